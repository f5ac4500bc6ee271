"""Offset and rate of the child's clock.

The offset (s) is to be added to the child's stamps, so that they are on the parent's clock. The
rate is the change of the offset per second.

Model: two sensors on one rigid body rotate by the same angle in the same time, however they are
mounted. The coarse offset maximises the correlation of their angular rates. It needs no extrinsic,
no common world, no common scale and no particular order of quaternions, because reordered or
inverted quaternions have the same angles. The fine offset is estimated together with X and the
scale (:mod:`~hand_eye_calib.core.alignment.similarity`).
"""

from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.core.alignment.similarity import MIN_PAIRS, SimilarityFit, fit_similarity
from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import InputError, NotEnoughDataError
from hand_eye_calib.core.base.stats import quantile
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory, repetitions
from hand_eye_calib.core.pairing.motion_pairs import (
    MAX_PAIRS,
    MotionPairs,
    find_leap,
    pairs_over,
    synchronise,
)
from hand_eye_calib.core.results.records import ClockRate

# Angles are measured over windows of this number of sampling steps, so that the noise of single
# poses does not exceed the motion.
_WINDOW_STEPS = 3

# Smallest length of a window (s).
_MIN_WINDOW_S = 0.2

# Smallest sampling step (s), for streams with short intervals.
_MIN_STEP_S = 0.02
# Largest sampling step (s), for streams with long intervals.
_MAX_STEP_S = 1.0

# Largest number of sampling steps. Longer recordings have longer steps.
_MAX_SAMPLES = 200_000

# Share of the windows, those with the largest angular rates, whose rates are clipped: they may be
# jumps of a stream instead of motion.
_CLIPPED_SHARE = 0.03

# An offset is possible if both streams overlap for this share of the shorter stream ...
_MIN_OVERLAP_SHARE = 0.25
# ... and for this time (s).
_MIN_OVERLAP_S = 5.0

# Half width of the peak of the correlation in seconds. Offsets nearer to the best offset are part
# of the same peak, and no rivals.
_PEAK_WIDTH_S = 2.0
# Half width of the peak in windows, if that is wider.
_PEAK_WIDTH_WINDOWS = 5.0

# Smallest ratio of the significance of the best offset to that of its best rival. In sixteen real
# recordings the ratio was 5 to 12 for streams of one body, and at most 1.3 for unrelated streams.
_MIN_DISTINCTNESS = 2.0

# Smallest correlation coefficient of angular rates at a trusted offset.
_MIN_CORRELATION = 0.5

# Shortest repetition of a pose (s) that may come from a frozen stream.
_MIN_REPETITION_S = 1.0

# Smallest standard deviation of an angular rate (rad/s) for a correlation.
MIN_VARIATION = 0.01

# Durations (s) of the motions that the offset is estimated from, one fit for each. The fit with the
# smallest standard deviation is used; it is usually that of short motions.
_LAGS_S = (1.0, 0.3, 3.0)

# Largest number of motions of a fit with a clock rate.
_MAX_PAIRS_OF_RATE = 5 * MAX_PAIRS

# The child's velocity at a stamp is its motion from one half span before to one half span after it.
# Shorter spans contain so much noise, and longer ones so many poses of the motion pair, that the
# offset is biased and its standard deviation too small.
# Smallest half span (s).
_MIN_SPAN_S = 0.05
# Largest half span (s) that is chosen because of noise.
_MAX_SPAN_S = 0.3

# Smallest half span in intervals of the child's stream.
_SPAN_INTERVALS = 2.0

# Half span for noisy streams: this factor times the time in which the body rotates by one standard
# deviation of the residual rotations.
_SPAN_OF_NOISE = 1.4

# Largest number of linearisations of a fit.
_MAX_ROUNDS = 8

# The linearisations end if the offset changes by less than this (s).
_SETTLED_S = 2e-5

# Prior standard deviation of a clock rate (s/s). 75 ppm are usual for USB devices.
_RATE_PRIOR = 1e-4

