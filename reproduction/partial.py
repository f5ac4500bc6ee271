"""``python -m reproduction.partial rates`` or ``positions``: errors of simulated calibrations.

``rates``: rotation of a gyroscope against an odometry. ``positions``: lever arm of an RTK receiver.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence

import numpy as np

import hand_eye_calib as hec
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.offline.cli.main import exit_code_of
from reproduction.coverage import motions
from reproduction.coverage.classes import VIO, slam, stamps_ns
from reproduction.coverage.measures import HALF_WIDTH_90
from reproduction.coverage.sensor_errors import SensorErrors, draw, sigmas
from reproduction.platforms import PLATFORMS
from reproduction.writing import markdown_table, show, study_parser, triple

_Motion = Callable[[np.random.Generator, float], motions.Motion]


# Simulated machines with a receiver.
MACHINES = {
    "car": PLATFORMS["car"],
    "excavator": PLATFORMS["excavator"],
    "hand-held": PLATFORMS["hand"]._replace(duration_s=120.0),
}

# An RTK receiver: rate of its positions (Hz).
_FIXES_HZ = 5.0
# White noise of a position with fixed ambiguities (m).
_FIXED_M = 0.01
# Outages per second, and their shortest and longest duration (s).
_OUTAGES_HZ = 0.2
_OUTAGE_S = (0.5, 1.5)
# Float solutions (ambiguities not fixed) per minute, and their shortest and longest duration (s).
_FLOATS_PER_MIN = 1.0
_FLOAT_S = (5.0, 15.0)
# Error of a float solution (m), and its correlation time (s).
_FLOAT_M = 0.3
_FLOAT_TAU_S = 5.0

# A consumer gyroscope: rate (Hz).
_RATES_HZ = 200.0
# Noise of a sample (rad/s).
_RATE_NOISE = np.radians(0.1)
# Bias (rad/s, 1 sigma), and its random walk (rad/s per root s).
_BIAS = 0.01
_BIAS_WALK = np.radians(0.002)
# Delay of its stamps (s).
_LATE_S = 0.005
# Motion and errors of the odometry, by name.
_TURNING: dict[str, tuple[_Motion, SensorErrors]] = {
    "hand-held, visual-inertial odometry": (motions.hand_held, VIO),
    "hand-held, white noise of 0.2 deg": (
        motions.hand_held,
        SensorErrors(white=sigmas(0.003, 0.2)),
    ),
    "drone, visual-inertial odometry": (motions.drone, VIO),
    "drone, SLAM": (motions.drone, slam(10.0, 0.05, 0.1)),
}


def simulated_positions(
    name: str, seed: int
) -> tuple[Trajectory, Trajectory, FloatArray]:
    """Simulate poses of the odometry, positions of the antenna, and the lever arm (3,)."""
    machine = MACHINES[name]
    seeds = (seed, sorted(MACHINES).index(name))
    generators = np.random.default_rng(seeds).spawn(4)
    motion_rng, mount_rng, odometry_rng, rng = generators
    motion = machine.motion(motion_rng, machine.duration_s)
    lever_arm = machine.lever_m * mount_rng.standard_normal(3) * [1.0, 1.0, 0.7]

    step_s = 1.0 / machine.rate_hz
    n_poses = round(machine.duration_s * machine.rate_hz)
    times_s: FloatArray = step_s * np.arange(n_poses, dtype=np.float64)
    poses = _odometry(machine.odometry, motion, times_s, step_s, odometry_rng)

    n_fixes = round((machine.duration_s - 1.0) * _FIXES_HZ)
    fixes_s: FloatArray = (
        np.arange(n_fixes, dtype=np.float64) + 0.25
    ) / _FIXES_HZ
    Ts = motion.at(fixes_s)
    yaw = mount_rng.uniform(-np.pi, np.pi)
    world = se3.rotation_exp(np.array([0.0, 0.0, yaw]))
    positions = (Ts[:, :3, :3] @ lever_arm + Ts[:, :3, 3]) @ world
    positions += _FIXED_M * rng.standard_normal(positions.shape)
    positions += _float_errors(fixes_s, rng)
    is_received = _received(len(fixes_s), rng)
    stamps = stamps_ns(fixes_s[is_received])
    child = Trajectory.from_positions(stamps, positions[is_received])
    return Trajectory(stamps_ns(times_s), poses), child, lever_arm


def _odometry(
    errors: SensorErrors,
    motion: motions.Motion,
    times_s: FloatArray,
    step_s: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Return the measured poses (N, 4, 4) of a motion."""
    true_poses = motion.at(times_s)
    twists = motion.twists(times_s)
    return draw(errors, true_poses, twists, step_s, rng).poses


