"""Table of the numbers of a trajectory, before they become poses.

A table contains the values of its quantities ("x", "qw", ...) row by row. The names of the columns
define the quantities. The rows come from the lines of a file or from numbers in memory.
"""

import math
import re
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from itertools import islice
from typing import Any, Self

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.config import STAMP_UNITS
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.text import shortened, shown_value
from hand_eye_calib.formats.files import LONGEST_NAME
from hand_eye_calib.formats.trajectory_files.cells import (
    angle,
    is_null,
    is_value,
    number,
)
from hand_eye_calib.formats.trajectory_files.columns import (
    QUATERNION,
    ROTATION,
    SCALAR_FIRST,
    UNNAMED,
    measured,
    named_columns,
    proposed_names,
    stamp_columns,
    unknown_angles,
    unknown_columns,
)
from hand_eye_calib.formats.trajectory_files.dates import decimals, stamp_of

# Groups of quantities that are an orientation. A tracker without track writes 0 for all quantities
# of a group. A valid orientation is never all 0.
_ORIENTATIONS = (QUATERNION, SCALAR_FIRST, UNNAMED, ROTATION)

# Largest number of different names in a column of sensors. A column with more names contains
# something else, such as images.
_MOST_SENSORS = 20

# Longest list of unknown columns in a note, in characters.
_LONGEST_LIST = 120

# Number of rows that are converted together. It limits the memory for the texts of cells.
_ROWS_AT_ONCE = 1000


