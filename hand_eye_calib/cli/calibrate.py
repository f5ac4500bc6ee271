"""``calibrate PATH ...``: two trajectory files, a bag or the parts of one, or the journal of a
session; several recordings; the stops of an arm; three sensors or more. ``replay`` is its other
name, for bags and journals alone.
"""

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from hand_eye_calib.cli import options
from hand_eye_calib.cli.options import note, print_result, waiting_for
from hand_eye_calib.errors import ConfigError

if TYPE_CHECKING:
    from hand_eye_calib.io.remote import AsGiven
    from hand_eye_calib.plain import Document

EXAMPLES = """\
examples:
  hand_eye_calib calibrate lidar.txt camera.txt --out result
  hand_eye_calib calibrate my_bag --list
  hand_eye_calib calibrate my_bag --parent-topic /lidar/odometry --child-topic /camera/odometry
  hand_eye_calib calibrate my_bag --parent-topic odom:lidar --child-topic /vio --out result
  hand_eye_calib calibrate gnss.csv slam.txt --time-offset estimate --prior z=1.85+/-0.02
  hand_eye_calib calibrate lidar.txt front.txt rear.txt --out rig
  hand_eye_calib calibrate monday/bag tuesday/bag wednesday/bag --out together
  hand_eye_calib calibrate --batch 'fleet/**' --vehicle 'fleet/{vehicle}/' --out results
  hand_eye_calib calibrate samples.yaml --out arm
  hand_eye_calib calibrate hand.tum images/ --target charuco:5x7:0.04:0.03 --camera camera.yaml
  hand_eye_calib replay my_bag --topics /lidar/odometry /front/vio odom:rear --out rig
  hand_eye_calib replay live/journal --out result"""

# Files of an arm's samples.
_SAMPLES = (".json", ".yaml", ".yml", ".samples", ".npz")
# Of the table of topics.
_ROW = "{:<32} {:<42} {:>8} {:>10}  {:<5}  {}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.usage = "%(prog)s [OPTION ...] PATH ..."
    parser.epilog = EXAMPLES
    parser.set_defaults(parser=parser)
    options.add_input_arguments(
        parser,
        "trajectory files of parent and child, and of more sensors; or a rosbag2 directory, .mcap, "
        ".db3 or .bag file, or the URL of one, as s3://..., of which several are the parts of one "
        "recording; or the journal of a node's session, or the output directory that holds it",
    )
    add = parser.add_argument
    topics = (
        "poses of three sensors or more, or frames as odom:lidar: all are solved together, in the "
        "frame of the first"
    )
    add("--topics", metavar="TOPIC", nargs="+", help=topics)
    listing = "show the bag's topics with types, counts, rates and frames, and exit"
    add("--list", action="store_true", help=listing)
    order = (
        "none: the poses of two files are stops without an order, paired by their rows. So are the "
        "samples of an arm (MoveIt, easy_handeye2, OpenCV, .npz), given as the only PATH"
    )
    add("--order", choices=("time", "none"), default="time", help=order)
    options.add_config_arguments(parser)
    group = parser.add_argument_group("output")
    out = (
        "save the result in this directory: extrinsic.yaml, extrinsic.urdf.xacro, "
        "static_transform.launch.py and report.html"
    )
    group.add_argument("--out", metavar="DIR", type=Path, help=out)
    group.add_argument(
        "--label",
        metavar="NAME=VALUE",
        nargs="+",
        action="extend",
        default=[],
        type=_label,
        help="what the report and the files say of the recording, such as vehicle=7 operator=Kim",
    )
    options.add_json_argument(group, or_verbose=True)
    _add_rare(parser)


@options.argument_type
def _label(text: str) -> tuple[str, str]:
    name, sign, value = text.partition("=")
    if not (name and sign and value):
        raise ConfigError(f"expected NAME=VALUE, such as vehicle=7; got {text!r}")
    return name, value


