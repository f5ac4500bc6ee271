"""Transform tree of the robot.

The installed transform and the base frame are read from the tree. The result is broadcast on
``/tf_static`` after the goal is reached, but never as a second parent of a frame.
"""

import contextlib
import time
from collections import deque
from dataclasses import replace
from functools import partial
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.subscription import Subscription

from hand_eye_calib.core.assessment.comparison import with_comparison
from hand_eye_calib.core.base.config import NodeConfig
from hand_eye_calib.core.base.errors import (
    ConfigError,
    HandEyeCalibError,
    InputError,
)
from hand_eye_calib.core.base.text import axes_in_words
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import turned
from hand_eye_calib.core.geometry.frames import (
    Extrinsic,
    FrameTree,
    checked_pose,
)
from hand_eye_calib.core.results.calibration import Calibration, Verdict
from hand_eye_calib.core.results.records import AXES, ROTATIONS
from hand_eye_calib.formats.bags.messages import transform_of
from hand_eye_calib.formats.installed import open_installed, stated
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.state import Broadcast, BroadcastState
from hand_eye_calib.online.ros.conversions import (
    LATCHED,
    LISTENING,
    quick,
    to_transform,
)

# Value of the option ``installed`` that stands for the transform on /tf_static.
TF = "tf"
STATIC_TOPIC = "/tf_static"
DYNAMIC_TOPIC = "/tf"

# Time (s) for which the transform tree is received before the result is broadcast. The discovery of
# other publishers takes up to 2.4 s.
LOOK_S = 5.0


def message_type(wanted_by: str = "publish_tf") -> type[Any]:
    """Return tf2_msgs/TFMessage, which the parameter ``wanted_by`` needs.

    Raises
    ------
    ConfigError
        If tf2_msgs is not installed.
    """
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        raise ConfigError(
            f"{wanted_by} needs the message package tf2_msgs, which is not installed: install "
            "ros-jazzy-tf2-msgs, or omit the parameter"
        ) from None
    return TFMessage


class RobotTree(FrameTree):
    """Edges that other nodes broadcast. If a frame gets a second parent, its first parent is kept.

    Attributes
    ----------
    own : deque of TransformStamped
        The last transforms that this node has broadcast. They are ignored if they are received.
    """

    def __init__(self, node: Node, log: NodeLog) -> None:
        super().__init__(STATIC_TOPIC)
        self.own: deque[TransformStamped] = deque(maxlen=100)
        self._node = node
        self._log = log
        self._subscriptions: dict[str, Subscription] = {}

    def listen(self, topic: str = STATIC_TOPIC) -> None:
        """Subscribe to a topic."""
        if topic not in self._subscriptions:
            qos = LISTENING if topic == STATIC_TOPIC else quick()
            self._subscriptions[topic] = self._node.create_subscription(
                message_type(), topic, partial(self._receive, topic), qos
            )

    def ignore(self, topic: str) -> None:
        """Unsubscribe from a topic."""
        if topic in self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop(topic))

    def what_forbids(self, parent: str, child: str) -> str:
        """Return why the edge ``parent -> child`` must not be broadcast; empty if it may be."""
        if edge := self.edges.get(child):
            topic = STATIC_TOPIC if edge.is_static else DYNAMIC_TOPIC
            if edge.parent == parent:
                return f"{topic} has the edge {parent} -> {child} already, from another node"
            return (
                f"{child} has the parent {edge.parent} on {topic} already, and a frame can have "
                "only one"
            )
        # The parent is unknown, or other edges form a circle.
        with contextlib.suppress(InputError):
            if child in self.above(parent):
                return f"{parent} is below {child} already: the edge would close a circle"
        return ""

    def _receive(self, topic: str, message: Any) -> None:
        for transform in message.transforms:
            if transform in self.own:
                continue
            fields = transform_of(transform)
            frame = fields.sensor_frame or ""
            try:
                edge = self.add(
                    fields.world_frame,
                    frame,
                    None,
                    is_static=topic == STATIC_TOPIC,
                )
                edge.pose = checked_pose(fields.position, fields.quat_xyzw)
            except InputError as error:
                self._log.warning(
                    f"{topic} has an unusable transform of {frame}: {error}"
                )


