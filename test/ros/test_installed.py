"""The node against what is installed: compared while it calibrates, and watched by the monitor."""

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from ros_harness import RELIABLE_INPUTS, T_PARENT_CHILD, drive, values_of

from hand_eye_calib.geometry import se3
from hand_eye_calib.io.results import load_result

NUMBERS = " ".join(
    f"{value:.9f}"
    for value in (*T_PARENT_CHILD[:3, 3], *se3.rotation_to_rpy(T_PARENT_CHILD[:3, :3]))
)


@pytest.fixture
def status(peer):
    """``status(part, condition)``: the first status of a part that meets a condition."""
    statuses = peer.diagnostics()

    def wait(part, condition):
        name = f"/calibrator: {part}"
        peer.spin_until(lambda: name in statuses and condition(statuses[name]), f"such a {part}")
        return statuses[name], values_of(statuses[name])

    return wait


def noisy(stamps_ns, Ts_pw_p, Ts_cw_c):
    noise = np.random.default_rng(0).normal(size=(2, len(stamps_ns), 6)) * 1e-3
    return stamps_ns, Ts_pw_p @ se3.exp(noise[0]), Ts_cw_c @ se3.exp(noise[1])


def test_a_result_is_compared_with_what_is_installed(start_node, peer, status, tmp_path):
    moved = NUMBERS.split()
    moved[2] = f"{float(moved[2]) + 0.2:.6f}"
    start_node(
        "-p solve_period:=0.3", f"-p installed:={' '.join(moved)}",
        f"-p output_directory:={tmp_path}", "-p report:=false", *RELIABLE_INPUTS,
    )  # fmt: skip
    peer.solve(peer.publishers(), *noisy(*drive(400)))

    def is_told(each):
        told = values_of(each)
        # Not the one of an early solve, of a few poses.
        return (
            told.get("comparison.verdict") == "moved" and float(told["comparison.sigma.z"]) < 0.02
        )

    _, values = status("progress", is_told)
    assert float(values["comparison.difference.z"]) == pytest.approx(-0.2, abs=0.02)
    assert float(values["comparison.values.z"]) == pytest.approx(float(moved[2]))
    assert float(values["comparison.sigma.z"]) > 0
    assert peer.trigger("save").success
    saved = load_result(tmp_path)
    assert saved.comparison.verdict == "moved"
    assert saved.goal.axes["x"].target == 0.02


def test_the_monitor_learns_then_is_quiet_and_raises_an_alarm_when_the_mount_moves(
    start_node, peer, status, tmp_path
):
    node = start_node(
        "-p monitor:=true", f"-p installed:={NUMBERS}", f"-p output_directory:={tmp_path}",
        *RELIABLE_INPUTS,
    )  # fmt: skip
    publishers = peer.publishers()
    stamps_ns, Ts_pw_p, Ts_cw_c = noisy(*drive(2600))
    peer.feed(publishers, stamps_ns[:1800], Ts_pw_p[:1800], Ts_cw_c[:1800])
    quiet, values = status("mount", lambda each: "has not moved" in each.message)
    assert quiet.level == DiagnosticStatus.OK
    assert all(float(values[f"visible_10min.{axis}"]) < 0.02 for axis in ("x", "y", "z", "yaw"))
    knocked = se3.exp(np.array([0, 0, 0, 0, 0, np.radians(1.0)]))
    peer.feed(publishers, stamps_ns[1800:2400], Ts_pw_p[1800:2400], Ts_cw_c[1800:2400] @ knocked)
    alarm, values = status("mount", lambda each: each.level == DiagnosticStatus.ERROR)
    assert alarm.message.startswith("the mount has moved: ")
    since_s = (int(values["since_ns"]) - stamps_ns[1800]) * 1e-9
    assert abs(since_s) < 10.0
    node.wait_for_log("the mount has moved: ")
    assert peer.trigger("reset").success
    peer.feed(publishers, stamps_ns[2400:], Ts_pw_p[2400:], Ts_cw_c[2400:])
    again, _ = status("mount", lambda each: "learning the noise" in each.message)
    assert again.level == DiagnosticStatus.OK
    assert "extrinsic" not in node.log
    assert not (tmp_path / "journal").exists()


def test_a_wrong_path_to_what_is_installed_ends_the_start_in_one_line(start_node, tmp_path):
    path = tmp_path / "robot.urdf"
    node = start_node("-p monitor:=true", f"-p installed:={path}")
    assert node.wait() == 1
    assert node.log == (
        "calibrator: what is installed must be a file that exists (URDF, extrinsic.yaml, bag) or "
        "six numbers in m and rad: installed must be X Y Z ROLL PITCH YAW; "
        f"got '{path}'\n"
    )


def test_frames_that_are_not_in_what_is_installed_are_said(start_node, peer, status, tmp_path):
    (tmp_path / "robot.urdf").write_text(
        '<robot name="r"><link name="base"/><link name="lidar"/><joint name="j" type="fixed">'
        '<parent link="base"/><child link="lidar"/></joint></robot>'
    )
    start_node("-p monitor:=true", f"-p installed:={tmp_path / 'robot.urdf'}", *RELIABLE_INPUTS)
    early, _ = status("mount", lambda each: True)
    assert early.message == "no poses yet"
    peer.feed(peer.publishers(), *drive(100))
    mount, _ = status("mount", lambda each: "what is installed is not known" in each.message)
    assert mount.level == DiagnosticStatus.WARN
    assert "no frame 'camera'" in mount.message
