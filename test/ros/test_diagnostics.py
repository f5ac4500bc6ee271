"""What a person next to the robot reads on /diagnostics."""

import itertools
import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from faults import inverted, reordered
from ros_harness import RELIABLE_INPUTS, START_NS, drive, message

from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.results import load_result

NAMES = [
    f"/calibrator: {name}"
    for name in (
        "extrinsic",
        "progress",
        "parent input",
        "child input",
        "stream checks",
        "journal",
    )
]


@pytest.fixture
def heard(peer):
    """List of mappings of names to statuses, as they come in."""
    received = []
    peer.node.create_subscription(
        DiagnosticArray,
        "/diagnostics",
        lambda array: received.append({each.name: each for each in array.status}),
        10,
    )
    return received


def wait(peer, heard, name, condition):
    """The first status of a name that meets a condition, among those still to come."""
    start = len(heard)
    name = f"/calibrator: {name}"
    peer.spin_until(
        lambda: any(condition(each[name]) for each in heard[start:]), f"such a status of {name}"
    )
    return next(each[name] for each in heard[start:] if condition(each[name]))


def values(status):
    return {pair.key: pair.value for pair in status.values}


def test_nothing_is_ok_before_a_valid_result_and_the_inputs_that_are_missing_are_named(
    start_node, peer, heard
):
    start_node()
    peer.spin_until(lambda: heard, "diagnostics")
    assert list(heard[0]) == NAMES
    assert {each.level for each in heard[0].values()} == {DiagnosticStatus.WARN}
    assert heard[0]["/calibrator: parent input"].message == "no message on /parent_odom yet"
    publishers = peer.publishers()
    peer.feed(publishers, *drive(5))  # too few
    # An input that delivers is no fault, whatever the result.
    parent = wait(peer, heard, "parent input", lambda status: status.message.endswith("Hz"))
    assert parent.level == DiagnosticStatus.OK
    wait(
        peer,
        heard,
        "extrinsic",
        lambda status: "synchronised pose pairs are needed" in status.message,
    )
    assert all(
        statuses["/calibrator: extrinsic"].level != DiagnosticStatus.OK for statuses in heard
    )


def test_two_nodes_are_told_apart(start_node, peer, heard):
    start_node("-r __ns:=/robot1")
    start_node("-r __node:=other")
    names = lambda: {name for statuses in heard for name in statuses}  # noqa: E731
    peer.spin_until(lambda: len(names()) == 2 * len(NAMES), "both nodes")
    assert {name.rpartition(": ")[0] for name in names()} == {"/robot1/calibrator", "/other"}


def test_a_good_drive_is_ok_with_all_its_figures(start_node, peer, heard, tmp_path):
    start_node("-p solve_period:=0.5", f"-p output_directory:={tmp_path}", *RELIABLE_INPUTS)
    publishers = peer.publishers()
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    # Stamps of now, the child's 5 s behind.
    stamps_ns = stamps_ns - stamps_ns[-1] + time.time_ns()
    peer.wait_matched(*publishers)
    for publisher, frame, Ts, late_ns in zip(
        publishers, ("lidar", "camera"), (Ts_pw_p, Ts_cw_c), (0, 5 * 10**9), strict=True
    ):
        for stamp_ns, T in zip(stamps_ns, Ts, strict=True):
            publisher.publish(message(publisher.msg_type, int(stamp_ns) - late_ns, T, frame))
    parent = wait(peer, heard, "parent input", lambda status: "set time_offset" in status.message)
    assert parent.level == DiagnosticStatus.WARN
    # By the times of arrival: more on a busy machine.
    assert float(values(parent)["clock offset to the other input seen (s)"]) > 3.0
    assert peer.set_parameter("time_offset", 5.0).successful
    good = wait(
        peer,
        heard,
        "extrinsic",
        lambda status: (
            status.level == DiagnosticStatus.OK and "120" in values(status)["synchronised poses"]
        ),
    )
    assert good.message.startswith("USE: all six axes are known to ")
    found = values(good)
    assert found["missing"] == "nothing"
    assert found["status"] == "ok"
    assert found["inliers (%)"] == "100.0"
    assert all(float(found[f"rotation about {axis} (deg)"]) > 20 for axis in "xyz")
    assert all(float(found[f"sigma {axis} (mm)"]) < 1.0 for axis in "xyz")
    assert all(float(found[f"sigma {axis} (deg)"]) < 0.1 for axis in ("roll", "pitch", "yaw"))
    assert 0 <= float(found["age of the result (s)"]) < 60
    journal = wait(peer, heard, "journal", lambda status: status.level == DiagnosticStatus.OK)
    assert values(journal)["directory"] == str(tmp_path / "journal")


