"""Types of messages, and what is measured in them.

Those of the first part of the table are unpacked from their bytes: all begin with a
``std_msgs/Header``, for some types the sensor's frame, then what is measured. Only that is
unpacked, which takes a small part of the time of a whole message and needs no type definitions.
Messages of all other types are decoded by libraries. A new type is a row in the table.
"""

import json
import math
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from types import SimpleNamespace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.config import STAMP_UNITS
from hand_eye_calib.core.base.errors import (
    ConfigError,
    HandEyeCalibError,
    InputError,
    NoPoseError,
    printable,
    required,
)
from hand_eye_calib.core.base.text import frame_name
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import are_null
from hand_eye_calib.core.geometry.rates import RateIntegrator
from hand_eye_calib.core.geometry.trajectory import Columns, Trajectory
from hand_eye_calib.formats.bags.storage import MessageKind
from hand_eye_calib.formats.files import LONGEST_NAME
from hand_eye_calib.formats.geodetic import LocalOrigin
from hand_eye_calib.formats.trajectory_files.columns import TWIST
from hand_eye_calib.formats.transforms import PoseFields

# What unpacking bytes that are not a message of its type may raise.
MALFORMED = (struct.error, ValueError)

NS_PER_S = STAMP_UNITS["s"]
_POSE_SIZE = struct.calcsize("=7d")


# ---- bytes

# CDR begins with 4 bytes that say how it is encoded, and alignment counts from there. A ROS 1
# header begins with as many bytes of sequence number, and nothing is aligned.
_START = struct.calcsize("=I")
_CDR = b"\x00\x01"


class Cursor:
    """Reads the parts of a message one after the other."""

    def __init__(self, data: bytes, is_ros1: bool) -> None:
        if not is_ros1 and bytes(data[:2]) != _CDR:
            raise ValueError(f"expected plain CDR, found encoding 0x{bytes(data[:2]).hex()}")
        self._data = data
        self._is_ros1 = is_ros1
        self.position = _START

    def read(self, format_: str) -> tuple[Any, ...]:
        """Read numbers of one size, by their format in struct."""
        if not self._is_ros1:
            self.position += (_START - self.position) % struct.calcsize(format_[-1])
        values = struct.unpack_from(f"<{format_}", self._data, self.position)
        self.position += struct.calcsize(f"={format_}")
        return values

    def stamp_ns(self) -> int:
        """Read a stamp."""
        seconds, nanoseconds = self.read("II" if self._is_ros1 else "iI")
        if nanoseconds >= NS_PER_S:
            raise ValueError(f"a stamp has {nanoseconds} nanoseconds, more than a second")
        return int(seconds * NS_PER_S + nanoseconds)

    def name(self) -> str:
        """Read the name of a frame; in CDR it ends in a zero byte. Control characters are escaped,
        and the leading slash of ROS 1 is left out.
        """
        (length,) = self.read("I")
        start = self.position
        self.position = self.position + length
        if self.position > len(self._data):
            raise ValueError("a text does not fit into the message")
        if length > LONGEST_NAME:
            raise ValueError(f"the name of a frame has {length} bytes, more than {LONGEST_NAME}")
        end = self.position - (not self._is_ros1)
        return printable(frame_name(str(self._data[start : max(end, start)], "utf-8")))


def _pose(cursor: Cursor) -> Sequence[float]:
    """Position (m) and quaternion."""
    return cursor.read("7d")


def _imu(cursor: Cursor) -> Sequence[float]:
    """Angular rates (rad/s) and orientation, scalar last, of an Imu: NaN for what its covariance
    says it does not have.
    """
    values = cursor.read("25d")
    orientation = (math.nan,) * 4 if values[4] == -1.0 else values[:4]
    rates = (math.nan,) * 3 if values[16] == -1.0 else values[13:16]
    return rates + orientation


def _fix(cursor: Cursor) -> Sequence[float]:
    """Latitude, longitude (deg) and height (m) of a NavSatFix: NaN without a fix."""
    (status,) = cursor.read("b")
    _ = cursor.read("H")
    values = cursor.read("3d")
    return values if status >= 0 else (math.nan,) * 3


# ---- types of messages


class MessageType(NamedTuple):
    """A type of messages that are read: its name; what they can be read as, the usual first; what
    reads the values behind the frames, if it is unpacked from its bytes, and whether the sensor's
    frame stands behind the header; or the fields of it that are read, see :mod:`.sources`.
    """

    name: str
    measures: Sequence[str]
    unpack: Callable[[Cursor], Sequence[float]] | None = None
    has_child_frame: bool = False
    fields: str = ""


