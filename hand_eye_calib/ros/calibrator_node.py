"""The node: thin callbacks around the engine.

Messages are converted and handed to the engine, solves run in a worker thread, results are published. All of it but the
solve happens in the executor's one thread, so nothing here needs a lock.
"""

import time
import traceback
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.task import Future
from scipy.spatial.transform import Rotation
from std_srvs.srv import SetBool, Trigger

from hand_eye_calib.calibration import SolveStatus
from hand_eye_calib.calibrator import Calibrator
from hand_eye_calib.errors import ConfigError, HandEyeCalibError, InputError, NotEnoughDataError
from hand_eye_calib.ros.conversions import POSE_TYPES, to_ns, to_pose_with_covariance, to_transform
from hand_eye_calib.ros.parameters import Parameters
from hand_eye_calib.ros.worker import SolveWorker

# Best effort hears reliable publishers too; the queue holds seconds of a fast stream while a callback is busy.
INPUT_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)
INPUT_QOS_OVERRIDES = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY)
RESULT_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)

# A header stamp this much earlier than the one before is a bag that loops, not a late message.
BACKWARD_JUMP_NS = 1_000_000_000

DISCOVERY_PERIOD_S = 0.2
LOG_PERIOD_S = 5.0


@dataclass
class _Stream:
    """One of the two inputs."""

    name: str
    topic: str
    subscription: Subscription | None = None
    last_stamp_ns: int | None = None
    refused: int = 0

    @property
    def relative_topic(self):
        return f"{self.name}_odom"


