"""Calibrations from stops: which way round, frames, verdicts, files."""

import json

import numpy as np
import pytest
from findings import codes_of
from numpy.testing import assert_allclose, assert_array_equal
from real_data import data_folder

import hand_eye_calib as hec
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.checks.findings import Severity
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.calibrate import calibrate_arm, calibrate_stops
from hand_eye_calib.extras.stops.samples import read_arm_samples
from hand_eye_calib.offline.cli.main import main

NOISE = np.repeat([0.0005, 0.001], 3)


@pytest.fixture
def random():
    return np.random.default_rng(0)


def arm(random, n=25, is_in_hand=True, turn_rad=(0.5, 0.5, 0.5)):
    """Poses of the hand in the base, of the target in the camera, and where the camera is."""
    mount_sigmas = np.repeat([0.1, 1.0], 3)
    X, Z = se3.exp(random.normal(size=(2, 6)) * mount_sigmas)
    robot_sigmas = [0.3, 0.3, 0.3, *turn_rad]
    robot = se3.exp(random.normal(size=(n, 6)) * robot_sigmas)
    moving = robot if is_in_hand else se3.inverse(robot)
    noise = se3.exp(random.normal(size=(n, 6)) * NOISE)
    tracking = se3.inverse(moving @ X) @ Z @ noise
    return robot, tracking, X, Z


@pytest.mark.parametrize("is_in_hand", [True, False])
def test_a_camera_in_the_hand_and_one_beside_the_robot_are_told_apart_and_kept(
    random, is_in_hand
):
    robot, tracking, X, Z = arm(random, is_in_hand=is_in_hand)
    result = calibrate_arm(robot, tracking, names={"camera": "eye"})
    frames = ("hand", "base") if is_in_hand else ("base", "hand")
    assert (result.parent_frame, result.parent_world_frame) == frames
    assert (result.child_frame, result.child_world_frame) == ("eye", "target")
    for estimate, truth in (
        (result.T_parent_child, X),
        (result.T_world_world, Z),
    ):
        assert np.abs(se3.log(se3.inverse(estimate) @ truth)).max() < 5e-3
    assert result.verdict is hec.Verdict.USE
    read = hec.Calibration.from_dict(result.to_dict())
    assert read.to_dict() == result.to_dict()
    assert_array_equal(read.T_world_world, result.T_world_world)


def test_a_scara_is_told_what_is_unknown(random):
    robot, tracking, X, _ = arm(random, turn_rad=(0.0, 0.0, 1.0))
    result = calibrate_arm(robot, tracking)
    assert result.unobservable() == ["z"]
    assert result.headline.startswith(
        "DO NOT USE: z cannot be determined from these stops"
    )
    with_prior = calibrate_arm(
        robot, tracking, CalibratorConfig(prior_z=f"{X[2, 3]}+/-0.002")
    )
    assert with_prior.verdict is hec.Verdict.USE


def test_inverse_poses_are_named(random):
    robot, tracking, _, _ = arm(random)
    result = calibrate_stops(robot, tracking)
    assert codes_of(result.findings) == ["inverse"]
    assert result.verdict is hec.Verdict.DO_NOT_USE
    assert not calibrate_stops(robot, se3.inverse(tracking)).findings


def test_priors_on_wrong_axes_contradict(random):
    robot, tracking, X, _ = arm(random)
    wrong_x = X[0, 3] + 1.0
    config = CalibratorConfig(prior_x=f"{wrong_x}+/-0.001")
    result = calibrate_arm(robot, tracking, config)
    assert result.status is hec.SolveStatus.CONTRADICTED


@pytest.mark.parametrize(
    ("file", "parent", "position", "within_m"),
    [
        (
            "moveit_samples/pose_samples.json",
            "base",
            (0.659, -0.249, 0.830),
            0.002,
        ),
        ("camodocal_example/TransformPairsInput.yml", "base", None, 0.0),
    ],
)
def test_samples_of_others(file, parent, position, within_m):
    folder = data_folder() / "independent"
    samples = read_arm_samples(folder / file)
    result = calibrate_arm(samples.robot, samples.tracking)
    assert result.parent_frame == parent
    # Two of CamOdoCal's 42 stops do not fit the others.
    assert {finding.severity for finding in result.findings} <= {Severity.NOTE}
    assert result.verdict is not hec.Verdict.DO_NOT_USE
    if position:
        assert_allclose(result.T_parent_child[:3, 3], position, atol=within_m)


