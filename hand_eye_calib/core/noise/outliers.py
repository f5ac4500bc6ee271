"""Jumps, poses that are wrong by themselves, and heavy tails.

What one increment or one pose's white error is expected to be from everything else, against what it
is, in units of the covariance of the difference: chi-square with six degrees of freedom if nothing
is wrong. With u = V^-1 r and P = V^-1 that is ``u_i' P_ii^-1 u_i`` (de Jong, Penzer, J. Amer.
Statist. Assoc. 93, 1998), and follows from the smoothed states.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.stats import (
    CHI2,
    MEDIAN_LENGTH,
    STUDENT,
    chi_square_quantile,
    median,
    robust_weights,
)
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise.increments import N_SYSTEMATIC, Course, Streams, linearise
from hand_eye_calib.core.noise.normal import transposed
from hand_eye_calib.core.noise.reml import walk_covariance
from hand_eye_calib.core.noise.state_space import WHITE, Posterior, combined
from hand_eye_calib.core.noise.tuning import Tuning

# Smallest jump (m, rad): rounding.
_LEAST_JUMP = 1e-6

# Covariances of differences are raised by this share and this variance (m^2, rad^2): rounding must
# not make them indefinite.
_RAISED_COVARIANCE = 1e-9
_LEAST_VARIANCE = 1e-18


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

    def across(self, kept: np.ndarray, longest_gap: int) -> Outliers:
        """For some poses, in order: a jump between two of them counts for their increment, and so
        does a gap of more poses than the longest.
        """
        jumps = np.logical_or.reduceat(self.jumps[: kept[-1]], kept[:-1])
        return Outliers(jumps | (np.diff(kept) > longest_gap), self.spikes[kept])

    def differs_by(self, other: Outliers) -> float:
        """Share of the evidence that counts in one but not in the other."""
        differing = np.sum(self.jumps != other.jumps) + np.sum(self.spikes != other.spikes)
        return float(differing) / len(self.spikes)


def first_outliers(
    streams: Streams,
    course: Course,
    T_parent_child: FloatArray,
    residuals: FloatArray,
    tuning: Tuning,
) -> Outliers:
    """What stands out of residuals (n, 6) without knowing their noise.

    A pose between two jumps counts as an outlier, and its increments as evidence, until shown
    otherwise; with a jump behind it where what stands out of the others stands out of the bridged
    one, too.
    """
    sizes = np.linalg.norm(residuals.reshape(-1, 2, 3), axis=2)
    usual = np.array([median(each) for each in sizes.T])
    limits = np.maximum(tuning.first_jump_sigmas * usual / MEDIAN_LENGTH, _LEAST_JUMP)
    jumps = (sizes > limits).any(axis=1)
    spikes = np.r_[False, jumps[1:] & jumps[:-1], False]
    if np.mean(spikes) > tuning.most_spikes:
        return Outliers(jumps, np.zeros(len(spikes), dtype=bool))
    jumps = jumps & ~(spikes[1:] | spikes[:-1])
    if spikes.any():
        poses, none = bridged(streams, T_parent_child, spikes), np.zeros(N_SYSTEMATIC)
        bridging = linearise(poses, course, T_parent_child, none, ()).columns[:, :, -1]
        sizes = np.linalg.norm(bridging.reshape(-1, 2, 3), axis=2)
        jumps |= (sizes > limits).any(axis=1) & spikes[:-1]
    return Outliers(jumps, spikes)


def innovations(posterior: Posterior, spikes: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Chi-squares of all increments (n,) and of all poses' white errors (N,)."""
    space, levels, (states, walk) = posterior.space, posterior.levels, posterior.restricted()
    of_walk = _chi_squares(
        walk[:, :, 0],
        posterior.walk_covariance * space.relative[:, None, None],
        walk_covariance(posterior) + walk[:, :, 1:] @ transposed(walk[:, :, 1:]),
        space.cut,
    )
    white, weights = states[:, :WHITE], np.where(spikes, 1.0, space.weights)
    along = np.exp(levels[len(space.white)]) * space.twists
    of_white = _chi_squares(
        white[:, :, 0],
        (combined(levels, space.white) + along[:, :, None] * space.twists[:, None])
        / weights[:, None, None],
        posterior.factor.selected_inverse[0][:, :WHITE, :WHITE]
        + white[:, :, 1:] @ transposed(white[:, :, 1:]),
        spikes,
    )
    return of_walk, of_white


