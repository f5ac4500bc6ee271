"""Proof that a minimum of a quadratic form over SE(3) is the global minimum.

After the translation is eliminated, the cost is ``x' M x`` in ``x = (vec R, 1)``. A rotation
satisfies 20 independent quadratic equations: its rows and its columns are orthonormal and
right-handed. One more equation is that the last variable is 1. Each equation is a symmetric matrix
A_i: ``x' A_i x`` is the same constant for all rotations. So, for any multipliers lambda_i,

    Z = M + sum_i lambda_i A_i,    x' Z x = x' M x + constant    for all rotations.

The condition ``Z x = 0`` at the minimum leaves 14 multipliers free. If Z is positive semidefinite
for some choice of the multipliers, no rotation has a smaller cost. This is Lagrangian duality
(Briales and Gonzalez-Jimenez, *Convex global 3D registration with Lagrangian duality*, CVPR 2017;
Giamou et al., *Certifiably globally optimal extrinsic calibration from per-sensor egomotion*, RA-L
2019).

The coordinates are rotated so that the minimum is the identity. The terms that depend only on the
equations are then constant. The rest is a Newton iteration in 14 multipliers with matrices of 9 x
9.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.solvers import quadratic_form

# A minimum is proved to be global if it exceeds the lower bound of the cost by at most this share
# ...
_MAX_RELATIVE_GAP = 1e-6
# ... plus this rounding, as a share of the mean eigenvalue of the form.
_ROUNDING = 1e-11

# In the barrier method, the weight of t is multiplied by this factor after a short Newton step. The
# first weight is the square of the factor.
_WEIGHT_GROWTH = 10.0
# The iteration ends if t is this near to its minimum, as a share of the mean eigenvalue of the
# form.
_CLOSE = 1e-12


def is_global(Q: FloatArray, T_parent_child: FloatArray) -> bool:
    """Return whether the cost at a transform is proved to be the global minimum over SE(3).

    Parameters
    ----------
    Q : (13, 13) array
        Quadratic form of the cost, see :mod:`~hand_eye_calib.core.solvers.quadratic_form`.
    T_parent_child : (4, 4) array
        Transform near a local minimum.
    """
    Ts, values, _ = quadratic_form.minimise(Q, T_parent_child[None, :3, :3])
    # With R = R_minimum S, M is the form of S, and S is the identity at the minimum.
    turn = np.eye(10)
    turn[:9, :9] = np.kron(Ts[0, :3, :3], np.eye(3))
    forms, _ = quadratic_form.without_translation(Q[None])
    M = turn.T @ forms[0] @ turn
    scale = max(float(np.trace(M)) / len(M), np.finfo(float).tiny)
    minimum = max(float(values[0]), 0.0)
    tolerance = _MAX_RELATIVE_GAP * minimum / scale + _ROUNDING
    eigenvalue = _maximise_smallest_eigenvalue(
        M / scale, enough=-0.25 * tolerance
    )
    # Every rotation has |x|^2 = 4. So the lower bound is at most 4 times a negative eigenvalue
    # below the minimum.
    gap = 4.0 * max(-eigenvalue, 0.0)
    decrease = float(quadratic_form.decrease(Q, T_parent_child, Ts[0]))
    gap += max(decrease, 0.0) / scale
    return gap <= tolerance


def _maximise_smallest_eigenvalue(M: FloatArray, enough: float) -> float:
    """Maximise the smallest eigenvalue of Z over the free multipliers, and return it.

    The search ends early if the eigenvalue is at least ``enough``. A barrier method minimises t
    such that ``Z + t I`` is positive definite along all directions perpendicular to the identity.
    Along the identity, Z is zero by construction.
    """
    tables = _tables()
    across = tables.across
    Z = M - np.tensordot(
        tables.stationary @ (M @ tables.identity), tables.equations, 1
    )
    Z_across = across.T @ Z @ across
    # The unknowns are the free multipliers and t. The first t makes Z + t I positive definite.
    derivatives = np.concatenate(
        [across.T @ tables.free @ across, np.eye(9)[None]]
    )
    t_start = max(-float(np.linalg.eigvalsh(Z_across)[0]), 0.0) + 0.1
    unknowns = np.append(np.zeros(len(tables.free)), t_start)
    weight = _WEIGHT_GROWTH**2
    best = float(np.linalg.eigvalsh(Z)[0])
    for _ in range(quadratic_form.MAX_NEWTON_STEPS):
        if best >= enough:
            break
        solved = np.linalg.solve(
            Z_across + np.tensordot(unknowns, derivatives, 1), derivatives
        )
        step, decrement = _newton_step(solved, weight)
        unknowns = unknowns + step
        matrix = Z + np.tensordot(unknowns[:-1], tables.free, 1)
        lowest = np.linalg.eigvalsh(matrix)[0]
        best = max(best, float(lowest))
        if decrement < 0.5:
            if len(Z_across) / weight < _CLOSE:
                break
            weight *= _WEIGHT_GROWTH
    return best


def _newton_step(solved: FloatArray, weight: float) -> tuple[FloatArray, float]:
    """Return a Newton step (15,) of ``weight t - log det(Z + t I)``, and its Newton decrement.

    After the step, the matrix is still positive definite.

    Parameters
    ----------
    solved : (15, 9, 9) array
        Inverse of ``Z + t I`` times the derivatives of ``Z + t I`` with respect to the 14
        multipliers and t.
    weight : float
        Weight of t.
    """
    gradient = -np.trace(solved, axis1=1, axis2=2)
    gradient[-1] += weight
    hessian = np.einsum("iab,jba->ij", solved, solved)
    hessian[np.diag_indices_from(hessian)] += 1e-14 * np.trace(hessian)
    step = -np.linalg.solve(hessian, gradient)
    decrement = float(np.sqrt(max(-gradient @ step, 0.0)))
    # After the fraction 1 / decay of the step (decay > 0), Z + t I becomes singular. Stop before,
    # but take at least the damped step, which always keeps the matrix positive definite.
    decay = -np.linalg.eigvals(np.tensordot(step, solved, 1)).real.min()
    inside = 0.9 / decay if decay > 0 else 1.0
    damped = 1.0 / (1.0 + decrement)
    return step * min(1.0, max(inside, damped)), decrement


class _Tables(NamedTuple):
    """Constants of the proof. They depend only on the equations of rotations.

    Attributes
    ----------
    identity : (10,) array
        (vec I, 1).
    across : (10, 9) array
        Directions perpendicular to ``identity``.
    equations : (21, 10, 10) array
        Independent symmetric matrices A_i. The last one states that the last variable is 1.
    stationary : (21, 10) array
        Factors that map ``M x`` to negative multipliers with ``Z x = 0`` at the identity.
    free : (14, 10, 10) array
        Combinations of the equations with free multipliers: they do not change ``Z x``.
    """

    identity: FloatArray
    across: FloatArray
    equations: FloatArray
    stationary: FloatArray
    free: FloatArray


@cache
def _tables() -> _Tables:
    """Compute the constants; the equations are those that 200 random rotations satisfy."""
    rotations = se3.rotation_exp(np.random.default_rng(0).normal(size=(200, 3)))
    x = np.append(rotations.reshape(-1, 9), np.ones((200, 1)), axis=1)
    upper = np.triu_indices(10)
    _, singular, rows = np.linalg.svd(x[:, upper[0]] * x[:, upper[1]])
    equations = np.zeros((21, 10, 10))
    equations[:20, *upper] = rows[singular < 1e-9]
    equations += equations.swapaxes(1, 2)
    equations[20, 9, 9] = 1.0
    identity = np.append(np.eye(3).ravel(), 1.0)
    across = np.linalg.svd(identity[None])[2][1:].T
    at_identity = (equations @ identity).T
    null_space = np.linalg.svd(at_identity)[2][
        np.linalg.matrix_rank(at_identity) :
    ]
    return _Tables(
        identity=identity,
        across=across,
        equations=equations,
        stationary=np.linalg.pinv(at_identity),
        free=np.tensordot(null_space, equations, 1),
    )
