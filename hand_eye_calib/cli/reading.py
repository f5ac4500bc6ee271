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

from hand_eye_calib.cli.console import flag, note, waiting_for, with_progress
from hand_eye_calib.cli.options import FILE_OPTIONS, STREAMS, options_from
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

_BAG_SUFFIXES = (".bag", ".db3", ".mcap", ".zstd")
# The options of a file as the messages of its reader name them.
_FILE_OPTION = re.compile("`(format|columns|times|stamp_unit)`")


@dataclass
class Recording:
    """Both streams of a recording, and where they came from.

    Attributes
    ----------
    snapshot : Snapshot
        The poses and the options.
    inputs : dict
        Where the poses came from, in plain values.
    files : list of pathlib.Path
        The files that were read.
    warnings : tuple of str
        What there is to say of the files.
    """

    snapshot: Snapshot
    inputs: dict[str, Any]
    files: list[Path]
    warnings: tuple[str, ...] = ()

    def solved(self) -> Calibration:
        """Solve, check the streams, and solve again if a check is certain of an option; the
        snapshot and the inputs have the options that gave the result.

        Raises
        ------
        NotEnoughDataError
            If there are too few poses.
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
    """Whether these are bags, or parts of one, rather than trajectory files.

    Raises
    ------
    ConfigError
        If some are bags and others are not, or a file stands alone.
    """
    bags = [path for path in paths if _is_bag(path)]
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


def _is_bag(path: Path | str) -> bool:
    return isinstance(path, str) or path.suffix in _BAG_SUFFIXES or path.is_dir()


def read_recording(arguments: Namespace) -> Recording:
    """The recording that the arguments name; ``is_of_bags`` says what they are.

    Raises
    ------
    HandEyeCalibError
        If it cannot be read, or something does not go together.
    """
    if not arguments.is_of_bags:
        return _read_pair(arguments)
    return read_paths(arguments.paths, sources_from(arguments), options_from(arguments))


def read_paths(
    paths: Sequence[Path | str],
    sources: Mapping[str, Any],
    options: Mapping[str, Any],
    are_files: bool = False,
) -> Recording:
    """The recording of a journal, of a bag or the parts of one, or of two trajectory files.

    Raises
    ------
    HandEyeCalibError
        If it cannot be read, or something does not go together.
    """
    if are_files:
        settings = [
            {"format": "auto", "measures": options.get(f"{stream}_measures", "auto")}
            for stream in STREAMS
        ]
        return _recording(paths, *_read(list(map(Path, paths)), settings, ["", ""]), options)
    journal = journal_in(paths)
    if journal is None:
        return read_bags(paths, sources, CalibratorConfig.from_options(dict(options)))
    if any(sources.values()):
        raise ConfigError(
            f"{journal} is the journal of a session, which has two streams; it cannot be combined "
            "with topics or frames"
        )
    return read_journal_of(journal, options)


def sources_from(arguments: Namespace) -> dict[str, Any]:
    """Topic or frames of "parent" and "child"; None for what is not given."""
    for stream in STREAMS:
        if fields := getattr(arguments, f"{stream}_fields"):
            if not (topic := getattr(arguments, f"{stream}_topic")):
                raise ConfigError(f"--{stream}-fields is of messages: give --{stream}-topic, too")
            setattr(arguments, f"{stream}_topic", f"{topic}?{fields}")
            setattr(arguments, f"{stream}_fields", "")
    return {
        stream: getattr(arguments, f"{stream}_topic") or getattr(arguments, f"{stream}_tf")
        for stream in STREAMS
    }


# ----------------------------------------------------------------------- files


def _read_pair(arguments: Namespace) -> Recording:
    trajectories, repairs = read_files(arguments)
    times = (arguments.times, arguments.parent_times, arguments.child_times)
    options = options_from(arguments)
    found = _recording(arguments.paths, [*trajectories.values()], repairs, options)
    found.files += filter(None, times)
    return found


def _recording(
    paths: Sequence[Path | str],
    trajectories: Sequence[Trajectory],
    repairs: Sequence[str],
    options: Mapping[str, Any],
) -> Recording:
    """The recording of the trajectories of two files."""
    for text in repairs:
        note(text)
    parent, child = trajectories
    config = offline_config(parent, child, options)
    inputs: dict[str, Any] = {}
    for path, stream, poses in zip(paths, STREAMS, trajectories, strict=True):
        first_ns, last_ns = poses.stamps_ns[[0, -1]].tolist()
        inputs[stream] = {"file": str(path), "poses": len(poses)}
        inputs[stream] |= {"first_stamp_ns": first_ns, "last_stamp_ns": last_ns}
    return Recording(whole_snapshot(config, parent, child), inputs, [*map(Path, paths)])


def read_files(arguments: Namespace) -> tuple[dict[str, Trajectory], list[str]]:
    """Read the trajectories of parent and child as the arguments say; a note says what was guessed.

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
    options = options_from(arguments)
    settings = [
        _settings_of(arguments, index) | {"measures": options.get(f"{stream}_measures", "auto")}
        for index, stream in enumerate(STREAMS)
    ]
    trajectories, repairs = _read(arguments.paths, settings, [f"{each}_" for each in STREAMS])
    names = names_of_files([Path(path) for path in arguments.paths])
    named = [
        dataclasses.replace(each, sensor_frame=each.sensor_frame or name)
        for each, name in zip(trajectories, names, strict=True)
    ]
    return dict(zip(STREAMS, named, strict=True)), repairs


