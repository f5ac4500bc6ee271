"""Correlation of the angular rates of two streams over all offsets of their clocks.

Model: two sensors on one rigid body rotate by the same angle in the same time, for any mounting. So
the correlation of the angular rates is largest at the offset of the child's clock. It needs no
extrinsic, no common world and no common scale. The order of quaternions does not matter, because
reordered or inverted quaternions have the same angles.
"""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.stats import quantile
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory, repetitions

# Angles are measured over windows of this number of sampling steps. In shorter windows the noise of
# single poses may exceed the motion.
_WINDOW_STEPS = 3

# Smallest length of a window (s).
_MIN_WINDOW_S = 0.2

# Smallest sampling step (s), for streams with short intervals.
_MIN_STEP_S = 0.02
# Largest sampling step (s), for streams with long intervals.
_MAX_STEP_S = 1.0

# Largest number of sampling steps. Longer recordings have longer steps.
_MAX_SAMPLES = 200_000

# The largest rates are clipped in this share of the windows: they may be jumps of a stream instead
# of motion.
_CLIPPED_SHARE = 0.03

# An offset is possible if both streams overlap for this share of the shorter stream ...
_MIN_OVERLAP_SHARE = 0.25
# ... and for this time (s).
_MIN_OVERLAP_S = 5.0

# Half width (s) of the peak of the correlation. Offsets within the peak do not count as rivals.
_PEAK_WIDTH_S = 2.0
# Half width of the peak in windows, if this is wider.
_PEAK_WIDTH_WINDOWS = 5.0

# Smallest ratio between the significances of the best offset and of its best rival. In sixteen real
# recordings it was 5 to 12 for streams of one body, and at most 1.3 for unrelated streams.
_MIN_DISTINCTNESS = 2.0

# Smallest correlation coefficient of the angular rates at an offset that is trusted.
_MIN_CORRELATION = 0.5

# A repeated pose may come from a frozen stream if the repetition lasts at least this time (s).
_MIN_REPETITION_S = 1.0

# Rates are correlated only if their standard deviation (rad/s) exceeds this limit.
MIN_VARIATION = 0.01


@dataclass(frozen=True)
class Correlation:
    """Best correlation of the angular rates of two streams over all clock offsets.

    The defaults mean that no offset could be estimated.

    Attributes
    ----------
    offset_s : float
        Offset (s) with the best correlation, to be added to the child's stamps. Its error is about
        a tenth of a sampling step.
    correlation : float
        Correlation coefficient of the angular rates at this offset.
    distinctness : float
        Significance of this offset divided by that of the best offset outside the peak.
    variation : float
        Standard deviation (rad/s) of the angular rate, in the stream with the smaller variation.
    ratio : float
        Angular rates of the child divided by those of the parent.
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
        """Return the reason why the offset cannot be trusted; empty if it can be trusted.

        ``quantity`` names the correlated rates in the text.
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
    """Find the clock offset with the best correlation of the angular rates.

    The stamps of the streams need not overlap. Repeated poses of a frozen stream may hide the
    offset; a second attempt leaves them out.

    Parameters
    ----------
    parent, child : Trajectory
    max_gap_s : float
        Windows that overlap a longer gap (s) between poses are left out.
    of_speed : bool
        Correlate speeds instead of angular rates, for a sensor without orientation.

    Returns
    -------
    Correlation
        The best correlation; the default values if a stream is too short.
    """
    if min(len(parent), len(child)) < 4:
        return Correlation()
    longer_interval_s = max(parent.interval_s, child.interval_s)
    step_s = float(np.clip(longer_interval_s, _MIN_STEP_S, _MAX_STEP_S))
    longer_s = max(parent.duration_s, child.duration_s)
    step_s = max(step_s, longer_s / _MAX_SAMPLES)
    window_s = max(_WINDOW_STEPS * step_s, _MIN_WINDOW_S)
    parent_rates = angular_rates(parent, window_s, step_s, max_gap_s, of_speed)
    child_rates = angular_rates(child, window_s, step_s, max_gap_s, of_speed)
    if _shorter_s(parent_rates, child_rates, step_s) < _MIN_OVERLAP_S:
        return Correlation()
    start_s = float(parent.stamps_ns[0] - child.stamps_ns[0]) * 1e-9
    best = _best_correlation(
        parent_rates, child_rates, start_s, step_s, window_s
    )
    if best.is_clear:
        return best
    _clear_repetitions(parent, parent_rates, step_s, window_s)
    _clear_repetitions(child, child_rates, step_s, window_s)
    if _shorter_s(parent_rates, child_rates, step_s) < _MIN_OVERLAP_S:
        return best
    second = _best_correlation(
        parent_rates, child_rates, start_s, step_s, window_s
    )
    return second if second.is_clear else best


def _shorter_s(
    parent_rates: FloatArray, child_rates: FloatArray, step_s: float
) -> float:
    """Return the total time (s) with finite rates, of the stream with less of it."""
    n_of_parent = np.isfinite(parent_rates).sum()
    n_of_child = np.isfinite(child_rates).sum()
    return min(n_of_parent, n_of_child) * step_s


def _clear_repetitions(
    stream: Trajectory, rates: FloatArray, step_s: float, window_s: float
) -> None:
    """Set the rates (M,) of windows that contain a repeated pose to NaN."""
    start_ns = int(stream.stamps_ns[0])
    for from_ns, until_ns in repetitions(stream, _MIN_REPETITION_S):
        first = max(
            int(((from_ns - start_ns) * 1e-9 - window_s) / step_s) + 1, 0
        )
        last = int((until_ns - start_ns) * 1e-9 / step_s) + 1
        rates[first : last + 1] = np.nan


