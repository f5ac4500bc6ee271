"""Scale: estimated for every method, by whatever motion there is, with outliers, with its standard
deviation.
"""

import dataclasses

import numpy as np
import pytest
from motions import (
    T_PARENT_CHILD,
    as_trajectory,
    child_of,
    disturbed,
    planar_poses,
    wandering_poses,
)

from hand_eye_calib.alignment.similarity import estimate_scale
from hand_eye_calib.engine.offline import calibrate
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import PosePairs


def streams(n_poses=400, seed=0, scale=1.0, noise=0.0, poses=wandering_poses):
    """Both at 10 Hz; the child's lengths must be multiplied by ``scale``."""
    parent = poses(n_poses, seed)
    child = disturbed(child_of(parent), seed + 2, noise, noise)
    return as_trajectory(disturbed(parent, seed + 1, noise, noise)), as_trajectory(child).scaled(
        1 / scale
    )


def pose_pairs(parent, child):
    return PosePairs(parent.stamps_ns, parent.poses, child.poses)


@pytest.mark.parametrize("scale", [1e-3, 0.3048, 1.0, 3.34, 1000.0])
@pytest.mark.parametrize("poses", [wandering_poses, planar_poses])
def test_noise_free_scale_is_exact(scale, poses):
    found = estimate_scale(pose_pairs(*streams(scale=scale, poses=poses)))
    assert found.scale == pytest.approx(scale, rel=1e-5)
    assert found.explains_translation


def test_most_pairs_decide_whatever_the_others_say():
    parent, child = streams(scale=2.5, noise=0.002)
    random = np.random.default_rng(0)
    wrong = random.random(len(child)) < 0.12
    poses = child.poses.copy()
    poses[wrong] = poses[wrong] @ se3.exp(random.normal(size=(int(wrong.sum()), 6)))
    found = estimate_scale(pose_pairs(parent, dataclasses.replace(child, poses=poses)))
    assert found.scale == pytest.approx(2.5, rel=0.01)


def test_standard_deviation_is_of_the_size_of_the_errors():
    found = [
        estimate_scale(pose_pairs(*streams(seed=seed, scale=1.7, noise=0.01)))
        for seed in range(0, 60, 5)
    ]
    ratios = [(fit.scale - 1.7) / fit.scale_sigma for fit in found]
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 3.0


@pytest.mark.parametrize("method", ["dnlo", "dnl", "park", "taylor", "zhuang", "ali"])
def test_every_method_takes_it(method):
    parent, child = streams(scale=2.0, noise=0.0005)
    result = calibrate(parent, child, method=method, reference="B10", scale="estimate")
    assert result.scale == pytest.approx(2.0, rel=0.005)
    assert 0 < result.scale_sigma < 0.01
    np.testing.assert_allclose(result.T_parent_child, T_PARENT_CHILD, atol=0.02)


def test_auto_estimates_only_where_the_streams_call_for_it():
    same = calibrate(*streams(noise=0.002), reference="B10", scale="auto")
    assert (same.scale, same.scale_sigma) == (1.0, 0.0)
    other = calibrate(*streams(scale=0.9, noise=0.002), reference="B10", scale="auto")
    assert other.scale == pytest.approx(0.9, rel=0.01)
    assert any("multiplied by 0.9" in warning for warning in other.warnings)


def test_uncertainty_of_the_scale_enters_that_of_the_extrinsic():
    parent, child = streams(noise=0.005)
    estimated = calibrate(parent, child, reference="B10", scale="estimate")
    given = calibrate(parent, child, reference="B10", scale=estimated.scale)
    assert np.trace(estimated.covariance) > np.trace(given.covariance)


def test_a_scale_that_explains_nothing_is_refused():
    parent, _ = streams(seed=1)
    _, other = streams(seed=9)
    with pytest.raises(NotEnoughDataError, match="scale cannot be estimated: even with a scale"):
        calibrate(parent, other, reference="B10", scale="estimate")
    assert calibrate(parent, other, reference="B10", scale="auto").scale == 1.0
