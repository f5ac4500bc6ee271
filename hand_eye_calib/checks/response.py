"""How the child's motion follows the parent's, for orientations and positions separately: gain and
smoothing.

Two sensors on one rigid body feel the same motion at the same time, so that with X

    w_A = R w_B,        R v_B = v_A + (dR_A/dt) t

for rotations w and displacements v over a short span. A gain of the rotations and smoothing break
this and are easily taken for a part of X. So is a delay of one part, which
:mod:`~hand_eye_calib.gls.extras` finds.

A filter changes a motion of angular frequency f by the factor 1 - i f d - f^2 c + ...: it adds -d
times the velocity and c times the acceleration. Both are columns of a linear regression.

Columns come from poses that the displacements do not use: white noise has no part in both sides.
Noise that accumulates has. It makes the stream that the column comes from look less smooth than it
is, never smoother. So columns of the child show that the child is smoothed, columns of the parent
that the parent is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import MotionPairs
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.stats import MEDIAN_LENGTH, median

# Half of the span of a displacement (s); an interval of the poses if that is longer.
_HALF_SPAN_S = 0.2

# Instants of a stencil may be off by this share of a step.
_TOLERANCE = 0.3
_MAX_INSTANTS, _MIN_INSTANTS = 1500, 150
_BLOCKS = 10

# Geman-McClure: residuals of about this many standard deviations have half the weight.
_TUNING, _ROUNDS = 3.0, 4

# An axis whose root mean square rotation is below this share of the main axis's has no gain.
_LITTLE = 0.1

# Noise of the parent explains a gain only if the child has this share of the parent's squared
# rotations about the axis.
_SHARED = 0.25

# Farthest step of a stencil. Rotation vectors near half a turn may point either way.
_FAR = 4
MAX_ROTATION = 2.8


@dataclass(frozen=True)
class Quantity:
    """A value, its standard deviation by the jackknife over blocks of time, and by how much noise
    of the rotations may push it.
    """

    value: float
    sigma: float
    bias: float

    def exceeds(self, least: float, sigmas: float) -> bool:
        """Whether the value is more than ``least``, and more than so many standard deviations."""
        return self.value > max(least, sigmas * self.sigma)


#: Smoothing (s^2) by part ("position", "rotation") and stream ("parent", "child").
Smoothing: TypeAlias = dict[tuple[str, str], Quantity]
_Regression: TypeAlias = tuple[FloatArray, FloatArray, float]


def rotation_gains(pairs: MotionPairs, R: FloatArray) -> tuple[tuple[Quantity, ...], FloatArray]:
    """Factors of the child's rotations about the principal axes of the motion, the axis with the
    most rotation first, and those axes in the parent sensor's frame, as columns.

    Parameters
    ----------
    pairs : MotionPairs
        Over times that are long enough for rotations to exceed their noise.
    R : (3, 3) array
        About the rotation of X.
    """
    x = se3.rotation_log(pairs.Ts_parenti_parentj[:, :3, :3])
    y = se3.rotation_log(pairs.Ts_childi_childj[:, :3, :3]) @ R.T
    keep = np.maximum(*(np.linalg.norm(vectors, axis=1) for vectors in (x, y))) < MAX_ROTATION
    x, y = x[keep], y[keep]
    axes = np.linalg.eigh(x.T @ x)[1][:, ::-1]
    columns = _along(x, axes)
    values, sigmas, _ = _regress(columns, y - x)
    variance = median(((y - x - columns @ values) ** 2).sum(axis=1)) / MEDIAN_LENGTH**2
    # Noise of the parent makes the gain too small, that of the child in the reverse regression too
    # large: what lies between them, noise alone explains.
    reverse, of_reverse, _ = _regress(_along(y, axes), x - y)
    other = 1.0 / (1.0 + reverse[:3]) - 1.0
    powers = [((vectors @ axes) ** 2).mean(axis=0) for vectors in (x, y)]
    is_shared = powers[1] > _SHARED * powers[0]
    is_nearer = is_shared & (np.abs(other) < np.abs(values[:3]))
    sigmas = np.where(is_nearer, of_reverse[:3], sigmas[:3])
    is_between = is_shared & (values[:3] * other < 0.0)
    values = np.where(is_between, 0.0, np.where(is_nearer, other, values[:3]))
    squared = powers[0]
    # Little rotation beside much may come from an axis that is slightly off.
    biases = np.where(squared < _LITTLE**2 * squared[0], 1.0, variance / (squared + 1e-300))
    gains = zip(values, sigmas, biases, strict=True)
    return tuple(Quantity(1.0 + value, sigma, bias) for value, sigma, bias in gains), axes


def _along(vectors: FloatArray, axes: FloatArray) -> FloatArray:
    """Columns (K, 3, 6) of a gain along each axis, and of a small rotation."""
    along = (vectors @ axes)[:, None, :] * axes[None]
    return np.concatenate([along, -se3.skew(vectors)], axis=2)


def find_smoothing(
    pose_pairs: PosePairs, T_parent_child: FloatArray, gain: FloatArray
) -> tuple[Smoothing, float] | None:
    """By how much each stream is smoothed, and the typical time from one pose to the next, s; None
    if too few poses follow each other.

    Parameters
    ----------
    pose_pairs : PosePairs
        In one unit of length.
    T_parent_child : (4, 4) array
        About X.
    gain : (3, 3) array
        Matrix from the parent's rotation vectors to the child's, both in the parent's axes.
    """
    stencil = _stencil(pose_pairs.stamps_ns)
    if stencil is None:
        return None
    at, step_s, interval_s = stencil
    R = T_parent_child[:3, :3]
    streams = ((pose_pairs.Ts_pw_p, np.eye(3)), (pose_pairs.Ts_cw_c, R))
    rotations = [_rotations(poses[:, :3, :3], to_parent, at) for poses, to_parent in streams]
    x, y = rotations[0][0] @ gain.T, rotations[1][0]
    tilt = -se3.skew(x)
    of_rotations = [
        _regress(
            np.concatenate(
                [
                    tilt,
                    -change[:, :, None] / (2 * step_s),
                    bend[:, :, None] / (3 * step_s**2),
                ],
                axis=2,
            ),
            y - x,
        )
        for _, change, bend in rotations
    ]
    positions = [_displacements(poses, to_parent, at) for poses, to_parent in streams]
    of_positions, bias = _positions(pose_pairs, positions, at, step_s, of_rotations[0][2] ** 2)
    found = {}
    for part, column, regressions, pushed in (
        ("rotation", 4, of_rotations, 0.0),
        ("position", 6, of_positions, bias),
    ):
        # A smoother parent is a child that is less smooth.
        for stream, sign, (values, sigmas, _) in zip(
            ("parent", "child"), (-1.0, 1.0), regressions, strict=True
        ):
            quantity = Quantity(sign * float(values[column]), float(sigmas[column]), pushed)
            found[part, stream] = quantity
    return found, interval_s


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

    change = between(1, 3) - between(-3, -1)
    bend = between(3, 4) - between(0, 1) - between(-1, 0) + between(-4, -3)
    return between(-2, 2), change, bend


def _displacements(
    poses: FloatArray, to_parent: FloatArray, at: dict[int, IntArray]
) -> tuple[FloatArray, FloatArray]:
    """Displacements (K, 3) of a stream over four steps, in the parent's axes; and the difference of
    the accelerations at both ends, times 3 steps squared, from other poses than those ends, and
    turned by other orientations.
    """
    p = {k: poses[rows, :3, 3] for k, rows in at.items()}

    def in_body(vectors: FloatArray, k: int = 0) -> FloatArray:
        return np.einsum("kji,kj->ki", poses[at[k], :3, :3], vectors) @ to_parent.T

    bend = (p[4] - p[3] - p[1] + p[0]) - (p[0] - p[-1] - p[-3] + p[-4])
    return in_body(p[2] - p[-2]), 0.5 * (in_body(bend, -1) + in_body(bend, 1))


def _positions(
    pose_pairs: PosePairs,
    displacements: list[tuple[FloatArray, FloatArray]],
    at: dict[int, IntArray],
    step_s: float,
    variance: float,
) -> tuple[list[_Regression], float]:
    """Regressions for the smoothing of both streams' positions, and by how much noise may push it.

    Noise of the parent's orientations, half of the ``variance`` of the rotations, is in the columns
    of the lever arm.
    """
    (x, _), (y, _) = displacements
    rotations = pose_pairs.Ts_pw_p[:, :3, :3]
    chords = np.swapaxes(rotations[at[0]], 1, 2) @ (rotations[at[2]] - rotations[at[-2]])
    base = np.concatenate([chords, -se3.skew(x)], axis=2)
    bends = [bend / (3 * step_s**2) for _, bend in displacements]
    found = [
        _regress(np.concatenate([base, bend[:, :, None]], axis=2), y - x, variance)
        for bend in bends
    ]
    # The same noise of an orientation turns a displacement and its bend.
    lengths = [median(np.linalg.norm(vectors, axis=1)) for vectors in (x, bends[0])]
    return found, variance * lengths[0] / max(lengths[1], 1e-12)


def _regress(columns: FloatArray, target: FloatArray, variance: float = 0.0) -> _Regression:
    """Values and standard deviations (m,), and the standard deviation of what remains: robust
    linear regression of (K, 3) on (K, 3, m), with the jackknife over blocks of time. ``variance``
    is that of noise in the first three columns, which would make their values too small.
    """
    K, _, m = columns.shape
    flat = np.concatenate([columns, target[:, :, None]], axis=2)
    edges = np.linspace(0, K, _BLOCKS + 1).astype(int)[:-1]
    products = np.einsum("kai,kaj->kij", flat, flat).reshape(K, -1)
    weights = np.ones(K)
    for _ in range(_ROUNDS):
        blocks = np.add.reduceat(products * weights[:, None], edges).reshape(_BLOCKS, m + 1, m + 1)
        total = blocks.sum(axis=0)
        ridge = np.diag(1e-9 * np.diag(total)[:m] + 1e-300)
        ridge[:3, :3] -= _of_noise(total[:3, :3], variance * weights.sum())
        values = np.linalg.solve(total[:m, :m] + ridge, total[:m, m])
        lengths = np.linalg.norm(target - columns @ values, axis=1)
        sigma = max(median(lengths) / MEDIAN_LENGTH, 1e-12)
        weights = 1.0 / (1.0 + (lengths / sigma) ** 2 / (3 * _TUNING**2)) ** 2
    rest = total - blocks
    shares = rest[:, :m, :m] + (1.0 - 1.0 / _BLOCKS) * ridge
    left_out = np.linalg.solve(shares, rest[:, :m, m:])[..., 0]
    spread = left_out - left_out.mean(axis=0)
    sigmas = np.sqrt((_BLOCKS - 1) / _BLOCKS * (spread**2).sum(axis=0))
    return values, sigmas, sigma


def _of_noise(gram: FloatArray, amount: float) -> FloatArray:
    """What noise of this amount adds to sums of products (3, 3): at most half of them."""
    sizes, directions = np.linalg.eigh(gram)
    return (directions * np.minimum(amount, 0.5 * np.maximum(sizes, 0.0))) @ directions.T
