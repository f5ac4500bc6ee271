"""Has it moved? By axis, where a person asks what has: an axis has if it differs by more than
chance makes of any of six once in 200 comparisons, or all together by what chance makes of them
once in 1,000; it is the same only if a change that matters would have been seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from hand_eye_calib.core.base import stats
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.text import amount, listing
from hand_eye_calib.core.results.context import AxisDifference
from hand_eye_calib.core.results.records import AXES

# Standard deviations (m, rad) that stand for "nothing known", and from which on one does.
UNKNOWN = np.sqrt(np.r_[np.full(3, 100.0), np.full(3, 10.0)])
UNKNOWN_FROM = 0.1 * UNKNOWN


class Change(str, Enum):
    """Whether something has moved."""

    SAME = "same"
    MOVED = "moved"
    CANNOT_TELL = "cannot tell"

    @classmethod
    def of_all(cls, changes: Sequence["Change"]) -> "Change":
        """The gravest of several."""
        graver = (each for each in (cls.MOVED, cls.CANNOT_TELL) if each in changes)
        return next(graver, cls.SAME)


@dataclass(frozen=True)
class Moved:
    """By axis how two estimates of an extrinsic differ, along and about the axes of the parent
    sensor's frame, and the verdict on all axes together.
    """

    axes: dict[str, AxisDifference]
    verdict: Change

    def _those(self, change: Change) -> list[str]:
        return [axis for axis, found in self.axes.items() if found.verdict == change]

    @property
    def sentence(self) -> str:
        """The verdict in one line, with what it rests on."""
        if self.verdict is Change.MOVED:
            return f"moved: {self.what}"
        same = self._those(Change.SAME)
        unknown = self._those(Change.CANNOT_TELL)
        if not unknown:
            return f"same: {self._power(same)}"
        told = f"cannot tell about {listing(unknown)}"
        return f"{told}; {listing(same)} the same: {self._power(same)}" if same else told

    @property
    def what(self) -> str:
        """The axes that have moved; the two that differ most if none has on its own."""
        ratios = {axis: abs(each.difference) / each.sigma for axis, each in self.axes.items()}
        most = sorted(filter(ratios.get, AXES), key=lambda axis: -ratios[axis])[:2]
        told = [
            f"{axis} by {amount(axis, one.difference)} +/- {amount(axis, one.sigma)}"
            for axis, one in ((axis, self.axes[axis]) for axis in self._those(Change.MOVED) or most)
        ]
        return listing(told) or "by what the axes show together, none of them alone"

    def _power(self, axes: Sequence[str]) -> str:
        told = []
        for names in (AXES[:3], AXES[3:]):
            if known := [axis for axis in names if axis in axes]:
                worst = max(known, key=lambda axis: self.axes[axis].visible)
                told.append(amount(worst, self.axes[worst].visible))
        return f"a change of {' or '.join(told)} would have been seen"


def moved(values: FloatArray, covariance: FloatArray, limits: FloatArray) -> Moved:
    """Judge a difference of two estimates by axis.

    Parameters
    ----------
    values : (6,) array
        Difference along (m) and about (rad) the axes of the parent sensor's frame.
    covariance : (6, 6) array
        Of both estimates together, with the scatter of recordings if they are of two.
    limits : (6,) array
        Changes that have to be seen before an axis is called the same.
    """
    covariance = covariance + 1e-18 * np.eye(6)
    sigmas = np.sqrt(np.diag(covariance))
    chi2 = float(values @ np.linalg.solve(covariance, values))
    sigmas = np.where(sigmas > UNKNOWN_FROM, np.inf, sigmas)
    largest = stats.LARGEST_OF_SIX
    visible = (largest + stats.NINE_TIMES_OUT_OF_TEN) * sigmas
    verdicts = [
        Change.MOVED if ratio > largest else Change.SAME if seen else Change.CANNOT_TELL
        for ratio, seen in zip(np.abs(values) / sigmas, visible <= limits, strict=True)
    ]
    columns = (each.tolist() for each in (values, sigmas, visible))
    rows = zip(*columns, (each.value for each in verdicts), strict=True)
    axes = {axis: AxisDifference(*row) for axis, row in zip(AXES, rows, strict=True)}
    return Moved(axes, Change.MOVED if chi2 > stats.CHI2[0.001][6] else Change.of_all(verdicts))
