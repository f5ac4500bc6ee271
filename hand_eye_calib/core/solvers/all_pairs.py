"""Solvers with the same weight for all motion pairs, and the solution type of all solvers.

Park and Taylor solve AX = XB in two steps, with the rotation vectors a, b of the motions A and B:

    min sum |a - R b|^2,    then    min sum |(R_A - I) t - (R t_B - t_A)|^2

They are the first stages of two methods, with equal weights for all motions: C. Park, P. Moghadam,
S. Kim, S. Sridharan, C. Fookes, *Spatiotemporal camera-LiDAR calibration: a targetless and
structureless approach*, IEEE Robotics and Automation Letters 5(2), 2020, and Z. Taylor, J. Nieto,
*Motion-based calibration of multimodal sensor arrays*, IEEE International Conference on Robotics
and Automation, 2015. Both solve the same two least-squares problems, and their published results
differ only by rounding. Both names exist here, because the comparison of Välimäki et al. (2023)
lists both.

DNL minimises ``sum |A X - X B|_F^2``: direct non-linear optimisation (Välimäki et al. 2023, eq. 4).

Ali minimises only the translation residual. This is cost Xc1 of I. Ali, O. Suominen, A. Gotchev, E.
R. Morales, *Methods for simultaneous robot-world-hand-eye calibration: a comparative study*,
Sensors 19(12), 2019, as the program of its authors computes it: the rotation residual enters only
as the norm of a unit quaternion, which is constant (Välimäki et al. 2023, section 2). The
translation residual of AX - XB is a quadratic form in the same thirteen variables as the cost of
DNL.
"""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs
from hand_eye_calib.core.solvers import quadratic_form

# Singular values and eigenvalues below this share of the largest one are rounding: the motion does
# not excite their directions.
RANK_TOLERANCE = 1e-12


@dataclass(frozen=True)
class Solution:
    """Solution of AX = XB for K motion pairs.

    Attributes
    ----------
    T_parent_child : (4, 4) array
        X. Along directions that the motion does not excite, the translation is zero and the
        rotation is that of the start.
    objective : float
        Cost of the method at X.
    converged : bool
        Whether the iteration converged. If it did not, X is the best transform so far.
    weights : (K,) array
        Weight of each motion pair; 1 if the method does not reject outliers.
    """

    T_parent_child: FloatArray
    objective: float
    converged: bool
    weights: FloatArray


def solve_park(pairs: MotionPairs) -> Solution:
    """Solve AX = XB for K >= 1 pairs in two closed-form steps.

    ``objective`` is the cost of the second step, the sum of squared translation residuals (m^2).
    """
    R = align_rotation_vectors(pairs)
    rows, targets = translation_equations(pairs, R)
    t, *_ = np.linalg.lstsq(
        rows.reshape(-1, 3), targets.ravel(), rcond=RANK_TOLERANCE
    )
    T_parent_child = se3.from_rotation_translation(R, t)
    objective = float((pairs.translation_residuals(T_parent_child) ** 2).sum())
    return Solution(T_parent_child, objective, True, np.ones(len(pairs)))


