"""The numbers of a trajectory file, row by row, before they become poses."""

import re
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.io.limits import LONGEST_LINE

# Characters of a line or value that a message shows.
MOST_SHOWN = 120

# A line and its number, from 1.
Line = tuple[int, str]

_NOT_EMPTY = re.compile("[^\n]+")


class Lines:
    """The lines of a text that are not empty, with their numbers.

    They are found anew each time: a list of them would take many times the memory of the text.

    Parameters
    ----------
    path : str or path-like
        For messages.
    text : str
        Its lines end with a line feed, a carriage return or both.
    after : int
        Lines up to this number are left out.
    """

    def __init__(self, path: str | Path, text: str, after: int = 0) -> None:
        if "\r" in text:
            text = text.replace("\r\n", "\n").replace("\r", "\n")
        self._path, self._text, self._after = path, text, after

    def __iter__(self) -> Iterator[Line]:
        number, end = 1, 0
        for found in _NOT_EMPTY.finditer(self._text):
            number += self._text.count("\n", end, found.start())
            end = found.end()
            if end - found.start() > LONGEST_LINE:
                raise InputError(
                    f"{self._path}, line {number}: longer than {LONGEST_LINE} characters"
                )
            if number > self._after:
                yield number, found.group()

    def after(self, number: int) -> "Lines":
        """The lines after one."""
        return Lines(self._path, self._text, number)


@dataclass
class Table:
    """The rows of a file.

    Attributes
    ----------
    path : str or path-like
    expected : str
        What a row should be, for messages.
    quantities : tuple of str
        What the values of a row are, in their order, such as "x" or "qw".
    stamp_unit : str
        Unit of the stamps; empty if it has to be recognised.
    units : dict
        Units of quantities that the header names.
    line_numbers : array of int
    stamps : list of Decimal
    numbers : array of float
        The values of all rows, one row after the other.
    guesses : list of str
        What a person should know of how the file was read.
    is_scalar_last_usual : bool
        Whether in such files the scalar of a quaternion is the last as a rule.
    header : tuple of str
        The names of all columns; empty without.
    convention : str
        How to read angles; empty to find out from the motion.
    conventions : list of str
        Those of the angles that the motion does not contradict, the usual first.
    """

    path: str | Path
    expected: str
    quantities: tuple[str, ...]
    stamp_unit: str = ""
    units: dict[str, str] = field(default_factory=dict)
    line_numbers: "array[int]" = field(default_factory=lambda: array("q"))
    stamps: list[Decimal] = field(default_factory=list)
    numbers: "array[float]" = field(default_factory=lambda: array("d"))
    guesses: list[str] = field(default_factory=list)
    is_scalar_last_usual: bool = False
    header: tuple[str, ...] = ()
    convention: str = ""
    conventions: list[str] = field(default_factory=list)

    def add(self, number: int, stamp: str, values: Sequence[str]) -> None:
        """Add a row from its text.

        Raises
        ------
        InputError
            If something in it is no number.
        """
        try:
            self.stamps.append(_decimal(stamp))
            self.numbers.extend(map(float, values))
        except ValueError as error:
            reason = str(error)[:MOST_SHOWN]
            raise InputError(
                f"{self.path}, line {number}: expected {self.expected}; {reason}"
            ) from None
        self.line_numbers.append(number)

    @property
    def values(self) -> FloatArray:
        """(N, k) array: the values of each row."""
        return np.asarray(self.numbers, dtype=float).reshape(-1, len(self.quantities))

    def unexpected(self, line: Line, found: int, expected: str = "") -> InputError:
        """The error of a line with another number of cells."""
        number, text = line
        shortened = text if len(text) <= 60 else text[:60] + "..."
        return InputError(
            f"{self.path}, line {number}: expected {expected or self.expected}; found {found}: "
            f"{shortened!r}"
        )

    def refuse(self, wrong: BoolArray, message: Callable[[int], str]) -> None:
        """Raise an error at the first wrong row (N,), if there is one."""
        index = int(np.argmax(wrong))
        if wrong[index]:
            raise InputError(f"{self.path}, line {self.line_numbers[index]}: {message(index)}")


def data_lines(lines: Iterable[Line]) -> Iterator[Line]:
    """The lines that are neither empty nor comments."""
    for number, text in lines:
        stripped = text.strip()
        if stripped and not stripped.startswith("#"):
            yield number, text


def cells_of(text: str) -> list[str]:
    """The cells of a line: separated by commas, semicolons or white space."""
    if "," not in text and ";" not in text:
        return text.split()
    import csv

    reader = csv.reader([text], delimiter="," if "," in text else ";", skipinitialspace=True)
    return [cell.strip() for cell in next(reader)]


def is_number(text: str) -> bool:
    """Whether a cell is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _decimal(text: str) -> Decimal:
    """A stamp as it is written, with no binary floating point in between."""
    try:
        stamp = Decimal(text)
    except InvalidOperation:
        stamp = Decimal("nan")
    if not stamp.is_finite() or stamp.adjusted() > 30:
        raise ValueError(f"found {text!r} for the timestamp")
    return stamp
