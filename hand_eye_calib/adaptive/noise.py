"""How strong the noise of the two trajectories is: restricted maximum likelihood over four variances."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from hand_eye_calib.adaptive.block_tridiagonal import Factor

# Variances never fall below this (rad^2 or m^2): rounding, not noise. The upper bound keeps the search out of overflow.
LOWEST_VARIANCE, _HIGHEST_VARIANCE = 1e-14, 1e6

# An increment across a jump is not evidence: this (rad^2, m^2) is added to its variance. A constant, so that the likelihood does
# not change with it.
_JUMP_VARIANCE = 1e8

# Variances are raised by this share, so that rounding cannot make them negative.
_ROUNDING = 1e-11

# Information below this share of what the parameter's own diagonal promises is rounding.
_RANK_TOLERANCE = 1e-12

# The search for the variances works on their logarithms and ends when a step lowers the loss by less than this: noise levels need no more
# than a few per cent.
_MAX_SEARCH_STEPS = 20
_FIRST_RADIUS, _SETTLED_RADIUS, _SETTLED_LOSS = 2.0, 1e-3, 0.01
_DIFFERENCE, _LEAST_BEND = 0.1, 1e-3


@dataclass(frozen=True)
class NoiseLevels:
    """Standard deviations per axis, of both sensors' trajectories together.

    Attributes
    ----------
    rotation_white, translation_white : float
        Independent error of each pose, rad and m.
    rotation_drift, translation_drift : float
        What an error that stays grows by in a typical interval between poses, rad and m.
    """

    rotation_white: float
    translation_white: float
    rotation_drift: float
    translation_drift: float

    @classmethod
    def from_variances(cls, variances):
        """From the four variances, in the order of the attributes."""
        return cls(*np.sqrt(variances).tolist())

    def variances(self):
        """(4,) array, in the order of the attributes."""
        return np.square(dataclasses.astuple(self))


@dataclass(frozen=True)
class Solve:
    """Generalised least squares under given variances.

    Attributes
    ----------
    step : (6 + k,) array
        Change of xi and of the nuisance parameters that minimises the weighted residual.
    covariance : (6 + k, 6 + k) array
        Of the parameters; zero along directions that no increment says anything about, where the step is zero too.
    log_information : float
        Logarithm of the determinant of their information, those directions left out.
    unseen : (6 + k, U) array
        Those directions, of unit length.
    cost : float
        Weighted squared residual after the step.
    factor : Factor or None
        Of V.
    """

    step: np.ndarray
    covariance: np.ndarray
    log_information: float
    unseen: np.ndarray
    cost: float
    factor: Factor | None

    def restricted_loss(self):
        """Negative restricted log likelihood, constants left out (Patterson, Thompson, Biometrika 58, 1971)."""
        return 0.5 * (self.factor.log_determinant() + self.cost + self.log_information)

    def loss(self):
        """Negative log likelihood, constants left out: comparable between models with different parameters."""
        return 0.5 * (self.factor.log_determinant() + self.cost)


def covariance_factor(components, variances, jumps):
    """Factor of the covariance of the residuals.

    Parameters
    ----------
    components : (4, 12, 6 n) array
        See :class:`~hand_eye_calib.adaptive.increments.Linearisation`.
    variances : (4,) array
    jumps : (n,) bool array
        Increments that carry no evidence.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where it is not positive definite to rounding.
    """
    bands = np.tensordot(variances, components, axes=1)
    bands[0] *= 1.0 + _ROUNDING
    bands[0].reshape(len(jumps), 6)[jumps] += _JUMP_VARIANCE
    return Factor(bands)


def solve_weighted(residuals, jacobian, factor):
    """Least squares of residuals (n, 6) over the parameters of their jacobian (n, 6, 6 + k), weighted by a covariance's factor."""
    whitened = factor.whiten(joined_columns(residuals, jacobian))
    return solve_normal_equations(whitened.T @ whitened, factor)


def joined_columns(residuals, jacobian):
    """(6 n, 6 + k + 1) array: derivatives and, last, residuals."""
    return np.concatenate([jacobian.reshape(-1, jacobian.shape[2]), residuals.reshape(-1, 1)], axis=1)


def solve_normal_equations(products, factor=None):
    """Solve from the products (6 + k + 1, 6 + k + 1) of whitened derivatives and residuals, the latter last."""
    covariance, log_information, unseen = _invert(products[:-1, :-1])
    gradient = products[:-1, -1]
    step = -covariance @ gradient
    cost = float(products[-1, -1] + gradient @ step)
    return Solve(step, covariance, log_information, unseen, cost, factor)


def generalised_least_squares(linearisation, variances, jumps):
    """:func:`solve_weighted` of a linearisation under given variances and jumps."""
    factor = covariance_factor(linearisation.components, variances, jumps)
    return solve_weighted(linearisation.residuals, linearisation.jacobian, factor)


