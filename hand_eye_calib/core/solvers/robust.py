"""Robust least squares on motion pairs, without a noise model.

Model: of motions A_i of the parent and B_i of the child,

    e_i(X) = Log(B_i^-1 X^-1 A_i X) = (translation, rotation)

has heavy tails and one unknown scale for all translations and one for all rotations. X minimises
the sum of Cauchy costs of both parts. Scales come from the median of the residuals. Pairs that
overlap are not independent, so that the covariance comes from sums over neighbouring pairs:
W. K. Newey, K. D. West, *A simple, positive semi-definite, heteroskedasticity and autocorrelation
consistent covariance matrix*, Econometrica 55, 1987.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import MEDIAN_NORMAL, median, robust_weights
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, motion_pairs
from hand_eye_calib.core.solvers.all_pairs import (
    Solution,
    align_rotation_vectors,
    translation_equations,
)

# Residual, in standard deviations, at which a Cauchy weight is a half: 95 % efficiency for normal
# errors (Holland and Welsch 1977, table 1).
_CAUCHY_UNIT = 2.385

# Steps at most, and steps after which the scales of the residuals stay as they are: the median may
# jump to and fro between two residuals.
_MAX_STEPS = 100
_FREE_SCALE_STEPS = 50

# A step below this share of a standard deviation of the answer usually ends the iteration.
_STEP_TOLERANCE = 1e-5

# Rotations about the common axis of all motions that are tried as starts: flat ground leaves that
# angle open to the rotations alone.
_N_STARTS = 12

# Singular values below this share of the largest are rounding.
_RANK_TOLERANCE = 1e-12

# Smallest scale of residuals (m, rad): that of exact data is rounding.
_MIN_SCALE = 1e-8

# Errors are taken to last for this share of the recording at most, and motions that overlap for two
# motions at least.
_LASTING_SHARE = 1.0 / 20.0
_LASTING_MOTIONS = 2

# Poses between both ends of a motion: the candidates.
_STRIDES = (1, 2, 5, 10, 20, 50)

# Motions that begin at neighbouring poses and overlap by more than four fifths say nearly the same.
_MOTIONS_PER_STRIDE = 5

# Most motions of one stride: more take time, and hardly change the covariance.
_MOST_MOTIONS = 2000

# Fewest motions that do not overlap, for strides above 1.
_MIN_MOTIONS = 10


@dataclass(frozen=True)
class RobustSolution(Solution):
    """Solution with its covariance.

    Attributes
    ----------
    cov_parent_child_in_child : (6, 6) array
        Covariance of xi in ``X Exp(xi)``, m before rad; zero along directions without evidence.
    unseen : (6, k) array
        Directions of xi without evidence.
    """

    cov_parent_child_in_child: FloatArray
    unseen: FloatArray


def solve(
    pairs: MotionPairs, T_start: FloatArray | None = None, tolerance: float = _STEP_TOLERANCE
) -> RobustSolution:
    """Solve A X = X B for K >= 1 pairs, from a start (4, 4) if one is given.

    A step below a tolerance, in standard deviations of the answer, ends the iteration.
    ``objective`` is the sum of the Cauchy costs of both parts, in units of their scales.
    """
    T_parent_child = _start(pairs) if T_start is None else T_start
    scales = np.full(2, _MIN_SCALE)
    converged = False
    for step_number in range(_MAX_STEPS):
        parts = _parts(pairs, T_parent_child)
        if step_number < _FREE_SCALE_STEPS:
            scales = _scales(parts)
        hessian, scores = _normal_equations(parts, scales, _weights(parts, scales))
        step = -_inverse(hessian) @ scores.sum(axis=(0, 1))
        T_parent_child = se3.retracted(T_parent_child, step)
        if step @ hessian @ step < tolerance**2:
            converged = True
            break
    parts = _parts(pairs, T_parent_child)
    weights = _weights(parts, scales)
    hessian, scores = _normal_equations(parts, scales, weights)
    return RobustSolution(
        T_parent_child=T_parent_child,
        objective=float(np.log(1.0 / weights).sum()),
        converged=converged,
        weights=weights.min(axis=0),
        cov_parent_child_in_child=_covariance(hessian, scores, pairs),
        unseen=_null_space(hessian),
    )


class Stride(NamedTuple):
    """Motions over one number of poses, and their solution.

    Attributes
    ----------
    reference : str
    pairs : MotionPairs
        Pairs of the reference; some of them if neighbours overlap a lot, or if there are many.
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
    """Solve with motions over several numbers of poses, each by itself.

    Parameters
    ----------
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Synchronised poses of both sensors, in order of time.
    T_start : (4, 4) array, optional
    tolerance : float
        As for :func:`solve`.
    """
    strides = []
    for n_poses in _STRIDES:
        if n_poses == 1 or _MIN_MOTIONS * n_poses < len(Ts_pw_p):
            reference = f"B{n_poses}"
            pairs = motion_pairs(Ts_pw_p, Ts_cw_c, reference)
            every = max(n_poses // _MOTIONS_PER_STRIDE, -(-len(pairs) // _MOST_MOTIONS), 1)
            pairs = pairs[::every]
            strides.append(Stride(reference, pairs, solve(pairs, T_start, tolerance)))
    return strides


def solve_best_stride(Ts_pw_p: FloatArray, Ts_cw_c: FloatArray) -> Stride:
    """Return the stride with the smallest covariance, see :func:`solve_strides`."""
    strides = solve_strides(Ts_pw_p, Ts_cw_c)
    return min(strides, key=lambda stride: _log_volume(stride.solution))


@dataclass(frozen=True)
class _Part:
    """Residuals (K, 3) of translation or rotation, and their Jacobians (K, 3, 6)."""

    residuals: FloatArray
    jacobians: FloatArray


def _parts(pairs: MotionPairs, T_parent_child: FloatArray) -> tuple[_Part, _Part]:
    """Linearise the residuals at ``X Exp(xi)``."""
    # The child's motion as the parent's motion predicts it: X^-1 A X.
    predicted = se3.inverse(T_parent_child) @ pairs.Ts_parenti_parentj @ T_parent_child
    errors = se3.inverse(pairs.Ts_childi_childj) @ predicted
    # Exp(-xi) Y Exp(xi) = Y Exp(xi - Ad(Y^-1) xi) to first order.
    jacobians = np.eye(6) - se3.adjoint(se3.inverse(predicted))
    rotation = se3.rotation_log(se3.rotation_of(errors))
    return _Part(se3.translation_of(errors), jacobians[:, :3]), _Part(rotation, jacobians[:, 3:])


def _scales(parts: tuple[_Part, _Part]) -> FloatArray:
    """Standard deviations (2,) of the residuals of each part, by their median."""
    medians = [median(np.abs(part.residuals).ravel()) for part in parts]
    return np.maximum(np.array(medians) / MEDIAN_NORMAL, _MIN_SCALE)


def _weights(parts: tuple[_Part, _Part], scales: FloatArray) -> FloatArray:
    """Cauchy weights (2, K) of translations and rotations."""
    squared = []
    for part, scale in zip(parts, scales, strict=True):
        squared.append((part.residuals**2).sum(axis=1) / 3.0 / (_CAUCHY_UNIT * scale) ** 2)
    return robust_weights("cauchy", np.array(squared))


def _normal_equations(
    parts: tuple[_Part, _Part], scales: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the weighted Hessian (6, 6), and the scores (2, K, 6) of both parts of the pairs."""
    hessian = np.zeros((6, 6))
    scores = []
    for part, scale, part_weights in zip(parts, scales, weights, strict=True):
        jacobians = part.jacobians / scale
        weighted = jacobians * part_weights[:, None, None]
        hessian += np.einsum("kij,kil->jl", weighted, jacobians)
        scores.append(np.einsum("kij,ki->kj", weighted, part.residuals / scale))
    return hessian, np.stack(scores)


def _covariance(hessian: FloatArray, scores: FloatArray, pairs: MotionPairs) -> FloatArray:
    """Covariance (6, 6) from the weighted Hessian (6, 6) and the scores (2, K, 6) of the pairs."""
    # The weights fall with the residuals, which makes the cost flatter.
    curvature = 2.0 / 3.0 / _CAUCHY_UNIT**2 * np.einsum("pki,pkj->ij", scores, scores)
    n_poses = int(pairs.j[-1] - pairs.i[0])
    motion = median(pairs.j - pairs.i)
    lasting = max(_LASTING_SHARE * n_poses, _LASTING_MOTIONS * motion)
    window = min(max(round(lasting * len(pairs) / n_poses), 1), len(pairs) // 2 + 1)
    # The residuals are smaller than the errors, as six unknowns follow the errors.
    n_motions = n_poses / motion
    n_free = max(n_motions - 6.0, 1.0)
    return n_motions / n_free * _sandwich(hessian - curvature, scores.sum(axis=0), window)


def _sandwich(hessian: FloatArray, scores: FloatArray, window: int) -> FloatArray:
    """Covariance (6, 6) by the scatter of the sums of scores (K, 6) over all windows of pairs."""
    total = np.cumsum(np.vstack([np.zeros(6), scores]), axis=0)
    sums = total[window:] - total[:-window]
    scatter = len(scores) / window / len(sums) * sums.T @ sums
    inverse = _inverse(hessian)
    return np.asarray(inverse @ scatter @ inverse)


def _inverse(hessian: FloatArray) -> FloatArray:
    """Pseudo-inverse (6, 6). Its rank is judged in units of each part: their scales may differ by
    many powers of ten.
    """
    units = _units(hessian)
    balanced = np.linalg.pinv(hessian / units / units[:, None], _RANK_TOLERANCE, hermitian=True)
    return np.asarray(balanced / units / units[:, None])


def _null_space(hessian: FloatArray) -> FloatArray:
    """Directions (6, k) without evidence, of length 1."""
    units = _units(hessian)
    values, vectors = np.linalg.eigh(hessian / units / units[:, None])
    directions = vectors[:, values <= _RANK_TOLERANCE * values[-1]] / units[:, None]
    return np.asarray(directions / np.linalg.norm(directions, axis=0))


def _units(hessian: FloatArray) -> FloatArray:
    """Root (6,) of the largest diagonal element of each part; 1 where it is zero."""
    roots = np.sqrt(np.diag(hessian).reshape(2, 3).max(axis=1))
    return np.repeat(np.where(roots > 0.0, roots, 1.0), 3)


def _log_volume(solution: RobustSolution) -> float:
    """Logarithm of the determinant of the covariance; infinite if a direction has no evidence."""
    if solution.unseen.shape[1]:
        return np.inf
    return float(np.linalg.slogdet(solution.cov_parent_child_in_child)[1])


# ------------------------------------------------------------------ start


def _start(pairs: MotionPairs) -> FloatArray:
    """Return a transform (4, 4) near the solution.

    The rotation aligns the rotation vectors of both sensors. Motions about one axis leave the angle
    about that axis open. So several angles are tried, each with the translation by least squares.
    """
    vectors_parent = se3.rotation_log(se3.rotation_of(pairs.Ts_parenti_parentj))
    vectors_child = se3.rotation_log(se3.rotation_of(pairs.Ts_childi_childj))
    # Angles of both motions are equal, whatever X is.
    differences = np.linalg.norm(vectors_parent, axis=1) - np.linalg.norm(vectors_child, axis=1)
    unit = max(1.5 * median(np.abs(differences)), _MIN_SCALE)
    weights = robust_weights("cauchy", (differences / unit) ** 2)
    aligned = align_rotation_vectors(pairs, weights)
    common_axis = np.linalg.svd(vectors_parent, full_matrices=False)[2][0]
    turned = median(np.linalg.norm(vectors_parent, axis=1))
    candidates = []
    for angle in np.arange(_N_STARTS) * 2.0 * np.pi / _N_STARTS:
        rotation = se3.rotation_exp(angle * common_axis) @ aligned
        candidate, misfit_m, moved_m = _with_translation(pairs, rotation, weights)
        off = median(np.linalg.norm(vectors_parent - vectors_child @ rotation.T, axis=1))
        # Rotations count as much as translations, each as a share of the motion.
        misfit = misfit_m + off / max(turned, _MIN_SCALE) * moved_m
        candidates.append((misfit, candidate))
    return min(candidates, key=lambda candidate: candidate[0])[1]


def _with_translation(
    pairs: MotionPairs, rotation: FloatArray, weights: FloatArray
) -> tuple[FloatArray, float, float]:
    """Fit the translation to a rotation by weighted least squares.

    Returns the transform (4, 4), the median misfit (m), and the median length (m) that the
    translation has to explain.
    """
    slopes, targets = translation_equations(pairs, rotation)
    weighted_slopes = (weights[:, None, None] * slopes).reshape(-1, 3)
    weighted_targets = (weights[:, None] * targets).ravel()
    translation = np.linalg.lstsq(weighted_slopes, weighted_targets, rcond=1e-9)[0]
    misfit_m = median(np.linalg.norm(slopes @ translation - targets, axis=1))
    moved_m = median(np.linalg.norm(targets, axis=1))
    return se3.from_rotation_translation(rotation, translation), misfit_m, moved_m
