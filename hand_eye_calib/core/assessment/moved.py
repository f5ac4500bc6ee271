"""Test for a shift of the mount, within a recording or between recordings.

Model: a mount that shifts by d changes the extrinsic from X to ``X exp(d)``. An estimate of d with
covariance C has the information ``H = C^-1`` and the score ``S = H d``. If shifts are expected to
have covariance L, the log likelihood ratio of a shift against no shift is

    1/2 S' (H + L^-1)^-1 S - 1/2 log|I + L H|

(Gaussian form of the generalised likelihood ratio: M. Basseville, I. Nikiforov, *Detection of
abrupt changes*, 1993). H and S are first divided by the long-run variance: the factor by which S
scatters more than H predicts. The ratio tests many possible times of a shift.
:mod:`~hand_eye_calib.core.assessment.change` tests single axes, to report which axis has moved.

A motion pair within a recording has the residual ``e = Log(B^-1 X0^-1 A X0)`` (6,) at an extrinsic
X0. If the mount moves to ``X0 exp(xi)``, then ``e = -J xi + noise`` with ``J = I - Ad(B^-1)``. For
the noise covariance C, a second of motion has ``H = sum J' C^-1 J`` and ``S = -sum J' C^-1 e``;
longer times have the sums. Large residuals get less weight. This reduces a small shift by a known
share, and a large shift by more. Therefore H and S are computed again at the shifted extrinsic.

The noise of successive motions is correlated, and the long-run variance measures this. Errors that
drift over minutes, such as a bias or a bent map, also cause a large ratio; so the stream checks
test whether a moving world explains the motion as well. Results of one rig scatter between
recordings by more than their covariances, because constant errors cannot be detected within a
recording. C must include this scatter (docs/session.md has the measurements).
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
from hand_eye_calib.core.noise.partwise import MAX_POSES
from hand_eye_calib.core.pairing.motion_pairs import (
    MotionPairs,
    PosePairs,
    pairs_over,
)

# Prior standard deviation of a shift along each axis (m).
_SHIFT_M = 0.03
# Prior standard deviation of a shift about each axis (rad).
_SHIFT_RAD = float(np.radians(1.0))

# Standard deviation between the results of several recordings of one hand-held rig or aircraft,
# along (m) and about (rad) each axis. Measured.
_SCATTER_IN_HAND = np.repeat([0.008, np.radians(0.12)], 3)
# The same standard deviation for vehicles. Measured.
_SCATTER_OF_VEHICLES = np.repeat([0.020, np.radians(0.10)], 3)
# A rig counts as a vehicle if the standard deviation of its translation along one axis exceeds that
# along the other two axes by this factor: a vehicle turns about this axis only.
_VEHICLE_SIGMA_RATIO = 4.0

# Duration (ns) of a motion pair, and of the blocks of time over which H and S are summed.
_BLOCK_NS = 1_000_000_000
# Largest number of motion pairs per block, on average over the recording.
_MAX_PAIRS_PER_BLOCK = 20

# Number of iterations in the estimate of the noise covariance.
_NOISE_ITERATIONS = 4
# Smallest standard deviations of residuals (m, rad).
_MIN_SIGMAS = np.repeat([1e-6, 1e-7], 3)

# Numbers of equal windows into which a recording is divided for the long-run variance.
_WINDOW_COUNTS = (8, 16)
# Fewest windows on each side of a possible shift.
_MIN_WINDOWS_PER_SIDE = 2
# Shortest window (s).
_MIN_WINDOW_S = 3.0

# Smallest log likelihood ratio of a significant shift.
SIGNIFICANT = 12.0

# Prior probability that a mount moves during a recording.
_PRIOR_PROBABILITY = 0.02
# Fewest parts of a recording on each side of a possible shift.
_MIN_PARTS_PER_SIDE = 4
# A shift with a smaller posterior probability is ignored.
_MIN_PROBABILITY = 1e-3

# Weight of the prior of a shift within a recording, as a share of SHIFT_INFORMATION. It only keeps
# the estimate finite: otherwise, shifts of many metres are possible along unobservable directions.
_PRIOR_SHARE = 1e-6


def scatter_of_recordings(covariance: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of the scatter between recordings of one rig.

    Add it to ``covariance``, the covariance (6, 6) of the result of one recording. The translation
    part of ``covariance`` decides whether the rig counts as a vehicle.
    """
    is_vehicle = counts_as_vehicle(covariance)
    sigmas = _SCATTER_OF_VEHICLES if is_vehicle else _SCATTER_IN_HAND
    return np.diag(sigmas**2)


