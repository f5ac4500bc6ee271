"""Common extrinsic of several recordings of one rig, and detection of results that differ.

The model has random effects: result i is ``X Exp(u_i) Exp(e_i)``. The error e_i has the covariance
of the result. The scatter u_i between recordings has a standard deviation per axis: the usual one
(:func:`~hand_eye_calib.core.assessment.moved.scatter_of_recordings`) times an unknown factor, one
factor for the translation and one for the rotation. Each factor has a half-Cauchy prior of scale 1.
X is the mean over both factors, weighted by prior and restricted likelihood (C. Röver, *Bayesian
random-effects meta-analysis using the bayesmeta R package*, 2020). Each axis of X comes from the
recordings that reveal the axis.

Two explanations of a contradiction are tried first: one recording is off, or the mount has moved at
some time. The better explanation is accepted if its p-value is small, both for the usual scatter
(chi-square test) and for the scatter of the other results (F test).

All values are along and about the axes of the parent: motion on a plane hides the same direction of
the parent in every recording.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.assessment.covariance import UNOBSERVABLE
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.blocks import Blocks, information, score
from hand_eye_calib.core.base.text import amount, axes_in_words, listing
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.core.results.records import AXES

# Variance (m^2, rad^2) of an unknown direction. It is so large that the direction remains unknown
# in the mean of many results.
_UNKNOWN_VARIANCE = 1e4
# Number of Gauss-Newton steps for the common extrinsic.
_ROUNDS = 2
# Significance level: probability of a false alarm.
_LEVEL = 0.01
# Results are closer together than their standard deviations if the probability of a larger
# chi-square exceeds this.
_CLOSE = 0.99
# Grid of the factors of the usual scatter. Results with more scatter are not from one mount.
_FACTORS = np.geomspace(1 / 16, 16, 9)

# Sentence by the kind of agreement.
_SENTENCES = {
    "single": "One recording: nothing to compare with",
    "agree": "{all} agree within their standard deviations",
    "differ": "{both} differ; record once more to find out which result is wrong",
    "scatter": "{all} scatter {excess} times as much as recordings of one rig; none stands out",
    "one off": "{first} differs from the others: {moves}",
    "moved": "The mount has moved before {first}: {moves}",
}


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Comparison of N results.

    Attributes
    ----------
    kind : str
        "single", "agree", "differ", "scatter", "one off" or "moved".
    apart : tuple of int
        Indices of the results that differ from the others: the single result that is off, or all
        results after the mount has moved.
    T_parent_child : (4, 4) array
        Common extrinsic of the results that are not apart.
    covariance : (6, 6) array
        Covariance of the common extrinsic, along and about the parent's axes. Unknown directions
        have a standard deviation of many metres.
    scatter : (6,) array
        Estimated standard deviation of u_i along (m) and about (rad) the axes.
    chi2, dof, p_value : float, int, float
        Chi-square test of the hypothesis that all results have one extrinsic and scatter as usual.
    excess : float
        Scatter of the results that are not apart, divided by the usual scatter.
    deviations : (N, 6) array
        Deviation of each result from the common extrinsic: x, y, z (m) along the parent's axes and
        the rotation vector (rad) about them. NaN on axes that are unknown in the result.
    sigmas : (N, 6) array
        Standard deviations of each result, including the usual scatter.
    """

    kind: str
    apart: tuple[int, ...]
    T_parent_child: FloatArray
    covariance: FloatArray
    scatter: FloatArray
    chi2: float
    dof: int
    p_value: float
    excess: float
    deviations: FloatArray
    sigmas: FloatArray

    def sentence(self, names: Sequence[str]) -> str:
        """Describe the comparison in a sentence, with the names of the results."""
        sentence = _SENTENCES[self.kind].format(
            all=f"The {len(names)} recordings",
            both=listing(names),
            excess=f"{self.excess:.1f}",
            first=names[self.apart[0]] if self.apart else "",
            moves=self._moves() if self.apart else "",
        )
        if self.kind == "single":
            return sentence
        numbers = f"chi-square {self.chi2:.1f}, {self.dof} degrees of freedom, p {self.p_value:.2g}"
        if self.dof and self.p_value > _CLOSE:
            numbers += (
                ": closer than their standard deviations, which contain the usual scatter "
                "between recordings"
            )
        return f"{sentence} ({numbers})"

    def _moves(self) -> str:
        """List the axes on which the results apart differ by more than two standard deviations.

        The axis that differs most is always listed.
        """
        apart = [*self.apart]
        values = self.deviations[apart].mean(axis=0)
        mean_variances = (self.sigmas[apart] ** 2).mean(axis=0) / len(apart)
        sigmas = np.sqrt(mean_variances + np.diag(self.covariance))
        ratios = np.nan_to_num(np.abs(values) / sigmas)
        moves = []
        for axis in np.argsort(-ratios):
            if ratios[axis] >= min(2.0, ratios.max()):
                name = AXES[axis]
                size = amount(name, values[axis])
                sigma = amount(name, float(sigmas[axis]))
                moves.append(f"{axes_in_words([name])} by {size} +/- {sigma}")
        return listing(moves)


