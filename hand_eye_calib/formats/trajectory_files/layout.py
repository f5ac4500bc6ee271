"""Layout of a text file with rows of numbers.

The layout states where the rows begin, what separates their cells, and the quantity of each column,
recognised by the names above the rows or by the numbers themselves.
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

# Lines that are no comments, from which the layout is recognised. Text above the columns has some
# twenty lines, sometimes a hundred.
_MOST_LINES = 300
# Characters of these lines.
_MOST_CHARACTERS = 1 << 19
# Comments just above the first of these lines.
_MOST_COMMENTS = 100
# Rows whose numbers are compared with what a column may be.
_MOST_ROWS = 100
# Smallest share of values among the cells of a row: a row may also have names of frames.
_LEAST_SHARE = 0.5

#: Columns of a row in the format tum.
TUM = ("t", *POSITION, "qx", "qy", "qz", "qw")
#: Columns of a stamp and a pose whose quaternion may be in either order.
STAMPED_POSE = ("t", *POSITION, *UNNAMED)
# Columns of the state that FAST-LIO and its relatives write: a stamp, a rotation vector, a
# position, and five vectors of which the last is gravity.
_FAST_LIO = ("t", *ROTATION_VECTOR, *POSITION, *[""] * 18)
# Range of lengths of gravity (m/s^2).
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
        Names of the columns above the rows.
    format : str
        Format that the rows look like; "tum" in doubt, so that its reader reports the problem.
    columns : tuple of str, optional
        Columns in that format, if they are known.
    is_transposable : bool
        Whether rows and columns of the rotation could be exchanged.
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

    If ``after`` is given, comments and the lines up to this line are skipped.

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

    ``needs_names`` is True if no option names the columns.

    Raises
    ------
    InputError
        For a line that is too long, and for another number of names than of columns.
    """
    comments, lines = _beginning(path, text)
    separator = separator_of([line for _, line in lines])
    split = splitter(separator)
    cells = [split(line) for _, line in lines]
    n_above = _lines_above_rows(cells)
    if n_above is None:
        return _layout_without_rows(lines, separator)
    above = [*comments, *(line for _, line in lines[:n_above])]
    row = _usual_row(cells[n_above:])
    header = _header_above(above, row, separator)
    merge = header.merge if header else None
    if header is None and not row[-1]:
        row = row[:-1]
        merge = _without_last
        header = _header_above(above, row, separator)
    if header is None:
        if needs_names:
            _refuse_other_number(path, lines[:n_above], row, separator)
        if merge is None and _is_split_stamp(row):
            merge = _joining([2, *[1] * (len(row) - 2)])
    cells_of = _merged(split, merge) if merge else split
    rows = [cells_of(line) for _, line in lines[n_above:]]
    rows_after = lines[n_above - 1][0] if n_above else 0
    layout = Layout(rows_after, cells_of, _usual_row(rows), header.names if header else None)
    is_separated = separator in (",", ";")
    if layout.names is not None:
        return _with_named_columns(layout, is_separated)
    return _with_fitting_columns(layout, rows, is_separated)


def _layout_without_rows(lines: Sequence[tuple[int, str]], separator: str) -> Layout:
    """Return the layout of a text without numbers: its last line may name columns."""
    split = splitter(separator)
    if not lines:
        return Layout(0, split, [], None, "tum", STAMPED_POSE)
    names = tuple(names_in(lines[-1][1], separator)[0])
    return Layout(lines[0][0], split, [], names, "csv", names)


def _usual_row(rows: Sequence[list[str]]) -> list[str]:
    """Return the first row with the most frequent number of cells."""
    n_cells = Counter(map(len, rows)).most_common(1)[0][0]
    return next(row for row in rows if len(row) == n_cells)


def _beginning(path: str | Path, text: str) -> tuple[list[str], list[tuple[int, str]]]:
    """Return the comments above the first other line, and the first lines that are no comments."""
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
    # Rows with another number of cells may be above the first usual row. Text is above them all.
    return 1 + max((place for place in range(first) if not is_row[place]), default=-1)


def _is_row(cells: Sequence[str]) -> bool:
    """Whether cells are a row of values rather than names or other text."""
    filled = [cell for cell in cells if cell]
    n_values = sum(map(is_value, filled))
    has_number = any(is_number(cell) or is_date_or_time(cell) for cell in filled)
    return has_number and n_values >= _LEAST_SHARE * len(filled)


# ---- joining of cells

# Joins cells of a row that belong to one column.
_Merge = Callable[[Sequence[str]], list[str]]


def _merged(split: CellsOf, merge: _Merge) -> CellsOf:
    return lambda line: merge(split(line))