# Where that stands in what is unpacked; latitude, longitude and height are positions.
_PARTS = {"poses": slice(7), "positions": slice(3), "rotations": slice(3, 7), "rates": slice(3)}
_OF_POSES = ("poses", "positions", "rotations")
_OF_POINTS = ("positions",)
_TURN = "qx={0}.x,qy={0}.y,qz={0}.z,qw={0}.w"
_PLACE = "lat_deg={0}latitude,lon_deg={0}longitude,height={0}altitude"


def _pose_at(at: str, stamp: str = "header.stamp", parts: str = "position orientation") -> str:
    position, orientation = (f"{at}{part}" for part in parts.split())
    place = f"x={position}.x,y={position}.y,z={position}.z"
    return f"t={stamp},{place},{_TURN.format(orientation)}"


def _twist_at(at: str) -> str:
    parts = (f"{kind}.{axis}" for kind in ("linear", "angular") for axis in "xyz")
    return ",".join(["t=header.stamp", *map(f"{{}}={at}.{{}}".format, TWIST, parts)])


PATH_TYPE = "nav_msgs/msg/Path"
POINTS_TYPE = "sensor_msgs/msg/PointCloud2"
#: Images, which are read with a target.
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_FRAME_TRANSFORM = "foxglove.FrameTransform"
#: Lists of transforms, and one alone.
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage", f"{_FRAME_TRANSFORM}s", _FRAME_TRANSFORM)

# Types that are read by their fields; of an array in a message, the first element.
_FIELDS = {
    **{
        f"novatel_{name}": "t=header.stamp,lat_deg=latitude,lon_deg=longitude,height=height,"
        "roll_deg=roll,pitch_deg=pitch,heading_deg=azimuth"
        for name in ("oem7_msgs/msg/INSPVA", "oem7_msgs/msg/INSPVAX", "gps_msgs/msg/Inspva")
    },
    "septentrio_gnss_driver/msg/INSNavGeod": "t=header.stamp,lat_rad=latitude,lon_rad=longitude,"
    "height=height,roll_deg=roll,pitch_deg=pitch,heading_deg=heading",
    "geographic_msgs/msg/GeoPoseStamped": "t=header.stamp,"
    + f"{_PLACE.format('pose.position.')},{_TURN.format('pose.orientation')}",
    "geometry_msgs/msg/TwistStamped": _twist_at("twist"),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twist_at("twist.twist"),
    "px4_msgs/msg/VehicleOdometry": "t_us=timestamp_sample,x=position.0,y=position.1,z=position.2,"
    "qw=q.0,qx=q.1,qy=q.2,qz=q.3",
    "geometry_msgs/msg/PoseArray": _pose_at("poses.0."),
    "mocap4r2_msgs/msg/RigidBodies": _pose_at("rigidbodies.0.pose."),
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": _pose_at("poses.0.pose."),
    "foxglove.PoseInFrame": _pose_at("pose.", "timestamp"),
    "foxglove.PosesInFrame": _pose_at("poses.0.", "timestamp"),
    _FRAME_TRANSFORM: _pose_at("", "timestamp", "translation rotation"),
    "gps_msgs/msg/GPSFix": f"t=header.stamp,{_PLACE.format('')}",
    "foxglove.LocationFix": f"t=timestamp,{_PLACE.format('')}",
}
# The likeliest first.
_ROWS = (
    MessageType("nav_msgs/msg/Odometry", _OF_POSES, _pose, has_child_frame=True),
    MessageType("geometry_msgs/msg/PoseStamped", _OF_POSES, _pose),
    MessageType("geometry_msgs/msg/PoseWithCovarianceStamped", _OF_POSES, _pose),
    MessageType("geometry_msgs/msg/TransformStamped", _OF_POSES, _pose, has_child_frame=True),
    MessageType(PATH_TYPE, _OF_POSES),
    MessageType("sensor_msgs/msg/Imu", ("rates", "rotations"), _imu),
    MessageType("sensor_msgs/msg/NavSatFix", _OF_POINTS, _fix),
    MessageType("geometry_msgs/msg/PointStamped", _OF_POINTS, lambda cursor: cursor.read("3d")),
    *(
        MessageType(name, _OF_POINTS if name.endswith("Fix") else _OF_POSES, fields=fields)
        for name, fields in _FIELDS.items()
    ),
    MessageType(POINTS_TYPE, _OF_POSES),
)
MESSAGE_TYPES = {row.name: row for row in _ROWS}
#: Those that carry whole poses.
POSE_TYPES = tuple(row.name for row in _ROWS if row.unpack is _pose)


