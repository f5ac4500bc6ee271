"""The format of a trajectory file, by its first lines."""

import re
from pathlib import Path

# Bytes that are looked at.
_MOST_BYTES = 65_536

# A stamp in nanoseconds since 1970 has at least so many digits.
_DIGITS_OF_NS = 17

_COLUMNS_OF = {8: "tum", 12: "kitti"}
# A pose with its stamp.
_FEWEST_COLUMNS = 8


def guess_format(path: str | Path) -> str:
    """The format that the first lines of a trajectory file look like.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    str
        One of :data:`~hand_eye_calib.config.TRAJECTORY_FORMATS`; tum in doubt, and if the file
        cannot be read, so that the reader says what is wrong.
    """
    path = Path(path)
    # What is no file, such as a pipe, can be read only once.
    if not path.is_file():
        return "tum"
    try:
        with path.open("rb") as file:
            text = file.read(_MOST_BYTES).decode("utf-8", errors="replace")
    except OSError:
        return "tum"
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    header = lines[0].lstrip("#").strip() if lines and lines[0].startswith("#") else ""
    data = next((line for line in lines if not line.startswith("#")), "")
    return _format_of(header, data)


def _format_of(header: str, data: str) -> str:
    """The format of a file with this first line of data, and this comment before it."""
    separator = "," if "," in data else ";" if ";" in data else None
    cells = [cell.strip() for cell in data.split(separator)]
    if not cells or not all(_is_number(cell) for cell in cells if cell):
        return "csv" if separator or len(cells) >= _FEWEST_COLUMNS else "tum"
    if separator is None:
        return _COLUMNS_OF.get(len(cells), "tum")
    if len(header.split(separator)) == len(cells):
        return "csv"
    is_ns = cells[0].isdecimal() and len(cells[0]) >= _DIGITS_OF_NS
    return "euroc" if is_ns and len(cells) >= _FEWEST_COLUMNS else "csv"


def _is_number(cell: str) -> bool:
    return re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|nan|[-+]?inf", cell) is not None
