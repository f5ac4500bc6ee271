"""Command ``demo``: calibrate a simulated recording, from its bag and with the live node.

Both results are compared with the true extrinsic.
"""

import argparse
import dataclasses
import math
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from hand_eye_calib.core.base.errors import HandEyeCalibError
from hand_eye_calib.core.base.python_path import trusted_environment
from hand_eye_calib.core.base.text import angle, length
from hand_eye_calib.extras.simulation.options import HILLY_DRIVE, REALISTIC
from hand_eye_calib.offline.cli.options import note, print_result, waiting_for
from hand_eye_calib.offline.cli.paths import directory

if TYPE_CHECKING:
    from numpy import ndarray

    from hand_eye_calib.core.results.calibration import Calibration
    from hand_eye_calib.extras.simulation.drive import SimulatedDrive

TOPICS = {"parent": "/lidar/odometry", "child": "/camera/odometry"}

# Drive of one minute that the demo simulates.
DRIVE = dataclasses.replace(
    HILLY_DRIVE, poses=600, parent_frame="lidar", child_frame="camera"
)

# Ratio of the speed of the playback to that of the recording.
PLAY_SPEED = 20.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.usage = "%(prog)s [OPTION ...]"
    parser.epilog = (
        "examples:\n  hand_eye_calib demo\n  hand_eye_calib demo --out demo_2"
    )
    out = (
        "directory for the bag, the node's log and report.html; files of an "
        "earlier demo are replaced. Default: demo_output"
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=directory,
        default=Path("demo_output"),
        help=out,
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the demo; return the exit code."""
    from hand_eye_calib.extras.simulation.drive import simulate_drive
    from hand_eye_calib.extras.simulation.player import play
    from hand_eye_calib.formats.bags.reader import PoseBag
    from hand_eye_calib.formats.bags.writer import write_bag
    from hand_eye_calib.offline.cli.bags import read_recording
    from hand_eye_calib.offline.cli.present import exit_code
    from hand_eye_calib.offline.cli.reporting import write_report

    with waiting_for("simulating"):
        drive = simulate_drive(0, DRIVE, REALISTIC)
        bag_path = arguments.out / "demo_bag"
        if bag_path.is_dir():
            shutil.rmtree(bag_path)
        streams = {
            TOPICS["parent"]: (drive.parent, "nav_msgs/msg/Odometry"),
            TOPICS["child"]: (drive.child, "nav_msgs/msg/Odometry"),
        }
        write_bag(bag_path, streams)
    note(
        f"1/4 simulated {drive.parent.duration_s:.0f} s of driving into {bag_path}"
    )
    recording = read_recording([bag_path], TOPICS, {})
    offline = recording.snapshot.estimate()
    note(
        f"2/4 calibrated offline; playing the bag to the live node at {PLAY_SPEED:g} times "
        "speed, after the node has started"
    )
    # Robots on the network must not receive simulated odometry.
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    # Use a domain from 1 to 100. The ports of domains from 102 on may be in use, because Linux
    # assigns them to clients.
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    node = _node(arguments.out / "node.log")
    with waiting_for("playing"), PoseBag(bag_path) as bag, node as check:
        poses = bag.poses(TOPICS["parent"], TOPICS["child"])
        online = play(poses, TOPICS, PLAY_SPEED, offline.stamp_ns, check)
    note("3/4 calibrated live; the report follows")
    print_result(_lines(drive, offline, online))
    write_report(arguments.out, offline, recording.snapshot, recording.inputs)
    note(f"4/4 done; everything is in {arguments.out}")
    return exit_code(offline)


@contextmanager
def _node(log_path: Path) -> Iterator[Callable[[], None]]:
    """Run the node in its own process, and stop it at the end of the context.

    The context yields ``check()``, which raises a HandEyeCalibError if the node has ended.
    """
    command = [
        sys.executable,
        "-m",
        "hand_eye_calib",
        "calibrator",
        "--ros-args",
    ]
    # Do not solve before all poses are sent. The player then calls ~/solve.
    command += ["-p", "solve_period:=1000.0"]
    for stream, topic in TOPICS.items():
        command += ["-r", f"{stream}_odom:={topic}"]
        # Both results must use the same messages, but best effort may lose some at this speed.
        command += [
            "-p",
            f"qos_overrides.{topic}.subscription.reliability:=reliable",
        ]

    def check() -> None:
        """Raise a HandEyeCalibError if the node has ended."""
        if process.poll() is not None:
            raise HandEyeCalibError(
                f"the node ended with exit code {process.returncode}; see {log_path}"
            )

    with (
        log_path.open("wb") as log,
        subprocess.Popen(
            command,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=trusted_environment(),
        ) as process,
    ):
        try:
            yield check
            process.send_signal(signal.SIGINT)
            if process.wait(10.0) != 0:
                check()
        finally:
            process.kill()


def _lines(
    drive: "SimulatedDrive", offline: "Calibration", live: "ndarray"
) -> Iterator[str]:
    """Yield lines with the verdict, the truth, and both results with their errors.

    ``live`` is ``T_parent_child`` (4, 4) of the node.
    """
    from hand_eye_calib.core.geometry import se3
    from hand_eye_calib.core.geometry.se3 import absolute_errors

    yield offline.headline
    heads = "".join(
        f"{name:>10}" for name in ("x", "y", "z", "m", "roll", "pitch", "yaw")
    )
    yield f"{f'Pose of {offline.child_frame} in {offline.parent_frame}':<26}{heads}  deg"
    truth = drive.T_parent_child
    replayed = offline.T_parent_child
    for title, T in (
        ("truth", truth),
        ("replay of the bag", replayed),
        ("live node", live),
    ):
        pose = se3.xyz_rpy(T).tolist()
        position = "".join(f"{value:10.4f}" for value in pose[:3])
        degrees = "".join(f"{math.degrees(value):10.3f}" for value in pose[3:])
        line = f"  {title:<24}{position}{'':10}{degrees}"
        if T is not truth:
            metres, radians = absolute_errors(T, truth)
            line += f"  off by {length(metres)} and {angle(radians)}"
        yield line
    metres, radians = absolute_errors(live, replayed)
    yield f"Offline and live differ by {metres:.1e} m and {math.degrees(radians):.1e} deg"
