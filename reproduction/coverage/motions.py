"""Motions of a rigid body with two sensors: hand-held, car, AGV, drone, robot arm."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3

# Motions are made at this rate (Hz) and interpolated from there.
_RATE = 100.0
_MARGIN_S = 0.5


@dataclass(frozen=True)
class Motion:
    """Poses of a body (N, 4, 4) in a fixed frame on a regular grid, from ``-_MARGIN_S`` on."""

    poses: FloatArray

    def at(self, times_s: FloatArray) -> FloatArray:
        """Return poses (M, 4, 4) at times (M,), s, interpolated between the poses of the grid."""
        rows = (np.asarray(times_s) + _MARGIN_S) * _RATE
        k = np.clip(rows.astype(int), 0, len(self.poses) - 2)
        share = rows - k
        return se3.interpolate(self.poses[k], self.poses[k + 1], share)

    def twists(self, times_s: FloatArray) -> FloatArray:
        """Return twists (M, 6) in the body's frame at times (M,), s: m/s and rad/s."""
        step_s = 1.0 / _RATE
        before = self.at(times_s - step_s)
        after = self.at(times_s + step_s)
        steps = se3.inverse(before) @ after
        return se3.log(steps) / (2.0 * step_s)


# Interval of the ramps (s) of a vehicle that follows the advice of the node.
RAMP_PERIOD_S = 31.0


def _grid(duration_s: float) -> FloatArray:
    length_s = duration_s + 2 * _MARGIN_S
    n_rows = round(length_s * _RATE) + 1
    return np.arange(n_rows) / _RATE - _MARGIN_S


def _waves(
    rng: np.random.Generator,
    times: FloatArray,
    columns: int,
    band_hz: tuple[float, float],
    waves: int = 6,
) -> FloatArray:
    """Draw sums of sines (N, columns) with standard deviation 1.

    The frequencies are log-uniform in a band.
    """
    lowest_hz, highest_hz = band_hz
    shape = (waves, columns)
    frequencies = lowest_hz * (highest_hz / lowest_hz) ** rng.random(shape)
    phases = rng.uniform(0.0, 2 * np.pi, shape)
    weights = rng.uniform(0.5, 1.5, shape)
    powers = np.sum(weights**2, axis=0)
    weights *= np.sqrt(2.0 / powers)
    angles = 2 * np.pi * frequencies * times[:, None, None] + phases
    sines = np.sin(angles)
    return np.sum(weights * sines, axis=1)


def _wave(
    rng: np.random.Generator,
    times: FloatArray,
    band_hz: tuple[float, float],
    waves: int = 6,
) -> FloatArray:
    """Draw a sum of sines (N,), as in :func:`_waves`."""
    return _waves(rng, times, 1, band_hz, waves)[:, 0]


def _smooth_steps(
    rng: np.random.Generator,
    times: FloatArray,
    hold_s: float,
    levels: Callable[[int], FloatArray],
    smooth_s: float,
) -> FloatArray:
    """Return values (N,) that are drawn anew after about ``hold_s``, and smoothed."""
    n_levels = int(np.ptp(times) / hold_s * 2) + 4
    holds_s = rng.uniform(0.5, 1.5, n_levels) * hold_s
    ends = np.cumsum(holds_s)
    drawn = levels(n_levels + 1)
    rows = np.searchsorted(ends, times - times[0])
    return gaussian_filter1d(drawn[rows], smooth_s * _RATE, mode="nearest")


def _from_euler(ypr: FloatArray, positions: FloatArray) -> FloatArray:
    rotations = Rotation.from_euler("ZYX", ypr).as_matrix()
    return se3.from_rotation_translation(rotations, positions)


def hand_held(rng: np.random.Generator, duration_s: float) -> Motion:
    """Simulate a person who waves a rig about all axes while walking slowly through a room."""
    times = _grid(duration_s)
    walk_m = np.array([1.0, 1.0, 0.15])
    angle_sizes = np.array([0.5, 0.3, 0.3])
    positions = 0.12 * _waves(rng, times, 3, (0.25, 1.2))
    positions += walk_m * _waves(rng, times, 3, (0.02, 0.08), 3)
    angles = angle_sizes * _waves(rng, times, 3, (0.15, 0.9))
    angles[:, 0] += 0.8 * _wave(rng, times, (0.01, 0.05), 3)
    return Motion(_from_euler(angles, positions))


