"""The node: topics, services, parameters and timers around the session.

Solves run in a process of their own; everything else happens in the executor's one thread, so
nothing here needs a lock.
"""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_srvs.srv import SetBool, Trigger

from hand_eye_calib.config import NodeConfig, other_names
from hand_eye_calib.errors import ConfigError
from hand_eye_calib.plain import from_plain
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.results.records import Progress
from hand_eye_calib.ros.check_monitor import CheckMonitor
from hand_eye_calib.ros.diagnostics import NodeParts, diagnostics
from hand_eye_calib.ros.inputs import PoseInput, TopicInput, qos_parameter_names
from hand_eye_calib.ros.live_session import LiveSession, check_below, output_path
from hand_eye_calib.ros.log import LOG_PERIOD_S, NodeLog
from hand_eye_calib.ros.mount import LIMITS, MountWatch
from hand_eye_calib.ros.parameters import Parameters
from hand_eye_calib.ros.report_process import ReportProcess, SessionResult
from hand_eye_calib.ros.results import ResultFiles, ResultTopics
from hand_eye_calib.ros.robot import Robot, needs_tf
from hand_eye_calib.ros.session_journal import FLUSH_PERIOD_S
from hand_eye_calib.ros.solve_cycle import ANSWER_PERIOD_S, SolveCycle
from hand_eye_calib.ros.tf import TfBroadcaster, message_type
from hand_eye_calib.ros.tf_input import TfInput, tf_source
from hand_eye_calib.session.goal import Goal

_DISCOVERY_PERIOD_S = 0.2
_DIAGNOSTICS_PERIOD_S = 1.0

# Requests that come while the node is busy wait here.
_SERVICE_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)


