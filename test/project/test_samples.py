"""The recordings that come with the package."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hand_eye_calib as hec
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.formats.files import local_path
from reproduction.samples import (
    CAMERA_IN_GRIPPER,
    sample_robot,
    se3_of,
    write_sample_arm,
    write_sample_arm_files,
    write_sample_robot,
)


def test_the_bag_has_the_poses_of_the_files():
    for sensor in ("lidar", "camera"):
        in_file = hec.read_trajectory(f"sample:{sensor}.tum")
        in_bag = hec.read_trajectory(
            "sample:drive.mcap", topic=f"/{sensor}/odometry"
        )
        assert_array_equal(in_bag.stamps_ns, in_file.stamps_ns)
        assert_allclose(in_bag.poses, in_file.poses, atol=1e-12)
        assert in_bag.sensor_frame == sensor


def test_the_drive_is_calibrated_within_its_standard_deviations():
    result = hec.calibrate(
        hec.read_trajectory("sample:lidar.tum"),
        hec.read_trajectory("sample:camera.tum"),
    )
    (truth,) = hec.read_trajectory("sample:truth.tum").poses
    assert result.verdict is hec.Verdict.USE
    assert (
        np.abs(deviation(result.T_parent_child, truth)) < 3.0 * result.sigmas
    ).all()
    # The recording has outlier poses 42 cm off. Motions to and from them are no inliers.
    residuals = result.residuals()
    assert residuals.translation_m.max() > 0.4
    assert residuals.translation_m[residuals.is_inlier].max() < 0.02


def test_the_arm_is_calibrated_within_its_standard_deviations():
    samples = hec.read_arm_samples("sample:arm.yaml")
    result = hec.calibrate_arm(
        samples.robot, samples.tracking, names=samples.frames
    )
    truth = se3_of(CAMERA_IN_GRIPPER)
    assert result.verdict is hec.Verdict.USE
    assert (result.parent_frame, result.child_frame) == ("gripper", "camera")
    assert (
        np.abs(deviation(result.T_parent_child, truth)) < 3.0 * result.sigmas
    ).all()


def test_the_arm_is_made_by_its_script(tmp_path):
    write_sample_arm(tmp_path / "arm.yaml")
    made = hec.read_arm_samples(tmp_path / "arm.yaml")
    kept = hec.read_arm_samples("sample:arm.yaml")
    assert_allclose(
        se3.log(se3.inverse(made.robot) @ kept.robot), 0.0, atol=1e-5
    )
    assert_allclose(
        se3.log(se3.inverse(made.tracking) @ kept.tracking), 0.0, atol=1e-5
    )


def test_two_files_of_the_arm_have_the_stops_of_its_samples(tmp_path):
    write_sample_arm(tmp_path / "arm.yaml")
    write_sample_arm_files(tmp_path)
    for name in ("hand.tum", "camera_in_target.tum"):
        made, kept = (
            np.loadtxt(path)
            for path in (tmp_path / name, local_path(f"sample:{name}"))
        )
        assert_allclose(made, kept, atol=2e-6)
    samples = hec.read_arm_samples("sample:arm.yaml")
    hand = hec.read_trajectory("sample:hand.tum")
    assert_allclose(hand.poses, samples.robot, atol=3e-6)


def test_the_robot_is_calibrated_within_its_standard_deviations():
    truth = sample_robot()
    with pytest.warns(UserWarning, match="by its columns"):
        result = hec.calibrate_vehicle(
            "sample:robot_lidar.tum", "sample:robot_wheels.csv"
        )
    assert result.verdict is hec.Verdict.USE
    errors = deviation(result.T_parent_child, truth.T_base_sensor)
    assert (
        np.abs(errors)[[0, 1, 3, 4, 5]] < 3.0 * result.sigmas[[0, 1, 3, 4, 5]]
    ).all()
    for parameter, value in zip(
        result.wheels.parameters, truth.parameters, strict=True
    ):
        assert abs(parameter.value - value) < 3.0 * parameter.sigma


def test_the_robot_is_made_by_its_script(tmp_path):
    write_sample_robot(tmp_path)
    for name, separator, n_names in (
        ("robot_lidar.tum", " ", 0),
        ("robot_wheels.csv", ",", 1),
    ):
        made, kept = (
            np.loadtxt(path, delimiter=separator, skiprows=n_names)
            for path in (tmp_path / name, local_path(f"sample:{name}"))
        )
        assert_allclose(made, kept, atol=2e-4)
