"""Extrinsic, scale and time offset together, robustly, and how well the two streams agree at all.

The methods of this package assume one clock and one unit of length. Where that is not known, this
fit comes first: it finds X, the factor s of the child's lengths and a correction d of the clock
offset from the same motion pairs,

    (R_A - I) t + t_A = s R t_B,      R_A R = R R_B,      B = B(d),

without a start value, with most of the pairs in agreement and the rest anywhere. What it says about
scale and offset holds for every method; its residuals tell whether the two streams can be on one
body.

A start is found on random small subsets, whose linear relaxation is the quadratic form of
:mod:`~hand_eye_calib.solvers.quadratic_form` over (vec M, t, 1) with any 3 x 3 matrix M for s R;
then follow Gauss-Newton steps with Geman-McClure weights.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.geometry import se3
from hand_eye_calib.solvers import dnl, quadratic_form

_SUBSETS, _SUBSET_SIZES = 32, (12, 24, 48)
_REFINED_STARTS = 3
_MAX_JUDGED_PAIRS = 300
_MAX_STEPS, _STEP_TOLERANCE = 30, 1e-6

# Residuals of about this many standard deviations count half.
_TUNING = 3.0
_INLIER_WEIGHT = 0.25

_BLOCKS = 10

# Where a fit leaves no more than this share of the motion unexplained, it is not worth looking for
# another.
EXPLAINED = 0.03

# Rotation errors are not believed to be smaller (rad), nor translation errors as a share of the
# motion: rounding.
_LEAST_SIGMA_ROTATION, _LEAST_SIGMA_TRANSLATION = 1e-7, 1e-9

# Damping of directions that the motion does not show, in balanced units.
_DAMPING = 1e-10

_SCALE, _OFFSET, _UNKNOWNS = 6, 7, 8

# Median length of a normal vector in three dimensions, in standard deviations per axis.
_MEDIAN_LENGTH = 1.538


@dataclass(frozen=True)
class SimilarityFit:
    """What a robust fit found.

    Attributes
    ----------
    T_parent_child : (4, 4) array
        X, in the parent's unit of length.
    scale : float
        s: factor from the child's unit of length to the parent's.
    offset_s : float
        d: seconds to add to the child's stamps, beyond what was added already; 0 where no twists
        were given.
    covariance : (8, 8) array
        Of (rho, phi, log s, d), by the delete-a-block jackknife over time; zero for what was held.
    sensitivity : (6, 2) array
        How far (rho, phi) moves for a unit of log s and of d.
    sigma_translation, sigma_rotation : float
        Robust standard deviations per axis of the residuals, m and rad.
    moved, turned : float
        Root mean square of the translations (m; the parent's or the child's times s, whichever is
        smaller) and of the parent's rotation angles (rad): what the residuals are to be compared
        with. A scale near zero explains nothing, however small the residuals.
    inliers : (K,) bool array
    """

    T_parent_child: np.ndarray
    scale: float
    offset_s: float
    covariance: np.ndarray
    sensitivity: np.ndarray
    sigma_translation: float
    sigma_rotation: float
    moved: float
    turned: float
    inliers: np.ndarray

    @property
    def unexplained(self):
        """Share of the motion, of translation and rotation together, that is left unexplained."""
        return _share(self.sigma_translation, self.moved, self.sigma_rotation, self.turned)

    @property
    def scale_sigma(self):
        """Standard deviation of the scale."""
        return self.scale * float(np.sqrt(self.covariance[_SCALE, _SCALE]))

    @property
    def offset_sigma_s(self):
        """Standard deviation of the time offset, s."""
        return float(np.sqrt(self.covariance[_OFFSET, _OFFSET]))


def fit_similarity(pairs, twists_i=None, twists_j=None, scale=None, start=None):
    """Fit X, the scale and, with twists, the time offset.

    Parameters
    ----------
    pairs : MotionPairs
        K pairs in order of time, K >= 4.
    twists_i, twists_j : (K, 6) arrays, optional
        Velocity of the child sensor in its own frame, (v in m/s, w in rad/s), at both ends of every
        pair.
    scale : float, optional
        Hold the scale at this value.
    start : SimilarityFit, optional
        Start at an earlier fit's X and scale; searched for without one.

    Returns
    -------
    SimilarityFit
    """
    problem = _Problem(pairs, twists_i, twists_j, scale)
    starts = (
        [(start.T_parent_child, start.scale if scale is None else scale)]
        if start
        else _starts(pairs, scale)
    )
    states = []
    for guess in starts:
        states.append(problem.refine(*guess))
        if problem.unexplained(states[-1]) < EXPLAINED:
            break
    return problem.describe(min(states, key=problem.badness))


def _starts(pairs, scale):
    """The most promising (X, scale): exact for random subsets of the pairs, if only one of them is
    free of outliers.
    """
    judged = pairs[np.linspace(0, len(pairs) - 1, min(len(pairs), _MAX_JUDGED_PAIRS)).astype(int)]
    units = [
        max(_rms(Ts[:, :3, 3]), 1e-12)
        for Ts in (judged.Ts_parenti_parentj, judged.Ts_childi_childj)
    ]
    judged = _in_units(judged, *units)
    condensed = quadratic_form.condense(judged)
    random = np.random.default_rng(0)
    subsets = np.zeros((1 + _SUBSETS, len(judged)))
    subsets[0] = 1.0
    for row in range(_SUBSETS):
        subsets[
            1 + row, random.permutation(len(judged))[: _SUBSET_SIZES[row % len(_SUBSET_SIZES)]]
        ] = 1.0
    forms = quadratic_form.expand(subsets @ condensed)
    held = None if scale is None else scale * units[1] / units[0]
    guesses = [
        (form, rotation) for form, rotation in zip(forms, _relaxed_rotations(forms), strict=True)
    ]
    guesses += [(forms[0], rotation) for rotation in dnl.start_rotations(judged)]
    candidates = [_with_translation(form, rotation, held) for form, rotation in guesses]
    numbers = quadratic_form.numbers(judged)
    # A cost in the unit of the smaller length, or a scale of zero would fit best.
    costs = [
        np.median(quadratic_form.costs(numbers * _child_lengths(factor), T)) / min(factor, 1.0) ** 2
        for T, factor in candidates
    ]
    starts = []
    for index in np.argsort(costs)[:_REFINED_STARTS]:
        T, factor = candidates[index]
        starts.append(
            (
                se3.from_rotation_translation(T[:3, :3], T[:3, 3] * units[0]),
                factor * units[0] / units[1],
            )
        )
    return starts


def _rms(vectors):
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _in_units(pairs, parent_unit, child_unit):
    """Pairs with translations in other units of length."""
    parent, child = pairs.Ts_parenti_parentj.copy(), pairs.Ts_childi_childj.copy()
    parent[:, :3, 3] /= parent_unit
    child[:, :3, 3] /= child_unit
    return dataclasses.replace(pairs, Ts_parenti_parentj=parent, Ts_childi_childj=child)


def _child_lengths(factor):
    """What the :func:`quadratic_form.numbers` of pairs are to be multiplied by (24,) where the
    child's lengths are by ``factor``.
    """
    factors = np.ones((2, 3, 4))
    factors[1, :, 3] = factor
    return factors.ravel()


def _relaxed_rotations(forms):
    """Rotations (B, 3, 3) nearest to the matrices M that minimise the forms over (vec M, t, 1).

    Flat motion leaves the smallest singular value to chance; its sign is chosen so that the result
    is a rotation.
    """
    left = forms[:, :12, :12]
    left = left + 1e-9 * np.trace(left, axis1=1, axis2=2)[:, None, None] * np.eye(12)
    matrices = -np.linalg.solve(left, forms[:, :12, 12:])[:, :9, 0].reshape(-1, 3, 3)
    u, _, vt = np.linalg.svd(matrices)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return u @ vt


def _with_translation(form, rotation, scale):
    """Transform and scale that minimise a form for a given rotation; the scale may be held."""
    basis = np.zeros((13, 4))
    basis[:9, 0], basis[9:12, 1:] = rotation.ravel(), np.eye(3)
    normal, right = basis.T @ form @ basis, -basis.T @ form[:, 12]
    normal += 1e-9 * np.trace(normal) * np.eye(4)
    if scale is None:
        scale = float(np.linalg.solve(normal, right)[0])
        if scale <= 1e-3:  # opposite or no motion: not a candidate, but keep the list whole
            scale = 1.0
    translation = np.linalg.solve(normal[1:, 1:], right[1:] - normal[1:, 0] * scale)
    return se3.from_rotation_translation(rotation, translation), scale


@dataclass(frozen=True)
class _State:
    T: np.ndarray
    scale: float
    offset_s: float


class _Problem:
    """Residuals of all pairs, their derivatives, and the iteration."""

    def __init__(self, pairs, twists_i, twists_j, scale):
        rotation_a, self.translation_a = (
            pairs.Ts_parenti_parentj[:, :3, :3],
            pairs.Ts_parenti_parentj[:, :3, 3],
        )
        rotation_b, self.translation_b = (
            pairs.Ts_childi_childj[:, :3, :3],
            pairs.Ts_childi_childj[:, :3, 3],
        )
        self.turn_a, self.turn_b = rotation_a - np.eye(3), rotation_b - np.eye(3)
        self.quats_a, self.quats_b = se3.to_quat_xyzw(rotation_a), se3.to_quat_xyzw(rotation_b)
        self.skew_b = se3.skew(self.translation_b)
        self.moved, self.moved_b = _rms(self.translation_a), _rms(self.translation_b)
        self.turned = float(np.sqrt(np.mean(se3.rotation_angle(rotation_a) ** 2)))
        self.free = np.ones(_UNKNOWNS, dtype=bool)
        self.free[_SCALE], self.free[_OFFSET] = scale is None, twists_i is not None
        if twists_i is None:
            twists_i = twists_j = np.zeros((len(pairs), 6))
        # Derivative of B by d: the child's stamps move on, so its poses at given instants move
        # back.
        turned_i = np.einsum("kji,kj->ki", rotation_b, twists_i[:, 3:])
        self.turn_by_offset = turned_i - twists_j[:, 3:]
        moved_i = twists_i[:, :3] + se3.cross(twists_i[:, 3:], self.translation_b)
        self.move_by_offset = moved_i - np.einsum("kij,kj->ki", rotation_b, twists_j[:, :3])

    def residuals(self, state):
        """Translation residuals (K, 3) in m and rotation residuals (K, 3) in rad, both in the
        parent's axes.
        """
        rotation, translation = state.T[:3, :3], state.T[:3, 3]
        moved_b = self.translation_b + self.move_by_offset * state.offset_s
        translations = (
            self.turn_a @ translation + self.translation_a - state.scale * moved_b @ rotation.T
        )
        # R_A^T R R_B R^T, by quaternions.
        va, vb, wa, wb = (
            self.quats_a[:, :3],
            self.quats_b[:, :3] @ rotation.T,
            self.quats_a[:, 3:],
            self.quats_b[:, 3:],
        )
        error = np.concatenate(
            [wa * vb - wb * va + se3.cross(vb, va), wa * wb + (va * vb).sum(axis=1, keepdims=True)],
            axis=1,
        )
        return translations, se3.quat_log(error) + (
            self.turn_by_offset * state.offset_s
        ) @ rotation.T

    def linearised(self, state):
        """Derivatives of both residuals by (rho, phi, log s, d), with ``R Exp(phi)`` and ``t + R
        rho``, and the residuals behind them.

        Two (K, 3, 9) arrays.
        """
        rotation = state.T[:3, :3]
        of_translation, of_rotation = np.zeros((2, len(self.translation_a), 3, _UNKNOWNS + 1))
        of_translation[:, :, :3] = _times(self.turn_a, rotation)
        of_translation[:, :, 3:6] = -state.scale * np.swapaxes(
            _times(self.skew_b, rotation.T), 1, 2
        )
        of_translation[:, :, _SCALE] = -state.scale * self.translation_b @ rotation.T
        of_translation[:, :, _OFFSET] = -state.scale * self.move_by_offset @ rotation.T
        of_rotation[:, :, 3:6] = np.swapaxes(_times(self.turn_b, rotation.T), 1, 2)
        of_rotation[:, :, _OFFSET] = self.turn_by_offset @ rotation.T
        of_translation[:, :, -1], of_rotation[:, :, -1] = self.residuals(state)
        return of_translation, of_rotation

    def sigmas(self, translations, rotations):
        """Robust standard deviations per axis, m and rad, of residuals of these lengths (K,)."""
        return (
            max(
                float(np.median(translations)) / _MEDIAN_LENGTH,
                _LEAST_SIGMA_TRANSLATION * self.moved,
                1e-12,
            ),
            max(float(np.median(rotations)) / _MEDIAN_LENGTH, _LEAST_SIGMA_ROTATION),
        )

    def sigmas_at(self, state):
        """:meth:`sigmas` of a state."""
        return self.sigmas(
            *(np.linalg.norm(residuals, axis=1) for residuals in self.residuals(state))
        )

    def badness(self, state):
        """Small for a good fit: the logarithm of the volume of the residuals' spread, in the
        smaller unit of length.
        """
        sigma_t, sigma_r = self.sigmas_at(state)
        return np.log(sigma_t / min(state.scale, 1.0)) + np.log(sigma_r)

    def moved_at(self, scale):
        """What translation residuals are to be compared with, m: the smaller of the two streams'
        motions.
        """
        return min(self.moved, scale * self.moved_b)

    def unexplained(self, state):
        """Share of the motion that a state leaves unexplained."""
        sigma_t, sigma_r = self.sigmas_at(state)
        return _share(sigma_t, self.moved_at(state.scale), sigma_r, self.turned)

    def refine(self, T, scale):
        """Gauss-Newton steps with robust weights from a start until they are small."""
        state = _State(T, scale, 0.0)
        for _ in range(_MAX_STEPS):
            rows = self.whitened(state)[0].reshape(-1, _UNKNOWNS + 1)
            moments = rows.T @ rows
            step = _solve(moments[:-1, :-1], -moments[:-1, -1], self.free)
            step *= min(1.0, 1.0 / max(np.linalg.norm(step[3:6]), abs(step[_SCALE]), 1e-300))
            rotation = state.T[:3, :3]
            T = se3.from_rotation_translation(
                rotation @ se3.rotation_exp(step[3:6]), state.T[:3, 3] + rotation @ step[:3]
            )
            state = _State(
                T, state.scale * float(np.exp(step[_SCALE])), state.offset_s + step[_OFFSET]
            )
            if np.abs(np.r_[step[:3] / max(self.moved, 1e-9), step[3:]]).max() < _STEP_TOLERANCE:
                break
        return state

    def whitened(self, state):
        """The rows of :meth:`linearised` in standard deviations and with their robust weights (K,
        6, 9), and these weights (K,).
        """
        parts = self.linearised(state)
        lengths = [np.linalg.norm(part[:, :, -1], axis=1) for part in parts]
        sigmas = self.sigmas(*lengths)
        squared = sum((length / sigma) ** 2 for length, sigma in zip(lengths, sigmas, strict=True))
        root = 1.0 / (1.0 + squared / (6 * _TUNING**2))
        return np.concatenate(
            [
                part * (root / sigma)[:, None, None]
                for part, sigma in zip(parts, sigmas, strict=True)
            ],
            axis=1,
        ), root**2

    def describe(self, state):
        """The state as a result, with its uncertainty."""
        rows, robust = self.whitened(state)
        blocks = [
            block.reshape(-1, _UNKNOWNS + 1)
            for block in np.array_split(rows, min(_BLOCKS, len(rows)))
        ]
        moments = np.array([block.T @ block for block in blocks])
        normal, gradient = moments[:, :-1, :-1], moments[:, :-1, -1]
        return SimilarityFit(
            state.T,
            state.scale,
            state.offset_s,
            _jackknife(normal, gradient, self.free),
            _sensitivity(normal.sum(axis=0)),
            *self.sigmas_at(state),
            self.moved_at(state.scale),
            self.turned,
            robust > _INLIER_WEIGHT,
        )


def _share(sigma_translation, moved, sigma_rotation, turned):
    return float(
        np.hypot(sigma_translation / max(moved, 1e-12), sigma_rotation / max(turned, 1e-12))
    )


def _times(matrices, right):
    """``matrices @ right`` for (K, 3, 3) and (3, 3), in one product."""
    return (matrices.reshape(-1, 3) @ right).reshape(-1, 3, 3)


def _solve(normal, right, free):
    """Solution of the free unknowns' equations in balanced units; directions without curvature stay
    put.
    """
    step = np.zeros_like(right)
    part = normal[np.ix_(free, free)]
    diagonal = np.diag(part)
    units = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    balanced = part * units * units[:, None]
    step[free] = units * np.linalg.solve(
        balanced + _DAMPING * np.eye(len(units)), units * right[free]
    )
    return step


def _jackknife(normal, gradient, free):
    """Covariance (8, 8) of one-step answers without each block of time."""
    total, total_gradient = normal.sum(axis=0), gradient.sum(axis=0)
    answers = np.array(
        [
            _solve(total - part, -(total_gradient - share), free)
            for part, share in zip(normal, gradient, strict=True)
        ]
    )
    answers -= answers.mean(axis=0)
    return (len(answers) - 1) / len(answers) * answers.T @ answers


def _sensitivity(normal):
    extrinsic = np.arange(_UNKNOWNS) < 6
    columns = [_solve(normal, -normal[:, column], extrinsic)[:6] for column in (_SCALE, _OFFSET)]
    return np.column_stack(columns)
