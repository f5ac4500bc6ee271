"""Park and Taylor: rotation by aligning rotation vectors, then translation by linear least squares.

The coarse stages of C. Park, P. Moghadam, S. Kim, S. Sridharan, C. Fookes, *Spatiotemporal
camera-LiDAR calibration: a targetless and structureless approach*, IEEE Robotics and Automation
Letters 5(2), 2020, and of Z. Taylor, J. Nieto, *Motion-based calibration of multimodal sensor
arrays*, IEEE International Conference on Robotics and Automation, 2015, with equal weights for all
readings. Both solve the same two least-squares problems, and their published results differ by
rounding only; they have names of their own because the comparison of Välimäki et al. (2023) lists
both.
"""

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import MotionPairs
from hand_eye_calib.solvers.solution import Solution

# Singular values below this share of the largest are rounding: directions that the motion does not
# reveal; they are not changed.
RANK_TOLERANCE = 1e-12


def solve(pairs: MotionPairs) -> Solution:
    """Solve AX = XB of K >= 1 pairs in two closed-form stages.

    ``objective`` is the sum of squared translation residuals, the cost of the second stage, in m^2.
    """
    rotation = align_rotation_vectors(pairs)
    # (R_A - I) t = R t_B - t_A; 0 along directions that no rotation reveals.
    moved = pairs.Ts_parenti_parentj[:, :3, :3] - np.eye(3)
    target = pairs.Ts_childi_childj[:, :3, 3] @ rotation.T - pairs.Ts_parenti_parentj[:, :3, 3]
    found = np.linalg.lstsq(moved.reshape(-1, 3), target.ravel(), rcond=RANK_TOLERANCE)
    T_parent_child = se3.from_rotation_translation(rotation, found[0])
    objective = float((pairs.residuals(T_parent_child)[0] ** 2).sum())
    return Solution(T_parent_child, objective, True, np.ones(len(pairs)))


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
