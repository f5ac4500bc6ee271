"""``replay BAG`` and ``replay JOURNAL``: feed what was recorded to the engine in its order."""

import argparse
import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_eye_calib.cli.console import note, print_table, waiting_for
from hand_eye_calib.cli.options import (
    add_config_arguments,
    add_output_arguments,
    argument_type,
    at_least,
    config_from,
    offer,
    options_from,
)
from hand_eye_calib.cli.robot import add_robot_arguments
from hand_eye_calib.errors import ConfigError, HandEyeCalibError, printable

if TYPE_CHECKING:
    from hand_eye_calib.cli.replaying import Replayed
    from hand_eye_calib.io.remote import AsGiven
    from hand_eye_calib.io.transforms import TfSource

EXAMPLES = """\
examples:
  hand_eye_calib replay my_bag --list
  hand_eye_calib replay my_bag --parent-topic /lidar/odometry --child-topic /camera/odometry
  hand_eye_calib replay my_bag --topics /lidar/odometry /front/vio odom:rear --out rig
  hand_eye_calib replay my_bag --parent-tf odom:lidar --child-topic /vio --out result
  hand_eye_calib replay live/journal --out result
  hand_eye_calib replay monday_1.mcap monday_2.mcap --time-offset estimate --every 5s"""

_UNITS_S = {"": 1.0, "s": 1.0, "ms": 1e-3, "min": 60.0}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = EXAMPLES
    parser.add_argument(
        "bags",
        metavar="BAG",
        nargs="*",
        type=_bag,
        help="rosbag2 directory, .mcap, .db3 or .bag file, or the URL of one, as s3://...; several "
        "are the parts of one recording. "
        "Or the journal of a node's session, or the output directory that holds it",
    )
    _add_stream_arguments(parser)
    parser.add_argument(
        "--list",
        action="store_true",
        help="show the bag's topics with types, counts, rates and frames, and exit",
    )
    parser.add_argument(
        "--every",
        metavar="DURATION",
        type=_duration_s,
        help="also estimate after every such period of bag time, for example 5s",
    )
    _add_batch_arguments(parser)
    add_config_arguments(parser)
    add_output_arguments(parser)
    add_robot_arguments(parser)


def _add_stream_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group(
        "pose streams",
        "Odometry, PoseStamped, PoseWithCovarianceStamped, TransformStamped or Path; may be left "
        "out if the bag has only two",
    )
    for stream in ("parent", "child"):
        source = group.add_mutually_exclusive_group()
        topic = source.add_argument(
            f"--{stream}-topic",
            metavar="TOPIC",
            help=f"poses of the {stream} sensor, of any type",
        )
        offer(topic, _topics_of)
        source.add_argument(
            f"--{stream}-tf",
            metavar="WORLD:SENSOR",
            type=_tf_source,
            help="the same from /tf and /tf_static: fixed frame and the sensor's, as odom:lidar",
        )
    several = group.add_argument(
        "--topics",
        metavar="TOPIC",
        nargs="+",
        help="poses of three sensors or more, or frames as odom:lidar: all are solved together, in "
        "the frame of the first",
    )
    offer(several, _topics_of)


def _topics_of(typed: argparse.Namespace) -> list[str]:
    """Topics of a bag with poses; none if it cannot be read."""
    from hand_eye_calib.io.bags import PoseBag
    from hand_eye_calib.io.bags.messages import SENSOR_TYPES

    try:
        with PoseBag(*typed.bags) as bag:
            return [topic.name for topic in bag.topics() if topic.type in SENSOR_TYPES]
    except HandEyeCalibError:
        return []


def _add_batch_arguments(parser: argparse.ArgumentParser) -> None:
    batch = parser.add_argument_group("many recordings")
    batch.add_argument(
        "--batch",
        metavar="FILE",
        type=Path,
        help="YAML file with a list of bags, each with its own options",
    )
    batch.add_argument(
        "--jobs",
        metavar="N",
        type=at_least(1),
        help="number of worker processes. Default: one for each core",
    )
    batch.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="use a Dask cluster instead: address of its scheduler, tcp://...",
    )


def run(arguments: argparse.Namespace) -> int:
    """Calibrate from a bag; returns the exit code."""
    _check_usage(arguments)
    if arguments.batch:
        from hand_eye_calib.cli.batch.run import run_batch

        return run_batch(arguments)
    from hand_eye_calib.io.remote import local_copies

    with local_copies(arguments.bags) as (arguments.bags, as_given):
        return _run_here(arguments, as_given)


