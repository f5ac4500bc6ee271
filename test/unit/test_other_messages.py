"""Messages that are no poses by themselves: twists, two topics joined, fields of any message."""

import json

import numpy as np
import pytest
from bag_making import JAZZY, header
from mcap.writer import Writer
from motions import as_trajectory, geodetic, smooth_poses
from rosbags import rosbag2
from rosbags.typesys import get_types_from_msg

from hand_eye_calib.cli.main import main
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.bags import PoseBag

TIMES = np.arange(0, 30, 0.05)
TRUTH = as_trajectory(smooth_poses(TIMES), rate_hz=20.0)
P, Q = TRUTH.poses[:, :3, 3], se3.to_quat_xyzw(TRUTH.poses)
TWIST = "geometry_msgs/msg/TwistStamped"
FIX, IMU = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu"
PX4, ARRAY = "px4_msgs/msg/VehicleOdometry", "geometry_msgs/msg/PoseArray"
GEO = "geographic_msgs/msg/GeoPoseStamped"
POINT, POSE = "geographic_msgs/msg/GeoPoint", "geographic_msgs/msg/GeoPose"
for name, fields in {
    PX4: "uint64 timestamp\nuint64 timestamp_sample\nfloat32[3] position\nfloat32[4] q\n",
    POINT: "float64 latitude\nfloat64 longitude\nfloat64 altitude",
    POSE: "geographic_msgs/GeoPoint position\ngeometry_msgs/Quaternion orientation",
    GEO: "std_msgs/Header header\ngeographic_msgs/GeoPose pose",
}.items():
    JAZZY.register(get_types_from_msg(fields, name))


def made(name, *values, **more):
    return JAZZY.types[name if "/" in name else f"geometry_msgs/msg/{name}"](*values, **more)


