"""Parts of one recording, or several recordings? They look alike on the command line."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry.trajectory import Trajectory

if TYPE_CHECKING:
    from hand_eye_calib.io.bags.topics import Source

# Who starts a recorder again needs less (s). Odometry seldom runs on from one drive to the next.
_LONGEST_PAUSE_S = 60.0
# A vehicle hardly moves so many times faster in a pause than it ever does beside it.
_FASTER = 2.0


_Part = dict["Source", tuple[Trajectory, bool]]


class SeveralRecordings(InputError):
    """Bags that are not parts of one recording; ``groups`` are the bags of each."""

    def __init__(self, reason: str, groups: list[list[Path]]) -> None:
        super().__init__(f"{reason}; calibrate each by itself, or all of one rig together")
        self.reason, self.groups = reason, groups


def refuse_recordings(
    paths: Sequence[str | Path],
    sources: "Mapping[Source, str]",
    max_gap_s: float = CalibratorConfig.max_gap,
) -> None:
    """Raise SeveralRecordings for bags that are not parts of one recording: parts continue each
    other, hold different topics, or repeat the same poses, as two recorders do that run side by
    side. ``sources`` has what each topic or pair of frames is read as; poses of two parts may be
    out of order for ``max_gap_s``.
    """
    if len(paths) < 2:
        return
    parts = {Path(path): _poses_in(path, sources) for path in paths}
    starts = {
        path: min(int(poses.stamps_ns[0]) for poses, _ in part.values())
        for path, part in parts.items()
        if part
    }
    groups: list[list[Path]] = []
    reason = ""
    for path in sorted(starts, key=lambda each: starts[each]):
        for group in groups:
            told = _difference(path, group, parts, max_gap_s)
            reason = reason or told
            if not told:
                group.append(path)
                break
        else:
            groups.append([path])
    if len(groups) > 1:
        raise SeveralRecordings(reason, groups)


def _poses_in(path: str | Path, sources: "Mapping[Source, str]") -> _Part:
    """The poses of each source in one bag, and whether another bag has the same pose at a stamp if
    it is of this recording: a path is corrected as it grows, positions and rates begin anew.
    """
    from hand_eye_calib.io.bags import PoseBag, trajectory_of

    found: _Part = {}
    with PoseBag(path) as bag:
        for source, measures in sources.items():
            # Without the topic, or the static transforms that only a first part has, it is no
            # recording of its own. What is damaged was said when all parts were read.
            with suppress(InputError):
                poses, _ = trajectory_of(bag, source, measures)
                is_path = isinstance(source, str) and bag.expected(source) is None
                found[source] = poses, poses.measures == "poses" and not is_path
    return found


def _difference(
    path: Path, group: Sequence[Path], parts: Mapping[Path, _Part], max_gap_s: float
) -> str:
    """What tells that a bag is no part of the recording of others that begin before it; empty for
    nothing.
    """
    for source, (poses, is_fixed) in parts[path].items():
        before = {each: parts[each][source] for each in group if source in parts[each]}
        if before:
            latest = max(before, key=lambda each: int(before[each][0].stamps_ns[-1]))
            earlier, was_fixed = before[latest]
            if told := _break(earlier, poses, max_gap_s, is_fixed and was_fixed):
                both = f"{latest} and {path} are two recordings, not parts of one"
                return f"{both}: {source} {told}"
    return ""


def _break(one: Trajectory, two: Trajectory, max_gap_s: float, is_fixed: bool) -> str:
    """What tells that two parts neither repeat nor continue each other; empty for nothing."""
    one, two = sorted((one, two), key=lambda each: int(each.stamps_ns[0]))
    begin_ns, end_ns = two.stamps_ns[0], min(one.stamps_ns[-1], two.stamps_ns[-1])
    pause_s, overlap_s = ((begin_ns - one.stamps_ns[-1]) * 1e-9, (end_ns - begin_ns) * 1e-9)
    if pause_s > _LONGEST_PAUSE_S:
        return f"pauses for {pause_s:.0f} s between them"
    if overlap_s > max_gap_s:
        _, rows, others = np.intersect1d(one.stamps_ns, two.stamps_ns, return_indices=True)
        is_same = (one.poses[rows] == two.poses[others]).all(axis=(1, 2)) | (not is_fixed)
        inside = (each.stamps_ns[each.stamps_ns >= begin_ns] for each in (one, two))
        if is_same.sum() < min((stamps_ns <= end_ns).sum() for stamps_ns in inside) / 2:
            return f"has different poses in both for {overlap_s:.1f} s of the same time"
    if pause_s >= 0 and is_fixed and len(one) + len(two) > 2:
        pairs = [np.diff(each.poses[:, :3, 3], axis=0) for each in (one, two)]
        lengths = np.linalg.norm(np.concatenate(pairs), axis=1)
        times_s = np.concatenate([np.diff(each.stamps_ns) for each in (one, two)]) * 1e-9
        distance = float(np.linalg.norm(two.poses[0, :3, 3] - one.poses[-1, :3, 3]))
        if distance > _FASTER * (lengths / times_s).max() * max(pause_s, np.median(times_s)):
            away = f"goes on {distance:.1f} m away after {pause_s:.1f} s"
            return f"{away}, as if it had started again"
    return ""
