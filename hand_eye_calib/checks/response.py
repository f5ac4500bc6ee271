"""How the child's motion follows the parent's, for orientations and positions separately: gain and
smoothing.

Two sensors on one rigid body feel the same motion at the same time, so that with X

    w_A = R w_B,        R v_B = v_A + (dR_A/dt) t

for rotations w and displacements v over a short span. A gain of the rotations and smoothing break
this and are easily taken for a part of X. So is a delay of one part, which
:mod:`~hand_eye_calib.gls.part_delays` finds.

A filter changes a motion of angular frequency f by the factor 1 - i f d - f^2 c + ...: it adds -d
times the velocity and c times the acceleration. Both are columns of a linear regression.

Columns come from poses that the displacements do not use: white noise has no part in both sides.
Noise that accumulates has. It makes the stream that the column comes from look less smooth than it
is, never smoother. So columns of the child show that the child is smoothed, columns of the parent
that the parent is.
"""

from __future__ import annotations

from dataclasses import dataclass

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

# Farthest step of a stencil. Rotation vectors near half a turn may point either way.
_FAR = 4
_MAX_ROTATION = 2.8


@dataclass(frozen=True)
class Quantity:
    """A value and its standard deviation, by the jackknife over blocks of time."""

    value: float
    sigma: float

    def exceeds(self, least: float, sigmas: float) -> bool:
        """Whether the value is more than ``least``, and more than so many standard deviations."""
        return self.value > max(least, sigmas * self.sigma)


@dataclass(frozen=True)
class Biased(Quantity):
    """A value, its standard deviation, and by how much noise of the rotations may push it."""

    bias: float


@dataclass(frozen=True, kw_only=True)
class Smoothing:
    """By how much each stream is smoothed: c in s^2."""

    parent: Biased
    child: Biased


@dataclass(frozen=True, kw_only=True)
class Response:
    """Response of the child's motion to the parent's.

    Attributes
    ----------
    rotation_smoothing, position_smoothing : Smoothing
    interval_s : float
        Typical time from one pose to the next, s.
    """

    rotation_smoothing: Smoothing
    position_smoothing: Smoothing
    interval_s: float


def rotation_gains(pairs: MotionPairs, R: FloatArray) -> tuple[tuple[Biased, ...], FloatArray]:
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
    keep = np.maximum(*(np.linalg.norm(vectors, axis=1) for vectors in (x, y))) < _MAX_ROTATION
    x, y = x[keep], y[keep]
    axes = np.linalg.eigh(x.T @ x)[1][:, ::-1]
    columns = np.concatenate([(x @ axes)[:, None, :] * axes[None], -se3.skew(x)], axis=2)
    found = _regress(columns, y - x)
    variance = median(((y - x - columns @ found.values) ** 2).sum(axis=1)) / MEDIAN_LENGTH**2
    squared = ((x @ axes) ** 2).mean(axis=0)
    # Little rotation beside much may come from an axis that is slightly off.
    biases = np.where(squared < _LITTLE**2 * squared[0], 1.0, variance / (squared + 1e-300))
    gains = zip(found.values, found.sigmas, biases, strict=False)
    return tuple(Biased(1.0 + value, sigma, bias) for value, sigma, bias in gains), axes


def response(
    pose_pairs: PosePairs, T_parent_child: FloatArray, gain: FloatArray | None = None
) -> Response | None:
    """Response of the child's motion to the parent's; None if too few poses follow each other.

    Parameters
    ----------
    pose_pairs : PosePairs
        In one unit of length.
    T_parent_child : (4, 4) array
        About X.
    gain : (3, 3) array, optional
        Matrix from the parent's rotation vectors to the child's, both in the parent's axes.
    """
    stencil = _Stencil.of(pose_pairs.stamps_ns)
    if stencil is None:
        return None
    R = T_parent_child[:3, :3]
    gain = np.eye(3) if gain is None else gain
    of_rotations, variance = _rotations(pose_pairs, stencil, R, gain)
    return Response(
        rotation_smoothing=of_rotations,
        position_smoothing=_positions(pose_pairs, stencil, R, variance),
        interval_s=stencil.interval_s,
    )


@dataclass(frozen=True)
class _Stencil:
    """Poses around K instants.

    Attributes
    ----------
    at : dict
        Indices (K,) by the number of steps from the instant, -4 to 4.
    step_s, interval_s : float
        A step, and the typical time from one pose to the next.
    """

    at: dict[int, IntArray]
    step_s: float
    interval_s: float

    @classmethod
    def of(cls, stamps_ns: IntArray) -> _Stencil | None:
        """The stencil around as many poses as have others at all distances."""
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
        at = {k: centres + n * k for k in range(-_FAR, _FAR + 1)}
        return cls(at, n * interval_s, interval_s)


