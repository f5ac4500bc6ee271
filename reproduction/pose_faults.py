"""Deliberate faults of two streams of poses: sampling, prediction, and one stream that depends on
the other, on simulated machines.

``python -m reproduction.pose_faults --seeds 3`` prints a row for each fault: verdicts, findings,
and the number of USE results with an error above 3.3 standard deviations (with the allowance).
"""

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np

import hand_eye_calib as hec
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.offline.cli.main import exit_code_of
from reproduction import fault_counts
from reproduction.coverage.classes import LIDAR_ODOMETRY, VIO, stamps_ns
from reproduction.coverage.sensor_errors import SensorErrors, draw, sigmas
from reproduction.platforms import PLATFORMS, TARGETS, generators_of
from reproduction.writing import (
    add_seed_options,
    counted,
    markdown_table,
    seeds_of,
    study_parser,
)

_CAMERA = SensorErrors(white=sigmas(0.001, 0.04), walk=sigmas(0.006, 0.05))
_STEREO = SensorErrors(
    white=sigmas(0.004, 0.02), walk_by_metre=sigmas(0.004, 0.01)
)

# Odometry of the child of each platform, and its rate (Hz).
_CHILDREN: Mapping[str, tuple[SensorErrors, float]] = {
    "car": (_STEREO, 10.0),
    "excavator": (VIO, 20.0),
    "hand": (_CAMERA, 20.0),
    "drone": (_CAMERA, 20.0),
    "drone_slam": (VIO, 20.0),
    "agv": (LIDAR_ODOMETRY, 10.0),
}

# Error of the mount (8 cm and 3.5 deg) that a computed or corrected stream assumes.
_WRONG_MOUNT = se3.exp(
    np.array(
        [0.05, -0.05, 0.04, *(np.radians(3.5) * np.array([0.6, -0.48, 0.64]))]
    )
)

# Standard deviations of the biases of an IMU: m/s^2 and rad/s.
_IMU_BIAS = np.repeat([0.9, np.radians(1.5)], 3)
# Time over which a velocity is estimated (s).
_VELOCITY_S = 0.1
# Shortest time between two stamps of arrival (s).
_TOGETHER_S = 0.0008


class Streams(NamedTuple):
    """Streams on one clock, and the extrinsic (4, 4) between them."""

    parent: Trajectory
    child: Trajectory
    T_parent_child: FloatArray


_Random: TypeAlias = np.random.Generator
_Damage: TypeAlias = Callable[[Streams, _Random], Streams]


def clean(platform: str, seed: int) -> Streams:
    """Simulate two independent odometries of a platform, with different stamps."""
    kind = PLATFORMS[platform]
    generators = generators_of(platform, seed, 902)
    motion_rng, mount_rng, parent_rng, child_rng = generators
    motion = kind.motion(motion_rng, kind.duration_s)
    rotation = se3.rotation_exp(mount_rng.uniform(-1.7, 1.7, 3))
    lever_arm = kind.lever_m * mount_rng.standard_normal(3) * [1.0, 1.0, 0.7]
    X = se3.from_rotation_translation(rotation, lever_arm)
    errors, rate_hz = _CHILDREN[platform]
    # Time (s) at the start and at the end in which only the parent has poses.
    margin_s = 0.3 + 0.37 / rate_hz

    def measured(
        errors: SensorErrors,
        hz: float,
        mount: FloatArray,
        start_s: float,
        rng: _Random,
    ) -> Trajectory:
        length_s = kind.duration_s - 1.0 - 2.0 * start_s
        n_poses = round(length_s * hz)
        times_s: FloatArray = start_s + np.arange(n_poses) / hz
        to_sensor = se3.adjoint(se3.inverse(mount))
        twists = motion.twists(times_s) @ to_sensor.T
        poses = motion.at(times_s) @ mount
        drawn = draw(errors, poses, twists, 1.0 / hz, rng)
        return Trajectory(stamps_ns(times_s), drawn.poses)

    parent = measured(kind.odometry, kind.rate_hz, np.eye(4), 0.0, parent_rng)
    child = measured(errors, rate_hz, X, margin_s, child_rng)
    return Streams(parent, child, X)


