"""Wheel data, their models, and the motions of the axle that they predict.

Wheel data are stored as the path of a unit vehicle, which has wheels of radius 1, a wheelbase of 1
and a track of B = 5. A step of the path has a forward part, a left part and a turn (dx, dy, da).

- Two driven wheels turn by l = dx - B da / 2 and r = dx + B da / 2. The axle moves by
  forward = (R_l l + R_r r) / 2,  turn = (R_r r - R_l l) / track.
- Odometry of two wheels: forward = k dx,  turn = k da / k_track + curvature forward.
- Steering: tan(angle) = da / dx,  forward = R dx,  turn = forward tan(angle - offset) / wheelbase.
- Omnidirectional: forward = k_x dx,  left = k_y dy,  turn = k_a da.

Places in the plane are complex numbers.

Reference: A. Censi, A. Franchi, L. Marchionni, G. Oriolo, *Simultaneous calibration of odometry and
sensor parameters for mobile robots*, IEEE Trans. Robotics 29, 2013.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory

# Track of the unit vehicle in radii of its wheels, as of a usual robot: its turns are as large.
UNIT_TRACK = 5.0

# Added to lengths to divide by (unit of the wheel data): a vehicle at rest has no steering angle.
_SMALL = 1e-12


class WheelModel(NamedTuple):
    """Model of one kind of wheels.

    Attributes
    ----------
    names : sequence of str
        Names of the P parameters.
    steps_of : callable
        ``steps_of(parameters, dx, dy, da)`` returns forward, left and turn of the axle (N,).
    parameters_of : callable
        ``parameters_of(length, turn)`` returns parameters (P,) of equal wheels, from the ratios of
        lengths and of turns to those of the unit vehicle.
    """

    names: tuple[str, ...]
    steps_of: Callable[..., tuple[FloatArray, ...]]
    parameters_of: Callable[[float, float], tuple[float, ...]]


def _two_wheels(
    parameters: FloatArray, dx: FloatArray, dy: FloatArray, da: FloatArray
) -> tuple[FloatArray, ...]:
    left_radius, right_radius, track = parameters
    half_turn = UNIT_TRACK * da / 2.0
    left = left_radius * (dx - half_turn)
    right = right_radius * (dx + half_turn)
    return (left + right) / 2.0, dy, (right - left) / track


def _odometry(
    parameters: FloatArray, dx: FloatArray, dy: FloatArray, da: FloatArray
) -> tuple[FloatArray, ...]:
    radius, track, curvature = parameters
    forward = radius * dx
    return forward, dy, radius * da / track + curvature * forward


def _steering(
    parameters: FloatArray, dx: FloatArray, dy: FloatArray, da: FloatArray
) -> tuple[FloatArray, ...]:
    radius, wheelbase, offset = parameters
    forward = radius * dx
    angle = np.arctan(da / (dx + _SMALL))
    return forward, dy, forward * np.tan(angle - offset) / wheelbase


def _omni(
    parameters: FloatArray, dx: FloatArray, dy: FloatArray, da: FloatArray
) -> tuple[FloatArray, ...]:
    forward_factor, left_factor, turn_factor = parameters
    return forward_factor * dx, left_factor * dy, turn_factor * da


#: Models by what the wheels measure. Names of ``diff_drive_controller`` where it has them.
MODELS = {
    "wheels": WheelModel(
        ("left_wheel_radius", "right_wheel_radius", "wheel_separation"),
        _two_wheels,
        lambda length, turn: (length, length, UNIT_TRACK * length / turn),
    ),
    "wheel_odometry": WheelModel(
        ("wheel_radius_multiplier", "wheel_separation_multiplier", "curvature"),
        _odometry,
        lambda length, turn: (length, length / turn, 0.0),
    ),
    "steering": WheelModel(
        ("wheel_radius", "wheelbase", "steering_offset"),
        _steering,
        lambda length, turn: (length, length / turn, 0.0),
    ),
    "omni": WheelModel(
        ("forward_multiplier", "left_multiplier", "turn_multiplier"),
        _omni,
        lambda length, turn: (length, length, turn),
    ),
}


def path_of(steps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return places (N + 1,), complex, and headings (N + 1,) of steps (3, N) of constant twist."""
    forward, left, turns = steps
    headings = np.append(0.0, np.cumsum(turns))
    middle = headings[:-1] + turns / 2.0
    moved = (forward + 1j * left) * np.exp(1j * middle) * np.sinc(turns / (2.0 * np.pi))
    return np.append(0.0, np.cumsum(moved)), headings


def steps_between(moved: FloatArray, headings: FloatArray, turns: FloatArray) -> FloatArray:
    """Return steps (3, N) from displacements (N,), complex, headings at their start, and turns."""
    arcs = moved * np.exp(-1j * (headings + turns / 2.0)) / np.sinc(turns / (2.0 * np.pi))
    return np.stack([arcs.real, arcs.imag, turns])


def trajectory_of(stamps_ns: IntArray, steps: FloatArray, measures: str) -> Trajectory:
    """Return the path of the unit vehicle from its steps (3, N - 1) between stamps (N,)."""
    places, headings = path_of(steps)
    poses = se3.from_rotation_translation(
        se3.rotation_exp(headings[:, None] * [0.0, 0.0, 1.0]),
        np.stack([places.real, places.imag, np.zeros(len(places))], axis=-1),
    )
    return Trajectory(stamps_ns, poses, "base_link", "", measures)


def steps_of(trajectory: Trajectory) -> FloatArray:
    """Return the steps (3, N - 1) of the path of a unit vehicle."""
    places = trajectory.poses[:, 0, 3] + 1j * trajectory.poses[:, 1, 3]
    headings = np.unwrap(np.arctan2(trajectory.poses[:, 1, 0], trajectory.poses[:, 0, 0]))
    return steps_between(np.diff(places), headings[:-1], np.diff(headings))


def motions(stamps_s: FloatArray, steps: FloatArray, ends_s: FloatArray) -> FloatArray:
    """Return the motions (3, K) from steps (3, N) between stamps (N + 1,).

    ``ends_s`` (2, K) are the times of both ends of the motions.
    """
    places, headings = path_of(steps)
    start, end = np.interp(ends_s, stamps_s, places)
    start_heading, end_heading = np.interp(ends_s, stamps_s, headings)
    return steps_between(end - start, start_heading, end_heading - start_heading)
