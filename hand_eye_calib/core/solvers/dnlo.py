"""DNLO: direct non-linear optimisation with outlier rejection (Välimäki et al. 2023, eq. 5).

Minimise ``sum_k alpha_k e_k(X) + (1 - alpha_k) c`` over X and over weights 0 <= alpha_k <= 1 that
sum to at least d. The cost of motion pair k is ``e_k = |A X - X B|_F^2``. For a fixed X the weights
have a closed form: alpha_k is 1 if e_k is below c, else 0; if fewer than d pairs are below c, the d
pairs of smallest cost have weight 1. So DNLO is truncated least squares with a minimum number of
inliers. Weights and X are improved alternately until nothing changes. This iteration ends in one of
many local minima, so it follows a search for a good start:

1. Graduated non-convexity (Yang, Antonante, Tzoumas, Carlone, *Graduated non-convexity for robust
   spatial perception*, RA-L 2020). The iteration starts from the minimum over all pairs, with soft
   weights that become sharper in each round.
2. Rivals: minima over random subsets of the inliers, and over small random subsets of all pairs. As
  in FAST-LTS (Rousseeuw, Van Driessen, *Computing LTS regression for large data sets*, 2006), many
  rivals are started, and only the most promising rivals are iterated to the end. A rival from the
  inliers replaces the solution if its objective is smaller. A rival from all pairs may be far away,
  so its objective must be clearly smaller: among distant minima of nearly equal objective, the
  minimum of graduated non-convexity is more reliable. A new solution gets new rivals.

If there are many pairs, the search uses an even sample; then the solution is refined on all pairs.
The random subsets have a fixed seed: the same pairs in the same order yield the same solution.
"""

import math
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs
from hand_eye_calib.core.solvers import all_pairs, quadratic_form
from hand_eye_calib.core.solvers.all_pairs import Solution

# Largest number of pairs in the sample that is searched.
_MAX_SEARCHED = 512

# Number of Gauss-Newton steps to the minimum over all pairs, from which graduated non-convexity
# starts.
_STEPS_OVER_ALL = 4
# Factor of the sharpness (mu of Yang et al.) from round to round.
_SHARPENING = 2.5
# The rounds end at this sharpness: the weights are then almost 0 or 1.
_MAX_SHARPNESS = 30.0

# Shares of the inliers in the random subsets of inliers.
_INLIER_SHARES = (0.2, 0.5)
# Sizes of the random subsets of all pairs. Small subsets are often free of outliers, large ones
# average noise.
_SUBSET_SIZES = (4, 8, 16, 32)
# Number of rivals from each kind of subset, times the number of pairs: about 50 rivals for 100
# pairs.
_RIVALS_TIMES_PAIRS = 5000
# Number of rounds before the most promising rivals are chosen.
_FIRST_ROUNDS = 3
# Number of the most promising rivals from each kind of subset. Only these are iterated to the end.
_N_PROMISING = 3
# Largest number of times that rivals are started.
_MAX_GENERATIONS = 3

# A rival from a subset of all pairs replaces the solution if its objective is below this share of
# the solution's objective.
_CLEARLY_SMALLER = 0.99
# The search ends if new rivals lower the objective by less than this share.
_MIN_GAIN_OF_RIVALS = 1e-6

# Largest number of rounds in an iteration, each with new weights and a new X.
_MAX_ROUNDS = 100
# In the search, an iteration ends if a round lowers the objective by less than this share.
_SEARCH_TOLERANCE = 1e-4
# The refinement on all pairs ends if a round lowers the objective by less than this share.
_TOLERANCE = 1e-9

# Cost of an omitted pair: finite, but larger than any threshold.
_COST_OF_LEFT_OUT = 1e100


def solve(
    pairs: MotionPairs, threshold: float, min_inlier_fraction: float
) -> Solution:
    """Minimise eq. (5) over X and the weights alpha.

    Parameters
    ----------
    pairs : MotionPairs
        K motion pairs, K >= 1.
    threshold : float
        c: cost (m^2) above which a pair is an outlier.
    min_inlier_fraction : float
        d / K: the sum of all weights is at least this share of K.

    Returns
    -------
    Solution
        ``objective`` is eq. (5), which contains c for each outlier. ``weights`` are alpha.
    """
    searched = pairs
    if len(pairs) > _MAX_SEARCHED:
        rows = np.linspace(0, len(pairs) - 1, _MAX_SEARCHED).astype(int)
        searched = pairs[rows]
    floor = min_inlier_fraction * len(searched)
    search = _Search(quadratic_form.condense(searched), threshold, floor)
    T = search.best(searched)
    return _refined(pairs, T, threshold, min_inlier_fraction * len(pairs))


