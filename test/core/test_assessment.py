"""Covariances, verdicts of axes, the floor, and which answer ``method: auto`` takes."""

import dataclasses
from types import SimpleNamespace

import motions
import numpy as np
import pytest
import real_data
from numpy.testing import assert_allclose, assert_array_equal
from sigmas import assert_errors_over_sigmas

import hand_eye_calib as hec
from hand_eye_calib.core.assessment import common_mode
from hand_eye_calib.core.assessment import covariance as uncertainty
from hand_eye_calib.core.assessment.reference_selection import select_reference
from hand_eye_calib.core.base.blocks import Blocks
from hand_eye_calib.core.engine import estimation
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import absolute_errors
from hand_eye_calib.core.noise import estimator
from hand_eye_calib.core.noise.normal import NormalEquations
from hand_eye_calib.core.pairing.motion_pairs import PosePairs, motion_pairs
from hand_eye_calib.core.results.calibration import DofVerdict, Verdict
from hand_eye_calib.core.solvers.registry import Method

DNL = Method("dnl")


def solve_and_assess(parent, child, reference="B1", method=DNL):
    pairs = motion_pairs(parent, child, reference)
    solution = method.solve(pairs)
    return solution, uncertainty.assess(
        pairs,
        solution,
        lambda left_out: method.solve_without(pairs, solution, left_out),
    )


def errors_and_covariances(n_runs, estimate):
    """Errors xi against the truth (R, 6) and covariances (R, 6, 6) over independent noise."""
    parent = motions.wandering_poses(120)
    child = motions.child_of(parent)
    errors = []
    covariances = []
    for run in range(n_runs):
        solution, covariance = estimate(
            motions.disturbed(parent, 2 * run, 0.005, 0.005),
            motions.disturbed(child, 2 * run + 1, 0.005, 0.005),
        )
        errors.append(
            se3.log(
                se3.inverse(solution.T_parent_child) @ motions.T_PARENT_CHILD
            )
        )
        covariances.append(covariance)
    return np.array(errors), np.array(covariances)


@pytest.mark.statistics
def test_the_stated_sigma_is_the_scatter_of_the_errors():
    def estimate(parent, child):
        solution, assessment = solve_and_assess(parent, child, "B10")
        return solution, assessment.cov_parent_child_in_child

    errors, covariances = errors_and_covariances(60, estimate)

    variances = np.diagonal(covariances, axis1=1, axis2=2)
    sigmas = np.sqrt(np.median(variances, axis=0))
    ratios = errors / sigmas
    for axis in range(6):
        assert_errors_over_sigmas(ratios[:, axis], 1 / 2.5, 1 / 0.7)


def with_white_noise(poses, seed):
    return motions.disturbed(poses, seed, 0.005, 0.005)


def drifting(poses, seed):
    random = np.random.default_rng(seed)
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    errors = random.normal(0.0, 0.003, (len(steps), 6))
    drifting_steps = steps @ se3.exp(errors)
    return motions.walked(drifting_steps, poses[0])


@pytest.mark.statistics
@pytest.mark.parametrize("disturb", [with_white_noise, drifting])
def test_the_jackknife_of_the_adaptive_estimator_is_the_size_of_a_model_that_is_right(
    disturb,
):
    ratios = []
    for run in range(12):
        parent = motions.wandering_poses(150, seed=run)
        child = disturb(motions.child_of(parent), run)
        stamps_ns = np.arange(len(parent)) * 100_000_000
        solution = estimator.solve(stamps_ns, parent, child, systematic=())
        model = solution.cov_parent_child_in_child / solution.misfit
        blocks = Blocks(solution.part_products).merged(10)
        answers = NormalEquations(blocks.without()).step[:, :6]
        deviations = answers - answers.mean(axis=0)
        resampled = 0.9 * deviations.T @ deviations
        resampled_over_model = np.linalg.solve(model, resampled)
        ratios.append(np.trace(resampled_over_model) / 6)

    # Cutting the trajectory around what is left out would give 2 and more under white noise.
    ratio = np.mean(ratios)
    text = f"variance of the jackknife over that of the model: {ratio:.2f}"
    assert 0.7 < ratio < 1.4, text


