"""The numbers of a trajectory, row by row, before they become poses: what the columns are by their
names, and what stands in them; and rows as they are written.
"""

import math
import re
from array import array
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import Any, Self

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.config import STAMP_UNITS
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.text import shortened, shown_value
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import ROTATION_TOLERANCE, Trajectory
from hand_eye_calib.formats.files import LONGEST_NAME, write_atomically, writing
from hand_eye_calib.formats.trajectory_files.cells import angle, is_null, number
from hand_eye_calib.formats.trajectory_files.columns import (
    MATRIX,
    POSITION,
    QUATERNION,
    ROTATION,
    SCALAR_FIRST,
    TUM_COLUMNS,
    UNNAMED,
    measured,
    named_columns,
    stamp_columns,
)
from hand_eye_calib.formats.trajectory_files.dates import seconds, stamp_of

# Quantities that are all 0 where there is no orientation, as of tracking that was lost.
_TURNS = (QUATERNION, SCALAR_FIRST, UNNAMED, ROTATION)

# More names than this in a column are those of something else, such as images.
_MOST_SENSORS = 20


@dataclass
class Table:
    """The rows of a file: their line numbers, stamps (none without a column of them), and values,
    one row after the other; the names of their images, if there is a column of them. Rows without
    a pose, with values that are absent or not finite, are left out: ``rows`` are the numbers of
    the others, from 0, ``n_rows`` counts all, ``first_left_out`` is the line of the first.

    ``path`` is what messages call it, ``names`` are those of all columns. ``measures`` says what
    to read, one of registry.MEASURES, "twists" for velocities, or "auto", which becomes what the
    columns are; ``expected`` is what a row should be, for messages. Found are the column of each
    quantity (``at``), such as "x" or "qw", those of the stamp (``stamp_at``) by what they are
    (``stamp_names``), and the ``units`` of quantities and of "t" in the names.
    ``guesses`` are what a person should know of how the file was read, ``conventions`` those of
    its angles that the motion does not contradict, the usual first; ``is_transposable`` if rows
    and columns of its rotations could be exchanged. An InputError if a column is missing, or
    several have the same meaning.
    """

    path: object
    names: Sequence[str]
    measures: str = "auto"
    expected: str = ""
    format: str = "csv"
    is_transposable: bool = False
    line_numbers: "array[int]" = field(default_factory=lambda: array("q"))
    rows: "array[int]" = field(default_factory=lambda: array("q"))
    n_rows: int = 0
    first_left_out: int | None = None
    stamps: list[Decimal] = field(default_factory=list)
    numbers: "array[float]" = field(default_factory=lambda: array("d"))
    images: list[str] = field(default_factory=list)
    guesses: list[str] = field(default_factory=list)
    conventions: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        columns, units = named_columns(self.names)
        self.expected = self.expected or f"{len(self.names)} columns: {self._listed()}"
        self.measures, quantities = measured(columns, self.names, self.measures)
        self.stamp_names = stamp_columns(columns)
        if missing := [name for name in quantities if name not in columns]:
            listed = self._listed()
            has_accelerations = re.search(r", a(cc\w*)?_?x", listed)
            no_pose = " (accelerations show no pose)" if has_accelerations else ""
            raise InputError(
                f"{self.path}: no column for {', '.join(missing)} among {listed}{no_pose}; name "
                "all columns with `columns`, such as t,x,y,z,qw,qx,qy,qz, or roll_deg,pitch_deg,"
                "yaw_deg or rotvec_x,rotvec_y,rotvec_z for turns, or t,wx,wy,wz of a gyroscope; "
                "remove other text above the rows"
            )
        for name in (*self.stamp_names, *quantities):
            if len(columns[name]) > 1:
                raise InputError(
                    f"{self.path}: columns {self._listed(columns[name])} could all be {name}; name "
                    "them with `columns`"
                )
        self.at = {name: columns[name][0] for name in quantities}
        self.stamp_at = [columns[name][0] for name in self.stamp_names]
        self._value_at = [*self.at.values()]
        self._image_at = columns.get("image", ())
        self.units = {name: units[at] for name, at in self.at.items() if units[at]}
        self.units["t"] = ""
        if self.stamp_names == ("secs", "nsecs"):
            self.units["t"] = "ns"
        elif len(self.stamp_at) == 1:
            self.units["t"] = units[self.stamp_at[0]]
        elif self.stamp_at:
            self.units["t"] = "s"
        unit = units[self.stamp_at[-1]] if self.stamp_at else ""
        self.second_unit = unit if unit in STAMP_UNITS else ""
        if "mow" in self.stamp_names:
            self.second_unit = self.second_unit or "ms"
        if self.stamp_names == ("mow",):
            self.units["t"] = self.second_unit
        self._sensor_at = columns.get("sensor", [])[:1]
        self._sensors: set[str] = set()
        turn = next((group for group in _TURNS if {*group} <= {*quantities}), ())
        self._turn_at = [list(quantities).index(name) for name in turn]

    @property
    def n_left_out(self) -> int:
        """How many rows have no pose."""
        return self.n_rows - len(self.rows)

    def _listed(self, places: Iterable[int] | None = None) -> str:
        """The names of some columns, or of all, for a message."""
        names = self.names if places is None else [self.names[k] for k in places]
        return shortened(", ".join(names), LONGEST_NAME)

    def values(self, names: Iterable[str] = ()) -> FloatArray:
        """(N, k) array: the values of some quantities, or of all."""
        places = [*self.at]
        all_values = np.asarray(self.numbers).reshape(-1, len(self.at))
        return all_values[:, [places.index(name) for name in names]] if names else all_values

    def fill(
        self, lines: Iterable[tuple[int, Any]], cells_of: Callable[[Any], Sequence[str]]
    ) -> Self:
        """Add rows from their line numbers and texts; an InputError at the first line with another
        number of cells, or with something that is no number.
        """
        n_columns = len(self.names)
        for line_number, text in lines:
            cells = cells_of(text)
            if len(cells) != n_columns:
                cells = self._as_many_as_columns(cells, line_number, text)
            try:
                self._add(cells, line_number)
            except ValueError as error:
                reason = f"expected {self.expected}; {shortened(str(error))}"
                raise InputError(f"{self.path}, line {line_number}: {reason}") from None
        self._refuse_several_sensors()
        return self

    def _refuse_several_sensors(self) -> None:
        """Raise an InputError if a column names few sensors, but more than one."""
        if 1 < len(self._sensors) <= _MOST_SENSORS:
            column = self.names[self._sensor_at[0]]
            listed = shortened(", ".join(sorted(self._sensors)), LONGEST_NAME)
            raise InputError(
                f"{self.path}: poses of several sensors, {column} {listed}; write a file for each"
            )

    def _add(self, cells: Sequence[str], line_number: int) -> None:
        """Add a row, or count it if it has no pose; a ValueError for what is no number."""
        row = self.n_rows
        self.n_rows += 1
        values = self._numbers_in(cells)
        if not self._is_pose(values) or not self._add_stamp(cells):
            if self.first_left_out is None:
                self.first_left_out = line_number
            return
        self.numbers.extend(values)
        if self._image_at:
            self.images.append(cells[self._image_at[0]])
        if self._sensor_at and len(self._sensors) <= _MOST_SENSORS:
            self._sensors.add(cells[self._sensor_at[0]])
        self.line_numbers.append(line_number)
        self.rows.append(row)

    def _add_stamp(self, cells: Sequence[str]) -> bool:
        """Add the stamp of a row, and return whether it has one if it needs one."""
        if self.stamp_at:
            texts = [cells[place] for place in self.stamp_at]
            try:
                self.stamps.append(stamp_of(self.stamp_names, texts, self.second_unit))
            except ValueError:
                if any(map(is_null, texts)):
                    return False
                raise
        return True

    def _numbers_in(self, cells: Sequence[str]) -> list[float]:
        try:
            return [float(cells[place]) for place in self._value_at]
        except ValueError:
            return [
                (angle if name in ("lat", "lon") else number)(cells[place])
                for name, place in self.at.items()
            ]

    def _is_pose(self, values: Sequence[float]) -> bool:
        """Whether the values of a row are finite, and some of its orientation is not 0."""
        # The sum is quick; that of large numbers may not be finite.
        if not math.isfinite(sum(values)) and not all(map(math.isfinite, values)):
            return False
        return not self._turn_at or any(values[place] for place in self._turn_at)

    def _as_many_as_columns(
        self, cells: Sequence[str], line_number: int, text: object
    ) -> Sequence[str]:
        """The cells of a row without an empty one at its end, or those of a row that has a stamp
        alone; an InputError for any other number of cells.
        """
        n_columns = len(self.names)
        if len(cells) == n_columns + 1 and not cells[-1]:
            return cells[:-1]
        others = (cell for place, cell in enumerate(cells) if place not in self.stamp_at)
        has_stamp = self.stamp_at and max(self.stamp_at) < len(cells) < n_columns
        if has_stamp and all(map(is_null, others)):
            return [*cells, *[""] * (n_columns - len(cells))]
        raise InputError(
            f"{self.path}, line {line_number}: expected {self.expected}; found {len(cells)}: "
            f"{shown_value(text)}"
        )

    def guess(self, text: str) -> None:
        """Note how something was read that the file does not say."""
        self.guesses.append(f"{self.path}: {text}")

    def refuse(self, wrong: BoolArray, message: Callable[[int], str]) -> None:
        """Raise an error at the first wrong row (N,), if there is one."""
        index = int(np.argmax(wrong))
        if wrong[index]:
            raise InputError(f"{self.path}, line {self.line_numbers[index]}: {message(index)}")


