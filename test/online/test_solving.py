"""The process that solves, without a node."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from findings import codes_of
from motions import as_trajectory, child_of, disturbed, feed, wandering_poses
from numpy.testing import assert_array_equal

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.engine.calibrator import BufferLimits, Calibrator
from hand_eye_calib.core.engine.run import review
from hand_eye_calib.online.live import solving
from hand_eye_calib.online.live.solving import (
    Answer,
    Failure,
    Job,
    SolvingProcess,
    answer,
)

PATIENCE_S = 120.0

# Solvers of the test's own.
SLOW = """
import time
from hand_eye_calib.online.live import solving
solving.answer = lambda job: time.sleep(3600.0)
solving.main()
"""
NOISY = """
import os
from hand_eye_calib.online.live import solving
excitation = solving.excitation
def noisy(pose_pairs):
    print("a library that prints", flush=True)
    os.system("echo a program that prints")
    return excitation(pose_pairs)
solving.excitation = noisy
solving.main()
"""

PRIORITY = """
import os
from hand_eye_calib.online.live import solving
def priority(job):
    return solving.Answer(job.session, os.getpriority(os.PRIO_PROCESS, 0))
solving.answer = priority
solving.main()
"""


def poses(**options):
    calibrator = Calibrator(CalibratorConfig(**{"reference": "B3", **options}))
    parent = wandering_poses(250)
    for stream, poses in (("parent", parent), ("child", child_of(parent))):
        feed(calibrator, stream, as_trajectory(poses))
    return calibrator


class Started(SolvingProcess):
    """A process whose answers can be waited for."""

    def __init__(self, *command):
        self.announced = threading.Semaphore(0)
        super().__init__(self.announced.release, *command)

    def next(self):
        assert self.announced.acquire(timeout=PATIENCE_S)
        (result,) = self.answers()
        return result


@pytest.fixture
def start():
    running = []

    def made(*command):
        running.append(Started(*command))
        return running[-1]

    yield made
    for process in running:
        process.stop(timeout_s=0.0)


def status(pid):
    try:
        return Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    except FileNotFoundError:
        return "(zombie)"


def wait_gone(pid):
    end = time.monotonic() + PATIENCE_S
    while "(zombie)" not in status(pid):
        assert time.monotonic() < end, f"process {pid} goes on"
        time.sleep(0.01)


OPTIONS = [{}, {"method": "adaptive", "time_offset": "estimate"}]
OPTIONS.append({"method": "dnlo", "backend": "ipopt"})


def test_gives_the_same_bits_as_here_job_after_job(start):
    process = start()
    for session, options in enumerate(OPTIONS, start=5):
        work = poses(**options)
        process.submit(Job(session, work, check=True))
        remote = process.next()
        here = answer(Job(session, poses(**options), check=True))
        assert remote.session == session
        for name in ("T_parent_child", "covariance", "objective", "sigmas"):
            values = [
                getattr(result.calibration, name) for result in (remote, here)
            ]
            assert_array_equal(*values, err_msg=f"{name} with {options}")
        assert remote.check.findings == here.check.findings
        assert remote.motion.n_poses == here.motion.n_poses == 250
        assert (remote.time_offset is None) == ("time_offset" not in options)
        if remote.time_offset is not None:
            assert (
                remote.time_offset.seconds
                == work.snapshot().resolved.time_offset.seconds
            )


def test_only_a_job_in_a_hurry_has_the_priority_of_the_node(start):
    of_node = os.getpriority(os.PRIO_PROCESS, 0)
    lower = min(of_node + 3, 19)
    process = start(PRIORITY)
    for has_hurry, priority in (
        (False, lower),
        (True, of_node),
        (False, lower),
    ):
        process.submit(Job(0, poses(), has_hurry=has_hurry))
        assert process.next().seconds == priority


def test_libraries_that_print_do_not_disturb_the_answers(start):
    process = start(NOISY)
    for session in range(2):
        process.submit(Job(session, poses()))
        assert process.next().session == session


def test_what_is_missing_and_defects_are_told_apart():
    missing = answer(Job(0, Calibrator(), check=True))
    assert "no poses on the parent stream" in missing.failure.what
    assert (missing.failure.is_early, missing.failure.details) == (True, "")
    assert (missing.is_checked, missing.check) == (
        True,
        None,
    )  # these tell too little
    unusable = answer(
        Job(0, poses(parent_frame="one", child_frame="one"))
    ).failure
    assert (unusable.is_early, unusable.details) == (False, "")
    broken = poses()
    broken.config = None
    defect = answer(Job(0, broken)).failure
    assert "AttributeError" in defect.what
    assert "Traceback" in defect.details


def test_killed_it_is_started_again_and_the_job_in_hand_has_failed(start):
    process = start(SLOW)
    for kill in range(2):
        old = process._process.pid
        process.submit(Job(kill, poses()))
        os.kill(old, signal.SIGKILL)
        failure = Failure(
            "the solving process was ended by SIGKILL", "it was started again"
        )
        assert process.next() == Answer(kill, 0.0, failure=failure)
        assert process._process.pid != old


def test_one_that_hangs_is_killed_started_again_and_the_job_has_failed(
    start, monkeypatch
):
    monkeypatch.setattr(solving, "HANGS_AFTER_S", 0.5)
    process = start(SLOW)
    old = process._process.pid
    process.submit(Job(7, poses(), check=True))
    text = "the solving process had no answer after 0.5 s and was killed"
    assert process.next() == Answer(
        7, 0.0, failure=Failure(text, "it was started again")
    )
    assert process._process.pid != old
    wait_gone(old)


def test_stop_does_not_wait_for_a_long_solve(start):
    for wait_s in (0.0, 0.2, 1.0):  # while it starts, reads, solves
        process = start(SLOW)
        process.submit(Job(0, poses()))
        time.sleep(wait_s)
        process.stop(timeout_s=0.1)
        wait_gone(process._process.pid)
        assert not list(process.answers())


@pytest.mark.parametrize("command", ["idle", "busy"])
def test_it_ends_with_the_node_however_that_ends(command):
    """In a program that is killed: nothing there can clean up."""
    program = f"""
