"""What is broadcast on /tf_static, and what is not."""

import dataclasses
import json
import time

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from motions import as_trajectory, child_of, feed, wandering_poses
from ros_harness import LATCHED, RELIABLE_INPUTS, drive, matrix, values_of
from std_msgs.msg import String

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.engine.calibrator import Calibrator
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import DofVerdict, SolveStatus
from hand_eye_calib.formats.results import load_result
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.state import Broadcast
from hand_eye_calib.online.ros import tf
from hand_eye_calib.online.ros.tf import RobotTree


@pytest.mark.parametrize(
    ("edges", "why"),
    [
        ([("base_link", "lidar"), ("map", "base_link")], ""),
        (
            [("a", "lidar"), ("lidar", "a")],
            "",
        ),  # a circle of others is no endless loop
        (
            [("base_link", "lidar"), ("base_link", "camera")],
            "camera has the parent base_link on /tf_static already",
        ),
        ([("lidar", "camera")], "from another node"),
        ([("camera", "mount"), ("mount", "lidar")], "would close a circle"),
    ],
)
def test_a_frame_has_one_parent_and_the_tree_no_circle(edges, why):
    tree = RobotTree(None, None)
    for parent, child in edges:
        tree.add(parent, child)
    reason = tree.what_forbids("lidar", "camera")
    assert why in reason if why else reason == ""


@pytest.fixture(scope="module")
def calibration():
    calibrator = Calibrator(CalibratorConfig(reference="B3"))
    noise = se3.exp(np.random.default_rng(0).normal(size=(150, 6)) * 1e-3)
    parent = wandering_poses(150)
    for stream, poses in (
        ("parent", parent @ noise),
        ("child", child_of(parent)),
    ):
        feed(calibrator, stream, as_trajectory(poses))
    return calibrator.estimate()


def edges(transforms):
    """Transforms of the camera among those received."""
    return [
        transform
        for transform in transforms
        if transform.child_frame_id == "camera"
    ]


