"""What every solver must do whatever the data: find the truth, respect frames and order, and
survive motion that shows nothing.
"""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from motions import walked
from numpy.testing import assert_allclose, assert_array_equal

from hand_eye_calib.core.base.config import METHODS
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, motion_pairs
from hand_eye_calib.core.solvers.all_pairs import pair_costs
from hand_eye_calib.core.solvers.registry import Method

PAPER_METHODS = [
    name for name, record in METHODS.items() if record.uses_reference
]
# Their answer depends on nothing but sums over the pairs. dnlo searches from random subsets.
SUMMING_METHODS = [
    name for name in PAPER_METHODS if not METHODS[name].rejects_outliers
]

few_examples = settings(max_examples=20)
N_POSES = 14

coordinate = st.floats(-3.0, 3.0, allow_subnormal=False)
rotation_coordinate = st.floats(-1.4, 1.4, allow_subnormal=False)


def vectors(coordinates):
    return st.tuples(coordinates, coordinates, coordinates).map(np.array)


# Zhuang's start, the identity, leads to the truth where the sensors are turned by no more than this
# (rad); beyond, it may miss it.
ZHUANG_IS_SURE_TO = 1.6

transforms = st.builds(
    lambda t, w: se3.from_rotation_translation(se3.rotation_exp(w), t),
    vectors(coordinate),
    vectors(rotation_coordinate),
)
rotations = st.builds(
    lambda w: se3.from_rotation_translation(se3.rotation_exp(w), np.zeros(3)),
    vectors(rotation_coordinate),
)
seeds = st.integers(0, 2**32 - 1)


def drive(seed):
    """Poses (N_POSES, 4, 4) of a body that moves up to 2 m and turns up to 0.8 rad per axis from
    pose to pose.
    """
    largest = np.repeat([2.0, 0.8], 3)
    return walked(
        se3.exp(
            np.random.default_rng(seed).uniform(
                -largest, largest, (N_POSES - 1, 6)
            )
        )
    )


def trajectories(seed, T_parent_child, noise=0.0):
    """Poses of both sensors in their own worlds; noise in m and rad on each pose of each."""
    Ts_pw_p = drive(seed)
    parent_noise, child_noise = se3.exp(
        noise * np.random.default_rng([seed, 1]).normal(size=(2, N_POSES, 6))
    )
    return Ts_pw_p @ parent_noise, Ts_pw_p @ T_parent_child @ child_noise


def rotation_angle(T):
    return se3.rotation_angle(T[:3, :3])


def answer(method, *trajectories):
    return (
        Method(method).solve(motion_pairs(*trajectories, "B1")).T_parent_child
    )


@pytest.mark.parametrize("method", PAPER_METHODS)
@few_examples
@given(seed=seeds, truth=transforms)
def test_noise_free_truth_is_found(method, seed, truth):
    solution = Method(method).solve(
        motion_pairs(*trajectories(seed, truth), "B1")
    )
    if method == "zhuang" and not solution.converged:
        assert rotation_angle(truth) > ZHUANG_IS_SURE_TO
        return
    assert solution.converged
    assert_allclose(solution.T_parent_child, truth, atol=1e-6)
    assert solution.objective == pytest.approx(0.0, abs=1e-12)
    assert_allclose(solution.weights, np.ones(N_POSES - 1), atol=1e-12)


@pytest.mark.parametrize("method", PAPER_METHODS)
@few_examples
@given(
    seed=seeds,
    truth=transforms,
    parent_world=transforms,
    child_world=transforms,
)
def test_worlds_do_not_matter(method, seed, truth, parent_world, child_world):
    Ts_pw_p, Ts_cw_c = trajectories(seed, truth, noise=0.01)
    moved = answer(method, parent_world @ Ts_pw_p, child_world @ Ts_cw_c)
    assert_allclose(moved, answer(method, Ts_pw_p, Ts_cw_c), atol=1e-6)


