"""What our run shows about the published results: agreement, false minima, Ali, DNLO, the KITTI
ground truth.
"""

from pathlib import Path

import numpy as np
import pandas as pd
from scipy.optimize import minimize_scalar

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.solvers.registry import Method
from hand_eye_calib.solvers.solution import Solution
from reproduction import comparison
from reproduction.published import KITTI, LEVELS, RECTIFIED, REFERENCES, SIMULATED, Case
from reproduction.results import Results, Table
from reproduction.rows import ALI_AS_PUBLISHED, TITLES
from reproduction.sources import Source
from reproduction.writing import markdown_table, percent, triple, write_text

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
            "## Ground truth of the KITTI drives",
            _truths(results.source),
            "## Scale of the long drive",
            _scale(results.source.cases("kitti_long", None)[0]),
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
                for values in [table.values(dataset, level, method, reference, metric)]
            }
            for reference in REFERENCES
        ]
        where = "mixture" if level is None else f"{dataset} at {level:g}"
        blocks.append(f"Medians, {where}.\n\n{markdown_table(lines)}")
    return "\n\n".join(blocks)


def _zhuang(rows: pd.DataFrame) -> str:
    chosen = rows[(rows["method"] == "zhuang") & rows["dataset"].isin(SIMULATED)]
    wrong = chosen[chosen["published_e_aR"] > _WRONG_DEG]
    free = wrong[wrong["level"] == 0.0]
    return (
        f"The published answer is more than {_WRONG_DEG:.0f} deg wrong in "
        f"{percent(len(wrong), len(chosen))} simulated rows, {len(free)} of them without any noise "
        f"({', '.join(sorted(set(free['run'])))}). Zhuang's parameters, the axis times the "
        "tangent of half the angle, grow without bound near 180 deg. Our iteration does the same "
        f"steps, and has not converged in {(~chosen['converged'].astype(bool)).sum()} rows."
    )


def _truths(source: Source) -> str:
    lines = []
    for dataset in KITTI:
        (case,) = source.cases(dataset, None)
        published, rectified = case.T_parent_child, RECTIFIED[dataset]
        lines.append(
            {
                "drive": dataset,
                "published t (m)": f"({triple(published[:3, 3], form='.4f')})",
                "rectified t (m)": f"({triple(rectified[:3, 3], form='.4f')})",
                "apart (m)": f"{_distance(published, rectified):.3f}",
                "apart (deg)": f"{_angle_deg(published[:3, :3], rectified[:3, :3]):.3f}",
            }
        )
    return markdown_table(lines)


def _angle_deg(first: FloatArray, second: FloatArray) -> float:
    return float(np.degrees(se3.rotation_angle(first.T @ second)))


def _distance(first: FloatArray, second: FloatArray) -> float:
    return float(np.linalg.norm(first[:3, 3] - second[:3, 3]))


def _scale(case: Case) -> str:
    """Calibration of the long drive with the child's lengths scaled for the smallest objective."""
    lines = []
    for method in ("dnl", "dnlo"):
        scaled = minimize_scalar(
            lambda scale, name: _solve_scaled(case, name, scale).objective,
            args=(method,),
            bounds=(0.9, 1.1),
            method="bounded",
            options={"xatol": 1e-5},
        )
        for scale in (1.0, float(scaled.x)):
            T = _solve_scaled(case, method, scale).T_parent_child
            lines.append(
                {
                    "method": f"{TITLES[method]} B5",
                    "scale": f"{scale:.4f}",
                    "e_at (m)": f"{_distance(T, case.T_parent_child):.3f}",
                    "rectified: e_at (m)": f"{_distance(T, RECTIFIED['kitti_long']):.3f}",
                }
            )
    about = "With the child's lengths as they are, and times the scale of the smallest objective:"
    return f"{about}\n\n{markdown_table(lines)}"


def _solve_scaled(case: Case, method: str, scale: float) -> Solution:
    child = case.child.scaled(scale).poses
    return Method(method).solve(motion_pairs(case.parent.poses, child, "B5"))
