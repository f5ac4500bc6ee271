"""Comparison with the published results: every row, every plotted point, differences and why."""

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
    lines = (
        {"case": row.name, "method": row.method, "reference": row.reference}
        | dict(zip(named, row.errors, strict=True))
        | {f"published_{name}": error for name, error in zip(named, row.theirs, strict=True)}
        | {"objective": row.objective, "objective_at_published": row.published_objective}
        | {"agrees": row.agrees, "why": row.why()}
        for row in rows
    )
    return write_csv(path, lines)


def describe_rows(rows: Sequence[Row]) -> str:
    """Markdown: how many rows agree, by method, and the reasons why others do not."""
    lines = []
    for method in sorted({row.method for row in rows}):
        some = [row for row in rows if row.method == method]
        absolute = sum(agree(row.errors[k], row.theirs[k]) for row in some for k in (2, 3))
        reasons = Counter(row.why() for row in some if not row.agrees).most_common()
        lines.append(
            {
                "method": TITLES[method],
                "rows that agree": percent(sum(row.agrees for row in some), len(some)),
                "values of e_at and e_aR that agree": percent(absolute, 2 * len(some)),
                "why the others differ": "; ".join(f"{why}: {n}" for why, n in reasons) or "-",
            }
        )
    others = [row for row in rows if not row.agrees and row.method not in ("ali", "dnlo")]
    return (
        "A row agrees where each of its four errors is within 0.1 % or 1e-6 (m, deg) of "
        f"the published one.\n\n{markdown_table(lines)}{_list_differing(others)}"
    )


def _list_differing(rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    listed = [
        {
            "case": row.name,
            "method": TITLES[row.method],
            "reference": row.reference,
            "ours: e_at m, e_aR deg": f"{row.errors[2]:.4g}, {row.errors[3]:.4g}",
            "published": f"{row.theirs[2]:.4g}, {row.theirs[3]:.4g}",
            "objective: ours, at the published X": "-"
            if row.published_objective is None
            else f"{row.objective:.4g}, {row.published_objective:.4g}",
            "why": row.why(),
        }
        for row in rows[:_MOST_LISTED]
    ]
    n_more = len(rows) - _MOST_LISTED
    more = f"\n\n{n_more} more are in the CSV file." if n_more > 0 else ""
    return "\n\n" + markdown_table(listed) + more


def describe_dnlo(rows: Sequence[Row]) -> str:
    """Markdown: the objectives of DNLO against those at the published answers, and how far the
    errors moved.
    """
    rows = [row for row in rows if row.method == "dnlo"]
    verdicts = Counter(row.objective_verdict for row in rows)
    others = [row for row in rows if not row.is_e_at_the_same]
    moved = np.array([abs(row.errors[2] - row.theirs[2]) for row in others])
    nearer = sum(row.errors[2] < row.theirs[2] for row in others)
    text = (
        "DNLO has many local minima and is compared by its objective, eq. (5), taken by the same "
        f"formula at our and at the published answer: lower in {verdicts['lower']} of {len(rows)} "
        f"rows, equal within 1e-6 in {verdicts['equal']}, higher in {verdicts['higher']}. e_at is "
        f"the published one in {percent(len(rows) - len(others), len(rows))}."
    )
    if others:
        text += (
            f" Where it is not, it moved by {np.median(moved):.2g} m (median; at most "
            f"{moved.max():.2g} m) and is smaller than the published one in "
            f"{percent(nearer, len(moved))}: a lower objective is not always a smaller error."
        )
    return text


def compare_summaries(ours: Summary, theirs: Summary, same_cases: bool) -> bool:
    """Whether a plotted point agrees with the published one. Of the same trajectories: the numbers
    must be equal. Of others: the 95 % intervals must overlap.
    """
    if same_cases:
        names = ("centre", "low", "high")
        return all(agree(getattr(ours, name), getattr(theirs, name)) for name in names)
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
    counts = Counter(row.why() for row in rows if row.published is not None and not row.agrees)
    return "; ".join(f"{n} of {len(rows)} rows: {why}" for why, n in counts.most_common())
