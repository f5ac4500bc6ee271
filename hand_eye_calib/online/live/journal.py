"""Journal of the live session: the poses on disk, so that a crash does not lose them.

A separate thread writes the journal, so that a slow or full disk never delays a message.
"""

import fcntl
import os
import queue
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TypeAlias

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.formats import journal
from hand_eye_calib.online.live.log import NodeLog

# Period (s) at which poses are written to the disk. A crash loses the poses of one period.
FLUSH_PERIOD_S = 0.25

# The disk counts as dead if this number of jobs waits in the queue. It is one minute of batches.
_MAX_WAITING = 240

# Stream, stamp (ns), position (m) and quaternion (x, y, z, w).
_Pose: TypeAlias = tuple[str, int, Sequence[float], Sequence[float]]


def lock_directory(directory: Path) -> int | None:
    """Make a directory and lock it for this process.

    Returns
    -------
    int or None
        File descriptor of the directory. The lock lasts until the descriptor is closed or the
        process ends. None if the directory cannot be made; the journal reports this failure.

    Raises
    ------
    ConfigError
        If another node has locked the directory.
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
            f"output_directory {directory} is in use by another calibrator: "
            "stop the other calibrator, or choose another directory"
        ) from None
    except OSError:
        # Some file systems have no locks.
        pass
    return descriptor


class SessionJournal:
    """Receive poses in the thread of the executor, and write them to disk in another thread.

    The first failure to write ends the journal until the next session.

    Parameters
    ----------
    directory : path
    about : callable
        Function that returns topic, options, frames and origin of each stream. The journal stores
        them.
    log : NodeLog
    resumed : Journal, optional
        Session in the directory that is continued. By default it is kept aside, and a new session
        begins.

    Attributes
    ----------
    poses : list
        Poses that were not written yet. The caller appends new poses.
    error : str
        Reason why the journal cannot be written; empty otherwise.

    Raises
    ------
    ConfigError
        If another node uses the parent directory, which is the node's output directory.
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
        # Only the thread uses the writer. It is None while the journal cannot be written.
        self._writer: journal.JournalWriter | None = None
        self._jobs.put(partial(self._open, about(), resumed))
        self._thread = threading.Thread(
            target=self._run, name="journal", daemon=True
        )
        self._thread.start()

    def flush(self) -> None:
        """Pass new poses on to the thread. Call this method often."""
        poses = self.poses
        self.poses = []
        if self._jobs.qsize() > _MAX_WAITING and not self.error:
            self._give_up("the disk does not answer")
        elif not self.error:
            self._jobs.put(partial(self._write, poses, self._about()))

    def begin(self) -> None:
        """Begin a new session without poses, and keep the files of the present session aside."""
        self.flush()
        self.error = ""
        self._jobs.put(self._close)
        self._jobs.put(partial(self._open, self._about()))

    def stop(self, timeout_s: float) -> None:
        """Write the last poses and end the thread; wait at most ``timeout_s``."""
        self.flush()
        self._jobs.put(self._close)
        self._jobs.put(None)
        self._thread.join(timeout_s)
        if self._lock is not None:
            os.close(self._lock)

    def _give_up(self, reason: str) -> None:
        """Stop writing until the next session; leave the files as they are."""
        self.error = reason
        self._log.warning(
            f"cannot write the session journal in {self.directory}: {reason}; "
            "no journal until ~/reset (make the directory writable first), so a crash would lose "
            "this session"
        )

    # ------------------------------------------------------------ in the thread

    def _run(self) -> None:
        """Process jobs until one is None."""
        while (job := self._jobs.get()) is not None:
            try:
                job()
            # A defect of the program must end the journal only, not the node.
            except Exception as error:
                self._writer = None
                reason = (
                    str(error) if isinstance(error, OSError) else repr(error)
                )
                self._give_up(getattr(error, "strerror", None) or reason)

    def _open(
        self, about: journal.About, resumed: journal.Journal | None = None
    ) -> None:
        """Start to write. A session in the directory is kept aside, unless it is continued."""
        if resumed is None and journal.is_used(self.directory):
            n_poses = journal.count_poses(self.directory)
            # A journal without poses is overwritten.
            if n_poses != 0:
                count = "" if n_poses is None else f" ({n_poses} poses)"
                aside = journal.keep_aside(self.directory)
                self._log.info(
                    f"the session before this one{count} is kept in {aside}"
                )
        self._writer = journal.JournalWriter(
            self.directory, about, resumed=resumed
        )

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
