"""A global minimum is proved, and a false one is not."""

import numpy as np
import published_data
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motions import child_of, wandering_poses

import hand_eye_calib as hec
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.solvers import quadratic_form
from hand_eye_calib.solvers.certificate import is_global
from hand_eye_calib.solvers.registry import Method

HALF_TURNS = np.array([np.diag(signs) for signs in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1])])


def noisy_pairs(seed, sigma=0.02, poses=60):
    rng = np.random.default_rng(seed)
    T_parent_child = se3.exp(rng.normal(size=6))
    Ts_pw_p = wandering_poses(poses, seed)
    Ts_cw_c = child_of(Ts_pw_p, T_parent_child) @ se3.exp(sigma * rng.normal(size=(poses, 6)))
    return motion_pairs(Ts_pw_p, Ts_cw_c, "B5")


def form_of(pairs, solution):
    return quadratic_form.weighted_sum(quadratic_form.coefficients(pairs), solution.weights)


def false_minimum(Q, T_parent_child):
    """The highest local minimum from rotations by pi beside the global one, and how much higher."""
    Ts, values, _ = quadratic_form.minimise(Q, T_parent_child[:3, :3] @ HALF_TURNS)
    T = Ts[np.argmax(values)]
    return T, float(quadratic_form.decrease(Q, T, T_parent_child))


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), sigma=st.sampled_from([0.0, 1e-3, 0.02, 0.2]))
@pytest.mark.parametrize("method", ["dnl", "dnlo"])
def test_the_minimum_is_proved_and_a_false_one_is_not(method, seed, sigma):
    pairs = noisy_pairs(seed, sigma)
    solution = Method(method).solve(pairs)
    Q = form_of(pairs, solution)
    assert is_global(Q, solution.T_parent_child)
    T_false, above = false_minimum(Q, solution.T_parent_child)
    if above > 1e-3 * np.trace(Q):
        assert not is_global(Q, T_false)


@pytest.mark.parametrize("name", sorted(published_data.FALSE_MINIMA_OF_DNL))
def test_the_false_minima_of_the_published_results_are_caught(name):
    case_name, reference = name
    dataset, *level, run = case_name.split("/")
    (case,) = [
        case
        for case in published_data.simulated([dataset], [float(level[0])] if level else None)
        if case.run == run
    ]
    pairs = motion_pairs(case.parent.poses, case.child.poses, reference)
    solution = Method("dnl").solve(pairs)
    assert Method("dnl").proved_global(pairs, solution) == "yes"
    T_false, above = false_minimum(form_of(pairs, solution), solution.T_parent_child)
    assert above > 9 * solution.objective
    assert not is_global(form_of(pairs, solution), T_false)


def test_results_say_what_was_proved(tmp_path):
    rng = np.random.default_rng(0)
    Ts_pw_p = wandering_poses(60)
    stamps_ns = np.arange(60) * 100_000_000
    parent = hec.Trajectory(stamps_ns, Ts_pw_p)
    child = hec.Trajectory(stamps_ns, child_of(Ts_pw_p, se3.exp(rng.normal(size=6))))
    proved = {
        method: hec.calibrate(parent, child, method=method, reference="B5")
        for method in ("dnl", "dnlo", "park")
    }
    assert {method: result.proved_global for method, result in proved.items()} == {
        "dnl": "yes",
        "dnlo": "yes",
        "park": "not tried",
    }
    hec.save(proved["dnl"], tmp_path)
    assert hec.load(tmp_path / "extrinsic.yaml").proved_global == "yes"
