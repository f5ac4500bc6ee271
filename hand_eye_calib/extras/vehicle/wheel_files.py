"""Read csv files of wheel data, and convert them to the path of a unit vehicle.

The unit vehicle has wheels of radius 1, see :mod:`.wheels`.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hand_eye_calib.core.base.arrays import FloatArray, IntArray, floats
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.extras.vehicle.wheels import UNIT_TRACK, trajectory_of
from hand_eye_calib.formats.files import LONGEST_LINE
from hand_eye_calib.formats.trajectory_files.file_options import FileOptions
from hand_eye_calib.formats.trajectory_files.stamps import stamps_in_ns
from hand_eye_calib.formats.trajectory_files.table import Table

# Kinds of wheel data, by the names of the columns after the stamps.
_COLUMNS = {
    r"left\w*,right\w*": "wheels",
    r"(speed|v|velocity)\w*,(steering|angle)\w*": "steering",
    r"(drive|driven|traction)\w*,(steering|angle)\w*": "tricycle",
    r"vx\w*,wz\w*": "wheel_odometry",
    r"vx\w*,vy\w*,wz\w*": "omni",
}


def _unit_of(column: str) -> float:
    """Return the unit of a column from its name; 1 for rad/s, rad and m/s."""
    units = [
        unit for name, unit in _UNITS.items() if column.endswith(f"_{name}")
    ]
    return units[0] if units else 1.0


def _along_and_across(
    speed: FloatArray, angle: FloatArray
) -> tuple[FloatArray, ...]:
    """Return the rates of a unit vehicle from a speed and a steering angle."""
    return speed * np.cos(angle), 0.0 * speed, speed * np.sin(angle)


# Functions that compute forward speed, left speed and yaw rate of the unit vehicle from the columns
# of wheel data.
_RATES: dict[str, Callable[..., tuple[ArrayLike, ...]]] = {
    "wheels": lambda left, right: (
        (left + right) / 2.0,
        0.0 * left,
        (right - left) / UNIT_TRACK,
    ),
    "steering": _along_and_across,
    "tricycle": _along_and_across,
    "wheel_odometry": lambda speed, turn: (speed, 0.0 * speed, turn),
    "omni": lambda forward, left, turn: (forward, left, turn),
}

# Number of columns of wheel data without the stamps.
_N_COLUMNS = {
    "wheels": 2,
    "steering": 2,
    "tricycle": 2,
    "wheel_odometry": 2,
    "omni": 3,
}

# Units at the end of a column's name, as factors to rad/s, rad or m/s.
_UNITS = {
    "rpm": np.pi / 30.0,
    "deg": np.pi / 180.0,
    "deg_s": np.pi / 180.0,
    "dps": np.pi / 180.0,
    "km_h": 1.0 / 3.6,
    "kmh": 1.0 / 3.6,
    "mm_s": 1e-3,
}

# Ends of the names of columns with counts of an encoder.
_COUNTS = ("ticks", "counts", "pulses", "encoder")

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")


def wheel_trajectory(
    stamps_ns: IntArray, values: ArrayLike, measures: str
) -> Trajectory:
    """Convert wheel data to a parent stream for :func:`hand_eye_calib.calibrate`.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    values : (N, 2) or (N, 3) array
        Values at the stamps: rates of the left and the right wheel (``wheels``); speed of the
        fixed axle and steering angle, rad (``steering``); speed of the steered wheel and its
        angle, rad (``tricycle``); forward speed and yaw rate, rad/s (``wheel_odometry``); or
        forward speed, left speed and yaw rate (``omni``). Rates and speeds are in rad/s of the
        wheels or in m/s.
    measures : {"wheels", "steering", "tricycle", "wheel_odometry", "omni"}

    Returns
    -------
    Trajectory
        Path of the unit vehicle, which has wheels of radius 1, a track of 5 and a wheelbase of 1.

    Raises
    ------
    InputError
        If the stamps do not increase, the values have a wrong number of columns, or a step turns by
        more than half a turn.
    ConfigError
        If ``measures`` is not a kind of wheel data.

    Examples
    --------
    >>> stamps_ns = np.arange(3) * 20_000_000
    >>> hec.wheel_trajectory(stamps_ns, [[1.0, 1.0]] * 3, "wheels")
    Trajectory(3 wheels over 0.040 s, sensor_frame='base_link')
    """
    if measures not in _N_COLUMNS:
        raise ConfigError(
            f"measures must be one of {', '.join(_N_COLUMNS)}; got {measures!r}"
        )
    values = floats("values", values)
    n_columns = _N_COLUMNS[measures]
    if values.shape != (len(stamps_ns), n_columns):
        raise InputError(
            f"{measures} needs values of shape ({len(stamps_ns)}, {n_columns}), a row for each "
            f"stamp; got {values.shape}"
        )
    # Between two stamps, the mean of both rows is used.
    return unit_path(stamps_ns, (values[:-1] + values[1:]) / 2.0, measures)


def unit_rates(measures: str, columns: Iterable[Any]) -> tuple[Any, ...]:
    """Return forward speed, left speed and yaw rate of the unit vehicle from wheel data.

    The arguments are numbers or arrays.
    """
    return _RATES[measures](*columns)


def unit_path(
    stamps_ns: IntArray, means: FloatArray, measures: str
) -> Trajectory:
    """Return the path of the unit vehicle from the wheel data (N - 1, C) between N stamps.

    Raises
    ------
    InputError
        If the stamps do not increase, or a step turns by more than half a turn.
    """
    durations_s = np.diff(stamps_ns) * 1e-9
    if not (durations_s > 0.0).all():
        raise InputError(
            "stamps of wheel data must increase; sort the rows, drop repeated stamps"
        )
    steps = np.stack(unit_rates(measures, means.T)) * durations_s
    if np.abs(steps[2]).max(initial=0.0) > np.pi:
        raise InputError(
            f"wheel speeds of up to {np.abs(means[:, 0]).max():.0f} are too large for rows that "
            f"are {durations_s.max():.3g} s apart; write them in rad/s or m/s, angles in rad"
        )
    return trajectory_of(stamps_ns, steps, measures)


def table_of_wheels(
    path: str | Path, data: bytes, options: FileOptions
) -> Table | None:
    """Read a csv file of wheel data as poses of the unit vehicle; None for other files.

    Raises
    ------
    InputError
        If a row cannot be read, or stamps do not increase.
    """
    first_line = (
        data[:LONGEST_LINE].partition(b"\n")[0].decode(errors="replace")
    )
    line = (
        (options.columns or first_line)
        .strip("\ufeff#% \r")
        .lower()
        .replace(" ", "")
    )
    # With semicolons between the cells, decimal commas are allowed.
    separator = ";" if ";" in first_line else ","
    stamp, *names = line.replace(";", ",").split(",")
    kind, order = _kind_and_order(path, names)
    if not kind:
        return None
    rows = []
    for line_number, text in enumerate(data.decode().splitlines(), 1):
        # Without the option `columns`, the first line has the names.
        if text.strip() and (line_number > 1 or options.columns):
            cells = [cell.replace(",", ".") for cell in text.split(separator)]
            if len(cells) > len(names):
                values_in_order = [cells[1 + column] for column in order]
                cells = [cells[0], *values_in_order]
            rows.append((line_number, [*cells, "0"]))
    # The table reads three values as positions. A zero at the end replaces a missing third value.
    n_values = len(names)
    rates = Table(path, (stamp, "x", "y", "z"), "positions")
    rates.fill(rows, lambda cells: cells[:4])
    values = rates.values()[:, :n_values] * [
        _unit_of(names[column]) for column in order
    ]
    wheels = wheel_trajectory(
        stamps_in_ns(rates, options.stamp_unit), values, kind
    )
    table = Table(
        path, (stamp, *_POSE), "poses", sensor_frame=wheels.sensor_frame
    )
    table.fill_from_arrays(se3.to_rows(wheels.poses), rates.stamps)
    table.measures = kind
    return table


def _kind_and_order(
    path: str | Path, names: Sequence[str]
) -> tuple[str, Sequence[int]]:
    """Return the kind of wheel data, and its columns in the order of this kind.

    ``names`` are those of the columns after the stamps. The kind is empty for other data.

    Raises
    ------
    InputError
        If the columns have counts of encoders, or a column of one wheel alone.
    """
    if len(names) == 1 and re.fullmatch(r"(left|right)\w*", names[0]):
        raise InputError(
            f"{path}: wheels need a column of the left and one of the right; found {names[0]}"
        )
    if len(names) not in _N_COLUMNS.values():
        return "", ()
    for pattern, kind in _COLUMNS.items():
        for order in permutations(range(len(names))):
            if re.fullmatch(pattern, ",".join(names[i] for i in order)):
                _refuse_counts(path, names)
                return kind, order
    return "", ()


def _refuse_counts(path: str | Path, names: Iterable[str]) -> None:
    """Raise an InputError if a column has counts of an encoder, by its name."""
    for name in names:
        if name.endswith(_COUNTS):
            raise InputError(
                f"{path}: {name} has counts of an encoder: convert them to speeds in rad/s, "
                "2 pi * counts in a row / counts of a turn / seconds in a row"
            )
