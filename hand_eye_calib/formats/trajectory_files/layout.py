"""Layout of a text file with rows of numbers.

The layout states where the rows begin, what separates their cells, and the quantity of each column.
The quantities are recognised by the names above the rows, or by the numbers themselves.
"""

import re
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry.trajectory import QUATERNION_NORM_TOLERANCE, ROTATION_TOLERANCE
from hand_eye_calib.formats.files import LONGEST_LINE
from hand_eye_calib.formats.trajectory_files.cells import (
    CellsOf,
    is_angle,
    is_number,
    is_value,
    names_in,
    number,
    separator_of,
    splitter,
)
from hand_eye_calib.formats.trajectory_files.columns import (
    LAST_ROW,
    MATRIX,
    POSITION,
    ROTATION,
    ROTATION_VECTOR,
    SCALAR_FIRST,
    TRANSLATION,
    TUM_COLUMNS,
    UNNAMED,
    is_pose,
    named_columns,
)
from hand_eye_calib.formats.trajectory_files.dates import is_date, is_date_or_time

#: Digits before the decimal point of stamps since 1970. Stamps in seconds have fewer.
DIGITS = {"ns": 17, "us": 14, "ms": 11}
COMMENTS = ("#", "//")
_LINE = re.compile(r"\S[^\r\n]*")

# Largest number of lines from which the layout is recognised, without comments. Text above the
# columns has some twenty lines, sometimes a hundred.
_MOST_LINES = 300
# Largest number of characters of these lines.
_MOST_CHARACTERS = 1 << 19
# Largest number of comments above these lines that may name the columns.
_MOST_COMMENTS = 100
# Largest number of rows whose numbers decide what a column is.
_MOST_ROWS = 100
# Smallest share of values among the cells of a row. The other cells may be names of frames.
_MIN_SHARE_OF_VALUES = 0.5

#: Columns of a row in the format tum.
TUM = ("t", *POSITION, "qx", "qy", "qz", "qw")
#: Columns of a stamp and a pose whose quaternion may be in either order.
STAMPED_POSE = ("t", *POSITION, *UNNAMED)
# Columns of the state that FAST-LIO and related programs write: a stamp, a rotation vector, a
# position, and six vectors of which the last is gravity.
_FAST_LIO = ("t", *ROTATION_VECTOR, *POSITION, *[""] * 18)
# Smallest and largest length of gravity (m/s^2).
_GRAVITY_M_S2 = (9.6, 10.0)
# Ten digits of seconds since 1970.
_SINCE_1970 = re.compile(r"\d{10,}(\.\d*)?", re.ASCII)


@dataclass(frozen=True)
class Layout:
    """Layout of a text.

    Attributes
    ----------
    rows_after : int
        Number of the last line above the rows.
    cells_of : callable
        Splits a row into cells.
    row : list of str
        Cells of the first row; empty without rows.
    names : tuple of str, optional
        Names of the columns, from a line above the rows.
    format : str
        Format of the rows; "tum" in doubt, so that the reader of this format reports the problem.
    columns : tuple of str, optional
        Quantities of the columns in this format, if they are known.
    is_transposable : bool
        Whether the matrices may be written row by row or column by column.
    """

    rows_after: int
    cells_of: CellsOf
    row: list[str]
    names: tuple[str, ...] | None
    format: str = "tum"
    columns: tuple[str, ...] | None = None
    is_transposable: bool = False


def lines_of(path: str | Path, text: str, after: int | None = None) -> Iterator[tuple[int, str]]:
    """Yield the number and the text of each line that is not blank.

    With ``after``, comments and the lines up to this line number are skipped.

    Raises
    ------
    InputError
        For a line that is too long.
    """
    line_number = 1
    end = 0
    for match in _LINE.finditer(text):
        line_number += text.count("\n", end, match.start())
        end = match.end()
        if end - match.start() > LONGEST_LINE:
            raise InputError(f"{path}, line {line_number}: longer than {LONGEST_LINE} characters")
        line = match[0]
        if after is None or (line_number > after and not line.startswith(COMMENTS)):
            yield line_number, line.rstrip()


