"""Stops: A X = Z B, its covariance, outliers, several sensors and targets, and what is unknown."""

import numpy as np
import pytest

from hand_eye_calib.engine.stops import calibrate_stops
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.geometry import se3
from hand_eye_calib.results.calibration import Verdict
from hand_eye_calib.solvers.robot_world import Stops, solve

LEVELS = np.repeat([0.002, 0.004], 3)  # m, rad


def poses(random, n, reach_m=0.3, turn_rad=0.5):
    xi = random.normal(size=(n, 6)) * np.repeat([reach_m, turn_rad], 3)
    return se3.exp(xi)


def recording(random, n, noise=1.0, outliers=0.0, Ts_world_parent=None, levels=LEVELS):
    """X, Z and the stops of a target seen by a camera in a hand."""
    X, Z = poses(random, 2, turn_rad=1.5)
    A = poses(random, n) if Ts_world_parent is None else Ts_world_parent
    B = se3.inverse(Z) @ A @ X @ se3.exp(noise * levels * random.normal(size=(n, 6)))
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
    first, second = solve(stops), solve(stops[random.permutation(30)])
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
    def test_rotations_about_all_axes_determine_everything(self, random):
        assert solve(recording(random, 15)[2]).undetermined().shape == (6, 0)

    @pytest.mark.parametrize("seed", range(10))
    @pytest.mark.parametrize("motion", ["one_axis", "no_rotation", "one_axis_unmoved"])
    def test_degenerate_stops_are_refused_by_axis(self, motion, seed):
        random = np.random.default_rng(seed)
        axis = random.normal(size=3)
        axis /= np.linalg.norm(axis)
        xi = np.zeros((25, 6))
        if motion != "one_axis_unmoved":
            xi[:, :3] = random.normal(size=(25, 3)) * 0.3
        if motion != "no_rotation":
            xi[:, 3:] = random.normal(size=(25, 1)) * axis
        A = poses(random, 1, turn_rad=2.0) @ se3.exp(xi)
        levels = LEVELS * random.uniform(0.3, 3.0)
        X, _, stops = recording(random, 25, Ts_world_parent=A, levels=levels)
        fit = solve(stops)
        unknown = np.kron(np.eye(2), fit.Ts_parent_child[0][:3, :3]) @ fit.undetermined()
        along = np.eye(3) if motion == "no_rotation" else axis[None]
        assert np.linalg.norm(along @ unknown[:3], axis=1).min() > 0.98
        if motion == "one_axis":
            assert unknown.shape == (6, 1)
        result = calibrate_stops(stops.Ts_world_parent, stops.Ts_world_child)
        assert result.verdict is not Verdict.USE
        assert result.reasons[0].rule in ("unobservable", "nothing_known")
