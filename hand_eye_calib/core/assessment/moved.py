"""Has it moved? The one kernel behind comparisons of results, parts of a recording and the monitor.

A change of the extrinsic is judged in two ways, both from its estimate d and the covariance C of
that. By axis, where a person asks what has moved (:mod:`~hand_eye_calib.core.assessment.change`).
By probability, where a shift is looked for at many times: with shifts of covariance L expected, the
logarithm of the likelihood ratio of a shift against none is, with ``H = C^-1`` and ``S = H d``,

    1/2 S' (H + L^-1)^-1 S - 1/2 log|I + L H|,

both divided before by how much more S scatters than H predicts.

Answers of one rig scatter from recording to recording by more than each of them states, as no
recording shows its own constant errors: that belongs to C (docs/session.md has the measurements).

Within a recording, a motion pair has the residual ``e = Log(B^-1 X0^-1 A X0)`` (6,) at an
extrinsic X0. If the mount has moved by xi, ``X0 exp(xi)``, then ``e = -J xi + noise`` with
``J = I - Ad(B^-1)``. With C the covariance of the noise, each second has ``H = sum J' C^-1 J`` and
``S = -sum J' C^-1 e``; both add over time. Large residuals have less weight, so that a large shift
comes out too small: take the information again at the extrinsic that it leads to. The noise of
motions that follow each other is correlated: the long-run variance of S in units of H says how
much. Errors that wander over minutes, of a map that bends or a bias, give a large ratio, too: the
stream checks compare how well a world that moves explains the motion.
"""

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

# Shifts that are looked for: one standard deviation per axis (m, rad).
SHIFT_M = 0.03
SHIFT_RAD = float(np.radians(1.0))

# Scatter between recordings of one rig, per axis (m, rad): of flights and hand-held recordings, and
# of vehicles. A vehicle turns about one axis, and knows the translation along it so many times
# worse than along the others.
_SCATTERS = np.repeat([[0.008, np.radians(0.12)], [0.020, np.radians(0.10)]], 3, axis=1)
_VEHICLE = 4.0

# Motions over this time (ns) are compared, so many of them in it at most, and what they show is
# added up over it.
_BLOCK_NS = 1_000_000_000
_MOTIONS_PER_BLOCK = 20

_ROUNDS = 4
_LEAST_SIGMA = np.repeat([1e-6, 1e-7], 3)

# The recording is cut into so many windows of equal duration, whose answers show the long-run
# variance; a shift separates at least so many of them on either side.
_WINDOWS = (8, 16)
_LEAST_WINDOWS = 2
_LEAST_WINDOW_S = 3.0

# Log likelihood ratio from which on a shift is significant.
SIGNIFICANT = 12.0

# Share of the recordings in which a mount moves, before one is looked at, and fewest parts of a
# recording before and after that. A smaller probability is none.
_MOVES = 0.02
_LEAST_PARTS = 4
_LEAST_PROBABILITY = 1e-3


def scatter_of_recordings(covariance: FloatArray) -> FloatArray:
    """Covariance (6, 6) of the answers of several recordings of one rig, beside that of one, which
    tells a vehicle from what is held in hand.
    """
    variances = np.linalg.eigvalsh(covariance[:3, :3])
    in_hand, of_vehicle = _SCATTERS
    is_vehicle = variances[2] > _VEHICLE**2 * variances[1]
    return np.diag((of_vehicle if is_vehicle else in_hand) ** 2)


def shift_covariance(metres: float = SHIFT_M, radians: float = SHIFT_RAD) -> FloatArray:
    """Covariance L (6, 6) of the shifts that are looked for, from standard deviations per axis."""
    return np.diag(np.repeat([metres**2, radians**2], 3))


# Information (6, 6) of the shifts that are looked for; and the share of it that a shift within a
# recording has before it is looked for: shifts of many metres count as impossible.
_OF_SHIFT = inverse(shift_covariance())
_RIDGE = 1e-6


def log_ratio(tables: FloatArray, shift: FloatArray | None = None) -> FloatArray:
    """Logarithm of the likelihood ratio of a shift against none.

    Parameters
    ----------
    tables : (..., 6, 7) array
        Evidence ``[H S]`` since the time from which on the mount may have moved.
    shift : (6, 6) array, optional
        L; :func:`shift_covariance` if left out.
    """
    L = shift_covariance() if shift is None else shift
    H = information(tables)
    S = score(tables)
    _, log_volume = np.linalg.slogdet(np.eye(6) + L @ H)
    squared = (S * solve(H + np.linalg.inv(L), S)).sum(axis=-1)
    return 0.5 * squared - 0.5 * log_volume


