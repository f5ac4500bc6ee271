"""The cost of a motion pair as a fixed quadratic form, and its minimum over SE(3).

``A X - X B`` is linear in ``x = (vec R, t, 1)``, thirteen numbers (vec is row-major). The cost of pair k,

    e_k(X) = | A X - X B |_F^2  (top three rows)  =  x^T Q_k x,

is therefore a quadratic form with a constant symmetric 13 x 13 matrix. The pairs are condensed once, into the 91 numbers of
each upper triangle; from then on every residual is one matrix product and every weighted sum of pairs is again one 13 x 13
matrix, whose minimum takes a three-variable Newton iteration however many pairs went in.
"""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.geometry import se3

DIMENSION = 13
_ROWS, _COLUMNS = np.triu_indices(DIMENSION)
_ROTATION, _TRANSLATION, _ONE = slice(0, 9), slice(9, 12), 12

# Pairs condensed at a time: keeps the intermediate arrays in the processor's cache.
_BLOCK = 1024

# Eigenvalues of the translation block below this share of the largest count as zero: rounding, not motion.
_RANK_TOLERANCE = 1e-10

_MAX_NEWTON_STEPS = 60
_STEP_TOLERANCE = 1e-12
_GENERATORS = se3.skew(np.eye(3))


def condense(pairs):
    """Upper triangles of every pair's Q_k.

    Parameters
    ----------
    pairs : MotionPairs
        K pairs.

    Returns
    -------
    (K, 91) array
        In the order of ``numpy.triu_indices(13)``; ``condensed @ monomials(X)`` gives all costs.
    """
    condensed = np.empty((len(_ROWS), len(pairs)))
    for start in range(0, len(pairs), _BLOCK):
        block = slice(start, start + _BLOCK)
        condensed[:, block] = _triangles(pairs.Ts_parenti_parentj[block], pairs.Ts_childi_childj[block])
    return condensed.T


def _triangles(Ts_parenti_parentj, Ts_childi_childj):
    """Upper triangles (91, K), one row per entry: every operation runs along the pairs."""
    n_pairs = len(Ts_parenti_parentj)
    R_a = Ts_parenti_parentj[:, :3, :3].reshape(n_pairs, 9).T.copy()
    R_b = Ts_childi_childj[:, :3, :3].reshape(n_pairs, 9).T.copy()
    t_a, t_b = Ts_parenti_parentj[:, :3, 3].T.copy(), Ts_childi_childj[:, :3, 3].T.copy()
    moved = R_a.copy()
    moved[[0, 4, 8]] -= 1.0
    triangles = np.empty((len(_ROWS), n_pairs))
    # |R_A R - R R_B|^2 = 2 |R|^2 - 2 sum_ijkl A_ik R_kj R_il B_lj, plus |R t_B|^2
    triangles[_RR] = -(R_a[_A_IK] * R_b[_B_LJ] + R_a[_A_KI] * R_b[_B_JL])
    triangles[_RR_DIAGONAL] += 2.0
    triangles[_RR_SAME_ROW] += t_b[_J_SAME_ROW] * t_b[_L_SAME_ROW]
    # the translation residual is (R_A - I) t + t_A - R t_B
    triangles[_RT] = -moved[_MOVED_IA] * t_b[_J_RT]
    triangles[_R1] = -t_a[_I_R1] * t_b[_J_R1]
    columns = moved.reshape(3, 3, n_pairs)  # columns[i, a] is (R_A - I)_ia
    triangles[_TT] = (columns[:, _A_TT] * columns[:, _B_TT]).sum(axis=0)
    triangles[_T1] = (columns * t_a[:, None]).sum(axis=0)
    triangles[_11] = (t_a * t_a).sum(axis=0)
    return triangles


