"""Readable types of messages, and the quantities (poses, rates, ...) in them.

Messages of frequent types are unpacked from their bytes: a ``std_msgs/Header``, the sensor's frame
in some types, and the values. This takes little time and needs no type definitions. Libraries
decode messages of all other types. To support a new type, add a row to ``_ROWS`` or ``_FIELDS``.
"""

import math
import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from hand_eye_calib.core.base.arrays import IntArray
from hand_eye_calib.core.base.config import STAMP_UNITS
from hand_eye_calib.core.base.errors import (
    ConfigError,
    InputError,
    printable,
)
from hand_eye_calib.core.base.registry import MEASURES
from hand_eye_calib.core.base.text import frame_name
from hand_eye_calib.formats.bags.decoding import decoder_of
from hand_eye_calib.formats.bags.storage import MessageKind
from hand_eye_calib.formats.files import LONGEST_NAME
from hand_eye_calib.formats.transforms import PoseFields

# Types of errors that unpacking raises if the bytes are not a message of the expected type.
MALFORMED = (struct.error, ValueError)

NS_PER_S = STAMP_UNITS["s"]
# Number of bytes of a stamp: seconds and nanoseconds.
STAMP_SIZE = 8
# Number of bytes of a pose: position and quaternion.
POSE_SIZE = struct.calcsize("=7d")
_NO_ROTATION = (math.nan,) * 4
_NO_VECTOR = (math.nan,) * 3


# ---- bytes

# Number of bytes before the stamp. In CDR these bytes are the encoding, and values are aligned
# relative to the end of them. In ROS 1 these bytes are a sequence number, and values are not
# aligned.
START = struct.calcsize("=I")
# First bytes of a message in plain CDR, little endian.
_CDR = b"\x00\x01"


class Cursor:
    """Read the values in the bytes of a message, one after the other.

    Raises
    ------
    ValueError
        If the message is neither ROS 1 nor plain CDR.
    """

    def __init__(self, data: bytes, is_ros1: bool) -> None:
        if not is_ros1 and bytes(data[:2]) != _CDR:
            raise ValueError(
                f"expected plain CDR, found encoding 0x{bytes(data[:2]).hex()}"
            )
        self._data = data
        self._is_ros1 = is_ros1
        self.position = START

    def read(self, format_: str) -> tuple[Any, ...]:
        """Read numbers. ``format_`` is a format of ``struct`` whose numbers have equal size."""
        if not self._is_ros1:
            self.position += (START - self.position) % struct.calcsize(
                format_[-1]
            )
        values = struct.unpack_from(f"<{format_}", self._data, self.position)
        self.position += struct.calcsize(f"={format_}")
        return values

    def stamp_ns(self) -> int:
        """Read a stamp; return it in ns."""
        seconds, nanoseconds = self.read("II" if self._is_ros1 else "iI")
        if nanoseconds >= NS_PER_S:
            raise ValueError(
                f"a stamp has {nanoseconds} nanoseconds, more than a second"
            )
        return int(seconds * NS_PER_S + nanoseconds)

    def name(self) -> str:
        """Read the name of a frame, without the leading slash of ROS 1.

        Control characters are escaped. In CDR, a zero byte ends the name.
        """
        (length,) = self.read("I")
        start = self.position
        self.position += length
        if self.position > len(self._data):
            raise ValueError("a text does not fit into the message")
        if length > LONGEST_NAME:
            raise ValueError(
                f"the name of a frame has {length} bytes, more than {LONGEST_NAME}"
            )
        end = self.position if self._is_ros1 else max(self.position - 1, start)
        return printable(frame_name(str(self._data[start:end], "utf-8")))


def unpack_pose(cursor: Cursor) -> Sequence[float]:
    """Read a position x y z (m) and a quaternion xyzw."""
    return cursor.read("7d")


def _point(cursor: Cursor) -> Sequence[float]:
    """Read a position x y z (m)."""
    return cursor.read("3d")


