"""``info RESULT``: print a saved calibration, or the file of another program with it."""

import argparse

from hand_eye_calib.core.base.config import EXPORT_FORMATS, ROBOT_FORMATS
from hand_eye_calib.offline.cli.options import add_json_argument, print_result

_FORMATS = (*ROBOT_FORMATS, *EXPORT_FORMATS)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.usage = "%(prog)s [OPTION ...] RESULT"
    parser.epilog = (
        "examples:\n  hand_eye_calib info result\n  hand_eye_calib info result --json\n"
        "  hand_eye_calib info result --as kalibr > camchain-imucam.yaml"
    )
    result = "extrinsic.yaml, or the directory that contains it"
    parser.add_argument("result", metavar="RESULT", help=result)
    formats = f"print it as the file of another program instead: {', '.join(_FORMATS)}"
    parser.add_argument("--as", dest="format", choices=_FORMATS, metavar="FORMAT", help=formats)
    add_json_argument(parser, or_verbose=True)


def run(arguments: argparse.Namespace) -> int:
    """Print a saved calibration, and return the exit code: 0 for every status of it."""
    from hand_eye_calib.formats.results import load_result
    from hand_eye_calib.offline.cli.present import as_lines

    calibration = load_result(arguments.result)
    if arguments.format:
        print(calibration.export(arguments.format), end="")
    else:
        document = calibration.to_dict() if arguments.json else None
        print_result(as_lines(calibration, (), arguments.verbose), document)
    return 0
