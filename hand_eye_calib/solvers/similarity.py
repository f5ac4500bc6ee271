"""Extrinsic, scale and time offset together, robustly, and how well the two streams agree at all.

The methods of this package assume one clock and one unit of length. Where that is not known, this fit comes first: it finds X, the factor s
of the child's lengths and a correction d of the clock offset from the same motion pairs,

    (R_A - I) t + t_A = s R t_B,      R_A R = R R_B,      B = B(d),

without a start value, with most of the pairs in agreement and the rest anywhere. What it says about scale and offset holds for every method;
its residuals tell whether the two streams can be on one body.

A start is found on random small subsets, whose linear relaxation is the quadratic form of :mod:`~hand_eye_calib.solvers.quadratic_form` over (vec M, t, 1)
with any 3 x 3 matrix M for s R; then follow Gauss-Newton steps with Geman-McClure weights.
"""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.geometry import se3
from hand_eye_calib.solvers import dnl, quadratic_form

_SUBSETS, _SUBSET_SIZES = 48, (12, 24, 48)
_REFINED_STARTS = 4
_MAX_JUDGED_PAIRS = 400
_MAX_STEPS, _STEP_TOLERANCE = 40, 1e-7

# Residuals of this many standard deviations count half.
_TUNING = 3.0

_BLOCKS = 10

# Rotation errors are not believed to be smaller (rad), nor translation errors relative to the motion: rounding.
_LEAST_SIGMA_ROTATION, _LEAST_SIGMA_TRANSLATION = 1e-7, 1e-9

# Damping of directions that the motion does not show, as a share of the largest curvature.
_DAMPING = 1e-10

_SCALE, _OFFSET = 6, 7


@dataclass(frozen=True)
class SimilarityFit:
    """What a robust fit found.

    Attributes
    ----------
    T_parent_child : (4, 4) array
        X, metres of the parent.
    scale : float
        s: factor from the child's unit of length to the parent's.
    offset_s : float
        d: seconds to add to the child's stamps, beyond what was added already. 0 where no twists were given.
    covariance : (8, 8) array
        Of (rho, phi, log s, d); zero for what was held. The larger of model and block jackknife for scale and offset.
    sigma_rotation, sigma_translation : float
        Robust standard deviation per axis of the residuals, rad and m.
    moved, turned : float
        Root mean square of the parent's translations (m) and rotation angles (rad): what the residuals are to be compared with.
    inliers : (K,) bool array
    """

    T_parent_child: np.ndarray
    scale: float
    offset_s: float
    covariance: np.ndarray
    sigma_rotation: float
    sigma_translation: float
    moved: float
    turned: float
    inliers: np.ndarray

    @property
    def scale_sigma(self):
        """Standard deviation of the scale."""
        return self.scale * float(np.sqrt(self.covariance[_SCALE, _SCALE]))

    @property
    def offset_sigma_s(self):
        """Standard deviation of the time offset, s."""
        return float(np.sqrt(self.covariance[_OFFSET, _OFFSET]))


def pairs_after(pose_pairs, lag_s, most):
    """Motion index pairs (i, j) between instants about ``lag_s`` apart, at most so many, evenly over the recording."""
    stamps_s = (pose_pairs.stamps_ns - pose_pairs.stamps_ns[0]) * 1e-9
    i = np.arange(len(stamps_s))
    if len(i) > most:
        i = np.linspace(0, len(i) - 1, most).astype(int)
    j = np.searchsorted(stamps_s, stamps_s[i] + lag_s - 1e-6)
    inside = j < len(stamps_s)
    i, j = i[inside], j[inside]
    near = stamps_s[j] - stamps_s[i] <= 1.5 * lag_s + 0.1
    return i[near], j[near]


