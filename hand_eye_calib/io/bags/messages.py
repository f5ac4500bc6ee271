"""Stamps, frames and values of ROS messages, unpacked from their bytes.

All types that are read begin with the same bytes: a ``std_msgs/Header``, for some types the
sensor's frame, then what is measured. Only those are unpacked, which takes a small part of the time
of a whole message and needs no type definitions. A new type is a row in :data:`MESSAGE_TYPES`.
"""

import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.errors import ConfigError, InputError, printable
from hand_eye_calib.geometry.trajectory import RateIntegrator
from hand_eye_calib.io.bags.fields import FIELDS
from hand_eye_calib.io.bags.poses import PoseColumns, TwistIntegrator
from hand_eye_calib.io.geodetic import POLE_DEG, LocalOrigin, wrong_latitude
from hand_eye_calib.io.limits import LONGEST_NAME
from hand_eye_calib.io.transforms import PoseFields

# What unpacking bytes that are not a message of its type may raise.
MALFORMED = (struct.error, ValueError)

Buffer = bytes | memoryview

_NS_PER_S = 1_000_000_000
_POSE_SIZE = 7 * 8
# Of what is no pose, the part that is not measured: at the origin, level.
_NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class MalformedMessage(ValueError):
    """One of many messages cannot be unpacked: its index, and why."""

    def __init__(self, index: int, reason: Exception) -> None:
        super().__init__(str(reason))
        self.index = index


# ---- bytes


class _Packing(NamedTuple):
    """How the parts of a message are packed: byte order, alignment, and format of a stamp."""

    order: str
    is_aligned: bool
    time: str


_CDR = {b"\x00\x00": _Packing(">", True, "iI"), b"\x00\x01": _Packing("<", True, "iI")}
_ROS1 = _Packing("<", False, "II")

# CDR begins with 4 bytes that say how it is encoded, and alignment counts from there. A ROS 1
# header begins with 4 bytes of sequence number.
_START = 4


class Cursor:
    """Reads the parts of a message one after the other."""

    def __init__(self, data: Buffer, is_ros1: bool) -> None:
        found = _ROS1 if is_ros1 else _CDR.get(bytes(data[:2]))
        if found is None:
            raise ValueError(f"expected plain CDR, found encoding 0x{bytes(data[:2]).hex()}")
        self.packing, self.data = found, data
        self.position = 0 if is_ros1 else _START

    def _read(self, format_: str, size: int, alignment: int) -> tuple[float, ...]:
        if self.packing.is_aligned:
            self.position += (_START - self.position) % alignment
        values = struct.unpack_from(self.packing.order + format_, self.data, self.position)
        self.position += size
        return values

    def length(self) -> int:
        """Read an unsigned integer of 4 bytes."""
        return int(self._read("I", 4, 4)[0])

    def byte(self) -> int:
        """Read an unsigned byte."""
        return int(self._read("B", 1, 1)[0])

    def stamp_ns(self) -> int:
        """Read a stamp."""
        seconds, nanoseconds = map(int, self._read(self.packing.time, 8, 4))
        if nanoseconds >= _NS_PER_S:
            raise ValueError(f"a stamp has {nanoseconds} nanoseconds, more than a second")
        return seconds * _NS_PER_S + nanoseconds

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
        return list(self._read(f"{count}d", 8 * count, 8))

    def pose(self) -> list[float]:
        """Read position and quaternion."""
        return self.doubles(7)

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
        (status,) = self._read("b", 1, 1)
        self._read("H", 2, 2)
        values = self.doubles(3)
        return values if status >= 0 else [math.nan] * 3

    def geo_pose(self) -> list[float]:
        """Read latitude, longitude (deg), height (m) and quaternion."""
        return self.doubles(7)

    def twist(self) -> list[float]:
        """Read velocity (m/s) and angular velocity (rad/s)."""
        return self.doubles(6)

    def point(self) -> list[float]:
        """Read a position (m)."""
        return self.doubles(3)


# ---- types of messages


class MessageType(NamedTuple):
    """A type of messages with a header that are read.

    Attributes
    ----------
    name : str
    measures : mapping of str to slice
        What its messages can be read as, the usual first, and where it is in what is unpacked.
    has_child_frame : bool
        Whether the sensor's frame stands behind the header.
    unpack : callable
        Reads the values that follow.
    is_sensors : bool
        Whether the header's frame is the sensor's, not that of the world.
    is_geodetic : bool
        Whether positions are latitude and longitude (deg) and height (m).
    is_twist : bool
        Whether poses are integrated from velocities in the sensor's frame.
    """

    name: str
    measures: Mapping[str, slice]
    has_child_frame: bool
    unpack: Callable[[Cursor], list[float]]
    is_sensors: bool = False
    is_geodetic: bool = False
    is_twist: bool = False


