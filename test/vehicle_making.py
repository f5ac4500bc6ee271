"""Simulated machines with wheels and a sensor, and their true parameters."""

from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

import hand_eye_calib as hec
from hand_eye_calib.core.geometry import se3

# Step of the simulation (s), and the interval of the wheel data (s).
_STEP_S = 0.005
_WHEELS_S = 0.02
_START_NS = 10**18


class Machine(NamedTuple):
    """Drive of a machine.

    ``values`` are the rates of the wheels at their stamps, ``parameters`` the true parameters of
    the wheels. The clock of the sensor is ``clock_s`` behind that of the wheels.
    """

    stamps_ns: np.ndarray
    values: np.ndarray
    measures: str
    sensor: hec.Trajectory
    T_base_sensor: np.ndarray
    parameters: list
    clock_s: float

    @property
    def wheels(self):
        return hec.wheel_trajectory(self.stamps_ns, self.values, self.measures)


def simulate_machine(seed, measures="wheels", course="eights", duration_s=180.0, noise=1.0):
    """Simulate figures of eight (or "straight", "circle") with slip, bumps and a noisy sensor."""
    rng = np.random.default_rng(seed)
    times_s = np.arange(0.0, duration_s + 1.0, _STEP_S)
    speed, yaw_rate = _course(course, rng, times_s)
    slip_angle = abs(rng.normal(0.0, 0.005)) * speed * yaw_rate
    left_speed = -slip_angle * speed
    if measures == "omni":
        left_speed = np.zeros(len(times_s))
        if course == "eights":
            left_speed = 0.4 * np.sin(2 * np.pi * times_s / 11 + rng.uniform(0, 6))
    Ts_world_base = _poses(rng, speed, left_speed, yaw_rate, noise)
    slip = _slip_of_wheels(rng, yaw_rate, noise * duration_s)
    parameters, rates = _wheels(measures, rng, speed, left_speed, yaw_rate, 1.0 + slip)
    every = round(_WHEELS_S / _STEP_S)
    n_rows = len(times_s) // every
    means = rates[: n_rows * every].reshape(n_rows, every, -1).mean(axis=1)
    sigmas = 0.01 * np.abs(means).max(axis=0)
    if measures == "steering":
        sigmas[1] = 0.002
    values = means + noise * sigmas * rng.standard_normal(means.shape)
    wheel_times_s = (np.arange(n_rows) + 0.5) * _WHEELS_S - _STEP_S
    T_base_sensor = _mount(rng)
    rows = np.arange(0, len(times_s), round(0.1 / _STEP_S))
    poses = _measured(rng, Ts_world_base[rows] @ T_base_sensor, noise)
    clock_s = 0.02
    sensor = hec.Trajectory(_stamps_ns(times_s[rows] - clock_s), poses, "lidar")
    return Machine(
        _stamps_ns(wheel_times_s), values, measures, sensor, T_base_sensor, parameters, clock_s
    )


def _stamps_ns(times_s):
    return _START_NS + np.round(times_s * 1e9).astype(np.int64)


def _course(course, rng, times_s):
    """Return speeds (m/s) and yaw rates (rad/s)."""
    phases = rng.uniform(0, 2 * np.pi, 3)
    speed = 0.8 + 0.15 * np.sin(2 * np.pi * times_s / 23 + phases[0])
    speed += 0.1 * np.sin(2 * np.pi * times_s / 7.1 + phases[1])
    curvature = {
        "eights": 0.9 * np.sin(2 * np.pi * times_s / 14 + phases[2]),
        "straight": 0.002 * np.sin(times_s),
        "circle": 0.7 + 0.003 * np.sin(times_s),
    }
    return speed, curvature[course] * speed


def _poses(rng, speed, left_speed, yaw_rate, noise):
    """Return poses of the base on a floor with bumps; the body leans outwards in curves."""
    headings = np.cumsum(yaw_rate) * _STEP_S
    middle = headings - yaw_rate * _STEP_S / 2
    places = np.cumsum((speed + 1j * left_speed) * np.exp(1j * middle)) * _STEP_S
    decay = np.exp(-_STEP_S / 0.3)
    shocks = np.sqrt(1 - decay**2) * rng.standard_normal((len(speed), 3))
    bumps = noise * lfilter([1.0], [1.0, -decay], shocks, axis=0) * [0.004, 0.004, 0.003]
    roll = bumps[:, 0] + noise * 0.01 * speed * yaw_rate
    rotations = se3.rotation_from_rpy(np.column_stack([roll, bumps[:, 1], headings]))
    positions = np.column_stack([places.real, places.imag, bumps[:, 2]])
    return se3.from_rotation_translation(rotations, positions)


def _slip_of_wheels(rng, yaw_rate, slipping_s):
    """Return the share (N, 2) by which two wheels turn too fast: bursts in curves."""
    slip = np.zeros((len(yaw_rate), 2))
    for start in rng.integers(0, len(yaw_rate), size=int(slipping_s / 8)):
        if abs(yaw_rate[start]) > 0.3 * np.abs(yaw_rate).max():
            end = start + int(rng.uniform(0.2, 1.0) / _STEP_S)
            slip[start:end, rng.integers(2)] += rng.uniform(0.03, 0.2)
    return slip


def _wheels(measures, rng, speed, left_speed, yaw_rate, slip):
    """Return true parameters 2 to 3 % off, and what the wheels measure (N, channels)."""
    off = 1.0 + rng.normal(0.0, [0.02, 0.02, 0.03])
    if measures == "wheels":
        left, right, track = off * [0.1, 0.1, 0.5]
        half_turn = yaw_rate * track / 2
        rates = [(speed - half_turn) / left, (speed + half_turn) / right]
        return [left, right, track], np.column_stack(rates) * slip
    if measures == "steering":
        factor, wheelbase = off[0], 1.2 * off[2]
        offset = np.radians(1.0) * rng.choice([-1.0, 1.0])
        angle = np.arctan(wheelbase * yaw_rate / speed) + offset
        return [factor, wheelbase, offset], np.column_stack([speed / factor * slip[:, 0], angle])
    rates = np.column_stack([speed, left_speed, yaw_rate]) / off
    rates[:, :2] *= slip
    return list(off), rates


def _mount(rng):
    """Return a pose of a sensor that is level to some degrees."""
    xyz = [rng.uniform(-0.3, 1.0), rng.uniform(-0.4, 0.4), rng.uniform(0.2, 1.5)]
    rpy = [*rng.normal(0, 0.03, 2), rng.uniform(-np.pi, np.pi)]
    return se3.from_rotation_translation(se3.rotation_from_rpy(rpy), xyz)


def _measured(rng, poses, noise):
    """Return poses with drift, 4 mm and 0.06 deg of noise."""
    drift = noise * rng.standard_normal((len(poses) - 1, 6)) * np.repeat([0.0007, 0.0001], 3)
    white = noise * rng.standard_normal((len(poses), 6)) * np.repeat([0.004, 0.001], 3)
    steps = se3.inverse(poses[:-1]) @ poses[1:] @ se3.exp(drift)
    return se3.chained(steps) @ se3.exp(white)
