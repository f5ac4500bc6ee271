"""``python -m reproduction.ablation``: measure what each part of the adaptive estimator gains.

The parts are switched off in turn. The table contains the error without a part divided by the error
of the full estimator, by families of recordings.

Every run draws new simulated platforms, noise and seeds, so that nobody can tune the estimator to
them. A part is kept if it improves recordings of other families than those that it was made for.
"""

import dataclasses
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.alignment.scale import settle_scale
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.core.noise import estimator
from hand_eye_calib.core.noise.tuning import TUNING
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from reproduction.coverage.measures import HALF_WIDTH_90
from reproduction.coverage.mixed import MIXED, make
from reproduction.recordings import Rig, real_rigs
from reproduction.writing import markdown_table, seed_of, show, study_parser

# Families of rigs. The name of a rig contains its family; any other rig is a family of its own.
_FAMILIES = ("kitti", "euroc", "zxl19", "tango")

# Errors (m, rad) below this are rounding. Recordings without noise are left out of the ratios.
_ROUNDING = 1e-4

# Ratio of errors (variant / full estimator) that counts for a recording without a solution.
_RATIO_OF_FAILURE = 3.0

# Smallest ratio of errors: a ratio of zero has no logarithm.
_MIN_RATIO = 1e-3


def _with(**constants: object) -> dict[str, Any]:
    """Return options of the estimator in which these constants replace the usual ones."""
    return {"tuning": dataclasses.replace(TUNING, **constants)}  # type: ignore[arg-type]


# Options of ``estimator.solve`` that switch a part off, by the name of the part.
VARIANTS: dict[str, dict[str, Any]] = {
    "outliers": {"without": ("outliers", "tails")},
    "heavy tails": {"without": ("tails",)},
    "time-correlated errors": {"without": ("time_correlated",)},
    "rotation about a world's origin": {"without": ("centre",)},
    "systematic errors": {"systematic": ()},
    "bias": {"systematic": ("scale", "time")},
    "scale": {"systematic": ("bias", "time")},
    "time": {"systematic": ("scale", "bias")},
    "rejection of biases like X": _with(max_sigma_growth=1e6),
    "strides for a noisy target": _with(strides=()),
    "iteration of outliers and X": _with(max_rounds=1),
    "subset of poses for noise": _with(most_poses=10**6),
}


class Case(NamedTuple):
    """A recording with pose pairs on one clock and in one unit, and its true extrinsic.

    Attributes
    ----------
    family : str
    poses : PosePairs
    is_clock_free : bool
        Whether the time offset was estimated from the recording.
    T_parent_child : (4, 4) array
        True extrinsic.
    sigmas : (6,) array
        Standard deviations (m, rad) of the true extrinsic; infinite on unknown axes.
    """

    family: str
    poses: PosePairs
    is_clock_free: bool
    T_parent_child: FloatArray
    sigmas: FloatArray


def real_cases(folder: Path | None) -> Iterator[Case]:
    """Yield the real recordings whose extrinsic is known; none without a folder."""
    for rig in real_rigs(folder)[0] if folder else ():
        if rig.truth is None or rig.is_refused:
            continue
        for recording in rig.recordings.values():
            yield _real_case(rig, recording.parent, recording.child)


def _real_case(rig: Rig, parent: Any, child: Any) -> Case:
    assert rig.truth is not None
    options = {
        name: value for name, value in rig.options.items() if name != "prior"
    }
    snapshot = whole_snapshot(parent, child, options).resolved
    pairs = snapshot.pose_pairs
    pairs = pairs.child_scaled(settle_scale(pairs, snapshot.config.scale)[0])
    family = next(
        (family for family in _FAMILIES if family in rig.name), rig.name
    )
    is_clock_free = snapshot.time_offset is not None
    return Case(
        family, pairs, is_clock_free, rig.truth.T_parent_child, rig.truth.sigmas
    )


def simulated_cases(seed: int, repeats: int) -> Iterator[Case]:
    """Yield recordings of random platforms: motion, rate, lever arm and noise are drawn.

    ``repeats`` is the number of recordings of each kind of platform.
    """
    for name in MIXED:
        for number in range(repeats):
            drive = make(name, seed, number)
            pairs = PosePairs(
                drive.parent.stamps_ns, drive.parent.poses, drive.child.poses
            )
            yield Case(name, pairs, False, drive.T_parent_child, np.zeros(6))


