"""Has the mount moved? A result against what is installed, or the results of several recordings."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.assessment.moved import UNKNOWN, Change, Moved, moved, scatter_of_recordings
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry.extrinsic import Extrinsic
from hand_eye_calib.plain import from_plain, plain
from hand_eye_calib.results.calibration import Calibration, DofVerdict
from hand_eye_calib.results.records import Comparison as Installed
from hand_eye_calib.results.status import AXES
from hand_eye_calib.results.verdict import target_of
from hand_eye_calib.session.agreement import Kind
from hand_eye_calib.session.together import agreement_of_results, require_same_frames
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
        names = ("difference", "sigma", "visible", "verdict")
        verdicts = [each.value for each in self.verdicts]
        rows = zip(self.values, self.sigmas, self.visible, verdicts, strict=True)
        axes = {
            axis: plain(dict(zip(names, row, strict=True)))
            for axis, row in zip(AXES, rows, strict=True)
        }
        taken = {name: getattr(self, name) for name in ("first", "second", "sentence", "chi2")}
        return taken | {"verdict": self.verdict.value, "axes": axes}


@dataclass(frozen=True)
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
        differences = [each.to_dict() for each in self.differences]
        told = {"verdict": self.verdict.value, "sentence": self.sentence}
        return told | {"moved": list(self.moved), "differences": differences}


def compare(
    results: Sequence[Calibration | Extrinsic],
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

    Raises
    ------
    InputError
        If there is nothing to compare, or the results are of different frames.

    Examples
    --------
    >>> hec.compare([result], installed=result).verdict.value
    'same'
    """
    called = list(names) if names else [f"result {i}" for i in range(1, len(results) + 1)]
    if len(called) != len(results) or len(set(called)) != len(called):
        raise InputError(f"expected {len(results)} different names, found {len(called)}")
    calibrations = [each for each in results if isinstance(each, Calibration)]
    require_same_frames(each for each in (*results, installed) if isinstance(each, Calibration))
    targets = [target_of(axis, each) for each in calibrations[:1] for axis in AXES]
    limits = _TARGETS * np.array(targets or CalibratorConfig().targets)
    stated = [_stated(result, name) for result, name in zip(results, called, strict=True)]
    couples = list(itertools.combinations(stated, 2))
    if installed is not None:
        couples = [(_stated(installed, "installed"), each) for each in stated]
    if not couples:
        raise InputError("expected two results or more, or one and what is installed")
    differences = tuple(_difference(*couple, limits) for couple in couples)
    verdict = Change.of_all([each.verdict for each in differences])
    moved_names = tuple(each.second for each in differences if each.verdict is Change.MOVED)
    sentence = f"moved: {listing(moved_names)} of {len(stated)}"
    if installed is not None and len(differences) == 1:
        sentence = differences[0].sentence
    elif not moved_names:
        beside = "another" if installed is None else "what is installed"
        sentence = f"{verdict.value}: none of {len(stated)} differs from {beside}"
    elif installed is None:
        moved_names, sentence = _who_moved(called, calibrations, differences)
    return Comparison(differences, moved_names, verdict, sentence)


def _who_moved(
    names: Sequence[str], results: Sequence[Calibration], differences: Sequence[Difference]
) -> tuple[tuple[str, ...], str]:
    """The one without which the others agree; or those from some recording on. Nobody, if neither
    explains the differences.
    """
    if len(results) == len(names) > 2:
        # Two differ, so that less evidence says which.
        found = agreement_of_results(results, level=0.05)
        moved_names = tuple(names[index] for index in found.apart)
        if found.kind is Kind.ONE_OFF:
            return moved_names, f"moved: {moved_names[0]} differs, the others agree"
        if found.kind is Kind.MOVED:
            between = f"{names[found.apart[0] - 1]} and {moved_names[0]}"
            return moved_names, f"moved between {between}: {listing(moved_names)}"
    apart = [each for each in differences if each.verdict is Change.MOVED]
    pairs = listing([f"{each.first} and {each.second}" for each in apart])
    return (), f"moved: {pairs} differ; which of them has moved, they do not tell"


def with_comparison(result: Calibration, installed: Calibration | Extrinsic) -> Calibration:
    """The result with its comparison with what is installed."""
    document: dict[str, Any] = compare([result], installed, ["result"]).to_dict()
    document["installed"] = installed.origin if isinstance(installed, Extrinsic) else "a result"
    stated = installed if isinstance(installed, Extrinsic) else _stated(installed, "").extrinsic
    document["values"] = dict(zip(AXES, stated.values.tolist(), strict=True))
    return replace(result, comparison=from_plain(Installed, document))


class _Stated(NamedTuple):
    """An extrinsic; along and about the parent's axes its covariance, how recordings of its rig
    scatter, and its floor.
    """

    name: str
    extrinsic: Extrinsic
    covariance: FloatArray
    scatter: FloatArray
    floor: FloatArray


def _stated(given: Calibration | Extrinsic, name: str) -> _Stated:
    X, floor, hidden = given.T_parent_child, np.zeros((6, 6)), np.zeros(6, dtype=bool)
    to_parent = np.kron(np.eye(2), X[:3, :3])
    if isinstance(given, Calibration):
        if given.floor is not None:
            floor = to_parent @ given.floor @ to_parent.T
        hidden = np.array([dof.verdict is DofVerdict.UNOBSERVABLE for dof in given.observability])
        given = Extrinsic(X, name, given.covariance, is_calibration=True)
    unknown = np.diag(UNKNOWN**2)
    is_known = bool(np.isfinite(given.covariance).all())
    covariance = to_parent @ given.covariance @ to_parent.T if is_known else unknown
    covariance = covariance + np.where(hidden, unknown, 0.0)
    scatter = scatter_of_recordings(covariance) if given.is_calibration else np.zeros((6, 6))
    return _Stated(name, given, covariance, scatter, floor)


def _difference(first: _Stated, second: _Stated, limits: FloatArray) -> Difference:
    values = deviation(second.extrinsic.T_parent_child, first.extrinsic.T_parent_child)
    scatter, floor = first.scatter + second.scatter, first.floor + second.floor
    if not (first.extrinsic.is_calibration and second.extrinsic.is_calibration):
        # What is the same in all recordings is in one of both only: the larger of both, by axis.
        scatter = floor + np.diag(np.maximum(np.diag(scatter - floor), 0.0))
    found = moved(values, first.covariance + second.covariance + scatter, limits)
    return Difference(**vars(found), first=first.name, second=second.name)
