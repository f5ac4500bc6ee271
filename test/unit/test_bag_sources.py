"""Where poses may come from in a bag: all types of messages, paths, chains of transforms, several
and compressed bags.
"""

import re
import struct

import numpy as np
import pytest
from bag_making import PATH, TF, path_message, tf_message, write_messages
from motions import T_PARENT_CHILD, as_trajectory, child_of, wandering_poses
from rosbags import rosbag1, rosbag2

import hand_eye_calib as hec
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.bags import PoseBag, write_bag
from hand_eye_calib.io.bags.messages import MESSAGE_TYPES, POSE_TYPES
from hand_eye_calib.io.bags.writer import write_streams
from hand_eye_calib.io.transforms import TfSource

ODOMETRY = "nav_msgs/msg/Odometry"
STORAGES = ("mcap", "sqlite3", "rosbag1")
POSES = wandering_poses(120)
PARENT = as_trajectory(POSES, sensor_frame="lidar", world_frame="map")
CHILD = as_trajectory(child_of(POSES), sensor_frame="camera", world_frame="odom")
SECOND = 10**9


def bag_path(tmp_path, storage, name="bag"):
    return tmp_path / (f"{name}.bag" if storage == "rosbag1" else name)


def assert_same_motion(trajectory, stamps_ns, poses, atol=1e-12):
    assert trajectory.stamps_ns.tolist() == list(stamps_ns)
    np.testing.assert_allclose(trajectory.poses, poses, atol=atol)


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("message_type", POSE_TYPES)
def test_every_type_of_stamped_pose(tmp_path, storage, message_type):
    path = bag_path(tmp_path, storage)
    write_bag(path, {"/a": (PARENT, message_type), "/b": (CHILD, ODOMETRY)}, storage)
    trajectory = hec.read_trajectory(path, topic="/a")
    assert_same_motion(trajectory, PARENT.stamps_ns, PARENT.poses)
    assert (trajectory.world_frame, trajectory.sensor_frame) == (
        "map",
        "lidar" if MESSAGE_TYPES[message_type].has_child_frame else "",
    )


def test_the_same_poses_are_bit_identical_in_all_storages(tmp_path):
    results = []
    for storage in STORAGES:
        path = bag_path(tmp_path, storage, storage)
        write_bag(path, {"/a": (PARENT, ODOMETRY), "/b": (CHILD, ODOMETRY)}, storage)
        results.append(
            hec.calibrate(
                hec.read_trajectory(path, topic="/a"),
                hec.read_trajectory(path, topic="/b"),
                reference="B5",
            )
        )
    for result in results[1:]:
        np.testing.assert_array_equal(result.T_parent_child, results[0].T_parent_child)
        np.testing.assert_array_equal(result.covariance, results[0].covariance)


# ---- transforms


def transforms(moving, static=(), slash=""):
    """Messages of edges: (child, parent, Trajectory) each, and (child, parent, matrix)."""
    messages = [
        (stamp_ns, "/tf", TF, tf_message([(stamp_ns, slash + parent, slash + child, matrix)]))
        for child, parent, trajectory in moving
        for stamp_ns, matrix in zip(trajectory.stamps_ns, trajectory.poses, strict=True)
    ]
    edges = [(0, slash + parent, slash + child, matrix) for child, parent, matrix in static]
    return (
        [*messages, (int(PARENT.stamps_ns[0]) - 1, "/tf_static", TF, tf_message(edges))]
        if edges
        else messages
    )


MOUNT = se3.exp(np.array([0.3, 0.1, -0.4, 0.2, 0.5, -0.9]))


@pytest.mark.parametrize("storage", STORAGES)
def test_a_chain_of_moving_and_static_transforms(tmp_path, storage):
    """map <- odom at 4 Hz, odom <- base at 10 Hz, base <- lidar fixed: poses of the lidar in the
    map, at the slow one's stamps.
    """
    slow = Trajectory(
        PARENT.stamps_ns[0] + 250_000_000 * np.arange(40) + 20_000_000,
        se3.exp(np.linspace(0, 1, 40)[:, None] * np.full(6, 0.2)),
    )
    messages = transforms(
        [("odom", "map", slow), ("base", "odom", PARENT)],
        [("lidar", "base", MOUNT), ("rear", "base", T_PARENT_CHILD)],
    )
    path = write_messages(bag_path(tmp_path, storage), messages, storage)
    trajectory = hec.read_trajectory(path, tf="map:lidar")
    inside = slow.stamps_ns <= PARENT.stamps_ns[-1]
    assert_same_motion(
        trajectory,
        slow.stamps_ns[inside],
        slow.poses[inside] @ PARENT.at(slow.stamps_ns[inside], straight=True) @ MOUNT,
    )
    assert (trajectory.world_frame, trajectory.sensor_frame) == ("map", "lidar")
    # Up and down again, through the common ancestor; and against the direction of the tree.
    other = hec.read_trajectory(path, tf="odom:lidar")
    assert_same_motion(other, PARENT.stamps_ns, PARENT.poses @ MOUNT)
    backwards = hec.read_trajectory(path, tf="lidar:odom")
    assert_same_motion(backwards, PARENT.stamps_ns, se3.inverse(PARENT.poses @ MOUNT))
    with pytest.raises(
        InputError,
        match=r"transform lidar:rear does not move: all of its transforms are static; it has "
        r"base:lidar \(static\), base:rear \(static\), map:odom",
    ):
        hec.read_trajectory(path, tf="lidar:rear")