def measured_as(message_type: str, wanted: str, source: object) -> str:
    """What messages of a type are read as: what is wanted, or the usual for "auto"; a ConfigError
    if they cannot be read as that.
    """
    row = MESSAGE_TYPES.get(message_type)
    possible = row.measures if row else _OF_POSES
    if wanted == "auto":
        return possible[0]
    if wanted not in possible:
        raise ConfigError(
            f"{source} has messages of type {message_type or 'tf2_msgs/msg/TFMessage'}, which "
            f"measure {' or '.join(possible)}; asked for are {wanted}"
        )
    return wanted


# ---- poses in columns


@dataclass(frozen=True, eq=False)
class PoseTable(Columns):
    """N poses of streams, "parent" or "child", in columns (N,), in the order of bag time.

    ``stamps_ns`` are of the headers, ``bag_ns`` when the messages were recorded; frames are None if
    the message type does not carry them; ``poses`` (N, 7) are x y z qx qy qz qw.
    """

    streams: NDArray[np.object_]
    stamps_ns: IntArray
    world_frames: NDArray[np.object_]
    sensor_frames: NDArray[np.object_]
    poses: FloatArray
    bag_ns: IntArray

    @classmethod
    def of(cls, stamps_ns: Any, poses: Any, world: Any = "", sensor: Any = None) -> Self:
        """Poses of no stream yet, whose stamps (N,) count as bag times; frames are one for all, or
        (N,). Of messages that are no poses, ``poses`` are what is unpacked of them.
        """
        stamps_ns = np.array(stamps_ns, dtype=np.int64)
        stream, world, sensor = (
            np.broadcast_to(np.array(each, dtype=object), stamps_ns.shape)
            for each in ("", world, sensor)
        )
        return cls(stream, stamps_ns, world, sensor, np.asarray(poses), stamps_ns)

    def recorded(self, stream: str, bag_ns: Any) -> Self:
        """The table with the name of its stream, and with the bag times (N,) of its poses."""
        streams = np.full(len(self), stream, dtype=object)
        return replace(self, streams=streams, bag_ns=np.array(bag_ns, dtype=np.int64))

    @classmethod
    def joined(cls, tables: Iterable[Self]) -> Self:
        """The rows of one or more tables in the order of bag time."""
        table = cls.concatenate(*tables)
        is_sorted = (np.diff(table.bag_ns) >= 0).all()
        return table if is_sorted else table[np.argsort(table.bag_ns, kind="stable")]

    def trajectory(self) -> Trajectory:
        """Poses of one stream in the order of stamps; of those with equal stamps the first."""
        stamps_ns, first = np.unique(self.stamps_ns, return_index=True)
        poses = self[first]
        positions = poses.poses[:, :3]
        quats_xyzw = poses.poses[:, 3:]
        frames = poses.sensor_frames[0] or "", poses.world_frames[0]
        return Trajectory.from_quat_xyzw(stamps_ns, positions, quats_xyzw, *frames)


# ---- messages that a library decodes


@lru_cache
def _decoder(kind: MessageKind) -> Callable[[bytes], Any]:
    """A function that makes an object of the bytes of a message. Raises InputError if definition or
    encoding of the messages are not known.
    """
    name = kind.type
    language, content = kind.definition
    if kind.encoding == "json":
        return partial(json.loads, object_hook=lambda fields: SimpleNamespace(**fields))
    if kind.encoding not in ("cdr", "ros1", "protobuf"):
        raise InputError(
            f"messages of type {name} are encoded as {kind.encoding[:40]!r}; expected cdr, ros1, "
            "json or protobuf"
        )
    try:
        if kind.encoding == "protobuf":
            reading = required("mcap_protobuf.decoder", name, "foxglove")
            schema = SimpleNamespace(id=0, name=name, encoding=language, data=content)
            return reading.DecoderFactory().decoder_for(kind.encoding, schema)
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

        types = get_typestore(Stores.ROS1_NOETIC if kind.is_ros1 else Stores.ROS2_JAZZY)
        if content and name not in types.types:
            text = content.decode()
            is_idl = "idl" in language.lower()
            known = get_types_from_idl(text) if is_idl else get_types_from_msg(text, name)
            types.register({key: each for key, each in known.items() if key not in types.types})
        types.types[name]
    except HandEyeCalibError:
        raise
    except Exception as error:  # of many kinds, at damaged definitions
        raise InputError(
            f"the bag has no definition of {name} that can be read; record it as mcap, which "
            "stores definitions"
        ) from error
    read = types.deserialize_ros1 if kind.is_ros1 else types.deserialize_cdr
    return lambda data: read(data, name)