@pytest.mark.parametrize(
    ("axis", "sigma", "verdict"),
    [
        ("z", 0.04, DofVerdict.OBSERVED),
        ("z", 0.06, DofVerdict.WEAK),
        ("z", 1.19, DofVerdict.UNOBSERVABLE),
        ("yaw", 0.01, DofVerdict.OBSERVED),
        ("yaw", 0.02, DofVerdict.WEAK),
        ("yaw", 0.31, DofVerdict.UNOBSERVABLE),
    ],
)
def test_an_axis_is_judged_by_its_standard_deviation(axis, sigma, verdict):
    expected_sigma = np.inf if verdict is DofVerdict.UNOBSERVABLE else sigma

    judgement = uncertainty.judged(axis, sigma)

    assert judgement.name == axis
    assert judgement.verdict == verdict
    assert judgement.sigma == expected_sigma


# ---- the common-mode floor, and the halves that widen a covariance


def streams(scale=1.0):
    poses = motions.wandering_poses(120)
    parent, child = motions.noisy_pair(poses, 1, 1e-4, 1e-4)
    return parent, child.scaled(scale)


class TestFloor:
    def test_of_pairs_it_contains_the_shift_that_a_wrong_scale_causes(self):
        parent, child = streams()
        method = Method("dnl")
        pairs = motion_pairs(parent.poses, child.poses, "B5")
        scaled_pairs = motion_pairs(
            parent.poses, child.scaled(1.01).poses, "B5"
        )
        answer = method.solve(pairs)
        scaled_answer = method.solve(scaled_pairs)
        T = answer.T_parent_child
        by_scale = se3.log(se3.inverse(T) @ scaled_answer.T_parent_child)

        floor = common_mode.floor_of_pairs(pairs, answer.weights, T, 0.0)

        of_scale = floor - common_mode.common_mode_floor()
        variance = np.trace(of_scale)
        direction = by_scale / np.linalg.norm(by_scale)
        assert direction @ of_scale @ direction > 0.99 * variance
        # These poses know the scale far better than one per cent.
        assert variance < 0.01 * by_scale @ by_scale

    def test_the_scale_is_as_open_as_the_data_leave_it(self):
        by_scale = np.r_[2.0, np.zeros(5)]
        fixed_variances = np.diag(common_mode.common_mode_floor())
        translation_variances = fixed_variances[:3]
        rotation_variances = fixed_variances[3:]
        assert_allclose(translation_variances, common_mode.FLOOR_TRANSLATION**2)
        assert_allclose(rotation_variances, common_mode.FLOOR_ROTATION**2)

        # Variance of the scale, and the expected standard deviation (m).
        cases = (
            (1e6, 0.02),
            (0.01**2, 0.02 / np.sqrt(2)),
            (0.0, 0.0),
        )
        for variance, expected in cases:
            floor = common_mode.open_scale_floor(by_scale, variance)
            sigma = np.sqrt(floor[0, 0])
            assert sigma == pytest.approx(expected, rel=1e-3)

    def test_what_is_far_away_moves_the_centre_of_a_fast_odometry(self):
        floor = common_mode.common_mode_floor(speed_m_s=2.4)
        sigmas = np.sqrt(np.diag(floor))
        assert_allclose(sigmas[:3], 0.013)

        parent, child = streams()
        fast = hec.calibrate(
            parent.scaled(20.0), child.scaled(20.0), checks=False
        )
        allowance_m = fast.allowance[:3]
        assert allowance_m.min() > 2 * common_mode.FLOOR_TRANSLATION

    def test_neither_stops_nor_jumps_count_for_the_usual_speed(self):
        numbers = np.arange(600)
        stamps_ns = numbers * 100_000_000
        # Half of the time at rest, then 2 m/s.
        x = 0.2 * np.clip(numbers - 300, 0, None)
        x[500:] += 40.0
        zero = np.zeros(600)
        positions = np.column_stack([x, zero, zero])
        still = np.zeros((600, 3))
        assert common_mode.usual_speed(stamps_ns, positions) == pytest.approx(
            2.0
        )
        assert common_mode.usual_speed(stamps_ns, still) == 0.0

    def test_exact_poses_have_none(self):
        both = hec.calibrate(
            *streams(), parent_kind="exact", child_kind="exact", checks=False
        )
        exact_child = hec.calibrate(
            *streams(), child_kind="exact", checks=False
        )
        odometry = hec.calibrate(
            *streams(), child_kind="odometry", checks=False
        )
        assert not both.allowance.any()
        half = 0.5 * odometry.covariance_allowance
        assert_allclose(exact_child.covariance_allowance, half)

    @pytest.mark.parametrize("method", ["auto", "adaptive", "dnlo", "park"])
    def test_every_result_has_it_beside_the_covariance(self, method):
        result = hec.calibrate(*streams(), method=method, checks=False)
        assert_allclose(
            result.allowance[3:], common_mode.FLOOR_ROTATION, rtol=1e-3
        )
        assert (
            0.999 * common_mode.FLOOR_TRANSLATION
            < result.allowance[:3].max()
            < 0.01
        )
        assert result.sigmas_measured[3:].max() < common_mode.FLOOR_ROTATION
        assert_allclose(
            result.sigmas**2, result.sigmas_measured**2 + result.allowance**2
        )
        assert_array_equal(
            result.covariance,
            result.covariance_measured + result.covariance_allowance,
        )


