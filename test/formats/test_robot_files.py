"""Files of a result for a robot: a fixed joint in xacro, and a launch file."""

import ast
import re
import shlex
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from result_making import calibration, good_calibration

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.results import save_result

AWKWARD = {
    "parent_frame": 'li"dar & <${x}>',
    "child_frame": "caméra -- 'left' \\ side",
}


def test_the_xacro_file_is_a_fixed_joint_with_the_extrinsic(tmp_path):
    written = good_calibration(**AWKWARD)
    save_result(written, tmp_path)
    root = ElementTree.parse(tmp_path / "extrinsic.urdf.xacro").getroot()
    (joint,) = root
    assert (root.tag, joint.tag, joint.get("type")) == (
        "robot",
        "joint",
        "fixed",
    )
    assert (
        joint.find("parent").get("link").replace("$$", "$")
        == written.parent_frame
    )
    assert joint.find("child").get("link") == written.child_frame
    xyz, rpy = (
        np.array(joint.find("origin").get(name).split(), dtype=float)
        for name in ("xyz", "rpy")
    )
    roll, pitch, yaw = (
        se3.rotation_exp(angle * axis)
        for angle, axis in zip(rpy, np.eye(3), strict=True)
    )
    assert yaw @ pitch @ roll == pytest.approx(
        written.T_parent_child[:3, :3], abs=1e-12
    )
    assert_array_equal(xyz, written.T_parent_child[:3, 3])


def test_the_launch_file_compiles_and_publishes_the_extrinsic(tmp_path):
    written = good_calibration(**AWKWARD)
    save_result(written, tmp_path)
    text = (tmp_path / "static_transform.launch.py").read_text(encoding="utf-8")
    compile(text, "static_transform.launch.py", "exec")
    tree = ast.parse(text)
    calls = {
        node.func.id: node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
    }
    assert set(calls) == {"LaunchDescription", "Node"}
    (transforms,) = (
        ast.literal_eval(statement.value)
        for statement in tree.body
        if hasattr(statement, "value")
    )
    assert f"# {written.headline}\n" in text
    node = {
        keyword.arg: ast.unparse(keyword.value)
        for keyword in calls["Node"].keywords
    }
    program = {
        "package": "'tf2_ros'",
        "executable": "'static_transform_publisher'",
    }
    assert node == program | {"arguments": "each"}
    (arguments,) = transforms
    options = dict(zip(arguments[::2], arguments[1::2], strict=True))
    assert (options.pop("--frame-id"), options.pop("--child-frame-id")) == (
        written.parent_frame,
        written.child_frame,
    )
    values = [
        float(options.pop(f"--{name}"))
        for name in ("x", "y", "z", "qx", "qy", "qz", "qw")
    ]
    assert options == {}
    assert_allclose(
        se3.from_quat_xyzw(values[:3], values[3:]),
        written.T_parent_child,
        atol=1e-11,
    )
    typed = shlex.split(written.static_transform_command())
    assert typed[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    assert_allclose(list(map(float, typed[5:18:2])), values, atol=1e-9)
    assert (typed[4::2], typed[-1]) == (arguments[::2], written.child_frame)


ROBOT_FILES = ("extrinsic.urdf.xacro", "static_transform.launch.py")


def test_an_unknown_axis_is_nothing_that_a_robot_takes(tmp_path):
    save_result(calibration(), tmp_path)
    xacro, launch = (
        (tmp_path / name).read_text(encoding="utf-8") for name in ROBOT_FILES
    )
    assert all(
        "USE WITH CARE: all but z; measure z by hand" in text
        for text in (xacro, launch)
    )
    xyz = re.search(r'xyz="(.*?)"', xacro)[1].split()
    assert xyz[2] == "MEASURE_Z_BY_HAND"
    assert (
        list(map(float, xyz[:2]))
        == calibration().T_parent_child[:2, 3].tolist()
    )
    assert "'--z', 'MEASURE_Z_BY_HAND'" in launch
