"""Offset and rate of the child's clock.

The offset (s) is added to the child's stamps to convert them to the parent's clock. The rate is the
change of the offset per second. The coarse offset comes from the angular rates
(:mod:`~hand_eye_calib.core.alignment.rate_correlation`). The fine offset is estimated together with
X and the scale (:mod:`~hand_eye_calib.core.alignment.similarity`).
"""

from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.core.alignment.rate_correlation import (
    Correlation,
    correlate_rates,
)
from hand_eye_calib.core.alignment.similarity import (
    MIN_PAIRS,
    SimilarityFit,
    fit_similarity,
)
from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import InputError, NotEnoughDataError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import (
    MAX_PAIRS,
    MotionPairs,
    find_leap,
    pairs_over,
    synchronise,
)
from hand_eye_calib.core.results.records import ClockRate

#: Durations (s) of the motions from which the offset is estimated, with one fit per duration. The
#: fit with the smallest standard deviation is used, usually that of short motions.
LAGS_S = (1.0, 0.3, 3.0)

# Largest number of motions in a fit that estimates a clock rate.
_MAX_PAIRS_OF_RATE = 5 * MAX_PAIRS

# The child's velocity at a stamp is its motion from half a span before to half a span after the
# stamp. Over a short span, velocities are noisy; over a long span, they share poses with the motion
# pair. Both errors bias the offset, and make its standard deviation too small. Smallest half span
# (s):
_MIN_SPAN_S = 0.05
# Largest half span (s) for noisy streams:
_MAX_SPAN_S = 0.3

# Smallest half span, in intervals between poses of the child:
_SPAN_INTERVALS = 2.0

# Half span for noisy streams: this factor times the time in which the body rotates by one standard
# deviation of the rotation residuals.
_SPAN_OF_NOISE = 1.4

# Largest number of linearisations in a fit.
_MAX_ROUNDS = 8

# Linearisation ends if the offset changes by less than this (s).
_SETTLED_S = 2e-5

# Prior standard deviation of a clock rate (s/s). 75 ppm are usual for USB devices.
_RATE_PRIOR = 1e-4

# Stamps are corrected for a clock rate only if it exceeds this number of standard deviations.
_MIN_RATE_SIGMAS = 4.0

# Largest plausible difference (s) between fine and coarse offset ...
_FINE_RANGE_S = 0.25
# ... or, if it is longer, this number of intervals of the slower stream.
_FINE_RANGE_INTERVALS = 2.0

_NO_CORRELATION = Correlation()


@dataclass(frozen=True)
class TimeOffset:
    """Estimate of a clock offset. The default values mean that no estimate exists.

    Attributes
    ----------
    seconds : float
        Offset (s), to be added to the child's stamps.
    sigma_s : float
        Standard deviation of the offset.
    correlation : Correlation
        Correlation of the angular rates, with the coarse offset.
    fit : SimilarityFit or None
        Fit with the fine offset; None if no fit explains the motion.
    spread_s : float
        Largest difference between the offsets from motions of different durations. It is infinite
        if a duration has no fit.
    rate : ClockRate or None
        Change of the offset with time; None if no fit explains the motion, or if the recording is
        too short.
    """

    seconds: float = 0.0
    sigma_s: float = np.inf
    correlation: Correlation = _NO_CORRELATION
    fit: SimilarityFit | None = None
    spread_s: float = np.inf
    rate: ClockRate | None = None

    def steadied(self, child: Trajectory) -> Trajectory:
        """Return the child with stamps corrected for the clock rate; unchanged without a rate."""
        if self.rate is None:
            return child
        return child.shifted(0.0, self.rate.used, self.rate.at_ns)

    def largest_s(self, duration_s: float) -> float:
        """Return the largest offset (s) within a recording: its size plus half of the drift."""
        changed_s = 0.5 * self.rate.used * duration_s if self.rate else 0.0
        return abs(self.seconds) + abs(changed_s)


