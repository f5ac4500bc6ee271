"""The stream checks of a snapshot, with a result or before any.

Of streams that have only positions, rotations or angular rates, what they have in common shows in a
solve, which is quick: whether they are of one body, in one unit of length, and on one clock.
"""

from dataclasses import replace

import numpy as np

from hand_eye_calib.alignment.angular_rates import MIN_VARIATION, Correlation, correlate_rates
from hand_eye_calib.alignment.time_offset import TimeOffset
from hand_eye_calib.checks.check import (
    CheckResult,
    check_offset,
    check_parts,
    check_streams,
    unseen,
)
from hand_eye_calib.checks.findings import Finding, Severity, answered, finding, gravest_first
from hand_eye_calib.engine.estimation import fixed_time_offset
from hand_eye_calib.engine.snapshot import Snapshot
from hand_eye_calib.errors import InputError, NotEnoughDataError
from hand_eye_calib.results.calibration import Calibration, DofVerdict, SolveStatus

# Smaller time offsets (s) of streams that are no poses are found by every solve.
_FOUND_BY_SOLVE_S = 0.25


def check(snapshot: Snapshot, calibration: Calibration | None = None) -> CheckResult:
    """Check the streams of a snapshot; of streams that are no poses, their sampling, and what the
    solve itself found. Time offset and scale of the result from them count as known; without one,
    those of the options, if they are given in numbers.
    """
    if snapshot.config.measured != "poses":
        return CheckResult(gravest_first(_check_parts(snapshot, calibration)))
    offset_s = calibration.time_offset_s if calibration else snapshot.config.time_offset
    scale = calibration.scale if calibration else snapshot.config.scale
    known = None
    if calibration and not calibration.unobservable():
        known = calibration.T_parent_child, np.sqrt(np.diag(calibration.covariance))
    result = check_streams(
        *snapshot.streams,
        time_offset_s=0.0 if isinstance(offset_s, str) else offset_s,
        scale=1.0 if isinstance(scale, str) else scale,
        max_gap_s=snapshot.max_gap_s,
        correlation=snapshot.correlation,
        known=known,
    )
    obsolete = set()
    if len(snapshot.kept):
        obsolete.add("gaps")  # pairs may have gaps where the streams have none
    if calibration and all(
        dof.verdict not in (DofVerdict.UNOBSERVABLE, DofVerdict.PRIOR)
        for dof in calibration.observability[:3]
    ):
        obsolete.add("one_axis")  # the result has shown otherwise
    findings = [found for found in result.findings if found.code not in obsolete]
    return replace(result, findings=gravest_first(answered(findings, snapshot.config)))


def _check_parts(snapshot: Snapshot, calibration: Calibration | None) -> list[Finding]:
    """Findings about streams that are no poses; of the solve, those of its result."""
    found = [*calibration.findings] if calibration else []
    known_s = fixed_time_offset(snapshot.resolved().config)
    if not len(snapshot.kept):  # pairs may have gaps where the streams have none
        parent, child = snapshot.streams
        found += check_parts(parent, child.shifted(known_s), snapshot.config.max_gap)
    if any(each.code == "unrelated" for each in found):
        correlation = _correlated(snapshot, known_s)
        if correlation.is_clear and abs(correlation.offset_s) >= _FOUND_BY_SOLVE_S:
            sigma_s = max(stream.interval_s for stream in snapshot.streams) / 5
            offset = TimeOffset(correlation.offset_s, sigma_s, correlation)
            found += check_offset(offset, known_s)
    return [each for index, each in enumerate(found) if each not in found[:index]]


def _correlated(snapshot: Snapshot, known_s: float) -> Correlation:
    """Correlation of the angular rates of both streams or, if one has only positions, of their
    speeds; the child's stamps are off by ``known_s``.
    """
    parent, child = snapshot.streams
    of_speed = snapshot.config.measured == "positions"
    return correlate_rates(parent, child.shifted(known_s), snapshot.config.max_gap, of_speed)


def check_partial(snapshot: Snapshot) -> CheckResult:
    """Check the streams of a snapshot of which one at least gives only a part of its poses.

    A time offset in the options is known; otherwise the streams are solved at the offset at which
    their angular rates, or the speeds beside positions, agree.
    """
    config = snapshot.config
    known_s = 0.0 if isinstance(config.time_offset, str) else config.time_offset
    before = check(_at_offset(snapshot, known_s))
    if any(each.makes_unusable for each in before.findings):
        return before
    correlation = _correlated(snapshot, known_s)
    is_behind = correlation.is_clear and abs(correlation.offset_s) > _FOUND_BY_SOLVE_S / 2
    solved = _at_offset(snapshot, known_s + (correlation.offset_s if is_behind else 0.0))
    try:
        result = solved.estimate()
    except NotEnoughDataError as error:
        found = [*before.findings, finding("too_short", text=str(error))]
    except InputError as error:
        found = [*before.findings, finding("unsolved", text=str(error), units="the units")]
    else:
        found = [*check(solved, result).findings]
        is_still = correlation.overlap_s > 0 and correlation.variation < MIN_VARIATION
        if not any(each.makes_unusable for each in found):
            found += _of_result(result, correlation, known_s)
        elif is_still and all(each.code == "unrelated" for each in found):
            found = [finding("no_turning")]
    return CheckResult(gravest_first(found), correlation)


def _at_offset(snapshot: Snapshot, offset_s: float) -> Snapshot:
    return replace(snapshot, config=replace(snapshot.config, time_offset=offset_s))


def _of_result(result: Calibration, correlation: Correlation, known_s: float) -> list[Finding]:
    """Findings about motion and clock of streams that agree."""
    within_reach = [dof.name for dof in result.observability if dof.name not in result.out_of_reach]
    hidden = [axis for axis in within_reach if axis in result.unobservable()]
    if result.status is SolveStatus.NOT_CONVERGED:
        text = "the solve of these streams does not converge"
        return [finding("unsolved", text=text, units="the units")]
    if hidden == within_reach:
        return [finding("no_turning")]
    offset_s, sigma_s = result.time_offset_s - known_s, result.time_offset_sigma_s
    found = check_offset(TimeOffset(offset_s, sigma_s, correlation), known_s)
    if abs(offset_s) < _FOUND_BY_SOLVE_S:
        found = [replace(each, severity=Severity.NOTE) for each in found]
    if hidden:
        found.append(unseen(hidden))
    return found
