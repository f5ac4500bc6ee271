"""DNLO: direct non-linear optimisation with outlier rejection (Välimäki et al. 2023, eq. 5).

For a fixed X the weights have a closed form: a pair counts where its cost is below c, and where
that keeps fewer than d pairs, the d cheapest count. DNLO is thus truncated least squares with a
floor on the inliers. Weights and X are improved in turn until nothing changes. Since that ends in
one of many local minima, a search comes first:

1. Graduated non-convexity (Yang, Antonante, Tzoumas, Carlone, *Graduated non-convexity for robust spatial perception*, RA-L
   2020): from the minimum over all pairs, the truncation is switched on by degrees.
2. Rivals: minima over random parts of its inliers and over small random subsets of all pairs. As in FAST-LTS (Rousseeuw, Van
   Driessen, *Computing LTS regression for large data sets*, 2006) many are started, and only the
   most promising followed to the end. One from the answer's own inliers replaces it where it is
   better. One from anywhere may lie far away and must be decisively better: between distant minima
   of nearly the same height, the annealed one is the more trustworthy. A new answer has new rivals.

Many pairs are searched by an even sample of them; the answer is then improved on all. The random
subsets come from a fixed seed: the same pairs in the same order give the same answer.
"""

import math

import numpy as np

from hand_eye_calib.geometry import se3
from hand_eye_calib.solvers import dnl, quadratic_form
from hand_eye_calib.solvers.solution import Solution

# The most pairs that are searched.
_MAX_SEARCHED = 512

# Graduated non-convexity: Gauss-Newton steps to the minimum over all pairs, how much sharper the
# truncation gets each round, and where it counts as sharp.
_STEPS_OVER_ALL = 4
_SHARPENING = 2.5
_SHARP = 30.0

# Rivals: shares of the inliers for those near an answer; sizes for those anywhere (small ones
# escape outliers, large ones resist noise). Of each kind as many are started as make up so many
# pairs in all: fifty where there are a hundred pairs.
_INLIER_SHARES = (0.2, 0.5)
_SUBSET_SIZES = (4, 8, 16, 32)
_STARTED_PAIRS = 5000
_FIRST_ROUNDS, _FOLLOWED, _MAX_GENERATIONS = 3, 3, 3

# A rival from anywhere replaces the answer when its objective is below this share of it. A new
# answer that is hardly lower ends the search.
_DECISIVE = 0.99
_HARDLY = 1e-6

# Rounds of weights and X in turn, and the share by which the objective falls when they end: in the
# search, and on all pairs.
_MAX_ROUNDS = 100
_SETTLED, _CONVERGED = 1e-4, 1e-9

# The cost of a pair that is left out: finite, and never an inlier's.
_NEVER = 1e100


def solve(pairs, threshold, min_inlier_fraction):
    """Minimise ``sum alpha e + (1 - alpha) c`` over X and the weights alpha.

    Parameters
    ----------
    pairs : MotionPairs
        K pairs, K >= 1.
    threshold : float
        c: cost above which a pair is an outlier, m^2.
    min_inlier_fraction : float
        d / K: share of the pairs whose weights must add up to at least that.

    Returns
    -------
    Solution
        ``objective`` is eq. (5) with the outliers' c included; ``weights`` are alpha.
    """
    searched = pairs[_searched(len(pairs))]
    T_found = _search(searched, threshold, min_inlier_fraction * len(searched))
    return _finish(pairs, T_found, threshold, min_inlier_fraction * len(pairs))


