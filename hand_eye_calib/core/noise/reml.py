"""Noise levels by restricted maximum likelihood (REML).

The loss of levels theta, which are logarithms, is the restricted negative log likelihood of the
residuals r under their covariance V (Patterson, Thompson, Biometrika 58, 1971):

    loss = 1/2 (log|V| + r'P r + log|J'V^-1 J|),    P = V^-1 - V^-1 J (J'V^-1 J)^-1 J'V^-1
    d loss / d theta_k = 1/2 (tr(P V_k) - r'P V_k P r),    V_k = dV / d theta_k

The gradient is exact; it needs only the blocks of the states' covariance on the diagonal and beside
it. The curvature is the average of observed and expected information (Gilmour, Thompson, Cullis,
Biometrics 51, 1995): ``1/2 f_k' P f_l`` with ``f_k = V_k P r``.
"""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.noise.normal import multiplied, transposed
from hand_eye_calib.core.noise.state_space import (
    LEVEL_CHANGE,
    WHITE,
    Markov,
    Posterior,
    StateSpace,
)

# Largest number of steps, and the shortest step of a log level.
MAX_STEPS = 20
_SHORTEST_STEP = 1e-3

# Longest step of a log level: a variance changes by a factor of 4.5 at most.
_LONGEST_STEP = 1.5
# Factor of a step that did not lower the loss.
_SHORTENED = 0.3

# Information added to every level. It bounds the step along levels that do not matter.
_ADDED_CURVATURE = 0.05


class Prior(NamedTuple):
    """Prior of the log levels: means, precisions and bounds, (m,) each."""

    mean: FloatArray
    precision: FloatArray
    lower: FloatArray
    upper: FloatArray

    def loss(self, levels: FloatArray) -> float:
        """Negative log density without constants."""
        return 0.5 * float((self.precision * (levels - self.mean) ** 2).sum())


def fit(
    space: StateSpace,
    start: FloatArray,
    prior: Prior,
    settled_loss: float,
    n_steps: int = MAX_STEPS,
) -> tuple[Posterior, FloatArray]:
    """Minimise the loss over the levels by Newton steps that are shortened if they overshoot.

    Parameters
    ----------
    space : StateSpace
    start : (m,) array
        Levels at the start.
    prior : Prior
    settled_loss : float
        The search ends if a step promises to lower the loss by less.
    n_steps : int
        Largest number of steps.

    Returns
    -------
    Posterior
        At the best levels.
    (m, m) array
        Average information on the levels.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the covariance at the start is not positive definite to rounding.
    """
    posterior = Posterior(space, np.clip(start, prior.lower, prior.upper))
    loss = posterior.loss + prior.loss(posterior.levels)
    for _ in range(n_steps):
        gradient, information = derivatives(posterior)
        gradient = gradient + prior.precision * (posterior.levels - prior.mean)
        curvature = information + np.diag(prior.precision + _ADDED_CURVATURE)
        step = _step(posterior.levels, gradient, curvature, prior)
        promised_gain = -float(gradient @ step + 0.5 * step @ curvature @ step)
        if promised_gain < settled_loss:
            break
        posterior, gain = _moved(posterior, step, prior, loss)
        loss -= gain
        if gain < 0.5 * settled_loss:
            break
    return posterior, information


def _moved(
    posterior: Posterior, step: FloatArray, prior: Prior, loss: float
) -> tuple[Posterior, float]:
    """Shorten a step until it lowers the loss.

    Returns
    -------
    Posterior
        After the step; the same one if even the shortest step does not lower the loss.
    float
        Decrease of the loss.
    """
    while np.abs(step).max() > _SHORTEST_STEP:
        with suppress(np.linalg.LinAlgError):
            rival = Posterior(posterior.space, posterior.levels + step)
            gain = loss - rival.loss - prior.loss(rival.levels)
            if gain > 0.0:
                return rival, gain
        step = _SHORTENED * step
    return posterior, 0.0


def _step(
    levels: FloatArray, gradient: FloatArray, curvature: FloatArray, prior: Prior
) -> FloatArray:
    """Return the Newton step of the levels (m,), damped until it is within the longest step.

    Levels at a bound that the gradient pushes against do not move.
    """
    is_free = (levels > prior.lower + 1e-9) | (gradient < 0)
    is_free &= (levels < prior.upper - 1e-9) | (gradient > 0)
    gradient = gradient[is_free]
    curvature = curvature[np.ix_(is_free, is_free)]
    least_damping = 0.05 * np.abs(gradient).max(initial=0.0) / _LONGEST_STEP
    step = np.zeros(len(levels))
    damping = 0.0
    while True:
        step[is_free] = -np.linalg.solve(curvature + damping * np.eye(len(gradient)), gradient)
        if np.abs(step).max() <= _LONGEST_STEP:
            return np.clip(levels + step, prior.lower, prior.upper) - levels
        damping = 2.0 * damping + least_damping


