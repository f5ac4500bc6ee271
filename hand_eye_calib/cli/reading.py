"""Recordings as the engine takes them: two trajectory files, the poses of a bag or of the parts of
one recording, the journal of a session.
"""

import dataclasses
import re
from argparse import Namespace
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_eye_calib.cli.console import STREAMS, flag, note, waiting_for, with_progress
from hand_eye_calib.cli.options import FILE_OPTIONS
from hand_eye_calib.cli.parts import refuse_recordings
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.engine.offline import offline_config, whole_snapshot
from hand_eye_calib.engine.run import run
from hand_eye_calib.engine.snapshot import Snapshot
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.text import names_of_files

if TYPE_CHECKING:
    from hand_eye_calib.io.bags import PoseBag, PoseBlock
    from hand_eye_calib.io.bags.topics import Source

_BAG_SUFFIXES = (".bag", ".db3", ".mcap", ".zstd")


@dataclass
class Recording:
    """Both streams of a recording with their options, where they came from in plain values, the
    files that were read, and what there is to say of them.
    """

    snapshot: Snapshot
    inputs: dict[str, Any]
    files: list[Path]
    warnings: tuple[str, ...] = ()

    def solved(self) -> Calibration:
        """Solve, check the streams, and solve again if a check is certain of an option; the
        snapshot and the inputs have the options that gave the result.
        """
        with waiting_for("solving, and checking the streams"):
            found = run(self.snapshot)
        self.snapshot = found.snapshot
        self.inputs["options"] = self.snapshot.config.to_options()
        warnings = (*found.calibration.warnings, *self.warnings)
        return dataclasses.replace(found.calibration, warnings=warnings)

    def with_fingerprints(self) -> None:
        """Add name, size and SHA-256 of the files to the inputs."""
        from hand_eye_calib.io.results import fingerprint

        files = with_progress(self.files, len(self.files), "hashing")
        self.inputs["files"] = [fingerprint(file) for file in files]


def are_bags(paths: Sequence[Path | str]) -> bool:
    """Whether these are bags, or parts of one, rather than trajectory files; a ConfigError if some
    are bags and others are not, or a file stands alone.
    """
    bags = [
        path
        for path in paths
        if isinstance(path, str) or path.suffix in _BAG_SUFFIXES or path.is_dir()
    ]
    if len(bags) == len(paths) or (len(paths) == 1 and not Path(paths[0]).is_file()):
        return True
    if bags:
        raise ConfigError(
            f"{bags[0]} is a bag, but not all of the others are: give two trajectory files, or the "
            "parts of one bag"
        )
    if len(paths) == 1:
        raise ConfigError(
            f"{paths[0]} is one trajectory file: give those of two sensors, PARENT CHILD, or a bag"
        )
    return False


def read_paths(
    paths: Sequence[Path | str],
    sources: Mapping[str, str],
    options: Mapping[str, Any],
    are_files: bool = False,
) -> Recording:
    """The recording of a journal, of a bag or the parts of one, or of two trajectory files; the
    sources and options are those that somebody gave.
    """
    if are_files:
        # The sensors of all recordings are the same, whatever their files are called.
        frames = {f"{stream}_frame": f"{stream}_sensor" for stream in STREAMS}
        return read_pair(paths, [{}] * 2, frames | dict(options))
    journal = journal_in(paths[0]) if len(paths) == 1 else None
    if journal is None:
        return read_bags(paths, sources, CalibratorConfig.from_options(dict(options)))
    if sources:
        raise ConfigError(
            f"{journal} is the journal of a session, which has two streams; it cannot be combined "
            "with topics or frames"
        )
    return read_journal_of(journal, options)


# ----------------------------------------------------------------------- files


