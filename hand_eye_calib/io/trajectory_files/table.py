"""The numbers of a trajectory file, row by row, before they become poses: which format its lines
have, and what stands in which column.
"""

import csv
import re
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from decimal import Decimal, InvalidOperation
from itertools import takewhile
from pathlib import Path
from typing import Any, Self

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.config import STAMP_UNITS, TRAJECTORY_FORMATS
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.io.files import read_text
from hand_eye_calib.io.limits import LARGEST_TEXT, LONGEST_LINE
from hand_eye_calib.io.trajectory_files.columns import (
    MATRIX,
    POSITION,
    QUATERNION,
    UNNAMED,
    Columns,
    are_columns,
    choose_columns,
    listed,
)
from hand_eye_calib.io.trajectory_files.foreign import rows_of

_Path = str | Path
# A line and its number, from 1.
Line = tuple[int, str]

#: The format that the lines look like.
AUTO = "auto"
TUM_COLUMNS = "timestamp tx ty tz qx qy qz qw"

# Characters of a line or of a reason that a message shows.
_MOST_SHOWN = 100
# A stamp in nanoseconds since 1970 has at least so many digits.
_DIGITS_OF_NS = 17
_NOT_EMPTY = re.compile("[^\n]+")
_ISO = re.compile(
    r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d)(?:[.,](\d{1,18}))?\s*(Z|[-+]\d\d:?\d\d)?", re.IGNORECASE
)
_NUMBER = re.compile(
    rf"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|nan|[-+]?inf|{_ISO.pattern}", re.IGNORECASE
)
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")

_TIMES = "times.txt"
# What four columns without names are.
_OF_FOUR = {"positions": "t,x,y,z", "rates": "t,wx,wy,wz"}


@dataclass(frozen=True, kw_only=True)
class FileOptions:
    """How to read a text file; see :func:`hand_eye_calib.read_trajectory`.

    Raises
    ------
    ConfigError
        For what is not known or does not go together.
    """

    format: str = "tum"
    columns: str | None = None
    times: str | Path | None = None
    stamp_unit: str | None = None
    repair: bool = False
    measures: str = AUTO

    def __post_init__(self) -> None:
        check_stamp_unit(self.stamp_unit)
        known = (*TRAJECTORY_FORMATS, AUTO)
        if self.format not in known:
            raise ConfigError(
                f"unknown trajectory format {self.format!r}; known are {', '.join(known)}"
            )
        for given, of, what in (
            (self.columns, "csv", "columns are named for"),
            (self.times, "kitti", "a file of times belongs to"),
        ):
            if given is not None and self.format not in (of, AUTO):
                raise ConfigError(f"{what} format {of} only; the format is {self.format}")


def check_stamp_unit(unit: str | None) -> None:
    """Refuse a unit of stamps that is not known, with a ConfigError."""
    if unit is not None and unit not in STAMP_UNITS:
        raise ConfigError(f"unknown unit of stamps {unit!r}; known are {', '.join(STAMP_UNITS)}")


# ---- lines


class Lines:
    """The lines of a text file that are not empty, with their numbers; an InputError if it cannot
    be read.

    They are found anew each time: a list of them would take many times the memory of the text.
    """

    def __init__(self, path: _Path, expected: str = "a trajectory") -> None:
        text = read_text(path, f"lines of {expected}", LARGEST_TEXT)
        self._path, self._text = path, text.replace("\r\n", "\n").replace("\r", "\n")

    def __iter__(self) -> Iterator[Line]:
        number, end = 1, 0
        for found in _NOT_EMPTY.finditer(self._text):
            number += self._text.count("\n", end, found.start())
            end = found.end()
            if end - found.start() > LONGEST_LINE:
                raise InputError(
                    f"{self._path}, line {number}: longer than {LONGEST_LINE} characters"
                )
            yield number, found.group()

    def data(self, after: int = 0) -> Iterator[Line]:
        """The lines after one that are neither blank nor comments."""
        for number, text in self:
            stripped = text.strip()
            if number > after and stripped and not stripped.startswith("#"):
                yield number, text

    def first(self) -> Line:
        """The first of them; 0 and nothing if there is none."""
        return next(self.data(), (0, ""))

    def header(self) -> tuple[list[str] | None, int]:
        """Names of the columns, if the file has any, and the number of the line that they take.

        They are the first line that is no comment, unless it is a row of numbers; otherwise the
        last comment above the data that has as many cells.
        """
        number, row = self.first()
        cells = _cells_of(row)
        if number and not _is_row(cells):
            return cells, number
        header = None
        for _, text in takewhile(lambda line: line[0] != number, self):
            names = _cells_of(text.strip().lstrip("#").strip())
            header = names if len(names) == len(cells) and not _is_row(names) else header
        return header or None, 0


def _cells_of(text: str) -> list[str]:
    """The cells of a line: separated by commas, semicolons or white space."""
    if "," not in text and ";" not in text:
        return text.split()
    delimiter = ";" if ";" in text else ","
    row = next(csv.reader([text], delimiter=delimiter, skipinitialspace=True))
    cells = [cell.strip() for cell in row]
    if delimiter == ";" and "," in text:
        return [
            each.replace(",", ".") if _DECIMAL_COMMA.fullmatch(each) else each for each in cells
        ]
    return cells


