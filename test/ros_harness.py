"""The node in a process of its own; the test's process is the other end of the middleware."""

import gc
import inspect
import itertools
import math
import multiprocessing
import multiprocessing.forkserver
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import (
    PoseStamped,
    PoseWithCovarianceStamped,
    TransformStamped,
)
from motions import disturbed
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import SetBool, Trigger

import hand_eye_calib
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.bags.messages import ns_of
from hand_eye_calib.offline.cli.main import main
from hand_eye_calib.online.ros import conversions

# Nothing is measured with this: it is how long a hang takes to fail a test, on a machine that is
# busy with other things.
PATIENCE_S = 300.0

T_PARENT_CHILD = se3.exp(np.array([0.4, -0.3, 0.2, 1.1, -0.7, 0.5]))
POSE_KINDS = (
    Odometry,
    PoseStamped,
    PoseWithCovarianceStamped,
    TransformStamped,
)
START_NS = 1_700_000_000_000_000_000

LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
RELIABLE_INPUTS = [
    f"-p qos_overrides./{stream}_odom.subscription.reliability:=reliable"
    for stream in ("parent", "child")
]

_domains = itertools.count(os.getpid())
# Sockets (TCP) that hold the domains in use.
_held = {}


def values_of(status):
    """Keys and values of a diagnostic status."""
    return {pair.key: pair.value for pair in status.values}


def free_domain():
    """A domain id that nobody uses, held until :func:`release_domain` or the end of the process.

    A socket at the port of the first participant holds the domain against other test runs. The
    participants alone would not: after the first one ends, its port is free.
    """
    for candidate in itertools.islice(_domains, 100):
        # Above 101, the ports overlap with those that Linux gives to clients.
        domain = 1 + candidate % 100
        port = 7410 + 250 * domain
        if _has_participant(port):
            continue
        try:
            _held[domain] = socket.create_server(("", port))
        except OSError:
            continue
        return domain
    raise RuntimeError("no free ROS domain")


def _has_participant(first_port):
    """Whether a participant, such as the node of a test run that was killed, is in a domain.

    Every second port from the first one on belongs to a participant.
    """
    for number in range(5):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", first_port + 2 * number))
            except OSError:
                return True
    return False


def release_domain(domain):
    """Let others use a domain."""
    _held.pop(domain).close()


def drive(
    n_poses=120, period_ns=100_000_000, start_ns=START_NS, sigma_rad=5e-5
):
    """Stamps and poses of both sensors on a rig that turns about all axes. Without noise they would
    be one stream computed from the other.
    """
    elapsed_ns = period_ns * np.arange(n_poses)
    s = elapsed_ns * 1e-9
    angles = np.outer(s, [0.7, 0.9, 0.4]) + np.array([0.0, 1.0, 0.0])
    rotations = se3.rotation_exp(np.sin(angles) * [0.5, 0.4, 0.8])
    y = 2.0 * np.sin(0.5 * s)
    z = 0.5 * np.cos(0.8 * s)
    positions = np.stack([s, y, z], axis=1)
    Ts_pw_p = se3.from_rotation_translation(rotations, positions)
    T_cw_pw = se3.exp(np.array([5.0, -3.0, 1.0, 0.3, 0.1, 2.0]))
    Ts_cw_c = T_cw_pw @ Ts_pw_p @ T_PARENT_CHILD
    Ts_cw_c = disturbed(Ts_cw_c, 1, 5e-5, sigma_rad)
    return start_ns + elapsed_ns, Ts_pw_p, Ts_cw_c


def message(kind, stamp_ns, T_world_sensor, sensor_frame):
    """A pose message of any accepted type."""
    made = kind()
    made.header.stamp = conversions.to_time(stamp_ns)
    made.header.frame_id = "world"
    place, turn = parts_of(made)
    place.x, place.y, place.z = T_world_sensor[:3, 3].tolist()
    turn.x, turn.y, turn.z, turn.w = se3.to_quat_xyzw(T_world_sensor).tolist()
    if hasattr(made, "child_frame_id"):
        made.child_frame_id = sensor_frame
    return made


def parts_of(message):
    """Position and orientation of a pose message of any type, still messages."""
    if hasattr(message, "transform"):
        return message.transform.translation, message.transform.rotation
    pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    return pose.position, pose.orientation


def matrix(transform):
    """(4, 4) array of a TransformStamped."""
    translation = transform.transform.translation
    rotation = transform.transform.rotation
    position = [translation.x, translation.y, translation.z]
    quat_xyzw = [rotation.x, rotation.y, rotation.z, rotation.w]
    return se3.from_quat_xyzw(position, quat_xyzw)