def agreement_of(
    Ts_parent_child: FloatArray,
    covariances: FloatArray,
    usual: FloatArray | None = None,
    level: float = _LEVEL,
) -> Agreement:
    """Compare results of one rig, and combine them.

    Parameters
    ----------
    Ts_parent_child : (N, 4, 4) array
        Results in order of time.
    covariances : (N, 6, 6) array
        Covariances along and about the parent's axes.
    usual : (6,) array, optional
        Usual standard deviations of u_i along (m) and about (rad) the axes. The default is no
        scatter in addition to the covariances.
    level : float
        Probability that results of one extrinsic are reported as different.
    """
    usual_scatter = np.zeros(6) if usual is None else usual
    stated = np.array(
        [_without_unknown(covariance) for covariance in covariances]
    )
    scattered = stated + np.diag(usual_scatter**2)
    weights = np.linalg.inv(scattered)
    best = int(np.argmax(np.trace(weights, axis1=1, axis2=2)))
    # Combine all results. Their covariances contain the usual scatter.
    no_scatter = np.zeros(6)
    first_guess = Ts_parent_child[best]
    of_all = _common(
        Ts_parent_child, np.linalg.inv(weights), no_scatter, first_guess
    )
    start = of_all.T_parent_child
    errors = deviation(Ts_parent_child, start)
    explanation = _explain(errors, weights, level)
    # Combine the results that agree, and estimate their scatter.
    belongs = ~explanation.apart
    common = _common(
        Ts_parent_child[belongs], stated[belongs], usual_scatter, start
    )
    # At level 0, no result is set apart.
    rest = _explain(errors[belongs], weights[belongs], 0.0)
    sigmas = np.sqrt(np.diagonal(scattered, axis1=1, axis2=2))
    sigmas = np.where(sigmas < UNOBSERVABLE, sigmas, np.nan)
    deviations = deviation(Ts_parent_child, common.T_parent_child)
    return Agreement(
        kind=explanation.kind,
        apart=tuple(np.flatnonzero(explanation.apart).tolist()),
        T_parent_child=common.T_parent_child,
        covariance=common.covariance,
        scatter=common.scatter,
        chi2=explanation.chi2,
        dof=explanation.dof,
        p_value=explanation.p_value,
        excess=math.sqrt(rest.chi2 / rest.dof) if rest.dof else 1.0,
        deviations=np.where(np.isfinite(sigmas), deviations, np.nan),
        sigmas=sigmas,
    )


class _Common(NamedTuple):
    """Common extrinsic (4, 4), its covariance (6, 6) and the scatter (6,) of the results."""

    T_parent_child: FloatArray
    covariance: FloatArray
    scatter: FloatArray


