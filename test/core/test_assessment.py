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
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.text import prior_as_typed
from hand_eye_calib.core.engine import estimation
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import absolute_errors
from hand_eye_calib.core.noise import estimator
from hand_eye_calib.core.noise.normal import NormalEquations
from hand_eye_calib.core.pairing.motion_pairs import PosePairs, motion_pairs
from hand_eye_calib.core.results.calibration import DofVerdict, SolveStatus, Verdict
from hand_eye_calib.core.solvers.registry import Method
from hand_eye_calib.formats.results import load_result
from hand_eye_calib.offline.calibrate import calibrate
from hand_eye_calib.offline.cli.main import main

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
            se3.log(se3.inverse(solution.T_parent_child) @ motions.T_PARENT_CHILD)
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
        scaled_pairs = motion_pairs(parent.poses, child.scaled(1.01).poses, "B5")
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
        fast = hec.calibrate(parent.scaled(20.0), child.scaled(20.0), checks=False)
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
        assert common_mode.usual_speed(stamps_ns, positions) == pytest.approx(2.0)
        assert common_mode.usual_speed(stamps_ns, still) == 0.0

    def test_exact_poses_have_none(self):
        both = hec.calibrate(
            *streams(), parent_kind="exact", child_kind="exact", checks=False
        )
        exact_child = hec.calibrate(*streams(), child_kind="exact", checks=False)
        odometry = hec.calibrate(*streams(), child_kind="odometry", checks=False)
        assert not both.allowance.any()
        half = 0.5 * odometry.covariance_allowance
        assert_allclose(exact_child.covariance_allowance, half)

    @pytest.mark.parametrize("method", ["auto", "adaptive", "dnlo", "park"])
    def test_every_result_has_it_beside_the_covariance(self, method):
        result = hec.calibrate(*streams(), method=method, checks=False)
        assert_allclose(result.allowance[3:], common_mode.FLOOR_ROTATION, rtol=1e-3)
        assert 0.999 * common_mode.FLOOR_TRANSLATION < result.allowance[:3].max() < 0.01
        assert result.sigmas_measured[3:].max() < common_mode.FLOOR_ROTATION
        assert_allclose(
            result.sigmas**2, result.sigmas_measured**2 + result.allowance**2
        )
        assert_array_equal(
            result.covariance, result.covariance_measured + result.covariance_allowance
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
        assert_array_equal(result.covariance_measured, model.covariance_measured)
        assert (result.method, result.reference) == ("adaptive", "increments")
        assert (
            result.method_reason == "auto: adaptive, because its noise model works here"
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
        dnlo = hec.calibrate(*streams, method="dnlo", reference=reference, checks=False)
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
            lambda _, opinions: 1e-4 * np.eye(6) if opinions else np.zeros((6, 6)),
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
        metres, radians = absolute_errors(result.T_parent_child, real_data.EUROC_TRUTH)
        assert metres < 0.013
        assert np.degrees(radians) < 0.3
        assert result.verdict is Verdict.USE_WITH_CARE

    def test_that_of_dnlo_if_a_reference_is_given(self):
        streams = noisy_streams(60)

        result = hec.calibrate(*streams, method="auto", reference="B3", checks=False)
        dnlo = hec.calibrate(*streams, method="dnlo", reference="B3", checks=False)

        assert_array_equal(result.T_parent_child, dnlo.T_parent_child)
        assert result.method == "dnlo"
        assert result.reference == "B3"
        assert result.method_reason == "auto: dnlo, because the user set reference B3"


def test_the_reference_whose_answer_is_nearest_is_chosen():
    parent, child = noisy_streams()
    poses = PosePairs(parent.stamps_ns, parent.poses, child.poses)

    choice = select_reference(poses, Method("dnlo"))

    nearest = min(choice.distances.values())
    assert choice.distances[choice.reference] == nearest
    assert f"{choice.reference} of B1, B2, B3" in choice.reason()


# ---- priors


pytestmark = pytest.mark.usefixtures("no_figures")

# A sensor on a mast, looking back.
MOUNT = se3.from_rotation_translation(
    se3.rotation_exp(np.array([0.0, 0.0, np.pi - 0.2])), [0.6, -0.3, 1.85]
)


def flat_drive(noise=0.001, mount=MOUNT):
    poses = motions.planar_poses(400)
    return motions.noisy_pair(poses, 1, noise, noise, mount=mount)


def sigmas(result):
    return {dof.name: dof.sigma for dof in result.observability_measured}


class TestOption:
    @pytest.mark.parametrize(
        ("name", "text", "prior"),
        [
            ("prior.z", "1.85+/-0.02", {"z": (1.85, 0.02)}),
            ("prior.z", "185cm +/- 20mm", {"z": (1.85, 0.02)}),
            ("prior.z", "1.85+-0.02", {"z": (1.85, 0.02)}),
            ("prior.x", "-.5±1e-2", {"x": (-0.5, 0.01)}),
            ("prior.yaw", "-90deg+/-2deg", {"yaw": (-np.pi / 2, np.radians(2))}),
            ("prior.roll", "0.1+/-0.05", {"roll": (0.1, 0.05)}),
            ("prior.z", "8m+/-0.02", {"z": (8.0, 0.02)}),
            ("prior.z", "800cm+/-2cm", {"z": (8.0, 0.02)}),
            ("prior.x", "-22cm+/-20mm", {"x": (-0.22, 0.02)}),
            ("prior.y", "4.9+/-0.1", {"y": (4.9, 0.1)}),
            ("prior.y", "", {}),
        ],
    )
    def test_values_with_units(self, name, text, prior):
        field = name.replace(".", "_")
        config = CalibratorConfig(**{field: text})

        parsed = config.prior()

        assert list(parsed) == list(prior)
        for axis, value_and_sigma in prior.items():
            assert parsed[axis] == pytest.approx(value_and_sigma)

    @pytest.mark.parametrize(
        ("name", "text", "message"),
        [
            ("prior_z", "1.85", "with its standard deviation"),
            ("prior_z", "1.85+/-0", "standard deviation above 0"),
            ("prior_z", "1.85deg+/-0.02", "numbers in m or cm or mm"),
            ("prior_z", "high+/-0.02", "numbers in m or cm or mm"),
            ("prior_yaw", "-90+/-2", "write -90deg"),
            ("prior_x", "1e999+/-1", r"at most 1e\+06 m; got '1e999'"),
            ("prior_x", "1+/-1e200", r"at most 1e\+06 m; got '1e200'"),
            ("prior_yaw", "1+/-1e999", r"at most 1e\+06 rad; got '1e999'"),
            ("prior_z", "-22+/-2", r"write -22cm\+/-2cm or -22m\+/-2m"),
            ("prior_x", "5.1+/-0.02", r"write 5.1cm\+/-0.02cm or 5.1m\+/-0.02m"),
            ("prior_y", "220.0+/-20.0", "may be m, cm or mm"),
            ("prior_z", "8+/-2cm", r"write 8cm\+/-2cm or 8m\+/-2cm"),
            (
                "prior_z",
                "-22cm+/-2",
                "standard deviation 2 needs a unit: write 2cm or 2m",
            ),
            (
                "prior_yaw",
                "-90deg+/-2",
                "standard deviation 2 needs a unit: write 2deg or 2rad",
            ),
        ],
    )
    def test_what_does_not_say_enough_is_refused(self, name, text, message):
        options = {name: text}
        with pytest.raises(ConfigError, match=message):
            CalibratorConfig(**options)


class TestFlatGround:
    def test_a_prior_alone_has_no_allowance_and_can_be_used(self):
        sigmas_m = {}
        for sigma_m in (0.02, 0.005):
            result = calibrate(
                *flat_drive(), prior={"z": (1.85, sigma_m)}, checks=False
            )
            sigmas_m[sigma_m] = result.sigmas[2]
            assert result.observability[2].verdict is DofVerdict.PRIOR
            assert result.allowance[2] < 0.0005
            assert result.allowance[:2].min() > 0.005
        assert sigmas_m == pytest.approx({0.02: 0.02, 0.005: 0.005}, rel=0.02)
        assert sigmas_m[0.02] <= 0.02

    def test_a_prior_beside_a_better_estimate_keeps_the_allowance_of_that(
        self, wandering
    ):
        streams, plain = wandering
        vague = calibrate(
            *streams, reference="B10", prior={"z": (0.0, 100.0)}, checks=False
        )
        assert_allclose(vague.allowance, plain.allowance, rtol=1e-3)

    def test_prior_fills_in_what_is_unknown(self):
        result = calibrate(*flat_drive(), reference="B10", prior={"z": (1.85, 0.02)})
        assert result.status is SolveStatus.OK
        assert result.unobservable() == []
        assert_allclose(result.T_parent_child[:3, 3], MOUNT[:3, 3], atol=0.03)
        verdicts = {dof.name: dof.verdict for dof in result.observability}
        assert verdicts["z"] is DofVerdict.PRIOR
        assert verdicts["yaw"] is DofVerdict.OBSERVED
        assert sigmas(result)["z"] == pytest.approx(0.02, rel=0.05)
        assert any(
            "z of the child sensor: mostly from the prior" in warning
            for warning in result.warnings
        )

    @pytest.mark.parametrize(
        "method", ["dnlo", "dnl", "park", "taylor", "zhuang", "ali"]
    )
    def test_every_method_takes_it(self, method):
        # Zhuang's starts at no rotation and this mount is nearly half a turn.
        mount = se3.from_rotation_translation(
            se3.rotation_exp(np.array([0.0, 0.0, 0.4])), MOUNT[:3, 3]
        )
        # Rotations alone do not show where x points on flat ground: the paper's two-stage methods
        # need the yaw too.
        prior = {"z": (1.85, 0.02), "yaw": (0.4, 0.001)}
        options = {
            "method": method,
            "reference": "B10",
            "prior": prior,
            "checks": False,
        }
        result = calibrate(*flat_drive(noise=0.0005, mount=mount), **options)
        assert result.T_parent_child[2, 3] == pytest.approx(1.85, abs=0.03)


@pytest.fixture(scope="module")
def wandering():
    """Two streams of full motion, and their calibration without a prior."""
    streams = motions.noisy_pair(
        motions.wandering_poses(300), 1, 0.01, 0.005, mount=MOUNT
    )
    return streams, calibrate(*streams, reference="B10")


class TestFullMotion:
    def test_a_vague_prior_changes_nothing(self, wandering):
        streams, plain = wandering
        vague = calibrate(
            *streams, reference="B10", prior={"z": (0.0, 100.0)}, checks=False
        )
        assert_allclose(vague.T_parent_child, plain.T_parent_child, atol=1e-5)
        assert [dof.verdict for dof in vague.observability] == [
            dof.verdict for dof in plain.observability
        ]

    @pytest.mark.parametrize(
        ("axis", "prior"),
        [
            ("x", (-0.6, 0.001)),
            ("x", "100m+/-1e-9m"),
            ("z", "15m+/-0.05m"),
            ("yaw", (0.2, 0.01)),
        ],
    )
    def test_a_contradiction_is_refused_and_the_prior_left_out(
        self, wandering, axis, prior
    ):
        streams, plain = wandering
        result = calibrate(*streams, reference="B10", prior={axis: prior})
        assert result.status is SolveStatus.CONTRADICTED
        assert result.status.failure == "a prior contradicts the motion"
        assert result.verdict is Verdict.DO_NOT_USE
        assert result.reasons[0].sentence.startswith(f"the prior on {axis} is ")
        assert result.reasons[0].advice == f"check value, unit and sign of prior.{axis}"
        assert_array_equal(result.T_parent_child, plain.T_parent_child)
        assert_array_equal(result.covariance_measured, plain.covariance_measured)


@pytest.mark.parametrize("interface", ["Python", "command", "YAML", "page"])
def test_centimetres_that_were_typed_without_a_unit_are_asked_about(
    interface, tmp_path, capsys
):
    paths = motions.write_pair(tmp_path, *flat_drive())
    expected = "prior.z needs a unit: -22"
    if interface == "Python":
        with pytest.raises(ConfigError, match=expected):
            calibrate(*flat_drive(), prior={"z": (-22.0, 2.0)})
        return
    if interface == "page":
        with pytest.raises(ConfigError, match=expected):
            CalibratorConfig(prior_z=prior_as_typed("z", "-22", "2"))
        assert prior_as_typed("z", "-22 ", "2cm") == "-22+/-2cm"
        assert prior_as_typed("z", "-0,22", "0.02") == "-0.22m+/-0.02m"
        assert prior_as_typed("z", "8m", "0.02") == "8m+/-0.02m"
        assert prior_as_typed("yaw", "-90", "2") == "-90deg+/-2deg"
        return
    options = ["--prior", "z=-22+/-2"]
    if interface == "YAML":
        file = tmp_path / "options.yaml"
        file.write_text("prior.z: -22+/-2\n", encoding="utf-8")
        options = ["--config", str(file)]
    try:
        status = main(["calibrate", *paths, *options, "--out", str(tmp_path / "out")])
    except SystemExit as usage:
        status = usage.code
    assert status == 2
    error = capsys.readouterr().err
    assert (
        "needs a unit: -22 may be m, cm or mm; write -22cm+/-2cm or -22m+/-2m" in error
    )
    assert not (tmp_path / "out").exists()


def test_along_an_unobservable_axis_only_an_impossible_distance_contradicts():
    # A boom of 15 m is longer than "unknown" assumes, and the motion says nothing about it.
    parent, child = flat_drive()
    boom = {"z": "15m+/-0.05m"}
    in_millimetres = {"z": "1850m+/-20m"}

    result = calibrate(parent, child, reference="B10", prior=boom)
    contradicted = calibrate(parent, child, reference="B10", prior=in_millimetres)

    assert result.status is SolveStatus.OK
    assert result.T_parent_child[2, 3] == pytest.approx(15.0, abs=0.05)
    assert contradicted.status is SolveStatus.CONTRADICTED
    assert contradicted.unobservable() == ["z"]


def test_the_command_refuses_a_contradiction(tmp_path, capsys):
    paths = motions.write_pair(tmp_path, *flat_drive())
    frames = ["--parent-frame", "lidar", "--child-frame", "camera"]
    command = [
        "calibrate",
        *paths,
        *frames,
        "--reference",
        "B10",
        "--out",
        str(tmp_path / "out"),
    ]
    assert main([*command, "--prior", "x=100m+/-1e-9m"]) == 1
    captured = capsys.readouterr()
    assert "the prior on x is " in captured.err
    assert captured.out.startswith("DO NOT USE: the prior on x is ")
    assert "static_transform" not in captured.out
    assert load_result(tmp_path / "out").status is SolveStatus.CONTRADICTED
    files = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert files == ["extrinsic.yaml", "report.html"]
