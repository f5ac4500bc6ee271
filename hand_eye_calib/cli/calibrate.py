"""``calibrate PARENT CHILD``: two trajectory files, or those of all sensors of a rig."""

import argparse
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_eye_calib.cli.console import note, waiting_for
from hand_eye_calib.cli.options import add_config_arguments, add_output_arguments, options_from
from hand_eye_calib.cli.robot import add_robot_arguments
from hand_eye_calib.config import STAMP_UNITS, TRAJECTORY_FORMATS
from hand_eye_calib.errors import ConfigError

if TYPE_CHECKING:
    from hand_eye_calib.geometry.trajectory import Trajectory

STREAMS = ("parent", "child")

EXAMPLES = """\
examples:
  hand_eye_calib calibrate lidar.txt camera.txt --out result
  hand_eye_calib calibrate gnss.csv slam.txt --time-offset estimate
  hand_eye_calib calibrate lidar.txt mono.txt --scale estimate --prior z=1.85+/-0.02
  hand_eye_calib calibrate lidar.txt front.txt rear.txt --out rig"""

_FORMATS = (
    "tum: t x y z qx qy qz qw; kitti: 12 numbers, with --times; euroc: ns, qw first; csv: columns "
    "by the names in the header, or with --columns: positions as x y z or lat lon height, "
    "orientations as quaternion, roll pitch yaw or heading. Default: what the file looks like"
)
# By name, what argparse needs.
FILE_OPTIONS: dict[str, dict[str, Any]] = {
    "format": {"choices": TRAJECTORY_FORMATS, "help": _FORMATS},
    "columns": {
        "metavar": "NAMES",
        "help": "names of the columns of a csv file without a header, in their order: "
        "t,x,y,z,qw,qx,qy,qz",
    },
    "times": {
        "metavar": "FILE",
        "type": Path,
        "help": "stamps of the poses of a kitti file, one per line",
    },
    "stamp_unit": {
        "choices": tuple(STAMP_UNITS),
        "help": "unit of the stamps. Default: recognised from their size",
    },
}

# Options that one of two files of different formats may have no use for.
_OF_SOME_FILES = ("columns", "times")
# The options of a file as the messages of its reader name them.
_FILE_OPTION = re.compile("`(format|columns|times|stamp_unit)`")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = EXAMPLES
    parser.add_argument("parent", metavar="PARENT", help="trajectory of the parent sensor")
    parser.add_argument("child", metavar="CHILD", help="trajectory of the child sensor")
    parser.add_argument(
        "others",
        metavar="OTHER",
        nargs="*",
        help="trajectories of more sensors: all are solved together, in the frame of the parent",
    )
    add_file_arguments(parser)
    add_config_arguments(parser)
    add_output_arguments(parser)
    add_robot_arguments(parser)


