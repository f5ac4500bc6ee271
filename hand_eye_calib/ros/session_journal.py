"""The journal of the node's session, written by a thread of its own: a slow or full disk never
holds up a message.
"""

import fcntl
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.errors import ConfigError
from hand_eye_calib.io.journal import (
    JournalWriter,
    count_poses,
    has_session,
    keep_aside,
    read_journal,
    write_about,
)

# How often what came in is handed to the disk: what a crash can cost.
FLUSH_PERIOD_S = 0.25

# After a failed write the journal is started anew this often.
_RETRY_S = 5.0

# Holds the process id of the node that writes into a directory.
_LOCK_NAME = ".calibrator.lock"

# Batches that may wait for a disk that does not answer: a minute.
_MOST_WAITING = 240


# The engine's state as arrays, and what the thread is told to do with what.
State = dict[str, np.ndarray]
_Work = Callable[[Any], None]


def whole_state(calibrator: Calibrator, others: Mapping[str, Calibrator]) -> State:
    """The state of the engine, and those of further child sensors under their names."""
    state = calibrator.state()
    for name, other in others.items():
        state |= {f"{name}/{part}": value for part, value in other.state().items()}
    return state


def resume(
    directory: Path, calibrator: Calibrator, others: Mapping[str, Calibrator] | None = None
) -> int:
    """Bring a calibrator, and those of further child sensors, to where the session in a directory
    ended; returns how many poses the first one has.

    Raises
    ------
    InputError
        If there is no session, or it is damaged.
    """
    others = others or {}
    checkpoint, events, _ = read_journal(directory)
    calibrator.restore({part: value for part, value in checkpoint.items() if "/" not in part})
    for name, other in others.items():
        beginning = f"{name}/"
        state = {
            part.removeprefix(beginning): value
            for part, value in checkpoint.items()
            if part.startswith(beginning)
        }
        if state:
            other.restore(state)
    for kind, stream, *event in events:
        for own_stream, each in takers(stream, calibrator, others):
            take = each.add_pose if kind == "pose" else each.set_frame
            take(own_stream, *event)
    return sum(calibrator.statistics(stream).received for stream in ("parent", "child"))


