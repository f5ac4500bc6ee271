"""Messages that cannot be used, bags that loop, services that steer the session."""

import signal
import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_harness import RELIABLE_INPUTS, START_NS, T_PARENT_CHILD, drive, matrix, message
from std_srvs.srv import Trigger

QUIET = ["-p solve_period:=1000.0", *RELIABLE_INPUTS]


def test_unusable_messages_are_refused_by_topic_and_the_node_goes_on(start_node, peer):
    node = start_node(*QUIET)
    publishers = peer.publishers()
    peer.wait_matched(*publishers)
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    nan = message(publishers[0].msg_type, START_NS - 2, Ts_pw_p[0], "lidar")
    nan.pose.pose.position.y = float("nan")
    publishers[0].publish(nan)
    long = message(publishers[1].msg_type, START_NS - 1, Ts_cw_c[0], "camera")
    long.pose.pose.orientation.w += 1.0
    publishers[1].publish(long)
    log = node.wait_for_log("/parent_odom: message with stamp", "/child_odom: message with stamp")
    assert "Traceback" not in log
    _, extrinsic = peer.solve(publishers, stamps_ns, Ts_pw_p, Ts_cw_c)
    np.testing.assert_allclose(matrix(extrinsic), T_PARENT_CHILD, atol=1e-6)


def test_empty_sensor_frame_is_named_by_default_or_by_parameter(start_node, peer):
    node = start_node(*QUIET)
    _, extrinsic = peer.solve(peer.publishers(), *drive(), frames=("", "camera"))
    assert (extrinsic.header.frame_id, extrinsic.child_frame_id) == ("parent_sensor", "camera")
    node.wait_for_log("name it with parent_frame")
    assert node.stop()[0] == 0
    start_node(*QUIET, "-p parent_frame:=lidar")
    _, extrinsic = peer.solve(peer.publishers(), *drive(), frames=("", "camera"))
    assert extrinsic.header.frame_id == "lidar"


def test_sensor_frame_that_changes_is_refused_by_topic(start_node, peer):
    node = start_node(*QUIET)
    publishers = peer.publishers()
    stamps_ns, Ts_pw_p, Ts_cw_c = drive(40)
    peer.feed(publishers, stamps_ns[:20], Ts_pw_p[:20], Ts_cw_c[:20])
    peer.feed(
        publishers, stamps_ns[20:], Ts_pw_p[20:], Ts_cw_c[20:], frames=("lidar", "other_camera")
    )
    log = node.wait_for_log("/child_odom: message with stamp")
    assert "camera" in log
    assert "other_camera" in log


def test_poses_without_a_sensor_frame_are_used_and_said_to_be_nameless(start_node, peer):
    node = start_node(*QUIET)
    _, extrinsic = peer.solve(peer.publishers(PoseStamped), *drive())
    node.wait_for_log("name it with parent_frame", "name it with child_frame")
    assert (extrinsic.header.frame_id, extrinsic.child_frame_id) == (
        "parent_sensor",
        "child_sensor",
    )


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
        return heard and np.allclose(matrix(heard[-1]), T_PARENT_CHILD, atol=1e-6)

    peer.spin_until(right, "the second lap's extrinsic")
    assert "poses, " in peer.trigger("solve").message


def test_small_reordering_does_not_start_a_new_session(start_node, peer):
    node = start_node(*QUIET)
    publishers = peer.publishers()
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    order = np.arange(len(stamps_ns))
    order[10:12] = [11, 10]
    _, extrinsic = peer.solve(publishers, stamps_ns[order], Ts_pw_p[order], Ts_cw_c[order])
    np.testing.assert_allclose(matrix(extrinsic), T_PARENT_CHILD, atol=1e-6)
    assert "new session" not in node.log


def test_solve_without_poses_says_what_is_missing(start_node, peer):
    node = start_node(*QUIET)
    answer = peer.trigger("solve")
    assert not answer.success
    assert answer.message
    node.wait_for_log(f"cannot solve yet: {answer.message}")


