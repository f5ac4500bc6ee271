"""DNLO, the quadratic form that it minimises, and the proof of a global minimum."""

import numpy as np
import published_data
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motions import T_PARENT_CHILD, child_of, disturbed, wandering_poses
from numpy.testing import assert_allclose

import hand_eye_calib as hec
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import motion_pairs
from hand_eye_calib.core.solvers import all_pairs, dnlo, quadratic_form
from hand_eye_calib.core.solvers.certificate import is_global
from hand_eye_calib.core.solvers.registry import Method


def brute_force_objective(costs, threshold, floor):
    """Return the minimum of eq. (5) over the weights, by linear programming."""
    from scipy.optimize import linprog

    n_pairs = len(costs)
    fewest = -np.ones((1, n_pairs))
    answer = linprog(
        costs - threshold, A_ub=fewest, b_ub=[-floor], bounds=(0, 1)
    )
    return answer.fun + threshold * n_pairs


@pytest.mark.parametrize("fraction", [0.0, 0.31, 0.5, 0.77, 1.0])
def test_truncation_is_the_optimum_over_the_weights(fraction):
    costs = np.random.default_rng(3).exponential(0.02, size=(4, 15))
    weights, objectives = dnlo.truncate(costs, 0.01, fraction * 15)
    for row in range(4):
        assert weights[row].sum() >= fraction * 15 - 1e-9
        assert_allclose(
            objectives[row],
            brute_force_objective(costs[row], 0.01, fraction * 15),
            rtol=1e-9,
        )


@pytest.fixture
def jumpy_pairs():
    """Return motion pairs in which 30 % of the child's poses are outliers."""
    choice = np.random.default_rng(5)
    random = np.random.default_rng(6)
    parent = wandering_poses(80)
    child = disturbed(child_of(parent), 1, 0.002, 0.002)
    outliers = choice.choice(80, 24, replace=False)
    child[outliers, :3, 3] += random.normal(0, 3.0, (24, 3))
    return motion_pairs(parent, child, "B1")


def test_outliers_are_rejected_and_reported(jumpy_pairs):
    solution = dnlo.solve(jumpy_pairs, threshold=0.01, min_inlier_fraction=0.3)
    assert_allclose(solution.T_parent_child, T_PARENT_CHILD, atol=0.02)
    costs = all_pairs.pair_costs(jumpy_pairs, solution.T_parent_child)
    assert np.array_equal(solution.weights > 0.5, costs < 0.01)
    assert solution.converged
    # the same data without rejection is far off, so the test above is not idle
    assert (
        np.abs(
            all_pairs.solve_dnl(jumpy_pairs).T_parent_child - T_PARENT_CHILD
        ).max()
        > 0.1
    )


def test_many_pairs_are_sampled_for_the_search_only():
    parent = wandering_poses(1500)
    child = disturbed(child_of(parent), 1, 0.001, 0.001)
    child[700:, :3, 3] += 5.0
    pairs = motion_pairs(parent, child, "B2")

    solution = Method("dnlo").solve(pairs)

    assert_allclose(solution.T_parent_child, T_PARENT_CHILD, atol=2e-3)


def test_leaving_pairs_out_agrees_with_solving_without_them(jumpy_pairs):
    method = Method("dnlo", min_inlier_fraction=0.3)
    solution = method.solve(jumpy_pairs)
    groups = np.arange(len(jumpy_pairs)) // 20
    for_each_group = np.arange(4)[:, None]
    left_out = groups[None] == for_each_group

    answers = method.solve_without(jumpy_pairs, solution, left_out)

    for is_left_out, answer in zip(left_out, answers, strict=True):
        solved_anew = method.solve(jumpy_pairs[~is_left_out])
        assert answer == pytest.approx(solved_anew.T_parent_child, abs=1e-5)


@pytest.mark.parametrize("method", ["dnl", "dnlo"])
def test_ipopt_and_the_fast_backend_agree(method, jumpy_pairs):
    fast_method = Method(method, min_inlier_fraction=0.3)
    ipopt_method = Method(method, min_inlier_fraction=0.3, backend="ipopt")

    fast = fast_method.solve(jumpy_pairs)
    ipopt = ipopt_method.solve(jumpy_pairs)

    assert fast.objective <= ipopt.objective * (1 + 1e-9)
    difference = abs(fast.objective - ipopt.objective)
    if difference < 1e-6 * ipopt.objective:
        assert_allclose(fast.T_parent_child, ipopt.T_parent_child, atol=1e-5)


@pytest.fixture
def pairs():
    return noisy_pairs(1)


def test_condensed_costs_are_the_matrix_costs(pairs):
    for T in (
        np.eye(4),
        T_PARENT_CHILD,
        se3.exp(np.array([30.0, -4.0, 2.0, 2.0, 1.0, -1.0])),
    ):
        condensed_costs = quadratic_form.condense(
            pairs
        ) @ quadratic_form.monomials(T)
        assert_allclose(
            condensed_costs,
            all_pairs.pair_costs(pairs, T),
            rtol=1e-12,
            atol=1e-12,
        )


