"""The subscriptions of the node's inputs: from a topic, or from transforms, to poses."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any

from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from hand_eye_calib.core.base.config import POSE_TYPES, CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError, NoPoseError
from hand_eye_calib.core.base.text import counted, listing
from hand_eye_calib.formats.bags import messages
from hand_eye_calib.formats.transforms import PoseFields, TfSource, TfStream
from hand_eye_calib.online.live.input import PoseInput, with_stamp
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.session import LiveSession
from hand_eye_calib.online.ros.conversions import LISTENING, message_class, quick
from hand_eye_calib.online.ros.tf import DYNAMIC_TOPIC, STATIC_TOPIC, message_type

_QOS_OVERRIDES = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY)

_, *_TYPES = POSE_TYPES  # without auto

_BAD_QOS = (ParameterException, InvalidQosOverridesError, RuntimeError, AssertionError, ValueError)

Parts = tuple[LiveSession, NodeLog, Callable[[PoseInput], None]]


class RosInput(PoseInput):
    """An input that subscribes; with each subscription, what is called with a message and its info.
    The parts are those of :class:`~hand_eye_calib.online.live.input.PoseInput`.
    """

    def __init__(self, name: str, topic: str, parts: Parts) -> None:
        super().__init__(name, topic, *parts)
        self._subscribed: list[tuple[Subscription, Callable[[Any, Mapping[str, int]], None]]] = []

    def take_waiting(self) -> bool:
        """Take the messages that wait in the queues; whether there were any."""
        before = self._arrived
        for one, callback in self._subscribed:
            take = partial(one.handle.take_message, one.msg_type, one.raw)
            with one.handle:
                for taken in islice(iter(take, None), one.qos_profile.depth):
                    callback(*taken)
        return self._arrived > before


class TopicInput(RosInput):
    """Subscribes to the poses of one sensor: to messages of the wanted type, or "auto" for that of
    the publishers.
    """

    def __init__(self, node: Node, name: str, wanted_type: str, parts: Parts) -> None:
        self._relative_topic = f"{name}_odom"
        super().__init__(name, node.resolve_topic_name(self._relative_topic), parts)
        self._node = node
        self._wanted_type = wanted_type
        self._n_publishers = 0
        self._type_name = ""

    def discover(self) -> None:
        """Subscribe as soon as the type is known; to be called often.

        Raises
        ------
        ConfigError
            If a type that is wanted cannot be used. A type that is found is refused in the log.
        """
        # Of the topic as resolved: rclpy's count does not follow remaps itself.
        publishers = self._node.get_publishers_info_by_topic(self._relative_topic)
        self._n_publishers = len(publishers)
        self.publishers = tuple(
            f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"
            for publisher in publishers
            if self._type_name in ("", publisher.topic_type)
        )
        self.problem = self._why_deaf(publishers) or counted(len(publishers), "publisher")
        is_wanted = self._wanted_type != "auto"
        offered = {each.topic_type for each in publishers}
        wanted = [self._wanted_type] if is_wanted else _TYPES
        usable = [each for each in wanted if each in offered]
        if offered and not usable:
            self.problem = f"it has type {listing(sorted(offered))}; expected {', '.join(wanted)}"
            self._log.warning(
                f"{self.topic}: {self.problem}: remap {self._relative_topic} to a topic with poses"
            )
        if self._subscribed or not (usable or is_wanted):
            return
        try:
            self._subscribe((usable or wanted)[0])
        except ConfigError as error:
            if is_wanted:
                raise
            self.problem = str(error)
            self._log.error(f"{self.topic} is not used: {error}")

    def _why_deaf(self, publishers: Sequence[TopicEndpointInfo]) -> str:
        """Why the middleware brings nothing of these publishers; empty if it does."""
        offered = {each.qos_profile.reliability for each in publishers}
        own = {each.qos_profile.reliability for each, _ in self._subscribed}
        if own != {ReliabilityPolicy.RELIABLE} or offered != {ReliabilityPolicy.BEST_EFFORT}:
            return ""
        return "it is published best effort, and qos_overrides ask for reliable: leave them out"

    def _subscribe(self, type_name: str) -> None:
        measures = messages.measured_as(type_name, self._wanted, self.topic)
        self._session.set_measures(self.name, measures)
        self._read = messages.MessageReader(type_name, measures, self._session.origin(self.name))
        # With two arguments, rclpy passes the info as well, which its annotations do not know.
        callback: Any = self._receive
        try:
            subscription = self._node.create_subscription(
                message_class(type_name),
                self._relative_topic,
                callback,
                quick(),
                # As bytes: making the objects of a message takes ten times as long as reading what
                # is needed of it.
                raw=True,
                qos_overriding_options=QoSOverridingOptions(_QOS_OVERRIDES),
            )
        except _BAD_QOS as error:
            raise ConfigError(
                f"cannot subscribe to {self.topic} with the QoS overrides given: {error}"
            ) from error
        self._subscribed = [(subscription, callback)]
        self._type_name = type_name
        self._log.info(f"subscribed to {self.topic} ({type_name}) for the {self.name} sensor")

    def _receive(self, data: bytes, info: Mapping[str, int]) -> None:
        # With several publishers, or none any more, the numbers of lost messages are not known.
        self.count(info["publication_sequence_number"] if self._n_publishers == 1 else None)
        try:
            stamp_ns = messages.Cursor(data, is_ros1=False).stamp_ns()
        except messages.MALFORMED as error:
            received_s = info["received_timestamp"] * 1e-9
            self.refuse(f"received at {received_s:.3f} s", "malformed", str(error))
            return
        self.accept(stamp_ns, partial(self._read, data))


class TfInput(RosInput):
    """Takes the poses of one sensor, parent or child, from ``/tf`` and ``/tf_static``."""

    def __init__(self, node: Node, name: str, source: TfSource, parts: Parts) -> None:
        super().__init__(name, str(source), parts)
        self._stream = TfStream(source, max_gap_s=0.0)
        kind = message_type(f"{name}_tf")
        for topic, qos in ((STATIC_TOPIC, LISTENING), (DYNAMIC_TOPIC, quick())):
            heard: Any = partial(self._hear, topic)
            self._subscribed.append((node.create_subscription(kind, topic, heard, qos), heard))

    def configure(self, config: CalibratorConfig) -> None:
        super().configure(config)
        messages.measured_as("", self._wanted, self.topic)  # or it raises
        self._stream.max_gap_s = config.max_gap

    def discover(self) -> None:
        """Say what is missing; to be called often."""
        self.problem = self._stream.describe_missing()

    def _hear(self, topic: str, message: Any, info: Mapping[str, int]) -> None:
        for transform in map(messages.transform_of, message.transforms):
            try:
                for pose in self._stream.add(transform, topic == STATIC_TOPIC):
                    self.accept(pose.stamp_ns, partial(PoseFields, *pose))
            except NoPoseError as error:
                self.leave_out(with_stamp(transform.stamp_ns), error)
            except InputError as error:
                self.refuse(with_stamp(transform.stamp_ns), "unusable", str(error))
