"""Robust maximum likelihood estimate of X and Z from stops, ``A_i X = Z B_i``.

A_i is the pose of the parent sensor in its world, such as the hand in the base of a robot. B_i is
the pose of the child sensor in its world, such as the camera in the frame of a target. X is the
pose of the child in the parent. Z is the pose of the child's world in the parent's world: the
target in the base of the robot. The order of the stops has no meaning.

The error of stop i is ``xi_i = Log(B_i^-1 Z^-1 A_i X)`` in the frame of the child, or the same
error in the frame of the child's world. It has a Student-t distribution. Outliers are detected, and
hypotheses compared, with one variance for the position and one for the rotation. Gauss-Newton steps
use weights and variances from the expectation-maximisation algorithm: K. L. Lange, R. J. A. Little,
J. M. G. Taylor, *Robust statistical modeling using the t distribution*, JASA 84, 1989. The final
fit has the variances of
:mod:`hand_eye_calib.extras.stops.error_components`.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.stats import student_weights
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.closed_form import Stops, starts_of
from hand_eye_calib.extras.stops.error_components import (
    MIN_VARIANCE,
    fit_components,
)
from hand_eye_calib.extras.stops.lasting_errors import (
    correlations,
    kernel_weights,
    rest_weights,
    views_of_stops,
)

# Fewest stops: X needs two motions with rotations about different axes, so three stops.
MIN_STOPS = 3

# Degrees of freedom of the Student-t distribution of errors. Measured: for 4 to 30 degrees of
# freedom, the result predicts unused stops of two real arms equally well, to 1 %. For normal errors
# (KinHEC), rotation errors are 3 % larger at 12 and 2 % at 16 than at 1000.
_DEGREES = 16.0

# A stop is an outlier if its squared Mahalanobis distance (six values) exceeds this limit. Normal
# errors exceed it at one of 300,000 stops (chi-square).
_OUTLIER_SQUARED = 36.0

# Degrees of freedom for the detection of outliers. The tails are so heavy that a few outliers
# hardly change the variances.
_OUTLIER_DEGREES = 3.0

# The degrees of freedom, times the number of stops minus two, are at least this. Otherwise a few
# stops would fit exactly, and all other stops would be outliers.
_FEWEST_DEGREES = 16.0

# Number of estimated values: six of X and six of Z.
_N_VALUES = 12

# Largest number of iterations. Each iteration updates weights and variances, then takes a
# Gauss-Newton step.
_MAX_ROUNDS = 60
# The iteration ends at a smaller step, in standard deviations of the values.
_SMALL_STEP = 1e-2

# A direction of X is observable if the mean squared rotation between stops that determines it
# exceeds this multiple of the variance of a measured rotation. Smaller rotations may be errors.
_DETERMINED = 8.0

# Prior standard deviation of the scale of the child's lengths, relative to 1: a usual error of the
# size of a target or of a focal length.
STRETCH = 0.03

# Largest number of stops whose correlations are computed together. The memory grows with its
# square.
_MAX_STOPS_AT_ONCE = 300


@dataclass(frozen=True)
class RobotWorld:
    """Solution of ``A_i X = Z B_i``.

    Attributes
    ----------
    T_parent_child : (4, 4) array
        X: pose of the child in the parent.
    T_world_world : (4, 4) array
        Z: pose of the child's world in the parent's world.
    covariance : (12, 12) array
        Covariance of the right perturbations (rho, phi): X in the frame of the child, then Z in the
        frame of the child's world. Unobservable directions have large variances.
    information : (12, 12) array
        Fisher information about the same perturbations, if the errors of different stops are
        independent.
    weights : (N,) array
        Weight of each stop: 1 for errors of usual size, less for larger errors, 0 for an outlier.
    level_m, level_rad : float
        Standard deviations of the errors of a stop's position and rotation, per axis.
    objective : float
        Negative log likelihood, up to a constant.
    converged : bool
        Whether the last step of the fit was small.
    scale_step : float
        Relative change of the scale of the child's lengths with the best fit, to first order.
    scale_sigma : float
        Standard deviation of ``scale_step``; infinite if the stops do not determine the scale.
    scale_inflation : float
        Factor by which errors that last for several stops increase the variance of the scale.
    """

    T_parent_child: FloatArray
    T_world_world: FloatArray
    covariance: FloatArray
    information: FloatArray
    weights: FloatArray
    level_m: float
    level_rad: float
    objective: float
    converged: bool
    scale_step: float = 0.0
    scale_sigma: float = float("inf")
    scale_inflation: float = 1.0

    def undetermined(self) -> FloatArray:
        """Return the unobservable directions (6, K) of X, as right perturbations."""
        to_others = self.information[:6, 6:]
        others = np.linalg.pinv(self.information[6:, 6:], hermitian=True)
        marginal = self.information[:6, :6] - to_others @ others @ to_others.T
        levels = np.repeat([self.level_m, self.level_rad], 3)
        n_used = max(int(np.sum(self.weights > 0.0)), 1)
        # Information of X times the variances of a stop: mean squared rotations (rad^2).
        squared_turns = marginal * np.outer(levels, levels) / n_used
        eigenvalues, directions = np.linalg.eigh(squared_turns)
        return directions[:, eigenvalues < _DETERMINED * self.level_rad**2]


def solve(stops: Stops, stretch: float = STRETCH) -> RobotWorld:
    """Estimate X and Z, with their covariance.

    Parameters
    ----------
    stops : Stops
        At least three stops.
    stretch : float
        Prior standard deviation of the scale of the child's lengths, relative to 1; infinite
        without prior knowledge. The scale itself remains 1. The covariance contains its
        uncertainty.

    Raises
    ------
    NotEnoughDataError
        If there are fewer than three stops.

    Notes
    -----
    The fit starts from the closed forms of :mod:`hand_eye_calib.extras.stops.closed_form`. Outliers
    are detected with heavy tails and left out. For this step, the errors are either in the frame of
    the child or in that of the child's world (a target whose pose a camera measures), whichever is
    likelier. The fit of the remaining stops has both kinds of errors:
    :mod:`hand_eye_calib.extras.stops.error_components`.
    """
    if len(stops) < MIN_STOPS:
        raise NotEnoughDataError(
            f"{len(stops)} stops are too few: at least {MIN_STOPS}, with rotations about two axes, "
            "are necessary; 15 or more are better"
        )
    views = views_of_stops(stops.Ts_world_parent, stops.Ts_world_child)
    rests = rest_weights(views)
    rough = _likelier_fit(stops, rests)
    is_kept = rough.weights > 0.0
    kept = stops[is_kept]
    components = fit_components(
        kept,
        (rough.T_parent_child, rough.T_world_world),
        np.square([rough.level_m, rough.level_rad]),
        rests[is_kept],
        max(_FEWEST_DEGREES / (len(stops) - 2), _DEGREES),
        _linearise,
    )
    weights = np.zeros(len(stops))
    weights[is_kept] = np.minimum(components.weights, 1.0)
    fit = replace(
        rough,
        T_parent_child=components.T_parent_child,
        T_world_world=components.T_world_world,
        covariance=_inverse_of(components.information, rough),
        weights=weights,
    )
    return _with_lasting_errors(
        kept, fit, components.whitening, rests[is_kept], views[is_kept], stretch
    )


def objective_of(stops: Stops) -> float:
    """Return the negative log likelihood of at least three stops, up to a constant."""
    return _robust_fit(stops).objective


def inliers_of(stops: Stops) -> BoolArray:
    """Return a mask (N,) of the inliers among at least three stops."""
    return _robust_fit(stops).weights > 0.0


def _robust_fit(stops: Stops) -> RobotWorld:
    views = views_of_stops(stops.Ts_world_parent, stops.Ts_world_child)
    return _likelier_fit(stops, rest_weights(views))


def _likelier_fit(stops: Stops, rests: FloatArray) -> RobotWorld:
    """Return the likelier fit: with errors in the frame of the child, or of its world.

    ``rests`` (N,) are the weights of the stops, smaller for several stops at one place.
    """
    fits = []
    for start in starts_of(stops):
        for in_world in (False, True):
            fits.append(_fit_without_outliers(stops, start, in_world, rests))
    return min(fits, key=lambda fit: fit.objective)


def _inverse_of(information: FloatArray, rough: RobotWorld) -> FloatArray:
    """Return the covariance (12, 12) of X and Z. Unobservable directions have large variances.

    Their prior standard deviations are a thousand times those of a stop in the fit ``rough``.
    """
    prior = np.tile(
        np.repeat([1e-3 / rough.level_m, 1e-3 / rough.level_rad], 3), 2
    )
    return np.asarray(
        np.linalg.inv(information + np.diag(prior**2)), dtype=float
    )


def _fit_without_outliers(
    stops: Stops,
    start: tuple[FloatArray, FloatArray],
    in_world: bool,
    rests: FloatArray,
) -> RobotWorld:
    """Detect outliers with heavy tails, then fit the other stops.

    With ``in_world``, the errors are in the frame of the child's world; otherwise in the frame of
    the child. ``rests`` (N,) are weights of stops at one place. Outliers have weight 0 in the
    result.
    """
    n = len(stops)
    fewest_degrees = _FEWEST_DEGREES / (n - 2)
    rough = _fit(
        stops, start, in_world, max(fewest_degrees, _OUTLIER_DEGREES), rests
    )
    is_kept = rough.weights > 0.0
    fit = _fit(
        stops[is_kept],
        (rough.T_parent_child, rough.T_world_world),
        in_world,
        max(fewest_degrees, _DEGREES),
        rests[is_kept],
    )
    weights = np.zeros(n)
    weights[is_kept] = fit.weights
    # Each outlier counts with the squared distance of the limit in the objective.
    log_levels = 6.0 * (np.log(fit.level_m) + np.log(fit.level_rad))
    n_left_out = float(np.sum(weights == 0.0))
    objective = fit.objective + 0.5 * n_left_out * (
        log_levels + _OUTLIER_SQUARED
    )
    return replace(fit, weights=weights, objective=objective)


# ------------------------------------------------------------------ the fit


def _linearise(
    stops: Stops, X: FloatArray, Z: FloatArray, in_world: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Return the errors xi (N, 6) of stops, and their derivatives (N, 6, 12).

    The derivatives are with respect to the right perturbations of X and Z. With ``in_world``, the
    errors are in the frame of the child's world; otherwise in the frame of the child.
    """
    predicted = se3.inverse(Z) @ stops.Ts_world_parent @ X
    measured_inverse = se3.inverse(stops.Ts_world_child)
    if in_world:
        errors = se3.log(predicted @ measured_inverse)
        frames = stops.Ts_world_child
    else:
        errors = se3.log(measured_inverse @ predicted)
        frames = np.broadcast_to(np.eye(4), predicted.shape)
    by_X = se3.adjoint(frames)
    by_Z = -se3.adjoint(frames @ se3.inverse(predicted))
    return errors, np.concatenate([by_X, by_Z], axis=2)


