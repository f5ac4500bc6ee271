"""``info RESULT``: show a saved calibration."""

from hand_eye_calib.cli.options import add_json_argument


def add_arguments(parser):
    """Declare the command's arguments."""
    parser.add_argument(
        "result", metavar="RESULT", help="extrinsic.yaml, or the directory that holds it"
    )
    add_json_argument(parser)


def run(arguments):
    """Print a saved calibration; returns the exit code, 0 whatever the calibration is worth."""
    from hand_eye_calib.cli.present import as_json, as_text
    from hand_eye_calib.io.results import load_result

    calibration = load_result(arguments.result)
    print(as_json(calibration) if arguments.json else as_text(calibration))
    return 0
