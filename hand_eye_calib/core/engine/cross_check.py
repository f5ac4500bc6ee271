"""Comparison of a result with other answers to the same question.

The other answers are DNLO's: at a few references, and from each half of the recording. The scatter
of the answers about the result is compared with what their covariances allow. Other references
reveal what the noise model misses, such as errors with longer correlation times than it assumes.
The halves reveal what changes during the recording. Neither reveals a constant error.
"""

import contextlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.config import METHODS, CalibratorConfig
from hand_eye_calib.core.base.errors import HandEyeCalibError
from hand_eye_calib.core.base.stats import MEDIAN_NORMAL, median
from hand_eye_calib.core.engine.estimation import Solved, solve_poses
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import Calibration, DofVerdict
from hand_eye_calib.core.results.records import AXES, AxisScatter, CrossCheck

# Method of the other answers: the fastest that rejects outliers.
_METHOD = "dnlo"

# References of the other answers: B1, B3, B8 and B20.
_BASELINES = (1, 3, 8, 20)

# Baseline of the halves if the result has no reference of its own.
_BASELINE_OF_HALVES = 8

# Largest number of poses of another answer; longer recordings are thinned out.
_MOST_POSES = 3_000

# Smallest number of poses of another answer.
_MIN_POSES = 20

# Smallest number of other answers for a robust standard deviation.
_MIN_OTHERS = 3

# An answer is about as certain as the result if its standard deviation is below this many of the
# result's.
_AS_CERTAIN = 3.0

# Smallest number of such answers for a robust standard deviation.
_MIN_AS_CERTAIN = 2

# Smallest share of inliers of an answer that counts: DNLO keeps half of the motion pairs, however
# noisy they are.
_FEWEST_INLIERS = 0.55

# Halves are not compared on an axis whose standard deviations differ by this factor: the smaller
# one comes from noise. The factor is 12 to 47 for simulated straight starts of 40 s, and 1.1 to 4.0
# with curves in both halves.
_UNEQUAL_HALVES = 5.0

# Smallest joint standard deviation (m, rad) to divide by: noise-free data has none.
_ROUNDING = 1e-9


def cross_checked(solved: Solved, config: CalibratorConfig, pose_pairs: PosePairs) -> Calibration:
    """Return the result of a solve with its cross-check.

    An axis that no other answer determines becomes weak. A prior on such an axis replaces the
    estimate from motion.

    Parameters
    ----------
    solved : Solved
    config : CalibratorConfig
        The options of the solve.
    pose_pairs : PosePairs
        The poses of the solve: on one clock, each stream in its own unit of length.
    """
    result = solved.calibration()
    others, halves = other_answers(result, config, pose_pairs)
    unconfirmed = np.array(AXES)[_unconfirmed(result, _sound(others))].tolist()
    replaced = [axis for axis in unconfirmed if axis in config.prior()]
    if replaced:
        result = solved.calibration(replaced)
    observability = tuple(
        replace(dof, verdict=DofVerdict.WEAK)
        if dof.name in unconfirmed and dof.verdict is DofVerdict.OBSERVED
        else dof
        for dof in result.observability_measured
    )
    result = replace(result, observability_measured=observability)
    return replace(result, cross_check=compare_answers(result, others, halves))


def _unconfirmed(result: Calibration, sound: Sequence[Calibration]) -> BoolArray:
    """Return which axes (6,) the result determines and no other answer does."""
    # A result with a reference was solved where the motion is most informative: other references
    # may be less informative.
    if len(sound) < _MIN_OTHERS or METHODS[result.method].uses_reference:
        return np.zeros(len(AXES), dtype=bool)
    of_others = np.array([other.sigmas_measured for other in sound])
    return np.isfinite(result.sigmas_measured) & np.isinf(of_others).all(axis=0)


def other_answers(
    calibration: Calibration, config: CalibratorConfig, pose_pairs: PosePairs
) -> tuple[list[Calibration], list[Calibration]]:
    """Return answers at other references, and from each half of the recording.

    The answers have the time offset and the scale of the result, and no priors. Those with too few
    data are missing. Parameters as of :func:`cross_checked`.
    """
    settled = replace(
        config,
        prior_x="",
        prior_y="",
        prior_z="",
        prior_roll="",
        prior_pitch="",
        prior_yaw="",
        method=_METHOD,
        backend="fast",
        time_offset=calibration.time_offset_s,
        scale=calibration.scale,
    )
    n_poses = len(pose_pairs)
    own = calibration.reference
    stride = _stride_of(n_poses)
    others = []
    for baseline in _BASELINES:
        is_own = (calibration.method, own) == (_METHOD, f"B{baseline * stride}")
        if baseline * stride * 4 < n_poses and not is_own:
            others.append(_answer(pose_pairs[::stride], settled, f"B{baseline}"))
    if not METHODS[calibration.method].uses_reference or own[0] not in "BC":
        own = f"B{_BASELINE_OF_HALVES}"
    half = n_poses // 2
    stride = _stride_of(n_poses - half)
    # The reference that has about the same motion pairs of thinned poses.
    kind = own[0]
    step = max(round(int(own[1:]) / stride), 1 if kind == "B" else 2)
    halves = [
        _answer(poses, settled, f"{kind}{step}")
        for poses in (pose_pairs[:half:stride], pose_pairs[half:n_poses:stride])
    ]
    return [*filter(None, others)], [*filter(None, halves)]


