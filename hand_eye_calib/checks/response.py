"""How the child's motion follows the parent's, beyond an extrinsic and a scale: one linear
regression per kind of motion, with a column for each thing that may be wrong.

Two sensors on one rigid body feel the same motion at the same time. With chords a, b and rotation
vectors x, y of parent and child over a span, in the parent's axes (b and y turned by X),

    b - a = (R_A - I) t + ...,        y - x = ...

where the dots are columns: a small rotation of X, a scale, and one group of columns per fault. All
groups are in one table of products, summed over blocks of time: to fit a group is to solve a small
part of it, and the jackknife over the blocks gives standard deviations. Rotations and displacements
over some seconds (:func:`long_response`) show gains, scales by axis, worlds that are turned or that
move; those over 0.4 s (:func:`short_response`) show delays and smoothing, which change a motion of
angular frequency f by ``1 - i f d - f^2 c``: -d times the velocity and c times the acceleration.

Columns of the short response come from poses that the displacements do not use: white noise has no
part in both sides. Noise that accumulates makes the stream that a column comes from look less
smooth than it is, never smoother. So columns of the child show that the child is smoothed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import MotionPairs
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.stats import MEDIAN_LENGTH, median

# Half of the span of a short displacement (s); an interval of the poses if that is longer. Instants
# of a stencil may be off by this share of a step.
_HALF_SPAN_S, _TOLERANCE = 0.2, 0.3
_MAX_INSTANTS, _MIN_INSTANTS = 1500, 150
_BLOCKS = 10

# Geman-McClure: residuals of about this many standard deviations have half the weight.
_TUNING, _ROUNDS = 3.0, 4

# Smoothing below this share of the squared interval of the poses, or so many times what noise may
# make of it, is none.
_SMOOTHING_INTERVALS2, _BIASES = 0.1, 2.0

# An axis whose root mean square rotation is below this share of the main axis's has no gain.
LITTLE = 0.1

# Farthest step of a stencil. Rotation vectors near half a turn may point either way.
_FAR = 4
MAX_ROTATION = 2.8


@dataclass(frozen=True)
class Fitted:
    """What a group of m columns is fitted with: values and standard deviations (m,), by the
    jackknife over blocks of time, and the share of the squared residuals that it takes away.
    """

    values: FloatArray
    sigmas: FloatArray
    share: float

    @property
    def significance(self) -> FloatArray:
        """Values (m,) in standard deviations."""
        return np.abs(self.values) / np.maximum(self.sigmas, 1e-12)


class Regression:
    """Robust linear regression of rows on named groups of columns.

    Parameters
    ----------
    target : (K, r) array
        In standard deviations of the noise, or any unit if all rows have one.
    columns : mapping of str to (K, r, m) array
    base : sequence of str
        Groups that every fit has.
    noise : float
        Variance of noise in each column of the first group, which would make its values too small.
    """

    def __init__(
        self,
        target: FloatArray,
        columns: Mapping[str, FloatArray],
        base: Sequence[str],
        noise: float = 0.0,
    ) -> None:
        self._base = list(base)
        ends = np.cumsum([column.shape[2] for column in columns.values()])
        self._where = {
            name: np.arange(end - column.shape[2], end)
            for (name, column), end in zip(columns.items(), ends, strict=True)
        }
        flat = np.concatenate([*columns.values(), target[:, :, None]], axis=2)
        edges = np.linspace(0, len(flat), _BLOCKS + 1).astype(int)[1:-1]
        known = self._indices(())
        weights = np.ones(len(flat))
        for _ in range(_ROUNDS):
            parts = np.split(flat * weights[:, None, None], edges), np.split(flat, edges)
            self.blocks = np.stack(
                [np.tensordot(*pair, axes=((0, 1), (0, 1))) for pair in zip(*parts, strict=True)]
            )
            if noise:
                gram = self.blocks.sum(axis=0)[:3, :3]
                self.blocks[:, :3, :3] -= _of_noise(gram, noise * weights.sum()) / _BLOCKS
            values = _solved(self.blocks.sum(axis=0), known)
            lengths = np.linalg.norm(target - flat[:, :, known] @ values, axis=1)
            sigma = max(median(lengths) / np.sqrt(target.shape[1]), 1e-12)
            weights = 1.0 / (1.0 + (lengths / sigma) ** 2 / (target.shape[1] * _TUNING**2)) ** 2
        self.sigma, self._weight = sigma, float(weights.sum())

    def _indices(self, groups: Sequence[str], without: str = "") -> IntArray:
        names = [*(name for name in self._base if name != without), *groups]
        return np.concatenate([self._where[name] for name in names])

    def fit(self, *groups: str, without: str = "") -> Fitted:
        """Fit groups beside the base, or beside what is left of it."""
        known, total = self._indices(groups, without), self.blocks.sum(axis=0)
        start = len(self._indices((), without))
        values, left_out = _solved(total, known), _solved(total - self.blocks, known)
        spread = left_out - left_out.mean(axis=0)
        sigmas = np.sqrt((_BLOCKS - 1) / _BLOCKS * (spread**2).sum(axis=0))
        costs = [_cost(total, indices) for indices in (known[:start], known)]
        share = 1.0 - costs[1] / max(costs[0], 1e-300)
        return Fitted(values[start:], sigmas[start:], share)

    def powers(self, group: str) -> FloatArray:
        """Sums of squares (m,) of the group's columns."""
        where = self._where[group]
        return np.asarray(self.blocks.sum(axis=0)[where, where])

    def biases(self, group: str) -> FloatArray:
        """By how much noise of the columns (m,), if it is as large as that of the rows, may push
        values.
        """
        return np.asarray(self.sigma**2 * self._weight / np.maximum(self.powers(group), 1e-300))


