"""Noise levels by restricted maximum likelihood (REML).

The symbols are those of :mod:`hand_eye_calib.core.noise`. theta are the levels: the logarithms of
variances and of time constants. V is the covariance of the residuals e. The loss is the restricted
negative log likelihood (Patterson, Thompson, Biometrika 58, 1971):

    loss = 1/2 (log|V| + e' P e + log|J' V^-1 J|)
    P = V^-1 - V^-1 J (J' V^-1 J)^-1 J' V^-1
    d loss / d theta_k = 1/2 (tr(P V_k) - e' P V_k P e),      V_k = dV / d theta_k

The information ``J' V^-1 J`` contains the prior of beta. The gradient is exact. It needs only the
blocks of the states' covariance on the diagonal and next to it. The curvature is the average
information, the mean of observed and expected information (Gilmour, Thompson, Cullis, Biometrics
51, 1995): ``1/2 f_k' P f_l`` with ``f_k = V_k P e``.
"""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.noise.normal import multiplied, transposed
from hand_eye_calib.core.noise.state_space import (
    WHITE,
    Markov,
    Posterior,
    StateSpace,
)

# Largest number of Newton steps of one search.
MAX_STEPS = 20

# Longest step of a level. A variance changes at most by a factor of 4.5.
_MAX_STEP = 1.5
# A step that does not lower the loss is shortened by this factor and tried again ...
_SHORTENING_FACTOR = 0.3
# ... unless it is shorter than this change of a level, which would change a variance by 0.1 %.
_MIN_STEP = 1e-3

# Information that is added to every level. It limits the step of levels without influence on the
# loss.
_ADDED_INFORMATION = 0.05


class Prior(NamedTuple):
    """Gaussian prior of the levels (m,), with bounds."""

    mean: FloatArray
    precision: FloatArray
    lower: FloatArray
    upper: FloatArray

    def loss(self, levels: FloatArray) -> float:
        """Return the negative log density at the levels (m,), without constants."""
        return 0.5 * float((self.precision * (levels - self.mean) ** 2).sum())


def fit(
    space: StateSpace,
    start: FloatArray,
    prior: Prior,
    settled_loss: float,
    n_steps: int = MAX_STEPS,
) -> tuple[Posterior, FloatArray]:
    """Minimise the restricted loss plus the loss of the prior, by damped Newton steps.

    Parameters
    ----------
    space : StateSpace
    start : (m,) array
        Levels at the start.
    prior : Prior
        Prior and bounds of the levels.
    settled_loss : float
        The search ends if the next step is predicted to lower the loss by less than this.
    n_steps : int
        Largest number of steps.

    Returns
    -------
    Posterior
        Posterior at the levels with the smallest loss.
    (m, m) array
        Average information on the levels, without the prior. It belongs to the returned levels if
        the search ended before a step. Otherwise it belongs to the levels before the last step.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the covariance at the start is not positive definite up to rounding.
    """
    posterior = Posterior(space, np.clip(start, prior.lower, prior.upper))
    loss = posterior.loss + prior.loss(posterior.levels)
    for _ in range(n_steps):
        gradient, information = derivatives(posterior)
        gradient = gradient + prior.precision * (posterior.levels - prior.mean)
        curvature = information + np.diag(prior.precision + _ADDED_INFORMATION)
        step = _newton_step(posterior.levels, gradient, curvature, prior)
        predicted_gain = -float(gradient @ step + 0.5 * step @ curvature @ step)
        if predicted_gain < settled_loss:
            break
        posterior, gain = _search_along(posterior, step, prior, loss)
        loss -= gain
        if gain < 0.5 * settled_loss:
            break
    return posterior, information