def solve_without(pairs, solution, left_out, threshold, min_inlier_fraction):
    """Answers when some pairs are left out, for resampling.

    A few pairs less may tip the choice of the inliers, and the answer with it: the search starts at
    the full answer, and by annealing. As in :func:`solve`, an even sample of many pairs is
    searched, and the answers are then improved on all.

    Parameters
    ----------
    pairs : MotionPairs
        K pairs.
    solution : Solution
        The answer for all of them.
    left_out : (B, K) bool array
        Pairs to leave out, for each of B answers.
    threshold, min_inlier_fraction : float
        As for :func:`solve`.

    Returns
    -------
    (B, 4, 4) array
    """
    condensed = quadratic_form.condense(pairs)
    fewest = min_inlier_fraction * float((~left_out).sum(axis=1).min())
    some = _searched(len(pairs))
    condensed_some, left_out_some = condensed[some], left_out[:, some]
    fewest_of_some = min_inlier_fraction * float((~left_out_some).sum(axis=1).min())
    near = np.repeat(solution.T_parent_child[None], len(left_out), axis=0)
    everything = near
    for _ in range(_STEPS_OVER_ALL):
        everything = _refit(condensed_some, (~left_out_some).astype(float), everything)
    annealed = _anneal(condensed_some, everything, threshold, fewest_of_some, left_out_some)
    twice = np.tile(left_out_some, (2, 1))
    candidates, _ = _settle(
        condensed_some, np.concatenate([near, annealed]), threshold, fewest_of_some, _SETTLED, twice
    )
    # An answer for some of the pairs may be better for others than what was found from there.
    costs = _costs(condensed_some, candidates)
    best = [
        np.argmin(truncate(costs[:, ~row], threshold, fewest_of_some)[1]) for row in left_out_some
    ]
    # The sample may be wrong about which of two minima is the lower one: all pairs decide between
    # the best and the one nearby.
    rivals, twice = np.concatenate([near, candidates[best]]), np.tile(left_out, (2, 1))
    answers, objectives = _settle(condensed, rivals, threshold, fewest, _CONVERGED, twice)
    nearby, other = np.split(answers, 2)
    return np.where(np.less(*np.split(objectives, 2))[:, None, None], nearby, other)


def truncate(costs, threshold, floor):
    """Best weights for given costs, and the objective they give.

    Parameters
    ----------
    costs : (..., K) array
        Costs of the pairs, for one X or several.
    threshold : float
        c, in the unit of the costs.
    floor : float
        d: the weights add up to at least this; pairs that cost the same share what the cheaper ones
        leave of it.

    Returns
    -------
    weights : (..., K) array
    objective : (...) array
        Eq. (5).
    """
    counted = costs < threshold
    too_few = counted.sum(axis=-1) < floor
    if not too_few.any():
        weights = counted.astype(float)
    else:
        last = math.ceil(floor) - 1
        dearest = np.partition(costs, last, axis=-1)[..., last, None]
        counted |= costs <= dearest  # where they are not too few, these count already
        weights = counted.astype(float)
        excess = too_few * (counted.sum(axis=-1) - floor)
        if excess.any():
            tied = costs == dearest
            weights -= tied * (excess / np.maximum(tied.sum(axis=-1), 1))[..., None]
    return weights, np.einsum("...k,...k", weights, costs) + threshold * (
        costs.shape[-1] - weights.sum(axis=-1)
    )


def _searched(n_pairs):
    """What of so many pairs is searched: all, or an even sample."""
    return (
        slice(None)
        if n_pairs <= _MAX_SEARCHED
        else np.linspace(0, n_pairs - 1, _MAX_SEARCHED).astype(int)
    )


def _search(pairs, threshold, floor):
    """The annealed answer (4, 4), or a rival that beats it."""
    condensed = quadratic_form.condense(pairs)
    T_annealed = _anneal(condensed, _minimum_over_all(condensed, pairs), threshold, floor)
    best, objective = _settle(condensed, T_annealed, threshold, floor)
    random = np.random.default_rng(0)
    for _ in range(_MAX_GENERATIONS):
        rivals = _rivals(condensed, best, threshold, floor, random)
        rivals, objectives = _settle(condensed, rivals, threshold, floor)
        before = objective
        for kind, enough in ((slice(_FOLLOWED), 1.0), (slice(_FOLLOWED, None), _DECISIVE)):
            first = [(kind.start or 0) + int(np.argmin(objectives[kind]))]
            if objectives[first] < enough * objective:
                best, objective = rivals[first], objectives[first]
        if objective >= before * (1 - _HARDLY):
            break
    return best[0]


