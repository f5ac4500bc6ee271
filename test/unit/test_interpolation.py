"""Poses between those of a trajectory."""

import numpy as np
import pytest
from motions import as_trajectory, wandering_poses

from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import REACH

HZ = 10


def shaking(hz, times_s):
    """Poses that shake about all axes and along them."""
    phases = 2 * np.pi * hz * times_s[:, None] + np.arange(6)
    return se3.exp(0.05 * np.sin(phases))


def errors(trajectory, truth, stamps_ns, straight):
    found = trajectory.at(stamps_ns, straight=straight)
    return np.linalg.norm(se3.log(se3.inverse(truth) @ found), axis=1)


def at_rest(noise, seed=0):
    poses = se3.exp(noise * np.random.default_rng(seed).standard_normal((3000, 6)))
    return as_trajectory(poses, HZ)


def middles(trajectory):
    return (trajectory.stamps_ns[:-1] + trajectory.stamps_ns[1:]) // 2


@pytest.mark.parametrize(("hz", "share"), [(0.5, 0.05), (1.0, 0.15), (2.0, 0.4)])
def test_a_shake_is_cut_far_less_than_by_a_constant_twist(hz, share):
    trajectory = as_trajectory(shaking(hz, np.arange(200) / HZ), HZ)
    stamps_ns = middles(trajectory)[REACH:-REACH]
    truth = shaking(hz, (stamps_ns - trajectory.stamps_ns[0]) * 1e-9)
    bent, straight = (errors(trajectory, truth, stamps_ns, each) for each in (False, True))
    assert bent.mean() < share * straight.mean()


def test_of_white_noise_little_more_is_left_than_by_a_constant_twist():
    trajectory = at_rest(1e-3)
    stamps_ns = middles(trajectory)[REACH:-REACH]
    truth = np.broadcast_to(np.eye(4), (len(stamps_ns), 4, 4))
    bent, straight = (
        np.sqrt((errors(trajectory, truth, stamps_ns, each) ** 2).mean()) for each in (False, True)
    )
    assert straight < bent < 1.05 * straight


def test_a_jump_hardly_reaches_the_intervals_beside_it():
    poses = np.broadcast_to(np.eye(4), (60, 4, 4)).copy()
    poses[30:, 0, 3] = 1.0
    trajectory = as_trajectory(poses, HZ)
    away = np.r_[:29, 30:59]
    off = trajectory.at(middles(trajectory))[:, 0, 3]
    assert np.abs(off[away] - np.round(off[away])).max() < 1.0 / 16.0


def test_only_poses_within_reach_count_to_the_bit():
    trajectory = as_trajectory(wandering_poses(80), HZ)
    stamps_ns = trajectory.stamps_ns[39:41] + 30_000_000
    near = trajectory[40 - REACH : 41 + REACH]
    assert np.array_equal(near.at(stamps_ns), trajectory.at(stamps_ns))
