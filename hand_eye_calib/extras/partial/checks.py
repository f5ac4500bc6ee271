"""Checks of two streams of which one has only positions, only rotations or only angular rates.

Positions: the regression of :mod:`~hand_eye_calib.extras.partial.columns` detects a wrong scale of
a coordinate, a delay of a coordinate, and smoothing.

Rotations and rates: the rotation vectors of the streams, in the parent sensor's frame, fulfil
``y = (I + [phi]_x + S) x + noise``. The antisymmetric part [phi]_x corrects the extrinsic rotation.
The symmetric part S is a fault: gains on its diagonal, misaligned axes off the diagonal (D.
Tedaldi, A. Pretto, E. Menegatti, *A robust and easy to implement method for IMU calibration without
external equipments*, 2014).
"""

from collections.abc import Collection
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.assessment.covariance import BLOCKS
from hand_eye_calib.core.assessment.moved import find_change
from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.stats import median, robust_sigma
from hand_eye_calib.core.base.text import angle, length
from hand_eye_calib.core.checks import agreement
from hand_eye_calib.core.checks.agreement import largest_deviation
from hand_eye_calib.core.checks.findings import (
    LIMITS,
    Finding,
    Severity,
    finding,
    graded,
    gravest_first,
)
from hand_eye_calib.core.checks.response import Regression
from hand_eye_calib.core.checks.sampling import check_interpolated
from hand_eye_calib.core.checks.stream_pair import MAX_ROTATION_RAD, MIN_PAIRS
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.noise.increments import without_rate_bias
from hand_eye_calib.core.pairing.motion_pairs import PosePairs, pairs_over, synchronise
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.extras.partial.position_columns import PositionFit, fit_positions
from hand_eye_calib.extras.partial.positions import solve, unexplained_share

# A lever arm is zero if each axis is below this distance (m) or below ``_ZERO_SIGMAS``.
_ZERO_M = 0.005
# Standard deviations below which a lever arm, or a rotation, is zero.
_ZERO_SIGMAS = 3.0

# A zero lever arm is an error if the upper bounds of two axes are below this distance (m): two
# housings hardly fit closer. An upper bound is the value plus two standard deviations.
_HOUSING_M = 0.03
# Limit of the upper bound of the third axis (m). Without two axes below this limit, the lever arm
# is unknown rather than zero.
_UNKNOWN_M = 0.06

# Median residual (m) below which positions were computed from the poses: no receiver or total
# station measures to a twentieth of a millimetre.
_COPIED_M = 5e-5
# The same limit as a share of the median motion, for slow streams.
_COPIED_SHARE = 0.01

# Median residual (rad) below which rotations were computed from those of the other stream. It
# corresponds to quaternions with five digits.
_COPIED_RAD = 2e-5

# Standard deviations from which on smoothing or a late coordinate is clear. They are those of a
# jackknife of at most 16 blocks, whose distribution has heavy tails.
_CLEAR_SIGMAS = 6.0
# Smallest smoothing of positions that is an error (s^2): that of a filter of 0.13 s. Streams
# without a filter have up to 0.006 (simulated machines with seeds 77 and 78, and NTU VIRAL).
_SMOOTHING_S2 = 0.008
# Drift of an odometry along a coordinate, as a share of the distance.
_DRIFT = 0.02
# Smallest delay of a coordinate against the others (s).
_LAG_S = 0.02
# Share of the squared residuals that faults must explain, to be reported for positions on another
# path than the poses.
_NAMES_UNRELATED = 0.6

# Largest number of motions in a regression of rotations.
_MOST_MOTIONS = 3000

# Rates have left-handed axes if the residual of the best reflection is below this share of the
# residual of the best rotation. Noise alone makes both about equal.
_MIRRORED = 0.5
# Least residual of the best rotation of such rates, as a share of the rotation vectors. If all
# motion is about one axis, a reflection only changes the sign of the noise about the others.
_UNMIRRORED = 0.1

# Share of a mirrored path below which a lever arm explains the path.
_MIRRORED_PATH = 0.1

# Index pairs of the planes between two principal axes.
_PLANES = ((0, 1), (0, 2), (1, 2))


