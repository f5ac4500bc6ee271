"""Has the mount moved? A result against what is installed, or the results of several recordings."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.assessment.moved import UNKNOWN, Change, moved, scatter_of_recordings
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry.extrinsic import Extrinsic
from hand_eye_calib.results.calibration import Calibration, DofVerdict
from hand_eye_calib.results.records import AxisDifference, Comparison, Difference
from hand_eye_calib.results.status import AXES
from hand_eye_calib.results.verdict import target_of
from hand_eye_calib.session.together import agreement_of_results, require_same_frames
from hand_eye_calib.text import listing

_Named = tuple[str, Calibration | Extrinsic]

# An axis is the same if changes of so many targets would have been seen.
_TARGETS = 5.0


def compare(
    results: Sequence[Calibration],
    installed: Calibration | Extrinsic | None = None,
    names: Sequence[str] | None = None,
) -> Comparison:
    """Compare results with what is installed, or with each other.

    Parameters
    ----------
    results : sequence of Calibration
    installed : Calibration or Extrinsic, optional
        What the robot uses now. Without it: which of several recordings of one rig has moved?
    names : sequence of str, optional
        What to call the results; numbered by default.

    Returns
    -------
    Comparison
        The differences from what is installed, or of each result from each; ``verdict`` is "same",
        "moved" or "cannot tell". ``moved`` names the results that differ from what is installed, or
        without which the others agree.

    Raises
    ------
    InputError
        If there is nothing to compare, or the results are of different frames.

    Examples
    --------
    >>> hec.compare([result], installed=result).verdict
    'same'
    """
    called = list(names) if names else [f"result {i}" for i in range(1, len(results) + 1)]
    if len(called) != len(results) or len(set(called)) != len(called):
        raise InputError(f"expected {len(results)} different names, found {len(called)}")
    require_same_frames(each for each in (*results, installed) if isinstance(each, Calibration))
    named = list(zip(called, results, strict=True))
    couples: list[tuple[_Named, _Named]] = [*combinations(named, 2)]
    if installed is not None:
        couples = [(("installed", installed), each) for each in named]
    if not couples:
        raise InputError("expected two results or more, or one and what is installed")
    limits = _TARGETS * np.array([target_of(axis, results[0]) for axis in AXES])
    differences = tuple(_difference(*couple, limits) for couple in couples)
    verdict = Change.of_all([Change(each.verdict) for each in differences]).value
    apart = [each for each in differences if each.verdict == Change.MOVED]
    of_all, who = f"{len(results)}", tuple(each.second for each in apart)
    if installed is not None and len(differences) == 1:
        sentence = differences[0].sentence
    elif not apart:
        beside = "another" if installed is None else "what is installed"
        sentence = f"{verdict}: none of {of_all} differs from {beside}"
    elif installed is not None:
        sentence = f"moved: {listing(who)} of {of_all}"
    else:
        # Two differ, so that less evidence says which.
        found = agreement_of_results(results, level=0.05)
        pairs = listing([f"{each.first} and {each.second}" for each in apart])
        who, told = (), f"{pairs} differ; which of them has moved, they do not tell"
        if found.kind in ("one off", "moved"):
            who, told = tuple(called[index] for index in found.apart), found.sentence(called)
        sentence = f"moved: {told}"
    return Comparison(sentence=sentence, verdict=verdict, moved=who, differences=differences)


def with_comparison(result: Calibration, installed: Calibration | Extrinsic) -> Calibration:
    """The result with its comparison with what is installed."""
    stated = installed
    if isinstance(stated, Calibration):
        stated = Extrinsic(stated.T_parent_child, "a result")
    values = dict(zip(AXES, stated.values.tolist(), strict=True))
    found = compare([result], installed, ["result"])
    return replace(result, comparison=replace(found, installed=stated.origin, values=values))


def _difference(first: _Named, second: _Named, limits: FloatArray) -> Difference:
    (first_name, one), (second_name, two) = first, second
    covariance, scatter, floor = _spread(one) + _spread(two)
    if not (_is_found(one) and _is_found(two)):
        # What is the same in all recordings is in one of both only: the larger of both, by axis.
        scatter = floor + np.diag(np.maximum(np.diag(scatter - floor), 0.0))
    values = deviation(two.T_parent_child, one.T_parent_child)
    found = moved(values, covariance + scatter, limits)
    columns = (found.values.tolist(), found.sigmas.tolist(), found.visible.tolist())
    rows = zip(*columns, (each.value for each in found.verdicts), strict=True)
    return Difference(
        first=first_name,
        second=second_name,
        verdict=found.verdict.value,
        sentence=found.sentence,
        chi2=found.chi2,
        axes={
            axis: AxisDifference(difference=value, sigma=sigma, visible=visible, verdict=verdict)
            for axis, (value, sigma, visible, verdict) in zip(AXES, rows, strict=True)
        },
    )


def _is_found(given: Calibration | Extrinsic) -> bool:
    """Whether it was found from motion, with the same sensors."""
    return isinstance(given, Calibration) or given.is_calibration


def _spread(given: Calibration | Extrinsic) -> FloatArray:
    """Covariance (6, 6) along and about the parent's axes, how recordings of its rig scatter, and
    its floor, stacked.
    """
    to_parent = np.kron(np.eye(2), given.T_parent_child[:3, :3])
    covariance, floor = np.diag(UNKNOWN**2), np.zeros((6, 6))
    if np.isfinite(given.covariance).all():
        covariance = to_parent @ given.covariance @ to_parent.T
    if isinstance(given, Calibration):
        hidden = [dof.verdict is DofVerdict.UNOBSERVABLE for dof in given.observability]
        covariance = covariance + np.diag(np.where(hidden, UNKNOWN**2, 0.0))
        if given.floor is not None:
            floor = to_parent @ given.floor @ to_parent.T
    scatter = scatter_of_recordings(covariance) if _is_found(given) else np.zeros((6, 6))
    return np.array([covariance, scatter, floor])
