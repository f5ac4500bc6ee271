"""Comparison with the published results: every row, every plotted point, differences and why."""

from pathlib import Path

import numpy as np
import pandas as pd

from reproduction.results import Summary
from reproduction.rows import METRICS, PUBLISHED, TITLES, UNITS, agree
from reproduction.writing import markdown_table, percent, write_csv

# Half the width of the 95 % interval of a median, in interquartile ranges over the root of the
# number of runs (McGill, Tukey, Larsen 1978).
_NOTCH = 1.57

_MOST_LISTED = 30


def write_rows(path: Path, rows: pd.DataFrame) -> Path:
    """Every row with ours, theirs and why they differ, as CSV; returns the path."""
    named = {
        name: f"{name}_{UNITS[name.removeprefix('published_')]}" for name in (*METRICS, *PUBLISHED)
    } | {"published_objective": "objective_at_published"}
    columns = ["case", "method", "reference", *METRICS, *PUBLISHED]
    columns += ["objective", "published_objective", "agrees", "why"]
    return write_csv(path, rows[columns].rename(columns=named))


def describe_rows(rows: pd.DataFrame) -> str:
    """Markdown: how many rows agree, by method, and the reasons why others do not."""
    lines = []
    for method, some in rows.groupby("method"):
        absolute = agree(some[["e_at", "e_aR"]].to_numpy(), some[list(PUBLISHED[2:])].to_numpy())
        why = some["why"][~some["agrees"]].value_counts()
        lines.append(
            {
                "method": TITLES[method],
                "rows that agree": percent(some["agrees"].sum(), len(some)),
                "values of e_at and e_aR that agree": percent(absolute.sum(), absolute.size),
                "why the others differ": "; ".join(f"{k}: {n}" for k, n in why.items()) or "-",
            }
        )
    others = rows[~rows["agrees"] & ~rows["method"].isin(["ali", "dnlo"])]
    return (
        "A row agrees where each of its four errors is within 0.1 % or 1e-6 (m, deg) of "
        f"the published one.\n\n{markdown_table(lines)}{_list_differing(others)}"
    )


def _list_differing(rows: pd.DataFrame) -> str:
    if rows.empty:
        return ""
    listed = [
        {
            "case": row.case,
            "method": TITLES[row.method],
            "reference": row.reference,
            "ours: e_at m, e_aR deg": f"{row.e_at:.4g}, {row.e_aR:.4g}",
            "published": f"{row.published_e_at:.4g}, {row.published_e_aR:.4g}",
            "objective: ours, at the published X": "-"
            if np.isnan(row.published_objective)
            else f"{row.objective:.4g}, {row.published_objective:.4g}",
            "why": row.why,
        }
        for row in rows[:_MOST_LISTED].itertuples()
    ]
    n_more = len(rows) - _MOST_LISTED
    more = f"\n\n{n_more} more are in the CSV file." if n_more > 0 else ""
    return "\n\n" + markdown_table(listed) + more


def describe_dnlo(rows: pd.DataFrame) -> str:
    """Markdown: the objectives of DNLO against those at the published answers, and how far the
    errors moved.
    """
    rows = rows[rows["method"] == "dnlo"]
    lower, equal, higher = (int((rows["verdict"] == x).sum()) for x in ("lower", "equal", "higher"))
    others = rows[~rows["same_e_at"]]
    text = (
        "DNLO has many local minima and is compared by its objective, eq. (5), taken by the same "
        f"formula at our and at the published answer: lower in {lower} of {len(rows)} "
        f"rows, equal within 1e-6 in {equal}, higher in {higher}. e_at is "
        f"the published one in {percent(len(rows) - len(others), len(rows))}."
    )
    if len(others):
        moved = (others["e_at"] - others["published_e_at"]).to_numpy()
        text += (
            f" Where it is not, it moved by {np.median(np.abs(moved)):.2g} m (median; at most "
            f"{np.abs(moved).max():.2g} m) and is smaller than the published one in "
            f"{percent((moved < 0).sum(), len(moved))}: a lower objective is not always a smaller "
            "error."
        )
    return text


def compare_summaries(ours: Summary, theirs: Summary, same_cases: bool) -> bool:
    """Whether a plotted point agrees with the published one. Of the same trajectories: the numbers
    must be equal. Of others: the 95 % intervals must overlap.
    """
    if same_cases:
        pairs = ((getattr(one, x) for one in (ours, theirs)) for x in ("centre", "low", "high"))
        return all(agree(*pair) for pair in pairs)
    (low, high), (their_low, their_high) = _interval(ours), _interval(theirs)
    return bool(agree(ours.centre, theirs.centre)) or (low <= their_high and their_low <= high)


def _interval(summary: Summary) -> tuple[float, float]:
    if summary.is_median:
        half = _NOTCH * (summary.high - summary.low) / np.sqrt(summary.n)
        return summary.centre - half, summary.centre + half
    return summary.low, summary.high


def reasons(rows: pd.DataFrame) -> str:
    """Why rows differ, with counts, in one string."""
    counts = rows["why"][~rows["agrees"] & (rows["why"] != "")].value_counts()
    return "; ".join(f"{n} of {len(rows)} rows: {why}" for why, n in counts.items())
