"""Degenerate input ends in a result or in one clear line, for every kind of data and method."""

import warnings

import numpy as np
import pytest
from motions import child_of, disturbed, planar_poses, walked, wandering_poses

import hand_eye_calib as hec
from hand_eye_calib.core.assessment.moved import most_likely
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise import estimator

N_POSES = 40
STAMPS_NS = 1_700_000_000_000_000_000 + 100_000_000 * np.arange(N_POSES)

# What each stream of data measures; stops have no stamps.
KINDS = ("poses", "positions", "rotations", "rates", "stops")
METHODS = ("adaptive", "dnlo", "dnl", "park", "taylor", "zhuang", "ali")


def steady(twist):
    """Poses of a sensor that repeats one motion."""
    steps = np.tile(twist, (N_POSES - 1, 1))
    return walked(se3.exp(steps))


def rocking():
    """Poses of an arm that turns one joint to and fro."""
    random = np.random.default_rng(1)
    tool = se3.exp(np.array([0.5, 0.2, 0.3, 0.3, 0.2, 0.1]))
    twists = np.zeros((N_POSES, 6))
    twists[:, 5] = np.cumsum(random.normal(0.0, 0.1, N_POSES))
    return se3.exp(twists) @ tool


def shifted_only():
    """Poses that never turn."""
    rotations = np.tile(np.eye(3), (N_POSES, 1, 1))
    positions = wandering_poses(N_POSES)[:, :3, 3]
    return se3.from_rotation_translation(rotations, positions)


MOTIONS = {
    "none": lambda: np.tile(np.eye(4), (N_POSES, 1, 1)),
    "any": lambda: wandering_poses(N_POSES),
    "planar": lambda: planar_poses(N_POSES),
    "about one axis": rocking,
    "straight": lambda: steady([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]),
    "constant rotation": lambda: steady([0.1, 0.0, 0.0, 0.0, 0.0, 0.05]),
    "on the spot": lambda: steady([0.0, 0.0, 0.0, 0.0, 0.0, 0.05]),
    "half turns": lambda: steady([0.1, 0.0, 0.0, 0.0, 0.0, np.pi]),
    "without rotation": shifted_only,
    "two poses in turn": lambda: np.tile(
        wandering_poses(20)[[0, 19]], (N_POSES // 2, 1, 1)
    ),
}


def both_poses(motion, unit=1.0, sigma=0.0):
    """Poses of parent and child in other units of length, with noise of each (m, rad)."""
    parent = MOTIONS[motion]()
    child = child_of(parent)
    if sigma:
        parent = disturbed(parent, 1, sigma, sigma)
        child = disturbed(child, 2, sigma, sigma)
    for poses in (parent, child):
        poses[:, :3, 3] *= unit
    return parent, child


def calibrated(kind, stamps_ns, parent, child, **options):
    """Return a calibration of one kind of data."""
    if kind == "stops":
        return hec.calibrate_stops(parent, child)
    of_parent = hec.Trajectory(stamps_ns, parent)
    if kind == "positions":
        of_child = hec.Trajectory.from_positions(stamps_ns, child[:, :3, 3])
    elif kind == "rates":
        steps = se3.log(se3.inverse(child[:-1]) @ child[1:])
        of_child = hec.Trajectory.from_rates(stamps_ns[1:], steps[:, 3:] / 0.1)
    elif kind == "rotations":
        of_child = hec.Trajectory(stamps_ns, child, measures="rotations")
    else:
        of_child = hec.Trajectory(stamps_ns, child)
    return hec.calibrate(of_parent, of_child, **options)


def assert_clear_end(kind, stamps_ns, parent, child, **options):
    """Check that a calibration ends in a finite result or in one line, without a warning."""
    message = ""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            result = calibrated(kind, stamps_ns, parent, child, **options)
        except hec.HandEyeCalibError as error:
            message = str(error)
    if message:
        assert "\n" not in message
        return
    assert np.isfinite(result.T_parent_child).all()
    assert not np.isnan(result.sigmas).any()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("motion", MOTIONS)
def test_a_motion_without_noise(motion, kind):
    parent, child = both_poses(motion)
    assert_clear_end(kind, STAMPS_NS, parent, child)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("motion", MOTIONS)
def test_a_motion_without_noise_by_every_method(motion, method):
    parent, child = both_poses(motion)
    options = {"method": method, "checks": False}
    assert_clear_end("poses", STAMPS_NS, parent, child, **options)


@pytest.mark.parametrize("unit", [1e3, 1e-3])
@pytest.mark.parametrize("kind", ["poses", "positions", "stops"])
@pytest.mark.parametrize(
    "motion", ["any", "about one axis", "constant rotation"]
)
def test_another_unit_of_length(motion, kind, unit):
    parent, child = both_poses(motion, unit)
    assert_clear_end(kind, STAMPS_NS, parent, child)


@pytest.mark.parametrize("unit", [1e3, 1e-3])
@pytest.mark.parametrize("method", ["auto", "adaptive", "dnlo", "zhuang"])
@pytest.mark.parametrize("motion", MOTIONS)
def test_another_unit_of_length_by_some_methods(motion, method, unit):
    parent, child = both_poses(motion, unit, 1e-3)
    options = {
        "method": method,
        "scale": "none",
        "checks": False,
    }
    assert_clear_end("poses", STAMPS_NS, parent, child, **options)


@pytest.mark.parametrize(
    "option", [{"scale": "estimate"}, {"time_offset": "estimate"}]
)
@pytest.mark.parametrize("motion", MOTIONS)
def test_an_estimated_scale_or_offset(motion, option):
    parent, child = both_poses(motion)
    options = {"checks": False, **option}
    assert_clear_end("poses", STAMPS_NS, parent, child, **options)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("motion", ["none", "any"])
def test_identical_streams(motion, kind):
    parent, _ = both_poses(motion)
    assert_clear_end(kind, STAMPS_NS, parent, parent)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n_poses", [0, 1, 2, 3])
def test_few_poses(n_poses, kind):
    parent, child = both_poses("any")
    few = slice(n_poses)
    assert_clear_end(kind, STAMPS_NS[few], parent[few], child[few])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "rows", [[7], [*range(0, N_POSES, 4)], [*range(N_POSES)]]
)
def test_poses_that_are_not_finite(rows, kind):
    parent, child = both_poses("any")
    child[rows, 0, 3] = np.nan
    assert_clear_end(kind, STAMPS_NS, parent, child)


