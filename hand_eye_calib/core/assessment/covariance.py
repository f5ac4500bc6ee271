"""Covariance and observability of an estimated extrinsic.

The error xi = (rho, phi) is a right perturbation in the child sensor's frame (J. Sola et al., *A
micro Lie theory for state estimation in robotics*, 2018):

    X_true = X exp(xi),    cov(xi) = max(C_model, C_jackknife) + U U' + C_floor

- C_model is the covariance under the noise model. The adaptive estimator has its own. For other
  methods, motion pairs have independent, equally large errors, propagated to first order.
- C_jackknife is the scatter of the answers without each tenth of the recording (B. Efron, R. J.
  Tibshirani, *An introduction to the bootstrap*, 1993). It needs no noise model and includes
  time-correlated errors such as drift. The larger of both holds in each direction.
- U are the directions that the motion does not reveal, times a standard deviation for "unknown".
- C_floor is the common-mode floor: errors that are equal in every part of a recording, such as
  wrong intrinsics of a camera or a stretched lidar map. Neither residuals nor halves reveal them.

A rotation R moves the end of a lever arm d by (R - I) d. The mean square over K motions is d' S d
with S = mean (R - I)'(R - I). If all rotations are about one axis, a lever arm d along that axis
does not move, and the translation along the axis stays unknown. The covariance, the stream checks
and the hints to the driver all use this rule.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace

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

# Number of blocks of the jackknife.
BLOCKS = 10
# Fewest blocks of a jackknife.
_LEAST_BLOCKS = 4
# Fewest motion pairs or increments in a block.
_LEAST_BLOCK_SIZE = 3

# An unseen direction of xi is a rotation if its part phi is longer than this.
_SHARE_OF_ROTATION = 0.5

# Standard deviations (m, rad) that represent "unknown" in the covariance: the distance between
# sensors on a large machine, and half a turn. An unknown direction is never exactly an axis of the
# parent sensor, so a part of its variance is added to the other axes. Larger values would hide what
# is known of these axes. The verdicts name the unknown axes.
UNKNOWN_SIGMAS = np.repeat([3.0, np.pi], 3)

# Smallest variance (m^2 or rad^2) that is divided by: the variance of noise-free data is zero.
ROUNDING_VARIANCE = 1e-24

# Information below this share of the largest is rounding.
_RANK_TOLERANCE = 1e-12

# The motion reveals a direction of the lever arm if the rotations displace it with this many times
# the power of the rotation errors. Below, noise alone looks like such a displacement.
_MIN_SIGNAL_TO_NOISE = 3.0

# A direction must also move by this share of the direction that moves most. Otherwise all rotation
# is about this direction to within 2.3 deg. Systematic odometry errors of 1 or 2 % of the rotation
# are common, and the residuals do not contain them.
_MIN_SHARE = 0.04

# Rotation errors are at least this large (rad): rounding, not motion.
_ROUNDING_ANGLE = 1e-6

# An axis is hidden if this share of it lies in directions that are not revealed.
_HIDDEN_SHARE = 0.1

# Standard deviations (m, rad) above which an axis is weak.
WEAK = (0.05, float(np.radians(1.0)))
# Standard deviation (m or rad) above which an axis is unobservable: its value is of no use.
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
        x, y, z, roll, pitch, yaw in the parent sensor's frame.
    contradictions : mapping
        Axis name to the distance between prior and motion in standard deviations, for axes on which
        both contradict each other. The prior of these axes is ignored.
    from_motion : (6, 6) array
        Share of an error of the estimate from motion that remains in the result, by xi: the
        identity without a prior, zero along directions that only a prior determines.
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
        """Return the allowance (6, 6) of the result from that of the estimate from motion."""
        return self.from_motion @ of_motion @ self.from_motion.T


def assess(
    pairs: MotionPairs, solution: Solution, solve_without: Callable[[BoolArray], FloatArray]
) -> Assessment:
    """Assess the solution of K motion pairs.

    Parameters
    ----------
    pairs : MotionPairs
        In order of time.
    solution : Solution
    solve_without : callable
        Returns the answers (B, 4, 4) without the pairs in each row of a mask (B, K). The jackknife
        uses it if there are enough pairs.
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


def assess_adaptive(pose_pairs: PosePairs, solution: AdaptiveSolution) -> Assessment:
    """Assess a solution of the adaptive estimator for these poses."""
    T_parent_child = solution.T_parent_child
    covariance = widened_by_blocks(solution.cov_parent_child_in_child, solution, slice(0, 6))
    least_share = _MIN_SHARE
    if not solution.is_noise_dominated:
        # Rotations exceed the noise of single poses: the tilt of the axis is estimated, and half
        # the share is enough.
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


