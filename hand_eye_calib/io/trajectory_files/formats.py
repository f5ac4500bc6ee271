"""The lines of each format as a table of numbers."""

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import chain, repeat
from pathlib import Path

from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.io.files import read_text
from hand_eye_calib.io.limits import LARGEST_TEXT, MOST_COLUMNS
from hand_eye_calib.io.trajectory_files.columns import QUATERNION, choose_columns, listed
from hand_eye_calib.io.trajectory_files.layout import header_of
from hand_eye_calib.io.trajectory_files.table import Lines, Table, cells_of, data_lines, is_number

_Path = str | Path

TUM_COLUMNS = "timestamp tx ty tz qx qy qz qw"
_EUROC_COLUMNS = "timestamp, px, py, pz, qw, qx, qy, qz"
_POSITION = ("x", "y", "z")
# The first three rows of a pose's matrix.
MATRIX = tuple(f"m{row}{column}" for row in "123" for column in "1234")
# Coefficients of a quaternion whose order is not known.
UNNAMED = ("q1", "q2", "q3", "q4")
_NS_PER_S = 1_000_000_000
_MATLAB = b"MATLAB 5.0 MAT-file"


def lines_of(path: _Path, expected: str) -> Lines:
    """The lines of a text file with their numbers.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    _refuse_binary_of_matlab(Path(path))
    return Lines(path, read_text(path, f"lines of {expected}", LARGEST_TEXT))


def _refuse_binary_of_matlab(path: Path) -> None:
    start = b""
    # What cannot be opened is refused by the reader.
    if path.is_file():
        with suppress(OSError), path.open("rb") as file:
            start = file.read(len(_MATLAB))
    if start == _MATLAB:
        raise InputError(
            f"{path}: a binary file of MATLAB; save the poses as text, "
            "save('poses.txt', 'poses', '-ascii', '-double')"
        )


def read_tum(path: _Path, lines: Lines, is_named: bool = True) -> Table:
    """Stamp, position, quaternion with the scalar last; if not ``is_named``, in unknown order."""
    quantities = _POSITION + (QUATERNION if is_named else UNNAMED)
    table = Table(path, f"8 numbers, {TUM_COLUMNS}", quantities)
    for number, text in data_lines(lines):
        fields = text.split()
        if len(fields) != 8:
            raise table.unexpected((number, text), len(fields))
        table.add(number, fields[0], fields[1:])
    return table


def read_euroc(path: _Path, lines: Lines) -> Table:
    """Stamp in nanoseconds, position, quaternion with the scalar first, and what follows."""
    quantities = (*_POSITION, "qw", "qx", "qy", "qz")
    table = Table(path, _EUROC_COLUMNS, quantities, stamp_unit="ns")
    for number, text in data_lines(lines):
        fields = [cell.strip() for cell in text.split(",")]
        if len(fields) < 8:
            expected = f"8 numbers or more, {_EUROC_COLUMNS}"
            raise table.unexpected((number, text), len(fields), expected)
        table.add(number, fields[0], fields[1:8])
    return table


def read_kitti(path: _Path, lines: Lines, times: _Path | None) -> Table:
    """Three rows of a matrix in each line, and the stamps in a file of their own.

    Raises
    ------
    ConfigError
        If that file is not named.
    InputError
        If a line cannot be used, or the files have different lengths.
    """
    table = Table(path, "12 numbers, the first three rows of a pose", MATRIX)
    if times is None:
        raise ConfigError(
            f"{path}: the poses of format kitti have no stamps; name their file with `times`"
        )
    stamps = [text.strip() for _, text in data_lines(lines_of(times, "stamps"))]
    for (number, text), stamp in zip(data_lines(lines), chain(stamps, repeat("0")), strict=False):
        fields = text.split()
        if len(fields) != 12:
            raise table.unexpected((number, text), len(fields))
        table.add(number, stamp, fields)
    if len(stamps) != len(table.stamps):
        raise InputError(
            f"{path}: {len(table.stamps)} poses, but {times} has {len(stamps)} stamps; they belong "
            "to different recordings"
        )
    return table


def read_csv(
    path: _Path,
    lines: Lines,
    columns: str | None,
    may_guess: bool = False,
    measures: str = "auto",
) -> Table:
    """Columns by the names in the header, or by those given.

    Parameters
    ----------
    path : path-like
    lines : Lines
    columns : str or None
        Names, separated by commas; None for those of the header.
    may_guess : bool
        Whether eight columns without names are a stamp, a position and a quaternion, whose order
        is to be found.
    measures : str
        What to read of the columns, one of config.MEASURES, or "auto" for what there is.

    Raises
    ------
    InputError
        If a line cannot be used, or columns have no names.
    """
    header, rows = header_of(lines)
    names = [name.strip() for name in columns.split(",")] if columns is not None else header
    if columns is not None:
        rows = _without_header(lines)
    if names is None:
        return _read_unnamed(path, rows, may_guess)
    if len(names) > MOST_COLUMNS:
        raise InputError(f"{path}: {len(names)} columns; at most {MOST_COLUMNS} are read")
    chosen = choose_columns(path, names, measures=measures)
    table = Table(
        path,
        f"{len(names)} columns: {listed(names)}",
        tuple(chosen.quantities),
        chosen.stamp_unit,
        chosen.units,
        header=tuple(names),
    )
    at = list(chosen.quantities.values())
    _fill(table, rows, len(names), chosen.stamp, at)
    return table


def _without_header(lines: Lines) -> Lines:
    """Lines without a first row that has no number in it."""
    number, row = next(data_lines(lines), (0, ""))
    is_header = not any(is_number(cell) for cell in cells_of(row))
    return lines.after(number) if is_header else lines


def _read_unnamed(path: _Path, lines: Lines, may_guess: bool) -> Table:
    row = next((text for _, text in data_lines(lines)), "")
    n_columns = len(cells_of(row)) if row else 8
    if not (may_guess and n_columns == 8) and row:
        raise InputError(
            f"{path}: the first line names no columns, so the order of the quaternion is unknown; "
            "name them with `columns`, such as t,x,y,z,qx,qy,qz,qw; there are "
            f"{n_columns}"
        )
    table = Table(path, "8 columns: a stamp, a position and a quaternion", _POSITION + UNNAMED)
    _fill(table, lines, 8, [0], range(1, 8))
    return table


def _fill(
    table: Table, lines: Lines, n_columns: int, stamp_at: list[int], at: Sequence[int]
) -> None:
    """Add all rows: the stamp from its one or two columns, the values from theirs."""
    stamp_of: Callable[[Table, int, list[str]], str] = _joined if len(stamp_at) > 1 else _single
    for number, text in data_lines(lines):
        cells = cells_of(text)
        if len(cells) != n_columns:
            raise table.unexpected((number, text), len(cells))
        stamp = stamp_of(table, number, [cells[index] for index in stamp_at])
        table.add(number, stamp, [cells[index] for index in at])


def _single(_: Table, __: int, cells: list[str]) -> str:
    return cells[0]


def _joined(table: Table, number: int, cells: list[str]) -> str:
    """Nanoseconds of a stamp in two columns."""
    secs, nsecs = cells
    if not (re.fullmatch(r"-?\d{1,18}", secs) and re.fullmatch(r"\d{1,9}", nsecs)):
        raise InputError(
            f"{table.path}, line {number}: expected whole seconds and nanoseconds; found "
            f"{secs[:40]!r} and {nsecs[:40]!r}"
        )
    return str(int(secs) * _NS_PER_S + int(nsecs))
