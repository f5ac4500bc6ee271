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
        """Poses (M, 4, 4) at times (M,), s: geodesics between the poses of the grid."""
        places = (np.asarray(times_s) + _MARGIN_S) * _RATE
        k = np.clip(places.astype(int), 0, len(self.poses) - 2)
        return se3.interpolate(self.poses[k], self.poses[k + 1], places - k)

    def twists(self, times_s: FloatArray) -> FloatArray:
        """Twists (M, 6) in the body's frame at times (M,): m/s and rad/s."""
        step = 1.0 / _RATE
        before = self.at(times_s - step)
        after = self.at(times_s + step)
        return se3.log(se3.inverse(before) @ after) / (2.0 * step)


# Time (s) from one ramp to the next of a vehicle that drives what the node asks for.
RAMP_PERIOD_S = 31.0


def _grid(duration_s: float) -> FloatArray:
    return (
        np.arange(round((duration_s + 2 * _MARGIN_S) * _RATE) + 1) / _RATE - _MARGIN_S
    )


def _waves(
    rng: np.random.Generator,
    times: FloatArray,
    columns: int,
    band_hz: tuple[float, float],
    waves: int = 6,
) -> FloatArray:
    """Sums of sines (N, columns) of standard deviation 1, frequencies log-uniform in a band."""
    frequencies = band_hz[0] * (band_hz[1] / band_hz[0]) ** rng.random((waves, columns))
    phases = rng.uniform(0.0, 2 * np.pi, (waves, columns))
    weights = rng.uniform(0.5, 1.5, (waves, columns))
    weights *= np.sqrt(2.0 / np.sum(weights**2, axis=0))
    angles = 2 * np.pi * frequencies * times[:, None, None] + phases
    return np.sum(weights * np.sin(angles), axis=1)


def _smooth_steps(
    rng: np.random.Generator,
    times: FloatArray,
    hold_s: float,
    levels: Callable[[int], FloatArray],
    smooth_s: float,
) -> FloatArray:
    """A level (N,) drawn anew every hold_s or so, smoothed."""
    ends = np.cumsum(
        rng.uniform(0.5, 1.5, int(np.ptp(times) / hold_s * 2) + 4) * hold_s
    )
    drawn = levels(len(ends) + 1)
    values = drawn[np.searchsorted(ends, times - times[0])]
    return gaussian_filter1d(values, smooth_s * _RATE, mode="nearest")


def _from_euler(ypr: FloatArray, positions: FloatArray) -> FloatArray:
    rotations = Rotation.from_euler("ZYX", ypr).as_matrix()
    return se3.from_rotation_translation(rotations, positions)


def hand_held(rng: np.random.Generator, duration_s: float) -> Motion:
    """A person waves a rig about all axes while walking slowly through a room."""
    times = _grid(duration_s)
    positions = 0.12 * _waves(rng, times, 3, (0.25, 1.2))
    positions += np.array([1.0, 1.0, 0.15]) * _waves(rng, times, 3, (0.02, 0.08), 3)
    angles = np.array([0.5, 0.3, 0.3]) * _waves(rng, times, 3, (0.15, 0.9))
    angles[:, 0] += 0.8 * _waves(rng, times, 1, (0.01, 0.05), 3)[:, 0]
    return Motion(_from_euler(angles, positions))


def _ground_vehicle(
    times: FloatArray,
    speed: FloatArray,
    yaw_rate: FloatArray,
    slope: FloatArray,
    bank: FloatArray,
    bumps: FloatArray,
) -> Motion:
    """A vehicle that moves along its own x axis; bumps (N, 3): extra roll, pitch (rad), heave."""
    heading = np.cumsum(yaw_rate) / _RATE
    velocity = speed[:, None] * np.stack(
        [
            np.cos(heading) * np.cos(slope),
            np.sin(heading) * np.cos(slope),
            np.sin(slope),
        ],
        axis=-1,
    )
    positions = np.cumsum(velocity, axis=0) / _RATE
    positions[:, 2] += bumps[:, 2]
    return Motion(
        _from_euler(
            np.column_stack([heading, bumps[:, 1] - slope, bank + bumps[:, 0]]),
            positions,
        )
    )