def test_flat_ground_is_said_in_one_sentence(start_node, peer, heard):
    start_node("-p solve_period:=0.2", *RELIABLE_INPUTS)
    stamps_ns, _, _ = drive()
    s = (stamps_ns - START_NS) * 1e-9
    flat = se3.from_rotation_translation(
        se3.rotation_exp(np.outer(np.arctan(0.5 * np.cos(0.5 * s)), [0, 0, 1])),
        np.stack([s, np.sin(0.5 * s), 0 * s], axis=1),
    )
    noise = se3.exp(np.random.default_rng(0).normal(size=(2, len(s), 6)) * 1e-3)
    peer.feed(peer.publishers(), stamps_ns, flat @ noise[0], flat @ noise[1])
    status = wait(
        peer,
        heard,
        "extrinsic",
        lambda status: (
            "rotation about z is fine" in status.message and "sigma z (mm)" in values(status)
        ),
    )
    assert status.level == DiagnosticStatus.WARN
    assert status.message.startswith("USE WITH CARE: all but z; measure z by hand; ")
    assert (
        "roll and pitch under 1 deg: vertical offset (z) not observable, drive over a ramp"
        in status.message
    )
    assert values(status)["sigma z (mm)"] == "unknown"


def test_bad_input_is_an_error_by_topic_and_reason(start_node, peer, heard):
    start_node(*RELIABLE_INPUTS)
    publishers = peer.publishers()
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    peer.feed(publishers, stamps_ns, Ts_pw_p, Ts_cw_c)
    wait(peer, heard, "extrinsic", lambda status: status.level == DiagnosticStatus.OK)
    # Both silent with a result: the robot is parked. One of them: something is broken.
    silent = wait(peer, heard, "child input", lambda status: "silent for" in status.message)
    assert silent.level == DiagnosticStatus.OK

    later_ns = itertools.count(int(stamps_ns[-1]), 10**8)

    def only_the_parent_goes_on(status):
        stamp_ns = next(later_ns)
        publishers[0].publish(message(publishers[0].msg_type, stamp_ns, Ts_pw_p[-1], "lidar"))
        return status.level == DiagnosticStatus.WARN and "silent for" in status.message

    wait(peer, heard, "child input", only_the_parent_goes_on)
    for stamp_ns in stamps_ns[:8]:  # enough to be believed after the pause
        publishers[1].publish(
            message(publishers[1].msg_type, int(stamp_ns) + 12 * 10**9, Ts_cw_c[0], "other_camera")
        )
    status = wait(peer, heard, "child input", lambda status: status.level == DiagnosticStatus.ERROR)
    assert (
        "/child_odom: the child stream's sensor frame changed from 'camera' to 'other_camera'"
        in status.message
    )
    assert values(status)["refused: unusable"] == "8"
    publishers[0].publish(message(publishers[0].msg_type, 0, Ts_pw_p[0], "lidar"))
    status = wait(
        peer,
        heard,
        "parent input",
        lambda status: values(status).get("refused: corrupt stamp") == "1",
    )
    assert status.level == DiagnosticStatus.ERROR


def test_repeated_stamps_gaps_and_rates_are_counted_and_disabled_is_said(start_node, peer, heard):
    start_node(*RELIABLE_INPUTS, "-p max_gap:=0.3")
    publishers = peer.publishers()
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    kept = np.r_[0:20, 30:60, 60:60]
    peer.feed(publishers, stamps_ns[kept], Ts_pw_p[kept], Ts_cw_c[kept])
    peer.feed(publishers, stamps_ns[55:60], Ts_pw_p[55:60], Ts_cw_c[55:60])
    found = values(
        wait(
            peer,
            heard,
            "parent input",
            lambda status: values(status)["refused: repeated stamp"] == "5",
        )
    )
    assert (found["messages"], found["poses taken"]) == ("55", "50")
    assert (found["longest gap (s)"], found["gaps above max_gap"]) == ("1.100", "1")
    assert float(found["rate (Hz)"]) > 0
    assert peer.set_enabled(False).success
    disabled = "not accepting poses: call ~/set_enabled"
    wait(peer, heard, "extrinsic", lambda status: disabled in status.message)


def test_simulated_time_that_does_not_run_is_said(start_node, peer, heard):
    start_node("-p use_sim_time:=true", "-p solve_period:=0.2", *RELIABLE_INPUTS)
    peer.feed(peer.publishers(), *drive())
    status = wait(peer, heard, "extrinsic", lambda status: "status" in values(status))
    assert (
        values(status)["age of its newest pose (s)"] == "the clock does not run: nothing on /clock"
    )


