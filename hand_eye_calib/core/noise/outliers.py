"""Jumps, outlier poses, and heavy tails.

The smoothed walk of an increment, or the smoothed white error of a pose, is compared with its
prediction from all other data. With the prior covariance S and the posterior covariance C of a
smoothed value u, the covariance of u is S - C, and

    chi-square = u' (S - C)^-1 u

has six degrees of freedom if nothing is wrong. It equals ``(V^-1 r)_i' (V^-1)_ii^-1 (V^-1 r)_i``
(de Jong, Penzer, J. Amer. Statist. Assoc. 93, 1998). An increment with a large chi-square is a
jump, and a pose with a large chi-square is an outlier ("spike").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.stats import (
    CHI2,
    MEDIAN_LENGTH,
    chi_square_quantile,
    median,
    robust_weights,
)
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise.increments import N_SYSTEMATIC, Course, Streams, linearise
from hand_eye_calib.core.noise.normal import transposed
from hand_eye_calib.core.noise.state_space import WHITE, Posterior, total_covariance
from hand_eye_calib.core.noise.tuning import Tuning

# Smallest jump (m, rad). Smaller ones are rounding.
_SMALLEST_JUMP = 1e-6

# Share of its own, and variance (m^2, rad^2), by which the diagonal of S - C is raised. Rounding
# must not make S - C indefinite.
_RAISED_SHARE = 1e-9
_RAISED_VARIANCE = 1e-18

# Number of poses whose chi-squares are computed at once.
_PART = 10_000


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

    def across(self, kept: IntArray, longest_gap: int) -> Outliers:
        """Return the outliers of a subset of poses.

        An increment between two kept poses is a jump if it contains a jump, or if it is longer than
        ``longest_gap`` poses.
        """
        jumps = np.logical_or.reduceat(self.jumps[: kept[-1]], kept[:-1])
        return Outliers(jumps | (np.diff(kept) > longest_gap), self.spikes[kept])

    def differs_by(self, other: Outliers) -> float:
        """Share of poses and increments that are outliers in only one of both sets."""
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

    A pose between two large residuals is an outlier at first, and its increments are evidence. The
    increment across the pose is a jump, too, if its residual is large once the pose is bridged.
    """
    sizes = _part_sizes(residuals)
    usual = np.array([median(part_sizes) for part_sizes in sizes.T])
    limits = np.maximum(tuning.first_jump_sigmas * usual / MEDIAN_LENGTH, _SMALLEST_JUMP)
    jumps: BoolArray = np.asarray((sizes > limits).any(axis=1))
    spikes = np.r_[False, jumps[1:] & jumps[:-1], False]
    if np.mean(spikes) > tuning.max_outlier_share:
        return Outliers(jumps, np.zeros(len(spikes), dtype=bool))
    jumps = jumps & ~(spikes[1:] | spikes[:-1])
    if spikes.any():
        poses = bridged(streams, T_parent_child, spikes)
        parameters = np.zeros(N_SYSTEMATIC)
        bridging = linearise(poses, course, T_parent_child, parameters, []).residuals
        jumps |= (_part_sizes(bridging) > limits).any(axis=1) & spikes[:-1]
    return Outliers(jumps, spikes)


def _part_sizes(residuals: FloatArray) -> FloatArray:
    """Lengths (n, 2) of translations and rotations of residuals (n, 6)."""
    return np.linalg.norm(residuals.reshape(-1, 2, 3), axis=2)


