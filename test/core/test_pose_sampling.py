"""Faults of sampling and of dependence are named on every platform; sound streams have none."""

import numpy as np
import pytest
from findings import codes_of

from hand_eye_calib.core.checks.check import check_streams
from hand_eye_calib.core.checks.findings import Severity
from hand_eye_calib.core.checks.sampling import check_sampling, step_velocities
from hand_eye_calib.core.checks.streams import check_stream
from hand_eye_calib.core.geometry.trajectory import Trajectory
from reproduction.platforms import PLATFORMS
from reproduction.pose_faults import FAULTS, clean, computed, faulty

OF_ONE_STREAM = [
    fault
    for fault, (_, codes) in FAULTS.items()
    if "not_independent" not in codes
]


def codes_of_stream(stream):
    findings = check_stream(stream, "child")
    return set(codes_of(findings))


@pytest.mark.parametrize("platform", PLATFORMS)
@pytest.mark.parametrize("fault", OF_ONE_STREAM)
def test_a_fault_of_one_stream_is_named(fault, platform):
    _, expected_codes = FAULTS[fault]
    streams = faulty(platform, fault, 7)
    assert codes_of_stream(streams.child) & expected_codes


@pytest.mark.parametrize("platform", PLATFORMS)
def test_sound_streams_have_no_finding(platform):
    streams = clean(platform, 7)
    assert codes_of_stream(streams.parent) == set()
    assert codes_of_stream(streams.child) == set()


def test_whole_poses_that_were_interpolated_are_consistent():
    child = clean("hand", 7).child
    few = child[::10]
    n_dense = len(few) * 10 - 20
    stamps_ns = child.stamps_ns[:n_dense]
    dense = Trajectory(stamps_ns, few.at(stamps_ns, straight=True))
    velocities = step_velocities(dense)

    findings = check_sampling(dense, velocities, "child")

    assert "interpolated" not in codes_of(findings)


@pytest.mark.parametrize("jump_m", [0.05, 0.5])
def test_jumps_at_random_are_no_corrections(jump_m):
    child = clean("hand", 7).child
    random = np.random.default_rng(3)
    n_poses = len(child)
    jumps_m = jump_m * random.standard_normal((n_poses, 3))
    is_steady = random.random(n_poses) > 0.1
    jumps_m[is_steady] = 0.0
    poses = child.poses.copy()
    poses[:, :3, 3] += np.cumsum(jumps_m, axis=0)
    jumping = Trajectory(child.stamps_ns, poses)
    assert "propagated" not in codes_of_stream(jumping)


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


@pytest.mark.parametrize("seed", [640502, 640503])
def test_a_correction_through_a_wrong_mount_is_an_error_on_flat_ground(seed):
    # Odometry of wheels hides two thirds of the squared differences.
    streams = faulty("agv", "corrected by the parent, 0.3 s", seed)
    (finding,) = check_streams(streams.parent, streams.child).findings
    assert (finding.code, finding.severity) == (
        "not_independent",
        Severity.ERROR,
    )
