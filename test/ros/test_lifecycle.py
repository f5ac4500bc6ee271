"""The node as a managed node: real transitions by the services of its life cycle."""

import time

from geometry_msgs.msg import TransformStamped
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from ros_harness import RELIABLE_INPUTS, drive
from std_msgs.msg import String
from std_srvs.srv import Trigger

from hand_eye_calib.online.watch.board import state_of


def change(peer, transition):
    request = ChangeState.Request(transition=Transition(id=transition))
    return peer.call(ChangeState, "change_state", request).success


def label(peer):
    return peer.call(GetState, "get_state").current_state.label


def service_names(peer):
    return {name for name, _ in peer.node.get_service_names_and_types()}


def test_a_managed_node_calibrates_between_activate_and_deactivate(
    start_node, peer, tmp_path
):
    node = start_node(
        "-p lifecycle:=true", "-p output_directory:=live", *RELIABLE_INPUTS
    )
    assert label(peer) == "unconfigured"
    assert "/calibrator/solve" not in service_names(peer)

    assert change(peer, Transition.TRANSITION_CONFIGURE)
    assert label(peer) == "inactive"
    states = peer.listen(String, "progress")
    peer.spin_until(lambda: states, "the state of the node")
    assert "poses are not accepted" in state_of(states[-1].data).extrinsic.text
    assert not peer.set_enabled(True).success

    assert change(peer, Transition.TRANSITION_ACTIVATE)
    assert label(peer) == "active"
    stamps_ns, Ts_pw_p, Ts_cw_c = drive()
    publishers = peer.publishers()
    answer, _ = peer.solve(publishers, stamps_ns, Ts_pw_p, Ts_cw_c)
    assert answer.success

    assert change(peer, Transition.TRANSITION_DEACTIVATE)
    assert label(peer) == "inactive"
    results = peer.listen(TransformStamped, "extrinsic")
    peer.spin_until(lambda: results, "the result, which stays published")

    assert change(peer, Transition.TRANSITION_CLEANUP)
    assert label(peer) == "unconfigured"
    assert (tmp_path / "live" / "extrinsic.yaml").exists()
    peer.wait_left(*publishers)
    code, _ = node.stop()
    assert code == 0


def test_a_managed_node_starts_a_new_session_after_a_cleanup(start_node, peer):
    start_node("-p lifecycle:=true", *RELIABLE_INPUTS)
    publishers = peer.publishers()
    for number in range(2):
        assert change(peer, Transition.TRANSITION_CONFIGURE)
        assert change(peer, Transition.TRANSITION_ACTIVATE)
        peer.wait_matched(*publishers)
        start_ns = 1_700_000_000_000_000_000 + number * 100_000_000_000
        answer, _ = peer.solve(publishers, *drive(start_ns=start_ns))
        assert answer.success
        assert " 120 poses" in answer.message
        assert change(peer, Transition.TRANSITION_DEACTIVATE)
        assert change(peer, Transition.TRANSITION_CLEANUP)
        peer.wait_left(*publishers)


def test_an_option_that_cannot_be_applied_leaves_the_node_unconfigured(
    start_node, peer
):
    node = start_node(
        "-p lifecycle:=true", "-p installed:=nowhere.urdf", *RELIABLE_INPUTS
    )
    assert not change(peer, Transition.TRANSITION_CONFIGURE)
    assert label(peer) == "unconfigured"
    node.wait_for_log("the node is not configured: ")
    assert "/calibrator/solve" not in service_names(peer)


def managed(peer, transition, wanted):
    """Change the state as nav2_lifecycle_manager does: request, then compare the state."""
    assert change(peer, transition), wanted
    assert label(peer) == wanted


def test_nav2_lifecycle_manager_starts_pauses_resumes_resets_and_shuts_down(
    start_node, peer
):
    # The requests of nav2_lifecycle_manager with bond_timeout 0, in its order, for one node.
    node = start_node("-p lifecycle:=true", *RELIABLE_INPUTS)

    def start_up():
        managed(peer, Transition.TRANSITION_CONFIGURE, "inactive")
        managed(peer, Transition.TRANSITION_ACTIVATE, "active")

    def reset():
        managed(peer, Transition.TRANSITION_DEACTIVATE, "inactive")
        managed(peer, Transition.TRANSITION_CLEANUP, "unconfigured")

    start_up()
    managed(peer, Transition.TRANSITION_DEACTIVATE, "inactive")  # pause
    managed(peer, Transition.TRANSITION_ACTIVATE, "active")  # resume
    publishers = peer.publishers()
    peer.wait_matched(*publishers)
    answer, _ = peer.solve(publishers, *drive())
    assert answer.success
    reset()
    peer.wait_left(*publishers)
    start_up()
    peer.wait_matched(*publishers)
    assert not change(peer, Transition.TRANSITION_ACTIVATE)
    assert "transition 3 is refused: the node is active" in node.log
    assert label(peer) == "active"
    reset()  # the shutdown begins like a reset
    managed(peer, Transition.TRANSITION_UNCONFIGURED_SHUTDOWN, "finalized")
    code, seconds = node.stop()
    assert (code, seconds < 2.0) == (0, True)


def test_a_shutdown_ends_the_session_from_any_state(start_node, peer):
    node = start_node("-p lifecycle:=true", *RELIABLE_INPUTS)
    assert change(peer, Transition.TRANSITION_CONFIGURE)
    assert change(peer, Transition.TRANSITION_ACTIVATE)
    assert peer.call(Trigger, "reset").success
    assert change(peer, Transition.TRANSITION_ACTIVE_SHUTDOWN)
    state = peer.call(GetState, "get_state").current_state
    assert state.id == State.PRIMARY_STATE_FINALIZED
    time.sleep(0.1)
    code, seconds = node.stop()
    assert (code, seconds < 2.0) == (0, True)


def test_the_plain_node_has_no_life_cycle(start_node, peer):
    start_node(*RELIABLE_INPUTS)
    assert peer.call(Trigger, "reset").success
    assert "/calibrator/change_state" not in service_names(peer)
