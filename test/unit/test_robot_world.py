"""Stops: A X = Z B, its covariance, outliers, several sensors and targets, and what is unknown."""

import numpy as np
import pytest

from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.geometry import se3
from hand_eye_calib.solvers.robot_world import Stops, solve

LEVELS = np.repeat([0.002, 0.004], 3)  # m, rad


def poses(random, n, reach_m=0.3, turn_rad=0.5):
    xi = random.normal(size=(n, 6)) * np.repeat([reach_m, turn_rad], 3)
    return se3.exp(xi)


def recording(random, n, noise=1.0, outliers=0.0, Ts_world_parent=None):
    """X, Z and the stops of a target seen by a camera in a hand."""
    X, Z = poses(random, 2, turn_rad=1.5)
    A = poses(random, n) if Ts_world_parent is None else Ts_world_parent
    B = se3.inverse(Z) @ A @ X @ se3.exp(noise * LEVELS * random.normal(size=(n, 6)))
    wrong = random.random(n) < outliers
    B[wrong] = B[wrong] @ poses(random, int(wrong.sum()), 0.3, 0.5)
    return X, Z, Stops.of_one(A, B)


def off(estimate, truth):
    return se3.log(se3.inverse(estimate) @ truth)


@pytest.fixture
def random():
    return np.random.default_rng(0)


@pytest.mark.parametrize("n", [3, 10, 1000])
def test_exact_stops_are_solved_exactly(random, n):
    X, Z, stops = recording(random, n, noise=0.0)
    fit = solve(stops)
    assert np.abs(off(fit.Ts_parent_child[0], X)).max() < 1e-7
    assert np.abs(off(fit.Ts_world_world[0], Z)).max() < 1e-7


@pytest.mark.parametrize("outliers", [0.0, 0.15])
def test_covariance_is_that_of_the_errors(random, outliers):
    squared = []
    for _ in range(40):
        X, Z, stops = recording(random, 20, outliers=outliers)
        fit = solve(stops)
        error = np.r_[off(fit.Ts_parent_child[0], X), off(fit.Ts_world_world[0], Z)]
        squared.append(error @ np.linalg.solve(fit.covariance, error))
    # Twelve are expected; the mean of 40 scatters by 0.8.
    assert 8.0 < np.mean(squared) < 18.0


def test_order_does_not_matter(random):
    _, _, stops = recording(random, 30)
    first, second = solve(stops), solve(stops.take(random.permutation(30)))
    assert np.abs(off(first.Ts_parent_child[0], second.Ts_parent_child[0])).max() < 2e-4


def test_outliers_have_no_weight(random):
    X, _, stops = recording(random, 40)
    stops.Ts_world_child[:4] = poses(random, 4, 1.0, 2.0)
    fit = solve(stops)
    assert np.all(fit.weights[:4] == 0.0)
    assert np.sum(fit.weights == 0.0) <= 6
    assert np.linalg.norm(off(fit.Ts_parent_child[0], X)[:3]) < 0.01


def test_several_cameras_and_targets_are_one_solve(random):
    Xs, Zs = poses(random, 2, turn_rad=1.5), poses(random, 3, turn_rad=1.5)
    child, world = np.array([0, 0, 1, 1, 1]).repeat(20), np.array([0, 1, 1, 2, 0]).repeat(20)
    A = poses(random, 100)
    B = se3.inverse(Zs[world]) @ A @ Xs[child] @ se3.exp(LEVELS * random.normal(size=(100, 6)))
    fit = solve(Stops(A, B, child, world))
    for estimates, truths in ((fit.Ts_parent_child, Xs), (fit.Ts_world_world, Zs)):
        errors = off(estimates, truths)
        assert np.linalg.norm(errors[:, :3], axis=1).max() < 0.02
        assert np.linalg.norm(errors[:, 3:], axis=1).max() < 0.02


def test_sensors_without_a_common_target_are_refused(random):
    _, _, stops = recording(random, 20)
    side = np.arange(20) % 2
    with pytest.raises(NotEnoughDataError, match="tied to no others"):
        solve(Stops(stops.Ts_world_parent, stops.Ts_world_child, side, side))


@pytest.mark.parametrize("n", [0, 1, 2])
def test_two_stops_are_too_few(random, n):
    _, _, stops = recording(random, n)
    with pytest.raises(NotEnoughDataError, match="at least 3"):
        solve(stops)


class TestUndetermined:
    @staticmethod
    def unknown(stops):
        """Which of six directions along and about the parent's axes are not determined."""
        fit = solve(stops)
        to_parent = np.kron(np.eye(2), fit.Ts_parent_child[0][:3, :3])
        return np.linalg.norm(to_parent @ fit.undetermined(), axis=1) > 0.3

    def test_rotations_about_all_axes_determine_everything(self, random):
        _, _, stops = recording(random, 15)
        assert not self.unknown(stops).any()

    def test_a_scara_does_not_show_the_height(self, random):
        xi = np.zeros((25, 6))
        xi[:, [0, 1, 2, 5]] = random.normal(size=(25, 4)) * [0.3, 0.3, 0.1, 1.0]
        _, _, stops = recording(random, 25, Ts_world_parent=se3.exp(xi))
        assert self.unknown(stops).tolist() == [False, False, True, False, False, False]

    def test_without_rotation_no_translation_is_known(self, random):
        A = np.tile(np.eye(4), (25, 1, 1))
        A[:, :3, 3] = random.normal(size=(25, 3)) * 0.3
        _, _, stops = recording(random, 25, Ts_world_parent=A)
        assert self.unknown(stops)[:3].all()
