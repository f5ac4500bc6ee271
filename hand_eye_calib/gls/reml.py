"""Noise levels by restricted maximum likelihood: exact derivatives, average information.

The derivatives need only the blocks of the states' covariance on the diagonal and beside it; the
curvature is the average of observed and expected information (Gilmour, Thompson, Cullis, Biometrics
51, 1995), ``1/2 f_k' P f_l`` with ``f_k = dV/dlevel_k P r``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.gls.block_tridiagonal import transposed
from hand_eye_calib.gls.normal import multiplied
from hand_eye_calib.gls.state_space import WHITE, Markov, Posterior, StateSpace

# The search ends if a step promises to lower the loss by less: noise levels need no more than a few
# per cent. Steps stay within a radius of the log levels.
_SETTLED_LOSS, _SETTLED_STEP, _MAX_STEPS = 0.05, 1e-3, 20
_FIRST_RADIUS, _LARGEST_RADIUS = 1.5, 3.0
_GOOD, _POOR, _SHRINK = 0.5, 0.2, 0.3

# Information that every level has beforehand: bounds the step along levels that do not matter.
_LEAST_CURVATURE = 0.05


@dataclass(frozen=True)
class Prior:
    """What is known of the log levels beforehand: means, precisions and bounds, (m,) each."""

    mean: FloatArray
    precision: FloatArray
    lower: FloatArray
    upper: FloatArray

    def loss(self, levels: FloatArray) -> float:
        """Negative log density, constants left out."""
        return 0.5 * float((self.precision * (levels - self.mean) ** 2).sum())

    def gradient(self, levels: FloatArray) -> FloatArray:
        """(m,) array: derivatives of the loss."""
        return self.precision * (levels - self.mean)


def fit(space: StateSpace, start: FloatArray, prior: Prior) -> tuple[Posterior, FloatArray]:
    """The posterior at the levels of the least loss near a start, by Newton steps within a radius;
    and the average information (m, m).
    """
    levels = np.clip(start, prior.lower, prior.upper)
    posterior, radius = Posterior(space, levels), _FIRST_RADIUS
    loss = posterior.loss + prior.loss(levels)
    for _ in range(_MAX_STEPS):
        gradient, information = derivatives(posterior)
        gradient = gradient + prior.gradient(levels)
        curvature = information + np.diag(prior.precision + _LEAST_CURVATURE)
        gain = 0.0
        while radius > _SETTLED_STEP:
            step, is_newton = _step(levels, gradient, curvature, prior, radius)
            promised = -float(gradient @ step + 0.5 * step @ curvature @ step)
            if np.abs(step).max() < _SETTLED_STEP or (is_newton and promised < _SETTLED_LOSS):
                break
            rival, rival_loss = _tried(space, levels + step, prior)
            gain = loss - rival_loss
            if gain > 0.0:
                break
            radius, gain = _SHRINK * float(np.abs(step).max()), 0.0
        if gain == 0.0 or rival is None:
            break
        levels, posterior, loss = rival.levels, rival, loss - gain
        if gain > _GOOD * promised:
            radius = min(2.0 * radius, _LARGEST_RADIUS)
        elif gain < _POOR * promised:
            radius = 0.5 * float(np.abs(step).max())
        if gain < 0.5 * _SETTLED_LOSS:
            break
    return posterior, information


def _tried(space: StateSpace, levels: FloatArray, prior: Prior) -> tuple[Posterior | None, float]:
    """The posterior at some levels, and its loss with the prior; infinite where there is none."""
    try:
        posterior = Posterior(space, levels)
    except np.linalg.LinAlgError:
        return None, np.inf
    loss = posterior.loss + prior.loss(levels)
    return posterior, loss if np.isfinite(loss) else np.inf


def _step(
    levels: FloatArray, gradient: FloatArray, curvature: FloatArray, prior: Prior, radius: float
) -> tuple[FloatArray, bool]:
    """Step of the levels that are free to move, damped to stay within the radius; and whether it
    is undamped.
    """
    free = (levels > prior.lower + 1e-9) | (gradient < 0)
    free &= (levels < prior.upper - 1e-9) | (gradient > 0)
    step, damping = np.zeros(len(levels)), 0.0
    values, vectors = np.linalg.eigh(curvature[np.ix_(free, free)])
    along = vectors.T @ gradient[free]
    least = 0.05 * max(float(np.abs(gradient[free]).max(initial=0.0)) / radius, 1e-3)
    while True:
        step[free] = -vectors @ (along / (values + damping))
        if np.abs(step).max() <= radius:
            break
        damping = max(2.0 * damping, least)
    return np.clip(levels + step, prior.lower, prior.upper) - levels, damping == 0.0


def derivatives(posterior: Posterior) -> tuple[FloatArray, FloatArray]:
    """Gradient (m,) of the loss by the log levels and the average information (m, m)."""
    states = posterior.restricted()
    walk = posterior.restricted_walk(states)
    gradient = np.concatenate(
        [
            _white_gradient(posterior, states[:, :WHITE]),
            _walk_gradient(posterior, walk),
            *(_markov_gradient(posterior, process, states) for process in posterior.markov),
        ]
    )
    return gradient, _average_information(posterior, states[:, :, 0], walk[:, :, 0])


def _white_gradient(posterior: Posterior, states: FloatArray) -> FloatArray:
    space, precision = posterior.space, posterior.white
    covariance, _ = posterior.selected_inverse
    moments = states @ transposed(states)
    moments += covariance[:, :WHITE, :WHITE]
    moments *= space.weights[:, None, None]
    excess = precision - precision @ moments @ precision
    excess[space.is_free] = 0.0
    total = excess.sum(axis=0)
    traces = [
        float((total * basis[0]).sum() if len(basis) == 1 else (excess * basis).sum())
        for basis in space.white
    ]
    along = (excess @ space.twists[:, :, None])[:, :, 0]
    traces.append(float((along * space.twists).sum()))
    return 0.5 * np.exp(posterior.levels[: len(traces)]) * traces


def _walk_gradient(posterior: Posterior, walk: FloatArray) -> FloatArray:
    space, precision = posterior.space, posterior.walk
    moments = walk_covariance(posterior) + walk @ walk.transpose(0, 2, 1)
    total = np.tensordot(posterior.evidence, moments, axes=1)
    excess = (~space.cut).sum() * precision - precision @ total @ precision
    first = space.n_white
    traces = [float((excess * basis).sum()) for basis in space.walk]
    return 0.5 * np.exp(posterior.levels[first : first + len(traces)]) * traces


def walk_covariance(posterior: Posterior) -> FloatArray:
    """Covariance (n, 6, 6) of the walk's increments for known parameters."""
    covariance, below = posterior.selected_inverse
    space, back = posterior.space, transposed(posterior.space.behind)
    half = space.ahead_times(covariance[1:])
    own = space.ahead_times(transposed(half)) + transposed(back) @ covariance[:-1] @ back
    mixed = space.ahead_times(below) @ back
    own -= mixed
    own -= transposed(mixed)
    return own


