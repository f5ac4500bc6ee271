"""Has the mount moved? A result against what is installed, or the results of several recordings."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.covariance import AXES
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.assessment.moved import UNKNOWN, Change, Moved, moved, scatter_of_recordings
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry.extrinsic import Extrinsic
from hand_eye_calib.plain import from_plain, plain
from hand_eye_calib.results.calibration import Calibration, DofVerdict
from hand_eye_calib.results.records import Comparison as Installed
from hand_eye_calib.results.verdict import target_of
from hand_eye_calib.session.agreement import Agreement, agreement_of
from hand_eye_calib.text import listing

# An axis is the same if changes of so many targets would have been seen.
_TARGETS = 5.0


@dataclass(frozen=True, kw_only=True)
class Difference(Moved):
    """How an extrinsic differs from another: second minus first; see Moved.

    Attributes
    ----------
    first, second : str
        What is compared.
    """

    first: str
    second: str

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain values."""
        columns = zip(AXES, self.values, self.sigmas, self.visible, self.verdicts, strict=True)
        return {
            "first": self.first,
            "second": self.second,
            "verdict": self.verdict.value,
            "sentence": self.sentence,
            "chi2": self.chi2,
            "axes": {
                axis: plain(
                    {
                        "difference": value,
                        "sigma": sigma,
                        "visible": visible,
                        "verdict": verdict.value,
                    }
                )
                for axis, value, sigma, visible, verdict in columns
            },
        }


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The differences of results from what is installed, or of each from each.

    Attributes
    ----------
    differences : tuple of Difference
    moved : tuple of str
        Results after whose removal the others agree; those that differ from what is installed.
    verdict : Change
    sentence : str
    """

    differences: tuple[Difference, ...]
    moved: tuple[str, ...]
    verdict: Change
    sentence: str

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain values."""
        return {
            "verdict": self.verdict.value,
            "sentence": self.sentence,
            "moved": list(self.moved),
            "differences": [each.to_dict() for each in self.differences],
        }


def compare(
    results: Sequence[Calibration | Extrinsic],
    installed: Calibration | Extrinsic | None = None,
    names: Sequence[str] | None = None,
    targets: Sequence[float] | None = None,
) -> Comparison:
    """Compare results with what is installed, or with each other.

    Parameters
    ----------
    results : sequence of Calibration
    installed : Calibration or Extrinsic, optional
        What the robot uses now. Without it the results of several recordings of one rig are
        compared: which one has moved?
    names : sequence of str, optional
        What to call the results; numbered by default.
    targets : (6,) sequence of float, optional
        Accuracy that matters along (m) and about (rad) each axis; by default that of the results.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If there is nothing to compare, or the results are of different frames.
    """
    called = list(names) if names else [f"result {i}" for i in range(1, len(results) + 1)]
    if len(called) != len(results) or len(set(called)) != len(called):
        raise InputError(f"expected {len(results)} different names, found {len(called)}")
    _require_same_frames([*results, *([installed] if installed is not None else [])])
    limits = _limits(results, targets)
    stated = [_stated(result, name) for result, name in zip(results, called, strict=True)]
    if installed is not None:
        if not stated:
            raise InputError("expected at least one result, found none")
        return _with_installed(stated, _stated(installed, "installed"), limits)
    if len(stated) < 2:
        raise InputError("expected two results or more, or one and what is installed")
    return _among_each_other(stated, limits)


def with_comparison(result: Calibration, installed: Calibration | Extrinsic) -> Calibration:
    """The result with its comparison with what is installed."""
    document: dict[str, Any] = compare([result], installed, ["result"]).to_dict()
    document["installed"] = installed.origin if isinstance(installed, Extrinsic) else "a result"
    stated = installed if isinstance(installed, Extrinsic) else _stated(installed, "").extrinsic
    document["values"] = dict(zip(AXES, stated.values.tolist(), strict=True))
    return replace(result, comparison=from_plain(Installed, document))


def agreement_of_results(results: Sequence[Calibration]) -> Agreement:
    """How the results of several recordings of one rig, in the order of time, belong together."""
    stated = [_stated(result, "") for result in results]
    return agreement_of(
        np.array([each.extrinsic.T_parent_child for each in stated]),
        np.array([each.covariance + each.scatter for each in stated]),
    )


@dataclass(frozen=True)
class _Stated:
    """An extrinsic; along and about the parent's axes its covariance, how recordings of its rig
    scatter, and its floor.
    """

    name: str
    extrinsic: Extrinsic
    covariance: FloatArray
    scatter: FloatArray
    floor: FloatArray


