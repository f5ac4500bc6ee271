"""What is broadcast on /tf_static, and what is not."""

import dataclasses
import itertools
import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from motions import as_trajectory, child_of, feed, wandering_poses
from ros_harness import LATCHED, RELIABLE_INPUTS, drive

from hand_eye_calib.calibration import DofVerdict
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.geometry import se3
from hand_eye_calib.ros import tf
from hand_eye_calib.ros.log import NodeLog
from hand_eye_calib.ros.settled import RESULTS, SPAN_S, SettledRule
from hand_eye_calib.ros.tf import FrameTree


class TestFrameTree:
    @staticmethod
    def tree(*edges):
        made = FrameTree()
        for parent, child in edges:
            made.add(parent, child, "/tf_static")
        return made

    def test_a_free_child_frame_is_fine(self):
        tree = self.tree(("base_link", "lidar"), ("map", "base_link"))
        assert tree.what_forbids("lidar", "camera") == ""

    def test_a_second_parent_is_not(self):
        tree = self.tree(("base_link", "lidar"), ("base_link", "camera"))
        assert tree.what_forbids("lidar", "camera").startswith(
            "camera has the parent base_link on /tf_static already"
        )

    def test_the_same_edge_from_another_node_is_not(self):
        tree = self.tree(("lidar", "camera"))
        assert "from another node" in tree.what_forbids("lidar", "camera")

    def test_a_circle_is_not(self):
        tree = self.tree(("camera", "mount"), ("mount", "lidar"))
        assert "would close a circle" in tree.what_forbids("lidar", "camera")

    def test_a_circle_of_others_is_no_endless_loop(self):
        tree = self.tree(("a", "lidar"), ("lidar", "a"))
        assert tree.what_forbids("lidar", "camera") == ""


@pytest.fixture(scope="module")
def calibration():
    calibrator = Calibrator(CalibratorConfig(reference="B3"))
    noise = se3.exp(np.random.default_rng(0).normal(size=(150, 6)) * 1e-3)
    parent = wandering_poses(150)
    for stream, poses in (("parent", parent @ noise), ("child", child_of(parent))):
        feed(calibrator, stream, as_trajectory(poses))
    return calibrator.estimate()


class TestSettledRule:
    @staticmethod
    def later(calibration, k, shift_sigmas=0.0):
        shift = np.zeros(6)
        shift[2] = shift_sigmas * np.sqrt(calibration.covariance[2, 2])
        step_ns = round(k * SPAN_S / (RESULTS - 1) * 1e9)
        return dataclasses.replace(
            calibration,
            T_parent_child=calibration.T_parent_child @ se3.exp(shift),
            stamp_ns=calibration.stamp_ns + step_ns,
        )

    def rule(self, calibration, shifts):
        made = SettledRule()
        for k, shift in enumerate(shifts):
            made.add(self.later(calibration, k, shift))
        return made

    def test_results_that_agree_settle(self, calibration):
        assert self.rule(calibration, [0, 0.5, -0.4, 0.3, 0]).what_is_missing() == ""

    def test_too_few_do_not(self, calibration):
        missing = self.rule(calibration, [0] * (RESULTS - 1)).what_is_missing()
        assert missing == f"{RESULTS - 1} results over 8 s, it takes {RESULTS} over 10 s"

    def test_results_that_wander_do_not(self, calibration):
        assert "differ" in self.rule(calibration, [0, 1.5, 0, 0, 0]).what_is_missing()

    def test_a_weak_axis_does_not(self, calibration):
        rule = self.rule(calibration, [0] * RESULTS)
        weak = dataclasses.replace(calibration.observability[2], verdict=DofVerdict.WEAK)
        dofs = (*calibration.observability[:2], weak, *calibration.observability[3:])
        rule.add(dataclasses.replace(self.later(calibration, RESULTS), observability=dofs))
        assert rule.what_is_missing() == "z only weakly observable"

    def test_faulty_streams_do_not_and_a_new_session_begins_anew(self, calibration):
        rule = self.rule(calibration, [0] * RESULTS)
        assert "the child's lengths" in rule.what_is_missing(("the child's lengths are feet",))
        rule.restart()
        assert rule.what_is_missing() == "no result yet"