def test_reset_forgets_the_poses(start_node, peer):
    start_node(*QUIET)
    answer, _ = peer.solve(peer.publishers(), *drive())
    assert answer.success
    assert "camera in lidar: xyz = (" in answer.message
    assert peer.trigger("reset").success
    assert not peer.trigger("solve").success


def test_result_of_a_session_that_was_reset_meanwhile_is_dropped(start_node, peer):
    start_node(*QUIET, "-p method:=dnl", "-p reference:=B1")
    peer.solve(peer.publishers(), *drive(1500, period_ns=20_000_000))
    assert peer.set_parameter("backend", "ipopt").successful  # slow: a second or so
    heard = peer.listen(TransformStamped, "extrinsic")
    peer.spin_until(lambda: heard, "the result of before")
    answer = peer.ask(Trigger, "solve")
    assert peer.trigger("reset").success
    peer.spin_until(answer.done, "the answer of solve")
    assert not answer.result().success
    assert (
        answer.result().message == "the session was reset during the solve: its result is dropped"
    )
    assert len(heard) == 1


def test_disabled_node_takes_no_poses(start_node, peer):
    node = start_node(*QUIET)
    publishers = peer.publishers()
    peer.wait_matched(*publishers)
    assert peer.set_enabled(False).success
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    peer.feed(publishers, stamps_ns, Ts_pw_p, Ts_cw_c)
    all_ignored = f"not accepting poses; {2 * len(stamps_ns)} ignored so far"
    peer.spin_until(
        lambda: peer.set_enabled(False).message == all_ignored, "the node to ignore every pose"
    )
    assert "no poses" in peer.trigger("solve").message
    assert peer.set_enabled(True).success
    _, extrinsic = peer.solve(publishers, stamps_ns + 10**12, Ts_pw_p, Ts_cw_c)
    np.testing.assert_allclose(matrix(extrinsic), T_PARENT_CHILD, atol=1e-6)
    assert f"first pose on /parent_odom, stamp {(START_NS + 10**12) * 1e-9:.3f} s" in node.log


def test_save_writes_the_result_files(start_node, peer, tmp_path):
    start_node(*QUIET)
    refused = peer.trigger("save")
    assert not refused.success
    assert "output_directory" in refused.message
    assert peer.set_parameter("output_directory", str(tmp_path / "out")).successful
    too_early = peer.trigger("save")
    assert not too_early.success
    assert "no result" in too_early.message
    peer.solve(peer.publishers(), *drive())
    saved = peer.trigger("save")
    assert saved.success, saved.message
    assert (tmp_path / "out" / "extrinsic.yaml").stat().st_size > 0


def test_directory_that_cannot_be_written_is_reported(start_node, peer, tmp_path):
    blocked = tmp_path / "a_file"
    blocked.write_text("")
    node = start_node(*QUIET, f"-p output_directory:={blocked / 'out'}")
    answer, _ = peer.solve(peer.publishers(), *drive())
    assert answer.success
    refused = peer.trigger("save")
    assert not refused.success
    assert str(blocked) in refused.message
    assert peer.trigger("solve").success
    assert node.stop()[0] == 1


def test_a_publisher_that_restarts_with_another_type_is_heard(start_node, peer):
    node = start_node(*QUIET)
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    before = peer.publishers(Odometry, Odometry)
    peer.feed(before, stamps_ns[:60], Ts_pw_p[:60], Ts_cw_c[:60])
    node.wait_for_log("first pose on /child_odom")
    peer.node.destroy_publisher(before[1])
    after = before[0], peer.publisher(TransformStamped, "child_odom")
    _, extrinsic = peer.solve(after, stamps_ns[60:], Ts_pw_p[60:], Ts_cw_c[60:])
    node.wait_for_log("/child_odom has changed its type from nav_msgs/msg/Odometry")
    np.testing.assert_allclose(matrix(extrinsic), T_PARENT_CHILD, atol=1e-6)


