"""What is read of ROS messages, straight from their bytes: stamps, frames and poses.

All types of stamped poses begin with the same bytes: a ``std_msgs/Header``, for some the sensor's
frame, then seven doubles. Only those are unpacked, which takes a small part of the time of a whole
message and needs no type definitions; and many messages that differ in nothing but their numbers
are unpacked at once.
"""

import struct
from typing import NamedTuple

import numpy as np

# Whether a message carries the sensor's frame, a string, between header and pose.
POSE_TYPES = {
    "nav_msgs/msg/Odometry": True,
    "geometry_msgs/msg/PoseStamped": False,
    "geometry_msgs/msg/PoseWithCovarianceStamped": False,
    "geometry_msgs/msg/TransformStamped": True,
}
PATH_TYPE = "nav_msgs/msg/Path"
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

# What unpacking bytes that are not a message of its type may raise.
MALFORMED = (struct.error, ValueError)

_NS_PER_S = 1_000_000_000
_POSE_SIZE = 7 * 8


class PoseFields(NamedTuple):
    """What is unpacked of one message; the frame of the sensor is None where the type has no place
    for it.
    """

    stamp_ns: int
    world_frame: str
    sensor_frame: str | None
    position: list
    quat_xyzw: list


class _Packing(NamedTuple):
    """How the parts of a message are packed: formats, whether they are aligned, and where the stamp
    is.
    """

    order: str
    is_aligned: bool
    time: struct.Struct
    length: struct.Struct
    pose: struct.Struct


def _packing(order, is_aligned, time):
    return _Packing(order, is_aligned, *(struct.Struct(order + part) for part in (time, "I", "7d")))


_CDR = {b"\x00\x00": _packing(">", True, "iI"), b"\x00\x01": _packing("<", True, "iI")}
_ROS1 = _packing("<", False, "II")

# CDR begins with 4 bytes that say how it is encoded, and alignment counts from there; a ROS 1
# header with 4 bytes of sequence number.
_START = 4


def _packing_of(data, is_ros1):
    if is_ros1:
        return _ROS1
    packing = _CDR.get(bytes(data[:2]))
    if packing is None:
        raise ValueError(f"expected plain CDR, found encoding 0x{bytes(data[:2]).hex()}")
    return packing


class _Cursor:
    """Reads the parts of a message one after the other."""

    def __init__(self, data, is_ros1):
        self.packing = _packing_of(data, is_ros1)
        self.data = data
        self.position = _START if not is_ros1 else 0

    def _align(self, size):
        if self.packing.is_aligned:
            self.position += (_START - self.position) % size

    def number(self):
        """An unsigned integer of 4 bytes."""
        self._align(4)
        (value,) = self.packing.length.unpack_from(self.data, self.position)
        self.position += 4
        return value

    def stamp_ns(self):
        """A stamp."""
        self._align(4)
        seconds, nanoseconds = self.packing.time.unpack_from(self.data, self.position)
        if nanoseconds >= _NS_PER_S:
            raise ValueError(f"a stamp has {nanoseconds} nanoseconds, more than a second")
        self.position += 8
        return seconds * _NS_PER_S + nanoseconds

    def text(self):
        """A string; in CDR it ends in a zero byte."""
        length = self.number()
        start, self.position = self.position, self.position + length
        if self.position > len(self.data):
            raise ValueError("a text does not fit into the message")
        end = self.position - self.packing.is_aligned
        return str(self.data[start : max(end, start)], "utf-8")

    def header(self):
        """Stamp and frame."""
        if not self.packing.is_aligned:
            self.number()  # sequence number
        return self.stamp_ns(), self.text()

    def pose(self):
        """Seven doubles."""
        self._align(8)
        values = self.packing.pose.unpack_from(self.data, self.position)
        self.position += _POSE_SIZE
        return list(values[:3]), list(values[3:])


def unpack_pose(data, message_type, is_ros1):
    """PoseFields of a message of one of POSE_TYPES.

    Raises
    ------
    struct.error, ValueError
        Where the bytes are not such a message.
    """
    return _unpack_pose(_Cursor(data, is_ros1), message_type)


def _unpack_pose(cursor, message_type):
    stamp_ns, world_frame = cursor.header()
    sensor_frame = cursor.text() if POSE_TYPES[message_type] else None
    return PoseFields(stamp_ns, world_frame, sensor_frame, *cursor.pose())


class PoseColumns(NamedTuple):
    """What is unpacked of many messages: N stamps and frames, and x y z qx qy qz qw as an (N, 7)
    array.
    """

    stamps_ns: np.ndarray
    world_frames: list
    sensor_frames: list
    numbers: np.ndarray


