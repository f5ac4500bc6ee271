"""``python -m reproduction.rig``: several sensors of one simulated rig.

It drives over hills. Every pose of every sensor has an error of its own, and every
motion one that stays. Their sizes and the extrinsics are known.
"""

import dataclasses
from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.extras.rig.rig import calibrate_rig
from hand_eye_calib.extras.simulation.drive import simulate_drive
from hand_eye_calib.extras.simulation.options import HILLY_DRIVE
from reproduction.partial import QUANTILE_90
from reproduction.writing import markdown_table, show, study_parser

# Errors per axis of the first sensor: white noise (m, rad), then random walk from pose to pose (m,
# rad).
_ERRORS = np.array([4e-3, 2e-3, 1e-3, 5e-4])


class Rig(NamedTuple):
    """A simulated rig: stamps (N,), poses (S, N, 4, 4), extrinsics (S, 4, 4) and sigmas (S, 4) of
    the errors.
    """

    stamps_ns: IntArray
    poses: FloatArray
    Xs: FloatArray
    errors: FloatArray


def simulated(seed: int, n_poses: int, errors: FloatArray) -> Rig:
    """A drive with sensors whose errors have sigmas (S, 4)."""
    random = np.random.default_rng((21, seed))
    drive = dataclasses.replace(
        HILLY_DRIVE, poses=n_poses, child_rate=10.0, child_delay=0.0
    )
    parent = simulate_drive((22, seed), drive).parent
    Xs = [np.eye(4)]
    poses = []
    for sensor, (white_m, white_rad, walk_m, walk_rad) in enumerate(errors):
        if sensor > 0:
            Xs.append(
                se3.exp(
                    np.r_[random.uniform(-1, 1, 3), random.normal(0, 0.7, 3)]
                )
            )
        true = parent.poses @ Xs[sensor]
        steps = (
            se3.inverse(true[:-1])
            @ true[1:]
            @ _errors(random, n_poses - 1, walk_m, walk_rad)
        )
        driven = [true[0]]
        for step in steps:
            driven.append(driven[-1] @ step)
        poses.append(
            np.array(driven) @ _errors(random, n_poses, white_m, white_rad)
        )
    return Rig(parent.stamps_ns, np.array(poses), np.array(Xs), errors)


def _errors(
    random: np.random.Generator, n: int, metres: float, radians: float
) -> FloatArray:
    sigmas = np.repeat([metres, radians], 3)
    return se3.exp(random.standard_normal((n, 6)) * sigmas)


def alike(n_sensors: int) -> FloatArray:
    """Sigmas of sensors of one make."""
    return np.tile(_ERRORS, (n_sensors, 1))


def unequal(n_sensors: int) -> FloatArray:
    """Sigmas of which the last sensor's are twice the first one's in translation, and half in
    rotation.
    """
    larger = np.linspace(1.0, 2.0, n_sensors)
    smaller = larger[::-1]
    factors = np.stack([larger, smaller, larger, smaller], axis=1)
    return _ERRORS * factors


class Outcome(NamedTuple):
    """One simulated rig: errors (P, 6) of all pairs of sensors in sigmas, squared errors of the rig
    and of the answers for neighbours alone (S - 2, 6), by how much the answers for two sensors at a
    time miss closing (m).
    """

    in_sigmas: FloatArray
    squares: FloatArray
    pairwise_squares: FloatArray
    closes_m: float


def outcome(rig: Rig) -> Outcome:
    """Calibrate a rig, all its extrinsics against the truth."""
    names = [f"s{index}" for index in range(len(rig.Xs))]
    calibration = calibrate_rig(trajectories_of(rig, names))
    errors = {}
    own = []
    for first, second in combinations(range(len(names)), 2):
        back = se3.inverse(rig.Xs[second]) @ rig.Xs[first]
        errors[first, second] = se3.log(
            back @ calibration.T(names[first], names[second])
        )
        own.append(
            np.diag(
                calibration.covariance_measured(names[first], names[second])
            )
        )
    pairwise = [
        se3.log(
            se3.inverse(rig.Xs[at + 1]) @ rig.Xs[at] @ neighbour.T_parent_child
        )
        for at, neighbour in enumerate(calibration.neighbours, start=1)
    ]
    return Outcome(
        np.array([*errors.values()]) / np.sqrt(own),
        np.array([errors[at, at + 1] for at in range(1, len(names) - 1)]) ** 2,
        np.array(pairwise) ** 2,
        max(closure.translation_m for closure in calibration.closures),
    )


def trajectories_of(rig: Rig, names: Sequence[str]) -> dict[str, Trajectory]:
    """The trajectories of all sensors by name."""
    return {
        name: Trajectory(rig.stamps_ns, poses)
        for name, poses in zip(names, rig.poses, strict=True)
    }


def simulated_table(repeats: int, n_poses: int) -> str:
    """A row for every kind and number of sensors."""
    rows = []
    for name, errors_of in (("alike", alike), ("unequal", unequal)):
        for n_sensors in (3, 5):
            errors = errors_of(n_sensors)
            outcomes = [
                outcome(simulated(seed, n_poses, errors))
                for seed in range(repeats)
            ]
            rows.append({"Sensors": name, "S": n_sensors, **_row(outcomes)})
    return markdown_table(rows)


def _row(outcomes: Sequence[Outcome]) -> dict[str, str]:
    squares, pairwise = (
        np.array([getattr(draw, name) for draw in outcomes]).mean(axis=0)
        for name in ("squares", "pairwise_squares")
    )
    misclosures_m = [draw.closes_m for draw in outcomes]
    inside = np.mean(
        [np.abs(draw.in_sigmas) < QUANTILE_90 for draw in outcomes]
    )
    return {
        "Neighbours: error / own answer": f"{np.sqrt(np.mean(squares / pairwise)):.2f}",
        "Within 90 % interval": f"{100 * inside:.0f} %",
        "Answers miss closing by (mm)": f"{1e3 * np.median(misclosures_m):.2f}",
    }


def main() -> None:
    """Simulate, calibrate and write."""
    parser = study_parser("reproduction.rig", __doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--poses", type=int, default=1200)
    arguments = parser.parse_args()
    show(
        arguments.page,
        {"simulated": simulated_table(arguments.repeats, arguments.poses)},
    )


if __name__ == "__main__":
    main()