def _is_row(cells: Sequence[str]) -> bool:
    """Whether all cells of a line are numbers or empty."""
    return bool(cells) and all(_NUMBER.fullmatch(cell) for cell in cells if cell)


# ---- what a file looks like


def layout_of(lines: Lines) -> tuple[str, bool]:
    """The format that lines have, one of :data:`~hand_eye_calib.config.TRAJECTORY_FORMATS`, tum in
    doubt, so that its reader says what is wrong; and whether the file itself names its columns.
    """
    data = lines.first()[1].strip()
    cells = _cells_of(data)
    is_separated, n_cells = "," in data or ";" in data, len(cells)
    if not _is_row(cells):
        is_table = is_separated or n_cells >= 8 or are_columns(cells)
        return ("csv" if is_table else "tum"), is_table
    names, _ = lines.header()
    if names is not None and are_columns(names):
        is_tum = not is_separated and " ".join(names).lower().endswith(TUM_COLUMNS[10:])
        return ("tum" if is_tum else "csv"), True
    if not is_separated:
        return ("kitti" if n_cells == 12 else "tum"), False
    is_ns = cells[0].isdecimal() and len(cells[0]) >= _DIGITS_OF_NS
    return ("euroc" if is_ns and n_cells >= 8 else "csv"), False


# ---- tables


@dataclass
class Table:
    """The rows of a file: their line numbers, stamps, and values, one row after the other.

    Attributes
    ----------
    expected : str
        What a row should be, for messages.
    columns : Columns
    guesses : list of str
        What a person should know of how the file was read.
    header : tuple of str
        The names of all columns; empty without.
    conventions : list of str
        Those of its angles that the motion does not contradict, the usual first.
    """

    path: _Path
    expected: str
    columns: Columns
    header: tuple[str, ...] = ()
    line_numbers: "array[int]" = field(default_factory=lambda: array("q"))
    stamps: list[Decimal] = field(default_factory=list)
    numbers: "array[float]" = field(default_factory=lambda: array("d"))
    guesses: list[str] = field(default_factory=list)
    conventions: list[str] = field(default_factory=list)

    @property
    def values(self) -> FloatArray:
        """(N, k) array: the values of each row."""
        return np.asarray(self.numbers, dtype=float).reshape(-1, len(self.columns.quantities))

    def fill(
        self,
        lines: Iterable[tuple[int, Any]],
        cells_of: Callable[[Any], list[str]],
        n_columns: int,
        may_have_more: bool = False,
    ) -> Self:
        """Add rows from their text.

        Raises
        ------
        InputError
            At the first line with another number of cells, or with something that is no number.
        """
        stamp_at, at = self.columns.stamp, [*self.columns.quantities.values()]
        for number, text in lines:
            cells = cells_of(text)
            if len(cells) != n_columns and not (may_have_more and len(cells) > n_columns):
                shown = text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}..."
                raise InputError(
                    f"{self.path}, line {number}: expected {self.expected}; found {len(cells)}: "
                    f"{shown!r}"
                )
            try:
                if stamp_at:
                    self.stamps.append(_stamp([cells[index] for index in stamp_at]))
                self.numbers.extend(float(cells[index]) for index in at)
            except ValueError as error:
                reason = f"expected {self.expected}; {str(error)[:_MOST_SHOWN]}"
                raise InputError(f"{self.path}, line {number}: {reason}") from None
            self.line_numbers.append(number)
        return self

    def guess(self, text: str) -> None:
        """Note how something was read that the file does not say."""
        self.guesses.append(f"{self.path}: {text}")

    def refuse(self, wrong: BoolArray, message: Callable[[int], str]) -> None:
        """Raise an error at the first wrong row (N,), if there is one."""
        index = int(np.argmax(wrong))
        if wrong[index]:
            raise InputError(f"{self.path}, line {self.line_numbers[index]}: {message(index)}")


def _stamp(cells: Sequence[str]) -> Decimal:
    """A stamp as it is written, with no binary floating point in between; nanoseconds of one in two
    columns.
    """
    if len(cells) == 2:
        secs, nsecs = cells
        if not (re.fullmatch(r"-?\d{1,18}", secs) and re.fullmatch(r"\d{1,9}", nsecs)):
            raise ValueError(
                f"expected whole seconds and nanoseconds; found {secs[:40]!r} and {nsecs[:40]!r}"
            )
        return Decimal(int(secs) * STAMP_UNITS["s"] + int(nsecs))
    if date := _ISO.fullmatch(cells[0]):
        day, clock, fraction, zone = date.groups()
        moment = datetime.fromisoformat(f"{day}T{clock}{zone or 'Z'}")
        return Decimal(int(moment.timestamp())) + Decimal(f"0.{fraction or 0}")
    try:
        stamp = Decimal(cells[0])
    except InvalidOperation:
        stamp = Decimal("nan")
    if not stamp.is_finite() or stamp.adjusted() > 30:
        raise ValueError(f"found {cells[0]!r} for the timestamp")
    return stamp