def _chi_squares(
    values: FloatArray, prior: FloatArray, posterior: FloatArray, left_out: BoolArray
) -> FloatArray:
    """Chi-square (n,) of smoothed values (n, 6); their covariance is prior minus posterior, or plus
    if the value was excluded.
    """
    spread = prior - posterior
    spread[left_out] = prior[left_out] + posterior[left_out]
    spread += _RAISED_COVARIANCE * prior + _LEAST_VARIANCE * np.eye(6)
    return np.asarray((values * np.linalg.solve(spread, values[:, :, None])[:, :, 0]).sum(axis=1))


def judged(
    outliers: Outliers,
    of_walk: FloatArray,
    of_white: FloatArray,
    tuning: Tuning,
    with_spikes: bool = True,
) -> Outliers:
    """Outliers by the chi-squares of increments (n,) and poses (N,): the largest of its
    neighbourhood is one, and what a walk makes probable is no jump.
    """
    alarming = chi_square_quantile(tuning.false_alarms / len(of_white))
    # A step of the walk is a jump from the level of false alarms on if the others are normal, in
    # units of what they usually are.
    others = of_walk[~outliers.jumps]
    ordinary = others[others < alarming]
    factor = tuning.decisive
    if len(ordinary) and np.mean(ordinary**2) <= tuning.walk_kurtosis * np.mean(ordinary) ** 2:
        factor = float(max(median(ordinary) / CHI2[0.5][6], 1.0))
    decisive = of_walk > factor * alarming
    beside = np.maximum(of_white[1:], of_white[:-1])
    found = decisive & _is_peak(of_walk) & (of_walk >= beside) & ~outliers.jumps
    jumps = (outliers.jumps & decisive) | found
    spikes = outliers.spikes
    if with_spikes:
        walks = np.maximum(np.r_[0.0, of_walk], np.r_[of_walk, 0.0])
        spikes = spikes | (of_white > alarming) & _is_peak(of_white) & (of_white > walks)
    return Outliers(jumps, spikes)


def _is_peak(values: FloatArray) -> BoolArray:
    padded = np.r_[0.0, values, 0.0]
    return (padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:])


def bridged(streams: Streams, T_parent_child: FloatArray, spikes: BoolArray) -> Streams:
    """Streams whose outlier poses of the child follow the parent's motion from the pose before.

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


def tail_weights(posterior: Posterior, tuning: Tuning) -> FloatArray:
    """Weights (N,) of white errors with Student's t distribution, whose level may change over time:
    ``u = (nu + 6) / (nu m + E w' S^-1 w)``.

    The level m of a pose is the mean of as many poses around it as predict it best, or 1 if none
    do. Of the expectation, the share that smoothing takes from the white errors is spread over the
    poses in inverse proportion to their weights.
    """
    states = posterior.states_after(posterior.normal.step)[:, :WHITE]
    pulled = se3.times(posterior.white, states)
    squares = (states * pulled).sum(axis=1)
    weights, free = posterior.space.weights, posterior.space.weights == 0.0
    kept = min(float(np.mean((weights * squares)[~free])) / 6.0, 1.0)
    hidden = 6.0 * (1.0 - kept) / np.where(free, 1.0, weights)
    expected = np.where(free, 0.0, squares + hidden)
    levels, of_all = [np.ones(len(expected))], np.array([~free, expected])
    for width in tuning.widths:  # so many neighbours on either side
        sums = np.cumsum(np.pad(of_all, ((0, 0), (width + 1, width))), axis=1)
        n_around, around = sums[:, 2 * width + 1 :] - sums[:, : len(free)] - of_all
        levels.append((STUDENT + around) / (STUDENT + 6.0 * n_around))
    losses = [
        float(np.mean((3.0 * np.log(m) + 5.0 * np.log1p(expected / (STUDENT * m)))[~free]))
        for m in levels
    ]
    best = int(np.argmin(losses))
    level = levels[best if losses[best] < losses[0] - tuning.least_gain_of_widths else 0]
    return robust_weights("student", expected / level) / level
