"""``method: auto``: which answer stands, and why."""

import dataclasses

import numpy as np
import pytest
import real_data
from motions import (
    T_PARENT_CHILD,
    as_trajectory,
    child_of,
    disturbed,
    smooth_poses,
    wandering_poses,
)

import hand_eye_calib as hec
from hand_eye_calib.assessment.metrics import absolute_errors
from hand_eye_calib.assessment.reference_selection import ReferenceChoice
from hand_eye_calib.engine import estimation
from hand_eye_calib.engine.offline import offline_config, whole_snapshot
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls import estimator
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.results.verdict import Verdict
from hand_eye_calib.solvers.registry import Method


def noisy_streams(n_poses=150):
    parent = wandering_poses(n_poses)
    return tuple(
        as_trajectory(disturbed(poses, seed, 0.002, 0.002), 10)
        for seed, poses in ((1, parent), (2, child_of(parent)))
    )


def shifted(metres):
    return T_PARENT_CHILD @ se3.from_rotation_translation(np.eye(3), np.array([metres, 0.0, 0.0]))


def squared_distance(result, T_other, covariance):
    error = se3.log(result.T_child_parent @ T_other)
    return error @ np.linalg.solve(result.covariance + covariance, error)


class TestWhichAnswerStands:
    def test_that_of_the_noise_model(self):
        streams = noisy_streams()
        result = hec.calibrate(*streams, method="auto")
        model = hec.calibrate(*streams, method="adaptive")
        np.testing.assert_array_equal(result.T_parent_child, model.T_parent_child)
        np.testing.assert_array_equal(result.covariance, model.covariance)
        assert (result.method, result.reference) == ("adaptive", "increments")
        assert result.method_reason.startswith("auto: adaptive, compared with dnlo on reference ")
        assert result.noise == model.noise
        assert model.method_reason == ""

    def test_that_of_the_noise_model_with_care_if_dnlo_differs(self, monkeypatch):
        solve = estimator.solve

        def other(*poses, **options):
            found = solve(*poses, **options)
            return dataclasses.replace(found, T_parent_child=shifted(0.1))

        monkeypatch.setattr(estimation.adaptive_estimator, "solve", other)
        result = hec.calibrate(*noisy_streams(), method="auto")
        np.testing.assert_array_equal(result.T_parent_child, shifted(0.1))
        assert result.method == "adaptive"
        assert result.verdict is Verdict.USE_WITH_CARE
        assert "model" in {reason.rule for reason in result.reasons}

    @pytest.mark.parametrize(
        ("changes", "why"),
        [
            ({"is_drowned": True}, "single poses are noisier than the motion between them"),
            ({"converged": False}, "the adaptive estimator did not converge"),
        ],
    )
    def test_that_of_dnlo_if_the_noise_model_cannot_work(self, changes, why, monkeypatch):
        solve = estimator.solve
        monkeypatch.setattr(
            estimation.adaptive_estimator,
            "solve",
            lambda *poses, **options: dataclasses.replace(solve(*poses, **options), **changes),
        )
        streams = noisy_streams()
        result = hec.calibrate(*streams, method="auto")
        reference = result.reference
        dnlo = hec.calibrate(*streams, method="dnlo", reference=reference)
        np.testing.assert_array_equal(result.T_parent_child, dnlo.T_parent_child)
        np.testing.assert_array_equal(result.covariance, dnlo.covariance)
        assert (result.method, result.noise) == ("dnlo", None)
        assert result.method_reason == f"auto: dnlo on reference {reference}, because {why}"

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
        result = hec.calibrate(*streams, method="auto", reference="B3")
        dnlo = hec.calibrate(*streams, method="dnlo", reference="B3")
        np.testing.assert_array_equal(result.T_parent_child, dnlo.T_parent_child)
        assert (result.method, result.reference) == ("dnlo", "B3")
        assert result.method_reason == "auto: dnlo, because the user set reference B3"

    def test_the_estimator_is_solved_once(self, monkeypatch):
        solves = []
        solve = estimator.solve
        monkeypatch.setattr(
            estimator,
            "solve",
            lambda *poses, **options: solves.append(len(poses[0])) or solve(*poses, **options),
        )
        streams = noisy_streams()
        whole_snapshot(offline_config(*streams, {"method": "auto"}), *streams).estimate()
        assert solves == [150]

    def test_a_time_offset_that_dnlo_does_not_know_of_is_no_misfit(self):
        times_s = np.arange(400) / 20
        parent = as_trajectory(disturbed(smooth_poses(times_s), 1, 1e-4, 1e-4), 20.0)
        child = as_trajectory(
            disturbed(child_of(smooth_poses(times_s + 0.05)), 2, 1e-4, 1e-4), 20.0
        )
        result, dnlo = (
            whole_snapshot(
                offline_config(parent, child, {"method": method}), parent, child
            ).estimate()
            for method in ("auto", "dnlo")
        )
        apart = squared_distance(result, dnlo.T_parent_child, dnlo.covariance)
        assert apart > 22.46
        assert result.method == "adaptive"
        assert result.time_offset_s == pytest.approx(0.05, abs=1e-3)
        # The verdict compares with the same answer: of DNLO without that offset.
        assert squared_distance(result, *result.other_answer) < 22.46

    def test_the_witness_gets_poses_without_the_bias_that_was_found(self):
        """Of a path that is off by so much per metre, DNLO knows nothing."""
        parent = smooth_poses(np.arange(400) / 10)
        child = child_of(parent)
        steps = np.linalg.norm(np.diff(child[:, :3, 3], axis=0), axis=1)
        drift = child[:-1, :3, :3] @ [0.0, 0.06, 0.0] * steps[:, None]
        child[1:, :3, 3] += np.cumsum(drift, axis=0)
        given = PosePairs(np.arange(400) * 10**8, parent, disturbed(child, 1, 1e-4, 1e-4))
        solution = estimator.solve(given.stamps_ns, given.Ts_pw_p, given.Ts_cw_c)
        assert "bias" in solution.systematic
        off = [
            np.linalg.norm(
                Method("dnlo")
                .solve(motion_pairs(poses.Ts_pw_p, poses.Ts_cw_c, "B5"))
                .T_parent_child[:3, 3]
                - T_PARENT_CHILD[:3, 3]
            )
            for poses in (given, estimation._without_bias(given, solution))
        ]
        assert off[1] < 0.2 * off[0]

    def test_few_poses_are_not_compared(self):
        result = hec.calibrate(*noisy_streams(12), method="auto")
        assert result.method == "adaptive"
        assert "too few to compare" in result.method_reason

    def test_the_cross_check_solves_with_the_method_that_was_used(self):
        streams = noisy_streams(60)
        by_auto = hec.calibrate(*streams, method="auto")
        by_model = hec.calibrate(*streams, method="adaptive")
        found, expected = (hec.cross_check(result, *streams) for result in (by_auto, by_model))
        assert found["x"].of_halves == expected["x"].of_halves


class TestReferenceChoice:
    choice = ReferenceChoice(
        "B5", {"B1": 0.01, "B5": 0.02, "B20": 0.1}, {"B1": 0.02, "B5": 0.002, "B20": 0.001}
    )

    def test_the_joint_error_weighs_translation_and_rotation_alike(self):
        joint = self.choice.joint_errors()
        assert joint["B1"] == pytest.approx(np.sqrt((1 + 20**2) / 2))
        assert joint["B5"] == pytest.approx(2.0)
        assert joint["B20"] == pytest.approx(np.sqrt((10**2 + 1) / 2))

    def test_the_reason_has_both(self):
        assert "0.02 m and 0.11 deg, that of B1 0.01 m and 1.1 deg" in self.choice.reason()
