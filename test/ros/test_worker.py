"""The thread that solves, without a node."""

import threading

import pytest

from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.ros.worker import SolveWorker


class Work:
    """Stands where a snapshot of the engine does: runs a function."""

    def __init__(self, estimate):
        self.estimate = estimate
        self.pose_pairs = PosePairs.empty


@pytest.fixture
def announced():
    return threading.Semaphore(0)


@pytest.fixture
def worker(announced):
    made = SolveWorker(announced.release)
    yield made
    assert made.stop(timeout_s=30.0)


def test_outcomes_come_in_order_with_their_sessions(worker, announced):
    for session in range(3):
        worker.submit(session, Work(lambda session=session: f"result {session}"))
    for session in range(3):
        assert announced.acquire(timeout=30.0)
        outcome = worker.take()
        assert (outcome.session, outcome.calibration, outcome.error) == (session, f"result {session}", None)


def test_any_exception_is_an_outcome_and_the_next_solve_runs(worker, announced):
    def fail():
        raise ZeroDivisionError("deep inside")

    worker.submit(0, Work(fail))
    worker.submit(1, Work(lambda: "fine"))
    assert announced.acquire(timeout=30.0)
    failed = worker.take()
    assert isinstance(failed.error, ZeroDivisionError)
    assert failed.error.__traceback__ is not None
    assert announced.acquire(timeout=30.0)
    assert worker.take().calibration == "fine"


def test_stop_does_not_wait_for_a_long_solve_and_silences_it(announced):
    release = threading.Event()
    started = threading.Event()
    worker = SolveWorker(announced.release)
    worker.submit(0, Work(lambda: (started.set(), release.wait())))
    assert started.wait(30.0)
    assert not worker.stop(timeout_s=0.01)
    release.set()
    assert worker.stop(timeout_s=30.0)
    assert not announced.acquire(blocking=False)
