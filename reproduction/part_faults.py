"""Deliberate faults of streams of positions, rates or rotations alone, on simulated machines.

``python -m reproduction.part_faults positions --seeds 3`` prints a row for each fault: how often a
finding names the fault, the verdicts, and the number of USE results with an error above 3.3
standard deviations (with the allowance).
"""

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

import hand_eye_calib as hec
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.offline.cli.main import exit_code_of
from reproduction import fault_counts
from reproduction.coverage.classes import stamps_ns
from reproduction.platforms import PLATFORMS, TARGETS, generators_of
from reproduction.writing import (
    add_seed_options,
    markdown_table,
    seeds_of,
    study_parser,
)

# Rate (Hz) of the simulated paths and angular rates before a sensor samples them.
_FINE_HZ = 200.0

# Targets (m, rad) so wide that verdicts do not depend on the accuracy.
WIDE: Mapping[str, Any] = {"target_translation": 0.3, "target_rotation": 0.0175}

# A consumer gyroscope: bias (rad/s, 1 sigma).
_BIAS = 0.01
# Noise of a sample (rad/s).
_RATE_NOISE = np.radians(0.1)
# Random walk of the bias (rad/s per root s).
_BIAS_WALK = np.radians(0.002)
# Delay of its stamps (s).
_LATE_S = 0.005
# Steps of a coarse gyroscope (rad/s).
_RATE_STEP = np.radians(2.0)

# Rotation vector (rad) by which a mount moves.
_TURNED = np.radians(2.0) * np.array([0.6, 0.48, 0.64])

# Error (m) of a wrong lever arm in the TF tree.
_WRONG_BY_M = np.array([0.3, -0.2, 0.4])


class Recording(NamedTuple):
    """Streams, and the lever arm (3,) or the rotation (3, 3) between them."""

    parent: Trajectory
    child: Trajectory
    truth: FloatArray


_Random: TypeAlias = np.random.Generator


def _fine_times(duration_s: float) -> FloatArray:
    """Return times (N,) from 0 at the fine rate, s."""
    n_times = round(duration_s * _FINE_HZ)
    return np.arange(n_times) / _FINE_HZ


def _unchanged(values: FloatArray) -> FloatArray:
    return values


def _low_passed(values: FloatArray, tau_s: float = 0.2) -> FloatArray:
    """Apply a first-order low-pass filter to values (N, k) at the fine rate."""
    step_s = 1.0 / _FINE_HZ
    share = step_s / (tau_s + step_s)
    rest = 1.0 - share
    start = rest * values[:1]
    filtered, _ = lfilter([share], [1.0, -rest], values, axis=0, zi=start)
    return np.asarray(filtered)


def _smoothed(values: FloatArray) -> FloatArray:
    sigma = 0.25 * _FINE_HZ
    return gaussian_filter1d(values, sigma, 0, mode="nearest")


def _with_heights(positions: FloatArray, heights: FloatArray) -> FloatArray:
    result = positions.copy()
    result[:, 2] = heights
    return result


def _barometric(path: FloatArray) -> FloatArray:
    heights = _low_passed(path[:, 2:], 1.0)
    return _with_heights(path, heights[:, 0])


def _height_late(path: FloatArray) -> FloatArray:
    times_s = np.arange(len(path)) / _FINE_HZ
    heights = np.interp(times_s - 0.3, times_s, path[:, 2])
    return _with_heights(path, heights)


# Effect of each fault on the path (N, 3) of an antenna at the fine rate, before it is sampled.
_OF_PATH: Mapping[str, Callable[[FloatArray], FloatArray]] = {
    "clean": _unchanged,
    "delayed 150 ms": _unchanged,
    "low-passed 200 ms": _low_passed,
    "smoothed 250 ms": _smoothed,
    "1 Hz interpolated": _unchanged,
    "constant height": _unchanged,
    "barometric height": _barometric,
    "height in feet": lambda path: path * [1.0, 1.0, 3.28084],
    "height 300 ms late": _height_late,
    "Web Mercator": lambda path: path / np.cos(np.radians(51.0)),
    "UTM": lambda path: path * 0.9996,
    "scale 1.05": lambda path: path * 1.05,
    "steps of 10 cm": _unchanged,
}


def _with_pressure_drift(
    positions: FloatArray, rate_hz: float, random: _Random
) -> FloatArray:
    """Add a random walk of 0.3 m per root minute to the heights."""
    steps = random.standard_normal(len(positions))
    drift = 0.3 * np.cumsum(steps) / (60 * rate_hz) ** 0.5
    return _with_heights(positions, positions[:, 2] + drift)


