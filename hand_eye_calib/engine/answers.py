"""Other answers to the same question: from parts of the recording, and from other methods and
references.

Long recordings are downsampled before they are solved again, so that all answers together take
seconds.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.estimation import estimate_beside
from hand_eye_calib.engine.estimators import ESTIMATORS, Estimator
from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.methods import METHODS
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.results.calibration import Calibration

# Methods that a result is compared with, at these baselines and with at most so many poses; and the
# method without a reference.
_COMPARED_METHODS = ("dnlo", "dnl", "park")
_COMPARED_BASELINES = (1, 5, 10, 20)
_MAX_POSES_OF_OTHERS = 3_000
_COMPARED_ESTIMATOR = "adaptive"

# The same for a check within every solve: the method that takes least time, at these baselines.
_QUICK_METHOD, _QUICK_BASELINES = "dnlo", (1, 3, 8, 20)

_MIN_POSES = 20


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