def car(rng: np.random.Generator, duration_s: float) -> Motion:
    """A car on hilly roads: junctions and bends, slopes of some degrees.

    The speed is about 9 m/s, with limits of 2 and 18 m/s.
    """
    times = _grid(duration_s)
    speed = np.clip(9.0 + 3.5 * _waves(rng, times, 1, (0.01, 0.06))[:, 0], 2.0, 18.0)
    bends = _smooth_steps(
        rng, times, 6.0, lambda size: rng.normal(0.0, 0.18, size), 0.8
    )
    junctions = rng.choice([-0.45, 0.0, 0.0, 0.45], size=int(duration_s / 4) + 4)
    turns = _smooth_steps(
        rng, times, 5.0, lambda size: rng.choice(junctions, size), 0.6
    )
    slope = np.radians(2.5) * _waves(rng, times, 1, (0.02, 0.1))[:, 0]
    bank = np.radians(1.2) * _waves(rng, times, 1, (0.03, 0.15))[:, 0]
    bumps = np.array([0.006, 0.005, 0.015]) * _waves(rng, times, 3, (0.5, 1.5))
    return _ground_vehicle(times, speed, bends + turns, slope, bank, bumps)


def agv(rng: np.random.Generator, duration_s: float, ramps: bool = True) -> Motion:
    """An automated guided vehicle in a hall: turns, and ramps up and down of 3 or 6 degrees.

    Without ``ramps`` the floor is flat and has no bumps.
    """
    times = _grid(duration_s)
    speed = _smooth_steps(
        rng, times, 8.0, lambda size: rng.uniform(0.4, 1.4, size), 0.7
    )
    yaw_rate = _smooth_steps(
        rng, times, 5.0, lambda size: rng.normal(0.0, 0.35, size), 0.5
    )
    flat = np.zeros_like(times)
    slope = flat
    if ramps:
        degrees = [0.0, 0.0, 0.0, 3.0, 6.0, -3.0, -6.0]
        slope = _smooth_steps(
            rng, times, 5.0, lambda size: rng.choice(np.radians(degrees), size), 0.4
        )
    bumps = _bumps_of_agv(rng, times, slope) if ramps else np.zeros((len(times), 3))
    return _ground_vehicle(times, speed, yaw_rate, slope, flat, bumps)


def _bumps_of_agv(
    rng: np.random.Generator, times: FloatArray, slope: FloatArray
) -> FloatArray:
    """Extra roll, pitch (rad) and heave (N, 3) on a slope (N,) (rad) that is not quite straight."""
    bumps = np.zeros((len(times), 3))
    bumps[:, :2] = np.radians(0.25) * _waves(rng, times, 2, (0.3, 1.0))
    bumps[:, 0] += slope * 0.25 * _waves(rng, times, 1, (0.03, 0.1))[:, 0]
    return bumps


def agv_on_request(
    rng: np.random.Generator, duration_s: float, flat_s: float = 0.0
) -> Motion:
    """An automated guided vehicle that drives what the node asks for: curves, and a ramp at times.

    A ramp of 7 deg takes 8 s, up and down in turn. Before ``flat_s``, there are no ramps.
    """
    times = _grid(duration_s)
    speed = _smooth_steps(
        rng, times, 8.0, lambda size: rng.uniform(0.6, 1.4, size), 0.7
    )
    yaw_rate = _smooth_steps(
        rng, times, 5.0, lambda size: rng.normal(0.0, 0.35, size), 0.5
    )
    ramps, since_s = np.divmod(times + rng.uniform(0.0, RAMP_PERIOD_S), RAMP_PERIOD_S)
    share = np.clip(np.minimum(since_s, 8.0 - since_s), 0.0, 1.0)
    slope = np.radians(7.0) * share * np.where(ramps % 2, 1.0, -1.0)
    slope[times < flat_s] = 0.0
    bumps = _bumps_of_agv(rng, times, slope)
    return _ground_vehicle(times, speed, yaw_rate, slope, np.zeros_like(times), bumps)


