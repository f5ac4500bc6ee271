"""Messages that cannot be used, bags that loop, services that steer the session."""

import itertools
import os
import re
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Odometry
from numpy.testing import assert_allclose
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_harness import (
    RELIABLE_INPUTS,
    START_NS,
    T_PARENT_CHILD,
    drive,
    matrix,
    message,
    values_of,
)
from sensor_msgs.msg import Imu, NavSatFix
from std_srvs.srv import Trigger

from hand_eye_calib.online.ros import conversions

QUIET = ["-p solve_period:=1000.0", *RELIABLE_INPUTS]


def test_unusable_messages_are_refused_by_topic_and_poison_nothing(
    start_node, peer
):
    node = start_node(*QUIET, "--log-level calibrator:=debug")
    publishers = peer.publishers()
    peer.wait_matched(*publishers)
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    nan, far, long = (
        message(Odometry, START_NS - early_ns, T, frame)
        for early_ns, T, frame in ((3, Ts_pw_p[0], "lidar"), (2, Ts_pw_p[0], "lidar"),
                                   (1, Ts_cw_c[0], "camera"))
    )  # fmt: skip
    nan.pose.pose.position.y = float("nan")
    far.pose.pose.position.x = 1e154
    long.pose.pose.orientation.w += 1.0
    for index, wrong in ((0, nan), (0, far), (1, long)):
        publishers[index].publish(wrong)
    refused = [
        f"/{name}_odom: a message is refused: " for name in ("parent", "child")
    ]
    _, extrinsic = peer.solve(publishers, stamps_ns, Ts_pw_p, Ts_cw_c)
    publishers[0].publish(
        message(Odometry, stamps_ns[-1], Ts_pw_p[-1], "lidar")
    )
    log = node.wait_for_log(*refused, "is repeated or too late")
    assert len(re.findall(r"message with stamp .* refused: ", log)) == 2, log
    assert (
        len(re.findall(r"message with stamp .* is left out: .*not finite", log))
        == 1
    ), log
    assert "Traceback" not in log
    assert_allclose(matrix(extrinsic), T_PARENT_CHILD, atol=1e-3)


def test_a_sensor_frame_without_a_name_is_named_by_default_or_by_parameter(
    start_node, peer
):
    # The messages of Odometry have an empty name; PoseStamped has no place for one.
    publishers = peer.publishers(Odometry, PoseStamped)
    for options, names in (
        ([], ("parent_sensor", "child_sensor")),
        (["-p parent_frame:=lidar"], ("lidar", "child_sensor")),
    ):
        node = start_node(*QUIET, *options)
        _, extrinsic = peer.solve(publishers, *drive(), frames=("", ""))
        assert (extrinsic.header.frame_id, extrinsic.child_frame_id) == names
        node.wait_for_log("name it with child_frame")
        assert node.stop()[0] == 0
        peer.wait_left(*publishers)


