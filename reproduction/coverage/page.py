"""The study as a page: goals and tables."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from reproduction.coverage.measures import KINDS, POOLED, Row
from reproduction.published import LEVELS, SIMULATED, path_to
from reproduction.writing import markdown_table

# Of the other tables the goals say all.
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
_PERCENT = ("covers", "covers_floor", "covers_truth", "refused")
# Of the levels of noise, outliers and drift the strongest are shown.
_LEVELS_SHOWN = {
    " ".join(path_to(dataset, LEVELS[dataset][-1])) for dataset in SIMULATED
}


class Goal(NamedTuple):
    """What is aimed at: the range of a measure, in the rows of a table whose names match."""

    text: str
    table: str
    kind: str
    low: float
    high: float
    names: str = "all "


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
        "0.82 to 0.97 in every class", "simulated", "covers", 0.82, 0.97, _EACH
    ),
    Goal("flat_agv is refused", "simulated", "refused", 1.0, 1.0, "flat_agv"),
    Goal(
        "real, with the floor: 0.87 to 0.93",
        "known answer",
        "covers_floor",
        0.87,
        0.93,
    ),
    Goal("without it at least 0.80", "known answer", "covers", 0.8, 1.0),
    Goal("scatter of rigs over sigma 0.8 to 1.25", "rig", "scatter", 0.8, 1.25),
    Goal("of each rig 0.6 to 1.5", "rig", "scatter", 0.6, 1.5, _EACH),
    Goal(
        "scatter of halves and thirds over sigma 0.8 to 1.25",
        "parts",
        "scatter",
        0.8,
        1.25,
    ),
    Goal("three devices close to 0.10 deg", "cycle", "deg", 0, 0.1, "tango"),
    Goal("chi2 of that is below 12.6", "cycle", "chi2", 0, 12.6, "tango"),
    Goal(
        "what leaves something open is refused", "refused", "refused", 1.0, 1.0
    ),
)


def page(rows: Sequence[Row], absent: Sequence[str], seeds: range) -> str:
    """The page in Markdown, from rows, folders of recordings that were not there, and the seeds of
    the recordings per class. Tables of errors over the truth have a row for each recording, others
    the pooled rows; ``--rows`` writes all.
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
    about = f"{len(seeds)} of each class, from seed {seeds.start} on. All rows: `--rows FILE`."
    return "\n\n".join(filter(None, [*blocks, about])) + "\n"


def _is_shown(row: Row, first: str) -> bool:
    is_shown = row.table == "known answer" or row.name in _LEVELS_SHOWN
    return row.method == first and is_shown


def reached(goal: Goal, rows: Sequence[Row], method: str) -> str:
    """The value that is farthest from its range, bold outside of it; empty without any."""
    values = {
        row.name: row.value(goal.kind)
        for row in rows
        if (row.table, row.method) == (goal.table, method)
        and re.match(goal.names, row.name)
    }
    values = {
        name: value for name, value in values.items() if np.isfinite(value)
    }
    if not values:
        return ""
    name = max(
        values,
        key=lambda name: max(goal.low - values[name], values[name] - goal.high),
    )
    text = f"{values[name]:.3g}" + (f" ({name})" if len(values) > 1 else "")
    return text if goal.low <= values[name] <= goal.high else f"**{text}**"


def _shown(row: Row, columns: Sequence[str], first: str) -> dict[str, str]:
    name = row.name if row.method == first else f"{row.name}, {row.method}"
    return {"": name, **{KINDS[kind][0]: cell(row, kind) for kind in columns}}


def cell(row: Row, kind: str) -> str:
    """A measure as text; empty if it was not taken."""
    value = row.value(kind)
    if np.isnan(value):
        return ""
    if kind in _PERCENT:
        return f"{100.0 * value:.0f} %"
    return (
        f"{value:.3f}"
        if kind == "deg"
        else f"{value:.2f}"
        if value < 100
        else f"{value:.0f}"
    )
