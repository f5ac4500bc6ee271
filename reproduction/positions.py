"""Streams of positions: simulated RTK receivers, and recordings with a known lever arm."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import hand_eye_calib as hec
from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from reproduction.coverage import motions
from reproduction.coverage.classes import LIDAR_ODOMETRY, VIO, stamps_ns
from reproduction.coverage.sensor_errors import SensorErrors, draw
from reproduction.recordings import Recording, Rig, real_rigs
from reproduction.writing import triple

# Normal errors are within so many sigmas in nine cases of ten.
QUANTILE_90 = 1.645


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
    "car": Machine(motions.car, LIDAR_ODOMETRY, 10.0, 240.0, 2.0),
    "excavator": Machine(motions.excavator, LIDAR_ODOMETRY, 10.0, 240.0, 2.0),
    "hand-held": Machine(motions.hand_held, VIO, 30.0, 120.0, 0.3),
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
        Trajectory(stamps_ns(times_s), poses),
        Trajectory.from_positions(stamps_ns(fixes_s[kept]), positions[kept]),
        lever_arm,
    )


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


def covers(ratios: FloatArray | list[FloatArray]) -> str:
    """Share of errors over their sigmas that the 90 % interval covers."""
    return f"{np.mean(np.abs(ratios) < QUANTILE_90):.0%}"


def simulated_rows(n_seeds: int) -> Iterator[dict[str, object]]:
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
        yield {
            "Machine": name,
            "Recordings": n_seeds,
            "Median error x, y, z (cm)": triple(np.median(np.abs(errors), axis=0), 100.0),
            "Median sigma x, y, z (cm)": triple(np.median(stated, axis=0), 100.0),
            "Covers": covers(ratios[known]),
            "Told unobservable": int((~known).sum()),
        }
    empty = dict.fromkeys(("error", "sigma"), "")
    together = covers(np.concatenate(pooled))
    yield {"Machine": "all", "Recordings": 3 * n_seeds, **empty, "Covers": together, "Told": ""}


def _recordings(data_folder: Path) -> Iterator[tuple[str, Rig, Recording]]:
    """Recordings with a known lever arm by their names on the page."""
    titles = {
        "euroc_stereo": "EuRoC {}, stereo odometry",
        "euroc_mono": "EuRoC {}, mono odometry",
        "simple_kitti": "KITTI {}, lidar odometry",
    }
    rigs = {rig.name: rig for rig in real_rigs(data_folder)[0]}
    for which in (name for name in titles if name in rigs):
        for name, recording in rigs[which].recordings.items():
            yield titles[which].format(name), rigs[which], recording


def recorded_rows(data_folder: Path) -> Iterator[dict[str, object]]:
    """Rows of the table of recordings; sigmas with the common-mode floor."""
    for name, rig, recording in _recordings(data_folder):
        streams = recording.parent, recording.child
        assert rig.truth is not None
        lever_arm, truth_m = rig.truth.T_parent_child[:3, 3], rig.truth.sigmas[0]
        result = hec.calibrate(*streams, child_measures="positions")
        whole = hec.calibrate(*streams, time_offset="estimate", scale="auto")
        error = result.T_parent_child[:3, 3] - lever_arm
        stated = result.sigmas_with_floor[:3]
        yield {
            "Positions against odometry": name,
            "Error x, y, z (mm)": _in_mm(error),
            "In all (mm)": f"{1e3 * np.linalg.norm(error):.0f}",
            "Sigma x, y, z (mm)": _in_mm(stated),
            "Largest error / sigma": f"{np.abs(error / stated).max():.1f}",
            "The same with the truth's sigma": (
                f"{np.abs(error / np.hypot(stated, truth_m)).max():.1f}"
            ),
            "Error of whole poses x, y, z (mm)": _in_mm(whole.T_parent_child[:3, 3] - lever_arm),
        }


def _in_mm(values: FloatArray) -> str:
    return ", ".join(f"{1000 * value:.0f}" if np.isfinite(value) else "-" for value in values)
