"""Whether the child's mount has moved: information about the extrinsic, block by block of time, and
the likelihood ratio of a shift.

At an extrinsic X0 a motion pair has the residual ``e = Log(B^-1 X0^-1 A X0)`` (6,). If the mount
has moved by xi, ``X0 exp(xi)``, then ``e = -J xi + noise`` with ``J = I - Ad(B^-1)``. With C the
covariance of the noise, each block of time has

    H = sum J' C^-1 J,      S = -sum J' C^-1 e,

so that ``H^-1 S`` is the shift that the block shows. Both add over blocks. Large residuals have
less weight, so that a large shift comes out too small: take the information again at the extrinsic
that it leads to.

The noise of motions that follow each other is correlated: f, the long-run variance of the scores S
in units of H, says how much more they scatter than H predicts. The logarithm of the likelihood
ratio of a shift with covariance L against none is then

    1/2 S' (H + f L^-1)^-1 S / f - 1/2 log|I + L H / f|.

Errors that wander over minutes, of a map that bends or a bias, give a large ratio, too. A shift is
a step: it remains if the answers of both sides may drift linearly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls.state_space import NormalEquations
from hand_eye_calib.pairing.motion_pairs import MotionPairs
from hand_eye_calib.pairing.motions import pairs_over
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.stats import median, robust_sigma, student_weights
from hand_eye_calib.text import angle, length

# Shifts that are looked for: one standard deviation per axis (m, rad).
SHIFT_M, SHIFT_RAD = 0.03, float(np.radians(1.0))

# Motions over this time (s) are compared, so many a second at most.
_LAG_S, _MOTIONS_PER_S = 1.0, 20.0

_ROUNDS = 4
_LEAST_SIGMA = np.repeat([1e-6, 1e-7], 3)

# The recording is cut into so many windows of equal duration, whose answers show the long-run
# variance; a shift separates at least so many of them on either side.
_WINDOWS, _LEAST_WINDOWS = (8, 16), 2
_LEAST_WINDOW_S = 3.0

# Log likelihood ratio from which on a shift is significant, and squared step in its covariance from
# which on it is no drift (0.3 % of chi2 of 6 degrees of freedom).
SIGNIFICANT, _LEAST_STEP = 12.0, 20.0

# Share of the recordings in which a mount moves, before one is looked at, and fewest parts of a
# recording before and after that. A smaller probability is none; log odds beyond these are certain.
_MOVES, _LEAST_PARTS, _LEAST_PROBABILITY, _CERTAIN = 0.02, 4, 1e-3, 50.0


def shift_covariance(metres: float = SHIFT_M, radians: float = SHIFT_RAD) -> FloatArray:
    """Covariance L (6, 6) of the shifts that are looked for, from standard deviations per axis."""
    return np.diag(np.repeat([metres**2, radians**2], 3))


@dataclass(frozen=True)
class Information:
    """Information about a shift of the extrinsic, block by block of time.

    Attributes
    ----------
    starts_ns : (M,) int64 array
        Start of each block, parent clock; blocks without motion pairs are there, too.
    H : (M, 6, 6) array
        Of xi = (rho, phi) in the child sensor's frame.
    S : (M, 6) array
    """

    starts_ns: IntArray
    H: FloatArray
    S: FloatArray

    def __len__(self) -> int:
        return len(self.starts_ns)

    def about(self, xi: FloatArray) -> Information:
        """The information about shifts from ``X0 exp(xi)``, to first order."""
        return Information(self.starts_ns, self.H, self.S - self.H @ xi)

    def part(self, which: slice | BoolArray) -> Information:
        """The information of some of the blocks."""
        return Information(self.starts_ns[which], self.H[which], self.S[which])

    def in_windows(self, n_windows: int) -> Information:
        """The information in so many windows of about equal duration."""
        return self.merged(np.arange(n_windows) * len(self) // n_windows)

    def merged(self, edges: IntArray) -> Information:
        """The information in longer blocks, each from one edge (an index) to the next."""
        H, S = np.add.reduceat(self.H, edges), np.add.reduceat(self.S, edges)
        return Information(self.starts_ns[edges], H, S)


@dataclass(frozen=True, kw_only=True)
class MountChange:
    """A shift of the mount within a recording.

    Attributes
    ----------
    at_ns : int
        When, parent clock.
    earliest_ns, latest_ns : int
        The times between which it took place, nine times out of ten.
    xi : (6,) array
        Shift: afterwards the extrinsic is ``X exp(xi)``, with X from before, (rho, phi) in the
        child sensor's frame, m and rad.
    covariance : (6, 6) array
        Of ``xi``, with the long-run variance.
    log_ratio : float
        Logarithm of the likelihood ratio of this shift against none.
    step : float
        Squared step, in its covariance, between the answers of both sides if they may drift.
    """

    at_ns: int
    earliest_ns: int
    latest_ns: int
    xi: FloatArray
    covariance: FloatArray
    log_ratio: float
    step: float

    @property
    def is_significant(self) -> bool:
        """Whether the recording shows it beyond doubt."""
        return self.log_ratio > SIGNIFICANT

    @property
    def is_step(self) -> bool:
        """Whether it happened at once; otherwise something may as well drift."""
        return self.step > _LEAST_STEP


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


def information(
    pose_pairs: PosePairs,
    T_parent_child: FloatArray,
    covariance: FloatArray | None = None,
    block_s: float = 1.0,
) -> Information:
    """Information about a shift of an extrinsic.

    Parameters
    ----------
    pose_pairs : PosePairs
        On one clock and in one unit of length.
    T_parent_child : (4, 4) array
        X0.
    covariance : (6, 6) array, optional
        Of the noise, from :func:`noise_covariance`; that of these residuals if left out.
    block_s : float
        Duration of a block, s.
    """
    stamps_ns = pose_pairs.stamps_ns
    duration_s = (stamps_ns[-1] - stamps_ns[0]) * 1e-9
    lag_s = max(_LAG_S, median(np.diff(stamps_ns)) * 1e-9)
    pairs = pairs_over(pose_pairs, lag_s, max(int(duration_s * _MOTIONS_PER_S), 2))
    return information_of(pairs, stamps_ns, T_parent_child, covariance, block_s)


def information_of(
    pairs: MotionPairs,
    stamps_ns: IntArray,
    T_parent_child: FloatArray,
    covariance: FloatArray | None = None,
    block_s: float = 1.0,
) -> Information:
    """:func:`information` of given motion pairs between poses of these stamps; a pair counts in the
    block of its middle.
    """
    residuals, jacobians = residuals_and_jacobians(pairs, T_parent_child)
    if covariance is None:
        covariance, weights = noise_covariance(residuals)
        precision = np.linalg.inv(covariance)
    else:
        precision = np.linalg.inv(covariance)
        squared = np.einsum("ki,ki->k", residuals @ precision, residuals)
        weights = student_weights(squared)
    whitened = np.swapaxes(jacobians, 1, 2) @ precision * weights[:, None, None]
    middles_ns = (stamps_ns[pairs.i] + stamps_ns[pairs.j]) // 2
    block_ns = round(block_s * 1e9)
    blocks = (middles_ns - stamps_ns[0]) // block_ns
    n_blocks = int((stamps_ns[-1] - stamps_ns[0]) // block_ns) + 1
    H, S = np.zeros((n_blocks, 6, 6)), np.zeros((n_blocks, 6))
    np.add.at(H, blocks, whitened @ jacobians)
    np.add.at(S, blocks, -np.einsum("kij,kj->ki", whitened, residuals))
    return Information(stamps_ns[0] + np.arange(n_blocks) * block_ns, H, S)


def log_ratio(
    H: FloatArray, S: FloatArray, long_run: float, shift: FloatArray | None = None
) -> FloatArray:
    """Logarithm of the likelihood ratio of a shift against none.

    Parameters
    ----------
    H : (..., 6, 6) array
        Information since the time from which on the mount may have moved.
    S : (..., 6) array
    long_run : float
        f, see :func:`long_run_variance`.
    shift : (6, 6) array, optional
        L; :func:`shift_covariance` if left out.
    """
    L = shift_covariance() if shift is None else shift
    matrices = H + long_run * np.linalg.inv(L)
    # As many dimensions as the matrices: else NumPy 1 takes the columns for vectors.
    columns = np.broadcast_to(S, matrices.shape[:-1])[..., None]
    solved = np.linalg.solve(matrices, columns)[..., 0]
    _, log_volume = np.linalg.slogdet(np.eye(6) + L @ H / long_run)
    return 0.5 * (S * solved).sum(axis=-1) / long_run - 0.5 * log_volume


def long_run_variance(found: Information, n_parameters: int = 6) -> float:
    """Long-run variance f of the scores in units of the information: mean of ``S' H^-1 S`` per
    degree of freedom, at least 1.

    Parameters
    ----------
    found : Information
        About no shift, in blocks that are longer than the noise is correlated.
    n_parameters : int
        Number of parameters that were fitted to these blocks.
    """
    informative = np.trace(found.H, axis1=1, axis2=2) > 0
    H, S = found.H[informative], found.S[informative]
    ridge = 1e-6 * np.linalg.inv(shift_covariance())
    squared = (S * np.linalg.solve(H + ridge, S[..., None])[..., 0]).sum(axis=1)
    return max(float(squared.sum()) / max(6 * len(S) - n_parameters, 1), 1.0)


def find_change(found: Information) -> MountChange | None:
    """The most likely shift of the mount within a recording; None if it is too short to tell.

    The answers of both sides of every possible time are compared. What each side scatters about its
    own answer, in windows of a sixteenth and of an eighth of the recording, is the long-run
    variance: noise that wanders is no shift.
    """
    found = found.about(_solve(found.H.sum(axis=0), found.S.sum(axis=0)))
    tried = [_best_split(found, n) for n in _WINDOWS if len(found) >= n * _LEAST_WINDOW_S]
    if not tried:
        return None
    long_run = max(variance for _, variance in tried)
    before_H, before_S = np.cumsum(found.H, axis=0)[:-1], np.cumsum(found.S, axis=0)[:-1]
    ratios = _log_ratios(found, before_H, before_S, long_run)
    n_edge = max(int(len(found) * _LEAST_WINDOWS / max(_WINDOWS)), 1)
    ratios[: n_edge - 1] = ratios[len(ratios) - n_edge + 1 :] = -np.inf
    best = int(np.argmax(ratios))
    H, S = found.H.sum(axis=0), found.S.sum(axis=0)
    before = _solve(before_H[best], before_S[best])
    after = _solve(H - before_H[best], S - before_S[best])
    covariance = long_run * (_inverse(before_H[best]) + _inverse(H - before_H[best]))
    edges_ns = found.starts_ns[1:]
    likely = np.exp(ratios - ratios[best])
    cumulated = np.cumsum(likely) / likely.sum()
    first, last = np.searchsorted(cumulated, [0.05, 0.95])
    return MountChange(
        at_ns=int(edges_ns[best]),
        earliest_ns=int(edges_ns[first]),
        latest_ns=int(edges_ns[min(last, len(edges_ns) - 1)]),
        xi=after - before,
        covariance=covariance,
        log_ratio=float(ratios[best]),
        step=_step(found, int(edges_ns[best])),
    )


@dataclass(frozen=True, kw_only=True)
class PossibleShift:
    """A shift of the mount that the parts of a recording may show.

    Attributes
    ----------
    probability : float
    share : float
        Of the recording before it, where it is most likely.
    xi : (6,) array
        Shift there, as of a MountChange, if there is one.
    spread : (6, 6) array
        Covariance of xi in ``X exp(xi)`` because of it: an answer between both mounts is half of
        the shift away from either.
    """

    probability: float
    share: float
    xi: FloatArray
    spread: FloatArray

    @property
    def warnings(self) -> tuple[str, ...]:
        """A warning if it is more likely than not."""
        if self.probability < 0.5:
            return ()
        return (
            f"The first {self.share:.0%} and the last {1 - self.share:.0%} of the recording give "
            f"different results ({length(float(np.linalg.norm(self.xi[:3])))}, "
            f"{angle(float(np.linalg.norm(self.xi[3:])))}). Perhaps a sensor moved, or an odometry "
            "got worse. The +/- values already include half of this.",
        )


def possible_shift(products: FloatArray, misfit: float) -> PossibleShift | None:
    """The shift of the mount that the parts of a recording may show; None if it is improbable.

    What the parts before and after each time say of X is compared under the noise model that gave
    X. The likelihood ratio of a shift, averaged over the times, gives its probability.

    Parameters
    ----------
    products : (K, p + 1, p + 1) array
        What each part of the recording adds, see :mod:`~hand_eye_calib.gls.resampling`.
    misfit : float
        Factor of the covariances.
    """
    cuts = np.arange(_LEAST_PARTS, len(products) - _LEAST_PARTS + 1)
    before = NormalEquations(np.cumsum(products, axis=0)[cuts - 1])
    after = NormalEquations(np.cumsum(products[::-1], axis=0)[::-1][cuts])
    known = before.is_complete & after.is_complete
    if not known.any():
        return None
    joint = (before.covariance + after.covariance)[known, :6, :6]
    H = np.linalg.inv(max(misfit, 1.0) * joint)
    S = (H @ (after.step - before.step)[known, :6, None])[:, :, 0]
    ratios = log_ratio(H, S, 1.0)
    shifts = np.linalg.solve(H + np.linalg.inv(shift_covariance()), S[:, :, None])[:, :, 0]
    weights = np.exp(ratios - ratios.max())
    log_odds = ratios.max() + np.log(weights.mean() * _MOVES / (1.0 - _MOVES))
    probability = float(1.0 / (1.0 + np.exp(-np.clip(log_odds, -_CERTAIN, _CERTAIN))))
    if probability < _LEAST_PROBABILITY:
        return None
    squared = np.einsum("k,ki,kj->ij", weights / weights.sum(), shifts, shifts)
    best = int(np.argmax(ratios))
    return PossibleShift(
        probability=probability,
        share=int(cuts[known][best]) / len(products),
        xi=shifts[best],
        spread=probability * squared / 4.0,
    )


def _best_split(found: Information, n_windows: int) -> tuple[int, float]:
    """Of so many windows, those before the most likely shift, and the long-run variance with it."""
    windows = found.in_windows(n_windows)
    splits = range(_LEAST_WINDOWS, n_windows - _LEAST_WINDOWS + 1)
    variances = [_within(windows, split) for split in splits]
    best = int(np.argmin(variances))
    return splits[best], variances[best]


def _within(windows: Information, split: int) -> float:
    """Long-run variance about the answers of the windows before and after a split."""
    centred = []
    for part in (slice(None, split), slice(split, None)):
        side = windows.part(part)
        centred.append(side.about(_solve(side.H.sum(axis=0), side.S.sum(axis=0))))
    H, S = (np.concatenate([getattr(side, name) for side in centred]) for name in ("H", "S"))
    return long_run_variance(Information(windows.starts_ns, H, S), n_parameters=12)


def _step(found: Information, at_ns: int) -> float:
    """Squared step at a time, in its covariance, if the answer before and the one after may drift
    linearly.
    """
    is_after = found.starts_ns >= at_ns
    (before, cov_before, rest_before), (after, cov_after, rest_after) = (
        _drifting(found.part(side), at_ns) for side in (~is_after, is_after)
    )
    rest = Information(found.starts_ns, found.H, np.concatenate([rest_before, rest_after]))
    long_run = max(long_run_variance(rest.in_windows(n), n_parameters=24) for n in _WINDOWS)
    step = after - before
    return float(step @ np.linalg.solve(cov_before + cov_after, step)) / long_run


def _drifting(side: Information, at_ns: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Answer at a time if it drifts linearly over these blocks, its covariance without the long-run
    variance, and the scores (M, 6) about the drifting answer.
    """
    times = (side.starts_ns - at_ns).astype(float)
    times /= max(np.abs(times).max(), 1.0)
    powers = np.stack([np.ones_like(times), times])
    H = np.einsum("ak,bk,kij->aibj", powers, powers, side.H).reshape(12, 12)
    prior = np.linalg.inv(shift_covariance())
    covariance = np.linalg.inv(H + 0.01 * np.kron(np.eye(2), prior))
    answer, drift = np.split(covariance @ (powers @ side.S).ravel(), 2)
    rest = side.S - np.einsum("kij,kj->ki", side.H, answer + times[:, None] * drift)
    return answer, covariance[:6, :6], rest


def _log_ratios(
    found: Information, before_H: FloatArray, before_S: FloatArray, long_run: float
) -> FloatArray:
    """Log likelihood ratios (M,) of a shift after each block, the common answer being free."""
    total = found.H.sum(axis=0)
    contrast = before_H - before_H @ _inverse(total) @ before_H
    return log_ratio(contrast, before_S, long_run)


def _solve(H: FloatArray, S: FloatArray) -> FloatArray:
    return _inverse(H) @ S


def _inverse(H: FloatArray) -> FloatArray:
    """Inverse of an information matrix; shifts of many metres count as impossible."""
    return np.linalg.inv(H + 1e-6 * np.linalg.inv(shift_covariance()))
