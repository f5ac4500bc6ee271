"""Bags, the parts of one recording, and the journals of sessions, as the engine takes them."""

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, Self

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.option import Options
from hand_eye_calib.core.engine.calibrator import Calibrator, Calibrators
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.bags.pose_table import PoseTable
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.formats.bags.sources import Source, source_of
from hand_eye_calib.formats.trajectory_files.dates import seconds
from hand_eye_calib.offline.cli.options import (
    OPTION_FIELDS,
    STREAMS,
    note,
    waiting_for,
    with_progress,
)
from hand_eye_calib.offline.cli.reading import Recording

# Who starts a recorder again needs less (s). Odometry seldom runs on from one drive to the next.
# A part may begin before the last poses of the one before it are written.
_LONGEST_PAUSE_S = 60.0
_LONGEST_OVERLAP_S = 1.0


class SeveralRecordingsError(InputError):
    """Bags that are not parts of one recording; ``groups`` are the bags of each."""

    def __init__(self, reason: str, groups: list[list[Path]]) -> None:
        super().__init__(f"{reason}; calibrate each by itself, or all of one rig together")
        self.reason = reason
        self.groups = groups


def read_recording(
    paths: Sequence[Path], wanted: Mapping[str, str], options: Mapping[str, Any]
) -> Recording:
    """Read the recording of a journal, of a bag or of the parts of one.

    Sources must be wanted by name if a bag leaves a choice; the options are those that somebody
    gave. Journals are recordings of their own; SeveralRecordingsError if the bags are such, too.
    """
    journal = next(filter(None, map(journal_in, paths)), None)
    if journal and len(paths) > 1:
        raise SeveralRecordingsError(
            f"{journal} is a session of its own", [[path] for path in paths]
        )
    if journal is None:
        return _read_bags(paths, wanted, CalibratorConfig.from_options(dict(options)))
    if wanted:
        raise ConfigError(
            f"{journal} is the journal of a session, which has two streams; it cannot be combined "
            "with topics, frames or stamps"
        )
    return read_journal_of(journal, options)


def select(
    bag: PoseBag, wanted: Mapping[str, str], config: CalibratorConfig
) -> tuple[dict[str, Source], dict[str, str]]:
    """The sources of "parent" and "child" in a bag, and what each measures."""
    given = {stream: source_of(wanted[stream]) for stream in STREAMS if stream in wanted}
    frames = {stream: getattr(config, f"{stream}_frame") for stream in STREAMS}
    chosen = bag.select(given.get("parent"), given.get("child"), frames)
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


def stamps_of(wanted: Mapping[str, str]) -> dict[str, str]:
    """Where the stamps of "parent" and "child" come from."""
    return {stream: wanted.get(f"{stream}_stamps", "header") for stream in STREAMS}


def read_sources(
    bag: PoseBag, measures: Iterable[tuple[Source, str, str]]
) -> tuple[list[Trajectory], list[str]]:
    """The whole trajectories of sources of a bag, each with what it measures and where its stamps
    come from, and what was wrong with their stamps.
    """
    found = []
    for source, kind, stamps in measures:
        with waiting_for(f"reading {source}"):
            found.append(bag.trajectory(source, kind, stamps))
    note(*bag.warnings)
    return [poses for poses, _ in found], [text for _, notes in found for text in notes]


def _read_bags(
    paths: Sequence[Path], wanted: Mapping[str, str], config: CalibratorConfig
) -> Recording:
    with PoseBag(*paths) as bag:
        sources, measures = select(bag, wanted, config)
        refuse_recordings(paths, sources.values())
        of_streams: Options = {f"{stream}_measures": measures[stream] for stream in STREAMS}
        calibrator = Calibrator(dataclasses.replace(config, **of_streams))
        bag.shown = with_progress
        stamps = stamps_of(wanted)
        both = sources["parent"], sources["child"]
        poses = bag.poses(*both, config.max_gap, measures, stamps)
        _feed(calibrator, poses, sources)
        for stream, source in sources.items():
            if not calibrator.frame(stream):
                calibrator.set_frame(stream, str(source))
        note(*bag.warnings)
        inputs = {"bag": str(bag), **calibrator.inputs(sources)}
        return Recording(calibrator.snapshot(), inputs, bag.files, tuple(bag.warnings))


def _feed(calibrator: Calibrator, poses: PoseTable, topics: Mapping[str, Source]) -> None:
    """Give every pose to the engine. The first message that cannot be used is an InputError with
    topic and stamp.
    """
    for stream in STREAMS:
        worlds = poses.world_frames[poses.streams == stream]
        if len(worlds):
            calibrator.set_world(stream, worlds[0])
    columns = (poses.streams, poses.sensor_frames, poses.stamps_ns, poses.poses)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    for stream, frame, stamp_ns, pose in rows:
        try:
            if frame is not None:
                calibrator.set_frame(stream, frame)
            calibrator.add_pose(stream, stamp_ns, pose[:3], pose[3:])
        except InputError as error:
            at = f"{topics[stream]}, stamp {seconds(stamp_ns)}"
            raise InputError(f"{at}: {error}") from error


def refuse_recordings(paths: Sequence[Path], sources: Collection[Source]) -> None:
    """Raise SeveralRecordingsError for bags that are not parts of one recording.

    Parts have different topics, or follow each other at once.
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
        raise SeveralRecordingsError(reason, [[part.path for part in group] for group in groups])


class _Part(NamedTuple):
    """When a bag was recorded, and which of the sources it has."""

    begin_ns: int
    end_ns: int
    path: Path
    has: set[Source]

    @classmethod
    def of(cls, path: Path, sources: Collection[Source]) -> Self:
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
    from hand_eye_calib.formats.journal import has_session

    return next((each for each in (path, path / "journal") if has_session(each)), None)


def read_journal_of(directory: Path, options: Options) -> Recording:
    """Read the journal of a session of the node; the options go before those of the session."""
    from hand_eye_calib.formats.journal import read_journal, replay_journal

    with waiting_for(f"reading {directory}"):
        journal = read_journal(directory)
        session = journal.about["parent"]
        # Options of an earlier version that were empty, and are no longer there, say nothing.
        before = {**session.get("options", {})}
        before = {name: each for name, each in before.items() if each or name in OPTION_FIELDS}
        config = CalibratorConfig.from_options(before | {**options})
        names = [each.name for each in dataclasses.fields(config)]
        given = [name for name in names if name in session.get("given", ())]
        given += CalibratorConfig.from_options(options).given
        calibrator = Calibrator(dataclasses.replace(config, given=given))
        replay_journal(journal, directory, Calibrators(child=calibrator))
    sources = {stream: journal.about.get(stream, {}).get("topic") or stream for stream in STREAMS}
    inputs = {"journal": str(directory), **calibrator.inputs(sources)}
    return Recording(calibrator.snapshot(), inputs, sorted(directory.glob("*.tum")))
