"""Robust least squares, as a method and as a second opinion."""

from dataclasses import replace

import numpy as np
import pytest
from motions import (
    T_PARENT_CHILD,
    child_of,
    disturbed,
    noisy_pair,
    planar_poses,
    wandering_poses,
)
from numpy.testing import assert_allclose
from sigmas import assert_nees, nees

import hand_eye_calib as hec
from hand_eye_calib.core.assessment.second_opinion import (
    excess_covariance,
    second_opinions,
)
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import sigmas_in_parent
from hand_eye_calib.core.pairing.motion_pairs import motion_pairs
from hand_eye_calib.core.solvers.robust import solve, solve_best_stride

N_POSES = 400
SIGMA_M = 0.004
SIGMA_RAD = 0.002


def noisy_poses(seed):
    """Return poses (N_POSES, 4, 4) of both sensors with white noise."""
    parent = wandering_poses(N_POSES, seed)
    child = child_of(parent)
    noisy_parent = disturbed(parent, [seed, 1], SIGMA_M, SIGMA_RAD)
    noisy_child = disturbed(child, [seed, 2], SIGMA_M, SIGMA_RAD)
    return noisy_parent, noisy_child


def error_of(solution):
    difference = se3.inverse(T_PARENT_CHILD) @ solution.T_parent_child
    return se3.log(difference)


class TestSolver:
    @pytest.mark.parametrize("share", [0.0, 0.1, 0.3])
    def test_outliers_hardly_move_the_answer(self, share):
        rng = np.random.default_rng(8)
        parent, child = noisy_poses(8)
        pairs = motion_pairs(parent, child, "B5")
        motions = pairs.Ts_childi_childj.copy()
        is_outlier = rng.random(len(motions)) < share
        twists = rng.normal(size=(is_outlier.sum(), 6))
        motions[is_outlier] = se3.exp(twists)
        fields = {**vars(pairs), "Ts_childi_childj": motions}
        spoilt_pairs = type(pairs)(**fields)

        clean = solve(pairs)
        spoilt = solve(spoilt_pairs)

        difference = se3.inverse(clean.T_parent_child) @ spoilt.T_parent_child
        moved = np.abs(se3.log(difference))
        sigmas = np.sqrt(np.diag(clean.cov_parent_child_in_child))
        assert (moved < 3.0 * sigmas).all(), (
            f"outliers move it by {moved / sigmas} sigma"
        )

    @pytest.mark.parametrize("reference", ["B1", "B5", "B10"])
    def test_covariance_counts_that_motions_overlap(self, reference):
        values = []
        for seed in range(30):
            solution = solve(motion_pairs(*noisy_poses(seed), reference))
            values.append(
                nees(error_of(solution), solution.cov_parent_child_in_child)
            )
        # Six degrees of freedom; few independent motions widen the distribution.
        assert_nees(values, 4.0, 11.0)

    def test_flat_ground_leaves_the_height_open(self):
        parent = planar_poses(200)
        mount = se3.from_rotation_translation(np.eye(3), [0.4, -0.2, 0.7])
        pairs = motion_pairs(parent, child_of(parent, mount), "B3")

        solution = solve(pairs)

        height = [0, 0, 1, 0, 0, 0]
        unseen = np.abs(solution.unseen[:, 0])
        assert_allclose(unseen, height, atol=1e-6)
        assert_allclose(solution.T_parent_child[:2], mount[:2], atol=1e-6)

    def test_the_stride_with_the_smallest_covariance_is_taken(self):
        parent, child = noisy_poses(3)

        best = solve_best_stride(parent, child)
        short = solve(motion_pairs(parent, child, "B1"))

        assert best.reference != "B1"
        _, of_best = np.linalg.slogdet(best.solution.cov_parent_child_in_child)
        _, of_short = np.linalg.slogdet(short.cov_parent_child_in_child)
        assert of_best < of_short


