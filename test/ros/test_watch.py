"""``watch`` beside the real node, over the real middleware."""

import http.client
import os
import re
import signal
import subprocess
import sys
import time
from html import unescape
from types import SimpleNamespace

import pytest
from ros_harness import PATIENCE_S, RELIABLE_INPUTS, drive

import hand_eye_calib as hec
from hand_eye_calib.core.base.plain import json_text
from hand_eye_calib.core.results.parts import brief_facts_of
from hand_eye_calib.online.live.state import JournalState, Level, NodeState
from hand_eye_calib.online.ros.watcher import Watcher
from hand_eye_calib.online.watch.board import Board, state_of

QUICK = ("-p solve_period:=0.2", *RELIABLE_INPUTS)


def test_what_is_no_state_is_left_out_and_control_characters_are_escaped():
    journal = JournalState(level=Level.OK, text="a\x1bb", directory="")
    state = NodeState(node="/r/calibrator", journal=journal)
    assert state_of(json_text(state)).journal.text == r"a\x1bb"
    for text in ("", "[]", "{", "[" * 100_000, '{"inputs": {}}', "7"):
        assert state_of(text) is None


def test_of_ten_thousand_names_on_the_network_a_few_are_kept():
    heard = []
    watcher = Watcher.__new__(Watcher)
    watcher._board = Board()
    watcher._sources = set()
    watcher._shared_since_s = {}
    topics = [
        (f"/n{k}/progress", ["std_msgs/msg/String"]) for k in range(10_000)
    ]
    watcher._node = SimpleNamespace(
        get_topic_names_and_types=lambda: topics,
        create_subscription=lambda kind, topic, *_: heard.append(topic),
        count_publishers=lambda topic: 1,
    )
    watcher._discover()
    assert 10 < len(heard) == len(watcher._sources) < 100


class Watch:
    """``python -m hand_eye_calib watch`` with its lines and notes in files."""

    def __init__(self, domain, directory, *arguments):
        self.seen = directory / "seen.txt"
        self.notes = directory / "notes.txt"
        with self.seen.open("w") as seen, self.notes.open("w") as notes:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "hand_eye_calib", "watch", *arguments],
                stdout=seen,
                stderr=notes,
                env=os.environ
                | {
                    "ROS_DOMAIN_ID": str(domain),
                    "XDG_STATE_HOME": str(directory),
                },
            )

    def wait_for(self, pattern, file=None):
        """Wait until a file, by default what was seen, has a pattern; returns the match."""
        end = time.monotonic() + PATIENCE_S
        while not (
            match := re.search(pattern, (file or self.seen).read_text())
        ):
            text = self.seen.read_text() + self.notes.read_text()
            assert time.monotonic() < end, f"no {pattern!r} in:\n{text}"
            assert self.process.poll() is None, text
            time.sleep(0.05)
        return match


@pytest.fixture
def start_watch(domain, tmp_path):
    running = []

    def start(*arguments):
        running.append(Watch(domain, tmp_path, *arguments))
        return running[-1]

    yield start
    for watch in running:
        watch.process.kill()
        watch.process.wait()


def test_a_person_sees_the_session_from_the_first_message_to_done(
    start_node, start_watch, peer, tmp_path
):
    watch = start_watch("--web", "127.0.0.1:0")
    watch.wait_for("NO NODE: No message from a calibrator yet")
    node = start_node(*QUICK, f"-p output_directory:={tmp_path / 'out'}")
    watch.wait_for("CHECK INPUT: No message on /parent_odom yet")
    publishers = peer.publishers()
    poses = drive(180, 300_000_000, sigma_rad=7e-4)
    parts = [
        [poses_of_stream[start:end] for poses_of_stream in poses]
        for start, end in ((0, 90), (90, 130), (130, 180))
    ]
    peer.solve(publishers, *parts[0])  # 27 s of motion are not enough
    watch.wait_for("▶ GO ON: ")
    peer.solve(publishers, *parts[1])  # and one result is none
    peer.solve(publishers, *parts[2])
    watch.wait_for("✓ DONE: ")

    address = r"http://127.0.0.1:(\d+)/\?key=(\S+)"
    port, key = watch.wait_for(address, watch.notes).groups()
    page = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    page.request("POST", f"/save?key={key}")
    assert page.getresponse().status == 200
    watch.wait_for("save: result saved to ")
    assert (tmp_path / "out" / "extrinsic.yaml").exists()
    events = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    events.request("GET", f"/events?key={key}")
    shown = events.getresponse().readline().decode()
    assert "pose of camera in lidar" in shown
    assert "DONE" in shown
    # The page and the saved result state the same smallest errors. The page is short.
    saved = hec.load(tmp_path / "out")
    (errors,) = brief_facts_of(saved)
    assert "Errors above" in errors
    assert errors in unescape(shown)
    assert saved.detectability.errors["x"] < 0.2

    node.stop()
    watch.wait_for("✓ ENDED: The node has ended. The result was saved at")
    watch.process.send_signal(signal.SIGINT)
    assert watch.process.wait(PATIENCE_S) == 0
    assert "Traceback" not in watch.notes.read_text()


def test_one_of_several_nodes_is_chosen_by_name(start_node, start_watch):
    for name in ("a", "b"):
        start_node("-r __ns:=/robot_" + name, *QUICK)
    watch = start_watch("--node", "/robot_b/calibrator")
    watch.wait_for("No message on /robot_b/parent_odom yet")
    assert "robot_a" not in watch.seen.read_text()


def test_two_nodes_of_one_name_are_one_state_without_requests(
    start_node, start_watch
):
    first = start_node(*QUICK)
    watch = start_watch()
    watch.wait_for("No message on /parent_odom yet")
    second = start_node(*QUICK)
    watch.wait_for(
        "! CHECK INPUT: Two nodes are named /calibrator. "
        "Stop one of them, or set another ROS_DOMAIN_ID."
    )
    n_before = len(watch.seen.read_text())
    second.stop()
    watch.wait_for(r"ROS_DOMAIN_ID\.\n(.*\n)*.*No message on /parent_odom yet")
    assert len(watch.seen.read_text()) > n_before
    assert first.process.poll() is None