def test_a_reset_withdraws_the_result_of_the_forgotten_session(start_node, peer):
    start_node(*QUIET)
    peer.solve(peer.publishers(), *drive())
    assert peer.trigger("reset").success
    late = peer.listen(TransformStamped, "extrinsic")
    peer.spin_until(lambda: peer.node.count_publishers("/calibrator/extrinsic") == 1, "one topic")
    time.sleep(0.5)
    assert not peer.trigger("solve").success
    assert not late


def test_a_hundred_calls_of_solve_at_once_have_a_hundred_answers(start_node, peer):
    start_node(*QUIET)
    peer.solve(peer.publishers(), *drive())
    answers = [peer.ask(Trigger, "solve") for _ in range(100)]
    peer.spin_until(lambda: all(each.done() for each in answers), "all answers")
    assert all(each.result().success for each in answers)


def test_a_directory_of_nobody_is_refused_as_a_parameter(start_node, peer):
    node = start_node(*QUIET)
    refused = peer.set_parameter("output_directory", "~nosuchuser/x")
    assert not refused.successful
    assert "~nosuchuser/x" in refused.reason
    assert peer.parameter("output_directory") == ""
    assert node.process.poll() is None


def test_a_directory_of_nobody_at_the_start_is_one_line_and_code_1(start_node):
    node = start_node("-p output_directory:=~nosuchuser/x")
    assert node.wait() == 1
    assert node.log.startswith("calibrator: output_directory '~nosuchuser/x'")
    assert node.log.count("\n") == 1


def test_a_position_beyond_the_world_is_refused_and_poisons_nothing(start_node, peer):
    node, publishers = start_node(*QUIET), peer.publishers()
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    far = Ts_pw_p[:1].copy()
    far[0, 0, 3] = 1e154
    peer.feed(publishers, stamps_ns[:1] - 1, far, Ts_cw_c[:1])
    node.wait_for_log("is more than 1e+08 m from the origin")
    _, extrinsic = peer.solve(publishers, stamps_ns, Ts_pw_p, Ts_cw_c)
    np.testing.assert_allclose(matrix(extrinsic), T_PARENT_CHILD, atol=1e-6)


class TestLoss:
    """Messages that are lost on the way are counted, to within two in a hundred."""

    @pytest.fixture
    def counted(self, peer):
        """Values of the inputs' newest statuses."""
        newest = {}

        def take(array):
            for each in array.status:
                values = {pair.key: pair.value for pair in each.values}
                newest[each.name.rpartition(": ")[2]] = values | {"said": each.message}

        peer.node.create_subscription(DiagnosticArray, "/diagnostics", take, 10)
        return newest

    def test_a_node_that_does_not_keep_up(self, start_node, peer, counted):
        node = start_node("-p solve_period:=1000.0")
        qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        publishers = [
            peer.node.create_publisher(Odometry, f"{stream}_odom", qos)
            for stream in ("parent", "child")
        ]
        stamps_ns, Ts_pw_p, Ts_cw_c = drive(4000, period_ns=2_500_000)
        peer.feed(publishers, stamps_ns[:100], Ts_pw_p[:100], Ts_cw_c[:100])
        node.process.send_signal(signal.SIGSTOP)
        peer.feed(publishers, stamps_ns[100:3900], Ts_pw_p[100:3900], Ts_cw_c[100:3900])
        node.process.send_signal(signal.SIGCONT)
        time.sleep(1.0)
        peer.feed(publishers, stamps_ns[3900:], Ts_pw_p[3900:], Ts_cw_c[3900:])

        def accounted(name):
            """Received and lost messages of the newest status make up all that were sent."""
            values = counted.get(name, {})
            if values.get("lost messages", "unknown") == "unknown":
                return False
            received, lost = (int(values[key]) for key in ("messages", "lost messages"))
            return lost > 500 and abs(received + lost - 4000) <= 0.02 * lost

        # The last message has come, so everything lost has a later one after it.
        for name in ("parent input", "child input"):
            peer.spin_until(lambda name=name: accounted(name), "all messages received or lost")