def _refined(
    pairs: MotionPairs, T: FloatArray, threshold: float, floor: float
) -> Solution:
    """Improve X and the weights alternately on all pairs, from a start T (4, 4).

    ``floor`` is d. The costs are computed from the coefficients of the pairs, which have more
    digits than the quadratic forms.
    """
    coefficients = quadratic_form.coefficients(pairs)
    weights, objective = truncate(
        quadratic_form.costs(coefficients, T), threshold, floor
    )
    Q = quadratic_form.weighted_sum(coefficients, weights)
    converged = False
    for _ in range(_MAX_ROUNDS):
        T_new = quadratic_form.gauss_newton_step(Q, T[None])[0]
        # If the form predicts no decrease, the costs of the pairs are not needed.
        converged = bool(
            quadratic_form.decrease(Q, T, T_new) < _TOLERANCE * objective
        )
        if converged:
            break
        costs = quadratic_form.costs(coefficients, T_new)
        weights_new, objective_new = truncate(costs, threshold, floor)
        converged = bool(objective_new >= objective * (1 - _TOLERANCE))
        if objective_new <= objective:
            # Update the form by the pairs whose weight has changed.
            changed = np.flatnonzero(weights_new != weights)
            changes = weights_new[changed] - weights[changed]
            Q = Q + quadratic_form.weighted_sum(coefficients[changed], changes)
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
    """Solve B times, each time without some pairs, for resampling.

    The iterations start from the solution with all pairs. Other pairs may become inliers.

    Parameters
    ----------
    pairs, threshold, min_inlier_fraction
        Arguments of :func:`solve`.
    solution : Solution
        Solution with all K pairs.
    left_out : (B, K) bool array
        Pairs that are omitted in each solution.

    Returns
    -------
    (B, 4, 4) array
        Transforms X.
    """
    n_remaining = (~left_out).sum(axis=1)
    fewest = min_inlier_fraction * float(n_remaining.min())
    search = _Search(quadratic_form.condense(pairs), threshold, fewest)
    starts = np.repeat(solution.T_parent_child[None], len(left_out), axis=0)
    return search.settle(starts, _TOLERANCE, left_out)[0]


def truncate(
    costs: FloatArray, threshold: float, floor: float
) -> tuple[FloatArray, FloatArray]:
    """Return the weights alpha that minimise eq. (5) for given costs, and the objectives.

    Parameters
    ----------
    costs : (..., K) array
        Costs of K pairs, at one X or at several.
    threshold : float
        c, in the unit of the costs.
    floor : float
        d: smallest sum of the weights. It may be fractional. If fewer pairs are below c, the d
        pairs with the smallest costs have weight 1. If d is fractional, or if costs are equal, the
        pairs with the largest of these costs have equal weights below 1, so that the sum is d.

    Returns
    -------
    (..., K) array
        Weights alpha.
    (...) array
        Objectives, eq. (5).
    """
    is_inlier = costs < threshold
    too_few = is_inlier.sum(axis=-1) < floor
    weights = is_inlier.astype(float)
    if too_few.any():
        last = math.ceil(floor) - 1
        largest = np.partition(costs, last, axis=-1)[..., last, None]
        # If enough pairs are below c, they include the d smallest costs, and nothing changes.
        is_inlier |= costs <= largest
        weights = is_inlier.astype(float)
        excess = too_few * (is_inlier.sum(axis=-1) - floor)
        if excess.any():
            is_tied = costs == largest
            n_tied = np.maximum(is_tied.sum(axis=-1), 1)
            weights -= is_tied * (excess / n_tied)[..., None]
    n_outliers = costs.shape[-1] - weights.sum(axis=-1)
    of_inliers = np.einsum("...k,...k", weights, costs)
    return weights, of_inliers + threshold * n_outliers


