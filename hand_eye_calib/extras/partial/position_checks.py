"""Checks of streams with positions of one sensor and poses of the other.

The regression of :mod:`~hand_eye_calib.extras.partial.position_columns` detects a wrong scale of a
coordinate, a delay of a coordinate, and smoothing.
"""

from collections.abc import Collection

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.base.text import length
from hand_eye_calib.core.checks import agreement
from hand_eye_calib.core.checks.agreement import largest_deviation
from hand_eye_calib.core.checks.findings import (
    Finding,
    Severity,
    finding,
    graded,
)
from hand_eye_calib.core.checks.sampling import check_interpolated
from hand_eye_calib.core.checks.stream_pair import MIN_PAIRS
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import PosePairs, synchronise
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.extras.partial.copies import COPIED_SHARE, as_errors, copied
from hand_eye_calib.extras.partial.position_columns import (
    PositionFit,
    fit_positions,
)
from hand_eye_calib.extras.partial.position_windows import unexplained_share
from hand_eye_calib.extras.partial.positions import solve
from hand_eye_calib.extras.partial.suspects import Suspect, most_significant

# A coordinate of a lever arm counts as zero if its size is below this (m).
_ZERO_M = 0.005

# Two housings hardly fit if two coordinates of the lever arm are below this (m). A coordinate is
# compared by its upper bound, which is its size plus two standard deviations.
_HOUSING_M = 0.03
# Largest upper bound (m) of a coordinate that counts as zero. If less than two coordinates are
# below, the lever arm is too uncertain for a finding. If all three are below, the finding can be an
# error.
_UNCERTAIN_M = 0.06

# Positions with a smaller median residual (m) were computed from the poses: no receiver or total
# station measures to a twentieth of a millimetre.
_COPIED_M = 5e-5

# Smoothing is an error, and a late coordinate is reported, above this number of standard
# deviations. A jackknife of at most 16 blocks estimates them, so the ratio has heavy tails.
_CLEAR_SIGMAS = 6.0
# Smoothing is a warning above this number of standard deviations. On a drone it is less certain, so
# the limit is lower: a drone tilts as it accelerates, so that a vertical lever arm acts nearly like
# smoothing.
_LIKELY_SIGMAS = 3.3
# Smallest smoothing of positions (s^2) that is an error: the effect of a filter of 0.13 s. Without
# a filter, streams have up to 0.006 (simulated machines with seeds 77 and 78, and NTU VIRAL).
_SMOOTHING_S2 = 0.008
# Smallest reported delay (s) of a coordinate after the others.
_LAG_S = 0.02
# If positions and poses are on different paths, a fault is reported as the cause only above this
# share of the squared residuals that the faults explain.
_MIN_EXPLAINED_SHARE = 0.6

# A path is mirrored if a lever arm leaves less than this share of the path unexplained after the
# sign of z was changed.
_MAX_UNEXPLAINED_IF_MIRRORED = 0.1


