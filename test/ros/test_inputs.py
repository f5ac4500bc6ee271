"""Messages that cannot be used, bags that loop, services that steer the session."""

import numpy as np
from geometry_msgs.msg import PoseStamped, TransformStamped
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
    start_node(*QUIET, "-p reference:=B1")
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
