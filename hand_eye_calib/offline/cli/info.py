"""``info RESULT``: print a saved calibration, or the file of another program with it."""

import argparse

from hand_eye_calib.offline.cli.options import (
    RESULT_FORMATS,
    add_json_argument,
    add_result_argument,
    print_result,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.usage = "%(prog)s [OPTION ...] RESULT"
    parser.epilog = (
        "examples:\n  hand_eye_calib info result\n  hand_eye_calib info result --json\n"
        "  hand_eye_calib info result --as kalibr > camchain-imucam.yaml"
    )
    add_result_argument(parser)
    formats = f"print the result as the file of another program: {', '.join(RESULT_FORMATS)}"
    parser.add_argument(
        "--as",
        dest="format",
        choices=RESULT_FORMATS,
        metavar="FORMAT",
        help=formats,
    )
    add_json_argument(parser, or_verbose=True)


def run(arguments: argparse.Namespace) -> int:
    """Print a saved calibration, and return the exit code 0, whatever its status is."""
    from hand_eye_calib.formats.results import load_result
    from hand_eye_calib.offline.cli.present import as_lines

    calibration = load_result(arguments.result)
    if arguments.format:
        print(calibration.export(arguments.format), end="")
    else:
        document = calibration.to_dict() if arguments.json else None
        print_result(as_lines(calibration, (), arguments.verbose), document)
    return 0
