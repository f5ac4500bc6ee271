"""Check the streams of a snapshot, whatever they measure."""

from dataclasses import replace

import numpy as np

from hand_eye_calib.core.alignment.time_offset import TimeOffset, correlate_rates
from hand_eye_calib.core.checks import check as checking
from hand_eye_calib.core.checks import parts
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.checks.findings import Finding, Severity, answered, gravest_first
from hand_eye_calib.core.engine.snapshot import Snapshot
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration, DofVerdict

#: Options that state whether the poses of a stream are inverse.
INVERSIONS = frozenset({"parent_invert", "child_invert"})

# Share of the squared residuals of positions that belong to another path which a fault must explain
# to be named.
_NAMES_UNRELATED = 0.6

# Smaller time offsets (s) of streams that are no poses are found by every solve.
_FOUND_BY_SOLVE_S = 0.25

# Accuracy of a coarse time offset, in intervals between poses.
_COARSE_INTERVALS = 0.2


def check(snapshot: Snapshot, calibration: Calibration | None = None) -> CheckResult:
    """Check the streams of a snapshot.

    Parameters
    ----------
    snapshot : Snapshot
    calibration : Calibration, optional
        A result from these streams. Its time offset, scale and extrinsic count as known. Without a
        result, the time offset and the scale of the options count as known if they are numbers.
    """
    if snapshot.config.measured == "poses":
        return _check_poses(snapshot, calibration)
    return CheckResult(gravest_first(_check_parts(snapshot, calibration)))


def _check_poses(snapshot: Snapshot, calibration: Calibration | None) -> CheckResult:
    """Check two streams of poses."""
    config = snapshot.config
    result = checking.check_streams(
        *snapshot.streams,
        time_offset_s=_known_offset_s(snapshot, calibration),
        scale=_known_scale(snapshot, calibration),
        max_gap_s=snapshot.max_gap_s,
        correlate=lambda: snapshot.correlation,
        known=_known_extrinsic(calibration),
        are_exact=config.parent_kind == config.child_kind == "exact",
    )
    obsolete = _obsolete_codes(snapshot, calibration)
    findings = [found for found in result.findings if found.code not in obsolete]
    if calibration and config.scale == "none":
        findings += checking.check_model_scale(calibration.scale, calibration.scale_sigma)
    findings = answered(findings, config)
    if INVERSIONS & config.given:
        # Whether both streams are inverse is the user's word.
        findings = [
            replace(found, severity=Severity.NOTE) if found.code == "inverse_both" else found
            for found in findings
        ]
    return replace(result, findings=gravest_first(findings))


def _known_offset_s(snapshot: Snapshot, calibration: Calibration | None) -> float:
    """Return the time offset (s) of the result, or that of the options."""
    if calibration:
        return calibration.time_offset_s
    given = snapshot.config.time_offset
    return 0.0 if isinstance(given, str) else given


def _known_scale(snapshot: Snapshot, calibration: Calibration | None) -> float:
    """Return the factor of the child's lengths of the result, or that of the options."""
    if calibration:
        return calibration.scale
    given = snapshot.config.scale
    return 1.0 if isinstance(given, str) else given


def _known_extrinsic(calibration: Calibration | None) -> checking.Known | None:
    """Return the extrinsic of a result with its standard deviations; infinite for all axes of a
    result that does not observe all.
    """
    if calibration is None:
        return None
    sigmas = np.sqrt(np.diag(calibration.covariance_measured))
    is_known = not calibration.unobservable()
    return calibration.T_parent_child, np.where(is_known, sigmas, np.inf)


def _obsolete_codes(snapshot: Snapshot, calibration: Calibration | None) -> set[str]:
    """Return the codes of findings that kept pairs or a result contradict."""
    obsolete = set()
    if len(snapshot.kept):
        obsolete.add("gaps")  # pairs may have gaps where the streams have none
    not_shown = DofVerdict.UNOBSERVABLE, DofVerdict.PRIOR
    translations = calibration.observability[:3] if calibration else ()
    if calibration and all(dof.verdict not in not_shown for dof in translations):
        obsolete.add("one_axis")
    return obsolete


def _least_lever_arm(calibration: Calibration) -> float:
    """Return the length (m) that the lever arm of a result has at least, within its uncertainty."""
    sigmas = np.sqrt(np.diag(calibration.covariance_measured))[:3]
    is_shown = [axis not in calibration.hidden for axis in "xyz"]
    return checking.least_lever_arm(calibration.T_parent_child, np.where(is_shown, sigmas, np.inf))


def _check_parts(snapshot: Snapshot, calibration: Calibration | None) -> list[Finding]:
    """Return findings about streams that are no poses, with those of the solve itself."""
    config = snapshot.config
    findings = [*calibration.findings] if calibration else []
    known_s = float(snapshot.resolved.config.time_offset)
    parent, child = snapshot.streams
    if not len(snapshot.kept):  # pairs may have gaps where the streams have none
        on_one_scale = child.scaled(_known_scale(snapshot, calibration))
        aligned = on_one_scale.shifted(known_s)
        lever_arm_m = _least_lever_arm(calibration) if calibration else 0.0
        findings += checking.check_parts(parent, aligned, config.max_gap, lever_arm_m)
    hidden = calibration.hidden if calibration else []
    if len(hidden) == 3 or any(found.code == "unrelated" for found in findings):
        findings += _check_clock_of_parts(parent, child, known_s, snapshot)
    codes = {found.code for found in findings}
    if calibration and len(hidden) < 3 and "time_offset" not in codes:
        least_share = _NAMES_UNRELATED if "unrelated" in codes else 0.0
        findings += parts.check_solved(parent, child, calibration, config, least_share)
    if hidden and not any(found.makes_unusable for found in findings):
        findings.append(checking.unseen(hidden))
    # Lengths in another unit are the cause of what the solve found.
    findings.sort(key=lambda found: found.code != "lengths")
    return [found for index, found in enumerate(findings) if found not in findings[:index]]


def _check_clock_of_parts(
    parent: Trajectory, child: Trajectory, known_s: float, snapshot: Snapshot
) -> list[Finding]:
    """Return the finding that the clocks differ, if speeds or angular rates show it clearly."""
    config = snapshot.config
    of_speed = config.measured == "positions"
    correlation = correlate_rates(parent, child.shifted(known_s), config.max_gap, of_speed)
    if not correlation.is_clear or abs(correlation.offset_s) < _FOUND_BY_SOLVE_S:
        return []
    sigma_s = _COARSE_INTERVALS * max(parent.interval_s, child.interval_s)
    offset = TimeOffset(correlation.offset_s, sigma_s, correlation)
    return checking.check_offset(offset, known_s)
