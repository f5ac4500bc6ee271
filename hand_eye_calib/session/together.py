"""Several recordings: one extrinsic from those of one rig, and a row of a table for each of many.
Comparison: of a result with what is installed, or of results with each other.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, count
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.change import UNKNOWN, Change, moved
from hand_eye_calib.assessment.covariance import combined
from hand_eye_calib.assessment.moved import scatter_of_recordings
from hand_eye_calib.engine.offline import calibrate
from hand_eye_calib.errors import HandEyeCalibError, InputError, located
from hand_eye_calib.geometry.frames import Extrinsic
from hand_eye_calib.geometry.se3 import deviation, turned, xyz_rpy
from hand_eye_calib.geometry.trajectory import TrajectoryLike
from hand_eye_calib.plain import Document
from hand_eye_calib.results.calibration import Calibration, Verdict, data_frame
from hand_eye_calib.results.context import Comparison, Difference, Recorded, Together
from hand_eye_calib.results.records import AXES, DofVerdict, SolveStatus
from hand_eye_calib.results.verdict import target_of
from hand_eye_calib.session.agreement import Agreement, agreement_of, unknown_directions
from hand_eye_calib.text import listing

if TYPE_CHECKING:
    import pandas as pd

_Pair: TypeAlias = tuple[TrajectoryLike, TrajectoryLike]
_Recordings: TypeAlias = Iterable[_Pair] | Mapping[str, _Pair]

# Values of a result that are in its row as they are.
_TAKEN = (
    *("verdict", "headline", "status", "parent_frame", "child_frame"),
    *("method", "reference", "n_poses", "n_pairs", "n_inliers"),
    *("time_offset_s", "time_offset_sigma_s", "scale", "scale_sigma"),
)

# What is that of all recordings together, and that of the newest of them.
_COUNTS = ("n_poses", "n_pairs", "n_inliers")
_OF_NEWEST = (
    *("reference", "backend", "measured", "stamp_ns", "parent_frame", "child_frame"),
    *("base_frame", "T_base_parent", "target_translation", "target_rotation", "target_axes"),
)


def calibrate_together(
    recordings: _Recordings,
    names: Sequence[str] | None = None,
    **options: Any,
) -> Calibration:
    """Estimate one extrinsic from several recordings of one rig.

    Each recording is calibrated by itself, with a clock offset and a scale of its own. What they
    say is added, with the scatter between recordings: an axis that one does not reveal comes from
    another, and a recording that does not belong to the others is named and left out.

    Parameters
    ----------
    recordings : iterable of (Trajectory, Trajectory), or of what can be read as one
        Poses of parent and child in each; or a mapping of names to these.
    names : sequence of str, optional
        What to call the recordings; numbered by default.
    **options
        Those of :func:`~hand_eye_calib.engine.offline.calibrate`.

    Returns
    -------
    Calibration
        With :attr:`~Calibration.together`: each recording's own result, and the scatter.

    Raises
    ------
    InputError
        If no recording can be used, or they are of different frames.
    HandEyeCalibError
        As ``calibrate`` does, with the name of the recording.

    Examples
    --------
    >>> found = hec.calibrate_together([(parent[:300], child), (parent[300:], child)])
    >>> len(found.together.recordings)
    2
    """
    results: dict[str, Calibration] = {}
    for name, pair in _named(recordings, names):
        with located(name):
            results[name] = calibrate(*pair, **options)
    return together(results)


def calibrate_many(
    recordings: _Recordings,
    names: Sequence[str] | None = None,
    **options: Any,
) -> "pd.DataFrame":
    """Calibrate many recordings, each by itself, one after the other.

    Parameters
    ----------
    recordings, names, **options
        As of :func:`calibrate_together`.

    Returns
    -------
    pandas.DataFrame
        A row for each recording by its name: verdict, headline, x, y and z (m), roll, pitch and yaw
        (deg), their standard deviations, whether each is observed; an ``error`` if it failed.

    Raises
    ------
    MissingDependencyError
        Without pandas.

    Examples
    --------
    >>> table = hec.calibrate_many([(parent, child)], ["monday"], checks=False)
    >>> "headline" in table.columns
    True
    """
    rows = []
    for name, pair in _named(recordings, names):
        try:
            row = row_of_result(calibrate(*pair, **options).to_dict()) | {"error": None}
        except HandEyeCalibError as error:
            row = {"error": str(error)}
        rows.append({"name": name, **row})
    return data_frame(rows, "name")


def _named(recordings: _Recordings, names: Sequence[str] | None) -> Iterable[tuple[str, _Pair]]:
    """Each recording with its name."""
    if isinstance(recordings, Mapping):
        names, recordings = [*recordings], recordings.values()
    pairs = [*recordings]
    if not all(isinstance(pair, Sequence) and len(pair) == 2 for pair in pairs):
        raise InputError("each recording must be a pair of parent and child: [(parent, child)]")
    if names is not None and len(set(names)) < len(pairs):
        raise InputError(f"expected {len(pairs)} different names, found {', '.join(names)}")
    return zip(names or map(str, count(1)), pairs, strict=False)


def row_of_result(calibration: Document) -> Document:
    """The row of a result, from what its ``to_dict`` gave; what is not known is None."""
    transform = calibration["T_parent_child"]
    row = {name: calibration[name] for name in _TAKEN}
    row["verdict"] = str(calibration["verdict"]).replace("_", " ")
    columns = [f"{axis}_m" for axis in AXES[:3]] + [f"{axis}_deg" for axis in AXES[3:]]
    values = [*transform["translation"], *transform["rpy_deg"]]
    sigmas = [*transform["sigma_translation"], *transform["sigma_rpy_deg"]]
    for column, value, sigma in zip(columns, values, sigmas, strict=True):
        row |= {column: value, f"sigma_{column}": sigma}
    return row | {f"{dof['name']}_is": dof["verdict"] for dof in calibration["observability"]}


def together(results: Mapping[str, Calibration]) -> Calibration:
    """One result from the results of recordings of one rig, by the names of those.

    Method, frames and targets are those of the recordings. So are the clock offset and the scale if
    all have the same; otherwise each has its own.

    Raises
    ------
    InputError
        If no recording can be used, or they are of different frames.
    """
    results = dict(sorted(results.items(), key=lambda one: one[1].stamp_ns))
    require_same_frames(results.values())
    unfit = {name: each.headline for name, each in results.items() if _says_nothing(each)}
    fit = {name: each for name, each in results.items() if name not in unfit}
    if not fit:
        told = "; ".join(f"{name}: {why}" for name, why in unfit.items())
        raise InputError(f"no recording can be used: {told or 'there is none'}")
    found = agreement_of_results([*fit.values()])
    names, unknown = [*fit], dict.fromkeys(results, np.full((2, 6), np.nan))
    unfit |= {names[index]: "it does not belong to the others" for index in found.apart}
    used = [each for name, each in fit.items() if name not in unfit]
    pairs = np.stack([found.deviations, found.sigmas], axis=1)
    beside = unknown | dict(zip(names, pairs, strict=True))
    records = tuple(
        Recorded(
            name=name,
            headline=each.headline,
            left_out=unfit.get(name, ""),
            deviations=_by_axis(beside[name][0]),
            sigmas=_by_axis(beside[name][1]),
            time_offset_s=each.time_offset_s,
            scale=each.scale,
            stamp_ns=each.stamp_ns,
        )
        for name, each in results.items()
    )
    record = Together(
        kind=found.kind,
        sentence=found.sentence(names),
        scatter=_by_axis(found.scatter),
        recordings=records,
    )
    return _joint(used, found, record)


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


def _says_nothing(result: Calibration) -> bool:
    """Whether a result is DO NOT USE for more than axes that are unknown."""
    never = {each.rule for each in result.reasons if each.verdict is Verdict.DO_NOT_USE}
    return bool(never - {"nothing_known"})


def _by_axis(values: FloatArray) -> dict[str, float]:
    return dict(zip(AXES, values.tolist(), strict=True))


def _joint(used: Sequence[Calibration], found: Agreement, record: Together) -> Calibration:
    """The result of recordings that belong together."""
    T = found.T_parent_child
    covariance, by_prior = found.covariance.copy(), set()
    for axis, name in enumerate(AXES):
        dofs = [one.observability_measured[axis] for one in used]
        known = [dof for dof in dofs if math.isfinite(dof.sigma)]
        if known and all(dof.verdict is DofVerdict.PRIOR for dof in known):
            # All have it from one measurement by hand.
            by_prior.add(name)
            least = min(dof.sigma for dof in known)
            covariance[axis, axis] = max(covariance[axis, axis], least**2)
    covariance = turned(T[:3, :3].T, covariance)
    assessed = combined(T, covariance, None, unknown_directions(covariance))
    observability = tuple(
        replace(dof, verdict=DofVerdict.PRIOR) if dof.name in by_prior else dof
        for dof in assessed.observability
    )
    is_open = any(math.isinf(dof.sigma) for dof in observability)
    newest = used[-1]
    own_clock = {(one.time_offset_s, one.scale) for one in used}
    offset_s, scale = own_clock.pop() if len(own_clock) == 1 else (0.0, 1.0)
    return Calibration(
        T_parent_child=T,
        covariance_measured=assessed.cov_parent_child_in_child,
        covariance_allowance=np.mean([one.covariance_allowance for one in used], axis=0),
        observability_measured=observability,
        status=SolveStatus.UNOBSERVABLE if is_open else SolveStatus.OK,
        objective=found.chi2,
        method=Counter(one.method for one in used).most_common(1)[0][0],
        time_offset_s=offset_s,
        scale=scale,
        findings=tuple({each.code: each for one in used for each in one.findings}.values()),
        together=record,
        **{name: sum(getattr(one, name) for one in used) for name in _COUNTS},
        **{name: getattr(newest, name) for name in _OF_NEWEST},
    )


# ---- has the mount moved?

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
    values = _by_axis(xyz_rpy(installed.T_parent_child))
    found = compare([result], installed, ["result"])
    return replace(result, comparison=replace(found, installed=origin, values=values))


def _difference(first: _Named, second: tuple[str, Calibration]) -> Difference:
    (first_name, one), (second_name, two) = first, second
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
    covariance, allowance = np.diag(UNKNOWN**2), np.zeros((6, 6))
    measured = given.covariance_measured if isinstance(given, Calibration) else given.covariance
    if np.isfinite(measured).all():
        covariance = turned(rotation, measured)
    if isinstance(given, Calibration):
        hidden = [dof.verdict is DofVerdict.UNOBSERVABLE for dof in given.observability]
        covariance = covariance + np.diag(np.where(hidden, UNKNOWN**2, 0.0))
        allowance = turned(rotation, given.covariance_allowance)
    scatter = scatter_of_recordings(covariance) if _is_found(given) else np.zeros((6, 6))
    return np.array([covariance, scatter, allowance])