def _without_last(cells: Sequence[str]) -> list[str]:
    """Drop an empty cell behind the last separator."""
    return [*cells] if cells[-1] else [*cells[:-1]]


def _joining(widths: Sequence[int]) -> _Merge:
    """Return a function that joins neighbouring cells of a row into columns.

    ``widths`` are the numbers of cells in the columns; columns of width 0 have no cell.
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
    """Names of the columns, and the joining of the cells that belong to one name."""

    names: tuple[str, ...]
    merge: _Merge | None = None


def _header_above(above: Sequence[str], row: Sequence[str], separator: str) -> _Header | None:
    """Return the names of the columns from the lines above the rows; None without such a line.

    The nearest line with known names counts, then the nearest line that fits and is no comment.
    """
    unknown = None
    for place in reversed(range(len(above))):
        line = above[place]
        is_comment = line.startswith(COMMENTS)
        for names in names_in(line, separator):
            header = _fitted(names, row, is_comment)
            if header is None:
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
    """Raise an InputError if a line above the rows names another number of columns."""
    for line_number, line in lines:
        names = names_in(line, separator)[0]
        if _is_known(names) and len(row) > 1:
            raise InputError(
                f"{path}, line {line_number}: names {len(names)} columns, but "
                f"the rows have {len(row)} cells; write one name for each "
                "column, or name all with `columns`"
            )


def _is_known(names: Sequence[str]) -> bool:
    columns = named_columns(names)[0].keys()
    return is_pose(columns) or {"x", "qw"} <= columns or {"roll", "pitch"} <= columns


def _fitted(names: Sequence[str], row: Sequence[str], is_comment: bool) -> _Header | None:
    """Return as many names as a row has cells, or joined cells; None if the names do not fit.

    If a comment has too many names, its last names count: the first may be a word like "format:".
    """
    if len(names) == len(row) + 1 and not names[-1]:
        names = names[:-1]
    if not names:
        return None
    for n_angle_cells in _ANGLE_CELLS:
        widths = _widths(names, row, n_angle_cells)
        if sum(widths) == len(row):
            return _header_of_widths(names, widths, row)
    n_more = len(row) - len(names)
    if _is_open(names[-1]):
        if len(names) > 1 and n_more >= -1:
            return _Header((*names[:-1], *[""] * (n_more + 1)))
    elif is_comment and n_more < 0:
        return _Header(tuple(names[-len(row) :]))
    return None


def _header_of_widths(names: Sequence[str], widths: Sequence[int], row: Sequence[str]) -> _Header:
    """Return the names that have cells, and the joining of their cells."""
    kept = [name for name, width in zip(names, widths, strict=True) if width]
    if max(widths) == 1:
        return _Header(_with_degrees(kept, row))
    merge = _joining(widths)
    return _Header(_with_degrees(kept, merge(row)), merge)


def _is_open(name: str) -> bool:
    """Whether the last name belongs to any number of columns, also to none."""
    return name.startswith("*") or name.endswith("...") or "cov" in name.lower()


# Numbers of cells of a latitude: degrees; degrees, minutes and seconds; degrees and minutes.
_ANGLE_CELLS = (1, 3, 2)
_HEMISPHERES = {"N", "S", "E", "W"}


def _places_of(names: Sequence[str], *quantities: str) -> set[int]:
    """Return the first column of each of the quantities that have one."""
    columns = named_columns(names)[0]
    return {columns[quantity][0] for quantity in quantities if quantity in columns}


def _widths(names: Sequence[str], row: Sequence[str], n_angle_cells: int) -> list[int]:
    """Return the number of cells of a row that each name has.

    A name has no cells if its cell belongs to the name before, as the cell of a hemisphere does.
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
    """Add the unit to the names of angles in degrees, minutes and seconds."""
    with_units = [*names]
    for place in _places_of(names, "lat", "lon"):
        if not is_number(row[place]) and is_angle(row[place]):
            with_units[place] = f"{names[place]} [deg]"
    return tuple(with_units)


def _with_units(names: tuple[str, ...], below: str, separator: str) -> tuple[str, ...]:
    """Add the units in the line below the names, if it has as many cells."""
    ways = names_in(below, separator) if below else []
    for units in ways:
        if len(units) == len(names) and not _is_row(units):
            return tuple(map(" ".join, zip(names, units, strict=True)))
    return names


def _with_stamp(names: tuple[str, ...], row: Sequence[str]) -> tuple[str, ...]:
    """Rename a first column of unknown name to "t" if it has stamps since 1970."""
    columns = named_columns(names)[0].keys()
    has_stamp = not columns.isdisjoint({"t", "secs", *named_columns(names[:1])[0]})
    return names if has_stamp or not _SINCE_1970.fullmatch(row[0]) else ("t", *names[1:])


