"""The common-mode floor, and the halves that widen a covariance."""

import numpy as np
import pytest
from motions import as_trajectory, child_of, disturbed, wandering_poses

import hand_eye_calib as hec
from hand_eye_calib.assessment.covariance import widened_by_halves
from hand_eye_calib.assessment.floor import (
    FLOOR_ROTATION,
    FLOOR_TRANSLATION,
    common_mode_floor,
    floor_of_pairs,
    open_scale_floor,
    usual_speed,
)
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.solvers.registry import Method


def streams(scale=1.0):
    parent = wandering_poses(120)
    child = as_trajectory(disturbed(child_of(parent), 2, 1e-4, 1e-4)).scaled(scale)
    return as_trajectory(disturbed(parent, 1, 1e-4, 1e-4)), child


class TestFloor:
    def test_of_pairs_it_contains_the_shift_that_a_wrong_scale_causes(self):
        parent, child = streams()
        answers = []
        for poses in (child.poses, child.scaled(1.01).poses):
            pairs = motion_pairs(parent.poses, poses, "B5")
            answers.append(Method("dnl").solve(pairs))
        pairs = motion_pairs(parent.poses, child.poses, "B5")
        T = answers[0].T_parent_child
        floor = floor_of_pairs(pairs, answers[0].weights, T, 0.0)
        by_scale = se3.log(se3.inverse(T) @ answers[1].T_parent_child)
        of_scale = floor - common_mode_floor()
        direction = by_scale / np.linalg.norm(by_scale)
        assert direction @ of_scale @ direction > 0.99 * np.trace(of_scale)
        # These poses know the scale far better than one per cent.
        assert np.trace(of_scale) < 0.01 * by_scale @ by_scale

    def test_the_scale_is_as_open_as_the_data_leave_it(self):
        by_scale = np.r_[2.0, np.zeros(5)]
        fixed = common_mode_floor()
        np.testing.assert_allclose(np.diag(fixed)[:3], FLOOR_TRANSLATION**2)
        np.testing.assert_allclose(np.diag(fixed)[3:], FLOOR_ROTATION**2)
        for variance, expected in ((1e6, 0.02), (0.01**2, 0.02 / np.sqrt(2)), (0.0, 0.0)):
            found = open_scale_floor(by_scale, variance)
            assert np.sqrt(found[0, 0]) == pytest.approx(expected, rel=1e-3)

    def test_what_is_far_away_moves_the_centre_of_a_fast_odometry(self):
        found = np.sqrt(np.diag(common_mode_floor(speed_m_s=2.4)))
        np.testing.assert_allclose(found[:3], 0.013)
        fast = hec.calibrate(*(each.scaled(20.0) for each in streams()))
        assert fast.sigmas_of_floor[:3].min() > 2 * FLOOR_TRANSLATION

    def test_neither_stops_nor_jumps_count_for_the_usual_speed(self):
        stamps_ns = np.arange(600) * 100_000_000
        x = 0.2 * np.clip(np.arange(600) - 300, 0, None)  # half of the time at rest, then 2 m/s
        x[500:] += 40.0
        positions = np.column_stack([x, 0.0 * x, 0.0 * x])
        assert usual_speed(stamps_ns, positions) == pytest.approx(2.0)
        assert usual_speed(stamps_ns, 0.0 * positions) == 0.0

    def test_exact_poses_have_none(self):
        both = hec.calibrate(*streams(), parent_kind="exact", child_kind="exact")
        one, none = (hec.calibrate(*streams(), child_kind=kind) for kind in ("exact", "odometry"))
        assert not both.floor.any()
        np.testing.assert_allclose(2.0 * one.floor, none.floor)

    @pytest.mark.parametrize("method", ["auto", "adaptive", "dnlo", "park"])
    def test_every_result_has_it_beside_the_covariance(self, method):
        result = hec.calibrate(*streams(), method=method)
        np.testing.assert_allclose(result.sigmas_of_floor[3:], FLOOR_ROTATION, rtol=1e-3)
        assert 0.999 * FLOOR_TRANSLATION < result.sigmas_of_floor[:3].max() < 0.01
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
