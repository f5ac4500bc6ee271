"""Positions that are late against the orientations of their stream."""

import numpy as np
import pytest
from motions import child_of, disturbed, smooth_poses

from hand_eye_calib.adaptive import estimator
from hand_eye_calib.adaptive.part_delays import PartDelay, spread_by_delays

TIMES_S = np.arange(300) / 10
LATE_S = 0.03


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
    stamps_ns = np.round(TIMES_S * 1e9).astype(np.int64)
    return estimator.solve(stamps_ns, *noisy, is_clock_free=True, with_delays=True).delays


@pytest.mark.parametrize("late_stream", ["child", "parent"])
def test_late_positions_are_found(late_stream):
    found = delays(late_stream)[("child", "parent").index(late_stream)]
    assert found.seconds == pytest.approx(LATE_S, abs=0.2 * LATE_S)
    assert found.sigmas > 10.0


def test_without_any_they_are_noise():
    assert all(each.sigmas < 4.0 and each.sigma_s < 0.003 for each in delays())


def test_they_are_estimated_only_if_asked_for():
    stamps_ns = np.round(TIMES_S * 1e9).astype(np.int64)
    poses = smooth_poses(TIMES_S)
    assert estimator.solve(stamps_ns, poses, child_of(poses), quick=True).delays is None


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
