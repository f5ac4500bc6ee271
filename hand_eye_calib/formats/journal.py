"""Session journal: poses that are written to disk when the node receives them.

After a crash, only the last poses are lost.

A journal is a directory with a text file for each stream: ``parent.tum``, ``child.tum`` and so on.
Other programs can also read these files. Each pose is a line ``t x y z qx qy qz qw``, with the
stamp in seconds and all digits of every number. A line that begins with ``# {`` is JSON. The first
such line describes the stream and its options; later lines contain changes. The value
``parent_poses`` in such a line is the length of the parent's file when the next poses of this file
were written. The order of arrival over several streams is computed from it. A killed process may
leave an incomplete line, so the reader stops before the first unreadable line.
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
from hand_eye_calib.formats.trajectory_files.writing import tum_line

_FORMAT = "hand_eye_calib/journal"
# Version of the format; journals of other versions are rejected.
_VERSION = 2
_STREAMS = ("parent", "child", *other_names())
# Key of the number of poses in the parent's file.
_BATCH = "parent_poses"
# Numbers in the names of renamed journals are below this, see `keep_aside`.
_END_OF_NUMBERS = 100
# Advice in messages about a journal that cannot be read.
_ADVICE = "move it away to start anew"
# Types of errors in the parsing of a line that does not belong to a journal.
_UNREADABLE = (ValueError, TypeError, OverflowError, RecursionError)

#: Description of each stream as plain values: topic, frame, origin, options and others.
About = Mapping[str, Document]


class JournalWriter:
    """Write the journal of a session into a directory.

    All methods raise an OSError if the directory cannot be written.

    Parameters
    ----------
    directory : str or path-like
        A missing directory is made.
    about : About
        Description of each stream.
    resumed : Journal, optional
        Session in the directory to be continued. The unreadable end of its files is removed.

    Raises
    ------
    OSError
        Also raised if the file of a stream is a link, or is not a journal.
    """

    def __init__(
        self,
        directory: str | Path,
        about: About,
        resumed: "Journal | None" = None,
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
        self._pending: dict[str, list[str]] = {
            stream: [] for stream in {**about, **self._about}
        }
        self._files: dict[str, FileIO] = {}
        for stream in self._pending:
            # Without a buffer, written data survives a crash of this process.
            path = Path(directory, f"{stream}.tum")
            self._files[stream] = open(  # noqa: SIM115
                path, "ab", buffering=0, opener=_open_no_link
            )
            self._files[stream].truncate(whole_bytes.get(stream, 0))
        head = {"format": _FORMAT, "version": _VERSION}
        self.describe(
            {
                stream: head | {"stream": stream} | {**about[stream]}
                for stream in about
            }
        )

    def add_pose(
        self,
        stream: str,
        stamp_ns: int,
        position: Sequence[float],
        quat_xyzw: Sequence[float],
    ) -> None:
        """Add a pose. The next :meth:`flush` writes it."""
        self._pending[stream].append(
            tum_line(stamp_ns, (*position, *quat_xyzw))
        )

    def describe(self, about: About) -> None:
        """Write changes in the descriptions of streams immediately, after the pending poses."""
        self.flush()
        for stream, description in about.items():
            written = self._about.get(stream, {})
            changes = {
                key: value
                for key, value in description.items()
                if written.get(key) != value
            }
            if changes:
                self._write(stream, [f"# {json.dumps(changes)}"])
            self._about[stream] = {**written, **description}

    def flush(self) -> None:
        """Pass all pending poses to the operating system, so that they survive a crash."""
        # The parent is the first stream, so the other streams use its final number of poses.
        for stream, lines in self._pending.items():
            if not lines:
                continue
            if stream == "parent":
                self._write(stream, lines)
                self._parent_poses += len(lines)
            else:
                self._write(
                    stream, [f'# {{"{_BATCH}": {self._parent_poses}}}', *lines]
                )
            lines.clear()

    def _write(self, stream: str, lines: Sequence[str]) -> None:
        """Write lines to the file of a stream; raise an OSError if the file was replaced."""
        file = self._files[stream]
        # Data for a replaced or deleted file would be lost.
        if not os.path.samestat(os.stat(file.name), os.fstat(file.fileno())):
            raise OSError("another program has replaced its file")
        file.write("\n".join([*lines, ""]).encode())

    def close(self) -> None:
        """Write all pending poses and close the files."""
        try:
            self.flush()
        finally:
            for file in self._files.values():
                file.close()


@dataclass(frozen=True)
class Journal:
    """Session that was read from a directory. The poses are in the order of arrival.

    Attributes
    ----------
    about : dict of str to dict
        Description of each stream: "options", "topic", "frame", "origin" and others.
    streams : (N,) array of str
        Stream of each pose.
    stamps_ns : (N,) array of int64
    poses : (N, 7) array
        Position x y z (m) and quaternion qx qy qz qw.
    whole_bytes : dict of str to int
        Number of bytes of the complete lines in each stream's file.
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
    files = {
        stream: _read(path)
        for stream, path in paths.items()
        if os.path.lexists(path)
    }
    # Check this after reading: a node may have renamed the directory in the meantime.
    if "parent" not in files:
        raise InputError(f"no session journal in {directory}")
    rows = np.concatenate(
        [np.reshape(file.values, (-1, 8)) for file in files.values()]
    )
    order = np.argsort(rows[:, 0], kind="stable")
    n_poses = [len(file.stamps_ns) for file in files.values()]
    stamps_ns = np.concatenate([file.stamps_ns for file in files.values()])
    return Journal(
        about={stream: file.about for stream, file in files.items()},
        streams=np.repeat([*files], n_poses)[order],
        stamps_ns=stamps_ns[order],
        poses=rows[order, 1:],
        whole_bytes={
            stream: file.whole_bytes for stream, file in files.items()
        },
    )