def check_solved(
    parent: Trajectory,
    child: Trajectory,
    calibration: Calibration,
    config: CalibratorConfig,
    is_unrelated: bool = False,
) -> list[Finding]:
    """Check positions and poses against their result.

    Parameters
    ----------
    parent, child : Trajectory
        Streams, each on its own clock.
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
    pairs = synchronise(parent, child, config.max_gap).child_scaled(
        calibration.scale
    )
    if len(pairs) < MIN_PAIRS:
        return []
    stream = "parent" if child.measures == "poses" else "child"
    priors = {*config.prior()}
    measured = {"parent": parent, "child": child}[stream]
    interpolated = check_interpolated(
        se3.translation_of(measured.poses), stream
    )
    return _check_moving(
        pairs, calibration, stream, priors, is_unrelated, interpolated
    )


def _check_moving(
    pairs: PosePairs,
    calibration: Calibration,
    stream: str,
    priors: Collection[str],
    is_unrelated: bool,
    interpolated: list[Finding],
) -> list[Finding]:
    """Check positions against the lever arm; return the findings of the first failed check.

    ``interpolated`` has the findings about interpolated positions.
    """
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
    no_lever_arm = (
        [] if is_unrelated else check_position(lever_arm, sigmas, priors)
    )
    if fitted and _is_copied(fitted, positions):
        # If the lever arm is zero, too, both streams are from one sensor.
        evidence = "The positions agree with the poses to rounding"
        return as_errors(no_lever_arm) or copied(
            evidence, residual_m=fitted.residual
        )
    if findings := [*interpolated, *no_lever_arm]:
        return findings
    if is_unrelated and _is_mirrored(pairs.stamps_ns, poses, positions):
        return [finding("mirrored_positions", stream)]
    if not fitted:
        return [] if is_unrelated else [finding("unchecked", stream)]
    return check_positions(fitted, stream, is_unrelated)


def _is_mirrored(
    stamps_ns: IntArray, poses: FloatArray, positions: FloatArray
) -> bool:
    """Return whether a lever arm explains the positions after the sign of z is changed.

    A change of the sign of x or y leads to the same mirrored path, up to a rotation. So only z is
    tried.
    """
    mirrored = positions * [1.0, 1.0, -1.0]
    try:
        solution = solve(stamps_ns, poses, mirrored)
    except np.linalg.LinAlgError:
        return False
    share = unexplained_share(
        poses, mirrored, solution.lever_arm, solution.scale
    )
    return share < _MAX_UNEXPLAINED_IF_MIRRORED


def _is_copied(fitted: PositionFit, positions: FloatArray) -> bool:
    """Return whether the positions were computed from the poses, because the residuals are tiny."""
    steps = np.diff(positions, axis=0)
    moved_m = median(np.linalg.norm(steps, axis=1))
    return fitted.residual < min(_COPIED_M, COPIED_SHARE * moved_m)


def check_position(
    lever_arm: FloatArray, sigmas: FloatArray, priors: Collection[str]
) -> list[Finding]:
    """Detect a lever arm of zero, a sign that positions were copied between the streams.

    Parameters
    ----------
    lever_arm, sigmas : (3,) array
        Lever arm and its standard deviations (m). Unobservable axes have infinite values.
    priors : collection of str
        Axes with a prior. They are not checked.
    """
    axes = [
        k
        for k, axis in enumerate("xyz")
        if np.isfinite(sigmas[k]) and axis not in priors
    ]
    if len(axes) < 2:
        return []
    lengths_m = np.abs(lever_arm[axes])
    sigmas_m = sigmas[axes]
    limits_m = np.maximum(_ZERO_M, agreement.ZERO_SIGMAS * sigmas_m)
    if (lengths_m > limits_m).any():
        return []
    uppers_m = np.sort(lengths_m + 2.0 * sigmas_m)
    if uppers_m[1] > _UNCERTAIN_M:
        return []
    # Two axes do not suffice for an error: an antenna may be directly above the other sensor.
    is_sure = (
        len(axes) == 3
        and uppers_m[1] < _HOUSING_M
        and uppers_m[2] < _UNCERTAIN_M
    )
    severity = Severity.ERROR if is_sure else Severity.WARNING
    distance_m = float(np.linalg.norm(lengths_m))
    size = f"{length(distance_m)} +/- {length(float(sigmas_m.max()))}"
    return [
        finding(
            "no_lever_arm",
            "both",
            severity,
            size=size,
            translation_m=distance_m,
        )
    ]


def check_positions(
    fitted: PositionFit, stream: str, is_unrelated: bool
) -> list[Finding]:
    """Detect the most significant fault of a stream of positions.

    Parameters
    ----------
    fitted : PositionFit
        The regression of the positions on the columns of all faults.
    stream : {"parent", "child"}
        The stream of positions.
    is_unrelated : bool
        Whether the positions are on another path than the poses. A fault is then reported only if
        it explains this.

    Returns
    -------
    list of Finding
        At most one finding.
    """
    if is_unrelated and fitted.explained_share < _MIN_EXPLAINED_SHARE:
        return []
    suspects = [
        _smoothing(fitted, stream),
        _scale_of_axis(fitted, stream),
        _lag_of_axis(fitted, stream),
    ]
    return most_significant(suspects)


def _smoothing(fitted: PositionFit, stream: str) -> Suspect:
    """Return the test for smoothed positions.

    Significant smoothing is an error: in turns, it biases the lever arm.
    """
    values, sigmas = fitted.estimate("smoothing")
    smoothing_s2 = float(values[0])
    n_sigmas = smoothing_s2 / max(float(sigmas[0]), 1e-12)
    if smoothing_s2 < _SMOOTHING_S2 or n_sigmas < _LIKELY_SIGMAS:
        return Suspect(n_sigmas, None)
    severity = Severity.ERROR if n_sigmas > _CLEAR_SIGMAS else Severity.WARNING
    issue = finding(
        "smoothed",
        stream,
        severity,
        part="positions",
        smoothing_s=smoothing_s2**0.5,
        shift_m=smoothing_s2 * fitted.acceleration_m_s2,
    )
    return Suspect(n_sigmas, issue)


def _scale_of_axis(fitted: PositionFit, stream: str) -> Suspect:
    """Test whether a coordinate has another scale than the others.

    Drift and noise of the odometry reduce the estimated scale of a coordinate that hardly changes.
    If this bias explains a scale that is too small, the scale is not reported. Exception: a
    coordinate that does not change at all was not measured.
    """
    axis, size, sigma = largest_deviation(*fitted.estimate("scales"))
    noise = 3.0 * fitted.residual**2 * (1.0 - fitted.explained_share)
    # Drift of an odometry over the distance from the mean position.
    spurious = (agreement.DRIFT_SHARE * fitted.path_m) ** 2 + noise
    max_bias = agreement.BIASES * spurious / fitted.spreads_m[axis] ** 2
    if -max_bias < size < 0.0 and not fitted.is_constant[axis]:
        return Suspect(0.0, None)
    factor = 1.0 + size
    values = {"axis": "xyz"[axis], "factor": factor, "sigma": sigma}
    return Suspect(
        abs(size) / sigma, graded("axis_scale", stream, size, sigma, **values)
    )


def _lag_of_axis(fitted: PositionFit, stream: str) -> Suspect:
    """Test whether a coordinate is later than the others."""
    axis, lag_s, sigma_s = largest_deviation(*fitted.estimate("delays"))
    n_sigmas = lag_s / sigma_s
    if lag_s < _LAG_S or n_sigmas < _CLEAR_SIGMAS:
        return Suspect(n_sigmas, None)
    shift_m = lag_s * float(fitted.speeds_m_s[axis])
    issue = graded(
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
    return Suspect(n_sigmas, issue)
