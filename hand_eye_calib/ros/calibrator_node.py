"""The node: thin callbacks around the engine.

Messages are converted and handed to the engine, solves run in a worker thread, results are
published. All of it but the solve happens in the executor's one thread, so nothing here needs a
lock.
"""

import dataclasses
import time
import traceback
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from hand_eye_calib.calibration import SolveStatus
from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.errors import ConfigError, HandEyeCalibError, InputError, NotEnoughDataError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.journal import has_session
from hand_eye_calib.io.results import keep_earlier_results, save_result
from hand_eye_calib.ros import diagnostics
from hand_eye_calib.ros.conversions import (
    POSE_TYPES,
    to_ns,
    to_pose_with_covariance,
    to_time,
    to_transform,
)
from hand_eye_calib.ros.parameters import Parameters
from hand_eye_calib.ros.session_journal import FLUSH_PERIOD_S, DirectoryLock, SessionJournal, resume
from hand_eye_calib.ros.stamp_guard import StampGuard, Verdict
from hand_eye_calib.ros.tf import StaticBroadcaster, check_available
from hand_eye_calib.ros.worker import Checked, SolveWorker

# Best effort hears reliable publishers too; the queue holds seconds of a fast stream while a
# callback is busy.
INPUT_QOS = QoSProfile(
    depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE
)
INPUT_QOS_OVERRIDES = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY)
RESULT_QOS = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)

DISCOVERY_PERIOD_S = 0.2
DIAGNOSTICS_PERIOD_S = 1.0
LOG_PERIOD_S = 5.0

# A result is stale when it is older than this many solve periods, and than so many seconds.
STALE_PERIODS, STALE_S = 5, 10.0

# How long a disk may hold up the end of the program.
JOURNAL_GRACE_S = 0.3


@dataclass
class _Stream:
    """One of the two inputs."""

    name: str
    topic: str
    subscription: Subscription | None = None
    sensor_frame: str = ""
    guard: StampGuard = field(default_factory=StampGuard)
    monitor: diagnostics.InputMonitor = field(default_factory=diagnostics.InputMonitor)

    @property
    def relative_topic(self):
        return f"{self.name}_odom"


