"""Messages that are no poses by themselves: twists, two topics joined, fields of any message."""

import json
import re
from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pytest
from bag_making import JAZZY, header
from mcap.writer import Writer
from motions import as_trajectory, geodetic, smooth_poses
from numpy.testing import assert_allclose
from rosbags import rosbag2
from rosbags.typesys import get_types_from_msg

from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.formats.bags.sources import hint_for_fields
from hand_eye_calib.formats.transforms import TfSource
from hand_eye_calib.offline.cli.main import main

TIMES = np.arange(0, 30, 0.05)
TRUTH = as_trajectory(smooth_poses(TIMES), rate_hz=20.0)
P = TRUTH.poses[:, :3, 3]
Q = se3.to_quat_xyzw(TRUTH.poses)
GEODETIC = geodetic(P - P[0], (48.1, 11.5, 550.0))
TWIST = "geometry_msgs/msg/TwistStamped"
FIX = "sensor_msgs/msg/NavSatFix"
IMU = "sensor_msgs/msg/Imu"
PX4 = "px4_msgs/msg/VehicleOdometry"
ARRAY = "geometry_msgs/msg/PoseArray"
GEO = "geographic_msgs/msg/GeoPoseStamped"
INS = "novatel_oem7_msgs/msg/INSPVA"
GPS = "gps_msgs/msg/GPSFix"
MARKER, BODY, BODIES = (
    f"mocap4r2_msgs/msg/{x}" for x in ("Marker", "RigidBody", "RigidBodies")
)
NAMED, NAMED_ARRAY = (
    f"motion_capture_tracking_interfaces/msg/{x}"
    for x in ("NamedPose", "NamedPoseArray")
)
POINT = "geographic_msgs/msg/GeoPoint"
POSE = "geographic_msgs/msg/GeoPose"
for name, fields in {
    PX4: "uint64 timestamp\nuint64 timestamp_sample\nuint8 pose_frame\nfloat32[3] position\n"
    "float32[4] q\nuint8 velocity_frame\nfloat32[3] velocity\nfloat32[3] angular_velocity\n"
    "float32[3] position_variance\nfloat32[3] orientation_variance\nfloat32[3] velocity_variance\n"
    "uint8 reset_counter\nint8 quality",
    MARKER: "int64 index\ngeometry_msgs/Point translation",
    BODY: "std_msgs/Header header\nuint32 frame_number\nstring rigid_body_name\n"
    "mocap4r2_msgs/Marker[] markers\ngeometry_msgs/Pose pose",
    BODIES: "std_msgs/Header header\nuint32 frame_number\nmocap4r2_msgs/RigidBody[] rigidbodies",
    NAMED: "string name\ngeometry_msgs/Pose pose",
    NAMED_ARRAY: "std_msgs/Header header\nmotion_capture_tracking_interfaces/NamedPose[] poses",
    POINT: "float64 latitude\nfloat64 longitude\nfloat64 altitude",
    POSE: "geographic_msgs/GeoPoint position\ngeometry_msgs/Quaternion orientation",
    GEO: "std_msgs/Header header\ngeographic_msgs/GeoPose pose",
    # Without what is not read.
    INS: "std_msgs/Header header\nfloat64 latitude\nfloat64 longitude\nfloat64 height\n"
    "float64 roll\nfloat64 pitch\nfloat64 azimuth",
    GPS: "std_msgs/Header header\nfloat64 latitude\nfloat64 longitude\nfloat64 altitude",
}.items():
    JAZZY.register(get_types_from_msg(fields, name))


def made(name, *values, **more):
    return JAZZY.types[name if "/" in name else f"geometry_msgs/msg/{name}"](
        *values, **more
    )


# Types of the messages, by the topics of the bag.
TYPES = {
    "/twist": TWIST,
    "/fix": FIX,
    "/imu": IMU,
    "/px4": PX4,
    "/array": ARRAY,
    "/geo": GEO,
    "/ins": INS,
    "/twists": f"{TWIST[:-7]}WithCovarianceStamped",
    "/bodies": BODIES,
    "/named": NAMED_ARRAY,
    "/gps": GPS,
}