class Robot:
    """Add the installed transform and the base frame of the robot to results.

    The options ``installed`` and ``base_frame`` do not change while the node runs.

    Attributes
    ----------
    problem : str
        Reason why the installed transform or the base frame is unknown. Empty if they are known, or
        if no option requests them.

    Raises
    ------
    ConfigError, InputError
        If the installed transform cannot be read.
    """

    def __init__(
        self, log: NodeLog, options: NodeConfig, frames: FrameTree
    ) -> None:
        self._log = log
        self._frames = frames
        self._source = options.installed
        self._base_frame = options.base_frame
        self.problem = ""
        # Installed transform between the frames of the last result.
        self._installed: Extrinsic | None = None
        self._installed_for = ("", "")
        from_tree = partial(stated, frames.pose, STATIC_TOPIC)
        self._read = (
            from_tree
            if self._source in ("", TF)
            else open_installed(self._source)
        )

    def installed(
        self, parent_frame: str, child_frame: str
    ) -> Extrinsic | None:
        """Return the installed transform; None if it is unknown, or if no option requests it."""
        frames = parent_frame, child_frame
        # Inverted poses exchange the two frames of their stream.
        if frames != self._installed_for:
            self._installed = None
        if self._installed is None and self._source:
            try:
                self._installed = self._read(parent_frame, child_frame)
                self._installed_for = frames
                self.problem = ""
                self._log.info(
                    f"the installed transform is from {self._installed.origin}"
                )
            except HandEyeCalibError as error:
                self._report(f"the installed transform is unknown: {error}")
        return self._installed

    def complete(self, calibration: Calibration) -> Calibration:
        """Return a usable result with its comparison, and its pose in the base frame if known.

        If the translation along one axis is the only unobservable value, it is set to its installed
        value.
        """
        installed = self.installed(
            calibration.parent_frame, calibration.child_frame
        )
        if installed is not None:
            calibration = with_comparison(calibration, installed)
            calibration = _with_axis_of(installed, calibration)
        if not self._base_frame:
            return calibration
        try:
            T_base_parent = self._frames.pose(
                self._base_frame, calibration.parent_frame
            )
        except InputError as error:
            self._report(
                f"base_frame {self._base_frame} is not known from {STATIC_TOPIC}: {error}"
            )
            return calibration
        return replace(
            calibration,
            base_frame=self._base_frame,
            T_base_parent=T_base_parent,
        )

    @property
    def why_not_compared(self) -> str:
        """Reason why the result is not compared; empty if no comparison is requested."""
        return (self.problem or "no result yet") if self._source else ""

    def _report(self, problem: str) -> None:
        """Store and log a problem."""
        self.problem = problem
        self._log.warning(problem)


def _with_axis_of(
    installed: Extrinsic, calibration: Calibration
) -> Calibration:
    """Return a result whose only unobservable axis has its installed value.

    The result is unchanged if several axes are unobservable, or if the axis is roll, pitch or yaw.
    """
    unobservable = calibration.unobservable()
    if len(unobservable) != 1:
        return calibration
    axis = unobservable[0]
    if axis in ROTATIONS or axis in calibration.out_of_reach:
        return calibration
    index = AXES.index(axis)
    T = calibration.T_parent_child.copy()
    covariance = turned(se3.rotation_of(T), calibration.covariance_measured)
    missing = float(installed.T_parent_child[index, 3] - T[index, 3])
    # The errors of the other axes are correlated with the error of this axis. Shift them by their
    # regression on this axis.
    T[:3, 3] += covariance[:3, index] / covariance[index, index] * missing
    warning = f"{axis} is taken from the installed transform: the motion does not determine it"
    return replace(
        calibration, T_parent_child=T, warnings=(*calibration.warnings, warning)
    )