_OF_POSES = {"poses": slice(7), "positions": slice(3), "rotations": slice(3, 7)}
_OF_IMU = {"rates": slice(4, 7), "rotations": slice(4)}
_OF_POINTS = {"positions": slice(3)}
_OF_TWIST = {"poses": slice(6), "rotations": slice(3, 6)}

# The likeliest first.
_ROWS = (
    MessageType("nav_msgs/msg/Odometry", _OF_POSES, True, Cursor.pose),
    MessageType("geometry_msgs/msg/PoseStamped", _OF_POSES, False, Cursor.pose),
    MessageType("geometry_msgs/msg/PoseWithCovarianceStamped", _OF_POSES, False, Cursor.pose),
    MessageType("geometry_msgs/msg/TransformStamped", _OF_POSES, True, Cursor.pose),
    MessageType("sensor_msgs/msg/Imu", _OF_IMU, False, Cursor.imu, is_sensors=True),
    MessageType("sensor_msgs/msg/NavSatFix", _OF_POINTS, False, Cursor.fix, True, True),
    MessageType("geometry_msgs/msg/PointStamped", _OF_POINTS, False, Cursor.point),
    MessageType(
        "geographic_msgs/msg/GeoPoseStamped", _OF_POSES, False, Cursor.geo_pose, is_geodetic=True
    ),
    *(
        MessageType(f"geometry_msgs/msg/{name}", _OF_TWIST, False, Cursor.twist, True, False, True)
        for name in ("TwistStamped", "TwistWithCovarianceStamped")
    ),
)
MESSAGE_TYPES = {row.name: row for row in _ROWS}
#: Those that carry whole poses.
POSE_TYPES = tuple(row.name for row in _ROWS if row.unpack is Cursor.pose)
# Arrays of PoseStamped and of TransformStamped.
PATH_TYPE = "nav_msgs/msg/Path"
POINTS_TYPE = "sensor_msgs/msg/PointCloud2"
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
#: Types of topics that can be one of the two sensors.
SENSOR_TYPES = (
    *POSE_TYPES,
    PATH_TYPE,
    *(name for name in MESSAGE_TYPES if name not in POSE_TYPES),
    *FIELDS,
    POINTS_TYPE,
)


def measured_as(message_type: str, wanted: str, source: object) -> str:
    """What messages of a type are read as: what is wanted, or the usual for "auto".

    Raises
    ------
    ConfigError
        If they cannot be read as that.
    """
    row = MESSAGE_TYPES.get(message_type)
    possible = [*(row.measures if row else _OF_POSES)]
    if wanted == "auto":
        return possible[0]
    if wanted not in possible:
        raise ConfigError(
            f"{source} has messages of type {message_type or 'tf2_msgs/msg/TFMessage'}, which "
            f"measure {' or '.join(possible)}; asked for are {wanted}"
        )
    return wanted


# ---- unpacking


def unpack_stamp_ns(data: Buffer) -> int:
    """Unpack the stamp of a message in CDR that begins with a header.

    Raises
    ------
    struct.error, ValueError
        If the bytes are not such a message.
    """
    return Cursor(data, is_ros1=False).stamp_ns()


