"""Pose pairs and motion pairs of two streams.

A pose pair consists of the poses of both sensors at one instant; one of the poses is interpolated.
A motion pair consists of the relative motions A and B of both sensors between two of these
instants. Motion pairs are the input of every AX = XB solver (Välimäki et al. 2023, eqs 1-2).
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.base.text import parse_reference
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Columns, Trajectory

# Both streams count as equally fast if the ratio of their median intervals is at most this. The
# pose pairs then have the child's stamps.
_MAX_EQUAL_RATIO = 1.2

# Number of poses that are searched together for the next keyframe.
_WINDOW = 64

# Longest plausible pause of a recording (s): one day. If a pause is longer, the stamps are wrong.
_MAX_PAUSE_S = 86_400.0

# Largest number of motion pairs in a fit, unless the caller sets another number.
MAX_PAIRS = 800


@dataclass(frozen=True, eq=False)
class PosePairs(Columns):
    """Poses of both sensors at common instants.

    Attributes
    ----------
    stamps_ns : (N,) int64 array
        Stamps on the parent's clock, strictly increasing.
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Poses of each sensor in its own world.
    """

    stamps_ns: IntArray
    Ts_pw_p: FloatArray
    Ts_cw_c: FloatArray

    def child_scaled(self, factor: float) -> Self:
        """Return the pose pairs with the child's translations multiplied by ``factor``."""
        Ts_cw_c = self.Ts_cw_c.copy()
        Ts_cw_c[:, :3, 3] *= factor
        return replace(self, Ts_cw_c=Ts_cw_c)

    def child_shifted(self, seconds: float) -> Self:
        """Return the pose pairs with ``seconds`` added to the child's stamps.

        The child's poses are interpolated at the common instants, and extrapolated at the ends.
        """
        child = Trajectory(self.stamps_ns, self.Ts_cw_c).shifted(seconds)
        return replace(self, Ts_cw_c=child.at(self.stamps_ns, extrapolate=True))

    @classmethod
    def empty(cls) -> Self:
        """Return zero pose pairs."""
        no_stamps = np.empty(0, dtype=np.int64)
        no_poses = np.empty((0, 4, 4))
        return cls(no_stamps, no_poses, no_poses)


def slower_stream(parent_stamps_ns: IntArray, child_stamps_ns: IntArray) -> str:
    """Return the name of the stream with the longer median interval, "parent" or "child".

    The result is "child" if the intervals are about equal, or if a stream has fewer than two
    stamps.
    """
    if len(parent_stamps_ns) < 2 or len(child_stamps_ns) < 2:
        return "child"
    interval_parent = median(np.diff(parent_stamps_ns))
    interval_child = median(np.diff(child_stamps_ns))
    return (
        "parent"
        if interval_parent > _MAX_EQUAL_RATIO * interval_child
        else "child"
    )


