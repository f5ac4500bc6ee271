"""From streams of which at least one gives only rotations, or angular rates, to a calibration: the
rotation between the sensors, the bias of a gyroscope and the time offset.

The adaptive estimator sees trajectories that never leave their origins: their increments have no
translation, and what it finds for the rotation does not depend on the rest.
"""

from dataclasses import replace

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.assessment.covariance import assess_rotation
from hand_eye_calib.assessment.prior import Fused, fuse
from hand_eye_calib.checks.findings import Finding, finding
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls import estimator as adaptive_estimator
from hand_eye_calib.gls.increments import (
    RATE,
    SYSTEMATIC_OF_RATES,
    SYSTEMATIC_OF_ROTATIONS,
    without_rate_bias,
)
from hand_eye_calib.gls.solution import AdaptiveSolution
from hand_eye_calib.pairing.motion_pairs import MotionPairs, motion_pairs
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.results.calibration import Calibration, DofVerdict, Residuals, SolveStatus
from hand_eye_calib.results.records import RateBias

# Two streams of which more than this share of the rotation stays unexplained are not of one body.
_UNRELATED = 0.5

# Poses between the ends of the motions that tell this; the quantile of their angles above which
# they count.
_SPAN, _TURNING = 10, 0.75

# Rates in another unit are off by this factor, within a share of it.
_DEGREES, _UNIT_WITHIN = float(np.degrees(1.0)), 0.2


def estimate_rotation(pose_pairs: PosePairs, config: CalibratorConfig) -> Calibration:
    """Solve and assess synchronised rotations.

    Parameters
    ----------
    pose_pairs : PosePairs
        On one clock. Positions are not looked at.
    config : CalibratorConfig
        With a time offset in seconds, which the poses already have.

    Returns
    -------
    Calibration
        Without frame names. Its translation is zero and unknown.

    Raises
    ------
    ConfigError
        If a scale is given or to be estimated: rotations have none.
    """
    if config.scale not in ("none", "auto"):
        config.require_poses(f"scale {config.scale}")
    Ts_pw_p, Ts_as_read = (
        _without_positions(Ts) for Ts in (pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c)
    )
    has_rates = "rates" in (config.parent_measures, config.child_measures)
    solution, Ts_cw_c = _solved(pose_pairs.stamps_ns, Ts_pw_p, Ts_as_read, has_rates)
    findings = _unrelated(Ts_pw_p, Ts_cw_c, solution)
    if findings and has_rates:
        findings = _rate_unit(motion_pairs(Ts_pw_p, Ts_as_read, "B1"), config) or findings
    assessment = assess_rotation(Ts_pw_p, solution)
    fused = fuse(solution.T_parent_child, assessment, config.prior())
    pairs = motion_pairs(Ts_pw_p, Ts_cw_c, "B1")
    residuals = _residuals(pairs, solution, pose_pairs)
    return Calibration(
        T_parent_child=fused.T_parent_child,
        covariance=fused.assessment.cov_parent_child_in_child,
        status=_status(solution, fused),
        observability=fused.assessment.observability,
        measured="rotations",
        T_method=solution.T_parent_child,
        objective=solution.objective,
        method="adaptive",
        reference="increments",
        backend="fast",
        n_poses=len(pose_pairs),
        n_pairs=len(residuals),
        n_inliers=int(residuals.is_inlier.sum()),
        time_offset_s=float(config.time_offset) + solution.time_offset_s,
        time_offset_sigma_s=solution.time_offset_sigma_s,
        rate_bias=_rate_bias(solution, config) if has_rates else None,
        noise=solution.describe(pose_pairs.stamps_ns),
        findings=findings,
        contradictions=fused.contradictions,
        **config.target_fields(),
        stamp_ns=int(pose_pairs.stamps_ns[-1]),
        motion_residuals=residuals,
    )


def _status(solution: AdaptiveSolution, fused: Fused) -> SolveStatus:
    if not solution.converged:
        return SolveStatus.NOT_CONVERGED
    if fused.contradictions:
        return SolveStatus.CONTRADICTED
    angles = fused.assessment.observability[3:]
    is_known = all(dof.verdict is not DofVerdict.UNOBSERVABLE for dof in angles)
    return SolveStatus.OK if is_known else SolveStatus.UNOBSERVABLE


