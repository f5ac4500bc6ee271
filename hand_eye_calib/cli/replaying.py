"""Feed the poses of a bag, or of a session's journal, to the engine in the order they came."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from itertools import chain, combinations, islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hand_eye_calib.arrays import IntArray
from hand_eye_calib.cli.console import note, waiting_for, with_progress
from hand_eye_calib.cli.present import convergence_line
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.errors import InputError, NotEnoughDataError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.results.calibration import Calibration

if TYPE_CHECKING:
    from hand_eye_calib.io.bags import PoseBag, PoseBlock
    from hand_eye_calib.io.transforms import TfSource

_STREAMS = ("parent", "child")
_NS_PER_S = 1_000_000_000
# Who starts a recorder again needs less (s). Odometry seldom runs on from one drive to the next.
_LONGEST_PAUSE_S = 60.0
# A vehicle hardly moves so many times faster in a pause than it ever does beside it.
_FASTER = 2.0


class _Output(NamedTuple):
    """How a replay says what it does."""

    note: Callable[[str], None]
    with_progress: Callable[..., Iterable[Any]]
    waiting_for: Callable[[str], AbstractContextManager[None]]


_LOUD = _Output(note, with_progress, waiting_for)
_SILENT = _Output(lambda text: None, lambda items, *_: items, lambda what: nullcontext())


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
    calibrator : Calibrator
        The engine, with all poses.
    convergence : list of dict
        Estimates on the way, in plain values.
    """

    calibration: Calibration
    inputs: dict[str, Any]
    files: list[Path]
    calibrator: Calibrator
    convergence: list[dict[str, Any]] = field(default_factory=list)


def replay(
    paths: Sequence[Path | str],
    parent: "str | TfSource | None",
    child: "str | TfSource | None",
    config: CalibratorConfig,
    every_s: float | None = None,
    quiet: bool = False,
) -> Replayed:
    """Calibrate from one bag, or from the parts of one recording.

    Parameters
    ----------
    paths : list of path-like
        Parts of one recording; see :func:`refuse_recordings`.
    parent, child : str, TfSource or None
        Topic or pair of frames; None if the bag leaves no choice.
    config : CalibratorConfig
    every_s : float, optional
        Bag time between estimates on the way.
    quiet : bool
        Print nothing on stderr; what there is to say of the data is among the calibration's
        warnings too.

    Returns
    -------
    Replayed

    Raises
    ------
    HandEyeCalibError
        If bag or poses cannot be used, or there are too few.
    """
    from hand_eye_calib.io.bags import PoseBag

    output = _SILENT if quiet else _LOUD
    calibrator = Calibrator(config)
    convergence = Convergence(calibrator, every_s) if every_s else None
    with PoseBag(*paths) as bag:
        sources = _sources(bag, parent, child, output)
        config = _measuring(bag, sources, config)
        with output.waiting_for("comparing the bags"):
            measures = {"parent": config.parent_measures, "child": config.child_measures}
            refuse_recordings(paths, sources, config.max_gap, measures)
        calibrator.reconfigure(config)
        warnings = _read(bag, sources, calibrator, convergence, output)
        files = bag.files()
    for text in warnings:
        output.note(text)
    with output.waiting_for("solving"):
        calibration = calibrator.estimate()
    calibration = dataclasses.replace(calibration, warnings=(*calibration.warnings, *warnings))
    inputs = {"bag": str(bag), **calibrator.inputs(sources)}
    history = convergence.history if convergence else []
    return Replayed(calibration, inputs, files, calibrator, history)


def journal_in(paths: Sequence[Path]) -> Path | None:
    """The directory of the session's journal that is to be replayed; None for bags."""
    from hand_eye_calib.io.journal import has_session

    if len(paths) != 1:
        return None
    found = (path for path in (paths[0], paths[0] / "journal") if has_session(path))
    return next(found, None)