class CalibratorNode(Node):
    """Estimates the pose of the child sensor in the parent sensor's frame from two live streams of
    poses.

    Raises
    ------
    ConfigError
        Where a parameter given at the start is unusable.
    """

    def __init__(self):
        try:
            super().__init__("calibrator", automatically_declare_parameters_from_overrides=True)
        except ValueError as error:
            raise ConfigError(
                f"a parameter that was given has no usable value, such as []: {error}"
            ) from None
        self._last_logged = {}
        self._lock = None
        self._streams = [
            _Stream(name, self.resolve_topic_name(f"{name}_odom")) for name in ("parent", "child")
        ]
        self._options = Parameters(
            self, set(self._qos_names()), self._on_parameters, self._check_node_options
        )
        for line in self._options.unknown:
            self.get_logger().warning(line)
        self._calibrator = Calibrator(self._options.calibrator)
        self._enabled = True
        self._session = 0
        self._new_poses = False
        self._result = None
        self._earlier_results_kept = False
        self._journal = None
        self._start_journal(self._options.node.journal == "resume")

        self._solving = False
        self._solves = 0
        self._rest_until_s = 0.0
        self._outcome = None
        self._solved_at_s = None
        self._failure, self._failed_unexpectedly = "", False
        self._asked = []
        self._asked_in_flight = []
        self._checks = diagnostics.StreamChecks()
        self._solved = self.create_guard_condition(self._on_ready)
        self._worker = SolveWorker(self._solved.trigger)

        self._extrinsic = self.create_publisher(TransformStamped, "~/extrinsic", RESULT_QOS)
        self._extrinsic_with_covariance = self.create_publisher(
            PoseWithCovarianceStamped, "~/extrinsic_with_covariance", RESULT_QOS
        )
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._broadcaster = StaticBroadcaster(self) if self._options.node.publish_tf else None
        # In a group of its own: while it awaits the solve, it would hold up every other callback of
        # its group.
        self.create_service(
            Trigger, "~/solve", self._on_solve, callback_group=ReentrantCallbackGroup()
        )
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/save", self._on_save)
        self.create_service(SetBool, "~/set_enabled", self._on_set_enabled)

        # Steady time: these go on while a bag, and with it simulated time, is paused.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._solve_timer = self.create_timer(
            self._options.node.solve_period, self._on_solve_timer, clock=steady
        )
        self._discovery_timer = self.create_timer(DISCOVERY_PERIOD_S, self._discover, clock=steady)
        self.create_timer(DIAGNOSTICS_PERIOD_S, self._publish_diagnostics, clock=steady)
        self.create_timer(FLUSH_PERIOD_S, self._flush_journal, clock=steady)
        self._discover()

    def stop(self, timeout_s):
        """End the threads and save the newest result; False where a solve is still running after
        ``timeout_s`` seconds.
        """
        ended = self._worker.stop(timeout_s)
        for outcome in self._worker.ready():
            if not isinstance(outcome, Checked):
                self._conclude(outcome)
        if self._options.node.output_directory and self._result is not None:
            self._log_saved(*self._save())
        written = self._stop_journal()
        return written and ended

    # ---------------------------------------------------------------- inputs

    def _qos_names(self):
        for stream in self._streams:
            for policy in INPUT_QOS_OVERRIDES:
                yield f"qos_overrides.{stream.topic}.subscription.{policy.name.lower()}"

    def _discover(self):
        for stream in self._streams:
            if stream.subscription is None and (type_name := self._type_of(stream)) is not None:
                self._subscribe(stream, type_name)
        if all(stream.subscription is not None for stream in self._streams):
            self._discovery_timer.cancel()

    def _type_of(self, stream):
        """Message type of an input by parameter or by the first publisher seen; None while neither
        tells.
        """
        wanted = getattr(self._options.node, f"{stream.name}_type")
        if wanted != "auto":
            return wanted
        offered = sorted(
            {info.topic_type for info in self.get_publishers_info_by_topic(stream.relative_topic)}
        )
        usable = [name for name in offered if name in POSE_TYPES]
        if offered and not usable and self._is_due(("type", stream.name)):
            self.get_logger().warning(
                f"{stream.topic} has type {', '.join(offered)}; expected {', '.join(POSE_TYPES)}: "
                f"remap {stream.relative_topic} to a topic with poses"
            )
        return usable[0] if usable else None

    def _subscribe(self, stream, type_name):
        pose_type = POSE_TYPES[type_name]
        try:
            stream.subscription = self.create_subscription(
                pose_type.message,
                stream.relative_topic,
                partial(self._on_pose, stream, pose_type),
                INPUT_QOS,
                qos_overriding_options=QoSOverridingOptions(INPUT_QOS_OVERRIDES),
            )
        except (
            ParameterException,
            InvalidQosOverridesError,
            RuntimeError,
            AssertionError,
            ValueError,
        ) as error:
            raise ConfigError(
                f"cannot subscribe to {stream.topic} with the QoS overrides given: {error}"
            ) from error
        self.get_logger().info(
            f"subscribed to {stream.topic} ({type_name}) for the {stream.name} sensor"
        )

    def _on_pose(self, stream, pose_type, message):
        if not self._enabled:
            stream.monitor.ignored += 1
            return
        stamp_ns, steady_s = to_ns(message.header.stamp), time.monotonic()
        max_gap_ns = self._options.calibrator.max_gap * 1e9
        stream.monitor.note(stamp_ns, self.get_clock().now().nanoseconds, steady_s, max_gap_ns)
        last_ns = stream.guard.last_ns
        verdict, messages = stream.guard.check(stamp_ns, message, steady_s)
        if verdict is Verdict.JUMPED_BACK:
            self.get_logger().warning(
                f"{stream.topic} jumped back by {(last_ns - stamp_ns) * 1e-9:.3f} s (a bag that loops? a clock that was reset?): "
                "new session, earlier poses forgotten"
            )
            self._reset(because_of=stream)
        elif verdict is Verdict.HOLD:
            self._refuse(
                stream,
                stamp_ns,
                "jump in time",
                f"its stamp is {(stamp_ns - last_ns) * 1e-9:+.3f} s from the one before; held back until others agree",
            )
        elif verdict is Verdict.OUTDATED:
            stream.monitor.refused["of the session before"] += 1
        for held_ns, held in messages:
            self._take(stream, pose_type, held_ns, held, first=last_ns is None)

    def _take(self, stream, pose_type, stamp_ns, message, first):
        position, quat_xyzw = pose_type.position(message), pose_type.quat_xyzw(message)
        try:
            if pose_type.sensor_frame is not None:
                self._set_frame(stream, pose_type.sensor_frame(message))
            added = self._calibrator.add_pose(stream.name, stamp_ns, position, quat_xyzw)
        except InputError as error:
            self._refuse(stream, stamp_ns, "unusable", str(error))
            return
        if first:
            self.get_logger().info(f"first pose on {stream.topic}, stamp {stamp_ns * 1e-9:.3f} s")
        if added and self._journal is not None:
            self._journal.add_pose(stream.name, stamp_ns, position, quat_xyzw)
        self._new_poses |= added
        self._checks.has_new_poses |= added

    def _set_frame(self, stream, sensor_frame):
        if sensor_frame == stream.sensor_frame and sensor_frame:
            return
        self._calibrator.set_frame(stream.name, sensor_frame)
        stream.sensor_frame = sensor_frame
        if self._journal is not None:
            self._journal.set_frame(stream.name, sensor_frame)

    def _refuse(self, stream, stamp_ns, reason, text):
        stream.monitor.note_bad(reason, text, time.monotonic())
        if self._is_due(("refused", stream.name)):
            self.get_logger().warning(
                f"{stream.topic}: message with stamp {stamp_ns * 1e-9:.9f} s refused: {text} "
                f"({stream.monitor.refused.total()} refused so far)"
            )

    # --------------------------------------------------------------- solving

    def _on_solve_timer(self):
        silent = [stream for stream in self._streams if stream.guard.last_ns is None]
        if silent and self._enabled and self._is_due("silent", 2 * LOG_PERIOD_S):
            self.get_logger().info("; ".join(self._say_silent(stream) for stream in silent))
        now_s = time.monotonic()
        if (
            (self._new_poses or self._checks.is_due(now_s))
            and not self._solving
            and now_s >= self._rest_until_s
        ):
            self._start_solve()

    def _say_silent(self, stream):
        publishers = self.count_publishers(stream.relative_topic)
        return f"no pose yet on {stream.topic} ({publishers or 'no'} publisher{'s' * (publishers != 1)})"

    def _start_solve(self):
        self._solving = True
        self._new_poses = False
        self._asked_in_flight, self._asked = self._asked, []
        now_s = time.monotonic()
        check = self._checks.is_due(now_s)
        if check:
            self._checks.begin(now_s)
        self._worker.submit(self._session, self._calibrator.snapshot(), check)

    def _on_ready(self):
        for outcome in self._worker.ready():
            if isinstance(outcome, Checked):
                self._on_checked(outcome)
            else:
                self._on_solved(outcome)

    def _on_checked(self, checked):
        if checked.session != self._session:
            return
        now_s = time.monotonic()
        self._rest_until_s = max(self._rest_until_s, now_s + checked.seconds)
        if checked.error is not None:
            if self._is_due("unchecked"):
                self.get_logger().warning(
                    f"the streams cannot be checked: {type(checked.error).__name__}: {checked.error}"
                )
            return
        new, gone = self._checks.take(checked.agreement, now_s)
        for line in new:
            self.get_logger().warning(line)
        for line in gone:
            self.get_logger().info(line)

    def _on_solved(self, outcome):
        good, text = self._conclude(outcome)
        self._solving = False
        for answer in self._asked_in_flight:
            answer.set_result((good, text))
        if self._asked:
            self._start_solve()

    def _conclude(self, outcome):
        """Publish and log an outcome; whether it is good, and one line about it."""
        if outcome.session != self._session:
            return False, "the session was reset during the solve: its result is dropped"
        self._solves += 1
        # Solves that take longer than their period leave the processor free for half the time.
        self._rest_until_s = time.monotonic() + outcome.seconds
        self._outcome = outcome
        self._calibrator.adopt(outcome.snapshot)
        self._failure, self._failed_unexpectedly = "", False
        if outcome.error is not None:
            self._failure = self._report_failure(outcome.error)
            self._failed_unexpectedly = not isinstance(outcome.error, HandEyeCalibError)
            return False, self._failure
        calibration = outcome.calibration
        if calibration.status is not SolveStatus.NOT_CONVERGED:
            self._publish_result(calibration)
        text = describe(calibration)
        if self._is_due("result", 1.0):
            self.get_logger().info(text)
        for warning in calibration.warnings:
            if self._is_due(warning):
                self.get_logger().warning(warning)
        return calibration.status is SolveStatus.OK, "; ".join((text, *calibration.warnings))

    def _publish_result(self, calibration):
        self._result, self._solved_at_s = calibration, time.monotonic()
        transform = to_transform(calibration)
        self._extrinsic.publish(transform)
        self._extrinsic_with_covariance.publish(to_pose_with_covariance(calibration))
        if self._broadcaster is not None and calibration.status is SolveStatus.OK:
            self._broadcaster.send(transform)

    def _report_failure(self, error):
        if isinstance(error, NotEnoughDataError):
            if self._is_due("not enough data"):
                self.get_logger().info(f"cannot solve yet: {error}")
            return str(error)
        if isinstance(error, HandEyeCalibError):
            if self._is_due("failed"):
                self.get_logger().warning(f"cannot solve: {error}")
            return str(error)
        if self._is_due("unexpected"):
            self.get_logger().error(
                "the solver failed unexpectedly:\n" + "".join(traceback.format_exception(error))
            )
        return f"the solver failed unexpectedly, see the log: {type(error).__name__}: {error}"

    def _reset(self, because_of=None):
        """Begin a new session; ``because_of`` a stream whose stamps jumped back, which has begun
        its own already.
        """
        self._calibrator.reset()
        self._session += 1
        self._new_poses = False
        self._result = self._outcome = self._solved_at_s = None
        self._failure, self._failed_unexpectedly = "", False
        self._checks.restart()
        for stream in self._streams:
            stream.sensor_frame = ""
            stream.monitor.restart()
            if stream is not because_of:
                stream.guard.restart(time.monotonic() if because_of else None)
        if self._journal is not None:
            self._journal.begin(self._calibrator.state())

    # --------------------------------------------------------------- journal

    def _start_journal(self, resuming=False):
        directory = _journal_directory(self._options.node)
        self._lock = DirectoryLock(directory.parent) if directory else None
        resumed = resuming and self._resume(directory)
        self._journal = (
            SessionJournal(directory, self._calibrator.state(), resumed) if directory else None
        )

    def _resume(self, directory):
        """Whether the session in a directory goes on."""
        if not has_session(directory):
            self.get_logger().info(f"no session to resume in {directory}: a new one begins")
            return False
        try:
            poses = resume(directory, self._calibrator)
        except HandEyeCalibError as error:
            self.get_logger().error(f"cannot resume: {error}; a new session begins")
            self._calibrator.reset()
            return False
        for stream in self._streams:
            stream.guard.last_ns = self._calibrator.statistics(stream.name).last_stamp_ns
        self._new_poses = poses > 0
        self.get_logger().info(f"session resumed from {directory}: {poses} poses")
        return True

    def _flush_journal(self):
        if self._journal is not None:
            self._journal.flush(self._calibrator.state)
            self._log_journal()

    def _log_journal(self):
        for is_warning, text in self._journal.notes():
            if not is_warning:
                self.get_logger().info(text)
            elif self._is_due("journal"):
                self.get_logger().warning(text)

    def _stop_journal(self):
        if self._journal is None:
            return True
        ended = self._journal.stop(self._calibrator.state, JOURNAL_GRACE_S)
        self._log_journal()
        self._journal = None
        self._lock.release()
        return ended

    # ----------------------------------------------------------- diagnostics

    def _publish_diagnostics(self):
        steady_s, clock_ns = time.monotonic(), self.get_clock().now().nanoseconds
        statuses = [
            self._calibration_status(steady_s, clock_ns),
            *self._input_statuses(steady_s),
            diagnostics.status("stream checks", *self._checks.report(steady_s)),
            self._journal_status(),
        ]
        message = DiagnosticArray(status=statuses)
        message.header.stamp = to_time(clock_ns)
        self._diagnostics.publish(message)

    def _calibration_status(self, steady_s, clock_ns):
        outcome = self._outcome
        state = diagnostics.SolverState(
            enabled=self._enabled,
            solving=self._solving,
            solves=self._solves,
            seconds=outcome.seconds if outcome else 0.0,
            failure=self._failure,
            failed_unexpectedly=self._failed_unexpectedly,
            seen=outcome.seen if outcome else None,
            calibration=self._result,
            solved_at_s=self._solved_at_s,
            stale_after_s=max(STALE_S, STALE_PERIODS * self._options.node.solve_period),
            faults=self._checks.grave(),
        )
        return diagnostics.status(
            "extrinsic", *diagnostics.calibration_report(state, steady_s, clock_ns)
        )

    def _input_statuses(self, steady_s):
        reports = {
            stream.name: stream.monitor.report(
                stream.topic, steady_s, self._calibrator.statistics(stream.name)
            )
            for stream in self._streams
        }
        seen_s = diagnostics.offset_between(*(stream.monitor for stream in self._streams))
        has_result = self._result is not None and self._result.status is SolveStatus.OK
        used_s = (
            self._result.time_offset_s if self._result else self._options.calibrator.time_offset
        )
        for name, report in reports.items():
            level, text, values = diagnostics.with_clock_offset(*report, seen_s, used_s)
            if level == diagnostics.OK and not has_result:
                level, text = diagnostics.WARN, f"{text}; no valid result yet"
            yield diagnostics.status(f"{name} input", level, text, values)

    def _journal_status(self):
        journal = self._journal
        values = {"directory": journal.directory if journal else "none"}
        has_result = self._result is not None and self._result.status is SolveStatus.OK
        if journal is None:
            node = self._options.node
            text = (
                "off"
                if node.journal == "off"
                else "off: output_directory is not set, a crash would lose the session"
            )
            level = diagnostics.WARN if node.journal != "off" or not has_result else diagnostics.OK
        elif journal.error:
            level, text = (
                diagnostics.ERROR,
                f"cannot write: {journal.error}; a crash would lose the session",
            )
        else:
            level, text = (
                diagnostics.OK if has_result else diagnostics.WARN,
                "the session is being written",
            )
        return diagnostics.status("journal", level, text, values)

    # -------------------------------------------------- services, parameters

    async def _on_solve(self, request, response):
        answer = Future()
        self._asked.append(answer)
        if not self._solving:
            self._start_solve()
        response.success, response.message = await answer
        return response

    def _on_reset(self, request, response):
        self._reset()
        response.success, response.message = True, "all poses forgotten, new session"
        self.get_logger().info(response.message)
        return response

    def _on_save(self, request, response):
        response.success, response.message = self._save()
        self._log_saved(response.success, response.message)
        return response

    def _log_saved(self, success, text):
        if success:
            self.get_logger().info(text)
        else:
            self.get_logger().warning(text)

    def _save(self):
        directory = self._options.node.output_directory
        if not directory:
            return False, "nowhere to save to: set the parameter output_directory to a directory"
        if self._result is None:
            return False, "nothing to save: there is no result yet"
        try:
            if not self._earlier_results_kept:
                keep_earlier_results(Path(directory).expanduser())
            self._earlier_results_kept = True
            warnings = (*self._result.warnings, *self._checks.grave())
            save_result(
                dataclasses.replace(self._result, warnings=warnings), Path(directory).expanduser()
            )
        except (OSError, HandEyeCalibError) as error:
            return False, f"cannot save to {directory}: {error}"
        return True, f"result saved to {directory}"

    def _on_set_enabled(self, request, response):
        self._enabled = request.data
        ignored = sum(stream.monitor.ignored for stream in self._streams)
        verb = "accepting" if request.data else "not accepting"
        response.success, response.message = True, f"{verb} poses; {ignored} ignored so far"
        self.get_logger().info(response.message)
        return response

    def _on_parameters(self):
        if self._options.calibrator != self._calibrator.config:
            self._calibrator.reconfigure(self._options.calibrator)
            self._new_poses = True  # the same poses may now give another result
            self._checks.hasten()
        self._follow_output_directory()
        if self._options.node.publish_tf != (self._broadcaster is not None):
            self._switch_broadcaster()
        period_ns = round(self._options.node.solve_period * 1e9)
        if period_ns != self._solve_timer.timer_period_ns:
            self._solve_timer.timer_period_ns = period_ns
            self._solve_timer.reset()

    def _check_node_options(self, options):
        """Raise ConfigError where options cannot be had together, or not on this machine."""
        if options.publish_tf:
            check_available()
        if options.journal == "resume" and not options.output_directory:
            raise ConfigError(
                "journal resume needs output_directory: that is where the session to resume is"
            )
        directory = _journal_directory(options)
        if directory and (self._lock is None or directory.parent != self._lock.directory):
            DirectoryLock(directory.parent).release()

    def _follow_output_directory(self):
        directory = _journal_directory(self._options.node)
        if directory == (self._journal.directory if self._journal else None):
            return
        self._stop_journal()
        self._start_journal()
        self._earlier_results_kept = False

    def _switch_broadcaster(self):
        if self._broadcaster is not None:
            self._broadcaster.close()
            self._broadcaster = None
            return
        self._broadcaster = StaticBroadcaster(self)
        if self._result is not None and self._result.status is SolveStatus.OK:
            self._broadcaster.send(to_transform(self._result))

    def _is_due(self, key, period_s=LOG_PERIOD_S):
        """Whether a message of this kind may be logged again: rclpy's own throttle cannot tell two
        topics apart.
        """
        now = time.monotonic()
        if now - self._last_logged.get(key, -float("inf")) < period_s:
            return False
        self._last_logged[key] = now
        return True


def _journal_directory(options):
    """Where the journal is to be; None for nowhere."""
    wanted = options.output_directory and options.journal != "off"
    return Path(options.output_directory).expanduser() / "journal" if wanted else None


def describe(calibration):
    """One line for a log: whose pose in whose frame, how good, from how much."""
    x, y, z = calibration.T_parent_child[:3, 3]
    roll, pitch, yaw = np.degrees(se3.rotation_to_rpy(calibration.T_parent_child[:3, :3]))
    return (
        f"{calibration.child_frame} in {calibration.parent_frame}: xyz = ({x:.4f}, {y:.4f}, {z:.4f}) m, "
        f"rpy = ({roll:.3f}, {pitch:.3f}, {yaw:.3f}) deg; status {calibration.status.value}; "
        f"{calibration.method} {calibration.reference}{' ipopt' * (calibration.backend == 'ipopt')}: "
        f"{calibration.n_poses} poses, {calibration.n_pairs} pairs, "
        f"{calibration.n_inliers} inliers"
    )
