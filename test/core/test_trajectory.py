from dataclasses import replace

import numpy as np
import pytest
from motions import as_trajectory, wandering_poses
from numpy.testing import assert_allclose, assert_array_equal

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import REACH, Trajectory

STAMPS = np.array([0, 10, 20], dtype=np.int64)
POSES = wandering_poses(3)


def test_poses_at_their_own_stamps_come_back_bit_by_bit():
    trajectory = as_trajectory(wandering_poses(50))
    assert np.array_equal(trajectory.at(trajectory.stamps_ns), trajectory.poses)


def test_straight_interpolation_lies_on_the_geodesic():
    trajectory = Trajectory(STAMPS, POSES)
    quarter = trajectory.at(np.array([15]), straight=True)[0]
    expected = POSES[1] @ se3.exp(0.5 * se3.log(se3.inverse(POSES[1]) @ POSES[2]))
    assert_allclose(quarter, expected, atol=1e-14)


def test_extrapolation_is_refused_unless_asked_for():
    trajectory = Trajectory(STAMPS, POSES)
    with pytest.raises(InputError, match="1 of 2 stamps lie outside"):
        trajectory.at(np.array([5, 30]))
    beyond = trajectory.at(np.array([30]), extrapolate=True)[0]
    step = se3.log(se3.inverse(POSES[1]) @ POSES[2])
    assert_allclose(beyond, POSES[1] @ se3.exp(2 * step), atol=1e-14)


# One coordinate of the last pose.
FAR = np.zeros((3, 4, 4))
FAR[2, 2, 3] = 1.0


@pytest.mark.parametrize(
    ("stamps", "poses", "message"),
    [
        (STAMPS.astype(float), POSES, "one-dimensional integers"),
        (STAMPS, POSES[:2], r"shape \(3, 4, 4\)"),
        (np.array([0, 10, 10]), POSES, "pose 2 has stamp 10 ns after 10 ns"),
        (
            STAMPS,
            np.where(np.arange(3)[:, None, None] == 1, np.nan, POSES),
            "pose 1 has a value that is not finite",
        ),
        (
            STAMPS,
            POSES * np.array([1, 1, 2])[:, None, None],
            "pose 2 is not a rigid transform",
        ),
        (
            STAMPS,
            POSES @ np.diag([1.0, 1.0, -1.0, 1.0]),
            "pose 0 is not a rigid transform",
        ),
        (
            STAMPS,
            POSES + 1e154 * FAR,
            r"pose 2: position \(.*1e\+154\) is more than 1e\+10 m",
        ),
    ],
)
def test_unusable_input_names_the_first_offender(stamps, poses, message):
    with pytest.raises(InputError, match=message):
        Trajectory(stamps, poses)


def test_shift_and_scale_keep_everything_else():
    trajectory = Trajectory(STAMPS, POSES, "lidar", "odom")
    shifted = trajectory.shifted(-0.000000003)
    scaled = trajectory.scaled(2.0)
    assert shifted.stamps_ns.tolist() == [-3, 7, 17]
    assert (shifted.sensor_frame, scaled.world_frame) == ("lidar", "odom")
    assert_array_equal(scaled.poses[:, :3, :3], POSES[:, :3, :3])
    assert_array_equal(scaled.poses[:, :3, 3], 2 * POSES[:, :3, 3])


def test_equal_trajectories_have_the_same_poses_stamps_and_frames():
    trajectory, other = (
        Trajectory(STAMPS, poses, "lidar") for poses in (POSES, POSES.copy())
    )
    assert trajectory == other
    changed = (
        other.shifted(1.0),
        other.scaled(2.0),
        other[:2],
        replace(other, sensor_frame=""),
    )
    assert trajectory not in [*changed, "lidar"]


HZ = 10


def shaking(hz, times_s):
    """Return poses that vibrate along and about all axes."""
    phases = 2 * np.pi * hz * times_s[:, None] + np.arange(6)
    return se3.exp(0.05 * np.sin(phases))


def errors(trajectory, truth, stamps_ns, straight):
    interpolated = trajectory.at(stamps_ns, straight=straight)
    return np.linalg.norm(se3.log(se3.inverse(truth) @ interpolated), axis=1)


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
    bent, straight = (
        errors(trajectory, truth, stamps_ns, way) for way in (False, True)
    )
    assert bent.mean() < share * straight.mean()


def test_of_white_noise_little_more_is_left_than_by_a_constant_twist():
    trajectory = at_rest(1e-3)
    stamps_ns = middles(trajectory)[REACH:-REACH]
    truth = np.broadcast_to(np.eye(4), (len(stamps_ns), 4, 4))
    bent, straight = (
        np.sqrt((errors(trajectory, truth, stamps_ns, is_straight) ** 2).mean())
        for is_straight in (False, True)
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
