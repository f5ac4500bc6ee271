"""The clock offset: seconds to add to the child's stamps to get the parent's clock, and by how much
that changes from second to second.
"""

from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.alignment.angular_rates import Correlation, correlate_rates
from hand_eye_calib.alignment.similarity import MIN_PAIRS, SimilarityFit, fit_similarity
from hand_eye_calib.arrays import IntArray
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import InputError, NotEnoughDataError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.pairing.motion_pairs import MAX_PAIRS, pairs_over
from hand_eye_calib.pairing.synchronise import find_leap, synchronise
from hand_eye_calib.results.records import ClockRate

# Motions over these times (s) are compared; the lag with the smallest standard deviation wins.
# Short motions show the offset best. Most motions that are compared if there is a rate to be
# measured.
_LAGS_S = (1.0, 0.3, 3.0)
_PAIRS_OF_RATE = 5 * MAX_PAIRS

# Time on either side of a stamp (s) over which the child's velocity is taken: at least; at most; in
# intervals of the child's stream, so that no pose is in the velocity and in the motion; and in
# standard deviations of rotations by the angular rate, so that noise is little of the velocity.
# Noise in both, or much of it, draws the offset, and its standard deviation is too small.
_LEAST_SPAN_S, _MOST_SPAN_S, _SPAN_INTERVALS, _SPAN_OF_NOISE = 0.05, 0.3, 2.0, 1.4

_MAX_ROUNDS, _SETTLED_S = 8, 2e-5

# A rate of the clock is known to this beforehand (75 ppm are usual for USB devices); one beyond so
# many standard deviations is there.
_RATE_PRIOR, _PLAIN_RATE = 1e-4, 4.0

# Most that the fine offset may differ from the coarse one: seconds, or intervals of the slower
# stream if those are longer.
_FINE_RANGE_S, _FINE_RANGE_INTERVALS = 0.25, 2.0


@dataclass(frozen=True)
class TimeOffset:
    """An estimated clock offset.

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

    seconds: float
    sigma_s: float
    correlation: Correlation
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
        return refine_time_offset(parent, child, correlation, max_gap_s)
    doubt = correlation.doubt("speeds" if of_speed else "angular rates")
    raise NotEnoughDataError(
        f"the time offset cannot be estimated: {doubt}; drive with more turns and "
        "changes of speed, or give time_offset in seconds"
    )


def refine_time_offset(
    parent: Trajectory,
    child: Trajectory,
    correlation: Correlation,
    max_gap_s: float,
    start: SimilarityFit | None = None,
    least_s: float = 0.0,
) -> TimeOffset:
    """Refine the coarse offset of a correlation; as it is, with a wide sigma, if no fit explains
    the motion. A ``start`` is a fit of the same streams; without one it is searched for. An offset
    below ``least_s`` of motions over one time need not be compared with those over others.
    """
    reach_s = max(_FINE_RANGE_S, _FINE_RANGE_INTERVALS * max(parent.interval_s, child.interval_s))
    best, fit = TimeOffset(correlation.offset_s, reach_s / 5, correlation), start
    held: list[float] = []
    for lag_s in _LAGS_S:
        found = _fine_offset(parent, child, correlation, lag_s, max_gap_s, fit, least_s)
        if (fit := found.fit) is None:
            continue
        holds = fit.explains_translation and abs(found.seconds - correlation.offset_s) <= reach_s
        held += [found.seconds] if holds else []
        if holds and found.sigma_s < best.sigma_s:
            best = found
        if found.largest_s(child.duration_s) < least_s:
            break
    return replace(best, spread_s=np.ptp(held)) if len(held) == len(_LAGS_S) else best


def _fine_offset(
    parent: Trajectory,
    child: Trajectory,
    correlation: Correlation,
    lag_s: float,
    max_gap_s: float,
    fit: SimilarityFit | None,
    least_s: float,
) -> TimeOffset:
    """Offset and fit over motions of ``lag_s``; no fit if there are too few. A clearly smaller
    offset than ``least_s`` is not refined.
    """
    span_s = max(_LEAST_SPAN_S, _SPAN_INTERVALS * child.interval_s)
    middle_ns = int(child.stamps_ns[0] + (child.stamps_ns[-1] - child.stamps_ns[0]) // 2)
    offset_s, rate = correlation.offset_s, ClockRate(ppm=0.0, sigma_ppm=np.inf, at_ns=middle_ns)
    most_pairs = MAX_PAIRS
    for _ in range(_MAX_ROUNDS):
        shifted = child.shifted(offset_s, rate.used, rate.at_ns)
        pose_pairs = synchronise(parent, shifted, max_gap_s)
        pairs = pairs_over(pose_pairs, lag_s, most_pairs)
        if len(pairs) < MIN_PAIRS:
            return TimeOffset(offset_s, np.inf, correlation)
        # Velocities of the child in its own frame, over less at the ends of the trajectory.
        at, where = np.unique(np.r_[pairs.i, pairs.j], return_inverse=True)
        stamps_ns, span_ns = pose_pairs.stamps_ns[at], round(span_s * 1e9)
        ends_ns = np.add.outer([-span_ns, span_ns], stamps_ns).clip(*shifted.stamps_ns[[0, -1]])
        before, after = (shifted.at(each) for each in ends_ns)
        steps, spans_s = se3.log(se3.inverse(before) @ after), np.diff(ends_ns, axis=0)[0] * 1e-9
        twists = (steps / spans_s[:, None])[where]
        of_child = twists[: len(pairs)], twists[len(pairs) :]
        fit = fit_similarity(pairs, of_child, start=fit)
        if not fit.explains_translation:
            # A body that rotates about one of its sensors shows no scale.
            in_one_unit = fit_similarity(pairs, of_child, same_unit=True)
            fit = in_one_unit if in_one_unit.explains_translation else fit
        speed = float(np.sqrt(np.mean((twists[:, 3:] ** 2).sum(axis=1))))
        of_noise_s = _SPAN_OF_NOISE * fit.sigma_rotation / max(speed, 1e-9)
        span_s = max(span_s, min(of_noise_s, _MOST_SPAN_S))
        offset_s = float(offset_s + fit.offset_s)
        is_small = abs(offset_s) + abs(fit.offset_s) < least_s / 2
        if abs(fit.offset_s) < _SETTLED_S or is_small:
            found = _rate(fit, pose_pairs.stamps_ns[pairs.i], rate)
            is_settled = abs(found.used - rate.used) * child.duration_s < _SETTLED_S
            rate = found
            if is_settled and (most_pairs > MAX_PAIRS or not rate.is_used):
                break
            most_pairs = _PAIRS_OF_RATE if rate.is_used else MAX_PAIRS
    known = rate if np.isfinite(rate.sigma_ppm) else None
    assert fit is not None
    return TimeOffset(offset_s, fit.offset_sigma_s, correlation, fit, rate=known)


def _rate(fit: SimilarityFit, stamps_ns: IntArray, before: ClockRate) -> ClockRate:
    """The rate before, and what is left of it: the slope of a line through the offsets of blocks of
    time, of which the stamps (K,) of the pairs are on the parent's clock.
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
    variance = float(weights @ residuals_s**2) / (len(offsets_s) - 2) / spread
    total = (before.used + slope) * _RATE_PRIOR**2 / (_RATE_PRIOR**2 + variance)
    sigma = float(np.sqrt(variance))
    is_used = abs(total) > _PLAIN_RATE * sigma
    return replace(before, ppm=1e6 * total, sigma_ppm=1e6 * sigma, is_used=is_used)
