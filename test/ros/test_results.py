"""What the node publishes, over the real middleware, for poses with a known or published answer."""

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from motions import disturbed
from nav_msgs.msg import Odometry
from numpy.testing import assert_allclose
from published_data import kitti_short
from ros_harness import (
    POSE_KINDS,
    RELIABLE_INPUTS,
    START_NS,
    T_PARENT_CHILD,
    drive,
    matrix,
    ns_of,
)
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.engine.calibrator import Calibrator
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.online.ros import conversions

FRAMES = ["-p parent_frame:=lidar", "-p child_frame:=camera"]


def test_extrinsic_of_a_noise_free_drive_comes_by_itself(start_node, peer):
    node = start_node("-p solve_period:=0.2", *RELIABLE_INPUTS)
    extrinsics = peer.listen(TransformStamped, "extrinsic")
    documents = []
    poses = peer.listen(PoseWithCovarianceStamped, "extrinsic_with_covariance")
    peer.node.create_subscription(
        String, "calibrator/progress", documents.append, conversions.LISTENING
    )
    peer.feed(peer.publishers(), *drive())
    last_ns = drive()[0][-1]
    stamp_ns = lambda: ns_of(extrinsics[-1].header.stamp)  # noqa: E731
    peer.spin_until(
        lambda: extrinsics and stamp_ns() == last_ns and poses,
        "a result of all",
    )
    assert_allclose(matrix(extrinsics[-1]), T_PARENT_CHILD, atol=1e-3)
    assert (extrinsics[-1].header.frame_id, extrinsics[-1].child_frame_id) == (
        "lidar",
        "camera",
    )
    # Each result is told at once, with the state.
    values = [
        f'"x": {transform.transform.translation.x},' for transform in extrinsics
    ]
    peer.spin_until(
        lambda: all(value in str(documents) for value in values), "the states"
    )
    assert poses[-1].header.frame_id == "lidar"
    covariance = np.reshape(poses[-1].pose.covariance, (6, 6))
    assert np.isfinite(covariance).all()
    assert_allclose(covariance, covariance.T, atol=1e-12)
    node.wait_for_log(
        "subscribed to /parent_odom (nav_msgs/msg/Odometry)",
        "subscribed to /child_odom (nav_msgs/msg/Odometry)",
        "first pose on /parent_odom",
        "first pose on /child_odom",
        "camera in lidar: xyz = (",
    )


@pytest.mark.parametrize(
    ("options", "sentence", "is_used"),
    [([], "solved with time_offset estimate", True),
     (["-p time_offset:=0.0"], "the child's clock is 0.29997", False)],
)  # fmt: skip
def test_a_clock_offset_that_is_certain_is_used_unless_the_clock_is_set_as_right(
    start_node, peer, options, sentence, is_used
):
    node = start_node("-p solve_period:=0.2", *options, *RELIABLE_INPUTS)
    extrinsics = peer.listen(TransformStamped, "extrinsic")
    stamps_ns, Ts_pw_p, Ts_cw_c = drive(260)
    peer.feed(peer.publishers(), stamps_ns[3:], Ts_pw_p[:-3], Ts_cw_c[3:])

    def is_right():
        return extrinsics and np.allclose(
            matrix(extrinsics[-1]), T_PARENT_CHILD, atol=0.01
        )

    log = node.wait_for_log(sentence)
    if is_used:
        peer.spin_until(is_right, "a result with the clock offset")
    assert ("solved with time_offset" in log) == is_used


@pytest.mark.parametrize("kind", POSE_KINDS[1:])
def test_each_message_type_is_found_from_the_graph(start_node, peer, kind):
    start_node("-p solve_period:=1000.0", *FRAMES, *RELIABLE_INPUTS)
    publishers = peer.publishers(kind, child_kind=Odometry)
    _, extrinsic = peer.solve(publishers, *drive())
    assert_allclose(matrix(extrinsic), T_PARENT_CHILD, atol=1e-3)
    assert (extrinsic.header.frame_id, extrinsic.child_frame_id) == (
        "lidar",
        "camera",
    )
    late = peer.listen(TransformStamped, "extrinsic")
    late_with_covariance = peer.listen(
        PoseWithCovarianceStamped, "extrinsic_with_covariance"
    )
    late_markers = peer.listen(MarkerArray, "markers")
    peer.spin_until(
        lambda: late and late_with_covariance and late_markers,
        "the latched result",
    )
    assert {marker.ns for marker in late_markers[-1].markers} > {
        "parent",
        "child",
        "text",
    }
    assert late == [extrinsic]
    assert late_with_covariance[0].header == extrinsic.header


