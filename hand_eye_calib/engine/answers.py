"""Other answers to the same question, from parts of the recording and from other methods and
references, and their scatter about a result, compared with what their covariances allow.

Other methods and references show what the noise model misses, such as errors that last longer than
it assumes; both halves of the recording what changes during it. Neither shows an error that is
constant.

Long recordings are downsampled before they are solved again, so that all answers together take
seconds.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.estimation import Solved, estimate_beside, estimate_extrinsic
from hand_eye_calib.engine.lever_arms import estimate_lever_arm
from hand_eye_calib.engine.rotations import estimate_rotation
from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.methods import METHODS
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.plain import plain
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.results.records import AxisScatter, CrossCheck
from hand_eye_calib.results.status import AXES
from hand_eye_calib.stats import MEDIAN_NORMAL, median

# Methods that a result is compared with, at these baselines and with at most so many poses; and the
# method without a reference.
_COMPARED_METHODS = ("dnlo", "dnl", "park")
_COMPARED_BASELINES = (1, 5, 10, 20)
_MAX_POSES_OF_OTHERS = 3_000
_COMPARED_ESTIMATOR = "adaptive"

# The same for a check within every solve: the method that takes least time, at these baselines.
_QUICK_METHOD, _QUICK_BASELINES = "dnlo", (1, 3, 8, 20)

_MIN_POSES = 20

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

Estimator: TypeAlias = Callable[[PosePairs, CalibratorConfig], Calibration]

# What estimates the extrinsic, or a part of it, by what both streams measure together.
ESTIMATORS: Mapping[str, Estimator] = {
    "poses": estimate_extrinsic,
    "rotations": estimate_rotation,
    "positions": estimate_lever_arm,
}


@dataclass(frozen=True)
class Answer:
    """Another answer to the same question.

    Attributes
    ----------
    label : str
        Method and reference, or part of the recording.
    until_s : float
        Seconds from the first pose of the recording to the last one used.
    calibration : Calibration
    stride : int
        One pose in so many was used.
    """

    label: str
    until_s: float
    calibration: Calibration
    stride: int = 1


@dataclass(frozen=True)
class _Question:
    label: str
    part: slice
    config: CalibratorConfig


class OtherAnswers:
    """Solves the same question again. Answers with too few data are left out.

    Parameters
    ----------
    calibration : Calibration
        The result. Its method, time offset and scale are used in every other answer.
    config : CalibratorConfig
        The options that gave it.
    pose_pairs : PosePairs
        The poses that gave it, on one clock, each stream in its own unit of length.
    """

    def __init__(
        self, calibration: Calibration, config: CalibratorConfig, pose_pairs: PosePairs
    ) -> None:
        self._calibration, self._poses = calibration, pose_pairs
        self._config = replace(
            config,
            method=calibration.method,
            time_offset=calibration.time_offset_s,
            scale="none" if calibration.measured == "rotations" else calibration.scale,
            backend="fast",
        )
        no_prior: dict[str, Any] = {name: "" for name in vars(config) if name.startswith("prior_")}
        self._without_prior = replace(self._config, **no_prior)

    def growing(self) -> tuple[Answer, ...]:
        """From the first part of the recording, the first two ... to all of it, with the prior."""
        method = METHODS[self._config.method]
        ends = np.linspace(0, len(self._poses), method.parts + 1).astype(int)[1:-1]
        questions = [_Question(str(end), slice(0, end), self._config) for end in ends]
        last_s = self._seconds(self._poses)
        return (
            *self._same_method(questions, method.most_poses_of_many),
            Answer("all", last_s, self._calibration),
        )

    def halves(self) -> tuple[Answer, ...]:
        """From each half alone, without priors."""
        return self._same_method(
            self._halves_with(self._without_prior), METHODS[self._config.method].most_poses_of_few
        )

    def _halves_with(self, config: CalibratorConfig) -> list[_Question]:
        half = len(self._poses) // 2
        return [
            _Question("first half", slice(0, half), config),
            _Question("second half", slice(half, None), config),
        ]

    def other_methods(self) -> tuple[Answer, ...]:
        """From other methods and references, without priors: of poses."""
        if self._calibration.measured != "poses":
            return ()
        questions = [
            question
            for method in _COMPARED_METHODS
            for question in self._at_baselines(method, _COMPARED_BASELINES)
        ]
        if self._calibration.method != _COMPARED_ESTIMATOR:
            questions.append(self._estimator_question())
        return self._answers(questions)

    def quick(self) -> tuple[tuple[Answer, ...], tuple[Answer, ...]]:
        """From other references, and from each half, with the quickest method: without priors."""
        others = self._at_baselines(_QUICK_METHOD, _QUICK_BASELINES)
        own = self._calibration.reference
        if not METHODS[self._calibration.method].uses_reference or own[0] not in "BC":
            own = f"B{_QUICK_BASELINES[2]}"
        config = replace(self._without_prior, method=_QUICK_METHOD, reference=own)
        halves = [
            self._downsampled(half, _MAX_POSES_OF_OTHERS, own) for half in self._halves_with(config)
        ]
        return self._answers(others, estimate_beside), self._answers(halves, estimate_beside)

    def _at_baselines(self, method: str, baselines: Sequence[int]) -> list[_Question]:
        """A method at these baselines, with at most so many poses; without the result itself."""
        stride = _stride(len(self._poses), _MAX_POSES_OF_OTHERS)
        own_label = f"{self._calibration.method} {self._calibration.reference}"
        questions = [
            _Question(
                f"{method} B{n * stride}",
                slice(None, None, stride),
                replace(self._without_prior, method=method, reference=f"B{n}"),
            )
            for n in baselines
            if n * stride * 4 < len(self._poses)
        ]
        return [question for question in questions if question.label != own_label]

    def _estimator_question(self) -> _Question:
        label = _COMPARED_ESTIMATOR
        stride = _stride(len(self._poses), METHODS[label].most_poses_of_few)
        config = replace(self._without_prior, method=label, reference="auto")
        if stride > 1:
            label = f"{label} (1 in {stride})"
        return _Question(label, slice(None, None, stride), config)

    def _same_method(self, questions: Iterable[_Question], max_poses: int) -> tuple[Answer, ...]:
        """Answers of the result's own method, with its reference, from at most so many poses."""
        return self._answers(
            self._downsampled(question, max_poses, self._calibration.reference)
            for question in questions
        )

    def _downsampled(self, question: _Question, max_poses: int, own_reference: str) -> _Question:
        start, end, _ = question.part.indices(len(self._poses))
        stride = _stride(end - start, max_poses)
        reference = "auto"
        if METHODS[question.config.method].uses_reference:
            reference = _coarser(own_reference, stride)
        config = replace(question.config, reference=reference)
        return replace(question, part=slice(start, end, stride), config=config)

    def _answers(
        self, questions: Iterable[_Question], estimate: Estimator | None = None
    ) -> tuple[Answer, ...]:
        """Answers by an estimator: by default the one that gave the result."""
        estimate = estimate or ESTIMATORS[self._calibration.measured]
        found = (self._answer(question, estimate) for question in questions)
        return tuple(filter(None, found))

    def _answer(self, question: _Question, estimate: Estimator) -> Answer | None:
        poses = self._poses[question.part]
        if len(poses) < _MIN_POSES:
            return None
        try:
            calibration = estimate(poses, question.config)
        except HandEyeCalibError:
            return None
        stride = question.part.step or 1
        return Answer(question.label, self._seconds(poses), calibration, stride)

    def _seconds(self, poses: PosePairs) -> float:
        """Seconds from the first pose of the recording to the last of these."""
        return float((poses.stamps_ns[-1] - self._poses.stamps_ns[0]) * 1e-9)


def _stride(count: int, max_count: int) -> int:
    return max(-(-count // max_count), 1)


def _coarser(reference: str, stride: int) -> str:
    """The reference with about the same pairs of every ``stride``-th pose."""
    kind, step = reference[0], reference[1:]
    if kind not in "BC" or not step.isdecimal():
        return reference
    return f"{kind}{max(round(int(step) / stride), 1 if kind == 'B' else 2)}"


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
