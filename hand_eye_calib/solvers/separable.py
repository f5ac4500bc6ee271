"""What the two-stage methods share: rotation from rotation vectors, then translation by linear
least squares.
"""

import numpy as np

from hand_eye_calib.geometry import se3
from hand_eye_calib.solvers.solution import Solution

# Singular values of the translation problem below this share of the largest are rounding, not
# motion.
_RANK_TOLERANCE = 1e-12


def align_rotation_vectors(pairs):
    """Rotation (3, 3) that brings the child's rotation vectors closest to the parent's, in least
    squares.

    Conjugation ``R_A = R R_B R^T`` turns rotation vectors as it turns points: ``log(R_A) = R
    log(R_B)``. The best R is found from the singular value decomposition of their 3 x 3 correlation
    (Kabsch 1976), mirrored back where it is a reflection. No centroid is taken off: the vectors
    have a common origin. A motion of nearly half a turn has a rotation vector whose sign is a
    matter of noise.
    """
    rotvecs_parent = se3.rotation_log(pairs.Ts_parenti_parentj[:, :3, :3])
    rotvecs_child = se3.rotation_log(pairs.Ts_childi_childj[:, :3, :3])
    left, _, right = np.linalg.svd(rotvecs_parent.T @ rotvecs_child)
    return left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right


def translation_given_rotation(pairs, rotation):
    """Translation (3,), in m, that best solves ``(R_A - I) t = R t_B - t_A`` over all pairs; 0
    along axes no pair turns about.
    """
    moved = pairs.Ts_parenti_parentj[:, :3, :3] - np.eye(3)
    target = pairs.Ts_childi_childj[:, :3, 3] @ rotation.T - pairs.Ts_parenti_parentj[:, :3, 3]
    return np.linalg.lstsq(moved.reshape(-1, 3), target.ravel(), rcond=_RANK_TOLERANCE)[0]


def solve_in_two_stages(pairs, rotation):
    """Solution with a given rotation and the translation that goes with it; its objective is the
    squared translation residual.
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


def squared_translation_residual(pairs, T_parent_child):
    """Sum over pairs of ``|R_A t + t_A - R t_B - t|^2``, in m^2."""
    return float((pairs.translation_residuals(T_parent_child) ** 2).sum())
