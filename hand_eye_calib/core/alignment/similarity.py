"""Robust fit of extrinsic, scale and time offset together, and of how much motion it leaves
unexplained.

The methods of this package assume one clock and one unit of length. If that is not known, this fit
comes first. It finds X, the factor s of the child's lengths and a correction d of the clock offset
from the same motion pairs,

    (R_A - I) t + t_A = s R t_B,      R_A R = R R_B,      B = B(d).

It needs no start value and tolerates a minority of outliers. Its scale and offset hold for every
method. Its residuals tell whether both streams can be on one rigid body.

A start is found on random small subsets: their linear relaxation is the quadratic form of
:mod:`~hand_eye_calib.core.solvers.quadratic_form` over (vec M, t, 1) with any 3 x 3 matrix M for s
R. Gauss-Newton steps with Geman-McClure weights follow.
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

# Starts: so many random subsets of each size, of so many pairs; and how many are refined.
_SUBSETS = 32
_SUBSET_SIZES = (12, 24, 48)
_MAX_RANKED_PAIRS = 300
_REFINED_STARTS = 3
# Steps end below this share of a standard deviation in every direction that is determined.
_MAX_STEPS = 30
_STEP_TOLERANCE = 1e-2

# Residuals of this many standard deviations have a quarter of the weight.
_TUNING = 3.0

# Blocks of time, for the jackknife and for a clock that drifts.
_N_BLOCKS = 10

# A fit that leaves no more than this share of the motion unexplained ends the search for others.
EXPLAINED = 0.03

# Largest share of the translations that may stay unexplained for the scale and the offset of a fit
# to mean something.
_MAX_UNEXPLAINED_TRANSLATION = 0.3

# Smallest standard deviations: of rotations (rad), and of translations as a share of the motion.
# Smaller ones are rounding.
_MIN_SIGMA_ROTATION = 1e-7
_MIN_SIGMA_TRANSLATION = 1e-9

# Fewer motions are not compared. For the scale they are over these times (s); that of the smallest
# relative standard deviation wins. Long motions show the scale best.
MIN_PAIRS = 20
_SCALE_LAGS_S = (3.0, 1.0, 8.0)

# A scale differs from 1 if it is off by more than this and by so many standard deviations, and if
# the fit leaves less than this of the motion unexplained: many jumps could imitate a scale.
_MIN_DIFFERENCE = 0.01
_MIN_SIGMAS = 5.0
_MAX_UNEXPLAINED_TO_DIFFER = 0.1

# Unknowns: (rho, phi), the logarithm of the scale, and the offset.
_UNKNOWNS = [*"xyz", "roll", "pitch", "yaw", "scale", "offset"]
_SCALE, _OFFSET = map(_UNKNOWNS.index, ("scale", "offset"))


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
        d: seconds to add to the child's stamps, beyond what was added already. 0 without twists.
    sigmas : (8,) array
        Standard deviations of (rho, phi, log s, d), by the delete-a-block jackknife over time. Zero
        for d without twists.
    scale_sigma, offset_sigma_s : float
        Those of s and d.
    sensitivity : (6, 2) array
        Derivative of (rho, phi) by log s and by d.
    offsets_of_blocks : (2, B) array
        By how much d would differ in each block of time, X and s as they are, and the weight of
        that. Zero without twists.
    held : float
        Those offsets, steps with fixed robust weights, as a share of what they should be.
    sigma_translation, sigma_rotation : float
        Robust standard deviations per axis of the residuals, m and rad.
    unexplained_translation, unexplained : float
        Unexplained share of the translations, and of the motion, translation and rotation together:
        the former over the root mean square of the parent's translations or of the child's times s,
        whichever are smaller: a scale near zero explains nothing, however small the residuals. If
        the scale is kept at 1, whichever are larger.
    explains_translation : bool
        Whether the fit explains enough of the translations to trust its scale and offset.
    is_in_one_unit, has_own_unit : bool
        Whether the lengths of both streams clearly do not differ by enough to matter; and whether
        they do, significantly.
    scale_bias : float
        By how much s differs from the scale with the streams exchanged, as noise of the child makes
        it. Computed if the lengths differ significantly, otherwise zero.
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
        Velocity of the child sensor in its own frame, (v in m/s, w in rad/s), at the start and the
        end of every pair.
    start : SimilarityFit, optional
        Fit whose X and scale to start at; a start is searched for without one.
    same_unit : bool
        Keep the scale at 1. A sensor that the body only rotates about hardly moves, and any small
        scale would do.
    most : float
        Starts that leave more than this share unexplained are not refined; by default, all are.

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
    # The volume that the residuals spread over, in the smaller unit of length.
    return min(fits, key=lambda fit: fit.sigma_translation * fit.sigma_rotation / min(fit.scale, 1))


def estimate_scale(pose_pairs: PosePairs, known: Sequence[SimilarityFit] = ()) -> SimilarityFit:
    """Estimate the factor from the child's unit of length to the parent's.

    Noise of the child makes the factor too small, as that of any regressor does, and the standard
    deviation does not contain that. With the streams exchanged it is too large. The child has a
    unit of its own only if both fits say so.

    Parameters
    ----------
    pose_pairs : PosePairs
    known : sequence of SimilarityFit, optional
        Fits of the same streams over the first of the times that are compared; a start is searched
        for without any.

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
    # By the relative standard deviation, plus the unexplained share if the fit does not hold.
    unexplained = [0.0 if fit.explains_translation else fit.unexplained_translation for fit in fits]
    doubts = [
        fit.scale_sigma / fit.scale + more for fit, more in zip(fits, unexplained, strict=True)
    ]
    return fits[int(np.argmin(doubts))]


