"""Robust fit of extrinsic, scale and time offset.

Model: X = (R, t), the factor s of the child's lengths and a correction d of the clock offset
satisfy for all motion pairs A, B

    (R_A - I) t + t_A = s R t_B,      R_A R = R R_B,      B = B(d).

The methods of this package assume one clock and one unit of length; this fit comes first if these
are not known. The fit needs no start value and tolerates a minority of outliers. Its residuals
decide whether both streams can be on one rigid body.

Starts come from random small subsets of the pairs: the quadratic form of
:mod:`~hand_eye_calib.core.solvers.quadratic_form` over (vec M, t, 1) is minimised with any 3 x 3
matrix M for s R. Gauss-Newton steps with Geman-McClure weights follow.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.blocks import Blocks, solve
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.stats import MEDIAN_LENGTH, median, robust_weights
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, PosePairs, pairs_over
from hand_eye_calib.core.solvers import all_pairs, quadratic_form

# Number of random subsets for starts.
_SUBSETS = 32

# Sizes of the subsets, in motion pairs.
_SUBSET_SIZES = (12, 24, 48)

# Largest number of motion pairs that the subsets are drawn from.
_MAX_RANKED_PAIRS = 300

# Number of starts that are refined.
_REFINED_STARTS = 3

# Largest number of Gauss-Newton steps.
_MAX_STEPS = 30

# Gauss-Newton ends with a step below this many standard deviations.
_STEP_TOLERANCE = 1e-2

# Residual, in standard deviations, whose weight is a quarter.
_TUNING = 3.0

# Number of blocks of time, for the jackknife and for a clock rate.
_N_BLOCKS = 10

# Unexplained share of the motion that ends the search for other fits.
EXPLAINED = 0.03

# Largest unexplained share of the translations with which the scale and the offset of a fit count.
_MAX_UNEXPLAINED_TRANSLATION = 0.3

# Smallest standard deviation of rotations (rad): smaller ones are rounding.
_MIN_SIGMA_ROTATION = 1e-7

# Smallest standard deviation of translations, as a share of the motion.
_MIN_SIGMA_TRANSLATION = 1e-9

# Smallest number of motion pairs of a fit.
MIN_PAIRS = 20

# Durations (s) of the motions that are compared for the scale; long motions determine it best.
_SCALE_LAGS_S = (3.0, 1.0, 8.0)

# Smallest difference of a scale from 1 that counts.
_MIN_DIFFERENCE = 0.01

# Smallest such difference in standard deviations.
_MIN_SIGMAS = 5.0

# Largest unexplained share of the translations with which a scale may differ from 1: many jumps
# imitate a scale.
_MAX_UNEXPLAINED_TO_DIFFER = 0.1

# Number of unknowns: rho (3), phi (3), log s, d.
_N_UNKNOWNS = 8

# Index of log s.
_SCALE = 6

# Index of d.
_OFFSET = 7


@dataclass(frozen=True, kw_only=True)
class SimilarityFit:
    """Result of a robust fit.

    Attributes
    ----------
    T_parent_child : (4, 4) array
        X, in the parent's unit of length.
    scale : float
        s: factor from the child's unit of length to the parent's.
    offset_s : float
        d: seconds to add to the child's stamps, besides the offset that they have. 0 without
        twists.
    sigmas : (8,) array
        Standard deviations of (rho, phi, log s, d), by the delete-a-block jackknife over time. Zero
        for d without twists.
    scale_sigma, offset_sigma_s : float
        Standard deviations of s and d.
    sensitivity : (6, 2) array
        Derivatives of (rho, phi) with respect to log s and to d.
    offsets_of_blocks : (2, B) array
        Differences of d in each block of time at this X and s, and the weights of the differences.
        Zero without twists.
    held : float
        Ratio of these differences to the right ones: steps with fixed robust weights are too short.
    sigma_translation, sigma_rotation : float
        Robust standard deviations per axis of the residuals, m and rad.
    unexplained_translation, unexplained : float
        Unexplained share of the translations, and of the whole motion. The former is relative to
        the root mean square of the parent's translations or of the child's times s, the smaller of
        both: a scale near zero explains nothing, however small the residuals. If the scale is kept
        at 1, the larger of both.
    explains_translation : bool
        Whether the fit explains enough of the translations to trust its scale and offset.
    is_in_one_unit : bool
        Whether s is certainly within 1 % of 1.
    has_own_unit : bool
        Whether s certainly differs from 1 by more than 1 %.
    scale_bias : float
        Difference of s from the scale with the streams exchanged, which noise of the child causes.
        Zero unless the lengths differ significantly.
    """

    T_parent_child: FloatArray
    scale: float
    offset_s: float
    sigmas: FloatArray
    scale_sigma: float
    offset_sigma_s: float
    sensitivity: FloatArray
    offsets_of_blocks: FloatArray
    held: float
    sigma_translation: float
    sigma_rotation: float
    unexplained_translation: float
    explains_translation: bool
    is_in_one_unit: bool
    has_own_unit: bool
    unexplained: float
    scale_bias: float = 0.0


def fit_similarity(
    pairs: MotionPairs,
    twists: tuple[FloatArray, FloatArray] | None = None,
    start: SimilarityFit | FloatArray | None = None,
    same_unit: bool = False,
    most: float | None = None,
) -> SimilarityFit:
    """Fit X, the scale and, with twists, the time offset.

    Parameters
    ----------
    pairs : MotionPairs
        K pairs in order of time, K >= 4.
    twists : ((K, 6) array, (K, 6) array), optional
        Velocities of the child sensor in its own frame, (v in m/s, w in rad/s), at the start and
        the end of every pair.
    start : SimilarityFit or (4, 4) array, optional
        Fit or X to start at; without one, starts are searched for.
    same_unit : bool
        Keep the scale at 1. If the body only rotates about a sensor, that sensor hardly moves, and
        any small scale would fit.
    most : float, optional
        Starts that leave more than this share of the motion unexplained are not refined.

    Returns
    -------
    SimilarityFit
    """
    problem = _Problem(pairs, twists, same_unit)
    if isinstance(start, SimilarityFit):
        starts = [(start.T_parent_child, start.scale)]
    else:
        starts = _starts(pairs) if start is None else [(start, 1.0)]
    fits: list[SimilarityFit] = []
    for T, scale in starts:
        scale = 1.0 if same_unit else scale
        if most is None or problem.shares(problem.rows(T, scale)[1], scale)[1] < most:
            fits.append(problem.describe(*problem.refine(T, scale)))
            if fits[-1].unexplained < EXPLAINED:
                break
    fits = fits or [problem.describe(T, scale, 0.0)]
    # The smallest volume of the residuals, in the smaller unit of length.
    return min(fits, key=lambda fit: fit.sigma_translation * fit.sigma_rotation / min(fit.scale, 1))


def estimate_scale(pose_pairs: PosePairs, known: Sequence[SimilarityFit] = ()) -> SimilarityFit:
    """Estimate the factor from the child's unit of length to the parent's.

    Noise of the child makes the factor too small, as noise of any regressor does; the standard
    deviation does not contain this bias. With the streams exchanged the factor is too large. The
    child has a unit of its own only if both fits find one.

    Parameters
    ----------
    pose_pairs : PosePairs
    known : sequence of SimilarityFit, optional
        Fits of the same streams over the first of the durations that are compared; without them, a
        start is searched for.

    Raises
    ------
    NotEnoughDataError
        If there are too few poses.
    """
    best = _best_scale(pose_pairs, known)
    if not best.has_own_unit:
        return best
    exchanged = replace(pose_pairs, Ts_pw_p=pose_pairs.Ts_cw_c, Ts_cw_c=pose_pairs.Ts_pw_p)
    T_child_parent = se3.inverse(best.T_parent_child)
    T_child_parent[:3, 3] /= best.scale
    start = replace(best, T_parent_child=T_child_parent, scale=1.0 / best.scale)
    of_exchanged = _best_scale(exchanged, (), start)
    return replace(
        best,
        has_own_unit=of_exchanged.has_own_unit,
        scale_bias=abs(1.0 / of_exchanged.scale - best.scale),
    )


def _best_scale(
    pose_pairs: PosePairs, known: Sequence[SimilarityFit], start: SimilarityFit | None = None
) -> SimilarityFit:
    """Return the fit whose scale has the smallest relative standard deviation."""
    fits = [*known]
    for lag_s in _SCALE_LAGS_S[len(fits) :]:
        pairs = pairs_over(pose_pairs, lag_s)
        if len(pairs) >= MIN_PAIRS:
            fits.append(fit_similarity(pairs, start=fits[-1] if fits else start))
    if not fits:
        raise NotEnoughDataError(
            f"the scale cannot be estimated from {len(pose_pairs)} pose pairs: fewer than "
            f"{MIN_PAIRS} of them are {min(_SCALE_LAGS_S):g} s apart; record longer, or give scale"
        )

    def doubt(fit: SimilarityFit) -> float:
        relative_sigma = fit.scale_sigma / fit.scale
        return relative_sigma + (0.0 if fit.explains_translation else fit.unexplained_translation)

    return min(fits, key=doubt)


def settle_scale(pose_pairs: PosePairs, option: str | float) -> tuple[float, SimilarityFit | None]:
    """Return the scale that the option ``scale`` asks for, and its fit if the scale is estimated.

    Raises
    ------
    NotEnoughDataError
        If the option asks for an estimate and the scale cannot be estimated.
    """
    if not isinstance(option, str):
        return option, None
    if option == "none":
        return 1.0, None
    try:
        fit = estimate_scale(pose_pairs)
    except NotEnoughDataError:
        if option == "estimate":
            raise
        return 1.0, None
    if option == "auto" and not fit.has_own_unit:
        return 1.0, None
    if not fit.explains_translation:
        raise NotEnoughDataError(
            "the scale cannot be estimated: even with a scale, "
            f"{min(fit.unexplained_translation, 1.0):.0%} of the motion stays unexplained "
            f"(at most {_MAX_UNEXPLAINED_TRANSLATION:.0%} is allowed); "
            "check the streams, or give scale"
        )
    return fit.scale, fit


def _starts(pairs: MotionPairs) -> list[tuple[FloatArray, float]]:
    """Return the best starts (X, scale).

    Candidates are the solutions of random subsets of the pairs, of which one without outliers
    suffices, and those of all pairs at the start rotations of dnl.
    """
    ranked = pairs[np.linspace(0, len(pairs) - 1, min(len(pairs), _MAX_RANKED_PAIRS)).astype(int)]
    parent = ranked.Ts_parenti_parentj.copy()
    child = ranked.Ts_childi_childj.copy()
    rms = [np.linalg.norm(se3.translation_of(Ts)) / len(Ts) ** 0.5 for Ts in (parent, child)]
    units = np.maximum(rms, 1e-12)
    parent[:, :3, 3] /= units[0]
    child[:, :3, 3] /= units[1]
    ranked = replace(ranked, Ts_parenti_parentj=parent, Ts_childi_childj=child)
    random = np.random.default_rng(0)
    subsets = np.zeros((1 + _SUBSETS, len(ranked)))
    subsets[0] = 1.0
    for row in range(_SUBSETS):
        size = _SUBSET_SIZES[row % len(_SUBSET_SIZES)]
        subsets[1 + row, random.permutation(len(ranked))[:size]] = 1.0
    forms = quadratic_form.expand(subsets @ quadratic_form.condense(ranked))
    # Rotations nearest to the matrices M that minimise the forms over (vec M, t, 1). In flat motion
    # the smallest singular value is arbitrary; its sign is chosen so that they are rotations.
    left = forms[:, :12, :12]
    left = left + 1e-9 * np.trace(left, axis1=1, axis2=2)[:, None, None] * np.eye(12)
    # Streams that never move have no form at all.
    left = left + np.finfo(float).tiny * np.eye(12)
    matrices = -np.linalg.solve(left, forms[:, :12, 12:])[:, :9, 0].reshape(-1, 3, 3)
    rotations = [*se3.nearest_rotation(matrices), *all_pairs.start_rotations(ranked)]
    forms = np.concatenate([forms, *[forms[:1]] * (len(rotations) - len(forms))])
    # The best scale and translation of each.
    reduced, to_translation = quadratic_form.without_translation(forms)
    vectors = np.append(np.reshape(rotations, (-1, 9)), np.zeros((len(forms), 1)), axis=1)
    products = se3.times(reduced, vectors)
    scales = -products[:, 9] / np.maximum((vectors * products).sum(axis=1), 1e-300)
    # Bad candidates, of opposite or no motion, stay with scale 1: rows still match the forms.
    scales[(scales <= 1e-3) | (scales >= 1e9)] = 1.0
    translations = -se3.times(to_translation, scales[:, None] * vectors + np.eye(10)[9])
    Ts = se3.from_rotation_translation(np.array(rotations), translations)
    costs = quadratic_form.median_costs(quadratic_form.coefficients(ranked), Ts, scales)
    Ts[:, :3, 3] *= units[0]
    scales *= units[0] / units[1]
    return [(Ts[k], float(scales[k])) for k in np.argsort(costs)[:_REFINED_STARTS]]


class _Problem:
    """Residuals of all motion pairs, their derivatives, and the Gauss-Newton iteration."""

    def __init__(
        self, pairs: MotionPairs, twists: tuple[FloatArray, FloatArray] | None, same_unit: bool
    ) -> None:
        A = pairs.Ts_parenti_parentj
        B = pairs.Ts_childi_childj
        rotation_a = se3.rotation_of(A)
        self.translation_a = se3.translation_of(A)
        rotation_b = se3.rotation_of(B)
        self.translation_b = se3.translation_of(B)
        self.chord_a = rotation_a - np.eye(3)
        self.chord_b = rotation_b - np.eye(3)
        self.quats_a = se3.to_quat_xyzw(rotation_a)
        self.quats_b = se3.to_quat_xyzw(rotation_b)
        self.skew_b = se3.skew(self.translation_b)
        self.rms_a = float(np.linalg.norm(se3.translation_of(A)) / len(pairs) ** 0.5)
        self.rms_b = float(np.linalg.norm(se3.translation_of(B)) / len(pairs) ** 0.5)
        self.rms_rotation = float(np.sqrt(np.mean(se3.rotation_angle(rotation_a) ** 2)))
        self.free = list(range(_SCALE))
        if not same_unit:
            self.free.append(_SCALE)
        if twists is not None:
            self.free.append(_OFFSET)
        twists_i, twists_j = twists or (np.zeros((len(pairs), 6)),) * 2
        # Derivatives of B with respect to d: with d added to its stamps, the child is at every
        # instant where it was d before.
        rotated_i = np.einsum("kji,kj->ki", rotation_b, twists_i[:, 3:])
        self.rotation_by_offset = rotated_i - twists_j[:, 3:]
        moved_i = twists_i[:, :3] + se3.cross(twists_i[:, 3:], self.translation_b)
        moved_j = np.einsum("kij,kj->ki", rotation_b, twists_j[:, :3])
        self.translation_by_offset = moved_i - moved_j

    def rows(
        self, T: FloatArray, scale: float, offset_s: float = 0.0
    ) -> tuple[list[FloatArray], tuple[float, float], FloatArray]:
        """Return the weighted derivatives and residuals at X, s and d.

        Returns
        -------
        parts : list of two (K, 3, 9) arrays
            Derivatives of the residuals of translation and of rotation, in the parent's axes, by
            (rho, phi, log s, d), with ``R Exp(phi)`` and ``t + R rho``; in the last column the
            residuals. All are in standard deviations, times the roots of the robust weights.
        sigmas : (float, float)
            Standard deviations per axis of the residuals, m and rad.
        root : (K,) array
            Roots of the robust weights.
        """
        rotation = se3.rotation_of(T)
        back = se3.rotation_of(T).T
        of_translation, of_rotation = np.zeros((2, len(self.translation_a), 3, _N_UNKNOWNS + 1))
        of_translation[:, :, :3] = _times(self.chord_a, rotation)
        of_translation[:, :, 3:6] = -scale * np.swapaxes(_times(self.skew_b, back), 1, 2)
        of_translation[:, :, _SCALE] = -scale * self.translation_b @ back
        of_translation[:, :, _OFFSET] = -scale * self.translation_by_offset @ back
        of_rotation[:, :, 3:6] = np.swapaxes(_times(self.chord_b, back), 1, 2)
        of_rotation[:, :, _OFFSET] = self.rotation_by_offset @ back
        # R_A^T R R_B R^T, by quaternions.
        va = self.quats_a[:, :3]
        wa = self.quats_a[:, 3:]
        vb = self.quats_b[:, :3] @ back
        wb = self.quats_b[:, 3:]
        vector = wa * vb - wb * va + se3.cross(vb, va)
        scalar = wa * wb + (va * vb).sum(axis=1, keepdims=True)
        moved_b = self.translation_b + self.translation_by_offset * offset_s
        of_translation[:, :, -1] = self.chord_a @ se3.translation_of(T) + self.translation_a
        of_translation[:, :, -1] -= scale * moved_b @ back
        of_rotation[:, :, -1] = se3.quat_log(np.concatenate([vector, scalar], axis=1))
        of_rotation[:, :, -1] += offset_s * of_rotation[:, :, _OFFSET]
        parts = [of_translation, of_rotation]
        lengths = [np.linalg.norm(part[:, :, -1], axis=1) for part in parts]
        sigmas = (
            max(median(lengths[0]) / MEDIAN_LENGTH, _MIN_SIGMA_TRANSLATION * self.rms_a, 1e-12),
            max(median(lengths[1]) / MEDIAN_LENGTH, _MIN_SIGMA_ROTATION),
        )
        squared = sum((length / sigma) ** 2 for length, sigma in zip(lengths, sigmas, strict=True))
        root = np.sqrt(robust_weights("geman_mcclure", squared / (6 * _TUNING**2)))
        for part, sigma in zip(parts, sigmas, strict=True):
            part *= (root / sigma)[:, None, None]
        return parts, sigmas, root

    def refine(self, T: FloatArray, scale: float) -> tuple[FloatArray, float, float]:
        """Return X, scale and offset after Gauss-Newton steps with robust weights."""
        offset_s = 0.0
        for _ in range(_MAX_STEPS):
            moments = np.zeros((_N_UNKNOWNS + 1,) * 2)
            for part in self.rows(T, scale, offset_s)[0]:
                flat = part.reshape(-1, _N_UNKNOWNS + 1)
                moments += flat.T @ flat
            step = np.zeros(_N_UNKNOWNS)
            step[self.free] = -solve(moments, self.free)
            step *= min(1.0, 1.0 / max(np.linalg.norm(step[3:6]), abs(step[_SCALE]), 1e-300))
            T = se3.retracted(T, step[:6])
            scale = scale * float(np.exp(step[_SCALE]))
            offset_s = offset_s + step[_OFFSET]
            if step @ moments[:-1, :-1] @ step < _STEP_TOLERANCE**2:
                break
        return T, scale, offset_s

    def shares(self, sigmas: tuple[float, float], scale: float) -> tuple[float, float]:
        """Return the unexplained shares of the translations and of the motion.

        ``sigmas`` are the standard deviations of the residuals, m and rad.
        """
        # Relative to the stream that moves less; to the one that moves more if the scale is fixed.
        lengths = (self.rms_a, scale * self.rms_b)
        rms_translation = min(lengths) if _SCALE in self.free else max(lengths)
        of_translation = sigmas[0] / max(rms_translation, 1e-12)
        of_rotation = sigmas[1] / max(self.rms_rotation, 1e-12)
        return of_translation, float(np.hypot(of_translation, of_rotation))

    def describe(self, T: FloatArray, scale: float, offset_s: float) -> SimilarityFit:
        """Return the fit at X, s and d with its uncertainty."""
        parts, sigmas_of_residuals, root = self.rows(T, scale, offset_s)
        rows = np.concatenate(parts, axis=1)
        blocks = Blocks.of_rows(rows, min(_N_BLOCKS, len(rows)))
        sigmas = np.zeros(_N_UNKNOWNS)
        sigmas[self.free] = np.sqrt(np.diag(blocks.jackknife(self.free)))
        by_scale = -solve(blocks.total, range(_SCALE), _SCALE)
        by_offset = -solve(blocks.total, range(_SCALE), _OFFSET)
        weights = blocks.sums[:, _OFFSET, _OFFSET]
        # A step with fixed robust weights is too short: the weights fall as the offset moves.
        pulls = (rows[:, :, _OFFSET] * rows[:, :, -1]).sum(axis=1) ** 2 / root
        fall = pulls.sum() / (1.5 * _TUNING**2) / max(weights.sum(), 1e-300)
        held = float(np.clip(1.0 - fall, 0.5, 1.0))
        offsets = -blocks.sums[:, _OFFSET, -1] / np.where(weights > 0.0, weights, 1.0)
        of_translation, unexplained = self.shares(sigmas_of_residuals, scale)
        scale_sigma = scale * float(sigmas[_SCALE])
        off = abs(scale - 1.0)
        is_off = off > max(_MIN_DIFFERENCE, _MIN_SIGMAS * scale_sigma)
        return SimilarityFit(
            T_parent_child=T,
            scale=scale,
            offset_s=offset_s,
            sigmas=sigmas,
            scale_sigma=scale_sigma,
            offset_sigma_s=float(sigmas[_OFFSET]) / held,
            sensitivity=np.column_stack([by_scale, by_offset]),
            offsets_of_blocks=np.stack([offsets, weights]),
            held=held,
            sigma_translation=sigmas_of_residuals[0],
            sigma_rotation=sigmas_of_residuals[1],
            unexplained_translation=of_translation,
            explains_translation=of_translation < _MAX_UNEXPLAINED_TRANSLATION,
            is_in_one_unit=off + _MIN_SIGMAS * scale_sigma < _MIN_DIFFERENCE,
            has_own_unit=is_off and of_translation < _MAX_UNEXPLAINED_TO_DIFFER,
            unexplained=unexplained,
        )


def _times(matrices: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``matrices @ right`` for (K, 3, 3) and (3, 3), by one product."""
    return (matrices.reshape(-1, 3) @ right).reshape(-1, 3, 3)
