"""Scores of answers: errors over their bound, and whether stated intervals contain the truth."""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.geometry.se3 import deviation, rotation_of
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.reasons import Verdict
from reproduction.coverage.measures import HALF_WIDTH_90, MEDIAN_3
from reproduction.coverage.scores import answer
from reproduction.gate.cases import Case, simulated_case

# Half-width of a 99.9 % interval, in standard deviations.
_REACH_999 = 3.3

_PARTS = (slice(0, 3), slice(3, 6))
# To mm and deg.
_UNITS = (1e3, 180.0 / np.pi)


@dataclass(frozen=True, kw_only=True)
class Score:
    """Errors and intervals of the result of one recording.

    ``errors`` are the errors of translation and rotation: divided by the bound for simulated
    recordings, in mm and deg for real recordings. The tuple is empty if an axis of a simulated
    recording is unobserved. ``robust_errors`` are the errors of robust least squares on
    the same recording, in the same units. ``over_bound`` and ``nees`` are squared Mahalanobis
    distances of the errors (6 degrees of freedom), for the bound and for the measured covariance.
    ``axes`` is the number of compared axes, ``inside`` counts true values in measured 90 %
    intervals, and ``inside_allowance`` those in intervals with the allowance.
    """

    family: str
    name: str
    # Verdict of the answer; empty if there is no answer.
    verdict: str
    errors: tuple[float, ...] = ()
    robust_errors: tuple[float, ...] = ()
    over_bound: float | None = None
    nees: float | None = None
    axes: int = 0
    inside: int = 0
    inside_allowance: int = 0
    # Whether the verdict is USE, although an axis is outside its 99.9 % interval or the recording
    # must be refused.
    is_wrong: bool = False


def score(case: Case) -> Score:
    """Calibrate one recording and compare the answer with the truth."""
    result = answer(*case.streams, case.options)
    if result is None:
        return Score(family=case.family, name=case.name, verdict="")
    is_use = result.verdict is Verdict.USE
    if case.must_not_be_used:
        return Score(
            family=case.family,
            name=case.name,
            verdict=result.verdict.value,
            is_wrong=is_use,
        )
    errors = deviation(result.T_parent_child, case.T_parent_child)
    is_observed = np.isfinite(result.sigmas)
    is_known = is_observed & np.isfinite(case.sigmas)
    measured = np.hypot(result.sigmas_measured, case.sigmas)[is_known]
    stated = np.hypot(result.sigmas, case.sigmas)[is_known]
    sizes = np.abs(errors)[is_known]
    over_bound = None
    nees = None
    if case.bound is not None and is_observed.all():
        to_parent = _to_parent(result)
        covariance = to_parent @ result.covariance_measured @ to_parent.T
        over_bound = _squared(errors, to_parent @ case.bound @ to_parent.T)
        nees = _squared(errors, covariance)
    robust = answer(
        *case.streams, {**case.options, "method": "robust", "checks": False}
    )
    return Score(
        family=case.family,
        name=case.name,
        verdict=result.verdict.value,
        errors=_errors_of(case, result, is_observed),
        robust_errors=_errors_of(case, robust, is_observed) if robust else (),
        over_bound=over_bound,
        nees=nees,
        axes=int(is_known.sum()),
        inside=int((sizes < HALF_WIDTH_90 * measured).sum()),
        inside_allowance=int((sizes < HALF_WIDTH_90 * stated).sum()),
        is_wrong=is_use and bool((sizes > _REACH_999 * stated).any()),
    )


def _errors_of(
    case: Case, result: Calibration, is_observed: BoolArray
) -> tuple[float, ...]:
    """Return the errors of translation and rotation of an answer to a case.

    Errors are divided by the bound of a simulated recording. A real recording has no bound: its
    errors are in mm and deg. Only the axes in ``is_observed`` (6,) are compared with the truth of a
    real recording. For a simulated recording with an unobserved axis, the tuple is empty.
    """
    errors = deviation(result.T_parent_child, case.T_parent_child)
    if case.bound is None:
        is_known = is_observed & np.isfinite(case.sigmas)
        return _sizes(np.where(is_known, errors, 0.0), case.sigmas)
    if not is_observed.all():
        return ()
    to_parent = _to_parent(result)
    bound = to_parent @ case.bound @ to_parent.T
    return tuple(
        float(np.sqrt(_squared(errors[axes], bound[axes, axes]) / MEDIAN_3))
        for axes in _PARTS
    )


def _to_parent(result: Calibration) -> FloatArray:
    """Return the rotation (6, 6) of errors from the child's axes to the parent's axes."""
    rotation = rotation_of(result.T_parent_child)
    return np.asarray(np.kron(np.eye(2), rotation))


def score_simulated(family: str, seed: int, number: int) -> Score:
    """Draw a simulated recording and score its answer."""
    return score(simulated_case(family, seed, number))


def _squared(errors: FloatArray, covariance: FloatArray) -> float:
    """Return the squared Mahalanobis distance of errors."""
    weighted = np.linalg.solve(covariance, errors)
    return float(errors @ weighted)


def _sizes(errors: FloatArray, truth_sigmas: FloatArray) -> tuple[float, ...]:
    """Return the sizes of the translation error (mm) and of the rotation error (deg).

    A part is left out if no axis of its truth is known. Half of the truth's standard deviation is
    added in quadrature, because smaller improvements are chance.
    """
    known_sigmas = np.where(np.isfinite(truth_sigmas), truth_sigmas, 0.0)
    squares = errors**2 + 0.25 * known_sigmas**2
    return tuple(
        unit * float(np.sqrt(squares[axes].sum()))
        for axes, unit in zip(_PARTS, _UNITS, strict=True)
        if np.isfinite(truth_sigmas[axes]).any()
    )