def flat_agv(rng: np.random.Generator, duration_s: float) -> Motion:
    """An automated guided vehicle on a perfectly flat floor: the vertical offset stays unknown."""
    return agv(rng, duration_s, ramps=False)


def excavator(rng: np.random.Generator, duration_s: float) -> Motion:
    """The cab of an excavator: it slews to and fro, rocks, and now and then drives a little."""
    times = _grid(duration_s)
    slewing = _smooth_steps(
        rng, times, 4.0, lambda size: rng.normal(0.0, 0.5, size), 0.5
    )
    tilt = np.radians(2.0) * _waves(rng, times, 2, (0.1, 0.6))
    tilt += np.radians(4.0) * _waves(rng, times, 2, (0.01, 0.05), 3)
    speeds = [0.0, 0.0, 0.0, 0.6, -0.6]
    speed = _smooth_steps(rng, times, 6.0, lambda size: rng.choice(speeds, size), 0.6)
    steering = _smooth_steps(
        rng, times, 6.0, lambda size: rng.normal(0.0, 0.8, size), 0.5
    )
    heading = np.cumsum(0.15 * (speed != 0) * steering) / _RATE
    velocity = np.stack(
        [speed * np.cos(heading), speed * np.sin(heading), 0.02 * speed], axis=-1
    )
    positions = np.cumsum(velocity, axis=0) / _RATE + 0.01 * _waves(
        rng, times, 3, (0.3, 1.0)
    )
    yaw = heading + np.cumsum(slewing) / _RATE
    return Motion(_from_euler(np.column_stack([yaw, tilt]), positions))


def drone(rng: np.random.Generator, duration_s: float) -> Motion:
    """A multicopter: its tilt makes its acceleration, its yaw follows slowly."""
    times = _grid(duration_s)
    positions = np.array([3.0, 3.0, 0.7]) * _waves(rng, times, 3, (0.03, 0.16))
    positions += np.array([0.3, 0.3, 0.1]) * _waves(rng, times, 3, (0.2, 0.5))
    acceleration = np.gradient(np.gradient(positions, axis=0), axis=0) * _RATE**2
    acceleration = gaussian_filter1d(acceleration, 0.05 * _RATE, axis=0)
    up = acceleration + np.array([0.0, 0.0, 9.81])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    yaw = 1.2 * _waves(rng, times, 1, (0.02, 0.2))[:, 0]
    ahead = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=-1)
    leftward = np.cross(up, ahead)
    leftward /= np.linalg.norm(leftward, axis=1, keepdims=True)
    rotations = np.stack([np.cross(leftward, up), leftward, up], axis=-1)
    return Motion(se3.from_rotation_translation(rotations, positions))


def arm(rng: np.random.Generator, duration_s: float) -> Motion:
    """A robot arm: a camera goes from view to view of a target and stops at each."""
    times = _grid(duration_s)
    views = int(np.ptp(times) / 2.5) + 3
    aims = np.column_stack(
        [
            rng.uniform(-0.25, 0.25, (views, 3)),
            rng.uniform(-1.0, 1.0, (views, 3)) * [0.45, 0.45, 0.9],
        ]
    )
    place = (times - times[0]) / 2.5
    k = place.astype(int)
    s = np.clip((place - k) / 0.8, 0.0, 1.0)[:, None]
    values = aims[k] + (aims[k + 1] - aims[k]) * s**3 * (10 - 15 * s + 6 * s**2)
    rotations = se3.rotation_exp(values[:, 3:])
    return Motion(se3.from_rotation_translation(rotations, values[:, :3]))
