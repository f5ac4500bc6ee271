"""``replay BAG``: feed the messages of a bag to the engine in the order they were recorded."""

import argparse
import dataclasses
import re
from contextlib import nullcontext
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path

from hand_eye_calib.calibration import Calibration
from hand_eye_calib.calibrator import Calibrator
from hand_eye_calib.cli.console import note, waiting_for, with_progress
from hand_eye_calib.cli.findings import with_findings
from hand_eye_calib.cli.options import add_config_arguments, add_output_arguments, config_from
from hand_eye_calib.cli.present import convergence_line, deliver
from hand_eye_calib.errors import ConfigError, InputError, NotEnoughDataError

_NS_PER_S = 1_000_000_000
_UNITS_S = {"": 1.0, "s": 1.0, "ms": 1e-3, "min": 60.0}


def add_arguments(parser):
    """Declare the command's arguments."""
    parser.add_argument(
        "bags",
        metavar="BAG",
        nargs="*",
        type=Path,
        help="rosbag2 directory, .mcap or .db3 file of one, or rosbag1 .bag file; several are the parts of one drive",
    )
    for stream in ("parent", "child"):
        source = parser.add_mutually_exclusive_group()
        source.add_argument(
            f"--{stream}-topic",
            metavar="TOPIC",
            help=f"poses of the {stream} sensor: Odometry, PoseStamped, PoseWithCovarianceStamped, TransformStamped or Path",
        )
        source.add_argument(
            f"--{stream}-tf",
            metavar="WORLD:SENSOR",
            type=_tf_source,
            help=f"poses of the {stream} sensor from /tf and /tf_static: its frame, and the fixed one, such as odom:lidar",
        )
    parser.add_argument(
        "--list", action="store_true", help="show what is in the bag - topics, types, counts, rates, frames - and end"
    )
    parser.add_argument(
        "--every",
        metavar="DURATION",
        type=_duration_s,
        help="estimate every so much bag time as well, such as 5s, and show how the estimate converges",
    )
    batch = parser.add_argument_group("many bags")
    batch.add_argument("--batch", metavar="FILE", type=Path, help="YAML file with a list of bags, each with options of its own")
    batch.add_argument("--jobs", metavar="N", type=_positive, help="processes that work on it. Default: one for each core")
    batch.add_argument(
        "--dask", metavar="ADDRESS", help="work on it on a Dask cluster instead: address of its scheduler, tcp://..."
    )
    add_config_arguments(parser)
    add_output_arguments(parser)


def run(arguments):
    """Calibrate from a bag; returns the exit code."""
    _check_usage(arguments)
    if arguments.batch:
        from hand_eye_calib.cli.batch import run_batch

        return run_batch(arguments)
    if arguments.list:
        from hand_eye_calib.cli.listing import list_bag

        return list_bag(arguments.bags, arguments.json)
    replayed = replay(
        arguments.bags,
        arguments.parent_topic or arguments.parent_tf,
        arguments.child_topic or arguments.child_tf,
        config_from(arguments),
        arguments.every,
    )
    if arguments.out:
        replayed.inputs["files"] = fingerprints(replayed.files)
    more = {"convergence": replayed.convergence} if arguments.every else {}
    snapshot = replayed.calibrator.snapshot()
    with waiting_for("checking"):
        calibration, findings = with_findings(replayed.calibration, snapshot.parent, snapshot.child, snapshot.config.max_gap)
    return deliver(calibration, arguments, replayed.inputs, snapshot, findings=findings, **more)


@dataclass
class Replayed:
    """What came out of a bag.

    Attributes
    ----------
    calibration : Calibration
    inputs : dict
        Where the data came from, in plain values.
    files : list of pathlib.Path
        The files that were read.
    convergence : list of dict
        Estimates on the way, in plain values.
    calibrator : Calibrator
        The engine, with all poses.
    """

    calibration: Calibration
    inputs: dict
    files: list
    convergence: list = field(default_factory=list)
    calibrator: Calibrator | None = None


def replay(paths, parent, child, config, every_s=None, quiet=False):
    """Calibrate from one bag, or from several of one drive.

    Parameters
    ----------
    paths : list of path-like
    parent, child : str, TfSource or None
        Topic or pair of frames; chosen where the bag leaves no choice.
    config : CalibratorConfig
    every_s : float, optional
        Bag time between estimates on the way.
    quiet : bool
        Say nothing on stderr; what there is to say of the data is among the calibration's warnings anyway.

    Returns
    -------
    Replayed

    Raises
    ------
    HandEyeCalibError
        Where bag or poses cannot be used, or there are too few.
    """
    from hand_eye_calib.io.bags import PoseBag

    say, shown, waited_for = _silence if quiet else (note, with_progress, waiting_for)
    calibrator = Calibrator(config)
    with PoseBag(*paths) as bag:
        sources = dict(zip(("parent", "child"), bag.select_topics(parent, child), strict=True))
        if not (parent and child):
            say(f"parent is {sources['parent']}, child is {sources['child']}; --parent-topic and --child-topic say otherwise")
        poses = bag.poses(*sources.values(), config.max_gap)
        with waited_for(f"opening {bag}"):
            poses = _started(poses)
        expected = bag.expected(*sources.values())
        convergence = Convergence(calibrator, every_s) if every_s else None
        found = feed(calibrator, shown(poses, expected, f"reading {bag}"), sources, convergence)
        found += bag.n_left_out
        warnings = bag.warnings
        files = bag.files()
    if expected is not None and found != expected:
        warnings.append(f"{bag} says it has {expected} messages on these topics, but {found} could be read; it may be damaged")
    for text in warnings:
        say(text)
    with waited_for("solving"):
        calibration = calibrator.estimate()
    calibration = dataclasses.replace(calibration, warnings=(*calibration.warnings, *warnings))
    inputs = {"bag": str(bag), "options": calibrator.config.to_options()}
    inputs |= {stream: {"topic": str(source), **_counts(calibrator.statistics(stream))} for stream, source in sources.items()}
    return Replayed(calibration, inputs, files, convergence.history if convergence else [], calibrator)