def _rotations(
    pose_pairs: PosePairs, stencil: _Stencil, R: FloatArray, gain: FloatArray
) -> tuple[Smoothing, float]:
    """Smoothing of both streams' orientations, and variance of what remains (rad^2 per axis)."""
    turns, bends, changes = [], [], []
    for poses, to_parent in ((pose_pairs.Ts_pw_p, np.eye(3)), (pose_pairs.Ts_cw_c, R)):
        angles = _Angles(poses[:, :3, :3], stencil.at, to_parent)
        turns.append(angles.between(-2, 2))
        changes.append(angles.between(1, 3) - angles.between(-3, -1))
        bends.append(
            angles.between(3, 4)
            - angles.between(0, 1)
            - angles.between(-1, 0)
            + angles.between(-4, -3)
        )
    x, y = turns[0] @ gain.T, turns[1]
    tilt, step_s = -se3.skew(x), stencil.step_s
    found = [
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
        for change, bend in zip(changes, bends, strict=True)
    ]
    smoothing = _smoothing(found[0].quantity(4), found[1].quantity(4), 0.0)
    return smoothing, found[0].sigma ** 2


@dataclass(frozen=True)
class _Angles:
    """Rotation vectors of a stream between instants of a stencil, in the parent's axes."""

    rotations: FloatArray
    at: dict[int, IntArray]
    to_parent: FloatArray

    def between(self, k: int, m: int) -> FloatArray:
        """From k steps to m steps after each instant."""
        start, end = self.rotations[self.at[k]], self.rotations[self.at[m]]
        return se3.rotation_log(np.swapaxes(start, 1, 2) @ end) @ self.to_parent.T


def _smoothing(by_parent: Quantity, by_child: Quantity, bias: float) -> Smoothing:
    """A smoother parent is a child that is less smooth."""
    return Smoothing(
        parent=Biased(-by_parent.value, by_parent.sigma, bias),
        child=Biased(by_child.value, by_child.sigma, bias),
    )


def _positions(
    pose_pairs: PosePairs, stencil: _Stencil, R: FloatArray, variance: float
) -> Smoothing:
    """Smoothing of both streams' positions.

    Noise of the parent's orientations, half of the ``variance`` of the rotations, is in the columns
    of the lever arm.
    """
    at, step_s = stencil.at, stencil.step_s
    parent = _Displacements(pose_pairs.Ts_pw_p, np.eye(3), at)
    child = _Displacements(pose_pairs.Ts_cw_c, R, at)
    x = parent.over(2)
    rotations = pose_pairs.Ts_pw_p[:, :3, :3]
    chords = np.swapaxes(rotations[at[0]], 1, 2) @ (rotations[at[2]] - rotations[at[-2]])
    base = np.concatenate([chords, -se3.skew(x)], axis=2)
    target = child.over(2) - x
    bends = [bend / (3 * step_s**2) for bend in (parent.bend(), child.bend())]
    smoothing = [
        _regress(np.concatenate([base, bend[:, :, None]], axis=2), target, variance).quantity(6)
        for bend in bends
    ]
    # The same noise of an orientation turns a displacement and its bend.
    bias = variance * _rms(x) / max(_rms(bends[0]), 1e-12)
    return _smoothing(smoothing[0], smoothing[1], bias)


def _rms(vectors: FloatArray) -> float:
    """Robust root mean square length."""
    return median(np.linalg.norm(vectors, axis=1))


@dataclass(frozen=True)
class _Displacements:
    """Displacements of a stream around instants, in the parent's axes there."""

    poses: FloatArray
    to_parent: FloatArray
    at: dict[int, IntArray]

    def _p(self, k: int) -> FloatArray:
        return self.poses[self.at[k], :3, 3]

    def _in_body(self, vectors: FloatArray, k: int = 0) -> FloatArray:
        rotations = self.poses[self.at[k], :3, :3]
        return np.einsum("kji,kj->ki", rotations, vectors) @ self.to_parent.T

    def over(self, k: int) -> FloatArray:
        """From k steps before each instant to k after."""
        return self._in_body(self._p(k) - self._p(-k))

    def bend(self) -> FloatArray:
        """Difference of the accelerations at both ends of :meth:`over` two steps, times 3 steps
        squared, from other poses than those ends, and turned by other orientations.
        """
        ahead = self._p(4) - self._p(3) - self._p(1) + self._p(0)
        behind = self._p(0) - self._p(-1) - self._p(-3) + self._p(-4)
        bend = ahead - behind
        return 0.5 * (self._in_body(bend, -1) + self._in_body(bend, 1))


@dataclass(frozen=True)
class _Regression:
    """Values and standard deviations (m,), and the standard deviation of what remains."""

    values: FloatArray
    sigmas: FloatArray
    sigma: float

    def quantity(self, k: int) -> Quantity:
        return Quantity(float(self.values[k]), float(self.sigmas[k]))


def _regress(columns: FloatArray, target: FloatArray, variance: float = 0.0) -> _Regression:
    """Robust linear regression of (K, 3) on (K, 3, m), with the jackknife over blocks of time.
    ``variance`` is that of noise in the first three columns, which would make their values too
    small.
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
    return _Regression(values, sigmas, sigma)


def _of_noise(gram: FloatArray, amount: float) -> FloatArray:
    """What noise of this amount adds to sums of products (3, 3): at most half of them."""
    sizes, directions = np.linalg.eigh(gram)
    return (directions * np.minimum(amount, 0.5 * np.maximum(sizes, 0.0))) @ directions.T
