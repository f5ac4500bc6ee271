"""``export RESULT FORMAT``: print a saved calibration as the file of another program."""

import argparse

from hand_eye_calib.offline.cli.options import (
    RESULT_FORMATS,
    add_result_argument,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.usage = "%(prog)s RESULT FORMAT"
    parser.epilog = (
        "examples:\n  hand_eye_calib export result urdf > camera.urdf.xacro\n"
        "  hand_eye_calib export result kalibr > camchain-imucam.yaml"
    )
    add_result_argument(parser)
    formats = f"one of {', '.join(RESULT_FORMATS)}"
    parser.add_argument(
        "format", metavar="FORMAT", choices=RESULT_FORMATS, help=formats
    )


def run(arguments: argparse.Namespace) -> int:
    """Print the file, and return the exit code."""
    from hand_eye_calib.formats.results import load_result

    print(load_result(arguments.result).export(arguments.format), end="")
    return 0
