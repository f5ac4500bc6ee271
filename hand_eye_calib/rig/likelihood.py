"""Exact likelihood of the increments of a rig, and its derivatives by the noise levels.

The increments of different sensors share those of the first one:

    cov(e_k, e_l) = N_0 for k != l,    cov(e_k, e_k) = N_0 + N_k

with N_k block tridiagonal in time, so that V is block tridiagonal with blocks of 6 K. One
factorisation gives the restricted likelihood and its derivatives in time linear in the poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hand_eye_calib.adaptive.block_tridiagonal import Factor, InOrder, transposed
from hand_eye_calib.adaptive.state_space import NormalEquations, multiplied
from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.rig.increments import Increments

# Log levels of each sensor: white translation (m^2), white rotation (rad^2), walk of translation
# and of rotation over a typical increment.
WHITE_TRANSLATION, WHITE_ROTATION, WALK_TRANSLATION, WALK_ROTATION = range(4)
N_LEVELS = 4

# Variances (m^2, rad^2) that errors have where a sensor is no evidence: jumps, and poses that are
# wrong by themselves. Large beside everything that is evidence.
UNKNOWN = 1.0

# Parts of the recording for the jackknife.
N_PARTS = 20

_PARTS = np.array([np.diag([1.0, 1, 1, 0, 0, 0]), np.diag([0.0, 0, 0, 1, 1, 1])])


@dataclass(frozen=True)
class Model:
    """Increments with what is known of their noise beside the levels.

    Attributes
    ----------
    increments : Increments
    white : (S, 2, 6, 6) array
        Covariances of unit translation and rotation errors of each sensor, in the frame of the
        first one.
    walk : (S, 2, n, 6, 6) array
        The same of a walk over each increment, which is 1 over a typical one.
    jumps : (S, n) bool array
        Increments of a sensor that are no evidence.
    spikes : (S, N) bool array
        Poses of a sensor that are no evidence.
    """

    increments: Increments
    white: FloatArray
    walk: FloatArray
    jumps: BoolArray
    spikes: BoolArray

    @property
    def n_sensors(self) -> int:
        """S."""
        return len(self.white)

    def covariance(self, sensor: int, levels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Blocks of N_k on the diagonal (n, 6, 6) and below it (n - 1, 6, 6), at all levels."""
        of_sensor = np.exp(levels[N_LEVELS * sensor : N_LEVELS * (sensor + 1)])
        white = np.tensordot(of_sensor[:2], self.white[sensor], axes=1)
        at_poses = np.broadcast_to(white, (self.walk.shape[2] + 1, 6, 6)).copy()
        at_poses[self.spikes[sensor]] += UNKNOWN * np.eye(6)
        adjoints = self.increments.adjoints
        moved = adjoints @ at_poses[:-1]
        own = at_poses[1:] + moved @ transposed(adjoints)
        own += np.tensordot(of_sensor[2:], self.walk[sensor], axes=1)
        own[self.jumps[sensor]] += UNKNOWN * np.eye(6)
        return own, -moved[1:]

    def blocks(self, levels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Blocks of V on the diagonal (n, 6 K, 6 K) and below it (n - 1, 6 K, 6 K)."""
        n, K = len(self.increments), self.n_sensors - 1
        own, beside = np.empty((n, K, 6, K, 6)), np.empty((n - 1, K, 6, K, 6))
        shared = self.covariance(0, levels)
        own[:], beside[:] = shared[0][:, None, :, None, :], shared[1][:, None, :, None, :]
        for sensor in range(1, K + 1):
            of_sensor = self.covariance(sensor, levels)
            own[:, sensor - 1, :, sensor - 1] += of_sensor[0]
            beside[:, sensor - 1, :, sensor - 1] += of_sensor[1]
        return own.reshape(n, 6 * K, 6 * K), beside.reshape(n - 1, 6 * K, 6 * K)

    def at_poses(self, columns: FloatArray) -> FloatArray:
        """Columns (n, 6) of increments brought to the poses (N, 6) whose white errors they see."""
        found = np.zeros((len(columns) + 1, 6))
        found[1:] = columns
        found[:-1] -= (transposed(self.increments.adjoints) @ columns[:, :, None])[:, :, 0]
        return found

    def between_poses(self, errors: FloatArray) -> FloatArray:
        """Increments (n, 6) of errors (N, 6) at the poses."""
        back = (self.increments.adjoints @ errors[:-1, :, None])[:, :, 0]
        return errors[1:] - back


def white_of(Xs: FloatArray) -> FloatArray:
    """Covariances (S, 2, 6, 6) of unit errors of sensors at Xs (S, 4, 4)."""
    adjoints = se3.adjoint(Xs)[:, None]
    return adjoints @ _PARTS @ transposed(adjoints)


def walk_of(white: FloatArray, relative: FloatArray) -> FloatArray:
    """Walks (S, 2, n, 6, 6) over increments of relative variance (n,)."""
    return white[:, :, None] * relative[:, None, None]


def walk_between(
    white: FloatArray, relative: FloatArray, poses: FloatArray, kept: IntArray
) -> FloatArray:
    """Walks between some of the poses (N, 4, 4) of the first sensor: an error of the rotation grows
    into one of the translation on the path that follows.
    """
    poses = se3.inverse(poses[0]) @ poses
    ahead, back = se3.adjoint(poses[1:]), se3.adjoint(se3.inverse(poses[kept[1:]]))
    walks = np.empty((*white.shape[:2], len(kept) - 1, 6, 6))
    for index in np.ndindex(white.shape[:2]):
        steps = relative[:, None, None] * (ahead @ white[index] @ transposed(ahead))
        sums = np.concatenate([np.zeros((1, 6, 6)), np.cumsum(steps, axis=0)])
        walks[index] = back @ np.diff(sums[kept], axis=0) @ transposed(back)
    return walks


class Likelihood:
    """Restricted likelihood and solution of a model at log levels.

    Raises
    ------
    numpy.linalg.LinAlgError
        If V is not positive definite to rounding.
    """

    def __init__(self, model: Model, levels: FloatArray) -> None:
        self.model, self.levels = model, levels
        self._factor = Factor(*model.blocks(levels))

    @cached_property
    def _whitened(self) -> FloatArray:
        return self._factor.whiten(self.model.increments.columns)

    @cached_property
    def products(self) -> FloatArray:
        """(p + 1, p + 1) array: products of the columns, weighed with V^-1."""
        return multiplied(self._whitened, self._whitened)

    @cached_property
    def normal(self) -> NormalEquations:
        """Solution for all parameters."""
        return NormalEquations(self.products)

    @cached_property
    def loss(self) -> float:
        """Negative restricted log likelihood, constants left out."""
        normal = self.normal
        return 0.5 * (self._factor.log_determinant() + normal.cost + normal.log_determinant)

    @cached_property
    def _forces(self) -> FloatArray:
        """V^-1 times the residuals after the step and, behind them, times a root of what the
        uncertainty of the parameters adds: (n, 6 K, 1 + q).
        """
        n, size, _ = self._whitened.shape
        mixed = (self._whitened.reshape(n * size, -1) @ self.normal.mixing).reshape(n, size, -1)
        return self._factor.restore(mixed)

    def force(self, sensor: int) -> FloatArray:
        """P r (n, 6) as the noise of a sensor feels it: its expected increments are N_k times it,
        for the first sensor with the opposite sign.
        """
        return self._of_sensor(self._forces[:, :, :1], sensor)[:, :, 0]

    def _of_sensor(self, columns: FloatArray, sensor: int) -> FloatArray:
        """Rows (n, 6, k) of columns (n, 6 K, k) that a sensor's noise enters."""
        parts = columns.reshape(len(columns), -1, 6, columns.shape[2])
        return parts.sum(axis=1) if sensor == 0 else parts[:, sensor - 1]

    @cached_property
    def _precision(self) -> tuple[FloatArray, FloatArray]:
        """P = V^-1 - V^-1 J C J' V^-1 on the diagonal and below it."""
        own, beside = self._factor.selected_inverse()
        roots = self._forces[:, :, 1:]
        return own - roots @ transposed(roots), beside - roots[1:] @ transposed(roots[:-1])

    def precision(self, sensor: int) -> tuple[FloatArray, FloatArray]:
        """Blocks (n, 6, 6) and (n - 1, 6, 6) of P as the noise of a sensor feels it: the
        covariance of :meth:`force`.
        """
        of_sensor = []
        for blocks in self._precision:
            parts = blocks.reshape(len(blocks), self.model.n_sensors - 1, 6, -1, 6)
            at = sensor - 1
            of_sensor.append(parts.sum(axis=(1, 3)) if sensor == 0 else parts[:, at, :, at])
        return of_sensor[0], of_sensor[1]

    def precision_at_poses(self, sensor: int) -> FloatArray:
        """Covariances (N, 6, 6) of :meth:`force` brought to the poses."""
        own, beside = self.precision(sensor)
        adjoints = self.model.increments.adjoints
        found = np.zeros((len(own) + 1, 6, 6))
        found[1:] = own
        found[:-1] += transposed(adjoints) @ own @ adjoints
        mixed = transposed(adjoints[1:]) @ beside
        found[1:-1] -= mixed + transposed(mixed)
        return found

    def average_information(self, pushed: FloatArray) -> FloatArray:
        """Information (m, m) of the levels from ``dV/dlevel P r`` (n, 6 K, m)."""
        whitened = self._factor.whiten(pushed)
        shared = multiplied(self._whitened, whitened)[:-1]
        own = multiplied(whitened, whitened)
        information = 0.5 * (own - shared.T @ self.normal.covariance @ shared)
        return 0.5 * (information + information.T)

    def motion_errors(self) -> FloatArray:
        """Expected increments (n, 6) of the error of the first sensor."""
        own, beside = self.model.covariance(0, self.levels)
        force = self.force(0)[:, :, None]
        found = own @ force
        found[1:] += beside @ force[:-1]
        found[:-1] += transposed(beside) @ force[1:]
        return -found[:, :, 0]

    def part_products(self) -> FloatArray:
        """What each part of the recording adds to the products, given the parts before it:
        (P, p + 1, p + 1), see :mod:`~hand_eye_calib.adaptive.resampling`.
        """
        columns = self.model.increments.columns
        whitened = InOrder(*self.model.blocks(self.levels)).whiten(columns)
        parts = np.array_split(whitened, min(N_PARTS, len(whitened)))
        return np.array([multiplied(part, part) for part in parts])


def derivatives(likelihood: Likelihood) -> tuple[FloatArray, FloatArray]:
    """Gradient (m,) of the loss by the log levels, and the average information (m, m)."""
    model, levels = likelihood.model, likelihood.levels
    gradient = np.zeros(len(levels))
    pushed = np.zeros((*likelihood.model.increments.columns.shape[:2], len(levels)))
    for sensor in range(model.n_sensors):
        own, _ = likelihood.precision(sensor)
        force = likelihood.force(sensor)
        at_poses = likelihood.precision_at_poses(sensor)
        pulled = model.at_poses(force)
        free = ~model.spikes[sensor]
        white = at_poses[free].sum(axis=0) - pulled[free].T @ pulled[free]
        own = own - force[:, :, None] * force[:, None]
        for part in range(2):
            basis, walk = model.white[sensor, part], model.walk[sensor, part]
            at = N_LEVELS * sensor + part
            gradient[at], gradient[at + 2] = (white * basis).sum(), (own * walk).sum()
            moved = model.between_poses(np.where(free[:, None], pulled @ basis, 0.0))
            walked = (walk @ force[:, :, None])[:, :, 0]
            for level, column in ((at, moved), (at + 2, walked)):
                _add(pushed, sensor, level, column)
    variances = np.exp(levels)
    return 0.5 * variances * gradient, likelihood.average_information(pushed * variances)


def _add(pushed: FloatArray, sensor: int, level: int, column: FloatArray) -> None:
    """Put a column (n, 6) of a sensor's noise where it enters the increments."""
    if sensor == 0:
        pushed[:, :, level] = np.tile(column, pushed.shape[1] // 6)
    else:
        pushed[:, 6 * sensor - 6 : 6 * sensor, level] = column
