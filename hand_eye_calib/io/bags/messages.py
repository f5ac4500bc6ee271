"""Stamps, frames and poses of ROS messages, unpacked from their bytes.

All types of stamped poses begin with the same bytes: a ``std_msgs/Header``, for some types the
sensor's frame, then seven doubles. Only those are unpacked. This takes a small part of the time of
a whole message and needs no type definitions. Messages that differ only in their values are
unpacked together.
"""

import math
import struct
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.errors import printable
from hand_eye_calib.io.limits import LONGEST_NAME

# Whether a message carries the sensor's frame, a string, between header and pose.
POSE_TYPES = {
    "nav_msgs/msg/Odometry": True,
    "geometry_msgs/msg/PoseStamped": False,
    "geometry_msgs/msg/PoseWithCovarianceStamped": False,
    "geometry_msgs/msg/TransformStamped": True,
}
PATH_TYPE = "nav_msgs/msg/Path"
IMU_TYPE, FIX_TYPE = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
POINT_TYPE = "geometry_msgs/msg/PointStamped"
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

# What unpacking bytes that are not a message of its type may raise.
MALFORMED = (struct.error, ValueError)

Buffer = bytes | memoryview

_NS_PER_S = 1_000_000_000
_POSE_SIZE = 7 * 8


class PoseFields(NamedTuple):
    """The unpacked part of one message.

    Attributes
    ----------
    stamp_ns : int
    world_frame : str
    sensor_frame : str or None
        None if the type has no place for it.
    position : list of 3 floats
        m.
    quat_xyzw : list of 4 floats
    """

    stamp_ns: int
    world_frame: str
    sensor_frame: str | None
    position: list[float]
    quat_xyzw: list[float]


class _Packing(NamedTuple):
    """How the parts of a message are packed: byte order, alignment and formats."""

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


def _packing_of(data: Buffer, is_ros1: bool) -> _Packing:
    if is_ros1:
        return _ROS1
    packing = _CDR.get(bytes(data[:2]))
    if packing is None:
        raise ValueError(f"expected plain CDR, found encoding 0x{bytes(data[:2]).hex()}")
    return packing


class _Cursor:
    """Reads the parts of a message one after the other."""

    def __init__(self, data: Buffer, is_ros1: bool) -> None:
        self.packing = _packing_of(data, is_ros1)
        self.data = data
        self.position = _START if not is_ros1 else 0

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

    def doubles(self, count: int) -> list[float]:
        """Read numbers."""
        self._align(8)
        format_ = f"{self.packing.order}{count}d"
        values = struct.unpack_from(format_, self.data, self.position)
        self.position += 8 * count
        return list(values)

    def fix_status(self) -> int:
        """Read a NavSatStatus; negative without a fix."""
        (status,) = struct.unpack_from("b", self.data, self.position)
        self.position += 1
        self._align(2)
        self.position += 2
        return int(status)

    def pose(self) -> tuple[list[float], list[float]]:
        """Read position and quaternion."""
        self._align(8)
        values = self.packing.pose.unpack_from(self.data, self.position)
        self.position += _POSE_SIZE
        return list(values[:3]), list(values[3:])


def unpack_pose(data: Buffer, message_type: str, is_ros1: bool) -> PoseFields:
    """Unpack a message of one of POSE_TYPES.

    Raises
    ------
    struct.error, ValueError
        If the bytes are not such a message.
    """
    return _unpack_pose(_Cursor(data, is_ros1), message_type)


def _unpack_pose(cursor: _Cursor, message_type: str) -> PoseFields:
    stamp_ns, world_frame = cursor.header()
    sensor_frame = cursor.name() if POSE_TYPES[message_type] else None
    return PoseFields(stamp_ns, world_frame, sensor_frame, *cursor.pose())


def unpack_stamp_ns(data: Buffer) -> int:
    """Unpack the stamp of a message in CDR that begins with a header.

    Raises
    ------
    struct.error, ValueError
        If the bytes are not such a message.
    """
    return _Cursor(data, is_ros1=False).stamp_ns()


class PoseColumns(NamedTuple):
    """The unpacked part of N messages in columns.

    Attributes
    ----------
    stamps_ns : (N,) int64 array
    world_frames : list of str
    sensor_frames : list of str or None
    poses : (N, 7) array
        x y z qx qy qz qw.
    """

    stamps_ns: IntArray
    world_frames: list[str]
    sensor_frames: Sequence[str | None]
    poses: FloatArray


class MalformedMessage(ValueError):
    """One of many messages cannot be unpacked: its index, and why."""

    def __init__(self, index: int, reason: Exception) -> None:
        super().__init__(str(reason))
        self.index = index


def unpack_poses(messages: Sequence[Buffer], message_type: str, is_ros1: bool) -> PoseColumns:
    """Unpack many messages of one type, together if they differ only in stamps and poses.

    Parameters
    ----------
    messages : list of bytes-like
        At least one.
    message_type : str
        One of POSE_TYPES.
    is_ros1 : bool

    Returns
    -------
    PoseColumns

    Raises
    ------
    MalformedMessage
        At the first that is not such a message.
    """
    try:
        first = _Cursor(messages[0], is_ros1)
        fields = _unpack_pose(first, message_type)
    except MALFORMED as error:
        raise MalformedMessage(0, error) from error
    size = len(messages[0])
    if all(len(data) == size for data in messages):
        bytes_of = np.frombuffer(b"".join(messages), dtype=np.uint8).reshape(-1, size)
        if (values := _unpack_together(bytes_of, first)) is not None:
            count = len(messages)
            return PoseColumns(
                values[0], [fields.world_frame] * count, [fields.sensor_frame] * count, values[1]
            )
    return _unpack_singly(messages, message_type, is_ros1)


