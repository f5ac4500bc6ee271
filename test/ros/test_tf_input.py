"""A sensor whose poses exist only as transforms, wherever tf2_msgs is installed."""

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_harness import LATCHED, RELIABLE_INPUTS, T_PARENT_CHILD, drive, matrix, message

from hand_eye_calib.geometry import se3

MOUNT = se3.exp(np.array([1.2, 0.1, 0.8, 0.2, -0.1, 1.5]))
RELIABLE = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)


@pytest.fixture
def kind():
    return pytest.importorskip("tf2_msgs.msg").TFMessage


def edge(stamp_ns, parent, child, T_parent_child):
    made = message(TransformStamped, stamp_ns, T_parent_child, child)
    made.header.frame_id = parent
    return made


def test_a_parent_that_is_only_in_tf_gives_what_its_topic_would(start_node, peer, kind):
    node = start_node("-p parent_tf:=odom:lidar", "-p solve_period:=0.2", RELIABLE_INPUTS[1])
    static = peer.node.create_publisher(kind, "/tf_static", LATCHED)
    static.publish(kind(transforms=[edge(0, "base", "lidar", MOUNT)]))
    moving = peer.node.create_publisher(kind, "/tf", RELIABLE)
    child = peer.publisher(Odometry, "child_odom")
    peer.wait_matched(static, moving, child)
    node.wait_for_log("against transform odom:lidar", "base:lidar (static)")
    extrinsics = peer.listen(TransformStamped, "extrinsic")
    stamps_ns, Ts_pw_p, Ts_cw_c = drive(100)
    for stamp_ns, T_odom_lidar, T_cw_c in zip(stamps_ns, Ts_pw_p, Ts_cw_c, strict=True):
        T_odom_base = T_odom_lidar @ se3.inverse(MOUNT)
        others = edge(stamp_ns, "odom", "arm", np.eye(4))
        moving.publish(kind(transforms=[others, edge(stamp_ns, "odom", "base", T_odom_base)]))
        child.publish(message(Odometry, stamp_ns, T_cw_c, "camera"))

    def is_found():  # the first solves are of few poses
        return extrinsics and np.allclose(matrix(extrinsics[-1]), T_PARENT_CHILD, atol=1e-3)

    peer.spin_until(is_found, "the result of all poses")
    assert extrinsics[-1].header.frame_id == "lidar"


def test_transforms_do_not_measure_rates(start_node, kind):
    node = start_node("-p child_tf:=odom:camera", "-p child_measures:=rates")
    assert node.wait() == 1
    assert node.log == (
        "calibrator: transform odom:camera has messages of type tf2_msgs/msg/TFMessage, which "
        "measure poses or positions or rotations; asked for are rates\n"
    )
