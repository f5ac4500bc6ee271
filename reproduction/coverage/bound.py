"""The Cramer-Rao bound of an extrinsic under the true noise, exact to first order.

The model of the difference ``z_i`` of both sensors at pose i is::

    z_i = c_i + d_i + xi,    c = Ad(X^-1) a - b,    d_i = Ad(B_i^-1) d_{i-1} + walk

xi is the error of the extrinsic X; a and b are the errors of the poses of parent and child. The
state d contains the unknown pose of one world in the other, and the drift of the odometry. B_i is
the child's motion to pose i. This is a linear state space: its information matrix is block
tridiagonal, and one band Cholesky factorisation eliminates all unknowns except xi.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from reproduction.coverage.sensor_errors import (
    DrawnErrors,
    SensorErrors,
    directions,
    scale_columns,
)

# Variances below this (m^2 or rad^2) count as this: a component without error has no inverse.
_LEAST_VARIANCE = 1e-18


@dataclass(frozen=True)
class Side:
    """A sensor: its error model, drawn errors and true poses."""

    errors: SensorErrors
    drawn: DrawnErrors
    # True poses; (N, 4, 4) array.
    Ts: FloatArray
    # Maps the sensor's errors to c: Ad(X^-1) for the parent, -I for the child; (6, 6) array.
    to_error: FloatArray


@dataclass(frozen=True)
class _Latent:
    """A latent process with k states.

    Attributes
    ----------
    phi : float
        Transition factor from pose to pose.
    variances : (k,) array
        Stationary variances.
    in_pose : (N, 6, k) array
        Effect of the states on the error of each pose.
    in_step : (N-1, 6, k) array
        Effect of the states on the error of each increment.
    """

    phi: float
    variances: FloatArray
    in_pose: FloatArray
    in_step: FloatArray


@dataclass(frozen=True)
class _StateSpace:
    """``x_{i+1} = F_i x_i + q_i``, ``z_i = H_i x_i + white``, in information form.

    ``H`` (N, 6, s), ``F`` and ``Q_inverse`` (N-1, s, s), ``first`` (s, s): information on x_0.
    """

    H: FloatArray
    F: FloatArray
    Q_inverse: FloatArray
    first: FloatArray


def cramer_rao_bound(
    sides: Sequence[Side], child: FloatArray, dt: float
) -> FloatArray:
    """Return the smallest covariance (6, 6) of xi in ``X Exp(xi)`` of any unbiased estimator.

    xi is (rho, phi) in the child frame.

    Parameters
    ----------
    sides : sequence of Side
    child : (N, 4, 4) array
        True poses of the child sensor.
    dt : float
        Time between poses, s.
    """
    information = normal_equations(sides, child, dt)
    covariance = _inverted(information)
    return covariance[:6, :6]


def ideal_estimate(
    sides: Sequence[Side], child: FloatArray, dt: float, z: FloatArray
) -> FloatArray:
    """Return the estimate (6,) of xi that attains the bound: least squares under the true noise.

    Parameters
    ----------
    sides, child, dt
        As for :func:`cramer_rao_bound`.
    z : (N, 6) array
        Differences of both sensors at each pose, see the model of this module.
    """
    equations = normal_equations(sides, child, dt, z)
    information = equations[:-1, :-1]
    right_side = equations[:-1, -1]
    covariance = _inverted(information)
    estimate = covariance @ right_side
    return estimate[:6]


def normal_equations(
    sides: Sequence[Side],
    child: FloatArray,
    dt: float,
    z: FloatArray | None = None,
) -> FloatArray:
    """Return the normal equations of the unknowns, after the states are eliminated.

    The unknowns are xi (6) and, if no odometry drifts, the pose (6) of one world in the other. If
    ``z`` is given, the last row and column belong to the right-hand side.
    """
    n_poses = len(child)
    white: FloatArray = np.zeros((6, 6))
    walk: FloatArray = np.zeros((6, 6))
    latents = []
    for side in sides:
        to_error = side.to_error
        white = white + to_error @ side.drawn.white @ to_error.T
        walk = walk + to_error @ side.drawn.walk @ to_error.T
        latents += _latents(side, dt)

    columns = [np.tile(np.eye(6), (n_poses, 1, 1))]
    if walk.any():
        steps = se3.inverse(child[:-1]) @ child[1:]
        adjoints = se3.adjoint(se3.inverse(steps))
        space = _drifting(adjoints, _inverted(walk), latents)
    else:
        middle = child[n_poses // 2]
        to_middle = se3.inverse(child) @ middle
        columns.append(se3.adjoint(to_middle))
        space = _stationary(n_poses, latents)
    if z is not None:
        columns.append(z[:, :, None])
    all_columns = np.concatenate(columns, axis=2)
    return _eliminated(_inverted(white), all_columns, space)


def _latents(side: Side, dt: float) -> list[_Latent]:
    """Return the latent processes of a sensor: slow errors, and the drifting scale."""
    errors = side.errors
    Ts = side.Ts
    to_error = side.to_error
    n_poses = len(Ts)
    not_in_step = np.zeros((n_poses - 1, 6, 6))
    latents = []
    for process in errors.slow:
        phi = _phi(dt, process.tau_s)
        in_pose = to_error @ directions(process, Ts)
        latents.append(_Latent(phi, process.sigma**2, in_pose, not_in_step))
    if errors.scale is not None:
        sigma, tau_s = errors.scale
        variances = np.array([sigma**2])
        steps = se3.inverse(Ts[:-1]) @ Ts[1:]
        in_step = scale_columns(steps) @ to_error.T
        not_in_pose = np.zeros((n_poses, 6, 1))
        phi = _phi(dt, tau_s)
        latents.append(
            _Latent(phi, variances, not_in_pose, in_step[:, :, None])
        )
    return latents


def _phi(dt: float, tau_s: float) -> float:
    return float(np.exp(-dt / tau_s))


def _drifting(
    adjoints: FloatArray, walk_inverse: FloatArray, latents: list[_Latent]
) -> _StateSpace:
    """Return the state space of d, a random walk with unknown start, and the latent processes."""
    n_steps = len(adjoints)
    size = 6 + sum(len(latent.variances) for latent in latents)
    F = np.zeros((n_steps, size, size))
    Q_inverse = np.zeros((n_steps, size, size))
    first = np.zeros((size, size))
    in_poses = [np.tile(np.eye(6), (n_steps + 1, 1, 1))]
    F[:, :6, :6] = adjoints
    Q_inverse[:, :6, :6] = walk_inverse
    start = 6
    for latent in latents:
        n_states = len(latent.variances)
        block = slice(start, start + n_states)
        innovation_variances = (1.0 - latent.phi**2) * latent.variances
        F[:, :6, block] = latent.in_step
        F[:, block, block] = latent.phi * np.eye(n_states)
        Q_inverse[:, block, block] = _inverse(innovation_variances)
        first[block, block] = _inverse(latent.variances)
        in_poses.append(latent.in_pose)
        start = block.stop
    H = np.concatenate(in_poses, axis=2)
    return _StateSpace(H, F, Q_inverse, first)


def _stationary(count: int, latents: list[_Latent]) -> _StateSpace:
    """Return the state space of the latent processes alone; none of them affects increments."""
    phis = [np.zeros(0)]
    variances = [np.zeros(0)]
    in_poses = [np.zeros((count, 6, 0))]
    for latent in latents:
        phis.append(np.full(len(latent.variances), latent.phi))
        variances.append(latent.variances)
        in_poses.append(latent.in_pose)
    phi = np.concatenate(phis)
    variance = np.concatenate(variances)
    innovation_variance = (1.0 - phi**2) * variance
    steps = (count - 1, 1, 1)
    return _StateSpace(
        H=np.concatenate(in_poses, axis=2),
        F=np.tile(np.diag(phi), steps),
        Q_inverse=np.tile(_inverse(innovation_variance), steps),
        first=_inverse(variance),
    )


def _inverted(matrices: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def _inverse(variances: FloatArray) -> FloatArray:
    bounded = np.maximum(variances, _LEAST_VARIANCE)
    return np.diag(1.0 / bounded)


def _eliminated(
    weights: FloatArray, columns: FloatArray, space: _StateSpace
) -> FloatArray:
    """Return the weighted Gram matrix (p, p) of columns (N, 6, p), with the states eliminated."""
    n_columns = columns.shape[2]
    gram = np.einsum(
        "nji,njk,nkl->il", columns, weights, columns, optimize=True
    )
    n_states = space.H.shape[2]
    if n_states == 0:
        return gram

    weighted = np.swapaxes(space.H, 1, 2) @ weights
    diagonal = weighted @ space.H
    diagonal[0] += space.first
    diagonal[1:] += space.Q_inverse
    F_transposed = np.swapaxes(space.F, 1, 2)
    diagonal[:-1] += F_transposed @ space.Q_inverse @ space.F
    below = -space.Q_inverse @ space.F

    coupling = weighted @ columns
    coupling = coupling.reshape(-1, n_columns)
    factor = cholesky_banded(_banded(diagonal, below), lower=True)
    solution = cho_solve_banded((factor, True), coupling)
    return gram - coupling.T @ solution


def _banded(diagonal: FloatArray, below: FloatArray) -> FloatArray:
    """Return the lower band storage of a symmetric block tridiagonal matrix.

    ``diagonal`` (N, s, s) are its diagonal blocks, ``below`` (N-1, s, s) the blocks below them.
    """
    n_poses, size, _ = diagonal.shape
    bands = np.zeros((2 * size, n_poses * size))
    end = (n_poses - 1) * size
    for column in range(size):
        for row in range(size):
            if row >= column:
                bands[row - column, column::size] = diagonal[:, row, column]
            band = size + row - column
            bands[band, column:end:size] = below[:, row, column]
    return bands
