"""Covariance and observability of an estimated extrinsic.

The error xi = (rho, phi) is a right perturbation in the child sensor's frame (J. Sola et al., *A
micro Lie theory for state estimation in robotics*, 2018):

    X_true = X exp(xi),    cov(xi) = max(C_model, C_jackknife) + U U' + C_floor

- C_model is the covariance under the noise model. The adaptive estimator computes C_model itself.
  For the other methods, C_model follows to first order from independent, equally large errors of
  the motion pairs.
- C_jackknife is the scatter of ten answers, each computed without one tenth of the recording
  (B. Efron, R. J. Tibshirani, *An introduction to the bootstrap*, 1993). It needs no noise model
  and includes time-correlated errors such as drift. The maximum is taken in each direction.
- U are the directions that the motion does not reveal, times the standard deviation of an unknown
  direction.
- C_floor is the common-mode floor: errors that are equal in every part of a recording, such as
  wrong intrinsics of a camera or a stretched lidar map. They change neither the residuals nor the
  difference between both halves of a recording.

A rotation R displaces the end of a lever arm d by the chord (R - I) d. The mean square of this
chord over K motions is d' S d, with S = mean (R - I)'(R - I). If all rotations are about one axis,
a lever arm along this axis is not displaced, and the translation along the axis is unknown. The
covariance, the stream checks and the hints to the driver all use this rule.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.blocks import Blocks, jackknife_covariance
from hand_eye_calib.core.base.stats import CHI2
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import sigmas_in_parent
from hand_eye_calib.core.noise.estimator import AdaptiveSolution, ModelSolution
from hand_eye_calib.core.noise.noise_model import WALK_ROTATION
from hand_eye_calib.core.noise.normal import NormalEquations, multiplied
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, PosePairs
from hand_eye_calib.core.results.calibration import DofObservability, DofVerdict
from hand_eye_calib.core.results.records import AXES, ROTATIONS
from hand_eye_calib.core.solvers.all_pairs import RANK_TOLERANCE, Solution

# Number of blocks for the jackknife.
BLOCKS = 10
# Without this number of blocks, no jackknife is computed.
_LEAST_BLOCKS = 4
# Fewest motion pairs or increments in a block.
_LEAST_BLOCK_SIZE = 3

# A unit vector xi = (rho, phi) counts as a rotation if the length of phi exceeds this limit.
_SHARE_OF_ROTATION = 0.5

# Standard deviations (m, rad) of an unknown direction: the distance between sensors on a large
# machine, and half a turn. An unknown direction is never exactly an axis of the parent sensor, so a
# part of its variance appears on the other axes. Larger values would hide the variances of these
# other axes.
UNKNOWN_SIGMAS = np.repeat([3.0, np.pi], 3)

# Smallest divisor among variances (m^2 or rad^2). The variance of noise-free data is zero.
ROUNDING_VARIANCE = 1e-24

# The motion reveals a direction of the lever arm if its mean square displacement exceeds that by
# rotation errors by this factor. Noise alone causes smaller ratios.
_MIN_SIGNAL_TO_NOISE = 3.0

# The displacement along a direction must also exceed this share of the largest displacement. A
# smaller share means that all rotation is about this direction to within 2.3 deg. Systematic
# odometry errors of 1 or 2 % of the rotation are common, and absent from the residuals.
_MIN_SHARE = 0.04

# Smallest rotation error (rad): rounding of poses in files.
_ROUNDING_ANGLE = 1e-6

# An axis is hidden if hidden directions contain more than this share of its squared length.
_HIDDEN_SHARE = 0.1

# An axis with a larger standard deviation (m, rad) is weak.
WEAK = (0.05, float(np.radians(1.0)))
# An axis or a direction with a larger standard deviation (m or rad) is unobservable: its value is
# useless.
UNOBSERVABLE = 0.3


@dataclass(frozen=True)
class Assessment:
    """An extrinsic with its covariance and verdicts.

    Attributes
    ----------
    T_parent_child : (4, 4) array
    cov_parent_child_in_child : (6, 6) array
        Covariance of xi = (rho, phi) in ``T_parent_child @ exp(xi)``, in the child sensor's frame,
        m and rad.
    observability : tuple of DofObservability
        Verdicts on x, y, z, roll, pitch, yaw in the parent sensor's frame.
    contradictions : mapping
        Axes on which prior and motion contradict each other, with their distance in standard
        deviations. The prior of these axes is ignored.
    from_motion : (6, 6) array
        Derivative of the result with respect to the estimate from motion, both as xi. Without a
        prior it is the identity. Along directions that only a prior determines it is zero.
    """

    T_parent_child: FloatArray
    cov_parent_child_in_child: FloatArray
    observability: tuple[DofObservability, ...]
    contradictions: Mapping[str, float] = field(default_factory=dict)
    from_motion: FloatArray = field(default_factory=lambda: np.eye(6))

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations (6,) along and about the parent's axes; infinite if unobservable."""
        return np.array([dof.sigma for dof in self.observability])

    def allowance(self, of_motion: FloatArray) -> FloatArray:
        """Return the allowance (6, 6) of the result.

        ``of_motion`` (6, 6) is the allowance of the estimate from motion.
        """
        return self.from_motion @ of_motion @ self.from_motion.T


