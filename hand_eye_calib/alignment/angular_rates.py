"""The offset between two clocks, from how fast both streams turn.

However two sensors are mounted on a rigid body, they turn through the same angle in the same time.
The offset that brings the two angular speeds into step is therefore the offset of the clocks: no
extrinsic is needed, and neither a common world, a common scale nor the right quaternion order
(reordering or inverting quaternions leaves the angles alone).
"""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.geometry import se3

# Angles are taken over windows of this many sampling steps, so that the noise of single poses does
# not drown the motion.
_WINDOW_STEPS = 3
_SHORTEST_WINDOW_S = 0.2
_SHORTEST_STEP_S, _LONGEST_STEP_S = 0.02, 1.0
_MOST_SAMPLES = 200_000

# Turning faster than in all but this share of the windows is clipped: jumps of a stream are no
# motion.
_CLIPPED_SHARE = 0.03

# Offsets are considered where at least this share of the shorter stream, and this long, overlaps.
_LEAST_OVERLAP_SHARE, _LEAST_OVERLAP_S = 0.25, 5.0

# Another offset is a rival only beyond this distance: next to the peak the correlation is high by
# itself.
_PEAK_WIDTH_S, _PEAK_WIDTH_WINDOWS = 2.0, 5.0

# Streams turning together are 5 to 12 times better correlated at their offset than at any other,
# streams that have nothing to do with each other at most 1.3 times (measured on sixteen real
# recordings).
DISTINCT = 2.0
CORRELATED = 0.5

# Variation of the turning rate (rad/s) below which there is nothing to compare.
LEAST_VARIATION = 0.01

_ALMOST_ONE = 1 - 1e-9


@dataclass(frozen=True)
class Correlation:
    """Where the turning of two streams agrees best.

    Attributes
    ----------
    offset_s : float
        Seconds to add to the child's stamps; fine to about a tenth of a sampling step.
    correlation : float
        Correlation coefficient of the turning rates there.
    distinctness : float
        How many times more significant that is than the best elsewhere.
    overlap_s : float
        How long both streams run together at that offset.
    variation : float
        Standard deviation of the turning rate of the stream that varies less, rad/s.
    """

    offset_s: float
    correlation: float
    distinctness: float
    overlap_s: float
    variation: float

    @property
    def is_clear(self):
        """Whether this is evidence enough to believe the offset."""
        return (
            self.correlation >= CORRELATED
            and self.distinctness >= DISTINCT
            and self.variation >= LEAST_VARIATION
        )

    def doubt(self):
        """What is wrong with the evidence, in words; empty where nothing is."""
        if self.variation < LEAST_VARIATION:
            return "the streams hardly turn, or turn at a constant rate"
        if self.correlation < CORRELATED:
            return f"their turning is correlated by {self.correlation:.2f} at best ({CORRELATED} is needed)"
        if self.distinctness < DISTINCT:
            return f"the best offset is only {self.distinctness:.1f} times better than the next ({DISTINCT:g} is needed)"
        return ""


NO_CORRELATION = Correlation(0.0, 0.0, 0.0, 0.0, 0.0)


def correlate_turning(parent, child, max_gap_s=0.5):
    """Find the clock offset at which two streams turn together, over all offsets.

    Parameters
    ----------
    parent, child : Trajectory
        Their time ranges need not overlap.
    max_gap_s : float
        Windows that touch a longer gap between poses are left out.

    Returns
    -------
    Correlation
        Without any evidence where a stream is too short; see :attr:`Correlation.is_clear`.

    Notes
    -----
    Correlation coefficients at all offsets at once by fast Fourier transforms with masks for gaps
    and ends (Padfield, *Masked object registration in the Fourier domain*, IEEE Transactions on
    Image Processing, 2012). Offsets are compared by the significance of their coefficient (Fisher's
    z), so that a short overlap needs a better agreement than a long one.
    """
    if min(len(parent), len(child)) < 4:
        return NO_CORRELATION
    step_s = float(
        np.clip(max(_interval_s(parent), _interval_s(child)), _SHORTEST_STEP_S, _LONGEST_STEP_S)
    )
    step_s = max(step_s, max(parent.duration_s, child.duration_s) / _MOST_SAMPLES)
    window_s = max(_WINDOW_STEPS * step_s, _SHORTEST_WINDOW_S)
    start_parent, rate_parent = turning_rates(parent, window_s, step_s, max_gap_s)
    start_child, rate_child = turning_rates(child, window_s, step_s, max_gap_s)
    if (
        min(np.isfinite(rate_parent).sum(), np.isfinite(rate_child).sum()) * step_s
        < _LEAST_OVERLAP_S
    ):
        return NO_CORRELATION
    variation = min(float(np.nanstd(rate)) for rate in (rate_parent, rate_child))
    lags, coefficients, overlaps = _masked_correlation(
        _compressed(rate_parent), _compressed(rate_child)
    )
    durations = overlaps * step_s
    enough = durations >= max(
        _LEAST_OVERLAP_SHARE * min(len(rate_parent), len(rate_child)) * step_s, _LEAST_OVERLAP_S
    )
    # About one independent sample a second; three degrees of freedom go into the coefficient.
    significance = np.where(
        enough,
        np.arctanh(np.clip(coefficients, -_ALMOST_ONE, _ALMOST_ONE))
        * np.sqrt(np.maximum(durations - 3, 0)),
        -np.inf,
    )
    best = int(np.argmax(significance))
    elsewhere = np.abs(lags - lags[best]) * step_s > max(
        _PEAK_WIDTH_S, _PEAK_WIDTH_WINDOWS * window_s
    )
    rival = max(float(np.max(significance, where=elsewhere, initial=0.0)), 1.0)
    offset_s = (int(start_parent) - int(start_child)) * 1e-9 + (
        lags[best] + _vertex(lags, coefficients, best)
    ) * step_s
    return Correlation(
        float(offset_s),
        float(coefficients[best]),
        float(significance[best] / rival),
        float(durations[best]),
        variation,
    )


