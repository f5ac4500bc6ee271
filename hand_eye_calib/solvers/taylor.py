"""Taylor: Kabsch on rotation vectors, then translation by linear least squares.

The coarse stage of Z. Taylor, J. Nieto, *Motion-based calibration of multimodal sensor arrays*,
IEEE International Conference on Robotics and Automation, 2015, with all readings of equal weight.
So reduced it is the same pair of least-squares problems as
:mod:`~hand_eye_calib.solvers.park`, and the published results of the two differ by rounding only; it keeps its own name because the
comparison of Välimäki et al. (2023) lists both.
"""

from hand_eye_calib.solvers import separable


def solve(pairs):
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