class Outcome(NamedTuple):
    """Errors of an estimate.

    Attributes
    ----------
    errors : (2,) array
        Translation error (m) and rotation error (rad); NaN if no axis of the truth is known.
    in_sigmas : (k,) array
        Absolute errors on the k known axes, divided by their standard deviations.
    """

    errors: FloatArray
    in_sigmas: FloatArray


def outcome(case: Case, options: dict[str, Any]) -> Outcome | None:
    """Return the errors of the estimator with these options; None if the estimator fails.

    Half of the truth's standard deviation is added to the error in quadrature. Improvements smaller
    than the uncertainty of the truth are chance, and then hardly change the ratio.
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
    deviations = deviation(solution.T_parent_child, case.T_parent_child)
    to_parent = np.kron(np.eye(2), solution.T_parent_child[:3, :3])
    variances = np.diag(
        to_parent @ solution.cov_parent_child_in_child @ to_parent.T
    )
    is_known = np.isfinite(case.sigmas)
    known_sigmas = np.where(is_known, case.sigmas, 0.0)
    squares = np.where(is_known, deviations**2 + 0.25 * known_sigmas**2, 0.0)
    errors = np.full(2, np.nan)
    for index, axes in enumerate((slice(0, 3), slice(3, 6))):
        if is_known[axes].any():
            errors[index] = np.sqrt(squares[axes].sum())
    in_sigmas = np.abs(deviations) / np.sqrt(variances + known_sigmas**2)
    return Outcome(errors, in_sigmas[is_known])


def table(cases: Sequence[Case]) -> str:
    """Return a table of error ratios with a row for every part that is switched off.

    See :func:`_row` for the columns.
    """
    references = [outcome(case, {}) for case in cases]
    rows = [_row("nothing", cases, references, references, 0.0)]
    for name, options in VARIANTS.items():
        started = time.process_time()
        outcomes = [outcome(case, options) for case in cases]
        seconds = time.process_time() - started
        rows.append(_row(name, cases, outcomes, references, seconds))
    return markdown_table(rows)


def _row(
    name: str,
    cases: Sequence[Case],
    outcomes: Sequence[Outcome | None],
    references: Sequence[Outcome | None],
    seconds: float,
) -> dict[str, str]:
    """Return the row of a variant: its errors divided by those of the full estimator.

    For each family, the row contains the geometric means of the ratios of translation and rotation
    errors. Further columns are the geometric mean over all families, and the same mean without the
    family of the largest ratio. The last columns are the share of true values in 90 % intervals,
    and the time.

    Parameters
    ----------
    name : str
        Name of the part that is switched off.
    cases : sequence of Case
    outcomes, references : sequence of Outcome or None
        Outcomes of the variant and of the full estimator for each case; None if it failed.
    seconds : float
        Processor time of the variant, s.
    """
    log_ratios: dict[str, list[FloatArray]] = {}
    are_inside: list[bool] = []
    for case, result, reference in zip(
        cases, outcomes, references, strict=True
    ):
        if reference is None or np.nanmax(reference.errors) < _ROUNDING:
            continue
        ratios = np.full(2, _RATIO_OF_FAILURE)
        if result is not None:
            ratios = result.errors / reference.errors
            are_inside += (result.in_sigmas < HALF_WIDTH_90).tolist()
        log_ratios_of_family = log_ratios.setdefault(case.family, [])
        log_ratios_of_family.append(np.log(np.maximum(ratios, _MIN_RATIO)))
    row = {"Without": name}
    gains = []
    for family, log_ratios_of_family in log_ratios.items():
        mean = np.mean(log_ratios_of_family, axis=0)
        row[family] = " ".join(f"{ratio:.2f}" for ratio in np.exp(mean))
        gains.append(float(np.nanmean(mean)))
    without_largest = sorted(gains)[:-1]
    return row | {
        "All": f"{np.exp(np.mean(gains)):.3f}",
        "All but the largest gain": f"{np.exp(np.mean(without_largest)):.3f}",
        "In 90 %": f"{100 * np.mean(are_inside):.0f} %",
        "s": f"{seconds:.0f}",
    }


def main() -> None:
    """Draw recordings, solve them with all variants, and print the table."""
    parser = study_parser("reproduction.ablation", __doc__)
    parser.add_argument(
        "--repeats",
        type=int,
        default=10,
        help="recordings of each kind of platform",
    )
    parser.add_argument(
        "--seed", type=int, help="default: a new seed at every run"
    )
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
