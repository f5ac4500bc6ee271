"""Nothing is lost: the node killed, stopped, restarted, and with a disk that fails."""

import hashlib
import resource
import signal

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from numpy.testing import assert_allclose
from ros_harness import RELIABLE_INPUTS, T_PARENT_CHILD, drive, matrix

from hand_eye_calib.formats.journal import (
    count_poses,
    has_session,
    read_journal,
)
from hand_eye_calib.formats.results import load_result

QUIET = ["-p solve_period:=1000.0", *RELIABLE_INPUTS]


def into(folder, journal="new"):
    return [f"-p output_directory:={folder}", f"-p journal:={journal}"]


def wait_written(peer, folder, poses):
    """Wait until the journal on disk has so many poses."""
    journal = folder / "journal"
    peer.spin_until(
        lambda: has_session(journal) and count_poses(journal) == poses,
        f"{poses} poses in the journal",
    )


def test_a_killed_session_goes_on_where_it_ended(start_node, peer, tmp_path):
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    node = start_node(*QUIET, *into(tmp_path))
    peer.feed(peer.publishers(), stamps_ns[:60], Ts_pw_p[:60], Ts_cw_c[:60])
    wait_written(peer, tmp_path, 120)
    node.process.kill()
    node.wait()

    again = start_node(*QUIET, *into(tmp_path, "resume"))
    again.wait_for_log(
        f"session resumed from {tmp_path / 'journal'}: 120 poses"
    )
    heard = peer.listen(TransformStamped, "extrinsic")
    answer = peer.trigger("solve")
    assert "60 poses" in answer.message
    assert "camera in lidar" in answer.message
    peer.spin_until(lambda: heard, "the resumed result")
    assert_allclose(matrix(heard[-1]), T_PARENT_CHILD, atol=1e-3)


def test_an_earlier_session_is_kept_aside_once_and_an_empty_one_is_not(
    start_node, peer, tmp_path
):
    node = start_node(*QUIET, *into(tmp_path))
    peer.feed(peer.publishers(), *drive(30))
    wait_written(peer, tmp_path, 60)
    assert node.stop()[0] == 0
    for _ in range(2):  # the second finds the empty session of the first
        node = start_node(*QUIET, *into(tmp_path))
        assert "no poses" in peer.trigger("solve").message
        wait_written(peer, tmp_path, 0)
        assert node.stop()[0] == 0
        assert count_poses(tmp_path / "journal.previous") == 60
    assert sorted(tmp_path.glob("journal*")) == [
        tmp_path / "journal",
        tmp_path / "journal.previous",
    ]
    first_log = (tmp_path / "node1.log").read_text()
    assert "the session before this one (60 poses) is kept in" in first_log
    start_node(*QUIET, *into(tmp_path))
    peer.feed(peer.publishers(), *drive(20))
    wait_written(peer, tmp_path, 40)
    assert peer.trigger("reset").success  # which keeps the session aside too
    wait_written(peer, tmp_path, 0)
    assert count_poses(tmp_path / "journal.previous") == 40


def test_nothing_to_resume_and_a_damaged_journal_begin_a_new_session(
    start_node, peer, tmp_path
):
    node = start_node(*QUIET, *into(tmp_path, "resume"))
    node.wait_for_log(
        f"no session to resume in {tmp_path / 'journal'}: a new session begins"
    )
    assert node.stop()[0] == 0
    (tmp_path / "journal" / "parent.tum").write_text("something else")
    node = start_node(*QUIET, *into(tmp_path, "resume"))
    node.wait_for_log(
        "cannot resume: ",
        "damaged from its first byte",
        "the session before this one is kept in",
    )
    wait_written(peer, tmp_path, 0)


def test_a_signal_saves_the_newest_result_and_the_whole_journal(
    start_node, peer, tmp_path
):
    live = tmp_path / "live"
    node = start_node(*QUIET, *into("live"))  # told as a whole path
    node.wait_for_log(f"files go to {live}")
    peer.solve(peer.publishers(), *drive())
    code, _ = node.stop(signal.SIGTERM)
    assert (code, "Traceback" in node.log) == (0, False), node.log
    assert f"result saved to {live}: " in node.log
    assert_allclose(load_result(live).T_parent_child, T_PARENT_CHILD, atol=1e-3)
    assert count_poses(live / "journal") == 240
    for stream, n_bytes in read_journal(live / "journal").whole_bytes.items():
        assert n_bytes == (live / "journal" / f"{stream}.tum").stat().st_size


