"""Comparison with the published results: every row, every plotted point, differences and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from reproduction.rows import METRICS, TITLES, UNITS, Row, agree
from reproduction.statistics import Summary
from reproduction.writing import markdown_table, percent, write_csv

# Half the width of the 95 % interval of a median, in interquartile ranges over the root of the
# number of runs (McGill, Tukey, Larsen 1978).
_NOTCH = 1.57

_MOST_LISTED = 30


def write_rows(path: Path, rows: Sequence[Row]) -> Path:
    """Every row with ours, theirs and why they differ, as CSV; returns the path."""
    named = [f"{metric}_{UNITS[metric]}" for metric in METRICS]
    header = [
        "case",
        "method",
        "reference",
        *named,
        *(f"published_{name}" for name in named),
        "objective",
        "objective_at_published",
        "agrees",
        "why",
    ]
    return write_csv(
        path,
        header,
        (
            [
                row.name,
                row.method,
                row.reference,
                *row.errors,
                *row.theirs,
                row.objective,
                row.published_objective,
                row.agrees,
                row.why(),
            ]
            for row in rows
        ),
    )


def describe_rows(rows: Sequence[Row]) -> str:
    """Markdown: how many rows agree, by method, and the reasons why others do not."""
    methods = sorted({row.method for row in rows})
    lines = []
    for method in methods:
        of_method = [row for row in rows if row.method == method]
        agreeing = sum(row.agrees for row in of_method)
        absolute = sum(agree(row.errors[k], row.theirs[k]) for row in of_method for k in (2, 3))
        reasons = Counter(row.why() for row in of_method if not row.agrees)
        lines.append(
            [
                TITLES[method],
                percent(agreeing, len(of_method)),
                percent(absolute, 2 * len(of_method)),
                "; ".join(f"{reason}: {count}" for reason, count in reasons.most_common()) or "-",
            ]
        )
    text = markdown_table(
        [
            "method",
            "rows that agree",
            "values of e_at and e_aR that agree",
            "why the others differ",
        ],
        lines,
    )
    return (
        "A row agrees where each of its four errors is within 0.1 % or 1e-6 (m, deg) of "
        "the published one.\n\n"
        + text
        + _list_differing(
            [row for row in rows if not row.agrees and row.method not in ("ali", "dnlo")]
        )
    )


def _list_differing(rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    listed = [
        [
            row.name,
            TITLES[row.method],
            row.reference,
            _three(row.errors),
            _three(row.theirs),
            _objectives(row),
            row.why(),
        ]
        for row in rows[:_MOST_LISTED]
    ]
    header = [
        "case",
        "method",
        "reference",
        "ours: e_at m, e_aR deg",
        "published",
        "objective: ours, at the published X",
        "why",
    ]
    more = (
        f"\n\n{len(rows) - _MOST_LISTED} more are in the CSV file."
        if len(rows) > _MOST_LISTED
        else ""
    )
    return "\n\n" + markdown_table(header, listed) + more


def _three(errors: Sequence[float]) -> str:
    return f"{errors[2]:.4g}, {errors[3]:.4g}"


def _objectives(row: Row) -> str:
    return (
        "-"
        if row.published_objective is None
        else f"{row.objective:.4g}, {row.published_objective:.4g}"
    )


def describe_dnlo(rows: Sequence[Row]) -> str:
    """Markdown: the objectives of DNLO against those at the published answers, and how far the
    errors moved.
    """
    rows = [row for row in rows if row.method == "dnlo"]
    verdicts = Counter(row.objective_verdict for row in rows)
    same = sum(agree(row.errors[2], row.theirs[2]) for row in rows)
    moved = np.array(
        [
            abs(row.errors[2] - row.theirs[2])
            for row in rows
            if not agree(row.errors[2], row.theirs[2])
        ]
    )
    nearer = sum(
        row.errors[2] < row.theirs[2] for row in rows if not agree(row.errors[2], row.theirs[2])
    )
    text = (
        "DNLO has many local minima and is compared by its objective, eq. (5), taken by the same "
        f"formula at our and at the published answer: lower in {verdicts['lower']} of {len(rows)} "
        f"rows, equal within 1e-6 in {verdicts['equal']}, higher in {verdicts['higher']}. e_at is "
        f"the published one in {percent(same, len(rows))}."
    )
    if len(moved):
        text += (
            f" Where it is not, it moved by {np.median(moved):.2g} m (median; at most "
            f"{moved.max():.2g} m) and is smaller than the published one in "
            f"{percent(nearer, len(moved))}: a lower objective is not always a smaller error."
        )
    return text


def compare_summaries(ours: Summary, theirs: Summary, same_cases: bool) -> bool:
    """Whether a plotted point agrees with the published one.

    Parameters
    ----------
    ours, theirs : Summary
    same_cases : bool
        Of the same trajectories: the numbers must be equal. Of others: the 95 % intervals must
        overlap.
    """
    if same_cases:
        return all(
            agree(getattr(ours, name), getattr(theirs, name)) for name in ("centre", "low", "high")
        )
    if agree(ours.centre, theirs.centre):
        return True
    (low, high), (their_low, their_high) = _interval(ours), _interval(theirs)
    return low <= their_high and their_low <= high


def _interval(summary: Summary) -> tuple[float, float]:
    if summary.is_median:
        half = _NOTCH * (summary.high - summary.low) / np.sqrt(summary.n)
        return summary.centre - half, summary.centre + half
    return summary.low, summary.high


def reasons(rows: Sequence[Row]) -> str:
    """Why rows differ, with counts, in one string."""
    counted = Counter(row.why() for row in rows if row.published is not None and not row.agrees)
    return "; ".join(
        f"{count} of {len(rows)} rows: {reason}" for reason, count in counted.most_common()
    )
