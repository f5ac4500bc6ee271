"""Park: rotation by aligning rotation vectors, then translation by linear least squares.

The coarse stage of C. Park, P. Moghadam, S. Kim, S. Sridharan, C. Fookes, *Spatiotemporal
camera-LiDAR calibration: a targetless and structureless approach*, IEEE Robotics and Automation
Letters 5(2), 2020.
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