class TfBroadcaster:
    """Broadcast the result on ``/tf_static`` after the session has reached its goal.

    Attributes
    ----------
    state : (Broadcast, str)
        Whether the result is broadcast; if not, the reason.
    """

    def __init__(self, node: Node, log: NodeLog, tree: RobotTree) -> None:
        self.state: BroadcastState = Broadcast.OFF, ""
        self._node = node
        self._log = log
        self._tree = tree
        self._is_on = False
        self._began_s = 0.0
        self._publisher: Any = None
        # Whether nodes may have received an edge that is no longer sent.
        self._is_withdrawn = False

    def switch(self, on: bool) -> None:
        """Switch the broadcast on or off. A subscriber keeps the last edge until it restarts."""
        if on == self._is_on:
            return
        self._is_on = on
        self._began_s = time.monotonic()
        if on:
            self._tree.listen()
            self._tree.listen(DYNAMIC_TOPIC)
        else:
            self._tree.ignore(DYNAMIC_TOPIC)

    def update(self, result: Calibration | None, why_not: str) -> None:
        """Broadcast a new result if the tree permits this. Call this method often.

        Parameters
        ----------
        result : Calibration or None
        why_not : str
            Reason why the result must not be broadcast yet; empty if it may be broadcast.
        """
        # Discovery takes seconds, so the publisher is made before the first message.
        if self._is_on and self._publisher is None:
            self._publisher = self._node.create_publisher(
                message_type(), STATIC_TOPIC, LATCHED
            )
        was_on = self.state[0] is Broadcast.ON
        broadcast, reason = self._decide(result, why_not)
        if broadcast is Broadcast.WAITING and (was_on or self._is_withdrawn):
            broadcast = Broadcast.WITHDRAWN
        self.state = broadcast, reason
        if result is not None and broadcast is Broadcast.ON:
            self._is_withdrawn = False
            self._broadcast(result, not was_on)
        elif was_on:
            # Without a publisher, new subscribers do not receive the old edge.
            self._node.destroy_publisher(self._publisher)
            self._publisher = None
            self._is_withdrawn = True
            self._log.warning(
                "the edge on /tf_static is withdrawn; nodes that have received it keep it until "
                "they restart"
            )

    def _decide(
        self, result: Calibration | None, why_not: str
    ) -> BroadcastState:
        """Return whether to broadcast a result; if not, the reason."""
        if not self._is_on:
            return Broadcast.OFF, ""
        if result is None:
            return Broadcast.WAITING, why_not
        was_checked = time.monotonic() - self._began_s >= LOOK_S
        # If the tree forbids the edge, report this before the goal is reached.
        if was_checked and (reason := self._what_forbids(result)):
            return Broadcast.REFUSED, reason
        if why_not:
            return Broadcast.WAITING, why_not
        if result.verdict is Verdict.DO_NOT_USE:
            return Broadcast.REFUSED, result.headline
        if unobservable := result.unobservable():
            return (
                Broadcast.REFUSED,
                f"{axes_in_words(unobservable)} not determined",
            )
        if not was_checked:
            return Broadcast.WAITING, "the transform tree is checked first"
        return Broadcast.ON, ""

    def _what_forbids(self, result: Calibration) -> str:
        """Return and log why the tree forbids the edge of a result; empty if it is allowed."""
        reason = self._tree.what_forbids(result.mounting[0], result.child_frame)
        if reason:
            self._log.error(
                f"publish_tf is refused: {reason}. Copy the result into the robot's description "
                "(extrinsic.urdf.xacro of ~/save), or switch publish_tf off"
            )
        return reason

    def _broadcast(self, result: Calibration, is_first: bool) -> None:
        """Publish the edge of a result if it is new or the first."""
        # The tree has been checked. /tf may be fast, so stop receiving it.
        self._tree.ignore(DYNAMIC_TOPIC)
        own = self._tree.own
        transform = to_transform(result, True)
        if is_first:
            self._log.info("the result is broadcast on /tf_static from now on")
        elif transform == own[-1]:
            return
        own.append(transform)
        self._publisher.publish(message_type()(transforms=[transform]))
