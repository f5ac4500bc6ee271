"""Cost of a motion pair as a fixed quadratic form, and the minimum of the form over SE(3).

``A X - X B`` is linear in the thirteen variables ``x = (vec R, t, 1)`` (vec is row-major). So the
cost of pair k is a quadratic form with a constant symmetric 13 x 13 matrix,

    e_k(X) = | A X - X B |_F^2  (top three rows)  =  x' Q_k x,

and every weighted sum of costs is such a form. For any number of pairs, a Newton iteration in three
variables finds the minimum of the sum.

The residual is also linear in the pair: it is ``(A - I) X - X (B - I)``. The 24 coefficients u of a
pair are the elements of ``A - I`` and ``B - I``. So residuals, forms and sums of forms are products
of u with a constant array. Without the subtraction of the identity, small motions would lose
digits.
"""

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.stats import medians
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs

# Number of variables in x.
DIMENSION = 13

# Number of pairs that are condensed together. Their arrays fit into the cache of the processor.
_BLOCK = 128
# Number of pairs that are summed together. Their arrays are smaller.
_SUMMED_BLOCK = 1024

# Eigenvalues of the translation block below this share of the largest one are rounding, and count
# as zero.
_RANK_TOLERANCE = 1e-10

# Largest number of steps of a Newton iteration. A well-posed form needs about ten.
MAX_NEWTON_STEPS = 60
# A Newton iteration ends if a step is shorter than this (rad).
_STEP_TOLERANCE = 1e-12

# Smallest divisor, which prevents divisions by zero.
TINY = 1e-300

# Indices of the variables x in the sixteen entries of X.
_X_IN_T = np.array([0, 1, 2, 4, 5, 6, 8, 9, 10, 3, 7, 11, 15])

# Rows and columns of the upper triangle of a form.
_ROWS, _COLUMNS = np.triu_indices(DIMENSION)
# Number of times that each element of the triangle is in the form: twice off the diagonal.
_MULTIPLICITY = np.where(_ROWS == _COLUMNS, 1.0, 2.0)
# Index in the triangle of each element of a form.
_TRIANGLE = np.empty((DIMENSION, DIMENSION), dtype=int)
_TRIANGLE[_ROWS, _COLUMNS] = np.arange(len(_ROWS))
_TRIANGLE[_COLUMNS, _ROWS] = np.arange(len(_ROWS))

# Generators of rotations about x, y, z.
_GENERATORS = se3.skew(np.eye(3))


def _residual_table() -> FloatArray:
    """Return factors F (24, 12, 13) with residual ``r = sum_c,m u_c F[c, r, m] x_m``.

    The 12 residuals are the top three rows of ``(A - I) X - X (B - I)``, row-major.
    """
    flat = np.zeros((16, DIMENSION))
    flat[_X_IN_T, np.arange(DIMENSION)] = 1.0
    # X[i, j] = entry[i, j] @ x.
    entry = flat.reshape(4, 4, DIMENSION)
    # Element (i, k) of A - I multiplies X[k, j].
    of_parent = np.einsum("il,kjm->ikljm", np.eye(3), entry)
    # Element (k, j) of B - I multiplies X[i, k].
    of_child = -np.einsum("jl,ikm->kjilm", np.eye(4), entry[:3, :3])
    shape = (12, 12, DIMENSION)
    return np.concatenate([of_parent.reshape(shape), of_child.reshape(shape)])


def _twist_table() -> FloatArray:
    """Return matrices D (6, 4, 4): ``X D`` are the derivatives of ``X Exp(xi)`` at xi = 0."""
    twists = np.zeros((6, 4, 4))
    twists[[0, 1, 2], [0, 1, 2], 3] = 1.0
    twists[3:, :3, :3] = _GENERATORS
    return twists


def _tangent_table() -> FloatArray:
    """Return factors (16, 7 * 13) that map the entries of X to seven vectors like x (13,).

    The first six vectors are the derivatives of x along the six tangents; the last is x itself.
    """
    maps = np.concatenate([_twist_table(), np.eye(4)[None]])
    tangents = np.einsum("in,dkl->nkdil", np.eye(4), maps).reshape(16, 7, 16)
    return tangents[:, :, _X_IN_T].reshape(16, 7 * DIMENSION)


