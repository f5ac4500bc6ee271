"""Cells of the lines of a text file: what separates them, and the numbers in them.

All patterns match whole cells and need time in proportion to their length.
"""

import csv
import re
from collections.abc import Callable, Sequence
from math import nan

from hand_eye_calib.formats.trajectory_files.dates import is_date_or_time

#: White space between cells.
BLANKS = ""
# Tried in this order: where two give as many numbers, the first is taken.
_SEPARATORS = (";", "\t", ",", "|", BLANKS)
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)(e[-+]?\d+)?|[-+]?nan|[-+]?inf", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(e[-+]?\d+)?", re.IGNORECASE)
# What programs write where they have no value.
_NULLS = {"", "nan", "-nan", "null", "none", "na", "n/a", "#n/a", "nil", "-", "--", "?"}
# Degrees, minutes and seconds with their signs, in at most so many characters.
_ANGLE = re.compile(
    r"([-+]?\d{1,3}(?:[.,]\d*)?)(?:[°ºd:\s]+(\d{1,2}(?:[.,]\d*)?)"
    r"(?:['′’m:\s]+(\d{1,2}(?:[.,]\d*)?))?)?[°ºdms'′’\"″”\s]*",
    re.ASCII,
)
_LONGEST_ANGLE = 40
# What an angle has and other cells of numbers have not.
_ANGLE_SIGNS = set("NSEW°º'′’\"″”:")

CellsOf = Callable[[str], list[str]]


def is_number(cell: str) -> bool:
    """Whether a cell is a number, perhaps with a decimal comma."""
    return bool(_NUMBER.fullmatch(cell) or _DECIMAL_COMMA.fullmatch(cell))


def is_value(cell: str) -> bool:
    """Whether a cell is a number, a date or time, or says that there is none."""
    return is_number(cell) or is_null(cell) or is_date_or_time(cell) or _is_marked_angle(cell)


def is_null(cell: str) -> bool:
    """Whether a cell says that there is no value, nan included."""
    return cell.lower() in _NULLS


def is_angle(cell: str) -> bool:
    """Whether a cell is an angle in degrees, minutes and seconds, with a sign or a hemisphere."""
    return _degrees(cell) is not None


def _is_marked_angle(cell: str) -> bool:
    """Whether a cell is an angle and no row of numbers that blanks separate."""
    return not _ANGLE_SIGNS.isdisjoint(cell) and is_angle(cell)


def number(cell: str) -> float:
    """The number in a cell: NaN where there is none.

    Raises
    ------
    ValueError
        If the cell has something else.
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
    """The number in a cell, or degrees of an angle such as 52 12 0.5 N.

    Raises
    ------
    ValueError
        If the cell has something else.
    """
    try:
        return number(cell)
    except ValueError:
        degrees = _degrees(cell)
        if degrees is None:
            raise
        return degrees


def _degrees(cell: str) -> float | None:
    """Degrees of an angle in degrees, minutes and seconds with a sign or a hemisphere."""
    text = cell.strip()
    if len(text) > _LONGEST_ANGLE:
        return None
    sides = [letter for letter in (text[:1], text[-1:]) if letter and letter in "NSEW"]
    if sides:
        text = text.strip("NSEW").strip()
    match = _ANGLE.fullmatch(text)
    if len(sides) > 1 or not match:
        return None
    parts = [abs(float(part.replace(",", "."))) for part in match.groups() if part]
    if any(part >= 60 for part in parts[1:]):
        return None
    size = sum(part / 60**power for power, part in enumerate(parts))
    is_negative = text.startswith("-") or "S" in sides or "W" in sides
    return -size if is_negative else size


def splitter(separator: str) -> CellsOf:
    """The function that splits a line into cells at a separator, none inside quotes."""
    if separator == BLANKS:
        return _at_blanks

    def cells_of(line: str) -> list[str]:
        if '"' in line:
            cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
        else:
            cells = line.split(separator)
        return [cell.strip() for cell in cells]

    return cells_of


def _at_blanks(line: str) -> list[str]:
    if '"' not in line:
        return line.split()
    quoted = csv.reader([line.replace("\t", " ")], delimiter=" ", skipinitialspace=True)
    return [cell for cell in next(quoted) if cell]


def separator_of(lines: Sequence[str]) -> str:
    """What separates the cells of lines: with it, the most digits are in cells that are numbers."""
    counts = [
        sum(_digits_in_numbers(splitter(separator)(line)) for line in lines)
        for separator in _SEPARATORS
    ]
    return _SEPARATORS[counts.index(max(counts))] if any(counts) else _usual(lines)


def _digits_in_numbers(cells: Sequence[str]) -> int:
    numbers = (cell for cell in cells if is_number(cell) or _is_marked_angle(cell))
    return sum(letter.isdigit() for cell in numbers for letter in cell)


def _usual(lines: Sequence[str]) -> str:
    """What separates cells that are no numbers."""
    first = lines[0] if lines else ""
    return next((separator for separator in _SEPARATORS[:-1] if separator in first), BLANKS)


def names_in(line: str, separator: str) -> list[list[str]]:
    """The names that a line may have, by what separates them: the separator, that separator
    outside brackets, white space outside brackets, and wide gaps.
    """
    text = line.lstrip("#/%").strip()
    ways = [splitter(separator)(text), _outside_brackets(text, separator)]
    ways += [_outside_brackets(text, BLANKS), [part.strip() for part in text.split("  ")]]
    ways += [splitter(other)(text) for other in (",", ";", "\t") if other != separator]
    return [[name for name in way if name] if way is ways[3] else way for way in ways]


def _outside_brackets(text: str, separator: str) -> list[str]:
    """Cells of a line that is not split inside brackets."""
    cells = [""]
    depth = 0
    for letter in text:
        depth += (letter in "([{") - (letter in ")]}" and depth > 0)
        is_end = letter == separator or (separator == BLANKS and letter.isspace())
        if depth == 0 and is_end:
            cells.append("")
        else:
            cells[-1] += letter
    cells = [cell.strip() for cell in cells]
    return [cell for cell in cells if cell] if separator == BLANKS else cells
