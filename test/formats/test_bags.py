"""Bags: all storages give the same poses, from all kinds of topics; what is asked for wrongly is
answered with what is there.
"""

import numpy as np
import pytest
from bag_making import (
    JAZZY,
    NOETIC,
    ODOMETRY,
    PATH,
    POSE_STAMPED,
    STORAGES,
    TF,
    all_poses,
    bag_path,
    path_message,
    poses_of,
    storage_file,
    tf_message,
    write_compressed,
    write_messages,
)
from motions import T_PARENT_CHILD, as_trajectory, child_of, wandering_poses
from numpy.testing import assert_allclose, assert_array_equal
from published_data import data_folder
from rosbags import rosbag1, rosbag2

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.formats.bags.writer import (
    stamped_messages,
    write_bag,
    write_streams,
)

SECOND = 10**9
POSES = wandering_poses(120)
PARENT = as_trajectory(POSES, sensor_frame="lidar", world_frame="map")
CHILD = as_trajectory(
    child_of(POSES)[:90], sensor_frame="camera", world_frame="odom"
)
STREAMS = {"/a": (PARENT, ODOMETRY), "/b": (CHILD, POSE_STAMPED)}


@pytest.fixture
def new_bag(tmp_path):
    """Writes a bag and returns its path."""

    def write(storage="mcap", streams=STREAMS, name="bag"):
        path = bag_path(tmp_path, storage, name)
        write_bag(path, streams, storage)
        return path

    return write


def assert_same_motion(trajectory, stamps_ns, poses, atol=1e-12):
    assert trajectory.stamps_ns.tolist() == list(stamps_ns)
    assert_allclose(trajectory.poses, poses, atol=atol)


@pytest.mark.parametrize("storage", STORAGES)
def test_poses_come_back_in_the_order_of_time_with_exact_stamps_and_frames(
    new_bag, storage
):
    poses = all_poses(new_bag(storage))
    assert [pose.stamp_ns for pose in poses] == sorted(
        [*PARENT.stamps_ns, *CHILD.stamps_ns]
    )
    for stream, source, frames in (
        ("parent", PARENT, ("map", "lidar")),
        ("child", CHILD, ("odom", None)),
    ):
        of_stream = [pose for pose in poses if pose.stream == stream]
        assert [
            pose.stamp_ns for pose in of_stream
        ] == source.stamps_ns.tolist()
        assert {
            (pose.world_frame, pose.sensor_frame) for pose in of_stream
        } == {frames}
        values = [pose.pose for pose in of_stream]
        quats_xyzw = se3.to_quat_xyzw(source.poses)
        assert_array_equal(values, np.c_[source.poses[:, :3, 3], quats_xyzw])


# ---- which topics are meant


def with_others(path, *others):
    """A bag of both streams and a message of each other topic: name, type and how to make it."""
    with rosbag2.Writer(
        path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP
    ) as writer:
        write_streams(writer, STREAMS, "mcap")
        for topic, message_type, make in others:
            connection = writer.add_connection(
                topic, message_type, typestore=JAZZY
            )
            data = JAZZY.serialize_cdr(make(JAZZY), message_type)
            writer.write(connection, int(PARENT.stamps_ns[3]), data)
    return path


LOG = (
    "/log",
    "std_msgs/msg/String",
    lambda types: types.types["std_msgs/msg/String"]("hello"),
)


def test_topics_are_listed_and_others_do_not_get_in_the_way(tmp_path, new_bag):
    path = with_others(
        tmp_path / "others", LOG, ("/path", PATH, path_message([], []))
    )
    assert all_poses(path) == all_poses(new_bag())
    with PoseBag(path) as bag:
        assert bag.select() == ("/a", "/b")
        assert [*bag.topics.values()][:2] == [
            ("/a", ODOMETRY, 120),
            ("/b", POSE_STAMPED, 90),
        ]
        assert (
            str(bag.topics["/log"]) == "/log (std_msgs/msg/String, 1 messages)"
        )


@pytest.mark.parametrize(
    ("named", "selected"),
    [
        (("/a", None), ("/a", "/b")),
        ((None, "/a"), ("/b", "/a")),
        ((None, None), ("/a", "/b")),
    ],
)
def test_two_pose_topics_leave_no_choice(new_bag, named, selected):
    goal = {
        "/goal_pose": (PARENT[:1], POSE_STAMPED)
    }  # published once: no sensor
    for streams in (STREAMS, STREAMS | goal):
        with PoseBag(
            new_bag(streams=streams, name=f"bag{len(streams)}")
        ) as bag:
            assert bag.select(*named) == selected


