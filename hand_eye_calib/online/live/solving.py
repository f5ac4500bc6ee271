"""Solving process of the node: its jobs, its answers, and both ends of its pipes.

A solve in a thread would share the interpreter with the callbacks of the node. On a slow machine,
their latency would rise to a second. The process imports the engine, but nothing of ROS. Jobs and
answers are pickles. This is safe, because both ends of a pipe are this program, and no other
program can write into the pipe.
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
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

from hand_eye_calib.core.alignment.time_offset import TimeOffset
from hand_eye_calib.core.assessment.excitation import Excitation, excitation
from hand_eye_calib.core.base.errors import (
    HandEyeCalibError,
    NotEnoughDataError,
)
from hand_eye_calib.core.base.option import Options
from hand_eye_calib.core.base.python_path import trusted_environment
from hand_eye_calib.core.checks.check import (
    MIN_DURATION_S,
    CheckResult,
    can_check,
)
from hand_eye_calib.core.checks.findings import Finding, answered
from hand_eye_calib.core.checks.streams import check_positions, check_stream
from hand_eye_calib.core.engine.attempts import (
    check,
    with_open_errors,
    with_options,
)
from hand_eye_calib.core.engine.calibrator import Calibrator
from hand_eye_calib.core.engine.run import review
from hand_eye_calib.core.engine.snapshot import STREAMS, Snapshot
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.online.live.state import GRACE_S
from hand_eye_calib.online.live.stream_checks import merged

# Code that the process runs. With `python -m`, the classes of its answers would belong to the
# module __main__, and the node could not unpickle them.
_SOLVE = "from hand_eye_calib.online.live.solving import main; main()"

# Time (s) after which a job counts as hung: live sessions are solved in seconds.
HANGS_AFTER_S = 600.0

# Duration (ns) of the newest part of the session, to which advice about the motion refers.
_NEWEST_NS = 60_000_000_000

# Nice value of a job that is not urgent, relative to the node: the callbacks of the node are more
# important. At 2 x 400 Hz, the latency p99 of the callbacks was 5 ms; with equal priority it was 14
# ms.
_NICENESS = 3

# Fewest unpaired poses with which a stream is checked.
_MIN_UNPAIRED = 200

NO_MOTION = excitation(PosePairs.empty())


@dataclass(frozen=True)
class Failure:
    """Error of a job.

    Attributes
    ----------
    what : str
        The error in one line.
    details : str
        Further text for the log, such as a traceback; empty unless the error is a defect of the
        program.
    is_early : bool
        Whether there is too little data.
    """

    what: str
    details: str = ""
    is_early: bool = False


@dataclass(frozen=True)
class Job:
    """Poses of a job.

    The job contains the buffers of the engine. The process converts them to trajectories, because
    this would delay the callbacks of the node.

    Attributes
    ----------
    session : int
        Number of the session.
    calibrator : Calibrator
        Copy of the engine.
    check : bool
        Whether to check the streams after the solve.
    options : Options
        Options that an earlier check has set.
    has_hurry : bool
        Whether the job has the priority of the node. With the lower priority, a solve takes twice
        as long if other programs keep the processor busy.
    """

    session: int
    calibrator: Calibrator
    check: bool = False
    options: Options = field(default_factory=dict)
    has_hurry: bool = False


@dataclass(frozen=True)
class Answer:
    """Result of a job: a calibration, a failure, or both if only the check has failed.

    Attributes
    ----------
    session : int
        Number of the session.
    seconds : float
        Duration of the job (s).
    motion : Excitation
        Motion of the sensors.
    calibration : Calibration or None
        Result with the options that the check has set.
    time_offset : TimeOffset or None
        Estimate of the clock offset between the streams.
    failure : Failure or None
    is_checked : bool
        Whether the job requested a check.
    check : CheckResult or None
        Result of the check; None if the motion is too short or has too little rotation.
    options : Options
        Options that the check has set.
    messages : tuple of str
        Sentences about the options that the check has set.
    newest_motion : Excitation or None
        Motion of the last minute.
    processor_s : float
        Processor time of the job (s). It is much shorter than the duration if other programs keep
        the processor busy.
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
    processor_s: float = 0.0


def answer(job: Job) -> Answer:
    """Solve, then check the streams if the job requests a check.

    If the check sets options, the calibration is computed with these options. Every error becomes a
    failure in the answer; what was computed before the error is kept.
    """
    start_s = time.monotonic()
    start_processor_s = time.process_time()
    result = Answer(job.session, 0.0, is_checked=job.check)
    try:
        received = job.calibrator.snapshot()
        configured = with_options(received, job.options)
        snapshot = configured.resolved
        result = replace(result, time_offset=snapshot.time_offset)
        pairs = snapshot.pose_pairs
        result = replace(
            result,
            motion=excitation(pairs),
            newest_motion=excitation(newest_pairs(pairs)),
        )
        result = replace(result, calibration=snapshot.estimate())
    except Exception as error:
        result = replace(result, failure=_failure(error))
    try:
        if job.check and can_check(*received.streams):
            result = _checked(result, configured, job.options)
    except Exception as error:
        result = replace(result, failure=result.failure or _failure(error))
    if result.check is not None:
        result = replace(
            result, check=with_findings_before_pairing(result.check, received)
        )
    return replace(
        result,
        seconds=time.monotonic() - start_s,
        processor_s=time.process_time() - start_processor_s,
    )


def newest_pairs(pairs: PosePairs) -> PosePairs:
    """Return the pairs of the last minute."""
    if not len(pairs):
        return pairs
    return pairs[pairs.stamps_ns > pairs.stamps_ns[-1] - _NEWEST_NS]