def estimate_time_offset(
    parent: Trajectory,
    child: Trajectory,
    max_gap_s: float = CalibratorConfig.max_gap,
    of_speed: bool = False,
) -> TimeOffset:
    """Estimate the offset of the child's clock.

    The coarse offset comes from the angular rates, and the fine offset from a fit of X, scale and
    offset.

    Parameters
    ----------
    parent, child : Trajectory
        Streams; their stamps need not overlap.
    max_gap_s : float
        Longest interval (s) between two poses in which poses are interpolated.
    of_speed : bool
        Whether a sensor has no orientation. Only a coarse offset is then estimated, from speeds.

    Returns
    -------
    TimeOffset

    Raises
    ------
    NotEnoughDataError
        If the coarse offset cannot be trusted; the message has the reason.
    InputError
        If a stream's stamps leap by days.
    """
    for name, stream in (("parent", parent), ("child", child)):
        leap = find_leap(stream.stamps_ns)
        if leap:
            raise InputError(f"the {name} stream's {'; '.join(leap)}")
    correlation = correlate_rates(parent, child, max_gap_s, of_speed)
    if not correlation.is_clear:
        doubt = correlation.doubt("speeds" if of_speed else "angular rates")
        raise NotEnoughDataError(
            f"the time offset cannot be estimated: {doubt}; drive with more turns and "
            "changes of speed, or give time_offset in seconds"
        )
    if of_speed:
        sigma_s = max(parent.interval_s, child.interval_s) / 5
        return TimeOffset(correlation.offset_s, sigma_s, correlation)
    coarse = TimeOffset(correlation.offset_s, correlation=correlation)
    return refine_time_offset(parent, child, coarse, max_gap_s)


def refine_time_offset(
    parent: Trajectory,
    child: Trajectory,
    at: TimeOffset,
    max_gap_s: float,
    negligible_s: float = 0.0,
    first: TimeOffset | None = None,
) -> TimeOffset:
    """Refine a clock offset by fits to motions of several durations.

    Parameters
    ----------
    parent, child : Trajectory
    at : TimeOffset
        Initial value. Its correlation has the coarse offset.
    max_gap_s : float
        Longest interval (s) between two poses in which poses are interpolated.
    negligible_s : float
        Offset (s) that the caller can neglect. If a fit has a smaller offset, no further durations
        are tried.
    first : TimeOffset, optional
        Offset from motions of the first duration, if it is already estimated.

    Returns
    -------
    TimeOffset
        Refined offset. If no fit explains the motion: the coarse offset with a large standard
        deviation.
    """
    reach_s = max(
        _FINE_RANGE_S,
        _FINE_RANGE_INTERVALS * max(parent.interval_s, child.interval_s),
    )
    coarse_s = at.correlation.offset_s
    best = TimeOffset(coarse_s, reach_s / 5, at.correlation)
    offsets_s = list[float]()
    for lag_s in LAGS_S:
        offset = first if lag_s == LAGS_S[0] else None
        offset = offset or offset_over(
            lag_s, parent, child, at, max_gap_s, negligible_s
        )
        at = replace(at, fit=offset.fit)
        explains = offset.fit and offset.fit.explains_translation
        if not explains or abs(offset.seconds - coarse_s) > reach_s:
            continue
        offsets_s.append(offset.seconds)
        if offset.sigma_s < best.sigma_s:
            best = offset
        if offset.largest_s(child.duration_s) < negligible_s:
            break
    if len(offsets_s) < len(LAGS_S):
        return best
    # The offsets differ if errors are correlated for longer than a block of the jackknife.
    sigma_s = float(np.hypot(best.sigma_s, np.std(offsets_s, ddof=1)))
    return replace(best, spread_s=np.ptp(offsets_s), sigma_s=sigma_s)