class CalibratorNode(Node):
    """Estimates the pose of the child sensor in the parent sensor's frame from two live streams of poses.

    Raises
    ------
    ConfigError
        Where a parameter given at the start is unusable.
    """

    def __init__(self):
        try:
            super().__init__("calibrator", automatically_declare_parameters_from_overrides=True)
        except ValueError as error:
            raise ConfigError(f"a parameter that was given has no usable value, such as []: {error}") from None
        self._last_logged = {}
        self._streams = [_Stream(name, self.resolve_topic_name(f"{name}_odom")) for name in ("parent", "child")]
        self._options = Parameters(self, set(self._qos_names()), self._on_parameters)
        for line in self._options.unknown:
            self.get_logger().warning(line)
        self._calibrator = Calibrator(self._options.calibrator)
        self._enabled = True
        self._ignored = 0
        self._session = 0
        self._new_poses = False
        self._result = None

        self._solving = False
        self._asked = []
        self._asked_in_flight = []
        self._solved = self.create_guard_condition(self._on_solved)
        self._worker = SolveWorker(self._solved.trigger)

        self._extrinsic = self.create_publisher(TransformStamped, "~/extrinsic", RESULT_QOS)
        self._extrinsic_with_covariance = self.create_publisher(
            PoseWithCovarianceStamped, "~/extrinsic_with_covariance", RESULT_QOS
        )
        # In a group of its own: while it awaits the solve, it would hold up every other callback of its group.
        self.create_service(Trigger, "~/solve", self._on_solve, callback_group=ReentrantCallbackGroup())
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/save", self._on_save)
        self.create_service(SetBool, "~/set_enabled", self._on_set_enabled)

        # Steady time: these go on while a bag, and with it simulated time, is paused.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._solve_timer = self.create_timer(self._options.node.solve_period, self._on_solve_timer, clock=steady)
        self._discovery_timer = self.create_timer(DISCOVERY_PERIOD_S, self._discover, clock=steady)
        self._discover()

    def stop(self, timeout_s):
        """End the worker thread; False where a solve is still running after ``timeout_s`` seconds."""
        return self._worker.stop(timeout_s)

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
        """Message type of an input by parameter or by the first publisher seen; None while neither tells."""
        wanted = getattr(self._options.node, f"{stream.name}_type")
        if wanted != "auto":
            return wanted
        offered = sorted({info.topic_type for info in self.get_publishers_info_by_topic(stream.relative_topic)})
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
        except (ParameterException, InvalidQosOverridesError, RuntimeError, AssertionError, ValueError) as error:
            raise ConfigError(f"cannot subscribe to {stream.topic} with the QoS overrides given: {error}") from error
        self.get_logger().info(f"subscribed to {stream.topic} ({type_name}) for the {stream.name} sensor")

    def _on_pose(self, stream, pose_type, message):
        if not self._enabled:
            self._ignored += 1
            return
        stamp_ns = to_ns(message.header.stamp)
        if stream.last_stamp_ns is not None and stamp_ns < stream.last_stamp_ns - BACKWARD_JUMP_NS:
            back_s = (stream.last_stamp_ns - stamp_ns) * 1e-9
            self.get_logger().warning(
                f"{stream.topic} jumped back by {back_s:.3f} s (a bag that loops?): new session, earlier poses forgotten"
            )
            self._reset()
        try:
            if pose_type.sensor_frame is not None:
                self._calibrator.set_frame(stream.name, pose_type.sensor_frame(message))
            added = self._calibrator.add_pose(stream.name, stamp_ns, pose_type.position(message), pose_type.quat_xyzw(message))
        except InputError as error:
            self._refuse(stream, stamp_ns, error)
            return
        if stream.last_stamp_ns is None:
            self.get_logger().info(f"first pose on {stream.topic}, stamp {stamp_ns * 1e-9:.3f} s")
        stream.last_stamp_ns = stamp_ns
        self._new_poses |= added

    def _refuse(self, stream, stamp_ns, error):
        stream.refused += 1
        if self._is_due(("refused", stream.name)):
            self.get_logger().warning(
                f"{stream.topic}: message with stamp {stamp_ns * 1e-9:.9f} s refused: {error} ({stream.refused} refused so far)"
            )

    # --------------------------------------------------------------- solving

    def _on_solve_timer(self):
        silent = [stream for stream in self._streams if stream.last_stamp_ns is None]
        if silent and self._enabled and self._is_due("silent", 2 * LOG_PERIOD_S):
            self.get_logger().info("; ".join(self._say_silent(stream) for stream in silent))
        if self._new_poses and not self._solving:
            self._start_solve()

    def _say_silent(self, stream):
        publishers = self.count_publishers(stream.relative_topic)
        return f"no pose yet on {stream.topic} ({publishers or 'no'} publisher{'s' * (publishers != 1)})"

    def _start_solve(self):
        self._solving = True
        self._new_poses = False
        self._asked_in_flight, self._asked = self._asked, []
        self._worker.submit(self._session, self._calibrator.snapshot())

    def _on_solved(self):
        good, text = self._conclude(self._worker.take())
        self._solving = False
        for answer in self._asked_in_flight:
            answer.set_result((good, text))
        if self._asked:
            self._start_solve()

    def _conclude(self, outcome):
        """Publish and log an outcome; whether it is good, and one line about it."""
        if outcome.session != self._session:
            return False, "the session was reset during the solve: its result is dropped"
        if outcome.error is not None:
            return False, self._report_failure(outcome.error)
        calibration = outcome.calibration
        if calibration.status is not SolveStatus.NOT_CONVERGED:
            self._result = calibration
            self._extrinsic.publish(to_transform(calibration))
            self._extrinsic_with_covariance.publish(to_pose_with_covariance(calibration))
        text = describe(calibration)
        if self._is_due("result", 1.0):
            self.get_logger().info(text)
        for warning in calibration.warnings:
            if self._is_due(warning):
                self.get_logger().warning(warning)
        return calibration.status is SolveStatus.OK, "; ".join((text, *calibration.warnings))

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
            self.get_logger().error("the solver failed unexpectedly:\n" + "".join(traceback.format_exception(error)))
        return f"the solver failed unexpectedly, see the log: {type(error).__name__}: {error}"

    def _reset(self):
        self._calibrator.reset()
        self._session += 1
        self._new_poses = False
        self._result = None
        for stream in self._streams:
            stream.last_stamp_ns = None

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
        if response.success:
            self.get_logger().info(response.message)
        else:
            self.get_logger().warning(response.message)
        return response

    def _save(self):
        directory = self._options.node.output_directory
        if not directory:
            return False, "nowhere to save to: set the parameter output_directory to a directory"
        if self._result is None:
            return False, "nothing to save: there is no result yet"
        try:
            self._result.save(Path(directory).expanduser())
        except (OSError, HandEyeCalibError) as error:
            return False, f"cannot save to {directory}: {error}"
        return True, f"result saved to {directory}"

    def _on_set_enabled(self, request, response):
        self._enabled = request.data
        verb = "accepting" if request.data else "not accepting"
        response.success, response.message = True, f"{verb} poses; {self._ignored} ignored so far"
        self.get_logger().info(response.message)
        return response

    def _on_parameters(self):
        if self._options.calibrator != self._calibrator.config:
            self._calibrator.reconfigure(self._options.calibrator)
            self._new_poses = True  # the same poses may now give another result
        period_ns = round(self._options.node.solve_period * 1e9)
        if period_ns != self._solve_timer.timer_period_ns:
            self._solve_timer.timer_period_ns = period_ns
            self._solve_timer.reset()

    def _is_due(self, key, period_s=LOG_PERIOD_S):
        """Whether a message of this kind may be logged again: rclpy's own throttle cannot tell two topics apart."""
        now = time.monotonic()
        if now - self._last_logged.get(key, -float("inf")) < period_s:
            return False
        self._last_logged[key] = now
        return True


def describe(calibration):
    """One line for a log: whose pose in whose frame, how good, from how much."""
    x, y, z = calibration.T_parent_child[:3, 3]
    roll, pitch, yaw = Rotation.from_matrix(calibration.T_parent_child[:3, :3]).as_euler("xyz", degrees=True)
    return (
        f"{calibration.child_frame} in {calibration.parent_frame}: xyz = ({x:.4f}, {y:.4f}, {z:.4f}) m, "
        f"rpy = ({roll:.3f}, {pitch:.3f}, {yaw:.3f}) deg; status {calibration.status.value}; "
        f"{calibration.method} {calibration.reference}: {calibration.n_poses} poses, {calibration.n_pairs} pairs, "
        f"{calibration.n_inliers} inliers"
    )
