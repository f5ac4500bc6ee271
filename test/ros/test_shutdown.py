"""However it is told to end, the node ends soon, with code 0 and without a traceback."""

import signal

import pytest
from ros_harness import RELIABLE_INPUTS, drive

# Generous: the promise is one second, and the machine may be busy.
SOON_S = 5.0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    "solve_period", [0.1, 1000.0]
)  # busy, and waiting for nothing but messages
def test_signal_ends_the_node_cleanly(start_node, peer, number, solve_period):
    node = start_node(f"-p solve_period:={solve_period}")
    peer.feed(peer.publishers(), *drive())
    assert peer.trigger("solve").message
    code, seconds = node.stop(number)
    assert (code, "Traceback" in node.log) == (0, False), node.log
    assert seconds < SOON_S


def test_second_ctrl_c_changes_nothing(start_node):
    node = start_node()
    node.wait_for_log("no pose yet on /parent_odom")
    code, _ = node.stop(signal.SIGINT, signal.SIGINT, signal.SIGTERM, signal.SIGINT)
    assert (code, "Traceback" in node.log) == (0, False), node.log


def test_signal_ends_the_node_while_it_solves(start_node, peer):
    node = start_node(
        "-p solve_period:=0.05", "-p backend:=ipopt", "-p reference:=B1", *RELIABLE_INPUTS
    )
    peer.feed(peer.publishers(), *drive(1500, period_ns=20_000_000))
    node.wait_for_log("first pose on /child_odom")
    code, seconds = node.stop(signal.SIGTERM)
    assert (code, "Traceback" in node.log) == (0, False), node.log
    assert seconds < SOON_S