def offset_over(
    lag_s: float,
    parent: Trajectory,
    child: Trajectory,
    at: TimeOffset,
    max_gap_s: float,
    negligible_s: float,
    start: SimilarityFit | FloatArray | None = None,
    max_unexplained: float | None = None,
) -> TimeOffset:
    """Estimate the offset from motions of one duration.

    Parameters
    ----------
    lag_s : float
        Duration (s) of the motions.
    parent, child : Trajectory
    at : TimeOffset
        Initial values of offset, fit and rate.
    max_gap_s : float
        Longest interval (s) between two poses in which poses are interpolated.
    negligible_s : float
        Offset (s) that the caller can neglect. The iteration ends early if the offset is clearly
        smaller. Otherwise it ends if the offset changes by less than a twentieth of this value.
    start : SimilarityFit or (4, 4) array, optional
        Initial fit or X, if ``at`` has no fit.
    max_unexplained : float, optional
        A start that leaves more than this share of the motion unexplained is not refined.

    Returns
    -------
    TimeOffset
        The offset; without a fit if there are too few motions.
    """
    span_s = max(_MIN_SPAN_S, _SPAN_INTERVALS * child.interval_s)
    offset_s = at.seconds
    start = at.fit or start
    settled_s = max(_SETTLED_S, negligible_s / 20)
    rate = at.rate or _unknown_rate(child)
    for _ in range(_MAX_ROUNDS):
        max_pairs = _MAX_PAIRS_OF_RATE if rate.is_used else MAX_PAIRS
        shifted = child.shifted(offset_s, rate.used, rate.at_ns)
        pose_pairs = synchronise(parent, shifted, max_gap_s)
        pairs = pairs_over(pose_pairs, lag_s, max_pairs)
        if len(pairs) < MIN_PAIRS:
            return TimeOffset(offset_s, np.inf, at.correlation)
        twists = _twists_of_pairs(shifted, pose_pairs.stamps_ns, pairs, span_s)
        fit = _fit_of(pairs, twists, start, max_unexplained)
        start = fit
        span_s = max(span_s, _span_of_noise_s(fit, np.concatenate(twists)))
        offset_s = float(offset_s + fit.offset_s)
        if _is_small_step(fit.offset_s, offset_s, settled_s, negligible_s):
            before = rate
            rate = _rate(fit, pose_pairs.stamps_ns[pairs.i], before)
            change_s = abs(rate.used - before.used) * child.duration_s
            is_settled = change_s < settled_s
            if is_settled and (max_pairs > MAX_PAIRS or not rate.is_used):
                break
    estimate = TimeOffset(offset_s, fit.offset_sigma_s, at.correlation, fit)
    return _with_known_rate(estimate, rate)


def _with_known_rate(offset: TimeOffset, rate: ClockRate) -> TimeOffset:
    """Return the offset with a clock rate, if the rate was estimated."""
    if not np.isfinite(rate.sigma_ppm):
        return offset
    return replace(offset, rate=rate)


def _is_small_step(
    step_s: float, offset_s: float, settled_s: float, negligible_s: float
) -> bool:
    """Return whether the last step ends the iteration: a small step, or a negligible offset."""
    return (
        abs(step_s) < settled_s
        or abs(offset_s) + abs(step_s) < negligible_s / 2
    )


