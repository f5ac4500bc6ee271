"""Stamps, frames and values of ROS messages, unpacked from their bytes.

All types that are read begin with the same bytes: a ``std_msgs/Header``, for some types the
sensor's frame, then what is measured. Only those are unpacked, which takes a small part of the time
of a whole message and needs no type definitions. A new type is a row in :data:`MESSAGE_TYPES`.
"""

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.config import STAMP_UNITS
from hand_eye_calib.errors import ConfigError, InputError, printable
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import RateIntegrator
from hand_eye_calib.io.bags.fields import FIELDS
from hand_eye_calib.io.bags.mcap_files import MessageKind
from hand_eye_calib.io.bags.poses import PoseColumns
from hand_eye_calib.io.geodetic import POLE_DEG, LocalOrigin
from hand_eye_calib.io.limits import LONGEST_NAME
from hand_eye_calib.io.transforms import PoseFields

# What unpacking bytes that are not a message of its type may raise.
MALFORMED = (struct.error, ValueError)
Errors = type[Exception] | tuple[type[Exception], ...]

T = TypeVar("T")

_NS_PER_S = STAMP_UNITS["s"]
_POSE_SIZE = struct.calcsize("=7d")
# Of what is no pose, the part that is not measured: at the origin, level.
_NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


# ---- bytes

# CDR begins with 4 bytes that say how it is encoded, and alignment counts from there. A ROS 1
# header begins with 4 bytes of sequence number, and nothing is aligned.
_START, _CDR = 4, b"\x00\x01"


class Cursor:
    """Reads the parts of a message one after the other."""

    def __init__(self, data: bytes, is_ros1: bool) -> None:
        if not is_ros1 and bytes(data[:2]) != _CDR:
            raise ValueError(f"expected plain CDR, found encoding 0x{bytes(data[:2]).hex()}")
        self.data, self.is_ros1, self.position = data, is_ros1, 0 if is_ros1 else _START

    def read(self, format_: str) -> tuple[float, ...]:
        """Read numbers of one kind, by their format in struct."""
        if not self.is_ros1:
            self.position += (_START - self.position) % struct.calcsize(format_[-1])
        values = struct.unpack_from(f"<{format_}", self.data, self.position)
        self.position += struct.calcsize(f"={format_}")
        return values

    def number(self, format_: str = "I") -> int:
        """Read a whole number, of 4 bytes without sign by default."""
        return int(self.read(format_)[0])

    def stamp_ns(self) -> int:
        """Read a stamp."""
        seconds, nanoseconds = self.number("I" if self.is_ros1 else "i"), self.number()
        if nanoseconds >= _NS_PER_S:
            raise ValueError(f"a stamp has {nanoseconds} nanoseconds, more than a second")
        return seconds * _NS_PER_S + nanoseconds

    def name(self) -> str:
        """Read a string; in CDR it ends in a zero byte. Control characters are escaped."""
        length = self.number()
        start, self.position = self.position, self.position + length
        if self.position > len(self.data):
            raise ValueError("a text does not fit into the message")
        if length > LONGEST_NAME:
            raise ValueError(f"the name of a frame has {length} bytes, more than {LONGEST_NAME}")
        end = self.position - (not self.is_ros1)
        return printable(str(self.data[start : max(end, start)], "utf-8"))

    def header(self) -> tuple[int, str]:
        """Read stamp and frame."""
        if self.is_ros1:
            self.number()  # sequence number
        return self.stamp_ns(), self.name()


def _pose(cursor: Cursor) -> Sequence[float]:
    """Position (m) and quaternion."""
    return cursor.read("7d")


def _imu(cursor: Cursor) -> Sequence[float]:
    """Orientation, scalar last, and angular rates (rad/s) of an Imu: NaN for what its covariance
    says it does not have.
    """
    values = cursor.read("25d")
    orientation = (math.nan,) * 4 if values[4] == -1.0 else values[:4]
    rates = (math.nan,) * 3 if values[16] == -1.0 else values[13:16]
    return orientation + rates


def _fix(cursor: Cursor) -> Sequence[float]:
    """Latitude, longitude (deg) and height (m) of a NavSatFix: NaN without a fix."""
    status, _ = cursor.number("b"), cursor.number("H")
    values = cursor.read("3d")
    return values if status >= 0 else (math.nan,) * 3


# ---- types of messages


class MessageType(NamedTuple):
    """A type of messages with a header that are read: its name; what they can be read as, the usual
    first, and where that is in what is unpacked; what reads the values behind the frames; and
    whether the sensor's frame stands behind the header.
    """

    name: str
    measures: Mapping[str, slice]
    unpack: Callable[[Cursor], Sequence[float]]
    has_child_frame: bool = False


_OF_POSES = {"poses": slice(7), "positions": slice(3), "rotations": slice(3, 7)}
_OF_IMU = {"rates": slice(4, 7), "rotations": slice(4)}
_OF_POINTS = {"positions": slice(3)}

