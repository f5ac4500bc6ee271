"""Noise levels by restricted maximum likelihood (REML).

The derivatives are exact. They need only the blocks of the states' covariance on the diagonal and
beside it. The curvature is the average of observed and expected information (Gilmour, Thompson,
Cullis, Biometrics 51, 1995), ``1/2 f_k' P f_l`` with ``f_k = dV/dlevel_k P r``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.noise.normal import multiplied, transposed
from hand_eye_calib.core.noise.state_space import WHITE, Markov, Posterior, StateSpace
from hand_eye_calib.core.noise.tuning import Tuning

# Steps of levels shorter than this end a search; so does this number of steps.
_SHORTEST_STEP = 1e-3
_MAX_STEPS = 20


class Prior(NamedTuple):
    """Prior of the log levels: means, precisions and bounds, (m,) each."""

    mean: FloatArray
    precision: FloatArray
    lower: FloatArray
    upper: FloatArray

    def loss(self, levels: FloatArray) -> float:
        """Negative log density, constants left out."""
        return 0.5 * float((self.precision * (levels - self.mean) ** 2).sum())


# Space, levels and prior without processes that do not matter; None if all matter.
Rest: TypeAlias = tuple[StateSpace, FloatArray, Prior] | None


def fit(
    space: StateSpace,
    start: FloatArray,
    prior: Prior,
    tuning: Tuning,
    settled: float | None = None,
    smaller: Callable[[FloatArray, FloatArray], Rest] | None = None,
) -> tuple[Posterior, FloatArray]:
    """Minimise the loss over the levels by Newton steps within a radius.

    Parameters
    ----------
    space : StateSpace
    start : (m,) array
        Levels at the start.
    prior : Prior
    tuning : Tuning
    settled : float, optional
        Steps end if one promises to lower the loss by less. Default: the tuning's.
    smaller : callable, optional
        Called with levels and information before each step. Returns the space, levels and prior
        without processes that do not matter, or None if all matter.

    Returns
    -------
    Posterior
        At the levels of the least loss.
    (m, m) array
        Average information on the levels.
    """
    settled = tuning.settled_loss if settled is None else settled
    levels = np.clip(start, prior.lower, prior.upper)
    posterior = Posterior(space, levels)
    radius = tuning.first_radius
    loss = posterior.loss + prior.loss(levels)
    for _ in range(_MAX_STEPS):
        gradient, information = derivatives(posterior)
        rest = smaller(levels, information) if smaller else None
        if rest:
            space, levels, prior = rest
            posterior = Posterior(space, levels)
            loss = posterior.loss + prior.loss(levels)
            gradient, information = derivatives(posterior)
        gradient = gradient + prior.precision * (levels - prior.mean)
        curvature = information + np.diag(prior.precision + tuning.least_curvature)
        gain = 0.0
        while radius > _SHORTEST_STEP:
            step, is_newton = _step(levels, gradient, curvature, prior, radius)
            promised = -float(gradient @ step + 0.5 * step @ curvature @ step)
            is_small = is_newton and promised < settled
            if is_small or np.abs(step).max() < _SHORTEST_STEP:
                break
            try:
                rival = Posterior(space, levels + step)
                gain = loss - (rival.loss + prior.loss(rival.levels))
            except np.linalg.LinAlgError:
                gain = 0.0
            if gain > 0.0:
                break
            radius = tuning.shrink * float(np.abs(step).max())
            gain = 0.0
        if gain == 0.0:
            break
        levels = rival.levels
        posterior = rival
        loss = loss - gain
        if gain > tuning.good * promised:
            radius = min(2.0 * radius, tuning.largest_radius)
        elif gain < tuning.poor * promised:
            radius = 0.5 * float(np.abs(step).max())
        if gain < 0.5 * settled:
            break
    return posterior, information


def _step(
    levels: FloatArray, gradient: FloatArray, curvature: FloatArray, prior: Prior, radius: float
) -> tuple[FloatArray, bool]:
    """Return the step of the levels, damped to stay within the radius, and whether it is undamped.

    Levels at a bound that the gradient pushes against do not move.
    """
    free = (levels > prior.lower + 1e-9) | (gradient < 0)
    free &= (levels < prior.upper - 1e-9) | (gradient > 0)
    step = np.zeros(len(levels))
    damping = 0.0
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
    space = posterior.space
    precision = posterior.white
    states, walk = posterior.restricted()
    white = states[:, :WHITE]
    moments = white @ transposed(white)
    moments += posterior.factor.selected_inverse[0][:, :WHITE, :WHITE]
    moments *= space.weights[:, None, None]
    excess = precision - precision @ moments @ precision
    excess[space.weights == 0.0] = 0.0
    traces = [float((excess * basis).sum()) for basis in space.white]
    along = (excess @ space.twists[:, :, None])[:, :, 0]
    traces.append(float((along * space.twists).sum()))
    moments = walk_covariance(posterior) + walk @ transposed(walk)
    total = np.tensordot(posterior.evidence, moments, axes=1)
    excess = (~space.cut).sum() * posterior.walk - posterior.walk @ total @ posterior.walk
    traces += [float((excess * basis).sum()) for basis in space.walk]
    gradient = [0.5 * np.exp(posterior.levels[: len(traces)]) * traces]
    gradient += [_markov_gradient(posterior, process, states) for process in posterior.markov]
    information = _average_information(posterior, states[:, :, 0], walk[:, :, 0])
    return np.concatenate(gradient), information


def walk_covariance(posterior: Posterior) -> FloatArray:
    """Covariance (n, 6, 6) of the walk's increments for known parameters."""
    covariance, below = posterior.factor.selected_inverse
    space = posterior.space
    back = transposed(posterior.space.behind)
    half = space.ahead_times(covariance[1:])
    own = space.ahead_times(transposed(half)) + transposed(back) @ covariance[:-1] @ back
    mixed = space.ahead_times(below) @ back
    own -= mixed
    own -= transposed(mixed)
    return own


