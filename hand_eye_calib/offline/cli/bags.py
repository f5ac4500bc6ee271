"""Read a recording from a bag, from several bags that are its parts, or from a journal."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.option import Options
from hand_eye_calib.core.engine.calibrator import Calibrator, Calibrators
from hand_eye_calib.core.geometry.span import WHOLE, Span
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.bags.pose_table import PoseTable
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.formats.bags.sources import Source, source_of
from hand_eye_calib.formats.trajectory_files.dates import seconds
from hand_eye_calib.offline.beside_motion import with_measurements
from hand_eye_calib.offline.cli.options import (
    OPTION_FIELDS,
    STREAMS,
    note,
    waiting_for,
    with_progress,
)
from hand_eye_calib.offline.cli.reading import Recording

# Longest pause (s) between the parts of a recording. A recorder restarts in less time. In a longer
# pause, odometry has often restarted as well.
_MAX_PAUSE_S = 60.0
# Longest overlap (s) of successive parts: the last poses of a part may be written after the next
# part has begun.
_MAX_OVERLAP_S = 1.0


class SeveralRecordingsError(InputError):
    """Error for bags that are not parts of one recording.

    Attributes
    ----------
    reason : str
        Bags that are different recordings, and the reason.
    groups : list of list of pathlib.Path
        Bags of each recording.
    """

    def __init__(self, reason: str, groups: list[list[Path]]) -> None:
        super().__init__(
            f"{reason}; calibrate each recording by itself, or all recordings of one rig together"
        )
        self.reason = reason
        self.groups = groups


def read_recording(
    paths: Sequence[Path],
    wanted: Mapping[str, str],
    options: Mapping[str, Any],
    without: Collection[str] = (),
    span: Span = WHOLE,
) -> Recording:
    """Read the recording of a journal, of a bag or of the parts of a bag.

    Parameters
    ----------
    paths : sequence of pathlib.Path
    wanted : mapping of str to str
        Sources and stamps of the streams, as returned by ``options.sources_from``. A source may be
        absent if the bag has only one candidate.
    options : mapping
        Options that the user has set.
    without : collection of str
        Names of the measurements that need no motion and are switched off.
    span : Span
        Part of the recording to use.

    Raises
    ------
    SeveralRecordingsError
        If the paths are not parts of one recording. Each journal is a recording.
    ConfigError
        If a journal is read with options that apply to bags only.
    """
    journals = [journal for path in paths if (journal := journal_in(path))]
    journal = journals[0] if journals else None
    if journal and len(paths) > 1:
        raise SeveralRecordingsError(
            f"the journal {journal} is a recording of its own",
            [[path] for path in paths],
        )
    if journal is None:
        recording = _read_bags(
            paths, wanted, CalibratorConfig.from_options(dict(options)), span
        )
        with waiting_for("looking for the ground and gravity"):
            recording.snapshot, notes = with_measurements(
                recording.snapshot, paths, without
            )
        note(*notes)
        return recording
    if wanted:
        raise ConfigError(
            f"the journal {journal} has two streams; omit the options for topics, frames and stamps"
        )
    if span:
        raise ConfigError(
            "a journal is used as a whole; for a part, calibrate its files: hand_eye_calib "
            f"calibrate {journal}/parent.tum {journal}/child.tum, with `start` and `end`"
        )
    return read_journal_of(journal, options)


def select(
    bag: PoseBag, wanted: Mapping[str, str], config: CalibratorConfig
) -> tuple[dict[str, Source], dict[str, str]]:
    """Choose the sources of "parent" and "child" in a bag.

    Returns
    -------
    sources : dict of str to Source
        Topic or frames of each stream.
    measures : dict of str to str
        Quantity that each stream measures, such as "poses".
    """
    named = {
        stream: source_of(wanted[stream])
        for stream in STREAMS
        if stream in wanted
    }
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
    """Return the stamps to use for "parent" and "child": "header" or "receive"."""
    return {
        stream: wanted.get(f"{stream}_stamps", "header") for stream in STREAMS
    }


def read_sources(
    bag: PoseBag,
    measures: Sequence[tuple[Source, str, str]],
    span: Span = WHOLE,
) -> tuple[list[Trajectory], list[str]]:
    """Read the trajectories of sources of a bag.

    Parameters
    ----------
    bag : PoseBag
    measures : sequence of (Source, str, str)
        Sources, their quantities, and the stamps to use: "header" or "receive".
    span : Span
        Part of the recording to use.

    Returns
    -------
    trajectories : list of Trajectory
    repairs : list of str
        Notes on stamps that were repaired.
    """
    trajectories = []
    repairs: list[str] = []
    # Errors name the options of a stream. All sensors of a rig share these options.
    streams = (
        STREAMS
        if len(measures) == len(STREAMS)
        else [STREAMS[0]] * len(measures)
    )
    for stream, (source, kind, stamps) in zip(streams, measures, strict=True):
        with waiting_for(f"reading {source}"):
            trajectory, notes = bag.trajectory(source, kind, stamps, stream)
        trajectories.append(trajectory)
        repairs += notes
    note(*bag.warnings)
    names = [str(source) for source, _, _ in measures]
    return span.cut(trajectories, names), repairs


def _read_bags(
    paths: Sequence[Path],
    wanted: Mapping[str, str],
    config: CalibratorConfig,
    span: Span,
) -> Recording:
    """Read the parts of one recording, and feed the poses to an engine."""
    with PoseBag(*paths) as bag:
        sources, measures = select(bag, wanted, config)
        refuse_recordings(paths, sources.values())
        kinds: Options = {
            f"{stream}_measures": measures[stream] for stream in STREAMS
        }
        calibrator = Calibrator(dataclasses.replace(config, **kinds))
        bag.shown = with_progress
        stamps = stamps_of(wanted)
        poses = bag.poses(
            sources["parent"],
            sources["child"],
            config.max_gap,
            measures,
            stamps,
        )
        _feed(calibrator, _part_of(poses, span, sources), sources)
        for stream, source in sources.items():
            if not calibrator.frame(stream):
                calibrator.set_frame(stream, str(source))
        note(*bag.warnings)
        inputs = {"bag": str(bag), **calibrator.inputs(sources)}
        return Recording(
            calibrator.snapshot(), inputs, bag.files, tuple(bag.warnings)
        )


def _part_of(
    poses: PoseTable, span: Span, sources: Mapping[str, Source]
) -> PoseTable:
    """Return the poses of both streams in a span."""
    of_streams = [np.flatnonzero(poses.streams == stream) for stream in STREAMS]
    # A stream without poses is refused later.
    if not span or not all(map(len, of_streams)):
        return poses
    stamps_ns = [poses.stamps_ns[rows] for rows in of_streams]
    masks = span.rows(stamps_ns, [str(sources[stream]) for stream in STREAMS])
    kept = [rows[mask] for rows, mask in zip(of_streams, masks, strict=True)]
    return poses[np.sort(np.concatenate(kept))]


def _feed(
    calibrator: Calibrator, poses: PoseTable, topics: Mapping[str, Source]
) -> None:
    """Add every pose to the engine.

    Raises
    ------
    InputError
        If the engine refuses a message; the error names topic and stamp.
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


