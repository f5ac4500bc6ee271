"""How far an answer may be from the truth: a 6 x 6 covariance and a verdict per degree of freedom.

Two estimates are made. In each direction the larger one holds:

- The model's. The adaptive estimator has its own; for other methods it is that of motion pairs with
  independent, equally large errors, propagated through the cost to first order.
- The delete-a-block jackknife: the spread of the answers without each tenth of the recording. It
  assumes no noise model and includes time-correlated errors, such as drift, which the model misses.

Beside the covariance stands the common-mode floor: errors that are the same in every part of a
recording. A camera whose intrinsics are slightly wrong, or a lidar map that is stretched, gives an
error that no statistic of the recording shows: neither the residuals nor the halves know of it. The
standard deviation of a result contains both.

A rotation R moves the end of a lever arm d by (R - I) d. Over K motions the mean square is d' S d,
with S = mean (R - I)'(R - I). If all rotations are about one axis, d along that axis does not move:
the translation of the child sensor along it stays unknown. This is the one rule for that; the
covariance, the stream checks and the hints to the driver all use it.

The scale is what the data leave open of it; where the frame of a sensor is, and how it is turned,
is known to what odometries on real recordings with a known extrinsic agree to. An odometry whose
gain of rotation is slightly wrong moves its own centre by that share of the distance of what it
sees, which is far where a vehicle is fast: on roads, centres are 6 to 14 cm off, in rooms 1 cm.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.blocks import Blocks, jackknife_covariance
from hand_eye_calib.core.base.stats import CHI2, median
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import sigmas_in_parent
from hand_eye_calib.core.noise.estimator import AdaptiveSolution, ModelSolution
from hand_eye_calib.core.noise.noise_model import WALK_ROTATION
from hand_eye_calib.core.noise.normal import NormalEquations, multiplied
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, PosePairs
from hand_eye_calib.core.results.calibration import DofObservability, DofVerdict
from hand_eye_calib.core.results.records import AXES, ROTATIONS
from hand_eye_calib.core.solvers.all_pairs import Solution

# (B, K) mask of the pairs to leave out to the answers (B, 4, 4) without them.
SolveWithout: TypeAlias = Callable[[BoolArray], FloatArray]

# Blocks of the jackknife; fewest of them, and of the pairs in each.
BLOCKS = 10
_FEWEST = (4, 3)

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

# A direction counts as revealed if the rotations move it with this many times the power of the
# rotation errors. With less, noise alone would look like that motion.
_MIN_SIGNAL_TO_NOISE = 3.0

# Nor is it revealed if it moves less than this share of the direction that moves most: all rotation
# is then about that direction to within 2.3 deg. Odometry errors of a per cent or two of the
# rotation are common. They are systematic, so that the residuals do not show them.
_MIN_SHARE = 0.04

# Rotation errors are never taken to be smaller than this (rad): rounding, not motion.
_ROUNDING_ANGLE = 1e-6

# An axis is hidden if this share of it lies in directions that are not revealed.
_HIDDEN_SHARE = 0.1

# Standard deviations (m, rad) above which an axis is weak, and above which it is unobservable: so
# little is known that nobody can use the value.
WEAK = (0.05, float(np.radians(1.0)))
UNOBSERVABLE = 0.3


@dataclass(frozen=True)
class Assessment:
    """An answer with its covariance and verdicts.

    Attributes
    ----------
    T_parent_child : (4, 4) array
    cov_parent_child_in_child : (6, 6) array
        Covariance of xi = (rho, phi) in ``T_parent_child @ exp(xi)``: error in the child sensor's
        frame, m and rad.
    observability : tuple of DofObservability
        x, y, z, roll, pitch, yaw in the parent sensor's frame.
    contradictions : mapping
        Axis name to the number of standard deviations between prior and motion, for the axes on
        which they contradict each other. The prior on these was left out.
    from_motion : (6, 6) array
        Share of an error of the estimate from motion that is left in the answer, by xi: the
        identity without a prior, zero along what a prior alone determines.
    """

    T_parent_child: FloatArray
    cov_parent_child_in_child: FloatArray
    observability: tuple[DofObservability, ...]
    contradictions: Mapping[str, float] = field(default_factory=dict)
    from_motion: FloatArray = field(default_factory=lambda: np.eye(6))

    def allowance(self, of_motion: FloatArray) -> FloatArray:
        """Return the allowance (6, 6) of the answer from that of the estimate from motion."""
        return self.from_motion @ of_motion @ self.from_motion.T


def assess(pairs: MotionPairs, solution: Solution, solve_without: SolveWithout) -> Assessment:
    """Covariance and observability of the solution of K motion pairs in order of time;
    ``solve_without(left_out)`` gives the answers (B, 4, 4) without the pairs in each row of
    ``left_out`` (B, K): blocks for a jackknife, if there are pairs enough.
    """
    T_parent_child = solution.T_parent_child
    resampled = None
    model, unknown = model_covariance(pairs, solution)
    n_blocks = min(BLOCKS, len(pairs) // _FEWEST[1])
    if n_blocks >= _FEWEST[0]:
        block_of_pair = np.arange(len(pairs)) * n_blocks // len(pairs)
        left_out = block_of_pair[None, :] == np.arange(n_blocks)[:, None]
        answers = solve_without(left_out)
        resampled = jackknife_covariance(se3.log(se3.inverse(T_parent_child) @ answers))
    return combined(T_parent_child, model, resampled, unknown)


def assess_adaptive(pose_pairs: PosePairs, solution: AdaptiveSolution) -> Assessment:
    """Covariance and observability of an answer of the adaptive estimator for these poses."""
    covariance = widened_by_blocks(solution.cov_parent_child_in_child, solution, slice(0, 6))
    hidden = noise_driven(
        pose_pairs.Ts_pw_p,
        solution.T_parent_child,
        solution.jumps,
        solution.rotation_variance,
        # Rotations below the noise of single poses cannot be told from none.
        # Otherwise they can, and the tilt of the axis is stated: half as much is enough.
        _MIN_SHARE if solution.is_noise_dominated else _MIN_SHARE / 2,
    )
    unseen = basis([*solution.unseen.T, *hidden])
    return combined(solution.T_parent_child, covariance, None, unseen)


def assess_rotation(Ts_pw_p: FloatArray, solution: AdaptiveSolution) -> Assessment:
    """Covariance and observability of an answer of the adaptive estimator from rotations alone,
    with the parent's poses (N, 4, 4).

    The translation is unknown. So is a rotation about the only axis that the sensors rotate about:
    it is the axis along which they do not reveal a lever arm either.
    """
    part = slice(3, 6)
    unseen = solution.unseen[3:]
    whole = np.zeros((6, 6))
    of_model = solution.cov_parent_child_in_child[part, part]
    whole[part, part] = widened_by_blocks(of_model, solution, part)
    lone_axes = noise_driven(
        Ts_pw_p, solution.T_parent_child, solution.jumps, solution.rotation_variance
    )
    hidden = [direction for direction in unseen.T if np.linalg.norm(direction) > _SHARE_OF_ROTATION]
    hidden += [axis[:3] for axis in lone_axes]
    unknown = [*np.eye(6)[:3], *(np.r_[np.zeros(3), direction] for direction in hidden)]
    return combined(solution.T_parent_child, whole, None, basis(unknown))


def assess_lever_arm(
    Ts: FloatArray, solution: ModelSolution, T: FloatArray, covariance: FloatArray
) -> Assessment:
    """Covariance and observability of a lever arm in the frame of a sensor with poses (N, 4, 4): of
    a transform T with no rotation, which is unknown. ``covariance`` (3, 3) is that of the model.
    """
    whole = np.zeros((6, 6))
    whole[:3, :3] = widened_by_blocks(covariance, solution, slice(0, 3))
    # White rotation noise per axis: at most what differs from step to step about the two axes with
    # the smoothest rotation. Nothing else shows it where positions alone are measured: noise of the
    # orientation would look like a small motion that does not move the lever arm.
    steps = se3.rotation_log(np.swapaxes(Ts[:-1, :3, :3], 1, 2) @ Ts[1:, :3, :3])
    # Differences of steps have six times the variance of white noise.
    variances = np.median(np.diff(steps, axis=0) ** 2, axis=0) / CHI2[0.5][1] / 6.0
    white = float(np.sort(variances)[:2].mean())
    walk = np.exp(solution.levels[WALK_ROTATION])
    hidden = noise_driven(
        Ts, np.eye(4), solution.jumps, lambda n: np.asarray(2.0 * white + n * walk)
    )
    return combined(T, whole, None, basis([*np.eye(6)[3:], *hidden]))


def widened_by_blocks(covariance: FloatArray, solution: ModelSolution, part: slice) -> FloatArray:
    """The model's covariance of a part of xi, widened to the scatter of its blocks."""
    if len(solution.jumps) < BLOCKS * _FEWEST[1]:
        return covariance
    blocks = Blocks(solution.part_products).merged(BLOCKS)
    answers = NormalEquations(blocks.without()).step
    spread = jackknife_covariance(answers[:, part])
    # One factor for all directions, how many times the covariance they spread on average: that of a
    # single direction scatters too much. Rotations may have a larger one: slow errors of a sensor's
    # rotation pass for those of a world, which motion averages.
    factors = np.ones(len(covariance))
    for turns in (slice(None), slice(3, None)):
        if n_directions := len(factors[turns]):
            information = np.linalg.pinv(covariance[turns, turns], hermitian=True)
            excess = np.trace(information @ spread[turns, turns]) / n_directions
            factors[turns] = np.maximum(factors[turns], excess)
    return covariance * np.sqrt(np.outer(factors, factors))


