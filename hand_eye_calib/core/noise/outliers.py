"""Jumps, outlier poses, and heavy tails.

The tests use the smoothed step w of the walk of each increment, and the smoothed white error v of
each pose. If v has the prior covariance S and the posterior covariance S_post, the smoothed v has
the covariance S - S_post. Then

    chi-square = v' (S - S_post)^-1 v

has six degrees of freedom if nothing is wrong, and the same holds for w. It measures how far the
data at this place are from their prediction by all other data: it equals
``(V^-1 e)_i' (V^-1)_ii^-1 (V^-1 e)_i`` with residuals e of covariance V (de Jong, Penzer, J. Amer.
Statist. Assoc. 93, 1998). An increment with a large chi-square is a jump, and a pose with a large
chi-square is an outlier, in the code a "spike".
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
from hand_eye_calib.core.noise.increments import (
    Course,
    Streams,
    first_residuals,
)
from hand_eye_calib.core.noise.noise_model import MIN_VARIANCE
from hand_eye_calib.core.noise.normal import transposed
from hand_eye_calib.core.noise.partwise import PartwisePosterior
from hand_eye_calib.core.noise.state_space import (
    WHITE,
    Posterior,
    total_covariance,
)
from hand_eye_calib.core.noise.tuning import Tuning

# The diagonal of S - S_post is increased by this share of the diagonal of S. Rounding could
# otherwise make the matrix indefinite.
_INCREASE_SHARE = 1e-9


@dataclass(frozen=True)
class Outliers:
    """Jumps and outlier poses.

    Attributes
    ----------
    jumps : (n,) bool array
        Increments at which a trajectory jumps and does not return. They are not used.
    spikes : (N,) bool array
        Outlier poses: the pose is wrong, but its neighbours are right. Outlier poses are not used.
    """

    jumps: BoolArray
    spikes: BoolArray

    def across(self, kept: IntArray, longest_gap: int) -> Outliers:
        """Return the outliers of the subset ``kept`` (indices of poses, ascending).

        An increment between two kept poses is a jump if it contains a jump, or if it is longer than
        ``longest_gap`` poses.
        """
        # Whether a jump is between each kept pose and the next kept pose.
        jumps = np.logical_or.reduceat(self.jumps[: kept[-1]], kept[:-1])
        return Outliers(
            jumps | (np.diff(kept) > longest_gap), self.spikes[kept]
        )

    def differs_from(self, other: Outliers) -> bool:
        """Return whether a jump or an outlier pose is in only one of both sets."""
        return not (
            np.array_equal(self.jumps, other.jumps)
            and np.array_equal(self.spikes, other.spikes)
        )


def first_outliers(
    streams: Streams,
    course: Course,
    T_parent_child: FloatArray,
    residuals: FloatArray,
    tuning: Tuning,
) -> Outliers:
    """Detect outliers in residuals (n, 6) before a noise model exists.

    A residual is large if it exceeds a multiple of its robust standard deviation. A pose between
    two large residuals is an outlier; any other large residual is a jump. The outlier pose is
    replaced. If the residual after it is still large, the increment after the pose is a jump, too.
    If too many poses would be outliers, all large residuals are jumps.
    """
    lengths = _lengths(residuals)
    usual_lengths = np.array([median(column) for column in lengths.T])
    limits = np.maximum(
        tuning.first_jump_sigmas * usual_lengths / MEDIAN_LENGTH,
        np.sqrt(MIN_VARIANCE),
    )
    is_large: BoolArray = np.asarray((lengths > limits).any(axis=1))
    spikes = np.r_[False, is_large[1:] & is_large[:-1], False]
    if np.mean(spikes) > tuning.max_outlier_share:
        return Outliers(is_large, np.zeros(len(spikes), dtype=bool))
    is_beside_spike = spikes[1:] | spikes[:-1]
    jumps = is_large & ~is_beside_spike
    if spikes.any():
        poses = bridge_outliers(streams, T_parent_child, spikes)
        bridged_residuals = first_residuals(poses, course, T_parent_child)
        is_still_large = (_lengths(bridged_residuals) > limits).any(axis=1)
        jumps |= is_still_large & spikes[:-1]
    return Outliers(jumps, spikes)


def _lengths(residuals: FloatArray) -> FloatArray:
    """Return the lengths (n, 2) of translation (m) and rotation (rad) of residuals (n, 6)."""
    return np.linalg.norm(residuals.reshape(-1, 2, 3), axis=2)


def leave_one_out_chi_squares(
    posterior: Posterior | PartwisePosterior, spikes: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the chi-squares of the increments (n,) and of the poses' white errors (N,).

    Each chi-square compares data with their prediction by all other data, earlier and later. Jumps
    and the outlier poses ``spikes`` (N,) are not used for predictions, but have chi-squares, too.
    An increment between two parts of a long recording has the chi-square zero.
    """
    of_walk = []
    of_white = []
    start = 0
    for part in posterior.parts():
        end = start + len(part.space.weights)
        walk, white = _chi_squares_of_part(part, spikes[start:end])
        of_walk.append(np.r_[walk, 0.0])
        of_white.append(white)
        start = end
    return np.concatenate(of_walk)[:-1], np.concatenate(of_white)