def _checked(result: Answer, snapshot: Snapshot, options: Options) -> Answer:
    """Return the answer with a stream check, and with the calibration that the check chooses."""
    if result.calibration is None:
        return replace(result, check=check(snapshot))
    run = review(result.calibration, snapshot, options)
    if not run.options:
        calibration = with_open_errors(result.calibration, run.check, snapshot)
        return replace(
            result,
            check=run.check,
            calibration=calibration,
        )
    return replace(
        result,
        check=run.check,
        options=dict(run.options),
        messages=tuple(message.lasting for message in run.messages),
        calibration=run.for_session(),
    )


def with_findings_before_pairing(
    result: CheckResult, snapshot: Snapshot
) -> CheckResult:
    """Add errors in the received poses to a check of pairs.

    Pairing interpolates one stream. This hides the poses of two alternating sources. Therefore the
    unpaired poses are also checked. Only errors are added: none of 232 windows of sound recordings
    has an error, but 1 of 15 windows has enough jumps for a warning.
    """
    if not len(snapshot.kept):
        return result
    config = snapshot.config
    errors: list[Finding] = []
    for stream, trajectory in zip(STREAMS, snapshot.unpaired, strict=True):
        if (
            len(trajectory) < _MIN_UNPAIRED
            or trajectory.duration_s < MIN_DURATION_S / 2
        ):
            continue
        if config.measured == "poses":
            findings = check_stream(trajectory, stream, config.max_gap)
        else:
            # If the streams have no positions, the scale 0 removes positions from the check.
            scale = 1.0 if config.measured == "positions" else 0.0
            findings = check_positions(
                trajectory.scaled(scale), stream, config.max_gap
            )
        errors += [
            finding
            for finding in answered(findings, config)
            if finding.makes_unusable
        ]
    return replace(result, findings=merged(result.findings, errors))


def _failure(error: Exception) -> Failure:
    """Return an error as a failure. A defect of the program includes its traceback."""
    if isinstance(error, HandEyeCalibError):
        return Failure(
            str(error), is_early=isinstance(error, NotEnoughDataError)
        )
    details = "".join(traceback.format_exception(error))
    return Failure(f"{type(error).__name__}: {error}", details)


# ------------------------------------------------------------- in the process


def main() -> None:
    """Answer jobs until standard input ends.

    Standard input ends with the node, even if the node crashes.
    """
    # Standard output is the pipe. Text that a library prints goes to standard error.
    outgoing = os.fdopen(os.dup(1), "wb")
    os.dup2(sys.stderr.fileno(), 1)
    jobs: queue.SimpleQueue[Job] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(jobs,), daemon=True).start()
    # On Linux, each thread has its own priority, which can only be lowered. Therefore jobs that are
    # not urgent have their own thread.
    at_low_priority = ThreadPoolExecutor(
        1, initializer=os.nice, initargs=(_NICENESS,)
    )
    while True:
        job = jobs.get()
        result = (
            answer(job)
            if job.has_hurry
            else at_low_priority.submit(answer, job).result()
        )
        pickle.dump(result, outgoing, pickle.HIGHEST_PROTOCOL)
        outgoing.flush()
        # The arrays of a job are in reference cycles. Without this collection, the memory of the
        # process grew by a half in 60 solves.
        gc.collect()


def _receive(jobs: "queue.SimpleQueue[Job]") -> None:
    """Read jobs in a thread, so that a long solve also ends with the node."""
    try:
        while True:
            jobs.put(pickle.load(sys.stdin.buffer))
    finally:
        os._exit(0)


# ----------------------------------------------------------------- in the node


def start(
    code: str, *arguments: str, stdin: Any, stdout: Any
) -> "subprocess.Popen[bytes]":
    """Start Python code in a process with the modules of this process.

    The new process has its own group, so that Ctrl-C in the terminal does not reach it.
    """
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdin=stdin,
        stdout=stdout,
        env=trusted_environment(),
        process_group=0,
    )


class SolvingProcess:
    """Process that answers one job at a time.

    The process starts at once. If it dies, or hangs and is killed, its job fails and a new process
    starts. It ends with the node in any case. The threads of this class only wait for the pipes.

    Parameters
    ----------
    on_answer : callable
        Function that is called in another thread when an answer is ready; :meth:`answers` returns
        it.
    command : str
        Python code of the process.
    """

    def __init__(
        self, on_answer: Callable[[], None], command: str = _SOLVE
    ) -> None:
        self._on_answer = on_answer
        self._command = command
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._is_stopping = False
        self._start()
        # This thread does nothing. stop() joins the thread of the last job, if there was one.
        self._thread = threading.Thread()
        self._thread.start()

    def submit(self, job: Job) -> None:
        """Send a job. The answer to the previous job must have arrived."""
        # A daemon thread: a pipe that hangs must not delay the end of the node.
        self._thread = threading.Thread(
            target=self._run, args=(job,), name="solving", daemon=True
        )
        self._thread.start()

    def answers(self) -> list[Answer]:
        """Return the answers in order, and remove them."""
        return [self._answers.get() for _ in range(self._answers.qsize())]

    def stop(self, timeout_s: float) -> None:
        """Wait up to ``timeout_s`` for the current job, then kill the process."""
        self._is_stopping = True
        self._thread.join(timeout_s)
        self._process.kill()
        # The thread ends, because its pipe has ended.
        self._thread.join(GRACE_S)
        self._process.communicate()

    def _start(self) -> None:
        self._process = start(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )

    def _run(self, job: Job) -> None:
        """Send a job, and store the answer. Kill the process if it hangs."""
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
        """Start the process again after its end. Return a failure that states how it ended."""
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