# ---- numbers in memory

_KINDS = (
    "a path, an array (N, 4, 4), (N, 8) of t, x, y, z, qx, qy, qz, qw or (N, 7), or a table with "
    "named columns"
)


def columns_of_array(source: Any) -> tuple[Sequence[str], FloatArray, list[str]]:
    """Names and values of the columns of an array of poses, and notes on how it was read; an
    InputError if it is none.
    """
    try:
        values = np.asarray(source, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"expected {_KINDS}; found {type(source).__name__}") from None
    notes: list[str] = []
    if values.shape[1:] == (4, 4) and not _has_last_row(values):
        values = np.swapaxes(values, 1, 2)
        notes = ["matrices are transposed: read with their rows as columns"]
        if not _has_last_row(values):
            raise InputError("the last row of a matrix is not 0 0 0 1; expected poses (N, 4, 4)")
    if values.shape[1:] in ((3, 4), (4, 4)):
        return MATRIX, values.reshape(len(values), -1)[:, : len(MATRIX)], notes
    names = ("t", *POSITION, *QUATERNION)
    known = {8: names, 7: names[1:], 4: names[:4]}
    if values.ndim != 2 or values.shape[1] not in known:
        raise InputError(f"expected {_KINDS}; found an array {values.shape}")
    return known[values.shape[1]], values, notes


