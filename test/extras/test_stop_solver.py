"""Stops, A X = Z B: the estimate, its covariance, outliers, and unobservable directions."""

import numpy as np
import pytest
from sigmas import assert_nees, nees

from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops import robot_world
from hand_eye_calib.extras.stops.calibrate import calibrate_stops
from hand_eye_calib.extras.stops.closed_form import Stops
from hand_eye_calib.extras.stops.robot_world import solve


@pytest.fixture
def random():
    return np.random.default_rng(0)


LEVELS = np.repeat([0.002, 0.004], 3)  # m, rad


def poses(random, n, reach_m=0.3, turn_rad=0.5):
    xi = random.normal(size=(n, 6)) * np.repeat([reach_m, turn_rad], 3)
    return se3.exp(xi)


def recorded(random, n, noise=1.0, outliers=0.0, Ts_world_parent=None):
    """X, Z and the stops of a target seen by a camera in a hand."""
    X, Z = poses(random, 2, turn_rad=1.5)
    A = Ts_world_parent
    if A is None:
        A = poses(random, n)
    errors = noise * LEVELS * random.normal(size=(n, 6))
    B = se3.inverse(Z) @ A @ X @ se3.exp(errors)
    is_wrong = random.random(n) < outliers
    n_wrong = int(is_wrong.sum())
    B[is_wrong] = B[is_wrong] @ poses(random, n_wrong, 0.3, 0.5)
    return X, Z, Stops(A, B)


def off(estimate, truth):
    return se3.log(se3.inverse(estimate) @ truth)


@pytest.mark.parametrize("n", [3, 10, 1000])
def test_exact_stops_are_solved_exactly(random, n):
    X, Z, stops = recorded(random, n, noise=0.0)
    fit = solve(stops)
    assert np.abs(off(fit.T_parent_child, X)).max() < 1e-7
    assert np.abs(off(fit.T_world_world, Z)).max() < 1e-7


def errors_m(fits, Xs):
    return np.array(
        [
            np.linalg.norm(off(fit.T_parent_child, X)[:3])
            for fit, X in zip(fits, Xs, strict=True)
        ]
    )


def seen_by_a_camera(random, n):
    """X, Z and stops of a target whose distance and rotation have the largest errors."""
    X, Z, stops = recorded(random, n, noise=0.2)
    measured = se3.inverse(stops.Ts_world_child)
    position = se3.translation_of(measured)
    sight = position / np.linalg.norm(position, axis=1, keepdims=True)
    position = position + 0.01 * random.normal(size=(n, 1)) * sight
    turns = se3.rotation_exp(0.01 * random.normal(size=(n, 3)))
    measured = se3.from_rotation_translation(
        se3.rotation_of(measured) @ turns, position
    )
    return X, Z, Stops(stops.Ts_world_parent, se3.inverse(measured))


def test_errors_of_a_camera_are_weighted_by_their_source(random):
    fits = []
    single = []
    truths = []
    values = []
    for _ in range(30):
        X, Z, stops = seen_by_a_camera(random, 20)
        truths.append(X)
        fits.append(solve(stops))
        rests = np.ones(len(stops))
        single.append(robot_world._likelier_fit(stops, rests))
        values.append(nees_of(solve(stops, stretch=1e-3), X, Z))
    assert np.mean(errors_m(fits, truths)) < 0.8 * np.mean(
        errors_m(single, truths)
    )
    assert_nees(values, 8.0, 18.0)


def nees_of(fit, X, Z):
    error = np.r_[off(fit.T_parent_child, X), off(fit.T_world_world, Z)]
    return nees(error, fit.covariance)


# NEES of twelve is expected; the mean of 40 has a standard error of 0.8. A target of another size,
# or few stops, have larger sigmas.
@pytest.mark.parametrize(
    ("outliers", "size", "n", "lowest_nees"),
    [(0, 1, 20, 8.0), (0.15, 1, 20, 8.0), (0, 0.98, 20, 4.0), (0, 1, 4, 4.0)],
)
def test_covariance_is_that_of_the_errors(
    random, outliers, size, n, lowest_nees
):
    values = []
    for _ in range(40):
        X, Z, stops = recorded(random, n, outliers=outliers)
        stops.Ts_world_child[:, :3, 3] *= size
        values.append(nees_of(solve(stops), X, Z))
    assert_nees(values, lowest_nees, 18.0)


