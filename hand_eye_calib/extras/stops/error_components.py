"""Fit of X and Z from stops with several sources of error.

The error of a stop, ``xi_i = Log(B_i^-1 Z^-1 A_i X)`` in the frame of the child, is a sum of
independent errors:

- a position across the line of sight from the child to the origin of its world, such as errors of
  the robot and of the pixels;
- a position along the line of sight: the distance of a target is measured worse than its direction;
- a rotation about the origin of the child, such as that of a robot's hand;
- a rotation about the origin of the child's world, such as that of a target in a camera. This
  rotation moves the child;
- for a flat target, a tilt: a rotation as in the last item, about an axis across the line of sight.
  It is larger for views from the front (:mod:`hand_eye_calib.extras.stops.flat_target`).

Their variances are estimated by restricted maximum likelihood: D. A. Harville, *Maximum likelihood
approaches to variance component estimation*, JASA 72, 1977. Each iteration is the update of
H. Zhou, L. Hu, J. Zhou, K. Lange, *MM algorithms for variance components models*, Journal of
Computational and Graphical Statistics 28(2), 2019, with a Gauss-Newton step of X and Z.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import student_weights
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.closed_form import Stops
from hand_eye_calib.extras.stops.flat_target import sines_of_views, usual_sine

# Number of sources that are positions. They are the first ones; the others are rotations.
_N_POSITION_SOURCES = 2

# Prior standard deviation of the logarithm of each variance: a factor of 4.5. Measured on stops of
# simulated arms.
_PRIOR_SIGMA = 1.5

# Largest number of iterations.
_MAX_ROUNDS = 100
# The iteration ends if X and Z, in standard deviations, and the log variances change by less.
_SMALL_CHANGE = 3e-3

# Largest number of iterations for linear values.
_MAX_LINEAR_ROUNDS = 30
# Step of linear values, in standard deviations, at which the iteration ends.
_SMALL_LINEAR_STEP = 0.1
# Change of the log variances at which the iteration for linear values ends.
_SMALL_LOG_CHANGE = 0.05

# Smallest variance (m^2, rad^2): rounding of poses without errors.
MIN_VARIANCE = 1e-24

# Function that returns the errors (N, 6) of stops and their derivatives (N, 6, 12) for X and Z.
Linearise = Callable[
    [Stops, FloatArray, FloatArray], tuple[FloatArray, FloatArray]
]


@dataclass(frozen=True)
class ComponentsFit:
    """Fit of X and Z with the variances of all sources of error.

    Attributes
    ----------
    T_parent_child, T_world_world : (4, 4) arrays
        X and Z.
    information : (12, 12) array
        Fisher information about the right perturbations of X and Z.
    whitening : (N, 6, 6) array
        Matrices that make the errors of each stop independent, with unit variance.
    weights : (N,) array
        Weight of each stop by Student's t distribution.
    """

    T_parent_child: FloatArray
    T_world_world: FloatArray
    information: FloatArray
    whitening: FloatArray
    weights: FloatArray


def fit_components(
    stops: Stops,
    start: tuple[FloatArray, FloatArray],
    variances: FloatArray,
    weights: FloatArray,
    degrees: float,
    linearise: Linearise,
) -> ComponentsFit:
    """Fit X, Z and the variances of the sources of error.

    Parameters
    ----------
    stops : Stops
        Stops without the outliers.
    start : two (4, 4) arrays
        X and Z to start from.
    variances : (2,) array
        Variances per axis of positions (m^2) and rotations (rad^2), from a fit without sources.
    weights : (N,) array
        Weights of the stops, smaller for several stops at one place.
    degrees : float
        Degrees of freedom of the Student-t distribution.
    linearise : callable
        Function that returns errors and derivatives in the frame of the child.
    """
    X, Z = start
    sources = _covariances_of_sources(stops)
    prior = _prior_components(variances, len(sources))
    components = prior
    for _ in range(_MAX_ROUNDS):
        errors, jacobian = linearise(stops, X, Z)
        iteration = _iteration(
            components, sources, errors, jacobian, weights, degrees
        )
        step_X, step_Z = se3.exp(iteration.step.reshape(2, 6))
        X = X @ step_X
        Z = Z @ step_Z
        updated = _updated(
            components, prior, iteration.quadratic, iteration.expected
        )
        log_change = float(np.max(np.abs(np.log(updated / components))))
        components = updated
        if iteration.decrease < _SMALL_CHANGE**2 and log_change < _SMALL_CHANGE:
            break
    precisions = iteration.precisions
    whitening = np.swapaxes(np.linalg.cholesky(precisions), 1, 2)
    # Expected information of the Student-t likelihood: K. L. Lange, R. J. A. Little,
    # J. M. G. Taylor, *Robust statistical modeling using the t distribution*, JASA 84, 1989,
    # section 4.
    expected_weights = (degrees + 6.0) / (degrees + 8.0) * weights
    information = np.einsum(
        "n,nij,nik->jk", expected_weights, jacobian, precisions @ jacobian
    )
    return ComponentsFit(X, Z, information, whitening, iteration.student)


@dataclass(frozen=True)
class LinearFit:
    """Fit of P values that change the errors of stops linearly.

    Attributes
    ----------
    values : (P,) array
    covariance : (P, P) array
        Covariance of ``values``. Unobservable directions have large variances.
    weights : (N,) array
        Weight of each stop by Student's t distribution.
    """

    values: FloatArray
    covariance: FloatArray
    weights: FloatArray


def fit_linear(
    stops: Stops,
    errors: FloatArray,
    jacobian: FloatArray,
    variances: FloatArray,
    weights: FloatArray,
    degrees: float,
) -> LinearFit:
    """Fit P values and the variances of the sources of error.

    Parameters
    ----------
    stops : Stops
    errors, jacobian : (N, 6) and (N, 6, P) arrays
        Errors in the frame of the child for values of zero, and their derivatives.
    variances, weights, degrees
        See :func:`fit_components`.
    """
    sources = _covariances_of_sources(stops)
    prior = _prior_components(variances, len(sources))
    components = prior
    lengths = np.sqrt(
        np.einsum("nij,nij->j", jacobian, jacobian) + MIN_VARIANCE
    )
    columns = jacobian / lengths
    values = np.zeros(len(lengths))
    for _ in range(_MAX_LINEAR_ROUNDS):
        remaining = errors + columns @ values
        iteration = _iteration(
            components, sources, remaining, columns, weights, degrees
        )
        values = values + iteration.step
        updated = _updated(
            components, prior, iteration.quadratic, iteration.expected
        )
        log_change = float(np.max(np.abs(np.log(updated / components))))
        components = updated
        if (
            iteration.decrease < _SMALL_LINEAR_STEP**2
            and log_change < _SMALL_LOG_CHANGE
        ):
            break
    shares = (degrees + 6.0) / (degrees + 8.0) * weights
    by_values = iteration.precisions @ columns
    information = np.einsum("n,nij,nik->jk", shares, columns, by_values)
    damping = 1e-10 * np.trace(information) * np.eye(len(values))
    covariance = np.linalg.inv(information + damping) / np.outer(
        lengths, lengths
    )
    covariance = np.asarray(covariance, dtype=float)
    return LinearFit(values / lengths, covariance, iteration.student)


@dataclass(frozen=True)
class _Iteration:
    """Step of the P values, and the terms that update the variances of the K sources.

    Attributes
    ----------
    precisions : (N, 6, 6) array
        Inverse covariances of the errors of each stop.
    student : (N,) array
        Weights by Student's t distribution.
    step : (P,) array
        Gauss-Newton step of the values: X and Z, and further values.
    decrease : float
        Predicted decrease of the objective, times two.
    quadratic : (K,) array
        Weighted squares of the errors from each source.
    expected : (K,) array
        Expected value of ``quadratic`` for the present variances.
    """

    precisions: FloatArray
    student: FloatArray
    step: FloatArray
    decrease: float
    quadratic: FloatArray
    expected: FloatArray


def _iteration(
    components: FloatArray,
    sources: FloatArray,
    errors: FloatArray,
    jacobian: FloatArray,
    weights: FloatArray,
    degrees: float,
) -> _Iteration:
    """Return one iteration at errors (N, 6) and their derivatives (N, 6, P).

    ``components`` (K,) are the variances of the sources. ``sources`` (K, N, 6, 6) are their
    covariances for a variance of 1.
    """
    covariances = np.tensordot(components, sources, 1) + MIN_VARIANCE * np.eye(
        6
    )
    precisions = np.asarray(np.linalg.inv(covariances), dtype=float)
    scores = np.einsum("nij,nj->ni", precisions, errors)
    distances = np.einsum("ni,ni->n", errors, scores)
    student = student_weights(distances, degrees)
    shares = weights * student
    by_values = precisions @ jacobian
    normal = np.einsum("n,nij,nik->jk", shares, jacobian, by_values)
    gradient = np.einsum("n,nij,ni->j", shares, by_values, errors)
    # Unobservable directions get a step of zero.
    damped = normal + 1e-13 * np.trace(normal) * np.eye(len(normal))
    step = -np.linalg.solve(damped, gradient)
    quadratic = np.einsum("n,ni,knij,nj->k", shares, scores, sources, scores)
    fitted = np.linalg.solve(damped, np.swapaxes(by_values, 1, 2))
    projected = precisions - shares[:, None, None] * (by_values @ fitted)
    expected = np.einsum("nij,knji->k", projected, sources)
    return _Iteration(
        precisions, student, step, -step @ gradient, quadratic, expected
    )


def _updated(
    components: FloatArray,
    prior: FloatArray,
    quadratic: FloatArray,
    expected: FloatArray,
) -> FloatArray:
    """Return the variances (K,) after an iteration of the MM algorithm with the prior."""
    # Twice the derivative of the prior's log density.
    pull = 2.0 * np.log(prior / components) / _PRIOR_SIGMA**2
    upwards = np.maximum(pull, 0.0)
    downwards = np.maximum(-pull, 0.0)
    numerator = components**2 * quadratic + upwards * components
    # Rounding can make a zero slightly negative.
    not_negative = np.maximum(expected, 0.0)
    denominator = not_negative + downwards / components
    # A source without effect keeps its variance, such as the line of sight if all positions are
    # zero.
    squared = np.divide(
        numerator, denominator, out=components**2, where=denominator > 0.0
    )
    return np.maximum(np.sqrt(squared), MIN_VARIANCE)


def _prior_components(variances: FloatArray, n_sources: int) -> FloatArray:
    """Return the prior means (K,) of the variances of all sources.

    ``variances`` (2,) are the variances of positions and rotations. The first two sources are
    positions, the others rotations.
    """
    n_rotations = n_sources - _N_POSITION_SOURCES
    return 0.5 * np.repeat(variances, [_N_POSITION_SOURCES, n_rotations])


def _covariances_of_sources(stops: Stops) -> FloatArray:
    """Return the covariances (K, N, 6, 6) of the errors from each source, for a variance of 1."""
    n = len(stops)
    to_world = se3.translation_of(se3.inverse(stops.Ts_world_child))
    lengths = np.linalg.norm(to_world, axis=1, keepdims=True)
    sight = to_world / np.maximum(lengths, np.sqrt(MIN_VARIANCE))
    along = sight[:, :, None] * sight[:, None, :]
    across = np.eye(3) - along
    covariances = np.zeros((4, n, 6, 6))
    covariances[0, :, :3, :3] = across
    covariances[1, :, :3, :3] = along
    covariances[2, :, 3:, 3:] = np.eye(3)
    covariances[3] = _about_world(
        np.broadcast_to(np.eye(3), (n, 3, 3)), to_world
    )
    if not stops.has_target:
        return covariances
    variances = (
        usual_sine(stops) ** 2 / sines_of_views(stops.Ts_world_child) ** 2
    )
    tilts = _about_world(variances[:, None, None] * across, to_world)
    return np.concatenate([covariances, tilts[None]])


def _about_world(rotations: FloatArray, to_world: FloatArray) -> FloatArray:
    """Return covariances (N, 6, 6) of errors from rotations about the origin of the child's world.

    ``rotations`` (N, 3, 3) are the covariances of the rotations, and ``to_world`` (N, 3) the
    positions of this origin, both in the frame of the child.
    """
    levers = se3.skew(to_world)
    covariances = np.empty((len(rotations), 6, 6))
    covariances[:, :3, :3] = levers @ rotations @ np.swapaxes(levers, 1, 2)
    covariances[:, :3, 3:] = levers @ rotations
    covariances[:, 3:, :3] = rotations @ np.swapaxes(levers, 1, 2)
    covariances[:, 3:, 3:] = rotations
    return covariances
