"""DNL and DNLO as in the paper: CasADi expressions minimised by Ipopt.

The problems are eqs (4) and (5) of Välimäki et al. 2023, section 3.2. The unknowns are the rotation
vector, the translation and, for DNLO, one weight per pair. These solvers are slow; tests compare
the fast solvers of this package with them.
"""

from typing import Any, TypeAlias

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import required
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs
from hand_eye_calib.core.solvers import dnlo
from hand_eye_calib.core.solvers.all_pairs import Solution, pair_costs

casadi = required("casadi", "backend ipopt", "casadi")

# CasADi has no type annotations.
_Expression: TypeAlias = Any

_IPOPT_OPTIONS = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
}


def solve_dnl(pairs: MotionPairs) -> Solution:
    """Minimise eq. (4) from the identity; see :mod:`hand_eye_calib.core.solvers.all_pairs`."""
    pose = casadi.MX.sym("pose", 6)
    problem = {"x": pose, "f": casadi.sum2(_cost_expressions(pairs, pose))}
    T_parent_child, settled = _minimum(problem, 0)
    objective = float(pair_costs(pairs, T_parent_child).sum())
    return Solution(T_parent_child, objective, settled, np.ones(len(pairs)))


def solve_dnlo(
    pairs: MotionPairs, threshold: float, min_inlier_fraction: float
) -> Solution:
    """Minimise eq. (5) from the identity with all weights 1.

    The parameters are those of :func:`hand_eye_calib.core.solvers.dnlo.solve`.
    """
    n_pairs = len(pairs)
    pose = casadi.MX.sym("pose", 6)
    alpha = casadi.MX.sym("alpha", n_pairs)
    costs = _cost_expressions(pairs, pose).T
    floor = min_inlier_fraction * n_pairs
    problem = {
        "x": casadi.vertcat(pose, alpha),
        "f": casadi.dot(alpha, costs) + threshold * casadi.sum1(1 - alpha),
        "g": casadi.sum1(alpha),
    }
    T_parent_child, settled = _minimum(
        problem,
        n_pairs,
        lbx=np.r_[np.full(6, -np.inf), np.zeros(n_pairs)],
        ubx=np.r_[np.full(6, np.inf), np.ones(n_pairs)],
        lbg=floor,
        ubg=np.inf,
    )
    weights, objective = dnlo.truncate(
        pair_costs(pairs, T_parent_child), threshold, floor
    )
    return Solution(T_parent_child, float(objective), settled, weights)


def _minimum(
    problem: dict[str, _Expression], n_weights: int, **bounds: Any
) -> tuple[FloatArray, bool]:
    """Solve a problem of CasADi; return X (4, 4), and whether Ipopt converged.

    The start is the identity with weights 1. ``bounds`` are those of the unknowns and constraints.
    """
    solver = casadi.nlpsol("solver", "ipopt", problem, _IPOPT_OPTIONS)
    # The start is not exactly the identity, because the rotation angle has no derivative at zero.
    start = np.r_[np.full(3, 1e-6), np.zeros(3), np.ones(n_weights)]
    solution = solver(x0=start, **bounds)
    unknowns = np.array(solution["x"]).ravel()
    rotation = se3.rotation_exp(unknowns[:3])
    T_parent_child = se3.from_rotation_translation(rotation, unknowns[3:6])
    has_converged = bool(solver.stats()["success"])
    return T_parent_child, has_converged


def _cost_expressions(pairs: MotionPairs, pose: _Expression) -> _Expression:
    """Return the expression (1, K) of the costs ``|A X - X B|_F^2`` of all pairs.

    One function is mapped over the pairs, so that the expression graph is small.
    """
    motion_a = casadi.SX.sym("A", 3, 4)
    motion_b = casadi.SX.sym("B", 3, 4)
    x = casadi.SX.sym("x", 6)
    rotation = _rodrigues(x[:3])
    translation = x[3:]
    rotation_residual = motion_a[:, :3] @ rotation - rotation @ motion_b[:, :3]
    translation_residual = (
        motion_a[:, :3] @ translation
        + motion_a[:, 3]
        - rotation @ motion_b[:, 3]
        - translation
    )
    cost = casadi.sumsqr(rotation_residual) + casadi.sumsqr(
        translation_residual
    )
    columns_a = casadi.vec(motion_a)
    columns_b = casadi.vec(motion_b)
    function = casadi.Function("cost", [x, columns_a, columns_b], [cost])
    return function.map(len(pairs))(
        pose,
        _columns(pairs.Ts_parenti_parentj),
        _columns(pairs.Ts_childi_childj),
    )


def _columns(transforms: FloatArray) -> FloatArray:
    """Return the top three rows of transforms as columns (12, K), column-major as in CasADi."""
    column_major = np.swapaxes(transforms[:, :3], 1, 2)
    columns = column_major.reshape(len(transforms), 12).T
    return np.ascontiguousarray(columns)


def _rodrigues(rotation_vector: _Expression) -> _Expression:
    """Return the expression (3, 3) of the rotation matrix of a rotation vector."""
    angle = casadi.norm_2(rotation_vector)
    cross = casadi.skew(rotation_vector / angle)
    first_order = casadi.sin(angle) * cross
    second_order = (1 - casadi.cos(angle)) * cross @ cross
    return casadi.SX.eye(3) + first_order + second_order
