"""Models of wheels, which predict the motion of the axle from wheel data.

Wheel data are stored as the path of a unit vehicle, which has wheels of radius 1, a wheelbase of 1
and a track of B = 5. A step of the path is forward, left and a turn: (dx, dy, da). From this step,
a model with the parameters of the real wheels computes the step of the axle (m, m, rad).

- Two driven wheels with radii R_l, R_r turn by l = dx - B da / 2 and r = dx + B da / 2:
  forward = (R_l l + R_r r) / 2,  turn = (R_r r - R_l l) / track.
- Odometry of two wheels, with multipliers k and k_track and an additional curvature:
  forward = k dx,  turn = k da / k_track + curvature forward.
- Steering: dx and da are the speed of the fixed axle, times the cosine and the sine of the steering
  angle. The steering angle has an offset o:
  forward = R sqrt(dx^2 + da^2) sign(dx),  turn = forward tan(angle - o) / wheelbase.
- A tricycle, which drives its steered wheel: the same with the speed of this wheel:
  forward = R (dx cos o + da sin o),  turn = R (da cos o - dx sin o) / wheelbase.
- Omnidirectional, with multipliers: forward = k_x dx,  left = k_y dy,  turn = k_a da.

Positions in the plane are complex numbers x + i y.

Reference: A. Censi, A. Franchi, L. Marchionni, G. Oriolo, *Simultaneous calibration of odometry and
sensor parameters for mobile robots*, IEEE Trans. Robotics 29, 2013.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory

# Track of the unit vehicle, in radii of its wheels. Usual robots have this ratio, so the turns have
# a usual size.
UNIT_TRACK = 5.0

# Added to a length before a division by it. The length is 0 for a vehicle at rest.
_SMALL = 1e-12


class WheelModel(NamedTuple):
    """Model of one kind of wheels.

    Attributes
    ----------
    names : sequence of str
        Names of the P parameters.
    steps_of : callable
        ``steps_of(parameters, dx, dy, da)`` returns forward, left and turn (N,) of the axle.
    parameters_of : callable
        Function ``parameters_of(length, turn)``, which returns starting values (P,) of the
        parameters. Its arguments are the motion of the axle divided by the motion of the unit
        vehicle: length and turn. Both wheels get the same radius.
    n_wheels : int
        Number of parameters (the first ones) that are sizes of wheels, which may slip.
    """

    names: tuple[str, ...]
    steps_of: Callable[..., tuple[FloatArray, ...]]
    parameters_of: Callable[[float, float], tuple[float, ...]]
    n_wheels: int = 1


def _two_wheels(
    parameters: FloatArray, dx: FloatArray, dy: FloatArray, da: FloatArray
) -> tuple[FloatArray, ...]:
    """Return the steps of an axle with two driven wheels."""
    left_radius, right_radius, track = parameters
    half_turn = UNIT_TRACK * da / 2.0
    left = left_radius * (dx - half_turn)
    right = right_radius * (dx + half_turn)
    return (left + right) / 2.0, dy, (right - left) / track


def _odometry(
    parameters: FloatArray, dx: FloatArray, dy: FloatArray, da: FloatArray
) -> tuple[FloatArray, ...]:
    """Return the steps of an axle with the odometry of two wheels."""
    radius, track, curvature = parameters
    forward = radius * dx
    return forward, dy, radius * da / track + curvature * forward


def _steering(
    parameters: FloatArray, dx: FloatArray, dy: FloatArray, da: FloatArray
) -> tuple[FloatArray, ...]:
    """Return the steps of the rear axle of a vehicle with a steering angle."""
    radius, wheelbase, offset = parameters
    forward = radius * np.copysign(np.hypot(dx, da), dx)
    angle = np.arctan(da / (dx + _SMALL))
    return forward, dy, forward * np.tan(angle - offset) / wheelbase


def _tricycle(
    parameters: FloatArray, dx: FloatArray, dy: FloatArray, da: FloatArray
) -> tuple[FloatArray, ...]:
    """Return the steps of the fixed axle of a vehicle that is driven by its steered wheel."""
    radius, wheelbase, offset = parameters
    ahead = radius * (dx * np.cos(offset) + da * np.sin(offset))
    aside = radius * (da * np.cos(offset) - dx * np.sin(offset))
    return ahead, dy, aside / wheelbase


def _omni(
    parameters: FloatArray, dx: FloatArray, dy: FloatArray, da: FloatArray
) -> tuple[FloatArray, ...]:
    """Return the steps of an omnidirectional vehicle."""
    forward_factor, left_factor, turn_factor = parameters
    return forward_factor * dx, left_factor * dy, turn_factor * da


#: Models by the kind of wheel data. Parameters that ``diff_drive_controller`` has, too, have the
#: same names.
MODELS = {
    "wheels": WheelModel(
        ("left_wheel_radius", "right_wheel_radius", "wheel_separation"),
        _two_wheels,
        lambda length, turn: (length, length, UNIT_TRACK * length / turn),
        n_wheels=2,
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
    "tricycle": WheelModel(
        ("wheel_radius", "wheelbase", "steering_offset"),
        _tricycle,
        lambda length, turn: (length, length / turn, 0.0),
    ),
    "omni": WheelModel(
        ("forward_multiplier", "left_multiplier", "turn_multiplier"),
        _omni,
        lambda length, turn: (length, length, turn),
        n_wheels=2,
    ),
}

#: Kinds of wheel data whose columns are the same, so that users easily confuse them.
RIVALS = {"steering": "tricycle", "tricycle": "steering"}


def path_of(steps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the positions (N + 1,), complex, and headings (N + 1,), rad, after steps (3, N).

    A step is an arc of constant curvature. Forward and left are lengths along the arc. The path
    begins at 0 with the heading 0.
    """
    forward, left, turns = steps
    headings = np.append(0.0, np.cumsum(turns))
    # The chord of an arc is parallel to the arc at its middle. Its length is that of the arc times
    # sin(turn / 2) / (turn / 2). numpy's sinc(x) is sin(pi x) / (pi x).
    middle_directions = np.exp(1j * (headings[:-1] + turns / 2.0))
    shortening = np.sinc(turns / (2.0 * np.pi))
    chords = (forward + 1j * left) * middle_directions * shortening
    positions = np.append(0.0, np.cumsum(chords))
    return positions, headings