def messages():
    """Topic and type to the messages of all stamps."""
    lat, lon, height = GEODETIC
    steps = se3.log(se3.inverse(TRUTH.poses[:-1]) @ TRUTH.poses[1:]) / 0.05
    twists = np.concatenate(
        [steps[:1], (steps[1:] + steps[:-1]) / 2, steps[-1:]]
    )
    status = made("sensor_msgs/msg/NavSatStatus", 0, 1)
    rpy = np.degrees(se3.rotation_to_rpy(TRUTH.poses[:, :3, :3]))
    # Roll, pitch downwards and heading from north.
    attitudes = np.c_[rpy[:, 0], -rpy[:, 1], 90.0 - rpy[:, 2]]
    px4 = [
        *zip(P.astype("f4"), np.roll(Q, 1, axis=1).astype("f4"), strict=True)
    ]
    written = {key: [] for key in TYPES.items()}
    zero = made("Vector3", 0.0, 0.0, 0.0)
    nine = np.zeros(9)
    nothing = np.zeros(3, "f4")
    for k, stamp_ns in enumerate(TRUTH.stamps_ns.tolist()):
        head = header(JAZZY, stamp_ns, "sensor")
        quaternion = made("Quaternion", *Q[k])
        twist = made(
            "Twist",
            made("Vector3", *twists[k, :3]),
            made("Vector3", *twists[k, 3:]),
        )
        pose = made("Pose", made("Point", *P[k]), quaternion)
        point = made(POINT, lat[k], lon[k], height[k])
        fields = {
            TWIST: (head, twist),
            TYPES["/twists"]: (
                head,
                made("TwistWithCovariance", twist, np.zeros(36)),
            ),
            FIX: (head, status, lat[k], lon[k], height[k], nine, 0),
            IMU: (head, quaternion, nine, zero, nine, zero, nine),
            PX4: (0, stamp_ns // 1000, 1, *px4[k], 1, *[nothing] * 5, 0, 0),
            BODIES: (head, k, [made(BODY, head, k, "cart", [], pose)]),
            NAMED_ARRAY: (head, [made(NAMED, "cart", pose)]),
            ARRAY: (head, [pose, pose]),
            GEO: (head, made(POSE, point, quaternion)),
            GPS: (head, lat[k], lon[k], height[k]),
            INS: (head, lat[k], lon[k], height[k], *attitudes[k]),
        }
        for key in written:
            written[key].append(made(key[1], *fields[key[1]]))
    return written


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("bags") / "bag"
    writer = rosbag2.Writer(
        path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP
    )
    with writer:
        for (topic, type_), all_messages in messages().items():
            connection = writer.add_connection(topic, type_, typestore=JAZZY)
            for stamp_ns, message in zip(
                TRUTH.stamps_ns.tolist(), all_messages, strict=True
            ):
                writer.write(
                    connection, stamp_ns, JAZZY.serialize_cdr(message, type_)
                )
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
        ("/twists", 0.05),
        ("/fix+/imu", 1e-6),
        ("/geo", 1e-5),
        ("/ins", 1e-5),
        ("/px4", 1e-5),
        ("/array", 1e-12),
        ("/bodies", 1e-12),
        ("/named", 1e-12),
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
    trajectory = read_bag_trajectory(bag, source)
    assert trajectory.measures == "poses"
    assert_allclose(trajectory.stamps_ns, TRUTH.stamps_ns, atol=1000, rtol=0)
    assert_allclose(
        from_start(trajectory.poses), from_start(TRUTH.poses), atol=within
    )


def foxglove(kind, k):
    """A message of Foxglove's as plain values."""
    lat, lon, height = (float(column[k]) for column in GEODETIC)
    sec, nsec = divmod(int(TRUTH.stamps_ns[k]), 10**9)
    place, turn = (
        dict(zip("xyzw", array[k].tolist(), strict=False)) for array in (P, Q)
    )
    pose = {"position": place, "orientation": turn}
    frames = {"parent_frame_id": "map", "child_frame_id": "base"}
    moving = {"timestamp": {"sec": sec, "nsec": nsec}} | frames
    moving |= {"translation": place, "rotation": turn}
    parts = {
        "PoseInFrame": {"frame_id": "map", "pose": pose},
        "PosesInFrame": {"frame_id": "map", "poses": [pose]},
        "FrameTransform": moving,
        "FrameTransforms": {"transforms": [moving]},
        "LocationFix": {"latitude": lat, "longitude": lon, "altitude": height},
    }
    timed = (
        {} if kind == "FrameTransforms" else {"timestamp": moving["timestamp"]}
    )
    return timed | parts[kind]


def in_json(path, kind, changed=(b"", b"")):
    """An mcap file of the library's own writer, with the timestamps of Foxglove's JSON."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(f"foxglove.{kind}", "jsonschema", b"{}")
        channel = writer.register_channel("/pose", "json", schema)
        for k, stamp_ns in enumerate(TRUTH.stamps_ns.tolist()):
            data = json.dumps(foxglove(kind, k)).encode().replace(*changed)
            writer.add_message(channel, stamp_ns, data, stamp_ns)
        writer.finish()


def in_protobuf(path, kind):
    """The same in Foxglove's own protobuf schemas, by the writer of mcap-protobuf-support."""
    writing = pytest.importorskip(
        "mcap_protobuf.writer", reason="needs mcap-protobuf-support"
    )
    name = f"foxglove_schemas_protobuf.{kind}_pb2"
    schema = pytest.importorskip(name, reason="needs foxglove-schemas-protobuf")
    json_format = pytest.importorskip("google.protobuf.json_format")
    to_date = re.compile(r'\{"sec": (\d+), "nsec": (\d+)\}')
    with path.open("wb") as file, writing.Writer(file) as writer:
        for k, stamp_ns in enumerate(TRUTH.stamps_ns.tolist()):
            date = datetime.fromtimestamp(stamp_ns // 10**9, UTC).strftime(
                "%Y-%m-%dT%H:%M:%S"
            )
            stamp = f'"{date}.{stamp_ns % 10**9:09d}Z"'
            text = to_date.sub(stamp, json.dumps(foxglove(kind, k)))
            message = json_format.Parse(text, getattr(schema, kind)())
            writer.write_message("/pose", message, stamp_ns, stamp_ns)


@pytest.mark.parametrize("write", [in_json, in_protobuf])
@pytest.mark.parametrize(
    "kind",
    [
        "PoseInFrame",
        "PosesInFrame",
        "FrameTransform",
        "FrameTransforms",
        "LocationFix",
    ],
)
def test_messages_of_foxglove(tmp_path, kind, write):
    write(tmp_path / "poses.mcap", kind)
    source = "map:base" if kind == "FrameTransforms" else "/pose"
    with PoseBag(tmp_path / "poses.mcap") as bag:
        trajectory, _ = bag.trajectory(
            TfSource.parse(source) if ":" in source else source
        )
        assert bag.topics["/pose"].type == f"foxglove.{kind}"
    assert (trajectory.stamps_ns == TRUTH.stamps_ns).all()
    if kind == "LocationFix":
        assert trajectory.measures == "positions"
        assert_allclose(trajectory.poses[:, :3, 3], P - P[0], atol=1e-5)
    else:
        assert_allclose(trajectory.poses, TRUTH.poses, atol=1e-12)


def test_json_without_what_its_type_has_is_named(tmp_path):
    path = tmp_path / "poses.mcap"
    in_json(path, "FrameTransforms", (b"rotation", b"turn"))
    with (
        PoseBag(path) as bag,
        pytest.raises(InputError, match="/pose: a message of type foxglove"),
    ):
        bag.trajectory(TfSource.parse("map:base"))


def test_values_that_are_not_finite_are_left_out(tmp_path):
    in_json(
        tmp_path / "poses.mcap",
        "PoseInFrame",
        (b'"x": -', b'"x": -Infinity, "X": '),
    )
    with PoseBag(tmp_path / "poses.mcap") as opened:
        trajectory, _ = opened.trajectory("/pose")
        assert (
            f"{len(P) - len(trajectory)} of {len(P)} poses (79%) were left"
            in opened.warnings[0]
        )
    assert (
        trajectory.stamps_ns == TRUTH.stamps_ns[(P[:, 0] >= 0) & (Q[:, 0] >= 0)]
    ).all()


def test_fields_of_a_place_are_positions(bag):
    fields = "t=header.stamp,x=poses.0.position.x,y=poses.0.position.y,z=poses.0.position.z"
    for source in (f"/array?{fields}", "/gps"):
        trajectory = read_bag_trajectory(bag, source)
        assert trajectory.measures == "positions"
        assert_allclose(
            from_start(trajectory.poses)[:, :3, 3], P - P[0], atol=1e-5
        )


@pytest.mark.parametrize(
    ("source", "error", "message"),
    [
        ("/fix+/nothing", InputError, "no topic /nothing in"),
        (
            "/imu+/fix",
            ConfigError,
            "measure rates or rotations; the options ask for positions",
        ),
        (
            "/array?t=header.stamp,x=pose.position.x,y=a,z=b",
            InputError,
            "has no pose.position.x; name other fields \\(the message has ",
        ),
        ("/array?t", ConfigError, "fields must be NAME=PATH"),
        (
            "/array?t=header.stamp,x=header.frame_id,y=header,z=header",
            InputError,
            "float",
        ),
        (
            "/px4?x=position.0,y=position.1,z=position.2",
            InputError,
            "no field is the stamp, t: .* receive \\(the message has timestamp, ",
        ),
    ],
)
def test_what_cannot_be_read_is_told_in_one_sentence(
    bag, source, error, message
):
    with pytest.raises(error, match=message) as caught:
        read_bag_trajectory(bag, source)
    assert "\n" not in str(caught.value)


def test_calibrate_takes_fields_and_two_topics(bag, tmp_path, capsys):
    command = [
        "calibrate",
        str(bag),
        "--parent-topic",
        "/fix+/imu",
        "--child-topic",
        "/array",
    ]
    fields = "t=header.stamp,x=poses.0.position.x,y=poses.0.position.y,z=poses.0.position.z"
    assert main(
        [*command, "--child-fields", fields, "--child-measures", "positions"]
    ) in (0, 1, 3)
    assert "Traceback" not in capsys.readouterr().err
    with PoseBag(bag) as opened:
        assert {"/twist", "/geo", "/px4", "/array"} <= opened.topics.keys()
    assert main(["calibrate", str(bag), "--child-fields", fields]) == 2
    assert "--child-fields needs --child-topic" in capsys.readouterr().err


def test_messages_without_a_stamp_have_the_times_of_the_recorder(bag):
    source = "/px4?x=position.0,y=position.1,z=position.2"
    with PoseBag(bag) as opened:
        run = next(opened.runs(["/px4"]))
        trajectory, _ = opened.trajectory(source, "auto", "receive")
    assert len(trajectory) > 100
    assert trajectory.stamps_ns[:5].tolist() == run.bag_ns[:5].tolist()


@pytest.mark.parametrize(
    ("fields", "hint"),
    [
        (
            {"header": {"stamp": {"sec": 1, "nanosec": 2}}, "x": 1.0},
            "name its fields, /a?t=header.stamp,x=... (the message has header.stamp and x)",
        ),
        (
            {"x": 1.0, "y": 2.0, "theta": 3.0},
            "name its fields, /a?x=..., and take the times of the recorder with `stamps` receive, "
            "because it has no stamp (the message has x, y and theta)",
        ),
        (None, "name its fields, /a?t=header.stamp,x=..."),
    ],
)
def test_the_fields_of_an_unknown_message_are_listed(fields, hint):
    message = json.loads(
        json.dumps(fields),
        object_hook=lambda values: SimpleNamespace(**values),
    )
    assert hint_for_fields("/a", message) == hint