def synchronise(
    parent: Trajectory,
    child: Trajectory,
    max_gap_s: float,
    at: str | None = None,
) -> PosePairs:
    """Interpolate the faster stream at the stamps of the slower stream.

    A stamp is skipped if it is outside the faster stream, or in a gap of the faster stream longer
    than ``max_gap_s``. A stamp at which the faster stream has a pose is always used.

    Parameters
    ----------
    parent, child : Trajectory
        Streams with stamps on one clock.
    max_gap_s : float
        Longest interval (s) between two poses in which poses are interpolated.
    at : {"parent", "child"}, optional
        Stream whose stamps the pose pairs have; by default the slower stream.

    Returns
    -------
    PosePairs
        The pose pairs; none if the streams do not overlap.
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


def _has_moved(
    T_last: FloatArray,
    poses: FloatArray,
    min_translation: float,
    min_rotation: float,
) -> BoolArray:
    """Return which poses (N, 4, 4) have moved (m) or rotated (rad) enough since the last keyframe.

    A threshold of zero is ignored. If both thresholds are zero, all poses count as moved.
    """
    if max(min_translation, min_rotation) == 0.0:
        return np.ones(len(poses), dtype=bool)
    has_moved = np.zeros(len(poses), dtype=bool)
    if min_translation > 0.0:
        steps = se3.translation_of(poses) - se3.translation_of(T_last)
        has_moved |= np.linalg.norm(steps, axis=1) >= min_translation
    if min_rotation > 0.0:
        rotations = se3.rotation_of(T_last).T @ se3.rotation_of(poses)
        has_moved |= se3.rotation_angle(rotations) >= min_rotation
    return has_moved


def select_keyframes(
    pose_pairs: PosePairs,
    min_translation: float,
    min_rotation: float,
    min_interval_s: float,
    previous: PosePairs | None = None,
) -> IntArray:
    """Return the indices of keyframes among pose pairs, ascending.

    A pose pair is a keyframe if two conditions are met since the last keyframe: ``min_interval_s``
    has passed, and the parent sensor has moved by ``min_translation`` or rotated by
    ``min_rotation``. A threshold of zero disables its criterion. Without a previous keyframe, the
    first pose pair is a keyframe.

    Parameters
    ----------
    pose_pairs : PosePairs
    min_translation, min_rotation, min_interval_s : float
        Thresholds in m, rad and s.
    previous : PosePairs, optional
        Last keyframe before these pose pairs, as zero or one pose pair.
    """
    n_poses = len(pose_pairs)
    if (
        n_poses == 0
        or max(min_translation, min_rotation, min_interval_s) == 0.0
    ):
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
        has_passed = stamps_ns[window] - last_ns >= min_interval_s * 1e9
        has_moved = _has_moved(
            T_last, poses[window], min_translation, min_rotation
        )
        candidates = np.flatnonzero(has_passed & has_moved)
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
    """Detect a leap of more than a day in the ascending stamps (N,) of a stream.

    Returns
    -------
    (str, str) or None
        The problem, as text that follows "the parent stream's", and the remedy. None without a
        leap.
    """
    if len(stamps_ns) < 2:
        return None
    intervals_s = np.diff(stamps_ns) * 1e-9
    count = len(stamps_ns)
    before = int(np.argmax(intervals_s)) + 1
    days = float(intervals_s[before - 1]) / _MAX_PAUSE_S
    if days <= 1.0:
        return None
    shorter_end = (
        f"the first {before}"
        if before < count - before
        else f"the last {count - before}"
    )
    problem = f"stamps leap by {days:,.0f} days after pose {before} of {count}"
    return problem, f"repair the stamps, or remove {shorter_end} of its poses"


@dataclass(frozen=True, eq=False)
class MotionPairs(Columns):
    """K pairs of relative motions, of both sensors between the same instants i and j.

    Attributes
    ----------
    Ts_parenti_parentj : (K, 4, 4) array
        Motions of the parent sensor, ``inv(T_pw_p(i)) @ T_pw_p(j)``: A of AX = XB.
    Ts_childi_childj : (K, 4, 4) array
        Motions of the child sensor: B of AX = XB.
    i, j : (K,) int arrays
        Indices of the pose pairs at the start and at the end of each motion.
    """

    Ts_parenti_parentj: FloatArray
    Ts_childi_childj: FloatArray
    i: IntArray
    j: IntArray

    def residuals(
        self, T_parent_child: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the residuals of AX = XB at X = (R, t), a (4, 4) array.

        Returns
        -------
        (K, 3) array
            Translations ``R_A t + t_A - R t_B - t`` in m, in the axes of the parent sensor at
            instant i: Välimäki et al. 2023, eq. (6). The article prints the last term with the
            opposite sign, but its published results have this sign.
        (K, 3) array
            Rotation vectors from ``R_A R`` to ``R R_B`` in rad, in the axes of the child sensor at
            instant j. Their lengths are the angles of eq. (7).
        """
        return (
            self.translation_residuals(T_parent_child),
            self.rotation_residuals(T_parent_child),
        )

    def translation_residuals(self, T_parent_child: FloatArray) -> FloatArray:
        """Return the translations (K, 3) of :meth:`residuals`."""
        R = se3.rotation_of(T_parent_child)
        t = se3.translation_of(T_parent_child)
        R_A = se3.rotation_of(self.Ts_parenti_parentj)
        t_A = se3.translation_of(self.Ts_parenti_parentj)
        t_B = se3.translation_of(self.Ts_childi_childj)
        return (R_A - np.eye(3)) @ t + t_A - t_B @ R.T

    def rotation_residuals(self, T_parent_child: FloatArray) -> FloatArray:
        """Return the rotation vectors (K, 3) of :meth:`residuals`."""
        R = se3.rotation_of(T_parent_child)
        R_A = se3.rotation_of(self.Ts_parenti_parentj)
        R_B = se3.rotation_of(self.Ts_childi_childj)
        return se3.rotations_between(R_A @ R, R @ R_B)