def noise_driven(
    Ts_pw_p: FloatArray,
    T_parent_child: FloatArray,
    jumps: BoolArray,
    rotation_variance: Callable[[int], FloatArray],
    least_share: float = _MIN_SHARE,
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
        See :func:`hidden_directions`.
    """
    longest = max(len(Ts_pw_p) // BLOCKS, 1)
    rotations = Ts_pw_p[:, :3, :3]
    jumps_before = np.concatenate([[0], np.cumsum(jumps)])
    found: list[FloatArray] = []
    for baseline in sorted({*np.geomspace(1, longest, 4).astype(int).tolist()}, reverse=True):
        motions = np.swapaxes(rotations[:-baseline], 1, 2) @ rotations[baseline:]
        # No baseline may run across a jump, unless all of them do.
        weights = (jumps_before[baseline:] == jumps_before[:-baseline]).astype(float)
        if not weights.any():
            weights[:] = 1.0
        chords = (motions - np.eye(3)) @ T_parent_child[:3, :3]
        noise = rotation_variance(baseline) * np.eye(3)
        products = lever_arm_products(chords, weights)
        found.append(hidden_directions(products, noise, least_share).T)
    return [np.r_[direction, np.zeros(3)] for direction in min(found, key=len)]


def combined(
    T_parent_child: FloatArray, model: FloatArray, resampled: FloatArray | None, unknown: FloatArray
) -> Assessment:
    """Covariance and verdicts from a model's covariance (6, 6) in the child's frame, that of
    resampling if there is one, and directions (6, U) that the motion does not reveal.
    """
    known = np.eye(6) - unknown @ unknown.T
    scaled = UNKNOWN_SIGMAS[:, None] * unknown
    if resampled is not None:  # the larger one, direction by direction
        # In the coordinates where the model's is the identity, the eigenvalues are the ratios.
        variances, axes = np.linalg.eigh(model)
        root = axes * np.sqrt(np.maximum(variances, ROUNDING_VARIANCE))
        ratios, vectors = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, resampled).T))
        raised = root @ vectors
        model = (raised * np.maximum(ratios, 1.0)) @ raised.T
    covariance = known @ model @ known + scaled @ scaled.T
    rotation = T_parent_child[:3, :3]
    sigmas = sigmas_in_parent(rotation, covariance)
    shares = ((np.kron(np.eye(2), rotation) @ unknown) ** 2).sum(axis=1)
    sigmas = np.where(shares > _HIDDEN_SHARE, np.inf, sigmas)
    return Assessment(T_parent_child, covariance, tuple(map(judged, AXES, sigmas.tolist())))


def without_axes(assessment: Assessment, axes: Collection[str]) -> Assessment:
    """An assessment that counts these axes of the parent's frame as unobservable."""
    # A direction that is unknown already is hardly ever an axis: both would hide a second one.
    known = {*axes}.difference(
        dof.name for dof in assessment.observability if dof.verdict is DofVerdict.UNOBSERVABLE
    )
    rows = [index for index, axis in enumerate(AXES) if axis in known]
    if not rows:
        return assessment
    rotation = assessment.T_parent_child[:3, :3]
    return _without(assessment, np.asarray(np.kron(np.eye(2), rotation)[rows].T, dtype=float))


def without_direction(assessment: Assessment, axis: FloatArray) -> Assessment:
    """Return an assessment in which a lever arm along an axis (3,) of the parent is unknown."""
    # A direction that is unknown already is the same one: both would hide a second one.
    if any(dof.verdict is DofVerdict.UNOBSERVABLE for dof in assessment.observability[:3]):
        return assessment
    in_child = assessment.T_parent_child[:3, :3].T @ axis
    return _without(assessment, np.r_[in_child, np.zeros(3)][:, None])


def _without(assessment: Assessment, unknown: FloatArray) -> Assessment:
    """Return an assessment in which directions (6, U) of the child are unknown, too."""
    T = assessment.T_parent_child
    found = combined(T, assessment.cov_parent_child_in_child, None, unknown)
    observability = tuple(
        before if before.verdict is DofVerdict.UNOBSERVABLE else after
        for before, after in zip(assessment.observability, found.observability, strict=True)
    )
    return replace(found, observability=observability)


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

    jacobian_t, jacobian_r = _derivatives(pairs, solution.T_parent_child[:3, :3])
    each = weights[:, None, None]
    information_t = multiplied(each * jacobian_t, jacobian_t)
    information_r = np.zeros((6, 6))
    information_r[3:, 3:] = multiplied(each * jacobian_r, jacobian_r)

    hessian = information_t + 2 * information_r
    values, vectors = np.linalg.eigh(hessian)
    seen = values > max(_RANK_TOLERANCE * values[-1], weights.sum() * _ROUNDING_ANGLE**2)
    inverse = (vectors * np.where(seen, 1.0 / np.where(seen, values, 1.0), 0.0)) @ vectors.T
    covariance = inverse @ (variance_t * information_t + 4 * variance_r * information_r) @ inverse

    hidden = hidden_directions(lever_arm_products(jacobian_t[..., :3], weights), cov_r).T
    of_lever_arm = [np.r_[direction, np.zeros(3)] for direction in hidden]
    return covariance, basis([*of_lever_arm, *vectors[:, ~seen].T])


def _derivatives(pairs: MotionPairs, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the translations that motion pairs leave by xi (K, 3, 6), and of the rotations
    by phi (K, 3, 3); the latter in axes that are turned with each pair.
    """
    chords = pairs.Ts_parenti_parentj[:, :3, :3] - np.eye(3)
    pushed = rotation @ se3.skew(pairs.Ts_childi_childj[:, :3, 3])
    turned = pairs.Ts_childi_childj[:, :3, :3] - np.eye(3)
    return np.concatenate([chords @ rotation, pushed], axis=2), turned


def lever_arm_products(chords: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """S (3, 3) of motions with these chords (K, 3, 3): R - I of each, or (R - I) Q for lever arms
    in a frame that Q rotates from; and with their weights (K,), 1 by default.
    """
    weights = np.ones(len(chords)) if weights is None else weights
    total = multiplied(weights[:, None, None] * chords, chords)
    return total / max(float(weights.sum()), 1.0)


def hidden_directions(
    products: FloatArray, cov_rotation: FloatArray | None = None, least_share: float = _MIN_SHARE
) -> FloatArray:
    """The directions (3, U) of lever arms that rotations do not reveal.

    Parameters
    ----------
    products : (3, 3) array
        :func:`lever_arm_products` of the motions.
    cov_rotation : (3, 3) array, optional
        Covariance C of the rotation errors, rad^2, in the frame of the lever arms. An error e moves
        a lever arm d by ``e x d``, with the mean square ``d' (tr(C) I - C) d``.
    least_share : float
        Least displacement, as a share of that along the direction that moves most.
    """
    powers, directions = np.linalg.eigh(products)
    cov_rotation = np.zeros((3, 3)) if cov_rotation is None else cov_rotation
    noise = np.trace(cov_rotation) * np.eye(3) - cov_rotation + _ROUNDING_ANGLE**2 * np.eye(3)
    of_noise = _MIN_SIGNAL_TO_NOISE * np.diag(directions.T @ noise @ directions)
    return directions[:, powers < np.maximum(of_noise, least_share**2 * powers[-1])]


def hidden_axes(products: FloatArray, cov_rotation: FloatArray | None = None) -> tuple[str, ...]:
    """Names of the axes x, y, z that lie too far in the hidden directions to be known."""
    shares = (hidden_directions(products, cov_rotation) ** 2).sum(axis=1)
    return tuple(axis for axis, share in zip("xyz", shares, strict=True) if share > _HIDDEN_SHARE)


def basis(directions: list[FloatArray]) -> FloatArray:
    """Orthonormal basis (6, U) of directions (6,), which may be linearly dependent."""
    if not directions:
        return np.zeros((6, 0))
    left, sizes, _ = np.linalg.svd(np.array(directions).T, full_matrices=False)
    return left[:, sizes > 1e-6 * sizes[0]]


def judged(axis: str, sigma: float) -> DofObservability:
    """Observed, weak or unobservable, by the standard deviation (m or rad)."""
    if sigma > UNOBSERVABLE:
        return DofObservability(axis, DofVerdict.UNOBSERVABLE, float("inf"))
    is_weak = sigma > WEAK[axis in ROTATIONS]
    verdict = DofVerdict.WEAK if is_weak else DofVerdict.OBSERVED
    return DofObservability(axis, verdict, sigma)


# -------------------------------------------------------------------- the common-mode floor

# Standard deviation along (m) and about (rad) each axis, and of the scale of a path.
FLOOR_TRANSLATION = 0.005
FLOOR_ROTATION = float(np.radians(0.15))
FLOOR_SCALE = 0.01
# What is seen is about two seconds of travel away, and rotations are right to 0.25 %: of ten real
# rigs, those on roads agree with 5 to 15 ms, and to the others it makes no difference.
FLOOR_TRAVEL_S = 0.005

# Speeds are those over this time (s), so that noise between neighbouring poses counts little.
_SPEED_OVER_S = 1.0

# Information below this share of the largest is noise: along such directions nothing is known
# anyway.
_MIN_INFORMATION = 1e-6


def common_mode_floor(speed_m_s: float = 0.0) -> FloatArray:
    """Covariance (6, 6) of xi = (rho, phi) that the floor stands for, in the child sensor's frame,
    with a scale that is part of the model; ``speed_m_s`` is the usual one of the recording.
    """
    translation = FLOOR_TRANSLATION**2 + (FLOOR_TRAVEL_S * speed_m_s) ** 2
    return np.diag(np.repeat([translation, FLOOR_ROTATION**2], 3))


def usual_speed(stamps_ns: IntArray, positions: FloatArray) -> float:
    """The speed (m/s) above which half of the path is driven: neither stops nor jumps count.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    positions : (N, 3) array
    """
    step_s = median(np.diff(stamps_ns)) * 1e-9 if len(stamps_ns) > 1 else 1.0
    stride = max(1, round(_SPEED_OVER_S / step_s))
    seconds = np.diff(stamps_ns[::stride]) * 1e-9
    metres = np.linalg.norm(np.diff(positions[::stride], axis=0), axis=1)
    if not metres.any():
        return 0.0
    speeds = metres / seconds
    order = np.argsort(speeds)
    driven = np.cumsum(metres[order])
    return float(speeds[order[np.searchsorted(driven, driven[-1] / 2)]])


def open_scale_floor(by_scale: FloatArray, scale_variance: float) -> FloatArray:
    """What a scale outside the model adds to the floor (6, 6).

    Parameters
    ----------
    by_scale : (6,) array
        Derivative of the answer by the logarithm of the scale of the child's path.
    scale_variance : float
        Of that scale, by the data alone.
    """
    open_variance = FLOOR_SCALE**2 * scale_variance / (FLOOR_SCALE**2 + scale_variance)
    return open_variance * np.outer(by_scale, by_scale)


def floor_of_pairs(
    pairs: MotionPairs, weights: FloatArray, T_parent_child: FloatArray, speed_m_s: float
) -> FloatArray:
    """The floor (6, 6) of an answer that minimises the weighted squared residuals of motion pairs,
    of a recording of this usual speed.

    With the child's translations times s the residual ``(R_A - I) t + t_A - s R t_B`` changes by
    ``-R t_B ds``. Pairs that overlap are as much evidence of the scale as those that do not.
    """
    rotation = T_parent_child[:3, :3]
    by_xi, turned = _derivatives(pairs, rotation)
    residuals = pairs.residuals(T_parent_child)[0][:, :, None]
    push = (pairs.Ts_childi_childj[:, :3, 3] @ rotation.T)[:, :, None]
    jacobian = np.concatenate([by_xi, push, residuals], axis=2)
    each = weights[:, None, None]
    products = multiplied(each * jacobian, jacobian)
    information = products[:6, :6].copy()
    pushed = products[:6, 6]
    information[3:, 3:] += 2 * multiplied(each * turned, turned)
    by_scale = np.linalg.pinv(information, rcond=_MIN_INFORMATION, hermitian=True) @ pushed
    of_scale = max(float(products[6, 6] - pushed @ by_scale), 1e-30)
    overlap = float(np.mean(pairs.j - pairs.i)) if len(pairs) else 1.0
    variance = overlap * products[7, 7] / max(3.0 * float(weights.sum()) - 7.0, 1.0)
    return common_mode_floor(speed_m_s) + open_scale_floor(by_scale, float(variance / of_scale))
