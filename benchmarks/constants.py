"""``python -m benchmarks.constants --data-folder DATA``: effect of the estimator's constants.

Each constant is halved and doubled. The errors are measured on new recordings of random platforms,
with poses and with positions alone, and on short real recordings. ``constants.csv`` was made with
seed 45343421.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.extras.partial import positions
from hand_eye_calib.extras.partial.position_tuning import (
    TUNING,
    PositionTuning,
)
from reproduction.ablation import Case, outcome, real_cases, simulated_cases
from reproduction.writing import seed_of, study_parser, write_csv

# Families of real recordings; one recording of each is used.
_FAMILIES = ("kitti", "zxl19")
# Recordings with more poses are not used.
_MOST_POSES = 1450


def chosen(folder: Path | None, seed: int) -> list[Case]:
    """Return a recording of every platform and of some real families."""
    real = [case for case in real_cases(folder) if case.family in _FAMILIES]
    first: dict[str, Case] = {}
    for case in (*simulated_cases(seed, 4), *real):
        if len(case.poses.stamps_ns) < _MOST_POSES:
            first.setdefault(case.family, case)
    return [*first.values()]


def changed(name: str, factor: float) -> PositionTuning:
    """Multiply a constant by a factor. Negative constants are logarithms, and are shifted."""
    value = getattr(TUNING, name)
    is_log = bool(np.min(value) < 0)

    def multiplied(number: float) -> float:
        if isinstance(number, int):
            return max(round(factor * number), min(number, 1))
        return float(number + np.log(factor)) if is_log else factor * number

    new_value: object
    if isinstance(value, tuple):
        new_value = tuple(multiplied(number) for number in value)
    else:
        new_value = multiplied(value)
    return dataclasses.replace(TUNING, **{name: new_value})


def measured(
    cases: Sequence[Case], tuning: PositionTuning = TUNING
) -> FloatArray:
    """Return errors of translation and rotation, and the mean squared error in sigmas (N, 3).

    A simulated recording has a second row, for the positions of its child alone.
    """
    rows = []
    for case in cases:
        result = outcome(case, {"tuning": tuning})
        row = [np.nan] * 3
        if result is not None:
            row = [*result.errors, np.mean(result.in_sigmas**2)]
        rows.append(row)
        is_simulated = not case.sigmas.any()
        if is_simulated:
            poses = case.poses
            child_positions = poses.Ts_cw_c[:, :3, 3]
            fit = positions.solve(
                poses.stamps_ns, poses.Ts_pw_p, child_positions, tuning=tuning
            )
            error = fit.lever_arm - case.T_parent_child[:3, 3]
            nees = float(error @ np.linalg.solve(fit.covariance, error))
            rows.append([float(np.linalg.norm(error)), np.nan, nees / 3.0])
    return np.array(rows)


def main() -> None:
    """Draw recordings, solve them with all constants, and write ``constants.csv``."""
    parser = study_parser("benchmarks.constants", __doc__)
    parser.add_argument(
        "--seed", type=int, help="default: a random seed at every run"
    )
    arguments = parser.parse_args()
    cases = chosen(arguments.data_folder, seed_of(arguments.seed))
    usual = measured(cases)
    rows = []
    for field in dataclasses.fields(TUNING)[1:]:
        row: dict[str, object] = {
            "constant": field.name,
            "value": getattr(TUNING, field.name),
        }
        largest = 0.0
        for title, factor in (("halved", 0.5), ("doubled", 2.0)):
            ratios = measured(cases, changed(field.name, factor)) / usual
            logs = np.log(ratios)
            row[f"{title}: error"] = f"{np.exp(np.nanmean(logs[:, :2])):.3f}"
            row[f"{title}: NEES"] = f"{np.exp(np.nanmean(logs[:, 2])):.3f}"
            largest = max(largest, float(np.nanmax(np.abs(np.expm1(logs)))))
        rows.append(row | {"largest change of one": f"{largest:.3f}"})
    write_csv(Path(__file__).with_suffix(".csv"), rows)


if __name__ == "__main__":
    main()
