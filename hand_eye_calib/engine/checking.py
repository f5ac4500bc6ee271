"""The stream checks of a snapshot, with a result or before any.

Of streams that have only positions, rotations or angular rates, what they have in common shows in a
solve: whether they are of one body, in one unit of length, and on one clock.
"""

from dataclasses import replace

import numpy as np

from hand_eye_calib.alignment.angular_rates import correlate_rates
from hand_eye_calib.alignment.time_offset import TimeOffset
from hand_eye_calib.checks.check import (
    CheckResult,
    check_offset,
    check_parts,
    check_streams,
    unseen,
)
from hand_eye_calib.checks.findings import Finding, answered, gravest_first
from hand_eye_calib.engine.snapshot import Snapshot
from hand_eye_calib.results.calibration import Calibration, DofVerdict
from hand_eye_calib.results.status import AXES

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
    if calibration:
        sigmas = np.sqrt(np.diag(calibration.covariance))
        is_known = not calibration.unobservable()
        known = calibration.T_parent_child, np.where(is_known, sigmas, np.inf)
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
    known_s = float(snapshot.resolved.config.time_offset)
    parent, child = snapshot.streams
    if not len(snapshot.kept):  # pairs may have gaps where the streams have none
        found += check_parts(parent, child.shifted(known_s), snapshot.config.max_gap)
    hidden = set()
    if calibration:
        hidden = {*calibration.unobservable()} - {*calibration.out_of_reach}
    if len(hidden) == 3 or any(each.code == "unrelated" for each in found):
        of_speed, max_gap_s = snapshot.config.measured == "positions", snapshot.config.max_gap
        correlation = correlate_rates(parent, child.shifted(known_s), max_gap_s, of_speed)
        if correlation.is_clear and abs(correlation.offset_s) >= _FOUND_BY_SOLVE_S:
            sigma_s = max(parent.interval_s, child.interval_s) / 5
            offset = TimeOffset(correlation.offset_s, sigma_s, correlation)
            found += check_offset(offset, known_s)
    if hidden and not any(each.makes_unusable for each in found):
        found.append(unseen([axis for axis in AXES if axis in hidden]))
    return [each for index, each in enumerate(found) if each not in found[:index]]
