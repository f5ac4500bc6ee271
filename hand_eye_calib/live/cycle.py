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
from hand_eye_calib.live.log import NodeLog
from hand_eye_calib.live.processes import SolvingProcess
from hand_eye_calib.live.session import LiveSession
from hand_eye_calib.live.solving import Answer, Checked, Failure, FailureKind, Job
from hand_eye_calib.live.stream_checks import StreamChecks
from hand_eye_calib.results.calibration import Calibration, SolveStatus
from hand_eye_calib.results.records import Progress
from hand_eye_calib.session.goal import Goal

# Takes whether a solve was good, and a line about it.
OnSolved = Callable[[bool, str], None]


class SolveCycle:
    """Sends snapshots of the session to the solving process and takes the answers.

    At most one job is under way; a result of an older session is dropped.

    Parameters
    ----------
    session : LiveSession
    log : NodeLog
    wake : callable
        Called in another thread when :meth:`take_answers` has something to do.
    complete : callable
        Called with each usable Calibration; gives it with what there is to add.
    publish : callable
        Called with each usable Calibration.
    targets : (6,) sequence
        Standard deviations wanted, m and rad.

    Attributes
    ----------
    checks : StreamChecks
    goal : Goal
    solves : int
        Solves of this node so far.
    seconds : float
        Duration of the last one.
    is_solving : bool
    result : Calibration or None
        The session's result: the newest usable one; once the goal is reached, the one kept. The
        newest was found at ``solved_at_s`` (steady time).
    snapshot : Snapshot or None
        The poses and options that gave that result.
    seen : Excitation or None
        How the sensors have moved, as of the last solve.
    failure : Failure or None
        Of the last solve.
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
        self.solves, self.seconds, self.is_solving = 0, 0.0, False
        self.checks, self.goal = StreamChecks(), Goal(targets)
        self._session, self._log = session, log
        self._complete, self._publish = complete, publish
        self._rest_until_s = 0.0
        self._asked: list[OnSolved] = []
        self._asked_in_flight: list[OnSolved] = []
        self._submitted: Snapshot | None = None
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
        self._said: tuple[object, ...] = ()
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
        for note in self._process.notes():
            self._log.warning(note)
        for answer in self._process.answers():
            good, text = self._conclude(answer)
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
            self._conclude(answer)

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

    def _conclude(self, answer: Answer) -> tuple[bool, str]:
        """Take an answer; whether it is good, and a line about it."""
        if answer.session != self._session.number:
            return False, "the session was reset during the solve: its result is dropped"
        self.solves += 1
        self.seconds = answer.seconds
        # Solves that take longer than their period leave the processor free for half the time.
        self._rest_until_s = time.monotonic() + answer.seconds
        self.seen, self.failure = answer.seen, answer.failure
        self._session.calibrator.adopt(answer.time_offset)
        if answer.check is not None:
            self._take_check(answer.check)
        if answer.calibration is None:
            assert answer.failure is not None
            missing = what_is_missing(self.seen) if self.seen and self.seen.n_poses else ""
            self.goal.wait(missing or answer.failure.what)
            return False, self._report_failure(answer.failure)
        return self._report_result(answer.calibration)

    def _take_check(self, checked: Checked) -> None:
        if checked.failure is not None:
            text = f"the streams cannot be checked: {checked.failure.what}"
            self._log.warning(text, "unchecked")
            return
        if checked.options:
            self._certain, self._told = self._certain | checked.options, checked.told
        new, gone = self.checks.take(checked.result, time.monotonic())
        for line in new:
            self._log.warning(line)
        for line in gone:
            self._log.info(line)

    def _report_result(self, calibration: Calibration) -> tuple[bool, str]:
        warnings = dict.fromkeys((*self._told, *calibration.warnings))
        calibration = self._with_findings(replace(calibration, warnings=tuple(warnings)))
        if not calibration.status.failure:
            assert self.seen is not None
            calibration = self._complete(calibration)
            progress = self.goal.add(calibration, self.seen, self.checks.faults())
            self._tell(progress)
            best = self.goal.best or calibration
            if best is calibration:
                assert self._submitted is not None
                self.snapshot = with_options(self._submitted, self._certain)
            self.result, self.solved_at_s = self._with_findings(best), time.monotonic()
            self._publish(self.result)
        text = describe(calibration)
        self._log.info(text, "result", 1.0)
        for reason in calibration.reasons:
            if not reason.is_finding:  # which are in the log already
                told = f"{reason.verdict.value}: {reason.sentence}; {reason.what_to_do}"
                self._log.warning(told, (reason.rule, reason.axes))
        for warning in calibration.warnings:
            self._log.warning(warning, warning)
        said = [f"{reason.sentence}; {reason.what_to_do}" for reason in calibration.reasons]
        return calibration.status is SolveStatus.OK, "; ".join((text, *said, *calibration.warnings))

    def _tell(self, progress: Progress) -> None:
        """Log the progress unless only its figures differ from what was said last."""
        said = progress.limiting_axis, progress.done, progress.will_not_get_there
        if said == self._said or progress.is_faulty or not progress.sentence:
            return
        self._said = said
        write = self._log.warning if progress.will_not_get_there else self._log.info
        write(progress.sentence)

    def _with_findings(self, calibration: Calibration) -> Calibration:
        if calibration.measured != "poses":
            return calibration  # which has its own
        return replace(calibration, findings=self.checks.findings)

    def _report_failure(self, failure: Failure) -> str:
        if failure.kind is FailureKind.NOT_ENOUGH_DATA:
            self._log.info(f"cannot solve yet: {failure.what}", "not enough data")
            return failure.what
        if failure.kind is FailureKind.UNUSABLE:
            self._log.warning(f"cannot solve: {failure.what}", "failed")
            return failure.what
        details = f"\n{failure.details}" if failure.details else ""
        text = f"the solve failed unexpectedly: {failure.what}"
        self._log.error(f"{text}{details}", "unexpected")
        return f"{text}; see the log"


def describe(calibration: Calibration) -> str:
    """One line for a log: whose pose in whose frame, how good, from how much."""
    xyz = ", ".join(f"{value:.4f}" for value in calibration.T_parent_child[:3, 3])
    angles = np.degrees(se3.rotation_to_rpy(calibration.T_parent_child[:3, :3]))
    rpy = ", ".join(f"{value:.3f}" for value in angles)
    sigmas_mm = ", ".join(_sigma(1000 * value, 1) for value in calibration.sigmas[:3])
    sigmas_deg = ", ".join(_sigma(value, 3) for value in np.degrees(calibration.sigmas_rpy))
    backend = " ipopt" * (calibration.backend == "ipopt")
    return (
        f"{calibration.headline}. {calibration.child_frame} in {calibration.parent_frame}: "
        f"xyz = ({xyz}) m +/- ({sigmas_mm}) mm, rpy = ({rpy}) deg +/- ({sigmas_deg}) deg; "
        f"status {calibration.status.value}; "
        f"{calibration.method} {calibration.reference}{backend}: "
        f"{calibration.n_poses} poses, {calibration.n_pairs} pairs, "
        f"{calibration.n_inliers} inliers"
    )


def _sigma(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "unknown"
