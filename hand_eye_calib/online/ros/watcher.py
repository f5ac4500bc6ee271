"""Listens to the nodes for ``watch``, and passes the presses of its buttons on."""

import os
import time
from functools import partial
from typing import Any, Self

import rclpy
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger

from hand_eye_calib.core.base.config import POSE_TYPES
from hand_eye_calib.core.base.errors import printable
from hand_eye_calib.core.base.text import counted
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.online.live.state import ANSWER_WITHIN_S, REPORT_PERIOD_S
from hand_eye_calib.online.ros.conversions import LATCHED
from hand_eye_calib.online.ros.outputs import PROGRESS_TOPIC
from hand_eye_calib.online.watch.board import Board, state_of

# So many nodes are listened to, and so many topics with poses are told of, at most.
_MOST = 20

# A service that has not answered for so long will not (s).
_PATIENCE_S = 3.0 * ANSWER_WITHIN_S


class Watcher:
    """Fills a board with what the nodes say; a context manager."""

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
        self._node.create_timer(REPORT_PERIOD_S, self._look)
        self._heard: set[str] = set()
        self._asked: dict[str, tuple[Client, Any, Future | None, float]] = {}
        self._look()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def spin(self, seconds: float) -> None:
        """Take what comes in, for at most so long."""
        self._executor.spin_once(timeout_sec=seconds)
        for asked in list(self._asked):
            self._follow(asked)

    def ask(self, request: str) -> None:
        """Do what a button asks for: call ``solve``, ``save`` or ``reset`` of the node that is
        shown, or set a parameter, as in ``prior.z:=1.85m+/-0.02m``; the answer goes to the board.
        """
        if request == "acknowledge":
            self._board.acknowledge()
        elif self._board.node and request not in self._asked:
            parameters = self._parameters(request)
            kind = Trigger
            name = request
            message = Trigger.Request()
            if parameters:
                kind = SetParameters
                name = "set_parameters"
                messages = [parameter.to_parameter_msg() for parameter in parameters]
                message = SetParameters.Request(parameters=messages)
            client = self._node.create_client(kind, f"{self._board.node}/{name}")
            self._asked[request] = client, message, None, time.monotonic()
            self._board.answer(request, None, "asked ...", time.monotonic())

    def _parameters(self, request: str) -> list[Parameter]:
        """The parameters that a request sets; none if it calls a service."""
        name, is_parameter, value = request.partition(":=")
        if is_parameter:
            return [Parameter(name, value=value)]
        if request == "recalibrate":
            return [Parameter("monitor", value=False)]
        if request == "forget":
            axes = self._board.priors or AXES
            return [Parameter(f"prior.{axis}", value="") for axis in axes]
        return []

    def _look(self) -> None:
        """Listen to nodes that are new: anybody may have a topic of that name. And note the topics
        with poses, but those of such nodes, for a person whose input has none.
        """
        found = self._node.get_topic_names_and_types()
        for topic, types in found:
            name, _, last = topic.rpartition("/")
            is_one = last == PROGRESS_TOPIC and name and "std_msgs/msg/String" in types
            if is_one and name not in self._heard and len(self._heard) < _MOST:
                self._heard.add(name)
                take = partial(self._take, name)
                self._node.create_subscription(String, topic, take, LATCHED)
        poses = [(topic, kind) for topic, kinds in found for kind in kinds if kind in POSE_TYPES]
        poses = [each for each in poses if each[0].rpartition("/")[0] not in self._heard]
        told = tuple(self._told(*each) for each in poses[:_MOST])
        self._board.topics = told or ("none is published here",)

    def _told(self, topic: str, kind: str) -> str:
        publishers = self._node.get_publishers_info_by_topic(topic)
        qos = {each.qos_profile.reliability.name.lower().replace("_", " ") for each in publishers}
        count = counted(len(publishers), "publisher")
        told = (kind.rpartition("/")[2], count, " and ".join(sorted(qos)))
        return f"{topic} ({', '.join(filter(None, told))})"

    def _take(self, name: str, message: String) -> None:
        state = state_of(message.data)
        if state is not None and state.node == name:
            self._board.take(state, time.monotonic())

    def _follow(self, request: str) -> None:
        """Go on with a request: wait for the service, then for the answer."""
        client, message, future, asked_s = self._asked[request]
        if future is None and client.service_is_ready():
            self._asked[request] = client, message, client.call_async(message), asked_s
        elif future is not None and future.done():
            response: Any = future.result()
            if client.srv_type is SetParameters:
                refused = [each.reason for each in response.results if not each.successful]
                self._end(request, not refused, "; ".join(refused))
            else:
                self._end(request, response.success, response.message)
        elif time.monotonic() - asked_s > _PATIENCE_S:
            self._end(request, False, f"no answer within {_PATIENCE_S:.0f} s")

    def _end(self, request: str, good: bool, text: str) -> None:
        self._node.destroy_client(self._asked.pop(request)[0])
        self._board.answer(request, good, printable(text) or "done", time.monotonic())
