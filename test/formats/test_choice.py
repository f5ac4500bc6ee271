"""Topics of a bag for the streams that the user has not named."""

import pytest

from hand_eye_calib.core.base.errors import UnclearStreamsError
from hand_eye_calib.formats.bags.choice import TopicInfo, choose
from hand_eye_calib.formats.bags.messages import quantities_of_types
from hand_eye_calib.formats.bags.roles import remarks_on_wheels
from hand_eye_calib.offline.cli.calibrate import (
    _other_streams,
    advice_on_topics,
)
from hand_eye_calib.offline.cli.options import typed_options

ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
CLOUD = "sensor_msgs/msg/PointCloud2"
IMAGE = "sensor_msgs/msg/Image"
FIX = "sensor_msgs/msg/NavSatFix"
IMU = "sensor_msgs/msg/Imu"
JOINTS = "sensor_msgs/msg/JointState"
BOTH = ("parent", "child")


def topics(*rows):
    return [TopicInfo(name, type_, count) for name, type_, count in rows]


def chosen(rows, missing=BOTH, frames=None, edges=()):
    return choose(
        topics(*rows), missing, lambda name: (frames or {}).get(name, ""), edges
    )


LIDAR = ("/lidar/odometry", ODOMETRY, 600)
CAMERA = ("/camera/odometry", ODOMETRY, 1800)


@pytest.mark.parametrize(
    ("more", "frames"),
    [
        (("/goal_pose", POSE, 1), {}),
        (("/ground_truth/pose", POSE, 900), {}),
        (("/odometry/filtered", ODOMETRY, 900), {}),
        # Two topics of one sensor, by the name or by the frame.
        (("/lidar/pose", POSE, 500), {}),
        (
            ("/slam", ODOMETRY, 500),
            {"/slam": "velodyne", "/lidar/odometry": "velodyne"},
        ),
        # Odometry of the vehicle beside that of two sensors.
        (("/odom", ODOMETRY, 900), {"/odom": "base_link"}),
    ],
)
def test_an_obvious_pair_is_taken(more, frames):
    selected = chosen([LIDAR, CAMERA, more], frames=frames)
    assert set(selected) == {LIDAR[0], CAMERA[0]}


def test_an_ins_beside_odometry_is_an_obvious_pair():
    ins = ("/novatel/inspvax", "novatel_oem7_msgs/msg/INSPVAX", 3000)
    assert chosen([LIDAR, ins]) == [LIDAR[0], ins[0]]


def test_the_stream_that_is_not_named_is_chosen_alone():
    goal = ("/goal_pose", POSE, 1)
    selected = chosen([CAMERA, goal], missing=("child",))
    assert selected == [CAMERA[0]]


@pytest.mark.parametrize(
    ("rows", "edges", "message", "options"),
    [
        ([], (), "the bag has no messages: record again", {}),
        (
            [LIDAR, CAMERA, ("/imu_link/odometry", ODOMETRY, 600)],
            (),
            "3 topics have poses: /lidar/odometry ",
            {
                "parent_topic": "/lidar/odometry",
                "child_topic": "/camera/odometry",
            },
        ),
        (
            [("/cam/image_raw", IMAGE, 900)],
            (),
            "no topic has poses: run visual odometry or SLAM on the images",
            {},
        ),
        (
            [("/front/points", CLOUD, 900), ("/rear/points", CLOUD, 900)],
            (),
            "no topic has poses; the odometry of lidars can be computed from /front/points",
            {"parent_topic": "/front/points", "child_topic": "/rear/points"},
        ),
        (
            [("/points", CLOUD, 900)],
            (),
            "no topic has poses: run the odometry of both sensors and record it",
            {},
        ),
        (
            [("/fix", FIX, 900), ("/imu", IMU, 9000)],
            (),
            "no topic has poses: GNSS and IMU need the poses of another sensor",
            {},
        ),
        (
            [LIDAR, ("/fix", FIX, 900)],
            (),
            "only one topic has poses, /lidar/odometry",
            {"parent_topic": "/lidar/odometry", "child_topic": "/fix"},
        ),
        (
            [LIDAR, ("/joint_states", JOINTS, 900)],
            (),
            ". If /lidar/odometry is not computed from the wheels, /joint_states is the other "
            "stream; otherwise record the odometry of a second sensor",
            {"parent_topic": "/joint_states", "child_topic": "/lidar/odometry"},
        ),
        (
            [LIDAR, ("/log", "std_msgs/msg/String", 5)],
            (),
            "/lidar/odometry (nav_msgs/msg/Odometry, 600 messages): record the odometry of the "
            "other sensor. The bag has /lidar/odometry",
            {},
        ),
        (
            [("/tf", "tf2_msgs/msg/TFMessage", 900)],
            ("odom:lidar", "map:camera"),
            "no topic has poses, but transforms have: map:camera and odom:lidar",
            {"parent_topic": "odom:lidar", "child_topic": "map:camera"},
        ),
        (
            [("/tf", "tf2_msgs/msg/TFMessage", 900)],
            ("map:odom", "odom:base_link"),
            "no topic has poses: run the odometry or SLAM of both sensors",
            {},
        ),
    ],
)
def test_without_an_obvious_pair_the_error_names_cause_and_options(
    rows, edges, message, options
):
    with pytest.raises(UnclearStreamsError) as caught:
        chosen(rows, edges=edges)
    assert message in str(caught.value)
    assert caught.value.options == options


