"""The journal of the live session, written by a thread of its own: a slow or full disk never holds
up a message.
"""

import fcntl
import os
import queue
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.formats import journal
from hand_eye_calib.online.live.log import NodeLog

# How often what came in is handed to the disk: what a crash can cost.
FLUSH_PERIOD_S = 0.25

# Batches that may wait for a disk that does not answer: a minute.
_MOST_WAITING = 240

# Stream, stamp (ns), position and quaternion.
_Pose = tuple[str, int, Sequence[float], Sequence[float]]


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
    What cannot be written ends the journal until the next session; ``error`` says why. Poses that
    the engine has taken are appended to ``poses``.

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
        about: Callable[[], journal.About],
        log: NodeLog,
        resumed: journal.Journal | None = None,
    ) -> None:
        self.directory = directory
        self.error = ""
        self._log = log
        self._lock = lock_directory(directory.parent)
        self._about = about
        self.poses: list[_Pose] = []
        self._jobs: queue.Queue[Callable[[], None] | None] = queue.Queue()
        # In the thread; None while it cannot be written.
        self._writer: journal.JournalWriter | None = None
        self._jobs.put(partial(self._open, about(), resumed))
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def flush(self) -> None:
        """Hand what is new to the thread; to be called often."""
        poses = self.poses
        self.poses = []
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

    def _open(self, about: journal.About, resumed: journal.Journal | None = None) -> None:
        if resumed is None and journal.is_used(self.directory):
            poses = journal.count_poses(self.directory)
            if poses != 0:  # not the empty one of a node that was started in vain
                what = "" if poses is None else f" ({poses} poses)"
                aside = journal.keep_aside(self.directory)
                self._log.info(f"the session before this one{what} is kept in {aside}")
        self._writer = journal.JournalWriter(self.directory, about, resumed=resumed)

    def _write(self, poses: list[_Pose], about: journal.About) -> None:
        if self._writer is not None:
            for pose in poses:
                self._writer.add_pose(*pose)
            self._writer.flush()
            self._writer.describe(about)

    def _close(self) -> None:
        writer = self._writer
        self._writer = None
        if writer is not None:
            writer.close()
