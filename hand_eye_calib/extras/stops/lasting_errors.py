"""Errors of stops that last over several stops, or come back with the place of the arm.

The errors of a target's pose depend on the view: stops from similar views have similar errors.
Their correlation is a white share on the diagonal plus an exponential of the distance of views.
The distance is that between places, or that along the way from stop to stop, over several ranges.
The restricted likelihood weighs these kernels.

Reference: D. A. Harville, *Maximum likelihood approaches to variance component estimation*, JASA
72, 1977.
"""

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3

# Range of each kernel (rad of view) and white share of its variance. The first kernel is of errors
# that do not last, the second of errors that come back with their place; the others are of errors
# that last along the way from stop to stop.
_RANGES_RAD = np.array([0.03, 0.05, *(0.03 * 4.0**k for k in range(6))])
_WHITE_SHARES = np.array([1.0, *[0.1] * 7])
_N_BY_PLACE = 2

# Keeps logarithms of zero finite.
_TINY = np.finfo(float).tiny


def views_of(Ts_world_parent: FloatArray, Ts_world_child: FloatArray) -> FloatArray:
    """Return the views (N, 13) of stops.

    The columns are the change of the view up to the stop (rad), the rotation matrix over the square
    root of two, and the place. Places are divided by a usual distance: that to the target, and
    between stops.
    """
    positions = se3.translation_of(Ts_world_parent)
    distances_m = np.linalg.norm(se3.translation_of(Ts_world_child), axis=1)
    ways_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    usual_m = np.median(distances_m) + ways_m.sum() / len(positions) + _TINY
    rotations = se3.rotation_of(Ts_world_parent).reshape(-1, 9) / np.sqrt(2.0)
    turns_rad = np.linalg.norm(np.diff(rotations, axis=0), axis=1)
    changes_rad = turns_rad + ways_m / usual_m
    return np.c_[np.cumsum(np.r_[0.0, changes_rad]), rotations, positions / usual_m]


def rest_weights(views: FloatArray) -> FloatArray:
    """Return weights (N,), 1 on average, for the stops.

    Consecutive stops at one place count as one stop: a resting arm gives many such stops.
    """
    # Length of the way up to each stop (rad of view).
    way_rad = views[:, 0]
    first = np.searchsorted(way_rad, way_rad - _RANGES_RAD[0])
    end = np.searchsorted(way_rad, way_rad + _RANGES_RAD[0])
    weights = 1.0 / np.maximum(end - first, 1)
    return np.asarray(weights / weights.mean())


def kernels_of(views: FloatArray) -> FloatArray:
    """Return the correlations (K, N, N) of the errors of stops, by each kernel."""
    places = np.linalg.norm(views[:, None, 1:] - views[:, 1:], axis=2)
    ways = np.abs(np.subtract.outer(views[:, 0], views[:, 0]))
    n_by_way = len(_RANGES_RAD) - _N_BY_PLACE
    distances = np.stack([*[places] * _N_BY_PLACE, *[ways] * n_by_way])
    distances = distances / _RANGES_RAD[:, None, None]
    white = _WHITE_SHARES[:, None, None]
    return np.asarray(white * np.eye(len(views)) + (1.0 - white) * np.exp(-distances))


def kernel_weights(kernels: FloatArray, rows: FloatArray) -> FloatArray:
    """Return the probability (K,) of each kernel, times its variance over that of the white kernel.

    Parameters
    ----------
    kernels : (K, N, N) array
    rows : (N, 6, M + 1) array
        Derivatives of the errors with respect to M values, and the errors in the last column.
    """
    n = len(rows)
    n_columns = rows.shape[2]
    factors = np.linalg.cholesky(kernels)
    whitened = np.linalg.solve(factors, rows.reshape(1, n, -1))
    triangles = np.linalg.qr(whitened.reshape(len(kernels), 6 * n, n_columns), mode="r")
    diagonals = np.abs(np.diagonal(triangles, 0, 1, 2)) + _TINY
    # The last diagonal element is the length of the errors that no values explain.
    log_variances = 2.0 * np.log(diagonals[:, -1])
    logs = -0.5 * (6 * n + 1 - n_columns) * log_variances
    logs = logs - np.log(diagonals[:, :-1] + 1e-9).sum(axis=1)
    logs -= 6.0 * np.log(np.diagonal(factors, 0, 1, 2)).sum(axis=1)
    likelihoods = np.exp(logs - logs.max())
    probabilities = likelihoods / likelihoods.sum()
    return np.asarray(probabilities * np.exp(log_variances - log_variances[0]))
