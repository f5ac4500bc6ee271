"""Jumps, poses that are wrong by themselves, and heavy tails.

What one increment or one pose's white error is expected to be from everything else, against what it
is, in units of the covariance of the difference: chi-square with six degrees of freedom if nothing
is wrong. With u = V^-1 r and P = V^-1 that is ``u_i' P_ii^-1 u_i`` (de Jong, Penzer, J. Amer.
Statist. Assoc. 93, 1998), and follows from the smoothed states.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls.block_tridiagonal import transposed
from hand_eye_calib.gls.increments import Streams
from hand_eye_calib.gls.reml import walk_covariance
from hand_eye_calib.gls.state_space import WHITE, Posterior
from hand_eye_calib.stats import CHI2, MEDIAN_LENGTH, STUDENT, chi_square_quantile, median

# False alarms expected in a whole recording.
_FALSE_ALARMS = 0.01

# Large steps of a walk with heavy tails are no jumps: these exceed the level of false alarms by
# this factor. Tails are heavy from this ratio on of the fourth moment of the steps that are below
# that level to the square of the second (4/3 for normal ones).
_DECISIVE, _WALK_KURTOSIS = 2.5, 1.5

# No more than this share of the increments can be jumps: otherwise the noise levels are wrong.
_MOST_JUMPS = 0.5

# First look for jumps: increments this many robust sigmas out. Wide, for the noise levels are not
# known yet. More pairs of them than this share are no spikes.
_FIRST_JUMP_SIGMAS = 5.0
_LEAST_JUMP = 1e-6
_MOST_SPIKES = 0.3

# Tails are heavy if the fourth moment of the white errors exceeds the square of the second by this
# factor (4/3 for normal ones).
_HEAVY_KURTOSIS = 1.7

# Poses on either side that may share a level of the white errors.
_WIDTHS = (2, 5, 12, 30)

# A level that changes is believed if it lowers the loss per pose by so much.
_LEAST_GAIN = 0.1

# Share of a covariance that keeps differences of covariances away from zero.
_ROUNDING, _LEAST_VARIANCE = 1e-9, 1e-18


# Poses farther apart than this say nothing of the noise levels: over such a gap a walk of the
# rotation shifts positions in a way that the model of one increment does not follow. In
# recordings of thousands of poses the walk fitted was a tenth of the true one.
LONGEST_GAP = 60


@dataclass(frozen=True)
class Outliers:
    """Evidence that does not count.

    Attributes
    ----------
    jumps : (n,) bool array
        Increments across which a trajectory jumps for good.
    spikes : (N,) bool array
        Poses that are wrong by themselves.
    """

    jumps: BoolArray
    spikes: BoolArray

    def across(self, kept: np.ndarray, longest_gap: int | None = None) -> Outliers:
        """For some poses, in order: a jump between two of them counts for their increment, and so
        does a gap of more poses than the longest.
        """
        if len(kept) == len(self.spikes):
            return self
        jumps = np.logical_or.reduceat(self.jumps[: kept[-1]], kept[:-1])
        if longest_gap is not None:
            jumps |= np.diff(kept) > longest_gap
        return Outliers(jumps, self.spikes[kept])

    def differs_by(self, other: Outliers) -> float:
        """Share of the evidence that counts in one but not in the other."""
        differing = np.sum(self.jumps != other.jumps) + np.sum(self.spikes != other.spikes)
        return float(differing) / len(self.spikes)


def first_outliers(residuals: FloatArray) -> Outliers:
    """What stands out of residuals (n, 6) without knowing their noise.

    A pose between two jumps counts as a spike, and its increments as evidence, until shown
    otherwise.
    """
    jumps = _standing_out(residuals, residuals)
    spikes = np.r_[False, jumps[1:] & jumps[:-1], False]
    if np.mean(spikes) > _MOST_SPIKES:
        return Outliers(jumps, np.zeros(len(spikes), dtype=bool))
    return Outliers(jumps & ~(spikes[1:] | spikes[:-1]), spikes)


def with_jumps_across_spikes(
    outliers: Outliers, residuals: FloatArray, bridging: FloatArray
) -> Outliers:
    """With a jump behind each spike where what stood out of the residuals (n, 6) stands out of
    those with bridged poses, too.
    """
    behind = _standing_out(bridging, residuals) & outliers.spikes[:-1]
    return Outliers(outliers.jumps | behind, outliers.spikes)


def _standing_out(residuals: FloatArray, usual: FloatArray) -> BoolArray:
    """Which residuals (n, 6) are far larger than usual ones, in translation or in rotation."""
    sizes, ordinary = (
        np.linalg.norm(each.reshape(-1, 2, 3), axis=2) for each in (residuals, usual)
    )
    limits = [_FIRST_JUMP_SIGMAS * median(each) / MEDIAN_LENGTH for each in ordinary.T]
    return np.asarray((sizes > np.maximum(limits, _LEAST_JUMP)).any(axis=1))


def surprises(posterior: Posterior, spikes: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Chi-squares of all increments (n,) and of all poses' white errors (N,)."""
    space, levels, states = posterior.space, posterior.levels, posterior.restricted()
    walk = posterior.restricted_walk(states)
    of_walk = _chi_squares(
        walk[:, :, 0],
        posterior.walk_covariance * space.relative[:, None, None],
        walk_covariance(posterior) + _squared(walk[:, :, 1:]),
        space.cut,
    )
    white, weights = states[:, :WHITE], np.where(spikes, 1.0, space.weights)
    of_white = _chi_squares(
        white[:, :, 0],
        space.white_covariance(levels) / weights[:, None, None],
        posterior.selected_inverse[0][:, :WHITE, :WHITE] + _squared(white[:, :, 1:]),
        spikes,
    )
    return of_walk, of_white


