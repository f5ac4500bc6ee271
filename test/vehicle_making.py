"""Simulated drives of machines with wheels."""

from functools import cache

import numpy as np

from hand_eye_calib.core.geometry import se3
from reproduction.machines import simulate_machine


@cache
def machine(measures="wheels", course="eights", duration_s=120.0, noise=1.0):
    return simulate_machine(11, measures, course, duration_s, noise)


def pose_errors(result, truth):
    """Errors of x, y (m) and of the rotations (rad) about the axes of the base."""
    T = result.T_parent_child
    position_error = T[:2, 3] - truth[:2, 3]
    rotation_error = T[:3, :3] @ truth[:3, :3].T
    return np.append(position_error, se3.rotation_log(rotation_error))
