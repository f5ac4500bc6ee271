"""What the node says of itself: its state on ~/progress, and /diagnostics made of it."""

import itertools
import json

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from faults import inverted
from motions import disturbed
from ros_harness import LATCHED, RELIABLE_INPUTS, drive, message, values_of
from std_msgs.msg import String

from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.results import load_result
from hand_eye_calib.online.live.state import Level
from hand_eye_calib.online.ros.watcher import state_of

PARTS = (
    "extrinsic",
    "progress",
    "parent input",
    "child input",
    "stream checks",
    "journal",
)


@pytest.fixture
def state(peer):
    """``state(condition)``: the first state that meets a condition, among those still to come.

    ``meanwhile()`` is called again and again until then.
    """
    heard = []
    peer.node.create_subscription(
        String,
        "calibrator/progress",
        lambda message: heard.append(state_of(message.data)),
        LATCHED,
    )

    def wait(condition, description="such a state", meanwhile=lambda: None):
        start = len(heard)

        def met():
            return next(
                (document for document in heard[start:] if condition(document)),
                None,
            )

        peer.spin_until(lambda: meanwhile() or met(), description)
        return met()

    wait.heard = heard
    return wait


def test_nothing_is_ok_before_a_valid_result_and_the_inputs_that_are_missing_are_named(
    start_node, peer, state
):
    start_node()
    first = state(lambda document: True)
    assert tuple(name for name, _ in first.parts()) == PARTS
    assert {status.level for _, status in first.parts()} == {Level.WARN}
    assert (
        first.inputs["parent"].text
        == "no message on /parent_odom yet: 0 publishers"
    )
    peer.feed(peer.publishers(), *drive(8))  # too few
    # An input that delivers is no fault, whatever the result.
    document = state(
        lambda document: document.inputs["parent"].text.endswith("Hz")
    )
    assert document.inputs["parent"].level is Level.OK
    state(
        lambda document: (
            "synchronised pose pairs are needed" in document.extrinsic.text
        )
    )
    assert Level.OK not in {
        document.extrinsic.level for document in state.heard
    }


def test_diagnostics_have_the_same_and_tell_two_nodes_apart(start_node, peer):
    start_node("-r __ns:=/robot1", "-p target.translation:=0.03")
    start_node("-r __node:=other")
    statuses = peer.diagnostics()
    states = []
    topic = "/robot1/calibrator/progress"
    peer.node.create_subscription(String, topic, states.append, LATCHED)
    peer.spin_until(
        lambda: states and len(statuses) == 2 * len(PARTS), "both nodes"
    )
    names = [
        f"{node}: {name}"
        for node in ("/robot1/calibrator", "/other")
        for name in PARTS
    ]
    assert set(statuses) == set(names)
    progress = statuses["/robot1/calibrator: progress"]
    document = json.loads(states[-1].data)
    assert progress.message == document["headline"]
    assert progress.message.startswith(
        "CHECK INPUT: No message on /robot1/parent_odom"
    )
    values = values_of(progress)
    assert (progress.level, progress.hardware_id) == (
        DiagnosticStatus.WARN,
        "hand_eye_calib",
    )
    z = [values[f"{name}.z"] for name in ("sigma", "target")]
    assert (values["done"], *z) == ("false", "unknown", "0.03")


def test_a_good_drive_is_ok_with_all_its_figures(
    start_node, peer, state, tmp_path
):
    start_node(
        "-p solve_period:=0.5",
        f"-p output_directory:={tmp_path}",
        *RELIABLE_INPUTS,
    )
    publishers = peer.publishers()
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    peer.wait_matched(*publishers)  # the child's clock is 20 s behind
    for publisher, frame, Ts, late_ns in zip(
        publishers,
        ("lidar", "camera"),
        (Ts_pw_p, Ts_cw_c),
        (0, 20 * 10**9),
        strict=True,
    ):
        for stamp_ns, T in zip(stamps_ns, Ts, strict=True):
            publisher.publish(
                message(publisher.msg_type, int(stamp_ns) - late_ns, T, frame)
            )
    sentence = (
        "the streams do not overlap in time (120 parent and 120 child poses"
    )
    # A solve may come before.
    apart = state(
        lambda document: sentence in document.extrinsic.text
    ).extrinsic
    assert (apart.level, "set time_offset" in apart.text) == (Level.WARN, True)
    assert peer.set_parameter("time_offset", 20.0).successful
    good = state(
        lambda document: (
            document.extrinsic.level is Level.OK
            and document.extrinsic.n_poses == 120
        )
    )
    assert good.extrinsic.text.startswith("USE: good to ")
    assert all(angle > 20 for angle in good.extrinsic.rotation_deg.values())
    result = good.extrinsic.result
    assert result.status == "ok"
    assert all(
        0.001 < result.pose_sigma[axis] < 0.01 for axis in "xyz"
    )  # the floor
    assert 0 <= result.age_s < 60
    assert (good.journal.level, good.journal.directory) == (
        Level.OK,
        str(tmp_path / "journal"),
    )


