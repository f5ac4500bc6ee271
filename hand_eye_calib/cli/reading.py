"""Recordings as the engine takes them: two trajectory files, the poses of a bag or of the parts of
one recording, the journal of a session.
"""

import dataclasses
import re
from argparse import Namespace
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from hand_eye_calib.cli.console import STREAMS, flag, note, waiting_for, with_progress
from hand_eye_calib.cli.options import FILE_OPTIONS
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.run import run
from hand_eye_calib.engine.snapshot import Snapshot, whole_snapshot
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.results.calibration import Calibration

if TYPE_CHECKING:
    from hand_eye_calib.engine.calibrator import Calibrator
    from hand_eye_calib.io.bags import PoseBag, PoseTable, Source

_BAG_SUFFIXES = (".bag", ".db3", ".mcap", ".zstd")
# Who starts a recorder again needs less (s). Odometry seldom runs on from one drive to the next.
# A part may begin before the last poses of the one before it are written.
_LONGEST_PAUSE_S, _LONGEST_OVERLAP_S = 60.0, 1.0


@dataclass
class Recording:
    """Both streams of a recording with their options, where they came from in plain values, the
    files that were read, and what there is to say of them.
    """

    snapshot: Snapshot
    inputs: dict[str, Any]
    files: list[Path]
    warnings: tuple[str, ...] = ()

    def solved(self, with_fingerprints: bool) -> Calibration:
        """Solve, check the streams, and solve again if a check is certain of an option; the
        snapshot and the inputs have the options that gave the result. With name, size and SHA-256
        of the files among the inputs, if they are wanted.
        """
        with waiting_for("solving, and checking the streams"):
            found = run(self.snapshot)
        self.snapshot = found.snapshot
        self.inputs["options"] = self.snapshot.config.to_options()
        if with_fingerprints:
            from hand_eye_calib.io.results import fingerprint

            files = with_progress(self.files, len(self.files), "hashing")
            self.inputs["files"] = [fingerprint(file) for file in files]
        warnings = (*found.calibration.warnings, *self.warnings)
        return dataclasses.replace(found.calibration, warnings=warnings)


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


# ----------------------------------------------------------------------- files


def read_pair(arguments: Namespace, options: Mapping[str, Any]) -> Recording:
    """The recording of the trajectory files of parent and child."""
    (parent, child), repairs = read_files(arguments, arguments.paths, options)
    for text in repairs:
        note(text)
    inputs: dict[str, Any] = {}
    for path, stream, poses in zip(arguments.paths, STREAMS, (parent, child), strict=True):
        first_ns, last_ns = poses.stamps_ns[[0, -1]].tolist()
        inputs[stream] = {"file": str(path), "poses": len(poses)}
        inputs[stream] |= {"first_stamp_ns": first_ns, "last_stamp_ns": last_ns}
    times = {arguments.times, arguments.parent_times, arguments.child_times} - {None}
    snapshot = whole_snapshot(parent, child, options)
    return Recording(snapshot, inputs, [*map(Path, arguments.paths), *times])


def read_files(
    arguments: Namespace, paths: Sequence[Path | str], options: Mapping[str, Any]
) -> tuple[list[Trajectory], list[str]]:
    """The trajectories of files, and what was wrong with their stamps; a note says what was
    guessed. How each is read is among the arguments: of two, its own options go before those for
    both. ``options`` say what the sensors measure.
    """
    from hand_eye_calib.io.trajectory_files import FileOptions, read_trajectory_files

    streams = STREAMS[: len(paths)] if len(paths) < 3 else [""] * len(paths)
    for name in (f"{stream}_{name}" for stream in STREAMS for name in FILE_OPTIONS):
        if len(paths) > 2 and getattr(arguments, name):
            raise ConfigError(f"--{flag(name)} is of two files; give it for all of a rig's")
    files = []
    for path, stream in zip(paths, streams, strict=True):
        given = {name: getattr(arguments, f"{stream}_{name}", None) for name in FILE_OPTIONS}
        given = {name: value or getattr(arguments, name) for name, value in given.items()}
        given["pair_by"] = arguments.pair_by
        given = {"format": "auto"} | {name: value for name, value in given.items() if value}
        measures = options.get(f"{stream}_measures", "auto")
        files.append((Path(path), FileOptions(**given, measures=measures, repair=True)))
    with waiting_for(f"reading {' and '.join(map(str, paths))}"):
        readings = read_trajectory_files(files)
    for reading, stream in zip(readings, streams, strict=True):
        for text in reading.guesses:
            named_as = rf"`{stream}_\1`" if stream else r"`\1`"
            note(re.sub(f"`({'|'.join(FILE_OPTIONS)})`", named_as, text))
    return [each.trajectory for each in readings], [
        text for reading in readings for text in reading.repairs
    ]


