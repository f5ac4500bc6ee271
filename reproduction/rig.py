"""``python -m reproduction.rig``: several sensors in one solve, simulated and real.

Simulated rigs drive over hills. Every pose of every sensor has an error of its own, and every
motion one that stays. Their sizes and the extrinsics are known.
"""

import dataclasses
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.rig import solution as joint
from hand_eye_calib.rig.calibrate import calibrate_rig, solve_rig
from hand_eye_calib.rig.result import RigCalibration
from hand_eye_calib.rig.table import Table, synchronised
from hand_eye_calib.simulation.drive import simulate_drive
from hand_eye_calib.simulation.options import HILLY_DRIVE
from reproduction.positions import QUANTILE_90
from reproduction.recordings import tango_devices, zxl19_sensors
from reproduction.writing import markdown_table, show, study_parser

# Errors per axis of the first sensor: white m and rad, walk m and rad from pose to pose.
_ERRORS = np.array([4e-3, 2e-3, 1e-3, 5e-4])


class Rig(NamedTuple):
    """A simulated rig: poses, extrinsics (S, 4, 4) and sigmas (S, 4) of the errors."""

    table: Table
    Xs: FloatArray
    errors: FloatArray


def simulated(seed: int, n_poses: int, errors: FloatArray) -> Rig:
    """A drive with sensors whose errors have sigmas (S, 4)."""
    random = np.random.default_rng((21, seed))
    drive = dataclasses.replace(HILLY_DRIVE, poses=n_poses, child_rate=10.0, child_delay=0.0)
    parent = simulate_drive((22, seed), drive).parent
    Xs, poses = [np.eye(4)], []
    for sensor, (white_m, white_rad, walk_m, walk_rad) in enumerate(errors):
        if sensor > 0:
            Xs.append(se3.exp(np.r_[random.uniform(-1, 1, 3), random.normal(0, 0.7, 3)]))
        true = parent.poses @ Xs[sensor]
        steps = se3.inverse(true[:-1]) @ true[1:] @ _errors(random, n_poses - 1, walk_m, walk_rad)
        driven = [true[0]]
        for step in steps:
            driven.append(driven[-1] @ step)
        poses.append(np.array(driven) @ _errors(random, n_poses, white_m, white_rad))
    return Rig(Table(parent.stamps_ns, np.array(poses)), np.array(Xs), errors)


def _errors(random: np.random.Generator, n: int, metres: float, radians: float) -> FloatArray:
    return se3.exp(random.standard_normal((n, 6)) * np.repeat([metres, radians], 3))


def alike(n_sensors: int) -> FloatArray:
    """Sigmas of sensors of one make."""
    return np.tile(_ERRORS, (n_sensors, 1))


def unequal(n_sensors: int) -> FloatArray:
    """Sigmas of which the last sensor's are twice the first one's in translation, and half in
    rotation.
    """
    share = np.linspace(1.0, 2.0, n_sensors)
    return _ERRORS * np.stack([share, share[::-1], share, share[::-1]], axis=1)


def unlike(n_sensors: int) -> FloatArray:
    """Sigmas of sensors of which every other one hardly drifts, with four times the white error."""
    errors = alike(n_sensors)
    errors[1::2] *= [4.0, 4.0, 0.1, 0.1]
    return errors


class Outcome(NamedTuple):
    """One simulated rig: errors (S - 1, 6) in sigmas, variance of the joint over that of the
    pairwise answer and the same of squared errors (S - 1, 6), found over true sigmas of the noise
    (S, 4), by how much chains of joint and of pairwise answers miss closing (m).
    """

    in_sigmas: FloatArray
    variances: FloatArray
    squares: FloatArray
    pairwise_squares: FloatArray
    noise: FloatArray
    closes_m: float
    pairwise_closes_m: float


