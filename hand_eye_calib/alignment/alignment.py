"""What has to be known before a method can solve: the offset of the child's clock and the scale of
its lengths.
"""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.alignment.angular_rates import Correlation, correlate_turning
from hand_eye_calib.alignment.similarity import SimilarityFit, fit_similarity
from hand_eye_calib.errors import InputError, NotEnoughDataError
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.leaps import find_leap
from hand_eye_calib.pairing.motion_pairs import pairs_between
from hand_eye_calib.pairing.synchronise import synchronise

# Motions over these times (s) are compared: short ones show the offset best, long ones the scale.
# The best is taken by its own standard deviation.
_OFFSET_LAGS_S = (1.0, 0.3, 3.0)
_SCALE_LAGS_S = (3.0, 1.0, 8.0)
_MOST_PAIRS = 800
_FEWEST_PAIRS = 20

# The child's velocity is taken over this long on either side (s), or one of its intervals if that
# is longer.
_VELOCITY_SPAN_S = 0.05

_OFFSET_ROUNDS, _OFFSET_SETTLED_S = 4, 2e-5

# The fine offset must agree with the coarse one to so much (s), or to that many intervals of the
# slower stream.
_FINE_RANGE_S, _FINE_RANGE_INTERVALS = 0.25, 2.0

# ``scale: auto`` estimates the scale where it differs from 1 by more than this and by so many
# standard deviations, and the fit explains the motion so well (jumps in most of the motions could
# feign a scale).
SCALE_MATTERS, SCALE_IS_SIGNIFICANT, SCALE_IS_CREDIBLE = 0.01, 5.0, 0.1

# Residuals of translations as a share of the motion above which the fit does not explain the
# motion, and cannot tell a scale.
MOST_UNEXPLAINED = 0.3


@dataclass(frozen=True)
class TimeOffset:
    """An estimated clock offset.

    Attributes
    ----------
    seconds : float
        To be added to the child's stamps.
    sigma_s : float
        Standard deviation.
    correlation : Correlation
        The evidence.
    fit : SimilarityFit
        The fit that refined it.
    """

    seconds: float
    sigma_s: float
    correlation: Correlation
    fit: SimilarityFit | None


@dataclass(frozen=True)
class Scale:
    """An estimated scale.

    Attributes
    ----------
    value : float
        Factor from the child's lengths to the parent's.
    sigma : float
    fit : SimilarityFit or None
        The fit it comes from; None where it was given.
    """

    value: float
    sigma: float
    fit: SimilarityFit | None

    @property
    def differs(self):
        """Whether the two streams' lengths differ by enough to matter, beyond doubt."""
        significant = abs(self.value - 1.0) > max(SCALE_MATTERS, SCALE_IS_SIGNIFICANT * self.sigma)
        return significant and self.unexplained < SCALE_IS_CREDIBLE

    @property
    def is_explained(self):
        """Whether the fit explains the motion, so that the value means something."""
        return self.unexplained < MOST_UNEXPLAINED

    @property
    def unexplained(self):
        """Residual translations as a share of the motion."""
        return self.fit.sigma_translation / max(self.fit.moved, 1e-12)


def estimate_time_offset(parent, child, max_gap_s=0.5):
    """Offset of the child's clock: coarse from the turning of both streams, then fine together with
    X and the scale.

    Parameters
    ----------
    parent, child : Trajectory
        Their time ranges need not overlap.
    max_gap_s : float

    Returns
    -------
    TimeOffset

    Raises
    ------
    NotEnoughDataError
        Where the evidence is weak; the message says why.
    InputError
        Where stamps lie days apart.
    """
    for name, stream in (("parent", parent), ("child", child)):
        if leap := find_leap(stream.stamps_ns):
            raise InputError(f"the {name} stream's {leap.what()}; {leap.advice()}")
    correlation = correlate_turning(parent, child, max_gap_s)
    if not correlation.is_clear:
        raise NotEnoughDataError(
            f"the time offset cannot be estimated: {correlation.doubt()}; drive more varied turns, or give time_offset in seconds"
        )
    return refine_time_offset(parent, child, correlation, max_gap_s)


