"""``method: auto``: which answer stands, and why."""

import dataclasses

import numpy as np
import pytest
import real_data
from motions import as_trajectory, child_of, disturbed, wandering_poses

import hand_eye_calib as hec
from hand_eye_calib.assessment.reference_selection import select_reference
from hand_eye_calib.engine import estimation
from hand_eye_calib.geometry.extrinsic import absolute_errors
from hand_eye_calib.gls import estimator
from hand_eye_calib.pairing.motion_pairs import PosePairs
from hand_eye_calib.results.verdict import Verdict
from hand_eye_calib.solvers.registry import Method


def noisy_streams(n_poses=150):
    parent = wandering_poses(n_poses)
    return tuple(
        as_trajectory(disturbed(poses, seed, 0.002, 0.002), 10)
        for seed, poses in ((1, parent), (2, child_of(parent)))
    )


class TestWhichAnswerStands:
    def test_that_of_the_noise_model(self):
        streams = noisy_streams()
        result = hec.calibrate(*streams, method="auto")
        model = hec.calibrate(*streams, method="adaptive")
        np.testing.assert_array_equal(result.T_parent_child, model.T_parent_child)
        np.testing.assert_array_equal(result.covariance, model.covariance)
        assert (result.method, result.reference) == ("adaptive", "increments")
        assert result.method_reason == "auto: adaptive, because its noise model works here"
        assert result.noise == model.noise
        assert model.method_reason == ""

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


def test_the_reference_whose_answer_is_nearest_is_chosen():
    parent, child = noisy_streams()
    poses = PosePairs(parent.stamps_ns, parent.poses, child.poses)
    choice = select_reference(poses, Method("dnlo"))
    assert choice.distances[choice.reference] == min(choice.distances.values())
    assert f"{choice.reference} of B1, B2, B3" in choice.reason()