def quadratic_form_of(pairs):
    """Return the matrix Q of the cost of all pairs."""
    condensed = quadratic_form.condense(pairs)
    return quadratic_form.expand(condensed.sum(axis=0))


def test_the_minimum_is_where_no_small_step_goes_down(pairs):
    def total(xi):
        costs = all_pairs.pair_costs(pairs, T @ se3.exp(xi))
        return costs.sum()

    Q = quadratic_form_of(pairs)
    starts = all_pairs.start_rotations(pairs)

    Ts, values, converged = quadratic_form.minimise(Q, starts)

    T = Ts[np.argmin(values)]
    lowest = total(np.zeros(6))
    steps = 1e-4 * np.eye(6)
    for step in steps:
        assert total(step) > lowest
        assert total(-step) > lowest
    assert converged.all()
    assert_allclose(values.min(), lowest, rtol=1e-9)


def test_gauss_newton_steps_reach_the_minimum(pairs):
    Q = quadratic_form_of(pairs)
    starts = all_pairs.start_rotations(pairs)
    T, *_ = quadratic_form.minimise(Q, starts[:1])
    away = se3.exp(np.array([0.05, -0.02, 0.01, 0.05, 0.02, -0.03]))
    stepped = T @ away

    for _ in range(12):
        stepped = quadratic_form.gauss_newton_step(Q[None], stepped)

    assert_allclose(stepped, T, atol=1e-8)


HALF_TURNS = np.array(
    [np.diag(signs) for signs in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1])]
)


def noisy_pairs(seed, sigma=0.02, poses=60):
    rng = np.random.default_rng(seed)
    T_parent_child = se3.exp(rng.normal(size=6))
    Ts_pw_p = wandering_poses(poses, seed)
    Ts_cw_c = child_of(Ts_pw_p, T_parent_child) @ se3.exp(
        sigma * rng.normal(size=(poses, 6))
    )
    return motion_pairs(Ts_pw_p, Ts_cw_c, "B5")


def form_of(pairs, solution):
    return quadratic_form.weighted_sum(
        quadratic_form.coefficients(pairs), solution.weights
    )


def false_minimum(Q, T_parent_child):
    """Return the highest local minimum near rotations by pi, and its cost over the global one."""
    starts = T_parent_child[:3, :3] @ HALF_TURNS
    Ts, values, _ = quadratic_form.minimise(Q, starts)
    T = Ts[np.argmax(values)]
    cost_above = quadratic_form.decrease(Q, T, T_parent_child)
    return T, float(cost_above)


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10_000), sigma=st.sampled_from([0.0, 1e-3, 0.02, 0.2])
)
@pytest.mark.parametrize("method", ["dnl", "dnlo"])
def test_the_minimum_is_proved_and_a_false_one_is_not(method, seed, sigma):
    pairs = noisy_pairs(seed, sigma)
    solution = Method(method).solve(pairs)
    Q = form_of(pairs, solution)
    T_false, cost_above = false_minimum(Q, solution.T_parent_child)

    assert is_global(Q, solution.T_parent_child)
    least_cost = 1e-3 * np.trace(Q)
    if cost_above > least_cost:
        assert not is_global(Q, T_false)


@pytest.mark.parametrize("name", sorted(published_data.FALSE_MINIMA_OF_DNL))
def test_the_false_minima_of_the_published_results_are_caught(name):
    case_name, reference = name
    dataset, *level, run = case_name.split("/")
    (case,) = [
        case
        for case in published_data.simulated(
            [dataset], [float(level[0])] if level else None
        )
        if case.run == run
    ]
    pairs = motion_pairs(case.parent.poses, case.child.poses, reference)
    solution = Method("dnl").solve(pairs)
    assert Method("dnl").proved_global(pairs, solution) == "yes"
    T_false, above = false_minimum(
        form_of(pairs, solution), solution.T_parent_child
    )
    assert above > 9 * solution.objective
    assert not is_global(form_of(pairs, solution), T_false)


def test_results_say_what_was_proved(tmp_path):
    rng = np.random.default_rng(0)
    Ts_pw_p = wandering_poses(60)
    stamps_ns = np.arange(60) * 100_000_000
    parent = hec.Trajectory(stamps_ns, Ts_pw_p)
    child = hec.Trajectory(
        stamps_ns, child_of(Ts_pw_p, se3.exp(rng.normal(size=6)))
    )
    proved = {
        method: hec.calibrate(parent, child, method=method, reference="B5")
        for method in ("dnl", "dnlo", "park")
    }
    assert {
        method: result.proved_global for method, result in proved.items()
    } == {
        "dnl": "yes",
        "dnlo": "yes",
        "park": "not tried",
    }
    hec.save(proved["dnl"], tmp_path)
    assert hec.load(tmp_path / "extrinsic.yaml").proved_global == "yes"