# ------------------------------------------------------------ bags and journals


class SeveralRecordings(InputError):
    """Bags that are not parts of one recording; ``groups`` are the bags of each."""

    def __init__(self, reason: str, groups: list[list[Path]]) -> None:
        super().__init__(f"{reason}; calibrate each by itself, or all of one rig together")
        self.reason, self.groups = reason, groups


def read_recording(
    paths: Sequence[Path], wanted: Mapping[str, str], options: Mapping[str, Any]
) -> Recording:
    """The recording of a journal, of a bag or of the parts of one, with SeveralRecordings if they
    are not. Sources must be wanted by name if a bag leaves a choice; the options are those that
    somebody gave.
    """
    journal = journal_in(paths[0]) if len(paths) == 1 else None
    if journal is None:
        return _read_bags(paths, wanted, CalibratorConfig.from_options(dict(options)))
    if wanted:
        raise ConfigError(
            f"{journal} is the journal of a session, which has two streams; it cannot be combined "
            "with topics or frames"
        )
    return read_journal_of(journal, options)


def source_of(text: str) -> "Source":
    """The topic, or the frames, that a text names."""
    from hand_eye_calib.io.transforms import TfSource

    return TfSource.parse(text) if ":" in text.partition("?")[0] else text


def select(
    bag: "PoseBag", wanted: Mapping[str, str], config: CalibratorConfig
) -> tuple[dict[str, "Source"], dict[str, str]]:
    """The sources of "parent" and "child" in a bag, and what each measures."""
    given = {stream: source_of(text) for stream, text in wanted.items()}
    chosen = bag.select(given.get("parent"), given.get("child"))
    if len(given) < len(STREAMS):
        parent, child = chosen
        note(
            f"parent is {parent}, child is {child}; to change that, give --parent-topic and "
            "--child-topic"
        )
    measures = {
        stream: bag.measured(source, getattr(config, f"{stream}_measures"))
        for stream, source in zip(STREAMS, chosen, strict=True)
    }
    return dict(zip(STREAMS, chosen, strict=True)), measures


def read_sources(
    bag: "PoseBag", measures: "Iterable[tuple[Source, str]]"
) -> tuple[list[Trajectory], list[str]]:
    """The whole trajectories of sources of a bag, each with what it measures, and what was wrong
    with their stamps.
    """
    found = []
    for source, kind in measures:
        with waiting_for(f"reading {source}"):
            found.append(bag.trajectory(source, kind))
    for text in bag.warnings:
        note(text)
    return [poses for poses, _ in found], [text for _, notes in found for text in notes]


def _read_bags(
    paths: Sequence[Path], wanted: Mapping[str, str], config: CalibratorConfig
) -> Recording:
    from hand_eye_calib.engine.calibrator import Calibrator
    from hand_eye_calib.io.bags import PoseBag

    with PoseBag(*paths) as bag:
        sources, measures = select(bag, wanted, config)
        refuse_recordings(paths, sources.values())
        of_streams: dict[str, Any] = {f"{stream}_measures": measures[stream] for stream in STREAMS}
        calibrator = Calibrator(dataclasses.replace(config, **of_streams))
        bag.shown = with_progress
        poses = bag.poses(sources["parent"], sources["child"], config.max_gap, measures)
        _feed(calibrator, poses, sources)
        for stream, source in sources.items():
            if not calibrator.frame(stream):
                calibrator.set_frame(stream, str(source).strip("/"))
        warnings = list(bag.warnings)
        files = bag.files
    for text in warnings:
        note(text)
    inputs = {"bag": str(bag), **calibrator.inputs(sources)}
    return Recording(calibrator.snapshot(), inputs, files, tuple(warnings))