def _ground_vehicle(
    times: FloatArray,
    speed: FloatArray,
    yaw_rate: FloatArray,
    slope: FloatArray,
    bank: FloatArray,
    bumps: FloatArray,
) -> Motion:
    """Simulate a vehicle that moves along its x axis.

    ``bumps`` (N, 3) are additional roll and pitch (rad) and heave (m).
    """
    heading = np.cumsum(yaw_rate) / _RATE
    level = np.cos(slope)
    ahead = np.stack(
        [np.cos(heading) * level, np.sin(heading) * level, np.sin(slope)],
        axis=-1,
    )
    velocity = speed[:, None] * ahead
    positions = np.cumsum(velocity, axis=0) / _RATE
    positions[:, 2] += bumps[:, 2]
    pitch = bumps[:, 1] - slope
    roll = bank + bumps[:, 0]
    angles = np.column_stack([heading, pitch, roll])
    return Motion(_from_euler(angles, positions))


def car(rng: np.random.Generator, duration_s: float) -> Motion:
    """Simulate a car on hilly roads: junctions and bends, slopes of some degrees.

    The speed is about 9 m/s, with limits of 2 and 18 m/s.
    """
    times = _grid(duration_s)
    speed = 9.0 + 3.5 * _wave(rng, times, (0.01, 0.06))
    speed = np.clip(speed, 2.0, 18.0)

    def bends(size: int) -> FloatArray:
        return rng.normal(0.0, 0.18, size)

    bend_rate = _smooth_steps(rng, times, 6.0, bends, 0.8)
    n_junctions = int(duration_s / 4) + 4
    junctions = rng.choice([-0.45, 0.0, 0.0, 0.45], size=n_junctions)

    def turns(size: int) -> FloatArray:
        return rng.choice(junctions, size)

    turn_rate = _smooth_steps(rng, times, 5.0, turns, 0.6)
    slope = np.radians(2.5) * _wave(rng, times, (0.02, 0.1))
    bank = np.radians(1.2) * _wave(rng, times, (0.03, 0.15))
    bump_sizes = np.array([0.006, 0.005, 0.015])
    bumps = bump_sizes * _waves(rng, times, 3, (0.5, 1.5))
    return _ground_vehicle(
        times, speed, bend_rate + turn_rate, slope, bank, bumps
    )


def agv(
    rng: np.random.Generator, duration_s: float, ramps: bool = True
) -> Motion:
    """Simulate an automated guided vehicle in a hall: turns, and ramps of 3 or 6 degrees.

    Without ``ramps`` the floor is flat and has no bumps.
    """
    times = _grid(duration_s)
    speed = _uniform_steps(rng, times, (0.4, 1.4))
    yaw_rate = _turns_of_agv(rng, times)
    flat = np.zeros_like(times)
    if not ramps:
        bumps = np.zeros((len(times), 3))
        return _ground_vehicle(times, speed, yaw_rate, flat, flat, bumps)

    slopes = np.radians([0.0, 0.0, 0.0, 3.0, 6.0, -3.0, -6.0])

    def drawn_slopes(size: int) -> FloatArray:
        return rng.choice(slopes, size)

    slope = _smooth_steps(rng, times, 5.0, drawn_slopes, 0.4)
    bumps = _bumps_of_agv(rng, times, slope)
    return _ground_vehicle(times, speed, yaw_rate, slope, flat, bumps)


def _uniform_steps(
    rng: np.random.Generator, times: FloatArray, limits: tuple[float, float]
) -> FloatArray:
    """Draw the speed (N,) of an automated guided vehicle, m/s: uniform between limits."""

    def speeds(size: int) -> FloatArray:
        return rng.uniform(*limits, size)

    return _smooth_steps(rng, times, 8.0, speeds, 0.7)


def _turns_of_agv(rng: np.random.Generator, times: FloatArray) -> FloatArray:
    """Draw the yaw rate (N,) of an automated guided vehicle, rad/s."""

    def yaw_rates(size: int) -> FloatArray:
        return rng.normal(0.0, 0.35, size)

    return _smooth_steps(rng, times, 5.0, yaw_rates, 0.5)


def _bumps_of_agv(
    rng: np.random.Generator, times: FloatArray, slope: FloatArray
) -> FloatArray:
    """Draw additional roll and pitch (rad) and heave (m), (N, 3), of a vehicle on slopes (N,), rad.

    The roll grows with the slope, because a ramp is not exactly straight.
    """
    bumps = np.zeros((len(times), 3))
    bumps[:, :2] = np.radians(0.25) * _waves(rng, times, 2, (0.3, 1.0))
    bumps[:, 0] += slope * 0.25 * _wave(rng, times, (0.03, 0.1))
    return bumps


