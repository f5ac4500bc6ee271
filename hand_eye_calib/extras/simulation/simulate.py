"""Command ``simulate``: write recordings with known truth as trajectory files and bags."""

import argparse
import dataclasses
from pathlib import Path

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.text import counted
from hand_eye_calib.extras.simulation.options import (
    HILLY_DRIVE,
    MIXTURE,
    PUBLISHED_DRIVE,
    REALISTIC,
)
from hand_eye_calib.offline.cli.options import (
    add_json_argument,
    at_least,
    print_result,
    with_progress,
)
from hand_eye_calib.offline.cli.paths import directory

# Names of the files in the published simulations, in which sensor 1 is the parent.
PARENT_FILE = "T_S1_W1.txt"
CHILD_FILE = "T_S2_W2.txt"
TRUTH_FILE = "T_S2_S1.txt"
PARENT_TOPIC = "/parent/odometry"
CHILD_TOPIC = "/child/odometry"
_TYPE = "nav_msgs/msg/Odometry"

_DRIVES = {"published": PUBLISHED_DRIVE, "hilly": HILLY_DRIVE}
_EPILOG = f"""\
examples:
  hand_eye_calib simulate --out simulated --drive hilly --mixture --bag mcap
  hand_eye_calib simulate --out repeats --runs 20

DIR/run_01, run_02, ... have the layout of the simulations published with Valimaki et al. 2023, in
TUM format:
  {PARENT_FILE}  trajectory of sensor 1, the parent, in its own world
  {CHILD_FILE}  trajectory of sensor 2, the child, in its own world
  {TRUTH_FILE}  the true extrinsic, one pose: the child sensor in the parent sensor's frame
  bag            with --bag mcap or sqlite3, bag.bag with --bag rosbag1: topics {PARENT_TOPIC}
                 and {CHILD_TOPIC} (nav_msgs/msg/Odometry)"""

# Short help that fits on one screen.
_BRIEF = f"""\
most used options:
  --out DIR         directory to make; it must be empty or not exist
  --runs N          number of recordings
  --same-mount      all recordings have one extrinsic, as those of one vehicle
  --seed SEED       the same seed gives the same recordings
  --drive hilly     two minutes outdoors in place of the paper's ten seconds
  --mixture         the noise of the paper: errors, jumps and drift
  --bag mcap        also write a bag of every recording

{_EPILOG}"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.set_defaults(brief=_BRIEF)
    parser.usage = "%(prog)s [OPTION ...] --out DIR"
    parser.epilog = _EPILOG
    add = parser.add_argument
    out = "directory to make; it must be empty or not exist"
    add("--out", metavar="DIR", type=directory, required=True, help=out)
    add(
        "--runs",
        type=at_least(1),
        default=1,
        metavar="N",
        help="number of recordings. Default: 1",
    )
    same_mount = "all recordings have the extrinsic of the first, as those of one vehicle"
    add("--same-mount", action="store_true", help=same_mount)
    seed = "the same seed gives the same recordings. Default: 0"
    add("--seed", type=at_least(0), default=0, help=seed)
    bag = "also write a bag of every recording, in this storage format"
    add("--bag", choices=("mcap", "sqlite3", "rosbag1"), help=bag)
    add_json_argument(parser)
    group = parser.add_argument_group("motion")
    group.add_argument(
        "--drive",
        choices=tuple(_DRIVES),
        default="published",
        help="published: 10 s at 0.5 m/s, both sensors at 10 Hz with equal stamps, as in the "
        "paper. hilly: two minutes at 1.5 m/s, 10 and 20 Hz, no common stamps. Default: published",
    )
    poses = "poses of the parent sensor. Default: 100 (published), 1200 (hilly)"
    group.add_argument("--poses", type=at_least(2), metavar="N", help=poses)
    group = parser.add_argument_group("noise")
    group.add_argument(
        "--mixture",
        action="store_true",
        help=f"the paper's mixture: errors of {MIXTURE.gaussian} m per axis, jumps at "
        f"{MIXTURE.outliers} of the poses, and a drift of {MIXTURE.drift} m/m",
    )


def run(arguments: argparse.Namespace) -> int:
    """Simulate and write recordings; return the exit code."""
    from hand_eye_calib.core.geometry.trajectory import Trajectory
    from hand_eye_calib.extras.simulation.drive import simulate_drive
    from hand_eye_calib.formats.trajectory_files.writing import write_trajectory

    config = _DRIVES[arguments.drive]
    config = dataclasses.replace(config, poses=arguments.poses or config.poses)
    noise = MIXTURE if arguments.mixture else REALISTIC
    _make_empty(arguments.out)
    digits = max(2, len(str(arguments.runs)))
    folders = [
        arguments.out / f"run_{number:0{digits}}"
        for number in range(1, arguments.runs + 1)
    ]
    mount = None
    for number, folder in with_progress(
        enumerate(folders), len(folders), "simulating"
    ):
        drive = simulate_drive((arguments.seed, number), config, noise, mount)
        if arguments.same_mount:
            mount = drive.T_parent_child
        _make_empty(folder)
        write_trajectory(folder / PARENT_FILE, drive.parent)
        write_trajectory(folder / CHILD_FILE, drive.child)
        truth = Trajectory(
            drive.parent.stamps_ns[:1], drive.T_parent_child[None]
        )
        write_trajectory(folder / TRUTH_FILE, truth)
        if arguments.bag:
            from hand_eye_calib.formats.bags.writer import write_bag

            name = "bag.bag" if arguments.bag == "rosbag1" else "bag"
            streams = {
                PARENT_TOPIC: (drive.parent, _TYPE),
                CHILD_TOPIC: (drive.child, _TYPE),
            }
            write_bag(folder / name, streams, arguments.bag)
    document = None
    if arguments.json:
        runs = [str(folder) for folder in folders]
        document = {
            "runs": runs,
            "seed": arguments.seed,
            "drive": config,
            "noise": noise,
        }
    print_result(
        [f"{counted(len(folders), 'recording')} written to {arguments.out}"],
        document,
    )
    return 0


def _make_empty(folder: Path) -> None:
    """Make a folder; raise an InputError if it exists and is not empty."""
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        raise InputError(
            f"{folder} is not empty, and no file in it is overwritten; remove "
            "it, or choose another folder with --out"
        )
