"""How far an answer may be from the truth: a 6 x 6 covariance and a verdict per degree of freedom.

Two estimates are made. In each direction the larger one holds:

- The model's. The adaptive estimator has its own; for other methods it is that of motion pairs with
  independent, equally large errors, propagated through the cost to first order.
- The delete-a-block jackknife: the spread of the answers without each tenth of the recording. It
  assumes no noise model and includes errors that last for many pairs, such as drift, which the
  model misses.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.assessment.excitation import (
    HIDDEN_SHARE,
    MIN_SHARE,
    ROUNDING_ANGLE,
    LeverArms,
    weighted_products,
)
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.extrinsic import sigmas_in_parent
from hand_eye_calib.gls.estimator import AdaptiveSolution, ModelSolution
from hand_eye_calib.gls.noise_model import WALK_ROTATION
from hand_eye_calib.gls.normal import NormalEquations, answers_without
from hand_eye_calib.pairing.motion_pairs import MotionPairs, PosePairs
from hand_eye_calib.results.records import AXES, ROTATIONS, DofObservability, DofVerdict
from hand_eye_calib.solvers.all_pairs import Solution
from hand_eye_calib.stats import CHI2

# (B, K) mask of the pairs to leave out to the answers (B, 4, 4) without them.
SolveWithout: TypeAlias = Callable[[BoolArray], FloatArray]

# Blocks of the jackknife; fewest of them, and of the pairs in each.
_BLOCKS, _FEWEST = 10, (4, 3)

# An unseen direction with at least this length in its rotation is not one of translation alone.
_SHARE_OF_ROTATION = 0.5

# Standard deviations that stand for "unknown" in the covariance: the distance between sensors on a
# large machine. An unknown direction is never exactly an axis of the parent sensor, so that part of
# its variance shows in the other axes; more than this would hide what is known of them. The
# verdicts say what is unknown.
UNKNOWN_SIGMAS = np.repeat([3.0, np.pi], 3)

# Smallest variance (m^2 or rad^2) to divide by: noise-free data has none.
ROUNDING_VARIANCE = 1e-24

# Information below this share of the largest is rounding.
_RANK_TOLERANCE = 1e-12

# Standard deviations (m, rad) above which an axis is weak, and above which it is unobservable: so
# little is known that nobody can use the value.
WEAK, UNOBSERVABLE = (0.05, float(np.radians(1.0))), 0.3


@dataclass(frozen=True)
class Assessment:
    """Covariance and verdicts of one answer.

    Attributes
    ----------
    cov_parent_child_in_child : (6, 6) array
        Covariance of xi = (rho, phi) in ``T_parent_child @ exp(xi)``: error in the child sensor's
        frame, m and rad.
    observability : tuple of DofObservability
        x, y, z, roll, pitch, yaw in the parent sensor's frame.
    """

    cov_parent_child_in_child: FloatArray
    observability: tuple[DofObservability, ...]


def assess(pairs: MotionPairs, solution: Solution, solve_without: SolveWithout) -> Assessment:
    """Covariance and observability of the solution of K motion pairs in order of time;
    ``solve_without(left_out)`` gives the answers (B, 4, 4) without the pairs in each row of
    ``left_out`` (B, K): blocks for a jackknife, if there are pairs enough.
    """
    T_parent_child, resampled = solution.T_parent_child, None
    model, unknown = model_covariance(pairs, solution)
    n_blocks = min(_BLOCKS, len(pairs) // _FEWEST[1])
    if n_blocks >= _FEWEST[0]:
        block_of_pair = np.arange(len(pairs)) * n_blocks // len(pairs)
        left_out = block_of_pair[None, :] == np.arange(n_blocks)[:, None]
        answers = solve_without(left_out)
        resampled = _spread_of_blocks(se3.log(se3.inverse(T_parent_child) @ answers))
    return combined(T_parent_child, model, resampled, unknown)


def assess_adaptive(pose_pairs: PosePairs, solution: AdaptiveSolution) -> Assessment:
    """Covariance and observability of an answer of the adaptive estimator for these poses."""
    covariance = _widened(solution.cov_parent_child_in_child, solution, slice(0, 6))
    hidden = noise_driven(
        pose_pairs.Ts_pw_p,
        solution.T_parent_child,
        solution.jumps,
        solution.rotation_variance,
        # Rotations below the noise of single poses cannot be told from none.
        # Otherwise they can, and the tilt of the axis is stated: half as much is enough.
        MIN_SHARE if solution.is_drowned else MIN_SHARE / 2,
    )
    unseen = basis([*solution.unseen.T, *hidden])
    return combined(solution.T_parent_child, covariance, None, unseen)


def assess_rotation(Ts_pw_p: FloatArray, solution: AdaptiveSolution) -> Assessment:
    """Covariance and observability of an answer of the adaptive estimator from rotations alone,
    with the parent's poses (N, 4, 4).

    The translation is unknown. So is a rotation about the only axis that the sensors rotate about:
    it is the axis along which they do not reveal a lever arm either.
    """
    part, unseen = slice(3, 6), solution.unseen[3:]
    whole = np.zeros((6, 6))
    whole[part, part] = _widened(solution.cov_parent_child_in_child[part, part], solution, part)
    lone_axes = noise_driven(
        Ts_pw_p, solution.T_parent_child, solution.jumps, solution.rotation_variance
    )
    hidden = [direction for direction in unseen.T if np.linalg.norm(direction) > _SHARE_OF_ROTATION]
    hidden += [axis[:3] for axis in lone_axes]
    unknown = [*np.eye(6)[:3], *(np.r_[np.zeros(3), direction] for direction in hidden)]
    return combined(solution.T_parent_child, whole, None, basis(unknown))


def assess_lever_arm(Ts: FloatArray, solution: ModelSolution, covariance: FloatArray) -> Assessment:
    """Covariance and observability of a lever arm in the frame of a sensor with poses (N, 4, 4): of
    a transform with no rotation, which is unknown. ``covariance`` (3, 3) is that of the model.
    """
    whole = np.zeros((6, 6))
    whole[:3, :3] = _widened(covariance, solution, slice(0, 3))
    white, walk = _white_rotation(Ts), np.exp(solution.levels[WALK_ROTATION])
    hidden = noise_driven(
        Ts, np.eye(4), solution.jumps, lambda n: np.asarray(2.0 * white + n * walk)
    )
    return combined(np.eye(4), whole, None, basis([*np.eye(6)[3:], *hidden]))


def _white_rotation(Ts: FloatArray) -> float:
    """Variance (rad^2) per axis of the white rotation noise of poses: at most what differs
    from step to step about the two axes with the smoothest rotation.

    Nothing else shows it where positions alone are measured: noise of the orientation would look
    like a small motion that does not move the lever arm.
    """
    steps = se3.rotation_log(np.swapaxes(Ts[:-1, :3, :3], 1, 2) @ Ts[1:, :3, :3])
    # Differences of steps have six times the variance of white noise.
    variances = np.median(np.diff(steps, axis=0) ** 2, axis=0) / CHI2[0.5][1] / 6.0
    return float(np.sort(variances)[:2].mean())


def _widened(covariance: FloatArray, solution: ModelSolution, part: slice) -> FloatArray:
    """The model's covariance of a part of xi, widened by blocks and halves."""
    if len(solution.jumps) < _BLOCKS * _FEWEST[1]:
        return covariance
    steps = answers_without(solution.part_products, _BLOCKS)[:, part]
    spread = np.linalg.pinv(covariance, hermitian=True) @ _spread_of_blocks(steps)
    # One factor for all directions: that of a single direction scatters too much.
    covariance = max(float(np.trace(spread)) / len(covariance), 1.0) * covariance
    return widened_by_halves(covariance, solution.part_products, solution.misfit, part)


