"""Play poses to a node ``calibrator`` in another process, and wait for its result.

The command ``demo`` uses this module.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial

import rclpy
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy._rclpy_pybind11 import RCLError
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import HandEyeCalibError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.bags.messages import transform_of
from hand_eye_calib.formats.bags.pose_table import PoseTable
from hand_eye_calib.online.ros.conversions import LATCHED, to_time

# Quality of service with which no message is lost.
_LOSSLESS = QoSProfile(
    history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE
)
# Longest time to wait for one callback (s).
_SPIN_S = 0.02
# Longest time to wait until the node has done what the player needs for its next step (s).
_PATIENCE_S = 120.0


def play(
    poses: PoseTable,
    topics: Mapping[str, str],
    speed: float,
    until_ns: int,
    check: Callable[[], None],
) -> FloatArray:
    """Publish poses to the node, and return the node's result ``T_parent_child`` (4, 4).

    Parameters
    ----------
    poses : PoseTable
    topics : mapping of str to str
        Topic of each stream.
    speed : float
        Ratio of the speed of the playback to that of the recording.
    until_ns : int
        Stamp up to which the result must use the poses.
    check : callable
        ``check()`` raises an error if the node has ended. It is called while waiting.

    Raises
    ------
    HandEyeCalibError
        If ROS cannot start, or the node does not answer in time.
    """
    with _player_node() as (node, executor):
        results = [TransformStamped()]
        publishers = _publishers(node, topics)
        solve = node.create_client(Trigger, "calibrator/solve")
        node.create_subscription(
            TransformStamped, "calibrator/extrinsic", results.append, LATCHED
        )
        wait = partial(_wait, executor, check)

        def has_all_poses() -> bool:
            """Whether the newest result uses all poses; call ~/solve again if it does not."""
            # A call of ~/solve may arrive before the last poses.
            if requests[-1].done():
                requests.append(solve.call_async(Trigger.Request()))
            return transform_of(results[-1]).stamp_ns >= until_ns

        wait(partial(_are_subscribed, publishers), "listen")
        _publish_in_time(poses, publishers, speed, executor)
        wait(solve.service_is_ready, "serve ~/solve")
        requests = [solve.call_async(Trigger.Request())]
        wait(has_all_poses, "give a result with all poses")
    result = transform_of(results[-1])
    return se3.from_quat_xyzw(result.position, result.quat_xyzw)


def play_live(
    poses: PoseTable,
    topics: Mapping[str, str],
    speed: float,
    check: Callable[[], None],
    is_wanted: Callable[[], bool],
) -> None:
    """Publish poses to the node as long as ``is_wanted()`` is true; then wait for a result.

    For the parameters and errors see :func:`play`.
    """
    with _player_node() as (node, executor):
        publishers = _publishers(node, topics)
        results: list[TransformStamped] = []
        node.create_subscription(
            TransformStamped, "calibrator/extrinsic", results.append, LATCHED
        )
        _wait(executor, check, partial(_are_subscribed, publishers), "listen")
        _publish_in_time(poses, publishers, speed, executor, is_wanted)
        # A busy computer may need longer for the first result than the drive takes.
        _wait(
            executor,
            check,
            lambda: results or not is_wanted(),
            "give a result",
        )


def _publishers(node: Node, topics: Mapping[str, str]) -> dict[str, Publisher]:
    """Return a publisher of odometry for each stream."""
    return {
        stream: node.create_publisher(Odometry, topic, _LOSSLESS)
        for stream, topic in topics.items()
    }


def _are_subscribed(publishers: Mapping[str, Publisher]) -> bool:
    """Whether the node has subscribed to all topics."""
    return all(
        publisher.get_subscription_count() for publisher in publishers.values()
    )


def _publish_in_time(
    poses: PoseTable,
    publishers: Mapping[str, Publisher],
    speed: float,
    executor: SingleThreadedExecutor,
    is_wanted: Callable[[], bool] = lambda: True,
) -> None:
    """Publish each pose at its time of the playback, and spin between the poses.

    The playback ends early once ``is_wanted()`` is false.
    """
    # Time at which the stamp 0 would be played.
    start_s = time.monotonic() - int(poses.stamps_ns[0]) * 1e-9 / speed
    for row, stamp_ns in enumerate(poses.stamps_ns.tolist()):
        due_s = start_s + stamp_ns * 1e-9 / speed
        while (remaining_s := due_s - time.monotonic()) > 0:
            executor.spin_once(timeout_sec=remaining_s)
        if not is_wanted():
            return
        publishers[poses.streams[row]].publish(_odometry(poses, row))


def _wait(
    executor: SingleThreadedExecutor,
    check: Callable[[], None],
    condition: Callable[[], object],
    purpose: str,
) -> None:
    """Run callbacks until a condition is true.

    Raises a HandEyeCalibError if this takes too long. ``purpose`` states in its message what the
    node should have done.
    """
    end_s = time.monotonic() + _PATIENCE_S
    while not condition():
        check()
        if time.monotonic() > end_s:
            raise HandEyeCalibError(
                f"waited {_PATIENCE_S:g} s for the node to {purpose}"
            )
        executor.spin_once(timeout_sec=_SPIN_S)


@contextmanager
def _player_node() -> Iterator[tuple[Node, SingleThreadedExecutor]]:
    """Context with a new ROS node and its executor; both are closed at its end."""
    context = rclpy.Context()
    try:
        rclpy.init(args=[], context=context)
    except RCLError as error:
        raise HandEyeCalibError(
            f"cannot start ROS: {' '.join(str(error).split())}"
        ) from None
    node = rclpy.create_node("hand_eye_calib_player", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        yield node, executor
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


def _odometry(poses: PoseTable, row: int) -> Odometry:
    """Return the message of a row of the table."""
    message = Odometry()
    message.header.stamp = to_time(int(poses.stamps_ns[row]))
    message.header.frame_id = poses.world_frames[row]
    message.child_frame_id = poses.sensor_frames[row] or ""
    position = message.pose.pose.position
    orientation = message.pose.pose.orientation
    position.x, position.y, position.z, *quat_xyzw = poses.poses[row].tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = quat_xyzw
    return message