def _has_last_row(matrices: FloatArray) -> bool:
    """Whether the last row of all finite matrices (N, 4, 4) is 0 0 0 1."""
    finite = matrices[np.isfinite(matrices).all(axis=(1, 2)) & matrices.any(axis=(1, 2))]
    return bool(np.allclose(finite[:, 3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=ROTATION_TOLERANCE))


def table_of_object(source: Any, times: Any = None) -> Table:
    """The numbers of an array or of a table; see :func:`hand_eye_calib.read_trajectory`. An
    InputError if it is neither, or the stamps are no numbers or datetimes, one for each pose.
    """
    if hasattr(source, "columns"):
        keys = [*source.columns]
        table = Table("the table", [*map(str, keys)], expected=_KINDS)
        columns = [np.asarray(source[keys[at]], dtype=float) for at in table.at.values()]
        values = np.column_stack(columns)
        if times is None and len(table.stamp_at) == 1:
            times = source[keys[table.stamp_at[0]]]
        elif times is None and table.stamp_at:
            texts = zip(*(map(str, source[keys[at]]) for at in table.stamp_at), strict=True)
            unit = table.second_unit
            times = [stamp_of(table.stamp_names, cells, unit) for cells in texts]
    else:
        names, values, notes = columns_of_array(source)
        if names[0] == "t":
            times = values[:, 0] if times is None else times
            names = names[1:]
            values = values[:, 1:]
        table = Table("the poses", names, expected=_KINDS)
        for note in notes:
            table.guess(note)
    stamps = None if times is None else _stamps_of_objects(times, table, len(values))
    _fill_from_array(table, values, stamps)
    return table


def _stamps_of_objects(times: Any, table: Table, n_poses: int) -> list[Decimal | None]:
    """One stamp per pose, none where it is not a time."""
    if isinstance(times, list) and times and isinstance(times[0], Decimal):
        return [*times]
    if getattr(getattr(times, "dtype", None), "tz", None) is not None:
        times = np.asarray(times, dtype="datetime64[ns]")
    stamps = np.asarray(times)
    is_time = np.ones(stamps.shape, dtype=bool)
    if stamps.dtype.kind == "M":
        table.units["t"] = "ns"
        is_time = ~np.isnat(stamps)
        stamps = stamps.astype("datetime64[ns]").astype(np.int64)
    elif stamps.dtype.kind == "f":
        is_time = np.isfinite(stamps)
    if stamps.dtype.kind not in "iuf" or not is_time.any():
        raise InputError(
            f"stamps must be finite numbers or datetimes; found {stamps.dtype} of shape "
            f"{stamps.shape}"
        )
    if stamps.shape != (n_poses,):
        raise InputError(
            f"there must be one stamp per pose; found {stamps.size} stamps and {n_poses} poses"
        )
    both = zip(stamps.tolist(), is_time.tolist(), strict=True)
    return [Decimal(stamp) if is_one else None for stamp, is_one in both]


def _fill_from_array(
    table: Table, values: FloatArray, stamps: Sequence[Decimal | None] | None
) -> None:
    """Add the rows (N, k) that have a pose and a stamp."""
    is_pose = np.isfinite(values).all(axis=1)
    if table._turn_at:
        is_pose &= values[:, table._turn_at].any(axis=1)
    if stamps is not None:
        is_pose &= np.array([stamp is not None for stamp in stamps], dtype=bool)
        table.stamps = [
            stamp for stamp, keep in zip(stamps, is_pose, strict=True) if stamp is not None and keep
        ]
    rows = np.flatnonzero(is_pose).tolist()
    table.numbers.frombytes(np.ascontiguousarray(values[is_pose]).tobytes())
    table.line_numbers.extend(row + 1 for row in rows)
    table.rows.extend(rows)
    table.n_rows = len(values)
    if table.n_left_out:
        table.first_left_out = int(np.argmin(is_pose)) + 1


# ---- rows that are written


def write_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory to a text file in the format tum, which evo reads, too, replacing it if it
    exists. Reading it back gives the same stamps and poses.

    Parameters
    ----------
    path : str or path-like
    trajectory : Trajectory

    Raises
    ------
    InputError
        If the file cannot be written.

    Examples
    --------
    >>> hec.write_trajectory("moved.tum", child.shifted(result.time_offset_s))
    """
    lines = map(tum_line, trajectory.stamps_ns.tolist(), se3.to_rows(trajectory.poses).tolist())
    with writing(path):
        write_atomically({Path(path): "\n".join([f"# {TUM_COLUMNS}", *lines, ""])})


def tum_line(stamp_ns: int, pose: Iterable[float]) -> str:
    """The line of a pose x y z qx qy qz qw, which keeps every digit."""
    return f"{seconds(stamp_ns)} {' '.join(map(repr, pose))}"
