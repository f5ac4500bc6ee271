"""The session journal: what the calibrator was told, on disk as it comes in, so that a crash loses
next to nothing.

A journal is a directory of segments ``session-<number>.journal``. A segment opens with a checkpoint
of the whole engine and goes on with every pose and frame name since; when it has grown enough, the
next segment starts from a new checkpoint and older ones are removed. Records carry their length and
a checksum: a reader takes what is whole and stops at the first record that is not, so that a
process killed in the middle of a write costs at most the record it was writing.
"""

import io
import os
import shutil
import struct
import zlib
from pathlib import Path

import numpy as np

from hand_eye_calib.errors import InputError

_MAGIC = b"hand_eye_calib journal 1\n"
_HEADER = struct.Struct("<cII")  # kind, payload length, checksum of kind and payload
_POSE = struct.Struct("<Bq7d")
_CHECKPOINT, _POSE_KIND, _FRAME = b"C", b"P", b"F"
_STREAMS = ("parent", "child")

# No payload is longer than this; a damaged length is recognised before anything is allocated for
# it.
_LONGEST_PAYLOAD = 1 << 30


class JournalWriter:
    """Writes one session into a directory.

    Parameters
    ----------
    directory : path
        Made if it does not exist. Segments that are there already are replaced by this session's.
    checkpoint : dict of str to arrays
        The engine's state to start from
        (:meth:`hand_eye_calib.engine.calibrator.Calibrator.state`).
    segment_bytes : int
        Bytes since the checkpoint at which :attr:`is_full` asks for a new one.

    Raises
    ------
    OSError
        Here and in all methods, where the disk does not take it.
    """

    def __init__(self, directory, checkpoint, segment_bytes=16_000_000):
        self._directory = Path(directory)
        self._directory.mkdir(parents=True, exist_ok=True)
        self._segment_bytes = segment_bytes
        self._file = None
        self._pending = bytearray()
        self.rotate(checkpoint)

    @property
    def is_full(self):
        """Whether it is time to :meth:`rotate`."""
        return self._written + len(self._pending) >= self._segment_bytes

    def add_pose(self, stream, stamp_ns, position, quat_xyzw):
        """Note a pose; it reaches the disk with the next :meth:`flush`."""
        self._add(_POSE_KIND, _POSE.pack(_STREAMS.index(stream), stamp_ns, *position, *quat_xyzw))

    def set_frame(self, stream, sensor_frame):
        """Note a stream's sensor frame."""
        self._add(_FRAME, bytes([_STREAMS.index(stream)]) + sensor_frame.encode())

    def flush(self):
        """Hand all that was noted to the operating system: from then on it survives the end of this
        process.
        """
        if self._pending:
            # Unbuffered: a short write leaves a torn record at the end, which the next flush would
            # bury.
            taken = self._file.write(self._pending)
            if taken != len(self._pending):
                raise OSError(f"only {taken} of {len(self._pending)} bytes were written")
            self._written += taken
            self._pending.clear()

    def rotate(self, checkpoint):
        """Start a new segment from a checkpoint, and remove the old ones once it is safely on disk."""
        old = _segments(self._directory)
        number = int(old[-1].stem.rpartition("-")[2]) + 1 if old else 1
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
        self._written, self._pending = 0, bytearray()
        for segment in old:
            segment.unlink(missing_ok=True)

    def close(self):
        """Flush and close."""
        if self._file is not None:
            try:
                self.flush()
            finally:
                self._file.close()
                self._file = None

    def _add(self, kind, payload):
        self._pending += _record(kind, payload)


def has_session(directory):
    """Whether a directory holds a journal."""
    return bool(_segments(Path(directory)))


def keep_aside(directory):
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


def count_poses(directory):
    """Poses in the session that a directory holds; None where it is damaged.

    Raises
    ------
    OSError
    """
    try:
        checkpoint, events, _ = read_journal(directory)
    except InputError:
        return None
    return sum(int(checkpoint[f"{stream}.statistics"][0]) for stream in _STREAMS) + sum(
        event[0] == "pose" for event in events
    )


def read_journal(directory):
    """The session a directory holds.

    Parameters
    ----------
    directory : path

    Returns
    -------
    checkpoint : dict of str to arrays
    events : list of tuple
        ("pose", stream, stamp_ns, position, quat_xyzw) and ("frame", stream, name), in the order
        they came in.
    lost_bytes : int
        Bytes at the end that were not whole; 0 after a clean end.

    Raises
    ------
    InputError
        Where there is no journal, or none of its segments begins with a whole checkpoint.
    """
    directory = Path(directory)
    segments = _segments(directory)
    if not segments:
        raise InputError(f"no session journal in {directory}")
    for segment in reversed(segments):
        try:
            data = segment.read_bytes()
        except OSError as error:
            raise InputError(
                f"cannot read the session journal {segment}: {error.strerror}"
            ) from None
        records, end = _whole_records(data)
        if records and records[0][0] == _CHECKPOINT:
            return (
                _unpack_checkpoint(records[0][1]),
                [_event(*record) for record in records[1:]],
                len(data) - end,
            )
    raise InputError(
        f"the session journal {segments[-1]} is damaged from its first byte; move it away to start anew"
    )


def _segments(directory):
    return sorted(
        directory.glob("session-*.journal"), key=lambda path: int(path.stem.rpartition("-")[2])
    )


def _record(kind, payload):
    return _HEADER.pack(kind, len(payload), zlib.crc32(payload, zlib.crc32(kind))) + payload


def _whole_records(data):
    """Records up to the first that is cut off or damaged, and where that begins."""
    records, position = [], len(_MAGIC)
    if data[:position] != _MAGIC:
        return records, 0
    while position + _HEADER.size <= len(data):
        kind, length, checksum = _HEADER.unpack_from(data, position)
        start = position + _HEADER.size
        payload = data[start : start + length]
        if (
            length > _LONGEST_PAYLOAD
            or len(payload) < length
            or zlib.crc32(payload, zlib.crc32(kind)) != checksum
        ):
            break
        records.append((kind, payload))
        position = start + length
    return records, position


def _event(kind, payload):
    if kind == _POSE_KIND:
        stream, stamp_ns, *pose = _POSE.unpack(payload)
        return "pose", _STREAMS[stream], stamp_ns, tuple(pose[:3]), tuple(pose[3:])
    if kind == _FRAME:
        return "frame", _STREAMS[payload[0]], payload[1:].decode()
    raise InputError(
        f"the session journal has a record of unknown kind {kind!r}; it is of a newer version of this program"
    )


def _pack_checkpoint(checkpoint):
    packed = io.BytesIO()
    np.savez(packed, **checkpoint)
    return packed.getvalue()


def _unpack_checkpoint(payload):
    with np.load(io.BytesIO(payload), allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}