def test_old_transforms_with_slashes_and_of_the_old_type(tmp_path):
    old = "tf/msg/tfMessage"
    messages = [
        (stamp_ns, "/tf", old, tf_message([(stamp_ns, "/odom", "/base", matrix)], old))
        for stamp_ns, matrix in zip(PARENT.stamps_ns, PARENT.poses, strict=True)
    ]
    trajectory = hec.read_trajectory(
        write_messages(tmp_path / "old.bag", messages, "rosbag1"), tf="odom:base"
    )
    assert_same_motion(trajectory, PARENT.stamps_ns, PARENT.poses)


def test_both_sensors_from_transforms_give_the_extrinsic(tmp_path):
    messages = transforms([("lidar", "map", PARENT), ("camera", "odom", CHILD)])
    path = write_messages(tmp_path / "bag", messages)
    with PoseBag(path) as bag:
        sources = bag.select_topics(TfSource("map", "lidar"), TfSource("odom", "camera"))
        poses = list(bag.poses(*sources))
        assert bag.warnings == []
    assert [pose.bag_ns for pose in poses] == sorted(pose.bag_ns for pose in poses)
    assert {(pose.stream, pose.world_frame, pose.sensor_frame) for pose in poses} == {
        ("parent", "map", "lidar"), ("child", "odom", "camera")
    }  # fmt: skip
    result = hec.calibrate(
        *(hec.read_trajectory(path, tf=tf) for tf in ("map:lidar", "odom:camera")), reference="B5"
    )
    np.testing.assert_allclose(result.T_parent_child, T_PARENT_CHILD, atol=1e-6)


def test_a_gap_in_a_chain_is_not_bridged(tmp_path):
    holey = PARENT[(np.arange(120) < 40) | (np.arange(120) >= 60)]
    steady = Trajectory(PARENT.stamps_ns[::2], np.repeat(np.eye(4)[None], 60, axis=0))
    path = write_messages(
        tmp_path / "bag", transforms([("base", "odom", holey), ("odom", "map", steady)])
    )
    with pytest.warns(
        UserWarning,
        match=r"transform map:base: 10 of 60 poses were left out, .* not known within 0\.5 s",
    ):
        trajectory = hec.read_trajectory(path, tf="map:base")
    assert len(trajectory) == 50


def test_repeated_transforms_count_once(tmp_path):
    path = write_messages(tmp_path / "bag", transforms([("base", "odom", PARENT)] * 2))
    assert_same_motion(hec.read_trajectory(path, tf="odom:base"), PARENT.stamps_ns, PARENT.poses)


@pytest.mark.parametrize(
    ("moving", "message"),
    [
        ([("base", "odom", PARENT)], r"no frame 'lidar' in the bag's transforms; it has odom:base"),
        (
            [("lidar", "base", PARENT), ("odom", "map", PARENT)],
            "frames 'odom' and 'lidar' are not connected; it has base:lidar, map:odom",
        ),
        (
            [("lidar", "odom", PARENT), ("lidar", "map", PARENT)],
            "frame 'lidar' has two parents, 'odom' and 'map'",
        ),
        (
            [("lidar", "odom", PARENT), ("odom", "lidar", PARENT)],
            "the bag's transforms form a loop through frame",
        ),
    ],
)
def test_transforms_that_do_not_lead_there(tmp_path, moving, message):
    path = write_messages(tmp_path / "bag", transforms(moving))
    with pytest.raises(InputError, match=message) as caught:
        hec.read_trajectory(path, tf="odom:lidar")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["odom", "odom:", ":lidar", "a:b:c", "odom:odom", "odom:/odom"])
