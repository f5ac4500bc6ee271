"""Calibrations from stops: which way round, frames, verdicts, files."""

import json

import numpy as np
import pytest
from real_data import data_folder
from sigmas import assert_nees, nees

import hand_eye_calib as hec
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError, NotEnoughDataError
from hand_eye_calib.core.checks.findings import Severity
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops import robot_world
from hand_eye_calib.extras.stops.calibrate import calibrate_arm, calibrate_stops
from hand_eye_calib.extras.stops.closed_form import Stops
from hand_eye_calib.extras.stops.robot_world import solve
from hand_eye_calib.extras.stops.samples import read_arm_samples
from hand_eye_calib.offline.cli.main import main

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
def test_a_camera_in_the_hand_and_one_beside_the_robot_are_told_apart_and_kept(
    random, is_in_hand
):
    robot, tracking, X, Z = arm(random, is_in_hand=is_in_hand)
    result = calibrate_arm(robot, tracking, names={"camera": "eye"})
    frames = ("hand", "base") if is_in_hand else ("base", "hand")
    assert (result.parent_frame, result.parent_world_frame) == frames
    assert (result.child_frame, result.child_world_frame) == ("eye", "target")
    for estimate, truth in ((result.T_parent_child, X), (result.T_world_world, Z)):
        assert np.abs(se3.log(se3.inverse(estimate) @ truth)).max() < 5e-3
    assert result.verdict is hec.Verdict.USE
    read = hec.Calibration.from_dict(result.to_dict())
    assert read.to_dict() == result.to_dict()
    np.testing.assert_array_equal(read.T_world_world, result.T_world_world)


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
    assert [finding.code for finding in result.findings] == ["inverse"]
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
    # Two of CamOdoCal's 42 stops do not fit the others.
    assert {finding.severity for finding in result.findings} <= {Severity.NOTE}
    assert result.verdict is not hec.Verdict.DO_NOT_USE
    if position:
        np.testing.assert_allclose(
            result.T_parent_child[:3, 3], position, atol=within_m
        )


class TestCommand:
    def test_samples_are_the_only_path(self, random, tmp_path, capsys, no_figures):
        robot, tracking, X, _ = arm(random)
        pairs = [[a.tolist(), b.tolist()] for a, b in zip(robot, tracking, strict=True)]
        (tmp_path / "samples.json").write_text(json.dumps(pairs))
        out = tmp_path / "out"
        assert (
            main(["calibrate", str(tmp_path / "samples.json"), "--out", str(out)]) == 0
        )
        assert "camera in hand: maps coordinates" in (output := capsys.readouterr().out)
        assert "target in base" in output
        np.testing.assert_allclose(hec.load(out).T_parent_child, X, atol=5e-3)

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
        np.testing.assert_allclose(document["T_parent_child"]["matrix"], X, atol=5e-3)
        assert main(["calibrate", files[0], "--order", "none"]) == 1
        assert "expected samples of an arm" in capsys.readouterr().err


# ---- samples of arms as other tools write them


N_SAMPLES = 4


@pytest.fixture
def both_poses():
    random = np.random.default_rng(0)
    return [se3.exp(random.normal(size=(N_SAMPLES, 6))) for _ in range(2)]


def transform_of(T):
    x, y, z, w = se3.to_quat_xyzw(T).tolist()
    return {
        "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
        "rotation": {"x": x, "y": y, "z": z, "w": w},
    }


def opencv(both_poses):
    text = f"%YAML:1.0\n---\nframeCount: {N_SAMPLES}\n"
    for k in range(N_SAMPLES):
        for name, Ts in zip(("T1", "T2"), both_poses, strict=True):
            numbers = ", ".join(f"{x:.17e}" for x in Ts[k].ravel())
            text += f"{name}_{k}: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: d\n"
            text += f"   data: [ {numbers} ]\n"
    return text