def replay_journal(directory: Path, options: Mapping[str, Any]) -> Replayed:
    """Calibrate from the journal of a session of the node.

    Parameters
    ----------
    directory : pathlib.Path
    options : mapping
        Options by their public names; they go before those of the session.

    Returns
    -------
    Replayed

    Raises
    ------
    HandEyeCalibError
        If the journal cannot be used, or has too few poses.
    """
    from hand_eye_calib.io.journal import read_journal
    from hand_eye_calib.ros.session_journal import give

    with waiting_for(f"reading {directory}"):
        journal = read_journal(directory)
        session = journal.about["parent"]
        config = CalibratorConfig.from_options({**session.get("options", {}), **options})
        names = [each.name for each in dataclasses.fields(config)]
        given = [name for name in names if name in session.get("given", ())]
        given += CalibratorConfig.from_options(options).given
        calibrator = Calibrator(dataclasses.replace(config, given=given))
        give(journal, directory, calibrator)
    with waiting_for("solving"):
        calibration = calibrator.estimate()
    sources = {stream: journal.about.get(stream, {}).get("topic") or stream for stream in _STREAMS}
    inputs = {"journal": str(directory), **calibrator.inputs(sources)}
    return Replayed(calibration, inputs, sorted(directory.glob("*.tum")), calibrator)


def _sources(
    bag: "PoseBag",
    parent: "str | TfSource | None",
    child: "str | TfSource | None",
    output: _Output,
) -> dict[str, Any]:
    """Topic or frames of each stream; a note if the bag left no choice."""
    sources = dict(zip(_STREAMS, bag.select_topics(parent, child), strict=True))
    if not (parent and child):
        output.note(
            f"parent is {sources['parent']}, child is {sources['child']}; to change that, give "
            "--parent-topic and --child-topic"
        )
    return sources


def _measuring(
    bag: "PoseBag", sources: Mapping[str, Any], config: CalibratorConfig
) -> CalibratorConfig:
    """The options with what the messages of each stream measure."""
    names = {stream: f"{stream}_measures" for stream in _STREAMS}
    measured: dict[str, Any] = {
        name: bag.measured(sources[stream], getattr(config, name)) for stream, name in names.items()
    }
    return dataclasses.replace(config, **measured)


def _read(
    bag: "PoseBag",
    sources: Mapping[str, Any],
    calibrator: Calibrator,
    convergence: "Convergence | None",
    output: _Output,
) -> list[str]:
    """Give all poses of a bag to the engine; returns what there is to say of the bag."""
    parent, child = (sources[stream] for stream in _STREAMS)
    config = calibrator.config
    measures = {"parent": config.parent_measures, "child": config.child_measures}
    blocks = bag.blocks(parent, child, config.max_gap, measures)
    with output.waiting_for(f"opening {bag}"):
        blocks = _started(blocks)
    expected = bag.expected(parent, child)
    shown = output.with_progress(blocks, expected, f"reading {bag}", len)
    found = feed(calibrator, shown, sources, convergence) + bag.n_left_out
    warnings = list(bag.warnings)
    if expected is not None and found != expected:
        warnings.append(
            f"{bag} says it has {expected} messages on these topics, but {found} could be read; it "
            "may be damaged"
        )
    return warnings


