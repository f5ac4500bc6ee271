"""Between ROS messages and the poses of the engine."""

from importlib import import_module
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import turned
from hand_eye_calib.core.results.calibration import Calibration

# Messages that may wait in a queue: seconds of a fast stream, and every publisher's last message.
_QUEUE = 1000

_RELIABLE = ReliabilityPolicy.RELIABLE
_LASTING = DurabilityPolicy.TRANSIENT_LOCAL
# Of a publisher: who comes later gets the last message. Of a subscription: every publisher's.
LATCHED = QoSProfile(depth=1, reliability=_RELIABLE, durability=_LASTING)
LISTENING = QoSProfile(depth=_QUEUE, reliability=_RELIABLE, durability=_LASTING)


def quick() -> QoSProfile:
    """Best effort, which hears reliable publishers too. A profile for each subscription: rclpy
    writes its overrides into it.
    """
    return QoSProfile(
        depth=_QUEUE,
        reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )


def message_class(type_name: str) -> type[Any]:
    """The class of messages of a type such as "nav_msgs/msg/Odometry"."""
    package, _, name = type_name.split("/")
    return getattr(import_module(f"{package}.msg"), name)


def to_time(stamp_ns: int) -> Time:
    """builtin_interfaces/Time of nanoseconds (int)."""
    sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return Time(sec=sec, nanosec=nanosec)


def to_transform(calibration: Calibration, is_mounting: bool = False) -> TransformStamped:
    """The extrinsic as geometry_msgs/TransformStamped: header.frame_id is the parent sensor, or the
    frame that the child is mounted on, child_frame_id the child sensor.
    """
    of_parent = calibration.parent_frame, calibration.T_parent_child
    frame, T = calibration.mounting if is_mounting else of_parent
    message = TransformStamped()
    message.header.stamp = to_time(calibration.stamp_ns)
    message.header.frame_id = frame
    message.child_frame_id = calibration.child_frame
    _put(T, message.transform.translation, message.transform.rotation)
    return message


def to_pose_with_covariance(calibration: Calibration) -> PoseWithCovarianceStamped:
    """The child sensor's pose in the parent sensor's frame as
    geometry_msgs/PoseWithCovarianceStamped (REP-103 covariance).
    """
    message = PoseWithCovarianceStamped()
    message.header.stamp = to_time(calibration.stamp_ns)
    message.header.frame_id = calibration.parent_frame
    T = calibration.T_parent_child
    pose = message.pose.pose
    _put(T, pose.position, pose.orientation)
    covariance = turned(T[:3, :3], calibration.covariance)
    message.pose.covariance = covariance.ravel().tolist()
    return message


def _put(T_target_source: FloatArray, place: Any, turn: Any) -> None:
    place.x, place.y, place.z = T_target_source[:3, 3].tolist()
    turn.x, turn.y, turn.z, turn.w = se3.to_quat_xyzw(T_target_source).tolist()