def check_solved(
    parent: Trajectory,
    child: Trajectory,
    calibration: Calibration,
    config: CalibratorConfig,
    is_unrelated: bool = False,
) -> list[Finding]:
    """Check two streams against their result if one stream does not measure full poses.

    Parameters
    ----------
    parent, child : Trajectory
        Each on its own clock.
    calibration : Calibration
        The result from both streams.
    config : CalibratorConfig
        The options of that result.
    is_unrelated : bool
        Whether positions are on another path than the poses.

    Returns
    -------
    list of Finding
    """
    child = child.shifted(calibration.time_offset_s)
    pairs = synchronise(parent, child, config.max_gap).child_scaled(calibration.scale)
    if len(pairs) < MIN_PAIRS:
        return []
    stream = "parent" if child.measures == "poses" else "child"
    priors = {*config.prior()}
    if calibration.measured == "rotations":
        has_rates = "rates" in (parent.measures, child.measures)
        return _check_turning(pairs, calibration, stream, priors, has_rates)
    measured = {"parent": parent, "child": child}[stream]
    interpolated = check_interpolated(se3.translation_of(measured.poses), stream)
    return _check_moving(pairs, calibration, stream, priors, is_unrelated, interpolated)


def _check_turning(
    pairs: PosePairs,
    calibration: Calibration,
    stream: str,
    priors: Collection[str],
    has_rates: bool,
) -> list[Finding]:
    """Check rotations or rates; return the findings of the first check that has any."""
    T_parent_child = calibration.T_parent_child
    sigmas = calibration.sigmas_measured[3:]
    parallel = check_rotation(se3.rotation_of(T_parent_child), sigmas, priors, has_rates)
    if copied := _copied_rotations(pairs, T_parent_child):
        return _as_errors(parallel) or copied
    if findings := parallel or _check_handedness(pairs, stream):
        return findings
    return check_rotations(_without_bias(pairs, calibration), T_parent_child, stream, has_rates)


def _check_moving(
    pairs: PosePairs,
    calibration: Calibration,
    stream: str,
    priors: Collection[str],
    is_unrelated: bool,
    interpolated: list[Finding],
) -> list[Finding]:
    """Check positions; return the findings of the first check that has any."""
    lever_arm = se3.translation_of(calibration.T_parent_child)
    sigmas = calibration.sigmas_measured[:3]
    if stream == "child":
        poses = pairs.Ts_pw_p
        positions = se3.translation_of(pairs.Ts_cw_c)
        fitted = fit_positions(pairs.stamps_ns, poses, positions, lever_arm)
    else:
        poses = pairs.Ts_cw_c
        positions = se3.translation_of(pairs.Ts_pw_p)
        fitted = fit_positions(pairs.stamps_ns, poses, positions, -lever_arm)
    no_lever_arm = [] if is_unrelated else check_position(lever_arm, sigmas, priors)
    if fitted and _is_copied(fitted, positions):
        copied = "The positions agree with the poses to rounding"
        return _as_errors(no_lever_arm) or _copied(copied, residual_m=fitted.residual)
    if findings := [*interpolated, *no_lever_arm]:
        return findings
    if is_unrelated and _is_mirrored(pairs.stamps_ns, poses, positions):
        return [finding("mirrored_positions", stream)]
    if not fitted:
        return [] if is_unrelated else [finding("unchecked", stream)]
    return check_positions(fitted, stream, is_unrelated)


def _is_mirrored(stamps_ns: IntArray, poses: FloatArray, positions: FloatArray) -> bool:
    """Return whether a lever arm explains positions only if one coordinate has the other sign."""
    mirrored = positions * [1.0, 1.0, -1.0]
    try:
        solution = solve(stamps_ns, poses, mirrored)
    except np.linalg.LinAlgError:
        return False
    share = unexplained_share(poses, mirrored, solution.lever_arm, solution.scale)
    return share < _MIRRORED_PATH


def _is_copied(fitted: PositionFit, positions: FloatArray) -> bool:
    """Return whether positions were computed from the poses: only rounding differs."""
    moved_m = median(np.linalg.norm(np.diff(positions, axis=0), axis=1))
    return fitted.residual < min(_COPIED_M, _COPIED_SHARE * moved_m)


def _as_errors(findings: list[Finding]) -> list[Finding]:
    """Return the same findings as errors."""
    return [replace(suspect, severity=Severity.ERROR) for suspect in findings]


def _without_bias(pairs: PosePairs, calibration: Calibration) -> PosePairs:
    """Remove the estimated gyroscope bias from pose pairs."""
    rate_bias = calibration.parts.get("rate_bias")
    if not rate_bias:
        return pairs
    bias = np.array(rate_bias.rad_per_s)
    if rate_bias.of == "parent":
        return replace(pairs, Ts_pw_p=without_rate_bias(pairs.stamps_ns, pairs.Ts_pw_p, bias))
    return replace(pairs, Ts_cw_c=without_rate_bias(pairs.stamps_ns, pairs.Ts_cw_c, bias))


