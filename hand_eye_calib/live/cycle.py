"""When the node solves, what came of it, and who waits for the answer."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from rclpy.task import Future

from hand_eye_calib.assessment.excitation import Excitation, what_is_missing
from hand_eye_calib.engine.run import with_options
from hand_eye_calib.engine.snapshot import Snapshot
from hand_eye_calib.results.calibration import Calibration, SolveStatus
from hand_eye_calib.ros.check_monitor import CheckMonitor
from hand_eye_calib.ros.live_session import LiveSession
from hand_eye_calib.ros.log import NodeLog
from hand_eye_calib.ros.progress import ProgressLog
from hand_eye_calib.ros.results import describe
from hand_eye_calib.ros.solving import Checked, Failure, FailureKind, Job, Solved
from hand_eye_calib.ros.solving_process import SolvingProcess
from hand_eye_calib.session.goal import Goal

# Answers to many calls are sent a few at a time: a client keeps ten that it has not taken yet, and
# loses the others.
_ANSWERS_AT_ONCE = 4
ANSWER_PERIOD_S = 0.02


class SolveCycle:
    """Sends snapshots of the session to the solving process and takes the answers.

    At most one job is under way; a result of an older session is dropped.

    Parameters
    ----------
    session : LiveSession
    checks : CheckMonitor
    log : NodeLog
    wake : callable
        Called in another thread when :meth:`take_answers` has something to do.
    complete : callable
        Called with each usable Calibration; gives it with what there is to add.
    publish : callable
        Called with each usable Calibration.
    goal : Goal

    Attributes
    ----------
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
        checks: CheckMonitor,
        log: NodeLog,
        wake: Callable[[], None],
        complete: Callable[[Calibration], Calibration],
        publish: Callable[[Calibration], None],
        goal: Goal,
    ) -> None:
        self.solves = 0
        self.seconds = 0.0
        self.is_solving = False
        self._session, self._checks, self._log = session, checks, log
        self._complete, self._publish = complete, publish
        self.goal = goal
        self._progress_log = ProgressLog(log)
        self._rest_until_s = 0.0
        self._asked: list[Future] = []
        self._asked_in_flight: list[Future] = []
        self._due_answers: deque[tuple[Future, tuple[bool, str]]] = deque()
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
        self.goal.restart()

    def aim(self, targets: Sequence[float]) -> None:
        """Start over with a goal of these targets (6; m, rad): options have changed."""
        self.goal = Goal(targets)
        self._certain, self._told = {}, ()

    @property
    def has_valid_result(self) -> bool:
        """Whether there is a result with all six degrees of freedom."""
        return self.result is not None and self.result.status is SolveStatus.OK

    def ask(self) -> Future:
        """Solve as soon as possible; the future's result is (success, text)."""
        answer = Future()
        self._asked.append(answer)
        if not self.is_solving:
            self._start()
        return answer

    def start_if_due(self) -> None:
        """Solve if there is something new and the last solve has left the processor a rest."""
        now_s = time.monotonic()
        has_work = self._session.has_new_poses or self._checks.is_due(now_s)
        if has_work and not self.is_solving and now_s >= self._rest_until_s:
            self._start()

    def take_answers(self) -> None:
        """Take what the solving process has sent."""
        for note in self._process.notes():
            self._log.warning(note)
        for answer in self._process.answers():
            if isinstance(answer, Checked):
                self._take_check(answer)
            else:
                self._take_solve(answer)

    def answer_some(self) -> bool:
        """Answer the next of those who asked; whether there are more, to be answered after
        :data:`ANSWER_PERIOD_S`.
        """
        for _ in range(min(_ANSWERS_AT_ONCE, len(self._due_answers))):
            future, answer = self._due_answers.popleft()
            future.set_result(answer)
        return bool(self._due_answers)

    def stop(self, timeout_s: float) -> bool:
        """Wait for the solve under way, take its result, and end the process; False if it took
        longer than ``timeout_s``.
        """
        in_time = self._process.stop(timeout_s)
        for answer in self._process.answers():
            if isinstance(answer, Solved):
                self._conclude(answer)
        return in_time

    def _start(self) -> None:
        self.is_solving = True
        self._checks.has_new_poses |= self._session.has_new_poses
        self._session.has_new_poses = False
        self._asked_in_flight, self._asked = self._asked, []
        now_s = time.monotonic()
        check = self._checks.is_due(now_s)
        if check:
            self._checks.begin(now_s)
        snapshot = self._session.calibrator.snapshot()
        self._submitted = with_options(snapshot, self._certain)
        self._process.submit(Job(self._session.number, snapshot, check, self._certain))

    def _take_check(self, checked: Checked) -> None:
        if checked.session != self._session.number:
            return
        now_s = time.monotonic()
        self._rest_until_s = max(self._rest_until_s, now_s + checked.seconds)
        if checked.failure is not None:
            text = f"the streams cannot be checked: {checked.failure.what}"
            self._log.warning(text, "unchecked")
            return
        if checked.options:
            self._certain, self._told = checked.options, checked.told
            self._session.has_new_poses = True  # to be solved with these options
        new, gone = self._checks.take(checked.result, now_s)
        if self.result is not None:
            self.result = self._with_findings(self.result)
        for line in new:
            self._log.warning(line)
        for line in gone:
            self._log.info(line)

    def _take_solve(self, solved: Solved) -> None:
        good, text = self._conclude(solved)
        self.is_solving = False
        self._due_answers += [(answer, (good, text)) for answer in self._asked_in_flight]
        self._asked_in_flight = []
        if self._asked:
            self._start()

    def _conclude(self, solved: Solved) -> tuple[bool, str]:
        """Take an answer; whether it is good, and a line about it."""
        if solved.session != self._session.number:
            return False, "the session was reset during the solve: its result is dropped"
        self.solves += 1
        self.seconds = solved.seconds
        # Solves that take longer than their period leave the processor free for half the time.
        self._rest_until_s = time.monotonic() + solved.seconds
        self.seen, self.failure = solved.seen, solved.failure
        self._session.calibrator.adopt(solved.time_offset)
        if solved.calibration is None:
            assert solved.failure is not None
            missing = what_is_missing(self.seen) if self.seen and self.seen.n_poses else ""
            self.goal.wait(missing or solved.failure.what)
            return False, self._report_failure(solved.failure)
        return self._report_result(solved.calibration)

    def _report_result(self, calibration: Calibration) -> tuple[bool, str]:
        warnings = dict.fromkeys((*self._told, *calibration.warnings))
        calibration = replace(calibration, warnings=tuple(warnings))
        if not calibration.status.failure:
            assert self.seen is not None
            calibration = self._complete(calibration)
            faults = self._checks.faults()
            progress = self.goal.add(calibration, self.seen, faults)
            if not faults:  # which are in the log already
                self._progress_log.tell(progress)
            best = self.goal.best or calibration
            if best is calibration:
                self.snapshot = self._submitted
            self.result, self.solved_at_s = self._with_findings(best), time.monotonic()
            self._publish(self.result)
        calibration = self._with_findings(calibration)
        text = describe(calibration, self.seen)
        self._log.info(text, "result", 1.0)
        for reason in calibration.reasons:
            if not reason.is_finding:  # which are in the log already
                told = f"{reason.verdict.value}: {reason.sentence}; {reason.what_to_do}"
                self._log.warning(told, (reason.rule, reason.axes))
        for warning in calibration.warnings:
            self._log.warning(warning, warning)
        good = calibration.status is SolveStatus.OK
        said = [f"{reason.sentence}; {reason.what_to_do}" for reason in calibration.reasons]
        return good, "; ".join((text, *said, *calibration.warnings))

    def _with_findings(self, calibration: Calibration) -> Calibration:
        if calibration.measured != "poses":
            return calibration  # which has its own
        return replace(calibration, findings=self._checks.findings())

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
