"""Advice on the next stops of an arm: the hand rotations that reduce the uncertainty most.

A candidate starts from a recorded stop. The hand turns about one of its axes, and moves so that the
target keeps its place in the image. Such a stop adds ``J' J`` to the information about X and Z; J
are the derivatives of its errors, divided by their standard deviations. Candidates are chosen in
turn. Each choice minimises the sum of the variances of X divided by the squared targets
(A-optimality): F. Pukelsheim, *Optimal design of experiments*, SIAM 2006.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import medians
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.closed_form import Stops
from hand_eye_calib.extras.stops.robot_world import RobotWorld, whitened_rows
from hand_eye_calib.extras.stops.rough_fit import angles_between

# Number of stops that are advised.
_N_NEXT = 3

# Angle (deg) of the advised turns. A flat target is still well visible at this angle.
_TURN_DEG = 30

# Prior standard deviation of unobservable directions, as a multiple of the standard deviations of a
# stop.
_PRIOR_LEVELS = 1e3


@dataclass(frozen=True)
class NextStop:
    """A stop to record: turn ``frame``, the hand, by ``angle_deg`` about its axis (x, y or z)."""

    axis: str
    angle_deg: float
    frame: str

    def __str__(self) -> str:
        return f"turn {self.frame} by {self.angle_deg:+g} deg about its {self.axis}"


def next_stops(
    stops: Stops,
    fit: RobotWorld,
    frame: str,
    is_inverse: bool,
    targets: FloatArray,
) -> tuple[int, tuple[NextStop, ...]]:
    """Choose the next stops of an arm; the most useful stop is first.

    Parameters
    ----------
    stops : Stops
        Recorded stops.
    fit : RobotWorld
        Fit of these stops.
    frame : str
        Name of the frame of the hand.
    is_inverse : bool
        Whether the camera is beside the robot. The stops then have inverse poses of the hand.
    targets : (6,) array
        Targets for the standard deviations of X: x, y, z (m) and the rotations (rad).

    Returns
    -------
    start : int
        Row of the stop at which the turns start.
    next_stops : tuple of NextStop
    """
    # The stop with the most central orientation.
    start = int(np.argmin(medians(angles_between(stops.Ts_world_parent))))
    # Information added by each candidate.
    gains = {}
    for axis, angle_deg in itertools.product("xyz", (_TURN_DEG, -_TURN_DEG)):
        vector = np.radians(angle_deg) * np.eye(3)["xyz".index(axis)]
        stop = _turned(stops[np.array([start])], fit, vector, is_inverse)
        jacobian = whitened_rows(stop, fit)[0, :, :12]
        gains[NextStop(axis, angle_deg, frame)] = jacobian.T @ jacobian
    levels = np.repeat([fit.level_m, fit.level_rad], 3)
    information = fit.information + np.diag(
        np.tile(1.0 / (_PRIOR_LEVELS * levels) ** 2, 2)
    )
    chosen = []
    for _ in range(_N_NEXT):
        costs = {
            stop: _cost(information + gain, targets)
            for stop, gain in gains.items()
        }
        best = min(costs, key=costs.__getitem__)
        chosen.append(best)
        information = information + gains.pop(best)
    return start, tuple(chosen)


def advice_in_words(number: int, stops: tuple[NextStop, ...]) -> str:
    """Return the advice as a sentence. ``number`` (from 1) is the stop at which the turns start."""
    turns = listing([str(stop) for stop in stops])
    return (
        f"record {len(stops)} more stops from stop {number}, with the target still in the image: "
        f"{turns}"
    )


def _turned(
    stop: Stops, fit: RobotWorld, vector: FloatArray, is_inverse: bool
) -> Stops:
    """Return a stop after a rotation of the hand by a vector (3,) in its own axes.

    The hand also moves, so that the target keeps its position in the camera. For ``is_inverse`` see
    :func:`next_stops`.
    """
    X = fit.T_parent_child
    Z = fit.T_world_world
    R = se3.rotation_of(stop.Ts_world_parent[0])
    turn = se3.rotation_exp(vector)
    R_A = turn.T @ R if is_inverse else R @ turn
    R_B = se3.rotation_of(Z).T @ R_A @ se3.rotation_of(X)
    target_in_camera = se3.translation_of(se3.inverse(stop.Ts_world_child[0]))
    B = se3.from_rotation_translation(R_B, -R_B @ target_in_camera)
    A = Z @ B @ se3.inverse(X)
    return Stops(A[None], B[None])


def _cost(information: FloatArray, targets: FloatArray) -> float:
    """Return the cost of an information (12, 12): sum of variances of X over squared targets."""
    variances = np.diag(np.linalg.inv(information))[:6]
    return float(np.sum(variances / targets**2))
