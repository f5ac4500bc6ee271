"""What the node publishes: its results, and its state."""

import json
from collections.abc import Iterator
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import String

from hand_eye_calib.core.base.plain import plain
from hand_eye_calib.core.base.text import in_words
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.records import AXES, ROTATIONS
from hand_eye_calib.online.live.state import GRACE_S, NodeState
from hand_eye_calib.online.ros.conversions import (
    LATCHED,
    to_pose_with_covariance,
    to_time,
    to_transform,
)

PROGRESS_TOPIC = "progress"
# The end of the node waits for those who listen, as it does for a disk.
_LAST_WORD = Duration(seconds=GRACE_S)

# Parts of the state that the names of values on /diagnostics leave out.
_UNNAMED = ("progress", "axes", "result", "differences")


class ResultTopics:
    """Publishes results on ``~/extrinsic`` and ``~/extrinsic_with_covariance``, latched."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._newest: Calibration | None = None
        self._advertise()

    def _advertise(self) -> None:
        self._is_told = False
        make = self._node.create_publisher
        self._transform = make(TransformStamped, "~/extrinsic", LATCHED)
        self._pose = make(PoseWithCovarianceStamped, "~/extrinsic_with_covariance", LATCHED)

    def publish(self, calibration: Calibration | None) -> None:
        """Publish a result that is new: with its covariance always, alone if the rotation and two
        axes of the translation are determined, as the others are zeros; if not, or with None, an
        earlier one is withdrawn: who subscribes from now on gets none.
        """
        if calibration is self._newest:
            return
        self._newest = calibration
        if calibration is None:
            self._withdraw()
            return
        if len(calibration.hidden) <= 1 and {*calibration.hidden}.isdisjoint(ROTATIONS):
            self._transform.publish(to_transform(calibration))
            self._is_told = True
        elif self._is_told:
            self._withdraw()
        self._pose.publish(to_pose_with_covariance(calibration))

    def _withdraw(self) -> None:
        for publisher in (self._transform, self._pose):
            self._node.destroy_publisher(publisher)
        self._advertise()


class StateTopics:
    """Publishes the node's state: as JSON on ``~/progress``, latched, and on ``/diagnostics``."""

    def __init__(self, node: Node) -> None:
        self._progress = node.create_publisher(String, f"~/{PROGRESS_TOPIC}", LATCHED)
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)

    def publish(self, state: NodeState, clock_ns: int) -> None:
        """Publish the state; ``clock_ns`` is the node's clock, 0 if it does not run."""
        self._progress.publish(String(data=json.dumps(plain(state), allow_nan=False)))
        self._diagnostics.publish(diagnostics(state, clock_ns))
        if state.has_ended:
            self._progress.wait_for_all_acked(_LAST_WORD)


def diagnostics(state: NodeState, clock_ns: int) -> DiagnosticArray:
    """The message for ``/diagnostics``: a status for each part of the node, by its fully qualified
    name: two nodes must be told apart.
    """
    message = DiagnosticArray()
    message.header.stamp = to_time(clock_ns)
    for name, part in state.parts():
        values = dict(_values(plain(part)))
        status = DiagnosticStatus(
            level=bytes([part.level]),
            name=f"{state.node}: {name}",
            message=part.text,
            hardware_id="hand_eye_calib",
            values=[KeyValue(key=key, value=text) for key, text in values.items()],
        )
        message.status.append(status)
    return message


def _values(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, str]]:
    """Names and texts of the values of a part: those of a mapping have its name before theirs, and
    the axis is last, as in ``sigma.x``.
    """
    if isinstance(value, list) and value and isinstance(value[0], dict):
        value = value[0]  # of comparisons, that with what is installed
    if isinstance(value, dict):
        for name, each in value.items():
            yield from _values(each, (*path, name))
    elif path not in (("level",), ("text",)):
        axes = [name for name in path if name in AXES]
        name = ".".join([each for each in path if each not in (*_UNNAMED, *axes)] + axes)
        if isinstance(value, bool):
            value = str(value).lower()
        yield name, "unknown" if value is None else in_words(value)