def _add_rare(parser: argparse.ArgumentParser) -> None:
    """Declare what is about images of a target, many recordings, and what is installed."""
    add = parser.add_argument_group("images of a target").add_argument
    target = (
        "what the images of --child-topic show, or those of a folder, the second PATH, one for "
        "each pose of a hand: such as "
        "charuco:5x7:0.04:0.03:4X4_50 (squares, side of a square and of a marker in m, markers) or "
        "aprilgrid:6x6:0.088:0.0264 (tags, side of a tag, gap)"
    )
    add("--target", metavar="TARGET", help=target)
    camera = "intrinsics: YAML of camera_info, Kalibr or OpenCV; a bag may have its own camera_info"
    add("--camera", metavar="FILE", type=Path, help=camera)
    add = parser.add_argument_group("many recordings").add_argument
    batch = "bags, folders of bags, or patterns of bags in quotes, such as 'fleet/*/drive'"
    add("--batch", metavar="BAG", nargs="+", help=batch)
    vehicle = (
        "the vehicle's name, or its place in the paths of --batch, such as 'fleet/{vehicle}/*': "
        "recordings of one vehicle are put together"
    )
    add("--vehicle", metavar="PATTERN", help=vehicle)
    no_report = "no page for each recording: they take most time"
    add("--no-report", action="store_true", help=no_report)
    jobs = "number of worker processes. Default: one for each core"
    add("--jobs", metavar="N", type=options.at_least(1), help=jobs)
    dask = "use a Dask cluster instead: address of its scheduler, tcp://..."
    add("--dask", metavar="ADDRESS", help=dask)
    add = parser.add_argument_group("what is installed").add_argument
    installed = (
        "compare the result with this: a URDF, an earlier extrinsic.yaml, a file of another "
        'program, a bag with /tf_static, or "X Y Z ROLL PITCH YAW" in m and rad'
    )
    add("--installed", metavar="SOURCE", help=installed)
    base_frame = (
        "state the child's pose in this frame too, as the URDF of --installed or the bag's "
        "/tf_static has it"
    )
    add("--base-frame", metavar="FRAME", help=base_frame)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate; returns the exit code."""
    if not (arguments.paths or arguments.batch):
        print(f"{arguments.parser.format_usage()}\n{EXAMPLES}", file=sys.stderr)
        return 2
    if arguments.batch and (arguments.paths or arguments.list):
        raise ConfigError("--batch cannot be combined with PATH or --list")
    if not arguments.batch and (arguments.dask or arguments.vehicle):
        raise ConfigError("--dask and --vehicle are for --batch")
    if not arguments.child_topic and bool(arguments.target) != bool(arguments.camera):
        raise ConfigError("--target and --camera go together: a target and a camera's intrinsics")
    never = ("parent_topic", "child_topic", "batch", "list")
    others = [name for name in never if getattr(arguments, name)]
    if arguments.topics and others:
        raise ConfigError(f"--topics and --{others[0].replace('_', '-')} do not go together")
    if arguments.batch:
        from hand_eye_calib.cli.batch.run import run_batch

        return run_batch(arguments)
    if any("*" in str(path) for path in arguments.paths):
        from hand_eye_calib.cli.batch.work import matching

        arguments.paths = [
            type(path)(found) for path in arguments.paths for found in matching(str(path))
        ]
    if not any("://" in str(path) for path in arguments.paths):
        return _run_here(arguments, lambda value: value)
    from hand_eye_calib.io.remote import local_copies

    with local_copies(arguments.paths) as (arguments.paths, as_given):
        return _run_here(arguments, as_given)


def _run_here(arguments: argparse.Namespace, as_given: "AsGiven") -> int:
    """Calibrate from files here; ``as_given`` puts URLs back into texts. Returns the exit code."""
    if arguments.list:
        return _list_topics(arguments, as_given)
    from hand_eye_calib.cli import reading
    from hand_eye_calib.cli.present import deliver

    paths = arguments.paths
    are_images = arguments.target and not arguments.child_topic
    are_samples = len(paths) == 1 and paths[0].suffix in _SAMPLES
    if are_samples or are_images or arguments.order == "none":
        from hand_eye_calib.cli import stops

        options.refuse_stamps(arguments)
        return deliver(*stops.solved(arguments), arguments)
    are_bags = arguments.command == "replay" or reading.are_bags(paths)
    if arguments.topics or (len(paths) > 2 and not are_bags):
        from hand_eye_calib.cli.rig import calibrate_rig

        return calibrate_rig(arguments, as_given)
    given = options.options_from(arguments)
    if not are_bags:
        options.refuse_stamps(arguments)
        recording = reading.read_pair(arguments, given)
    else:
        from hand_eye_calib.cli import bags

        try:
            recording = bags.read_recording(paths, options.sources_from(arguments), given)
        except bags.SeveralRecordingsError as several:
            from hand_eye_calib.cli.batch.run import run_together

            note(f"{several.reason}; they give one result, as recordings of one rig")
            return run_together(arguments, several.groups)
    calibration = recording.solved(with_fingerprints=bool(arguments.out))
    calibration = dataclasses.replace(calibration, warnings=tuple(as_given(calibration.warnings)))
    bag = paths[0] if are_bags else None
    return deliver(calibration, as_given(recording.inputs), arguments, recording.snapshot, bag)


def _list_topics(arguments: argparse.Namespace, as_given: "AsGiven") -> int:
    """Print the topics of a bag, with the rate in the bag's time, the frames of the first messages,
    and whether one can be one of the two sensors; returns the exit code.
    """
    from hand_eye_calib.io.bags.messages import MESSAGE_TYPES
    from hand_eye_calib.io.bags.reader import PoseBag

    with PoseBag(*arguments.paths) as bag, waiting_for(f"reading {bag}"):
        topics = [
            {
                **each._asdict(),
                "rate_hz": (each.count - 1) / (bag.duration_s or 1.0) if each.count > 1 else None,
                "frames": bag.edges_on(each.name),
                "is_usable": each.type in MESSAGE_TYPES,
            }
            for each in bag.topics.values()
        ]
        document: Document = {"bag": str(bag), "start_ns": bag.start_ns, "end_ns": bag.end_ns}
        document |= {"duration_s": bag.duration_s, "topics": topics, "warnings": bag.warnings}
    document = as_given(document)
    note(*document["warnings"])
    lines = [f"{document['bag']}, {document['duration_s']:.1f} s"]
    lines.append(_ROW.format("topic", "type", "count", "rate", "poses", "frames"))
    for topic in topics:
        rate = "" if topic["rate_hz"] is None else f"{topic['rate_hz']:.1f} Hz"
        cells = (topic["name"], topic["type"] or "several types", topic["count"], rate)
        usable, frames = "yes" * topic["is_usable"], " ".join(topic["frames"])
        lines.append(_ROW.format(*cells, usable, frames).rstrip())
    lines.append(
        "--parent-topic and --child-topic take the topics with poses, or frames of /tf: odom:lidar"
    )
    print_result(lines, document if arguments.json else None)
    return 0
