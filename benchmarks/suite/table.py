"""Tables of the benchmarks, on the terminal and in the documentation."""

import sys
from typing import NamedTuple

import numpy as np
from rich import box, table
from rich.console import Console

from suite.baseline import FLOOR, OPENCV, aims
from suite.data import LONG, REFERENCE, SHORT

_UNITS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "us"), (1e-9, "ns"))
_MARK = "<!-- tables of benchmarks/run.py: {} -->\n"
_BEGIN = _MARK.format("begin")
_END = _MARK.format("end")


class Table(NamedTuple):
    """A title, the headings of the columns after the first, and rows of text."""

    title: str
    headings: list
    rows: list


def tables(source, rows, memory):
    """Return the tables of all rows."""
    sizes = {row.size for row in rows if row.name == FLOOR}
    of_pairs = [row for row in rows if row.size in sizes]
    without_opencv = [
        row for row in of_pairs if not row.name.startswith("opencv")
    ]
    all_tables = [_growth(source, without_opencv)]
    for size, name in ((SHORT, "short"), (LONG, "long")):
        title = f"All methods: {source} {name} drive, {size:,} pairs"
        rows_of_drive = [row for row in of_pairs if row.size == size]
        all_tables.append(_side_by_side(title, rows_of_drive))
    others = [row for row in rows if row.size not in sizes]
    all_tables.append(_others(others, memory))
    headings = ["aim", "measured", "met"]
    all_tables.append(Table("Aims", headings, aims(rows, memory)))
    return all_tables


def show(all_tables):
    """Print tables."""
    console = Console(width=None if sys.stdout.isatty() else 150)
    for text_table in all_tables:
        shown = table.Table(title=text_table.title, box=box.SIMPLE_HEAD)
        for index, heading in enumerate(["", *text_table.headings]):
            shown.add_column(heading, justify="right" if index else "left")
        for row in text_table.rows:
            shown.add_row(*row)
        console.print(shown)


def write(all_tables, page, note):
    """Replace the tables of an earlier run in a Markdown page, with a note before them."""
    before, _, rest = page.read_text(encoding="utf-8").partition(_BEGIN)
    _, _, after = rest.partition(_END)
    parts = [_BEGIN, note]
    for text_table in all_tables:
        lines = [
            ["", *text_table.headings],
            ["---", *["---:"] * len(text_table.headings)],
            *text_table.rows,
        ]
        texts = [f"| {' | '.join(line)} |\n" for line in lines]
        parts.append(f"### {text_table.title}\n\n{''.join(texts)}")
    page.write_text(
        before + "\n".join([*parts, _END]) + after, encoding="utf-8"
    )


def _readable(seconds):
    """Return a time with three digits and a unit."""
    size, unit = next(
        (unit for unit in _UNITS if seconds >= unit[0]), _UNITS[-1]
    )
    return f"{seconds / size:.3g} {unit}"


def _cell(row):
    return f"{_readable(row.seconds)} ± {row.spread:.0%}"


def _growth(source, rows):
    """Return the table of times by method and number of pairs."""
    sizes = sorted({row.size for row in rows})
    time_of = {}
    for row in rows:
        time_of[row.name, row.size] = _readable(row.seconds)
    lines = []
    for name in dict.fromkeys(row.name for row in rows):
        times = [time_of.get((name, size), "") for size in sizes]
        lines.append([name, *times])
    return Table(
        f"Processor time by number of motion pairs ({REFERENCE}; {SHORT} and {LONG:,} "
        f"{source}, others simulated)",
        [f"{size:,}" for size in sizes],
        lines,
    )


def _side_by_side(title, rows):
    """Return the table of all methods on a drive: time, objective and errors."""
    lines = []
    for row in rows:
        if row.error_m is None or row.name == OPENCV:
            continue
        has_objective = row.name.startswith("dnl")
        objective = f"{row.objective:.6f}" if has_objective else ""
        metres = f"{row.error_m:.3f}"
        degrees = f"{np.degrees(row.error_rad):.3f}"
        lines.append([row.name, _cell(row), objective, metres, degrees])
    return Table(title, ["time", "objective", "e_at, m", "e_aR, deg"], lines)


def _others(rows, memory):
    """Return the table of processes, bags, messages and memory."""
    lines = [
        [row.name, f"{row.size:,}" if row.size else "", _cell(row)]
        for row in rows
    ]
    for size, (before, peak, data) in memory.items():
        of_what = f"of which {before / 1e6:.0f} before the solve, {data / 1e6:.0f} for the pairs"
        lines.append(
            [
                "peak memory of dnlo fast",
                f"{size:,}",
                f"{peak / 1e6:.0f} MB, {of_what}",
            ]
        )
    return Table("Processes, bags, messages", ["size", "measured"], lines)