def layout_of(path: str | Path, text: str, needs_names: bool) -> Layout:
    """Return the layout of a text.

    Parameters
    ----------
    path : str or path-like
        Name of the text in messages.
    text : str
    needs_names : bool
        Whether names above the rows must fit the columns, because no option names the columns.

    Raises
    ------
    InputError
        For a line that is too long, and for names that do not fit the columns.
    """
    comments, lines = _first_lines(path, text)
    separator = separator_of([line for _, line in lines])
    split = splitter(separator)
    cells = [split(line) for _, line in lines]
    n_above = _lines_above_rows(cells)
    if n_above is None:
        return _layout_without_rows(lines, separator)
    above = [*comments, *(line for _, line in lines[:n_above])]
    row = _usual_row(cells[n_above:])
    header = _header_of(above, row, separator)
    if needs_names and header.names is None:
        _refuse_other_number(path, lines[:n_above], _without_last(row), separator)
    cells_of = _merged(split, header.merge) if header.merge else split
    rows = [cells_of(line) for _, line in lines[n_above:]]
    rows_after = lines[n_above - 1][0] if n_above else 0
    layout = Layout(rows_after, cells_of, _usual_row(rows), header.names)
    is_separated = separator in (",", ";")
    if header.names is not None:
        return _with_named_columns(layout, header.names, is_separated)
    return _with_fitting_columns(layout, rows, is_separated)


def _layout_without_rows(lines: Sequence[tuple[int, str]], separator: str) -> Layout:
    """Return the layout of a text without rows of numbers. Its last line may name columns."""
    split = splitter(separator)
    if not lines:
        return Layout(0, split, [], None, "tum", STAMPED_POSE)
    names = tuple(names_in(lines[-1][1], separator)[0])
    return Layout(lines[0][0], split, [], names, "csv", names)


def _usual_row(rows: Sequence[list[str]]) -> list[str]:
    """Return the first row with the most frequent number of cells."""
    n_cells = Counter(map(len, rows)).most_common(1)[0][0]
    return next(row for row in rows if len(row) == n_cells)


def _first_lines(path: str | Path, text: str) -> tuple[list[str], list[tuple[int, str]]]:
    """Return the comments at the beginning, and the first numbered lines that are not comments."""
    comments: deque[str] = deque(maxlen=_MOST_COMMENTS)
    lines: list[tuple[int, str]] = []
    n_characters = 0
    for line_number, line in lines_of(path, text):
        if not line.startswith(COMMENTS):
            lines.append((line_number, line))
            n_characters += len(line)
        elif not lines:
            comments.append(line)
        if len(lines) >= _MOST_LINES or n_characters > _MOST_CHARACTERS:
            break
    return [*comments], lines


def _lines_above_rows(cells: Sequence[Sequence[str]]) -> int | None:
    """Return the number of lines of text above the rows of numbers; None without rows."""
    is_row = [_is_row(row) for row in cells]
    n_cells = Counter(len(row) for row, has_values in zip(cells, is_row, strict=True) if has_values)
    if not n_cells:
        return None
    usual = n_cells.most_common(1)[0][0]
    first = next(place for place, row in enumerate(cells) if is_row[place] and len(row) == usual)
    # Rows with another number of cells may precede the first usual row. The text ends before them.
    return 1 + max((place for place in range(first) if not is_row[place]), default=-1)


def _is_row(cells: Sequence[str]) -> bool:
    """Whether cells are a row of values rather than names or other text."""
    filled = [cell for cell in cells if cell]
    n_values = sum(map(is_value, filled))
    has_number = any(is_number(cell) or is_date_or_time(cell) for cell in filled)
    return has_number and n_values >= _MIN_SHARE_OF_VALUES * len(filled)


