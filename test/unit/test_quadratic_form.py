import numpy as np
import pytest
from motions import T_PARENT_CHILD, child_of, disturbed, wandering_poses

from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.solvers import all_pairs, quadratic_form


@pytest.fixture
def pairs():
    parent = wandering_poses(60)
    return motion_pairs(
        disturbed(parent, 1, 0.02, 0.02), disturbed(child_of(parent), 2, 0.02, 0.02), "B5"
    )


def test_condensed_costs_are_the_matrix_costs(pairs):
    for T in (np.eye(4), T_PARENT_CHILD, se3.exp(np.array([30.0, -4.0, 2.0, 2.0, 1.0, -1.0]))):
        condensed_costs = quadratic_form.condense(pairs) @ quadratic_form.monomials(T)
        np.testing.assert_allclose(
            condensed_costs, all_pairs.pair_costs(pairs, T), rtol=1e-12, atol=1e-12
        )


def test_the_minimum_is_where_no_small_step_goes_down(pairs):
    Q = quadratic_form.expand(quadratic_form.condense(pairs).sum(axis=0))
    Ts, values, converged = quadratic_form.minimise(Q, all_pairs.start_rotations(pairs))
    T = Ts[np.argmin(values)]

    def total(xi):
        return all_pairs.pair_costs(pairs, T @ se3.exp(xi)).sum()

    step = 1e-4
    for direction in np.vstack([np.eye(6), -np.eye(6)]):
        assert total(step * direction) > total(np.zeros(6))
    assert converged.all()
    np.testing.assert_allclose(values.min(), total(np.zeros(6)), rtol=1e-9)


def test_gauss_newton_steps_reach_the_minimum(pairs):
    Q = quadratic_form.expand(quadratic_form.condense(pairs).sum(axis=0))
    T = quadratic_form.minimise(Q, all_pairs.start_rotations(pairs)[:1])[0]
    stepped = T @ se3.exp(np.array([0.05, -0.02, 0.01, 0.05, 0.02, -0.03]))
    for _ in range(12):
        stepped = quadratic_form.gauss_newton_step(Q[None], stepped)
    np.testing.assert_allclose(stepped, T, atol=1e-8)
