"""A result is named by what it is: which frame is the sensor's, which stream is the parent's."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from bag_making import (
    JAZZY,
    ODOMETRY,
    POSE_STAMPED,
    STORAGES,
    TF,
    bag_path,
    pose_message,
    tf_message,
    write_messages,
)
from motions import T_PARENT_CHILD, child_of, wandering_poses
from numpy.testing import assert_allclose, assert_array_equal

import hand_eye_calib as hec
from hand_eye_calib.core.base.config import CalibratorConfig, NodeConfig
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.engine.calibrator import Calibrator, Calibrators
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import FrameTree, StreamFrames
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.formats.bags.unpacking import MessageReader
from hand_eye_calib.formats.installed import open_installed
from hand_eye_calib.formats.journal import read_journal, replay_journal
from hand_eye_calib.offline.cli.main import main

N = 200
STAMPS_NS = 1_700_000_000_000_000_000 + 50_000_000 * np.arange(N)
POSES = wandering_poses(N)
CHILD = child_of(POSES)
INVERSE = se3.inverse(CHILD)
FAST = ["--reference", "B5", "--json"]


def bag_of(path, parent, child, storage="mcap"):
    """Write a bag of two streams: each a topic, a type, the frames and the poses."""
    recorded = []
    for topic, kind, world, sensor, poses in (parent, child):
        for stamp_ns, pose in zip(STAMPS_NS.tolist(), poses, strict=True):
            if kind == TF:
                make = tf_message([(stamp_ns, world, sensor, pose)])
            else:
                make = pose_message(
                    kind, stamp_ns, se3.to_rows(pose), world, sensor
                )
            recorded.append((stamp_ns, topic, kind, make))
    return write_messages(path, recorded, storage)


def calibrated(capsys, *arguments):
    words = [str(argument) for argument in arguments]
    main(["calibrate", *words, *FAST])
    out, err = capsys.readouterr()
    document = json.loads(out) if out else None
    return document, err


def frames_of(document):
    return document["parent_frame"], document["child_frame"]


# ---- which frame of a stream moves


@pytest.mark.parametrize(
    ("world", "sensor", "expected"),
    [
        (
            "camera",
            "aruco_marker",
            "camera",
        ),  # a camera that sees a fixed marker
        (
            "camera_color_optical_frame",
            "tag36h11:3",
            "camera_color_optical_frame",
        ),
        ("camera", "", "camera"),  # a PoseStamped of the marker
        ("base_link", "tool0", "base_link"),  # an arm, seen from its hand
        ("tool0", "base_link", "tool0"),
        (
            "odom",
            "base_link",
            "base_link",
        ),  # a publisher that writes inverse poses
        ("camera_init", "aft_mapped", "aft_mapped"),
        ("t265_odom_frame", "t265_pose_frame", "t265_pose_frame"),
        ("vicon/world", "target", "vicon/world"),
        ("", "lidar", "lidar"),
    ],
)
def test_inverse_poses_are_those_of_the_frame_that_is_no_world(
    world, sensor, expected
):
    frames = StreamFrames(sensor, world)
    assert frames.inverse_name == expected


def test_a_name_that_the_user_gives_stays_unless_the_messages_have_it_too():
    named = StreamFrames("vo", "camera", "front")
    already_named = StreamFrames("marker", "camera", "marker")
    assert named.inverse_name == "front"
    assert already_named.inverse_name == "camera"


OBSERVED = {
    TF: ["--child-topic", "camera:aruco_marker"],
    ODOMETRY: ["--child-topic", "/child"],
    POSE_STAMPED: ["--child-topic", "/child"],
}


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("kind", OBSERVED)
def test_a_camera_that_observes_a_fixed_marker_is_the_child(
    tmp_path, capsys, storage, kind
):
    parent = ("/tf", TF, "/base_link", "/tool0", POSES)
    topic = "/tf" if kind == TF else "/child"
    child = (topic, kind, "/camera", "/aruco_marker", INVERSE)
    path = bag_of(bag_path(tmp_path, storage), parent, child, storage)
    options = [
        "--parent-topic",
        "base_link:tool0",
        *OBSERVED[kind],
        "--child-invert",
        "poses",
    ]
    document, _ = calibrated(capsys, path, *options)
    assert frames_of(document) == ("tool0", "camera")
    assert_allclose(
        document["T_parent_child"]["matrix"], T_PARENT_CHILD, atol=1e-6
    )
    beginning = "the child sensor is now camera, because"
    assert [text for text in document["warnings"] if text.startswith(beginning)]


def test_the_repair_that_inverts_a_stream_names_the_result_and_its_files_by_the_camera(
    tmp_path, capsys
):
    rows = np.random.default_rng(4).normal(scale=2e-3, size=(2, N, 6))
    parent = ("/tf", TF, "base_link", "tool0", POSES @ se3.exp(rows[0]))
    child = (
        "/tf",
        TF,
        "camera",
        "aruco_marker",
        se3.inverse(CHILD @ se3.exp(rows[1])),
    )
    path = bag_of(tmp_path / "bag", parent, child)
    sources = [
        "--parent-topic",
        "base_link:tool0",
        "--child-topic",
        "camera:aruco_marker",
    ]
    out = tmp_path / "result"
    assert main(
        ["calibrate", str(path), *sources, "--out", str(out), "--no-report"]
    ) in (0, 3)
    text = capsys.readouterr().out
    assert "--child-invert poses" in text
    assert "camera in tool0: maps coordinates of camera into tool0" in text
    assert "aruco_marker:" not in text
    saved = yaml.safe_load((out / "extrinsic.yaml").read_text())
    assert frames_of(saved) == ("tool0", "camera")
    result = hec.load(out)
    assert (
        "--frame-id tool0 --child-frame-id camera"
        in result.static_transform_command()
    )
    urdf = (out / "extrinsic.urdf.xacro").read_text()
    assert "aruco" not in urdf
    assert "camera" in urdf
    assert "aruco" not in result.export("kalibr")


def test_a_camera_beside_an_arm_that_sees_a_marker_on_the_hand_is_named_by_both_readings():
    """Both streams as they are: the marker in the hand. Both inverse: the camera in the base."""
    arm = Trajectory(STAMPS_NS, POSES, "tool0", "base_link")
    marker = Trajectory(STAMPS_NS, CHILD, "aruco_marker", "camera")
    options = {"reference": "B5", "checks": False}
    inverse_options = {
        "parent_invert": "poses",
        "child_invert": "poses",
        **options,
    }
    T_base_camera = POSES[0] @ T_PARENT_CHILD @ se3.inverse(CHILD[0])

    as_it_is = hec.calibrate(arm, marker, **options)
    inverse = hec.calibrate(arm, marker, **inverse_options)

    assert as_it_is.parent_frame == "tool0"
    assert as_it_is.child_frame == "aruco_marker"
    assert inverse.parent_frame == "base_link"
    assert inverse.child_frame == "camera"
    assert_allclose(as_it_is.T_parent_child, T_PARENT_CHILD, atol=1e-6)
    assert_allclose(inverse.T_parent_child, T_base_camera, atol=1e-6)


def feed_messages(engines, stream, message_type, frames, poses):
    """Feed the poses of a stream as the messages of a live session."""
    reader = MessageReader(message_type, "poses")
    for stamp_ns, pose in zip(STAMPS_NS, poses, strict=True):
        row = se3.to_rows(pose)
        make = pose_message(message_type, stamp_ns, row, *frames)
        data = bytes(JAZZY.serialize_cdr(make(JAZZY), message_type))
        fields = reader(data)
        if fields.sensor_frame is not None:
            engines.set_frame(stream, fields.sensor_frame)
        engines.set_world(stream, fields.world_frame)
        engines.add_pose(stream, stamp_ns, fields.position, fields.quat_xyzw)


@pytest.mark.parametrize("kind", [ODOMETRY, POSE_STAMPED])
def test_a_live_session_and_its_journal_name_the_camera_too(tmp_path, kind):
    config = CalibratorConfig(child_invert="poses", reference="B5")
    engines = Calibrators(child=Calibrator(config))
    feed_messages(engines, "parent", ODOMETRY, ("/base_link", "/tool0"), POSES)
    feed_messages(engines, "child", kind, ("/camera", "/aruco_marker"), INVERSE)

    snapshot = engines["child"].snapshot()
    result = snapshot.estimate(cross_check=False)

    assert result.parent_frame == "tool0"
    assert result.child_frame == "camera"
    assert_allclose(result.T_parent_child, T_PARENT_CHILD, atol=1e-6)


# ---- names that contradict the streams


def test_frames_given_the_other_way_round_choose_the_topics(tmp_path, capsys):
    parent = ("/lidar/odometry", ODOMETRY, "map", "lidar", POSES)
    child = ("/camera/odometry", ODOMETRY, "odom", "camera", CHILD)
    path = bag_of(tmp_path / "bag", parent, child)
    names = ["--parent-frame", "/camera", "--child-frame", "lidar"]
    document, err = calibrated(capsys, path, *names)
    assert "parent is /camera/odometry, child is /lidar/odometry" in err
    assert frames_of(document) == ("camera", "lidar")
    inverse = se3.inverse(T_PARENT_CHILD)
    assert_allclose(document["T_parent_child"]["matrix"], inverse, atol=1e-6)
    topics = [
        "--parent-topic",
        "/lidar/odometry",
        "--child-topic",
        "/camera/odometry",
    ]
    assert main(["calibrate", str(path), *topics, *names]) == 1
    error = capsys.readouterr().err
    assert (
        "the parent stream is of lidar, the child stream of camera; exchange the two"
        in error
    )


def test_a_name_of_the_other_stream_is_refused_everywhere():
    lidar = Trajectory(STAMPS_NS, POSES, "lidar")
    camera = Trajectory(STAMPS_NS, CHILD, "camera")
    for names in (
        {"parent_frame": "camera", "child_frame": "lidar"},
        {"parent_frame": "camera", "child_frame": "front"},
        {"child_frame": "/lidar", "parent_frame": "roof"},
    ):
        with pytest.raises(
            InputError, match="that is the frame of the other stream"
        ):
            hec.calibrate(lidar, camera, checks=False, **names)
        live = Calibrator(CalibratorConfig(**names))
        live.set_frame("parent", "lidar")
        live.set_frame("child", "camera")
        with pytest.raises(
            InputError, match="that is the frame of the other stream"
        ):
            live.estimate()


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (
            {"parent_frame": "lidar", "child_frame": "camera"},
            ("lidar", "camera"),
        ),
        ({"parent_frame": "roof", "child_frame": "front"}, ("roof", "front")),
        ({"child_frame": "front"}, ("lidar", "front")),
        ({}, ("lidar", "camera")),
    ],
)
def test_other_names_are_taken_as_they_are(names, expected):
    lidar = Trajectory(STAMPS_NS, POSES, "lidar")
    camera = Trajectory(STAMPS_NS, CHILD, "camera")
    options = {"reference": "B5", "checks": False, **names}

    result = hec.calibrate(lidar, camera, **options)

    frames = (result.parent_frame, result.child_frame)
    assert frames == expected


def test_two_streams_of_one_frame_are_told_apart_by_names():
    first = Trajectory(STAMPS_NS, POSES, "base_link")
    second = Trajectory(STAMPS_NS, CHILD, "base_link")
    options = {
        "reference": "B5",
        "checks": False,
        "parent_frame": "base_link",
        "child_frame": "camera",
    }

    result = hec.calibrate(first, second, **options)

    assert result.parent_frame == "base_link"
    assert result.child_frame == "camera"


# ---- which topic is which stream


@pytest.mark.parametrize(
    ("topics", "frames", "expected"),
    [
        (
            ("/camera/pose", "/lidar/pose"),
            ("camera", "lidar"),
            ("/camera/pose", "/lidar/pose"),
        ),
        (
            ("/camera/pose", "/lidar/pose"),
            ("lidar", "camera"),
            ("/lidar/pose", "/camera/pose"),
        ),
        (
            ("/cam0/pose", "/velodyne/pose"),
            ("camera", ""),
            ("/cam0/pose", "/velodyne/pose"),
        ),
        (
            ("/front/vio", "/rear/vio"),
            ("rear_camera", "front_camera"),
            ("/rear/vio", "/front/vio"),
        ),
        (("/child", "/parent"), ("left", "right"), ("/parent", "/child")),
    ],
)
def test_two_topics_without_frames_are_chosen_by_the_names_of_the_frames(
    tmp_path, topics, frames, expected
):
    first_topic, second_topic = topics
    parent_frame, child_frame = frames
    first = (first_topic, POSE_STAMPED, "map", "", POSES)
    second = (second_topic, POSE_STAMPED, "odom", "", CHILD)
    path = bag_of(tmp_path / "bag", first, second)
    named = {"parent": parent_frame, "child": child_frame}

    with PoseBag(path) as bag:
        selected = bag.select(frames=named)

    assert selected == expected


def test_a_topic_whose_messages_name_another_frame_is_not_taken(tmp_path):
    first = ("/a", ODOMETRY, "odom", "base_link", POSES)
    second = ("/b", POSE_STAMPED, "odom", "", CHILD)
    path = bag_of(tmp_path / "bag", first, second)
    with PoseBag(path) as bag:
        assert bag.select(frames={"parent": "camera", "child": ""}) == (
            "/b",
            "/a",
        )
        assert bag.select(
            frames={"parent": "base_link", "child": "camera"}
        ) == (
            "/a",
            "/b",
        )
        assert bag.select() == ("/a", "/b")


def test_topics_are_not_guessed_against_nothing(tmp_path, capsys):
    first = ("/one", POSE_STAMPED, "map", "", POSES)
    second = ("/two", POSE_STAMPED, "odom", "", CHILD)
    path = bag_of(tmp_path / "bag", first, second)
    names = ["--parent-frame", "camera", "--child-frame", "lidar"]
    topics = ["--parent-topic", "/two", "--child-topic", "/one"]

    code = main(["calibrate", str(path), *names])

    error = "the names do not decide which of the topics /one and /two is of camera and lidar: set"
    _, printed = capsys.readouterr()
    assert code == 1
    assert error in printed
    document, _ = calibrated(capsys, path, *topics, *names)
    assert frames_of(document) == ("camera", "lidar")


# ---- the leading slash of ROS 1


@pytest.mark.parametrize("storage", STORAGES)
def test_frames_of_ros1_lose_their_slash_wherever_they_are_printed(
    tmp_path, capsys, storage
):
    parent = ("/a", ODOMETRY, "/odom", "/base_link", POSES)
    child = ("/b", ODOMETRY, "/map", "/robot/camera", CHILD)
    path = bag_of(bag_path(tmp_path, storage), parent, child, storage)
    topics = ["--parent-topic", "/a", "--child-topic", "/b"]
    document, _ = calibrated(capsys, path, *topics)
    assert frames_of(document) == ("base_link", "robot/camera")
    main(["calibrate", str(path), *topics, "--reference", "B5"])
    text = capsys.readouterr().out
    assert "robot/camera in base_link: maps" in text
    assert " /base_link" not in text


def test_options_trees_results_and_installed_poses_have_no_slash(tmp_path):
    config = CalibratorConfig(parent_frame="/base_link", child_frame="/camera")
    assert (config.parent_frame, config.child_frame) == ("base_link", "camera")
    assert (
        NodeConfig(base_frame="/base_footprint").base_frame == "base_footprint"
    )
    tree = FrameTree()
    tree.add("/base_link", "/camera", T_PARENT_CHILD)
    assert_array_equal(tree.pose("base_link", "camera"), T_PARENT_CHILD)
    assert_array_equal(tree.pose("/base_link", "/camera"), T_PARENT_CHILD)
    parent = Trajectory(STAMPS_NS, POSES, "/base_link")
    child = Trajectory(STAMPS_NS, CHILD, "/camera")
    result = hec.calibrate(parent, child, reference="B5", checks=False)
    assert (result.parent_frame, result.child_frame) == ("base_link", "camera")
    assert replace(result, base_frame="/map").base_frame == "map"
    old = json.loads(json.dumps(result.to_dict()))
    old["parent_frame"] = "/base_link"
    file = tmp_path / "extrinsic.yaml"
    file.write_text(yaml.safe_dump(old))
    installed = open_installed(str(file))("base_link", "camera")
    assert_allclose(installed.T_parent_child, T_PARENT_CHILD, atol=1e-6)
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(
        '<robot name="r"><link name="/base_link"/><link name="/camera"/>'
        '<joint name="j" type="fixed"><origin xyz="1 2 3" rpy="0 0 0"/>'
        '<parent link="/base_link"/><child link="/camera"/></joint></robot>'
    )
    described = open_installed(str(urdf))("base_link", "camera")
    assert described.T_parent_child[:3, 3].tolist() == [1.0, 2.0, 3.0]


def test_a_journal_keeps_the_world_of_a_stream(tmp_path):
    from hand_eye_calib.formats.journal import JournalWriter

    about = {
        "parent": {"frame": "tool0", "world": "base_link"},
        "child": {"frame": "marker", "world": "camera"},
    }
    writer = JournalWriter(tmp_path, about)
    for stream, poses in (("parent", POSES), ("child", INVERSE)):
        for stamp_ns, row in zip(
            STAMPS_NS.tolist(), se3.to_rows(poses).tolist(), strict=True
        ):
            writer.add_pose(stream, stamp_ns, row[:3], row[3:])
    writer.close()
    engine = Calibrator(CalibratorConfig(child_invert="poses"))
    replay_journal(read_journal(tmp_path), tmp_path, Calibrators(child=engine))
    snapshot = engine.snapshot()
    assert (snapshot.parent_frame, snapshot.child_frame) == ("tool0", "camera")
