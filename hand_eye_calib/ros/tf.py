"""The extrinsic on ``/tf_static``, where tf2_msgs is installed."""

from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from hand_eye_calib.errors import ConfigError

_STATIC_QOS = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


def check_available() -> None:
    """Raise ConfigError if tf2_msgs is missing."""
    _message_type()


class StaticBroadcaster:
    """Sends one edge of the tree, anew whenever it changes."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._message_type = _message_type()
        self._publisher = node.create_publisher(self._message_type, "/tf_static", _STATIC_QOS)

    def send(self, transform: TransformStamped) -> None:
        """Broadcast a TransformStamped."""
        self._publisher.publish(self._message_type(transforms=[transform]))

    def close(self) -> None:
        """Stop; a listener that has heard the edge keeps it."""
        self._node.destroy_publisher(self._publisher)


def _message_type() -> type[Any]:
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        raise ConfigError(
            "publish_tf needs the message package tf2_msgs, which is not installed: install "
            "ros-jazzy-tf2-msgs, or leave publish_tf off and use the launch file that ~/save writes"
        ) from None
    return TFMessage
