"""``method: auto``: which answer stands, and why."""

import dataclasses

import numpy as np
import pytest
from motions import (
    T_PARENT_CHILD,
    as_trajectory,
    child_of,
    disturbed,
    smooth_poses,
    wandering_poses,
)

import hand_eye_calib as hec
from hand_eye_calib.adaptive import estimator
from hand_eye_calib.assessment import model_fit
from hand_eye_calib.assessment.covariance import Assessment
from hand_eye_calib.assessment.reference_selection import ReferenceChoice
from hand_eye_calib.engine import estimation
from hand_eye_calib.engine.offline import offline_config, whole_snapshot
from hand_eye_calib.errors import ConfigError
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.solvers.registry import Method


def noisy_streams(n_poses=150):
    parent = wandering_poses(n_poses)
    return tuple(
        as_trajectory(disturbed(poses, seed, 0.002, 0.002), 10)
        for seed, poses in ((1, parent), (2, child_of(parent)))
    )


def shifted(metres):
    return T_PARENT_CHILD @ se3.from_rotation_translation(np.eye(3), np.array([metres, 0.0, 0.0]))


def known_to(sigma_m):
    return Assessment(np.diag([sigma_m**2] * 3 + [1e-4] * 3), ())


class TestWhichAnswerStands:
    def test_that_of_the_noise_model_if_it_fits(self):
        streams = noisy_streams()
        result = hec.calibrate(*streams, method="auto")
        model = hec.calibrate(*streams, method="adaptive")
        np.testing.assert_array_equal(result.T_parent_child, model.T_parent_child)
        np.testing.assert_array_equal(result.covariance, model.covariance)
        assert (result.method, result.reference) == ("adaptive", "increments")
        assert result.method_reason.startswith("auto: the noise model fits")
        assert result.noise == model.noise
        assert model.method_reason == ""

    def test_that_of_dnlo_if_it_does_not(self, monkeypatch):
        """Of a model that is wrong: its answer is half a metre off."""
        solve = estimator.solve

        def wrong(*poses, **options):
            found = solve(*poses, **options)
            return dataclasses.replace(found, T_parent_child=shifted(0.5))

        streams = noisy_streams()
        monkeypatch.setattr(estimation.adaptive_estimator, "solve", wrong)
        result = hec.calibrate(*streams, method="auto")
        reference = result.reference
        dnlo = hec.calibrate(*streams, method="dnlo", reference=reference)
        np.testing.assert_array_equal(result.T_parent_child, dnlo.T_parent_child)
        np.testing.assert_array_equal(result.covariance, dnlo.covariance)
        assert (result.method, result.noise) == ("dnlo", None)
        assert f"dnlo on reference {reference} stands" in result.method_reason
        assert "joint standard deviations" in result.method_reason

    def test_that_of_dnlo_if_a_reference_is_given(self):
        streams = noisy_streams(60)
        result = hec.calibrate(*streams, method="auto", reference="B3")
        dnlo = hec.calibrate(*streams, method="dnlo", reference="B3")
        np.testing.assert_array_equal(result.T_parent_child, dnlo.T_parent_child)
        assert (result.method, result.reference) == ("dnlo", "B3")
        assert result.method_reason == "auto: dnlo, for reference B3 is given"

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
        result = hec.calibrate(parent, child, method="auto", time_offset=0.0)
        dnlo = hec.calibrate(parent, child, method="dnlo", time_offset=0.0)
        apart = model_fit.squared_distance(
            se3.log(result.T_child_parent @ dnlo.T_parent_child),
            result.covariance + dnlo.covariance,
        )
        assert apart > 22.46
        assert result.method == "adaptive"
        assert result.time_offset_s == pytest.approx(0.05, abs=1e-3)
        # The verdict compares with the same answer: of DNLO without that offset.
        T_other, covariance = result.other_answer
        error = se3.log(result.T_child_parent @ T_other)
        assert model_fit.squared_distance(error, result.covariance + covariance) < 22.46

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
            for poses in (given, estimation._without_biases(given, solution))
        ]
        assert off[1] < 0.2 * off[0]

    def test_few_poses_are_not_compared(self):
        result = hec.calibrate(*noisy_streams(12), method="auto")
        assert result.method == "adaptive"
        assert "too few to compare" in result.method_reason

    def test_it_has_one_backend(self):
        with pytest.raises(ConfigError, match="method auto has no ipopt backend"):
            hec.calibrate(*noisy_streams(20), method="auto", backend="ipopt")

    def test_files_keep_the_reason(self):
        result = hec.calibrate(*noisy_streams(60), method="auto")
        loaded = hec.Calibration.from_dict(result.to_dict())
        assert (loaded.method, loaded.method_reason) == (result.method, result.method_reason)

    def test_the_cross_check_solves_with_the_method_that_was_used(self):
        streams = noisy_streams(60)
        by_auto = hec.calibrate(*streams, method="auto")
        by_model = hec.calibrate(*streams, method="adaptive")
        found, expected = (hec.cross_check(result, *streams) for result in (by_auto, by_model))
        np.testing.assert_array_equal(found.of_halves, expected.of_halves)


class TestWhatSpeaksAgainstTheModel:
    def why_not(self, shift_m=1e-3, floor_m=0.0, **changes):
        parent, child = noisy_streams(40)
        solution = estimator.solve(parent.stamps_ns, parent.poses, child.poses)
        good = {"misfit": 1.3, "converged": True, "T_parent_child": T_PARENT_CHILD}
        model = dataclasses.replace(solution, **(good | changes))
        dnlo = shifted(shift_m), known_to(0.01)
        return model_fit.why_not(model, known_to(0.01), dnlo, floor_m**2 * np.eye(6))

    def test_nothing(self):
        assert self.why_not(0.02) == ""

    @pytest.mark.parametrize(
        ("changes", "said"),
        [
            ({"jumps": np.arange(39) % 3 == 0}, "33% of the increments are jumps"),
            ({"misfit": 2.1}, "2.1 times the variance"),
            ({"converged": False}, "did not converge"),
            ({"is_drowned": True}, "drowns the rotation between them"),
            ({"shift_m": 0.1}, "2.9 joint standard deviations"),
        ],
    )
    def test_jumps_misfit_and_distance(self, changes, said):
        assert said in self.why_not(**changes)

    def test_residuals_smaller_than_predicted_are_no_misfit(self):
        """Of data without noise they are rounding."""
        assert self.why_not(misfit=1e-12) == ""

    def test_what_the_floor_covers_is_no_misfit(self):
        assert self.why_not(shift_m=0.1, floor_m=0.05) == ""

    def test_the_distance_is_in_units_of_the_joint_covariance(self):
        apart = model_fit.squared_distance(np.r_[0.05, np.zeros(5)], np.eye(6) * 0.02**2)
        assert apart == pytest.approx(0.05**2 / 0.02**2)

    def test_answers_that_are_the_same_need_no_statistics(self):
        assert self.why_not(shift_m=0.0, misfit=1e-9, converged=False) == ""


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