def _posed(streams: Streams, child: FloatArray) -> Streams:
    return streams._replace(child=replace(streams.child, poses=child))


def interpolated(rate_hz: float) -> _Damage:
    """Sample the child's positions at a lower rate, and interpolate them to its stamps."""

    def damage(streams: Streams, _: _Random) -> Streams:
        poses = streams.child.poses.copy()
        rows = np.arange(len(poses))
        interval_s = streams.child.interval_s
        stride = max(round(1.0 / (rate_hz * interval_s)), 2)
        measured = rows[::stride]
        for axis in range(3):
            values = poses[measured, axis, 3]
            poses[:, axis, 3] = np.interp(rows, measured, values)
        return _posed(streams, poses)

    return damage


def at_constant_velocity(fix_hz: float) -> _Damage:
    """Predict the child's poses at constant velocity between measured poses (``fix_hz``)."""

    def damage(streams: Streams, _: _Random) -> Streams:
        poses = streams.child.poses
        interval_s = streams.child.interval_s
        stride = round(1.0 / (fix_hz * interval_s))
        n_velocity = round(_VELOCITY_S / interval_s)
        rows = np.arange(len(poses))
        since_fix = rows % stride
        fixes = rows - since_fix
        before = np.maximum(fixes - n_velocity, 0)
        n_steps = np.maximum(fixes - before, 1)
        twists = se3.log(se3.inverse(poses[before]) @ poses[fixes])
        twists /= n_steps[:, None]
        predicted = se3.exp(twists * since_fix[:, None])
        return _posed(streams, poses[fixes] @ predicted)

    return damage


def by_imu(fix_hz: float) -> _Damage:
    """Predict the child's poses by an IMU with biases between measured poses (``fix_hz``)."""

    def damage(streams: Streams, random: _Random) -> Streams:
        bias = _IMU_BIAS * random.standard_normal(6)
        interval_s = streams.child.interval_s
        rows = np.arange(len(streams.child))
        stride = round(1.0 / (fix_hz * interval_s))
        since_s = (rows % stride)[:, None] * interval_s
        translations = 0.5 * bias[:3] * since_s**2
        rotations = bias[3:] * since_s
        errors = np.concatenate([translations, rotations], axis=1)
        return _posed(streams, streams.child.poses @ se3.exp(errors))

    return damage


def late(scatter_s: float) -> _Damage:
    """Stamp the child's poses with their arrival: exponential delays, order kept."""

    def damage(streams: Streams, random: _Random) -> Streams:
        count = len(streams.child)
        delays_s = random.exponential(scatter_s, count)
        delays_ns = np.round(1e9 * delays_s).astype(np.int64)
        arrival_ns = streams.child.stamps_ns + delays_ns
        # Stamps increase by at least the shortest time between two.
        interval_ns = round(1e9 * _TOGETHER_S)
        least_ns = interval_ns * np.arange(count)
        stamps_ns = np.maximum.accumulate(arrival_ns - least_ns) + least_ns
        child = replace(streams.child, stamps_ns=stamps_ns)
        return streams._replace(child=child)

    return damage


def computed(noise_m: float) -> _Damage:
    """Compute the child from the parent through a wrong mount, and add noise."""

    def damage(streams: Streams, random: _Random) -> Streams:
        poses = streams.parent.at(streams.child.stamps_ns, straight=True)
        noise = noise_m * random.standard_normal((len(poses), 6))
        noise[:, 3:] *= 0.5
        sensor_poses = poses @ streams.T_parent_child @ _WRONG_MOUNT
        return _posed(streams, sensor_poses @ se3.exp(noise))

    return damage


def _filtered(stream: Trajectory, aims: FloatArray, tau_s: float) -> Trajectory:
    """Correct the poses of a stream towards the poses ``aims`` (N, 4, 4) by a filter."""
    gain = 1.0 - np.exp(-stream.interval_s / tau_s)
    steps = se3.inverse(stream.poses[:-1]) @ stream.poses[1:]
    poses = [aims[0]]
    for step, aim in zip(steps, aims[1:], strict=True):
        predicted = poses[-1] @ step
        innovation = se3.log(se3.inverse(predicted) @ aim)
        correction = se3.exp(gain * innovation)
        poses.append(predicted @ correction)
    return replace(stream, poses=np.array(poses))


