"""DNLO: direct non-linear optimisation with outlier rejection (Välimäki et al. 2023, eq. 5).

Minimise ``sum alpha_k e_k(X) + (1 - alpha_k) c`` over X and weights 0 <= alpha_k <= 1 that sum to
at least d, with ``e_k = |A X - X B|_F^2``. For a fixed X the weights have a closed form: a pair
counts if its cost is below c; if fewer than d pairs are, the d pairs of the smallest cost count.
DNLO is thus truncated least squares with a minimum number of inliers. Weights and X are improved in
turn until nothing changes. That ends in one of many local minima, so a search comes first:

1. Graduated non-convexity (Yang, Antonante, Tzoumas, Carlone, *Graduated non-convexity for robust
   spatial perception*, RA-L 2020): from the minimum over all pairs, the truncation is sharpened in
   rounds.
2. Rivals: minima over random parts of the inliers and over small random subsets of all pairs. As in
   FAST-LTS (Rousseeuw, Van Driessen, *Computing LTS regression for large data sets*, 2006) many are
   started, and only the most promising are followed to the end. A rival from the inliers replaces
   the solution if it is better. A rival from any subset may be far away and must be clearly better:
   of distant minima of nearly the same height, the annealed one is more reliable. A new solution
   gets new rivals.

If there are many pairs, an even sample is searched; the solution is then improved on all pairs. The
random subsets come from a fixed seed: the same pairs in the same order have the same solution.
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

# Gauss-Newton steps to the minimum over all pairs, where graduated non-convexity starts.
_STEPS_OVER_ALL = 4
# Factor of the sharpness (mu of Yang et al.) from round to round.
_SHARPENING = 2.5
# Sharpness of the last round: the weights are then almost 0 or 1.
_SHARP = 30.0

# Shares of the inliers that a rival of the first kind is fitted to.
_INLIER_SHARES = (0.2, 0.5)
# Numbers of pairs that a rival of the second kind is fitted to. Small subsets escape outliers,
# large ones resist noise.
_SUBSET_SIZES = (4, 8, 16, 32)
# Number of started rivals of each kind times number of pairs: about 50 rivals for 100 pairs.
_STARTED_PAIRS = 5000
# Rounds before the most promising rivals are chosen.
_FIRST_ROUNDS = 3
# Most promising rivals of each kind, which are followed to the end.
_FOLLOWED = 3
# Largest number of times that rivals are started.
_MAX_GENERATIONS = 3

# A rival from a subset of all pairs replaces the solution if its objective is below this share of
# the solution's.
_DECISIVE = 0.99
# A generation of rivals that lowers the objective by a smaller share is the last.
_NEGLIGIBLE = 1e-6

# Largest number of rounds, each with new weights and a new X.
_MAX_ROUNDS = 100
# A round of the search that lowers the objective by a smaller share is the last.
_SETTLED = 1e-4
# The same share for the refinement on all pairs.
_CONVERGED = 1e-9

# Cost of a pair that is left out: finite, and larger than the cost of any inlier.
_NEVER = 1e100


def solve(pairs: MotionPairs, threshold: float, min_inlier_fraction: float) -> Solution:
    """Minimise eq. (5) over X and the weights alpha.

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
    return _refined(pairs, T, threshold, min_inlier_fraction * len(pairs))


def _refined(pairs: MotionPairs, T: FloatArray, threshold: float, floor: float) -> Solution:
    """Improve X (4, 4) and the weights in turn on all pairs.

    The costs are computed from the coefficients of the pairs, which lose fewer digits than forms.
    """
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
        costs = quadratic_form.costs(coefficients, T_new)
        weights_new, objective_new = truncate(costs, threshold, floor)
        converged = bool(objective_new >= objective * (1 - _CONVERGED))
        if objective_new <= objective:
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
    """Solve again without some of the pairs, for resampling.

    The iteration starts from the full solution. With fewer pairs, other pairs may become inliers.

    Parameters
    ----------
    pairs, threshold, min_inlier_fraction
        As for :func:`solve`.
    solution : Solution
        The solution with all K pairs.
    left_out : (B, K) bool array
        Pairs to leave out of each of B solutions.

    Returns
    -------
    (B, 4, 4) array
    """
    fewest = min_inlier_fraction * float((~left_out).sum(axis=1).min())
    search = _Search(quadratic_form.condense(pairs), threshold, fewest)
    starts = np.repeat(solution.T_parent_child[None], len(left_out), axis=0)
    return search.settle(starts, _CONVERGED, left_out)[0]


def truncate(costs: FloatArray, threshold: float, floor: float) -> tuple[FloatArray, FloatArray]:
    """Return the best weights for the costs of the pairs at one X or several.

    Parameters
    ----------
    costs : (..., K) array
    threshold : float
        c, in the unit of the costs.
    floor : float
        d: the weights add up to at least d. If fewer pairs are below c, pairs of equal cost share
        the remainder of d.

    Returns
    -------
    (..., K) array
        Weights alpha.
    (...) array
        Objectives, eq. (5).
    """
    counted = costs < threshold
    too_few = counted.sum(axis=-1) < floor
    weights = counted.astype(float)
    if too_few.any():
        last = math.ceil(floor) - 1
        largest = np.partition(costs, last, axis=-1)[..., last, None]
        # This changes nothing for an X with enough pairs below c: they include the d smallest.
        counted |= costs <= largest
        weights = counted.astype(float)
        excess = too_few * (counted.sum(axis=-1) - floor)
        if excess.any():
            tied = costs == largest
            weights -= tied * (excess / np.maximum(tied.sum(axis=-1), 1))[..., None]
    n_outliers = costs.shape[-1] - weights.sum(axis=-1)
    return weights, np.einsum("...k,...k", weights, costs) + threshold * n_outliers


