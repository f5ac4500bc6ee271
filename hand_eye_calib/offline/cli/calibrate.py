"""``calibrate PATH ...``: calibrate from files, bags or journals.

Possible paths are: two trajectory files; a bag or its parts; the journal of a session; several
recordings; the stops of an arm; the files of three or more sensors. The command ``replay`` does the
same for bags and journals only.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.registry import (
    BESIDE_MOTION,
    RESULT_FILES,
    ROUTES,
    SEVERAL_RECORDINGS,
)
from hand_eye_calib.offline.beside_motion import switched_off
from hand_eye_calib.offline.cli import options
from hand_eye_calib.offline.cli.config_file import options_from
from hand_eye_calib.offline.cli.options import note, print_result, waiting_for
from hand_eye_calib.offline.cli.paths import directory, refuse_wrong_paths

if TYPE_CHECKING:
    from hand_eye_calib.core.base.plain import Document
    from hand_eye_calib.formats.bags.reader import PoseBag
    from hand_eye_calib.formats.remote import RestoreUrls

EXAMPLES = """\
examples:
  hand_eye_calib calibrate lidar.txt camera.txt --out result
  hand_eye_calib calibrate my_bag --list
  hand_eye_calib calibrate my_bag --parent-topic /lidar/odometry --child-topic /camera/odometry
  hand_eye_calib calibrate my_bag --parent-topic odom:lidar --child-topic /vio --out result
  hand_eye_calib calibrate gnss.csv slam.txt --time-offset estimate --prior z=1.85+/-0.02
  hand_eye_calib rig lidar.txt front.txt rear.txt --out rig
  hand_eye_calib calibrate monday/bag tuesday/bag wednesday/bag --out together
  hand_eye_calib batch 'fleet/**' --vehicle 'fleet/{vehicle}/' --out results
  hand_eye_calib arm samples.yaml --out arm
  hand_eye_calib arm hand.tum images/ --target charuco:5x7:0.04:0.03 --camera camera.yaml
  hand_eye_calib rig my_bag --topics /lidar/odometry /front/vio odom:rear --out rig
  hand_eye_calib replay live/journal --out result"""

# Short help that fits on one screen.
_BRIEF = """\
PATH:
  lidar.tum camera.tum          trajectory files of parent and child: TUM, KITTI, EuRoC, CSV
  my_bag                        a bag of ROS 2 or ROS 1 with two pose topics
  live/journal                  the journal of a session of the node
  samples.yaml                  the stops of an arm: MoveIt, easy_handeye2, OpenCV
  lidar.tum front.tum rear.tum  three sensors or more

most used options:
  --list                        show the topics of the bag, and exit
  --parent-topic, --child-topic TOPIC   pose topics of the bag, if it has more than two
  --start 12 --end 80           use a part, in seconds after both streams have poses
  --out DIR                     save the result, the files for ROS and report.html
  --time-offset estimate        the sensors' clocks differ
  --scale estimate              the child's lengths have no unit (a single camera)
  --prior z=1.85+/-0.02         a value that was measured by hand, in m (yaw=-90deg+/-2deg)
  --installed SOURCE            compare with a URDF, an earlier result or a bag's /tf_static
  --json                        print one JSON document