def _common(
    Ts: FloatArray,
    covariances: FloatArray,
    usual_scatter: FloatArray,
    start: FloatArray,
) -> _Common:
    """Estimate the common extrinsic of N results of one mount.

    The estimate is the posterior mean over a grid of G pairs of factors.

    Parameters
    ----------
    Ts : (N, 4, 4) array
    covariances : (N, 6, 6) array
        Covariances without the scatter between recordings.
    usual_scatter : (6,) array
    start : (4, 4) array
        Point at which the first step linearises.
    """
    factors = np.ones((1, 2))
    if usual_scatter.any():
        factors = np.array(list(itertools.product(_FACTORS, repeat=2)))
    variances = (np.repeat(factors, 3, axis=1) * usual_scatter) ** 2
    scatter_covariances = variances[:, :, None] * np.eye(6)
    spread = covariances + scatter_covariances[:, None]
    weights = np.linalg.inv(spread)
    mean_covariances = np.linalg.inv(weights.sum(axis=1))
    _, log_determinants = np.linalg.slogdet(spread)
    _, log_determinants_of_mean = np.linalg.slogdet(mean_covariances)
    # Restricted likelihood: divide by the determinant of the covariance of the mean.
    log_volumes = log_determinants.sum(axis=1) - log_determinants_of_mean
    # The half-Cauchy density of a factor, times the factor, is a density over its logarithm. The
    # grid is uniform in the logarithm.
    log_prior = np.log(factors / (1.0 + factors**2)).sum(axis=1)
    T = start
    for _ in range(_ROUNDS):
        errors = deviation(Ts, T)
        scores = np.einsum("gnij,nj->gi", weights, errors)
        means = se3.times(mean_covariances, scores)
        residuals = errors - means[:, None]
        weighted = np.einsum("gnij,gnj->gni", weights, residuals)
        squares = (residuals * weighted).sum(axis=(1, 2))
        log_posterior = log_prior - 0.5 * (log_volumes + squares)
        shares = np.exp(log_posterior - log_posterior.max())
        shares /= shares.sum()
        step = shares @ means
        # Law of total variance: mean of the covariances plus covariance of the means.
        covariance = np.einsum("g,gij->ij", shares, mean_covariances)
        covariance += (shares * (means - step).T) @ (means - step)
        rotation = se3.rotation_exp(step[3:]) @ se3.rotation_of(T)
        translation = se3.translation_of(T) + step[:3]
        T = se3.from_rotation_translation(rotation, translation)
    scatter = np.sqrt(shares @ variances)
    return _Common(T, covariance, scatter)