def fit_similarity(pairs, twists_i=None, twists_j=None, scale=None, seed=0):
    """Fit X, the scale and, with twists, the time offset.

    Parameters
    ----------
    pairs : MotionPairs
        K pairs in order of time, K >= 4.
    twists_i, twists_j : (K, 6) arrays, optional
        Velocity of the child sensor in its own frame, (v in m/s, w in rad/s), at both ends of every pair.
    scale : float, optional
        Hold the scale at this value.
    seed : int

    Returns
    -------
    SimilarityFit
    """
    problem = _Problem(pairs, twists_i, twists_j, scale)
    starts = _starts(pairs, scale, seed)
    state, weights = min((problem.refine(*start) for start in starts), key=lambda found: problem.badness(found[0]))
    return problem.describe(state, weights)


@dataclass(frozen=True)
class _State:
    T: np.ndarray
    scale: float
    offset_s: float


def _starts(pairs, scale, seed):
    """The most promising (X, scale) from linear relaxations of random subsets."""
    lengths = [max(float(np.sqrt(np.mean(Ts[:, :3, 3] ** 2))), 1e-12) for Ts in (pairs.Ts_parenti_parentj, pairs.Ts_childi_childj)]
    judged = pairs[np.linspace(0, len(pairs) - 1, min(len(pairs), _MAX_JUDGED_PAIRS)).astype(int)]
    normal = _rescaled(judged, *lengths)
    condensed = quadratic_form.condense(normal)
    random = np.random.default_rng(seed)
    weights = [np.ones(len(judged))]
    for row in range(_SUBSETS):
        chosen = np.zeros(len(judged))
        chosen[random.permutation(len(judged))[: _SUBSET_SIZES[row % len(_SUBSET_SIZES)]]] = 1.0
        weights.append(chosen)
    forms = quadratic_form.expand(np.array(weights) @ condensed)
    rotations, scales = _relaxed(forms)
    held = None if scale is None else scale * lengths[1] / lengths[0]
    candidates = []
    axes_aligned = dnl.start_rotations(normal)
    for form in forms[:1]:
        for rotation in axes_aligned:
            candidates.append(_complete(form, rotation, held))
    for form, rotation, relaxed_scale in zip(forms, rotations, scales, strict=True):
        candidates.append(_complete(form, rotation, relaxed_scale if held is None else held))
    scores = []
    for T, factor in candidates:
        scaled = _rescaled(normal, 1.0, 1.0 / factor)
        scores.append(np.median(dnl.pair_costs(scaled, T)) / min(factor, 1.0) ** 2)
    best = np.argsort(scores)[:_REFINED_STARTS]
    results = []
    for index in best:
        T, factor = candidates[index]
        T = T.copy()
        T[:3, 3] *= lengths[0]
        results.append((T, factor * lengths[0] / lengths[1]))
    return results


def _relaxed(forms):
    """Rotations (B, 3, 3) and scales (B,) nearest to the matrices M that minimise the forms over (vec M, t, 1)."""
    left = forms[:, :12, :12] + 1e-9 * np.trace(forms[:, :12, :12], axis1=1, axis2=2)[:, None, None] * np.eye(12)
    matrices = -np.linalg.solve(left, forms[:, :12, 12:])[:, :9, 0].reshape(-1, 3, 3)
    u, sizes, vt = np.linalg.svd(matrices)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    # Flat motion leaves the third singular value to chance.
    return u @ vt, np.maximum(sizes[:, :2].mean(axis=1), 1e-6)


def _complete(form, rotation, scale):
    """Best translation for a rotation and a scale, or best of both where the scale is free."""
    flat = rotation.ravel()
    translation_block = form[9:12, 9:12] + 1e-9 * np.trace(form[9:12, 9:12]) * np.eye(3) + 1e-300 * np.eye(3)
    if scale is None:
        basis = np.zeros((13, 4))
        basis[:9, 0], basis[9:12, 1:] = flat, np.eye(3)
        normal = basis.T @ form @ basis
        solved = -np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(4), basis.T @ form[:, 12])
        scale = solved[0] if solved[0] > 1e-3 else 1.0
    translation = -np.linalg.solve(translation_block, scale * form[9:12, :9] @ flat + form[9:12, 12])
    return se3.from_rotation_translation(rotation, translation), float(scale)