@dataclass(frozen=True)
class _Search:
    """A search for the best inliers.

    Attributes
    ----------
    condensed : (K, 91) array
        Forms of the pairs.
    threshold, floor : float
        c and d, see :func:`truncate`.
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
        """Take a Gauss-Newton step from each transform (S, 4, 4) with its weights (S, K)."""
        forms = quadratic_form.expand(weights @ self.condensed)
        return quadratic_form.gauss_newton_step(forms, Ts)

    def best(self, pairs: MotionPairs) -> FloatArray:
        """Return the annealed solution (4, 4), or a better rival."""
        total = self.condensed.sum(axis=0)
        Ts = se3.from_rotation_translation(all_pairs.start_rotations(pairs), np.zeros(3))
        for _ in range(_STEPS_OVER_ALL):
            Ts = quadratic_form.gauss_newton_step(quadratic_form.expand(total), Ts)
        of_all = int(np.argmin(quadratic_form.monomials(Ts) @ total))
        best, objectives = self.settle(self.anneal(Ts[[of_all]]))
        objective = objectives[0]
        random = np.random.default_rng(0)
        for _ in range(_MAX_GENERATIONS):
            rivals, objectives = self.settle(self._rivals(best, random))
            before = objective
            # The first rivals come from inliers, the others from subsets of all pairs.
            for first, share in ((0, 1.0), (_FOLLOWED, _DECISIVE)):
                rival = first + int(np.argmin(objectives[first : first + _FOLLOWED]))
                if objectives[rival] < share * objective:
                    best = rivals[[rival]]
                    objective = objectives[rival]
            if objective >= before * (1 - _NEGLIGIBLE):
                break
        return best[0]

    def _rivals(self, T: FloatArray, random: np.random.Generator) -> FloatArray:
        """Return the most promising rivals (6, 4, 4) of a minimum T (1, 4, 4).

        Three are minima over random parts of the inliers of T; three are minima over small random
        subsets of all pairs.
        """
        n_pairs = len(self.condensed)
        # A multiple of the numbers of shares and sizes.
        started = 4 * (1 + _STARTED_PAIRS // (4 * n_pairs))
        inliers, _ = truncate(self.costs(T), self.threshold, self.floor)
        of_inliers = np.repeat(_INLIER_SHARES, started // 2)[:, None] * inliers
        of_all = np.repeat(_SUBSET_SIZES, started // 4)[:, None] * np.full(n_pairs, 1 / n_pairs)
        probabilities = np.concatenate([of_inliers, of_all])
        weights = (random.random(probabilities.shape) < probabilities).astype(float)
        Ts = np.repeat(T, len(weights), axis=0)
        for _ in range(_FIRST_ROUNDS):
            Ts = self.refit(weights, Ts)
            weights, objectives = truncate(self.costs(Ts), self.threshold, self.floor)
        order = np.argsort(objectives.reshape(2, started), axis=1, kind="stable")
        promising = order[:, :_FOLLOWED]
        return np.concatenate([Ts[promising[0]], Ts[started + promising[1]]])

    def anneal(self, Ts: FloatArray) -> FloatArray:
        """Return the ends (S, 4, 4) of graduated non-convexity from each start (S, 4, 4).

        The costs are truncated at c or at the d-th smallest cost, whichever is larger. The weight
        of a pair with cost e is ``sqrt(c mu (mu + 1) / e) - mu``, limited to 0 and 1 (GNC-TLS of
        Yang et al.). The sharpness mu grows from round to round.
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
            ratio = np.sqrt(cuts / np.maximum(costs, quadratic_form.TINY))
            weights = (ratio - sharpness[:, None]).clip(0.0, 1.0)
            Ts = self.refit(weights, Ts)
            sharpness = sharpness * _SHARPENING

    def settle(
        self, Ts: FloatArray, tolerance: float = _SETTLED, left_out: BoolArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Take Gauss-Newton steps and new weights in turn until no objective falls.

        Parameters
        ----------
        Ts : (S, 4, 4) array
            Starts.
        tolerance : float
            The rounds end if no objective falls by a larger share.
        left_out : (S, K) bool array, optional
            Pairs to leave out at each start.

        Returns
        -------
        (S, 4, 4) array
            The best transforms.
        (S,) array
            Their objectives.
        """
        weights, objectives = truncate(self.costs(Ts, left_out), self.threshold, self.floor)
        Ts = Ts.copy()
        # Starts whose objective still falls. The other starts are done.
        falling = np.arange(len(Ts))
        for _ in range(_MAX_ROUNDS):
            Ts_new = self.refit(weights, Ts[falling])
            before = objectives[falling]
            costs = self.costs(Ts_new, None if left_out is None else left_out[falling])
            weights, after = truncate(costs, self.threshold, self.floor)
            better = after < before
            Ts[falling[better]] = Ts_new[better]
            objectives[falling[better]] = after[better]
            if (after >= before * (1 - tolerance)).all():
                break
            still_falling = after < before * (1 - _CONVERGED)
            falling = falling[still_falling]
            weights = weights[still_falling]
        return Ts, objectives