def read_pair(
    paths: Sequence[Path | str],
    settings: Sequence[Mapping[str, Any]],
    options: Mapping[str, Any],
) -> Recording:
    """The recording of the trajectory files of parent and child, with how each is read."""
    (parent, child), repairs = read_files(paths, settings, options)
    for text in repairs:
        note(text)
    inputs: dict[str, Any] = {}
    for path, stream, poses in zip(paths, STREAMS, (parent, child), strict=True):
        first_ns, last_ns = poses.stamps_ns[[0, -1]].tolist()
        inputs[stream] = {"file": str(path), "poses": len(poses)}
        inputs[stream] |= {"first_stamp_ns": first_ns, "last_stamp_ns": last_ns}
    files = [*map(Path, paths), *(each["times"] for each in settings if each.get("times"))]
    snapshot = whole_snapshot(offline_config(parent, child, options), parent, child)
    return Recording(snapshot, inputs, files)


def file_settings(arguments: Namespace) -> list[dict[str, Any]]:
    """How each of the files is read: of two, its own options before those for both."""
    if len(arguments.paths) == 2:
        return [
            {
                name: getattr(arguments, f"{stream}_{name}") or getattr(arguments, name)
                for name in FILE_OPTIONS
            }
            for stream in STREAMS
        ]
    for name in (f"{stream}_{name}" for stream in STREAMS for name in FILE_OPTIONS):
        if getattr(arguments, name):
            raise ConfigError(f"--{flag(name)} is of two files; give the option for all of a rig's")
    return [{name: getattr(arguments, name) for name in FILE_OPTIONS}] * len(arguments.paths)


def read_files(
    paths: Sequence[Path | str],
    settings: Sequence[Mapping[str, Any]],
    options: Mapping[str, Any],
) -> tuple[list[Trajectory], list[str]]:
    """The trajectories of files, named like the files that name no frame, and what was wrong with
    their stamps; a note says what was guessed. See :func:`file_settings`; the options say what the
    sensors measure.
    """
    from hand_eye_calib.io.trajectory_files import FileOptions, read_trajectory_files

    is_pair = len(paths) == 2
    streams = STREAMS if is_pair else [""] * len(paths)
    files = []
    for path, stream, given in zip(paths, streams, settings, strict=True):
        measures = options.get(f"{stream}_measures", "auto")
        of_file = {"format": "auto"} | {name: value for name, value in given.items() if value}
        files.append((Path(path), FileOptions(**of_file, measures=measures, repair=True)))
    with waiting_for(f"reading {' and '.join(map(str, paths))}"):
        readings = read_trajectory_files(files)
    for reading, stream in zip(readings, streams, strict=True):
        for text in reading.guesses:
            of_one = rf"`{stream}_\1`" if is_pair else r"`\1`"
            note(re.sub(f"`({'|'.join(FILE_OPTIONS)})`", of_one, text))
    as_paths = [Path(path) for path in paths]
    names = names_of_files(as_paths) if is_pair else [path.stem for path in as_paths]
    trajectories = [
        dataclasses.replace(each.trajectory, sensor_frame=each.trajectory.sensor_frame or name)
        for each, name in zip(readings, names, strict=True)
    ]
    return trajectories, [text for reading in readings for text in reading.repairs]


# ------------------------------------------------------------ bags and journals


def source_of(text: str) -> "Source":
    """The topic, or the frames, that a text names."""
    from hand_eye_calib.io.transforms import TfSource

    return TfSource.parse(text) if ":" in text.partition("?")[0] else text