def test_frames_that_are_not_a_pair(text):
    with pytest.raises(ConfigError, match="expected two frames as WORLD:SENSOR"):
        TfSource.parse(text)


def test_a_bag_without_transforms_says_what_it_has(tmp_path):
    write_bag(tmp_path / "bag", {"/a": (PARENT, ODOMETRY)})
    with pytest.raises(
        InputError,
        match=r"no transforms in .*The bag has /a \(nav_msgs/msg/Odometry, 120 messages\)",
    ):
        hec.read_trajectory(tmp_path / "bag", tf="odom:lidar")


# ---- paths


@pytest.mark.parametrize("storage", STORAGES)
def test_a_growing_path_is_its_newest_message(tmp_path, storage):
    """A SLAM publishes its whole past again and again; the last correction counts, the time of the
    first appearance is kept.
    """
    messages = []
    for end in range(10, 121, 10):
        corrected = POSES[:end].copy()
        corrected[:, 0, 3] += 0.01 * (120 - end)
        messages.append(
            (
                PARENT.stamps_ns[end - 1],
                "/path",
                PATH,
                path_message(PARENT.stamps_ns[:end], corrected),
            )
        )
    path = write_messages(bag_path(tmp_path, storage), messages, storage)
    assert_same_motion(hec.read_trajectory(path, topic="/path"), PARENT.stamps_ns, POSES)
    with PoseBag(path) as bag:
        poses = list(bag.poses("/path", "/none"))
    assert [pose.bag_ns for pose in poses] == np.repeat(PARENT.stamps_ns[9::10], 10).tolist()


def test_a_path_that_drops_its_oldest_poses_is_put_together(tmp_path):
    messages = [
        (
            PARENT.stamps_ns[end - 1],
            "/path",
            PATH,
            path_message(PARENT.stamps_ns[max(end - 30, 0) : end], POSES[max(end - 30, 0) : end]),
        )
        for end in range(10, 121, 10)
    ]
    assert_same_motion(
        hec.read_trajectory(write_messages(tmp_path / "bag", messages), topic="/path"),
        PARENT.stamps_ns,
        POSES,
    )


def test_a_path_whose_poses_have_no_stamps_is_refused(tmp_path):
    messages = [
        (SECOND, "/path", PATH, path_message(np.zeros(5, dtype=int), POSES[:5])),
        (SECOND, "/p", PATH, path_message([], [])),
    ]
    path = write_messages(tmp_path / "bag", messages)
    with pytest.raises(InputError, match="the poses of path /path have no stamps"):
        hec.read_trajectory(path, topic="/path")
    with pytest.raises(InputError, match="no poses on /p of"):
        hec.read_trajectory(path, topic="/p")


# ---- which topics are meant


def choose(tmp_path, streams, extra=()):
    path = tmp_path / "bag"
    with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        write_streams(writer, streams, "mcap")
        from bag_making import JAZZY

        for topic, message_type, make in extra:
            connection = writer.add_connection(topic, message_type, typestore=JAZZY)
            writer.write(
                connection, int(PARENT.stamps_ns[0]), JAZZY.serialize_cdr(make(JAZZY), message_type)
            )
    with PoseBag(path) as bag:
        return bag.select_topics()


def test_a_goal_that_was_published_once_is_no_sensor(tmp_path):
    streams = {
        "/a": (PARENT, ODOMETRY),
        "/b": (CHILD, ODOMETRY),
        "/goal_pose": (PARENT[:1], "geometry_msgs/msg/PoseStamped"),
    }
    assert choose(tmp_path, streams) == ("/a", "/b")


def test_a_path_counts_where_there_are_not_two_others(tmp_path):
    path = ("/path", PATH, path_message(PARENT.stamps_ns, POSES))
    assert choose(tmp_path / "1", {"/a": (PARENT, ODOMETRY), "/z": (CHILD, ODOMETRY)}, [path]) == (
        "/a",
        "/z",
    )
    assert choose(tmp_path / "2", {"/z": (CHILD, ODOMETRY)}, [path]) == ("/path", "/z")


# ---- several bags, compressed bags, other layouts


