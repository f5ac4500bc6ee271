"""Poses from any message of which the bag has the definition, by paths to its fields:
``/topic?t=header.stamp,x=pose.position.x,...``. Names before the equals sign are those of columns
in csv files, with their units; vx, vy, vz, wx, wy, wz are integrated.
"""

import json
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.io.bags.poses import TwistIntegrator

_POSITION, _ORIENTATION = "x={0}.x,y={0}.y,z={0}.z", "qx={0}.x,qy={0}.y,qz={0}.z,qw={0}.w"


def _pose(at: str, stamp: str = "header.stamp") -> str:
    position = _POSITION.format(f"{at}.position")
    return f"t={stamp},{position},{_ORIENTATION.format(f'{at}.orientation')}"


_PX4 = "t_us=timestamp_sample,x=position.0,y=position.1,z=position.2,qw=q.0,qx=q.1,qy=q.2,qz=q.3"
#: Types of messages that are read this way, and how. Of arrays, the first element.
FIELDS = {
    "px4_msgs/msg/VehicleOdometry": _PX4,
    "geometry_msgs/msg/PoseArray": _pose("poses.0"),
    "mocap4r2_msgs/msg/RigidBodies": _pose("rigidbodies.0.pose"),
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": _pose("poses.0.pose"),
    "foxglove.PoseInFrame": _pose("pose", "timestamp"),
    "foxglove.FrameTransform": "t=timestamp,"
    + _POSITION.format("translation")
    + ","
    + _ORIENTATION.format("rotation"),
    "foxglove.LocationFix": "t=timestamp,lat=latitude,lon=longitude,height=altitude",
}
_VELOCITIES = ("vx", "vy", "vz", "wx", "wy", "wz")


def split_fields(source: str) -> tuple[str, str]:
    """Topic and fields of a source; no fields if it names none."""
    topic, _, fields = source.partition("?")
    return topic, fields


def decoder(name: str, encoding: str, definition: Any = None) -> Callable[[bytes], Any]:
    """What makes a message of its bytes.

    Parameters
    ----------
    name, encoding : str
        Of the message type.
    definition : rosbags.interfaces.MessageDefinition, optional
        That of the bag.

    Raises
    ------
    InputError
        If there is none, or the encoding is not known.
    """
    if encoding == "json":
        return json.loads
    if encoding not in ("cdr", "ros1"):
        raise InputError(
            f"messages of type {name} are encoded as {encoding[:40]!r}; expected cdr, ros1 or json"
        )
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    is_ros1 = encoding == "ros1"
    types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY)
    text = getattr(definition, "data", "")
    try:
        if text and name not in types.types:
            is_idl = definition.format.name == "IDL"
            known = get_types_from_idl(text) if is_idl else get_types_from_msg(text, name)
            types.register({key: each for key, each in known.items() if key not in types.types})
        if name not in types.types:
            raise KeyError(name)
    except Exception as error:  # of many kinds, at damaged definitions
        raise InputError(
            f"the bag has no definition of {name} that can be read; record it as mcap, which "
            "stores definitions"
        ) from error
    read = types.deserialize_ros1 if is_ros1 else types.deserialize_cdr
    return lambda data: read(data, name)


def rows_of_messages(
    topic: str, fields: str, messages: Iterable[Any]
) -> tuple[IntArray, FloatArray, list[str]]:
    """Stamps (N,) in ns and poses (N, 7) of x y z qx qy qz qw of decoded messages, and notes for a
    person.

    Raises
    ------
    ConfigError
        If the fields are not written as they should be.
    InputError
        If a message does not have them.
    """
    from hand_eye_calib.io.trajectory_files.columns import choose_columns
    from hand_eye_calib.io.trajectory_files.poses import poses_of, stamps_in_ns
    from hand_eye_calib.io.trajectory_files.table import Table, table_of

    pairs = [each.partition("=")[::2] for each in fields.split(",")]
    if not all(name and path for name, path in pairs):
        raise ConfigError(
            "fields are written NAME=PATH,..., such as t=header.stamp,x=pose.position.x; got "
            f"{fields!r}"
        )
    names, paths = [name for name, _ in pairs], [path.split(".") for _, path in pairs]
    is_twist = {*_VELOCITIES} <= {*names}
    rows = enumerate(messages, 1)

    def cells_of(message: Any) -> list[str]:
        return [_text(topic, message, path) for path in paths]

    if is_twist:
        chosen = choose_columns(topic, names, measures="rates")
        table = Table(topic, fields, _VELOCITIES, chosen.stamp_unit)
        at = [names.index(name) for name in _VELOCITIES]
        table.fill(rows, cells_of, len(names), at, chosen.stamp)
    else:
        table = table_of(topic, names, rows, cells_of)
    if not table.stamps:
        raise InputError(f"no messages on {topic}")
    stamps_ns = stamps_in_ns(table, None)
    if is_twist:
        twists = np.asarray(table.numbers).reshape(-1, len(_VELOCITIES))
        return stamps_ns, TwistIntegrator().poses(stamps_ns, twists), []
    positions, quats_xyzw = poses_of(table)
    return stamps_ns, np.c_[positions, quats_xyzw], table.guesses


def _text(topic: str, message: Any, path: list[str]) -> str:
    """A value of a message; a stamp in seconds with all its digits."""
    value = message
    for part in path:
        try:
            if isinstance(value, dict):
                value = value[part]
            else:
                value = value[int(part)] if part.isdecimal() else getattr(value, part)
        except (AttributeError, KeyError, IndexError, TypeError):
            raise InputError(
                f"{topic}: a message has no {'.'.join(path)}; name other fields"
            ) from None
    get = value.get if isinstance(value, dict) else lambda name: getattr(value, name, None)
    if get("sec") is not None:
        fraction = next((get(name) for name in ("nanosec", "nsec", "nanosecs") if get(name)), 0)
        return f"{get('sec')}.{fraction:09d}"
    return str(value)
