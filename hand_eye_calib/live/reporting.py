"""The parts of the session as the node's state has them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hand_eye_calib.geometry import se3
from hand_eye_calib.live.cycle import SolveCycle
from hand_eye_calib.live.input import PoseInput
from hand_eye_calib.live.solving import FailureKind
from hand_eye_calib.live.state import (
    AxisValues,
    Broadcast,
    ExtrinsicState,
    InputState,
    Level,
    ProgressState,
    ResultState,
)
from hand_eye_calib.plain import plain
from hand_eye_calib.results.calibration import Calibration, Verdict
from hand_eye_calib.results.records import Comparison
from hand_eye_calib.results.status import AXES

# If poses wait that no result contains, the result is stale when it is older than this many solve
# periods, and than so many seconds.
_STALE_PERIODS, _STALE_S = 5, 10.0

# Inputs whose stamps differ by more than this (s) from what time_offset says are suspected of
# different clocks.
_SUSPICIOUS_OFFSET_S = 2.0


def extrinsic_state(
    cycle: SolveCycle,
    *,
    accepts_poses: bool,
    tf_static: tuple[Broadcast, str],
    waited_for_s: float | None,
    steady_s: float,
    clock_ns: int,
) -> ExtrinsicState:
    """The result: what is missing, how good it is, how it was found.

    Parameters
    ----------
    cycle : SolveCycle
    accepts_poses : bool
    tf_static : (Broadcast, str)
        What is done about ``/tf_static``, and the reason.
    waited_for_s : float or None
        The solve period while poses wait; None on a parked robot.
    steady_s, clock_ns
        Steady time, and the node's clock, 0 if it does not run yet.
    """
    seen, result, age_s = cycle.seen, cycle.result, cycle.age_s(steady_s)
    is_stale = waited_for_s is not None and age_s > max(_STALE_S, _STALE_PERIODS * waited_for_s)
    refused = tf_static[1] if tf_static[0] is Broadcast.REFUSED else ""
    stale = f"the result is {age_s:.0f} s old" if is_stale else ""
    level, text = _judged(cycle, accepts_poses, refused, stale)
    return ExtrinsicState(
        level=level,
        text=text,
        is_solving=cycle.is_solving,
        n_poses=seen.n_poses if seen else 0,
        path_m=seen.distance if seen else 0.0,
        motion_s=seen.motion_s if seen else 0.0,
        has_vehicle_axes=bool(seen and seen.has_vehicle_axes),
        rotation_deg=dict(zip("xyz", plain(np.degrees(seen.rotation)), strict=True))
        if seen
        else {},
        tf_static=tf_static[0],
        tf_static_reason=tf_static[1],
        result=_result_state(result, age_s, clock_ns) if result else None,
    )


def _judged(cycle: SolveCycle, accepts_poses: bool, refused: str, stale: str) -> tuple[Level, str]:
    """Level and message: the gravest that applies."""
    result, failure = cycle.result, cycle.failure
    said = failure.what if failure else ""
    if failure is not None and failure.kind is FailureKind.UNEXPECTED:
        return Level.ERROR, f"the solve failed unexpectedly, see the log: {said}"
    if not accepts_poses:
        return Level.WARN, "not accepting poses: call ~/set_enabled to go on"
    if result is None:
        faults = [f"{Verdict.DO_NOT_USE.value}: {fault}" for fault in cycle.checks.faults()[:1]]
        return Level.WARN, "; ".join(filter(None, (*faults, said))) or "no result yet"
    if refused and result.verdict is not Verdict.DO_NOT_USE:
        return Level.WARN, f"publish_tf is refused: {refused}"
    if stale:
        return Level.WARN, ": ".join(filter(None, (stale, said)))
    return Level.OK if result.verdict is Verdict.USE else Level.WARN, result.headline


def _result_state(result: Calibration, age_s: float, clock_ns: int) -> ResultState:
    T = result.T_parent_child
    pose = np.concatenate([T[:3, 3], se3.rotation_to_rpy(T[:3, :3])])
    sigmas = result.sigmas_printed
    same = ("parent_frame", "child_frame", "warnings", "n_poses", "time_offset_s",
            "time_offset_sigma_s", "scale", "scale_sigma")  # fmt: skip
    return ResultState(
        **{name: getattr(result, name) for name in same},
        verdict=result.verdict.value,
        status=result.status.value,
        reasons=tuple(f"{each.sentence}: {each.what_to_do}" for each in result.reasons),
        pose=_by_axis(np.where(np.isfinite(sigmas), pose, np.nan)),
        pose_sigma=_by_axis(sigmas),
        inlier_share=result.n_inliers / max(result.n_pairs, 1),
        age_s=age_s,
        newest_pose_age_s=(clock_ns - result.stamp_ns) * 1e-9 if clock_ns else None,
    )


def _by_axis(values: Any) -> AxisValues:
    return dict(zip(AXES, plain(values), strict=True))


def progress_state(cycle: SolveCycle, why_not_compared: str) -> ProgressState:
    """Each axis against its target, the seconds left, and what to do now; WARN before the first
    result, and while the motion is of no use for an axis that lacks. ``why_not_compared`` with what
    is installed: empty if that was not asked for.
    """
    progress, result = cycle.goal.progress, cycle.result
    comparison = result.comparison if result is not None else None
    if comparison is None and why_not_compared:
        comparison = Comparison(sentence=f"not compared yet: {why_not_compared}")
    return ProgressState(
        level=Level.WARN if result is None or progress.will_not_get_there else Level.OK,
        text=progress.sentence,
        has_result=result is not None,
        progress=progress,
        comparison=comparison,
    )


def input_states(
    inputs: Sequence[PoseInput], has_result: bool, time_offset: float | str, steady_s: float
) -> dict[str, InputState]:
    """The states of the inputs by their names: parent, child, and those of further child sensors.

    Parameters
    ----------
    inputs : sequence of PoseInput
    has_result : bool
        Whether a robot that rests has nothing more to show.
    time_offset : float or str
        What is added to the child's stamps, s.
    steady_s : float
    """
    may_rest = has_result and all(each.is_silent(steady_s) for each in inputs[:2])
    states = {each.name: each.state(steady_s, may_rest) for each in inputs}
    parent_s, child_s = states["parent"].delay_s, states["child"].delay_s
    if parent_s is None or child_s is None:
        return states
    seen_s = child_s - parent_s
    is_other = isinstance(time_offset, float) and abs(seen_s - time_offset) > _SUSPICIOUS_OFFSET_S
    for name in ("parent", "child"):
        states[name] = replace(states[name], clock_offset_s=seen_s)
        if is_other and states[name].level is Level.OK:
            text = (
                f"{states[name].text}; the stamps of the two inputs are {seen_s:.3f} s apart but "
                f"time_offset is {time_offset:.3f}: if their clocks differ, set time_offset"
            )
            states[name] = replace(states[name], level=Level.WARN, text=text)
    return states
