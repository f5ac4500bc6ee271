"""The process that solves: reads jobs from standard input, writes answers to standard output.

It imports the engine and nothing of ROS. Messages are pickles: both ends are the same program, and
nobody else has the pipes.
"""

import os
import pickle
import queue
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from typing import Any, BinaryIO

from hand_eye_calib.alignment.time_offset import TimeOffset
from hand_eye_calib.assessment.excitation import Excitation, excitation
from hand_eye_calib.checks.check import CheckResult, can_check
from hand_eye_calib.engine.checking import check
from hand_eye_calib.engine.run import review, with_options
from hand_eye_calib.engine.snapshot import Snapshot
from hand_eye_calib.errors import HandEyeCalibError, NotEnoughDataError
from hand_eye_calib.results.calibration import Calibration

# Every other program goes first, the node's callbacks above all.
_NICENESS = 10


class FailureKind(Enum):
    """Why there is no result: too little data, unusable input or options, or a defect."""

    NOT_ENOUGH_DATA = auto()
    UNUSABLE = auto()
    UNEXPECTED = auto()


@dataclass(frozen=True)
class Failure:
    """An error as text: ``what`` in one line, ``details`` for the log."""

    kind: FailureKind
    what: str
    details: str = ""


@dataclass(frozen=True)
class Job:
    """A snapshot to solve. The answers carry the number of its session.

    Attributes
    ----------
    session : int
    snapshot : Snapshot
    check : bool
        Check its streams as well.
    options : dict
        Options that an earlier check was certain of.
    """

    session: int
    snapshot: Snapshot
    check: bool = False
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Solved:
    """How a solve ended, after how many seconds: with a calibration or with a failure.

    Attributes
    ----------
    seen : Excitation or None
        How the sensors have moved.
    time_offset : TimeOffset or None
        The time offset, if it was estimated.
    """

    session: int
    seconds: float
    seen: Excitation | None = None
    calibration: Calibration | None = None
    time_offset: TimeOffset | None = None
    failure: Failure | None = None


@dataclass(frozen=True)
class Checked:
    """How a stream check ended, after how many seconds: with neither findings nor a failure if the
    motion is too short or has too little rotation to tell.

    Attributes
    ----------
    options : dict
        Options that the check is certain of: the result is of streams that were solved with them.
    told : tuple of str
        Warnings about that.
    """

    session: int
    seconds: float
    result: CheckResult | None = None
    failure: Failure | None = None
    options: dict[str, Any] = field(default_factory=dict)
    told: tuple[str, ...] = ()


Answer = Solved | Checked


def answers(job: Job) -> Iterator[Answer]:
    """Solve, then check if the job asks for it."""
    solved = _solve(job)
    found = solved.calibration
    # The node has no use for the noise model's whole solution.
    yield replace(solved, calibration=replace(found, model=None) if found else None)
    if job.check:
        yield _check(job, found)


def _solve(job: Job) -> Solved:
    start, snapshot = time.monotonic(), job.snapshot
    seen = calibration = failure = None
    try:
        snapshot = with_options(snapshot, job.options).resolved()
        seen = excitation(snapshot.pose_pairs())
        calibration = snapshot.estimate()
    except Exception as error:  # the node reports it
        failure = _failure(error)
    seconds = time.monotonic() - start
    return Solved(job.session, seconds, seen, calibration, snapshot.time_offset, failure=failure)


def _check(job: Job, calibration: Calibration | None) -> Checked:
    """Check the streams with the time offset and the scale that the solve found; if that makes
    certain of another one, as it is after solving with that.
    """
    start = time.monotonic()
    try:
        if not can_check(*job.snapshot.streams):
            return Checked(job.session, time.monotonic() - start)
        snapshot = with_options(job.snapshot, job.options)
        if calibration is None:
            return Checked(job.session, time.monotonic() - start, check(snapshot))
        found = review(calibration, snapshot, job.options)
    except Exception as error:  # the node reports it
        return Checked(job.session, time.monotonic() - start, failure=_failure(error))
    seconds = time.monotonic() - start
    return Checked(job.session, seconds, found.check, options=dict(found.options), told=found.told)


def _failure(error: Exception) -> Failure:
    if isinstance(error, NotEnoughDataError):
        return Failure(FailureKind.NOT_ENOUGH_DATA, str(error))
    if isinstance(error, HandEyeCalibError):
        return Failure(FailureKind.UNUSABLE, str(error))
    details = "".join(traceback.format_exception(error))
    return Failure(FailureKind.UNEXPECTED, f"{type(error).__name__}: {error}", details)


def main() -> None:
    """Answer jobs until the standard input ends, which it does with the node, however that ends."""
    os.nice(_NICENESS)
    incoming, outgoing = _private_pipes()
    jobs: queue.SimpleQueue[Job] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(incoming, jobs), daemon=True).start()
    while True:
        for answer in answers(jobs.get()):
            pickle.dump(answer, outgoing, pickle.HIGHEST_PROTOCOL)
            outgoing.flush()


def _private_pipes() -> tuple[BinaryIO, BinaryIO]:
    """The pipes to the node; what a library prints goes to standard error instead."""
    incoming, outgoing = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(sys.stderr.fileno(), 1)
    return incoming, outgoing


def _receive(incoming: BinaryIO, jobs: "queue.SimpleQueue[Job]") -> None:
    """Read jobs in a thread: the end of the node must be noticed during a long solve too."""
    try:
        while True:
            jobs.put(pickle.load(incoming))
    finally:
        os._exit(0)