# Effect of some faults on measured positions (N, 3); the second argument is their rate (Hz).
_OF_POSITIONS: Mapping[
    str, Callable[[FloatArray, float, _Random], FloatArray]
] = {
    "1 Hz interpolated": lambda positions, hz, _: _interpolated(
        positions, round(hz)
    ),
    "constant height": lambda positions, hz, _: positions * [1.0, 1.0, 0.0],
    "barometric height": _with_pressure_drift,
    "steps of 10 cm": lambda positions, hz, _: np.round(positions / 0.1) * 0.1,
}

# Pose of a world in another world.
_OTHER_WORLD = se3.exp(np.array([3.0, 4.0, 1.0, 0.1, 0.2, 2.0]))


def _beside(stream: Trajectory, translations: FloatArray) -> Trajectory:
    """Return the poses of a sensor at translations (3,) or (N, 3) in the frame of ``stream``."""
    mounts = se3.from_rotation_translation(np.eye(3), translations)
    return replace(stream, poses=stream.poses @ mounts)


# Streams whose positions are computed from the poses of the other sensor. The arguments are the
# stream of poses, the lever arm (3,) and a generator.
_COPIES: Mapping[
    str, Callable[[Trajectory, FloatArray, _Random], Trajectory]
] = {
    "copied": lambda parent, lever_arm, _: parent,
    "copied with noise": lambda parent, lever_arm, random: _beside(
        parent, 0.003 * random.standard_normal((len(parent), 3))
    ),
    "copied, resampled": lambda parent, lever_arm, _: _resampled(parent, 7.0),
    "copied, world turned": lambda parent, lever_arm, _: replace(
        parent, poses=_OTHER_WORLD @ parent.poses
    ),
    "computed with a wrong lever arm": lambda parent, lever_arm, _: _beside(
        parent, lever_arm + _WRONG_BY_M
    ),
}

OF_POSITIONS = (*_OF_PATH, *_COPIES)


def _interpolated(positions: FloatArray, stride: int) -> FloatArray:
    """Keep every ``stride``-th position, and interpolate between them."""
    rows = np.arange(len(positions))
    columns = [
        np.interp(rows, rows[::stride], column[::stride])
        for column in positions.T
    ]
    return np.column_stack(columns)


def _resampled(stream: Trajectory, rate_hz: float) -> Trajectory:
    step_ns = round(1e9 / rate_hz)
    wanted_ns = np.arange(
        stream.stamps_ns[0] + step_ns // 3, stream.stamps_ns[-1], step_ns
    )
    return Trajectory(wanted_ns, stream.at(wanted_ns))


