"""Samples of arms as other tools write them."""

import json

import numpy as np
import pytest

from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.stops import read_arm_samples

N = 4


@pytest.fixture
def poses():
    random = np.random.default_rng(0)
    return [se3.exp(random.normal(size=(N, 6))) for _ in range(2)]


def transform(T):
    x, y, z, w = se3.to_quat_xyzw(T).tolist()
    return {
        "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
        "rotation": {"x": x, "y": y, "z": z, "w": w},
    }


def opencv(poses):
    text = f"%YAML:1.0\n---\nframeCount: {N}\n"
    for k in range(N):
        for name, Ts in zip(("T1", "T2"), poses, strict=True):
            numbers = ", ".join(f"{x:.17e}" for x in Ts[k].ravel())
            text += f"{name}_{k}: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: d\n"
            text += f"   data: [ {numbers} ]\n"
    return text


def easy_handeye2(poses):
    parameters = {"robot_effector_frame": "tool0", "tracking_base_frame": "camera"}
    samples = [
        {"robot": transform(a), "tracking": transform(b)} for a, b in zip(*poses, strict=True)
    ]
    return json.dumps({"parameters": parameters, "samples": samples})


def moveit_yaml(poses):
    names = ("effector_wrt_world", "object_wrt_sensor")
    rows = (
        dict(zip(names, (a.ravel().tolist(), b.ravel().tolist()), strict=True))
        for a, b in zip(*poses, strict=False)
    )
    return json.dumps(list(rows))


def moveit_json(poses):
    return json.dumps([[a.tolist(), b.tolist()] for a, b in zip(*poses, strict=True)])


@pytest.mark.parametrize("written", [opencv, easy_handeye2, moveit_yaml, moveit_json])
def test_files_of_other_tools(written, poses, tmp_path):
    path = tmp_path / "samples.yaml"
    path.write_text(written(poses))
    read = read_arm_samples(path)
    np.testing.assert_allclose(read.robot, poses[0], atol=1e-12)
    np.testing.assert_allclose(read.tracking, poses[1], atol=1e-12)
    frames = {"hand": "tool0", "camera": "camera"} if written is easy_handeye2 else {}
    assert read.frames == frames


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "expected samples of an arm"),
        ("a: 1", "expected samples of an arm"),
        ("[1, 2]", "sample 1: expected samples of an arm"),
        ("[[1, 2]]", "sample 1: expected a pose"),
        ("[{x: 1, y: 2}]", "expected samples of an arm"),
        ("[{robot: {}, tracking: {}}]", "translation and rotation"),
        (json.dumps([[np.eye(4).tolist(), (2 * np.eye(4)).tolist()]]), "the rotation is not one"),
        (json.dumps([[[0] * 7, [0] * 7]]), "a quaternion of length 0"),
        ("[[" + "[.nan" + ", 1" * 15 + "], [.nan]]]", "not finite"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(text, said, tmp_path):
    path = tmp_path / "samples.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=said) as raised:
        read_arm_samples(path)
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("as_rows", [False, True])
def test_two_stacks_in_an_npz(as_rows, poses, tmp_path):
    stacks = [np.c_[Ts[:, :3, 3], se3.to_quat_xyzw(Ts)] for Ts in poses] if as_rows else poses
    file = tmp_path / "arm.npz"
    np.savez(file, robot=stacks[0], tracking=stacks[1])
    read = read_arm_samples(file)
    np.testing.assert_allclose([read.robot, read.tracking], poses, atol=1e-12)
    np.savez(file, first=np.eye(4))
    with pytest.raises(InputError, match="expected samples of an arm"):
        read_arm_samples(file)
    file.write_bytes(b"PK and no more")
    with pytest.raises(InputError, match=r"cannot read .*arm\.npz"):
        read_arm_samples(file)