def test_bag_that_loops_starts_a_new_session(start_node, peer):
    node = start_node(*QUIET)
    publishers = peer.publishers()
    # The first lap is of another rig: were it kept, the result would be wrong.
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    peer.solve(publishers, stamps_ns, Ts_pw_p, Ts_pw_p)
    second_ns = stamps_ns[: len(stamps_ns) // 2]
    half = len(second_ns)
    peer.feed(publishers, second_ns, Ts_pw_p[:half], Ts_cw_c[:half])
    node.wait_for_log("jumped back by", "new session")
    heard = peer.listen(TransformStamped, "extrinsic")

    def right():
        peer.trigger("solve")
        return heard and np.allclose(
            matrix(heard[-1]), T_PARENT_CHILD, atol=1e-3
        )

    peer.spin_until(right, "the second lap's extrinsic")
    assert "poses, " in peer.trigger("solve").message


def test_solves_at_once_have_answers_and_a_reset_forgets_poses_and_result(
    start_node, peer
):
    node = start_node(*QUIET)
    answer = peer.trigger("solve")
    assert not answer.success
    assert answer.message
    node.wait_for_log(f"cannot solve yet: {answer.message}")
    answer, _ = peer.solve(peer.publishers(), *drive())
    assert answer.success
    assert "camera in lidar: xyz = (" in answer.message
    answers = [peer.ask(Trigger, "solve") for _ in range(5)]
    peer.spin_until(
        lambda: all(answer.done() for answer in answers), "all answers"
    )
    assert all(answer.result().success for answer in answers)
    assert peer.trigger("reset").success
    late = peer.listen(TransformStamped, "extrinsic")
    peer.spin_until(
        lambda: peer.node.count_publishers("/calibrator/extrinsic") == 1,
        "one topic",
    )
    time.sleep(0.5)  # what is not to come has no event
    assert not peer.trigger("solve").success
    assert not late


def test_result_of_a_session_that_was_reset_meanwhile_is_dropped(
    start_node, peer
):
    node = start_node(*QUIET)
    peer.solve(peer.publishers(), *drive())
    heard = peer.listen(TransformStamped, "extrinsic")
    statuses = peer.diagnostics()
    peer.spin_until(lambda: heard, "the result of before")

    def wait_until(is_solving):
        name = "/calibrator: extrinsic"
        statuses.clear()
        peer.spin_until(
            lambda: (
                name in statuses
                and values_of(statuses[name])["is_solving"] == is_solving
            ),
            f"is_solving {is_solving}",
        )

    wait_until("false")  # requests may have been repeated
    n_heard = len(heard)
    tasks = Path(f"/proc/{node.process.pid}/task").glob("*/children")
    (solver,) = map(int, " ".join(task.read_text() for task in tasks).split())
    os.kill(solver, signal.SIGSTOP)
    answer = peer.ask(Trigger, "solve")
    wait_until("true")  # two services share no order
    assert peer.trigger("reset").success
    os.kill(solver, signal.SIGCONT)
    peer.spin_until(answer.done, "the answer of solve")
    assert not answer.result().success
    dropped = "the session was reset during the solve: the result is dropped"
    assert answer.result().message == dropped
    assert len(heard) == n_heard


BEST_EFFORT = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)


def test_best_effort_publishers_of_a_remapped_topic_are_counted_heard_and_named(
    start_node, peer
):
    """Whatever QoS the other input has."""
    node = start_node(
        "-p solve_period:=0.1",
        "-r parent_odom:=/lidar/odom",
        RELIABLE_INPUTS[1],
    )
    child = peer.publisher(Odometry, "child_odom")
    peer.wait_matched(child)  # its override comes first
    parent = peer.node.create_publisher(Odometry, "/lidar/odom", BEST_EFFORT)
    node.wait_for_log("no pose yet on /lidar/odom: 1 publisher")
    peer.feed((parent, child), *drive(8))
    node.wait_for_log("first pose on /lidar/odom", "first pose on /child_odom")


def test_a_qos_that_keeps_messages_away_is_named(start_node, peer):
    start_node(*QUIET)
    statuses = peer.diagnostics()
    peer.node.create_publisher(Odometry, "parent_odom", BEST_EFFORT)
    sentence = "no message on /parent_odom yet: it is published best effort, but qos_overrides ask"
    peer.spin_until(
        lambda: any(
            status.message.startswith(sentence) for status in statuses.values()
        ),
        "that",
    )


