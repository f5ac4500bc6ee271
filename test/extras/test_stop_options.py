"""Options and inputs of stops, and the advice that leads to them."""

import json

import numpy as np
import pytest
from arm_making import (
    BESIDE,
    ON_HAND,
    WITHIN_M,
    WITHIN_RAD,
    arm,
    same,
    scalar_first,
    scaled,
    transposed_rotations,
    with_outliers,
    with_rotations,
)
from findings import codes_of
from numpy.testing import assert_allclose

import hand_eye_calib as hec
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.checks.findings import Severity
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.calibrate import calibrate_arm, calibrate_stops
from hand_eye_calib.offline.cli.main import main


class TestOptions:
    @pytest.mark.parametrize(
        ("option", "value"),
        [
            ("method", "dnlo"),
            ("reference", "B1"),
            ("time_offset", 1.0),
            ("time_offset", 0.0),
            ("max_gap", 2.0),
        ],
    )
    def test_what_means_nothing_for_stops_is_refused(self, option, value):
        robot, tracking, _ = arm(ON_HAND)
        with pytest.raises(
            ConfigError, match=f"{option} {value} has no meaning for stops"
        ):
            calibrate_arm(robot, tracking, CalibratorConfig(**{option: value}))

    @pytest.mark.parametrize(
        ("of_robot", "of_target", "options"),
        [
            (scalar_first, same, {"parent_quaternion": "wxyz"}),
            (same, transposed_rotations, {"child_invert": "orientations"}),
            (
                se3.inverse,
                se3.inverse,
                {"parent_invert": "poses", "child_invert": "poses"},
            ),
            (lambda Ts: scaled(Ts, 1e3), same, {"parent_scale": 0.001}),
            (same, lambda Ts: scaled(Ts, 2.0), {"scale": 0.5}),
            (same, lambda Ts: scaled(Ts, 2.0), {"scale": "estimate"}),
        ],
    )
    def test_an_option_puts_right_what_it_says(
        self, of_robot, of_target, options
    ):
        robot, tracking, truth = arm(ON_HAND)
        config = CalibratorConfig(**options)
        result = calibrate_arm(of_robot(robot), of_target(tracking), config)
        error = se3.log(se3.inverse(result.T_parent_child) @ truth)
        assert np.linalg.norm(error[:3]) < WITHIN_M
        assert result.findings == ()

    @pytest.mark.parametrize(
        ("of_robot", "of_target", "options", "code"),
        [
            (
                scalar_first,
                scalar_first,
                {"parent_quaternion": "xyzw"},
                "quaternion_order",
            ),
            (lambda Ts: scaled(Ts, 1e3), same, {"parent_scale": 1.0}, "units"),
            (same, lambda Ts: scaled(Ts, 2.0), {"scale": "none"}, "scale"),
            (same, same, {"scale": 2.0}, "scale"),
        ],
    )
    def test_what_the_user_has_settled_is_not_repaired(
        self, of_robot, of_target, options, code
    ):
        robot, tracking, _ = arm(ON_HAND)
        config = CalibratorConfig(**options)
        result = calibrate_arm(of_robot(robot), of_target(tracking), config)
        assert codes_of(result.findings) == [code]
        assert result.verdict is hec.Verdict.DO_NOT_USE


