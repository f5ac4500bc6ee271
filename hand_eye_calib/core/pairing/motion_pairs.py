"""Two streams to pairs: their poses at common instants, by interpolation; and relative motions of
both between these, what every AX = XB solver starts from.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.base.text import parse_reference
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Columns, Trajectory

# Streams whose intervals differ by less than this factor count as equally fast: they are paired at
# the child's stamps.
_EQUALLY_FAST = 1.2

# Number of poses checked at once in the search for the next keyframe.
_WINDOW = 64

# No recording pauses this long (s): a stamp is wrong.
_LEAP_S = 86_400.0

# Pairs that are compared where the choice of poses is free.
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
        """The same poses with the child's translations times ``factor``."""
        Ts_cw_c = self.Ts_cw_c.copy()
        Ts_cw_c[:, :3, 3] *= factor
        return replace(self, Ts_cw_c=Ts_cw_c)

    @classmethod
    def empty(cls) -> Self:
        """No poses."""
        return cls(np.empty(0, dtype=np.int64), np.empty((0, 4, 4)), np.empty((0, 4, 4)))


def slower_stream(parent_stamps_ns: IntArray, child_stamps_ns: IntArray) -> str:
    """The stream at whose stamps to pair, "parent" or "child": the slower one by the median
    interval; the child if both are about equally fast.
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

    An instant outside the faster stream, or between two of its poses that are more than
    ``max_gap_s`` apart, is left out. An instant at which it has a pose of its own is always kept.

    Parameters
    ----------
    parent, child : Trajectory
        On one clock.
    max_gap_s : float
        Seconds.
    at : {"parent", "child"}, optional
        The stream at whose stamps to pair; the slower one by default.
    """
    if len(parent) == 0 or len(child) == 0:
        return PosePairs.empty()
    at = at or slower_stream(parent.stamps_ns, child.stamps_ns)
    slow, fast = (parent, child) if at == "parent" else (child, parent)
    # Wanted stamps at which the faster stream has a pose, or may be interpolated.
    after = np.searchsorted(fast.stamps_ns, slow.stamps_ns)
    inside = after < len(fast)
    after = np.minimum(after, len(fast) - 1)
    gap_ns = fast.stamps_ns[after] - fast.stamps_ns[np.maximum(after - 1, 0)]
    exact = fast.stamps_ns[after] == slow.stamps_ns
    keep = inside & (exact | ((after > 0) & (gap_ns <= max_gap_s * 1e9)))
    stamps_ns = slow.stamps_ns[keep]
    is_one = len(fast) == 1
    fast_poses = np.repeat(fast.poses, len(stamps_ns), axis=0) if is_one else fast.at(stamps_ns)
    both = (slow.poses[keep], fast_poses) if at == "parent" else (fast_poses, slow.poses[keep])
    return PosePairs(stamps_ns, *both)


def select_keyframes(
    pose_pairs: PosePairs,
    min_translation: float,
    min_rotation: float,
    min_interval_s: float,
    previous: PosePairs | None = None,
) -> IntArray:
    """Indices of the pose pairs to keep, in order.

    A pose pair is kept if ``min_interval_s`` has passed since the last one kept and the parent
    sensor has since moved ``min_translation`` or rotated by ``min_rotation``. A threshold of zero
    switches that criterion off.

    Thresholds are in m, rad and s; ``previous`` is the last one kept before these, of length 1 (0
    for none).
    """
    n_poses = len(pose_pairs)
    if n_poses == 0 or max(min_translation, min_rotation, min_interval_s) == 0.0:
        return np.arange(n_poses)
    stamps_ns = pose_pairs.stamps_ns
    poses = pose_pairs.Ts_pw_p
    kept = []
    if previous is not None and len(previous):
        last_ns = previous.stamps_ns[-1]
        T_last = previous.Ts_pw_p[-1]
    else:
        kept = [0]
        last_ns = stamps_ns[0]
        T_last = poses[0]
    index = len(kept)
    while index < n_poses:
        window = slice(index, index + _WINDOW)
        wanted = stamps_ns[window] - last_ns >= min_interval_s * 1e9
        has_moved = np.full(len(wanted), max(min_translation, min_rotation) == 0.0)
        if min_translation > 0.0:
            away_m = np.linalg.norm(poses[window, :3, 3] - T_last[:3, 3], axis=1)
            has_moved |= away_m >= min_translation
        if min_rotation > 0.0:
            turned = se3.rotation_angle(T_last[:3, :3].T @ poses[window, :3, :3])
            has_moved |= turned >= min_rotation
        hits = index + np.flatnonzero(wanted & has_moved)
        if hits.size:
            kept.append(int(hits[0]))
            last_ns = stamps_ns[hits[0]]
            T_last = poses[hits[0]]
        index = kept[-1] + 1 if hits.size else index + _WINDOW
    return np.array(kept, dtype=int)


