"""Comparison of a result with other estimates of the same transform.

The other estimates come from robust least squares: from motions over several strides (numbers of
poses), and from each half of the recording. The scatter of the estimates about the result is
compared with the covariances. Other strides reveal errors that the noise model does not contain,
such as errors with longer correlation times. The halves reveal changes during the recording.
Constant errors remain hidden.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hand_eye_calib.core.assessment.covariance import Assessment
from hand_eye_calib.core.assessment.second_opinion import (
    assess_robust,
    second_opinions,
)
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.config import METHODS, CalibratorConfig
from hand_eye_calib.core.base.stats import MEDIAN_NORMAL, median
from hand_eye_calib.core.engine.estimation import Solved
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.core.pairing.motion_pairs import PosePairs, motion_pairs
from hand_eye_calib.core.results.calibration import Calibration, DofVerdict
from hand_eye_calib.core.results.records import AXES, AxisScatter, CrossCheck
from hand_eye_calib.core.solvers import robust

# Reference of the motions in each half, if the result has no reference.
_REFERENCE_OF_HALVES = "B8"

# Largest number of motion pairs that are used from a half.
_MAX_PAIRS = 3_000

# Smallest number of poses in a half for an estimate.
_MIN_POSES = 20

# Smallest number of other estimates from which a robust standard deviation is computed.
_MIN_OTHERS = 3

# Another estimate counts as about equally certain if its standard deviation is below this multiple
# of the standard deviation of the result.
_AS_CERTAIN = 3.0

# Smallest number of about equally certain estimates from which a robust standard deviation is
# computed.
_MIN_AS_CERTAIN = 2

# Halves are not compared on an axis if their standard deviations differ by more than this factor,
# because noise then causes the smaller one. The factor is 12 to 47 for simulated straight starts of
# 40 s, and 1.1 to 4.0 with curves in both halves.
_MAX_RATIO_OF_HALVES = 5.0

# Smallest standard deviation (m, rad) used as a divisor, for noise-free data.
_ROUNDING = 1e-9


def cross_checked(
    solved: Solved, config: CalibratorConfig, pose_pairs: PosePairs
) -> Calibration:
    """Return the result of a solve with its cross-check.

    If only the result determines an axis, and no other estimate does, the axis becomes weak. With a
    prior on this axis, the prior replaces the estimate from motion.

    Parameters
    ----------
    solved : Solved
    config : CalibratorConfig
        Options of the solve.
    pose_pairs : PosePairs
        Poses of the solve: on one clock, but each stream in its own unit of length.
    """
    result = solved.calibration()
    others = solved.opinions or answers_of_whole(result, pose_pairs)
    halves = answers_of_halves(result, pose_pairs)
    unconfirmed = np.array(AXES)[_unconfirmed(result, others)].tolist()
    replaced = [axis for axis in unconfirmed if axis in config.prior()]
    if replaced:
        result = solved.calibration(replaced)
    observability = []
    for dof in result.observability_measured:
        if dof.name in unconfirmed and dof.verdict is DofVerdict.OBSERVED:
            dof = replace(dof, verdict=DofVerdict.WEAK)
        observability.append(dof)
    # The covariance of the result already contains the excess scatter of the other estimates, so
    # they could never contradict it. Compare with the covariance of the noise model, without the
    # excess.
    of_model = replace(solved, excess=np.zeros((6, 6))).calibration(replaced)
    return replace(
        result,
        observability_measured=tuple(observability),
        cross_check=compare_answers(of_model, others, halves),
    )


def _unconfirmed(
    result: Calibration, others: Sequence[Assessment]
) -> BoolArray:
    """Return a mask (6,) of the axes that only the result determines."""
    # A result with a reference uses the most informative motions. Other motions may determine fewer
    # axes.
    if len(others) < _MIN_OTHERS or METHODS[result.method].uses_reference:
        return np.zeros(len(AXES), dtype=bool)
    of_others = np.array([other.sigmas for other in others])
    is_known = np.isfinite(result.sigmas_measured)
    is_known_to_none = np.isinf(of_others).all(axis=0)
    return is_known & is_known_to_none


def answers_of_whole(
    result: Calibration, pose_pairs: PosePairs
) -> tuple[Assessment, ...]:
    """Estimate X for several strides, with the scale of the result.

    A stride is the number of poses from the start to the end of a motion.
    """
    scaled = pose_pairs.child_scaled(result.scale)
    return second_opinions(
        scaled.Ts_pw_p, scaled.Ts_cw_c, result.T_parent_child
    )


def answers_of_halves(
    result: Calibration, pose_pairs: PosePairs
) -> list[Assessment]:
    """Estimate X from each half of the recording that has enough poses.

    The scale is that of the result. The reference is also that of the result, if it has one.
    """
    scaled = pose_pairs.child_scaled(result.scale)
    middle = len(scaled) // 2
    reference = _REFERENCE_OF_HALVES
    if METHODS[result.method].uses_reference and result.reference[0] in "BC":
        reference = result.reference
    answers = []
    for half in (scaled[:middle], scaled[middle:]):
        if len(half) < _MIN_POSES:
            continue
        pairs = motion_pairs(half.Ts_pw_p, half.Ts_cw_c, reference)
        if len(pairs):
            pairs = pairs[:: math.ceil(len(pairs) / _MAX_PAIRS)]
            answers.append(
                assess_robust(pairs, robust.solve(pairs, result.T_parent_child))
            )
    return answers


def compare_answers(
    calibration: Calibration,
    others: Sequence[Assessment] = (),
    halves: Sequence[Assessment] = (),
) -> CrossCheck:
    """Compare a result with other estimates of the same transform.

    Parameters
    ----------
    calibration : Calibration
    others : sequence of Assessment
        Estimates from the whole recording.
    halves : sequence of Assessment
        Estimates from the first and the second half of the recording. A single estimate is ignored.

    Returns
    -------
    CrossCheck
        Scatter by the name of the axis.
    """
    sigmas = calibration.sigmas_measured
    allowance = calibration.allowance
    differences = np.empty((len(others), 6))
    joint_sigmas = np.empty((len(others), 6))
    for row, other in enumerate(others):
        differences[row], joint_sigmas[row] = _distance_and_sigma(
            calibration.T_parent_child, sigmas, other
        )
    own_sigmas = np.maximum(sigmas, _ROUNDING)
    of_others = np.reshape([other.sigmas for other in others], (-1, 6))
    # Use only estimates that are about as certain as the result.
    is_certain = of_others < _AS_CERTAIN * own_sigmas
    differences_of_certain = np.where(is_certain, differences, np.nan)
    scatter_of_certain = _robust_sigma(differences_of_certain, _MIN_AS_CERTAIN)
    of_halves, excess_of_halves = _scatter_of_halves(calibration, halves)
    columns = {
        "sigma": calibration.sigmas,
        "of_methods": _robust_sigma(differences, _MIN_OTHERS),
        "of_halves": of_halves,
        "excess_of_methods": _robust_sigma(
            differences / np.hypot(joint_sigmas, allowance), _MIN_OTHERS
        ),
        "excess_of_halves": excess_of_halves,
        "excess_over_own": scatter_of_certain / np.hypot(own_sigmas, allowance),
    }
    unconfirmed = _unconfirmed(calibration, others)
    scatter = {}
    for index, axis in enumerate(AXES):
        values: dict[str, float | None] = dict.fromkeys(columns)
        for name, column in columns.items():
            if np.isfinite(sigmas[index]) and np.isfinite(column[index]):
                values[name] = float(column[index])
        scatter[axis] = AxisScatter(
            **values, is_confirmed=not unconfirmed[index]
        )
    return scatter


def _scatter_of_halves(
    calibration: Calibration, halves: Sequence[Assessment]
) -> tuple[FloatArray, FloatArray]:
    """Estimate the standard deviation of a result from the difference between both halves.

    Returns
    -------
    (6,) array
        Standard deviations (m, rad); NaN for axes that are not compared.
    (6,) array
        These standard deviations, divided by those that the covariances predict.
    """
    if len(halves) != 2:
        return np.full(6, np.nan), np.full(6, np.nan)
    first, second = halves
    between, joint = _distance_and_sigma(
        first.T_parent_child, first.sigmas, second
    )
    half_sigmas = np.maximum([first.sigmas, second.sigmas], _ROUNDING)
    limits = _MAX_RATIO_OF_HALVES * half_sigmas.min(axis=0)
    are_alike = half_sigmas.max(axis=0) < limits
    between = np.where(are_alike, between, np.nan)
    # The result is about the mean of both halves. So its standard deviation is half of that of
    # their difference. The covariances of the halves lack the allowance. The sigma of a noise model
    # also contains slow errors, which they lack.
    has_slow_errors = not METHODS[calibration.method].uses_reference
    missing = calibration.sigmas if has_slow_errors else calibration.allowance
    return between / 2, between / 2 / np.hypot(joint / 2, missing)


def _distance_and_sigma(
    T_parent_child: FloatArray, sigmas: FloatArray, other: Assessment
) -> tuple[FloatArray, FloatArray]:
    """Return the distance (6,) of another estimate, and the joint standard deviation (6,).

    Distances and standard deviations (m, rad) are NaN on axes that one of both estimates does not
    determine.
    """
    distance = np.abs(deviation(T_parent_child, other.T_parent_child))
    joint = np.hypot(sigmas, other.sigmas)
    is_known = np.isfinite(joint)
    return (
        np.where(is_known, distance, np.nan),
        np.where(is_known, np.maximum(joint, _ROUNDING), np.nan),
    )


def _robust_sigma(distances: FloatArray, fewest: int) -> FloatArray:
    """Return robust standard deviations (6,) of distances (N, 6), from medians.

    A standard deviation is NaN if its axis has fewer than ``fewest`` finite distances.
    """
    medians = np.full(6, np.nan)
    for axis, column in enumerate(distances.T):
        finite = column[np.isfinite(column)]
        if len(finite) >= fewest:
            medians[axis] = median(finite)
    return medians / MEDIAN_NORMAL
