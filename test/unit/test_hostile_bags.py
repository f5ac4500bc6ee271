"""Bags that claim more than they hold, or hold what no recorder writes: a bounded reading, poses or
one line.
"""

import resource
import sqlite3
import subprocess
import sys
from pathlib import Path

import mcap_making as making
import pytest
from backports import zstd
from bag_making import JAZZY, NOETIC
from motions import as_trajectory, child_of, wandering_poses

from hand_eye_calib.errors import InputError
from hand_eye_calib.io.bags import PoseBag, write_bag

MIB = 1 << 20
# 64 MB plus four times the largest message that is read; and what Python takes to import a module.
LARGEST_GROWTH_MB = 64 + 4 * 32 + 8

ODOMETRY, POSE_STAMPED = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
POSES = wandering_poses(40)
STREAMS = {
    "/a": (as_trajectory(POSES, sensor_frame="lidar", world_frame="map"), ODOMETRY),
    "/b": (as_trajectory(child_of(POSES), sensor_frame="camera", world_frame="odom"), ODOMETRY),
}
HEAD = making.schema() + making.channel()

READ = """
import resource, sys
from hand_eye_calib.errors import InputError
from hand_eye_calib.io.bags import PoseBag
import backports.zstd, bz2, lz4.frame, sqlite3
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
before = peak()
try:
    with PoseBag(sys.argv[1]) as bag:
        print(sum(map(len, bag.blocks("/a", "/b"))), "poses;", *bag.warnings)
except InputError as error:
    print(error)
print(peak() - before)
"""


def odometry(typestore=JAZZY):
    from bag_making import header, pose

    types = typestore.types
    zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    covariance = __import__("numpy").zeros(36)
    message = types[ODOMETRY](
        header(typestore, 5_000_000_000, "map"),
        "lidar",
        types["geometry_msgs/msg/PoseWithCovariance"](pose(typestore, POSES[0]), covariance),
        types["geometry_msgs/msg/TwistWithCovariance"](
            types["geometry_msgs/msg/Twist"](zero, zero), covariance
        ),
    )
    if typestore is NOETIC:
        return bytes(NOETIC.serialize_ros1(message, ODOMETRY))
    return bytes(JAZZY.serialize_cdr(message, ODOMETRY))


def indexed(records, summary_records, counts):
    """A whole file with an index."""
    return making.whole(records, HEAD + summary_records + making.statistics(counts))


def chunk_of_zeros():
    """A chunk of 300 MiB of zeros, which are records of 9 bytes."""
    return making.whole(HEAD + making.chunk(bytes(300 * MIB)))