# Most of a start is importing: nodes are forked from a process that has imported their modules. The
# process has also looked for the file of each module, as rclpy does with the first line of a log.
_FORKS = multiprocessing.get_context("forkserver")
_FORKS.set_forkserver_preload(
    [
        "pytest",
        "ros_harness",
        "hand_eye_calib.online.ros.calibrator",
        "hand_eye_calib.online.ros.node",
        "hand_eye_calib.online.ros.calibrator_node",
        "rosidl_generator_py",
        "type_description_interfaces.msg",
    ]
)
inspect.getmodule(inspect.currentframe())


def _run_node(arguments, log_file, environment, before):
    """The node's process, from the fork to its end."""
    gc.freeze()
    with log_file.open("wb") as log:
        for stream in (1, 2):
            os.dup2(log.fileno(), stream)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(log_file.parent)
    sys.stdout.reconfigure(write_through=True)
    sys.argv = ["hand_eye_calib", *arguments]
    exec(before, {})
    sys.exit(main(arguments))


class _Forked(_FORKS.Process):
    """A forked process, in words of :class:`subprocess.Popen` too."""

    def poll(self):
        return self.exitcode

    returncode = property(poll)

    def wait(self, timeout=None):
        self.join(timeout)
        assert self.exitcode is not None, f"process {self.pid} does not end"
        return self.exitcode

    def send_signal(self, number):
        os.kill(self.pid, number)


