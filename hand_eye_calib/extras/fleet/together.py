"""Several recordings: one extrinsic from recordings of one rig, or a table of many results."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from hand_eye_calib.core.assessment.agreement import (
    Agreement,
    unknown_directions,
)
from hand_eye_calib.core.assessment.comparison import (
    agreement_of_results,
    by_axis,
    require_same_frames,
)
from hand_eye_calib.core.assessment.covariance import Assessment, combined
from hand_eye_calib.core.base.errors import (
    HandEyeCalibError,
    InputError,
    located,
    require_type,
)
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import turned
from hand_eye_calib.core.geometry.trajectory import TrajectoryLike
from hand_eye_calib.core.results.calibration import (
    Calibration,
    Verdict,
    data_frame,
)
from hand_eye_calib.core.results.records import (
    AXES,
    DofVerdict,
    Finding,
    SolveStatus,
    gravest_first,
)
from hand_eye_calib.extras.fleet.records import Recorded, Together
from hand_eye_calib.offline.calibrate import calibrate

if TYPE_CHECKING:
    import pandas as pd

_Pair: TypeAlias = tuple[TrajectoryLike, TrajectoryLike]
_Recordings: TypeAlias = Iterable[_Pair] | Mapping[str, _Pair]

# Fields of a result in its row of the table.
_FIELDS_OF_ROW = (
    "verdict",
    "headline",
    "status",
    "parent_frame",
    "child_frame",
    "method",
    "reference",
    "n_poses",
    "n_pairs",
    "n_inliers",
    "time_offset_s",
    "time_offset_sigma_s",
    "scale",
    "scale_sigma",
)

# Fields of the common result that are sums over the recordings.
_COUNTS = ("n_poses", "n_pairs", "n_inliers")

# Fields of the common result that are taken from the newest recording.
_OF_NEWEST = (
    "reference",
    "backend",
    "measured",
    "exact_streams",
    "stamp_ns",
    "parent_frame",
    "child_frame",
    "base_frame",
    "T_base_parent",
    "target_translation",
    "target_rotation",
    "target_axes",
)


def calibrate_together(
    recordings: _Recordings,
    names: Sequence[str] | None = None,
    **options: Any,
) -> Calibration:
    """Estimate one extrinsic from several recordings of one rig.

    Each recording is calibrated separately, with its own clock offset and scale. The mean of the
    results is weighted by their covariances and by the scatter between recordings. An axis that a
    recording does not determine comes from the others. A recording that contradicts the others is
    named and left out.

    Parameters
    ----------
    recordings : iterable of (Trajectory, Trajectory), or mapping of names to such pairs
        Poses of parent and child of each recording: trajectories, or sources of
        :func:`~hand_eye_calib.read_trajectory`.
    names : sequence of str, optional
        Names of the recordings; numbers by default.
    **options
        Options of :func:`~hand_eye_calib.offline.calibrate.calibrate`.

    Returns
    -------
    Calibration
        Its part :attr:`~Calibration.together` has the result of each recording, and the scatter.

    Raises
    ------
    InputError
        If no recording is usable, or the recordings have different frames.
    HandEyeCalibError
        Errors of ``calibrate``, with the name of the recording.

    Examples
    --------
    >>> result = hec.calibrate_together([(parent[:300], child), (parent[300:], child)])
    >>> len(result.together.recordings)
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
    """Calibrate many recordings separately, one after the other.

    Parameters
    ----------
    recordings, names, **options
        As for :func:`calibrate_together`.

    Returns
    -------
    pandas.DataFrame
        A row for each recording by its name: verdict, headline, x, y and z (m), roll, pitch and yaw
        (deg), their standard deviations, and whether each axis is observed. A recording that failed
        has an ``error``.

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
            row = row_of_result(calibrate(*pair, **options).to_dict()) | {
                "error": None
            }
        except HandEyeCalibError as error:
            row = {"error": str(error)}
        rows.append({"name": name, **row})
    return data_frame(rows, "name")


def _named(
    recordings: _Recordings, names: Sequence[str] | None
) -> Iterable[tuple[str, _Pair]]:
    """Return the names and the pairs of all recordings, after checks."""
    if isinstance(recordings, Mapping):
        names = [*recordings]
        recordings = recordings.values()
    require_type("recordings", recordings, Iterable)
    pairs = [*recordings]
    if not all(isinstance(pair, Sequence) and len(pair) == 2 for pair in pairs):
        raise InputError(
            "each recording must be a pair of parent and child: [(parent, child)]"
        )
    if names is not None and len(set(names)) < len(pairs):
        raise InputError(
            f"expected {len(pairs)} different names, found {', '.join(names)}"
        )
    return zip(names or map(str, count(1)), pairs, strict=False)


def row_of_result(calibration: Document) -> Document:
    """Return the row of a result from its document; unknown values are None."""
    transform = calibration["T_parent_child"]
    row = {name: calibration[name] for name in _FIELDS_OF_ROW}
    row["verdict"] = str(calibration["verdict"]).replace("_", " ")
    columns = [f"{axis}_m" for axis in AXES[:3]] + [
        f"{axis}_deg" for axis in AXES[3:]
    ]
    values = [*transform["translation"], *transform["rpy_deg"]]
    sigmas = [*transform["sigma_translation"], *transform["sigma_rpy_deg"]]
    for column, value, sigma in zip(columns, values, sigmas, strict=True):
        row |= {column: value, f"sigma_{column}": sigma}
    return row | {
        f"{dof['name']}_is": dof["verdict"]
        for dof in calibration["observability"]
    }


def together(results: Mapping[str, Calibration]) -> Calibration:
    """Return one result from the results of recordings of one rig.

    Parameters
    ----------
    results : mapping of str to Calibration
        Results by recording. The common result has the most frequent method, and the frames and
        targets of the newest recording. It has a clock offset and a scale only if all recordings
        have equal values.

    Raises
    ------
    InputError
        If no recording is usable, or the recordings have different frames.
    """
    results = dict(sorted(results.items(), key=lambda item: item[1].stamp_ns))
    require_same_frames(results.values())
    left_out = {
        name: result.headline
        for name, result in results.items()
        if _is_unusable(result)
    }
    usable = {
        name: result for name, result in results.items() if name not in left_out
    }
    if not usable:
        raise _nothing_usable(left_out)
    agreement = agreement_of_results([*usable.values()])
    names = [*usable]
    for index in agreement.apart:
        left_out[names[index]] = "its result disagrees with the others"
    used = {
        name: result for name, result in usable.items() if name not in left_out
    }
    record = Together(
        kind=agreement.kind,
        sentence=agreement.sentence(names),
        scatter=by_axis(agreement.scatter),
        recordings=_records_of(results, left_out, names, agreement),
    )
    return _joint(used, agreement, record)


def _nothing_usable(left_out: Mapping[str, str]) -> InputError:
    """Return the error that no recording is usable, with the reason for each recording."""
    reasons = "; ".join(
        f"{name}: {reason}" for name, reason in left_out.items()
    )
    return InputError(f"no recording can be used: {reasons or 'there is none'}")


def _records_of(
    results: Mapping[str, Calibration],
    left_out: Mapping[str, str],
    compared: Sequence[str],
    agreement: Agreement,
) -> tuple[Recorded, ...]:
    """Return a record of each recording.

    Parameters
    ----------
    results : mapping of str to Calibration
    left_out : mapping of str to str
        Reasons why recordings are left out.
    compared : sequence of str
        Names of the recordings in ``agreement``. Unusable recordings are not compared.
    agreement : Agreement
    """
    unknown = np.full(6, np.nan)
    deviations = dict.fromkeys(results, unknown)
    deviations |= dict(zip(compared, agreement.deviations, strict=True))
    sigmas = dict.fromkeys(results, unknown)
    sigmas |= dict(zip(compared, agreement.sigmas, strict=True))
    records = []
    for name, result in results.items():
        recorded = Recorded(
            name=name,
            headline=result.headline,
            left_out=left_out.get(name, ""),
            deviations=by_axis(deviations[name]),
            sigmas=by_axis(sigmas[name]),
            time_offset_s=result.time_offset_s,
            scale=result.scale,
            stamp_ns=result.stamp_ns,
        )
        records.append(recorded)
    return tuple(records)


def _is_unusable(result: Calibration) -> bool:
    """Return whether the verdict is DO NOT USE for a reason other than unknown axes."""
    rules = {
        reason.rule
        for reason in result.reasons
        if reason.verdict is Verdict.DO_NOT_USE
    }
    return bool(rules - {"nothing_known"})


def _warnings_of(recordings: Mapping[str, Calibration]) -> tuple[str, ...]:
    """Return the different warnings, with their recordings unless all recordings have them."""
    names: dict[str, list[str]] = {}
    for name, result in recordings.items():
        for warning in result.warnings:
            names.setdefault(warning, []).append(name)
    warnings = []
    for warning, of_warning in names.items():
        is_common = len(of_warning) == len(recordings)
        warnings.append(
            warning if is_common else f"{listing(of_warning)}: {warning}"
        )
    return tuple(warnings)


def _joint(
    recordings: Mapping[str, Calibration],
    agreement: Agreement,
    record: Together,
) -> Calibration:
    """Return the common result of recordings that agree, sorted by time."""
    used = [*recordings.values()]
    assessed = _assessed(used, agreement)
    is_open = any(math.isinf(dof.sigma) for dof in assessed.observability)
    newest = used[-1]
    methods = Counter(result.method for result in used)
    most_frequent_method, _ = methods.most_common(1)[0]
    clocks = {(result.time_offset_s, result.scale) for result in used}
    offset_s, scale = clocks.pop() if len(clocks) == 1 else (0.0, 1.0)
    allowances = [result.covariance_allowance for result in used]
    counts = {
        name: sum(getattr(result, name) for result in used) for name in _COUNTS
    }
    of_newest = {name: getattr(newest, name) for name in _OF_NEWEST}
    return Calibration(
        T_parent_child=agreement.T_parent_child,
        covariance_measured=assessed.cov_parent_child_in_child,
        covariance_allowance=np.mean(allowances, axis=0),
        observability_measured=assessed.observability,
        status=SolveStatus.UNOBSERVABLE if is_open else SolveStatus.OK,
        objective=agreement.chi2,
        method=most_frequent_method,
        time_offset_s=offset_s,
        scale=scale,
        findings=_gravest_of_each(used),
        warnings=_warnings_of(recordings),
        parts={"together": record},
        **counts,
        **of_newest,
    )


def _assessed(used: Sequence[Calibration], agreement: Agreement) -> Assessment:
    """Assess the common result of recordings.

    If an axis is from a prior in all recordings, they share one measurement by hand. The standard
    deviation of the axis is then at least the smallest among the recordings.
    """
    T = agreement.T_parent_child
    covariance = agreement.covariance.copy()
    by_prior = set()
    for axis, name in enumerate(AXES):
        dofs = [result.observability_measured[axis] for result in used]
        finite = [dof for dof in dofs if math.isfinite(dof.sigma)]
        if finite and all(dof.verdict is DofVerdict.PRIOR for dof in finite):
            by_prior.add(name)
            variance = min(dof.sigma for dof in finite) ** 2
            covariance[axis, axis] = max(covariance[axis, axis], variance)
    covariance = turned(se3.rotation_of(T).T, covariance)
    assessed = combined(T, covariance, unknown_directions(covariance))
    observability = tuple(
        replace(dof, verdict=DofVerdict.PRIOR) if dof.name in by_prior else dof
        for dof in assessed.observability
    )
    return replace(assessed, observability=observability)


def _gravest_of_each(used: Sequence[Calibration]) -> tuple[Finding, ...]:
    """Return the gravest finding for each code and stream."""
    all_findings: list[Finding] = []
    for result in used:
        all_findings += result.findings
    gravest: dict[tuple[str, str], Finding] = {}
    for finding in gravest_first(all_findings):
        gravest.setdefault((finding.code, finding.stream), finding)
    return tuple(gravest.values())
