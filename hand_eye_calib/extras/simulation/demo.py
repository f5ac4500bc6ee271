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
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    from hand_eye_calib.extras.simulation.options import DriveConfig

TOPICS = {"parent": "/lidar/odometry", "child": "/camera/odometry"}

# Drive of one minute that the demo simulates.
DRIVE = dataclasses.replace(
    HILLY_DRIVE, poses=600, parent_frame="lidar", child_frame="camera"
)

# Ratio of the speed of the playback to that of the recording.
PLAY_SPEED = 20.0

# Drive of two minutes for the option --live, and the ratio of its speed to that of the recording.
LIVE_DRIVE = dataclasses.replace(
    HILLY_DRIVE, parent_frame="lidar", child_frame="camera"
)
LIVE_SPEED = 1.0

# Longest time (s) in which a node stops, without and with a result to save.
_STOP_WITHIN_S = 10.0
_SAVE_WITHIN_S = 60.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.usage = "%(prog)s [OPTION ...]"
    parser.epilog = (
        "examples:\n  hand_eye_calib demo\n  hand_eye_calib demo --live"
    )
    live = (
        "play two minutes of driving to the live node at their own speed, and display "
        "the session as watch --web does"
    )
    parser.add_argument("--live", action="store_true", help=live)
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
    return (_run_live if arguments.live else _run_both)(arguments.out)


def _run_both(out: Path) -> int:
    """Calibrate from a bag and with the live node; return the exit code."""
    from hand_eye_calib.extras.simulation.player import play
    from hand_eye_calib.formats.bags.reader import PoseBag
    from hand_eye_calib.offline.cli.bags import read_recording
    from hand_eye_calib.offline.cli.present import exit_code
    from hand_eye_calib.offline.cli.reporting import write_report

    drive, bag_path = _simulated(DRIVE, out)
    note(
        f"1/4 simulated {drive.parent.duration_s:.0f} s of driving into {bag_path}"
    )
    recording = read_recording([bag_path], TOPICS, {})
    offline = recording.snapshot.estimate()
    note(
        f"2/4 calibrated offline; playing the bag to the live node at {PLAY_SPEED:g} times "
        "speed, after the node has started"
    )
    _isolate()
    # Do not solve before all poses are sent. The player then calls ~/solve.
    parameters = ["solve_period:=1000.0"]
    for topic in TOPICS.values():
        # Both results must use the same messages, but best effort may lose some at this speed.
        parameters.append(
            f"qos_overrides.{topic}.subscription.reliability:=reliable"
        )
    log_path = out / "node.log"
    with (
        waiting_for("playing"),
        PoseBag(bag_path) as bag,
        _node(log_path, parameters) as node,
    ):
        poses = bag.poses(TOPICS["parent"], TOPICS["child"])
        check = partial(_require_running, node, log_path)
        online = play(poses, TOPICS, PLAY_SPEED, offline.stamp_ns, check)
        node.send_signal(signal.SIGINT)
        if node.wait(_STOP_WITHIN_S) != 0:
            check()
    note("3/4 calibrated live; the report follows")
    print_result(_lines(drive, offline, online))
    write_report(out, offline, recording.snapshot, recording.inputs)
    note(f"4/4 done; everything is in {out}")
    return exit_code(offline)


