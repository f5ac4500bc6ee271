"""Plays poses to a node ``calibrator`` in another process and waits for its answer: the far end of
the middleware, for ``demo``.
"""

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import rclpy
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy._rclpy_pybind11 import RCLError
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.geometry import se3
from hand_eye_calib.ros.conversions import LATCHED, from_transform, to_time

if TYPE_CHECKING:  # what reads bags is not needed to play poses
    from hand_eye_calib.io.bags import PoseTable

# Nothing is lost on the way to a subscription that is reliable too.
_LOSSLESS = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
_SPIN_S, _PATIENCE_S = 0.02, 120.0


class LiveExtrinsic(NamedTuple):
    """What the node published on ``~/extrinsic``; the stamp is of the newest pose used."""

    T_parent_child: FloatArray
    stamp_ns: int


class Player:
    """Publishes nav_msgs/Odometry on topics by their streams and listens to the node; a context
    manager. ``check`` is called while waiting, and raises if that has become pointless.

    Raises
    ------
    HandEyeCalibError
        If ROS cannot start; from the methods, if the node does not do its part in time.
    """

    def __init__(self, topics: Mapping[str, str], check: Callable[[], None]) -> None:
        self._check = check
        self._context = rclpy.Context()
        try:
            rclpy.init(args=[], context=self._context)
        except RCLError as error:
            raise HandEyeCalibError(f"cannot start ROS: {' '.join(str(error).split())}") from None
        self._node = node = rclpy.create_node("hand_eye_calib_player", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)
        self._publishers = {
            stream: node.create_publisher(Odometry, topic, _LOSSLESS)
            for stream, topic in topics.items()
        }
        self._solve = node.create_client(Trigger, "calibrator/solve")
        self._heard: list[TransformStamped] = []
        heard = self._heard.append
        node.create_subscription(TransformStamped, "calibrator/extrinsic", heard, LATCHED)

    def __enter__(self) -> "Player":
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def play(self, poses: "PoseTable", speed: float) -> None:
        """Publish poses ``speed`` times as fast as they were recorded, once the node listens to
        both topics.
        """
        publishers = self._publishers.values()
        self._wait(lambda: all(each.get_subscription_count() for each in publishers), "subscribe")
        start_s, first_ns = time.monotonic(), int(poses.stamps_ns[0])
        for row, stamp_ns in enumerate(poses.stamps_ns.tolist()):
            due_s = start_s + (stamp_ns - first_ns) * 1e-9 / speed
            while (remaining_s := due_s - time.monotonic()) > 0:
                self._executor.spin_once(timeout_sec=remaining_s)
            self._publishers[poses.streams[row]].publish(_odometry(poses, row))
        self._check()

    def wait_for_extrinsic(self, stamp_ns: int) -> LiveExtrinsic:
        """Have the node solve until the newest pose in its result has this stamp or a later one.

        Poses and service calls share no order, so one call of ``~/solve`` would not be enough.
        """
        self._wait(self._solve.service_is_ready, "serve ~/solve")
        asked = [self._solve.call_async(Trigger.Request())]

        def is_covered() -> bool:
            if asked[-1].done():
                asked.append(self._solve.call_async(Trigger.Request()))
            return bool(self._heard) and from_transform(self._heard[-1]).stamp_ns >= stamp_ns

        self._wait(is_covered, "give a result with all poses")
        found = from_transform(self._heard[-1])
        T = se3.from_quat_xyzw(found.position, found.quat_xyzw)
        return LiveExtrinsic(T, found.stamp_ns)

    def _wait(self, condition: Callable[[], object], purpose: str) -> None:
        end_s = time.monotonic() + _PATIENCE_S
        while not condition():
            self._check()
            if time.monotonic() > end_s:
                raise HandEyeCalibError(f"waited {_PATIENCE_S:g} s for the node to {purpose}")
            self._executor.spin_once(timeout_sec=_SPIN_S)


def _odometry(poses: "PoseTable", row: int) -> Odometry:
    message = Odometry()
    message.header.stamp = to_time(int(poses.stamps_ns[row]))
    message.header.frame_id = poses.world_frames[row]
    message.child_frame_id = poses.sensor_frames[row] or ""
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    position.x, position.y, position.z, *quat_xyzw = poses.poses[row].tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = quat_xyzw
    return message