def test_bad_input_is_an_error_by_topic_and_reason(start_node, peer, state):
    start_node(*RELIABLE_INPUTS)
    publishers = peer.publishers()
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    peer.feed(publishers, stamps_ns, Ts_pw_p, Ts_cw_c)
    state(lambda document: document.extrinsic.level is Level.OK)
    # Both silent with a result: the robot is parked. One of them: something is broken.
    silent = state(
        lambda document: "silent for" in document.inputs["child"].text
    )
    assert silent.inputs["child"].level is Level.OK

    later_ns = itertools.count(int(stamps_ns[-1]), 10**8)

    def only_the_parent_goes_on():
        stamp_ns = next(later_ns)
        publishers[0].publish(
            message(publishers[0].msg_type, stamp_ns, Ts_pw_p[-1], "lidar")
        )

    def is_broken(document):
        child = document.inputs["child"]
        return child.level is Level.WARN and "silent for" in child.text

    state(is_broken, "the silence of the child", only_the_parent_goes_on)
    for stamp_ns in stamps_ns[:8]:  # enough to be believed after the pause
        publishers[1].publish(
            message(
                publishers[1].msg_type,
                int(stamp_ns) + 12 * 10**9,
                Ts_cw_c[0],
                "other_camera",
            )
        )
    child = state(
        lambda document: document.inputs["child"].level is Level.ERROR
    ).inputs["child"]
    assert (
        "/child_odom: the child stream's sensor frame changed from 'camera' to 'other_camera'"
        in child.text
    )
    assert child.refused["unusable"] == 8
    for stamp_ns in (0, next(later_ns)):
        publishers[0].publish(
            message(publishers[0].msg_type, stamp_ns, Ts_pw_p[0], "lidar")
        )
    newest = state(
        lambda document: (
            document.inputs["parent"].refused.get("corrupt stamp") == 1
        )
    )
    assert newest.inputs["parent"].level is Level.ERROR


def test_repeated_stamps_gaps_and_rates_are_counted_and_disabled_is_said(
    start_node, peer, state
):
    start_node(*RELIABLE_INPUTS)
    publishers = peer.publishers()
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    kept = np.r_[0:20, 30:60, 60:60]
    peer.feed(publishers, stamps_ns[kept], Ts_pw_p[kept], Ts_cw_c[kept])
    peer.feed(publishers, stamps_ns[55:60], Ts_pw_p[55:60], Ts_cw_c[55:60])
    parent = state(
        lambda document: (
            document.inputs["parent"].refused["repeated stamp"] == 5
        )
    )
    parent = parent.inputs["parent"]
    assert (parent.messages, parent.poses_taken) == (55, 50)
    assert parent.longest_gap_s == pytest.approx(1.1)
    assert parent.rate_hz > 0
    assert peer.set_enabled(False).success
    disabled = "poses are not accepted: call ~/set_enabled"
    state(lambda document: disabled in document.extrinsic.text)


def test_a_dead_publisher_pauses_the_session_and_a_second_one_is_named(
    start_node, peer, state
):
    start_node("-p solve_period:=0.5", *RELIABLE_INPUTS)
    publishers = peer.publishers()
    stamps_ns, Ts_pw_p, Ts_cw_c = drive(200)
    peer.feed(publishers, stamps_ns, Ts_pw_p, Ts_cw_c)
    later_ns = itertools.count(int(stamps_ns[-1]) + 10**8, 10**8)

    def both_go_on():
        stamp_ns = next(later_ns)
        newest = (Ts_pw_p[-1], "lidar"), (Ts_cw_c[-1], "camera")
        for publisher, (T, frame) in zip(publishers, newest, strict=True):
            publisher.publish(message(publisher.msg_type, stamp_ns, T, frame))

    def has_result(document):
        # On a busy computer, the first result comes long after the last pose of the drive.
        return document.extrinsic.result and not document.progress.is_paused

    state(has_result, "a result of streams that go on", both_go_on)
    second = peer.publisher(publishers[1].msg_type, "child_odom")

    def has_two_publishers(document):
        return document.inputs["child"].publishers == 2

    child = state(
        has_two_publishers, "the second publisher", both_go_on
    ).inputs["child"]
    assert child.level is Level.WARN
    assert (
        "/child_odom has 2 publishers, all named /peer. Stop all but one"
        in child.text
    )
    for publisher in (publishers[1], second):
        peer.node.destroy_publisher(publisher)

    def only_the_parent_goes_on():
        made = message(
            publishers[0].msg_type, next(later_ns), Ts_pw_p[-1], "lidar"
        )
        publishers[0].publish(made)

    def is_paused(document):
        # A check of the streams may come at any time, and its finding is a graver text.
        return (
            document.progress.is_paused and document.inputs["child"].is_paused
        )

    paused = state(is_paused, "the pause", only_the_parent_goes_on)
    assert paused.progress.is_paused
    assert paused.progress.level is Level.WARN
    gone = "it has no publisher any more"
    left = state(
        lambda document: gone in document.inputs["child"].text,
        "the end of the publisher",
    )
    child = left.inputs["child"]
    assert (child.publishers, child.level) == (0, Level.WARN)