class TestBlocks:
    """Twenty parts of equal information, sigma of each 1."""

    def variances(self, scatter):
        """Over those of the model, where answers of parts scatter so many times too much."""
        random = np.random.default_rng(4)
        answers = random.standard_normal((20, 6)) * scatter
        products = np.tile(np.eye(7), (20, 1, 1))
        products[:, 6, :6] = answers
        products[:, :6, 6] = answers
        solution = SimpleNamespace(jumps=np.zeros(100), part_products=products)
        model_covariance = np.eye(6) / 20
        covariance = uncertainty.widened_by_blocks(
            model_covariance, solution, slice(0, 6)
        )
        return 20 * np.diag(covariance)

    def test_all_directions_have_one_factor(self):
        variances = self.variances([4, 4, 4, 1, 1, 1])
        # (16 + 1) / 2 is expected, of nine degrees of freedom.
        assert_allclose(variances, 7.76, rtol=1e-3)

    def test_rotations_have_a_larger_one_if_they_scatter_more(self):
        variances = self.variances([1, 1, 1, 4, 4, 4])
        of_translation = variances[:3]
        of_rotation = variances[3:]
        assert np.ptp(of_translation) == pytest.approx(0.0, abs=1e-9)
        assert np.ptp(of_rotation) == pytest.approx(0.0, abs=1e-9)
        assert of_translation[0] > 5.0
        assert of_translation[0] < of_rotation[0] / 1.5

    def test_parts_that_agree_leave_the_model(self):
        scatter = np.full(6, 0.3)
        variances = self.variances(scatter)
        assert_allclose(variances, 1.0)


# ---- the choice of a reference


def noisy_streams(n_poses=150):
    poses = motions.wandering_poses(n_poses)
    return motions.noisy_pair(poses, 1, 0.002, 0.002)


