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
    """A snapshot to solve, and perhaps its streams to check, in a session of this number, with
    options that an earlier check was certain of.
    """

    session: int
    snapshot: Snapshot
    check: bool = False
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Checked:
    """How a stream check ended: with neither findings nor a failure if the motion is too short or
    has too little rotation to tell. The result is one with the options that it is certain of, and
    warnings tell of that.
    """

    result: CheckResult | None = None
    failure: Failure | None = None
    options: dict[str, Any] = field(default_factory=dict)
    told: tuple[str, ...] = ()


@dataclass(frozen=True)
class Answer:
    """How a job ended, after how many seconds: with a calibration or with a failure; and how the
    sensors have been seen to move.
    """

    session: int
    seconds: float
    seen: Excitation | None = None
    calibration: Calibration | None = None
    time_offset: TimeOffset | None = None
    failure: Failure | None = None
    check: Checked | None = None


def answer(job: Job) -> Answer:
    """Solve, then check if the job asks for it. If the check is certain of other options, the
    calibration is the one with these.
    """
    start_s = time.monotonic()
    snapshot, seen, calibration, failure, checked = job.snapshot, None, None, None, None
    try:
        snapshot = with_options(snapshot, job.options).resolved()
        seen = excitation(snapshot.pose_pairs())
        calibration = snapshot.estimate()
    except Exception as error:  # the node reports it
        failure = _failure(error)
    if job.check:
        checked = Checked()
        try:
            if can_check(*job.snapshot.streams):
                as_sent = with_options(job.snapshot, job.options)
                if calibration is None:
                    checked = Checked(check(as_sent))
                else:
                    found = review(calibration, as_sent, job.options)
                    calibration = found.calibration if found.options else calibration
                    checked = Checked(found.check, options=dict(found.options), told=found.told)
        except Exception as error:  # the node reports it
            checked = Checked(failure=_failure(error))
    if calibration is not None:  # the node has no use for the noise model's whole solution
        calibration = replace(calibration, model=None)
    seconds = time.monotonic() - start_s
    return Answer(job.session, seconds, seen, calibration, snapshot.time_offset, failure, checked)


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
    # What a library prints goes to standard error instead of the pipes.
    incoming, outgoing = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(sys.stderr.fileno(), 1)
    jobs: queue.SimpleQueue[Job] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(incoming, jobs), daemon=True).start()
    while True:
        pickle.dump(answer(jobs.get()), outgoing, pickle.HIGHEST_PROTOCOL)
        outgoing.flush()


def _receive(incoming: BinaryIO, jobs: "queue.SimpleQueue[Job]") -> None:
    """Read jobs in a thread: the end of the node must be noticed during a long solve too."""
    try:
        while True:
            jobs.put(pickle.load(incoming))
    finally:
        os._exit(0)
