"""Bags: all storages give the same poses, and a bag that cannot be read says so in one line."""

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from published_data import data_folder
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io import bags
from hand_eye_calib.io.bags import PoseBag, write_bag

ODOMETRY, POSE_STAMPED = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
STORAGES = ("mcap", "sqlite3", "rosbag1")
JAZZY, NOETIC = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)


def trajectory(first_ns, count=40, seed=1, **frames):
    stamps_ns = first_ns + 100_000_007 * np.arange(count)
    return Trajectory(stamps_ns, se3.exp(np.random.default_rng(seed).normal(size=(count, 6))), **frames)


PARENT = trajectory(1317375625661736123, sensor_frame="lidar", world_frame="map")
CHILD = trajectory(1317375625661736130, count=30, seed=2, sensor_frame="camera_left", world_frame="odom_camera")
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
    return path if path.is_file() else next(part for part in path.iterdir() if part.suffix in (".mcap", ".db3"))


def read(path, parent="/lidar/odom", child="/camera/pose"):
    with PoseBag(path) as bag:
        return list(bag.poses(parent, child))


@pytest.mark.parametrize("storage", STORAGES)
def test_poses_come_back_in_the_order_of_time_with_exact_stamps_and_frames(new_bag, storage):
    poses = read(new_bag(storage))
    assert [pose.stamp_ns for pose in poses] == sorted([*PARENT.stamps_ns, *CHILD.stamps_ns])
    for stream, source, world, sensor in (("parent", PARENT, "map", "lidar"), ("child", CHILD, "odom_camera", None)):
        found = [pose for pose in poses if pose.stream == stream]
        assert [pose.stamp_ns for pose in found] == source.stamps_ns.tolist()
        assert [pose.number for pose in found] == list(range(1, len(source) + 1))
        assert {(pose.world_frame, pose.sensor_frame) for pose in found} == {(world, sensor)}
        np.testing.assert_array_equal([pose.position for pose in found], source.poses[:, :3, 3])
        np.testing.assert_array_equal([pose.quat_xyzw for pose in found], se3.to_quat_xyzw(source.poses))


def test_storage_files_read_alone(new_bag):
    for storage in ("mcap", "sqlite3"):
        path = new_bag(storage, name=storage)
        assert read(storage_file(path)) == read(path)


@given(
    world=st.text(max_size=9),
    sensor=st.text(max_size=9),
    stamp_ns=st.integers(0, 2**31 * 10**9 - 1),
    numbers=st.lists(st.floats(width=64), min_size=7, max_size=7),
    message_type=st.sampled_from([ODOMETRY, POSE_STAMPED]),
)
def test_unpacking_agrees_with_whole_messages(world, sensor, stamp_ns, numbers, message_type):
    """Any length of the frames' names moves what follows: alignment is where a reader goes wrong."""
    world, sensor = (text.replace("\0", "") for text in (world, sensor))
    has_sensor_frame = message_type == ODOMETRY
    expected = (stamp_ns, world, sensor if has_sensor_frame else None, *numbers)
    for typestore, extra in ((JAZZY, {}), (NOETIC, {"seq": 7})):
        types = typestore.types
        header = types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9)), frame_id=world, **extra
        )
        pose = types["geometry_msgs/msg/Pose"](
            types["geometry_msgs/msg/Point"](*numbers[:3]), types["geometry_msgs/msg/Quaternion"](*numbers[3:])
        )
        zero, covariance = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0), np.ones(36)
        if has_sensor_frame:
            twist = types["geometry_msgs/msg/TwistWithCovariance"](types["geometry_msgs/msg/Twist"](zero, zero), covariance)
            pose = types["geometry_msgs/msg/PoseWithCovariance"](pose, covariance)
            message = types[message_type](header, sensor, pose, twist)
        else:
            message = types[message_type](header, pose)
        if extra:
            unpacked = [bags._unpack_ros1(typestore.serialize_ros1(message, message_type), has_sensor_frame)]
        else:
            unpacked = [
                bags._unpack_cdr(typestore.serialize_cdr(message, message_type, little_endian=little), has_sensor_frame)
                for little in (True, False)
            ]
        for stamp, *frames, position, quat_xyzw in unpacked:
            np.testing.assert_array_equal([*position, *quat_xyzw], numbers)
            assert (stamp, *frames) == expected[:3]


def test_topics_lists_everything_in_the_bag(new_bag):
    with PoseBag(new_bag()) as bag:
        assert bag.topics() == [("/camera/pose", POSE_STAMPED, 30), ("/lidar/odom", ODOMETRY, 40)]
        assert str(bag.topics()[0]) == "/camera/pose (geometry_msgs/msg/PoseStamped, 30 messages)"


