"""The solving process of the node: its jobs, its answers, and both ends of its pipes.

A solve in a thread would share the interpreter with the callbacks: on a slow machine their latency
rises to a second. The process imports the engine and nothing of ROS. Jobs and answers are pickles,
which is safe because both ends are the same program, and no other program has the pipes.
"""

import contextlib
import gc
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from hand_eye_calib.core.alignment.time_offset import TimeOffset
from hand_eye_calib.core.assessment.excitation import Excitation, excitation
from hand_eye_calib.core.base.errors import HandEyeCalibError, NotEnoughDataError
from hand_eye_calib.core.base.option import Options
from hand_eye_calib.core.base.python_path import trusted_environment
from hand_eye_calib.core.checks.check import MIN_DURATION_S, CheckResult, can_check
from hand_eye_calib.core.checks.findings import Finding, answered
from hand_eye_calib.core.checks.streams import check_positions, check_stream
from hand_eye_calib.core.engine.attempts import with_options
from hand_eye_calib.core.engine.calibrator import Calibrator
from hand_eye_calib.core.engine.run import check, review
from hand_eye_calib.core.engine.snapshot import STREAMS, Snapshot
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.online.live.state import GRACE_S
from hand_eye_calib.online.live.stream_checks import merged

# Not `-m`: the classes would belong to the module __main__, which the node does not have.
_SOLVE = "from hand_eye_calib.online.live.solving import main; main()"

# Priority of the process: other programs get twice its share of a processor. A higher value makes a
# solve take minutes while other programs are busy. The latency of callbacks does not depend on it.
_NICENESS = 3

# Time (s) after which a job counts as hung: live sessions are solved in seconds.
HANGS_AFTER_S = 600.0

# Time (ns) of the motion that the advice to a person is about.
_NEWEST_NS = 60_000_000_000

# Fewest poses of a stream, not paired yet, for a check of its received poses.
_FEWEST_RAW = 200

NO_MOTION = excitation(PosePairs.empty())


@dataclass(frozen=True)
class Failure:
    """An error.

    Attributes
    ----------
    what : str
        The error in one line.
    details : str
        Text for the log; only if the error is a defect of the program.
    is_early : bool
        Whether there is too little data.
    """

    what: str
    details: str = ""
    is_early: bool = False


@dataclass(frozen=True)
class Job:
    """Poses to solve.

    The process makes the trajectories, because that would delay the callbacks of the node.

    Attributes
    ----------
    session : int
        Number of the session.
    calibrator : Calibrator
        Copy of the engine.
    check : bool
        Whether to check the streams, too.
    options : Options
        Options that an earlier check has set.
    """

    session: int
    calibrator: Calibrator
    check: bool = False
    options: Options = field(default_factory=dict)


@dataclass(frozen=True)
class Answer:
    """Result of a job: a calibration or a failure, or both if only the check has failed.

    Attributes
    ----------
    session : int
        Number of the session.
    seconds : float
        Duration of the job (s).
    motion : Excitation
        Motion of the sensors.
    calibration : Calibration or None
        With the options that the check has set.
    time_offset : TimeOffset or None
    failure : Failure or None
    is_checked : bool
        Whether the job has requested a check.
    check : CheckResult or None
        None if the motion is too short for a check, or has too little rotation.
    options : Options
        Options that the check has set.
    messages : tuple of str
        Sentences about these options.
    newest_motion : Excitation or None
        Motion of the last minute.
    """

    session: int
    seconds: float
    motion: Excitation = NO_MOTION
    calibration: Calibration | None = None
    time_offset: TimeOffset | None = None
    failure: Failure | None = None
    is_checked: bool = False
    check: CheckResult | None = None
    options: Options = field(default_factory=dict)
    messages: tuple[str, ...] = ()
    newest_motion: Excitation | None = None


def answer(job: Job) -> Answer:
    """Solve, then check the streams if the job requests it.

    The calibration has the options that the check has set.
    """
    start_s = time.monotonic()
    result = Answer(job.session, 0.0, is_checked=job.check)
    # The node reports all errors.
    try:
        received = job.calibrator.snapshot()
        configured = with_options(received, job.options)
        snapshot = configured.resolved
        result = replace(result, time_offset=snapshot.time_offset)
        pairs = snapshot.pose_pairs
        result = replace(result, motion=excitation(pairs), newest_motion=excitation(_newest(pairs)))
        result = replace(result, calibration=snapshot.estimate())
    except Exception as error:
        result = replace(result, failure=_failure(error))
    try:
        if job.check and can_check(*received.streams):
            result = _checked(result, configured, job.options)
    except Exception as error:
        result = replace(result, failure=result.failure or _failure(error))
    if result.check is not None:
        result = replace(result, check=with_raw_findings(result.check, received))
    return replace(result, seconds=time.monotonic() - start_s)


def _newest(pairs: PosePairs) -> PosePairs:
    """Return the pairs of the last minute."""
    if not len(pairs):
        return pairs
    return pairs[pairs.stamps_ns > pairs.stamps_ns[-1] - _NEWEST_NS]


def _checked(result: Answer, snapshot: Snapshot, options: Options) -> Answer:
    """Return the answer with a stream check, and with the calibration that the check chooses."""
    if result.calibration is None:
        return replace(result, check=check(snapshot))
    run = review(result.calibration, snapshot, options)
    return replace(
        result,
        check=run.check,
        options=dict(run.options),
        messages=run.messages,
        calibration=run.calibration if run.options else result.calibration,
    )


