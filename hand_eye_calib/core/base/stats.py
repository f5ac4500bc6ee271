"""Quantiles and robust weights.

Quantiles of data are computed here, because the functions of NumPy import ``numpy.ma``, which takes
a tenth of the import time of NumPy. Quantiles of distributions are tables: the import of SciPy's
functions takes longer than a comparison of results.
"""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray

# Median of the absolute value of a standard normal variable.
MEDIAN_NORMAL = 0.6745
# Median length of a standard normal vector in three dimensions.
MEDIAN_LENGTH = 1.538

# Quantiles of chi-square, by the probability of a larger value and the degrees of freedom.
CHI2 = {
    0.5: {1: 0.455, 6: 5.348},
    0.01: {1: 6.63, 2: 9.21, 3: 11.34, 4: 13.28, 5: 15.09, 6: 16.81},
    0.001: {6: 22.457744},
}
# The largest absolute value of six standard normal variables exceeds this in one of 200 cases.
LARGEST_OF_SIX = 3.341479

# Quantile 0.9 of the standard normal distribution. An estimate exceeds a limit in nine of ten cases
# if its expected value is this number of standard deviations above the limit.
NINE_TIMES_OUT_OF_TEN = 1.281552

# Degrees of freedom of Student's t distribution, as a model of heavy tails.
STUDENT = 4.0

# In a regression, singular values below this share of the largest one are rounding.
_RANK_TOLERANCE = 1e-9

# Smallest unit of residuals in a robust regression. It is for exact data.
_SMALLEST_UNIT = 1e-12


def median(values: ArrayLike) -> float:
    """Return the median of finite values of any shape; NaN if there are no values.

    For a few hundred values, this takes a fraction of the time of ``numpy.median``.
    """
    flat = np.asarray(values, dtype=np.float64).ravel()
    return float(medians(flat)) if flat.size else np.nan


def medians(values: FloatArray) -> FloatArray:
    """Return the medians (...) of finite values (..., K), K >= 1."""
    count = values.shape[-1]
    half = count // 2
    if count % 2:
        parted = np.partition(values, half, axis=-1)
        return np.asarray(parted[..., half])
    parted = np.partition(values, (half - 1, half), axis=-1)
    in_the_middle = parted[..., half - 1] + parted[..., half]
    return np.asarray(0.5 * in_the_middle)