def easy_handeye2(both_poses):
    parameters = {"robot_effector_frame": "tool0", "tracking_base_frame": "camera"}
    samples = [
        {"robot": transform_of(a), "tracking": transform_of(b)}
        for a, b in zip(*both_poses, strict=True)
    ]
    return json.dumps({"parameters": parameters, "samples": samples})


def moveit_yaml(both_poses):
    names = ("effector_wrt_world", "object_wrt_sensor")
    rows = (
        dict(zip(names, (a.ravel().tolist(), b.ravel().tolist()), strict=True))
        for a, b in zip(*both_poses, strict=False)
    )
    return json.dumps(list(rows))


def moveit_json(both_poses):
    return json.dumps(
        [[a.tolist(), b.tolist()] for a, b in zip(*both_poses, strict=True)]
    )


@pytest.mark.parametrize("written", [opencv, easy_handeye2, moveit_yaml, moveit_json])
def test_files_of_other_tools(written, both_poses, tmp_path):
    path = tmp_path / "samples.yaml"
    path.write_text(written(both_poses))
    read = read_arm_samples(path)
    np.testing.assert_allclose(read.robot, both_poses[0], atol=1e-12)
    np.testing.assert_allclose(read.tracking, both_poses[1], atol=1e-12)
    frames = {"hand": "tool0", "camera": "camera"} if written is easy_handeye2 else {}
    assert read.frames == frames


def calib_of_easy_handeye2(kind):
    names = {"robot_base_frame": "link0", "tracking_base_frame": "camera"}
    return json.dumps({"parameters": {"calibration_type": kind, **names}})


@pytest.mark.parametrize("folder", ["samples", "calibrations"])
@pytest.mark.parametrize("kind", ["eye_on_base", "eye_in_hand"])
def test_the_calibration_of_the_same_name_states_the_place_of_the_camera(
    folder, kind, both_poses, tmp_path
):
    for name in ("samples", "calibrations"):
        (tmp_path / name).mkdir()
    path = tmp_path / "samples" / "arm.samples"
    path.write_text(easy_handeye2(both_poses))
    calibration = tmp_path / folder / "arm.calib"
    calibration.write_text(calib_of_easy_handeye2(kind))
    (tmp_path / folder / "other.calib").write_text("not: read: ]")
    read = read_arm_samples(path)
    is_beside = kind == "eye_on_base"
    robot = se3.inverse(both_poses[0]) if is_beside else both_poses[0]
    np.testing.assert_allclose(read.robot, robot, atol=1e-12)
    np.testing.assert_allclose(read.tracking, both_poses[1], atol=1e-12)
    assert read.setup == ("beside" if is_beside else "hand")
    assert read.frames == {"base": "link0", "camera": "camera"}
    assert read.calibration == calibration


def test_a_calibration_is_not_read_if_the_samples_state_the_place(both_poses, tmp_path):
    document = json.loads(easy_handeye2(both_poses))
    document["parameters"]["calibration_type"] = "eye_in_hand"
    path = tmp_path / "arm.samples"
    path.write_text(json.dumps(document))
    (tmp_path / "arm.calib").write_text(calib_of_easy_handeye2("eye_on_base"))
    read = read_arm_samples(path)
    assert read.setup == "hand"
    assert read.calibration is None


def test_the_command_names_the_calibration_that_states_the_place(
    tmp_path, capsys, no_figures
):
    random = np.random.default_rng(5)
    hand = se3.exp(random.normal(size=(12, 6)))
    camera_in_base = se3.exp(np.array([1.0, 0.1, 0.5, 0.2, -0.3, 0.4]))
    target_in_hand = se3.exp(np.array([0.02, 0.0, 0.1, 0.1, 0.2, 0.0]))
    tracking = se3.inverse(camera_in_base) @ hand @ target_in_hand
    path = tmp_path / "arm.samples"
    path.write_text(easy_handeye2([se3.inverse(hand), tracking]))
    (tmp_path / "arm.calib").write_text(calib_of_easy_handeye2("eye_on_base"))
    main(["calibrate", str(path), "--json"])
    printed = capsys.readouterr()
    assert "place of the camera and names of frames: " in printed.err
    assert "arm.calib" in printed.err
    result = json.loads(printed.out)
    assert result["parent_frame"] == "link0"
    np.testing.assert_allclose(
        result["T_parent_child"]["matrix"], camera_in_base, atol=1e-6
    )


