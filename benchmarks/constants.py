"""``python -m benchmarks.constants --data-folder DATA``: what every constant of the adaptive search
does, halved and doubled, on random platforms that are drawn anew, by poses and by positions alone,
and on short real recordings. ``constants.csv`` is of seed 45343421.
"""

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.noise.tuning import TUNING
from hand_eye_calib.extras.partial import positions
from reproduction.ablation import Case, outcome, real_cases, simulated_cases
from reproduction.writing import seed_of, study_parser, write_csv

# Of the constants above zero, those that are logarithms of variances.
_LOGARITHMS = ("highest_level", "any_rotation")

# One recording of each family, none longer than this.
_FAMILIES, _MOST_POSES = ("kitti", "zxl19"), 1450


def chosen(folder: Path | None, seed: int) -> list[Case]:
    """One recording of every platform and of some real families."""
    real = [case for case in real_cases(folder) if case.family in _FAMILIES]
    first: dict[str, Case] = {}
    for case in (*simulated_cases(seed, 4), *real):
        if len(case.poses.stamps_ns) < _MOST_POSES:
            first.setdefault(case.family, case)
    return [*first.values()]


@contextlib.contextmanager
def changed(name: str, factor: float) -> Iterator[None]:
    """A constant times a factor, wherever it is read."""
    before = getattr(TUNING, name)
    is_log = np.min(before) < 0 or name in _LOGARITHMS

    def one(value: float) -> float:
        if isinstance(value, int):
            return max(round(factor * value), min(value, 1))
        return float(value + np.log(factor)) if is_log else factor * value

    is_tuple = isinstance(before, tuple)
    object.__setattr__(TUNING, name, tuple(map(one, before)) if is_tuple else one(before))
    try:
        yield
    finally:
        object.__setattr__(TUNING, name, before)


def measured(cases: Sequence[Case]) -> FloatArray:
    """Errors of translation and rotation, and squared errors over their variances (N, 3)."""
    rows = []
    for case in cases:
        found = outcome(case, {})
        rows.append([np.nan] * 3 if found is None else [*found.errors, np.mean(found.in_sigmas**2)])
        if not case.sigmas.any():
            poses = case.poses
            lever = positions.solve(poses.stamps_ns, poses.Ts_pw_p, poses.Ts_cw_c[:, :3, 3])
            off = lever.lever_arm - case.T_parent_child[:3, 3]
            square = float(off @ np.linalg.solve(lever.covariance, off)) / 3.0
            rows.append([float(np.linalg.norm(off)), np.nan, square])
    return np.array(rows)


def main() -> None:
    """Draw, solve and write ``constants.csv``."""
    parser = study_parser("benchmarks.constants", __doc__)
    parser.add_argument("--seed", type=int, help="default: another one at every run")
    arguments = parser.parse_args()
    cases = chosen(arguments.data_folder, seed_of(arguments.seed))
    whole, rows = measured(cases), []
    for field in dataclasses.fields(TUNING)[1:]:
        row: dict[str, object] = {"constant": field.name, "value": getattr(TUNING, field.name)}
        largest = 0.0
        for title, factor in (("halved", 0.5), ("doubled", 2.0)):
            with changed(field.name, factor):
                logs = np.log(measured(cases) / whole)
            row[f"{title}: error"] = f"{np.exp(np.nanmean(logs[:, :2])):.3f}"
            row[f"{title}: NEES"] = f"{np.exp(np.nanmean(logs[:, 2])):.3f}"
            largest = max(largest, float(np.nanmax(np.abs(np.expm1(logs)))))
        rows.append(row | {"largest change of one": f"{largest:.3f}"})
    write_csv(Path(__file__).with_suffix(".csv"), rows)


if __name__ == "__main__":
    main()