@pytest.mark.parametrize(
    ("rows", "message", "options"),
    [
        (
            [("/imu", IMU, 900), ("/joint_states", JOINTS, 900)],
            "no other topic has poses; /imu has rates",
            {"child_topic": "/imu"},
        ),
        (
            [("/imu", IMU, 900), ("/fix", FIX, 900)],
            "no other topic has poses; /fix has positions",
            {"child_topic": "/fix"},
        ),
        (
            [("/joint_states", JOINTS, 900)],
            "no other topic has poses: run the odometry or SLAM of the other sensor, and record "
            "it. The bag has /joint_states",
            {},
        ),
    ],
)
def test_beside_a_named_topic_the_error_names_the_other_stream(
    rows, message, options
):
    with pytest.raises(UnclearStreamsError) as caught:
        chosen(rows, missing=("child",))
    assert str(caught.value).startswith(message)
    assert caught.value.options == options


def test_a_topic_of_the_same_sensor_is_not_the_other_stream():
    rows = [("/odom", ODOMETRY, 900), ("/imu", IMU, 900)]
    frames = {"/odom": "base_footprint", "/imu": "base_footprint"}
    with pytest.raises(UnclearStreamsError) as caught:
        chosen(rows, frames=frames)
    assert not caught.value.options
    assert "record the odometry of the other sensor" in str(caught.value)
    with pytest.raises(UnclearStreamsError) as caught:
        chosen(rows, frames={**frames, "/imu": "imu_link"})
    assert {*caught.value.options.values()} == {"/odom", "/imu"}


@pytest.mark.parametrize(
    ("frame_of_imu", "text"),
    [
        (
            "base_footprint",
            "/imu: rates, which give the rotation only: --child-topic /imu "
            "--child-frame imu_link",
        ),
        ("imu_link", "Run: --parent-topic /imu --child-topic /odom"),
    ],
)
def test_a_bag_with_one_odometry_names_every_other_stream(frame_of_imu, text):
    rows = [
        ("/odom", ODOMETRY, 900),
        ("/imu", IMU, 900),
        ("/joint_states", JOINTS, 900),
        ("/log", "std_msgs/msg/String", 5),
    ]
    frames = {"/odom": "base_footprint", "/imu": frame_of_imu}
    with pytest.raises(UnclearStreamsError) as caught:
        chosen(rows, frames=frames)
    options = typed_options(caught.value.options.items())
    message = f"{caught.value}. Run: {options}"
    assert text in message
    assert "/joint_states" in message
    described = [
        {"name": name, "type": type_, "count": count}
        | {"quantity": quantities_of_types().get(type_, "")}
        | {"frames": [frames[name]] if name in frames else []}
        for name, type_, count in rows
    ]
    imu, wheels = _other_streams(described)
    expected = "/imu: rates, which give the rotation only: --child-topic /imu"
    if frame_of_imu == "base_footprint":
        expected += " --child-frame imu_link"
    assert imu == expected
    assert wheels.endswith(": --parent-topic /joint_states")
    without_poses = described[1:]
    assert _other_streams(without_poses) == []


@pytest.mark.parametrize(
    ("rows", "advice"),
    [
        (
            [LIDAR, ("/log", "std_msgs/msg/String", 5)],
            "accept a topic with poses",
        ),
        (
            [("/front/points", CLOUD, 900)],
            "accept points of lidars, whose odometry is computed",
        ),
        (
            [("/tf", "tf2_msgs/msg/TFMessage", 9)],
            "accept frames of /tf: odom:lidar",
        ),
        (
            [LIDAR, ("/tf", "tf2_msgs/msg/TFMessage", 9)],
            "a topic with poses, or frames of /tf: odom:lidar",
        ),
        (
            [("/imu", IMU, 9000)],
            "no topic has poses: run the odometry or SLAM of",
        ),
    ],
)
def test_the_list_of_topics_ends_with_what_can_be_a_stream(rows, advice):
    quantities = quantities_of_types()
    described = [
        {"count": count, "quantity": quantities.get(type_, "")}
        for _, type_, count in rows
    ]
    assert advice in advice_on_topics(described)


@pytest.mark.parametrize(
    ("types", "is_noted"),
    [
        ({JOINTS: "/joint_states", ODOMETRY: "/odom"}, True),
        ({JOINTS: "/joint_states", POSE: "/slam"}, False),
        ({ODOMETRY: "/odom", POSE: "/slam"}, False),
    ],
)
def test_odometry_beside_wheels_is_noted(types, is_noted):
    remarks = remarks_on_wheels(types)
    assert [
        "if /odom is computed from the wheels of /joint_states" in remark
        for remark in remarks
    ] == [True] * is_noted