def counts_as_vehicle(covariance: FloatArray) -> bool:
    """Return whether one translation is much less certain than the others, by a covariance."""
    variances = np.linalg.eigvalsh(covariance[:3, :3])
    return bool(variances[2] > _VEHICLE_SIGMA_RATIO**2 * variances[1])


def scatter_in_words(covariance: FloatArray) -> str:
    """Explain the scatter between recordings for a result with a covariance (6, 6)."""
    scatter = np.sqrt(np.diag(scatter_of_recordings(covariance)))
    sizes = f"{length(scatter[0])} and {angle(scatter[3])}"
    if counts_as_vehicle(covariance):
        return f"{sizes}, as for a vehicle, because one of x, y, z is much less certain"
    return f"{sizes}, as for a sensor that turns about all axes"


def shift_covariance(
    metres: float = _SHIFT_M, radians: float = _SHIFT_RAD
) -> FloatArray:
    """Return the prior covariance L (6, 6) of shifts, from standard deviations per axis."""
    variances = np.repeat([metres**2, radians**2], 3)
    return np.diag(variances)


_EXPECTED_SHIFTS = shift_covariance()
#: Prior information (6, 6) of a shift: the inverse of the prior covariance L.
SHIFT_INFORMATION = inverse(_EXPECTED_SHIFTS)


def log_ratio(
    tables: FloatArray, L: FloatArray = _EXPECTED_SHIFTS
) -> FloatArray:
    """Return the log likelihood ratio (...) of a shift against no shift.

    Parameters
    ----------
    tables : (..., 6, 7) array
        Information and score ``[H S]`` of the shift.
    L : (..., 6, 6) array
        Prior covariance of the shift.
    """
    H = information(tables)
    S = score(tables)
    log_volume = np.linalg.slogdet(np.eye(6) + L @ H)[1]
    squared = (S * _solve(H + np.linalg.inv(L), S)).sum(axis=-1)
    return 0.5 * squared - 0.5 * log_volume


def _solve(H: FloatArray, S: FloatArray) -> FloatArray:
    """Return ``H^-1 S`` (..., n) of matrices (..., n, n) and vectors (..., n)."""
    # If S has fewer dimensions than H, NumPy 1 reads S as a stack of vectors instead of columns.
    shape = np.broadcast_shapes(S.shape, H.shape[:-1])
    columns = np.broadcast_to(S, shape)[..., None]
    try:
        solved = np.linalg.solve(H, columns)
    except np.linalg.LinAlgError:
        # Exact poses determine some directions so well that rounding makes H singular.
        solved = np.linalg.pinv(H) @ columns
    return np.asarray(solved[..., 0])


def most_likely(tables: FloatArray, ridge: float) -> FloatArray:
    """Return the most likely shifts (..., 6) from ``[H S]`` (..., 6, 7).

    ``ridge`` is the weight of the prior: SHIFT_INFORMATION times ``ridge`` is added to H.
    """
    regular = information(tables) + ridge * SHIFT_INFORMATION
    return _solve(regular, score(tables))


