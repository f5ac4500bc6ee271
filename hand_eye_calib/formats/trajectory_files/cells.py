"""Cells of the lines of a text file: the separator between cells, and the numbers in cells.

Every pattern matches a whole cell. Its time is in proportion to the length of the cell, so a
hostile file cannot make it slow.
"""

import csv
import re
from collections.abc import Callable, Sequence
from math import nan

from hand_eye_calib.formats.trajectory_files.dates import is_date_or_time

#: Separator of a file whose cells are separated by white space.
BLANKS = ""
# Possible separators. If several of them fit equally well, the first one is used.
_SEPARATORS = (";", "\t", ",", "|", BLANKS)
_NUMBER = re.compile(
    r"[-+]?(\d+(\.\d*)?|\.\d+)(e[-+]?\d+)?|[-+]?nan|[-+]?inf", re.IGNORECASE
)
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(e[-+]?\d+)?", re.IGNORECASE)
# Texts that programs write for a missing value, in lower case.
_NULLS = {
    "",
    "nan",
    "-nan",
    "null",
    "none",
    "na",
    "n/a",
    "#n/a",
    "nil",
    "-",
    "--",
    "?",
}
# Degrees, minutes and seconds with their signs, and a hemisphere before or after the numbers.
_ANGLE = re.compile(
    r"(?P<before>[NSEW]?)\s*"
    r"(?P<degrees>[-+]?\d{1,3}(?:[.,]\d*)?)(?:[°ºd:\s]+(?P<minutes>\d{1,2}(?:[.,]\d*)?)"
    r"(?:['′’m:\s]+(?P<seconds>\d{1,2}(?:[.,]\d*)?))?)?[°ºdms'′’\"″”\s]*"
    r"(?P<behind>[NSEW]?)",
    re.ASCII,
)
# Largest number of characters in a cell that may be an angle.
_LONGEST_ANGLE = 40
# Characters that occur in angles, but not in plain numbers: hemispheres and signs of units.
_ANGLE_SIGNS = set("NSEW°º'′’\"″”:")

# Function that splits a line into cells.
CellsOf = Callable[[str], list[str]]


def is_number(cell: str) -> bool:
    """Whether a cell is a number, with a decimal point or comma."""
    return bool(_NUMBER.fullmatch(cell) or _DECIMAL_COMMA.fullmatch(cell))


def are_whole(cells: Sequence[str]) -> bool:
    """Whether all cells are whole numbers, which may be parts of numbers with decimal commas."""
    return all(cell.lstrip("+-").isdecimal() for cell in cells)


def is_value(cell: str) -> bool:
    """Whether a cell is a number, an angle, a date or time, or the mark of a missing value."""
    return (
        is_number(cell)
        or is_null(cell)
        or is_date_or_time(cell)
        or _is_marked_angle(cell)
    )


def is_null(cell: str) -> bool:
    """Return whether a cell is empty, nan or another mark of a missing value."""
    return cell.lower() in _NULLS


def is_angle(cell: str) -> bool:
    """Return whether a cell is an angle in degrees, such as 52.1, 52 12 0.5 or 52d12m N."""
    return _degrees(cell) is not None


def _is_marked_angle(cell: str) -> bool:
    """Return whether a cell has a mark of an angle: hemisphere, degree sign, quote or colon."""
    return not _ANGLE_SIGNS.isdisjoint(cell) and is_angle(cell)


def number(cell: str) -> float:
    """Return the number in a cell; NaN for the mark of a missing value.

    Raises
    ------
    ValueError
        If the cell contains other text.
    """
    try:
        return float(cell)
    except ValueError:
        if is_null(cell):
            return nan
        if _DECIMAL_COMMA.fullmatch(cell):
            return float(cell.replace(",", "."))
        raise


def angle(cell: str) -> float:
    """Return the number in a cell. An angle such as 52 12 0.5 N is converted to degrees.

    Raises
    ------
    ValueError
        If the cell contains other text.
    """
    try:
        return number(cell)
    except ValueError:
        degrees = _degrees(cell)
        if degrees is None:
            raise
        return degrees


