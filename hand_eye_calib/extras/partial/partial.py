"""Calibration from streams without full poses of both sensors.

- Positions of one sensor and poses of the other: the lever arm l and the time offset are estimated.
  By convention, the sensor with positions has the axes of the sensor with poses. The rotation is
  unobservable.
- Rotations or angular rates: the rotation R, the time offset and the bias b of a gyroscope are
  estimated, from ``w_p(t) = R (w_c(t + d) - b)``. The adaptive estimator is used with poses whose
  positions are all zero, because its rotation does not depend on them.
"""

import contextlib
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hand_eye_calib.core.assessment import common_mode, covariance
from hand_eye_calib.core.assessment.prior import fuse, widened
from hand_eye_calib.core.assessment.second_opinion import (
    excess_covariance,
    second_opinions,
)
from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.checks.findings import (
    Finding,
    Severity,
    finding,
    graded,
)
from hand_eye_calib.core.checks.units import in_other_units
from hand_eye_calib.core.engine import estimation
from hand_eye_calib.core.engine.cross_check import cross_checked
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.noise import estimator as adaptive_estimator
from hand_eye_calib.core.noise import increments
from hand_eye_calib.core.pairing.motion_pairs import PosePairs, motion_pairs
from hand_eye_calib.core.results.calibration import Calibration, DofVerdict
from hand_eye_calib.core.results.records import Residuals
from hand_eye_calib.extras.partial import position_windows
from hand_eye_calib.extras.partial import positions as of_positions
from hand_eye_calib.extras.partial.position_columns import fit_positions
from hand_eye_calib.extras.partial.rate_bias import RateBias
from hand_eye_calib.extras.partial.rotation_checks import (
    TURNING,
    measured_stream,
)
from hand_eye_calib.extras.partial.rotation_columns import fit_pairs

# A fault is searched for if the poses leave more than this share of the positions' path
# unexplained. Two sensors on one body have at most 0.05.
_SUSPECT_PATH = 0.1
# The streams are unrelated if this share is larger. Sensors on two bodies have 0.5 and more.
_UNRELATED_PATH = 0.3
# Rotations or rates are unrelated if more than this share of the rotation is unexplained.
_UNRELATED_ROTATION = 0.5

# Number of poses that a motion spans in the comparison of the rotations of both streams.
_SPAN = 10

# A scale explains a path if it reduces the unexplained share to this multiple or less.
_MENDED_PATH = 0.5

# A scale between the streams is reported above this number of standard deviations.
_SCALE_SIGMAS = 5.0
# Smallest share of the information on a reported scale that comes from the data instead of the
# prior.
_MIN_DATA_SHARE = 0.5
# Smallest scale that is used as a divisor.
_LEAST_SCALE = 1e-3

# Standard deviation (m) along each axis of a sensor's reference point: the origin of an odometry,
# or the centre of an antenna or a prism.
_POINT_M = 0.005


@dataclass(frozen=True)
class _Paths:
    """Poses (N, 4, 4) and positions (N, 3) at the same stamps (N,).

    ``is_child`` states whether the child measures the positions.
    """

    stamps_ns: IntArray
    poses: FloatArray
    positions: FloatArray
    is_child: bool

    @classmethod
    def of(cls, pose_pairs: PosePairs, config: CalibratorConfig) -> "_Paths":
        """Return the paths of two synchronised streams, one of which measures positions."""
        parent = pose_pairs.Ts_pw_p
        child = pose_pairs.child_scaled(config.given_scale).Ts_cw_c
        if config.child_measures == "positions":
            return cls(
                pose_pairs.stamps_ns,
                parent,
                se3.translation_of(child),
                is_child=True,
            )
        return cls(
            pose_pairs.stamps_ns,
            child,
            se3.translation_of(parent),
            is_child=False,
        )

    def solve(self, with_scale: bool) -> of_positions.LeverArmSolution:
        """Estimate the lever arm, and on request the scale."""
        return of_positions.solve(
            self.stamps_ns, self.poses, self.positions, with_scale
        )

    def unexplained_share(
        self, solution: of_positions.LeverArmSolution
    ) -> float:
        """Return the share of the positions' path that a lever arm leaves unexplained."""
        return position_windows.unexplained_share(
            self.poses, self.positions, solution.lever_arm, solution.scale
        )

    def without_smoothing(
        self, solution: of_positions.LeverArmSolution
    ) -> tuple[of_positions.LeverArmSolution, FloatArray]:
        """Return the solution, corrected for the estimated smoothing of the positions.

        The second value is the covariance (3, 3), m^2, that possible faults add to the lever arm.
        """
        scaled = solution.scale * self.positions
        fitted = fit_positions(
            self.stamps_ns, self.poses, scaled, solution.lever_arm
        )
        if fitted is None:
            return solution, np.zeros((3, 3))
        smoothing = fitted.smoothing
        by_response = solution.by_response
        # A smoothing c acts like a response of -c.
        lever_arm = solution.lever_arm - smoothing.mean_s2 * by_response
        of_smoothing = smoothing.variance_s4 * np.outer(
            by_response, by_response
        )
        return (
            replace(solution, lever_arm=lever_arm),
            fitted.open_covariance + of_smoothing,
        )

    def child_scale(self, scale: float) -> float:
        """Return the scale of the child that corresponds to a scale of the positions."""
        return scale if self.is_child else 1.0 / scale


