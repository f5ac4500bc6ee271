"""Has the mount moved? A result against what is installed, or the results of several recordings."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, count

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.assessment.moved import UNKNOWN, Change, moved, scatter_of_recordings
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry.extrinsic import Extrinsic, turned
from hand_eye_calib.results.calibration import Calibration, DofVerdict
from hand_eye_calib.results.context import AxisDifference, Comparison, Difference
from hand_eye_calib.results.status import AXES
from hand_eye_calib.results.verdict import target_of
from hand_eye_calib.session.together import agreement_of_results, require_same_frames
from hand_eye_calib.text import listing

_Named = tuple[str, Calibration | Extrinsic]

# An axis is the same if changes of so many targets would have been seen.
SEEN_TARGETS = 5.0


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
        Its ``moved`` names the results that differ, or without which the others agree.

    Raises
    ------
    InputError
        If there is nothing to compare, or the results are of different frames.

    Examples
    --------
    >>> hec.compare([result], installed=result).verdict
    'same'
    """
    named = list(zip(names or map("result {}".format, count(1)), results, strict=False))
    if len(dict(named)) < len(results):
        raise InputError(f"expected {len(results)} different names, found {len(dict(named))}")
    require_same_frames(each for each in (*results, installed) if isinstance(each, Calibration))
    couples: list[tuple[_Named, tuple[str, Calibration]]] = [*combinations(named, 2)]
    if installed is not None:
        couples = [(("installed", installed), each) for each in named]
    if not couples:
        raise InputError("expected two results or more, or one and what is installed")
    differences = tuple(_difference(*couple) for couple in couples)
    verdict = Change.of_all([Change(each.verdict) for each in differences]).value
    apart = tuple(each.second for each in differences if each.verdict == Change.MOVED)
    others = "another" if installed is None else "what is installed"
    sentence = f"{verdict}: none of {len(results)} differs from {others}"
    sentence = f"moved: {listing(apart)} of {len(results)}" if apart else sentence
    if installed is not None and len(differences) == 1:
        sentence = differences[0].sentence
    elif apart and installed is None:
        apart, sentence = _who_moved([*dict(named)], results, differences)
    return Comparison(sentence=sentence, verdict=verdict, moved=apart, differences=differences)


def _who_moved(
    names: Sequence[str], results: Sequence[Calibration], differences: Sequence[Difference]
) -> tuple[tuple[str, ...], str]:
    """Those without which the others agree, and a sentence; none if nothing explains it."""
    # Two differ, so that less evidence says which.
    found = agreement_of_results(results, level=0.05)
    if found.kind in ("one off", "moved"):
        return tuple(names[index] for index in found.apart), f"moved: {found.sentence(names)}"
    apart = [each for each in differences if each.verdict == Change.MOVED]
    pairs = listing([f"{each.first} and {each.second}" for each in apart])
    return (), f"moved: {pairs} differ; they do not show which of them has moved"


def with_comparison(result: Calibration, installed: Calibration | Extrinsic) -> Calibration:
    """The result with its comparison with what is installed."""
    stated = installed
    if isinstance(stated, Calibration):
        stated = Extrinsic(stated.T_parent_child, "a result")
    values = dict(zip(AXES, stated.values.tolist(), strict=True))
    found = compare([result], installed, ["result"])
    return replace(result, comparison=replace(found, installed=stated.origin, values=values))


def _difference(first: _Named, second: tuple[str, Calibration]) -> Difference:
    (first_name, one), (second_name, two) = first, second
    covariance, scatter, floor = _spread(one) + _spread(two)
    if not (_is_found(one) and _is_found(two)):
        # What is the same in all recordings is in one of both only: the larger of both, by axis.
        scatter = floor + np.diag(np.maximum(np.diag(scatter - floor), 0.0))
    values = deviation(two.T_parent_child, one.T_parent_child)
    limits = SEEN_TARGETS * np.array([target_of(axis, two) for axis in AXES])
    found = moved(values, covariance + scatter, limits)
    columns = (found.values.tolist(), found.sigmas.tolist(), found.visible.tolist())
    rows = zip(*columns, (each.value for each in found.verdicts), strict=True)
    return Difference(
        first=first_name,
        second=second_name,
        verdict=found.verdict.value,
        sentence=found.sentence,
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
    rotation = given.T_parent_child[:3, :3]
    covariance, floor = np.diag(UNKNOWN**2), np.zeros((6, 6))
    if np.isfinite(given.covariance).all():
        covariance = turned(rotation, given.covariance)
    if isinstance(given, Calibration):
        hidden = [dof.verdict is DofVerdict.UNOBSERVABLE for dof in given.observability]
        covariance = covariance + np.diag(np.where(hidden, UNKNOWN**2, 0.0))
        floor = turned(rotation, given.floor)
    scatter = scatter_of_recordings(covariance) if _is_found(given) else np.zeros((6, 6))
    return np.array([covariance, scatter, floor])
