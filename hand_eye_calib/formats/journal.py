"""Session journal: the poses of the node, written to disk as they arrive.

After a crash, only the last poses are lost.

A journal is a directory with a text file for each stream: ``parent.tum``, ``child.tum`` and so on.
Other programs can read these files, too. Each pose is a line ``t x y z qx qy qz qw``, with the
stamp in seconds and all digits of every number. A line that begins with ``# {`` is JSON: the first
such line describes the stream and its options, later lines their changes. ``parent_poses`` in such
a line is the number of poses in the parent's file when the next poses of this file were written.
This number determines the order of arrival. A process that is killed may leave an incomplete line.
So the reader stops before the first line that it cannot read.
"""

import json
import os
import shutil
from array import array
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.config import other_names
from hand_eye_calib.core.base.errors import InputError, located
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.engine.calibrator import Calibrators
from hand_eye_calib.formats.files import LONGEST_LINE, open_regular
from hand_eye_calib.formats.trajectory_files.table import tum_line

_FORMAT = "hand_eye_calib/journal"
_VERSION = 2
_STREAMS = ("parent", "child", *other_names())
_BATCH = "parent_poses"
# Largest number in the name of a journal that was set aside.
_MOST_ASIDE = 100
_ADVICE = "move it away to start anew"
# Errors while parsing a line that does not belong to a journal.
_UNREADABLE = (ValueError, TypeError, OverflowError, RecursionError)

#: Description of each stream in plain values: topic, frame, origin, options and others.
About = Mapping[str, Document]


class JournalWriter:
    """Writer of one session into a directory.

    All methods raise an OSError if the directory cannot be written.

    Parameters
    ----------
    directory : str or path-like
        A missing directory is made.
    about : About
        Description of each stream.
    resumed : Journal, optional
        Session in the directory to be continued. The unreadable end of its files is cut off.

    Raises
    ------
    OSError
        Also if a file with a stream's name is a link, or does not belong to a journal.
    """

    def __init__(
        self, directory: str | Path, about: About, resumed: "Journal | None" = None
    ) -> None:
        Path(directory).mkdir(parents=True, exist_ok=True)
        _refuse_foreign(Path(directory))
        self._parent_poses = 0
        self._about: dict[str, Document] = {}
        whole_bytes: dict[str, int] = {}
        if resumed:
            self._parent_poses = int((resumed.streams == "parent").sum())
            self._about |= resumed.about
            whole_bytes = resumed.whole_bytes
        self._pending: dict[str, list[str]] = {stream: [] for stream in {**about, **self._about}}
        self._files: dict[str, FileIO] = {}
        for stream in self._pending:
            # Without a buffer, data survives this process as soon as it is written.
            path = Path(directory, f"{stream}.tum")
            self._files[stream] = open(path, "ab", buffering=0, opener=_open_no_link)  # noqa: SIM115
            self._files[stream].truncate(whole_bytes.get(stream, 0))
        head = {"format": _FORMAT, "version": _VERSION}
        self.describe({stream: head | {"stream": stream} | {**about[stream]} for stream in about})

    def add_pose(
        self, stream: str, stamp_ns: int, position: Sequence[float], quat_xyzw: Sequence[float]
    ) -> None:
        """Add a pose. The next :meth:`flush` writes it."""
        self._pending[stream].append(tum_line(stamp_ns, (*position, *quat_xyzw)))

    def describe(self, about: About) -> None:
        """Write the changes in the descriptions of streams at once."""
        self.flush()
        for stream, description in about.items():
            before = self._about.get(stream, {})
            changes = {key: value for key, value in description.items() if before.get(key) != value}
            if changes:
                self._write(stream, [f"# {json.dumps(changes)}"])
            self._about[stream] = {**before, **description}

    def flush(self) -> None:
        """Write all poses to the operating system, so that they survive this process."""
        # The parent's stream is the first.
        for stream, lines in self._pending.items():
            if not lines:
                continue
            if stream == "parent":
                self._write(stream, lines)
                self._parent_poses += len(lines)
            else:
                self._write(stream, [f'# {{"{_BATCH}": {self._parent_poses}}}', *lines])
            lines.clear()

    def _write(self, stream: str, lines: Sequence[str]) -> None:
        file = self._files[stream]
        # If the file was replaced or deleted, data written to it would be lost.
        if not os.path.samestat(os.stat(file.name), os.fstat(file.fileno())):
            raise OSError("another program has replaced its file")
        file.write("\n".join([*lines, ""]).encode())

    def close(self) -> None:
        """Flush and close."""
        try:
            self.flush()
        finally:
            for file in self._files.values():
                file.close()


@dataclass(frozen=True)
class Journal:
    """Session of a directory, with its poses in the order of their arrival.

    Attributes
    ----------
    about : dict of str to dict
        "options", "topic", "frame", "origin" and other values of each stream.
    streams : (N,) array of str
        Stream of each pose.
    stamps_ns : (N,) array of int64
    poses : (N, 7) array
        x y z (m), qx qy qz qw.
    whole_bytes : dict of str to int
        Number of readable bytes of each stream's file.
    """

    about: dict[str, Document]
    streams: np.ndarray
    stamps_ns: IntArray
    poses: FloatArray
    whole_bytes: dict[str, int]