def check_position(
    lever_arm: FloatArray, sigmas: FloatArray, priors: Collection[str]
) -> list[Finding]:
    """Detect a lever arm of zero, which suggests that positions were copied between the streams.

    Parameters
    ----------
    lever_arm, sigmas : (3,) array
        Lever arm and its standard deviations (m), infinite for unobservable axes.
    priors : collection of str
        Axes with a prior; they are not checked.
    """
    axes = [k for k, axis in enumerate("xyz") if np.isfinite(sigmas[k]) and axis not in priors]
    if len(axes) < 2:
        return []
    lengths_m = np.abs(lever_arm[axes])
    sigmas_m = sigmas[axes]
    if (lengths_m > np.maximum(_ZERO_M, _ZERO_SIGMAS * sigmas_m)).any():
        return []
    uppers_m = np.sort(lengths_m + 2.0 * sigmas_m)
    if uppers_m[1] > _UNKNOWN_M:
        return []
    # Two axes are not enough for an error: an antenna may be right above the other sensor.
    is_sure = len(axes) == 3 and uppers_m[1] < _HOUSING_M and uppers_m[2] < _UNKNOWN_M
    severity = Severity.ERROR if is_sure else Severity.WARNING
    distance_m = float(np.linalg.norm(lengths_m))
    size = f"{length(distance_m)} +/- {length(float(sigmas_m.max()))}"
    return [finding("no_lever_arm", "both", severity, size=size, translation_m=distance_m)]


def check_rotation(
    rotation: FloatArray, sigmas: FloatArray, priors: Collection[str], has_rates: bool
) -> list[Finding]:
    """Detect a rotation of zero, which suggests that both streams come from one sensor.

    Parameters
    ----------
    rotation : (3, 3) array
    sigmas : (3,) array
        Standard deviations (rad), infinite for unobservable axes.
    priors : collection of str
        Axes with a prior. With a prior about a rotation, nothing is checked.
    has_rates : bool
        Whether a stream has rates. The finding is an error then, otherwise a warning: the axes of
        two cameras may well be parallel.
    """
    limit_rad = agreement.MAX_SIGMA_RAD
    # The standard deviations must be small on all axes: if two level sensors turn only about the
    # vertical, yaw is unobservable, and roll and pitch are zero for any two sensors.
    if {"roll", "pitch", "yaw"} & {*priors} or not sigmas.max() < limit_rad:
        return []
    angles_rad = np.abs(se3.rotation_log(rotation))
    if (angles_rad > np.maximum(agreement.SAME_RAD, _ZERO_SIGMAS * sigmas)).any():
        return []
    angle_rad = float(np.linalg.norm(angles_rad))
    severity = Severity.ERROR if has_rates else Severity.WARNING
    return [finding("parallel_axes", "both", severity, size=angle(angle_rad), angle_rad=angle_rad)]


def check_positions(fitted: PositionFit, stream: str, is_unrelated: bool) -> list[Finding]:
    """Detect the fault of a stream of positions that is most significant.

    Parameters
    ----------
    fitted : PositionFit
        The regression of the positions on the columns of all faults.
    stream : {"parent", "child"}
        The stream of positions.
    is_unrelated : bool
        Whether the positions are on another path than the poses. A fault is reported then only if
        it explains why.

    Returns
    -------
    list of Finding
        At most one finding.
    """
    if is_unrelated and fitted.explained_share < _NAMES_UNRELATED:
        return []
    suspects = [
        _smoothing(fitted, stream),
        _scale_of_axis(fitted, stream),
        _lag_of_axis(fitted, stream),
    ]
    ranked = sorted(suspects, key=lambda suspect: suspect.sigmas, reverse=True)
    return [suspect.found for suspect in ranked if suspect.found][:1]


class _Suspect(NamedTuple):
    """A fault that is possible: its size in standard deviations, and its finding if it is clear."""

    sigmas: float
    found: Finding | None


