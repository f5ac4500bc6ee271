"""Cross-check of a result: the scatter of other answers from the same recording, compared with
what their covariances allow.

Two kinds of answers are compared with the result: those of other methods and references from the
same poses, and those of each half of the recording alone. The first show what the noise model
misses, such as errors that last longer than it assumes. The second show what changes during the
recording. Neither shows an error that is constant.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.assessment.covariance import TRANSLATIONS
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.calibration import Calibration
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.answers import OtherAnswers
from hand_eye_calib.engine.offline import offline_config, whole_snapshot
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.methods import METHODS

# Largest distance of two answers, in their joint standard deviations, that the covariances allow.
_MAX_DISTANCE = 3.0

# Fewest other answers that have a scatter.
_MIN_OTHERS = 3

# Median absolute value of a normal variable, in standard deviations.
_MEDIAN_OF_NORMAL = 0.6745


@dataclass(frozen=True, kw_only=True)
class CrossCheck:
    """Scatter of other answers about a result, along and about the axes of the parent sensor's
    frame (m and rad).

    Attributes
    ----------
    axes : tuple of str
        x, y, z, roll, pitch, yaw.
    sigma : (6,) array
        The result's standard deviations; infinite if an axis is unobservable.
    of_methods : (6,) array
        Robust standard deviation of the answers of other methods and references about the result;
        NaN if too few of them know the axis.
    of_halves : (6,) array
        Standard deviation of the result that follows from the difference between the answers of
        both halves; NaN if they do not know the axis.
    excess_of_methods, excess_of_halves : (6,) arrays
        Distance of the answers in their joint standard deviations (of the methods: the median over
        that of a normal variable).
    """

    axes: tuple[str, ...]
    sigma: FloatArray
    of_methods: FloatArray
    of_halves: FloatArray
    excess_of_methods: FloatArray
    excess_of_halves: FloatArray

    def warnings(self) -> tuple[str, ...]:
        """A sentence for each kind of answers that lie farther apart than the covariances allow."""
        found = (
            ("other methods and references disagree", self.of_methods, self.excess_of_methods),
            ("the two halves of the recording disagree", self.of_halves, self.excess_of_halves),
        )
        return tuple(
            f"{what} by more than the stated standard deviations allow, in "
            f"{', '.join(self._listed(scatter, far))}: trust the larger value"
            for what, scatter, excess in found
            if (far := np.flatnonzero(excess > _MAX_DISTANCE)).size
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON or YAML; None for what is not known."""
        columns = {"sigma": self.sigma, "of_methods": self.of_methods, "of_halves": self.of_halves}
        return {
            axis: {
                name: float(values[k]) if np.isfinite(values[k]) else None
                for name, values in columns.items()
            }
            for k, axis in enumerate(self.axes)
        }

    def _listed(self, scatter: FloatArray, far: IntArray) -> Iterator[str]:
        for k in far:
            is_translation = self.axes[k] in TRANSLATIONS
            unit, factor = ("m", 1.0) if is_translation else ("deg", float(np.degrees(1.0)))
            other, own = factor * scatter[k], factor * self.sigma[k]
            yield f"{self.axes[k]} ({other:.2g} {unit} against {own:.2g})"


def cross_check(
    calibration: Calibration,
    parent: Trajectory,
    child: Trajectory,
    config: CalibratorConfig | None = None,
) -> CrossCheck:
    """Cross-check a result with other methods and references and with both halves of its recording.

    This solves some fifteen times.

    Parameters
    ----------
    calibration : Calibration
        The result.
    parent, child : Trajectory
        The trajectories that gave it.
    config : CalibratorConfig, optional
        The options that gave it; the defaults, with the result's method, if left out.

    Returns
    -------
    CrossCheck

    Raises
    ------
    NotEnoughDataError
        If too few poses can be paired.
    """
    config = config or offline_config(parent, child, {"method": calibration.method})
    settled = replace(config, time_offset=calibration.time_offset_s)
    pose_pairs = whole_snapshot(settled, parent, child).pose_pairs()
    answers = OtherAnswers(calibration, config, pose_pairs)
    return compare_answers(
        calibration,
        [other.calibration for other in answers.other_methods()],
        [half.calibration for half in answers.halves()],
    )


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
        From other methods and references. Only methods that reject outliers count: with jumps, the
        others disagree for a reason that says nothing about the result.
    halves : sequence of Calibration
        From the first and the second half of the recording, or fewer.

    Returns
    -------
    CrossCheck
    """
    robust = [other for other in others if METHODS[other.method].rejects_outliers]
    of_methods, excess_of_methods = _scatter(calibration, robust)
    of_halves = excess_of_halves = np.full(6, np.nan)
    if len(halves) == 2:
        apart, allowed = _apart(*halves)
        # The whole is the mean of both halves: its standard deviation is half of that of their
        # difference.
        of_halves, excess_of_halves = apart / 2, apart / allowed
    known = np.isfinite(calibration.sigmas)
    return CrossCheck(
        axes=tuple(dof.name for dof in calibration.observability),
        sigma=calibration.sigmas,
        of_methods=np.where(known, of_methods, np.nan),
        of_halves=np.where(known, of_halves, np.nan),
        excess_of_methods=np.where(known, excess_of_methods, np.nan),
        excess_of_halves=np.where(known, excess_of_halves, np.nan),
    )


def _scatter(
    calibration: Calibration, others: Sequence[Calibration]
) -> tuple[FloatArray, FloatArray]:
    """Robust standard deviation (6,) of other answers about a result, and the same in joint
    standard deviations.
    """
    if not others:
        return np.full(6, np.nan), np.full(6, np.nan)
    distances = [_apart(calibration, other) for other in others]
    apart = np.array([distance for distance, _ in distances])
    allowed = np.array([joint for _, joint in distances])
    apart[:, np.isfinite(apart).sum(axis=0) < _MIN_OTHERS] = np.nan
    return _median(apart) / _MEDIAN_OF_NORMAL, _median(apart / allowed) / _MEDIAN_OF_NORMAL


def _median(values: FloatArray) -> FloatArray:
    """Median (6,) of the finite values in each column; NaN if there is none."""
    return np.array(
        [
            np.median(column[np.isfinite(column)]) if np.isfinite(column).any() else np.nan
            for column in values.T
        ]
    )


def _apart(first: Calibration, second: Calibration) -> tuple[FloatArray, FloatArray]:
    """Distance (6,) of two answers and their joint standard deviation; NaN if either does not know
    the axis.
    """
    distance = np.abs(deviation(first.T_parent_child, second.T_parent_child))
    joint = np.hypot(first.sigmas, second.sigmas)
    known = np.isfinite(joint)
    return np.where(known, distance, np.nan), np.where(known, joint, np.nan)
