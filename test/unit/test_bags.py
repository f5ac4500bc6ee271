"""Bags: all storages give the same poses, and a bag that cannot be read says so in one line."""

import re
import sys

import numpy as np
import pytest
import yaml
from published_data import data_folder
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from hand_eye_calib.errors import ConfigError, InputError, MissingDependencyError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.bags import PoseBag, write_bag
from hand_eye_calib.io.bags.writer import stamped_messages, write_streams

ODOMETRY, POSE_STAMPED = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
STORAGES = ("mcap", "sqlite3", "rosbag1")
JAZZY, NOETIC = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)


def trajectory(first_ns, count=40, seed=1, **frames):
    stamps_ns = first_ns + 100_000_007 * np.arange(count)
    return Trajectory(
        stamps_ns, se3.exp(np.random.default_rng(seed).normal(size=(count, 6))), **frames
    )


PARENT = trajectory(1317375625661736123, sensor_frame="lidar", world_frame="map")
CHILD = trajectory(
    1317375625661736130, count=30, seed=2, sensor_frame="camera_left", world_frame="odom_camera"
)
STREAMS = {"/lidar/odom": (PARENT, ODOMETRY), "/camera/pose": (CHILD, POSE_STAMPED)}


@pytest.fixture
def new_bag(tmp_path):
    """Writes a bag and returns its path."""

    def write(storage="mcap", streams=STREAMS, name="bag"):
        path = tmp_path / (name + (".bag" if storage == "rosbag1" else ""))
        write_bag(path, streams, storage)
        return path

    return write


def storage_file(path):
    """The file that holds the messages."""
    return (
        path
        if path.is_file()
        else next(part for part in path.iterdir() if part.suffix in (".mcap", ".db3"))
    )


def read(path, parent="/lidar/odom", child="/camera/pose"):
    with PoseBag(path) as bag:
        return list(bag.poses(parent, child))


@pytest.mark.parametrize("storage", STORAGES)
def test_poses_come_back_in_the_order_of_time_with_exact_stamps_and_frames(new_bag, storage):
    poses = read(new_bag(storage))
    assert [pose.stamp_ns for pose in poses] == sorted([*PARENT.stamps_ns, *CHILD.stamps_ns])
    for stream, source, world, sensor in (
        ("parent", PARENT, "map", "lidar"),
        ("child", CHILD, "odom_camera", None),
    ):
        found = [pose for pose in poses if pose.stream == stream]
        assert [pose.stamp_ns for pose in found] == source.stamps_ns.tolist()
        assert [pose.number for pose in found] == list(range(1, len(source) + 1))
        assert {(pose.world_frame, pose.sensor_frame) for pose in found} == {(world, sensor)}
        np.testing.assert_array_equal([pose.position for pose in found], source.poses[:, :3, 3])
        np.testing.assert_array_equal(
            [pose.quat_xyzw for pose in found], se3.to_quat_xyzw(source.poses)
        )


def test_storage_files_read_alone(new_bag):
    for storage in ("mcap", "sqlite3"):
        path = new_bag(storage, name=storage)
        assert read(storage_file(path)) == read(path)


def test_topics_lists_everything_in_the_bag(new_bag):
    with PoseBag(new_bag()) as bag:
        assert bag.topics() == [("/camera/pose", POSE_STAMPED, 30), ("/lidar/odom", ODOMETRY, 40)]
        assert str(bag.topics()[0]) == "/camera/pose (geometry_msgs/msg/PoseStamped, 30 messages)"


def add_text_topic(path):
    """A rosbag2 with poses and a topic of strings."""
    with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        write_streams(writer, STREAMS, "mcap")
        connection = writer.add_connection("/log", "std_msgs/msg/String", typestore=JAZZY)
        text = JAZZY.types["std_msgs/msg/String"]("hello")
        writer.write(
            connection, int(PARENT.stamps_ns[3]), JAZZY.serialize_cdr(text, "std_msgs/msg/String")
        )
    return path


def test_other_topics_do_not_get_in_the_way(tmp_path, new_bag):
    path = add_text_topic(tmp_path / "with_text")
    assert read(path) == read(new_bag())
    with PoseBag(path) as bag:
        assert bag.select_topics() == ("/lidar/odom", "/camera/pose")


@pytest.mark.parametrize(
    ("named", "selected"),
    [
        (("/lidar/odom", "/camera/pose"), ("/lidar/odom", "/camera/pose")),
        (("/lidar/odom", None), ("/lidar/odom", "/camera/pose")),
        ((None, "/lidar/odom"), ("/camera/pose", "/lidar/odom")),
        ((None, None), ("/lidar/odom", "/camera/pose")),
    ],
)
def test_two_pose_topics_leave_no_choice(new_bag, named, selected):
    with PoseBag(new_bag()) as bag:
        assert bag.select_topics(*named) == selected