@pytest.mark.parametrize("kind", KINDS[:-1])
@pytest.mark.parametrize("rows", [[9], [*range(20, 30)], [*range(N_POSES)]])
def test_equal_stamps(rows, kind):
    parent, child = both_poses("any")
    stamps_ns = STAMPS_NS.copy()
    stamps_ns[rows] = stamps_ns[rows[0] - 1]
    assert_clear_end(kind, stamps_ns, parent, child)


@pytest.mark.parametrize("kind", KINDS[:-1])
def test_stamps_in_reverse_order(kind):
    parent, child = both_poses("any")
    reverse_ns = STAMPS_NS[::-1].copy()
    assert_clear_end(kind, reverse_ns, parent, child)


@pytest.fixture
def singular(monkeypatch):
    """Let the search of the noise model end in a singular matrix."""

    def fail(problem):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(estimator, "_search", fail)


def test_dnlo_stands_in_if_no_noise_model_fits(singular):
    parent, child = both_poses("any", sigma=1e-3)
    result = calibrated("poses", STAMPS_NS, parent, child, checks=False)
    reason = (
        "auto: dnlo on reference B3, because no noise model fits these poses"
    )
    assert result.method_reason == reason


@pytest.mark.parametrize(
    "options", [{"method": "adaptive"}, {"method": "dnlo"}]
)
def test_a_method_that_needs_the_noise_model_says_that_none_fits(
    singular, options
):
    parent, child = both_poses("any", sigma=1e-3)
    options = {"checks": False, **options}
    with pytest.raises(hec.HandEyeCalibError, match="no noise model fits"):
        calibrated("poses", STAMPS_NS, parent, child, **options)


def test_a_shift_by_evidence_of_one_direction_is_finite():
    tables = 1e30 * np.ones((1, 6, 7))
    shift = most_likely(tables, 1e-3)
    assert np.isfinite(shift).all()