def _squared(columns: FloatArray) -> FloatArray:
    return columns @ transposed(columns)


def _chi_squares(
    values: FloatArray, prior: FloatArray, posterior: FloatArray, left_out: BoolArray
) -> FloatArray:
    """Chi-square (n,) of smoothed values (n, 6); their covariance is prior minus posterior, or plus
    if the value was excluded.
    """
    spread = np.where(left_out[:, None, None], prior + posterior, prior - posterior)
    spread += _ROUNDING * prior + _LEAST_VARIANCE * np.eye(6)
    return np.asarray((values * np.linalg.solve(spread, values[:, :, None])[:, :, 0]).sum(axis=1))


def judged(
    outliers: Outliers, of_walk: FloatArray, of_white: FloatArray, with_spikes: bool
) -> Outliers:
    """Outliers by the chi-squares of increments (n,) and poses (N,): the largest of its
    neighbourhood is one, and what a walk makes probable is no jump.
    """
    alarming = chi_square_quantile(_FALSE_ALARMS / len(of_white))
    decisive = of_walk > _decisive(of_walk[~outliers.jumps], alarming)
    beside = np.maximum(of_white[1:], of_white[:-1])
    found = decisive & _is_peak(of_walk) & (of_walk >= beside) & ~outliers.jumps
    jumps = outliers.jumps & decisive
    if np.sum(jumps | found) <= _MOST_JUMPS * len(jumps):
        jumps = jumps | found
    spikes = outliers.spikes
    if with_spikes:
        walks = np.maximum(np.r_[0.0, of_walk], np.r_[of_walk, 0.0])
        spikes = spikes | (of_white > alarming) & _is_peak(of_white) & (of_white > walks)
    return Outliers(jumps, spikes)


def _decisive(of_walk: FloatArray, alarming: float) -> float:
    """Chi-square from which a step of the walk is a jump: that of false alarms if the others are
    normal, in the units of what they are as a rule.
    """
    ordinary = of_walk[of_walk < alarming]
    if len(ordinary) == 0 or np.mean(ordinary**2) > _WALK_KURTOSIS * np.mean(ordinary) ** 2:
        return _DECISIVE * alarming
    return float(max(median(ordinary) / CHI2[0.5][6], 1.0)) * alarming


def _is_peak(values: FloatArray) -> BoolArray:
    padded = np.r_[0.0, values, 0.0]
    return (padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:])


def bridged(streams: Streams, T_parent_child: FloatArray, spikes: BoolArray) -> Streams:
    """Streams with the child's poses at spikes as the parent's motion from the pose before has
    them.

    A pose that is wrong by itself is no evidence, but its large error would not be small in the
    increments on both sides of it, which are of first order.
    """
    Ts_cw_c = streams.Ts_cw_c.copy()
    at = np.flatnonzero(spikes[1:]) + 1
    by_parent = se3.inverse(streams.Ts_pw_p[at - 1]) @ streams.Ts_pw_p[at]
    motions = se3.inverse(T_parent_child) @ by_parent @ T_parent_child
    for pose, motion in zip(at, motions, strict=True):
        Ts_cw_c[pose] = Ts_cw_c[pose - 1] @ motion
    return Streams(streams.stamps_s, streams.Ts_pw_p, Ts_cw_c)


def tails_are_heavy(outliers: Outliers, of_white: FloatArray) -> bool:
    """Whether the white errors (chi-squares (N,)) are far from normal."""
    normal = of_white[~outliers.spikes]
    return bool(np.mean(normal**2) > _HEAVY_KURTOSIS * np.mean(normal) ** 2)


def tail_weights(posterior: Posterior) -> FloatArray:
    """Weights (N,) of white errors with Student's t distribution, whose level may change over time:
    ``u = (nu + 6) / (nu m + E w' S^-1 w)``.

    The level m of a pose is the mean of as many poses around it as predict it best, or 1 if none
    do. Of the expectation, the share that smoothing takes from the white errors is spread over the
    poses in inverse proportion to their weights.
    """
    states = posterior.states_after(posterior.normal.step)[:, :WHITE]
    pulled = (posterior.white @ states[:, :, None])[:, :, 0]
    squares = (states * pulled).sum(axis=1)
    weights, free = posterior.space.weights, posterior.space.is_free
    kept = min(float(np.mean((weights * squares)[~free])) / 6.0, 1.0)
    hidden = 6.0 * (1.0 - kept) / np.where(free, 1.0, weights)
    expected = np.where(free, 0.0, squares + hidden)
    levels = [np.ones(len(expected))]
    for width in _WIDTHS:
        around = STUDENT + 6.0 * _around((~free).astype(float), width)
        levels.append((STUDENT + _around(expected, width)) / around)
    losses = [
        float(np.mean((3.0 * np.log(m) + 5.0 * np.log1p(expected / (STUDENT * m)))[~free]))
        for m in levels
    ]
    best = int(np.argmin(losses))
    level = levels[best if losses[best] < losses[0] - _LEAST_GAIN else 0]
    return np.asarray((STUDENT + 6.0) / (STUDENT * level + expected))


def _around(values: FloatArray, width: int) -> FloatArray:
    """Sums (N,) of the values of so many neighbours on either side."""
    sums = np.cumsum(np.r_[0.0, np.pad(values, width)])
    return np.asarray(sums[2 * width + 1 :] - sums[: len(values)] - values)
