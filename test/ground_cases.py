"""Drives over the ground that several tests use, their errors and targets."""

from functools import cache

import numpy as np
from ground_making import Machine

from hand_eye_calib.core.geometry import se3

# Targets of the ground: z (m), roll and pitch (rad).
Z_M = 0.02
TILT = np.radians(0.15)


@cache
def machine(place="yard", noise=1.0):
    """A machine, and the scans of both lidars, one a second."""
    drive = Machine(3, place, 70.0, noise=noise)
    mounts = (drive.T_base_parent, drive.T_base_child)
    return drive, [list(drive.clouds(mount, 10)) for mount in mounts]


def errors_of(result, drive):
    """Errors along (m) and about (rad) the axes of the parent."""
    deviation = se3.deviation(result.T_parent_child, drive.T_parent_child)
    return np.abs(deviation)
