"""Jumps, outlier poses, and heavy tails.

An increment or a pose's white error is compared with its prediction from all other data, in units
of the covariance of the difference. This is chi-square with six degrees of freedom if nothing is
wrong. With u = V^-1 r and P = V^-1 it is ``u_i' P_ii^-1 u_i`` (de Jong, Penzer, J. Amer.
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
    """Jumps and outlier poses.

    Attributes
    ----------
    jumps : (n,) bool array
        Increments across which a trajectory jumps for good; they are no evidence.
    spikes : (N,) bool array
        Outlier poses: wrong by themselves, and no evidence.
    """

    jumps: BoolArray
    spikes: BoolArray

    def across(self, kept: np.ndarray, longest_gap: int) -> Outliers:
        """Return the outliers of a subset of poses.

        An increment between two of them is a jump if a jump lies between, or if the gap is longer
        than ``longest_gap`` poses.
        """
        jumps = np.logical_or.reduceat(self.jumps[: kept[-1]], kept[:-1])
        return Outliers(jumps | (np.diff(kept) > longest_gap), self.spikes[kept])

    def differs_by(self, other: Outliers) -> float:
        """Share of poses and increments that are outliers in one but not in the other."""
        differing = np.sum(self.jumps != other.jumps) + np.sum(self.spikes != other.spikes)
        return float(differing) / len(self.spikes)


def first_outliers(
    streams: Streams,
    course: Course,
    T_parent_child: FloatArray,
    residuals: FloatArray,
    tuning: Tuning,
) -> Outliers:
    """Detect outliers in residuals (n, 6) without a noise model.

    A pose between two jumps is an outlier at first, and its increments are evidence. The increment
    across it is a jump, too, if its residual stands out once the pose is bridged.
    """
    sizes = np.linalg.norm(residuals.reshape(-1, 2, 3), axis=2)
    usual = np.array([median(part_sizes) for part_sizes in sizes.T])
    limits = np.maximum(tuning.first_jump_sigmas * usual / MEDIAN_LENGTH, _LEAST_JUMP)
    jumps = (sizes > limits).any(axis=1)
    spikes = np.r_[False, jumps[1:] & jumps[:-1], False]
    if np.mean(spikes) > tuning.most_spikes:
        return Outliers(jumps, np.zeros(len(spikes), dtype=bool))
    jumps = jumps & ~(spikes[1:] | spikes[:-1])
    if spikes.any():
        poses = bridged(streams, T_parent_child, spikes)
        none = np.zeros(N_SYSTEMATIC)
        bridging = linearise(poses, course, T_parent_child, none, ()).columns[:, :, -1]
        sizes = np.linalg.norm(bridging.reshape(-1, 2, 3), axis=2)
        jumps |= (sizes > limits).any(axis=1) & spikes[:-1]
    return Outliers(jumps, spikes)


def innovations(posterior: Posterior, spikes: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Chi-squares of the increments (n,) and of the poses' white errors (N,)."""
    space = posterior.space
    levels = posterior.levels
    states, walk = posterior.restricted()
    of_walk = chi_squares(
        walk[:, :, 0],
        posterior.walk_covariance * space.relative[:, None, None],
        walk_covariance(posterior) + walk[:, :, 1:] @ transposed(walk[:, :, 1:]),
        space.cut,
    )
    white = states[:, :WHITE]
    weights = np.where(spikes, 1.0, space.weights)
    along = np.exp(levels[len(space.white)]) * space.twists
    of_white = chi_squares(
        white[:, :, 0],
        (combined(levels, space.white) + along[:, :, None] * space.twists[:, None])
        / weights[:, None, None],
        posterior.factor.selected_inverse[0][:, :WHITE, :WHITE]
        + white[:, :, 1:] @ transposed(white[:, :, 1:]),
        spikes,
    )
    return of_walk, of_white


def chi_squares(
    values: FloatArray, prior: FloatArray, posterior: FloatArray, left_out: BoolArray
) -> FloatArray:
    """Chi-square (n,) of smoothed values (n, 6); their covariance is prior minus posterior, or plus
    if the value was excluded.
    """
    spread = prior - posterior
    spread[left_out] = prior[left_out] + posterior[left_out]
    # On the diagonal alone: a prior of jitter along one velocity is singular itself.
    spread += (_RAISED_COVARIANCE * prior + _LEAST_VARIANCE) * np.eye(6)
    return np.asarray((values * np.linalg.solve(spread, values[:, :, None])[:, :, 0]).sum(axis=1))


def judged(
    outliers: Outliers,
    of_walk: FloatArray,
    of_white: FloatArray,
    tuning: Tuning,
    with_spikes: bool = True,
) -> Outliers:
    """Detect outliers by the chi-squares of increments (n,) and poses (N,).

    An outlier is the largest of its neighbourhood. A step that the walk makes probable is no jump.
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
    new_jumps = decisive & _is_peak(of_walk) & (of_walk >= beside) & ~outliers.jumps
    jumps = (outliers.jumps & decisive) | new_jumps
    spikes = outliers.spikes
    if with_spikes:
        walks = np.maximum(np.r_[0.0, of_walk], np.r_[of_walk, 0.0])
        spikes = spikes | (of_white > alarming) & _is_peak(of_white) & (of_white > walks)
    return Outliers(jumps, spikes)


def _is_peak(values: FloatArray) -> BoolArray:
    padded = np.r_[0.0, values, 0.0]
    return (padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:])


def bridged(streams: Streams, T_parent_child: FloatArray, spikes: BoolArray) -> Streams:
    """Replace outlier poses of the child by the pose before, moved as the parent moved.

    An outlier pose is no evidence. The increments on both sides of it are linearised to first
    order, so that its large error must not be in them.
    """
    Ts_cw_c = streams.Ts_cw_c.copy()
    at = np.flatnonzero(spikes[1:]) + 1
    by_parent = se3.inverse(streams.Ts_pw_p[at - 1]) @ streams.Ts_pw_p[at]
    motions = se3.inverse(T_parent_child) @ by_parent @ T_parent_child
    for pose, motion in zip(at, motions, strict=True):
        Ts_cw_c[pose] = Ts_cw_c[pose - 1] @ motion
    return Streams(streams.stamps_s, streams.Ts_pw_p, Ts_cw_c)


def tail_weights(posterior: Posterior, tuning: Tuning) -> FloatArray:
    """Weights (N,) of white errors with Student's t distribution.

    ``u = (nu + 6) / (nu m + E w' S^-1 w)``, where the level m may change over time. m of a pose is
    the mean over the number of poses around it that predicts it best, or 1 if none does. Smoothing
    takes a share of the expectation; this share is spread over the poses in inverse proportion to
    their weights.
    """
    states = posterior.states_after(posterior.normal.step)[:, :WHITE]
    pulled = se3.times(posterior.white, states)
    squares = (states * pulled).sum(axis=1)
    weights = posterior.space.weights
    free = posterior.space.weights == 0.0
    kept = min(float(np.mean((weights * squares)[~free])) / 6.0, 1.0)
    hidden = 6.0 * (1.0 - kept) / np.where(free, 1.0, weights)
    expected = np.where(free, 0.0, squares + hidden)
    levels = [np.ones(len(expected))]
    of_all = np.array([~free, expected])
    for width in tuning.widths:
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
