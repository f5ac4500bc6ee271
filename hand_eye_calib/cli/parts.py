"""Parts of one recording, or several recordings? They look alike on the command line."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry.trajectory import Trajectory

if TYPE_CHECKING:
    from hand_eye_calib.io.bags import PoseBag
    from hand_eye_calib.io.bags.topics import Source

# Who starts a recorder again needs less (s). Odometry seldom runs on from one drive to the next.
_LONGEST_PAUSE_S = 60.0
# A vehicle hardly moves so many times faster in a pause than it ever does beside it.
_FASTER = 2.0


class _Part(NamedTuple):
    """The poses of one source in one of the bags."""

    path: Path
    poses: Trajectory
    # Whether another bag has the same pose at a stamp, if it is of this recording. A path is
    # corrected as it grows; positions and rates begin anew in each bag.
    is_fixed: bool

    def first_ns(self) -> int:
        return int(self.poses.stamps_ns[0])

    def last_ns(self) -> int:
        return int(self.poses.stamps_ns[-1])


class SeveralRecordings(InputError):
    """Bags that are not parts of one recording; ``groups`` are the bags of each."""

    def __init__(self, reason: str, groups: list[list[Path]]) -> None:
        super().__init__(f"{reason}; calibrate each by itself, or all of one rig together")
        self.reason, self.groups = reason, groups


def refuse_recordings(
    bag: "PoseBag", sources: "Mapping[Source, str]", max_gap_s: float = CalibratorConfig.max_gap
) -> None:
    """Refuse bags that are not parts of one recording, after they were read together.

    Parts continue each other, hold different topics, or repeat the same poses, as two recorders do
    that run side by side. ``sources`` has what the poses of each topic or pair of frames are read
    as; poses of two parts may be out of order for ``max_gap_s``. Raises SeveralRecordings.
    """
    if len(bag.paths) < 2:
        return
    read = [_read(bag, source, measures) for source, measures in sources.items()]
    starts = {
        path: min(parts[path].first_ns() for parts in read if path in parts)
        for path in map(Path, bag.paths)
        if any(path in parts for parts in read)
    }
    groups: list[list[Path]] = []
    message = ""
    for path in sorted(starts, key=lambda each: starts[each]):
        for group in groups:
            told = _difference(path, group, zip(sources, read, strict=True), max_gap_s)
            message = message or told
            if not told:
                group.append(path)
                break
        else:
            groups.append([path])
    if len(groups) > 1:
        raise SeveralRecordings(message, groups)


def _read(bag: "PoseBag", source: "Source", measures: str) -> dict[Path, _Part]:
    """The poses of a source in each bag that has some."""
    if isinstance(source, str) and bag.expected(source) is not None:
        is_fixed = bag.measured(source, measures) == "poses"
        found = [_Part(*each, is_fixed) for each in bag.parts(source)]
    else:  # a path or transforms, which are put together from all bags
        alone = (_part(path, source, measures) for path in bag.paths)
        found = [part for part in alone if part is not None]
    return {Path(part.path): part for part in found}


def _difference(
    path: Path,
    group: list[Path],
    read: "Iterable[tuple[Source, dict[Path, _Part]]]",
    max_gap_s: float,
) -> str:
    """What tells that a bag is no part of the recording of others that begin before it; empty for
    nothing.
    """
    for source, parts in read:
        before = [parts[each] for each in group if each in parts]
        if path not in parts or not before:
            continue
        part = parts[path]
        in_order = sorted([*before, part], key=_Part.first_ns)
        at = in_order.index(part)
        earlier, later = in_order[:at], in_order[at + 1 :]
        differences = [(each, _overlap(each, part, max_gap_s)) for each in earlier]
        differences += [(each, _overlap(part, each, max_gap_s)) for each in later]
        if earlier:
            latest = max(earlier, key=_Part.last_ns)
            differences.append((latest, _break(latest, part)))
        differences += [(each, _break(part, each)) for each in later[:1]]
        for other, told in differences:
            if told:
                both = f"{other.path} and {part.path} are two recordings, not parts of one"
                return f"{both}: {source} {told}"
    return ""


def _part(path: Path, source: "Source", measures: str) -> _Part | None:
    """The poses of a source in one bag; None without any."""
    from hand_eye_calib.io.bags import PoseBag, trajectory_of

    with PoseBag(path) as bag:
        try:
            poses, _ = trajectory_of(bag, source, measures)
            return _Part(path, poses, not isinstance(source, str))
        except InputError:
            # It is no recording of its own: without the topic, or without the static transforms
            # that only a first part has. What is damaged is said when all parts are read.
            return None


def _overlap(first: _Part, second: _Part, max_gap_s: float) -> str:
    """What tells that poses of one time are not the same; empty for nothing."""
    one, two = first.poses, second.poses
    last_ns = min(first.last_ns(), second.last_ns())
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
    pause_s = float(second.poses.stamps_ns[0] - first.last_ns()) * 1e-9
    if pause_s > _LONGEST_PAUSE_S:
        return f"pauses for {pause_s:.0f} s between them"
    steps = [_steps(part.poses) for part in (first, second) if len(part.poses) > 1]
    if pause_s < 0 or not first.is_fixed or not steps:
        return ""
    distance = float(np.linalg.norm(second.poses.poses[0, :3, 3] - first.poses.poses[-1, :3, 3]))
    lengths, times_s = np.concatenate(steps, axis=1)
    furthest = _FASTER * (lengths / times_s).max() * max(pause_s, float(np.median(times_s)))
    if distance > furthest:
        return f"goes on {distance:.1f} m away after {pause_s:.1f} s, as if it had started again"
    return ""


def _steps(trajectory: Trajectory) -> np.ndarray:
    """Lengths (m) and times (s) from pose to pose, (2, N - 1)."""
    lengths = np.linalg.norm(np.diff(trajectory.poses[:, :3, 3], axis=0), axis=1)
    return np.stack([lengths, np.diff(trajectory.stamps_ns) * 1e-9])
