"""Poses that stop coming: which stream, since when, and what a person sees."""

from types import SimpleNamespace

import numpy as np
import pytest
from result_making import good_calibration, seen

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.formats.transforms import PoseFields
from hand_eye_calib.online.live import cycle as cycle_module
from hand_eye_calib.online.live import input as module
from hand_eye_calib.online.live.cycle import SolveCycle
from hand_eye_calib.online.live.describing import pause_of
from hand_eye_calib.online.live.input import PoseInput
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.session import LiveSession
from hand_eye_calib.online.live.solving import Answer
from hand_eye_calib.online.live.state import Broadcast, Level, NodeState
from hand_eye_calib.online.watch.board import Board, Tone

RATE_HZ = 10.0


@pytest.fixture
def log_lines():
    return []


@pytest.fixture
def node(monkeypatch, log_lines):
    """Both inputs of a session on a clock of its own, and the state that the node would publish."""
    nothing = SimpleNamespace(
        submit=lambda job: None, stop=lambda s: None, answers=list
    )
    monkeypatch.setattr(cycle_module, "SolvingProcess", lambda wake: nothing)
    now = [1000.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    write = dict.fromkeys(
        ("debug", "info", "warning", "error"), log_lines.append
    )
    log = NodeLog(SimpleNamespace(**write))
    session = LiveSession(log, CalibratorConfig())
    inputs = [
        PoseInput(name, f"/{name}_odom", session, log, lambda source: None)
        for name in ("parent", "child")
    ]
    for source in inputs:
        source.publishers = ("/driver",)
    targets = CalibratorConfig().targets
    cycle = SolveCycle(
        session, log, print, lambda calibration: calibration, print, targets
    )
    cycle.ask(lambda good, text: None)
    return SimpleNamespace(now=now, inputs=inputs, cycle=cycle)


def pose_at(stamp_ns):
    return PoseFields(
        stamp_ns, "world", None, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    )


def run(node, seconds, senders=("parent", "child"), stamps_stand=False):
    """Let time pass, with poses of the senders."""
    for _ in range(round(seconds * RATE_HZ)):
        node.now[0] += 1.0 / RATE_HZ
        stamp_ns = round((100.0 if stamps_stand else node.now[0]) * 1e9)
        pose = pose_at(stamp_ns)
        for source in node.inputs:
            if source.name in senders:
                source.accept(stamp_ns, lambda pose=pose: pose)


def state_of(node, may_rest=False):
    inputs = {
        source.name: source.state(node.now[0], may_rest)
        for source in node.inputs
    }
    pause = pause_of(inputs, node.inputs[0].is_enabled)
    return NodeState(
        node="/calibrator",
        inputs=inputs,
        extrinsic=node.cycle.extrinsic_state(True, (Broadcast.OFF, "")),
        progress=node.cycle.progress_state("", pause),
    )


def view_of(state):
    board = Board()
    board.take(state, 0.0)
    return board.view(0.5)


def with_result(node, motion_s=20.0):
    newest = good_calibration(warnings=())
    node.cycle.conclude(Answer(0, 0.1, seen(motion_s), newest))


def test_a_stream_that_stops_pauses_the_session_and_is_named(node):
    run(node, 20.0)
    with_result(node)
    assert view_of(state_of(node)).word == "GO ON"
    run(node, 4.5, senders=["parent"])
    assert view_of(state_of(node)).word == "GO ON"
    run(node, 2.5, senders=["parent"])
    state = state_of(node)
    view = view_of(state_of(node))
    assert (state.inputs["child"].level, state.inputs["parent"].level) == (
        Level.WARN,
        Level.OK,
    )
    assert state.inputs["child"].text == "/child_odom has been silent for 7 s"
    assert (state.progress.level, state.progress.is_paused) == (
        Level.WARN,
        True,
    )
    assert state.progress.text == (
        "Paused: no pose of child (/child_odom) for 7.0 s; start the source of the poses again."
    )
    assert (view.word, view.tone) == ("PAUSED", Tone.ACT)
    assert "/child_odom" in view.sentence
    run(node, 1.0)
    assert view_of(state_of(node)).word == "GO ON"


@pytest.mark.parametrize("stream", ["parent", "child"])
def test_messages_that_give_no_pose_are_no_sign_of_life(node, stream):
    run(node, 20.0)
    with_result(node)
    other = "child" if stream == "parent" else "parent"
    last_ns = round(node.now[0] * 1e9)
    for _ in range(80):
        run(node, 0.1, senders=[other])
        pose = pose_at(last_ns)
        source = next(item for item in node.inputs if item.name == stream)
        source.accept(last_ns, lambda pose=pose: pose)
    state = state_of(node)
    assert state.inputs[stream].level is Level.WARN
    assert (
        "has messages, but no new pose for 8 s. Check the source: the stamps repeat"
        in (state.inputs[stream].text)
    )
    assert (state.progress.is_paused, view_of(state).word) == (True, "PAUSED")


def test_a_publisher_that_has_gone_is_named_and_a_parked_robot_asks_for_nothing(
    node,
):
    run(node, 20.0)
    with_result(node)
    run(node, 8.0, senders=[])
    parked = state_of(node, may_rest=True)
    assert {item.level for item in parked.inputs.values()} == {Level.OK}
    assert (parked.progress.level, parked.progress.is_paused) == (
        Level.OK,
        True,
    )
    assert parked.progress.text == (
        "Paused: no pose of parent (/parent_odom) and child (/child_odom) for 8.0 s; "
        "continue to drive, or save."
    )
    assert (view_of(parked).word, view_of(parked).tone) == ("PAUSED", Tone.BUSY)
    node.inputs[1].publishers = ()
    dead = state_of(node, may_rest=False)
    assert dead.inputs["child"].text == (
        "/child_odom has been silent for 8 s: it has no publisher any more"
    )
    assert (dead.progress.level, view_of(dead).tone) == (Level.WARN, Tone.ACT)


def test_a_session_that_is_done_is_not_paused(node):
    run(node, 20.0)
    for motion_s in (20.0, 32.0, 44.0):
        with_result(node, motion_s)
    run(node, 8.0, senders=[])
    state = state_of(node, may_rest=True)
    assert (state.progress.is_paused, view_of(state).word) == (False, "DONE")


def test_a_node_that_accepts_no_poses_is_paused(node):
    run(node, 20.0)
    with_result(node)
    for source in node.inputs:
        source.is_enabled = False
    run(node, 8.0)
    state = state_of(node)
    assert {item.level for item in state.inputs.values()} == {Level.OK}
    assert (
        state.progress.text
        == "Paused: poses are not accepted; call ~/set_enabled, or activate the node."
    )
    assert (state.progress.level, view_of(state).word) == (Level.WARN, "PAUSED")


def test_a_slow_stream_is_not_paused_between_its_poses(node):
    for k in range(12):
        node.now[0] += 4.0
        stamp_ns = round((100.0 + 4.0 * k) * 1e9)
        pose = pose_at(stamp_ns)
        node.inputs[0].accept(stamp_ns, lambda pose=pose: pose)
    assert node.inputs[0].silent_s(node.now[0]) == pytest.approx(0.0)
    assert not node.inputs[0].is_paused(node.now[0] + 12.0)
    assert node.inputs[0].is_paused(node.now[0] + 21.0)


def test_a_step_of_a_clock_is_named_and_a_gap_is_not(node, log_lines):
    run(node, 20.0)
    run(node, 3.0, senders=["parent"])
    run(node, 2.0)
    assert not [line for line in log_lines if "jump ahead" in line]
    assert (
        state_of(node).inputs["child"].text.endswith(" Hz, longest gap 3.1 s")
    )
    for _ in range(10):
        node.now[0] += 0.1
        stamp_ns = round((node.now[0] + 30.0) * 1e9)
        node.inputs[1].accept(
            stamp_ns, lambda stamp_ns=stamp_ns: pose_at(stamp_ns)
        )
    (line,) = [line for line in log_lines if "jump ahead" in line]
    assert line.startswith("/child_odom: the stamps jump ahead by 30.1")
    assert state_of(node).inputs["child"].text.endswith("longest gap 30 s")


def test_two_publishers_on_one_topic_are_a_warning_with_their_names(node):
    run(node, 20.0)
    with_result(node)
    node.inputs[1].publishers = ("/vio", "/bag")
    state = state_of(node)
    assert (state.inputs["child"].level, state.inputs["child"].publishers) == (
        Level.WARN,
        2,
    )
    assert state.inputs["child"].text.startswith(
        "/child_odom has 2 publishers: /bag and /vio. Stop all but one, then reset"
    )
    view = view_of(state)
    assert (view.word, view.tone) == ("CHECK INPUT", Tone.ACT)
    assert np.all(
        [
            line.tone is Tone.ACT
            for line in view.health
            if line.name == "child input"
        ]
    )


def test_poses_of_two_publishers_stay_a_warning_until_a_reset(node):
    run(node, 20.0)
    with_result(node)
    child = node.inputs[1]

    def receive(numbers):
        """Receive messages of two publishers; return the text of the input once one has ended."""
        child.publishers = ("/vio", "/bag")
        for number in numbers:
            child.count_mixed(number)
        child.publishers = ("/vio",)
        return state_of(node).inputs["child"].text

    # A publisher was started again, and the graph still contains the old one.
    assert receive((*range(300, 320), *range(20))) == "10.0 Hz"
    alternating = [number for k in range(20) for number in (320 + k, 20 + k)]
    assert receive(alternating) == (
        "/child_odom had 2 publishers: /bag and /vio. Their poses are mixed: reset"
    )
    child.restart()
    run(node, 1.0)
    assert state_of(node).inputs["child"].text == "10.0 Hz"


def test_numbers_that_fall_are_no_lost_messages(node):
    """A publisher is started again, or a second publisher is not discovered yet."""
    parent, child = node.inputs
    for number in (1, 2, 3, 1, 2, 3, 7):
        parent.count(number)
    for number in (600, 601, 1, 602, 2, 603, 3):
        child.count(number)
    lost = [source.state(node.now[0], False).lost for source in node.inputs]
    assert lost == [3, 0]
