"""The robot's transform tree: what is installed and the base frame are read from it, and the
extrinsic is broadcast on ``/tf_static``, only once the goal is reached, never as a second parent.
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
from hand_eye_calib.core.base.errors import ConfigError, HandEyeCalibError, InputError
from hand_eye_calib.core.base.text import axes_in_words
from hand_eye_calib.core.geometry.frames import Extrinsic, FrameTree, checked_pose
from hand_eye_calib.core.geometry.se3 import turned
from hand_eye_calib.core.results.calibration import Calibration, Verdict
from hand_eye_calib.core.results.records import AXES, ROTATIONS
from hand_eye_calib.formats.bags.messages import transform_of
from hand_eye_calib.formats.installed import open_installed, stated
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.state import Broadcast
from hand_eye_calib.online.ros.conversions import LATCHED, LISTENING, quick, to_transform

TF = "tf"
STATIC_TOPIC = "/tf_static"
DYNAMIC_TOPIC = "/tf"

# The transform tree is listened to for so long before anything is broadcast (s): discovery takes up
# to 2.4 s.
LOOK_S = 5.0


def message_type(wanted_by: str = "publish_tf") -> type[Any]:
    """tf2_msgs/TFMessage, which this parameter needs; a ConfigError if that is not installed."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        raise ConfigError(
            f"{wanted_by} needs the message package tf2_msgs, which is not installed: install "
            "ros-jazzy-tf2-msgs, or leave that parameter out"
        ) from None
    return TFMessage


class RobotTree(FrameTree):
    """The edges that others broadcast; of two parents of a frame the first counts. ``own`` is what
    this node has broadcast itself, which is not heard.
    """

    def __init__(self, node: Node, log: NodeLog) -> None:
        super().__init__(STATIC_TOPIC)
        self.own: deque[TransformStamped] = deque(maxlen=100)
        self._node = node
        self._log = log
        self._subscriptions: dict[str, Subscription] = {}

    def listen(self, topic: str = STATIC_TOPIC) -> None:
        """Listen to a topic from now on."""
        if topic not in self._subscriptions:
            heard = partial(self._hear, topic)
            qos = LISTENING if topic == STATIC_TOPIC else quick()
            subscription = self._node.create_subscription(message_type(), topic, heard, qos)
            self._subscriptions[topic] = subscription

    def ignore(self, topic: str) -> None:
        """Listen to a topic no longer."""
        if topic in self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop(topic))

    def what_forbids(self, parent: str, child: str) -> str:
        """Why the edge ``parent -> child`` must not be broadcast; empty if it may."""
        if child in self.edges:
            edge = self.edges[child]
            topic = STATIC_TOPIC if edge.is_static else DYNAMIC_TOPIC
            if edge.parent == parent:
                return f"{topic} has the edge {parent} -> {child} already, from another node"
            return f"{child} has the parent {edge.parent} on {topic} already, and a frame has one"
        with contextlib.suppress(InputError):  # it is not there, or others have closed a circle
            if child in self.above(parent):
                return f"{parent} is below {child} already: the edge would close a circle"
        return ""

    def _hear(self, topic: str, message: Any) -> None:
        for each in message.transforms:
            if each in self.own:
                continue
            edge = transform_of(each)
            frame = edge.sensor_frame or ""
            try:
                known = self.add(edge.world_frame, frame, None, is_static=topic == STATIC_TOPIC)
                known.pose = checked_pose(edge.position, edge.quat_xyzw)
            except InputError as error:
                self._log.warning(f"{topic} has an unusable transform of {frame}: {error}")


class Robot:
    """Completes results with what is installed, and with the pose in the base frame, from the
    robot's own frames. These two options do not change while the node runs.

    Attributes
    ----------
    problem : str
        Why the installed extrinsic or the base frame is not known yet; empty if it is, or if
        nothing was asked for.

    Raises
    ------
    ConfigError, InputError
        If what is installed cannot be read.
    """

    def __init__(self, log: NodeLog, options: NodeConfig, frames: FrameTree) -> None:
        self._log = log
        self._frames = frames
        self._source = options.installed
        self._base_frame = options.base_frame
        # What is installed between the two frames that were asked for last.
        self._installed: Extrinsic | None = None
        self._installed_for = ("", "")
        self.problem = ""
        of_tree = partial(stated, frames.pose, STATIC_TOPIC)
        self._read = of_tree if self._source in ("", TF) else open_installed(self._source)

    def installed(self, parent_frame: str, child_frame: str) -> Extrinsic | None:
        """What is installed; None if nothing was given, or it is not known (yet)."""
        frames = parent_frame, child_frame
        if frames != self._installed_for:  # inverted poses exchange the frames of their stream
            self._installed = None
        if self._installed is None and self._source:
            try:
                self._installed = self._read(parent_frame, child_frame)
                self._installed_for = frames
                self.problem = ""
                self._log.info(f"installed is what {self._installed.origin} says")
            except HandEyeCalibError as error:
                self._report(f"what is installed is not known: {error}")
        return self._installed

    def complete(self, calibration: Calibration) -> Calibration:
        """A usable result with its comparison and its pose in the base frame, if that is known. A
        single axis that the motion cannot determine has the value that is installed.
        """
        installed = self.installed(calibration.parent_frame, calibration.child_frame)
        if installed is not None:
            calibration = with_comparison(calibration, installed)
            calibration = _with_axis_of(installed, calibration)
        if not self._base_frame:
            return calibration
        try:
            T_base_parent = self._frames.pose(self._base_frame, calibration.parent_frame)
        except InputError as error:
            self._report(f"base_frame {self._base_frame} is not known from {STATIC_TOPIC}: {error}")
            return calibration
        return replace(calibration, base_frame=self._base_frame, T_base_parent=T_base_parent)

    @property
    def why_not_compared(self) -> str:
        """Why a result is not compared with what is installed; empty if that was not asked for."""
        return (self.problem or "no result yet") if self._source else ""

    def _report(self, problem: str) -> None:
        self.problem = problem
        self._log.warning(problem)