def _invert(information):
    """Inverse and log determinant of an information matrix on the directions that have any, and the other directions."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(scale[:, None] * information * scale)
    seen = values > _RANK_TOLERANCE
    scaled = scale[:, None] * vectors[:, seen]
    log_determinant = np.log(values[seen]).sum() - 2 * np.log(scale).sum()
    unseen = scale[:, None] * vectors[:, ~seen]
    return (scaled / values[seen]) @ scaled.T, float(log_determinant), unseen / np.linalg.norm(unseen, axis=0)


def starting_variances(residuals, jumps):
    """Rough (white, drift) variances (2,) of residuals (n, 3), from their scatter and the correlation of neighbours.

    Differences of white noise have variance 2 s^2 and a covariance of -s^2 with their neighbours; drift adds variance alone.
    """
    kept = ~jumps
    together = kept[1:] & kept[:-1]
    total = np.mean(residuals[kept] ** 2) if kept.any() else LOWEST_VARIANCE
    neighbours = np.mean(residuals[1:][together] * residuals[:-1][together]) if together.any() else -total / 2
    white = np.clip(-neighbours, 0.05 * total, 0.5 * total)
    return np.clip([white, max(total - 2 * white, 0.01 * total)], LOWEST_VARIANCE, _HIGHEST_VARIANCE)


def fit_rotation_variances(linearisation, jumps, start):
    """White and drift variance of rotation (2,), from the rotation residuals alone.

    They do not depend on the translation's noise, and their three components share one tridiagonal covariance, which makes this
    search all but free.
    """
    white, drift = linearisation.rotation_bands
    penalty = np.where(jumps, _JUMP_VARIANCE, 0.0)
    columns = np.concatenate([linearisation.jacobian[:, :3, 3:6], linearisation.residuals[:, :3, None]], axis=2)
    right = columns.reshape(len(jumps), 12)

    def loss(log_variances):
        variances = np.exp(log_variances)
        diagonal = variances[0] * white[0] + variances[1] * drift + penalty
        pivots, multipliers, info = lapack.dpttrf(diagonal, variances[0] * white[1][:-1])
        if info != 0:
            return np.inf
        solved, _ = lapack.dpttrs(pivots, multipliers, right)
        products = np.einsum("nij,nik->jk", columns, solved.reshape(-1, 3, 4))
        covariance, log_information, _ = _invert(products[:3, :3])
        gradient = products[:3, 3]
        cost = products[3, 3] - gradient @ covariance @ gradient
        return 0.5 * (3 * np.log(pivots).sum() + cost + log_information)

    return _search(loss, start)


def fit_translation_variances(linearisation, jumps, rotation_variances, start):
    """White and drift variance of translation (2,), from all residuals under given variances of rotation (2,)."""

    def loss(log_variances):
        variances = join_variances(rotation_variances, np.exp(log_variances))
        try:
            return generalised_least_squares(linearisation, variances, jumps).restricted_loss()
        except np.linalg.LinAlgError:
            return np.inf

    return _search(loss, start)


def join_variances(rotation, translation):
    """Variances (4,) in the order of :class:`NoiseLevels` from (white, drift) of rotation and of translation."""
    return np.array([rotation[0], translation[0], rotation[1], translation[1]])


def _search(loss, start):
    """Variances (2,) that minimise a loss of their logarithms: Newton's method within a radius, derivatives by differences."""
    lowest, highest = np.log(LOWEST_VARIANCE), np.log(_HIGHEST_VARIANCE)
    here, radius = np.log(start), _FIRST_RADIUS
    value = loss(here)
    first, second = _DIFFERENCE * np.eye(2)
    for _ in range(_MAX_SEARCH_STEPS):
        ahead = np.array([loss(here + first), loss(here + second)])
        behind = np.array([loss(here - first), loss(here - second)])
        curvature = np.diag(ahead + behind - 2 * value)
        curvature[0, 1] = curvature[1, 0] = loss(here + first + second) - ahead.sum() + value
        bends, axes = np.linalg.eigh(curvature / _DIFFERENCE**2)
        # Downhill where the loss bends the wrong way, too.
        newton = -axes @ ((axes.T @ (ahead - behind)) / (2 * _DIFFERENCE) / np.maximum(np.abs(bends), _LEAST_BEND))
        length = np.linalg.norm(newton)
        while True:
            there = np.clip(here + newton * min(1.0, radius / max(length, 1e-300)), lowest, highest)
            lower = loss(there)
            if lower <= value or radius < _SETTLED_RADIUS:
                break
            radius = min(radius, length) / 4
        if lower > value:
            break
        gain, here, value = value - lower, there, lower
        if gain < _SETTLED_LOSS and min(length, _FIRST_RADIUS) <= radius:
            break
        radius *= 2
    return np.exp(here)