def add_text_topic(path):
    """A rosbag2 with poses and a topic of strings."""
    with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        bags._write_streams(writer, STREAMS, "mcap")
        connection = writer.add_connection("/log", "std_msgs/msg/String", typestore=JAZZY)
        text = JAZZY.types["std_msgs/msg/String"]("hello")
        writer.write(connection, int(PARENT.stamps_ns[3]), JAZZY.serialize_cdr(text, "std_msgs/msg/String"))
    return path


def test_other_topics_do_not_get_in_the_way(tmp_path, new_bag):
    path = add_text_topic(tmp_path / "with_text")
    assert read(path) == read(new_bag())
    with PoseBag(path) as bag:
        assert bag.select_topics() == ("/camera/pose", "/lidar/odom")


@pytest.mark.parametrize(
    ("named", "selected"),
    [
        (("/lidar/odom", "/camera/pose"), ("/lidar/odom", "/camera/pose")),
        (("/lidar/odom", None), ("/lidar/odom", "/camera/pose")),
        ((None, "/lidar/odom"), ("/camera/pose", "/lidar/odom")),
        ((None, None), ("/camera/pose", "/lidar/odom")),
    ],
)
def test_two_pose_topics_leave_no_choice(new_bag, named, selected):
    with PoseBag(new_bag()) as bag:
        assert bag.select_topics(*named) == selected


@pytest.mark.parametrize(
    ("named", "message"),
    [
        (("/odom", "/camera/pose"), "no topic /odom in "),
        (("/lidar/odom", "/log"), r"topic /log of .* is of type std_msgs/msg/String; accepted are nav_msgs/msg/Odometry, "),
        (("/lidar/odom", "/lidar/odom"), "parent and child topic are both /lidar/odom"),
    ],
)
def test_a_wrong_topic_is_answered_with_those_that_are_there(tmp_path, named, message):
    with PoseBag(add_text_topic(tmp_path / "bag")) as bag, pytest.raises(InputError, match=message) as caught:
        bag.select_topics(*named)
    listing = (
        "The bag has /camera/pose (geometry_msgs/msg/PoseStamped, 30 messages), /lidar/odom (nav_msgs/msg/Odometry, 40 messages), "
        "/log (std_msgs/msg/String, 1 messages)"
    )
    assert listing in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_without_names_there_must_be_exactly_two_pose_topics(new_bag, count):
    path = new_bag(streams={f"/odom_{number}": (PARENT, ODOMETRY) for number in range(count)})
    with (
        PoseBag(path) as bag,
        pytest.raises(InputError, match="name the topics of poses with --parent-topic and --child-topic"),
    ):
        bag.select_topics()


def one_line(error):
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("share", [0.01, 0.5, 0.9])
def test_a_bag_cut_off_is_refused(new_bag, storage, share):
    path = new_bag(storage)
    data = storage_file(path).read_bytes()
    storage_file(path).write_bytes(data[: int(len(data) * share)])
    with pytest.raises(InputError, match="it is cut off, damaged or of an unsupported kind") as caught:
        read(path)
    assert str(path) in one_line(caught)


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
        with pytest.raises(InputError, match=f"text.{suffix}: it is cut off, damaged or of an unsupported kind") as caught:
            PoseBag(path)
        one_line(caught)


def test_a_directory_without_metadata_names_its_files(tmp_path, new_bag):
    path = new_bag("mcap")
    (path / "metadata.yaml").unlink()
    with pytest.raises(InputError, match=rf"no metadata.yaml in .*ros2 bag reindex .* alone: {storage_file(path).name}"):
        PoseBag(path)
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=r"no metadata\.yaml in .*folder.*check the path"):
        PoseBag(tmp_path / "folder")