# The likeliest first.
_ROWS = (
    MessageType("nav_msgs/msg/Odometry", _OF_POSES, _pose, has_child_frame=True),
    MessageType("geometry_msgs/msg/PoseStamped", _OF_POSES, _pose),
    MessageType("geometry_msgs/msg/PoseWithCovarianceStamped", _OF_POSES, _pose),
    MessageType("geometry_msgs/msg/TransformStamped", _OF_POSES, _pose, has_child_frame=True),
    MessageType("sensor_msgs/msg/Imu", _OF_IMU, _imu),
    MessageType("sensor_msgs/msg/NavSatFix", _OF_POINTS, _fix),
    MessageType("geometry_msgs/msg/PointStamped", _OF_POINTS, lambda cursor: cursor.read("3d")),
)
MESSAGE_TYPES = {row.name: row for row in _ROWS}
#: Those that carry whole poses.
POSE_TYPES = tuple(row.name for row in _ROWS if row.unpack is _pose)
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
    """What messages of a type are read as: what is wanted, or the usual for "auto"; a ConfigError
    if they cannot be read as that.
    """
    possible = ["positions"] if message_type == "foxglove.LocationFix" else [*_OF_POSES]
    if message_type in MESSAGE_TYPES:
        possible = [*MESSAGE_TYPES[message_type].measures]
    if wanted == "auto":
        return possible[0]
    if wanted not in possible:
        raise ConfigError(
            f"{source} has messages of type {message_type or 'tf2_msgs/msg/TFMessage'}, which "
            f"measure {' or '.join(possible)}; asked for are {wanted}"
        )
    return wanted


# ---- unpacking


def unpack_stamp_ns(data: bytes) -> int:
    """Unpack the stamp of a message in CDR that begins with a header; raises MALFORMED."""
    return Cursor(data, is_ros1=False).stamp_ns()


class Run(NamedTuple):
    """Messages of one kind that follow each other, and their bag times (N,)."""

    kind: MessageKind
    messages: list[bytes]
    bag_ns: IntArray

    def read(self, unpack: Callable[..., T], errors: Errors = MALFORMED) -> T:
        """What is unpacked of the messages and whether they are of ROS 1; an InputError if that
        raises one of the errors.
        """
        try:
            return unpack(self.messages, self.kind.is_ros1)
        except InputError:
            raise
        except errors as error:
            raise InputError(
                f"{self.kind.topic}: a message is not a readable {self.kind.type} ({error}); the "
                "bag is damaged, record it again"
            ) from error

    def each(self, unpack: Callable[..., T], errors: Errors = MALFORMED) -> list[T]:
        """The same of each message."""
        return self.read(lambda data, is_ros1: [unpack(each, is_ros1) for each in data], errors)


_Unpacked = tuple[int, str, str | None, Sequence[float], int]


def _unpack(row: MessageType, is_ros1: bool, data: bytes) -> _Unpacked:
    """Stamp in ns, the header's frame, the sensor's behind it, values, and where these end."""
    cursor = Cursor(data, is_ros1)
    stamp_ns, frame = cursor.header()
    sensor_frame = cursor.name() if row.has_child_frame else None
    return stamp_ns, frame, sensor_frame, row.unpack(cursor), cursor.position


def unpack_poses(messages: Sequence[bytes], message_type: str, is_ros1: bool) -> PoseColumns:
    """Unpack one or more messages of one of MESSAGE_TYPES, poses together if they differ only in
    stamps and values; raises MALFORMED.
    """
    row, size = MESSAGE_TYPES[message_type], len(messages[0])
    if row.unpack is _pose and len(messages) > 1 and {*map(len, messages)} == {size}:
        _, world, sensor, _, end = _unpack(row, is_ros1, messages[0])
        bytes_of = np.frombuffer(b"".join(messages), dtype=np.uint8).reshape(-1, size)
        # The sequence number of ROS 1 may differ, the encoding of CDR may not.
        is_alike = is_ros1 or bool((bytes_of[:, :2] == bytes_of[0, :2]).all())
        found = _unpack_together(bytes_of[:, _START:end], is_ros1)
        if found is not None and is_alike:
            return PoseColumns.of_frames(*found, world, sensor)
    rows = (_unpack(row, is_ros1, data) for data in messages)
    stamps_ns, worlds, sensors, values, _ = zip(*rows, strict=True)
    return PoseColumns(np.array(stamps_ns, dtype=np.int64), [*worlds], [*sensors], np.array(values))