def _rescaled(pairs, parent_unit, child_unit):
    import dataclasses

    parent, child = pairs.Ts_parenti_parentj.copy(), pairs.Ts_childi_childj.copy()
    parent[:, :3, 3] /= parent_unit
    child[:, :3, 3] /= child_unit
    return dataclasses.replace(pairs, Ts_parenti_parentj=parent, Ts_childi_childj=child)


class _Problem:
    def __init__(self, pairs, twists_i, twists_j, scale):
        self.held_scale, self.twists_i, self.twists_j = scale, twists_i, twists_j
        self.rotation_a, self.translation_a = pairs.Ts_parenti_parentj[:, :3, :3], pairs.Ts_parenti_parentj[:, :3, 3]
        self.rotation_b, self.translation_b = pairs.Ts_childi_childj[:, :3, :3], pairs.Ts_childi_childj[:, :3, 3]
        self.moved = float(np.sqrt(np.mean((self.translation_a**2).sum(axis=1))))
        self.turned = float(np.sqrt(np.mean(se3.rotation_angle(self.rotation_a) ** 2)))
        free = np.ones(8, dtype=bool)
        free[_SCALE], free[_OFFSET] = scale is None, twists_i is not None
        self.free = free

    def residuals(self, state):
        """Translation (K, 3) and rotation residuals (K, 3)."""
        rotation, translation = state.T[:3, :3], state.T[:3, 3]
        translations = self.rotation_a @ translation - translation + self.translation_a
        translations -= state.scale * self.translation_b @ rotation.T
        error = np.swapaxes(self.rotation_a, 1, 2) @ (rotation @ self.rotation_b @ rotation.T)
        rotations = se3.rotation_log(error)
        if self.twists_i is not None:
            by_translation, by_rotation = self._offset_columns(state)
            translations += by_translation * state.offset_s
            rotations = rotations + by_rotation * state.offset_s
        return translations, rotations

    def _offset_columns(self, state):
        rotation = state.T[:3, :3]
        turn_i = np.einsum("kji,kj->ki", self.rotation_b, self.twists_i[:, 3:])
        by_rotation = (turn_i - self.twists_j[:, 3:]) @ rotation.T
        moved = self.twists_i[:, :3] + np.cross(self.twists_i[:, 3:], self.translation_b)
        moved -= np.einsum("kij,kj->ki", self.rotation_b, self.twists_j[:, :3])
        return -state.scale * moved @ rotation.T, by_rotation

    def jacobians(self, state):
        """Derivatives (K, 3, 8) of both residuals by (rho, phi, log s, d)."""
        rotation, n_pairs = state.T[:3, :3], len(self.translation_a)
        of_translation, of_rotation = np.zeros((n_pairs, 3, 8)), np.zeros((n_pairs, 3, 8))
        of_translation[:, :, :3] = (self.rotation_a - np.eye(3)) @ rotation
        of_translation[:, :, 3:6] = state.scale * rotation @ se3.skew(self.translation_b)
        of_translation[:, :, _SCALE] = -state.scale * self.translation_b @ rotation.T
        of_rotation[:, :, 3:6] = rotation @ (np.swapaxes(self.rotation_b, 1, 2) - np.eye(3))
        if self.twists_i is not None:
            of_translation[:, :, _OFFSET], of_rotation[:, :, _OFFSET] = self._offset_columns(state)
        return of_translation, of_rotation

    def sigmas(self, translations, rotations):
        """Robust standard deviations per axis, m and rad."""
        return (
            max(_sigma(translations), _LEAST_SIGMA_TRANSLATION * self.moved + 1e-12),
            max(_sigma(rotations), _LEAST_SIGMA_ROTATION),
        )

    def badness(self, state):
        """Logarithm of the likelihood's scale: small for a good fit."""
        sigma_t, sigma_r = self.sigmas(*self.residuals(state))
        return np.log(sigma_t / min(state.scale, 1.0)) + np.log(sigma_r)

    def weigh(self, translations, rotations):
        """Weights (K,) of both kinds of residuals, over their variances."""
        sigma_t, sigma_r = self.sigmas(translations, rotations)
        squared = (translations**2).sum(axis=1) / sigma_t**2 + (rotations**2).sum(axis=1) / sigma_r**2
        robust = 1.0 / (1.0 + squared / (6 * _TUNING**2)) ** 2
        return robust / sigma_t**2, robust / sigma_r**2, robust

    def refine(self, T, scale):
        """Gauss-Newton from a start; the last state and the robust weights."""
        state, robust = _State(T, scale, 0.0), None
        for _ in range(_MAX_STEPS):
            translations, rotations = self.residuals(state)
            weights_t, weights_r, robust = self.weigh(translations, rotations)
            normal, gradient = self._normal_equations(state, translations, rotations, weights_t, weights_r)
            step = _solve(normal.sum(axis=0), -gradient.sum(axis=0), self.free)
            step *= min(1.0, 1.0 / max(np.linalg.norm(step[3:6]), abs(step[_SCALE]), 1e-300))
            state = _State(state.T @ _tangent(step[:6]), state.scale * float(np.exp(step[_SCALE])), state.offset_s + step[_OFFSET])
            size = np.r_[step[:3] / max(self.moved, 1e-9), step[3:]]
            if np.abs(size).max() < _STEP_TOLERANCE:
                break
        return state, robust

    def _normal_equations(self, state, translations, rotations, weights_t, weights_r):
        """Normal matrices (B, 8, 8) and gradients (B, 8) of blocks of time."""
        of_translation, of_rotation = self.jacobians(state)
        blocks = np.array_split(np.arange(len(translations)), min(_BLOCKS, len(translations)))
        normal = np.empty((len(blocks), 8, 8))
        gradient = np.empty((len(blocks), 8))
        for row, block in enumerate(blocks):
            parts = ((of_translation, translations, weights_t), (of_rotation, rotations, weights_r))
            flat = [
                ((jacobian[block] * np.sqrt(w[block])[:, None, None]).reshape(-1, 8), (r[block] * np.sqrt(w[block])[:, None]).ravel())
                for jacobian, r, w in parts
            ]
            normal[row] = sum(j.T @ j for j, _ in flat)
            gradient[row] = sum(j.T @ r for j, r in flat)
        return normal, gradient

    def describe(self, state, robust):
        translations, rotations = self.residuals(state)
        weights_t, weights_r, robust = self.weigh(translations, rotations)
        normal, gradient = self._normal_equations(state, translations, rotations, weights_t, weights_r)
        covariance = _covariance(normal, gradient, self.free)
        sigma_t, sigma_r = self.sigmas(translations, rotations)
        return SimilarityFit(
            state.T, state.scale, state.offset_s, covariance, sigma_r, sigma_t, self.moved, self.turned, robust > 0.25
        )


