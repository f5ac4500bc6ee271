"""The cost of a motion pair as a fixed quadratic form, and its minimum over SE(3).

``A X - X B`` is linear in the thirteen variables ``x = (vec R, t, 1)`` (vec is row-major). The cost
of pair k,

    e_k(X) = | A X - X B |_F^2  (top three rows)  =  x^T Q_k x,

is therefore a quadratic form with a constant symmetric 13 x 13 matrix, and so is every weighted sum
of pairs. Its minimum takes a Newton iteration in three variables, for any number of pairs.

The residual is linear in the pair, too: it is ``(A - I) X - X (B - I)``, where a pair enters with
the 24 coefficients u of ``A - I`` and ``B - I``. Residuals, forms and sums of forms are thus matrix
products of u with a constant array. Subtracting the identity first keeps the digits of small
motions.
"""

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.stats import medians
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs

DIMENSION = 13

# Pairs per block, so that the intermediate arrays stay in the cache of the processor.
_BLOCK = 128
_SUMMED_BLOCK = 1024

# Eigenvalues of the translation block below this share of the largest are rounding: they count as
# zero.
_RANK_TOLERANCE = 1e-10

_MAX_NEWTON_STEPS = 60
_STEP_TOLERANCE = 1e-12


def _tables() -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Arrays that the forms are made of.

    Positions (13,) of x in the sixteen entries of X. Factors (24, 12, 13) of coefficient u of a
    pair times variable m of x in residual (i, j). D (6, 16) of ``X D``, the derivative of X along
    each tangent (rho, phi). What X.ravel() times gives x of X D for all six, then x (16, 91).
    """
    x_in_T = np.array([0, 1, 2, 4, 5, 6, 8, 9, 10, 3, 7, 11, 15])
    flat = np.zeros((16, DIMENSION))
    flat[x_in_T, np.arange(DIMENSION)] = 1.0
    entry = flat.reshape(4, 4, DIMENSION)  # X[i, j] = entry[i, j] @ x
    of_parent = np.einsum("il,kjm->ikljm", np.eye(3), entry)
    of_child = -np.einsum("jl,ikm->kjilm", np.eye(4), entry[:3, :3])
    residual = np.concatenate([each.reshape(12, 12, DIMENSION) for each in (of_parent, of_child)])
    twists = np.zeros((6, 4, 4))
    twists[[0, 1, 2], [0, 1, 2], 3] = 1.0
    twists[3:, :3, :3] = _GENERATORS
    tangents = np.einsum("in,dkl->nkdil", np.eye(4), np.concatenate([twists, np.eye(4)[None]]))
    tangents = tangents.reshape(16, 7, 16)[:, :, x_in_T].reshape(16, 7 * DIMENSION)
    return x_in_T, residual, twists.reshape(6, 16), tangents


_ROWS, _COLUMNS = np.triu_indices(DIMENSION)
_MULTIPLICITY = np.where(_ROWS == _COLUMNS, 1.0, 2.0)
_TRIANGLE = np.empty((DIMENSION, DIMENSION), dtype=int)
_TRIANGLE[_ROWS, _COLUMNS] = _TRIANGLE[_COLUMNS, _ROWS] = np.arange(len(_ROWS))
_GENERATORS = se3.skew(np.eye(3))
_X_IN_T, _RESIDUAL, _TWISTS, _TANGENTS = _tables()


def condense(pairs: MotionPairs) -> FloatArray:
    """Upper triangles (K, 91) of every pair's Q_k, in the order of ``numpy.triu_indices(13)``:
    ``condensed @ monomials(X)`` gives all costs.
    """
    condensed = np.empty((len(pairs), len(_ROWS)))
    u = coefficients(pairs)
    upper = _ROWS * DIMENSION + _COLUMNS
    for start in range(0, len(pairs), _BLOCK):
        block = slice(start, start + _BLOCK)
        residuals = (u[block] @ _RESIDUAL.reshape(24, -1)).reshape(-1, 12, DIMENSION)
        # numpy multiplies two arrays of small matrices faster than it squares one.
        forms = np.swapaxes(residuals, 1, 2) @ residuals.copy()
        condensed[block] = forms.reshape(-1, DIMENSION**2).take(upper, axis=1)
    return condensed


def coefficients(pairs: MotionPairs) -> FloatArray:
    """Coefficients (K, 24) that the residuals are linear in: the top three rows of A - I, then of
    B - I, of each pair.
    """
    both = pairs.Ts_parenti_parentj, pairs.Ts_childi_childj
    moved = [(Ts[:, :3] - np.eye(4)[:3]).reshape(-1, 12) for Ts in both]
    return np.concatenate(moved, axis=1)


def costs(coefficients: FloatArray, T_parent_child: FloatArray) -> FloatArray:
    """Costs ``|A X - X B|_F^2`` (K,) at one X, from the :func:`coefficients` of the pairs."""
    residuals = coefficients @ (_RESIDUAL @ T_parent_child.ravel()[_X_IN_T])
    return np.asarray(np.einsum("ki,ki->k", residuals, residuals))


def median_costs(coefficients: FloatArray, Ts: FloatArray, scales: FloatArray) -> FloatArray:
    """Medians (S,) of the costs at each X (S, 4, 4), the child's translations times its scale, in
    the smaller unit of length: otherwise a scale of zero would cost least.
    """
    at = np.tensordot(Ts.reshape(-1, 16)[:, _X_IN_T], _RESIDUAL, axes=(1, 2))
    at.reshape(-1, 2, 3, 4, 12)[:, 1, :, 3] *= scales[:, None, None]
    return medians(((coefficients @ at) ** 2).sum(axis=2)) / np.minimum(scales, 1.0) ** 2


def weighted_sum(coefficients: FloatArray, weights: FloatArray) -> FloatArray:
    """Sum (13, 13) of the forms with weights (K,), from the :func:`coefficients` of the pairs,
    without making the forms.
    """
    moments = np.zeros((24, 24))
    for start in range(0, len(coefficients), _SUMMED_BLOCK):
        block = slice(start, start + _SUMMED_BLOCK)
        moments += (coefficients[block] * weights[block, None]).T @ coefficients[block]
    return _RESIDUAL.reshape(-1, DIMENSION).T @ (moments @ _RESIDUAL.reshape(24, -1)).reshape(
        -1, DIMENSION
    )


def decrease(
    Q: FloatArray, T_parent_child: FloatArray, T_parent_child_new: FloatArray
) -> np.float64:
    """Decrease of ``x^T Q x`` of one form (13, 13) from one transform (4, 4) to another, accurate
    for small steps.
    """
    x = T_parent_child.ravel()[_X_IN_T]
    x_new = T_parent_child_new.ravel()[_X_IN_T]
    return np.float64((x - x_new) @ Q @ (x + x_new))


def monomials(T_parent_child: FloatArray) -> FloatArray:
    """Products ``x_i x_j`` (..., 91) of two variables of transforms (..., 4, 4), doubled off the
    diagonal, which map condensed forms to costs.
    """
    entries = T_parent_child.reshape((*T_parent_child.shape[:-2], 16))
    first = entries.take(_X_IN_T[_ROWS], axis=-1)
    return first * (entries.take(_X_IN_T[_COLUMNS], axis=-1) * _MULTIPLICITY)


def expand(condensed: FloatArray) -> FloatArray:
    """Symmetric (..., 13, 13) matrices from upper triangles (..., 91)."""
    return condensed.take(_TRIANGLE, axis=-1)


def minimise(Q: FloatArray, rotation_start: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Minimise ``x^T Q x`` over SE(3), from several rotations or for several forms at once.

    The translation is eliminated exactly. The rest is a quadratic function of the nine entries of
    R, minimised by damped Newton steps ``R <- R Exp(phi)``.

    Parameters
    ----------
    Q : (13, 13) or (B, 13, 13) array
    rotation_start : (B, 3, 3) array

    Returns
    -------
    (B, 4, 4), (B,), (B,) bool arrays
        Transforms, the forms there, and whether the iteration settled.
    """
    rotation = np.array(rotation_start, dtype=float)
    Q = np.broadcast_to(Q, (len(rotation), DIMENSION, DIMENSION))
    reduced, to_translation = without_translation(Q)
    constant = reduced[:, 9, 9]
    value, gradient, hessian = _derivatives(reduced, rotation)
    damping = np.zeros(len(rotation))
    converged = np.zeros(len(rotation), dtype=bool)
    for _ in range(_MAX_NEWTON_STEPS):
        if converged.all():
            break
        step, length, scale = _newton_step(gradient, hessian, damping)
        trial = rotation @ se3.rotation_exp(step)
        trial_value, trial_gradient, trial_hessian = _derivatives(reduced, trial)
        better = (trial_value < value) & ~converged
        # At the rounding level the value falls no more. A tiny step that hardly raises it is the
        # last.
        rounding = 1e-15 * (np.abs(value) + np.abs(constant))
        stalled = ~better & (0.5 * scale * length**2 <= rounding)
        converged |= (length < _STEP_TOLERANCE) | stalled
        damping = np.where(
            better, 0.25 * damping * (damping > 1e-9 * scale), np.maximum(4 * damping, 1e-3 * scale)
        )
        pick = better[:, None, None]
        rotation = np.where(pick, trial, rotation)
        hessian = np.where(pick, trial_hessian, hessian)
        gradient = np.where(better[:, None], trial_gradient, gradient)
        value = np.where(better, trial_value, value)
    vectors = np.append(rotation.reshape(-1, 9), np.ones((len(rotation), 1)), axis=1)
    translation = -se3.times(to_translation, vectors)
    Ts = se3.from_rotation_translation(rotation, translation)
    return Ts, value + constant, converged


