"""DNLO: direct non-linear optimisation with outlier rejection (Välimäki et al. 2023, eq. 5).

For a fixed X the weights have a closed form: a pair counts where its cost is below c, and where that keeps fewer than d pairs,
the d cheapest count. DNLO is thus truncated least squares with a floor on the inliers. Weights and X are improved in turn
until nothing changes. Since that ends in one of many local minima, the search has four stages:

1. Graduated non-convexity (Yang, Antonante, Tzoumas, Carlone, *Graduated non-convexity for robust spatial perception*, RA-L
   2020): from the minimum over all pairs, the truncation is switched on by degrees.
2. Around that answer: minima over random parts of its inliers, the best of which replaces it.
3. Everywhere: minima over small random subsets of all pairs, as in FAST-LTS (Rousseeuw, Van Driessen, *Computing LTS regression
   for large data sets*, 2006). Such an answer may lie far away, so it must be decisively better: between distant minima of
   nearly the same height, the annealed one is the more trustworthy.
4. The truncation is switched on by degrees once more, from the best so far.

The random subsets come from a fixed seed: the same pairs in the same order give the same answer.
"""

import math

import numpy as np

from hand_eye_calib.solvers import dnl, quadratic_form
from hand_eye_calib.solvers.solution import Solution

# Graduated non-convexity: how much sharper the truncation gets each round, and where it counts as sharp.
_SHARPENING = 1.6
_SHARP = 100.0

# Random subsets: shares of the inliers for the search around an answer; sizes for the search everywhere (small ones escape
# outliers, large ones resist noise); starts per batch, batches of each kind, and the most pairs that starts are judged on.
_INLIER_SHARES = (0.15, 0.33)
_SUBSET_SIZES = (4, 8, 16, 32)
_BATCH, _BATCHES = 16, 2
_MAX_JUDGED_PAIRS = 512

# A distant minimum replaces the annealed one when its objective is below this share of it.
_DECISIVE = 0.99

_MAX_ROUNDS = 100

# A batch of starts has settled when no objective falls by more than this share in a round.
_SETTLED = 1e-5

# Leaving pairs out: rounds of refitting from the full answer, and a finite cost that never counts as an inlier's.
_ROUNDS_WITHOUT = 8
_NEVER = 1e100


def solve(pairs, threshold=0.01, min_inlier_fraction=0.5):
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
    condensed = quadratic_form.condense(pairs)
    floor = min_inlier_fraction * len(pairs)
    T_annealed = _anneal(condensed, _minimum_over_all(condensed, pairs), threshold, floor)
    best = _alternate(condensed, T_annealed, threshold, floor)
    random = np.random.default_rng(0)
    for draw, enough in ((_parts_of_inliers, 1.0), (_small_subsets, _DECISIVE)):
        for _ in range(_BATCHES):
            T_rival, objective = _best_of_batch(condensed, best.T_parent_child, draw, random, threshold, floor)
            if objective < enough * best.objective:
                best = _better(best, _alternate(condensed, T_rival, threshold, floor))
    T_annealed = _anneal(condensed, best.T_parent_child, threshold, floor)
    best = _better(best, _alternate(condensed, T_annealed, threshold, floor))
    # The condensed forms cancel where the fit is perfect; the answer's own numbers come from the matrices.
    weights, objective = truncate(dnl.pair_costs(pairs, best.T_parent_child), threshold, floor)
    return Solution(best.T_parent_child, float(objective), best.converged, best.iterations, weights)