def _imu(cursor: Cursor) -> Sequence[float]:
    """Read angular rates (rad/s) and orientation xyzw of an Imu message.

    A quantity is NaN if the message does not contain it.
    """
    # Orientation (4 numbers) and its covariance (9), rates (3) and their covariance (9). A
    # covariance that begins with -1 means that the message does not contain the quantity.
    values = cursor.read("25d")
    orientation = _NO_ROTATION if values[4] == -1.0 else values[:4]
    rates = _NO_VECTOR if values[16] == -1.0 else values[13:16]
    return rates + orientation


def unpack_fix(cursor: Cursor) -> Sequence[float]:
    """Read latitude, longitude (deg) and height (m) of a NavSatFix message; NaN without a fix."""
    (status,) = cursor.read("b")
    cursor.read("H")  # services
    place = cursor.read("3d")
    return place if status >= 0 else _NO_VECTOR


# ---- types of messages


class MessageType(NamedTuple):
    """Readable type of messages.

    Attributes
    ----------
    name : str
    measures : sequence of str
        Quantities in the messages. The first one is read by default.
    unpack : callable, optional
        Function that reads the values after the frame names. None for types that a library decodes.
    has_child_frame : bool
        Whether the name of the sensor's frame follows the header.
    fields : str
        Fields to read from decoded messages, in the notation of :mod:`.sources`.
    """

    name: str
    measures: Sequence[str]
    unpack: Callable[[Cursor], Sequence[float]] | None = None
    has_child_frame: bool = False
    fields: str = ""


# Columns of each quantity in the values of :func:`unpack_pose`, :func:`_point`, :func:`_imu` and
# :func:`unpack_fix`. Latitude, longitude and height count as positions.
COLUMNS = {
    "poses": slice(7),
    "positions": slice(3),
    "rotations": slice(3, 7),
    "rates": slice(3),
}
_OF_POSES = ("poses", "positions", "rotations")
_OF_POINTS = ("positions",)

PATH_TYPE = "nav_msgs/msg/Path"
POINTS_TYPE = "sensor_msgs/msg/PointCloud2"
#: Type of joint states, which may contain the wheels of a vehicle.
JOINTS_TYPE = "sensor_msgs/msg/JointState"
#: Type of velocities without stamps.
TWIST_TYPE = "geometry_msgs/msg/Twist"
#: Types of images. Poses are computed from images of a target.
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
#: Types of lists of transforms, and of single transforms.
TF_TYPES = (
    "tf2_msgs/msg/TFMessage",
    "tf/msg/tfMessage",
    "foxglove.FrameTransforms",
    "foxglove.FrameTransform",
)


def _pose_fields(
    position: str, orientation: str, stamp: str = "header.stamp"
) -> str:
    """Return the fields of a pose, in the notation of :mod:`.sources`.

    The parameters are the paths of its position, orientation and stamp in a message.
    """
    place = f"x={position}.x,y={position}.y,z={position}.z"
    return f"t={stamp},{place},{_rotation_fields(orientation)}"


def _rotation_fields(path: str) -> str:
    """Return the fields of the quaternion at a path in a message."""
    return f"qx={path}.x,qy={path}.y,qz={path}.z,qw={path}.w"


def _twist_fields(path: str) -> str:
    """Return the fields of a stamped twist (velocity and angular rates) at a path in a message."""
    linear = f"vx={path}.linear.x,vy={path}.linear.y,vz={path}.linear.z"
    angular = f"wx={path}.angular.x,wy={path}.angular.y,wz={path}.angular.z"
    return f"t=header.stamp,{linear},{angular}"