def read_journal(directory: str | Path) -> Journal:
    """Read the session of a directory.

    Raises
    ------
    InputError
        If the directory has no session, or the session cannot be read.
    """
    paths = {stream: Path(directory, f"{stream}.tum") for stream in _STREAMS}
    files = {stream: _read(path) for stream, path in paths.items() if os.path.lexists(path)}
    # Checked after reading: a node may have renamed the directory meanwhile, so that its files are
    # gone.
    if "parent" not in files:
        raise InputError(f"no session journal in {directory}")
    rows = np.concatenate([np.reshape(file.values, (-1, 8)) for file in files.values()])
    order = np.argsort(rows[:, 0], kind="stable")
    n_poses = [len(file.stamps_ns) for file in files.values()]
    stamps_ns = np.concatenate([file.stamps_ns for file in files.values()])
    return Journal(
        about={stream: file.about for stream, file in files.items()},
        streams=np.repeat([*files], n_poses)[order],
        stamps_ns=stamps_ns[order],
        poses=rows[order, 1:],
        whole_bytes={stream: file.whole_bytes for stream, file in files.items()},
    )


class _StreamFile(NamedTuple):
    """File of one stream.

    A row of ``values`` is the order of arrival and x y z qx qy qz qw. The order of arrival is
    counted in poses of the parent. ``whole_bytes`` is the number of readable bytes.
    """

    about: Document
    stamps_ns: "array[int]"
    values: "array[float]"
    whole_bytes: int


def _read(path: Path) -> _StreamFile:
    """Read the file of one stream up to the first unreadable line."""
    about: Document = {}
    # A session may last all day: a pose takes 72 bytes in these arrays, and 500 in lists.
    stamps_ns = array("q")
    values = array("d")
    whole_bytes = 0
    with open_regular(path) as file, suppress(*_UNREADABLE):
        while (line := file.readline(LONGEST_LINE)).endswith(b"\n"):
            if line.startswith(b"# {"):
                about |= json.loads(line[2:])
            elif not line.startswith(b"#"):
                stamp, *cells = line.split()
                seconds, _, decimals = stamp.partition(b".")
                if len(cells) != 7 or len(decimals) != 9:
                    break
                # The parent's poses are 0, 1, 2, ... Other poses arrived between two of them.
                arrived = about.get(_BATCH, len(stamps_ns) + 0.5) - 0.5
                row = [float(cell) for cell in (arrived, *cells)]
                stamps_ns.append(int(seconds + decimals))
                values.extend(row)
            whole_bytes += len(line)
    if about.get("format") != _FORMAT:
        raise InputError(f"the session journal {path} is damaged from its first byte; {_ADVICE}")
    if about.get("version") != _VERSION:
        raise InputError(
            f"the session journal {path} is of format version {about.get('version')}, this program "
            f"reads {_VERSION}: use the version that wrote it, or {_ADVICE}"
        )
    return _StreamFile(about, stamps_ns, values, whole_bytes)


def _refuse_foreign(directory: Path) -> None:
    """Raise an OSError if a file with a stream's name is not a journal, to protect its content."""
    for stream in _STREAMS:
        path = directory / f"{stream}.tum"
        if os.path.lexists(path) and not _is_own(path):
            raise OSError(f"{path} is no session journal; move it away")


def _is_own(path: Path) -> bool:
    """Whether a file is empty or begins like a journal, and is not a link."""
    if path.is_symlink() or not path.is_file():
        return False
    with open_regular(path) as file:
        beginning = file.read(LONGEST_LINE)
    return not beginning or (beginning.startswith(b"# {") and _FORMAT.encode() in beginning)


def _open_no_link(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW, 0o666)


def is_used(directory: str | Path) -> bool:
    """Whether a directory has a file with a stream's name and any content."""
    return any(os.path.lexists(Path(directory, f"{stream}.tum")) for stream in _STREAMS)


def has_session(directory: str | Path) -> bool:
    """Whether a directory has a journal."""
    return os.path.isfile(Path(directory) / "parent.tum")


def keep_aside(directory: str | Path) -> Path:
    """Rename the directory of a journal, so that a new session can use its name.

    The new name is ``journal.previous``. An older journal with this name is removed. If the name
    belongs to other files, the next free name is used, such as ``journal.previous2``.

    Returns
    -------
    pathlib.Path
        The new path.

    Raises
    ------
    OSError
        If the directory cannot be renamed, or no name is free.
    """
    directory = Path(directory)
    for number in ("", *range(2, _MOST_ASIDE)):
        aside = directory.with_name(f"{directory.name}.previous{number}")
        if _is_journal(aside):
            shutil.rmtree(aside)
        if not os.path.lexists(aside):
            return directory.replace(aside)
    raise OSError(f"{aside} and earlier ones are no session journals; move them away")


def _is_journal(directory: Path) -> bool:
    """Whether a directory has files of a journal and no other files."""
    if directory.is_symlink() or not directory.is_dir():
        return False
    names = {f"{stream}.tum" for stream in _STREAMS}
    return all(path.name in names and _is_own(path) for path in directory.iterdir())


def count_poses(directory: str | Path) -> int | None:
    """Return the number of poses in the session of a directory; None for unreadable sessions."""
    try:
        return len(read_journal(directory).stamps_ns)
    except InputError:
        return None


def replay_journal(journal: Journal, directory: Path, engines: Calibrators) -> None:
    """Add the poses of a session to calibrators, in the order of their arrival.

    Raises
    ------
    InputError
        If a calibrator refuses a pose. The message names the directory.
    """
    with located(f"cannot use the session journal {directory}"):
        for stream, about in journal.about.items():
            if about.get("frame"):
                engines.set_frame(stream, about["frame"])
            if about.get("world"):
                engines.set_world(stream, about["world"])
        columns = (journal.streams, journal.stamps_ns, journal.poses)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for stream, stamp_ns, pose in rows:
            if engines.takers(stream):
                engines.add_pose(stream, stamp_ns, pose[:3], pose[3:])
