"""The Cramer-Rao bound of an extrinsic under the true noise, exact to first order.

With ``c = Ad(X^-1) a - b`` (a, b: errors of both sensors' poses) a recording shows
``z_i = c_i + d_i + xi``. Here ``d_i = Ad(B_i^-1) d_{i-1} + walk`` holds the unknown pose of one
world in the other and the drift of odometry. That is a linear state space: its information matrix
is block tridiagonal, and one band Cholesky factorisation eliminates all but xi.
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
    """One sensor."""

    errors: SensorErrors
    drawn: DrawnErrors
    # True poses; (N, 4, 4) array.
    Ts: FloatArray
    # Takes its errors into c: Ad(X^-1) of the parent, -I of the child; (6, 6) array.
    to_error: FloatArray


@dataclass(frozen=True)
class _Latent:
    """A latent process: its transition, stationary variances (k,), and where it enters: the error
    of each pose (N, 6, k), and the increments (N-1, 6, k).
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


def cramer_rao_bound(sides: Sequence[Side], child: FloatArray, dt: float) -> FloatArray:
    """Least covariance (6, 6) of xi in ``X Exp(xi)``, (rho, phi), child frame, of any unbiased
    estimator.

    Parameters
    ----------
    sides : sequence of Side
    child : (N, 4, 4) array
        True poses of the child sensor.
    dt : float
        Time between poses, s.
    """
    return _inverted(normal_equations(sides, child, dt))[:6, :6]


def ideal_estimate(
    sides: Sequence[Side], child: FloatArray, dt: float, z: FloatArray
) -> FloatArray:
    """The estimate (6,) of xi that attains the bound: least squares under the true noise.

    Parameters
    ----------
    sides, child, dt
        As for :func:`cramer_rao_bound`.
    z : (N, 6) array
        What the recording shows, see the module.
    """
    gram = normal_equations(sides, child, dt, z)
    return (_inverted(gram[:-1, :-1]) @ gram[:-1, -1])[:6]


def normal_equations(
    sides: Sequence[Side], child: FloatArray, dt: float, z: FloatArray | None = None
) -> FloatArray:
    """Information on xi, behind it on the pose of the worlds if odometry does not drift, and the
    right-hand side as last column if z is given.
    """
    white = sum(
        (s.to_error @ s.drawn.white @ s.to_error.T for s in sides), np.zeros((6, 6))
    )
    walk = sum(
        (s.to_error @ s.drawn.walk @ s.to_error.T for s in sides), np.zeros((6, 6))
    )
    latents = [latent for side in sides for latent in _latents(side, dt)]
    columns = [np.tile(np.eye(6), (len(child), 1, 1))]
    if walk.any():
        steps = se3.inverse(child[:-1]) @ child[1:]
        space = _drifting(se3.adjoint(se3.inverse(steps)), _inverted(walk), latents)
    else:
        columns.append(se3.adjoint(se3.inverse(child) @ child[len(child) // 2]))
        space = _stationary(len(child), latents)
    if z is not None:
        columns.append(z[:, :, None])
    return _eliminated(_inverted(white), np.concatenate(columns, axis=2), space)


def _latents(side: Side, dt: float) -> list[_Latent]:
    errors = side.errors
    Ts = side.Ts
    G = side.to_error
    nowhere = np.zeros((len(Ts) - 1, 6, 6))
    latents = [
        _Latent(
            _phi(dt, process.tau_s),
            process.sigma**2,
            G @ directions(process, Ts),
            nowhere,
        )
        for process in errors.slow
    ]
    if errors.scale is not None:
        sigma, tau_s = errors.scale
        columns = scale_columns(se3.inverse(Ts[:-1]) @ Ts[1:]) @ G.T
        nowhere = np.zeros((len(Ts), 6, 1))
        latents.append(
            _Latent(_phi(dt, tau_s), np.array([sigma**2]), nowhere, columns[:, :, None])
        )
    return latents


def _phi(dt: float, tau_s: float) -> float:
    return float(np.exp(-dt / tau_s))


def _drifting(
    adjoints: FloatArray, walk_inverse: FloatArray, latents: list[_Latent]
) -> _StateSpace:
    """States (d, latents), d a random walk of unknown start."""
    count = len(adjoints)
    size = 6 + sum(len(latent.variances) for latent in latents)
    F = np.zeros((count, size, size))
    Q_inverse = np.zeros((count, size, size))
    F[:, :6, :6] = adjoints
    Q_inverse[:, :6, :6] = walk_inverse
    first = np.zeros((size, size))
    at = 6
    for latent in latents:
        block = slice(at, at + len(latent.variances))
        F[:, :6, block] = latent.in_step
        F[:, block, block] = latent.phi * np.eye(len(latent.variances))
        Q_inverse[:, block, block] = _inverse((1.0 - latent.phi**2) * latent.variances)
        first[block, block] = _inverse(latent.variances)
        at = block.stop
    d = np.tile(np.eye(6), (count + 1, 1, 1))
    H = np.concatenate([d, *(latent.in_pose for latent in latents)], axis=2)
    return _StateSpace(H, F, Q_inverse, first)


def _stationary(count: int, latents: list[_Latent]) -> _StateSpace:
    """States (latents) alone, none of them in the increments."""
    nothing = np.zeros(0)
    phi = np.concatenate(
        [nothing, *(0.0 * latent.variances + latent.phi for latent in latents)]
    )
    variances = np.concatenate([nothing, *(latent.variances for latent in latents)])
    return _StateSpace(
        np.concatenate(
            [np.zeros((count, 6, 0)), *(latent.in_pose for latent in latents)], axis=2
        ),
        np.tile(np.diag(phi), (count - 1, 1, 1)),
        np.tile(_inverse((1.0 - phi**2) * variances), (count - 1, 1, 1)),
        _inverse(variances),
    )


def _inverted(matrices: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def _inverse(variances: FloatArray) -> FloatArray:
    return np.diag(1.0 / np.maximum(variances, _LEAST_VARIANCE))


def _eliminated(
    weights: FloatArray, columns: FloatArray, space: _StateSpace
) -> FloatArray:
    """Gram matrix (p, p) of columns (N, 6, p) after eliminating the states."""
    gram = np.einsum("nji,njk,nkl->il", columns, weights, columns, optimize=True)
    if not space.H.shape[2]:
        return gram
    weighted = np.swapaxes(space.H, 1, 2) @ weights
    diagonal = weighted @ space.H
    diagonal[0] += space.first
    diagonal[1:] += space.Q_inverse
    diagonal[:-1] += np.swapaxes(space.F, 1, 2) @ space.Q_inverse @ space.F
    coupling = (weighted @ columns).reshape(-1, columns.shape[2])
    factor = cholesky_banded(_banded(diagonal, -space.Q_inverse @ space.F), lower=True)
    return gram - coupling.T @ cho_solve_banded((factor, True), coupling)


def _banded(diagonal: FloatArray, below: FloatArray) -> FloatArray:
    """Lower band storage of a symmetric block tridiagonal matrix."""
    count, size, _ = diagonal.shape
    bands = np.zeros((2 * size, count * size))
    for column in range(size):
        for row in range(size):
            if row >= column:
                bands[row - column, column::size] = diagonal[:, row, column]
            bands[size + row - column, column : (count - 1) * size : size] = below[
                :, row, column
            ]
    return bands