def test_topic_of_another_type_is_named_with_the_types_that_work(
    start_node, peer
):
    node = start_node(
        "-p child_type:=geometry_msgs/msg/PoseStamped", "-p solve_period:=0.1"
    )
    node.wait_for_log("no pose yet on /parent_odom: 0 publishers; no pose")
    peer.publisher(String, "parent_odom")
    peer.publisher(Odometry, "child_odom")
    node.wait_for_log(
        "/parent_odom: it has type std_msgs/msg/String; expected nav_msgs/msg/Odometry, "
        "geometry_msgs/msg/PoseStamped",
        "/child_odom: it has type nav_msgs/msg/Odometry; expected geometry_msgs/msg/PoseStamped: ",
    )
    statuses = peer.diagnostics()
    sentence = "no message on /child_odom yet: it has type nav_msgs/msg/Odometry; expected"
    peer.spin_until(
        lambda: sentence in str(statuses.get("/calibrator: child input")),
        "the status",
    )


def test_two_nodes_of_one_name_are_told_and_one_topic_for_two_inputs_is_refused(
    start_node,
):
    first = start_node()
    _ = start_node()
    first.wait_for_log("another node is called /calibrator, too")
    refused = start_node(
        "-r parent_odom:=/odom", "-r child_odom:=/odom", "-r __node:=third"
    )
    assert refused.wait() == 1
    assert refused.log.startswith(
        "calibrator: two inputs have the same topic: remap one"
    )


def recording():
    """KITTI where it is, else a simulated drive: stamps, poses of both, and the answer's error."""
    try:
        case = kitti_short()
    except pytest.skip.Exception:
        return *drive(448), T_PARENT_CHILD, (0.0, 0.0)
    return (
        case.stamps_ns,
        case.parent.poses,
        case.child.poses,
        case.T_parent_child,
        (0.20, 0.23),
    )


def test_a_recording_through_the_node_equals_the_engine_fed_directly(
    start_node, peer
):
    stamps_ns, *Ts_w, T_true, off = recording()
    options = {"method": "dnlo", "reference": "B10", "max_gap": 60.0}
    engine = Calibrator(CalibratorConfig.from_options(options))
    for stream, frame, Ts in zip(
        ("parent", "child"), ("lidar", "camera"), Ts_w, strict=True
    ):
        engine.set_frame(stream, frame)
        for stamp_ns, T_world_sensor in zip(stamps_ns, Ts, strict=True):
            quat_xyzw = se3.to_quat_xyzw(T_world_sensor).tolist()
            engine.add_pose(
                stream, int(stamp_ns), T_world_sensor[:3, 3].tolist(), quat_xyzw
            )
    offline = engine.estimate()
    arguments = [f"-p {name}:={value}" for name, value in options.items()]
    start_node("-p solve_period:=1000.0", *arguments, *RELIABLE_INPUTS)
    answer, extrinsic = peer.solve(peer.publishers(), stamps_ns, *Ts_w)
    assert_allclose(
        matrix(extrinsic), offline.T_parent_child, rtol=0, atol=1e-9
    )
    assert ns_of(extrinsic.header.stamp) == offline.stamp_ns
    counts = f"{offline.n_poses} poses, {offline.n_pairs} pairs, {offline.n_inliers} inliers"
    assert counts in answer.message
    metres, radians = se3.absolute_errors(matrix(extrinsic), T_true)
    assert (metres, np.degrees(radians)) == pytest.approx(off, abs=0.01)


def test_motion_that_hides_a_direction_is_published_with_a_warning(
    start_node, peer
):
    stamps_ns, _, _ = drive(400)
    s = (stamps_ns - START_NS) * 1e-9
    flat = se3.from_rotation_translation(
        se3.rotation_exp(np.outer(np.sin(0.4 * s), [0, 0, 1])),
        np.stack([s, np.sin(0.5 * s), 0 * s], axis=1),
    )
    node = start_node("-p solve_period:=1000.0", *RELIABLE_INPUTS)
    poses = peer.listen(PoseWithCovarianceStamped, "extrinsic_with_covariance")
    child = disturbed(flat @ T_PARENT_CHILD, 1, 5e-5, 5e-5)
    answer, extrinsic = peer.solve(peer.publishers(), stamps_ns, flat, child)
    assert not answer.success
    assert "status unobservable" in answer.message
    assert answer.message.startswith(
        "USE WITH CARE: all but z; measure z by hand"
    )
    reason = (
        "z cannot be determined from this motion; measure it "
        "by hand and give a prior, such as prior.z "
    )
    node.wait_for_log("[WARN]", reason)
    assert_allclose(matrix(extrinsic)[:2, 3], T_PARENT_CHILD[:2, 3], atol=1e-3)
    peer.spin_until(lambda: poses, "the pose with covariance")
    covariance = np.reshape(poses[-1].pose.covariance, (6, 6))
    assert np.isfinite(covariance).all()
    # Known directions to a centimetre with the floor, the hidden one to no better than metres.
    assert max(covariance[0, 0], covariance[1, 1]) < 1e-4
    assert covariance[2, 2] > 8.0