def unexplained_path(pose_pairs: PosePairs, config: CalibratorConfig) -> float:
    """Return the share of the positions' path that the best lever arm leaves unexplained."""
    paths = _Paths.of(pose_pairs, config)
    return position_windows.unexplained_at_start(paths.poses, paths.positions)


def estimate_lever_arm(
    pose_pairs: PosePairs, config: CalibratorConfig
) -> Calibration:
    """Solve and assess synchronised poses and positions.

    The result has no frame names. Its rotation is unknown, and set to the identity.

    Parameters
    ----------
    pose_pairs : PosePairs
        Poses on one clock: the time offset of the options is already applied. The orientations of
        the sensor that measures positions are ignored.
    config : CalibratorConfig

    Raises
    ------
    InputError
        If no lever arm explains the positions.
    """
    stamps_ns = pose_pairs.stamps_ns
    paths = _Paths.of(pose_pairs, config)
    # Convert the lever arm of the sensor with positions to the extrinsic and to the child's clock.
    sign = 1.0 if paths.is_child else -1.0
    try:
        solution = paths.solve(config.scale in ("auto", "estimate"))
    except np.linalg.LinAlgError:
        raise InputError(
            "no lever arm fits these positions: they jump, or belong to another body; compare both "
            "paths"
        ) from None
    solution, of_faults = paths.without_smoothing(solution)
    T = se3.from_rotation_translation(np.eye(3), sign * solution.lever_arm)
    assessment = covariance.assess_lever_arm(
        paths.poses, solution, T, solution.covariance, of_faults
    )
    fused = fuse(assessment, config.prior())
    findings = _check_path(solution, fused, paths, "scale" in config.given)
    offset_s = float(config.time_offset)
    if not any(issue.makes_unusable for issue in findings):
        offset_s += sign * solution.time_offset_s
    scale = paths.child_scale(solution.scale)
    return estimation.calibration_of(
        solution,
        fused,
        _step_residuals(solution, paths),
        stamps_ns,
        config,
        reference="increments",
        measured="positions",
        noise=solution.describe(stamps_ns),
        T_method=T,
        covariance_allowance=fused.allowance(_allowance(paths, config)),
        time_offset_s=offset_s,
        time_offset_sigma_s=solution.time_offset_sigma_s,
        scale=config.given_scale * scale,
        scale_sigma=solution.scale_sigma * scale**2,
        findings=findings,
    )


def _allowance(paths: _Paths, config: CalibratorConfig) -> FloatArray:
    """Return the covariance (6, 6) of constant errors, which no recording reveals.

    The reference point of a sensor is uncertain, unless its stream is exact. Poses that are not
    exact add the distance that the sensor travels in ``FLOOR_TRAVEL_S``, as for full poses.
    """
    kind_of_poses = config.parent_kind
    kind_of_positions = config.child_kind
    if not paths.is_child:
        kind_of_poses = config.child_kind
        kind_of_positions = config.parent_kind
    variance = _POINT_M**2
    if kind_of_positions != "exact":
        variance += _POINT_M**2
    if kind_of_poses != "exact":
        speed_m_s = common_mode.usual_speed(
            paths.stamps_ns, se3.translation_of(paths.poses)
        )
        variance += (common_mode.FLOOR_TRAVEL_S * speed_m_s) ** 2
    return variance * np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


def _step_residuals(
    solution: of_positions.LeverArmSolution, paths: _Paths
) -> Residuals:
    """Return the residuals of the distances between consecutive positions.

    A residual is the predicted minus the measured distance (m). It is a vector along the predicted
    step, in the axes of the sensor with poses. So the rotation of the world does not matter.
    """
    rotations = se3.rotation_of(paths.poses)
    steps = np.diff(
        rotations @ solution.lever_arm + se3.translation_of(paths.poses), axis=0
    )
    lengths = np.linalg.norm(steps, axis=1)
    excess = lengths - np.linalg.norm(np.diff(paths.positions, axis=0), axis=1)
    along = (excess / np.maximum(lengths, 1e-12))[:, None] * steps
    is_outlier = solution.jumps | solution.spikes[1:]
    return Residuals(
        translation=se3.times(np.swapaxes(rotations[:-1], 1, 2), along),
        rotation=np.zeros((len(steps), 3)),
        weights=(~is_outlier).astype(float),
        start_ns=paths.stamps_ns[:-1],
        end_ns=paths.stamps_ns[1:],
    )


