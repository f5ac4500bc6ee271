"""Our run against the published results: agreement of rows, DNLO, Ali, Zhuang's false minima."""

from pathlib import Path

import numpy as np
import pandas as pd

from reproduction import comparison
from reproduction.published import KITTI, LEVELS, REFERENCES, SIMULATED
from reproduction.results import Results, Table
from reproduction.rows import ALI_AS_PUBLISHED
from reproduction.writing import markdown_table, percent, write_text

# An answer whose rotation error exceeds this (deg) is a false minimum.
_WRONG_DEG = 90.0


def write(name: str, results: Results) -> list[Path]:
    """Write ``NAME.md`` and rows.csv, and return their paths."""
    rows = results.rows
    paired = rows[(rows["method"] != "ali") | rows["dataset"].isin(KITTI)]
    return [
        write_text(
            results.out / f"{name}.md",
            "# What the run says about the published results",
            "## Row by row",
            comparison.describe_rows(paired),
            "## DNLO",
            comparison.describe_dnlo(results.rows),
            "## Ali: as published, and with a normalised quaternion",
            _ali(results.ours),
            "## Zhuang's false minima",
            _zhuang(results.rows),
        ),
        comparison.write_rows(results.out / "rows.csv", results.rows),
    ]


def _ali(table: Table) -> str:
    """Return tables of median errors of both variants of Ali, and of DNL, at the largest noise."""
    blocks = []
    for dataset in SIMULATED:
        level = LEVELS[dataset][-1]
        lines = [
            _medians(table, dataset, level, reference)
            for reference in REFERENCES
        ]
        where = "mixture" if level is None else f"{dataset} at {level:g}"
        blocks.append(f"Medians, {where}.\n\n{markdown_table(lines)}")
    return "\n\n".join(blocks)


def _medians(
    table: Table, dataset: str, level: float | None, reference: str
) -> dict[str, str]:
    methods = {"published": ALI_AS_PUBLISHED, "proper": "ali", "DNL": "dnl"}
    line = {"reference": reference}
    for metric in ("e_at", "e_aR"):
        for title, method in methods.items():
            values = table.values(dataset, level, method, reference, metric)
            line[f"{metric}, {title}"] = f"{np.median(values):.4g}"
    return line


def _zhuang(rows: pd.DataFrame) -> str:
    """Return the text about published false minima of Zhuang's method."""
    is_simulated = rows["dataset"].isin(SIMULATED)
    simulated = rows[(rows["method"] == "zhuang") & is_simulated]
    wrong = simulated[simulated["published_e_aR"] > _WRONG_DEG]
    noise_free = wrong[wrong["level"] == 0.0]
    runs = ", ".join(sorted(set(noise_free["run"])))
    n_unconverged = (~simulated["converged"].astype(bool)).sum()
    return (
        f"The published answer is more than {_WRONG_DEG:.0f} deg wrong in "
        f"{percent(len(wrong), len(simulated))} simulated rows. {len(noise_free)} of these rows "
        f"have no noise ({runs}). Zhuang's parameters, the axis times the "
        "tangent of half the angle, grow without bound near 180 deg. Our iteration does the same "
        f"steps, and has not converged in {n_unconverged} rows."
    )
