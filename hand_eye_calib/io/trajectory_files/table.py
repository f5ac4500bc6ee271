"""The numbers of a trajectory file, row by row, before they become poses: which format its lines
have, and what stands in which column.
"""

import csv
import os
import re
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from io import TextIOWrapper
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.config import PAIR_BY, STAMP_UNITS, TRAJECTORY_FORMATS
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.io.files import open_regular
from hand_eye_calib.io.limits import LARGEST_TEXT, LONGEST_LINE
from hand_eye_calib.io.trajectory_files.columns import (
    MATRIX,
    POSITION,
    QUATERNION,
    RATES,
    UNNAMED,
    Columns,
    are_columns,
    choose_columns,
    listed,
)
from hand_eye_calib.io.trajectory_files.foreign import rows_of
from hand_eye_calib.text import shortened, shown_value

_Path = str | Path
# A line and its number, from 1.
Line = tuple[int, str]

#: The format that the lines look like.
AUTO = "auto"
TUM_COLUMNS = "timestamp tx ty tz qx qy qz qw"

# A stamp in nanoseconds since 1970 has at least so many digits.
_DIGITS_OF_NS = 17
# A number, or a time as of ISO 8601.
_NUMBER = re.compile(
    r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|nan|[-+]?inf|\d{4}-\d\d-\d\d[t ]\d.*", re.IGNORECASE
)
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")

_TIMES = "times.txt"
# What four columns without names are.
_OF_FOUR = {"positions": ("t", *POSITION), "rates": ("t", *RATES)}


@dataclass(frozen=True, kw_only=True)
class FileOptions:
    """How to read a text file; see :func:`hand_eye_calib.read_trajectory`. ``pair_by`` is of all
    files that belong together: "time", or "row" or "name" (of images) in place of stamps.

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
    pair_by: str = PAIR_BY[0]

    def __post_init__(self) -> None:
        for what, given, known in (
            ("unit of stamps", self.stamp_unit or "s", (*STAMP_UNITS,)),
            ("trajectory format", self.format, (*TRAJECTORY_FORMATS, AUTO)),
        ):
            if given not in known:
                raise ConfigError(f"unknown {what} {given!r}; known are {', '.join(known)}")
        for value, of, what in (
            (self.columns, "csv", "columns are named for"),
            (self.times, "kitti", "a file of times belongs to"),
        ):
            if value is not None and self.format not in (of, AUTO):
                raise ConfigError(f"{what} format {of} only; the format is {self.format}")


# ---- lines


def lines_of(
    path: _Path, expected: str = "a trajectory", after: int | None = None
) -> Iterator[Line]:
    """The lines of a text file that are not blank, with their numbers; those after one that are no
    comments. They are read anew each time: a list would take many times the memory of the text.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    try:
        with TextIOWrapper(open_regular(path), encoding="utf-8-sig") as file:
            if os.fstat(file.fileno()).st_size > LARGEST_TEXT:
                raise InputError(f"cannot read {path}: it is larger than {LARGEST_TEXT} bytes")
            for number, text in enumerate(file, 1):
                if len(text) > LONGEST_LINE:
                    raise InputError(
                        f"{path}, line {number}: longer than {LONGEST_LINE} characters"
                    )
                text = text.strip()
                if text and (after is None or (number > after and not text.startswith("#"))):
                    yield number, text
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; expected lines of {expected}") from None


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