def unknown_directions(covariance: FloatArray) -> FloatArray:
    """Return orthonormal unknown directions (6, U) of a covariance (6, 6)."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors[:, values > UNOBSERVABLE**2]


def _without_unknown(covariance: FloatArray) -> FloatArray:
    """Return a covariance (6, 6) in which unknown directions have a very large variance."""
    if not np.isfinite(covariance).all():
        return _UNKNOWN_VARIANCE * np.eye(6)
    values, vectors = np.linalg.eigh(covariance)
    is_unknown = values >= UNOBSERVABLE**2
    values = np.where(is_unknown, _UNKNOWN_VARIANCE, np.maximum(values, 1e-12))
    return (vectors * values) @ vectors.T


class _Explanation(NamedTuple):
    """Kind of agreement, mask (N,) of the results that are apart, and the test of all results."""

    kind: str
    apart: BoolArray
    chi2: float
    dof: int
    p_value: float


def _explain(
    errors: FloatArray, weights: FloatArray, level: float
) -> _Explanation:
    """Explain errors (N, 6) of results with weights (N, 6, 6).

    Three or more results are split into two groups with a mean each. The first group is a single
    result, or all results since the mount has moved. If two splits have the same p-value, a single
    result is preferred. The kinds are:

    - "single": there is one result.
    - "one off" or "moved": the best split is significant at ``level``.
    - "agree": no split is significant, and the chi-square test of all results accepts one
      extrinsic (_LEVEL).
    - "scatter": the test rejects one extrinsic for three or more results, and a scatter within the
      grid of factors explains the result of the test.
    - "differ": the test rejects one extrinsic for two results, or no such scatter explains it.

    Parameters
    ----------
    errors : (N, 6) array
    weights : (N, 6, 6) array
    level : float
        Significance level of the best split. With 0, no split is significant.
    """
    from scipy.special import chdtrc

    n_results = len(errors)
    number = np.arange(n_results)
    design = np.concatenate(
        [np.broadcast_to(np.eye(6), weights.shape), errors[:, :, None]], axis=2
    )
    products = Blocks(np.swapaxes(design, 1, 2) @ weights @ design)
    ranks = Blocks(_ranks(weights))
    total_chi2, total_dof = map(
        float, _chi2_and_dof(products.total, ranks.total)
    )
    p_value = float(chdtrc(total_dof, total_chi2)) if total_dof else 1.0
    kind = "differ" if p_value < _LEVEL else "agree"
    apart = np.zeros(n_results, dtype=bool)
    if n_results < 3:
        kind = kind if n_results == 2 else "single"
        return _Explanation(kind, apart, total_chi2, int(total_dof), p_value)
    first_after_move = np.arange(2, n_results - 1)
    p_values = _p_values_of_splits(products, ranks, first_after_move)
    best = int(np.argmin(p_values))
    # The best of several splits is tested, so its p-value is multiplied by their number
    # (Bonferroni).
    if len(p_values) * p_values[best] < level:
        # The first N splits separate a single result, the others the results after a move.
        if best < n_results:
            kind = "one off"
            apart = number == best
        else:
            kind = "moved"
            apart = number >= first_after_move[best - n_results]
    elif kind == "differ" and total_chi2 < _FACTORS[-1] ** 2 * total_dof:
        # A scatter of at most the largest factor times the usual scatter explains chi-square.
        kind = "scatter"
    return _Explanation(kind, apart, total_chi2, int(total_dof), p_value)


def _p_values_of_splits(
    products: Blocks, ranks: Blocks, since: IntArray
) -> FloatArray:
    """Return the p-values (N + S,) of all splits of N results into two groups.

    A p-value is the larger p-value of two tests. The chi-square test is of the decrease of
    chi-square by the split. The F test compares this decrease with the remaining chi-square.

    Parameters
    ----------
    products, ranks : Blocks
        Products and ranks of the results, as for :func:`_chi2_and_dof`.
    since : (S,) int array
        First results of the second groups, for splits by time. The first N splits separate one
        result each.
    """
    from scipy.special import chdtrc, fdtrc

    total_chi2, total_dof = map(
        float, _chi2_and_dof(products.total, ranks.total)
    )
    group = np.concatenate([products.sums, products.since(since)])
    group_ranks = np.concatenate([ranks.sums, ranks.since(since)])
    group_chi2, group_dof = _chi2_and_dof(group, group_ranks)
    other_chi2, other_dof = _chi2_and_dof(
        products.total - group, ranks.total - group_ranks
    )
    chi2 = group_chi2 + other_chi2
    dof = group_dof + other_dof
    gained = total_chi2 - chi2
    spent = total_dof - dof
    p_values = chdtrc(spent, gained)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = gained / spent / (chi2 / dof)
        by_scatter_of_others = fdtrc(spent, dof, ratios)
    p_values = np.where(
        dof > 0, np.fmax(p_values, by_scatter_of_others), p_values
    )
    p_values[spent <= 0] = 1.0
    return p_values


def _chi2_and_dof(
    products: FloatArray, ranks: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return chi-square and degrees of freedom of errors about the mean of their group.

    Parameters
    ----------
    products : (..., 7, 7) array
        Sums of ``(1 e)' W (1 e)`` over each group.
    ranks : (...) array
        Sums of the ranks of W.
    """
    weights = information(products)
    scores = score(products)
    mean = np.linalg.solve(weights, scores[..., None])[..., 0]
    explained = (scores * mean).sum(axis=-1)
    chi2 = np.maximum(products[..., -1, -1] - explained, 0.0)
    dof = np.asarray(ranks - _ranks(weights), dtype=float)
    return chi2, dof


def _ranks(weights: FloatArray) -> FloatArray:
    """Return the numbers (...) of known directions of weights (..., 6, 6)."""
    is_known = np.linalg.eigvalsh(weights) > 1 / UNOBSERVABLE**2
    return np.asarray(is_known.sum(axis=-1), dtype=float)