def _unpack(cursor: Cursor, row: MessageType) -> tuple[int, str, str | None, list[float]]:
    """Stamp in ns, the header's frame, the sensor's behind it, and values."""
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
    is_alike = len(messages) > 1 and {*map(len, messages)} == {size}
    if is_alike and message_type in POSE_TYPES:
        try:
            first = Cursor(messages[0], is_ros1)
            _, world_frame, sensor_frame, _ = _unpack(first, row)
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
            found_rows.append(_unpack(Cursor(data, is_ros1), row))
        except MALFORMED as error:
            raise MalformedMessage(index, error) from error
    stamps_ns, frames, sensor_frames, values = zip(*found_rows, strict=True)
    return PoseColumns(
        np.array(stamps_ns, dtype=np.int64), [*frames], [*sensor_frames], np.array(values)
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
    cursor = Cursor(data, is_ros1)
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
    cursor = Cursor(data, is_ros1)
    for _ in range(cursor.count("transforms")):
        stamp_ns, world_frame = cursor.header()
        frames = world_frame.lstrip("/"), cursor.name().lstrip("/")
        values = cursor.pose()
        yield PoseFields(stamp_ns, *frames, values[:3], values[3:])


def frames_in(data: Buffer, message_type: str, is_ros1: bool) -> set[str]:
    """The frames of a message of SENSOR_TYPES or TF_TYPES: ``world:sensor`` as far as it says.

    Raises
    ------
    struct.error, ValueError
        If the bytes are not such a message.
    """
    if message_type in TF_TYPES:
        found = unpack_transforms(data, is_ros1)
        return {f"{each.world_frame}:{each.sensor_frame}" for each in found}
    cursor = Cursor(data, is_ros1)
    _, frame = cursor.header()
    row = MESSAGE_TYPES.get(message_type)
    sensor_frame = cursor.name() if row and row.has_child_frame else ""
    return {":".join(filter(None, (frame, sensor_frame)))}


# ---- what the messages of a topic measure


# What a row that is not finite lacks.
_LACKS = {
    "poses": "finite values",
    "positions": "fix",
    "rotations": "orientation",
    "rates": "angular rates",
}


class MessageReader:
    """Unpacks the messages of one topic, in their order, as poses: of what is no pose, the other
    part means nothing (level positions, rotations at the origin).

    Parameters
    ----------
    message_type, measures : str
        As of :func:`measured_as`.
    origin : LocalOrigin, optional
        Of latitudes and longitudes; the first one read by default.

    Attributes
    ----------
    n_left_out : int
        Messages without a fix or an orientation.
    """

    def __init__(self, message_type: str, measures: str, origin: LocalOrigin | None = None) -> None:
        self._row, self._measures = MESSAGE_TYPES[message_type], measures
        self._integrator, self._twists = RateIntegrator(), TwistIntegrator()
        self._origin = origin or LocalOrigin()
        self.n_left_out = 0

    def columns(self, messages: Sequence[Buffer], is_ros1: bool) -> tuple[PoseColumns, BoolArray]:
        """The next messages, and which of them have what is measured; the others are not finite.

        Raises
        ------
        MalformedMessage
            At the first that cannot be unpacked.
        InputError
            At the first latitude beyond 90 deg; its attribute ``index`` has the row.
        """
        columns = unpack_poses(messages, self._row.name, is_ros1)
        is_pose = self._measures == "poses" and not self._row.is_twist
        if is_pose and not self._row.is_geodetic:
            return columns, np.ones(len(messages), dtype=bool)
        values = columns.poses[:, self._row.measures[self._measures]]
        is_usable = np.asarray(np.isfinite(values).all(axis=1), dtype=bool)
        self.n_left_out += int((~is_usable).sum())
        poses = np.tile(_NOTHING, (len(values), 1))
        if is_usable.any():
            parts = {"positions": slice(3), "poses": slice(7)}
            part = parts.get(self._measures, slice(3, 7))
            poses[is_usable, part] = self._measured(columns.stamps_ns, values, is_usable)
        poses[~is_usable] = np.nan
        columns = columns._replace(poses=poses)
        if self._row.is_sensors:
            frames = columns.world_frames
            columns = columns._replace(world_frames=[""] * len(poses), sensor_frames=frames)
        return columns, is_usable

    def _measured(self, stamps_ns: IntArray, values: FloatArray, rows: BoolArray) -> FloatArray:
        """Positions (N, 3), quaternions (N, 4) or both (N, 7) of what was read in some rows."""
        if self._row.is_twist:
            if self._measures == "poses":
                return self._twists.poses(stamps_ns[rows], values[rows])
            return self._integrator.quats_xyzw(stamps_ns[rows], values[rows])
        if self._measures == "rates":
            return self._integrator.quats_xyzw(stamps_ns[rows], values[rows])
        if not self._row.is_geodetic or self._measures == "rotations":
            return values[rows]
        beyond = np.flatnonzero(rows & (np.abs(values[:, 0]) > POLE_DEG))
        if len(beyond):
            error = InputError(wrong_latitude(*values[beyond[0], :2]))
            error.index = int(beyond[0])  # type: ignore[attr-defined]
            raise error
        lat, lon = np.radians(values[rows, :2]).T
        positions = self._origin.local(lat, lon, values[rows, 2])
        return np.c_[positions, values[rows, 3:]]

    def __call__(self, data: Buffer) -> PoseFields:
        """The next message, in CDR, as it arrives.

        Raises
        ------
        InputError
            If it cannot be unpacked, or lacks what is measured.
        """
        try:
            if self._row.name in POSE_TYPES and self._measures == "poses":
                stamp_ns, world, sensor, of_pose = _unpack(Cursor(data, False), self._row)
                return PoseFields(stamp_ns, world, sensor, of_pose[:3], of_pose[3:])
            columns, is_usable = self.columns([data], is_ros1=False)
        except InputError:
            raise
        except MALFORMED as error:
            raise InputError(f"not a message of type {self._row.name}: {error}") from error
        if not is_usable.all():
            raise InputError(f"the message has no {_LACKS[self._measures]}")
        values = columns.poses[0].tolist()
        frames = columns.world_frames[0], columns.sensor_frames[0]
        return PoseFields(int(columns.stamps_ns[0]), *frames, values[:3], values[3:])