def solve_without(pairs, solution, left_out, threshold=0.01, min_inlier_fraction=0.5):
    """Answers near a given one when some pairs are left out, for resampling.

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
    Ts, weights = np.repeat(solution.T_parent_child[None], len(left_out), axis=0), solution.weights * ~left_out
    floor = min_inlier_fraction * float((~left_out).sum(axis=1).min())
    for _ in range(_ROUNDS_WITHOUT):
        Ts = _refit(condensed, weights, Ts)
        weights, _ = truncate(np.where(left_out, _NEVER, _costs(condensed, Ts)), threshold, floor)
    return Ts


def truncate(costs, threshold, floor):
    """Best weights for given costs, and the objective they give.

    Parameters
    ----------
    costs : (..., K) array
        Costs of the pairs, for one X or several.
    threshold : float
        c, in the unit of the costs.
    floor : float
        d: the weights add up to at least this; with a fractional part the last pair counts in part.

    Returns
    -------
    weights : (..., K) array
    objective : (...) array
        Eq. (5).
    """
    weights = (costs < threshold).astype(float)
    too_few = weights.sum(axis=-1) < floor
    if np.any(too_few):
        whole = math.ceil(floor)
        short = costs[too_few]
        order = np.argpartition(short, whole - 1, axis=-1)[..., :whole]
        floored = np.zeros_like(short)
        np.put_along_axis(floored, order, 1.0, axis=-1)
        np.put_along_axis(floored, order[..., -1:], 1.0 - (whole - floor), axis=-1)
        weights[too_few] = floored
    return weights, (weights * costs + (1.0 - weights) * threshold).sum(axis=-1)


def _better(solution, rival):
    return rival if rival.objective < solution.objective else solution


def _minimum_over_all(condensed, pairs):
    minimum = quadratic_form.minimise(quadratic_form.expand(condensed.sum(axis=0)), dnl.start_rotations(pairs))
    return minimum.T_parent_child[int(np.argmin(minimum.value))]


def _costs(condensed, Ts_parent_child):
    return np.maximum(quadratic_form.monomials(Ts_parent_child) @ condensed.T, 0.0)


def _anneal(condensed, T_start, threshold, floor):
    """Graduated non-convexity, with the truncation at c or at the d-th smallest cost, whichever is larger."""
    T = T_start[None]
    last = max(math.ceil(floor) - 1, 0)
    costs = _costs(condensed, T)[0]
    cut = max(threshold, np.partition(costs, last)[last])
    sharpness = max(cut / max(2 * costs.max() - cut, cut), 1e-4)
    while sharpness < _SHARP:
        ratio = np.sqrt(cut * sharpness * (sharpness + 1) / np.maximum(costs, 1e-300)) - sharpness
        T = _refit(condensed, np.clip(ratio, 0.0, 1.0)[None], T)
        costs = _costs(condensed, T)[0]
        cut = max(threshold, np.partition(costs, last)[last])
        sharpness *= _SHARPENING
    return T[0]


def _refit(condensed, weights, Ts):
    return quadratic_form.gauss_newton_step(quadratic_form.expand(weights @ condensed), Ts)


def _settle(condensed, Ts, weights, threshold, floor):
    """A Gauss-Newton step and new weights in turn, for a batch of starts (S, 4, 4), until no objective falls any more."""
    objectives = np.full(len(Ts), np.inf)
    for _ in range(_MAX_ROUNDS):
        Ts = _refit(condensed, weights, Ts)
        weights, new_objectives = truncate(_costs(condensed, Ts), threshold, floor)
        falling = new_objectives < objectives * (1 - _SETTLED)
        objectives = new_objectives
        if not falling.any():
            break
    return Ts, objectives


def _alternate(condensed, T_start, threshold, floor):
    """Weights and X in turn until neither changes; X is then the exact minimum for its weights."""
    T = T_start[None]
    weights, objective = truncate(_costs(condensed, T), threshold, floor)
    converged, iterations = False, 0
    while not converged and iterations < _MAX_ROUNDS:
        iterations += 1
        T_new = _refit(condensed, weights, T)
        new_weights, new_objective = truncate(_costs(condensed, T_new), threshold, floor)
        if np.array_equal(new_weights, weights) or new_objective >= objective:
            T_new = quadratic_form.minimise(quadratic_form.expand(weights @ condensed), T[:, :3, :3]).T_parent_child
            new_weights, new_objective = truncate(_costs(condensed, T_new), threshold, floor)
            converged = bool(np.array_equal(new_weights, weights) or new_objective >= objective)
        if new_objective <= objective:
            T, weights, objective = T_new, new_weights, new_objective
    return Solution(T[0], float(objective[0]), converged, iterations, weights[0])


def _parts_of_inliers(costs, threshold, floor, random):
    """Weights (_BATCH, K): each row a random part of the pairs that count as inliers."""
    inliers = np.flatnonzero(truncate(costs[None], threshold, floor)[0][0])
    sizes = [round(_INLIER_SHARES[row % len(_INLIER_SHARES)] * len(inliers)) for row in range(_BATCH)]
    return _indicators(len(costs), inliers, sizes, random)


def _small_subsets(costs, threshold, floor, random):
    """Weights (_BATCH, K): each row a few random pairs."""
    sizes = [_SUBSET_SIZES[row % len(_SUBSET_SIZES)] for row in range(_BATCH)]
    return _indicators(len(costs), np.arange(len(costs)), sizes, random)


def _indicators(n_pairs, candidates, sizes, random):
    weights = np.zeros((len(sizes), n_pairs))
    for row, size in zip(weights, sizes, strict=True):
        row[random.permutation(candidates)[: max(size, _SUBSET_SIZES[0])]] = 1.0
    return weights


def _best_of_batch(condensed, T_start, draw, random, threshold, floor):
    """The best of a batch of minima over random subsets, and its objective.

    Many pairs are judged by an even sample of them; only the best is then followed on all.
    """
    n_pairs = len(condensed)
    sampled = n_pairs > _MAX_JUDGED_PAIRS
    judged = condensed[np.linspace(0, n_pairs - 1, _MAX_JUDGED_PAIRS).astype(int)] if sampled else condensed
    judged_floor = floor * len(judged) / n_pairs
    weights = draw(_costs(judged, T_start[None])[0], threshold, judged_floor, random)
    Ts, objectives = _settle(judged, np.repeat(T_start[None], _BATCH, axis=0), weights, threshold, judged_floor)
    best = [int(np.argmin(objectives))]
    if sampled:
        weights, _ = truncate(_costs(condensed, Ts[best]), threshold, floor)
        Ts, objectives = _settle(condensed, Ts[best], weights, threshold, floor)
        best = [0]
    return Ts[best[0]], float(objectives[best[0]])