def _variances(
    stops: Stops, squared: FloatArray, weights: FloatArray, degrees: float
) -> FloatArray:
    """Estimate the variances (2,) per axis of positions (m^2) and rotations (rad^2).

    Four stops or fewer do not determine both variances: the positions may fit exactly. Then both
    are assumed to be proportional: the variance of positions is the variance of rotations times the
    variance of the child's positions. The factor is estimated from both errors.

    Parameters
    ----------
    stops : Stops
    squared : (N, 2) array
        Squared errors of positions and rotations.
    weights : (N,) array
        Weights of the stops.
    degrees : float
        Degrees of freedom of the Student-t distribution.
    """
    n = len(stops)
    # Degrees of freedom of each variance. The fit uses half of the twelve values for each.
    n_free = max(3.0 * n - 0.5 * _N_VALUES, 0.5)
    # Sum of the weights at convergence. The variances converge faster if they are divided by it: C.
    # Liu, D. B. Rubin, Y. N. Wu, *Parameter expansion to accelerate EM*, Biometrika 85, 1998.
    final_sum = ((degrees + 6.0) * n - 2.0 * n_free) / degrees
    means = final_sum / weights.sum() * (weights @ squared) / n_free
    if 3 * n <= _N_VALUES:
        places_m2 = (
            se3.translation_of(stops.Ts_world_child).var(axis=0).sum()
            + MIN_VARIANCE
        )
        factor = means @ [0.5 / places_m2, 0.5]
        means = factor * np.array([places_m2, 1.0])
    return np.maximum(means, MIN_VARIANCE)


