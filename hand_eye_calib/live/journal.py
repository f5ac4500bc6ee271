"""The journal of the live session, written by a thread of its own: a slow or full disk never holds
up a message.
"""

import fcntl
import os
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.io.journal import (
    About,
    Journal,
    JournalWriter,
    count_poses,
    has_session,
    keep_aside,
)
from hand_eye_calib.live.log import NodeLog

# How often what came in is handed to the disk: what a crash can cost.
FLUSH_PERIOD_S = 0.25

# Batches that may wait for a disk that does not answer: a minute.
_MOST_WAITING = 240

# The engines by the child sensor of each; all of them have the same parent.
Engines = Mapping[str, Calibrator]
# Stream, stamp (ns), position and quaternion.
_Pose = tuple[str, int, Sequence[float], Sequence[float]]


def takers(stream: str, engines: Engines) -> list[tuple[str, Calibrator]]:
    """Who takes a message of a stream, and as which: the parent's counts for all child sensors."""
    if stream == "parent":
        return [(stream, each) for each in engines.values()]
    return [("child", engines[stream])] if stream in engines else []


def give(journal: Journal, directory: Path, engines: Engines) -> None:
    """Give engines the session of a directory.

    Raises
    ------
    InputError
        If they do not take it.
    """
    try:
        for stream, about in journal.about.items():
            for own_stream, engine in takers(stream, engines) if about.get("frame") else ():
                engine.set_frame(own_stream, about["frame"])
        columns = (journal.streams, journal.stamps_ns, journal.poses)
        for stream, stamp_ns, pose in zip(*(each.tolist() for each in columns), strict=True):
            for own_stream, engine in takers(stream, engines):
                engine.add_pose(own_stream, stamp_ns, pose[:3], pose[3:])
    except InputError as error:
        raise InputError(f"cannot use the session journal {directory}: {error}") from None


def lock_directory(directory: Path) -> int | None:
    """Keep a directory, made if need be, for this process, until the descriptor is closed or the
    process ends. None if it cannot be written: the journal will say so.

    Raises
    ------
    ConfigError
        If another node has it.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise ConfigError(
            f"output_directory {directory} is in use by another calibrator: stop that one, or "
            "choose another directory"
        ) from None
    except OSError:
        pass  # a disk that takes no lock
    return descriptor


class SessionJournal:
    """Takes poses in the executor's thread, writes them in its own, which writes to the log too.
    What cannot be written ends the journal until the next session; ``error`` says why.

    Parameters
    ----------
    directory : path
    about : callable
        Gives what is known of each stream: options, topic, frame, origin.
    log : NodeLog
    resumed : Journal, optional
        The session in the directory goes on; otherwise it is kept aside.

    Raises
    ------
    ConfigError
        If another node has the directory above.
    """

    def __init__(
        self,
        directory: Path,
        about: Callable[[], About],
        log: NodeLog,
        resumed: Journal | None = None,
    ) -> None:
        self.directory, self.error, self._log = directory, "", log
        self._lock = lock_directory(directory.parent)
        self._about = about
        self._poses: list[_Pose] = []
        self._jobs: queue.Queue[Callable[[], None] | None] = queue.Queue()
        self._writer: JournalWriter | None = None  # in the thread; None while it cannot be written
        self._jobs.put(partial(self._open, about(), resumed))
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def add_pose(
        self, stream: str, stamp_ns: int, position: Sequence[float], quat_xyzw: Sequence[float]
    ) -> None:
        """Note a pose that the engine has taken."""
        self._poses.append((stream, stamp_ns, position, quat_xyzw))

    def flush(self) -> None:
        """Hand what is new to the thread; to be called often."""
        poses, self._poses = self._poses, []
        if self._jobs.qsize() > _MOST_WAITING and not self.error:
            self._give_up("the disk does not answer")
        elif not self.error:
            self._jobs.put(partial(self._write, poses, self._about()))

    def begin(self) -> None:
        """Start a new session without poses; the one so far is kept aside."""
        self.flush()
        self.error = ""
        self._jobs.put(self._close)
        self._jobs.put(partial(self._open, self._about()))

    def stop(self, timeout_s: float) -> None:
        """Write what is left and end the thread, unless the disk keeps it busy."""
        self.flush()
        self._jobs.put(self._close)
        self._jobs.put(None)
        self._thread.join(timeout_s)
        if self._lock is not None:
            os.close(self._lock)

    def _give_up(self, reason: str) -> None:
        """Leave the files as they are."""
        self.error = reason
        self._log.warning(
            f"cannot write the session journal in {self.directory}: {reason}; going on without it "
            "until ~/reset: a crash would lose this session"
        )

    # ------------------------------------------------------------ in the thread

    def _run(self) -> None:
        while (work := self._jobs.get()) is not None:
            try:
                work()
            except Exception as error:  # a defect, too: the node must say so and go on
                self._writer = None
                what = str(error) if isinstance(error, OSError) else repr(error)
                self._give_up(getattr(error, "strerror", None) or what)

    def _open(self, about: About, resumed: Journal | None = None) -> None:
        if resumed is None and has_session(self.directory):
            poses = count_poses(self.directory)
            if poses != 0:  # not the empty one of a node that was started in vain
                what = "" if poses is None else f" ({poses} poses)"
                aside = keep_aside(self.directory)
                self._log.info(f"the session before this one{what} is kept in {aside}")
        self._writer = JournalWriter(self.directory, about, resumed=resumed)

    def _write(self, poses: list[_Pose], about: About) -> None:
        if self._writer is not None:
            for pose in poses:
                self._writer.add_pose(*pose)
            self._writer.flush()
            self._writer.describe(about)

    def _close(self) -> None:
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()