def _of_noise(gram: FloatArray, amount: float) -> FloatArray:
    """What noise of this amount adds to sums of products (3, 3): at most half of them."""
    sizes, directions = np.linalg.eigh(gram)
    return (directions * np.minimum(amount, 0.5 * np.maximum(sizes, 0.0))) @ directions.T


def _solved(products: FloatArray, columns: IntArray) -> FloatArray:
    normal = products[..., columns[:, None], columns]
    units = 1.0 / np.sqrt(np.diagonal(normal, axis1=-2, axis2=-1) + 1e-300)
    balanced = normal * units[..., :, None] * units[..., None, :] + 1e-9 * np.eye(len(columns))
    pushed = (units * products[..., columns, -1])[..., None]
    return np.asarray(units * np.linalg.solve(balanced, pushed)[..., 0])


def _cost(products: FloatArray, columns: IntArray) -> float:
    return float(products[-1, -1] - products[columns, -1] @ _solved(products, columns))


# ------------------------------------------------------------------ motions over seconds


def long_response(
    pose_pairs: PosePairs,
    motions: MotionPairs,
    T_parent_child: FloatArray,
    moved_at_ns: int | None = None,
) -> tuple[Regression, FloatArray] | None:
    """Regression of rotations and displacements over seconds, and the principal axes of the
    rotations (columns, parent's frame); None if nearly all are near half a turn.

    Groups: ``turned_child``, ``turned_parent``: positions turned against orientations, a rotation
    vector in the stream's world; ``axes_child``, ``axes_parent``: factors, less 1, of the
    coordinates of a stream's positions; ``drift``: velocity and angular rate of the child's world;
    ``gain``: factors, less 1, of the child's rotations about the principal axes; ``moved``: lever
    arm and rotation of X after a time, if one is given.
    """
    R, t = T_parent_child[:3, :3], T_parent_child[:3, 3]
    A, B = motions.Ts_parenti_parentj, motions.Ts_childi_childj
    x, y = se3.rotation_log(A[:, :3, :3]), se3.rotation_log(B[:, :3, :3]) @ R.T
    keep = np.maximum(np.linalg.norm(x, axis=1), np.linalg.norm(y, axis=1)) < MAX_ROTATION
    if keep.sum() < _BLOCKS:
        return None
    motions, A, B, x, y = motions[keep], A[keep], B[keep], x[keep], y[keep]
    a, b = A[:, :3, 3], B[:, :3, 3] @ R.T
    chords = A[:, :3, :3] - np.eye(3)
    target_t, target_r = b - a - chords @ t, y - x
    unit_t, unit_r = (
        max(median(np.linalg.norm(v, axis=1)) / MEDIAN_LENGTH, least)
        for v, least in ((target_t, 1e-7), (target_r, 1e-8))
    )
    from_parent = np.swapaxes(pose_pairs.Ts_pw_p[motions.i, :3, :3], 1, 2)
    from_child = R @ np.swapaxes(pose_pairs.Ts_cw_c[motions.i, :3, :3], 1, 2)
    dp = pose_pairs.Ts_pw_p[motions.j, :3, 3] - pose_pairs.Ts_pw_p[motions.i, :3, 3]
    dc = pose_pairs.Ts_cw_c[motions.j, :3, 3] - pose_pairs.Ts_cw_c[motions.i, :3, 3]
    # What the other stream makes of these displacements.
    to_parent, to_child = (np.swapaxes(each, 1, 2) for each in (from_parent, from_child))
    dp_seen = _times(to_parent, b - chords @ t)
    dc_seen = _times(to_child, a + chords @ t)
    seconds = (pose_pairs.stamps_ns[motions.j] - pose_pairs.stamps_ns[motions.i]) * 1e-9
    moved = from_child * seconds[:, None, None]
    middle = 0.5 * (pose_pairs.Ts_cw_c[motions.i, :3, 3] + pose_pairs.Ts_cw_c[motions.j, :3, 3])
    middle = middle - middle.mean(axis=0)
    axes = np.linalg.eigh(x.T @ x)[1][:, ::-1]
    along = (x @ axes)[:, None, :] * axes[None]

    def both(of_t: FloatArray, of_r: FloatArray | None = None) -> FloatArray:
        of_r = np.zeros_like(of_t) if of_r is None else of_r
        return np.concatenate([of_t / unit_t, of_r / unit_r], axis=1)

    columns = {
        "lever": both(chords),
        "rotation": both(se3.skew(b), se3.skew(y)),
        "scale": both(b[:, :, None]),
        "turned_child": both(-from_child @ se3.skew(dc)),
        "turned_parent": both(from_parent @ se3.skew(dp)),
        "axes_child": both(from_child * dc_seen[:, None, :]),
        "axes_parent": both(-from_parent * dp_seen[:, None, :]),
        "drift": np.concatenate([both(moved), both(-moved @ se3.skew(middle), moved)], axis=2),
        "gain": both(np.zeros_like(along), along),
    }
    if moved_at_ns is not None:
        middles_ns = (pose_pairs.stamps_ns[motions.i] + pose_pairs.stamps_ns[motions.j]) // 2
        of_mount = np.concatenate([columns["lever"], columns["rotation"]], axis=2)
        columns["moved"] = (middles_ns >= moved_at_ns)[:, None, None] * of_mount
    target = both(target_t[:, :, None], target_r[:, :, None])[:, :, 0]
    return Regression(target, columns, ("lever", "rotation", "scale")), axes