# Where the blocks of Q lie in its upper triangle, and which entries of A and B meet there. Rows 0-8 are vec R: entry 3 k + j is R_kj.
_RR, _RT, _R1 = (
    np.flatnonzero((_ROWS < 9) & where) for where in (_COLUMNS < 9, (_COLUMNS > 8) & (_COLUMNS < 12), _COLUMNS == 12)
)
_TT, _T1, _11 = (
    np.flatnonzero((_ROWS > 8) & where) for where in ((_COLUMNS < 12), (_ROWS < 12) & (_COLUMNS == 12), _ROWS == 12)
)
(_K, _J), (_I, _L) = np.divmod(_ROWS[_RR], 3), np.divmod(_COLUMNS[_RR], 3)
_A_IK, _A_KI, _B_LJ, _B_JL = 3 * _I + _K, 3 * _K + _I, 3 * _L + _J, 3 * _J + _L
_RR_DIAGONAL = _RR[_ROWS[_RR] == _COLUMNS[_RR]]
_RR_SAME_ROW, _J_SAME_ROW, _L_SAME_ROW = _RR[_K == _I], _J[_K == _I], _L[_K == _I]
_MOVED_IA, _J_RT = 3 * (_ROWS[_RT] // 3) + _COLUMNS[_RT] - 9, _ROWS[_RT] % 3
_I_R1, _J_R1 = np.divmod(_ROWS[_R1], 3)
_A_TT, _B_TT = _ROWS[_TT] - 9, _COLUMNS[_TT] - 9


def monomials(T_parent_child):
    """The 91 products that turn condensed forms into costs.

    Parameters
    ----------
    T_parent_child : (..., 4, 4) array

    Returns
    -------
    (..., 91) array
        ``x_i x_j``, doubled off the diagonal.
    """
    T_parent_child = np.asarray(T_parent_child, dtype=float)
    x = np.concatenate(
        [
            T_parent_child[..., :3, :3].reshape(T_parent_child.shape[:-2] + (9,)),
            T_parent_child[..., :3, 3],
            np.ones(T_parent_child.shape[:-2] + (1,)),
        ],
        axis=-1,
    )
    return x[..., _ROWS] * x[..., _COLUMNS] * _MULTIPLICITY


_MULTIPLICITY = np.where(_ROWS == _COLUMNS, 1.0, 2.0)


def expand(condensed):
    """Symmetric (..., 13, 13) matrices from upper triangles (..., 91)."""
    matrices = np.empty(condensed.shape[:-1] + (DIMENSION, DIMENSION))
    matrices[..., _ROWS, _COLUMNS] = condensed
    matrices[..., _COLUMNS, _ROWS] = condensed
    return matrices


def _pseudo_inverse(matrices):
    values, vectors = np.linalg.eigh(matrices)
    seen = values > _RANK_TOLERANCE * np.maximum(values[..., -1:], np.finfo(float).tiny)
    inverse_values = np.where(seen, 1.0 / np.where(seen, values, 1.0), 0.0)
    return (vectors * inverse_values[..., None, :]) @ np.swapaxes(vectors, -1, -2)


@dataclass(frozen=True)
class Minimum:
    """Where forms are smallest: B transforms (B, 4, 4), their values (B,) and whether Newton converged (B,)."""

    T_parent_child: np.ndarray
    value: np.ndarray
    converged: np.ndarray
    iterations: int


def minimise(Q, rotation_start, max_steps=_MAX_NEWTON_STEPS):
    """Minimise ``x^T Q x`` over SE(3), from several rotations or for several forms at once.

    The translation is eliminated exactly; what is left is a quadratic in the nine entries of R, minimised by damped Newton
    steps ``R <- R Exp(phi)``.

    Parameters
    ----------
    Q : (13, 13) or (B, 13, 13) array
    rotation_start : (B, 3, 3) array
    max_steps : int

    Returns
    -------
    Minimum
    """
    rotation = np.array(rotation_start, dtype=float)
    Q = np.broadcast_to(Q, (len(rotation), DIMENSION, DIMENSION))
    gain = _pseudo_inverse(Q[:, _TRANSLATION, _TRANSLATION])
    Q_translation_rest = np.concatenate([Q[:, _TRANSLATION, _ROTATION], Q[:, _TRANSLATION, _ONE, None]], axis=2)
    reduced = np.empty((len(rotation), 10, 10))
    reduced[:, :9, :9] = Q[:, _ROTATION, _ROTATION]
    reduced[:, :9, 9] = reduced[:, 9, :9] = Q[:, _ROTATION, _ONE]
    reduced[:, 9, 9] = Q[:, _ONE, _ONE]
    reduced -= np.swapaxes(Q_translation_rest, 1, 2) @ gain @ Q_translation_rest
    S, linear, constant = reduced[:, :9, :9], reduced[:, :9, 9], reduced[:, 9, 9]

    value, gradient, hessian = _derivatives(S, linear, rotation)
    damping = np.zeros(len(rotation))
    converged = np.zeros(len(rotation), dtype=bool)
    iterations = 0
    while iterations < max_steps and not converged.all():
        iterations += 1
        curvature, axes = np.linalg.eigh(hessian)
        # Follow negative curvature downhill too, and never divide by a curvature that is only rounding.
        size = np.maximum(np.abs(curvature), 1e-14 * np.maximum(np.abs(curvature).max(axis=1, keepdims=True), 1e-300))
        step = -(axes @ ((np.swapaxes(axes, 1, 2) @ gradient[:, :, None]) / (size + damping[:, None])[:, :, None]))[:, :, 0]
        length = np.linalg.norm(step, axis=1)
        step *= np.minimum(1.0, 1.0 / np.maximum(length, 1e-300))[:, None]
        trial = rotation @ se3.rotation_exp(step)
        trial_value, trial_gradient, trial_hessian = _derivatives(S, linear, trial)
        small = length < _STEP_TOLERANCE
        better = (trial_value < value) & ~converged
        scale = np.abs(curvature).max(axis=1)
        # At the rounding level the value no longer falls; a tiny step that does not raise it noticeably is the end.
        stalled = ~better & (0.5 * scale * length**2 <= 1e-15 * (np.abs(value) + np.abs(constant)))
        converged |= small | stalled
        damping = np.where(better, 0.25 * damping * (damping > 1e-9 * scale), np.maximum(4 * damping, 1e-3 * scale))
        pick = better[:, None, None]
        rotation = np.where(pick, trial, rotation)
        hessian = np.where(pick, trial_hessian, hessian)
        gradient = np.where(better[:, None], trial_gradient, gradient)
        value = np.where(better, trial_value, value)
    rotation_vec = np.concatenate([rotation.reshape(-1, 9), np.ones((len(rotation), 1))], axis=1)
    translation = -(gain @ Q_translation_rest @ rotation_vec[:, :, None])[:, :, 0]
    return Minimum(se3.from_rotation_translation(rotation, translation), value + constant, converged, iterations)


def gauss_newton_step(Q, Ts_parent_child):
    """One Gauss-Newton step of every form from its own transform: cheap, for searches that are polished afterwards.

    Parameters
    ----------
    Q : (B, 13, 13) array
        Sums of pair forms with weights that are not negative.
    Ts_parent_child : (B, 4, 4) array

    Returns
    -------
    (B, 4, 4) array
    """
    rotation, translation = Ts_parent_child[:, :3, :3], Ts_parent_child[:, :3, 3]
    n_forms = len(rotation)
    x = np.ones((n_forms, DIMENSION, 1))
    x[:, _ROTATION, 0], x[:, _TRANSLATION, 0] = rotation.reshape(n_forms, 9), translation
    tangents = np.zeros((n_forms, 6, DIMENSION))
    tangents[:, :3, _TRANSLATION] = np.eye(3)
    tangents[:, 3:, _ROTATION] = (rotation[:, None] @ _GENERATORS).reshape(n_forms, 3, 9)
    pulled = tangents @ Q
    curvature = pulled @ np.swapaxes(tangents, 1, 2)
    # Enough damping to keep directions that the pairs do not see where they are, too little to slow down the others.
    diagonal = np.einsum("bii->bi", curvature)
    diagonal += 1e-12 * diagonal.sum(axis=1, keepdims=True) + 1e-300
    step = -np.linalg.solve(curvature, pulled @ x)[:, :, 0]
    return se3.from_rotation_translation(rotation @ se3.rotation_exp(step[:, 3:]), translation + step[:, :3])


def _derivatives(S, linear, rotation):
    """Value, gradient (B, 3) and Hessian (B, 3, 3) of ``r^T S r + 2 linear^T r`` under ``R Exp(phi)`` at phi = 0."""
    flat = rotation.reshape(-1, 9)
    S_flat = (S @ flat[:, :, None])[:, :, 0]
    value = ((S_flat + 2 * linear) * flat).sum(axis=1)
    product = np.swapaxes(rotation, 1, 2) @ (S_flat + linear).reshape(-1, 3, 3)
    gradient = 2 * np.stack(
        [
            product[:, 2, 1] - product[:, 1, 2],
            product[:, 0, 2] - product[:, 2, 0],
            product[:, 1, 0] - product[:, 0, 1],
        ],
        axis=1,
    )
    tangents = (rotation[:, None] @ _GENERATORS).reshape(-1, 3, 9)
    trace = np.trace(product, axis1=1, axis2=2)
    hessian = 2 * (
        tangents @ S @ np.swapaxes(tangents, 1, 2)
        + 0.5 * (product + np.swapaxes(product, 1, 2))
        - trace[:, None, None] * np.eye(3)
    )
    return value, gradient, hessian