def outcome(rig: Rig) -> Outcome:
    """Solve jointly, and two sensors at a time with the same estimator."""
    random = np.random.default_rng(23)
    start = rig.Xs.copy()
    start[1:] = se3.exp(0.01 * random.standard_normal((len(start) - 1, 6))) @ start[1:]
    found = joint.solve(rig.table, start)
    of_pairs = {pair: _pairwise(rig, start, *pair) for pair in _pairs(len(start))}
    errors, pairwise, variances, own = [], [], [], []
    for sensor in range(1, len(start)):
        back = se3.inverse(rig.Xs[sensor])
        of_pair = of_pairs[0, sensor]
        errors.append(se3.log(back @ found.Xs[sensor]))
        pairwise.append(se3.log(back @ of_pair.Xs[1]))
        own.append(np.diag(found.covariance_of(0, sensor)))
        variances.append(own[-1] / np.diag(of_pair.covariance_of(0, 1)))
    sigmas = np.array([dataclasses.astuple(noise)[:4] for noise in found.noise])[:, [1, 0, 3, 2]]
    return Outcome(
        np.array(errors) / np.sqrt(own),
        np.array(variances),
        np.array(errors) ** 2,
        np.array(pairwise) ** 2,
        sigmas / rig.errors,
        _miss(found.T(0, 1), found.T(1, 2), found.T(0, 2)),
        _miss(*(of_pairs[pair].Xs[1] for pair in ((0, 1), (1, 2), (0, 2)))),
    )


def _pairs(n_sensors: int) -> list[tuple[int, int]]:
    return [(0, sensor) for sensor in range(1, n_sensors)] + [(1, 2)]


def _pairwise(rig: Rig, start: FloatArray, first: int, second: int) -> joint.RigSolution:
    table = Table(rig.table.stamps_ns, rig.table.poses[[first, second]])
    X = se3.inverse(start[first]) @ start[second]
    return joint.solve(table, np.array([np.eye(4), X]))


def _miss(ab: FloatArray, bc: FloatArray, ac: FloatArray) -> float:
    return float(np.linalg.norm((ab @ bc @ se3.inverse(ac))[:3, 3]))


def simulated_table(repeats: int, n_poses: int) -> str:
    """A row for every kind and number of sensors."""
    rows = []
    for name, errors_of in (("alike", alike), ("unequal", unequal), ("unlike", unlike)):
        for n_sensors in (3, 5, 8):
            errors = errors_of(n_sensors)
            found = [outcome(simulated(seed, n_poses, errors)) for seed in range(repeats)]
            rows.append({"Sensors": name, "S": n_sensors, **_row(found, n_sensors)})
    return markdown_table(rows)


def _row(found: Sequence[Outcome], n_sensors: int) -> dict[str, str]:
    squares = np.array([each.squares for each in found]).mean(axis=0)
    pairwise = np.array([each.pairwise_squares for each in found]).mean(axis=0)
    noise = np.median([each.noise for each in found], axis=0)
    inside = np.mean([np.abs(each.in_sigmas) < QUANTILE_90 for each in found])
    closes = 1e3 * max(each.closes_m for each in found)
    variances = np.mean([each.variances for each in found])
    return {
        "White error: worst sensor": _worst(noise[:, :2]),
        "Walk: worst sensor": _worst(noise[:, 2:]),
        "Error / pairwise": f"{np.sqrt(np.mean(squares / pairwise)):.3f}",
        "Sigma / pairwise": f"{np.sqrt(variances):.3f}",
        "sqrt(2/S)": f"{np.sqrt(2 / n_sensors):.2f}",
        "Within 90 % interval": f"{100 * inside:.0f} %",
        "Closes to (mm)": "0" if closes < 1e-6 else f"{closes:.2g}",
        "Pairwise to (mm)": f"{1e3 * np.median([each.pairwise_closes_m for each in found]):.2f}",
    }


def _worst(ratios: FloatArray) -> str:
    """The ratio that is farthest from one, as a change in per cent."""
    worst = ratios.flat[int(np.argmax(np.abs(np.log(ratios))))]
    return f"{100 * (worst - 1):+.0f} %"


def time_table() -> str:
    """Processor time of calibrating whole rigs."""
    rows = []
    for n_sensors, n_poses in ((3, 2500), (3, 10000), (8, 2500), (8, 5000), (8, 10000)):
        rig = simulated(1, n_poses, unequal(n_sensors))
        trajectories = {
            f"s{index}": Trajectory(rig.table.stamps_ns, poses)
            for index, poses in enumerate(rig.table.poses)
        }
        started = time.process_time()
        found = calibrate_rig(trajectories)
        solved = time.process_time()
        joint.solve(rig.table, found.solution.Xs)
        rows.append(
            {
                "Sensors": n_sensors,
                "Poses": f"{n_poses:,}",
                "Whole calibration (s)": f"{solved - started:.1f}",
                "Joint solve (s)": f"{time.process_time() - solved:.1f}",
            }
        )
    return markdown_table(rows)


