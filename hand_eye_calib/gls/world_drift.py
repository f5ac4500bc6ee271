"""A world of one stream that moves against the other's: a map that is turned or shifted bit by bit,
a heading that drifts.

If the child's world moves with a constant twist w, its poses are ``Exp(t w) T``, and its motions
from pose to pose ``B Exp(dt Ad(T^-1) w)``: six columns of the linear model, of first order like
those of a clock offset. A rotation about a distant origin moves the sensor across its direction of
travel, and X is taken to be askew.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls.increments import Linearisation, Streams
from hand_eye_calib.gls.state_space import NormalEquations, selected

N_COLUMNS = 6

# By how much the weighted squared residual must fall: at odometry that drifts at random it falls by
# 25 at most.
_SIGNIFICANT = 36.0


@dataclass(frozen=True)
class WorldDrift:
    """How the child's world moves against the parent's.

    Attributes
    ----------
    twist : (6,) array
        Velocity, m/s, and angular rate, rad/s, in the child's world, about its origin.
    evidence : float
        By how much the weighted squared residual falls with it, over the misfit.
    shift : (6,) array
        By how much xi in ``X Exp(xi)`` is off because it is not in the model.
    """

    twist: FloatArray
    evidence: float
    shift: FloatArray

    @property
    def is_significant(self) -> bool:
        """Whether it is there beyond doubt."""
        return self.evidence > _SIGNIFICANT

    def speed_at(self, positions: FloatArray) -> float:
        """Root mean square speed (m/s) at which it moves positions (N, 3) of the child."""
        velocities = self.twist[:3] + np.cross(self.twist[3:], positions)
        return float(np.sqrt((velocities**2).sum(axis=1).mean()))


def with_world_columns(linearisation: Linearisation, streams: Streams) -> Linearisation:
    """A linearisation with six more columns: of a twist of the child's world."""
    adjoints = se3.adjoint(se3.inverse(streams.Ts_cw_c))
    intervals_s = np.diff(streams.stamps_s)[:, None, None]
    columns = 0.5 * intervals_s * (adjoints[1:] + adjoints[:-1])
    return linearisation.with_columns(columns)


def world_drift(
    products: FloatArray, known: list[int], world: list[int], misfit: float
) -> WorldDrift:
    """The twist of the child's world, beside X and the systematic errors of a model.

    Parameters
    ----------
    products : (p + 1, p + 1) array
        Of all columns and, last, the residuals.
    known, world : lists of int
        Columns of X and of systematic errors in the model; those of :func:`with_world_columns`.
    misfit : float
        Factor of the covariance.
    """
    without = NormalEquations(selected(products, known))
    found = NormalEquations(selected(products, known + world))
    twist = found.step[-N_COLUMNS:]
    shift = (without.covariance @ products[np.ix_(known, world)] @ twist)[:6]
    return WorldDrift(twist, (without.cost - found.cost) / max(misfit, 1.0), shift)
