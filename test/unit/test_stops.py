"""Calibrations from stops: which way round, frames, verdicts, files."""

import json

import numpy as np
import pytest
from real_data import data_folder

import hand_eye_calib as hec
from hand_eye_calib.cli.main import main
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.stops import calibrate_arm, calibrate_stops
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.stops import read_arm_samples

NOISE = np.repeat([0.0005, 0.001], 3)


@pytest.fixture
def random():
    return np.random.default_rng(0)


def arm(random, n=25, is_in_hand=True, turn_rad=(0.5, 0.5, 0.5)):
    """Poses of the hand in the base, of the target in the camera, and where the camera is."""
    X, Z = se3.exp(random.normal(size=(2, 6)) * np.repeat([0.1, 1.0], 3))
    robot = se3.exp(random.normal(size=(n, 6)) * [0.3, 0.3, 0.3, *turn_rad])
    moving = robot if is_in_hand else se3.inverse(robot)
    tracking = se3.inverse(moving @ X) @ Z @ se3.exp(random.normal(size=(n, 6)) * NOISE)
    return robot, tracking, X, Z


@pytest.mark.parametrize("is_in_hand", [True, False])
def test_a_camera_in_the_hand_and_one_beside_the_robot_are_told_apart(random, is_in_hand):
    robot, tracking, X, Z = arm(random, is_in_hand=is_in_hand)
    result = calibrate_arm(robot, tracking, names={"camera": "eye"})
    frames = ("hand", "base") if is_in_hand else ("base", "hand")
    assert (result.parent_frame, result.parent_world_frame) == frames
    assert (result.child_frame, result.child_world_frame) == ("eye", "target")
    for estimate, truth in ((result.T_parent_child, X), (result.T_world_world, Z)):
        assert np.abs(se3.log(se3.inverse(estimate) @ truth)).max() < 5e-3
    assert result.verdict is hec.Verdict.USE


def test_the_result_comes_back_from_its_document(random):
    robot, tracking, _, _ = arm(random)
    result = calibrate_arm(robot, tracking)
    read = hec.Calibration.from_dict(result.to_dict())
    assert read.to_dict() == result.to_dict()
    np.testing.assert_array_equal(read.T_world_world, result.T_world_world)


def test_a_scara_is_told_what_is_unknown(random):
    robot, tracking, X, _ = arm(random, turn_rad=(0.0, 0.0, 1.0))
    result = calibrate_arm(robot, tracking)
    assert result.unobservable() == ["z"]
    assert result.verdict is hec.Verdict.USE_WITH_CARE
    known = calibrate_arm(robot, tracking, CalibratorConfig(prior_z=f"{X[2, 3]}+/-0.002"))
    assert not known.unobservable()


def test_inverse_poses_are_named(random):
    robot, tracking, _, _ = arm(random)
    result = calibrate_stops(robot, tracking)
    assert [found.code for found in result.findings] == ["inverse"]
    assert result.verdict is hec.Verdict.DO_NOT_USE
    assert not calibrate_stops(robot, se3.inverse(tracking)).findings


def test_priors_on_wrong_axes_contradict(random):
    robot, tracking, X, _ = arm(random)
    config = CalibratorConfig(prior_x=f"{X[0, 3] + 1.0}+/-0.001")
    assert calibrate_arm(robot, tracking, config).status is hec.SolveStatus.CONTRADICTED


@pytest.mark.parametrize(
    ("file", "parent", "position", "within_m"),
    [
        ("moveit_samples/pose_samples.json", "base", (0.659, -0.249, 0.830), 0.002),
        ("camodocal_example/TransformPairsInput.yml", "base", None, 0.0),
    ],
)
def test_samples_of_others(file, parent, position, within_m):
    folder = data_folder() / "independent"
    samples = read_arm_samples(folder / file)
    result = calibrate_arm(samples.robot, samples.tracking)
    assert result.parent_frame == parent
    assert not result.findings
    assert result.verdict is not hec.Verdict.DO_NOT_USE
    if position:
        np.testing.assert_allclose(result.T_parent_child[:3, 3], position, atol=within_m)


class TestCommand:
    def test_samples_are_the_only_path(self, random, tmp_path, capsys):
        robot, tracking, X, _ = arm(random)
        pairs = [[a.tolist(), b.tolist()] for a, b in zip(robot, tracking, strict=True)]
        (tmp_path / "samples.json").write_text(json.dumps(pairs))
        out = tmp_path / "out"
        assert main(["calibrate", str(tmp_path / "samples.json"), "--out", str(out)]) == 0
        assert "camera in hand: maps coordinates" in (told := capsys.readouterr().out)
        assert "target in base" in told
        np.testing.assert_allclose(hec.load(out).T_parent_child, X, atol=5e-3)

    def test_two_files_without_an_order(self, random, tmp_path, capsys):
        robot, tracking, X, _ = arm(random)
        for name, poses in (("hand", robot), ("eye", se3.inverse(tracking))):
            stamps_ns = np.arange(len(poses)) * 10**9
            hec.write_trajectory(tmp_path / f"{name}.tum", hec.Trajectory(stamps_ns, poses))
        files = [str(tmp_path / "hand.tum"), str(tmp_path / "eye.tum")]
        assert main(["calibrate", *files, "--order", "none", "--json"]) == 0
        document = json.loads(capsys.readouterr().out)
        assert document["reference"] == "stops"
        np.testing.assert_allclose(document["T_parent_child"]["matrix"], X, atol=5e-3)
        assert main(["calibrate", files[0], "--order", "none"]) == 1
        assert "expected samples of an arm" in capsys.readouterr().err
