"""DNL: direct non-linear optimisation over all pairs (Välimäki et al. 2023, eq. 4)."""

import numpy as np

from hand_eye_calib.solvers import quadratic_form
from hand_eye_calib.solvers.solution import Solution


def solve(pairs):
    """Minimise ``sum |A X - X B|_F^2`` over X.

    Parameters
    ----------
    pairs : MotionPairs
        K pairs, K >= 1.

    Returns
    -------
    Solution
    """
    numbers, weights = quadratic_form.numbers(pairs), np.ones(len(pairs))
    minimum = quadratic_form.minimise(
        quadratic_form.weighted_sum(numbers, weights), start_rotations(pairs)
    )
    best = int(np.argmin(minimum.value))
    T_parent_child = minimum.T_parent_child[best]
    return Solution(
        T_parent_child,
        float(quadratic_form.costs(numbers, T_parent_child).sum()),
        bool(minimum.converged[best]),
        minimum.iterations,
        weights,
    )


def solve_without(pairs, solution, left_out):
    """Answers (B, 4, 4) near a given one when the pairs of each row of ``left_out`` (B, K) are left
    out, for resampling.
    """
    numbers = quadratic_form.numbers(pairs)
    forms = np.stack(
        [quadratic_form.weighted_sum(numbers, kept) for kept in (~left_out).astype(float)]
    )
    starts = np.repeat(solution.T_parent_child[None, :3, :3], len(left_out), axis=0)
    return quadratic_form.minimise(forms, starts).T_parent_child


def pair_costs(pairs, T_parent_child):
    """Costs ``|A X - X B|_F^2`` (K,) straight from the matrices: exact to the last digit where the
    condensed forms cancel.
    """
    return quadratic_form.costs(quadratic_form.numbers(pairs), T_parent_child)


def start_rotations(pairs):
    """Rotations (4, 3, 3) to start from.

    The first turns the child's rotation axes onto the parent's as well as it can: close to the
    answer whenever the motion turns at all. The others do so after half a turn about one of the
    child's axes, for motion that hardly turns.
    """
    axes_parent = _axial(pairs.Ts_parenti_parentj)
    axes_child = _axial(pairs.Ts_childi_childj)
    left, _, right = np.linalg.svd(axes_parent.T @ axes_child)
    aligned = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return aligned @ _HALF_TURNS


_HALF_TURNS = np.array(
    [np.diag(signs) for signs in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])], dtype=float
)


def _axial(transforms):
    """Rotation axes times twice the sine of the angle (K, 3): as good as a rotation vector for
    aligning axes, and cheaper.
    """
    rotation = transforms[:, :3, :3]
    return np.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        axis=1,
    )
