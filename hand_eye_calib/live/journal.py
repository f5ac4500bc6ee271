"""The journal of the live session, written by a thread of its own: a slow or full disk never holds
up a message.
"""

import contextlib
import fcntl
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.files import write_atomically
from hand_eye_calib.io.journal import (
    About,
    Journal,
    JournalWriter,
    count_poses,
    has_session,
    keep_aside,
)

# How often what came in is handed to the disk: what a crash can cost.
FLUSH_PERIOD_S = 0.25

# After a failed write the journal is started anew this often.
_RETRY_S = 5.0

# Says which process writes into a directory; the lock is on the directory itself.
_LOCK_NAME = ".calibrator.lock"

# Batches that may wait for a disk that does not answer: a minute.
_MOST_WAITING = 240

# The engines by the child sensor of each; all of them have the same parent.
Engines = Mapping[str, Calibrator]
# The poses so far by stream.
Poses = dict[str, Trajectory]
# Stream, stamp (ns), position and quaternion of a pose.
_Event = tuple[str, int, Sequence[float], Sequence[float]]


def takers(stream: str, engines: Engines) -> list[tuple[str, Calibrator]]:
    """Who takes a message of a stream, and as which: the parent's counts for all child sensors."""
    if stream == "parent":
        return [(stream, each) for each in engines.values()]
    return [("child", engines[stream])] if stream in engines else []


def poses_so_far(engines: Engines) -> Poses:
    """What the engines have of each stream: as it came in, or at the stamps of pairs where some
    were made.
    """
    streams = {name: engine.snapshot().streams for name, engine in engines.items()}
    return {"parent": streams["child"][0]} | {name: child for name, (_, child) in streams.items()}


def give(journal: Journal, directory: Path, engines: Engines) -> None:
    """Give engines the session of a directory.

    Raises
    ------
    InputError
        If they do not take it.
    """
    try:
        for name, engine in engines.items():
            for stream, own_stream in (("parent", "parent"), (name, "child")):
                if frame := journal.about.get(stream, {}).get("frame"):
                    engine.set_frame(own_stream, frame)
            rows = np.isin(journal.streams, ["parent", name])
            poses = journal.poses[rows]
            own_streams = np.where(journal.streams[rows] == "parent", "parent", "child")
            engine.add_poses(own_streams, journal.stamps_ns[rows], poses[:, :3], poses[:, 3:])
    except InputError as error:
        raise InputError(f"cannot use the session journal {directory}: {error}") from None


class DirectoryLock:
    """Keeps a directory for this process until :meth:`release`, or its end, however that comes.

    Parameters
    ----------
    directory : path
        Made if it does not exist. If it cannot be written, nothing is locked: the journal will say
        so.

    Raises
    ------
    ConfigError
        If another node has it.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = Path(directory)
        self._descriptor: int | None = None
        note = self.directory / _LOCK_NAME
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            self._descriptor = os.open(self.directory, os.O_RDONLY | os.O_DIRECTORY)
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            write_atomically({note: str(os.getpid())})
        except BlockingIOError:
            self.release()
            owner = 0
            with contextlib.suppress(OSError, ValueError):
                owner = int(note.read_bytes()[:32])
            raise ConfigError(
                f"output_directory {self.directory} is in use by another calibrator "
                f"(process {owner or 'unknown'}): stop that one, or choose another directory"
            ) from None
        except OSError:
            return  # a disk that takes no lock, or nothing at all

    def release(self) -> None:
        """Leave the directory to others."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