def refuse_recordings(
    paths: Sequence[Path], sources: Collection[Source]
) -> None:
    """Raise a SeveralRecordingsError for bags that are not parts of one recording.

    Two parts of one recording have different topics, or one part follows the other without a pause.
    """
    if len(paths) < 2:
        return
    recordings: list[list[_Bag]] = []
    reason = ""
    for bag in sorted(_Bag.of(path, sources) for path in paths):
        for recording in recordings:
            with_same_topics = [
                earlier
                for earlier in recording
                if earlier.sources & bag.sources
            ]
            difference = bag.difference_from(with_same_topics)
            if not difference:
                recording.append(bag)
                break
            reason = difference
        else:
            recordings.append([bag])
    if len(recordings) > 1:
        groups = [[bag.path for bag in recording] for recording in recordings]
        raise SeveralRecordingsError(reason, groups)


class _Bag(NamedTuple):
    """Times (ns) and sources of a bag. Bags are sorted by their times."""

    begin_ns: int
    end_ns: int
    path: Path
    sources: set[Source]

    @classmethod
    def of(cls, path: Path, candidates: Collection[Source]) -> Self:
        """Read the times of a bag, and the sources among the candidates that it contains."""
        sources = set()
        with PoseBag(path) as bag:
            for source in candidates:
                with suppress(InputError):
                    bag.check(source)
                    sources.add(source)
            return cls(bag.start_ns or 0, bag.end_ns or 0, path, sources)

    def difference_from(self, earlier: "Sequence[_Bag]") -> str:
        """Return the reason why the bag does not continue earlier bags; empty if it does."""
        if not earlier:
            return ""
        latest = max(earlier, key=lambda bag: bag.end_ns)
        pause_s = (self.begin_ns - latest.end_ns) * 1e-9
        if -_MAX_OVERLAP_S <= pause_s <= _MAX_PAUSE_S:
            return ""
        reason = f"there is a pause of {pause_s:.0f} s between them"
        if pause_s < 0:
            until_ns = min(latest.end_ns, self.end_ns)
            reason = (
                f"both cover the same {(until_ns - self.begin_ns) * 1e-9:.1f} s"
            )
        return f"{latest.path} and {self.path} are two recordings, not parts of one: {reason}"


def journal_in(path: Path | str) -> Path | None:
    """Return the directory of the journal at a path; None if the path is a bag.

    The path is this directory, or the output directory of a node that contains it.
    """
    if isinstance(path, str) or not path.is_dir():
        return None
    from hand_eye_calib.formats.journal import has_session

    return next(
        (folder for folder in (path, path / "journal") if has_session(folder)),
        None,
    )


def read_journal_of(directory: Path, options: Options) -> Recording:
    """Read the journal of a session of the node.

    The options that the user has set override those of the session.
    """
    from hand_eye_calib.formats.journal import read_journal, replay_journal

    with waiting_for(f"reading {directory}"):
        journal = read_journal(directory)
        session = journal.about["parent"]
        # The session may be of an earlier version. An option that no longer exists is skipped if
        # its value is empty; otherwise it is an error.
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
    sources = {
        stream: journal.about.get(stream, {}).get("topic") or stream
        for stream in STREAMS
    }
    inputs = {"journal": str(directory), **calibrator.inputs(sources)}
    return Recording(
        calibrator.snapshot(), inputs, sorted(directory.glob("*.tum"))
    )