def solve(H: FloatArray, S: FloatArray) -> FloatArray:
    """``H^-1 S`` (..., n) of matrices (..., n, n)."""
    # As many dimensions as the matrices: else NumPy 1 takes the columns for vectors.
    columns = np.broadcast_to(S, np.broadcast_shapes(S.shape, H.shape[:-1]))[..., None]
    return np.asarray(np.linalg.solve(H, columns)[..., 0])


def most_likely(tables: FloatArray, ridge: float) -> FloatArray:
    """Shifts (..., 6) that evidence ``[H S]`` (..., 6, 7) shows, with a share ``ridge`` of the
    information of the shifts that are looked for.
    """
    return solve(information(tables) + ridge * _OF_SHIFT, score(tables))


def squares_about(tables: FloatArray, answers: FloatArray, ridge: float) -> FloatArray:
    """Squares (...) of the shifts from answers (..., 6) that evidence ``[H S]`` (..., 6, 7) shows,
    in units of their covariance.
    """
    H = information(tables)
    scores = score(tables) - se3.times(H, answers)
    return np.asarray((scores * solve(H + ridge * _OF_SHIFT, scores)).sum(axis=-1))


# ---------------------------------------------------------------- within a recording


@dataclass(frozen=True, kw_only=True)
class MountChange:
    """A shift of the mount within a recording, at a stamp of the parent's clock: afterwards the
    extrinsic is ``X exp(xi)``, with X from before, and xi (6,) = (rho, phi) in the child sensor's
    frame, m and rad; its covariance (6, 6) with the long-run variance; and the logarithm of the
    likelihood ratio of this shift against none.
    """

    at_ns: int
    xi: FloatArray
    covariance: FloatArray
    log_ratio: float


