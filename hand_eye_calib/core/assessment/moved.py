"""Test for a shift of the mount: the kernel of comparisons, parts of a recording and the monitor.

A shift d of the extrinsic, ``X exp(d)``, has an estimate with covariance C: information ``H =
C^-1``, score ``S = H d``. With shifts of covariance L expected, the log likelihood ratio of a shift
against none is (a Gaussian form of the generalised likelihood ratio: M. Basseville, I. Nikiforov,
*Detection of abrupt changes*, 1993)

    1/2 S' (H + L^-1)^-1 S - 1/2 log|I + L H|.

H and S are divided before by the long-run variance: how much more S scatters than H predicts. This
ratio serves tests at many times. :mod:`~hand_eye_calib.core.assessment.change` tests each axis,
where a person asks what has moved.

A motion pair within a recording has the residual ``e = Log(B^-1 X0^-1 A X0)`` (6,) at an extrinsic
X0. If the mount has moved by xi, to ``X0 exp(xi)``, then ``e = -J xi + noise`` with ``J = I -
Ad(B^-1)``. With the noise covariance C each second has ``H = sum J' C^-1 J`` and ``S = -sum J' C^-1
e``; both add over time. Large residuals have less weight, so a large shift comes out too small:
compute the information again at the extrinsic that the shift leads to.

Successive motions have correlated noise, which the long-run variance measures. Errors that wander
over minutes, such as a bias or a map that bends, also give a large ratio. The stream checks compare
how well a moving world explains the motion. Answers of one rig scatter between recordings by more
than their covariances, because constant errors do not show within a recording. This scatter belongs
to C (docs/session.md has the measurements).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base import stats
from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.blocks import (
    Blocks,
    answer_evidence,
    information,
    inverse,
    score,
)
from hand_eye_calib.core.base.text import angle, length
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise.normal import NormalEquations
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, PosePairs, pairs_over

# Expected shifts: one standard deviation per axis (m, rad).
_SHIFT_M = 0.03
_SHIFT_RAD = float(np.radians(1.0))

# Scatter between recordings of one rig per axis (m, rad): of flights and hand-held recordings.
_SCATTER_IN_HAND = np.repeat([0.008, np.radians(0.12)], 3)
# The same of vehicles.
_SCATTER_OF_VEHICLES = np.repeat([0.020, np.radians(0.10)], 3)
# A vehicle turns about one axis: the standard deviation of the translation along this axis is
# larger than the others by this factor.
_VEHICLE = 4.0

# Time over which motions are compared, and in which their evidence is added (ns).
_BLOCK_NS = 1_000_000_000
# Largest number of motions in this time.
_MOTIONS_PER_BLOCK = 20

# Rounds of the estimate of the noise.
_ROUNDS = 4
# Smallest standard deviations of residuals (m, rad).
_LEAST_SIGMA = np.repeat([1e-6, 1e-7], 3)

# Number of windows of equal duration in a recording for the long-run variance.
_WINDOWS = (8, 16)
# Fewest windows on either side of a shift.
_LEAST_WINDOWS = 2
# Shortest window (s).
_LEAST_WINDOW_S = 3.0

# Log likelihood ratio from which on a shift is significant.
SIGNIFICANT = 12.0

# Prior probability that a mount moves within a recording.
_MOVES = 0.02
# Fewest parts of a recording before and after a shift.
_LEAST_PARTS = 4
# A smaller probability of a shift is zero.
_LEAST_PROBABILITY = 1e-3

# Information of the expected shifts within a recording, as a share of the full one: without it,
# shifts of many metres are possible.
_RIDGE = 1e-6


def scatter_of_recordings(covariance: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) between recordings of one rig, to be added to that of one.

    The covariance (6, 6) of one recording reveals whether the rig is a vehicle.
    """
    variances = np.linalg.eigvalsh(covariance[:3, :3])
    is_vehicle = variances[2] > _VEHICLE**2 * variances[1]
    return np.diag((_SCATTER_OF_VEHICLES if is_vehicle else _SCATTER_IN_HAND) ** 2)


def shift_covariance(metres: float = _SHIFT_M, radians: float = _SHIFT_RAD) -> FloatArray:
    """Return the covariance L (6, 6) of expected shifts from standard deviations per axis."""
    return np.diag(np.repeat([metres**2, radians**2], 3))


