"""The clock offset: seconds to add to the child's stamps to get the parent's clock, and by how much
that changes from second to second.

Two sensors on one rigid body rotate through the same angle in the same time, however they are
mounted. So the offset at which their angular rates agree best is that of the clocks, coarsely. This
needs no extrinsic, no common world, no common scale and no particular quaternion order: reordered
or inverted quaternions have the same angles. Then it is refined together with X.
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
from hand_eye_calib.core.pairing.motion_pairs import MAX_PAIRS, find_leap, pairs_over, synchronise
from hand_eye_calib.core.results.records import ClockRate

# Angles are taken over windows of this many sampling steps, and at least so long, so that the noise
# of single poses does not hide the motion. Sampling steps are within bounds, and at most so many.
_WINDOW_STEPS = 3
_MIN_WINDOW_S = 0.2
_MIN_STEP_S = 0.02
_MAX_STEP_S = 1.0
_MAX_SAMPLES = 200_000

# Angular rates above those of all but this share of the windows are clipped: jumps of a stream are
# not motion.
_CLIPPED_SHARE = 0.03

# Offsets are considered if at least this share of the shorter stream, and this long, overlaps.
_MIN_OVERLAP_SHARE = 0.25
_MIN_OVERLAP_S = 5.0

# Another offset is a rival only beyond this distance: close to the peak the correlation is high
# anyway.
_PEAK_WIDTH_S = 2.0
_PEAK_WIDTH_WINDOWS = 5.0

# Streams of one body are 5 to 12 times better correlated at their offset than at any other,
# unrelated streams at most 1.3 times (measured on sixteen real recordings).
_DISTINCT = 2.0
_CORRELATED = 0.5

# Poses that are repeated for so long (s) may be those of a stream that froze.
_REPEATS_S = 1.0

# Smallest standard deviation of the angular rate (rad/s) that can be correlated.
MIN_VARIATION = 0.01

# Motions over these times (s) are compared; the lag with the smallest standard deviation wins.
# Short motions show the offset best. Most motions that are compared if there is a rate to be
# measured.
_LAGS_S = (1.0, 0.3, 3.0)
_PAIRS_OF_RATE = 5 * MAX_PAIRS

# Time on either side of a stamp (s) over which the child's velocity is taken: at least; at most; in
# intervals of the child's stream, so that no pose is in the velocity and in the motion; and in
# standard deviations of rotations by the angular rate, so that noise is little of the velocity.
# Noise in both, or much of it, draws the offset, and its standard deviation is too small.
_LEAST_SPAN_S = 0.05
_MOST_SPAN_S = 0.3
_SPAN_INTERVALS = 2.0
_SPAN_OF_NOISE = 1.4

_MAX_ROUNDS = 8
_SETTLED_S = 2e-5

# A rate of the clock is known to this beforehand (75 ppm are usual for USB devices); one beyond so
# many standard deviations is there.
_RATE_PRIOR = 1e-4
_PLAIN_RATE = 4.0

# Most that the fine offset may differ from the coarse one: seconds, or intervals of the slower
# stream if those are longer.
_FINE_RANGE_S = 0.25
_FINE_RANGE_INTERVALS = 2.0


@dataclass(frozen=True)
class Correlation:
    """Best correlation of the angular rates of two streams, over all clock offsets; by default no
    evidence of any.

    Attributes
    ----------
    offset_s : float
        Seconds to add to the child's stamps; accurate to about a tenth of a sampling step.
    correlation : float
        Correlation coefficient of the angular rates at that offset.
    distinctness : float
        Ratio of its significance to that of the best rival.
    variation : float
        Standard deviation of the angular rate, of the stream that varies less, rad/s.
    ratio : float
        Of the child's angular rates to the parent's.
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
        """What is wrong with the evidence, in words; empty if nothing is. ``quantity`` is what was
        correlated.
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
    """Find the clock offset at which the angular rates of two streams agree best, or their speeds,
    for sensors without an orientation; there is no evidence if a stream is too short.

    Windows that touch a gap between poses longer than ``max_gap_s`` are left out. The time ranges
    of both need not overlap.
    """
    if min(len(parent), len(child)) < 4:
        return Correlation()
    step_s = float(np.clip(max(parent.interval_s, child.interval_s), _MIN_STEP_S, _MAX_STEP_S))
    step_s = max(step_s, max(parent.duration_s, child.duration_s) / _MAX_SAMPLES)
    window_s = max(_WINDOW_STEPS * step_s, _MIN_WINDOW_S)
    of_parent, of_child = (
        angular_rates(each, window_s, step_s, max_gap_s, of_speed) for each in (parent, child)
    )
    if min(np.isfinite(each).sum() for each in (of_parent, of_child)) * step_s < _MIN_OVERLAP_S:
        return Correlation()
    start_s = float(parent.stamps_ns[0] - child.stamps_ns[0]) * 1e-9
    best = _best_correlation(of_parent, of_child, start_s, step_s, window_s)
    if best.is_clear:
        return best
    # A stream that froze for a while hides the offset.
    for stream, rates in ((parent, of_parent), (child, of_child)):
        _leave_out_repetitions(stream, rates, step_s, window_s)
    if min(np.isfinite(rates).sum() for rates in (of_parent, of_child)) * step_s < _MIN_OVERLAP_S:
        return best
    without = _best_correlation(of_parent, of_child, start_s, step_s, window_s)
    return without if without.is_clear else best


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
    """Return the best correlation of rates (M,), (N,) over all lags; ``start_s`` is the parent's
    first stamp less the child's.
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
    """Angular rates (M,), rad/s, or speeds, m/s, over windows of ``window_s`` seconds that start
    every ``step_s`` seconds; NaN for windows that touch a gap.
    """
    stamps_ns = trajectory.stamps_ns
    n_windows = max(int((trajectory.duration_s - window_s) / step_s), 0)
    starts_ns = stamps_ns[0] + np.round(np.arange(n_windows) * step_s * 1e9).astype(np.int64)
    ends_ns = starts_ns + round(window_s * 1e9)
    before, after = np.split(trajectory.at(np.concatenate([starts_ns, ends_ns])), 2)
    if of_speed:
        moved = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    else:
        moved = se3.rotation_angle(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])
    rates = moved / window_s
    gaps_before = np.r_[0, np.cumsum(np.diff(stamps_ns) > (max_gap_s + window_s) * 1e9)]
    first = np.searchsorted(stamps_ns, starts_ns, side="right") - 1
    last = np.minimum(np.searchsorted(stamps_ns, ends_ns), len(stamps_ns) - 1)
    rates[gaps_before[last] > gaps_before[first]] = np.nan
    return rates


