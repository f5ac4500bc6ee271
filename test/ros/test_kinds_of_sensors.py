"""Sensors other than odometries: an antenna, whose lever arm is found, also in a session that is
resumed; an IMU, whose rates are integrated; and one whose poses exist only as transforms.
"""

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from motions import geodetic
from nav_msgs.msg import Odometry
from numpy.testing import assert_allclose
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_harness import (
    LATCHED,
    RELIABLE_INPUTS,
    T_PARENT_CHILD,
    drive,
    matrix,
    message,
    ns_of,
)
from sensor_msgs.msg import Imu, NavSatFix

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.journal import (
    count_poses,
    has_session,
    read_journal,
)
from hand_eye_calib.online.ros import conversions

ORIGIN = (60.0, 25.0, 40.0)


def fixes(stamps_ns, positions):
    """Messages of an antenna; one in twenty without a fix."""
    rows = zip(stamps_ns.tolist(), *geodetic(positions, ORIGIN), strict=True)
    for index, (stamp_ns, *place) in enumerate(rows):
        fix = NavSatFix()
        fix.header.stamp = conversions.to_time(stamp_ns)
        fix.header.frame_id = "antenna"
        fix.latitude, fix.longitude, fix.altitude = place
        fix.status.status = -1 if index % 20 == 19 else 0
        yield fix


def test_an_antenna_as_child_and_its_origin_after_a_restart(
    start_node, peer, tmp_path
):
    stamps_ns, Ts_pw_p, Ts_cw_c = drive(160)
    rows = [
        *zip(
            stamps_ns, Ts_pw_p, fixes(stamps_ns, Ts_cw_c[:, :3, 3]), strict=True
        )
    ]
    publishers = peer.publishers(Odometry, NavSatFix)

    def feed(chunk):
        peer.wait_matched(*publishers)
        for stamp_ns, T, fix in chunk:
            publishers[0].publish(message(Odometry, stamp_ns, T, "lidar"))
            publishers[1].publish(fix)

    options = (
        *RELIABLE_INPUTS,
        "-p solve_period:=1000.0",
        f"-p output_directory:={tmp_path}",
    )
    node = start_node(*options)
    feed(rows[:80])
    journal = tmp_path / "journal"
    peer.spin_until(
        lambda: has_session(journal) and count_poses(journal) == 156,
        "the journal",
    )
    peer.spin_until(
        lambda: "origin" in read_journal(journal).about["child"], "the origin"
    )
    origin = read_journal(journal).about["child"]["origin"]
    assert_allclose(
        np.degrees(origin[:2]), [rows[0][2].latitude, rows[0][2].longitude]
    )
    node.process.kill()
    node.wait()
    peer.wait_left(*publishers)

    node = start_node(*options, "-p journal:=resume")
    node.wait_for_log("session resumed")
    feed(rows[80:])
    peer.spin_until(
        lambda: count_poses(journal) == 312, "all poses in the journal"
    )
    transforms = peer.listen(TransformStamped, "extrinsic")
    assert peer.trigger("solve").success
    peer.spin_until(lambda: transforms, "the lever arm")
    assert transforms[-1].child_frame_id == "antenna"
    assert matrix(transforms[-1])[:3, 3] == pytest.approx(
        T_PARENT_CHILD[:3, 3], abs=0.01
    )
    assert read_journal(journal).about["child"]["origin"] == origin
    assert "Traceback" not in node.log


def imu_messages(stamps_ns, Ts_cw_c):
    """Messages whose mean rate between two stamps is that of the poses."""
    steps = se3.rotation_log(
        np.swapaxes(Ts_cw_c[:-1, :3, :3], 1, 2) @ Ts_cw_c[1:, :3, :3]
    )
    rates = steps / (np.diff(stamps_ns)[:, None] * 1e-9)
    rates = np.concatenate(
        [rates[:1], 0.5 * (rates[1:] + rates[:-1]), rates[-1:]]
    )
    for stamp_ns, (x, y, z) in zip(
        stamps_ns.tolist(), rates.tolist(), strict=True
    ):
        imu = Imu()
        imu.header.stamp = conversions.to_time(stamp_ns)
        imu.header.frame_id = "imu_link"
        imu.angular_velocity.x = x
        imu.angular_velocity.y = y
        imu.angular_velocity.z = z
        yield imu


