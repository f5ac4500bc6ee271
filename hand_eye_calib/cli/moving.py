"""``info RESULT --move``: the child's trajectory as that of the parent sensor."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from hand_eye_calib.cli.console import note
from hand_eye_calib.errors import ConfigError

if TYPE_CHECKING:
    from hand_eye_calib.calibration import Calibration

_TEXT = (".tum", ".txt")


def add_moving_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare ``--move`` and ``--to``."""
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


def move(calibration: "Calibration", arguments: argparse.Namespace) -> None:
    """Write the moved trajectory if it was asked for.

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
