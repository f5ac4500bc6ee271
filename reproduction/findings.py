"""What our run shows about the published results: agreement, false minima, Ali, DNLO, the KITTI
ground truth.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize_scalar

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.solvers.registry import Method
from hand_eye_calib.solvers.solution import Solution
from reproduction import comparison
from reproduction.kitti_truth import RECTIFIED
from reproduction.published import KITTI, LEVELS, REFERENCES, SIMULATED, Case
from reproduction.rows import ALI_AS_PUBLISHED, TITLES, Row, agree
from reproduction.statistics import Table
from reproduction.writing import markdown_table, percent, write_text

if TYPE_CHECKING:
    from reproduction.results import Results
    from reproduction.sources import Source

_WRONG_DEG = 90.0


def write(name: str, results: Results) -> list[Path]:
    """Write ``NAME.md`` and rows.csv; returns the paths."""
    return [
        write_text(
            results.out / f"{name}.md",
            "# What the run says about the published results",
            "## Row by row",
            _agreement(results.rows),
            comparison.describe_rows(
                [row for row in results.rows if row.method != "ali" or row.dataset in KITTI]
            ),
            "## DNLO",
            comparison.describe_dnlo(results.rows),
            _dnlo_by_dataset(results.rows),
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


def _agreement(rows: Sequence[Row]) -> str:
    """The share of rows that agree, of the four methods with one answer and of Ali."""
    lines = []
    for title, methods in (
        ("Park, Taylor, Zhuang, DNL", ("park", "taylor", "zhuang", "dnl")),
        ("Ali", (ALI_AS_PUBLISHED, "ali")),
    ):
        chosen = [
            row
            for row in rows
            if row.method in methods and not (row.method == "ali" and row.dataset in SIMULATED)
        ]
        lines.append(
            f"{title}: {percent(sum(row.agrees for row in chosen), len(chosen))} of the "
            "published rows are reproduced."
        )
    return "\n".join(lines)


def _dnlo_by_dataset(rows: Sequence[Row]) -> str:
    lines = []
    for dataset in (*SIMULATED, *KITTI):
        chosen = [row for row in rows if (row.dataset, row.method) == (dataset, "dnlo")]
        verdicts = [row.objective_verdict for row in chosen]
        same = sum(agree(row.errors[2], row.theirs[2]) for row in chosen)
        counts = [verdicts.count(verdict) for verdict in ("lower", "equal", "higher")]
        medians = [
            f"{np.median([getattr(row, name)[2] for row in chosen]):.4f}"
            for name in ("errors", "published")
        ]
        lines.append([dataset, len(chosen), *counts, percent(same, len(chosen)), *medians])
    header = [
        "data set",
        "rows",
        "objective lower",
        "equal",
        "higher",
        "e_at agrees",
        "median e_at (m)",
        "published (m)",
    ]
    return markdown_table(header, lines)


def _ali(table: Table) -> str:
    blocks = []
    for dataset in SIMULATED:
        level = LEVELS[dataset][-1]
        lines = []
        for reference in REFERENCES:
            line = [reference]
            for metric in ("e_at", "e_aR"):
                values = [
                    np.median(table.values(dataset, level, method, reference, metric))
                    for method in (ALI_AS_PUBLISHED, "ali", "dnl")
                ]
                line += [f"{value:.4g}" for value in values]
            lines.append(line)
        header = [
            "reference",
            "e_at (m): published",
            "proper",
            "DNL",
            "e_aR (deg): published",
            "proper",
            "DNL",
        ]
        where = "mixture" if level is None else f"{dataset} at {level:g}"
        best = {
            method: table.best_reference(dataset, method) for method in (ALI_AS_PUBLISHED, "ali")
        }
        choice = (
            f"Best variant over all levels: {best[ALI_AS_PUBLISHED]} as published, "
            f"{best['ali']} properly."
        )
        blocks.append(f"Medians, {where}. {choice}\n\n{markdown_table(header, lines)}")
    return "\n\n".join(blocks)


def _zhuang(rows: Sequence[Row]) -> str:
    chosen = [row for row in rows if row.method == "zhuang" and row.dataset in SIMULATED]
    unsettled = sum(not row.converged for row in chosen)
    free = [row for row in chosen if row.level == 0.0 and row.theirs[3] > _WRONG_DEG]
    runs = sorted({row.run for row in free})
    wrong = sum(row.theirs[3] > _WRONG_DEG for row in chosen)
    angles = sorted(
        {
            round(_angle_deg(np.eye(3), row.transform[:3, :3]), 1)
            for row in rows
            if row.run in runs and row.method == "dnl" and row.level == 0.0
        }
    )
    return (
        f"The published answer is more than {_WRONG_DEG:.0f} deg wrong in "
        f"{percent(wrong, len(chosen))} simulated rows, {len(free)} of them without any noise: "
        f"{', '.join(runs) or 'none'}, whose extrinsic is a turn by {', '.join(map(str, angles))} "
        "deg. Zhuang's parameters, the axis times the tangent of half the angle, grow without "
        "bound near 180 deg. Our iteration does the same steps and says so: it has not converged "
        f"in {unsettled} rows."
    )


def _truths(source: Source) -> str:
    lines = []
    for dataset in KITTI:
        (case,) = source.cases(dataset, None)
        published, rectified = case.T_parent_child, RECTIFIED[dataset]
        angle = _angle_deg(published[:3, :3], rectified[:3, :3])
        lines.append(
            [
                dataset,
                _vector(published[:3, 3]),
                _vector(rectified[:3, 3]),
                f"{np.linalg.norm(published[:3, 3] - rectified[:3, 3]):.3f}",
                f"{angle:.3f}",
            ]
        )
    header = ["drive", "published t (m)", "rectified t (m)", "apart (m)", "apart (deg)"]
    return markdown_table(header, lines)


def _angle_deg(first: FloatArray, second: FloatArray) -> float:
    return float(np.degrees(se3.rotation_angle(first.T @ second)))


def _vector(values: Iterable[float]) -> str:
    return "(" + ", ".join(f"{value:.4f}" for value in values) + ")"


def _scale(case: Case) -> str:
    """Calibration of the long drive with the child's lengths scaled for the smallest objective."""
    lines = []
    for method in ("dnl", "dnlo"):
        for reference in ("B5", "B10"):
            scaled = minimize_scalar(
                lambda scale, method=method, reference=reference: (
                    _solve_scaled(case, method, reference, scale).objective
                ),
                bounds=(0.9, 1.1),
                method="bounded",
                options={"xatol": 1e-5},
            )
            line = [f"{TITLES[method]} {reference}"]
            for scale in (1.0, float(scaled.x)):
                T = _solve_scaled(case, method, reference, scale).T_parent_child
                e_at = np.linalg.norm(T[:3, 3] - case.T_parent_child[:3, 3])
                lines_rectified = np.linalg.norm(T[:3, 3] - RECTIFIED["kitti_long"][:3, 3])
                line += [f"{scale:.4f}", f"{e_at:.3f}", f"{lines_rectified:.3f}"]
            lines.append(line)
    header = [
        "method",
        "scale",
        "e_at (m)",
        "rectified: e_at (m)",
        "scale estimated",
        "e_at (m)",
        "rectified: e_at (m)",
    ]
    return (
        "The child's lengths times the scale that gives the smallest objective:\n\n"
        + markdown_table(header, lines)
    )


def _solve_scaled(case: Case, method: str, reference: str, scale: float) -> Solution:
    poses = case.child.poses.copy()
    poses[:, :3, 3] *= scale
    return Method(method).solve(motion_pairs(case.parent.poses, poses, reference))