_RESIDUAL = _residual_table()
_TWISTS = _twist_table().reshape(6, 16)
_TANGENTS = _tangent_table()


def condense(pairs: MotionPairs) -> FloatArray:
    """Return the upper triangles (K, 91) of the forms Q_k of all K pairs.

    The elements have the order of ``numpy.triu_indices(13)``, so the costs of the pairs are
    ``condensed @ monomials(X)``.
    """
    condensed = np.empty((len(pairs), len(_ROWS)))
    u = coefficients(pairs)
    upper = _ROWS * DIMENSION + _COLUMNS
    for start in range(0, len(pairs), _BLOCK):
        block = slice(start, start + _BLOCK)
        residuals = (u[block] @ _RESIDUAL.reshape(24, -1)).reshape(
            -1, 12, DIMENSION
        )
        # numpy multiplies two arrays of small matrices faster than it squares one.
        forms = residuals.swapaxes(1, 2) @ residuals.copy()
        condensed[block] = forms.reshape(-1, DIMENSION**2).take(upper, axis=1)
    return condensed


def coefficients(pairs: MotionPairs) -> FloatArray:
    """Return the coefficients u (K, 24): the top three rows of A - I, then of B - I."""
    identity = np.eye(4)[:3]
    of_parent = (pairs.Ts_parenti_parentj[:, :3] - identity).reshape(-1, 12)
    of_child = (pairs.Ts_childi_childj[:, :3] - identity).reshape(-1, 12)
    return np.concatenate([of_parent, of_child], axis=1)


def costs(coefficients: FloatArray, T_parent_child: FloatArray) -> FloatArray:
    """Return the costs ``|A X - X B|_F^2`` (K,) of pairs with coefficients (K, 24)."""
    residuals = coefficients @ (_RESIDUAL @ T_parent_child.ravel()[_X_IN_T])
    return np.einsum("ki,ki->k", residuals, residuals)


def median_costs(
    coefficients: FloatArray, Ts: FloatArray, scales: FloatArray
) -> FloatArray:
    """Return the medians (S,) of the costs of all pairs, at each X and scale of the child.

    The costs are in the smaller unit of length. Otherwise, a scale of zero would always have the
    smallest cost.

    Parameters
    ----------
    coefficients : (K, 24) array
    Ts : (S, 4, 4) array
    scales : (S,) array
        Factors of the child's translations.
    """
    xs = Ts.reshape(-1, 16)[:, _X_IN_T]
    # Factors (S, 24, 12) from coefficients to residuals.
    by_u = np.tensordot(xs, _RESIDUAL, axes=(1, 2))
    # The second half of u is B - I (3, 4). Its last column is the child's translation.
    by_element = by_u.reshape(-1, 2, 3, 4, 12)
    by_element[:, 1, :, 3] *= scales[:, None, None]
    residuals = coefficients @ by_u
    costs_of_pairs = (residuals**2).sum(axis=2)
    units = np.minimum(scales, 1.0)
    return medians(costs_of_pairs) / units**2


