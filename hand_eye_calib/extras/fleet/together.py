"""Several recordings: one extrinsic from those of one rig; a row of a table for each of many."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from hand_eye_calib.core.assessment.agreement import Agreement, unknown_directions
from hand_eye_calib.core.assessment.comparison import (
    agreement_of_results,
    by_axis,
    require_same_frames,
)
from hand_eye_calib.core.assessment.covariance import combined
from hand_eye_calib.core.base.errors import HandEyeCalibError, InputError, located
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.geometry.se3 import turned
from hand_eye_calib.core.geometry.trajectory import TrajectoryLike
from hand_eye_calib.core.results.calibration import Calibration, Verdict, data_frame
from hand_eye_calib.core.results.records import AXES, DofVerdict, SolveStatus
from hand_eye_calib.extras.fleet.records import Recorded, Together
from hand_eye_calib.offline.calibrate import calibrate

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
        Those of :func:`~hand_eye_calib.offline.calibrate.calibrate`.

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
        names = [*recordings]
        recordings = recordings.values()
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
    names = [*fit]
    unknown = dict.fromkeys(results, np.full((2, 6), np.nan))
    unfit |= {names[index]: "it does not belong to the others" for index in found.apart}
    used = [each for name, each in fit.items() if name not in unfit]
    pairs = np.stack([found.deviations, found.sigmas], axis=1)
    beside = unknown | dict(zip(names, pairs, strict=True))
    records = tuple(
        Recorded(
            name=name,
            headline=each.headline,
            left_out=unfit.get(name, ""),
            deviations=by_axis(beside[name][0]),
            sigmas=by_axis(beside[name][1]),
            time_offset_s=each.time_offset_s,
            scale=each.scale,
            stamp_ns=each.stamp_ns,
        )
        for name, each in results.items()
    )
    record = Together(
        kind=found.kind,
        sentence=found.sentence(names),
        scatter=by_axis(found.scatter),
        recordings=records,
    )
    return _joint(used, found, record)


def _says_nothing(result: Calibration) -> bool:
    """Whether a result is DO NOT USE for more than axes that are unknown."""
    never = {each.rule for each in result.reasons if each.verdict is Verdict.DO_NOT_USE}
    return bool(never - {"nothing_known"})


def _joint(used: Sequence[Calibration], found: Agreement, record: Together) -> Calibration:
    """The result of recordings that belong together."""
    T = found.T_parent_child
    covariance = found.covariance.copy()
    by_prior = set()
    for axis, name in enumerate(AXES):
        dofs = [one.observability_measured[axis] for one in used]
        known = [dof for dof in dofs if math.isfinite(dof.sigma)]
        if known and all(dof.verdict is DofVerdict.PRIOR for dof in known):
            # All have it from one measurement by hand.
            by_prior.add(name)
            least = min(dof.sigma for dof in known)
            covariance[axis, axis] = max(covariance[axis, axis], least**2)
    covariance = turned(T[:3, :3].T, covariance)
    assessed = combined(T, covariance, unknown_directions(covariance))
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
        parts={"together": record},
        **{name: sum(getattr(one, name) for one in used) for name in _COUNTS},
        **{name: getattr(newest, name) for name in _OF_NEWEST},
    )