_NOVATEL = (
    "t=header.stamp,lat_deg=latitude,lon_deg=longitude,height=height,"
    "roll_deg=roll,pitch_deg=pitch,heading_deg=azimuth"
)
# Fields of types that a library decodes. From an array of poses, the first pose is read.
_FIELDS = {
    "novatel_oem7_msgs/msg/INSPVA": _NOVATEL,
    "novatel_oem7_msgs/msg/INSPVAX": _NOVATEL,
    "novatel_gps_msgs/msg/Inspva": _NOVATEL,
    "septentrio_gnss_driver/msg/INSNavGeod": "t=header.stamp,lat_rad=latitude,lon_rad=longitude,"
    "height=height,roll_deg=roll,pitch_deg=pitch,heading_deg=heading",
    "geographic_msgs/msg/GeoPoseStamped": "t=header.stamp,lat_deg=pose.position.latitude,"
    "lon_deg=pose.position.longitude,height=pose.position.altitude,"
    + _rotation_fields("pose.orientation"),
    "geometry_msgs/msg/TwistStamped": _twist_fields("twist"),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twist_fields(
        "twist.twist"
    ),
    "px4_msgs/msg/VehicleOdometry": "t_us=timestamp_sample,x=position.0,y=position.1,z=position.2,"
    "qw=q.0,qx=q.1,qy=q.2,qz=q.3",
    "geometry_msgs/msg/PoseArray": _pose_fields(
        "poses.0.position", "poses.0.orientation"
    ),
    "mocap4r2_msgs/msg/RigidBodies": _pose_fields(
        "rigidbodies.0.pose.position", "rigidbodies.0.pose.orientation"
    ),
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": _pose_fields(
        "poses.0.pose.position", "poses.0.pose.orientation"
    ),
    "foxglove.PoseInFrame": _pose_fields(
        "pose.position", "pose.orientation", "timestamp"
    ),
    "foxglove.PosesInFrame": _pose_fields(
        "poses.0.position", "poses.0.orientation", "timestamp"
    ),
    "foxglove.FrameTransform": _pose_fields(
        "translation", "rotation", "timestamp"
    ),
    "gps_msgs/msg/GPSFix": "t=header.stamp,lat_deg=latitude,lon_deg=longitude,height=altitude",
    "foxglove.LocationFix": "t=timestamp,lat_deg=latitude,lon_deg=longitude,height=altitude",
}
# All types, the most frequent first.
_ROWS = [
    MessageType(
        "nav_msgs/msg/Odometry", _OF_POSES, unpack_pose, has_child_frame=True
    ),
    MessageType("geometry_msgs/msg/PoseStamped", _OF_POSES, unpack_pose),
    MessageType(
        "geometry_msgs/msg/PoseWithCovarianceStamped", _OF_POSES, unpack_pose
    ),
    MessageType(
        "geometry_msgs/msg/TransformStamped",
        _OF_POSES,
        unpack_pose,
        has_child_frame=True,
    ),
    MessageType(PATH_TYPE, _OF_POSES),
    MessageType("sensor_msgs/msg/Imu", ("rates", "rotations"), _imu),
    MessageType("sensor_msgs/msg/NavSatFix", _OF_POINTS, unpack_fix),
    MessageType("geometry_msgs/msg/PointStamped", _OF_POINTS, _point),
]
for _name, _fields in _FIELDS.items():
    _measures = _OF_POINTS if _name.endswith("Fix") else _OF_POSES
    _ROWS.append(MessageType(_name, _measures, fields=_fields))
_ROWS.append(MessageType(POINTS_TYPE, _OF_POSES))
_ROWS.append(MessageType(JOINTS_TYPE, ("wheels", "steering", "tricycle")))

MESSAGE_TYPES = {row.name: row for row in _ROWS}
#: Types whose messages contain a complete pose that is unpacked from the bytes.
POSE_TYPES = tuple(row.name for row in _ROWS if row.unpack is unpack_pose)
#: Types whose header contains the sensor's frame instead of a world frame.
SENSOR_TYPES = tuple(
    row.name for row in _ROWS if row.unpack in (_imu, unpack_fix)
)
#: Types whose messages contain a complete pose, with fields that a library decodes.
FIELD_POSE_TYPES = tuple(
    name
    for name, fields in _FIELDS.items()
    if "qw=" in fields or "roll" in fields
)


