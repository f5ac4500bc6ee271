"""One thread that solves and checks, so that neither ever holds up receiving."""

import multiprocessing
import os
import queue
import signal
import threading
import time
import traceback
from dataclasses import dataclass

from hand_eye_calib.assessment.excitation import Excitation, excitation
from hand_eye_calib.calibration import Calibration
from hand_eye_calib.checks.check import CheckResult, can_check
from hand_eye_calib.engine.calibrator import Snapshot

# Whoever else needs the processor goes before the solver's process.
_NICENESS = 10


@dataclass(frozen=True)
class Outcome:
    """How a solve of a snapshot ended, after how many seconds: with a calibration or with an
    exception.
    """

    session: int
    snapshot: Snapshot
    seconds: float
    seen: Excitation | None = None
    calibration: Calibration | None = None
    error: Exception | None = None


@dataclass(frozen=True)
class Checked:
    """How a check of a snapshot's streams ended, after how many seconds: with neither where its
    poses turn too little to tell.
    """

    session: int
    seconds: float
    agreement: CheckResult | None = None
    error: Exception | None = None


class SolveWorker:
    """Runs ``snapshot.estimate()`` in a thread of its own, and ``snapshot.check()`` after it where
    that is asked for.

    Parameters
    ----------
    on_done : callable
        Called in the worker's thread when an Outcome or Checked is ready; calls may come so close
        that one serves for two.
    """

    def __init__(self, on_done):
        self._on_done = on_done
        self._snapshots = queue.SimpleQueue()
        self._outcomes = queue.SimpleQueue()
        self._stopping = threading.Event()
        self._apart = SolverProcess()
        # A daemon: a solver that is deep in native code must not keep the process alive.
        self._thread = threading.Thread(target=self._run, name="solve", daemon=True)
        self._thread.start()

    def submit(self, session, snapshot, check=False):
        """Solve a snapshot of the engine, then check its streams if asked to; ``session`` comes
        back with what is ready.
        """
        self._snapshots.put((session, snapshot, check))

    def ready(self):
        """Each Outcome and Checked that nobody has taken, in the order they came about."""
        while not self._outcomes.empty():
            yield self._outcomes.get()

    def stop(self, timeout_s):
        """Ask the thread to end and wait for it; True when it has ended."""
        self._stopping.set()
        self._snapshots.put(None)
        self._apart.stop()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self):
        while (job := self._snapshots.get()) is not None:
            session, snapshot, check = job
            outcome = _solve(session, snapshot, self._apart)
            if self._stopping.is_set() and outcome.error is not None:
                return  # nobody waits for it, and its process may have been ended
            self._tell(outcome)
            if check and not self._stopping.is_set():
                self._tell(_check(outcome))

    def _tell(self, outcome):
        self._outcomes.put(outcome)
        if not self._stopping.is_set():
            self._on_done()


class SolverProcess:
    """Estimates in a process of its own, started when it is first needed.

    CasADi keeps the interpreter's lock for a tenth of a second while it builds a problem, and all
    messages would wait.
    """

    def __init__(self):
        self._process = None

    def estimate(self, snapshot):
        """``snapshot.estimate()``, there.

        Raises
        ------
        Exception
            What it raised there; RuntimeError where the process has died.
        """
        if self._process is None or not self._process.is_alive():
            self._start()
        try:
            self._connection.send(snapshot)
            answer = self._connection.recv()
        except (EOFError, OSError):
            self._process.join(1.0)
            raise RuntimeError(
                f"the solver's process ended with code {self._process.exitcode}"
            ) from None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def stop(self):
        """End the process, whatever it does."""
        if self._process is not None:
            self._process.kill()
            self._process.join()

    def _start(self):
        spawn = multiprocessing.get_context(
            "spawn"
        )  # a fork would copy the middleware's threads' locks
        self._connection, theirs = spawn.Pipe()
        self._process = spawn.Process(target=_serve, args=(theirs,), name="solver", daemon=True)
        self._process.start()
        theirs.close()


def _serve(connection):
    # Ctrl-C goes to all processes of a terminal; this one ends when the node's does.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(_NICENESS)
    while True:
        try:
            snapshot = connection.recv()
        except EOFError:
            return
        try:
            answer = snapshot.estimate()
        except Exception as error:  # raised again in the node
            error.add_note("".join(traceback.format_exception(error)))
            answer = error
        try:
            connection.send(answer)
        except OSError:
            return


def _solve(session, snapshot, apart):
    start, seen, calibration, failure = time.monotonic(), None, None, None
    try:
        seen = excitation(snapshot.pose_pairs())
        calibration = apart.estimate(snapshot) if _needs_process(snapshot) else snapshot.estimate()
    except Exception as error:  # handed to the executor's thread, which reports it
        failure = error
    return Outcome(session, snapshot, time.monotonic() - start, seen, calibration, failure)


def _check(outcome):
    """Check the streams of a solve, with the time offset and the scale it found."""
    start, snapshot, agreement, failure = time.monotonic(), outcome.snapshot, None, None
    try:
        if can_check(*snapshot.streams):
            agreement = snapshot.check(outcome.calibration)
    except Exception as error:  # as with a solve
        failure = error
    return Checked(outcome.session, time.monotonic() - start, agreement, failure)


def _needs_process(snapshot):
    return snapshot.config.backend == "ipopt"
