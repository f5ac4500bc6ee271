"""The extrinsic on ``/tf_static``: only if it has settled, and never as a second parent."""

import time
from collections import deque
from functools import partial
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from hand_eye_calib.calibration import Calibration
from hand_eye_calib.errors import ConfigError
from hand_eye_calib.ros.conversions import to_mounting
from hand_eye_calib.ros.log import NodeLog
from hand_eye_calib.ros.settled import SettledRule

STATIC_TOPIC = "/tf_static"
DYNAMIC_TOPIC = "/tf"

_STATIC_QOS = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
# Every publisher's latched message must fit.
_LISTENING_QOS = QoSProfile(
    depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
_DYNAMIC_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)

# The transform tree is listened to for so long before anything is broadcast (s): discovery takes up
# to 2.4 s.
LOOK_S = 5.0

# What to do without tf2_msgs.
_INSTEAD = {
    "publish_tf": "leave publish_tf off and use the launch file that ~/save writes",
    "parent_tf": "give the poses of the parent sensor as a topic, parent_odom",
    "child_tf": "give the poses of the child sensor as a topic, child_odom",
    "base_frame": "leave base_frame empty and give --base-frame and --urdf to replay",
    "installed": "give a URDF, an extrinsic.yaml or numbers instead of tf",
}

# Own broadcasts that are recognised when they are heard.
_MOST_OWN = 100


class FrameTree:
    """The edges that others have broadcast."""

    def __init__(self) -> None:
        self._parents: dict[str, dict[str, str]] = {}  # child to parent to topic

    def add(self, parent: str, child: str, topic: str) -> None:
        """Take note of an edge."""
        self._parents.setdefault(child, {})[parent] = topic

    def what_forbids(self, parent: str, child: str) -> str:
        """Why the edge ``parent -> child`` must not be broadcast; empty if it may."""
        for other, topic in self._parents.get(child, {}).items():
            if other == parent:
                return f"{topic} has the edge {parent} -> {child} already, from another node"
            return f"{child} has the parent {other} on {topic} already, and a frame has one parent"
        if child in self._ancestors(parent):
            return f"{parent} is below {child} in the tree already: the edge would close a circle"
        return ""

    def _ancestors(self, frame: str) -> set[str]:
        found: set[str] = set()
        waiting = [frame]
        while waiting:
            for parent in self._parents.get(waiting.pop(), {}):
                if parent not in found:
                    found.add(parent)
                    waiting.append(parent)
        return found


class TfBroadcaster:
    """Broadcasts settled results on ``/tf_static`` while that is switched on.

    Parameters
    ----------
    node : rclpy.node.Node
    log : NodeLog
    """

    def __init__(self, node: Node, log: NodeLog) -> None:
        self._node, self._log = node, log
        self._rule = SettledRule()
        self._newest: Calibration | None = None
        self._waiting_for = "no result yet"
        self._forbidden = ""
        self._tree = FrameTree()
        self._own: deque[TransformStamped] = deque(maxlen=_MOST_OWN)
        self._publisher: Publisher | None = None
        self._subscriptions: dict[str, Subscription] = {}
        self._began_s = 0.0

    @property
    def is_on(self) -> bool:
        """Whether settled results are broadcast."""
        return bool(self._subscriptions)

    @property
    def refused(self) -> str:
        """Why nothing may be broadcast; empty if it may."""
        return self._forbidden

    @property
    def state(self) -> str:
        """What is done about it, in words."""
        if not self.is_on:
            return "off"
        if self._forbidden:
            return f"refused: {self._forbidden}"
        if self._publisher is not None:
            return "broadcast"
        return f"not yet: {self._waiting_for}"

    def switch(self, on: bool) -> None:
        """Start or stop; a listener that has heard the edge keeps it until it is restarted."""
        if on == self.is_on:
            return
        if on:
            self._listen()
            self.look()
            return
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()
        self._withdraw()

    def is_own(self, transform: TransformStamped) -> bool:
        """Whether this node has broadcast the transform."""
        return transform in self._own

    def add(self, calibration: Calibration, faults: tuple[str, ...]) -> None:
        """Take the next result of the session."""
        self._newest = calibration
        self._rule.add(calibration)
        self._waiting_for = self._rule.what_is_missing(faults)
        self._broadcast()

    def look(self) -> None:
        """Go on if the transform tree has been listened to for long enough; to be called often."""
        if self._newest is not None and self._publisher is None:
            self._broadcast()

    def restart(self) -> None:
        """Begin a new session: what was broadcast is withdrawn."""
        self._rule.restart()
        self._newest, self._waiting_for = None, "no result yet"
        self._withdraw()

    def _listen(self) -> None:
        kind = message_type()
        qos = {STATIC_TOPIC: _LISTENING_QOS, DYNAMIC_TOPIC: _DYNAMIC_QOS}
        self._subscriptions = {
            topic: self._node.create_subscription(kind, topic, partial(self._hear, topic), profile)
            for topic, profile in qos.items()
        }
        self._began_s = time.monotonic()
        self._tree, self._forbidden = FrameTree(), ""

    def _hear(self, topic: str, message: Any) -> None:
        for transform in message.transforms:
            if not self.is_own(transform):
                self._tree.add(transform.header.frame_id, transform.child_frame_id, topic)
        if self._publisher is not None and topic == STATIC_TOPIC:
            self._check()

    def _check(self) -> bool:
        """Whether the newest result may be broadcast."""
        assert self._newest is not None
        frames = self._newest.mounting[0], self._newest.child_frame
        forbidden = self._tree.what_forbids(*frames)
        if forbidden and forbidden != self._forbidden:
            self._log.error(
                f"publish_tf is refused: {forbidden}. Put the result into the robot's description "
                "(extrinsic.urdf.xacro, which ~/save writes), or leave publish_tf off"
            )
            if self._publisher is not None:
                self._log.error("restart the listeners: some of them believe the other parent")
            self._withdraw()
        self._forbidden = forbidden
        return not forbidden

    def _broadcast(self) -> None:
        is_looking = time.monotonic() - self._began_s < LOOK_S
        if not self.is_on or is_looking or self._waiting_for or not self._check():
            return
        assert self._newest is not None
        if DYNAMIC_TOPIC in self._subscriptions:  # enough of that: it may be fast
            self._node.destroy_subscription(self._subscriptions.pop(DYNAMIC_TOPIC))
        if self._publisher is None:
            self._publisher = self._node.create_publisher(message_type(), STATIC_TOPIC, _STATIC_QOS)
            self._log.info("the result has settled: it is broadcast on /tf_static from now on")
        transform = to_mounting(self._newest)
        self._own.append(transform)
        self._publisher.publish(message_type()(transforms=[transform]))

    def _withdraw(self) -> None:
        """Give nothing to new listeners; those who have heard the edge keep it."""
        if self._publisher is not None:
            self._node.destroy_publisher(self._publisher)
            self._publisher = None
            self._log.warning(
                "the edge on /tf_static is withdrawn; listeners that have heard it keep it until "
                "they are restarted"
            )


def message_type(wanted_by: str = "publish_tf") -> type[Any]:
    """tf2_msgs/TFMessage.

    Parameters
    ----------
    wanted_by : str
        The parameter that needs it.

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
            f"ros-jazzy-tf2-msgs, or {_INSTEAD[wanted_by]}"
        ) from None
    return TFMessage