def read_bags(
    paths: Sequence[Path | str], wanted: Mapping[str, str], config: CalibratorConfig
) -> Recording:
    """Read one bag, or the parts of one recording; with SeveralRecordings if they are not. Sources
    must be wanted by name if the bag leaves a choice.
    """
    from hand_eye_calib.io.bags import PoseBag

    with PoseBag(*paths) as bag:
        sources, measures = select(bag, wanted, config)
        parent, child = sources.values()
        if len(wanted) < len(STREAMS):
            note(
                f"parent is {parent}, child is {child}; to change that, give --parent-topic and "
                "--child-topic"
            )
        of_streams: dict[str, Any] = {f"{stream}_measures": measures[stream] for stream in STREAMS}
        calibrator = Calibrator(dataclasses.replace(config, **of_streams))
        bag.shown = with_progress
        blocks = bag.blocks(parent, child, config.max_gap, measures)
        # What is read whole, as transforms and scans, is read before the first block.
        with waiting_for(f"opening {bag}"):
            first = list(islice(blocks, 1))
        expected = bag.expected(parent, child)
        shown = with_progress(chain(first, blocks), expected, f"reading {bag}", len)
        found = feed(calibrator, shown, sources) + bag.n_left_out
        for stream, source in sources.items():
            if not calibrator.frame(stream):
                calibrator.set_frame(stream, str(source).strip("/"))
        with waiting_for("comparing the bags"):
            kinds = {source: measures[stream] for stream, source in sources.items()}
            refuse_recordings(bag.paths, kinds, config.max_gap)
        warnings = list(bag.warnings)
        files = bag.files()
    if expected is not None and found != expected:
        warnings.append(
            f"{bag} says it has {expected} messages on these topics, but {found} could be read; it "
            "may be damaged"
        )
    for text in warnings:
        note(text)
    inputs = {"bag": str(bag), **calibrator.inputs(sources)}
    return Recording(calibrator.snapshot(), inputs, files, tuple(warnings))


def select(
    bag: "PoseBag", wanted: Mapping[str, str], config: CalibratorConfig
) -> tuple[dict[str, Any], dict[str, str]]:
    """The sources of "parent" and "child" in a bag, and what each measures."""
    given = {stream: source_of(text) for stream, text in wanted.items()}
    chosen = bag.topics.select(given.get("parent"), given.get("child"))
    sources = dict(zip(STREAMS, chosen, strict=True))
    return sources, {
        stream: bag.measured(source, getattr(config, f"{stream}_measures"))
        for stream, source in sources.items()
    }


def feed(calibrator: Calibrator, blocks: "Iterable[PoseBlock]", topics: Mapping[str, Any]) -> int:
    """Give every pose to the engine; returns how many there were. The first message that cannot be
    used is an InputError with topic, message number and stamp.
    """
    # A message without a frame name changes nothing.
    frames: set[tuple[str, str | None]] = {(stream, None) for stream in topics}
    count = 0
    for block in blocks:
        count += len(block)
        columns = (block.streams, block.sensor_frames, block.stamps_ns, block.poses)
        row = 0
        try:
            rows = zip(*(column.tolist() for column in columns), strict=True)
            for row, (stream, frame, stamp_ns, pose) in enumerate(rows):  # noqa: B007
                if (stream, frame) not in frames:
                    calibrator.set_frame(stream, frame)
                    frames.add((stream, frame))
                calibrator.add_pose(stream, stamp_ns, pose[:3], pose[3:])
        except InputError as error:
            seconds, nanoseconds = divmod(int(block.stamps_ns[row]), 1_000_000_000)
            raise InputError(
                f"{topics[block.streams[row]]}, message {block.message_numbers[row]}, stamp "
                f"{seconds}.{nanoseconds:09d}: {error}"
            ) from error
    return count


def journal_in(path: Path | str) -> Path | None:
    """The directory of a session's journal at a path, or in its output directory; None for bags."""
    from hand_eye_calib.io.journal import has_session

    if isinstance(path, str):
        return None
    return next((each for each in (path, path / "journal") if has_session(each)), None)


def read_journal_of(directory: Path, options: Mapping[str, Any]) -> Recording:
    """Read the journal of a session of the node; the options go before those of the session."""
    from hand_eye_calib.io.journal import read_journal
    from hand_eye_calib.live.journal import give

    with waiting_for(f"reading {directory}"):
        journal = read_journal(directory)
        session = journal.about["parent"]
        config = CalibratorConfig.from_options({**session.get("options", {}), **options})
        names = [each.name for each in dataclasses.fields(config)]
        given = [name for name in names if name in session.get("given", ())]
        given += CalibratorConfig.from_options(options).given
        calibrator = Calibrator(dataclasses.replace(config, given=given))
        give(journal, directory, {"child": calibrator})
    sources = {stream: journal.about.get(stream, {}).get("topic") or stream for stream in STREAMS}
    inputs = {"journal": str(directory), **calibrator.inputs(sources)}
    return Recording(calibrator.snapshot(), inputs, sorted(directory.glob("*.tum")))
