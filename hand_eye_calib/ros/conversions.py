"""Between ROS messages and the numbers of the engine."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    TransformStamped,
    Vector3,
)
from nav_msgs.msg import Odometry

from hand_eye_calib.geometry import se3


@dataclass(frozen=True)
class PoseType:
    """How to read one type of pose message.

    Attributes
    ----------
    message : type
        Message class.
    pose : callable
        message -> (position, orientation), both still messages.
    sensor_frame : callable or None
        message -> name of the moving frame; None where the type only names the world frame.
    """

    message: type
    pose: Callable
    sensor_frame: Callable | None = None

    def position(self, message):
        """Translation (x, y, z) in m."""
        point = self.pose(message)[0]
        return point.x, point.y, point.z

    def quat_xyzw(self, message):
        """Orientation, scalar last."""
        quaternion = self.pose(message)[1]
        return quaternion.x, quaternion.y, quaternion.z, quaternion.w


POSE_TYPES = {
    "nav_msgs/msg/Odometry": PoseType(
        Odometry, lambda message: (message.pose.pose.position, message.pose.pose.orientation), lambda message: message.child_frame_id
    ),
    "geometry_msgs/msg/PoseStamped": PoseType(PoseStamped, lambda message: (message.pose.position, message.pose.orientation)),
    "geometry_msgs/msg/PoseWithCovarianceStamped": PoseType(
        PoseWithCovarianceStamped, lambda message: (message.pose.pose.position, message.pose.pose.orientation)
    ),
    "geometry_msgs/msg/TransformStamped": PoseType(
        TransformStamped, lambda message: (message.transform.translation, message.transform.rotation), lambda message: message.child_frame_id
    ),
}  # fmt: skip


def to_ns(stamp):
    """Nanoseconds (int) of a builtin_interfaces/Time."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def to_time(stamp_ns):
    """builtin_interfaces/Time of nanoseconds (int)."""
    sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return Time(sec=sec, nanosec=nanosec)


def to_transform(calibration):
    """The extrinsic as geometry_msgs/TransformStamped: header.frame_id is the parent sensor,
    child_frame_id the child sensor.
    """
    message = TransformStamped()
    message.header.stamp = to_time(calibration.stamp_ns)
    message.header.frame_id = calibration.parent_frame
    message.child_frame_id = calibration.child_frame
    message.transform.translation = _xyz(Vector3, calibration.T_parent_child)
    message.transform.rotation = _quaternion(calibration.T_parent_child)
    return message


def to_pose_with_covariance(calibration):
    """The child sensor's pose in the parent sensor's frame as
    geometry_msgs/PoseWithCovarianceStamped (REP-103 covariance).
    """
    message = PoseWithCovarianceStamped()
    message.header.stamp = to_time(calibration.stamp_ns)
    message.header.frame_id = calibration.parent_frame
    message.pose.pose.position = _xyz(Point, calibration.T_parent_child)
    message.pose.pose.orientation = _quaternion(calibration.T_parent_child)
    covariance = covariance_about_parent_axes(calibration.T_parent_child, calibration.covariance)
    message.pose.covariance = covariance.ravel().tolist()
    return message


def covariance_about_parent_axes(T_parent_child, cov_parent_child_in_child):
    """Covariance of a pose as ROS messages carry it (REP-103).

    The engine's error is ``xi = (rho, phi)`` in ``T_parent_child @ exp(xi)``, in the child's axes.
    To first order it moves the child's origin by ``R rho`` and turns it by ``R phi`` about the
    parent's fixed axes through that origin, so both blocks are rotated and nothing else: there is
    no lever arm.

    Parameters
    ----------
    T_parent_child : (4, 4) array
    cov_parent_child_in_child : (6, 6) array
        m and rad, order (rho, phi).

    Returns
    -------
    (6, 6) array
        Order x, y, z, rotation about X, Y, Z of the parent frame.
    """
    R_parent_child = T_parent_child[:3, :3]
    rotation = np.zeros((6, 6))
    rotation[:3, :3] = rotation[3:, 3:] = R_parent_child
    return rotation @ cov_parent_child_in_child @ rotation.T


def _xyz(kind, T_target_source):
    x, y, z = T_target_source[:3, 3].tolist()
    return kind(x=x, y=y, z=z)


def _quaternion(T_target_source):
    x, y, z, w = se3.to_quat_xyzw(T_target_source).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)
