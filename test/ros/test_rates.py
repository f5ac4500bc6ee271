"""A child that is an IMU: the node integrates its rates and finds the rotation."""

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from ros_harness import RELIABLE_INPUTS, T_PARENT_CHILD, drive, matrix, message
from sensor_msgs.msg import Imu

from hand_eye_calib.geometry import se3
from hand_eye_calib.ros import conversions


def imu_messages(stamps_ns, Ts_cw_c):
    """Messages whose mean rate between two stamps is that of the poses."""
    steps = se3.rotation_log(np.swapaxes(Ts_cw_c[:-1, :3, :3], 1, 2) @ Ts_cw_c[1:, :3, :3])
    rates = steps / (np.diff(stamps_ns)[:, None] * 1e-9)
    rates = np.concatenate([rates[:1], 0.5 * (rates[1:] + rates[:-1]), rates[-1:]])
    for stamp_ns, (x, y, z) in zip(stamps_ns.tolist(), rates.tolist(), strict=True):
        imu = Imu()
        imu.header.stamp, imu.header.frame_id = conversions.to_time(stamp_ns), "imu_link"
        imu.angular_velocity.x, imu.angular_velocity.y, imu.angular_velocity.z = x, y, z
        yield imu


def test_an_imu_as_child(start_node, peer):
    node = start_node("-p solve_period:=0.5", *RELIABLE_INPUTS)
    publishers = peer.publishers(Odometry, Imu)
    peer.wait_matched(*publishers)
    stamps_ns, Ts_pw_p, Ts_cw_c = drive(300)  # long enough for the stream checks
    for stamp_ns, T, imu in zip(stamps_ns, Ts_pw_p, imu_messages(stamps_ns, Ts_cw_c), strict=True):
        publishers[0].publish(message(Odometry, stamp_ns, T, "lidar"))
        publishers[1].publish(imu)
    found = peer.listen(TransformStamped, "extrinsic")
    with_covariance = peer.listen(PoseWithCovarianceStamped, "extrinsic_with_covariance")
    peer.spin_until(
        lambda: found and conversions.to_ns(found[-1].header.stamp) >= stamps_ns[-2],
        "a result with the last poses",
    )
    assert found[-1].child_frame_id == "imu_link"
    T = matrix(found[-1])
    assert T[:3, 3].tolist() == [0.0, 0.0, 0.0]
    assert float(se3.rotation_angle(T[:3, :3].T @ T_PARENT_CHILD[:3, :3])) < np.radians(3.0)
    peer.spin_until(lambda: with_covariance, "the pose with covariance")
    assert with_covariance[-1].pose.covariance[0] > 1.0
    assert "DO NOT USE" not in peer.trigger("solve").message
    assert "Traceback" not in node.log