def _check_path(
    solution: of_positions.LeverArmSolution,
    fused: covariance.Assessment,
    paths: _Paths,
    is_scale_given: bool,
) -> tuple[Finding, ...]:
    """Detect positions with another unit or scale, or on another path than the odometry."""
    share = paths.unexplained_share(solution)
    if share < _SUSPECT_PATH:
        if is_scale_given:
            return ()
        return _check_scale(solution, solution.prior_scale_sigma, paths)
    axes = fused.observability[:3]
    is_observed = any(
        dof.verdict is not DofVerdict.UNOBSERVABLE for dof in axes
    )
    is_near = is_observed and share < _UNRELATED_PATH
    # Does a unit or a scale explain the path?
    with contextlib.suppress(np.linalg.LinAlgError):
        scaled = paths.solve(with_scale=True)
        unexplained = paths.unexplained_share(scaled)
        unit = _check_units(scaled, paths)
        if unit and not is_near and unexplained < _UNRELATED_PATH:
            return (unit,)
        if not is_scale_given and unexplained < min(
            _SUSPECT_PATH, _MENDED_PATH * share
        ):
            return _check_scale(scaled, np.inf, paths)
    share = min(share, 1.0)
    severity = Severity.WARNING if is_near else Severity.ERROR
    return (finding("unrelated_positions", severity=severity, share=share),)


def _check_units(
    solution: of_positions.LeverArmSolution, paths: _Paths
) -> Finding | None:
    """Detect positions or an odometry in another unit of length."""
    scale = paths.child_scale(solution.scale)
    sigma = solution.scale_sigma * (scale / solution.scale)
    odometry = Trajectory(paths.stamps_ns, paths.poses)
    antenna = Trajectory.from_positions(paths.stamps_ns, paths.positions)
    if paths.is_child:
        return in_other_units(scale, sigma, odometry, antenna)
    return in_other_units(scale, sigma, antenna, odometry)


def _check_scale(
    solution: of_positions.LeverArmSolution, prior_sigma: float, paths: _Paths
) -> tuple[Finding, ...]:
    """Detect a scale between the streams that is larger than the error of an odometry.

    The estimate has a prior of 1 with ``prior_sigma``. The effect of this prior is removed here.
    """
    data_share = 1.0 - (solution.scale_sigma / prior_sigma) ** 2
    if data_share < _MIN_DATA_SHARE:
        return ()
    excess = (solution.scale - 1.0) / data_share
    sigma = solution.scale_sigma / data_share**0.5
    if abs(excess) < _SCALE_SIGMAS * sigma:
        return ()
    scale = 1.0 + excess
    if not paths.is_child:
        scale = 1.0 / max(scale, _LEAST_SCALE)
    differs = graded(
        "scale", "child", scale - 1.0, scale=scale, sigma=sigma * scale**2
    )
    return (differs,) if differs else ()


def estimate_rotation(
    pose_pairs: PosePairs, config: CalibratorConfig, cross_check: bool = True
) -> Calibration:
    """Solve and assess synchronised rotations.

    The result has no frame names. Its translation is unknown, and set to zero.

    Parameters
    ----------
    pose_pairs : PosePairs
        Poses on one clock: the time offset of the options is already applied. Positions are
        ignored.
    config : CalibratorConfig
    cross_check : bool
        Whether to compare the result with robust least squares of the same rotations.
    """
    stamps_ns = pose_pairs.stamps_ns
    Ts_pw_p = _rotations_of(pose_pairs.Ts_pw_p)
    as_read = _rotations_of(pose_pairs.Ts_cw_c)
    has_rates = "rates" in (config.parent_measures, config.child_measures)
    solution, Ts_cw_c = _solve_rotation(stamps_ns, Ts_pw_p, as_read, has_rates)
    findings = _check_rotation(Ts_pw_p, Ts_cw_c, solution.T_parent_child)
    rotations = replace(pose_pairs, Ts_pw_p=Ts_pw_p, Ts_cw_c=Ts_cw_c)
    on_one_clock = rotations.child_shifted(solution.time_offset_s)
    of_model = covariance.assess_rotation(Ts_pw_p, solution)
    opinions = second_opinions(
        Ts_pw_p, on_one_clock.Ts_cw_c, solution.T_parent_child
    )
    assessment = of_model
    if not findings:
        open_covariance = _open_covariance(
            on_one_clock, solution.T_parent_child, config
        )
        assessment = widened(of_model, open_covariance)
    solved = estimation.Solved(
        solution=solution,
        assessment=assessment,
        method="adaptive",
        reference="increments",
        measured="rotations",
        pairs=motion_pairs(Ts_pw_p, Ts_cw_c, "B1"),
        weights=(~solution.left_out).astype(float),
        stamps_ns=stamps_ns,
        config=config,
        opinions=opinions,
        excess=excess_covariance(of_model, opinions),
    )
    floor = estimation.floor_of(solved, rotations, config) * np.repeat(
        [0.0, 1.0], 3
    )
    solved = replace(solved, floor=floor)
    checked = cross_checked(solved, config, rotations) if cross_check else None
    result = replace(checked or solved.calibration(), findings=findings)
    if not has_rates:
        return result
    return result.with_part("rate_bias", _rate_bias(solution, config))


