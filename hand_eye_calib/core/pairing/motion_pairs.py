"""Pose pairs and motion pairs of two streams.

Pose pairs are poses of both sensors at common instants, by interpolation. Motion pairs are relative
motions A and B of both sensors between two of these instants: the input of every AX = XB solver
(Välimäki et al. 2023, eqs 1-2).
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.base.text import parse_reference
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Columns, Trajectory

# Streams whose median intervals differ by less than this factor are paired at the child's stamps.
_EQUALLY_FAST = 1.2

# Number of poses that are checked at once for the next keyframe.
_WINDOW = 64

# Longest pause of a recording, s: after a longer one, the stamps are wrong.
_LEAP_S = 86_400.0

# Largest number of motion pairs of a fit, unless the fit needs more.
MAX_PAIRS = 800


@dataclass(frozen=True, eq=False)
class PosePairs(Columns):
    """Poses of both sensors at common instants.

    Attributes
    ----------
    stamps_ns : (N,) int64 array
        Parent clock, strictly increasing.
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Pose of each sensor in its own world.
    """

    stamps_ns: IntArray
    Ts_pw_p: FloatArray
    Ts_cw_c: FloatArray

    def child_scaled(self, factor: float) -> Self:
        """Return the poses with the child's translations multiplied by ``factor``."""
        Ts_cw_c = self.Ts_cw_c.copy()
        Ts_cw_c[:, :3, 3] *= factor
        return replace(self, Ts_cw_c=Ts_cw_c)

    @classmethod
    def empty(cls) -> Self:
        """Return pairs of length 0."""
        return cls(np.empty(0, dtype=np.int64), np.empty((0, 4, 4)), np.empty((0, 4, 4)))


def slower_stream(parent_stamps_ns: IntArray, child_stamps_ns: IntArray) -> str:
    """Return the stream with the longer median interval, "parent" or "child".

    It is the child if both intervals are about equal, or if a stream has fewer than two stamps.
    """
    if len(parent_stamps_ns) < 2 or len(child_stamps_ns) < 2:
        return "child"
    interval_parent = median(np.diff(parent_stamps_ns))
    interval_child = median(np.diff(child_stamps_ns))
    return "parent" if interval_parent > _EQUALLY_FAST * interval_child else "child"


def synchronise(
    parent: Trajectory, child: Trajectory, max_gap_s: float, at: str | None = None
) -> PosePairs:
    """Interpolate the faster stream at the slower stream's stamps.

    Instants outside the faster stream are skipped, and instants between two of its poses that are
    more than ``max_gap_s`` apart. An instant at which the faster stream has a pose is always used.

    Parameters
    ----------
    parent, child : Trajectory
        On one clock.
    max_gap_s : float
        Seconds.
    at : {"parent", "child"}, optional
        Stream whose stamps the pairs have; the slower one by default.
    """
    if len(parent) == 0 or len(child) == 0:
        return PosePairs.empty()
    at = at or slower_stream(parent.stamps_ns, child.stamps_ns)
    slow, fast = (parent, child) if at == "parent" else (child, parent)
    after = np.searchsorted(fast.stamps_ns, slow.stamps_ns)
    is_inside = after < len(fast)
    after = np.minimum(after, len(fast) - 1)
    gap_ns = fast.stamps_ns[after] - fast.stamps_ns[np.maximum(after - 1, 0)]
    is_exact = fast.stamps_ns[after] == slow.stamps_ns
    is_interpolated = (after > 0) & (gap_ns <= max_gap_s * 1e9)
    is_used = is_inside & (is_exact | is_interpolated)
    stamps_ns = slow.stamps_ns[is_used]
    slow_poses = slow.poses[is_used]
    if len(fast) == 1:
        fast_poses = np.repeat(fast.poses, len(stamps_ns), axis=0)
    else:
        fast_poses = fast.at(stamps_ns)
    if at == "parent":
        return PosePairs(stamps_ns, slow_poses, fast_poses)
    return PosePairs(stamps_ns, fast_poses, slow_poses)


