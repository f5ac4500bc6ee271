"""One extrinsic from the results of several recordings of one rig, and which of them do not belong.

Result i is ``X Exp(u_i) Exp(e_i)``: e_i has the covariance that the result states, u_i is what
differs from recording to recording and shows in none of them. Its standard deviations per axis are
usual ones (:func:`~hand_eye_calib.core.assessment.moved.scatter_of_recordings`) times a factor for
the translation and one for the rotation. Neither is known: a half-Cauchy prior of scale 1, the
restricted likelihood of the results, and a mean over both factors (Röver, *Bayesian random-effects
meta-analysis using the bayesmeta R package*, 2020). Information is added, so that an axis which one
recording does not reveal comes from another.

Before that, two explanations of a contradiction are tried: one recording is off, or the mount has
moved at some time. The better one is accepted if chance rarely makes one as good, both with the
usual scatter and, by an F test, with that of the others.

Everything is along and about the axes of the parent. What motion on a plane does not reveal is the
same direction there in every recording.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.blocks import Blocks, information, score
from hand_eye_calib.core.base.text import amount, axes_in_words, listing
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.core.results.records import AXES

# A direction with a larger standard deviation (m, rad) is unknown; its variance then.
_UNKNOWN = 0.3
_UNKNOWN_VARIANCE = 1e4
_ROUNDS = 2
# Probability of a false alarm.
_LEVEL = 0.01
# Factors of the usual scatter; with more, results are of no one mount.
_FACTORS = np.geomspace(1 / 16, 16, 9)


# What is said of results by how they belong together: see Together.kind.
_SAID = {
    "single": "One recording: nothing to compare with",
    "agree": "{all} agree within their standard deviations",
    "differ": "{both} differ; one more recording shows which is off",
    "scatter": "{all} scatter {excess} times more than those of one rig do; none stands out",
    "one off": "{first} differs from the others: {moves}",
    "moved": "The mount has moved before {first}: {moves}",
}


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """What came of a comparison of N results.

    Attributes
    ----------
    kind : str
    apart : tuple of int
        Indices of the results that do not belong to the others: the one that is off, or all since
        the mount has moved.
    T_parent_child : (4, 4) array
        Common extrinsic of the others.
    covariance : (6, 6) array
        Of that, along and about the parent's axes. Unknown directions have a standard deviation
        of many metres.
    scatter : (6,) array
        Standard deviation of u_i along (m) and about (rad) the axes, root mean square.
    chi2, dof, p_value : float, int, float
        Of the hypothesis that all results are of one extrinsic and scatter as usual.
    excess : float
        How many times larger than that the scatter is, without those apart.
    deviations : (N, 6) array
        Of each result from the common extrinsic: x, y, z (m) along the parent's axes and the
        rotation vector (rad) about them. NaN if it does not know the axis.
    sigmas : (N, 6) array
        Standard deviations of each, with the usual scatter.
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
        """What the comparison of results with these names found."""
        found = _SAID[self.kind].format(
            all=f"The {len(names)} recordings",
            both=listing(names),
            excess=f"{self.excess:.1f}",
            first=names[self.apart[0]] if self.apart else "",
            moves=self._moves() if self.apart else "",
        )
        if self.kind == "single":
            return found
        numbers = f"chi-square {self.chi2:.1f}, {self.dof} degrees of freedom, p {self.p_value:.2g}"
        return f"{found} ({numbers})"

    def _moves(self) -> str:
        """The axes on which those apart differ by over two standard deviations; at least one."""
        apart = [*self.apart]
        values = self.deviations[apart].mean(axis=0)
        variances = (self.sigmas[apart] ** 2).mean(axis=0) / len(apart) + np.diag(self.covariance)
        ratios = np.nan_to_num(np.abs(values) / np.sqrt(variances))
        order = [axis for axis in np.argsort(-ratios) if ratios[axis] >= min(2.0, ratios.max())]
        told = []
        for axis, name in ((axis, AXES[axis]) for axis in order):
            size = amount(name, values[axis])
            sigma = amount(name, float(np.sqrt(variances[axis])))
            told.append(f"{axes_in_words([name])} by {size} +/- {sigma}")
        return listing(told)


def agreement_of(
    Ts_parent_child: FloatArray,
    covariances: FloatArray,
    usual: FloatArray | None = None,
    level: float = _LEVEL,
) -> Agreement:
    """Compare results of one rig, and put them together.

    Parameters
    ----------
    Ts_parent_child : (N, 4, 4) array
        In the order of time.
    covariances : (N, 6, 6) array
        Along and about the parent's axes.
    usual : (6,) array, optional
        Usual standard deviations of u_i along (m) and about (rad) the axes. Left out: there is no
        scatter but what the covariances say.
    level : float
        Probability to accuse one of results that belong together.
    """
    Ts = Ts_parent_child
    tau = np.zeros(6) if usual is None else usual
    stated = np.array([_without_unknown(each) for each in covariances])
    weights = np.linalg.inv(stated + np.diag(tau**2))
    best = int(np.argmax(np.trace(weights, axis1=1, axis2=2)))
    start = common_of(Ts, np.linalg.inv(weights), np.zeros(6), Ts[best])[0]
    errors = deviation(Ts, start)
    kind, apart, chi2, dof, p_value = _explanation(errors, weights, level)
    T, covariance, scatter = common_of(Ts[~apart], stated[~apart], tau, start)
    _, _, left, free, _ = _explanation(errors[~apart], weights[~apart], 0.0)
    sigmas = np.sqrt(np.diagonal(stated + np.diag(tau**2), axis1=1, axis2=2))
    sigmas = np.where(sigmas < _UNKNOWN, sigmas, np.nan)
    return Agreement(
        kind=kind,
        apart=tuple(np.flatnonzero(apart).tolist()),
        T_parent_child=T,
        covariance=covariance,
        scatter=scatter,
        chi2=chi2,
        dof=dof,
        p_value=p_value,
        excess=math.sqrt(left / free) if free else 1.0,
        deviations=np.where(np.isfinite(sigmas), deviation(Ts, T), np.nan),
        sigmas=sigmas,
    )


