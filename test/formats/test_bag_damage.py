"""Bags that are cut off, damaged or made to do harm: a right answer, a warning, or one line - never
a traceback, and never more memory than any bag should take.

What cannot be noticed is a flipped bit that moves one pose by less than noise might (some
centimetres here), in a file without checksums; robust methods then give nearly the same answer, and
how nearly is tested. Bits of what is not read (covariances, twists, other topics) do no harm.
"""

import faulthandler
import json
import os
import re
import resource
import sqlite3
import subprocess
import sys

import bag_making
import numpy as np
import pytest
from backports import zstd
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from motions import T_PARENT_CHILD, as_trajectory, child_of, wandering_poses
from numpy.testing import assert_allclose
from rosbags import rosbag1, rosbag2

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats import files
from hand_eye_calib.formats.bags import folders
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.formats.bags.writer import write_bag, write_streams
from hand_eye_calib.offline.cli.main import main

MIB = 1 << 20
# What a command may take: LARGEST, the interpreter and its libraries.
MOST_MIB = 1000
PLACES = 100
POSES = wandering_poses(60)
STREAMS = {
    "/a": (
        as_trajectory(POSES, sensor_frame="lidar", world_frame="map"),
        bag_making.ODOMETRY,
    ),
    "/b": (
        as_trajectory(
            child_of(POSES), sensor_frame="camera", world_frame="odom"
        ),
        bag_making.POSE_STAMPED,
    ),
}
TOPICS = ["--parent-topic", "/a", "--child-topic", "/b"]
# Largest error of an entry of T_parent_child that may go unnoticed.
UNNOTICED = 5e-3


@pytest.fixture(autouse=True)
def _nothing_hangs():
    """Whatever takes minutes is a hang: it ends the run with the place it hangs at."""
    faulthandler.dump_traceback_later(600, exit=True)
    yield
    faulthandler.cancel_dump_traceback_later()


@pytest.fixture(params=bag_making.STORAGES)
def bag(request, tmp_path):
    """Bytes of a bag's file, and where to put damaged ones."""
    path = bag_making.bag_path(tmp_path, request.param)
    write_bag(path, STREAMS, request.param)
    file = bag_making.storage_file(path)
    return file.read_bytes(), tmp_path / f"damaged{file.suffix}"


def read(path):
    """Poses and warnings, or None and the one line of an error."""
    try:
        with PoseBag(path) as bag:
            poses = bag_making.poses_of(bag, *bag.select())
            outcome = poses, bag.warnings
    except InputError as error:
        outcome = None, [str(error)]
    assert "\n" not in "".join(outcome[1])
    return outcome


def replay(path, capsys):
    """Exit code and JSON document or None; a code without a document has one line of an error."""
    options = [
        *TOPICS,
        "--child-frame",
        "camera",
        "--reference",
        "B5",
        "--json",
    ]
    code = main(["replay", str(path), *options])
    out, err = capsys.readouterr()
    if not out:
        assert (code, err.count(": error: ")) == (1, 1)
    return json.loads(out) if out else None


def places(size, seed):
    return np.random.default_rng(seed).integers(0, size, PLACES).tolist()


def stamped(poses):
    return [(pose.stream, pose.stamp_ns, pose.pose) for pose in poses]


def test_cut_off_anywhere(bag, capsys):
    data, path = bag
    path.write_bytes(data)
    whole, warnings = read(path)
    assert (len(whole), warnings) == (120, [])
    outcomes = set()
    for number, size in enumerate(places(len(data), seed=1)):
        path.write_bytes(data[:size])
        poses, warnings = read(path)
        assert len(warnings) == 1, size
        outcomes.add("refused" if poses is None else "recovered")
        if poses is not None:
            assert poses == whole[: len(poses)]
        document = replay(path, capsys) if number % 20 == 0 else None
        if document is not None:
            assert any("lost" in warning for warning in document["warnings"])
            if document["verdict"] != "DO_NOT_USE":
                matrix = document["T_parent_child"]["matrix"]
                assert_allclose(matrix, T_PARENT_CHILD, atol=1e-6)
    assert outcomes == (
        {"refused", "recovered"} if path.suffix == ".mcap" else {"refused"}
    )


def test_a_bit_flipped_anywhere(bag, capsys):
    data, path = bag
    path.write_bytes(data)
    whole, _ = read(path)
    matrix = replay(path, capsys)["T_parent_child"]["matrix"]
    assert_allclose(matrix, T_PARENT_CHILD, atol=1e-9)
    harmed = 0
    bits = np.random.default_rng(3).integers(0, 8, PLACES).tolist()
    for place, bit in zip(places(len(data), seed=2), bits, strict=True):
        damaged = bytearray(data)
        damaged[place] ^= 1 << bit
        path.write_bytes(damaged)
        poses, _ = read(path)
        if poses is not None and sorted(stamped(poses)) == sorted(
            stamped(whole)
        ):
            continue  # the engine gets what it got before
        harmed += 1
        document = replay(path, capsys)
        if document is not None and not document["warnings"]:
            matrix = document["T_parent_child"]["matrix"]
            assert_allclose(
                matrix, T_PARENT_CHILD, atol=UNNOTICED, err_msg=str(place)
            )
    assert harmed >= 10


