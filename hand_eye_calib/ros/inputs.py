"""The node's two inputs: from a topic, or from transforms, to poses in the session."""

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.subscription import Subscription

from hand_eye_calib.config import other_names
from hand_eye_calib.engine.pose_buffer import StreamStatistics
from hand_eye_calib.errors import ConfigError, HandEyeCalibError
from hand_eye_calib.io.bags.messages import (
    MALFORMED,
    MessageReader,
    PoseFields,
    measured_as,
    unpack_stamp_ns,
)
from hand_eye_calib.ros.conversions import MESSAGES
from hand_eye_calib.ros.input_monitor import InputMonitor
from hand_eye_calib.ros.live_session import LiveSession
from hand_eye_calib.ros.log import NodeLog
from hand_eye_calib.ros.parameters import Parameters
from hand_eye_calib.ros.stamp_guard import Judgement, StampGuard, Verdict

_QOS_OVERRIDES = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY)

# Messages taken in one callback beyond the first; services and timers have their turn then.
_MOST_AT_ONCE = 50

_BAD_QOS = (
    ParameterException,
    InvalidQosOverridesError,
    RuntimeError,
    AssertionError,
    ValueError,
)


class PoseInput:
    """Hands the poses of one sensor to the session, wherever they come from.

    Parameters
    ----------
    node : rclpy.node.Node
    name : str
        "parent", "child", or one of :func:`~hand_eye_calib.config.other_names`.
    topic : str
        Where they come from, for messages.
    session : LiveSession
    log : NodeLog
    on_jump_back : callable
        Called with this input when its stamps have jumped back: a new session has to begin.

    Attributes
    ----------
    topic : str
        Where they come from.
    is_enabled : bool
        Whether poses are taken.
    monitor : InputMonitor
    guard : StampGuard
    """

    def __init__(
        self,
        node: Node,
        name: str,
        topic: str,
        session: LiveSession,
        log: NodeLog,
        on_jump_back: Callable[["PoseInput"], None],
    ) -> None:
        self.name = name
        self.topic = topic
        self.is_enabled = True
        self.monitor = InputMonitor()
        self.guard = StampGuard()
        self._node, self._session, self._log = node, session, log
        self._on_jump_back = on_jump_back
        self._sensor_frame = ""
        self._max_gap_ns = 0.0
        self._unusable = ""
        self._wanted: str = "auto"
        self._is_watching = False

    @property
    def statistics(self) -> StreamStatistics:
        """What the engine has taken from this input."""
        return self._session.statistics(self.name)

    def configure(self, options: Parameters) -> None:
        """Follow the parameters."""
        self._max_gap_ns = options.calibrator.max_gap * 1e9
        self._wanted = getattr(options.calibrator, f"{self.name}_measures", "auto")
        self._is_watching = options.node.monitor

    def restart(self, because_of: "PoseInput | None") -> None:
        """Begin a new session: asked for, or because the stamps of an input have jumped back."""
        self._sensor_frame = ""
        self.monitor.restart()
        if because_of is None:
            self.guard.restart()
        elif because_of is not self:
            self.guard.restart(time.monotonic())

    def resume(self) -> None:
        """Go on where a session on disk has ended."""
        self.guard.resume(self.statistics.last_stamp_ns)

    def discover(self, wanted_type: str) -> None:
        """Look for publishers; to be called often."""
        raise NotImplementedError

    def describe_silence(self) -> str:
        """Why nothing has come yet, as far as the graph tells."""
        raise NotImplementedError

    def what_is_missing(self) -> str:
        """Why nothing has come yet, if more is known than that; otherwise empty."""
        return self._unusable

    def _measures_as(self, type_name: str) -> str:
        """What messages of a type (empty for transforms) are read as here.

        Raises
        ------
        ConfigError
            If they cannot be used.
        """
        measures = measured_as(type_name, self._wanted, self.topic)
        if self._is_watching and measures != "poses":
            raise ConfigError(f"monitor needs poses; {self.topic} has {measures}")
        return measures

    # -------------------------------------------------------------- messages

    def accept(self, stamp_ns: int, read: Callable[[], PoseFields]) -> None:
        """Take a message; it is read when its stamp is believed."""
        if not self.is_enabled:
            self.monitor.ignored += 1
            return
        steady_s = time.monotonic()
        clock_ns = self._node.get_clock().now().nanoseconds
        self.monitor.note(stamp_ns, clock_ns, steady_s, self._max_gap_ns)
        last_ns = self.guard.last_ns
        judgement = self.guard.check(stamp_ns, read, steady_s)
        if judgement.verdict is Verdict.JUMPED_BACK:
            self._say_jump_back(judgement.taken[0][0], last_ns)
            self._on_jump_back(self)
        elif judgement.verdict is Verdict.OUTDATED:
            self.monitor.refused["of the session before"] += 1
        self._use(judgement, is_first=last_ns is None)

    def flush(self) -> None:
        """Take messages that waited for others, if none came; to be called often."""
        is_first = self.guard.last_ns is None
        self._use(self.guard.flush(time.monotonic()), is_first)

    def _use(self, judgement: Judgement, is_first: bool) -> None:
        for stamp_ns in judgement.dropped:
            text = "its stamp does not fit those before and after it"
            self._refuse(with_stamp(stamp_ns), "corrupt stamp", text)
        for stamp_ns, read in judgement.taken:
            self._take(stamp_ns, read)
        if is_first and judgement.taken:
            first_s = judgement.taken[0][0] * 1e-9
            self._log.info(f"first pose on {self.topic}, stamp {first_s:.3f} s")

    def _take(self, stamp_ns: int, read: Callable[[], PoseFields]) -> None:
        try:
            pose = read()
            if pose.sensor_frame is not None:
                self._set_frame(pose.sensor_frame)
            self._session.add_pose(self.name, stamp_ns, pose.position, pose.quat_xyzw)
        except HandEyeCalibError as error:
            self._refuse(with_stamp(stamp_ns), "unusable", str(error))

    def _set_frame(self, sensor_frame: str) -> None:
        if sensor_frame == self._sensor_frame:  # an empty one too: parameters or a default name it
            return
        self._session.set_frame(self.name, sensor_frame)
        self._sensor_frame = sensor_frame

    def _say_jump_back(self, stamp_ns: int, last_ns: int | None) -> None:
        jump_s = ((last_ns or 0) - stamp_ns) * 1e-9
        self._log.warning(
            f"{self.topic} jumped back by {jump_s:.3f} s (a bag that loops? a clock that was "
            "reset?): new session, earlier poses forgotten"
        )

    def _refuse(self, which: str, reason: str, text: str) -> None:
        self.monitor.note_refused(reason, text, time.monotonic())
        self._log.warning(
            f"{self.topic}: message {which} refused: {text} "
            f"({self.monitor.refused.total()} refused so far)",
            ("refused", self.name),
        )


