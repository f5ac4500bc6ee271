"""Tables 1 and 2 (best variants on KITTI) and S1-S12 (every reference), against the published and
the rectified ground truth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hand_eye_calib.assessment.metrics import absolute_errors
from reproduction import comparison
from reproduction.kitti_truth import RECTIFIED
from reproduction.published import METHODS, REFERENCES
from reproduction.rows import TITLES, Row, agree
from reproduction.writing import markdown_table, percent, write_csv, write_text

if TYPE_CHECKING:
    from reproduction.results import Results

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
_COLUMNS = (
    "e_rt (m)",
    "e_rR (deg)",
    "e_at (m)",
    "e_aR (deg)",
    "e_at gain over B1 (m)",
    "e_aR gain over B1 (deg)",
)
_ERROR_COLUMNS = (0, 1, 2, 3, 6, 7)
_RECTIFIED_COLUMNS = tuple(f"rectified: {column}" for column in _COLUMNS[2:])
_NOTE = (
    "Columns 'rectified' are against the calibration of the rectified images that the SLAM saw; "
    "the others against the ground truth as published. Gain: error of the method's B1 variant "
    "less that of this one."
)


# By method and reference.
Variants = Mapping[str, Mapping[str, Row]]
# Variant and its values; None without a gain.
Line = tuple[str, tuple[float | None, ...]]


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
    lines = {
        method: _line(best_variant(rows[method].values()), rows[method]["B1"]) for method in METHODS
    }
    smallest = {
        column: min(value for _, values in lines.values() if (value := values[column]) is not None)
        for column in _ERROR_COLUMNS
    }
    header = ["method", *_COLUMNS, *_RECTIFIED_COLUMNS]
    body = [
        [
            f"{TITLES[method]} {variant}",
            *(_print(value, smallest.get(column)) for column, value in enumerate(values)),
        ]
        for method, (variant, values) in lines.items()
    ]
    table = [
        [TITLES[method], variant, *("" if value is None else value for value in values)]
        for method, (variant, values) in lines.items()
    ]
    return [
        write_text(
            results.out / f"{name}.md",
            f"# Table {name[-1]}. {_DRIVES[dataset]}",
            markdown_table(header, body),
            f"Best variant of each method by e_at; the smallest error of a column is bold. {_NOTE}",
            _best_against_rectified(rows),
        ),
        write_csv(results.out / f"{name}.csv", ["method", "variant", *header[1:]], table),
        *_compare_with_print(name, rows, lines, results),
    ]


def _line(row: Row, b1: Row) -> Line:
    """Variant and the ten numbers of a method."""
    rectified = rectified_errors(row)
    if row.reference == "B1":
        return "B1", (*row.errors, None, None, *rectified, None, None)
    gains = (b1.errors[2] - row.errors[2], b1.errors[3] - row.errors[3])
    rectified_gains = tuple(np.subtract(rectified_errors(b1), rectified).tolist())
    return row.reference, (*row.errors, *gains, *rectified, *rectified_gains)


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
        b1 = rectified_errors(by_reference["B1"])
        lines.append(
            [
                f"{TITLES[method]} {row.reference}",
                f"{e_at:.3f}",
                f"{e_aR:.3f}",
                f"{b1[0]:.3f}",
                f"{b1[1]:.3f}",
            ]
        )
    header = [
        "best against the rectified truth",
        "e_at (m)",
        "e_aR (deg)",
        "B1: e_at (m)",
        "B1: e_aR (deg)",
    ]
    return markdown_table(header, lines)


def _compare_with_print(
    name: str, rows: Variants, lines: Mapping[str, Line], results: Results
) -> list[Path]:
    """Cell by cell: ours (of our best variant, and of the paper's), the published file's, and as
    printed.
    """
    dataset = SUMMARY_TABLES[name]
    compared: list[list[Any]] = []
    for method, (variant, values) in lines.items():
        printed_variant, *printed = PRINTED[dataset][method]
        there = rows[method][printed_variant]
        same_variant = _line(there, rows[method]["B1"])[1]
        why = "; ".join(
            dict.fromkeys(
                f"{row.reference}: {row.why()}"
                for row in (there, rows[method]["B1"])
                if not row.agrees
            )
        )
        for column, ours, ours_there, theirs in zip(
            _COLUMNS, values[:6], same_variant[:6], printed, strict=True
        ):
            same = (ours is theirs) or (
                ours is not None and theirs is not None and abs(ours - theirs) <= 0.00051
            )
            there_same = (ours_there is theirs) or abs(ours_there - theirs) <= 0.00051
            note = "" if same else f"best variant is {variant} here" if there_same else why
            compared.append(
                [
                    TITLES[method],
                    variant,
                    printed_variant,
                    column,
                    _blank(ours),
                    _blank(ours_there),
                    _blank(theirs),
                    same,
                    there_same,
                    note,
                ]
            )
    header = [
        "method",
        "our_best_variant",
        "papers_variant",
        "column",
        "ours",
        "ours_with_the_papers_variant",
        "printed",
        "agrees",
        "agrees_with_the_papers_variant",
        "why",
    ]
    text = [
        "Cells that agree with the printed table to its three decimals: "
        f"{percent(sum(line[7] for line in compared), len(compared))}; with the paper's variant of "
        f"each method: {percent(sum(line[8] for line in compared), len(compared))}.",
        markdown_table(
            header,
            [
                [f"{cell:.4f}" if isinstance(cell, float) else cell for cell in line]
                for line in compared
                if not line[7]
            ],
        )
        if not all(line[7] for line in compared)
        else "",
        "## Every variant, against the published results in full precision",
        comparison.describe_rows([row for method in METHODS for row in rows[method].values()]),
        comparison.describe_dnlo(list(rows["dnlo"].values())),
    ]
    return [
        write_csv(results.out / f"{name}_comparison.csv", header, compared),
        write_text(
            results.out / f"{name}_comparison.md", f"# {name}: comparison with the paper", *text
        ),
    ]


def _blank(value: float | None) -> float | str:
    return "" if value is None else value


def write_variant_table(name: str, results: Results) -> list[Path]:
    """Tables S1 to S12; returns the paths."""
    dataset, method = VARIANT_TABLES[name]
    rows = results.of(dataset, method)
    best = best_variant(rows)
    header = ["reference", *_COLUMNS[:4], "rectified: e_at (m)", "rectified: e_aR (deg)"]
    lines: list[list[Any]] = [
        [row.reference, *row.errors, *rectified_errors(row)]
        for row in sorted(rows, key=lambda row: REFERENCES.index(row.reference))
    ]
    printed = [
        [
            line[0],
            *(_print(value, value if line[0] == best.reference else None) for value in line[1:]),
        ]
        for line in lines
    ]
    title = f"# Table {name.removeprefix('table')}. {_DRIVES[dataset]} using {TITLES[method]}"
    compared = [
        [
            row.reference,
            metric,
            ours,
            theirs,
            agree(ours, theirs),
            "" if agree(ours, theirs) else row.why(),
        ]
        for row in rows
        for metric, ours, theirs in zip(_COLUMNS[:4], row.errors, row.theirs, strict=True)
    ]
    blocks = [comparison.describe_rows(rows)]
    if method == "dnlo":
        blocks.append(comparison.describe_dnlo(rows))
        blocks.append(
            markdown_table(
                [
                    "reference",
                    "objective",
                    "objective at the published answer",
                    "e_at (m)",
                    "published e_at (m)",
                ],
                [
                    [
                        row.reference,
                        f"{row.objective:.6f}",
                        f"{row.published_objective:.6f}",
                        f"{row.errors[2]:.4f}",
                        f"{row.theirs[2]:.4f}",
                    ]
                    for row in rows
                ],
            )
        )
    return [
        write_text(
            results.out / f"{name}.md",
            title,
            markdown_table(header, printed),
            f"The best variant by e_at is bold. {_NOTE}",
        ),
        write_csv(results.out / f"{name}.csv", header, lines),
        write_csv(
            results.out / f"{name}_comparison.csv",
            ["reference", "column", "ours", "published", "agrees", "why"],
            compared,
        ),
        write_text(
            results.out / f"{name}_comparison.md",
            f"# {name}: comparison with the published results",
            *blocks,
        ),
    ]
