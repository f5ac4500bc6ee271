"""Offset and rate of the child's clock.

The offset is the seconds to add to the child's stamps to get the parent's clock. The rate is the
change of the offset per second.

Model: two sensors on one rigid body rotate through the same angle in the same time, however they
are mounted. The coarse offset is that with the best correlation of their angular rates. It needs no
extrinsic, no common world, no common scale and no particular quaternion order: reordered or
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

# Length of a window in which an angle is measured, in sampling steps: noise of single poses must
# not exceed the motion.
_WINDOW_STEPS = 3

# Smallest length of a window (s).
_MIN_WINDOW_S = 0.2

# Bounds of the sampling step (s).
_MIN_STEP_S = 0.02
_MAX_STEP_S = 1.0

# Largest number of sampling steps.
_MAX_SAMPLES = 200_000

# Share of the windows whose angular rates are clipped: jumps of a stream are not motion.
_CLIPPED_SHARE = 0.03

# Smallest overlap at an offset: share of the shorter stream, and duration (s).
_MIN_OVERLAP_SHARE = 0.25
_MIN_OVERLAP_S = 5.0

# Smallest distance of a rival from the best offset, in seconds and in windows: close to the peak,
# the correlation is always high.
_PEAK_WIDTH_S = 2.0
_PEAK_WIDTH_WINDOWS = 5.0

# Smallest ratio of the significance of the best offset to that of its best rival. In sixteen real
# recordings the ratio was 5 to 12 for streams of one body, and at most 1.3 for unrelated streams.
_DISTINCT = 2.0

# Smallest correlation coefficient that counts.
_CORRELATED = 0.5

# Shortest repetition of a pose (s) that may come from a frozen stream.
_REPEATS_S = 1.0

# Smallest standard deviation of an angular rate (rad/s) for a correlation.
MIN_VARIATION = 0.01

# Durations (s) of the motions of the fits. The fit with the smallest standard deviation is used;
# short motions determine the offset best.
_LAGS_S = (1.0, 0.3, 3.0)

# Largest number of motions of a fit with a clock rate.
_PAIRS_OF_RATE = 5 * MAX_PAIRS

# Half of the span of time over which the child's velocity at a stamp is measured. The span must not
# contain poses of the motion, and noise must be a small share of the velocity: otherwise the offset
# is biased and its standard deviation is too small. Bounds in seconds.
_MIN_SPAN_S = 0.05
_MAX_SPAN_S = 0.3

# Smallest half span, in intervals of the child's stream.
_SPAN_INTERVALS = 2.0

# Smallest half span, in standard deviations of rotations over the angular rate.
_SPAN_OF_NOISE = 1.4

# Largest number of linearisations of a fit.
_MAX_ROUNDS = 8

# Change of the offset (s) that ends the linearisations.
_SETTLED_S = 2e-5

# Prior standard deviation of a clock rate (75 ppm are usual for USB devices).
_RATE_PRIOR = 1e-4

# Smallest clock rate that is used, in standard deviations.
_CLEAR_RATE = 4.0

# Largest difference between fine and coarse offset, in seconds and in intervals of the slower
# stream; the longer of both counts.
_FINE_RANGE_S = 0.25
_FINE_RANGE_INTERVALS = 2.0


@dataclass(frozen=True)
class Correlation:
    """Best correlation of the angular rates of two streams over all clock offsets.

    The defaults mean no evidence of any offset.

    Attributes
    ----------
    offset_s : float
        Seconds to add to the child's stamps, accurate to about a tenth of a sampling step.
    correlation : float
        Correlation coefficient of the angular rates at that offset.
    distinctness : float
        Ratio of the significance of that offset to that of its best rival.
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
        """Whether the evidence suffices to trust the offset."""
        return not self.doubt()

    def doubt(self, quantity: str = "angular rates") -> str:
        """Return what is wrong with the evidence of an offset; empty if nothing is.

        ``quantity`` names what was correlated.
        """
        if self.variation < MIN_VARIATION:
            return "the streams hardly rotate, or rotate at a constant rate"
        if self.correlation < _CORRELATED:
            return (
                f"their {quantity} are correlated by {self.correlation:.2f} at best "
                f"({_CORRELATED} is needed)"
            )
        if self.distinctness < _DISTINCT:
            return (
                f"the best offset is only {self.distinctness:.1f} times better than the next "
                f"({_DISTINCT:g} is needed)"
            )
        return ""


