"""Advice on the next stops of an arm: rotations of the hand that reduce the uncertainty most.

A candidate is one of the present stops with the hand turned about one of its own axes, and moved
such that the target stays in its place in the image. Its measurement adds ``J' J`` to the
information of X and Z, with J the derivatives of the errors in units of their levels. Candidates
are chosen in turn. Each minimises the sum of the variances of X over the squared targets
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

# Angle of the advised turns (deg): a flat target is still well visible.
_TURN_DEG = 30

# Prior standard deviation of unknown directions, in levels of the errors of a stop.
_PRIOR_LEVELS = 1e3


@dataclass(frozen=True)
class NextStop:
    """A stop to add: turn ``frame`` by ``angle_deg`` about its own ``axis`` (x, y or z)."""

    axis: str
    angle_deg: float
    frame: str

    def __str__(self) -> str:
        return f"turn {self.frame} by {self.angle_deg:+g} deg about its {self.axis}"


def next_stops(
    stops: Stops, fit: RobotWorld, frame: str, is_inverse: bool, targets: FloatArray
) -> tuple[int, tuple[NextStop, ...]]:
    """Return the row of the stop to start from, and the next stops, the most useful first.

    Parameters
    ----------
    stops : Stops
    fit : RobotWorld
        Of one child and one world.
    frame : str
        Name of the frame that turns: the hand.
    is_inverse : bool
        Whether the stops have the inverse poses of ``frame``: a camera beside the robot.
    targets : (6,) array
        Standard deviations (m, rad) that x, y, z and the rotations should have.
    """
    # The smallest median angle to the other stops.
    start = int(np.argmin(medians(angles_between(stops.Ts_world_parent))))
    # By its candidate, the information that a stop adds.
    gains = {}
    for axis, angle_deg in itertools.product("xyz", (_TURN_DEG, -_TURN_DEG)):
        vector = np.radians(angle_deg) * np.eye(3)["xyz".index(axis)]
        stop = _turned(stops[np.array([start])], fit, vector, is_inverse)
        jacobian = whitened_rows(stop, fit, in_world=False)[0, :, :12]
        gains[NextStop(axis, angle_deg, frame)] = jacobian.T @ jacobian
    levels = np.repeat([fit.level_m, fit.level_rad], 3)
    information = fit.information + np.diag(np.tile(1.0 / (_PRIOR_LEVELS * levels) ** 2, 2))
    chosen = []
    for _ in range(_N_NEXT):
        costs = {stop: _cost(information + gain, targets) for stop, gain in gains.items()}
        best = min(costs, key=costs.__getitem__)
        chosen.append(best)
        information = information + gains.pop(best)
    return start, tuple(chosen)


def advice_in_words(number: int, stops: tuple[NextStop, ...]) -> str:
    """Return the advice in a sentence; ``number`` is that of the stop to start from."""
    turns = listing([str(stop) for stop in stops])
    return (
        f"record {len(stops)} more stops from stop {number}, with the target still in the image: "
        f"{turns}"
    )


def _turned(stop: Stops, fit: RobotWorld, vector: FloatArray, is_inverse: bool) -> Stops:
    """Return a stop (1) with the hand turned by a rotation vector (3,) in its own axes.

    The target keeps its place in the camera.
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
    """Return the sum of the variances of X over the squared targets."""
    variances = np.diag(np.linalg.inv(information))[:6]
    return float(np.sum(variances / targets**2))
