"""Study of the end of a session of a vehicle that drives as the node asks.

The vehicle drives in curves, and over a ramp of 7 deg every 31 s. There is a result every 4 s. The
goal of the node gets the results in turn and ends the session. Other rules for the end are applied
to the same results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.core.assessment.excitation import Excitation, excitation
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.online.live.describing import is_too_little
from hand_eye_calib.online.live.goal import Goal
from hand_eye_calib.online.live.solving import newest_pairs
from reproduction.coverage.classes import CLASSES, simulate
from reproduction.coverage.motions import agv_on_request
from reproduction.session.stop import (
    FACTORS,
    TARGET,
    Rule,
    Step,
    count_good_times,
    end_of,
    until,
)
from reproduction.writing import markdown_table

# Classes of the sensors' errors; drives use them alternately.
CLASSES_IN_TURN = ("agv_long", "agv_ramps")
# Target in units of the default target: 4 cm and 0.6 deg.
*_, FACTOR = FACTORS
# Share of the targets, share of the motion before, and the limits (s) of the further motion.
_NUMBERS_OF_RULES = (
    (1.0, 0.5, 20.0, 75.0),
    (1.0, 0.5, 40.0, 75.0),
    (1.0, 1.0, 45.0, 75.0),
)
RULES = [Rule(*numbers) for numbers in _NUMBERS_OF_RULES]

# Ends (s) of the parts of a recording.
_ENDS_S = np.arange(10.0, 176.1, 4.0)


@dataclass(frozen=True)
class End:
    """How a session ended.

    Attributes
    ----------
    rule : str
        Rule of the end; empty for the rule of the node.
    worst : float
        Largest error over its target; NaN for a session that did not end.
    wait_s : float
        Motion (s) before the end in which all results were within the targets.
    n_times, n_good_times : int
        Number of reports of the time left, and of those within a factor of two of the truth.
    change_s : float
        Motion (s) during which the node advised to change the motion.
    """

    rule: str
    worst: float = np.nan
    wait_s: float = np.nan
    n_times: int = 0
    n_good_times: int = 0
    change_s: float = 0.0


def ends(seed: int) -> list[End]:
    """Return how a session ended by the rule of the node, and by each other rule."""
    steps, newest = _steps(seed)
    rows = [_end_of_node(steps, newest)]
    for rule in RULES:
        end = end_of(rule, steps, FACTOR)
        row = End(str(rule))
        rows.append(row if end is None else _with_error(row, steps, end))
    return rows


def _steps(seed: int) -> tuple[list[Step], list[Excitation]]:
    """Return the results of the parts of a recording, and the motion of the last minute of each."""
    name = CLASSES_IN_TURN[seed % 2]
    kind = replace(
        CLASSES[name], motion=agv_on_request, duration_s=_ENDS_S[-1] + 5.0
    )
    made = simulate(kind, (9150, seed))  # a key that no other study has
    start_ns = int(made.parent.stamps_ns[0])
    steps = []
    newest = []
    for end_s in _ENDS_S:
        end_ns = start_ns + round(end_s * 1e9)
        parent = until(made.parent, end_ns)
        child = until(made.child, end_ns)
        snapshot = whole_snapshot(parent, child, {"max_pairs": 5000}).resolved
        calibration = snapshot.estimate()
        error = deviation(calibration.T_parent_child, made.T_parent_child)
        pairs = snapshot.pose_pairs
        steps.append(Step(end_s, error, calibration, excitation(pairs)))
        newest.append(excitation(newest_pairs(pairs)))
    return steps, newest


def _end_of_node(steps: Sequence[Step], newest: Sequence[Excitation]) -> End:
    """Return how a session ended by the rule of the node."""
    goal = Goal(FACTOR * TARGET)
    times: list[tuple[float, float]] = []
    change_s = 0.0
    for index, (step, last_minute) in enumerate(
        zip(steps, newest, strict=True)
    ):
        progress = goal.add(step.calibration, step.seen, (), last_minute)
        motion_s = step.seen.motion_s
        if progress.done:
            row = End(
                "",
                n_times=len(times),
                n_good_times=count_good_times(times, motion_s),
                change_s=change_s,
            )
            return _with_error(row, steps, index)
        if progress.will_not_get_there and index:
            change_s += motion_s - steps[index - 1].seen.motion_s
        if not is_too_little(step.seen) and np.isfinite(progress.seconds_left):
            times.append((motion_s, progress.seconds_left))
    return End("", change_s=change_s)


def _with_error(row: End, steps: Sequence[Step], end: int) -> End:
    """Return how a session ended, with the error at its end."""
    targets = FACTOR * TARGET
    first = end
    while first and (steps[first - 1].calibration.sigmas <= targets).all():
        first -= 1
    wait_s = steps[end].seen.motion_s - steps[first].seen.motion_s
    worst = float((np.abs(steps[end].error) / targets).max())
    return replace(row, worst=worst, wait_s=wait_s)


def table(rows: Sequence[End]) -> str:
    """Return a table with a row for each rule."""
    lines = []
    for rule in dict.fromkeys(row.rule for row in rows):
        of_rule = [row for row in rows if row.rule == rule]
        done = [row for row in of_rule if np.isfinite(row.worst)]
        worst = np.array([row.worst for row in done])
        waits_s = np.array([row.wait_s for row in done])
        waits = f"{np.median(waits_s):.0f}, {waits_s.max():.0f}"
        n_times = sum(row.n_times for row in done)
        n_good_times = sum(row.n_good_times for row in done)
        good = f"{n_good_times / n_times:.0%} of {n_times}" if n_times else "-"
        change_s = sum(row.change_s for row in of_rule)
        lines.append(
            {
                "rule": rule or "**of the node**",
                "ended": f"{len(done)} of {len(of_rule)}",
                "worst axis within target": f"{np.mean(worst <= 1.0):.0%}",
                "largest error / target": f"{worst.max():.2f}",
                "end after the last axis (s), median and largest": waits,
                "time left within a factor of two": good,
                "change the motion (s)": f"{change_s:.0f}",
            }
        )
    return markdown_table(lines)
