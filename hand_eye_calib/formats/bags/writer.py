"""Write trajectories into bags with the library rosbags."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.core.base.config import STAMP_UNITS
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.bags.storage import rosbags
from hand_eye_calib.formats.files import writing

# Trajectory and message type of each topic.
Streams = Mapping[str, tuple[Trajectory, str]]

_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_PATH = "nav_msgs/msg/Path"


def write_bag(
    path: str | Path, streams: Streams, storage: str = "mcap"
) -> None:
    """Write trajectories into a new bag. The poses of all topics are sorted by their stamps.

    Parameters
    ----------
    path : str or Path
        Directory of the bag; for rosbag1, the ``.bag`` file. It must not exist.
    streams : mapping of str to (Trajectory, str)
        Trajectory and message type of each topic: Odometry, TFMessage, PoseStamped or Path. Only
        Odometry and TFMessage contain the sensor's frame. A Path is one message with all poses.
        The stamps of the trajectory are header stamps and bag times. Subscribers that join late
        still receive topics of one message.
    storage : {"mcap", "sqlite3", "rosbag1"}

    Raises
    ------
    InputError
        If the bag cannot be written.
    """
    path = Path(path)
    options: dict[str, object] = {}
    if storage == "rosbag1":
        library = rosbags(1)
    else:
        library = rosbags(2)
        options = {
            "version": 9,
            "storage_plugin": library.StoragePlugin[storage.upper()],
        }
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with library.Writer(path, **options) as writer:
            write_streams(writer, streams, storage)


def write_streams(writer: Any, streams: Streams, storage: str) -> None:
    """Write trajectories with an open writer of rosbags; see :func:`write_bag`."""
    from rosbags.typesys import Stores, get_typestore

    is_ros1 = storage == "rosbag1"
    typestore = get_typestore(
        Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY
    )
    serialize = typestore.serialize_ros1 if is_ros1 else typestore.serialize_cdr
    rows = []
    for topic, (trajectory, message_type) in streams.items():
        messages = list(
            stamped_messages(typestore.types, trajectory, message_type, is_ros1)
        )
        options = {}
        if len(messages) == 1 and not is_ros1:
            options["offered_qos_profiles"] = [_latched()]
        connection = writer.add_connection(
            topic, message_type, typestore=typestore, **options
        )
        for stamp_ns, message in messages:
            rows.append((stamp_ns, connection, message))
    rows.sort(key=lambda row: row[0])
    for stamp_ns, connection, message in rows:
        writer.write(
            connection, stamp_ns, serialize(message, connection.msgtype)
        )


def _latched() -> Any:
    """Return the QoS of a topic whose last message is sent to late subscribers, as /tf_static."""
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    unlimited = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        unlimited,
        unlimited,
        QosLiveliness.AUTOMATIC,
        unlimited,
        False,
    )


def stamped_messages(
    types: Mapping[str, Any],
    trajectory: Trajectory,
    message_type: str,
    is_ros1: bool,
) -> Iterator[tuple[int, Any]]:
    """Iterate over the stamps (ns) and messages of a trajectory.

    ``types`` has the classes of messages in rosbags, by message type. A Path is one message with
    the first stamp.
    """
    if message_type == _PATH:
        stamped = stamped_messages(
            types, trajectory, "geometry_msgs/msg/PoseStamped", is_ros1
        )
        poses = [message for _, message in stamped]
        yield (
            int(trajectory.stamps_ns[0]),
            types[_PATH](poses[0].header, poses),
        )
        return

    def make(name: str, *values: Any) -> Any:
        return types[f"geometry_msgs/msg/{name}"](*values)

    zero = make("Vector3", 0.0, 0.0, 0.0)
    no_covariance = np.zeros(36)
    twist = make(
        "TwistWithCovariance", make("Twist", zero, zero), no_covariance
    )
    rows = se3.to_rows(trajectory.poses).tolist()
    for number, stamp_ns in enumerate(trajectory.stamps_ns.tolist()):
        stamp = types["builtin_interfaces/msg/Time"](
            *divmod(stamp_ns, STAMP_UNITS["s"])
        )
        sequence = {"seq": number} if is_ros1 else {}
        header = types["std_msgs/msg/Header"](
            stamp=stamp, frame_id=trajectory.world_frame, **sequence
        )
        x, y, z, *quat_xyzw = rows[number]
        rotation = make("Quaternion", *quat_xyzw)
        if message_type == _TRANSFORMS:
            transform = make("Transform", make("Vector3", x, y, z), rotation)
            stamped_transform = make(
                "TransformStamped", header, trajectory.sensor_frame, transform
            )
            yield stamp_ns, types[_TRANSFORMS]([stamped_transform])
            continue
        pose = make("Pose", make("Point", x, y, z), rotation)
        parts: tuple[Any, ...] = (pose,)
        if message_type == "nav_msgs/msg/Odometry":
            with_covariance = make("PoseWithCovariance", pose, no_covariance)
            parts = (trajectory.sensor_frame, with_covariance, twist)
        yield stamp_ns, types[message_type](header, *parts)
