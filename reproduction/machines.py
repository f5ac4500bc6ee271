"""Simulated machines with wheels and a sensor, and their true parameters.

Machines are kinds of wheel data: ``wheels``, ``steering``, ``tricycle`` and ``omni``. ``mecanum``
is the odometry of four mecanum wheels. No model describes the data of ``skid``, whose tracks slip
more in tight curves, and of ``articulated``, whose steering angle is the angle of its joint.

The courses ``eights`` and ``wide`` (figures of eight) determine x, y and yaw of the sensor.
``straight``, ``circle``, ``bend``, ``left`` and ``spin`` do not.
"""

from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.extras.vehicle.wheel_files import wheel_trajectory

# Step of the simulation (s), and the interval of the wheel data (s).
_STEP_S = 0.005
_WHEELS_S = 0.02
# Length of a ramp up and down again (m).
_RAMP_M = 12.0
_START_NS = 10**18


class Machine(NamedTuple):
    """Drive of a machine.

    Attributes
    ----------
    stamps_ns : (N,) int64 array
        Stamps of the wheel data.
    values : (N, 2) or (N, 3) array
        Values of the wheels, see :func:`~hand_eye_calib.wheel_trajectory`.
    measures : str
        Kind of wheel data.
    sensor : Trajectory
        Poses of the sensor. Its clock is ``clock_s`` behind that of the wheels.
    T_base_sensor : (4, 4) array
    parameters : list of float
        True parameters of the wheels, in the order of the model.
    clock_s : float
    """

    stamps_ns: IntArray
    values: FloatArray
    measures: str
    sensor: Trajectory
    T_base_sensor: FloatArray
    parameters: list[float]
    clock_s: float

    @property
    def wheels(self) -> Trajectory:
        """Stream of the wheels for ``calibrate``."""
        return wheel_trajectory(self.stamps_ns, self.values, self.measures)


class Course(NamedTuple):
    """Speeds (m/s) ahead and to the left and yaw rates (rad/s) of an axle, (N,) each."""

    speed: FloatArray
    left_speed: FloatArray
    yaw_rate: FloatArray


# Kind of the wheel data of machines whose name is not a kind of wheel data.
_DATA = {"mecanum": "omni", "skid": "wheels", "articulated": "steering"}

# Sum of half the wheelbase and half the track of a machine with mecanum wheels (m).
_MECANUM_M = 0.6
# Rows: motions forward, to the left, and turn. Columns: wheels front left, front right, rear left,
# rear right. The speed of a wheel is the sum of the motions with the signs of its column.
_MECANUM = np.array([[1, 1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]])


def simulate_machine(
    seed: int,
    machine: str = "wheels",
    course: str = "eights",
    duration_s: float = 180.0,
    noise: float = 1.0,
    slip: float = 1.0,
    ramp_rad: float = 0.0,
) -> Machine:
    """Simulate a drive with slip, bumps and a noisy sensor; see the module for the names.

    ``noise`` is a factor of all errors, ``slip`` of the number of slips of the wheels. The floor
    rises and falls along the path with slopes up to ``ramp_rad``.
    """
    rng = np.random.default_rng(seed)
    times_s = np.arange(0.0, duration_s + 1.0, _STEP_S, dtype=float)
    driven = _course(course, machine, rng, times_s)
    Ts_world_base = _poses(rng, driven, noise, ramp_rad)
    n_wheels = 4 if machine == "mecanum" else 2
    slips = _slip_of_wheels(
        rng, driven.yaw_rate, slip * noise * duration_s, n_wheels
    )
    parameters, rates = _wheels(machine, rng, driven, 1.0 + slips)

    stride = round(_WHEELS_S / _STEP_S)
    n_rows = len(times_s) // stride
    whole_rates = rates[: n_rows * stride]
    means = whole_rates.reshape(n_rows, stride, -1).mean(axis=1)
    sigmas = 0.01 * np.abs(means).max(axis=0)
    if machine in ("steering", "tricycle", "articulated"):
        sigmas[1] = 0.002
    standard = rng.standard_normal(means.shape)
    middles = np.arange(n_rows) + 0.5
    wheel_times_s = np.asarray(middles * _WHEELS_S - _STEP_S, dtype=float)

    T_base_sensor = _mount(rng)
    rows = np.arange(0, len(times_s), round(0.1 / _STEP_S))
    poses = _measured(rng, Ts_world_base[rows] @ T_base_sensor, noise)
    clock_s = 0.02
    return Machine(
        stamps_ns=_stamps_ns(wheel_times_s),
        values=means + noise * sigmas * standard,
        measures=_DATA.get(machine, machine),
        sensor=Trajectory(_stamps_ns(times_s[rows] - clock_s), poses, "lidar"),
        T_base_sensor=T_base_sensor,
        parameters=parameters,
        clock_s=clock_s,
    )


