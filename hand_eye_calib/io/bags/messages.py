"""Stamps, frames and values of ROS messages, unpacked from their bytes.

All types that are read begin with the same bytes: a ``std_msgs/Header``, for some types the
sensor's frame, then doubles. Only those are unpacked. This takes a small part of the time of a
whole message and needs no type definitions. Poses that differ only in their values are unpacked
together.
"""

import math
import struct
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.errors import printable
from hand_eye_calib.io.bags.poses import PoseColumns, PoseFields
from hand_eye_calib.io.limits import LONGEST_NAME

# What unpacking bytes that are not a message of its type may raise.
MALFORMED = (struct.error, ValueError)

Buffer = bytes | memoryview

_NS_PER_S = 1_000_000_000
_POSE_SIZE = 7 * 8


class MalformedMessage(ValueError):
    """One of many messages cannot be unpacked: its index, and why."""

    def __init__(self, index: int, reason: Exception) -> None:
        super().__init__(str(reason))
        self.index = index


# ---- bytes


class _Packing(NamedTuple):
    """How the parts of a message are packed: byte order, alignment, and formats of a stamp and of a
    length.
    """

    order: str
    is_aligned: bool
    time: struct.Struct
    length: struct.Struct
    pose: struct.Struct


def _packing(order: str, is_aligned: bool, time: str) -> _Packing:
    return _Packing(order, is_aligned, *(struct.Struct(order + part) for part in (time, "I", "7d")))


_CDR = {b"\x00\x00": _packing(">", True, "iI"), b"\x00\x01": _packing("<", True, "iI")}
_ROS1 = _packing("<", False, "II")

# CDR begins with 4 bytes that say how it is encoded, and alignment counts from there. A ROS 1
# header begins with 4 bytes of sequence number.
_START = 4


class _Cursor:
    """Reads the parts of a message one after the other."""

    def __init__(self, data: Buffer, is_ros1: bool) -> None:
        found = _ROS1 if is_ros1 else _CDR.get(bytes(data[:2]))
        if found is None:
            raise ValueError(f"expected plain CDR, found encoding 0x{bytes(data[:2]).hex()}")
        self.packing, self.data = found, data
        self.position = 0 if is_ros1 else _START

    def _align(self, size: int) -> None:
        if self.packing.is_aligned:
            self.position += (_START - self.position) % size

    def length(self) -> int:
        """Read an unsigned integer of 4 bytes."""
        self._align(4)
        (value,) = self.packing.length.unpack_from(self.data, self.position)
        self.position += 4
        return int(value)

    def stamp_ns(self) -> int:
        """Read a stamp."""
        self._align(4)
        seconds, nanoseconds = self.packing.time.unpack_from(self.data, self.position)
        if nanoseconds >= _NS_PER_S:
            raise ValueError(f"a stamp has {nanoseconds} nanoseconds, more than a second")
        self.position += 8
        return int(seconds * _NS_PER_S + nanoseconds)

    def name(self) -> str:
        """Read a string; in CDR it ends in a zero byte. Control characters are escaped."""
        length = self.length()
        start, self.position = self.position, self.position + length
        if self.position > len(self.data):
            raise ValueError("a text does not fit into the message")
        if length > LONGEST_NAME:
            raise ValueError(f"the name of a frame has {length} bytes, more than {LONGEST_NAME}")
        end = self.position - self.packing.is_aligned
        return printable(str(self.data[start : max(end, start)], "utf-8"))

    def header(self) -> tuple[int, str]:
        """Read stamp and frame."""
        if not self.packing.is_aligned:
            self.length()  # sequence number
        return self.stamp_ns(), self.name()

    def count(self, what: str) -> int:
        """Read the length of an array of poses, each with a header."""
        count = self.length()
        if count > len(self.data) // _POSE_SIZE:
            raise ValueError(f"{count} {what} do not fit into {len(self.data)} bytes")
        return count

    def doubles(self, count: int) -> list[float]:
        """Read numbers."""
        self._align(8)
        format_ = f"{self.packing.order}{count}d"
        values = struct.unpack_from(format_, self.data, self.position)
        self.position += 8 * count
        return list(values)

    def pose(self) -> list[float]:
        """Read position and quaternion."""
        self._align(8)
        values = self.packing.pose.unpack_from(self.data, self.position)
        self.position += _POSE_SIZE
        return list(values)

    def imu(self) -> list[float]:
        """Read orientation, scalar last, and angular rates (rad/s) of an Imu: NaN for what its
        covariance says it does not have.
        """
        values = self.doubles(4 + 9 + 3 + 9)
        orientation = [math.nan] * 4 if values[4] == -1.0 else values[:4]
        rates = [math.nan] * 3 if values[16] == -1.0 else values[13:16]
        return orientation + rates

    def fix(self) -> list[float]:
        """Read latitude, longitude (deg) and height (m) of a NavSatFix: NaN without a fix."""
        (status,) = struct.unpack_from("b", self.data, self.position)
        self.position += 1
        self._align(2)
        self.position += 2
        values = self.doubles(3)
        return values if status >= 0 else [math.nan] * 3

    def point(self) -> list[float]:
        """Read a position (m)."""
        return self.doubles(3)


