"""Comparison of a result with what is installed, or of results with each other."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations, count

import numpy as np

from hand_eye_calib.core.assessment.agreement import Agreement, agreement_of
from hand_eye_calib.core.assessment.change import UNKNOWN, Change, moved
from hand_eye_calib.core.assessment.moved import scatter_of_recordings
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.core.geometry.frames import Extrinsic
from hand_eye_calib.core.geometry.se3 import deviation, turned, xyz_rpy
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.context import Comparison, Difference
from hand_eye_calib.core.results.records import AXES, DofVerdict
from hand_eye_calib.core.results.verdict import target_of

_Named = tuple[str, Calibration | Extrinsic]

# Largest undetected change of an axis, in targets, with which the axis counts as the same.
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
    """The results without which the others agree, if there are such, and a sentence."""
    # That two differ is known: less evidence is enough to say which.
    found = agreement_of_results(results, level=0.05)
    if found.kind in ("one off", "moved"):
        return tuple(names[index] for index in found.apart), f"moved: {found.sentence(names)}"
    apart = [each for each in differences if each.verdict == Change.MOVED]
    pairs = listing([f"{each.first} and {each.second}" for each in apart])
    return (), f"moved: {pairs} differ; they do not show which of them has moved"


def with_comparison(result: Calibration, installed: Calibration | Extrinsic) -> Calibration:
    """The result with its comparison with what is installed."""
    origin = "a result" if isinstance(installed, Calibration) else installed.origin
    values = by_axis(xyz_rpy(installed.T_parent_child))
    found = compare([result], installed, ["result"])
    return replace(result, comparison=replace(found, installed=origin, values=values))


def _difference(first: _Named, second: tuple[str, Calibration]) -> Difference:
    first_name, one = first
    second_name, two = second
    covariance, scatter, allowance = _spread(one) + _spread(two)
    if not (_is_found(one) and _is_found(two)):
        # What is the same in all recordings is in one of both only: the larger of both, by axis.
        scatter = allowance + np.diag(np.maximum(np.diag(scatter - allowance), 0.0))
    values = deviation(two.T_parent_child, one.T_parent_child)
    limits = SEEN_TARGETS * np.array([target_of(axis, two) for axis in AXES])
    found = moved(values, covariance + scatter, limits)
    return Difference(
        first=first_name,
        second=second_name,
        verdict=found.verdict.value,
        sentence=found.sentence,
        axes=found.axes,
    )


def _is_found(given: Calibration | Extrinsic) -> bool:
    """Whether it was found from motion, with the same sensors."""
    return isinstance(given, Calibration) or given.is_calibration


def _spread(given: Calibration | Extrinsic) -> FloatArray:
    """Covariance (6, 6) along and about the parent's axes, how recordings of its rig scatter, and
    its allowance, stacked.
    """
    rotation = given.T_parent_child[:3, :3]
    covariance = np.diag(UNKNOWN**2)
    allowance = np.zeros((6, 6))
    measured = given.covariance_measured if isinstance(given, Calibration) else given.covariance
    if np.isfinite(measured).all():
        covariance = turned(rotation, measured)
    if isinstance(given, Calibration):
        hidden = [dof.verdict is DofVerdict.UNOBSERVABLE for dof in given.observability]
        covariance = covariance + np.diag(np.where(hidden, UNKNOWN**2, 0.0))
        allowance = turned(rotation, given.covariance_allowance)
    scatter = scatter_of_recordings(covariance) if _is_found(given) else np.zeros((6, 6))
    return np.array([covariance, scatter, allowance])


def agreement_of_results(results: Sequence[Calibration], level: float = 0.01) -> Agreement:
    """How the results of several recordings of one rig, in the order of time, belong together; the
    level is that of :func:`agreement_of`.
    """
    Ts = np.array([each.T_parent_child for each in results])
    covariances = turned(Ts[:, :3, :3], np.array([each.covariance_measured for each in results]))
    usual = [np.diag(scatter_of_recordings(each)) for each in covariances]
    return agreement_of(Ts, covariances, np.sqrt(np.median(usual, axis=0)), level)


def require_same_frames(results: Iterable[Calibration]) -> None:
    """Raise InputError unless all results are of one pair of frames."""
    frames = {f"{each.child_frame} in {each.parent_frame}" for each in results}
    if len(frames) > 1:
        raise InputError(
            f"expected results of one pair of frames; found {' and '.join(sorted(frames))}"
        )


def by_axis(values: FloatArray) -> dict[str, float]:
    """Return values (6,) by the names of their axes."""
    return dict(zip(AXES, values.tolist(), strict=True))
