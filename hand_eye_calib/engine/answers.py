"""Other answers to the same question, from parts of the recording and from other methods and
references, and their scatter about a result, compared with what their covariances allow.

Other methods and references show what the noise model misses, such as errors that last longer than
it assumes; both halves of the recording what changes during it. Neither shows an error that is
constant.

Long recordings are downsampled before they are solved again, so that all answers together take
seconds.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.estimation import Solved, estimate_beside, estimate_extrinsic
from hand_eye_calib.engine.partial import estimate_lever_arm, estimate_rotation
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
        parts = {str(end): slice(0, end) for end in ends}
        found = self._of_parts(parts, self._config, method.most_poses_of_many)
        return (*found, Answer("all", self._seconds(self._poses), self._calibration))

    def halves(self) -> tuple[Answer, ...]:
        """From each half alone, without priors."""
        most = METHODS[self._config.method].most_poses_of_few
        return self._of_parts(self._halves(), self._without_prior, most)

    def other_methods(self) -> tuple[Answer, ...]:
        """From other methods and references, without priors: of poses."""
        if self._calibration.measured != "poses":
            return ()
        found: list[Answer | None] = [
            answer
            for method in _COMPARED_METHODS
            for answer in self._at_baselines(method, _COMPARED_BASELINES, estimate_extrinsic)
        ]
        label = _COMPARED_ESTIMATOR
        if self._calibration.method != label:
            config = replace(self._without_prior, method=label, reference="auto")
            stride = _stride(len(self._poses), METHODS[label].most_poses_of_few)
            label += f" (1 in {stride})" if stride > 1 else ""
            found.append(self._answer(label, slice(None, None, stride), config))
        return tuple(filter(None, found))

    def quick(self) -> tuple[tuple[Answer, ...], tuple[Answer, ...]]:
        """From other references, and from each half, with the quickest method: without priors."""
        others = self._at_baselines(_QUICK_METHOD, _QUICK_BASELINES, estimate_beside)
        own = self._calibration.reference
        if not METHODS[self._calibration.method].uses_reference or own[0] not in "BC":
            own = f"B{_QUICK_BASELINES[2]}"
        config = replace(self._without_prior, method=_QUICK_METHOD, reference=own)
        return others, self._of_parts(self._halves(), config, _MAX_POSES_OF_OTHERS, estimate_beside)

    def _halves(self) -> dict[str, slice]:
        half = len(self._poses) // 2
        return {"first half": slice(0, half), "second half": slice(half, None)}

    def _at_baselines(
        self, method: str, baselines: Sequence[int], estimate: Estimator
    ) -> tuple[Answer, ...]:
        """A method at these baselines, with at most so many poses; without the result itself."""
        stride = _stride(len(self._poses), _MAX_POSES_OF_OTHERS)
        own_label = f"{self._calibration.method} {self._calibration.reference}"
        found = []
        for n in baselines:
            label = f"{method} B{n * stride}"
            if n * stride * 4 < len(self._poses) and label != own_label:
                config = replace(self._without_prior, method=method, reference=f"B{n}")
                found.append(self._answer(label, slice(None, None, stride), config, estimate))
        return tuple(filter(None, found))

    def _of_parts(
        self,
        parts: Mapping[str, slice],
        config: CalibratorConfig,
        max_poses: int,
        estimate: Estimator | None = None,
    ) -> tuple[Answer, ...]:
        """Answers from parts of the recording, from at most so many poses of each."""
        own = self._calibration.reference if estimate is None else config.reference
        found = []
        for label, part in parts.items():
            start, end, _ = part.indices(len(self._poses))
            stride = _stride(end - start, max_poses)
            uses_reference = METHODS[config.method].uses_reference
            on = replace(config, reference=_coarser(own, stride) if uses_reference else "auto")
            found.append(self._answer(label, slice(start, end, stride), on, estimate))
        return tuple(filter(None, found))

    def _answer(
        self, label: str, part: slice, config: CalibratorConfig, estimate: Estimator | None = None
    ) -> Answer | None:
        """The answer of an estimator: by default of the one that gave the result."""
        poses = self._poses[part]
        if len(poses) < _MIN_POSES:
            return None
        try:
            found = (estimate or ESTIMATORS[self._calibration.measured])(poses, config)
        except HandEyeCalibError:
            return None
        return Answer(label, self._seconds(poses), found, part.step or 1)

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
        # The halves do not state the floor and, of another method, errors that last.
        beside = calibration.sigmas_of_floor
        if halves[0].method != calibration.method:
            beside = calibration.sigmas_with_floor
        excess_of_halves = of_halves / np.hypot(allowed / 2, beside)
    columns = {
        "sigma": calibration.sigmas,
        "of_methods": of_methods,
        "of_halves": of_halves,
        "excess_of_methods": excess_of_methods,
        "excess_of_halves": excess_of_halves,
        "excess_over_own": _over_own(calibration, robust),
    }
    known = np.isfinite(calibration.sigmas)
    return {
        axis: AxisScatter(
            **{name: plain(values[k]) if known[k] else None for name, values in columns.items()}
        )
        for k, axis in enumerate(AXES)
    }


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
