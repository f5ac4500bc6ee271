"""Poses between those of a trajectory.

A constant twist between two poses cuts the corners of a motion: a shake of angular frequency f,
seen every h seconds, shrinks by (f h)^2 / 12. So the change of the twist at the poses before and
after counts, too, as far as it is motion and not noise. Changes by white noise s have variance
6 s^2 and a covariance of -4 s^2 with the next one; those by a motion that is sampled well are
alike. The share of motion follows from the poses nearby. What is left of white noise halfway
between two poses is between 0.71 (a constant twist) and 0.80 of it.
"""

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry import se3

# Intervals on either side of one that tell motion from noise, and poses before and after a stamp
# that interpolation looks at.
_NEARBY = 4
REACH = _NEARBY + 2

# Of white noise: covariance of neighbouring changes over their variance, and variance of the mean
# of two of them over theirs.
_CORRELATION, _LEFT_IN_THE_MEAN = -2.0 / 3.0, 1.0 / 6.0


def corners(
    stamps_ns: IntArray, poses: FloatArray, start: IntArray, fraction: FloatArray
) -> FloatArray:
    """Twists from a constant twist to the motion.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    poses : (N, 4, 4) array
        ``Ts_world_sensor``.
    start : (M,) int array
        Index of the pose before each wanted one.
    fraction : (M,) array
        Of the interval to the next pose, in [0, 1].

    Returns
    -------
    (M, 6) array
        xi in ``T_world_sensor exp(xi)``.
    """
    spans_s = np.diff(stamps_ns) * 1e-9
    changes = _changes(spans_s, poses, _near(start, len(spans_s)))
    shares = _shares_of_motion(changes)[start]
    at_start, at_end = changes[start], changes[start + 1]
    bend = ((2.0 - fraction)[:, None] * at_start + (1.0 + fraction)[:, None] * at_end) / 3.0
    missing = 0.5 * fraction * (1.0 - fraction) * spans_s[start] ** 2
    return -missing[:, None] * shares * bend


def _near(start: IntArray, n_intervals: int) -> IntArray:
    """Intervals that tell what happens in the wanted ones."""
    is_near = np.zeros(n_intervals, dtype=bool)
    for step in range(-_NEARBY - 1, _NEARBY + 2):
        is_near[np.clip(start + step, 0, n_intervals - 1)] = True
    return np.flatnonzero(is_near)


def _changes(spans_s: FloatArray, poses: FloatArray, intervals: IntArray) -> FloatArray:
    """Change of the twist per second (N, 6) at each pose; zero at the ends and far from these
    intervals.
    """
    twists = np.zeros((len(spans_s), 6))
    steps = se3.log(se3.inverse(poses[intervals]) @ poses[intervals + 1])
    twists[intervals] = steps / spans_s[intervals, None]
    changes = np.zeros((len(poses), 6))
    changes[1:-1] = np.diff(twists, axis=0) / (0.5 * (spans_s[1:] + spans_s[:-1]))[:, None]
    return changes


def _shares_of_motion(changes: FloatArray) -> FloatArray:
    """Share (N - 1, 6) of motion in the changes at both ends of each interval, translation and
    rotation each on its own, as the weight that makes their mean most precise.
    """
    shares = np.empty((len(changes) - 1, 6))
    for part in (slice(0, 3), slice(3, 6)):
        of_part = changes[:, part]
        power = (of_part**2).sum(axis=1)
        products = _sums_nearby((of_part[1:] * of_part[:-1]).sum(axis=1))
        powers = _sums_nearby(0.5 * (power[1:] + power[:-1]))
        alike = products / np.maximum(powers, 1e-300)
        motion = np.clip((alike - _CORRELATION) / (1.0 - _CORRELATION), 0.0, 1.0)
        shares[:, part] = (motion / (motion + (1.0 - motion) * _LEFT_IN_THE_MEAN))[:, None]
    return shares


def _sums_nearby(values: FloatArray) -> FloatArray:
    """Sum of each value and its neighbours on either side."""
    padded = np.pad(values, _NEARBY)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEARBY + 1)
    return np.asarray(windows.sum(axis=1))
