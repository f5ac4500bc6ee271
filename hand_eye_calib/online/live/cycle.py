"""Solves and stream checks of a live session: when they run, and how their results are used.

Solves run in a process of their own, see ``solving.py``. A :class:`SolveCycle` sends a copy of the
engine to this process as soon as there are new poses, receives the answer, and decides whether the
new result becomes the result of the session.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from hand_eye_calib.core.assessment.excitation import Excitation
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.option import Options
from hand_eye_calib.core.base.plain import plain
from hand_eye_calib.core.base.text import duration, parse_targets
from hand_eye_calib.core.engine.attempts import with_options
from hand_eye_calib.core.engine.calibrator import Calibrator
from hand_eye_calib.core.engine.snapshot import STREAMS, Snapshot
from hand_eye_calib.core.results.calibration import (
    Calibration,
    SolveStatus,
    Verdict,
)
from hand_eye_calib.online.live.describing import (
    advice_after_failure,
    comparison_of,
    describe,
    is_held_up,
    is_refuted,
    is_too_little,
    priors_of,
    refuted_in_words,
    slow_in_words,
    state_of_result,
    too_little_in_words,
    with_newest_halves,
)
from hand_eye_calib.online.live.goal import Goal, no_result_in_words
from hand_eye_calib.online.live.log import GOES_ON_S, ONCE_S, NodeLog
from hand_eye_calib.online.live.result_log import ResultLog
from hand_eye_calib.online.live.session import LiveSession
from hand_eye_calib.online.live.solving import (
    NO_MOTION,
    Answer,
    Failure,
    Job,
    SolvingProcess,
)
from hand_eye_calib.online.live.state import (
    ANSWER_WITHIN_S,
    Broadcast,
    BroadcastState,
    Condition,
    ExtrinsicState,
    Level,
    Outcome,
    ProgressState,
    Standing,
)
from hand_eye_calib.online.live.stream_checks import StreamChecks

# Callback that receives the success of a solve and a line of text about the result.
OnSolved: TypeAlias = Callable[[bool, str], None]

# Shortest time between two stream checks (s). A check takes one or two seconds.
_CHECK_PERIOD_S = 30.0

# Shortest time between two stream checks, as a multiple of the duration of a solve. A check
# prolongs a solve by a half. So on a busy computer most solves have no check.
_SOLVES_PER_CHECK = 4.0

# Options that change the verdict on a result, but not the result.
_TARGETS = ("target_translation", "target_rotation", "target_axes")


class SolveCycle:
    """Send jobs to the solving process, and store the result of the session.

    At most one job runs at a time. An answer to a job of an older session is dropped.

    Parameters
    ----------
    session : LiveSession
    log : NodeLog
    wake : callable
        Function that is called in another thread when an answer arrives for :meth:`take_answers`.
    complete : callable
        Function that gets a usable Calibration, and returns it with additions of the node.
    publish : callable
        Function that is called after an answer was processed, before the callbacks of :meth:`ask`.
    targets : (6,) sequence
        Target standard deviations of x, y, z (m), roll, pitch and yaw (rad).

    Attributes
    ----------
    is_solving : bool
    result : Calibration or None
        Result of the session: the newest usable result, or the best result after the goal is
        reached. If a newer result was worse, the warnings contain its values. If the motion
        contradicts a prior, the result has the verdict DO NOT USE.
    """

    def __init__(
        self,
        session: LiveSession,
        log: NodeLog,
        wake: Callable[[], None],
        complete: Callable[[Calibration], Calibration],
        publish: Callable[[], None],
        targets: Sequence[float],
    ) -> None:
        self.is_solving = False
        self.checks = StreamChecks(log)
        self.goal = Goal(targets)
        self._results = ResultLog(log)
        self._session = session
        self._log = log
        self._complete = complete
        self._publish = publish
        # Earliest start of the next solve (steady time, s).
        self._rest_until_s = 0.0
        # Start of the newest job (steady time, s).
        self._started_s = 0.0
        # Duration and processor time of the last finished job (s).
        self._job_s = 0.0
        self._job_processor_s = 0.0
        # Callbacks that wait for a solve, with the time of the request (steady time, s).
        self._waiting: dict[OnSolved, float] = {}
        # Callbacks that the answer to the current job must call. They were waiting when the job
        # started.
        self._in_job: tuple[OnSolved, ...] = ()
        self._process = SolvingProcess(wake)
        self.restart()

    def restart(self) -> None:
        """Begin a new session without a result."""
        self.result: Calibration | None = None
        # Copy of the engine with the poses of the result, and options that checks had set.
        self._solved: tuple[Calibrator, Options] | None = None
        self._solved_at_s = 0.0
        # Motion of the session so far.
        self._motion = NO_MOTION
        # Motion of the last minute.
        self._newest_motion: Excitation | None = None
        # Failure of the newest solve.
        self._failure: Failure | None = None
        # Time of the first failure (steady time, s), if all solves since the result have failed.
        self._failing_since_s: float | None = None
        # Options that checks of this session have set, and the warnings about these options.
        self._check_options: Options = {}
        self._option_warnings: tuple[str, ...] = ()
        # Whether poses or options have come that no check has used.
        self._is_unchecked = False
        # Earliest time of the next check (steady time, s).
        self._check_due_s = 0.0
        self.checks.restart()
        self.goal.restart()
        self._results.restart()

    def follow(
        self, config: CalibratorConfig, before: CalibratorConfig
    ) -> None:
        """Apply changed options; check the streams again at once.

        If only targets have changed, the result is kept, because the robot may be parked. Its
        verdict is computed again. Otherwise the goal starts again.

        Parameters
        ----------
        config, before : CalibratorConfig
            New and former options.
        """
        self._check_options = {}
        self._option_warnings = ()
        self._is_unchecked = True
        self._check_due_s = 0.0
        self.checks.follow(config)
        targets = {name: getattr(config, name) for name in _TARGETS}
        result = self.published
        has_same_values = replace(before, **targets) == config
        others_before = before.given.difference(_TARGETS)
        has_same_names = others_before == config.given.difference(_TARGETS)
        have_only_targets_changed = has_same_values and has_same_names
        if result is None or not have_only_targets_changed:
            self.goal.follow(config.targets)
            return
        targets["target_axes"] = parse_targets(
            "target.axes", config.target_axes
        )
        self.result = replace(result, **targets)
        self.goal.retarget(self.result, config.targets)

    @property
    def published(self) -> Calibration | None:
        """Result to publish; None if there is none, or if it is refuted."""
        if self.result is None or is_refuted(self.result):
            return None
        return self.result

    @property
    def standing(self) -> Standing:
        """Validity of the result."""
        if self.result is None:
            return Standing.NONE
        if is_refuted(self.result):
            return Standing.REFUTED
        if self._failing_since_s is None:
            return Standing.CURRENT
        return Standing.OUTDATED

    @property
    def problem(self) -> str:
        """Reason why the result is refuted or outdated, in one line; empty otherwise."""
        result = self.result
        failure = self._failure
        if result is None:
            return ""
        if is_refuted(result):
            return refuted_in_words(result)
        if failure is None or self._failing_since_s is None:
            return ""
        now_s = time.monotonic()
        failing_s = duration(now_s - self._failing_since_s)
        age_s = duration(now_s - self._solved_at_s)
        return (
            f"every solve has failed for {failing_s}: {failure.what.rstrip('.')}; the result shown "
            f"is {age_s} old, of {result.n_poses} poses"
        )

    def result_to_save(self) -> Calibration | None:
        """Return the result; None if there is none.

        If all later solves have failed, the result gets a warning about this failure.
        """
        if self.result is None or self.standing is not Standing.OUTDATED:
            return self.result
        return replace(
            self.result, warnings=(*self.result.warnings, self.problem)
        )

    def snapshot(self) -> Snapshot | None:
        """Return the poses and options of the result; None without a result."""
        if self._solved is None:
            return None
        calibrator, options = self._solved
        return with_options(calibrator.snapshot(), options)

    # ------------------------------------------------------------------ solving

    def ask(self, on_solved: OnSolved) -> None:
        """Solve as soon as possible, and call ``on_solved`` with the answer."""
        self._waiting[on_solved] = time.monotonic()
        if not self.is_solving:
            self._start()

    def answer_overdue(self) -> None:
        """Answer callers that have waited too long, although the solve still runs.

        This method must be called often.
        """
        now_s = time.monotonic()
        for on_solved, asked_s in list(self._waiting.items()):
            if asked_s >= now_s - ANSWER_WITHIN_S:
                continue
            del self._waiting[on_solved]
            text = f"still solving after {ANSWER_WITHIN_S:g} s (is the processor busy?)"
            on_solved(
                False,
                f"{text}: the result will be in the log and on the topics",
            )

    def start_if_due(self) -> None:
        """Start a solve or a check if there are new poses and the pause after a solve is over."""
        now_s = time.monotonic()
        must_check = self._is_unchecked and now_s >= self._check_due_s
        has_work = self._session.has_new_poses or must_check
        if has_work and not self.is_solving and now_s >= self._rest_until_s:
            self._start()

    def take_answers(self) -> None:
        """Process the answers of the solving process, and call the callbacks of their jobs."""
        for answer in self._process.answers():
            is_good, text = self.conclude(answer)
            self.is_solving = False
            self._publish()
            for on_solved in self._in_job:
                # A caller that waited too long already has an answer.
                if self._waiting.pop(on_solved, None) is not None:
                    on_solved(is_good, text)
            self._in_job = ()
            if self._waiting:
                self._start()

    def stop(self, timeout_s: float) -> None:
        """Wait up to ``timeout_s`` for the current solve, take its result, and end the process."""
        self._process.stop(timeout_s)
        for answer in self._process.answers():
            self.conclude(answer)

    def _start(self) -> None:
        """Submit a job to the solving process."""
        now_s = time.monotonic()
        self.is_solving = True
        self._started_s = now_s
        self._is_unchecked |= self._session.has_new_poses
        self._in_job = tuple(self._waiting)
        # A requested result needs up-to-date findings, even if no check is due.
        is_due = now_s >= self._check_due_s or bool(self._in_job)
        check = self._is_unchecked and is_due
        if check:
            self._is_unchecked = False
            self._check_due_s = now_s + max(
                _CHECK_PERIOD_S, _SOLVES_PER_CHECK * self._job_s
            )
        self._submitted = self._session.copy_to_solve()
        job = Job(
            self._session.number,
            self._submitted,
            check,
            self._check_options,
            has_hurry=is_held_up(self._job_s, self._job_processor_s),
        )
        self._process.submit(job)

    # ------------------------------------------------------------------ answers

    def conclude(self, answer: Answer) -> Outcome:
        """Process an answer; return the success of the solve, and a line of text about it."""
        if answer.session != self._session.number:
            return (
                False,
                "the session was reset during the solve: the result is dropped",
            )
        # Pause for the processor time of the solve, so that half of the processor stays free. On a
        # busy computer, the solve takes much longer than its processor time, so this pause
        # suffices.
        self._rest_until_s = time.monotonic() + answer.processor_s
        self._job_s = answer.seconds
        self._job_processor_s = answer.processor_s
        if slow := slow_in_words(
            self._job_s, self._job_s, self._job_processor_s
        ):
            self._log.warning(slow, key="slow")
        self._take_motion(answer)
        self._take_check(answer)
        calibration = answer.calibration
        if calibration is not None and answer.check is None:
            calibration = self.checks.with_open_errors(calibration)
        self._failure = answer.failure
        if self.result is None and is_too_little(self._motion):
            calibration = None
            text = too_little_in_words(self._motion)
            self._failure = self._failure or Failure(text, is_early=True)
        text = self._results.failure(self._failure) if self._failure else ""
        if calibration is None:
            self._keep_result(*self._advice_after_failure())
            return False, text
        newest = self._with_warnings(calibration)
        if newest.status is SolveStatus.CONTRADICTED:
            return self._refute(newest)
        if newest.status.failure:
            self._failure = Failure(newest.status.failure)
            self._keep_result(no_result_in_words(newest.status.failure))
            return False, self._results.result(newest, self.goal.progress)
        return self._take(self._complete(newest))

    def _advice_after_failure(self) -> tuple[str, tuple[str, ...]]:
        """Return advice after a failed solve, and axes that may be measured by hand."""
        statistics = map(self._session.calibrator.statistics, STREAMS)
        n_received = min(stream.received for stream in statistics)
        failure = self._failure.what if self._failure is not None else ""
        return advice_after_failure(self._motion, n_received, failure)

    def _with_warnings(self, calibration: Calibration) -> Calibration:
        """Return a calibration with findings and warnings of the session; log the warnings."""
        warnings = tuple(
            dict.fromkeys((*self._option_warnings, *calibration.warnings))
        )
        for warning in warnings:
            self._log.warning(warning)
        warned = replace(calibration, warnings=warnings)
        return self.checks.with_findings(warned)

    def _take_motion(self, answer: Answer) -> None:
        """Store motion and clock offset of an answer."""
        # More poses can decrease the estimated rotation. Keep the largest value so far.
        rotation = np.maximum(self._motion.rotation, answer.motion.rotation)
        self._motion = replace(answer.motion, rotation=rotation)
        self._newest_motion = answer.newest_motion
        self._session.calibrator.adopt(answer.time_offset)

    def _take_check(self, answer: Answer) -> None:
        """Store the stream check of an answer, and the options that the check has set."""
        if answer.options:
            self._check_options = {**self._check_options, **answer.options}
            self._option_warnings = answer.messages
        if answer.check is not None:
            self.checks.take(answer.check)
        elif answer.is_checked:
            self._check_due_s = 0.0

    def _keep_result(self, advice: str, by_hand: tuple[str, ...] = ()) -> None:
        """Keep the result after a failed solve, and mark the result as outdated.

        Without a result, the advice becomes the progress of the session.
        """
        self.goal.wait(advice, by_hand)
        if self._failing_since_s is None:
            self._failing_since_s = time.monotonic()

    def _refute(self, newest: Calibration) -> Outcome:
        """Replace the result by a calibration with a prior that the motion contradicts.

        The earlier result is then neither published nor saved.
        """
        self.goal.add(newest, self._motion, self.checks.faults())
        self._solved = self._submitted, self._check_options
        self._set_result(newest)
        return False, self._results.result(newest, self.goal.progress)

    def _set_result(self, result: Calibration) -> None:
        """Store the result of the session as current."""
        self.result = result
        self._solved_at_s = time.monotonic()
        self._failing_since_s = None

    def _take(self, newest: Calibration) -> Outcome:
        """Make a usable calibration the result of the session, unless the goal has a better one."""
        was_done = self.goal.progress.done
        faults = self.checks.faults()
        progress = self.goal.add(
            newest, self._motion, faults, self._newest_motion, self._job_s
        )
        result = self.goal.best or newest
        if result is newest:
            self._solved = self._submitted, self._check_options
        else:
            reason = (
                f"the result of {result.n_poses} poses is kept, "
                "because the newest result is worse"
            )
            self._log.info(f"{reason}: {describe(newest)}", ONCE_S, key="kept")
            result = replace(result, warnings=(*result.warnings, reason))
            result = with_newest_halves(result, newest)
        result = self.checks.with_findings(result)
        self._set_result(result)
        every_s = GOES_ON_S if progress.done == was_done else 0.0
        text = self._results.result(result, progress, every_s)
        return result.status is SolveStatus.OK, text

    # -------------------------------------------------------------------- state

    def extrinsic_state(
        self, accepts_poses: bool, tf_static: BroadcastState
    ) -> ExtrinsicState:
        """Return the diagnostics of the result.

        Parameters
        ----------
        accepts_poses : bool
            Whether the inputs accept poses.
        tf_static : tuple of Broadcast and str
            Whether the result is broadcast on /tf_static, and if not, the reason.
        """
        motion = self._motion
        level, text = self._condition(accepts_poses, tf_static)
        result = None
        contradicted: tuple[str, ...] = ()
        if self.result is not None:
            age_s = time.monotonic() - self._solved_at_s
            result = state_of_result(self.result, age_s)
            contradicted = tuple(self.result.contradictions)
        return ExtrinsicState(
            level=level,
            text=text,
            is_solving=self.is_solving,
            slow=self._slow_in_words(),
            n_poses=motion.n_poses,
            path_m=motion.distance,
            motion_s=motion.motion_s,
            has_vehicle_axes=motion.has_vehicle_axes,
            rotation_deg=dict(
                zip("xyz", plain(np.degrees(motion.rotation)), strict=True)
            ),
            tf_static=tf_static[0],
            tf_static_reason=tf_static[1],
            standing=self.standing,
            problem=self.problem,
            priors=priors_of(self._session.calibrator.config),
            contradicted=contradicted,
            result=result,
        )

    def _slow_in_words(self) -> str:
        """Return a sentence about slow solves with the reason; empty if solves are fast."""
        running_s = (
            time.monotonic() - self._started_s if self.is_solving else 0.0
        )
        return slow_in_words(
            max(running_s, self._job_s), self._job_s, self._job_processor_s
        )

    def _condition(
        self, accepts_poses: bool, tf_static: BroadcastState
    ) -> Condition:
        """Return level and text of the gravest condition that applies."""
        result = self.result
        failure = self._failure
        broadcast, why_refused = tf_static
        if failure is not None and failure.details:
            return (
                Level.ERROR,
                f"the solve failed unexpectedly, see the log: {failure.what}",
            )
        if result is not None and self.problem:
            separator = ": " if self.standing is Standing.REFUTED else ", but "
            return (
                Level.WARN,
                f"{result.verdict.value}{separator}{self.problem}",
            )
        if not accepts_poses:
            return (
                Level.WARN,
                "poses are not accepted: call ~/set_enabled, or activate the node",
            )
        if result is None:
            return Level.WARN, self._why_no_result()
        if (
            broadcast is Broadcast.REFUSED
            and result.verdict is not Verdict.DO_NOT_USE
        ):
            return Level.WARN, f"publish_tf is refused: {why_refused}"
        if failure is not None:
            return Level.WARN, failure.what
        return (
            Level.OK if result.verdict is Verdict.USE else Level.WARN,
            result.headline,
        )

    def _why_no_result(self) -> str:
        """Return the gravest finding and the failure of the newest solve."""
        texts = [
            f"{Verdict.DO_NOT_USE.value}: {fault}"
            for fault in self.checks.faults()[:1]
        ]
        if self._failure is not None:
            texts.append(self._failure.what)
        return "; ".join(texts) or "no result yet"

    def progress_state(
        self, why_not_compared: str, pause: Condition = (Level.OK, "")
    ) -> ProgressState:
        """Return the diagnostics of the progress towards the targets.

        The level is OK if the person should continue the motion; otherwise WARN.

        Parameters
        ----------
        why_not_compared : str
            Reason why the result is not compared with the installed transform; empty if no
            comparison was requested.
        pause : tuple of Level and str
            Level and reason if no poses arrive, as returned by
            :func:`~hand_eye_calib.online.live.describing.pause_of`.
        """
        progress = self.goal.progress
        needs_change = progress.is_faulty or progress.will_not_get_there
        is_well = self.standing is Standing.CURRENT and not needs_change
        level = Level.OK if is_well else Level.WARN
        pause_level, why_paused = pause
        if progress.done:
            why_paused = ""
        if why_paused:
            level = max(level, pause_level)
        text = progress.sentence
        if not progress.is_faulty:
            text = self.problem or why_paused or text
        return ProgressState(
            level=level,
            text=text,
            is_paused=bool(why_paused),
            progress=progress,
            comparison=comparison_of(self.result, why_not_compared),
        )