# Smallest clock rate that the stamps are corrected for, in standard deviations.
_MIN_RATE_SIGMAS = 4.0

# Largest plausible difference between fine and coarse offset (s) ...
_FINE_RANGE_S = 0.25
# ... or in intervals of the slower stream, if that is longer.
_FINE_RANGE_INTERVALS = 2.0


@dataclass(frozen=True)
class Correlation:
    """Best correlation of the angular rates of two streams over all clock offsets.

    The defaults mean that no offset could be estimated.

    Attributes
    ----------
    offset_s : float
        Offset (s) with the best correlation, to be added to the child's stamps. It is accurate to
        about a tenth of a sampling step.
    correlation : float
        Correlation coefficient of the angular rates at this offset.
    distinctness : float
        Significance of this offset over that of its best rival, which is the best offset outside
        the peak.
    variation : float
        Standard deviation of the angular rate (rad/s) of the stream that varies less.
    ratio : float
        Ratio of the child's angular rates to the parent's.
    """

    offset_s: float = 0.0
    correlation: float = 0.0
    distinctness: float = 0.0
    variation: float = 0.0
    ratio: float = 1.0

    @property
    def is_clear(self) -> bool:
        """Whether the offset can be trusted."""
        return not self.doubt()

    def doubt(self, quantity: str = "angular rates") -> str:
        """Return the reason why the offset cannot be trusted; empty if it can.

        ``quantity`` is the name of the correlated rates, for the text.
        """
        if self.variation < MIN_VARIATION:
            return "the streams hardly rotate, or rotate at a constant rate"
        if self.correlation < _MIN_CORRELATION:
            return (
                f"their {quantity} are correlated by {self.correlation:.2f} at best "
                f"({_MIN_CORRELATION} is needed)"
            )
        if self.distinctness < _MIN_DISTINCTNESS:
            return (
                f"the best offset is only {self.distinctness:.1f} times better than the next "
                f"({_MIN_DISTINCTNESS:g} is needed)"
            )
        return ""


def correlate_rates(
    parent: Trajectory,
    child: Trajectory,
    max_gap_s: float = CalibratorConfig.max_gap,
    of_speed: bool = False,
) -> Correlation:
    """Find the clock offset with the best correlation of the angular rates of two streams.

    The stamps of the streams need not overlap. If poses of a frozen stream are repeated, they may
    hide the offset; they are left out in a second attempt.

    Parameters
    ----------
    parent, child : Trajectory
    max_gap_s : float
        Windows that overlap a longer gap (s) between poses are left out.
    of_speed : bool
        Correlate speeds instead, for a sensor without orientation.

    Returns
    -------
    Correlation
        The best correlation; the default if a stream is too short.
    """
    if min(len(parent), len(child)) < 4:
        return Correlation()
    step_s = float(np.clip(max(parent.interval_s, child.interval_s), _MIN_STEP_S, _MAX_STEP_S))
    step_s = max(step_s, max(parent.duration_s, child.duration_s) / _MAX_SAMPLES)
    window_s = max(_WINDOW_STEPS * step_s, _MIN_WINDOW_S)
    parent_rates = angular_rates(parent, window_s, step_s, max_gap_s, of_speed)
    child_rates = angular_rates(child, window_s, step_s, max_gap_s, of_speed)
    if _shorter_s(parent_rates, child_rates, step_s) < _MIN_OVERLAP_S:
        return Correlation()
    start_s = float(parent.stamps_ns[0] - child.stamps_ns[0]) * 1e-9
    best = _best_correlation(parent_rates, child_rates, start_s, step_s, window_s)
    if best.is_clear:
        return best
    _leave_out_repetitions(parent, parent_rates, step_s, window_s)
    _leave_out_repetitions(child, child_rates, step_s, window_s)
    if _shorter_s(parent_rates, child_rates, step_s) < _MIN_OVERLAP_S:
        return best
    second = _best_correlation(parent_rates, child_rates, start_s, step_s, window_s)
    return second if second.is_clear else best


