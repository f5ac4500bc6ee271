"""Comparison with the published results: how many rows agree, and why the other rows differ."""

from pathlib import Path

import numpy as np
import pandas as pd

from reproduction.rows import METRICS, PUBLISHED, TITLES, UNITS
from reproduction.writing import markdown_table, percent, write_csv

# Largest number of rows that a page lists.
_MOST_LISTED = 30


def write_rows(path: Path, rows: pd.DataFrame) -> Path:
    """Write all rows as CSV: our errors, the published errors, and why they differ.

    Returns the path.
    """
    named = {
        name: f"{name}_{UNITS[name.removeprefix('published_')]}"
        for name in (*METRICS, *PUBLISHED)
    } | {"published_objective": "objective_at_published"}
    columns = ["case", "method", "reference", *METRICS, *PUBLISHED]
    columns += ["objective", "published_objective", "agrees", "why"]
    return write_csv(path, rows[columns].rename(columns=named))


def describe_rows(rows: pd.DataFrame) -> str:
    """Return Markdown: how many rows of each method agree, and why the other rows differ."""
    table = markdown_table(
        {
            "method": TITLES[method],
            "rows that agree": percent(group["agrees"].sum(), len(group)),
            "why the others differ": reasons(group) or "-",
        }
        for method, group in rows.groupby("method")
    )
    is_listed = ~rows["agrees"] & ~rows["method"].isin(["ali", "dnlo"])
    listed = []
    for row in rows[is_listed][:_MOST_LISTED].itertuples():
        objectives = f"{row.objective:.4g}, {row.published_objective:.4g}"
        listed.append(
            {
                "case": row.case,
                "method": TITLES[row.method],
                "reference": row.reference,
                "ours: e_at m, e_aR deg": f"{row.e_at:.4g}, {row.e_aR:.4g}",
                "published": f"{row.published_e_at:.4g}, {row.published_e_aR:.4g}",
                "objective: ours, at the published X": objectives,
                "why": row.why,
            }
        )
    return (
        "A row agrees where each of its four errors is within 0.1 % or 1e-6 (m, deg) of "
        f"the published one.\n\n{table}"
        + (f"\n\n{markdown_table(listed)}" if listed else "")
    )


def describe_dnlo(rows: pd.DataFrame) -> str:
    """Return Markdown: objectives of DNLO at our answers and at the published answers, and the
    change of the errors.
    """
    rows = rows[rows["method"] == "dnlo"]
    counts = rows["verdict"].value_counts()
    lower, equal, higher = (
        int(counts.get(verdict, 0)) for verdict in ("lower", "equal", "higher")
    )
    others = rows[~rows["same_e_at"]]
    text = (
        "DNLO has many local minima, so its objectives, eq. (5), are compared. The same formula "
        "gives the objective at our answer and at the published answer. Ours is lower in "
        f"{lower} of {len(rows)} rows, equal within 1e-6 in {equal}, higher in {higher}. e_at "
        f"equals the published value in {percent(len(rows) - len(others), len(rows))}."
    )
    if len(others):
        moved = (others["e_at"] - others["published_e_at"]).to_numpy()
        text += (
            f" In the other rows, e_at differs by {np.median(np.abs(moved)):.2g} m (median; at "
            f"most {np.abs(moved).max():.2g} m), and is smaller than the published value in "
            f"{percent((moved < 0).sum(), len(moved))}: a lower objective is not always a smaller "
            "error."
        )
    return text


def reasons(rows: pd.DataFrame) -> str:
    """Return the reasons why rows differ, with their counts."""
    whys = rows["why"]
    is_explained = ~rows["agrees"] & (whys != "")
    counts = whys[is_explained].value_counts()
    words = [
        f"{count} of {len(rows)} rows: {why}" for why, count in counts.items()
    ]
    return "; ".join(words)