def with_raw_findings(result: CheckResult, snapshot: Snapshot) -> CheckResult:
    """Add errors in the newest poses as they were received, if older poses are paired already.

    A check of a session uses the pairs, for which one stream is interpolated. Interpolation hides
    poses of two sources that alternate. None of 232 windows of sound recordings has such an error.
    Warnings are left to the check of the pairs, because 1 of 15 windows has enough jumps for one.
    """
    if not len(snapshot.kept):
        return result
    config = snapshot.config
    errors: list[Finding] = []
    for stream, trajectory in zip(STREAMS, snapshot.unpaired, strict=True):
        if len(trajectory) < _FEWEST_RAW or trajectory.duration_s < MIN_DURATION_S / 2:
            continue
        if config.measured == "poses":
            findings = check_stream(trajectory, stream, config.max_gap)
        else:
            # Unless both streams have positions, the positions of a stream are no measurements.
            scale = 1.0 if config.measured == "positions" else 0.0
            findings = check_positions(trajectory.scaled(scale), stream, config.max_gap)
        errors += [finding for finding in answered(findings, config) if finding.makes_unusable]
    return replace(result, findings=merged(result.findings, errors))


def _failure(error: Exception) -> Failure:
    if isinstance(error, HandEyeCalibError):
        return Failure(str(error), is_early=isinstance(error, NotEnoughDataError))
    details = "".join(traceback.format_exception(error))
    return Failure(f"{type(error).__name__}: {error}", details)


# ------------------------------------------------------------- in the process


def main() -> None:
    """Answer jobs until standard input ends.

    It ends with the node, even if the node crashes.
    """
    os.nice(_NICENESS)
    # A library may print: that goes to standard error, not into the pipe.
    outgoing = os.fdopen(os.dup(1), "wb")
    os.dup2(sys.stderr.fileno(), 1)
    jobs: queue.SimpleQueue[Job] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(jobs,), daemon=True).start()
    while True:
        pickle.dump(answer(jobs.get()), outgoing, pickle.HIGHEST_PROTOCOL)
        outgoing.flush()
        # References to the arrays of a job form cycles: memory grew by a half in 60 solves.
        gc.collect()


def _receive(jobs: "queue.SimpleQueue[Job]") -> None:
    """Read jobs in a thread, so that the end of the node also ends a long solve."""
    try:
        while True:
            jobs.put(pickle.load(sys.stdin.buffer))
    finally:
        os._exit(0)


# ----------------------------------------------------------------- in the node


def start(code: str, *arguments: str, stdin: Any, stdout: Any) -> "subprocess.Popen[bytes]":
    """Run Python code with the modules of this process.

    The new process has a group of its own, so that Ctrl-C in the terminal does not reach it.
    """
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdin=stdin,
        stdout=stdout,
        env=trusted_environment(),
        process_group=0,
    )


class SolvingProcess:
    """A process that answers one job at a time.

    The process starts at once. It starts again after it has died or has been killed because it
    hung; its job has failed then. The end of the node ends it in any case. The threads in this
    class only wait for the pipes.

    Parameters
    ----------
    on_answer : callable
        Called in another thread when an answer is ready; one call may stand for two answers.
    command : str
        Python code that the process runs.
    """

    def __init__(self, on_answer: Callable[[], None], command: str = _SOLVE) -> None:
        self._on_answer = on_answer
        self._command = command
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._is_stopping = False
        self._start()
        # Only a thread that was started can be joined.
        self._thread = threading.Thread()
        self._thread.start()

    def submit(self, job: Job) -> None:
        """Send a job; the last job must have been answered."""
        # A daemon, because a pipe that hangs must not delay the end of the node.
        self._thread = threading.Thread(target=self._run, args=(job,), name="solving", daemon=True)
        self._thread.start()

    def answers(self) -> list[Answer]:
        """Return and remove the answers, in order."""
        return [self._answers.get() for _ in range(self._answers.qsize())]

    def stop(self, timeout_s: float) -> None:
        """Wait up to ``timeout_s`` for the current job, then kill the process."""
        self._is_stopping = True
        self._thread.join(timeout_s)
        self._process.kill()
        # The pipe of the thread has ended.
        self._thread.join(GRACE_S)
        self._process.communicate()

    def _start(self) -> None:
        self._process = start(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def _run(self, job: Job) -> None:
        to_process: Any = self._process.stdin
        from_process: Any = self._process.stdout
        result = None
        start_s = time.monotonic()
        killer = threading.Timer(HANGS_AFTER_S, self._process.kill)
        killer.daemon = True
        killer.start()
        with contextlib.suppress(EOFError, OSError, pickle.UnpicklingError):
            pickle.dump(job, to_process, pickle.HIGHEST_PROTOCOL)
            to_process.flush()
            result = pickle.load(from_process)
        killer.cancel()
        if result is None:
            if self._is_stopping:
                return
            has_hung = time.monotonic() - start_s >= HANGS_AFTER_S
            result = Answer(job.session, 0.0, failure=self._restart(has_hung))
        self._answers.put(result)
        if not self._is_stopping:
            self._on_answer()

    def _restart(self, has_hung: bool) -> Failure:
        """Start the process again after its end, and return how it ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(GRACE_S)
        self._process.kill()
        self._process.communicate()
        code = self._process.returncode
        if has_hung:
            cause = f"had no answer after {HANGS_AFTER_S:g} s and was killed"
        elif code < 0:
            cause = f"was ended by {signal.Signals(-code).name}"
        else:
            cause = f"ended with {code}"
        self._start()
        if self._is_stopping:
            self._process.kill()
        return Failure(f"the solving process {cause}", "it was started again")
