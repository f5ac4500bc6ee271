"""Keys that a person presses in watch."""

import queue
import time

import pytest
from node_states import ERROR, mount, state

from hand_eye_calib.online.ros.watch import Session
from hand_eye_calib.online.watch.board import Board


@pytest.fixture
def typed():
    """A session at a terminal: function that types keys and returns the view."""
    board = Board()
    requests = queue.SimpleQueue()
    keys = []
    board.take(state(), time.monotonic())
    session = Session(board, requests, lambda: keys.pop() if keys else "")

    def type_keys(text):
        keys.append(text)
        return session.view()

    type_keys.session = session
    type_keys.requests = requests
    type_keys.board = board
    return type_keys


def test_keys_ask_and_a_reset_takes_two(typed):
    typed("sx9w")
    assert [typed.requests.get(), typed.requests.get()] == ["solve", "save"]
    assert typed("r").answer[0].text == "forgets all poses: press r again"
    typed("ca")  # no mount has moved
    assert typed.requests.empty()
    typed("r")
    assert typed.requests.get() == "reset"
    typed.board.take(
        mount(**ERROR, text="moved", since_ns=10**18), time.monotonic()
    )
    typed("ca")
    typed("c")
    assert [typed.requests.get() for _ in range(2)] == [
        "acknowledge",
        "recalibrate",
    ]
    assert (typed.session.is_over, typed.session.shows_code) == (False, False)
    typed("p")
    assert typed.session.shows_code
    typed("q")
    assert typed.session.is_over
