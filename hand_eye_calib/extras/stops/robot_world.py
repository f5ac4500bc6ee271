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

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.stats import student_weights
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.closed_form import Stops, start_poses
from hand_eye_calib.extras.stops.lasting_errors import (
    kernel_weights,
    kernels_of,
    rest_weights,
    views_of,
)

# A rotation about an axis needs two motions, which are three stops.
MIN_STOPS = 3

# Degrees of freedom of the Student-t distribution of errors. Measured: between 4 and 30, motions
# between stops that were left out close equally well, to 1 %, on recordings of two arms.
_DEGREES = 12.0

# Squared distance of six values from which on a stop is an outlier: 1 in 300,000 normal errors.
_OUTLIER_SQUARED = 36.0

# Degrees of freedom while outliers are detected: few outliers hardly widen so heavy tails.
_OUTLIER_DEGREES = 3.0

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
    """Solution of ``A_i X = Z B_i`` for C children and W worlds of theirs.

    Attributes
    ----------
    Ts_parent_child : (C, 4, 4) array
        X of each child.
    Ts_world_world : (W, 4, 4) array
        Z: pose of each world of the children in the parent's world.
    covariance : (6 (C + W), 6 (C + W)) array
        Covariance of the right perturbations (rho, phi) of all X, then of all Z, in the frames of
        the children and of their worlds. Undetermined directions have large variances.
    information : (6 (C + W), 6 (C + W)) array
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
        Share by which longer positions of the children would fit best, to first order, and its
        standard deviation; infinite if the stops do not determine it. For several sensors or
        targets, those of the pair with most stops.
    inflation : float
        Factor of the variances for errors that last over several stops.
    """

    Ts_parent_child: FloatArray
    Ts_world_world: FloatArray
    covariance: FloatArray
    information: FloatArray
    weights: FloatArray
    level_m: float
    level_rad: float
    objective: float
    converged: bool
    scale_step: float = 0.0
    scale_sigma: float = float("inf")
    inflation: float = 1.0

    def undetermined(self) -> FloatArray:
        """Return the directions (6, K), as right perturbations, of the first X that are unknown."""
        to_others = self.information[:6, 6:]
        others = np.linalg.pinv(self.information[6:, 6:], hermitian=True)
        marginal = self.information[:6, :6] - to_others @ others @ to_others.T
        levels = np.repeat([self.level_m, self.level_rad], 3)
        n_used = max(int(np.sum(self.weights > 0.0)), 1)
        # In units of the errors of a stop: the squared rotations between stops (rad^2).
        squared_turns = marginal * np.outer(levels, levels) / n_used
        eigenvalues, directions = np.linalg.eigh(squared_turns)
        return directions[:, eigenvalues < _DETERMINED * self.level_rad**2]


class _Pair(NamedTuple):
    """A child with one of its worlds: rows (K,) of its stops, columns (12,) of its X and Z."""

    rows: IntArray
    columns: IntArray


def solve(stops: Stops, stretch: float = STRETCH) -> RobotWorld:
    """Return the most likely X and Z.

    Parameters
    ----------
    stops : Stops
        At least three.
    stretch : float
        Prior standard deviation, as a share, of the scale of the children's lengths; infinite if
        nothing is known of it. The covariance contains its effect.

    Raises
    ------
    NotEnoughDataError
        If a child or one of its worlds has no stops, or none of the pairs has three.

    Notes
    -----
    The start has a closed form: rotations by M. Shah, *Solving the robot-world/hand-eye calibration
    problem using the Kronecker product*, Journal of Mechanisms and Robotics 5(3), 2013, eq. 18,
    then translations by linear least squares. Outliers are detected with heavy tails and left out.
    Both frames of the errors are tried, the child's and that of its world (a target whose pose a
    camera measured); the likelier one is kept.
    """
    counts = _counts_of_pairs(stops)
    if counts.max() < MIN_STOPS or not counts.any(axis=1).all() or not counts.any(axis=0).all():
        raise NotEnoughDataError(
            f"{len(stops)} stops are too few: at least {MIN_STOPS} of each sensor, with rotations "
            "about two axes, are necessary; 15 or more are better"
        )
    starts = start_poses(stops, counts)
    views = views_of(stops.Ts_world_parent, stops.Ts_world_child)
    rests = rest_weights(views)
    fits = [_fit_without_outliers(stops, starts, in_world, rests) for in_world in (False, True)]
    in_world = fits[1].objective < fits[0].objective
    best = fits[int(in_world)]
    is_kept = best.weights > 0.0
    return _with_lasting_errors(
        stops[is_kept], best, in_world, rests[is_kept], views[is_kept], stretch
    )