def feed(
    calibrator: Calibrator,
    blocks: "Iterable[PoseBlock]",
    topics: Mapping[str, Any],
    convergence: "Convergence | None" = None,
) -> int:
    """Give every pose to the engine.

    Parameters
    ----------
    calibrator : Calibrator
    blocks : iterable of PoseBlock
    topics : mapping
        "parent" and "child" to the names of their topics, for messages.
    convergence : Convergence, optional
        Told the bag time of every pose.

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
        for first, last in pairwise(_cuts(block, frames, convergence)):
            part = block[first:last]
            if convergence is not None:
                convergence.reached(int(part.bag_ns[0]))
            try:
                _add(calibrator, part, frames)
            except InputError as error:
                raise InputError(f"{_place(part, topics, error)}: {error}") from error
    return count


def _cuts(
    block: "PoseBlock",
    frames: set[tuple[str, str | None]],
    convergence: "Convergence | None",
) -> list[int]:
    """Rows at which a block is cut, first and last included: where a frame name appears for the
    first time, or an estimate is due.
    """
    first_rows: dict[tuple[str, str | None], int] = {}
    named = zip(block.streams.tolist(), block.sensor_frames.tolist(), strict=True)
    for row, pair in enumerate(named):
        if pair not in frames:
            first_rows.setdefault(pair, row)
    due = convergence.cuts(block.bag_ns) if convergence else []
    return sorted({0, len(block), *first_rows.values(), *due})


def _add(calibrator: Calibrator, part: "PoseBlock", frames: set[tuple[str, str | None]]) -> None:
    """Add poses; the first of them may name a frame that is new."""
    pair = (part.streams[0], part.sensor_frames[0])
    if pair not in frames:
        calibrator.set_frame(*pair)
        frames.add(pair)
    calibrator.add_poses(part.streams, part.stamps_ns, part.poses[:, :3], part.poses[:, 3:])


def _place(part: "PoseBlock", topics: Mapping[str, Any], error: InputError) -> str:
    """Topic, message number and stamp of the message that was refused."""
    row = getattr(error, "index", 0)
    seconds, nanoseconds = divmod(int(part.stamps_ns[row]), _NS_PER_S)
    topic = topics[part.streams[row]]
    return f"{topic}, message {part.message_numbers[row]}, stamp {seconds}.{nanoseconds:09d}"


class Convergence:
    """Estimates on the way, one in each period of bag time.

    Parameters
    ----------
    calibrator : Calibrator
    every_s : float

    Attributes
    ----------
    history : list of dict
        Bag time in seconds since the first message, and the calibration in plain values, or why
        there was none.
    """

    def __init__(self, calibrator: Calibrator, every_s: float) -> None:
        self.history: list[dict[str, Any]] = []
        self._calibrator, self._every_ns = calibrator, round(every_s * _NS_PER_S)
        self._first_ns: int | None = None
        self._next_ns = 0

    def cuts(self, bag_ns: IntArray) -> list[int]:
        """Indices in an array of bag times at which another period may begin."""
        first_ns = bag_ns[0] if self._first_ns is None else self._first_ns
        return (np.flatnonzero(np.diff((bag_ns - first_ns) // self._every_ns)) + 1).tolist()

    def reached(self, bag_ns: int) -> None:
        """Estimate if another period has passed; to be called before that message is added."""
        if self._first_ns is None:
            self._first_ns, self._next_ns = bag_ns, bag_ns + self._every_ns
        if bag_ns < self._next_ns:
            return
        periods = (bag_ns - self._first_ns) // self._every_ns
        self._next_ns = self._first_ns + (periods + 1) * self._every_ns
        self.history.append({"bag_time_s": periods * self._every_ns / _NS_PER_S} | self._estimate())
        note(convergence_line(self.history[-1]))

    def _estimate(self) -> dict[str, Any]:
        try:
            return {"calibration": self._calibrator.estimate().to_dict()}
        except NotEnoughDataError as error:
            return {"calibration": None, "reason": str(error)}


def fingerprints(files: Sequence[Path], quiet: bool = False) -> list[dict[str, Any]]:
    """Name, size and SHA-256 of the files that were read."""
    from hand_eye_calib.io.results import fingerprint

    output = _SILENT if quiet else _LOUD
    return [fingerprint(file) for file in output.with_progress(files, len(files), "hashing")]


def _started(blocks: Iterator[Any]) -> Iterator[Any]:
    """The same blocks, after what a bag has to do before the first of them."""
    return chain(list(islice(blocks, 1)), blocks)


# ------------------------------- parts of one recording, or several recordings


class _Part(NamedTuple):
    """The poses of one stream in one of the bags."""

    path: Path | str
    poses: Trajectory
    # Whether another bag has the same pose at a stamp, if it is of this recording. A path is
    # corrected as it grows; positions and rates begin anew in each bag.
    is_fixed: bool

    @property
    def first_s(self) -> float:
        return float(self.poses.stamps_ns[0]) * 1e-9

    @property
    def last_s(self) -> float:
        return float(self.poses.stamps_ns[-1]) * 1e-9


def refuse_recordings(
    paths: Sequence[Path | str],
    sources: "Mapping[str, str | TfSource]",
    max_gap_s: float,
    measures: Mapping[str, str] | None = None,
) -> None:
    """Refuse bags that are not parts of one recording.

    Parts continue each other, hold different topics, or repeat the same poses, as two recorders do
    that run side by side.

    Parameters
    ----------
    paths : sequence of path-like
    sources : mapping
        "parent" and "child" to a topic or a pair of frames.
    max_gap_s : float
        Poses of two parts may be out of order for so long.
    measures : mapping, optional
        "parent" and "child" to what their poses are read as.

    Raises
    ------
    InputError
        If two bags are recordings of their own; the message names them and says why.
    """
    if len(paths) < 2:
        return
    for stream, source in sources.items():
        read = (_part(path, source, (measures or {}).get(stream, "auto")) for path in paths)
        parts = sorted(filter(None, read), key=lambda part: part.first_s)
        latest: _Part | None = None
        for first, second in combinations(parts, 2):
            if difference := _overlap(first, second, max_gap_s):
                raise _refusal(first, second, source, difference)
        for part in parts:
            if latest is not None and (difference := _break(latest, part)):
                raise _refusal(latest, part, source, difference)
            latest = part if latest is None else max(latest, part, key=lambda each: each.last_s)


def _refusal(first: _Part, second: _Part, source: Any, difference: str) -> InputError:
    return InputError(
        f"{first.path} and {second.path} are two recordings, not parts of one: {source} "
        f"{difference}; calibrate each by itself, or all with --batch FILE, which lists them"
    )


def _part(path: Path | str, source: "str | TfSource", measures: str) -> _Part | None:
    """The poses of a source in one bag; None without any."""
    from hand_eye_calib.io.bags import PoseBag, trajectory_of
    from hand_eye_calib.io.bags.messages import PATH_TYPE

    with PoseBag(path) as bag:
        paths = {topic.name for topic in bag.topics() if topic.type == PATH_TYPE}
        try:
            poses, _ = trajectory_of(bag, source, measures)
            return _Part(path, poses, poses.measures == "poses" and source not in paths)
        except InputError:
            # It is no recording of its own: without the topic, or without the static transforms
            # that only a first part has. What is damaged is said when all parts are read.
            return None


def _overlap(first: _Part, second: _Part, max_gap_s: float) -> str:
    """What tells that poses of one time are not the same; empty for nothing."""
    one, two = first.poses, second.poses
    last_ns = min(one.stamps_ns[-1], two.stamps_ns[-1])
    overlap_s = (last_ns - two.stamps_ns[0]) * 1e-9
    if overlap_s <= max_gap_s:
        return ""
    shared, rows, others = np.intersect1d(
        one.stamps_ns, two.stamps_ns, assume_unique=True, return_indices=True
    )
    is_same = np.ones(len(shared), dtype=bool)
    if first.is_fixed and second.is_fixed:
        is_same = (one.poses[rows] == two.poses[others]).all(axis=(1, 2))
    count = min(
        int(((each.stamps_ns >= two.stamps_ns[0]) & (each.stamps_ns <= last_ns)).sum())
        for each in (one, two)
    )
    if is_same.sum() >= count / 2:
        return ""
    return f"has different poses in both for {overlap_s:.1f} s of the same time"


def _break(first: _Part, second: _Part) -> str:
    """What tells that a part does not continue one before; empty for nothing."""
    pause_s = second.first_s - first.last_s
    if pause_s > _LONGEST_PAUSE_S:
        return f"pauses for {pause_s:.0f} s between them"
    if pause_s < 0 or not first.is_fixed:
        return ""
    distance = float(np.linalg.norm(second.poses.poses[0, :3, 3] - first.poses.poses[-1, :3, 3]))
    steps = [_steps(part.poses) for part in (first, second) if len(part.poses) > 1]
    if not steps:
        return ""
    lengths, times_s = np.concatenate(steps, axis=1)
    furthest = _FASTER * (lengths / times_s).max() * max(pause_s, float(np.median(times_s)))
    if distance > furthest:
        return f"goes on {distance:.1f} m away after {pause_s:.1f} s, as if it had started again"
    return ""


def _steps(trajectory: Trajectory) -> np.ndarray:
    """Lengths (m) and times (s) from pose to pose, (2, N - 1)."""
    lengths = np.linalg.norm(np.diff(trajectory.poses[:, :3, 3], axis=0), axis=1)
    return np.stack([lengths, np.diff(trajectory.stamps_ns) * 1e-9])
