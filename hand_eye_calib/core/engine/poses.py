"""Poses of both sensors: how they are solved and checked, and mistakes in their conventions."""

from dataclasses import replace

import numpy as np

from hand_eye_calib.core.checks import check as checking
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.checks.findings import Severity, answered, gravest_first
from hand_eye_calib.core.engine.cross_check import cross_checked
from hand_eye_calib.core.engine.estimation import solve_poses
from hand_eye_calib.core.engine.kinds import Kind
from hand_eye_calib.core.engine.snapshot import MOST_MOVED_S, Snapshot
from hand_eye_calib.core.results.calibration import Calibration, DofVerdict

#: Options that state whether the poses of a stream are inverse.
INVERSIONS = frozenset({"parent_invert", "child_invert"})


def solve(snapshot: Snapshot, cross_check: bool | None) -> Calibration:
    """Solve synchronised poses, and compare the result with other references and with both halves.

    With ``cross_check`` None, the comparison is made unless the user set the reference.
    """
    config = snapshot.config
    pairs = snapshot.pose_pairs
    solved = solve_poses(pairs, config, snapshot.time_offset)
    if cross_check or (cross_check is None and config.reference == "auto"):
        return cross_checked(solved, config, pairs)
    return solved.calibration()


def check(snapshot: Snapshot, calibration: Calibration | None = None) -> CheckResult:
    """Check two streams of poses.

    Parameters
    ----------
    snapshot : Snapshot
    calibration : Calibration, optional
        A result from these streams. Its time offset, scale and extrinsic count as known. Without a
        result, the time offset and the scale of the options count as known if they are numbers.
    """
    config = snapshot.config
    result = checking.check_streams(
        *snapshot.streams,
        time_offset_s=calibration.time_offset_s if calibration else config.given_time_offset_s,
        scale=calibration.scale if calibration else config.given_scale,
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


#: Two streams of poses on the road.
POSES = Kind(
    solve=solve,
    check=check,
    least_clock_change_s=MOST_MOVED_S,
    has_conventions=True,
)
