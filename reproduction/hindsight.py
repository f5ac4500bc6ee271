"""``python -m reproduction adaptive``: the adaptive estimator and ``reference: auto`` against the
best choice with hindsight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import norm

from hand_eye_calib.adaptive import estimator
from hand_eye_calib.assessment import metrics
from hand_eye_calib.assessment.covariance import assess_adaptive
from hand_eye_calib.assessment.metrics import Errors
from hand_eye_calib.assessment.reference_selection import CANDIDATES, select_reference
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.solvers.registry import Method
from reproduction.published import LEVELS, SIMULATED, Case
from reproduction.runner import in_parallel
from reproduction.writing import markdown_table, write_csv, write_text

if TYPE_CHECKING:
    from reproduction.results import Results
    from reproduction.sources import Source

_COVERAGE = 0.90
_ROUNDING_M = 1e-5


@dataclass(frozen=True)
class LevelStudy:
    """Medians over the runs of one level.

    Attributes
    ----------
    dataset, level
    e_at, e_aR : float
        Of the adaptive estimator, m and deg.
    best_e_at, best_e_aR : (float, str)
        The smallest published median of any method and reference, and whose it is; None without
        published results.
    nees : float
        Normalised squared error (6 degrees of freedom) under the stated covariance.
    coverage : float
        Share of the errors, component by component, within the stated 90 % interval.
    nuisances : dict
        How often which systematic error was chosen.
    auto_e_at : float
        Of DNLO with the reference chosen for each run.
    fixed_e_at : (float, str)
        Of DNLO with the best single reference for all runs.
    """

    dataset: str
    level: float | None
    e_at: float
    e_aR: float
    best_e_at: tuple[float, str] | None
    best_e_aR: tuple[float, str] | None
    nees: float
    coverage: float
    nuisances: dict[str, int]
    auto_e_at: float
    fixed_e_at: tuple[float, str]


def write(name: str, results: Results) -> list[Path]:
    """Study every level and write ``NAME.md`` and ``NAME.csv``; returns their paths."""
    tasks = [
        (results.source, dataset, level)
        for dataset in SIMULATED
        for level in LEVELS.get(dataset, (None,))
    ]
    studies = in_parallel(study_level, tasks, results.jobs)
    with_noise = [study for study in studies if study.level != 0]
    return [
        write_csv(results.out / f"{name}.csv", _COLUMNS, [_cells(study) for study in studies]),
        write_text(
            results.out / f"{name}.md",
            "# The adaptive estimator and reference auto against hindsight",
            f"Medians over {results.n_runs} trajectories. The best published result is the "
            "smallest of the 36 medians of method and reference at that level, chosen with "
            "knowledge of the truth. NEES: 5.35 is expected.",
            markdown_table(_ESTIMATOR_COLUMNS, map(_estimator_cells, with_noise)),
            "DNLO with the reference chosen by auto, against the one reference of "
            f"{', '.join(CANDIDATES)} with the smallest median, also chosen with knowledge of the "
            "truth; levels with errors below 0.01 mm left out:",
            markdown_table(_AUTO_COLUMNS, filter(None, map(_auto_cells, with_noise))),
        ),
    ]


def study_level(source: Source, dataset: str, level: float | None) -> LevelStudy:
    """LevelStudy of the cases of a data set at a level."""
    cases = source.cases(dataset, level)
    errors, squared_errors, covered, nuisances = [], [], [], []
    auto, fixed = [], []
    for case in cases:
        poses = PosePairs(case.parent.stamps_ns, case.parent.poses, case.child.poses)
        solution = estimator.solve(poses.stamps_ns, poses.Ts_pw_p, poses.Ts_cw_c)
        covariance = assess_adaptive(poses, solution).cov_parent_child_in_child
        xi = se3.log(se3.inverse(solution.T_parent_child) @ case.T_parent_child)
        errors.append(metrics.absolute_errors(solution.T_parent_child, case.T_parent_child))
        squared_errors.append(xi @ np.linalg.solve(covariance, xi))
        covered.append(np.abs(xi) < norm.isf((1 - _COVERAGE) / 2) * np.sqrt(np.diag(covariance)))
        nuisances.append(solution.systematic)
        dnlo = {reference: _dnlo_error(poses, case, reference) for reference in CANDIDATES}
        fixed.append([dnlo[reference] for reference in CANDIDATES])
        auto.append(dnlo[select_reference(poses, Method("dnlo")).reference])
    e_at, e_aR = np.median(errors, axis=0)
    of_fixed = np.median(fixed, axis=0)
    return LevelStudy(
        dataset,
        level,
        float(e_at),
        float(np.degrees(e_aR)),
        _best_published(cases, lambda result: result.e_at),
        _best_published(cases, lambda result: np.degrees(result.e_aR)),
        float(np.median(squared_errors)),
        float(np.mean(covered)),
        {nuisance: nuisances.count(nuisance) for nuisance in sorted(set(nuisances))},
        float(np.median(auto)),
        (float(of_fixed.min()), CANDIDATES[int(of_fixed.argmin())]),
    )


def _dnlo_error(poses: PosePairs, case: Case, reference: str) -> float:
    solution = Method("dnlo").solve(motion_pairs(poses.Ts_pw_p, poses.Ts_cw_c, reference))
    return metrics.absolute_errors(solution.T_parent_child, case.T_parent_child)[0]


def _best_published(
    cases: Sequence[Case], error: Callable[[Errors], float]
) -> tuple[float, str] | None:
    if not cases[0].results:
        return None
    medians = {
        key: np.median([error(case.results[key].errors) for case in cases])
        for key in cases[0].results
    }
    method, reference = min(medians, key=lambda key: float(medians[key]))
    return float(medians[method, reference]), f"{method} {reference}"


_ESTIMATOR_COLUMNS = (
    "set",
    "level",
    "translation (m)",
    "best published",
    "rotation (deg)",
    "best published",
    "median NEES",
    "90 % interval covers",
)
_AUTO_COLUMNS = ("set", "level", "auto: translation (m)", "best fixed reference", "ratio")
_COLUMNS = (
    *_ESTIMATOR_COLUMNS,
    "systematic error chosen",
    *_AUTO_COLUMNS[2:],
)


def _estimator_cells(study: LevelStudy) -> list[str]:
    return [
        *_level(study),
        f"{study.e_at:.5f}",
        _best(study.best_e_at),
        f"{study.e_aR:.4f}",
        _best(study.best_e_aR),
        f"{study.nees:.2f}",
        f"{study.coverage:.0%}",
    ]


def _auto_cells(study: LevelStudy) -> list[str] | None:
    """Cells of a level; None if both errors are rounding, so that their ratio means nothing."""
    if max(study.auto_e_at, study.fixed_e_at[0]) < _ROUNDING_M:
        return None
    ratio = study.auto_e_at / study.fixed_e_at[0]
    return [*_level(study), f"{study.auto_e_at:.5f}", _best(study.fixed_e_at), f"{ratio:.2f}"]


def _cells(study: LevelStudy) -> list[str]:
    chosen = ", ".join(f"{name} {count}" for name, count in study.nuisances.items())
    return [
        *_estimator_cells(study),
        chosen,
        *(_auto_cells(study) or [*_level(study), "", "", ""])[2:],
    ]


def _level(study: LevelStudy) -> list[str]:
    return [study.dataset, "" if study.level is None else f"{study.level:g}"]


def _best(best: tuple[float, str] | None) -> str:
    return "" if best is None else f"{best[0]:.5f} ({best[1]})"
