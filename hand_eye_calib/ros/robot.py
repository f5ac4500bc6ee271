"""What the robot has installed, and its base frame: from files, or from the transform tree."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from rclpy.node import Node

from hand_eye_calib.config import NodeConfig
from hand_eye_calib.errors import HandEyeCalibError, InputError
from hand_eye_calib.geometry.extrinsic import Extrinsic
from hand_eye_calib.geometry.frames import FrameTree, checked_pose
from hand_eye_calib.io.installed import of_frames, open_installed
from hand_eye_calib.live.log import NodeLog
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.ros.conversions import LISTENING, from_transform
from hand_eye_calib.ros.tf import STATIC_TOPIC, message_type
from hand_eye_calib.session.compare import with_comparison

TF = "tf"

# What could not be read is tried again after so long.
_AGAIN_S = 5.0


class Robot:
    """Completes results with what is installed, and with the pose in the base frame.

    Parameters
    ----------
    node : rclpy.node.Node
    log : NodeLog
    options : NodeConfig
        Its ``installed`` and ``base_frame`` do not change while the node runs.
    is_own : callable
        Whether this node has broadcast a transform itself.

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

    def __init__(
        self, node: Node, log: NodeLog, options: NodeConfig, is_own: Callable[[Any], bool]
    ) -> None:
        self._log, self._is_own = log, is_own
        self._source, self._base_frame = options.installed, options.base_frame
        self._installed: Extrinsic | None = None
        self._frames = FrameTree(STATIC_TOPIC)
        self._again_at_s = 0.0
        self.problem = ""
        self._read = self._of_tf if self._source in ("", TF) else open_installed(self._source)
        if needs_tf(options):
            kind = message_type("installed")
            node.create_subscription(kind, STATIC_TOPIC, self._hear, LISTENING)

    def installed(self, parent_frame: str, child_frame: str) -> Extrinsic | None:
        """What is installed; None if nothing was given, or it is not known (yet)."""
        if self._installed is None and self._source and time.monotonic() >= self._again_at_s:
            self._again_at_s = time.monotonic() + _AGAIN_S
            try:
                self._installed = self._read(parent_frame, child_frame)
                self.problem = ""
                self._log.info(f"installed is what {self._installed.origin} says")
            except HandEyeCalibError as error:
                self._report(f"what is installed is not known: {error}")
        return self._installed

    def complete(self, calibration: Calibration) -> Calibration:
        """A usable result with its comparison and its pose in the base frame."""
        installed = self.installed(calibration.parent_frame, calibration.child_frame)
        if installed is not None:
            calibration = with_comparison(calibration, installed)
        return self.in_base(calibration)

    def in_base(self, calibration: Calibration) -> Calibration:
        """A result with its pose in the base frame, if one was asked for and is known."""
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

    def lacks_base(self, calibration: Calibration) -> bool:
        """Whether the pose in the base frame was asked for and is not there."""
        return calibration.base_frame != self._base_frame

    def _of_tf(self, parent_frame: str, child_frame: str) -> Extrinsic:
        return of_frames(self._frames, parent_frame, child_frame, STATIC_TOPIC)

    def _report(self, problem: str) -> None:
        self.problem = problem
        self._log.warning(problem, "robot", 60.0)

    def _hear(self, message: Any) -> None:
        for each in message.transforms:
            if self._is_own(each):
                continue
            edge = from_transform(each)
            try:
                pose = checked_pose(edge.position, edge.quat_xyzw)
                self._frames.add(edge.world_frame, edge.sensor_frame or "", pose)
            except HandEyeCalibError as error:
                frame = edge.sensor_frame
                self._report(f"{STATIC_TOPIC} has an unusable transform of {frame}: {error}")


def needs_tf(options: NodeConfig) -> bool:
    """Whether the transform tree has to be listened to."""
    return options.installed == TF or bool(options.base_frame)
