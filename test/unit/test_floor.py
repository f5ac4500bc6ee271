"""The common-mode floor, and the halves that widen a covariance."""

import numpy as np
import pytest
from motions import as_trajectory, child_of, disturbed, wandering_poses

import hand_eye_calib as hec
from hand_eye_calib.assessment.covariance import widened_by_halves
from hand_eye_calib.assessment.floor import (
    FLOOR_ROTATION,
    FLOOR_SCALE,
    FLOOR_TILT,
    axes_lost_by_tilt,
    common_mode_floor,
)
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import MotionPairs, motion_pairs
from hand_eye_calib.solvers.registry import Method


def streams(scale=1.0):
    parent = wandering_poses(120)
    child = as_trajectory(disturbed(child_of(parent), 2, 1e-4, 1e-4)).scaled(scale)
    return as_trajectory(disturbed(parent, 1, 1e-4, 1e-4)), child


class TestFloor:
    def test_a_height_that_a_tilted_axis_would_move_too_far_is_unobservable(self):
        rng = np.random.default_rng(4)
        vectors = rng.normal(size=(2000, 3)) * [0.01, 0.01, 0.4]
        motions = se3.exp(np.c_[np.zeros((2000, 3)), vectors])
        pairs = MotionPairs(motions, motions, np.arange(2000), np.arange(2000) + 1)

        def lost(height, sigma):
            T = se3.from_rotation_translation(np.eye(3), [0.3, 0.2, height])
            return axes_lost_by_tilt(pairs, np.ones(2000), T, np.array([0.01, 0.01, sigma]))

        assert lost(3.0, 0.01) == ["z"]
        assert lost(0.5, 0.01) == []
        assert lost(0.5, 0.29) == ["z"]
        assert lost(3.0, np.inf) == []  # it is unobservable already

    def test_its_translation_is_the_shift_that_a_wrong_scale_causes(self):
        parent, child = streams()
        answers = []
        for poses in (child.poses, child.scaled(1 + FLOOR_SCALE).poses):
            pairs = motion_pairs(parent.poses, poses, "B5")
            answers.append(Method("dnl").solve(pairs))
        pairs = motion_pairs(parent.poses, child.poses, "B5")
        T = answers[0].T_parent_child
        shift = se3.log(se3.inverse(T) @ answers[1].T_parent_child)[:3]
        floor = common_mode_floor(pairs, answers[0].weights, T)
        expected = np.outer(shift, shift)
        np.testing.assert_allclose(floor[:3, :3], expected, atol=0.1 * np.trace(expected))
        np.testing.assert_allclose(floor[3:, 3:], np.eye(3) * FLOOR_ROTATION**2)

    def test_a_tilted_axis_of_rotation_draws_the_height_to_zero(self):
        rng = np.random.default_rng(3)
        vectors = rng.normal(size=(4000, 3)) * [0.02, 0.02, 0.5]
        tilts = rng.normal(size=(4000, 2)) * FLOOR_TILT
        height, shown = 0.8, np.zeros((4000, 3))
        tilted = vectors.copy()
        tilted[:, :2] += tilts * vectors[:, 2:]
        lever = np.array([0.0, 0.0, height])
        shown[:] = np.cross(vectors, lever)
        arms = np.cross(tilted, [0.0, 0.0, 1.0])
        lost = 1.0 - (arms * shown).sum() / (height * (arms**2).sum())
        T = se3.from_rotation_translation(np.eye(3), lever)
        motions = se3.exp(np.c_[np.zeros((4000, 3)), tilted])
        pairs = MotionPairs(motions, motions, np.arange(4000), np.arange(4000) + 1)
        known = np.array([True, True, True])
        sigmas = [
            np.sqrt(np.diag(common_mode_floor(pairs, np.ones(4000), T, axes)))
            for axes in (None, known, ~known)
        ]
        np.testing.assert_allclose(sigmas[1][2], height * lost / (1.0 - lost), rtol=0.2)
        assert sigmas[1][2] > 0.04 > 0.01 > sigmas[1][:2].max()
        np.testing.assert_array_equal(sigmas[0], sigmas[2])

    @pytest.mark.parametrize("method", ["auto", "adaptive", "dnlo", "park"])
    def test_every_result_has_it_beside_the_covariance(self, method):
        result = hec.calibrate(*streams(), method=method)
        assert result.floor is not None
        np.testing.assert_allclose(result.sigmas_of_floor[3:], FLOOR_ROTATION)
        assert 1e-5 < result.sigmas_of_floor[:3].max() < 0.05
        assert result.sigmas[3:].max() < FLOOR_ROTATION
        np.testing.assert_allclose(
            result.sigmas_with_floor**2, result.sigmas**2 + result.sigmas_of_floor**2
        )
        np.testing.assert_array_equal(
            result.covariance_with_floor, result.covariance + result.floor
        )


class TestHalves:
    """Two halves of equal information, sigma of each 1, so that of the whole is sqrt(1/2)."""

    whole = 0.5 * np.eye(6)

    def products(self, apart):
        found = np.zeros((2, 7, 7))
        for products, sign in zip(found, (1, -1), strict=True):
            products[:6, :6] = np.eye(6)
            # The residuals at zero of a half whose answer is sign * apart / 2 along x.
            products[0, 6] = products[6, 0] = -sign * apart / 2
        return found

    def test_the_direction_of_their_difference_is_widened(self):
        wide = widened_by_halves(self.whole, self.products(9.0), misfit=1.0)
        assert wide[0, 0] / 0.5 == pytest.approx(9.0**2 / 2 / 10.64)
        np.testing.assert_allclose(wide[1:, 1:], self.whole[1:, 1:])

    def test_the_misfit_belongs_to_their_covariance(self):
        kept = widened_by_halves(self.whole, self.products(9.0), misfit=5.0)
        np.testing.assert_array_equal(kept, self.whole)
