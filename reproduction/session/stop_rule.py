"""Is a session that is told to stop really good enough, and how much sooner might it have stopped?

Every recording is cut off after ever longer times; each prefix is calibrated, and the goal judges
the results in turn, as in the node. Where it says "done", the error against the truth is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.session.goal import Goal
from reproduction.session.prefixes import Kept, Step
from reproduction.writing import markdown_table

TARGET = np.r_[np.full(3, 0.02), np.full(3, 0.00524)]
FACTORS = (0.5, 1.0, 2.0, 4.0)


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


def stopped(kept: Kept, factor: float) -> Stop:
    """Let the goal judge the results of a recording in turn."""
    goal = Goal(factor * TARGET)
    is_stuck = False
    for number, step in enumerate(kept.steps, start=1):
        progress = goal.add(step.calibration, step.seen)
        is_stuck |= progress.will_not_get_there
        if progress.is_done:
            worst = _worst(step.error, kept.truth_sigmas, factor)
            earliest_s = _earliest(kept.steps[:number], kept.truth_sigmas, factor)
            return Stop(kept.kind, factor, False, True, worst, step.end_s, earliest_s)
    return Stop(kept.kind, factor, is_stuck)


def _worst(error: FloatArray, truth_sigmas: FloatArray, factor: float) -> float:
    """Largest error over target; where the truth is known to less than that, it says nothing."""
    unsure = 2.0 * truth_sigmas
    excess = np.where(np.isfinite(unsure), np.maximum(np.abs(error) - unsure, 0.0), 0.0)
    return float((excess / (factor * TARGET)).max())


def _earliest(steps: Sequence[Step], truth_sigmas: FloatArray, factor: float) -> float:
    """The time from which on all errors stay within their targets."""
    good = [_worst(step.error, truth_sigmas, factor) <= 1.0 for step in steps]
    first = len(good) - next((i for i, is_good in enumerate(good[::-1]) if not is_good), len(good))
    return steps[first].end_s if first < len(good) else np.nan


def table(stops: Sequence[Stop]) -> str:
    """A row per kind with the default targets, and one for all with each other target."""
    rows = []
    for factor in FACTORS:
        of_factor = [stop for stop in stops if stop.factor == factor]
        kinds = dict.fromkeys(stop.kind for stop in of_factor if factor == 1.0)
        for kind in kinds:
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
        "error / target: median": f"{np.median(worst):.2f}" if done else "-",
        "largest": f"{worst.max():.2f}" if done else "-",
        "seconds beyond earliest": f"{np.median(beyond):.0f}" if len(beyond) else "-",
        "not getting there": sum(stop.is_stuck for stop in stops),
    }
