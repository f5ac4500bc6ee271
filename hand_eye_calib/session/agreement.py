"""Whether several results of one rig agree, and which recording does not belong to the others.

Each result has a covariance, so their scatter can be tested: the sum of squared distances from the
common extrinsic, in standard deviations, has a chi-square distribution. Directions that a recording
did not reveal count neither as agreement nor as contradiction.

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
from scipy.special import chdtrc, fdtrc

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.geometry import se3

# A direction with a larger standard deviation (m, rad) is unknown.
_UNKNOWN = 0.3
_ROUNDS = 4
# Probability of a false alarm.
_LEVEL = 0.01


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
    """What came of a comparison of results.

    Attributes
    ----------
    kind : Kind
    apart : tuple of int
        Indices of the results that do not belong to the others: the one that is off, or all since
        the mount has moved.
    T_parent_child : (4, 4) ndarray
        Common extrinsic of the others.
    covariance : (6, 6) ndarray
        Of that, along and about the parent's axes; with the scatter, if that is larger than stated.
        Unknown directions have a standard deviation of 3.
    chi2, dof, p_value : float, int, float
        Of the hypothesis that all results are of one extrinsic.
    scatter : float
        How many times larger than stated the scatter is, without those apart.
    deviations : (N, 6) ndarray
        Of each result from the common extrinsic: x, y, z (m) along the parent's axes and the
        rotation vector (rad) about them. NaN if it does not know the axis.
    sigmas : (N, 6) ndarray
        Stated standard deviations of each.
    difference : (6,) ndarray
        Of those apart from the others, likewise. NaN if none is apart.
    difference_sigmas : (6,) ndarray
        Standard deviations of that.
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
    difference: FloatArray
    difference_sigmas: FloatArray


@dataclass(frozen=True)
class _Fit:
    """One extrinsic for a group of results."""

    T: FloatArray
    information: FloatArray
    chi2: float
    dof: int