@pytest.mark.parametrize(
    ("named", "message"),
    [
        (("/odom", "/camera/pose"), "no topic /odom in "),
        (
            ("/lidar/odom", "/log"),
            r"topic /log of .* is of type std_msgs/msg/String; accepted are "
            r"nav_msgs/msg/Odometry, ",
        ),
        (("/lidar/odom", "/lidar/odom"), "parent and child topic are both /lidar/odom"),
    ],
)
def test_a_wrong_topic_is_answered_with_those_that_are_there(tmp_path, named, message):
    with (
        PoseBag(add_text_topic(tmp_path / "bag")) as bag,
        pytest.raises(InputError, match=message) as caught,
    ):
        bag.select_topics(*named)
    listing = (
        "The bag has /camera/pose (geometry_msgs/msg/PoseStamped, 30 messages), "
        "/lidar/odom (nav_msgs/msg/Odometry, 40 messages), "
        "/log (std_msgs/msg/String, 1 messages)"
    )
    assert listing in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_without_names_there_must_be_exactly_two_pose_topics(new_bag, count):
    path = new_bag(streams={f"/odom_{number}": (PARENT, ODOMETRY) for number in range(count)})
    with (
        PoseBag(path) as bag,
        pytest.raises(
            InputError, match="name the topics of poses with --parent-topic and --child-topic"
        ),
    ):
        bag.select_topics()


def one_line(error):
    assert "\n" not in str(error.value)
    return str(error.value)


def cut_off(path, share):
    data = storage_file(path).read_bytes()
    storage_file(path).write_bytes(data[: int(len(data) * share)])


LONG = {topic: (trajectory(1_000, count=4000), ODOMETRY) for topic in STREAMS}


@pytest.mark.parametrize(
    ("storage", "compression", "share"),
    [
        *((storage, "", share) for storage in ("mcap", "rosbag1") for share in (0.3, 0.5, 0.9)),
        *(("mcap", "zstd", share) for share in (0.3, 0.5, 0.9)),
        *(("sqlite3", "", share) for share in (0.5, 0.9)),
    ],
)
def test_a_bag_cut_off_gives_what_came_before(tmp_path, storage, compression, share):
    """The recorder lost power: no index, the last chunk incomplete, no metadata.yaml."""
    path = tmp_path / ("bag.bag" if storage == "rosbag1" else "bag")
    if compression:
        write_compressed(path, LONG)
    else:
        write_bag(path, LONG, storage)
    whole = read(path)
    cut_off(path, share)
    if path.is_dir():
        (path / "metadata.yaml").unlink()
    with PoseBag(path) as bag:
        recovered = list(bag.poses("/lidar/odom", "/camera/pose"))
        (warning,) = bag.warnings
        assert sum(topic.count for topic in bag.topics()) == len(recovered)
    # Chunks are of 1 MiB, an uncompressed one can be used up to its last whole message. What leads
    # to the rows of a table may lie behind the cut.
    lost = 0.2 * (compression == "zstd") + 0.25 * (storage == "sqlite3")
    assert 0.9 * share - lost < len(recovered) / len(whole) < share + 0.1
    assert recovered == whole[: len(recovered)]
    assert re.search(r"cut off or damaged .* lost", warning)
    assert re.search(rf"recovered are {len(recovered)} messages covering [0-9.]+ s$", warning)


def write_compressed(path, streams):
    writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
    writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
    with writer:
        write_streams(writer, streams, "mcap")


def test_an_mcap_of_which_nothing_can_be_recovered_is_refused(new_bag):
    path = new_bag()
    cut_off(path, 0.05)
    with pytest.raises(InputError, match="nothing before that can be recovered") as caught:
        read(path)
    one_line(caught)


def test_a_damaged_chunk_is_left_out_and_said_so(tmp_path):
    path = tmp_path / "bag"
    write_compressed(path, LONG)
    whole = read(path)
    file = storage_file(path)
    data = bytearray(file.read_bytes())
    data[100_000:100_100] = bytes(100)  # in the second of six chunks
    file.write_bytes(data)
    with PoseBag(path) as bag:
        poses = list(bag.poses("/lidar/odom", "/camera/pose"))
        warnings = bag.warnings
    assert len(whole) * 0.5 < len(poses) < len(whole)
    found = {(pose.stream, pose.stamp_ns) for pose in poses}
    assert found < {(pose.stream, pose.stamp_ns) for pose in whole}
    assert len(found) == len(poses)
    assert re.search(r"the chunk at byte \d+ is damaged", " ".join(warnings))


