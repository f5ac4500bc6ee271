"""Advice on the next stops of an arm: rotations of the hand that reduce the uncertainty most.

A candidate starts from one of the recorded stops. The hand is turned about one of its axes, and
moved so that the target keeps its place in the image. The stop adds ``J' J`` to the information
about X and Z, with J the derivatives of its errors over their standard deviations. Candidates are
chosen one after the other. Each minimises the sum of the variances of X over the squared targets
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

# Angle of the advised turns (deg). A flat target is still visible well at this angle.
_TURN_DEG = 30

# Prior standard deviation of unobservable directions, in standard deviations of a stop's errors.
_PRIOR_LEVELS = 1e3


@dataclass(frozen=True)
class NextStop:
    """A stop to add: turn ``frame``, the hand, by ``angle_deg`` about its axis (x, y or z)."""

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
    """Choose the next stops of an arm, the most useful first.

    Parameters
    ----------
    stops : Stops
        Recorded stops.
    fit : RobotWorld
        Their fit.
    frame : str
        Name of the frame of the hand, which turns.
    is_inverse : bool
        True for a camera beside the robot: then the stops have the inverse poses of the hand.
    targets : (6,) array
        Wanted standard deviations of X: x, y, z (m) and the rotations (rad).

    Returns
    -------
    start : int
        Row of the stop that the turns start from.
    next_stops : tuple of NextStop
    """
    # The most central orientation.
    start = int(np.argmin(medians(angles_between(stops.Ts_world_parent))))
    # Information that each candidate adds.
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
    """Return the advice as a sentence; ``number`` (from 1) is the stop to start from."""
    turns = listing([str(stop) for stop in stops])
    return (
        f"record {len(stops)} more stops from stop {number}, with the target still in the image: "
        f"{turns}"
    )


def _turned(
    stop: Stops, fit: RobotWorld, vector: FloatArray, is_inverse: bool
) -> Stops:
    """Return a stop with the hand turned by a rotation vector (3,), given in its own axes.

    The hand is moved so that the target keeps its position in the camera. ``is_inverse`` as in
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