def _shorter_s(parent_rates: FloatArray, child_rates: FloatArray, step_s: float) -> float:
    """Return the total duration (s) of finite rates, of the stream with fewer finite rates."""
    return min(np.isfinite(parent_rates).sum(), np.isfinite(child_rates).sum()) * step_s


def _leave_out_repetitions(
    stream: Trajectory, rates: FloatArray, step_s: float, window_s: float
) -> None:
    """Set those of the rates (M,) to NaN whose windows contain a repeated pose of a stream."""
    start_ns = int(stream.stamps_ns[0])
    for from_ns, until_ns in repetitions(stream, _MIN_REPETITION_S):
        first = max(int(((from_ns - start_ns) * 1e-9 - window_s) / step_s) + 1, 0)
        last = int((until_ns - start_ns) * 1e-9 / step_s) + 1
        rates[first : last + 1] = np.nan


def _best_correlation(
    of_parent: FloatArray, of_child: FloatArray, start_s: float, step_s: float, window_s: float
) -> Correlation:
    """Return the best correlation of rates (M,) and (N,) over all lags.

    Parameters
    ----------
    of_parent, of_child : (M,) and (N,) arrays
        Rates in consecutive windows; NaN if unknown.
    start_s : float
        First stamp (s) of the parent minus that of the child.
    step_s, window_s : float
        Distance between the starts of windows, and length of a window.
    """
    lags, coefficients, overlaps, ratios = _masked_correlation(of_parent, of_child)
    durations = overlaps * step_s
    shorter_s = min(len(of_parent), len(of_child)) * step_s
    is_possible = durations >= max(_MIN_OVERLAP_SHARE * shorter_s, _MIN_OVERLAP_S)
    # Fisher's z of n samples has the standard deviation 1 / sqrt(n - 3). There is about one
    # independent sample per second.
    fisher_z = np.arctanh(np.clip(coefficients, -1 + 1e-9, 1 - 1e-9))
    significance = fisher_z * np.sqrt(np.maximum(durations - 3, 0))
    significance[~is_possible] = -np.inf
    best = int(np.argmax(significance))
    lags_s = np.multiply(lags, step_s, dtype=float)
    peak_width_s = max(_PEAK_WIDTH_S, _PEAK_WIDTH_WINDOWS * window_s)
    rivals = significance[np.abs(lags_s - lags_s[best]) > peak_width_s]
    # Vertex of the parabola through the best lag and its neighbours, in steps from the best lag.
    below, top, above = coefficients[np.arange(best - 1, best + 2) % len(coefficients)]
    curvature = below - 2 * top + above
    vertex = 0.0
    if curvature < 0:
        vertex = np.clip(0.5 * (below - above) / curvature, -0.5, 0.5)
    return Correlation(
        offset_s=float(start_s + (lags[best] + vertex) * step_s),
        correlation=float(top),
        distinctness=float(significance[best] / max(rivals.max(initial=-np.inf), 1.0)),
        variation=min(float(np.nanstd(rates)) for rates in (of_parent, of_child)),
        ratio=float(ratios[best]),
    )


def angular_rates(
    trajectory: Trajectory, window_s: float, step_s: float, max_gap_s: float, of_speed: bool = False
) -> FloatArray:
    """Return the mean angular rates (M,) in rad/s, or the speeds in m/s, of M windows.

    Windows of ``window_s`` seconds start every ``step_s`` seconds. The rates of windows that
    overlap a gap longer than ``max_gap_s`` are NaN.
    """
    stamps_ns = trajectory.stamps_ns
    n_windows = max(int((trajectory.duration_s - window_s) / step_s), 0)
    starts_ns = stamps_ns[0] + np.round(np.arange(n_windows) * step_s * 1e9).astype(np.int64)
    ends_ns = starts_ns + round(window_s * 1e9)
    before, after = np.split(trajectory.at(np.concatenate([starts_ns, ends_ns])), 2)
    if of_speed:
        moved = np.linalg.norm(se3.translation_of(after) - se3.translation_of(before), axis=1)
    else:
        moved = se3.rotation_angle(
            np.swapaxes(se3.rotation_of(before), 1, 2) @ se3.rotation_of(after)
        )
    rates = moved / window_s
    # Number of long gaps before each pose. A window overlaps a gap if it differs at both ends.
    gaps_before = np.r_[0, np.cumsum(np.diff(stamps_ns) > (max_gap_s + window_s) * 1e9)]
    first = np.searchsorted(stamps_ns, starts_ns, side="right") - 1
    last = np.minimum(np.searchsorted(stamps_ns, ends_ns), len(stamps_ns) - 1)
    rates[gaps_before[last] > gaps_before[first]] = np.nan
    return rates


