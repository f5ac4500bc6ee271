"""How strong the noise of the two trajectories is: restricted maximum likelihood over four
variances.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.adaptive import lapack
from hand_eye_calib.adaptive.block_tridiagonal import Factor

# Variances never fall below this (rad^2 or m^2): rounding, not noise. The upper bound keeps the
# search out of overflow.
LOWEST_VARIANCE, _HIGHEST_VARIANCE = 1e-14, 1e6

# An increment across a jump is not evidence: this (rad^2, m^2) is added to its variance. A
# constant, so that the likelihood does not change with it.
_JUMP_VARIANCE = 1e8

# Variances are raised by this share, so that rounding cannot make them negative.
_ROUNDING = 1e-11

# Information below this share of what the parameter's own diagonal promises is rounding; no
# diagonal counts as smaller than the latter.
_RANK_TOLERANCE, _LEAST_INFORMATION = 1e-12, float(np.finfo(float).tiny)

# The search for the variances works on their logarithms and ends when a step promises to lower the
# loss by less than this: noise levels need no more than a few per cent. Derivatives are from
# differences of this size, here and in these directions.
_MAX_SEARCH_STEPS = 20
_FIRST_RADIUS, _SETTLED_RADIUS, _SETTLED_LOSS = 2.0, 1e-3, 0.01
_DIFFERENCE, _LEAST_BEND = 0.1, 1e-3
_AROUND = np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [1, 1]])
# No step leaves less than this of a standard deviation. A variance of this share of the other is
# not too small for the loss to show it.
_LEAST_LEFT, _AUDIBLE = 1e-3, 1e-3


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
        Of the parameters; zero along directions that no increment says anything about, where the
        step is zero too.
    unseen : (6 + k, U) array
        Those directions, of unit length.
    cost : float
        Weighted squared residual after the step.
    factor : Factor or None
        Of V.
    """

    step: np.ndarray
    covariance: np.ndarray
    unseen: np.ndarray
    cost: float
    factor: Factor | None

    def loss(self):
        """Negative log likelihood, constants left out: comparable between models with different
        parameters.
        """
        return 0.5 * (self.factor.log_determinant() + self.cost)


def covariance_factor(components, variances, jumps):
    """Factor of the covariance of the residuals.

    Parameters
    ----------
    components : Components
    variances : (4,) array
    jumps : (n,) bool array
        Increments that carry no evidence.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where it is not positive definite to rounding.
    """
    bands = components.covariance(variances)
    bands[:, :, 0] *= 1.0 + _ROUNDING
    bands[jumps, :, 0] += _JUMP_VARIANCE
    return Factor(bands)


def solve_weighted(residuals, jacobian, factor):
    """Least squares of residuals (n, 6) over the parameters of their jacobian (n, 6, 6 + k),
    weighted by a covariance's factor.
    """
    whitened = factor.whiten(joined_columns(residuals, jacobian))
    return solve_normal_equations(whitened.T @ whitened, factor)


def joined_columns(residuals, jacobian):
    """(6 n, 6 + k + 1) array: derivatives and, last, residuals; column by column, as LAPACK wants
    it.
    """
    columns = np.empty((residuals.size, jacobian.shape[2] + 1), order="F")
    columns[:, :-1], columns[:, -1] = jacobian.reshape(-1, jacobian.shape[2]), residuals.ravel()
    return columns


def solve_normal_equations(products, factor=None):
    """Solve from the products (6 + k + 1, 6 + k + 1) of whitened derivatives and residuals, the
    latter last.
    """
    values, axes = _eigen(products[:-1, :-1])
    seen = values > _RANK_TOLERANCE
    covariance = (axes[:, seen] / values[seen]) @ axes[:, seen].T
    unseen = axes[:, ~seen] / np.linalg.norm(axes[:, ~seen], axis=0)
    gradient = products[:-1, -1]
    step = -covariance @ gradient
    cost = float(products[-1, -1] + gradient @ step)
    return Solve(step, covariance, unseen, cost, factor)


def generalised_least_squares(linearisation, variances, jumps):
    """:func:`solve_weighted` of a linearisation under given variances and jumps."""
    factor = covariance_factor(linearisation.components, variances, jumps)
    return solve_weighted(linearisation.residuals, linearisation.jacobian, factor)


def _eigen(information):
    """Of information matrices (..., p, p), each parameter scaled to unit information: eigenvalues,
    and axes in the parameters' own units.

    The inverse is ``axes @ diag(1 / values) @ axes'``.
    """
    scale = 1.0 / np.sqrt(
        np.maximum(np.diagonal(information, axis1=-2, axis2=-1), _LEAST_INFORMATION)
    )
    values, vectors = np.linalg.eigh(scale[..., :, None] * information * scale[..., None, :])
    return values, scale[..., :, None] * vectors


def restricted_losses(log_determinants, products):
    """Negative restricted log likelihoods (K,), constants left out (Patterson, Thompson, Biometrika
    58, 1971).

    Parameters
    ----------
    log_determinants : (K,) array
        Of the residuals' covariance.
    products : (K, p + 1, p + 1) array
        Of whitened derivatives and residuals, as for :func:`solve_normal_equations`.
    """
    information, gradients = products[:, :-1, :-1], products[:, :-1, -1]
    values, axes = _eigen(information)
    seen = values > _RANK_TOLERANCE
    values = np.where(seen, values, 1.0)
    explained = (gradients[:, None] @ axes)[:, 0] ** 2 / values
    costs = products[:, -1, -1] - np.where(seen, explained, 0.0).sum(axis=1)
    diagonals = np.maximum(np.diagonal(information, axis1=1, axis2=2), _LEAST_INFORMATION)
    return 0.5 * (
        log_determinants + costs + np.log(values).sum(axis=1) + np.log(diagonals).sum(axis=1)
    )


