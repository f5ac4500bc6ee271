"""``python -m reproduction.ablation``: what each part of the adaptive estimator gains, by families
of recordings: with each part switched off in turn, the error over that of the whole estimator.

The simulated platforms, their noise and their seeds are drawn anew at every run, so that nobody can
tune to them. A part earns its place if families that it was not made for are better with it.
"""

import dataclasses
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.alignment.similarity import settle_scale
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.core.noise import estimator
from hand_eye_calib.core.noise.tuning import TUNING
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from reproduction.coverage.mixed import MIXED, make
from reproduction.recordings import Rig, real_rigs
from reproduction.writing import markdown_table, seed_of, show, study_parser

# Families of rigs by the beginnings of their names; the others are families of their own.
_FAMILIES = ("kitti", "euroc", "zxl19", "tango")

# Errors (m, rad) below this are rounding: noise-free recordings tell nothing.
_ROUNDING = 1e-4

# A recording that a variant cannot solve counts as that many times as far off.
_FAILED = 3.0


def _with(**numbers: object) -> dict[str, Any]:
    """Other numbers of the search."""
    return {"tuning": dataclasses.replace(TUNING, **numbers)}  # type: ignore[arg-type]


# Options of ``estimator.solve`` that switch one part off.
VARIANTS: dict[str, dict[str, Any]] = {
    "outliers": {"without": ("outliers", "tails")},
    "heavy tails": {"without": ("tails",)},
    "time-correlated errors": {"without": ("time_correlated",)},
    "rotation about a world's origin": _with(centre_ratio=0.0),
    "systematic errors": {"systematic": ()},
    "bias": {"systematic": ("scale", "time")},
    "scale": {"systematic": ("bias", "time")},
    "time": {"systematic": ("scale", "bias")},
    "biases that X can be told from": _with(max_sigma_growth=1e6),
    "fewer poses of a target": _with(strides=()),
    "following X": _with(max_rounds=1),
    "all poses for the noise": _with(most_poses=10**6),
}


class Case(NamedTuple):
    """One recording, aligned: its truth and how well that is known (6,), infinite where not."""

    family: str
    poses: PosePairs
    is_clock_free: bool
    T_parent_child: FloatArray
    sigmas: FloatArray


def real_cases(folder: Path | None) -> Iterator[Case]:
    """Recordings with a known answer."""
    for rig in real_rigs(folder)[0] if folder else ():
        if rig.truth is None or rig.is_refused:
            continue
        for recording in rig.recordings.values():
            yield _real_case(rig, recording.parent, recording.child)


def _real_case(rig: Rig, parent: Any, child: Any) -> Case:
    assert rig.truth is not None
    options = {name: value for name, value in rig.options.items() if name != "prior"}
    snapshot = whole_snapshot(parent, child, options).resolved
    pairs = snapshot.pose_pairs
    pairs = pairs.child_scaled(settle_scale(pairs, snapshot.config.scale)[0])
    family = next((family for family in _FAMILIES if family in rig.name), rig.name)
    is_clock_free = snapshot.time_offset is not None
    return Case(
        family, pairs, is_clock_free, rig.truth.T_parent_child, rig.truth.sigmas
    )


def simulated_cases(seed: int, repeats: int) -> Iterator[Case]:
    """Random platforms: motion, rate, lever arm and noise drawn from the seed."""
    for name in MIXED:
        for number in range(repeats):
            drive = make(name, seed, number)
            pairs = PosePairs(
                drive.parent.stamps_ns, drive.parent.poses, drive.child.poses
            )
            yield Case(name, pairs, False, drive.T_parent_child, np.zeros(6))


class Outcome(NamedTuple):
    """Errors in m and rad, NaN where the truth is not known, and shares (6,) of sigma."""

    errors: FloatArray
    in_sigmas: FloatArray


