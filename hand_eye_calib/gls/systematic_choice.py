"""Which systematic errors the data ask for: models of them, one step from where the search stands,
judged under the same noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Self

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.gls.increments import DRIFT, N_SYSTEMATIC, TIME, parameters_of
from hand_eye_calib.gls.resampling import N_BLOCKS, answers_without, part_products
from hand_eye_calib.gls.state_space import NormalEquations, Posterior, selected

# Systematic errors larger than this (of the length, m/m, s, rad/s) are none: a wrong unit, a clock
# that was not aligned, or noise.
_LARGEST = np.array([0.5, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.5, 1.0, 1.0, 1.0])

# Nor is one assumed that can hardly be told from X, whose standard deviations would grow by this
# factor: on a road a child that slips sideways looks like one that is mounted askew, and then small
# errors of rotations decide. On roads such biases grow them by 4 or more, biases of the published
# simulations along one axis by 2 or less.
_MOST_GROWTH = 3.0

# Each parameter of a systematic error must lower the weighted squared residual by so much: one that
# is not there is chosen once in forty to five hundred recordings. Schwarz's criterion would ask for
# 7 to 10, as if every increment were evidence of errors that add up over all of them.
_PENALTY = 5.0

# A bias (m/m) along each of the six axes of both sensors is there or not; the chances of one are
# those of none. Its size is Cauchy's, with the scale that odometry has. What that costs is in place
# of the penalty above.
_BIAS_SCALE, _BIAS_ODDS = 0.01, 1.0 / 6.0

# What the largest ratio of variances over ten blocks to those of a model that is right hardly
# exceeds: of six, once in ten times; of three, once in a hundred.
_HARDLY_BY_CHANCE = 3.3


@dataclass(frozen=True)
class Model:
    """A model of systematic errors.

    Attributes
    ----------
    parameters : list of int
        Those that it has: of a bias, along the axes that the data ask for.
    fit : NormalEquations
        Of X and these parameters.
    penalty : float
        What they add to its cost.
    is_credible : bool
    """

    parameters: list[int]
    fit: NormalEquations
    penalty: float
    is_credible: bool

    @property
    def criterion(self) -> float:
        """Weighted squared residual and penalty: the smallest is best."""
        return self.fit.cost + self.penalty


@dataclass(frozen=True)
class Candidates:
    """Models of systematic errors.

    Attributes
    ----------
    tried : list of int
        Parameters of all of them, the columns of ``posterior``.
    posterior : Posterior
    models : dict
        Name to Model.
    """

    tried: list[int]
    posterior: Posterior
    models: dict[str, Model]

    @classmethod
    def of(cls, tried: list[int], posterior: Posterior, systematic: Sequence[str]) -> Self:
        """All of these models, the plainest first."""

        def fitted(parameters: list[int]) -> NormalEquations:
            return NormalEquations(selected(posterior.products, columns_of(parameters, tried)))

        known = parameters_of(systematic[0])
        plainest = Model(known, fitted(known), _PENALTY * len(known), is_credible=True)
        models = {systematic[0]: plainest}
        for name in systematic[1:]:
            choices = [
                Model(
                    parameters,
                    fit := fitted(parameters),
                    _penalty(fit, parameters),
                    _is_credible(fit, parameters, plainest.fit.covariance[:6, :6]),
                )
                for parameters in _choices(name)
            ]
            models[name] = min(choices, key=lambda one: (not one.is_credible, one.criterion))
        return cls(tried, posterior, models)

    def judged_by_parts(self, prefers_time: bool) -> Self:
        """With penalties for parameters that differ from part to part. If models with a time offset
        come first, the others are not credible, unless it differs from part to part.
        """
        parts = part_products(self.posterior)
        models = {}
        for name, model in self.models.items():
            misjudged = _n_misjudged(parts, columns_of(model.parameters, self.tried), model.fit)
            models[name] = replace(model, penalty=model.penalty + _PENALTY * misjudged)
        is_steady = "time" in models and models["time"].penalty == self.models["time"].penalty
        with_time = {name for name in self.credible if TIME in models[name].parameters}
        if prefers_time and is_steady and with_time:
            models = {
                name: replace(model, is_credible=name in with_time)
                for name, model in models.items()
            }
        return replace(self, models=models)

    @property
    def credible(self) -> list[str]:
        """Names of the credible models."""
        return [name for name, model in self.models.items() if model.is_credible]

    @property
    def best(self) -> str:
        """Name of the best credible model."""
        return min(self.credible, key=lambda name: self.models[name].criterion)

    def spread_about(self, chosen: str) -> FloatArray:
        """Covariance (6, 6) of X by the choice of a model: the spread of the answers of all that
        are credible about that of the chosen one, each with the probability that its criterion
        leaves it.
        """
        models = [self.models[name] for name in self.credible]
        costs = np.array([model.criterion for model in models])
        chances = np.exp((costs.min() - costs) / 2)
        steps = np.array([model.fit.step[:6] for model in models])
        steps -= self.models[chosen].fit.step[:6]
        return (chances / chances.sum() * steps.T) @ steps

    def sigmas(self, names: Sequence[str]) -> FloatArray:
        """Standard deviations (11,) of the parameters of these models, where there are such."""
        sigmas = np.zeros(N_SYSTEMATIC)
        for name in set(names) & set(self.models):
            model = self.models[name]
            sigmas[model.parameters] = np.sqrt(np.diag(model.fit.covariance)[6:])
        return sigmas


def columns_of(parameters: Sequence[int], tried: list[int]) -> list[int]:
    """Columns of X and of the parameters of a model beside the others."""
    return [*range(6), *(6 + tried.index(column) for column in parameters)]


def _choices(name: str) -> list[list[int]]:
    """The parameters that a model may have: a bias is along one axis, two or three."""
    parameters = parameters_of(name)
    axes = [index for index in parameters if index in DRIFT]
    others = [index for index in parameters if index not in DRIFT]
    sizes = range(min(len(axes), 1), len(axes) + 1)
    return [[*some, *others] for size in sizes for some in combinations(axes, size)]


def _penalty(fit: NormalEquations, parameters: Sequence[int]) -> float:
    """What parameters add to the cost of a model; of a bias, minus twice the logarithm of the
    chance that the data's answer has beforehand (Laplace's approximation of the evidence).
    """
    is_bias = np.isin(parameters, DRIFT)
    penalty = _PENALTY * float((~is_bias).sum())
    if is_bias.any():
        sizes = fit.step[6:][is_bias] / _BIAS_SCALE
        covariance = fit.covariance[6:, 6:][np.ix_(is_bias, is_bias)] / _BIAS_SCALE**2
        penalty += 2.0 * float(np.log(np.pi * (1.0 + sizes**2) / _BIAS_ODDS).sum())
        penalty -= float(np.linalg.slogdet(2.0 * np.pi * covariance)[1])
    return penalty


def _n_misjudged(parts: FloatArray, columns: list[int], fit: NormalEquations) -> float:
    """The number of parameters of systematic errors, each times the factor less one by which its
    variance over ten blocks exceeds that of the model beyond chance. By as much more a parameter
    that is not there lowers the weighted squared residual than the model expects (Takeuchi's
    criterion).
    """
    n_parameters = len(columns) - 6
    if n_parameters == 0 or len(parts) < N_BLOCKS:
        return 0.0
    answers = answers_without(selected(parts, columns), N_BLOCKS)[:, 6:]
    spread = np.atleast_2d(np.cov(answers.T, bias=True)) * (N_BLOCKS - 1)
    ratios = np.linalg.eigvals(np.linalg.pinv(fit.covariance[6:, 6:], hermitian=True) @ spread)
    return float(np.maximum(ratios.real / _HARDLY_BY_CHANCE - 1.0, 0.0).sum())


def _is_credible(fit: NormalEquations, parameters: Sequence[int], plainest: FloatArray) -> bool:
    """Whether systematic errors are of a size that sensors have, and X can be told from them: its
    standard deviations do not grow too much from those with the plainest model.
    """
    if (np.abs(fit.step[6:]) > _LARGEST[list(parameters)]).any():
        return False
    ratios = np.linalg.eigvals(np.linalg.pinv(plainest, hermitian=True) @ fit.covariance[:6, :6])
    return bool(ratios.real.max() < _MOST_GROWTH**2)