def feed(calibrator, poses, topics, convergence=None):
    """Give every pose to the engine.

    Parameters
    ----------
    calibrator : Calibrator
    poses : iterable of StampedPose
    topics : mapping
        "parent" and "child" to the names of their topics, for messages.
    convergence : Convergence, optional
        Told of every pose's bag time.

    Returns
    -------
    int
        How many there were.

    Raises
    ------
    InputError
        At the first message that cannot be used, naming topic, message and stamp.
    """
    count, frames = 0, {}
    for pose in poses:
        stream, number, stamp_ns, _, sensor_frame, position, quat_xyzw, bag_ns = pose
        if convergence is not None:
            convergence.reached(bag_ns)
        count += 1
        try:
            if sensor_frame is not None and frames.get(stream) != sensor_frame:
                calibrator.set_frame(stream, sensor_frame)
                frames[stream] = sensor_frame
            calibrator.add_pose(stream, stamp_ns, position, quat_xyzw)
        except InputError as error:
            stamp = f"{stamp_ns // _NS_PER_S}.{stamp_ns % _NS_PER_S:09d}"
            raise InputError(f"{topics[stream]}, message {number}, stamp {stamp}: {error}") from error
    return count


class Convergence:
    """Estimates on the way, every so much bag time.

    Parameters
    ----------
    calibrator : Calibrator
    every_s : float

    Attributes
    ----------
    history : list of dict
        Bag time in seconds since the first message, and the calibration in plain values, or why there was none.
    """

    def __init__(self, calibrator, every_s):
        self.history = []
        self._calibrator, self._every_ns = calibrator, round(every_s * _NS_PER_S)
        self._first_ns = self._next_ns = None

    def reached(self, bag_ns):
        """Estimate where another period has passed; call it before the message of that time is added."""
        if self._first_ns is None:
            self._first_ns, self._next_ns = bag_ns, bag_ns + self._every_ns
        if bag_ns < self._next_ns:
            return
        periods = (bag_ns - self._first_ns) // self._every_ns
        self._next_ns = self._first_ns + (periods + 1) * self._every_ns
        self.history.append({"bag_time_s": periods * self._every_ns / _NS_PER_S} | self._estimate())
        note(convergence_line(self.history[-1]))

    def _estimate(self):
        try:
            return {"calibration": self._calibrator.estimate().to_dict()}
        except NotEnoughDataError as error:
            return {"calibration": None, "reason": str(error)}


def fingerprints(files, quiet=False):
    """Name, size and SHA-256 of the files that were read."""
    from hand_eye_calib.io.results import fingerprint

    return [fingerprint(file) for file in (files if quiet else with_progress(files, len(files), "hashing"))]


def _started(poses):
    """The same poses, after what a bag has to do before the first of them."""
    return chain(list(islice(poses, 1)), poses)


# In place of note, with_progress and waiting_for.
_silence = (lambda text: None, lambda items, *_: items, lambda what: nullcontext())


def _check_usage(arguments):
    if arguments.batch and (arguments.bags or arguments.list or arguments.every):
        raise ConfigError("--batch names its bags in its file: no BAG, --list or --every goes with it")
    if not arguments.batch and (arguments.jobs or arguments.dask):
        raise ConfigError("--jobs and --dask are for --batch")
    if not arguments.batch and not arguments.bags:
        raise ConfigError("the following arguments are required: BAG, or --batch FILE")


def _tf_source(text):
    from hand_eye_calib.io.transforms import TfSource

    try:
        return TfSource.parse(text)
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _duration_s(text):
    match = re.fullmatch(r"([0-9]*\.?[0-9]+)\s*(s|ms|min|)", text)
    if not match or not float(match[1]):
        raise argparse.ArgumentTypeError(f"expected a duration such as 5s, 500ms or 1min; got {text!r}")
    return float(match[1]) * _UNITS_S[match[2]]


def _positive(text):
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, got {text!r}")
    return int(text)


def _counts(statistics):
    return {
        "messages": statistics.received,
        "refused_duplicate": statistics.refused_duplicate,
        "refused_late": statistics.refused_late,
        "first_stamp_ns": statistics.first_stamp_ns,
        "last_stamp_ns": statistics.last_stamp_ns,
    }