class TestMethod:
    def test_calibrate_says_which_stride_it_took(self):
        poses = wandering_poses(N_POSES, 5)
        parent, child = noisy_pair(poses, 5, SIGMA_M, SIGMA_RAD)

        result = hec.calibrate(parent, child, method="robust")

        assert result.method == "robust"
        assert result.reference_reason.startswith(f"{result.reference}: ")
        errors = np.abs(se3.deviation(result.T_parent_child, T_PARENT_CHILD))
        assert (errors < 4.0 * result.sigmas_measured).all()


class TestSecondOpinions:
    def test_answers_that_agree_add_almost_nothing(self):
        answer, opinions = answer_and_opinions(seed=2)
        largest_added = added_sigmas(answer, opinions).max()
        assert largest_added < 0.5 * answer.sigmas.max()

    @pytest.mark.parametrize("axis", range(6))
    def test_difference_is_added_on_its_axis(self, axis):
        answer, opinions = answer_and_opinions(seed=2)
        step = np.zeros(6)
        step[axis] = 0.1
        far = replace(
            answer,
            T_parent_child=shifted_in_parent(answer.T_parent_child, step),
        )
        expected = np.zeros(6)
        expected[axis] = 0.1
        assert_allclose(added_sigmas(far, opinions), expected, atol=0.01)

    def test_answers_that_are_less_certain_add_nothing(self):
        answer, opinions = answer_and_opinions(seed=2)
        T_far = shifted_in_parent(answer.T_parent_child, np.full(6, 0.1))
        certain = replace(
            answer,
            T_parent_child=T_far,
            observability=tuple(
                replace(dof, sigma=0.1 * dof.sigma)
                for dof in answer.observability
            ),
        )
        assert added_sigmas(certain, opinions).max() == 0.0

    def test_unobservable_axis_has_none(self):
        parent = planar_poses(300)
        child = child_of(parent, np.eye(4))
        high = se3.from_rotation_translation(np.eye(3), [0.0, 0.0, 5.0])
        opinions = second_opinions(parent, child, high)
        answer = replace(opinions[-1], T_parent_child=high)

        added = added_sigmas(answer, opinions)

        assert added[2] == 0.0

    def test_few_poses_have_an_opinion(self):
        parent, child = noisy_poses(4)
        few = slice(15)
        (opinion,) = second_opinions(parent[few], child[few], T_PARENT_CHILD)
        covariance = opinion.cov_parent_child_in_child
        assert np.isfinite(covariance).all()

    def test_sigmas_of_a_result_contain_the_excess(self, monkeypatch):
        poses = wandering_poses(N_POSES, 6)
        parent, child = noisy_pair(poses, 6, SIGMA_M, SIGMA_RAD)
        usual = hec.calibrate(parent, child, method="adaptive")
        path = "hand_eye_calib.core.engine.estimation.excess_covariance"
        monkeypatch.setattr(path, lambda *_: 0.05**2 * np.eye(6))

        widened = hec.calibrate(parent, child, method="adaptive")

        expected = np.hypot(usual.sigmas_measured, 0.05)
        assert_allclose(widened.sigmas_measured, expected, rtol=0.1)
        # The comparison states the standard deviation without second opinions.
        assert widened.cross_check["x"].sigma < 0.05
        assert widened.sigmas[0] > 0.05


def answer_and_opinions(seed):
    """Return an assessed result, and second opinions from the same poses."""
    parent, child = noisy_poses(seed)
    opinions = second_opinions(parent, child, T_PARENT_CHILD)
    answer = min(opinions, key=lambda opinion: opinion.sigmas.sum())
    return answer, opinions


def shifted_in_parent(T, step):
    """Return a transform after a shift (6,) along and about the parent's axes."""
    turn = se3.rotation_exp(step[3:])
    shifted = T.copy()
    shifted[:3, 3] += step[:3]
    shifted[:3, :3] = turn @ T[:3, :3]
    return shifted


def added_sigmas(answer, opinions):
    """Return the standard deviations (6,) that opinions add, along and about the parent's axes."""
    excess = excess_covariance(answer, opinions)
    rotation = answer.T_parent_child[:3, :3]
    return sigmas_in_parent(rotation, excess)