class SessionJournal:
    """Takes poses in the executor's thread, writes them in its own.

    Parameters
    ----------
    directory : path
    about : callable
        Gives what is known of each stream: options, topic, frame, origin.
    poses : callable
        Gives the poses of the session so far, for a journal that is begun or begun again.
    resumed : Journal, optional
        The session in the directory goes on; otherwise it is kept aside.

    Attributes
    ----------
    error : str
        Why it cannot be written; empty if it can.
    """

    def __init__(
        self,
        directory: Path,
        about: Callable[[], About],
        poses: Callable[[], Poses],
        resumed: Journal | None = None,
    ) -> None:
        self.directory, self.error = Path(directory), ""
        self._make_about, self._make_poses = about, poses
        self._about = about()
        self._notes: queue.SimpleQueue[tuple[bool, str]] = queue.SimpleQueue()
        self._events: list[_Event] = []
        self._jobs: queue.Queue[Callable[[], None] | None] = queue.Queue()
        self._failed_at_s: float | None = None
        self._is_ours = resumed is not None
        self._writer: JournalWriter | None = None  # in the thread; None while it cannot be written
        self._jobs.put(partial(self._open, self._about, poses(), resumed))
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def add_pose(
        self, stream: str, stamp_ns: int, position: Sequence[float], quat_xyzw: Sequence[float]
    ) -> None:
        """Note a pose that the engine has taken."""
        self._events.append((stream, stamp_ns, position, quat_xyzw))

    def flush(self) -> None:
        """Hand what is new to the thread; to be called often."""
        events, self._events = self._events, []
        before, self._about = self._about, self._make_about()
        if self._failed_at_s is not None:
            if time.monotonic() - self._failed_at_s >= _RETRY_S:
                self._failed_at_s = None
                self._jobs.put(partial(self._open, self._about, self._make_poses()))
        elif self._jobs.qsize() > _MOST_WAITING:
            self._give_up("the disk does not answer")
        elif events or self._about != before:
            self._jobs.put(partial(self._write, events, self._about))

    def begin(self) -> None:
        """Start a new session without poses; the one so far is kept aside."""
        events, self._events = self._events, []
        self._jobs.put(partial(self._write, events, self._about))
        self._about = self._make_about()
        self._jobs.put(partial(self._begin, self._about))

    def notes(self) -> Iterator[tuple[bool, str]]:
        """Lines for the log since the last call, each with whether it is a warning."""
        while not self._notes.empty():
            yield self._notes.get()

    def stop(self, timeout_s: float) -> None:
        """Write what is left and end the thread, unless the disk keeps it busy."""
        self.flush()
        self._jobs.put(self._close)
        self._jobs.put(None)
        self._thread.join(timeout_s)

    def _give_up(self, reason: str) -> None:
        """Leave the files as they are; they are begun again later."""
        self.error, self._failed_at_s = reason, time.monotonic()
        text = f"cannot write the session journal in {self.directory}: {reason}; "
        self._notes.put((True, text + "going on without it: a crash would lose this session"))

    # ------------------------------------------------------------ in the thread

    def _run(self) -> None:
        while (work := self._jobs.get()) is not None:
            try:
                work()
            except Exception as error:  # a defect, too: the node must say so and go on
                self._writer = None
                what = str(error) if isinstance(error, OSError) else repr(error)
                self._give_up(getattr(error, "strerror", None) or what)

    def _open(self, about: About, poses: Poses, resumed: Journal | None = None) -> None:
        if not self._is_ours and has_session(self.directory):
            self._keep_aside()
        self._is_ours = True
        self._writer = JournalWriter(self.directory, about, poses, resumed)
        if self.error:
            self.error = ""
            text = f"the session journal in {self.directory} is being written again"
            self._notes.put((False, text))

    def _begin(self, about: About) -> None:
        self._close()
        self._is_ours = False
        self._open(about, {})

    def _keep_aside(self) -> None:
        """Keep an earlier session, unless there is nothing in it."""
        poses = count_poses(self.directory)
        if poses != 0:
            what = "a session that cannot be read"
            if poses is not None:
                what = f"the session before this one ({poses} poses)"
            text = (
                f"{what} is kept in {keep_aside(self.directory)}; to go on with it, stop the node, "
                f"rename that folder to {self.directory.name} and start with the parameter journal "
                "at resume"
            )
            self._notes.put((False, text))

    def _write(self, events: list[_Event], about: About) -> None:
        if self._writer is not None:
            for event in events:
                self._writer.add_pose(*event)
            self._writer.flush()
            self._writer.describe(about)

    def _close(self) -> None:
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()
