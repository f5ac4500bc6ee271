"""Bags written from trajectories, with the library rosbags."""

import heapq
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.core.base.config import STAMP_UNITS
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.bags.storage import rosbags
from hand_eye_calib.formats.files import writing

STORAGES = ("mcap", "sqlite3", "rosbag1")

Streams = Mapping[str, tuple[Trajectory, str]]


def write_bag(path: str | Path, streams: Streams, storage: str = "mcap") -> None:
    """Write trajectories into a new bag, the poses of all topics in the order of their stamps.

    ``path`` is the directory to make, or for rosbag1 the ``.bag`` file; neither may exist.
    ``streams`` are topics with trajectory and message type, Odometry (with the sensor's frame) or
    PoseStamped; stamps are written to both header and bag. ``storage`` is one of STORAGES.
    """
    path = Path(path)
    library = rosbags(1 if storage == "rosbag1" else 2)
    about: dict[str, object] = {}
    if storage != "rosbag1":
        about = {"version": 9, "storage_plugin": library.StoragePlugin[storage.upper()]}
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with library.Writer(path, **about) as writer:
            write_streams(writer, streams, storage)


def write_streams(writer: Any, streams: Streams, storage: str) -> None:
    """Write trajectories with a writer of rosbags that is open; see :func:`write_bag`."""
    from rosbags.typesys import Stores, get_typestore

    is_ros1 = storage == "rosbag1"
    typestore = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY)
    serialize = typestore.serialize_ros1 if is_ros1 else typestore.serialize_cdr
    sequences = []
    for topic, (trajectory, message_type) in streams.items():
        connection = writer.add_connection(topic, message_type, typestore=typestore)
        messages = stamped_messages(typestore.types, trajectory, message_type, is_ros1)
        sequences.append([(stamp_ns, connection, message) for stamp_ns, message in messages])
    for stamp_ns, connection, message in heapq.merge(*sequences, key=lambda item: item[0]):
        writer.write(connection, stamp_ns, serialize(message, connection.msgtype))


def stamped_messages(
    types: Mapping[str, Any], trajectory: Trajectory, message_type: str, is_ros1: bool
) -> Iterator[tuple[int, Any]]:
    """Iterate over stamps in ns and messages of a trajectory; ``types`` are rosbags' classes."""

    def make(name: str, *values: Any) -> Any:
        return types[f"geometry_msgs/msg/{name}"](*values)

    zero = make("Vector3", 0.0, 0.0, 0.0)
    no_covariance = np.zeros(36)
    twist = make("TwistWithCovariance", make("Twist", zero, zero), no_covariance)
    rows = zip(trajectory.stamps_ns, se3.to_rows(trajectory.poses).tolist(), strict=True)
    for number, (stamp_ns, row) in enumerate(rows):
        stamp = types["builtin_interfaces/msg/Time"](*divmod(int(stamp_ns), STAMP_UNITS["s"]))
        sequence = {"seq": number} if is_ros1 else {}
        head = {"stamp": stamp, "frame_id": trajectory.world_frame, **sequence}
        pose = make("Pose", make("Point", *row[:3]), make("Quaternion", *row[3:]))
        parts: tuple[Any, ...] = (pose,)
        if message_type == "nav_msgs/msg/Odometry":
            with_covariance = make("PoseWithCovariance", pose, no_covariance)
            parts = (trajectory.sensor_frame, with_covariance, twist)
        yield int(stamp_ns), types[message_type](types["std_msgs/msg/Header"](**head), *parts)
