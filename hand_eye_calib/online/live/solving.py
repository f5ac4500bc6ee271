"""The process beside the node's that solves: what it is sent, what it answers, and both ends.

A thread that solves would share the interpreter with the callbacks: on a slow machine their latency
rises to a second. The process imports the engine and nothing of ROS. Messages are pickles: both
ends are the same program, and nobody else has the pipes.
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
from hand_eye_calib.core.checks.findings import answered, gravest_first
from hand_eye_calib.core.checks.streams import check_positions, check_stream
from hand_eye_calib.core.engine.attempts import with_options
from hand_eye_calib.core.engine.calibrator import Calibrator
from hand_eye_calib.core.engine.run import check, review
from hand_eye_calib.core.engine.snapshot import STREAMS, Snapshot
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.online.live.state import GRACE_S

# Not `-m`: its classes would belong to the module __main__, which the node does not have.
_SOLVE = "from hand_eye_calib.online.live.solving import main; main()"

# Other programs have twice the share of a processor. With more, a solve takes minutes beside busy
# ones; the latency of the node's callbacks is the same with any.
_NICENESS = 3

# A job that has taken this long (s) hangs: live sessions are solved in seconds.
HANGS_AFTER_S = 600.0

# Fewest poses of a stream, not paired yet, that are checked as they came in.
_FEWEST_RAW = 200

NO_MOTION = excitation(PosePairs.empty())


@dataclass(frozen=True)
class Failure:
    """An error as one line. ``details`` are for the log, and only of a defect; ``is_early`` if
    there is too little data.
    """

    what: str
    details: str = ""
    is_early: bool = False


@dataclass(frozen=True)
class Job:
    """Poses to solve, and perhaps their streams to check, in a session of this number, with options
    that an earlier check was certain of. They come as the calibrator had them: making trajectories
    of them would hold up the node's callbacks.
    """

    session: int
    calibrator: Calibrator
    check: bool = False
    options: Options = field(default_factory=dict)


@dataclass(frozen=True)
class Answer:
    """How a job ended, after how many seconds: with a calibration, and how the sensors have been
    seen to move, or with a failure; with both if only the check has failed.

    ``is_checked`` if a check was asked for: its result is None if the motion is too short or has
    too little rotation to tell. The result is one with the options that it is certain of, and
    ``messages`` say so.
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


def answer(job: Job) -> Answer:
    """Solve, then check if the job asks for it. If the check is certain of other options, the
    calibration is the one with these.
    """
    start_s = time.monotonic()
    done = Answer(job.session, 0.0, is_checked=job.check)
    try:
        as_came = job.calibrator.snapshot()
        as_sent = with_options(as_came, job.options)
        snapshot = as_sent.resolved
        done = replace(done, time_offset=snapshot.time_offset)
        done = replace(done, motion=excitation(snapshot.pose_pairs))
        done = replace(done, calibration=snapshot.estimate())
    except Exception as error:  # the node reports it
        done = replace(done, failure=_failure(error))
    try:
        if job.check and can_check(*as_came.streams):
            if done.calibration is None:
                done = replace(done, check=check(as_sent))
            else:
                run = review(done.calibration, as_sent, job.options)
                done = replace(
                    done, check=run.check, options=dict(run.options), messages=run.messages
                )
                if run.options:
                    done = replace(done, calibration=run.calibration)
    except Exception as error:  # the node reports it
        done = replace(done, failure=done.failure or _failure(error))
    if done.check is not None:
        done = replace(done, check=with_raw_findings(done.check, as_came))
    return replace(done, seconds=time.monotonic() - start_s)


def with_raw_findings(result: CheckResult, snapshot: Snapshot) -> CheckResult:
    """Add the errors of the newest poses as they came in, if the older ones are paired.

    A check of a session sees the pairs, of which one stream is interpolated: poses of two sources
    that alternate do not show there. Of 232 windows of right recordings, none has such an error;
    one in 15 has jumps enough for a warning, which is left to the check of the pairs.
    """
    if not len(snapshot.kept):
        return result
    config = snapshot.config
    findings = [*result.findings]
    for stream, trajectory in zip(STREAMS, snapshot.unpaired, strict=True):
        if len(trajectory) < _FEWEST_RAW or trajectory.duration_s < MIN_DURATION_S / 2:
            continue
        if config.measured == "poses":
            of_stream = check_stream(trajectory, stream, config.max_gap)
        else:
            # Without positions of both, those of the other are no measurements.
            scale = 1.0 if config.measured == "positions" else 0.0
            of_stream = check_positions(trajectory.scaled(scale), stream, config.max_gap)
        seen = {(finding.code, finding.stream) for finding in findings}
        for finding in answered(of_stream, config):
            if finding.makes_unusable and (finding.code, finding.stream) not in seen:
                findings.append(finding)
    return replace(result, findings=gravest_first(findings))


