"""Regression of positions beside poses on columns of possible faults.

In a window of some seconds, the measured positions are

    q_i = A (R_i l + t_i) + a + sum_k f_k c_ki + noise

with the poses (R_i, t_i) of the odometry, the lever arm l, and the pose (A, a) of its world in the
world of the positions. Errors of (A, a) are projected out of each window. The column c_k is what a
fault f_k adds: the coordinates for a wrong scale of an axis, the velocities for a delay, the
accelerations for smoothing. Any low-pass filter has the response ``1 - i w d - w^2 c`` at low
angular frequencies w, with a delay d and a smoothing c.

Accelerations come from the poses, and those of the measured positions are their instrument: the
noise of both is independent, so that neither noise nor drift looks like smoothing (W. Greene,
*Econometric Analysis*, 2012, chapter 8).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.blocks import Blocks
from hand_eye_calib.core.base.stats import median, robust_weights
from hand_eye_calib.core.geometry import se3

# Duration of a window (s): an odometry drifts little in it, and a machine turns.
_WINDOW_S = 10.0
# Shortest window (s), for short recordings, and fewest positions of a window.
_SHORTEST_WINDOW_S = 4.0
_LEAST_POSITIONS = 12
# Windows of a recording that has enough of them, and fewest windows.
_ENOUGH_WINDOWS = 16
_LEAST_WINDOWS = 6

# Step (s) of the differences that accelerations come from; one interval if that is longer.
_STEP_S = 0.2
# Stamps of four steps may be off by this share of their duration: others are beside a gap.
_TOLERANCE = 0.3

# Range below which a coordinate is constant (m).
_CONSTANT_M = 1e-6

# Rounds of the robust weights of windows, and the residual with half the weight, in usual ones.
_ROUNDS = 4
_HALF_WEIGHT = 2.0

# Largest number of blocks of the jackknife.
_MOST_BLOCKS = 16


class _Windows(NamedTuple):
    """Aligned windows (W, K) of positions, in the world of the positions.

    Attributes
    ----------
    is_used : (W, K) bool array
        Positions without a gap nearby.
    rotations : (W, K, 3, 3) array
        Of the sensor with poses.
    path : (W, K, 3) array
        Predicted positions less their mean.
    residuals : (W, K, 3) array
        Measured less predicted positions.
    velocities, accelerations : (W, K, 3) array
        Of the predicted positions.
    measured_accelerations : (W, K, 3) array
        Of the measured positions.
    """

    is_used: BoolArray
    rotations: FloatArray
    path: FloatArray
    residuals: FloatArray
    velocities: FloatArray
    accelerations: FloatArray
    measured_accelerations: FloatArray


class Column(NamedTuple):
    """Columns of one fault.

    Attributes
    ----------
    sigma : float
        Prior standard deviation of the values. Larger faults are not usual.
    rows : callable
        Columns (W, K, 3, m) of windows.
    instrument : callable, optional
        The same columns from the measured positions.
    """

    sigma: float
    rows: Callable[[_Windows], FloatArray]
    instrument: Callable[[_Windows], FloatArray] | None = None


def _by_axis(vectors: FloatArray) -> FloatArray:
    """Return one column (..., 3, 3) for each coordinate of vectors (..., 3)."""
    return np.asarray(vectors[..., None] * np.eye(3))


#: Columns by the names of the faults.
COLUMNS = {
    # Metres.
    "lever_arm": Column(100.0, lambda windows: windows.rotations),
    # Factor of each coordinate, less 1.
    "scales": Column(1.0, lambda windows: _by_axis(windows.path)),
    # Delay of each coordinate, s.
    "delays": Column(1.0, lambda windows: _by_axis(-windows.velocities)),
    # Smoothing, s^2.
    "smoothing": Column(
        0.1,
        lambda windows: windows.accelerations[..., None],
        lambda windows: windows.measured_accelerations[..., None],
    ),
}


class Estimate(NamedTuple):
    """Values (m,) of a fault and their standard deviations (m,)."""

    values: FloatArray
    sigmas: FloatArray


@dataclass(frozen=True)
class PositionFit:
    """Regression of positions on the columns of all faults.

    Attributes
    ----------
    blocks : Blocks
        Products of the columns in blocks of time, in units of the noise.
    places : dict
        Places of the columns of each fault.
    residual_m : float
        Usual residual with a lever arm and without a fault, m.
    is_constant : (3,) bool array
        Coordinates that are the same in all measured positions.
    path_m : float
        Root mean square distance from the mean of a window.
    spreads_m : (3,) array
        The same along each coordinate, without what the other columns explain.
    speeds_m_s : (3,) array
        Root mean square speed along each coordinate.
    acceleration_m_s2 : float
        Root mean square acceleration.
    """

    blocks: Blocks
    places: dict[str, list[int]]
    residual_m: float
    is_constant: BoolArray
    path_m: float
    spreads_m: FloatArray
    speeds_m_s: FloatArray
    acceleration_m_s2: float

    @property
    def _every_column(self) -> list[int]:
        return list(range(self.blocks.sums.shape[-1] - 1))

    @cached_property
    def _whole(self) -> Estimate:
        return self._solved(self._every_column)

    def _solved(self, columns: list[int]) -> Estimate:
        sigmas = np.sqrt(np.diag(self.blocks.jackknife(columns)))
        return Estimate(self.blocks.solve(columns), sigmas)

    def estimate(self, name: str) -> Estimate:
        """Return the values of a fault, if all other faults are possible too."""
        places = self.places[name]
        return Estimate(self._whole.values[places], self._whole.sigmas[places])

    @property
    def explained_share(self) -> float:
        """Share of the squared residuals with a lever arm alone that the faults explain."""
        costs = []
        for columns in (self.places["lever_arm"], self._every_column):
            x = np.append(-self.blocks.solve(columns), 1.0)
            used = [*columns, -1]
            costs.append(float(x @ self.blocks.total[np.ix_(used, used)] @ x))
        return 1.0 - costs[1] / max(costs[0], 1e-300)

    @property
    def open_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the lever arm that possible faults leave open, m^2.

        The lever arm moves if all faults are possible, and it is less certain then.
        """
        moved = self.estimate("lever_arm")
        alone = self._solved(self.places["lever_arm"])
        added = np.maximum(moved.sigmas**2 - alone.sigmas**2, 0.0)
        return np.asarray(np.outer(moved.values, moved.values) + np.diag(added))