def test_a_journal_that_cannot_be_written_is_an_error(start_node, peer, heard, tmp_path):
    (tmp_path / "a_file").write_text("")
    start_node(f"-p output_directory:={tmp_path / 'a_file' / 'out'}")
    status = wait(peer, heard, "journal", lambda status: status.level == DiagnosticStatus.ERROR)
    assert "a crash would lose the session" in status.message


class TestStreamChecks:
    """What the checks find is said while one still drives."""

    @pytest.mark.parametrize(
        ("damage", "said"),
        [
            (reordered, "the child stream's quaternions seem to be written w x y z"),
            (inverted, "the child stream seems to hold inverse poses"),
        ],
    )
    def test_faulty_streams_are_named(self, start_node, peer, heard, damage, said):
        node = start_node("-p solve_period:=0.5", *RELIABLE_INPUTS)
        stamps_ns, Ts_pw_p, Ts_cw_c = drive(250)
        peer.feed(
            peer.publishers(), stamps_ns, Ts_pw_p, damage(Trajectory(stamps_ns, Ts_cw_c)).poses
        )
        status = wait(peer, heard, "stream checks", lambda status: said in status.message)
        assert status.level == DiagnosticStatus.WARN
        verdict = wait(peer, heard, "extrinsic", lambda status: said in status.message)
        assert verdict.level == DiagnosticStatus.WARN
        assert verdict.message.startswith("DO NOT USE: ")
        node.wait_for_log(said)

    def test_what_helps_is_a_parameter_and_what_is_mended_is_no_longer_said(
        self, start_node, peer, heard, tmp_path
    ):
        node = start_node(
            "-p solve_period:=0.5",
            "-p scale:=0.002",
            f"-p output_directory:={tmp_path}",
            *RELIABLE_INPUTS,
        )
        stamps_ns, Ts_pw_p, Ts_cw_c = drive(250)
        Ts_cw_c[:, :3, 3] *= 1000.0
        peer.feed(peer.publishers(), stamps_ns, Ts_pw_p, Ts_cw_c)
        wait(
            peer,
            heard,
            "stream checks",
            lambda status: status.message.endswith(": set scale to 0.001"),
        )
        assert peer.trigger("save").success
        assert load_result(tmp_path).headline.startswith("DO NOT USE: the child's lengths must be")
        assert peer.set_parameter("scale", 0.001).successful
        status = wait(
            peer, heard, "stream checks", lambda status: status.level == DiagnosticStatus.OK
        )
        assert status.message == "both streams can be of one rigid body"
        wait(peer, heard, "extrinsic", lambda status: status.level == DiagnosticStatus.OK)
        log = node.wait_for_log("no longer found: the child's lengths must be")
        assert log.count("set scale to 0.001") == 1

    def test_a_unit_that_is_certain_is_used_and_said(self, start_node, peer, heard, tmp_path):
        node = start_node(
            "-p solve_period:=0.5", f"-p output_directory:={tmp_path}", *RELIABLE_INPUTS
        )
        stamps_ns, Ts_pw_p, Ts_cw_c = drive(250)
        Ts_cw_c[:, :3, 3] *= 1000.0
        peer.feed(peer.publishers(), stamps_ns, Ts_pw_p, Ts_cw_c)
        said = "solved with scale 0.001"
        node.wait_for_log(said)
        wait(peer, heard, "stream checks", lambda status: status.level == DiagnosticStatus.OK)
        wait(peer, heard, "extrinsic", lambda status: status.level == DiagnosticStatus.OK)
        assert peer.trigger("save").success
        result = load_result(tmp_path)
        assert result.scale == 0.001
        assert any(said in text for text in result.warnings)

    def test_sound_streams_raise_nothing(self, start_node, peer, heard):
        node = start_node("-p solve_period:=0.5", *RELIABLE_INPUTS)
        peer.feed(peer.publishers(), *drive(250))
        status = wait(
            peer, heard, "stream checks", lambda status: status.level == DiagnosticStatus.OK
        )
        assert not [key for key in values(status) if key.startswith(("warning", "error"))]
        assert "[WARN]" not in node.log

    def test_too_little_driving_is_said(self, start_node, peer, heard):
        start_node("-p solve_period:=0.5", *RELIABLE_INPUTS)
        peer.feed(peer.publishers(), *drive(60))
        wait(peer, heard, "extrinsic", lambda status: "status" in values(status))
        status = wait(peer, heard, "stream checks", lambda status: True)
        assert status.level == DiagnosticStatus.WARN
        assert (
            status.message == "not checked yet: that takes 20 s of motion with rotations of 30 deg"
        )