@pytest.mark.parametrize(
    ("named", "message"),
    [
        (("/odom", "/b"), "no topic /odom in "),
        (
            ("/a", "/log"),
            r"/log of .* has type std_msgs/msg/String, which cannot be read",
        ),
        (("/a", "/a"), "parent and child topic are both /a"),
    ],
)
def test_a_wrong_topic_is_answered_with_those_that_are_there(
    tmp_path, named, message
):
    with (
        PoseBag(with_others(tmp_path / "bag", LOG)) as bag,
        pytest.raises(InputError, match=message) as caught,
    ):
        bag.select(*named)
    listing = (
        "The bag has /a (nav_msgs/msg/Odometry, 120 messages) and "
        "/b (geometry_msgs/msg/PoseStamped, 90 messages), and 1 topic of other types"
    )
    assert listing in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("count", "message"),
    [
        (0, "the bag has no messages"),
        (1, r"only one topic has poses, /odom_0 .*\. The bag has /odom_0 "),
        (3, "3 topics have poses: /odom_0 .*, /odom_1 .* and /odom_2 "),
    ],
)
def test_without_names_there_must_be_an_obvious_pair_of_topics(
    new_bag, count, message
):
    path = new_bag(
        streams={f"/odom_{number}": STREAMS["/a"] for number in range(count)}
    )
    with PoseBag(path) as bag, pytest.raises(InputError, match=message):
        bag.select()


def test_several_publishers_and_types_on_one_topic(tmp_path):
    """Two connections of one type are one stream; of two types, the topic is refused."""
    for name, second_type in (
        ("one.bag", ODOMETRY),
        ("two.bag", "std_msgs/msg/String"),
    ):
        with rosbag1.Writer(tmp_path / name) as writer:
            write_streams(writer, STREAMS, "rosbag1")
            about = {"typestore": NOETIC, "callerid": "/second"}
            connection = writer.add_connection("/a", second_type, **about)
            later = Trajectory(PARENT.stamps_ns[-1:] + 1, PARENT.poses[-1:])
            stamp_ns, message = next(
                stamped_messages(NOETIC.types, later, ODOMETRY, True)
            )
            text = NOETIC.types["std_msgs/msg/String"]("hello")
            message = message if second_type == ODOMETRY else text
            writer.write(
                connection,
                stamp_ns,
                NOETIC.serialize_ros1(message, second_type),
            )
    poses = all_poses(tmp_path / "one.bag")
    assert sum(pose.stream == "parent" for pose in poses) == len(PARENT) + 1
    with (
        PoseBag(tmp_path / "two.bag") as bag,
        pytest.raises(
            InputError, match="topic /a of .* has type several types"
        ),
    ):
        bag.select("/a", "/b")


# ---- transforms


def transforms(moving, static=()):
    """Messages of edges: (child, parent, Trajectory) each, and (child, parent, matrix)."""
    messages = [
        (stamp_ns, "/tf", TF, tf_message([(stamp_ns, parent, child, matrix)]))
        for child, parent, trajectory in moving
        for stamp_ns, matrix in zip(
            trajectory.stamps_ns, trajectory.poses, strict=True
        )
    ]
    edges = [(0, parent, child, matrix) for child, parent, matrix in static]
    before_ns = int(PARENT.stamps_ns[0]) - 1
    return [
        *messages,
        *[(before_ns, "/tf_static", TF, tf_message(edges))][: len(edges)],
    ]


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
    moving = [("odom", "map", slow), ("base", "odom", PARENT)]
    static = [("lidar", "base", MOUNT), ("rear", "base", T_PARENT_CHILD)]
    path = write_messages(
        bag_path(tmp_path, storage), transforms(moving, static), storage
    )
    trajectory = hec.read_trajectory(path, topic="map:lidar")
    stamps_ns = slow.stamps_ns[slow.stamps_ns <= PARENT.stamps_ns[-1]]
    expected = (
        slow.poses[: len(stamps_ns)]
        @ PARENT.at(stamps_ns, straight=True)
        @ MOUNT
    )
    assert_same_motion(trajectory, stamps_ns, expected)
    assert (trajectory.world_frame, trajectory.sensor_frame) == ("map", "lidar")
    # Up and down again, through the common ancestor; and against the direction of the tree.
    other = hec.read_trajectory(path, topic="odom:lidar")
    assert_same_motion(other, PARENT.stamps_ns, PARENT.poses @ MOUNT)
    backwards = hec.read_trajectory(path, topic="lidar:odom")
    assert_same_motion(
        backwards, PARENT.stamps_ns, se3.inverse(PARENT.poses @ MOUNT)
    )
    message = (
        r"transform lidar:rear: it does not move, because all of its transforms are static; it has "
        r"base:lidar \(static\), base:rear \(static\), map:odom"
    )
    with pytest.raises(InputError, match=message):
        hec.read_trajectory(path, topic="lidar:rear")