# ---- joining of cells

# Joins cells of a row that belong to one column.
_Merge = Callable[[Sequence[str]], list[str]]


def _merged(split: CellsOf, merge: _Merge) -> CellsOf:
    """Return a function that splits a line and then joins cells."""
    return lambda line: merge(split(line))


def _without_last(cells: Sequence[str]) -> list[str]:
    """Drop an empty cell after the last separator."""
    return [*cells] if cells[-1] else [*cells[:-1]]


def _joining(widths: Sequence[int]) -> _Merge:
    """Return a function that joins neighbouring cells of a row into columns.

    ``widths`` are the numbers of cells of the columns, some of them 0. Rows with another total
    number of cells stay unchanged.
    """
    ends = np.cumsum([width for width in widths if width]).tolist()
    spans = list(zip([0, *ends[:-1]], ends, strict=True))

    def merge(cells: Sequence[str]) -> list[str]:
        if len(cells) != ends[-1]:
            return [*cells]
        return [" ".join(cells[start:end]) for start, end in spans]

    return merge


def _is_split_stamp(cells: Sequence[str]) -> bool:
    """Whether the first two cells are a date and a time of day."""
    return len(cells) > 1 and is_date(cells[0]) and ":" in cells[1] and is_date_or_time(cells[1])


# ---- names above the rows


class _Header(NamedTuple):
    """Names of the columns, if there are any, and a function that joins cells of one column."""

    names: tuple[str, ...] | None
    merge: _Merge | None = None


def _header_of(above: Sequence[str], row: list[str], separator: str) -> _Header:
    """Return the header of rows such as ``row``, from the lines above the rows."""
    header = _header_above(above, row, separator)
    if header:
        return header
    if not row[-1]:
        header = _header_above(above, row[:-1], separator)
        return _Header(header.names if header else None, _without_last)
    if _is_split_stamp(row):
        return _Header(None, _joining([2, *[1] * (len(row) - 2)]))
    return _Header(None)


def _header_above(above: Sequence[str], row: Sequence[str], separator: str) -> _Header | None:
    """Return the header from the lines above the rows; None if no line fits the row.

    The nearest line with known names is preferred. Without known names, the nearest line that fits
    and is not a comment is used.
    """
    unknown = None
    for place in reversed(range(len(above))):
        line = above[place]
        is_comment = line.startswith(COMMENTS)
        for names in names_in(line, separator):
            header = _fitted(names, row, is_comment)
            if header is None or header.names is None:
                continue
            if _is_known(header.names):
                below = above[place + 1] if place + 1 < len(above) else ""
                with_units = _with_units(header.names, below, separator)
                return header._replace(names=_with_stamp(with_units, row))
            if unknown is None and not is_comment:
                unknown = _Header(header.names)
    return unknown


def _refuse_other_number(
    path: str | Path, lines: Sequence[tuple[int, str]], row: Sequence[str], separator: str
) -> None:
    """Raise an InputError if a line above the rows names more or fewer columns than a row has."""
    for line_number, line in lines:
        names = names_in(line, separator)[0]
        if _is_known(names) and len(row) > 1:
            raise InputError(
                f"{path}, line {line_number}: names {len(names)} columns, but "
                f"the rows have {len(row)} cells; write one name for each "
                "column, or name all with `columns`"
            )


def _is_known(names: Sequence[str]) -> bool:
    """Whether some of the names are those of a pose, of rates or of an orientation."""
    columns = named_columns(names)[0].keys()
    return is_pose(columns) or {"x", "qw"} <= columns or {"roll", "pitch"} <= columns