def _markov_gradient(posterior: Posterior, process: Markov, states: FloatArray) -> FloatArray:
    phi, rest, group = process.phi, process.rest, process.group.states
    covariance, below = posterior.selected_inverse
    own = states[:, group]
    here = np.einsum("nii->n", covariance[:, group, group]) + np.einsum("nij,nij->n", own, own)
    ahead = np.einsum("nii->n", below[:, group, group])
    ahead += np.einsum("nij,nij->n", own[1:], own[:-1])
    innovations = here[1:] - 2.0 * phi * ahead + phi**2 * here[:-1]
    size, variance = process.group.size, process.variance
    by_variance = 0.5 * (
        size * len(here) - (here[0] + float((innovations / rest).sum())) / variance
    )
    by_phi = (phi * innovations / rest**2 - (ahead - phi * here[:-1]) / rest) / variance
    by_phi -= size * phi / rest
    return np.array([by_variance, float((by_phi * process.slope).sum())])


def _average_information(posterior: Posterior, states: FloatArray, walk: FloatArray) -> FloatArray:
    space = posterior.space
    variances = np.exp(posterior.levels)
    moved = np.zeros((*states.shape, len(variances)))
    pulled = (posterior.white @ states[:, :WHITE, None])[:, :, 0]
    pulled[space.is_free] = 0.0
    for index, basis in enumerate(space.white):
        moved[:, :WHITE, index] = variances[index] * (basis @ pulled[:, :, None])[:, :, 0]
    along = variances[len(space.white)] * (space.twists * pulled).sum(axis=1)
    moved[:, :WHITE, len(space.white)] = along[:, None] * space.twists
    for process in posterior.markov:
        group = process.group
        values = states[:, group.states]
        moved[:, group.states, group.variance] = values
        moved[:, group.states, group.tau] = _by_tau(process, values)
    columns = space.observed(moved)
    pushed = walk @ posterior.walk
    for index, basis in enumerate(space.walk, start=space.n_white):
        columns[:, :, index] = variances[index] * pushed @ basis
    columns[space.cut] = 0.0
    weighed, whitened = posterior.halves(columns)
    own = multiplied(columns, weighed) - multiplied(whitened, whitened)
    shared = multiplied(space.columns, weighed) - multiplied(posterior.whitened, whitened)
    shared = shared[:-1]
    information = 0.5 * (own - shared.T @ posterior.normal.covariance @ shared)
    return 0.5 * (information + information.T)


def _by_tau(process: Markov, values: FloatArray) -> FloatArray:
    """Derivative by log tau of the states (N, k) that the covariance makes of fixed forces."""
    phi, rest, slope = process.phi, process.rest, process.slope
    by_rest = 2.0 * phi * slope / rest**2
    beside = (slope / rest + phi * by_rest)[:, None]
    first = (2.0 * phi * slope / rest + phi**2 * by_rest)[:, None]
    forces = np.zeros_like(values)
    forces[1:] += by_rest[:, None] * values[1:] - beside * values[:-1]
    forces[:-1] += first * values[:-1] - beside * values[1:]
    return -process.covariance_times(forces)
