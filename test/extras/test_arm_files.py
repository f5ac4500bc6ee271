"""Files of arms: samples of other tools, angles of robots, a file for each pose."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.samples import read_arm_samples
from hand_eye_calib.offline.cli.main import main

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
    parameters = {
        "robot_effector_frame": "tool0",
        "tracking_base_frame": "camera",
    }
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


@pytest.mark.parametrize(
    "written", [opencv, easy_handeye2, moveit_yaml, moveit_json]
)
def test_files_of_other_tools(written, both_poses, tmp_path):
    path = tmp_path / "samples.yaml"
    path.write_text(written(both_poses))
    read = read_arm_samples(path)
    assert_allclose(read.robot, both_poses[0], atol=1e-12)
    assert_allclose(read.tracking, both_poses[1], atol=1e-12)
    frames = (
        {"hand": "tool0", "camera": "camera"}
        if written is easy_handeye2
        else {}
    )
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
    assert_allclose(read.robot, robot, atol=1e-12)
    assert_allclose(read.tracking, both_poses[1], atol=1e-12)
    assert read.setup == ("beside" if is_beside else "hand")
    assert read.frames == {"base": "link0", "camera": "camera"}
    assert read.calibration == calibration


def test_a_calibration_is_not_read_if_the_samples_state_the_place(
    both_poses, tmp_path
):
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
    assert_allclose(
        result["T_parent_child"]["matrix"], camera_in_base, atol=1e-6
    )


def test_the_report_of_an_arm_states_the_error_of_a_near_object(tmp_path):
    assert (
        main(["calibrate", "sample:arm.yaml", "--out", str(tmp_path / "arm")])
        == 0
    )
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
    return se3.rotation_exp(
        np.radians(angle_deg) * np.eye(3)["xyz".index(axis)]
    )


@pytest.mark.parametrize(
    ("robot", "angles", "expected"),
    [
        ("abb", [HALF_ROOT, 0, 0, HALF_ROOT], about("z", 90)),
        (
            "fanuc",
            [10, 20, 30],
            about("z", 30) @ about("y", 20) @ about("x", 10),
        ),
        (
            "kawasaki",
            [10, 20, 30],
            about("z", 10) @ about("y", 20) @ about("z", 30),
        ),
        (
            "kuka",
            [10, 20, 30],
            about("z", 10) @ about("y", 20) @ about("x", 30),
        ),
        ("ur", [0, np.pi / 2, 0], about("y", 90)),
        (
            "yaskawa",
            [10, 20, 30],
            about("z", 30) @ about("y", 20) @ about("x", 10),
        ),
    ],
)
def test_angles_of_robots(robot, angles, expected):
    poses = hec.robot_poses([[1.0, 2.0, 3.0, *angles]], robot)
    assert_allclose(poses[0, :3, :3], expected, atol=1e-12)
    assert_allclose(poses[0, :3, 3], [1.0, 2.0, 3.0])


def test_an_unknown_robot_or_a_wrong_number_of_values_is_refused():
    with pytest.raises(ConfigError, match="must be one of abb, fanuc"):
        hec.robot_poses([[0.0] * 6], "r2d2")
    with pytest.raises(
        InputError, match="a pose of abb has 7 numbers; found 6"
    ):
        hec.robot_poses([[0.0] * 6], "abb")


def test_the_file_of_a_hand_has_the_angles_of_its_robot(
    both_poses, tmp_path, capsys
):
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
    assert_allclose(
        result["T_parent_child"]["matrix"], T_hand_camera, atol=1e-6
    )


def test_angles_of_a_robot_are_refused_for_samples(tmp_path, capsys):
    command = [
        "calibrate",
        str(tmp_path / "samples.yaml"),
        "--parent-angles",
        "kuka",
    ]
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
        (folder / name / f"pos{stop:02d}.yaml").write_text(
            f"%YAML:1.0\n---\n{text}"
        )


def write_rows_of_matrices(folder, stop, robot, target):
    for name, T in (("gripper", robot), ("board", target)):
        np.savetxt(folder / f"{name}_{stop}.txt", T[:3].reshape(1, -1))


def write_poses_and_targets(folder, stop, robot, target):
    for name, T in (("pos", robot), ("target_pos", target)):
        np.savetxt(folder / f"{name}{stop:02d}.txt", T)


@pytest.mark.parametrize(
    "write",
    [write_visp, write_zivid, write_rows_of_matrices, write_poses_and_targets],
)
def test_a_folder_with_a_file_for_each_pose(write, both_poses, tmp_path):
    for stop, (robot, target) in enumerate(zip(*both_poses, strict=True)):
        write(tmp_path, stop, robot, target)
    read = read_arm_samples(tmp_path)
    assert_allclose([read.robot, read.tracking], both_poses, atol=1e-9)


def test_a_folder_of_poses_is_calibrated(both_poses, tmp_path, capsys):
    for stop, (robot, target) in enumerate(zip(*both_poses, strict=True)):
        write_visp(tmp_path, stop, robot, target)
    main(["calibrate", str(tmp_path)])
    assert "camera in hand" in capsys.readouterr().out


def test_a_stop_without_both_poses_is_named(both_poses, tmp_path):
    for stop in range(4):
        write_visp(tmp_path, stop, both_poses[0][stop], both_poses[1][stop])
    (tmp_path / "pose_cPo_2.yaml").unlink()
    with pytest.raises(
        InputError, match="each stop needs both poses; incomplete: 2"
    ):
        read_arm_samples(tmp_path)


# ---- arguments of OpenCV in a FileStorage

ARGUMENTS = ("R_gripper2base", "t_gripper2base", "R_target2cam", "t_target2cam")


def opencv_matrix(values):
    rows = np.atleast_2d(values)
    numbers = ", ".join(repr(float(value)) for value in rows.ravel())
    size = f"rows: {len(rows)}\n      cols: 3"
    return (
        f"!!opencv-matrix\n      {size}\n      dt: d\n      data: [{numbers}]"
    )


def one_matrix(name, stack):
    return f"{name}: {opencv_matrix(stack.reshape(-1, 3))}\n"


def a_matrix_for_each_stop(name, stack):
    return f"{name}:\n" + "".join(
        f"   - {opencv_matrix(values)}\n" for values in stack
    )


def a_name_for_each_stop(name, stack):
    items = [
        f"{name}_{stop}: {opencv_matrix(values)}\n"
        for stop, values in enumerate(stack)
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
        write(name, stack)
        for name, stack in zip(ARGUMENTS, stacks, strict=True)
    )
    path = tmp_path / "samples.yaml"
    path.write_text(f"%YAML:1.0\n---\n{text}")
    read = read_arm_samples(path)
    assert_allclose([read.robot, read.tracking], both_poses, atol=1e-9)


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
    assert_allclose([read.robot, read.tracking], both_poses, atol=1e-12)
    np.savez(file, first=np.eye(4))
    with pytest.raises(InputError, match="expected samples of an arm"):
        read_arm_samples(file)
    file.write_bytes(b"PK and no more")
    with pytest.raises(InputError, match=r"cannot read .*arm\.npz"):
        read_arm_samples(file)