def _solved(
    stamps_ns: IntArray, Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, has_rates: bool
) -> tuple[AdaptiveSolution, FloatArray]:
    """The solution, and the child's poses freed of the bias of the rates.

    The noise is fitted to increments of up to some seconds. What a bias does to these is linear
    only for what is left of it after a first solve.
    """
    if not has_rates:
        solution = adaptive_estimator.solve(stamps_ns, Ts_pw_p, Ts_cw_c, SYSTEMATIC_OF_ROTATIONS)
        return solution, Ts_cw_c
    first = adaptive_estimator.solve(stamps_ns, Ts_pw_p, Ts_cw_c, SYSTEMATIC_OF_RATES, quick=True)
    Ts_cw_c = without_rate_bias(stamps_ns, Ts_cw_c, first.rate_bias[0])
    solution = adaptive_estimator.solve(stamps_ns, Ts_pw_p, Ts_cw_c, SYSTEMATIC_OF_RATES)
    parameters = solution.parameters.copy()
    parameters[RATE] += first.parameters[RATE]
    return replace(solution, parameters=parameters), Ts_cw_c


def _without_positions(Ts: FloatArray) -> FloatArray:
    return se3.from_rotation_translation(Ts[:, :3, :3], np.zeros((len(Ts), 3)))


def _rate_bias(solution: AdaptiveSolution, config: CalibratorConfig) -> RateBias:
    """The bias of the rates, in the axes of the sensor that has it.

    Of two gyroscopes only the difference of the biases shows, the child's less the parent's.
    """
    bias, sigmas = solution.rate_bias
    if config.child_measures == "rates":
        of = "child" if config.parent_measures != "rates" else "child less parent, child's axes"
        return RateBias(of=of, rad_per_s=tuple(bias.tolist()), sigma=tuple(sigmas.tolist()))
    rotation = solution.T_parent_child[:3, :3]
    variances = np.diag(rotation @ np.diag(sigmas**2) @ rotation.T)
    return RateBias(
        of="parent",
        rad_per_s=tuple((-rotation @ bias).tolist()),
        sigma=tuple(np.sqrt(variances).tolist()),
    )


def _residuals(pairs: MotionPairs, solution: AdaptiveSolution, pose_pairs: PosePairs) -> Residuals:
    translation, rotation = pairs.residuals(solution.T_parent_child)
    return Residuals(
        translation=translation,
        rotation=rotation,
        weights=(~solution.jumps).astype(float),
        start_ns=pose_pairs.stamps_ns[pairs.i],
        end_ns=pose_pairs.stamps_ns[pairs.j],
    )


def _unrelated(
    Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, solution: AdaptiveSolution
) -> tuple[Finding, ...]:
    """A finding if the rotations of one stream do not explain those of the other."""
    span = min(_SPAN, max(len(Ts_pw_p) // 10, 1))
    pairs = motion_pairs(Ts_pw_p, Ts_cw_c, f"B{span}")
    left = np.linalg.norm(pairs.residuals(solution.T_parent_child)[1], axis=1)
    turned = se3.rotation_angle(pairs.Ts_parenti_parentj[:, :3, :3])
    most = turned >= np.quantile(turned, _TURNING)  # a sensor may stand still for long
    share = float(np.median(left[most]) / max(float(np.median(turned[most])), 1e-12))
    if share < _UNRELATED:
        return ()
    found = finding(
        "unrelated_parts",
        share=min(share, 1.0),
        part="rotation of one sensor",
        other="other",
        units="the unit of the rates",
    )
    return (found,)


def _rate_unit(steps: MotionPairs, config: CalibratorConfig) -> tuple[Finding, ...]:
    """A finding if the rates of one stream are in degrees and those of the other in radians."""
    of_parent, of_child = (
        float(np.quantile(se3.rotation_angle(Ts[:, :3, :3]), _TURNING))
        for Ts in (steps.Ts_parenti_parentj, steps.Ts_childi_childj)
    )
    stream, ratio = "child", of_child / max(of_parent, 1e-12)
    if config.child_measures != "rates":
        stream, ratio = "parent", of_parent / max(of_child, 1e-12)
    if min(abs(ratio / _DEGREES - 1.0), abs(ratio * _DEGREES - 1.0)) >= _UNIT_WITHIN:
        return ()
    unit, read_as = ("deg/s", "rad/s") if ratio > 1.0 else ("rad/s", "deg/s")
    return (finding("rate_unit", stream, ratio=ratio, unit=unit, read_as=read_as),)