def _unknown_rate(child: Trajectory) -> ClockRate:
    """Return a clock rate of zero with an infinite standard deviation."""
    first_ns, last_ns = child.stamps_ns[[0, -1]]
    middle_ns = int(first_ns + (last_ns - first_ns) // 2)
    return ClockRate(ppm=0.0, sigma_ppm=np.inf, at_ns=middle_ns)


def _span_of_noise_s(fit: SimilarityFit, twists: FloatArray) -> float:
    """Return the half span (s) that noise requires for velocities (M, 6)."""
    squared_rates = (twists[:, 3:] ** 2).sum(axis=1)
    rms_rate = float(np.sqrt(np.mean(squared_rates)))
    span_s = _SPAN_OF_NOISE * fit.sigma_rotation / max(rms_rate, 1e-9)
    return min(span_s, _MAX_SPAN_S)


def _fit_of(
    pairs: MotionPairs,
    twists: tuple[FloatArray, FloatArray],
    start: SimilarityFit | FloatArray | None,
    max_unexplained: float | None,
) -> SimilarityFit:
    """Fit X, scale and offset. If the scale makes the fit fail, fit only X and offset.

    With ``max_unexplained``, see :func:`offset_over`, there is only one attempt.
    """
    fit = fit_similarity(
        pairs, twists, start=start, max_unexplained=max_unexplained
    )
    if fit.explains_translation or max_unexplained is not None:
        return fit
    # If the body rotates about one of its sensors, the motion does not determine the scale.
    in_one_unit = fit_similarity(pairs, twists, same_unit=True)
    return in_one_unit if in_one_unit.explains_translation else fit


def _twists_of_pairs(
    child: Trajectory, stamps_ns: IntArray, pairs: MotionPairs, span_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return velocities (K, 6) of the child at the first and at the last pose of K motion pairs.

    ``stamps_ns`` are the stamps of the pose pairs. See :func:`_twists`.
    """
    # Motions share poses. Compute the velocity at each pose once.
    poses, index_of_pose = np.unique(
        np.r_[pairs.i, pairs.j], return_inverse=True
    )
    twists = _twists(child, stamps_ns[poses], span_s)[index_of_pose]
    at_starts, at_ends = np.split(twists, 2)
    return at_starts, at_ends


def _twists(
    trajectory: Trajectory, stamps_ns: IntArray, span_s: float
) -> FloatArray:
    """Return velocities (N, 6), m/s and rad/s, of a sensor in its own frame at stamps (N,).

    A velocity is the mean from ``span_s`` seconds before to ``span_s`` seconds after a stamp. At
    the ends of the trajectory the time is shorter.
    """
    span_ns = round(span_s * 1e9)
    first_ns, last_ns = trajectory.stamps_ns[[0, -1]]
    from_ns = np.clip(stamps_ns - span_ns, first_ns, last_ns)
    until_ns = np.clip(stamps_ns + span_ns, first_ns, last_ns)
    before, after = np.split(
        trajectory.at(np.concatenate([from_ns, until_ns])), 2
    )
    steps = se3.log(se3.inverse(before) @ after)
    spans_s = (until_ns - from_ns) * 1e-9
    return steps / spans_s[:, None]


def _rate(
    fit: SimilarityFit, stamps_ns: IntArray, before: ClockRate
) -> ClockRate:
    """Estimate the clock rate from the offsets of a fit in blocks of time.

    The slope of a line through these offsets is a correction of ``before``. Because the blocks are
    few, the variance of the slope is that of Student's t distribution. The result is the posterior
    mean with the prior _RATE_PRIOR.

    Parameters
    ----------
    fit : SimilarityFit
    stamps_ns : (K,) int64 array
        Stamps of the motion pairs, on the parent's clock.
    before : ClockRate
        Rate for which the child's stamps were already corrected in the fit.

    Returns
    -------
    ClockRate
        The new rate; ``before`` if a block has no information on the offset.
    """
    offsets_s, weights = fit.offsets_of_blocks
    if weights.min() <= 0.0:
        return before
    blocks_s = np.array_split((stamps_ns - stamps_ns[0]) * 1e-9, len(offsets_s))
    block_times_s = [float(block.mean()) for block in blocks_s]
    times_s = block_times_s - np.average(block_times_s, weights=weights)
    centred_s = offsets_s - np.average(offsets_s, weights=weights)
    spread = float(weights @ times_s**2)
    slope = float(weights @ (times_s * centred_s)) / spread
    residuals_s = centred_s - slope * times_s
    # Student's t distribution with n - 2 degrees of freedom has the variance (n - 2) / (n - 4).
    variance = float(weights @ residuals_s**2) / (len(offsets_s) - 4) / spread
    variance /= fit.curvature_share**2
    total = (before.used + slope) * _RATE_PRIOR**2 / (_RATE_PRIOR**2 + variance)
    sigma = float(np.sqrt(variance))
    is_used = abs(total) > _MIN_RATE_SIGMAS * sigma
    return replace(
        before, ppm=1e6 * total, sigma_ppm=1e6 * sigma, is_used=is_used
    )
