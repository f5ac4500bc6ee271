"""The session journal: the input of the calibrator, written to disk as it arrives, so that a crash
loses next to nothing.

A journal is a directory of segments ``session-<number>.journal``. A segment opens with a checkpoint
of the whole engine and goes on with every pose and frame name since; when it has grown enough, the
next segment starts from a new checkpoint and older ones are removed. Records carry their length and
a checksum: a reader takes the whole records and stops at the first that is not, so that a process
killed in the middle of a write costs at most the record it was writing.
"""

import io
import os
import re
import shutil
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Literal, TypeAlias

import numpy as np
import yaml
from numpy.typing import NDArray

from hand_eye_calib.config import other_names
from hand_eye_calib.errors import InputError
from hand_eye_calib.io.files import read_bytes, write_atomically
from hand_eye_calib.io.limits import LARGEST_RECORD, LARGEST_SEGMENT, LONGEST_NAME
from hand_eye_calib.io.yaml_files import read_yaml

_MAGIC = b"hand_eye_calib journal 1\n"
_HEADER = struct.Struct("<cII")  # kind, payload length, checksum of kind and payload
_POSE = struct.Struct("<Bq7d")
_CHECKPOINT, _POSE_KIND, _FRAME = b"C", b"P", b"F"
_STREAMS = ("parent", "child", *other_names())

#: Options and topics of the session, beside its segments.
ABOUT_NAME = "session.yaml"

_SEGMENT_NAME = re.compile(r"session-(\d{1,18})\.journal")

Checkpoint: TypeAlias = Mapping[str, NDArray[Any]]
PoseEvent: TypeAlias = tuple[
    Literal["pose"], str, int, tuple[float, float, float], tuple[float, float, float, float]
]
FrameEvent: TypeAlias = tuple[Literal["frame"], str, str]
Event: TypeAlias = PoseEvent | FrameEvent


class JournalWriter:
    """Writes one session into a directory.

    Parameters
    ----------
    directory : path
        Made if it does not exist. Segments in it are replaced by this session's.
    checkpoint : dict of str to arrays
        The engine's state to start from
        (:meth:`hand_eye_calib.engine.calibrator.Calibrator.state`).
    segment_bytes : int
        Bytes since the checkpoint at which :attr:`is_full` asks for a new one.

    Raises
    ------
    OSError
        Here and in all methods, if it cannot be written.
    """

    def __init__(
        self, directory: str | Path, checkpoint: Checkpoint, segment_bytes: int = 16_000_000
    ) -> None:
        self._directory = Path(directory)
        self._directory.mkdir(parents=True, exist_ok=True)
        self._segment_bytes = segment_bytes
        self._file: Any = None
        self._pending = bytearray()
        self.rotate(checkpoint)

    @property
    def is_full(self) -> bool:
        """Whether it is time to :meth:`rotate`."""
        return self._written + len(self._pending) >= self._segment_bytes

    def add_pose(
        self,
        stream: str,
        stamp_ns: int,
        position: Sequence[float],
        quat_xyzw: Sequence[float],
    ) -> None:
        """Note a pose; it reaches the disk with the next :meth:`flush`."""
        self._add(_POSE_KIND, _POSE.pack(_STREAMS.index(stream), stamp_ns, *position, *quat_xyzw))

    def set_frame(self, stream: str, sensor_frame: str) -> None:
        """Note a stream's sensor frame."""
        self._add(_FRAME, bytes([_STREAMS.index(stream)]) + sensor_frame.encode())

    def flush(self) -> None:
        """Hand everything noted to the operating system, where it survives this process."""
        if self._pending:
            # Unbuffered: a short write leaves a torn record at the end, which the next flush would
            # bury.
            self._check_in_place()
            taken = self._file.write(self._pending)
            if taken != len(self._pending):
                raise OSError(f"only {taken} of {len(self._pending)} bytes were written")
            self._written += taken
            self._pending.clear()

    def rotate(self, checkpoint: Checkpoint) -> None:
        """Start a new segment from a checkpoint, and remove the old ones once it is on disk."""
        old = _segments(self._directory)
        number = _number(old[-1]) + 1 if old else 1
        path = self._directory / f"session-{number:06d}.journal"
        beginning = _MAGIC + _record(_CHECKPOINT, _pack_checkpoint(checkpoint))
        temporary = path.with_suffix(".tmp")
        with open(temporary, "wb") as file:
            file.write(beginning)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        self.close()
        self._file = open(path, "ab", buffering=0)  # noqa: SIM115 - kept open for the session
        self._path = path
        self._written, self._pending = 0, bytearray()
        for segment in old:
            segment.unlink(missing_ok=True)

    def close(self) -> None:
        """Flush and close."""
        if self._file is not None:
            try:
                self.flush()
            finally:
                self._file.close()
                self._file = None

    def _check_in_place(self) -> None:
        """Raise OSError if the file is no longer where it was: what is written would be lost."""
        if not os.path.samestat(os.stat(self._path), os.fstat(self._file.fileno())):
            raise OSError("another program has replaced its file")

    def _add(self, kind: bytes, payload: bytes) -> None:
        self._pending += _record(kind, payload)


