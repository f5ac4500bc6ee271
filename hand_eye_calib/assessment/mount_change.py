"""Whether the child's mount has moved within a recording.

At an extrinsic X0 a motion pair has the residual ``e = Log(B^-1 X0^-1 A X0)`` (6,). If the mount
has moved by xi, ``X0 exp(xi)``, then ``e = -J xi + noise`` with ``J = I - Ad(B^-1)``. With C the
covariance of the noise, each second has ``H = sum J' C^-1 J`` and ``S = -sum J' C^-1 e``, so that
``H^-1 S`` is the shift that it shows; both add over time. Large residuals have less weight, so that
a large shift comes out too small: take the information again at the extrinsic that it leads to. The
noise of motions that follow each other is correlated: f, the long-run variance of S in units of H,
says how much. The likelihood ratio of a shift is that of
:mod:`~hand_eye_calib.assessment.moved`.

Errors that wander over minutes, of a map that bends or a bias, give a large ratio, too: the stream
checks compare how well a world that moves explains the motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.assessment.moved import (
    log_ratio,
    probability,
    scatter_of_recordings,
    shift_covariance,
    solve,
    squared_shift,
)
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls.normal import NormalEquations
from hand_eye_calib.pairing.motion_pairs import MotionPairs, pairs_over
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.stats import median, robust_sigma, student_weights
from hand_eye_calib.text import angle, length

# Motions over this time (s) are compared, so many a second at most; what they show is added up over
# seconds (ns).
_LAG_S, _MOTIONS_PER_S, _BLOCK_NS = 1.0, 20.0, 1_000_000_000

_ROUNDS = 4
_LEAST_SIGMA = np.repeat([1e-6, 1e-7], 3)

# The recording is cut into so many windows of equal duration, whose answers show the long-run
# variance; a shift separates at least so many of them on either side.
_WINDOWS, _LEAST_WINDOWS = (8, 16), 2
_LEAST_WINDOW_S = 3.0

# Log likelihood ratio from which on a shift is significant.
SIGNIFICANT = 12.0

# Share of the recordings in which a mount moves, before one is looked at, and fewest parts of a
# recording before and after that. A smaller probability is none.
_MOVES, _LEAST_PARTS, _LEAST_PROBABILITY = 0.02, 4, 1e-3


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


def noise_covariance(residuals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Covariance (6, 6) of residuals (K, 6) whose noise is Student's t, and the weight (K,) of
    each: 1 on average, small for jumps.
    """
    sigmas = np.repeat([robust_sigma(part) for part in (residuals[:, :3], residuals[:, 3:])], 3)
    covariance = np.diag(np.maximum(sigmas, _LEAST_SIGMA) ** 2)
    for _ in range(_ROUNDS):
        squared = np.einsum("ki,ki->k", residuals @ np.linalg.inv(covariance), residuals)
        weights = student_weights(squared)
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
    starts_ns, H, S = _by_second(pose_pairs, T_parent_child)
    S = _about_answer(H, S)
    cuts = [np.arange(n) * len(S) // n for n in _WINDOWS if len(S) >= n * _LEAST_WINDOW_S]
    if not cuts:
        return None
    long_run = 1.0
    for edges in cuts:  # the least of all splits, about the answers of their sides
        H_of, S_of = np.add.reduceat(H, edges), np.add.reduceat(S, edges)
        rests = [
            np.concatenate([_about_answer(H_of[:k], S_of[:k]), _about_answer(H_of[k:], S_of[k:])])
            for k in range(_LEAST_WINDOWS, len(edges) - _LEAST_WINDOWS + 1)
        ]
        long_run = max(long_run, min(_long_run(H_of, rest) for rest in rests))
    before_H, before_S = np.cumsum(H, axis=0)[:-1], np.cumsum(S, axis=0)[:-1]
    after_H, after_S = H.sum(axis=0) - before_H, S.sum(axis=0) - before_S
    # The common answer is free.
    contrast = before_H - before_H @ _inverse(H.sum(axis=0)) @ before_H
    ratios = log_ratio(contrast / long_run, before_S / long_run)
    n_edge = max(int(len(S) * _LEAST_WINDOWS / max(_WINDOWS)), 1)
    ratios[: n_edge - 1] = ratios[len(ratios) - n_edge + 1 :] = -np.inf
    best = int(np.argmax(ratios))
    cov_before, cov_after = _inverse(before_H[best]), _inverse(after_H[best])
    return MountChange(
        at_ns=int(starts_ns[best + 1]),
        xi=cov_after @ after_S[best] - cov_before @ before_S[best],
        covariance=long_run * (cov_before + cov_after),
        log_ratio=float(ratios[best]),
    )


def _by_second(
    pose_pairs: PosePairs, T_parent_child: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Starts (N,) of the seconds of a recording, H (N, 6, 6) and S (N, 6) of each."""
    stamps_ns = pose_pairs.stamps_ns
    duration_s = (stamps_ns[-1] - stamps_ns[0]) * 1e-9
    lag_s = max(_LAG_S, median(np.diff(stamps_ns)) * 1e-9)
    pairs = pairs_over(pose_pairs, lag_s, max(int(duration_s * _MOTIONS_PER_S), 2))
    residuals, jacobians = residuals_and_jacobians(pairs, T_parent_child)
    covariance, weights = noise_covariance(residuals)
    whitened = np.swapaxes(jacobians, 1, 2) @ np.linalg.inv(covariance) * weights[:, None, None]
    middles_ns = (stamps_ns[pairs.i] + stamps_ns[pairs.j]) // 2
    blocks = (middles_ns - stamps_ns[0]) // _BLOCK_NS
    n_blocks = int((stamps_ns[-1] - stamps_ns[0]) // _BLOCK_NS) + 1
    H, S = np.zeros((n_blocks, 6, 6)), np.zeros((n_blocks, 6))
    np.add.at(H, blocks, whitened @ jacobians)
    np.add.at(S, blocks, -np.einsum("kij,kj->ki", whitened, residuals))
    return stamps_ns[0] + np.arange(n_blocks) * _BLOCK_NS, H, S


def _about_answer(H: FloatArray, S: FloatArray) -> FloatArray:
    """Scores of shifts from the answer of all of them, to first order."""
    return np.asarray(S - H @ (_inverse(H.sum(axis=0)) @ S.sum(axis=0)))


def _long_run(H: FloatArray, S: FloatArray) -> float:
    """Long-run variance f of scores about two answers in units of the information, at least 1: mean
    of ``S' H^-1 S`` per degree of freedom.
    """
    informative = np.trace(H, axis1=1, axis2=2) > 0
    squared = squared_shift(H[informative], S[informative], 1e-6)
    return max(float(squared.sum()) / max(6 * len(squared) - 12, 1), 1.0)


def _inverse(H: FloatArray) -> FloatArray:
    """Inverse of an information matrix; shifts of many metres count as impossible."""
    return np.linalg.inv(H + 1e-6 * np.linalg.inv(shift_covariance()))


@dataclass(frozen=True, kw_only=True)
class PossibleShift:
    """A difference between the parts of a recording.

    Attributes
    ----------
    probability : float
        That the parts before and after some time have different answers, under their noise model.
    share : float
        Of the recording before it, where it is most likely.
    xi : (6,) array
        Shift there, as of a MountChange, if there is one.
    spread : (6, 6) array
        Covariance of xi in ``X exp(xi)`` because of it: an answer between both mounts is half of
        the shift away from either.
    warnings : tuple of str
        One if something has moved, more likely than not: by more than recordings of one rig
        scatter.
    """

    probability: float
    share: float
    xi: FloatArray
    spread: FloatArray
    warnings: tuple[str, ...] = ()


def possible_shift(products: FloatArray, misfit: float) -> PossibleShift | None:
    """The shift of the mount that the parts of a recording may show; None if it is improbable.

    What the parts before and after each time say of X is compared under the noise model that gave
    X. The likelihood ratio of a shift, averaged over the times, gives its probability.

    Parameters
    ----------
    products : (K, p + 1, p + 1) array
        Of :func:`~hand_eye_calib.gls.state_space.part_products`.
    misfit : float
        Factor of the covariances.
    """
    cuts = np.arange(_LEAST_PARTS, len(products) - _LEAST_PARTS + 1)
    before = NormalEquations(np.cumsum(products, axis=0)[cuts - 1])
    after = NormalEquations(np.cumsum(products[::-1], axis=0)[::-1][cuts])
    known = before.is_complete & after.is_complete
    if not known.any():
        return None
    joint = max(misfit, 1.0) * (before.covariance + after.covariance)[known, :6, :6]
    steps = (after.step - before.step)[known, :6]
    H = np.linalg.inv(joint)
    S = (H @ steps[:, :, None])[:, :, 0]
    ratios = log_ratio(H, S)
    found = probability(ratios, _MOVES)
    if found < _LEAST_PROBABILITY:
        return None
    beside = np.linalg.inv(joint + scatter_of_recordings(joint[len(joint) // 2]))
    moved = probability(log_ratio(beside, (beside @ steps[:, :, None])[:, :, 0]), _MOVES)
    shifts = solve(H + np.linalg.inv(shift_covariance()), S)
    weights = np.exp(ratios - ratios.max())
    squared = np.einsum("k,ki,kj->ij", weights / weights.sum(), shifts, shifts)
    best = int(np.argmax(ratios))
    share, xi = int(cuts[known][best]) / len(products), shifts[best]
    sizes = length(float(np.linalg.norm(xi[:3]))), angle(float(np.linalg.norm(xi[3:])))
    told = (
        f"The first {share:.0%} and the last {1 - share:.0%} of the recording give different "
        f"results ({', '.join(sizes)}). Perhaps a sensor moved, or an odometry got worse. The +/- "
        "values already include half of this."
    )
    return PossibleShift(
        probability=found,
        share=share,
        xi=xi,
        spread=found * squared / 4.0,
        warnings=(told,) if moved >= 0.5 else (),
    )
