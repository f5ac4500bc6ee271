"""``demo``: one simulated drive, calibrated from its bag and by the live node, compared with the
truth.
"""

import dataclasses
import json
import math
import os
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

from hand_eye_calib.cli.console import fail, note
from hand_eye_calib.cli.options import add_json_argument
from hand_eye_calib.errors import HandEyeCalibError, InputError, MissingDependencyError
from hand_eye_calib.simulation.options import HILLY_DRIVE, NoiseConfig

TOPICS = {"parent": "/lidar/odometry", "child": "/camera/odometry"}

# A minute of driving with good odometry: 2 mm and 0.06 deg per pose, 2 mm of drift per metre, a
# handful of SLAM corrections of decimetres.
DRIVE = dataclasses.replace(HILLY_DRIVE, poses=600, parent_frame="lidar", child_frame="camera")
NOISE = NoiseConfig(gaussian=0.002, rotation_per_metre=0.5, outliers=0.005, drift=0.002)

PLAY_SPEED = 20.0
# The same messages through the same engine: what is left is the way through a quaternion.
AGREEMENT = 1e-9

_STOP_S = 10.0


def add_arguments(parser):
    """Declare the command's arguments."""
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path("demo_output"),
        help="directory for the bag, the node's log and report.html; those of an earlier demo are replaced. Default: demo_output",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="another seed, another drive. Default: 0"
    )
    add_json_argument(parser)


def run(arguments):
    """Run the demo; returns the exit code."""
    from hand_eye_calib.cli.present import EXIT_CODES
    from hand_eye_calib.cli.reporting import with_consistency, write_report
    from hand_eye_calib.simulation.drive import simulate_drive

    Player = _import_player()
    if arguments.seed < 0:
        raise InputError(f"--seed must not be negative; got {arguments.seed}")
    drive = simulate_drive(arguments.seed, DRIVE, NOISE)
    bag_path = _write_bag(arguments.out, drive)
    note(f"simulated {drive.parent.duration_s:.0f} s of driving into {bag_path}")
    calibrator = _replay(bag_path)
    offline = calibrator.estimate()
    note(f"replayed it offline; playing it to the live node at {PLAY_SPEED:g} times the speed")
    live = _play(Player, bag_path, arguments.out / "node.log", offline.stamp_ns)
    document = _document(drive, bag_path, offline, live)
    print(json.dumps(document, indent=2, allow_nan=False) if arguments.json else _text(document))
    inputs = {"bag": str(bag_path)} | {stream: {"topic": topic} for stream, topic in TOPICS.items()}
    snapshot = calibrator.snapshot()
    write_report(arguments.out, *with_consistency(offline, snapshot), snapshot.config, inputs)
    if max(document["agreement"].values()) > AGREEMENT:
        return fail(
            f"offline and online differ by more than {AGREEMENT}: {document['agreement']}; the same messages must give the same",
            1,
        )
    return EXIT_CODES[offline.status]


def _import_player():
    try:
        from hand_eye_calib.ros.player import Player
    except ModuleNotFoundError as error:
        if error.name.partition(".")[0] == "hand_eye_calib":
            raise
        raise MissingDependencyError(
            f"the demo runs the live node and needs ROS 2's Python packages ({error.name} is missing): source the setup file of a "
            "ROS 2 installation, or pip install 'hand_eye_calib[ros]'"
        ) from None
    return Player


def _write_bag(out, drive):
    from hand_eye_calib.io.bags import write_bag

    path = out / "demo_bag"
    try:
        if path.is_dir():
            shutil.rmtree(path)
    except OSError as error:
        raise InputError(
            f"cannot replace {path}: {error.strerror}; remove it or choose another directory with --out"
        ) from None
    streams = {
        TOPICS["parent"]: (drive.parent, "nav_msgs/msg/Odometry"),
        TOPICS["child"]: (drive.child, "nav_msgs/msg/Odometry"),
    }
    write_bag(path, streams)
    return path


def _opened(bag_path):
    from hand_eye_calib.io.bags import PoseBag

    return PoseBag(bag_path)


def _replay(bag_path):
    from hand_eye_calib.cli.replaying import feed
    from hand_eye_calib.engine.calibrator import Calibrator

    calibrator = Calibrator()
    with _opened(bag_path) as bag:
        feed(calibrator, bag.blocks(*TOPICS.values()), TOPICS)
    return calibrator


def _play(Player, bag_path, log_path, stamp_ns):
    _keep_to_ourselves()
    with _node(log_path) as check, Player(TOPICS, check) as player, _opened(bag_path) as bag:
        player.play(bag.poses(*TOPICS.values()), PLAY_SPEED)
        return player.wait_for_extrinsic(stamp_ns)


