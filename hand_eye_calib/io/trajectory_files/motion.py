"""What the motion says of orientations whose convention is not known.

A vehicle moves in a steady direction of its own body: forward, as a rule. With orientations of a
wrong convention that direction wanders as the vehicle turns. Hand-held sensors and drones move in
all directions; of them this says nothing.
"""

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry import se3

# Steps are this share of the extent of the positions, and at least so many are needed.
_STEPS_IN_EXTENT = 50
_FEWEST_STEPS = 10
# The wrong convention scatters the direction at least so much, and so many times as much as the
# right one.
_SMALLEST_SCATTER = 0.05
_CLEARLY = 4.0


def fits_better(positions: FloatArray, quats_xyzw: FloatArray, others_xyzw: FloatArray) -> bool:
    """Whether the motion fits other orientations clearly better.

    Parameters
    ----------
    positions : (N, 3) ndarray
        Metres.
    quats_xyzw, others_xyzw : (N, 4) ndarray
        Orientations of the sensor in the frame of the positions, read in two ways.

    Returns
    -------
    bool
        False if it says nothing.
    """
    rows = _apart(positions)
    if len(rows) <= _FEWEST_STEPS:
        return False
    steps = np.diff(positions[rows], axis=0)
    scatter = _scatter(steps, quats_xyzw[rows[:-1]])
    other = _scatter(steps, others_xyzw[rows[:-1]])
    return scatter > _SMALLEST_SCATTER and scatter > _CLEARLY * other


def _apart(positions: FloatArray) -> IntArray:
    """Rows between which the sensor has moved on by a step."""
    step = float(np.linalg.norm(np.ptp(positions, axis=0))) / _STEPS_IN_EXTENT
    if not step > 0:
        return np.arange(0)
    travelled = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))]
    rows = np.flatnonzero(np.diff(np.floor(travelled / step), prepend=-1.0))
    # Of a sensor that stands still, the noise of the positions adds up to a path.
    moved = np.linalg.norm(np.diff(positions[rows], axis=0), axis=1) > step / 3
    return rows[np.r_[True, moved]]


def _scatter(steps: FloatArray, quats_xyzw: FloatArray) -> float:
    """Scatter of the directions of steps (N, 3) in the sensor's own frame: 0 if all are the same,
    1 if they go everywhere.
    """
    directions = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    rotations = se3.from_quat_xyzw(np.zeros_like(steps), quats_xyzw)[:, :3, :3]
    in_sensor = np.einsum("nji,nj->ni", rotations, directions)
    return 1.0 - float(np.linalg.norm(in_sensor.mean(axis=0)))
