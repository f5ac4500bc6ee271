"""Coarse clock offset between two streams, from the correlation of their angular rates.

Two sensors on one rigid body rotate through the same angle in the same time, however they are
mounted. The offset that aligns their angular rates is therefore the clock offset. This needs no
extrinsic, no common world, no common scale and no particular quaternion order: reordered or
inverted quaternions have the same angles.
"""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.stats import quantile

# Angles are taken over windows of this many sampling steps, and at least so long, so that the noise
# of single poses does not hide the motion. Sampling steps are within bounds, and at most so many.
_WINDOW_STEPS, _MIN_WINDOW_S = 3, 0.2
_MIN_STEP_S, _MAX_STEP_S, _MAX_SAMPLES = 0.02, 1.0, 200_000

# Angular rates above those of all but this share of the windows are clipped: jumps of a stream are
# not motion.
_CLIPPED_SHARE = 0.03

# Offsets are considered if at least this share of the shorter stream, and this long, overlaps.
_MIN_OVERLAP_SHARE, _MIN_OVERLAP_S = 0.25, 5.0

# Another offset is a rival only beyond this distance: close to the peak the correlation is high
# anyway.
_PEAK_WIDTH_S, _PEAK_WIDTH_WINDOWS = 2.0, 5.0

# Streams of one body are 5 to 12 times better correlated at their offset than at any other,
# unrelated streams at most 1.3 times (measured on sixteen real recordings).
_DISTINCT, _CORRELATED = 2.0, 0.5

# Smallest standard deviation of the angular rate (rad/s) that can be correlated.
MIN_VARIATION = 0.01


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
    overlap_s : float
        Time that both streams have in common at that offset.
    variation : float
        Standard deviation of the angular rate, of the stream that varies less, rad/s.
    """

    offset_s: float = 0.0
    correlation: float = 0.0
    distinctness: float = 0.0
    overlap_s: float = 0.0
    variation: float = 0.0

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
    lags, coefficients, overlaps = _masked_correlation(of_parent, of_child)
    durations = overlaps * step_s
    shorter_s = min(len(of_parent), len(of_child)) * step_s
    enough = durations >= max(_MIN_OVERLAP_SHARE * shorter_s, _MIN_OVERLAP_S)
    # About one independent sample a second; three degrees of freedom go into the coefficient.
    fisher_z = np.arctanh(np.clip(coefficients, -1 + 1e-9, 1 - 1e-9))
    significance = np.where(enough, fisher_z * np.sqrt(np.maximum(durations - 3, 0)), -np.inf)
    best, lags_s = int(np.argmax(significance)), np.multiply(lags, step_s, dtype=float)
    apart_s = max(_PEAK_WIDTH_S, _PEAK_WIDTH_WINDOWS * window_s)
    rivals = significance[np.abs(lags_s - lags_s[best]) > apart_s]
    # The vertex of the parabola through the best lag and its neighbours.
    below, top, above = coefficients[np.arange(best - 1, best + 2) % len(coefficients)]
    curvature = below - 2 * top + above
    beside = 0.0 if curvature >= 0 else np.clip(0.5 * (below - above) / curvature, -0.5, 0.5)
    start_s = (parent.stamps_ns[0] - child.stamps_ns[0]) * 1e-9
    return Correlation(
        offset_s=float(start_s + (lags[best] + beside) * step_s),
        correlation=float(top),
        distinctness=float(significance[best] / max(rivals.max(initial=-np.inf), 1.0)),
        overlap_s=float(durations[best]),
        variation=min(float(np.nanstd(rates)) for rates in (of_parent, of_child)),
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
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Lags, correlation coefficients and counts of common samples of rates: first[i + lag] against
    second[i], NaNs left out.
    """
    size = 1 << (len(first) + len(second) - 1).bit_length()
    spectra = []
    for rates in (first, second):
        # Jumps are clipped and large values compressed.
        mask, roots = np.isfinite(rates), np.sqrt(rates)
        roots = np.minimum(roots, quantile(roots[mask], 1 - _CLIPPED_SHARE))
        filled = np.where(mask, roots - np.nanmean(roots), 0.0)
        spectra += [np.fft.rfft(part, size) for part in (mask.astype(float), filled, filled**2)]
    one_a, a, aa = spectra[:3]
    one_b, b, bb = np.conj(spectra[3:])
    count = np.round(np.fft.irfft(one_a * one_b, size))
    divisor = np.maximum(count, 1.0)
    sum_a, sum_b = np.fft.irfft(a * one_b, size), np.fft.irfft(one_a * b, size)
    covariance = np.fft.irfft(a * b, size) - sum_a * sum_b / divisor
    square_a, square_b = np.fft.irfft(aa * one_b, size), np.fft.irfft(one_a * bb, size)
    variance_a, variance_b = square_a - sum_a**2 / divisor, square_b - sum_b**2 / divisor
    varied = variance_a > 1e-9 * square_a.max(initial=0.0)
    varied &= variance_b > 1e-9 * square_b.max(initial=0.0)
    scale = np.sqrt(np.where(varied, variance_a * variance_b, 1.0))
    lags = np.arange(size)
    lags = np.where(lags < len(first), lags, lags - size)
    return lags, np.where(varied, covariance / scale, 0.0), count