def weighted_sum(coefficients: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the sum (13, 13) of the forms of K pairs, with weights (K,).

    The sum is computed from the coefficients (K, 24), which is faster than a sum of forms.
    """
    moments = np.zeros((24, 24))
    for start in range(0, len(coefficients), _SUMMED_BLOCK):
        block = slice(start, start + _SUMMED_BLOCK)
        weighted = coefficients[block] * weights[block, None]
        moments += weighted.T @ coefficients[block]
    by_residual = (moments @ _RESIDUAL.reshape(24, -1)).reshape(-1, DIMENSION)
    return _RESIDUAL.reshape(-1, DIMENSION).T @ by_residual


def decrease(
    Q: FloatArray, T_parent_child: FloatArray, T_parent_child_new: FloatArray
) -> np.float64:
    """Return the decrease of ``x' Q x`` from one transform to another, exact for small steps."""
    x = T_parent_child.ravel()[_X_IN_T]
    x_new = T_parent_child_new.ravel()[_X_IN_T]
    return np.float64((x - x_new) @ Q @ (x + x_new))


def monomials(T_parent_child: FloatArray) -> FloatArray:
    """Return the products ``x_i x_j`` (..., 91), i <= j, of transforms X (..., 4, 4).

    A product of two different variables is doubled, because the triangle contains it once.
    """
    entries = T_parent_child.reshape((*T_parent_child.shape[:-2], 16))
    first = entries.take(_X_IN_T[_ROWS], axis=-1)
    second = entries.take(_X_IN_T[_COLUMNS], axis=-1)
    return first * (second * _MULTIPLICITY)


def expand(condensed: FloatArray) -> FloatArray:
    """Return the symmetric matrices (..., 13, 13) with the upper triangles (..., 91)."""
    return condensed.take(_TRIANGLE, axis=-1)


def minimise(
    Q: FloatArray, rotation_start: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Minimise ``x' Q x`` over SE(3), for one form from several starts or for several forms.

    The translation is eliminated exactly. The remaining quadratic function of the nine entries of R
    is minimised by damped Newton steps ``R <- R Exp(phi)``.

    Parameters
    ----------
    Q : (13, 13) or (B, 13, 13) array
    rotation_start : (B, 3, 3) array
        Rotation at the start of each of B iterations.

    Returns
    -------
    (B, 4, 4) array
        Transforms X.
    (B,) array
        Values of the forms at X.
    (B,) bool array
        Whether each iteration converged.
    """
    R = np.array(rotation_start, dtype=float)
    whole_forms = np.broadcast_to(Q, (len(R), DIMENSION, DIMENSION))
    forms, to_translation = without_translation(whole_forms)
    constant = forms[:, 9, 9]
    value, gradient, hessian = _derivatives(forms, R)
    damping = np.zeros(len(R))
    converged = np.zeros(len(R), dtype=bool)
    for _ in range(MAX_NEWTON_STEPS):
        if converged.all():
            break
        step, length, curvature = _newton_step(gradient, hessian, damping)
        R_new = R @ se3.rotation_exp(step)
        value_new, gradient_new, hessian_new = _derivatives(forms, R_new)
        better = (value_new < value) & ~converged
        # Near the minimum, a step changes the value by less than rounding. This step is the last.
        rounding = 1e-15 * (np.abs(value) + np.abs(constant))
        stalled = ~better & (0.5 * curvature * length**2 <= rounding)
        converged |= (length < _STEP_TOLERANCE) | stalled
        is_damped = damping > 1e-9 * curvature
        less_damping = np.where(is_damped, 0.25 * damping, 0.0)
        more_damping = np.maximum(4 * damping, 1e-3 * curvature)
        damping = np.where(better, less_damping, more_damping)
        R[better] = R_new[better]
        hessian[better] = hessian_new[better]
        gradient[better] = gradient_new[better]
        value[better] = value_new[better]
    vectors = np.append(R.reshape(-1, 9), np.ones((len(R), 1)), axis=1)
    translations = -se3.times(to_translation, vectors)
    Ts = se3.from_rotation_translation(R, translations)
    return Ts, value + constant, converged


def without_translation(Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eliminate the translation from forms (B, 13, 13).

    Returns
    -------
    (B, 10, 10) array
        Forms of ``(vec R, 1)`` at the best translation for R.
    (B, 3, 10) array
        Factors that map ``(vec R, 1)`` to the negative best translation (m).
    """
    # Indices of t, and of vec R and 1, in x.
    translation = slice(9, 12)
    others = np.append(np.arange(9), 12)
    of_translation = Q[:, translation, translation]
    coupling = Q[:, translation][:, :, others]
    of_others = Q[:, others[:, None], others]
    # The pseudo-inverse of the translation block is zero along unobservable directions.
    values, vectors = np.linalg.eigh(of_translation)
    largest = np.maximum(values[:, -1:], np.finfo(float).tiny)
    is_observed = values > _RANK_TOLERANCE * largest
    inverse_values = np.divide(
        1.0, values, np.zeros_like(values), where=is_observed
    )
    inverse = (vectors * inverse_values[:, None]) @ vectors.swapaxes(1, 2)
    eliminated = coupling.swapaxes(1, 2) @ inverse @ coupling
    return of_others - eliminated, inverse @ coupling


def _newton_step(
    gradient: FloatArray, hessian: FloatArray, damping: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute damped Newton steps.

    Returns
    -------
    (B, 3) array
        Steps, limited to 1 rad.
    (B,) array
        Lengths of the steps before the limit, rad.
    (B,) array
        Largest absolute curvature of each form.
    """
    values, axes = np.linalg.eigh(hessian)
    # With absolute values, the step is a descent direction also along negative curvature.
    curvatures = np.abs(values)
    largest = curvatures.max(axis=1)
    # A curvature below rounding would make an arbitrarily long step.
    rounding = 1e-14 * np.maximum(largest, TINY)
    curvatures = np.maximum(curvatures, rounding[:, None])
    damped_curvatures = curvatures + damping[:, None]
    gradient_along_axes = axes.swapaxes(1, 2) @ gradient[:, :, None]
    step_along_axes = gradient_along_axes / damped_curvatures[:, :, None]
    step = -(axes @ step_along_axes)[:, :, 0]
    length = np.linalg.norm(step, axis=1)
    shortening = np.minimum(1.0, 1.0 / np.maximum(length, TINY))
    step *= shortening[:, None]
    return step, length, largest


def gauss_newton_step(Q: FloatArray, Ts_parent_child: FloatArray) -> FloatArray:
    """Take one Gauss-Newton step for each form from its own transform.

    The step is faster than a step of :func:`minimise`, but loses digits. It is for searches whose
    result is refined afterwards.

    Parameters
    ----------
    Q : (B, 13, 13) or (13, 13) array
        Sums of forms of pairs.
    Ts_parent_child : (B, 4, 4) array
        Transforms before the step.

    Returns
    -------
    (B, 4, 4) array
        Transforms after the step.
    """
    n_forms = len(Ts_parent_child)
    entries = Ts_parent_child.reshape(n_forms, 16)
    # Derivatives of x along the six tangents, then x itself. These seven vectors are linear in X.
    tangents = (entries @ _TANGENTS).reshape(n_forms, 7, DIMENSION)
    normal = tangents @ Q @ tangents.transpose(0, 2, 1)
    # The damping keeps X constant along directions that the pairs do not determine. It is too small
    # to slow down other directions. Every eighth of the 49 elements is on the diagonal.
    diagonal = normal.reshape(n_forms, 49)[:, :48:8]
    diagonal += 1e-12 * diagonal.sum(axis=1, keepdims=True) + TINY
    step = np.linalg.solve(normal[:, :6, :6], -normal[:, :6, 6:])
    # Cayley's map equals the exponential to second order, and is faster.
    twist = (step[:, :, 0] @ _TWISTS).reshape(n_forms, 4, 4)
    squared_angles = (step[:, 3:] ** 2).sum(axis=1, keepdims=True)
    shrink = 1 / (1 + 0.25 * squared_angles)
    second_order = twist + 0.5 * twist @ twist
    return Ts_parent_child @ (np.eye(4) + shrink * second_order)


def _derivatives(
    forms: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the values of forms of (vec R, 1) at ``R Exp(phi)``, and derivatives at phi = 0.

    With r = vec R, a form is ``r' S r + 2 linear' r`` plus a constant.

    Returns
    -------
    (B,) array
        Values without the constant.
    (B, 3) array
        Gradients.
    (B, 3, 3) array
        Hessians.
    """
    S = forms[:, :9, :9]
    linear = forms[:, :9, 9]
    r = R.reshape(-1, 9)
    S_r = se3.times(S, r)
    value = ((S_r + 2 * linear) * r).sum(axis=1)
    product = R.swapaxes(1, 2) @ (S_r + linear).reshape(-1, 3, 3)
    gradient = 2 * se3.vee(product)
    # Derivatives of r with respect to phi.
    tangents = (R[:, None] @ _GENERATORS).reshape(-1, 3, 9)
    trace = np.trace(product, axis1=1, axis2=2)
    symmetric = 0.5 * (product + product.swapaxes(1, 2))
    hessian = tangents @ S @ tangents.swapaxes(1, 2) + symmetric
    hessian = 2 * (hessian - trace[:, None, None] * np.eye(3))
    return value, gradient, hessian
