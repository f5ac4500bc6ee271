"""DNLO: direct non-linear optimisation with outlier rejection (Välimäki et al. 2023, eq. 5).

For a fixed X the weights have a closed form: a pair counts if its cost is below c; if those are
fewer than d, the d pairs of the smallest cost count. DNLO is thus truncated least squares with a
minimum number of inliers. Weights and X are improved in turn until nothing changes. That ends in
one of many local minima, so a search comes first:

1. Graduated non-convexity (Yang, Antonante, Tzoumas, Carlone, *Graduated non-convexity for robust
   spatial perception*, RA-L 2020): from the minimum over all pairs, the truncation is sharpened in
   rounds.
2. Rivals: minima over random parts of the inliers and over small random subsets of all pairs. As in
   FAST-LTS (Rousseeuw, Van Driessen, *Computing LTS regression for large data sets*, 2006) many are
   started, and only the most promising are followed to the end. One from the inliers replaces the
   answer if it is better. One from any subset may be far away and must be clearly better: of
   distant minima of nearly the same height, the annealed one is more reliable. A new answer gets
   new rivals.

Of many pairs an even sample is searched; the answer is then improved on all. The random subsets
come from a fixed seed: the same pairs in the same order give the same answer.
"""

import math
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs
from hand_eye_calib.core.solvers import all_pairs, quadratic_form
from hand_eye_calib.core.solvers.all_pairs import Solution

# Largest number of pairs that is searched.
_MAX_SEARCHED = 512

# Graduated non-convexity: Gauss-Newton steps to the minimum over all pairs, factor of the sharpness
# from round to round, and the sharpness of the last round.
_STEPS_OVER_ALL = 4
_SHARPENING = 2.5
_SHARP = 30.0

# Rivals: shares of the inliers, and sizes of the subsets of all pairs (small ones escape outliers,
# large ones resist noise). As many of each kind are started as have this many pairs in all: fifty
# if there are a hundred pairs.
_INLIER_SHARES = (0.2, 0.5)
_SUBSET_SIZES = (4, 8, 16, 32)
_STARTED_PAIRS = 5000
_FIRST_ROUNDS = 3
_FOLLOWED = 3
_MAX_GENERATIONS = 3

# A rival from any subset replaces the answer if its objective is below this share of it. A new
# answer that is lower by less than the second share ends the search.
_DECISIVE = 0.99
_HARDLY = 1e-6

# Rounds of weights and X in turn, and the share by which the objective falls in the last one: in
# the search, and on all pairs.
_MAX_ROUNDS = 100
_SETTLED = 1e-4
_CONVERGED = 1e-9

# Cost of a pair that is left out: finite, and never that of an inlier.
_NEVER = 1e100


def solve(pairs: MotionPairs, threshold: float, min_inlier_fraction: float) -> Solution:
    """Minimise ``sum alpha e + (1 - alpha) c`` over X and the weights alpha.

    Parameters
    ----------
    pairs : MotionPairs
        K pairs, K >= 1.
    threshold : float
        c: cost above which a pair is an outlier, m^2.
    min_inlier_fraction : float
        d / K: the weights add up to at least this share of the pairs.

    Returns
    -------
    Solution
        ``objective`` is eq. (5) with the outliers' c included; ``weights`` are alpha.
    """
    searched = pairs
    if len(pairs) > _MAX_SEARCHED:
        searched = pairs[np.linspace(0, len(pairs) - 1, _MAX_SEARCHED).astype(int)]
    floor = min_inlier_fraction * len(searched)
    T = _Search(quadratic_form.condense(searched), threshold, floor).best(searched)
    # On all pairs, by costs from the matrices, which cancel least.
    floor = min_inlier_fraction * len(pairs)
    coefficients = quadratic_form.coefficients(pairs)
    weights, objective = truncate(quadratic_form.costs(coefficients, T), threshold, floor)
    Q = quadratic_form.weighted_sum(coefficients, weights)
    converged = False
    for _ in range(_MAX_ROUNDS):
        T_new = quadratic_form.gauss_newton_step(Q, T[None])[0]
        # Without a predicted decrease, no pass over the pairs is needed.
        converged = bool(quadratic_form.decrease(Q, T, T_new) < _CONVERGED * objective)
        if converged:
            break
        weights_new, objective_new = truncate(
            quadratic_form.costs(coefficients, T_new), threshold, floor
        )
        converged = bool(objective_new >= objective * (1 - _CONVERGED))
        if objective_new <= objective:
            changed = np.flatnonzero(weights_new != weights)
            Q = Q + quadratic_form.weighted_sum(
                coefficients[changed], weights_new[changed] - weights[changed]
            )
            T = T_new
            weights = weights_new
            objective = objective_new
        if converged:
            break
    return Solution(T, float(objective), converged, weights)