def fit(
    stamps_ns: IntArray, poses: FloatArray, positions: FloatArray, lever_arm: FloatArray
) -> PositionFit | None:
    """Fit positions with a lever arm and all faults.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    poses : (N, 4, 4) array
        Poses of the other sensor.
    positions : (N, 3) array
        At the same stamps, in the same unit.
    lever_arm : (3,) array
        Best estimate, m. The values of the regression are relative to this estimate.

    Returns
    -------
    PositionFit or None
        None if the recording is too short.
    """
    stamps_s = (stamps_ns - stamps_ns[0]) * 1e-9
    windows = _windows(stamps_s, poses, positions, lever_arm)
    if windows is None:
        return None
    rows, instruments = _rows(windows)
    products = np.einsum("wkp,wkq->wpq", instruments, rows)
    counts = 3.0 * windows.is_used.sum(axis=1)
    places = _places()
    known = [*places["lever_arm"], -1]
    weights = np.ones(len(products))
    for _ in range(_ROUNDS):
        total = Blocks(weights[:, None, None] * products)
        x = np.append(-total.solve(known[:-1]), 1.0)
        squares = np.einsum("i,wij,j->w", x, products[:, known][:, :, known], x) / counts
        usual = max(median(squares), 1e-18)
        weights = robust_weights("cauchy", squares / usual / _HALF_WEIGHT**2) / usual
    blocks = Blocks(weights[:, None, None] * products)
    blocks = blocks.merged(min(len(products), _MOST_BLOCKS))
    information = blocks.total[:-1, :-1] + _prior()[:-1, :-1]
    own = 1.0 / np.abs(np.diag(np.linalg.inv(information)))
    return PositionFit(
        blocks=Blocks(blocks.sums + _prior() / len(blocks.sums)),
        places=places,
        residual_m=float(np.sqrt(usual)),
        is_constant=np.ptp(positions, axis=0) < _CONSTANT_M,
        path_m=float(np.linalg.norm(_root_mean_square(windows.path, windows.is_used))),
        spreads_m=np.sqrt(own[places["scales"]] / (weights @ counts / 3.0)),
        speeds_m_s=_root_mean_square(windows.velocities, windows.is_used),
        acceleration_m_s2=float(
            np.linalg.norm(_root_mean_square(windows.accelerations, windows.is_used))
        ),
    )


def _root_mean_square(vectors: FloatArray, is_used: BoolArray) -> FloatArray:
    """Return the root mean square (3,) of used vectors (W, K, 3)."""
    return np.asarray(np.sqrt((vectors[is_used] ** 2).mean(axis=0)))


def _places() -> dict[str, list[int]]:
    """Return the places of the columns of each fault."""
    places: dict[str, list[int]] = {}
    start = 0
    for name in COLUMNS:
        size = 1 if name == "smoothing" else 3
        places[name] = list(range(start, start + size))
        start += size
    return places


