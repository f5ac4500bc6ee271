"""Layout of a text file with rows of numbers.

A layout contains the line where the rows begin, the separator of their cells, and the quantity of
each column (x, qw, ...). The quantities are recognised by the names above the rows or, without
names, by the values (``recognition.py``).
"""

import re
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import NamedTuple

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.formats.files import LONGEST_LINE
from hand_eye_calib.formats.trajectory_files.cells import (
    CellsOf,
    are_whole,
    is_angle,
    is_number,
    is_value,
    names_in,
    separator_of,
    splitter,
)
from hand_eye_calib.formats.trajectory_files.columns import (
    MATRIX,
    POSITION,
    SCALAR_FIRST,
    TUM_COLUMNS,
    is_pose,
    named_columns,
)
from hand_eye_calib.formats.trajectory_files.dates import (
    is_date,
    is_date_or_time,
)
from hand_eye_calib.formats.trajectory_files.recognition import (
    STAMPED_POSE,
    TRANSPOSABLE,
    columns_of_rows,
)

#: Smallest exponents of 10 for stamps since 1970 in ns, us and ms; smaller stamps are in seconds.
#: The limits correspond to March 1973, so the unit of later stamps is clear.
UNIT_EXPONENTS = {"ns": 17, "us": 14, "ms": 11}
COMMENTS = ("#", "//")
#: Remedy for commas both between cells and in numbers.
DECIMAL_COMMAS = (
    "their numbers seem to have decimal commas: export with decimal points, or with ; "
    "between cells"
)
_LINE = re.compile(r"\S[^\r\n]*")

# The layout is recognised from at most this number of lines, without comments. Text above the
# columns usually has about 20 lines, sometimes 100.
_MOST_LINES = 300
# The layout is recognised from at most this number of characters.
_MOST_CHARACTERS = 1 << 19
# Column names are searched for in at most this number of comments, the last ones above the first
# row.
_MOST_COMMENTS = 100
# Smallest share of values among the cells of a row of numbers. Other cells may be frame names.
_MIN_SHARE_OF_VALUES = 0.5

#: Quantities of the columns in the format tum.
TUM = ("t", *POSITION, "qx", "qy", "qz", "qw")
# Stamp since 1970 in any unit. In seconds it has ten digits.
_SINCE_1970 = re.compile(r"\d{10,}(\.\d*)?", re.ASCII)


@dataclass(frozen=True)
class Layout:
    """Layout of a text.

    Attributes
    ----------
    rows_after : int
        Number of the last line above the rows (from 1); 0 if there is no such line.
    cells_of : callable
        Function that splits a row into cells.
    row : list of str
        Cells of the first row; empty without rows.
    names : tuple of str, optional
        Names of the columns, from a line above the rows.
    format : str
        Format of the rows. It is "tum" if no format fits, so that the error describes a row of this
        format.
    columns : tuple of str, optional
        Quantities of the columns; None if unknown.
    is_transposable : bool
        Whether a rotation matrix may be stored by rows or by columns.
    """

    rows_after: int
    cells_of: CellsOf
    row: list[str]
    names: tuple[str, ...] | None
    format: str = "tum"
    columns: tuple[str, ...] | None = None
    is_transposable: bool = False


def lines_of(
    path: str | Path, text: str, after: int | None = None
) -> Iterator[tuple[int, str]]:
    """Yield the number and the text of each line that is not blank.

    With ``after``, comments and all lines up to this line number are skipped.

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
            raise InputError(
                f"{path}, line {line_number}: longer than {LONGEST_LINE} characters; pass a file "
                "with one pose in each line"
            )
        line = match[0]
        if after is None or (
            line_number > after and not line.startswith(COMMENTS)
        ):
            yield line_number, line.rstrip()


def layout_of(path: str | Path, text: str, needs_names: bool) -> Layout:
    """Return the layout of a text.

    Parameters
    ----------
    path : str or path-like
        Name of the text in messages.
    text : str
    needs_names : bool
        Whether the names of the columns must come from the file. Then a line above the rows with
        more or fewer names than columns is an error.

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
        _refuse_other_number_of_names(
            path, lines[:n_above], _without_last(row), separator
        )
    cells_of = _merged(split, header.merge) if header.merge else split
    rows = [cells_of(line) for _, line in lines[n_above:]]
    rows_after = lines[n_above - 1][0] if n_above else 0
    layout = Layout(rows_after, cells_of, _usual_row(rows), header.names)
    is_separated = separator in (",", ";")
    if header.names is not None:
        return _with_named_columns(layout, header.names, is_separated)
    return _with_fitting_columns(layout, rows, is_separated)