def _run_live(out: Path) -> int:
    """Play a drive to the live node, and display the session; return the exit code.

    The drive ends early if the person ends the display, or with Ctrl-C.
    """
    from hand_eye_calib.extras.simulation.player import play_live
    from hand_eye_calib.formats.bags.reader import PoseBag

    drive, bag_path = _simulated(LIVE_DRIVE, out)
    _isolate()
    directory = out / "live"
    log_path = out / "node.log"
    note(
        f"playing {drive.parent.duration_s:.0f} s of driving to the live node; press q to end"
    )
    with (
        PoseBag(bag_path) as bag,
        _node(log_path, [f"output_directory:={directory}"]) as node,
        _started("watch", "--web") as watch,
    ):
        poses = bag.poses(TOPICS["parent"], TOPICS["child"])
        check = partial(_require_running, node, log_path)
        try:
            play_live(
                poses, TOPICS, LIVE_SPEED, check, lambda: watch.poll() is None
            )
            # The terminal sends Ctrl-C to the node and to the display as well.
            node.send_signal(signal.SIGINT)
            code = node.wait(_SAVE_WITHIN_S)
            if sys.stdout.isatty():
                watch.wait()
        except KeyboardInterrupt:
            code = node.wait(_SAVE_WITHIN_S)
        if code != 0:
            check()
        watch.send_signal(signal.SIGINT)
        watch.wait(_STOP_WITHIN_S)
    print_result(_live_lines(drive, directory))
    return 0


def _simulated(
    config: "DriveConfig", out: Path
) -> "tuple[SimulatedDrive, Path]":
    """Simulate a drive; return the drive and the path of its bag, which is written."""
    from hand_eye_calib.extras.simulation.drive import simulate_drive
    from hand_eye_calib.formats.bags.writer import write_bag

    with waiting_for("simulating"):
        drive = simulate_drive(0, config, REALISTIC)
        bag_path = out / "demo_bag"
        if bag_path.is_dir():
            shutil.rmtree(bag_path)
        streams = {
            TOPICS["parent"]: (drive.parent, "nav_msgs/msg/Odometry"),
            TOPICS["child"]: (drive.child, "nav_msgs/msg/Odometry"),
        }
        write_bag(bag_path, streams)
    return drive, bag_path


def _isolate() -> None:
    """Restrict ROS to this computer, in a domain that hardly any other program uses."""
    # Robots on the network must not receive simulated odometry.
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    # Use a domain from 1 to 100. The ports of domains from 102 on may be in use, because Linux
    # assigns them to clients.
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))


@contextmanager
def _node(
    log_path: Path, parameters: Sequence[str]
) -> "Iterator[subprocess.Popen[bytes]]":
    """Run the node in its own process, and kill it at the end of the context if it still runs.

    ``parameters`` are ROS parameters NAME:=VALUE.
    """
    arguments = ["--ros-args"]
    for stream, topic in TOPICS.items():
        arguments += ["-r", f"{stream}_odom:={topic}"]
    for parameter in parameters:
        arguments += ["-p", parameter]
    with (
        log_path.open("wb") as log,
        _started(
            "calibrator", *arguments, stdout=log, stderr=subprocess.STDOUT
        ) as process,
    ):
        yield process


@contextmanager
def _started(
    *arguments: str, **options: Any
) -> "Iterator[subprocess.Popen[bytes]]":
    """Run a command of this program in a process, and kill it at the end if it still runs."""
    command = [sys.executable, "-m", "hand_eye_calib", *arguments]
    with subprocess.Popen(
        command, env=trusted_environment(), **options
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def _require_running(
    process: "subprocess.Popen[bytes]", log_path: Path
) -> None:
    """Raise a HandEyeCalibError if the node has ended."""
    if process.poll() is not None:
        raise HandEyeCalibError(
            f"the node ended with exit code {process.returncode}; see {log_path}"
        )


def _live_lines(drive: "SimulatedDrive", directory: Path) -> Iterator[str]:
    """Yield lines with the saved result of a live session, and its error."""
    from hand_eye_calib.core.geometry.se3 import absolute_errors
    from hand_eye_calib.formats.results import FILE_NAME, load_result

    path = directory / FILE_NAME
    if not path.exists():
        yield "The session ended without a result: let it run for half a minute"
        return
    result = load_result(path)
    metres, radians = absolute_errors(
        result.T_parent_child, drive.T_parent_child
    )
    yield result.headline
    yield f"Off the simulated truth by {length(metres)} and {angle(radians)}; saved in {directory}"


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
