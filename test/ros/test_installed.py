"""The node against what is installed: compared while it calibrates, and watched by the monitor."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from numpy.testing import assert_allclose, assert_array_equal
from result_making import SHIFTED_FROM as X
from result_making import shifted
from ros_harness import RELIABLE_INPUTS, T_PARENT_CHILD, drive, values_of

from hand_eye_calib.core.base.config import NodeConfig
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import DofObservability, DofVerdict
from hand_eye_calib.extras.mount.digest import read_digest
from hand_eye_calib.formats.results import load_result
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.ros import tf as module
from hand_eye_calib.online.ros.conversions import to_transform
from hand_eye_calib.online.ros.tf import STATIC_TOPIC, Robot, RobotTree

NUMBERS = " ".join(
    f"{value:.9f}"
    for value in (
        *T_PARENT_CHILD[:3, 3],
        *se3.rotation_to_rpy(T_PARENT_CHILD[:3, :3]),
    )
)


@pytest.fixture
def status(peer):
    """``status(part, condition)``: the first status of a part that meets a condition."""
    statuses = peer.diagnostics()

    def wait(name, condition):
        name = f"/calibrator: {name}"
        peer.spin_until(
            lambda: name in statuses and condition(statuses[name]),
            f"such a {name}",
        )
        return statuses[name], values_of(statuses[name])

    return wait


def noisy(stamps_ns, Ts_pw_p, Ts_cw_c):
    noise = np.random.default_rng(0).normal(size=(2, len(stamps_ns), 6)) * 1e-3
    return stamps_ns, Ts_pw_p @ se3.exp(noise[0]), Ts_cw_c @ se3.exp(noise[1])


def test_a_result_is_compared_with_what_is_installed(
    start_node, peer, status, tmp_path
):
    moved = NUMBERS.split()
    moved[2] = f"{float(moved[2]) + 0.2:.6f}"
    start_node(
        "-p solve_period:=0.3", f"-p installed:={' '.join(moved)}",
        f"-p output_directory:={tmp_path}", "-p report:=false", *RELIABLE_INPUTS,
    )  # fmt: skip
    peer.solve(peer.publishers(), *noisy(*drive(400)))

    def is_told(status):
        of = values_of(status)
        # Not the one of an early solve, of a few poses.
        return (
            of.get("comparison.verdict") == "moved"
            and float(of["comparison.sigma.z"]) < 0.02
        )

    _, values = status("progress", is_told)
    assert float(values["comparison.difference.z"]) == pytest.approx(
        -0.2, abs=0.02
    )
    assert float(values["comparison.values.z"]) == pytest.approx(
        float(moved[2])
    )
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
    quiet, values = status(
        "mount", lambda status: "has not moved" in status.message
    )
    assert quiet.level == DiagnosticStatus.OK
    assert all(
        float(values[f"visible_10min.{axis}"]) < 0.02
        for axis in ("x", "y", "z", "about_z")
    )
    knocked = se3.exp(np.array([0, 0, 0, 0, 0, np.radians(1.0)]))
    peer.feed(
        publishers,
        stamps_ns[1800:2400],
        Ts_pw_p[1800:2400],
        Ts_cw_c[1800:2400] @ knocked,
    )
    alarm, values = status(
        "mount", lambda status: status.level == DiagnosticStatus.ERROR
    )
    assert alarm.message.startswith("the mount has moved: ")
    since_s = (int(values["since_ns"]) - stamps_ns[1800]) * 1e-9
    assert abs(since_s) < 10.0
    node.wait_for_log("the mount has moved: ")
    assert peer.trigger("save").success
    (digest,) = (tmp_path / "digests").iterdir()
    assert " by " in read_digest(digest).alarm
    assert peer.trigger("reset").success
    peer.feed(publishers, stamps_ns[2400:], Ts_pw_p[2400:], Ts_cw_c[2400:])
    again, _ = status(
        "mount", lambda status: "learning the noise" in status.message
    )
    assert again.level == DiagnosticStatus.OK
    assert "extrinsic" not in node.log
    assert not (tmp_path / "journal").exists()


def test_a_wrong_path_to_what_is_installed_ends_the_start_in_one_line(
    start_node,
):
    node = start_node("-p monitor:=true", "-p installed:=robot.urdf")
    assert node.wait() == 1
    assert node.log == (
        "calibrator: installed: no file 'robot.urdf'; expected a URDF, extrinsic.yaml, a bag, or "
        "X Y Z ROLL PITCH YAW in m and rad\n"
    )


def test_frames_that_are_not_in_what_is_installed_are_said(
    start_node, peer, status, tmp_path
):
    (tmp_path / "robot.urdf").write_text(
        '<robot name="r"><link name="base"/><link name="lidar"/><joint name="j" type="fixed">'
        '<parent link="base"/><child link="lidar"/></joint></robot>'
    )
    start_node(
        "-p monitor:=true",
        f"-p installed:={tmp_path / 'robot.urdf'}",
        *RELIABLE_INPUTS,
    )
    early, _ = status("mount", lambda status: True)
    assert early.message == "no poses yet"
    peer.feed(peer.publishers(), *drive(100))
    mount, _ = status(
        "mount",
        lambda status: "the installed transform is unknown" in status.message,
    )
    assert mount.level == DiagnosticStatus.WARN
    assert "no frame 'camera'" in mount.message


# ---- the robot's own frames


LIDAR = se3.from_rotation_translation(
    se3.rotation_from_rpy([0.1, 0.0, 0.5]), [1.0, 0.0, 2.0]
)


def edge(parent, child, T):
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    place = message.transform.translation
    rotation = message.transform.rotation
    place.x, place.y, place.z = T[:3, 3].tolist()
    rotation.x, rotation.y, rotation.z, rotation.w = se3.to_quat_xyzw(
        T
    ).tolist()
    return message


class Heard:
    """A node that only subscribes, and a log that only remembers."""

    def __init__(self, monkeypatch, **options):
        monkeypatch.setattr(module, "message_type", lambda: object)
        self.lines = []
        self._callbacks = []
        logger = SimpleNamespace(
            **dict.fromkeys(("info", "warning", "error"), self.lines.append)
        )
        log = NodeLog(logger)
        tree = RobotTree(self, log)
        tree.listen(STATIC_TOPIC)
        self.own = tree.own
        self.robot = Robot(log, NodeConfig(**options), tree)

    def create_subscription(self, kind, topic, callback, qos):
        assert topic == "/tf_static"
        self._callbacks.append(callback)

    def hear(self, *edges):
        for callback in self._callbacks:
            callback(SimpleNamespace(transforms=edges))


def result(**fields):
    return shifted(parent_frame="lidar", child_frame="camera", **fields)


def test_the_base_frame_comes_from_tf(monkeypatch):
    heard = Heard(monkeypatch, base_frame="base_link")
    early = heard.robot.complete(result())
    assert early.base_frame == ""
    assert (
        "base_frame base_link is not known from /tf_static" in heard.lines[-1]
    )
    heard.hear(
        edge("base_link", "mast", LIDAR), edge("mast", "lidar", np.eye(4))
    )
    mounting = heard.robot.complete(result())
    assert_allclose(mounting.T_base_child, LIDAR @ X, atol=1e-12)
    broadcast = to_transform(mounting, is_mounting=True)
    assert (broadcast.header.frame_id, broadcast.child_frame_id) == (
        "base_link",
        "camera",
    )
    assert broadcast.transform.translation.x == pytest.approx((LIDAR @ X)[0, 3])


def test_what_is_installed_comes_from_tf_but_not_from_the_node_itself(
    monkeypatch,
):
    heard = Heard(monkeypatch, installed="tf")
    own = edge("base_link", "camera", np.eye(4))
    heard.own.append(own)
    heard.hear(edge("base_link", "lidar", LIDAR), own)
    assert heard.robot.complete(result()).comparison is None
    assert "no frame 'camera'" in heard.robot.problem
    assert "the installed transform is unknown" in heard.robot.why_not_compared
    heard.hear(edge("base_link", "camera", LIDAR @ X))
    assert heard.robot.complete(result()).comparison.verdict == "same"
    assert heard.robot.problem == ""


def test_the_one_axis_that_motion_does_not_show_is_that_of_what_is_installed(
    monkeypatch,
):
    known_pose = result()
    dofs = [*known_pose.observability_measured]
    dofs[2] = DofObservability("z", DofVerdict.UNOBSERVABLE, np.inf)
    covariance = np.eye(6) * 1e-6
    R = known_pose.T_parent_child[:3, :3]
    covariance[:3, :3] += 9.0 * np.outer(R[2], R[2])
    hidden = dataclasses.replace(
        known_pose,
        observability_measured=tuple(dofs),
        covariance_measured=covariance,
    )
    heard = Heard(monkeypatch, installed="7m 8m 9m 0 0 0")
    T = heard.robot.complete(hidden).T_parent_child
    assert_allclose(T[:2, 3], known_pose.T_parent_child[:2, 3], atol=1e-4)
    assert T[2, 3] == pytest.approx(9.0)
    assert (
        "z is taken from the installed transform: the motion does not determine it"
        in heard.robot.complete(hidden).warnings[-1]
    )
    assert_array_equal(
        heard.robot.complete(known_pose).T_parent_child,
        known_pose.T_parent_child,
    )


def test_an_unusable_transform_is_said(monkeypatch):
    heard = Heard(monkeypatch, base_frame="base_link")
    bad = edge("base_link", "lidar", LIDAR)
    bad.transform.rotation.w = 0.0
    bad.transform.rotation.x = bad.transform.rotation.y = (
        bad.transform.rotation.z
    ) = 0.0
    heard.hear(bad)
    assert "unusable transform of lidar" in heard.lines[-1]
    assert heard.robot.complete(result()).base_frame == ""
