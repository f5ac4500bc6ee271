"""Detect that the target or the camera moved between two stops.

The hypothesis is that X or Z has another value from a certain stop on. The change is fitted at the
stops of a coarse grid, in the order of the stops. Errors are linearised about the solution without
a movement. The size of the change in standard deviations is a Wald statistic.
"""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.checks.findings import Finding, finding
from hand_eye_calib.extras.stops.closed_form import Stops
from hand_eye_calib.extras.stops.error_components import fit_linear
from hand_eye_calib.extras.stops.lasting_errors import (
    rest_weights,
    views_of_stops,
)
from hand_eye_calib.extras.stops.robot_world import RobotWorld, rows_of
from hand_eye_calib.extras.stops.rough_fit import MAX_COMPARED

# Grid of the search: shares of the stops before a movement.
_SHARES = np.arange(1, 8) / 8.0

# Fewest stops on each side of a movement.
_MIN_PART = 4

# Degrees of freedom of Student's t distribution of the errors. The tails are heavy, because stops
# near the movement may be in the wrong part.
_DEGREES = 4.0

# A part consists of outliers if the median weight of its stops is smaller than this.
_MIN_WEIGHT = 0.3

# Smallest squared size of a movement, in standard deviations (six values): this number plus the
# next number divided by the number of stops, because few stops hardly determine the variances.
# Largest value on the grid without a movement: 32 for simulated stops and for stops of KinHEC with
# noise; 67 for an arm of 30 stops with errors of its lengths and angles.
_MIN_SQUARED = 40.0
_MIN_SQUARED_TIMES_STOPS = 600.0

# Smallest translation (m) that is a movement. In KinHEC, errors of the lengths and angles of an arm
# look like movements of up to 0.0094 m and 0.3 deg.
_MIN_SHIFT_M = 0.015
# Smallest rotation (rad) that is a movement.
_MIN_TURN_RAD = 0.026

# Number of columns: derivatives with respect to X (6), Z (6) and the scale.
_N_COLUMNS = 13
# Columns of the part that moves: X or Z.
_PARTS = {"camera": slice(0, 6), "target": slice(6, 12)}

# Names of the moved parts for two sensors without an arm.
_SENSOR_PARTS = {
    "camera": "the child on the parent",
    "target": "the world of one sensor",
}


@dataclass(frozen=True)
class _Movement:
    """Change of the camera (X) or of the target (Z).

    Attributes
    ----------
    part : str
        "camera" or "target".
    start : int
        Row of the first stop after the movement.
    change : (6,) array
        Right perturbation of X or Z.
    squared : float
        Squared size of the change, in standard deviations.
    """

    part: str
    start: int
    change: FloatArray
    squared: float


def check_movement(
    stops: Stops, fit: RobotWorld, is_arm: bool
) -> Finding | None:
    """Return a finding if the camera or the target has clearly moved between two stops."""
    n = len(stops)
    sampled = np.unique(
        np.linspace(0, n - 1, min(n, MAX_COMPARED)).astype(np.int64)
    )
    movements = _movements(stops[sampled], fit)
    if not movements:
        return None
    movement = max(movements, key=lambda movement: movement.squared)
    shift_m = float(np.linalg.norm(movement.change[:3]))
    turn_rad = float(np.linalg.norm(movement.change[3:]))
    is_clear = movement.squared > _MIN_SQUARED + _MIN_SQUARED_TIMES_STOPS / len(
        sampled
    )
    is_small = shift_m < _MIN_SHIFT_M and turn_rad < _MIN_TURN_RAD
    if is_small or not is_clear:
        return None
    return finding(
        "moved_stops",
        what=f"the {movement.part}" if is_arm else _SENSOR_PARTS[movement.part],
        size_mm=1e3 * shift_m,
        turn_deg=float(np.degrees(turn_rad)),
        number=int(sampled[movement.start]) + 1,
        n_stops=n,
    )


def _movements(stops: Stops, fit: RobotWorld) -> list[_Movement]:
    """Return the fits of a movement of camera or target, at each stop of the grid."""
    n = len(stops)
    rows = rows_of(stops, fit)
    errors = rows[:, :, _N_COLUMNS]
    weights = rest_weights(
        views_of_stops(stops.Ts_world_parent, stops.Ts_world_child)
    )
    variances = np.square([fit.level_m, fit.level_rad])
    starts = np.unique(np.round(_SHARES * n).astype(np.int64))
    movements = []
    for start in starts[(starts >= _MIN_PART) & (starts <= n - _MIN_PART)]:
        for part, columns in _PARTS.items():
            after = rows[:, :, columns].copy()
            after[:start] = 0.0
            jacobian = np.concatenate([rows[:, :, :_N_COLUMNS], after], axis=2)
            linear = fit_linear(
                stops, errors, jacobian, variances, weights, _DEGREES
            )
            typical = min(
                median(linear.weights[:start]), median(linear.weights[start:])
            )
            if typical < _MIN_WEIGHT:
                continue
            change = linear.values[_N_COLUMNS:]
            covariance = linear.covariance[_N_COLUMNS:, _N_COLUMNS:]
            squared = float(change @ np.linalg.solve(covariance, change))
            movements.append(_Movement(part, int(start), change, squared))
    return movements
