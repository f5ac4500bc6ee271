"""Tables 1 and 2 (best variants on KITTI) and S1-S12 (every reference), against the published and
the rectified ground truth.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.assessment.metrics import absolute_errors
from reproduction import comparison
from reproduction.kitti_truth import RECTIFIED
from reproduction.published import METHODS, REFERENCES
from reproduction.results import Results
from reproduction.rows import TITLES, Row, agree
from reproduction.writing import markdown_table, percent, write_csv, write_text

SUMMARY_TABLES = {"table1": "kitti_short", "table2": "kitti_long"}
_DRIVES = {
    "kitti_short": "Camera to lidar calibration on KITTI 2011_09_30_drive_0027",
    "kitti_long": "Camera to camera calibration on KITTI 2011_10_03_drive_0027",
}
VARIANT_TABLES = {
    f"tableS{number}": (dataset, method)
    for number, (dataset, method) in enumerate(
        ((dataset, method) for dataset in _DRIVES for method in METHODS), start=1
    )
}

# As printed in the paper: variant; e_rt, e_rR, e_at, e_aR; improvement of e_at and e_aR over B1
# (none where B1 is the best).
PRINTED: dict[str, dict[str, tuple[Any, ...]]] = {
    "kitti_short": {
        "ali": ("B5", 0.170, 0.294, 0.342, 0.722, 0.288, -0.056),
        "dnl": ("B5", 0.170, 0.293, 0.342, 0.721, 0.288, -0.052),
        "dnlo": ("B10", 0.271, 0.488, 0.202, 0.232, 0.128, 0.209),
        "park": ("B10", 0.325, 0.473, 0.183, 0.849, 0.435, -0.102),
        "taylor": ("B10", 0.325, 0.473, 0.183, 0.849, 0.435, -0.102),
        "zhuang": ("B1", 0.055, 0.152, 1.063, 2.899, None, None),
    },
    "kitti_long": {
        "ali": ("B5", 0.155, 0.181, 0.074, 0.432, 0.104, 0.018),
        "dnl": ("B5", 0.155, 0.181, 0.074, 0.432, 0.104, 0.018),
        "dnlo": ("C5", 0.076, 0.149, 0.159, 0.345, 0.034, 0.071),
        "park": ("B5", 0.157, 0.181, 0.078, 0.351, 0.111, 0.075),
        "taylor": ("B5", 0.157, 0.181, 0.078, 0.351, 0.111, 0.075),
        "zhuang": ("B5", 0.155, 0.181, 0.074, 0.400, 0.106, -0.081),
    },
}
_ERRORS = ("e_rt (m)", "e_rR (deg)", "e_at (m)", "e_aR (deg)")
_GAINS = ("e_at gain over B1 (m)", "e_aR gain over B1 (deg)")
_RECTIFIED = ("rectified: e_at (m)", "rectified: e_aR (deg)")
_NOTE = (
    "Columns 'rectified' are against the calibration of the rectified images that the SLAM saw; "
    "the others against the ground truth as published. Gain: error of the method's B1 variant "
    "less that of this one."
)


# Printed numbers are the same to three decimals.
_SAME_PRINT = 0.00051

# By method and reference.
Variants = Mapping[str, Mapping[str, Row]]
# Column to value; None without a gain.
Values = dict[str, float | None]


def rectified_errors(row: Row) -> tuple[float, float]:
    """e_at (m) and e_aR (deg) against the rectified ground truth."""
    e_at, e_aR = absolute_errors(row.transform, RECTIFIED[row.dataset])
    return e_at, float(np.degrees(e_aR))


def best_variant(
    rows: Iterable[Row], error: Callable[[Row], float] = lambda row: row.errors[2]
) -> Row:
    """The row with the smallest e_at, or another error."""
    return min(rows, key=error)


def write_summary_table(name: str, results: Results) -> list[Path]:
    """Tables 1 and 2; returns the paths."""
    dataset = SUMMARY_TABLES[name]
    rows = {
        method: {row.reference: row for row in results.of(dataset, method)} for method in METHODS
    }
    best = {method: best_variant(rows[method].values()) for method in METHODS}
    values = {method: _values(best[method], rows[method]["B1"]) for method in METHODS}
    smallest = {
        column: min(each[column] for each in values.values()) for column in (*_ERRORS, *_RECTIFIED)
    }
    printed = (
        {"method": f"{TITLES[method]} {best[method].reference}"}
        | {column: _print(value, smallest.get(column)) for column, value in each.items()}
        for method, each in values.items()
    )
    table = (
        {"method": TITLES[method], "variant": best[method].reference, **_blank(each)}
        for method, each in values.items()
    )
    return [
        write_text(
            results.out / f"{name}.md",
            f"# Table {name[-1]}. {_DRIVES[dataset]}",
            markdown_table(printed),
            f"Best variant of each method by e_at; the smallest error of a column is bold. {_NOTE}",
            _best_against_rectified(rows),
        ),
        write_csv(results.out / f"{name}.csv", table),
        *_compare_with_print(name, rows, best, results),
    ]


def _values(row: Row, b1: Row) -> Any:
    """The ten numbers of a variant by column."""
    own, base = ((*x.errors[2:], *rectified_errors(x)) for x in (row, b1))
    gains = [None if row.reference == "B1" else y - x for x, y in zip(own, base, strict=True)]
    values = (*row.errors, *gains[:2], *own[2:], *gains[2:])
    columns = (*_ERRORS, *_GAINS, *_RECTIFIED, *(f"rectified: {gain}" for gain in _GAINS))
    return dict(zip(columns, values, strict=True))


def _blank(values: Values) -> dict[str, float | str]:
    return {column: "" if value is None else value for column, value in values.items()}


def _print(value: float | None, bold: float | None = None) -> str:
    """To three decimals; bold where that reads as ``bold`` does."""
    if value is None:
        return "-"
    text = f"{value:.3f}"
    return f"**{text}**" if bold is not None and text == f"{bold:.3f}" else text


def _best_against_rectified(rows: Variants) -> str:
    lines = []
    for method, by_reference in rows.items():
        row = best_variant(by_reference.values(), lambda row: rectified_errors(row)[0])
        e_at, e_aR = rectified_errors(row)
        b1_e_at, b1_e_aR = rectified_errors(by_reference["B1"])
        lines.append(
            {
                "best against the rectified truth": f"{TITLES[method]} {row.reference}",
                "e_at (m)": f"{e_at:.3f}",
                "e_aR (deg)": f"{e_aR:.3f}",
                "B1: e_at (m)": f"{b1_e_at:.3f}",
                "B1: e_aR (deg)": f"{b1_e_aR:.3f}",
            }
        )
    return markdown_table(lines)


def _compare_with_print(
    name: str, rows: Variants, best: Mapping[str, Row], results: Results
) -> list[Path]:
    """Cell by cell: ours (of our best variant, and of the paper's), the published file's, and as
    printed.
    """
    compared = [
        line
        for method in METHODS
        for line in _printed_cells(
            rows[method], best[method], PRINTED[SUMMARY_TABLES[name]][method]
        )
    ]
    agreeing, there = (
        percent(sum(line[which] for line in compared), len(compared))
        for which in ("agrees", "agrees_with_the_papers_variant")
    )
    differing = [
        {column: f"{x:.4f}" if isinstance(x, float) else x for column, x in line.items()}
        for line in compared
        if not line["agrees"]
    ]
    return [
        write_csv(results.out / f"{name}_comparison.csv", compared),
        write_text(
            results.out / f"{name}_comparison.md",
            f"# {name}: comparison with the paper",
            f"Cells that agree with the printed table to its three decimals: {agreeing}; with the "
            f"paper's variant of each method: {there}.",
            markdown_table(differing) if differing else "",
            "## Every variant, against the published results in full precision",
            comparison.describe_rows([row for by in rows.values() for row in by.values()]),
            comparison.describe_dnlo(list(rows["dnlo"].values())),
        ),
    ]


def _printed_cells(
    rows: Mapping[str, Row], best: Row, printed: tuple[Any, ...]
) -> Iterator[dict[str, Any]]:
    """A line for each printed number of a method."""
    variant, *numbers = printed
    involved = [row for row in (rows[variant], rows["B1"]) if not row.agrees]
    why = "; ".join(dict.fromkeys(f"{row.reference}: {row.why()}" for row in involved))
    ours, there = _values(best, rows["B1"]), _values(rows[variant], rows["B1"])
    for column, number in zip((*_ERRORS, *_GAINS), numbers, strict=True):
        same, same_there = (_reads_as(each[column], number) for each in (ours, there))
        other = f"best variant is {best.reference} here" if same_there else why
        yield {
            "method": TITLES[best.method],
            "our_best_variant": best.reference,
            "papers_variant": variant,
            "column": column,
            **_blank(
                {
                    "ours": ours[column],
                    "ours_with_the_papers_variant": there[column],
                    "printed": number,
                }
            ),
            "agrees": same,
            "agrees_with_the_papers_variant": same_there,
            "why": "" if same else other,
        }


def _reads_as(value: float | None, printed: float | None) -> bool:
    if value is None or printed is None:
        return value is printed
    return abs(value - printed) <= _SAME_PRINT


def write_variant_table(name: str, results: Results) -> list[Path]:
    """Tables S1 to S12; returns the paths."""
    dataset, method = VARIANT_TABLES[name]
    rows = results.of(dataset, method)
    best = best_variant(rows)
    values = {
        row.reference: dict(
            zip((*_ERRORS, *_RECTIFIED), (*row.errors, *rectified_errors(row)), strict=True)
        )
        for row in sorted(rows, key=lambda row: REFERENCES.index(row.reference))
    }
    printed = (
        {"reference": name}
        | {column: _print(x, x if name == best.reference else None) for column, x in each.items()}
        for name, each in values.items()
    )
    compared = (
        {
            "reference": row.reference,
            "column": column,
            "ours": ours,
            "published": theirs,
            "agrees": agree(ours, theirs),
            "why": "" if agree(ours, theirs) else row.why(),
        }
        for row in rows
        for column, ours, theirs in zip(_ERRORS, row.errors, row.theirs, strict=True)
    )
    blocks = [comparison.describe_rows(rows)]
    if method == "dnlo":
        objectives = (
            {
                "reference": row.reference,
                "objective": f"{row.objective:.6f}",
                "objective at the published answer": f"{row.published_objective:.6f}",
                "e_at (m)": f"{row.errors[2]:.4f}",
                "published e_at (m)": f"{row.theirs[2]:.4f}",
            }
            for row in rows
        )
        blocks += [comparison.describe_dnlo(rows), markdown_table(objectives)]
    return [
        write_text(
            results.out / f"{name}.md",
            f"# Table {name.removeprefix('table')}. {_DRIVES[dataset]} using {TITLES[method]}",
            markdown_table(printed),
            f"The best variant by e_at is bold. {_NOTE}",
        ),
        write_csv(
            results.out / f"{name}.csv",
            ({"reference": reference, **each} for reference, each in values.items()),
        ),
        write_csv(results.out / f"{name}_comparison.csv", compared),
        write_text(
            results.out / f"{name}_comparison.md",
            f"# {name}: comparison with the published results",
            *blocks,
        ),
    ]