def squares_about(
    tables: FloatArray, shifts: FloatArray, ridge: float
) -> FloatArray:
    """Return squared Mahalanobis distances (...) of estimated shifts from ``shifts`` (..., 6).

    ``tables`` (..., 6, 7) are ``[H S]`` of the estimates. ``ridge`` is the weight of the prior, as
    in :func:`most_likely`.
    """
    H = information(tables)
    scores = score(tables) - se3.times(H, shifts)
    return np.asarray(
        (scores * _solve(H + ridge * SHIFT_INFORMATION, scores)).sum(axis=-1)
    )


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
        and ``X exp(xi)`` after the shift.
    covariance : (6, 6) array
        Covariance of xi, multiplied by the long-run variance.
    log_ratio : float
        Log likelihood ratio of this shift against no shift.
    """

    at_ns: int
    xi: FloatArray
    covariance: FloatArray
    log_ratio: float


def residuals_and_jacobians(
    pairs: MotionPairs, T_parent_child: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return residuals e (K, 6) of motion pairs at an extrinsic X0, and J (K, 6, 6).

    If the mount moves to ``X0 exp(xi)``, then ``e = -J xi + noise``. So J is the derivative of e
    with respect to X0, and the negative derivative with respect to the true extrinsic.
    """
    Bs_inverse = se3.inverse(pairs.Ts_childi_childj)
    Bs_predicted = (
        se3.inverse(T_parent_child) @ pairs.Ts_parenti_parentj @ T_parent_child
    )
    return se3.log(Bs_inverse @ Bs_predicted), np.eye(6) - se3.adjoint(
        Bs_inverse
    )


def evidence(
    residuals: FloatArray,
    jacobians: FloatArray,
    noise: FloatArray,
    weights: FloatArray,
) -> FloatArray:
    """Return information and score ``[H S]`` (K, p, p + 1) of each motion pair on p parameters.

    Parameters
    ----------
    residuals : (K, 6) array
        Residuals e of the motion pairs, in m and rad.
    jacobians : (K, 6, p) array
        J of ``residuals = -J parameters + noise``.
    noise : (6, 6) array
        Covariance of the residuals.
    weights : (K,) array
        Robust weights of the motion pairs.
    """
    precision = np.linalg.inv(noise)
    whitened = np.swapaxes(jacobians, 1, 2) @ precision
    weighted = whitened * weights[:, None, None]
    columns = np.concatenate([jacobians, -residuals[..., None]], axis=2)
    return weighted @ columns