def _stride_of(n_poses: int) -> int:
    """Return the stride that leaves no more than the largest number of poses."""
    return max(-(-n_poses // _MOST_POSES), 1)


def _answer(poses: PosePairs, config: CalibratorConfig, reference: str) -> Calibration | None:
    """Return the answer at a reference; None if there are too few data."""
    if len(poses) < _MIN_POSES:
        return None
    with contextlib.suppress(HandEyeCalibError):
        return solve_poses(
            poses, replace(config, reference=reference), is_beside=True
        ).calibration()
    return None


def compare_answers(
    calibration: Calibration, others: Sequence[Calibration] = (), halves: Sequence[Calibration] = ()
) -> CrossCheck:
    """Compare a result with other answers to the same question.

    Parameters
    ----------
    calibration : Calibration
    others : sequence of Calibration
        Answers at other references. Those that reject almost half of their motion pairs do not
        count.
    halves : sequence of Calibration
        Answers from the first and the second half of the recording; not compared unless there are
        two.
    """
    sigmas = calibration.sigmas_measured
    allowance = calibration.allowance
    sound = _sound(others)
    apart = np.empty((len(sound), 6))
    joint = np.empty((len(sound), 6))
    for row, other in enumerate(sound):
        apart[row], joint[row] = _apart(calibration, other)
    own = np.maximum(sigmas, _ROUNDING)
    of_others = np.reshape([other.sigmas_measured for other in sound], (-1, 6))
    as_certain = np.where(of_others < _AS_CERTAIN * own, apart, np.nan)
    of_halves, excess_of_halves = _scatter_of_halves(calibration, halves)
    columns = {
        "sigma": calibration.sigmas,
        "of_methods": _robust_sigma(apart, _MIN_OTHERS),
        "of_halves": of_halves,
        "excess_of_methods": _robust_sigma(apart / np.hypot(joint, allowance), _MIN_OTHERS),
        "excess_of_halves": excess_of_halves,
        "excess_over_own": _robust_sigma(as_certain, _MIN_AS_CERTAIN) / np.hypot(own, allowance),
    }
    unconfirmed = _unconfirmed(calibration, sound)
    scatter = {}
    for index, axis in enumerate(AXES):
        values: dict[str, float | None] = dict.fromkeys(columns)
        for name, column in columns.items():
            if np.isfinite(sigmas[index]) and np.isfinite(column[index]):
                values[name] = float(column[index])
        scatter[axis] = AxisScatter(**values, is_confirmed=not unconfirmed[index])
    return scatter


def _scatter_of_halves(
    calibration: Calibration, halves: Sequence[Calibration]
) -> tuple[FloatArray, FloatArray]:
    """Return the standard deviation (6,) of a result by the difference of both halves.

    The second array is the same in joint standard deviations. Axes are NaN if they are not
    compared.
    """
    if len(halves) != 2:
        return np.full(6, np.nan), np.full(6, np.nan)
    between, joint = _apart(*halves)
    half_sigmas = np.maximum([half.sigmas_measured for half in halves], _ROUNDING)
    are_alike = half_sigmas.max(axis=0) < _UNEQUAL_HALVES * half_sigmas.min(axis=0)
    between = np.where(are_alike, between, np.nan)
    # The result is about the mean of both halves, whose standard deviation is half of that of their
    # difference. The halves do not contain the allowance, nor the slow errors that another method
    # estimates.
    is_same_method = halves[0].method == calibration.method
    beside = calibration.allowance if is_same_method else calibration.sigmas
    return between / 2, between / 2 / np.hypot(joint / 2, beside)


def _sound(others: Sequence[Calibration]) -> list[Calibration]:
    """Return the answers that do not reject almost half of their motion pairs."""
    return [other for other in others if other.n_inliers > _FEWEST_INLIERS * max(other.n_pairs, 1)]


def _apart(first: Calibration, second: Calibration) -> tuple[FloatArray, FloatArray]:
    """Return the distance (6,) of two answers and their joint standard deviation.

    Both are NaN on axes that either answer does not determine.
    """
    distance = np.abs(deviation(first.T_parent_child, second.T_parent_child))
    joint = np.hypot(first.sigmas_measured, second.sigmas_measured)
    is_known = np.isfinite(joint)
    return (
        np.where(is_known, distance, np.nan),
        np.where(is_known, np.maximum(joint, _ROUNDING), np.nan),
    )


def _robust_sigma(distances: FloatArray, fewest: int) -> FloatArray:
    """Return the standard deviation (6,) by the median of distances (N, 6) from zero.

    It is NaN for axes with fewer than ``fewest`` finite distances.
    """
    medians = np.full(6, np.nan)
    for axis, column in enumerate(distances.T):
        finite = column[np.isfinite(column)]
        if len(finite) >= fewest:
            medians[axis] = median(finite)
    return medians / MEDIAN_NORMAL
