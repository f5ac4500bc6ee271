"""Errors beside those of the model, each as it would be alone in it: delays of the positions of a
stream against its own orientations, and a world that moves against the other.

Positions and orientations of one pose may come from different filters. Poses whose positions are
late by d are ``T Exp(-d (v, 0))``, with the velocity v of that sensor in its own frame. At a
constant v that is a shift of the sensor, which no motion tells from a part of X; where v changes,
it is a column of the linear model like that of a clock offset, ``(v, w)``. Both are estimated
together: a clock offset alone moves positions and orientations alike.

If the child's world moves with a constant twist w, its poses are ``Exp(t w) T``, and its motions
from pose to pose ``B Exp(dt Ad(T^-1) w)``: six columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls.increments import TIME, Linearisation, Streams, turned
from hand_eye_calib.gls.normal import (
    N_BLOCKS,
    NormalEquations,
    answers_without,
    selected,
)
from hand_eye_calib.gls.parts import part_products
from hand_eye_calib.gls.problem import Fit, Problem

# A direction without evidence that has this much of a delay in it leaves the delay open.
_UNSEEN = 1e-6

# By how much the weighted squared residual must fall for a world to move: at odometry that drifts
# at random it falls by 25 at most.
_SIGNIFICANT = 36.0


@dataclass(frozen=True)
class PartDelay:
    """A delay of positions against orientations.

    Attributes
    ----------
    seconds : float
        Positive if the positions are late.
    sigma_s : float
        Standard deviation: the larger of that of the model and that of the jackknife. Infinite if
        the motion shows nothing of it.
    """

    seconds: float
    sigma_s: float

    @property
    def sigmas(self) -> float:
        """Its size in standard deviations."""
        return abs(self.seconds) / max(self.sigma_s, 1e-12)


@dataclass(frozen=True)
class WorldDrift:
    """How the child's world moves against the parent's.

    Attributes
    ----------
    twist : (6,) array
        Velocity, m/s, and angular rate, rad/s, in the child's world, about its origin.
    evidence : float
        By how much the weighted squared residual falls with it, over the misfit.
    """

    twist: FloatArray
    evidence: float

    @property
    def is_significant(self) -> bool:
        """Whether it is there beyond doubt."""
        return self.evidence > _SIGNIFICANT

    def speed_at(self, positions: FloatArray) -> float:
        """Root mean square speed (m/s) at which it moves positions (N, 3) of the child."""
        velocities = self.twist[:3] + np.cross(self.twist[3:], positions)
        return float(np.sqrt((velocities**2).sum(axis=1).mean()))


@dataclass(frozen=True)
class Extras:
    """Delays of the child's and of the parent's positions, and the drift of the child's world."""

    delays: tuple[PartDelay, PartDelay]
    world_drift: WorldDrift


def extras(problem: Problem, fit: Fit, misfit: float) -> Extras:
    """Under the noise that the search found; ``misfit`` is the factor of the covariance."""
    with_clock = [*dict.fromkeys((*fit.columns, TIME))]
    linearisation = fit.linearised(fit.poses, fit.course, fit.error, with_clock)
    added = [
        *_by_delays(linearisation, fit.poses.twists, fit.T),
        _by_world(fit.poses),
    ]
    jacobian, residuals = linearisation.columns[:, :, :-1], linearisation.columns[:, :, -1:]
    columns = np.concatenate([jacobian, *added, residuals], axis=2)
    parts = part_products(problem.posterior(fit).with_columns(columns))
    products = parts.sum(axis=0)
    n_known, n_clocked = 6 + len(fit.columns), 6 + len(with_clock)
    child, parent = (_part_delay(products, parts, n_clocked, at, misfit) for at in range(2))
    known = list(range(n_known))
    world = list(range(n_clocked + 2, len(products) - 1))
    without = NormalEquations(selected(products, known))
    found = NormalEquations(selected(products, known + world))
    evidence = (without.cost - found.cost) / max(misfit, 1.0)
    return Extras((child, parent), WorldDrift(found.step[n_known:], evidence))


def _by_delays(
    linearisation: Linearisation, twists: FloatArray, T_parent_child: FloatArray
) -> list[FloatArray]:
    """Derivatives (n, 6, 1) by delays of the child's and of the parent's positions, from the
    velocities (N, 6) of the child in its own frame.
    """
    rotation, translation = T_parent_child[:3, :3], T_parent_child[:3, 3]
    of_child = twists * [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    of_parent = -of_child
    of_parent[:, :3] += np.cross(twists[:, 3:], translation @ rotation)
    return [
        (turned(linearisation.adjoints, moving[:-1]) - moving[1:])[:, :, None]
        for moving in (of_child, of_parent)
    ]


def _by_world(streams: Streams) -> FloatArray:
    """Derivatives (n, 6, 6) by a twist of the child's world."""
    adjoints = se3.adjoint(se3.inverse(streams.Ts_cw_c))
    intervals_s = np.diff(streams.stamps_s)[:, None, None]
    return np.asarray(0.5 * intervals_s * (adjoints[1:] + adjoints[:-1]))


def _part_delay(
    products: FloatArray, parts: FloatArray, n_known: int, stream: int, misfit: float
) -> PartDelay:
    """The delay of a stream beside X, systematic errors and the clock, which are known columns."""
    columns = [*range(n_known), n_known + stream]
    normal = NormalEquations(selected(products, columns))
    if np.abs(normal.unseen[-1]).max(initial=0.0) > _UNSEEN:
        return PartDelay(0.0, np.inf)
    variance = max(misfit, 1.0) * float(normal.covariance[-1, -1])
    if len(parts) >= N_BLOCKS:
        spread = answers_without(selected(parts, columns))[:, -1].var()
        variance = max(variance, (N_BLOCKS - 1) * float(spread))
    return PartDelay(float(normal.step[-1]), float(np.sqrt(variance)))
