"""Errors of a transform against another. Metres and radians."""

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3


def absolute_errors(
    T_parent_child: FloatArray, truth_T_parent_child: FloatArray
) -> tuple[float, float]:
    """Absolute errors e_at (m) and e_aR (rad) of a transform (4, 4) against the true one: eqs 8 and
    9 of Välimäki et al. 2023.
    """
    translation = np.linalg.norm(truth_T_parent_child[:3, 3] - T_parent_child[:3, 3])
    rotation = se3.rotation_angle(T_parent_child[:3, :3].T @ truth_T_parent_child[:3, :3])
    return float(translation), float(rotation)


def deviation(T_parent_child: FloatArray, T_reference: FloatArray) -> FloatArray:
    """Deviations (..., 6) of transforms (..., 4, 4) from another (4, 4), along (m) and about (rad)
    the axes of the parent sensor's frame.
    """
    rotation = se3.rotation_log(T_parent_child[..., :3, :3] @ T_reference[:3, :3].T)
    translation = T_parent_child[..., :3, 3] - T_reference[:3, 3]
    return np.concatenate([translation, rotation], axis=-1)