def noise_driven(
    Ts_pw_p: FloatArray,
    T_parent_child: FloatArray,
    jumps: BoolArray,
    rotation_variance: Callable[[int], FloatArray],
    least_share: float = MIN_SHARE,
) -> list[FloatArray]:
    """Directions (6,) of translation that the rotations do not reveal over any baseline.

    Each increment alone may be smaller than its noise; sums of increments decide: long ones if the
    noise is white, short ones if it drifts.

    Parameters
    ----------
    Ts_pw_p, T_parent_child : (N, 4, 4) array, (4, 4) array
    jumps : (N - 1,) bool array
        Increments that are no evidence.
    rotation_variance : callable
        Variance (rad^2) per axis of the rotation noise over so many increments.
    least_share : float
        See :meth:`~hand_eye_calib.assessment.excitation.LeverArms.hidden_directions`.
    """
    longest = max(len(Ts_pw_p) // _BLOCKS, 1)
    rotations, jumps_before = Ts_pw_p[:, :3, :3], np.concatenate([[0], np.cumsum(jumps)])
    found: list[FloatArray] = []
    for baseline in sorted({*np.geomspace(1, longest, 4).astype(int).tolist()}, reverse=True):
        motions = np.swapaxes(rotations[:-baseline], 1, 2) @ rotations[baseline:]
        # No baseline may run across a jump, unless all of them do.
        weights = (jumps_before[baseline:] == jumps_before[:-baseline]).astype(float)
        if not weights.any():
            weights[:] = 1.0
        lever_arms = LeverArms.of((motions - np.eye(3)) @ T_parent_child[:3, :3], weights)
        noise = rotation_variance(baseline) * np.eye(3)
        found.append(lever_arms.hidden_directions(noise, least_share).T)
    return [np.r_[direction, np.zeros(3)] for direction in min(found, key=len)]


def combined(
    T_parent_child: FloatArray,
    model: FloatArray,
    resampled: FloatArray | None,
    unknown: FloatArray,
) -> Assessment:
    """Covariance and verdicts from a model's covariance (6, 6) in the child's frame, that of
    resampling if there is one, and directions (6, U) that the motion does not reveal.
    """
    known, scaled = np.eye(6) - unknown @ unknown.T, UNKNOWN_SIGMAS[:, None] * unknown
    if resampled is not None:  # the larger one, direction by direction
        # In the coordinates where the model's is the identity, the eigenvalues are the ratios.
        variances, axes = np.linalg.eigh(model)
        root = axes * np.sqrt(np.maximum(variances, ROUNDING_VARIANCE))
        ratios, vectors = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, resampled).T))
        raised = root @ vectors
        model = (raised * np.maximum(ratios, 1.0)) @ raised.T
    covariance, rotation = known @ model @ known + scaled @ scaled.T, T_parent_child[:3, :3]
    sigmas = sigmas_in_parent(rotation, covariance)
    shares = ((np.kron(np.eye(2), rotation) @ unknown) ** 2).sum(axis=1)
    sigmas = np.where(shares > HIDDEN_SHARE, np.inf, sigmas)
    return Assessment(covariance, tuple(map(judged, AXES, sigmas.tolist())))