import time
from hand_eye_calib.core.engine.calibrator import Calibrator
from hand_eye_calib.online.live.solving import Job, SolvingProcess
process = SolvingProcess(lambda: None, {SLOW!r})
if {command == "busy"}:
    process.submit(Job(0, Calibrator()))
print(process._process.pid, flush=True)
time.sleep(3600.0)
"""
    node = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True
    )
    pid = int(node.stdout.readline())
    node.kill()
    node.wait()
    node.stdout.close()
    wait_gone(pid)


@pytest.mark.parametrize("pairing_starts", [2000, 100])
def test_what_a_check_is_certain_of_is_solved_with_as_in_a_replay(
    pairing_starts,
):
    limits = BufferLimits(pairing_starts=pairing_starts, batch=64)
    calibrator = Calibrator(CalibratorConfig(reference="B3"), limits)
    parent = wandering_poses(400)
    child = disturbed(child_of(parent), 1, 0.001, 0.001)
    # Turn by turn, as live: the oldest are made into pairs on the way.
    streams = as_trajectory(parent), as_trajectory(child).shifted(-0.3)
    for start in range(0, 400, 50):
        for stream, poses in zip(("parent", "child"), streams, strict=True):
            feed(calibrator, stream, poses[start : start + 50])
    live = calibrator.snapshot()
    assert (len(live.kept) > 0) == (pairing_starts < 400)
    replayed = review(live.estimate(), live).calibration
    first = answer(Job(1, calibrator, check=True))
    assert first.options == {"time_offset": "estimate"}
    # A session keeps the message, whereas later results have another offset.
    assert first.messages[0].startswith(
        "the clocks may differ: solved with time_offset estimate; "
    )
    assert first.messages[0] in first.calibration.warnings
    assert "behind the parent" not in " ".join(first.calibration.warnings)
    again = answer(Job(1, calibrator, check=True, options=first.options))
    assert again.calibration.time_offset_s == pytest.approx(0.3, abs=0.01)
    for result in (first, again):
        assert_array_equal(
            result.calibration.T_parent_child, replayed.T_parent_child
        )
        assert_array_equal(result.calibration.covariance, replayed.covariance)
    assert (again.options, again.messages) == ({}, ())
    assert "time_offset" not in codes_of(again.check.findings)