def motion_pairs(
    Ts_pw_p: FloatArray,
    Ts_cw_c: FloatArray,
    reference: str,
    every: int = 1,
) -> MotionPairs:
    """Return the relative motions of two synchronised trajectories for a reference.

    The reference selects the two poses of each motion.

    Parameters
    ----------
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Poses of parent and child sensor in their own worlds at the same N instants.
    reference : str
        ``"A"``: from the first pose to every other pose. ``"B<n>"``: to every pose from the n-th
        pose before it. ``"C<n>"``: in segments of n poses, from the first pose of the segment to
        every other pose of it. As in the published results, segments that start at pose N - n or
        later are skipped.
    every : int
        Only every k-th motion pair is computed.

    Returns
    -------
    MotionPairs
        The motion pairs; none if there are too few poses.

    Raises
    ------
    ConfigError
        If the reference has another form, or if n is below 1, or below 2 after C.
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
    return pairs_between(Ts_pw_p, Ts_cw_c, i[::every], j.ravel()[::every])


def pairs_between(
    Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, i: IntArray, j: IntArray
) -> MotionPairs:
    """Return the motion pairs from the poses i to the poses j, (K,) arrays of indices."""
    of_parent = [Ts_pw_p.take(rows, axis=0) for rows in (i, j)]
    of_child = [Ts_cw_c.take(rows, axis=0) for rows in (i, j)]
    return MotionPairs(motions(*of_parent), motions(*of_child), i, j)


def motions(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the motions ``inv(start) @ end`` of a sensor between poses (..., 4, 4).

    Positions are subtracted before they are rotated. For map coordinates of 1e6 m, an inversion of
    the start would lose ten digits.
    """
    motion = end.copy()
    motion[..., :3, 3] -= se3.translation_of(start)
    motion[..., :3, :] = (
        np.swapaxes(se3.rotation_of(start), -1, -2) @ motion[..., :3, :]
    )
    return motion


def pairs_over(
    pose_pairs: PosePairs, lag_s: float, max_pairs: int = MAX_PAIRS
) -> MotionPairs:
    """Return motion pairs that last about ``lag_s`` seconds, spread evenly over the recording.

    Motions that a gap makes longer by more than half are skipped.

    Parameters
    ----------
    pose_pairs : PosePairs
    lag_s : float
        Duration (s) of the motions. If the median interval of the pose pairs is longer, it is used.
    max_pairs : int
        Largest number of motion pairs.
    """
    stamps_ns = pose_pairs.stamps_ns
    if len(stamps_ns) > 1:
        lag_s = max(lag_s, median(np.diff(stamps_ns)) * 1e-9)
    lag_ns = round(lag_s * 1e9)
    n_poses = len(stamps_ns)
    i = np.linspace(0, n_poses - 1, min(n_poses, max_pairs)).astype(int)
    after = np.searchsorted(stamps_ns, stamps_ns[i] + lag_ns)
    after = np.maximum(after, i + 1)
    has_end = after < n_poses
    i = i[has_end]
    after = after[has_end]
    # Use the pose nearest to the end. The first pose after the end would often have a late stamp.
    ends_ns = stamps_ns[i] + lag_ns
    is_before = ends_ns - stamps_ns[after - 1] < stamps_ns[after] - ends_ns
    j = np.maximum(after - is_before, i + 1)
    is_near = stamps_ns[j] - stamps_ns[i] <= (1.5 * lag_s + 0.1) * 1e9
    return pairs_between(
        pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, i[is_near], j[is_near]
    )
