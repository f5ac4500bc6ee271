"""The process that solves, without a node."""

import dataclasses
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from motions import as_trajectory, child_of, disturbed, feed, wandering_poses
from ros_harness import RELIABLE_INPUTS, drive

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.engine.pose_buffer import BufferLimits
from hand_eye_calib.engine.run import review
from hand_eye_calib.ros import solving_process
from hand_eye_calib.ros.solving import Checked, Failure, FailureKind, Job, Solved, answers
from hand_eye_calib.ros.solving_process import SolvingProcess

PATIENCE_S = 120.0

# A solver of the test's own: what it does is in the session's number.
SLOW = """
import time
from hand_eye_calib.ros import solving
def answers(job):
    time.sleep(3600.0)
solving.answers = answers
solving.main()
"""
BROKEN = "raise SystemExit(3)"
NOISY = """
import os
from hand_eye_calib.ros import solving
excitation = solving.excitation
def noisy(pose_pairs):
    print("a library that prints", flush=True)
    os.system("echo a program that prints")
    return excitation(pose_pairs)
solving.excitation = noisy
solving.main()
"""


def snapshot(**options):
    calibrator = Calibrator(CalibratorConfig(**{"reference": "B3", **options}))
    parent = wandering_poses(250)
    for stream, poses in (("parent", parent), ("child", child_of(parent))):
        feed(calibrator, stream, as_trajectory(poses))
    return calibrator.snapshot()


@pytest.fixture
def announced():
    return threading.Semaphore(0)


@pytest.fixture
def start(announced):
    running = []

    def made(*arguments):
        running.append(SolvingProcess(announced.release, *arguments))
        return running[-1]

    yield made
    for process in running:
        process.stop(timeout_s=0.0)


def wait_for(process, count):
    """So many answers."""
    end, found = time.monotonic() + PATIENCE_S, []
    while len(found) < count:
        assert time.monotonic() < end, f"waited {PATIENCE_S} s for {count} answers, got {found}"
        found += process.answers()
        time.sleep(0.01)
    return found


def wait_gone(pid):
    end = time.monotonic() + PATIENCE_S
    while Path(f"/proc/{pid}").exists() and "(zombie)" not in status(pid):
        assert time.monotonic() < end, f"process {pid} goes on"
        time.sleep(0.01)


def status(pid):
    try:
        return Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    except FileNotFoundError:
        return "(zombie)"


def same(first, second):
    """Whether two results are equal to the last bit."""
    return all(
        np.array_equal(getattr(first, name), getattr(second, name), equal_nan=True)
        for name in ("T_parent_child", "covariance", "objective", "sigmas")
    )


@pytest.mark.parametrize(
    "options", [{}, {"method": "adaptive"}, {"method": "dnlo", "backend": "ipopt"}]
)
def test_gives_the_same_bits_as_here(start, announced, options):
    process, work = start(), snapshot(**options)
    process.submit(Job(5, work, check=True))
    solved, checked = wait_for(process, 2)
    here, check_here = answers(Job(5, snapshot(**options), check=True))
    assert (solved.session, checked.session) == (5, 5)
    assert same(solved.calibration, here.calibration)
    assert checked.result.findings == check_here.result.findings
    assert solved.seen.n_poses == here.seen.n_poses == 250
    assert announced.acquire(timeout=PATIENCE_S)


def test_an_estimated_time_offset_comes_back_for_the_engine(start):
    process, work = start(), snapshot(time_offset="estimate")
    process.submit(Job(0, work))
    (solved,) = wait_for(process, 1)
    assert solved.time_offset.seconds == work.resolved().time_offset.seconds


def test_answers_come_in_order_with_their_sessions(start):
    process = start()
    for session in range(5):
        process.submit(Job(session, snapshot()))
    assert [answer.session for answer in wait_for(process, 5)] == [0, 1, 2, 3, 4]


def test_what_is_missing_and_defects_are_told_apart():
    (missing,) = answers(Job(0, Calibrator().snapshot()))
    assert missing.failure.kind is FailureKind.NOT_ENOUGH_DATA
    assert "no poses on the parent stream" in missing.failure.what
    (unusable,) = answers(Job(0, snapshot(parent_frame="one", child_frame="one")))
    assert unusable.failure.kind is FailureKind.UNUSABLE
    (defect,) = answers(Job(0, dataclasses.replace(snapshot(), config=None)))
    assert defect.failure.kind is FailureKind.UNEXPECTED
    assert "AttributeError" in defect.failure.what
    assert "Traceback" in defect.failure.details


def test_streams_that_tell_too_little_are_not_checked():
    calibrator = Calibrator(CalibratorConfig(reference="B3"))
    for stream in ("parent", "child"):
        feed(calibrator, stream, as_trajectory(wandering_poses(50)))
    _, checked = answers(Job(0, calibrator.snapshot(), check=True))
    assert (checked.result, checked.failure) == (None, None)