def add_file_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how trajectory files are to be read: for both, and for each."""
    group = parser.add_argument_group(
        "trajectory files", "each also as --parent-... and --child-... for one of the two files"
    )
    for name, settings in FILE_OPTIONS.items():
        group.add_argument(f"--{name.replace('_', '-')}", dest=name, **settings)
        for stream in STREAMS:
            of_one = settings | {"help": f"the same for {stream.upper()} only"}
            option = f"--{stream}-{name.replace('_', '-')}"
            group.add_argument(option, dest=f"{stream}_{name}", **of_one)


def read_files(
    arguments: argparse.Namespace, options: Mapping[str, Any]
) -> tuple[dict[str, "Trajectory"], list[str]]:
    """Read both files as the options of :func:`add_file_arguments` say, and say what was guessed.

    Parameters
    ----------
    arguments : argparse.Namespace
    options : mapping
        Options of the engine by their public names.

    Returns
    -------
    trajectories : dict
        "parent" and "child" to Trajectory.
    repairs : list of str
        What was wrong with the stamps.

    Raises
    ------
    HandEyeCalibError
        If a file cannot be read.
    """
    from hand_eye_calib.io.trajectory_files import AUTO, FileOptions, read_trajectory_files

    files = []
    for stream in STREAMS:
        settings = _settings_of(arguments, stream)
        settings |= {"format": _given(arguments, stream, "format") or AUTO, "repair": True}
        settings["measures"] = options.get(f"{stream}_measures", AUTO)
        files.append((getattr(arguments, stream), FileOptions(**settings)))
    with waiting_for(f"reading {arguments.parent} and {arguments.child}"):
        read = dict(zip(STREAMS, read_trajectory_files(files), strict=True))
    for stream, reading in read.items():
        for text in reading.guesses:
            note(_FILE_OPTION.sub(f"`{stream}_\\1`", text))
    repairs = [text for reading in read.values() for text in reading.repairs]
    return {stream: reading.trajectory for stream, reading in read.items()}, repairs


def _given(arguments: argparse.Namespace, stream: str, name: str) -> Any:
    """An option of one file, or the one for both."""
    return getattr(arguments, f"{stream}_{name}") or getattr(arguments, name)


def _settings_of(arguments: argparse.Namespace, stream: str) -> dict[str, Any]:
    """How to read the file of a stream: its own options before those for both.

    Of those for both, columns are meant for the files that do not name their own, and times for
    those of format kitti.
    """
    given = {name: _given(arguments, stream, name) for name in FILE_OPTIONS if name != "format"}
    for name in _OF_SOME_FILES:
        of_both = getattr(arguments, name) and not getattr(arguments, f"{stream}_{name}")
        if of_both and not _is_meant(arguments, stream, name):
            others = (other for other in STREAMS if other != stream)
            if any(_is_meant(arguments, other, name) for other in others):
                given[name] = None
    return given


def _is_meant(arguments: argparse.Namespace, stream: str, name: str) -> bool:
    """Whether ``--columns`` or ``--times`` for both files fits the file of a stream."""
    from hand_eye_calib.io.trajectory_files import layout_of_file

    found = layout_of_file(getattr(arguments, stream))
    format = _given(arguments, stream, "format") or found.format
    if name == "times":
        return bool(format == "kitti")
    return format == "csv" or not (_given(arguments, stream, "format") or found.is_named)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate from files; returns the exit code."""
    if arguments.others:
        from hand_eye_calib.cli.rig import calibrate_and_deliver

        files = [arguments.parent, arguments.child, *arguments.others]
        return calibrate_and_deliver(_read_rig(files, arguments), arguments, {"files": files})
    from hand_eye_calib.cli.present import deliver
    from hand_eye_calib.engine import run as engine
    from hand_eye_calib.engine.offline import offline_config, whole_snapshot

    options = options_from(arguments)
    trajectories, repairs = read_files(arguments, options)
    for text in repairs:
        note(text)
    config = offline_config(trajectories["parent"], trajectories["child"], options)
    with waiting_for("solving, and checking the streams"):
        found = engine.run(whole_snapshot(config, **trajectories))
    calibration, snapshot = found.calibration, found.snapshot
    inputs: dict[str, Any] = {"options": snapshot.config.to_options()}
    for stream in STREAMS:
        inputs[stream] = {"file": str(getattr(arguments, stream)), **_extent(trajectories[stream])}
    if arguments.out:
        from hand_eye_calib.cli.replaying import fingerprints

        inputs["files"] = fingerprints(_files(arguments))
    return deliver(calibration, arguments, inputs, snapshot)


def _read_rig(files: Sequence[str], arguments: argparse.Namespace) -> dict[str, "Trajectory"]:
    """The trajectories by the names of their frames: as the files name them, or as the files are
    named.
    """
    from hand_eye_calib.cli.rig import add_sensor
    from hand_eye_calib.io.trajectory_files import AUTO, FileOptions, read_trajectory_files

    of_one = [
        f"--{stream}-{name.replace('_', '-')}"
        for stream in STREAMS
        for name in FILE_OPTIONS
        if getattr(arguments, f"{stream}_{name}")
    ]
    if of_one:
        raise ConfigError(f"{of_one[0]} is of two files; give the option for all of a rig's files")
    settings = {name: getattr(arguments, name) for name in FILE_OPTIONS}
    settings |= {"format": arguments.format or AUTO, "repair": True}
    with waiting_for(f"reading {', '.join(files)}"):
        read = read_trajectory_files([(file, FileOptions(**settings)) for file in files])
    found: dict[str, Trajectory] = {}
    for file, (trajectory, repairs, guesses) in zip(files, read, strict=True):
        for text in (*guesses, *repairs):
            note(text)
        add_sensor(found, trajectory.sensor_frame or Path(file).stem, trajectory)
    return found


def _files(arguments: argparse.Namespace) -> list[Path]:
    """All files that were read."""
    times = (arguments.times, arguments.parent_times, arguments.child_times)
    return [Path(arguments.parent), Path(arguments.child), *filter(None, times)]


def _extent(trajectory: "Trajectory") -> dict[str, int]:
    return {
        "poses": len(trajectory),
        "first_stamp_ns": int(trajectory.stamps_ns[0]),
        "last_stamp_ns": int(trajectory.stamps_ns[-1]),
    }
