"""Which systematic errors the data ask for: models of them, one step from where the search stands,
judged under the same noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.gls.increments import N_SYSTEMATIC, TIME, parameters_of
from hand_eye_calib.gls.normal import NormalEquations, selected
from hand_eye_calib.gls.problem import Fit, Problem
from hand_eye_calib.gls.state_space import Posterior
from hand_eye_calib.gls.tuning import Tuning

_BIAS = parameters_of("bias")


@dataclass(frozen=True)
class Model:
    """A model of systematic errors.

    Attributes
    ----------
    parameters : list of int
        Those that it has: of a bias, along the axes that the data ask for.
    fit : NormalEquations
        Of X and these parameters.
    criterion : float
        Weighted squared residual and what the parameters add to it: the smallest is best.
    is_credible : bool
    """

    parameters: list[int]
    fit: NormalEquations
    criterion: float
    is_credible: bool = True


def systematic(problem: Problem, fit: Fit) -> Fit:
    """The model of systematic errors that the data ask for, one step from where the search stands,
    at poses freed of their errors. All models are judged under the same noise. If the clock is
    free, those with a time offset come first.
    """
    names = problem.systematic
    tried = sorted({column for name in names for column in parameters_of(name)})
    posterior = problem.posterior(fit, tried)
    models = _models(names, tried, posterior.products, problem.tuning)
    credible = {name: model for name, model in models.items() if model.is_credible}
    with_time = {name: model for name, model in credible.items() if TIME in model.parameters}
    if problem.is_clock_free and with_time:
        credible = with_time
    best = min(credible, key=lambda name: credible[name].criterion)
    if "bias" in best:
        # A scale is not of first order if it is large, and then a bias along the direction of
        # travel seems to be nearer: both are judged at their own parameters.
        scales = [name for name in credible if "scale" in name]
        nearest = sorted(scales, key=lambda name: credible[name].criterion)[:1]
        best = min(
            (best, *nearest), key=lambda name: _own_criterion(fit, posterior, credible[name])
        )
    chosen = replace(
        fit,
        systematic=best,
        columns=models[best].parameters,
        other_sigmas=_sigmas([models[name] for name in ("scale", "time") if name in models]),
        cov_beyond=fit.cov_beyond + spread_about(models[best], [*credible.values()]),
    ).moved(models[best].fit.step)
    states = posterior.states_after(models[best].fit.step, _columns(chosen.columns, tried))
    return chosen.freed(problem.streams, states)


def _own_criterion(fit: Fit, posterior: Posterior, model: Model) -> float:
    """Criterion of a model where its own step leads, under the same noise."""
    own = replace(fit, columns=model.parameters).moved(model.fit.step)
    columns = own.linearised(own.poses, own.course, own.error, own.columns).columns
    return posterior.with_columns(columns).normal.cost + model.criterion - model.fit.cost


def _models(
    names: Sequence[str], tried: list[int], products: FloatArray, tuning: Tuning
) -> dict[str, Model]:
    """Models by name, from products of the columns of X and of the parameters tried; the first is
    the plainest, and always credible.
    """

    def fitted(parameters: list[int]) -> NormalEquations:
        return NormalEquations(selected(products, _columns(parameters, tried)))

    known = parameters_of(names[0])
    plainest = fitted(known)
    models = {names[0]: Model(known, plainest, plainest.cost + tuning.penalty * len(known))}
    for name in names[1:]:
        choices = [
            Model(
                parameters,
                fit := fitted(parameters),
                fit.cost + penalty(fit, parameters, tuning),
                is_credible(fit, parameters, plainest, tuning),
            )
            for parameters in _choices(name)
        ]
        models[name] = min(choices, key=lambda one: (not one.is_credible, one.criterion))
    return models


def spread_about(chosen: Model, models: Sequence[Model]) -> FloatArray:
    """Covariance (6, 6) of X by the choice of a model: the spread of the answers of all that are
    credible about that of the chosen one, each with the probability that its criterion leaves it.
    """
    costs = np.array([model.criterion for model in models])
    chances = np.exp((costs.min() - costs) / 2)
    steps = np.array([model.fit.step[:6] for model in models]) - chosen.fit.step[:6]
    return np.asarray((chances / chances.sum() * steps.T) @ steps)


def _sigmas(models: Sequence[Model]) -> FloatArray:
    """Standard deviations (8,) of the parameters of models."""
    sigmas = np.zeros(N_SYSTEMATIC)
    for model in models:
        sigmas[model.parameters] = np.sqrt(np.diag(model.fit.covariance)[6:])
    return sigmas


def _columns(parameters: Sequence[int], tried: list[int]) -> list[int]:
    """Columns of X and of the parameters of a model beside the others."""
    return [*range(6), *(6 + tried.index(column) for column in parameters)]


def _choices(name: str) -> list[list[int]]:
    """The parameters that a model may have: a bias is along one axis, two or three."""
    parameters = parameters_of(name)
    axes = [index for index in parameters if index in _BIAS]
    others = [index for index in parameters if index not in _BIAS]
    sizes = range(min(len(axes), 1), len(axes) + 1)
    return [[*some, *others] for size in sizes for some in combinations(axes, size)]


def penalty(fit: NormalEquations, parameters: Sequence[int], tuning: Tuning) -> float:
    """What parameters add to the cost of a model; of a bias, minus twice the logarithm of the
    chance that the data's answer has beforehand (Laplace's approximation of the evidence).
    """
    is_bias = np.isin(parameters, _BIAS)
    total = tuning.penalty * float((~is_bias).sum())
    if is_bias.any():
        sizes = fit.step[6:][is_bias] / tuning.bias_scale
        covariance = fit.covariance[6:, 6:][np.ix_(is_bias, is_bias)] / tuning.bias_scale**2
        total += 2.0 * float(np.log(np.pi * (1.0 + sizes**2) / tuning.bias_odds).sum())
        total -= float(np.linalg.slogdet(2.0 * np.pi * covariance)[1])
    return total


def is_credible(
    fit: NormalEquations, parameters: Sequence[int], plainest: NormalEquations, tuning: Tuning
) -> bool:
    """Whether systematic errors are of a size that sensors have, and X can be told from them: its
    standard deviations do not grow too much from those with the plainest model.
    """
    if (np.abs(fit.step[6:]) > np.array(tuning.largest)[list(parameters)]).any():
        return False
    of_plainest = np.linalg.pinv(plainest.covariance[:6, :6], hermitian=True)
    ratios = np.linalg.eigvals(of_plainest @ fit.covariance[:6, :6])
    return bool(ratios.real.max() < tuning.most_growth**2)