def _times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


# ------------------------------------------------------------------ motions over 0.4 s


def short_response(
    pose_pairs: PosePairs, T_parent_child: FloatArray, gain: FloatArray
) -> tuple[Regression, Regression, float] | None:
    """Regressions of rotations and of displacements over 0.4 s, and the least smoothing (s^2) of
    displacements that noise cannot explain; None if too few poses follow each other.

    Groups of both: ``late``: the child's part is late (s); ``smooth_child``, ``smooth_parent``
    (s^2). Of displacements: ``late_axes_child``, ``late_axes_parent``: by coordinate.
    """
    stencil = _stencil(pose_pairs.stamps_ns)
    if stencil is None:
        return None
    at, h, interval_s = stencil
    R = T_parent_child[:3, :3]
    P, C = pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c
    x, late_p, bend_p = _rotations(P[:, :3, :3], np.eye(3), at)
    y, late_c, bend_c = _rotations(C[:, :3, :3], R, at)
    x = x @ gain.T
    skew = se3.skew(y)
    rotations = Regression(
        y - x,
        {
            "rotation": skew,
            "late": -0.5 * (late_p + late_c)[:, :, None] / (2 * h),
            "smooth_child": bend_c[:, :, None] / (3 * h**2),
            "smooth_parent": -bend_p[:, :, None] / (3 * h**2),
        },
        ("rotation", "late"),
    )
    chords = np.swapaxes(P[at[0], :3, :3], 1, 2) @ (P[at[2], :3, :3] - P[at[-2], :3, :3])
    a, faster_p, bend_a = _displacements(P, at)
    b, faster_c, bend_b = _displacements(C, at)
    to_parent, to_child = (
        {k: turn @ np.swapaxes(poses[at[k], :3, :3], 1, 2) for k in (-1, 0, 1)}
        for poses, turn in ((P, np.eye(3)), (C, R))
    )
    # Columns are turned by other orientations than the displacements.
    from_parent, from_child = (0.5 * (each[-1] + each[1]) for each in (to_parent, to_child))
    b_in = _times(to_child[0], b)
    late = -0.5 * (_times(from_parent, faster_p) + _times(from_child, faster_c)) / (2 * h)
    displacements = Regression(
        b_in - _times(to_parent[0], a),
        {
            "lever": chords,
            "rotation": se3.skew(b_in),
            "late": late[:, :, None],
            "late_axes_child": -from_child * faster_c[:, None, :] / (2 * h),
            "late_axes_parent": from_parent * faster_p[:, None, :] / (2 * h),
            "smooth_child": _times(from_child, bend_b)[:, :, None] / (3 * h**2),
            "smooth_parent": -_times(from_parent, bend_a)[:, :, None] / (3 * h**2),
        },
        ("lever", "rotation", "late"),
        noise=rotations.sigma**2,
    )
    # An error of an orientation turns a displacement and its bend alike.
    lengths = [median(np.linalg.norm(vectors, axis=1)) for vectors in (a, bend_a)]
    pushed = _BIASES * rotations.sigma**2 * lengths[0] / max(lengths[1] / (3 * h**2), 1e-12)
    return rotations, displacements, _SMOOTHING_INTERVALS2 * interval_s**2 + pushed


