"""Bags that claim more than they hold, or hold what no recorder writes: a bounded memory, and poses
or one line.
"""

import os
import sqlite3
import subprocess
import sys

import numpy as np
import pytest
from backports import zstd
from bag_making import JAZZY
from motions import as_trajectory, child_of, wandering_poses
from rosbags import rosbag1, rosbag2

from hand_eye_calib.errors import InputError
from hand_eye_calib.io.bags import PoseBag, storage, write_bag
from hand_eye_calib.io.bags.writer import write_streams

MIB = 1 << 20
# What a command may take: LARGEST_GROWTH, the interpreter and its libraries.
MOST_MIB = 1000
ODOMETRY = "nav_msgs/msg/Odometry"
POSES = wandering_poses(40)
STREAMS = {
    "/a": (as_trajectory(POSES, sensor_frame="lidar", world_frame="map"), ODOMETRY),
    "/b": (as_trajectory(child_of(POSES), sensor_frame="camera", world_frame="odom"), ODOMETRY),
}
# Three gigabytes of zeros, in frames.
BOMB = zstd.compress(bytes(64 * MIB)) * 48

# Not ru_maxrss, which a process has from the one that started it.
REPLAY = """
import pathlib, re, sys
from hand_eye_calib.cli.main import main
code = main(["replay", sys.argv[1], "--parent-topic", "/a", "--child-topic", "/b"])
peak = re.search(r"VmHWM:\\s+(\\d+) kB", pathlib.Path("/proc/self/status").read_text())
print(code, int(peak[1]) // 1024)
"""


def with_message(path, kind, data):
    """A bag of poses with one more message on /a."""
    plugin = rosbag2.StoragePlugin[kind.upper()]
    with rosbag2.Writer(path, version=9, storage_plugin=plugin) as writer:
        write_streams(writer, STREAMS, kind)
        connection = writer.add_connection("/c", ODOMETRY, typestore=JAZZY)
        for topic in writer.connections:
            if topic.topic == "/a":
                connection = topic
        writer.write(connection, int(STREAMS["/a"][0].stamps_ns[-1]) + 1, data)
    return path


def mcap_bomb(path):
    return with_message(path / "bag", "mcap", BOMB)


def sqlite3_bomb(path):
    return with_message(path / "bag", "sqlite3", BOMB)


def rosbag1_bomb(path):
    """A chunk of 700 MiB of zeros."""
    path = path / "bag.bag"
    writer = rosbag1.Writer(path)
    writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
    with writer:
        write_streams(writer, STREAMS, "rosbag1")
        connection = next(each for each in writer.connections if each.topic == "/a")
        last_ns = int(STREAMS["/a"][0].stamps_ns[-1])
        writer.write(connection, last_ns + 1, memoryview(np.zeros(700 * MIB, dtype=np.uint8)))
    return path


@pytest.mark.parametrize("make", [mcap_bomb, sqlite3_bomb, rosbag1_bomb])
def test_a_command_ends_in_one_line_and_within_its_memory(tmp_path, make):
    path = make(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", REPLAY, str(path)], capture_output=True, text=True, check=True
    )
    code, mib = map(int, done.stdout.split())
    errors = [line for line in done.stderr.splitlines() if ": error: " in line]
    assert (code, len(errors)) == (1, 1), done.stderr
    assert "takes more memory than any bag should" in errors[0]
    assert mib < MOST_MIB
    assert "Traceback" not in done.stderr


def test_a_compressed_file_unpacks_to_a_multiple_of_its_size(tmp_path):
    path = tmp_path / "bag.mcap.zstd"
    path.write_bytes(zstd.compress(bytes(300 * MIB)))
    with pytest.raises(InputError, match="unpacks to more than 256 times .* not believable"):
        PoseBag(path)


# ---- SQLite


def database(path, rows):
    connection = sqlite3.connect(path)
    connection.executescript(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT,"
        " serialization_format TEXT, offered_qos_profiles TEXT);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
        " data BLOB);"
    )
    connection.execute("INSERT INTO topics VALUES(1, '/a', ?, 'cdr', '')", (ODOMETRY,))
    connection.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)", rows)
    connection.commit()
    connection.close()
    return path


@pytest.fixture(scope="module")
def odometry(tmp_path_factory):
    """Bytes of a message."""
    path = tmp_path_factory.mktemp("one") / "bag"
    write_bag(path, STREAMS)
    with PoseBag(path) as bag:
        return next(data for _, _, data in bag._messages(["/a"]))


@pytest.mark.parametrize(
    "bad", [(5, "text"), (5, 7), (5, None), ("five", b""), (1e300, b""), (-5, b""), (None, b"")]
)
def test_values_of_other_types_are_left_out_or_refused(tmp_path, odometry, bad):
    path = database(tmp_path / "bag.db3", [(1, odometry), bad, (9, odometry)])
    found, said = poses_or_error(path)
    assert found in ([1, 9], None)
    assert "not bytes with a time were left out" in said or found is None
    assert "\n" not in said


def poses_or_error(path):
    """Bag times of the poses that are read, None if they are refused, and what is said."""
    try:
        with PoseBag(path) as bag:
            return [pose.bag_ns for pose in bag.poses("/a", None)], " ".join(bag.warnings)
    except InputError as error:
        return None, str(error)


def test_messages_without_an_index_of_times_are_read_in_order(tmp_path, odometry):
    path = database(tmp_path / "bag.db3", [(stamp, odometry) for stamp in (7, 3, 5)])
    with PoseBag(path) as bag:
        assert [pose.bag_ns for pose in bag.poses("/a", None)] == [3, 5, 7]


def test_rows_that_are_computed_are_refused(tmp_path):
    path = database(tmp_path / "bag.db3", [])
    connection = sqlite3.connect(path)
    connection.executescript(
        "DROP TABLE messages; CREATE VIEW messages AS WITH RECURSIVE n(k) AS (SELECT 1 UNION"
        " ALL SELECT k + 1 FROM n) SELECT 1 AS topic_id, k AS timestamp, zeroblob(1000) AS data"
        " FROM n;"
    )
    connection.close()
    with pytest.raises(InputError, match="it has no tables 'topics' and 'messages'"):
        PoseBag(path)


@pytest.mark.parametrize("name", ["run#1.db3", "run%41.db3", "what?.db3", "a?mode=rw&b.db3"])
def test_a_path_is_not_read_as_an_address(tmp_path, name):
    write_bag(tmp_path / "bag", STREAMS, "sqlite3")
    (tmp_path / "bag" / "bag.db3").rename(tmp_path / name)
    with PoseBag(tmp_path / name) as bag:
        assert sum(map(len, bag.blocks("/a", "/b"))) == 80


# ---- folders


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
    os.mkfifo(tmp_path / "bag.mcap")
    with pytest.raises(InputError, match="is not a regular file"):
        PoseBag(tmp_path / "bag.mcap")


def test_a_rosbag2_of_more_files_than_are_read_is_refused(tmp_path, monkeypatch):
    write_bag(tmp_path / "bag", STREAMS, "mcap")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    data = (tmp_path / "bag" / "bag.mcap").read_bytes()
    for number in range(4):
        (tmp_path / "bag" / f"bag_{number}.mcap").write_bytes(data)
    monkeypatch.setattr(storage, "MOST_BAG_FILES", 4)
    with pytest.raises(InputError, match="has more than 4 files; read it in parts"):
        PoseBag(tmp_path / "bag")
