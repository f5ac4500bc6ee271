"""``info RESULT``: show a saved calibration, or pack it for a report."""

import argparse
from pathlib import Path

from hand_eye_calib.cli.moving import add_moving_arguments, move
from hand_eye_calib.cli.options import add_json_argument
from hand_eye_calib.cli.robot import add_description_arguments, write_description
from hand_eye_calib.errors import ConfigError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = (
        "examples:\n  hand_eye_calib info result\n  hand_eye_calib info result --json\n"
        "  hand_eye_calib info result --bundle wrong_answer.zip\n"
        "  hand_eye_calib info result --move camera.tum --to camera_as_lidar.tum"
    )
    parser.add_argument(
        "result", metavar="RESULT", help="extrinsic.yaml, or the directory that holds it"
    )
    add_description_arguments(parser)
    parser.add_argument(
        "--bundle",
        metavar="FILE",
        type=Path,
        help="write what a report of a wrong answer needs to a zip file: versions, options, "
        "findings, the result and 200 kB of downsampled poses without their place; nothing else",
    )
    add_moving_arguments(parser)
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print a saved calibration; returns the exit code, 0 whatever the calibration's status."""
    from hand_eye_calib.cli.present import as_json, as_text
    from hand_eye_calib.io.results import load_result

    calibration = load_result(arguments.result)
    if arguments.write and not arguments.urdf:
        raise ConfigError("--write needs --urdf: the description to change")
    move(calibration, arguments)
    if arguments.bundle:
        from hand_eye_calib.cli.bundle import write_bundle
        from hand_eye_calib.cli.console import note

        for text in write_bundle(arguments.result, arguments.bundle):
            note(text)
        note(f"wrote {arguments.bundle}")
    print(as_json(calibration) if arguments.json else as_text(calibration))
    write_description(calibration, arguments)
    return 0
