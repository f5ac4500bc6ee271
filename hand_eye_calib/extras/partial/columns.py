"""Linear regression of residuals on the extrinsic and on possible faults of a stream.

In a window of some seconds, the residual of sample i of a measured stream is

    e_i = sum_k c_ki f_k + nuisances + noise.

The column c_k is the derivative of the residuals with respect to the unknown f_k. The first
unknowns correct the extrinsic; the others are sizes of faults, such as a delay. Each window also
has unknowns of its own, such as the pose of its world: these nuisances are projected out. A column
with noise has an instrument, the same column computed from the other stream (W. Greene,
*Econometric Analysis*, 2012, chapter 8). The windows have robust weights. A jackknife over blocks
of windows estimates the covariance.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.blocks import Blocks, inverse
from hand_eye_calib.core.base.stats import median, robust_weights
from hand_eye_calib.core.geometry import se3

# Shortest window (s), for short recordings.
_MIN_WINDOW_S = 4.0
# Fewest samples in a window. At least half of them must be used.
_MIN_SAMPLES = 12
# Windows of a short recording become shorter, so that there are at least this number of them.
_ENOUGH_WINDOWS = 16
# Fewest windows in a regression.
_MIN_WINDOWS = 6

# A sample is skipped if the duration of the four steps around it deviates from the usual duration
# by more than this share: a gap is nearby.
_MAX_DEVIATION = 0.3

# Number of iterations of the robust weights.
_N_ITERATIONS = 4
# A window whose residual has this size, in median residuals, gets half of the full weight.
_HALF_WEIGHT = 2.0

# Largest number of blocks for the jackknife.
_MAX_BLOCKS = 16


class Column(NamedTuple):
    """Columns of the m unknowns of one fault.

    Attributes
    ----------
    sigma : float
        Prior standard deviation of the unknowns, in their unit: the usual size of the fault.
    rows : callable
        Function that computes the columns (W, K, 3, m) of the windows.
    instrument : callable, optional
        Function that computes the same columns from the other stream. By default, the columns are
        their own instrument.
    """

    sigma: float
    rows: Callable[[Any], FloatArray]
    instrument: Callable[[Any], FloatArray] | None = None


def by_axis(vectors: FloatArray) -> FloatArray:
    """Return vectors (..., 3) as diagonal matrices (..., 3, 3): one column per coordinate."""
    return vectors[..., None] * np.eye(3)


class Split(NamedTuple):
    """Division of N samples into W windows of K samples.

    Attributes
    ----------
    size : int
        Number K of samples in a window.
    is_enough : (W',) bool array
        Which of all W' windows of the recording have enough used samples. Only those W windows are
        kept.
    is_used : (W, K) bool array
        Samples that are not near a gap.
    """

    size: int
    is_enough: BoolArray
    is_used: BoolArray

    def __call__(self, values: FloatArray) -> FloatArray:
        """Return the values (N, ...) of all samples, divided into windows (W, K, ...)."""
        n_windows = len(self.is_enough)
        whole = values[: n_windows * self.size]
        windows = whole.reshape(n_windows, self.size, *values.shape[1:])
        return windows[self.is_enough]


def split(
    stamps_s: FloatArray, spans_s: FloatArray, step: int, longest_s: float
) -> Split | None:
    """Divide a recording into windows; return None if the recording is too short.

    Parameters
    ----------
    stamps_s : (N,) array
    spans_s : (N,) array
        Duration of the four steps around each sample, from which derivatives are computed.
    step : int
        Number of sample intervals of a step.
    longest_s : float
        Duration of a window if the recording is long enough.
    """
    interval_s = median(np.diff(stamps_s))
    duration_s = interval_s * len(stamps_s)
    window_s = min(longest_s, max(duration_s / _ENOUGH_WINDOWS, _MIN_WINDOW_S))
    size = max(round(window_s / interval_s), _MIN_SAMPLES)
    n_windows = len(stamps_s) // size
    if n_windows < _MIN_WINDOWS:
        return None
    usual_s = 4 * step * interval_s
    is_regular = np.abs(spans_s - usual_s) < _MAX_DEVIATION * usual_s
    is_used = is_regular[: n_windows * size].reshape(n_windows, size)
    # A window with many gaps has too few samples for its nuisances.
    is_enough = is_used.sum(axis=1) >= _MIN_SAMPLES // 2
    if is_enough.sum() < _MIN_WINDOWS:
        return None
    return Split(size, is_enough, is_used[is_enough])


class Estimate(NamedTuple):
    """Estimated unknowns (m,) of a fault, and their standard deviations (m,)."""

    values: FloatArray
    sigmas: FloatArray


@dataclass(frozen=True)
class Fit:
    """Result of the regression of a stream on the extrinsic and all faults.

    Attributes
    ----------
    blocks : Blocks
        Normal equations of each block of time: products of the columns and of the residuals (last),
        divided by the variance of the noise.
    places : dict
        Indices of the columns of each fault. The first entry is the extrinsic.
    weights : (W,) array
        Weights of the windows, divided by the variance of the noise.
    residual : float
        Root of the median squared residual of the windows, if only the extrinsic is estimated.
    remaining : float
        The same value if all faults are also estimated.
    n_samples : float
        Number of samples, where a window counts by its weight.
    nuisances : (W, n) array
        Estimated nuisances of each window, if all faults are also estimated.
    """

    blocks: Blocks
    places: dict[str, list[int]]
    weights: FloatArray
    residual: float
    remaining: float
    n_samples: float
    nuisances: FloatArray

    @property
    def _extrinsic_columns(self) -> list[int]:
        return next(iter(self.places.values()))

    @property
    def _every_column(self) -> list[int]:
        n_columns = self.blocks.sums.shape[-1] - 1
        return list(range(n_columns))

    @cached_property
    def joint(self) -> Estimate:
        """Estimate of the extrinsic and all faults together."""
        return self._solved(self._every_column)

    def _solved(self, columns: list[int]) -> Estimate:
        sigmas = np.sqrt(np.diag(self.blocks.jackknife(columns)))
        return Estimate(self.blocks.solve(columns), sigmas)

    def estimate(self, name: str) -> Estimate:
        """Return the estimate of a fault from the regression on all faults together."""
        places = self.places[name]
        return Estimate(self.joint.values[places], self.joint.sigmas[places])

    def biases(self, name: str) -> FloatArray:
        """Return the largest bias (m,) of a fault's values by noise in the columns.

        Noise in a column reduces its estimate (errors in variables). The noise is assumed to be as
        large as the residuals.
        """
        information = self.blocks.total[:-1, :-1]
        variances = np.diag(np.linalg.inv(information))
        return self.n_samples * np.abs(variances[self.places[name]])

    @property
    def explained_share(self) -> float:
        """Share by which the faults reduce the sum of squared residuals."""
        without_faults = self._cost(self._extrinsic_columns)
        return 1.0 - self._cost(self._every_column) / max(
            without_faults, 1e-300
        )

    def _cost(self, columns: list[int]) -> float:
        """Return the sum of squared residuals after some columns were fitted."""
        # The sum is x' P x, with the products P of columns and residuals, and x = (-estimate, 1).
        x = np.append(-self.blocks.solve(columns), 1.0)
        used = [*columns, -1]
        return float(x @ self.blocks.total[np.ix_(used, used)] @ x)

    @property
    def open_covariance(self) -> FloatArray:
        """Covariance (3, 3) that all possible faults together add to the extrinsic."""
        return self.open_to(self._every_column)

    def open_to(self, columns: list[int]) -> FloatArray:
        """Return the covariance (3, 3) that the faults of some columns add to the extrinsic.

        If these faults are also estimated, the extrinsic shifts, and its covariance grows. The
        result is the sum of the squared shift and of the growth. It may have a single direction,
        such as the axis about which a machine turns.
        """
        n_values = len(self._extrinsic_columns)
        shift = self.blocks.solve(columns)[:n_values]
        with_faults = self.blocks.jackknife(columns)[:n_values, :n_values]
        without_faults = self.blocks.jackknife(self._extrinsic_columns)
        variances, axes = np.linalg.eigh(with_faults - without_faults)
        # By chance, some variances become smaller. They add nothing.
        growth = (axes * np.maximum(variances, 0.0)) @ axes.T
        return np.outer(shift, shift) + growth


def _places_of(
    columns: Mapping[str, Column], tables: Sequence[FloatArray]
) -> tuple[dict[str, list[int]], list[float]]:
    """Return the indices of the values of each fault, and the prior information on all values."""
    places: dict[str, list[int]] = {}
    information: list[float] = []
    for (name, column), table in zip(columns.items(), tables, strict=True):
        start = len(information)
        information += [column.sigma**-2] * table.shape[3]
        places[name] = list(range(start, len(information)))
    return places, information


def fit_columns(
    columns: Mapping[str, Column],
    windows: Any,
    is_used: BoolArray,
    residuals: FloatArray,
    nuisances: FloatArray,
) -> Fit:
    """Estimate the extrinsic and all faults from the residuals of all windows.

    Parameters
    ----------
    columns : mapping of str to Column
        Columns of each unknown. The first entry is the extrinsic.
    windows : object
        Argument of the functions of the columns.
    is_used : (W, K) bool array
        Samples that are not near a gap.
    residuals : (W, K, 3) array
    nuisances : (W, K, 3, n) array
        Columns of the unknowns that each window has on its own.
    """
    tables = [column.rows(windows) for column in columns.values()]
    instruments = []
    for column, table in zip(columns.values(), tables, strict=True):
        instrument = column.instrument
        instruments.append(instrument(windows) if instrument else table)
    places, information = _places_of(columns, tables)
    prior = np.diag([*information, 0.0])
    # Project the nuisances out, with an orthonormal basis (W, 3 K, n).
    basis, triangle = np.linalg.qr(_flat([nuisances], is_used))
    to_basis = np.swapaxes(basis, 1, 2)
    target = residuals[..., None]
    data = _flat([*tables, target], is_used)
    in_basis = to_basis @ data
    data = data - basis @ in_basis
    probes = _flat([*instruments, target], is_used)
    probes = probes - basis @ (to_basis @ probes)
    products = np.einsum("wkp,wkq->wpq", probes, data)
    counts = 3.0 * is_used.sum(axis=1)
    weights, usual = _window_weights(
        products, next(iter(places.values())), counts
    )
    blocks = Blocks(weights[:, None, None] * products)
    blocks = blocks.merged(min(len(products), _MAX_BLOCKS))
    with_prior = Blocks(blocks.sums + prior / len(blocks.sums))
    values = with_prior.solve(range(len(information)))
    x = np.append(-values, 1.0)
    remaining = ((data @ x) ** 2).sum(axis=1) / counts
    return Fit(
        blocks=with_prior,
        places=places,
        weights=weights,
        residual=float(np.sqrt(usual)),
        remaining=float(np.sqrt(median(remaining))),
        n_samples=float(usual * weights @ counts / 3.0),
        nuisances=se3.times(inverse(triangle), in_basis @ x),
    )


def _window_weights(
    products: FloatArray, extrinsic: list[int], counts: FloatArray
) -> tuple[FloatArray, float]:
    """Return robust weights (W,) of windows by their residuals after the extrinsic was fitted.

    Parameters
    ----------
    products : (W, p, p) array
        Products of the columns and of the residuals, which are last.
    extrinsic : list of int
        Columns of the extrinsic.
    counts : (W,) array
        Number of residuals of each window.

    Returns
    -------
    weights : (W,) array
        Weights, divided by the median squared residual.
    usual : float
        Median squared residual.
    """
    used = [*extrinsic, -1]
    of_extrinsic = products[:, used][:, :, used]
    weights = np.ones(len(products))
    for _ in range(_N_ITERATIONS):
        total = Blocks(weights[:, None, None] * products)
        x = np.append(-total.solve(extrinsic), 1.0)
        squares = np.einsum("i,wij,j->w", x, of_extrinsic, x) / counts
        usual = max(median(squares), 1e-18)
        weights = (
            robust_weights("cauchy", squares / usual / _HALF_WEIGHT**2) / usual
        )
    return weights, usual


def _flat(tables: list[FloatArray], is_used: BoolArray) -> FloatArray:
    """Join tables (W, K, 3, m) of columns into one table (W, 3 K, p).

    Rows of unused samples are zero.
    """
    joined = is_used[..., None, None] * np.concatenate(tables, axis=3)
    return np.reshape(joined, (len(joined), -1, joined.shape[3]))