class TestInput:
    def test_rows_and_pairs_as_opencv_has_them_are_poses(self):
        robot, tracking, _ = arm(ON_HAND)
        expected = calibrate_arm(robot, tracking).T_parent_child
        of_opencv = [(Ts[:, :3, :3], Ts[:, :3, 3:]) for Ts in (robot, tracking)]
        vectors = [
            (se3.rotation_log(Ts[:, :3, :3]), Ts[:, :3, 3])
            for Ts in (robot, tracking)
        ]
        rows = [se3.to_rows(Ts) for Ts in (robot, tracking)]
        lists = [[T.tolist() for T in Ts] for Ts in (robot, tracking)]
        for first, second in (of_opencv, vectors, rows, lists):
            assert_allclose(
                calibrate_arm(first, second).T_parent_child, expected, atol=1e-9
            )

    @pytest.mark.parametrize("shape", [(3,), (3, 1), (1, 3)])
    @pytest.mark.parametrize("are_vectors", [False, True])
    def test_four_arrays_of_opencv_are_taken_in_its_order(
        self, are_vectors, shape
    ):
        robot, tracking, _ = arm(ON_HAND)
        expected = calibrate_arm(robot, tracking).T_parent_child
        arrays = []
        for Ts in (robot, tracking):
            rotations = Ts[:, :3, :3]
            if are_vectors:
                rotations = se3.rotation_log(rotations).reshape(-1, *shape)
            arrays.append(list(rotations))
            arrays.append(list(Ts[:, :3, 3].reshape(-1, *shape)))
        result = calibrate_arm(*arrays)
        assert_allclose(result.T_parent_child, expected, atol=1e-9)

    def test_three_arrays_of_opencv_are_refused_with_the_right_order(self):
        robot, tracking, _ = arm(ON_HAND)
        with pytest.raises(InputError, match="R_gripper2base, t_gripper2base"):
            calibrate_arm(
                robot[:, :3, :3], robot[:, :3, 3], tracking[:, :3, :3]
            )

    @pytest.mark.parametrize("solve", [calibrate_arm, calibrate_stops])
    def test_what_is_no_pose_is_named_in_one_line(self, solve):
        robot, tracking, _ = arm(ON_HAND)
        holed = tracking.copy()
        holed[3, 0, 3] = np.nan
        cases = {
            "20 poses of .*, 18 of": (robot, tracking[:18]),
            "row 4: a number is not finite": (robot, holed),
            "the matrix is transposed": (np.swapaxes(robot, 1, 2), tracking),
            r"expected poses as \(N, 4, 4\)": (robot[:, :2], tracking),
            "rows of different shapes": ([[1.0, 2.0], [3.0]], tracking),
            "20 rotations, 18 translations": (
                (robot[:, :3, :3], robot[:18, :3, 3]),
                tracking,
            ),
        }
        for message, (first, second) in cases.items():
            with pytest.raises(InputError, match=message) as raised:
                solve(first, second)
            assert "\n" not in str(raised.value)


def test_stops_that_turn_about_two_axes_are_not_said_to_lack_them():
    robot, tracking, _ = arm(ON_HAND, noise_m=0.0005)
    config = CalibratorConfig(parent_scale=1.0, scale="none")
    result = calibrate_arm(scaled(robot, 1e3), tracking, config)
    assert result.verdict is hec.Verdict.DO_NOT_USE
    assert "two axes" not in " ".join(
        reason.sentence for reason in result.reasons
    )