class Head(NamedTuple):
    """What the beginning of a file tells: number and cells of the first line that is no comment (0
    and none without one); the names of the columns, which are that line, unless it is a row of
    numbers, otherwise the last comment above it that has as many cells; the format, tum in doubt,
    so that its reader says what is wrong; and the columns of that format, if they are known.
    """

    number: int
    cells: list[str]
    names: Sequence[str] | None
    format: str
    header: Sequence[str] | None

    @classmethod
    def of(cls, path: _Path) -> Self:
        """Look at a file."""
        comments: dict[int, list[str]] = {}
        for line in lines_of(path):
            cells = _cells_of(line[1].lstrip("#").strip())
            if not line[1].startswith("#"):
                break
            if not _is_row(cells):
                comments[len(cells)] = cells
        else:
            line, cells = (0, ""), []
        names = comments.get(len(cells)) if _is_row(cells) or not cells else cells
        is_separated, n_cells = "," in line[1] or ";" in line[1], len(cells)
        found: tuple[str, Sequence[str] | None] = "csv", _UNNAMED if n_cells == 8 else None
        if names and (names is cells or are_columns(names)):
            is_tum = " ".join(names).lower().endswith(TUM_COLUMNS[10:])
            found = ("tum", _FORMATS["tum"][0]) if is_tum and not is_separated else ("csv", names)
        elif not is_separated and n_cells != 4:
            found = ("kitti", MATRIX) if n_cells == 12 else ("tum", _UNNAMED)
        elif n_cells >= 8 and cells[0].isdecimal() and len(cells[0]) >= _DIGITS_OF_NS:
            found = "euroc", _FORMATS["euroc"][0]
        return cls(line[0], cells, names, *found)


# ---- tables