def _fitted(names: Sequence[str], row: Sequence[str], is_comment: bool) -> _Header | None:
    """Return a header with one name for each cell of a row; None if the names do not fit.

    Cells may be joined to fit. If a comment has too many names, its last names are used, because
    its first words may be text such as "format:".
    """
    # A separator at the end of the line makes an empty name.
    if len(names) == len(row) + 1 and not names[-1]:
        names = names[:-1]
    if not names:
        return None
    for n_angle_cells in _ANGLE_CELLS:
        widths = _widths(names, row, n_angle_cells)
        if sum(widths) == len(row):
            return _header_of_widths(names, widths, row)
    n_missing = len(row) - len(names)
    if _is_open(names[-1]):
        # The last name stands for all further columns, which get empty names.
        if len(names) > 1 and n_missing >= -1:
            return _Header((*names[:-1], *[""] * (n_missing + 1)))
    elif is_comment and n_missing < 0:
        return _Header(tuple(names[-len(row) :]))
    return None


def _header_of_widths(names: Sequence[str], widths: Sequence[int], row: Sequence[str]) -> _Header:
    """Return the header of the names with cells, whose cells are joined by their widths."""
    names = [name for name, width in zip(names, widths, strict=True) if width]
    if max(widths) == 1:
        return _Header(_with_degrees(names, row))
    merge = _joining(widths)
    return _Header(_with_degrees(names, merge(row)), merge)


def _is_open(name: str) -> bool:
    """Whether the last name may belong to any number of columns, also to none."""
    return name.startswith("*") or name.endswith("...") or "cov" in name.lower()


# Numbers of cells that a latitude may have: degrees; degrees, minutes and seconds; degrees and
# minutes.
_ANGLE_CELLS = (1, 3, 2)
_HEMISPHERES = {"N", "S", "E", "W"}


def _places_of(names: Sequence[str], *quantities: str) -> set[int]:
    """Return the first column of each quantity; quantities without a column are skipped."""
    columns = named_columns(names)[0]
    return {columns[quantity][0] for quantity in quantities if quantity in columns}


def _widths(names: Sequence[str], row: Sequence[str], n_angle_cells: int) -> list[int]:
    """Return the number of cells of each name in a row.

    A name has no cells if its cell is joined to the name before, such as the cell of a hemisphere.
    """
    angles = _places_of(names, "lat", "lon")
    stamps = _places_of(names, "t", "date")
    all_have_names = len(names) == len(row)
    widths: list[int] = []
    place = 0
    for column in range(len(names)):
        width = 1
        if all_have_names and place > column:
            width = 0
        elif column in angles:
            next_cell = row[place + n_angle_cells : place + n_angle_cells + 1]
            width = n_angle_cells + len(_HEMISPHERES.intersection(next_cell))
        elif column in stamps and not all_have_names and _is_split_stamp(row[place:]):
            width = 2
        widths.append(width)
        place += width
    return widths


def _with_degrees(names: Sequence[str], row: Sequence[str]) -> tuple[str, ...]:
    """Append the unit "deg" to the names of angles in degrees, minutes and seconds."""
    with_units = [*names]
    for place in _places_of(names, "lat", "lon"):
        if not is_number(row[place]) and is_angle(row[place]):
            with_units[place] = f"{names[place]} [deg]"
    return tuple(with_units)


def _with_units(names: tuple[str, ...], below: str, separator: str) -> tuple[str, ...]:
    """Append the units in the line below the names, if this line has one unit for each name."""
    for units in names_in(below, separator) if below else []:
        if len(units) == len(names) and not _is_row(units):
            return tuple(map(" ".join, zip(names, units, strict=True)))
    return names


def _with_stamp(names: tuple[str, ...], row: Sequence[str]) -> tuple[str, ...]:
    """Rename a first column with an unknown name to "t" if it contains stamps since 1970."""
    columns = named_columns(names)[0].keys()
    has_stamp = not columns.isdisjoint({"t", "secs", *named_columns(names[:1])[0]})
    return names if has_stamp or not _SINCE_1970.fullmatch(row[0]) else ("t", *names[1:])


