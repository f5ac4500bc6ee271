"""Listens to the nodes for ``watch``, and passes the presses of its buttons on."""

import os
import re
import time
from collections.abc import Iterable
from functools import partial
from types import TracebackType
from typing import Any, Self

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from std_srvs.srv import Trigger

from hand_eye_calib.errors import printable
from hand_eye_calib.geometry import se3
from hand_eye_calib.ros.status import HARDWARE_ID
from hand_eye_calib.watch.board import Board, Pose, Status

_LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
_DIAGNOSTICS_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)

_NODE_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")

# A service that has not answered for so long will not (s): a solve takes seconds.
_PATIENCE_S = 60.0


class Watcher:
    """Fills a board with what the nodes say; a context manager.

    Parameters
    ----------
    board : Board
    """

    def __init__(self, board: Board) -> None:
        self._board = board
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node(
            f"hand_eye_calib_watch_{os.getpid()}",
            context=self._context,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._node.create_subscription(
            DiagnosticArray, "/diagnostics", self._take, _DIAGNOSTICS_QOS
        )
        self._heard: set[str] = set()
        self._clients: dict[tuple[str, str], Client] = {}
        self._asked: dict[tuple[str, str], tuple[Future | None, float]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def spin(self, seconds: float) -> None:
        """Take what comes in, for at most so long."""
        self._executor.spin_once(timeout_sec=seconds)
        for asked in list(self._asked):
            self._follow(*asked)

    def ask(self, node: str, request: str) -> None:
        """Call ``solve``, ``save`` or ``reset`` of a node; the answer goes to the board."""
        if not node:
            return
        key = node, request
        if key not in self._clients:
            self._clients[key] = self._node.create_client(Trigger, f"{node}/{request}")
        self._asked[key] = None, time.monotonic()
        self._answer(key, None, "asked ...")

    # ------------------------------------------------------------------ input

    def _take(self, message: DiagnosticArray) -> None:
        now_s = time.monotonic()
        for node, statuses in by_node(message.status).items():
            self._board.take(node, statuses, now_s)
            if node not in self._heard:
                self._heard.add(node)
                self._node.create_subscription(
                    TransformStamped, f"{node}/extrinsic", partial(self._take_pose, node), _LATCHED
                )

    def _take_pose(self, node: str, message: TransformStamped) -> None:
        place, rotation = message.transform.translation, message.transform.rotation
        T_parent_child = se3.from_quat_xyzw(
            [place.x, place.y, place.z], [rotation.x, rotation.y, rotation.z, rotation.w]
        )
        rpy = se3.rotation_to_rpy(T_parent_child[:3, :3]).tolist()
        frames = printable(message.header.frame_id), printable(message.child_frame_id)
        self._board.take_pose(node, Pose(*frames, (place.x, place.y, place.z, *rpy)))

    # --------------------------------------------------------------- services

    def _follow(self, node: str, request: str) -> None:
        """Go on with a request: wait for the service, then for the answer."""
        key = node, request
        future, asked_s = self._asked[key]
        client = self._clients[key]
        if future is None and client.service_is_ready():
            self._asked[key] = client.call_async(Trigger.Request()), asked_s
        elif future is not None and future.done():
            del self._asked[key]
            response: Any = future.result()
            self._answer(key, response.success, printable(response.message))
        elif time.monotonic() - asked_s > _PATIENCE_S:
            del self._asked[key]
            self._answer(key, False, f"no answer within {_PATIENCE_S:.0f} s")

    def _answer(self, key: tuple[str, str], good: bool | None, text: str) -> None:
        self._board.answer(*key, good, text, time.monotonic())


def by_node(statuses: Iterable[DiagnosticStatus]) -> dict[str, list[Status]]:
    """The statuses of each calibrator among those of a message, by the node's name."""
    nodes: dict[str, list[Status]] = {}
    for each in statuses:
        node = each.name.rpartition(": ")[0]
        # Anybody may publish anything: services and topics must be possible below the name.
        if each.hardware_id == HARDWARE_ID and _NODE_NAME.fullmatch(node):
            nodes.setdefault(node, []).append(_status(each))
    return nodes


def _status(message: DiagnosticStatus) -> Status:
    return Status(
        part=printable(message.name.rpartition(": ")[2]),
        level=ord(message.level),
        text=printable(message.message),
        values={printable(each.key): printable(each.value) for each in message.values},
    )
