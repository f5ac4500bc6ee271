"""Convert poses as a robot's controller displays them: a position and angles in its convention.

R is the rotation of the hand in the base; Rx, Ry and Rz are rotations about the axes x, y and z.

==================  ==========================  =======================
robot               numbers after the position  rotation
==================  ==========================  =======================
``abb``             q1 q2 q3 q4                 quaternion w, x, y, z
``fanuc``           W P R, deg                  R = Rz(R) Ry(P) Rx(W)
``kawasaki``        O A T, deg                  R = Rz(O) Ry(A) Rz(T)
``kuka``            A B C, deg                  R = Rz(A) Ry(B) Rx(C)
``ur``              rx ry rz, rad               rotation vector
``yaskawa``         Rx Ry Rz, deg               R = Rz(Rz) Ry(Ry) Rx(Rx)
==================  ==========================  =======================

Reference: Basler AG, *rc_cube documentation*, appendix *Pose formats*,
docs.baslerweb.com/stereovisard/rc_cube/en.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.core.base.arrays import FloatArray, floats
from hand_eye_calib.core.base.errors import ConfigError, InputError, located
from hand_eye_calib.core.base.option import did_you_mean
from hand_eye_calib.core.base.text import shown_value
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import pose_stack
from hand_eye_calib.formats.files import read_text

# Axes of the angles in SciPy's notation: small letters are fixed axes, capitals are moving axes.
_AXES = {"fanuc": "xyz", "kawasaki": "ZYZ", "kuka": "ZYX", "yaskawa": "xyz"}

#: Makers of robots whose convention of angles is implemented.
ROBOTS = ("abb", "fanuc", "kawasaki", "kuka", "ur", "yaskawa")


def robot_poses(rows: Any, robot: str) -> FloatArray:
    """Return the poses (N, 4, 4) of a robot's hand in its base.

    Parameters
    ----------
    rows : (N, 6) or (N, 7) array-like
        Position, then angles or quaternion in the robot's convention. Positions keep their unit.
    robot : {"abb", "fanuc", "kawasaki", "kuka", "ur", "yaskawa"}
        Maker of the robot.

    Raises
    ------
    ConfigError
        If the robot is unknown.
    InputError
        If the rows have a different number of values, or are not poses.

    Examples
    --------
    >>> hec.robot_poses([[400.0, 0.0, 300.0, 90.0, 0.0, 180.0]], "kuka").shape
    (1, 4, 4)
    """
    if robot not in ROBOTS:
        hint = did_you_mean(str(robot), ROBOTS)
        raise ConfigError(
            f"the robot must be one of {', '.join(ROBOTS)}; got {shown_value(robot)}{hint}"
        )
    values = np.atleast_2d(floats("rows", rows))
    n_values = 7 if robot == "abb" else 6
    if values.ndim != 2 or values.shape[1] != n_values:
        raise InputError(
            f"a pose of {robot} has {n_values} numbers; found {values.shape[-1]}"
        )
    positions = values[:, :3]
    angles = values[:, 3:]
    if robot == "abb":
        return pose_stack(
            np.c_[positions, np.roll(angles, -1, axis=1)], "robot"
        )
    return pose_stack((_rotations(angles, robot), positions), "robot")


def _rotations(angles: FloatArray, robot: str) -> FloatArray:
    """Return the rotations (N, 3, 3) of angles (N, 3) in the robot's convention and unit."""
    if robot == "ur":
        return se3.rotation_exp(angles)
    rotations = Rotation.from_euler(_AXES[robot], angles, degrees=True)
    return np.asarray(rotations.as_matrix())


def read_robot_poses(path: Path, robot: str) -> FloatArray:
    """Read the poses (N, 4, 4) of a robot from a text file with one pose on each line.

    Empty lines and a first line with names of columns are skipped.
    """
    rows = []
    lines = read_text(path, "poses of a robot").splitlines()
    for number, line in enumerate(lines, 1):
        cells = [cell for cell in re.split(r"[\s,;]", line) if cell]
        with located(f"{path}, line {number}"):
            try:
                values = [float(cell) for cell in cells]
            except ValueError:
                if number == 1:
                    continue
                raise InputError("expected numbers") from None
            if values:
                rows.append(robot_poses(values, robot)[0])
    if not rows:
        raise InputError(f"{path}: no poses")
    return np.stack(rows)
