"""Robust least squares on motion pairs, without a noise model.

Model: the residual of a motion pair (motion A_i of the parent, motion B_i of the child) is

    e_i(X) = (translation, rotation vector) of B_i^-1 X^-1 A_i X.

Residuals have heavy tails. All translations have one unknown standard deviation, and all rotations
have another one; medians of the residuals estimate both. X minimises the sum of Cauchy costs of
translations and rotations. Overlapping motions are not independent, so the covariance is computed
from sums over neighbouring pairs: W. K. Newey, K. D. West, *A simple, positive semi-definite,
heteroskedasticity and autocorrelation consistent covariance matrix*, Econometrica 55, 1987.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import MEDIAN_NORMAL, median, robust_weights
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, motion_pairs
from hand_eye_calib.core.solvers.all_pairs import (
    RANK_TOLERANCE,
    Solution,
    align_rotation_vectors,
    translation_equations,
)

# A residual of this number of standard deviations has half of the full Cauchy weight: 95 %
# efficiency for normal errors (Holland and Welsch 1977, table 1).
_CAUCHY_UNIT = 2.385

# Largest number of Gauss-Newton steps.
_MAX_STEPS = 100
# After this number of steps, the standard deviations of the residuals stay fixed: medians may
# alternate between two residuals.
_FREE_SCALE_STEPS = 50

# By default, the iteration ends if a step is shorter than this, in standard deviations of X.
_STEP_TOLERANCE = 1e-5

# Number of start angles about the common axis of all motions. On flat ground, rotations do not
# determine this angle.
_N_STARTS = 12

# Lower bound of the standard deviation of residuals (m, rad), for exact data.
_MIN_SCALE = 1e-8

# Assumed correlation time of errors, as a share of the recording.
_CORRELATED_SHARE = 1.0 / 20.0
# Smallest assumed correlation time, in motions. Overlapping motions have common errors.
_CORRELATED_MOTIONS = 2

# Strides that are tried. A stride is the number of poses between the start and the end of a motion.
_STRIDES = (1, 2, 5, 10, 20, 50)

# Number of motions that start within one stride. Further motions would overlap by more than four
# fifths, and add little information.
_MOTIONS_PER_STRIDE = 5

# Largest number of motions per stride. Further motions take time, and hardly change the covariance.
_MAX_MOTIONS = 2000

# A stride above 1 is skipped if less than this number of successive motions fits into the
# recording.
_MIN_MOTIONS = 10


@dataclass(frozen=True)
class RobustSolution(Solution):
    """Solution with its covariance.

    Attributes
    ----------
    cov_parent_child_in_child : (6, 6) array
        Covariance of xi = (rho in m, phi in rad) in ``X Exp(xi)``; zero along directions without
        information.
    unseen : (6, k) array
        Unit vectors of xi along which the motions have no information.
    """

    cov_parent_child_in_child: FloatArray
    unseen: FloatArray


def solve(
    pairs: MotionPairs,
    T_start: FloatArray | None = None,
    tolerance: float = _STEP_TOLERANCE,
) -> RobustSolution:
    """Solve A X = X B for K >= 1 pairs.

    Parameters
    ----------
    pairs : MotionPairs
    T_start : (4, 4) array, optional
        Transform near the solution. By default it is computed from the pairs.
    tolerance : float
        The iteration ends if a step is shorter than this, in standard deviations of X.

    Returns
    -------
    RobustSolution
        ``objective`` is the sum of the Cauchy costs of translations and rotations, in units of
        their standard deviations. ``weights`` has the smaller of both weights of each pair.
    """
    T_parent_child = _start(pairs) if T_start is None else T_start
    scales = np.full(2, _MIN_SCALE)
    converged = False
    for step_number in range(_MAX_STEPS):
        components = _components(pairs, T_parent_child)
        if step_number < _FREE_SCALE_STEPS:
            scales = _scales(components)
        hessian, scores = _normal_equations(
            components, scales, _weights(components, scales)
        )
        step = -_inverse(hessian) @ scores.sum(axis=(0, 1))
        T_parent_child = se3.retracted(T_parent_child, step)
        if step @ hessian @ step < tolerance**2:
            converged = True
            break
    components = _components(pairs, T_parent_child)
    weights = _weights(components, scales)
    hessian, scores = _normal_equations(components, scales, weights)
    return RobustSolution(
        T_parent_child=T_parent_child,
        objective=float(np.log(1.0 / weights).sum()),
        converged=converged,
        weights=weights.min(axis=0),
        cov_parent_child_in_child=_covariance(hessian, scores, pairs),
        unseen=_null_space(hessian),
    )


class Stride(NamedTuple):
    """Motions over a fixed number of poses, and their solution.

    Attributes
    ----------
    reference : str
        Reference of the motions: "B5" for motions over five poses.
    pairs : MotionPairs
        Motion pairs of the reference. If neighbours overlap much, or if there are many pairs, only
        every k-th pair.
    solution : RobustSolution
    """

    reference: str
    pairs: MotionPairs
    solution: RobustSolution


def solve_strides(
    Ts_pw_p: FloatArray,
    Ts_cw_c: FloatArray,
    T_start: FloatArray | None = None,
    tolerance: float = _STEP_TOLERANCE,
) -> list[Stride]:
    """Solve the motions of each stride (number of poses) separately.

    Parameters
    ----------
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Synchronised poses of both sensors, in order of time.
    T_start : (4, 4) array, optional
    tolerance : float
        See :func:`solve`.

    Returns
    -------
    list of Stride
        Stride 1, and all longer strides for which the recording is long enough.
    """
    strides = []
    for n_poses in _STRIDES:
        if n_poses == 1 or _MIN_MOTIONS * n_poses < len(Ts_pw_p):
            reference = f"B{n_poses}"
            every_by_overlap = n_poses // _MOTIONS_PER_STRIDE
            n_motions = len(Ts_pw_p) - n_poses
            every_by_number = math.ceil(n_motions / _MAX_MOTIONS)
            every = max(every_by_overlap, every_by_number, 1)
            pairs = motion_pairs(Ts_pw_p, Ts_cw_c, reference, every)
            strides.append(
                Stride(reference, pairs, solve(pairs, T_start, tolerance))
            )
    return strides


def solve_best_stride(Ts_pw_p: FloatArray, Ts_cw_c: FloatArray) -> Stride:
    """Return the stride with the smallest covariance, see :func:`solve_strides`."""
    strides = solve_strides(Ts_pw_p, Ts_cw_c)
    return min(strides, key=lambda stride: _log_volume(stride.solution))


@dataclass(frozen=True)
class _Component:
    """Translations or rotations of K residuals: residuals (K, 3) and Jacobians (K, 3, 6)."""

    residuals: FloatArray
    jacobians: FloatArray


def _components(
    pairs: MotionPairs, T_parent_child: FloatArray
) -> tuple[_Component, _Component]:
    """Return residuals and their derivatives with respect to xi in ``X Exp(xi)``.

    The first component has the translations (m), the second the rotation vectors (rad).
    """
    # Motion X^-1 A X of the child, predicted from the parent's motion. A single product of
    # two-dimensional matrices is faster than many small products.
    moved = (pairs.Ts_parenti_parentj.reshape(-1, 4) @ T_parent_child).reshape(
        -1, 4, 4
    )
    predicted = se3.inverse(T_parent_child) @ moved
    errors = se3.inverse(pairs.Ts_childi_childj) @ predicted
    # For a predicted motion Y, Exp(-xi) Y Exp(xi) = Y Exp(xi - Ad(Y^-1) xi) to first order. The
    # errors are near the identity, so the Jacobians neglect their rotation.
    jacobians = np.eye(6) - se3.adjoint(se3.inverse(predicted))
    rotation_vectors = se3.rotation_log(se3.rotation_of(errors))
    translation = _Component(se3.translation_of(errors), jacobians[:, :3])
    rotation = _Component(rotation_vectors, jacobians[:, 3:])
    return translation, rotation


def _scales(components: tuple[_Component, _Component]) -> FloatArray:
    """Return the standard deviations (2,) of both components, from medians of residuals."""
    medians = [
        median(np.abs(component.residuals).ravel()) for component in components
    ]
    sigmas = np.array(medians) / MEDIAN_NORMAL
    return np.maximum(sigmas, _MIN_SCALE)


def _weights(
    components: tuple[_Component, _Component], scales: FloatArray
) -> FloatArray:
    """Return the Cauchy weights (2, K) of translations and of rotations."""
    squared = []
    for component, scale in zip(components, scales, strict=True):
        mean_squares = (component.residuals**2).sum(axis=1) / 3.0
        squared.append(mean_squares / (_CAUCHY_UNIT * scale) ** 2)
    return robust_weights("cauchy", np.array(squared))


def _normal_equations(
    components: tuple[_Component, _Component],
    scales: FloatArray,
    weights: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the weighted Hessian (6, 6), and the scores (2, K, 6).

    A score is the derivative, with respect to xi, of the cost of one translation or rotation.
    """
    hessian = np.zeros((6, 6))
    scores = []
    for component, scale, component_weights in zip(
        components, scales, weights, strict=True
    ):
        jacobians = component.jacobians / scale
        weighted = jacobians * component_weights[:, None, None]
        hessian += weighted.reshape(-1, 6).T @ jacobians.reshape(-1, 6)
        residuals = component.residuals[:, None] / scale
        scores.append((residuals @ weighted)[:, 0])
    return hessian, np.stack(scores)