def test_the_report_of_an_arm_states_the_error_of_a_near_object(tmp_path):
    assert main(["calibrate", "sample:arm.yaml", "--out", str(tmp_path / "arm")]) == 0
    page = (tmp_path / "arm" / "report.html").read_text()
    assert (
        "The position of an object 0.5 m from camera has a standard deviation of"
        in page
    )


# ---- angles of robots

# Half of the square root of 2.
HALF_ROOT = 0.5**0.5


def about(axis, angle_deg):
    """Return the rotation (3, 3) about an axis."""
    return se3.rotation_exp(np.radians(angle_deg) * np.eye(3)["xyz".index(axis)])


@pytest.mark.parametrize(
    ("robot", "angles", "expected"),
    [
        ("abb", [HALF_ROOT, 0, 0, HALF_ROOT], about("z", 90)),
        ("fanuc", [10, 20, 30], about("z", 30) @ about("y", 20) @ about("x", 10)),
        ("kawasaki", [10, 20, 30], about("z", 10) @ about("y", 20) @ about("z", 30)),
        ("kuka", [10, 20, 30], about("z", 10) @ about("y", 20) @ about("x", 30)),
        ("ur", [0, np.pi / 2, 0], about("y", 90)),
        ("yaskawa", [10, 20, 30], about("z", 30) @ about("y", 20) @ about("x", 10)),
    ],
)
def test_angles_of_robots(robot, angles, expected):
    poses = hec.robot_poses([[1.0, 2.0, 3.0, *angles]], robot)
    np.testing.assert_allclose(poses[0, :3, :3], expected, atol=1e-12)
    np.testing.assert_allclose(poses[0, :3, 3], [1.0, 2.0, 3.0])


def test_an_unknown_robot_or_a_wrong_number_of_values_is_refused():
    with pytest.raises(ConfigError, match="must be one of abb, fanuc"):
        hec.robot_poses([[0.0] * 6], "r2d2")
    with pytest.raises(InputError, match="a pose of abb has 7 numbers; found 6"):
        hec.robot_poses([[0.0] * 6], "abb")