def _masked_correlation(
    first: FloatArray, second: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Correlate rates (M,) and (N,) at all lags: ``first[i + lag]`` with ``second[i]``.

    NaNs are left out: D. Padfield, *Masked object registration in the Fourier domain*, IEEE
    Transactions on Image Processing 21(5), 2012. The correlation is that of the square roots of the
    rates, so that few large rates do not dominate.

    Returns
    -------
    lags : (L,) int array
    coefficients : (L,) array
        Correlation coefficients; 0 if a stream does not vary.
    counts : (L,) array
        Numbers of common samples.
    ratios : (L,) array
        Ratios of the second rates to the first.
    """
    size = 1 << (len(first) + len(second) - 1).bit_length()
    spectra = []
    for rates in (first, second):
        mask = np.isfinite(rates)
        roots = np.sqrt(rates)
        roots = np.minimum(roots, quantile(roots[mask], 1 - _CLIPPED_SHARE))
        filled = np.where(mask, roots - np.nanmean(roots), 0.0)
        spectra.append(np.fft.rfft([mask.astype(float), filled, filled**2], size))
    # Sums over the common samples at each lag are inverse transforms of products of spectra.
    one_a, a, aa = spectra[0]
    one_b, b, bb = np.conj(spectra[1])
    count = np.round(np.fft.irfft(one_a * one_b, size))
    divisor = np.maximum(count, 1.0)
    sum_a = np.fft.irfft(a * one_b, size)
    sum_b = np.fft.irfft(one_a * b, size)
    covariance = np.fft.irfft(a * b, size) - sum_a * sum_b / divisor
    square_a = np.fft.irfft(aa * one_b, size)
    square_b = np.fft.irfft(one_a * bb, size)
    variance_a = square_a - sum_a**2 / divisor
    variance_b = square_b - sum_b**2 / divisor
    has_variance = variance_a > 1e-9 * square_a.max(initial=0.0)
    has_variance &= variance_b > 1e-9 * square_b.max(initial=0.0)
    scale = np.sqrt(np.where(has_variance, variance_a * variance_b, 1.0))
    ratios = np.where(has_variance, variance_b, 1.0) / np.where(has_variance, variance_a, 1.0)
    lags = np.arange(size)
    lags = np.where(lags < len(first), lags, lags - size)
    return lags, np.where(has_variance, covariance / scale, 0.0), count, ratios


@dataclass(frozen=True)
class TimeOffset:
    """Estimate of a clock offset. The defaults mean that there is no estimate.

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
        Largest difference between the offsets from motions of different durations; infinite unless
        there is a fit for each duration.
    rate : ClockRate or None
        Change of the offset with time; None if no fit explains the motion, or if the recording is
        too short.
    """

    seconds: float = 0.0
    sigma_s: float = np.inf
    correlation: Correlation = Correlation()
    fit: SimilarityFit | None = None
    spread_s: float = np.inf
    rate: ClockRate | None = None

    def steadied(self, child: Trajectory) -> Trajectory:
        """Return the child with stamps corrected for the clock rate, if a rate was estimated."""
        return child.shifted(0.0, self.rate.used, self.rate.at_ns) if self.rate else child

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

    The coarse offset comes from the angular rates. The fine offset comes from a fit together with X
    and the scale.

    Parameters
    ----------
    parent, child : Trajectory
        Streams; their stamps need not overlap.
    max_gap_s : float
        Longest interval (s) between two poses in which poses are interpolated.
    of_speed : bool
        Estimate only the coarse offset, from speeds, because a sensor has no orientation.

    Returns
    -------
    TimeOffset

    Raises
    ------
    NotEnoughDataError
        If the coarse offset cannot be trusted; the message contains the reason.
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
    parent: Trajectory, child: Trajectory, at: TimeOffset, max_gap_s: float, least_s: float = 0.0
) -> TimeOffset:
    """Refine a clock offset by fits to motions of several durations.

    Parameters
    ----------
    parent, child : Trajectory
    at : TimeOffset
        Initial value. Its correlation contains the coarse offset.
    max_gap_s : float
        Longest interval (s) between two poses in which poses are interpolated.
    least_s : float
        Smallest offset (s) that matters to the caller: the first fit with a smaller offset is the
        last fit.

    Returns
    -------
    TimeOffset
        The refined offset. The coarse offset, with a large standard deviation, if no fit explains
        the motion.
    """
    reach_s = max(_FINE_RANGE_S, _FINE_RANGE_INTERVALS * max(parent.interval_s, child.interval_s))
    coarse_s = at.correlation.offset_s
    best = TimeOffset(coarse_s, reach_s / 5, at.correlation)
    offsets_s = list[float]()
    for lag_s in _LAGS_S:
        offset = offset_over(lag_s, parent, child, at, max_gap_s, least_s)
        at = replace(at, fit=offset.fit)
        explains = offset.fit and offset.fit.explains_translation
        if not explains or abs(offset.seconds - coarse_s) > reach_s:
            continue
        offsets_s.append(offset.seconds)
        if offset.sigma_s < best.sigma_s:
            best = offset
        if offset.largest_s(child.duration_s) < least_s:
            break
    if len(offsets_s) < len(_LAGS_S):
        return best
    # Errors that are correlated for longer than a block of the jackknife make these offsets differ.
    sigma_s = float(np.hypot(best.sigma_s, np.std(offsets_s, ddof=1)))
    return replace(best, spread_s=np.ptp(offsets_s), sigma_s=sigma_s)


def offset_over(
    lag_s: float,
    parent: Trajectory,
    child: Trajectory,
    at: TimeOffset,
    max_gap_s: float,
    least_s: float,
    start: SimilarityFit | FloatArray | None = None,
    most: float | None = None,
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
    least_s : float
        Smallest offset (s) that matters to the caller. The iteration ends early if the offset is
        clearly smaller; otherwise it continues until the offset is accurate to a twentieth of it.
    start : SimilarityFit or (4, 4) array, optional
        Initial fit or X, if ``at`` has no fit.
    most : float, optional
        A start that leaves more than this share of the motion unexplained is not refined.

    Returns
    -------
    TimeOffset
        The offset; without a fit if there are too few motions.
    """
    span_s = max(_MIN_SPAN_S, _SPAN_INTERVALS * child.interval_s)
    middle_ns = int(child.stamps_ns[0] + (child.stamps_ns[-1] - child.stamps_ns[0]) // 2)
    offset_s = at.seconds
    start = at.fit or start
    settled_s = max(_SETTLED_S, least_s / 20)
    rate = at.rate or ClockRate(ppm=0.0, sigma_ppm=np.inf, at_ns=middle_ns)
    for _ in range(_MAX_ROUNDS):
        max_pairs = _MAX_PAIRS_OF_RATE if rate.is_used else MAX_PAIRS
        shifted = child.shifted(offset_s, rate.used, rate.at_ns)
        pose_pairs = synchronise(parent, shifted, max_gap_s)
        pairs = pairs_over(pose_pairs, lag_s, max_pairs)
        if len(pairs) < MIN_PAIRS:
            return TimeOffset(offset_s, np.inf, at.correlation)
        # Velocities at the starts of all motions, then at their ends. Motions share poses.
        poses, index_of_pose = np.unique(np.r_[pairs.i, pairs.j], return_inverse=True)
        twists = _twists(shifted, pose_pairs.stamps_ns[poses], span_s)[index_of_pose]
        fit = _fit_of(pairs, (twists[: len(pairs)], twists[len(pairs) :]), start, most)
        start = fit
        rms_rate = float(np.sqrt(np.mean((twists[:, 3:] ** 2).sum(axis=1))))
        span_of_noise_s = _SPAN_OF_NOISE * fit.sigma_rotation / max(rms_rate, 1e-9)
        span_s = max(span_s, min(span_of_noise_s, _MAX_SPAN_S))
        offset_s = float(offset_s + fit.offset_s)
        is_small = abs(offset_s) + abs(fit.offset_s) < least_s / 2
        if abs(fit.offset_s) < settled_s or is_small:
            before = rate
            rate = _rate(fit, pose_pairs.stamps_ns[pairs.i], before)
            is_settled = abs(rate.used - before.used) * child.duration_s < settled_s
            if is_settled and (max_pairs > MAX_PAIRS or not rate.is_used):
                break
    estimated_rate = rate if np.isfinite(rate.sigma_ppm) else None
    return TimeOffset(offset_s, fit.offset_sigma_s, at.correlation, fit, rate=estimated_rate)


def _fit_of(
    pairs: MotionPairs,
    twists: tuple[FloatArray, FloatArray],
    start: SimilarityFit | FloatArray | None,
    most: float | None,
) -> SimilarityFit:
    """Fit X, scale and offset; only X and offset if the scale makes the fit fail.

    ``most`` is that of :func:`offset_over`. If it is given, there is only one attempt.
    """
    fit = fit_similarity(pairs, twists, start=start, most=most)
    if fit.explains_translation or most is not None:
        return fit
    # The motion does not determine the scale if the body rotates about one of its sensors.
    in_one_unit = fit_similarity(pairs, twists, same_unit=True)
    return in_one_unit if in_one_unit.explains_translation else fit


def _twists(trajectory: Trajectory, stamps_ns: IntArray, span_s: float) -> FloatArray:
    """Return velocities (N, 6), m/s and rad/s, of a sensor in its own frame at stamps (N,).

    A velocity is the mean from ``span_s`` seconds before to ``span_s`` seconds after a stamp; less
    at the ends of the trajectory.
    """
    span_ns = round(span_s * 1e9)
    ends_ns = np.add.outer([-span_ns, span_ns], stamps_ns).clip(*trajectory.stamps_ns[[0, -1]])
    before, after = np.split(trajectory.at(ends_ns.ravel()), 2)
    steps = se3.log(se3.inverse(before) @ after)
    spans_s = np.diff(ends_ns, axis=0)[0] * 1e-9
    return np.asarray(steps / spans_s[:, None])


def _rate(fit: SimilarityFit, stamps_ns: IntArray, before: ClockRate) -> ClockRate:
    """Estimate the clock rate from the offsets of a fit in blocks of time.

    The slope of a line through these offsets is a correction of ``before``. The variance of the
    slope is that of Student's t distribution, because there are few blocks. The result is the mean
    of the posterior with the prior _RATE_PRIOR.

    Parameters
    ----------
    fit : SimilarityFit
    stamps_ns : (K,) int64 array
        Stamps of the motion pairs, on the parent's clock.
    before : ClockRate
        Rate that the child's stamps were corrected for in the fit.

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
    # The variance of Student's t is that of the residuals over 2 degrees of freedom less: n - 4.
    variance = float(weights @ residuals_s**2) / (len(offsets_s) - 4) / spread / fit.held**2
    total = (before.used + slope) * _RATE_PRIOR**2 / (_RATE_PRIOR**2 + variance)
    sigma = float(np.sqrt(variance))
    is_used = abs(total) > _MIN_RATE_SIGMAS * sigma
    return replace(before, ppm=1e6 * total, sigma_ppm=1e6 * sigma, is_used=is_used)
