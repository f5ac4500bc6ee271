"""CSV and Markdown files."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from hand_eye_calib.errors import InputError


def write_csv(path: Path, header: Sequence[object], rows: Iterable[Iterable[object]]) -> Path:
    """Write rows of values under a header; returns the path. Numbers keep all digits."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
    return path


def write_text(path: Path, *blocks: str) -> Path:
    """Write blocks of text, an empty line between them; returns the path."""
    path.write_text("\n\n".join(block for block in blocks if block) + "\n", encoding="utf-8")
    return path


def markdown_table(header: Sequence[object], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table of strings and numbers."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def put_into_page(page: Path, name: str, text: str) -> None:
    """Replace the tables of an earlier run in a Markdown page.

    Parameters
    ----------
    page : pathlib.Path
        Has the lines ``<!-- NAME: begin -->`` and ``<!-- NAME: end -->``, between which the text is
        put.
    name : str
    text : str
        Markdown; a heading at its beginning is left out, because the page has its own.

    Raises
    ------
    InputError
        If the page cannot be read or has no such lines.
    """
    begin, end = f"<!-- {name}: begin -->\n", f"<!-- {name}: end -->"
    try:
        before, found, rest = page.read_text(encoding="utf-8").partition(begin)
        _, closed, after = rest.partition(end)
        if not (found and closed):
            raise InputError(
                f"{page} has no lines {begin.strip()} and {end} to put the tables into"
            )
        body = re.sub(r"\A# .*\n+", "", text).strip()
        page.write_text(f"{before}{begin}\n{body}\n\n{end}{after}", encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot use {page}: {error.strerror}") from None


def bullets(items: Iterable[str]) -> str:
    """A Markdown list."""
    return "\n".join(f"- {item}" for item in items)


def percent(part: int, whole: int) -> str:
    """Such as "4328 of 4332 (99.91 %)", rounded down: only all is 100 %."""
    share = int(1e4 * part / whole) / 100 if whole else 0.0
    return f"{part} of {whole} ({share:.2f} %)"