def noise_covariance(residuals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Estimate the covariance (6, 6) of residuals (K, 6), with noise of Student's t distribution.

    The second result has the robust weights (K,) of the residuals: 1 on average, small for jumps.
    """
    sigmas = np.repeat(
        [stats.robust_sigma(part) for part in np.split(residuals, 2, axis=1)], 3
    )
    covariance = np.diag(np.maximum(sigmas, _MIN_SIGMAS) ** 2)
    for _ in range(_NOISE_ITERATIONS):
        squared = np.einsum(
            "ki,ki->k", residuals @ np.linalg.inv(covariance), residuals
        )
        weights = stats.robust_weights("student", squared)
        scatter = (weights[:, None] * residuals).T @ residuals / len(residuals)
        covariance = scatter + np.diag(_MIN_SIGMAS**2)
    return covariance, weights


def find_change(
    pose_pairs: PosePairs, T_parent_child: FloatArray
) -> MountChange | None:
    """Return the most likely shift of the mount within a recording.

    The shift is tested at the start of every second, except near both ends. A ratio below
    :data:`SIGNIFICANT` is no evidence of a shift. H and S are divided by the long-run variance, so
    that drifting noise is not reported as a shift. Returns None if the recording is too short.

    Parameters
    ----------
    pose_pairs : PosePairs
        Poses of both sensors, on one clock and in one unit of length.
    T_parent_child : (4, 4) array
        Linearisation point X0, near the extrinsic.
    """
    starts_ns, blocks = evidence_by_second(pose_pairs, T_parent_child)
    n_blocks = len(starts_ns)
    long_run = _worst_long_run_variance(blocks)
    if long_run is None:
        return None
    shifts = blocks.shift_since(
        np.arange(1, n_blocks), _PRIOR_SHARE * SHIFT_INFORMATION
    )
    ratios = log_ratio(shifts / long_run)
    # Near both ends, one side of the shift is too short for its own estimate.
    n_edge = max(int(n_blocks * _MIN_WINDOWS_PER_SIDE / max(_WINDOW_COUNTS)), 1)
    ratios[: n_edge - 1] = -np.inf
    ratios[len(ratios) - n_edge + 1 :] = -np.inf
    best = int(np.argmax(ratios))
    damped = information(shifts[best]) + _PRIOR_SHARE * SHIFT_INFORMATION
    # The weights were computed at X0. They reduce the estimate to a share of the shift.
    share = stats.share_of_step(6)
    return MountChange(
        at_ns=int(starts_ns[best + 1]),
        xi=most_likely(shifts[best], _PRIOR_SHARE) / share,
        covariance=long_run * inverse(damped) / share**2,
        log_ratio=float(ratios[best]),
    )


def shifts_at(blocks: Blocks, cuts: IntArray) -> FloatArray | None:
    """Return ``[H S]`` (C, 6, 7) of a shift at each of C times, for :func:`log_ratio`.

    H and S are divided by the long-run variance. Returns None if the recording is too short.

    Parameters
    ----------
    blocks : Blocks
        ``[H S]`` of each second.
    cuts : (C,) int array
        Index of the first second after each possible shift.
    """
    long_run = _worst_long_run_variance(blocks)
    if long_run is None:
        return None
    return blocks.shift_since(cuts, _PRIOR_SHARE * SHIFT_INFORMATION) / long_run


def _worst_long_run_variance(blocks: Blocks) -> float | None:
    """Return the largest long-run variance of the scores, relative to independent scores.

    The ratio is at least 1. ``blocks`` has ``[H S]`` of each second. None if there are too few
    seconds.
    """
    counts = [
        count
        for count in _WINDOW_COUNTS
        if len(blocks.sums) >= count * _MIN_WINDOW_S
    ]
    if not counts:
        return None
    return max(
        1.0, *(_long_run_variance(blocks.merged(count)) for count in counts)
    )


def _long_run_variance(windows: Blocks) -> float:
    """Return the variance of the scores of windows, divided by the variance that H predicts.

    A shift must not increase this variance. Therefore each possible time of a shift has two
    estimates, before and after it, and the scores on each side are relative to the estimate of that
    side. The result is the smallest variance over all times.
    """
    n_windows = len(windows.sums)
    cuts = np.arange(
        _MIN_WINDOWS_PER_SIDE, n_windows - _MIN_WINDOWS_PER_SIDE + 1
    )
    sides = np.stack([windows.before(cuts), windows.since(cuts)], axis=1)
    estimates = most_likely(sides, _PRIOR_SHARE)
    side_of_window = (np.arange(n_windows) >= cuts[:, None]).astype(int)
    # For each cut, the estimate on the side of each window.
    row_of_cut = np.arange(len(cuts))[:, None]
    answers = estimates[row_of_cut, side_of_window]
    traces = np.trace(information(windows.sums), axis1=1, axis2=2)
    has_evidence = traces > 0
    squares = squares_about(
        windows.sums[has_evidence], answers[:, has_evidence], _PRIOR_SHARE
    )
    # Each window has six values. The two estimates use twelve degrees of freedom.
    dof = max(6 * int(has_evidence.sum()) - 12, 1)
    return float(squares.sum(axis=1).min()) / dof


def evidence_by_second(
    pose_pairs: PosePairs,
    T_parent_child: FloatArray,
    further_columns: Callable[[MotionPairs], FloatArray] | None = None,
) -> tuple[IntArray, Blocks]:
    """Return the start (ns) of each second of a recording, and ``[H S]`` of each second.

    ``further_columns`` returns columns (K, 6, q) of J, for q parameters in addition to xi.
    """
    stamps_ns = pose_pairs.stamps_ns
    duration_ns = int(stamps_ns[-1] - stamps_ns[0])
    lag_s = max(_BLOCK_NS, stats.median(np.diff(stamps_ns))) * 1e-9
    max_pairs = max(duration_ns * _MAX_PAIRS_PER_BLOCK // _BLOCK_NS, 2)
    pairs = pairs_over(pose_pairs, lag_s, max_pairs)
    # Batches limit the memory.
    starts = range(0, max(len(pairs), 1), MAX_POSES)
    batches = [slice(start, start + MAX_POSES) for start in starts]
    linearised = [
        residuals_and_jacobians(pairs[batch], T_parent_child)
        for batch in batches
    ]
    residuals = np.concatenate([residuals for residuals, _ in linearised])
    covariance, weights = noise_covariance(residuals)
    middles_ns = (stamps_ns[pairs.i] + stamps_ns[pairs.j]) // 2
    block_of_pair = (middles_ns - stamps_ns[0]) // _BLOCK_NS
    n_blocks = duration_ns // _BLOCK_NS + 1
    sums = []
    for batch, (_, jacobians) in zip(batches, linearised, strict=True):
        if further_columns:
            jacobians = np.concatenate(
                [jacobians, further_columns(pairs[batch])], axis=2
            )
        tables = evidence(
            residuals[batch], jacobians, covariance, weights[batch]
        )
        blocks = Blocks.gathered(tables, block_of_pair[batch], n_blocks)
        sums.append(blocks.sums)
    starts_ns = stamps_ns[0] + np.arange(n_blocks) * _BLOCK_NS
    return starts_ns, Blocks(np.sum(sums, axis=0))


def possible_shift(
    products: FloatArray, misfit: float
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the covariance that a possible shift of the mount adds, and a warning.

    Under the noise model, the estimates before and after each possible time are compared. The
    likelihood ratio, averaged over these times, leads to the probability of a shift. A result in
    the middle between both mounts is wrong by half of the shift.

    Parameters
    ----------
    products : (K, p + 1, p + 1) array
        Products ``[J e]' W [J e]`` of K parts of the recording, from
        :func:`~hand_eye_calib.core.noise.state_space.part_products`.
    misfit : float
        Factor of the covariances: squared residuals divided by their expected value. Factors below
        1 count as 1.

    Returns
    -------
    covariance : (6, 6) array
        Covariance of xi in ``X exp(xi)``, in m and rad; zero if a shift is improbable.
    warnings : tuple of str
        One warning if a shift is more likely than no shift, even with the scatter between
        recordings in the covariances; otherwise empty.
    """
    cuts = np.arange(
        _MIN_PARTS_PER_SIDE, len(products) - _MIN_PARTS_PER_SIDE + 1
    )
    before = NormalEquations(Blocks(products).before(cuts))
    after = NormalEquations(Blocks(products).since(cuts))
    is_complete = before.is_complete & after.is_complete
    if not is_complete.any():
        return np.zeros((6, 6)), ()
    covariances = (
        max(misfit, 1.0)
        * (before.covariance + after.covariance)[is_complete, :6, :6]
    )
    steps = (after.step - before.step)[is_complete, :6]
    tables = answer_evidence(steps, covariances)
    ratios = log_ratio(tables)
    probability = _probability(ratios)
    if probability < _MIN_PROBABILITY:
        return np.zeros((6, 6)), ()
    shifts = most_likely(tables, 1.0)
    weights = np.exp(ratios - ratios.max())
    squared = np.einsum("k,ki,kj->ij", weights / weights.sum(), shifts, shifts)
    spread = probability * squared / 4.0
    scattered = covariances + scatter_of_recordings(
        covariances[len(covariances) // 2]
    )
    if _probability(log_ratio(answer_evidence(steps, scattered))) < 0.5:
        return spread, ()
    best = int(np.argmax(ratios))
    share = int(cuts[is_complete][best]) / len(products)
    return spread, (_shift_warning(share, shifts[best]),)


def _shift_warning(share: float, xi: FloatArray) -> str:
    """Return the warning about a shift xi (6,) after the fraction ``share`` of the recording."""
    metres = length(float(np.linalg.norm(xi[:3])))
    turn = angle(float(np.linalg.norm(xi[3:])))
    return (
        f"The first {share:.0%} and the last {1 - share:.0%} of the recording give different "
        f"results ({metres}, {turn}). Perhaps a sensor moved, or an odometry got worse. The +/- "
        "values already include half of this."
    )


def _probability(log_ratios: FloatArray) -> float:
    """Return the probability of a shift at any of several times with these likelihood ratios."""
    most = log_ratios.max()
    log_odds = most + np.log(
        np.exp(log_ratios - most).mean()
        * _PRIOR_PROBABILITY
        / (1.0 - _PRIOR_PROBABILITY)
    )
    return float(np.exp(-np.logaddexp(0.0, -log_odds)))
