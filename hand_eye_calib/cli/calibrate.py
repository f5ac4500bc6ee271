"""``calibrate PARENT CHILD``: two trajectory files."""

from hand_eye_calib.calibrator import calibrate, offline_config
from hand_eye_calib.cli.console import waiting_for
from hand_eye_calib.cli.options import add_config_arguments, add_output_arguments, options_from
from hand_eye_calib.cli.present import deliver
from hand_eye_calib.io.trajectory_files import read_trajectory


def add_arguments(parser):
    """Declare the command's arguments."""
    parser.add_argument("parent", metavar="PARENT", help="trajectory of the parent sensor, TUM format")
    parser.add_argument("child", metavar="CHILD", help="trajectory of the child sensor, TUM format")
    add_config_arguments(parser)
    add_output_arguments(parser)


def run(arguments):
    """Calibrate from files; returns the exit code."""
    options = options_from(arguments)
    files = {"parent": arguments.parent, "child": arguments.child}
    trajectories = {stream: read_trajectory(path) for stream, path in files.items()}
    options = offline_config(trajectories["parent"], trajectories["child"], options).to_options()
    with waiting_for("solving"):
        calibration = calibrate(trajectories["parent"], trajectories["child"], **options)
    inputs = {"options": options}
    inputs |= {stream: {"file": str(path), **_extent(trajectories[stream])} for stream, path in files.items()}
    return deliver(calibration, arguments, inputs)


def _extent(trajectory):
    return {
        "poses": len(trajectory),
        "first_stamp_ns": int(trajectory.stamps_ns[0]),
        "last_stamp_ns": int(trajectory.stamps_ns[-1]),
    }