examples:
  hand_eye_calib calibrate lidar.tum camera.tum --out result
  hand_eye_calib calibrate my_bag --parent-topic /lidar/odometry --child-topic /camera/odometry
  hand_eye_calib calibrate gnss.csv slam.txt --time-offset estimate --prior z=1.85+/-0.02"""

# Format of a row in the table of topics: topic, type, count, rate, measured quantity and frames.
_ROW = "{:<32} {:<42} {:>8} {:>10}  {:<9}  {}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.set_defaults(brief=_BRIEF)
    parser.usage = "%(prog)s [OPTION ...] PATH ..."
    parser.epilog = EXAMPLES
    parser.set_defaults(parser=parser)
    options.add_input_arguments(
        parser,
        "trajectory files of the parent, the child and further sensors; or "
        "bags, the parts of one recording: a rosbag2 directory, a .mcap, "
        ".db3 or .bag file, or a URL such as s3://...; or the journal of a "
        "node's session, or its output directory",
    )
    add = parser.add_argument
    listing = (
        "print the bag's topics with types, counts, rates and frames, and exit"
    )
    add("--list", action="store_true", help=listing)
    options.add_config_arguments(parser)
    group = parser.add_argument_group("output")
    out = (
        "save the result in this directory: extrinsic.yaml, extrinsic.urdf.xacro, "
        "static_transform.launch.py and report.html"
    )
    group.add_argument("--out", metavar="DIR", type=directory, help=out)
    group.add_argument(
        "--label",
        metavar="NAME=VALUE",
        nargs="+",
        action="extend",
        default=[],
        type=_label,
        help="labels of the recording for the report and the files, such as vehicle=7 operator=Kim",
    )
    options.add_json_argument(group, or_verbose=True)
    for route in ROUTES.values():
        route.add_arguments(parser)
    for source in BESIDE_MOTION.values():
        source.add_arguments(parser)
    for file in RESULT_FILES.values():
        file.add_arguments(group)
    _add_installed(parser)


@options.argument_type
def _label(text: str) -> tuple[str, str]:
    """Return name and value of a label, from ``NAME=VALUE``."""
    name, sign, value = text.partition("=")
    if not (name and sign and value):
        raise ConfigError(
            f"expected NAME=VALUE, such as vehicle=7; got {text!r}"
        )
    return name, value


def _add_installed(parser: argparse.ArgumentParser) -> None:
    """Add the arguments about the extrinsic that is installed on the robot."""
    add = parser.add_argument_group("what is installed").add_argument
    installed = (
        "compare the result with this: a URDF, an earlier extrinsic.yaml, a file of another "
        'program, a bag with /tf_static, or "X Y Z ROLL PITCH YAW" in m and rad'
    )
    add("--installed", metavar="SOURCE", help=installed)
    base_frame = (
        "also print the child's pose in this frame, from the URDF of "
        "--installed or the bag's /tf_static"
    )
    add("--base-frame", metavar="FRAME", help=base_frame)


def _matching_paths(patterns: Sequence[Any]) -> list[Any]:
    """Return the paths that match patterns with ``*``; a URL (text) stays a text."""
    from hand_eye_calib.formats.bags.patterns import matching

    return [
        type(pattern)(match)
        for pattern in patterns
        for match in matching(str(pattern))
    ]


def _refuse_repeated_labels(labels: Sequence[str]) -> None:
    """Raise a ConfigError if the name of a label appears twice."""
    for name in labels:
        if labels.count(name) > 1:
            raise ConfigError(f"--label {name} was given twice; keep one")


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, and return the exit code."""
    is_batch = bool(getattr(arguments, "batch", None))
    if not (arguments.paths or is_batch):
        print(f"{arguments.parser.format_usage()}\n{EXAMPLES}", file=sys.stderr)
        return 2
    if is_batch and (arguments.paths or arguments.list):
        raise ConfigError("--batch cannot be combined with PATH or --list")
    _refuse_repeated_labels([name for name, _ in arguments.label])
    # The shell does not expand a pattern in quotes, or in a URL.
    if any("*" in str(path) for path in arguments.paths):
        arguments.paths = _matching_paths(arguments.paths)
    if not any("://" in str(path) for path in arguments.paths):
        return _run_locally(arguments, lambda value: value)
    from hand_eye_calib.formats.remote import local_copies

    with local_copies(arguments.paths) as (arguments.paths, with_urls):
        return _run_locally(arguments, with_urls)


def _run_locally(
    arguments: argparse.Namespace, with_urls: "RestoreUrls"
) -> int:
    """Calibrate from local files, and return the exit code.

    ``with_urls`` replaces the paths of downloaded copies by their URLs, in plain values.
    """
    refuse_wrong_paths(arguments.command, arguments.paths)
    # A route belongs to an extra, such as the stops of an arm. takes() raises a ConfigError for
    # arguments that exclude each other.
    routes = [route for route in ROUTES.values() if route.takes(arguments)]
    if arguments.list:
        return _list_topics(arguments, with_urls)
    if routes:
        _refuse_result_files(arguments)
        return routes[0].run(arguments, with_urls)
    from hand_eye_calib.offline.cli import reading
    from hand_eye_calib.offline.cli.present import deliver

    paths = arguments.paths
    are_bags = arguments.command == "replay" or reading.are_bags(paths)
    settings = options_from(arguments)
    if not are_bags:
        if len(paths) != len(options.STREAMS):
            raise ConfigError(
                f"expected the trajectory files of two sensors; got {len(paths)}"
            )
        options.refuse_options_of_bags(arguments)
        recording = reading.read_pair(arguments, settings)
    else:
        from hand_eye_calib.offline.cli import bags

        try:
            recording = bags.read_recording(
                paths,
                options.sources_from(arguments),
                settings,
                switched_off(vars(arguments)),
                reading.span_from(arguments),
            )
        except bags.SeveralRecordingsError as several:
            note(
                f"{several.reason}; all are used as recordings of one rig, and give one result"
            )
            _refuse_result_files(arguments)
            return SEVERAL_RECORDINGS["one rig"](arguments, several.groups)
    calibration = recording.solved(with_fingerprints=bool(arguments.out))
    calibration = dataclasses.replace(
        calibration, warnings=tuple(with_urls(calibration.warnings))
    )
    bag = paths[0] if are_bags else None
    return deliver(
        calibration,
        with_urls(recording.inputs),
        arguments,
        recording.snapshot,
        bag,
    )


def _refuse_result_files(arguments: argparse.Namespace) -> None:
    """Raise a ConfigError if a file is requested that only two streams have."""
    for name in RESULT_FILES:
        if getattr(arguments, name, None):
            raise ConfigError(
                f"--{name} applies to one recording of two sensors with poses; omit it"
            )


