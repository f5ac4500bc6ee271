"""``replay BAG`` and ``replay JOURNAL``: feed what was recorded to the engine in its order."""

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING

from hand_eye_calib.cli.completion import offer, topics_of
from hand_eye_calib.cli.console import waiting_for
from hand_eye_calib.cli.options import (
    add_config_arguments,
    add_output_arguments,
    config_from,
    options_from,
)
from hand_eye_calib.cli.parser import advanced
from hand_eye_calib.cli.robot import add_robot_arguments
from hand_eye_calib.errors import ConfigError

if TYPE_CHECKING:
    from hand_eye_calib.cli.replaying import Replayed
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
        type=Path,
        help="rosbag2 directory, .mcap, .db3 or .bag file; several are the parts of one recording. "
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
        offer(topic, lambda typed: topics_of(typed.bags))
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
    offer(several, lambda typed: topics_of(typed.bags))


def _add_batch_arguments(parser: argparse.ArgumentParser) -> None:
    batch = parser.add_argument_group("many recordings")
    batch.add_argument(
        "--batch",
        metavar="FILE",
        type=Path,
        help="YAML file with a list of bags, each with its own options",
    )
    jobs = batch.add_argument(
        "--jobs",
        metavar="N",
        type=_positive,
        help="number of worker processes. Default: one for each core",
    )
    dask = batch.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="use a Dask cluster instead: address of its scheduler, tcp://...",
    )
    advanced(jobs)
    advanced(dask)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate from a bag; returns the exit code."""
    _check_usage(arguments)
    if arguments.batch:
        from hand_eye_calib.cli.batch import run_batch

        return run_batch(arguments)
    if arguments.list:
        from hand_eye_calib.cli.listing import list_bag

        return list_bag(arguments.bags, arguments.json)

    if arguments.topics:
        from hand_eye_calib.cli.rig import calibrate_bag

        return calibrate_bag(arguments)

    from hand_eye_calib.cli.memory import prepare_to_solve

    prepare_to_solve()
    from hand_eye_calib.cli.options import options_from
    from hand_eye_calib.cli.present import deliver
    from hand_eye_calib.cli.replaying import fingerprints
    from hand_eye_calib.engine.checked import checked

    replayed = _replayed(arguments)
    if arguments.out:
        replayed.inputs["files"] = fingerprints(replayed.files)
    more = {"convergence": replayed.convergence} if arguments.every else {}
    snapshot = replayed.calibrator.snapshot()
    with waiting_for("checking the streams"):
        calibration, snapshot = checked(replayed.calibration, snapshot, options_from(arguments))
    inputs = replayed.inputs | {"options": snapshot.config.to_options()}
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
            f"{journal} is the journal of a session, which has its two streams: no topics, frames "
            "or --every go with it"
        )
    return replay_journal(journal, options_from(arguments))


def _check_usage(arguments: argparse.Namespace) -> None:
    if arguments.batch and (arguments.bags or arguments.list or arguments.every):
        raise ConfigError(
            "--batch names its bags in its file: no BAG, --list or --every goes with it"
        )
    if not arguments.batch and (arguments.jobs or arguments.dask):
        raise ConfigError("--jobs and --dask are for --batch")
    if arguments.topics:
        named = [f"{each}_{kind}" for each in ("parent", "child") for kind in ("topic", "tf")]
        others = [name for name in (*named, "batch", "list", "every") if getattr(arguments, name)]
        if others:
            raise ConfigError(f"--topics and --{others[0].replace('_', '-')} do not go together")
    if not arguments.batch and not arguments.bags:
        raise ConfigError("the following arguments are required: BAG, or --batch FILE")


def _tf_source(text: str) -> "TfSource":
    from hand_eye_calib.io.transforms import TfSource

    try:
        return TfSource.parse(text)
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _duration_s(text: str) -> float:
    match = re.fullmatch(r"([0-9]*\.?[0-9]+)\s*(s|ms|min|)", text)
    if not match or not float(match[1]):
        raise argparse.ArgumentTypeError(
            f"expected a duration such as 5s, 500ms or 1min; got {text!r}"
        )
    return float(match[1]) * _UNITS_S[match[2]]


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, got {text!r}")
    return int(text)
