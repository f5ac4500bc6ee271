"""The journal of the node's session, written by a thread of its own: a slow or full disk never
holds up a message.
"""

import fcntl
import os
import queue
import threading
import time
from pathlib import Path

from hand_eye_calib.errors import ConfigError
from hand_eye_calib.io.journal import (
    JournalWriter,
    count_poses,
    has_session,
    keep_aside,
    read_journal,
)

# How often what came in is handed to the disk: what a crash can cost.
FLUSH_PERIOD_S = 0.25

# After a failed write the journal is started anew this often.
_RETRY_S = 5.0

# Holds the process id of the node that writes into a directory.
_LOCK_NAME = ".calibrator.lock"

# Batches that may wait for a disk that does not answer: a minute.
_MOST_WAITING = 240


def resume(directory, calibrator):
    """Bring a calibrator to where the session in a directory ended; returns how many poses it has.

    Raises
    ------
    InputError
        Where there is no session, or it is damaged.
    """
    checkpoint, events, _ = read_journal(directory)
    calibrator.restore(checkpoint)
    for kind, *event in events:
        calibrator.add_pose(*event) if kind == "pose" else calibrator.set_frame(*event)
    return sum(calibrator.statistics(stream).received for stream in ("parent", "child"))


class DirectoryLock:
    """Keeps a directory for this process until :meth:`release`, or its end, however that comes.

    Parameters
    ----------
    directory : path
        Made if it does not exist. Where it cannot be written, nothing is locked: the journal will
        say so.

    Raises
    ------
    ConfigError
        Where another node has it.
    """

    def __init__(self, directory):
        self.directory = Path(directory)
        self._descriptor = None
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            self._descriptor = os.open(self.directory / _LOCK_NAME, os.O_RDWR | os.O_CREAT, 0o644)
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.ftruncate(self._descriptor, 0)
            os.pwrite(self._descriptor, str(os.getpid()).encode(), 0)
        except BlockingIOError:
            owner = os.pread(self._descriptor, 32, 0).decode(errors="replace")
            self.release()
            raise ConfigError(
                f"output_directory {self.directory} is in use by another calibrator (process {owner or 'unknown'}): stop that one, or "
                "choose another directory"
            ) from None
        except OSError:
            return  # a disk that takes no lock, or nothing at all

    def release(self):
        """Leave the directory to others."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


class SessionJournal:
    """Takes note of a session in the executor's thread, writes in its own.

    Parameters
    ----------
    directory : path
    state : dict of str to arrays
        The engine's state to start from.
    resumed : bool
        The state is that of the session in the directory, which need not be kept aside then.
    """

    def __init__(self, directory, state, resumed=False):
        self.directory = Path(directory)
        self.error = ""
        self._notes = queue.SimpleQueue()
        self._events = []
        self._jobs = queue.Queue()
        self._is_full = False
        self._failed_at = None
        self._broken = False  # in the thread: the segment must not be written to any more
        self._is_ours = resumed
        self._writer = None
        self._jobs.put((self._open, state))
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def add_pose(self, stream, stamp_ns, position, quat_xyzw):
        """Note a pose that the engine has taken."""
        self._events.append((stream, stamp_ns, position, quat_xyzw))

    def set_frame(self, stream, sensor_frame):
        """Note the name of a stream's sensor frame."""
        self._events.append((stream, sensor_frame))

    def flush(self, make_state):
        """Hand what was noted to the thread; to be called often. ``make_state()`` gives the
        engine's state where one is needed.
        """
        events, self._events = self._events, []
        if self._failed_at is not None:
            if time.monotonic() - self._failed_at >= _RETRY_S:
                self._failed_at = None
                self._jobs.put((self._open, make_state()))
        elif self._jobs.qsize() > _MOST_WAITING:
            self._failed_at = time.monotonic()
            self._fail("the disk does not answer")
        elif self._is_full:
            self._is_full = False
            self._jobs.put((self._write, events))
            self._jobs.put((self._rotate, make_state()))
        elif events:
            self._jobs.put((self._write, events))

    def begin(self, state):
        """Start a new session; the one so far is kept aside."""
        self._jobs.put((self._write, self._events))
        self._events = []
        self._jobs.put((self._begin, state))

    def notes(self):
        """Lines for the log since the last call, each with whether it is a warning."""
        while not self._notes.empty():
            yield self._notes.get()

    def stop(self, make_state, timeout_s):
        """Write what is left and end the thread; False where the disk keeps it busy."""
        self.flush(make_state)
        self._jobs.put(None)
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    # ------------------------------------------------------------ in the thread

    def _run(self):
        while (job := self._jobs.get()) is not None:
            work, argument = job
            try:
                work(argument)
            except OSError as error:
                self._broken = True
                self._failed_at = time.monotonic()
                self._fail(error.strerror or str(error))
        if self._writer is not None and not self._broken:
            try:
                self._writer.close()
            except OSError as error:
                self._fail(error.strerror or str(error))

    def _fail(self, reason):
        self.error = reason
        self._notes.put(
            (
                True,
                f"cannot write the session journal in {self.directory}: {reason}; going on without it: a crash would lose this session",
            )
        )

    def _open(self, state):
        if not self._is_ours:
            self._keep_aside()
        self._is_ours = True
        self._writer = JournalWriter(self.directory, state)
        self._broken = False
        if self.error:
            self.error = ""
            self._notes.put(
                (False, f"the session journal in {self.directory} is being written again")
            )

    def _begin(self, state):
        if self._writer is not None and not self._broken:
            self._writer.close()
        self._writer, self._is_ours = None, False
        self._open(state)

    def _keep_aside(self):
        """Keep a session of before, unless there is nothing in it."""
        if not has_session(self.directory):
            return
        poses = count_poses(self.directory)
        if poses == 0:
            return
        aside = keep_aside(self.directory)
        size = (
            "a damaged session" if poses is None else f"the session before this one ({poses} poses)"
        )
        how = f"stop the node, rename that folder to {self.directory.name} and start with the parameter journal at resume"
        self._notes.put((False, f"{size} is kept in {aside}; to go on with it, {how}"))

    def _write(self, events):
        if self._broken:
            return
        for event in events:
            self._writer.add_pose(*event) if len(event) == 4 else self._writer.set_frame(*event)
        self._writer.flush()
        self._is_full = self._writer.is_full

    def _rotate(self, state):
        if not self._broken:
            self._writer.rotate(state)
