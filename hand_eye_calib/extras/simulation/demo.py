"""``demo``: calibrate one simulated recording from its bag and with the live node, and compare with
the truth.
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

if TYPE_CHECKING:
    from numpy import ndarray

    from hand_eye_calib.core.results.calibration import Calibration
    from hand_eye_calib.extras.simulation.drive import SimulatedDrive

TOPICS = {"parent": "/lidar/odometry", "child": "/camera/odometry"}

# A minute of driving.
DRIVE = dataclasses.replace(HILLY_DRIVE, poses=600, parent_frame="lidar", child_frame="camera")

PLAY_SPEED = 20.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.usage = "%(prog)s [OPTION ...]"
    parser.epilog = "examples:\n  hand_eye_calib demo\n  hand_eye_calib demo --out demo_2"
    out = (
        "directory for the bag, the node's log and report.html; those of an earlier demo are "
        "replaced. Default: demo_output"
    )
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("demo_output"), help=out)


def run(arguments: argparse.Namespace) -> int:
    """Run the demo; returns the exit code."""
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
        streams = zip(TOPICS.values(), (drive.parent, drive.child), strict=True)
        write_bag(bag_path, {topic: (each, "nav_msgs/msg/Odometry") for topic, each in streams})
    note(f"1/4 simulated {drive.parent.duration_s:.0f} s of driving into {bag_path}")
    recording = read_recording([bag_path], TOPICS, {})
    offline = recording.snapshot.estimate()
    note(f"2/4 calibrated offline; playing the bag to the live node at {PLAY_SPEED:g} times speed")
    # Simulated odometry stays away from robots on the network.
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    # From 102 on the ports overlap with those that Linux gives to clients.
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
    """Run the node in a process of its own; yields a function that raises if it has ended."""
    command = [sys.executable, "-m", "hand_eye_calib", "calibrator", "--ros-args"]
    command += ["-p", "solve_period:=1000.0"]  # the player asks for the solve of all poses
    for stream, topic in TOPICS.items():
        command += ["-r", f"{stream}_odom:={topic}"]
        # At this speed best effort might lose messages, and the results of the same messages are
        # compared.
        command += ["-p", f"qos_overrides.{topic}.subscription.reliability:=reliable"]

    def check() -> None:
        if process.poll() is not None:
            raise HandEyeCalibError(
                f"the node ended with exit code {process.returncode}; see {log_path}"
            )

    with (
        log_path.open("wb") as log,
        subprocess.Popen(
            command, stdout=log, stderr=subprocess.STDOUT, env=trusted_environment()
        ) as process,
    ):
        try:
            yield check
            process.send_signal(signal.SIGINT)
            if process.wait(10.0) != 0:
                check()  # says so
        finally:
            process.kill()


def _lines(drive: "SimulatedDrive", offline: "Calibration", live: "ndarray") -> Iterator[str]:
    """The verdict, each result beside the truth, and how far it is off."""
    from hand_eye_calib.core.geometry import se3
    from hand_eye_calib.core.geometry.se3 import absolute_errors

    yield offline.headline
    heads = "".join(f"{name:>10}" for name in ("x", "y", "z", "m", "roll", "pitch", "yaw"))
    yield f"{f'Pose of {offline.child_frame} in {offline.parent_frame}':<26}{heads}  deg"
    truth = drive.T_parent_child
    replayed = offline.T_parent_child
    for title, T in (("truth", truth), ("replay of the bag", replayed), ("live node", live)):
        metres, radians = absolute_errors(T, truth)
        pose = se3.xyz_rpy(T).tolist()
        position = "".join(f"{value:10.4f}" for value in pose[:3])
        degrees = "".join(f"{math.degrees(value):10.3f}" for value in pose[3:])
        off = f"off by {length(metres)} and {angle(radians)}" * (T is not truth)
        yield f"  {title:<24}{position}{'':10}{degrees}  {off}".rstrip()
    metres, radians = absolute_errors(live, replayed)
    yield f"Offline and live differ by {metres:.1e} m and {math.degrees(radians):.1e} deg"