def _with_named_columns(layout: Layout, is_separated: bool) -> Layout:
    """Return the layout with its format and columns, by the names above the rows."""
    names = layout.names or ()
    if not is_separated and " ".join(names[1:]).lower() == TUM_COLUMNS.partition(" ")[2]:
        return replace(layout, format="tum", columns=TUM)
    return replace(layout, format="csv", columns=names)


# ---- numbers without names

# Columns of a pose without a stamp: the numbers are compared with each in turn.
_POSES: tuple[tuple[str, ...], ...] = (
    (*MATRIX, *LAST_ROW),
    tuple(f"m{row}{column}" for column in "1234" for row in "1234"),
    MATRIX,
    (*ROTATION, *TRANSLATION),
    (*TRANSLATION, *ROTATION),
    (*POSITION, *UNNAMED),
    (*UNNAMED, *POSITION),
)
# Poses whose rotations are apart from the translations.
_TRANSPOSABLE = _POSES[3:5]
# Numbers of a pose's covariance behind the pose: its diagonal, one half, or all.
_COVARIANCES = (6, 21, 36)
# Numbers of columns that could be several things, which their numbers do not distinguish.
_UNCLEAR = (4, 7)


def _with_fitting_columns(
    layout: Layout, rows: Sequence[Sequence[str]], is_separated: bool
) -> Layout:
    """Return the layout with its format and columns, by the numbers of rows without names."""
    n_columns = len(layout.row)
    columns = _fitting(layout.row, rows)
    is_stamped_pose = columns is None or columns[: len(TUM)] == STAMPED_POSE
    if is_stamped_pose and is_separated and n_columns >= len(TUM) and _is_in_ns(layout.row[0]):
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
    if is_separated or n_columns in _UNCLEAR:
        return replace(layout, format="csv", columns=STAMPED_POSE if n_columns == 8 else None)
    if n_columns == len(MATRIX):
        return replace(layout, format="kitti", columns=MATRIX)
    return replace(layout, format="tum", columns=STAMPED_POSE)


def _fitting(row: Sequence[str], rows: Sequence[Sequence[str]]) -> tuple[str, ...] | None:
    """Return the columns that the numbers of the first rows fit, with empty names for the others.

    None if the numbers fit nothing, or no row is complete.
    """
    places = [place for place, cell in enumerate(row) if is_value(cell)]
    if not places:
        return None
    values = _complete(rows, places, len(row))
    with np.errstate(all="ignore"):  # numbers may be of any size
        columns = _columns_of(values) if len(values) else None
    if columns is None:
        return None
    named = [""] * len(row)
    for place, name in zip(places, columns, strict=True):
        named[place] = name
    return tuple(named)


def _columns_of(values: FloatArray) -> tuple[str, ...] | None:
    """Return the columns that numbers (N, n) fit; None if they fit nothing.

    They are a pose with or without a stamp, or a stamped pose and other columns behind it.
    """
    n_columns = values.shape[1]
    if n_columns == len(_FAST_LIO) and _is_gravity(values[:, -3:]):
        return _FAST_LIO
    stamps: tuple[tuple[str, ...], ...] = ((), ("t",))
    if _are_seconds_and_ns(values):
        stamps = (*stamps, ("secs", "nsecs"))
    for pose in _POSES:
        for stamp in stamps:
            has_length = len(stamp) + len(pose) == n_columns
            if has_length and _fits(pose, values[:, len(stamp) :]):
                return (*stamp, *pose)
    for pose in _POSES:
        n_more = n_columns - 1 - len(pose)
        # Behind a position and a quaternion any number of others may be.
        may_have_more = pose == STAMPED_POSE[1:] or n_more in _COVARIANCES
        if n_more > 0 and may_have_more and _fits(pose, values[:, 1 : 1 + len(pose)]):
            return ("t", *pose, *[""] * n_more)
    return None


def _complete(rows: Sequence[Sequence[str]], places: Sequence[int], n_columns: int) -> FloatArray:
    """Return the numbers (N, n) of the first rows that have all of them.

    A stamp in the first cell that is no number becomes 0.
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
    """Whether the columns of a pose, in this order, can have these values (N, n)."""
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
    """Whether vectors (N, 3) are as long as gravity."""
    lengths = np.linalg.norm(values, axis=1)
    shortest, longest = _GRAVITY_M_S2
    return bool(((lengths >= shortest) & (lengths <= longest)).all())


def _is_in_ns(cell: str) -> bool:
    """Whether a cell has nanoseconds since 1970."""
    return cell.isdecimal() and len(cell) >= DIGITS["ns"]