def read_rig_files(arguments: Namespace) -> dict[str, Trajectory]:
    """The trajectories of three files or more by the names of their frames, or of the files.

    Raises
    ------
    HandEyeCalibError
        If a file cannot be read, or an option is of two files.
    """
    for stream in STREAMS:
        for name in FILE_OPTIONS:
            if getattr(arguments, f"{stream}_{name}"):
                raise ConfigError(
                    f"--{stream}-{flag(name)} is of two files; give the option for all of a rig's "
                    "files"
                )
    settings = {name: getattr(arguments, name) for name in FILE_OPTIONS}
    settings["format"] = settings["format"] or "auto"
    count = len(arguments.paths)
    trajectories, repairs = _read(arguments.paths, [settings] * count, [""] * count)
    for text in repairs:
        note(text)
    found: dict[str, Trajectory] = {}
    for path, trajectory in zip(arguments.paths, trajectories, strict=True):
        add_sensor(found, trajectory.sensor_frame or Path(path).stem, trajectory)
    return found


def add_sensor(found: dict[str, Trajectory], name: str, trajectory: Trajectory) -> None:
    """Add the trajectory of a sensor by its name, which no other one has.

    Raises
    ------
    ConfigError
        If another one has it.
    """
    if name in found:
        raise ConfigError(
            f"two trajectories of the rig are of one sensor, {name!r}: sensors have the names of "
            "their frames or files, which must differ"
        )
    found[name] = trajectory


def _read(
    paths: Sequence[Path], settings: Sequence[Mapping[str, Any]], prefixes: Sequence[str]
) -> tuple[list[Trajectory], list[str]]:
    """Trajectories of files, and what was wrong with their stamps; guesses become notes, in which
    the options of a file have a prefix.
    """
    from hand_eye_calib.io.trajectory_files import FileOptions, read_trajectory_files

    options = [FileOptions(**each, repair=True) for each in settings]
    files = list(zip(paths, options, strict=True))
    with waiting_for(f"reading {' and '.join(map(str, paths))}"):
        readings = read_trajectory_files(files)
    for reading, prefix in zip(readings, prefixes, strict=True):
        for text in reading.guesses:
            note(_FILE_OPTION.sub(rf"`{prefix}\1`", text))
    repairs = [text for reading in readings for text in reading.repairs]
    return [reading.trajectory for reading in readings], repairs


def _settings_of(arguments: Namespace, index: int) -> dict[str, Any]:
    """How to read the parent's (0) or the child's (1) file: its own options before those for both.

    Of those for both, columns are meant for the files that do not name their own, and times for
    those of format kitti.
    """
    given = {name: _given(arguments, index, name) for name in FILE_OPTIONS}
    for name in ("columns", "times"):
        is_own = getattr(arguments, f"{STREAMS[index]}_{name}")
        if given[name] and not is_own and not _is_meant(arguments, index, name):
            given[name] = None if _is_meant(arguments, 1 - index, name) else given[name]
    return given | {"format": given["format"] or "auto"}


