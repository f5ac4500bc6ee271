"""Zhuang: rotation and translation together, by Gauss-Newton on the identification Jacobian.

H. Zhuang, Z. Qu, *A new identification Jacobian for robotic hand/eye calibration*, IEEE
Transactions on Systems, Man, and Cybernetics 24(8), 1994, eqs 14-16.

With ``z = tan(w/2) k`` for the rotation by w about k, Cayley's formula ``R = (I - [z])^-1 (I +
[z])`` makes both halves of AX = XB polynomial once they are multiplied by ``I - [z]``:

    f = [k_A + k_B] z + k_A - k_B                              (rotation axes: k_A = R k_B)
    g = (I - [z]) ((R_A - I) t + t_A) - (I + [z]) t_B          (translations)

Both are linear in the sixteen products of (1, z) with (1, t). So the pairs are condensed once, by a
QR decomposition, and an iteration takes the same time for any number of pairs.

The axes enter with unit length even for the smallest angle, and g grows with the rotation of X:
with noisy rotations or a large rotation of X the answer is biased. A rotation of X by pi has no
finite z. From the identity the iteration may also settle in a false minimum, more often for larger
rotations of X (from about 1.8 rad on): in the published results 33 rows of one simulated trajectory
with an X of 3.13 rad, three noise-free ones among them. The answer is still the published one, but
it does not count as converged if the cost is lower near park's answer.
"""

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs
from hand_eye_calib.core.solvers import all_pairs
from hand_eye_calib.core.solvers.all_pairs import Solution

_MAX_ITERATIONS = 500
_STEP_TOLERANCE = 1e-8

# A minimum is lower by at least this share of the cost, and by residuals of this share of the data.
_LOWER = 1e-6
_ROUNDING = 1e-12


def solve(pairs: MotionPairs) -> Solution:
    """Solve AX = XB of K >= 1 pairs by Gauss-Newton from the identity.

    ``objective`` is the sum of ``|f|^2 + |g|^2``. ``converged`` is False if the iteration did not
    settle or settled in a false minimum.
    """
    residual_of_products = _condense(pairs)
    parameters, objective, settled = _gauss_newton(residual_of_products, np.zeros(6))
    near_park = _parameters(all_pairs.solve_park(pairs).T_parent_child)
    _, elsewhere, _ = _gauss_newton(residual_of_products, near_park)
    rounding = _ROUNDING**2 * float((residual_of_products**2).sum())
    lowest = objective <= elsewhere / (1 - _LOWER) + rounding
    T_parent_child = se3.from_rotation_translation(_rotation(parameters[:3]), parameters[3:])
    return Solution(T_parent_child, objective, settled and lowest, np.ones(len(pairs)))


def _gauss_newton(
    residual_of_products: FloatArray, parameters: FloatArray
) -> tuple[FloatArray, float, bool]:
    """Iterate from (z, t) (6,): the last (z, t), its cost, and whether the iteration
    settled.
    """
    for _ in range(_MAX_ITERATIONS):
        products, derivative = _products(parameters)
        rows = residual_of_products @ derivative
        values = -residual_of_products @ products
        step = np.linalg.lstsq(rows, values, rcond=all_pairs.RANK_TOLERANCE)[0]
        parameters = parameters + step
        settled = bool((np.abs(step) < _STEP_TOLERANCE).all())
        if settled:
            break
    residuals = residual_of_products @ _products(parameters)[0]
    return parameters, float(residuals @ residuals), settled


def _condense(pairs: MotionPairs) -> FloatArray:
    """Matrix (at most 20, 16) that maps the products to residuals of the same squared length as all
    f and g together.
    """
    Ts_parent = pairs.Ts_parenti_parentj
    Ts_child = pairs.Ts_childi_childj
    rotation_parent = Ts_parent[:, :3, :3]
    translation_parent = Ts_parent[:, :3, 3]
    translation_child = Ts_child[:, :3, 3]
    axes_parent = _axes(rotation_parent)
    axes_child = _axes(Ts_child[:, :3, :3])
    apart = axes_parent - axes_child
    together = axes_parent + axes_child
    f = np.concatenate([apart[:, :, None], se3.skew(together)], axis=2)
    g = np.zeros((len(pairs), 3, 4, 4))
    g[..., 1:] = (rotation_parent - np.eye(3))[:, :, None]
    g[:, :, 0, 0] = translation_parent - translation_child
    g[:, :, 1:, 0] = (translation_parent + translation_child)[:, :, None]
    g[:, :, 1:] = -np.einsum("zij,njzt->nizt", se3.skew(np.eye(3)), g[:, :, 1:])
    f_of_products = np.kron(np.linalg.qr(f.reshape(-1, 4), mode="r"), [1.0, 0.0, 0.0, 0.0])
    return np.concatenate([f_of_products, np.linalg.qr(g.reshape(-1, 16), mode="r")])


def _products(parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Products (16,) of (1, z) and (1, t), z slowest, and their derivatives (16, 6) by (z, t)."""
    one_z = np.append(1.0, parameters[:3])
    one_t = np.append(1.0, parameters[3:])
    derivative = np.zeros((4, 4, 6))
    derivative[1:, :, :3] = one_t[:, None] * np.eye(3)[:, None]
    derivative[:, 1:, 3:] = one_z[:, None, None] * np.eye(3)
    return np.outer(one_z, one_t).ravel(), derivative.reshape(16, 6)


def _axes(rotation: FloatArray) -> FloatArray:
    """Unit rotation axes (K, 3); (0, 0, 1) without rotation."""
    rotvec = se3.rotation_log(rotation)
    angle = np.linalg.norm(rotvec, axis=1, keepdims=True)
    return np.divide(rotvec, angle, np.tile([0.0, 0.0, 1.0], (len(angle), 1)), where=angle > 0.0)


def _rotation(z: FloatArray) -> FloatArray:
    """Rotation matrix (3, 3) of ``z = tan(w/2) k``."""
    length = np.linalg.norm(z)
    return se3.rotation_exp(z * (2 * np.arctan(length) / length if length > 0.0 else 2.0))


def _parameters(T_parent_child: FloatArray) -> FloatArray:
    """(z, t) (6,) of a transform, the inverse of ``_rotation`` for z."""
    rotvec = se3.rotation_log(T_parent_child[:3, :3])
    angle = np.linalg.norm(rotvec)
    return np.append(
        rotvec * (np.tan(angle / 2) / angle if angle > 0.0 else 0.5), T_parent_child[:3, 3]
    )