def _stamps_ns(times_s: FloatArray) -> IntArray:
    since_ns = np.round(times_s * 1e9)
    return _START_NS + since_ns.astype(np.int64)


def _course(
    course: str, machine: str, rng: np.random.Generator, times_s: FloatArray
) -> Course:
    """Return the motion of the axle, which slips outwards in curves."""
    phases = rng.uniform(0, 2 * np.pi, 3)

    def wave(period_s: float, phase: float) -> FloatArray:
        angles = 2 * np.pi * times_s / period_s
        return np.sin(angles + phase)

    speed = 0.8 + 0.15 * wave(23, phases[0])
    speed += 0.1 * wave(7.1, phases[1])
    bends = wave(14, phases[2])
    ripple = np.sin(times_s)
    from_middle_s = times_s - times_s[-1] / 2.0
    curvatures = {
        "eights": 0.9 * bends,
        "wide": 0.3 * bends,
        "straight": 0.002 * ripple,
        "circle": 0.7 + 0.003 * ripple,
        "bend": 0.7 * np.exp(-((from_middle_s / 2.0) ** 2)),
        "left": 0.5 + 0.4 * bends,
    }
    if course == "spin":
        yaw_rate = 0.5 * bends
        speed = 0.002 * ripple
    else:
        yaw_rate = curvatures[course] * speed

    slip = abs(rng.normal(0.0, 0.005))
    slip_angle = slip * speed * yaw_rate
    left_speed = -slip_angle * speed
    if machine in ("omni", "mecanum"):
        left_speed = np.zeros(len(times_s))
        if course == "eights":
            left_speed = 0.4 * wave(11, rng.uniform(0, 6))
    return Course(speed, left_speed, yaw_rate)


def _poses(
    rng: np.random.Generator, driven: Course, noise: float, ramp_rad: float
) -> FloatArray:
    """Return poses of the base on a floor with bumps; the body leans outwards in curves.

    ``noise`` multiplies bumps and lean. For a noise of 1, the bumps have standard deviations of
    4 mrad in roll and pitch and 3 mm in height, and a correlation time of 0.3 s. The lean is
    10 mrad for a lateral acceleration of 1 m/s^2.
    """
    speed, left_speed, yaw_rate = driven
    # The vehicle pitches as the floor below it rises and falls.
    phases = 2 * np.pi * np.cumsum(speed) * _STEP_S / _RAMP_M
    pitch = ramp_rad * np.sin(phases)
    level = np.cos(pitch)
    headings = np.cumsum(yaw_rate / level) * _STEP_S
    middle_headings = headings - yaw_rate * _STEP_S / 2

    # Horizontal velocities and positions are complex numbers x + iy.
    in_base = speed * level + 1j * left_speed
    velocities = in_base * np.exp(1j * middle_headings)
    places = np.cumsum(velocities) * _STEP_S
    climbs = speed * np.sin(pitch)
    heights = -np.cumsum(climbs) * _STEP_S

    decay = np.exp(-_STEP_S / 0.3)
    standard = rng.standard_normal((len(speed), 3))
    shocks = np.sqrt(1 - decay**2) * standard
    correlated = lfilter([1.0], [1.0, -decay], shocks, axis=0)
    bumps = noise * correlated * [0.004, 0.004, 0.003]
    lean = noise * 0.01 * speed * yaw_rate
    roll_bumps, pitch_bumps, height_bumps = bumps.T
    rpy = np.column_stack([roll_bumps + lean, pitch + pitch_bumps, headings])
    rotations = se3.rotation_from_rpy(rpy)
    positions = [places.real, places.imag, heights + height_bumps]
    return se3.from_rotation_translation(rotations, np.column_stack(positions))


def _slip_of_wheels(
    rng: np.random.Generator,
    yaw_rate: FloatArray,
    slipping_s: float,
    n_wheels: int,
) -> FloatArray:
    """Return the slip (N, n_wheels): the share by which wheels turn too fast, in some curves."""
    n_rows = len(yaw_rate)
    slip = np.zeros((n_rows, n_wheels))
    least_rate = 0.3 * np.abs(yaw_rate).max()
    for start in rng.integers(0, n_rows, size=int(slipping_s / 8)):
        if abs(yaw_rate[start]) > least_rate:
            length_s = rng.uniform(0.2, 1.0)
            end = start + int(length_s / _STEP_S)
            wheel = rng.integers(n_wheels)
            slip[start:end, wheel] += rng.uniform(0.03, 0.2)
    return slip


