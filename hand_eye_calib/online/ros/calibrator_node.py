"""The node: topics, services, parameters and timers around the live session.

Solves run in a process of their own; everything else happens in the executor's one thread, so
nothing here needs a lock.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial, partialmethod
from itertools import chain, cycle
from pathlib import Path
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from hand_eye_calib.core.base.config import NodeConfig, other_names
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.registry import MOUNT_MONITORS
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.formats.transforms import TfSource
from hand_eye_calib.online.live.cycle import SolveCycle, pause_of, priors_of
from hand_eye_calib.online.live.input import PoseInput
from hand_eye_calib.online.live.journal import FLUSH_PERIOD_S
from hand_eye_calib.online.live.log import GOES_ON_S, NodeLog
from hand_eye_calib.online.live.saving import Saver
from hand_eye_calib.online.live.session import LiveSession, output_path
from hand_eye_calib.online.live.state import REPORT_PERIOD_S, NodeState
from hand_eye_calib.online.ros.inputs import TfInput, TopicInput
from hand_eye_calib.online.ros.outputs import PROGRESS_TOPIC, ResultTopics, StateTopics
from hand_eye_calib.online.ros.parameters import Parameters
from hand_eye_calib.online.ros.tf import TF, Robot, RobotTree, TfBroadcaster, message_type


class CalibratorNode(Node):
    """Estimates the pose of the child sensor in the parent sensor's frame from two live streams of
    poses.

    Raises
    ------
    ConfigError
        If a parameter given at the start is unusable.
    """

    # Without rclpy's warnings about QoS, which the inputs give themselves: each costs as much as a
    # message at every turn of the executor.
    _quiet = PublisherEventCallbacks(use_default_callbacks=False)
    create_publisher = partialmethod(Node.create_publisher, event_callbacks=_quiet)
    _deaf = SubscriptionEventCallbacks(use_default_callbacks=False)
    create_subscription = partialmethod(Node.create_subscription, event_callbacks=_deaf)

    def __init__(self) -> None:
        try:
            super().__init__("calibrator", automatically_declare_parameters_from_overrides=True)
        except ValueError as error:
            raise ConfigError(
                f"a parameter that was given has no usable value, such as []: {error}"
            ) from None
        self._log = NodeLog(self.get_logger())
        self._output_base: Path | None = None
        self._options = Parameters(self, self._follow_parameters, self._check_options)
        for line in self._options.unknown:
            self._log.warning(line)
        options = self._options.node
        config = self._options.calibrator
        self._config = config
        # From now on, participants may choose a directory below this one.
        self._output_base = output_path(options.output_directory or ".").resolve()
        if options.monitor:
            config.require_poses("monitor")
        _ = config.measured  # or it raises
        others = other_names(options.other_children)
        self._session = LiveSession(self._log, config, others)
        tree = RobotTree(self, self._log)
        self._robot = Robot(self._log, options, tree)
        if options.base_frame or options.installed == TF:
            message_type("base_frame" if options.base_frame else "installed")  # or it raises
            tree.listen()
        self._tf = TfBroadcaster(self, self._log, tree)
        self._inputs = [self._make_input(name) for name in ("parent", "child", *others)]
        self._session.topics = {each.name: each.topic for each in self._inputs[:2]}
        if len({each.topic for each in self._inputs}) < len(self._inputs):
            topics = listing([each.topic for each in self._inputs])
            raise ConfigError(f"two inputs have one topic: remap one to another sensor's: {topics}")
        self._session.start_journal(options, is_first=True)
        for each in self._inputs:
            each.resume()
        self._results, self._states = ResultTopics(self), StateTopics(self)
        self._tf.switch(options.publish_tf)
        self._mount = self._watch_mount() if options.monitor else None
        self._answered = self.create_guard_condition(lambda: self._cycle.take_answers())
        hooks = self._answered.trigger, self._robot.complete, self._publish
        self._cycle = SolveCycle(self._session, self._log, *hooks, config.targets)
        self._saver = Saver(self._session, self._cycle, self._log)
        self._serve()
        self._discover()
        self._say_start()

    def take_messages(self) -> bool:
        """Take the messages that wait at the inputs; whether there were any."""
        return max(each.take_waiting() for each in self._inputs)

    def stop(self, timeout_s: float) -> bool:
        """End the solving process and save the newest result; False if that was wanted and could
        not be done.
        """
        self._cycle.stop(timeout_s)
        saved = True
        if self._cycle.result is not None:
            if self._options.node.output_directory:
                saved, _ = self._saver.save(self._options.node)
            else:
                self._log.warning("the result is not saved: output_directory is not set")
        self._publish(has_ended=True)
        self._session.stop_journal()
        return saved

    # ---------------------------------------------------------------- set-up

    def _say_start(self) -> None:
        """Say in one line what the node goes by."""
        options = self._options.node
        inputs = self._inputs
        what = "watching" if options.monitor else "calibrating"
        children = ", ".join(each.topic for each in inputs[1:])
        given = self._options.given.items()
        set_to = [f"{name} {value}" for name, value in given if name != "output_directory"]
        files = f"files go to {self._output_base}" if options.output_directory else ""
        told = [
            f"{what} {children} against {inputs[0].topic}",
            files or "nothing is saved: no output_directory",
            f"set are {', '.join(set_to)}" if set_to else "",
            "" if options.enabled else "no poses are accepted before ~/set_enabled",
        ]
        self._log.info("; ".join(filter(None, told)))

    def _watch_mount(self) -> Any:
        robot = self._robot
        watch = MOUNT_MONITORS["installed"]
        return watch(self._session, robot.installed, lambda: robot.problem, self._log)

    def _make_input(self, name: str) -> TopicInput | TfInput:
        options = self._options.node
        parts = self._session, self._log, self._begin_session
        made: TopicInput | TfInput
        if frames := getattr(options, f"{name}_tf", ""):
            made = TfInput(self, name, TfSource.parse(frames), parts)
        else:
            made = TopicInput(self, name, getattr(options, f"{name}_type", "auto"), parts)
        made.configure(self._options.calibrator)
        made.is_enabled = options.enabled
        return made

    def _serve(self) -> None:
        # A long queue: requests come while the node is busy, too.
        qos = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
        serve = partial(self.create_service, qos_profile=qos)
        # A group of its own: while it awaits a solve, it would hold up every other callback of its
        # group.
        serve(Trigger, "~/solve", self._on_solve, callback_group=ReentrantCallbackGroup())
        save = lambda request: self._saver.save(self._options.node)  # noqa: E731
        serve(Trigger, "~/save", partial(self._answer, save))
        serve(Trigger, "~/reset", partial(self._answer, self._reset))
        serve(SetBool, "~/set_enabled", partial(self._answer, self._set_enabled))
        # Steady time: these go on while a bag, and with it simulated time, is paused.
        make = partial(self.create_timer, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._solve_timer = make(self._options.node.solve_period, self._on_solve_timer)
        # In turn: all at once would hold up messages for long on a slow computer.
        others = [self._publish, *[self._discover] * round(REPORT_PERIOD_S / FLUSH_PERIOD_S - 1)]
        turns = cycle(chain.from_iterable((self._session.flush_journal, each) for each in others))
        make(FLUSH_PERIOD_S / 2, lambda: next(turns)())

    # ---------------------------------------------------------------- timers

    def _discover(self) -> None:
        for each in self._inputs:
            each.discover()
        name = self.get_fully_qualified_name()
        if self.count_publishers(f"{name}/{PROGRESS_TOPIC}") > 1:
            self._log.warning(f"another node is called {name}, too: start one with -r __node:=NAME")

    def _on_solve_timer(self) -> None:
        silent = [each for each in self._inputs if not each.has_poses]
        if silent and silent[0].is_enabled:
            text = "; ".join(f"no pose yet on {each.topic}: {each.problem}" for each in silent)
            self._log.info(text, GOES_ON_S)
        self._cycle.start_if_due()

    def _publish(self, has_ended: bool = False) -> None:
        """Publish all that is to be told now: so the topics agree at every time."""
        self._results.publish(self._cycle.published)
        self._tf.look(self._cycle.result, self._why_not_broadcast())
        if self._mount is not None:
            self._mount.look()
        if not has_ended:
            self.take_messages()  # which a slow computer has kept waiting
        clock_ns = self.get_clock().now().nanoseconds
        self._states.publish(replace(self._state(), has_ended=has_ended), clock_ns)
        self._cycle.answer_overdue()

    def _why_not_broadcast(self) -> str:
        result = self._cycle.result
        progress = self._cycle.goal.progress
        if result is None:
            return "no result yet"
        if self._cycle.published is None:
            return self._cycle.problem
        if not progress.done:
            return "the streams are faulty" if progress.is_faulty else "the goal is not reached"
        wanted = self._options.node.base_frame
        return "" if result.base_frame == wanted else f"base_frame {wanted} is not known"

    def _state(self) -> NodeState:
        cycle = self._cycle
        name = self.get_fully_qualified_name()
        steady_s = time.monotonic()
        # A robot that rests, once there is a result, has nothing more to show. Who has no publisher
        # any more does not rest, unless the goal is reached.
        rests = cycle.published is not None
        rests &= all(each.is_silent(steady_s) for each in self._inputs[:2])
        is_done = cycle.goal.progress.done
        inputs = {
            each.name: each.state(steady_s, rests and (is_done or each.publishers != ()))
            for each in self._inputs
        }
        if self._mount is not None:
            return NodeState(node=name, mount=self._mount.state(), inputs=inputs)
        return NodeState(
            node=name,
            extrinsic=cycle.extrinsic_state(self._inputs[0].is_enabled, self._tf.state),
            progress=cycle.progress_state(
                self._robot.why_not_compared, pause_of(inputs, self._inputs[0].is_enabled)
            ),
            inputs=inputs,
            checks=cycle.checks.state(),
            journal=self._session.journal_state(self._options.node),
            saved=self._saver.state,
        )

    # --------------------------------------------------------------- session

    def _begin_session(self, because_of: PoseInput | None = None) -> None:
        """Begin a new session: asked for, or because the stamps of an input have jumped back."""
        self._session.reset()
        if self._mount is not None and because_of is None:
            self._mount = self._watch_mount()
        for part in (self._log, self._cycle, self._mount):
            if part is not None:
                part.restart()
        self._saver.state = None
        for each in self._inputs:
            each.restart(because_of)
        self._publish()

    # -------------------------------------------------------------- services

    async def _on_solve(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        solved = Future()
        self._cycle.ask(lambda good, text: solved.set_result((good, text)))
        response.success, response.message = await solved
        return response

    def _answer(self, act: Callable[[Any], tuple[bool, str]], request: Any, response: Any) -> Any:
        """Answer a service with what was done: whether it worked, and a line about it."""
        response.success, response.message = act(request)
        self._publish()
        return response

    def _reset(self, request: Trigger.Request) -> tuple[bool, str]:
        self._begin_session()
        text = "all poses forgotten, new session"
        priors = priors_of(self._options.calibrator)
        if priors:
            kept = listing([f"prior.{axis} {value}" for axis, value in priors.items()])
            text = f"{text}; {kept} still set: set to '' to forget it"
        self._log.info(text)
        return True, text

    def _set_enabled(self, request: SetBool.Request) -> tuple[bool, str]:
        for each in self._inputs:
            each.is_enabled = request.data
        text = f"{'' if request.data else 'not '}accepting poses"
        self._log.info(text)
        return True, text

    # ------------------------------------------------------------ parameters

    def _check_options(self, options: NodeConfig) -> None:
        """Raise ConfigError if options cannot be had together, or not on this machine."""
        if options.publish_tf:
            message_type()
        if options.monitor and not options.installed:
            raise ConfigError("monitor needs installed: what the mount is watched against")
        if options.monitor and options.other_children:
            raise ConfigError("monitor watches one child sensor: leave other_children at 0")
        if self._output_base is not None and options.output_directory:
            output_path(options.output_directory, self._output_base)

    def _follow_parameters(self) -> None:
        options = self._options.node
        config = self._options.calibrator
        before = self._config
        if (config, config.given) != (before, before.given):
            self._config = config
            self._session.reconfigure(config)
            self._cycle.follow(config, before)
        for each in self._inputs:
            each.configure(config)
        if options.monitor != (self._mount is not None):
            self._session.watch_only(None)
            self._mount = self._watch_mount() if options.monitor else None
            self._begin_session()
            self._session.start_journal(options)
        self._tf.switch(options.publish_tf)
        period_ns = round(options.solve_period * 1e9)
        if period_ns != self._solve_timer.timer_period_ns:
            self._solve_timer.timer_period_ns = period_ns
            self._solve_timer.reset()
        self._publish()