def _degrees(cell: str) -> float | None:
    """Return an angle in degrees, positive to the north and east; None if the text is no angle.

    Minutes and seconds are optional, and must be below 60.
    """
    text = cell.strip()
    match = _ANGLE.fullmatch(text) if len(text) <= _LONGEST_ANGLE else None
    if not match or (match["before"] and match["behind"]):
        return None
    numbers = match.group("degrees", "minutes", "seconds")
    magnitudes = [
        abs(float(digits.replace(",", "."))) for digits in numbers if digits
    ]
    if max(magnitudes[1:], default=0.0) >= 60:
        return None
    total = sum(
        magnitude / 60**power for power, magnitude in enumerate(magnitudes)
    )
    hemisphere = match["before"] or match["behind"]
    is_negative = match["degrees"].startswith("-") or hemisphere in ("S", "W")
    return -total if is_negative else total


def splitter(separator: str) -> CellsOf:
    """Return a function that splits a line into cells at a separator outside quotes."""
    if separator == BLANKS:
        return _split_at_blanks

    def cells_of(line: str) -> list[str]:
        if '"' in line:
            cells = next(
                csv.reader([line], delimiter=separator, skipinitialspace=True)
            )
        else:
            cells = line.split(separator)
        return [cell.strip() for cell in cells]

    return cells_of


def _split_at_blanks(line: str) -> list[str]:
    """Return the cells of a line that are separated by white space outside quotes."""
    if '"' not in line:
        return line.split()
    cells = csv.reader(
        [line.replace("\t", " ")], delimiter=" ", skipinitialspace=True
    )
    return [cell for cell in next(cells) if cell]


def separator_of(lines: Sequence[str]) -> str:
    """Return the separator of the cells in lines.

    A wrong separator leaves several numbers in one cell, which is then not a number. Therefore the
    separator with most digits in cells that are numbers is used. If no cell is a number, the first
    possible separator in the first line is used.
    """
    n_digits = {}
    for separator in _SEPARATORS:
        cells_of = splitter(separator)
        n_digits[separator] = sum(
            _digits_in_numbers(cells_of(line)) for line in lines
        )
    if any(n_digits.values()):
        return max(_SEPARATORS, key=n_digits.__getitem__)
    first_line = lines[0] if lines else ""
    return next(
        separator for separator in _SEPARATORS if separator in first_line
    )


def _digits_in_numbers(cells: Sequence[str]) -> int:
    """Return the number of digits in the cells that are numbers or angles."""
    numbers = "".join(
        cell for cell in cells if is_number(cell) or _is_marked_angle(cell)
    )
    return sum(map(str.isdigit, numbers))


def names_in(line: str, separator: str) -> list[list[str]]:
    """Return the names of columns in a line, for each way to split the line.

    A header may have another separator than the rows. The line is split in several ways, in this
    order: at the separator of the rows, at the same separator outside brackets, at white space
    outside brackets, at gaps of two or more spaces, at the other separators.
    """
    text = line.lstrip("#/%").strip()
    between_gaps = [name.strip() for name in text.split("  ")]
    names_of_splits = [
        splitter(separator)(text),
        _outside_brackets(text, separator),
        _outside_brackets(text, BLANKS),
        [name for name in between_gaps if name],
    ]
    for other in (",", ";", "\t"):
        if other != separator:
            names_of_splits.append(splitter(other)(text))
    return names_of_splits


def _outside_brackets(text: str, separator: str) -> list[str]:
    """Split a line at a separator outside brackets."""
    cells = [""]
    # Number of open brackets at the letter.
    depth = 0
    for letter in text:
        if letter in "([{":
            depth += 1
        elif letter in ")]}" and depth:
            depth -= 1
        is_separator = (
            letter.isspace() if separator == BLANKS else letter == separator
        )
        if is_separator and depth == 0:
            cells.append("")
        else:
            cells[-1] += letter
    cells = [cell.strip() for cell in cells]
    return [cell for cell in cells if cell] if separator == BLANKS else cells
