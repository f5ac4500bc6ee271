"""Texts and values about the results of a session, for the state and the log of the node."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hand_eye_calib.core.assessment.excitation import (
    Excitation,
    axes_by_hand,
    what_is_missing,
)
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.spelling import Interface
from hand_eye_calib.core.base.text import (
    AXIS_UNITS,
    amount,
    duration,
    in_sentences,
    listing,
)
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import Calibration, SolveStatus
from hand_eye_calib.core.results.context import Comparison
from hand_eye_calib.core.results.document import (
    angles_in_words,
    transforms_of,
)
from hand_eye_calib.core.results.parts import brief_facts_of
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.online.live.brief import of_reason
from hand_eye_calib.online.live.progress import AXIS_KEYS
from hand_eye_calib.online.live.state import (
    Condition,
    InputState,
    Level,
    ResultState,
    as_printed,
)

# A first result is accepted after this duration of motion (s). Earlier estimates and advice jump.
_MIN_MOTION_S = 20.0
# A first result is also accepted after this rotation (rad).
_MIN_ROTATION_RAD = float(np.radians(30.0))

# Advice while both streams have poses that cannot be paired.
NO_PAIRS = "The poses of both sensors do not pair. Compare their clocks and their rates."

# Streams without pairs have a fault if each has at least this number of poses; with fewer, they
# have just begun.
_MANY_UNPAIRED = 50

# Solves that take longer than this (s) are reported, because advice and time left then refer to
# older data.
_SLOW_SOLVE_S = 10.0
# If a solve gets less than this share of a processor, other programs keep the processor busy.
_BUSY_SHARE = 0.5


def pause_of(
    inputs: Mapping[str, InputState], accepts_poses: bool
) -> Condition:
    """Return level and reason if no poses arrive; otherwise level OK and an empty text.

    The level is OK if every input is silent and permitted to be silent: the robot is parked.
    """
    if not accepts_poses:
        return (
            Level.WARN,
            "Paused: poses are not accepted; call ~/set_enabled, or activate the node.",
        )
    paused = {name: state for name, state in inputs.items() if state.is_paused}
    if not paused:
        return Level.OK, ""
    level = Level.WARN
    if len(paused) == len(inputs):
        level = max(state.level for state in paused.values())
    remedy = (
        "continue to drive, or save"
        if level is Level.OK
        else "start the source of the poses again"
    )
    streams = listing(
        [f"{name} ({state.topic})" for name, state in paused.items()]
    )
    longest_s = max(state.silent_s or 0.0 for state in paused.values())
    return (
        level,
        f"Paused: no pose of {streams} for {duration(longest_s)}; {remedy}.",
    )


def is_too_little(motion: Excitation) -> bool:
    """Whether the motion is too short for a first result."""
    has_rotated = motion.rotation.max() >= _MIN_ROTATION_RAD
    return bool(motion.motion_s < _MIN_MOTION_S and not has_rotated)


def has_just_begun(motion: Excitation) -> bool:
    """Whether the motion is too short for advice about the motion that is missing."""
    return motion.motion_s < _MIN_MOTION_S


def too_little_in_words(motion: Excitation) -> str:
    """Return a sentence about the motion needed for a first result, and the motion so far."""
    if not is_too_little(motion):
        return f"No result yet after {motion.motion_s:.0f} s of motion: keep moving."
    rotation_deg = np.floor(np.degrees(motion.rotation.max()))
    return (
        f"Move the sensors for {_MIN_MOTION_S:g} s, or turn them by "
        f"{np.degrees(_MIN_ROTATION_RAD):.0f} deg. So far: {motion.motion_s:.0f} s and "
        f"{rotation_deg:.0f} deg."
    )


def advice_after_failure(
    motion: Excitation, n_received: int, failure: str
) -> tuple[str, tuple[str, ...]]:
    """Return advice after a failed solve, and axes that may be measured by hand.

    After a short motion, the advice is to continue. Later the advice names the missing motion, or
    else the reason of the failure.

    Parameters
    ----------
    motion : Excitation
        Motion of the session.
    n_received : int
        Poses of the stream with fewer poses.
    failure : str
        Reason of the failure.
    """
    if not motion.n_poses and n_received >= _MANY_UNPAIRED:
        return NO_PAIRS, ()
    if has_just_begun(motion):
        return too_little_in_words(motion), ()
    if missing := what_is_missing(motion):
        by_hand = axes_by_hand(motion.hidden_axes(), motion)
        return in_sentences(missing), by_hand
    return in_sentences(failure), ()


def is_held_up(seconds: float, processor_s: float) -> bool:
    """Return whether a solve took long, and waited for the processor most of this time."""
    return seconds >= _SLOW_SOLVE_S and processor_s < _BUSY_SHARE * seconds


def slow_in_words(
    seconds: float, last_s: float, last_processor_s: float
) -> str:
    """Return a sentence about slow solves with the reason; empty if solves are fast.

    Parameters
    ----------
    seconds : float
        Longer duration of two solves (s): the last one and the running one.
    last_s, last_processor_s : float
        Duration and processor time of the last solve (s).
    """
    if seconds < _SLOW_SOLVE_S:
        return ""
    is_busy = is_held_up(last_s, last_processor_s) or last_s < _SLOW_SOLVE_S
    word = "busy" if is_busy else "slow"
    # Round to tens of seconds, so that the sentence does not change every second.
    return f"The computer is {word}: a result takes {duration(10.0 * (seconds // 10.0))}."


def with_newest_halves(kept: Calibration, newest: Calibration) -> Calibration:
    """Return the kept result with the newest difference between both halves of the session.

    The cross-check solves each half on its own. Its newest values include all poses so far.
    """
    if newest.cross_check is None or kept.cross_check is None:
        return kept
    rows = {}
    for axis, row in kept.cross_check.items():
        newest_row = newest.cross_check[axis]
        excess = newest_row.excess_of_halves
        rows[axis] = replace(
            row, of_halves=newest_row.of_halves, excess_of_halves=excess
        )
    return replace(kept, cross_check=rows)


def comparison_of(
    result: Calibration | None, why_not: str
) -> Comparison | None:
    """Return the comparison with the installed transform, or the reason why it is missing."""
    if result is not None and result.comparison is not None:
        return with_axis_keys(result.comparison)
    if not why_not:
        return None
    return Comparison(sentence=f"not compared yet: {why_not}")


def with_axis_keys(comparison: Comparison) -> Comparison:
    """Return the comparison, with the axis names of topics (``AXIS_KEYS``) in its differences."""
    differences = []
    for difference in comparison.differences:
        axes = {AXIS_KEYS[axis]: row for axis, row in difference.axes.items()}
        differences.append(replace(difference, axes=axes))
    return replace(comparison, differences=tuple(differences))


def is_refuted(result: Calibration) -> bool:
    """Whether the solve failed, or an error in the streams makes every axis unusable."""
    return bool(result.status.failure) or any(
        finding.makes_unusable for finding in result.findings
    )


def refuted_in_words(result: Calibration) -> str:
    """Return why a result is refuted, and what to do, in one line."""
    reason = result.reasons[0]
    text = f"{reason.sentence}; {reason.advice_on(Interface.NODE)}"
    if result.status is SolveStatus.CONTRADICTED:
        text += ", or remove it"
    return text


def priors_of(config: CalibratorConfig) -> dict[str, str]:
    """Return the priors that are set, by axis, in the form in which the user typed them."""
    priors = {axis: getattr(config, f"prior_{axis}") for axis in AXES}
    return {axis: text for axis, text in priors.items() if text}


def state_of_result(result: Calibration, age_s: float) -> ResultState:
    """Return the diagnostics of a result that was computed ``age_s`` seconds ago."""
    pose = se3.xyz_rpy(result.T_parent_child)
    sigmas = result.sigmas_printed
    problem, step = of_reason(result.reasons[0]) if result.reasons else ("", "")
    return ResultState(
        parent_frame=result.parent_frame,
        child_frame=result.child_frame,
        verdict=result.verdict.value,
        status=result.status.value,
        reasons=tuple(
            f"{reason.sentence}: {reason.advice_on(Interface.NODE)}"
            for reason in result.reasons
        ),
        pose=as_printed(np.where(np.isfinite(sigmas), pose, np.nan)),
        pose_sigma=as_printed(sigmas),
        warnings=result.warnings,
        n_poses=result.n_poses,
        time_offset_s=result.time_offset_s,
        scale=result.scale,
        age_s=age_s,
        facts=(*brief_facts_of(result), *measured_parts(result)),
        angles=angles_in_words(transforms_of(result)["T_parent_child"], result),
        caution=problem,
        step=step,
    )


def measured_parts(result: Calibration) -> list[str]:
    """Return a line about the measured parts of the standard deviations.

    More motion reduces only these parts. Without a large allowance, there is no line.
    """
    is_known = np.isfinite(result.sigmas)
    if not is_known.any():
        return []
    measured = result.sigmas_measured[is_known]
    is_mostly_allowance = 2.0 * measured**2 < result.sigmas[is_known] ** 2
    if not is_mostly_allowance.all():
        return []
    largest: dict[str, float] = {}
    for axis, sigma in zip(
        np.array(AXES)[is_known].tolist(), measured.tolist(), strict=True
    ):
        unit = AXIS_UNITS[axis]
        largest[unit] = max(sigma, largest.get(unit, 0.0))
    axis_of_unit = {"m": "x", "rad": "yaw"}
    sizes = listing(
        [amount(axis_of_unit[unit], sigma) for unit, sigma in largest.items()]
    )
    verb = "is" if len(largest) == 1 else "are"
    return [
        f"{sizes} {verb} measured; the rest of +/- is an allowance for constant errors, which more "
        "motion does not reduce"
    ]


def describe(calibration: Calibration) -> str:
    """Return a log line with verdict, pose, standard deviations and amount of data."""
    pose = se3.xyz_rpy(calibration.T_parent_child)
    sigmas = calibration.sigmas_printed
    xyz = _listed(pose[:3], 4)
    rpy = _listed(np.degrees(pose[3:]), 3)
    mm = _listed(1000 * sigmas[:3], 1)
    deg = _listed(np.degrees(sigmas[3:]), 3)
    return (
        f"{calibration.headline.rstrip('.')}. "
        f"{calibration.child_frame} in {calibration.parent_frame}: "
        f"xyz = ({xyz}) m +/- ({mm}) mm, rpy = ({rpy}) deg +/- ({deg}) deg; "
        f"status {calibration.status.value}; {calibration.method} {calibration.reference}"
        f": {calibration.n_poses} poses, {calibration.n_pairs} pairs, "
        f"{calibration.n_inliers} inliers"
    )


def _listed(values: FloatArray, decimals: int) -> str:
    """Return numbers as a text with commas; infinity becomes "unknown"."""
    texts = [f"{value:.{decimals}f}" for value in values]
    return ", ".join(texts).replace("inf", "unknown")