def without_translation(Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Forms (B, 10, 10) of ``(vec R, 1)`` at the best translation for R, and what gives minus that,
    m, times ``(vec R, 1)`` (B, 3, 10).
    """
    of_rest = np.append(np.arange(9), 12)
    translation_rest = Q[:, 9:12][:, :, of_rest]
    values, vectors = np.linalg.eigh(Q[:, 9:12, 9:12])
    seen = values > _RANK_TOLERANCE * np.maximum(values[:, -1:], np.finfo(float).tiny)
    inverse_values = np.where(seen, 1.0 / np.where(seen, values, 1.0), 0.0)
    gain = (vectors * inverse_values[:, None]) @ np.swapaxes(vectors, 1, 2)
    eliminated = np.swapaxes(translation_rest, 1, 2) @ gain @ translation_rest
    return Q[:, of_rest[:, None], of_rest] - eliminated, gain @ translation_rest


def _newton_step(
    gradient: FloatArray, hessian: FloatArray, damping: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Damped Newton steps (B, 3), rad, of at most 1 rad; their lengths (B,) before that limit, and
    the largest curvatures (B,).
    """
    curvature, axes = np.linalg.eigh(hessian)
    # The absolute value follows negative curvature downhill, too; the limit avoids a division by
    # rounding.
    size = np.maximum(
        np.abs(curvature),
        1e-14 * np.maximum(np.abs(curvature).max(axis=1, keepdims=True), 1e-300),
    )
    along = np.swapaxes(axes, 1, 2) @ gradient[:, :, None]
    step = -(axes @ (along / (size + damping[:, None])[:, :, None]))[:, :, 0]
    length = np.linalg.norm(step, axis=1)
    step *= np.minimum(1.0, 1.0 / np.maximum(length, 1e-300))[:, None]
    return step, length, np.abs(curvature).max(axis=1)


def gauss_newton_step(Q: FloatArray, Ts_parent_child: FloatArray) -> FloatArray:
    """Transforms (B, 4, 4) after one Gauss-Newton step of each form Q (B, 13, 13), a sum of those
    of pairs, from its own transform. It is fast, for searches whose result is refined afterwards.
    """
    n_forms = len(Ts_parent_child)
    # The derivatives of x along the six tangents at X, and x itself, are linear in X.
    tangents = (Ts_parent_child.reshape(n_forms, 16) @ _TANGENTS).reshape(n_forms, 7, DIMENSION)
    normal = tangents @ Q @ tangents.transpose(0, 2, 1)
    # Enough damping to leave directions unchanged that the pairs do not reveal, too little to slow
    # down the others.
    diagonal = normal.reshape(n_forms, 49)[:, :48:8]
    diagonal += 1e-12 * diagonal.sum(axis=1, keepdims=True) + 1e-300
    step = np.linalg.solve(normal[:, :6, :6], -normal[:, :6, 6:])
    # Cayley's map: a rotation, equal to the exponential up to second order, and faster.
    twist = (step[:, :, 0] @ _TWISTS).reshape(n_forms, 4, 4)
    shrink = 1 / (1 + 0.25 * (step[:, 3:] ** 2).sum(axis=1, keepdims=True))
    return Ts_parent_child @ (np.eye(4) + shrink * (twist + 0.5 * twist @ twist))


def _derivatives(
    reduced: FloatArray, rotation: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Value (B,) of forms of (vec R, 1) without the constant, gradient (B, 3) and Hessian (B, 3, 3)
    under ``R Exp(phi)`` at phi = 0.
    """
    S = reduced[:, :9, :9]
    linear = reduced[:, :9, 9]
    flat = rotation.reshape(-1, 9)
    S_flat = se3.times(S, flat)
    value = ((S_flat + 2 * linear) * flat).sum(axis=1)
    product = np.swapaxes(rotation, 1, 2) @ (S_flat + linear).reshape(-1, 3, 3)
    gradient = 2 * se3.vee(product)
    tangents = (rotation[:, None] @ _GENERATORS).reshape(-1, 3, 9)
    trace = np.trace(product, axis1=1, axis2=2)
    hessian = 2 * (
        tangents @ S @ np.swapaxes(tangents, 1, 2)
        + 0.5 * (product + np.swapaxes(product, 1, 2))
        - trace[:, None, None] * np.eye(3)
    )
    return value, gradient, hessian