def _given(arguments: Namespace, index: int, name: str) -> Any:
    """An option of one file, or the one for both."""
    return getattr(arguments, f"{STREAMS[index]}_{name}") or getattr(arguments, name)


def _is_meant(arguments: Namespace, index: int, name: str) -> bool:
    """Whether ``--columns`` or ``--times`` for both files fits one of them."""
    from hand_eye_calib.io.trajectory_files import layout_of_file

    found = layout_of_file(arguments.paths[index])
    given = _given(arguments, index, "format")
    if name == "times":
        return bool((given or found.format) == "kitti")
    return (given or found.format) == "csv" or not (given or found.is_named)


# ------------------------------------------------------------ bags and journals


def read_bags(
    paths: Sequence[Path | str], wanted: Mapping[str, Any], config: CalibratorConfig
) -> Recording:
    """Read one bag, or the parts of one recording.

    Parameters
    ----------
    paths : list of path-like
        Parts of one recording; see :func:`refuse_recordings`.
    wanted : mapping
        "parent" and "child" to a topic or a TfSource; to None if the bag leaves no choice.
    config : CalibratorConfig

    Raises
    ------
    HandEyeCalibError
        If bag or poses cannot be used.
    """
    from hand_eye_calib.io.bags import PoseBag

    with PoseBag(*paths) as bag:
        parent, child = bag.topics.select(wanted["parent"], wanted["child"])
        sources = {"parent": parent, "child": child}
        if not all(wanted.values()):
            note(
                f"parent is {parent}, child is {child}; to change that, give --parent-topic and "
                "--child-topic"
            )
        measures = measures_of(bag, sources, config)
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
            refuse_recordings(bag, kinds, config.max_gap)
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


def measures_of(
    bag: "PoseBag", sources: Mapping[str, Any], config: CalibratorConfig
) -> dict[str, str]:
    """What the messages of each stream measure, unless an option says that."""
    return {
        stream: bag.measured(source, getattr(config, f"{stream}_measures"))
        for stream, source in sources.items()
    }


def feed(calibrator: Calibrator, blocks: "Iterable[PoseBlock]", topics: Mapping[str, Any]) -> int:
    """Give every pose to the engine.

    Parameters
    ----------
    calibrator : Calibrator
    blocks : iterable of PoseBlock
    topics : mapping
        "parent" and "child" to the names of their topics, for messages.

    Returns
    -------
    int
        How many there were.

    Raises
    ------
    InputError
        At the first message that cannot be used, with topic, message number and stamp.
    """
    # A message without a frame name changes nothing.
    frames: set[tuple[str, str | None]] = {(stream, None) for stream in topics}
    count = 0
    for block in blocks:
        count += len(block)
        row = 0
        try:
            named = zip(block.streams.tolist(), block.sensor_frames.tolist(), strict=True)
            for row, pair in enumerate(named):  # noqa: B007
                if pair not in frames:
                    calibrator.set_frame(*pair)
                    frames.add(pair)
            calibrator.add_poses(
                block.streams, block.stamps_ns, block.poses[:, :3], block.poses[:, 3:]
            )
        except InputError as error:
            row = getattr(error, "index", row)
            seconds, nanoseconds = divmod(int(block.stamps_ns[row]), 1_000_000_000)
            raise InputError(
                f"{topics[block.streams[row]]}, message {block.message_numbers[row]}, stamp "
                f"{seconds}.{nanoseconds:09d}: {error}"
            ) from error
    return count


def journal_in(paths: Sequence[Path | str]) -> Path | None:
    """The directory of the session's journal that is meant; None for bags."""
    from hand_eye_calib.io.journal import has_session

    if len(paths) != 1 or isinstance(paths[0], str):
        return None
    return next((path for path in (paths[0], paths[0] / "journal") if has_session(path)), None)


def read_journal_of(directory: Path, options: Mapping[str, Any]) -> Recording:
    """Read the journal of a session of the node.

    Parameters
    ----------
    directory : pathlib.Path
    options : mapping
        Options by their public names; they go before those of the session.

    Raises
    ------
    HandEyeCalibError
        If the journal cannot be used.
    """
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
