"""The command compare, and the options about what is installed, as a person types them."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose
from result_making import SHIFTED_FROM as X
from result_making import shift
from result_making import shifted as result

import hand_eye_calib as hec
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import SolveStatus

pytestmark = pytest.mark.usefixtures("no_figures")

NUMBERS = " ".join(
    f"{value:.6f}" for value in (*X[:3, 3], *se3.rotation_to_rpy(X[:3, :3]))
)


def urdf_of(T):
    xyz, rpy = (
        " ".join(map(repr, values.tolist()))
        for values in (T[:3, 3], se3.rotation_to_rpy(T[:3, :3]))
    )
    return f"""<robot name="r"><link name="base"/>
<joint name="a" type="fixed"><parent link="base"/><child link="lidar"/><origin xyz="1 0 2"/></joint>
<joint name="b" type="fixed"><parent link="lidar"/><child link="camera"/><origin
xyz="{xyz}" rpy="{rpy}"/></joint></robot>"""


@pytest.fixture
def saved(tmp_path, monkeypatch):
    """Folders with results: two that agree, one that has moved; and a description."""
    monkeypatch.chdir(tmp_path)
    frames = {"parent_frame": "lidar", "child_frame": "camera"}
    hec.save(result(seed=1, **frames), "first")
    hec.save(result(seed=2, **frames), "second")
    hec.save(result(shift("y", 0.05), seed=3, **frames), "third")
    flat = {"hidden": "z", "status": SolveStatus.UNOBSERVABLE}
    hec.save(result(seed=4, **flat, **frames), "flat")
    (tmp_path / "robot.urdf").write_text(urdf_of(X))
    return tmp_path


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (
            ["first", "--with", NUMBERS],
            0,
            "Mount of camera on lidar: same: a change of ",
        ),
        (["third", "--with", "robot.urdf"], 4, "moved: y by "),
        (
            ["flat", "--with", "first"],
            3,
            "cannot tell about x, y and z; roll, pitch",
        ),
        (["first", "second"], 0, "same: both agree"),
        (
            ["first", "second", "third"],
            4,
            "moved: third differs from the others: y by ",
        ),
        (["first", "third", "--with", "second"], 4, "moved: third of 2"),
    ],
)
def test_the_exit_code_is_the_verdict(saved, run, words, code, text):
    exit_code, out, err = run("compare", *words)
    assert (exit_code, err) == (code, "")
    assert text in out


def test_json_has_it_all(saved, run):
    code, out, _ = run("compare", "third", "--with", "robot.urdf", "--json")
    document = json.loads(out)
    assert (code, document["verdict"], document["moved"]) == (
        4,
        "moved",
        ["third"],
    )
    (difference,) = document["differences"]
    assert difference["axes"]["y"]["difference"] == pytest.approx(
        0.05, abs=0.01
    )


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (["first"], 1, "two results or more"),
        (["first", "first"], 1, "first appears twice: name each result once"),
        (["first", "--with", "absent.urdf"], 2, "no file 'absent.urdf'"),
        (["absent", "first"], 1, "cannot read absent"),
        (
            ["first", "--with", "1e400 0 0 0 0 0"],
            2,
            "must be at most 1e+06 m; got '1e400'",
        ),
        (
            ["first", "--with", "0 0 0 0 1e300 0"],
            2,
            "must be at most 1e+06 rad; got '1e300'",
        ),
        (["first", "--with", "x" * 5000], 2, "xxx..."),
        (["first", "n" * 256], 1, "n...: File name too long; choose another"),
    ],
)
def test_what_cannot_be_compared_is_one_line(saved, run, words, code, text):
    exit_code, out, err = run("compare", *words)
    assert (exit_code, out, err.count("\n")) == (code, "", 1)
    assert text in err
    assert len(err) < 400


def test_a_calibration_is_compared_and_stated_in_the_base_frame(saved, run):
    assert run("simulate", "--out", "drive")[0] == 0
    drive = saved / "drive" / "run_01"
    truth = np.loadtxt(drive / "T_S2_S1.txt")
    T = se3.from_quat_xyzw(truth[1:4], truth[4:])
    (saved / "true.urdf").write_text(urdf_of(T))
    code, out, _ = run(
        "calibrate", drive / "T_S1_W1.txt", drive / "T_S2_W2.txt", "--installed", "true.urdf",
        "--parent-frame", "lidar", "--child-frame", "camera", "--base-frame", "base", "--json",
    )  # fmt: skip
    document = json.loads(out)
    assert code == 0
    assert document["comparison"]["verdict"] == "same"
    base = se3.from_rotation_translation(np.eye(3), [1.0, 0.0, 2.0])
    in_base = base @ document["T_parent_child"]["matrix"]
    assert_allclose(in_base, base @ T, atol=5e-3)
    assert_allclose(document["T_base_child"]["matrix"], in_base, atol=1e-6)
    saved_result = hec.Calibration.from_dict(document)
    hec.save(saved_result, "in_base")
    assert_allclose(hec.load("in_base").T_base_child, in_base, atol=1e-6)
    assert (
        '<parent link="base"/>'
        in (saved / "in_base" / "extrinsic.urdf.xacro").read_text()
    )
    assert (
        "--frame-id base --child-frame-id camera" in run("info", "in_base")[1]
    )