def assess(
    pairs: MotionPairs,
    solution: Solution,
    solve_without: Callable[[BoolArray], FloatArray],
) -> Assessment:
    """Assess the solution for K motion pairs.

    Parameters
    ----------
    pairs : MotionPairs
        Motion pairs in order of time.
    solution : Solution
    solve_without : callable
        Function that returns the answers (B, 4, 4) without the pairs in each row of a mask (B, K).
        If there are enough pairs, the jackknife calls it.
    """
    T_parent_child = solution.T_parent_child
    covariance, unknown = model_covariance(pairs, solution)
    n_blocks = min(BLOCKS, len(pairs) // _LEAST_BLOCK_SIZE)
    if n_blocks >= _LEAST_BLOCKS:
        block_of_pair = np.arange(len(pairs)) * n_blocks // len(pairs)
        left_out = block_of_pair[None, :] == np.arange(n_blocks)[:, None]
        answers = solve_without(left_out)
        deviations = se3.log(se3.inverse(T_parent_child) @ answers)
        covariance = _larger(covariance, jackknife_covariance(deviations))
    return combined(T_parent_child, covariance, unknown)


def assess_adaptive(
    pose_pairs: PosePairs, solution: AdaptiveSolution
) -> Assessment:
    """Assess a solution of the adaptive estimator for these poses."""
    T_parent_child = solution.T_parent_child
    covariance = widened_by_blocks(
        solution.cov_parent_child_in_child, solution, slice(0, 6)
    )
    least_share = _MIN_SHARE
    if not solution.is_noise_dominated:
        # The rotations exceed the noise of single poses. The solution then estimates the tilt of
        # the axis as well, so half of the share suffices.
        least_share = _MIN_SHARE / 2
    hidden = _hidden_by_noise(
        pose_pairs.Ts_pw_p,
        T_parent_child,
        solution.jumps,
        solution.rotation_variance,
        least_share,
    )
    unknown = basis([*solution.unseen.T, *_translations(hidden)])
    return combined(T_parent_child, covariance, unknown)


def assess_rotation(
    Ts_pw_p: FloatArray, solution: AdaptiveSolution
) -> Assessment:
    """Assess a solution of the adaptive estimator from rotations alone.

    The translation is unknown. If the sensors rotate about a single axis, the rotation about this
    axis is unknown as well; this axis is the hidden direction of a lever arm.

    Parameters
    ----------
    Ts_pw_p : (N, 4, 4) array
        Poses of the parent.
    solution : AdaptiveSolution
    """
    part = slice(3, 6)
    model = solution.cov_parent_child_in_child[part, part]
    covariance = np.zeros((6, 6))
    covariance[part, part] = widened_by_blocks(model, solution, part)
    unseen = [
        phi
        for phi in solution.unseen[part].T
        if np.linalg.norm(phi) > _SHARE_OF_ROTATION
    ]
    lone_axes = _hidden_by_noise(
        Ts_pw_p,
        solution.T_parent_child,
        solution.jumps,
        solution.rotation_variance,
    )
    translations = np.eye(6)[:3]
    rotations = [np.r_[np.zeros(3), phi] for phi in (*unseen, *lone_axes)]
    unknown = basis([*translations, *rotations])
    return combined(solution.T_parent_child, covariance, unknown)


def assess_lever_arm(
    Ts: FloatArray,
    solution: ModelSolution,
    T: FloatArray,
    covariance: FloatArray,
    of_faults: FloatArray,
) -> Assessment:
    """Assess a lever arm in the frame of a sensor that has poses.

    Parameters
    ----------
    Ts : (N, 4, 4) array
        Poses of the sensor.
    solution : ModelSolution
    T : (4, 4) array
        The lever arm, with an identity for the unknown rotation.
    covariance : (3, 3) array
        Covariance of the lever arm under the noise model.
    of_faults : (3, 3) array
        Covariance that possible faults of the positions add.
    """
    whole = np.zeros((6, 6))
    whole[:3, :3] = (
        widened_by_blocks(covariance, solution, slice(0, 3)) + of_faults
    )
    white = _white_rotation_variance(se3.rotation_of(Ts))
    walk = np.exp(solution.levels[WALK_ROTATION])

    def rotation_variance(n_increments: int) -> FloatArray:
        return 2.0 * white + n_increments * walk

    hidden = _hidden_by_noise(Ts, np.eye(4), solution.jumps, rotation_variance)
    rotations = np.eye(6)[3:]
    unknown = basis([*rotations, *_translations(hidden)])
    return combined(T, whole, unknown)


def _white_rotation_variance(rotations: FloatArray) -> float:
    """Return an upper bound of the variance (rad^2) per axis of white rotation noise.

    The bound is from the differences between successive steps about the two axes with the smoothest
    rotation. The positions of a lever arm do not reveal this noise, which looks like a small motion
    that does not displace the lever arm.

    Parameters
    ----------
    rotations : (N, 3, 3) array
    """
    steps = se3.rotations_between(rotations[:-1], rotations[1:])
    squares = np.diff(steps, axis=0) ** 2
    median_squares = np.median(squares, axis=0)
    # The variance of a difference of steps is six times the variance of white noise.
    variances = median_squares / CHI2[0.5][1] / 6.0
    two_smallest = np.sort(variances)[:2]
    return float(two_smallest.mean())


def widened_by_blocks(
    covariance: FloatArray, solution: ModelSolution, part: slice
) -> FloatArray:
    """Widen the model's covariance of a part of xi to the scatter between blocks.

    All directions share one factor, the mean of their variance ratios, because the ratio of a
    single direction scatters too much. Rotations have their own factor if it is larger: the noise
    model may confuse slow rotation errors fixed to a sensor with errors fixed to a world. Errors
    fixed to a world average out while the sensor moves, so the model's covariance is too small in
    this case.

    If a recording has too few increments for the blocks, the model's covariance is unchanged.
    """
    if len(solution.jumps) < BLOCKS * _LEAST_BLOCK_SIZE:
        return covariance
    blocks = Blocks(solution.part_products).merged(BLOCKS)
    answers = NormalEquations(blocks.without()).step
    spread = jackknife_covariance(answers[:, part])
    factors = np.full(
        len(covariance), max(_mean_ratio(spread, covariance), 1.0)
    )
    if len(covariance) == 6:
        rotation_ratio = _mean_ratio(spread[3:, 3:], covariance[3:, 3:])
        factors[3:] = np.maximum(factors[3:], rotation_ratio)
    return covariance * np.sqrt(np.outer(factors, factors))


def _mean_ratio(spread: FloatArray, covariance: FloatArray) -> float:
    """Return the mean ratio of the variances of two covariances (n, n) over all directions."""
    information = np.linalg.pinv(covariance, hermitian=True)
    return float(np.trace(information @ spread) / len(covariance))


def _hidden_by_noise(
    Ts_pw_p: FloatArray,
    T_parent_child: FloatArray,
    jumps: BoolArray,
    rotation_variance: Callable[[int], FloatArray],
    least_share: float = _MIN_SHARE,
) -> FloatArray:
    """Return the directions (U, 3) of translation that the rotations do not reveal.

    A single increment may be smaller than its noise. Therefore sums of increments are tested as
    well. Long baselines are best against white noise, and short baselines against drift.

    Parameters
    ----------
    Ts_pw_p : (N, 4, 4) array
    T_parent_child : (4, 4) array
    jumps : (N - 1,) bool array
        Increments with a jump, which are ignored.
    rotation_variance : callable
        Variance (rad^2) per axis of the rotation noise over a number of increments.
    least_share : float
        See :func:`_hidden_directions`.
    """
    longest = max(len(Ts_pw_p) // BLOCKS, 1)
    baselines = np.unique(np.geomspace(1, longest, 4).astype(int))
    rotations = se3.rotation_of(Ts_pw_p)
    jumps_before = np.concatenate([[0], np.cumsum(jumps)])
    candidates: list[FloatArray] = []
    for baseline in baselines[::-1].tolist():
        motions = se3.relative_rotations(
            rotations[:-baseline], rotations[baseline:]
        )
        # Motions across a jump have weight zero, except if all motions are across a jump.
        is_without_jump = jumps_before[baseline:] == jumps_before[:-baseline]
        weights = is_without_jump.astype(float)
        if not is_without_jump.any():
            weights[:] = 1.0
        chords = (motions - np.eye(3)) @ se3.rotation_of(T_parent_child)
        noise = rotation_variance(baseline) * np.eye(3)
        products = lever_arm_products(chords, weights)
        candidates.append(_hidden_directions(products, noise, least_share).T)
    # The baseline that reveals most directions decides.
    return min(candidates, key=len)


def _translations(directions: FloatArray) -> FloatArray:
    """Return directions (U, 6) of xi = (rho, 0) for directions (U, 3) of rho."""
    return np.pad(directions, ((0, 0), (0, 3)))


def _larger(model: FloatArray, resampled: FloatArray) -> FloatArray:
    """Return the larger of two covariances (6, 6), direction by direction."""
    # In coordinates in which the model's covariance is the identity, the eigenvalues of the other
    # covariance are the ratios of both variances.
    variances, axes = np.linalg.eigh(model)
    root = axes * np.sqrt(np.maximum(variances, ROUNDING_VARIANCE))
    whitened = np.linalg.solve(root, np.linalg.solve(root, resampled).T)
    ratios, vectors = np.linalg.eigh(whitened)
    raised = root @ vectors
    return (raised * np.maximum(ratios, 1.0)) @ raised.T


def combined(
    T_parent_child: FloatArray, covariance: FloatArray, unknown: FloatArray
) -> Assessment:
    """Assess a result, given its covariance and the directions that the motion does not reveal.

    Parameters
    ----------
    T_parent_child : (4, 4) array
    covariance : (6, 6) array
        Covariance in the child's frame.
    unknown : (6, U) array
        Orthonormal directions.
    """
    onto_known = np.eye(6) - unknown @ unknown.T
    scaled = UNKNOWN_SIGMAS[:, None] * unknown
    whole = onto_known @ covariance @ onto_known + scaled @ scaled.T
    rotation = se3.rotation_of(T_parent_child)
    sigmas = sigmas_in_parent(rotation, whole)
    unknown_in_parent = se3.block_diagonal(rotation) @ unknown
    unknown_shares = (unknown_in_parent**2).sum(axis=1)
    sigmas = np.where(unknown_shares > _HIDDEN_SHARE, np.inf, sigmas)
    observability = map(judged, AXES, sigmas.tolist())
    return Assessment(T_parent_child, whole, tuple(observability))


def without_axes(assessment: Assessment, axes: Collection[str]) -> Assessment:
    """Return an assessment in which the given axes of the parent's frame are unobservable."""
    # An unobservable axis already has an unknown direction near it. The axis as a second direction
    # would make another axis unobservable.
    is_hidden = [
        dof.name in axes and dof.verdict is not DofVerdict.UNOBSERVABLE
        for dof in assessment.observability
    ]
    if not any(is_hidden):
        return assessment
    in_parent = se3.block_diagonal(se3.rotation_of(assessment.T_parent_child))
    return _without(assessment, in_parent[is_hidden].T)


def without_direction(assessment: Assessment, axis: FloatArray) -> Assessment:
    """Return an assessment in which a lever arm along an axis (3,) of the parent is unknown."""
    # The unknown direction of an unobservable translation is already this axis. A second, slightly
    # different direction would make another axis unobservable.
    if any(
        dof.verdict is DofVerdict.UNOBSERVABLE
        for dof in assessment.observability[:3]
    ):
        return assessment
    in_child = se3.rotation_of(assessment.T_parent_child).T @ axis
    return _without(assessment, _translations(in_child[None]).T)


def _without(assessment: Assessment, unknown: FloatArray) -> Assessment:
    """Return an assessment in which further directions (6, U) of the child are unknown."""
    hidden = combined(
        assessment.T_parent_child, assessment.cov_parent_child_in_child, unknown
    )
    observability = tuple(
        before if before.verdict is DofVerdict.UNOBSERVABLE else after
        for before, after in zip(
            assessment.observability, hidden.observability, strict=True
        )
    )
    return replace(hidden, observability=observability)


def model_covariance(
    pairs: MotionPairs, solution: Solution
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (6, 6) for independent errors of the pairs, and unknown directions.

    The cost is ``|r_t|^2 + 2 |r_R|^2`` with the residual translation r_t and the residual rotation
    vector r_R. Their Jacobians are J_t and J_R, the variances of the residuals s_t^2 and s_R^2. An
    estimate that minimises the weighted sum has the covariance
    ``H^-1 (s_t^2 J_t'J_t + 4 s_R^2 J_R'J_R) H^-1`` with ``H = J_t'J_t + 2 J_R'J_R``. It is zero
    along directions without information.

    The second value is an orthonormal basis (6, U) of the directions that the motion does not
    reveal.
    """
    weights = solution.weights
    n_effective = max(float(weights.sum()) - 3.0, 1.0)
    residual_t, residual_r = pairs.residuals(solution.T_parent_child)
    squares_t = (residual_t**2).sum(axis=1)
    variance_t = (weights @ squares_t) / (3 * n_effective)
    cov_r = (weights[:, None] * residual_r).T @ residual_r / n_effective
    variance_r = np.trace(cov_r) / 3

    jacobian_t, jacobian_r = derivatives(
        pairs, se3.rotation_of(solution.T_parent_child)
    )
    weight_of_pair = weights[:, None, None]
    information_t = multiplied(weight_of_pair * jacobian_t, jacobian_t)
    information_r = np.zeros((6, 6))
    information_r[3:, 3:] = multiplied(weight_of_pair * jacobian_r, jacobian_r)

    hessian = information_t + 2 * information_r
    values, vectors = np.linalg.eigh(hessian)
    rounding = max(
        RANK_TOLERANCE * values[-1], weights.sum() * _ROUNDING_ANGLE**2
    )
    is_seen = values > rounding
    inverse_values = np.divide(1.0, values, out=np.zeros(6), where=is_seen)
    inverse = (vectors * inverse_values) @ vectors.T
    score_covariance = (
        variance_t * information_t + 4 * variance_r * information_r
    )
    covariance = inverse @ score_covariance @ inverse

    # The derivatives with respect to rho are the chords of lever arms.
    products = information_t[:3, :3] / max(float(weights.sum()), 1.0)
    hidden = _hidden_directions(products, cov_r).T
    unseen = vectors[:, ~is_seen].T
    return covariance, basis([*_translations(hidden), *unseen])


def derivatives(
    pairs: MotionPairs, rotation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the residuals of motion pairs with respect to xi.

    Returns
    -------
    of_translation : (K, 3, 6) array
        Derivatives of the translations with respect to xi = (rho, phi).
    of_rotation : (K, 3, 3) array
        Derivatives of the rotations with respect to phi. Their axes differ from pair to pair by a
        rotation, which does not change products J' J.
    """
    parent_chords = se3.rotation_of(pairs.Ts_parenti_parentj) - np.eye(3)
    child_chords = se3.rotation_of(pairs.Ts_childi_childj) - np.eye(3)
    by_rho = parent_chords @ rotation
    by_phi = rotation @ se3.skew(se3.translation_of(pairs.Ts_childi_childj))
    of_translation = np.concatenate([by_rho, by_phi], axis=2)
    return of_translation, child_chords


def lever_arm_products(
    chords: FloatArray, weights: FloatArray | None = None
) -> FloatArray:
    """Return S (3, 3), the weighted mean of the products of chords.

    Parameters
    ----------
    chords : (K, 3, 3) array
        R - I of each motion. For a lever arm in another frame: (R - I) Q, where Q rotates from this
        frame to the frame of R.
    weights : (K,) array, optional
        Weights of the motions; 1 by default.
    """
    if weights is None:
        weights = np.ones(len(chords))
    weighted = weights[:, None, None] * chords
    total = multiplied(weighted, chords)
    return total / max(float(weights.sum()), 1.0)


def _hidden_directions(
    products: FloatArray,
    cov_rotation: FloatArray,
    least_share: float = _MIN_SHARE,
) -> FloatArray:
    """Return the directions (3, U) of lever arms that rotations do not reveal.

    Parameters
    ----------
    products : (3, 3) array
        Products of the motions, see :func:`lever_arm_products`.
    cov_rotation : (3, 3) array
        Covariance C of the rotation errors, rad^2, in the frame of the lever arms. An error e
        displaces a lever arm d by ``e x d``. The mean square is ``d' (tr(C) I - C) d``.
    least_share : float
        Smallest displacement of a revealed direction, as a share of the largest displacement.
    """
    powers, directions = np.linalg.eigh(products)
    identity = np.eye(3)
    noise = np.trace(cov_rotation) * identity - cov_rotation
    noise = noise + _ROUNDING_ANGLE**2 * identity
    noise_powers = np.diag(directions.T @ noise @ directions)
    least_powers = np.maximum(
        _MIN_SIGNAL_TO_NOISE * noise_powers,
        least_share**2 * powers[-1],
    )
    return directions[:, powers < least_powers]


def hidden_axes(
    products: FloatArray, cov_rotation: FloatArray | None = None
) -> tuple[str, ...]:
    """Return the names of the axes x, y, z that lie mostly in hidden directions.

    Parameters
    ----------
    products : (3, 3) array
        Products of the motions, see :func:`lever_arm_products`.
    cov_rotation : (3, 3) array, optional
        Covariance of the rotation errors, rad^2; zero by default.
    """
    if cov_rotation is None:
        cov_rotation = np.zeros((3, 3))
    directions = _hidden_directions(products, cov_rotation)
    shares = (directions**2).sum(axis=1)
    return tuple(
        "xyz"[index] for index in np.flatnonzero(shares > _HIDDEN_SHARE)
    )


def basis(directions: list[FloatArray]) -> FloatArray:
    """Return an orthonormal basis (6, U) of directions (6,) that may be linearly dependent."""
    if not directions:
        return np.zeros((6, 0))
    vectors, sizes, _ = np.linalg.svd(
        np.array(directions).T, full_matrices=False
    )
    return vectors[:, sizes > 1e-6 * sizes[0]]


def judged(axis: str, sigma: float) -> DofObservability:
    """Return the verdict on a standard deviation (m or rad): observed, weak or unobservable."""
    if sigma > UNOBSERVABLE:
        return DofObservability(axis, DofVerdict.UNOBSERVABLE, float("inf"))
    is_weak = sigma > WEAK[axis in ROTATIONS]
    verdict = DofVerdict.WEAK if is_weak else DofVerdict.OBSERVED
    return DofObservability(axis, verdict, sigma)