class _StreamFile(NamedTuple):
    """Content of the file of one stream.

    ``values`` are rows of 8 numbers: order of arrival, x y z, qx qy qz qw. The order of arrival of
    a parent's pose is its index. Other poses have values between two such indices. ``whole_bytes``
    is the length of the complete lines.
    """

    about: Document
    stamps_ns: "array[int]"
    values: "array[float]"
    whole_bytes: int


def _read(path: Path) -> _StreamFile:
    """Read the file of one stream up to the first unreadable line."""
    about: Document = {}
    # A session may last all day. A pose takes 72 bytes in these arrays; in lists it would take 500.
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
                # Order of arrival: 0, 1, 2, ... for the parent's poses, and n - 0.5 for a pose of
                # another stream that arrived after n poses of the parent.
                arrival = about.get(_BATCH, len(stamps_ns) + 0.5) - 0.5
                row = [float(cell) for cell in (arrival, *cells)]
                stamps_ns.append(int(seconds + decimals))
                values.extend(row)
            whole_bytes += len(line)
    if about.get("format") != _FORMAT:
        raise InputError(
            f"the session journal {path} is damaged from its first byte; {_ADVICE}"
        )
    if about.get("version") != _VERSION:
        raise InputError(
            f"the session journal {path} is of format version {about.get('version')}, this program "
            f"reads {_VERSION}: use the version that wrote it, or {_ADVICE}"
        )
    return _StreamFile(about, stamps_ns, values, whole_bytes)


def _refuse_foreign(directory: Path) -> None:
    """Raise an OSError if the file of a stream is not a journal, so that it is not overwritten."""
    for stream in _STREAMS:
        path = directory / f"{stream}.tum"
        if os.path.lexists(path) and not _is_own(path):
            raise OSError(f"{path} is no session journal; move it away")


def _is_own(path: Path) -> bool:
    """Return whether a file belongs to a journal: no link, and empty or with its first line."""
    if path.is_symlink() or not path.is_file():
        return False
    with open_regular(path) as file:
        beginning = file.read(LONGEST_LINE)
    if not beginning:
        return True
    return beginning.startswith(b"# {") and _FORMAT.encode() in beginning


def _open_no_link(path: str, flags: int) -> int:
    """Open a file like the builtin open. Raise an OSError if the path is a link."""
    return os.open(path, flags | os.O_NOFOLLOW, 0o666)


def is_used(directory: str | Path) -> bool:
    """Return whether a directory has a file with the name of a stream, even if it is no journal."""
    return any(
        os.path.lexists(Path(directory, f"{stream}.tum")) for stream in _STREAMS
    )


def has_session(directory: str | Path) -> bool:
    """Return whether a directory has the parent's file of a journal."""
    return os.path.isfile(Path(directory) / "parent.tum")


def keep_aside(directory: str | Path) -> Path:
    """Rename the directory of a journal, so that its name is free for a new session.

    The new name of ``journal`` is ``journal.previous``. An older journal with this name is removed.
    If other files have this name, the next free name is used, such as ``journal.previous2``.

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
    for number in ("", *range(2, _END_OF_NUMBERS)):
        aside = directory.with_name(f"{directory.name}.previous{number}")
        if _is_journal(aside):
            shutil.rmtree(aside)
        if not os.path.lexists(aside):
            return directory.replace(aside)
    raise OSError(
        f"{aside} and the folders with lower numbers are no session journals; move them away"
    )


def _is_journal(directory: Path) -> bool:
    """Return whether a directory is not a link and contains only files of a journal."""
    if directory.is_symlink() or not directory.is_dir():
        return False
    names = {f"{stream}.tum" for stream in _STREAMS}
    return all(
        path.name in names and _is_own(path) for path in directory.iterdir()
    )


def count_poses(directory: str | Path) -> int | None:
    """Return the number of poses in the session of a directory; None if it cannot be read."""
    try:
        return len(read_journal(directory).stamps_ns)
    except InputError:
        return None


def replay_journal(
    journal: Journal, directory: Path, engines: Calibrators
) -> None:
    """Add the poses of a session to calibrators, in the order of their arrival.

    Raises
    ------
    InputError
        If a calibrator rejects a pose. The message names the session by ``directory``.
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