def agreement_of(Ts_parent_child: FloatArray, covariances: FloatArray) -> Agreement:
    """Compare results of one rig.

    Parameters
    ----------
    Ts_parent_child : (N, 4, 4) ndarray
        In the order of time.
    covariances : (N, 6, 6) ndarray
        In the tangent (rho, phi) of the child; with errors that are constant during a recording, if
        they are known (``covariance_with_floor``).
    """
    Ts = np.asarray(Ts_parent_child, dtype=float)
    weights = np.array([_information(*one) for one in zip(Ts, covariances, strict=True)])
    nothing = np.zeros(len(Ts), dtype=bool)
    whole = _fit(Ts, weights, ~nothing)
    p_value = float(chdtrc(whole.dof, whole.chi2)) if whole.dof else 1.0
    kind, apart = _explanation(Ts, weights, whole, p_value < _LEVEL)
    kept = _fit(Ts, weights, ~apart)
    scatter = math.sqrt(kept.chi2 / kept.dof) if kept.dof else 1.0
    widened = max(scatter, 1.0) ** 2 if kind is not Kind.AGREE else 1.0
    difference, difference_sigmas = _difference(Ts, weights, apart, widened)
    sigmas = np.array([_sigmas(weight) for weight in weights])
    deviations = _errors(Ts, kept.T)
    return Agreement(
        kind=kind,
        apart=tuple(np.flatnonzero(apart).tolist()),
        T_parent_child=kept.T,
        covariance=_covariance(kept.information) * widened,
        chi2=whole.chi2,
        dof=whole.dof,
        p_value=p_value,
        scatter=scatter,
        deviations=np.where(np.isfinite(sigmas), deviations, np.nan),
        sigmas=sigmas,
        difference=difference,
        difference_sigmas=difference_sigmas,
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
    best = (math.inf, Kind.AGREE, nothing)
    candidates = list(_candidates(len(Ts)))
    errors = _errors(Ts, whole.T)
    for kind, apart in candidates:
        p_value = len(candidates) * _p_of_split(errors, weights, whole, apart)
        best = min(best, (p_value, kind, apart), key=lambda one: one[0])
    if best[0] < _LEVEL:
        return best[1:]
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
    left = [_left(errors[group], weights[group]) for group in (apart, ~apart)]
    chi2, dof = sum(one[0] for one in left), sum(one[1] for one in left)
    gained, spent = whole.chi2 - chi2, whole.dof - dof
    if spent <= 0:
        return 1.0
    if chi2 <= dof or dof == 0:
        return float(chdtrc(spent, gained))
    return float(fdtrc(spent, dof, gained / spent / (chi2 / dof)))


def _information(T: FloatArray, covariance: FloatArray) -> FloatArray:
    """Inverse of a covariance (6, 6) in its known directions along the parent's axes; none in the
    others.
    """
    if not np.isfinite(covariance).all():
        return np.zeros((6, 6))
    to_parent = np.kron(np.eye(2), T[:3, :3])
    values, vectors = np.linalg.eigh(to_parent @ covariance @ to_parent.T)
    known = values < _UNKNOWN**2
    smallest = 1e-12  # m^2, rad^2
    return (vectors[:, known] / np.maximum(values[known], smallest)) @ vectors[:, known].T


def _ranks(information: FloatArray) -> IntArray:
    """Number of known directions of each matrix (..., 6, 6)."""
    known = np.linalg.eigvalsh(information) > 1 / _UNKNOWN**2
    return np.asarray(known.sum(axis=-1))


def _known_inverse(information: FloatArray) -> FloatArray:
    """Inverse of an information in its known directions; zero in the others."""
    values, vectors = np.linalg.eigh(information)
    known = values > 1 / _UNKNOWN**2
    return (vectors[:, known] / values[known]) @ vectors[:, known].T


def _covariance(information: FloatArray) -> FloatArray:
    """Inverse of an information; directions without any have a standard deviation of 3."""
    values, vectors = np.linalg.eigh(information)
    variances = np.where(values > 1 / _UNKNOWN**2, 1 / np.maximum(values, 1e-9), 9.0)
    return (vectors * variances) @ vectors.T


def _fit(Ts: FloatArray, weights: FloatArray, group: BoolArray) -> _Fit:
    """The extrinsic that fits a group of results best, by least squares."""
    Ts, weights = Ts[group], weights[group]
    total = weights.sum(axis=0)
    T = Ts[int(np.argmax(np.trace(weights, axis1=1, axis2=2)))]
    for _ in range(_ROUNDS):
        errors = _errors(Ts, T)
        step = _known_inverse(total) @ np.einsum("nij,nj->i", weights, errors)
        T = se3.from_rotation_translation(
            se3.rotation_exp(step[3:]) @ T[:3, :3], T[:3, 3] + step[:3]
        )
    chi2, dof = _left(_errors(Ts, T), weights)
    return _Fit(T, total, chi2, dof)


def _errors(Ts: FloatArray, T: FloatArray) -> FloatArray:
    """Deviations (N, 6) of many transforms from one, as :func:`deviation`."""
    turned = se3.rotation_log(Ts[:, :3, :3] @ T[:3, :3].T)
    return np.concatenate([Ts[:, :3, 3] - T[:3, 3], turned], axis=1)


def _left(errors: FloatArray, weights: FloatArray) -> tuple[float, int]:
    """Chi-square and degrees of freedom that are left of errors (N, 6) after their common part."""
    total = weights.sum(axis=0)
    weighted = np.einsum("nij,nj->i", weights, errors)
    chi2 = np.einsum("ni,nij,nj->", errors, weights, errors)
    chi2 -= weighted @ _known_inverse(total) @ weighted
    return float(max(chi2, 0.0)), int(_ranks(weights).sum() - _ranks(total))


def _difference(
    Ts: FloatArray, weights: FloatArray, apart: BoolArray, widened: float
) -> tuple[FloatArray, FloatArray]:
    """Difference of the two groups and its sigmas."""
    if not apart.any():
        return np.full(6, np.nan), np.full(6, np.nan)
    kept, other = (_fit(Ts, weights, group) for group in (~apart, apart))
    difference = deviation(other.T, kept.T)
    variances = sum(_sigmas(fit.information) ** 2 for fit in (kept, other))
    sigmas = np.sqrt(variances * widened)
    return np.where(np.isfinite(sigmas), difference, np.nan), sigmas


def _sigmas(information: FloatArray) -> FloatArray:
    """Standard deviations (6,); NaN of those unknown."""
    sigmas = np.sqrt(np.diag(_covariance(information)))
    return np.where(sigmas < _UNKNOWN, sigmas, np.nan)


def sentence(found: Agreement, names: Sequence[str]) -> str:
    """What a comparison found, in a sentence or two.

    Parameters
    ----------
    found : Agreement
    names : sequence of str
        Of the results, in their order.
    """
    count = len(names)
    test = f"chi-square {found.chi2:.1f} of {found.dof} degrees of freedom, p {found.p_value:.2g}"
    if found.kind is Kind.SINGLE:
        return "One recording: nothing to compare with."
    if found.kind is Kind.AGREE:
        return f"The {count} recordings agree within their standard deviations ({test})."
    if found.kind is Kind.DIFFER:
        return (
            f"{names[0]} and {names[1]} do not agree ({test}); a third recording tells which of "
            "them is off."
        )
    if found.kind is Kind.SCATTER:
        return (
            f"The {count} recordings scatter {found.scatter:.1f} times as much as their standard "
            f"deviations say ({test}); none stands out."
        )
    moved = ", ".join(_moves(found))
    if found.kind is Kind.ONE_OFF:
        return f"{names[found.apart[0]]} does not agree with the others: {moved}."
    return f"The mount has moved before {names[found.apart[0]]}: {moved}."


def _moves(found: Agreement) -> Iterator[str]:
    """Differences of more than two standard deviations, the largest first; at least one."""
    ratios = np.nan_to_num(np.abs(found.difference / found.difference_sigmas))
    order = np.argsort(-ratios)
    axes = ("x", "y", "z", "about x", "about y", "about z")
    for rank, index in enumerate(order.tolist()):
        if rank and ratios[index] < 2:
            return
        value, sigma = found.difference[index], found.difference_sigmas[index]
        if index < 3:
            yield f"{axes[index]} {1000 * value:+.1f} +/- {1000 * sigma:.1f} mm"
        else:
            yield f"{math.degrees(value):+.2f} +/- {math.degrees(sigma):.2f} deg {axes[index]}"
