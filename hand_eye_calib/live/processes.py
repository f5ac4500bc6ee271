"""The process beside the node's that solves, and how Python code is run in another process.

A thread that solves would share the interpreter with the callbacks: on a slow machine their latency
rises to a second. The thread here only waits for the pipes.
"""

import contextlib
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from hand_eye_calib.live.solving import Answer, Failure, FailureKind, Job

# Not `-m`: its classes would belong to the module __main__, which the node does not have.
_SOLVE = "from hand_eye_calib.live.solving import main; main()"

# A job hangs that has taken this long (s), and so many times the longest before it: solves grow
# with their data, but not by that from one to the next, and a slow computer needs seconds for each.
HANGS_AFTER_S, _HANGS_TIMES = 120.0, 20.0

# A process that has closed its pipes is killed after so long.
_LAST_BREATH_S = 1.0

_NOT_AN_ANSWER = (EOFError, OSError, pickle.UnpicklingError)


def start(code: str, *arguments: str, stdin: Any, stdout: Any) -> "subprocess.Popen[bytes]":
    """Run Python code with the same modules as here, in a group of its own, which Ctrl-C in the
    terminal leaves alone.
    """
    path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdin=stdin,
        stdout=stdout,
        env=os.environ | {"PYTHONPATH": path},
        process_group=0,
    )


class SolvingProcess:
    """Answers jobs in another process, in the order they were submitted.

    The process is started at once and again when it has died, or was killed because it hung; the
    job in hand has failed then. It ends with this one, however this one ends.

    Parameters
    ----------
    on_answer : callable
        Called in another thread when an answer is ready; one call may stand for two.
    command : str
        Python code that the process runs.
    """

    def __init__(self, on_answer: Callable[[], None], command: str = _SOLVE) -> None:
        self._on_answer, self._command = on_answer, command
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._is_stopping = False
        self._hangs_after_s = HANGS_AFTER_S
        self._process = self._started()
        # A daemon: a disk or a pipe that hangs must not keep the node alive.
        self._thread = threading.Thread(target=self._run, name="solving", daemon=True)
        self._thread.start()

    @property
    def pid(self) -> int:
        """Id of the process that solves."""
        return self._process.pid

    def submit(self, job: Job) -> None:
        """Queue a job."""
        self._jobs.put(job)

    def answers(self) -> list[Answer]:
        """The answers that nobody has taken, in order."""
        return [self._answers.get() for _ in range(self._answers.qsize())]

    def stop(self, timeout_s: float) -> None:
        """Wait for the job in hand, then end the process whatever it does."""
        self._is_stopping = True
        self._jobs.put(None)
        self._thread.join(timeout_s)
        self._process.kill()
        self._thread.join(_LAST_BREATH_S)  # its pipe has ended
        _end(self._process)

    def _started(self) -> "subprocess.Popen[bytes]":
        return start(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            began_s = time.monotonic()
            killer = threading.Timer(self._hangs_after_s, self._process.kill)
            killer.daemon = True
            killer.start()
            to, back = self._process.stdin, self._process.stdout
            assert to is not None
            assert back is not None
            try:
                pickle.dump(job, to, pickle.HIGHEST_PROTOCOL)
                to.flush()
                found: Answer = pickle.load(back)
                longest_s = _HANGS_TIMES * (time.monotonic() - began_s)
                self._hangs_after_s = max(self._hangs_after_s, longest_s)
            except _NOT_AN_ANSWER:
                if self._is_stopping:
                    return
                what = self._restart(time.monotonic() - began_s >= self._hangs_after_s)
                failure = Failure(FailureKind.UNEXPECTED, what)
                found = Answer(job.session, 0.0, failure=failure)
            finally:
                killer.cancel()
            self._answers.put(found)
            if not self._is_stopping:
                self._on_answer()

    def _restart(self, hangs: bool) -> str:
        """Start the process again; returns how it ended."""
        code = _end(self._process)
        cause = f"ended with code {code}"
        if hangs:
            cause = f"had no answer after {self._hangs_after_s:.3g} s and was killed"
            self._hangs_after_s *= 2.0  # it may have been a long solve
        elif code < 0:
            cause = f"was ended by {signal.Signals(-code).name}"
        self._process = self._started()
        if self._is_stopping:
            self._process.kill()
        return f"the solving process {cause}; it was started again"


def _end(process: "subprocess.Popen[bytes]") -> int:
    """Exit code of a process that has died, or is made to."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()
    try:
        return process.wait(_LAST_BREATH_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()
