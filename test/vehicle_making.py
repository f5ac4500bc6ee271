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
    turn = result.T_parent_child[:3, :3] @ truth[:3, :3].T
    return np.append((result.T_parent_child - truth)[:2, 3], se3.rotation_log(turn))