def derivatives(posterior: Posterior) -> tuple[FloatArray, FloatArray]:
    """Return the gradient (m,) of the loss and the average information (m, m).

    Both are with respect to the log levels.

    With S^-1 the precision of errors that have covariance S, and M the second moments of their
    smoothed values, the derivative with respect to the level of a basis is
    ``1/2 exp(level) tr((S^-1 - S^-1 M S^-1) basis)``.
    """
    space = posterior.space
    states, walk = posterior.smoothed()
    white = states[:, :WHITE]
    moments = white @ transposed(white)
    moments += posterior.factor.selected_inverse[0][:, :WHITE, :WHITE]
    moments *= space.weights[:, None, None]
    precision = posterior.white_precision
    excess = precision - precision @ moments @ precision
    excess[space.weights == 0.0] = 0.0
    traces = [float((excess * basis).sum()) for basis in space.white_bases]
    moments = posterior.walk_covariances() + walk @ transposed(walk)
    total = np.tensordot(posterior.evidence, moments, axes=1)
    walk_precision = posterior.walk_precision
    excess = (~space.cut).sum() * walk_precision - walk_precision @ total @ walk_precision
    traces += [float((excess * basis).sum()) for basis in space.walk_bases]
    gradient = [0.5 * np.exp(posterior.levels[: len(traces)]) * traces]
    gradient += [_group_gradient(posterior, group, states) for group in posterior.groups]
    information = _average_information(posterior, states[:, :, 0], walk[:, :, 0])
    return np.concatenate(gradient), information


def _group_gradient(posterior: Posterior, group: Markov, states: FloatArray) -> FloatArray:
    """Return numerical derivatives (2,) of the loss for one group.

    The derivatives are with respect to the log variance and the time constant of the group. The
    part of the loss that depends on these two is ``1/2 (tr(Pi M) - log|Pi|)`` with the second
    moments M of the smoothed processes and their precision Pi.
    """
    covariance, below = posterior.factor.selected_inverse
    values = states[:, group.states]
    n_processes = values.shape[1]
    # Second moments of each pose, and of each pose with the pose before.
    squares = np.einsum("nii->n", covariance[:, group.states, group.states])
    squares += np.einsum("nij,nij->n", values, values)
    products = np.einsum("nii->n", below[:, group.states, group.states])
    products += np.einsum("nij,nij->n", values[1:], values[:-1])
    gradient = np.zeros(2)
    for sign in (1.0, -1.0):
        for level, change in enumerate(sign * LEVEL_CHANGE * np.eye(2)):
            changed = group.changed(change)
            trace = float(changed.diagonal @ squares + 2.0 * changed.between @ products)
            deviance = trace + n_processes * changed.log_determinant
            gradient[level] += sign * deviance / (4.0 * LEVEL_CHANGE)
    return gradient


def _average_information(posterior: Posterior, states: FloatArray, walk: FloatArray) -> FloatArray:
    """Average information (m, m) at the smoothed states (N, d) and walk (n, 6)."""
    space = posterior.space
    variances = np.exp(posterior.levels)
    n_white = len(space.white_bases)
    # f_k through the states: their covariance's derivative times the forces on them.
    moved = np.zeros((*states.shape, len(variances)))
    forces = (posterior.white_precision @ states[:, :WHITE, None])[:, :, 0]
    forces[space.weights == 0.0] = 0.0
    for level, basis in enumerate(space.white_bases):
        moved[:, :WHITE, level] = variances[level] * (basis @ forces[:, :, None])[:, :, 0]
    first_of_groups = n_white + len(space.walk_bases)
    for level, group in zip(
        range(first_of_groups, len(variances), 2), posterior.groups, strict=True
    ):
        values = states[:, group.states]
        moved[:, group.states, level] = values
        moved[:, group.states, level + 1] = group.derivative_by_log_tau(values)
    columns = space.apply_u(moved)
    # f_k of the walk, which acts on the increments directly.
    forces = walk @ posterior.walk_precision
    for level, basis in enumerate(space.walk_bases, start=n_white):
        columns[:, :, level] = variances[level] * forces @ basis
    columns[space.cut] = 0.0
    weighted, whitened = posterior.forward_half(columns)
    own = multiplied(columns, weighted) - multiplied(whitened, whitened)
    shared = multiplied(space.columns, weighted) - multiplied(posterior.whitened, whitened)
    shared = shared[:-1]
    information = 0.5 * (own - shared.T @ posterior.normal.covariance @ shared)
    return 0.5 * (information + information.T)