def _unpack_together(rows: np.ndarray, is_ros1: bool) -> tuple[IntArray, FloatArray] | None:
    """Stamps and poses of rows of bytes (N, size) that begin with a stamp and end with a pose; None
    if what is between them, the frames, differs, or a stamp cannot be right.
    """
    frames, stamps = rows[:, 8:-_POSE_SIZE], np.ascontiguousarray(rows[:, :8])
    seconds, nanoseconds = stamps.view("<u4" if is_ros1 else "<i4").T.astype(np.int64)
    if (frames != frames[0]).any() or not (nanoseconds // _NS_PER_S == 0).all():
        return None
    poses = np.ascontiguousarray(rows[:, -_POSE_SIZE:]).view("<f8")
    return seconds * _NS_PER_S + nanoseconds, poses


def unpack_path(data: bytes, is_ros1: bool) -> PoseColumns:
    """Unpack the poses of a nav_msgs/Path; raises MALFORMED."""
    cursor = Cursor(data, is_ros1)
    _, world_frame = cursor.header()
    rows = [(cursor.header()[0], _pose(cursor)) for _ in range(cursor.number())]
    stamps_ns = np.array([stamp_ns for stamp_ns, _ in rows], dtype=np.int64)
    poses = np.reshape([pose for _, pose in rows], (-1, 7))
    return PoseColumns.of_frames(stamps_ns, poses, world_frame)


def unpack_transforms(data: bytes, is_ros1: bool) -> list[PoseFields]:
    """Unpack the transforms of a tf message, frames without a leading slash; raises MALFORMED."""
    cursor, found = Cursor(data, is_ros1), []
    for _ in range(cursor.number()):
        stamp_ns, world_frame = cursor.header()
        frames = world_frame.lstrip("/"), cursor.name().lstrip("/")
        values = _pose(cursor)
        found.append(PoseFields(stamp_ns, *frames, values[:3], values[3:]))
    return found


# ---- what the messages of a topic measure


class MessageReader:
    """Unpacks the messages of one topic, in their order, as poses: of what is no pose, the other
    part means nothing (level positions, rotations at the origin).

    ``measures`` is as of :func:`measured_as`, ``origin`` that of latitudes and longitudes, the
    first one read by default. ``n_left_out`` counts messages without a fix or an orientation.
    """

    def __init__(self, message_type: str, measures: str, origin: LocalOrigin | None = None) -> None:
        self._row, self._measures = MESSAGE_TYPES[message_type], measures
        self._are_poses = message_type in POSE_TYPES and measures == "poses"
        self._rates = RateIntegrator()
        self._origin = origin or LocalOrigin()
        self.n_left_out = 0

    def columns(self, messages: Sequence[bytes], is_ros1: bool) -> tuple[PoseColumns, BoolArray]:
        """The next messages, and which of them have what is measured; the others are not finite.

        Raises as :func:`unpack_poses`, and InputError at a latitude beyond 90 deg.
        """
        columns = unpack_poses(messages, self._row.name, is_ros1)
        if self._are_poses:
            return columns, np.ones(len(messages), dtype=bool)
        values = columns.poses[:, self._row.measures[self._measures]]
        is_usable = np.asarray(np.isfinite(values).all(axis=1), dtype=bool)
        self.n_left_out += int((~is_usable).sum())
        poses = np.tile(_NOTHING, (len(values), 1))
        if is_usable.any():
            part = slice(3) if self._measures == "positions" else slice(3, 7)
            poses[is_usable, part] = self._measured(columns.stamps_ns, values, is_usable)
        poses[~is_usable] = np.nan
        columns = columns._replace(poses=poses)
        if self._row.unpack in (_imu, _fix):  # whose header has the sensor's frame
            frames = columns.world_frames
            columns = columns._replace(world_frames=[""] * len(poses), sensor_frames=frames)
        return columns, is_usable

    def _measured(self, stamps_ns: IntArray, values: FloatArray, rows: BoolArray) -> FloatArray:
        """Positions (N, 3) or quaternions (N, 4) of what was read in some rows."""
        if self._measures == "rates":
            return se3.to_quat_xyzw(self._rates.rotations(stamps_ns[rows], values[rows]))
        if self._row.unpack is not _fix:
            return values[rows]
        beyond = values[np.abs(values[:, 0]) > POLE_DEG]
        if len(beyond):
            raise InputError(
                "found latitude {:.7g} and longitude {:.7g}: no latitude is beyond 90 deg; they "
                "seem to be swapped, swap them at their source".format(*beyond[0])
            )
        lat, lon = np.radians(values[rows, :2]).T
        return self._origin.local(lat, lon, values[rows, 2])

    def __call__(self, data: bytes) -> PoseFields:
        """The next message, in CDR, as it arrives; an InputError if it cannot be unpacked, or lacks
        what is measured.
        """
        try:
            if self._are_poses:
                stamp_ns, world, sensor, of_pose, _ = _unpack(self._row, False, data)
                return PoseFields(stamp_ns, world, sensor, of_pose[:3], of_pose[3:])
            columns, is_usable = self.columns([data], is_ros1=False)
        except InputError:
            raise
        except MALFORMED as error:
            raise InputError(f"not a message of type {self._row.name}: {error}") from error
        if not is_usable.all():
            raise InputError(f"the message has no {self._measures}")
        values = columns.poses[0].tolist()
        world, sensor = columns.world_frames[0], columns.sensor_frames[0]
        return PoseFields(int(columns.stamps_ns[0]), world, sensor, values[:3], values[3:])
