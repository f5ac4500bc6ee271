"""Reading bags, measured against the library that reads them whole.

    OMP_NUM_THREADS=1 python benchmarks/bags.py [--messages 100000] [--images 2.0]

For every storage: two topics of ``nav_msgs/Odometry``, read and solved by us, against rosbags' own
iteration with every message deserialised, in one run and in processor time, so that other work on
the machine counts little. More than 1.5 times rosbags' time is a failure. With ``--images``, a bag
of that many GB whose bulk is camera images is replayed in a process of its own: more than 500 MB of
memory is a failure.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from itertools import chain
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from rosbags import rosbag2
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from hand_eye_calib.cli.reading import _feed as feed
from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.bags import PoseBag, write_bag

TOPICS = {"parent": "/lidar/odometry", "child": "/camera/odometry"}
ODOMETRY, IMAGE = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Image"
STORAGES = ("mcap", "sqlite3", "rosbag1")
TOLERATED_RATIO, TOLERATED_MB = 1.5, 500
TYPESTORE = get_typestore(Stores.ROS2_JAZZY)

REPLAY = """
import resource, sys, time
from hand_eye_calib.cli.main import main
start = time.perf_counter()
code = main(["replay", *sys.argv[1:], "--json"])
peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(code, time.perf_counter() - start, peak_mb, file=sys.stderr)
"""


def drive(count):
    """Trajectories of both sensors: 100 Hz, turning about all axes, stamps of their own."""
    phase = np.linspace(0, count / 300, count)
    twists = np.c_[
        np.full(count, 0.01),
        np.zeros((count, 2)),
        0.004 * np.sin(phase),
        0.003 * np.sin(1.7 * phase),
        0.008 * np.cos(phase),
    ]
    poses = [np.eye(4)]
    for step in se3.exp(twists[1:]):
        poses.append(poses[-1] @ step)
    parent = np.array(poses)
    child = (
        se3.exp(np.array([3.0, -2, 1, 0.5, 0.2, -2]))
        @ parent
        @ se3.exp(np.array([0.4, -0.2, 0.7, 0.3, -1.2, 0.6]))
    )
    stamps_ns = 1_700_000_000_000_000_000 + 10_000_000 * np.arange(count)
    return Trajectory(stamps_ns, parent, "lidar", "map"), Trajectory(
        stamps_ns + 3_000_000, child, "camera", "odom"
    )


def streams(count):
    return {
        topic: (trajectory, ODOMETRY)
        for topic, trajectory in zip(TOPICS.values(), drive(count), strict=True)
    }


def with_rosbags(path):
    """Seconds that rosbags takes to iterate over a bag and deserialise its messages."""
    start = time.process_time()
    with AnyReader([path], default_typestore=TYPESTORE) as reader:
        for connection, _, data in reader.messages(reader.connections):
            reader.deserialize(data, connection.msgtype)
    return time.process_time() - start


def with_ours(path):
    """Seconds to read, to hand everything to the engine as well, and to solve."""
    start = time.process_time()
    with PoseBag(path) as bag:
        bag.poses(*TOPICS.values())
    read = time.process_time()
    calibrator = Calibrator()
    with PoseBag(path) as bag:
        feed(calibrator, bag.poses(*TOPICS.values()), TOPICS)
    fed = time.process_time()
    calibrator.estimate()
    return read - start, fed - read, time.process_time() - fed


def compare(folder, count, console):
    """Table of all storages; how many are too slow."""
    table = Table(title=f"2 x {count:,} Odometry messages, seconds of processor time")
    for heading in (
        "storage",
        "rosbags",
        "read",
        "read + engine",
        "solve",
        "read + engine + solve / rosbags",
    ):
        table.add_column(heading, justify="left" if heading == "storage" else "right")
    too_slow = 0
    for storage in STORAGES:
        path = folder / (f"{storage}.bag" if storage == "rosbag1" else storage)
        write_bag(path, streams(count), storage)
        theirs, (read, fed, solved) = with_rosbags(path), with_ours(path)
        ratio = (fed + solved) / theirs
        too_slow += ratio > TOLERATED_RATIO
        table.add_row(
            storage, *(f"{seconds:.2f}" for seconds in (theirs, read, fed, solved)), f"{ratio:.2f}"
        )
    console.print(table)
    return too_slow


def images(folder, gigabytes, console):
    """Replay a bag that is nearly all images; whether it took too much memory."""
    image = TYPESTORE.types[IMAGE](
        header=TYPESTORE.types["std_msgs/msg/Header"](
            TYPESTORE.types["builtin_interfaces/msg/Time"](0, 0), "camera"
        ),
        height=1080,
        width=1920,
        encoding="rgb8",
        is_bigendian=0,
        step=5760,
        data=np.zeros(1920 * 1080 * 3, dtype=np.uint8),
    )
    raw = bytes(TYPESTORE.serialize_cdr(image, IMAGE))
    n_images, count = int(gigabytes * 1e9 / len(raw)) + 1, 20_000
    path = folder / "images"
    with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/image", IMAGE, typestore=TYPESTORE)
        odometry = [
            writer.add_connection(topic, ODOMETRY, typestore=TYPESTORE) for topic in TOPICS.values()
        ]
        with PoseBag(_small_bag(folder, count)) as bag:
            messages = chain.from_iterable(bag._blocks(TOPICS.values()))
            for number, (kind, bag_ns, data) in enumerate(messages):
                if number % (2 * count // n_images) == 0:
                    writer.write(connection, bag_ns, raw)
                writer.write(
                    next(known for known in odometry if known.topic == kind.topic), bag_ns, data
                )
    size = sum(file.stat().st_size for file in path.iterdir()) / 1e9
    arguments = [str(path), "--parent-topic", TOPICS["parent"], "--child-topic", TOPICS["child"]]
    done = subprocess.run(
        [sys.executable, "-c", REPLAY, *arguments], capture_output=True, text=True, check=True
    )
    code, seconds, megabytes = done.stderr.split()[-3:]
    console.print(
        f"replay of {size:.2f} GB with {n_images} images: exit code {code}, "
        f"{float(seconds):.1f} s, peak memory {float(megabytes):.0f} MB"
    )
    return float(megabytes) > TOLERATED_MB


def _small_bag(folder, count):
    write_bag(folder / "small", streams(count))
    return folder / "small"


def main(arguments=None):
    """Run everything; exit code."""
    parser = argparse.ArgumentParser(description="Benchmarks of reading bags.")
    parser.add_argument(
        "--messages", type=int, default=100_000, help="Odometry messages of each sensor"
    )
    parser.add_argument(
        "--images",
        type=float,
        default=0.0,
        metavar="GB",
        help="size of a bag with camera images to replay as well",
    )
    options = parser.parse_args(arguments)
    console = Console(width=None if sys.stdout.isatty() else 110)
    with tempfile.TemporaryDirectory() as folder:
        failures = compare(Path(folder), options.messages, console)
        if options.images:
            failures += images(Path(folder), options.images, console)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
