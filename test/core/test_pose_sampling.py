"""Faults of sampling and of dependence are named on every platform; sound streams have none."""

import numpy as np
import pytest

from hand_eye_calib.core.checks.check import check_streams
from hand_eye_calib.core.checks.sampling import check_sampling, step_velocities
from hand_eye_calib.core.checks.streams import check_stream
from hand_eye_calib.core.geometry.trajectory import Trajectory
from reproduction.part_faults import PLATFORMS
from reproduction.pose_faults import FAULTS, clean, computed, faulty

OF_ONE_STREAM = [
    fault for fault, (_, codes) in FAULTS.items() if "not_independent" not in codes
]


def codes_of(stream):
    return {finding.code for finding in check_stream(stream, "child")}


@pytest.mark.parametrize("platform", PLATFORMS)
@pytest.mark.parametrize("fault", OF_ONE_STREAM)
def test_a_fault_of_one_stream_is_named(fault, platform):
    streams = faulty(platform, fault, 7)
    assert codes_of(streams.child) & FAULTS[fault][1]


@pytest.mark.parametrize("platform", PLATFORMS)
def test_sound_streams_have_no_finding(platform):
    streams = clean(platform, 7)
    assert codes_of(streams.parent) == set()
    assert codes_of(streams.child) == set()


def test_whole_poses_that_were_interpolated_are_consistent():
    child = clean("hand", 7).child
    few = child[::10]
    stamps_ns = child.stamps_ns[: len(few) * 10 - 20]
    dense = Trajectory(stamps_ns, few.at(stamps_ns, straight=True))
    velocities = step_velocities(dense)
    codes = {finding.code for finding in check_sampling(dense, velocities, "child")}
    assert "interpolated" not in codes


@pytest.mark.parametrize("jump_m", [0.05, 0.5])
def test_jumps_at_random_are_no_corrections(jump_m):
    child = clean("hand", 7).child
    random = np.random.default_rng(3)
    poses = child.poses.copy()
    jumps_m = jump_m * random.standard_normal((len(poses), 3))
    jumps_m[random.random(len(poses)) > 0.1] = 0.0
    poses[:, :3, 3] += np.cumsum(jumps_m, axis=0)
    assert "propagated" not in codes_of(Trajectory(child.stamps_ns, poses))


@pytest.mark.parametrize("platform", ["drone", "drone_slam"])
def test_a_copy_with_noise_of_its_own_never_drifts(platform):
    sound = clean(platform, 7)
    copy = computed(0.003)(sound, np.random.default_rng(1))
    findings = [
        {
            finding.code
            for finding in check_streams(streams.parent, streams.child).findings
        }
        for streams in (sound, copy)
    ]
    assert findings == [set(), {"not_independent"}]
