"""Study of the end of a session: is its result within the target, and could it have ended sooner?

The parts of a recording begin with the recording and have increasing lengths. Each part is
calibrated, and the goal judges the results in turn, as in the node. At the part that reaches the
goal, the error is computed against the truth. Other rules for the end of a session are applied to
the same results.
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
# Default target of each axis: 2 cm and 0.3 deg (m, rad).
TARGET = np.r_[np.full(3, 0.02), np.full(3, 0.00524)]
# Factors of the default target that are tried.
FACTORS = (0.5, 1.0, 2.0)

# First end (s) of the parts of a recording, and their interval (s) in the first two minutes.
_FIRST_S = 20.0
_INTERVAL_S = 5.0
_FINE_UNTIL_S = 120.0
# Interval after the first two minutes: the larger of this time (s) ...
_LATER_INTERVAL_S = 10.0
# ... and this share of the time so far.
_LATER_SHARE = 0.06

# First number of the seeds of all recordings.
_KEY = 57


class Rule(NamedTuple):
    """A rule for the end of a session.

    The session ends if all standard deviations remain within a share of their targets for a further
    time of motion. This time is a share of the motion until the standard deviations came within
    their targets, and is limited.

    Attributes
    ----------
    of_target : float
        Share of the targets.
    of_motion : float
        Share of the motion before.
    shortest_s, longest_s : float
        Limits of the further time of motion, s.
    """

    of_target: float
    of_motion: float
    shortest_s: float
    longest_s: float

    def __str__(self) -> str:
        shortest = (
            f"{self.shortest_s:g} s" if self.shortest_s else "two results"
        )
        confirmation = f"for {shortest}"
        if self.of_motion:
            confirmation = f"for {self.of_motion:.0%} of the motion, {shortest}"
            confirmation += (
                f" to {self.longest_s:g} s"
                if self.longest_s < np.inf
                else " or more"
            )
        return f"{self.of_target:g} of the target, {confirmation}"


# Share of the targets, share of the motion before, and the limits (s) of the further motion.
_NUMBERS_OF_RULES = (
    (0.7, 0.0, 0.0, 0.0),
    (1.0, 0.0, 0.0, 0.0),
    (1.0, 0.0, 20.0, 20.0),
    (1.0, 0.0, 30.0, 30.0),
    (1.0, 0.0, 60.0, 60.0),
    (1.0, 0.5, 20.0, 60.0),
    (1.0, 0.5, 20.0, 75.0),
    (1.0, 0.5, 20.0, 90.0),
    (1.0, 0.5, 20.0, np.inf),
    (1.0, 1.0, 20.0, 90.0),
    (1.0, 1.0, 20.0, np.inf),
)
RULES = [Rule(*numbers) for numbers in _NUMBERS_OF_RULES]


class Recorded(NamedTuple):
    """A recording with a known extrinsic, and the options that a user would set."""

    name: str
    kind: str
    recording: Recording
    truth: Truth
    options: Mapping[str, Any]


class Step(NamedTuple):
    """Result of a part of a recording.

    Attributes
    ----------
    end_s : float
        End of the part after the start of the recording, s.
    error : (6,) array
        Error along and about the parent's axes (m, rad).
    calibration : Calibration
    seen : Excitation
        Motion of the part.
    """

    end_s: float
    error: FloatArray
    calibration: Calibration
    seen: Excitation


@dataclass(frozen=True)
class Stop:
    """End of the session of a recording, for a target and a rule.

    Attributes
    ----------
    kind : str
        Kind of motion, or name of a real rig.
    rule : str
        Text of an entry of RULES; empty for the rule of the node.
    factor : float
        Factor of the default target.
    is_stuck : bool
        Whether the session did not reach the target, after the message that this motion will not
        reach it.
    is_done : bool
        Whether the rule ended the session. The next three values are NaN otherwise.
    worst : float
        Largest ratio of an error to its target at the end. The uncertainty of the truth is
        subtracted from the error.
    seconds : float
        End of the session, s.
    earliest_s : float
        Start (s) of the time during which all errors were within their targets until the end; NaN
        if an error exceeds its target at the end.
    n_times : int
        Number of reports of the time left, before the end.
    n_good_times : int
        Number of these reports within a factor of two of the true time left.
    """

    kind: str
    rule: str
    factor: float
    is_stuck: bool
    is_done: bool = False
    worst: float = np.nan
    seconds: float = np.nan
    earliest_s: float = np.nan
    n_times: int = 0
    n_good_times: int = 0


def simulated(seeds: int, first_seed: int = 0) -> Iterator[Recorded]:
    """Yield ``seeds`` recordings of each class; twice as many for a kind with only one class."""
    for kind, classes in KINDS.items():
        for name, duration_s in classes.items():
            n_seeds = seeds * 2 // len(classes)
            for seed in range(first_seed, first_seed + n_seeds):
                key = (_KEY, seed, sorted(CLASSES).index(name))
                made = simulate(
                    replace(CLASSES[name], duration_s=duration_s), key
                )
                truth = Truth.within(made.T_parent_child, 0.0, 0.0)
                yield Recorded(
                    f"{name} {seed}",
                    kind,
                    Recording(made.parent, made.child),
                    truth,
                    {},
                )


def real(rigs: Sequence[Rig]) -> Iterator[Recorded]:
    """Yield the recordings of rigs whose extrinsic is known."""
    for rig in rigs:
        if rig.truth is not None:
            for name, recording in rig.recordings.items():
                yield Recorded(
                    f"{rig.name} {name}",
                    rig.name,
                    recording,
                    rig.truth,
                    rig.options,
                )


def stops(recorded: Recorded) -> list[dict[str, Any]]:
    """Return a :class:`Stop`, as a dictionary, for every factor of the target and every rule."""
    steps = list(_steps(recorded))
    return [
        vars(stop)
        for factor in FACTORS
        for stop in _stops(recorded, steps, factor)
    ]


def _ends_s(duration_s: float) -> list[float]:
    """Return the ends (s) of the parts of a recording."""
    ends_s = [min(_FIRST_S, duration_s)]
    while ends_s[-1] < duration_s:
        step_s = _INTERVAL_S
        if ends_s[-1] >= _FINE_UNTIL_S:
            step_s = max(_LATER_INTERVAL_S, _LATER_SHARE * ends_s[-1])
        ends_s.append(min(ends_s[-1] + step_s, duration_s))
    return ends_s


def _steps(recorded: Recorded) -> Iterator[Step]:
    """Yield the results of the parts. Parts that cannot be solved are left out."""
    options: dict[str, Any] = dict(recorded.options)
    of_axes = prior_fields(options.pop("prior", {}))
    options |= {
        name.replace("_", ".", 1): value for name, value in of_axes.items()
    }
    options = {"max_pairs": CalibratorConfig.max_pairs, **options}
    streams = recorded.recording.parent, recorded.recording.child
    of_parent, of_child = (stream.stamps_ns[[0, -1]] for stream in streams)
    # Streams on the same clock are cut at the same stamp. If the clocks differ, the child's part is
    # the same share of its recording as the parent's.
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
        error = deviation(
            calibration.T_parent_child, recorded.truth.T_parent_child
        )
        yield Step(end_s, error, calibration, seen)


def until(trajectory: Trajectory, stamp_ns: int) -> Trajectory:
    """Return the poses up to a stamp (ns), at least three."""
    return trajectory[
        : max(
            int(np.searchsorted(trajectory.stamps_ns, stamp_ns, side="right")),
            3,
        )
    ]


def _stops(
    recorded: Recorded, steps: Sequence[Step], factor: float
) -> Iterator[Stop]:
    """Yield the ends of the session: by the goal of the node, then by each of RULES."""
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
        n_good = count_good_times(times, steps[end].seen.motion_s)
        yield replace(stop, n_times=len(times), n_good_times=n_good)
    for rule in RULES:
        yield _stop(
            recorded, str(rule), steps, factor, end_of(rule, steps, factor)
        )


def count_good_times(times: Sequence[tuple[float, float]], end_s: float) -> int:
    """Count the reports of the time left that are within a factor of two of the truth.

    ``times`` contains the motion (s) and the reported time left (s); ``end_s`` is the motion at the
    end.
    """
    ratios = np.array(
        [left_s / (end_s - motion_s) for motion_s, left_s in times]
    )
    return int(((ratios >= 0.5) & (ratios <= 2.0)).sum())


def end_of(rule: Rule, steps: Sequence[Step], factor: float) -> int | None:
    """Return the index of the part after which a rule ends the session; None if it does not."""
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
    recorded: Recorded,
    rule: str,
    steps: Sequence[Step],
    factor: float,
    end: int | None,
) -> Stop:
    """Return the end of a session after the part ``end``, which is None if no part ends it."""
    if end is None:
        return Stop(recorded.kind, rule, factor, is_stuck=False)
    worst = [
        _worst(step.error, recorded.truth.sigmas, factor)
        for step in steps[: end + 1]
    ]
    # From here on all errors stay within their targets.
    first = max(
        (i + 1 for i, ratio in enumerate(worst) if ratio > 1.0), default=0
    )
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
    """Return the largest ratio of an error to its target.

    Twice the standard deviation of the truth is subtracted from each error. Axes without a known
    truth are left out.
    """
    unsure = 2.0 * truth_sigmas
    excess = np.where(
        np.isfinite(unsure), np.maximum(np.abs(error) - unsure, 0.0), 0.0
    )
    return float((excess / (factor * TARGET)).max())


def table(stops: Sequence[Stop], which: str) -> str:
    """Return a table with a row for each target.

    For simulated recordings and the default target, each kind of motion has a row, too.
    """
    rows = []
    for factor in FACTORS:
        of_factor = [
            stop for stop in stops if stop.factor == factor and not stop.rule
        ]
        kinds = {
            stop.kind
            for stop in of_factor
            if factor == 1.0 and which == "simulated"
        }
        for kind in (kind for kind in KINDS if kind in kinds):
            rows.append(
                _row(kind, factor, [s for s in of_factor if s.kind == kind])
            )
        rows.append(_row("**all**", factor, of_factor))
    return markdown_table(rows)


def rules_table(stops: Sequence[Stop]) -> str:
    """Return a table with a row for the rule of the node and for each of RULES."""
    rows = []
    for rule in dict.fromkeys(stop.rule for stop in stops):
        row: dict[str, object] = {"rule": rule or "**of the node**"}
        for factor in FACTORS:
            of_rule = [
                stop
                for stop in stops
                if stop.rule == rule and stop.factor == factor
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
    """Return the row of sessions with a target: errors and times of those that ended."""
    target_cm = 100 * factor * TARGET[0]
    target_deg = np.degrees(factor * TARGET[3])
    done = [stop for stop in stops if stop.is_done]
    within = "-"
    largest = "-"
    if done:
        worst = np.array([stop.worst for stop in done])
        within = f"{np.mean(worst <= 1.0):.0%}"
        largest = f"{worst.max():.2f}"
    beyond_s = np.array([stop.seconds - stop.earliest_s for stop in done])
    beyond_s = beyond_s[np.isfinite(beyond_s)]
    beyond = f"{np.median(beyond_s):.0f}" if len(beyond_s) else "-"
    return {
        "recordings": kind,
        "target": f"{target_cm:g} cm, {target_deg:.1f} deg",
        "number": len(stops),
        "told to stop": len(done),
        "worst axis within target": within,
        "largest error / target": largest,
        "seconds beyond earliest": beyond,
        "not getting there": sum(stop.is_stuck for stop in stops),
        "time left within a factor of two": _share_of_times(done),
    }


def _share_of_times(done: Sequence[Stop]) -> str:
    n_times = sum(stop.n_times for stop in done)
    if not n_times:
        return "-"
    return f"{sum(stop.n_good_times for stop in done) / n_times:.0%}"
