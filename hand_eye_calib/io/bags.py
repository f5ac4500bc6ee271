"""Poses in bags: rosbag2 (sqlite3, mcap) and rosbag1, read and written without ROS. The only module that imports rosbags.

All accepted message types begin with the same bytes: a ``std_msgs/Header``, for some the sensor's frame, then seven doubles.
Only those bytes are unpacked, which takes a tenth of the time of a whole message and needs no type definitions; what else is in
the bag cannot get in the way.
"""

import heapq
import struct
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry import se3

# Whether a message carries the sensor's frame, a string, between header and pose.
POSE_TYPES = {
    "nav_msgs/msg/Odometry": True,
    "geometry_msgs/msg/PoseStamped": False,
}
STORAGES = ("mcap", "sqlite3", "rosbag1")

_NS_PER_S = 1_000_000_000


class TopicInfo(NamedTuple):
    """A topic of a bag: its name, its message type ("" where publishers disagree) and its number of messages."""

    name: str
    type: str
    count: int

    def __str__(self):
        return f"{self.name} ({self.type or 'several types'}, {self.count} messages)"


class StampedPose(NamedTuple):
    """A pose message.

    Attributes
    ----------
    stream : str
        "parent" or "child".
    number : int
        Of the message within its topic, from 1.
    stamp_ns : int
        From the header.
    world_frame : str
    sensor_frame : str or None
        None where the message type does not carry it.
    position : tuple of 3 floats
        m.
    quat_xyzw : tuple of 4 floats
        As recorded: not checked, not normalised.
    """

    stream: str
    number: int
    stamp_ns: int
    world_frame: str
    sensor_frame: str | None
    position: tuple
    quat_xyzw: tuple


class PoseBag:
    """A bag opened for reading; a context manager.

    Parameters
    ----------
    path : str or path-like
        A rosbag2 directory, a single ``.mcap`` or ``.db3`` file of one, or a rosbag1 ``.bag`` file.

    Raises
    ------
    InputError
        Where there is no bag or it cannot be read: one line that names the path and says what to do.
    """

    def __init__(self, path):
        self.path = Path(path)
        _check_path(self.path)
        self._is_rosbag2 = self.path.is_dir() or self.path.suffix != ".bag"
        self._unpack = _unpack_cdr if self._is_rosbag2 else _unpack_ros1
        with self._reading():
            self._reader = (rosbag2 if self._is_rosbag2 else rosbag1).Reader(self.path)
            self._reader.open()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """Close the files."""
        self._reader.close()

    def topics(self):
        """All topics of the bag, a list of TopicInfo in the order of their names."""
        infos = self._reader.topics
        return [TopicInfo(name, infos[name].msgtype or "", infos[name].msgcount) for name in sorted(infos)]

    def select_topics(self, parent_topic=None, child_topic=None):
        """Names of the parent's and the child's topic.

        A topic that is not named is chosen where the bag leaves only one way to do it: with neither named, it has exactly two
        topics of poses, and the first in alphabetical order becomes the parent.

        Raises
        ------
        InputError
            Where a named topic is not in the bag or holds no poses, where both are the same, or where there is a choice to make.
            The message lists the topics that are there.
        """
        topics = {topic.name: topic for topic in self.topics()}
        named = [name for name in (parent_topic, child_topic) if name]
        for name in named:
            self._check_topic(name, topics)
        if len(named) == 2 and named[0] == named[1]:
            raise InputError(f"parent and child topic are both {parent_topic}; name two topics. {self._listing(topics)}")
        free = [name for name, topic in topics.items() if topic.type in POSE_TYPES and name not in named]
        if len(named) < 2 and len(free) != 2 - len(named):
            raise InputError(f"name the topics of poses with --parent-topic and --child-topic. {self._listing(topics)}")
        return parent_topic or free.pop(0), child_topic or free.pop(0)

    def _check_topic(self, name, topics):
        if name not in topics:
            raise InputError(f"no topic {name} in {self.path}. {self._listing(topics)}")
        if topics[name].type not in POSE_TYPES:
            raise InputError(
                f"topic {name} of {self.path} is of type {topics[name].type or 'several types'}; accepted are "
                f"{', '.join(POSE_TYPES)}. {self._listing(topics)}"
            )

    def _listing(self, topics):
        return f"The bag has {', '.join(map(str, topics.values()))}" if topics else f"There are no topics in {self.path}"

    def poses(self, parent_topic, child_topic):
        """Iterate over the messages of both topics in the order of the bag's time.

        Yields
        ------
        StampedPose

        Raises
        ------
        InputError
            Where the bag turns out to be damaged.
        """
        streams = {parent_topic: "parent", child_topic: "child"}
        numbers = dict.fromkeys(streams, 0)
        for topic, message_type, data in self._messages(streams):
            numbers[topic] += 1
            try:
                pose = self._unpack(data, POSE_TYPES[message_type])
            except (struct.error, ValueError) as error:
                raise InputError(
                    f"{topic}, message {numbers[topic]}: not a readable {message_type} ({error}); the bag is damaged, record it again"
                ) from error
            yield StampedPose(streams[topic], numbers[topic], *pose)

    def _messages(self, topics):
        with self._reading():
            connections = [connection for connection in self._reader.connections if connection.topic in topics]
            if self._is_rosbag2:
                connections = [connection._replace(ext=_AnyQos()) for connection in connections]
            for connection, _, data in self._reader.messages(connections):
                yield connection.topic, connection.msgtype, data

    @contextmanager
    def _reading(self):
        """Whatever the reader stumbles over becomes one line.

        A damaged file makes rosbags, sqlite, lz4 or zstd raise nearly anything, assertions and key errors included. Nothing but
        their code runs inside, so no defect of this package is hidden.
        """
        try:
            yield
        except Exception as error:
            reason = " ".join([f"{type(error).__name__}:", *str(error).split()]).rstrip(".:")
            repair = "'mcap recover' or sqlite3's '.recover'" if self._is_rosbag2 else "'rosbag reindex'"
            raise InputError(
                f"cannot read bag {self.path}: it is cut off, damaged or of an unsupported kind ({reason}); "
                f"repair it with {repair}, or record it again"
            ) from error


