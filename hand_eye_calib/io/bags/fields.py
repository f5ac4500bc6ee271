"""Poses from any message of which the bag has the definition, by paths to its fields:
``/topic?t=header.stamp,x=pose.position.x,...``. Names before the equals sign are those of columns
in csv files, with their units; vx, vy, vz, wx, wy, wz are integrated.
"""

import json
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.bags.mcap_files import MessageKind
from hand_eye_calib.io.trajectory_files.poses import poses_of, stamps_in_ns
from hand_eye_calib.io.trajectory_files.table import TWIST, Table

_ORIENTATION = "qx={0}.x,qy={0}.y,qz={0}.z,qw={0}.w"


def _pose(at: str, stamp: str = "header.stamp", parts: str = "position orientation") -> str:
    position, orientation = (f"{at}{part}" for part in parts.split())
    place = f"x={position}.x,y={position}.y,z={position}.z"
    return f"t={stamp},{place},{_ORIENTATION.format(orientation)}"


def _twist(at: str) -> str:
    parts = [*(f"linear.{axis}" for axis in "xyz"), *(f"angular.{axis}" for axis in "xyz")]
    fields = (f"{name}={at}.{part}" for name, part in zip(TWIST, parts, strict=True))
    return ",".join(["t=header.stamp", *fields])


_PLACE = "lat_deg={0}latitude,lon_deg={0}longitude,height={0}altitude"
#: Types of messages that are read this way, and how. Of arrays, the first element.
FIELDS = {
    "geographic_msgs/msg/GeoPoseStamped": f"t=header.stamp,{_PLACE.format('pose.position.')},"
    + _ORIENTATION.format("pose.orientation"),
    "geometry_msgs/msg/TwistStamped": _twist("twist"),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twist("twist.twist"),
    "px4_msgs/msg/VehicleOdometry": "t_us=timestamp_sample,x=position.0,y=position.1,z=position.2,"
    "qw=q.0,qx=q.1,qy=q.2,qz=q.3",
    "geometry_msgs/msg/PoseArray": _pose("poses.0."),
    "mocap4r2_msgs/msg/RigidBodies": _pose("rigidbodies.0.pose."),
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": _pose("poses.0.pose."),
    "foxglove.PoseInFrame": _pose("pose.", "timestamp"),
    "foxglove.FrameTransform": _pose("", "timestamp", "translation rotation"),
    "foxglove.LocationFix": f"t=timestamp,{_PLACE.format('')}",
}


def split_fields(source: str) -> tuple[str, str]:
    """Topic and fields of a source; no fields if it names none."""
    topic, _, fields = source.partition("?")
    return topic, fields


class FieldReader:
    """Reads the fields of a topic's messages; a ConfigError if they are not written as they should
    be.
    """

    def __init__(self, topic: str, fields: str) -> None:
        pairs = [each.partition("=")[::2] for each in fields.split(",")]
        if not all(name and path for name, path in pairs):
            raise ConfigError(
                "fields are written NAME=PATH,..., such as t=header.stamp,x=pose.position.x; got "
                f"{fields!r}"
            )
        self._topic = topic
        self._names = [name for name, _ in pairs]
        self._paths = [path.split(".") for _, path in pairs]

    def cells_of(self, kind: MessageKind) -> Callable[..., list[str]]:
        """What reads the values of a message of this kind, stamps in seconds with all their digits;
        an InputError if it lacks one.
        """
        decode = _decoder(kind)

        def cells(data: bytes, is_ros1: bool) -> list[str]:
            message = decode(data)
            return [self._text(message, path) for path in self._paths]

        return cells

    def _text(self, value: Any, path: list[str]) -> str:
        try:
            for part in path:
                if isinstance(value, dict):
                    value = value[part]
                else:
                    value = value[int(part)] if part.isdecimal() else getattr(value, part)
        except (AttributeError, KeyError, IndexError, TypeError):
            raise InputError(
                f"{self._topic}: a message has no {'.'.join(path)}; name other fields"
            ) from None
        stamp = value if isinstance(value, dict) else getattr(value, "__dict__", {})
        if "sec" not in stamp:
            return str(value)
        return f"{stamp['sec']}.{stamp.get('nanosec', stamp.get('nsec', 0)):09d}"

    def poses(self, rows: Iterable[list[str]]) -> tuple[IntArray, FloatArray, list[str]]:
        """Stamps (N,) in ns and poses (N, 7) of x y z qx qy qz qw of the cells of messages, and
        notes for a person; an InputError if they are no poses.
        """
        measures = "twists" if {*TWIST} <= {*self._names} else "auto"
        table = Table(self._topic, self._names, measures).fill(enumerate(rows, 1), list)
        if not table.stamps:
            raise InputError(f"no messages on {self._topic}, or none of its fields is a stamp, t")
        stamps_ns = stamps_in_ns(table, None)
        if measures == "twists":
            return stamps_ns, _integrated(stamps_ns, table.values()), []
        if table.measures == "rates":
            raise InputError(f"{self._topic}: wx, wy, wz alone are no poses; name vx, vy, vz, too")
        return stamps_ns, np.c_[poses_of(table)], table.guesses


def _integrated(stamps_ns: IntArray, twists: FloatArray) -> FloatArray:
    """Poses (N, 7) of velocities (N, 6), m/s and rad/s, in the sensor's own frame."""
    steps = (twists[1:] + twists[:-1]) / 2 * (np.diff(stamps_ns) * 1e-9)[:, None]
    poses = np.tile(np.eye(4), (len(twists), 1, 1))
    for row, step in enumerate(se3.exp(steps), start=1):
        poses[row] = poses[row - 1] @ step
        poses[row, :3, :3] = se3.nearest_rotation(poses[row, :3, :3])
    return np.c_[poses[:, :3, 3], se3.to_quat_xyzw(poses)]


@lru_cache
def _decoder(kind: MessageKind) -> Callable[[bytes], Any]:
    """What makes a message of its bytes; an InputError if its definition or encoding is not
    known.
    """
    name, definition = kind.type, kind.definition
    if kind.encoding == "json":
        return json.loads
    if kind.encoding not in ("cdr", "ros1"):
        encoding = f"{kind.encoding[:40]!r}; expected cdr, ros1 or json"
        raise InputError(f"messages of type {name} are encoded as {encoding}")
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if kind.is_ros1 else Stores.ROS2_JAZZY)
    text = getattr(definition, "data", "")
    try:
        if text and name not in types.types:
            is_idl = definition.format.name == "IDL"
            known = get_types_from_idl(text) if is_idl else get_types_from_msg(text, name)
            types.register({key: each for key, each in known.items() if key not in types.types})
        types.types[name]
    except Exception as error:  # of many kinds, at damaged definitions
        raise InputError(
            f"the bag has no definition of {name} that can be read; record it as mcap, which "
            "stores definitions"
        ) from error
    read = types.deserialize_ros1 if kind.is_ros1 else types.deserialize_cdr
    return lambda data: read(data, name)