def residuals_and_jacobians(
    pairs: MotionPairs, T_parent_child: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals e (K, 6) of motion pairs at an extrinsic, and their negative derivatives J
    (K, 6, 6) by a shift of it.
    """
    Bs_inverse = se3.inverse(pairs.Ts_childi_childj)
    moved = se3.inverse(T_parent_child) @ pairs.Ts_parenti_parentj @ T_parent_child
    return se3.log(Bs_inverse @ moved), np.eye(6) - se3.adjoint(Bs_inverse)


def evidence(
    residuals: FloatArray, jacobians: FloatArray, noise: FloatArray, weights: FloatArray
) -> FloatArray:
    """Evidence ``[H S]`` (K, p, p + 1) of motion pairs on p parameters.

    Parameters
    ----------
    residuals : (K, 6) array
    jacobians : (K, 6, p) array
        Negative derivatives of the residuals.
    noise : (6, 6) array
        Covariance of the residuals.
    weights : (K,) array
    """
    whitened = np.swapaxes(jacobians, 1, 2) @ np.linalg.inv(noise)
    weighted = whitened * weights[:, None, None]
    columns = np.concatenate([jacobians, -residuals[..., None]], axis=2)
    return weighted @ columns


def noise_covariance(residuals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Covariance (6, 6) of residuals (K, 6) whose noise is Student's t, and the weight (K,) of
    each: 1 on average, small for jumps.
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
    """The most likely shift of the mount within a recording; None if it is too short to tell.

    The answers of both sides of every possible time are compared. What each side scatters about its
    own answer, in windows of a sixteenth and of an eighth of the recording, is the long-run
    variance: noise that wanders is no shift.

    Parameters
    ----------
    pose_pairs : PosePairs
        On one clock and in one unit of length.
    T_parent_child : (4, 4) array
        X0, near the extrinsic.
    """
    starts_ns, blocks = _by_second(pose_pairs, T_parent_child)
    n_blocks = len(starts_ns)
    counts = [count for count in _WINDOWS if n_blocks >= count * _LEAST_WINDOW_S]
    if not counts:
        return None
    long_run = max(1.0, *(_long_run(blocks.merged(count)) for count in counts))
    shifts = blocks.shift_since(np.arange(1, n_blocks), _RIDGE * _OF_SHIFT)
    ratios = log_ratio(shifts / long_run)
    n_edge = max(int(n_blocks * _LEAST_WINDOWS / max(_WINDOWS)), 1)
    ratios[: n_edge - 1] = ratios[len(ratios) - n_edge + 1 :] = -np.inf
    best = int(np.argmax(ratios))
    return MountChange(
        at_ns=int(starts_ns[best + 1]),
        xi=most_likely(shifts[best], _RIDGE),
        covariance=long_run * inverse(information(shifts[best]) + _RIDGE * _OF_SHIFT),
        log_ratio=float(ratios[best]),
    )


def _long_run(windows: Blocks) -> float:
    """Long-run variance of the scores of windows, in units of their information: about the answers
    before and since a time, which is chosen so that the variance is smallest.
    """
    count = len(windows.sums)
    cuts = np.arange(_LEAST_WINDOWS, count - _LEAST_WINDOWS + 1)
    sides = np.stack([windows.before(cuts), windows.since(cuts)], axis=1)
    is_since = (np.arange(count) >= cuts[:, None]).astype(int)
    answers = most_likely(sides, _RIDGE)[np.arange(len(cuts))[:, None], is_since]
    seen = np.trace(information(windows.sums), axis1=1, axis2=2) > 0
    squared = squares_about(windows.sums[seen], answers[:, seen], _RIDGE).sum(axis=1)
    # Six values a window, less those of both answers.
    return float(squared.min()) / max(6 * int(seen.sum()) - 12, 1)


def _by_second(pose_pairs: PosePairs, T_parent_child: FloatArray) -> tuple[IntArray, Blocks]:
    """Starts (N,) of the seconds of a recording, and the evidence ``[H S]`` of each."""
    stamps_ns = pose_pairs.stamps_ns
    duration_ns = int(stamps_ns[-1] - stamps_ns[0])
    lag_s = max(_BLOCK_NS, stats.median(np.diff(stamps_ns))) * 1e-9
    most = max(duration_ns * _MOTIONS_PER_BLOCK // _BLOCK_NS, 2)
    pairs = pairs_over(pose_pairs, lag_s, most)
    residuals, jacobians = residuals_and_jacobians(pairs, T_parent_child)
    covariance, weights = noise_covariance(residuals)
    tables = evidence(residuals, jacobians, covariance, weights)
    middles_ns = (stamps_ns[pairs.i] + stamps_ns[pairs.j]) // 2
    blocks = (middles_ns - stamps_ns[0]) // _BLOCK_NS
    n_blocks = duration_ns // _BLOCK_NS + 1
    starts_ns = stamps_ns[0] + np.arange(n_blocks) * _BLOCK_NS
    return starts_ns, Blocks.gathered(tables, blocks, n_blocks)


def possible_shift(products: FloatArray, misfit: float) -> tuple[FloatArray, tuple[str, ...]]:
    """The shift of the mount that the parts of a recording may show: the covariance (6, 6) of xi in
    ``X exp(xi)`` because of it, as an answer between both mounts is half of the shift away from
    either, zeros if it is improbable; and a warning if something has moved, more likely than not,
    by more than recordings of one rig scatter.

    What the parts before and after each time say of X is compared under the noise model that gave
    X. The likelihood ratio of a shift, averaged over the times, gives its probability.

    Parameters
    ----------
    products : (K, p + 1, p + 1) array
        Of :func:`~hand_eye_calib.core.noise.state_space.part_products`.
    misfit : float
        Factor of the covariances.
    """
    cuts = np.arange(_LEAST_PARTS, len(products) - _LEAST_PARTS + 1)
    before = NormalEquations(Blocks(products).before(cuts))
    after = NormalEquations(Blocks(products).since(cuts))
    is_complete = before.is_complete & after.is_complete
    if not is_complete.any():
        return np.zeros((6, 6)), ()
    joint = max(misfit, 1.0) * (before.covariance + after.covariance)[is_complete, :6, :6]
    steps = (after.step - before.step)[is_complete, :6]
    tables = answer_evidence(steps, joint)
    ratios = log_ratio(tables)
    probability = _probability(ratios)
    if probability < _LEAST_PROBABILITY:
        return np.zeros((6, 6)), ()
    shifts = most_likely(tables, 1.0)
    weights = np.exp(ratios - ratios.max())
    squared = np.einsum("k,ki,kj->ij", weights / weights.sum(), shifts, shifts)
    spread = probability * squared / 4.0
    of_recordings = joint + scatter_of_recordings(joint[len(joint) // 2])
    if _probability(log_ratio(answer_evidence(steps, of_recordings))) < 0.5:
        return spread, ()
    best = int(np.argmax(ratios))
    share = int(cuts[is_complete][best]) / len(products)
    return spread, (_parts_differ(share, shifts[best]),)


def _parts_differ(share: float, xi: FloatArray) -> str:
    """Warning about a shift xi (6,) after a share of the recording."""
    metres = length(float(np.linalg.norm(xi[:3])))
    turn = angle(float(np.linalg.norm(xi[3:])))
    return (
        f"The first {share:.0%} and the last {1 - share:.0%} of the recording give different "
        f"results ({metres}, {turn}). Perhaps a sensor moved, or an odometry got worse. The +/- "
        "values already include half of this."
    )


def _probability(log_ratios: FloatArray) -> float:
    """Probability of a shift at one of several times, from its logarithmic likelihood ratios."""
    most = log_ratios.max()
    log_odds = most + np.log(np.exp(log_ratios - most).mean() * _MOVES / (1.0 - _MOVES))
    return float(np.exp(-np.logaddexp(0.0, -log_odds)))