def test_an_mcap_that_needs_the_library_mcap_says_so(new_bag, monkeypatch):
    path = new_bag()
    cut_off(path, 0.9)
    monkeypatch.setitem(sys.modules, "mcap", None)
    with pytest.raises(MissingDependencyError, match="needs mcap, .*: pip install mcap") as caught:
        read(path)
    one_line(caught)


@pytest.mark.parametrize("storage", STORAGES)
def test_flipped_bits_give_poses_or_one_line(new_bag, storage):
    path = new_bag(storage)
    data = storage_file(path).read_bytes()
    random = np.random.default_rng(3)
    refused = []
    for flips in [1, 10, 100] * 8:
        damaged = bytearray(data)
        for position in random.integers(0, len(data), flips):
            damaged[position] ^= 1 << int(random.integers(8))
        storage_file(path).write_bytes(damaged)
        try:
            read(path)
        except InputError as error:
            refused.append(str(error))
    assert refused
    assert not [message for message in refused if "\n" in message]


def test_paths_that_are_no_bag(tmp_path, new_bag):
    with pytest.raises(InputError, match=r"no bag at .*absent"):
        PoseBag(tmp_path / "absent")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(InputError, match=r"notes\.txt is not a bag; expected"):
        PoseBag(tmp_path / "notes.txt")
    for suffix in ("bag", "mcap", "db3"):
        path = tmp_path / f"empty.{suffix}"
        path.touch()
        with pytest.raises(InputError, match=f"empty.{suffix} is an empty file"):
            PoseBag(path)
        path = tmp_path / f"text.{suffix}"
        path.write_text("this is not a bag\n" * 100)
        with pytest.raises(
            InputError, match=f"text.{suffix}: it is cut off, damaged or of an unsupported kind"
        ) as caught:
            PoseBag(path)
        one_line(caught)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_directory_without_metadata_or_with_damaged_one_is_read_by_its_files(
    tmp_path, new_bag, storage
):
    path = new_bag(storage)
    whole = read(path)
    for text in (
        "",
        "nothing: here",
        "[",
        "{}",
        "rosbag2_bagfile_information: {relative_file_paths: 3}",
    ):
        (path / "metadata.yaml").write_text(text)
        with PoseBag(path) as bag:
            assert list(bag.poses("/lidar/odom", "/camera/pose")) == whole
            (warning,) = bag.warnings
        assert "metadata.yaml is damaged" in warning
    (path / "metadata.yaml").unlink()
    with PoseBag(path) as bag:
        assert list(bag.poses("/lidar/odom", "/camera/pose")) == whole
        assert bag.warnings == []
    (tmp_path / "folder").mkdir()
    with pytest.raises(
        InputError,
        match=r"no bag in .*folder: expected metadata\.yaml or files that end in .*check the path",
    ):
        PoseBag(tmp_path / "folder")


def test_a_file_that_metadata_names_and_that_is_missing_is_named(new_bag):
    path = new_bag()
    metadata = yaml.safe_load((path / "metadata.yaml").read_text())
    metadata["rosbag2_bagfile_information"]["relative_file_paths"].append("bag_1.mcap")
    (path / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    with PoseBag(path) as bag:
        assert bag.warnings == [
            f"{path}: bag_1.mcap of 2 files in metadata.yaml is missing; its messages are left out"
        ]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_qos_that_differs_between_metadata_and_storage_hides_no_message(new_bag, storage):
    path = new_bag(storage)
    before = read(path)
    metadata = yaml.safe_load((path / "metadata.yaml").read_text())
    qos = {
        "history": "keep_last",
        "depth": 5,
        "reliability": "reliable",
        "durability": "volatile",
        "liveliness": "automatic",
        "deadline": {"sec": 0, "nsec": 0},
        "lifespan": {"sec": 0, "nsec": 0},
        "liveliness_lease_duration": {"sec": 0, "nsec": 0},
        "avoid_ros_namespace_conventions": False,
    }
    for topic in metadata["rosbag2_bagfile_information"]["topics_with_message_count"]:
        topic["topic_metadata"]["offered_qos_profiles"] = [qos]
    (path / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    assert read(path) == before


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "unpack_from requires a buffer|expected plain CDR"),
        (b"\x00\x01\x00\x00" + b"\x01" * 11, "requires a buffer"),
        (b"\x00\x07\x00\x00" + b"\x00" * 100, "expected plain CDR, found encoding 0x0007"),
    ],
)
def test_a_message_that_is_too_short_or_strangely_encoded_is_named(tmp_path, data, reason):
    with rosbag2.Writer(tmp_path / "bag", version=9) as writer:
        write_streams(writer, {"/camera/pose": (CHILD, POSE_STAMPED)}, "sqlite3")
        connection = writer.add_connection("/lidar/odom", ODOMETRY, typestore=JAZZY)
        writer.write(connection, 1, data)
    with pytest.raises(
        InputError,
        match=f"/lidar/odom, message 1: not a readable nav_msgs/msg/Odometry .*{reason}|{reason}",
    ):
        read(tmp_path / "bag")


