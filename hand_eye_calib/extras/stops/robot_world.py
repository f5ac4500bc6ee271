"""Stops: independent poses without an order, ``A_i X = Z B_i`` by robust maximum likelihood.

A_i is the pose of the parent sensor in its world, such as the hand in the base of a robot. B_i is
the pose of the child sensor in its own world, such as the camera in the frame of a target. X is the
pose of the child in the parent, Z the pose of the child's world in the parent's world (robot-world
calibration; eye-to-hand if the arm carries the target).

A robot stops, measures and moves on: poses of neighbours contain no more than those of any two
stops. So each stop is compared with Z. Its error ``xi_i = Log(B_i^-1 Z^-1 A_i X)``, in the frame of
the child or of its world, has a Student-t distribution with one variance for positions and one for
rotations.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.stats import student_weights
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.closed_form import Stops, robust_start
from hand_eye_calib.extras.stops.lasting_errors import (
    kernel_weights,
    kernels_of,
    rest_weights,
    views_of,
)

# A rotation about an axis needs two motions, which are three stops.
MIN_STOPS = 3

# Degrees of freedom of the Student-t distribution of errors. Measured: between 4 and 30, motions
# between stops that were left out close equally well, to 1 %, on recordings of two arms. With
# normal errors (KinHEC), rotations are 3 % worse at 12 degrees and 2 % at 16 than at 1000.
_DEGREES = 16.0

# Squared distance of six values from which on a stop is an outlier: 1 in 300,000 normal errors.
_OUTLIER_SQUARED = 36.0

# Difference of the log likelihoods of both frames of the errors at which the likelier frame has e
# times the weight of the other. Errors of a robot's geometry last, so likelihoods of independent
# errors are too certain. Measured on KinHEC: 5 to 20 lower the errors of robots with wrong
# dimensions by 7 to 10 %; above 10, noise of images loses.
_LIKELIHOOD_SCALE = 10.0

# Degrees of freedom while outliers are detected: few outliers hardly widen so heavy tails.
_OUTLIER_DEGREES = 3.0

# Number of estimated values: six of X and six of Z.
_N_VALUES = 12

# Largest number of rounds of weights, variances and a Gauss-Newton step; a step below this many
# standard deviations ends them.
_ROUNDS = 60
_SMALL_STEP = 1e-2

# Smallest variance of errors (m^2, rad^2): the rounding of copied poses.
_SMALLEST_VARIANCE = 1e-24

# A direction is determined if the squared rotations between stops that reveal it exceed this
# multiple of the squared error of a rotation, which looks like a rotation itself.
_DETERMINED = 8.0

# Standard deviation of the scale of distances to a target, as a share: a usual error of the size of
# the target or of the focal length.
STRETCH = 0.03

# Largest number of stops whose lasting errors are computed together.
_MOST_AT_ONCE = 300


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
        Covariance of the right perturbations (rho, phi) of X, then of Z, in the frames of the child
        and of its world. Undetermined directions have large variances.
    information : (12, 12) array
        Fisher information of the same if the errors of each stop are independent and normal.
    weights : (N,) array
        Weight of each stop: 1 for errors as large as the levels, less for larger ones, 0 for an
        outlier.
    level_m, level_rad : float
        Standard deviations of the errors of a stop's position and rotation, per axis.
    objective : float
        Negative log likelihood.
    converged : bool
    scale_step, scale_sigma : float
        Share by which longer positions of the child would fit best, to first order, and its
        standard deviation; infinite if the stops do not determine it.
    scale_inflation : float
        Factor of the variance of the scale for errors that last over several stops.
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
        """Return the directions (6, K), as right perturbations, of X that are unknown."""
        to_others = self.information[:6, 6:]
        others = np.linalg.pinv(self.information[6:, 6:], hermitian=True)
        marginal = self.information[:6, :6] - to_others @ others @ to_others.T
        levels = np.repeat([self.level_m, self.level_rad], 3)
        n_used = max(int(np.sum(self.weights > 0.0)), 1)
        # In units of the errors of a stop: the squared rotations between stops (rad^2).
        squared_turns = marginal * np.outer(levels, levels) / n_used
        eigenvalues, directions = np.linalg.eigh(squared_turns)
        return directions[:, eigenvalues < _DETERMINED * self.level_rad**2]


def solve(stops: Stops, stretch: float = STRETCH) -> RobotWorld:
    """Return the most likely X and Z.

    Parameters
    ----------
    stops : Stops
        At least three.
    stretch : float
        Prior standard deviation, as a share, of the scale of the child's lengths; infinite if
        nothing is known of it. The covariance contains its effect.

    Raises
    ------
    NotEnoughDataError
        If there are fewer than three stops.

    Notes
    -----
    The start has a closed form: rotations by M. Shah, *Solving the robot-world/hand-eye calibration
    problem using the Kronecker product*, Journal of Mechanisms and Robotics 5(3), 2013, eq. 18,
    then translations by linear least squares. Outliers are detected with heavy tails and left out.
    Both frames of the errors are tried, the child's and that of its world (a target whose pose a
    camera measured). The fits are averaged with weights of their likelihoods.
    """
    if len(stops) < MIN_STOPS:
        raise NotEnoughDataError(
            f"{len(stops)} stops are too few: at least {MIN_STOPS}, with rotations about two axes, "
            "are necessary; 15 or more are better"
        )
    start = robust_start(stops)
    views = views_of(stops.Ts_world_parent, stops.Ts_world_child)
    rests = rest_weights(views)
    fits = [_fit_without_outliers(stops, start, in_world, rests) for in_world in (False, True)]
    in_world = fits[1].objective < fits[0].objective
    best = fits[int(in_world)]
    other = fits[int(not in_world)]
    is_kept = best.weights > 0.0
    best = _with_lasting_errors(
        stops[is_kept], best, in_world, rests[is_kept], views[is_kept], stretch
    )
    return _averaged(best, other)


def _averaged(best: RobotWorld, other: RobotWorld) -> RobotWorld:
    """Return the fit in the likelier frame, moved towards the fit in the other frame.

    Both are weighted by their likelihoods. The covariance contains their scatter. A fit in the
    other frame that contradicts the best one is ignored.
    """
    offsets = [
        se3.log(se3.inverse(best.T_parent_child) @ other.T_parent_child),
        se3.log(se3.inverse(best.T_world_world) @ other.T_world_world),
    ]
    offset = np.concatenate(offsets)
    if offset @ np.linalg.solve(best.covariance, offset) > _OUTLIER_SQUARED:
        return best
    odds = math.exp((best.objective - other.objective) / _LIKELIHOOD_SCALE)
    weight = odds / (1.0 + odds)
    step_X, step_Z = se3.exp(weight * np.reshape(offset, (2, 6)))
    return replace(
        best,
        T_parent_child=best.T_parent_child @ step_X,
        T_world_world=best.T_world_world @ step_Z,
        covariance=best.covariance + weight * (1.0 - weight) * np.outer(offset, offset),
    )


def _fit_without_outliers(
    stops: Stops,
    start: tuple[FloatArray, FloatArray],
    in_world: bool,
    rests: FloatArray,
) -> RobotWorld:
    """Detect outliers with heavy tails, and fit the other stops."""
    n = len(stops)
    # With heavier tails a few stops fit exactly, and all others are outliers.
    fewest_degrees = 16.0 / (n - 2)
    rough = _fit(stops, start, in_world, max(fewest_degrees, _OUTLIER_DEGREES), rests)
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
    # Each stop that is left out counts as an outlier at the limit.
    log_levels = 6.0 * (np.log(fit.level_m) + np.log(fit.level_rad))
    n_left_out = float(np.sum(weights == 0.0))
    objective = fit.objective + 0.5 * n_left_out * (log_levels + _OUTLIER_SQUARED)
    return replace(fit, weights=weights, objective=objective)


# ------------------------------------------------------------------ the fit


def _linearise(
    stops: Stops, X: FloatArray, Z: FloatArray, in_world: bool
) -> tuple[FloatArray, FloatArray]:
    """Return the errors (N, 6) of stops, and their derivatives (N, 6, 12).

    The derivatives are with respect to X and Z.

    ``in_world`` chooses the frame of the errors: the world of the child, rather than the child.
    """
    predicted = se3.inverse(Z) @ stops.Ts_world_parent @ X
    measured = se3.inverse(stops.Ts_world_child)
    if in_world:
        errors = se3.log(predicted @ measured)
        frames = stops.Ts_world_child
    else:
        errors = se3.log(measured @ predicted)
        frames = np.broadcast_to(np.eye(4), predicted.shape)
    by_X = se3.adjoint(frames)
    by_Z = -se3.adjoint(frames @ se3.inverse(predicted))
    return errors, np.concatenate([by_X, by_Z], axis=2)


def _variances(
    stops: Stops, squared: FloatArray, weights: FloatArray, degrees: float
) -> FloatArray:
    """Return the variances (2,) of positions and rotations.

    If all positions may fit exactly, both are one level, over the spread of the places.

    Parameters
    ----------
    stops : Stops
    squared : (N, 2) array
        Squared errors of positions and rotations.
    weights : (N,) array
    degrees : float
        Degrees of freedom of the Student-t distribution.
    """
    n = len(stops)
    # Estimated values make the errors smaller.
    n_free = max(3.0 * n - 0.5 * _N_VALUES, 0.5)
    # Sum of the weights at convergence. Variances that use it from the start settle sooner:
    # C. Liu, D. B. Rubin, Y. N. Wu, *Parameter expansion to accelerate EM*, Biometrika 85, 1998.
    final_sum = ((degrees + 6.0) * n - 2.0 * n_free) / degrees
    means = final_sum / weights.sum() * (weights @ squared) / n_free
    if 3 * n <= _N_VALUES:
        places_m2 = se3.translation_of(stops.Ts_world_child).var(axis=0).sum() + _SMALLEST_VARIANCE
        means = means @ [0.5 / places_m2, 0.5] * np.array([places_m2, 1.0])
    return np.maximum(means, _SMALLEST_VARIANCE)


def _products(rows: FloatArray) -> FloatArray:
    """Return the products (n, n) of the columns of rows (N, 6, n)."""
    columns = rows.reshape(-1, rows.shape[2])
    return columns.T @ columns


def _gauss_newton_step(products: FloatArray) -> FloatArray:
    """Return the step (n,) of the products (n + 1, n + 1) of derivatives and errors."""
    normal = products[:-1, :-1]
    # Undetermined directions stay where they are.
    damping = 1e-13 * np.trace(normal) * np.eye(len(normal))
    return -np.linalg.solve(normal + damping, products[:-1, -1])


def _fit(
    stops: Stops,
    start: tuple[FloatArray, FloatArray],
    in_world: bool,
    degrees: float,
    rests: FloatArray,
) -> RobotWorld:
    """Estimate weights, variances and Gauss-Newton steps in turn.

    Parameters
    ----------
    stops : Stops
    start : two (4, 4) arrays
        X and Z to start from.
    in_world : bool
        Whether errors are normal in the frame of the child's world, rather than in the child's.
    degrees : float
        Degrees of freedom of the Student-t distribution.
    rests : (N,) array
        Weights of stops at one place.
    """
    X, Z = start
    n = len(stops)
    weights = rests
    for _ in range(_ROUNDS):
        errors, jacobian = _linearise(stops, X, Z, in_world)
        squared = np.sum(errors.reshape(n, 2, 3) ** 2, axis=2)
        variances = _variances(stops, squared, weights, degrees)
        distances = squared @ (1.0 / variances)
        weights = rests * student_weights(distances, degrees)
        whitening = np.sqrt(weights[:, None] * np.repeat(1.0 / variances, 3))
        rows = whitening[..., None] * np.concatenate([jacobian, errors[..., None]], axis=2)
        products = _products(rows)
        step = _gauss_newton_step(products)
        step_X, step_Z = se3.exp(step.reshape(2, 6))
        X = X @ step_X
        Z = Z @ step_Z
        converged = bool(-step @ products[:-1, -1] < _SMALL_STEP**2)
        if converged:
            break
    # Information of normal errors under a Student-t likelihood: Lange, Little, Taylor, *Robust
    # statistical modeling using the t distribution*, JASA 84, 1989, section 4.
    rows *= np.sqrt((degrees + 6.0) / (degrees + 8.0) * rests / weights)[:, None, None]
    fisher = _products(rows)[:-1, :-1]
    # Prior of undetermined directions: a thousand times the errors of a stop.
    weak_prior = np.diag(np.tile(np.repeat(1e-6 / variances, 3), 2))
    objective = 1.5 * n * np.log(variances).sum()
    objective += 0.5 * (degrees + 6.0) * rests @ np.log1p(distances / degrees)
    is_inlier = distances < _OUTLIER_SQUARED
    return RobotWorld(
        T_parent_child=X,
        T_world_world=Z,
        covariance=np.asarray(np.linalg.inv(fisher + weak_prior), dtype=float),
        information=fisher,
        weights=np.where(is_inlier, np.minimum(weights / rests, 1.0), 0.0),
        level_m=float(np.sqrt(variances[0])),
        level_rad=float(np.sqrt(variances[1])),
        objective=float(objective),
        converged=converged,
    )


# ------------------------------------------------------------------ the covariance


class _Stretch(NamedTuple):
    """Effect of longer positions of the child, to first order.

    Attributes
    ----------
    step, sigma : float
        Share by which longer positions would fit best, and its standard deviation; infinite if the
        stops do not determine it.
    scores : (12, 12) array
        Covariance that the unknown scale adds to the scores (the products of the errors and their
        derivatives with respect to the values).
    inflation : float
        Factor of the variance for lasting errors.
    """

    step: float
    sigma: float
    scores: FloatArray
    inflation: float


def _with_lasting_errors(
    stops: Stops,
    fit: RobotWorld,
    in_world: bool,
    rests: FloatArray,
    views: FloatArray,
    stretch: float,
) -> RobotWorld:
    """Return a fit with the covariance for lasting errors, and for targets of another size.

    Parameters
    ----------
    stops : Stops
        Those that were not left out.
    fit : RobotWorld
    in_world : bool
        Frame of the errors, as of :func:`_linearise`.
    rests : (N,) array
        Weights of stops at one place.
    views : (N, 13) array
        Of :func:`views_of`.
    stretch : float
        Prior standard deviation of the scale, as a share.
    """
    rows = whitened_rows(stops, fit, in_world)
    weighted = rows * np.sqrt(fit.weights[fit.weights > 0.0])[:, None, None]
    first = slice(_MOST_AT_ONCE)
    shares = kernel_weights(kernels_of(views[first]), weighted[first])
    # Covariance that lasting errors add to the scores of X, Z and the scale.
    lasting = np.zeros((13, 13))
    n_parts = -(-len(stops) // _MOST_AT_ONCE)
    for part in np.array_split(np.arange(len(stops)), n_parts):
        kernel = np.tensordot(shares, kernels_of(views[part]), 1)
        kernel = rests[part, None] * kernel * rests[part] - np.diag(rests[part])
        by_values = np.swapaxes(rows[part, :, :13], 0, 1)
        lasting += np.einsum("kni,knj->ij", by_values, kernel @ by_values)
    lasting *= (_DEGREES + 6.0) / (_DEGREES + 8.0)
    whitened = np.sqrt(rests)[:, None, None] * weighted
    longer = _stretch_of(whitened.reshape(-1, 14), lasting, stretch)
    scores = lasting[:12, :12] + longer.scores
    # Few stops hardly determine the levels.
    level_factor = 1.0 + 2.0 / max(3.0 * len(stops) - 0.5 * _N_VALUES, 0.5)
    covariance = level_factor * (fit.covariance + fit.covariance @ scores @ fit.covariance)
    return replace(
        fit,
        covariance=covariance,
        scale_step=longer.step,
        scale_sigma=longer.sigma * math.sqrt(level_factor),
        scale_inflation=longer.inflation,
    )


def whitened_rows(stops: Stops, fit: RobotWorld, in_world: bool) -> FloatArray:
    """Return derivatives and errors (N, 6, 14) of stops, in units of their levels.

    The columns are the derivatives with respect to X and Z (12), that with respect to longer
    positions of the child (1), and the errors (1).
    """
    errors, jacobian = _linearise(stops, fit.T_parent_child, fit.T_world_world, in_world)
    by_length = np.zeros((len(stops), 6))
    if in_world:
        by_length[:, :3] = -se3.translation_of(stops.Ts_world_child)
    else:
        by_length[:, :3] = se3.translation_of(se3.inverse(stops.Ts_world_child))
    rows = np.concatenate([jacobian, by_length[..., None], errors[..., None]], axis=2)
    levels = np.repeat([fit.level_m, fit.level_rad], 3)
    return np.asarray(rows / levels[:, None])


def _stretch_of(rows: FloatArray, lasting: FloatArray, stretch: float) -> _Stretch:
    """Return the effect of longer positions of the child.

    Parameters
    ----------
    rows : (6 N, 14) array
        Of :func:`whitened_rows`.
    lasting : (13, 13) array
        Covariance that lasting errors add to the scores of X, Z and the scale.
    stretch : float
        Prior standard deviation of the scale, as a share.
    """
    size = np.sum(rows**2)
    products = rows.T @ rows + 1e-12 * size * np.eye(14)
    # What is left of longer positions and errors once X and Z are fitted.
    by_length, by_errors = np.linalg.cholesky(products)[12:, 12]
    direction = np.append(-np.linalg.solve(products[:12, :12], products[:12, 12]), 1.0)
    inflation = max(1.0 + float(direction @ lasting @ direction) / float(by_length**2), 1.0)
    step = 0.0
    sigma = math.inf
    # What keeps the matrix definite is no information about the scale.
    if by_length > 2e-6 * math.sqrt(float(size)):
        step = -by_errors / by_length
        sigma = math.sqrt(inflation) / by_length
    information = by_length**2 / inflation + stretch**-2.0
    mean = by_length * by_errors / inflation / information
    square = mean**2 + 1.0 / information
    scores = square * np.outer(products[:12, 12], products[:12, 12])
    return _Stretch(step, sigma, scores, inflation)
