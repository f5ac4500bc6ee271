"""Recordings in bags, in the parts of a recording, and in the journals of sessions."""

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

# Longest pause (s) between the parts of a recording: a recorder can be restarted in less time.
# Odometry seldom continues from one drive to the next.
_LONGEST_PAUSE_S = 60.0
# Longest overlap (s): a part may begin before the last poses of the part before it are written.
_LONGEST_OVERLAP_S = 1.0


class SeveralRecordingsError(InputError):
    """Error for bags that are not parts of one recording.

    ``groups`` are the bags of each recording.
    """

    def __init__(self, reason: str, groups: list[list[Path]]) -> None:
        super().__init__(f"{reason}; calibrate each by itself, or all of one rig together")
        self.reason = reason
        self.groups = groups


def read_recording(
    paths: Sequence[Path], wanted: Mapping[str, str], options: Mapping[str, Any]
) -> Recording:
    """Read the recording of a journal, of a bag or of the parts of a bag.

    Parameters
    ----------
    paths : sequence of pathlib.Path
    wanted : mapping of str to str
        Sources of the streams, and origins of their stamps; see options.sources_from. They are
        needed if a bag has several candidates.
    options : mapping
        Options that the user set.

    Raises
    ------
    SeveralRecordingsError
        If the bags are not parts of one recording. Each journal is a recording of its own.
    """
    journals = [journal for path in paths if (journal := journal_in(path))]
    journal = journals[0] if journals else None
    if journal and len(paths) > 1:
        raise SeveralRecordingsError(
            f"{journal} is a session of its own", [[path] for path in paths]
        )
    if journal is None:
        return _read_bags(paths, wanted, CalibratorConfig.from_options(dict(options)))
    if wanted:
        raise ConfigError(
            f"the journal {journal} has two streams; omit the options for topics, frames and stamps"
        )
    return read_journal_of(journal, options)


def select(
    bag: PoseBag, wanted: Mapping[str, str], config: CalibratorConfig
) -> tuple[dict[str, Source], dict[str, str]]:
    """Return the sources of "parent" and "child" in a bag, and their kinds of data."""
    named = {stream: source_of(wanted[stream]) for stream in STREAMS if stream in wanted}
    frames = {stream: getattr(config, f"{stream}_frame") for stream in STREAMS}
    parent, child = bag.select(named.get("parent"), named.get("child"), frames)
    if len(named) < len(STREAMS):
        note(
            f"parent is {parent}, child is {child}; to change this, set "
            "--parent-topic and --child-topic"
        )
    measures = {
        "parent": bag.measured(parent, config.parent_measures),
        "child": bag.measured(child, config.child_measures),
    }
    return {"parent": parent, "child": child}, measures


def stamps_of(wanted: Mapping[str, str]) -> dict[str, str]:
    """Return the origins of the stamps of "parent" and "child"."""
    return {stream: wanted.get(f"{stream}_stamps", "header") for stream in STREAMS}


def read_sources(
    bag: PoseBag, measures: Iterable[tuple[Source, str, str]]
) -> tuple[list[Trajectory], list[str]]:
    """Read the whole trajectories of sources of a bag.

    Parameters
    ----------
    bag : PoseBag
    measures : iterable of (Source, str, str)
        Sources with their kinds of data and the origins of their stamps.

    Returns
    -------
    trajectories : list of Trajectory
    repairs : list of str
        Notes on faults of the stamps.
    """
    trajectories = []
    repairs: list[str] = []
    for source, kind, stamps in measures:
        with waiting_for(f"reading {source}"):
            trajectory, notes = bag.trajectory(source, kind, stamps)
        trajectories.append(trajectory)
        repairs += notes
    note(*bag.warnings)
    return trajectories, repairs