def _search_along(
    posterior: Posterior, step: FloatArray, prior: Prior, loss: float
) -> tuple[Posterior, float]:
    """Take a step of the levels (m,), shortened if necessary until it lowers the loss.

    Returns
    -------
    Posterior
        Posterior after the step; ``posterior`` if even the shortest step does not lower the loss.
    float
        Decrease of the loss.
    """
    while np.abs(step).max() > _MIN_STEP:
        with suppress(np.linalg.LinAlgError):
            rival = Posterior(posterior.space, posterior.levels + step)
            gain = loss - rival.loss - prior.loss(rival.levels)
            if gain > 0.0:
                return rival, gain
        step = _SHORTENING_FACTOR * step
    return posterior, 0.0


def _newton_step(
    levels: FloatArray,
    gradient: FloatArray,
    curvature: FloatArray,
    prior: Prior,
) -> FloatArray:
    """Return the damped Newton step of the levels (m,). No level moves by more than _MAX_STEP.

    A level at a bound stays there if its descent direction crosses the bound.
    """
    may_decrease = levels > prior.lower + 1e-9
    may_increase = levels < prior.upper - 1e-9
    is_free = (may_decrease | (gradient < 0)) & (may_increase | (gradient > 0))
    gradient = gradient[is_free]
    curvature = curvature[np.ix_(is_free, is_free)]
    added_damping = 0.05 * np.abs(gradient).max(initial=0.0) / _MAX_STEP
    step = np.zeros(len(levels))
    damping = 0.0
    while True:
        step[is_free] = -np.linalg.solve(
            curvature + damping * np.eye(len(gradient)), gradient
        )
        if np.abs(step).max() <= _MAX_STEP:
            return np.clip(levels + step, prior.lower, prior.upper) - levels
        damping = 2.0 * damping + added_damping


def derivatives(posterior: Posterior) -> tuple[FloatArray, FloatArray]:
    """Return the gradient (m,) of the loss and the average information (m, m) of the levels.

    By Fisher's identity, the gradient is the expected gradient of the joint negative log density of
    states and walk, at the posterior of this model. The posterior itself is not differentiated. So
    each error contributes the derivative of ``1/2 (tr(S^-1 E) + log|S|)`` with its prior covariance
    S and its posterior second moments E, which count as constant. E contains the uncertainty of
    beta.

    For the white errors v of a pose, S is a sum of bases. The derivative with respect to the level
    of a basis is ``1/2 exp(level) tr(D basis)`` with ``D = S^-1 - S^-1 E[v v'] S^-1``, summed over
    all poses. The derivative with respect to a level of the walk has the same form.
    """
    states, walk = posterior.smoothed()
    white_D = _white_difference(posterior, states[:, :WHITE])
    traces = [
        float((white_D * basis).sum()) for basis in posterior.space.white_bases
    ]
    walk_D = _walk_difference(posterior, walk)
    traces += [
        float((walk_D * basis).sum()) for basis in posterior.space.walk_bases
    ]
    variances = np.exp(posterior.levels[: len(traces)])
    gradient = [0.5 * variances * traces]
    gradient += [
        _group_gradient(posterior, group, states) for group in posterior.groups
    ]
    information = _average_information(
        posterior, states[:, :, 0], walk[:, :, 0]
    )
    return np.concatenate(gradient), information


def _white_difference(posterior: Posterior, white: FloatArray) -> FloatArray:
    """Return D (N, 6, 6) of :func:`derivatives` for the smoothed white errors (N, 6, 1 + p)."""
    weights = posterior.space.weights
    moments = white @ transposed(white)
    moments += posterior.factor.selected_inverse[0][:, :WHITE, :WHITE]
    moments *= weights[:, None, None]
    precision = posterior.white_precision
    difference = precision - precision @ moments @ precision
    difference[weights == 0.0] = 0.0
    return difference


def _walk_difference(posterior: Posterior, walk: FloatArray) -> FloatArray:
    """Return D (6, 6) of :func:`derivatives` for the smoothed walk (n, 6, 1 + p), summed."""
    moments = posterior.walk_covariances() + walk @ transposed(walk)
    total = np.tensordot(posterior.walk_weights, moments, axes=1)
    precision = posterior.walk_precision
    n_used = (~posterior.space.cut).sum()
    return n_used * precision - precision @ total @ precision