def common_of(
    Ts: FloatArray, covariances: FloatArray, usual: FloatArray, start: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The common extrinsic (4, 4) of N results that belong together, its covariance (6, 6), and
    their scatter (6,); see the top of the file.
    """
    factors = np.array(list(itertools.product(_FACTORS, repeat=2)) if usual.any() else [(1.0, 1.0)])
    variances = (np.repeat(factors, 3, axis=1) * usual) ** 2
    spread = covariances + (variances[:, :, None] * np.eye(6))[:, None]
    weights = np.linalg.inv(spread)
    each = np.linalg.inv(weights.sum(axis=1))
    volumes = np.linalg.slogdet(spread)[1].sum(axis=1) - np.linalg.slogdet(each)[1]
    # Half-Cauchy, on a grid of logarithms.
    log_prior = np.log(factors / (1.0 + factors**2)).sum(axis=1)
    T = start
    for _ in range(_ROUNDS):
        errors = deviation(Ts, T)
        means = (each @ np.einsum("gnij,nj->gi", weights, errors)[:, :, None])[:, :, 0]
        rest = errors - means[:, None]
        squared = (rest * np.einsum("gnij,gnj->gni", weights, rest)).sum(axis=(1, 2))
        shares = log_prior - 0.5 * (volumes + squared)  # of the restricted likelihood
        shares = np.exp(shares - shares.max())
        shares /= shares.sum()
        step = shares @ means
        covariance = np.einsum("g,gij->ij", shares, each)
        covariance += (shares * (means - step).T) @ (means - step)
        rotation = se3.rotation_exp(step[3:]) @ T[:3, :3]
        T = se3.from_rotation_translation(rotation, T[:3, 3] + step[:3])
    return T, covariance, np.sqrt(shares @ variances)


def unknown_directions(covariance: FloatArray) -> FloatArray:
    """Orthonormal directions (6, U) in which a covariance (6, 6) says that nothing is known."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors[:, values > _UNKNOWN**2])


def _without_unknown(covariance: FloatArray) -> FloatArray:
    """A covariance (6, 6) in whose unknown directions many results together know nothing."""
    if not np.isfinite(covariance).all():
        return _UNKNOWN_VARIANCE * np.eye(6)
    values, vectors = np.linalg.eigh(covariance)
    values = np.where(values < _UNKNOWN**2, np.maximum(values, 1e-12), _UNKNOWN_VARIANCE)
    return (vectors * values) @ vectors.T


def _explanation(
    errors: FloatArray, weights: FloatArray, level: float
) -> tuple[str, BoolArray, float, int, float]:
    """How the results belong together, and which of them are apart; chi-square, its degrees of
    freedom and p-value of all together.

    Each result alone is tried, and all since each time; what both explain is one that is off.
    """
    from scipy.special import chdtrc, fdtrc

    number = np.arange(len(errors))
    design = np.concatenate([np.broadcast_to(np.eye(6), weights.shape), errors[:, :, None]], axis=2)
    products = Blocks(np.swapaxes(design, 1, 2) @ weights @ design)
    ranks = Blocks(_ranks(weights))
    all_chi2, all_dof = _left(products.total, ranks.total)
    p_value = float(chdtrc(all_dof, all_chi2)) if all_dof else 1.0
    kind = "differ" if p_value < _LEVEL else "agree"
    apart = number < 0
    if len(number) < 3:
        kind = kind if len(number) == 2 else "single"
        return kind, apart, float(all_chi2), int(all_dof), p_value
    since = np.arange(2, len(number) - 1)
    group = np.concatenate([products.sums, products.since(since)])
    ranks_of_group = np.concatenate([ranks.sums, ranks.since(since)])
    others = products.total - group, ranks.total - ranks_of_group
    chi2, dof = np.add(_left(group, ranks_of_group), _left(*others))
    gained = all_chi2 - chi2
    spent = all_dof - dof
    p_values = chdtrc(spent, gained)
    with np.errstate(divide="ignore", invalid="ignore"):
        by_others = fdtrc(spent, dof, gained / spent / (chi2 / dof))
    p_values = np.where(dof > 0, np.fmax(p_values, by_others), p_values)
    p_values[spent <= 0] = 1.0
    best = int(np.argmin(p_values))
    if len(p_values) * p_values[best] < level:
        is_one = best < len(number)
        kind = "one off" if is_one else "moved"
        apart = number == best if is_one else number >= best - len(number) + 2
    elif kind == "differ" and all_chi2 < _FACTORS[-1] ** 2 * all_dof:
        kind = "scatter"
    return kind, apart, float(all_chi2), int(all_dof), p_value


def _left(products: FloatArray, ranks: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Chi-square and degrees of freedom that are left of groups of errors after the common part of
    each, from sums of ``(1 e)' W (1 e)`` (..., 7, 7) and of the ranks of W.
    """
    weights = information(products)
    weighted = score(products)
    common = np.linalg.solve(weights, weighted[..., None])[..., 0]
    chi2 = products[..., -1, -1] - (weighted * common).sum(axis=-1)
    return np.maximum(chi2, 0.0), np.asarray(ranks - _ranks(weights), dtype=float)


def _ranks(weights: FloatArray) -> FloatArray:
    seen = np.linalg.eigvalsh(weights) > 1 / _UNKNOWN**2
    return np.asarray(seen.sum(axis=-1), dtype=float)