def fault_in(statuses):
    """Text of the newest progress if the streams have a fault, otherwise empty."""
    newest = statuses.get("/calibrator: progress")
    if newest is None or values_of(newest)["is_faulty"] != "true":
        return ""
    return newest.message


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
                kind,
                "/tf_static",
                lambda message: heard.extend(message.transforms),
                LATCHED,
            )
            return heard

        return start

    @pytest.fixture
    def robot(self, kind, peer):
        """Publishes the robot's own static edges."""

        def publish(*edges):
            publisher = peer.node.create_publisher(kind, "/tf_static", LATCHED)
            transforms = [
                TransformStamped(child_frame_id=child) for _, child in edges
            ]
            for transform, (parent, _) in zip(transforms, edges, strict=True):
                transform.header.frame_id = parent
            publisher.publish(kind(transforms=transforms))

        return publish

    def test_what_is_done_is_broadcast_to_who_stops_then_and_a_reset_withdraws_it(
        self, start_node, peer, listen, robot, tmp_path
    ):
        robot(("base_link", "lidar"))
        heard = listen()
        extrinsics = peer.listen(TransformStamped, "extrinsic")
        states = peer.listen(String, "progress")
        statuses = peer.diagnostics()
        start_node(
            "-p publish_tf:=true", "-p solve_period:=1000.0", f"-p output_directory:={tmp_path}",
            *RELIABLE_INPUTS,
        )  # fmt: skip

        def state(name="extrinsic", key="tf_static"):
            return values_of(statuses[f"/calibrator: {name}"])[key]

        def fault():
            return fault_in(statuses)

        publishers = peer.publishers()
        poses = drive(500)
        peer.solve(publishers, *(half[:250] for half in poses))
        early = "the goal is not reached"
        is_early = lambda: statuses and state(key="tf_static_reason") == early  # noqa: E731
        peer.spin_until(is_early, "the state", fault)
        assert state() == "not_yet"
        peer.solve(publishers, *(half[250:] for half in poses))
        peer.spin_until(
            lambda: state("progress", "done") == "true", "the goal", fault
        )
        # Nothing comes in any more: the two results that reached the goal suffice.
        peer.spin_until(lambda: edges(heard), "the edge")
        peer.spin_until(lambda: state() == "broadcast", "the state")
        assert edges(heard)[0].header.frame_id == "lidar"
        T = matrix(edges(heard)[-1])
        assert pytest.approx(matrix(extrinsics[-1])) == T
        # The answer, the file and the page say the same, and of the same poses.
        answer = peer.trigger("solve").message
        xyz = ", ".join(f"{value:.4f}" for value in T[:3, 3])
        assert f"xyz = ({xyz})" in answer
        assert peer.trigger("save").success
        saved = load_result(tmp_path)
        assert saved.T_parent_child == pytest.approx(T)
        assert f"{saved.n_poses} poses" in answer
        document = json.loads(states[-1].data)
        pose = document["extrinsic"]["result"]["pose"]
        place = [pose[axis] for axis in "xyz"]
        assert place == pytest.approx(T[:3, 3].tolist())
        assert document["progress"]["progress"]["done"]
        assert saved.goal.done
        assert peer.trigger("reset").success
        late = listen()
        peer.spin_until(lambda: late, "the robot's edge")
        time.sleep(0.5)
        assert not edges(late)

    @pytest.fixture
    def broadcaster(self, kind, peer, calibration, monkeypatch):
        """In the peer's own node, switched on, without looking at the tree first."""
        monkeypatch.setattr(tf, "LOOK_S", 0.0)
        log = NodeLog(peer.node.get_logger())
        made = tf.TfBroadcaster(peer.node, log, RobotTree(peer.node, log))
        made.switch(True)
        yield made
        made.switch(False)

    def test_a_frame_that_has_a_parent_is_refused_loudly(
        self, peer, robot, listen, broadcaster, calibration, capfd
    ):
        child = calibration.child_frame
        robot(("base_link", child))
        self.frames_of_new_listener(peer, listen, child)
        broadcaster.update(calibration, "")
        standing, why = broadcaster.state
        assert standing is Broadcast.REFUSED
        assert why.startswith(f"{child} has the parent base_link on /tf_static")
        assert (
            f"publish_tf is refused: {child} has the parent"
            in capfd.readouterr().err
        )

    def test_a_parent_that_comes_later_ends_the_broadcast(
        self, peer, robot, listen, broadcaster, calibration, capfd
    ):
        child = calibration.child_frame
        broadcaster.update(calibration, "")
        assert self.frames_of_new_listener(peer, listen, child) == {child}
        robot(("base_link", child))

        def is_refused():
            broadcaster.update(calibration, "")
            return broadcaster.state[0] is Broadcast.REFUSED

        peer.spin_until(is_refused, "the refusal")
        assert "is withdrawn" in capfd.readouterr().err

    def test_what_is_done_but_may_not_be_broadcast_is_refused_and_withdrawn(
        self, broadcaster, calibration
    ):
        broadcaster.update(calibration, "")
        assert broadcaster.state == (Broadcast.ON, "")
        faulty = "the streams are faulty"
        broadcaster.update(calibration, faulty)
        assert broadcaster.state == (Broadcast.WITHDRAWN, faulty)
        broadcaster.update(None, "no result yet")
        assert broadcaster.state == (Broadcast.WITHDRAWN, "no result yet")
        broadcaster.update(calibration, "")
        assert broadcaster.state == (Broadcast.ON, "")
        dofs = [*calibration.observability_measured]
        dofs[2] = dataclasses.replace(
            dofs[2], verdict=DofVerdict.UNOBSERVABLE, sigma=np.inf
        )
        broadcaster.update(
            dataclasses.replace(
                calibration, observability_measured=tuple(dofs)
            ),
            "",
        )
        assert broadcaster.state == (Broadcast.REFUSED, "z not determined")
        broadcaster.update(
            dataclasses.replace(calibration, status=SolveStatus.NOT_CONVERGED),
            "",
        )
        assert broadcaster.state[0] is Broadcast.REFUSED
        assert broadcaster.state[1].startswith(
            "DO NOT USE: the solver did not converge"
        )

    @staticmethod
    def frames_of_new_listener(peer, listen, until):
        heard = listen()
        peer.spin_until(
            lambda: until in {transform.child_frame_id for transform in heard},
            until,
        )
        return {transform.child_frame_id for transform in heard}