_EXPECTED_SHIFTS = shift_covariance()
#: Information of the expected shifts, the inverse of their covariance.
SHIFT_INFORMATION = inverse(_EXPECTED_SHIFTS)


def log_ratio(tables: FloatArray, L: FloatArray = _EXPECTED_SHIFTS) -> FloatArray:
    """Return the log likelihood ratio (...) of a shift against none.

    Parameters
    ----------
    tables : (..., 6, 7) array
        Evidence ``[H S]`` since the possible shift.
    L : (..., 6, 6) array
        Covariance of the expected shifts.
    """
    H = information(tables)
    S = score(tables)
    log_volume = np.linalg.slogdet(np.eye(6) + L @ H)[1]
    squared = (S * _solve(H + np.linalg.inv(L), S)).sum(axis=-1)
    return 0.5 * squared - 0.5 * log_volume


def _solve(H: FloatArray, S: FloatArray) -> FloatArray:
    """Return ``H^-1 S`` (..., n) of matrices (..., n, n) and vectors (..., n)."""
    # NumPy 1 takes the columns for vectors unless both arrays have as many dimensions.
    columns = np.broadcast_to(S, np.broadcast_shapes(S.shape, H.shape[:-1]))[..., None]
    try:
        solved = np.linalg.solve(H, columns)
    except np.linalg.LinAlgError:
        # Exact poses have so much evidence along some directions that the others are rounding.
        solved = np.linalg.pinv(H) @ columns
    return np.asarray(solved[..., 0])


def most_likely(tables: FloatArray, ridge: float) -> FloatArray:
    """Return the most likely shifts (..., 6) by evidence ``[H S]`` (..., 6, 7).

    ``ridge`` is the share of the information of the expected shifts that is added.
    """
    return _solve(information(tables) + ridge * SHIFT_INFORMATION, score(tables))


def squares_about(tables: FloatArray, shifts: FloatArray, ridge: float) -> FloatArray:
    """Return the squared distances (...) of evidence ``[H S]`` (..., 6, 7) from shifts (..., 6).

    The unit is the covariance of the evidence. ``ridge`` is as in :func:`most_likely`.
    """
    H = information(tables)
    scores = score(tables) - se3.times(H, shifts)
    return np.asarray((scores * _solve(H + ridge * SHIFT_INFORMATION, scores)).sum(axis=-1))


# ---------------------------------------------------------------- within a recording


@dataclass(frozen=True, kw_only=True)
class MountChange:
    """A shift of the mount within a recording.

    Attributes
    ----------
    at_ns : int
        Stamp of the shift on the parent's clock.
    xi : (6,) array
        The shift (rho, phi) in the child sensor's frame, m and rad: the extrinsic is ``X`` before
        and ``X exp(xi)`` afterwards.
    covariance : (6, 6) array
        Of xi, with the long-run variance.
    log_ratio : float
        Log likelihood ratio of this shift against none.
    """

    at_ns: int
    xi: FloatArray
    covariance: FloatArray
    log_ratio: float


