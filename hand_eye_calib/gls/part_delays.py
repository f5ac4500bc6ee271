"""Delay of the positions of a stream against its own orientations, and of a stream as a whole.

Positions and orientations of one pose may come from different filters. Poses whose positions are
late by d are ``T Exp(-d (v, 0))``, with the velocity v of that sensor in its own frame. At a
constant v that is a shift of the sensor, which no motion tells from a part of X; where v changes,
it is a column of the linear model like that of a clock offset, ``(v, w)``. Both are estimated
together, under the noise that the estimator found: a clock offset alone moves positions and
orientations alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.gls.increments import Linearisation, turned
from hand_eye_calib.gls.resampling import N_BLOCKS, answers_without
from hand_eye_calib.gls.state_space import NormalEquations, selected

# Delays from so many standard deviations on are likely; a clock is more often right.
_LIKELY, _LIKELY_OF_CLOCK = 2.0, 3.0

# A direction without evidence that has this much of a delay in it leaves the delay open.
_UNSEEN = 1e-6


@dataclass(frozen=True)
class PartDelay:
    """A delay of positions against orientations, or of a stream against the other.

    Attributes
    ----------
    seconds : float
        Positive if the positions, or the child's poses, are late.
    sigma_s : float
        Standard deviation: the larger of that of the model and that of the jackknife. Infinite if
        the motion shows nothing of it.
    sensitivity : (6,) array
        By how much xi in ``X Exp(xi)`` is off for each second of it that is not in the model.
    """

    seconds: float
    sigma_s: float
    sensitivity: FloatArray

    @property
    def sigmas(self) -> float:
        """Its size in standard deviations."""
        return abs(self.seconds) / max(self.sigma_s, 1e-12)


def spread_by_delays(
    delays: tuple[PartDelay, ...], clock_offset_s: float, clock: PartDelay | None = None
) -> FloatArray:
    """Covariance (6, 6) of xi by delays that the model does not have: of the one that matters most.

    A delay that is likely counts with its size. If the clocks were found to be apart, one of the
    streams may have a latency rather than another clock, and its positions and orientations need
    not have the same: then a delay counts that the motion does not exclude, up to that offset.

    Parameters
    ----------
    delays : sequence of PartDelay
    clock_offset_s : float
        As estimated; zero if it was given.
    clock : PartDelay, optional
        Of the child's clock, if the model has none.
    """
    spreads = [np.zeros((6, 6))]
    for delay in delays:
        variance = min(delay.sigma_s, abs(clock_offset_s)) ** 2
        if delay.sigmas > _LIKELY:
            variance += delay.seconds**2
        spreads.append(variance * np.outer(delay.sensitivity, delay.sensitivity))
    if clock is not None and clock.sigmas > _LIKELY_OF_CLOCK:
        spreads.append(clock.seconds**2 * np.outer(clock.sensitivity, clock.sensitivity))
    return max(spreads, key=lambda spread: float(np.trace(spread[:3, :3])))


def with_delay_columns(
    linearisation: Linearisation, twists: FloatArray, T_parent_child: FloatArray
) -> Linearisation:
    """A linearisation with two more columns: of a delay of the child's positions, and of the
    parent's; from the velocities (N, 6) of the child in its own frame.
    """
    rotation, translation = T_parent_child[:3, :3], T_parent_child[:3, 3]
    velocities, rates = twists[:, :3], twists[:, 3:]
    of_parent = velocities - np.cross(rates, translation @ rotation)
    columns = [
        sign * _column(linearisation, of_sensor)
        for sign, of_sensor in ((1.0, velocities), (-1.0, of_parent))
    ]
    return linearisation.with_columns(np.concatenate(columns, axis=2))


def _column(linearisation: Linearisation, velocities: FloatArray) -> FloatArray:
    twists = np.concatenate([velocities, np.zeros_like(velocities)], axis=1)
    return (turned(linearisation.adjoints, twists[:-1]) - twists[1:])[:, :, None]


def part_delay(
    products: FloatArray, parts: FloatArray, known: list[int], column: int, misfit: float
) -> PartDelay:
    """A delay, beside X and the systematic errors of a model.

    Parameters
    ----------
    products : (p + 1, p + 1) array
        Of all columns and, last, the residuals.
    parts : (K, p + 1, p + 1) array
        What each part of the recording adds to them.
    known : list of int
        Columns of X and of the systematic errors in the model.
    column : int
        That of the delay.
    misfit : float
        Factor of the covariance.
    """
    columns = [*known, column]
    without = NormalEquations(selected(products, known))
    sensitivity = (without.covariance @ products[known, column])[:6]
    normal = NormalEquations(selected(products, columns))
    if np.abs(normal.unseen[-1]).max(initial=0.0) > _UNSEEN:
        return PartDelay(0.0, np.inf, sensitivity)
    variance = max(misfit, 1.0) * float(normal.covariance[-1, -1])
    if len(parts) >= N_BLOCKS:
        spread = answers_without(selected(parts, columns), N_BLOCKS)[:, -1].var()
        variance = max(variance, (N_BLOCKS - 1) * float(spread))
    return PartDelay(float(normal.step[-1]), float(np.sqrt(variance)), sensitivity)
