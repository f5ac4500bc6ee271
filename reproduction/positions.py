"""Streams of positions: simulated RTK receivers, and recordings with a known lever arm."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import hand_eye_calib as hec
from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.trajectory_files import read_trajectory_file
from reproduction.coverage import motions
from reproduction.coverage.sensor_errors import SensorErrors, draw, sigmas
from reproduction.recordings import Recording

_START_NS = 1_700_000_000_000_000_000
_QUANTILE_90 = 1.645
_N_PARTS = 3

_LIDAR = SensorErrors(white=sigmas(0.01, 0.03), walk_by_metre=sigmas(0.006, 0.012))
_VIO = SensorErrors(white=sigmas(0.0008, 0.03), walk=sigmas(0.004, 0.06))


@dataclass(frozen=True)
class Machine:
    """How a machine moves, its odometry and the rate of that (Hz), how long it is recorded (s) and
    the size of its lever arm (m).
    """

    motion: Callable[[np.random.Generator, float], motions.Motion]
    odometry: SensorErrors
    rate_hz: float
    duration_s: float
    lever_m: float


MACHINES = {
    "car": Machine(motions.car, _LIDAR, 10.0, 240.0, 2.0),
    "excavator": Machine(motions.excavator, _LIDAR, 10.0, 240.0, 2.0),
    "hand-held": Machine(motions.hand_held, _VIO, 30.0, 120.0, 0.3),
}


@dataclass(frozen=True)
class Receiver:
    """An RTK receiver: rate (Hz), white noise of a fixed solution (m); outages per second and how
    long they last (s); float solutions per minute, how long they last (s), their error (m), which
    lasts for some seconds, and its correlation time (s).
    """

    rate_hz: float = 5.0
    white_m: float = 0.01
    outages_hz: float = 0.2
    outage_s: tuple[float, float] = (0.5, 1.5)
    floats_per_min: float = 1.0
    float_s: tuple[float, float] = (5.0, 15.0)
    float_m: float = 0.3
    float_tau_s: float = 5.0


def simulated_positions(name: str, seed: int) -> tuple[Trajectory, Trajectory, FloatArray]:
    """Poses of the odometry, positions of the antenna, and the lever arm (3,)."""
    machine, receiver = MACHINES[name], Receiver()
    seeds = (seed, sorted(MACHINES).index(name))
    motion_rng, mount_rng, odometry_rng, rng = np.random.default_rng(seeds).spawn(4)
    motion = machine.motion(motion_rng, machine.duration_s)
    lever_arm = machine.lever_m * mount_rng.standard_normal(3) * [1.0, 1.0, 0.7]
    step_s = 1.0 / machine.rate_hz
    n_poses = round(machine.duration_s * machine.rate_hz)
    times_s: FloatArray = step_s * np.arange(n_poses, dtype=np.float64)
    true_poses, twists = motion.at(times_s), motion.twists(times_s)
    poses = draw(machine.odometry, true_poses, twists, step_s, odometry_rng).poses
    n_fixes = round((machine.duration_s - 1.0) * receiver.rate_hz)
    fixes_s: FloatArray = (np.arange(n_fixes, dtype=np.float64) + 0.25) / receiver.rate_hz
    Ts = motion.at(fixes_s)
    yaw = mount_rng.uniform(-np.pi, np.pi)
    positions = (Ts[:, :3, :3] @ lever_arm + Ts[:, :3, 3]) @ se3.rotation_exp(np.r_[0, 0, yaw])
    positions += receiver.white_m * rng.standard_normal(positions.shape)
    positions += _float_errors(receiver, fixes_s, rng)
    kept = _received(receiver, len(fixes_s), rng)
    return (
        Trajectory(_stamps_ns(times_s), poses),
        Trajectory.from_positions(_stamps_ns(fixes_s[kept]), positions[kept]),
        lever_arm,
    )


def _stamps_ns(times_s: FloatArray) -> np.ndarray:
    return _START_NS + np.round(times_s * 1e9).astype(np.int64)


def _float_errors(receiver: Receiver, times_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Errors (N, 3) of float solutions; zero where the solution is fixed."""
    errors = np.zeros((len(times_s), 3))
    stay = np.exp(-1.0 / (receiver.rate_hz * receiver.float_tau_s))
    n_floats = round(receiver.floats_per_min * times_s[-1] / 60.0)
    for start_s in rng.uniform(0.0, times_s[-1] - receiver.float_s[1], n_floats):
        inside = (times_s >= start_s) & (times_s < start_s + rng.uniform(*receiver.float_s))
        error = rng.standard_normal(3)
        for row in np.flatnonzero(inside):
            errors[row] = receiver.float_m * (error + 0.1 * rng.standard_normal(3))
            error = stay * error + np.sqrt(1.0 - stay**2) * rng.standard_normal(3)
    return errors


def _received(receiver: Receiver, count: int, rng: np.random.Generator) -> BoolArray:
    """Which of the fixes arrive (N,)."""
    received = np.ones(count, dtype=bool)
    for start in np.flatnonzero(rng.random(count) < receiver.outages_hz / receiver.rate_hz):
        received[start : start + round(receiver.rate_hz * rng.uniform(*receiver.outage_s))] = False
    return received


SIMULATED_HEADER = (
    *("Machine", "Recordings", "Median error x, y, z (cm)", "Median sigma x, y, z (cm)"),
    *("Covers", "Told unobservable"),
)