# ---- files cut off, in chunks, and without an index

STAMPS_NS = 1_000 + 100_000_007 * np.arange(4000)
LONG = Trajectory(
    STAMPS_NS, se3.exp(np.random.default_rng(1).normal(size=(4000, 6)))
)
LONG = dict.fromkeys(STREAMS, (LONG, bag_making.ODOMETRY))


@pytest.mark.parametrize("kind", ["mcap", "zstd"])
def test_a_bag_cut_off_gives_what_came_before(tmp_path, kind):
    """The recorder lost power: no index, the last chunk incomplete, no metadata.yaml."""
    path = bag_making.bag_path(tmp_path, kind)
    if kind == "zstd":
        bag_making.write_compressed(path, LONG)
    else:
        write_bag(path, LONG, kind)
    whole = bag_making.all_poses(path)
    file = bag_making.storage_file(path)
    (path / "metadata.yaml").unlink()
    size = file.stat().st_size
    for share in (0.9, 0.5, 0.3, 0.04):  # the last in the first chunk
        os.truncate(file, int(size * share))
        recovered, (warning,) = read(path)
        assert max(share - 0.1, 0) < len(recovered) / len(whole) < share + 0.1
        assert recovered == whole[: len(recovered)]
        assert re.search(r"truncated or damaged .* lost", warning)
        assert re.search(
            rf"{len(recovered)} messages over [0-9.]+ s were recovered$",
            warning,
        )


def test_a_damaged_chunk_is_refused(tmp_path):
    path = bag_making.write_compressed(tmp_path / "bag", LONG)
    file = bag_making.storage_file(path)
    data = bytearray(file.read_bytes())
    data[100_000:100_100] = bytes(100)  # in the second of six chunks
    file.write_bytes(data)
    poses, (error,) = read(path)
    assert poses is None
    assert "damaged" in error
    assert "repair it with 'mcap recover'" in error


@pytest.mark.parametrize(
    "options",
    [
        {
            "index_types": IndexType.NONE,
            "use_statistics": False,
            "repeat_channels": False,
        },
        {"index_types": IndexType.CHUNK, "compression": CompressionType.LZ4},
        {"use_chunking": False},
    ],
)
def test_mcap_files_without_parts_of_an_index_are_whole(tmp_path, options):
    write_bag(tmp_path / "bag", STREAMS)
    with (
        bag_making.storage_file(tmp_path / "bag").open("rb") as whole,
        (tmp_path / "a.mcap").open("wb") as new,
    ):
        writer = Writer(new, **options)
        writer.start()
        ids = {}
        for schema, channel, message in make_reader(whole).iter_messages():
            if channel.id not in ids:
                key = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
                ids[channel.id] = writer.register_channel(
                    channel.topic, "cdr", key
                )
            times = message.log_time, message.publish_time
            writer.add_message(
                ids[channel.id], times[0], message.data, times[1]
            )
        writer.finish()
    assert read(tmp_path / "a.mcap") == (
        bag_making.all_poses(tmp_path / "bag"),
        [],
    )