def starting_variances(residuals, jumps):
    """Rough (white, drift) variances (2,) of residuals (n, 3), from their scatter and the
    correlation of neighbours.

    Differences of white noise have variance 2 s^2 and a covariance of -s^2 with their neighbours;
    drift adds variance alone.
    """
    kept = ~jumps
    together = kept[1:] & kept[:-1]
    total = np.mean(residuals[kept] ** 2) if kept.any() else LOWEST_VARIANCE
    neighbours = (
        np.mean(residuals[1:][together] * residuals[:-1][together])
        if together.any()
        else -total / 2
    )
    white = np.clip(-neighbours, 0.05 * total, 0.5 * total)
    return np.clip(
        [white, max(total - 2 * white, 0.01 * total)], LOWEST_VARIANCE, _HIGHEST_VARIANCE
    )


def fit_rotation_variances(linearisation, jumps, start):
    """White and drift variance of rotation (2,), from the rotation residuals alone.

    They do not depend on the translation's noise, and their three components share one tridiagonal
    covariance, which makes this search all but free.
    """
    # One component's share of the bands: the same for all three.
    components = linearisation.components
    diagonal, below = components.white_rotation[:, 0, 0], components.white_rotation[:-1, 0, 6]
    penalty = np.where(jumps, _JUMP_VARIANCE, 0.0)
    columns = np.concatenate(
        [linearisation.jacobian[:, :3, 3:6], linearisation.residuals[:, :3, None]], axis=2
    ).reshape(-1, 4)

    def weigh(variances):
        total = variances[0] * diagonal + variances[1] * components.relative_interval + penalty
        pivots, multipliers, info = lapack.dpttrf(total, variances[0] * below)
        if info != 0:
            return np.inf, np.eye(4)
        solved, _ = lapack.dpttrs(pivots, multipliers, columns.reshape(-1, 12))
        return 3 * np.log(pivots).sum(), columns.T @ solved.reshape(-1, 4)

    return _search(weigh, start)


def fit_translation_variances(linearisation, jumps, rotation_variances, start):
    """White and drift variance of translation (2,), from all residuals under given variances of
    rotation (2,).
    """

    columns = joined_columns(linearisation.residuals, linearisation.jacobian)

    def weigh(variances):
        try:
            factor = covariance_factor(
                linearisation.components, join_variances(rotation_variances, variances), jumps
            )
        except np.linalg.LinAlgError:
            return np.inf, np.eye(columns.shape[1])
        whitened = factor.whiten(columns)
        return factor.log_determinant(), whitened.T @ whitened

    return _search(weigh, start)


def join_variances(rotation, translation):
    """Variances (4,) in the order of :class:`NoiseLevels` from (white, drift) of rotation and of
    translation.
    """
    return np.array([rotation[0], translation[0], rotation[1], translation[1]])


def _search(weigh, start):
    """Variances (2,) of the least restricted loss: Newton's method within a radius, derivatives by
    differences.

    ``weigh(variances)`` gives log determinant and products for :func:`restricted_losses`, an
    infinite one where variances are impossible.

    The search is by logarithms, the steps are Newton's for the standard deviations: where the data
    ask for none of one noise the loss falls with its variance, and one such step goes all the way,
    whereas in logarithms each would be as long as the one before.
    """
    lowest, highest = np.log(LOWEST_VARIANCE), np.log(_HIGHEST_VARIANCE)

    def losses(log_variances):
        return restricted_losses(
            *map(np.array, zip(*map(weigh, np.exp(log_variances)), strict=True))
        )

    # At next to nothing the loss no longer shows which way is down: a noise that had vanished is
    # tried a little louder, too.
    starts = np.unique(np.log([start, np.maximum(start, _AUDIBLE * np.max(start))]), axis=0)
    values = losses(starts)
    here, value, radius = starts[np.argmin(values)], values.min(), _FIRST_RADIUS
    for _ in range(_MAX_SEARCH_STEPS):
        newton, promised = _newton_step(value, losses(here + _DIFFERENCE * _AROUND))
        if promised < _SETTLED_LOSS:
            # What is left to go is taken on trust, as far as the derivatives reach.
            here = np.clip(here + np.clip(newton, -_DIFFERENCE, _DIFFERENCE), lowest, highest)
            break
        length = np.linalg.norm(newton)
        while True:
            there = np.clip(here + newton * min(1.0, radius / max(length, 1e-300)), lowest, highest)
            lower = losses([there])[0]
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


def _newton_step(value, around):
    """Change of the log variances (2,) by a Newton step of the standard deviations, and by how much
    it promises to lower the loss.

    From the loss here and around here, see ``_AROUND``.
    """
    ahead, behind, both = around[:2], around[2:4], around[4]
    slope = (ahead - behind) / (2 * _DIFFERENCE)
    curvature = np.diag(ahead + behind - 2 * value)
    curvature[0, 1] = curvature[1, 0] = both - ahead.sum() + value
    # By the relative change d of the standard deviations, the log variances being 2 log(1 + d)
    # larger.
    slope, curvature = 2 * slope, 4 * curvature / _DIFFERENCE**2 - 2 * np.diag(slope)
    bends, axes = np.linalg.eigh(curvature)
    # Downhill where the loss bends the wrong way, too.
    bends = np.maximum(np.abs(bends), _LEAST_BEND)
    along = axes.T @ slope
    change = -axes @ (along / bends)
    return 2 * np.log(np.maximum(1 + change, _LEAST_LEFT)), 0.5 * float((along**2 / bends).sum())