def innovations(posterior: Posterior, spikes: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the chi-squares of the increments (n,) and of the poses' white errors (N,)."""
    space = posterior.space
    states, walk = posterior.smoothed()
    of_walk = chi_squares(
        walk[:, :, 0],
        posterior.walk_covariance * space.walk_factors[:, None, None],
        posterior.walk_covariances() + walk[:, :, 1:] @ transposed(walk[:, :, 1:]),
        space.cut,
    )
    white = states[:, :WHITE]
    weights = np.where(spikes, 1.0, space.weights)
    covariance = total_covariance(posterior.levels, space.white_bases)
    covariance_left = posterior.factor.selected_inverse[0][:, :WHITE, :WHITE]
    of_white = chi_squares(
        white[:, :, 0],
        covariance / weights[:, None, None],
        covariance_left + white[:, :, 1:] @ transposed(white[:, :, 1:]),
        spikes,
    )
    return of_walk, of_white


def chi_squares(
    values: FloatArray, prior: FloatArray, posterior: FloatArray, left_out: BoolArray
) -> FloatArray:
    """Return the chi-squares (n,) of smoothed values (n, 6).

    Their covariances are prior minus posterior (n, 6, 6); the sum of both for a value whose own
    data are left out.
    """
    squares = np.empty(len(values))
    # In parts: temporary arrays of a long recording would need as much memory as its posterior.
    for start in range(0, len(values), _PART):
        part = slice(start, start + _PART)
        are_left_out = left_out[part]
        prior_part = prior[part]
        covariances = prior_part - posterior[part]
        covariances[are_left_out] = prior_part[are_left_out] + posterior[part][are_left_out]
        # On the diagonal alone: the prior of jitter along one velocity is singular itself.
        covariances += (_RAISED_SHARE * prior_part + _RAISED_VARIANCE) * np.eye(6)
        weighted = np.linalg.solve(covariances, values[part, :, None])[:, :, 0]
        squares[part] = (values[part] * weighted).sum(axis=1)
    return squares


def judged(
    outliers: Outliers,
    of_walk: FloatArray,
    of_white: FloatArray,
    tuning: Tuning,
    with_spikes: bool = True,
) -> Outliers:
    """Detect outliers by the chi-squares of increments (n,) and poses (N,).

    An outlier has the largest chi-square of its neighbourhood. A step that the walk makes probable
    is no jump.

    Parameters
    ----------
    outliers : Outliers
        Detected before. Outlier poses stay outliers, jumps only if they are large.
    of_walk, of_white : (n,) and (N,) arrays
    tuning : Tuning
    with_spikes : bool
        Whether to detect new outlier poses.
    """
    alarming = chi_square_quantile(tuning.false_alarms / len(of_white))
    is_large = of_walk > _jump_factor(of_walk[~outliers.jumps], alarming, tuning) * alarming
    of_poses = np.maximum(of_white[1:], of_white[:-1])
    is_new = _is_peak(of_walk) & (of_walk >= of_poses) & ~outliers.jumps
    jumps = is_large & (outliers.jumps | is_new)
    spikes = outliers.spikes
    if with_spikes:
        of_increments = np.maximum(np.r_[0.0, of_walk], np.r_[of_walk, 0.0])
        spikes = spikes | (of_white > alarming) & _is_peak(of_white) & (of_white > of_increments)
    return Outliers(jumps, spikes)


def _jump_factor(of_walk: FloatArray, alarming: float, tuning: Tuning) -> float:
    """Factor of the alarming chi-square above which a step of the walk is a jump.

    A walk with normal steps has jumps from the alarming level on, in units of its usual steps. A
    walk with heavy tails needs more.
    """
    ordinary = of_walk[of_walk < alarming]
    if not len(ordinary) or np.mean(ordinary**2) > tuning.walk_kurtosis * np.mean(ordinary) ** 2:
        return tuning.heavy_jump_factor
    return float(max(median(ordinary) / CHI2[0.5][6], 1.0))


def _is_peak(values: FloatArray) -> BoolArray:
    """Return whether each value (n,) is larger than its neighbours."""
    padded = np.r_[0.0, values, 0.0]
    return (padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:])


def bridged(streams: Streams, T_parent_child: FloatArray, spikes: BoolArray) -> Streams:
    """Replace outlier poses of the child by the pose before, moved as the parent moved.

    An outlier pose is no evidence. The increments on both sides of it are linearised to first
    order, so its large error must not be in them.
    """
    Ts_cw_c = streams.Ts_cw_c.copy()
    outlier_poses = np.flatnonzero(spikes[1:]) + 1
    As = se3.inverse(streams.Ts_pw_p[outlier_poses - 1]) @ streams.Ts_pw_p[outlier_poses]
    Bs = se3.inverse(T_parent_child) @ As @ T_parent_child
    for pose, B in zip(outlier_poses, Bs, strict=True):
        Ts_cw_c[pose] = Ts_cw_c[pose - 1] @ B
    return Streams(streams.stamps_s, streams.Ts_pw_p, Ts_cw_c)


def tail_weights(posterior: Posterior) -> FloatArray:
    """Return weights (N,) of the white errors w if these have Student's t distribution.

    ``u = (nu + 6) / (nu + E w' S^-1 w)`` with nu degrees of freedom and the white covariance S.
    Smoothing removes a share of the expectation. This share is spread over the poses in inverse
    proportion to their weights.
    """
    w = posterior.states_after(posterior.normal.step)[:, :WHITE]
    squares = (w * se3.times(posterior.white_precision, w)).sum(axis=1)
    weights = posterior.space.weights
    is_free = weights == 0.0
    share_kept = min(float(np.mean((weights * squares)[~is_free])) / WHITE, 1.0)
    hidden = WHITE * (1.0 - share_kept) / np.where(is_free, 1.0, weights)
    return robust_weights("student", np.where(is_free, 0.0, squares + hidden))