def assess_rotation(Ts_pw_p: FloatArray, solution: AdaptiveSolution) -> Assessment:
    """Assess a solution of the adaptive estimator from rotations alone.

    The translation is unknown. If the sensors rotate about only one axis, the rotation about this
    axis is unknown, too: it is the axis along which a lever arm would be hidden.

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
    unseen = [phi for phi in solution.unseen[part].T if np.linalg.norm(phi) > _SHARE_OF_ROTATION]
    lone_axes = _hidden_by_noise(
        Ts_pw_p, solution.T_parent_child, solution.jumps, solution.rotation_variance
    )
    rotations = [np.r_[np.zeros(3), phi] for phi in (*unseen, *lone_axes)]
    return combined(solution.T_parent_child, covariance, basis([*np.eye(6)[:3], *rotations]))


def assess_lever_arm(
    Ts: FloatArray,
    solution: ModelSolution,
    T: FloatArray,
    covariance: FloatArray,
    of_faults: FloatArray,
) -> Assessment:
    """Assess a lever arm in the frame of a sensor with poses.

    Parameters
    ----------
    Ts : (N, 4, 4) array
        Poses of the sensor.
    solution : ModelSolution
    T : (4, 4) array
        The lever arm with the identity for the rotation, which is unknown.
    covariance : (3, 3) array
        Of the lever arm under the noise model.
    of_faults : (3, 3) array
        Covariance that possible faults of the positions add.
    """
    whole = np.zeros((6, 6))
    whole[:3, :3] = widened_by_blocks(covariance, solution, slice(0, 3)) + of_faults
    # Bound the white rotation noise per axis by the differences between steps about the two axes
    # with the smoothest rotation. Positions do not reveal it otherwise: noise of the orientation
    # would look like a small motion that does not move the lever arm.
    rotations = se3.rotation_of(Ts)
    steps = se3.rotations_between(rotations[:-1], rotations[1:])
    # Differences of steps have six times the variance of white noise.
    variances = np.median(np.diff(steps, axis=0) ** 2, axis=0) / CHI2[0.5][1] / 6.0
    white = float(np.sort(variances)[:2].mean())
    walk = np.exp(solution.levels[WALK_ROTATION])
    hidden = _hidden_by_noise(
        Ts, np.eye(4), solution.jumps, lambda n: np.asarray(2.0 * white + n * walk)
    )
    return combined(T, whole, basis([*np.eye(6)[3:], *_translations(hidden)]))


def widened_by_blocks(covariance: FloatArray, solution: ModelSolution, part: slice) -> FloatArray:
    """Widen the model's covariance of a part of xi to the scatter of blocks.

    One factor serves all directions, the mean of their variance ratios: the ratio of a single
    direction scatters too much. Rotations use a factor of their own if it is larger, because the
    noise model easily takes slow rotation errors fixed to a sensor for errors fixed to a world. The
    latter average out while the sensor moves, so the model's covariance is then too small.
    """
    if len(solution.jumps) < BLOCKS * _LEAST_BLOCK_SIZE:
        return covariance
    blocks = Blocks(solution.part_products).merged(BLOCKS)
    answers = NormalEquations(blocks.without()).step
    spread = jackknife_covariance(answers[:, part])
    factors = np.full(len(covariance), max(_mean_ratio(spread, covariance), 1.0))
    if len(covariance) == 6:
        of_rotation = _mean_ratio(spread[3:, 3:], covariance[3:, 3:])
        factors[3:] = np.maximum(factors[3:], of_rotation)
    return covariance * np.sqrt(np.outer(factors, factors))


def _mean_ratio(spread: FloatArray, covariance: FloatArray) -> float:
    """Mean ratio of the variances of two covariances (n, n) over all directions."""
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

    A single increment may be smaller than its noise; sums of increments decide. Long baselines are
    best if the noise is white, short ones if it drifts.

    Parameters
    ----------
    Ts_pw_p : (N, 4, 4) array
    T_parent_child : (4, 4) array
    jumps : (N - 1,) bool array
        Increments that are no evidence.
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
        motions = np.swapaxes(rotations[:-baseline], 1, 2) @ rotations[baseline:]
        # Motions across a jump do not count, unless all of them are.
        weights = (jumps_before[baseline:] == jumps_before[:-baseline]).astype(float)
        if not weights.any():
            weights[:] = 1.0
        chords = (motions - np.eye(3)) @ se3.rotation_of(T_parent_child)
        noise = rotation_variance(baseline) * np.eye(3)
        products = lever_arm_products(chords, weights)
        candidates.append(_hidden_directions(products, noise, least_share).T)
    return min(candidates, key=len)


def _translations(directions: FloatArray) -> FloatArray:
    """Directions (U, 6) of xi from directions (U, 3) of its translation."""
    return np.pad(directions, ((0, 0), (0, 3)))


def _larger(model: FloatArray, resampled: FloatArray) -> FloatArray:
    """Return the larger of two covariances (6, 6), direction by direction."""
    # In coordinates where the model's covariance is the identity, the eigenvalues of the other are
    # the ratios.
    variances, axes = np.linalg.eigh(model)
    root = axes * np.sqrt(np.maximum(variances, ROUNDING_VARIANCE))
    whitened = np.linalg.solve(root, np.linalg.solve(root, resampled).T)
    ratios, vectors = np.linalg.eigh(whitened)
    raised = root @ vectors
    return (raised * np.maximum(ratios, 1.0)) @ raised.T


def combined(T_parent_child: FloatArray, covariance: FloatArray, unknown: FloatArray) -> Assessment:
    """Assess a result from its covariance and the directions that the motion does not reveal.

    Parameters
    ----------
    T_parent_child : (4, 4) array
    covariance : (6, 6) array
        In the child's frame.
    unknown : (6, U) array
        Orthonormal.
    """
    known = np.eye(6) - unknown @ unknown.T
    scaled = UNKNOWN_SIGMAS[:, None] * unknown
    whole = known @ covariance @ known + scaled @ scaled.T
    rotation = se3.rotation_of(T_parent_child)
    sigmas = sigmas_in_parent(rotation, whole)
    unknown_shares = ((se3.block_diagonal(rotation) @ unknown) ** 2).sum(axis=1)
    sigmas = np.where(unknown_shares > _HIDDEN_SHARE, np.inf, sigmas)
    return Assessment(T_parent_child, whole, tuple(map(judged, AXES, sigmas.tolist())))


def without_axes(assessment: Assessment, axes: Collection[str]) -> Assessment:
    """Return an assessment in which these axes of the parent's frame are unobservable."""
    # An unobservable axis keeps its unknown direction, which hardly ever is exactly the axis: a
    # second direction would hide another axis.
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
    # An unobservable translation has this axis as its direction already. The same direction, added
    # again with other rounding, would make a second axis unobservable.
    if any(dof.verdict is DofVerdict.UNOBSERVABLE for dof in assessment.observability[:3]):
        return assessment
    in_child = se3.rotation_of(assessment.T_parent_child).T @ axis
    return _without(assessment, _translations(in_child[None]).T)