class NodeProcess:
    """The command ``calibrator`` in a process of its own, with its output in a file.

    The node starts its solving process as it does for users.

    Parameters
    ----------
    before : str
        Python code that runs in the process before the node.
    fresh : bool
        Whether an interpreter is started for the node. By default, the process is forked from one
        that has imported the modules of the node.
    """

    def __init__(self, domain, log_file, ros_arguments, before="", fresh=False):
        self._log_file = log_file
        if not any("report:=" in str(argument) for argument in ros_arguments):
            # A solve takes the processor for seconds.
            ros_arguments = [
                *ros_arguments,
                "-p report:=false",
            ]
        words = [
            word
            for argument in ros_arguments
            for word in str(argument).split(" ", 1)
        ]
        arguments = ["calibrator", "--ros-args", *words]
        source = str(Path(hand_eye_calib.__file__).parents[1])
        environment = os.environ | {
            "ROS_DOMAIN_ID": str(domain),
            "PYTHONUNBUFFERED": "1",
            "PYTHONPATH": os.pathsep.join(
                filter(None, [source, os.environ.get("PYTHONPATH")])
            ),
        }
        log_file.touch()
        if not fresh:
            arguments_of_node = arguments, log_file, environment, before
            self.process = _Forked(target=_run_node, args=arguments_of_node)
            self.process.start()
            return
        with log_file.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "hand_eye_calib", *arguments],
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment,
                cwd=log_file.parent,  # below it, output directories may be chosen
            )

    @property
    def log(self):
        return self._log_file.read_text(errors="replace")

    def wait_for_log(self, *texts, may_have_ended=False):
        """Wait until the log has all texts; returns the log."""
        end = time.monotonic() + PATIENCE_S
        while not all(text in self.log for text in texts):
            assert time.monotonic() < end, (
                f"no {texts} in the node's log:\n{self.log}"
            )
            assert may_have_ended or self.process.poll() is None, (
                f"the node ended with {self.process.returncode}:\n{self.log}"
            )
            time.sleep(0.02)
        return self.log

    def wait(self):
        """Exit code once the node has ended by itself."""
        return self.process.wait(PATIENCE_S)

    def stop(self, *signals):
        """Send signals, 50 ms apart; exit code and seconds it took."""
        start = time.monotonic()
        for number, next_signal in enumerate(signals or [signal.SIGINT]):
            if number > 0:
                time.sleep(0.05)
            self.process.send_signal(next_signal)
        code = self.process.wait(PATIENCE_S)
        duration_s = time.monotonic() - start
        return code, duration_s

    def kill(self):
        """End it at once where it still runs."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


class Peer:
    """Publishes poses to the node, hears its results, calls its services."""

    def __init__(self, domain):
        self.target = "calibrator"  # the node's name, with its namespace
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self.node = rclpy.create_node("peer", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._clients = {}

    def close(self):
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def spin_until(self, condition, what, hopeless=lambda: ""):
        """Take what comes in until a condition is met; fail at once if ``hopeless`` has a reason
        why it never will be.
        """
        end = time.monotonic() + PATIENCE_S
        while not condition():
            if reason := hopeless():
                pytest.fail(f"{what} cannot come: {reason}")
            assert time.monotonic() < end, f"waited {PATIENCE_S} s for {what}"
            self._executor.spin_once(timeout_sec=0.05)

    def publisher(self, kind, topic):
        """Publisher that keeps all it is given until a reliable subscription has it."""
        return self.node.create_publisher(
            kind,
            topic,
            QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE),
        )

    def publishers(self, kind=Odometry, child_kind=None):
        """Publishers on both inputs of the node."""
        return self.publisher(kind, "parent_odom"), self.publisher(
            child_kind or kind, "child_odom"
        )

    def wait_matched(self, *publishers):
        self.spin_until(
            lambda: all(
                publisher.get_subscription_count() for publisher in publishers
            ),
            "the node to subscribe",
        )

    def wait_left(self, *publishers):
        """Wait until a node that has ended is forgotten: what is published before that is lost."""
        self.spin_until(
            lambda: (
                not any(
                    publisher.get_subscription_count()
                    for publisher in publishers
                )
            ),
            "the node to leave",
        )

    def feed(
        self,
        publishers,
        stamps_ns,
        Ts_pw_p,
        Ts_cw_c,
        frames=("lidar", "camera"),
    ):
        """Publish both trajectories, interleaved."""
        self.wait_matched(*publishers)
        for stamp_ns, poses in zip(
            stamps_ns, zip(Ts_pw_p, Ts_cw_c, strict=True), strict=True
        ):
            for publisher, T_world_sensor, frame in zip(
                publishers, poses, frames, strict=True
            ):
                publisher.publish(
                    message(publisher.msg_type, stamp_ns, T_world_sensor, frame)
                )

    def listen(self, kind, name):
        """List that fills with the node's messages on a latched topic."""
        heard = []
        self.node.create_subscription(
            kind, f"{self.target}/{name}", heard.append, LATCHED
        )
        return heard

    def diagnostics(self):
        """Dictionary that fills with the newest status of each name."""
        newest = {}

        def take(array):
            newest.update({status.name: status for status in array.status})

        self.node.create_subscription(DiagnosticArray, "/diagnostics", take, 10)
        return newest

    def ask(self, kind, name, request=None):
        """Future of a service's answer."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(
                kind, f"{self.target}/{name}"
            )
        client = self._clients[name]
        self.spin_until(client.service_is_ready, f"service {name}")
        return client.call_async(request or kind.Request())

    def call(self, kind, name, request=None):
        """Answer of a service."""
        futures = []
        last_s = -math.inf

        def answered():
            nonlocal last_s
            # An answer is lost where the server has not discovered the client yet: then ask once
            # more.
            if time.monotonic() > last_s + 3.0:
                last_s = time.monotonic()
                futures.append(self.ask(kind, name, request))
            return any(future.done() for future in futures)

        self.spin_until(answered, f"the answer of {name}")
        done = [future for future in futures if future.done()]
        return done[0].result()

    def trigger(self, name):
        """Answer of a service, asked again while a solve goes on."""
        answers = [self.call(Trigger, name)]

        def is_final():
            if answers[-1].message.startswith("still solving"):
                answers.append(self.call(Trigger, name))
            return not answers[-1].message.startswith("still solving")

        self.spin_until(is_final, f"the end of {name}")
        return answers[-1]

    def solve(self, publishers, stamps_ns, Ts_pw_p, Ts_cw_c, **options):
        """Feed, then have the node solve with everything; answer of the last ~/solve.

        Best-effort delivery and services share no order, so it asks until the last stamp is in the
        result.
        """
        self.feed(publishers, stamps_ns, Ts_pw_p, Ts_cw_c, **options)
        extrinsics = self.listen(TransformStamped, "extrinsic")
        answers = []

        def solved():
            answers.append(self.trigger("solve"))
            self._executor.spin_once(timeout_sec=0.05)
            return (
                extrinsics
                and ns_of(extrinsics[-1].header.stamp) >= stamps_ns[-1]
            )

        def refused():
            """The answer that comes again and again, if it forbids to publish a result."""
            newest = [answer.message for answer in answers[-3:]]
            is_settled = len(newest) == 3 and len(set(newest)) == 1
            return (
                newest[0]
                if is_settled and newest[0].startswith("DO NOT USE")
                else ""
            )

        self.spin_until(solved, "a result with the last pose", refused)
        return answers[-1], extrinsics[-1]

    def set_enabled(self, data):
        return self.call(SetBool, "set_enabled", SetBool.Request(data=data))

    def set_parameter(self, name, value):
        parameter = Parameter(name, value=value).to_parameter_msg()
        (result,) = self.call(
            SetParameters,
            "set_parameters",
            SetParameters.Request(parameters=[parameter]),
        ).results
        return result

    def parameter(self, name):
        (value,) = self.call(
            GetParameters, "get_parameters", GetParameters.Request(names=[name])
        ).values
        return rclpy.parameter.parameter_value_to_python(value)

    def describe(self, name):
        request = DescribeParameters.Request(names=[name])
        (descriptor,) = self.call(
            DescribeParameters, "describe_parameters", request
        ).descriptors
        return descriptor