def _layout_without_rows(
    lines: Sequence[tuple[int, str]], separator: str
) -> Layout:
    """Return the layout of a text without rows of numbers. Its last line may name the columns."""
    split = splitter(separator)
    if not lines:
        return Layout(0, split, [], None, "tum", STAMPED_POSE)
    names = tuple(names_in(lines[-1][1], separator)[0])
    return Layout(lines[0][0], split, [], names, "csv", names)


def _usual_row(rows: Sequence[list[str]]) -> list[str]:
    """Return the first row with the most frequent number of cells."""
    n_cells = Counter(map(len, rows)).most_common(1)[0][0]
    return next(row for row in rows if len(row) == n_cells)


def _first_lines(
    path: str | Path, text: str
) -> tuple[list[str], list[tuple[int, str]]]:
    """Return the comments before the first other line, and the first lines without comments.

    A line that is not a comment comes with its number.
    """
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


def _lines_above_rows(cells: Sequence[list[str]]) -> int | None:
    """Return the number of lines of text above the rows of numbers; None if there are no rows."""
    rows = [line for line, row in enumerate(cells) if _is_row(row)]
    if not rows:
        return None
    first = cells.index(_usual_row([cells[line] for line in rows]))
    # Rows with another number of cells may be above the first usual row, and belong to the rows. So
    # the text ends at the last line above the usual row that is not a row.
    return 1 + max(
        (line for line in range(first) if line not in rows), default=-1
    )


def _is_row(cells: Sequence[str]) -> bool:
    """Return whether a line is a row of numbers, in which at least half of the cells are values."""
    filled = [cell for cell in cells if cell]
    n_values = sum(map(is_value, filled))
    has_number = any(
        is_number(cell) or is_date_or_time(cell) for cell in filled
    )
    return has_number and n_values >= _MIN_SHARE_OF_VALUES * len(filled)


# ---- joining of cells

# Function that joins cells of a row that belong to one column, such as date and time of day.
_Merge = Callable[[Sequence[str]], list[str]]


def _merged(split: CellsOf, merge: _Merge) -> CellsOf:
    """Return a function that splits a line, and then joins cells that belong to one column."""
    return lambda line: merge(split(line))


def _without_last(cells: Sequence[str]) -> list[str]:
    """Return cells without the empty last cell after a separator at the end of the line."""
    return [*cells] if cells[-1] else [*cells[:-1]]


def _joining(widths: Sequence[int]) -> _Merge:
    """Return a function that joins neighbouring cells of a row into columns.

    ``widths`` has the number of cells of each column; columns with 0 cells are left out. A row with
    another total number of cells is returned unchanged.
    """
    ends = [0, *accumulate(filter(None, widths))]

    def merge(cells: Sequence[str]) -> list[str]:
        if len(cells) != ends[-1]:
            return [*cells]
        return [" ".join(cells[start:end]) for start, end in pairwise(ends)]

    return merge


def _is_split_stamp(cells: Sequence[str]) -> bool:
    """Return whether the first two cells are a date and a time of day."""
    return (
        len(cells) > 1
        and is_date(cells[0])
        and ":" in cells[1]
        and is_date_or_time(cells[1])
    )


# ---- names above the rows


class _Header(NamedTuple):
    """Names of the columns, if there are any, and a function that joins the cells of a row.

    The function joins cells that belong to one column, such as a date and a time.
    """

    names: tuple[str, ...] | None
    merge: _Merge | None = None


def _header_of(above: Sequence[str], row: list[str], separator: str) -> _Header:
    """Return the header for rows with as many cells as ``row``, from the lines above the rows."""
    header = _header_above(above, row, separator)
    if header:
        return header
    # The rows may end with a separator that the line of the names lacks.
    if not row[-1]:
        header = _header_above(above, row[:-1], separator)
        return _Header(header.names if header else None, _without_last)
    if _is_split_stamp(row):
        return _Header(None, _joining([2, *[1] * (len(row) - 2)]))
    return _Header(None)