def fused(tau_s: float) -> _Damage:
    """Correct the child by the parent through a wrong mount."""

    def damage(streams: Streams, _: _Random) -> Streams:
        aims = streams.parent.at(streams.child.stamps_ns)
        aims = aims @ streams.T_parent_child @ _WRONG_MOUNT
        return streams._replace(child=_filtered(streams.child, aims, tau_s))

    return damage


class _Fault(NamedTuple):
    """A fault: the function that damages streams, and the codes of findings that name the fault."""

    damage: _Damage
    codes: frozenset[str]


_INTERPOLATED = frozenset({"interpolated"})
_PROPAGATED = frozenset({"propagated"})
_ARRIVAL = frozenset({"arrival"})
_DEPENDENT = frozenset({"not_independent"})

FAULTS: Mapping[str, _Fault] = {
    "positions at 1 Hz interpolated": _Fault(interpolated(1.0), _INTERPOLATED),
    "positions at 2 Hz interpolated": _Fault(interpolated(2.0), _INTERPOLATED),
    "positions at 5 Hz interpolated": _Fault(interpolated(5.0), _INTERPOLATED),
    "predicted at constant velocity, 2 Hz": _Fault(
        at_constant_velocity(2.0), _PROPAGATED
    ),
    "predicted by an IMU, 1 Hz": _Fault(by_imu(1.0), _PROPAGATED),
    "predicted by an IMU, 2 Hz": _Fault(by_imu(2.0), _PROPAGATED),
    "stamps of arrival, 30 ms": _Fault(late(0.03), _ARRIVAL),
    "computed from the parent": _Fault(computed(0.0), _DEPENDENT),
    "computed, noise of 3 mm": _Fault(computed(0.003), _DEPENDENT),
    "corrected by the parent, 0.3 s": _Fault(fused(0.3), _DEPENDENT),
    "corrected by the parent, 2 s": _Fault(fused(2.0), _DEPENDENT),
}


def faulty(platform: str, fault: str, seed: int) -> Streams:
    """Simulate streams with a fault of :data:`FAULTS`, or without a fault ("clean")."""
    streams = clean(platform, seed)
    if fault == "clean":
        return streams
    random = np.random.default_rng((seed, 903))
    return FAULTS[fault].damage(streams, random)


def largest_ratio(result: Calibration, truth: FloatArray) -> float:
    """Return the largest ratio of an error to its standard deviation over the known axes.

    The standard deviation includes the allowance for constant errors.
    """
    errors = se3.deviation(result.T_parent_child, truth)
    return fault_counts.largest_ratio(errors, result.sigmas)


def rows(
    faults: Sequence[str], seeds: Sequence[int]
) -> Iterator[dict[str, object]]:
    """Yield the row of each fault."""
    for fault in faults:
        names = FAULTS[fault].codes if fault in FAULTS else frozenset()
        tally = fault_counts.Tally()
        for platform, (metres, degrees) in TARGETS.items():
            for seed in seeds:
                streams = faulty(platform, fault, seed)
                result = hec.calibrate(
                    streams.parent,
                    streams.child,
                    target_translation=metres,
                    target_rotation=float(np.radians(degrees)),
                )
                ratio = largest_ratio(result, streams.T_parent_child)
                tally.add(result, ratio, names)
        yield {
            "Fault": fault,
            "Named": f"{tally.n_named} of {tally.verdicts.total()}",
            **tally.verdict_cells(),
            "Findings": counted(tally.codes.elements()),
            **tally.error_cells(),
        }


def run(arguments: argparse.Namespace) -> int:
    """Print the table, and return the exit code."""
    seeds = seeds_of(arguments)
    print(markdown_table(rows(arguments.faults or ["clean", *FAULTS], seeds)))
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study, and return the exit code."""
    parser = study_parser("reproduction.pose_faults", __doc__)
    parser.add_argument(
        "faults", nargs="*", help="faults of the table. Default: all"
    )
    add_seed_options(parser, 1)
    return exit_code_of(lambda: run(parser.parse_args(argv)))


if __name__ == "__main__":
    raise SystemExit(main())