class TestCommand:
    def test_samples_are_the_only_path(
        self, random, tmp_path, capsys, no_figures
    ):
        robot, tracking, X, _ = arm(random)
        pairs = [
            [a.tolist(), b.tolist()]
            for a, b in zip(robot, tracking, strict=True)
        ]
        (tmp_path / "samples.json").write_text(json.dumps(pairs))
        out = tmp_path / "out"
        assert (
            main(
                ["calibrate", str(tmp_path / "samples.json"), "--out", str(out)]
            )
            == 0
        )
        assert "camera in hand: maps coordinates" in (
            output := capsys.readouterr().out
        )
        assert "target in base" in output
        assert_allclose(hec.load(out).T_parent_child, X, atol=5e-3)

    def test_two_files_without_an_order(self, random, tmp_path, capsys):
        robot, tracking, X, _ = arm(random)
        for name, poses in (("hand", robot), ("eye", se3.inverse(tracking))):
            stamps_ns = np.arange(len(poses)) * 10**9
            hec.write_trajectory(
                tmp_path / f"{name}.tum", hec.Trajectory(stamps_ns, poses)
            )
        files = [str(tmp_path / "hand.tum"), str(tmp_path / "eye.tum")]
        assert main(["calibrate", *files, "--order", "none", "--json"]) == 0
        document = json.loads(capsys.readouterr().out)
        assert document["reference"] == "stops"
        assert_allclose(document["T_parent_child"]["matrix"], X, atol=5e-3)
        assert main(["calibrate", files[0], "--order", "none"]) == 1
        assert "expected samples of an arm" in capsys.readouterr().err


@pytest.mark.parametrize("is_in_hand", [True, False])
def test_three_stops_do_not_say_where_the_camera_is(random, is_in_hand):
    robot, tracking, *_ = arm(random, n=3, is_in_hand=is_in_hand)

    result = calibrate_arm(robot, tracking)

    assert result.verdict.value == "DO NOT USE"
    assert "fit these stops equally well" in result.findings[0].what


@pytest.mark.parametrize(
    "convert", [lambda Ts: Ts, se3.inverse], ids=["same", "inverse"]
)
def test_a_target_with_the_poses_of_the_robot_is_a_copy(random, convert):
    robot, *_ = arm(random)

    result = calibrate_arm(robot, convert(robot))

    assert result.verdict.value == "DO NOT USE"
    assert result.findings[0].code == "same_frame"


@pytest.mark.parametrize(
    ("error_m", "codes"), [(0.003, []), (0.1, ["outliers"])]
)
def test_only_clear_outliers_are_reported(random, error_m, codes):
    robot, tracking, *_ = arm(random, n=40)
    tracking[[5, 20], :3, 3] += error_m

    result = calibrate_arm(robot, tracking)

    assert [row.number for row in result.stops.rows if not row.is_used] == [
        6,
        21,
    ]
    assert codes_of(result.findings) == codes


@pytest.mark.parametrize(
    ("tilt_deg", "codes"), [(2.0, []), (25.0, ["outliers"])]
)
@pytest.mark.parametrize("setup", ["hand", "beside"])
def test_a_tilt_of_a_target_seen_from_the_front_is_not_reported(
    random, setup, tilt_deg, codes
):
    n = 40
    views = random.normal(size=(n, 2))
    views *= np.radians(25.0) / np.linalg.norm(views, axis=1, keepdims=True)
    views[7] = [np.radians(tilt_deg), 0.0]
    vectors = np.column_stack([views, np.zeros(n)])
    tracking = se3.from_rotation_translation(
        se3.rotation_exp(vectors) @ np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.8]
    )
    X, Z = se3.exp(random.normal(size=(2, 6)) * np.repeat([0.3, 1.0], 3))
    robot = Z @ se3.inverse(X @ tracking)
    if setup == "beside":
        robot = X @ tracking @ se3.inverse(Z)
    tracking = tracking @ se3.exp(random.normal(size=(n, 6)) * 1e-3)
    # The mirror image of a view from the front.
    mirrored = se3.rotation_exp(np.radians([-4.0, 0.0, 0.0]))
    tracking[7, :3, :3] = mirrored @ tracking[7, :3, :3]

    result = calibrate_arm(robot, tracking, setup=setup)

    assert [row.number for row in result.stops.rows if not row.is_used] == [8]
    assert codes_of(result.findings) == codes
