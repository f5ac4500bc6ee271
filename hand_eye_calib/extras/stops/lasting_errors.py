"""Correlation of the errors of stops.

The error of a target's pose depends on the view, so similar views have similar errors. Two kinds of
correlation are considered: errors that return with the place of the arm, and errors that last along
the way from stop to stop. The correlation of two stops is ``(1 - w) exp(-d / r)``: d is the
distance between their views, r a range and w a share of white noise. Several kernels (kind, r, w)
are averaged, with their restricted likelihoods as weights.

Reference: D. A. Harville, *Maximum likelihood approaches to variance component estimation*, JASA
72, 1977.
"""

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3

# Range of each kernel (rad of view). The first kernel is white noise. The second kernel is for
# errors that return with the place, the others for errors that last along the way.
_RANGES_RAD = np.array([0.03, 0.05, *(0.03 * 4.0**k for k in range(6))])
# Share of white noise in each kernel.
_WHITE_SHARES = np.array([1.0, *[0.1] * 7])
_N_BY_PLACE = 2

# Smallest positive number. It keeps arguments of logarithms and divisors positive.
_TINY = np.finfo(float).tiny


def views_of_stops(
    Ts_world_parent: FloatArray, Ts_world_child: FloatArray
) -> FloatArray:
    """Return the views (N, 13) of stops. Distances between views are about angles in rad.

    Column 0 is the length of the way to the stop: the sum of the changes of view. Columns 1 to 9
    are the rotation matrix over the square root of two, so that the distance between two rotations
    is about their angle. Columns 10 to 12 are the position of the parent, divided by the sum of two
    lengths: the median distance to the target, and the mean way between stops.
    """
    positions = se3.translation_of(Ts_world_parent)
    distances_m = np.linalg.norm(se3.translation_of(Ts_world_child), axis=1)
    ways_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    usual_m = np.median(distances_m) + ways_m.sum() / len(positions) + _TINY
    rotations = se3.rotation_of(Ts_world_parent).reshape(-1, 9) / np.sqrt(2.0)
    turns_rad = np.linalg.norm(np.diff(rotations, axis=0), axis=1)
    changes_rad = turns_rad + ways_m / usual_m
    lengths_rad = np.cumsum(np.append(0.0, changes_rad))
    return np.column_stack([lengths_rad, rotations, positions / usual_m])


def rest_weights(views: FloatArray) -> FloatArray:
    """Return weights (N,) of stops, 1 on average, so that an arm at rest does not dominate.

    Consecutive stops at one place have the weight of one stop together.
    """
    # Length of the way to each stop (rad of view). It never decreases.
    way_rad = views[:, 0]
    first = np.searchsorted(way_rad, way_rad - _RANGES_RAD[0])
    end = np.searchsorted(way_rad, way_rad + _RANGES_RAD[0])
    weights = 1.0 / np.maximum(end - first, 1)
    return np.asarray(weights / weights.mean())


def correlations(views: FloatArray) -> FloatArray:
    """Return the correlations (K, N, N) of the errors of N stops for each of K kernels."""
    places = np.linalg.norm(views[:, None, 1:] - views[:, 1:], axis=2)
    ways = np.abs(np.subtract.outer(views[:, 0], views[:, 0]))
    n_by_way = len(_RANGES_RAD) - _N_BY_PLACE
    distances = np.stack([*[places] * _N_BY_PLACE, *[ways] * n_by_way])
    distances = distances / _RANGES_RAD[:, None, None]
    white = _WHITE_SHARES[:, None, None]
    return np.asarray(
        white * np.eye(len(views)) + (1.0 - white) * np.exp(-distances)
    )


def kernel_weights(kernels: FloatArray, rows: FloatArray) -> FloatArray:
    """Return the weight (K,) of each kernel in the mean covariance.

    A weight is the probability of the kernel, times the variance of the errors under this kernel,
    divided by the variance under white noise.

    Parameters
    ----------
    kernels : (K, N, N) array
        Correlations of the stops under each kernel.
    rows : (N, 6, M + 1) array
        Derivatives of the errors with respect to M values. The last column has the errors.
    """
    n = len(rows)
    n_columns = rows.shape[2]
    factors = np.linalg.cholesky(kernels)
    whitened = np.linalg.solve(factors, rows.reshape(1, n, -1))
    triangles = np.linalg.qr(
        whitened.reshape(len(kernels), 6 * n, n_columns), mode="r"
    )
    diagonals = np.abs(np.diagonal(triangles, 0, 1, 2)) + _TINY
    # The last diagonal element is the norm of the residuals after the M values were fitted.
    log_variances = 2.0 * np.log(diagonals[:, -1])
    logs = -0.5 * (6 * n + 1 - n_columns) * log_variances
    logs = logs - np.log(diagonals[:, :-1] + 1e-9).sum(axis=1)
    logs -= 6.0 * np.log(np.diagonal(factors, 0, 1, 2)).sum(axis=1)
    likelihoods = np.exp(logs - logs.max())
    probabilities = likelihoods / likelihoods.sum()
    return np.asarray(probabilities * np.exp(log_variances - log_variances[0]))