class TestNode:
    """On the real topics, wherever tf2_msgs is installed."""

    @pytest.fixture
    def kind(self):
        return pytest.importorskip("tf2_msgs.msg").TFMessage

    @pytest.fixture
    def listen(self, kind, peer):
        def start():
            heard = []
            peer.node.create_subscription(
                kind, "/tf_static", lambda message: heard.extend(message.transforms), LATCHED
            )
            return heard

        return start

    @pytest.fixture
    def robot(self, kind, peer):
        """Publishes the robot's own static edges."""

        def publish(*edges):
            publisher = peer.node.create_publisher(kind, "/tf_static", LATCHED)
            transforms = [TransformStamped(child_frame_id=child) for _, child in edges]
            for transform, (parent, _) in zip(transforms, edges, strict=True):
                transform.header.frame_id = parent
            publisher.publish(kind(transforms=transforms))

        return publish

    @pytest.fixture
    def said(self, peer):
        """Newest message of the extrinsic's status."""
        newest = {}

        def take(array):
            newest.update({each.name.rpartition(": ")[2]: each for each in array.status})

        peer.node.create_subscription(DiagnosticArray, "/diagnostics", take, 10)
        return newest

    @staticmethod
    def play(peer, condition, what):
        """Feed a drive until something happens."""
        publishers = peer.publishers()
        peer.wait_matched(*publishers)
        poses = drive(1200, period_ns=50_000_000)
        blocks = (slice(start, start + 20) for start in itertools.count(0, 20))
        due = [time.monotonic()]

        def check():
            if time.monotonic() >= due[0]:
                due[0] += 0.2  # five times as fast as recorded
                block = next(blocks)
                peer.feed(publishers, *(part[block] for part in poses))
            return condition()

        peer.spin_until(check, what)

    ON = ("-p publish_tf:=true", "-p solve_period:=0.5", *RELIABLE_INPUTS)

    def test_a_settled_result_is_broadcast_and_a_reset_withdraws_it(
        self, start_node, peer, listen, robot
    ):
        robot(("base_link", "lidar"))
        heard, extrinsics = listen(), peer.listen(TransformStamped, "extrinsic")
        start_node(*self.ON)

        def edges(found):
            return [each for each in found if each.child_frame_id == "camera"]

        self.play(peer, lambda: edges(heard), "the edge")
        assert edges(heard)[0].header.frame_id == "lidar"
        assert len(extrinsics) >= RESULTS  # those before were not broadcast
        assert peer.trigger("reset").success
        late = listen()
        peer.spin_until(lambda: late, "the robot's edge")
        time.sleep(0.5)
        assert not edges(late)

    def test_a_frame_that_has_a_parent_is_refused_loudly(
        self, start_node, peer, listen, robot, said
    ):
        robot(("base_link", "lidar"), ("base_link", "camera"))
        node = start_node(*self.ON)
        heard = listen()

        def refused():
            status = said.get("extrinsic")
            return status and status.message.startswith("publish_tf is refused: camera has the")

        self.play(peer, refused, "the refusal")
        assert said["extrinsic"].level == DiagnosticStatus.WARN
        node.wait_for_log("[ERROR]", "publish_tf is refused: camera has the parent base_link")
        assert {each.header.frame_id for each in heard} == {"base_link"}

    def test_a_parent_that_comes_later_ends_the_broadcast(self, start_node, peer, listen, robot):
        node = start_node(*self.ON)
        heard = listen()
        self.play(peer, lambda: heard, "the edge")
        robot(("base_link", "camera"))
        node.wait_for_log("publish_tf is refused: camera has the parent base_link", "withdrawn")

    @pytest.fixture
    def broadcaster(self, kind, peer, calibration, monkeypatch):
        """In the peer's own node, switched on, with a result that has settled."""
        monkeypatch.setattr(tf, "LOOK_S", 0.0)
        made = tf.TfBroadcaster(peer.node, NodeLog(peer.node.get_logger()))
        made.switch(True)
        yield made
        made.switch(False)

    @staticmethod
    def settle(broadcaster, calibration):
        for k in range(RESULTS):
            broadcaster.add(TestSettledRule.later(calibration, k), ())

    @staticmethod
    def frames_of_new_listener(peer, listen, until):
        heard = listen()
        peer.spin_until(lambda: until in {each.child_frame_id for each in heard}, until)
        return {each.child_frame_id for each in heard}

    def test_further_children_are_in_the_same_message(self, peer, listen, broadcaster, calibration):
        rear, side = (
            dataclasses.replace(calibration, child_frame=name) for name in ("rear", "side")
        )
        weak = dataclasses.replace(calibration.observability[2], verdict=DofVerdict.WEAK)
        dofs = (*calibration.observability[:2], weak, *calibration.observability[3:])
        broadcaster.add_others([rear, dataclasses.replace(side, observability=dofs)])
        assert broadcaster.state == "not yet: no result yet"
        self.settle(broadcaster, calibration)
        child = calibration.child_frame
        assert self.frames_of_new_listener(peer, listen, "rear") == {child, "rear"}
        assert broadcaster.refused == ""
        broadcaster.restart()
        self.settle(broadcaster, calibration)
        assert self.frames_of_new_listener(peer, listen, child) == {child}

    def test_a_further_child_that_has_a_parent_is_refused_alone(
        self, peer, listen, robot, broadcaster, calibration
    ):
        robot(("base_link", "rear"))
        self.frames_of_new_listener(peer, listen, "rear")
        child = calibration.child_frame
        others = [dataclasses.replace(calibration, child_frame=name) for name in ("rear", "side")]
        self.settle(broadcaster, calibration)
        broadcaster.add_others(others)
        assert broadcaster.refused.startswith("rear has the parent base_link on /tf_static")
        assert broadcaster.state.startswith("broadcast; rear has the parent")
        heard = listen()
        peer.spin_until(lambda: {each.child_frame_id for each in heard} >= {child, "side"}, "both")
        robot(("base_link", "side"))
        peer.spin_until(lambda: "side has the parent base_link" in broadcaster.refused, "refusal")
        late = listen()
        peer.spin_until(lambda: child in {each.child_frame_id for each in late}, "the child")
        assert (calibration.parent_frame, "side") not in {
            (each.header.frame_id, each.child_frame_id) for each in late
        }