def _products(rows: FloatArray) -> FloatArray:
    """Return ``J' J`` (n, n) of stacked rows J (N, 6, n)."""
    columns = rows.reshape(-1, rows.shape[2])
    return columns.T @ columns


def _gauss_newton_step(products: FloatArray) -> FloatArray:
    """Return the Gauss-Newton step (n,).

    ``products`` (n + 1, n + 1) are ``[J e]' [J e]`` of the whitened derivatives J and errors e.
    """
    normal = products[:-1, :-1]
    # Unobservable directions get a step of zero.
    damping = 1e-13 * np.trace(normal) * np.eye(len(normal))
    return -np.linalg.solve(normal + damping, products[:-1, -1])


def _fit(
    stops: Stops,
    start: tuple[FloatArray, FloatArray],
    in_world: bool,
    degrees: float,
    rests: FloatArray,
) -> RobotWorld:
    """Fit X and Z: update variances and weights, take a Gauss-Newton step, and repeat.

    Parameters
    ----------
    stops : Stops
    start : two (4, 4) arrays
        X and Z to start from.
    in_world : bool
        Whether the errors are in the frame of the child's world, instead of the child's frame.
    degrees : float
        Degrees of freedom of the Student-t distribution.
    rests : (N,) array
        Weights of the stops, smaller for several stops at one place.
    """
    X, Z = start
    n = len(stops)
    weights = rests
    for _ in range(_MAX_ROUNDS):
        errors, jacobian = _linearise(stops, X, Z, in_world)
        squared = np.sum(errors.reshape(n, 2, 3) ** 2, axis=2)
        variances = _variances(stops, squared, weights, degrees)
        distances = squared @ (1.0 / variances)
        weights = rests * student_weights(distances, degrees)
        whitening = np.sqrt(weights[:, None] * np.repeat(1.0 / variances, 3))
        equations = np.concatenate([jacobian, errors[..., None]], axis=2)
        rows = whitening[..., None] * equations
        products = _products(rows)
        step = _gauss_newton_step(products)
        step_X, step_Z = se3.exp(step.reshape(2, 6))
        X = X @ step_X
        Z = Z @ step_Z
        converged = bool(-step @ products[:-1, -1] < _SMALL_STEP**2)
        if converged:
            break
    # Expected information of the Student-t likelihood: Lange, Little, Taylor 1989, section 4.
    factors = np.sqrt((degrees + 6.0) / (degrees + 8.0) * rests / weights)
    fisher = _products(rows * factors[:, None, None])[:-1, :-1]
    is_outlier = distances >= _OUTLIER_SQUARED
    log_tails = rests @ np.log1p(distances / degrees)
    log_variances = 1.5 * n * np.log(variances).sum()
    objective = log_variances + 0.5 * (degrees + 6.0) * log_tails
    fit = RobotWorld(
        T_parent_child=X,
        T_world_world=Z,
        covariance=np.zeros((_N_VALUES, _N_VALUES)),
        information=fisher,
        weights=np.where(is_outlier, 0.0, np.minimum(weights / rests, 1.0)),
        level_m=float(np.sqrt(variances[0])),
        level_rad=float(np.sqrt(variances[1])),
        objective=float(objective),
        converged=converged,
    )
    return replace(fit, covariance=_inverse_of(fisher, fit))