def _counts_of_pairs(stops: Stops) -> IntArray:
    """Return the numbers of stops (C, W) of each child with each of its worlds."""
    n_children = 1 + int(stops.child.max(initial=0))
    n_worlds = 1 + int(stops.world.max(initial=0))
    counts = np.zeros((n_children, n_worlds), dtype=np.int64)
    np.add.at(counts, (stops.child, stops.world), 1)
    return counts


def _fit_without_outliers(
    stops: Stops,
    starts: tuple[FloatArray, FloatArray],
    in_world: bool,
    rests: FloatArray,
) -> RobotWorld:
    """Detect outliers with heavy tails, and fit the other stops."""
    n = len(stops)
    n_poses = sum(map(len, starts))
    # With heavier tails a few stops fit exactly, and all others are outliers.
    fewest_degrees = 8.0 * n_poses / max(n - n_poses, 0.1)
    rough = _fit(stops, starts, in_world, max(fewest_degrees, _OUTLIER_DEGREES), rests)
    is_kept = rough.weights > 0.0
    fit = _fit(
        stops[is_kept],
        (rough.Ts_parent_child, rough.Ts_world_world),
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
    stops: Stops, Xs: FloatArray, Zs: FloatArray, in_world: bool
) -> tuple[FloatArray, FloatArray]:
    """Return the errors (N, 6) of stops, and their derivatives (N, 6, 12) by X and Z of the stop.

    ``in_world`` chooses the frame of the errors: the world of the child, rather than the child.
    """
    predicted = se3.inverse(Zs[stops.world]) @ stops.Ts_world_parent @ Xs[stops.child]
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


def _pairs(stops: Stops, n_children: int) -> list[_Pair]:
    """Return the pairs of a child and one of its worlds that have stops."""
    blocks = np.stack([stops.child, n_children + stops.world], axis=1)
    unique_blocks, pair_of_stop = np.unique(blocks, axis=0, return_inverse=True)
    columns = (6 * unique_blocks[..., None] + np.arange(6)).reshape(-1, 12)
    pair_of_stop = pair_of_stop.ravel()
    return [_Pair(np.flatnonzero(pair_of_stop == k), columns[k]) for k in range(len(columns))]


def _products(rows: FloatArray, pairs: list[_Pair], n_values: int) -> FloatArray:
    """Return the products (n + 1, n + 1) of the columns of rows (N, 6, 13).

    The columns of a stop are those of its X and its Z, and one more.
    """
    products = np.zeros((n_values + 1, n_values + 1))
    for pair in pairs:
        of_pair = rows[pair.rows].reshape(-1, 13)
        columns = np.append(pair.columns, n_values)
        products[columns[:, None], columns] += of_pair.T @ of_pair
    return products


