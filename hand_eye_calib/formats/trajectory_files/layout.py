"""The layout of a text file with rows of numbers: where the rows begin, what separates their cells,
and what each column is, by names above the rows or by the numbers themselves.
"""

import re
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

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

#: Digits before the point of stamps since 1970; of seconds, fewer.
DIGITS = {"ns": 17, "us": 14, "ms": 11}
COMMENTS = ("#", "//")
_LINE = re.compile(r"\S[^\r\n]*")

# Lines that are no comments, and characters of them, that are looked at before any is read; and
# comments just above the first of them. Text above the columns has some twenty lines, sometimes
# a hundred.
_MOST_LINES = 300
_MOST_CHARACTERS = 1 << 19
_MOST_COMMENTS = 100
# Rows whose numbers are compared with what a column may be.
_MOST_ROWS = 100
# Share of the cells of a row that are numbers, at least: it may have names of frames.
_LEAST_SHARE = 0.5

#: Columns of a row in format tum, and a stamp and a pose with a quaternion whose order is to be
#: found.
TUM = ("t", *POSITION, "qx", "qy", "qz", "qw")
STAMPED_POSE = ("t", *POSITION, *UNNAMED)
# Columns of the state that FAST-LIO and its relatives write: a stamp, a rotation vector, a
# position, and five vectors of which the last is gravity.
_FAST_LIO = ("t", *ROTATION_VECTOR, *POSITION, *[""] * 18)
_GRAVITY_M_S2 = (9.6, 10.0)
# Seconds since 1970 have ten digits.
_LEAST_SECONDS = 1e9
_SINCE_1970 = re.compile(r"\d{10,}(\.\d*)?", re.ASCII)