def _open_covariance(
    pairs: PosePairs, T_parent_child: FloatArray, config: CalibratorConfig
) -> FloatArray:
    """Return the covariance (6, 6) that possible faults add to the rotation, rad^2.

    The covariance is of a perturbation in the axes of the child. The translation has zeros.
    """
    whole = np.zeros((6, 6))
    rotation = se3.rotation_of(T_parent_child)
    name = measured_stream(config.parent_measures, config.child_measures)
    has_rates = "rates" in (config.parent_measures, config.child_measures)
    fitted = fit_pairs(pairs, rotation, name, has_rates)
    if fitted:
        covariance_of_fit = fitted.axes_covariance
        if name == "parent":
            covariance_of_fit = rotation.T @ covariance_of_fit @ rotation
        whole[3:, 3:] = covariance_of_fit
    return whole


def _rotations_of(Ts: FloatArray) -> FloatArray:
    """Return poses (N, 4, 4) with the same rotations and zero translations."""
    return se3.from_rotation_translation(se3.rotation_of(Ts), np.zeros(3))


def _solve_rotation(
    stamps_ns: IntArray,
    Ts_pw_p: FloatArray,
    Ts_cw_c: FloatArray,
    has_rates: bool,
) -> tuple[adaptive_estimator.AdaptiveSolution, FloatArray]:
    """Estimate the rotation; return the solution, and the child's poses without a rate bias.

    The noise is fitted to increments of up to some seconds. A bias changes them linearly only if it
    is small, so a first solve removes most of it.
    """
    solve = partial(
        adaptive_estimator.solve, stamps_ns, Ts_pw_p, is_clock_free=True
    )
    if not has_rates:
        return solve(Ts_cw_c, increments.SYSTEMATIC_OF_ROTATIONS), Ts_cw_c
    first = solve(Ts_cw_c, increments.SYSTEMATIC_OF_RATES, quick=True)
    Ts_cw_c = increments.without_rate_bias(
        stamps_ns, Ts_cw_c, first.rate_bias[0]
    )
    solution = solve(Ts_cw_c, increments.SYSTEMATIC_OF_RATES)
    parameters = solution.parameters.copy()
    parameters[increments.RATE] += first.parameters[increments.RATE]
    return replace(solution, parameters=parameters), Ts_cw_c


def _rate_bias(
    solution: adaptive_estimator.AdaptiveSolution, config: CalibratorConfig
) -> RateBias:
    """Return the bias of the rates, in the axes of the sensor with the bias.

    Two gyroscopes reveal only the difference of their biases: child minus parent.
    """
    bias, sigmas = solution.rate_bias
    of = (
        "child"
        if config.parent_measures != "rates"
        else "child less parent, child's axes"
    )
    if config.child_measures != "rates":
        rotation = se3.rotation_of(solution.T_parent_child)
        of = "parent"
        bias = -rotation @ bias
        sigmas = np.sqrt(np.diag(rotation @ np.diag(sigmas**2) @ rotation.T))
    return RateBias(
        of=of, rad_per_s=tuple(bias.tolist()), sigma=tuple(sigmas.tolist())
    )


def _check_rotation(
    Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, T_parent_child: FloatArray
) -> tuple[Finding, ...]:
    """Detect streams whose rotations differ too much under the estimated extrinsic."""
    span = min(_SPAN, max(len(Ts_pw_p) // 10, 1))
    pairs = motion_pairs(Ts_pw_p, Ts_cw_c, f"B{span}")
    residuals = np.linalg.norm(pairs.rotation_residuals(T_parent_child), axis=1)
    angles = se3.rotation_angle(se3.rotation_of(pairs.Ts_parenti_parentj))
    is_turning = angles >= np.quantile(angles, TURNING)
    usual_angle = float(np.median(angles[is_turning]))
    share = float(np.median(residuals[is_turning]) / max(usual_angle, 1e-12))
    if share < _UNRELATED_ROTATION:
        return ()
    share = min(share, 1.0)
    return (finding("unrelated_rotations", share=share),)
