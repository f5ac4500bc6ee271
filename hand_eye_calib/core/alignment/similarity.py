"""Robust fit of extrinsic, scale and time offset.

Model: X = (R, t), the scale s of the child's lengths and a correction d (s) of the child's stamps
satisfy for all motion pairs A = (R_A, t_A) and B = (R_B, t_B)

    (R_A - I) t + t_A = s R t_B,      R_A R = R R_B,      B = B(d).

The methods of this package assume one clock and one unit of length. If they are uncertain, this fit
is made first. It needs no initial value, and tolerates a minority of outliers. Its residuals show
whether both streams can be on one rigid body.

The first values come from small random subsets of the motion pairs (starts). Any 3 x 3 matrix M
replaces s R in a start. Then the quadratic form of
:mod:`~hand_eye_calib.core.solvers.quadratic_form` in (vec M, t, 1) has its minimum in closed form.
Gauss-Newton steps with Geman-McClure weights refine the best starts.
"""

from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.blocks import Blocks, solve
from hand_eye_calib.core.base.stats import MEDIAN_LENGTH, median, robust_weights
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs
from hand_eye_calib.core.solvers import all_pairs, quadratic_form

# Number of random subsets of motion pairs, each of which yields a start.
_N_SUBSETS = 32

# Sizes of the subsets in motion pairs. They are used in turn.
_SUBSET_SIZES = (12, 24, 48)

# Largest number of motion pairs from which the subsets are drawn.
_MAX_RANKED_PAIRS = 300

# Number of the best starts that are refined.
_N_REFINED_STARTS = 3

# Largest number of Gauss-Newton steps.
_MAX_STEPS = 30

# Gauss-Newton ends if the step, in standard deviations of the unknowns, is shorter than this.
_STEP_TOLERANCE = 1e-2

# A residual of this number of standard deviations has a quarter of the full robust weight.
_QUARTER_WEIGHT_SIGMAS = 3.0

# Number of blocks of time for the jackknife and for the clock rate.
_N_BLOCKS = 10

# A fit that leaves a smaller share of the motion unexplained is good: no further fits are tried.
EXPLAINED = 0.03

# Scale and offset of a fit are used only if the unexplained share of the translations is smaller.
MAX_UNEXPLAINED_TRANSLATION = 0.3

# Lower bound of the standard deviation of rotations (rad). A smaller value is rounding.
_MIN_SIGMA_ROTATION = 1e-7

# Lower bound of the standard deviation of translations, as a share of the motions' translations.
_MIN_SIGMA_TRANSLATION = 1e-9

# Smallest number of motion pairs of a fit.
MIN_PAIRS = 20

# The units of length differ if the scale differs from 1 by more than this limit ...
_MIN_DIFFERENCE = 0.01

# ... and by more than this number of standard deviations ...
_MIN_SIGMAS = 5.0

# ... and if the unexplained share of the translations is smaller than this: many jumps may look
# like a scale.
_MAX_UNEXPLAINED_OF_OTHER_UNIT = 0.1

# Number of unknowns: rho (3), phi (3), log s and d.
_N_UNKNOWNS = 8

# Index of log s in the unknowns.
_SCALE = 6

