"""Publishers of the node, for its results and its state."""

import json
from collections.abc import Iterator
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from hand_eye_calib.core.base.plain import plain
from hand_eye_calib.core.base.text import in_words
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.records import AXES, ROTATIONS
from hand_eye_calib.online.live.progress import AXIS_KEYS
from hand_eye_calib.online.live.state import GRACE_S, NodeState
from hand_eye_calib.online.ros.conversions import (
    LATCHED,
    to_pose_with_covariance,
    to_time,
    to_transform,
)
from hand_eye_calib.online.ros.markers import to_markers

PROGRESS_TOPIC = "progress"
# Longest time for which the ending node waits until subscribers have received its last state.
_GRACE = Duration(seconds=GRACE_S)

# Keys of all mappings by axis.
_AXIS_NAMES = {*AXES, *AXIS_KEYS.values()}

# Keys of the state that are left out of the names of values on /diagnostics.
_OMITTED = ("progress", "axes", "result", "differences")


class ResultTopics:
    """Publish results on ``~/extrinsic``, ``~/extrinsic_with_covariance`` and ``~/markers``.

    All topics are latched: late subscribers receive the last message.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._newest: Calibration | None = None
        self._markers = node.create_publisher(MarkerArray, "~/markers", LATCHED)
        self._advertise()

    def _advertise(self) -> None:
        """Make the publishers of the result."""
        # Whether ~/extrinsic has a message.
        self._has_transform = False
        make = self._node.create_publisher
        self._transform = make(TransformStamped, "~/extrinsic", LATCHED)
        self._pose = make(
            PoseWithCovarianceStamped, "~/extrinsic_with_covariance", LATCHED
        )

    def publish(self, calibration: Calibration | None) -> None:
        """Publish a result if it is new. None withdraws the earlier result.

        An axis that is not determined is zero in the messages. ``~/extrinsic`` has no covariance,
        so it is published only if the rotation and two axes of the translation are determined. Late
        subscribers do not receive a withdrawn message.
        """
        if calibration is self._newest:
            return
        self._newest = calibration
        self._markers.publish(to_markers(calibration))
        if calibration is None:
            self._withdraw()
            return
        hidden = calibration.hidden
        if len(hidden) <= 1 and not set(hidden) & set(ROTATIONS):
            self._transform.publish(to_transform(calibration))
            self._has_transform = True
        elif self._has_transform:
            self._withdraw()
        self._pose.publish(to_pose_with_covariance(calibration))

    def _withdraw(self) -> None:
        """Replace the publishers, so that late subscribers receive no old message."""
        for publisher in (self._transform, self._pose):
            self._node.destroy_publisher(publisher)
        self._advertise()


class StateTopics:
    """Publish the state of the node as JSON on ``~/progress`` (latched) and on ``/diagnostics``."""

    def __init__(self, node: Node) -> None:
        self._progress = node.create_publisher(
            String, f"~/{PROGRESS_TOPIC}", LATCHED
        )
        self._diagnostics = node.create_publisher(
            DiagnosticArray, "/diagnostics", 10
        )

    def publish(self, state: NodeState, clock_ns: int) -> None:
        """Publish the state at a time of the node's clock (ns); 0 if the clock does not run."""
        self._progress.publish(
            String(data=json.dumps(plain(state), allow_nan=False))
        )
        self._diagnostics.publish(diagnostics(state, clock_ns))
        if state.has_ended:
            self._progress.wait_for_all_acked(_GRACE)


def diagnostics(state: NodeState, clock_ns: int) -> DiagnosticArray:
    """Return the message for ``/diagnostics``, with one status for each part of the node.

    The name of a status begins with the fully qualified name of the node, so that two nodes have
    different names. The status of the progress has the headline of the node.
    """
    message = DiagnosticArray()
    message.header.stamp = to_time(clock_ns)
    for name, part in state.parts():
        values = dict(_values(plain(part)))
        status = DiagnosticStatus(
            level=bytes([part.level]),
            name=f"{state.node}: {name}",
            message=state.headline if name == "progress" else part.text,
            hardware_id="hand_eye_calib",
            values=[
                KeyValue(key=key, value=text) for key, text in values.items()
            ],
        )
        message.status.append(status)
    return message


def _values(
    value: Any, path: tuple[str, ...] = ()
) -> Iterator[tuple[str, str]]:
    """Yield the name and the text of each value in a part of the state.

    A name consists of the keys that lead to the value, with the axis last, such as ``sigma.x``.
    ``path`` has the keys that lead to ``value``.
    """
    # The first of several differences is the difference from the installed transform. Only this one
    # is published.
    if isinstance(value, list) and value and isinstance(value[0], dict):
        value = value[0]
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _values(item, (*path, key))
    elif path not in (("level",), ("text",)):
        axes = [key for key in path if key in _AXIS_NAMES]
        keys = [key for key in path if key not in (*_OMITTED, *axes)]
        text = in_words(value)
        if value is None:
            text = "unknown"
        elif isinstance(value, bool):
            text = text.lower()
        yield ".".join(keys + axes), text