def select_keyframes(
    pose_pairs: PosePairs,
    min_translation: float,
    min_rotation: float,
    min_interval_s: float,
    previous: PosePairs | None = None,
) -> IntArray:
    """Return the indices of the keyframes among pose pairs, in order.

    A pose pair is a keyframe if ``min_interval_s`` has passed since the last keyframe and the
    parent sensor has moved ``min_translation`` or rotated by ``min_rotation`` since. A threshold of
    zero switches its criterion off.

    Parameters
    ----------
    pose_pairs : PosePairs
    min_translation, min_rotation, min_interval_s : float
        Thresholds in m, rad and s.
    previous : PosePairs, optional
        The last keyframe before these pose pairs, of length 1; of length 0 for none.
    """
    n_poses = len(pose_pairs)
    if n_poses == 0 or max(min_translation, min_rotation, min_interval_s) == 0.0:
        return np.arange(n_poses)
    stamps_ns = pose_pairs.stamps_ns
    poses = pose_pairs.Ts_pw_p
    if previous is not None and len(previous):
        keyframes = []
        last_ns = previous.stamps_ns[-1]
        T_last = previous.Ts_pw_p[-1]
    else:
        keyframes = [0]
        last_ns = stamps_ns[0]
        T_last = poses[0]
    index = len(keyframes)
    while index < n_poses:
        window = slice(index, index + _WINDOW)
        is_late = stamps_ns[window] - last_ns >= min_interval_s * 1e9
        has_moved = np.full(len(is_late), max(min_translation, min_rotation) == 0.0)
        if min_translation > 0.0:
            distances_m = np.linalg.norm(poses[window, :3, 3] - se3.translation_of(T_last), axis=1)
            has_moved |= distances_m >= min_translation
        if min_rotation > 0.0:
            angles = se3.rotation_angle(se3.rotation_of(T_last).T @ poses[window, :3, :3])
            has_moved |= angles >= min_rotation
        candidates = np.flatnonzero(is_late & has_moved)
        if not candidates.size:
            index += _WINDOW
            continue
        keyframe = index + int(candidates[0])
        keyframes.append(keyframe)
        last_ns = stamps_ns[keyframe]
        T_last = poses[keyframe]
        index = keyframe + 1
    return np.array(keyframes, dtype=int)


def find_leap(stamps_ns: IntArray) -> tuple[str, str] | None:
    """Find a leap of more than a day in the rising stamps (N,) of a stream.

    Returns
    -------
    (str, str) or None
        What is wrong, as a text to follow "the parent stream's", and what to do; None without a
        leap.
    """
    if len(stamps_ns) < 2:
        return None
    intervals_s = np.diff(stamps_ns) * 1e-9
    count = len(stamps_ns)
    before = int(np.argmax(intervals_s)) + 1
    days = float(intervals_s[before - 1]) / _LEAP_S
    if days <= 1.0:
        return None
    few = f"the first {before}" if before < count - before else f"the last {count - before}"
    what = f"stamps leap by {days:,.0f} days after pose {before} of {count}"
    return what, f"repair the stamps, or remove {few} of its poses"