def quantities_of_types() -> dict[str, str]:
    """Return the quantity in the messages of each readable type, for a list of topics."""
    quantities = {row.name: row.measures[0] for row in _ROWS}
    return {
        **quantities,
        **dict.fromkeys(TF_TYPES, "frames"),
        POINTS_TYPE: "points",
    }


def measured_as(message_type: str, wanted: str, source: object) -> str:
    """Return the quantity to read from messages of a type.

    Parameters
    ----------
    message_type : str
        Empty for transforms.
    wanted : str
        Quantity that the user requests, or "auto" for the usual quantity of the type.
    source : object
        Name of the topic in the error.

    Raises
    ------
    ConfigError
        If the messages do not contain the wanted quantity.
    """
    row = MESSAGE_TYPES.get(message_type)
    possible = row.measures if row else _OF_POSES
    if wanted == "auto":
        return possible[0]
    if not {wanted, MEASURES[wanted].read_as} & {*possible}:
        raise ConfigError(
            f"{source} has messages of type {message_type or 'tf2_msgs/msg/TFMessage'}, which "
            f"measure {' or '.join(possible)}; the options ask for {wanted}"
        )
    return wanted


# ---- fields of decoded messages


def ns_of(stamp: Any) -> int | None:
    """Return a stamp in ns; None if the object is not a stamp.

    Stamps of ROS, of JSON in Foxglove and of protobuf have different field names.
    """
    for seconds, nanoseconds in (
        ("sec", "nanosec"),
        ("sec", "nsec"),
        ("seconds", "nanos"),
    ):
        if hasattr(stamp, nanoseconds):
            return int(
                getattr(stamp, seconds) * NS_PER_S + getattr(stamp, nanoseconds)
            )
    return None


def pose_row(position: Any, orientation: Any) -> tuple[float, ...]:
    """Return x y z qx qy qz qw of the position (or translation) and orientation of a message."""
    xyz = (position.x, position.y, position.z)
    return (*xyz, orientation.x, orientation.y, orientation.z, orientation.w)


def transform_of(message: Any) -> PoseFields:
    """Return a transform of ROS or of Foxglove. Frame names lose their leading slash."""
    if hasattr(message, "header"):
        stamp = message.header.stamp
        parent = message.header.frame_id
        pose = message.transform
    else:
        stamp = message.timestamp
        parent = message.parent_frame_id
        pose = message
    parent = printable(frame_name(parent[:LONGEST_NAME]))
    frame = printable(frame_name(message.child_frame_id[:LONGEST_NAME]))
    row = pose_row(pose.translation, pose.rotation)
    return PoseFields(ns_of(stamp) or 0, parent, frame, row[:3], row[3:])


class Run(NamedTuple):
    """Messages of one kind in the order of bag time, with their bag times (N,), ns."""

    kind: MessageKind
    messages: list[bytes]
    bag_ns: IntArray

    def decoded(self) -> Iterator[Any]:
        """Iterate over the messages as objects with their fields.

        Raises
        ------
        InputError
            If a message cannot be decoded.
        """
        decode = decoder_of(self.kind)
        for data in self.messages:
            try:
                message = decode(data)
            # The libraries raise errors of many kinds.
            except Exception as error:
                raise self.unreadable(error) from error
            yield message

    def transforms(self) -> Iterator[tuple[int, PoseFields]]:
        """Iterate over the transforms in messages of one of TF_TYPES, each with its bag time (ns).

        Raises
        ------
        InputError
            If a message cannot be decoded.
        """
        for message, bag_ns in zip(
            self.decoded(), self.bag_ns.tolist(), strict=True
        ):
            try:
                for transform in getattr(message, "transforms", [message]):
                    yield bag_ns, transform_of(transform)
            except (
                AttributeError,
                TypeError,
            ) as error:
                # A message in JSON may have any fields.
                raise self.unreadable(error) from error

    def unreadable(self, error: Exception) -> InputError:
        """Return the error for a message that cannot be read; ``error`` is the reason."""
        return InputError(
            f"{self.kind.topic}: a message of type {self.kind.type} cannot be "
            f"read ({error}); the bag is damaged: record it again"
        )
