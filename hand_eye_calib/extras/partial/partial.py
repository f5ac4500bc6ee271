"""From streams of which one gives only a part of its poses to a calibration.

Positions beside poses: the lever arm. By convention the sensor that measures positions has the axes
of the other one; the rotation is out of reach. Rotations, or angular rates: the rotation, and the
bias of a gyroscope. The adaptive estimator sees trajectories that never leave their origins: what
it finds for the rotation does not depend on the rest. Of both: the time offset.
"""

import contextlib
from dataclasses import replace
from functools import partial

import numpy as np

from hand_eye_calib.core.assessment import covariance
from hand_eye_calib.core.assessment.prior import fuse
from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.checks.check import in_other_units
from hand_eye_calib.core.checks.findings import Finding, Severity, finding, graded
from hand_eye_calib.core.engine import estimation
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.noise import estimator as adaptive_estimator
from hand_eye_calib.core.noise import increments
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, PosePairs, motion_pairs
from hand_eye_calib.core.results.calibration import Calibration, DofVerdict
from hand_eye_calib.core.results.records import Residuals
from hand_eye_calib.extras.partial import positions as of_positions
from hand_eye_calib.extras.partial.rate_bias import RateBias

# Shares of the path, or of the rotation, that stay unexplained. Of one body it is 0.05 of the path
# at most, of two 0.5 and more.
_SUSPECT_PATH = 0.1
_UNRELATED_PATH = 0.3
_UNRELATED_ROTATION = 0.5

# Poses between the ends of the motions that tell how much of the rotation is explained; the
# quantile of their angles above which they count.
_SPAN = 10
_TURNING = 0.75

# Rates in degrees instead of radians are off by that factor, within this share of it.
_UNIT_WITHIN = 0.2

# A scale mends a path if it leaves less than this share of what remains without it.
_MENDED_PATH = 0.5

# A scale between the streams must exceed so many of its standard deviations, and the data must
# know it better than the expectation of the model (share of the information).
_SCALE_SIGMAS = 5.0
_SHOWN_SCALE = 0.5
_LEAST_SCALE = 1e-3

# Standard deviation (m) along each axis of where the frame of an odometry is, and of where an
# antenna or a prism measures.
_POINT_M = 0.005


def estimate_lever_arm(pose_pairs: PosePairs, config: CalibratorConfig) -> Calibration:
    """Solve and assess synchronised poses and positions, on one clock: a result without frame names
    whose rotation is the identity, and unknown. Of the sensor that measures positions, orientations
    are not looked at. The poses already have the time offset of the options, in seconds.

    Raises
    ------
    InputError
        If no lever arm explains the positions.
    """
    stamps_ns = pose_pairs.stamps_ns
    is_child = config.child_measures == "positions"
    given = config.given_scale
    of_parent = pose_pairs.Ts_pw_p
    of_child = pose_pairs.child_scaled(given).Ts_cw_c
    poses, measured = (of_parent, of_child) if is_child else (of_child, of_parent)
    positions = measured[:, :3, 3]
    with_scale = config.scale in ("auto", "estimate")
    try:
        solution = of_positions.solve(stamps_ns, poses, positions, with_scale)
    except np.linalg.LinAlgError:
        raise InputError(
            "no lever arm fits these positions: they jump, or belong to another body; compare both "
            "paths"
        ) from None
    sign = 1.0 if is_child else -1.0
    T = se3.from_rotation_translation(np.eye(3), sign * solution.lever_arm)
    assessment = covariance.assess_lever_arm(poses, solution, T, solution.covariance)
    fused = fuse(assessment, config.prior())
    is_scale_given = "scale" in config.given
    findings = _of_path(solution, fused, stamps_ns, poses, positions, is_child, is_scale_given)
    scale = solution.scale if is_child else 1.0 / solution.scale
    # What does not explain the positions has no time offset either.
    is_usable = not any(each.makes_unusable for each in findings)
    offset_s = float(config.time_offset) + (sign * solution.time_offset_s if is_usable else 0.0)
    kinds = config.parent_kind, config.child_kind
    of_poses, of_antenna = kinds if is_child else kinds[::-1]
    allowance = _allowance(stamps_ns, poses, of_poses, of_antenna)
    return estimation.calibration_of(
        solution,
        fused,
        _steps(solution, stamps_ns, poses, positions),
        stamps_ns,
        config,
        reference="increments",
        measured="positions",
        noise=solution.describe(stamps_ns),
        T_method=T,
        covariance_allowance=fused.allowance(allowance),
        time_offset_s=offset_s,
        time_offset_sigma_s=solution.time_offset_sigma_s,
        scale=given * scale,
        scale_sigma=solution.scale_sigma * scale**2,
        findings=findings,
    )


def _allowance(
    stamps_ns: IntArray, poses: FloatArray, kind_of_poses: str, kind_of_positions: str
) -> FloatArray:
    """Return the covariance (6, 6) of errors that no recording shows.

    The point that each sensor measures is uncertain, unless the positions are exact. An odometry
    adds its travel in ``FLOOR_TRAVEL_S``, as for poses.
    """
    variance = _POINT_M**2
    if kind_of_positions != "exact":
        variance += _POINT_M**2
    if kind_of_poses != "exact":
        speed_m_s = covariance.usual_speed(stamps_ns, poses[:, :3, 3])
        variance += (covariance.FLOOR_TRAVEL_S * speed_m_s) ** 2
    return variance * np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


