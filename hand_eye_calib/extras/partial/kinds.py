"""Kinds of data without full poses of both sensors.

Either one sensor has poses and the other positions, or both have rotations or angular rates.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from hand_eye_calib.core.alignment.rate_correlation import correlate_rates
from hand_eye_calib.core.alignment.time_offset import TimeOffset
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.checks import check as checking
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.checks.clock_and_scale import check_offset
from hand_eye_calib.core.checks.findings import (
    Finding,
    gravest_first,
    unobservable_axes,
)
from hand_eye_calib.core.engine.kinds import Kind, kind_of
from hand_eye_calib.core.engine.snapshot import (
    MOST_MOVED_S,
    UNASKED_S,
    Snapshot,
)
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.extras.partial import position_checks, rotation_checks
from hand_eye_calib.extras.partial.partial import (
    estimate_lever_arm,
    estimate_rotation,
    unexplained_path,
)

# Allowed values of options that matter only if both sensors have full poses.
_OF_POSES: dict[str, tuple[object, ...]] = {
    "method": ("auto", "adaptive"),
    "reference": ("auto",),
    "backend": ("fast",),
    "threshold": (CalibratorConfig.threshold,),
    "min_inlier_fraction": (CalibratorConfig.min_inlier_fraction,),
}

# Rotations have no lengths: their scale is 1.
_OF_ROTATIONS: dict[str, tuple[object, ...]] = {
    **_OF_POSES,
    "scale": ("none", "auto"),
    "parent_scale": (1.0,),
}

# Positions are paired anew if the time offset changes by more than this (s). The noise model of the
# positions estimates a smaller change better than speeds do.
_LEAST_CHANGE_OF_POSITIONS_S = 0.05

# Largest time offset (s) that the solve can certainly estimate without a correlation of rates.
_FOUND_BY_SOLVE_S = 0.25

# Standard deviation of a time offset from correlated rates, as a multiple of the interval between
# poses.
_COARSE_INTERVALS = 0.2


# Time offsets (s) that are tried if speeds are not correlated. The solve estimates the remainder.
_TRIED_OFFSETS_S = tuple(np.round(np.arange(-0.9, 0.95, 0.1), 3).tolist())
# A tried offset is accepted if the unexplained share of the path falls below this fraction of the
# share without an offset.
_CLEAR_SHARE = 0.5


def _solve_positions(
    snapshot: Snapshot, cross_check: bool | None
) -> Calibration:
    """Estimate the lever arm. Positions have no cross-check, so ``cross_check`` has no effect.

    With a delay, positions may look unrelated to the poses. In this case, the delay is estimated
    from the correlation of speeds or from the paths, and the solve is repeated.
    """
    result = _solve(snapshot, estimate_lever_arm)
    config = snapshot.config
    if (
        not _is_unrelated(result)
        or len(snapshot.kept)
        or "time_offset" in config.given
    ):
        return result
    known_s = float(config.time_offset)
    parent, child = snapshot.streams
    correlation = correlate_rates(
        parent, child.shifted(known_s), config.max_gap, of_speed=True
    )
    offset_s = (
        correlation.offset_s
        if correlation.is_clear
        else _offset_of_paths(snapshot)
    )
    if not MOST_MOVED_S < abs(offset_s) < UNASKED_S:
        return result
    shifted = _solve(_shifted(snapshot, offset_s), estimate_lever_arm)
    return result if _is_unrelated(shifted) else shifted


def _shifted(snapshot: Snapshot, offset_s: float) -> Snapshot:
    """Return the snapshot with an additional time offset (s)."""
    known_s = float(snapshot.config.time_offset)
    return replace(
        snapshot,
        config=replace(snapshot.config, time_offset=known_s + offset_s),
    )


def _offset_of_paths(snapshot: Snapshot) -> float:
    """Return the time offset (s) at which a lever arm explains most of the positions.

    A long lever arm changes the speed of the antenna so much that speeds are not correlated. The
    result is 0 if no offset explains the positions clearly better.
    """
    shares = {}
    for offset_s in _TRIED_OFFSETS_S:
        pose_pairs = _shifted(snapshot, offset_s).pose_pairs
        if len(pose_pairs) >= snapshot.config.min_pairs:
            shares[offset_s] = unexplained_path(pose_pairs, snapshot.config)
    if not shares:
        return 0.0
    best_s = min(shares, key=lambda offset_s: shares[offset_s])
    is_clear = shares[best_s] < _CLEAR_SHARE * shares.get(0.0, 1.0)
    return best_s if is_clear else 0.0


def _is_unrelated(calibration: Calibration) -> bool:
    """Return whether the streams of a result are unrelated, according to its findings."""
    return _has(calibration.findings, "unrelated")


def _solve_rotations(
    snapshot: Snapshot, cross_check: bool | None
) -> Calibration:
    """Estimate the rotation, and the bias of angular rates."""
    return _solve(
        snapshot,
        partial(estimate_rotation, cross_check=cross_check is not False),
    )


def _solve(
    snapshot: Snapshot, estimate: Callable[..., Calibration]
) -> Calibration:
    """Estimate the extrinsic. If the time offset changes much, pair the streams anew and repeat.

    A change by ``UNASKED_S`` or more is not believed: the result then keeps its extrinsic, with the
    time offset of the configuration.
    """
    config = snapshot.config
    result = estimate(snapshot.pose_pairs, config)
    before_s = float(config.time_offset)
    change_s = abs(result.time_offset_s - before_s)
    if not change_s < UNASKED_S:
        return replace(result, time_offset_s=before_s)
    if len(snapshot.kept) or not change_s > MOST_MOVED_S:
        return result
    # Pairing interpolates the poses. The solve only moved them along their velocity, which is
    # correct for small offsets.
    config = replace(config, time_offset=result.time_offset_s)
    pose_pairs = replace(snapshot, config=config).pose_pairs
    return (
        estimate(pose_pairs, config)
        if len(pose_pairs) >= config.min_pairs
        else result
    )


def check(
    snapshot: Snapshot, calibration: Calibration | None = None
) -> CheckResult:
    """Check two streams without full poses of both sensors.

    The result includes the findings of the calibration.

    Parameters
    ----------
    snapshot : Snapshot
    calibration : Calibration, optional
        Result from these streams. Its time offset and scale are not checked again.
    """
    findings = [*calibration.findings] if calibration else []
    known_s = float(snapshot.resolved.config.time_offset)
    # Pairs of a stored session may have gaps that the streams did not have, so they are not
    # checked.
    if not len(snapshot.kept):
        findings += _check_aligned(snapshot, calibration, known_s)
    hidden = calibration.hidden if calibration else []
    if len(hidden) == 3 or _has(findings, "unrelated"):
        parent, child = snapshot.streams
        of_clock = _check_clock(parent, child, known_s, snapshot)
        findings = _explained(findings, by=of_clock)
    if calibration and not _has(findings, "time_offset"):
        findings = _with_solved(findings, snapshot, calibration)
    if hidden and not any(issue.makes_unusable for issue in findings):
        findings.append(unobservable_axes(hidden))
    # Lengths in another unit come first, because they cause the findings of the solve.
    findings.sort(key=lambda issue: issue.code != "lengths")
    return CheckResult(gravest_first(_without_repetitions(findings)))


def _with_solved(
    findings: list[Finding], snapshot: Snapshot, calibration: Calibration
) -> list[Finding]:
    """Return findings with those about the residuals of the solve."""
    is_unrelated = _has(findings, "unrelated")
    of_solve = _check_solved(snapshot, calibration, is_unrelated)
    if calibration.measured == "rotations":
        return _explained(findings, by=of_solve)
    # Faults in spite of unrelated streams are their cause, and come first.
    return [*of_solve, *findings] if is_unrelated else [*findings, *of_solve]


def _has(findings: Sequence[Finding], code: str) -> bool:
    """Return whether a finding has this code."""
    return any(issue.code == code for issue in findings)


def _explained(findings: list[Finding], by: Sequence[Finding]) -> list[Finding]:
    """Return findings with their causes.

    If there are causes, they replace the finding that the streams are unrelated.
    """
    if by:
        findings = [issue for issue in findings if issue.code != "unrelated"]
    return [*findings, *by]


def _check_solved(
    snapshot: Snapshot, calibration: Calibration, is_unrelated: bool
) -> list[Finding]:
    """Check both streams with the extrinsic of their calibration."""
    parent, child = snapshot.streams
    config = snapshot.config
    if calibration.measured == "rotations":
        return rotation_checks.check_solved(
            parent, child, calibration, config, is_unrelated
        )
    if len(calibration.hidden) == 3 and not is_unrelated:
        return []
    return position_checks.check_solved(
        parent, child, calibration, config, is_unrelated
    )


def _check_aligned(
    snapshot: Snapshot, calibration: Calibration | None, known_s: float
) -> list[Finding]:
    """Check both streams with the scale and the time offset of their calibration."""
    parent, child = snapshot.streams
    scale = calibration.scale if calibration else snapshot.config.given_scale
    aligned = child.scaled(scale).shifted(known_s)
    lever_arm_m = _least_lever_arm(calibration) if calibration else 0.0
    return checking.check_parts(
        parent, aligned, snapshot.config.max_gap, lever_arm_m
    )


def _without_repetitions(findings: Sequence[Finding]) -> list[Finding]:
    """Return the findings in their order, without repetitions."""
    different: list[Finding] = []
    for issue in findings:
        if issue not in different:
            different.append(issue)
    return different


def _least_lever_arm(calibration: Calibration) -> float:
    """Return the smallest length (m) of the lever arm that is compatible with its uncertainty."""
    sigmas = np.sqrt(np.diag(calibration.covariance_measured))[:3]
    is_hidden = [axis in calibration.hidden for axis in "xyz"]
    observed_sigmas = np.where(is_hidden, np.inf, sigmas)
    return checking.least_lever_arm(calibration.T_parent_child, observed_sigmas)


def _check_clock(
    parent: Trajectory, child: Trajectory, known_s: float, snapshot: Snapshot
) -> list[Finding]:
    """Return the finding about a clock offset, if speeds or angular rates correlate clearly."""
    uses_speeds = kind_of(snapshot.config).is_timed_by_speed
    max_gap_s = snapshot.config.max_gap
    correlation = correlate_rates(
        parent, child.shifted(known_s), max_gap_s, uses_speeds
    )
    if (
        not correlation.is_clear
        or abs(correlation.offset_s) < _FOUND_BY_SOLVE_S
    ):
        return []
    sigma_s = _COARSE_INTERVALS * max(parent.interval_s, child.interval_s)
    offset = TimeOffset(correlation.offset_s, sigma_s, correlation)
    return check_offset(offset, known_s)


#: Poses of one sensor and positions of the other.
POSITIONS = Kind(
    solve=_solve_positions,
    check=check,
    least_clock_change_s=_LEAST_CHANGE_OF_POSITIONS_S,
    allowed=_OF_POSES,
    is_timed_by_speed=True,
)

#: Rotations or angular rates of both sensors.
ROTATIONS = Kind(
    solve=_solve_rotations,
    check=check,
    least_clock_change_s=MOST_MOVED_S,
    allowed=_OF_ROTATIONS,
)