def _failure(error: Exception) -> Failure:
    if isinstance(error, HandEyeCalibError):
        return Failure(str(error), is_early=isinstance(error, NotEnoughDataError))
    details = "".join(traceback.format_exception(error))
    return Failure(f"{type(error).__name__}: {error}", details)


# ------------------------------------------------------------- in the process


def main() -> None:
    """Answer jobs until the standard input ends, which it does with the node, however that ends."""
    os.nice(_NICENESS)
    # What a library prints goes to standard error instead of the pipe.
    outgoing = os.fdopen(os.dup(1), "wb")
    os.dup2(sys.stderr.fileno(), 1)
    jobs: queue.SimpleQueue[Job] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(jobs,), daemon=True).start()
    while True:
        pickle.dump(answer(jobs.get()), outgoing, pickle.HIGHEST_PROTOCOL)
        outgoing.flush()
        # The arrays of a job are in cycles: memory grew by half of itself in 60 solves.
        gc.collect()


def _receive(jobs: "queue.SimpleQueue[Job]") -> None:
    """Read jobs in a thread: the end of the node must be noticed during a long solve too."""
    try:
        while True:
            jobs.put(pickle.load(sys.stdin.buffer))
    finally:
        os._exit(0)


# ----------------------------------------------------------------- in the node


def start(code: str, *arguments: str, stdin: Any, stdout: Any) -> "subprocess.Popen[bytes]":
    """Run Python code with the same modules as here, in a group of its own, which Ctrl-C in the
    terminal leaves alone.
    """
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdin=stdin,
        stdout=stdout,
        env=trusted_environment(),
        process_group=0,
    )


class SolvingProcess:
    """Answers one job at a time in another process.

    The process is started at once and again when it has died, or was killed because it hung; the
    job in hand has failed then. It ends with this one, however this one ends. The threads here only
    wait for the pipes.

    Parameters
    ----------
    on_answer : callable
        Called in another thread when an answer is ready; one call may stand for two.
    command : str
        Python code that the process runs.
    """

    def __init__(self, on_answer: Callable[[], None], command: str = _SOLVE) -> None:
        self._on_answer = on_answer
        self._command = command
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._is_stopping = False
        self._start()
        self._thread = threading.Thread()
        self._thread.start()  # so that it can be waited for

    def submit(self, job: Job) -> None:
        """Send a job, once the one before is answered."""
        # A daemon: a pipe that hangs must not keep the node alive.
        self._thread = threading.Thread(target=self._run, args=(job,), name="solving", daemon=True)
        self._thread.start()

    def answers(self) -> list[Answer]:
        """The answers that nobody has taken, in order."""
        return [self._answers.get() for _ in range(self._answers.qsize())]

    def stop(self, timeout_s: float) -> None:
        """Wait for the job in hand, then end the process whatever it does."""
        self._is_stopping = True
        self._thread.join(timeout_s)
        self._process.kill()
        self._thread.join(GRACE_S)  # its pipe has ended
        self._process.communicate()

    def _start(self) -> None:
        self._process = start(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def _run(self, job: Job) -> None:
        to: Any = self._process.stdin
        back: Any = self._process.stdout
        found = None
        began_s = time.monotonic()
        killer = threading.Timer(HANGS_AFTER_S, self._process.kill)
        killer.daemon = True
        killer.start()
        with contextlib.suppress(EOFError, OSError, pickle.UnpicklingError):
            pickle.dump(job, to, pickle.HIGHEST_PROTOCOL)
            to.flush()
            found = pickle.load(back)
        killer.cancel()
        if found is None and self._is_stopping:
            return
        hangs = time.monotonic() - began_s >= HANGS_AFTER_S
        self._answers.put(found or Answer(job.session, 0.0, failure=self._restart(hangs)))
        if not self._is_stopping:
            self._on_answer()

    def _restart(self, hangs: bool) -> Failure:
        """Start the process again, which has died or was killed; returns how it ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(GRACE_S)
        self._process.kill()
        self._process.communicate()
        code = self._process.returncode
        cause = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
        if hangs:
            cause = f"had no answer after {HANGS_AFTER_S:g} s and was killed"
        self._start()
        if self._is_stopping:
            self._process.kill()
        return Failure(f"the solving process {cause}", "it was started again")