def test_a_disk_that_is_full_is_reported_and_the_node_goes_on(
    start_node, peer, tmp_path
):
    node = start_node(*QUIET, *into(tmp_path / "out"))
    publishers = peer.publishers()
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    peer.solve(publishers, stamps_ns[:40], Ts_pw_p[:40], Ts_cw_c[:40])
    assert peer.trigger("save").success
    saved = fingerprints(tmp_path / "out")
    # No file may grow beyond so many bytes, which its log does not reach: for the node, the disk is
    # full.
    resource.prlimit(
        node.process.pid, resource.RLIMIT_FSIZE, (3000, resource.RLIM_INFINITY)
    )
    answer, _ = peer.solve(
        publishers, stamps_ns[40:], Ts_pw_p[40:], Ts_cw_c[40:]
    )
    assert answer.success
    peer.spin_until(
        lambda: not peer.trigger("save").success, "the save to fail"
    )
    assert fingerprints(tmp_path / "out") == saved
    node.wait_for_log(
        "cannot write the session journal in",
        "no journal until ~/reset",
        "cannot save",
    )
    resource.prlimit(
        node.process.pid,
        resource.RLIMIT_FSIZE,
        (resource.RLIM_INFINITY, resource.RLIM_INFINITY),
    )
    assert peer.trigger("save").success
    assert peer.trigger("reset").success
    peer.feed(publishers, stamps_ns[:40], Ts_pw_p[:40], Ts_cw_c[:40])
    wait_written(peer, tmp_path / "out", 80)


def test_a_directory_that_cannot_be_made_is_reported_and_the_node_goes_on(
    start_node, peer, tmp_path
):
    blocked = tmp_path / "a_file"
    blocked.write_text("")
    node = start_node(*QUIET, *into(blocked / "out"))
    node.wait_for_log("cannot write the session journal in")
    assert peer.solve(peer.publishers(), *drive())[0].success
    statuses = peer.diagnostics()
    name = "/calibrator: journal"
    error = "a crash would lose the session"
    peer.spin_until(
        lambda: name in statuses and error in statuses[name].message,
        "the status",
    )
    assert statuses[name].level == DiagnosticStatus.ERROR
    refused = peer.trigger("save")
    assert (refused.success, str(blocked) in refused.message) == (False, True)
    assert peer.trigger("solve").success
    code, _ = node.stop()  # the result is lost, which the exit code says
    assert (code, "Traceback" in node.log) == (1, False), node.log
    assert "cannot save: " in node.log


def fingerprints(folder):
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.iterdir()
        if path.is_file()
    }


def test_two_nodes_do_not_share_a_directory(start_node, peer, tmp_path):
    used = tmp_path / "used"
    first = start_node(*QUIET, *into(used))
    peer.trigger("solve")
    second = start_node(*QUIET, *into(used))
    assert second.wait() == 1
    line = f"output_directory {used} is in use by another calibrator: stop the other calibrator, or"
    assert second.log == f"calibrator: {line} choose another directory\n"
    first.process.kill()
    first.wait()
    # A node that was killed stores nothing.
    third = start_node("-p solve_period:=0.2", *into(used))
    third.wait_for_log("no pose yet on /parent_odom")


def test_participants_choose_a_directory_below_that_of_the_start_only(
    start_node, peer, tmp_path
):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "link").symlink_to(tmp_path / "elsewhere")
    start_node(*QUIET, *into(tmp_path / "mine"))
    for outside in (
        "elsewhere",
        "mine/../elsewhere",
        "mine/link",
        "mine/link/below",
    ):
        refused = peer.set_parameter(
            "output_directory", str(tmp_path / outside)
        )
        assert not refused.successful, outside
        assert f"must be {tmp_path / 'mine'} or below it" in refused.reason
    refused = peer.set_parameter("output_directory", "~nosuchuser/x")
    assert (refused.successful, "~nosuchuser/x" in refused.reason) == (
        False,
        True,
    )
    assert peer.parameter("output_directory") == str(tmp_path / "mine")
    assert peer.set_parameter(
        "output_directory", str(tmp_path / "mine" / "truck")
    ).successful
    assert not list((tmp_path / "elsewhere").iterdir())


def test_an_earlier_result_is_kept_once_and_replaced_whatever_it_is(
    start_node, peer, tmp_path
):
    (tmp_path / "extrinsic.yaml").write_bytes(b"\xff\xfe\x00 not UTF-8")
    node = start_node(*QUIET, *into(tmp_path))
    peer.solve(peer.publishers(), *drive())
    for _ in range(2):
        assert peer.trigger("save").success
    assert node.stop()[0] == 0
    assert (
        (tmp_path / "previous" / "extrinsic.yaml")
        .read_bytes()
        .startswith(b"\xff\xfe")
    )
    assert load_result(tmp_path).n_poses == 120