def takers(
    stream: str, calibrator: Calibrator, others: Mapping[str, Calibrator]
) -> list[tuple[str, Calibrator]]:
    """Who takes a message of a stream, and as which: the parent's counts for all child sensors."""
    if stream == "parent":
        return [(stream, each) for each in (calibrator, *others.values())]
    if stream == "child":
        return [(stream, calibrator)]
    return [("child", others[stream])] if stream in others else []


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
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            self._descriptor = os.open(self.directory / _LOCK_NAME, os.O_RDWR | os.O_CREAT, 0o644)
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.ftruncate(self._descriptor, 0)
            os.pwrite(self._descriptor, str(os.getpid()).encode(), 0)
        except BlockingIOError:
            assert self._descriptor is not None
            owner = os.pread(self._descriptor, 32, 0).decode(errors="replace")
            self.release()
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
    """Takes poses and frame names in the executor's thread, writes them in its own.

    Parameters
    ----------
    directory : path
    state : dict of str to arrays
        The engine's state to start from.
    about : mapping
        Options and topics of the session, in plain values.
    resumed : bool
        The state is that of the session in the directory, which need not be kept aside then.
    """

    def __init__(
        self, directory: Path, state: State, about: Mapping[str, Any], resumed: bool = False
    ) -> None:
        self.directory = Path(directory)
        self.error = ""
        self._notes: queue.SimpleQueue[tuple[bool, str]] = queue.SimpleQueue()
        self._events: list[tuple[Any, ...]] = []
        self._jobs: queue.Queue[tuple[_Work, Any] | None] = queue.Queue()
        self._is_full = False
        self._failed_at: float | None = None
        self._broken = False  # in the thread: the segment must not be written to any more
        self._is_ours = resumed
        self._writer: JournalWriter | None = None
        self._about = about
        self._jobs.put((self._open, state))
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def add_pose(
        self, stream: str, stamp_ns: int, position: Sequence[float], quat_xyzw: Sequence[float]
    ) -> None:
        """Note a pose that the engine has taken."""
        self._events.append((stream, stamp_ns, position, quat_xyzw))

    def set_frame(self, stream: str, sensor_frame: str) -> None:
        """Note the name of a stream's sensor frame."""
        self._events.append((stream, sensor_frame))

    def describe(self, about: Mapping[str, Any]) -> None:
        """Take other options or topics of the session."""
        self._jobs.put((self._write_about, about))

    def flush(self, make_state: Callable[[], State]) -> None:
        """Hand what was noted to the thread; to be called often.

        Parameters
        ----------
        make_state : callable
            Gives the engine's state, for a new segment.
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

    def begin(self, state: State) -> None:
        """Start a new session; the one so far is kept aside."""
        self._jobs.put((self._write, self._events))
        self._events = []
        self._jobs.put((self._begin, state))

    def notes(self) -> Iterator[tuple[bool, str]]:
        """Lines for the log since the last call, each with whether it is a warning."""
        while not self._notes.empty():
            yield self._notes.get()

    def stop(self, make_state: Callable[[], State], timeout_s: float) -> bool:
        """Write what is left and end the thread; False if the disk keeps it busy."""
        self.flush(make_state)
        self._jobs.put(None)
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    # ------------------------------------------------------------ in the thread

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            work, argument = job
            try:
                work(argument)
            except OSError as error:
                self._give_up(error.strerror or str(error))
            except Exception as error:  # a defect: the node must say so and go on
                self._give_up(f"{type(error).__name__}: {error}")
        if self._writer is not None and not self._broken:
            try:
                self._writer.close()
            except OSError as error:
                self._fail(error.strerror or str(error))

    def _give_up(self, reason: str) -> None:
        """Leave this segment as it is; a new one is begun later."""
        self._broken = True
        self._failed_at = time.monotonic()
        self._fail(reason)

    def _fail(self, reason: str) -> None:
        self.error = reason
        text = f"cannot write the session journal in {self.directory}: {reason}; "
        self._notes.put((True, text + "going on without it: a crash would lose this session"))

    def _open(self, state: State) -> None:
        if not self._is_ours:
            self._keep_aside()
        self._is_ours = True
        self._writer = JournalWriter(self.directory, state)
        self._broken = False
        write_about(self.directory, self._about)
        if self.error:
            self.error = ""
            text = f"the session journal in {self.directory} is being written again"
            self._notes.put((False, text))

    def _begin(self, state: State) -> None:
        if self._writer is not None and not self._broken:
            self._writer.close()
        self._writer, self._is_ours = None, False
        self._open(state)

    def _keep_aside(self) -> None:
        """Keep an earlier session, unless there is nothing in it."""
        if not has_session(self.directory):
            return
        poses = count_poses(self.directory)
        if poses == 0:
            return
        aside = keep_aside(self.directory)
        size = (
            "a damaged session" if poses is None else f"the session before this one ({poses} poses)"
        )
        how = (
            f"stop the node, rename that folder to {self.directory.name} and start with the "
            "parameter journal at resume"
        )
        self._notes.put((False, f"{size} is kept in {aside}; to go on with it, {how}"))

    def _write(self, events: list[tuple[Any, ...]]) -> None:
        if self._broken or self._writer is None:
            return
        for event in events:
            self._writer.add_pose(*event) if len(event) == 4 else self._writer.set_frame(*event)
        self._writer.flush()
        self._is_full = self._writer.is_full

    def _write_about(self, about: Mapping[str, Any]) -> None:
        self._about = about
        if not self._broken and self._writer is not None:
            write_about(self.directory, about)

    def _rotate(self, state: State) -> None:
        if not self._broken and self._writer is not None:
            self._writer.rotate(state)