def _stencil(stamps_ns: IntArray) -> tuple[dict[int, IntArray], float, float] | None:
    """Indices (K,) of poses by the number of steps from K instants, -4 to 4, around as many poses
    as have others at all distances; a step, and the typical time from one pose to the next (s).
    """
    if len(stamps_ns) < _MIN_INSTANTS:
        return None
    interval_s = median(np.diff(stamps_ns)) * 1e-9
    n = max(round(_HALF_SPAN_S / 2 / interval_s), 1)
    reach = _FAR * n
    centres = np.arange(reach, len(stamps_ns) - reach)
    valid = np.ones(len(centres), dtype=bool)
    for k in range(-reach, reach + 1, n):
        elapsed_s = (stamps_ns[centres + k] - stamps_ns[centres]) * 1e-9
        valid &= np.abs(elapsed_s - k * interval_s) < _TOLERANCE * (n + abs(k)) * interval_s
    centres = centres[valid]
    if len(centres) < _MIN_INSTANTS:
        return None
    centres = centres[:: -(-len(centres) // _MAX_INSTANTS)]
    return {k: centres + n * k for k in range(-_FAR, _FAR + 1)}, n * interval_s, interval_s


def _rotations(
    rotations: FloatArray, to_parent: FloatArray, at: dict[int, IntArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotation vectors (K, 3) of a stream over four steps, in the parent's axes; how they change,
    and how their changes do, from other poses.
    """

    def between(k: int, m: int) -> FloatArray:
        start, end = rotations[at[k]], rotations[at[m]]
        return se3.rotation_log(np.swapaxes(start, 1, 2) @ end) @ to_parent.T

    bend = between(3, 4) - between(0, 1) - between(-1, 0) + between(-4, -3)
    return between(-2, 2), between(1, 3) - between(-3, -1), bend


def _displacements(
    poses: FloatArray, at: dict[int, IntArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Displacements (K, 3) of a stream over four steps, in its world; the difference of those over
    two steps at both ends, from other poses; and of the accelerations, times 3 steps squared.
    """
    p = {k: poses[rows, :3, 3] for k, rows in at.items()}
    bend = (p[4] - p[3] - p[1] + p[0]) - (p[0] - p[-1] - p[-3] + p[-4])
    return p[2] - p[-2], (p[3] - p[1]) - (p[-1] - p[-3]), bend
