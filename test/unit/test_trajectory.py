import numpy as np
import pytest
from motions import as_trajectory, wandering_poses

from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory

STAMPS = np.array([0, 10, 20], dtype=np.int64)
POSES = wandering_poses(3)


def test_poses_at_their_own_stamps_come_back_bit_by_bit():
    trajectory = as_trajectory(wandering_poses(50))
    assert np.array_equal(trajectory.at(trajectory.stamps_ns), trajectory.poses)


def test_straight_interpolation_lies_on_the_geodesic():
    trajectory = Trajectory(STAMPS, POSES)
    quarter = trajectory.at(np.array([15]), straight=True)[0]
    expected = POSES[1] @ se3.exp(0.5 * se3.log(se3.inverse(POSES[1]) @ POSES[2]))
    np.testing.assert_allclose(quarter, expected, atol=1e-14)


def test_extrapolation_is_refused_unless_asked_for():
    trajectory = Trajectory(STAMPS, POSES)
    with pytest.raises(InputError, match="1 of 2 stamps lie outside"):
        trajectory.at(np.array([5, 30]))
    beyond = trajectory.at(np.array([30]), extrapolate=True)[0]
    step = se3.log(se3.inverse(POSES[1]) @ POSES[2])
    np.testing.assert_allclose(beyond, POSES[1] @ se3.exp(2 * step), atol=1e-14)


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
        (STAMPS, POSES * np.array([1, 1, 2])[:, None, None], "pose 2 is not a rigid transform"),
        (STAMPS, POSES @ np.diag([1.0, 1.0, -1.0, 1.0]), "pose 0 is not a rigid transform"),
        (STAMPS, POSES + 1e154 * FAR, r"pose 2: position \(.*1e\+154\) is more than 1e\+08 m"),
    ],
)
def test_unusable_input_names_the_first_offender(stamps, poses, message):
    with pytest.raises(InputError, match=message):
        Trajectory(stamps, poses)


def test_shift_and_scale_keep_everything_else():
    trajectory = Trajectory(STAMPS, POSES, "lidar", "odom")
    shifted, scaled = trajectory.shifted(-0.000000003), trajectory.scaled(2.0)
    assert shifted.stamps_ns.tolist() == [-3, 7, 17]
    assert (shifted.sensor_frame, scaled.world_frame) == ("lidar", "odom")
    np.testing.assert_array_equal(scaled.poses[:, :3, :3], POSES[:, :3, :3])
    np.testing.assert_array_equal(scaled.poses[:, :3, 3], 2 * POSES[:, :3, 3])