def test_old_transforms_with_slashes_and_of_the_old_type_count_once(tmp_path):
    old = "tf/msg/tfMessage"
    messages = [
        (
            stamp_ns,
            "/tf",
            old,
            tf_message([(stamp_ns, "/odom", "/base", matrix)], old),
        )
        for stamp_ns, matrix in zip(PARENT.stamps_ns, PARENT.poses, strict=True)
    ]
    path = write_messages(tmp_path / "old.bag", messages * 2, "rosbag1")
    assert_same_motion(
        hec.read_trajectory(path, topic="odom:base"),
        PARENT.stamps_ns,
        PARENT.poses,
    )


@pytest.mark.parametrize(
    ("edges", "message"),
    [
        (
            ["base odom"],
            r"no frame 'lidar' in the bag's transforms; it has odom:base",
        ),
        (
            ["lidar base", "odom map"],
            "'odom' and 'lidar' are not connected; it has base:lidar, m",
        ),
        (
            ["lidar odom", "lidar map"],
            "frame 'lidar' has two parents, 'odom' and 'map'",
        ),
        (
            ["lidar odom", "odom lidar"],
            "the bag's transforms form a loop through frame",
        ),
        (
            [],
            r"no transforms in .*The bag has /a \(nav_msgs/msg/Odometry, 120 messages\)",
        ),
    ],
)
def test_transforms_that_do_not_lead_there(tmp_path, new_bag, edges, message):
    moving = [(*edge.split(), PARENT) for edge in edges]
    path = (
        write_messages(tmp_path / "tf", transforms(moving))
        if edges
        else new_bag()
    )
    with pytest.raises(InputError, match=message) as caught:
        hec.read_trajectory(path, topic="odom:lidar")
    assert "\n" not in str(caught.value)


# ---- paths


@pytest.mark.parametrize("storage", STORAGES)
def test_a_growing_path_is_its_newest_message(tmp_path, storage):
    """A SLAM publishes its whole past again and again; the last correction counts."""
    messages = []
    for end in range(10, 121, 10):
        corrected = POSES[:end].copy()
        corrected[:, 0, 3] += 0.01 * (120 - end)
        path = path_message(PARENT.stamps_ns[:end], corrected)
        messages.append((PARENT.stamps_ns[end - 1], "/path", PATH, path))
    path = write_messages(bag_path(tmp_path, storage), messages, storage)
    assert_same_motion(
        hec.read_trajectory(path, topic="/path"), PARENT.stamps_ns, POSES
    )


def test_a_path_whose_poses_have_no_stamps_is_refused(tmp_path):
    without = (
        SECOND,
        "/path",
        PATH,
        path_message(np.zeros(5, dtype=int), POSES[:5]),
    )
    path = write_messages(
        tmp_path / "bag", [without, (SECOND, "/p", PATH, path_message([], []))]
    )
    with pytest.raises(
        InputError, match="the poses of path /path have no stamps"
    ):
        hec.read_trajectory(path, topic="/path")
    with pytest.raises(InputError, match="no poses on /p of"):
        hec.read_trajectory(path, topic="/p")


# ---- several bags, single files, compressed ones, metadata


@pytest.mark.parametrize("storage", STORAGES)
def test_the_parts_of_a_drive_are_read_in_the_order_of_time(new_bag, storage):
    paths = []
    for number, rows in enumerate(
        [slice(80, 120), slice(0, 40), slice(40, 80)]
    ):
        streams = {
            "/a": (PARENT[rows], ODOMETRY),
            "/b": (PARENT[rows], ODOMETRY),
        }
        paths.append(new_bag(storage, streams, f"part{number}"))
    with PoseBag(*paths) as bag:
        poses = poses_of(bag)
        assert [*bag.topics.values()] == [
            ("/a", ODOMETRY, 120),
            ("/b", ODOMETRY, 120),
        ]
        assert (bag.start_ns, bag.end_ns) == (
            PARENT.stamps_ns[0],
            PARENT.stamps_ns[-1],
        )
    assert [
        pose.stamp_ns for pose in poses if pose.stream == "parent"
    ] == PARENT.stamps_ns.tolist()


