"""Positions that are late against the orientations of their stream, and a world that moves."""

import numpy as np
import pytest
from motions import child_of, disturbed, smooth_poses

from hand_eye_calib.geometry import se3
from hand_eye_calib.gls import estimator

TIMES_S = np.arange(300) / 10
LATE_S = 0.03


STAMPS_NS = np.round(TIMES_S * 1e9).astype(np.int64)


def delays(late_stream=None):
    """Of the child's and of the parent's positions, if those of a stream are late."""
    poses = smooth_poses(TIMES_S)
    before = smooth_poses(TIMES_S - LATE_S)
    streams = {"parent": poses, "child": child_of(poses)}
    if late_stream:
        late = {"parent": before, "child": child_of(before)}[late_stream]
        streams[late_stream] = streams[late_stream].copy()
        streams[late_stream][:, :3, 3] = late[:, :3, 3]
    noisy = (disturbed(each, seed, 0.001, 0.001) for seed, each in enumerate(streams.values()))
    return estimator.solve(STAMPS_NS, *noisy, is_clock_free=True, with_extras=True).extras.delays


def solution(child_of_times, twist=(0.0,) * 6, systematic=("none",)):
    """Of a child at these times in a world with this twist."""
    child = se3.exp(np.outer(TIMES_S, twist)) @ child_of(smooth_poses(child_of_times))
    noisy = disturbed(smooth_poses(TIMES_S), 0, 0.001, 0.001), disturbed(child, 1, 0.001, 0.001)
    return estimator.solve(STAMPS_NS, *noisy, systematic=systematic, with_extras=True)


@pytest.mark.parametrize("late_stream", ["child", "parent"])
def test_late_positions_are_found(late_stream):
    found = delays(late_stream)[("child", "parent").index(late_stream)]
    assert found.seconds == pytest.approx(LATE_S, abs=0.2 * LATE_S)
    assert found.sigmas > 10.0


def test_without_any_they_are_noise():
    assert all(each.sigmas < 4.0 and each.sigma_s < 0.003 for each in delays())


def test_they_are_estimated_only_if_asked_for():
    poses = smooth_poses(TIMES_S)
    found = estimator.solve(STAMPS_NS, poses, child_of(poses), quick=True)
    assert found.extras is None


def test_a_world_that_moves_is_found_with_its_twist():
    twist = np.r_[0.01, -0.02, 0.005, np.radians([0.1, -0.05, 0.2])]
    found = solution(TIMES_S, twist).extras.world_drift
    assert found.is_significant
    np.testing.assert_allclose(found.twist, twist, atol=5e-4)
    assert found.speed_at(np.zeros((5, 3))) == pytest.approx(np.linalg.norm(twist[:3]), abs=1e-3)
    assert not solution(TIMES_S).extras.world_drift.is_significant
