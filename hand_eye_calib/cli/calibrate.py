"""``calibrate PARENT CHILD``: two trajectory files."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_eye_calib.cli.console import note, waiting_for
from hand_eye_calib.cli.options import add_config_arguments, add_output_arguments, options_from
from hand_eye_calib.cli.parser import advanced
from hand_eye_calib.config import STAMP_UNITS, TRAJECTORY_FORMATS

if TYPE_CHECKING:
    from hand_eye_calib.geometry.trajectory import Trajectory

STREAMS = ("parent", "child")

EXAMPLES = """\
examples:
  hand_eye_calib calibrate lidar.txt camera.txt --out result
  hand_eye_calib calibrate gnss.csv slam.txt --parent-format csv --time-offset estimate
  hand_eye_calib calibrate lidar.txt mono.txt --scale estimate --prior z=1.85+/-0.02"""

_FORMATS = (
    "tum: t x y z qx qy qz qw; kitti: 12 numbers, with --times; euroc: ns, qw first; csv: columns "
    "by the names in the header, or with --columns. Default: what the file looks like"
)
_USUAL_FORMAT = "tum"
_FILE_OPTIONS: dict[str, dict[str, Any]] = {
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = EXAMPLES
    parser.add_argument("parent", metavar="PARENT", help="trajectory of the parent sensor")
    parser.add_argument("child", metavar="CHILD", help="trajectory of the child sensor")
    add_file_arguments(parser)
    add_config_arguments(parser)
    add_output_arguments(parser)


def add_file_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how trajectory files are to be read: for both, and for each."""
    group = parser.add_argument_group(
        "trajectory files", "each also as --parent-... and --child-... for one of the two files"
    )
    for name, settings in _FILE_OPTIONS.items():
        group.add_argument(f"--{name.replace('_', '-')}", dest=name, **settings)
        for stream in STREAMS:
            of_one = settings | {"help": f"the same for {stream.upper()} only"}
            option = f"--{stream}-{name.replace('_', '-')}"
            advanced(group.add_argument(option, dest=f"{stream}_{name}", **of_one))
    group.add_argument(
        "--repair-stamps",
        action="store_true",
        help="sort poses that are out of order and drop repeated stamps, instead of refusing the "
        "file",
    )


def read_files(arguments: argparse.Namespace) -> tuple[dict[str, "Trajectory"], list[str]]:
    """Read both files as the options of :func:`add_file_arguments` say.

    Returns
    -------
    trajectories : dict
        "parent" and "child" to Trajectory.
    notes : list of str
        What had to be repaired.

    Raises
    ------
    HandEyeCalibError
        If a file cannot be read.
    """
    from hand_eye_calib.io.trajectory_files import read_trajectory_file

    trajectories: dict[str, Trajectory] = {}
    notes: list[str] = []
    formats = {stream: _format_of(arguments, stream) for stream in STREAMS}
    for stream in STREAMS:
        trajectories[stream], repaired = read_trajectory_file(
            getattr(arguments, stream),
            formats[stream],
            repair=arguments.repair_stamps,
            **_settings_of(arguments, stream, formats),
        )
        notes += repaired
    return trajectories, notes


def _format_of(arguments: argparse.Namespace, stream: str) -> str:
    """The format that was given for the file of a stream, or that it looks like."""
    from hand_eye_calib.io.format_guess import guess_format

    if given := getattr(arguments, f"{stream}_format") or arguments.format:
        return given
    path = getattr(arguments, stream)
    guess = guess_format(path)
    # Columns are named for csv, and only csv has lines like those of euroc.
    if guess == "euroc" and (arguments.columns or getattr(arguments, f"{stream}_columns")):
        guess = "csv"
    if guess != _USUAL_FORMAT:
        note(f"{path} looks like format {guess}; to change that, give --{stream}-format")
    return guess


def _settings_of(
    arguments: argparse.Namespace, stream: str, formats: Mapping[str, str]
) -> dict[str, Any]:
    """How to read the file of a stream: its own options before those for both."""
    given = {
        name: getattr(arguments, f"{stream}_{name}") or getattr(arguments, name)
        for name in _FILE_OPTIONS
        if name != "format"
    }
    # An option for both files is meant for those of them that have its format.
    for name, belongs_to in (("columns", "csv"), ("times", "kitti")):
        is_own = bool(getattr(arguments, f"{stream}_{name}"))
        if formats[stream] != belongs_to and not is_own and belongs_to in formats.values():
            given[name] = None
    return given


def run(arguments: argparse.Namespace) -> int:
    """Calibrate from files; returns the exit code."""
    from hand_eye_calib.cli.findings import with_findings
    from hand_eye_calib.cli.present import deliver
    from hand_eye_calib.engine.offline import offline_config, whole_snapshot

    options = options_from(arguments)
    trajectories, notes = read_files(arguments)
    for text in notes:
        note(text)
    config = offline_config(trajectories["parent"], trajectories["child"], options)
    snapshot = whole_snapshot(config, **trajectories)
    with waiting_for("solving"):
        calibration = snapshot.estimate()
    with waiting_for("checking the streams"):
        calibration, findings = with_findings(calibration, snapshot)
    inputs: dict[str, Any] = {"options": config.to_options()}
    for stream in STREAMS:
        inputs[stream] = {"file": str(getattr(arguments, stream)), **_extent(trajectories[stream])}
    if arguments.out:
        from hand_eye_calib.cli.replaying import fingerprints

        inputs["files"] = fingerprints(_files(arguments))
    return deliver(calibration, arguments, inputs, snapshot, findings=findings)


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
