"""``info RESULT``: show a saved calibration, or move a trajectory by it."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from hand_eye_calib.cli.console import note, print_result
from hand_eye_calib.cli.options import add_json_argument, add_verbose_argument
from hand_eye_calib.config import EXPORT_FORMATS
from hand_eye_calib.errors import ConfigError

if TYPE_CHECKING:
    from hand_eye_calib.results.calibration import Calibration

_TEXT = (".tum", ".txt")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.usage = "%(prog)s [OPTION ...] RESULT"
    parser.epilog = (
        "examples:\n  hand_eye_calib info result\n  hand_eye_calib info result --json\n"
        "  hand_eye_calib info result --as kalibr > camchain-imucam.yaml\n"
        "  hand_eye_calib info result --move camera.tum --to camera_as_lidar.tum"
    )
    parser.add_argument(
        "result", metavar="RESULT", help="extrinsic.yaml, or the directory that holds it"
    )
    parser.add_argument(
        "--as",
        dest="format",
        choices=EXPORT_FORMATS,
        metavar="FORMAT",
        help=f"print it as the file of another program instead: {', '.join(EXPORT_FORMATS)}",
    )
    parser.add_argument(
        "--move",
        metavar="CHILD",
        help="trajectory file of the child sensor: move it by the result, so that it is the parent "
        "sensor's trajectory, with the result's time offset and scale",
    )
    parser.add_argument(
        "--to",
        metavar="FILE",
        type=Path,
        help="where to: .tum or .txt for a text file, .bag for rosbag1, otherwise a new mcap bag",
    )
    add_json_argument(parser)
    add_verbose_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print a saved calibration; returns the exit code, 0 whatever the calibration's status."""
    from hand_eye_calib.cli.present import as_text
    from hand_eye_calib.io.results import load_result
    from hand_eye_calib.plain import json_text

    calibration = load_result(arguments.result)
    _move(calibration, arguments)
    if arguments.format:
        print(calibration.export(arguments.format), end="")
    elif arguments.json:
        print(json_text(calibration.to_dict()))
    else:
        print_result(as_text(calibration, with_details=arguments.verbose))
    return 0


def _move(calibration: "Calibration", arguments: argparse.Namespace) -> None:
    """Write the child's trajectory as that of the parent sensor, if it was asked for.

    Raises
    ------
    ConfigError
        If one of both options is missing.
    InputError
        If a file cannot be read or written.
    """
    if bool(arguments.move) != bool(arguments.to):
        raise ConfigError("--move CHILD and --to FILE go together")
    if not arguments.move:
        return
    from hand_eye_calib.io.trajectory_files import AUTO, read_trajectory_file, write_trajectory

    child, repairs, guesses = read_trajectory_file(arguments.move, AUTO, repair=True)
    suffix = arguments.to.suffix
    storage = "tum" if suffix in _TEXT else "rosbag1" if suffix == ".bag" else "mcap"
    write_trajectory(arguments.to, calibration.child_as_parent(child), storage)
    for text in [*guesses, *repairs, f"wrote {arguments.to}"]:
        note(text)