def agv_on_request(
    rng: np.random.Generator, duration_s: float, flat_s: float = 0.0
) -> Motion:
    """Simulate an automated guided vehicle that drives as the node asks: curves, and some ramps.

    A ramp of 7 deg takes 8 s, up and down in turn. Before ``flat_s``, there are no ramps.
    """
    times = _grid(duration_s)
    speed = _uniform_steps(rng, times, (0.6, 1.4))
    yaw_rate = _turns_of_agv(rng, times)
    start_s = rng.uniform(0.0, RAMP_PERIOD_S)
    ramp_numbers, since_s = np.divmod(times + start_s, RAMP_PERIOD_S)
    until_s = 8.0 - since_s
    share = np.clip(np.minimum(since_s, until_s), 0.0, 1.0)
    signs = np.where(ramp_numbers % 2, 1.0, -1.0)
    slope = np.radians(7.0) * share * signs
    slope[times < flat_s] = 0.0
    level = np.zeros_like(times)
    bumps = _bumps_of_agv(rng, times, slope)
    return _ground_vehicle(times, speed, yaw_rate, slope, level, bumps)


def flat_agv(rng: np.random.Generator, duration_s: float) -> Motion:
    """Simulate an automated guided vehicle on a flat floor: z of the extrinsic stays unknown."""
    return agv(rng, duration_s, ramps=False)


def excavator(rng: np.random.Generator, duration_s: float) -> Motion:
    """Simulate the cab of an excavator, which slews to and fro, rocks, and sometimes drives."""
    times = _grid(duration_s)

    def slewing_rates(size: int) -> FloatArray:
        return rng.normal(0.0, 0.5, size)

    def speeds(size: int) -> FloatArray:
        return rng.choice([0.0, 0.0, 0.0, 0.6, -0.6], size)

    def steering_rates(size: int) -> FloatArray:
        return rng.normal(0.0, 0.8, size)

    slewing = _smooth_steps(rng, times, 4.0, slewing_rates, 0.5)
    tilt = np.radians(2.0) * _waves(rng, times, 2, (0.1, 0.6))
    tilt += np.radians(4.0) * _waves(rng, times, 2, (0.01, 0.05), 3)
    speed = _smooth_steps(rng, times, 6.0, speeds, 0.6)
    steering = _smooth_steps(rng, times, 6.0, steering_rates, 0.5)

    is_driving = speed != 0
    heading = np.cumsum(0.15 * is_driving * steering) / _RATE
    velocity = np.column_stack(
        [speed * np.cos(heading), speed * np.sin(heading), 0.02 * speed]
    )
    path = np.cumsum(velocity, axis=0) / _RATE
    positions = path + 0.01 * _waves(rng, times, 3, (0.3, 1.0))
    yaw = heading + np.cumsum(slewing) / _RATE
    angles = np.column_stack([yaw, tilt])
    return Motion(_from_euler(angles, positions))


def drone(rng: np.random.Generator, duration_s: float) -> Motion:
    """Simulate a multicopter, which tilts to accelerate and yaws slowly."""
    times = _grid(duration_s)
    slow_m = np.array([3.0, 3.0, 0.7])
    fast_m = np.array([0.3, 0.3, 0.1])
    positions = slow_m * _waves(rng, times, 3, (0.03, 0.16))
    positions += fast_m * _waves(rng, times, 3, (0.2, 0.5))
    up = _thrust_directions(positions)
    yaw = 1.2 * _wave(rng, times, (0.02, 0.2))
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)])
    leftward = np.cross(up, ahead)
    leftward /= np.linalg.norm(leftward, axis=1, keepdims=True)
    forward = np.cross(leftward, up)
    rotations = np.stack([forward, leftward, up], axis=-1)
    return Motion(se3.from_rotation_translation(rotations, positions))


def _thrust_directions(positions: FloatArray) -> FloatArray:
    """Return the directions (N, 3) of the thrust of a multicopter along positions (N, 3)."""
    velocity = np.gradient(positions, axis=0)
    acceleration = np.gradient(velocity, axis=0) * _RATE**2
    acceleration = gaussian_filter1d(acceleration, 0.05 * _RATE, axis=0)
    gravity = np.array([0.0, 0.0, 9.81])
    up = acceleration + gravity
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    return up


def arm(rng: np.random.Generator, duration_s: float) -> Motion:
    """Simulate the camera of a robot arm, which stops at each of several views of a target."""
    times = _grid(duration_s)
    view_s = 2.5
    n_views = int(np.ptp(times) / view_s) + 3
    angle_limits = [0.45, 0.45, 0.9]
    positions = rng.uniform(-0.25, 0.25, (n_views, 3))
    vectors = rng.uniform(-1.0, 1.0, (n_views, 3)) * angle_limits
    views = np.column_stack([positions, vectors])

    progress = (times - times[0]) / view_s
    k = progress.astype(int)
    # The arm moves for 0.8 of the time, smoothly, and then rests.
    s = np.clip((progress - k) / 0.8, 0.0, 1.0)[:, None]
    smooth = 10 - 15 * s + 6 * s**2
    change = views[k + 1] - views[k]
    values = views[k] + change * s**3 * smooth
    rotations = se3.rotation_exp(values[:, 3:])
    return Motion(se3.from_rotation_translation(rotations, values[:, :3]))