def test_an_imu_as_child(start_node, peer):
    node = start_node("-p solve_period:=0.5", *RELIABLE_INPUTS)
    publishers = peer.publishers(Odometry, Imu)
    peer.wait_matched(*publishers)
    stamps_ns, Ts_pw_p, Ts_cw_c = drive(
        300
    )  # long enough for the stream checks
    for stamp_ns, T, imu in zip(
        stamps_ns, Ts_pw_p, imu_messages(stamps_ns, Ts_cw_c), strict=True
    ):
        publishers[0].publish(message(Odometry, stamp_ns, T, "lidar"))
        publishers[1].publish(imu)
    transforms = peer.listen(TransformStamped, "extrinsic")
    with_covariance = peer.listen(
        PoseWithCovarianceStamped, "extrinsic_with_covariance"
    )
    peer.spin_until(
        lambda: (
            transforms and ns_of(transforms[-1].header.stamp) >= stamps_ns[-2]
        ),
        "a result with the last poses",
    )
    assert transforms[-1].child_frame_id == "imu_link"
    T = matrix(transforms[-1])
    assert T[:3, 3].tolist() == [0.0, 0.0, 0.0]
    assert float(
        se3.rotation_angle(T[:3, :3].T @ T_PARENT_CHILD[:3, :3])
    ) < np.radians(3.0)
    peer.spin_until(lambda: with_covariance, "the pose with covariance")
    assert with_covariance[-1].pose.covariance[0] > 1.0
    assert "DO NOT USE" not in peer.trigger("solve").message
    assert "Traceback" not in node.log


MOUNT = se3.exp(np.array([1.2, 0.1, 0.8, 0.2, -0.1, 1.5]))
RELIABLE = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)


@pytest.fixture
def kind():
    return pytest.importorskip("tf2_msgs.msg").TFMessage


def edge(stamp_ns, parent, child, T_parent_child):
    made = message(TransformStamped, stamp_ns, T_parent_child, child)
    made.header.frame_id = parent
    return made


def test_a_parent_that_is_only_in_tf_gives_what_its_topic_would(
    start_node, peer, kind
):
    node = start_node(
        "-p parent_tf:=odom:lidar", "-p solve_period:=0.2", RELIABLE_INPUTS[1]
    )
    static = peer.node.create_publisher(kind, "/tf_static", LATCHED)
    static.publish(kind(transforms=[edge(0, "base", "lidar", MOUNT)]))
    moving = peer.node.create_publisher(kind, "/tf", RELIABLE)
    child = peer.publisher(Odometry, "child_odom")
    peer.wait_matched(static, moving, child)
    node.wait_for_log("against transform odom:lidar", "base:lidar (static)")
    extrinsics = peer.listen(TransformStamped, "extrinsic")
    stamps_ns, Ts_pw_p, Ts_cw_c = drive(100)
    for stamp_ns, T_odom_lidar, T_cw_c in zip(
        stamps_ns, Ts_pw_p, Ts_cw_c, strict=True
    ):
        T_odom_base = T_odom_lidar @ se3.inverse(MOUNT)
        others = edge(stamp_ns, "odom", "arm", np.eye(4))
        moving.publish(
            kind(
                transforms=[others, edge(stamp_ns, "odom", "base", T_odom_base)]
            )
        )
        child.publish(message(Odometry, stamp_ns, T_cw_c, "camera"))

    def is_found():  # the first solves are of few poses
        return extrinsics and np.allclose(
            matrix(extrinsics[-1]), T_PARENT_CHILD, atol=1e-3
        )

    peer.spin_until(is_found, "the result of all poses")
    assert extrinsics[-1].header.frame_id == "lidar"


def test_transforms_do_not_measure_rates(start_node, kind):
    node = start_node("-p child_tf:=odom:camera", "-p child_measures:=rates")
    assert node.wait() == 1
    assert node.log == (
        "calibrator: transform odom:camera has messages of type tf2_msgs/msg/TFMessage, which "
        "measure poses or positions or rotations; the options ask for rates\n"
    )