def _interval_s(trajectory):
    return float(np.median(np.diff(trajectory.stamps_ns))) * 1e-9


def turning_rates(trajectory, window_s, step_s, max_gap_s):
    """Start stamp and angular speeds (M,), rad/s, over windows that start every ``step_s``; nan
    where a window touches a gap.
    """
    stamps_ns = trajectory.stamps_ns
    n_windows = max(int((trajectory.duration_s - window_s) / step_s), 0)
    starts_ns = stamps_ns[0] + np.round(np.arange(n_windows) * step_s * 1e9).astype(np.int64)
    ends_ns = starts_ns + round(window_s * 1e9)
    rotations = [trajectory.at(at_ns)[:, :3, :3] for at_ns in (starts_ns, ends_ns)]
    rates = se3.rotation_angle(np.swapaxes(rotations[0], 1, 2) @ rotations[1]) / window_s
    gaps_before = np.r_[0, np.cumsum(np.diff(stamps_ns) > (max_gap_s + window_s) * 1e9)]
    first = np.searchsorted(stamps_ns, starts_ns, side="right") - 1
    last = np.minimum(np.searchsorted(stamps_ns, ends_ns), len(stamps_ns) - 1)
    rates[gaps_before[last] > gaps_before[first]] = np.nan
    return stamps_ns[0], rates


def _compressed(rates):
    """Rates with jumps clipped and large values compressed, about their mean."""
    roots = np.sqrt(rates)
    roots = np.minimum(roots, np.nanquantile(roots, 1 - _CLIPPED_SHARE))
    return roots - np.nanmean(roots)


def _masked_correlation(first, second):
    """Lags, correlation coefficients and numbers of common samples; first[i + lag] is compared with
    second[i], nans are left out.
    """
    size = 1 << (len(first) + len(second) - 1).bit_length()

    def spectra(signal):
        mask = np.isfinite(signal)
        filled = np.where(mask, signal, 0.0)
        return [np.fft.rfft(part, size) for part in (mask.astype(float), filled, filled**2)]

    one_a, a, aa = spectra(first)
    one_b, b, bb = (np.conj(part) for part in spectra(second))
    count = np.round(np.fft.irfft(one_a * one_b, size))
    divisor = np.maximum(count, 1.0)
    sum_a, sum_b = np.fft.irfft(a * one_b, size), np.fft.irfft(one_a * b, size)
    covariance = np.fft.irfft(a * b, size) - sum_a * sum_b / divisor
    square_a, square_b = np.fft.irfft(aa * one_b, size), np.fft.irfft(one_a * bb, size)
    variance_a, variance_b = square_a - sum_a**2 / divisor, square_b - sum_b**2 / divisor
    varied = (variance_a > 1e-9 * square_a.max(initial=0.0)) & (
        variance_b > 1e-9 * square_b.max(initial=0.0)
    )
    coefficients = np.where(
        varied, covariance / np.sqrt(np.where(varied, variance_a * variance_b, 1.0)), 0.0
    )
    lags = np.arange(size)
    return np.where(lags < len(first), lags, lags - size), coefficients, count


def _vertex(lags, coefficients, best):
    """Distance, in lags, from the best lag to the vertex of the parabola through it and its
    neighbours.
    """
    below, top, above = (float(coefficients[(best + step) % len(lags)]) for step in (-1, 0, 1))
    bend = below - 2 * top + above
    return 0.0 if bend >= 0 else float(np.clip(0.5 * (below - above) / bend, -0.5, 0.5))
