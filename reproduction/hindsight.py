"""``python -m reproduction adaptive``: the adaptive estimator and ``reference: auto`` against the
best choice with hindsight.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import norm

from hand_eye_calib.assessment import metrics
from hand_eye_calib.assessment.covariance import assess_adaptive
from hand_eye_calib.assessment.metrics import Errors
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


@dataclass(frozen=True)
class LevelStudy:
    """Medians over the runs of one level; errors in m and deg."""

    dataset: str
    level: float | None
    # Of the adaptive estimator.
    e_at: float
    e_aR: float
    # The smallest published median of any method and reference, and whose it is.
    best_e_at: str
    best_e_aR: str
    # Normalised squared error (6 degrees of freedom) under the stated covariance.
    nees: float
    # Share of the errors, component by component, within the stated 90 % interval.
    coverage: float
    # How often which systematic error was chosen.
    systematic: str
    # Of DNLO with the reference chosen for each run, and with the best single one for all.
    auto_e_at: float
    fixed_e_at: float
    fixed: str

    @property
    def ratio(self) -> str:
        """Of the errors of DNLO, chosen over best."""
        return f"{self.auto_e_at / self.fixed_e_at:.2f}"


def write(name: str, results: Results) -> list[Path]:
    """Study every level and write ``NAME.md`` and ``NAME.csv``; returns their paths."""
    tasks = [(results.source, dataset, level) for dataset in SIMULATED for level in LEVELS[dataset]]
    studies = in_parallel(study_level, tasks, results.jobs)
    with_noise = [study for study in studies if study.level != 0]
    return [
        write_text(
            results.out / f"{name}.md",
            "# The adaptive estimator and reference auto against hindsight",
            f"Medians over {results.n_runs} trajectories. The best published result is the "
            "smallest of the 36 medians of method and reference at that level, chosen with "
            "knowledge of the truth. NEES: 5.35 is expected.",
            markdown_table(map(_of_estimator, with_noise), _TITLES),
            "DNLO with the reference chosen by auto, against the one reference of "
            f"{', '.join(CANDIDATES)} with the smallest median, also chosen with knowledge of the "
            "truth; levels with errors below 0.01 mm left out:",
            markdown_table(
                {**_level(study), **_of_auto(study)}
                for study in with_noise
                if max(study.auto_e_at, study.fixed_e_at) >= _ROUNDING_M
            ),
        ),
        write_csv(
            results.out / f"{name}.csv",
            (
                _of_estimator(study)
                | {"systematic error chosen": study.systematic}
                | _of_auto(study)
                for study in studies
            ),
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
    counts = {nuisance: nuisances.count(nuisance) for nuisance in sorted(set(nuisances))}
    return LevelStudy(
        dataset,
        level,
        float(e_at),
        float(np.degrees(e_aR)),
        _best_published(cases, lambda result: result.e_at),
        _best_published(cases, lambda result: np.degrees(result.e_aR)),
        float(np.median(squared_errors)),
        float(np.mean(covered)),
        ", ".join(f"{nuisance} {count}" for nuisance, count in counts.items()),
        float(np.median(auto)),
        float(of_fixed.min()),
        CANDIDATES[int(of_fixed.argmin())],
    )


def _dnlo_error(poses: PosePairs, case: Case, reference: str) -> float:
    solution = Method("dnlo").solve(motion_pairs(poses.Ts_pw_p, poses.Ts_cw_c, reference))
    return metrics.absolute_errors(solution.T_parent_child, case.T_parent_child)[0]


def _best_published(cases: Sequence[Case], error: Callable[[Errors], float]) -> str:
    if not cases[0].results:
        return ""
    medians = {
        key: float(np.median([error(case.results[key].errors) for case in cases]))
        for key in cases[0].results
    }
    best = min(medians, key=lambda key: medians[key])
    return f"{medians[best]:.5f} ({' '.join(best)})"


_TITLES = (
    "set | level | translation (m) | best published | rotation (deg) | best published | median NEES"
    " | 90 % interval covers"
)


def _level(study: LevelStudy) -> dict[str, str]:
    return {"set": study.dataset, "level": "" if study.level is None else f"{study.level:g}"}


def _of_estimator(study: LevelStudy) -> dict[str, str]:
    return {
        **_level(study),
        "translation (m)": f"{study.e_at:.5f}",
        "best published translation": study.best_e_at,
        "rotation (deg)": f"{study.e_aR:.4f}",
        "best published rotation": study.best_e_aR,
        "median NEES": f"{study.nees:.2f}",
        "90 % interval covers": f"{study.coverage:.0%}",
    }


def _of_auto(study: LevelStudy) -> dict[str, str]:
    """Of the choice of a reference; empty if both errors are rounding: no ratio has a meaning."""
    is_rounding = max(study.auto_e_at, study.fixed_e_at) < _ROUNDING_M
    best = f"{study.fixed_e_at:.5f} ({study.fixed})"
    return {
        "auto: translation (m)": "" if is_rounding else f"{study.auto_e_at:.5f}",
        "best fixed reference": "" if is_rounding else best,
        "ratio": "" if is_rounding else study.ratio,
    }
