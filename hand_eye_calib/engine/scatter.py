"""The scatter of other answers about a result, compared with what their covariances allow.

Two kinds of answers are compared with the result: those of other methods and references from the
same poses, and those of each half of the recording alone. The first show what the noise model
misses, such as errors that last longer than it assumes. The second show what changes during the
recording. Neither shows an error that is constant.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.answers import OtherAnswers
from hand_eye_calib.engine.estimation import Solved
from hand_eye_calib.methods import METHODS
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.plain import plain
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.results.records import AxisScatter, CrossCheck
from hand_eye_calib.results.status import AXES
from hand_eye_calib.stats import MEDIAN_NORMAL, median

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
    part of every solve. An axis that none of the references reveals is unobservable.

    Parameters
    ----------
    solved : Solved
    config : CalibratorConfig
        The options that gave it.
    pose_pairs : PosePairs
        The poses that gave it.

    Returns
    -------
    Calibration
    """
    result = solved.calibration()
    answers = OtherAnswers(result, config, pose_pairs).quick()
    others, halves = ([answer.calibration for answer in kind] for kind in answers)
    if unseen := _unseen_by_all(result, others):
        result = solved.calibration(unseen)
    return replace(result, cross_check=compare_answers(result, others, halves))


def _unseen_by_all(calibration: Calibration, others: Sequence[Calibration]) -> list[str]:
    """Axes that a result knows, and no sound answer at other references.

    None for a method with a reference: it is chosen, or given, where the motion shows most, which
    others at shorter ones need not see.
    """
    robust = [other for other in others if _is_sound(other)]
    if len(robust) < _MIN_OTHERS or METHODS[calibration.method].uses_reference:
        return []
    return [
        dof.name
        for index, dof in enumerate(calibration.observability)
        if math.isfinite(dof.sigma) and all(np.isinf(other.sigmas[index]) for other in robust)
    ]


def compare_answers(
    calibration: Calibration,
    others: Sequence[Calibration] = (),
    halves: Sequence[Calibration] = (),
) -> CrossCheck:
    """Compare a result with other answers to the same question.

    Parameters
    ----------
    calibration : Calibration
        The result.
    others : sequence of Calibration
        From other methods and references. Only those count that reject outliers, and not half of
        the motion pairs: the others disagree for a reason that says nothing about the result.
    halves : sequence of Calibration
        From the first and the second half of the recording, or fewer.

    Returns
    -------
    CrossCheck
    """
    robust = [other for other in others if _is_sound(other)]
    of_methods, excess_of_methods = _scatter(calibration, robust)
    of_halves = excess_of_halves = np.full(6, np.nan)
    if len(halves) == 2:
        apart, allowed = _apart(halves[0], halves[1])
        # The whole is the mean of both halves: its standard deviation is half of that of their
        # difference.
        of_halves = apart / 2
        excess_of_halves = of_halves / np.hypot(allowed / 2, _beside_halves(calibration, halves[0]))
    of_model, excess_of_model = _from_other_model(calibration)
    columns = {
        "sigma": calibration.sigmas,
        "of_methods": of_methods,
        "of_halves": of_halves,
        "of_model": of_model,
        "excess_of_methods": excess_of_methods,
        "excess_of_halves": excess_of_halves,
        "excess_of_model": excess_of_model,
        "excess_over_own": _over_own(calibration, robust),
    }
    known = np.isfinite(calibration.sigmas)
    return {
        axis: AxisScatter(
            **{name: plain(values[k]) if known[k] else None for name, values in columns.items()}
        )
        for k, axis in enumerate(AXES)
    }


def _beside_halves(calibration: Calibration, half: Calibration) -> FloatArray:
    """Standard deviations (6,) that the halves do not state: the floor, and those of a result of
    another method, which may know of errors that last.
    """
    if half.method == calibration.method:
        return calibration.sigmas_of_floor
    return np.hypot(calibration.sigmas, calibration.sigmas_of_floor)


def _scatter(
    calibration: Calibration, others: Sequence[Calibration]
) -> tuple[FloatArray, FloatArray]:
    """Robust standard deviation (6,) of other answers about a result, and the same in joint
    standard deviations.
    """
    if not others:
        return np.full(6, np.nan), np.full(6, np.nan)
    floor = calibration.sigmas_of_floor
    distances = [_apart(calibration, other, floor) for other in others]
    apart = np.array([distance for distance, _ in distances])
    allowed = np.array([joint for _, joint in distances])
    apart[:, np.isfinite(apart).sum(axis=0) < _MIN_OTHERS] = np.nan
    return _median(apart) / MEDIAN_NORMAL, _median(apart / allowed) / MEDIAN_NORMAL


def _is_sound(other: Calibration) -> bool:
    share = other.n_inliers / max(other.n_pairs, 1)
    return METHODS[other.method].rejects_outliers and share > _FEWEST_INLIERS


def _over_own(calibration: Calibration, others: Sequence[Calibration]) -> FloatArray:
    """Median distance (6,) of other answers in the result's own standard deviations, over that of a
    normal variable.
    """
    if not others:
        return np.full(6, np.nan)
    own = np.maximum(calibration.sigmas, _ROUNDING)
    as_certain = np.array([other.sigmas for other in others]) < _AS_CERTAIN * own
    own = np.hypot(own, calibration.sigmas_of_floor)
    apart = np.array([_apart(calibration, other)[0] for other in others])
    apart[~as_certain] = np.nan
    apart[:, np.isfinite(apart).sum(axis=0) < _MIN_AS_CERTAIN] = np.nan
    return _median(apart) / own / MEDIAN_NORMAL


def _median(values: FloatArray) -> FloatArray:
    """Median (6,) of the finite values in each column; NaN if there is none."""
    return np.array([median(column[np.isfinite(column)]) for column in values.T])


def _apart(
    first: Calibration, second: Calibration, floor: FloatArray | float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Distance (6,) of two answers and their joint standard deviation; NaN if either does not know
    the axis.
    """
    distance = np.abs(deviation(first.T_parent_child, second.T_parent_child))
    joint = np.hypot(np.hypot(first.sigmas, second.sigmas), floor)
    known = np.isfinite(joint)
    return np.where(known, distance, np.nan), np.where(known, np.maximum(joint, _ROUNDING), np.nan)


def _from_other_model(calibration: Calibration) -> tuple[FloatArray, FloatArray]:
    """Distance (6,) from the answer under other assumptions, and the same in joint standard
    deviations.
    """
    if calibration.other_answer is None:
        return np.full(6, np.nan), np.full(6, np.nan)
    T_other, covariance = calibration.other_answer
    distance = np.abs(deviation(T_other, calibration.T_parent_child))
    to_parent = np.kron(np.eye(2), T_other[:3, :3])
    variances = np.diag(to_parent @ covariance @ to_parent.T) + calibration.sigmas**2
    variances += calibration.sigmas_of_floor**2
    return distance, distance / np.sqrt(np.maximum(variances, _ROUNDING**2))
