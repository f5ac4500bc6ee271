"""Parts of the two-stage methods: rotation from rotation vectors, then translation by linear least
squares.
"""

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import MotionPairs
from hand_eye_calib.solvers.solution import Solution

# Singular values of the translation problem below this share of the largest are rounding.
_RANK_TOLERANCE = 1e-12


def align_rotation_vectors(pairs: MotionPairs) -> FloatArray:
    """Find the rotation (3, 3) from the child's rotation vectors to the parent's, in least squares.

    ``R_A = R R_B R^T`` means ``log(R_A) = R log(R_B)``. The best R comes from the singular value
    decomposition of the 3 x 3 correlation of the vectors (Kabsch 1976), mirrored back if it is a
    reflection. No centroid is subtracted, because the vectors have a common origin. For a rotation
    by nearly pi, noise decides the sign of the vector.
    """
    rotvecs_parent = se3.rotation_log(pairs.Ts_parenti_parentj[:, :3, :3])
    rotvecs_child = se3.rotation_log(pairs.Ts_childi_childj[:, :3, :3])
    return se3.nearest_rotation(rotvecs_parent.T @ rotvecs_child)


def translation_given_rotation(pairs: MotionPairs, rotation: FloatArray) -> FloatArray:
    """Find the translation (3,), m, that solves ``(R_A - I) t = R t_B - t_A`` over all pairs in
    least squares; 0 along directions that no rotation reveals.
    """
    moved = pairs.Ts_parenti_parentj[:, :3, :3] - np.eye(3)
    target = pairs.Ts_childi_childj[:, :3, 3] @ rotation.T - pairs.Ts_parenti_parentj[:, :3, 3]
    found = np.linalg.lstsq(moved.reshape(-1, 3), target.ravel(), rcond=_RANK_TOLERANCE)
    return np.asarray(found[0], dtype=float)


def solve_in_two_stages(pairs: MotionPairs, rotation: FloatArray) -> Solution:
    """Complete a rotation (3, 3) by its translation; the objective is the squared translation
    residual.
    """
    T_parent_child = se3.from_rotation_translation(
        rotation, translation_given_rotation(pairs, rotation)
    )
    return Solution(
        T_parent_child,
        squared_translation_residual(pairs, T_parent_child),
        True,
        1,
        np.ones(len(pairs)),
    )


def squared_translation_residual(pairs: MotionPairs, T_parent_child: FloatArray) -> float:
    """Sum over the pairs of ``|R_A t + t_A - R t_B - t|^2``, m^2."""
    return float((pairs.translation_residuals(T_parent_child) ** 2).sum())