def ns_of(stamp: Any) -> int | None:
    """A stamp of a message, as ROS, Foxglove's JSON or protobuf has it, in ns; None for others."""
    for seconds, nanoseconds in (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos")):
        if hasattr(stamp, nanoseconds):
            return int(getattr(stamp, seconds) * NS_PER_S + getattr(stamp, nanoseconds))
    return None


def pose_row(position: Any, orientation: Any) -> tuple[float, ...]:
    """x y z qx qy qz qw of a position, or translation, and an orientation of a message."""
    at = position
    turn = orientation
    return at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w


def transform_of(message: Any) -> PoseFields:
    """A transform of ROS or of Foxglove; its frames without a leading slash."""
    if is_ros := hasattr(message, "header"):
        stamp = message.header.stamp
        parent = message.header.frame_id
    else:
        stamp = message.timestamp
        parent = message.parent_frame_id
    parent = printable(frame_name(parent[:LONGEST_NAME]))
    frame = printable(frame_name(message.child_frame_id[:LONGEST_NAME]))
    pose = message.transform if is_ros else message
    row = pose_row(pose.translation, pose.rotation)
    return PoseFields(ns_of(stamp) or 0, parent, frame, row[:3], row[3:])


class Run(NamedTuple):
    """Messages of one kind that follow each other, and their bag times (N,)."""

    kind: MessageKind
    messages: list[bytes]
    bag_ns: IntArray

    def decoded(self) -> Iterator[Any]:
        """The messages as objects with their fields; an InputError at one that cannot be read."""
        decode = _decoder(self.kind)
        for data in self.messages:
            try:
                message = decode(data)
            except Exception as error:  # the libraries' are of many kinds
                raise self.unreadable(error) from error
            yield message

    def transforms(self) -> Iterator[tuple[int, PoseFields]]:
        """Bag times, and the transforms of all messages, which are of one of TF_TYPES."""
        for message, bag_ns in zip(self.decoded(), self.bag_ns.tolist(), strict=True):
            try:
                for each in getattr(message, "transforms", [message]):
                    yield bag_ns, transform_of(each)
            except (AttributeError, TypeError) as error:  # JSON may have anything
                raise self.unreadable(error) from error

    def unreadable(self, error: Exception) -> InputError:
        """What to raise for a message that is not of its type."""
        return InputError(
            f"{self.kind.topic}: a message is not a readable {self.kind.type} ({error}); the bag "
            "is damaged, record it again"
        )


# ---- messages that are unpacked from their bytes


_Unpacked = tuple[int, str, str | None, Sequence[float], int]


def _unpack(row: MessageType, is_ros1: bool, data: bytes) -> _Unpacked:
    """Stamp in ns, the header's frame, the sensor's behind it, values, and where these end."""
    cursor = Cursor(data, is_ros1)
    stamp_ns = cursor.stamp_ns()
    frame = cursor.name()
    sensor_frame = cursor.name() if row.has_child_frame else None
    values = row.unpack(cursor) if row.unpack else ()
    return stamp_ns, frame, sensor_frame, values, cursor.position


def unpack_poses(messages: Sequence[bytes], message_type: str, is_ros1: bool) -> PoseTable:
    """Unpack one or more messages of one of MESSAGE_TYPES, poses together if they differ only in
    stamps and values; raises MALFORMED.
    """
    row = MESSAGE_TYPES[message_type]
    size = len(messages[0])
    if row.unpack is _pose and len(messages) > 1 and {*map(len, messages)} == {size}:
        _, world, sensor, _, end = _unpack(row, is_ros1, messages[0])
        bytes_of = np.frombuffer(b"".join(messages), dtype=np.uint8).reshape(-1, size)
        # The sequence number of ROS 1 may differ, the encoding of CDR may not.
        is_alike = is_ros1 or bool((bytes_of[:, :2] == bytes_of[0, :2]).all())
        found = _unpack_together(bytes_of[:, _START:end], is_ros1)
        if found is not None and is_alike:
            return PoseTable.of(*found, world, sensor)
    rows = (_unpack(row, is_ros1, data) for data in messages)
    stamps_ns, worlds, sensors, values, _ = zip(*rows, strict=True)
    return PoseTable.of(stamps_ns, values, worlds, sensors)


def _unpack_together(rows: np.ndarray, is_ros1: bool) -> tuple[IntArray, FloatArray] | None:
    """Stamps and poses of rows of bytes (N, size) that begin with a stamp and end with a pose; None
    if what is between them, the frames, differs, or a stamp cannot be right.
    """
    frames = rows[:, 8:-_POSE_SIZE]
    stamps = np.ascontiguousarray(rows[:, :8])
    seconds, nanoseconds = stamps.view("<u4" if is_ros1 else "<i4").T.astype(np.int64)
    if (frames != frames[0]).any() or not (nanoseconds // NS_PER_S == 0).all():
        return None
    poses = np.ascontiguousarray(rows[:, -_POSE_SIZE:]).view("<f8")
    return seconds * NS_PER_S + nanoseconds, poses


# ---- what the messages of a topic measure


class MessageReader:
    """Unpacks the messages of one topic, in their order, as poses. Positions alone get level
    orientations, and rotations alone positions at the origin: these mean nothing.

    ``measures`` is as of :func:`measured_as`, ``origin`` that of latitudes and longitudes, the
    first one read by default. ``n_left_out`` counts messages without what is measured: null poses,
    no fix, no orientation.
    """

    def __init__(self, message_type: str, measures: str, origin: LocalOrigin | None = None) -> None:
        self._row = MESSAGE_TYPES[message_type]
        self._measures = measures
        self._are_poses = message_type in POSE_TYPES and measures == "poses"
        self._rates = RateIntegrator()
        # Of the pose before: the bytes of its frames, where they end, and the frames.
        self._frames: tuple[bytes, int, str, str | None] = b" ", 0, "", None
        self._origin = origin or LocalOrigin()
        self.n_left_out = 0

    def columns(self, messages: Sequence[bytes], is_ros1: bool) -> tuple[PoseTable, BoolArray]:
        """The next messages, and which of them have what is measured; the others are not finite.

        Raises as :func:`unpack_poses`, and InputError at a place that is not on earth.
        """
        columns = unpack_poses(messages, self._row.name, is_ros1)
        if self._are_poses:
            is_null = are_null(columns.poses)
            self.n_left_out += int(is_null.sum())
            return columns, ~is_null
        values = columns.poses[:, _PARTS[self._measures]]
        is_usable = np.asarray(np.isfinite(values).all(axis=1), dtype=bool)
        if self._measures == "rotations":
            is_usable &= (values != 0.0).any(axis=1)
        self.n_left_out += int((~is_usable).sum())
        poses = np.tile([0.0] * 6 + [1.0], (len(values), 1))
        if is_usable.any():
            part = _PARTS["positions" if self._measures == "positions" else "rotations"]
            poses[is_usable, part] = self._measured(columns.stamps_ns, values, is_usable)
        poses[~is_usable] = np.nan
        if self._row.unpack not in (_imu, _fix):
            return replace(columns, poses=poses), is_usable
        # Whose header has the sensor's frame.
        return PoseTable.of(columns.stamps_ns, poses, "", columns.world_frames), is_usable

    def _measured(self, stamps_ns: IntArray, values: FloatArray, rows: BoolArray) -> FloatArray:
        """Positions (N, 3) or quaternions (N, 4) of what was read in some rows."""
        if self._measures == "rates":
            return se3.to_quat_xyzw(self._rates.rotations(stamps_ns[rows], values[rows]))
        if self._row.unpack is not _fix:
            return values[rows]
        beyond = values[(np.abs(values[:, :2]) > (90, 360)).any(axis=1)]
        if len(beyond):
            raise InputError(
                "found latitude {:.7g} and longitude {:.7g}: no latitude is beyond 90 deg, no "
                "longitude beyond 360; if they are swapped, repair their source".format(*beyond[0])
            )
        lat, lon = np.radians(values[rows, :2]).T
        return self._origin.local(lat, lon, values[rows, 2])

    def __call__(self, data: bytes) -> PoseFields:
        """The next message, in CDR, as it arrives; an InputError if it cannot be unpacked, or lacks
        what is measured.
        """
        try:
            if self._are_poses:
                names, start, world, sensor = self._frames
                if data[12:start] != names:  # behind encoding and stamp
                    _, world, sensor, _, end = _unpack(self._row, False, data)
                    start = end - _POSE_SIZE
                    self._frames = data[12:start], start, world, sensor
                pose = struct.unpack_from("<7d", data, start)
                return PoseFields(Cursor(data, False).stamp_ns(), world, sensor, pose[:3], pose[3:])
            columns, is_usable = self.columns([data], is_ros1=False)
        except InputError:
            raise
        except MALFORMED as error:
            raise InputError(f"not a message of type {self._row.name}: {error}") from error
        if not is_usable.all():
            raise NoPoseError(f"the message has no {self._measures}")
        values = columns.poses[0].tolist()
        world = columns.world_frames[0]
        sensor = columns.sensor_frames[0]
        return PoseFields(int(columns.stamps_ns[0]), world, sensor, values[:3], values[3:])