def refine_time_offset(parent, child, correlation, max_gap_s=0.5, start=None):
    """TimeOffset from a coarse one: the fine offset where the fit explains the motion, otherwise
    the coarse one with a wide sigma.

    A SimilarityFit of the same streams as ``start`` spares the search for one.
    """
    interval_s = max(
        float(np.median(np.diff(stream.stamps_ns))) * 1e-9 for stream in (parent, child)
    )
    reach_s = max(_FINE_RANGE_S, _FINE_RANGE_INTERVALS * interval_s)
    best, fit = TimeOffset(correlation.offset_s, reach_s / 5, correlation, None), start
    for lag_s in _OFFSET_LAGS_S:
        offset_s, fit = _fine_offset(parent, child, correlation.offset_s, lag_s, max_gap_s, fit)
        if fit is None:
            continue
        good = (
            fit.sigma_translation < MOST_UNEXPLAINED * fit.moved
            and abs(offset_s - correlation.offset_s) <= reach_s
        )
        if good and fit.offset_sigma_s < best.sigma_s:
            best = TimeOffset(float(offset_s), fit.offset_sigma_s, correlation, fit)
    return best


def _fine_offset(parent, child, offset_s, lag_s, max_gap_s, fit):
    span_s = max(_VELOCITY_SPAN_S, float(np.median(np.diff(child.stamps_ns))) * 1e-9)
    for _ in range(_OFFSET_ROUNDS):
        shifted = child.shifted(offset_s)
        pose_pairs = synchronise(parent, shifted, max_gap_s)
        i, j = indices_after(pose_pairs.stamps_ns, lag_s)
        if len(i) < _FEWEST_PAIRS:
            return offset_s, None
        pairs = pairs_between(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, i, j)
        twists = _twists(shifted, pose_pairs.stamps_ns[np.r_[i, j]], span_s)
        fit = fit_similarity(pairs, *np.split(twists, 2), start=fit)
        offset_s += fit.offset_s
        if abs(fit.offset_s) < _OFFSET_SETTLED_S:
            break
    return offset_s, fit


def _twists(trajectory, stamps_ns, span_s):
    """Velocities (K, 6) of the sensor in its own frame: over the span on either side, less at the
    ends.
    """
    span_ns = round(span_s * 1e9)
    first_ns, last_ns = trajectory.stamps_ns[[0, -1]]
    before, after = (np.clip(stamps_ns + sign * span_ns, first_ns, last_ns) for sign in (-1, 1))
    steps = se3.log(se3.inverse(trajectory.at(before)) @ trajectory.at(after))
    return steps / ((after - before) * 1e-9)[:, None]


def estimate_scale(pose_pairs, held=None, start=None):
    """Factor from the child's unit of length to the parent's.

    Parameters
    ----------
    pose_pairs : PosePairs
    held : float, optional
        Hold the scale here and only see how well it fits.
    start : SimilarityFit, optional
        Of the same streams: spares the search for one.

    Returns
    -------
    Scale

    Raises
    ------
    NotEnoughDataError
        Where there are too few poses.
    """
    best, fit = None, start
    for lag_s in _SCALE_LAGS_S:
        i, j = indices_after(pose_pairs.stamps_ns, lag_s)
        if len(i) < _FEWEST_PAIRS:
            continue
        pairs = pairs_between(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, i, j)
        fit = fit_similarity(pairs, scale=held, start=fit)
        scale = Scale(fit.scale, fit.scale_sigma, fit)
        if best is None or _quality(scale) < _quality(best):
            best = scale
    if best is None:
        raise NotEnoughDataError(
            f"the scale cannot be estimated from {len(pose_pairs)} pose pairs: no {_FEWEST_PAIRS} of them lie "
            f"{min(_SCALE_LAGS_S):g} s apart; record longer, or give scale"
        )
    return best


def _quality(scale):
    return scale.sigma / scale.value + (0.0 if scale.is_explained else scale.unexplained)


def indices_after(stamps_ns, lag_s, most=_MOST_PAIRS):
    """Indices i, j of instants about ``lag_s`` apart, at most so many, evenly over the recording."""
    i = np.linspace(0, len(stamps_ns) - 1, min(len(stamps_ns), most)).astype(int)
    j = np.searchsorted(stamps_ns, stamps_ns[i] + round(lag_s * 1e9) - 1000)
    inside = j < len(stamps_ns)
    i, j = i[inside], j[inside]
    near = stamps_ns[j] - stamps_ns[i] <= (1.5 * lag_s + 0.1) * 1e9
    return i[near], j[near]