def _wheels(
    machine: str, rng: np.random.Generator, driven: Course, slip: FloatArray
) -> tuple[list[float], FloatArray]:
    """Return the true parameters of the wheels, and what the wheels measure (N, channels).

    The true parameters differ from the nominal ones at random, by 2 to 3 % (1 sigma).
    """
    speed, left_speed, yaw_rate = driven
    off = 1.0 + rng.normal(0.0, [0.02, 0.02, 0.03])
    if machine in ("wheels", "skid"):
        left, right, track = off * [0.1, 0.1, 0.5]
        half_turn = yaw_rate * track / 2
        if machine == "skid":
            # Tracks slip when the machine turns, more in tight curves.
            half_turn *= 1.5 + 0.3 * np.abs(yaw_rate)
        left_rate = (speed - half_turn) / left
        right_rate = (speed + half_turn) / right
        wheels = np.column_stack([left_rate, right_rate])
        return [left, right, track], wheels * slip

    factor = off[0]
    wheelbase = 1.2 * off[2]
    offset = np.radians(1.0) * rng.choice([-1.0, 1.0])
    if machine == "omni":
        rates = np.column_stack([speed, left_speed, yaw_rate]) / off
        rates[:, :2] *= slip
        return list(off), rates
    if machine == "mecanum":
        # Rollers slip sideways.
        multipliers = [factor, factor * off[1], factor / off[2]]
        motion = np.column_stack([speed, left_speed, yaw_rate]) / multipliers
        wheels = (motion * [1.0, 1.0, _MECANUM_M]) @ _MECANUM * slip
        return multipliers, wheels @ _MECANUM.T / [4.0, 4.0, 4.0 * _MECANUM_M]
    parameters = [factor, wheelbase, offset]
    if machine == "articulated":
        return parameters, _articulated(driven, factor, wheelbase, slip)

    wheel_speed = speed
    if machine == "tricycle":
        # The driven wheel is the steered wheel.
        wheel_speed = np.hypot(speed, wheelbase * yaw_rate)
    measured_speed = wheel_speed / factor * slip[:, 0]
    angle = np.arctan2(wheelbase * yaw_rate, speed)
    return parameters, np.column_stack([measured_speed, angle + offset])


def _articulated(
    driven: Course, factor: float, wheelbase: float, slip: FloatArray
) -> FloatArray:
    """Return the speed of the front axle and the angle of the joint in the middle of a loader.

    The yaw rate of the front part is ``(v sin g + l g') / (l (1 + cos g))``. v is the speed, g the
    angle of the joint, g' its rate, and l the length of each of both parts.
    """
    length = wheelbase / 2.0
    angles = np.zeros(len(driven.speed))
    for row in range(len(angles) - 1):
        angle = angles[row]
        turn = driven.yaw_rate[row] * length * (1.0 + np.cos(angle))
        sideways = driven.speed[row] * np.sin(angle)
        rate = (turn - sideways) / length
        angles[row + 1] = angle + rate * _STEP_S
    measured_speed = driven.speed / factor * slip[:, 0]
    return np.column_stack([measured_speed, angles])


def _mount(rng: np.random.Generator) -> FloatArray:
    """Return a pose of a sensor that is level within a few degrees."""
    x = rng.uniform(-0.3, 1.0)
    y = rng.uniform(-0.4, 0.4)
    z = rng.uniform(0.2, 1.5)
    roll, pitch = rng.normal(0, 0.03, 2)
    yaw = rng.uniform(-np.pi, np.pi)
    rotation = se3.rotation_from_rpy([roll, pitch, yaw])
    return se3.from_rotation_translation(rotation, [x, y, z])


def _measured(
    rng: np.random.Generator, poses: FloatArray, noise: float
) -> FloatArray:
    """Return poses with drift, 4 mm and 0.06 deg of noise."""
    drift_sigmas = np.repeat([0.0007, 0.0001], 3)
    white_sigmas = np.repeat([0.004, 0.001], 3)
    drift = noise * rng.standard_normal((len(poses) - 1, 6)) * drift_sigmas
    white = noise * rng.standard_normal((len(poses), 6)) * white_sigmas
    true_steps = se3.inverse(poses[:-1]) @ poses[1:]
    steps = true_steps @ se3.exp(drift)
    return se3.chained(steps) @ se3.exp(white)