def without_axes(
    assessment: Assessment, T_parent_child: FloatArray, axes: Collection[str]
) -> Assessment:
    """An assessment that counts these axes of the parent's frame as unobservable."""
    # A direction that is unknown already is hardly ever an axis: both would hide a second one.
    known = {*axes}.difference(
        dof.name for dof in assessment.observability if dof.verdict is DofVerdict.UNOBSERVABLE
    )
    rows = [index for index, axis in enumerate(AXES) if axis in known]
    if not rows:
        return assessment
    to_parent = np.kron(np.eye(2), T_parent_child[:3, :3])
    unknown = np.asarray(to_parent[rows].T, dtype=float)
    found = combined(T_parent_child, assessment.cov_parent_child_in_child, None, unknown)
    observability = tuple(
        before if before.verdict is DofVerdict.UNOBSERVABLE else after
        for before, after in zip(assessment.observability, found.observability, strict=True)
    )
    return Assessment(found.cov_parent_child_in_child, observability)


def model_covariance(pairs: MotionPairs, solution: Solution) -> tuple[FloatArray, FloatArray]:
    """Covariance for independent, equally large errors of the pairs.

    The cost is ``|r_t|^2 + 2 |r_R|^2`` with the residual translation r_t and the residual rotation
    vector r_R. With their Jacobians J_t, J_R and the variances s_t^2, s_R^2 of the residuals, an
    estimate that minimises the weighted sum has covariance ``H^-1 (s_t^2 J_t'J_t + 4 s_R^2 J_R'J_R)
    H^-1``, ``H = J_t'J_t + 2 J_R'J_R``: (6, 6), zero along directions without information. Second
    is an orthonormal basis (6, U) of the directions that the motion does not reveal.
    """
    weights = solution.weights
    n_effective = max(float(weights.sum()) - 3.0, 1.0)
    residual_t, residual_r = pairs.residuals(solution.T_parent_child)
    variance_t = (weights @ (residual_t**2).sum(axis=1)) / (3 * n_effective)
    cov_r = (weights[:, None] * residual_r).T @ residual_r / n_effective
    variance_r = np.trace(cov_r) / 3

    rotation = solution.T_parent_child[:3, :3]
    rotation_a, rotation_b = pairs.Ts_parenti_parentj[:, :3, :3], pairs.Ts_childi_childj[:, :3, :3]
    translation_b, moved = pairs.Ts_childi_childj[:, :3, 3], rotation_a - np.eye(3)
    jacobian_t = np.concatenate([moved @ rotation, rotation @ se3.skew(translation_b)], axis=2)
    information_t = weighted_products(weights, jacobian_t)
    jacobian_r = np.swapaxes(rotation_b, 1, 2) - np.eye(3)
    information_r = np.zeros((6, 6))
    information_r[3:, 3:] = weighted_products(weights, jacobian_r)

    hessian = information_t + 2 * information_r
    values, vectors = np.linalg.eigh(hessian)
    seen = values > max(_RANK_TOLERANCE * values[-1], weights.sum() * ROUNDING_ANGLE**2)
    inverse = (vectors * np.where(seen, 1.0 / np.where(seen, values, 1.0), 0.0)) @ vectors.T
    covariance = inverse @ (variance_t * information_t + 4 * variance_r * information_r) @ inverse

    hidden = LeverArms.of(moved @ rotation, weights).hidden_directions(cov_r).T
    of_lever_arm = [np.r_[direction, np.zeros(3)] for direction in hidden]
    return covariance, basis([*of_lever_arm, *vectors[:, ~seen].T])