def write_about(directory: str | Path, about: Mapping[str, Any]) -> None:
    """Write beside the segments what a person wants to know of the session: plain values.

    Raises
    ------
    OSError
    """
    text = yaml.safe_dump(dict(about), sort_keys=False, allow_unicode=True)
    write_atomically({Path(directory) / ABOUT_NAME: text})


def read_about(directory: str | Path) -> dict[str, Any]:
    """What :func:`write_about` wrote; empty if there is nothing.

    Raises
    ------
    InputError
        If it cannot be read or is no mapping of names to mappings.
    """
    path = Path(directory) / ABOUT_NAME
    if not path.exists():
        return {}
    about = read_yaml(path)
    if not isinstance(about, dict) or not all(isinstance(each, dict) for each in about.values()):
        raise InputError(f"{path}: expected a mapping of names to mappings; remove the file")
    return about


def has_session(directory: str | Path) -> bool:
    """Whether a directory holds a journal."""
    return bool(_segments(Path(directory)))


def keep_aside(directory: str | Path) -> Path:
    """Rename a journal's directory so that a new session can use it; returns where it went.

    Only the last one is kept: what was kept before is removed.

    Raises
    ------
    OSError
    """
    directory = Path(directory)
    aside = directory.with_name(f"{directory.name}.previous")
    if aside.exists():
        shutil.rmtree(aside)
    return directory.replace(aside)


def count_poses(directory: str | Path) -> int | None:
    """Number of poses in the session that a directory holds; None if it is damaged.

    Raises
    ------
    OSError
    """
    try:
        checkpoint, events, _ = read_journal(directory)
        kept = sum(int(checkpoint[f"{stream}.statistics"][0]) for stream in _STREAMS[:2])
    except (InputError, LookupError, ValueError, TypeError):
        return None
    return kept + sum(event[0] == "pose" for event in events)


def read_journal(directory: str | Path) -> tuple[dict[str, NDArray[Any]], list[Event], int]:
    """Read the session that a directory holds.

    Parameters
    ----------
    directory : path

    Returns
    -------
    checkpoint : dict of str to arrays
    events : list of tuple
        ("pose", stream, stamp_ns, position, quat_xyzw) and ("frame", stream, name), in the order
        in which they arrived.
    lost_bytes : int
        Bytes at the end that were not whole; 0 after a clean end.

    Raises
    ------
    InputError
        If there is no journal, or none of its segments begins with a whole checkpoint.
    """
    segments = _segments(Path(directory))
    if not segments:
        raise InputError(f"no session journal in {directory}")
    for segment in reversed(segments):
        try:
            data = read_bytes(segment, LARGEST_SEGMENT)
        except OSError as error:
            raise InputError(
                f"cannot read the session journal {segment}: {error.strerror}"
            ) from None
        records, end = _whole_records(data)
        if records and records[0][0] == _CHECKPOINT:
            try:
                events = [_event(*record) for record in records[1:]]
                return _unpack_checkpoint(records[0][1]), events, len(data) - end
            except InputError as error:
                raise InputError(f"cannot use the session journal {segment}: {error}") from None
    raise InputError(
        f"the session journal {segments[-1]} is damaged from its first byte; move it away to start "
        "anew"
    )