def steps_between(
    chords: FloatArray, headings: FloatArray, turns: FloatArray
) -> FloatArray:
    """Return the steps (3, N) with these chords; the inverse of :func:`path_of`.

    ``chords`` (N,) are the displacements as complex numbers, ``headings`` (N,) the headings at the
    start of each step, and ``turns`` (N,) the turns of the steps, rad.
    """
    arcs = (
        chords
        * np.exp(-1j * (headings + turns / 2.0))
        / np.sinc(turns / (2.0 * np.pi))
    )
    return np.stack([arcs.real, arcs.imag, turns])


def trajectory_of(
    stamps_ns: IntArray, steps: FloatArray, measures: str
) -> Trajectory:
    """Return the path of the unit vehicle from its steps (3, N - 1) between stamps (N,)."""
    positions, headings = path_of(steps)
    poses = se3.from_rotation_translation(
        se3.rotation_exp(headings[:, None] * [0.0, 0.0, 1.0]),
        np.stack(
            [positions.real, positions.imag, np.zeros(len(positions))], axis=-1
        ),
    )
    return Trajectory(stamps_ns, poses, "base_link", "", measures)


def steps_of(trajectory: Trajectory) -> FloatArray:
    """Return the steps (3, N - 1) of the path of a unit vehicle."""
    positions = trajectory.poses[:, 0, 3] + 1j * trajectory.poses[:, 1, 3]
    headings = np.unwrap(
        np.arctan2(trajectory.poses[:, 1, 0], trajectory.poses[:, 0, 0])
    )
    return steps_between(np.diff(positions), headings[:-1], np.diff(headings))


def motions(
    stamps_s: FloatArray, steps: FloatArray, ends_s: FloatArray
) -> FloatArray:
    """Return the motion (3, K) of each window as one arc: forward, left and turn.

    Parameters
    ----------
    stamps_s : (N + 1,) array
    steps : (3, N) array
        Steps of the axle between the stamps.
    ends_s : (2, K) array
        Times of the start and the end of each window.
    """
    positions, headings = path_of(steps)
    start, end = np.interp(ends_s, stamps_s, positions)
    start_heading, end_heading = np.interp(ends_s, stamps_s, headings)
    return steps_between(
        end - start, start_heading, end_heading - start_heading
    )