# ---- types of messages


class MessageType(NamedTuple):
    """A type of messages with a header that are read.

    Attributes
    ----------
    name : str
    measures : tuple of str
        What its messages can be read as, the usual first.
    has_child_frame : bool
        Whether the sensor's frame stands behind the header. Without it, the header's frame is that
        of the world, or for Imu and NavSatFix the sensor's.
    unpack : callable
        Reads the values that follow.
    """

    name: str
    measures: tuple[str, ...]
    has_child_frame: bool
    unpack: Callable[[_Cursor], list[float]]


OF_POSES = ("poses", "positions", "rotations")
IMU_TYPE, FIX_TYPE = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
POINT_TYPE = "geometry_msgs/msg/PointStamped"

# The likeliest first.
_ROWS = (
    MessageType("nav_msgs/msg/Odometry", OF_POSES, True, _Cursor.pose),
    MessageType("geometry_msgs/msg/PoseStamped", OF_POSES, False, _Cursor.pose),
    MessageType("geometry_msgs/msg/PoseWithCovarianceStamped", OF_POSES, False, _Cursor.pose),
    MessageType("geometry_msgs/msg/TransformStamped", OF_POSES, True, _Cursor.pose),
    MessageType(IMU_TYPE, ("rates", "rotations"), False, _Cursor.imu),
    MessageType(FIX_TYPE, ("positions",), False, _Cursor.fix),
    MessageType(POINT_TYPE, ("positions",), False, _Cursor.point),
)
MESSAGE_TYPES = {row.name: row for row in _ROWS}
#: Those that carry whole poses.
POSE_TYPES = tuple(row.name for row in _ROWS if "poses" in row.measures)
# Arrays of PoseStamped and of TransformStamped.
PATH_TYPE = "nav_msgs/msg/Path"
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
#: Types of topics that can be one of the two sensors.
SENSOR_TYPES = (*POSE_TYPES, PATH_TYPE, *(name for name in MESSAGE_TYPES if name not in POSE_TYPES))


# ---- unpacking


def unpack_stamp_ns(data: Buffer) -> int:
    """Unpack the stamp of a message in CDR that begins with a header.

    Raises
    ------
    struct.error, ValueError
        If the bytes are not such a message.
    """
    return _Cursor(data, is_ros1=False).stamp_ns()


def unpack_one(
    data: Buffer, message_type: str, is_ros1: bool
) -> tuple[int, str, str | None, list[float]]:
    """Unpack a message: stamp in ns, the header's frame, the sensor's behind it, and values.

    Raises
    ------
    struct.error, ValueError
        If the bytes are not such a message.
    """
    return _unpack_one(_Cursor(data, is_ros1), MESSAGE_TYPES[message_type])


def _unpack_one(cursor: _Cursor, row: MessageType) -> tuple[int, str, str | None, list[float]]:
    stamp_ns, frame = cursor.header()
    return stamp_ns, frame, cursor.name() if row.has_child_frame else None, row.unpack(cursor)