def _masked_correlation(
    first: FloatArray, second: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Lags, correlation coefficients, counts of common samples, and how many times the second is as
    large, of rates: first[i + lag] against second[i], NaNs left out.
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
    varied = variance_a > 1e-9 * square_a.max(initial=0.0)
    varied &= variance_b > 1e-9 * square_b.max(initial=0.0)
    scale = np.sqrt(np.where(varied, variance_a * variance_b, 1.0))
    ratios = np.where(varied, variance_b, 1.0) / np.where(varied, variance_a, 1.0)
    lags = np.arange(size)
    lags = np.where(lags < len(first), lags, lags - size)
    return lags, np.where(varied, covariance / scale, 0.0), count, ratios


@dataclass(frozen=True)
class TimeOffset:
    """An estimated clock offset; by default nothing is known of one.

    Attributes
    ----------
    seconds : float
        Seconds to add to the child's stamps.
    sigma_s : float
        Standard deviation.
    correlation : Correlation
        Correlation of the angular rates that gave the coarse offset.
    fit : SimilarityFit or None
        The fit that gave the fine offset; None if no fit held.
    spread_s : float
        Largest difference between the offsets from motions over different times; infinite unless
        there is a fit over each.
    rate : ClockRate or None
        By how much the offset changes with time; None if no fit held, or it was too short.
    """

    seconds: float = 0.0
    sigma_s: float = np.inf
    correlation: Correlation = Correlation()
    fit: SimilarityFit | None = None
    spread_s: float = np.inf
    rate: ClockRate | None = None

    def steadied(self, child: Trajectory) -> Trajectory:
        """The child's poses at a constant offset: with stamps freed of a rate that is used."""
        return child.shifted(0.0, self.rate.used, self.rate.at_ns) if self.rate else child

    def largest_s(self, duration_s: float) -> float:
        """Largest size of the offset in a recording, with a rate that is used."""
        changed_s = 0.5 * self.rate.used * duration_s if self.rate else 0.0
        return abs(self.seconds) + abs(changed_s)


def estimate_time_offset(
    parent: Trajectory,
    child: Trajectory,
    max_gap_s: float = CalibratorConfig.max_gap,
    of_speed: bool = False,
) -> TimeOffset:
    """Estimate the offset of the child's clock: coarse from the angular rates, then fine together
    with X and the scale.

    Parameters
    ----------
    parent, child : Trajectory
        Their time ranges need not overlap.
    max_gap_s : float
        Longest time between two poses that interpolation may bridge, in seconds.
    of_speed : bool
        From the speeds of both sensors alone, coarsely: one of them has no orientation.

    Raises
    ------
    NotEnoughDataError
        If the evidence is weak; the message says why.
    InputError
        If a stream's stamps leap by days.
    """
    for name, stream in (("parent", parent), ("child", child)):
        if leap := find_leap(stream.stamps_ns):
            raise InputError(f"the {name} stream's {'; '.join(leap)}")
    correlation = correlate_rates(parent, child, max_gap_s, of_speed)
    if correlation.is_clear and of_speed:
        sigma_s = max(parent.interval_s, child.interval_s) / 5
        return TimeOffset(correlation.offset_s, sigma_s, correlation)
    if correlation.is_clear:
        coarse = TimeOffset(correlation.offset_s, correlation=correlation)
        return refine_time_offset(parent, child, coarse, max_gap_s)
    doubt = correlation.doubt("speeds" if of_speed else "angular rates")
    raise NotEnoughDataError(
        f"the time offset cannot be estimated: {doubt}; drive with more turns and "
        "changes of speed, or give time_offset in seconds"
    )


def refine_time_offset(
    parent: Trajectory, child: Trajectory, at: TimeOffset, max_gap_s: float, least_s: float = 0.0
) -> TimeOffset:
    """Refine an offset ``at`` which the streams are about; the coarse one, with a wide sigma, if no
    fit explains the motion. An offset below ``least_s`` of motions over one time need not be
    compared with those over others.
    """
    reach_s = max(_FINE_RANGE_S, _FINE_RANGE_INTERVALS * max(parent.interval_s, child.interval_s))
    coarse_s = at.correlation.offset_s
    best = TimeOffset(coarse_s, reach_s / 5, at.correlation)
    held = list[float]()
    for lag_s in _LAGS_S:
        found = offset_over(lag_s, parent, child, at, max_gap_s, least_s)
        at = replace(at, fit=found.fit)
        holds = found.fit and found.fit.explains_translation
        if not holds or abs(found.seconds - coarse_s) > reach_s:
            continue
        held.append(found.seconds)
        if found.sigma_s < best.sigma_s:
            best = found
        if found.largest_s(child.duration_s) < least_s:
            break
    if len(held) < len(_LAGS_S):
        return best
    # What lasts for longer than the jackknife's blocks shows in how these offsets differ.
    sigma_s = float(np.hypot(best.sigma_s, np.std(held, ddof=1)))
    return replace(best, spread_s=np.ptp(held), sigma_s=sigma_s)


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
    """Offset and fit over motions of ``lag_s``, from an offset ``at`` and its fit, or X to start
    at; no fit if there are too few. A clearly smaller offset than ``least_s`` is not refined,
    others no better than that asks for; nor is a fit whose start leaves more than ``most``.
    """
    span_s = max(_LEAST_SPAN_S, _SPAN_INTERVALS * child.interval_s)
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
        # Velocities of the child in its own frame, over less at the ends of the trajectory.
        ends, where = np.unique(np.r_[pairs.i, pairs.j], return_inverse=True)
        stamps_ns = pose_pairs.stamps_ns[ends]
        span_ns = round(span_s * 1e9)
        ends_ns = np.add.outer([-span_ns, span_ns], stamps_ns).clip(*shifted.stamps_ns[[0, -1]])
        before, after = np.split(shifted.at(ends_ns.ravel()), 2)
        steps = se3.log(se3.inverse(before) @ after)
        spans_s = np.diff(ends_ns, axis=0)[0] * 1e-9
        twists = (steps / spans_s[:, None])[where]
        of_child = twists[: len(pairs)], twists[len(pairs) :]
        start = fit = fit_similarity(pairs, of_child, start=start, most=most)
        if not fit.explains_translation and most is None:
            # A body that rotates about one of its sensors shows no scale.
            in_one_unit = fit_similarity(pairs, of_child, same_unit=True)
            start = fit = in_one_unit if in_one_unit.explains_translation else fit
        speed = float(np.sqrt(np.mean((twists[:, 3:] ** 2).sum(axis=1))))
        of_noise_s = _SPAN_OF_NOISE * fit.sigma_rotation / max(speed, 1e-9)
        span_s = max(span_s, min(of_noise_s, _MOST_SPAN_S))
        offset_s = float(offset_s + fit.offset_s)
        is_small = abs(offset_s) + abs(fit.offset_s) < least_s / 2
        if abs(fit.offset_s) < settled_s or is_small:
            earlier = rate
            rate = _rate(fit, pose_pairs.stamps_ns[pairs.i], rate)
            is_settled = abs(rate.used - earlier.used) * child.duration_s < settled_s
            if is_settled and (most_pairs > MAX_PAIRS or not rate.is_used):
                break
    known = rate if np.isfinite(rate.sigma_ppm) else None
    return TimeOffset(offset_s, fit.offset_sigma_s, at.correlation, fit, rate=known)


def _rate(fit: SimilarityFit, stamps_ns: IntArray, before: ClockRate) -> ClockRate:
    """Estimate the clock rate. To the rate before comes the slope of a line through the offsets
    that are left in blocks of time; ``stamps_ns`` (K,) of the pairs are on the parent's clock.
    Its variance is that of Student's t, as the blocks are few.
    """
    offsets_s, weights = fit.offsets_of_blocks
    if weights.min() <= 0.0:
        return before
    blocks_s = np.array_split((stamps_ns - stamps_ns[0]) * 1e-9, len(offsets_s))
    times_s = [float(each.mean()) for each in blocks_s]
    away_s = times_s - np.average(times_s, weights=weights)
    left_s = offsets_s - np.average(offsets_s, weights=weights)
    spread = float(weights @ away_s**2)
    slope = float(weights @ (away_s * left_s)) / spread
    residuals_s = left_s - slope * away_s
    variance = float(weights @ residuals_s**2) / (len(offsets_s) - 4) / spread / fit.held**2
    total = (before.used + slope) * _RATE_PRIOR**2 / (_RATE_PRIOR**2 + variance)
    sigma = float(np.sqrt(variance))
    is_used = abs(total) > _PLAIN_RATE * sigma
    return replace(before, ppm=1e6 * total, sigma_ppm=1e6 * sigma, is_used=is_used)