def _chi_squares_of_part(
    posterior: Posterior, spikes: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the chi-squares of :func:`leave_one_out_chi_squares` for one part of a recording."""
    space = posterior.space
    # Column 0 is the posterior mean. The other columns are a root of the covariance that the
    # uncertainty of the parameters adds.
    states, walk = posterior.smoothed()
    of_walk = chi_squares(
        walk[:, :, 0],
        posterior.walk_covariance * space.walk_factors[:, None, None],
        posterior.walk_covariances()
        + walk[:, :, 1:] @ transposed(walk[:, :, 1:]),
        space.cut,
    )
    white = states[:, :WHITE]
    # An outlier pose has the weight 0 in the state space. Its chi-square belongs to the pose that
    # replaces it; it matters only as a neighbour of other poses.
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
    values: FloatArray,
    prior: FloatArray,
    posterior: FloatArray,
    is_unused: BoolArray,
) -> FloatArray:
    """Return the chi-squares (n,) of smoothed values (n, 6).

    ``prior`` and ``posterior`` (n, 6, 6) are the covariances of the values. A smoothed value has
    the covariance prior minus posterior. The values in ``is_unused`` are predictions from all other
    data: their covariance is prior plus posterior.
    """
    covariances = prior - posterior
    covariances[is_unused] = prior[is_unused] + posterior[is_unused]
    # Increase the diagonal only. The prior of jitter is singular, because jitter acts along one
    # velocity. The prior of positions or rotations alone is singular, too.
    covariances += (_INCREASE_SHARE * prior + MIN_VARIANCE) * np.eye(6)
    weighted = np.linalg.solve(covariances, values[:, :, None])[:, :, 0]
    return np.asarray((values * weighted).sum(axis=1))


def detect_outliers(
    outliers: Outliers,
    of_walk: FloatArray,
    of_white: FloatArray,
    tuning: Tuning,
    with_spikes: bool = True,
) -> Outliers:
    """Detect jumps and outlier poses by their chi-squares.

    A new jump or outlier needs a chi-square larger than that of neighbouring poses and increments.

    Parameters
    ----------
    outliers : Outliers
        Result of the previous detection. Its outlier poses remain outliers. Its jumps remain jumps
        if their chi-square is still large.
    of_walk, of_white : (n,) and (N,) arrays
        Chi-squares of increments and of poses, see :func:`leave_one_out_chi_squares`.
    tuning : Tuning
    with_spikes : bool
        Whether to detect new outlier poses.
    """
    # Tail probability of a single test. All poses together then have the expected number of false
    # alarms.
    threshold = chi_square_quantile(tuning.false_alarms / len(of_white))
    jump_threshold = (
        _jump_factor(of_walk[~outliers.jumps], threshold, tuning) * threshold
    )
    at_either_end = np.maximum(of_white[1:], of_white[:-1])
    is_new = _is_peak(of_walk) & (of_walk >= at_either_end) & ~outliers.jumps
    may_be_jump = outliers.jumps | is_new
    jumps = may_be_jump & (of_walk > jump_threshold)
    spikes = outliers.spikes
    if with_spikes:
        on_either_side = np.maximum(np.r_[0.0, of_walk], np.r_[of_walk, 0.0])
        is_largest = _is_peak(of_white) & (of_white > on_either_side)
        is_new_spike = is_largest & (of_white > threshold)
        spikes = spikes | is_new_spike
    return Outliers(jumps, spikes)


def _jump_factor(
    of_walk: FloatArray, threshold: float, tuning: Tuning
) -> float:
    """Return the factor of the threshold above which the chi-square of a step is a jump.

    For normal steps, the factor is the ratio of their median chi-square to that of the model, and
    at least 1. For steps with heavy tails, the factor is a larger constant.
    """
    ordinary = of_walk[of_walk < threshold]
    if not len(ordinary):
        return tuning.heavy_jump_factor
    normal_square = tuning.walk_kurtosis * np.mean(ordinary) ** 2
    if np.mean(ordinary**2) > normal_square:
        return tuning.heavy_jump_factor
    return float(max(median(ordinary) / CHI2[0.5][6], 1.0))


def _is_peak(values: FloatArray) -> BoolArray:
    """Return a mask of the values (n,) that exceed both neighbours."""
    padded = np.r_[0.0, values, 0.0]
    return (padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:])


def bridge_outliers(
    streams: Streams, T_parent_child: FloatArray, spikes: BoolArray
) -> Streams:
    """Replace the child's pose at each outlier by its previous pose, moved like the parent.

    The state space ignores the error of an outlier pose. But the increments on both sides are
    linearised to first order, which a large error would make invalid. If the parent's pose is
    wrong, the child's pose is replaced, too: both errors then agree. Outlier poses at the start of
    a recording have no sound pose before them, and are replaced by the next pose, moved back.
    """
    Ts_cw_c = streams.Ts_cw_c.copy()
    outlier_poses = np.flatnonzero(spikes)
    first_sound = int(np.argmin(spikes))
    at_start = outlier_poses[outlier_poses < first_sound][::-1]
    later = outlier_poses[outlier_poses > first_sound]
    poses = np.concatenate([at_start, later])
    neighbours = np.concatenate([at_start + 1, later - 1])
    As = se3.inverse(streams.Ts_pw_p[neighbours]) @ streams.Ts_pw_p[poses]
    Bs = se3.inverse(T_parent_child) @ As @ T_parent_child
    # A neighbour that is an outlier, too, was replaced before.
    for pose, neighbour, B in zip(poses, neighbours, Bs, strict=True):
        Ts_cw_c[pose] = Ts_cw_c[neighbour] @ B
    return Streams(streams.stamps_s, streams.Ts_pw_p, Ts_cw_c)


def tail_weights(posterior: Posterior | PartwisePosterior) -> FloatArray:
    """Return weights (N,) of the white errors v for Student's t distribution.

    ``weight = (nu + 6) / (nu + E[v' S^-1 v])``, with nu = 4 degrees of freedom and the white
    covariance S. At the present weights u, v has the covariance S / u, and ``v' S^-1 v`` the mean
    6 / u. The smoothed v^ is shorter than v: let r be the mean of ``u v^' S^-1 v^ / 6`` over all
    poses, at most 1. Then ``E[v' S^-1 v] = v^' S^-1 v^ + 6 (1 - r) / u``.
    """
    return np.concatenate(
        [_tail_weights_of_part(part) for part in posterior.parts()]
    )


def _tail_weights_of_part(posterior: Posterior) -> FloatArray:
    """Return the weights of :func:`tail_weights` for one part of a recording."""
    smoothed = posterior.states_after(posterior.normal.step)[:, :WHITE]
    forces = se3.times(posterior.white_precision, smoothed)
    squares = (smoothed * forces).sum(axis=1)
    weights = posterior.space.weights
    is_outlier = weights == 0.0
    weighted_squares = (weights * squares)[~is_outlier]
    remaining_share = min(float(np.mean(weighted_squares)) / WHITE, 1.0)
    removed = (
        WHITE * (1.0 - remaining_share) / np.where(is_outlier, 1.0, weights)
    )
    expected_squares = np.where(is_outlier, 0.0, squares + removed)
    return robust_weights("student", expected_squares)