def correlate_rates(
    parent: Trajectory,
    child: Trajectory,
    max_gap_s: float = CalibratorConfig.max_gap,
    of_speed: bool = False,
) -> Correlation:
    """Find the clock offset with the best correlation of the angular rates of two streams.

    The time ranges of the streams need not overlap. A stream that is too short gives no evidence.

    Parameters
    ----------
    parent, child : Trajectory
    max_gap_s : float
        Windows that touch a longer gap between poses are left out.
    of_speed : bool
        Correlate speeds instead, for a sensor without orientation.
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
    # Poses that a frozen stream repeats may hide the offset.
    _leave_out_repetitions(parent, parent_rates, step_s, window_s)
    _leave_out_repetitions(child, child_rates, step_s, window_s)
    if _shorter_s(parent_rates, child_rates, step_s) < _MIN_OVERLAP_S:
        return best
    without = _best_correlation(parent_rates, child_rates, start_s, step_s, window_s)
    return without if without.is_clear else best


def _shorter_s(parent_rates: FloatArray, child_rates: FloatArray, step_s: float) -> float:
    """Return the duration (s) of the finite rates of the stream that has fewer."""
    return min(np.isfinite(parent_rates).sum(), np.isfinite(child_rates).sum()) * step_s


def _leave_out_repetitions(
    stream: Trajectory, rates: FloatArray, step_s: float, window_s: float
) -> None:
    """Set the rates (M,) of windows to NaN in which a stream repeats its pose for a second."""
    start_ns = int(stream.stamps_ns[0])
    for from_ns, until_ns in repetitions(stream, _REPEATS_S):
        first = max(int(((from_ns - start_ns) * 1e-9 - window_s) / step_s) + 1, 0)
        last = int((until_ns - start_ns) * 1e-9 / step_s) + 1
        rates[first : last + 1] = np.nan


def _best_correlation(
    of_parent: FloatArray, of_child: FloatArray, start_s: float, step_s: float, window_s: float
) -> Correlation:
    """Return the best correlation of rates (M,) and (N,) over all lags.

    ``start_s`` is the parent's first stamp less the child's.
    """
    lags, coefficients, overlaps, ratios = _masked_correlation(of_parent, of_child)
    durations = overlaps * step_s
    shorter_s = min(len(of_parent), len(of_child)) * step_s
    enough = durations >= max(_MIN_OVERLAP_SHARE * shorter_s, _MIN_OVERLAP_S)
    # About one independent sample a second; three degrees of freedom go into the coefficient.
    fisher_z = np.arctanh(np.clip(coefficients, -1 + 1e-9, 1 - 1e-9))
    significance = np.where(enough, fisher_z * np.sqrt(np.maximum(durations - 3, 0)), -np.inf)
    best = int(np.argmax(significance))
    lags_s = np.multiply(lags, step_s, dtype=float)
    apart_s = max(_PEAK_WIDTH_S, _PEAK_WIDTH_WINDOWS * window_s)
    rivals = significance[np.abs(lags_s - lags_s[best]) > apart_s]
    # The vertex of the parabola through the best lag and its neighbours.
    below, top, above = coefficients[np.arange(best - 1, best + 2) % len(coefficients)]
    curvature = below - 2 * top + above
    beside = 0.0 if curvature >= 0 else np.clip(0.5 * (below - above) / curvature, -0.5, 0.5)
    return Correlation(
        offset_s=float(start_s + (lags[best] + beside) * step_s),
        correlation=float(top),
        distinctness=float(significance[best] / max(rivals.max(initial=-np.inf), 1.0)),
        variation=min(float(np.nanstd(rates)) for rates in (of_parent, of_child)),
        ratio=float(ratios[best]),
    )


def angular_rates(
    trajectory: Trajectory, window_s: float, step_s: float, max_gap_s: float, of_speed: bool = False
) -> FloatArray:
    """Return angular rates (M,) in rad/s, or speeds in m/s, of windows of a trajectory.

    Windows of ``window_s`` seconds start every ``step_s`` seconds. Windows that touch a gap of more
    than ``max_gap_s`` are NaN.
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
    Transactions on Image Processing 21(5), 2012.

    Returns
    -------
    lags : (L,) int array
    coefficients : (L,) array
        Correlation coefficients.
    counts : (L,) array
        Numbers of common samples.
    ratios : (L,) array
        Ratios of the second rates to the first.
    """
    size = 1 << (len(first) + len(second) - 1).bit_length()
    spectra = []
    for rates in (first, second):
        # Jumps are clipped and large values compressed.
        mask = np.isfinite(rates)
        roots = np.sqrt(rates)
        roots = np.minimum(roots, quantile(roots[mask], 1 - _CLIPPED_SHARE))
        filled = np.where(mask, roots - np.nanmean(roots), 0.0)
        spectra += [np.fft.rfft(part, size) for part in (mask.astype(float), filled, filled**2)]
    one_a, a, aa = spectra[:3]
    one_b, b, bb = np.conj(spectra[3:])
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
    """An estimated clock offset. The defaults mean no information.

    Attributes
    ----------
    seconds : float
        Seconds to add to the child's stamps.
    sigma_s : float
        Standard deviation.
    correlation : Correlation
        Correlation of the angular rates, with the coarse offset.
    fit : SimilarityFit or None
        Fit with the fine offset; None if no fit explains the motion.
    spread_s : float
        Largest difference between the offsets from motions over different times; infinite unless
        there is a fit for each time.
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
        """Return the child without the clock rate in its stamps; unchanged without a rate."""
        return child.shifted(0.0, self.rate.used, self.rate.at_ns) if self.rate else child

    def largest_s(self, duration_s: float) -> float:
        """Return a bound (s) of the offset over a recording: its size plus half the drift."""
        changed_s = 0.5 * self.rate.used * duration_s if self.rate else 0.0
        return abs(self.seconds) + abs(changed_s)