def _prior() -> FloatArray:
    """Return the products (p + 1, p + 1) of the prior: all values are zero."""
    information = []
    for name, places in _places().items():
        information += [COLUMNS[name].sigma ** -2] * len(places)
    return np.diag([*information, 0.0])


def _rows(windows: _Windows) -> tuple[FloatArray, FloatArray]:
    """Return rows and instruments (W, 3 K, p + 1) without the pose of each window's world."""
    residuals = windows.residuals[..., None]
    columns = [column.rows(windows) for column in COLUMNS.values()]
    instruments = [(column.instrument or column.rows)(windows) for column in COLUMNS.values()]
    used = windows.is_used[..., None, None]
    world = np.concatenate(
        [np.broadcast_to(np.eye(3), windows.rotations.shape), se3.skew(windows.path)], axis=3
    )
    n_windows = len(used)
    flat = [
        (used * np.concatenate(table, axis=3)).reshape(
            n_windows, -1, sum(t.shape[3] for t in table)
        )
        for table in ([world], [*columns, residuals], [*instruments, residuals])
    ]
    basis = np.linalg.qr(flat[0])[0]
    projected = [table - basis @ (np.swapaxes(basis, 1, 2) @ table) for table in flat[1:]]
    return projected[0], projected[1]


def _windows(
    stamps_s: FloatArray, poses: FloatArray, positions: FloatArray, lever_arm: FloatArray
) -> _Windows | None:
    """Return aligned windows, or None if the recording is too short."""
    interval_s = median(np.diff(stamps_s))
    duration_s = interval_s * len(stamps_s)
    window_s = min(_WINDOW_S, max(duration_s / _ENOUGH_WINDOWS, _SHORTEST_WINDOW_S))
    size = max(round(window_s / interval_s), _LEAST_POSITIONS)
    n_windows = len(stamps_s) // size
    if n_windows < _LEAST_WINDOWS:
        return None
    step = max(round(_STEP_S / interval_s), 1)
    rotations = se3.rotation_of(poses)
    predicted = se3.times(rotations, lever_arm) + se3.translation_of(poses)
    spans_s, velocities, accelerations = _derivatives(stamps_s, predicted, step)
    measured_accelerations = _derivatives(stamps_s, positions, step)[2]
    usual_s = 4 * step * interval_s
    is_used = np.abs(spans_s - usual_s) < _TOLERANCE * usual_s

    def split(values: Any) -> Any:
        return values[: n_windows * size].reshape(n_windows, size, *values.shape[1:])

    used = split(is_used)
    # Windows with few positions beside gaps do not reveal anything.
    enough = used.sum(axis=1) >= _LEAST_POSITIONS // 2
    if enough.sum() < _LEAST_WINDOWS:
        return None
    used = used[enough]
    path = _centred(split(predicted)[enough], used)
    measured = _centred(split(positions)[enough], used)
    products = np.einsum("wki,wkj,wk->wij", measured, path, used)
    to_world = se3.nearest_rotation(products)[:, None]
    path = se3.times(to_world, path)
    return _Windows(
        is_used=used,
        rotations=to_world @ split(rotations)[enough],
        path=path,
        residuals=measured - path,
        velocities=se3.times(to_world, split(velocities)[enough]),
        accelerations=se3.times(to_world, split(accelerations)[enough]),
        measured_accelerations=split(measured_accelerations)[enough],
    )


def _centred(vectors: FloatArray, used: BoolArray) -> FloatArray:
    """Return vectors (W, K, 3) less the mean of the used ones of each window."""
    counts = used.sum(axis=1)[:, None]
    means = (vectors * used[..., None]).sum(axis=1) / counts
    return np.asarray(vectors - means[:, None])


def _derivatives(
    stamps_s: FloatArray, path: FloatArray, step: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return durations of four steps (N,), velocities and accelerations (N, 3) of a path (N, 3).

    Accelerations do not contain the noise of the position itself.
    """
    rows = np.arange(len(path))
    last = len(path) - 1
    before_2, before, after, after_2 = (np.clip(rows + k * step, 0, last) for k in (-2, -1, 1, 2))
    spans_s = stamps_s[after_2] - stamps_s[before_2]
    step_s = np.maximum(spans_s / 4.0, 1e-9)[:, None]
    velocities = (path[after] - path[before]) / (2.0 * step_s)
    bends = path[after_2] - path[after] - path[before] + path[before_2]
    return spans_s, velocities, bends / (3.0 * step_s**2)
