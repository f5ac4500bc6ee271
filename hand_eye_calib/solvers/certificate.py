"""Proof that a minimum of a quadratic form over SE(3) is the global one.

With the translation eliminated, the cost is ``x^T M x`` in ``x = (vec R, 1)``. A rotation satisfies
20 independent quadratic equations (orthonormal rows and columns, right-handed both ways), and the
last variable is 1; each is a symmetric matrix A_i with ``x^T A_i x = 0`` for every rotation, but
for a constant. For any multipliers, ``Z = M + sum lambda_i A_i`` therefore has the same values on
all rotations. Those with ``Z x = 0`` at the minimum leave 14 multipliers free. If some choice makes
Z positive semidefinite, no rotation has a smaller cost: Lagrangian duality (Briales and
Gonzalez-Jimenez, *Convex global 3D registration with Lagrangian duality*, CVPR 2017; Giamou et al.,
*Certifiably globally optimal extrinsic calibration from per-sensor egomotion*, RA-L 2019).

The coordinates are turned so that the minimum is the identity. All that depends on the equations
alone is then constant, and what is left is a Newton iteration in 14 variables with matrices of 9 x
9.
"""

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.solvers import quadratic_form

# The bound may exceed the minimum by this share of it, and by this share of the form's mean
# eigenvalue, which is rounding.
_RELATIVE, _ROUNDING = 1e-6, 1e-11

_MAX_STEPS = 60

# The barrier's weight grows by this factor once a Newton step is short, until the bound is this
# close to the best that any multipliers give.
_SHARPENING, _CLOSE = 10.0, 1e-12


def is_global(Q: FloatArray, T_parent_child: FloatArray) -> bool:
    """Whether the cost at a transform is proved to be the smallest over all of SE(3).

    Parameters
    ----------
    Q : (13, 13) array
        The form, see `quadratic_form`.
    T_parent_child : (4, 4) array
        Near a local minimum.
    """
    minimum = quadratic_form.minimise(Q, T_parent_child[None, :3, :3])
    nearest = minimum.T_parent_child[0]
    M = _turned(quadratic_form.without_translation(Q[None])[0][0], nearest[:3, :3])
    scale = max(float(np.trace(M)) / len(M), np.finfo(float).tiny)
    tolerance = _RELATIVE * max(float(minimum.value[0]), 0.0) / scale + _ROUNDING
    lowest = _highest_lowest_eigenvalue(M / scale, enough=-0.25 * tolerance)
    # |x|^2 is 4 for every rotation.
    gap = 4.0 * max(-lowest, 0.0)
    gap += max(float(quadratic_form.decrease(Q, T_parent_child, nearest)), 0.0) / scale
    return gap <= tolerance


def _turned(M: FloatArray, rotation: FloatArray) -> FloatArray:
    """The form of S in R = rotation S, so that S is the identity at the minimum."""
    turn = np.eye(10)
    turn[:9, :9] = np.kron(rotation, np.eye(3))
    return turn.T @ M @ turn


def _highest_lowest_eigenvalue(M: FloatArray, enough: float) -> float:
    """The smallest eigenvalue of Z, made as large as multipliers can, or just ``enough``.

    A barrier method: minimise t with ``Z + t`` positive definite where it is not zero by
    construction.
    """
    Z = M - np.tensordot(_STATIONARY @ (M @ _IDENTITY), _EQUATIONS, 1)
    free = _BESIDE.T @ Z @ _BESIDE
    shift = max(-float(np.linalg.eigvalsh(free)[0]), 0.0) + 0.1
    unknowns, weight = np.append(np.zeros(len(_FREE)), shift), 1.0
    best = float(np.linalg.eigvalsh(Z)[0])
    for _ in range(_MAX_STEPS):
        if best >= enough:
            break
        step, decrement = _newton_step(free, unknowns, weight)
        unknowns = unknowns + step
        lowest = np.linalg.eigvalsh(Z + np.tensordot(unknowns[:-1], _FREE_WHOLE, 1))[0]
        best = max(best, float(lowest))
        if decrement < 0.5:
            if len(free) / weight < _CLOSE:
                break
            weight *= _SHARPENING
    return best


def _newton_step(free: FloatArray, unknowns: FloatArray, weight: float) -> tuple[FloatArray, float]:
    """A Newton step of ``weight t - log det`` that stays inside, and the Newton decrement."""
    solved = np.linalg.solve(free + np.tensordot(unknowns, _FREE_AND_SHIFT, 1), _FREE_AND_SHIFT)
    gradient = -np.trace(solved, axis1=1, axis2=2)
    gradient[-1] += weight
    hessian = np.einsum("iab,jba->ij", solved, solved)
    hessian[np.diag_indices_from(hessian)] += 1e-14 * np.trace(hessian)
    step = -np.linalg.solve(hessian, gradient)
    decrement = float(np.sqrt(max(-gradient @ step, 0.0)))
    # How far it is to the edge along the step.
    falling = -np.linalg.eigvals(np.tensordot(step, solved, 1)).real.min()
    inside = 0.9 / falling if falling > 0 else 1.0
    return step * min(1.0, max(inside, 1.0 / (1.0 + decrement))), decrement


def _equations() -> FloatArray:
    """Symmetric matrices (21, 10, 10) of the equations, independent of each other; the last
    variable's is among them.
    """
    found = [np.diag([0.0] * 9 + [1.0])]
    transposed = np.append(np.arange(9).reshape(3, 3).T.ravel(), 9)
    for a in range(3):
        for b in range(3):
            orthonormal, right_handed = np.zeros((2, 10, 10))
            for k in range(3):
                orthonormal[3 * a + k, 3 * b + k] += 1.0
            orthonormal[9, 9] = -float(a == b)
            # Rows: r_(a+1) x r_(a+2) = r_a, component b.
            next_row, last_row = 3 * ((a + 1) % 3), 3 * ((a + 2) % 3)
            right_handed[next_row + (b + 1) % 3, last_row + (b + 2) % 3] = 1.0
            right_handed[next_row + (b + 2) % 3, last_row + (b + 1) % 3] = -1.0
            right_handed[3 * a + b, 9] = -1.0
            for A in (orthonormal, right_handed):
                found += [A + A.T, (A + A.T)[np.ix_(transposed, transposed)]]
    _, singular, rows = np.linalg.svd(np.reshape(found, (len(found), 100)))
    return rows[: int((singular > 1e-9).sum())].reshape(-1, 10, 10)


# (vec I, 1), and the directions (10, 9) beside it.
_IDENTITY = np.append(np.eye(3).ravel(), 1.0)
_BESIDE = np.linalg.svd(_IDENTITY[None])[2][1:].T
_EQUATIONS = _equations()
_AT_IDENTITY = (_EQUATIONS @ _IDENTITY).T
# Multipliers (21, 10) that make ``Z x = 0`` for a given ``M x``, and those (14, 21) that keep it.
_STATIONARY = np.linalg.pinv(_AT_IDENTITY)
_KEPT = np.linalg.svd(_AT_IDENTITY)[2][np.linalg.matrix_rank(_AT_IDENTITY) :]
_FREE_WHOLE = np.tensordot(_KEPT, _EQUATIONS, 1)
_FREE = _BESIDE.T @ _FREE_WHOLE @ _BESIDE
_FREE_AND_SHIFT = np.concatenate([_FREE, np.eye(9)[None]])
