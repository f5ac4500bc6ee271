"""Bags of whatever messages a test needs."""

from typing import NamedTuple

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.formats.bags.writer import write_streams

JAZZY = get_typestore(Stores.ROS2_JAZZY)
NOETIC = get_typestore(Stores.ROS1_NOETIC)
NOETIC.register(
    get_types_from_msg(
        "geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"
    )
)
NOETIC.register(
    get_types_from_msg(
        "geometry_msgs/TransformStamped[] transforms", "tf/msg/tfMessage"
    )
)
TF = "tf2_msgs/msg/TFMessage"
PATH = "nav_msgs/msg/Path"
ODOMETRY = "nav_msgs/msg/Odometry"
POINTS = "sensor_msgs/msg/PointCloud2"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
STORAGES = ("mcap", "sqlite3", "rosbag1")


def bag_path(folder, storage, name="bag"):
    return folder / (f"{name}.bag" if storage == "rosbag1" else name)


def storage_file(path):
    """The file that holds the messages of a bag."""
    if path.is_file():
        return path
    for file in path.iterdir():
        if file.suffix in (".mcap", ".db3"):
            return file
    raise FileNotFoundError(path)


class Pose(NamedTuple):
    """A row of a PoseTable."""

    stream: str
    stamp_ns: int
    world_frame: str
    sensor_frame: str | None
    pose: tuple[float, ...]
    bag_ns: int


def poses_of(bag, parent="/a", child="/b"):
    """The poses of an open bag one by one."""
    poses = bag.poses(parent, child)
    columns = [column.tolist() for column in vars(poses).values()]
    rows = zip(*columns, strict=True)
    return [Pose(*row[:4], tuple(row[4]), row[5]) for row in rows]


def all_poses(path, parent="/a", child="/b"):
    with PoseBag(path) as bag:
        return poses_of(bag, parent, child)


def write_compressed(path, streams, storage="mcap", mode="STORAGE"):
    """A rosbag2 compressed by zstd in some way, or not at all."""
    plugin = rosbag2.StoragePlugin[storage.upper()]
    writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    if mode:
        writer.set_compression(
            rosbag2.CompressionMode[mode], rosbag2.CompressionFormat.ZSTD
        )
    with writer:
        write_streams(writer, streams, storage)
    return path


def header(typestore, stamp_ns, frame):
    extra = {"seq": 0} if typestore is NOETIC else {}
    time_type = typestore.types["builtin_interfaces/msg/Time"]
    header_type = typestore.types["std_msgs/msg/Header"]
    seconds, nanoseconds = divmod(int(stamp_ns), 10**9)
    stamp = time_type(seconds, nanoseconds)
    return header_type(stamp=stamp, frame_id=frame, **extra)


def pose(typestore, matrix, kind="Pose"):
    """A Pose or Transform of a (4, 4) matrix."""
    types = typestore.types
    translation = matrix[:3, 3].tolist()
    quat_xyzw = se3.to_quat_xyzw(matrix).tolist()
    vector = types[
        "geometry_msgs/msg/Point"
        if kind == "Pose"
        else "geometry_msgs/msg/Vector3"
    ](*translation)
    return types[f"geometry_msgs/msg/{kind}"](
        vector, types["geometry_msgs/msg/Quaternion"](*quat_xyzw)
    )


def tf_message(edges, message_type=TF):
    """Makes a message of transforms: (stamp, parent, child, matrix) each."""

    def make(typestore):
        transforms = [
            typestore.types["geometry_msgs/msg/TransformStamped"](
                header(typestore, stamp_ns, parent),
                child,
                pose(typestore, matrix, "Transform"),
            )
            for stamp_ns, parent, child, matrix in edges
        ]
        return typestore.types[message_type](transforms)

    return make