@dataclass(frozen=True, eq=False)
class MotionPairs(Columns):
    """Relative motions of both sensors between the same instants i and j, K of them.

    Attributes
    ----------
    Ts_parenti_parentj : (K, 4, 4) array
        Motion of the parent sensor, ``inv(T_pw_p(i)) @ T_pw_p(j)``: A of AX = XB.
    Ts_childi_childj : (K, 4, 4) array
        Motion of the child sensor: B.
    i, j : (K,) int arrays
        Indices of the poses the motions run between.
    """

    Ts_parenti_parentj: FloatArray
    Ts_childi_childj: FloatArray
    i: IntArray
    j: IntArray

    def residuals(self, T_parent_child: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the residuals (K, 3) of translation and (K, 3) of rotation at X (4, 4).

        Translation: ``R_A t + t_A - R t_B - t`` in m, in the axes of the parent sensor at instant
        i: Välimäki et al. 2023, eq. (6). The article prints the last term with the opposite sign;
        its published results have this sign. Rotation: rotation vectors in rad, in the axes of the
        child sensor at instant j, from ``R_A R`` to ``R R_B``. Their lengths are the angles of
        eq. (7).
        """
        rotation = se3.rotation_of(T_parent_child)
        translation = se3.translation_of(T_parent_child)
        chord = se3.rotation_of(self.Ts_parenti_parentj) - np.eye(3)
        moved_child = se3.translation_of(self.Ts_childi_childj) @ rotation.T
        of_translation = (
            chord @ translation + se3.translation_of(self.Ts_parenti_parentj) - moved_child
        )
        via_parent = se3.rotation_of(self.Ts_parenti_parentj) @ rotation
        via_child = rotation @ se3.rotation_of(self.Ts_childi_childj)
        return of_translation, se3.rotations_between(via_parent, via_child)


def motion_pairs(Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, reference: str) -> MotionPairs:
    """Return the relative motions of two synchronised trajectories between referenced poses.

    Parameters
    ----------
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Poses of parent and child sensor in their own worlds at the same N instants.
    reference : str
        ``"A"``: every pose with the first. ``"B<n>"``: every pose with the n-th before it.
        ``"C<n>"``: every pose with the keyframe that starts its segment of n poses; a last segment
        whose keyframe is N - n or later is skipped, as in the published results.

    Returns
    -------
    MotionPairs
        The pairs; of length 0 if there are too few poses.

    Raises
    ------
    ConfigError
        If the reference has another form. n is at least 1, and at least 2 after C.
    """
    kind, step = parse_reference("reference", reference)
    n_poses = len(Ts_pw_p)
    if kind == "C":
        keyframes = np.arange(0, max(n_poses - step, 0), step)
        i = np.repeat(keyframes, step - 1)
        j = keyframes[:, None] + np.arange(1, step)
    else:
        j = np.arange(step, n_poses)
        i = np.zeros_like(j) if kind == "A" else j - step
    return pairs_between(Ts_pw_p, Ts_cw_c, i, j.ravel())


def pairs_between(
    Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, i: IntArray, j: IntArray
) -> MotionPairs:
    """Return the MotionPairs from the instants i to the instants j, (K,) int arrays."""
    parent = motions(Ts_pw_p.take(i, axis=0), Ts_pw_p.take(j, axis=0))
    child = motions(Ts_cw_c.take(i, axis=0), Ts_cw_c.take(j, axis=0))
    return MotionPairs(parent, child, i, j)


def motions(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the motions (..., 4, 4) of a sensor between two stacks of poses (..., 4, 4).

    The translation difference is taken before rotating: with map coordinates of 1e6 m, inverting
    first costs ten digits.
    """
    motion = end.copy()
    motion[..., :3, 3] -= se3.translation_of(start)
    motion[..., :3, :] = np.swapaxes(se3.rotation_of(start), -1, -2) @ motion[..., :3, :]
    return motion


def pairs_over(pose_pairs: PosePairs, lag_s: float, max_pairs: int = MAX_PAIRS) -> MotionPairs:
    """Return motion pairs between poses about ``lag_s`` seconds apart, evenly over the recording.

    Parameters
    ----------
    pose_pairs : PosePairs
    lag_s : float
        Seconds between the poses of a pair; the median interval if that is longer.
    max_pairs : int
        Largest number of pairs.
    """
    stamps_ns = pose_pairs.stamps_ns
    if len(stamps_ns) > 1:
        lag_s = max(lag_s, median(np.diff(stamps_ns)) * 1e-9)
    i = np.linspace(0, len(stamps_ns) - 1, min(len(stamps_ns), max_pairs)).astype(int)
    after = np.maximum(np.searchsorted(stamps_ns, stamps_ns[i] + round(lag_s * 1e9)), i + 1)
    has_end = after < len(stamps_ns)
    i = i[has_end]
    after = after[has_end]
    # The pose nearest to the end: the first pose after the end would more often have a late stamp.
    ends_ns = stamps_ns[i] + round(lag_s * 1e9)
    is_before = ends_ns - stamps_ns[after - 1] < stamps_ns[after] - ends_ns
    j = np.maximum(after - is_before, i + 1)
    is_near = stamps_ns[j] - stamps_ns[i] <= (1.5 * lag_s + 0.1) * 1e9
    return pairs_between(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, i[is_near], j[is_near])