def _header_above(
    above: Sequence[str], row: Sequence[str], separator: str
) -> _Header | None:
    """Return the header from the lines above the rows, or None if no line fits the row.

    The nearest line with names of quantities is used. If there is none, the nearest fitting line
    that is not a comment is used.
    """
    unknown = None
    below = ""
    for line in reversed(above):
        is_comment = line.startswith(COMMENTS)
        for names in names_in(line, separator):
            header = _header_if_fitting(names, row, is_comment)
            if header is None or header.names is None:
                continue
            if _are_names_of_quantities(header.names):
                with_units = _with_units(header.names, below, separator)
                return header._replace(names=_with_stamp(with_units, row))
            if unknown is None and not is_comment:
                unknown = _Header(header.names)
        below = line
    return unknown


def _refuse_other_number_of_names(
    path: str | Path,
    lines: Sequence[tuple[int, str]],
    row: Sequence[str],
    separator: str,
) -> None:
    """Raise an InputError if a line above the rows has more or fewer names than a row has cells."""
    for line_number, line in lines:
        names = names_in(line, separator)[0]
        if _are_names_of_quantities(names) and len(row) > 1:
            advice = (
                "write one name for each column, or name all with `columns`"
            )
            if len(row) > len(names) and separator == "," and are_whole(row):
                advice = DECIMAL_COMMAS
            raise InputError(
                f"{path}, line {line_number}: names {len(names)} columns, but "
                f"the rows have {len(row)} cells; {advice}"
            )


def _are_names_of_quantities(names: Sequence[str]) -> bool:
    """Return whether the names include those of a position, orientation, rates or pose."""
    by_name, _ = named_columns(names)
    columns = by_name.keys()
    return (
        is_pose(columns)
        or {"x", "qw"} <= columns
        or {"roll", "pitch"} <= columns
    )


def _header_if_fitting(
    names: Sequence[str], row: Sequence[str], is_comment: bool
) -> _Header | None:
    """Return a header with a name for each cell of a row, or None if the numbers differ.

    Cells of one quantity are joined. If a comment has more words than the row has cells, only the
    last words are names: the first words may be text such as "format:".
    """
    # A separator at the end of the line adds an empty name.
    if len(names) == len(row) + 1 and not names[-1]:
        names = names[:-1]
    if not names:
        return None
    for n_angle_cells in _ANGLE_CELLS:
        widths = _widths(names, row, n_angle_cells)
        if sum(widths) == len(row):
            return _header_of_widths(names, widths, row)
    n_missing = len(row) - len(names)
    if _may_name_several_columns(names[-1]):
        # The last name stands for all further columns, whose names are empty.
        if len(names) > 1 and n_missing >= -1:
            return _Header((*names[:-1], *[""] * (n_missing + 1)))
    elif is_comment and n_missing < 0:
        return _Header(tuple(names[-len(row) :]))
    return None


def _header_of_widths(
    names: Sequence[str], widths: Sequence[int], row: Sequence[str]
) -> _Header:
    """Return the header for names with ``widths`` cells each; names without cells are left out."""
    names = [name for name, width in zip(names, widths, strict=True) if width]
    if max(widths) == 1:
        return _Header(_with_degrees(names, row))
    merge = _joining(widths)
    return _Header(_with_degrees(names, merge(row)), merge)


def _may_name_several_columns(name: str) -> bool:
    """Return whether a name such as "cov" or "*" may stand for any number of columns, or none."""
    return name.startswith("*") or name.endswith("...") or "cov" in name.lower()


# Possible numbers of cells of a latitude or longitude, in the order of the trials: degrees;
# degrees, minutes and seconds; degrees and minutes.
_ANGLE_CELLS = (1, 3, 2)
_HEMISPHERES = {"N", "S", "E", "W"}


def _places_of(names: Sequence[str], *quantities: str) -> set[int]:
    """Return the first column of each quantity. Quantities without a column are left out."""
    columns = named_columns(names)[0]
    return {
        columns[quantity][0] for quantity in quantities if quantity in columns
    }


