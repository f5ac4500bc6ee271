"""Tables 1 and 2 (best variants on KITTI) and S1-S12 (all references).

Errors are against the published ground truth and against the rectified ground truth.
"""

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hand_eye_calib.core.geometry.se3 import absolute_errors
from reproduction import comparison
from reproduction.published import METHODS, RECTIFIED, REFERENCES
from reproduction.results import Results
from reproduction.rows import METRICS, TITLES
from reproduction.writing import markdown_table, percent, write_csv, write_text

SUMMARY_TABLES = {"table1": "kitti_short", "table2": "kitti_long"}
_DRIVES = {
    "kitti_short": "Camera to lidar calibration on KITTI 2011_09_30_drive_0027",
    "kitti_long": "Camera to camera calibration on KITTI 2011_10_03_drive_0027",
}
VARIANT_TABLES = {
    f"tableS{number}": variant
    for number, variant in enumerate(product(_DRIVES, METHODS), start=1)
}

# Tables 1 and 2 as printed in the paper: best variant; e_rt, e_rR, e_at, e_aR; improvement of e_at
# and e_aR over B1 (None if B1 is the best variant).
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
_RECTIFIED_GAINS = tuple(f"rectified: {gain}" for gain in _GAINS)
_COLUMNS = (*_ERRORS, *_GAINS, *_RECTIFIED, *_RECTIFIED_GAINS)
_NOTE = (
    "Errors in the columns 'rectified' are against the calibration of the rectified images, which "
    "the SLAM used. Other errors are against the published ground truth. Gain: error of the "
    "method's B1 variant minus the error of this variant."
)

# Largest difference of numbers that are equal when printed with three decimals.
_SAME_PRINT = 0.00051


def with_rectified(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of one drive by method and reference, with further columns.

    The further columns are the errors against the rectified truth, and the gains over the method's
    B1 variant.
    """
    truth = RECTIFIED[rows["dataset"].iloc[0]]
    indexed = rows.set_index(["method", "reference"])
    errors = [
        absolute_errors(np.reshape(T, (4, 4)), truth)
        for T in indexed["T_parent_child"]
    ]
    indexed[list(_RECTIFIED)] = np.array(errors) * [1.0, 180.0 / np.pi]
    indexed = indexed.rename(columns=dict(zip(METRICS, _ERRORS, strict=True)))
    absolute = [*_ERRORS[2:], *_RECTIFIED]
    of_b1 = indexed.xs("B1", level="reference")[absolute].reindex(
        indexed.index, level="method"
    )
    gains = of_b1 - indexed[absolute]
    gains[indexed.index.get_level_values("reference") == "B1"] = np.nan
    indexed[[*_GAINS, *_RECTIFIED_GAINS]] = gains
    return indexed


def best_variants(rows: pd.DataFrame, by: str = _ERRORS[2]) -> pd.DataFrame:
    """Select the variant of each method with the smallest error ``by``.

    ``rows`` are from :func:`with_rectified`.
    """
    best = []
    for method in METHODS:
        rows_of_method = rows.loc[[method]]
        best.append(rows_of_method[by].idxmin())
    return rows.loc[best]


def write_summary_table(name: str, results: Results) -> list[Path]:
    """Write Table 1 or 2 and its comparison with the printed table; return the paths."""
    dataset = SUMMARY_TABLES[name]
    rows = with_rectified(results.rows[results.rows["dataset"] == dataset])
    best = best_variants(rows)
    smallest = best[[*_ERRORS, *_RECTIFIED]].min()
    printed = []
    for (method, reference), row in best.iterrows():
        line = {"method": f"{TITLES[method]} {reference}"}
        for column in _COLUMNS:
            line[column] = _print(row[column], smallest.get(column))
        printed.append(line)
    table = best[list(_COLUMNS)].reset_index(names=["method", "variant"])
    table["method"] = table["method"].map(TITLES)
    return [
        write_text(
            results.out / f"{name}.md",
            f"# Table {name[-1]}. {_DRIVES[dataset]}",
            markdown_table(printed),
            f"Best variant of each method by e_at; the smallest error of a column is bold. {_NOTE}",
        ),
        write_csv(results.out / f"{name}.csv", table),
        *_compare_with_print(name, rows, best, results),
    ]


def _print(value: float, bold: float | None = None) -> str:
    """Return a value with three decimals, in bold type if it equals ``bold`` in three decimals."""
    if np.isnan(value):
        return "-"
    text = f"{value:.3f}"
    return f"**{text}**" if bold is not None and text == f"{bold:.3f}" else text


def _compare_with_print(
    name: str, rows: pd.DataFrame, best: pd.DataFrame, results: Results
) -> list[Path]:
    """Write the cells of a summary table beside the printed ones, and return the paths.

    A row of the CSV file has the value of our best variant and the printed value. The Markdown file
    lists the cells that differ.
    """
    dataset = SUMMARY_TABLES[name]
    cells: list[dict[str, Any]] = []
    for method, reference in best.index:
        variant, *numbers = PRINTED[dataset][method]
        # Printed gains are relative to B1, so the reason of B1 may explain a difference, too.
        reasons = rows.loc[method].loc[[variant, "B1"], "why"]
        why = "; ".join(dict.fromkeys(reasons))
        for column, number in zip((*_ERRORS, *_GAINS), numbers, strict=True):
            ours = float(best.loc[(method, reference), column])
            agrees = (
                np.isnan(ours)
                if number is None
                else abs(ours - number) <= _SAME_PRINT
            )
            cells.append(
                {
                    "method": TITLES[method],
                    "our_best_variant": reference,
                    "papers_variant": variant,
                    "column": column,
                    "ours": ours,
                    "printed": number,
                    "agrees": agrees,
                    "why": "" if agrees else why,
                }
            )
    compared = pd.DataFrame(cells)
    solved = results.rows[results.rows["dataset"] == dataset]
    return [
        write_csv(results.out / f"{name}_comparison.csv", compared),
        write_text(
            results.out / f"{name}_comparison.md",
            f"# {name}: comparison with the paper",
            "Cells that agree with the printed table to its three decimals: "
            f"{percent(compared['agrees'].sum(), len(compared))}.",
            markdown_table(
                compared[~compared["agrees"]].round(4).to_dict("records")
            ),
            "## Every variant, against the published results in full precision",
            comparison.describe_rows(solved),
            comparison.describe_dnlo(solved),
        ),
    ]


def write_variant_table(name: str, results: Results) -> list[Path]:
    """Write one of Tables S1 to S12 and its comparison with the paper; return the paths."""
    dataset, method = VARIANT_TABLES[name]
    solved = results.of(dataset, method)
    rows = with_rectified(solved).loc[method].loc[list(REFERENCES)]
    columns = [*_ERRORS, *_RECTIFIED]
    best = rows[_ERRORS[2]].idxmin()
    printed = []
    for reference, row in rows.iterrows():
        line = {"reference": reference}
        for column in columns:
            bold = row[column] if reference == best else None
            line[column] = _print(row[column], bold)
        printed.append(line)
    return [
        write_text(
            results.out / f"{name}.md",
            f"# Table {name.removeprefix('table')}. {_DRIVES[dataset]} using {TITLES[method]}",
            markdown_table(printed),
            f"The best variant by e_at is bold. {_NOTE}",
        ),
        write_csv(results.out / f"{name}.csv", rows[columns].reset_index()),
        write_text(
            results.out / f"{name}_comparison.md",
            f"# {name}: comparison with the published results",
            comparison.describe_rows(solved),
            comparison.describe_dnlo(solved) if method == "dnlo" else "",
        ),
    ]