def solve_without(
    pairs: MotionPairs,
    solution: Solution,
    left_out: BoolArray,
    threshold: float,
    min_inlier_fraction: float,
) -> FloatArray:
    """Solve again without some of the pairs, for resampling.

    A few pairs less may change the choice of the inliers and with it the answer, which is followed
    from the full one.

    Parameters
    ----------
    pairs, threshold, min_inlier_fraction
        As for :func:`solve`.
    solution : Solution
        The solution with all K pairs.
    left_out : (B, K) bool array
        Pairs to leave out, for each of B answers (B, 4, 4).
    """
    fewest = min_inlier_fraction * float((~left_out).sum(axis=1).min())
    search = _Search(quadratic_form.condense(pairs), threshold, fewest)
    near = np.repeat(solution.T_parent_child[None], len(left_out), axis=0)
    return search.settle(near, _CONVERGED, left_out)[0]


def truncate(costs: FloatArray, threshold: float, floor: float) -> tuple[FloatArray, FloatArray]:
    """The best weights (..., K) for costs (..., K) of the pairs at one X or several, and their
    objectives (...), eq. (5). The threshold is c, in the unit of the costs; the weights add up to
    at least d, the floor. Pairs of equal cost share what those of smaller cost leave of it.
    """
    counted = costs < threshold
    too_few = counted.sum(axis=-1) < floor
    weights = counted.astype(float)
    if too_few.any():
        last = math.ceil(floor) - 1
        largest = np.partition(costs, last, axis=-1)[..., last, None]
        counted |= costs <= largest  # these count already if there are enough
        weights = counted.astype(float)
        excess = too_few * (counted.sum(axis=-1) - floor)
        if excess.any():
            tied = costs == largest
            weights -= tied * (excess / np.maximum(tied.sum(axis=-1), 1))[..., None]
    return weights, np.einsum("...k,...k", weights, costs) + threshold * (
        costs.shape[-1] - weights.sum(axis=-1)
    )


