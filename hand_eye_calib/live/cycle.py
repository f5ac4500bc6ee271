"""When the node solves, what came of it, and who waits for the answer."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hand_eye_calib.assessment.excitation import Excitation, what_is_missing
from hand_eye_calib.engine.run import with_options
from hand_eye_calib.engine.snapshot import Snapshot
from hand_eye_calib.geometry import se3
from hand_eye_calib.live.log import ONCE_S, NodeLog
from hand_eye_calib.live.processes import SolvingProcess
from hand_eye_calib.live.session import LiveSession
from hand_eye_calib.live.solving import Answer, Checked, Failure, FailureKind, Job
from hand_eye_calib.live.stream_checks import StreamChecks
from hand_eye_calib.results.calibration import Calibration, SolveStatus
from hand_eye_calib.session.goal import Goal
from hand_eye_calib.text import amount

# Takes whether a solve was good, and a line about it.
OnSolved = Callable[[bool, str], None]

# The line about the result, and the sentence that says what to do now, are logged so often (s).
_SAID_EVERY_S = 60.0

# What the motion does not determine is worth a warning after so many seconds of it.
_ENOUGH_MOTION_S = 30.0


class SolveCycle:
    """Sends snapshots of the session to the solving process and takes the answers.

    At most one job is under way; a result of an older session is dropped.

    Parameters
    ----------
    session : LiveSession
    log : NodeLog
    wake : callable
        Called in another thread when :meth:`take_answers` has something to do.
    complete, publish : callable
        Called with each usable Calibration, which gives it with what there is to add; and with the
        session's result whenever there is a new one.
    targets : (6,) sequence
        Standard deviations wanted, m and rad.

    Attributes
    ----------
    is_solving : bool
    result : Calibration or None
        The session's result, which is told, published, saved and broadcast: the newest usable one;
        once the goal is reached, the one kept, whose warnings say why the newest is not. The
        newest was found at ``solved_at_s`` (steady time).
    snapshot : Snapshot or None
        The poses and options that gave that result.
    seen, failure
        How the sensors have moved, and what went wrong, as of the last solve.
    """

    def __init__(
        self,
        session: LiveSession,
        log: NodeLog,
        wake: Callable[[], None],
        complete: Callable[[Calibration], Calibration],
        publish: Callable[[Calibration], None],
        targets: Sequence[float],
    ) -> None:
        self.is_solving = False
        self.checks, self.goal = StreamChecks(), Goal(targets)
        self._session, self._log = session, log
        self._complete, self._publish = complete, publish
        self._rest_until_s = 0.0
        self._asked: list[OnSolved] = []
        self._asked_in_flight: list[OnSolved] = []
        self._process = SolvingProcess(wake)
        self.restart()

    def restart(self) -> None:
        """Begin a new session: no result yet."""
        self.result: Calibration | None = None
        self.snapshot: Snapshot | None = None
        self.solved_at_s: float | None = None
        self.seen: Excitation | None = None
        self.failure: Failure | None = None
        self._certain: dict[str, Any] = {}
        self._told: tuple[str, ...] = ()
        self.checks.restart()
        self.goal.restart()

    def follow(self, targets: Sequence[float]) -> None:
        """Options have changed: start over with a goal of these targets."""
        self.goal = Goal(targets)
        self._certain, self._told = {}, ()
        self.checks.hasten()

    @property
    def has_valid_result(self) -> bool:
        """Whether there is a result with all six degrees of freedom."""
        return self.result is not None and self.result.status is SolveStatus.OK

    def age_s(self, steady_s: float) -> float:
        """Age of the result at a steady time."""
        return 0.0 if self.solved_at_s is None else steady_s - self.solved_at_s

    def ask(self, on_solved: OnSolved) -> None:
        """Solve as soon as possible."""
        self._asked.append(on_solved)
        if not self.is_solving:
            self._start()

    def start_if_due(self) -> None:
        """Solve if there is something new and the last solve has left the processor a rest."""
        now_s = time.monotonic()
        has_work = self._session.has_new_poses or self.checks.is_due(now_s)
        if has_work and not self.is_solving and now_s >= self._rest_until_s:
            self._start()

    def take_answers(self) -> None:
        """Take what the solving process has sent."""
        for answer in self._process.answers():
            good, text = self.conclude(answer)
            self.is_solving = False
            asked, self._asked_in_flight = self._asked_in_flight, []
            for on_solved in asked:
                on_solved(good, text)
            if self._asked:
                self._start()

    def stop(self, timeout_s: float) -> None:
        """Wait so long for the solve under way, take its result, and end the process."""
        self._process.stop(timeout_s)
        for answer in self._process.answers():
            self.conclude(answer)

    def _start(self) -> None:
        self.is_solving = True
        self.checks.has_new_poses |= self._session.has_new_poses
        self._session.has_new_poses = False
        self._asked_in_flight, self._asked = self._asked, []
        now_s = time.monotonic()
        check = self.checks.is_due(now_s)
        if check:
            self.checks.begin(now_s)
        self._submitted = self._session.calibrator.snapshot()
        self._process.submit(Job(self._session.number, self._submitted, check, self._certain))

    def conclude(self, answer: Answer) -> tuple[bool, str]:
        """Take an answer; whether it is good, and a line about it."""
        if answer.session != self._session.number:
            return False, "the session was reset during the solve: its result is dropped"
        # Solves that take longer than their period leave the processor free for half the time.
        self._rest_until_s = time.monotonic() + answer.seconds
        self.seen, self.failure = answer.seen, answer.failure
        self._session.calibrator.adopt(answer.time_offset)
        if answer.check is not None:
            self._take_check(answer.check)
        if answer.failure is not None:
            missing = what_is_missing(self.seen) if self.seen and self.seen.n_poses else ""
            self.goal.wait(missing or answer.failure.what)
            return False, self._report_failure(answer.failure)
        assert answer.calibration is not None
        told = tuple(dict.fromkeys((*self._told, *answer.calibration.warnings)))
        newest = self._with_findings(replace(answer.calibration, warnings=told))
        if newest.status.failure:
            return False, self._answer_with(newest)
        return self._take(self._complete(newest))

    def _take_check(self, checked: Checked) -> None:
        if checked.failure is not None:
            self._log.warning(f"the streams cannot be checked: {checked.failure.what}")
            return
        if checked.options:
            self._certain, self._told = self._certain | checked.options, checked.told
        new, gone = self.checks.take(checked.result, time.monotonic())
        for line in new:
            self._log.warning(line)
        for line in gone:
            self._log.info(line)

    def _take(self, newest: Calibration) -> tuple[bool, str]:
        """Take a usable calibration: it becomes the session's result, unless a better one that has
        reached the goal is kept.
        """
        assert self.seen is not None
        was_done = self.goal.progress.done
        progress = self.goal.add(newest, self.seen, self.checks.faults())
        result = self.goal.best or newest
        if result is newest:
            self.snapshot = with_options(self._submitted, self._certain)
        else:
            result = replace(result, warnings=(*result.warnings, _why_kept(result, newest)))
        self.result, self.solved_at_s = self._with_findings(result), time.monotonic()
        self._publish(self.result)
        if not progress.is_faulty and progress.sentence:
            write = self._log.warning if progress.will_not_get_there else self._log.info
            write(progress.sentence, _SAID_EVERY_S, key=f"now {progress.done}")
        every_s = _SAID_EVERY_S if progress.done == was_done else 0.0
        return self.result.status is SolveStatus.OK, self._answer_with(self.result, every_s)

    def _answer_with(self, calibration: Calibration, every_s: float = _SAID_EVERY_S) -> str:
        """A line about a calibration with its reasons and warnings. What is new of that is logged:
        the reasons once the motion has had its chance, as the progress says what to do before.
        """
        text = describe(calibration)
        self._log.info(text, every_s, key="result")
        progress, seen = self.goal.progress, self.seen
        is_late = seen is not None and seen.motion_s >= _ENOUGH_MOTION_S
        is_final = progress.done or progress.will_not_get_there or bool(calibration.status.failure)
        said = []
        for reason in calibration.reasons:
            said.append(f"{reason.sentence}; {reason.what_to_do}")
            is_due = is_final or (is_late and reason.rule == "unobservable")
            if is_due and not reason.is_finding:  # which are in the log already
                self._log.warning(f"{reason.verdict.value}: {said[-1]}")
        for warning in calibration.warnings:
            self._log.warning(warning)
        return "; ".join((text, *said, *calibration.warnings))

    def _with_findings(self, calibration: Calibration) -> Calibration:
        if calibration.measured != "poses":
            return calibration  # which has its own
        return replace(calibration, findings=self.checks.findings)

    def _report_failure(self, failure: Failure) -> str:
        if failure.kind is FailureKind.NOT_ENOUGH_DATA:
            self._log.info(f"cannot solve yet: {failure.what}", ONCE_S)
        elif failure.kind is FailureKind.UNUSABLE:
            self._log.warning(f"cannot solve: {failure.what}")
        else:
            text = f"the solve failed unexpectedly: {failure.what}"
            self._log.error("\n".join(filter(None, (text, failure.details))))
            return f"{text}; see the log"
        return failure.what


def _why_kept(kept: Calibration, newest: Calibration) -> str:
    """Which result is kept, and what speaks against the newest one."""
    if newest.reasons:
        why = f"of that is said: {newest.headline}"
    else:
        worst = int(np.argmax(newest.sigmas / kept.sigmas))
        dof = newest.observability[worst].name
        before, now = (amount(dof, float(each.sigmas[worst])) for each in (kept, newest))
        why = f"that knows {dof} to {now} only, this one to {before}"
    xyz, rpy = _pose_in_words(newest)
    return (
        f"kept is the result of {kept.n_poses} poses, not the newest (of {newest.n_poses} poses, "
        f"xyz = ({xyz}) m, rpy = ({rpy}) deg): {why}"
    )


def describe(calibration: Calibration) -> str:
    """One line for a log: whose pose in whose frame, how good, from how much."""
    xyz, rpy = _pose_in_words(calibration)
    sigmas = calibration.sigmas_printed
    sigmas_mm = ", ".join(_sigma(1000 * value, 1) for value in sigmas[:3])
    sigmas_deg = ", ".join(_sigma(value, 3) for value in np.degrees(sigmas[3:]))
    backend = " ipopt" * (calibration.backend == "ipopt")
    return (
        f"{calibration.headline}. {calibration.child_frame} in {calibration.parent_frame}: "
        f"xyz = ({xyz}) m +/- ({sigmas_mm}) mm, rpy = ({rpy}) deg +/- ({sigmas_deg}) deg; "
        f"status {calibration.status.value}; "
        f"{calibration.method} {calibration.reference}{backend}: "
        f"{calibration.n_poses} poses, {calibration.n_pairs} pairs, "
        f"{calibration.n_inliers} inliers"
    )


def _pose_in_words(calibration: Calibration) -> tuple[str, str]:
    angles = np.degrees(se3.rotation_to_rpy(calibration.T_parent_child[:3, :3]))
    return (
        ", ".join(f"{value:.4f}" for value in calibration.T_parent_child[:3, 3]),
        ", ".join(f"{value:.3f}" for value in angles),
    )


def _sigma(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "unknown"
