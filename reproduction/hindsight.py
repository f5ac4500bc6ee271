"""``python -m reproduction adaptive``: the adaptive estimator and ``reference: auto`` against the
best choice with hindsight.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import norm

from hand_eye_calib.assessment.covariance import assess_adaptive
from hand_eye_calib.assessment.metrics import absolute_errors
from hand_eye_calib.assessment.reference_selection import CANDIDATES, select_reference
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls import estimator
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.solvers.registry import Method
from reproduction.published import LEVELS, SIMULATED, Case
from reproduction.results import Results
from reproduction.runner import in_parallel
from reproduction.sources import Source
from reproduction.writing import markdown_table, write_csv, write_text

_COVERAGE = 0.90
_ROUNDING_M = 1e-5


def write(name: str, results: Results) -> list[Path]:
    """Study every level and write ``NAME.md`` and ``NAME.csv``; returns their paths."""
    levels = [
        (dataset, level)
        for dataset in SIMULATED
        for level in (LEVELS[dataset][1::2] or LEVELS[dataset])
    ]
    tasks = [(results.source, *level) for level in levels]
    rows = [
        {"set": dataset, "level": "" if level is None else f"{level:g}", **medians}
        for (dataset, level), medians in zip(
            levels, in_parallel(study_level, tasks, results.jobs), strict=True
        )
    ]
    by_auto = (
        row
        for row in rows
        if max(row["auto: translation (m)"], row["best fixed (m)"]) >= _ROUNDING_M
    )
    return [
        write_text(
            results.out / f"{name}.md",
            "# The adaptive estimator and reference auto against hindsight",
            f"Medians over {results.n_runs} trajectories. The best published result is the "
            "smallest of the 36 medians of method and reference at that level, chosen with "
            "knowledge of the truth. NEES: 5.35 is expected.",
            markdown_table(_printed(row, _OF_ESTIMATOR) for row in rows),
            "DNLO with the reference chosen by auto, against the one reference of "
            f"{', '.join(CANDIDATES)} with the smallest median, also chosen with knowledge of the "
            "truth; levels with errors below 0.01 mm left out:",
            markdown_table(_printed(row, _OF_AUTO) for row in by_auto),
        ),
        write_csv(results.out / f"{name}.csv", rows),
    ]


# Columns of both tables, and how their numbers are printed.
_OF_ESTIMATOR = {
    "translation (m)": ".5f",
    "best published": "",
    "rotation (deg)": ".4f",
    "best published rotation": "",
    "median NEES": ".2f",
    "90 % interval covers": ".0%",
}
_OF_AUTO = {"auto: translation (m)": ".5f", "best fixed (m)": ".5f", "which": "", "ratio": ".2f"}


def _printed(row: dict[str, Any], forms: dict[str, str]) -> dict[str, str]:
    start = {name: row[name] for name in ("set", "level")}
    return start | {name: f"{row[name]:{form}}" for name, form in forms.items()}


def study_level(source: Source, dataset: str, level: float | None) -> dict[str, Any]:
    """Medians over the cases of a data set at a level."""
    cases = source.cases(dataset, level)
    runs = pd.DataFrame(_study(case) for case in cases)
    medians = runs.median(numeric_only=True)
    best = medians[list(CANDIDATES)].idxmin()
    auto, fixed = medians["auto"], medians[best]
    return {
        "translation (m)": medians["e_at"],
        "best published": _best_published(cases, "e_at"),
        "rotation (deg)": medians["e_aR"],
        "best published rotation": _best_published(cases, "e_aR"),
        "median NEES": medians["nees"],
        "90 % interval covers": runs["covered"].mean(),
        "systematic error chosen": ", ".join(
            f"{each} {count}" for each, count in runs["systematic"].value_counts().items()
        ),
        "auto: translation (m)": auto,
        "best fixed (m)": fixed,
        "which": best,
        "ratio": auto / fixed if fixed else np.nan,
    }


def _study(case: Case) -> dict[str, Any]:
    """Errors (m, deg) of the adaptive estimator, its squared error under the stated covariance, the
    share of components in their intervals, and the errors of DNLO with every reference.
    """
    poses = PosePairs(case.parent.stamps_ns, case.parent.poses, case.child.poses)
    solution = estimator.solve(poses.stamps_ns, poses.Ts_pw_p, poses.Ts_cw_c)
    covariance = assess_adaptive(poses, solution).cov_parent_child_in_child
    xi = se3.log(se3.inverse(solution.T_parent_child) @ case.T_parent_child)
    e_at, e_aR = absolute_errors(solution.T_parent_child, case.T_parent_child)
    reach = norm.isf((1 - _COVERAGE) / 2) * np.sqrt(np.diag(covariance))
    dnlo = {reference: _dnlo_error(poses, case, reference) for reference in CANDIDATES}
    return {
        "e_at": e_at,
        "e_aR": np.degrees(e_aR),
        "nees": xi @ np.linalg.solve(covariance, xi),
        "covered": np.mean(np.abs(xi) < reach),
        "systematic": solution.systematic,
        "auto": dnlo[select_reference(poses, Method("dnlo")).reference],
        **dnlo,
    }


def _dnlo_error(poses: PosePairs, case: Case, reference: str) -> float:
    solution = Method("dnlo").solve(motion_pairs(poses.Ts_pw_p, poses.Ts_cw_c, reference))
    return absolute_errors(solution.T_parent_child, case.T_parent_child)[0]


def _best_published(cases: Sequence[Case], metric: str) -> str:
    """The smallest published median, m or deg, with its method and reference."""
    if not cases[0].results:
        return ""
    unit = 1.0 if metric == "e_at" else 180.0 / np.pi
    medians = {
        key: unit * np.median([getattr(case.results[key].errors, metric) for case in cases])
        for key in cases[0].results
    }
    best = min(medians, key=lambda key: medians[key])
    return f"{medians[best]:.5f} ({' '.join(best)})"