def _float_errors(times_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return errors (N, 3) of float solutions; zero where the solution is fixed."""
    errors = np.zeros((len(times_s), 3))
    stay = np.exp(-1.0 / (_FIXES_HZ * _FLOAT_TAU_S))
    change = np.sqrt(1.0 - stay**2)
    end_s = times_s[-1]
    n_floats = round(_FLOATS_PER_MIN * end_s / 60.0)
    starts_s = rng.uniform(0.0, end_s - _FLOAT_S[1], n_floats)
    for start_s in starts_s:
        length_s = rng.uniform(*_FLOAT_S)
        is_float = (times_s >= start_s) & (times_s < start_s + length_s)
        error = rng.standard_normal(3)
        for row in np.flatnonzero(is_float):
            white = 0.1 * rng.standard_normal(3)
            errors[row] = _FLOAT_M * (error + white)
            error = stay * error + change * rng.standard_normal(3)
    return errors


def _received(count: int, rng: np.random.Generator) -> BoolArray:
    """Return whether each position is received (N,), outside of the outages."""
    received = np.ones(count, dtype=bool)
    is_start = rng.random(count) < _OUTAGES_HZ / _FIXES_HZ
    for start in np.flatnonzero(is_start):
        length_s = rng.uniform(*_OUTAGE_S)
        end = start + round(_FIXES_HZ * length_s)
        received[start:end] = False
    return received


def _covers(ratios: FloatArray) -> str:
    """Return the share of errors within the 90 % interval; ``ratios`` are errors in sigmas."""
    is_covered = np.abs(ratios) < HALF_WIDTH_90
    return f"{np.mean(is_covered):.0%}"


def position_rows(n_seeds: int) -> Iterator[dict[str, object]]:
    """Yield the row of each simulated machine with a receiver."""
    for name in MACHINES:
        errors = []
        sigmas = []
        for seed in range(n_seeds):
            parent, child, lever_arm = simulated_positions(name, seed)
            result = hec.calibrate(parent, child)
            errors.append(result.T_parent_child[:3, 3] - lever_arm)
            sigmas.append(result.sigmas_measured[:3])
        ratios = np.array(errors) / np.array(sigmas)
        median_errors = np.median(np.abs(errors), axis=0)
        median_sigmas = np.median(sigmas, axis=0)
        yield {
            "Machine": name,
            "Recordings": n_seeds,
            "Median error x, y, z (cm)": triple(median_errors, 100.0),
            "Median sigma x, y, z (cm)": triple(median_sigmas, 100.0),
            "Covers": _covers(ratios[np.isfinite(sigmas)]),
        }


def simulated_rates(
    name: str, seed: int, duration_s: float = 60.0, rate_hz: float = 20.0
) -> tuple[Trajectory, Trajectory, FloatArray]:
    """Simulate poses of the parent, rates of the child, and the rotation (3, 3) between them."""
    kind, errors = _TURNING[name]
    generators = np.random.default_rng(seed).spawn(4)
    motion_rng, mount_rng, parent_rng, child_rng = generators
    motion = kind(motion_rng, duration_s)
    rotation_vector = mount_rng.uniform(-np.pi, np.pi, 3) / np.sqrt(3)
    rotation = se3.rotation_exp(rotation_vector)
    times_s: FloatArray = np.arange(round(duration_s * rate_hz)) / rate_hz
    poses = _odometry(errors, motion, times_s, 1 / rate_hz, parent_rng)
    parent = Trajectory(stamps_ns(times_s), poses)

    n_rates = round(duration_s * _RATES_HZ)
    fine_s: FloatArray = np.arange(n_rates) / _RATES_HZ
    rates = motion.twists(fine_s)[:, 3:] @ rotation
    rates += _BIAS * child_rng.standard_normal(3)
    rates += _RATE_NOISE * child_rng.standard_normal(rates.shape)
    steps = child_rng.standard_normal(rates.shape) / np.sqrt(_RATES_HZ)
    rates += _BIAS_WALK * np.cumsum(steps, axis=0)
    child = Trajectory.from_rates(stamps_ns(fine_s - _LATE_S), rates)
    return parent, child, rotation


def rate_rows(n_seeds: int) -> Iterator[dict[str, object]]:
    """Yield the row of each motion with a gyroscope."""
    for name in _TURNING:
        angles = []
        ratios = []
        offsets = []
        for seed in range(n_seeds):
            parent, child, rotation = simulated_rates(name, seed)
            result = hec.calibrate(parent, child)
            error = se3.rotation_log(rotation @ result.T_parent_child[:3, :3].T)
            angles.append(np.degrees(np.linalg.norm(error)))
            ratios.append(error / result.sigmas_measured[3:])
            offsets.append(abs(result.time_offset_s - _LATE_S))
        yield {
            "Motion, poses from": name,
            "Recordings": n_seeds,
            "Median error (deg)": f"{np.median(angles):.3f}",
            "Largest (deg)": f"{np.max(angles):.3f}",
            "Covers": _covers(np.array(ratios)),
            "Offset, median error (ms)": f"{1e3 * np.median(offsets):.2f}",
        }


def run(arguments: argparse.Namespace) -> int:
    """Print the table, and return the exit code."""
    if arguments.what == "rates":
        tables = {"rates": markdown_table(rate_rows(arguments.seeds))}
    else:
        tables = {"receivers": markdown_table(position_rows(arguments.seeds))}
    show(arguments.page, tables)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study, and return the exit code."""
    parser = study_parser("reproduction.partial", __doc__)
    parser.add_argument("what", choices=("rates", "positions"))
    parser.add_argument(
        "--seeds",
        type=int,
        default=40,
        help="recordings of each row. Default: 40",
    )
    return exit_code_of(lambda: run(parser.parse_args(argv)))


if __name__ == "__main__":
    raise SystemExit(main())
