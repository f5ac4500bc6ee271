"""Whether the results of several recordings of one rig agree, and which of them do not.

Each result has a covariance, and recordings of one rig scatter beside it. So the sum of squared
distances from the common extrinsic has a chi-square distribution. Directions that a recording did
not reveal count neither as agreement nor as contradiction.

Two explanations of a contradiction are tried: one recording is off, or the mount has moved at some
time. The better one is accepted if chance rarely makes one as good; if the others still scatter
more than stated, by an F test against their own scatter.

Everything is along and about the axes of the parent. What motion on a plane does not reveal is the
same direction there in every recording.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.assessment.covariance import AXES
from hand_eye_calib.geometry import se3
from hand_eye_calib.text import amount, axes_in_words, listing

# A direction with a larger standard deviation (m, rad) is unknown.
_UNKNOWN = 0.3
_ROUNDS = 4
# Probability of a false alarm; and of a scatter that is no more than stated.
_LEVEL, _ORDINARY = 0.01, 0.05


class Kind(str, Enum):
    """How the results of a rig belong together."""

    SINGLE = "single"  # there is nothing to compare with
    AGREE = "agree"
    SCATTER = "scatter"  # more than stated, but none stands out
    ONE_OFF = "one off"
    MOVED = "moved"
    DIFFER = "differ"  # two recordings: nobody knows which


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """What came of a comparison of N results.

    Attributes
    ----------
    kind : Kind
    apart : tuple of int
        Indices of the results that do not belong to the others: the one that is off, or all since
        the mount has moved.
    T_parent_child : (4, 4) array
        Common extrinsic of the others.
    covariance : (6, 6) array
        Of that, along and about the parent's axes; wider if they scatter more than stated. Unknown
        directions have a standard deviation of 3.
    chi2, dof, p_value : float, int, float
        Of the hypothesis that all results are of one extrinsic.
    scatter : float
        How many times larger than stated the scatter is, without those apart.
    deviations : (N, 6) array
        Of each result from the common extrinsic: x, y, z (m) along the parent's axes and the
        rotation vector (rad) about them. NaN if it does not know the axis.
    sigmas : (N, 6) array
        Standard deviations of each, with the scatter of recordings.
    """

    kind: Kind
    apart: tuple[int, ...]
    T_parent_child: FloatArray
    covariance: FloatArray
    chi2: float
    dof: int
    p_value: float
    scatter: float
    deviations: FloatArray
    sigmas: FloatArray

    def sentence(self, names: Sequence[str]) -> str:
        """What the comparison of results with these names found."""
        if self.kind is Kind.SINGLE:
            return "One recording: nothing to compare with"
        test = (
            f"chi-square {self.chi2:.1f} with {self.dof} degrees of freedom, p {self.p_value:.2g}"
        )
        match self.kind:
            case Kind.AGREE:
                found = f"The {len(names)} recordings agree within their standard deviations"
            case Kind.DIFFER:
                found = f"{names[0]} and {names[1]} differ; a third recording shows which is off"
            case Kind.SCATTER:
                found = f"The {len(names)} recordings scatter {self.scatter:.1f} times as much as "
                found += "their standard deviations say; none stands out"
            case Kind.ONE_OFF:
                found = f"{names[self.apart[0]]} differs from the others: {self._moves()}"
            case Kind.MOVED:
                found = f"The mount has moved before {names[self.apart[0]]}: {self._moves()}"
        return f"{found} ({test})"

    def _moves(self) -> str:
        """By how much those apart differ, by more than two standard deviations; at least one."""
        apart = [*self.apart]
        values = self.deviations[apart].mean(axis=0)
        variances = (self.sigmas[apart] ** 2).mean(axis=0) / len(apart) + np.diag(self.covariance)
        ratios = np.nan_to_num(np.abs(values) / np.sqrt(variances))
        order = [axis for axis in np.argsort(-ratios) if ratios[axis] >= min(2.0, ratios.max())]
        return listing(
            [
                f"{axes_in_words([AXES[axis]])} by {amount(AXES[axis], values[axis])} +/- "
                f"{amount(AXES[axis], float(np.sqrt(variances[axis])))}"
                for axis in order
            ]
        )


@dataclass(frozen=True)
class _Fit:
    """One extrinsic for a group of results, and what is left of their scatter about it."""

    T: FloatArray
    information: FloatArray
    chi2: float
    dof: int


def agreement_of(Ts_parent_child: FloatArray, covariances: FloatArray) -> Agreement:
    """Compare results of one rig.

    Parameters
    ----------
    Ts_parent_child : (N, 4, 4) array
        In the order of time.
    covariances : (N, 6, 6) array
        Along and about the parent's axes, with the scatter of recordings.
    """
    from scipy.special import chdtrc

    Ts = np.asarray(Ts_parent_child, dtype=float)
    weights = np.array([_information(covariance) for covariance in covariances])
    nothing = np.zeros(len(Ts), dtype=bool)
    whole = _fit(Ts, weights, ~nothing)
    p_value = float(chdtrc(whole.dof, whole.chi2)) if whole.dof else 1.0
    kind, apart = _explanation(Ts, weights, whole, p_value < _LEVEL)
    kept = _fit(Ts, weights, ~apart)
    scatter = math.sqrt(kept.chi2 / kept.dof) if kept.dof else 1.0
    widened = max(scatter, 1.0) ** 2 if kind is not Kind.AGREE else 1.0
    sigmas = np.sqrt([np.diag(_covariance(weight)) for weight in weights])
    sigmas = np.where(sigmas < _UNKNOWN, sigmas, np.nan)
    return Agreement(
        kind=kind,
        apart=tuple(np.flatnonzero(apart).tolist()),
        T_parent_child=kept.T,
        covariance=_covariance(kept.information) * widened,
        chi2=whole.chi2,
        dof=whole.dof,
        p_value=p_value,
        scatter=scatter,
        deviations=np.where(np.isfinite(sigmas), _errors(Ts, kept.T), np.nan),
        sigmas=sigmas,
    )


def _explanation(
    Ts: FloatArray, weights: FloatArray, whole: _Fit, is_large: bool
) -> tuple[Kind, BoolArray]:
    """How the results belong together, and which of them are apart.

    ``is_large`` says whether they scatter more than stated.
    """
    nothing = np.zeros(len(Ts), dtype=bool)
    if len(Ts) == 1:
        return Kind.SINGLE, nothing
    if len(Ts) == 2:
        return Kind.DIFFER if is_large else Kind.AGREE, nothing
    candidates, errors = list(_candidates(len(Ts))), _errors(Ts, whole.T)
    p_values = [_p_of_split(errors, weights, whole, apart) for _, apart in candidates]
    best = int(np.argmin(p_values))
    if len(candidates) * p_values[best] < _LEVEL:
        return candidates[best]
    return Kind.SCATTER if is_large else Kind.AGREE, nothing


def _candidates(count: int) -> Iterator[tuple[Kind, BoolArray]]:
    """Each result alone, and all since each time; what both explain is one that is off."""
    number = np.arange(count)
    for one in range(count):
        yield Kind.ONE_OFF, number == one
    for first in range(2, count - 1):
        yield Kind.MOVED, number >= first


def _p_of_split(errors: FloatArray, weights: FloatArray, whole: _Fit, apart: BoolArray) -> float:
    """Probability of as good a split into two groups, if there is only one."""
    from scipy.special import chdtrc, fdtrc

    left = [_left(errors[group], weights[group]) for group in (apart, ~apart)]
    chi2, dof = sum(one[0] for one in left), sum(one[1] for one in left)
    gained, spent = whole.chi2 - chi2, whole.dof - dof
    if spent <= 0:
        return 1.0
    if dof == 0 or chdtrc(dof, chi2) > _ORDINARY:
        return float(chdtrc(spent, gained))
    return float(fdtrc(spent, dof, gained / spent / (chi2 / dof)))


def _information(covariance: FloatArray) -> FloatArray:
    """Inverse of a covariance (6, 6) in its known directions; none in the others."""
    if not np.isfinite(covariance).all():
        return np.zeros((6, 6))
    values, vectors = np.linalg.eigh(covariance)
    weights = np.where(values < _UNKNOWN**2, 1.0 / np.maximum(values, 1e-12), 0.0)
    return (vectors * weights) @ vectors.T


def _covariance(information: FloatArray, unknown: float = 9.0) -> FloatArray:
    """Inverse of an information; directions without any have this variance."""
    values, vectors = np.linalg.eigh(information)
    variances = np.where(values > 1 / _UNKNOWN**2, 1 / np.maximum(values, 1e-9), unknown)
    return (vectors * variances) @ vectors.T


def _fit(Ts: FloatArray, weights: FloatArray, group: BoolArray) -> _Fit:
    """The extrinsic that fits a group of results best, by least squares."""
    Ts, weights = Ts[group], weights[group]
    total = weights.sum(axis=0)
    T = Ts[int(np.argmax(np.trace(weights, axis1=1, axis2=2)))]
    for _ in range(_ROUNDS):
        weighted = np.einsum("nij,nj->i", weights, _errors(Ts, T))
        step = _covariance(total, unknown=0.0) @ weighted
        T = se3.from_rotation_translation(
            se3.rotation_exp(step[3:]) @ T[:3, :3], T[:3, 3] + step[:3]
        )
    return _Fit(T, total, *_left(_errors(Ts, T), weights))


def _errors(Ts: FloatArray, T: FloatArray) -> FloatArray:
    """Deviations (N, 6) of transforms from one, along and about the parent's axes."""
    rotations = se3.rotation_log(Ts[:, :3, :3] @ T[:3, :3].T)
    return np.concatenate([Ts[:, :3, 3] - T[:3, 3], rotations], axis=1)


def _left(errors: FloatArray, weights: FloatArray) -> tuple[float, int]:
    """Chi-square and degrees of freedom that are left of errors (N, 6) after their common part."""
    total = weights.sum(axis=0)
    weighted = np.einsum("nij,nj->i", weights, errors)
    chi2 = np.einsum("ni,nij,nj->", errors, weights, errors)
    chi2 -= weighted @ _covariance(total, unknown=0.0) @ weighted
    ranks = (np.linalg.eigvalsh([*weights, total]) > 1 / _UNKNOWN**2).sum(axis=1)
    return float(max(chi2, 0.0)), int(ranks[:-1].sum() - ranks[-1])
