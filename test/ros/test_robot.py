"""What is installed and the base frame, from transforms as they come in; no middleware needed."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from result_making import SHIFTED_FROM as X
from result_making import shifted

from hand_eye_calib.config import NodeConfig
from hand_eye_calib.geometry import se3
from hand_eye_calib.live.log import NodeLog
from hand_eye_calib.results.calibration import DofObservability, DofVerdict
from hand_eye_calib.ros import tf as module
from hand_eye_calib.ros.conversions import to_transform
from hand_eye_calib.ros.tf import STATIC_TOPIC, Robot, RobotTree

LIDAR = se3.from_rotation_translation(se3.rotation_from_rpy([0.1, 0.0, 0.5]), [1.0, 0.0, 2.0])


def edge(parent, child, T):
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    place, rotation = message.transform.translation, message.transform.rotation
    place.x, place.y, place.z = T[:3, 3].tolist()
    rotation.x, rotation.y, rotation.z, rotation.w = se3.to_quat_xyzw(T).tolist()
    return message


class Heard:
    """A node that only subscribes, and a log that only remembers."""

    def __init__(self, monkeypatch, **options):
        monkeypatch.setattr(module, "message_type", lambda: object)
        self.lines, self._callbacks = [], []
        logger = SimpleNamespace(**dict.fromkeys(("info", "warning", "error"), self.lines.append))
        log = NodeLog(logger)
        tree = RobotTree(self, log)
        tree.listen(STATIC_TOPIC)
        self.own, self.robot = tree.own, Robot(log, NodeConfig(**options), tree)

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
    assert "base_frame base_link is not known from /tf_static" in heard.lines[-1]
    heard.hear(edge("base_link", "mast", LIDAR), edge("mast", "lidar", np.eye(4)))
    found = heard.robot.complete(result())
    np.testing.assert_allclose(found.T_base_child, LIDAR @ X, atol=1e-12)
    broadcast = to_transform(found, is_mounting=True)
    assert (broadcast.header.frame_id, broadcast.child_frame_id) == ("base_link", "camera")
    assert broadcast.transform.translation.x == pytest.approx((LIDAR @ X)[0, 3])


def test_what_is_installed_comes_from_tf_but_not_from_the_node_itself(monkeypatch):
    heard = Heard(monkeypatch, installed="tf")
    own = edge("base_link", "camera", np.eye(4))
    heard.own.append(own)
    heard.hear(edge("base_link", "lidar", LIDAR), own)
    assert heard.robot.complete(result()).comparison is None
    assert "no frame 'camera'" in heard.robot.problem
    assert "what is installed is not known" in heard.robot.why_not_compared
    heard.hear(edge("base_link", "camera", LIDAR @ X))
    assert heard.robot.complete(result()).comparison.verdict == "same"
    assert heard.robot.problem == ""


def test_the_one_axis_that_motion_does_not_show_is_that_of_what_is_installed(monkeypatch):
    found = result()
    dofs = [*found.observability]
    dofs[2] = DofObservability("z", DofVerdict.UNOBSERVABLE, np.inf)
    covariance = np.eye(6) * 1e-6
    R = found.T_parent_child[:3, :3]
    covariance[:3, :3] += 9.0 * np.outer(R[2], R[2])
    hidden = dataclasses.replace(found, observability=tuple(dofs), covariance=covariance)
    heard = Heard(monkeypatch, installed="7 8 9 0 0 0")
    T = heard.robot.complete(hidden).T_parent_child
    np.testing.assert_allclose(T[:2, 3], found.T_parent_child[:2, 3], atol=1e-4)
    assert T[2, 3] == pytest.approx(9.0)
    assert "z is that of what is installed (7 8" in heard.robot.complete(hidden).warnings[-1]
    np.testing.assert_array_equal(heard.robot.complete(found).T_parent_child, found.T_parent_child)


def test_an_unusable_transform_is_said(monkeypatch):
    heard = Heard(monkeypatch, base_frame="base_link")
    bad = edge("base_link", "lidar", LIDAR)
    bad.transform.rotation.w = 0.0
    bad.transform.rotation.x = bad.transform.rotation.y = bad.transform.rotation.z = 0.0
    heard.hear(bad)
    assert "unusable transform of lidar" in heard.lines[-1]
    assert heard.robot.complete(result()).base_frame == ""