def _with_named_columns(layout: Layout, names: tuple[str, ...], is_separated: bool) -> Layout:
    """Set the format and the columns of a layout by the names above the rows."""
    if not is_separated and " ".join(names[1:]).lower() == TUM_COLUMNS.partition(" ")[2]:
        return replace(layout, format="tum", columns=TUM)
    return replace(layout, format="csv", columns=names)


# ---- numbers without names

# Possible columns of a pose without a stamp, in the order in which they are tried.
_POSES: tuple[tuple[str, ...], ...] = (
    (*MATRIX, *LAST_ROW),
    tuple(f"m{row}{column}" for column in "1234" for row in "1234"),
    MATRIX,
    (*ROTATION, *TRANSLATION),
    (*TRANSLATION, *ROTATION),
    (*POSITION, *UNNAMED),
    (*UNNAMED, *POSITION),
)
# Poses with a rotation matrix in separate columns, which may be written row by row or column by
# column.
_TRANSPOSABLE = _POSES[3:5]
# Column counts of a covariance after the pose: its diagonal, one half, or all elements.
_COVARIANCES = (6, 21, 36)
# Column counts for which several formats are possible.
_UNCLEAR = (4, 7)


def _with_fitting_columns(
    layout: Layout, rows: Sequence[Sequence[str]], is_separated: bool
) -> Layout:
    """Set the format and the columns of a layout without names from the values in its rows."""
    n_columns = len(layout.row)
    columns = _fitting(layout.row, rows)
    may_be_stamped_pose = columns is None or columns[: len(TUM)] == STAMPED_POSE
    is_long_enough = is_separated and n_columns >= len(TUM)
    if may_be_stamped_pose and is_long_enough and _is_in_ns(layout.row[0]):
        return replace(layout, format="euroc", columns=("t [ns]", *POSITION, *SCALAR_FIRST))
    if columns == STAMPED_POSE and not is_separated:
        return replace(layout, format="tum", columns=columns)
    if columns is not None:
        pose = tuple(name for name in columns if name in MATRIX)
        return replace(
            layout,
            format="kitti" if columns == MATRIX else "csv",
            columns=columns,
            is_transposable=pose in _TRANSPOSABLE,
        )
    return _in_doubt(layout, is_separated)


def _in_doubt(layout: Layout, is_separated: bool) -> Layout:
    """Set the format of a layout whose numbers fit nothing, by the number of its columns."""
    n_columns = len(layout.row)
    if is_separated or n_columns in _UNCLEAR:
        columns = STAMPED_POSE if n_columns == len(STAMPED_POSE) else None
        return replace(layout, format="csv", columns=columns)
    if n_columns == len(MATRIX):
        return replace(layout, format="kitti", columns=MATRIX)
    return replace(layout, format="tum", columns=STAMPED_POSE)


def _fitting(row: Sequence[str], rows: Sequence[Sequence[str]]) -> tuple[str, ...] | None:
    """Return columns that fit the numbers of the first rows; None if nothing fits.

    Cells of text have columns with empty names.
    """
    places = [place for place, cell in enumerate(row) if is_value(cell)]
    if not places:
        return None
    values = _complete(rows, places, len(row))
    # Numbers of a file may be too large for their squares.
    with np.errstate(all="ignore"):
        columns = _columns_of(values) if len(values) else None
    if columns is None:
        return None
    named = [""] * len(row)
    for place, name in zip(places, columns, strict=True):
        named[place] = name
    return tuple(named)


def _columns_of(values: FloatArray) -> tuple[str, ...] | None:
    """Return columns that fit numbers (N, n); None if nothing fits.

    The columns are a pose with or without a stamp, or a stamped pose and further columns.
    """
    if values.shape[1] == len(_FAST_LIO) and _is_gravity(values[:, -3:]):
        return _FAST_LIO
    return _pose_alone(values) or _pose_with_more(values)


