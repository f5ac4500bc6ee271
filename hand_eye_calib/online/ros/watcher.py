"""Connection of ``watch`` to the nodes: it receives their states and sends requests."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
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
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.online.live.state import ANSWER_WITHIN_S, REPORT_PERIOD_S
from hand_eye_calib.online.ros.conversions import LATCHED
from hand_eye_calib.online.ros.outputs import PROGRESS_TOPIC
from hand_eye_calib.online.watch.board import Board, state_of

# Largest number of nodes whose state is received, and of listed topics with poses.
_MAX_NAMES = 20

# Longest wait (s) for the answer to a request: a node answers within ANSWER_WITHIN_S.
_MAX_WAIT_S = 3.0 * ANSWER_WITHIN_S

# Two nodes share a name if both are there for longer than this time (s). The middleware drops a
# killed node only after 20 s (lease of Fast DDS), and it may have been started again.
_SHARED_AFTER_S = 25.0


@dataclass
class _Request:
    """Service call that has no answer yet.

    Attributes
    ----------
    message
        The request message.
    start_s : float
        Time of the request (steady, s).
    future : Future or None
        Future of the answer; None until the service is available.
    """

    client: Client
    message: Any
    start_s: float
    future: Future | None = None


class Watcher:
    """Pass the states of nodes to a board (context manager)."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._context = rclpy.Context()
        rclpy.init(
            args=[],
            context=self._context,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self._node = rclpy.create_node(
            f"hand_eye_calib_watch_{os.getpid()}",
            context=self._context,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._node.create_timer(REPORT_PERIOD_S, self._discover)
        # Names of the nodes whose state is received.
        self._sources: set[str] = set()
        # Times (steady, s) since which several nodes have had the same name, by name.
        self._shared_since_s: dict[str, float] = {}
        # Calls without an answer, by the request of :meth:`ask`.
        self._requests: dict[str, _Request] = {}
        self._discover()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def spin(self, seconds: float) -> None:
        """Process messages for at most this time (s)."""
        self._executor.spin_once(timeout_sec=seconds)
        for name in list(self._requests):
            self._follow(name)

    def ask(self, request: str) -> None:
        """Send a request to the displayed node. The board gets the answer later.

        Parameters
        ----------
        request : str
            A service such as ``solve``, a parameter such as ``prior.z:=1.85m+/-0.02m``, or one of
            ``acknowledge``, ``recalibrate`` and ``forget``.
        """
        if request == "acknowledge":
            self._board.acknowledge()
            return
        node = self._board.node
        if not node or node in self._board.shared_names:
            return
        if request in self._requests:
            return
        now_s = time.monotonic()
        if parameters := self._parameters(request):
            messages = [
                parameter.to_parameter_msg() for parameter in parameters
            ]
            message = SetParameters.Request(parameters=messages)
            client = self._node.create_client(
                SetParameters, f"{self._board.node}/set_parameters"
            )
        else:
            message = Trigger.Request()
            client = self._node.create_client(
                Trigger, f"{self._board.node}/{request}"
            )
        self._requests[request] = _Request(client, message, now_s)
        self._board.answer(request, None, "asked ...", now_s)

    def _parameters(self, request: str) -> list[Parameter]:
        """Return the parameters that a request sets; empty if the request calls a service."""
        name, is_parameter, value = request.partition(":=")
        if is_parameter:
            return [Parameter(name, value=value)]
        if request == "recalibrate":
            return [Parameter("monitor", value=False)]
        if request == "forget":
            return [
                Parameter(f"prior.{axis}", value="")
                for axis in self._board.priors or AXES
            ]
        return []

    def _discover(self) -> None:
        """Subscribe to the states of new nodes, and find shared names and other topics with poses.

        Any program may publish a topic called ``progress``. Therefore the number of nodes is
        limited. The list of topics is for a person whose input has no poses.
        """
        topics = self._node.get_topic_names_and_types()
        self._subscribe(topics)
        self._board.shared_names = self._shared_names(time.monotonic())
        poses = []
        for topic, types in topics:
            namespace, _, _ = topic.rpartition("/")
            if namespace in self._sources or topic in self._board.inputs:
                continue
            pose_types = [name for name in types if name in POSE_TYPES]
            if pose_types and self._node.count_publishers(topic):
                poses += [(topic, type_name) for type_name in pose_types]
        lines = [
            self._describe(topic, type_name)
            for topic, type_name in poses[:_MAX_NAMES]
        ]
        self._board.topics = tuple(
            lines or ["no other topic with poses is published here"]
        )

    def _subscribe(self, topics: Sequence[tuple[str, Sequence[str]]]) -> None:
        """Subscribe to the states of new nodes, given all topics with their types."""
        for topic, types in topics:
            name, _, last = topic.rpartition("/")
            is_state = (
                last == PROGRESS_TOPIC
                and name
                and "std_msgs/msg/String" in types
            )
            if (
                is_state
                and name not in self._sources
                and len(self._sources) < _MAX_NAMES
            ):
                self._sources.add(name)
                take = partial(self._take, name)
                self._node.create_subscription(String, topic, take, LATCHED)

    def _shared_names(self, now_s: float) -> frozenset[str]:
        """Return the names that several nodes have, and have had for some time."""
        for name in self._sources:
            if self._node.count_publishers(f"{name}/{PROGRESS_TOPIC}") > 1:
                self._shared_since_s.setdefault(name, now_s)
            else:
                self._shared_since_s.pop(name, None)
        return frozenset(
            name
            for name, since_s in self._shared_since_s.items()
            if now_s - since_s > _SHARED_AFTER_S
        )

    def _describe(self, topic: str, type_name: str) -> str:
        """Return a line with type and reliability of a topic."""
        publishers = self._node.get_publishers_info_by_topic(topic)
        texts = [type_name.rpartition("/")[2]]
        if publishers:
            names = {
                publisher.qos_profile.reliability.name
                for publisher in publishers
            }
            texts.append(" and ".join(sorted(names)).lower().replace("_", " "))
        return f"{topic} ({', '.join(texts)})"

    def _take(self, name: str, message: String) -> None:
        """Pass the state of a node to the board, unless the state names another node."""
        state = state_of(message.data)
        if state is not None and state.node == name:
            self._board.take(state, time.monotonic())

    def _follow(self, name: str) -> None:
        """Call the service of a request if it is available now. Pass its answer to the board."""
        request = self._requests[name]
        if request.future is None and request.client.service_is_ready():
            request.future = request.client.call_async(request.message)
        elif request.future is not None and request.future.done():
            response: Any = request.future.result()
            if request.client.srv_type is SetParameters:
                refused = [
                    result.reason
                    for result in response.results
                    if not result.successful
                ]
                self._end(name, not refused, "; ".join(refused))
            else:
                self._end(name, response.success, response.message)
        elif time.monotonic() - request.start_s > _MAX_WAIT_S:
            self._end(name, False, f"no answer within {_MAX_WAIT_S:.0f} s")

    def _end(self, name: str, is_good: bool, text: str) -> None:
        """Remove a request, and pass its answer to the board."""
        self._node.destroy_client(self._requests.pop(name).client)
        self._board.answer(
            name, is_good, printable(text) or "done", time.monotonic()
        )
