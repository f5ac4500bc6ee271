"""What the lines of a trajectory file look like: the format, and the names of the columns."""

import re
from collections.abc import Sequence
from itertools import takewhile
from typing import NamedTuple

from hand_eye_calib.io.trajectory_files.columns import are_columns
from hand_eye_calib.io.trajectory_files.table import Lines, cells_of, data_lines, is_number

# A stamp in nanoseconds since 1970 has at least so many digits.
_DIGITS_OF_NS = 17

_COLUMNS_OF = {8: "tum", 12: "kitti"}
# A pose with its stamp.
_FEWEST_COLUMNS = 8
_TUM_NAMES = "tx ty tz qx qy qz qw"


class Layout(NamedTuple):
    """What a file looks like.

    Attributes
    ----------
    format : str
        One of :data:`~hand_eye_calib.config.TRAJECTORY_FORMATS`; tum in doubt, so that its reader
        says what is wrong.
    is_named : bool
        Whether the file itself names its columns.
    """

    format: str
    is_named: bool


def layout_of(lines: Lines) -> Layout:
    """The layout that the first lines of a file have.

    Parameters
    ----------
    lines : Lines
        All lines.
    """
    data = next((text for _, text in data_lines(lines)), "").strip()
    separator = next((mark for mark in ",;" if mark in data), None)
    n_cells = len(cells_of(data))
    if not _is_row(data):
        is_table = bool(separator) or n_cells >= _FEWEST_COLUMNS or are_columns(cells_of(data))
        return Layout("csv" if is_table else "tum", is_table)
    names = header_of(lines)[0]
    if names is not None and len(names) == n_cells and are_columns(names):
        is_tum = separator is None and " ".join(names).lower().endswith(_TUM_NAMES)
        return Layout("tum" if is_tum else "csv", True)
    if separator is None:
        return Layout(_COLUMNS_OF.get(n_cells, "tum"), False)
    first = data.split(separator)[0].strip()
    is_ns = first.isdecimal() and len(first) >= _DIGITS_OF_NS
    return Layout("euroc" if is_ns and n_cells >= _FEWEST_COLUMNS else "csv", False)


def header_of(lines: Lines) -> tuple[list[str] | None, Lines]:
    """Names of the columns, if the file has any, and the lines after a header.

    The header is the first line that is no comment, unless it is a row of numbers; otherwise the
    last comment above the data that has as many cells, or the first.
    """
    number, row = next(data_lines(lines), (0, ""))
    if number and not _is_row(row):
        return _names(row), lines.after(number)
    n_cells, opening, fitting = len(cells_of(row)), None, None
    for _, text in takewhile(lambda line: line[0] != number, lines):
        names = _names(text)
        opening = names if opening is None and text.strip() else opening
        fitting = names if len(names) == n_cells and text.strip() else fitting
    found = opening if fitting is None else fitting
    return found if found is not None and _is_header(found) else None, lines


def _names(text: str) -> list[str]:
    return cells_of(text.strip().lstrip("#").strip())


def _is_header(names: Sequence[str]) -> bool:
    return not all(is_number(name) for name in names if name)


def _is_row(text: str) -> bool:
    """Whether all cells of a line are numbers or empty."""
    cells = cells_of(text)
    return bool(cells) and all(_NUMBER.fullmatch(cell) for cell in cells if cell)


_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|nan|[-+]?inf")