# ---- formats


def read_table(path: _Path, options: FileOptions) -> Table:
    """The rows of a file in its format, or in the one that it looks like.

    Raises
    ------
    InputError
        If a line cannot be used, or columns have no names.
    ConfigError
        If the stamps of format kitti are nowhere.
    """
    if (found := rows_of(path, options.columns)) is not None:
        names, rows = found.header.split(","), enumerate(found.rows, 1)
        table = table_of(path, names, rows, lambda row: [*map(str, row)], options.measures)
        table.guesses += [f"{path}: {note}" for note in found.notes]
        return table
    lines = Lines(path)
    format, is_named, guesses = options.format, True, list[str]()
    columns, times = options.columns, options.times
    if format == AUTO:
        format, is_named = layout_of(lines)
        if columns is None and times is None:
            if not is_named and len(_cells_of(lines.first()[1])) == 4:
                columns = _OF_FOUR.get(options.measures)
                if columns is None:
                    raise InputError(
                        f"{path}: four columns without names; name them with `columns`: t,x,y,z "
                        "for positions, t,wx,wy,wz for angular rates"
                    )
            elif format != "tum":
                guesses = [f"{path} looks like format {format}; to change that, give `format`"]
        if columns is not None or times is not None:
            format, is_named = "csv" if columns is not None else "kitti", True
        beside = Path(path).with_name(_TIMES)
        if format == "kitti" and times is None and beside.is_file():
            times = beside
            guesses.append(f"stamps read from {beside}; to change that, give `times`")
    if format == "csv":
        table = _read_csv(path, lines, columns, options)
    elif format == "kitti":
        table = _read_kitti(path, lines, times)
    else:
        table = _read_poses(path, lines, format, is_named)
    table.guesses[:0] = guesses
    return table


def _read_poses(path: _Path, lines: Lines, format: str, is_named: bool) -> Table:
    """A stamp, a position and a quaternion, in the order of tum or of euroc."""
    if format == "euroc":
        expected = "8 numbers or more, timestamp, px, py, pz, qw, qx, qy, qz"
        places = Columns.in_order(*POSITION, "qw", "qx", "qy", "qz", stamp_unit="ns")
        table = Table(path, expected, places)
        return table.fill(lines.data(), lambda text: [*map(str.strip, text.split(","))], 8, True)
    places = Columns.in_order(*POSITION, *(QUATERNION if is_named else UNNAMED))
    return Table(path, f"8 numbers, {TUM_COLUMNS}", places).fill(lines.data(), str.split, 8)


def _read_kitti(path: _Path, lines: Lines, times: _Path | None) -> Table:
    """Matrices, whose stamps are in a file of their own."""
    if times is None:
        raise ConfigError(
            f"{path}: the poses of format kitti have no stamps; name their file with `times`"
        )
    places = Columns.in_order(*MATRIX, has_stamp=False)
    table = Table(path, "12 numbers, the first three rows of a pose", places)
    table.fill(lines.data(), str.split, len(MATRIX))
    stamps = Table(times, "a stamp", Columns.in_order())
    table.stamps = stamps.fill(Lines(times, "stamps").data(), str.split, 1, True).stamps
    if len(table.stamps) != len(table.line_numbers):
        raise InputError(
            f"{path}: {len(table.line_numbers)} poses, but {times} has {len(table.stamps)} "
            "stamps; they belong to different recordings"
        )
    return table


def _read_csv(path: _Path, lines: Lines, columns: str | None, options: FileOptions) -> Table:
    """Columns by the names in the header, or by those given."""
    number, row = lines.first()
    cells = _cells_of(row)
    if columns is None:
        header, after = lines.header()
    else:
        header = [name.strip() for name in columns.split(",")]
        after = 0 if any(map(_NUMBER.fullmatch, cells)) else number
    if header is not None:
        return table_of(path, header, lines.data(after), _cells_of, options.measures)
    if cells and not (options.format == AUTO and len(cells) == 8):
        raise InputError(
            f"{path}: the first line names no columns, so the order of the quaternion is "
            "unknown; name them with `columns`, such as t,x,y,z,qx,qy,qz,qw; there are "
            f"{len(cells)}"
        )
    # A stamp, a position and a quaternion, whose order is to be found.
    places = Columns.in_order(*POSITION, *UNNAMED)
    table = Table(path, "8 columns: a stamp, a position and a quaternion", places)
    return table.fill(lines.data(), _cells_of, 8)


def table_of(
    path: _Path,
    names: Sequence[str],
    lines: Iterable[tuple[int, Any]],
    cells_of: Callable[[Any], list[str]],
    measures: str = AUTO,
) -> Table:
    """The numbers of lines whose columns have names.

    Raises
    ------
    InputError
        If a column is missing, or a line cannot be used.
    """
    expected = f"{len(names)} columns: {listed(names)}"
    table = Table(path, expected, choose_columns(path, names, measures), tuple(names))
    return table.fill(lines, cells_of, len(names))