def positions(platform: str, fault: str, seed: int) -> Recording:
    """Simulate poses of an odometry, and positions of an antenna with a fault.

    ``fault`` is an entry of :data:`OF_POSITIONS`.
    """
    kind = PLATFORMS[platform]
    generators = generators_of(platform, seed, 77)
    motion_rng, mount_rng, odometry_rng, random = generators
    motion = kind.motion(motion_rng, kind.duration_s)
    lever_arm = kind.lever_m * mount_rng.standard_normal(3) * [1.0, 1.0, 0.7]
    parent = kind.measured(motion, odometry_rng)
    if fault in _COPIES:
        copy = _COPIES[fault](parent, lever_arm, random)
        child = Trajectory.from_positions(
            copy.stamps_ns, copy.poses[:, :3, 3], "antenna", "map"
        )
        return Recording(parent, child, lever_arm)
    fine_s = _fine_times(kind.duration_s - 1.0)
    Ts = motion.at(fine_s)
    yaw = mount_rng.uniform(-np.pi, np.pi)
    world = se3.rotation_exp(np.array([0.0, 0.0, yaw]))
    path = (Ts[:, :3, :3] @ lever_arm + Ts[:, :3, 3]) @ world
    stride = round(_FINE_HZ / kind.positions_hz)
    taken = np.arange(stride // 4, len(fine_s), stride)
    measured = _OF_PATH[fault](path)[taken]
    measured = measured + kind.noise_m * random.standard_normal(measured.shape)
    if fault in _OF_POSITIONS:
        measured = _OF_POSITIONS[fault](measured, kind.positions_hz, random)
    late_s = 0.15 if fault == "delayed 150 ms" else 0.0
    stamps = stamps_ns(fine_s[taken] + late_s)
    return Recording(
        parent,
        Trajectory.from_positions(stamps, measured, "antenna", "map"),
        lever_arm,
    )


def _misaligned(rates: FloatArray) -> FloatArray:
    matrix = np.eye(3)
    matrix[0] = np.cos(np.radians(3.0)), np.sin(np.radians(3.0)), 0.0
    return rates @ matrix.T


def _moved(values: FloatArray) -> FloatArray:
    """Return rates (N, 3) or orientations (N, 3, 3) of a sensor whose mount moves half-way."""
    half = len(values) // 2
    later = values[half:] @ se3.rotation_exp(_TURNED)
    return np.concatenate([values[:half], later])


def _clipped(rates: FloatArray) -> FloatArray:
    limit = 0.6 * np.abs(rates).max()
    return np.clip(rates, -limit, limit)


def _stepped(rates: FloatArray) -> FloatArray:
    return np.round(rates / _RATE_STEP) * _RATE_STEP


# Effect of each fault on the true rates (N, 3) of a gyroscope.
_OF_RATES: Mapping[str, Callable[[FloatArray], FloatArray]] = {
    "clean": _unchanged,
    "own rates": _unchanged,
    "copied, turned": _unchanged,
    "axis misaligned 3 deg": _misaligned,
    "gain of an axis 1.03": lambda rates: rates * [1.03, 1.0, 1.0],
    "delayed 100 ms": _unchanged,
    "mount moved 2 deg": _moved,
    "two axes swapped": lambda rates: rates[:, [1, 0, 2]],
    "sign of an axis": lambda rates: rates * [-1.0, 1.0, 1.0],
    "bias walks": _unchanged,
    "low-passed 200 ms": lambda rates: _low_passed(rates, 0.2),
    "smoothed 250 ms": _smoothed,
    "clipped": _unchanged,
    "steps of 2 deg/s": _unchanged,
    "degrees": np.degrees,
}

# Effect of some faults on measured rates (N, 3), which have bias and noise.
_OF_MEASURED_RATES: Mapping[str, Callable[[FloatArray], FloatArray]] = {
    "clipped": _clipped,
    "steps of 2 deg/s": _stepped,
}

OF_RATES = tuple(_OF_RATES)


def rates(platform: str, fault: str, seed: int) -> Recording:
    """Simulate poses of an odometry, and rates of a gyroscope with a fault.

    ``fault`` is an entry of :data:`OF_RATES`.
    """
    kind = PLATFORMS[platform]
    generators = generators_of(platform, seed, 78)
    motion_rng, mount_rng, odometry_rng, random = generators
    motion = kind.motion(motion_rng, kind.duration_s)
    rotation = se3.rotation_exp(mount_rng.uniform(-1.7, 1.7, 3))
    parent = kind.measured(motion, odometry_rng)
    if fault == "copied, turned":
        return Recording(parent, _differentiated(parent, rotation), rotation)
    fine_s = _fine_times(kind.duration_s)
    parent_rates = motion.twists(fine_s)[:, 3:]
    is_of_parent = fault == "own rates"
    true_rates = parent_rates if is_of_parent else parent_rates @ rotation
    measured = _OF_RATES[fault](true_rates)
    measured = measured + _BIAS * random.standard_normal(3)
    measured += _RATE_NOISE * random.standard_normal(measured.shape)
    walk = _BIAS_WALK * (30.0 if fault == "bias walks" else 1.0)
    steps = random.standard_normal(measured.shape) / np.sqrt(_FINE_HZ)
    measured += walk * np.cumsum(steps, axis=0)
    if fault in _OF_MEASURED_RATES:
        measured = _OF_MEASURED_RATES[fault](measured)
    late_s = 0.1 if fault == "delayed 100 ms" else _LATE_S
    child = Trajectory.from_rates(stamps_ns(fine_s - late_s), measured, "imu")
    return Recording(parent, child, rotation)


def _differentiated(parent: Trajectory, rotation: FloatArray) -> Trajectory:
    """Return rates that are the derivatives of the parent's orientations.

    The orientations are first turned by ``rotation``, as by a static transform of a TF tree.
    """
    orientations = se3.rotation_of(parent.poses) @ rotation
    steps = se3.rotations_between(orientations[:-1], orientations[1:])
    stamps_ns = parent.stamps_ns
    intervals_s = np.diff(stamps_ns) * 1e-9
    middles_ns = (stamps_ns[:-1] + stamps_ns[1:]) // 2
    return Trajectory.from_rates(
        middles_ns, steps / intervals_s[:, None], "imu"
    )


# An attitude sensor: rate (Hz).
_ATTITUDE_HZ = 50.0
# White noise of its orientations (rad).
_ATTITUDE_NOISE = np.radians(0.1)
# Drift of its orientations (rad per root s).
_ATTITUDE_WALK = np.radians(0.02)


def _yaws(rotations: FloatArray) -> FloatArray:
    sines = rotations[:, 1, 0]
    cosines = rotations[:, 0, 0]
    return np.arctan2(sines, cosines)


def _about_z(angles: FloatArray) -> FloatArray:
    vectors = angles[:, None] * [0.0, 0.0, 1.0]
    return se3.rotation_exp(vectors)


def _with_yaw_gain(rotations: FloatArray) -> FloatArray:
    excess = 0.05 * np.unwrap(_yaws(rotations))
    return _about_z(excess) @ rotations


def _filtered(
    rotations: FloatArray, low_pass: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Filter the entries of rotation matrices (N, 3, 3)."""
    flat = low_pass(rotations.reshape(-1, 9))
    return se3.nearest_rotation(flat.reshape(-1, 3, 3))


def _reordered(rotations: FloatArray) -> FloatArray:
    quats_xyzw = Rotation.from_matrix(rotations).as_quat()
    quats_wxyz = np.roll(quats_xyzw, 1, axis=1)
    return Rotation.from_quat(quats_wxyz).as_matrix()


# Effect of each fault on the true orientations (N, 3, 3) of an attitude sensor, at the fine rate.
_OF_ROTATIONS: Mapping[str, Callable[[FloatArray], FloatArray]] = {
    "clean": _unchanged,
    "copied": _unchanged,
    "copied, turned": _unchanged,
    "delayed 100 ms": _unchanged,
    "low-passed 200 ms": lambda rotations: _filtered(rotations, _low_passed),
    "smoothed 250 ms": lambda rotations: _filtered(rotations, _smoothed),
    "mount moved 2 deg": _moved,
    "inverse": lambda rotations: np.swapaxes(rotations, 1, 2),
    "order w x y z": _reordered,
    "yaw only": lambda rotations: _about_z(_yaws(rotations)),
    "yaw gain 1.05": _with_yaw_gain,
    "yaw wanders": _unchanged,
    "steps of 1 deg": _unchanged,
}

OF_ROTATIONS = tuple(_OF_ROTATIONS)


def rotations(platform: str, fault: str, seed: int) -> Recording:
    """Simulate poses of an odometry, and orientations of an attitude sensor with a fault.

    ``fault`` is an entry of :data:`OF_ROTATIONS`.
    """
    kind = PLATFORMS[platform]
    generators = generators_of(platform, seed, 79)
    motion_rng, mount_rng, odometry_rng, random = generators
    motion = kind.motion(motion_rng, kind.duration_s)
    mount = se3.rotation_exp(mount_rng.uniform(-1.7, 1.7, 3))
    parent = kind.measured(motion, odometry_rng)
    if fault.startswith("copied"):
        turned = mount if fault == "copied, turned" else np.eye(3)
        poses = parent.poses @ se3.from_rotation_translation(
            turned, np.zeros(3)
        )
        return Recording(
            parent,
            Trajectory(parent.stamps_ns, poses, "ahrs", "", "rotations"),
            mount,
        )
    fine_s = _fine_times(kind.duration_s - 1.0)
    own = motion.at(fine_s)[:, :3, :3] @ mount
    stride = round(_FINE_HZ / _ATTITUDE_HZ)
    measured = _OF_ROTATIONS[fault](own)[::stride]
    drift = (
        np.cumsum(random.standard_normal((len(measured), 3)), axis=0)
        / _ATTITUDE_HZ**0.5
    )
    walk = _ATTITUDE_WALK * np.ones(3)
    noise = _ATTITUDE_NOISE * random.standard_normal((len(measured), 3))
    if fault == "yaw wanders":
        walk[2] *= 30.0
    if fault == "yaw only":
        walk[:2] = 0.0
        noise[:, :2] = 0.0
    measured = (
        se3.rotation_exp(walk * drift) @ measured @ se3.rotation_exp(noise)
    )
    if fault == "steps of 1 deg":
        vectors = Rotation.from_matrix(measured).as_euler("ZYX", degrees=True)
        measured = Rotation.from_euler(
            "ZYX", np.round(vectors), degrees=True
        ).as_matrix()
    late_s = 0.1 if fault == "delayed 100 ms" else _LATE_S
    poses = se3.from_rotation_translation(measured, np.zeros(3))
    child = Trajectory(
        stamps_ns(fine_s[::stride] + late_s), poses, "ahrs", "", "rotations"
    )
    return Recording(parent, child, mount)


KINDS = {
    "positions": (positions, OF_POSITIONS),
    "rates": (rates, OF_RATES),
    "rotations": (rotations, OF_ROTATIONS),
}

# Codes of the findings that name a fault. Faults without a code are estimated or harmless.
_NAMED: Mapping[str, Mapping[str, str]] = {
    "positions": {
        "low-passed 200 ms": "smoothed_positions",
        "smoothed 250 ms": "smoothed_positions",
        "1 Hz interpolated": "interpolated",
        "constant height": "axis_scale",
        "barometric height": "axis_lag axis_scale",
        "height in feet": "axis_scale",
        "height 300 ms late": "axis_lag",
        "Web Mercator": "scale",
        "scale 1.05": "scale",
        "steps of 10 cm": "coarse_positions",
        **dict.fromkeys(_COPIES, "same_position not_independent"),
    },
    "rates": {
        "own rates": "same_frame",
        "copied, turned": "not_independent",
        "axis misaligned 3 deg": "misaligned",
        "gain of an axis 1.03": "rotation_gain",
        "mount moved 2 deg": "mount_moved",
        "two axes swapped": "left_handed",
        "sign of an axis": "left_handed",
        "bias walks": "bias_drift",
        "low-passed 200 ms": "smoothed_rates",
        "smoothed 250 ms": "smoothed_rates",
        "clipped": "clipped_rates",
        "steps of 2 deg/s": "coarse_rates",
        "degrees": "rate_unit",
    },
    "rotations": {
        "copied": "same_frame",
        "copied, turned": "not_independent",
        "low-passed 200 ms": "smoothed_orientations",
        "smoothed 250 ms": "smoothed_orientations",
        "mount moved 2 deg": "mount_moved",
        "inverse": "inverse_orientation",
        "order w x y z": "inverse_orientation",
        "yaw only": "flat",
        "yaw gain 1.05": "rotation_gain",
        "steps of 1 deg": "coarse_orientations",
    },
}

# Target that a person would set for rates and rotations of machines that turn slowly (deg).
_SLOW_TARGET_DEG = 0.5
# The same for other machines (deg).
_TARGET_DEG = 0.3
# Machines that turn slowly.
_SLOW = ("excavator", "agv")


def options_of(kind: str, platform: str) -> dict[str, Any]:
    """Return the targets of a calibration, as a person would set them."""
    if kind == "positions":
        metres, _ = TARGETS[platform]
        return {"target_translation": metres}
    degrees = _SLOW_TARGET_DEG if platform in _SLOW else _TARGET_DEG
    return {"target_rotation": float(np.radians(degrees))}


def largest_ratio(kind: str, result: Calibration, truth: FloatArray) -> float:
    """Return the largest ratio of an error to its standard deviation over the known axes.

    The standard deviation includes the allowance for constant errors.
    """
    T = result.T_parent_child
    if kind == "positions":
        errors = se3.translation_of(T) - truth
        return fault_counts.largest_ratio(errors, result.sigmas[:3])
    errors = se3.rotation_log(truth @ se3.rotation_of(T).T)
    return fault_counts.largest_ratio(errors, result.sigmas[3:])


def rows(kind: str, seeds: Sequence[int]) -> Iterator[dict[str, object]]:
    """Yield the row of each fault of a kind of streams."""
    make, faults = KINDS[kind]
    for fault in faults:
        names = set(_NAMED[kind].get(fault, "").split())
        tally = fault_counts.Tally()
        for platform in PLATFORMS:
            options = options_of(kind, platform)
            for seed in seeds:
                recording = make(platform, fault, seed)
                result = hec.calibrate(
                    recording.parent, recording.child, **options
                )
                ratio = largest_ratio(kind, result, recording.truth)
                tally.add(result, ratio, names)
        named = f"({tally.n_with_findings} findings)"
        if names:
            named = f"{tally.n_named} of {tally.verdicts.total()}"
        yield {
            "Fault": fault,
            "Finding": " or ".join(sorted(names)) or "none",
            "Named": named,
            **tally.verdict_cells(),
            **tally.error_cells(),
        }


def run(arguments: argparse.Namespace) -> int:
    """Print the table, and return the exit code."""
    seeds = seeds_of(arguments)
    print(markdown_table(rows(arguments.kind, seeds)))
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study, and return the exit code."""
    parser = study_parser("reproduction.part_faults", __doc__)
    parser.add_argument("kind", choices=tuple(KINDS))
    add_seed_options(parser, 2)
    return exit_code_of(lambda: run(parser.parse_args(argv)))


if __name__ == "__main__":
    raise SystemExit(main())