def unpack_poses(messages, message_type, is_ros1):
    """Many messages of one type, at once as far as they are alike.

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
    size, end, count = len(messages[0]), first.position, len(messages)
    if any(len(data) != size for data in messages):
        return _one_by_one(messages, message_type, is_ros1)
    block = np.frombuffer(b"".join(messages), dtype=np.uint8).reshape(count, size)
    # Frames and the padding after them, and how CDR is encoded; the sequence number of ROS 1 may be
    # any.
    is_alike = (block[:, 12 : end - _POSE_SIZE] == block[0, 12 : end - _POSE_SIZE]).all()
    is_alike = is_alike and (is_ros1 or (block[:, :2] == block[0, :2]).all())
    order, time = first.packing.order, "u4" if is_ros1 else "i4"
    nanoseconds = np.ascontiguousarray(block[:, 8:12]).view(order + "u4")[:, 0]
    if not is_alike or (nanoseconds >= _NS_PER_S).any():
        return _one_by_one(messages, message_type, is_ros1)
    seconds = np.ascontiguousarray(block[:, 4:8]).view(order + time)[:, 0].astype(np.int64)
    numbers = (
        np.ascontiguousarray(block[:, end - _POSE_SIZE : end])
        .view(order + "f8")
        .astype(float, copy=False)
    )
    return PoseColumns(
        seconds * _NS_PER_S + nanoseconds,
        [fields.world_frame] * count,
        [fields.sensor_frame] * count,
        numbers,
    )


class MalformedMessage(ValueError):
    """One of many messages cannot be unpacked: its index, and why."""

    def __init__(self, index, reason):
        super().__init__(str(reason))
        self.index = index


def _one_by_one(messages, message_type, is_ros1):
    rows = []
    for index, data in enumerate(messages):
        try:
            rows.append(unpack_pose(data, message_type, is_ros1))
        except MALFORMED as error:
            raise MalformedMessage(index, error) from error
    numbers = np.array([[*row.position, *row.quat_xyzw] for row in rows], dtype=float)
    stamps_ns = np.array([row.stamp_ns for row in rows], dtype=np.int64)
    return PoseColumns(
        stamps_ns, [row.world_frame for row in rows], [row.sensor_frame for row in rows], numbers
    )


def unpack_path(data, is_ros1):
    """World frame, stamps and numbers of a nav_msgs/Path.

    Returns
    -------
    world_frame : str
    stamps_ns : (N,) int64 array
    numbers : (N, 7) array
        x y z qx qy qz qw.

    Raises
    ------
    struct.error, ValueError
        Where the bytes are not such a message.
    """
    cursor = _Cursor(data, is_ros1)
    _, world_frame = cursor.header()
    count = cursor.number()
    if count > len(data) // _POSE_SIZE:
        raise ValueError(f"{count} poses do not fit into {len(data)} bytes")
    stamps_ns, numbers = np.empty(count, dtype=np.int64), np.empty((count, 7))
    for index in range(count):
        start = cursor.position
        stamps_ns[index], _ = cursor.header()
        numbers[index, :3], numbers[index, 3:] = cursor.pose()
        # The first pose may be aligned otherwise than the rest; the second tells what the others
        # are like.
        if index == 1 and _unpack_alike(cursor, start, stamps_ns, numbers):
            break
    return world_frame, stamps_ns, numbers


def _unpack_alike(cursor, start, stamps_ns, numbers):
    """All but the first two poses of a path at once; False where their frames differ, so that they
    are not of one length.
    """
    size, rest = cursor.position - start, len(stamps_ns) - 2
    if len(cursor.data) - cursor.position < rest * size:
        return False
    block = np.frombuffer(
        cursor.data, dtype=np.uint8, offset=start, count=(rest + 1) * size
    ).reshape(-1, size)
    stamp = 0 if cursor.packing.is_aligned else 4
    if (block[:, stamp + 8 : size - _POSE_SIZE] != block[0, stamp + 8 : size - _POSE_SIZE]).any():
        return False
    order = cursor.packing.order
    times = np.ascontiguousarray(block[1:, stamp : stamp + 8]).view(order + "u4").astype(np.int64)
    if (times[:, 1] >= _NS_PER_S).any():
        return False
    stamps_ns[2:] = times[:, 0] * _NS_PER_S + times[:, 1]
    numbers[2:] = np.ascontiguousarray(block[1:, size - _POSE_SIZE :]).view(order + "f8")
    return True


def unpack_transforms(data, is_ros1):
    """PoseFields of every transform of a tf message, frames without a leading slash.

    Raises
    ------
    struct.error, ValueError
        Where the bytes are not such a message.
    """
    cursor = _Cursor(data, is_ros1)
    count = cursor.number()
    if count > len(data) // _POSE_SIZE:
        raise ValueError(f"{count} transforms do not fit into {len(data)} bytes")
    transforms = []
    for _ in range(count):
        stamp_ns, world_frame = cursor.header()
        sensor_frame = cursor.text()
        transforms.append(
            PoseFields(stamp_ns, world_frame.lstrip("/"), sensor_frame.lstrip("/"), *cursor.pose())
        )
    return transforms