def chunk_of_empty_messages():
    return making.whole(HEAD + making.chunk(making.message(b"") * (60 * MIB // 31)))


def chunk_with_one_large_message():
    return making.whole(HEAD + making.chunk(making.message(bytes(300 * MIB))))


def chunk_that_understates_its_size():
    return making.whole(HEAD + making.chunk(bytes(300 * MIB), size=1000))


def many_large_chunks():
    chunk = making.chunk(making.message(odometry()) * (60 * MIB // 760))
    return making.whole(HEAD + chunk * 100)


def messages_compressed_one_by_one():
    return making.whole(HEAD + making.message(zstd.compress(bytes(300 * MIB))) * 5)


def many_messages_compressed_one_by_one():
    data = zstd.compress(odometry() + bytes(30 * MIB))
    return making.whole(HEAD + b"".join(making.message(data, k) for k in range(100)))


def index_that_names_one_message_often():
    message = making.message(odometry() + bytes(MIB))
    other = making.channel(2, "/image")
    chunk = making.chunk(message, compression="")
    offset = making.offset_of(HEAD + other)
    index = making.message_index(1, [(1, 0)] * 4000)
    described = making.chunk_index(offset, len(chunk), {1: offset + len(chunk), 2: 0})
    return indexed(HEAD + other + chunk + index, other + described, {1: 4000})


def index_that_names_one_chunk_often():
    chunk = making.chunk(making.message(odometry()) * 80_000)
    described = making.chunk_index(making.offset_of(HEAD), len(chunk))
    return indexed(HEAD + chunk, described * 1000, {1: 80_000_000})


def chunks_that_overlap():
    """Every chunk begins before all messages, so that all of them would have to wait."""
    records, described = HEAD, b""
    for k in range(40):
        messages = [making.message(odometry() + bytes(1000), 10**6 + k + j) for j in range(500)]
        chunk = making.chunk(b"".join(messages), start_ns=k)
        described += making.chunk_index(making.offset_of(records), len(chunk), start_ns=k)
        records += chunk
    return indexed(records, described, {1: 20_000})


def summary_without_end():
    chunk = making.chunk(making.message(odometry()))
    many = making.chunk_index(making.offset_of(HEAD), len(chunk)) * 300_000
    return indexed(HEAD + chunk, many, {1: 300_000})


def rosbag1_chunk_of_zeros():
    return making.rosbag1([making.bz2_chunk(bytes(300 * MIB))], 1)


def rosbag1_index_that_names_one_chunk_often():
    content = making.message1(odometry(NOETIC)) * 20_000
    return making.rosbag1([making.bz2_chunk(content)], 20_000, repeats=1000)


def rosbag1_chunk_of_empty_messages():
    return making.rosbag1([making.bz2_chunk(making.message1(b"") * 300_000)], 1)


FILES = {
    "mcap": [
        chunk_of_zeros,
        chunk_of_empty_messages,
        chunk_with_one_large_message,
        chunk_that_understates_its_size,
        many_large_chunks,
        messages_compressed_one_by_one,
        many_messages_compressed_one_by_one,
        index_that_names_one_message_often,
        index_that_names_one_chunk_often,
        chunks_that_overlap,
        summary_without_end,
    ],
    "bag": [
        rosbag1_chunk_of_zeros,
        rosbag1_index_that_names_one_chunk_often,
        rosbag1_chunk_of_empty_messages,
    ],
}


def limited():
    """Processor time and memory of a process that reads."""
    resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
    resource.setrlimit(resource.RLIMIT_AS, (6 << 30, 6 << 30))


def read_apart(path):
    """What a process says that reads a bag, and by how many MB it grew."""
    done = subprocess.run(
        [sys.executable, "-c", READ, str(path)],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=limited,
    )
    assert done.returncode == 0, (done.returncode, done.stdout[-300:], done.stderr[-600:])
    said, growth = done.stdout.splitlines()
    return said, float(growth)


@pytest.mark.parametrize(
    ("suffix", "make"), [(suffix, make) for suffix, makers in FILES.items() for make in makers]
)
def test_memory_is_bounded_whatever_a_bag_claims(tmp_path, suffix, make):
    path = tmp_path / f"bag.{suffix}"
    path.write_bytes(make())
    said, growth = read_apart(path)
    assert growth < LARGEST_GROWTH_MB, said


def test_a_compressed_file_unpacks_to_a_multiple_of_its_size(tmp_path):
    path = tmp_path / "bag.mcap.zstd"
    path.write_bytes(zstd.compress(making.MAGIC + bytes(300 * MIB)))
    with pytest.raises(InputError, match="its content unpacks to more than .* not believable"):
        PoseBag(path)


def test_messages_of_a_database_are_bounded(tmp_path):
    path = database(tmp_path / "bag.db3", [(zstd.compress(bytes(300 * MIB)), 1)] * 3)
    said, growth = read_apart(path)
    assert growth < LARGEST_GROWTH_MB
    assert "unpacks to more than" in said


# ---- values of SQLite


def database(path, rows, columns="id INTEGER PRIMARY KEY, topic_id INTEGER"):
    connection = sqlite3.connect(path)
    connection.executescript(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT,"
        " serialization_format TEXT, offered_qos_profiles TEXT);"
        f"CREATE TABLE messages({columns}, timestamp INTEGER, data BLOB);"
    )
    for key, topic in enumerate(("/a", "/b"), start=1):
        connection.execute("INSERT INTO topics VALUES(?, ?, ?, 'cdr', '')", (key, topic, ODOMETRY))
    connection.executemany(
        "INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)",
        [(stamp, data) for data, stamp in rows],
    )
    connection.commit()
    connection.close()
    return path


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([("text", 5)], "a message of /a is str, expected bytes"),
        ([(7, 5)], "a message of /a is int, expected bytes"),
        ([(None, 5)], "a message of /a is NoneType, expected bytes"),
        ([(b"", "five")], "a message has no time that is a positive integer"),
        ([(b"", 1e300)], "a message has no time that is a positive integer"),
        ([(b"", None)], "a message has no time that is a positive integer"),
        ([(b"", -5)], "a message has no time that is a positive integer"),
        ([(odometry(), 1), (odometry(), "five"), (odometry(), 9)], "a positive integer"),
    ],
)
def test_values_of_other_types_are_named(tmp_path, rows, message):
    path = database(tmp_path / "bag.db3", rows)
    with pytest.raises(InputError, match=message), PoseBag(path) as bag:
        list(bag.blocks("/a", "/b"))


def test_messages_without_an_index_of_times_are_read_in_order(tmp_path):
    path = database(tmp_path / "bag.db3", [(odometry(), stamp) for stamp in (7, 3, 5)])
    with PoseBag(path) as bag:
        assert [pose.bag_ns for pose in bag.poses("/a", "/b")] == [3, 5, 7]


@pytest.mark.parametrize(
    ("after", "columns", "message"),
    [
        (
            "DROP TABLE messages; CREATE VIEW messages AS WITH RECURSIVE n(k) AS (SELECT 1 UNION"
            " ALL SELECT k + 1 FROM n) SELECT 1 AS topic_id, k AS timestamp, zeroblob(1000) AS data"
            " FROM n;",
            "id INTEGER PRIMARY KEY, topic_id INTEGER",
            "it has no table 'messages'",
        ),
        (
            "",
            "topic_id INTEGER, more BLOB AS (zeroblob(1000000000))",
            "its table 'messages' has computed columns",
        ),
    ],
)
def test_rows_that_are_computed_are_refused(tmp_path, after, columns, message):
    path = database(tmp_path / "bag.db3", [], columns)
    connection = sqlite3.connect(path)
    connection.executescript(after)
    connection.close()
    with pytest.raises(InputError, match=message):
        PoseBag(path)


@pytest.mark.parametrize(
    "name", ["run#1.db3", "run%41.db3", "what?.db3", "a?mode=rw&b.db3", "ü ñ.db3"]
)
def test_a_path_is_not_read_as_an_address(tmp_path, name):
    write_bag(tmp_path / "bag", STREAMS, "sqlite3")
    (tmp_path / "bag" / "bag.db3").rename(tmp_path / name)
    with PoseBag(tmp_path / name) as bag:
        assert sum(map(len, bag.blocks("/a", "/b"))) == 80


def test_a_percent_sign_does_not_lead_to_another_file(tmp_path):
    """``run%31.db3`` is not ``run1.db3``."""
    write_bag(tmp_path / "bag", STREAMS, "sqlite3")
    (tmp_path / "bag" / "bag.db3").rename(tmp_path / "run1.db3")
    database(tmp_path / "run%31.db3", [(odometry(), 1)])
    with PoseBag(tmp_path / "run%31.db3") as bag:
        assert [topic.count for topic in bag.topics()] == [1, 0]


# ---- values of mcap


def test_times_beyond_64_bits_are_left_out(tmp_path):
    good = making.message(odometry(), 5)
    for records in (
        good + making.message(odometry(), (1 << 64) - 1),
        making.chunk(good + making.message(odometry(), (1 << 64) - 1)),
    ):
        path = tmp_path / "bag.mcap"
        path.write_bytes(making.whole(HEAD + records))
        with PoseBag(path) as bag:
            assert [pose.bag_ns for pose in bag.poses("/a", "/b")] == [5]
            assert "/a: a message of time 18446744073709551615 ns was left out" in str(bag.warnings)


def test_an_index_with_impossible_times_is_not_used(tmp_path):
    chunk = making.chunk(making.message(odometry(), 5))
    described = making.chunk_index(making.offset_of(HEAD), len(chunk))
    summary = HEAD + described + making.statistics({1: 1}, 0, (1 << 64) - 1)
    path = tmp_path / "bag.mcap"
    path.write_bytes(making.whole(HEAD + chunk, summary))
    with PoseBag(path) as bag:
        assert (bag.start_ns, bag.end_ns) == (5, 5)
        assert sum(map(len, bag.blocks("/a", "/b"))) == 1
        assert "the index has times that cannot be right" in str(bag.warnings)


def test_images_larger_than_a_message_may_be_do_not_get_in_the_way(tmp_path):
    """Between poses there may be messages of any size, in chunks and outside."""
    image = making.message(bytes(40 * MIB), 6, key=2)
    records = HEAD + making.channel(2, "/image") + making.message(odometry(), 5) + image
    path = tmp_path / "bag.mcap"
    path.write_bytes(making.whole(records + making.message(odometry(), 7)))
    with PoseBag(path) as bag:
        assert [pose.bag_ns for pose in bag.poses("/a", "/b")] == [5, 7]
        assert bag.warnings == []


def test_a_message_that_is_too_large_is_named(tmp_path):
    path = tmp_path / "bag.mcap"
    large = making.message(odometry() + bytes(33 * MIB), 6)
    path.write_bytes(making.whole(HEAD + making.message(odometry(), 5) + large))
    with PoseBag(path) as bag:
        assert [pose.bag_ns for pose in bag.poses("/a", "/b")] == [5]
        assert "/a: a message of 34603" in str(bag.warnings)


def test_names_with_control_characters_are_escaped(tmp_path):
    head = making.schema() + making.channel(topic="/a\x1b[31m\n")
    path = tmp_path / "bag.mcap"
    path.write_bytes(
        making.whole(head + making.message(odometry().replace(b"lidar", b"li\x1b\nr"), 5))
    )
    with PoseBag(path) as bag:
        (topic,) = bag.topics()
        assert topic.name == "/a\\x1b[31m\\n"
        (pose,) = bag.poses(topic.name, None)
        assert pose.sensor_frame == "li\\x1b\\nr"


def test_a_damaged_metadata_file_leaves_the_bag_beside_it_readable(tmp_path):
    write_bag(tmp_path / "bag", STREAMS, "mcap")
    metadata = tmp_path / "bag" / "metadata.yaml"
    bomb = "\n".join(
        ["a0: &a0 {x: 1}"]
        + [f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 9)}]}}" for k in range(1, 12)]
    )
    texts = [bomb, "[" * 100_000, "a: &a {b: *a}", "x: 2024-13-45", "n: " + "9" * 5000]
    texts += ["!!float abc", "rosbag2_bagfile_information: 5", "\x00", "é: \udcff"]
    for text in texts:
        metadata.write_bytes(text.encode("utf-8", "surrogateescape"))
        with PoseBag(tmp_path / "bag") as bag:
            assert sum(map(len, bag.blocks("/a", "/b"))) == 80
            (warning,) = bag.warnings
        assert "metadata.yaml is damaged" in warning
        assert "\n" not in warning


