"""The variant of Ali's method behind the published simulation results, for comparison only.

In this variant, the quaternion q = (w, x, y, z) is not normalised. The matrix that is fitted,

    M(q) = I + 2 sqrt(|q|) P(q),    P(q) = [[-yy-zz, xy-wz, xz+wy], [xy+wz, -xx-zz, yz-wx], [xz-wy,
    yz+wx, -xx-yy]],

is a rotation only if |q| = 1: a rotation has the factor ``1 / |q|^2`` in place of ``sqrt(|q|)``.
The translation residual is minimised over q and t from the identity, and q is normalised only
afterwards. The reported rotation therefore differs from the fitted matrix. With noise, |q| is often
between 0.5 and 1.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs
from hand_eye_calib.core.solvers.all_pairs import Solution, residual_rows

_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
_MAX_ITERATIONS = 300
_STEP_TOLERANCE = 1e-10
_LARGEST_START_GRADIENT = 100.0
_SUFFICIENT_DECREASE = 1e-8

# Increases of the cost below this share of the cost are rounding.
_ROUNDING = 10 * np.finfo(float).eps


def solve(pairs: MotionPairs) -> Solution:
    """Minimise the translation residual over an unnormalised quaternion, by Newton's method from
    the identity.

    The cost has several minima, and the steps decide which minimum is reached. The steps are those
    of Ipopt (Wächter, Biegler 2006) without constraints. The cost is scaled to a start gradient of
    at most 100, the Hessian is shifted until it is positive definite, and the step is halved until
    the cost decreases.

    Parameters
    ----------
    pairs : MotionPairs
        K pairs, K >= 1.

    Returns
    -------
    Solution
        ``objective`` is the squared translation residual of the returned transform, not of the
        fitted matrix. The solution has not converged if the cost still decreases while q grows
        without bound.
    """
    # Residuals use the triangular factor R, not the normal matrix R^T R, which loses half of the
    # digits on noise-free data.
    rows = np.asarray(np.linalg.qr(residual_rows(pairs), mode="r"))
    _, start_gradient, _ = _derivatives(_IDENTITY, rows)
    largest = max(np.abs(start_gradient).max(), np.finfo(float).tiny)
    rows *= np.sqrt(min(1.0, _LARGEST_START_GRADIENT / largest))
    parameters = _IDENTITY
    shift = 0.0
    for _ in range(_MAX_ITERATIONS):
        value, gradient, hessian = _derivatives(parameters, rows)
        step, shift = _descent_step(gradient, hessian, shift)
        slope = gradient @ step
        rounding = _ROUNDING * value
        length = 1.0
        rise = _value(parameters + step, rows) - value
        while rise > _SUFFICIENT_DECREASE * length * slope + rounding:
            length /= 2
            rise = _value(parameters + length * step, rows) - value
        parameters = parameters + length * step
        converged = bool(np.abs(step).max() < _STEP_TOLERANCE)
        if converged:
            break
    quat_xyzw = np.roll(parameters[:4], -1)
    rotation = Rotation.from_quat(quat_xyzw).as_matrix()
    T_parent_child = se3.from_rotation_translation(rotation, parameters[4:])
    translation_residuals = pairs.translation_residuals(T_parent_child)
    objective = float(np.sum(translation_residuals**2))
    return Solution(T_parent_child, objective, converged, np.ones(len(pairs)))


def _descent_step(
    gradient: FloatArray, hessian: FloatArray, last_shift: float
) -> tuple[FloatArray, float]:
    """Return the Newton step, and the shift of the Hessian's diagonal for the next step.

    Shifts are tried until the Hessian is positive definite: first zero, then growing shifts from
    about a third of ``last_shift``.
    """
    growth = 100.0
    first_shift = 1e-4
    if last_shift:
        growth = 8.0
        first_shift = max(last_shift / 3, 1e-20)
    smallest = np.linalg.eigvalsh(hessian)[0]
    shift = 0.0
    while smallest + shift <= 0.0:
        shift = shift * growth if shift else first_shift
    step = -np.linalg.solve(hessian + shift * np.eye(7), gradient)
    return np.asarray(step), shift or last_shift


def _symmetric(*entries: tuple[int, int, float]) -> FloatArray:
    matrix = np.zeros((4, 4))
    for row, column, value in entries:
        matrix[row, column] += value / 2
        matrix[column, row] += value / 2
    return matrix


_W, _X, _Y, _Z = range(4)
# Entry k of P, row by row, is q^T _P[k] q.
_P = np.array(
    [
        _symmetric((_Y, _Y, -1), (_Z, _Z, -1)),
        _symmetric((_X, _Y, 1), (_W, _Z, -1)),
        _symmetric((_X, _Z, 1), (_W, _Y, 1)),
        _symmetric((_X, _Y, 1), (_W, _Z, 1)),
        _symmetric((_X, _X, -1), (_Z, _Z, -1)),
        _symmetric((_Y, _Z, 1), (_W, _X, -1)),
        _symmetric((_X, _Z, 1), (_W, _Y, -1)),
        _symmetric((_Y, _Z, 1), (_W, _X, 1)),
        _symmetric((_X, _X, -1), (_Y, _Y, -1)),
    ]
)


def _factor(q: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return ``sqrt(|q|)``, its gradient (4,) and its Hessian (4, 4)."""
    squared = q @ q
    factor = float(squared**0.25)
    gradient = factor * q / (2 * squared)
    curvature = 0.75 * np.outer(q, q) / squared**2
    hessian = factor * (np.eye(4) / (2 * squared) - curvature)
    return factor, gradient, hessian


def _lift(parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the thirteen numbers x = (vec M(q), t, 1) and their derivative (13, 7).

    ``parameters`` (7,) are q and t. The residuals are linear in x.
    """
    q = parameters[:4]
    factor, factor_gradient, _ = _factor(q)
    half_gradient = _P @ q
    P = half_gradient @ q
    M = np.eye(3).ravel() + 2 * factor * P
    x = np.concatenate([M, parameters[4:], [1.0]])
    of_factor = 2 * np.outer(P, factor_gradient)
    derivative = np.zeros((13, 7))
    derivative[:9, :4] = of_factor + 4 * factor * half_gradient
    derivative[9:12, 4:] = np.eye(3)
    return x, derivative


def _value(parameters: FloatArray, rows: FloatArray) -> float:
    x, _ = _lift(parameters)
    residuals = rows @ x
    return float(residuals @ residuals)


def _derivatives(
    parameters: FloatArray, rows: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Return the cost, its gradient (7,) and its Hessian (7, 7) with respect to q and t.

    ``rows`` (n, 13) are the residuals as linear functions of x, see :func:`_lift`.
    """
    x, derivative = _lift(parameters)
    q = parameters[:4]
    residuals = rows @ x
    slope = rows @ derivative
    factor, factor_gradient, factor_hessian = _factor(q)
    weights = residuals @ rows
    weighted = np.tensordot(weights[:9], _P, axes=1)
    cross = np.outer(factor_gradient, 2 * weighted @ q)
    of_factor = factor_hessian * (q @ weighted @ q)
    curvature = of_factor + cross + cross.T + 2 * factor * weighted
    hessian = 2 * slope.T @ slope
    hessian[:4, :4] += 4 * curvature
    gradient = 2 * residuals @ slope
    return float(residuals @ residuals), gradient, hessian
