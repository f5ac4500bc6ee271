"""Other answers to the same question, from other references and from parts of the recording, and
their scatter about a result, compared with what their covariances allow.

Other references show what the noise model misses, such as errors that last longer than it assumes;
both halves of the recording what changes during it. Neither shows an error that is constant.
"""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.config import METHODS, CalibratorConfig
from hand_eye_calib.engine.estimation import Solved, solve_poses
from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.geometry.extrinsic import deviation
from hand_eye_calib.pairing.motion_pairs import PosePairs
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.results.records import AXES, AxisScatter, CrossCheck
from hand_eye_calib.stats import MEDIAN_NORMAL, median

# A result is compared with the method that takes least time, at these baselines, from at most and
# at least so many poses; the halves of a result without a baseline are solved at the last but one.
_METHOD = "dnlo"
_BASELINES, _MOST_POSES, _MIN_POSES = (1, 3, 8, 20), 3_000, 20

# Fewest other answers that have a scatter.
_MIN_OTHERS = 3

# Answers whose standard deviation is below so many of the result's are about as certain. Fewest of
# them that say something.
_AS_CERTAIN, _MIN_AS_CERTAIN = 3.0, 2

# An answer from a smaller share of the motion pairs says nothing about others: DNLO keeps half of
# them at least, however noisy they are.
_FEWEST_INLIERS = 0.55

# Smallest joint standard deviation (m, rad) to divide by: noise-free data has none.
_ROUNDING = 1e-9


def cross_checked(solved: Solved, config: CalibratorConfig, pose_pairs: PosePairs) -> Calibration:
    """The result of a solve, compared with what DNLO gives at a few references and from each half:
    part of every solve. An axis that none of the references reveals is unobservable. Options and
    poses are those that gave it: on one clock, each stream in its own unit of length.
    """
    result = solved.calibration()
    others, halves = other_answers(result, config, pose_pairs)
    robust = _sound(others)
    # One of a reference was solved where the motion shows most, which others need not see.
    if len(robust) >= _MIN_OTHERS and not METHODS[result.method].uses_reference:
        of_others = np.array([other.sigmas for other in robust])
        unseen = np.isfinite(result.sigmas) & np.isinf(of_others).all(axis=0)
        if unseen.any():
            result = solved.calibration(np.array(AXES)[unseen].tolist())
    return replace(result, cross_check=compare_answers(result, others, halves))


def other_answers(
    calibration: Calibration, config: CalibratorConfig, pose_pairs: PosePairs
) -> tuple[list[Calibration], list[Calibration]]:
    """Answers to the same question at other references, and from each half of the recording, with
    the time offset and the scale of the result, without priors; those with too few data are left
    out. Parameters as of :func:`cross_checked`.
    """
    known: dict[str, Any] = {name: "" for name in vars(config) if name.startswith("prior_")}
    known |= {"time_offset": calibration.time_offset_s, "scale": calibration.scale}
    settled = replace(config, method=_METHOD, backend="fast", **known)

    def answers(parts: Sequence[tuple[str, slice]]) -> list[Calibration]:
        found = []
        for reference, part in parts:
            poses = pose_pairs[part]
            if len(poses) >= _MIN_POSES:
                with contextlib.suppress(HandEyeCalibError):
                    config = replace(settled, reference=reference)
                    found.append(solve_poses(poses, config, is_beside=True).calibration())
        return found

    n_poses, own = len(pose_pairs), calibration.reference
    stride = max(-(-n_poses // _MOST_POSES), 1)
    others = [
        (f"B{n}", slice(None, None, stride))
        for n in _BASELINES
        if n * stride * 4 < n_poses and (calibration.method, own) != (_METHOD, f"B{n * stride}")
    ]
    if not METHODS[calibration.method].uses_reference or own[0] not in "BC":
        own = f"B{_BASELINES[-2]}"
    half = n_poses // 2
    stride = max(-(-(n_poses - half) // _MOST_POSES), 1)
    # About the same pairs of every stride-th pose.
    own = f"{own[0]}{max(round(int(own[1:]) / stride), 1 if own[0] == 'B' else 2)}"
    halves = [(own, slice(*edges, stride)) for edges in ((0, half), (half, n_poses))]
    return answers(others), answers(halves)


def compare_answers(
    calibration: Calibration,
    others: Sequence[Calibration] = (),
    halves: Sequence[Calibration] = (),
) -> CrossCheck:
    """Compare a result with other answers to the same question: at other references, of which only
    those count that do not reject half of the motion pairs, and from the first and the second half
    of the recording, or fewer.
    """
    sigmas, floor = calibration.sigmas, calibration.sigmas_of_floor
    sound = _sound(others)
    pairs = [_apart(calibration, other) for other in sound]
    apart, joint = np.reshape(pairs, (-1, 2, 6)).swapaxes(0, 1)
    own = np.maximum(sigmas, _ROUNDING)
    as_certain = np.reshape([other.sigmas for other in sound], (-1, 6)) < _AS_CERTAIN * own
    of_as_certain = _robust_sigma(np.where(as_certain, apart, np.nan), _MIN_AS_CERTAIN)
    of_halves = excess_of_halves = np.full(6, np.nan)
    if len(halves) == 2:
        between, allowed = _apart(*halves)
        # The whole is the mean of both halves: its standard deviation is half of that of their
        # difference. They do not state the floor and, of another method, time-correlated errors.
        of_halves = between / 2
        is_same = halves[0].method == calibration.method
        beside = floor if is_same else calibration.sigmas_with_floor
        excess_of_halves = of_halves / np.hypot(allowed / 2, beside)
    columns = {
        "sigma": sigmas,
        "of_methods": _robust_sigma(apart, _MIN_OTHERS),
        "of_halves": of_halves,
        "excess_of_methods": _robust_sigma(apart / np.hypot(joint, floor), _MIN_OTHERS),
        "excess_of_halves": excess_of_halves,
        "excess_over_own": of_as_certain / np.hypot(own, floor),
    }
    table = np.where(np.isfinite(sigmas), [*columns.values()], np.nan).T.tolist()
    rows = [[each if math.isfinite(each) else None for each in row] for row in table]
    return {
        axis: AxisScatter(**dict(zip(columns, row, strict=True)))
        for axis, row in zip(AXES, rows, strict=True)
    }


def _sound(others: Sequence[Calibration]) -> list[Calibration]:
    return [one for one in others if one.n_inliers > _FEWEST_INLIERS * max(one.n_pairs, 1)]


def _apart(first: Calibration, second: Calibration) -> tuple[FloatArray, FloatArray]:
    """Distance (6,) of two answers and their joint standard deviation; NaN if either does not know
    the axis.
    """
    distance = np.abs(deviation(first.T_parent_child, second.T_parent_child))
    joint = np.hypot(first.sigmas, second.sigmas)
    known = np.isfinite(joint)
    return np.where(known, distance, np.nan), np.where(known, np.maximum(joint, _ROUNDING), np.nan)


def _robust_sigma(distances: FloatArray, fewest: int) -> FloatArray:
    """Standard deviation (6,) by the median of distances (N, 6) from zero; NaN for axes on which
    fewer are finite.
    """
    columns = [column[np.isfinite(column)] for column in distances.T]
    medians = [median(column) if len(column) >= fewest else np.nan for column in columns]
    return np.array(medians) / MEDIAN_NORMAL