def _smoothing(fitted: PositionFit, stream: str) -> _Suspect:
    """Return how clear it is that positions are smoothed.

    Smoothed positions are an error, because the lever arm follows from the positions in turns.
    """
    values, sigmas = fitted.estimate("smoothing")
    smoothing_s2 = float(values[0])
    n_sigmas = smoothing_s2 / max(float(sigmas[0]), 1e-12)
    if smoothing_s2 < _SMOOTHING_S2 or n_sigmas < _CLEAR_SIGMAS:
        return _Suspect(n_sigmas, None)
    found = finding(
        "smoothed",
        stream,
        Severity.ERROR,
        part="positions",
        smoothing_s=smoothing_s2**0.5,
        shift_m=smoothing_s2 * fitted.acceleration_m_s2,
    )
    return _Suspect(n_sigmas, found)


def _scale_of_axis(fitted: PositionFit, stream: str) -> _Suspect:
    """Return how clear it is that a coordinate has another scale than the others.

    Drift and noise of the odometry along a coordinate that hardly changes shrink its factor. A
    coordinate that does not change at all was not measured.
    """
    axis, size, sigma = largest_deviation(*fitted.estimate("scales"))
    noise = 3.0 * fitted.residual**2 * (1.0 - fitted.explained_share)
    spurious = (_DRIFT * fitted.path_m) ** 2 + noise
    shrinks = agreement.BIASES * spurious / fitted.spreads_m[axis] ** 2
    if abs(size) < shrinks and not fitted.is_constant[axis]:
        return _Suspect(0.0, None)
    factor = 1.0 + size
    values = {"axis": "xyz"[axis], "factor": factor, "sigma": sigma}
    return _Suspect(abs(size) / sigma, graded("axis_scale", stream, size, sigma, **values))


def _lag_of_axis(fitted: PositionFit, stream: str) -> _Suspect:
    """Return how clear it is that a coordinate is late against the others."""
    axis, lag_s, sigma_s = largest_deviation(*fitted.estimate("delays"))
    n_sigmas = lag_s / sigma_s
    if lag_s < _LAG_S or n_sigmas < _CLEAR_SIGMAS:
        return _Suspect(n_sigmas, None)
    shift_m = lag_s * float(fitted.speeds_m_s[axis])
    found = graded(
        "late",
        stream,
        shift_m,
        delay_s=lag_s,
        sigma_s=sigma_s,
        shift_m=shift_m,
        code="axis_lag",
        part=f"{'xyz'[axis]} coordinates",
        others="others",
    )
    return _Suspect(n_sigmas, found)


def _copied(evidence: str, **residual: Any) -> list[Finding]:
    """Return the finding that one stream was computed from the other."""
    return [finding("not_independent", "both", Severity.ERROR, evidence=evidence, **residual)]


def _copied_rotations(pairs: PosePairs, T_parent_child: FloatArray) -> list[Finding]:
    """Detect rotations that were computed from the other stream: only rounding differs."""
    of_parent, of_child = _rotation_vectors(pairs)
    if len(of_parent) < MIN_PAIRS:
        return []
    residuals = of_child @ se3.rotation_of(T_parent_child).T - of_parent
    residual_rad = median(np.linalg.norm(residuals, axis=1))
    usual_rad = median(np.linalg.norm(of_parent, axis=1))
    if residual_rad > min(_COPIED_RAD, _COPIED_SHARE * usual_rad):
        return []
    return _copied("The rotations of both streams agree to rounding", residual_rad=residual_rad)


def check_rotations(
    pairs: PosePairs, T_parent_child: FloatArray, stream: str, has_rates: bool
) -> list[Finding]:
    """Check rotations for a moved mount and, with rates, for wrong gains and misaligned axes.

    Parameters
    ----------
    pairs : PosePairs
        On one clock and without gyroscope bias. The positions are ignored.
    T_parent_child : (4, 4) array
    stream : {"parent", "child"}
        The stream of rotations or rates, which a finding names.
    has_rates : bool
        Whether a stream has rates. Orientations come from an odometry or a filter, which has no
        sensor axes to misalign: only a moved mount is checked then.

    Returns
    -------
    list of Finding
        At most one finding.
    """
    rotation = se3.rotation_of(T_parent_child)
    of_parent, of_child = _rotation_vectors(pairs)
    if len(of_parent) < BLOCKS * MIN_PAIRS:
        return []
    still = np.zeros(3)
    turning = PosePairs(
        pairs.stamps_ns,
        se3.from_rotation_translation(se3.rotation_of(pairs.Ts_pw_p), still),
        se3.from_rotation_translation(se3.rotation_of(pairs.Ts_cw_c), still),
    )
    change = find_change(turning, se3.from_rotation_translation(rotation, still))
    moved = agreement.moved_mount(change, int(pairs.stamps_ns[0])) if change else None
    if moved:
        return [moved]
    if not has_rates:
        return []
    suspects = _matrix_suspects(of_parent, of_child @ rotation.T, stream)
    findings = gravest_first([suspect for suspect in suspects if suspect])
    return [*findings[:1]]