def residuals_and_jacobians(
    pairs: MotionPairs, T_parent_child: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return residuals e (K, 6) of motion pairs at an extrinsic X0, and J (K, 6, 6).

    If the mount has moved to ``X0 exp(xi)``, then ``e = -J xi + noise``. So J is the derivative of
    e with respect to X0, and the negative derivative with respect to the true extrinsic.
    """
    Bs_inverse = se3.inverse(pairs.Ts_childi_childj)
    Bs_predicted = se3.inverse(T_parent_child) @ pairs.Ts_parenti_parentj @ T_parent_child
    return se3.log(Bs_inverse @ Bs_predicted), np.eye(6) - se3.adjoint(Bs_inverse)


def evidence(
    residuals: FloatArray, jacobians: FloatArray, noise: FloatArray, weights: FloatArray
) -> FloatArray:
    """Return the evidence ``[H S]`` (K, p, p + 1) of motion pairs on p parameters.

    Parameters
    ----------
    residuals : (K, 6) array
    jacobians : (K, 6, p) array
        J of ``residuals = -J parameters + noise``.
    noise : (6, 6) array
        Covariance of the residuals.
    weights : (K,) array
    """
    whitened = np.swapaxes(jacobians, 1, 2) @ np.linalg.inv(noise)
    columns = np.concatenate([jacobians, -residuals[..., None]], axis=2)
    return (whitened * weights[:, None, None]) @ columns


def noise_covariance(residuals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Estimate the covariance (6, 6) of residuals (K, 6) with Student's t noise.

    The second value are the weights (K,) of the residuals: 1 on average, small for jumps.
    """
    sigmas = np.repeat([stats.robust_sigma(part) for part in np.split(residuals, 2, axis=1)], 3)
    covariance = np.diag(np.maximum(sigmas, _LEAST_SIGMA) ** 2)
    for _ in range(_ROUNDS):
        squared = np.einsum("ki,ki->k", residuals @ np.linalg.inv(covariance), residuals)
        weights = stats.robust_weights("student", squared)
        scatter = (weights[:, None] * residuals).T @ residuals / len(residuals)
        covariance = scatter + np.diag(_LEAST_SIGMA**2)
    return covariance, weights


def find_change(pose_pairs: PosePairs, T_parent_child: FloatArray) -> MountChange | None:
    """Return the most likely shift of the mount within a recording; None if it is too short.

    The answers before and after every possible time are compared. The scatter of windows about the
    answer of their side, in windows of a sixteenth and of an eighth of the recording, is the
    long-run variance: noise that wanders is no shift.

    Parameters
    ----------
    pose_pairs : PosePairs
        On one clock and in one unit of length.
    T_parent_child : (4, 4) array
        X0, near the extrinsic.
    """
    starts_ns, blocks = evidence_by_second(pose_pairs, T_parent_child)
    n_blocks = len(starts_ns)
    long_run = _long_run_variance_of(blocks)
    if long_run is None:
        return None
    shifts = blocks.shift_since(np.arange(1, n_blocks), _RIDGE * SHIFT_INFORMATION)
    ratios = log_ratio(shifts / long_run)
    n_edge = max(int(n_blocks * _LEAST_WINDOWS / max(_WINDOWS)), 1)
    ratios[: n_edge - 1] = -np.inf
    ratios[len(ratios) - n_edge + 1 :] = -np.inf
    best = int(np.argmax(ratios))
    damped = information(shifts[best]) + _RIDGE * SHIFT_INFORMATION
    return MountChange(
        at_ns=int(starts_ns[best + 1]),
        xi=most_likely(shifts[best], _RIDGE),
        covariance=long_run * inverse(damped),
        log_ratio=float(ratios[best]),
    )


def shifts_at(blocks: Blocks, cuts: IntArray) -> FloatArray | None:
    """Return the evidence (C, 6, 7) of a shift at each cut (C,), for :func:`log_ratio`.

    It is divided by the long-run variance. None if the recording is too short.

    Parameters
    ----------
    blocks : Blocks
        Evidence by second.
    cuts : (C,) int array
        Indices of the first second after a shift.
    """
    long_run = _long_run_variance_of(blocks)
    if long_run is None:
        return None
    return blocks.shift_since(cuts, _RIDGE * SHIFT_INFORMATION) / long_run


def _long_run_variance_of(blocks: Blocks) -> float | None:
    """Return the long-run variance of evidence by second; None if there are too few seconds."""
    counts = [count for count in _WINDOWS if len(blocks.sums) >= count * _LEAST_WINDOW_S]
    if not counts:
        return None
    return max(1.0, *(_long_run_variance(blocks.merged(count)) for count in counts))


def _long_run_variance(windows: Blocks) -> float:
    """Return the long-run variance of the scores of windows, in units of their information.

    The scores are taken about the answers before and since a time. The time with the smallest
    variance counts.
    """
    n_windows = len(windows.sums)
    cuts = np.arange(_LEAST_WINDOWS, n_windows - _LEAST_WINDOWS + 1)
    sides = np.stack([windows.before(cuts), windows.since(cuts)], axis=1)
    side_of_window = (np.arange(n_windows) >= cuts[:, None]).astype(int)
    answers = most_likely(sides, _RIDGE)[np.arange(len(cuts))[:, None], side_of_window]
    has_evidence = np.trace(information(windows.sums), axis1=1, axis2=2) > 0
    squares = squares_about(windows.sums[has_evidence], answers[:, has_evidence], _RIDGE)
    # Six values a window, less six of each answer.
    dof = max(6 * int(has_evidence.sum()) - 12, 1)
    return float(squares.sum(axis=1).min()) / dof


def evidence_by_second(
    pose_pairs: PosePairs,
    T_parent_child: FloatArray,
    further_columns: Callable[[MotionPairs], FloatArray] | None = None,
) -> tuple[IntArray, Blocks]:
    """Return the starts (N,) of the seconds of a recording, and their evidence ``[H S]``.

    ``further_columns`` returns columns (K, 6, q) of J for q unknowns beside xi.
    """
    stamps_ns = pose_pairs.stamps_ns
    duration_ns = int(stamps_ns[-1] - stamps_ns[0])
    lag_s = max(_BLOCK_NS, stats.median(np.diff(stamps_ns))) * 1e-9
    most_motions = max(duration_ns * _MOTIONS_PER_BLOCK // _BLOCK_NS, 2)
    pairs = pairs_over(pose_pairs, lag_s, most_motions)
    residuals, jacobians = residuals_and_jacobians(pairs, T_parent_child)
    covariance, weights = noise_covariance(residuals)
    if further_columns:
        jacobians = np.concatenate([jacobians, further_columns(pairs)], axis=2)
    tables = evidence(residuals, jacobians, covariance, weights)
    middles_ns = (stamps_ns[pairs.i] + stamps_ns[pairs.j]) // 2
    block_of_pair = (middles_ns - stamps_ns[0]) // _BLOCK_NS
    n_blocks = duration_ns // _BLOCK_NS + 1
    starts_ns = stamps_ns[0] + np.arange(n_blocks) * _BLOCK_NS
    return starts_ns, Blocks.gathered(tables, block_of_pair, n_blocks)


def possible_shift(products: FloatArray, misfit: float) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the covariance because of a possible shift of the mount, and a warning.

    The answers before and after each time are compared under the noise model of the estimate. The
    likelihood ratio of a shift, averaged over the times, gives its probability. An answer between
    both mounts is half of the shift away from either.

    Parameters
    ----------
    products : (K, p + 1, p + 1) array
        Of :func:`~hand_eye_calib.core.noise.state_space.part_products`.
    misfit : float
        Factor of the covariances.

    Returns
    -------
    covariance : (6, 6) array
        Of xi in ``X exp(xi)``; zero if a shift is improbable.
    warnings : tuple of str
        One if a shift larger than the scatter of recordings is more likely than not.
    """
    cuts = np.arange(_LEAST_PARTS, len(products) - _LEAST_PARTS + 1)
    before = NormalEquations(Blocks(products).before(cuts))
    after = NormalEquations(Blocks(products).since(cuts))
    is_complete = before.is_complete & after.is_complete
    if not is_complete.any():
        return np.zeros((6, 6)), ()
    covariances = max(misfit, 1.0) * (before.covariance + after.covariance)[is_complete, :6, :6]
    steps = (after.step - before.step)[is_complete, :6]
    tables = answer_evidence(steps, covariances)
    ratios = log_ratio(tables)
    probability = _probability(ratios)
    if probability < _LEAST_PROBABILITY:
        return np.zeros((6, 6)), ()
    shifts = most_likely(tables, 1.0)
    weights = np.exp(ratios - ratios.max())
    squared = np.einsum("k,ki,kj->ij", weights / weights.sum(), shifts, shifts)
    spread = probability * squared / 4.0
    scattered = covariances + scatter_of_recordings(covariances[len(covariances) // 2])
    if _probability(log_ratio(answer_evidence(steps, scattered))) < 0.5:
        return spread, ()
    best = int(np.argmax(ratios))
    share = int(cuts[is_complete][best]) / len(products)
    return spread, (_parts_differ(share, shifts[best]),)


def _parts_differ(share: float, xi: FloatArray) -> str:
    """Return the warning about a shift xi (6,) after a share of the recording."""
    metres = length(float(np.linalg.norm(xi[:3])))
    turn = angle(float(np.linalg.norm(xi[3:])))
    return (
        f"The first {share:.0%} and the last {1 - share:.0%} of the recording give different "
        f"results ({metres}, {turn}). Perhaps a sensor moved, or an odometry got worse. The +/- "
        "values already include half of this."
    )


def _probability(log_ratios: FloatArray) -> float:
    """Return the probability of a shift at one of several times, by the log likelihood ratios."""
    most = log_ratios.max()
    log_odds = most + np.log(np.exp(log_ratios - most).mean() * _MOVES / (1.0 - _MOVES))
    return float(np.exp(-np.logaddexp(0.0, -log_odds)))
