"""Which systematic errors the data ask for: models of them, one step from where the search stands,
judged under the same noise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from hand_eye_calib.adaptive.increments import DRIFT, N_SYSTEMATIC, TIME, parameters_of
from hand_eye_calib.adaptive.resampling import N_BLOCKS, answers_without, part_products
from hand_eye_calib.adaptive.state_space import NormalEquations, Posterior, selected
from hand_eye_calib.arrays import FloatArray

# Systematic errors larger than this (of the length, m/m, s, rad/s) are none: a wrong unit, a clock
# that was not aligned, or noise.
_LARGEST = np.array([0.5, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.5, 1.0, 1.0, 1.0])

# Nor is one assumed that can hardly be told from X: on a road a child that slips sideways looks
# like one that is mounted askew, and then small errors of rotations decide. A drift must be of a
# size (m/m) that odometry has; smaller ones are in the common-mode floor.
_MOST_GROWTH, _MOST_GROWTH_BY_DRIFT = 3.0, 8.0
_LEAST_DRIFT, _MOST_DRIFT = 0.005, 0.06

# Each parameter of a systematic error must lower the weighted squared residual by so much: one that
# is not there is chosen once in forty to five hundred recordings. Schwarz's criterion would ask for
# 7 to 10, as if every increment were evidence of errors that add up over all of them.
_PENALTY = 5.0

# What the largest ratio of variances over ten blocks to those of a model that is right hardly
# exceeds: of six, once in ten times; of three, once in a hundred.
_HARDLY_BY_CHANCE = 3.3


@dataclass(frozen=True)
class Candidates:
    """Models of systematic errors.

    Attributes
    ----------
    tried : list of int
        Parameters of all of them, the columns of ``posterior``.
    posterior : Posterior
    fits : dict
        Name of a model to NormalEquations of X and its parameters.
    credible : list of str
    penalties : dict
        Name to what its parameters add to its cost.
    """

    tried: list[int]
    posterior: Posterior
    fits: dict[str, NormalEquations]
    credible: list[str]
    penalties: dict[str, float]

    @classmethod
    def of(cls, tried: list[int], posterior: Posterior, systematic: Sequence[str]) -> Self:
        """All of these models, the plainest first."""
        fits = {
            name: NormalEquations(selected(posterior.products, columns_of(name, tried)))
            for name in systematic
        }
        plainest = fits[systematic[0]].covariance
        credible = [
            name
            for name, fit in fits.items()
            if name == systematic[0] or _is_credible(fit, name, plainest)
        ]
        penalties = {name: _PENALTY * len(parameters_of(name)) for name in systematic}
        return cls(tried, posterior, fits, credible, penalties)

    def judged_by_parts(self, prefers_time: bool) -> Self:
        """With penalties for parameters that differ from part to part. If models with a time offset
        come first, the others are not credible, unless it differs from part to part.
        """
        parts = part_products(self.posterior)
        counts = {
            name: _n_misjudged(parts, columns_of(name, self.tried), fit)
            for name, fit in self.fits.items()
        }
        credible = self.credible
        if prefers_time and counts.get("time", np.inf) <= 1.0:
            credible = [name for name in credible if TIME in parameters_of(name)] or credible
        penalties = {name: _PENALTY * count for name, count in counts.items()}
        return dataclasses.replace(self, credible=credible, penalties=penalties)

    def criterion(self, name: str) -> float:
        """Weighted squared residual and penalty: the smallest is best."""
        return self.fits[name].cost + self.penalties[name]

    @property
    def best(self) -> str:
        """Name of the best credible model."""
        return min(self.credible, key=self.criterion)

    def spread_about(self, chosen: str) -> FloatArray:
        """Covariance (6, 6) of X by the choice of a model: the spread of the answers of all that
        are credible about that of the chosen one, each with the probability that its criterion
        leaves it.
        """
        costs = np.array([self.criterion(name) for name in self.credible])
        chances = np.exp((costs.min() - costs) / 2)
        steps = np.array([self.fits[name].step[:6] for name in self.credible])
        steps -= self.fits[chosen].step[:6]
        return (chances / chances.sum() * steps.T) @ steps

    def sigmas(self, names: Sequence[str]) -> FloatArray:
        """Standard deviations (11,) of the parameters of these models, where there are such."""
        sigmas = np.zeros(N_SYSTEMATIC)
        for name in set(names) & set(self.fits):
            sigmas[parameters_of(name)] = np.sqrt(np.diag(self.fits[name].covariance)[6:])
        return sigmas


def columns_of(name: str, tried: list[int]) -> list[int]:
    """Columns of X and of the parameters of a model beside the others."""
    return [*range(6), *(6 + tried.index(column) for column in parameters_of(name))]


def _n_misjudged(parts: FloatArray, columns: list[int], fit: NormalEquations) -> float:
    """The number of parameters of systematic errors, each times the factor by which its variance
    over ten blocks exceeds that of the model beyond chance. By as much a parameter that is not
    there lowers the weighted squared residual more than the model expects (Takeuchi's criterion).
    """
    n_parameters = len(columns) - 6
    if n_parameters == 0 or len(parts) < N_BLOCKS:
        return n_parameters
    answers = answers_without(selected(parts, columns), N_BLOCKS)[:, 6:]
    spread = np.atleast_2d(np.cov(answers.T, bias=True)) * (N_BLOCKS - 1)
    ratios = np.linalg.eigvals(np.linalg.pinv(fit.covariance[6:, 6:], hermitian=True) @ spread)
    return float(np.maximum(ratios.real / _HARDLY_BY_CHANCE, 1.0).sum())


def _is_credible(fit: NormalEquations, name: str, plainest: FloatArray) -> bool:
    """Whether systematic errors are of a size that sensors have, and X can be told from them: its
    standard deviations do not grow too much from those with the plainest model.
    """
    parameters = parameters_of(name)
    if (np.abs(fit.step[6:]) > _LARGEST[parameters]).any():
        return False
    ratios = np.linalg.eigvals(np.linalg.pinv(plainest, hermitian=True) @ fit.covariance[:6, :6])
    growth = np.sqrt(ratios.real.max())
    if growth < _MOST_GROWTH:
        return True
    drift = np.linalg.norm(fit.step[6:][np.isin(parameters, DRIFT)])
    return bool(growth < _MOST_GROWTH_BY_DRIFT and _LEAST_DRIFT < drift < _MOST_DRIFT)
