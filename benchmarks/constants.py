"""``python -m benchmarks.constants --data-folder DATA``: what every constant of the adaptive search
does, halved and doubled, on random platforms that are drawn anew, by poses and by positions alone,
and on short real recordings. ``constants.csv`` is of seed 45343421.
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

# One recording of each family, none longer than this.
_FAMILIES = ("kitti", "zxl19")
_MOST_POSES = 1450


def chosen(folder: Path | None, seed: int) -> list[Case]:
    """One recording of every platform and of some real families."""
    real = [case for case in real_cases(folder) if case.family in _FAMILIES]
    first: dict[str, Case] = {}
    for case in (*simulated_cases(seed, 4), *real):
        if len(case.poses.stamps_ns) < _MOST_POSES:
            first.setdefault(case.family, case)
    return [*first.values()]


def changed(name: str, factor: float) -> PositionTuning:
    """Multiply a constant by a factor; logarithms of variances are shifted instead."""
    value = getattr(TUNING, name)
    is_log = bool(np.min(value) < 0)

    def multiplied(number: float) -> float:
        if isinstance(number, int):
            return max(round(factor * number), min(number, 1))
        return float(number + np.log(factor)) if is_log else factor * number

    new_value = (
        tuple(map(multiplied, value))
        if isinstance(value, tuple)
        else multiplied(value)
    )
    return dataclasses.replace(TUNING, **{name: new_value})


def measured(
    cases: Sequence[Case], tuning: PositionTuning = TUNING
) -> FloatArray:
    """Errors of translation and rotation, and squared errors over their variances (N, 3)."""
    rows = []
    for case in cases:
        found = outcome(case, {"tuning": tuning})
        rows.append(
            [np.nan] * 3
            if found is None
            else [*found.errors, np.mean(found.in_sigmas**2)]
        )
        if not case.sigmas.any():
            poses = case.poses
            measured_m = poses.Ts_cw_c[:, :3, 3]
            lever = positions.solve(
                poses.stamps_ns, poses.Ts_pw_p, measured_m, tuning=tuning
            )
            off = lever.lever_arm - case.T_parent_child[:3, 3]
            square = float(off @ np.linalg.solve(lever.covariance, off)) / 3.0
            rows.append([float(np.linalg.norm(off)), np.nan, square])
    return np.array(rows)


def main() -> None:
    """Draw, solve and write ``constants.csv``."""
    parser = study_parser("benchmarks.constants", __doc__)
    parser.add_argument(
        "--seed", type=int, help="default: another one at every run"
    )
    arguments = parser.parse_args()
    cases = chosen(arguments.data_folder, seed_of(arguments.seed))
    whole = measured(cases)
    rows = []
    for field in dataclasses.fields(TUNING)[1:]:
        row: dict[str, object] = {
            "constant": field.name,
            "value": getattr(TUNING, field.name),
        }
        largest = 0.0
        for title, factor in (("halved", 0.5), ("doubled", 2.0)):
            logs = np.log(measured(cases, changed(field.name, factor)) / whole)
            row[f"{title}: error"] = f"{np.exp(np.nanmean(logs[:, :2])):.3f}"
            row[f"{title}: NEES"] = f"{np.exp(np.nanmean(logs[:, 2])):.3f}"
            largest = max(largest, float(np.nanmax(np.abs(np.expm1(logs)))))
        rows.append(row | {"largest change of one": f"{largest:.3f}"})
    write_csv(Path(__file__).with_suffix(".csv"), rows)


if __name__ == "__main__":
    main()