def test_covariance_is_that_of_errors_that_last(random):
    values = []
    n = 40
    lasting = np.linalg.cholesky(
        0.7 ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    )
    for _ in range(30):
        waves = np.sin(
            np.linspace(0.0, 6.0, n)[:, None] * random.uniform(0.5, 2.0, 6)
        )
        X, Z, stops = recorded(
            random, n, noise=0.0, Ts_world_parent=se3.exp(0.5 * waves)
        )
        errors = se3.exp(lasting @ random.normal(size=(n, 6)) * LEVELS)
        fit = solve(Stops(stops.Ts_world_parent, stops.Ts_world_child @ errors))
        values.append(nees_of(fit, X, Z))
    # NEES of twelve is expected; it was 25 when errors counted as independent.
    assert_nees(values, 6.0, 18.0)


def test_an_arm_that_rests_makes_no_outliers_of_the_other_stops(random):
    A = poses(random, 40)
    _, _, stops = recorded(random, 40, Ts_world_parent=A)
    at_rest = np.zeros(60, dtype=int)
    order = np.r_[at_rest, np.arange(40)]

    fit = solve(stops[order])

    assert np.all(fit.weights > 0.0)


def test_order_does_not_matter(random):
    _, _, stops = recorded(random, 30)
    first = solve(stops)
    second = solve(stops[random.permutation(30)])
    assert np.abs(off(first.T_parent_child, second.T_parent_child)).max() < 2e-4


def test_outliers_have_no_weight(random):
    X, _, stops = recorded(random, 40)
    stops.Ts_world_child[:4] = poses(random, 4, 1.0, 2.0)
    fit = solve(stops)
    assert np.all(fit.weights[:4] == 0.0)
    assert np.sum(fit.weights == 0.0) <= 6
    assert np.linalg.norm(off(fit.T_parent_child, X)[:3]) < 0.01


def test_two_stops_are_too_few(random):
    for n in (0, 1, 2):
        with pytest.raises(NotEnoughDataError, match="at least 3"):
            solve(recorded(random, n)[2])


class TestUndetermined:
    def test_rotations_about_all_axes_determine_everything(self, random):
        _, _, stops = recorded(random, 15)
        fit = solve(stops)
        assert fit.undetermined().shape == (6, 0)

    @pytest.mark.parametrize("seed", range(10))
    @pytest.mark.parametrize(
        "motion", ["one_axis", "no_rotation", "one_axis_unmoved", "two"]
    )
    def test_degenerate_stops_are_refused_by_axis(self, motion, seed):
        random = np.random.default_rng(seed)
        axes = se3.nearest_rotation(random.normal(size=(3, 3)))
        axis = axes[0]
        moves = 0.3 * random.normal(size=(25, 3))
        turns = random.normal(size=(25, 1)) * axis
        places = np.arange(25)
        undetermined_axes = axis[None]
        if motion == "one_axis_unmoved":
            moves[:] = 0.0
        elif motion == "no_rotation":
            turns[:] = 0.0
            undetermined_axes = np.eye(3)
        elif motion == "two":
            places = places % 2
        twists = np.c_[moves, turns][places]
        A = poses(random, 1, turn_rad=2.0) @ se3.exp(twists)
        noise = random.uniform(0.3, 3.0)
        _, _, stops = recorded(random, 25, noise, Ts_world_parent=A)

        fit = solve(stops)
        result = calibrate_stops(stops.Ts_world_parent, stops.Ts_world_child)

        to_parent = np.kron(np.eye(2), fit.T_parent_child[:3, :3])
        unknown = to_parent @ fit.undetermined()
        along = np.linalg.norm(undetermined_axes @ unknown[:3], axis=1)
        assert along.min() > 0.98
        has_one_unknown = unknown.shape == (6, 1)
        assert has_one_unknown == (motion == "one_axis")
        assert result.reasons[0].rule == "nothing_known"
        assert {"x", "y", "z"} & set(result.unobservable())
