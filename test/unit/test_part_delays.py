"""Positions that are late against the orientations of their stream, a clock that is not in the
model, and a world that moves.
"""

import numpy as np
import pytest
from motions import child_of, disturbed, smooth_poses

from hand_eye_calib.geometry import se3
from hand_eye_calib.gls import estimator
from hand_eye_calib.gls.part_delays import PartDelay, spread_by_delays

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
    return estimator.solve(STAMPS_NS, *noisy, is_clock_free=True, with_delays=True).delays


def solution(child_of_times, twist=(0.0,) * 6, systematic=("none",)):
    """Of a child at these times in a world with this twist."""
    child = se3.exp(np.outer(TIMES_S, twist)) @ child_of(smooth_poses(child_of_times))
    noisy = disturbed(smooth_poses(TIMES_S), 0, 0.001, 0.001), disturbed(child, 1, 0.001, 0.001)
    return estimator.solve(STAMPS_NS, *noisy, systematic=systematic, with_delays=True)


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
    assert (found.delays, found.clock, found.world_drift) == (None, None, None)


def test_a_clock_offset_that_is_not_in_the_model_is_told_and_counts():
    late = solution(TIMES_S - 0.01)
    assert late.time_offset_s == 0.0
    assert late.clock.seconds == pytest.approx(0.01, abs=0.001)
    spread = spread_by_delays((), 0.0, late.clock)
    shift = late.clock.seconds * late.clock.sensitivity
    np.testing.assert_allclose(spread, np.outer(shift, shift))
    in_model = solution(TIMES_S - 0.01, systematic=("time",))
    off = se3.log(se3.inverse(in_model.T_parent_child) @ late.T_parent_child)
    np.testing.assert_allclose(off[:3], shift[:3], atol=0.1 * np.linalg.norm(shift[:3]) + 2e-4)
    assert in_model.clock is None


def test_a_clock_offset_that_is_noise_does_not_count():
    clock = PartDelay(0.0028, 0.001, np.ones(6))
    assert not spread_by_delays((), 0.0, clock).any()


def test_a_world_that_moves_is_found_with_its_twist():
    twist = np.r_[0.01, -0.02, 0.005, np.radians([0.1, -0.05, 0.2])]
    found = solution(TIMES_S, twist).world_drift
    assert found.is_significant
    np.testing.assert_allclose(found.twist, twist, atol=5e-4)
    assert found.speed_at(np.zeros((5, 3))) == pytest.approx(np.linalg.norm(twist[:3]), abs=1e-3)
    assert not solution(TIMES_S).world_drift.is_significant


def test_what_the_motion_does_not_exclude_counts_up_to_the_clock_offset():
    along_x = np.array([1.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    unlikely, likely = PartDelay(0.001, 0.004, along_x), PartDelay(0.02, 0.004, along_x)
    unknown = PartDelay(0.0, np.inf, along_x)

    def sigma_x(delay, offset_s):
        spread = spread_by_delays((delay,), offset_s)
        assert not spread[1:].any()
        return np.sqrt(spread[0, 0])

    assert sigma_x(unlikely, 0.0) == 0.0
    assert sigma_x(unlikely, 0.05) == pytest.approx(1.5 * 0.004)
    assert sigma_x(unlikely, -0.002) == pytest.approx(1.5 * 0.002)
    assert sigma_x(unknown, 0.05) == pytest.approx(1.5 * 0.05)
    assert sigma_x(likely, 0.0) == pytest.approx(1.5 * 0.02)
    assert not spread_by_delays((), 0.1).any()