def _widths(
    names: Sequence[str], row: Sequence[str], n_angle_cells: int
) -> list[int]:
    """Return the number of cells in a row for each name.

    A latitude or longitude has ``n_angle_cells`` cells, and one more for a hemisphere. A stamp may
    have two cells, for date and time of day. If there are as many names as cells, a name whose cell
    belongs to the previous quantity has no cells.
    """
    angles = _places_of(names, "lat", "lon")
    stamps = _places_of(names, "t", "date")
    has_name_for_each_cell = len(names) == len(row)
    widths: list[int] = []
    n_used_cells = 0
    for column in range(len(names)):
        width = 1
        if has_name_for_each_cell and n_used_cells > column:
            width = 0
        elif column in angles:
            end = n_used_cells + n_angle_cells
            width = n_angle_cells + len(
                _HEMISPHERES.intersection(row[end : end + 1])
            )
        elif column in stamps and not has_name_for_each_cell:
            width = 2 if _is_split_stamp(row[n_used_cells:]) else 1
        widths.append(width)
        n_used_cells += width
    return widths


def _with_degrees(names: Sequence[str], row: Sequence[str]) -> tuple[str, ...]:
    """Append the unit "deg" to the names of angles in degrees, minutes and seconds."""
    with_units = [*names]
    for place in _places_of(names, "lat", "lon"):
        if not is_number(row[place]) and is_angle(row[place]):
            with_units[place] = f"{names[place]} [deg]"
    return tuple(with_units)


def _with_units(
    names: tuple[str, ...], below: str, separator: str
) -> tuple[str, ...]:
    """Append the units from the line below the names, if it has one unit for each name."""
    for units in names_in(below, separator) if below else []:
        if len(units) == len(names) and not _is_row(units):
            return tuple(map(" ".join, zip(names, units, strict=True)))
    return names


def _with_stamp(names: tuple[str, ...], row: Sequence[str]) -> tuple[str, ...]:
    """Rename a first column with an unknown name to "t" if it has stamps since 1970."""
    columns = named_columns(names)[0].keys()
    first_quantities = named_columns(names[:1])[0].keys()
    has_stamp = not columns.isdisjoint({"t", "secs", *first_quantities})
    if has_stamp or not _SINCE_1970.fullmatch(row[0]):
        return names
    return ("t", *names[1:])


def _with_named_columns(
    layout: Layout, names: tuple[str, ...], is_separated: bool
) -> Layout:
    """Set format and columns of a layout from the names above the rows."""
    if (
        not is_separated
        and " ".join(names[1:]).lower() == TUM_COLUMNS.partition(" ")[2]
    ):
        return replace(layout, format="tum", columns=TUM)
    return replace(layout, format="csv", columns=names)


# ---- numbers without names

# Numbers of columns that several kinds of data have. 4: a position with a stamp, or a quaternion.
# 7: a pose without a stamp, or a stamp with a position and three angles.
_AMBIGUOUS_COUNTS = (4, 7)


def _with_fitting_columns(
    layout: Layout, rows: Sequence[Sequence[str]], is_separated: bool
) -> Layout:
    """Set format and columns of a layout without names from the values in its rows."""
    n_columns = len(layout.row)
    columns = columns_of_rows(layout.row, rows)
    may_be_stamped_pose = columns is None or columns[: len(TUM)] == STAMPED_POSE
    is_long_enough = is_separated and n_columns >= len(TUM)
    if may_be_stamped_pose and is_long_enough and _is_in_ns(layout.row[0]):
        return replace(
            layout, format="euroc", columns=("t [ns]", *POSITION, *SCALAR_FIRST)
        )
    if columns == STAMPED_POSE and not is_separated:
        return replace(layout, format="tum", columns=columns)
    if columns is not None:
        pose = tuple(name for name in columns if name in MATRIX)
        return replace(
            layout,
            format="kitti" if columns == MATRIX else "csv",
            columns=columns,
            is_transposable=pose in TRANSPOSABLE,
        )
    return _with_assumed_format(layout, is_separated)


def _with_assumed_format(layout: Layout, is_separated: bool) -> Layout:
    """Set the format by the number of columns, because the values fit no pose.

    Reading the rows then fails. The error describes a row of this format.
    """
    n_columns = len(layout.row)
    if is_separated or n_columns in _AMBIGUOUS_COUNTS:
        columns = STAMPED_POSE if n_columns == len(STAMPED_POSE) else None
        return replace(layout, format="csv", columns=columns)
    if n_columns == len(MATRIX):
        return replace(layout, format="kitti", columns=MATRIX)
    return replace(layout, format="tum", columns=STAMPED_POSE)


def _is_in_ns(cell: str) -> bool:
    """Return whether a cell is a number of nanoseconds since 1970."""
    return cell.isdecimal() and len(cell) >= UNIT_EXPONENTS["ns"]