def _covariance(
    hessian: FloatArray, scores: FloatArray, pairs: MotionPairs
) -> FloatArray:
    """Return the covariance (6, 6) from the weighted Hessian and the scores (2, K, 6) of pairs.

    The covariance includes errors that are correlated over a share of the recording.
    """
    # The weight of a pair decreases with its residual. The weighted Hessian lacks this term of the
    # second derivative.
    curvature = (
        2.0 / 3.0 / _CAUCHY_UNIT**2 * np.einsum("pki,pkj->ij", scores, scores)
    )
    n_poses = int(pairs.j.max() - pairs.i.min())
    motion = median(pairs.j - pairs.i)
    # Correlation time in poses, then in pairs.
    n_correlated_poses = max(
        _CORRELATED_SHARE * n_poses, _CORRELATED_MOTIONS * motion
    )
    window = round(n_correlated_poses * len(pairs) / n_poses)
    window = min(max(window, 1), len(pairs) // 2 + 1)
    # Residuals are smaller than errors, because the six unknowns fit a part of the errors. For n
    # motions without overlap, the factor n / (n - 6) corrects this.
    n_motions = n_poses / motion
    n_free = max(n_motions - 6.0, 1.0)
    covariance = _sandwich(hessian - curvature, scores.sum(axis=0), window)
    return n_motions / n_free * covariance


def _sandwich(
    hessian: FloatArray, scores: FloatArray, window: int
) -> FloatArray:
    """Return the covariance (6, 6) from sums of scores (K, 6) over windows of consecutive pairs."""
    total = np.cumsum(np.vstack([np.zeros(6), scores]), axis=0)
    sums = total[window:] - total[:-window]
    scatter = len(scores) / window / len(sums) * sums.T @ sums
    inverse = _inverse(hessian)
    return inverse @ scatter @ inverse


def _inverse(hessian: FloatArray) -> FloatArray:
    """Return the pseudo-inverse (6, 6) of a Hessian.

    The rank is determined after translation and rotation were scaled to equal size: they may differ
    by many powers of ten.
    """
    units = _units(hessian)
    balanced = np.linalg.pinv(
        hessian / units / units[:, None], RANK_TOLERANCE, hermitian=True
    )
    return balanced / units / units[:, None]


def _null_space(hessian: FloatArray) -> FloatArray:
    """Return unit vectors (6, k) of the k directions without information."""
    units = _units(hessian)
    values, vectors = np.linalg.eigh(hessian / units / units[:, None])
    is_unknown = values <= RANK_TOLERANCE * values[-1]
    directions = vectors[:, is_unknown] / units[:, None]
    return directions / np.linalg.norm(directions, axis=0)


def _units(hessian: FloatArray) -> FloatArray:
    """Return the scales (6,) of translation and of rotation in a Hessian (6, 6).

    A scale is the square root of the largest diagonal element of the translation or of the
    rotation; 1 if this element is zero.
    """
    largest = np.diag(hessian).reshape(2, 3).max(axis=1)
    roots = np.sqrt(largest)
    units = np.where(roots > 0.0, roots, 1.0)
    return np.repeat(units, 3)


def _log_volume(solution: RobustSolution) -> float:
    """Return the log determinant of the covariance; infinite if a direction has no information."""
    if solution.unseen.shape[1]:
        return np.inf
    return float(np.linalg.slogdet(solution.cov_parent_child_in_child)[1])


# ------------------------------------------------------------------ start


def _start(pairs: MotionPairs) -> FloatArray:
    """Return a transform (4, 4) near the solution.

    The rotation aligns the rotation vectors of both sensors. If all motions rotate about one axis,
    the angle about this axis is unknown. Several angles are then tried, with their least squares
    translations.
    """
    vectors_parent = se3.rotation_log(se3.rotation_of(pairs.Ts_parenti_parentj))
    vectors_child = se3.rotation_log(se3.rotation_of(pairs.Ts_childi_childj))
    # For any X, both motions of a pair rotate by the same angle. Pairs with different angles get
    # small weights.
    differences = np.linalg.norm(vectors_parent, axis=1) - np.linalg.norm(
        vectors_child, axis=1
    )
    unit = max(1.5 * median(np.abs(differences)), _MIN_SCALE)
    weights = robust_weights("cauchy", (differences / unit) ** 2)
    aligned = align_rotation_vectors(pairs, weights)
    common_axis = np.linalg.svd(vectors_parent, full_matrices=False)[2][0]
    angle_rad = max(_median_length(vectors_parent), _MIN_SCALE)
    starts = []
    misfits_m = []
    for turn in np.arange(_N_STARTS) * 2.0 * np.pi / _N_STARTS:
        rotation = se3.rotation_exp(turn * common_axis) @ aligned
        slopes, targets = translation_equations(pairs, rotation)
        translation = _weighted_translation(slopes, targets, weights)
        misfit_m = _median_length(slopes @ translation - targets)
        misfit_rad = _median_length(vectors_parent - vectors_child @ rotation.T)
        starts.append(se3.from_rotation_translation(rotation, translation))
        # Convert the misfit of the rotation to m: its share of the rotation, times the median
        # translation.
        misfits_m.append(
            misfit_m + misfit_rad / angle_rad * _median_length(targets)
        )
    return starts[int(np.argmin(misfits_m))]


def _weighted_translation(
    slopes: FloatArray, targets: FloatArray, weights: FloatArray
) -> FloatArray:
    """Solve ``slopes @ t = targets`` by least squares.

    Parameters
    ----------
    slopes : (K, 3, 3) array
    targets : (K, 3) array
    weights : (K,) array
        Factors of the equations of each pair.
    """
    weighted_slopes = (weights[:, None, None] * slopes).reshape(-1, 3)
    weighted_targets = (weights[:, None] * targets).ravel()
    translation, *_ = np.linalg.lstsq(
        weighted_slopes, weighted_targets, rcond=1e-9
    )
    return np.asarray(translation, dtype=float)


def _median_length(vectors: FloatArray) -> float:
    """Return the median length of vectors (K, 3)."""
    return median(np.linalg.norm(vectors, axis=1))