def test_bags_of_one_sensor_each_are_read_side_by_side(new_bag):
    lidar = new_bag("rosbag1", {"/a": STREAMS["/a"]}, "lidar")
    with PoseBag(
        lidar, new_bag("mcap", {"/b": STREAMS["/b"]}, "camera")
    ) as bag:
        assert bag.select() == ("/a", "/b")
        poses = poses_of(bag)
    assert [pose.bag_ns for pose in poses] == sorted(
        [*PARENT.stamps_ns, *CHILD.stamps_ns]
    )


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("mode", ["STORAGE", "MESSAGE", "FILE", None])
def test_compressed_bags_and_their_files_alone(
    tmp_path, new_bag, storage, mode
):
    if (storage, mode) == ("sqlite3", "STORAGE"):
        pytest.skip("only mcap has chunks to compress")
    expected = all_poses(new_bag(storage, name="plain"))
    path = write_compressed(tmp_path / "bag", STREAMS, storage, mode)
    assert all_poses(path) == expected
    (path / "metadata.yaml").unlink()
    assert all_poses(path) == expected
    (file,) = path.iterdir()
    assert (file.suffix == ".zstd") == (mode == "FILE")
    assert all_poses(file) == expected


@pytest.mark.parametrize("compression", list(rosbag1.Writer.CompressionFormat))
def test_compressed_chunks_of_rosbag1(tmp_path, new_bag, compression):
    writer = rosbag1.Writer(tmp_path / "chunks.bag")
    writer.set_compression(compression)
    with writer:
        write_streams(writer, STREAMS, "rosbag1")
    assert all_poses(tmp_path / "chunks.bag") == all_poses(new_bag("rosbag1"))


def test_the_files_of_a_directory_are_read_whatever_its_metadata_says(new_bag):
    path = new_bag("mcap")
    whole = all_poses(path)
    (path / "metadata.yaml").write_text("[" * 100_000)
    (storage,) = path.glob("*.mcap")
    (path / f"{storage.name}.zstd").write_bytes(
        b"left beside what was unpacked from it"
    )
    with PoseBag(path) as bag:
        assert poses_of(bag) == whole
        assert bag.warnings == []


# ---- poses that cannot be right


def test_a_stamp_that_jumps_against_the_bags_own_time_is_left_out(tmp_path):
    stamps_ns = PARENT.stamps_ns.copy()
    stamps_ns[30] += 64 * SECOND
    poses = zip(PARENT.stamps_ns, stamps_ns, PARENT.poses, strict=True)
    messages = []
    for bag_ns, stamp_ns, matrix in poses:
        jumping = Trajectory(np.array([stamp_ns]), matrix[None])
        ((_, message),) = stamped_messages(
            JAZZY.types, jumping, ODOMETRY, is_ros1=False
        )
        messages.append(
            (bag_ns, "/a", ODOMETRY, lambda _, message=message: message)
        )
    path = write_messages(tmp_path / "bag", messages)
    with pytest.warns(
        UserWarning,
        match="/a: 1 poses were left out: their stamps jump away from",
    ):
        trajectory = hec.read_trajectory(path, topic="/a")
    rest = np.arange(120) != 30
    assert_same_motion(trajectory, PARENT.stamps_ns[rest], PARENT.poses[rest])


# ---- writing, and bags of others


def test_writing_refuses_what_it_cannot_do(tmp_path, new_bag):
    path = new_bag()
    with pytest.raises(InputError, match="cannot write .*bag"):
        write_bag(storage_file(path) / "new", STREAMS)
    assert not {*tmp_path.iterdir()} - {path}


def test_bags_of_other_programs_read_or_are_refused_in_one_line():
    """Recordings of rosbag, rosbag2 and others: split, converted, compressed, unsorted, empty, of
    wrong formats.
    """
    folder = data_folder() / "bags"
    suffixes = (".bag", ".mcap", ".db3")
    paths = [
        p
        for p in folder.rglob("*")
        if p.suffix in suffixes or (p / "metadata.yaml").exists()
    ]
    refused = {}
    for path in paths:
        try:
            with PoseBag(path) as bag:
                counts = {
                    topic.name: topic.count for topic in bag.topics.values()
                }
                n_messages = sum(
                    len(run.messages) for run in bag.runs([*counts])
                )
                assert n_messages == sum(counts.values())
        except InputError as error:
            refused[path.name] = str(error)
    assert refused.keys() == {"empty-file.bag"}
    assert not [message for message in refused.values() if "\n" in message]
    poses = all_poses(folder / "fuse" / "turtlebot3.bag", "/odom", None)
    assert len(poses) == 2741
    assert {(pose.world_frame, pose.sensor_frame) for pose in poses} == {
        ("odom", "base_footprint")
    }
    lengths = np.linalg.norm([pose.pose[3:] for pose in poses], axis=1)
    assert_allclose(lengths, 1.0, atol=1e-6)