def test_the_file_of_a_hand_has_the_angles_of_its_robot(both_poses, tmp_path, capsys):
    Ts_base_hand = both_poses[0]
    T_hand_camera = se3.exp(np.array([0.05, 0.02, 0.1, 0.3, -0.2, 1.0]))
    T_base_target = se3.exp(np.array([0.5, 0.1, 0.0, 0.1, 0.2, 0.3]))
    abc_deg = np.degrees(se3.rotation_to_rpy(Ts_base_hand[:, :3, :3]))[:, ::-1]
    hand = tmp_path / "hand.csv"
    rows = np.c_[Ts_base_hand[:, :3, 3], abc_deg]
    np.savetxt(hand, rows, delimiter=",", header="X,Y,Z,A,B,C", comments="")
    camera = tmp_path / "camera.npy"
    np.save(camera, se3.inverse(T_base_target) @ Ts_base_hand @ T_hand_camera)
    command = ["calibrate", str(hand), str(camera), "--order", "none"]
    assert main([*command, "--parent-angles", "kuka", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(
        result["T_parent_child"]["matrix"], T_hand_camera, atol=1e-6
    )


def test_angles_of_a_robot_are_refused_for_samples(tmp_path, capsys):
    command = ["calibrate", str(tmp_path / "samples.yaml"), "--parent-angles", "kuka"]
    assert main(command) == 2
    assert "--parent-angles" in capsys.readouterr().err


# ---- a file for each pose


def write_visp(folder, stop, robot, target):
    for name, T in (("fPe", robot), ("cPo", target)):
        values = [*T[:3, 3], *se3.rotation_log(T[:3, :3])]
        rows = "".join(f"  - [{value:.12g}]\n" for value in values)
        (folder / f"pose_{name}_{stop}.yaml").write_text(
            f"rows: 6\ncols: 1\ndata: \n{rows}"
        )


def write_zivid(folder, stop, robot, target):
    for name, T in (("robot", robot), ("camera", target)):
        (folder / name).mkdir(exist_ok=True)
        numbers = ", ".join(repr(float(value)) for value in T.ravel())
        text = (
            "PoseState: !!opencv-matrix\n   rows: 4\n   cols: 4\n "
            f"  dt: d\n   data: [{numbers}]\n"
        )
        (folder / name / f"pos{stop:02d}.yaml").write_text(f"%YAML:1.0\n---\n{text}")


def write_rows_of_matrices(folder, stop, robot, target):
    for name, T in (("gripper", robot), ("board", target)):
        np.savetxt(folder / f"{name}_{stop}.txt", T[:3].reshape(1, -1))


def write_poses_and_targets(folder, stop, robot, target):
    for name, T in (("pos", robot), ("target_pos", target)):
        np.savetxt(folder / f"{name}{stop:02d}.txt", T)


@pytest.mark.parametrize(
    "write", [write_visp, write_zivid, write_rows_of_matrices, write_poses_and_targets]
)
def test_a_folder_with_a_file_for_each_pose(write, both_poses, tmp_path):
    for stop, (robot, target) in enumerate(zip(*both_poses, strict=True)):
        write(tmp_path, stop, robot, target)
    read = read_arm_samples(tmp_path)
    np.testing.assert_allclose([read.robot, read.tracking], both_poses, atol=1e-9)


def test_a_folder_of_poses_is_calibrated(both_poses, tmp_path, capsys):
    for stop, (robot, target) in enumerate(zip(*both_poses, strict=True)):
        write_visp(tmp_path, stop, robot, target)
    main(["calibrate", str(tmp_path)])
    assert "camera in hand" in capsys.readouterr().out


def test_a_stop_without_both_poses_is_named(both_poses, tmp_path):
    for stop in range(4):
        write_visp(tmp_path, stop, both_poses[0][stop], both_poses[1][stop])
    (tmp_path / "pose_cPo_2.yaml").unlink()
    with pytest.raises(InputError, match="each stop needs both poses; incomplete: 2"):
        read_arm_samples(tmp_path)


# ---- arguments of OpenCV in a FileStorage

ARGUMENTS = ("R_gripper2base", "t_gripper2base", "R_target2cam", "t_target2cam")


def opencv_matrix(values):
    rows = np.atleast_2d(values)
    numbers = ", ".join(repr(float(value)) for value in rows.ravel())
    size = f"rows: {len(rows)}\n      cols: 3"
    return f"!!opencv-matrix\n      {size}\n      dt: d\n      data: [{numbers}]"


def one_matrix(name, stack):
    return f"{name}: {opencv_matrix(stack.reshape(-1, 3))}\n"


def a_matrix_for_each_stop(name, stack):
    return f"{name}:\n" + "".join(f"   - {opencv_matrix(values)}\n" for values in stack)


def a_name_for_each_stop(name, stack):
    items = [
        f"{name}_{stop}: {opencv_matrix(values)}\n" for stop, values in enumerate(stack)
    ]
    return "".join(items)


@pytest.mark.parametrize("are_vectors", [False, True])
@pytest.mark.parametrize(
    "write", [one_matrix, a_matrix_for_each_stop, a_name_for_each_stop]
)
def test_arguments_of_opencv_in_a_file_storage(
    write, are_vectors, both_poses, tmp_path
):
    stacks = []
    for Ts in both_poses:
        rotations = Ts[:, :3, :3]
        stacks += [
            se3.rotation_log(rotations) if are_vectors else rotations,
            Ts[:, :3, 3],
        ]
    text = "".join(
        write(name, stack) for name, stack in zip(ARGUMENTS, stacks, strict=True)
    )
    path = tmp_path / "samples.yaml"
    path.write_text(f"%YAML:1.0\n---\n{text}")
    read = read_arm_samples(path)
    np.testing.assert_allclose([read.robot, read.tracking], both_poses, atol=1e-9)


def test_a_file_storage_with_too_few_numbers_is_refused(tmp_path):
    path = tmp_path / "samples.yaml"
    text = "".join(one_matrix(name, np.eye(3)[:1]) for name in ARGUMENTS)
    path.write_text(text.replace("1.0, 0.0, 0.0]", "1.0, 0.0]"))
    with pytest.raises(
        InputError, match="rotations of 2 numbers and translations of 2"
    ):
        read_arm_samples(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected samples of an arm"),
        ("a: 1", "expected samples of an arm"),
        ("[1, 2]", "sample 1: expected samples of an arm"),
        ("[[1, 2]]", "sample 1: expected a pose"),
        ("[{x: 1, y: 2}]", "expected samples of an arm"),
        ("[{robot: {}, tracking: {}}]", "translation and rotation"),
        (
            json.dumps([[np.eye(4).tolist(), (2 * np.eye(4)).tolist()]]),
            "not a rotation matrix",
        ),
        (json.dumps([[[0] * 7, [0] * 7]]), "a quaternion of length 0"),
        ("[[" + "[.nan" + ", 1" * 15 + "], [.nan]]]", "not finite"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(text, message, tmp_path):
    path = tmp_path / "samples.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as raised:
        read_arm_samples(path)
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("as_rows", [False, True])
def test_two_stacks_in_an_npz(as_rows, both_poses, tmp_path):
    stacks = (
        [np.c_[Ts[:, :3, 3], se3.to_quat_xyzw(Ts)] for Ts in both_poses]
        if as_rows
        else both_poses
    )
    file = tmp_path / "arm.npz"
    np.savez(file, robot=stacks[0], tracking=stacks[1])
    read = read_arm_samples(file)
    np.testing.assert_allclose([read.robot, read.tracking], both_poses, atol=1e-12)
    np.savez(file, first=np.eye(4))
    with pytest.raises(InputError, match="expected samples of an arm"):
        read_arm_samples(file)
    file.write_bytes(b"PK and no more")
    with pytest.raises(InputError, match=r"cannot read .*arm\.npz"):
        read_arm_samples(file)


# ---- stops: A X = Z B, its covariance, outliers, and what is unknown


LEVELS = np.repeat([0.002, 0.004], 3)  # m, rad


def poses(random, n, reach_m=0.3, turn_rad=0.5):
    xi = random.normal(size=(n, 6)) * np.repeat([reach_m, turn_rad], 3)
    return se3.exp(xi)


def recorded(random, n, noise=1.0, outliers=0.0, Ts_world_parent=None):
    """X, Z and the stops of a target seen by a camera in a hand."""
    X, Z = poses(random, 2, turn_rad=1.5)
    A = poses(random, n) if Ts_world_parent is None else Ts_world_parent
    B = se3.inverse(Z) @ A @ X @ se3.exp(noise * LEVELS * random.normal(size=(n, 6)))
    wrong = random.random(n) < outliers
    B[wrong] = B[wrong] @ poses(random, int(wrong.sum()), 0.3, 0.5)
    return X, Z, Stops(A, B)


def off(estimate, truth):
    return se3.log(se3.inverse(estimate) @ truth)


@pytest.mark.parametrize("n", [3, 10, 1000])
def test_exact_stops_are_solved_exactly(random, n):
    X, Z, stops = recorded(random, n, noise=0.0)
    fit = solve(stops)
    assert np.abs(off(fit.T_parent_child, X)).max() < 1e-7
    assert np.abs(off(fit.T_world_world, Z)).max() < 1e-7


def errors_m(fits, Xs):
    return np.array(
        [
            np.linalg.norm(off(fit.T_parent_child, X)[:3])
            for fit, X in zip(fits, Xs, strict=True)
        ]
    )


def seen_by_a_camera(random, n):
    """X, Z and stops of a target whose distance and rotation have the largest errors."""
    X, Z, stops = recorded(random, n, noise=0.2)
    measured = se3.inverse(stops.Ts_world_child)
    position = se3.translation_of(measured)
    sight = position / np.linalg.norm(position, axis=1, keepdims=True)
    position = position + 0.01 * random.normal(size=(n, 1)) * sight
    turns = se3.rotation_exp(0.01 * random.normal(size=(n, 3)))
    measured = se3.from_rotation_translation(
        se3.rotation_of(measured) @ turns, position
    )
    return X, Z, Stops(stops.Ts_world_parent, se3.inverse(measured))


def test_errors_of_a_camera_are_weighted_by_their_source(random):
    fits = []
    single = []
    truths = []
    values = []
    for _ in range(30):
        X, Z, stops = seen_by_a_camera(random, 20)
        truths.append(X)
        fits.append(solve(stops))
        rests = np.ones(len(stops))
        single.append(robot_world._likelier_fit(stops, rests))
        values.append(nees_of(solve(stops, stretch=1e-3), X, Z))
    assert np.mean(errors_m(fits, truths)) < 0.8 * np.mean(errors_m(single, truths))
    assert_nees(values, 8.0, 18.0)


def nees_of(fit, X, Z):
    error = np.r_[off(fit.T_parent_child, X), off(fit.T_world_world, Z)]
    return nees(error, fit.covariance)


# NEES of twelve is expected; the mean of 40 has a standard error of 0.8. A target of another size,
# or few stops, have larger sigmas.
@pytest.mark.parametrize(
    ("outliers", "size", "n", "lowest_nees"),
    [(0, 1, 20, 8.0), (0.15, 1, 20, 8.0), (0, 0.98, 20, 4.0), (0, 1, 4, 4.0)],
)
def test_covariance_is_that_of_the_errors(random, outliers, size, n, lowest_nees):
    values = []
    for _ in range(40):
        X, Z, stops = recorded(random, n, outliers=outliers)
        stops.Ts_world_child[:, :3, 3] *= size
        values.append(nees_of(solve(stops), X, Z))
    assert_nees(values, lowest_nees, 18.0)


def test_covariance_is_that_of_errors_that_last(random):
    values = []
    n = 40
    lasting = np.linalg.cholesky(
        0.7 ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    )
    for _ in range(30):
        waves = np.sin(np.linspace(0.0, 6.0, n)[:, None] * random.uniform(0.5, 2.0, 6))
        X, Z, stops = recorded(
            random, n, noise=0.0, Ts_world_parent=se3.exp(0.5 * waves)
        )
        errors = se3.exp(lasting @ random.normal(size=(n, 6)) * LEVELS)
        fit = solve(Stops(stops.Ts_world_parent, stops.Ts_world_child @ errors))
        values.append(nees_of(fit, X, Z))
    # NEES of twelve is expected; it was 25 when errors counted as independent.
    assert_nees(values, 6.0, 18.0)


def test_an_arm_that_rests_makes_no_outliers_of_the_other_stops(random):
    A = poses(random, 40)
    resting = np.r_[np.zeros(60, dtype=int), np.arange(40)]
    _, _, stops = recorded(random, 40, Ts_world_parent=A)
    assert np.all(solve(stops[resting]).weights > 0.0)


def test_order_does_not_matter(random):
    _, _, stops = recorded(random, 30)
    first = solve(stops)
    second = solve(stops[random.permutation(30)])
    assert np.abs(off(first.T_parent_child, second.T_parent_child)).max() < 2e-4


def test_outliers_have_no_weight(random):
    X, _, stops = recorded(random, 40)
    stops.Ts_world_child[:4] = poses(random, 4, 1.0, 2.0)
    fit = solve(stops)
    assert np.all(fit.weights[:4] == 0.0)
    assert np.sum(fit.weights == 0.0) <= 6
    assert np.linalg.norm(off(fit.T_parent_child, X)[:3]) < 0.01


@pytest.mark.parametrize(("error_m", "codes"), [(0.003, []), (0.1, ["outliers"])])
def test_only_clear_outliers_are_reported(random, error_m, codes):
    robot, tracking, *_ = arm(random, n=40)
    tracking[[5, 20], :3, 3] += error_m

    result = calibrate_arm(robot, tracking)

    assert [row.number for row in result.stops.rows if not row.is_used] == [6, 21]
    assert [finding.code for finding in result.findings] == codes


@pytest.mark.parametrize(("tilt_deg", "codes"), [(2.0, []), (25.0, ["outliers"])])
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
    X, Z = poses(random, 2, 0.3, 1.0)
    robot = Z @ se3.inverse(X @ tracking)
    if setup == "beside":
        robot = X @ tracking @ se3.inverse(Z)
    tracking = tracking @ se3.exp(random.normal(size=(n, 6)) * 1e-3)
    # The mirror image of a view from the front.
    mirrored = se3.rotation_exp(np.radians([-4.0, 0.0, 0.0]))
    tracking[7, :3, :3] = mirrored @ tracking[7, :3, :3]

    result = calibrate_arm(robot, tracking, setup=setup)

    assert [row.number for row in result.stops.rows if not row.is_used] == [8]
    assert [finding.code for finding in result.findings] == codes


def test_two_stops_are_too_few(random):
    for n in (0, 1, 2):
        with pytest.raises(NotEnoughDataError, match="at least 3"):
            solve(recorded(random, n)[2])


class TestUndetermined:
    def test_rotations_about_all_axes_determine_everything(self, random):
        assert solve(recorded(random, 15)[2]).undetermined().shape == (6, 0)

    @pytest.mark.parametrize("seed", range(10))
    @pytest.mark.parametrize(
        "motion", ["one_axis", "no_rotation", "one_axis_unmoved", "two"]
    )
    def test_degenerate_stops_are_refused_by_axis(self, motion, seed):
        random = np.random.default_rng(seed)
        axis = se3.nearest_rotation(random.normal(size=(3, 3)))[0]
        moves = 0.3 * (motion != "one_axis_unmoved") * random.normal(size=(25, 3))
        turns = (motion != "no_rotation") * random.normal(size=(25, 1)) * axis
        places = np.arange(25) % (2 if motion == "two" else 25)
        A = poses(random, 1, turn_rad=2.0) @ se3.exp(np.c_[moves, turns][places])
        _, _, stops = recorded(random, 25, random.uniform(0.3, 3.0), Ts_world_parent=A)
        fit = solve(stops)
        unknown = np.kron(np.eye(2), fit.T_parent_child[:3, :3]) @ fit.undetermined()
        along = np.eye(3) if motion == "no_rotation" else axis[None]
        assert np.linalg.norm(along @ unknown[:3], axis=1).min() > 0.98
        result = calibrate_stops(stops.Ts_world_parent, stops.Ts_world_child)
        assert (unknown.shape == (6, 1)) == (motion == "one_axis")
        assert result.reasons[0].rule == "nothing_known"
        assert {"x", "y", "z"} & {*result.unobservable()}


# ------------------------------------------------------------------ arms that say too little


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
