"""The extrinsic on ``/tf_static``: only once the goal is reached, and never as a second parent."""

import math
import time
from collections import deque
from collections.abc import Sequence
from functools import partial
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from hand_eye_calib.errors import ConfigError
from hand_eye_calib.live.log import NodeLog
from hand_eye_calib.live.state import Broadcast
from hand_eye_calib.results.calibration import Calibration, DofVerdict, Verdict
from hand_eye_calib.results.verdict import target_of
from hand_eye_calib.ros.conversions import LATCHED, LISTENING, to_mounting
from hand_eye_calib.text import axes_in_words

STATIC_TOPIC = "/tf_static"
DYNAMIC_TOPIC = "/tf"

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
        above, waiting = set[str](), [parent]
        while waiting:
            for frame in self._parents.get(waiting.pop(), {}):
                if frame not in above:
                    above.add(frame)
                    waiting.append(frame)
        if child in above:
            return f"{parent} is below {child} in the tree already: the edge would close a circle"
        return ""


class TfBroadcaster:
    """Broadcasts the results of a session that has reached its goal on ``/tf_static`` while that is
    switched on, and with them the results of further child sensors.

    Parameters
    ----------
    node : rclpy.node.Node
    log : NodeLog
    """

    def __init__(self, node: Node, log: NodeLog) -> None:
        self._node, self._log = node, log
        self._tree = FrameTree()
        self._own: deque[TransformStamped] = deque(maxlen=_MOST_OWN)
        self._publisher: Publisher | None = None
        self._subscriptions: dict[str, Subscription] = {}
        self._began_s = 0.0
        self._forget()

    def _forget(self) -> None:
        self._newest: Calibration | None = None
        self._others: list[Calibration] = []
        self._waiting_for = "no result yet"
        self._forbidden: dict[str, str] = {}  # frame to the reason

    @property
    def refused(self) -> str:
        """Why something may not be broadcast; empty if all may."""
        return "; ".join(self._forbidden.values())

    @property
    def state(self) -> tuple[Broadcast, str]:
        """What is done about it, and the reason."""
        if not self._subscriptions:
            return Broadcast.OFF, ""
        if self._publisher is not None:
            return Broadcast.ON, self.refused
        if self._forbidden:
            return Broadcast.REFUSED, self.refused
        return Broadcast.WAITING, self._waiting_for or "the transform tree is looked at first"

    def switch(self, on: bool) -> None:
        """Start or stop; a listener that has heard the edge keeps it until it is restarted."""
        if on and not self._subscriptions:
            kind = message_type()
            for topic, qos in ((STATIC_TOPIC, LISTENING), (DYNAMIC_TOPIC, _DYNAMIC_QOS)):
                self._subscriptions[topic] = self._node.create_subscription(
                    kind, topic, partial(self._hear, topic), qos
                )
            self._began_s = time.monotonic()
            self._tree, self._forbidden = FrameTree(), {}
            self.look()
        elif not on and self._subscriptions:
            for subscription in self._subscriptions.values():
                self._node.destroy_subscription(subscription)
            self._subscriptions.clear()
            self._withdraw()

    def is_own(self, transform: TransformStamped) -> bool:
        """Whether this node has broadcast the transform."""
        return transform in self._own

    def add(self, calibration: Calibration, is_done: bool) -> None:
        """Take the next result of the session, and whether the goal is reached with it."""
        self._newest = calibration
        unknown = what_is_unknown(calibration)
        self._waiting_for = unknown if is_done else "the goal is not reached"
        self._broadcast()

    def add_others(self, calibrations: Sequence[Calibration]) -> None:
        """Take the results of all further child sensors, in the frames that they are mounted on."""
        self._others = []
        for calibration in calibrations:
            if unknown := what_is_unknown(calibration):
                self._log.info(f"{calibration.child_frame} is not on /tf_static: {unknown}")
            else:
                self._others.append(calibration)
        self._broadcast()

    def look(self) -> None:
        """Go on if the transform tree has been listened to for long enough; to be called often."""
        if self._publisher is None:
            self._broadcast()

    def restart(self) -> None:
        """Begin a new session: what was broadcast is withdrawn."""
        self._forget()
        self._withdraw()

    def _hear(self, topic: str, message: Any) -> None:
        for transform in message.transforms:
            if not self.is_own(transform):
                self._tree.add(transform.header.frame_id, transform.child_frame_id, topic)
        if self._publisher is not None and topic == STATIC_TOPIC and self._finds_forbidden():
            self._broadcast()

    def _finds_forbidden(self) -> bool:
        """Whether there is another edge that may not be broadcast."""
        assert self._newest is not None
        before, self._forbidden = self._forbidden, {}
        for each in (self._newest, *self._others):
            if why := self._tree.what_forbids(each.mounting[0], each.child_frame):
                self._forbidden[each.child_frame] = why
        new = [why for frame, why in self._forbidden.items() if why != before.get(frame)]
        for why in new:
            self._log.error(
                f"publish_tf is refused: {why}. Put the result into the robot's description "
                "(extrinsic.urdf.xacro, which ~/save writes), or leave publish_tf off"
            )
            if self._publisher is not None:
                self._log.error("restart the listeners: some of them believe the other parent")
        return bool(new)

    def _broadcast(self) -> None:
        is_looking = time.monotonic() - self._began_s < LOOK_S
        if not self._subscriptions or is_looking or self._waiting_for or self._newest is None:
            return
        self._finds_forbidden()
        if self._newest.child_frame in self._forbidden:
            self._withdraw()
            return
        if DYNAMIC_TOPIC in self._subscriptions:  # enough of that: it may be fast
            self._node.destroy_subscription(self._subscriptions.pop(DYNAMIC_TOPIC))
        if self._publisher is None:
            self._publisher = self._node.create_publisher(message_type(), STATIC_TOPIC, LATCHED)
            self._log.info("the result is broadcast on /tf_static from now on")
        # In one message: new listeners get the last one alone.
        found = [each for each in self._others if each.child_frame not in self._forbidden]
        transforms = [to_mounting(each) for each in (self._newest, *found)]
        self._own.extend(transforms)
        self._publisher.publish(message_type()(transforms=transforms))

    def _withdraw(self) -> None:
        """Give nothing to new listeners; those who have heard the edge keep it."""
        if self._publisher is not None:
            self._node.destroy_publisher(self._publisher)
            self._publisher = None
            self._log.warning(
                "the edge on /tf_static is withdrawn; listeners that have heard it keep it until "
                "they are restarted"
            )


def what_is_unknown(calibration: Calibration) -> str:
    """What a result lacks to be a whole transform that may be used; empty if nothing."""
    if calibration.verdict is Verdict.DO_NOT_USE:
        return calibration.headline
    rough = [
        dof.name
        for dof in calibration.observability
        if not math.isfinite(dof.sigma)
        or (dof.verdict is not DofVerdict.PRIOR and dof.sigma > target_of(dof.name, calibration))
    ]
    return f"{axes_in_words(rough)} not known to the target" if rough else ""


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