def _steps(
    solution: of_positions.LeverArmSolution,
    stamps_ns: IntArray,
    poses: FloatArray,
    positions: FloatArray,
) -> Residuals:
    """Residuals of the steps between positions, along the axes of the sensor with poses."""
    steps = np.diff(poses[:, :3, :3] @ solution.lever_arm + poses[:, :3, 3], axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    excess = lengths - np.linalg.norm(np.diff(positions, axis=0), axis=1)
    along = (excess / np.maximum(lengths, 1e-12))[:, None] * steps
    return Residuals(
        translation=se3.times(np.swapaxes(poses[:-1, :3, :3], 1, 2), along),
        rotation=np.zeros((len(steps), 3)),
        weights=(~(solution.jumps | solution.spikes[1:])).astype(float),
        start_ns=stamps_ns[:-1],
        end_ns=stamps_ns[1:],
    )


def _other_units(
    scale: float,
    sigma: float,
    stamps_ns: IntArray,
    poses: FloatArray,
    positions: FloatArray,
    is_child: bool,
) -> Finding | None:
    """The finding that the positions or the odometry are in other units, or None. ``is_child`` if
    the positions are the child's.
    """
    odometry = Trajectory(stamps_ns, poses)
    antenna = Trajectory.from_positions(stamps_ns, positions)
    if is_child:
        return in_other_units(scale, sigma, odometry, antenna)
    return in_other_units(scale, sigma, antenna, odometry)


def _of_path(
    solution: of_positions.LeverArmSolution,
    fused: covariance.Assessment,
    stamps_ns: IntArray,
    poses: FloatArray,
    positions: FloatArray,
    is_child: bool,
    is_scale_given: bool,
) -> tuple[Finding, ...]:
    """A finding if the path of the positions is not that of the odometry, or in other units."""
    share = of_positions.unexplained_share(poses, positions, solution.lever_arm, solution.scale)
    if share < _SUSPECT_PATH:
        expected = solution.model.tuning.of_positions[3]
        return () if is_scale_given else _of_scale(solution, expected, is_child)
    axes = fused.observability[:3]
    is_known = any(dof.verdict is not DofVerdict.UNOBSERVABLE for dof in axes)
    is_near = is_known and share < _UNRELATED_PATH
    with contextlib.suppress(np.linalg.LinAlgError):
        scaled = of_positions.solve(stamps_ns, poses, positions, True)
        left = of_positions.unexplained_share(poses, positions, scaled.lever_arm, scaled.scale)
        scale = scaled.scale if is_child else 1.0 / scaled.scale
        sigma = scaled.scale_sigma * (scale / scaled.scale)
        unit = _other_units(scale, sigma, stamps_ns, poses, positions, is_child)
        if unit and not is_near and left < _UNRELATED_PATH:
            return (unit,)
        if not is_scale_given and left < min(_SUSPECT_PATH, _MENDED_PATH * share):
            return _of_scale(scaled, scaled.model.tuning.any_scale, is_child)
    share = min(share, 1.0)
    severity = Severity.WARNING if is_near else Severity.ERROR
    text = f"{share:.0%} of the motion of the positions is not that of the odometry"
    return (finding("unrelated", severity=severity, share=share, text=text),)


def _of_scale(
    solution: of_positions.LeverArmSolution, expected: float, is_child: bool
) -> tuple[Finding, ...]:
    """A finding if one stream's lengths differ from the other's by more than an odometry may have.

    The model expects a scale near 1 within ``expected``. That expectation is taken out.
    """
    shown = 1.0 - (solution.scale_sigma / expected) ** 2
    if shown < _SHOWN_SCALE:
        return ()
    excess = (solution.scale - 1.0) / shown
    sigma = solution.scale_sigma / shown**0.5
    scale = 1.0 + excess if is_child else 1.0 / max(1.0 + excess, _LEAST_SCALE)
    if abs(excess) < _SCALE_SIGMAS * sigma:
        return ()
    differs = graded("scale", "child", scale - 1.0, scale=scale, sigma=sigma * scale**2)
    return (differs,) if differs else ()


def estimate_rotation(
    pose_pairs: PosePairs, config: CalibratorConfig, cross_check: bool = True
) -> Calibration:
    """Solve and assess synchronised rotations on one clock.

    The result has no frame names, and a translation of zero, which is unknown: positions do not
    count. The poses already have the time offset of the options, in seconds. With a
    ``cross_check`` the result is compared with DNLO's answers from the same rotations.
    """
    Ts_pw_p, as_read = (
        se3.from_rotation_translation(Ts[:, :3, :3], np.zeros((len(Ts), 3)))
        for Ts in (pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c)
    )
    stamps_ns = pose_pairs.stamps_ns
    has_rates = "rates" in (config.parent_measures, config.child_measures)
    solution, Ts_cw_c = _rotation(stamps_ns, Ts_pw_p, as_read, has_rates)
    findings = _of_rotation(Ts_pw_p, Ts_cw_c, solution.T_parent_child)
    if findings and has_rates:
        findings = _rate_unit(motion_pairs(Ts_pw_p, as_read, "B1"), config) or findings
    rotations = replace(pose_pairs, Ts_pw_p=Ts_pw_p, Ts_cw_c=Ts_cw_c)
    solved = estimation.Solved(
        solution=solution,
        assessment=covariance.assess_rotation(Ts_pw_p, solution),
        method="adaptive",
        reference="increments",
        measured="rotations",
        pairs=motion_pairs(Ts_pw_p, Ts_cw_c, "B1"),
        weights=(~solution.jumps).astype(float),
        stamps_ns=stamps_ns,
        config=config,
    )
    floor = estimation.floor_of(solved, rotations, config) * np.repeat([0.0, 1.0], 3)
    solved = replace(solved, floor=floor)
    checked = estimation.cross_checked(solved, config, rotations) if cross_check else None
    rate_bias = _rate_bias(solution, config) if has_rates else None
    result = replace(checked or solved.calibration(), findings=findings)
    return result.with_part("rate_bias", rate_bias) if rate_bias else result


def _rotation(
    stamps_ns: IntArray, Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, has_rates: bool
) -> tuple[adaptive_estimator.AdaptiveSolution, FloatArray]:
    """The solution, and the child's poses without the bias of the rates.

    The noise is fitted to increments of up to some seconds. What a bias does to these is linear
    only for what is left of it after a first solve.
    """
    solve = partial(adaptive_estimator.solve, stamps_ns, Ts_pw_p, is_clock_free=True)
    if not has_rates:
        return solve(Ts_cw_c, increments.SYSTEMATIC_OF_ROTATIONS), Ts_cw_c
    first = solve(Ts_cw_c, increments.SYSTEMATIC_OF_RATES, quick=True)
    Ts_cw_c = increments.without_rate_bias(stamps_ns, Ts_cw_c, first.rate_bias[0])
    solution = solve(Ts_cw_c, increments.SYSTEMATIC_OF_RATES)
    parameters = solution.parameters.copy()
    parameters[increments.RATE] += first.parameters[increments.RATE]
    return replace(solution, parameters=parameters), Ts_cw_c


def _rate_bias(solution: adaptive_estimator.AdaptiveSolution, config: CalibratorConfig) -> RateBias:
    """The bias of the rates, in the axes of the sensor that has it.

    Of two gyroscopes only the difference of the biases shows, the child's less the parent's.
    """
    bias, sigmas = solution.rate_bias
    of = "child" if config.parent_measures != "rates" else "child less parent, child's axes"
    if config.child_measures != "rates":
        rotation = solution.T_parent_child[:3, :3]
        of = "parent"
        bias = -rotation @ bias
        sigmas = np.sqrt(np.diag(rotation @ np.diag(sigmas**2) @ rotation.T))
    return RateBias(of=of, rad_per_s=tuple(bias.tolist()), sigma=tuple(sigmas.tolist()))


def _of_rotation(
    Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, T_parent_child: FloatArray
) -> tuple[Finding, ...]:
    """A finding if the rotations of one stream do not explain those of the other."""
    span = min(_SPAN, max(len(Ts_pw_p) // 10, 1))
    pairs = motion_pairs(Ts_pw_p, Ts_cw_c, f"B{span}")
    left = np.linalg.norm(pairs.residuals(T_parent_child)[1], axis=1)
    turned = se3.rotation_angle(pairs.Ts_parenti_parentj[:, :3, :3])
    most = turned >= np.quantile(turned, _TURNING)  # a sensor may stand still for long
    share = float(np.median(left[most]) / max(float(np.median(turned[most])), 1e-12))
    if share < _UNRELATED_ROTATION:
        return ()
    share = min(share, 1.0)
    text = f"{share:.0%} of the rotation of one sensor is not that of the other"
    return (finding("unrelated", share=share, text=text),)


def _rate_unit(steps: MotionPairs, config: CalibratorConfig) -> tuple[Finding, ...]:
    """A finding if the rates of one stream are in degrees and those of the other in radians."""
    of_parent, of_child = (
        max(float(np.quantile(se3.rotation_angle(Ts[:, :3, :3]), _TURNING)), 1e-12)
        for Ts in (steps.Ts_parenti_parentj, steps.Ts_childi_childj)
    )
    stream = "child"
    ratio = of_child / of_parent
    degrees = float(np.degrees(1.0))
    if config.child_measures != "rates":
        stream = "parent"
        ratio = of_parent / of_child
    if min(abs(ratio / degrees - 1.0), abs(ratio * degrees - 1.0)) >= _UNIT_WITHIN:
        return ()
    unit, read_as = ("deg/s", "rad/s") if ratio > 1.0 else ("rad/s", "deg/s")
    return (finding("rate_unit", stream, ratio=ratio, unit=unit, read_as=read_as),)