class _AnyQos:
    """Stands in for a connection's QoS profiles where the reader compares them.

    A rosbag2 directory may describe the QoS of a topic differently in metadata.yaml and in its storage files (converted bags do).
    The reader would then silently yield none of the topic's messages.
    """

    __hash__ = None

    def __eq__(self, other):
        return True


def _check_path(path):
    """The mistakes that are easily made and easily explained."""
    if not path.exists():
        raise InputError(f"no bag at {path}; expected a rosbag2 directory, a .mcap or .db3 file of one, or a rosbag1 .bag file")
    if path.is_file() and path.suffix not in (".bag", ".mcap", ".db3"):
        raise InputError(
            f"{path} is not a bag; expected a rosbag2 directory, a .mcap or .db3 file of one, or a rosbag1 .bag file"
        )
    if path.is_file() and path.stat().st_size == 0:
        raise InputError(f"bag {path} is an empty file; record it again")
    if path.is_dir() and not (path / "metadata.yaml").exists():
        parts = sorted(part.name for part in path.iterdir() if part.suffix in (".mcap", ".db3"))
        raise InputError(
            f"no metadata.yaml in {path}, so it is no complete rosbag2 directory; "
            + (
                f"run 'ros2 bag reindex {path}' or read one of its files alone: {', '.join(parts)}"
                if parts
                else "check the path"
            )
        )


class _Packing(NamedTuple):
    """Formats of the parts of a message in one byte order."""

    time: struct.Struct
    length: struct.Struct
    pose: struct.Struct


def _packing(byte_order, time):
    return _Packing(*(struct.Struct(byte_order + part) for part in (time, "I", "7d")))


_CDR = {b"\x00\x00": _packing(">", "iI"), b"\x00\x01": _packing("<", "iI")}
_ROS1 = _packing("<", "II")


def _unpack_cdr(data, has_sensor_frame):
    """Fields of StampedPose after ``number``, from CDR: 4 bytes say how it is encoded, alignment counts from there."""
    packing = _CDR.get(bytes(data[:2]))
    if packing is None:
        raise ValueError(f"expected plain CDR, found encoding 0x{bytes(data[:2]).hex()}")
    seconds, nanoseconds = packing.time.unpack_from(data, 4)
    world_frame, end = _unpack_cdr_string(packing, data, 12)
    sensor_frame = None
    if has_sensor_frame:
        sensor_frame, end = _unpack_cdr_string(packing, data, end + -end % 4)
    pose = packing.pose.unpack_from(data, end + (4 - end) % 8)
    return seconds * _NS_PER_S + nanoseconds, world_frame, sensor_frame, pose[:3], pose[3:]


def _unpack_cdr_string(packing, data, start):
    """A string that ends in a zero byte, and where the next field may begin."""
    (length,) = packing.length.unpack_from(data, start)
    end = start + 4 + length
    return str(data[start + 4 : max(end - 1, start + 4)], "utf-8"), end