@dataclass(frozen=True)
class Layout:
    """The layout of a text.

    Attributes
    ----------
    rows_after : int
        Number of the last line above the rows.
    cells_of : callable
        Splits a row into cells.
    row : list of str
        Cells of the first row; empty without any.
    names : tuple of str, optional
        Names of the columns above the rows.
    format : str
        What the rows look like; "tum" in doubt, so that its reader names what is wrong.
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
    """The lines of a text that are not blank, with their numbers; those after one that are no
    comments.
    """
    number = 1
    end = 0
    for line in _LINE.finditer(text):
        number += text.count("\n", end, line.start())
        end = line.end()
        if end - line.start() > LONGEST_LINE:
            raise InputError(f"{path}, line {number}: longer than {LONGEST_LINE} characters")
        if after is None or (number > after and not line[0].startswith(COMMENTS)):
            yield number, line[0].rstrip()


def layout_of(path: str | Path, text: str, needs_names: bool) -> Layout:
    """The layout of a text; ``needs_names`` if no option says what the columns are. Raises an
    InputError for a line that is too long, and for names that are not as many as the columns.
    """
    comments, lines = _beginning(path, text)
    separator = separator_of([line for _, line in lines])
    split = splitter(separator)
    cells = [split(line) for _, line in lines]
    first_row, n_above = _first_row(cells)
    above = [*comments, *(line for _, line in lines[:n_above])]
    rows_after = lines[n_above - 1][0] if n_above else 0
    if first_row is None:
        last = lines[-1][1] if lines else ""
        of_last = tuple(names_in(last, separator)[0]) if last else None
        columns = STAMPED_POSE if of_last is None else of_last
        return Layout(rows_after, split, [], of_last, "tum" if of_last is None else "csv", columns)
    rows = cells[first_row:]
    row = _usual_row(rows)
    names, merge = _names_above(above, row, separator)
    if names is None and not row[-1]:
        row = row[:-1]
        merge = _without_last
        names, _ = _names_above(above, row, separator)
    if names is None:
        if needs_names:
            _refuse_other_number(path, lines[:n_above], row, separator)
        merge = merge or _of_stamps(row)
    cells_of = split if merge is None else _merged(split, merge)
    rows = [cells_of(line) for _, line in lines[first_row:]]
    layout = Layout(rows_after, cells_of, _usual_row(rows), names)
    return _by_names_or_numbers(layout, rows, "," in separator or ";" in separator)


def _usual_row(rows: Sequence[list[str]]) -> list[str]:
    """The first row that has as many cells as most."""
    n_cells = Counter(map(len, rows)).most_common(1)[0][0]
    return next(row for row in rows if len(row) == n_cells)


def _merged(split: CellsOf, merge: "_Merge") -> CellsOf:
    return lambda line: merge(split(line))


def _without_last(cells: Sequence[str]) -> list[str]:
    """Cells without an empty one behind the last separator."""
    return [*cells] if cells[-1] else [*cells[:-1]]


def _beginning(path: str | Path, text: str) -> tuple[list[str], list[tuple[int, str]]]:
    """The comments above the first line that is none, and the first lines that are none."""
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


def _first_row(cells: Sequence[Sequence[str]]) -> tuple[int | None, int]:
    """Which line is the first row of numbers, if any, and how many lines of text are above."""
    is_row = [_is_row(row) for row in cells]
    counts = Counter(len(row) for row, is_one in zip(cells, is_row, strict=True) if is_one)
    if not counts:
        return None, len(cells[:1])
    usual = counts.most_common(1)[0][0]
    first = next(place for place, row in enumerate(cells) if is_row[place] and len(row) == usual)
    # Rows above it that have another number of cells are rows, too, unless text follows.
    n_above = 1 + max((place for place in range(first) if not is_row[place]), default=-1)
    return n_above, n_above


def _is_row(cells: Sequence[str]) -> bool:
    """Whether cells are those of a row of values rather than of names or other text."""
    n_filled = sum(bool(cell) for cell in cells)
    n_values = sum(is_value(cell) for cell in cells if cell)
    has_number = any(is_number(cell) or is_date_or_time(cell) for cell in cells)
    return has_number and n_values >= _LEAST_SHARE * n_filled


# ---- names above the rows

_Merge = Callable[[Sequence[str]], list[str]]


def _names_above(
    above: Sequence[str], row: Sequence[str], separator: str
) -> tuple[tuple[str, ...] | None, _Merge | None]:
    """Return the names of the columns, and what joins cells that belong to one name.

    The nearest line above the rows with known names counts, then the nearest that fits and is no
    comment. Both are None if there is no such line.
    """
    unknown: tuple[str, ...] | None = None
    for place in reversed(range(len(above))):
        line = above[place]
        for names in names_in(line, separator):
            fit = _fitted(names, row, line.startswith(COMMENTS))
            if fit is None:
                continue
            fitted, merge = fit
            if _is_known(fitted):
                below = above[place + 1] if place + 1 < len(above) else ""
                with_units = _with_units(fitted, below, separator)
                return _with_stamp(with_units, row), merge
            if unknown is None and not line.startswith(COMMENTS):
                unknown = fitted
    return unknown, None


def _refuse_other_number(
    path: str | Path, lines: Sequence[tuple[int, str]], row: Sequence[str], separator: str
) -> None:
    """Raise an InputError if a line above the rows names known columns, but not as many as there
    are.
    """
    for line_number, line in lines:
        names = names_in(line, separator)[0]
        if _is_known(names) and len(row) > 1:
            raise InputError(
                f"{path}, line {line_number}: names {len(names)} columns, but the rows have "
                f"{len(row)} cells; give each column one name, or name all with `columns`"
            )


def _is_known(names: Sequence[str]) -> bool:
    columns = named_columns(names)[0].keys()
    return is_pose(columns) or {"x", "qw"} <= columns or {"roll", "pitch"} <= columns


def _fitted(
    names: Sequence[str], row: Sequence[str], is_comment: bool
) -> tuple[tuple[str, ...], _Merge | None] | None:
    """Names that are as many as the cells of a row, and what joins cells for that; None if they do
    not fit. Of a comment the last names count, as after "format:".
    """
    if len(names) == len(row) + 1 and not names[-1]:
        names = names[:-1]
    for n_angle_cells in _ANGLE_CELLS:
        widths = _widths(names, row, n_angle_cells)
        if sum(widths) == len(row):
            merge = _joining(widths) if max(widths, default=1) > 1 else None
            return _of_angles(names, widths, merge(row) if merge else row), merge
    if is_comment and len(names) > len(row) and not _is_open(names[-1]):
        return tuple(names[-len(row) :]), None
    if len(names) > 1 and _is_open(names[-1]):
        n_more = len(row) - len(names) + 1
        return ((*names[:-1], *[""] * n_more), None) if n_more >= 0 else None
    return None


def _is_open(name: str) -> bool:
    """Whether a name, the last, is of any number of columns, or of none."""
    return name.startswith("*") or name.endswith("...") or "cov" in name.lower()


# A latitude is one number, degrees, minutes and seconds, or degrees and minutes.
_ANGLE_CELLS = (1, 3, 2)
_SIDES = {"N", "S", "E", "W"}
_ANGLES = ("lat", "lon")


def _widths(names: Sequence[str], row: Sequence[str], n_angle_cells: int) -> list[int]:
    """How many cells of a row each name has: 0 for a name of a cell that belongs to the one before,
    such as that of a hemisphere.
    """
    columns = named_columns(names)[0]
    angles = {columns[name][0] for name in _ANGLES if name in columns}
    stamps = {columns[name][0] for name in ("t", "date") if name in columns}
    all_have_names = len(names) == len(row)
    widths: list[int] = []
    place = 0
    for column in range(len(names)):
        if widths and all_have_names and sum(widths) > column:
            widths.append(0)
            continue
        width = n_angle_cells if column in angles else 1
        if column in angles and _SIDES.intersection(row[place + width : place + width + 1]):
            width += 1
        if column in stamps and not all_have_names and _is_split_stamp(row[place:]):
            width = 2
        widths.append(width)
        place += width
    return widths


def _of_angles(names: Sequence[str], widths: Sequence[int], row: Sequence[str]) -> tuple[str, ...]:
    """The names with a width; with their unit if their cells are angles in degrees, minutes and
    seconds.
    """
    kept = [(name, width) for name, width in zip(names, widths, strict=True) if width]
    columns = named_columns([name for name, _ in kept])[0]
    angles = {columns[name][0] for name in _ANGLES if name in columns}
    named = [name for name, _ in kept]
    for place in angles:
        if not is_number(row[place]) and is_angle(row[place]):
            named[place] = f"{named[place]} [deg]"
    return tuple(named)


def _is_split_stamp(cells: Sequence[str]) -> bool:
    """Whether the first two cells are a date and a time of day."""
    return len(cells) > 1 and is_date(cells[0]) and ":" in cells[1] and is_date_or_time(cells[1])


def _joining(widths: Sequence[int]) -> _Merge:
    """A function that joins cells, as many as each width."""
    ends = np.cumsum([width for width in widths if width]).tolist()
    spans = list(zip([0, *ends[:-1]], ends, strict=True))

    def merge(cells: Sequence[str]) -> list[str]:
        if len(cells) != ends[-1]:
            return [*cells]
        return [" ".join(cells[start:end]) for start, end in spans]

    return merge


def _of_stamps(row: Sequence[str]) -> _Merge | None:
    """What joins a date and a time of day at the beginning of rows without names."""
    if not _is_split_stamp(row):
        return None
    return _joining([2, *[1] * (len(row) - 2)])


def _with_units(names: Sequence[str], below: str, separator: str) -> tuple[str, ...]:
    """Names with units from the line below them."""
    for units in names_in(below, separator) if below else []:
        if len(units) == len(names) and not _is_row(units):
            return tuple(" ".join(pair) for pair in zip(names, units, strict=True))
    return tuple(names)


def _with_stamp(names: tuple[str, ...], row: Sequence[str]) -> tuple[str, ...]:
    """Names with "t" for a first column without a known name that has stamps since 1970."""
    columns = named_columns(names)[0]
    of_first = named_columns(names[:1])[0]
    if {"t", "secs", *of_first} & columns.keys() or not _SINCE_1970.fullmatch(row[0]):
        return names
    return ("t", *names[1:])


# ---- numbers without names

# Columns of a pose without a stamp; the first that the numbers fit is taken.
_POSES: tuple[tuple[str, ...], ...] = (
    (*MATRIX, *LAST_ROW),
    tuple(f"m{row}{column}" for column in "1234" for row in "1234"),
    MATRIX,
    (*ROTATION, *TRANSLATION),
    (*TRANSLATION, *ROTATION),
    (*POSITION, *UNNAMED),
    (*UNNAMED, *POSITION),
)
_TRANSPOSABLE = _POSES[3:5]
# Numbers of a covariance of a pose behind it: its diagonal, one half, or all. Behind a position
# and a quaternion any number of others may be.
_COVARIANCES = (6, 21, 36)


def _by_names_or_numbers(
    layout: Layout, rows: Sequence[Sequence[str]], is_separated: bool
) -> Layout:
    """The layout with its format and columns: those with names, or those that the numbers fit."""
    names = layout.names
    n_columns = len(layout.row)
    if names is not None:
        is_tum = " ".join(names[1:]).lower() == TUM_COLUMNS.partition(" ")[2]
        if is_tum and not is_separated:
            return replace(layout, format="tum", columns=TUM)
        return replace(layout, format="csv", columns=names)
    is_euroc = is_separated and n_columns >= len(TUM) and _is_in_ns(layout.row[0])
    columns = _fitting(layout.row, rows)
    is_usual = columns is None or columns[: len(TUM)] == STAMPED_POSE
    if is_euroc and is_usual:
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


# Numbers of columns that could be several things, none of which can be seen in the numbers.
_UNCLEAR = (4, 7)


def _fitting(row: Sequence[str], rows: Sequence[Sequence[str]]) -> tuple[str, ...] | None:
    """The columns that the numbers of the first rows fit, with empty names for others; None if they
    fit nothing, or no row is complete.
    """
    places = [place for place, cell in enumerate(row) if is_value(cell)]
    values = _complete(rows, places, len(row))
    if not len(values):
        return None
    columns = _columns_of(values)
    if columns is None:
        return None
    named = [""] * len(row)
    for place, name in zip(places, columns, strict=True):
        named[place] = name
    return tuple(named)


def _columns_of(values: FloatArray) -> tuple[str, ...] | None:
    """The columns that numbers (N, n) fit: a pose, with a stamp before it or not, and perhaps other
    columns behind a stamped one.
    """
    n_columns = values.shape[1]
    n_fast_lio = len(_FAST_LIO)
    if n_columns == n_fast_lio and _is_gravity(values[:, -3:]):
        return _FAST_LIO
    for pose in _POSES:
        for stamp in ((), ("t",), ("secs", "nsecs")):
            columns = (*stamp, *pose)
            if len(columns) != n_columns or not _fits(pose, values[:, len(stamp) :]):
                continue
            if len(stamp) < 2 or _are_seconds_and_ns(values):
                return columns
    for pose in _POSES:
        n_more = n_columns - 1 - len(pose)
        may_have_more = pose == STAMPED_POSE[1:] or n_more in _COVARIANCES
        if n_more > 0 and may_have_more and _fits(pose, values[:, 1 : 1 + len(pose)]):
            return ("t", *pose, *[""] * n_more)
    return None


def _complete(rows: Sequence[Sequence[str]], places: Sequence[int], n_columns: int) -> FloatArray:
    """The numbers (N, n) of the first rows that have all of them but the stamp; 0 for a first cell
    that is a time.
    """
    values: list[list[float]] = []
    for cells in islice((cells for cells in rows if len(cells) == n_columns), _MOST_ROWS):
        try:
            numbers = [number(cells[place]) for place in places[1:]]
            first = number(cells[places[0]]) if is_number(cells[places[0]]) else 0.0
        except ValueError:
            continue
        values.append([first, *numbers])
    table = np.array(values, dtype=float).reshape(len(values), len(places))
    return table[np.isfinite(table).all(axis=1)]


def _fits(pose: Sequence[str], values: FloatArray) -> bool:
    """Whether the columns of a pose, in this order, can have these values (N, n)."""
    with np.errstate(all="ignore"):
        if pose[0] in UNNAMED or pose[-1] in UNNAMED:
            start = pose.index(UNNAMED[0])
            norms = np.linalg.norm(values[:, start : start + len(UNNAMED)], axis=1)
            is_unit = np.abs(norms - 1.0) <= QUATERNION_NORM_TOLERANCE
            return bool(is_unit[norms > 0.0].all() and norms.any())
        places = [pose.index(name) for name in ROTATION]
        Rs = values[:, places].reshape(-1, 3, 3)
        Rs = Rs[Rs.any(axis=(1, 2))]
        errors = np.abs(Rs @ np.swapaxes(Rs, 1, 2) - np.eye(3))
        if not len(Rs) or not (errors <= ROTATION_TOLERANCE).all():
            return False
        if LAST_ROW[0] not in pose:
            return True
        last_row = values[:, [pose.index(name) for name in LAST_ROW]]
        return bool(np.allclose(last_row, [0.0, 0.0, 0.0, 1.0], atol=ROTATION_TOLERANCE))


def _are_seconds_and_ns(values: FloatArray) -> bool:
    """Whether the first two columns are whole seconds since 1970 and whole nanoseconds."""
    whole = values[:, :2]
    is_whole = bool((whole == np.round(whole)).all())
    since_1970 = bool((whole[:, 0] >= _LEAST_SECONDS).all())
    return is_whole and since_1970 and bool(((whole[:, 1] >= 0) & (whole[:, 1] < 1e9)).all())


def _is_gravity(values: FloatArray) -> bool:
    """Whether vectors (N, 3) are as long as gravity."""
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(values, axis=1)
    least, most = _GRAVITY_M_S2
    return bool(((lengths >= least) & (lengths <= most)).all())


def _is_in_ns(cell: str) -> bool:
    """Whether a cell has nanoseconds since 1970."""
    return cell.isdecimal() and len(cell) >= DIGITS["ns"]