@dataclass
class Table:
    """Numbers of a trajectory, with one row per pose. Rows without a pose are counted and skipped.

    A row has no pose if a value is missing or not finite, or if its orientation is all 0.

    Attributes
    ----------
    path : object
        Path of the file, or another name for the table in messages.
    names : sequence of str
        Names of all columns.
    measures : str
        Kind of data to read: "poses", "positions", "rotations", "rates" or "twists" (velocities).
        "auto" is replaced by the kind according to the columns.
    expected : str
        Description of a row for messages.
    format : str
    is_transposable : bool
        Whether a rotation matrix may be stored by rows or by columns.
    line_numbers, rows : array
        Line number of each row with a pose, and its index among all rows.
    n_rows : int
        Number of all rows, with and without a pose.
    first_skipped : int or None
        Line number of the first row without a pose.
    stamps : list of Decimal
        Stamp of each row with a pose; empty without a column of stamps.
    numbers : array of float
        Values of the quantities, row after row, for rows with a pose.
    images : list of str
        Name of the image of each row with a pose; empty without such a column.
    sensor_frame : str
        Name of the sensor's frame; if empty, the name of the file is used.
    guesses : list of str
        Notes for the user about properties that the file does not state.
    conventions : list of str
        Conventions of the angles that fit the motion. The first one has priority.
    at : dict of str to int
        Column of each quantity, such as "x" or "qw".
    units : dict of str to str
        Units of the quantities, if stated in the names of the columns.
    stamp_names, stamp_at : sequence
        Quantities that together are the stamp, and their columns.
    stamp_unit : str
        Unit of the stamps; if empty, it is inferred from the size of the stamps.
    second_unit : str
        Unit of the time within a GPS week; empty if not stated in the name of the column.
    unknown : list of int
        Columns with a name that is not the name of a quantity.

    Raises
    ------
    InputError
        If a column is missing, if several columns are the same quantity, or if columns with unknown
        names seem to be the orientations.
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
    first_skipped: int | None = None
    stamps: list[Decimal] = field(default_factory=list)
    numbers: "array[float]" = field(default_factory=lambda: array("d"))
    images: list[str] = field(default_factory=list)
    sensor_frame: str = ""
    guesses: list[str] = field(default_factory=list)
    conventions: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        columns, units = named_columns(self.names)
        self.expected = (
            self.expected
            or f"{len(self.names)} columns: {self._listed(self.names)}"
        )
        is_kind_set = self.measures != "auto"
        self.measures, quantities = measured(columns, self.names, self.measures)
        self.unknown = unknown_columns(self.names, columns)
        if self.measures == "positions" and not is_kind_set:
            self._refuse_unknown_angles(columns, units)
        self.stamp_names = stamp_columns(columns)
        self._refuse_unclear_columns(columns, quantities)
        self.at = {name: columns[name][0] for name in quantities}
        self.units = {
            name: units[column]
            for name, column in self.at.items()
            if units[column]
        }
        self.stamp_at = [columns[name][0] for name in self.stamp_names]
        self._set_stamp_units(units)
        self._value_at = [*self.at.values()]
        self._image_at = columns.get("image", [])[:1]
        self._sensor_at = columns.get("sensor", [])[:1]
        self._sensors: set[str] = set()
        orientation = next(
            (group for group in _ORIENTATIONS if {*group} <= {*quantities}), ()
        )
        self._orientation_at = [quantities.index(name) for name in orientation]

    def _refuse_unclear_columns(
        self, columns: Mapping[str, list[int]], quantities: Sequence[str]
    ) -> None:
        """Raise an InputError if a quantity has no column, or several columns."""
        if missing := [name for name in quantities if name not in columns]:
            listed = self._listed(self.names)
            has_accelerations = re.search(r", a(cc\w*)?_?x", listed)
            no_pose = (
                " (accelerations contain no pose)" if has_accelerations else ""
            )
            if {"a", "b", "c"} <= {name.strip().lower() for name in self.names}:
                raise InputError(
                    f"{self.path}: the columns A, B and C seem to be angles of a robot; name "
                    "its maker, such as hand_eye_calib arm HAND CAMERA --parent-angles kuka"
                )
            raise InputError(
                f"{self.path}: no column for {', '.join(missing)} among "
                f"{listed}{no_pose}; name all columns with `columns`, such as "
                "t,x,y,z,qw,qx,qy,qz, with roll_deg,pitch_deg,yaw_deg or "
                "rotvec_x,rotvec_y,rotvec_z for rotations, or t,wx,wy,wz of "
                "a gyroscope; remove other text above the rows"
            )
        for name in (*self.stamp_names, *quantities):
            if len(columns[name]) > 1:
                found = [self.names[column] for column in columns[name]]
                if len({*found}) == 1:
                    raise InputError(
                        f"{self.path}: {len(found)} columns have the name {found[0]}; name each "
                        "column once, with `columns`"
                    )
                listed = self._listed(found)
                raise InputError(
                    f"{self.path}: each of the columns {listed} could be {name}; "
                    "name them with `columns`"
                )

    def _refuse_unknown_angles(
        self, columns: Mapping[str, list[int]], units: Sequence[str]
    ) -> None:
        """Raise an InputError if columns with unknown names seem to be the orientations."""
        angles = unknown_angles(self.names, units, self.unknown)
        if angles:
            listed = self._listed(self.names[place] for place in self.unknown)
            proposal = proposed_names(units, columns, self.unknown, angles)
            raise InputError(
                f"{self.path}: columns with unknown names: {listed}; name all columns with "
                f"`columns`, such as {proposal} (_ leaves a column out)"
            )

    @property
    def unread(self) -> str:
        """End of a note on missing quantities: the columns with unknown names; may be empty."""
        if not self.unknown:
            return ""
        listed = ", ".join(self.names[place] for place in self.unknown)
        return (
            f"; not read: {shortened(listed, _LONGEST_LIST)} (if they are part of the poses, name "
            "all columns with `columns`)"
        )

    def _set_stamp_units(self, units: Sequence[str]) -> None:
        """Set the units of the stamps and of the time within a GPS week.

        ``units`` has the units in the names of all columns.
        """
        unit = units[self.stamp_at[-1]] if self.stamp_at else ""
        self.second_unit = unit if unit in STAMP_UNITS else ""
        if "mow" in self.stamp_names:
            self.second_unit = self.second_unit or "ms"
        if len(self.stamp_names) < 2:
            self.stamp_unit = self.second_unit
        elif self.stamp_names == ("secs", "nsecs"):
            self.stamp_unit = "ns"
        else:
            self.stamp_unit = "s"

    @property
    def n_left_out(self) -> int:
        """Number of rows without a pose."""
        return self.n_rows - len(self.rows)

    def _listed(self, names: Iterable[str]) -> str:
        """Return the names of columns as text for a message, shortened if they are many."""
        return shortened(", ".join(names), LONGEST_NAME)

    def values(self, names: Iterable[str] = ()) -> FloatArray:
        """Return the values (N, k) of k quantities; without names, of all quantities."""
        quantities = [*self.at]
        all_values = np.asarray(self.numbers).reshape(-1, len(quantities))
        if not names:
            return all_values
        places = [quantities.index(name) for name in names]
        return all_values[:, places]

    def fill(
        self,
        lines: Iterable[tuple[int, Any]],
        cells_of: Callable[[Any], Sequence[str]],
    ) -> Self:
        """Add rows, and return this table.

        Parameters
        ----------
        lines : iterable of (int, object)
            Line number and content of each row.
        cells_of : callable
            Function that splits the content of a row into cells.

        Raises
        ------
        InputError
            At the first line with another number of cells, or with text instead of a number. Also
            if the poses are from several sensors.
        """
        remaining = iter(lines)
        while numbered := list(islice(remaining, _ROWS_AT_ONCE)):
            line_numbers = [line_number for line_number, _ in numbered]
            rows = [cells_of(content) for _, content in numbered]
            if self._add_at_once(rows, line_numbers):
                continue
            for (line_number, content), cells in zip(
                numbered, rows, strict=True
            ):
                try:
                    self._add_row(cells, line_number, content)
                except InputError:
                    if line_number == line_numbers[-1] and not any(remaining):
                        self._refuse_cut(cells, line_number)
                    raise
        if 1 < len(self._sensors) <= _MOST_SENSORS:
            column = self.names[self._sensor_at[0]]
            raise InputError(
                f"{self.path}: poses of several sensors, {column} "
                f"{self._listed(sorted(self._sensors))}; write one file for "
                "each sensor"
            )
        return self

    def _refuse_cut(self, cells: Sequence[str], line_number: int) -> None:
        """Raise an InputError if the last line has too few numbers, as in an incomplete file."""
        is_short = len(cells) < len(self.names)
        if is_short and self.n_rows and all(map(is_value, cells)):
            raise InputError(
                f"{self.path}, line {line_number}, the last line, is cut: {len(cells)} of "
                f"{len(self.names)} numbers; copy the file again, or delete this line"
            ) from None

    def fill_from_arrays(
        self, values: FloatArray, stamps: Sequence[Decimal | None] | None
    ) -> None:
        """Add the rows of values (N, k) that have a pose and, with ``stamps``, also a stamp."""
        self._add_arrays(values, stamps, range(1, len(values) + 1))

    def _add_arrays(
        self,
        values: FloatArray,
        stamps: Sequence[Decimal | None] | None,
        line_numbers: Sequence[int],
    ) -> None:
        """Add rows like :meth:`fill_from_arrays`, from lines with these numbers."""
        is_pose = np.isfinite(values).all(axis=1)
        if self._orientation_at:
            is_pose &= values[:, self._orientation_at].any(axis=1)
        if stamps is not None:
            is_pose &= np.array(
                [stamp is not None for stamp in stamps], dtype=bool
            )
            stamps_and_uses = zip(stamps, is_pose, strict=True)
            self.stamps += [
                stamp
                for stamp, is_used in stamps_and_uses
                if is_used and stamp is not None
            ]
        rows = np.flatnonzero(is_pose).tolist()
        self.numbers.frombytes(np.ascontiguousarray(values[is_pose]).tobytes())
        self.line_numbers.extend(line_numbers[row] for row in rows)
        self.rows.extend(self.n_rows + row for row in rows)
        self.n_rows += len(values)
        if self.first_skipped is None and len(rows) < len(values):
            self.first_skipped = line_numbers[int(np.argmin(is_pose))]

    def _add_at_once(
        self, rows: Sequence[Sequence[str]], line_numbers: Sequence[int]
    ) -> bool:
        """Add rows of cells column by column, if all their cells are plain numbers.

        Returns
        -------
        bool
            Whether the rows were added. If they were not, nothing has changed.
        """
        has_names = self._image_at or self._sensor_at
        if (
            has_names
            or len(self.stamp_at) > 1
            or {*map(len, rows)} != {len(self.names)}
        ):
            return False
        columns = [*zip(*rows, strict=True)]
        values = np.empty((len(rows), len(self._value_at)))
        stamps = None
        try:
            for place, column in enumerate(self._value_at):
                values[:, place] = [*map(float, columns[column])]
            if self.stamp_at:
                stamps = decimals(columns[self.stamp_at[0]])
        except ValueError:
            return False
        self._add_arrays(values, stamps, line_numbers)
        return True

    def _add_row(
        self, cells: Sequence[str], line_number: int, content: object
    ) -> None:
        """Add the row of one line.

        Raises
        ------
        InputError
            If the line has another number of cells, or text instead of a number.
        """
        if len(cells) != len(self.names):
            cells = self._padded(cells, line_number, content)
        try:
            self._add(cells, line_number)
        except ValueError as error:
            reason = f"expected {self.expected}; {shortened(str(error))}"
            raise InputError(
                f"{self.path}, line {line_number}: {reason}"
            ) from None

    def _add(self, cells: Sequence[str], line_number: int) -> None:
        """Add a row. If it has no pose, only count it.

        Raises
        ------
        ValueError
            If a cell has text instead of a number.
        """
        row = self.n_rows
        self.n_rows += 1
        values = self._numbers_in(cells)
        if not self._is_pose(values) or not self._add_stamp(cells):
            if self.first_skipped is None:
                self.first_skipped = line_number
            return
        self.numbers.extend(values)
        self.images += [cells[column] for column in self._image_at]
        if len(self._sensors) <= _MOST_SENSORS:
            self._sensors.update(cells[column] for column in self._sensor_at)
        self.line_numbers.append(line_number)
        self.rows.append(row)

    def _add_stamp(self, cells: Sequence[str]) -> bool:
        """Add the stamp of a row. Return False if it is missing."""
        if not self.stamp_at:
            return True
        texts = [cells[column] for column in self.stamp_at]
        try:
            self.stamps.append(
                stamp_of(self.stamp_names, texts, self.second_unit)
            )
        except ValueError:
            if any(map(is_null, texts)):
                return False
            raise
        return True

    def _numbers_in(self, cells: Sequence[str]) -> list[float]:
        """Return the values of the quantities in a row; NaN for missing values.

        Raises
        ------
        ValueError
            If a cell contains text instead of a number.
        """
        # float is fast, and reads almost every row. The other functions also read decimal commas,
        # marks of missing values, and angles in degrees, minutes and seconds.
        try:
            return [float(cells[column]) for column in self._value_at]
        except ValueError:
            values = []
            for name, column in self.at.items():
                read = angle if name in ("lat", "lon") else number
                values.append(read(cells[column]))
            return values

    def _is_pose(self, values: Sequence[float]) -> bool:
        """Return whether the values of a row are finite, and its orientation is not all 0."""
        # Check the sum first, which is fast: if it is finite, all values are finite. But the sum of
        # large finite values may be infinite.
        if not math.isfinite(sum(values)) and not all(
            map(math.isfinite, values)
        ):
            return False
        return not self._orientation_at or any(
            values[place] for place in self._orientation_at
        )

    def _padded(
        self, cells: Sequence[str], line_number: int, content: object
    ) -> Sequence[str]:
        """Return a row with too few or too many cells with one cell for each column.

        An empty last cell is dropped. If a row has only a stamp, empty cells are appended.

        Raises
        ------
        InputError
            If the row has another number of cells for another reason.
        """
        n_missing = len(self.names) - len(cells)
        if n_missing == -1 and not cells[-1]:
            return cells[:-1]
        if n_missing > 0 and self.stamp_at and max(self.stamp_at) < len(cells):
            others = [
                cell
                for column, cell in enumerate(cells)
                if column not in self.stamp_at
            ]
            if all(map(is_null, others)):
                return [*cells, *[""] * n_missing]
        raise InputError(
            f"{self.path}, line {line_number}: expected {self.expected}; found {len(cells)}: "
            f"{shown_value(content)}"
        )

    def guess(self, text: str) -> None:
        """Add a note for the user about a property that the file does not state."""
        self.guesses.append(f"{self.path}: {text}")

    def refuse(
        self, is_wrong: BoolArray, message: Callable[[int], str]
    ) -> None:
        """Raise an InputError at the first row for which ``is_wrong`` (N,) is true."""
        index = int(np.argmax(is_wrong))
        if is_wrong[index]:
            raise InputError(
                f"{self.path}, line {self.line_numbers[index]}: {message(index)}"
            )
