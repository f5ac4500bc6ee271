"""Zhuang: simultaneous rotation and translation by Gauss-Newton on the identification Jacobian.

H. Zhuang, Z. Qu, *A new identification Jacobian for robotic hand/eye calibration*, IEEE
Transactions on Systems, Man, and Cybernetics 24(8), 1994, eqs 14-16.

With ``z = tan(w/2) k`` for the rotation by w about k, Cayley's formula ``R = (I - [z])^-1 (I +
[z])`` makes both parts of AX = XB polynomial after a multiplication by ``I - [z]``:

    f = [k_A + k_B] z + k_A - k_B                              (rotation axes: k_A = R k_B)
    g = (I - [z]) ((R_A - I) t + t_A) - (I + [z]) t_B          (translations)

Both residuals f and g are linear in the sixteen products of (1, z) with (1, t). A QR decomposition
condenses the pairs once. So an iteration takes equal time for any number of pairs.

The axes have unit length even for small angles, so noisy rotations bias the solution. A large
rotation of X also biases it, because g grows with this rotation. A rotation of X by pi has no
finite z.

The iteration starts from the identity. It may converge to a false minimum if X rotates by more than
about 1.8 rad. In the published results, this happens in 33 rows of one simulated trajectory, whose
X rotates by 3.13 rad; three of these rows are without noise. Such a solution is returned as
published, but ``converged`` is False if the cost near the solution of Park is lower.
"""

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs
from hand_eye_calib.core.solvers import all_pairs
from hand_eye_calib.core.solvers.all_pairs import Solution

# Largest number of iterations, as in the authors' program.
_MAX_ITERATIONS = 500
# The iteration ends if all components of a step, in m or in units of z, are below this limit, as in
# the authors' program.
_STEP_TOLERANCE = 1e-8

# A minimum is lower than another minimum if its cost is smaller by more than this share ...
_MIN_DIFFERENCE = 1e-6
# ... and by more than this rounding of the residuals, as a share of the data.
_ROUNDING = 1e-12


def solve(pairs: MotionPairs) -> Solution:
    """Solve AX = XB for K >= 1 pairs by Gauss-Newton from the identity.

    ``objective`` is the sum of ``|f|^2 + |g|^2`` over all pairs. ``converged`` is False if the
    iteration did not converge, or if it converged to a false minimum.
    """
    M = _condense(pairs)
    parameters, objective, settled = _gauss_newton(M, np.zeros(6))
    near_park = _parameters(all_pairs.solve_park(pairs).T_parent_child)
    _, objective_near_park, _ = _gauss_newton(M, near_park)
    # The cost at a false minimum exceeds the cost at the minimum near the solution of Park.
    rounding = _ROUNDING**2 * float((M**2).sum())
    is_lowest = (
        objective <= objective_near_park / (1 - _MIN_DIFFERENCE) + rounding
    )
    T_parent_child = se3.from_rotation_translation(
        _rotation(parameters[:3]), parameters[3:]
    )
    return Solution(
        T_parent_child, objective, settled and is_lowest, np.ones(len(pairs))
    )


def _gauss_newton(
    M: FloatArray, parameters: FloatArray
) -> tuple[FloatArray, float, bool]:
    """Minimise ``|M products(z, t)|^2`` from the start ``parameters`` = (z, t) (6,).

    M is the matrix of :func:`_condense`.

    Returns
    -------
    (6,) array
        The last (z, t).
    float
        Cost at the last (z, t).
    bool
        Whether the iteration converged.
    """
    for _ in range(_MAX_ITERATIONS):
        products, derivatives = _products(parameters)
        step, *_ = np.linalg.lstsq(
            M @ derivatives, -M @ products, rcond=all_pairs.RANK_TOLERANCE
        )
        parameters = parameters + step
        settled = bool((np.abs(step) < _STEP_TOLERANCE).all())
        if settled:
            break
    residuals = M @ _products(parameters)[0]
    return parameters, float(residuals @ residuals), settled


def _condense(pairs: MotionPairs) -> FloatArray:
    """Return the matrix M (at most 20, 16) that maps products of (1, z) with (1, t) to residuals.

    The sum of the squared residuals is that of ``|f|^2 + |g|^2`` over all pairs.
    """
    A = pairs.Ts_parenti_parentj
    B = pairs.Ts_childi_childj
    t_A = se3.translation_of(A)
    t_B = se3.translation_of(B)
    k_A = _axes(se3.rotation_of(A))
    k_B = _axes(se3.rotation_of(B))
    # Factors of (1, z) in f.
    by_z = se3.skew(k_A + k_B)
    f = np.concatenate([(k_A - k_B)[:, :, None], by_z], axis=2)
    # Coefficients (K, 3, i, j) of z_i t_j in g, with z_0 = t_0 = 1: g = (R_A - I) t + t_A - t_B -
    # [z] ((R_A - I) t + t_A + t_B). The slices i = 1, 2, 3 first contain the bracket; the einsum
    # then multiplies it by -[z].
    chords = se3.rotation_of(A) - np.eye(3)
    g = np.zeros((len(pairs), 3, 4, 4))
    g[..., 1:] = chords[:, :, None]
    g[:, :, 0, 0] = t_A - t_B
    g[:, :, 1:, 0] = (t_A + t_B)[:, :, None]
    brackets = g[:, :, 1:]
    g[:, :, 1:] = -np.einsum("zij,njzt->nizt", se3.skew(np.eye(3)), brackets)
    root_f = np.linalg.qr(f.reshape(-1, 4), mode="r")
    root_g = np.linalg.qr(g.reshape(-1, 16), mode="r")
    # f does not contain t. Its coefficients belong to the products with t_0 = 1.
    root_f_of_products = np.kron(root_f, [1.0, 0.0, 0.0, 0.0])
    return np.concatenate([root_f_of_products, root_g])


def _products(parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the products (16,) of (1, z) and (1, t), and the derivatives (16, 6).

    The derivatives are with respect to (z, t). Products are in row-major order of (z, t).
    """
    one_z = np.append(1.0, parameters[:3])
    one_t = np.append(1.0, parameters[3:])
    derivatives = np.zeros((4, 4, 6))
    derivatives[1:, :, :3] = one_t[:, None] * np.eye(3)[:, None]
    derivatives[:, 1:, 3:] = one_z[:, None, None] * np.eye(3)
    return np.outer(one_z, one_t).ravel(), derivatives.reshape(16, 6)


def _axes(rotations: FloatArray) -> FloatArray:
    """Return the unit rotation axes (K, 3); (0, 0, 1) for a rotation by zero."""
    rotvecs = se3.rotation_log(rotations)
    angles = np.linalg.norm(rotvecs, axis=1, keepdims=True)
    axes = np.tile([0.0, 0.0, 1.0], (len(angles), 1))
    return np.divide(rotvecs, angles, axes, where=angles > 0.0)


def _rotation(z: FloatArray) -> FloatArray:
    """Return the rotation matrix (3, 3) of ``z = tan(w/2) k``."""
    length = np.linalg.norm(z)
    factor = 2 * np.arctan(length) / length if length > 0.0 else 2.0
    return se3.rotation_exp(z * factor)


def _parameters(T_parent_child: FloatArray) -> FloatArray:
    """Return the parameters (z, t) (6,) of a transform."""
    rotvec = se3.rotation_log(se3.rotation_of(T_parent_child))
    angle = np.linalg.norm(rotvec)
    factor = np.tan(angle / 2) / angle if angle > 0.0 else 0.5
    return np.append(rotvec * factor, se3.translation_of(T_parent_child))
