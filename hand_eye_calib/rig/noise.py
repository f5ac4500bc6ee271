"""Noise levels of the sensors of a rig: a start from differences, then restricted likelihood."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from hand_eye_calib.adaptive.reml import Fit, Prior, minimised
from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.rig.likelihood import N_LEVELS, Likelihood, Model, derivatives

# Variances never fall below this (m^2, rad^2), and white errors and walks not below these shares of
# the largest of all sensors: both stand in one matrix.
_LOWEST_VARIANCE, _LEAST_WHITE, _LEAST_WALK = 1e-14, np.exp(-12.0), np.exp(-12.0)
_HIGHEST_LEVEL = 14.0

# A start gives every sensor at least this share of the mean of all.
_AUDIBLE = 0.05


def first_levels(residuals: FloatArray, jumps: BoolArray) -> FloatArray:
    """Log levels (4 S,) from the scatter of the differences of all sensors, and from its
    correlation from one increment to the next.

    Differences of white errors have variance 2 s^2 and a covariance of -s^2 with their neighbours;
    the walk adds variance alone. What the pairs of sensors scatter by, ``v_k + v_l``, is solved for
    the sensors (three-cornered hat).

    Parameters
    ----------
    residuals : (n, 6 K) array
    jumps : (S, n) bool array
    """
    n, S = len(residuals), len(jumps)
    errors = np.concatenate([np.zeros((n, 1, 6)), residuals.reshape(n, S - 1, 6)], axis=1)
    pairs = list(combinations(range(S), 2))
    design = np.zeros((len(pairs), S))
    scatter = np.empty((len(pairs), N_LEVELS))
    for row, (first, second) in enumerate(pairs):
        design[row, [first, second]] = 1.0
        kept = ~(jumps[first] | jumps[second])
        scatter[row] = _scatter(errors[:, first] - errors[:, second], kept)
    variances = np.linalg.lstsq(design, scatter, rcond=None)[0]
    least = np.maximum(_AUDIBLE * scatter.mean(axis=0) / 2.0, 1e2 * _LOWEST_VARIANCE)
    return np.log(np.maximum(variances, least)).ravel()


def _scatter(difference: FloatArray, kept: BoolArray) -> FloatArray:
    """Variances (4,) of white errors and walks in the difference (n, 6) of two sensors."""
    found = np.empty(N_LEVELS)
    together = kept[1:] & kept[:-1]
    for index, part in enumerate((slice(0, 3), slice(3, 6))):
        values = difference[:, part]
        total = float(np.mean(values[kept] ** 2)) if kept.any() else _LOWEST_VARIANCE
        products = values[1:][together] * values[:-1][together]
        neighbours = float(np.mean(products)) if together.any() else -0.5 * total
        white = float(np.clip(-neighbours, 0.05 * total, 0.5 * total))
        found[index], found[index + 2] = white, max(total - 2.0 * white, 0.02 * total)
    return found


def fitted(model: Model, start: FloatArray) -> Fit[Likelihood]:
    """Log levels of the largest restricted likelihood near a start."""
    of_sensors = start.reshape(-1, N_LEVELS)
    whole = np.logaddexp(of_sensors[:, :2] + np.log(2.0), of_sensors[:, 2:]).max(axis=0)
    shares = np.log([_LEAST_WHITE, _LEAST_WHITE, _LEAST_WALK, _LEAST_WALK])
    lowest = np.maximum(np.tile(whole, 2) + shares, np.log(_LOWEST_VARIANCE))
    lower = np.tile(lowest, len(of_sensors))
    upper = np.full(len(start), _HIGHEST_LEVEL)
    prior = Prior(start, np.zeros(len(start)), lower, upper)
    return minimised(lambda levels: Likelihood(model, levels), derivatives, start, prior)