def _keep_to_ourselves():
    """No robot on the network shall receive simulated odometry; an explicit ROS_DOMAIN_ID is
    respected.
    """
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    # Above 101 the ports run into those that Linux gives to clients.
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))


@contextmanager
def _node(log_path):
    """The node in a process of its own; yields a function that raises where it has ended."""
    command = [
        sys.executable,
        "-m",
        "hand_eye_calib",
        "calibrator",
        "--ros-args",
        "-p",
        "solve_period:=0.5",
    ]
    for stream, topic in TOPICS.items():
        command += ["-r", f"{stream}_odom:={topic}"]
        # Played this fast, best effort might lose messages, and this demo compares results of the
        # same ones.
        command += ["-p", f"qos_overrides.{topic}.subscription.reliability:=reliable"]
    with log_path.open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)

    def check():
        if process.poll() is not None:
            raise HandEyeCalibError(
                f"the node ended with exit code {process.returncode}; see {log_path}"
            )

    try:
        yield check
        process.send_signal(signal.SIGINT)
        if process.wait(_STOP_S) != 0:
            check()  # says so
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


def _document(drive, bag_path, offline, live):
    frames = {"parent_frame": offline.parent_frame, "child_frame": offline.child_frame}
    if (live.parent_frame, live.child_frame) != (offline.parent_frame, offline.child_frame):
        raise HandEyeCalibError(
            f"the node's result is of {live.child_frame} in {live.parent_frame}, the replay's of {frames}"
        )
    difference_m, difference_rad = _errors(live.T_parent_child, offline.T_parent_child)
    return {
        **frames,
        "bag": str(bag_path),
        "poses": {"parent": len(drive.parent), "child": len(drive.child)},
        "status": offline.status.value,
        "truth": _both_directions(drive.T_parent_child),
        "offline": _estimate(offline.T_parent_child, drive.T_parent_child)
        | {"stamp_ns": offline.stamp_ns, "reference": offline.reference},
        "online": _estimate(live.T_parent_child, drive.T_parent_child)
        | {"stamp_ns": live.stamp_ns},
        "agreement": {"translation_m": difference_m, "rotation_rad": difference_rad},
    }


def _estimate(T_parent_child, truth):
    error_m, error_rad = _errors(T_parent_child, truth)
    return _both_directions(T_parent_child) | {
        "error": {"translation_m": error_m, "rotation_rad": error_rad}
    }


def _both_directions(T_parent_child):
    from hand_eye_calib.geometry import se3

    return {
        "T_parent_child": T_parent_child.tolist(),
        "T_child_parent": se3.inverse(T_parent_child).tolist(),
    }


def _errors(T_parent_child, truth):
    """Distance between the translations (m) and angle between the rotations (rad)."""
    from hand_eye_calib.geometry import se3

    return math.dist(T_parent_child[:3, 3], truth[:3, 3]), float(
        se3.rotation_angle(T_parent_child[:3, :3].T @ truth[:3, :3])
    )


def _text(document):
    parent, child, agreement = (
        document["parent_frame"],
        document["child_frame"],
        document["agreement"],
    )
    rows = {"truth": "truth", "offline": "replay of the bag", "online": "live node"}
    lines = []
    for direction, source, target in (
        ("T_parent_child", child, parent),
        ("T_child_parent", parent, child),
    ):
        lines.append(
            f"{f'Pose of {source} in {target}':<26}         x         y         z  m      roll     pitch       yaw  deg"
        )
        lines += [f"  {title:<24}{_row(document[key][direction])}" for key, title in rows.items()]
    lines.append(f"Error of the pose of {child} in {parent}")
    for key in ("offline", "online"):
        error = document[key]["error"]
        lines.append(
            f"  {rows[key]:<24}{1e3 * error['translation_m']:10.2f} mm {math.degrees(error['rotation_rad']):10.4f} deg"
        )
    lines.append(
        f"Offline and online differ by {agreement['translation_m']:.1e} m and {math.degrees(agreement['rotation_rad']):.1e} deg"
    )
    return "\n".join(lines)


def _row(matrix):
    from hand_eye_calib.geometry import se3

    angles = se3.rotation_to_rpy([row[:3] for row in matrix[:3]])
    return (
        "".join(f"{row[3]:10.4f}" for row in matrix[:3])
        + "   "
        + "".join(f"{math.degrees(a):10.3f}" for a in angles)
    )