@few_examples
@given(
    seed=seeds,
    axis=vectors(rotation_coordinate),
    angle=st.floats(2.4, 3.1),
    shift=vectors(coordinate),
)
def test_zhuang_knows_a_false_minimum(seed, axis, angle, shift):
    """Sensors that face almost opposite ways: from the identity it often fails, but says so."""
    assume(np.linalg.norm(axis) > 0.1)
    truth = se3.from_rotation_translation(
        se3.rotation_exp(angle * axis / np.linalg.norm(axis)), shift
    )
    solution = Method("zhuang").solve(
        motion_pairs(*trajectories(seed, truth), "B1")
    )
    assert solution.converged == np.allclose(
        solution.T_parent_child, truth, atol=1e-6
    )


@pytest.mark.parametrize(
    "method", [name for name in SUMMING_METHODS if name != "zhuang"]
)
@few_examples
@given(
    seed=seeds, truth=transforms, T_parent_new=transforms, T_child_new=rotations
)
def test_answer_follows_the_sensor_frames_with_noise(
    method, seed, truth, T_parent_new, T_child_new
):
    """With M = AX - XB of the old frames, the new frames have ``inv(T_parent_new) M T_child_new``.

    Its translation is turned and its rotation part keeps its size, so every cost stays what it was
    - as long as the child's frame only turns: a shifted child's frame adds a part of the rotation
    residual to the translation residual, and the best compromise moves.
    """
    Ts_pw_p, Ts_cw_c = trajectories(seed, truth, noise=0.01)
    expected = (
        se3.inverse(T_parent_new)
        @ answer(method, Ts_pw_p, Ts_cw_c)
        @ T_child_new
    )
    assert_allclose(
        answer(method, Ts_pw_p @ T_parent_new, Ts_cw_c @ T_child_new),
        expected,
        atol=1e-6,
    )


@few_examples
@given(
    seed=seeds, truth=transforms, T_parent_new=transforms, T_child_new=rotations
)
def test_dnlo_follows_the_sensor_frames_with_outliers(
    seed, truth, T_parent_new, T_child_new
):
    """Its costs are dnl's; with two pairs that are plainly wrong its answer is that of the others,
    in any frames.
    """
    Ts_pw_p, Ts_cw_c = trajectories(seed, truth, noise=1e-4)
    Ts_cw_c[5:, :3, 3] += [30.0, 0.0, 0.0]
    Ts_cw_c[9:, :3, 3] += [0.0, 30.0, 0.0]
    pairs = motion_pairs(Ts_pw_p, Ts_cw_c, "B1")
    solution = Method("dnlo").solve(pairs)
    assert_array_equal(np.flatnonzero(solution.weights == 0.0), [4, 8])
    assert_allclose(
        solution.T_parent_child,
        Method("dnl").solve(pairs[solution.weights > 0]).T_parent_child,
        atol=1e-6,
    )
    expected = se3.inverse(T_parent_new) @ solution.T_parent_child @ T_child_new
    assert_allclose(
        answer("dnlo", Ts_pw_p @ T_parent_new, Ts_cw_c @ T_child_new),
        expected,
        atol=1e-6,
    )


@pytest.mark.parametrize("method", PAPER_METHODS)
@few_examples
@given(seed=seeds, truth=transforms, order=st.permutations(range(N_POSES - 1)))
def test_order_of_the_pairs_does_not_matter(method, seed, truth, order):
    pairs = motion_pairs(
        *trajectories(
            seed, truth, noise=0.01 if method in SUMMING_METHODS else 0.0
        ),
        "B1",
    )
    ours = Method(method).solve(pairs)
    reordered = Method(method).solve(pairs[np.array(order)])
    assert_allclose(reordered.T_parent_child, ours.T_parent_child, atol=1e-6)
    assert reordered.objective == pytest.approx(
        ours.objective, rel=1e-6, abs=1e-12
    )