def with_stamp(stamp_ns: int) -> str:
    """Which message, in words."""
    return f"with stamp {stamp_ns * 1e-9:.9f} s"


class TopicInput(PoseInput):
    """Subscribes to the poses of one sensor.

    The parameters are those of :class:`PoseInput`; the topic is known by the name of the sensor.
    """

    def __init__(self, node: Node, name: str, *arguments: Any) -> None:
        self.relative_topic = relative_topic(name)
        topic = node.resolve_topic_name(self.relative_topic)
        super().__init__(node, name, topic, *arguments)
        self._subscription: Subscription | None = None
        self._type_name = ""

    def discover(self, wanted_type: str) -> None:
        """Subscribe as soon as the type is known, and again if the publisher changes it.

        Raises
        ------
        ConfigError
            If a type that is wanted cannot be used. A type that is found is refused in the log.
        """
        offered = self._offered_types()
        type_name = self._choose_type(offered) if wanted_type == "auto" else wanted_type
        self._unusable = ""
        if type_name is not None and type_name != self._type_name:
            try:
                self._subscribe(type_name)
            except ConfigError as error:
                if wanted_type != "auto":
                    raise
                self._unusable = str(error)
                self._log.error(f"{self.topic} is not used: {error}", ("unusable", self.name))
        publishers = self._node.count_publishers(self.topic)
        self.monitor.delivery.has_one_publisher = publishers == 1

    def describe_silence(self) -> str:
        """Why nothing has come yet, as far as the graph tells."""
        publishers = self._node.count_publishers(self.topic)  # which does not follow remaps itself
        count = f"{publishers or 'no'} publisher{'s' * (publishers != 1)}"
        return f"no pose yet on {self.topic} ({count})"

    def _offered_types(self) -> list[str]:
        infos = self._node.get_publishers_info_by_topic(self.relative_topic)
        return sorted({info.topic_type for info in infos})

    def _choose_type(self, offered: list[str]) -> str | None:
        """The type of the publishers; None if there is none that can be used."""
        if self._type_name in offered:
            return self._type_name
        usable = [name for name in MESSAGES if name in offered]
        if offered and not usable:
            self._log.warning(
                f"{self.topic} has type {', '.join(offered)}; expected {', '.join(MESSAGES)}: "
                f"remap {self.relative_topic} to a topic with poses",
                ("type", self.name),
            )
        return usable[0] if usable else None

    def _subscribe(self, type_name: str) -> None:
        measures = self._measures_as(type_name)
        self._session.set_measures(self.name, measures)
        if self._subscription is not None:
            self._log.warning(f"{self.topic} has changed its type from {self._type_name}")
            self._node.destroy_subscription(self._subscription)
            self._subscription = None
        read = MessageReader(type_name, measures, self._session.origin(self.name))

        def on_message(data: Any, info: dict[str, Any]) -> None:
            self.receive(read, data, info)
            for queued in waiting_messages(self._subscription):
                self.receive(read, *queued)

        # rclpy looks at the signature: with two arguments it passes the info as well, which its
        # annotations do not know.
        callback: Any = on_message
        try:
            self._subscription = self._node.create_subscription(
                MESSAGES[type_name],
                self.relative_topic,
                callback,
                _qos(),
                # As bytes: making the objects of a message takes ten times as long as reading what
                # is needed of it.
                raw=True,
                qos_overriding_options=QoSOverridingOptions(_QOS_OVERRIDES),
            )
        except _BAD_QOS as error:
            raise ConfigError(
                f"cannot subscribe to {self.topic} with the QoS overrides given: {error}"
            ) from error
        self._type_name = type_name
        self._log.info(f"subscribed to {self.topic} ({type_name}) for the {self.name} sensor")

    def receive(self, read: MessageReader, data: bytes, info: dict[str, Any]) -> None:
        """Take a message: the callback of the subscription."""
        waited_ns = time.time_ns() - info["received_timestamp"]
        self.monitor.delivery.note(info["publication_sequence_number"], waited_ns * 1e-9)
        try:
            stamp_ns = unpack_stamp_ns(data)
        except MALFORMED as error:
            received_s = info["received_timestamp"] * 1e-9
            self._refuse(f"received at {received_s:.3f} s", "malformed", str(error))
            return
        self.accept(stamp_ns, partial(read, data))


def _qos() -> QoSProfile:
    """Best effort, which hears reliable publishers too, and a queue for seconds of a fast stream.

    One for each subscription: rclpy writes its overrides into the profile that it is given.
    """
    return QoSProfile(
        depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE
    )


def waiting_messages(subscription: Subscription | None) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Messages that wait in a subscription's queue, each with its info.

    To be taken in the callback: the executor needs several times as long for a message as the
    callback, and on a slow computer falls behind.
    """
    if subscription is None:
        return
    with subscription.handle:
        for _ in range(_MOST_AT_ONCE):
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                return
            yield taken


def relative_topic(name: str) -> str:
    """The topic of an input before remapping."""
    return f"{name}_odom"


def qos_parameter_names(node: Node) -> Iterator[str]:
    """The parameters that rclpy declares for the QoS of the inputs."""
    for name in ("parent", "child", *other_names()):
        topic = node.resolve_topic_name(relative_topic(name))
        for policy in _QOS_OVERRIDES:
            yield f"qos_overrides.{topic}.subscription.{policy.name.lower()}"