@pytest.mark.parametrize("storage", STORAGES)
def test_the_parts_of_a_drive_are_read_in_the_order_of_time(tmp_path, storage):
    paths = []
    for number, part in enumerate([slice(80, 120), slice(0, 40), slice(40, 80)]):
        paths.append(bag_path(tmp_path, storage, f"part{number}"))
        write_bag(
            paths[-1], {"/a": (PARENT[part], ODOMETRY), "/b": (CHILD[part], ODOMETRY)}, storage
        )
    with PoseBag(*paths) as bag:
        poses = list(bag.poses("/a", "/b"))
        assert bag.topics() == [("/a", ODOMETRY, 120), ("/b", ODOMETRY, 120)]
        assert (bag.start_ns, bag.end_ns) == (PARENT.stamps_ns[0], PARENT.stamps_ns[-1])
    assert [pose.stamp_ns for pose in poses if pose.stream == "parent"] == PARENT.stamps_ns.tolist()
    assert [pose.number for pose in poses if pose.stream == "child"] == list(range(1, 121))


def test_bags_of_one_sensor_each_are_read_side_by_side(tmp_path):
    write_bag(tmp_path / "lidar.bag", {"/a": (PARENT, ODOMETRY)}, "rosbag1")
    write_bag(tmp_path / "camera", {"/b": (CHILD, ODOMETRY)}, "mcap")
    with PoseBag(tmp_path / "lidar.bag", tmp_path / "camera") as bag:
        assert bag.select_topics() == ("/a", "/b")
        poses = list(bag.poses("/a", "/b"))
    assert [pose.bag_ns for pose in poses] == sorted([*PARENT.stamps_ns, *CHILD.stamps_ns])


def read_all(path):
    with PoseBag(path) as bag:
        return list(bag.poses("/a", "/b"))


@pytest.mark.parametrize(
    ("storage", "mode"),
    [
        ("mcap", "STORAGE"),
        ("mcap", "MESSAGE"),
        ("mcap", "FILE"),
        ("sqlite3", "MESSAGE"),
        ("sqlite3", "FILE"),
    ],
)
def test_compressed_bags(tmp_path, storage, mode):
    write_bag(tmp_path / "plain", {"/a": (PARENT, ODOMETRY), "/b": (CHILD, ODOMETRY)}, storage)
    writer = rosbag2.Writer(
        tmp_path / "bag", version=9, storage_plugin=rosbag2.StoragePlugin[storage.upper()]
    )
    writer.set_compression(rosbag2.CompressionMode[mode], rosbag2.CompressionFormat.ZSTD)
    with writer:
        write_streams(writer, {"/a": (PARENT, ODOMETRY), "/b": (CHILD, ODOMETRY)}, storage)
    expected = read_all(tmp_path / "plain")
    assert read_all(tmp_path / "bag") == expected
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert read_all(tmp_path / "bag") == expected
    (file,) = (tmp_path / "bag").iterdir()
    assert (file.suffix == ".zstd") == (mode == "FILE")
    assert read_all(file) == expected


@pytest.mark.parametrize("compression", list(rosbag1.Writer.CompressionFormat))
def test_compressed_chunks_of_rosbag1(tmp_path, compression):
    write_bag(
        tmp_path / "plain.bag", {"/a": (PARENT, ODOMETRY), "/b": (CHILD, ODOMETRY)}, "rosbag1"
    )
    writer = rosbag1.Writer(tmp_path / "bag.bag")
    writer.set_compression(compression)
    with writer:
        write_streams(writer, {"/a": (PARENT, ODOMETRY), "/b": (CHILD, ODOMETRY)}, "rosbag1")
    assert read_all(tmp_path / "bag.bag") == read_all(tmp_path / "plain.bag")


FOOTER = struct.pack("<BQQQI", 2, 20, 0, 0, 0)


def without_index(data):
    """The records of an mcap without its summary, as a recorder writes it that makes no index."""
    (summary,) = struct.unpack_from("<Q", data, len(data) - 8 - 20)
    return data[:summary] + FOOTER + data[-8:]


def without_chunks(data):
    """The same messages outside chunks, the second half first: not in the order of time."""
    (size,) = struct.unpack_from("<Q", data, 9)
    position, messages, others = 17 + size, [], []
    while data[position] != 0x0F:
        (size,) = struct.unpack_from("<Q", data, position + 1)
        if data[position] == 6:
            body, end = position + 9 + 28 + 4 + 8, position + 9 + size
            while body < end:
                (length,) = struct.unpack_from("<Q", data, body + 1)
                (messages if data[body] == 5 else others).append(data[body : body + 9 + length])
                body += 9 + length
        position += 9 + size
    half = len(messages) // 2
    (size,) = struct.unpack_from("<Q", data, 9)
    return (
        data[: 17 + size]
        + b"".join(others + messages[half:] + messages[:half])
        + FOOTER
        + data[-8:]
    )