def test_a_pipe_is_no_bag(tmp_path):
    import os

    os.mkfifo(tmp_path / "bag.mcap")
    with pytest.raises(InputError, match="is not a regular file"):
        PoseBag(tmp_path / "bag.mcap")


def test_rosbag1_files_written_by_hand_are_read(tmp_path):
    """The files above are refused for what is wrong with them, not for how they are made."""
    content = b"".join(making.message1(odometry(NOETIC), k) for k in range(5))
    path = tmp_path / "bag.bag"
    path.write_bytes(making.rosbag1([making.bz2_chunk(content)], 5))
    with PoseBag(path) as bag:
        assert [pose.bag_ns for pose in bag.poses("/a", None)] == [k * 10**9 for k in range(5)]
        assert bag.warnings == []


def test_a_rosbag2_of_more_files_than_are_read_is_refused(tmp_path, monkeypatch):
    from hand_eye_calib.io.bags import files

    write_bag(tmp_path / "bag", STREAMS, "mcap")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    data = (tmp_path / "bag" / "bag.mcap").read_bytes()
    for number in range(4):
        Path(tmp_path / "bag" / f"bag_{number}.mcap").write_bytes(data)
    monkeypatch.setattr(files, "MOST_BAG_FILES", 4)
    with pytest.raises(InputError, match="has more than 4 files; read it in parts"):
        PoseBag(tmp_path / "bag")
