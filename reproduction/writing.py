"""CSV and Markdown: files, tables, pages; and the arguments of a study."""

import argparse
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from hand_eye_calib.core.base.errors import InputError

TableRow = Mapping[str, object]


def write_csv(path: Path, rows: Iterable[TableRow] | pd.DataFrame) -> Path:
    """Write a table; returns the path. Numbers keep all digits."""
    table = (
        rows
        if isinstance(rows, pd.DataFrame)
        else pd.DataFrame(list(rows), dtype=object)
    )
    table.to_csv(path, index=False, lineterminator="\n")
    return path


def write_text(path: Path, *blocks: str) -> Path:
    """Write blocks of text, an empty line between them; returns the path."""
    path.write_text("\n\n".join(filter(None, blocks)) + "\n", encoding="utf-8")
    return path


def markdown_table(rows: Iterable[TableRow]) -> str:
    """A Markdown table; the keys of the first row are the titles."""
    rows = list(rows)
    if not rows:
        return "Nothing."
    lines: list[Iterable[object]] = [
        rows[0],
        ["---"] * len(rows[0]),
        *(r.values() for r in rows),
    ]
    return "\n".join(
        "| " + " | ".join(str(cell) for cell in line) + " |" for line in lines
    )


def put_into_page(page: Path, name: str, text: str) -> None:
    """Put Markdown, without a heading at its beginning, between the lines ``<!-- NAME: begin -->``
    and ``<!-- NAME: end -->`` of a page. Raises InputError if it has no such lines.
    """
    begin = f"<!-- {name}: begin -->\n"
    end = f"<!-- {name}: end -->"
    before, marker, rest = page.read_text(encoding="utf-8").partition(begin)
    _, closed, after = rest.partition(end)
    if not (marker and closed):
        raise InputError(
            f"{page} has no lines {begin.strip()} and {end} to put the tables into"
        )
    body = re.sub(r"\A# .*\n+", "", text).strip()
    page.write_text(
        f"{before}{begin}\n{body}\n\n{end}{after}", encoding="utf-8"
    )


def study_parser(
    name: str, about: str | None, page: str = "put the tables into this page"
) -> argparse.ArgumentParser:
    """Parser of a study: recordings, and a page for its tables."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {name}",
        description=about,
        allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    folder = os.environ.get("HAND_EYE_CALIB_DATA")
    parser.add_argument(
        "--data-folder",
        metavar="DIR",
        type=Path,
        default=Path(folder) if folder else None,
        help="folder of the real recordings (valimaki2023, euroc_vio, ...); without it, simulated "
        "ones only. Default: $HAND_EYE_CALIB_DATA",
    )
    parser.add_argument("--page", metavar="FILE", type=Path, help=page)
    return parser


def seed_of(seed: int | None) -> int:
    """The seed that is given, or another one at every run."""
    if seed is not None:
        return seed
    state = np.random.SeedSequence().generate_state(1)
    return int(state[0])


def show(page: Path | None, tables: Mapping[str, str]) -> None:
    """Print named tables, and put them into the page if there is one."""
    for name, text in tables.items():
        print(text, flush=True)
        if page:
            put_into_page(page, name, text)


def percent(count: int, whole: int) -> str:
    """Such as "4328 of 4332 (99.91 %)", rounded down: only all is 100 %."""
    share = 0.0
    if whole:
        share = int(1e4 * count / whole) / 100
    return f"{count} of {whole} ({share:.2f} %)"


def counted(words: Iterable[str], most: int | None = None) -> str:
    """Words with how often they occur, the most frequent first."""
    return ", ".join(
        f"{word} {count}" for word, count in Counter(words).most_common(most)
    )


def triple(
    values: Iterable[float], factor: float = 1.0, form: str = ".1f"
) -> str:
    """Numbers times a factor, a comma between them."""
    words = [f"{factor * value:{form}}" for value in values]
    return ", ".join(words)
