"""CSV files, Markdown tables and pages, and the command-line arguments of a study."""

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
    """Write a table with all digits of its numbers, and return the path."""
    table = (
        rows
        if isinstance(rows, pd.DataFrame)
        else pd.DataFrame(list(rows), dtype=object)
    )
    table.to_csv(path, index=False, lineterminator="\n")
    return path


def write_text(path: Path, *blocks: str) -> Path:
    """Write blocks of text, separated by empty lines, and return the path."""
    path.write_text("\n\n".join(filter(None, blocks)) + "\n", encoding="utf-8")
    return path


def markdown_table(rows: Iterable[TableRow]) -> str:
    """Return a Markdown table; the keys of the first row are the titles."""
    rows = list(rows)
    if not rows:
        return "Nothing."
    lines: list[Iterable[object]] = [rows[0], ["---"] * len(rows[0])]
    lines += [row.values() for row in rows]
    texts = []
    for cells in lines:
        words = " | ".join(str(cell) for cell in cells)
        texts.append(f"| {words} |")
    return "\n".join(texts)


def put_into_page(page: Path, name: str, text: str) -> None:
    """Write Markdown between the lines ``<!-- NAME: begin -->`` and ``<!-- NAME: end -->``.

    A heading at the beginning of the Markdown is removed. Raises InputError if the page has no such
    lines.
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
    """Return the parser of a study, with options for the recordings and the page of its tables."""
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
        help="folder of the real recordings (valimaki2023, euroc_vio, ...); without the folder, "
        "only simulated recordings are used. Default: $HAND_EYE_CALIB_DATA",
    )
    parser.add_argument("--page", metavar="FILE", type=Path, help=page)
    return parser


def add_seed_options(parser: argparse.ArgumentParser, count: int) -> None:
    """Add ``--seeds`` (by default ``count``) and ``--first-seed`` to a parser."""
    parser.add_argument(
        "--seeds",
        type=int,
        default=count,
        help="recordings of each row and kind of motion. Default: %(default)s",
    )
    parser.add_argument(
        "--first-seed",
        type=int,
        default=0,
        help="seed of the first recording. Default: 0",
    )


def seeds_of(arguments: argparse.Namespace) -> range:
    """Return the seeds for the options of :func:`add_seed_options`."""
    first = arguments.first_seed
    return range(first, first + arguments.seeds)


def seed_of(seed: int | None) -> int:
    """Return the given seed, or a random seed if there is none."""
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
    """Return text such as "4328 of 4332 (99.91 %)", rounded down so that only all are 100 %."""
    share = 0.0
    if whole:
        share = int(1e4 * count / whole) / 100
    return f"{count} of {whole} ({share:.2f} %)"


def counted(words: Iterable[str], most: int | None = None) -> str:
    """Return words with their numbers of occurrences, the most frequent word first."""
    return ", ".join(
        f"{word} {count}" for word, count in Counter(words).most_common(most)
    )


def triple(
    values: Iterable[float], factor: float = 1.0, form: str = ".1f"
) -> str:
    """Return numbers, multiplied by a factor, as text with commas."""
    words = [f"{factor * value:{form}}" for value in values]
    return ", ".join(words)