def _list_topics(
    arguments: argparse.Namespace, with_urls: "RestoreUrls"
) -> int:
    """Print the topics of a bag, and return the exit code.

    Columns include the mean rate over the whole bag, the quantity that the topic measures, and the
    frames of the first messages.
    """
    from hand_eye_calib.formats.bags.reader import PoseBag
    from hand_eye_calib.offline.cli import reading

    files = [path for path in arguments.paths if reading.is_plain_file(path)]
    if files:
        raise ConfigError(
            f"--list prints the topics of a bag; {files[0]} is a trajectory file, which has none. "
            "Omit --list"
        )
    with PoseBag(*arguments.paths) as bag, waiting_for(f"reading {bag}"):
        document: Document = {
            "bag": str(bag),
            "start_ns": bag.start_ns,
            "end_ns": bag.end_ns,
            "duration_s": bag.duration_s,
            "topics": _described_topics(bag),
            "warnings": bag.warnings,
        }
    document = with_urls(document)
    note(*document["warnings"])
    print_result(
        _table_of_topics(document), document if arguments.json else None
    )
    return 0


def _described_topics(bag: "PoseBag") -> list["Document"]:
    """Return a row for each topic of a bag, as plain values."""
    from hand_eye_calib.formats.bags.messages import (
        MESSAGE_TYPES,
        quantities_of_types,
    )

    quantities = quantities_of_types()
    measured: dict[str, tuple[str, str]] = {}
    for source in BESIDE_MOTION.values():
        measured |= source.topics(bag)
    rows = []
    for topic in bag.topics.values():
        beside_motion, frame = measured.get(topic.name, ("", ""))
        rate_hz = None
        if topic.count > 1:
            rate_hz = (topic.count - 1) / (bag.duration_s or 1.0)
        frames = bag.edges_on(topic.name)
        if not frames:
            frames = _sensor_frames(bag, topic.name, frame)
        rows.append(
            {
                **topic._asdict(),
                "rate_hz": rate_hz,
                "frames": frames,
                "is_usable": topic.type in MESSAGE_TYPES,
                "quantity": quantities.get(topic.type, ""),
                "measures": beside_motion,
            }
        )
    return rows


def _table_of_topics(document: "Document") -> list[str]:
    """Return the lines of the table of topics, followed by advice."""
    lines = [f"{document['bag']}, {document['duration_s']:.1f} s"]
    lines.append(
        _ROW.format("topic", "type", "count", "rate", "measures", "frames")
    )
    for row in document["topics"]:
        cells = [
            row["name"],
            row["type"] or "several types",
            row["count"],
            "" if row["rate_hz"] is None else f"{row['rate_hz']:.1f} Hz",
            row["quantity"],
            " ".join(row["frames"]),
        ]
        lines.append(_ROW.format(*cells).rstrip())
    advice = advice_on_topics(document["topics"])
    others = _other_streams(document["topics"])
    if others:
        advice += "; the other stream may be:"
    return [*lines, advice, *others]


def advice_on_topics(rows: "Sequence[Document]") -> str:
    """Return the advice below the table of topics."""
    if not any(row["count"] for row in rows):
        return "the bag has no messages: record again"
    quantities = {row["quantity"] for row in rows}
    if "poses" in quantities:
        advice = "--parent-topic and --child-topic accept a topic with poses"
    elif quantities & {"frames", "points"}:
        advice = "no topic has poses; --parent-topic and --child-topic accept"
        if "points" in quantities:
            return f"{advice} points of lidars, whose odometry is computed"
    else:
        return "no topic has poses: run the odometry or SLAM of both sensors, and record it"
    if "frames" in quantities:
        advice += ", or frames of /tf: odom:lidar"
    return advice.replace("accept, or", "accept")


def _other_streams(rows: "Sequence[Document]") -> list[str]:
    """Return lines about the topics without poses that can be the other stream.

    The list is empty if no topic has poses.
    """
    from hand_eye_calib.formats.bags.choice import TopicInfo, other_streams

    rows_with_poses = [row for row in rows if row["quantity"] == "poses"]
    if not rows_with_poses:
        return []
    frames: set[str] = set()
    for row in rows_with_poses:
        frames |= {*row["frames"]}
    topics = [TopicInfo(row["name"], row["type"], row["count"]) for row in rows]
    of_own_frame = {
        row["name"] for row in rows if frames.isdisjoint(row["frames"])
    }
    return other_streams(topics, of_own_frame)


def _sensor_frames(bag: "PoseBag", topic: str, frame: str) -> list[str]:
    """Return the sensor's frame of a topic in a list; empty if no message names a frame.

    ``frame`` is the frame if it is already known; otherwise empty.
    """
    # The other topics must be listed in spite of a damaged message.
    with suppress(InputError):
        frame = frame or bag.sensor_frame(topic)
    return [frame] if frame else []
