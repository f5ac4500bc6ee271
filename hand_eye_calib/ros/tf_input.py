"""An input whose poses exist only as transforms on ``/tf`` and ``/tf_static``."""

import time
from functools import partial
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from hand_eye_calib.config import NodeConfig
from hand_eye_calib.errors import InputError, printable
from hand_eye_calib.io.bags.messages import PoseFields
from hand_eye_calib.io.transforms import TfSource
from hand_eye_calib.ros.conversions import to_ns
from hand_eye_calib.ros.inputs import PoseInput, waiting_messages, with_stamp
from hand_eye_calib.ros.parameters import Parameters
from hand_eye_calib.ros.tf import DYNAMIC_TOPIC, STATIC_TOPIC, message_type
from hand_eye_calib.ros.tf_stream import StampedPose, StampedTransform, TfStream

_DEPTH = 1000
_STATIC_QOS = QoSProfile(
    depth=_DEPTH,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
_DYNAMIC_QOS = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)


class TfInput(PoseInput):
    """Takes the poses of one sensor from the transform tree.

    Parameters
    ----------
    node : rclpy.node.Node
    name : {"parent", "child"}
    source : TfSource
    *arguments
        The others of :class:`~hand_eye_calib.ros.inputs.PoseInput`.
    """

    def __init__(self, node: Node, name: str, source: TfSource, *arguments: Any) -> None:
        super().__init__(node, name, str(source), *arguments)
        self._source = source
        self._stream = TfStream(source, max_gap_s=0.0)
        self._subscriptions: dict[str, Subscription] = {}

    def configure(self, options: Parameters) -> None:
        super().configure(options)
        self._measures_as("")
        self._stream.max_gap_s = options.calibrator.max_gap

    def discover(self, wanted_type: str) -> None:
        if self._subscriptions:
            return
        kind = message_type(f"{self.name}_tf")
        for topic, qos in ((STATIC_TOPIC, _STATIC_QOS), (DYNAMIC_TOPIC, _DYNAMIC_QOS)):
            # With two arguments rclpy passes the info as well, which its annotations do not know.
            callback: Any = partial(self._hear, topic)
            self._subscriptions[topic] = self._node.create_subscription(kind, topic, callback, qos)
        self._log.info(f"{self._source} is taken from /tf for the {self.name} sensor")

    def describe_silence(self) -> str:
        return f"no pose yet of {self._source}: {self.what_is_missing()}"

    def what_is_missing(self) -> str:
        return self._stream.describe_missing()

    def _hear(self, topic: str, message: Any, info: dict[str, Any]) -> None:
        self._receive(topic, message, info)
        for queued in waiting_messages(self._subscriptions.get(topic)):
            self._receive(topic, *queued)

    def _receive(self, topic: str, message: Any, info: dict[str, Any]) -> None:
        waited_ns = time.time_ns() - info["received_timestamp"]
        self.monitor.delivery.note(None, waited_ns * 1e-9)  # /tf has many publishers
        for each in message.transforms:
            transform = _stamped(each)
            try:
                for pose in self._stream.add(transform, topic == STATIC_TOPIC):
                    self.accept(pose.stamp_ns, partial(self._fields, pose))
            except InputError as error:
                self._refuse(with_stamp(transform.stamp_ns), "unusable", str(error))

    def _fields(self, pose: StampedPose) -> PoseFields:
        frames = self._source.world_frame, self._source.sensor_frame
        return PoseFields(pose.stamp_ns, *frames, list(pose.position), list(pose.quat_xyzw))


def tf_source(options: NodeConfig, name: str) -> TfSource | None:
    """The frames from whose transforms an input takes its poses; None for a topic."""
    text: str = getattr(options, f"{name}_tf")
    return TfSource.parse(text) if text else None


def _stamped(message: TransformStamped) -> StampedTransform:
    place, rotation = message.transform.translation, message.transform.rotation
    return StampedTransform(
        to_ns(message.header.stamp),
        printable(message.header.frame_id).lstrip("/"),
        printable(message.child_frame_id).lstrip("/"),
        (place.x, place.y, place.z),
        (rotation.x, rotation.y, rotation.z, rotation.w),
    )