def _best_correlation(
    of_parent: FloatArray,
    of_child: FloatArray,
    start_s: float,
    step_s: float,
    window_s: float,
) -> Correlation:
    """Return the best correlation of rates (M,) and (N,) over all lags.

    Parameters
    ----------
    of_parent, of_child : (M,) and (N,) arrays
        Rates in consecutive windows; NaN if unknown.
    start_s : float
        First stamp of the parent minus first stamp of the child (s).
    step_s, window_s : float
        Distance between the starts of two windows, and duration of a window (s).
    """
    lags, coefficients, overlaps, ratios = _masked_correlation(
        of_parent, of_child
    )
    durations = overlaps * step_s
    shorter_s = min(len(of_parent), len(of_child)) * step_s
    is_possible = durations >= max(
        _MIN_OVERLAP_SHARE * shorter_s, _MIN_OVERLAP_S
    )
    # Fisher's z for n samples has a standard deviation of 1 / sqrt(n - 3). About one sample per
    # second is independent.
    fisher_z = np.arctanh(np.clip(coefficients, -1 + 1e-9, 1 - 1e-9))
    significance = fisher_z * np.sqrt(np.maximum(durations - 3, 0))
    significance[~is_possible] = -np.inf
    best = int(np.argmax(significance))
    lags_s = np.multiply(lags, step_s, dtype=float)
    peak_width_s = max(_PEAK_WIDTH_S, _PEAK_WIDTH_WINDOWS * window_s)
    rivals = significance[np.abs(lags_s - lags_s[best]) > peak_width_s]
    # Vertex of the parabola through the best lag and its two neighbours, in steps from the best
    # lag.
    around = np.arange(best - 1, best + 2) % len(coefficients)
    below, top, above = coefficients[around]
    curvature = below - 2 * top + above
    vertex = 0.0
    if curvature < 0:
        vertex = np.clip(0.5 * (below - above) / curvature, -0.5, 0.5)
    return Correlation(
        offset_s=float(start_s + (lags[best] + vertex) * step_s),
        correlation=float(top),
        distinctness=float(
            significance[best] / max(rivals.max(initial=-np.inf), 1.0)
        ),
        variation=min(
            float(np.nanstd(rates)) for rates in (of_parent, of_child)
        ),
        ratio=float(ratios[best]),
    )


def angular_rates(
    trajectory: Trajectory,
    window_s: float,
    step_s: float,
    max_gap_s: float,
    of_speed: bool = False,
) -> FloatArray:
    """Return the mean angular rates (M,) in rad/s, or the speeds in m/s, of M windows.

    Windows of ``window_s`` seconds start every ``step_s`` seconds. The rates of windows that
    overlap a gap longer than ``max_gap_s`` are NaN.
    """
    stamps_ns = trajectory.stamps_ns
    n_windows = max(int((trajectory.duration_s - window_s) / step_s), 0)
    elapsed_ns = np.round(np.arange(n_windows) * step_s * 1e9)
    starts_ns = stamps_ns[0] + elapsed_ns.astype(np.int64)
    ends_ns = starts_ns + round(window_s * 1e9)
    before, after = np.split(
        trajectory.at(np.concatenate([starts_ns, ends_ns])), 2
    )
    if of_speed:
        moved = np.linalg.norm(
            se3.translation_of(after) - se3.translation_of(before), axis=1
        )
    else:
        rotations = se3.relative_rotations(
            se3.rotation_of(before), se3.rotation_of(after)
        )
        moved = se3.rotation_angle(rotations)
    rates = moved / window_s
    # Number of long gaps before each pose. A window overlaps a gap if this number differs at its
    # ends.
    gaps_before = np.r_[
        0, np.cumsum(np.diff(stamps_ns) > (max_gap_s + window_s) * 1e9)
    ]
    first = np.searchsorted(stamps_ns, starts_ns, side="right") - 1
    last = np.minimum(np.searchsorted(stamps_ns, ends_ns), len(stamps_ns) - 1)
    rates[gaps_before[last] > gaps_before[first]] = np.nan
    return rates


def _masked_correlation(
    first: FloatArray, second: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Correlate rates (M,) and (N,) at all lags: ``first[i + lag]`` with ``second[i]``.

    NaNs are left out: D. Padfield, *Masked object registration in the Fourier domain*, IEEE
    Transactions on Image Processing 21(5), 2012. The square roots of the rates are correlated, so
    that a few large rates do not dominate.

    Returns
    -------
    lags : (L,) int array
    coefficients : (L,) array
        Correlation coefficients; 0 if a stream does not vary.
    counts : (L,) array
        Numbers of samples that both streams have.
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
        spectra.append(
            np.fft.rfft([mask.astype(float), filled, filled**2], size)
        )
    # Sums over the common samples at each lag are inverse transforms of products of spectra. For
    # the roots of the first rates: spectra of their mask, their values and their squares.
    one_a, a, aa = spectra[0]
    # The same spectra for the roots of the second rates.
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
    ratios = np.where(has_variance, variance_b, 1.0) / np.where(
        has_variance, variance_a, 1.0
    )
    lags = np.arange(size)
    lags = np.where(lags < len(first), lags, lags - size)
    return lags, np.where(has_variance, covariance / scale, 0.0), count, ratios