def messages():
    """Topic and type to the messages of all stamps."""
    lat, lon, height = geodetic(P - P[0], (48.1, 11.5, 550.0))
    steps = se3.log(se3.inverse(TRUTH.poses[:-1]) @ TRUTH.poses[1:]) / 0.05
    twists = np.concatenate([steps[:1], (steps[1:] + steps[:-1]) / 2, steps[-1:]])
    status = made("sensor_msgs/msg/NavSatStatus", 0, 1)
    types = {"/twist": TWIST, "/fix": FIX, "/imu": IMU, "/px4": PX4, "/array": ARRAY, "/geo": GEO}
    found = {key: [] for key in types.items()}
    zero, nine = made("Vector3", 0.0, 0.0, 0.0), np.zeros(9)
    for k, stamp_ns in enumerate(TRUTH.stamps_ns.tolist()):
        head, quaternion = header(JAZZY, stamp_ns, "sensor"), made("Quaternion", *Q[k])
        linear, angular = (made("Vector3", *part) for part in (twists[k, :3], twists[k, 3:]))
        pose = made("Pose", made("Point", *P[k]), quaternion)
        point = made(POINT, lat[k], lon[k], height[k])
        each = {
            TWIST: (head, made("Twist", linear, angular)),
            FIX: (head, status, lat[k], lon[k], height[k], nine, 0),
            IMU: (head, quaternion, nine, zero, nine, zero, nine),
            PX4: (0, stamp_ns // 1000, P[k].astype("f4"), np.roll(Q[k], 1).astype("f4")),
            ARRAY: (head, [pose, pose]),
            GEO: (head, made(POSE, point, quaternion)),
        }
        for key in found:
            found[key].append(made(key[1], *each[key[1]]))
    return found


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("bags") / "bag"
    writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
    with writer:
        for (topic, type_), all_messages in messages().items():
            connection = writer.add_connection(topic, type_, typestore=JAZZY)
            for stamp_ns, message in zip(TRUTH.stamps_ns.tolist(), all_messages, strict=True):
                writer.write(connection, stamp_ns, JAZZY.serialize_cdr(message, type_))
    return path


def read_bag_trajectory(path, source):
    with PoseBag(path) as bag:
        return bag.trajectory(source)[0]


def from_start(poses):
    return se3.inverse(poses[:1]) @ poses


@pytest.mark.parametrize(
    ("source", "within"),
    [
        ("/twist", 0.05),  # integrated over 30 s
        ("/fix+/imu", 1e-6),
        ("/geo", 1e-5),
        ("/px4", 1e-5),
        ("/array", 1e-12),
        ("/array?t=header.stamp,x=poses.1.position.x,y=poses.1.position.y,z=poses.1.position.z,"
         "qx=poses.1.orientation.x,qy=poses.1.orientation.y,qz=poses.1.orientation.z,"
         "qw=poses.1.orientation.w", 1e-12),
        ("/twist?t=header.stamp,vx=twist.linear.x,vy=twist.linear.y,vz=twist.linear.z,"
         "wx=twist.angular.x,wy=twist.angular.y,wz=twist.angular.z", 0.05),
        ("/geo?t=header.stamp,lat=pose.position.latitude,lon=pose.position.longitude,"
         "height=pose.position.altitude,qx=pose.orientation.x,qy=pose.orientation.y,"
         "qz=pose.orientation.z,qw=pose.orientation.w", 1e-5),
    ],
)  # fmt: skip
def test_the_poses_are_those_of_the_truth(bag, source, within):
    found = read_bag_trajectory(bag, source)
    assert found.measures == "poses"
    np.testing.assert_allclose(found.stamps_ns, TRUTH.stamps_ns, atol=1000, rtol=0)
    np.testing.assert_allclose(from_start(found.poses), from_start(TRUTH.poses), atol=within)


def test_messages_of_json(tmp_path):
    path = tmp_path / "poses.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("foxglove.PoseInFrame", "jsonschema", b"{}")
        channel = writer.register_channel("/pose", "json", schema)
        for k, stamp_ns in enumerate(TRUTH.stamps_ns.tolist()):
            sec, nsec = divmod(stamp_ns, 10**9)
            parts = (("position", dict(zip("xyz", P[k], strict=True))),
                     ("orientation", dict(zip("xyzw", Q[k], strict=True))))  # fmt: skip
            message = {"timestamp": {"sec": sec, "nsec": nsec}, "pose": dict(parts)}
            message["frame_id"] = "map"
            writer.add_message(channel, stamp_ns, json.dumps(message).encode(), stamp_ns)
        writer.finish()
    found = read_bag_trajectory(path, "/pose")
    np.testing.assert_allclose(found.poses, TRUTH.poses, atol=1e-12)
    assert (found.stamps_ns == TRUTH.stamps_ns).all()


@pytest.mark.parametrize(
    ("source", "error", "message"),
    [
        ("/fix+/nothing", InputError, "no topic /nothing in"),
        ("/imu+/fix", ConfigError, "measure rates or rotations; asked for are positions"),
        ("/array?t=header.stamp,x=pose.position.x,y=a,z=b", InputError, "has no pose.position.x"),
        ("/array?t", ConfigError, "fields are written NAME=PATH"),
        ("/array?t=header.stamp,x=header.frame_id,y=header,z=header", InputError, "float"),
        ("/px4?x=position.0,y=position.1,z=position.2", InputError, "of its fields is a stamp"),
    ],
)
def test_what_cannot_be_read_is_told_in_one_sentence(bag, source, error, message):
    with pytest.raises(error, match=message) as caught:
        read_bag_trajectory(bag, source)
    assert "\n" not in str(caught.value)


def test_calibrate_takes_fields_and_two_topics(bag, tmp_path, capsys):
    command = ["calibrate", str(bag), "--parent-topic", "/fix+/imu", "--child-topic", "/array"]
    fields = "t=header.stamp,x=poses.0.position.x,y=poses.0.position.y,z=poses.0.position.z"
    assert main([*command, "--child-fields", fields, "--child-measures", "positions"]) in (0, 1, 3)
    assert "Traceback" not in capsys.readouterr().err
    with PoseBag(bag) as opened:
        assert {"/twist", "/geo", "/px4", "/array"} <= opened.topics.keys()
    assert main(["calibrate", str(bag), "--child-fields", fields]) == 2
    assert "give --child-topic, too" in capsys.readouterr().err
