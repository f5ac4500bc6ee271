"""The session journal: the poses that the node takes, written to disk as they arrive, so that a
crash loses next to nothing.

A journal is a directory with a text file for each stream, ``parent.tum``, ``child.tum`` and so on,
which other programs read as well: a line ``t x y z qx qy qz qw`` for each pose, with the stamp in
seconds and all digits of every number. Lines that begin with ``# {`` hold JSON. The first says what
the stream is and which options hold, later ones what has changed. ``parent_poses`` says how many
poses the parent's file had when the poses below it were written, which gives the order of arrival.
A process that is killed while it writes leaves a line without an end; a reader stops before the
first line that it cannot read.
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
# Names for a journal that is kept aside, beside what is no journal.
_MOST_ASIDE = 100
_ADVICE = "move it away to start anew"
# What a line may raise that is none of a journal.
_UNREADABLE = (ValueError, TypeError, OverflowError, RecursionError)

#: What is known of each stream: plain values, such as topic, frame, origin and options.
About = Mapping[str, Document]


class JournalWriter:
    """Writes one session into a directory, which is made if it does not exist. All methods raise
    OSError if it cannot be written.

    A directory with a file of such a name that is no journal, or a link, is refused.
    ``about`` is what is known of each stream, ``resumed`` the session in the directory if that goes
    on: what cannot be read at the end of its files is cut off.
    """

    def __init__(
        self, directory: str | Path, about: About, resumed: "Journal | None" = None
    ) -> None:
        Path(directory).mkdir(parents=True, exist_ok=True)
        _refuse_foreign(Path(directory))
        before = resumed or Journal({}, np.array([]), np.array([]), np.array([]), {})
        self._parent_poses = int((before.streams == "parent").sum())
        self._about: dict[str, Document] = {**before.about}
        self._pending: dict[str, list[str]] = {stream: [] for stream in {**about, **before.about}}
        self._files: dict[str, FileIO] = {}
        for stream in self._pending:
            # Unbuffered: what is flushed is with the operating system and survives this process.
            path = Path(directory, f"{stream}.tum")
            self._files[stream] = open(path, "ab", buffering=0, opener=_open_no_link)  # noqa: SIM115
            self._files[stream].truncate(before.whole_bytes.get(stream, 0))
        head = {"format": _FORMAT, "version": _VERSION}
        self.describe({stream: head | {"stream": stream} | {**about[stream]} for stream in about})

    def add_pose(
        self, stream: str, stamp_ns: int, position: Sequence[float], quat_xyzw: Sequence[float]
    ) -> None:
        """Note a pose; it reaches the disk with the next :meth:`flush`."""
        self._pending[stream].append(tum_line(stamp_ns, (*position, *quat_xyzw)))

    def describe(self, about: About) -> None:
        """Note what is known of the streams: what has changed reaches the disk at once."""
        self.flush()
        for stream, known in about.items():
            before = self._about.get(stream, {})
            if changed := {key: each for key, each in known.items() if before.get(key) != each}:
                self._write(stream, [f"# {json.dumps(changed)}"])
            self._about[stream] = {**before, **known}

    def flush(self) -> None:
        """Hand everything noted to the operating system, where it survives this process."""
        for stream, lines in self._pending.items():  # the parent is first
            if lines:
                batch = [] if stream == "parent" else [f'# {{"{_BATCH}": {self._parent_poses}}}']
                self._write(stream, [*batch, *lines])
                self._parent_poses += len(lines) * (stream == "parent")
                lines.clear()

    def _write(self, stream: str, lines: Sequence[str]) -> None:
        file = self._files[stream]
        # A file that is no longer where it was would take what is written, and lose it.
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
    """The session that a directory holds; its poses are in the order in which they arrived.

    ``about`` has "options", "topic", "frame", "origin" and what else was noted of each stream;
    ``streams`` (N,) and ``stamps_ns`` (N,) belong to ``poses`` (N, 7) of x y z (m), qx qy qz qw;
    ``whole_bytes`` are those of each stream's file up to the end of the last line that could be
    read.
    """

    about: dict[str, Document]
    streams: np.ndarray
    stamps_ns: IntArray
    poses: FloatArray
    whole_bytes: dict[str, int]


def read_journal(directory: str | Path) -> Journal:
    """Read the session that a directory holds; an InputError if there is none, or it cannot be
    read.
    """
    paths = {stream: Path(directory, f"{stream}.tum") for stream in _STREAMS}
    found = {stream: _read(path) for stream, path in paths.items() if os.path.lexists(path)}
    if "parent" not in found:  # a node may just have renamed the directory
        raise InputError(f"no session journal in {directory}")
    abouts, stamps_ns, values, sizes = zip(*found.values(), strict=True)
    rows = np.concatenate([np.reshape(each, (-1, 8)) for each in values])
    order = np.argsort(rows[:, 0], kind="stable")
    return Journal(
        about=dict(zip(found, abouts, strict=True)),
        streams=np.repeat([*found], [len(each) for each in stamps_ns])[order],
        stamps_ns=np.concatenate(stamps_ns)[order],
        poses=rows[order, 1:],
        whole_bytes=dict(zip(found, sizes, strict=True)),
    )


def _read(path: Path) -> tuple[Document, "array[int]", "array[float]", int]:
    """Read the file of one stream: what its comments say, the stamps of its poses, their rows, and
    how many bytes could be read. A row is x y z qx qy qz qw behind the time of arrival, which is
    counted in poses of the parent.
    """
    about: Document = {}
    # A pose is 72 bytes in these, and 500 in lists: a session may last all day.
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
                # The parent's poses count from 0; others came between two of them.
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
    return about, stamps_ns, values, whole_bytes


def _refuse_foreign(directory: Path) -> None:
    """Raise an OSError if a file of a stream's name is not a journal's: writing would empty it."""
    for stream in _STREAMS:
        path = directory / f"{stream}.tum"
        if os.path.lexists(path) and not _is_own(path):
            raise OSError(f"{path} is no session journal; move it away")


def _is_own(path: Path) -> bool:
    """Return whether a file is empty or begins as the file of a journal does; links are not."""
    if path.is_symlink() or not path.is_file():
        return False
    with open_regular(path) as file:
        beginning = file.read(LONGEST_LINE)
    return not beginning or (beginning.startswith(b"# {") and _FORMAT.encode() in beginning)


def _open_no_link(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW, 0o666)


def is_used(directory: str | Path) -> bool:
    """Return whether a directory has a file of the name of a stream, whatever is in it."""
    return any(os.path.lexists(Path(directory, f"{stream}.tum")) for stream in _STREAMS)


def has_session(directory: str | Path) -> bool:
    """Whether a directory holds a journal."""
    return os.path.isfile(Path(directory) / "parent.tum")


def keep_aside(directory: str | Path) -> Path:
    """Rename a journal's directory so that a new session can use it, and return where it went.

    Only the last journal is kept: the one before is removed. Where that is more than a journal, the
    next free name is taken, such as ``journal.previous2``. Raises OSError.
    """
    directory = Path(directory)
    for number in ("", *range(2, _MOST_ASIDE)):
        aside = directory.with_name(f"{directory.name}.previous{number}")
        if _is_journal(aside):
            shutil.rmtree(aside)
        if not os.path.lexists(aside):
            return directory.replace(aside)
    raise OSError(f"{aside} and those before it are no session journals; move them away")


def _is_journal(directory: Path) -> bool:
    """Return whether a directory holds files of a journal and nothing else."""
    if directory.is_symlink() or not directory.is_dir():
        return False
    names = {f"{stream}.tum" for stream in _STREAMS}
    return all(path.name in names and _is_own(path) for path in directory.iterdir())


def count_poses(directory: str | Path) -> int | None:
    """Number of poses in the session that a directory holds; None if it cannot be read."""
    try:
        return len(read_journal(directory).stamps_ns)
    except InputError:
        return None


def replay_journal(journal: Journal, directory: Path, engines: Calibrators) -> None:
    """Add the poses of the session of a directory to engines, in the order of their arrival.

    Raises
    ------
    InputError
        If the engines refuse them.
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