def test_several_publishers_and_types_on_one_topic(tmp_path):
    """Two connections of one type are one stream; of two types, the topic is refused."""
    for name, second_type in (("one.bag", ODOMETRY), ("two.bag", "std_msgs/msg/String")):
        with rosbag1.Writer(tmp_path / name) as writer:
            write_streams(
                writer, {"/odom": (PARENT, ODOMETRY), "/pose": (CHILD, POSE_STAMPED)}, "rosbag1"
            )
            connection = writer.add_connection(
                "/odom", second_type, typestore=NOETIC, callerid="/second"
            )
            stamp_ns = int(PARENT.stamps_ns[-1]) + 1
            message = next(
                stamped_messages(NOETIC.types, trajectory(stamp_ns, count=1), ODOMETRY, True)
            )[1]
            text = NOETIC.types["std_msgs/msg/String"]("hello")
            message = message if second_type == ODOMETRY else text
            writer.write(connection, stamp_ns, NOETIC.serialize_ros1(message, second_type))
    poses = read(tmp_path / "one.bag", "/odom", "/pose")
    assert sum(pose.stream == "parent" for pose in poses) == len(PARENT) + 1
    with (
        PoseBag(tmp_path / "two.bag") as bag,
        pytest.raises(InputError, match="topic /odom of .* is of type several types"),
    ):
        bag.select_topics("/odom", "/pose")


def test_writing_refuses_what_it_cannot_do(tmp_path, new_bag):
    path = new_bag()
    with pytest.raises(InputError, match="exists already"):
        write_bag(path, STREAMS)
    with pytest.raises(InputError, match=r"must be named \.bag"):
        write_bag(tmp_path / "new", STREAMS, "rosbag1")
    with pytest.raises(InputError, match=r"must be named \.bag"):
        write_bag(tmp_path / "new.bag", STREAMS, "mcap")
    with pytest.raises(
        ConfigError, match="unknown bag storage 'zip'; known are mcap, sqlite3, rosbag1"
    ):
        write_bag(tmp_path / "new", STREAMS, "zip")
    with pytest.raises(ConfigError, match="cannot write messages of type 'std_msgs/msg/String'"):
        write_bag(tmp_path / "new", {"/a": (PARENT, "std_msgs/msg/String")})
    with pytest.raises(InputError, match="cannot write bag"):
        write_bag(storage_file(path) / "new", STREAMS)
    assert not (tmp_path / "new").exists()
    assert not (tmp_path / "new.bag").exists()


def test_bags_of_other_programs_read_or_are_refused_in_one_line():
    """Recordings of rosbag, rosbag2 and others: split, converted, compressed, unsorted, empty, of
    wrong formats.
    """
    folder = data_folder() / "bags"
    paths = [
        path
        for path in folder.rglob("*")
        if path.suffix in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").exists()
    ]
    assert paths
    refused = {}
    for path in paths:
        try:
            with PoseBag(path) as bag:
                topics = bag.topics()
                assert len(list(bag._messages([topic.name for topic in topics]))) == sum(
                    topic.count for topic in topics
                )
        except InputError as error:
            refused[path.name] = str(error)
    assert refused.keys() == {"empty-file.bag", "wrong_rmw_test", "wrong_rmw_test_0.mcap"}
    assert not [message for message in refused.values() if "\n" in message]
    with PoseBag(folder / "fuse" / "turtlebot3.bag") as bag:
        poses = list(bag.poses("/odom", "/none"))
    assert len(poses) == 2741
    assert {(pose.world_frame, pose.sensor_frame) for pose in poses} == {("odom", "base_footprint")}
    np.testing.assert_allclose(
        np.linalg.norm([pose.quat_xyzw for pose in poses], axis=1), 1.0, atol=1e-6
    )