def test_too_little_driving_is_said_also_where_time_does_not_run(
    start_node, peer, state
):
    start_node(
        "-p use_sim_time:=true", "-p solve_period:=0.2", *RELIABLE_INPUTS
    )
    peer.feed(peer.publishers(), *drive())
    newest = state(lambda document: document.extrinsic.result)
    assert (newest.checks.level, newest.checks.age_s) == (Level.WARN, None)
    sentence = (
        "not checked yet: that takes 20 s of motion with rotations of 30 deg"
    )
    assert newest.checks.text == sentence


def in_millimetres(trajectory):
    poses = trajectory.poses.copy()
    poses[:, :3, 3] *= 1000.0
    return Trajectory(trajectory.stamps_ns, poses)


class TestStreamChecks:
    """What the checks find is said while one still drives."""

    @pytest.mark.parametrize(
        ("damage", "sentence"),
        [
            (inverted, "the child stream seems to contain inverse poses"),
            (in_millimetres, "solved with scale 0.001"),
        ],
    )
    def test_faulty_streams_that_can_be_repaired_are_named_and_solved_with(
        self, start_node, peer, state, damage, sentence
    ):
        node = start_node("-p solve_period:=0.5", *RELIABLE_INPUTS)
        stamps_ns, Ts_pw_p, Ts_cw_c = drive(250, sigma_rad=7e-4)
        # Both are noisy, as odometries are: noise of one alone leaves open which is inverse.
        Ts_pw_p = disturbed(Ts_pw_p, 9, 5e-5, 7e-4)
        child = damage(Trajectory(stamps_ns, Ts_cw_c)).poses
        peer.feed(peer.publishers(), stamps_ns, Ts_pw_p, child)

        def is_told(document):
            result = document.extrinsic.result
            # Solves begin before the last pose.
            is_whole = document.extrinsic.n_poses == len(stamps_ns)
            return (
                result
                and is_whole
                and any(sentence in text for text in result.warnings)
            )

        newest = state(is_told)
        assert (newest.checks.level, newest.extrinsic.result.verdict) == (
            Level.OK,
            "USE",
        )
        node.wait_for_log(sentence)

    def test_what_helps_is_a_parameter_and_what_is_mended_is_no_longer_said(
        self, start_node, peer, state, tmp_path
    ):
        node = start_node(
            "-p solve_period:=0.5", "-p scale:=0.002", f"-p output_directory:={tmp_path}",
            *RELIABLE_INPUTS,
        )  # fmt: skip
        stamps_ns, Ts_pw_p, Ts_cw_c = drive(250, sigma_rad=7e-4)
        Ts_cw_c[:, :3, 3] *= 1000.0
        peer.feed(peer.publishers(), stamps_ns, Ts_pw_p, Ts_cw_c)
        state(
            lambda document: document.checks.text.endswith(
                ": set scale to 0.001"
            )
        )
        assert peer.trigger("save").success
        assert load_result(tmp_path).headline.startswith(
            "DO NOT USE: the child's lengths must be"
        )
        assert peer.set_parameter("scale", 0.001).successful
        newest = state(
            lambda document: (
                document.checks.level is Level.OK
                and document.extrinsic.level is Level.OK
            )
        )
        assert newest.checks.text == "both streams can be of one rigid body"
        log = node.wait_for_log("no longer found: the child's lengths must be")
        assert log.count("set scale to 0.001") == 1

    def test_sound_streams_raise_nothing(self, start_node, peer, state):
        # A solve of the first few poses may say what they do not determine.
        node = start_node(
            "-p solve_period:=0.5", "-p min_pairs:=240", *RELIABLE_INPUTS
        )
        peer.feed(peer.publishers(), *drive(250, sigma_rad=7e-4))
        newest = state(lambda document: document.checks.level is Level.OK)
        assert not [
            sentence
            for sentence in newest.checks.findings
            if not sentence.startswith("note")
        ]
        warnings = [line for line in node.log.splitlines() if "[WARN]" in line]
        # Other programs may keep the computer busy.
        assert not [
            line for line in warnings if "The computer is busy" not in line
        ]