@dataclass(frozen=True)
class _Search:
    """A search over condensed pairs (K, 91) with the threshold c and the floor d. Pairs that are
    left out, (S, K) bool arrays, are so at each of S transforms.
    """

    condensed: FloatArray
    threshold: float
    floor: float

    def costs(self, Ts: FloatArray, left_out: BoolArray | None = None) -> FloatArray:
        """Costs (S, K) of all pairs at each transform (S, 4, 4)."""
        costs: FloatArray = quadratic_form.monomials(Ts) @ self.condensed.T
        if left_out is not None:
            costs[left_out] = _NEVER
        return costs

    def refit(self, weights: FloatArray, Ts: FloatArray) -> FloatArray:
        """Gauss-Newton step (S, 4, 4) from each transform with its weights (S, K)."""
        forms = quadratic_form.expand(weights @ self.condensed)
        return quadratic_form.gauss_newton_step(forms, Ts)

    def best(self, pairs: MotionPairs) -> FloatArray:
        """The annealed answer (4, 4), or a better rival."""
        total = self.condensed.sum(axis=0)
        Ts = se3.from_rotation_translation(all_pairs.start_rotations(pairs), np.zeros(3))
        for _ in range(_STEPS_OVER_ALL):
            Ts = quadratic_form.gauss_newton_step(quadratic_form.expand(total), Ts)
        near_all = Ts[[int(np.argmin(quadratic_form.monomials(Ts) @ total))]]
        best, objective = self.settle(self.anneal(near_all))
        random = np.random.default_rng(0)
        for _ in range(_MAX_GENERATIONS):
            rivals, objectives = self.settle(self._rivals(best, random))
            before = objective
            for kind, enough in ((slice(_FOLLOWED), 1.0), (slice(_FOLLOWED, None), _DECISIVE)):
                first = [(kind.start or 0) + int(np.argmin(objectives[kind]))]
                if objectives[first] < enough * objective:
                    best = rivals[first]
                    objective = objectives[first]
            if objective >= before * (1 - _HARDLY):
                break
        return best[0]

    def _rivals(self, T: FloatArray, random: np.random.Generator) -> FloatArray:
        """The most promising minima (6, 4, 4): three over random parts of the inliers of T
        (1, 4, 4), then three over small random subsets.
        """
        n_pairs = len(self.condensed)
        started = 4 * (1 + _STARTED_PAIRS // (4 * n_pairs))
        inliers, _ = truncate(self.costs(T), self.threshold, self.floor)
        near = np.repeat(_INLIER_SHARES, started // 2)[:, None] * inliers
        anywhere = np.repeat(_SUBSET_SIZES, started // 4)[:, None] * np.full(n_pairs, 1 / n_pairs)
        chances = np.concatenate([near, anywhere])
        weights = (random.random(chances.shape) < chances).astype(float)
        Ts = np.repeat(T, len(weights), axis=0)
        for _ in range(_FIRST_ROUNDS):
            Ts = self.refit(weights, Ts)
            weights, objectives = truncate(self.costs(Ts), self.threshold, self.floor)
        order = np.argsort(objectives.reshape(2, started), axis=1, kind="stable")
        return Ts[(order[:, :_FOLLOWED] + [[0], [started]]).ravel()]

    def anneal(self, Ts: FloatArray) -> FloatArray:
        """Graduated non-convexity from each start (S, 4, 4), with the truncation at c or at the
        d-th smallest cost, whichever is larger.
        """
        last = max(math.ceil(self.floor) - 1, 0)
        sharpness = np.zeros(len(Ts))
        while True:
            costs = self.costs(Ts)
            cut = np.maximum(self.threshold, np.partition(costs, last)[:, last])
            if not sharpness.any():
                largest = costs.max(axis=1)
                sharpness = np.maximum(cut / np.maximum(2 * largest - cut, cut), 1e-4)
            if sharpness.min() >= _SHARP:
                return Ts
            cuts = (cut * sharpness * (sharpness + 1))[:, None]
            ratio = np.sqrt(cuts / np.maximum(costs, 1e-300)) - sharpness[:, None]
            Ts = self.refit(ratio.clip(0.0, 1.0), Ts)
            sharpness = sharpness * _SHARPENING

    def settle(
        self, Ts: FloatArray, tolerance: float = _SETTLED, left_out: BoolArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Take Gauss-Newton steps and new weights in turn until no objective falls; returns the
        best transforms (S, 4, 4) and their objectives (S,). Those that have converged wait for the
        others.
        """
        weights, objectives = truncate(self.costs(Ts, left_out), self.threshold, self.floor)
        Ts, falling = Ts.copy(), np.arange(len(Ts))
        for _ in range(_MAX_ROUNDS):
            Ts_new = self.refit(weights, Ts[falling])
            before = objectives[falling]
            costs = self.costs(Ts_new, None if left_out is None else left_out[falling])
            weights, new = truncate(costs, self.threshold, self.floor)
            better = new < before
            Ts[falling[better]], objectives[falling[better]] = Ts_new[better], new[better]
            if (new >= before * (1 - tolerance)).all():
                break
            still = new < before * (1 - _CONVERGED)
            falling = falling[still]
            weights = weights[still]
        return Ts, objectives
