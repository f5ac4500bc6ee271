"""One thread that solves, so that solving never holds up receiving."""

import queue
import threading
import time
from dataclasses import dataclass

from hand_eye_calib.assessment.excitation import Excitation, excitation
from hand_eye_calib.calibration import Calibration
from hand_eye_calib.calibrator import Snapshot


@dataclass(frozen=True)
class Outcome:
    """How a solve of a snapshot ended, after how many seconds: with a calibration or with an exception."""

    session: int
    snapshot: Snapshot
    seconds: float
    seen: Excitation | None = None
    calibration: Calibration | None = None
    error: Exception | None = None


class SolveWorker:
    """Runs ``snapshot.estimate()`` in a thread of its own.

    Parameters
    ----------
    on_done : callable
        Called in the worker's thread when an outcome can be taken.
    """

    def __init__(self, on_done):
        self._on_done = on_done
        self._snapshots = queue.SimpleQueue()
        self._outcomes = queue.SimpleQueue()
        self._stopping = threading.Event()
        # A daemon: a solver that is deep in native code must not keep the process alive.
        self._thread = threading.Thread(target=self._run, name="solve", daemon=True)
        self._thread.start()

    def submit(self, session, snapshot):
        """Solve a snapshot of the engine; ``session`` comes back with the outcome."""
        self._snapshots.put((session, snapshot))

    def take(self):
        """The next outcome, after ``on_done`` has announced it."""
        return self._outcomes.get()

    def rest(self):
        """Outcomes that nobody has taken."""
        while not self._outcomes.empty():
            yield self._outcomes.get()

    def stop(self, timeout_s):
        """Ask the thread to end and wait for it; True when it has ended."""
        self._stopping.set()
        self._snapshots.put(None)
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self):
        while (job := self._snapshots.get()) is not None:
            self._outcomes.put(_solve(*job))
            if not self._stopping.is_set():
                self._on_done()


def _solve(session, snapshot):
    start, seen, calibration, failure = time.monotonic(), None, None, None
    try:
        seen = excitation(snapshot.pose_pairs())
        calibration = snapshot.estimate()
    except Exception as error:  # handed to the executor's thread, which reports it
        failure = error
    return Outcome(session, snapshot, time.monotonic() - start, seen, calibration, failure)