class TestWhichAnswerStands:
    def test_that_of_the_noise_model(self):
        streams = noisy_streams()
        result = hec.calibrate(*streams, method="auto", checks=False)
        model = hec.calibrate(*streams, method="adaptive", checks=False)
        assert_array_equal(result.T_parent_child, model.T_parent_child)
        assert_array_equal(
            result.covariance_measured, model.covariance_measured
        )
        assert (result.method, result.reference) == ("adaptive", "increments")
        assert (
            result.method_reason
            == "auto: adaptive, because its noise model works here"
        )
        assert result.noise == model.noise
        assert model.method_reason == ""

    @pytest.mark.parametrize(
        ("changes", "why"),
        [
            (
                {"is_noise_dominated": True},
                "single poses are noisier than the motion between them",
            ),
            ({"converged": False}, "the adaptive estimator did not converge"),
        ],
    )
    def test_that_of_dnlo_if_the_noise_model_cannot_work(
        self, changes, why, monkeypatch
    ):
        solve = estimator.solve
        monkeypatch.setattr(
            estimation.adaptive_estimator,
            "solve",
            lambda *poses, **options: dataclasses.replace(
                solve(*poses, **options), **changes
            ),
        )
        streams = noisy_streams()
        result = hec.calibrate(*streams, method="auto", checks=False)
        reference = result.reference
        dnlo = hec.calibrate(
            *streams, method="dnlo", reference=reference, checks=False
        )
        assert_array_equal(result.T_parent_child, dnlo.T_parent_child)
        assert (result.method, result.noise) == ("dnlo", None)
        assert (
            result.method_reason
            == f"auto: dnlo on reference {reference}, because {why}"
        )

    def test_dnlo_instead_of_the_noise_model_has_the_excess_of_second_opinions(
        self, monkeypatch
    ):
        solve = estimator.solve
        monkeypatch.setattr(
            estimation.adaptive_estimator,
            "solve",
            lambda *poses, **options: dataclasses.replace(
                solve(*poses, **options), converged=False
            ),
        )
        # Every second opinion differs by 1 cm and 0.01 rad more than the model expects.
        monkeypatch.setattr(
            estimation,
            "excess_covariance",
            lambda _, opinions: (
                1e-4 * np.eye(6) if opinions else np.zeros((6, 6))
            ),
        )
        streams = noisy_streams()
        result = hec.calibrate(*streams, method="auto", checks=False)
        dnlo = hec.calibrate(
            *streams, method="dnlo", reference=result.reference, checks=False
        )
        added = result.covariance_measured - dnlo.covariance_measured
        assert_allclose(np.diag(added), 1e-4, rtol=1e-3)

    def test_a_difference_from_dnlo_does_not_replace_the_better_answer(self):
        """Of this flight DNLO's answer is 20 mm and 1.7 deg off."""
        flight = real_data.euroc("vislam_ba", "v1_02")
        result = hec.calibrate(flight.parent, flight.child)
        assert result.method == "adaptive"
        metres, radians = absolute_errors(
            result.T_parent_child, real_data.EUROC_TRUTH
        )
        assert metres < 0.013
        assert np.degrees(radians) < 0.3
        assert result.verdict is Verdict.USE_WITH_CARE

    def test_that_of_dnlo_if_a_reference_is_given(self):
        streams = noisy_streams(60)

        result = hec.calibrate(
            *streams, method="auto", reference="B3", checks=False
        )
        dnlo = hec.calibrate(
            *streams, method="dnlo", reference="B3", checks=False
        )

        assert_array_equal(result.T_parent_child, dnlo.T_parent_child)
        assert result.method == "dnlo"
        assert result.reference == "B3"
        assert (
            result.method_reason
            == "auto: dnlo, because the user set reference B3"
        )


def test_the_reference_whose_answer_is_nearest_is_chosen():
    parent, child = noisy_streams()
    poses = PosePairs(parent.stamps_ns, parent.poses, child.poses)

    choice = select_reference(poses, Method("dnlo"))

    nearest = min(choice.distances.values())
    assert choice.distances[choice.reference] == nearest
    assert f"{choice.reference} of B1, B2, B3" in choice.reason()