def _stated(given: Calibration | Extrinsic, name: str) -> _Stated:
    unknown = np.diag(UNKNOWN**2)
    if isinstance(given, Extrinsic):
        is_known = bool(np.isfinite(given.covariance).all())
        covariance = given.covariance_in_parent if is_known else unknown
        scatter = scatter_of_recordings(covariance) if given.is_calibration else np.zeros((6, 6))
        return _Stated(name, given, covariance, scatter, np.zeros((6, 6)))
    X = given.T_parent_child
    found = Extrinsic(X, name, given.covariance, is_calibration=True)
    to_parent = np.kron(np.eye(2), X[:3, :3])
    floor = np.zeros((6, 6)) if given.floor is None else to_parent @ given.floor @ to_parent.T
    hidden = [dof.verdict is DofVerdict.UNOBSERVABLE for dof in given.observability]
    is_known = bool(np.isfinite(given.covariance).all())
    covariance = found.covariance_in_parent if is_known else unknown
    covariance = covariance + np.where(hidden, unknown, 0.0)
    return _Stated(name, found, covariance, scatter_of_recordings(covariance), floor)


def _require_same_frames(results: Sequence[Calibration | Extrinsic]) -> None:
    frames = {
        (result.parent_frame, result.child_frame)
        for result in results
        if isinstance(result, Calibration)
    }
    if len(frames) > 1:
        told = listing([f"{child} in {parent}" for parent, child in sorted(frames)])
        raise InputError(f"expected results of one pair of frames; found {told}")


def _limits(
    results: Sequence[Calibration | Extrinsic], targets: Sequence[float] | None
) -> FloatArray:
    """Changes (6,) that have to be seen before an axis is called the same."""
    if targets is None:
        stated = [
            [target_of(axis, result) for axis in AXES]
            for result in results
            if isinstance(result, Calibration)
        ]
        targets = stated[0] if stated else CalibratorConfig().targets
    return _TARGETS * np.array(targets)


def _difference(first: _Stated, second: _Stated, limits: FloatArray) -> Difference:
    values = deviation(second.extrinsic.T_parent_child, first.extrinsic.T_parent_child)
    scatter, floor = first.scatter + second.scatter, first.floor + second.floor
    if not (first.extrinsic.is_calibration and second.extrinsic.is_calibration):
        # What is the same in all recordings is in one of both only: the larger of both, by axis.
        scatter = floor + np.diag(np.maximum(np.diag(scatter - floor), 0.0))
    found = moved(values, first.covariance + second.covariance + scatter, limits)
    return Difference(**vars(found), first=first.name, second=second.name)


def _with_installed(
    stated: Sequence[_Stated], installed: _Stated, limits: FloatArray
) -> Comparison:
    differences = tuple(_difference(installed, each, limits) for each in stated)
    names = tuple(each.second for each in differences if each.verdict is Change.MOVED)
    verdict = Change.of_all([each.verdict for each in differences])
    if len(differences) == 1:
        sentence = differences[0].sentence
    elif names:
        sentence = f"moved: {listing(names)} of {len(stated)}"
    else:
        sentence = f"{verdict.value}: none of {len(stated)} differs"
    return Comparison(differences=differences, moved=names, verdict=verdict, sentence=sentence)


def _among_each_other(stated: Sequence[_Stated], limits: FloatArray) -> Comparison:
    """Each with each; and whose removal lets the others agree."""
    differences = tuple(
        _difference(first, second, limits) for first, second in itertools.combinations(stated, 2)
    )
    names = [each.name for each in stated]
    apart = [(d.first, d.second) for d in differences if d.verdict is Change.MOVED]
    moved_names = _who_moved(names, apart)
    verdict = Change.of_all([each.verdict for each in differences])
    if verdict is not Change.MOVED:
        sentence = f"{verdict.value}: none of {len(stated)} differs from another"
    elif not moved_names:
        pairs = listing([f"{first} and {second}" for first, second in apart])
        sentence = f"moved: {pairs} differ; which of them has moved, they do not tell"
    elif len(moved_names) == 1:
        sentence = f"moved: {moved_names[0]} differs, the others agree"
    else:
        last = names[names.index(moved_names[0]) - 1]
        sentence = f"moved between {last} and {moved_names[0]}: {listing(moved_names)}"
    return Comparison(
        differences=differences, moved=moved_names, verdict=verdict, sentence=sentence
    )


def _who_moved(names: Sequence[str], apart: Sequence[tuple[str, str]]) -> tuple[str, ...]:
    """The one without which the others agree; or those from some recording on, if those before
    agree and those from there on agree. Empty if neither, or more than one, is possible.
    """

    def agree(some: Sequence[str]) -> bool:
        return not any(first in some and second in some for first, second in apart)

    if not apart or len(names) < 3:
        return ()
    singles = [name for name in names if agree([other for other in names if other != name])]
    if len(singles) == 1:
        return tuple(singles)
    splits = [k for k in range(2, len(names) - 1) if agree(names[:k]) and agree(names[k:])]
    return tuple(names[splits[0] :]) if not singles and len(splits) == 1 else ()