def _without(assessment: Assessment, unknown: FloatArray) -> Assessment:
    """Return an assessment in which directions (6, U) of the child are unknown, too."""
    hidden = combined(assessment.T_parent_child, assessment.cov_parent_child_in_child, unknown)
    observability = tuple(
        before if before.verdict is DofVerdict.UNOBSERVABLE else after
        for before, after in zip(assessment.observability, hidden.observability, strict=True)
    )
    return replace(hidden, observability=observability)


def model_covariance(pairs: MotionPairs, solution: Solution) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (6, 6) for independent errors of the pairs, and the unknown directions.

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
    variance_t = (weights @ (residual_t**2).sum(axis=1)) / (3 * n_effective)
    cov_r = (weights[:, None] * residual_r).T @ residual_r / n_effective
    variance_r = np.trace(cov_r) / 3

    jacobian_t, jacobian_r = _derivatives(pairs, se3.rotation_of(solution.T_parent_child))
    weight_of_pair = weights[:, None, None]
    information_t = multiplied(weight_of_pair * jacobian_t, jacobian_t)
    information_r = np.zeros((6, 6))
    information_r[3:, 3:] = multiplied(weight_of_pair * jacobian_r, jacobian_r)

    hessian = information_t + 2 * information_r
    values, vectors = np.linalg.eigh(hessian)
    rounding = max(_RANK_TOLERANCE * values[-1], weights.sum() * _ROUNDING_ANGLE**2)
    is_seen = values > rounding
    inverse_values = np.divide(1.0, values, out=np.zeros(6), where=is_seen)
    inverse = (vectors * inverse_values) @ vectors.T
    covariance = inverse @ (variance_t * information_t + 4 * variance_r * information_r) @ inverse

    hidden = _hidden_directions(lever_arm_products(jacobian_t[..., :3], weights), cov_r).T
    return covariance, basis([*_translations(hidden), *vectors[:, ~is_seen].T])


