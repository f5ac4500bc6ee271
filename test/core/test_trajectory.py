from dataclasses import replace

import numpy as np
import pytest
from motions import as_trajectory, wandering_poses
from numpy.testing import assert_allclose, assert_array_equal

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.interpolation import REACH
from hand_eye_calib.core.geometry.trajectory import Trajectory

STAMPS = np.array([0, 10, 20], dtype=np.int64)
POSES = wandering_poses(3)


def test_poses_at_their_own_stamps_come_back_bit_by_bit():
    trajectory = as_trajectory(wandering_poses(50))
    poses = trajectory.at(trajectory.stamps_ns)
    assert_array_equal(poses, trajectory.poses)


def test_straight_interpolation_lies_on_the_geodesic():
    trajectory = Trajectory(STAMPS, POSES)
    increment = se3.inverse(POSES[1]) @ POSES[2]
    half = se3.exp(0.5 * se3.log(increment))

    (interpolated,) = trajectory.at(np.array([15]), straight=True)

    assert_allclose(interpolated, POSES[1] @ half, atol=1e-14)


def test_extrapolation_is_refused_unless_asked_for():
    trajectory = Trajectory(STAMPS, POSES)
    increment = se3.inverse(POSES[1]) @ POSES[2]
    twice = se3.exp(2 * se3.log(increment))

    with pytest.raises(InputError, match="1 of 2 stamps lie outside"):
        trajectory.at(np.array([5, 30]))
    (beyond,) = trajectory.at(np.array([30]), extrapolate=True)

    assert_allclose(beyond, POSES[1] @ twice, atol=1e-14)


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
    assert shifted.sensor_frame == "lidar"
    assert scaled.world_frame == "odom"
    expected = POSES.copy()
    expected[:, :3, 3] *= 2.0
    assert_array_equal(scaled.poses, expected)


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
    angles = 2 * np.pi * hz * times_s
    phases = angles[:, None] + np.arange(6)
    return se3.exp(0.05 * np.sin(phases))


def errors(trajectory, truth, stamps_ns, straight):
    interpolated = trajectory.at(stamps_ns, straight=straight)
    difference = se3.inverse(truth) @ interpolated
    twists = se3.log(difference)
    return np.linalg.norm(twists, axis=1)


def at_rest(noise, seed=0):
    random = np.random.default_rng(seed)
    twists = noise * random.standard_normal((3000, 6))
    return as_trajectory(se3.exp(twists), HZ)


def middles(trajectory):
    starts_ns = trajectory.stamps_ns[:-1]
    ends_ns = trajectory.stamps_ns[1:]
    return (starts_ns + ends_ns) // 2


@pytest.mark.parametrize(
    ("hz", "share"), [(0.5, 0.05), (1.0, 0.15), (2.0, 0.4)]
)
def test_a_shake_is_cut_far_less_than_by_a_constant_twist(hz, share):
    trajectory_s = np.arange(200) / HZ
    trajectory = as_trajectory(shaking(hz, trajectory_s), HZ)
    stamps_ns = middles(trajectory)[REACH:-REACH]
    times_s = (stamps_ns - trajectory.stamps_ns[0]) * 1e-9
    truth = shaking(hz, times_s)

    bent = errors(trajectory, truth, stamps_ns, straight=False)
    straight = errors(trajectory, truth, stamps_ns, straight=True)

    assert bent.mean() < share * straight.mean()


def test_of_white_noise_little_more_is_left_than_by_a_constant_twist():
    trajectory = at_rest(1e-3)
    stamps_ns = middles(trajectory)[REACH:-REACH]
    truth = np.broadcast_to(np.eye(4), (len(stamps_ns), 4, 4))

    def rms(is_straight):
        lengths = errors(trajectory, truth, stamps_ns, is_straight)
        return np.sqrt(np.mean(lengths**2))

    bent = rms(is_straight=False)
    straight = rms(is_straight=True)

    assert straight < bent < 1.05 * straight


def test_a_jump_hardly_reaches_the_intervals_beside_it():
    poses = np.broadcast_to(np.eye(4), (60, 4, 4)).copy()
    poses[30:, 0, 3] = 1.0
    trajectory = as_trajectory(poses, HZ)

    interpolated = trajectory.at(middles(trajectory))

    away = np.r_[:29, 30:59]
    x = interpolated[away, 0, 3]
    from_either_side = np.abs(x - np.round(x))
    assert from_either_side.max() < 1.0 / 16.0


def test_only_poses_within_reach_count_to_the_bit():
    trajectory = as_trajectory(wandering_poses(80), HZ)
    stamps_ns = trajectory.stamps_ns[39:41] + 30_000_000
    within_reach = trajectory[40 - REACH : 41 + REACH]

    of_all = trajectory.at(stamps_ns)
    of_near = within_reach.at(stamps_ns)

    assert_array_equal(of_near, of_all)