def _group_gradient(
    posterior: Posterior, group: Markov, states: FloatArray
) -> FloatArray:
    """Return the derivatives (2,) of the loss with respect to the two levels of a group.

    The levels are the log variance and the log time constant. The result is the derivative of
    ``1/2 (tr(Pi E[g g']) - log|Pi|)``, summed over the processes g of the group. Pi is their prior
    precision. Their posterior second moments E[g g'] count as constant, see :func:`derivatives`.
    """
    covariance, below = posterior.factor.selected_inverse
    values = states[:, group.states]
    n_poses, n_processes, _ = values.shape
    # Second moments, summed over the processes of the group: at each pose (N,), and between each
    # pose and the previous pose (n,).
    squares = np.einsum("nii->n", covariance[:, group.states, group.states])
    squares += np.einsum("nij,nij->n", values, values)
    products = np.einsum("nii->n", below[:, group.states, group.states])
    products += np.einsum("nij,nij->n", values[1:], values[:-1])
    trace = group.diagonal @ squares + 2.0 * group.between @ products
    by_log_variance = n_processes * n_poses - trace
    diagonal, between, log_determinant = group.by_log_tau()
    by_log_tau = diagonal @ squares + 2.0 * between @ products
    by_log_tau += n_processes * log_determinant
    return np.array([0.5 * by_log_variance, 0.5 * by_log_tau])


def _average_information(
    posterior: Posterior, states: FloatArray, walk: FloatArray
) -> FloatArray:
    """Return the average information (m, m), given the posterior means of states and walk.

    It equals ``1/2 f' P f = 1/2 (f' V^-1 f - f' V^-1 J (J' V^-1 J)^-1 J' V^-1 f)``.

    Parameters
    ----------
    posterior : Posterior
    states : (N, d) array
    walk : (n, 6) array
    """
    space = posterior.space
    f = _working_columns(posterior, states, walk)
    weighted, whitened = posterior.forward_half(f)
    f_V_f = multiplied(f, weighted) - multiplied(whitened, whitened)
    J_V_f = multiplied(space.columns, weighted) - multiplied(
        posterior.whitened, whitened
    )
    J_V_f = J_V_f[:-1]
    information = 0.5 * (f_V_f - J_V_f.T @ posterior.normal.covariance @ J_V_f)
    return 0.5 * (information + information.T)


def _working_columns(
    posterior: Posterior, states: FloatArray, walk: FloatArray
) -> FloatArray:
    """Return the columns f_k (n, 6, m) of the average information, one column per level."""
    space = posterior.space
    variances = np.exp(posterior.levels)
    n_white = len(space.white_bases)
    # Levels of white errors and of processes: f_k = U (d Pi^-1 / d theta_k) Pi x. For white errors
    # with the weight z, Pi is z S^-1 and d Pi^-1 is d S / z, so that the weights cancel.
    moved = np.zeros((*states.shape, len(variances)))
    forces = (posterior.white_precision @ states[:, :WHITE, None])[:, :, 0]
    forces[space.weights == 0.0] = 0.0
    for level, basis in enumerate(space.white_bases):
        moved[:, :WHITE, level] = (
            variances[level] * (basis @ forces[:, :, None])[:, :, 0]
        )
    first_of_groups = n_white + len(space.walk_bases)
    for level, group in zip(
        range(first_of_groups, len(variances), 2), posterior.groups, strict=True
    ):
        values = states[:, group.states]
        moved[:, group.states, level] = values
        moved[:, group.states, level + 1] = group.covariance_by_log_tau(values)
    f = space.apply_u(moved)
    # Levels of the walk: f_k = (d W^-1 / d theta_k) W w.
    forces = walk @ posterior.walk_precision
    for level, basis in enumerate(space.walk_bases, start=n_white):
        f[:, :, level] = variances[level] * forces @ basis
    f[space.cut] = 0.0
    return f