@pytest.mark.parametrize("text", ["", "nothing: here", "rosbag2_bagfile_information: {version: 99}", "[", "{}"])
def test_damaged_metadata_is_refused(new_bag, text):
    path = new_bag()
    (path / "metadata.yaml").write_text(text)
    with pytest.raises(InputError, match="cannot read bag"):
        PoseBag(path)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_qos_that_differs_between_metadata_and_storage_hides_no_message(new_bag, storage):
    path = new_bag(storage)
    before = read(path)
    metadata = yaml.safe_load((path / "metadata.yaml").read_text())
    qos = {
        "history": "keep_last", "depth": 5, "reliability": "reliable", "durability": "volatile", "liveliness": "automatic",
        "deadline": {"sec": 0, "nsec": 0}, "lifespan": {"sec": 0, "nsec": 0}, "liveliness_lease_duration": {"sec": 0, "nsec": 0},
        "avoid_ros_namespace_conventions": False,
    }  # fmt: skip
    for topic in metadata["rosbag2_bagfile_information"]["topics_with_message_count"]:
        topic["topic_metadata"]["offered_qos_profiles"] = [qos]
    (path / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    assert read(path) == before


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "not a readable"),
        (b"\x00\x01\x00\x00" + b"\x01" * 11, "requires a buffer"),
        (b"\x00\x07\x00\x00" + b"\x00" * 100, "expected plain CDR, found encoding 0x0007"),
    ],
)
def test_a_message_that_is_too_short_or_strangely_encoded_is_named(tmp_path, data, reason):
    with rosbag2.Writer(tmp_path / "bag", version=9) as writer:
        bags._write_streams(writer, {"/camera/pose": (CHILD, POSE_STAMPED)}, "sqlite3")
        connection = writer.add_connection("/lidar/odom", ODOMETRY, typestore=JAZZY)
        writer.write(connection, 1, data)
    with pytest.raises(InputError, match=f"/lidar/odom, message 1: not a readable nav_msgs/msg/Odometry .*{reason}|{reason}"):
        read(tmp_path / "bag")


def test_several_publishers_and_types_on_one_topic(tmp_path):
    """Two connections of one type are one stream; of two types, the topic is refused."""
    for name, second_type in (("one.bag", ODOMETRY), ("two.bag", "std_msgs/msg/String")):
        with rosbag1.Writer(tmp_path / name) as writer:
            bags._write_streams(writer, {"/odom": (PARENT, ODOMETRY), "/pose": (CHILD, POSE_STAMPED)}, "rosbag1")
            connection = writer.add_connection("/odom", second_type, typestore=NOETIC, callerid="/second")
            stamp_ns = int(PARENT.stamps_ns[-1]) + 1
            message = next(bags._stamped_messages(NOETIC, trajectory(stamp_ns, count=1), ODOMETRY, True, connection))[2]
            text = NOETIC.types["std_msgs/msg/String"]("hello")
            message = message if second_type == ODOMETRY else text
            writer.write(connection, stamp_ns, NOETIC.serialize_ros1(message, second_type))
    poses = read(tmp_path / "one.bag", "/odom", "/pose")
    assert sum(pose.stream == "parent" for pose in poses) == len(PARENT) + 1
    with PoseBag(tmp_path / "two.bag") as bag, pytest.raises(InputError, match="topic /odom of .* is of type several types"):
        bag.select_topics("/odom", "/pose")


def test_writing_refuses_what_it_cannot_do(tmp_path, new_bag):
    path = new_bag()
    with pytest.raises(InputError, match="exists already"):
        write_bag(path, STREAMS)
    with pytest.raises(InputError, match=r"must be named \.bag"):
        write_bag(tmp_path / "new", STREAMS, "rosbag1")
    with pytest.raises(InputError, match=r"must be named \.bag"):
        write_bag(tmp_path / "new.bag", STREAMS, "mcap")
    with pytest.raises(ConfigError, match="unknown bag storage 'zip'; known are mcap, sqlite3, rosbag1"):
        write_bag(tmp_path / "new", STREAMS, "zip")
    with pytest.raises(ConfigError, match="cannot write messages of type 'std_msgs/msg/String'"):
        write_bag(tmp_path / "new", {"/a": (PARENT, "std_msgs/msg/String")})
    with pytest.raises(InputError, match="cannot write bag"):
        write_bag(storage_file(path) / "new", STREAMS)
    assert not (tmp_path / "new").exists()
    assert not (tmp_path / "new.bag").exists()


def test_bags_of_other_programs_read_or_are_refused_in_one_line():
    """Recordings of rosbag, rosbag2 and others: split, converted, compressed, unsorted, empty, of wrong formats."""
    folder = data_folder() / "bags"
    paths = [
        path for path in folder.rglob("*") if path.suffix in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").exists()
    ]
    assert paths
    refused = {}
    for path in paths:
        try:
            with PoseBag(path) as bag:
                topics = bag.topics()
                assert sum(1 for _ in bag._messages([topic.name for topic in topics])) == sum(topic.count for topic in topics)
        except InputError as error:
            refused[path.name] = str(error)
    assert refused.keys() == {"empty-file.bag", "wrong_rmw_test"}
    assert not [message for message in refused.values() if "\n" in message]
    with PoseBag(folder / "fuse" / "turtlebot3.bag") as bag:
        poses = list(bag.poses("/odom", "/none"))
    assert len(poses) == 2741
    assert {(pose.world_frame, pose.sensor_frame) for pose in poses} == {("odom", "base_footprint")}
    np.testing.assert_allclose(np.linalg.norm([pose.quat_xyzw for pose in poses], axis=1), 1.0, atol=1e-6)
