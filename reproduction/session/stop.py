"""Is a session that is told to stop really good enough, and how much sooner might it have stopped?

Every recording is cut off after ever longer times; each part is calibrated, and the goal judges the
results in turn, as in the node. Where it says "done", the error against the truth is known.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.assessment.excitation import Excitation, excitation
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import HandEyeCalibError
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.offline.calibrate import prior_fields
from hand_eye_calib.online.live.goal import Goal
from reproduction.coverage.classes import CLASSES, simulate
from reproduction.recordings import Recording, Rig, Truth
from reproduction.writing import markdown_table

# Class, and duration (s): five kinds of motion with two kinds of errors each.
KINDS = {
    "hand-held": {"hand_gm_1s": 150.0, "hand_vio_walk": 150.0},
    "car": {"car_ins_lidar": 360.0, "car_two_slams": 360.0},
    "AGV": {"agv_ramps": 360.0, "agv_long": 1200.0},
    "drone": {"drone_gnss_vio": 180.0, "drone_two_vios": 180.0},
    "arm": {"arm_target": 180.0},
}
TARGET = np.r_[np.full(3, 0.02), np.full(3, 0.00524)]
FACTORS = (0.5, 1.0, 2.0)
_STEPS = 24


class Recorded(NamedTuple):
    """A recording with a known answer, and what a user would give."""

    name: str
    kind: str
    recording: Recording
    truth: Truth
    options: Mapping[str, Any]


class Step(NamedTuple):
    """A part of a recording: its end (s), the error (6,) along and about the parent's axes, and
    what the session is told.
    """

    end_s: float
    error: FloatArray
    calibration: Calibration
    seen: Excitation


@dataclass(frozen=True)
class Stop:
    """How the session of a recording ended with a target."""

    kind: str
    # Of the default targets.
    factor: float
    # Whether it was told that this motion will not get there, and was right.
    is_stuck: bool
    is_done: bool = False
    # If it was told to stop: the largest error over its target, what the truth itself is unsure of
    # taken off; when that was, and from when on, until then, all errors were within their targets.
    worst: float = np.nan
    seconds: float = np.nan
    earliest_s: float = np.nan


def simulated(seeds: int) -> Iterator[Recorded]:
    """So many recordings of each class; twice as many of a kind that has one class."""
    for kind, classes in KINDS.items():
        for name, duration_s in classes.items():
            for seed in range(seeds * 2 // len(classes)):
                key = (7, seed, sorted(CLASSES).index(name))
                made = simulate(dataclasses.replace(CLASSES[name], duration_s=duration_s), key)
                truth = Truth.within(made.T_parent_child, 0.0, 0.0)
                yield Recorded(
                    f"{name} {seed}", kind, Recording(made.parent, made.child), truth, {}
                )


def real(rigs: Sequence[Rig]) -> Iterator[Recorded]:
    """The recordings of rigs whose answer is known."""
    for rig in rigs:
        if rig.truth is not None:
            for name, recording in rig.recordings.items():
                yield Recorded(f"{rig.name} {name}", rig.name, recording, rig.truth, rig.options)


def stops(recorded: Recorded) -> list[dict[str, Any]]:
    """Plain values of a :class:`Stop` for every factor of the target."""
    steps = list(_steps(recorded))
    return [vars(_stopped(recorded, steps, factor)) for factor in FACTORS]


def _steps(recorded: Recorded) -> Iterator[Step]:
    """Calibrations of the parts; those that cannot be solved are left out."""
    options: dict[str, Any] = dict(recorded.options)
    of_axes = prior_fields(options.pop("prior", {}))
    options |= {name.replace("_", ".", 1): value for name, value in of_axes.items()}
    options = {"max_pairs": CalibratorConfig.max_pairs, **options}
    streams = recorded.recording.parent, recorded.recording.child
    of_parent, of_child = (stream.stamps_ns[[0, -1]] for stream in streams)
    # Clocks of their own: the child's part is the same share of its recording.
    if abs(of_child[0] - of_parent[0]) < 10 * 10**9:
        of_child = of_parent
    for share in np.arange(1, _STEPS + 1) / _STEPS:
        parts = [
            _until(stream, start_ns + round(share * (end_ns - start_ns)))
            for stream, (start_ns, end_ns) in zip(streams, (of_parent, of_child), strict=True)
        ]
        try:
            snapshot = whole_snapshot(parts[0], parts[1], options).resolved
            calibration = snapshot.estimate()
            seen = excitation(snapshot.pose_pairs)
        except (HandEyeCalibError, np.linalg.LinAlgError):
            continue
        end_s = float(share * np.ptp(of_parent) * 1e-9)
        error = deviation(calibration.T_parent_child, recorded.truth.T_parent_child)
        yield Step(end_s, error, calibration, seen)


def _until(trajectory: Trajectory, stamp_ns: int) -> Trajectory:
    return trajectory[: max(int(np.searchsorted(trajectory.stamps_ns, stamp_ns, side="right")), 3)]


def _stopped(recorded: Recorded, steps: Sequence[Step], factor: float) -> Stop:
    """Let the goal judge the results of a recording in turn."""
    goal = Goal(factor * TARGET)
    is_stuck = False
    worst: list[float] = []
    for step in steps:
        progress = goal.add(step.calibration, step.seen)
        is_stuck |= progress.will_not_get_there
        worst.append(_worst(step.error, recorded.truth.sigmas, factor))
        if progress.done:
            # From here on all errors stay within their targets.
            first = max((i + 1 for i, ratio in enumerate(worst) if ratio > 1.0), default=0)
            earliest_s = steps[first].end_s if first < len(worst) else np.nan
            return Stop(recorded.kind, factor, False, True, worst[-1], step.end_s, earliest_s)
    return Stop(recorded.kind, factor, is_stuck)


def _worst(error: FloatArray, truth_sigmas: FloatArray, factor: float) -> float:
    """Largest error over target; where the truth is known to less than that, it says nothing."""
    unsure = 2.0 * truth_sigmas
    excess = np.where(np.isfinite(unsure), np.maximum(np.abs(error) - unsure, 0.0), 0.0)
    return float((excess / (factor * TARGET)).max())


def table(stops: Sequence[Stop], which: str) -> str:
    """A row for all recordings with each target; of simulated ones, with the default targets, one
    for each kind, too.
    """
    rows = []
    for factor in FACTORS:
        of_factor = [stop for stop in stops if stop.factor == factor]
        kinds = {stop.kind for stop in of_factor if factor == 1.0 and which == "simulated"}
        for kind in (kind for kind in KINDS if kind in kinds):
            rows.append(_row(kind, factor, [s for s in of_factor if s.kind == kind]))
        rows.append(_row("**all**", factor, of_factor))
    return markdown_table(rows)


def _row(kind: str, factor: float, stops: Sequence[Stop]) -> dict[str, object]:
    done = [stop for stop in stops if stop.is_done]
    worst = np.array([stop.worst for stop in done])
    beyond = np.array([stop.seconds - stop.earliest_s for stop in done])
    beyond = beyond[np.isfinite(beyond)]
    return {
        "recordings": kind,
        "target": f"{100 * factor * TARGET[0]:g} cm, {np.degrees(factor * TARGET[3]):.1f} deg",
        "number": len(stops),
        "told to stop": len(done),
        "worst axis within target": f"{np.mean(worst <= 1.0):.0%}" if done else "-",
        "largest error / target": f"{worst.max():.2f}" if done else "-",
        "seconds beyond earliest": f"{np.median(beyond):.0f}" if len(beyond) else "-",
        "not getting there": sum(stop.is_stuck for stop in stops),
    }