def _run_here(arguments: argparse.Namespace, as_given: "AsGiven") -> int:
    """Calibrate from bags on this machine; ``as_given`` puts their URLs back into texts.

    Returns the exit code.
    """
    if arguments.list:
        return _list_bag(arguments.bags, arguments.json, as_given)

    if arguments.topics:
        from hand_eye_calib.cli.rig import calibrate_bag

        return calibrate_bag(arguments, as_given)

    from hand_eye_calib.cli.present import deliver
    from hand_eye_calib.cli.replaying import fingerprints
    from hand_eye_calib.engine.run import review

    replayed = _replayed(arguments)
    if arguments.out:
        replayed.inputs["files"] = fingerprints(replayed.files)
    more = {"convergence": replayed.convergence} if arguments.every else {}
    snapshot = replayed.calibrator.snapshot()
    with waiting_for("checking the streams"):
        found = review(replayed.calibration, snapshot)
    calibration, snapshot = found.calibration, found.snapshot
    calibration = replace(calibration, warnings=tuple(as_given(calibration.warnings)))
    inputs = as_given(replayed.inputs) | {"options": snapshot.config.to_options()}
    return deliver(calibration, arguments, inputs, snapshot, **more)


def _replayed(arguments: argparse.Namespace) -> "Replayed":
    """What came out of the bags, or of the journal."""
    from hand_eye_calib.cli.replaying import journal_in, replay, replay_journal

    parent = arguments.parent_topic or arguments.parent_tf
    child = arguments.child_topic or arguments.child_tf
    journal = journal_in(arguments.bags)
    if journal is None:
        return replay(arguments.bags, parent, child, config_from(arguments), arguments.every)
    if parent or child or arguments.every:
        raise ConfigError(
            f"{journal} is the journal of a session, which has two streams; it cannot be combined "
            "with topics, frames or --every"
        )
    return replay_journal(journal, options_from(arguments))


def _list_bag(paths: Sequence[Path], as_json: bool, as_given: "AsGiven") -> int:
    """Print the topics of a bag; returns the exit code."""
    from hand_eye_calib.io.bags import PoseBag

    with PoseBag(*paths) as bag:
        with waiting_for(f"reading {bag}"):
            topics = bag.describe()
        document: dict[str, Any] = {
            "bag": as_given(str(bag)),
            "start_ns": bag.start_ns,
            "end_ns": bag.end_ns,
            "duration_s": bag.duration_s,
            "topics": [topic._asdict() for topic in topics],
            "warnings": as_given(bag.warnings),
        }
    for text in document["warnings"]:
        note(text)
    if as_json:
        print(json.dumps(document, indent=2))
    else:
        _print_topics(document, topics)
    return 0


def _print_topics(document: dict[str, Any], topics: Sequence[Any]) -> None:
    from rich import box
    from rich.table import Table

    if not topics:
        print(f"{document['bag']} has no topics")
        return
    title = f"{document['bag']}, {document['duration_s']:.1f} s"
    table = Table(title=title, box=box.SIMPLE, title_justify="left", pad_edge=False)
    for heading in ("topic", "type"):
        table.add_column(heading, overflow="fold")
    for heading in ("count", "rate", "duration"):
        table.add_column(heading, justify="right", overflow="fold")
    table.add_column("frames", overflow="fold")
    for topic in topics:
        table.add_row(*_cells(topic), style="bold" if topic.is_usable else None)
    print_table(table)
    if any(topic.is_usable for topic in topics):
        print(
            "Poses: --parent-topic and --child-topic take the topics in bold, --parent-tf and "
            "--child-tf frames of /tf: odom:lidar"
        )


def _cells(topic: Any) -> list[str]:
    return [
        printable(topic.name),
        topic.type or "several types",
        str(topic.count),
        "" if topic.rate_hz is None else f"{topic.rate_hz:.1f} Hz",
        "" if topic.duration_s is None else f"{topic.duration_s:.1f} s",
        "\n".join(printable(frame) for frame in topic.frames),
    ]


def _check_usage(arguments: argparse.Namespace) -> None:
    if arguments.batch and (arguments.bags or arguments.list or arguments.every):
        raise ConfigError("--batch cannot be combined with BAG, --list or --every")
    if not arguments.batch and (arguments.jobs or arguments.dask):
        raise ConfigError("--jobs and --dask are for --batch")
    if arguments.topics:
        named = [f"{each}_{kind}" for each in ("parent", "child") for kind in ("topic", "tf")]
        others = [name for name in (*named, "batch", "list", "every") if getattr(arguments, name)]
        if others:
            raise ConfigError(f"--topics and --{others[0].replace('_', '-')} do not go together")
    if not arguments.batch and not arguments.bags:
        raise ConfigError("the following arguments are required: BAG, or --batch FILE")


def _bag(text: str) -> Path | str:
    """A path; a URL stays as it is, for a path has no two slashes in a row."""
    from hand_eye_calib.io.remote import is_url

    return text if is_url(text) else Path(text)


@argument_type
def _tf_source(text: str) -> "TfSource":
    from hand_eye_calib.io.transforms import TfSource

    return TfSource.parse(text)


@argument_type
def _duration_s(text: str) -> float:
    match = re.fullmatch(r"([0-9]*\.?[0-9]+)\s*(s|ms|min|)", text)
    if not match or not float(match[1]):
        raise ConfigError(f"expected a duration such as 5s, 500ms or 1min; got {text!r}")
    return float(match[1]) * _UNITS_S[match[2]]