def _feed(calibrator: "Calibrator", poses: "PoseTable", topics: Mapping[str, Any]) -> None:
    """Give every pose to the engine. The first message that cannot be used is an InputError with
    topic and stamp.
    """
    # A message without a frame name changes nothing.
    frames: set[tuple[str, str | None]] = {(stream, None) for stream in topics}
    columns = (poses.streams, poses.sensor_frames, poses.stamps_ns, poses.poses)
    row = 0
    try:
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for row, (stream, frame, stamp_ns, pose) in enumerate(rows):  # noqa: B007
            if (stream, frame) not in frames:
                calibrator.set_frame(stream, frame)
                frames.add((stream, frame))
            calibrator.add_pose(stream, stamp_ns, pose[:3], pose[3:])
    except InputError as error:
        seconds, nanoseconds = divmod(int(poses.stamps_ns[row]), 1_000_000_000)
        raise InputError(
            f"{topics[poses.streams[row]]}, stamp {seconds}.{nanoseconds:09d}: {error}"
        ) from error


def refuse_recordings(paths: Sequence[Path], sources: "Collection[Source]") -> None:
    """Raise SeveralRecordings for bags that are not parts of one recording: parts have different
    topics, or follow each other at once.
    """
    groups: list[list[_Part]] = []
    reason = ""
    parts = [_Part.of(path, sources) for path in paths] if len(paths) > 1 else []
    for part in sorted(parts):
        for group in groups:
            if not (told := part.differs_from([each for each in group if each.has & part.has])):
                group.append(part)
                break
            reason = told
        else:
            groups.append([part])
    if len(groups) > 1:
        raise SeveralRecordings(reason, [[part.path for part in group] for group in groups])


class _Part(NamedTuple):
    """When a bag was recorded, and which of the sources it has."""

    begin_ns: int
    end_ns: int
    path: Path
    has: "set[Source]"

    @classmethod
    def of(cls, path: Path, sources: "Collection[Source]") -> Self:
        from hand_eye_calib.io.bags import PoseBag

        has = set()
        with PoseBag(path) as bag:
            for source in sources:
                with suppress(InputError):
                    bag.check(source)
                    has.add(source)
            return cls(bag.start_ns or 0, bag.end_ns or 0, path, has)

    def differs_from(self, earlier: "Sequence[_Part]") -> str:
        """What tells that it is no part of the recording of earlier bags; empty for nothing."""
        latest = max(earlier, key=lambda part: part.end_ns, default=None)
        pause_s = 0.0 if latest is None else (self.begin_ns - latest.end_ns) * 1e-9
        if latest is None or -_LONGEST_OVERLAP_S <= pause_s <= _LONGEST_PAUSE_S:
            return ""
        told = f"there is a pause of {pause_s:.0f} s between them"
        if pause_s < 0:
            until_ns = min(latest.end_ns, self.end_ns)
            told = f"both are of the same {(until_ns - self.begin_ns) * 1e-9:.1f} s"
        return f"{latest.path} and {self.path} are two recordings, not parts of one: {told}"


def journal_in(path: Path | str) -> Path | None:
    """The directory of a session's journal at a path, or in its output directory; None for bags."""
    if isinstance(path, str) or not path.is_dir():
        return None
    from hand_eye_calib.io.journal import has_session

    return next((each for each in (path, path / "journal") if has_session(each)), None)


def read_journal_of(directory: Path, options: Mapping[str, Any]) -> Recording:
    """Read the journal of a session of the node; the options go before those of the session."""
    from hand_eye_calib.engine.calibrator import Calibrator
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