def estimate_time_offset(
    parent: Trajectory,
    child: Trajectory,
    max_gap_s: float = CalibratorConfig.max_gap,
    of_speed: bool = False,
) -> TimeOffset:
    """Estimate the offset of the child's clock.

    The coarse offset comes from the angular rates, the fine one from a fit with X and the scale.

    Parameters
    ----------
    parent, child : Trajectory
        Their time ranges need not overlap.
    max_gap_s : float
        Longest gap between two poses that is interpolated across, s.
    of_speed : bool
        Estimate only the coarse offset, from speeds: a sensor has no orientation.

    Raises
    ------
    NotEnoughDataError
        If the evidence is weak; the message has the reason.
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
    """Refine a clock offset by fits of motions over several times.

    Parameters
    ----------
    parent, child : Trajectory
    at : TimeOffset
        Offset to start at, with the coarse offset in its correlation.
    max_gap_s : float
        Longest gap between two poses that is interpolated across, s.
    least_s : float
        Stop after the first fit whose offset is smaller than this.

    Returns
    -------
    TimeOffset
        The coarse offset, with a wide standard deviation, if no fit explains the motion.
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
    # Errors that last longer than the blocks of the jackknife make these offsets differ.
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
    """Estimate the offset from motions over one time.

    Parameters
    ----------
    lag_s : float
        Duration of the motions, s.
    parent, child : Trajectory
    at : TimeOffset
        Offset, fit and rate to start at.
    max_gap_s : float
        Longest gap between two poses that is interpolated across, s.
    least_s : float
        Stop early if the offset is clearly smaller than this; otherwise refine to a twentieth of
        this.
    start : SimilarityFit or (4, 4) array, optional
        Fit or X to start at, if ``at`` has no fit.
    most : float, optional
        Do not refine a fit whose start leaves more than this share of the motion unexplained.

    Returns
    -------
    TimeOffset
        Without a fit if there are too few motions.
    """
    span_s = max(_MIN_SPAN_S, _SPAN_INTERVALS * child.interval_s)
    middle_ns = int(child.stamps_ns[0] + (child.stamps_ns[-1] - child.stamps_ns[0]) // 2)
    offset_s = at.seconds
    start = at.fit or start
    settled_s = max(_SETTLED_S, least_s / 20)
    rate = at.rate or ClockRate(ppm=0.0, sigma_ppm=np.inf, at_ns=middle_ns)
    for _ in range(_MAX_ROUNDS):
        most_pairs = _PAIRS_OF_RATE if rate.is_used else MAX_PAIRS
        shifted = child.shifted(offset_s, rate.used, rate.at_ns)
        pose_pairs = synchronise(parent, shifted, max_gap_s)
        pairs = pairs_over(pose_pairs, lag_s, most_pairs)
        if len(pairs) < MIN_PAIRS:
            return TimeOffset(offset_s, np.inf, at.correlation)
        ends, index_of_end = np.unique(np.r_[pairs.i, pairs.j], return_inverse=True)
        twists = _twists(shifted, pose_pairs.stamps_ns[ends], span_s)[index_of_end]
        of_pairs = twists[: len(pairs)], twists[len(pairs) :]
        fit = start = _fit_of(pairs, of_pairs, start, most)
        speed = float(np.sqrt(np.mean((twists[:, 3:] ** 2).sum(axis=1))))
        of_noise_s = _SPAN_OF_NOISE * fit.sigma_rotation / max(speed, 1e-9)
        span_s = max(span_s, min(of_noise_s, _MAX_SPAN_S))
        offset_s = float(offset_s + fit.offset_s)
        is_small = abs(offset_s) + abs(fit.offset_s) < least_s / 2
        if abs(fit.offset_s) < settled_s or is_small:
            before = rate
            rate = _rate(fit, pose_pairs.stamps_ns[pairs.i], before)
            is_settled = abs(rate.used - before.used) * child.duration_s < settled_s
            if is_settled and (most_pairs > MAX_PAIRS or not rate.is_used):
                break
    estimated_rate = rate if np.isfinite(rate.sigma_ppm) else None
    return TimeOffset(offset_s, fit.offset_sigma_s, at.correlation, fit, rate=estimated_rate)


def _fit_of(
    pairs: MotionPairs,
    twists: tuple[FloatArray, FloatArray],
    start: SimilarityFit | FloatArray | None,
    most: float | None,
) -> SimilarityFit:
    """Fit X, scale and offset; or X and offset, if the scale makes the fit fail."""
    fit = fit_similarity(pairs, twists, start=start, most=most)
    if fit.explains_translation or most is not None:
        return fit
    # The motion does not determine the scale if the body rotates about one of its sensors.
    in_one_unit = fit_similarity(pairs, twists, same_unit=True)
    return in_one_unit if in_one_unit.explains_translation else fit


def _twists(trajectory: Trajectory, stamps_ns: IntArray, span_s: float) -> FloatArray:
    """Return velocities (N, 6), m/s and rad/s, of a sensor in its own frame at stamps (N,).

    The velocities are means over ``span_s`` before and after each stamp, or less at the ends of the
    trajectory.
    """
    span_ns = round(span_s * 1e9)
    ends_ns = np.add.outer([-span_ns, span_ns], stamps_ns).clip(*trajectory.stamps_ns[[0, -1]])
    before, after = np.split(trajectory.at(ends_ns.ravel()), 2)
    steps = se3.log(se3.inverse(before) @ after)
    spans_s = np.diff(ends_ns, axis=0)[0] * 1e-9
    return np.asarray(steps / spans_s[:, None])


def _rate(fit: SimilarityFit, stamps_ns: IntArray, before: ClockRate) -> ClockRate:
    """Estimate the clock rate from the offsets of a fit in blocks of time.

    The slope of a line through these offsets is added to the rate before. Its variance is that of
    Student's t distribution, because the blocks are few.

    Parameters
    ----------
    fit : SimilarityFit
    stamps_ns : (K,) int64 array
        Stamps of the motion pairs, on the parent's clock.
    before : ClockRate
        Rate that the child's stamps are corrected for in the fit.
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
    variance = float(weights @ residuals_s**2) / (len(offsets_s) - 4) / spread / fit.held**2
    total = (before.used + slope) * _RATE_PRIOR**2 / (_RATE_PRIOR**2 + variance)
    sigma = float(np.sqrt(variance))
    is_used = abs(total) > _CLEAR_RATE * sigma
    return replace(before, ppm=1e6 * total, sigma_ppm=1e6 * sigma, is_used=is_used)