def _tangent(step):
    return se3.from_rotation_translation(se3.rotation_exp(step[3:]), step[:3])


def _sigma(residuals):
    """Robust standard deviation per axis of vectors (K, 3): the median length of a normal one is 1.538 of them."""
    return float(np.median(np.linalg.norm(residuals, axis=1))) / 1.538


def _solve(normal, right, free):
    """Solution of the free unknowns' equations, in balanced units; directions without curvature stay put."""
    step = np.zeros_like(right)
    part = normal[np.ix_(free, free)]
    units = 1.0 / np.sqrt(np.maximum(np.diag(part), 1e-12 * np.diag(part).max() + 1e-300))
    balanced = part * units * units[:, None]
    step[free] = units * np.linalg.solve(balanced + _DAMPING * np.eye(len(units)), units * right[free])
    return step


def _covariance(normal, gradient, free):
    """Covariance (8, 8), the larger diagonal of model and delete-a-block jackknife for each unknown."""
    n_blocks, total = len(normal), normal.sum(axis=0)
    model = np.column_stack([_solve(total, unit, free) for unit in np.eye(8)])
    left_out = np.array([_solve(total - part, -(gradient.sum(axis=0) - g), free) for part, g in zip(normal, gradient, strict=True)])
    left_out -= left_out.mean(axis=0)
    jackknife = (n_blocks - 1) / n_blocks * left_out.T @ left_out
    return jackknife if np.trace(jackknife) > 0 else model