def settle_scale(pose_pairs: PosePairs, option: str | float) -> tuple[float, SimilarityFit | None]:
    """The scale to use, given or estimated as the option ``scale`` asks for, and the fit that it
    comes from if it was estimated.

    Raises
    ------
    NotEnoughDataError
        If it is to be estimated and cannot be.
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
    """The most promising (X, scale): answers of random subsets of the pairs, one of which without
    outliers suffices, and of all pairs with the start rotations of dnl.
    """
    ranked = pairs[np.linspace(0, len(pairs) - 1, min(len(pairs), _MAX_RANKED_PAIRS)).astype(int)]
    parent = ranked.Ts_parenti_parentj.copy()
    child = ranked.Ts_childi_childj.copy()
    rms = [np.linalg.norm(Ts[:, :3, 3]) / len(Ts) ** 0.5 for Ts in (parent, child)]
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
    # Opposite or no motion: a bad candidate, but one for every form.
    scales[(scales <= 1e-3) | (scales >= 1e9)] = 1.0
    translations = -se3.times(to_translation, scales[:, None] * vectors + np.eye(10)[9])
    Ts = se3.from_rotation_translation(np.array(rotations), translations)
    costs = quadratic_form.median_costs(quadratic_form.coefficients(ranked), Ts, scales)
    Ts[:, :3, 3] *= units[0]
    scales *= units[0] / units[1]
    return [(Ts[k], float(scales[k])) for k in np.argsort(costs)[:_REFINED_STARTS]]


class _Problem:
    """Residuals of all pairs, their derivatives, and the iteration."""

    def __init__(
        self, pairs: MotionPairs, twists: tuple[FloatArray, FloatArray] | None, same_unit: bool
    ) -> None:
        A = pairs.Ts_parenti_parentj
        B = pairs.Ts_childi_childj
        rotation_a = A[:, :3, :3]
        self.translation_a = A[:, :3, 3]
        rotation_b = B[:, :3, :3]
        self.translation_b = B[:, :3, 3]
        self.chord_a = rotation_a - np.eye(3)
        self.chord_b = rotation_b - np.eye(3)
        self.quats_a = se3.to_quat_xyzw(rotation_a)
        self.quats_b = se3.to_quat_xyzw(rotation_b)
        self.skew_b = se3.skew(self.translation_b)
        lengths = (np.linalg.norm(Ts[:, :3, 3]) / len(pairs) ** 0.5 for Ts in (A, B))
        self.rms_a, self.rms_b = map(float, lengths)
        self.rms_rotation = float(np.sqrt(np.mean(se3.rotation_angle(rotation_a) ** 2)))
        self.free = list(range(_SCALE))
        self.free += [] if same_unit else [_SCALE]
        self.free += [] if twists is None else [_OFFSET]
        twists_i, twists_j = twists or (np.zeros((len(pairs), 6)),) * 2
        # Derivatives of B by d. Adding to the child's stamps moves its poses at given instants
        # back.
        rotated_i = np.einsum("kji,kj->ki", rotation_b, twists_i[:, 3:])
        self.rotation_by_offset = rotated_i - twists_j[:, 3:]
        moved_i = twists_i[:, :3] + se3.cross(twists_i[:, 3:], self.translation_b)
        moved_j = np.einsum("kij,kj->ki", rotation_b, twists_j[:, :3])
        self.translation_by_offset = moved_i - moved_j

    def rows(
        self, T: FloatArray, scale: float, offset_s: float = 0.0
    ) -> tuple[list[FloatArray], tuple[float, float], FloatArray]:
        """Derivatives of the residuals of translation and of rotation, in the parent's axes, by
        (rho, phi, log s, d), with ``R Exp(phi)`` and ``t + R rho``; the residuals in the last
        column. Two (K, 3, 9) arrays in standard deviations and times their robust weights, these
        deviations per axis (m, rad), and these weights (K,).
        """
        rotation = T[:3, :3]
        back = T[:3, :3].T
        of_translation, of_rotation = np.zeros((2, len(self.translation_a), 3, len(_UNKNOWNS) + 1))
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
        of_translation[:, :, -1] = self.chord_a @ T[:3, 3] + self.translation_a
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
        """X, scale and offset after Gauss-Newton steps with robust weights until they are small."""
        offset_s = 0.0
        for _ in range(_MAX_STEPS):
            moments = np.zeros((len(_UNKNOWNS) + 1,) * 2)
            for part in self.rows(T, scale, offset_s)[0]:
                flat = part.reshape(-1, len(_UNKNOWNS) + 1)
                moments += flat.T @ flat
            step = np.zeros(len(_UNKNOWNS))
            step[self.free] = -solve(moments, self.free)
            step *= min(1.0, 1.0 / max(np.linalg.norm(step[3:6]), abs(step[_SCALE]), 1e-300))
            T = se3.retracted(T, step[:6])
            scale = scale * float(np.exp(step[_SCALE]))
            offset_s = offset_s + step[_OFFSET]
            if step @ moments[:-1, :-1] @ step < _STEP_TOLERANCE**2:
                break
        return T, scale, offset_s

    def shares(self, sigmas: tuple[float, float], scale: float) -> tuple[float, float]:
        """Unexplained shares of translations and motion, from the residuals' sigmas (m, rad)."""
        # Of the stream that moves less or, with one unit of length, of the one that moves more.
        lengths = (self.rms_a, scale * self.rms_b)
        rms_translation = min(lengths) if _SCALE in self.free else max(lengths)
        of_translation = sigmas[0] / max(rms_translation, 1e-12)
        of_rotation = sigmas[1] / max(self.rms_rotation, 1e-12)
        return of_translation, float(np.hypot(of_translation, of_rotation))

    def describe(self, T: FloatArray, scale: float, offset_s: float) -> SimilarityFit:
        """The result, with its uncertainty."""
        parts, sigmas_of_residuals, root = self.rows(T, scale, offset_s)
        rows = np.concatenate(parts, axis=1)
        blocks = Blocks.of_rows(rows, min(_N_BLOCKS, len(rows)))
        sigmas = np.zeros(len(_UNKNOWNS))
        sigmas[self.free] = np.sqrt(np.diag(blocks.jackknife(self.free)))
        by = [-solve(blocks.total, range(_SCALE), column) for column in (_SCALE, _OFFSET)]
        weights = blocks.sums[:, _OFFSET, _OFFSET]
        # Robust weights fall as the offset moves, so that a step is shorter than it should be.
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
            sensitivity=np.column_stack(by),
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
    """``matrices @ right`` for (K, 3, 3) and (3, 3), in one product."""
    return (matrices.reshape(-1, 3) @ right).reshape(-1, 3, 3)
