"""Solves in a process of its own, so that no solve ever holds up a message.

A thread of the node would share the interpreter with the callbacks: on a slow machine their latency
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
from collections.abc import Callable, Iterator

from hand_eye_calib.ros.solving import Answer, Checked, Failure, FailureKind, Job, Solved

# Not `-m`: its classes would belong to the module __main__, which the node does not have.
_COMMAND = "from hand_eye_calib.ros.solving import main; main()"

# A job is sent so many times before it is given up.
_ATTEMPTS = 2

# A job hangs that has taken this long (s), and so many times the longest before it: solves grow
# with their data, but not by that from one to the next, and a slow computer needs seconds for each.
HANGS_AFTER_S, _HANGS_TIMES = 120.0, 20.0

# A process that has closed its pipes is killed after so long.
_LAST_BREATH_S = 1.0

_NOT_AN_ANSWER = (EOFError, OSError, pickle.UnpicklingError)


class SolvingProcess:
    """Answers jobs in another process, in the order they were submitted.

    The process is started at once and again when it has died; the job in hand is sent again then.
    One that hangs is killed and started again; the job in hand has failed then. It ends with this
    one, however this one ends.

    Parameters
    ----------
    on_answer : callable
        Called in another thread when an answer or a note is ready; one call may stand for two.
    command : str
        Python code that the process runs.
    """

    def __init__(self, on_answer: Callable[[], None], command: str = _COMMAND) -> None:
        self._on_answer = on_answer
        self._command = command
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._notes: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._stopping = threading.Event()
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

    def answers(self) -> Iterator[Answer]:
        """Each answer that nobody has taken, in order."""
        while not self._answers.empty():
            yield self._answers.get()

    def notes(self) -> Iterator[str]:
        """Lines for the log: the process died and was started again."""
        while not self._notes.empty():
            yield self._notes.get()

    def stop(self, timeout_s: float) -> bool:
        """Wait for the job in hand, then end the process whatever it does.

        Returns
        -------
        bool
            True if the job in hand was answered in time.
        """
        self._stopping.set()
        self._jobs.put(None)
        self._thread.join(timeout_s)
        in_time = not self._thread.is_alive()
        self._process.kill()
        self._thread.join(_LAST_BREATH_S)  # its pipe has ended
        _end(self._process)
        return in_time

    def _started(self) -> "subprocess.Popen[bytes]":
        # The same modules as here; a group of its own, which Ctrl-C in the terminal leaves alone.
        path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
        return subprocess.Popen(
            [sys.executable, "-c", self._command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": path},
            process_group=0,
        )

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            for answer in self._answers_to(job):
                self._answers.put(answer)
                if not self._stopping.is_set():
                    self._on_answer()

    def _answers_to(self, job: Job) -> Iterator[Answer]:
        """Yield the job's answers; failures in their place if the process dies again and again."""
        answered = 0
        for _ in range(_ATTEMPTS):
            watch = _Watch(self._process, self._hangs_after_s)
            try:
                for index, answer in enumerate(self._exchange(job)):
                    if index >= answered:
                        yield answer
                        answered += 1
                self._hangs_after_s = max(self._hangs_after_s, _HANGS_TIMES * watch.seconds)
                return
            except _NOT_AN_ANSWER:
                if self._stopping.is_set():
                    return
                cause = self._restart(watch)
            finally:
                watch.cancel()
            if watch.has_killed:
                self._hangs_after_s *= 2.0  # it may have been a long solve
                break
        failure = Failure(FailureKind.UNEXPECTED, f"the solving process {cause}")
        kinds = [Solved, Checked][: 1 + job.check]
        for kind in kinds[answered:]:
            yield kind(job.session, 0.0, failure=failure)

    def _exchange(self, job: Job) -> Iterator[Answer]:
        to, back = self._process.stdin, self._process.stdout
        assert to is not None
        assert back is not None
        pickle.dump(job, to, pickle.HIGHEST_PROTOCOL)
        to.flush()
        for _ in range(1 + job.check):
            yield pickle.load(back)

    def _restart(self, watch: "_Watch") -> str:
        """Start the process again; returns how it ended."""
        code = _end(self._process)
        self._process = self._started()
        if self._stopping.is_set():
            self._process.kill()
        if watch.has_killed:
            cause = f"had no answer after {self._hangs_after_s:.3g} s and was killed"
        elif code < 0:
            cause = f"was ended by {signal.Signals(-code).name}"
        else:
            cause = f"ended with code {code}"
        self._notes.put(f"the solving process {cause}; it was started again")
        self._on_answer()
        return cause


class _Watch:
    """Kills a process that is not done after some seconds, unless it is cancelled."""

    def __init__(self, process: "subprocess.Popen[bytes]", after_s: float) -> None:
        self.has_killed = False
        self._process, self._began_s = process, time.monotonic()
        self._timer = threading.Timer(after_s, self._kill)
        self._timer.daemon = True
        self._timer.start()

    @property
    def seconds(self) -> float:
        """Time so far."""
        return time.monotonic() - self._began_s

    def cancel(self) -> None:
        self._timer.cancel()

    def _kill(self) -> None:
        self.has_killed = True
        self._process.kill()


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
