"""The thread that solves, without a node."""

import threading

import numpy as np
import pytest
from motions import as_trajectory, child_of, feed, wandering_poses

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.ros.worker import SolverProcess, SolveWorker


class Work:
    """Stands where a snapshot of the engine does: runs a function."""

    def __init__(self, estimate, check=None, n_poses=250):
        self.estimate = estimate
        self.check = check
        self.streams = [as_trajectory(wandering_poses(n_poses))] * 2
        self.pose_pairs = PosePairs.empty
        self.config = CalibratorConfig()


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
    for _ in range(3):
        assert announced.acquire(timeout=30.0)
    for session, outcome in enumerate(worker.ready()):
        assert (outcome.session, outcome.calibration, outcome.error) == (
            session,
            f"result {session}",
            None,
        )


def test_any_exception_is_an_outcome_and_the_next_solve_runs(worker, announced):
    def fail():
        raise ZeroDivisionError("deep inside")

    worker.submit(0, Work(fail))
    worker.submit(1, Work(lambda: "fine"))
    assert announced.acquire(timeout=30.0)
    assert announced.acquire(timeout=30.0)
    failed, fine = worker.ready()
    assert isinstance(failed.error, ZeroDivisionError)
    assert failed.error.__traceback__ is not None
    assert fine.calibration == "fine"


@pytest.mark.parametrize(("n_poses", "agreement"), [(250, "checked after result"), (50, None)])
def test_streams_are_checked_after_the_solve_where_asked_and_where_they_suffice(
    worker, announced, n_poses, agreement
):
    work = Work(lambda: "result", lambda calibration: f"checked after {calibration}", n_poses)
    worker.submit(7, work)
    worker.submit(8, work, check=True)
    for _ in range(3):
        assert announced.acquire(timeout=30.0)
    *outcomes, checked = worker.ready()
    assert [outcome.calibration for outcome in outcomes] == ["result", "result"]
    assert (checked.session, checked.agreement, checked.error) == (8, agreement, None)


def test_a_check_that_fails_says_why(worker, announced):
    worker.submit(0, Work(lambda: "result", lambda calibration: 1 / 0), check=True)
    for _ in range(2):
        assert announced.acquire(timeout=30.0)
    assert isinstance(list(worker.ready())[-1].error, ZeroDivisionError)


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


class TestSolverProcess:
    """What the ipopt backend runs in."""

    @pytest.fixture
    def apart(self):
        made = SolverProcess()
        yield made
        made.stop()

    @staticmethod
    def snapshot():
        calibrator = Calibrator(CalibratorConfig(backend="ipopt", reference="B3"))
        for stream, poses in (
            ("parent", wandering_poses(60)),
            ("child", child_of(wandering_poses(60))),
        ):
            feed(calibrator, stream, as_trajectory(poses))
        return calibrator.snapshot()

    def test_gives_the_same_answer(self, apart):
        snapshot = self.snapshot()
        for _ in range(2):
            assert np.array_equal(
                apart.estimate(snapshot).T_parent_child, snapshot.estimate().T_parent_child
            )

    def test_raises_what_was_raised_there(self, apart):
        with pytest.raises(NotEnoughDataError, match="no poses on the parent stream"):
            apart.estimate(Calibrator(CalibratorConfig(backend="ipopt")).snapshot())

    def test_that_died_is_said_and_started_anew(self, apart):
        snapshot = self.snapshot()
        apart.estimate(snapshot)
        apart.stop()
        assert apart.estimate(snapshot).n_poses == 60
