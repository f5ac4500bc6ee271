"""What our run shows about the published results: agreement, false minima, Ali, DNLO."""

from pathlib import Path

import numpy as np
import pandas as pd

from reproduction import comparison
from reproduction.published import KITTI, LEVELS, REFERENCES, SIMULATED
from reproduction.results import Results, Table
from reproduction.rows import ALI_AS_PUBLISHED
from reproduction.writing import markdown_table, percent, write_text

_WRONG_DEG = 90.0


def write(name: str, results: Results) -> list[Path]:
    """Write ``NAME.md`` and rows.csv; returns the paths."""
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
    methods = {"published": ALI_AS_PUBLISHED, "proper": "ali", "DNL": "dnl"}
    blocks = []
    for dataset in SIMULATED:
        level = LEVELS[dataset][-1]
        lines = [
            {"reference": reference}
            | {
                f"{metric}, {title}": f"{np.median(values):.4g}"
                for metric in ("e_at", "e_aR")
                for title, method in methods.items()
                for values in [
                    table.values(dataset, level, method, reference, metric)
                ]
            }
            for reference in REFERENCES
        ]
        where = "mixture" if level is None else f"{dataset} at {level:g}"
        blocks.append(f"Medians, {where}.\n\n{markdown_table(lines)}")
    return "\n\n".join(blocks)


def _zhuang(rows: pd.DataFrame) -> str:
    chosen = rows[
        (rows["method"] == "zhuang") & rows["dataset"].isin(SIMULATED)
    ]
    wrong = chosen[chosen["published_e_aR"] > _WRONG_DEG]
    free = wrong[wrong["level"] == 0.0]
    return (
        f"The published answer is more than {_WRONG_DEG:.0f} deg wrong in "
        f"{percent(len(wrong), len(chosen))} simulated rows, {len(free)} of them without any noise "
        f"({', '.join(sorted(set(free['run'])))}). Zhuang's parameters, the axis times the "
        "tangent of half the angle, grow without bound near 180 deg. Our iteration does the same "
        f"steps, and has not converged in {(~chosen['converged'].astype(bool)).sum()} rows."
    )