def pose_message(message_type, stamp_ns, values, world="map", sensor="sensor"):
    """Makes a PoseStamped or an Odometry of x y z qx qy qz qw, whatever these are."""

    def make(typestore):
        def made(name, *parts):
            geometry_type = typestore.types[f"geometry_msgs/msg/{name}"]
            return geometry_type(*parts)

        row = [float(value) for value in values]
        position = made("Point", *row[:3])
        orientation = made("Quaternion", *row[3:])
        pose = made("Pose", position, orientation)
        parts = (pose,)
        if message_type == ODOMETRY:
            zero = made("Vector3", 0.0, 0.0, 0.0)
            no_motion = made("Twist", zero, zero)
            twist = made("TwistWithCovariance", no_motion, np.zeros(36))
            pose = made("PoseWithCovariance", pose, np.zeros(36))
            parts = (sensor, pose, twist)
        stamped_header = header(typestore, stamp_ns, world)
        return typestore.types[message_type](stamped_header, *parts)

    return make


def path_message(stamps_ns, poses, frame="map"):
    """Makes a nav_msgs/Path."""

    def make(typestore):
        steps = [
            typestore.types["geometry_msgs/msg/PoseStamped"](
                header(typestore, stamp_ns, frame), pose(typestore, matrix)
            )
            for stamp_ns, matrix in zip(stamps_ns, poses, strict=True)
        ]
        return typestore.types[PATH](
            header(typestore, stamps_ns[-1] if len(stamps_ns) else 0, frame),
            steps,
        )

    return make


def imu(rates, first_covariance=0.0, stamp_ns=12_000_000_005):
    """A serialised Imu with angular rates (rad/s)."""
    covariance = np.zeros(9)
    of_rates = np.zeros(9)
    of_rates[0] = first_covariance
    types = JAZZY.types
    vector = types["geometry_msgs/msg/Vector3"]
    message = types["sensor_msgs/msg/Imu"](
        header=header(JAZZY, stamp_ns, "imu_link"),
        orientation=types["geometry_msgs/msg/Quaternion"](
            x=0.0, y=0.0, z=0.6, w=0.8
        ),
        orientation_covariance=covariance,
        angular_velocity=vector(*rates),
        angular_velocity_covariance=of_rates,
        linear_acceleration=vector(0.0, 0.0, 9.81),
        linear_acceleration_covariance=covariance,
    )
    return bytes(JAZZY.serialize_cdr(message, message.__msgtype__))


def fix(
    status,
    latitude=60.0,
    longitude=25.0,
    altitude=30.0,
    stamp_ns=12_000_000_005,
):
    """A serialised NavSatFix (deg, deg, m)."""
    types = JAZZY.types
    message = types["sensor_msgs/msg/NavSatFix"](
        header=header(JAZZY, stamp_ns, "imu_link"),
        status=types["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
        position_covariance=np.zeros(9),
        position_covariance_type=0,
    )
    return bytes(JAZZY.serialize_cdr(message, message.__msgtype__))


def cloud_message(typestore, stamp_ns, points, frame, names="xyz"):
    """A PointCloud2 of points (N, 3)."""
    field = typestore.types["sensor_msgs/msg/PointField"]
    fields = [
        field(name=name, offset=4 * at, datatype=7, count=1)
        for at, name in enumerate(names)
    ]
    rows = np.ascontiguousarray(points, dtype="<f4")
    return cloud_of_rows(typestore, stamp_ns, rows, fields, frame)


def cloud_of_rows(typestore, stamp_ns, rows, fields, frame):
    """A PointCloud2 of rows that are laid out as its fields state."""
    (point_step, *_) = rows.strides
    return typestore.types[POINTS](
        header=header(typestore, stamp_ns, frame),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=point_step,
        row_step=point_step * len(rows),
        data=rows.view(np.uint8).ravel(),
        is_dense=True,
    )


def write_messages(path, messages, storage="mcap"):
    """Write (bag time, topic, type, make) messages, in the order of bag time."""
    typestore = JAZZY
    serialize = JAZZY.serialize_cdr
    if storage == "rosbag1":
        typestore = NOETIC
        serialize = NOETIC.serialize_ros1
        writer = rosbag1.Writer(path)
    else:
        plugin = rosbag2.StoragePlugin[storage.upper()]
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    with writer:
        connections = {}
        for bag_ns, topic, message_type, make in sorted(
            messages, key=lambda message: message[0]
        ):
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, message_type, typestore=typestore
                )
            writer.write(
                connections[topic],
                int(bag_ns),
                serialize(make(typestore), message_type),
            )
    return path
