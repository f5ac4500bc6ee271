import numpy as np
import pytest
from motions import T_PARENT_CHILD, child_of, disturbed, wandering_poses

from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.solvers import all_pairs, dnlo
from hand_eye_calib.solvers.registry import Method


def brute_force_objective(costs, threshold, floor):
    """Eq. (5) minimised over the weights by a linear programme."""
    from scipy.optimize import linprog

    answer = linprog(
        costs - threshold, A_ub=-np.ones((1, len(costs))), b_ub=[-floor], bounds=(0, 1)
    )
    return answer.fun + threshold * len(costs)


@pytest.mark.parametrize("fraction", [0.0, 0.31, 0.5, 0.77, 1.0])
def test_truncation_is_the_optimum_over_the_weights(fraction):
    costs = np.random.default_rng(3).exponential(0.02, size=(4, 15))
    weights, objectives = dnlo.truncate(costs, 0.01, fraction * 15)
    for row in range(4):
        assert weights[row].sum() >= fraction * 15 - 1e-9
        np.testing.assert_allclose(
            objectives[row], brute_force_objective(costs[row], 0.01, fraction * 15), rtol=1e-9
        )


@pytest.fixture
def jumpy_pairs():
    """30 % of the child's poses thrown far off."""
    parent = wandering_poses(80)
    child = disturbed(child_of(parent), 1, 0.002, 0.002)
    thrown = np.random.default_rng(5).choice(80, 24, replace=False)
    child[thrown, :3, 3] += np.random.default_rng(6).normal(0, 3.0, (24, 3))
    return motion_pairs(parent, child, "B1")


def test_outliers_are_rejected_and_reported(jumpy_pairs):
    solution = dnlo.solve(jumpy_pairs, threshold=0.01, min_inlier_fraction=0.3)
    np.testing.assert_allclose(solution.T_parent_child, T_PARENT_CHILD, atol=0.02)
    costs = all_pairs.pair_costs(jumpy_pairs, solution.T_parent_child)
    assert np.array_equal(solution.weights > 0.5, costs < 0.01)
    assert solution.converged
    # the same data without rejection is far off, so the test above is not idle
    assert np.abs(all_pairs.solve_dnl(jumpy_pairs).T_parent_child - T_PARENT_CHILD).max() > 0.1


def test_many_pairs_are_sampled_for_the_search_only():
    parent = wandering_poses(1500)
    child = disturbed(child_of(parent), 1, 0.001, 0.001)
    child[700:, :3, 3] += 5.0
    solution = Method("dnlo").solve(motion_pairs(parent, child, "B2"))
    np.testing.assert_allclose(solution.T_parent_child, T_PARENT_CHILD, atol=2e-3)


def test_leaving_pairs_out_agrees_with_solving_without_them(jumpy_pairs):
    method = Method("dnlo", min_inlier_fraction=0.3)
    solution = method.solve(jumpy_pairs)
    left_out = np.arange(len(jumpy_pairs))[None] // 20 == np.arange(4)[:, None]
    answers = method.solve_without(jumpy_pairs, solution, left_out)
    for row, answer in zip(left_out, answers, strict=True):
        np.testing.assert_allclose(
            answer, method.solve(jumpy_pairs[~row]).T_parent_child, atol=1e-5
        )


@pytest.mark.parametrize("method", ["dnl", "dnlo"])
def test_ipopt_and_the_fast_backend_agree(method, jumpy_pairs):
    fast = Method(method, min_inlier_fraction=0.3).solve(jumpy_pairs)
    ipopt = Method(method, min_inlier_fraction=0.3, backend="ipopt").solve(jumpy_pairs)
    assert fast.objective <= ipopt.objective * (1 + 1e-9)
    if abs(fast.objective - ipopt.objective) < 1e-6 * ipopt.objective:
        np.testing.assert_allclose(fast.T_parent_child, ipopt.T_parent_child, atol=1e-5)
