"""Page of the coverage study: goals and tables."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from reproduction.coverage.measures import KINDS, POOLED, Row
from reproduction.published import LEVELS, SIMULATED, path_to
from reproduction.writing import markdown_table

# Columns of the printed tables. Other tables appear in the goals only.
_COLUMNS = {
    "simulated": ("bound", "bound_t", "bound_r", "nees", "covers"),
    "levels": ("mm", "deg", "covers"),
    "known answer": (
        "mm",
        "deg",
        "z",
        "covers",
        "covers_floor",
        "covers_truth",
    ),
}
_TITLES = {
    "simulated": "Simulated recordings",
    "levels": "The published trajectories of the paper",
    "known answer": "Real recordings with a known answer",
}
_ABOUT = {
    "simulated": (
        "Errors are in units of the Cramer-Rao bound under the true noise: "
        "sqrt(median(e' C^-1 e) / 5.35); the smallest possible value is 1. NEES is the squared "
        "error over the stated covariance; its expected median is 5.35. The pooled row contains "
        "the geometric mean of the errors."
    ),
    "levels": "Medians over the 38 trajectories of the strongest noise, outliers and drift.",
    "known answer": (
        "Errors are over the axes that the truth and the motion both determine. The last column "
        "adds the uncertainty of the truth to the stated uncertainty."
    ),
}
# Kinds of measures that are shares.
_PERCENT = ("covers", "covers_floor", "covers_truth", "refused")
# Names of the strongest levels of noise, outliers and drift, which are printed.
_LEVELS_SHOWN = {
    " ".join(path_to(dataset, LEVELS[dataset][-1])) for dataset in SIMULATED
}


class Goal(NamedTuple):
    """Aimed range of a kind of measure, in rows of a table whose names match ``names``."""

    text: str
    table: str
    kind: str
    low: float
    high: float
    names: str = "all "


# Regular expression for rows that are not pooled.
_EACH = "(?!all )"
GOALS = (
    Goal(
        "error over bound, geometric mean at most 1.05",
        "simulated",
        "bound",
        0,
        1.05,
    ),
    Goal("no class above 1.4", "simulated", "bound", 0, 1.4, _EACH),
    Goal("median NEES 4.5 to 6.0", "simulated", "nees", 4.5, 6.0),
    Goal(
        "90 % intervals cover 0.88 to 0.92", "simulated", "covers", 0.88, 0.92
    ),
    Goal(
        "90 % intervals of every class cover 0.82 to 0.97",
        "simulated",
        "covers",
        0.82,
        0.97,
        _EACH,
    ),
    Goal("flat_agv is refused", "simulated", "refused", 1.0, 1.0, "flat_agv"),
    Goal(
        "90 % intervals of real recordings, with the floor, cover 0.87 to 0.93",
        "known answer",
        "covers_floor",
        0.87,
        0.93,
    ),
    Goal(
        "the same without the floor: at least 0.80",
        "known answer",
        "covers",
        0.8,
        1.0,
    ),
    Goal("scatter of rigs over sigma 0.8 to 1.25", "rig", "scatter", 0.8, 1.25),
    Goal(
        "scatter of every rig over sigma 0.6 to 1.5",
        "rig",
        "scatter",
        0.6,
        1.5,
        _EACH,
    ),
    Goal(
        "scatter of halves and thirds over sigma 0.8 to 1.25",
        "parts",
        "scatter",
        0.8,
        1.25,
    ),
    Goal(
        "misclosure of three devices at most 0.10 deg",
        "cycle",
        "deg",
        0,
        0.1,
        "tango",
    ),
    Goal(
        "chi2 of this misclosure below 12.6", "cycle", "chi2", 0, 12.6, "tango"
    ),
    Goal(
        "recordings with an undetermined axis are refused",
        "refused",
        "refused",
        1.0,
        1.0,
    ),
)


def page(rows: Sequence[Row], absent: Sequence[str], seeds: range) -> str:
    """Return the page in Markdown.

    The table of known answers has a row for each recording. The table of levels has a row for each
    printed level. The table of simulated recordings has only the pooled row. ``--rows`` writes all
    rows.

    Parameters
    ----------
    rows : sequence of Row
    absent : sequence of str
        Sets of real recordings without a folder.
    seeds : range
        Seeds of the recordings of each class.
    """
    methods = list(dict.fromkeys(row.method for row in rows))
    blocks = [
        "# Certified coverage",
        "How close is the error to its theoretical bound, and do the stated intervals contain the "
        "truth?\nFor readers who check the method. `make coverage-study` writes this page.",
        f"Absent, and left out: {', '.join(absent)}." if absent else "",
        "## Goals",
        "Missed goals are bold.",
        markdown_table(
            {"goal": goal.text}
            | {method: reached(goal, rows, method) for method in methods}
            for goal in GOALS
        ),
    ]
    for table, columns in _COLUMNS.items():
        chosen = [
            row
            for row in rows
            if row.table == table
            and (row.name == POOLED.get(table) or _is_shown(row, methods[0]))
        ]
        if chosen:
            shown = (_shown(row, columns, methods[0]) for row in chosen)
            blocks += [
                f"## {_TITLES[table]}",
                _ABOUT[table],
                markdown_table(shown),
            ]
    about = (
        f"{len(seeds)} recordings of each class, from seed {seeds.start} on. "
        "`--rows FILE` writes all rows."
    )
    return "\n\n".join(filter(None, [*blocks, about])) + "\n"


def _is_shown(row: Row, first_method: str) -> bool:
    """Whether the page contains a row that is not pooled: only rows of the first method."""
    is_shown = row.table == "known answer" or row.name in _LEVELS_SHOWN
    return row.method == first_method and is_shown


def reached(goal: Goal, rows: Sequence[Row], method: str) -> str:
    """Return the worst value for a goal as text; empty without a value.

    The worst value is farthest outside of the goal's range, or nearest to its limits. A value
    outside of the range is bold.
    """
    values: dict[str, float] = {}
    for row in rows:
        is_of_table = (row.table, row.method) == (goal.table, method)
        if is_of_table and re.match(goal.names, row.name):
            value = row.value(goal.kind)
            if np.isfinite(value):
                values[row.name] = value
    if not values:
        return ""

    def excess(name: str) -> float:
        return max(goal.low - values[name], values[name] - goal.high)

    name = max(values, key=excess)
    text = f"{values[name]:.3g}"
    if len(values) > 1:
        text = f"{text} ({name})"
    return text if goal.low <= values[name] <= goal.high else f"**{text}**"


def _shown(
    row: Row, columns: Sequence[str], first_method: str
) -> dict[str, str]:
    """Return the cells of a row by title."""
    name = row.name
    if row.method != first_method:
        name = f"{row.name}, {row.method}"
    cells = {"": name}
    for kind in columns:
        title, _ = KINDS[kind]
        cells[title] = cell(row, kind)
    return cells


def cell(row: Row, kind: str) -> str:
    """Return a measure as text; empty without a value."""
    value = row.value(kind)
    if np.isnan(value):
        return ""
    if kind in _PERCENT:
        return f"{100.0 * value:.0f} %"
    if kind == "deg":
        return f"{value:.3f}"
    return f"{value:.2f}" if value < 100 else f"{value:.0f}"
