"""Does the same drive, asked in other ways, give the same answer? The spread of such answers,
against what their covariances allow.

Two kinds of answers are compared with a result: those of other methods and references from the same
poses, and those of the drive's two halves alone. The first see what a noise model leaves out, such
as errors that last longer than it knows; the second what changes during the drive. Neither sees
what is wrong all the time.
"""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.assessment.metrics import deviation

# Answers this many of their joint standard deviations apart are not what the covariances allow.
_TOO_FAR = 3.0

# Fewer other answers say nothing about a spread.
_FEWEST_OTHERS = 3

# Median absolute value of a normal variable, in standard deviations.
_MEDIAN_OF_NORMAL = 0.6745


@dataclass(frozen=True)
class Consistency:
    """How far other answers lie from a result, along and about the axes of the parent sensor's
    frame (m and rad).

    Attributes
    ----------
    axes : tuple of str
        x, y, z, roll, pitch, yaw.
    sigma : (6,) array
        The result's standard deviations; infinite where an axis is not observable.
    of_methods : (6,) array
        Robust standard deviation of the other methods' and references' answers about the result;
        NaN where too few of them know the axis.
    of_halves : (6,) array
        Standard deviation of the whole drive's answer that the difference of its halves' answers
        suggests; NaN where they do not know the axis.
    excess_of_methods, excess_of_halves : (6,) arrays
        How many of their joint standard deviations the answers lie apart (of the methods: their
        median over that of a normal variable).
    """

    axes: tuple
    sigma: np.ndarray
    of_methods: np.ndarray
    of_halves: np.ndarray
    excess_of_methods: np.ndarray
    excess_of_halves: np.ndarray

    def warnings(self):
        """A sentence for each kind of answers that lie further apart than the covariances allow;
        empty where none do.
        """
        found = (
            ("other methods and references disagree", self.of_methods, self.excess_of_methods),
            ("the two halves of the drive disagree", self.of_halves, self.excess_of_halves),
        )
        return tuple(
            f"{what} by more than the stated standard deviations allow, in "
            f"{', '.join(self._told(spread, far))}: trust the larger number"
            for what, spread, excess in found
            if (far := np.flatnonzero(excess > _TOO_FAR)).size
        )

    def to_dict(self):
        """Plain numbers for JSON or YAML; None for what is not known."""
        columns = {"sigma": self.sigma, "of_methods": self.of_methods, "of_halves": self.of_halves}
        return {
            axis: {
                name: float(values[k]) if np.isfinite(values[k]) else None
                for name, values in columns.items()
            }
            for k, axis in enumerate(self.axes)
        }

    def _told(self, spread, far):
        for k in far:
            unit, factor = ("m", 1.0) if k < 3 else ("deg", np.degrees(1.0))
            yield (
                f"{self.axes[k]} ({factor * spread[k]:.2g} {unit} against "
                f"{factor * self.sigma[k]:.2g})"
            )


def consistency(calibration, others=(), halves=()):
    """Compare a result with other answers to the same question.

    Parameters
    ----------
    calibration : Calibration
        The result.
    others : sequence of Calibration
        From the same poses, by other methods and references.
    halves : sequence of Calibration
        From the first and from the second half of the poses, or empty.

    Returns
    -------
    Consistency
    """
    known = np.isfinite(calibration.sigmas)
    of_methods, excess_of_methods = _spread(calibration, others)
    of_halves = excess_of_halves = np.full(6, np.nan)
    if len(halves) == 2:
        apart, allowed = _apart(*halves)
        # The whole is the mean of two such parts: its standard deviation is half of their
        # difference's.
        of_halves, excess_of_halves = apart / 2, apart / allowed
    axes = tuple(dof.name for dof in calibration.observability)
    return Consistency(
        axes,
        calibration.sigmas,
        *(
            np.where(known, values, np.nan)
            for values in (of_methods, of_halves, excess_of_methods, excess_of_halves)
        ),
    )


def _spread(calibration, others):
    """Robust standard deviation (6,) of other answers about a result, and the same in joint
    standard deviations.
    """
    if not others:
        return np.full(6, np.nan), np.full(6, np.nan)
    apart, allowed = (
        np.array(values)
        for values in zip(*(_apart(calibration, other) for other in others), strict=True)
    )
    apart[:, np.isfinite(apart).sum(axis=0) < _FEWEST_OTHERS] = np.nan
    return tuple(_median(values) / _MEDIAN_OF_NORMAL for values in (apart, apart / allowed))


def _median(values):
    """Median (6,) of the finite values in each column; NaN where there is none."""
    return np.array(
        [
            np.median(column[np.isfinite(column)]) if np.isfinite(column).any() else np.nan
            for column in values.T
        ]
    )


def _apart(first, second):
    """Distance (6,) of two answers and their joint standard deviation; NaN where either does not
    know the axis.
    """
    distance = np.abs(deviation(first.T_parent_child, second.T_parent_child))
    joint = np.hypot(first.sigmas, second.sigmas)
    known = np.isfinite(joint)
    return np.where(known, distance, np.nan), np.where(known, joint, np.nan)
