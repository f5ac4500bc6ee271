"""Plays poses to a node ``calibrator`` in another process and waits for its answer: the far end of
the middleware, for ``demo``.
"""

import time
from collections.abc import Callable, Mapping

import rclpy
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy._rclpy_pybind11 import RCLError
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import HandEyeCalibError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.bags.messages import transform_of
from hand_eye_calib.formats.bags.pose_table import PoseTable
from hand_eye_calib.online.ros.conversions import LATCHED, to_time

# Nothing is lost on the way to a subscription that is reliable too.
_LOSSLESS = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
_SPIN_S = 0.02
_PATIENCE_S = 120.0


def play(
    poses: PoseTable,
    topics: Mapping[str, str],
    speed: float,
    until_ns: int,
    check: Callable[[], None],
) -> FloatArray:
    """Publish poses on the topics of their streams, ``speed`` times as fast as they were recorded.

    ``check`` is called while waiting, and raises if that has become pointless.

    Returns
    -------
    (4, 4) array
        T_parent_child that the node publishes once it has used the poses until then.

    Raises
    ------
    HandEyeCalibError
        If ROS cannot start, or the node does not do its part in time.
    """
    context = rclpy.Context()
    try:
        rclpy.init(args=[], context=context)
    except RCLError as error:
        raise HandEyeCalibError(f"cannot start ROS: {' '.join(str(error).split())}") from None
    node = rclpy.create_node("hand_eye_calib_player", context=context)
    executor = SingleThreadedExecutor(context=context)
    heard = [TransformStamped()]
    executor.add_node(node)
    publishers = {name: node.create_publisher(Odometry, topics[name], _LOSSLESS) for name in topics}
    solve = node.create_client(Trigger, "calibrator/solve")
    node.create_subscription(TransformStamped, "calibrator/extrinsic", heard.append, LATCHED)

    def wait(condition: Callable[[], object], purpose: str) -> None:
        end_s = time.monotonic() + _PATIENCE_S
        while not condition():
            check()
            if time.monotonic() > end_s:
                raise HandEyeCalibError(f"waited {_PATIENCE_S:g} s for the node to {purpose}")
            executor.spin_once(timeout_sec=_SPIN_S)

    def is_covered() -> bool:
        # Poses and service calls share no order, so one call of ~/solve would not be enough.
        if asked[-1].done():
            asked.append(solve.call_async(Trigger.Request()))
        return transform_of(heard[-1]).stamp_ns >= until_ns

    try:
        wait(lambda: all(each.get_subscription_count() for each in publishers.values()), "listen")
        start_s = time.monotonic() - int(poses.stamps_ns[0]) * 1e-9 / speed
        for row, stamp_ns in enumerate(poses.stamps_ns.tolist()):
            while (remaining_s := start_s + stamp_ns * 1e-9 / speed - time.monotonic()) > 0:
                executor.spin_once(timeout_sec=remaining_s)
            publishers[poses.streams[row]].publish(_odometry(poses, row))
        wait(solve.service_is_ready, "serve ~/solve")
        asked = [solve.call_async(Trigger.Request())]
        wait(is_covered, "give a result with all poses")
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
    found = transform_of(heard[-1])
    return se3.from_quat_xyzw(found.position, found.quat_xyzw)


def _odometry(poses: PoseTable, row: int) -> Odometry:
    message = Odometry()
    message.header.stamp = to_time(int(poses.stamps_ns[row]))
    message.header.frame_id = poses.world_frames[row]
    message.child_frame_id = poses.sensor_frames[row] or ""
    position = message.pose.pose.position
    orientation = message.pose.pose.orientation
    position.x, position.y, position.z, *quat_xyzw = poses.poses[row].tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = quat_xyzw
    return message