def translation_equations(
    pairs: MotionPairs, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return both sides of the equations ``(R_A - I) t = R t_B - t_A`` for the translation t.

    Parameters
    ----------
    pairs : MotionPairs
        K pairs.
    R : (3, 3) array
        Rotation of X.

    Returns
    -------
    (K, 3, 3) array
        ``R_A - I``.
    (K, 3) array
        ``R t_B - t_A``, m.
    """
    A = pairs.Ts_parenti_parentj
    t_B = se3.translation_of(pairs.Ts_childi_childj)
    return se3.rotation_of(A) - np.eye(3), t_B @ R.T - se3.translation_of(A)


def align_rotation_vectors(
    pairs: MotionPairs, weights: FloatArray | None = None
) -> FloatArray:
    """Estimate the rotation R (3, 3) of X from rotation vectors a of the parent and b of the child.

    ``R_A = R R_B R'`` means ``a = R b``. The least squares solution comes from the singular value
    decomposition of the 3 x 3 correlation of the vectors (Kabsch 1976), where a reflection is
    corrected to a rotation. The vectors have a common origin, so no centroid is subtracted. Near
    pi, the sign of a rotation vector is random.

    Parameters
    ----------
    pairs : MotionPairs
        K pairs.
    weights : (K,) array, optional
        Weights of the pairs, 1 by default.
    """
    a = se3.rotation_log(se3.rotation_of(pairs.Ts_parenti_parentj))
    b = se3.rotation_log(se3.rotation_of(pairs.Ts_childi_childj))
    weighted = a if weights is None else a * weights[:, None]
    return se3.nearest_rotation(weighted.T @ b)


def solve_dnl(pairs: MotionPairs) -> Solution:
    """Minimise ``sum |A X - X B|_F^2`` over X, for K >= 1 pairs."""
    coefficients = quadratic_form.coefficients(pairs)
    weights = np.ones(len(pairs))
    Q = quadratic_form.weighted_sum(coefficients, weights)
    T, converged = _lowest_minimum(Q, pairs)
    objective = float(quadratic_form.costs(coefficients, T).sum())
    return Solution(T, objective, converged, weights)


def solve_ali(pairs: MotionPairs) -> Solution:
    """Minimise ``sum |R_A t + t_A - R t_B - t|^2`` over X, for K >= 1 pairs."""
    rows = residual_rows(pairs)
    T, converged = _lowest_minimum(rows.T @ rows, pairs)
    objective = float((pairs.translation_residuals(T) ** 2).sum())
    return Solution(T, objective, converged, np.ones(len(pairs)))


def residual_rows(pairs: MotionPairs) -> FloatArray:
    """Return the matrix (3 K, 13) that maps x to the residuals ``R_A t + t_A - R t_B - t``.

    ``x = (vec R, t, 1)`` with row-major vec.
    """
    rows = np.zeros((len(pairs), 3, quadratic_form.DIMENSION))
    of_child = -se3.translation_of(pairs.Ts_childi_childj)
    for axis in range(3):
        first = 3 * axis
        rows[:, axis, first : first + 3] = of_child
    rows[:, :, 9:12] = se3.rotation_of(pairs.Ts_parenti_parentj) - np.eye(3)
    rows[:, :, 12] = se3.translation_of(pairs.Ts_parenti_parentj)
    return rows.reshape(-1, quadratic_form.DIMENSION)


def _lowest_minimum(
    Q: FloatArray, pairs: MotionPairs
) -> tuple[FloatArray, bool]:
    """Return X (4, 4) at the lowest minimum of a form (13, 13), and whether it converged.

    The starts are those of :func:`start_rotations`.
    """
    Ts, values, converged = quadratic_form.minimise(Q, start_rotations(pairs))
    best = int(np.argmin(values))
    return Ts[best], bool(converged[best])


def pair_costs(pairs: MotionPairs, T_parent_child: FloatArray) -> FloatArray:
    """Return the costs ``|A X - X B|_F^2`` (K,), with more digits than the condensed forms."""
    return quadratic_form.costs(
        quadratic_form.coefficients(pairs), T_parent_child
    )


def start_rotations(pairs: MotionPairs) -> FloatArray:
    """Return rotations (4, 3, 3) of X from which iterations start.

    The first rotation aligns the rotation axes of both sensors. It is near the solution if the
    sensors rotate. The other three add a rotation of the child by pi about one of its axes. They
    help if the sensors hardly rotate.
    """
    # The antisymmetric part of a rotation matrix has the direction of the rotation axis, and is
    # faster to compute than a rotation vector.
    axes_parent = se3.vee(pairs.Ts_parenti_parentj)
    axes_child = se3.vee(pairs.Ts_childi_childj)
    U, _, V_transposed = np.linalg.svd(axes_parent.T @ axes_child)
    sign = np.linalg.det(U @ V_transposed)
    aligned = U @ np.diag([1.0, 1.0, sign]) @ V_transposed
    # The identity, and the rotations by pi about x, y and z.
    diagonals = [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]
    half_turns = [np.diag(diagonal) for diagonal in diagonals]
    return aligned @ half_turns
