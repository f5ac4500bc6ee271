"""Is a session that is told to stop really good enough, and how much sooner might it have stopped?

Every recording is cut off after ever longer times; each prefix is calibrated, and the goal judges
the results in turn, as in the node. Where it says "done", the error against the truth is known.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.session.goal import Goal
from reproduction.session.prefixes import Kept, Recorded, Step, load, save, steps
from reproduction.writing import markdown_table

TARGET = np.r_[np.full(3, 0.02), np.full(3, 0.00524)]
FACTORS = (0.5, 1.0, 2.0, 4.0)


@dataclass(frozen=True)
class Stop:
    """How the session of a recording ended with a target.

    Attributes
    ----------
    name, kind : str
    factor : float
        Of the default targets.
    is_done : bool
    worst : float
        Largest error over its target, what the truth itself is unsure of taken off; NaN if the
        session was not told to stop.
    seconds, earliest_s : float
        When it was told to stop, and from when on, until then, all errors were within their
        targets.
    stuck_s : float
        When it was told that this motion will not get there; NaN if it was not.
    """

    name: str
    kind: str
    factor: float
    is_done: bool
    worst: float
    seconds: float
    earliest_s: float
    stuck_s: float


def solve(recordings: Iterable[Recorded], path: Path, method: str) -> list[Kept]:
    """Calibrate the prefixes of all recordings that are not in the file yet."""
    known = {kept.name for kept in load(path)}
    for recorded in recordings:
        if recorded.name not in known:
            save(path, recorded, steps(recorded, method))
    return load(path)


def stopped(kept: Kept, factor: float) -> Stop:
    """Let the goal judge the results of a recording in turn."""
    goal = Goal(factor * TARGET)
    stuck_s = np.nan
    for number, step in enumerate(kept.steps, start=1):
        progress = goal.add(step.calibration, step.seen)
        if progress.will_not_get_there and np.isnan(stuck_s):
            stuck_s = step.end_s
        if progress.is_done:
            worst = _worst(step.error, kept.truth_sigmas, factor)
            earliest_s = _earliest(kept.steps[:number], kept.truth_sigmas, factor)
            return Stop(kept.name, kept.kind, factor, True, worst, step.end_s, earliest_s, stuck_s)
    return Stop(kept.name, kept.kind, factor, False, np.nan, np.nan, np.nan, stuck_s)


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
    header = (
        "recordings", "target", "number", "told to stop", "worst axis within target",
        "error / target: median", "largest", "seconds beyond earliest", "not getting there",
    )  # fmt: skip
    return markdown_table(header, rows)


def _row(kind: str, factor: float, stops: Sequence[Stop]) -> tuple[object, ...]:
    done = [stop for stop in stops if stop.is_done]
    worst = np.array([stop.worst for stop in done])
    beyond = np.array([stop.seconds - stop.earliest_s for stop in done])
    beyond = beyond[np.isfinite(beyond)]
    within = f"{np.mean(worst <= 1.0):.0%}" if done else "-"
    target = f"{100 * factor * TARGET[0]:g} cm, {np.degrees(factor * TARGET[3]):.1f} deg"
    stuck = sum(np.isfinite(stop.stuck_s) and not stop.is_done for stop in stops)
    return (
        kind, target, len(stops), len(done), within,
        f"{np.median(worst):.2f}" if done else "-", f"{worst.max():.2f}" if done else "-",
        f"{np.median(beyond):.0f}" if len(beyond) else "-", stuck,
    )  # fmt: skip