def test_without_the_library_mcap_whole_files_are_read(tmp_path, monkeypatch):
    write_bag(tmp_path / "bag", STREAMS)
    whole = bag_making.all_poses(tmp_path / "bag")
    monkeypatch.setattr(folders, "find_spec", lambda _: None)
    assert bag_making.all_poses(tmp_path / "bag") == whole
    file = bag_making.storage_file(tmp_path / "bag")
    os.truncate(file, file.stat().st_size // 2)
    with pytest.raises(InputError, match="truncated.*'pip install mcap'"):
        PoseBag(tmp_path / "bag")


# ---- what is no bag


def test_paths_that_are_no_bag(tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "folder").mkdir()
    (tmp_path / "runs/one/bag").mkdir(parents=True)
    (tmp_path / "runs/one/bag/bag.mcap").touch()
    os.mkfifo(tmp_path / "fifo.mcap")
    messages = {
        "absent": "no bag at .*absent",
        "notes.txt": r"notes\.txt is not a bag; expected",
        "folder": r"no bag in .*: expected files that end in .*check the path",
        "runs": "no bag in .*runs/one/bag, or all bags below: hand_eye_calib batch ",
        "fifo.mcap": r"fifo\.mcap is not a bag; expected",
    }
    for suffix in ("bag", "mcap", "db3"):
        (tmp_path / f"empty.{suffix}").touch()
        (tmp_path / f"text.{suffix}").write_text("this is not a bag\n" * 100)
        messages[f"empty.{suffix}"] = f"empty.{suffix}: it is empty, 0 bytes"
        messages[f"text.{suffix}"] = (
            f"text.{suffix}: it is truncated, damaged or of an unsupported kind"
        )
    for name, message in messages.items():
        assert re.search(message, *read(tmp_path / name)[1]), name


@pytest.mark.parametrize("data", [b"", b"\x00\x07\x00\x00" + b"\x00" * 100])
def test_a_message_that_is_too_short_or_strangely_encoded_is_named(
    tmp_path, data
):
    with_message(tmp_path / "bag", "sqlite3", data)
    message = "/a: a message of type nav_msgs/msg/Odometry cannot be read .*expected plain CDR"
    with pytest.raises(InputError, match=message):
        bag_making.all_poses(tmp_path / "bag")


@pytest.mark.parametrize(
    "name", ["run#1.db3", "run%41.db3", "what?.db3", "a?mode=rw&b.db3"]
)
def test_a_path_is_not_read_as_an_address(tmp_path, name):
    write_bag(tmp_path / "bag", STREAMS, "sqlite3")
    bag_making.storage_file(tmp_path / "bag").rename(tmp_path / name)
    assert len(bag_making.all_poses(tmp_path / name)) == 120


# ---- bags made to do harm

# Three gigabytes of zeros, in frames.
BOMB = zstd.compress(bytes(64 * MIB)) * 48

# Not ru_maxrss, which a process has from the one that started it.
REPLAY = """
import pathlib, re, sys
from hand_eye_calib.offline.cli.main import main
code = main(["replay", *sys.argv[1:]])
peak = re.search(r"VmHWM:\\s+(\\d+) kB", pathlib.Path("/proc/self/status").read_text())
print(code, int(peak[1]) // 1024)
"""


def with_message(path, kind, data):
    """A bag of poses with one more message on /a."""
    plugin = rosbag2.StoragePlugin[kind.upper()]
    with rosbag2.Writer(path, version=9, storage_plugin=plugin) as writer:
        write_streams(writer, STREAMS, kind)
        connection = next(
            connection
            for connection in writer.connections
            if connection.topic == "/a"
        )
        writer.write(connection, int(STREAMS["/a"][0].stamps_ns[-1]) + 1, data)
    return path


def rosbag1_bomb(path):
    """A chunk of 700 MiB of zeros."""
    path = path / "bag.bag"
    writer = rosbag1.Writer(path)
    writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
    with writer:
        write_streams(writer, STREAMS, "rosbag1")
        connection = next(
            connection
            for connection in writer.connections
            if connection.topic == "/a"
        )
        last_ns = int(STREAMS["/a"][0].stamps_ns[-1])
        writer.write(
            connection,
            last_ns + 1,
            memoryview(np.zeros(700 * MIB, dtype=np.uint8)),
        )
    return path


@pytest.mark.parametrize("kind", bag_making.STORAGES)
def test_a_command_ends_in_one_line_and_within_its_memory(tmp_path, kind):
    is_ros1 = kind == "rosbag1"
    path = (
        rosbag1_bomb(tmp_path)
        if is_ros1
        else with_message(tmp_path / "bag", kind, BOMB)
    )
    command = [sys.executable, "-c", REPLAY, str(path), *TOPICS]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    code, mib = map(int, done.stdout.split())
    errors = [line for line in done.stderr.splitlines() if ": error: " in line]
    assert (code, len(errors)) == (1, 1), done.stderr
    assert "needs too much memory" in errors[0]
    assert mib < MOST_MIB
    assert "Traceback" not in done.stderr


def test_readings_in_several_threads_leave_no_limit_behind(monkeypatch):
    monkeypatch.setattr(files, "_is_limited", True)
    before = resource.getrlimit(resource.RLIMIT_AS)
    first = files.reading_memory()
    second = files.reading_memory()
    with first:
        second.__enter__()
        assert resource.getrlimit(resource.RLIMIT_AS) != before
    second.__exit__(None, None, None)
    assert resource.getrlimit(resource.RLIMIT_AS) == before


def test_a_compressed_file_unpacks_to_a_multiple_of_its_size(tmp_path):
    path = tmp_path / "bag.mcap.zstd"
    path.write_bytes(zstd.compress(bytes(300 * MIB)))
    with pytest.raises(
        InputError, match="unpacks to more than 256 times .* is damaged"
    ):
        PoseBag(path)


@pytest.mark.parametrize("time", ["1e300", "-1e300", "9.3e18", "'text'"])
def test_a_time_that_is_none_costs_its_message_or_gives_one_line(
    tmp_path, capsys, time
):
    write_bag(tmp_path / "bag", STREAMS, storage="sqlite3")
    with sqlite3.connect(bag_making.storage_file(tmp_path / "bag")) as database:
        database.execute(
            f"UPDATE messages SET timestamp = {time} WHERE id = 41"
        )
    code = main(
        ["calibrate", str(tmp_path / "bag"), *TOPICS, "--method", "dnlo"]
    )
    notes = capsys.readouterr().err
    if time == "'text'":
        assert code == 1
        assert "damaged" in notes
    else:
        assert code in (0, 3)
        assert "1 poses were left out: their stamps jump" in notes