def test_two_files_need_no_stamps(tmp_path, capsys):
    robot, tracking, truth = arm(ON_HAND)
    files = []
    for name, Ts in (("hand", robot), ("camera", se3.inverse(tracking))):
        vectors = np.c_[Ts[:, :3, 3], se3.rotation_log(Ts[:, :3, :3])]
        files.append(str(tmp_path / f"{name}.csv"))
        np.savetxt(
            files[-1],
            vectors,
            delimiter=",",
            header="x,y,z,rx,ry,rz",
            comments="",
        )
    assert main(["calibrate", *files, "--order", "none", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert_allclose(
        np.array(document["T_parent_child"]["matrix"])[:3, 3],
        truth[:3, 3],
        atol=WITHIN_M,
    )


def test_rotations_alone_give_no_position():
    robot, tracking, truth = arm(ON_HAND)
    config = CalibratorConfig(parent_measures="rotations")
    result = calibrate_arm(robot, tracking, config)
    assert result.out_of_reach == ("x", "y", "z")
    error = se3.log(se3.inverse(result.T_parent_child) @ truth)
    assert np.linalg.norm(error[3:]) < WITHIN_RAD


def test_degrees_under_names_of_rotation_vectors_are_refused(tmp_path, capsys):
    robot, tracking, _ = arm(ON_HAND)
    angles = np.degrees(se3.rotation_to_rpy(robot[:, :3, :3]))
    np.savetxt(
        tmp_path / "hand.csv",
        np.c_[robot[:, :3, 3], angles],
        delimiter=",",
        header="x,y,z,rx,ry,rz",
        comments="",
    )
    stamps_ns = np.arange(len(tracking)) * 10**9
    hec.write_trajectory(
        tmp_path / "camera.tum", hec.Trajectory(stamps_ns, tracking)
    )
    files = [str(tmp_path / name) for name in ("hand.csv", "camera.tum")]
    assert main(["calibrate", *files, "--order", "none"]) == 1
    assert "angles in degrees" in capsys.readouterr().err


@pytest.mark.parametrize("n_files", [1, 2])
def test_pairing_by_time_is_refused_for_stops(n_files, tmp_path, capsys):
    robot, tracking, _ = arm(ON_HAND)
    np.savez(tmp_path / "arm.npz", robot=robot, tracking=tracking)
    for name, Ts in (("hand", robot), ("camera", tracking)):
        np.save(tmp_path / f"{name}.npy", Ts)
    names = (
        ["arm.npz"]
        if n_files == 1
        else ["hand.npy", "camera.npy", "--order", "none"]
    )
    words = [str(tmp_path / name) if "." in name else name for name in names]
    assert main(["calibrate", *words, "--pair-by", "time"]) == 2
    assert "--pair-by time has no meaning for stops" in capsys.readouterr().err


SIZED = {
    "metres": (same, same),
    "millimetres, target": (same, lambda Ts: scaled(Ts, 1e3)),
    "millimetres, both": (
        lambda Ts: scaled(Ts, 1e3),
        lambda Ts: scaled(Ts, 1e3),
    ),
    "centimetres, target": (same, lambda Ts: scaled(Ts, 1e2)),
    "scalar first, both": (scalar_first, scalar_first),
}


@pytest.mark.parametrize("place", [ON_HAND, BESIDE])
@pytest.mark.parametrize("size", [0.7, 1.2, 1.5])
@pytest.mark.parametrize("name", SIZED)
def test_the_options_that_a_finding_names_lead_to_the_right_answer(
    name, size, place
):
    of_robot, of_target = SIZED[name]
    robot, tracking, truth = arm(place, seed=5)
    sides = of_robot(robot), of_target(scaled(tracking, size))
    refused = calibrate_arm(*sides)
    assert refused.verdict is hec.Verdict.DO_NOT_USE
    options = refused.reasons[0].options
    assert options == {"scale": "estimate"}
    result = calibrate_arm(*sides, CalibratorConfig(**options))
    error = se3.log(se3.inverse(result.T_parent_child) @ truth)
    assert np.linalg.norm(error[:3]) < WITHIN_M
    assert result.verdict is not hec.Verdict.DO_NOT_USE
    automatic = calibrate_arm(*sides, CalibratorConfig(scale="auto"))
    assert_allclose(automatic.T_parent_child, result.T_parent_child, atol=1e-9)
    assert automatic.verdict is result.verdict


SETUPS = {"hand": ON_HAND, "beside": BESIDE}


@pytest.mark.parametrize("setup", SETUPS)
def test_the_first_line_has_the_place_of_the_camera_but_no_setup_that_the_stops_refuse(
    setup,
):
    robot, tracking, _ = arm(SETUPS[setup])

    result = calibrate_arm(robot, tracking)

    assert result.headline.endswith(f"; camera {SETUPS[setup]}")
    assert result.setup == setup
    assert (
        hec.Calibration.from_dict(result.to_dict()).headline == result.headline
    )
    assert result.inverse().setup == setup


@pytest.mark.parametrize("setup", SETUPS)
def test_a_setup_that_the_stops_contradict_is_refused_alone(setup):
    robot, tracking, _ = arm(SETUPS[setup])
    other = "beside" if setup == "hand" else "hand"

    obeyed = calibrate_arm(robot, tracking, setup=setup)
    refused = calibrate_arm(robot, tracking, setup=other)

    assert obeyed.findings == ()
    assert obeyed.warnings == ()
    assert codes_of(refused.findings) == ["setup"]
    assert (
        f"the stops fit a camera {SETUPS[setup]}, not one {SETUPS[other]}"
        in refused.headline
    )


def test_a_setup_decides_where_the_stops_do_not():
    robot, tracking, _ = arm(ON_HAND, n=3)
    assert codes_of(calibrate_arm(robot, tracking).findings) == ["ambiguous"]
    for setup in SETUPS:
        result = calibrate_arm(robot, tracking, setup=setup)
        assert result.setup == setup
        assert "ambiguous" not in codes_of(result.findings)


def test_an_unknown_setup_is_refused():
    robot, tracking, _ = arm(ON_HAND)
    with pytest.raises(
        ConfigError, match="setup must be one of hand, beside; got"
    ):
        calibrate_arm(robot, tracking, setup="eye in hand")


def test_setup_is_an_option_of_arms_alone(tmp_path, capsys):
    robot, tracking, _ = arm(ON_HAND)
    np.savez(tmp_path / "arm.npz", robot=robot, tracking=tracking)
    files = []
    for name, Ts in (("hand", robot), ("camera", se3.inverse(tracking))):
        files.append(str(tmp_path / f"{name}.npy"))
        np.save(files[-1], Ts)

    assert (
        main(["calibrate", str(tmp_path / "arm.npz"), "--setup", "hand"]) == 0
    )
    assert (
        main(["calibrate", str(tmp_path / "arm.npz"), "--setup", "beside"]) == 3
    )
    capsys.readouterr()
    # Poses without an order are stops.
    assert (
        main(["calibrate", *files, "--order", "none", "--setup", "hand"]) == 0
    )
    capsys.readouterr()
    assert (
        main(["calibrate", *files, "--order", "time", "--setup", "hand"]) == 2
    )
    assert "the place of the camera of an arm" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("count", "severity", "verdict"),
    [
        (1, Severity.NOTE, hec.Verdict.USE),
        (4, Severity.NOTE, hec.Verdict.USE),
        (5, Severity.WARNING, hec.Verdict.USE_WITH_CARE),
        (10, Severity.WARNING, hec.Verdict.USE_WITH_CARE),
    ],
)
@pytest.mark.parametrize("place", [ON_HAND, BESIDE])
def test_stops_that_were_left_out_are_counted_and_named(
    place, count, severity, verdict
):
    robot, tracking, truth = arm(place, seed=9, n=40)

    result = calibrate_arm(robot, with_outliers(tracking, count))

    (finding,) = result.findings
    assert (finding.code, finding.severity) == ("outliers", severity)
    assert finding.evidence == {"count": count, "n_stops": 40}
    assert sum(not row.is_used for row in result.stops.rows) == count
    text = f"{count} of 40 stops do not fit the others and were left out: stop"
    if count == 1:
        text = "1 of 40 stops does not fit the others and was left out: stop"
    assert text in result.headline
    assert result.verdict is verdict
    error = se3.log(se3.inverse(result.T_parent_child) @ truth)
    assert np.linalg.norm(error[:3]) < WITHIN_M


def test_one_wrong_stop_of_five_is_left_out():
    robot, target, truth = arm(ON_HAND, seed=31, n=5)
    wrong = target.copy()
    wrong[2] = wrong[2] @ se3.exp([0.3, -0.2, 0.2, 0.5, 0.8, -0.4])
    result = calibrate_arm(robot, wrong)
    assert result.verdict is hec.Verdict.USE_WITH_CARE
    assert [issue.code for issue in result.findings] == ["outliers"]
    error = se3.log(se3.inverse(result.T_parent_child) @ truth)
    assert np.linalg.norm(error[:3]) < WITHIN_M


def test_targets_detected_mirrored_at_half_of_the_stops_are_left_out():
    robot, target, truth = arm(ON_HAND, seed=32, n=30)
    random = np.random.default_rng(32)
    is_wrong = random.permutation(30) < 14
    tilts = se3.rotation_exp(0.4 * random.normal(size=(30, 3)))
    wrong = np.where(
        is_wrong[:, None, None],
        with_rotations(target, target[:, :3, :3] @ tilts),
        target,
    )
    result = calibrate_arm(robot, wrong)
    assert result.verdict is hec.Verdict.USE_WITH_CARE
    error = se3.log(se3.inverse(result.T_parent_child) @ truth)
    assert np.linalg.norm(error[:3]) < WITHIN_M


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        (
            [],
            "leave --parent-invert out, or give --child-invert poses (target) as well",
        ),
        (
            ["--child-invert", "none"],
            "leave --parent-invert out, or give --child-invert",
        ),
    ],
)
def test_the_place_in_the_file_is_held_against_inverse_poses(
    options, advice, capsys
):
    """The sample file says eye_in_hand. The option that was given is not advised again."""
    command = ["arm", "sample:arm.yaml", "--parent-invert", "poses", *options]
    assert main(command) == 3
    out = " ".join(capsys.readouterr().out.split())
    assert (
        "DO NOT USE: the stops fit a camera beside the robot, not one on the hand"
        in out
    )
    assert "give --setup beside; or, if the camera is on the hand" in out
    assert advice in out
    beside = ["--child-invert", "poses", "--setup", "beside"]
    assert main(["arm", "sample:arm.yaml", *beside]) == 0