@few_examples
@given(seed=seeds, truth=transforms)
def test_each_cost_is_lowest_at_its_own_method(seed, truth):
    pairs = motion_pairs(*trajectories(seed, truth, noise=0.03), "B1")
    solutions = {
        method: Method(method).solve(pairs) for method in PAPER_METHODS
    }
    for solution in solutions.values():
        assert solutions["dnl"].objective <= pair_costs(
            pairs, solution.T_parent_child
        ).sum() * (1 + 1e-9)
        assert solutions["dnlo"].objective <= np.minimum(
            pair_costs(pairs, solution.T_parent_child), 0.01
        ).sum() * (1 + 1e-9) or (
            solutions["dnlo"].weights.sum() < (len(pairs) + 1) / 2
        )
    assert solutions["ali"].objective <= solutions["park"].objective * (
        1 + 1e-9
    )


def degenerate_motions(seed):
    """Tangent vectors (K, 6) of motions that leave part of X, or all of it, unseen, by kind."""
    random = np.random.default_rng(seed)
    shifts, turns = random.uniform(-1, 1, (2, 12, 3))
    amounts = random.uniform(-1, 1, (12, 1))
    axis = turns[0] / np.linalg.norm(turns[0])
    none = np.zeros((12, 3))
    kinds = {
        "no motion": [none, none],
        "translation": [shifts, none],
        "straight line": [amounts * axis, none],
        "rotation about one axis": [shifts, amounts * axis],
        "plane": [shifts * [1, 1, 0], amounts * [0, 0, 1]],
        "rotation on the spot": [none, turns],
        "half turns": [
            shifts,
            np.pi * turns / np.linalg.norm(turns, axis=1, keepdims=True),
        ],
        "one pair": [shifts[:1], turns[:1]],
        "two pairs": [shifts[:2], turns[:2]],
        "hardly any": [1e-9 * shifts, 1e-9 * turns],
    }
    return {
        kind: np.concatenate(motions, axis=1) for kind, motions in kinds.items()
    }


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("method", PAPER_METHODS)
@pytest.mark.parametrize("kind", degenerate_motions(0))
@settings(max_examples=4)
@given(
    seed=seeds,
    truth=st.one_of(
        transforms, st.just(np.eye(4)), st.just(np.diag([1.0, -1.0, -1.0, 1.0]))
    ),
)
def test_degenerate_motion_gives_a_rigid_transform(method, kind, seed, truth):
    Ts_parent = se3.exp(degenerate_motions(seed)[kind])
    index = np.arange(len(Ts_parent))
    pairs = MotionPairs(
        Ts_parent, se3.inverse(truth) @ Ts_parent @ truth, index, index + 1
    )
    solution = Method(method).solve(pairs)
    T = solution.T_parent_child
    assert np.isfinite(T).all()
    assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(T[:3, :3]) > 0
    assert_array_equal(T[3], [0, 0, 0, 1])
    assert np.isfinite(solution.objective)
    assert solution.weights.shape == (len(pairs),)
    assert np.isfinite(solution.weights).all()


@pytest.mark.parametrize("method", PAPER_METHODS)
def test_no_pairs_is_a_clear_error(method):
    none = motion_pairs(np.eye(4)[None], np.eye(4)[None], "B1")
    with pytest.raises(NotEnoughDataError, match="no motion pairs"):
        Method(method).solve(none)


@pytest.mark.parametrize("method", ["park", "taylor", "ali", "dnl", "zhuang"])
@few_examples
@given(seed=seeds, yaw=st.floats(-1.5, 1.5), shift=vectors(coordinate))
def test_planar_motion_still_shows_what_it_can(method, seed, yaw, shift):
    """A vehicle on flat ground: the height is left near zero instead of blowing up, and methods
    that use all residuals find the rest.
    """
    truth = se3.from_rotation_translation(
        se3.rotation_exp(np.array([0.0, 0.0, yaw])), shift
    )
    Ts_parent = se3.exp(degenerate_motions(seed)["plane"])
    index = np.arange(len(Ts_parent))
    pairs = MotionPairs(
        Ts_parent, se3.inverse(truth) @ Ts_parent @ truth, index, index + 1
    )
    solution = Method(method).solve(pairs)
    assert abs(solution.T_parent_child[2, 3]) < 1e-3
    if method in ("dnl", "zhuang"):
        assert_allclose(solution.T_parent_child[:2], truth[:2], atol=1e-5)