def real_rigs(folder: Path) -> Iterator[tuple[str, Mapping[str, Trajectory], RigCalibration]]:
    """The three devices of tango, and the three sensors of zxl19's vehicle in three recordings."""
    tango, zxl19 = folder / "asl_tango_easy", folder / "zxl19"
    if tango.is_dir():
        devices = tango_devices(tango)
        yield "tango", devices, solve_rig(devices, {"time_offset": "estimate", "scale": "auto"})
    for number, sensors in enumerate(zxl19_sensors(zxl19) if zxl19.is_dir() else (), start=1):
        options = {"time_offset": "estimate", "scale": "estimate"}
        yield f"zxl19 bag{number}", sensors, solve_rig(sensors, options)


def real_table(folder: Path) -> str:
    """A row for every sensor of every real rig."""
    rows = []
    for name, streams, found in real_rigs(folder):
        same_model = _same_model(streams, found)
        miss = "; ".join(
            f"{1e3 * each.translation_m:.0f} mm, {np.degrees(each.rotation_rad):.2f} deg, "
            f"{each.chi2:.1f} of {each.dof}"
            for each in found.closures
        )
        for own, pairwise, ratios in zip(
            found.calibrations, found.pairwise, same_model, strict=True
        ):
            both = np.isfinite(own.sigmas) & np.isfinite(pairwise.sigmas)
            shrinks = np.exp(np.mean(np.log(own.sigmas[both] / pairwise.sigmas[both])))
            rows.append(
                {
                    "Rig": name,
                    "Sensor": own.child_frame,
                    "Sigma x y z (mm)": _listed(1e3 * own.sigmas[:3]),
                    "of pairs": _listed(1e3 * pairwise.sigmas[:3]),
                    "roll pitch yaw (deg)": _listed(np.degrees(own.sigmas[3:])),
                    "of pairs (deg)": _listed(np.degrees(pairwise.sigmas[3:])),
                    "Joint / pairwise": f"{shrinks:.2f}",
                    "same model": f"{ratios.mean():.2f}, {ratios.max():.2f}",
                    "misses": miss,
                }
            )
            miss = ""
    titles = (
        "Rig | Sensor | Sigma x y z (mm) | Pairwise | roll pitch yaw (deg) | Pairwise | Joint / "
        "pairwise | The same noise model: mean, largest axis | Pairwise answers miss closing by, "
        "chi-square of degrees"
    )
    return markdown_table(rows, titles)


def _listed(values: FloatArray) -> str:
    return " ".join(f"{value:.2g}" for value in values)


def _same_model(streams: Mapping[str, Trajectory], found: RigCalibration) -> list[FloatArray]:
    """Standard deviations (6,) of each sensor under the model, over those of the same model for
    this sensor and the first one alone.
    """
    moved = [
        streams[each.child_frame].scaled(each.scale).shifted(each.time_offset_s)
        for each in found.pairwise
    ]
    table = synchronised([streams[found.sensors[0]], *moved], CalibratorConfig().max_gap)
    Xs, ratios = found.solution.Xs, []
    whole = joint.solve(table, Xs)
    for at in range(1, len(Xs)):
        pair = joint.solve(Table(table.stamps_ns, table.poses[[0, at]]), Xs[[0, at]])
        own = np.diag(whole.covariance)[6 * at - 6 : 6 * at]
        ratios.append(np.sqrt(own / np.diag(pair.covariance)))
    return ratios


def main() -> None:
    """Simulate, calibrate and write."""
    parser = study_parser("reproduction.rig", __doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--poses", type=int, default=1200)
    arguments = parser.parse_args()
    show(arguments.page, {"simulated": simulated_table(arguments.repeats, arguments.poses)})
    show(arguments.page, {"time": time_table()})
    if arguments.data_folder:
        show(arguments.page, {"real": real_table(arguments.data_folder)})


if __name__ == "__main__":
    main()