def test_killed_it_is_started_again_says_so_and_the_job_in_hand_is_answered(start):
    process = start()
    for kill in range(3):
        old = process.pid
        process.submit(Job(kill, snapshot()))
        os.kill(old, signal.SIGKILL)
        (solved,) = wait_for(process, 1)
        assert (solved.session, solved.failure) == (kill, None)
        assert process.pid != old
    note = "the solving process was ended by SIGKILL; it was started again"
    assert list(process.notes()) == [note] * 3


def test_one_that_cannot_run_is_a_failure_and_not_for_ever(start):
    process = start(BROKEN)
    process.submit(Job(0, snapshot(), check=True))
    failure = Failure(FailureKind.UNEXPECTED, "the solving process ended with code 3")
    assert wait_for(process, 2) == [
        Solved(0, 0.0, failure=failure),
        Checked(0, 0.0, failure=failure),
    ]


def test_one_that_hangs_is_killed_started_again_and_the_job_has_failed(start, monkeypatch):
    monkeypatch.setattr(solving_process, "HANGS_AFTER_S", 0.5)
    process = start(SLOW)
    old = process.pid
    process.submit(Job(7, snapshot(), check=True))
    what = "the solving process had no answer after 0.5 s and was killed"
    failure = Failure(FailureKind.UNEXPECTED, what)
    assert wait_for(process, 2) == [
        Solved(7, 0.0, failure=failure),
        Checked(7, 0.0, failure=failure),
    ]
    assert list(process.notes()) == [f"{what}; it was started again"]
    assert process.pid != old
    wait_gone(old)


def test_a_node_whose_solving_process_hangs_says_so_and_goes_on(start_node, peer):
    node = start_node(
        "-p solve_period:=1000.0",
        *RELIABLE_INPUTS,
        before="from hand_eye_calib.ros import solving_process as s; s.HANGS_AFTER_S = 5.0",
    )
    assert peer.trigger("reset").success
    pid = node.process.pid
    os.kill(int(Path(f"/proc/{pid}/task/{pid}/children").read_text()), signal.SIGSTOP)
    answer = peer.trigger("solve")
    what = "the solving process had no answer after 5 s and was killed"
    assert (answer.success, what in answer.message) == (False, True)
    node.wait_for_log(f"{what}; it was started again")
    answer, _ = peer.solve(peer.publishers(), *drive())
    assert answer.success


def test_what_libraries_print_does_not_disturb(start):
    process = start(NOISY)
    process.submit(Job(0, snapshot()))
    (solved,) = wait_for(process, 1)
    assert solved.failure is None


def test_stop_does_not_wait_for_a_long_solve(start, announced):
    for wait_s in (0.0, 0.2, 1.0):  # while it starts, reads, solves
        process = start(SLOW)
        process.submit(Job(0, snapshot()))
        time.sleep(wait_s)
        assert not process.stop(timeout_s=0.1)
        wait_gone(process.pid)
        assert not list(process.answers())


def test_it_waits_without_using_the_processor(start):
    process = start()
    process.submit(Job(0, snapshot()))
    wait_for(process, 1)
    before = cpu_ticks(process.pid)
    time.sleep(2.0)
    assert cpu_ticks(process.pid) - before < 20  # of 200; the first few clean up after the job


def cpu_ticks(pid):
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


@pytest.mark.parametrize("command", ["idle", "busy"])
def test_it_ends_with_the_node_however_that_ends(tmp_path, command):
    """In a program that is killed: nothing there can clean up."""
    program = f"""
import time
from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.engine.pose_buffer import BufferLimits
from hand_eye_calib.ros.solving import Job
from hand_eye_calib.ros.solving_process import SolvingProcess
process = SolvingProcess(lambda: None, {SLOW!r})
if {command == "busy"}:
    process.submit(Job(0, Calibrator().snapshot()))
time.sleep(1.0)
print(process.pid, flush=True)
time.sleep(3600.0)
"""
    node = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    pid = int(node.stdout.readline())
    node.kill()
    node.wait()
    node.stdout.close()
    wait_gone(pid)


def test_it_imports_neither_ros_nor_plots_nor_bags():
    program = "import sys, hand_eye_calib.ros.solving; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    unwanted = {"rclpy", "matplotlib", "rosbags", "casadi", "jinja2", "yaml", "rich"}
    assert not unwanted & set(done.stdout.split())


@pytest.mark.parametrize("pairing_starts", [2000, 100])
def test_what_a_check_is_certain_of_is_solved_with_as_in_a_replay(pairing_starts):
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
    solved, check = answers(Job(1, live, check=True))
    assert solved.calibration.time_offset_s == 0.0
    assert check.options == {"time_offset": "estimate"}
    assert "solved with time_offset estimate" in check.told[0]
    again, settled = answers(Job(1, live, check=True, options=check.options))
    replayed = review(live.estimate(), live).calibration
    assert again.calibration.time_offset_s == pytest.approx(0.3, abs=0.01)
    np.testing.assert_array_equal(again.calibration.T_parent_child, replayed.T_parent_child)
    np.testing.assert_array_equal(again.calibration.covariance, replayed.covariance)
    assert (settled.options, settled.told) == ({}, ())
    assert "time_offset" not in {finding.code for finding in settled.result.findings}
