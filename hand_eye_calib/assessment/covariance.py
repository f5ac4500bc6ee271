"""How far an answer may be from the truth: a 6 x 6 covariance and a verdict per degree of freedom.

Two estimates are made and the larger one holds, direction by direction:

- the model's: of the adaptive estimator its own; of other methods that of motion pairs with independent, equally large errors, carried
  through the cost to first order;
- the delete-a-block jackknife: the answer with each tenth of the drive left out in turn. It does not believe the noise model, and sees
  what lasts for many pairs (drift, bad stretches), to which the model is blind.
"""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.adaptive.estimator import solve_without
from hand_eye_calib.calibration import DofObservability, DofVerdict
from hand_eye_calib.geometry import se3

_BLOCKS = 10
_FEWEST_BLOCKS, _FEWEST_PAIRS_PER_BLOCK = 4, 3

# Standard deviations that say "unknown" in the covariance: as far as sensors are apart on a large
# machine. The unknown direction is never quite an axis of the parent sensor, and what is assumed of
# it leaks into the other two; more than this would drown what is known of them. The verdicts carry
# the plain statement.
UNKNOWN_TRANSLATION = 3.0
UNKNOWN_ROTATION = np.pi
UNKNOWN_SIGMAS = np.r_[np.full(3, UNKNOWN_TRANSLATION), np.full(3, UNKNOWN_ROTATION)]

# A translation direction counts as observed when the rotations that reveal it have this many times
# the power of the rotation errors themselves; below, noise alone would look like that motion.
_LEAST_SIGNAL_TO_NOISE = 3.0

# Nor does it where all rotation is about that direction but for this share (2 deg): odometries are
# wrong by a per cent or two of the turn, and such errors last, so that the residuals do not show
# them.
_NEARLY_ONE_AXIS = 0.04

# Rotation errors are never taken to be smaller than this (rad): rounding, not motion.
_ROUNDING_ANGLE = 1e-6

# Nor variances smaller than this (m^2 or rad^2).
_ROUNDING_VARIANCE = 1e-24

# Information below this share of the largest is rounding.
_RANK_TOLERANCE = 1e-12

# Share of an axis that may lie in unknown directions before the axis itself counts as unobservable.
_UNKNOWN_SHARE = 0.1

# Beyond these an observed axis is called weak; beyond the last a rotation is not observed at all.
WEAK_TRANSLATION = 0.05
WEAK_ROTATION = np.radians(1.0)
_LOST_ROTATION = 0.3

AXES = ("x", "y", "z", "roll", "pitch", "yaw")


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

    cov_parent_child_in_child: np.ndarray
    observability: tuple


def assess(pairs, solution, solve_without):
    """Covariance and observability of a solution.

    Parameters
    ----------
    pairs : MotionPairs
        K pairs in order of time.
    solution : Solution
        Their solution.
    solve_without : callable
        ``solve_without(left_out)`` gives the answers (B, 4, 4) without the pairs in each row of
        ``left_out`` (B, K).

    Returns
    -------
    Assessment
    """
    model, unknown = model_covariance(pairs, solution)
    resampled = jackknife_covariance(len(pairs), solution.T_parent_child, solve_without)
    return _combine(solution.T_parent_child, model, resampled, unknown)


def assess_adaptive(pose_pairs, solution):
    """Covariance and observability of an answer of the adaptive estimator.

    Parameters
    ----------
    pose_pairs : PosePairs
    solution : AdaptiveSolution
        Its answer for these poses.

    Returns
    -------
    Assessment
    """
    poses = pose_pairs.stamps_ns, pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c
    resampled = jackknife_covariance(
        len(solution.jumps),
        solution.T_parent_child,
        lambda left_out: solve_without(*poses, solution, left_out),
    )
    unseen = [*solution.unseen.T, *_noise_driven_baselines(pose_pairs.Ts_pw_p, solution)]
    covariance = solution.cov_parent_child_in_child
    return _combine(solution.T_parent_child, covariance, resampled, _basis(unseen))