def _rotation_vectors(pairs: PosePairs) -> tuple[FloatArray, FloatArray]:
    """Rotation vectors (K, 3) of parent and child over 1 s, each in its own sensor frame."""
    motions = pairs_over(pairs, agreement.SHORT_S, _MOST_MOTIONS)
    of_parent = se3.rotation_log(se3.rotation_of(motions.Ts_parenti_parentj))
    of_child = se3.rotation_log(se3.rotation_of(motions.Ts_childi_childj))
    angles = np.maximum(np.linalg.norm(of_parent, axis=1), np.linalg.norm(of_child, axis=1))
    is_usable = angles < MAX_ROTATION_RAD
    return of_parent[is_usable], of_child[is_usable]


def _check_handedness(pairs: PosePairs, stream: str) -> list[Finding]:
    """Detect rates about left-handed axes: a reflection fits far better than any rotation."""
    of_parent, of_child = _rotation_vectors(pairs)
    if len(of_parent) < BLOCKS * MIN_PAIRS:
        return []
    # Subtract the mean, which contains the bias: a wrong rotation spoils the estimate of the bias.
    of_parent = of_parent - of_parent.mean(axis=0)
    of_child = of_child - of_child.mean(axis=0)
    left, _, right = np.linalg.svd(of_child.T @ of_parent)
    rotating = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
    mirroring = rotating * [1.0, 1.0, -1.0]
    residuals_rad = []
    for signs in (rotating, mirroring):
        errors = of_child @ left @ signs @ right - of_parent
        residuals_rad.append(median(np.linalg.norm(errors, axis=1)))
    by_rotation, by_mirror = residuals_rad
    usual = median(np.linalg.norm(of_parent, axis=1))
    is_mirrored = by_mirror < _MIRRORED * by_rotation and by_rotation > _UNMIRRORED * usual
    return [finding("mirrored_rates", stream)] if is_mirrored else []


def _matrix_suspects(
    of_parent: FloatArray, of_child: FloatArray, stream: str
) -> list[Finding | None]:
    """Detect misaligned axes and wrong gains of a stream of rotations or rates.

    Parameters
    ----------
    of_parent, of_child : (K, 3) array
        Rotation vectors of both sensors, in the parent sensor's frame.
    stream : {"parent", "child"}
        The stream of rotations or rates. Its rotation vectors are the regressors, because a
        gyroscope has less noise.

    Notes
    -----
    The regression estimates 3 small rotations, which correct the extrinsic, 3 gains along the
    principal axes of rotation, and 3 elements of the symmetric part off the diagonal.
    """
    if stream == "child":
        reference = of_child
        measured = of_parent
    else:
        reference = of_parent
        measured = of_child
    axes = np.linalg.eigh(reference.T @ reference)[1][:, ::-1]
    x = reference @ axes
    y = measured @ axes
    gains = x[:, None, :] * np.eye(3)
    shears = np.zeros((len(x), 3, 3))
    for column, (k, m) in enumerate(_PLANES):
        shears[:, k, column] = x[:, m]
        shears[:, m, column] = x[:, k]
    rows = np.concatenate([se3.skew(x), gains, shears, (y - x)[:, :, None]], axis=2)
    where = {"rotation": [0, 1, 2], "gain": [3, 4, 5], "shear": [6, 7, 8]}
    unit = np.full((3, 1), max(float(robust_sigma(y - x)), 1e-8))
    fit = Regression(rows, rows, unit, where, "rotation")
    gain = agreement.rotation_gain(fit, axes, inverse=stream == "child")
    return [_shear(fit, stream), gain]


def _shear(fit: Regression, stream: str) -> Finding | None:
    """Detect sensor axes that are not perpendicular."""
    values, sigmas = fit.fit("shear", "gain")
    limits = agreement.BIASES * fit.biases("shear")
    significant = np.where(
        np.abs(values) > np.maximum(LIMITS["misaligned"].sigmas * sigmas, limits), values, 0
    )
    size = float(np.abs(significant).max())
    # If the symmetric part is s, the angle between two axes is wrong by 2 s.
    degrees = float(np.degrees(2.0 * size))
    return graded("misaligned", stream, size, degrees=degrees)