def _markov_gradient(posterior: Posterior, process: Markov, states: FloatArray) -> FloatArray:
    phi = process.phi
    rest = process.rest
    group = process.states
    covariance, below = posterior.factor.selected_inverse
    own = states[:, group]
    here = np.einsum("nii->n", covariance[:, group, group]) + np.einsum("nij,nij->n", own, own)
    ahead = np.einsum("nii->n", below[:, group, group])
    ahead += np.einsum("nij,nij->n", own[1:], own[:-1])
    innovations = here[1:] - 2.0 * phi * ahead + phi**2 * here[:-1]
    size = own.shape[1]
    variance = process.variance
    total = here[0] + float((innovations / rest).sum())
    by_variance = 0.5 * (size * len(here) - total / variance)
    by_phi = (phi * innovations / rest**2 - (ahead - phi * here[:-1]) / rest) / variance
    by_phi -= size * phi / rest
    return np.array([by_variance, float((by_phi * process.slope).sum())])


def _average_information(posterior: Posterior, states: FloatArray, walk: FloatArray) -> FloatArray:
    space = posterior.space
    variances = np.exp(posterior.levels)
    n_white = len(space.white)
    moved = np.zeros((*states.shape, len(variances)))
    pulled = (posterior.white @ states[:, :WHITE, None])[:, :, 0]
    pulled[space.weights == 0.0] = 0.0
    for index, basis in enumerate(space.white):
        moved[:, :WHITE, index] = variances[index] * (basis @ pulled[:, :, None])[:, :, 0]
    along = variances[n_white] * (space.twists * pulled).sum(axis=1)
    moved[:, :WHITE, n_white] = along[:, None] * space.twists
    for at, process in enumerate(posterior.markov):
        level = n_white + 1 + len(space.walk) + 2 * at
        values = states[:, process.states]
        moved[:, process.states, level] = values
        moved[:, process.states, level + 1] = process.by_tau(values)
    columns = space.observed(moved)
    pushed = walk @ posterior.walk
    for index, basis in enumerate(space.walk, start=n_white + 1):
        columns[:, :, index] = variances[index] * pushed @ basis
    columns[space.cut] = 0.0
    weighed, whitened = posterior.halves(columns)
    own = multiplied(columns, weighed) - multiplied(whitened, whitened)
    shared = multiplied(space.columns, weighed) - multiplied(posterior.whitened, whitened)
    shared = shared[:-1]
    information = 0.5 * (own - shared.T @ posterior.normal.covariance @ shared)
    return 0.5 * (information + information.T)