def _variances(
    stops: Stops, squared: FloatArray, weights: FloatArray, n_values: int, degrees: float
) -> FloatArray:
    """Return the variances (2,) of positions and rotations.

    If all positions may fit exactly, both are one level, over the spread of the places.

    Parameters
    ----------
    stops : Stops
    squared : (N, 2) array
        Squared errors of positions and rotations.
    weights : (N,) array
    n_values : int
        Number of estimated values.
    degrees : float
        Degrees of freedom of the Student-t distribution.
    """
    n = len(stops)
    # Estimated values make the errors smaller.
    n_free = max(3.0 * n - 0.5 * n_values, 0.5)
    # Sum of the weights at convergence. Variances that use it from the start settle sooner:
    # C. Liu, D. B. Rubin, Y. N. Wu, *Parameter expansion to accelerate EM*, Biometrika 85, 1998.
    final_sum = ((degrees + 6.0) * n - 2.0 * n_free) / degrees
    means = final_sum / weights.sum() * (weights @ squared) / n_free
    if 3 * n <= n_values:
        places_m2 = se3.translation_of(stops.Ts_world_child).var(axis=0).sum() + _SMALLEST_VARIANCE
        means = means @ [0.5 / places_m2, 0.5] * np.array([places_m2, 1.0])
    return np.maximum(means, _SMALLEST_VARIANCE)


def _gauss_newton_step(products: FloatArray) -> FloatArray:
    """Return the step (n,) of the products (n + 1, n + 1) of derivatives and errors."""
    normal = products[:-1, :-1]
    # Undetermined directions stay where they are.
    damping = 1e-13 * np.trace(normal) * np.eye(len(normal))
    return -np.linalg.solve(normal + damping, products[:-1, -1])


