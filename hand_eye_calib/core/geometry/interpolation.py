"""Interpolation of poses that does not cut the corners of a motion.

Poses are interpolated at a fraction s of an interval of h seconds by

    T(s) = T_i exp(s xi_i) exp(-m s (1 - s) h^2 / 2 * bend(s)),    xi_i = Log(T_i^-1 T_i+1).

``bend`` is the second derivative of the pose, computed from the changes of the twist at both ends.
m is the share of these changes that is motion; the rest is noise, see :func:`corner_corrections`.
For m = 0, the formula is the geodesic of SE(3) of Välimäki et al. 2023.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hand_eye_calib.core.base.arrays import FloatArray, IntArray

# Motion and noise are distinguished by this number of intervals on each side of an interval.
_NEARBY = 4

# Number of poses on each side of a stamp that interpolation uses.
REACH = _NEARBY + 2

# Correlation of neighbouring second differences of white noise: -4 s^2 / (6 s^2).
_CORRELATION = -2.0 / 3.0

# Variance of the mean of two neighbouring second differences of white noise, divided by the
# variance of one.
_VARIANCE_OF_MEAN = 1.0 / 6.0


def shares_of_motion(changes: FloatArray) -> FloatArray:
    """Return the share of motion (N - 1, 6) in changes (N, 6) of the twist at the poses.

    With this weight, the mean change at both ends of an interval is the most precise estimate of
    the change due to motion. All translations of an interval have one weight, and all rotations
    another.
    """
    shares = np.empty((len(changes) - 1, 6))
    for columns in (slice(0, 3), slice(3, 6)):
        vectors = changes[:, columns]
        squares = (vectors**2).sum(axis=1)
        products = _sums_nearby((vectors[1:] * vectors[:-1]).sum(axis=1))
        powers = _sums_nearby(0.5 * (squares[1:] + squares[:-1]))
        # The correlation is 1 for motion and -2/3 for white noise.
        correlation = products / np.maximum(powers, 1e-300)
        motion = np.clip(
            (correlation - _CORRELATION) / (1.0 - _CORRELATION), 0.0, 1.0
        )
        noise = (1.0 - motion) * _VARIANCE_OF_MEAN
        shares[:, columns] = (motion / (motion + noise))[:, None]
    return shares


def _sums_nearby(values: FloatArray) -> FloatArray:
    """Return the sums (K,) of values (K,) and their neighbours on either side."""
    windows = sliding_window_view(np.pad(values, _NEARBY), 2 * _NEARBY + 1)
    return windows.sum(axis=1)


def corner_corrections(
    stamps_ns: IntArray,
    changes: FloatArray,
    shares: FloatArray,
    start: IntArray,
    fraction: FloatArray,
) -> FloatArray:
    """Return the corrections of poses that were interpolated with a constant twist.

    A constant twist between two poses cuts the corners of a motion. If a vibration of angular
    frequency f is sampled every h seconds, its amplitude decreases by the share (f h)^2 / 12. The
    changes of the twist at both poses correct this loss, as far as they are motion and not noise.

    White noise of poses with standard deviation s causes changes with variance 6 s^2, and
    covariance -4 s^2 between neighbours, in units of h. A well sampled motion causes equal changes
    at neighbours. Therefore the correlation of neighbouring changes determines the share of motion.
    Halfway between two poses, the standard deviation of white noise is 0.71 (constant twist) to
    0.80 of its value at a pose.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    changes : (N, 6) array
        Changes of the twist at the poses, m/s^2 and rad/s^2.
    shares : (N - 1, 6) array
        Share of motion in the changes.
    start : (M,) int array
        Index of the pose before each interpolated pose.
    fraction : (M,) array
        Fraction of the interval from this pose to the next.

    Returns
    -------
    (M, 6) array
        Corrections xi (m, rad), applied as ``T_world_sensor exp(xi)``.
    """
    at_start = changes[start]
    at_end = changes[start + 1]
    share_of_start = (2.0 - fraction)[:, None]
    share_of_end = (1.0 + fraction)[:, None]
    bend = (share_of_start * at_start + share_of_end * at_end) / 3.0
    interval_s = np.diff(stamps_ns)[start] * 1e-9
    # Double integral of a constant second derivative that is zero at both ends of the interval.
    half_square_s2 = 0.5 * fraction * (1.0 - fraction) * interval_s**2
    return -half_square_s2[:, None] * shares[start] * bend
