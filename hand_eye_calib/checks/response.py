"""How the child's motion follows the parent's, for orientations and positions separately: gain,
delay and smoothing.

Two sensors on one rigid body feel the same motion at the same time, so that with X

    w_A = R w_B,        R v_B = v_A + (dR_A/dt) t

for rotations w and displacements v over a short span. Three things break this and are easily taken
for a part of X, because a delay of positions at constant speed looks like a lever arm: a gain of
the rotations, a delay of one part, and smoothing.

A filter changes a motion of angular frequency f by the factor 1 - i f d - f^2 c + ...: it adds -d
times the velocity and c times the acceleration. For orientations both are columns of a linear
regression. Positions are tried at several delays, each with its own t and c: noise is the same at
each, so that the best delay is not biased, and a delay that looks like a lever arm is told from one
by its second order.

Columns come from poses that the displacements do not use: white noise has no part in both sides.
Noise that accumulates has. It makes the stream that the column comes from look less smooth than it
is, never smoother. So columns of the child show that the child is smoothed, columns of the parent
that the parent is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import MotionPairs
from hand_eye_calib.pairing.synchronise import PosePairs

# Half of the span of a displacement (s); an interval of the poses if that is longer.
_HALF_SPAN_S = 0.2

# Delays of positions that are tried are multiples of about this (s), so many in either direction.
_DELAY_STEP_S, _N_DELAYS = 0.05, 5

# Instants of a stencil may be off by this share of a step.
_TOLERANCE = 0.3
_MAX_INSTANTS, _MIN_INSTANTS = 1500, 150
_BLOCKS = 10

# Geman-McClure: residuals of about this many standard deviations have half the weight.
_TUNING, _ROUNDS, _MEDIAN_LENGTH = 3.0, 4, 1.538

# What remains without a delay is at least so many times of what remains with it. Without a delay,
# it was at most 1.2 in noise of any size.
_CONTRAST = 1.5

# Shares of the estimated noise of rotations that may be true as well.
_DOUBTS = (0.5, 1.5)

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


@dataclass(frozen=True)
class Delay(Biased):
    """A delay, s, and how many times what remains without it is of what remains with it."""

    contrast: float

    @property
    def is_clear(self) -> bool:
        """Whether the positions agree so much better with it that it is no accident of noise."""
        return self.contrast > _CONTRAST


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
    rotation_delay : Quantity
    position_delay : Delay
        s; positive if the child is late.
    rotation_smoothing, position_smoothing : Smoothing
    interval_s : float
        Typical time from one pose to the next, s.
    rms_speed : float
        Root mean square speed of the parent, m/s.
    """

    rotation_delay: Quantity
    rotation_smoothing: Smoothing
    position_delay: Delay
    position_smoothing: Smoothing
    interval_s: float
    rms_speed: float


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
    variance = np.median(((y - x - columns @ found.values) ** 2).sum(axis=1)) / _MEDIAN_LENGTH**2
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
    delay, of_rotations, variance = _rotations(pose_pairs, stencil, R, gain)
    late, of_positions = _positions(pose_pairs, stencil, R, variance)
    p = pose_pairs.Ts_pw_p[:, :3, 3]
    speeds = np.linalg.norm(p[stencil.at[2]] - p[stencil.at[-2]], axis=1) / (4 * stencil.step_s)
    return Response(
        rotation_delay=delay,
        rotation_smoothing=of_rotations,
        position_delay=late,
        position_smoothing=of_positions,
        interval_s=stencil.interval_s,
        rms_speed=float(np.sqrt(np.mean(np.minimum(speeds, 3 * np.median(speeds)) ** 2))),
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
    delay : int
        Poses from one delay that is tried to the next.
    """

    at: dict[int, IntArray]
    step_s: float
    interval_s: float
    delay: int

    @classmethod
    def of(cls, stamps_ns: IntArray) -> _Stencil | None:
        """The stencil around as many poses as have others at all distances."""
        if len(stamps_ns) < _MIN_INSTANTS:
            return None
        interval_s = float(np.median(np.diff(stamps_ns))) * 1e-9
        n = max(round(_HALF_SPAN_S / 2 / interval_s), 1)
        delay = max(round(_DELAY_STEP_S / interval_s), 1)
        reach = _FAR * n + _N_DELAYS * delay
        centres = np.arange(reach, len(stamps_ns) - reach)
        valid = np.ones(len(centres), dtype=bool)
        for k in (-reach, *(n * k for k in range(-_FAR, _FAR + 1)), reach):
            elapsed_s = (stamps_ns[centres + k] - stamps_ns[centres]) * 1e-9
            valid &= np.abs(elapsed_s - k * interval_s) < _TOLERANCE * (n + abs(k)) * interval_s
        centres = centres[valid]
        if len(centres) < _MIN_INSTANTS:
            return None
        centres = centres[:: -(-len(centres) // _MAX_INSTANTS)]
        at = {k: centres + n * k for k in range(-_FAR, _FAR + 1)}
        return cls(at, n * interval_s, interval_s, delay)


def _rotations(
    pose_pairs: PosePairs, stencil: _Stencil, R: FloatArray, gain: FloatArray
) -> tuple[Quantity, Smoothing, float]:
    """Delay and smoothing of the child's orientations, and variance of what remains (rad^2 per
    axis).
    """
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
    return found[0].quantity(3), smoothing, found[0].sigma ** 2


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
) -> tuple[Delay, Smoothing]:
    """Delay and smoothing of the child's positions.

    Noise of the parent's orientations moves a long lever arm more than a short one, which would
    favour delays with a short one. It has half of the ``variance`` of the rotations. A delay that
    depends on how well that is known is worth little: its bias is how far it moves if half of the
    noise more or less is assumed.
    """
    at, step_s = stencil.at, stencil.step_s
    parent = _Displacements(pose_pairs.Ts_pw_p, np.eye(3), at)
    child = _Displacements(pose_pairs.Ts_cw_c, R, at)
    x = parent.over(2)
    rotations = pose_pairs.Ts_pw_p[:, :3, :3]
    chords = np.swapaxes(rotations[at[0]], 1, 2) @ (rotations[at[2]] - rotations[at[-2]])
    base = np.concatenate([chords, -se3.skew(x)], axis=2)
    delays = np.arange(-_N_DELAYS, _N_DELAYS + 1)
    targets = [child.over(2, int(k) * stencil.delay) - x for k in delays]
    spacing_s = stencil.delay * stencil.interval_s
    delay, best = _delay(base, targets, variance, spacing_s)
    others = [_delay(base, targets, factor * variance, spacing_s)[0] for factor in _DOUBTS]
    delay = replace(delay, bias=max(abs(other.value - delay.value) for other in others))
    best = best if delay.is_clear else _N_DELAYS
    shift, target = int(delays[best]) * stencil.delay, targets[best]
    bends = [bend / (3 * step_s**2) for bend in (parent.bend(0), child.bend(shift))]
    smoothing = [
        _regress(
            np.concatenate([base, bend[:, :, None]], axis=2), target, variance=variance
        ).quantity(6)
        for bend in bends
    ]
    # The same noise of an orientation turns a displacement and its bend.
    bias = variance * _rms(x) / max(_rms(bends[0]), 1e-12)
    return delay, _smoothing(smoothing[0], smoothing[1], bias)


def _delay(
    base: FloatArray, targets: list[FloatArray], variance: float, spacing_s: float
) -> tuple[Delay, int]:
    """The delay at which the positions agree best, and which of those tried is nearest to it."""
    tried = [_regress(base, target, variance=variance) for target in targets]
    best = int(np.argmin([found.less_noise().sum() for found in tried]))
    # With the weights of the best, costs are a parabola.
    weights = tried[best].weights
    weighted = [_regress(base, target, weights, variance) for target in targets]
    return _best_delay(np.array([found.less_noise() for found in weighted]), best, spacing_s), best


def _rms(vectors: FloatArray) -> float:
    """Robust root mean square length."""
    return float(np.median(np.linalg.norm(vectors, axis=1)))


def _best_delay(costs: FloatArray, best: int, step_s: float) -> Delay:
    """Vertex of the parabola through the costs (delays, blocks) around the best, with the jackknife
    over blocks, and no bias.
    """
    total = costs.sum(axis=1)
    middle = int(np.clip(best, 1, len(total) - 2))

    def vertex(sums: FloatArray) -> float:
        below, top, above = sums[middle - 1 : middle + 2]
        curvature = below - 2 * top + above
        if curvature <= 0:
            return float(_N_DELAYS)
        return float(np.clip(0.5 * (below - above) / curvature, -_N_DELAYS, _N_DELAYS))

    left_out = np.array([vertex(total - costs[:, b]) for b in range(costs.shape[1])])
    n = len(left_out)
    sigma = np.sqrt((n - 1) / n * ((left_out - left_out.mean()) ** 2).sum())
    offset = vertex(total)
    below, top, above = total[middle - 1 : middle + 2]
    least = top - 0.5 * (below - 2 * top + above) * offset**2
    contrast = total[_N_DELAYS] / max(least, 1e-9 * abs(total[_N_DELAYS]), 1e-300)
    value = middle - _N_DELAYS + offset
    return Delay(float(value * step_s), float(sigma * step_s), 0.0, float(contrast))


@dataclass(frozen=True)
class _Displacements:
    """Displacements of a stream around instants, in the parent's axes there."""

    poses: FloatArray
    to_parent: FloatArray
    at: dict[int, IntArray]

    def _p(self, k: int, shift: int) -> FloatArray:
        return self.poses[self.at[k] + shift, :3, 3]

    def _in_body(self, vectors: FloatArray, k: int = 0) -> FloatArray:
        rotations = self.poses[self.at[k], :3, :3]
        return np.einsum("kji,kj->ki", rotations, vectors) @ self.to_parent.T

    def over(self, k: int, shift: int = 0) -> FloatArray:
        """From k steps before each instant to k after, of poses ``shift`` later."""
        return self._in_body(self._p(k, shift) - self._p(-k, shift))

    def bend(self, shift: int) -> FloatArray:
        """Difference of the accelerations at both ends of :meth:`over` two steps, times 3 steps
        squared, from other poses than those ends, and turned by other orientations.
        """
        ahead = self._p(4, shift) - self._p(3, shift) - self._p(1, shift) + self._p(0, shift)
        behind = self._p(0, shift) - self._p(-1, shift) - self._p(-3, shift) + self._p(-4, shift)
        bend = ahead - behind
        return 0.5 * (self._in_body(bend, -1) + self._in_body(bend, 1))