class CalibratorNode(Node):
    """Estimates the pose of the child sensor in the parent sensor's frame from two live streams of
    poses.

    Raises
    ------
    ConfigError
        If a parameter given at the start is unusable.
    """

    def __init__(self) -> None:
        try:
            super().__init__("calibrator", automatically_declare_parameters_from_overrides=True)
        except ValueError as error:
            raise ConfigError(
                f"a parameter that was given has no usable value, such as []: {error}"
            ) from None
        self._log = NodeLog(self.get_logger())
        self._session = LiveSession(self._log)
        self._output_base: Path | None = None
        self._options = Parameters(
            self, set(qos_parameter_names(self)), self._follow_parameters, self._check_options
        )
        for line in self._options.unknown:
            self._log.warning(line)
        # From now on, participants may choose a directory below this one.
        self._output_base = output_path(self._options.node.output_directory or ".").resolve()
        if self._options.node.monitor:
            self._options.calibrator.require_poses("monitor")
        _ = self._options.calibrator.measured  # or it raises
        self._session.reconfigure(self._options.calibrator)
        self._checks = CheckMonitor()
        self._files = ResultFiles()
        self._report = ReportProcess()
        self._tf = TfBroadcaster(self, self._log)
        self._robot = Robot(self, self._log, self._options.node, self._tf)
        self._inputs = self._make_input("parent"), self._make_input("child")
        self._others = self._make_others()
        self._session.topics = {each.name: each.topic for each in self._inputs}
        self._open_journal()
        self._topics = ResultTopics(self)
        self._tf.switch(self._options.node.publish_tf)
        self._mount = None
        if self._options.node.monitor:
            self._session.watch_only(LIMITS)
            self._mount = MountWatch(self._session, self._robot, self._log)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._answered = self.create_guard_condition(self._take_answers)
        self._cycle = SolveCycle(
            self._session,
            self._checks,
            self._log,
            self._answered.trigger,
            self._robot.complete,
            self._publish_result,
            Goal(self._options.calibrator.targets),
        )
        self._parts = NodeParts(
            self.get_fully_qualified_name(), self._options, self._session, self._inputs,
            self._cycle, self._checks, self._tf, self._robot, self._mount, self._others,
        )  # fmt: skip
        self._serve()
        self._start_timers()
        self._discover()

    def stop(self, timeout_s: float) -> bool:
        """End the solving process and save the newest result.

        Returns
        -------
        bool
            False if a result that was to be saved could not be.
        """
        self._cycle.stop(timeout_s)
        saved = True
        if self._options.node.output_directory and self._cycle.result is not None:
            saved, text = self._save()
            self._log_outcome(saved, text)
        elif self._cycle.result is not None:
            self._log.warning("the result is not saved: output_directory is not set")
        self._session.stop_journal()
        return saved

    # ---------------------------------------------------------------- set-up

    def _make_input(self, name: str) -> PoseInput:
        frames = tf_source(self._options.node, name)
        parts = self._session, self._log, self._begin_session
        made = TfInput(self, name, frames, *parts) if frames else TopicInput(self, name, *parts)
        made.configure(self._options)
        return made

    def _make_others(self) -> tuple[PoseInput, ...]:
        """Inputs of further child sensors."""
        names = other_names(self._options.node.other_children)
        self._session.take_others(names)
        parts = self._session, self._log, self._begin_session
        made = [TopicInput(self, name, *parts) for name in names]
        for each in made:
            each.configure(self._options)
        return tuple(made)

    def _open_journal(self) -> None:
        resuming = self._options.node.journal == "resume"
        self._session.follow_journal(self._options.node, resuming)
        for each in (*self._inputs, *self._others):
            each.resume()

    def _serve(self) -> None:
        # A group of its own: while it awaits a solve, it would hold up every other callback of its
        # group.
        apart = ReentrantCallbackGroup()
        self.create_service(
            Trigger, "~/solve", self._on_solve, qos_profile=_SERVICE_QOS, callback_group=apart
        )
        self.create_service(Trigger, "~/reset", self._on_reset, qos_profile=_SERVICE_QOS)
        self.create_service(Trigger, "~/save", self._on_save, qos_profile=_SERVICE_QOS)
        self.create_service(
            SetBool, "~/set_enabled", self._on_set_enabled, qos_profile=_SERVICE_QOS
        )

    def _start_timers(self) -> None:
        # Steady time: these go on while a bag, and with it simulated time, is paused.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        period_s = self._options.node.solve_period
        self._solve_timer = self.create_timer(period_s, self._on_solve_timer, clock=steady)
        self.create_timer(_DISCOVERY_PERIOD_S, self._discover, clock=steady)
        self.create_timer(_DIAGNOSTICS_PERIOD_S, self._publish_diagnostics, clock=steady)
        self._answer_timer = self.create_timer(ANSWER_PERIOD_S, self._answer_some, clock=steady)
        self.create_timer(FLUSH_PERIOD_S, self._session.flush_journal, clock=steady)

    # ---------------------------------------------------------------- timers

    def _discover(self) -> None:
        self._inputs[0].discover(self._options.node.parent_type)
        self._inputs[1].discover(self._options.node.child_type)
        for each in self._others:
            each.discover("auto")
        for each in (*self._inputs, *self._others):
            each.flush()

    def _on_solve_timer(self) -> None:
        inputs = (*self._inputs, *self._others)
        silent = [each for each in inputs if each.guard.last_ns is None]
        if silent and silent[0].is_enabled:
            text = "; ".join(each.describe_silence() for each in silent)
            self._log.info(text, "silent", 2 * LOG_PERIOD_S)
        self._cycle.start_if_due()

    def _take_answers(self) -> None:
        self._cycle.take_answers()
        self._answer_some()

    def _answer_some(self) -> None:
        if self._cycle.answer_some():
            self._answer_timer.reset()
        else:
            self._answer_timer.cancel()

    def _publish_result(self, calibration: Calibration) -> None:
        self._topics.publish(calibration)
        if not self._robot.lacks_base(calibration):
            self._tf.add(calibration, self._cycle.goal.progress.is_done)

    def _publish_others(self, calibrations: Sequence[Calibration]) -> None:
        """Publish new results of the further child sensors, in their order."""
        for each, calibration in zip(self._others, calibrations, strict=False):
            self._topics.publish_other(each.name, calibration)
        mounted = [self._robot.in_base(each) for each in calibrations]
        if mounted:
            self._tf.add_others([each for each in mounted if not self._robot.lacks_base(each)])

    def _publish_diagnostics(self) -> None:
        self._tf.look()
        self._publish_others(self._report.take_others())
        if self._mount is not None:
            self._mount.look()
        clock_ns = self.get_clock().now().nanoseconds
        self._diagnostics.publish(diagnostics(self._parts, time.monotonic(), clock_ns))

    # --------------------------------------------------------------- session

    def _begin_session(self, because_of: PoseInput | None = None) -> None:
        """Begin a new session: asked for, or because the stamps of an input have jumped back."""
        self._session.reset()
        self._cycle.restart()
        self._checks.restart()
        self._topics.clear()
        self._report.forget()
        self._tf.restart()
        if self._mount is not None:
            self._mount.restart()
        for each in (*self._inputs, *self._others):
            each.restart(because_of)

    def _save(self) -> tuple[bool, str]:
        options, cycle = self._options.node, self._cycle
        inputs = self._session.inputs()
        if cycle.snapshot is not None:  # a check may have been certain of other options
            inputs["options"] = cycle.snapshot.config.to_options()
        result = cycle.result
        if result is not None:
            result = dataclasses.replace(
                result, goal=from_plain(Progress, cycle.goal.progress.to_dict())
            )
        saved, text = self._files.save(result, options.output_directory, inputs)
        others = {name: each.snapshot() for name, each in self._session.others.items()}
        is_wanted = options.report or others
        if saved and is_wanted and result is not None and cycle.snapshot is not None:
            path = output_path(options.output_directory)
            told = SessionResult(result, cycle.snapshot, inputs, options.report, others)
            try:
                self._report.write(path, told)
                text += f", {told.what_follows}"
            except OSError as error:
                missing = f"{told.files} cannot be written: {error.strerror}"
                self._log.warning(missing)
                text += f"; {missing}"
        return saved, text

    def _log_outcome(self, success: bool, text: str) -> None:
        if success:
            self._log.info(text)
        else:
            self._log.warning(text)

    # -------------------------------------------------------------- services

    async def _on_solve(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        response.success, response.message = await self._cycle.ask()
        return response

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._begin_session()
        response.success, response.message = True, "all poses forgotten, new session"
        self._log.info(response.message)
        return response

    def _on_save(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = self._save()
        self._log_outcome(response.success, response.message)
        return response

    def _on_set_enabled(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        for each in (*self._inputs, *self._others):
            each.is_enabled = request.data
        ignored = sum(each.monitor.ignored for each in self._inputs)
        verb = "accepting" if request.data else "not accepting"
        response.success, response.message = True, f"{verb} poses; {ignored} ignored so far"
        self._log.info(response.message)
        return response

    # ------------------------------------------------------------ parameters

    def _check_options(self, options: NodeConfig) -> None:
        """Raise ConfigError if options cannot be had together, or not on this machine."""
        if options.publish_tf:
            message_type()
        if needs_tf(options):
            message_type("base_frame" if options.base_frame else "installed")
        if options.monitor and not options.installed:
            raise ConfigError("monitor needs installed: what the mount is watched against")
        if options.monitor and options.other_children:
            raise ConfigError("monitor watches one child sensor: leave other_children at 0")
        for name in ("parent", "child"):
            if tf_source(options, name):
                message_type(f"{name}_tf")
        if self._output_base is not None and options.output_directory:
            check_below(self._output_base, options.output_directory)
        self._session.check_journal(options)

    def _follow_parameters(self) -> None:
        options = self._options
        if options.calibrator != self._session.calibrator.config:
            self._session.reconfigure(options.calibrator)
            self._checks.hasten()
            self._cycle.aim(options.calibrator.targets)
        for each in (*self._inputs, *self._others):
            each.configure(options)
        self._session.follow_journal(options.node)
        self._tf.switch(options.node.publish_tf)
        period_ns = round(options.node.solve_period * 1e9)
        if period_ns != self._solve_timer.timer_period_ns:
            self._solve_timer.timer_period_ns = period_ns
            self._solve_timer.reset()