@pytest.mark.parametrize("change", [without_index, without_chunks])
def test_mcap_files_without_index_and_without_chunks_are_whole(tmp_path, change):
    write_bag(tmp_path / "bag", {"/a": (PARENT, ODOMETRY), "/b": (CHILD, ODOMETRY)})
    expected = read_all(tmp_path / "bag")
    data = (tmp_path / "bag" / "bag.mcap").read_bytes()
    (tmp_path / "changed.mcap").write_bytes(change(data))
    with PoseBag(tmp_path / "changed.mcap") as bag:
        assert list(bag.poses("/a", "/b")) == expected
        assert bag.warnings == []


# ---- poses that cannot be right


def spoiled(trajectory, index, change):
    poses = trajectory.poses.copy()
    poses[index] = change(poses[index])
    return Trajectory(trajectory.stamps_ns, poses, trajectory.sensor_frame, trajectory.world_frame)


def moved(matrix):
    return matrix + np.pad([[0.0, 0.0, 0.0, 40.0]], ((1, 2), (0, 0)))


def turned(matrix):
    return matrix @ se3.exp(np.array([0, 0, 0, 1.5, 0, 0]))


@pytest.mark.parametrize(("change", "by", "unit"), [(moved, 40, "m"), (turned, 1.5, "rad")])
@pytest.mark.parametrize("index", [0, 1, 60, 118, 119])
def test_a_pose_that_jumps_away_and_back_is_warned_about(tmp_path, change, by, unit, index):
    calm = as_trajectory(wandering_poses(120, step_rad=0.02), sensor_frame="camera")
    write_bag(
        tmp_path / "bag", {"/a": (PARENT, ODOMETRY), "/b": (spoiled(calm, index, change), ODOMETRY)}
    )
    with PoseBag(tmp_path / "bag") as bag:
        list(bag.poses("/a", "/b"))
        warnings = bag.warnings
        assert bag.warnings == warnings  # asking twice changes nothing
    assert len(warnings) == 1
    assert (
        f"/b: 1 of 120 poses jump away and back (first message {index + 1}, stamp " in warnings[0]
    )
    found, found_unit = re.search(r"by ([\d.]+) (\w+)", warnings[0]).groups()
    assert (float(found), found_unit) == (pytest.approx(by, rel=0.1), unit)


def test_lasting_jumps_and_quick_motion_are_nothing_unusual(tmp_path):
    jumped = CHILD.poses.copy()
    jumped[50:, 0, 3] += 5.0
    jumped = Trajectory(CHILD.stamps_ns, jumped, "camera", "odom")
    write_bag(
        tmp_path / "bag",
        {
            "/a": (
                as_trajectory(wandering_poses(120, step_m=3.0)),
                "geometry_msgs/msg/PoseStamped",
            ),
            "/b": (jumped, ODOMETRY),
        },
    )
    with PoseBag(tmp_path / "bag") as bag:
        list(bag.poses("/a", "/b"))
        assert bag.warnings == []


def test_a_stamp_that_jumps_against_the_bags_own_time_is_warned_about(tmp_path):
    from bag_making import header, pose

    def odometry(stamp_ns, matrix):
        def make(typestore):
            types = typestore.types
            zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
            twist = types["geometry_msgs/msg/TwistWithCovariance"](
                types["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36)
            )
            with_covariance = types["geometry_msgs/msg/PoseWithCovariance"](
                pose(typestore, matrix), np.zeros(36)
            )
            return types[ODOMETRY](
                header(typestore, stamp_ns, "odom"), "lidar", with_covariance, twist
            )

        return make

    stamps_ns = PARENT.stamps_ns.copy()
    stamps_ns[30] += 64 * SECOND
    messages = [
        (bag_ns, "/a", ODOMETRY, odometry(stamp_ns, matrix))
        for bag_ns, stamp_ns, matrix in zip(PARENT.stamps_ns, stamps_ns, PARENT.poses, strict=True)
    ]
    path = write_messages(tmp_path / "bag", messages)
    expected = (
        r"/a: 1 of 120 stamps jump away and back against the bag's own time \(first message "
        r"31, .*by 64 s\); their poses were left out"
    )
    with pytest.warns(UserWarning, match=expected):
        trajectory = hec.read_trajectory(path, topic="/a")
    assert_same_motion(
        trajectory, np.delete(PARENT.stamps_ns, 30), np.delete(PARENT.poses, 30, axis=0)
    )


def test_reading_from_a_bag_takes_no_options_of_text_files(tmp_path):
    for options in ({"format": "csv"}, {"columns": "t"}, {"repair": True}, {"tf": "a:b"}):
        with pytest.raises(ConfigError, match="topic and tf are for bags"):
            hec.read_trajectory(tmp_path, topic="/a", **options)
