"""Test by axis whether an extrinsic has moved.

The difference d of two estimates has the covariance C. An axis k has moved if ``|d_k| / sigma_k``
exceeds a limit, which the largest of six normal variables exceeds once in 200 comparisons. The
extrinsic has also moved if ``d' C^-1 d`` exceeds the 99.9 % quantile of chi-square with 6 degrees
of freedom. An axis is the same only if the test would detect a relevant change in nine of ten
cases.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from hand_eye_calib.core.base import stats
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.text import amount, listing
from hand_eye_calib.core.results.context import AxisDifference
from hand_eye_calib.core.results.records import AXES, ROTATIONS, TRANSLATIONS

# Standard deviations (m, rad) of an unknown axis.
UNKNOWN = np.sqrt(np.repeat([100.0, 10.0], 3))
# An axis with a larger standard deviation (m, rad) is unknown.
UNKNOWN_FROM = 0.1 * UNKNOWN


class Change(str, Enum):
    """Verdict on the difference between two extrinsics."""

    SAME = "same"
    MOVED = "moved"
    CANNOT_TELL = "cannot tell"

    @classmethod
    def of_all(cls, changes: Sequence["Change"]) -> "Change":
        """Return the gravest of several verdicts."""
        for change in (cls.MOVED, cls.CANNOT_TELL):
            if change in changes:
                return change
        return cls.SAME


@dataclass(frozen=True)
class Moved:
    """Difference between two estimates of an extrinsic.

    Attributes
    ----------
    axes : dict of str to AxisDifference
        Differences along and about the axes of the parent sensor's frame.
    verdict : Change
        Verdict on all axes together.
    """

    axes: dict[str, AxisDifference]
    verdict: Change

    def _axes_that(self, change: Change) -> list[str]:
        """Return the axes with this verdict."""
        return [
            axis
            for axis, difference in self.axes.items()
            if difference.verdict == change
        ]

    @property
    def sentence(self) -> str:
        """The verdict in one line, with its evidence."""
        if self.verdict is Change.MOVED:
            return f"moved: {self.what}"
        same = self._axes_that(Change.SAME)
        unknown = self._axes_that(Change.CANNOT_TELL)
        if not unknown:
            return f"same: {self._power(same)}"
        sentence = f"cannot tell about {listing(unknown)}"
        if not same:
            return sentence
        return f"{sentence}; {listing(same)} the same: {self._power(same)}"

    @property
    def what(self) -> str:
        """The axes that have moved, and by how much.

        If more than three axes have moved, the total distance and angle. If no single axis has
        moved, the two axes that differ most.
        """
        axes = self._axes_that(Change.MOVED)
        if len(axes) > len(TRANSLATIONS):
            return f"{listing(axes)}, by {listing(self._totals())} in all"
        axes = axes or self._most_different_axes()
        moves = []
        for axis in axes:
            difference = amount(axis, self.axes[axis].difference)
            sigma = amount(axis, self.axes[axis].sigma)
            moves.append(f"{axis} by {difference} +/- {sigma}")
        return (
            listing(moves)
            or "on all axes together, although no single axis differs clearly"
        )

    def _most_different_axes(self) -> list[str]:
        """Return the two axes that differ most, in standard deviations."""
        ratios = {}
        for axis in AXES:
            if axis in self.axes:
                ratios[axis] = (
                    abs(self.axes[axis].difference) / self.axes[axis].sigma
                )
        different = [axis for axis, ratio in ratios.items() if ratio]
        return sorted(different, key=lambda axis: -ratios[axis])[:2]

    def _totals(self) -> list[str]:
        """Return the distance and the angle of the difference in words, with the largest sigmas."""
        totals = []
        for axes in (TRANSLATIONS, ROTATIONS):
            rows = [self.axes[axis] for axis in axes]
            sigma = max(row.sigma for row in rows)
            if math.isfinite(sigma):
                total = amount(
                    axes[0], math.hypot(*(row.difference for row in rows))
                )
                totals.append(f"{total} +/- {amount(axes[0], sigma)}")
        return totals

    def _power(self, axes: Sequence[str]) -> str:
        """Describe the changes that the test would detect on these axes."""
        changes = []
        for names in (AXES[:3], AXES[3:]):
            if tested := [axis for axis in names if axis in axes]:
                worst = max(tested, key=lambda axis: self.axes[axis].visible)
                changes.append(amount(worst, self.axes[worst].visible))
        return f"a change of {' or '.join(changes)} would have been seen"


def moved(
    values: FloatArray, covariance: FloatArray, limits: FloatArray
) -> Moved:
    """Test the difference between two estimates of an extrinsic.

    Parameters
    ----------
    values : (6,) array
        Difference along (m) and about (rad) the axes of the parent sensor's frame.
    covariance : (6, 6) array
        Covariance of the difference. If the estimates come from two recordings, it includes the
        scatter between recordings.
    limits : (6,) array
        Changes that the test must be able to detect on an axis before the axis is called the same.
    """
    # Estimates without noise have a singular covariance. Make it invertible.
    covariance = covariance + 1e-18 * np.eye(6)
    sigmas = np.sqrt(np.diag(covariance))
    chi2 = float(values @ np.linalg.solve(covariance, values))
    sigmas = np.where(sigmas > UNKNOWN_FROM, np.inf, sigmas)
    largest = stats.LARGEST_OF_SIX
    visible = (largest + stats.NINE_TIMES_OUT_OF_TEN) * sigmas
    axes = {}
    verdicts = []
    for index, axis in enumerate(AXES):
        difference = float(values[index])
        sigma = float(sigmas[index])
        verdict = Change.CANNOT_TELL
        if abs(difference) / sigma > largest:
            verdict = Change.MOVED
        elif visible[index] <= limits[index]:
            verdict = Change.SAME
        verdicts.append(verdict)
        axes[axis] = AxisDifference(
            difference, sigma, float(visible[index]), verdict.value
        )
    if chi2 > stats.CHI2[0.001][6]:
        return Moved(axes, Change.MOVED)
    return Moved(axes, Change.of_all(verdicts))