def _read_bags(
    paths: Sequence[Path], wanted: Mapping[str, str], config: CalibratorConfig
) -> Recording:
    with PoseBag(*paths) as bag:
        sources, measures = select(bag, wanted, config)
        refuse_recordings(paths, sources.values())
        kinds: Options = {f"{stream}_measures": measures[stream] for stream in STREAMS}
        calibrator = Calibrator(dataclasses.replace(config, **kinds))
        bag.shown = with_progress
        stamps = stamps_of(wanted)
        poses = bag.poses(sources["parent"], sources["child"], config.max_gap, measures, stamps)
        _feed(calibrator, poses, sources)
        for stream, source in sources.items():
            if not calibrator.frame(stream):
                calibrator.set_frame(stream, str(source))
        note(*bag.warnings)
        inputs = {"bag": str(bag), **calibrator.inputs(sources)}
        return Recording(calibrator.snapshot(), inputs, bag.files, tuple(bag.warnings))


def _feed(calibrator: Calibrator, poses: PoseTable, topics: Mapping[str, Source]) -> None:
    """Add every pose to the engine.

    Raises
    ------
    InputError
        For the first message that the engine refuses, with topic and stamp.
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
    """Raise a SeveralRecordingsError for bags that are not parts of one recording.

    Parts of one recording have different topics, or follow each other without a pause.
    """
    if len(paths) < 2:
        return
    groups: list[list[_Part]] = []
    reason = ""
    for part in sorted(_Part.of(path, sources) for path in paths):
        for group in groups:
            same_topics = [other for other in group if other.has & part.has]
            difference = part.difference_from(same_topics)
            if not difference:
                group.append(part)
                break
            reason = difference
        else:
            groups.append([part])
    if len(groups) > 1:
        raise SeveralRecordingsError(reason, [[part.path for part in group] for group in groups])


class _Part(NamedTuple):
    """Time of a bag, and the sources that it has."""

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

    def difference_from(self, earlier: "Sequence[_Part]") -> str:
        """Return the reason for which the bag does not continue earlier bags; empty if it does."""
        if not earlier:
            return ""
        latest = max(earlier, key=lambda part: part.end_ns)
        pause_s = (self.begin_ns - latest.end_ns) * 1e-9
        if -_LONGEST_OVERLAP_S <= pause_s <= _LONGEST_PAUSE_S:
            return ""
        reason = f"there is a pause of {pause_s:.0f} s between them"
        if pause_s < 0:
            until_ns = min(latest.end_ns, self.end_ns)
            reason = f"both cover the same {(until_ns - self.begin_ns) * 1e-9:.1f} s"
        return f"{latest.path} and {self.path} are two recordings, not parts of one: {reason}"


def journal_in(path: Path | str) -> Path | None:
    """Return the directory of a session's journal at a path, or in the output directory there.

    None for bags.
    """
    if isinstance(path, str) or not path.is_dir():
        return None
    from hand_eye_calib.formats.journal import has_session

    return next((folder for folder in (path, path / "journal") if has_session(folder)), None)


def read_journal_of(directory: Path, options: Options) -> Recording:
    """Read the journal of a session of the node. The options override those of the session."""
    from hand_eye_calib.formats.journal import read_journal, replay_journal

    with waiting_for(f"reading {directory}"):
        journal = read_journal(directory)
        session = journal.about["parent"]
        # Skip empty options of an earlier version that no longer exist.
        before = {
            name: value
            for name, value in session.get("options", {}).items()
            if value or name in OPTION_FIELDS
        }
        config = CalibratorConfig.from_options(before | {**options})
        names = [field.name for field in dataclasses.fields(config)]
        given = [name for name in names if name in session.get("given", ())]
        given += CalibratorConfig.from_options(options).given
        calibrator = Calibrator(dataclasses.replace(config, given=given))
        replay_journal(journal, directory, Calibrators(child=calibrator))
    sources = {stream: journal.about.get(stream, {}).get("topic") or stream for stream in STREAMS}
    inputs = {"journal": str(directory), **calibrator.inputs(sources)}
    return Recording(calibrator.snapshot(), inputs, sorted(directory.glob("*.tum")))