def simulated_rows(n_seeds: int) -> Iterator[list[object]]:
    """Rows of the table of simulated receivers."""
    pooled: list[FloatArray] = []
    for name in MACHINES:
        errors, stated = [], []
        for seed in range(n_seeds):
            parent, child, lever_arm = simulated_positions(name, seed)
            result = hec.calibrate(parent, child)
            errors.append(result.T_parent_child[:3, 3] - lever_arm)
            stated.append(result.sigmas[:3])
        ratios = np.abs(errors) / np.array(stated)
        known = np.isfinite(stated)
        pooled.append(ratios[known])
        yield [
            name,
            n_seeds,
            _in_cm(np.median(np.abs(errors), axis=0)),
            _in_cm(np.median(stated, axis=0)),
            f"{np.mean(ratios[known] < _QUANTILE_90):.0%}",
            int((~known).sum()),
        ]
    together = np.concatenate(pooled)
    yield ["all", 3 * n_seeds, "", "", f"{np.mean(together < _QUANTILE_90):.0%}", ""]


def _in_cm(values: FloatArray) -> str:
    return ", ".join(f"{100 * value:.1f}" for value in values)


_EUROC_LEVER = np.array([-0.0216401, -0.0646770, 0.0098107])
_KITTI_LEVER = np.array([0.8, -0.3, 0.5])
RECORDED_HEADER = (
    *("Positions against odometry", "Error x, y, z (mm)", "In all (mm)", "Sigma x, y, z (mm)"),
    *("Largest error / sigma", "The same with the truth's sigma"),
    "Error of whole poses x, y, z (mm)",
)


def _recordings() -> dict[str, tuple[str, str, FloatArray, float]]:
    """Files of odometry and positions, the lever arm and how well it is known (m)."""
    recordings = {
        f"EuRoC {flight}, {kind} odometry": (
            f"euroc_vio/vio_{kind}_{flight}.tum",
            f"euroc_vio/cam0_truth_{flight}.tum",
            _EUROC_LEVER,
            0.01,
        )
        for kind in ("stereo", "mono")
        for flight in ("mh_03", "mh_05", "v2_01")
    }
    recordings |= {
        f"KITTI {drive}, lidar odometry": (
            f"simple_kitti/odometry_{drive}.tum",
            f"simple_kitti/truth_{drive}.tum",
            _KITTI_LEVER,
            0.0,
        )
        for drive in ("05", "07")
    }
    return recordings


def _streams(data_folder: Path, *names: str) -> list[Trajectory]:
    return [read_trajectory_file(data_folder / name)[0] for name in names]


def recorded_rows(data_folder: Path) -> Iterator[list[object]]:
    """Rows of the table of recordings; sigmas with the common-mode floor."""
    for name, (parent, child, lever_arm, truth_m) in _recordings().items():
        streams = _streams(data_folder, parent, child)
        result = hec.calibrate(*streams, child_measures="positions")
        whole = hec.calibrate(*streams, time_offset="estimate", scale="auto")
        error = result.T_parent_child[:3, 3] - lever_arm
        stated = result.sigmas_with_floor[:3]
        yield [
            name,
            _in_mm(error),
            f"{1e3 * np.linalg.norm(error):.0f}",
            _in_mm(stated),
            f"{np.abs(error / stated).max():.1f}",
            f"{np.abs(error / np.hypot(stated, truth_m)).max():.1f}",
            _in_mm(whole.T_parent_child[:3, 3] - lever_arm),
        ]


def _in_mm(values: FloatArray) -> str:
    return ", ".join(f"{1000 * value:.0f}" if np.isfinite(value) else "-" for value in values)


PARTS_HEADER = ("Thirds of", "Scatter x, y, z (mm)", "Sigma x, y, z (mm)", "Chi-square of 6")


def parts_rows(data_folder: Path) -> Iterator[list[object]]:
    """Rows of the table of recordings in three parts: how far their lever arms are apart, against
    their covariances with the common-mode floor. No truth is needed for that.
    """
    total = 0.0
    recordings = _recordings()
    for name, (parent, child, *_) in recordings.items():
        whole = Recording(*_streams(data_folder, parent, child))
        parts = [
            hec.calibrate(part.parent, part.child, child_measures="positions")
            for part in whole.parts(_N_PARTS, 0.0)
        ]
        lever_arms = np.array([part.T_parent_child[:3, 3] for part in parts])
        covariances = np.array([part.covariance_with_floor[:3, :3] for part in parts])
        chi_square = _misfit_of_mean(lever_arms, covariances)
        total += chi_square
        variances = np.diagonal(covariances, axis1=1, axis2=2)
        yield [
            name,
            _in_mm(lever_arms.std(axis=0, ddof=1)),
            _in_mm(np.sqrt(variances.mean(axis=0))),
            f"{chi_square:.1f}",
        ]
    yield ["all, the mean", "", "", f"{total / len(recordings):.1f}"]


def _misfit_of_mean(values: FloatArray, covariances: FloatArray) -> float:
    """Chi-square of values (K, 3) with covariances (K, 3, 3) about their weighted mean."""
    weights = np.linalg.inv(covariances)
    mean = np.linalg.solve(weights.sum(axis=0), np.einsum("kij,kj->i", weights, values))
    away = values - mean
    return float(np.einsum("ki,kij,kj->", away, weights, away))
