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
# Stream, stamp (ns), position and quaternion of a pose.
_Event = tuple[str, int, Sequence[float], Sequence[float]]


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
        for name, engine in engines.items():
            for stream, own_stream in (("parent", "parent"), (name, "child")):
                if frame := journal.about.get(stream, {}).get("frame"):
                    engine.set_frame(own_stream, frame)
            columns = (journal.streams, journal.stamps_ns, journal.poses)
            for stream, stamp_ns, pose in zip(*(each.tolist() for each in columns), strict=True):
                if stream in ("parent", name):
                    own_stream = "parent" if stream == "parent" else "child"
                    engine.add_pose(own_stream, stamp_ns, pose[:3], pose[3:])
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
        self._descriptor: int | None = None
        try:
            directory.mkdir(parents=True, exist_ok=True)
            self._descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise ConfigError(
                f"output_directory {directory} is in use by another calibrator: stop that one, or "
                "choose another directory"
            ) from None
        except OSError:
            return  # a disk that takes no lock, or nothing at all

    def release(self) -> None:
        """Leave the directory to others."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


class SessionJournal:
    """Takes poses in the executor's thread, writes them in its own. What cannot be written ends
    the journal until the next session.

    Parameters
    ----------
    directory : path
    about : callable
        Gives what is known of each stream: options, topic, frame, origin.
    log : NodeLog
        Written to from that thread, too.
    resumed : Journal, optional
        The session in the directory goes on; otherwise it is kept aside.

    Attributes
    ----------
    error : str
        Why it cannot be written; empty if it can.

    Raises
    ------
    ConfigError
        If another node writes into the directory above.
    """

    def __init__(
        self,
        directory: Path,
        about: Callable[[], About],
        log: NodeLog,
        resumed: Journal | None = None,
    ) -> None:
        self.directory, self.error, self._log = directory, "", log
        self._lock = DirectoryLock(directory.parent)
        self._make_about, self._about = about, about()
        self._events: list[_Event] = []
        self._jobs: queue.Queue[Callable[[], None] | None] = queue.Queue()
        self._writer: JournalWriter | None = None  # in the thread; None while it cannot be written
        self._jobs.put(partial(self._open, self._about, resumed))
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
        if self._jobs.qsize() > _MOST_WAITING and not self.error:
            self._give_up("the disk does not answer")
        elif not self.error and (events or self._about != before):
            self._jobs.put(partial(self._write, events, self._about))

    def begin(self) -> None:
        """Start a new session without poses; the one so far is kept aside."""
        self._jobs.put(partial(self._write, self._events, self._about))
        self._events, self._about, self.error = [], self._make_about(), ""
        self._jobs.put(self._close)
        self._jobs.put(partial(self._open, self._about))

    def stop(self, timeout_s: float) -> None:
        """Write what is left and end the thread, unless the disk keeps it busy."""
        self.flush()
        self._jobs.put(self._close)
        self._jobs.put(None)
        self._thread.join(timeout_s)
        self._lock.release()

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
                what = "a session that cannot be read"
                if poses is not None:
                    what = f"the session before this one ({poses} poses)"
                self._log.info(
                    f"{what} is kept in {keep_aside(self.directory)}; to go on with it, stop the "
                    f"node, rename that folder to {self.directory.name} and start with the "
                    "parameter journal at resume"
                )
        self._writer = JournalWriter(self.directory, about, resumed=resumed)

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