def _unpack_ros1(data, has_sensor_frame):
    """Fields of StampedPose after ``number``, from ROS 1: little-endian, not aligned, a sequence number first."""
    seconds, nanoseconds = _ROS1.time.unpack_from(data, 4)
    world_frame, end = _unpack_ros1_string(data, 12)
    sensor_frame = None
    if has_sensor_frame:
        sensor_frame, end = _unpack_ros1_string(data, end)
    pose = _ROS1.pose.unpack_from(data, end)
    return seconds * _NS_PER_S + nanoseconds, world_frame, sensor_frame, pose[:3], pose[3:]


def _unpack_ros1_string(data, start):
    (length,) = _ROS1.length.unpack_from(data, start)
    end = start + 4 + length
    return str(data[start + 4 : end], "utf-8"), end


def write_bag(path, streams, storage="mcap"):
    """Write trajectories into a new bag, the poses of all topics interleaved in the order of their stamps.

    Parameters
    ----------
    path : str or path-like
        Directory to make, or for rosbag1 the ``.bag`` file. It must not exist.
    streams : mapping of str to (Trajectory, str)
        Topic to trajectory and message type, one of POSE_TYPES. Where the type has a place for the sensor's frame, the
        trajectory's is put there. Stamps are written to both header and bag.
    storage : str
        "mcap", "sqlite3" or "rosbag1".

    Raises
    ------
    InputError
        Where the path exists or cannot be written.
    ConfigError
        For an unknown storage or message type.
    """
    path = Path(path)
    if storage not in STORAGES:
        raise ConfigError(f"unknown bag storage {storage!r}; known are {', '.join(STORAGES)}")
    unknown = [message_type for _, message_type in streams.values() if message_type not in POSE_TYPES]
    if unknown:
        raise ConfigError(f"cannot write messages of type {unknown[0]!r}; known are {', '.join(POSE_TYPES)}")
    if (path.suffix == ".bag") != (storage == "rosbag1"):
        raise InputError(f"cannot write {path} as {storage}: a rosbag1 file, and nothing else, must be named .bag")
    if path.exists():
        raise InputError(f"{path} exists already; remove it or choose another name")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _writer(path, storage) as writer:
            _write_streams(writer, streams, storage)
    except OSError as error:
        raise InputError(f"cannot write bag {path}: {error.strerror}") from None


def _writer(path, storage):
    if storage == "rosbag1":
        return rosbag1.Writer(path)
    return rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[storage.upper()])


def _write_streams(writer, streams, storage):
    is_rosbag1 = storage == "rosbag1"
    typestore = get_typestore(Stores.ROS1_NOETIC if is_rosbag1 else Stores.ROS2_JAZZY)
    serialize = typestore.serialize_ros1 if is_rosbag1 else typestore.serialize_cdr
    sequences = []
    for topic, (trajectory, message_type) in streams.items():
        connection = writer.add_connection(topic, message_type, typestore=typestore)
        sequences.append(_stamped_messages(typestore, trajectory, message_type, is_rosbag1, connection))
    for stamp_ns, connection, message in heapq.merge(*sequences, key=lambda item: item[0]):
        writer.write(connection, stamp_ns, serialize(message, connection.msgtype))


def _stamped_messages(typestore, trajectory, message_type, is_rosbag1, connection):
    types = typestore.types
    zero, no_covariance = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0), np.zeros(36)
    twist = types["geometry_msgs/msg/TwistWithCovariance"](types["geometry_msgs/msg/Twist"](zero, zero), no_covariance)
    positions, quats_xyzw = trajectory.poses[:, :3, 3].tolist(), se3.to_quat_xyzw(trajectory.poses).tolist()
    for number, stamp_ns in enumerate(trajectory.stamps_ns.tolist()):
        header = types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, _NS_PER_S)),
            frame_id=trajectory.world_frame,
            **({"seq": number} if is_rosbag1 else {}),
        )
        pose = types["geometry_msgs/msg/Pose"](
            types["geometry_msgs/msg/Point"](*positions[number]), types["geometry_msgs/msg/Quaternion"](*quats_xyzw[number])
        )
        if message_type == "nav_msgs/msg/Odometry":
            pose = types["geometry_msgs/msg/PoseWithCovariance"](pose, no_covariance)
            yield stamp_ns, connection, types[message_type](header, trajectory.sensor_frame, pose, twist)
        else:
            yield stamp_ns, connection, types[message_type](header, pose)
