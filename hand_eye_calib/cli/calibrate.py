"""``calibrate PARENT CHILD``: two trajectory files."""

from pathlib import Path

from hand_eye_calib.cli.console import note, waiting_for
from hand_eye_calib.cli.options import add_config_arguments, add_output_arguments, options_from
from hand_eye_calib.config import STAMP_UNITS, TRAJECTORY_FORMATS

STREAMS = ("parent", "child")
_FILE_OPTIONS = {
    "format": dict(choices=TRAJECTORY_FORMATS, help="tum: t x y z qx qy qz qw; kitti: 12 numbers, with --times; euroc: ns, qw first; csv: columns by "
                   "the names in the header, or with --columns. Default: tum"),
    "columns": dict(metavar="NAMES", help="names of the columns of a csv file without a header: t,x,y,z,qw,qx,qy,qz in their order"),
    "times": dict(metavar="FILE", type=Path, help="stamps of the poses of a kitti file, one a line"),
    "stamp_unit": dict(choices=tuple(STAMP_UNITS), help="unit of the stamps. Default: recognised from their size"),
}  # fmt: skip


def add_arguments(parser):
    """Declare the command's arguments."""
    parser.add_argument("parent", metavar="PARENT", help="trajectory of the parent sensor")
    parser.add_argument("child", metavar="CHILD", help="trajectory of the child sensor")
    add_file_arguments(parser)
    add_config_arguments(parser)
    add_output_arguments(parser)


def add_file_arguments(parser):
    """Add the options that say how trajectory files are to be read: for both, and for each."""
    group = parser.add_argument_group(
        "trajectory files", "each also as --parent-... and --child-... for one of the two"
    )
    for name, settings in _FILE_OPTIONS.items():
        group.add_argument(f"--{name.replace('_', '-')}", dest=name, **settings)
        for stream in STREAMS:
            kind = {key: value for key, value in settings.items() if key != "help"} | {
                "help": f"the same for {stream.upper()} alone"
            }
            group.add_argument(
                f"--{stream}-{name.replace('_', '-')}", dest=f"{stream}_{name}", **kind
            )
    group.add_argument(
        "--repair-stamps",
        action="store_true",
        help="sort poses that are out of order and drop those with a stamp that is there already, instead of refusing the file",
    )


def read_files(arguments):
    """The trajectories of both files, by stream, as :func:`add_file_arguments` says they are to be
    read.

    Returns
    -------
    trajectories : dict
        "parent" and "child" to Trajectory.
    notes : list of str
        What had to be repaired.

    Raises
    ------
    HandEyeCalibError
        Where a file cannot be read.
    """
    from hand_eye_calib.io.trajectory_files import read_trajectory_file

    trajectories, notes = {}, []
    for stream in STREAMS:
        given = {
            name: getattr(arguments, f"{stream}_{name}") or getattr(arguments, name)
            for name in _FILE_OPTIONS
        }
        file_format = given.pop("format") or "tum"
        # A setting for both files is for those of them that are of its format.
        for name, belongs_to in (("columns", "csv"), ("times", "kitti")):
            if (
                file_format != belongs_to
                and not getattr(arguments, f"{stream}_{name}")
                and _is_of_other(arguments, stream, belongs_to)
            ):
                given[name] = None
        trajectories[stream], repaired = read_trajectory_file(
            getattr(arguments, stream), file_format, repair=arguments.repair_stamps, **given
        )
        notes += repaired
    return trajectories, notes


def _is_of_other(arguments, stream, file_format):
    """Whether the other file is of this format."""
    other = STREAMS[1 - STREAMS.index(stream)]
    return (getattr(arguments, f"{other}_format") or arguments.format) == file_format


def run(arguments):
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
    with waiting_for("checking"):
        calibration, findings = with_findings(calibration, snapshot)
    inputs = {"options": config.to_options()}
    for stream in STREAMS:
        inputs[stream] = {"file": str(getattr(arguments, stream)), **_extent(trajectories[stream])}
    if arguments.out:
        from hand_eye_calib.cli.replaying import fingerprints

        files = [getattr(arguments, stream) for stream in STREAMS]
        files += [
            times
            for times in (arguments.times, arguments.parent_times, arguments.child_times)
            if times
        ]
        inputs["files"] = fingerprints(files)
    return deliver(calibration, arguments, inputs, snapshot, findings=findings)


def _extent(trajectory):
    return {
        "poses": len(trajectory),
        "first_stamp_ns": int(trajectory.stamps_ns[0]),
        "last_stamp_ns": int(trajectory.stamps_ns[-1]),
    }
