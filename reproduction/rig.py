"""``python -m reproduction.rig``: calibrate several sensors of a simulated rig.

The rig drives over hills. The poses of every sensor have white noise and a random walk. The sizes
of both, and the extrinsics, are known.
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
from reproduction.coverage.measures import HALF_WIDTH_90
from reproduction.writing import markdown_table, show, study_parser

# Standard deviations of a sensor's errors per axis: white noise (m, rad), then random walk from
# pose to pose (m, rad).
_ERRORS = np.array([4e-3, 2e-3, 1e-3, 5e-4])


class Rig(NamedTuple):
    """A simulated rig of S sensors with N poses each.

    Attributes
    ----------
    stamps_ns : (N,) int64 array
    poses : (S, N, 4, 4) array
        Measured poses.
    Xs : (S, 4, 4) array
        True extrinsics: the pose of each sensor in the first sensor.
    errors : (S, 4) array
        Standard deviations of the errors, in the order of ``_ERRORS``.
    """

    stamps_ns: IntArray
    poses: FloatArray
    Xs: FloatArray
    errors: FloatArray


def simulated(seed: int, n_poses: int, errors: FloatArray) -> Rig:
    """Simulate a drive with sensors whose errors have the standard deviations ``errors`` (S, 4)."""
    random = np.random.default_rng((21, seed))
    drive = dataclasses.replace(
        HILLY_DRIVE, poses=n_poses, child_rate=10.0, child_delay=0.0
    )
    parent = simulate_drive((22, seed), drive).parent
    Xs = [np.eye(4)]
    poses = []
    for sensor, (white_m, white_rad, walk_m, walk_rad) in enumerate(errors):
        if sensor > 0:
            translation = random.uniform(-1, 1, 3)
            rotation_vector = random.normal(0, 0.7, 3)
            Xs.append(se3.exp(np.r_[translation, rotation_vector]))
        true_poses = parent.poses @ Xs[sensor]
        true_steps = se3.inverse(true_poses[:-1]) @ true_poses[1:]
        steps = true_steps @ _errors(random, n_poses - 1, walk_m, walk_rad)
        drifting = [true_poses[0]]
        for step in steps:
            drifting.append(drifting[-1] @ step)
        white = _errors(random, n_poses, white_m, white_rad)
        poses.append(np.array(drifting) @ white)
    return Rig(parent.stamps_ns, np.array(poses), np.array(Xs), errors)


def _errors(
    random: np.random.Generator, n: int, metres: float, radians: float
) -> FloatArray:
    """Draw transforms (n, 4, 4) near the identity, with these standard deviations per axis."""
    sigmas = np.repeat([metres, radians], 3)
    return se3.exp(random.standard_normal((n, 6)) * sigmas)


def alike(n_sensors: int) -> FloatArray:
    """Return the standard deviations (S, 4) of sensors with equal errors."""
    return np.tile(_ERRORS, (n_sensors, 1))


def unequal(n_sensors: int) -> FloatArray:
    """Return standard deviations (S, 4) that change from the first to the last sensor.

    Errors of translations grow by a factor of two, errors of rotations decrease by a factor of two.
    """
    larger = np.linspace(1.0, 2.0, n_sensors)
    smaller = larger[::-1]
    factors = np.stack([larger, smaller, larger, smaller], axis=1)
    return _ERRORS * factors


class Outcome(NamedTuple):
    """Errors of the calibration of a simulated rig with S sensors and P pairs of sensors.

    Attributes
    ----------
    in_sigmas : (P, 6) array
        Errors of all pairs of sensors, divided by their standard deviations.
    squares : (S - 2, 6) array
        Squared errors of neighbours without the first sensor, from the rig.
    pairwise_squares : (S - 2, 6) array
        Squared errors of the same neighbours, each calibrated alone.
    closes_m : float
        Largest misclosure of pairwise extrinsics around a cycle of sensors, m.
    """

    in_sigmas: FloatArray
    squares: FloatArray
    pairwise_squares: FloatArray
    closes_m: float


def outcome(rig: Rig) -> Outcome:
    """Calibrate a rig, and compare all its extrinsics with the truth."""
    names = [f"s{index}" for index in range(len(rig.Xs))]
    calibration = calibrate_rig(trajectories_of(rig, names))
    errors = {}
    variances = []
    for first, second in combinations(range(len(names)), 2):
        T = calibration.T(names[first], names[second])
        T_true_inverse = se3.inverse(rig.Xs[second]) @ rig.Xs[first]
        errors[first, second] = se3.log(T_true_inverse @ T)
        covariance = calibration.covariance_measured(
            names[first], names[second]
        )
        variances.append(np.diag(covariance))
    pairwise = []
    for sensor, neighbour in enumerate(calibration.neighbours, start=1):
        T_true_inverse = se3.inverse(rig.Xs[sensor + 1]) @ rig.Xs[sensor]
        pairwise.append(se3.log(T_true_inverse @ neighbour.T_parent_child))
    of_neighbours = [
        errors[sensor, sensor + 1] for sensor in range(1, len(names) - 1)
    ]
    misclosures_m = [closure.translation_m for closure in calibration.closures]
    return Outcome(
        in_sigmas=np.array([*errors.values()]) / np.sqrt(variances),
        squares=np.array(of_neighbours) ** 2,
        pairwise_squares=np.array(pairwise) ** 2,
        closes_m=max(misclosures_m),
    )


def trajectories_of(rig: Rig, names: Sequence[str]) -> dict[str, Trajectory]:
    """Return the trajectories of all sensors by name."""
    return {
        name: Trajectory(rig.stamps_ns, poses)
        for name, poses in zip(names, rig.poses, strict=True)
    }


def simulated_table(repeats: int, n_poses: int) -> str:
    """Return a table with a row for equal and unequal sensors, three and five of them."""
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
    squares = np.mean([outcome.squares for outcome in outcomes], axis=0)
    pairwise = np.mean(
        [outcome.pairwise_squares for outcome in outcomes], axis=0
    )
    ratio = np.sqrt(np.mean(squares / pairwise))
    misclosures_m = [outcome.closes_m for outcome in outcomes]
    inside = np.mean(
        [np.abs(outcome.in_sigmas) < HALF_WIDTH_90 for outcome in outcomes]
    )
    return {
        "Neighbours: error / pairwise error": f"{ratio:.2f}",
        "Within 90 % interval": f"{100 * inside:.0f} %",
        "Misclosure (mm)": f"{1e3 * np.median(misclosures_m):.2f}",
    }


def main() -> None:
    """Simulate rigs, calibrate them, and print the table."""
    parser = study_parser("reproduction.rig", __doc__)
    parser.add_argument(
        "--repeats", type=int, default=5, help="drives of each row. Default: 5"
    )
    parser.add_argument(
        "--poses",
        type=int,
        default=1200,
        help="poses of a drive. Default: 1200",
    )
    arguments = parser.parse_args()
    show(
        arguments.page,
        {"simulated": simulated_table(arguments.repeats, arguments.poses)},
    )


if __name__ == "__main__":
    main()