def _pose_alone(values: FloatArray) -> tuple[str, ...] | None:
    """Return the columns of a pose with or without a stamp; None if numbers (N, n) do not fit."""
    stamps: list[tuple[str, ...]] = [(), ("t",)]
    if _are_seconds_and_ns(values):
        stamps.append(("secs", "nsecs"))
    for pose in _POSES:
        for stamp in stamps:
            columns = (*stamp, *pose)
            if len(columns) == values.shape[1] and _fits(pose, values[:, len(stamp) :]):
                return columns
    return None


def _pose_with_more(values: FloatArray) -> tuple[str, ...] | None:
    """Return the columns of a stamped pose and further columns; None if numbers do not fit."""
    for pose in _POSES:
        n_more = values.shape[1] - 1 - len(pose)
        # Any number of columns may follow a position and a quaternion.
        may_have_more = pose == STAMPED_POSE[1:] or n_more in _COVARIANCES
        if n_more > 0 and may_have_more and _fits(pose, values[:, 1 : 1 + len(pose)]):
            return ("t", *pose, *[""] * n_more)
    return None


def _complete(rows: Sequence[Sequence[str]], places: Sequence[int], n_columns: int) -> FloatArray:
    """Return the numbers (N, n) of the first rows in which all n cells are numbers.

    A first cell that is not a number, such as a date, becomes 0.
    """
    values: list[list[float]] = []
    for cells in islice((cells for cells in rows if len(cells) == n_columns), _MOST_ROWS):
        first, *others = (cells[place] for place in places)
        try:
            stamp = number(first) if is_number(first) else 0.0
            values.append([stamp, *map(number, others)])
        except ValueError:
            continue
    table = np.array(values, dtype=float).reshape(len(values), len(places))
    return table[np.isfinite(table).all(axis=1)]


def _fits(pose: Sequence[str], values: FloatArray) -> bool:
    """Whether values (N, n) can be those of a pose with these columns."""
    if UNNAMED[0] in pose:
        norms = np.linalg.norm(_values_of(UNNAMED, pose, values), axis=1)
        is_unit = np.abs(norms - 1.0) <= QUATERNION_NORM_TOLERANCE
        return bool(is_unit[norms > 0.0].all() and norms.any())
    Rs = _values_of(ROTATION, pose, values).reshape(-1, 3, 3)
    Rs = Rs[Rs.any(axis=(1, 2))]
    errors = np.abs(Rs @ np.swapaxes(Rs, 1, 2) - np.eye(3))
    if not len(Rs) or not (errors <= ROTATION_TOLERANCE).all():
        return False
    if LAST_ROW[0] not in pose:
        return True
    last_rows = _values_of(LAST_ROW, pose, values)
    return bool(np.allclose(last_rows, [0.0, 0.0, 0.0, 1.0], atol=ROTATION_TOLERANCE))


def _values_of(names: Sequence[str], pose: Sequence[str], values: FloatArray) -> FloatArray:
    return values[:, [pose.index(name) for name in names]]


def _are_seconds_and_ns(values: FloatArray) -> bool:
    """Whether the first two columns are whole seconds since 1970 and whole nanoseconds."""
    stamps = values[:, :2]
    is_whole = (stamps == np.round(stamps)).all()
    # Seconds since 1970 have ten digits.
    is_since_1970 = (stamps[:, 0] >= 1e9).all()
    nanoseconds = stamps[:, -1]
    is_below_second = ((nanoseconds >= 0) & (nanoseconds < 1e9)).all()
    return bool(is_whole and is_since_1970 and is_below_second)


def _is_gravity(values: FloatArray) -> bool:
    """Whether vectors (N, 3) have the length of gravity."""
    lengths = np.linalg.norm(values, axis=1)
    shortest, longest = _GRAVITY_M_S2
    return bool(((lengths >= shortest) & (lengths <= longest)).all())


def _is_in_ns(cell: str) -> bool:
    """Whether a cell has nanoseconds since 1970."""
    return cell.isdecimal() and len(cell) >= DIGITS["ns"]