def masked_medians(values: FloatArray, is_used: BoolArray) -> FloatArray:
    """Return the medians (...) of the values (..., K) inside a mask of the same shape."""
    ascending = np.sort(np.where(is_used, values, np.inf), axis=-1)
    counts = is_used.sum(axis=-1, keepdims=True)
    below = np.take_along_axis(ascending, (counts - 1) // 2, axis=-1)
    above = np.take_along_axis(ascending, counts // 2, axis=-1)
    return np.asarray(0.5 * (below + above)[..., 0])


def quantile(values: ArrayLike, share: float) -> float:
    """Return the quantile of at least one finite value, for a probability from 0 to 1.

    The values may have any shape. The quantile is interpolated linearly between two values, like
    ``numpy.quantile``, but faster.
    """
    flat = np.asarray(values, dtype=np.float64).ravel()
    rank = share * (len(flat) - 1)
    low = int(rank)
    high = min(low + 1, len(flat) - 1)
    parted = np.partition(flat, (low, high))
    return float(parted[low] + (rank - low) * (parted[high] - parted[low]))


def robust_sigma(vectors: FloatArray) -> FloatArray:
    """Return robust standard deviations (...) per axis, each from K vectors (..., K, 3)."""
    lengths = np.linalg.norm(vectors, axis=-1)
    return medians(lengths) / MEDIAN_LENGTH


def share_of_step(n_components: int) -> float:
    """Return the share of a small change that one step with fixed Student weights achieves.

    The weight of a residual decreases with its size, so the score grows less than the fixed weight
    times the residual. ``n_components`` is the number of components of a residual. K. L. Lange, R.
    J. A. Little, J. M. G. Taylor, *Robust statistical modeling using the t distribution*, JASA 84,
    1989.
    """
    return (STUDENT + n_components) / (STUDENT + n_components + 2.0)


def student_weights(
    squared: FloatArray, degrees: float = STUDENT
) -> FloatArray:
    """Return weights by Student's t distribution for vectors of six values. Their mean is 1.

    K. L. Lange, R. J. A. Little, J. M. G. Taylor, *Robust statistical modeling using the t
    distribution*, JASA 84, 1989, eq. 4.

    Parameters
    ----------
    squared : (...) array
        Squared Mahalanobis distance of each vector.
    degrees : float
        Degrees of freedom.
    """
    return (degrees + 6.0) / (degrees + squared)


# Weight functions by kind. Their argument is the squared residual; see :func:`robust_weights`.
_WEIGHTS: Mapping[str, Callable[[FloatArray], FloatArray]] = {
    # P. J. Huber, *Robust estimation of a location parameter*, Ann. Math. Statist. 35, 1964.
    "huber": lambda squared: np.asarray(
        1.0 / np.maximum(np.sqrt(squared), 1.0)
    ),
    # P. W. Holland, R. E. Welsch, *Robust regression using iteratively reweighted least-squares*,
    # Comm. Statist. A 6, 1977, table 1.
    "cauchy": lambda squared: 1.0 / (1.0 + squared),
    # S. Geman, D. E. McClure, *Statistical methods for tomographic image reconstruction*, Bulletin
    # of the International Statistical Institute 52, 1987.
    "geman_mcclure": lambda squared: 1.0 / (1.0 + squared) ** 2,
    "student": student_weights,
}


def robust_weights(kind: str, squared: FloatArray) -> FloatArray:
    """Return weights of residuals for iteratively reweighted least squares.

    Parameters
    ----------
    kind : {"huber", "cauchy", "geman_mcclure", "student"}
        Weight function. Weights are at most 1; only ``student`` differs: its weights have the mean
        1 for vectors of six values.
    squared : (...) array
        Squared residuals. A squared residual of 1 has the weight 1/2 for ``cauchy``, 1/4 for
        ``geman_mcclure``, and 1 for ``huber`` (also below 1). For ``student``: squared Mahalanobis
        distances.

    Examples
    --------
    >>> robust_weights("cauchy", np.array([0.0, 1.0, 9.0])).tolist()
    [1.0, 0.5, 0.1]
    """
    return _WEIGHTS[kind](squared)


def robust_regression(
    kind: str,
    rows: FloatArray,
    targets: FloatArray,
    rounds: int,
    unit: Callable[[FloatArray], float],
) -> tuple[FloatArray, FloatArray]:
    """Solve ``rows @ x = targets`` by iteratively reweighted least squares.

    Parameters
    ----------
    kind : str
        Kind of weights, see :func:`robust_weights`.
    rows : (K, d, p) array
    targets : (K, d) array
    rounds : int
        Number of iterations.
    unit : callable
        Function ``unit(lengths)`` that returns the unit of residuals for the weight function, from
        the lengths (K,) of all residuals.

    Returns
    -------
    values : (p,) array
    lengths : (K,) array
        Lengths of the residuals.
    """
    weights = np.ones(len(rows))
    for _ in range(rounds):
        roots = np.sqrt(weights)[:, None]
        scaled_rows = (roots[..., None] * rows).reshape(-1, rows.shape[2])
        scaled_targets = (roots * targets).ravel()
        values, *_ = np.linalg.lstsq(
            scaled_rows, scaled_targets, rcond=_RANK_TOLERANCE
        )
        lengths = np.linalg.norm(rows @ values - targets, axis=1)
        divisor = max(unit(lengths), _SMALLEST_UNIT)
        weights = robust_weights(kind, (lengths / divisor) ** 2)
    return np.asarray(values, dtype=float), lengths


def chi_square_quantile(tail: float) -> float:
    """Return the value that chi-square (6 degrees of freedom) exceeds with probability ``tail``.

    ``tail`` is between 1e-30 and 0.99. Chi-square exceeds 2 h with the probability ``exp(-h) (1 + h
    + h^2 / 2)``. The negative logarithm of this probability is convex and increases with h. So
    Newton's method converges from above, in at most ten steps.
    """
    half = 10.0 - 2.0 * np.log(tail)
    for _ in range(20):
        series = 1.0 + half + half**2 / 2
        excess = half - np.log(series) + np.log(tail)
        half -= excess * series / (half**2 / 2)
    return 2.0 * float(half)