class TestRefusedInput:
    """What an input carries cannot be used: that is said, and ends nothing."""

    def test_a_type_that_does_not_measure_what_was_asked_for(
        self, start_node, peer
    ):
        node = start_node(QUIET[0], "-p child_measures:=rates")
        wrong = peer.publisher(PoseStamped, "child_odom")
        node.wait_for_log(
            "[ERROR]",
            "/child_odom has messages of type geometry_msgs/msg/PoseStamped, which measure poses "
            "or positions or rotations; the options ask for rates",
        )
        peer.node.destroy_publisher(wrong)
        peer.wait_matched(peer.publisher(Imu, "child_odom"))
        assert "Traceback" not in node.log

    def test_positions_where_the_mount_is_watched(self, start_node, peer):
        node = start_node("-p monitor:=true", "-p installed:=1 0 0 0 0 0")
        peer.publisher(NavSatFix, "child_odom")
        node.wait_for_log(
            "a rig and the monitor need poses; child has positions"
        )
        peer.wait_matched(peer.publisher(Odometry, "parent_odom"))

    def test_positions_on_both_inputs(self, start_node, peer):
        node = start_node("-p solve_period:=0.1", *RELIABLE_INPUTS)
        # The one that comes second is refused.
        peer.wait_matched(peer.publisher(NavSatFix, "parent_odom"))
        wrong = peer.publisher(NavSatFix, "child_odom")
        node.wait_for_log(
            "/child_odom is not used: positions determine a lever arm only beside poses of the "
            "other sensor; give positions with orientations for one of the two; the parent "
            "measures positions, the child positions"
        )
        peer.node.destroy_publisher(wrong)
        peer.wait_matched(peer.publisher(Odometry, "child_odom"))

    @pytest.mark.parametrize(
        ("arguments", "text"),
        [
            (
                [
                    "child_measures:=rates",
                    "child_type:=geometry_msgs/msg/PoseStamped",
                ],
                "/child_odom has messages of type geometry_msgs/msg/PoseStamped, which measure",
            ),
            (
                ["child_measures:=positions", "parent_measures:=positions"],
                "positions determine a lever arm only beside poses of the other sensor",
            ),
            (
                [
                    "child_measures:=positions",
                    "monitor:=true",
                    "installed:=1 0 0 0 0 0",
                ],
                "monitor needs poses of both sensors; the parent measures auto, the child positio",
            ),
            (
                ["monitor:=true"],
                "monitor needs installed: set it to the transform to compare with",
            ),
            (
                ["journal:=resume"],
                "journal resume needs output_directory: set the session",
            ),
            (
                ["output_directory:=~nosuchuser/x"],
                "output_directory '~nosuchuser/x'",
            ),
        ],
    )
    def test_parameters_that_cannot_go_together_end_the_start_in_one_line(
        self, start_node, arguments, text
    ):
        node = start_node(*(f"-p {argument}" for argument in arguments))
        assert node.wait() == 1
        assert node.log.startswith(f"calibrator: {text}")
        assert node.log.count("\n") == 1


def received_and_lost(statuses):
    """Numbers of messages received and lost of both inputs; empty until they are known."""
    values = [
        values_of(status)
        for name, status in statuses.items()
        if name.endswith(" input")
    ]
    if len(values) < 2 or any(row["lost"] == "unknown" for row in values):
        return []
    return [[int(row[key]) for key in ("messages", "lost")] for row in values]


class TestLoss:
    """Messages that are lost on the way are counted, to within two in a hundred."""

    def test_a_node_that_does_not_keep_up(self, start_node, peer):
        statuses = peer.diagnostics()
        node = start_node(
            "-p solve_period:=1000.0", "-r parent_odom:=/lidar/odom"
        )
        qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        topics = "/lidar/odom", "child_odom"
        publishers = [
            peer.node.create_publisher(Odometry, topic, qos) for topic in topics
        ]
        made = [
            message(Odometry, START_NS, stream[0], "lidar")
            for stream in drive(1)[1:]
        ]
        n_sent = 0
        calls = itertools.count()

        def send(count):
            """Quick: a node that is stopped for longer than 20 s is forgotten."""
            nonlocal n_sent
            for number in range(n_sent, n_sent + count):
                stamp = conversions.to_time(START_NS + 2_500_000 * number)
                for publisher, pose in zip(publishers, made, strict=True):
                    pose.header.stamp = stamp
                    publisher.publish(pose)
            n_sent += count

        def told():
            """Received and lost messages of both inputs, once known; now and then one more is sent,
            so that everything lost has a later one after it.
            """
            if next(calls) % 50 == 0:
                send(1)
            return received_and_lost(statuses)

        def is_all_accounted_for():
            """Of n_before, an unknown number was sent before the subscriptions."""
            for received, lost in told() or [(0, 0)]:
                excess = received + lost - n_sent
                slack = 0.02 * lost
                if lost < 500 or not -n_before - slack <= excess <= slack:
                    return False
            return True

        peer.spin_until(told, "both inputs to receive")
        n_before = n_sent
        node.process.send_signal(signal.SIGSTOP)
        send(3800)
        node.process.send_signal(signal.SIGCONT)
        peer.spin_until(
            is_all_accounted_for, "all messages to be received or lost"
        )
        node.wait_for_log("of the messages are lost. Free processor time")
