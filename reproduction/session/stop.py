"""Is a session that has reached its goal good enough, and how much sooner might it have ended?

Every recording is cut off after ever longer times. Each part is calibrated, and the goal judges the
results in turn, as in the node. The error against the truth is known where the goal is reached.
Other rules for the end of a session are applied to the same results.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.assessment.excitation import Excitation, excitation
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import HandEyeCalibError
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration, SolveStatus
from hand_eye_calib.offline.calibrate import prior_fields
from hand_eye_calib.online.live.goal import Goal
from reproduction.coverage.classes import CLASSES, simulate
from reproduction.recordings import Recording, Rig, Truth
from reproduction.writing import markdown_table

# Class, and duration (s): five kinds of motion with two kinds of errors each.
KINDS = {
    "hand-held": {"hand_gm_1s": 150.0, "hand_vio_walk": 150.0},
    "car": {"car_ins_lidar": 360.0, "car_two_slams": 360.0},
    "AGV": {"agv_ramps": 360.0, "agv_long": 600.0},
    "drone": {"drone_gnss_vio": 180.0, "drone_two_vios": 180.0},
    "arm": {"arm_target": 180.0},
}
TARGET = np.r_[np.full(3, 0.02), np.full(3, 0.00524)]
FACTORS = (0.5, 1.0, 2.0)

# First end (s) of the parts of a recording, and their interval (s) in the first two minutes.
_FIRST_S = 20.0
_INTERVAL_S = 5.0
_FINE_UNTIL_S = 120.0
# Later interval (s), and as a share of the time.
_LATER_INTERVAL_S = 10.0
_LATER_SHARE = 0.06

# Key of the recordings' random numbers.
_KEY = 57


class Rule(NamedTuple):
    """A rule for the end of a session.

    All standard deviations are below a share of their targets, at all results of a further motion.
    This motion is a share of the motion before it, within limits (s).
    """

    of_target: float
    of_motion: float
    shortest_s: float
    longest_s: float

    def __str__(self) -> str:
        shortest = f"{self.shortest_s:g} s" if self.shortest_s else "two results"
        confirmation = f"for {shortest}"
        if self.of_motion:
            confirmation = f"for {self.of_motion:.0%} of the motion, {shortest}"
            confirmation += (
                f" to {self.longest_s:g} s" if self.longest_s < np.inf else " or more"
            )
        return f"{self.of_target:g} of the target, {confirmation}"


RULES = [
    Rule(0.7, 0.0, 0.0, 0.0),
    Rule(1.0, 0.0, 0.0, 0.0),
    Rule(1.0, 0.0, 20.0, 20.0),
    Rule(1.0, 0.0, 30.0, 30.0),
    Rule(1.0, 0.0, 60.0, 60.0),
    Rule(1.0, 0.5, 20.0, 60.0),
    Rule(1.0, 0.5, 20.0, 75.0),
    Rule(1.0, 0.5, 20.0, 90.0),
    Rule(1.0, 0.5, 20.0, np.inf),
    Rule(1.0, 1.0, 20.0, 90.0),
    Rule(1.0, 1.0, 20.0, np.inf),
]


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
    # Of RULES; empty for the rule of the node.
    rule: str
    # Of the default targets.
    factor: float
    # Whether the user was told that this motion will not reach the target, and this was right.
    is_stuck: bool
    is_done: bool = False
    # The next three are of sessions that were told to stop. Largest error over its target, less the
    # uncertainty of the truth.
    worst: float = np.nan
    # Time of the stop.
    seconds: float = np.nan
    # Time since which all errors had been within their targets.
    earliest_s: float = np.nan
    # Reported times left before the end, and those within a factor of two.
    n_times: int = 0
    n_good_times: int = 0


def simulated(seeds: int, first_seed: int = 0) -> Iterator[Recorded]:
    """So many recordings of each class; twice as many of a kind that has one class."""
    for kind, classes in KINDS.items():
        for name, duration_s in classes.items():
            n_seeds = seeds * 2 // len(classes)
            for seed in range(first_seed, first_seed + n_seeds):
                key = (_KEY, seed, sorted(CLASSES).index(name))
                made = simulate(replace(CLASSES[name], duration_s=duration_s), key)
                truth = Truth.within(made.T_parent_child, 0.0, 0.0)
                yield Recorded(
                    f"{name} {seed}",
                    kind,
                    Recording(made.parent, made.child),
                    truth,
                    {},
                )


def real(rigs: Sequence[Rig]) -> Iterator[Recorded]:
    """The recordings of rigs whose answer is known."""
    for rig in rigs:
        if rig.truth is not None:
            for name, recording in rig.recordings.items():
                yield Recorded(
                    f"{rig.name} {name}", rig.name, recording, rig.truth, rig.options
                )


def stops(recorded: Recorded) -> list[dict[str, Any]]:
    """Plain values of a :class:`Stop` for every factor of the target, and for every rule."""
    steps = list(_steps(recorded))
    return [
        vars(stop) for factor in FACTORS for stop in _stops(recorded, steps, factor)
    ]


def _ends_s(duration_s: float) -> list[float]:
    """Ends (s) of the parts of a recording."""
    ends_s = [min(_FIRST_S, duration_s)]
    while ends_s[-1] < duration_s:
        step_s = _INTERVAL_S
        if ends_s[-1] >= _FINE_UNTIL_S:
            step_s = max(_LATER_INTERVAL_S, _LATER_SHARE * ends_s[-1])
        ends_s.append(min(ends_s[-1] + step_s, duration_s))
    return ends_s


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
    duration_s = float(np.ptp(of_parent) * 1e-9)
    for end_s in _ends_s(duration_s):
        share = end_s / duration_s
        parts = [
            until(stream, start_ns + round(share * (end_ns - start_ns)))
            for stream, (start_ns, end_ns) in zip(
                streams, (of_parent, of_child), strict=True
            )
        ]
        try:
            snapshot = whole_snapshot(parts[0], parts[1], options).resolved
            calibration = snapshot.estimate()
            seen = excitation(snapshot.pose_pairs)
        except (HandEyeCalibError, np.linalg.LinAlgError):
            continue
        error = deviation(calibration.T_parent_child, recorded.truth.T_parent_child)
        yield Step(end_s, error, calibration, seen)


def until(trajectory: Trajectory, stamp_ns: int) -> Trajectory:
    """The poses up to a stamp (ns), three at least."""
    return trajectory[
        : max(int(np.searchsorted(trajectory.stamps_ns, stamp_ns, side="right")), 3)
    ]


def _stops(recorded: Recorded, steps: Sequence[Step], factor: float) -> Iterator[Stop]:
    """Let the goal, and each rule, judge the results of a recording in turn."""
    goal = Goal(factor * TARGET)
    is_stuck = False
    # Motion (s) and time left (s) of each result.
    times: list[tuple[float, float]] = []
    end = None
    for index, step in enumerate(steps):
        progress = goal.add(step.calibration, step.seen)
        is_stuck |= progress.will_not_get_there
        if progress.done:
            end = index
            break
        if np.isfinite(progress.seconds_left):
            times.append((step.seen.motion_s, progress.seconds_left))
    stop = _stop(recorded, "", steps, factor, end)
    if end is None:
        yield replace(stop, is_stuck=is_stuck)
    else:
        end_s = steps[end].seen.motion_s
        ratios = np.array([left_s / (end_s - motion_s) for motion_s, left_s in times])
        n_good = int(((ratios >= 0.5) & (ratios <= 2.0)).sum())
        yield replace(stop, n_times=len(times), n_good_times=n_good)
    for rule in RULES:
        yield _stop(recorded, str(rule), steps, factor, end_of(rule, steps, factor))


def end_of(rule: Rule, steps: Sequence[Step], factor: float) -> int | None:
    """Index of the part after which a rule ends the session."""
    targets = rule.of_target * factor * TARGET
    since_s = None
    for index, step in enumerate(steps):
        is_within = (step.calibration.sigmas <= targets).all()
        if not is_within or step.calibration.status is not SolveStatus.OK:
            since_s = None
        elif since_s is None:
            since_s = step.seen.motion_s
        else:
            share_s = rule.of_motion * since_s
            wanted_s = min(max(share_s, rule.shortest_s), rule.longest_s)
            if step.seen.motion_s >= since_s + wanted_s:
                return index
    return None


def _stop(
    recorded: Recorded, rule: str, steps: Sequence[Step], factor: float, end: int | None
) -> Stop:
    """The end of a session after a part; None for a session that goes on."""
    if end is None:
        return Stop(recorded.kind, rule, factor, is_stuck=False)
    worst = [
        _worst(step.error, recorded.truth.sigmas, factor) for step in steps[: end + 1]
    ]
    # From here on all errors stay within their targets.
    first = max((i + 1 for i, ratio in enumerate(worst) if ratio > 1.0), default=0)
    return Stop(
        kind=recorded.kind,
        rule=rule,
        factor=factor,
        is_stuck=False,
        is_done=True,
        worst=worst[-1],
        seconds=steps[end].end_s,
        earliest_s=steps[first].end_s if first <= end else np.nan,
    )


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
        of_factor = [stop for stop in stops if stop.factor == factor and not stop.rule]
        kinds = {
            stop.kind for stop in of_factor if factor == 1.0 and which == "simulated"
        }
        for kind in (kind for kind in KINDS if kind in kinds):
            rows.append(_row(kind, factor, [s for s in of_factor if s.kind == kind]))
        rows.append(_row("**all**", factor, of_factor))
    return markdown_table(rows)


def rules_table(stops: Sequence[Stop]) -> str:
    """A row for the rule of the node, and for each other rule."""
    rows = []
    for rule in dict.fromkeys(stop.rule for stop in stops):
        row: dict[str, object] = {"rule": rule or "**of the node**"}
        for factor in FACTORS:
            of_rule = [
                stop for stop in stops if stop.rule == rule and stop.factor == factor
            ]
            columns = _row("", factor, of_rule)
            ended = f"{columns['told to stop']} of {len(of_rule)}"
            text = f"{ended}, {columns['worst axis within target']}"
            text += f", {columns['largest error / target']}"
            row[str(columns["target"])] = (
                f"{text}, {columns['seconds beyond earliest']} s"
            )
        rows.append(row)
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
        "time left within a factor of two": _share_of_times(done),
    }


def _share_of_times(done: Sequence[Stop]) -> str:
    n_times = sum(stop.n_times for stop in done)
    if not n_times:
        return "-"
    return f"{sum(stop.n_good_times for stop in done) / n_times:.0%}"
