"""Taylor: Kabsch on rotation vectors, then translation by linear least squares.

The coarse stage of Z. Taylor, J. Nieto, *Motion-based calibration of multimodal sensor arrays*,
IEEE International Conference on Robotics and Automation, 2015, with equal weights for all readings.
In this form it solves the same two least-squares problems as :mod:`~hand_eye_calib.solvers.park`,
and the published results of the two differ by rounding only. It has a name of its own because the
comparison of Välimäki et al. (2023) lists both.
"""

from hand_eye_calib.pairing.motion_pairs import MotionPairs
from hand_eye_calib.solvers import separable
from hand_eye_calib.solvers.solution import Solution


def solve(pairs: MotionPairs) -> Solution:
    """Solve AX = XB in two closed-form stages.

    Parameters
    ----------
    pairs : MotionPairs
        K pairs, K >= 1.

    Returns
    -------
    Solution
        ``objective`` is the sum of squared translation residuals, the cost of the second stage, in
        m^2.
    """
    return separable.solve_in_two_stages(pairs, separable.align_rotation_vectors(pairs))
