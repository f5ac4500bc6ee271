"""Has the mount moved? A result against what is installed, or the results of several recordings.

Answers of one rig scatter from recording to recording by more than each of them states, as no
recording shows its own constant errors: each result has that scatter beside its covariance
(docs/session.md has the measurements). A change is called one if an axis differs by more than
chance makes of six axes once in 200 comparisons, or all axes together by what chance makes of them
once in 1,000. An axis is called the same only if a change that matters would have been seen.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.covariance import AXES
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry.extrinsic import Extrinsic
from hand_eye_calib.plain import from_plain
from hand_eye_calib.results.calibration import Calibration, DofVerdict
from hand_eye_calib.results.records import Comparison as Installed
from hand_eye_calib.results.verdict import target_of
from hand_eye_calib.stats import CHI2_THOUSANDTH, LARGEST_OF_SIX, NINE_TIMES_OUT_OF_TEN
from hand_eye_calib.text import amount, listing

# Scatter between recordings of one rig, per axis (m, rad): of flights and hand-held recordings, and
# of vehicles. A vehicle turns about one axis, and knows the translation along it so many times
# worse than along the others.
_SCATTER_IN_HAND = np.repeat([0.008, np.radians(0.12)], 3)
_SCATTER_OF_VEHICLE = np.repeat([0.020, np.radians(0.10)], 3)
_VEHICLE = 4.0

# An axis is the same if changes of so many targets would have been seen.
_TARGETS = 5.0

# Variances that stand for "nothing known" (m^2, rad^2).
_UNKNOWN = np.diag(np.r_[np.full(3, 100.0), np.full(3, 10.0)])


class Change(str, Enum):
    """What a comparison says."""

    SAME = "same"
    MOVED = "moved"
    CANNOT_TELL = "cannot tell"


@dataclass(frozen=True, kw_only=True)
class Difference:
    """How an extrinsic differs from another.

    Attributes
    ----------
    first, second : str
        What is compared; the difference is second minus first.
    values : (6,) array
        Differences along (m) and about (rad) the axes of the parent sensor's frame.
    sigmas : (6,) array
        Their standard deviations; infinite if one of both does not know the axis.
    visible : (6,) array
        Changes of this size would have been seen nine times out of ten.
    verdicts : tuple of Change
        Per axis.
    verdict : Change
    chi2 : float
        Squared distance in units of the covariance; 6 on average if nothing has moved.
    """

    first: str
    second: str
    values: FloatArray
    sigmas: FloatArray
    visible: FloatArray
    verdicts: tuple[Change, ...]
    verdict: Change
    chi2: float

    def axes(self, change: Change) -> list[str]:
        """Names of the axes with this verdict."""
        return [axis for axis, found in zip(AXES, self.verdicts, strict=True) if found is change]

    @property
    def sentence(self) -> str:
        """The verdict in one line, with what it rests on."""
        if self.verdict is Change.MOVED:
            return f"moved: {self._moved()}"
        same, unknown = self.axes(Change.SAME), self.axes(Change.CANNOT_TELL)
        if not unknown:
            return f"same: {self._power(same)}"
        told = f"cannot tell about {listing(unknown)}"
        return f"{told}; {listing(same)} the same: {self._power(same)}" if same else told

    def _moved(self) -> str:
        moved = self.axes(Change.MOVED)
        if not moved:
            ratios = np.abs(self.values) / self.sigmas
            moved = [AXES[axis] for axis in np.argsort(-ratios)[:2] if ratios[axis] > 0]
        if not moved:
            return "by what the axes show together, none of them alone"
        told = []
        for axis in moved:
            index = AXES.index(axis)
            sigma = amount(axis, float(self.sigmas[index]))
            told.append(f"{axis} by {amount(axis, float(self.values[index]))} +/- {sigma}")
        return listing(told)

    def _power(self, axes: Sequence[str]) -> str:
        told = []
        for names in (AXES[:3], AXES[3:]):
            known = [axis for axis in names if axis in axes]
            if known:
                worst = max(known, key=lambda axis: float(self.visible[AXES.index(axis)]))
                told.append(amount(worst, float(self.visible[AXES.index(worst)])))
        return f"a change of {' or '.join(told)} would have been seen"

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
                axis: {
                    "difference": float(value),
                    "sigma": _finite(sigma),
                    "visible": _finite(visible),
                    "verdict": verdict.value,
                }
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
    if isinstance(given, Extrinsic):
        is_known = bool(np.isfinite(given.covariance).all())
        covariance = given.covariance_in_parent if is_known else _UNKNOWN
        scatter = _scatter(covariance) if given.is_calibration else np.zeros((6, 6))
        return _Stated(name, given, covariance, scatter, np.zeros((6, 6)))
    X = given.T_parent_child
    found = Extrinsic(X, name, given.covariance, is_calibration=True)
    to_parent = np.kron(np.eye(2), X[:3, :3])
    floor = np.zeros((6, 6)) if given.floor is None else to_parent @ given.floor @ to_parent.T
    hidden = [dof.verdict is DofVerdict.UNOBSERVABLE for dof in given.observability]
    unknown = np.diag(np.where(hidden, np.diag(_UNKNOWN), 0.0))
    is_known = bool(np.isfinite(given.covariance).all())
    covariance = (found.covariance_in_parent if is_known else _UNKNOWN) + unknown
    return _Stated(name, found, covariance, _scatter(covariance), floor)


def _scatter(covariance: FloatArray) -> FloatArray:
    """Covariance (6, 6) of the answers of several recordings beside that of one."""
    variances = np.linalg.eigvalsh(covariance[:3, :3])
    is_vehicle = variances[2] > _VEHICLE**2 * variances[1]
    return np.diag((_SCATTER_OF_VEHICLE if is_vehicle else _SCATTER_IN_HAND) ** 2)


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
    covariance = first.covariance + second.covariance + scatter
    covariance = covariance + 1e-18 * np.eye(6)
    sigmas = np.sqrt(np.diag(covariance))
    visible = (LARGEST_OF_SIX + NINE_TIMES_OUT_OF_TEN) * sigmas
    distance = float(values @ np.linalg.solve(covariance, values))
    unknown = sigmas > 0.1 * np.sqrt(np.diag(_UNKNOWN))
    sigmas, visible = np.where(unknown, np.inf, sigmas), np.where(unknown, np.inf, visible)
    verdicts = tuple(
        _axis_verdict(abs(value) / sigma, seen <= limit)
        for value, sigma, seen, limit in zip(values, sigmas, visible, limits, strict=True)
    )
    if Change.MOVED in verdicts or distance > CHI2_THOUSANDTH[6]:
        verdict = Change.MOVED
    else:
        verdict = Change.CANNOT_TELL if Change.CANNOT_TELL in verdicts else Change.SAME
    return Difference(
        first=first.name,
        second=second.name,
        values=values,
        sigmas=sigmas,
        visible=visible,
        verdicts=verdicts,
        verdict=verdict,
        chi2=distance,
    )


def _axis_verdict(ratio: float, would_be_seen: bool) -> Change:
    if ratio > LARGEST_OF_SIX:
        return Change.MOVED
    return Change.SAME if would_be_seen else Change.CANNOT_TELL


def _with_installed(
    stated: Sequence[_Stated], installed: _Stated, limits: FloatArray
) -> Comparison:
    differences = tuple(_difference(installed, each, limits) for each in stated)
    moved = tuple(each.second for each in differences if each.verdict is Change.MOVED)
    if len(differences) == 1:
        sentence = differences[0].sentence
    elif moved:
        sentence = f"moved: {listing(moved)} of {len(stated)}"
    else:
        sentence = f"{_overall(differences).value}: none of {len(stated)} differs"
    return Comparison(
        differences=differences, moved=moved, verdict=_overall(differences), sentence=sentence
    )


def _overall(differences: Sequence[Difference]) -> Change:
    verdicts = [each.verdict for each in differences]
    for graver in (Change.MOVED, Change.CANNOT_TELL):
        if graver in verdicts:
            return graver
    return Change.SAME


def _among_each_other(stated: Sequence[_Stated], limits: FloatArray) -> Comparison:
    """Each with each; and whose removal lets the others agree."""
    differences = tuple(
        _difference(first, second, limits) for first, second in itertools.combinations(stated, 2)
    )
    verdict = _overall(differences)
    moved = _who_moved(stated, differences) if verdict is Change.MOVED else ()
    if verdict is not Change.MOVED:
        sentence = f"{verdict.value}: none of {len(stated)} differs from another"
    elif not moved:
        pairs = [f"{d.first} and {d.second}" for d in differences if d.verdict is Change.MOVED]
        sentence = f"moved: {listing(pairs)} differ; which of them has moved, they do not tell"
    elif len(moved) == 1:
        sentence = f"moved: {moved[0]} differs, the others agree"
    else:
        sentence = f"moved between {_before(stated, moved)} and {moved[0]}: {listing(moved)}"
    return Comparison(differences=differences, moved=moved, verdict=verdict, sentence=sentence)


def _before(stated: Sequence[_Stated], moved: Sequence[str]) -> str:
    names = [each.name for each in stated]
    return names[names.index(moved[0]) - 1]


def _who_moved(stated: Sequence[_Stated], differences: Sequence[Difference]) -> tuple[str, ...]:
    """The one without which the others agree; or those from some recording on, if those before
    agree and those from there on agree. Empty if neither, or more than one, is possible.
    """
    apart = {(d.first, d.second) for d in differences if d.verdict is Change.MOVED}

    def agree(names: Sequence[str]) -> bool:
        return not any(first in names and second in names for first, second in apart)

    names = [each.name for each in stated]
    if len(names) < 3:
        return ()
    singles = [name for name in names if agree([other for other in names if other != name])]
    if len(singles) == 1:
        return tuple(singles)
    splits = [k for k in range(2, len(names) - 1) if agree(names[:k]) and agree(names[k:])]
    return tuple(names[splits[0] :]) if not singles and len(splits) == 1 else ()


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