@dataclass(frozen=True)
class _Regression:
    """Values and standard deviations (m,), the robust cost of each block of time, the weights (K,)
    and their sum in each block, the standard deviation of what remains, and what noise adds to the
    products (3, 3) of the first three columns.
    """

    values: FloatArray
    sigmas: FloatArray
    block_costs: FloatArray
    weights: FloatArray
    block_weights: FloatArray
    sigma: float
    of_noise: FloatArray

    def less_noise(self) -> FloatArray:
        """Cost of each block without what noise of rotations makes of a lever arm, the first three
        values.
        """
        lever_arm = self.values[:3]
        of_noise = float(lever_arm @ self.of_noise @ lever_arm)
        return self.block_costs - of_noise * self.block_weights / self.block_weights.sum()

    def quantity(self, k: int) -> Quantity:
        return Quantity(float(self.values[k]), float(self.sigmas[k]))


def _regress(
    columns: FloatArray,
    target: FloatArray,
    given: FloatArray | None = None,
    variance: float = 0.0,
) -> _Regression:
    """Robust linear regression of (K, 3) on (K, 3, m), with the jackknife over blocks of time; not
    robust, but weighted, with given weights. ``variance`` is that of noise in the first three
    columns, which would make their values too small.
    """
    K, _, m = columns.shape
    flat = np.concatenate([columns, target[:, :, None]], axis=2)
    edges = np.linspace(0, K, _BLOCKS + 1).astype(int)[:-1]
    products = np.einsum("kai,kaj->kij", flat, flat).reshape(K, -1)
    weights = np.ones(K) if given is None else given
    for _ in range(_ROUNDS if given is None else 1):
        blocks = np.add.reduceat(products * weights[:, None], edges).reshape(_BLOCKS, m + 1, m + 1)
        total = blocks.sum(axis=0)
        ridge = np.diag(1e-9 * np.diag(total)[:m] + 1e-300)
        of_noise = _of_noise(total[:3, :3], variance * weights.sum())
        ridge[:3, :3] -= of_noise
        values = np.linalg.solve(total[:m, :m] + ridge, total[:m, m])
        lengths = np.linalg.norm(target - columns @ values, axis=1)
        sigma = max(float(np.median(lengths)) / _MEDIAN_LENGTH, 1e-12)
        squared = (lengths / sigma) ** 2 / (3 * _TUNING**2)
        weights = 1.0 / (1.0 + squared) ** 2 if given is None else given
    rest = total - blocks
    shares = rest[:, :m, :m] + (1.0 - 1.0 / _BLOCKS) * ridge
    left_out = np.linalg.solve(shares, rest[:, :m, m:])[..., 0]
    spread = left_out - left_out.mean(axis=0)
    costs = weights * lengths**2 if given is not None else sigma**2 * squared / (1.0 + squared)
    sigmas = np.sqrt((_BLOCKS - 1) / _BLOCKS * (spread**2).sum(axis=0))
    block_costs, block_weights = (np.add.reduceat(each, edges) for each in (costs, weights))
    return _Regression(values, sigmas, block_costs, weights, block_weights, sigma, of_noise)


def _of_noise(gram: FloatArray, amount: float) -> FloatArray:
    """What noise of this amount adds to sums of products (3, 3): at most half of them."""
    sizes, directions = np.linalg.eigh(gram)
    return (directions * np.minimum(amount, 0.5 * np.maximum(sizes, 0.0))) @ directions.T