def find_leap(stamps_ns: IntArray) -> tuple[str, str] | None:
    """The longest leap in stamps (N,), in rising order, of a stream: what it is, to follow "the
    parent stream's", and what to do about it; None without one.
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
    """K relative motions of both sensors between the same instants i and j.

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
        """Residuals (K, 3) of translation and of rotation at X (4, 4).

        ``R_A t + t_A - R t_B - t``, in m, in the axes of the parent sensor at instant i: Välimäki
        et al. 2023, eq. (6). The article prints its last term with the opposite sign; its published
        results have this one. Rotation vectors, in rad, in the axes of the child sensor at instant
        j, of the rotation from ``R_A R`` to ``R R_B``; their lengths are the angles of eq. (7).
        """
        rotation = T_parent_child[:3, :3]
        translation = T_parent_child[:3, 3]
        chord = self.Ts_parenti_parentj[:, :3, :3] - np.eye(3)
        moved_child = self.Ts_childi_childj[:, :3, 3] @ rotation.T
        apart = chord @ translation + self.Ts_parenti_parentj[:, :3, 3] - moved_child
        via_parent = self.Ts_parenti_parentj[:, :3, :3] @ rotation
        via_child = rotation @ self.Ts_childi_childj[:, :3, :3]
        return apart, se3.rotation_log(np.swapaxes(via_parent, 1, 2) @ via_child)


def motion_pairs(Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, reference: str) -> MotionPairs:
    """Relative motions of two synchronised trajectories (Välimäki et al. 2023, eqs 1-2).

    Parameters
    ----------
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Poses of parent and child sensor in their own worlds at the same N instants.
    reference : str
        ``"A"``: every pose with the first. ``"B<n>"``: with the n-th before it. ``"C<n>"``: with
        the keyframe that starts its segment of n poses; a last segment whose keyframe is N - n or
        later is left out, as in the published results.

    Returns
    -------
    MotionPairs
        Of length 0 if there are too few poses.

    Raises
    ------
    ConfigError
        If the reference has another form: n is at least 1, of C at least 2.
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
    """MotionPairs from the instants i to the instants j, (K,) int arrays."""
    parent, child = (motions(Ts.take(i, axis=0), Ts.take(j, axis=0)) for Ts in (Ts_pw_p, Ts_cw_c))
    return MotionPairs(parent, child, i, j)


def motions(start: FloatArray, end: FloatArray) -> FloatArray:
    """Motions (..., 4, 4) from poses to poses, (..., 4, 4) each, of one sensor.

    The translation difference is taken before rotating: with map coordinates of 1e6 m, inverting
    first costs ten digits.
    """
    moved = end.copy()
    moved[..., :3, 3] -= start[..., :3, 3]
    moved[..., :3, :] = np.swapaxes(start[..., :3, :3], -1, -2) @ moved[..., :3, :]
    return moved


def pairs_over(pose_pairs: PosePairs, lag_s: float, max_pairs: int = MAX_PAIRS) -> MotionPairs:
    """Motion pairs between poses about ``lag_s`` seconds apart (their interval if that is longer),
    evenly over the recording; none if no two poses lie that far apart.
    """
    stamps_ns = pose_pairs.stamps_ns
    if len(stamps_ns) > 1:
        lag_s = max(lag_s, median(np.diff(stamps_ns)) * 1e-9)
    i = np.linspace(0, len(stamps_ns) - 1, min(len(stamps_ns), max_pairs)).astype(int)
    ends_ns = stamps_ns[i] + round(lag_s * 1e9)
    after = np.maximum(np.searchsorted(stamps_ns, ends_ns), i + 1)
    i, ends_ns, after = (each[after < len(stamps_ns)] for each in (i, ends_ns, after))
    # The nearest: of the poses after that, those with late stamps would be the first more often.
    is_before = ends_ns - stamps_ns[after - 1] < stamps_ns[after] - ends_ns
    j = np.maximum(after - is_before, i + 1)
    near = stamps_ns[j] - stamps_ns[i] <= (1.5 * lag_s + 0.1) * 1e9
    return pairs_between(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, i[near], j[near])