@dataclass(frozen=True)
class _Search:
    """Search for the X and the inliers with the smallest objective.

    Attributes
    ----------
    condensed : (K, 91) array
        Quadratic forms of the pairs, see
        :func:`~hand_eye_calib.core.solvers.quadratic_form.condense`.
    threshold, floor : float
        c and d, see :func:`truncate`.
    """

    condensed: FloatArray
    threshold: float
    floor: float

    def costs(
        self, Ts: FloatArray, left_out: BoolArray | None = None
    ) -> FloatArray:
        """Return the costs (S, K) of all pairs at each transform (S, 4, 4).

        Pairs in ``left_out`` (S, K) get a very large cost.
        """
        costs: FloatArray = quadratic_form.monomials(Ts) @ self.condensed.T
        if left_out is not None:
            costs[left_out] = _COST_OF_LEFT_OUT
        return costs

    def refit(self, weights: FloatArray, Ts: FloatArray) -> FloatArray:
        """Take a Gauss-Newton step from each transform (S, 4, 4), with weights (S, K)."""
        forms = quadratic_form.expand(weights @ self.condensed)
        return quadratic_form.gauss_newton_step(forms, Ts)

    def best(self, pairs: MotionPairs) -> FloatArray:
        """Return the solution (4, 4) of graduated non-convexity, or a rival that is better.

        ``pairs`` are the motion pairs of the forms.
        """
        total = self.condensed.sum(axis=0)
        Ts = se3.from_rotation_translation(
            all_pairs.start_rotations(pairs), np.zeros(3)
        )
        for _ in range(_STEPS_OVER_ALL):
            Ts = quadratic_form.gauss_newton_step(
                quadratic_form.expand(total), Ts
            )
        of_all = int(np.argmin(quadratic_form.monomials(Ts) @ total))
        best, objectives = self.settle(self.anneal(Ts[[of_all]]))
        objective = objectives[0]
        random = np.random.default_rng(0)
        for _ in range(_MAX_GENERATIONS):
            rivals, objectives = self.settle(self._rivals(best, random))
            before = objective
            # The first rivals come from subsets of the inliers, the other rivals from subsets of
            # all pairs.
            for first, limit in ((0, 1.0), (_N_PROMISING, _CLEARLY_SMALLER)):
                of_kind = objectives[first : first + _N_PROMISING]
                rival = first + int(np.argmin(of_kind))
                if objectives[rival] < limit * objective:
                    best = rivals[[rival]]
                    objective = objectives[rival]
            if objective >= before * (1 - _MIN_GAIN_OF_RIVALS):
                break
        return best[0]

    def _rivals(self, T: FloatArray, random: np.random.Generator) -> FloatArray:
        """Return the most promising rivals (6, 4, 4) of a minimum T (1, 4, 4).

        The first three come from random subsets of the inliers of T, the other three from small
        random subsets of all pairs.
        """
        n_pairs = len(self.condensed)
        # Number of rivals from each kind of subset. It is a multiple of 4, so that all shares and
        # all sizes occur equally often.
        n_rivals = 4 * (1 + _RIVALS_TIMES_PAIRS // (4 * n_pairs))
        inliers, _ = truncate(self.costs(T), self.threshold, self.floor)
        # Probability (2 n_rivals, K) with which each pair is in the subset of each rival.
        shares = np.repeat(_INLIER_SHARES, n_rivals // 2)
        sizes = np.repeat(_SUBSET_SIZES, n_rivals // 4)
        of_inliers = shares[:, None] * inliers
        of_all = sizes[:, None] * np.full(n_pairs, 1 / n_pairs)
        probabilities = np.concatenate([of_inliers, of_all])
        weights = (random.random(probabilities.shape) < probabilities).astype(
            float
        )
        Ts = np.repeat(T, len(weights), axis=0)
        for _ in range(_FIRST_ROUNDS):
            Ts = self.refit(weights, Ts)
            weights, objectives = truncate(
                self.costs(Ts), self.threshold, self.floor
            )
        order = np.argsort(
            objectives.reshape(2, n_rivals), axis=1, kind="stable"
        )
        promising = order[:, :_N_PROMISING]
        return np.concatenate([Ts[promising[0]], Ts[n_rivals + promising[1]]])

    def anneal(self, Ts: FloatArray) -> FloatArray:
        """Return the results (S, 4, 4) of graduated non-convexity from each start (S, 4, 4).

        The costs are truncated at c, or at the d-th smallest cost if that is larger. The weight of
        a pair with cost e is ``sqrt(c mu (mu + 1) / e) - mu``, limited to 0 and 1 (GNC-TLS of Yang
        et al.). The sharpness mu grows from round to round.
        """
        last = max(math.ceil(self.floor) - 1, 0)
        sharpness = np.zeros(len(Ts))
        while True:
            costs = self.costs(Ts)
            truncation = np.maximum(
                self.threshold, np.partition(costs, last)[:, last]
            )
            if not sharpness.any():
                # In the first round, the weights of all pairs are above zero.
                largest = costs.max(axis=1)
                sharpness = truncation / np.maximum(
                    2 * largest - truncation, truncation
                )
                sharpness = np.maximum(sharpness, 1e-4)
            if sharpness.min() >= _MAX_SHARPNESS:
                return Ts
            numerators = (truncation * sharpness * (sharpness + 1))[:, None]
            ratio = np.sqrt(numerators / np.maximum(costs, quadratic_form.TINY))
            weights = (ratio - sharpness[:, None]).clip(0.0, 1.0)
            Ts = self.refit(weights, Ts)
            sharpness = sharpness * _SHARPENING

    def settle(
        self,
        Ts: FloatArray,
        tolerance: float = _SEARCH_TOLERANCE,
        left_out: BoolArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Alternate Gauss-Newton steps and new weights until no objective decreases.

        Parameters
        ----------
        Ts : (S, 4, 4) array
            Starts.
        tolerance : float
            The iteration ends if no objective decreases by a larger share.
        left_out : (S, K) bool array, optional
            Pairs that are omitted for each start.

        Returns
        -------
        (S, 4, 4) array
            The best transforms.
        (S,) array
            Their objectives.
        """
        weights, objectives = truncate(
            self.costs(Ts, left_out), self.threshold, self.floor
        )
        Ts = Ts.copy()
        # Indices of the starts whose objective still decreases.
        active = np.arange(len(Ts))
        for _ in range(_MAX_ROUNDS):
            Ts_new = self.refit(weights, Ts[active])
            before = objectives[active]
            costs = self.costs(
                Ts_new, None if left_out is None else left_out[active]
            )
            weights, after = truncate(costs, self.threshold, self.floor)
            better = after < before
            Ts[active[better]] = Ts_new[better]
            objectives[active[better]] = after[better]
            if (after >= before * (1 - tolerance)).all():
                break
            is_active = after < before * (1 - _TOLERANCE)
            active = active[is_active]
            weights = weights[is_active]
        return Ts, objectives
