"""Between ROS messages and the poses of the engine."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    PointStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    TransformStamped,
    Vector3,
)
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, NavSatFix

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.calibration import Calibration
from hand_eye_calib.errors import InputError, printable
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.rates import RateIntegrator
from hand_eye_calib.io.trajectory_files.geodetic import LocalOrigin

_Triple = TypeVar("_Triple", Point, Vector3)


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
        message -> name of the moving frame; None if the type only names the world frame.
    """

    message: type[Any]
    pose: Callable[[Any], tuple[Any, Any]]
    sensor_frame: Callable[[Any], str] | None = None

    def position(self, message: Any) -> tuple[float, float, float]:
        """Translation (x, y, z) in m."""
        point = self.pose(message)[0]
        return point.x, point.y, point.z

    def quat_xyzw(self, message: Any) -> tuple[float, float, float, float]:
        """Orientation, scalar last."""
        quaternion = self.pose(message)[1]
        return quaternion.x, quaternion.y, quaternion.z, quaternion.w


def _pose(pose: Any) -> tuple[Any, Any]:
    return pose.position, pose.orientation


def _transform(transform: Any) -> tuple[Any, Any]:
    return transform.translation, transform.rotation


def _child_frame(message: Any) -> str:
    """The frame with control characters escaped, as it is read from bags."""
    return printable(message.child_frame_id)


POSE_TYPES = {
    "nav_msgs/msg/Odometry": PoseType(
        Odometry, lambda message: _pose(message.pose.pose), _child_frame
    ),
    "geometry_msgs/msg/PoseStamped": PoseType(PoseStamped, lambda message: _pose(message.pose)),
    "geometry_msgs/msg/PoseWithCovarianceStamped": PoseType(
        PoseWithCovarianceStamped, lambda message: _pose(message.pose.pose)
    ),
    "geometry_msgs/msg/TransformStamped": PoseType(
        TransformStamped, lambda message: _transform(message.transform), _child_frame
    ),
}


# Messages of a part of a pose, and how each is read as what it measures; a new reading for every
# stream, for some remember what came before.
PART_TYPES: dict[tuple[str, str], Callable[[], PoseType]] = {
    ("sensor_msgs/msg/Imu", "rates"): lambda: PoseType(Imu, _integrated(), _own_frame),
    ("sensor_msgs/msg/Imu", "rotations"): lambda: PoseType(Imu, _orientation, _own_frame),
    ("sensor_msgs/msg/NavSatFix", "positions"): lambda: PoseType(NavSatFix, _local(), _own_frame),
    ("geometry_msgs/msg/PointStamped", "positions"): lambda: PoseType(
        PointStamped, lambda message: (message.point, Quaternion())
    ),
}


def reading(type_name: str, measures: str) -> PoseType:
    """How to read messages of a type as what they measure, see
    :func:`~hand_eye_calib.io.bags.parts.measured_as`.
    """
    if type_name not in POSE_TYPES:
        return PART_TYPES[type_name, measures]()
    whole = POSE_TYPES[type_name]
    parts: dict[str, Callable[[Any], tuple[Any, Any]]] = {
        "poses": whole.pose,
        "positions": lambda message: (whole.pose(message)[0], Quaternion()),
        "rotations": lambda message: (Point(), whole.pose(message)[1]),
    }
    return replace(whole, pose=parts[measures])


def _own_frame(message: Any) -> str:
    """The frame of a message that is one of the sensor's own."""
    return printable(message.header.frame_id)


def _orientation(message: Imu) -> tuple[Point, Quaternion]:
    if message.orientation_covariance[0] == -1.0:
        raise InputError("the message says that it has no orientation")
    return Point(), message.orientation


def _integrated() -> Callable[[Imu], tuple[Point, Quaternion]]:
    """Orientations from the rates of messages, one after the other."""
    integrator = RateIntegrator()

    def pose(message: Imu) -> tuple[Point, Quaternion]:
        if message.angular_velocity_covariance[0] == -1.0:
            raise InputError("the message says that it has no angular rates")
        rate = message.angular_velocity
        rates = np.array([[rate.x, rate.y, rate.z]])
        if not np.isfinite(rates).all():
            raise InputError("an angular rate is not finite")
        x, y, z, w = integrator.quats_xyzw(np.array([to_ns(message.header.stamp)]), rates)[0]
        return Point(), Quaternion(x=float(x), y=float(y), z=float(z), w=float(w))

    return pose


def _local() -> Callable[[NavSatFix], tuple[Point, Quaternion]]:
    """Metres east, north and up of the first fix."""
    origin = LocalOrigin()

    def pose(message: NavSatFix) -> tuple[Point, Quaternion]:
        if message.status.status < 0:
            raise InputError("the receiver has no fix")
        lat, lon = np.radians([[message.latitude], [message.longitude]])
        height = np.array([message.altitude])
        if not np.isfinite([lat, lon, height]).all():
            raise InputError("a coordinate is not finite")
        x, y, z = origin.local(lat, lon, height)[0]
        return Point(x=float(x), y=float(y), z=float(z)), Quaternion()

    return pose


def to_ns(stamp: Time) -> int:
    """Nanoseconds (int) of a builtin_interfaces/Time."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def to_time(stamp_ns: int) -> Time:
    """builtin_interfaces/Time of nanoseconds (int)."""
    sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return Time(sec=sec, nanosec=nanosec)


def to_transform(calibration: Calibration) -> TransformStamped:
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


def to_mounting(calibration: Calibration) -> TransformStamped:
    """The child sensor's pose in the frame that it is mounted on, for the transform tree."""
    mounted_on, T = calibration.mounting
    message = to_transform(calibration)
    message.header.frame_id = mounted_on
    message.transform.translation = _xyz(Vector3, T)
    message.transform.rotation = _quaternion(T)
    return message


def to_pose_with_covariance(calibration: Calibration) -> PoseWithCovarianceStamped:
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


def covariance_about_parent_axes(
    T_parent_child: FloatArray, cov_parent_child_in_child: FloatArray
) -> FloatArray:
    """Covariance of a pose as ROS messages carry it (REP-103).

    The engine's error is ``xi = (rho, phi)`` in ``T_parent_child @ exp(xi)``, in the child's axes.
    To first order it moves the child's origin by ``R rho`` and rotates the child by ``R phi`` about
    the parent's axes through that origin. Both blocks are rotated; there is no lever arm.

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


def _xyz(kind: type[_Triple], T_target_source: FloatArray) -> _Triple:
    x, y, z = T_target_source[:3, 3].tolist()
    return kind(x=x, y=y, z=z)


def _quaternion(T_target_source: FloatArray) -> Quaternion:
    x, y, z, w = se3.to_quat_xyzw(T_target_source).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)