def _with_axis_of(installed: Extrinsic, calibration: Calibration) -> Calibration:
    """A result whose only unobservable axis, of the translation, is that of what is installed."""
    hidden = calibration.unobservable()
    if len(hidden) != 1 or hidden[0] in (*ROTATIONS, *calibration.out_of_reach):
        return calibration
    index = AXES.index(hidden[0])
    T = calibration.T_parent_child.copy()
    covariance = turned(T[:3, :3], calibration.covariance_measured)
    missing = float(installed.T_parent_child[index, 3] - T[index, 3])
    # The other axes follow as far as the motion has tied them to this one.
    T[:3, 3] += covariance[:3, index] / covariance[index, index] * missing
    told = f"{hidden[0]} is that of what is installed ({installed.origin})"
    return replace(calibration, T_parent_child=T, warnings=(*calibration.warnings, told))


class TfBroadcaster:
    """Broadcasts the result of a session that has reached its goal on ``/tf_static`` while that is
    switched on. ``state`` is what is done about it, and the reason.
    """

    def __init__(self, node: Node, log: NodeLog, tree: RobotTree) -> None:
        self._node = node
        self._log = log
        self._tree = tree
        self._is_on = False
        self._began_s = 0.0
        self._publisher: Any = None
        self.state: tuple[Broadcast, str] = Broadcast.OFF, ""

    def switch(self, on: bool) -> None:
        """Start or stop; a listener that has heard the edge keeps it until it is restarted."""
        if on != self._is_on:
            self._is_on = on
            self._began_s = time.monotonic()
            if on:
                self._tree.listen()
                self._tree.listen(DYNAMIC_TOPIC)
            else:
                self._tree.ignore(DYNAMIC_TOPIC)

    def look(self, result: Calibration | None, why_not: str) -> None:
        """Broadcast the session's result if it is new, as far as the tree allows it now; to be
        called often. ``why_not`` is empty if it may be.
        """
        if self._is_on and self._publisher is None:  # without a message: discovery takes seconds
            self._publisher = self._node.create_publisher(message_type(), STATIC_TOPIC, LATCHED)
        was_on = self.state[0] is Broadcast.ON
        self.state = self._judged(result, why_not)
        if result is not None and self.state[0] is Broadcast.ON:
            self._broadcast(result, not was_on)
        elif was_on:  # new listeners get nothing; the others keep it
            self._node.destroy_publisher(self._publisher)
            self._publisher = None
            self._log.warning(
                "the edge on /tf_static is withdrawn; listeners that have heard it keep it until "
                "they are restarted"
            )

    def _judged(self, result: Calibration | None, why_not: str) -> tuple[Broadcast, str]:
        if not self._is_on:
            return Broadcast.OFF, ""
        if result is None or why_not:
            return Broadcast.WAITING, why_not
        if result.verdict is Verdict.DO_NOT_USE:
            return Broadcast.REFUSED, result.headline
        if hidden := result.unobservable():
            return Broadcast.REFUSED, f"{axes_in_words(hidden)} not determined"
        if time.monotonic() - self._began_s < LOOK_S:
            return Broadcast.WAITING, "the transform tree is looked at first"
        if forbidden := self._tree.what_forbids(result.mounting[0], result.child_frame):
            self._log.error(
                f"publish_tf is refused: {forbidden}. Put the result into the robot's description "
                "(extrinsic.urdf.xacro, which ~/save writes), or leave publish_tf off"
            )
            return Broadcast.REFUSED, forbidden
        return Broadcast.ON, ""

    def _broadcast(self, result: Calibration, is_first: bool) -> None:
        self._tree.ignore(DYNAMIC_TOPIC)  # enough of that: it may be fast
        own = self._tree.own
        transform = to_transform(result, True)
        if is_first:
            self._log.info("the result is broadcast on /tf_static from now on")
        elif transform == own[-1]:
            return
        own.append(transform)
        self._publisher.publish(message_type()(transforms=[transform]))
