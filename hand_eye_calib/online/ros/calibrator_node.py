"""ROS 2 node: topics, services, parameters and timers around the live session.

Solves run in a separate process. All other code runs in the single thread of the executor, so no
lock is needed.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial, partialmethod
from itertools import cycle
from pathlib import Path
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import (
    PublisherEventCallbacks,
    SubscriptionEventCallbacks,
)
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from hand_eye_calib.core.base.config import (
    CalibratorConfig,
    NodeConfig,
    other_names,
)
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.registry import MOUNT_MONITORS
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.formats.transforms import TfSource
from hand_eye_calib.online.live.cycle import SolveCycle
from hand_eye_calib.online.live.describing import pause_of, priors_of
from hand_eye_calib.online.live.input import PoseInput
from hand_eye_calib.online.live.journal import FLUSH_PERIOD_S
from hand_eye_calib.online.live.log import GOES_ON_S, NodeLog
from hand_eye_calib.online.live.saving import Saver
from hand_eye_calib.online.live.session import LiveSession, output_path
from hand_eye_calib.online.live.state import REPORT_PERIOD_S, NodeState, Outcome
from hand_eye_calib.online.ros.inputs import (
    TfInput,
    TopicInput,
    how_to_remap,
)
from hand_eye_calib.online.ros.lifecycle import ManagedNode
from hand_eye_calib.online.ros.outputs import (
    PROGRESS_TOPIC,
    ResultTopics,
    StateTopics,
)
from hand_eye_calib.online.ros.parameters import Parameters
from hand_eye_calib.online.ros.tf import (
    TF,
    Robot,
    RobotTree,
    TfBroadcaster,
    message_type,
)
from hand_eye_calib.online.watch.headline import (
    CHANGE_MOTION,
    CHANGE_TARGET,
    headline_of,
)


class CalibratorNode(ManagedNode):
    """Estimates the pose of the child sensor in the parent sensor's frame from two live streams.

    Raises
    ------
    ConfigError
        If a parameter given at the start is unusable.
    """

    # The inputs report incompatible QoS themselves. So rclpy's default event callbacks are switched
    # off: in every cycle of the executor, they take as much time as a message.
    create_publisher = partialmethod(
        Node.create_publisher,
        event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
    )
    create_subscription = partialmethod(
        Node.create_subscription,
        event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
    )

    def __init__(self) -> None:
        try:
            super().__init__(
                "calibrator",
                automatically_declare_parameters_from_overrides=True,
            )
        except ValueError as error:
            raise ConfigError(
                f"a parameter has an unusable value, such as []: {error}"
            ) from None
        self._log = NodeLog(self.get_logger())
        self._output_base: Path | None = None
        self._options = Parameters(
            self, self._follow_parameters, self._check_options
        )
        for line in self._options.unknown:
            self._log.warning(line)
        self._inputs: list[TopicInput | TfInput] = []
        if self._options.node.lifecycle:
            self.manage()
        else:
            self.configure()
            self.is_configured = True

    def configure(self) -> None:
        """Make session, inputs, topics, services and timers.

        Raises
        ------
        ConfigError
            If an option cannot be applied.
        """
        options = self._options.node
        config = self._options.calibrator
        # From now on, participants may only choose a directory below this one.
        self._output_base = output_path(
            options.output_directory or "."
        ).resolve()
        if options.monitor:
            config.require_poses("monitor")
        # Raises an error for an impossible combination.
        _ = config.measured
        others = other_names(options.other_children)
        self._session = LiveSession(self._log, config, others)
        tree = RobotTree(self, self._log)
        self._robot = Robot(self._log, options, tree)
        if options.base_frame or options.installed == TF:
            # Raises an error if tf2_msgs is not installed.
            message_type("base_frame" if options.base_frame else "installed")
            tree.listen()
        self._tf = TfBroadcaster(self, self._log, tree)
        self._inputs = [
            self._make_input(name) for name in ("parent", "child", *others)
        ]
        self._start_session()
        self._made.callback(self._session.stop_journal)
        self._results = ResultTopics(self)
        self._states = StateTopics(self)
        self._tf.switch(options.publish_tf)
        self._mount = self._watch_mount() if options.monitor else None
        answered = self.create_guard_condition(
            lambda: self._cycle.take_answers()
        )
        self._cycle = SolveCycle(
            self._session,
            self._log,
            answered.trigger,
            self._robot.complete,
            self._publish,
            config.targets,
        )
        self._made.callback(self._cycle.stop, 0.0)
        self._saver = Saver(self._session, self._cycle, self._log)
        self._serve()
        self._start_timers()
        self._discover()
        self._log_start()

    def take_messages(self) -> bool:
        """Process the messages that wait at the inputs. Return whether there were any."""
        had_messages = [source.take_waiting() for source in self._inputs]
        return any(had_messages)

    def stop(self, timeout_s: float) -> bool:
        """End the solving process and save the newest result. Return False if the save failed."""
        if not self.is_configured:
            return True
        self._cycle.stop(timeout_s)
        is_saved = True
        if self._mount is not None and self._options.node.output_directory:
            # A session may be too short for a digest. This is no failure.
            self._save_digest()
        elif self._cycle.result is not None:
            if self._options.node.output_directory:
                is_saved, _ = self._saver.save(self._options.node)
            else:
                self._log.warning(
                    "the result is not saved: output_directory is not set"
                )
        self._publish(has_ended=True)
        self._session.stop_journal()
        self._inputs = []
        return is_saved

    def accept_poses(self, accept: bool) -> None:
        """Accept or ignore poses from now on."""
        for source in self._inputs:
            source.is_enabled = accept
        self._log.info("accepting poses" if accept else "not accepting poses")
        self._publish()

    # ---------------------------------------------------------------- set-up

    def _start_session(self) -> None:
        """Start or resume the session with its journal.

        Raises
        ------
        ConfigError
            If two inputs have the same topic.
        """
        topics = {source.name: source.topic for source in self._inputs}
        if len(set(topics.values())) < len(topics):
            text = "two inputs have the same topic: remap one to the topic of another sensor"
            raise ConfigError(f"{text}: {listing([*topics.values()])}")
        self._session.topics = {
            name: topics[name] for name in ("parent", "child")
        }
        self._session.start_journal(self._options.node, is_first=True)
        for source in self._inputs:
            source.resume()

    def _log_start(self) -> None:
        """Log topics, directory and options in one line."""
        options = self._options.node
        parent, *children = [source.topic for source in self._inputs]
        verb = "watching" if options.monitor else "calibrating"
        texts = [f"{verb} {', '.join(children)} against {parent}"]
        if options.output_directory:
            texts.append(f"files go to {self._output_base}")
        else:
            texts.append("nothing is saved: no output_directory")
        settings = [
            f"{name} {value}"
            for name, value in self._options.given.items()
            if name != "output_directory"
        ]
        if settings:
            texts.append(f"parameters: {', '.join(settings)}")
        if not options.enabled:
            texts.append("poses are not accepted before ~/set_enabled")
        self._log.info("; ".join(texts))

    def _watch_mount(self) -> Any:
        """Return a new monitor of the mount."""
        robot = self._robot
        make = MOUNT_MONITORS["installed"]
        return make(
            self._session, robot.installed, lambda: robot.problem, self._log
        )

    def _make_input(self, name: str) -> TopicInput | TfInput:
        """Return the input of a sensor: transforms if an option names its frames, else a topic."""
        options = self._options.node
        parts = self._session, self._log, self._begin_session
        source: TopicInput | TfInput
        if frames := getattr(options, f"{name}_tf", ""):
            source = TfInput(self, name, TfSource.parse(frames), parts)
        else:
            source = TopicInput(
                self, name, getattr(options, f"{name}_type", "auto"), parts
            )
        source.configure(self._options.calibrator)
        source.is_enabled = options.enabled and not options.lifecycle
        return source

    def _serve(self) -> None:
        """Advertise the services."""
        # The queue is long, because requests also arrive while the node is busy.
        qos = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
        serve = partial(self.create_service, qos_profile=qos)
        # This service has its own callback group. While its callback awaits a solve, no other
        # callback of the group can run.
        serve(
            Trigger,
            "~/solve",
            self._on_solve,
            callback_group=ReentrantCallbackGroup(),
        )
        serve(Trigger, "~/save", partial(self._answer, self._save))
        serve(Trigger, "~/reset", partial(self._answer, self._reset))
        serve(
            SetBool, "~/set_enabled", partial(self._answer, self._set_enabled)
        )

    def _start_timers(self) -> None:
        """Start the timers for solves and for other periodic tasks."""
        # Steady time continues while a bag, and with it simulated time, is paused.
        make_timer = partial(
            self.create_timer, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self._solve_timer = make_timer(
            self._options.node.solve_period, self._on_solve_timer
        )
        # Each call of the timer runs one task, because all tasks of a second together would delay
        # messages on a slow computer. Calls alternate between a flush of the journal and another
        # task. The first other task of a second publishes; the others discover.
        flush = self._session.flush_journal
        tasks = [flush, self._publish]
        for _ in range(round(REPORT_PERIOD_S / FLUSH_PERIOD_S) - 1):
            tasks += [flush, self._discover]
        next_tasks = cycle(tasks)
        make_timer(FLUSH_PERIOD_S / 2, lambda: next(next_tasks)())

    # ---------------------------------------------------------------- timers

    def _discover(self) -> None:
        """Look for publishers of the inputs, and for another node of the same name."""
        for source in self._inputs:
            source.discover()
        name = self.get_fully_qualified_name()
        if self.count_publishers(f"{name}/{PROGRESS_TOPIC}") > 1:
            self._log.warning(
                f"another node is called {name}, too: start one with -r __node:=NAME"
            )

    def _on_solve_timer(self) -> None:
        """Log inputs without a pose, and start a solve if there are new poses."""
        silent = [source for source in self._inputs if not source.has_poses]
        if silent and silent[0].is_enabled:
            texts = [
                f"no pose yet on {source.topic}: {source.problem}"
                for source in silent
            ]
            if remedy := how_to_remap(self, silent):
                texts.append(remedy)
            self._log.info("; ".join(texts), GOES_ON_S)
        self._cycle.start_if_due()

    def _publish(self, has_ended: bool = False) -> None:
        """Publish result and state together, so that all topics agree."""
        self._results.publish(self._cycle.published)
        self._tf.update(self._cycle.result, self._why_not_broadcast())
        if self._mount is not None:
            self._mount.look()
        # On a slow computer messages may wait in the queues. Count them before the state is made.
        if not has_ended:
            self.take_messages()
        clock_ns = self.get_clock().now().nanoseconds
        state = replace(self._state(), has_ended=has_ended)
        headline = headline_of(state)
        self._states.publish(replace(state, headline=headline.line), clock_ns)
        if self._mount is None:
            is_warning = headline.word in (CHANGE_MOTION, CHANGE_TARGET)
            write = self._log.warning if is_warning else self._log.info
            write(headline.line, GOES_ON_S)
        self._cycle.answer_overdue()

    def _why_not_broadcast(self) -> str:
        """Return the reason why the result must not be broadcast yet; empty if it may."""
        result = self._cycle.result
        progress = self._cycle.goal.progress
        if result is None:
            return "no result yet"
        if self._cycle.published is None:
            return self._cycle.problem
        if progress.is_faulty and not progress.done:
            return "the streams are faulty"
        if not progress.done:
            return "the goal is not reached"
        base_frame = self._options.node.base_frame
        if result.base_frame != base_frame:
            return f"base_frame {base_frame} is not known"
        return ""

    def _state(self) -> NodeState:
        """Return the whole state of the node."""
        cycle = self._cycle
        name = self.get_fully_qualified_name()
        steady_s = time.monotonic()
        accepts_poses = self._inputs[0].is_enabled
        # With a result, the robot may be parked, and silent inputs are normal. An input without a
        # publisher is still reported, until the goal is reached.
        silent = [source.is_silent(steady_s) for source in self._inputs[:2]]
        is_parked = cycle.published is not None and all(silent)
        is_done = cycle.goal.progress.done
        inputs = {}
        for source in self._inputs:
            may_rest = is_parked and (is_done or source.publishers != ())
            inputs[source.name] = source.state(steady_s, may_rest)
        if self._mount is not None:
            return NodeState(
                node=name, mount=self._mount.state(), inputs=inputs
            )
        pause = pause_of(inputs, accepts_poses)
        return NodeState(
            node=name,
            extrinsic=cycle.extrinsic_state(accepts_poses, self._tf.state),
            progress=cycle.progress_state(self._robot.why_not_compared, pause),
            inputs=inputs,
            checks=cycle.checks.state(),
            journal=self._session.journal_state(self._options.node),
            saved=self._saver.state,
            can_save=bool(self._options.node.output_directory),
        )

    # --------------------------------------------------------------- session

    def _begin_session(self, because_of: PoseInput | None = None) -> None:
        """Begin a new session.

        Parameters
        ----------
        because_of : PoseInput, optional
            Input whose stamps have jumped back; None if a person requested the new session.
        """
        self._session.reset()
        if self._mount is not None and because_of is None:
            self._mount = self._watch_mount()
        self._log.restart()
        self._cycle.restart()
        if self._mount is not None:
            self._mount.restart()
        self._saver.state = None
        for source in self._inputs:
            source.restart(because_of)
        self._publish()

    # -------------------------------------------------------------- services

    async def _on_solve(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Solve. Answer the request when the solve has ended."""
        solved = Future()
        self._cycle.ask(
            lambda is_good, text: solved.set_result((is_good, text))
        )
        response.success, response.message = await solved
        return response

    def _answer(
        self, act: Callable[[Any], Outcome], request: Any, response: Any
    ) -> Any:
        """Call ``act`` with a request, and fill the response with its success and its text."""
        response.success, response.message = act(request)
        self._publish()
        return response

    def _save_digest(self) -> Outcome:
        """Write the digest of a monitored session; return the success and a line of text.

        The digest is a small file for the history of the mount.
        """
        directory = self._options.node.output_directory
        if self._mount is None or not directory:
            return False, "the digest is not saved: set output_directory"
        saved: Outcome = self._mount.save(output_path(directory))
        return saved

    def _save(self, request: Trigger.Request) -> Outcome:
        """Save the result, or the digest of a monitored session."""
        if self._mount is not None:
            return self._save_digest()
        return self._saver.save(self._options.node)

    def _reset(self, request: Trigger.Request) -> Outcome:
        """Begin a new session. The response names the priors, which are kept."""
        self._begin_session()
        text = "all poses discarded, new session"
        priors = priors_of(self._options.calibrator)
        if priors:
            settings = listing(
                [f"prior.{axis} {value}" for axis, value in priors.items()]
            )
            text = f"{text}; {settings} still set: set to '' to remove it"
        self._log.info(text)
        return True, text

    def _set_enabled(self, request: SetBool.Request) -> Outcome:
        if self._options.node.lifecycle:
            return False, "this is a managed node: activate or deactivate it"
        self.accept_poses(request.data)
        return (
            True,
            "accepting poses" if request.data else "not accepting poses",
        )

    # ------------------------------------------------------------ parameters

    def _check_options(self, options: NodeConfig) -> None:
        """Raise a ConfigError if options exclude each other, or need a package that is missing."""
        if options.publish_tf:
            message_type()
        if options.monitor and not options.installed:
            raise ConfigError(
                "monitor needs installed: set it to the transform to compare with"
            )
        if options.monitor and options.other_children:
            raise ConfigError(
                "monitor watches one child sensor: leave other_children at 0"
            )
        if self._output_base is not None and options.output_directory:
            output_path(options.output_directory, self._output_base)

    def _follow_parameters(self, before: CalibratorConfig) -> None:
        """Apply changed parameters. ``before`` has the earlier options of the engine."""
        if not self.is_configured:
            return
        options = self._options.node
        config = self._options.calibrator
        if (config, config.given) != (before, before.given):
            self._session.reconfigure(config)
            self._cycle.follow(config, before)
        for source in self._inputs:
            source.configure(config)
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
