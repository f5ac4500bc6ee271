"""Regression of windows of a recording on columns of possible faults.

In a window of some seconds, the residuals of a measured stream are

    e_i = sum_k c_ki f_k + nuisances + noise.

The first columns belong to the extrinsic, the others to faults. Each window has nuisances of its
own, such as the pose of its world: they are projected out. Instruments replace columns with noise:
the same columns, computed from the other stream (W. Greene, *Econometric Analysis*, 2012, chapter
8). Weights of windows are robust. A jackknife over blocks of windows estimates the covariance.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.blocks import Blocks, inverse
from hand_eye_calib.core.base.stats import median, robust_weights
from hand_eye_calib.core.geometry import se3

# Shortest window (s), for short recordings, and fewest samples of a window.
_SHORTEST_WINDOW_S = 4.0
_LEAST_SAMPLES = 12
# Windows of a recording that has enough of them, and fewest windows.
_ENOUGH_WINDOWS = 16
_LEAST_WINDOWS = 6

# Stamps of four steps may be off by this share of their duration: others are beside a gap.
_TOLERANCE = 0.3

# Rounds of the robust weights of windows, and the residual with half the weight, in usual ones.
_ROUNDS = 4
_HALF_WEIGHT = 2.0

# Largest number of blocks of the jackknife.
_MOST_BLOCKS = 16


class Column(NamedTuple):
    """Columns of one fault.

    Attributes
    ----------
    sigma : float
        Prior standard deviation of the values. Larger faults are not usual.
    rows : callable
        Columns (W, K, 3, m) of windows.
    instrument : callable, optional
        The same columns from the measured stream.
    """

    sigma: float
    rows: Callable[[Any], FloatArray]
    instrument: Callable[[Any], FloatArray] | None = None


def by_axis(vectors: FloatArray) -> FloatArray:
    """Return one column (..., 3, 3) for each coordinate of vectors (..., 3)."""
    return np.asarray(vectors[..., None] * np.eye(3))


class Split(NamedTuple):
    """Division of N samples into W windows of K samples.

    Attributes
    ----------
    size : int
        K.
    is_enough : (W', ) bool array
        Windows with enough used samples, of all windows W'.
    is_used : (W, K) bool array
        Samples without a gap nearby.
    """

    size: int
    is_enough: BoolArray
    is_used: BoolArray

    def __call__(self, values: FloatArray) -> FloatArray:
        """Return values (W, K, ...) of windows from values (N, ...)."""
        n_windows = len(self.is_enough)
        whole = values[: n_windows * self.size]
        return whole.reshape(n_windows, self.size, *values.shape[1:])[self.is_enough]


def split(stamps_s: FloatArray, spans_s: FloatArray, step: int, longest_s: float) -> Split | None:
    """Divide a recording into windows; return None if it is too short.

    Parameters
    ----------
    stamps_s : (N,) array
    spans_s : (N,) array
        Duration of the four steps around each sample.
    step : int
        Samples of a step.
    longest_s : float
        Duration of a window of a recording that is long enough.
    """
    interval_s = median(np.diff(stamps_s))
    duration_s = interval_s * len(stamps_s)
    window_s = min(longest_s, max(duration_s / _ENOUGH_WINDOWS, _SHORTEST_WINDOW_S))
    size = max(round(window_s / interval_s), _LEAST_SAMPLES)
    n_windows = len(stamps_s) // size
    if n_windows < _LEAST_WINDOWS:
        return None
    usual_s = 4 * step * interval_s
    is_regular = np.abs(spans_s - usual_s) < _TOLERANCE * usual_s
    is_used = is_regular[: n_windows * size].reshape(n_windows, size)
    # Windows with few samples beside gaps do not reveal anything.
    is_enough = is_used.sum(axis=1) >= _LEAST_SAMPLES // 2
    if is_enough.sum() < _LEAST_WINDOWS:
        return None
    return Split(size, is_enough, is_used[is_enough])


class Estimate(NamedTuple):
    """Values (m,) of a fault and their standard deviations (m,)."""

    values: FloatArray
    sigmas: FloatArray


@dataclass(frozen=True)
class Fit:
    """Regression of a stream on the columns of all faults.

    Attributes
    ----------
    blocks : Blocks
        Products of the columns in blocks of time, in units of the noise.
    places : dict
        Places of the columns of each fault. The first are those of the extrinsic.
    weights : (W,) array
        Weights of the windows.
    residual : float
        Usual residual with the extrinsic and without a fault.
    remaining : float
        Usual residual if all faults are possible.
    n_samples : float
        Number of samples, those of windows with less weight counted less.
    nuisances : (W, n) array
        Nuisances of each window, if all faults are possible.
    """

    blocks: Blocks
    places: dict[str, list[int]]
    weights: FloatArray
    residual: float
    remaining: float
    n_samples: float
    nuisances: FloatArray

    @property
    def _of_extrinsic(self) -> list[int]:
        return next(iter(self.places.values()))

    @property
    def _every_column(self) -> list[int]:
        return list(range(self.blocks.sums.shape[-1] - 1))

    @cached_property
    def joint(self) -> Estimate:
        """Estimate of the extrinsic and all faults together."""
        return self._solved(self._every_column)

    def _solved(self, columns: list[int]) -> Estimate:
        sigmas = np.sqrt(np.diag(self.blocks.jackknife(columns)))
        return Estimate(self.blocks.solve(columns), sigmas)

    def estimate(self, name: str) -> Estimate:
        """Return the values of a fault, if all other faults are possible too."""
        places = self.places[name]
        return Estimate(self.joint.values[places], self.joint.sigmas[places])

    def biases(self, name: str) -> FloatArray:
        """Return the bias (m,) that noise of the columns can cause in the values of a fault.

        The noise is assumed to be as large as the noise of the residuals.
        """
        covariance = np.linalg.inv(self.blocks.total[:-1, :-1])
        return np.asarray(self.n_samples * np.abs(np.diag(covariance)[self.places[name]]))

    @property
    def explained_share(self) -> float:
        """Share of the squared residuals with the extrinsic alone that the faults explain."""
        costs = []
        for columns in (self._of_extrinsic, self._every_column):
            x = np.append(-self.blocks.solve(columns), 1.0)
            used = [*columns, -1]
            costs.append(float(x @ self.blocks.total[np.ix_(used, used)] @ x))
        return 1.0 - costs[1] / max(costs[0], 1e-300)

    @property
    def open_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the extrinsic that possible faults leave open."""
        return self.open_to(self._every_column)

    def open_to(self, columns: list[int]) -> FloatArray:
        """Return the covariance (3, 3) of the extrinsic that the faults of some columns leave open.

        The extrinsic moves if these faults are possible, and it is less certain then. Both may have
        one direction, such as the axis that a machine turns about.
        """
        n_values = len(self._of_extrinsic)
        values = self.blocks.solve(columns)[:n_values]
        with_faults = self.blocks.jackknife(columns)[:n_values, :n_values]
        variances, axes = np.linalg.eigh(with_faults - self.blocks.jackknife(self._of_extrinsic))
        added = (axes * np.maximum(variances, 0.0)) @ axes.T
        return np.asarray(np.outer(values, values) + added)


def fit_columns(
    columns: Mapping[str, Column],
    windows: Any,
    is_used: BoolArray,
    residuals: FloatArray,
    nuisances: FloatArray,
) -> Fit:
    """Fit windows with columns of the extrinsic and of all faults.

    Parameters
    ----------
    columns : mapping of str to Column
        The first columns are those of the extrinsic.
    windows : object
        What the columns are computed from.
    is_used : (W, K) bool array
    residuals : (W, K, 3) array
    nuisances : (W, K, 3, n) array
        Columns that each window has for itself.
    """
    rows = [column.rows(windows) for column in columns.values()]
    instruments = [(column.instrument or column.rows)(windows) for column in columns.values()]
    places: dict[str, list[int]] = {}
    information: list[float] = []
    for name, row in zip(columns, rows, strict=True):
        start = len(information)
        information += [columns[name].sigma ** -2] * row.shape[3]
        places[name] = list(range(start, len(information)))
    prior = np.diag([*information, 0.0])
    basis, triangle = np.linalg.qr(_flat([nuisances], is_used))
    target = residuals[..., None]
    joined = [_flat([*table, target], is_used) for table in (rows, instruments)]
    absorbed = [np.swapaxes(basis, 1, 2) @ table for table in joined]
    projected, probes = (table - basis @ part for table, part in zip(joined, absorbed, strict=True))
    products = np.einsum("wkp,wkq->wpq", probes, projected)
    counts = 3.0 * is_used.sum(axis=1)
    known = [*next(iter(places.values())), -1]
    weights = np.ones(len(products))
    for _ in range(_ROUNDS):
        total = Blocks(weights[:, None, None] * products)
        x = np.append(-total.solve(known[:-1]), 1.0)
        squares = np.einsum("i,wij,j->w", x, products[:, known][:, :, known], x) / counts
        usual = max(median(squares), 1e-18)
        weights = robust_weights("cauchy", squares / usual / _HALF_WEIGHT**2) / usual
    blocks = Blocks(weights[:, None, None] * products)
    blocks = blocks.merged(min(len(products), _MOST_BLOCKS))
    with_prior = Blocks(blocks.sums + prior / len(blocks.sums))
    values = with_prior.solve(range(len(information)))
    x = np.append(-values, 1.0)
    remaining = ((projected @ x) ** 2).sum(axis=1) / counts
    of_windows = absorbed[0] @ x
    return Fit(
        blocks=with_prior,
        places=places,
        weights=weights,
        residual=float(np.sqrt(usual)),
        remaining=float(np.sqrt(median(remaining))),
        n_samples=float(usual * weights @ counts / 3.0),
        nuisances=se3.times(inverse(triangle), of_windows),
    )


def _flat(tables: list[FloatArray], is_used: BoolArray) -> FloatArray:
    """Join tables (W, K, 3, m) of columns to one table (W, 3 K, p), zero where not used."""
    joined = is_used[..., None, None] * np.concatenate(tables, axis=3)
    return np.reshape(joined, (len(joined), -1, joined.shape[3]))