def _segments(directory: Path) -> list[Path]:
    """Segments in their order; files of other names, such as copies, are not looked at.

    None in a directory that cannot be read, or that is renamed while it is read (a reset).
    """
    try:
        names = os.listdir(directory)
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return []
    found = [directory / name for name in names if _SEGMENT_NAME.fullmatch(name)]
    return sorted(found, key=_number)


def _number(segment: Path) -> int:
    return int(segment.stem.rpartition("-")[2])


def _record(kind: bytes, payload: bytes) -> bytes:
    return _HEADER.pack(kind, len(payload), zlib.crc32(payload, zlib.crc32(kind))) + payload


def _whole_records(data: bytes) -> tuple[list[tuple[bytes, bytes]], int]:
    """Records up to the first that is cut off or damaged, and where that begins."""
    records: list[tuple[bytes, bytes]] = []
    position = len(_MAGIC)
    if data[:position] != _MAGIC:
        return records, 0
    while position + _HEADER.size <= len(data):
        kind, length, checksum = _HEADER.unpack_from(data, position)
        start = position + _HEADER.size
        if length > LARGEST_RECORD or start + length > len(data):
            break
        payload = data[start : start + length]
        if zlib.crc32(payload, zlib.crc32(kind)) != checksum:
            break
        records.append((kind, payload))
        position = start + length
    return records, position


def _event(kind: bytes, payload: bytes) -> Event:
    """The event of a record, whose checksum was right."""
    if kind not in (_POSE_KIND, _FRAME):
        raise InputError(f"it has a record of unknown kind {kind!r}, of a newer version perhaps")
    try:
        if kind == _POSE_KIND:
            number, stamp_ns, x, y, z, qx, qy, qz, qw = _POSE.unpack(payload)
            return "pose", _STREAMS[number], stamp_ns, (x, y, z), (qx, qy, qz, qw)
        if len(payload) > LONGEST_NAME:
            raise ValueError(f"a frame's name has {len(payload)} bytes")
        return "frame", _STREAMS[payload[0]], payload[1:].decode()
    except (struct.error, LookupError, ValueError) as error:
        raise InputError(f"it has a record that cannot be right ({error})") from None


def _pack_checkpoint(checkpoint: Checkpoint) -> bytes:
    packed = io.BytesIO()
    np.savez(packed, **checkpoint)  # type: ignore[arg-type]
    return packed.getvalue()


def _unpack_checkpoint(payload: bytes) -> dict[str, NDArray[Any]]:
    try:
        with zipfile.ZipFile(io.BytesIO(payload)) as archive:
            return {
                info.filename.removesuffix(".npy"): _unpack_array(archive, info)
                for info in archive.infolist()
            }
    # A damaged archive makes zipfile and NumPy raise nearly anything.
    except Exception as error:
        raise InputError(f"its checkpoint cannot be right ({error})") from None


def _unpack_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    """An array of the archive, not larger than its bytes; never one of Python objects."""
    if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
        raise ValueError("an array is compressed")
    file: BinaryIO = io.BytesIO(archive.read(info))
    version = np.lib.format.read_magic(file)
    if version != (1, 0):
        raise ValueError("an array is of another version")
    shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(file)
    if dtype.hasobject or is_fortran or dtype.kind not in "biufU":
        raise ValueError(f"an array is of type {dtype}")
    return np.frombuffer(file.read(), dtype=dtype).reshape(shape).copy()