def _rivals(condensed, T, threshold, floor, random):
    """The most promising minima over random parts of the inliers of T (1, 4, 4), then over small
    random subsets: (6, 4, 4).
    """
    n_pairs = len(condensed)
    started = 4 * (1 + _STARTED_PAIRS // (4 * n_pairs))
    inliers, _ = truncate(_costs(condensed, T), threshold, floor)
    near = np.repeat(_INLIER_SHARES, started // 2)[:, None] * inliers
    anywhere = np.repeat(_SUBSET_SIZES, started // 4)[:, None] * np.full(n_pairs, 1 / n_pairs)
    chances = np.concatenate([near, anywhere])
    weights = (random.random(chances.shape) < chances).astype(float)
    Ts = np.repeat(T, len(weights), axis=0)
    for _ in range(_FIRST_ROUNDS):
        Ts = _refit(condensed, weights, Ts)
        weights, objectives = truncate(_costs(condensed, Ts), threshold, floor)
    promising = np.argsort(objectives.reshape(2, started), axis=1, kind="stable")[:, :_FOLLOWED] + [
        [0],
        [started],
    ]
    return Ts[promising.ravel()]


def _minimum_over_all(condensed, pairs):
    """X (1, 4, 4) near the minimum over all pairs, where annealing starts."""
    total = condensed.sum(axis=0)
    Ts = se3.from_rotation_translation(dnl.start_rotations(pairs), np.zeros(3))
    for _ in range(_STEPS_OVER_ALL):
        Ts = quadratic_form.gauss_newton_step(quadratic_form.expand(total), Ts)
    return Ts[[int(np.argmin(_costs(total[None], Ts)))]]


def _anneal(condensed, Ts, threshold, floor, left_out=None):
    """Graduated non-convexity from a batch of starts (S, 4, 4), with the truncation at c or at the
    d-th smallest cost, whichever is larger.
    """
    last = max(math.ceil(floor) - 1, 0)

    def judge(Ts):
        costs = _costs(condensed, Ts, left_out)
        return costs, np.maximum(threshold, np.partition(costs, last)[:, last])

    costs, cut = judge(Ts)
    largest = np.max(costs, axis=1, initial=0.0, where=costs < _NEVER)
    sharpness = np.maximum(cut / np.maximum(2 * largest - cut, cut), 1e-4)
    while sharpness.min() < _SHARP:
        ratio = (
            np.sqrt((cut * sharpness * (sharpness + 1))[:, None] / np.maximum(costs, 1e-300))
            - sharpness[:, None]
        )
        Ts = _refit(condensed, ratio.clip(0.0, 1.0), Ts)
        costs, cut = judge(Ts)
        sharpness = sharpness * _SHARPENING
    return Ts


def _costs(condensed, Ts_parent_child, left_out=None):
    costs = quadratic_form.monomials(Ts_parent_child) @ condensed.T
    if left_out is not None:
        costs[left_out] = _NEVER
    return costs


def _refit(condensed, weights, Ts):
    return quadratic_form.gauss_newton_step(quadratic_form.expand(weights @ condensed), Ts)


def _settle(condensed, Ts, threshold, floor, tolerance=_SETTLED, left_out=None):
    """A Gauss-Newton step and new weights in turn until no objective of a batch falls: the best X
    (S, 4, 4) of each, and its objective.
    """
    weights, objectives = truncate(_costs(condensed, Ts, left_out), threshold, floor)
    for _ in range(_MAX_ROUNDS):
        Ts_new = _refit(condensed, weights, Ts)
        weights, objectives_new = truncate(_costs(condensed, Ts_new, left_out), threshold, floor)
        settled = objectives_new >= objectives * (1 - tolerance)
        better = objectives_new < objectives
        Ts = np.where(better[:, None, None], Ts_new, Ts)
        objectives = np.where(better, objectives_new, objectives)
        if settled.all():
            break
    return Ts, objectives


def _finish(pairs, T_start, threshold, floor):
    """Weights and X in turn on all pairs until the objective falls no more. The costs come from the
    matrices, which cancel least.
    """
    numbers = quadratic_form.numbers(pairs)
    T = T_start
    weights, objective = truncate(quadratic_form.costs(numbers, T), threshold, floor)
    Q = quadratic_form.weighted_sum(numbers, weights)
    converged, iterations = False, 0
    while not converged and iterations < _MAX_ROUNDS:
        iterations += 1
        T_new = quadratic_form.gauss_newton_step(Q, T[None])[0]
        # A step that promises nothing needs no pass over the pairs.
        converged = bool(quadratic_form.fall(Q, T, T_new) < _CONVERGED * objective)
        if converged:
            break
        weights_new, objective_new = truncate(
            quadratic_form.costs(numbers, T_new), threshold, floor
        )
        converged = bool(objective_new >= objective * (1 - _CONVERGED))
        if objective_new <= objective:
            changed = np.flatnonzero(weights_new != weights)
            Q = Q + quadratic_form.weighted_sum(
                numbers[changed], weights_new[changed] - weights[changed]
            )
            T, weights, objective = T_new, weights_new, objective_new
    return Solution(T, float(objective), converged, iterations, weights)