# ------------------------------------------------------------------ the covariance


class _Stretch(NamedTuple):
    """Effect of an unknown scale of the child's lengths, to first order.

    Attributes
    ----------
    step : float
        Relative change of the scale with the best fit.
    sigma : float
        Standard deviation of ``step``; infinite if the stops do not determine the scale.
    scores : (12, 12) array
        Covariance that the unknown scale adds to the covariance of the scores ``J' e``. J are the
        whitened derivatives with respect to X and Z, and e the whitened errors.
    inflation : float
        Factor by which errors that last for several stops increase the variance of the scale.
    """

    step: float
    sigma: float
    scores: FloatArray
    inflation: float


def _with_lasting_errors(
    stops: Stops,
    fit: RobotWorld,
    whitening: FloatArray,
    rests: FloatArray,
    views: FloatArray,
    stretch: float,
) -> RobotWorld:
    """Return a fit whose covariance includes correlated errors and an unknown scale.

    Errors of stops may be correlated: they last for several stops, or return with the place of the
    arm. With the information H and the covariance S of the scores under these correlations, the
    covariance is ``H^-1 S H^-1`` (sandwich estimator).

    Parameters
    ----------
    stops : Stops
        Stops without the outliers.
    fit : RobotWorld
    whitening : (N, 6, 6) array
        Matrices that make the errors of each stop independent, with unit variance.
    rests : (N,) array
        Weights of the stops, smaller for several stops at one place.
    views : (N, 13) array
        Views of the stops, from :func:`views_of_stops`.
    stretch : float
        Prior standard deviation of the scale, as a share.
    """
    rows = whitening @ rows_of(stops, fit)
    weighted = rows * np.sqrt(fit.weights[fit.weights > 0.0])[:, None, None]
    first = slice(_MAX_STOPS_AT_ONCE)
    shares = kernel_weights(correlations(views[first]), weighted[first])
    # Covariance that the correlations add to the scores of X, Z and the scale.
    lasting = np.zeros((13, 13))
    n_parts = -(-len(stops) // _MAX_STOPS_AT_ONCE)
    for part in np.array_split(np.arange(len(stops)), n_parts):
        kernel = np.tensordot(shares, correlations(views[part]), 1)
        kernel = rests[part, None] * kernel * rests[part] - np.diag(rests[part])
        by_values = np.swapaxes(rows[part, :, :13], 0, 1)
        lasting += np.einsum("kni,knj->ij", by_values, kernel @ by_values)
    lasting *= (_DEGREES + 6.0) / (_DEGREES + 8.0)
    whitened = np.sqrt(rests)[:, None, None] * weighted
    of_scale = _stretch_of(whitened.reshape(-1, 14), lasting, stretch)
    scores = lasting[:12, :12] + of_scale.scores
    # Few stops hardly determine the variances of the errors. The factor covers this uncertainty.
    level_factor = 1.0 + 2.0 / max(3.0 * len(stops) - 0.5 * _N_VALUES, 0.5)
    covariance = level_factor * (
        fit.covariance + fit.covariance @ scores @ fit.covariance
    )
    return replace(
        fit,
        covariance=covariance,
        scale_step=of_scale.step,
        scale_sigma=of_scale.sigma * math.sqrt(level_factor),
        scale_inflation=of_scale.inflation,
    )


def whitened_rows(stops: Stops, fit: RobotWorld) -> FloatArray:
    """Return derivatives and errors (N, 6, 14) of stops, divided by their standard deviations.

    The columns are those of :func:`rows_of`.
    """
    levels = np.repeat([fit.level_m, fit.level_rad], 3)
    return np.asarray(rows_of(stops, fit) / levels[:, None])


def rows_of(stops: Stops, fit: RobotWorld) -> FloatArray:
    """Return derivatives and errors (N, 6, 14) of stops, in the frame of the child.

    The columns are: derivatives with respect to X and Z (12), the derivative with respect to the
    scale of the child's lengths (1), and the errors (1). The derivative by the scale uses predicted
    positions of the child. Measured positions contain noise that is also in the errors, and would
    make the estimated scale too small.
    """
    errors, jacobian = _linearise(stops, fit.T_parent_child, fit.T_world_world)
    predicted = (
        se3.inverse(fit.T_world_world)
        @ stops.Ts_world_parent
        @ fit.T_parent_child
    )
    by_length = np.zeros((len(stops), 6))
    by_length[:, :3] = se3.translation_of(se3.inverse(predicted))
    return np.concatenate(
        [jacobian, by_length[..., None], errors[..., None]], axis=2
    )


def _stretch_of(
    rows: FloatArray, lasting: FloatArray, stretch: float
) -> _Stretch:
    """Return the effect of an unknown scale of the child's lengths.

    Parameters
    ----------
    rows : (6 N, 14) array
        Weighted rows of :func:`whitened_rows`.
    lasting : (13, 13) array
        Covariance that correlations of errors add to the scores of X, Z and the scale.
    stretch : float
        Prior standard deviation of the scale, as a share.
    """
    size = np.sum(rows**2)
    products = rows.T @ rows + 1e-12 * size * np.eye(14)
    # Parts of the scale's derivative, and of the errors along it, that X and Z cannot explain.
    by_length, by_errors = np.linalg.cholesky(products)[12:, 12]
    direction = np.append(
        -np.linalg.solve(products[:12, :12], products[:12, 12]), 1.0
    )
    inflation = max(
        1.0 + float(direction @ lasting @ direction) / float(by_length**2), 1.0
    )
    step = 0.0
    sigma = math.inf
    # The regularisation of ``products`` alone could produce a value below this limit.
    if by_length > 2e-6 * math.sqrt(float(size)):
        step = -by_errors / by_length
        sigma = math.sqrt(inflation) / by_length
    information = by_length**2 / inflation + stretch**-2.0
    mean = by_length * by_errors / inflation / information
    square = mean**2 + 1.0 / information
    scores = square * np.outer(products[:12, 12], products[:12, 12])
    return _Stretch(step, sigma, scores, inflation)