def outcome(case: Case, options: dict[str, Any]) -> Outcome | None:
    """How far the estimator is off; None if it fails. Half of what the truth is not known to counts
    as an error of all variants.
    """
    poses = case.poses
    try:
        solution = estimator.solve(
            poses.stamps_ns,
            poses.Ts_pw_p,
            poses.Ts_cw_c,
            is_clock_free=case.is_clock_free,
            **options,
        )
    except (np.linalg.LinAlgError, ValueError):
        return None
    off = deviation(solution.T_parent_child, case.T_parent_child)
    to_parent = np.kron(np.eye(2), solution.T_parent_child[:3, :3])
    variances = np.diag(to_parent @ solution.cov_parent_child_in_child @ to_parent.T)
    is_determined = np.isfinite(case.sigmas)
    squares = np.where(
        is_determined,
        off**2 + 0.25 * np.where(is_determined, case.sigmas, 0.0) ** 2,
        0.0,
    )
    sizes = [
        np.sqrt(squares[axes].sum()) if is_determined[axes].any() else np.nan
        for axes in (slice(0, 3), slice(3, 6))
    ]
    in_sigmas = np.abs(off) / np.sqrt(
        variances + np.where(is_determined, case.sigmas, np.inf) ** 2
    )
    return Outcome(np.array(sizes), in_sigmas[is_determined])


def table(cases: Sequence[Case]) -> str:
    """A row for every variant: error over that of the whole estimator by family, translation and
    rotation; geometric mean over all families, and over all but the one it gains most in.
    """
    whole = [outcome(case, {}) for case in cases]
    rows = [_row("nothing", cases, whole, whole, 0.0)]
    for name, options in VARIANTS.items():
        started = time.process_time()
        outcomes = [outcome(case, options) for case in cases]
        rows.append(_row(name, cases, outcomes, whole, time.process_time() - started))
    return markdown_table(rows)


def _row(
    name: str,
    cases: Sequence[Case],
    outcomes: Sequence[Outcome | None],
    whole: Sequence[Outcome | None],
    seconds: float,
) -> dict[str, str]:
    logs: dict[str, list[FloatArray]] = {}
    inside = []
    for case, outcome_of_case, reference in zip(cases, outcomes, whole, strict=True):
        if reference is None or np.nanmax(reference.errors) < _ROUNDING:
            continue
        ratios = (
            np.full(2, _FAILED)
            if outcome_of_case is None
            else outcome_of_case.errors / reference.errors
        )
        logs.setdefault(case.family, []).append(np.log(np.maximum(ratios, 1e-3)))
        inside += (
            [] if outcome_of_case is None else [*(outcome_of_case.in_sigmas < 1.645)]
        )
    means = {
        family: np.mean(ratios_of_family, axis=0)
        for family, ratios_of_family in logs.items()
    }
    by_family = [float(np.nanmean(mean)) for mean in means.values()]
    others = sorted(by_family)[:-1]
    return {
        "Without": name,
        **{
            family: " ".join(f"{np.exp(x):.2f}" for x in mean)
            for family, mean in means.items()
        },
        "All": f"{np.exp(np.mean(by_family)):.3f}",
        "All but its best": f"{np.exp(np.mean(others)):.3f}",
        "In 90 %": f"{100 * np.mean(inside):.0f} %",
        "s": f"{seconds:.0f}",
    }


def main() -> None:
    """Draw, solve and print."""
    parser = study_parser("reproduction.ablation", __doc__)
    parser.add_argument(
        "--repeats", type=int, default=10, help="recordings of each platform"
    )
    parser.add_argument("--seed", type=int, help="default: another one at every run")
    arguments = parser.parse_args()
    seed = seed_of(arguments.seed)
    cases = [
        *real_cases(arguments.data_folder),
        *simulated_cases(seed, arguments.repeats),
    ]
    drawn_by = f"Seed {seed}, {len(cases)} recordings."
    show(arguments.page, {"ablation": f"{drawn_by}\n\n{table(cases)}"})


if __name__ == "__main__":
    main()