@dataclass
class Table:
    """The rows of a file: their line numbers, stamps (none without a column of them), and values,
    one row after the other.

    Attributes
    ----------
    path : str or path-like
        What messages call it.
    expected : str
        What a row should be, for messages.
    columns : Columns
    format : str
        One of :data:`~hand_eye_calib.config.TRAJECTORY_FORMATS`.
    header : tuple of str
        The names of all columns; empty without.
    images : sequence of str
        The name of each row's image; empty without.
    guesses : list of str
        What a person should know of how the file was read.
    conventions : list of str
        Those of its angles that the motion does not contradict, the usual first.
    """

    path: _Path
    expected: str
    columns: Columns
    format: str = "csv"
    header: tuple[str, ...] = ()
    images: Sequence[str] = ()
    line_numbers: "array[int]" = field(default_factory=lambda: array("q"))
    stamps: list[Decimal] = field(default_factory=list)
    numbers: "array[float]" = field(default_factory=lambda: array("d"))
    guesses: list[str] = field(default_factory=list)
    conventions: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.line_numbers)

    @property
    def values(self) -> FloatArray:
        """(N, k) array: the values of each row."""
        return np.asarray(self.numbers, dtype=float).reshape(-1, len(self.columns.quantities))

    def columns_of(self, names: Sequence[str]) -> FloatArray:
        """(N, k) array: the values of some quantities."""
        places = [*self.columns.quantities]
        return self.values[:, [places.index(name) for name in names]]

    def fill(
        self,
        lines: Iterable[tuple[int, Any]],
        cells_of: Callable[[Any], list[str]],
        n_columns: int,
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
            if len(cells) != n_columns:
                raise InputError(
                    f"{self.path}, line {number}: expected {self.expected}; found {len(cells)}: "
                    f"{shown_value(text)}"
                )
            try:
                if stamp_at:
                    self.stamps.append(_stamp([cells[index] for index in stamp_at]))
                self.numbers.extend(float(cells[index]) for index in at)
            except ValueError as error:
                reason = f"expected {self.expected}; {shortened(str(error))}"
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
    columns; of a time of ISO 8601, in UTC if it names no zone, microseconds count.
    """
    if len(cells) == 2:
        return Decimal(int(cells[0]) * STAMP_UNITS["s"] + int(cells[1]))
    try:
        stamp = Decimal(cells[0])
    except InvalidOperation:
        if not _NUMBER.fullmatch(cells[0]):
            raise ValueError(f"found {cells[0]!r} for the timestamp") from None
        moment = datetime.fromisoformat(cells[0])
        moment = moment.replace(tzinfo=moment.tzinfo or UTC)
        return Decimal(int(moment.timestamp())) + Decimal(moment.microsecond).scaleb(-6)
    if not stamp.is_finite() or stamp.adjusted() > 30:
        raise ValueError(f"found {cells[0]!r} for the timestamp")
    return stamp


# ---- formats

# Of the formats whose columns have an order: their names, what a row is, and how it is split.
_FORMATS: dict[str, tuple[Sequence[str], str, Callable[[str], list[str]]]] = {
    "tum": (("t", *POSITION, *QUATERNION), f"8 numbers, {TUM_COLUMNS}", str.split),
    "kitti": (MATRIX, "12 numbers, the first three rows of a pose", str.split),
    "euroc": (
        ("t [ns]", *POSITION, "qw", "qx", "qy", "qz"),
        "8 numbers or more, timestamp, px, py, pz, qw, qx, qy, qz",
        lambda text: [*map(str.strip, text.split(","))][:8],
    ),
}
# A stamp, a position and a quaternion, whose order is to be found.
_UNNAMED = ("t", *POSITION, *UNNAMED)


def read_table(path: _Path, options: FileOptions) -> Table:
    """The rows of a file in its format, or in the one that it looks like.

    Raises
    ------
    InputError
        If a line cannot be used, or columns have no names.
    """
    if (found := rows_of(path, options.columns)) is not None:
        rows = enumerate(found.rows, 1)
        table = table_of(path, found.header, rows, lambda row: [*map(str, row)], options.measures)
        table.guesses, table.images = [f"{path}: {note}" for note in found.notes], found.images
        return table
    head, guesses = Head.of(path), list[str]()
    format, columns, times = options.format, options.columns, options.times
    if format != AUTO or columns or times:
        format = format if format != AUTO else "csv" if columns else "kitti"
        header = _FORMATS[format][0] if format != "csv" else head.names
    else:
        format, header = head.format, head.header
        header = header or _OF_FOUR.get(options.measures) if len(head.cells) == 4 else header
        if format != "tum":
            guesses = [f"{path} looks like format {format}; to change that, give `format`"]
        beside = Path(path).with_name(_TIMES)
        if format == "kitti" and beside.is_file():
            times = beside
            guesses.append(f"stamps read from {beside}; to change that, give `times`")
    after = head.number if head.names is head.cells else 0
    if columns:
        header = [name.strip() for name in columns.split(",")]
        after = 0 if any(map(_NUMBER.fullmatch, head.cells)) else head.number
    if header is None and head.cells:
        raise InputError(
            f"{path}: the first line names no columns, so that their order is unknown; name the "
            f"{len(head.cells)} with `columns`, such as t,x,y,z,qx,qy,qz,qw or t,wx,wy,wz"
        )
    _, expected, cells_of = _FORMATS.get(format, ((), "", _cells_of))
    # A file without data is not gone through again.
    lines = lines_of(path, after=after if format == "csv" else 0) if head.cells else iter(())
    measures = options.measures if format == "csv" else AUTO
    table = table_of(path, header or _UNNAMED, lines, cells_of, measures, expected)
    if format == "kitti" and times is not None:
        table.stamps = _stamps_of(times, table)
    table.guesses, table.format = guesses, format
    return table


def _stamps_of(times: _Path, poses: Table) -> list[Decimal]:
    """The stamps of poses from a file of their own."""
    table, lines = Table(times, "a stamp", Columns([0], {})), lines_of(times, "stamps", after=0)
    table.fill(lines, lambda text: text.split()[:1], 1)
    if len(table) != len(poses):
        raise InputError(
            f"{poses.path}: {len(poses)} poses, but {times} has {len(table)} stamps; they belong "
            "to different recordings"
        )
    return table.stamps


def table_of(
    path: _Path,
    names: Sequence[str],
    lines: Iterable[tuple[int, Any]],
    cells_of: Callable[[Any], list[str]],
    measures: str = AUTO,
    expected: str = "",
) -> Table:
    """The numbers of lines whose columns have names.

    Raises
    ------
    InputError
        If a column is missing, or a line cannot be used.
    """
    columns = choose_columns(path, names, measures)
    expected = expected or f"{len(names)} columns: {listed(names)}"
    return Table(path, expected, columns, header=tuple(names)).fill(lines, cells_of, len(names))