def _derivatives(pairs: MotionPairs, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the residuals of motion pairs.

    Returns
    -------
    of_translation : (K, 3, 6) array
        Derivatives with respect to xi = (rho, phi).
    of_rotation : (K, 3, 3) array
        Derivatives with respect to phi, in axes that differ from pair to pair by a rotation. Such a
        rotation does not change products J' J.
    """
    # A chord is R_A - I.
    chords = se3.rotation_of(pairs.Ts_parenti_parentj) - np.eye(3)
    by_phi = rotation @ se3.skew(se3.translation_of(pairs.Ts_childi_childj))
    of_rotation = se3.rotation_of(pairs.Ts_childi_childj) - np.eye(3)
    return np.concatenate([chords @ rotation, by_phi], axis=2), of_rotation


def lever_arm_products(chords: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Return S (3, 3), the mean product of the chords of motions.

    Parameters
    ----------
    chords : (K, 3, 3) array
        R - I of each motion; (R - I) Q for lever arms in a frame that Q rotates from.
    weights : (K,) array, optional
        1 by default.
    """
    weights = np.ones(len(chords)) if weights is None else weights
    total = multiplied(weights[:, None, None] * chords, chords)
    return total / max(float(weights.sum()), 1.0)


def _hidden_directions(
    products: FloatArray, cov_rotation: FloatArray, least_share: float = _MIN_SHARE
) -> FloatArray:
    """Return the directions (3, U) of lever arms that rotations do not reveal.

    Parameters
    ----------
    products : (3, 3) array
        :func:`lever_arm_products` of the motions.
    cov_rotation : (3, 3) array
        Covariance C of the rotation errors, rad^2, in the frame of the lever arms. An error e moves
        a lever arm d by ``e x d``, with the mean square ``d' (tr(C) I - C) d``.
    least_share : float
        Least displacement, as a share of that along the direction that moves most.
    """
    powers, directions = np.linalg.eigh(products)
    noise = np.trace(cov_rotation) * np.eye(3) - cov_rotation + _ROUNDING_ANGLE**2 * np.eye(3)
    noise_powers = _MIN_SIGNAL_TO_NOISE * np.diag(directions.T @ noise @ directions)
    return directions[:, powers < np.maximum(noise_powers, least_share**2 * powers[-1])]


def hidden_axes(products: FloatArray, cov_rotation: FloatArray | None = None) -> tuple[str, ...]:
    """Return the names of the axes x, y, z that lie too far in hidden directions.

    Parameters
    ----------
    products : (3, 3) array
        :func:`lever_arm_products` of the motions.
    cov_rotation : (3, 3) array, optional
        Covariance of the rotation errors, rad^2; zero by default.
    """
    cov_rotation = np.zeros((3, 3)) if cov_rotation is None else cov_rotation
    shares = (_hidden_directions(products, cov_rotation) ** 2).sum(axis=1)
    return tuple(axis for axis, share in zip("xyz", shares, strict=True) if share > _HIDDEN_SHARE)


def basis(directions: list[FloatArray]) -> FloatArray:
    """Return an orthonormal basis (6, U) of directions (6,), which may be linearly dependent."""
    if not directions:
        return np.zeros((6, 0))
    left, sizes, _ = np.linalg.svd(np.array(directions).T, full_matrices=False)
    return left[:, sizes > 1e-6 * sizes[0]]


def judged(axis: str, sigma: float) -> DofObservability:
    """Judge an axis by its standard deviation (m or rad): observed, weak or unobservable."""
    if sigma > UNOBSERVABLE:
        return DofObservability(axis, DofVerdict.UNOBSERVABLE, float("inf"))
    is_weak = sigma > WEAK[axis in ROTATIONS]
    verdict = DofVerdict.WEAK if is_weak else DofVerdict.OBSERVED
    return DofObservability(axis, verdict, sigma)


# -------------------------------------------------------------------- the common-mode floor

# Standard deviation along each axis (m): odometries on real recordings with a known extrinsic agree
# to this on where the frame of a sensor is.
FLOOR_TRANSLATION = 0.005
# Standard deviation about each axis (rad), from the same recordings.
FLOOR_ROTATION = float(np.radians(0.15))
# Prior standard deviation of the scale of a path that is not part of the model.
FLOOR_SCALE = 0.01
# Standard deviation along each axis per speed (s). Rotations of an odometry are right to 0.25 %.
# The odometry moves its own centre by this share of the distance of what it observes, about two
# seconds of travel. Of ten real rigs, those on roads agree with 5 to 15 ms: centres are 6 to 14 cm
# off there, and 1 cm in rooms.
FLOOR_TRAVEL_S = 0.005

# Speeds are means over this time (s), so that noise between neighbouring poses counts little.
_SPEED_OVER_S = 1.0

# Information below this share of the largest is noise: such directions are unknown anyway.
_MIN_INFORMATION = 1e-6


def common_mode_floor(speed_m_s: float = 0.0) -> FloatArray:
    """Return the common-mode floor for a scale that is part of the model.

    Parameters
    ----------
    speed_m_s : float
        Usual speed of the recording.

    Returns
    -------
    (6, 6) array
        Covariance of xi = (rho, phi), in the child sensor's frame.
    """
    translation = FLOOR_TRANSLATION**2 + (FLOOR_TRAVEL_S * speed_m_s) ** 2
    return np.diag(np.repeat([translation, FLOOR_ROTATION**2], 3))


def usual_speed(stamps_ns: IntArray, positions: FloatArray) -> float:
    """Return the speed (m/s) above which half of the path is driven.

    Neither stops nor jumps change it.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    positions : (N, 3) array
    """
    step_s = median(np.diff(stamps_ns)) * 1e-9 if len(stamps_ns) > 1 else 1.0
    stride = max(1, round(_SPEED_OVER_S / step_s))
    durations_s = np.diff(stamps_ns[::stride]) * 1e-9
    lengths_m = np.linalg.norm(np.diff(positions[::stride], axis=0), axis=1)
    if not lengths_m.any():
        return 0.0
    speeds = lengths_m / durations_s
    order = np.argsort(speeds)
    driven_m = np.cumsum(lengths_m[order])
    middle = np.searchsorted(driven_m, driven_m[-1] / 2)
    return float(speeds[order[middle]])


def open_scale_floor(by_scale: FloatArray, scale_variance: float) -> FloatArray:
    """Return the part of the floor (6, 6) of a scale outside the model.

    Parameters
    ----------
    by_scale : (6,) array
        Derivative of the answer with respect to the logarithm of the scale of the child's path.
    scale_variance : float
        Variance of this scale, by the data alone.
    """
    open_variance = FLOOR_SCALE**2 * scale_variance / (FLOOR_SCALE**2 + scale_variance)
    return open_variance * np.outer(by_scale, by_scale)


def floor_of_pairs(
    pairs: MotionPairs, weights: FloatArray, T_parent_child: FloatArray, speed_m_s: float
) -> FloatArray:
    """Return the floor (6, 6) of an answer that minimises the squared residuals of motion pairs.

    With the child's translations times s, the residual ``(R_A - I) t + t_A - s R t_B`` changes by
    ``-R t_B ds``. Overlapping pairs are as much evidence of the scale as separate ones.

    Parameters
    ----------
    pairs : MotionPairs
        K motion pairs.
    weights : (K,) array
    T_parent_child : (4, 4) array
    speed_m_s : float
        Usual speed of the recording.
    """
    rotation = se3.rotation_of(T_parent_child)
    by_xi, of_rotation = _derivatives(pairs, rotation)
    by_log_scale = (se3.translation_of(pairs.Ts_childi_childj) @ rotation.T)[:, :, None]
    residuals = pairs.residuals(T_parent_child)[0][:, :, None]
    columns = np.concatenate([by_xi, by_log_scale, residuals], axis=2)
    weight_of_pair = weights[:, None, None]
    products = multiplied(weight_of_pair * columns, columns)
    information = products[:6, :6].copy()
    information[3:, 3:] += 2 * multiplied(weight_of_pair * of_rotation, of_rotation)
    coupling = products[:6, 6]
    by_scale = np.linalg.pinv(information, rcond=_MIN_INFORMATION, hermitian=True) @ coupling
    scale_information = max(float(products[6, 6] - coupling @ by_scale), 1e-30)
    overlap = float(np.mean(pairs.j - pairs.i)) if len(pairs) else 1.0
    variance = overlap * products[7, 7] / max(3.0 * float(weights.sum()) - 7.0, 1.0)
    scale_variance = float(variance / scale_information)
    return common_mode_floor(speed_m_s) + open_scale_floor(by_scale, scale_variance)