# Index of d in the unknowns.
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
        d: seconds to be added to the child's stamps, after the offset that was already applied. 0
        if the velocities (``twists``) are missing.
    sigmas : (8,) array
        Standard deviations of (rho, phi, log s, d), by the delete-a-block jackknife over time. Zero
        for unknowns that were not estimated.
    scale_sigma, offset_sigma_s : float
        Standard deviations of s and d.
    sensitivity : (6, 2) array
        Derivatives of (rho, phi) with respect to log s and to d.
    offsets_of_blocks : (2, B) array
        Estimate of a further change of d (s) from each of B blocks of time, at this X and s, and
        the weight of each estimate. Zero if the velocities are missing.
    curvature_share : float
        Curvature of the cost with respect to d, divided by the curvature for constant robust
        weights; at most 1. The estimate from a block assumes constant weights, and is too small by
        this factor.
    sigma_translation, sigma_rotation : float
        Robust standard deviations per axis of the residuals, m and rad.
    unexplained_translation, unexplained : float
        Residuals as a share of the translations, and as a share of the whole motion. The share
        refers to the stream that moves less in the parent's unit. Otherwise, a scale near zero
        would make the share small without explaining anything. If the scale is fixed at 1, the
        share refers to the stream that moves more.
    explains_translation : bool
        Whether the fit explains enough of the translations to trust its scale and offset.
    is_in_one_unit : bool
        Whether s is certainly within 1 % of 1.
    has_own_unit : bool
        Whether s certainly differs from 1 by more than 1 %.
    scale_bias : float
        s minus the scale of a fit with exchanged streams. Noise of the child causes this
        difference. Zero unless the units of length differ.
    """

    T_parent_child: FloatArray
    scale: float
    offset_s: float
    sigmas: FloatArray
    scale_sigma: float
    offset_sigma_s: float
    sensitivity: FloatArray
    offsets_of_blocks: FloatArray
    curvature_share: float
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
    max_unexplained: float | None = None,
) -> SimilarityFit:
    """Fit X, the scale and, if velocities are given, the time offset.

    Parameters
    ----------
    pairs : MotionPairs
        K pairs in order of time, K >= 4.
    twists : ((K, 6) array, (K, 6) array), optional
        Velocities of the child sensor in its own frame, (v in m/s, w in rad/s), at the start and
        the end of every motion.
    start : SimilarityFit or (4, 4) array, optional
        Fit or X as initial value. By default, starts are searched for.
    same_unit : bool
        Fix the scale at 1. If the body only rotates about one sensor, this sensor hardly moves, and
        any small scale would fit.
    max_unexplained : float, optional
        Starts that leave more than this share of the motion unexplained are not refined.

    Returns
    -------
    SimilarityFit
        The best fit; if no start is good enough, the last start without refinement.
    """
    problem = _Problem(pairs, twists, same_unit)
    if isinstance(start, SimilarityFit):
        starts = [(start.T_parent_child, start.scale)]
    else:
        starts = _starts(pairs) if start is None else [(start, 1.0)]
    fits: list[SimilarityFit] = []
    for T, scale in starts:
        scale = 1.0 if same_unit else scale
        if max_unexplained is not None:
            _, sigmas, _ = problem.rows(T, scale)
            _, unexplained = problem.shares(sigmas, scale)
            if unexplained >= max_unexplained:
                continue
        fits.append(problem.describe(*problem.refine(T, scale)))
        if fits[-1].unexplained < EXPLAINED:
            break
    fits = fits or [problem.describe(T, scale, 0.0)]

    def size_of_residuals(fit: SimilarityFit) -> float:
        # Lengths are in the smaller unit: otherwise a scale near zero would win.
        return fit.sigma_translation * fit.sigma_rotation / min(fit.scale, 1)

    return min(fits, key=size_of_residuals)


def _starts(pairs: MotionPairs) -> list[tuple[FloatArray, float]]:
    """Return the best starts (X, scale), the best first.

    Candidates are the solutions for random subsets of the pairs, and the solutions for all pairs at
    the start rotations of dnl. A single subset without outliers is sufficient.
    """
    n_ranked = min(len(pairs), _MAX_RANKED_PAIRS)
    ranked = np.linspace(0, len(pairs) - 1, n_ranked).astype(int)
    few = pairs[ranked]
    # Divide lengths by the root mean square translation of their stream.
    parent = few.Ts_parenti_parentj.copy()
    child = few.Ts_childi_childj.copy()
    unit_of_parent = max(_rms_translation(parent), 1e-12)
    unit_of_child = max(_rms_translation(child), 1e-12)
    parent[:, :3, 3] /= unit_of_parent
    child[:, :3, 3] /= unit_of_child
    few = replace(few, Ts_parenti_parentj=parent, Ts_childi_childj=child)
    sums = _random_subsets(len(few)) @ quadratic_form.condense(few)
    subset_forms = quadratic_form.expand(sums)
    more_rotations = all_pairs.start_rotations(few)
    rotations = np.concatenate(
        [_closed_form_rotations(subset_forms), more_rotations]
    )
    # The start rotations of dnl belong to the quadratic form of all pairs.
    forms_of_all = np.repeat(subset_forms[:1], len(more_rotations), axis=0)
    forms = np.concatenate([subset_forms, forms_of_all])
    # For each rotation, scale and translation that minimise its form.
    reduced, to_translation = quadratic_form.without_translation(forms)
    vectors = np.append(
        rotations.reshape(-1, 9), np.zeros((len(forms), 1)), axis=1
    )
    products = se3.times(reduced, vectors)
    squares = (vectors * products).sum(axis=1)
    scales = -products[:, 9] / np.maximum(squares, 1e-300)
    # Opposite motion, or no motion, leads to an impossible scale. At scale 1 such candidates have
    # large costs.
    scales[(scales <= 1e-3) | (scales >= 1e9)] = 1.0
    scaled_vectors = scales[:, None] * vectors + np.eye(10)[9]
    translations = -se3.times(to_translation, scaled_vectors)
    Ts = se3.from_rotation_translation(rotations, translations)
    costs = quadratic_form.median_costs(
        quadratic_form.coefficients(few), Ts, scales
    )
    Ts[:, :3, 3] *= unit_of_parent
    scales *= unit_of_parent / unit_of_child
    best = np.argsort(costs)[:_N_REFINED_STARTS]
    return [(Ts[k], float(scales[k])) for k in best]


def _rms_translation(motions: FloatArray) -> float:
    """Return the root mean square length of the translations of motions (K, 4, 4)."""
    total = np.linalg.norm(se3.translation_of(motions))
    return float(total / len(motions) ** 0.5)


def _random_subsets(n_pairs: int) -> FloatArray:
    """Return subsets of motion pairs as rows of weights 0 or 1. The first row has all pairs."""
    random = np.random.default_rng(0)
    subsets = np.zeros((1 + _N_SUBSETS, n_pairs))
    subsets[0] = 1.0
    for row in range(_N_SUBSETS):
        size = _SUBSET_SIZES[row % len(_SUBSET_SIZES)]
        subsets[1 + row, random.permutation(n_pairs)[:size]] = 1.0
    return subsets


def _closed_form_rotations(forms: FloatArray) -> FloatArray:
    """Return the rotations that are nearest to the matrices M with minimal quadratic forms.

    In flat motion the smallest singular value of M is arbitrary. Its sign is chosen so that the
    result is a rotation.

    Parameters
    ----------
    forms : (S, 13, 13) array
        Quadratic forms in (vec M, t, 1).

    Returns
    -------
    (S, 3, 3) array
    """
    left = forms[:, :12, :12]
    traces = np.trace(left, axis1=1, axis2=2)
    left = left + 1e-9 * traces[:, None, None] * np.eye(12)
    # The quadratic form of streams that never move is zero.
    left = left + np.finfo(float).tiny * np.eye(12)
    minima = -np.linalg.solve(left, forms[:, :12, 12:])
    matrices = minima[:, :9, 0].reshape(-1, 3, 3)
    return se3.nearest_rotation(matrices)


class _Problem:
    """Residuals of all motion pairs, their derivatives, and the Gauss-Newton iteration.

    ``pairs``, ``twists`` and ``same_unit`` are those of :func:`fit_similarity`.
    """

    def __init__(
        self,
        pairs: MotionPairs,
        twists: tuple[FloatArray, FloatArray] | None,
        same_unit: bool,
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
        self.rms_a = _rms_translation(A)
        self.rms_b = _rms_translation(B)
        self.rms_rotation = float(
            np.sqrt(np.mean(se3.rotation_angle(rotation_a) ** 2))
        )
        # Indices of the unknowns that are estimated.
        self.free = list(range(_SCALE))
        if not same_unit:
            self.free.append(_SCALE)
        if twists is not None:
            self.free.append(_OFFSET)
        if twists is None:
            at_rest = np.zeros((len(pairs), 6))
            twists = (at_rest, at_rest)
        twists_i, twists_j = twists
        # Derivatives of B with respect to d. If d is added to the child's stamps, its pose at an
        # instant is the pose that it had d seconds earlier.
        rotated_i = np.einsum("kji,kj->ki", rotation_b, twists_i[:, 3:])
        self.rotation_by_offset = rotated_i - twists_j[:, 3:]
        moved_i = twists_i[:, :3] + se3.cross(
            twists_i[:, 3:], self.translation_b
        )
        moved_j = np.einsum("kij,kj->ki", rotation_b, twists_j[:, :3])
        self.translation_by_offset = moved_i - moved_j

    def rows(
        self, T: FloatArray, scale: float, offset_s: float = 0.0
    ) -> tuple[list[FloatArray], tuple[float, float], FloatArray]:
        """Return the weighted derivatives and residuals at X, s and d.

        Returns
        -------
        parts : list of two (K, 3, 9) arrays
            One array for translations, one for rotations. The columns are the derivatives of the
            residuals with respect to (rho, phi, log s, d), then the residuals. X changes to ``(R
            Exp(phi), t + R rho)``; residuals are in the parent's axes. All values are divided by
            the standard deviations of the residuals and multiplied by ``root``.
        sigmas : (float, float)
            Standard deviations per axis of the residuals, m and rad.
        root : (K,) array
            Square roots of the robust weights.
        """
        translations = self._translation_rows(T, scale, offset_s)
        rotations = self._rotation_rows(T, offset_s)
        lengths_m = np.linalg.norm(translations[:, :, -1], axis=1)
        lengths_rad = np.linalg.norm(rotations[:, :, -1], axis=1)
        least_m = max(_MIN_SIGMA_TRANSLATION * self.rms_a, 1e-12)
        sigma_m = max(median(lengths_m) / MEDIAN_LENGTH, least_m)
        sigma_rad = max(
            median(lengths_rad) / MEDIAN_LENGTH, _MIN_SIGMA_ROTATION
        )
        squared = (lengths_m / sigma_m) ** 2 + (lengths_rad / sigma_rad) ** 2
        relative = squared / (6 * _QUARTER_WEIGHT_SIGMAS**2)
        root = np.sqrt(robust_weights("geman_mcclure", relative))
        translations *= (root / sigma_m)[:, None, None]
        rotations *= (root / sigma_rad)[:, None, None]
        return [translations, rotations], (sigma_m, sigma_rad), root

    def _translation_rows(
        self, T: FloatArray, scale: float, offset_s: float
    ) -> FloatArray:
        """Return derivatives and residuals (K, 3, 9) of the translations, without weights."""
        rotation = se3.rotation_of(T)
        back = rotation.T
        rows = np.zeros((len(self.translation_a), 3, _N_UNKNOWNS + 1))
        rows[:, :, :3] = _times(self.chord_a, rotation)
        rows[:, :, 3:6] = -scale * np.swapaxes(_times(self.skew_b, back), 1, 2)
        rows[:, :, _SCALE] = -scale * self.translation_b @ back
        rows[:, :, _OFFSET] = -scale * self.translation_by_offset @ back
        moved_b = self.translation_b + self.translation_by_offset * offset_s
        rows[:, :, -1] = (
            self.chord_a @ se3.translation_of(T) + self.translation_a
        )
        rows[:, :, -1] -= scale * moved_b @ back
        return rows

    def _rotation_rows(self, T: FloatArray, offset_s: float) -> FloatArray:
        """Return derivatives and residuals (K, 3, 9) of the rotations, without weights."""
        back = se3.rotation_of(T).T
        rows = np.zeros((len(self.translation_a), 3, _N_UNKNOWNS + 1))
        rows[:, :, 3:6] = np.swapaxes(_times(self.chord_b, back), 1, 2)
        rows[:, :, _OFFSET] = self.rotation_by_offset @ back
        # Vector and scalar part of the quaternion of R_A^T R R_B R^T.
        va = self.quats_a[:, :3]
        wa = self.quats_a[:, 3:]
        vb = self.quats_b[:, :3] @ back
        wb = self.quats_b[:, 3:]
        vector = wa * vb - wb * va + se3.cross(vb, va)
        scalar = wa * wb + (va * vb).sum(axis=1, keepdims=True)
        rows[:, :, -1] = se3.quat_log(np.concatenate([vector, scalar], axis=1))
        rows[:, :, -1] += offset_s * rows[:, :, _OFFSET]
        return rows

    def refine(
        self, T: FloatArray, scale: float
    ) -> tuple[FloatArray, float, float]:
        """Return X, scale and offset after Gauss-Newton steps with robust weights from a start."""
        offset_s = 0.0
        for _ in range(_MAX_STEPS):
            moments = np.zeros((_N_UNKNOWNS + 1, _N_UNKNOWNS + 1))
            for part in self.rows(T, scale, offset_s)[0]:
                flat = part.reshape(-1, _N_UNKNOWNS + 1)
                moments += flat.T @ flat
            step = np.zeros(_N_UNKNOWNS)
            step[self.free] = -solve(moments, self.free)
            # A step is limited to a rotation of 1 rad and a factor e of the scale.
            size = max(np.linalg.norm(step[3:6]), abs(step[_SCALE]), 1e-300)
            step *= min(1.0, 1.0 / size)
            T = se3.retracted(T, step[:6])
            scale = scale * float(np.exp(step[_SCALE]))
            offset_s = offset_s + step[_OFFSET]
            if step @ moments[:-1, :-1] @ step < _STEP_TOLERANCE**2:
                break
        return T, scale, offset_s

    def shares(
        self, sigmas: tuple[float, float], scale: float
    ) -> tuple[float, float]:
        """Return the unexplained shares of the translations and of the motion.

        ``sigmas`` are the standard deviations of the residuals, m and rad.
        """
        # Use the lengths of the stream that moves less; if the scale is fixed, of the one that
        # moves more.
        lengths = (self.rms_a, scale * self.rms_b)
        rms_translation = min(lengths) if _SCALE in self.free else max(lengths)
        of_translation = sigmas[0] / max(rms_translation, 1e-12)
        of_rotation = sigmas[1] / max(self.rms_rotation, 1e-12)
        return of_translation, float(np.hypot(of_translation, of_rotation))

    def describe(
        self, T: FloatArray, scale: float, offset_s: float
    ) -> SimilarityFit:
        """Return the fit at X, s and d, with its uncertainty and its quality."""
        parts, sigmas_of_residuals, root = self.rows(T, scale, offset_s)
        rows = np.concatenate(parts, axis=1)
        blocks = Blocks.of_rows(rows, min(_N_BLOCKS, len(rows)))
        sigmas = np.zeros(_N_UNKNOWNS)
        sigmas[self.free] = np.sqrt(np.diag(blocks.jackknife(self.free)))
        by_scale = -solve(blocks.total, range(_SCALE), _SCALE)
        by_offset = -solve(blocks.total, range(_SCALE), _OFFSET)
        weights = blocks.sums[:, _OFFSET, _OFFSET]
        # The robust weights of a block change with d, so a step of d for constant weights is too
        # short. The second derivative of the Geman-McClure cost is smaller than the curvature for
        # constant weights; the loss is the part that the change of the weights causes.
        pulls = (rows[:, :, _OFFSET] * rows[:, :, -1]).sum(axis=1) ** 2 / root
        loss = (
            pulls.sum()
            / (1.5 * _QUARTER_WEIGHT_SIGMAS**2)
            / max(weights.sum(), 1e-300)
        )
        curvature_share = float(np.clip(1.0 - loss, 0.5, 1.0))
        offsets = -blocks.sums[:, _OFFSET, -1] / np.where(
            weights > 0.0, weights, 1.0
        )
        of_translation, unexplained = self.shares(sigmas_of_residuals, scale)
        scale_sigma = scale * float(sigmas[_SCALE])
        difference = abs(scale - 1.0)
        differs = difference > max(_MIN_DIFFERENCE, _MIN_SIGMAS * scale_sigma)
        return SimilarityFit(
            T_parent_child=T,
            scale=scale,
            offset_s=offset_s,
            sigmas=sigmas,
            scale_sigma=scale_sigma,
            offset_sigma_s=float(sigmas[_OFFSET]) / curvature_share,
            sensitivity=np.column_stack([by_scale, by_offset]),
            offsets_of_blocks=np.stack([offsets, weights]),
            curvature_share=curvature_share,
            sigma_translation=sigmas_of_residuals[0],
            sigma_rotation=sigmas_of_residuals[1],
            unexplained_translation=of_translation,
            explains_translation=of_translation < MAX_UNEXPLAINED_TRANSLATION,
            is_in_one_unit=difference + _MIN_SIGMAS * scale_sigma
            < _MIN_DIFFERENCE,
            has_own_unit=differs
            and of_translation < _MAX_UNEXPLAINED_OF_OTHER_UNIT,
            unexplained=unexplained,
        )


def _times(matrices: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``matrices @ right`` for arrays (K, 3, 3) and (3, 3), as a single matrix product."""
    return (matrices.reshape(-1, 3) @ right).reshape(-1, 3, 3)