def _noise_driven_baselines(Ts_pw_p, solution):
    """Directions (6,) of translation that rotations over no baseline lift out of the rotation
    noise.

    The adaptive estimator weighs increments, each of which may well drown in noise; what counts is
    the best that sums of them can do: long ones where the noise is white, short ones where it
    drifts.
    """
    longest = max(len(Ts_pw_p) // _BLOCKS, 1)
    baselines = sorted({*np.geomspace(1, longest, 4).astype(int).tolist()}, reverse=True)
    found = [_noise_driven_over(baseline, Ts_pw_p[:, :3, :3], solution) for baseline in baselines]
    return min(found, key=len)


def _noise_driven_over(baseline, rotation, solution):
    motions = np.swapaxes(rotation[:-baseline], 1, 2) @ rotation[baseline:]
    # No baseline may run across a jump, unless all of them do.
    jumps_before = np.concatenate([[0], np.cumsum(solution.jumps)])
    weights = (jumps_before[baseline:] == jumps_before[:-baseline]).astype(float)
    if not weights.any():
        weights[:] = 1.0
    variance = 2 * solution.noise.rotation_white**2 + baseline * solution.noise.rotation_drift**2
    moved = (motions - np.eye(3)) @ solution.T_parent_child[:3, :3]
    return _noise_driven_translations(weights, moved, variance * np.eye(3))


def _combine(T_parent_child, model, resampled, unknown):
    known = np.eye(6) - unknown @ unknown.T
    covariance = known @ larger_by_direction(model, resampled) @ known + _unknown_variance(unknown)
    return Assessment(covariance, _verdicts(T_parent_child[:3, :3], covariance, unknown))


def model_covariance(pairs, solution):
    """Covariance if the pairs' errors were independent and alike.

    The cost is ``|r_t|^2 + 2 |r_R|^2`` with the residual translation r_t and the residual rotation
    vector r_R. With their Jacobians J_t, J_R and the variances s_t^2, s_R^2 of the residuals, an
    estimate that minimises the weighted sum has covariance ``H^-1 (s_t^2 J_t'J_t + 4 s_R^2 J_R'J_R)
    H^-1``, ``H = J_t'J_t + 2 J_R'J_R``.

    Returns
    -------
    covariance : (6, 6) array
        Zero along directions that no pair says anything about.
    unknown : (6, U) array
        Orthonormal basis of the directions that the motion does not reveal, or no better than noise
        would.
    """
    weights = solution.weights
    n_effective = max(float(weights.sum()) - 3.0, 1.0)
    rotation, translation = solution.T_parent_child[:3, :3], solution.T_parent_child[:3, 3]
    rotation_a, rotation_b = pairs.Ts_parenti_parentj[:, :3, :3], pairs.Ts_childi_childj[:, :3, :3]
    translation_b = pairs.Ts_childi_childj[:, :3, 3]
    moved = rotation_a - np.eye(3)

    residual_t = (
        moved @ translation + pairs.Ts_parenti_parentj[:, :3, 3] - translation_b @ rotation.T
    )
    residual_r = se3.rotation_log(
        np.swapaxes(rotation_a @ rotation, 1, 2) @ (rotation @ rotation_b)
    )  # child axes at j
    variance_t = (weights @ (residual_t**2).sum(axis=1)) / (3 * n_effective)
    cov_r = np.einsum("k,ki,kj->ij", weights, residual_r, residual_r) / n_effective
    variance_r = np.trace(cov_r) / 3

    jacobian_t = np.concatenate([moved @ rotation, rotation @ se3.skew(translation_b)], axis=2)
    information_t = np.einsum("k,kai,kaj->ij", weights, jacobian_t, jacobian_t)
    jacobian_r = np.swapaxes(rotation_b, 1, 2) - np.eye(3)
    information_r = np.zeros((6, 6))
    information_r[3:, 3:] = np.einsum("k,kai,kaj->ij", weights, jacobian_r, jacobian_r)

    hessian = information_t + 2 * information_r
    values, vectors = np.linalg.eigh(hessian)
    seen = values > max(_RANK_TOLERANCE * values[-1], weights.sum() * _ROUNDING_ANGLE**2)
    inverse = (vectors * np.where(seen, 1.0 / np.where(seen, values, 1.0), 0.0)) @ vectors.T
    covariance = inverse @ (variance_t * information_t + 4 * variance_r * information_r) @ inverse

    unseen = _noise_driven_translations(weights, moved @ rotation, cov_r) + list(
        vectors[:, ~seen].T
    )
    return covariance, _basis(unseen)


def _noise_driven_translations(weights, moved_in_child, cov_r):
    """Directions (6,) of translation whose only evidence is rotation noise.

    Noise e in a rotation moves a lever d by ``e x d``; its mean square is ``d' (tr(C) I - C) d``
    with the covariance C of e.
    """
    signal = np.einsum("k,kai,kaj->ij", weights, moved_in_child, moved_in_child) / max(
        float(weights.sum()), 1.0
    )
    noise = np.trace(cov_r) * np.eye(3) - cov_r + _ROUNDING_ANGLE**2 * np.eye(3)
    powers, directions = np.linalg.eigh(signal)
    drowned = [
        direction
        for power, direction in zip(powers, directions.T, strict=True)
        if power
        < max(
            _LEAST_SIGNAL_TO_NOISE * (direction @ noise @ direction),
            _NEARLY_ONE_AXIS**2 * powers[-1],
        )
    ]
    return [np.r_[direction, np.zeros(3)] for direction in drowned]


def _basis(directions):
    """Orthonormal basis (6, U) of directions (6,) that may depend on each other: what is found in
    two ways is unknown once.
    """
    if not directions:
        return np.zeros((6, 0))
    left, sizes, _ = np.linalg.svd(np.array(directions).T, full_matrices=False)
    return left[:, sizes > 1e-6 * sizes[0]]


def _unknown_variance(unknown):
    scaled = UNKNOWN_SIGMAS[:, None] * unknown
    return scaled @ scaled.T


def jackknife_covariance(n_pairs, T_parent_child, solve_without):
    """Delete-a-block jackknife covariance (6, 6), or None where there are too few pairs for blocks.

    ``(B - 1) / B * sum (xi_b - mean)(xi_b - mean)'`` over the B answers without a block (Efron,
    Tibshirani, *An introduction to the bootstrap*, 1993, eq. 11.5), with xi_b the tangent vector
    from the full answer.
    """
    n_blocks = min(_BLOCKS, n_pairs // _FEWEST_PAIRS_PER_BLOCK)
    if n_blocks < _FEWEST_BLOCKS:
        return None
    block_of_pair = np.arange(n_pairs) * n_blocks // n_pairs
    left_out = block_of_pair[None, :] == np.arange(n_blocks)[:, None]
    deviations = se3.log(se3.inverse(T_parent_child) @ solve_without(left_out))
    deviations -= deviations.mean(axis=0)
    return (n_blocks - 1) / n_blocks * deviations.T @ deviations


def larger_by_direction(first, second):
    """The first covariance, lifted to the second in every direction where that is larger; second
    may be None.
    """
    if second is None:
        return first
    # In the coordinates where the first is the identity, the eigenvalues of the second are the
    # ratios.
    variances, axes = np.linalg.eigh(first)
    root = axes * np.sqrt(np.maximum(variances, _ROUNDING_VARIANCE))
    values, vectors = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, second).T))
    lifted = root @ vectors
    return (lifted * np.maximum(values, 1.0)) @ lifted.T


def _verdicts(rotation_parent_child, covariance, unknown):
    """Verdicts for the axes of the parent sensor's frame."""
    to_parent = np.kron(np.eye(2), rotation_parent_child)
    sigmas = np.sqrt(np.maximum(np.diag(to_parent @ covariance @ to_parent.T), 0.0))
    unknown_shares = ((to_parent @ unknown) ** 2).sum(axis=1)
    verdicts = []
    for index, (name, sigma, share) in enumerate(zip(AXES, sigmas, unknown_shares, strict=True)):
        turns = index >= 3
        if share > _UNKNOWN_SHARE or (turns and sigma > _LOST_ROTATION):
            verdicts.append(DofObservability(name, DofVerdict.UNOBSERVABLE, float("inf")))
        else:
            weak = sigma > (WEAK_ROTATION if turns else WEAK_TRANSLATION)
            verdicts.append(
                DofObservability(
                    name, DofVerdict.WEAK if weak else DofVerdict.OBSERVED, float(sigma)
                )
            )
    return tuple(verdicts)
