"""Wrong arguments in Python: an error of the package names the argument and what to pass."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hand_eye_calib as hec

SAMPLES = hec.read_arm_samples("sample:arm.yaml")
LIDAR = hec.read_trajectory("sample:lidar.tum")
RESULT = hec.calibrate(LIDAR, hec.read_trajectory("sample:camera.tum"))


def with_last_row(number, row):
    """Return the poses of the lidar, of which one has another last row."""
    poses = LIDAR.poses.copy()
    poses[number, 3] = row
    return poses


def with_stamps_in(unit_ns):
    """Return the trajectory of the lidar with stamps in a unit of a number of nanoseconds."""
    return hec.Trajectory(LIDAR.stamps_ns // unit_ns, LIDAR.poses)


IN_PYTHON = {
    "no child": (
        lambda: hec.calibrate(LIDAR),
        "a child is missing: pass two trajectories",
    ),
    "no parent": (
        lambda: hec.calibrate(None, LIDAR),
        "the parent must be a trajectory",
    ),
    "positions as poses": (
        lambda: hec.Trajectory(LIDAR.stamps_ns, LIDAR.poses[:, :3, 3]),
        "for positions alone, use Trajectory.from_positions",
    ),
    "rows of poses": (
        lambda: hec.Trajectory(LIDAR.stamps_ns, np.ones((len(LIDAR), 7))),
        "Trajectory.from_quat_xyzw(stamps_ns, rows[:, :3], rows[:, 3:])",
    ),
    "transposed poses": (
        lambda: hec.Trajectory(LIDAR.stamps_ns, LIDAR.poses.transpose(0, 2, 1)),
        "1: the poses seem to be transposed; pass poses.transpose(0, 2, 1)",
    ),
    "another last row": (
        lambda: hec.Trajectory(LIDAR.stamps_ns, with_last_row(3, [0, 0, 1, 1])),
        "pose 3: the last row must be 0 0 0 1; found 0 0 1 1: is it a pose",
    ),
    "stamps in whole milliseconds": (
        lambda: hec.calibrate(with_stamps_in(10**6), LIDAR),
        "the parent has a pose every 100 ns, at stamps such as 17",
    ),
    "stamps in milliseconds beside a file": (
        lambda: hec.calibrate("sample:lidar.tum", with_stamps_in(10**6)),
        "they look like milliseconds; multiply them so that stamps_ns are",
    ),
    "stamps in seconds": (
        lambda: hec.Trajectory(LIDAR.stamps_ns / 1e9, LIDAR.poses),
        "multiply seconds by 1e9 and round them",
    ),
    "poses as positions": (
        lambda: hec.Trajectory.from_positions(LIDAR.stamps_ns, LIDAR.poses),
        "positions must be numbers of shape (N, 3); found shape (600, 4, 4)",
    ),
    "a file of samples": (
        lambda: hec.calibrate_arm("arm.yaml"),
        "samples = hec.read_arm_samples(path)",
    ),
    "a number as prior": (
        lambda: hec.CalibratorConfig(prior_z=1.85),
        "prior.z must be a text with its standard deviation, such as '1.85",
    ),
    "a prior in degrees": (
        lambda: hec.calibrate(LIDAR, LIDAR, prior={"yaw": (-62, 2)}),
        "write '-62deg+/-2deg', or convert both numbers with np.deg2rad",
    ),
    "a text as target": (
        lambda: hec.CalibratorConfig(target_translation="two"),
        "target.translation must be a number in m; got 'two'",
    ),
    "names as text": (
        lambda: hec.calibrate_arm(SAMPLES.robot, SAMPLES.tracking, names="abc"),
        "names must be of type Mapping; got str",
    ),
    "words as poses": (
        lambda: hec.robot_poses("abc", "kuka"),
        "rows must be numbers; got str",
    ),
    "a method with two letters swapped": (
        lambda: hec.CalibratorConfig(method="dnol"),
        "got 'dnol'; did you mean dnlo or dnl?",
    ),
    "an offset with its unit": (
        lambda: hec.CalibratorConfig(time_offset="-35 ms"),
        "time_offset must be estimate or a number in s; got '-35 ms'; write -0.035",
    ),
    "a misspelt robot": (
        lambda: hec.robot_poses([[0.0] * 6], "kuca"),
        "did you mean kuka?",
    ),
    "files as poses": (
        lambda: hec.calibrate_arm("hand.tum", "camera.tum"),
        "robot: expected poses, not a path; read_arm_samples",
    ),
    "a matrix as installed": (
        lambda: hec.compare([RESULT], installed=np.eye(3)),
        "installed must be an earlier result, such as hec.load(DIR); got ndarray",
    ),
    "a result without a list": (
        lambda: hec.compare(RESULT, RESULT),
        "got Calibration: pass a list of results",
    ),
    "paths as results": (
        lambda: hec.compare(["a", "b"]),
        "got str: read a saved result with hand_eye_calib.load",
    ),
    "a list as a rig": (
        lambda: hec.calibrate_rig(["a.tum", "b.tum", "c.tum"]),
        "pass {name: trajectory} of all sensors",
    ),
    "a bag without a topic": (
        lambda: hec.read_trajectory("sample:drive.mcap"),
        "is a bag: name the topic of the bag",
    ),
    "one result": (
        lambda: hec.compare([RESULT]),
        "to compare one result with the installed transform",
    ),
}


@pytest.mark.parametrize("name", IN_PYTHON)
def test_a_wrong_argument_in_python_is_answered_in_one_line(name):
    call, message = IN_PYTHON[name]
    with pytest.raises(hec.HandEyeCalibError) as caught:
        call()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_misspelt_attribute_of_a_result_has_the_near_name():
    with pytest.raises(AttributeError, match="did you mean sigmas"):
        _ = RESULT.sigma


def test_a_result_with_exchanged_frames_is_compared_as_its_inverse():
    for comparison in (
        hec.compare([RESULT, RESULT.inverse()]),
        hec.compare([RESULT], installed=RESULT.inverse()),
    ):
        assert comparison.verdict == "same"
        for row in comparison.differences[0].axes.values():
            assert_allclose(row.difference, 0.0, atol=1e-9)
    moved = dataclasses.replace(RESULT.inverse(), T_parent_child=np.eye(4))
    assert hec.compare([RESULT, moved]).verdict == "moved"
