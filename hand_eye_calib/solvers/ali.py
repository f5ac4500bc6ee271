"""Ali: rotation and translation together, from the translation residual alone.

Cost Xc1 of I. Ali, O. Suominen, A. Gotchev, E. R. Morales, *Methods for simultaneous
robot-world-hand-eye calibration: a comparative study*, Sensors 19(12), 2019, as its authors'
program computes it: the rotation residual of a motion pair enters only as the norm of a unit
quaternion, a constant (Välimäki et al. 2023, section 2). The rest is the translation of AX - XB,
a quadratic form in the same thirteen variables as dnl's cost. It is minimised in the same way over
proper rotations.
"""

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.pairing.motion_pairs import MotionPairs
from hand_eye_calib.solvers import quadratic_form
from hand_eye_calib.solvers.dnl import lowest
from hand_eye_calib.solvers.park import squared_translation_residual
from hand_eye_calib.solvers.solution import Solution


def solve(pairs: MotionPairs) -> Solution:
    """Minimise ``sum |R_A t + t_A - R t_B - t|^2`` over X, of K >= 1 pairs."""
    rows = residual_rows(pairs)
    T, converged, iterations = lowest(rows.T @ rows, pairs)
    objective = squared_translation_residual(pairs, T)
    return Solution(T, objective, converged, iterations, np.ones(len(pairs)))


def residual_rows(pairs: MotionPairs) -> FloatArray:
    """Matrix (3 K, 13) that maps ``x = (vec R, t, 1)``, vec row-major, to the residuals
    ``R_A t + t_A - R t_B - t``.
    """
    rows = np.zeros((len(pairs), 3, quadratic_form.DIMENSION))
    for axis in range(3):
        rows[:, axis, 3 * axis : 3 * axis + 3] = -pairs.Ts_childi_childj[:, :3, 3]
    rows[:, :, 9:12] = pairs.Ts_parenti_parentj[:, :3, :3] - np.eye(3)
    rows[:, :, 12] = pairs.Ts_parenti_parentj[:, :3, 3]
    return rows.reshape(-1, quadratic_form.DIMENSION)