def basis(directions: list[FloatArray]) -> FloatArray:
    """Orthonormal basis (6, U) of directions (6,), which may be linearly dependent."""
    if not directions:
        return np.zeros((6, 0))
    left, sizes, _ = np.linalg.svd(np.array(directions).T, full_matrices=False)
    return left[:, sizes > 1e-6 * sizes[0]]


def _spread_of_blocks(deviations: FloatArray) -> FloatArray:
    """Jackknife covariance (6, 6) of the deviations (B, 6) of the B answers without a block:
    ``(B - 1) / B * sum (xi_b - mean)(xi_b - mean)'`` (Efron, Tibshirani, *An introduction to the
    bootstrap*, 1993, eq. 11.5).
    """
    n_blocks, centred = len(deviations), deviations - deviations.mean(axis=0)
    return (n_blocks - 1) / n_blocks * centred.T @ centred


def widened_by_halves(
    model: FloatArray, products: FloatArray, misfit: float, part: slice = slice(0, 6)
) -> FloatArray:
    """The model's covariance (6, 6), or that of a part of xi, widened along the direction in which
    both halves of the recording disagree by more than chance.

    ``products`` (K, p + 1, p + 1) are what each part of the recording adds
    (``Posterior.part_products``); ``misfit`` is a factor of the covariances of the halves.
    """
    half = len(products) // 2
    halves = NormalEquations(np.array([products[:half].sum(axis=0), products[half:].sum(axis=0)]))
    if not halves.is_complete.all():
        return model
    difference = (halves.step[0] - halves.step[1])[part]
    joint = misfit * halves.covariance.sum(axis=0)[part, part]
    away = np.linalg.solve(joint, difference)
    excess = float(difference @ away) / CHI2[0.1][len(model)]
    if excess <= 1.0:
        return model
    error = model @ away
    return model + (excess - 1.0) / float(error @ away) * np.outer(error, error)


def judged(axis: str, sigma: float) -> DofObservability:
    """Observed, weak or unobservable, by the standard deviation (m or rad)."""
    if sigma > UNOBSERVABLE:
        return DofObservability(axis, DofVerdict.UNOBSERVABLE, float("inf"))
    is_weak = sigma > WEAK[axis in ROTATIONS]
    verdict = DofVerdict.WEAK if is_weak else DofVerdict.OBSERVED
    return DofObservability(axis, verdict, sigma)