def unpack_poses(messages: Sequence[Buffer], message_type: str, is_ros1: bool) -> PoseColumns:
    """Unpack many messages of one type, poses together if they differ only in stamps and values.

    Parameters
    ----------
    messages : list of bytes-like
        At least one.
    message_type : str
        One of MESSAGE_TYPES.
    is_ros1 : bool

    Returns
    -------
    PoseColumns

    Raises
    ------
    MalformedMessage
        At the first that is not such a message.
    """
    row, size = MESSAGE_TYPES[message_type], len(messages[0])
    if message_type in POSE_TYPES and {*map(len, messages)} == {size}:
        try:
            first = _Cursor(messages[0], is_ros1)
            _, world_frame, sensor_frame, _ = _unpack_one(first, row)
        except MALFORMED as error:
            raise MalformedMessage(0, error) from error
        bytes_of = np.frombuffer(b"".join(messages), dtype=np.uint8).reshape(-1, size)
        # The sequence number of ROS 1 may differ, the encoding of CDR may not.
        is_alike = is_ros1 or bool((bytes_of[:, :2] == bytes_of[0, :2]).all())
        found = _unpack_together(bytes_of[:, _START : first.position], first.packing)
        if found is not None and is_alike:
            n = len(messages)
            return PoseColumns(found[0], [world_frame] * n, [sensor_frame] * n, found[1])
    found_rows = []
    for index, data in enumerate(messages):
        try:
            found_rows.append(_unpack_one(_Cursor(data, is_ros1), row))
        except MALFORMED as error:
            raise MalformedMessage(index, error) from error
    stamps_ns, frames, sensor_frames, values = zip(*found_rows, strict=True)
    return PoseColumns(
        np.array(stamps_ns, dtype=np.int64),
        list(frames),
        list(sensor_frames),
        np.array(values, dtype=float),
    )


def _unpack_together(bytes_of: np.ndarray, packing: _Packing) -> tuple[IntArray, FloatArray] | None:
    """Stamps and poses of rows of bytes (N, size) that begin with a stamp and end with a pose; None
    if what is between them, the frames, differs, or a stamp cannot be right.
    """
    frames = bytes_of[:, 8:-_POSE_SIZE]
    time = packing.order + ("i4" if packing.is_aligned else "u4")
    seconds = np.ascontiguousarray(bytes_of[:, :4]).view(time)[:, 0].astype(np.int64)
    nanoseconds = np.ascontiguousarray(bytes_of[:, 4:8]).view(packing.order + "u4")[:, 0]
    if (frames != frames[0]).any() or (nanoseconds >= _NS_PER_S).any():
        return None
    poses = np.ascontiguousarray(bytes_of[:, -_POSE_SIZE:]).view(packing.order + "f8")
    return seconds * _NS_PER_S + nanoseconds, poses.astype(np.float64, copy=False)


def unpack_path(data: Buffer, is_ros1: bool) -> tuple[str, IntArray, FloatArray]:
    """Unpack a nav_msgs/Path.

    Returns
    -------
    world_frame : str
    stamps_ns : (N,) int64 array
    poses : (N, 7) array
        x y z qx qy qz qw.

    Raises
    ------
    struct.error, ValueError
        If the bytes are not such a message.
    """
    cursor = _Cursor(data, is_ros1)
    _, world_frame = cursor.header()
    count = cursor.count("poses")
    stamps_ns, poses = np.empty(count, dtype=np.int64), np.empty((count, 7))
    for index in range(count):
        start = cursor.position
        stamps_ns[index], _ = cursor.header()
        poses[index] = cursor.pose()
        # The first pose may be aligned otherwise than the rest. The second shows what the others
        # are like.
        size = cursor.position - start
        if index == 1 and len(data) - start >= (count - 1) * size:
            rest = np.frombuffer(data, np.uint8, (count - 1) * size, start).reshape(-1, size)
            found = _unpack_together(rest[:, _START * is_ros1 :], cursor.packing)
            if found is not None:
                stamps_ns[1:], poses[1:] = found
                break
    return world_frame, stamps_ns, poses


def unpack_transforms(data: Buffer, is_ros1: bool) -> Iterator[PoseFields]:
    """Iterate over the transforms of a tf message, frames without a leading slash.

    Raises
    ------
    struct.error, ValueError
        If the bytes are not such a message.
    """
    cursor = _Cursor(data, is_ros1)
    for _ in range(cursor.count("transforms")):
        stamp_ns, world_frame = cursor.header()
        frames = world_frame.lstrip("/"), cursor.name().lstrip("/")
        values = cursor.pose()
        yield PoseFields(stamp_ns, *frames, values[:3], values[3:])