def _fit(
    stops: Stops,
    starts: tuple[FloatArray, FloatArray],
    in_world: bool,
    degrees: float,
    rests: FloatArray,
) -> RobotWorld:
    """Estimate weights, variances and Gauss-Newton steps in turn.

    Parameters
    ----------
    stops : Stops
    starts : arrays (C, 4, 4) and (W, 4, 4)
        X and Z to start from.
    in_world : bool
        Whether errors are normal in the frame of the child's world, rather than in the child's.
    degrees : float
        Degrees of freedom of the Student-t distribution.
    rests : (N,) array
        Weights of stops at one place.
    """
    Xs, Zs = starts
    n = len(stops)
    n_values = 6 * (len(Xs) + len(Zs))
    pairs = _pairs(stops, len(Xs))
    weights = rests
    for _ in range(_ROUNDS):
        errors, jacobian = _linearise(stops, Xs, Zs, in_world)
        squared = np.sum(errors.reshape(n, 2, 3) ** 2, axis=2)
        variances = _variances(stops, squared, weights, n_values, degrees)
        distances = squared @ (1.0 / variances)
        weights = rests * student_weights(distances, degrees)
        whitening = np.sqrt(weights[:, None] * np.repeat(1.0 / variances, 3))
        rows = whitening[..., None] * np.concatenate([jacobian, errors[..., None]], axis=2)
        products = _products(rows, pairs, n_values)
        step = _gauss_newton_step(products)
        transforms = se3.exp(step.reshape(-1, 6))
        Xs = Xs @ transforms[: len(Xs)]
        Zs = Zs @ transforms[len(Xs) :]
        converged = bool(-step @ products[:-1, -1] < _SMALL_STEP**2)
        if converged:
            break
    # Information of normal errors under a Student-t likelihood: Lange, Little, Taylor, *Robust
    # statistical modeling using the t distribution*, JASA 84, 1989, section 4.
    rows *= np.sqrt((degrees + 6.0) / (degrees + 8.0) * rests / weights)[:, None, None]
    fisher = _products(rows, pairs, n_values)[:-1, :-1]
    # Prior of undetermined directions: a thousand times the errors of a stop.
    weak_prior = np.diag(np.tile(np.repeat(1e-6 / variances, 3), n_values // 6))
    objective = 1.5 * n * np.log(variances).sum()
    objective += 0.5 * (degrees + 6.0) * rests @ np.log1p(distances / degrees)
    is_inlier = distances < _OUTLIER_SQUARED
    return RobotWorld(
        Ts_parent_child=Xs,
        Ts_world_world=Zs,
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
    """Effect of longer positions of the children of one pair, to first order.

    Attributes
    ----------
    step, sigma : float
        Share by which longer positions would fit best, and its standard deviation; infinite if the
        stops do not determine it.
    scores : (12, 12) array
        Covariance that the unknown scale adds to the scores (the products of the derivatives by the
        values and the errors).
    """

    step: float
    sigma: float
    scores: FloatArray


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
    rows = _whitened_rows(stops, fit, in_world)
    weighted = rows * np.sqrt(fit.weights[fit.weights > 0.0])[:, None, None]
    pairs = _pairs(stops, len(fit.Ts_parent_child))
    largest = max((pair.rows for pair in pairs), key=len)[:_MOST_AT_ONCE]
    shares = kernel_weights(kernels_of(views[largest]), weighted[largest])
    # Covariance of the scores, beside that of independent errors.
    scores = np.zeros_like(fit.information)
    for pair in pairs:
        n_parts = -(-len(pair.rows) // _MOST_AT_ONCE)
        for part in np.array_split(pair.rows, n_parts):
            kernel = np.tensordot(shares, kernels_of(views[part]), 1)
            kernel = rests[part, None] * kernel * rests[part] - np.diag(rests[part])
            by_values = np.swapaxes(rows[part, :, :12], 0, 1)
            product = np.einsum("kni,knj->ij", by_values, kernel @ by_values)
            scores[np.ix_(pair.columns, pair.columns)] += product
    scores *= (_DEGREES + 6.0) / (_DEGREES + 8.0)
    inflation = 1.0 + np.trace(scores @ fit.covariance) / len(scores)
    step = 0.0
    sigma = math.inf
    for pair in pairs:
        of_pair = np.sqrt(rests[pair.rows])[:, None, None] * weighted[pair.rows]
        longer = _stretch_of(of_pair.reshape(-1, 14), inflation, stretch)
        scores[np.ix_(pair.columns, pair.columns)] += longer.scores
        if len(pair.rows) >= len(largest) and longer.sigma < math.inf:
            step = longer.step
            sigma = longer.sigma
    # Few stops hardly determine the levels.
    level_factor = 1.0 + 2.0 / max(3.0 * len(stops) - 0.5 * len(scores), 0.5)
    covariance = level_factor * (fit.covariance + fit.covariance @ scores @ fit.covariance)
    return replace(
        fit,
        covariance=covariance,
        scale_step=step,
        scale_sigma=sigma * math.sqrt(level_factor),
        inflation=float(inflation),
    )


def _whitened_rows(stops: Stops, fit: RobotWorld, in_world: bool) -> FloatArray:
    """Return derivatives and errors (N, 6, 14) of stops, in units of their levels.

    The columns are the derivatives by X and Z (12), by longer positions of the children (1), and
    the errors (1).
    """
    errors, jacobian = _linearise(stops, fit.Ts_parent_child, fit.Ts_world_world, in_world)
    by_length = np.zeros((len(stops), 6))
    if in_world:
        by_length[:, :3] = -se3.translation_of(stops.Ts_world_child)
    else:
        by_length[:, :3] = se3.translation_of(se3.inverse(stops.Ts_world_child))
    rows = np.concatenate([jacobian, by_length[..., None], errors[..., None]], axis=2)
    levels = np.repeat([fit.level_m, fit.level_rad], 3)
    return np.asarray(rows / levels[:, None])


def _stretch_of(rows: FloatArray, inflation: float, stretch: float) -> _Stretch:
    """Return the effect of longer positions of a pair.

    Parameters
    ----------
    rows : (6 K, 14) array
        Of :func:`_whitened_rows`.
    inflation : float
        Factor of all variances for lasting errors.
    stretch : float
        Prior standard deviation of the scale, as a share.
    """
    size = np.sum(rows**2)
    products = rows.T @ rows + 1e-12 * size * np.eye(14)
    # What is left of longer positions and errors once X and Z are fitted.
    by_length, by_errors = np.linalg.cholesky(products)[12:, 12]
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
    return _Stretch(step, sigma, scores)
