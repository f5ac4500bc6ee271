"""Kind of data "poses": solve and check two streams of poses."""

from dataclasses import replace

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.checks import check as checking
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.checks.clock_and_scale import (
    beside_solved_scale,
    check_model_scale,
)
from hand_eye_calib.core.checks.findings import (
    Severity,
    answered,
    gravest_first,
)
from hand_eye_calib.core.engine.cross_check import cross_checked
from hand_eye_calib.core.engine.estimation import solve_poses
from hand_eye_calib.core.engine.kinds import Kind
from hand_eye_calib.core.engine.snapshot import MOST_MOVED_S, Snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import turned
from hand_eye_calib.core.results.calibration import Calibration, DofVerdict
from hand_eye_calib.core.results.records import AXES

#: Options that invert the poses of a stream.
INVERSIONS = frozenset({"parent_invert", "child_invert"})


def solve(snapshot: Snapshot, cross_check: bool | None) -> Calibration:
    """Solve synchronised poses, and cross-check the result if requested.

    If ``cross_check`` is None, the result is cross-checked unless the user chose a reference such
    as B1.
    """
    config = snapshot.config
    pairs = snapshot.pose_pairs
    solved = solve_poses(pairs, config, snapshot.time_offset)
    if cross_check or (cross_check is None and config.reference == "auto"):
        return cross_checked(solved, config, pairs)
    return solved.calibration()


def check(
    snapshot: Snapshot, calibration: Calibration | None = None
) -> CheckResult:
    """Check two streams of poses.

    Parameters
    ----------
    snapshot : Snapshot
    calibration : Calibration, optional
        Result of these streams. The check uses its time offset, scale and extrinsic. Without a
        result, it uses the time offset and the scale of the options if they are numbers.
    """
    config = snapshot.config
    time_offset_s = config.given_time_offset_s
    scale = config.given_scale
    if calibration:
        time_offset_s = calibration.time_offset_s
        scale = calibration.scale
    result = checking.check_streams(
        *snapshot.streams,
        time_offset_s=time_offset_s,
        scale=scale,
        max_gap_s=snapshot.max_gap_s,
        correlate=lambda: snapshot.correlation,
        earlier=_extrinsic_estimate(calibration),
        are_exact=config.parent_kind == config.child_kind == "exact",
    )
    obsolete = _obsolete_codes(snapshot, calibration)
    findings = [
        finding for finding in result.findings if finding.code not in obsolete
    ]
    if calibration and config.scale == "none":
        findings += check_model_scale(
            calibration.scale, calibration.scale_sigma
        )
    if calibration and config.scale == "estimate":
        findings = [
            beside_solved_scale(
                finding, calibration.scale, calibration.scale_sigma
            )
            for finding in findings
        ]
    findings = answered(findings, config)
    if INVERSIONS & config.given:
        # The user has decided whether both streams are inverse.
        for index, finding in enumerate(findings):
            if finding.code == "inverse_both":
                findings[index] = replace(finding, severity=Severity.NOTE)
    return replace(
        result,
        findings=gravest_first(findings),
        open_covariance=_limited_by_prior(
            result.open_covariance, config, calibration
        ),
    )


def _limited_by_prior(
    covariance: FloatArray,
    config: CalibratorConfig,
    calibration: Calibration | None,
) -> FloatArray:
    """Return a covariance (6, 6) limited to the standard deviations of the priors.

    The covariance is for an error of the motion, in the child's axes.
    """
    priors = config.prior()
    if calibration is None or not priors:
        return covariance
    rotation = se3.rotation_of(calibration.T_parent_child)
    of_parent = turned(rotation, covariance)
    factors = np.ones(len(AXES))
    for index, axis in enumerate(AXES):
        if axis in priors:
            sigma = float(np.sqrt(max(of_parent[index, index], 1e-30)))
            factors[index] = min(1.0, priors[axis][1] / sigma)
    return turned(rotation.T, of_parent * np.outer(factors, factors))


def _extrinsic_estimate(
    calibration: Calibration | None,
) -> checking.ExtrinsicEstimate | None:
    """Return the extrinsic of a result with standard deviations (6,), or None without a result.

    All standard deviations are infinite if the result does not determine every axis.
    """
    if calibration is None:
        return None
    sigmas = np.sqrt(np.diag(calibration.covariance_measured))
    if calibration.unobservable():
        sigmas = np.full(6, np.inf)
    return checking.ExtrinsicEstimate(calibration.T_parent_child, sigmas)


def _obsolete_codes(
    snapshot: Snapshot, calibration: Calibration | None
) -> set[str]:
    """Return the codes of findings that are obsolete for this snapshot or this result."""
    obsolete = set()
    if len(snapshot.kept):
        # Kept pairs are downsampled, so they have gaps even if the streams have none.
        obsolete.add("gaps")
    # If all motion turns about one axis, a direction of translation is unobservable. So if the
    # result determines all directions, the motion turns about two axes.
    if calibration:
        unobserved = {DofVerdict.UNOBSERVABLE, DofVerdict.PRIOR}
        if unobserved.isdisjoint(
            dof.verdict for dof in calibration.observability[:3]
        ):
            obsolete.add("one_axis")
    return obsolete


#: Kind of data of two streams of poses.
POSES = Kind(
    solve=solve,
    check=check,
    least_clock_change_s=MOST_MOVED_S,
    has_conventions=True,
)
