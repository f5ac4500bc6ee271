"""Inputs of the node: subscriptions to a topic with poses, or to transforms."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any, TypeAlias

from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, ReliabilityPolicy
from rclpy.qos_overriding_options import (
    InvalidQosOverridesError,
    QoSOverridingOptions,
)
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from hand_eye_calib.core.base.config import POSE_TYPES, CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError, NoPoseError
from hand_eye_calib.core.base.registry import LIVE_READINGS
from hand_eye_calib.core.base.text import counted, listing, shortened
from hand_eye_calib.formats.bags import messages, unpacking
from hand_eye_calib.formats.files import LONGEST_NAME
from hand_eye_calib.formats.transforms import PoseFields, TfSource, TfStream
from hand_eye_calib.online.live.input import PoseInput, with_stamp
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.session import LiveSession
from hand_eye_calib.online.ros.conversions import (
    LISTENING,
    message_class,
    quick,
)
from hand_eye_calib.online.ros.tf import (
    DYNAMIC_TOPIC,
    STATIC_TOPIC,
    message_type,
)

_QOS_OVERRIDES = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
)

# Message types in the order of preference. The first entry of POSE_TYPES, "auto", is left out.
_TYPES = (*POSE_TYPES[1:], *LIVE_READINGS)

# Errors that rclpy raises for QoS overrides that it cannot apply.
_BAD_QOS = (
    ParameterException,
    InvalidQosOverridesError,
    RuntimeError,
    AssertionError,
    ValueError,
)

# Arguments of PoseInput after name and topic.
Parts: TypeAlias = tuple[LiveSession, NodeLog, Callable[[PoseInput], None]]


class RosInput(PoseInput):
    """An input with subscriptions.

    Parameters
    ----------
    name, topic : str
    parts : tuple
        Further arguments of :class:`~hand_eye_calib.online.live.input.PoseInput`.
    """

    def __init__(self, name: str, topic: str, parts: Parts) -> None:
        super().__init__(name, topic, *parts)
        #: Argument that names another topic; empty if the topic has a publisher.
        self.remapping = ""
        # Subscriptions with their callbacks. A callback gets a message, and rclpy's information
        # about it.
        self._subscribed: list[
            tuple[Subscription, Callable[[Any, Mapping[str, int]], None]]
        ] = []

    def take_waiting(self) -> bool:
        """Process the messages that wait in the queues. Return whether there were any.

        Messages are taken from rclpy directly, because the executor takes much longer per message.
        """
        before = self._arrived
        for subscription, callback in self._subscribed:
            handle = subscription.handle
            take = partial(
                handle.take_message, subscription.msg_type, subscription.raw
            )
            with handle:
                # take() returns None at the end of the queue. The limit is for a queue that fills
                # as fast as messages are taken.
                for message in islice(
                    iter(take, None), subscription.qos_profile.depth
                ):
                    callback(*message)
        return self._arrived > before


class TopicInput(RosInput):
    """The poses of one sensor from a topic.

    Parameters
    ----------
    node : rclpy.node.Node
    name : str
    wanted_type : str
        Message type, or "auto" for the type of the publishers.
    parts : tuple
        See :class:`RosInput`.
    """

    def __init__(
        self, node: Node, name: str, wanted_type: str, parts: Parts
    ) -> None:
        self._relative_topic = f"{name}_odom"
        super().__init__(
            name, node.resolve_topic_name(self._relative_topic), parts
        )
        self._node = node
        self._wanted_type = wanted_type
        self._n_publishers = 0
        self._type_name = ""

    def discover(self) -> None:
        """Subscribe as soon as the message type is known. Call this method often.

        Raises
        ------
        ConfigError
            If the type that the options request is unusable. If the type of the publishers is
            unusable, the log gets an error instead.
        """
        # Unlike count_publishers, this method of rclpy applies remappings to the topic.
        publishers = self._node.get_publishers_info_by_topic(
            self._relative_topic
        )
        self._n_publishers = len(publishers)
        self.publishers = tuple(
            f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"
            for publisher in publishers
            if self._type_name in ("", publisher.topic_type)
        )
        self.problem = self._wrong_qos(publishers) or counted(
            len(publishers), "publisher"
        )
        self.remapping = ""
        if not publishers:
            self.remapping = f"-r {self._relative_topic}:=TOPIC"
        type_name = self._choose_type(
            {publisher.topic_type for publisher in publishers}
        )
        if self._subscribed or not type_name:
            return
        try:
            self._subscribe(type_name)
        except ConfigError as error:
            if self._wanted_type != "auto":
                raise
            self.problem = str(error)
            self._log.error(f"{self.topic} is not used: {error}")

    def _choose_type(self, offered: set[str]) -> str:
        """Return the message type to subscribe to; empty if no offered type is usable."""
        is_auto = self._wanted_type == "auto"
        wanted = _TYPES if is_auto else (self._wanted_type,)
        usable = [type_name for type_name in wanted if type_name in offered]
        if offered and not usable:
            self.problem = f"it has type {listing(sorted(offered))}; expected {', '.join(wanted)}"
            self._log.warning(
                f"{self.topic}: {self.problem}: remap {self._relative_topic} to a topic with poses"
            )
        if is_auto:
            return usable[0] if usable else ""
        return self._wanted_type

    def _wrong_qos(self, publishers: Sequence[TopicEndpointInfo]) -> str:
        """Return the reason why the middleware cannot deliver messages; empty if it can."""
        offered = {
            publisher.qos_profile.reliability for publisher in publishers
        }
        own = {
            subscription.qos_profile.reliability
            for subscription, _ in self._subscribed
        }
        if own != {ReliabilityPolicy.RELIABLE} or offered != {
            ReliabilityPolicy.BEST_EFFORT
        }:
            return ""
        return (
            "it is published best effort, but qos_overrides ask for reliable: remove these "
            "overrides"
        )

    def _subscribe(self, type_name: str) -> None:
        """Subscribe to messages of a type.

        Raises
        ------
        ConfigError
            If the type or the QoS overrides cannot be used.
        """
        measures = messages.measured_as(type_name, self._wanted, self.topic)
        self._session.set_measures(self.name, measures)
        if type_name in LIVE_READINGS:
            self._read = LIVE_READINGS[type_name](self.topic, measures)
        else:
            origin = self._session.origin(self.name)
            self._read = unpacking.MessageReader(type_name, measures, origin)
        # rclpy passes the information about a message to any callback with two arguments. Its
        # annotations do not allow such a callback, so the type is Any.
        callback: Any = self._receive
        try:
            subscription = self._node.create_subscription(
                message_class(type_name),
                self._relative_topic,
                callback,
                quick(),
                # The callback receives bytes. Reading a pose from bytes takes a tenth of the time
                # in which rclpy makes the objects of a message.
                raw=True,
                qos_overriding_options=QoSOverridingOptions(_QOS_OVERRIDES),
            )
        except _BAD_QOS as error:
            raise ConfigError(
                f"cannot subscribe to {self.topic}: {error}; correct its qos_overrides"
            ) from error
        self._subscribed = [(subscription, callback)]
        self._type_name = type_name
        self._log.info(
            f"subscribed to {self.topic} ({type_name}) for the {self.name} sensor"
        )

    def _receive(self, data: bytes, info: Mapping[str, int]) -> None:
        """Process a message in its serialized form."""
        # Each publisher has its own sequence numbers.
        number = info["publication_sequence_number"]
        self.count(number if self._n_publishers == 1 else None)
        if self._n_publishers > 1:
            self.count_mixed(number)
        try:
            stamp_ns = messages.Cursor(data, is_ros1=False).stamp_ns()
        except messages.MALFORMED as error:
            received_s = info["received_timestamp"] * 1e-9
            self.refuse(
                f"received at {received_s:.3f} s", "malformed", str(error)
            )
            return
        self.accept(stamp_ns, partial(self._read, data))


def how_to_remap(node: Node, inputs: Sequence[RosInput]) -> str:
    """Return how the user names other topics for inputs without a publisher; may be empty.

    The text lists the topics with poses that other nodes publish.
    """
    remappings = [source.remapping for source in inputs if source.remapping]
    if not remappings:
        return ""
    own = f"{node.get_fully_qualified_name()}/"
    names = [
        name
        for name, types in node.get_topic_names_and_types()
        if not name.startswith(own)
        and not {*types}.isdisjoint(POSE_TYPES)
        and node.count_publishers(name)
    ]
    text = f"to use other topics, start with {' '.join(remappings)}"
    if names:
        listed = shortened(listing(sorted(names)), LONGEST_NAME)
        text = f"{text}; topics with poses: {listed}"
    return text


class TfInput(RosInput):
    """Poses of parent or child from ``/tf`` and ``/tf_static``."""

    def __init__(
        self, node: Node, name: str, source: TfSource, parts: Parts
    ) -> None:
        super().__init__(name, str(source), parts)
        self._stream = TfStream(source, max_gap_s=0.0)
        kind = message_type(f"{name}_tf")
        for topic, qos in ((STATIC_TOPIC, LISTENING), (DYNAMIC_TOPIC, quick())):
            callback: Any = partial(self._receive, topic)
            subscription = node.create_subscription(kind, topic, callback, qos)
            self._subscribed.append((subscription, callback))

    def configure(self, config: CalibratorConfig) -> None:
        """Apply the options.

        Raises
        ------
        ConfigError
            If the options request measurements that are no poses.
        """
        super().configure(config)
        messages.measured_as("", self._wanted, self.topic)
        self._stream.max_gap_s = config.max_gap

    def discover(self) -> None:
        """Update the reason for missing poses. Call this method often."""
        self.problem = self._stream.describe_missing()

    def _receive(
        self, topic: str, message: Any, info: Mapping[str, int]
    ) -> None:
        """Process the transforms of a message on ``/tf`` or ``/tf_static``."""
        for transform in map(messages.transform_of, message.transforms):
            try:
                for pose in self._stream.add(transform, topic == STATIC_TOPIC):
                    self.accept(pose.stamp_ns, partial(PoseFields, *pose))
            except NoPoseError as error:
                self.leave_out(with_stamp(transform.stamp_ns), error)
            except InputError as error:
                self.refuse(
                    with_stamp(transform.stamp_ns), "unusable", str(error)
                )