def _unpack_together(bytes_of: np.ndarray, first: _Cursor) -> tuple[IntArray, FloatArray] | None:
    """Stamps and poses of messages of one length (N, length); None if they differ in more."""
    packing, end = first.packing, first.position
    # Frames with their padding, and the encoding of CDR. The sequence number of ROS 1 may differ.
    frames = bytes_of[:, 12 : end - _POSE_SIZE]
    is_alike = (frames == frames[0]).all()
    if packing.is_aligned:
        is_alike &= (bytes_of[:, :2] == bytes_of[0, :2]).all()
    nanoseconds = np.ascontiguousarray(bytes_of[:, 8:12]).view(packing.order + "u4")[:, 0]
    if not is_alike or (nanoseconds >= _NS_PER_S).any():
        return None
    time = packing.order + ("i4" if packing.is_aligned else "u4")
    seconds = np.ascontiguousarray(bytes_of[:, 4:8]).view(time)[:, 0].astype(np.int64)
    poses = np.ascontiguousarray(bytes_of[:, end - _POSE_SIZE : end]).view(packing.order + "f8")
    return seconds * _NS_PER_S + nanoseconds, poses.astype(np.float64, copy=False)


def _unpack_singly(messages: Sequence[Buffer], message_type: str, is_ros1: bool) -> PoseColumns:
    rows = []
    for index, data in enumerate(messages):
        try:
            rows.append(unpack_pose(data, message_type, is_ros1))
        except MALFORMED as error:
            raise MalformedMessage(index, error) from error
    return PoseColumns(
        np.array([row.stamp_ns for row in rows], dtype=np.int64),
        [row.world_frame for row in rows],
        [row.sensor_frame for row in rows],
        np.array([[*row.position, *row.quat_xyzw] for row in rows], dtype=float),
    )


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
    count = _count(cursor, "poses")
    stamps_ns, poses = np.empty(count, dtype=np.int64), np.empty((count, 7))
    for index in range(count):
        start = cursor.position
        stamps_ns[index], _ = cursor.header()
        poses[index, :3], poses[index, 3:] = cursor.pose()
        # The first pose may be aligned otherwise than the rest. The second shows what the others
        # are like.
        if index == 1 and _unpack_rest(cursor, start, stamps_ns, poses):
            break
    return world_frame, stamps_ns, poses


def _count(cursor: _Cursor, what: str) -> int:
    """Read the length of an array of poses, each with a header."""
    count = cursor.length()
    if count > len(cursor.data) // _POSE_SIZE:
        raise ValueError(f"{count} {what} do not fit into {len(cursor.data)} bytes")
    return count


def _unpack_rest(cursor: _Cursor, start: int, stamps_ns: IntArray, poses: FloatArray) -> bool:
    """Unpack all but the first two poses of a path together; False if their lengths differ."""
    size, rest = cursor.position - start, len(stamps_ns) - 2
    if len(cursor.data) - cursor.position < rest * size:
        return False
    block = np.frombuffer(
        cursor.data, dtype=np.uint8, offset=start, count=(rest + 1) * size
    ).reshape(-1, size)
    stamp = 0 if cursor.packing.is_aligned else 4
    frames = block[:, stamp + 8 : size - _POSE_SIZE]
    if (frames != frames[0]).any():
        return False
    order = cursor.packing.order
    times = np.ascontiguousarray(block[1:, stamp : stamp + 8]).view(order + "u4").astype(np.int64)
    if (times[:, 1] >= _NS_PER_S).any():
        return False
    stamps_ns[2:] = times[:, 0] * _NS_PER_S + times[:, 1]
    poses[2:] = np.ascontiguousarray(block[1:, size - _POSE_SIZE :]).view(order + "f8")
    return True


def unpack_transforms(data: Buffer, is_ros1: bool) -> Iterator[PoseFields]:
    """Iterate over the transforms of a tf message, frames without a leading slash.

    Raises
    ------
    struct.error, ValueError
        If the bytes are not such a message.
    """
    cursor = _Cursor(data, is_ros1)
    for _ in range(_count(cursor, "transforms")):
        stamp_ns, world_frame = cursor.header()
        frames = world_frame.lstrip("/"), cursor.name().lstrip("/")
        yield PoseFields(stamp_ns, *frames, *cursor.pose())


class PartFields(NamedTuple):
    """The unpacked part of a message that is no pose: stamp, frame and values."""

    stamp_ns: int
    frame: str
    values: list[float]


def unpack_part(data: Buffer, message_type: str, is_ros1: bool) -> PartFields:
    """Unpack a message of a part of a pose.

    An Imu has orientation, quaternion with the scalar last, and angular rates (rad/s): NaN for what
    its covariance says it does not have. A NavSatFix has latitude, longitude (deg) and height (m):
    NaN without a fix. A PointStamped has a position (m).

    Raises
    ------
    struct.error, ValueError
        If the bytes are not such a message.
    """
    cursor = _Cursor(data, is_ros1)
    return PartFields(*cursor.header(), _VALUES[message_type](cursor))


def _of_imu(cursor: _Cursor) -> list[float]:
    values = cursor.doubles(4 + 9 + 3 + 9)
    orientation, rates = values[:4], values[13:16]
    if values[4] == -1.0:
        orientation = [math.nan] * 4
    if values[16] == -1.0:
        rates = [math.nan] * 3
    return orientation + rates


def _of_fix(cursor: _Cursor) -> list[float]:
    has_fix = cursor.fix_status() >= 0
    values = cursor.doubles(3)
    return values if has_fix else [math.nan] * 3


def _of_point(cursor: _Cursor) -> list[float]:
    return cursor.doubles(3)


_VALUES = {IMU_TYPE: _of_imu, FIX_TYPE: _of_fix, POINT_TYPE: _of_point}
