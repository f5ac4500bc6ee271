"""Conversions to ROS messages, and the QoS of topics."""

from importlib import import_module
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import turned
from hand_eye_calib.core.results.calibration import Calibration

# Length of a queue of messages: several seconds of a fast stream. For /tf_static, it is the number
# of publishers whose last message a late subscriber receives.
_QUEUE = 1000

_RELIABLE = ReliabilityPolicy.RELIABLE
_LATCHING = DurabilityPolicy.TRANSIENT_LOCAL
# QoS of a latched publisher: late subscribers receive its last message.
LATCHED = QoSProfile(depth=1, reliability=_RELIABLE, durability=_LATCHING)
# QoS of a subscription that receives the last message of every latched publisher.
LISTENING = QoSProfile(
    depth=_QUEUE, reliability=_RELIABLE, durability=_LATCHING
)


def quick() -> QoSProfile:
    """Return a new best-effort QoS, which also receives reliable messages.

    rclpy writes QoS overrides into the object, so every subscription needs its own object.
    """
    return QoSProfile(
        depth=_QUEUE,
        reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )


def message_class(type_name: str) -> type[Any]:
    """Return the class of a message type such as "nav_msgs/msg/Odometry"."""
    package, _, name = type_name.split("/")
    return getattr(import_module(f"{package}.msg"), name)


def to_time(stamp_ns: int) -> Time:
    """Return nanoseconds as builtin_interfaces/Time."""
    sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return Time(sec=sec, nanosec=nanosec)


def to_transform(
    calibration: Calibration, is_mounting: bool = False
) -> TransformStamped:
    """Return the extrinsic as geometry_msgs/TransformStamped.

    ``header.frame_id`` is the parent sensor's frame, ``child_frame_id`` the child sensor's frame.

    Parameters
    ----------
    calibration : Calibration
    is_mounting : bool
        Use ``calibration.mounting``, the pose in the frame on which the child sensor is mounted:
        the base frame if there is one, otherwise the frame of the parent sensor.
    """
    frame = calibration.parent_frame
    T = calibration.T_parent_child
    if is_mounting:
        frame, T = calibration.mounting
    message = TransformStamped()
    message.header.stamp = to_time(calibration.stamp_ns)
    message.header.frame_id = frame
    message.child_frame_id = calibration.child_frame
    fill(message.transform.translation, message.transform.rotation, T)
    return message


def to_pose_with_covariance(
    calibration: Calibration,
) -> PoseWithCovarianceStamped:
    """Return the child sensor's pose in the parent sensor's frame.

    The message is geometry_msgs/PoseWithCovarianceStamped with a covariance as in REP 103.
    """
    message = PoseWithCovarianceStamped()
    message.header.stamp = to_time(calibration.stamp_ns)
    message.header.frame_id = calibration.parent_frame
    T = calibration.T_parent_child
    fill(message.pose.pose.position, message.pose.pose.orientation, T)
    covariance = turned(se3.rotation_of(T), calibration.covariance)
    message.pose.covariance = covariance.ravel().tolist()
    return message


def fill(position: Any, orientation: Any, T_target_source: FloatArray) -> None:
    """Write a transform into the position and the orientation of a message."""
    translation = se3.translation_of(T_target_source).tolist()
    position.x, position.y, position.z = translation
    quat_xyzw = se3.to_quat_xyzw(T_target_source).tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = quat_xyzw
