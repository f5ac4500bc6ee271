"""Rows of the coverage study: results of calibrations, compared with true or repeated values."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.errors import HandEyeCalibError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import absolute_errors, deviation
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import (
    Calibration,
    DofVerdict,
    SolveStatus,
)
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.offline.calibrate import calibrate
from reproduction.coverage import classes
from reproduction.coverage.measures import COVERAGE, Row
from reproduction.published import load_simulated, path_to
from reproduction.recordings import CYCLE, PARTS, Rig, Truth

# Half the width of an interval, in standard deviations.
_REACH = float(norm.isf((1.0 - COVERAGE) / 2.0))

_KNOWN = (DofVerdict.OBSERVED, DofVerdict.WEAK)

METHODS = {
    "auto": {"method": "auto"},
    "dnlo": {"method": "dnlo", "reference": "auto"},
}


def answer(
    parent: Trajectory, child: Trajectory, options: Mapping[str, Any]
) -> Calibration | None:
    """Calibrate; return None if the calibration fails."""
    try:
        return calibrate(parent, child, **options)
    except HandEyeCalibError:
        return None


def _of_rig(rig: Rig, name: str, method: str) -> Calibration | None:
    """Calibrate a recording of a rig."""
    recording = rig.recordings[name]
    return answer(
        recording.parent, recording.child, {**rig.options, **METHODS[method]}
    )


def _name_of(rig: Rig, name: str) -> str:
    return f"{rig.name} {name}".removesuffix(" whole")


def _row(
    table: str, name: str, method: str, cases: Mapping[str, Mapping[str, float]]
) -> Row:
    """Return a row from the measures of each case."""
    by_kind: dict[str, dict[str, float]] = {}
    for case, measures in cases.items():
        for kind, value in measures.items():
            by_kind.setdefault(kind, {})[case] = value
    return Row(table, name, method, by_kind)


def class_row(name: str, method: str, seeds: range) -> Row:
    """Measure errors over the bound, NEES and coverage of a simulated class."""
    cases = {}
    for seed in seeds:
        recording = classes.make(name, seed)
        result = answer(recording.parent, recording.child, METHODS[method])
        cases[f"{seed}"] = _class_case(name, recording, result)
    return _row("simulated", name, method, cases)


def _class_case(
    name: str, recording: classes.Simulated, result: Calibration | None
) -> dict[str, float]:
    if name in classes.REFUSED:
        return {"refused": float(result is None or bool(result.unobservable()))}
    if result is None:
        return {}
    xi = se3.log(se3.inverse(result.T_parent_child) @ recording.T_parent_child)
    bound = recording.bound()
    case = {
        "bound": _squared(xi, bound),
        "bound_t": _squared(xi[:3], bound[:3, :3]),
        "bound_r": _squared(xi[3:], bound[3:, 3:]),
    }
    if np.isfinite(result.covariance_measured).all():
        case["nees"] = _squared(xi, result.covariance_measured)
    return case | _covers(xi, result)


def _covers(xi: FloatArray, result: Calibration) -> dict[str, float]:
    """Return the share of components of xi in their intervals; empty without intervals."""
    covariance = result.covariance_measured
    if not np.isfinite(covariance).all():
        return {}
    sigmas = np.sqrt(np.diag(covariance))
    is_within = np.abs(xi) < _REACH * sigmas
    return {"covers": float(is_within.mean())}


def level_row(
    folder: Path, dataset: str, level: float | None, method: str
) -> Row:
    """Measure errors on the published trajectories of a level."""
    levels = None if level is None else [level]
    cases = {}
    for case in load_simulated(folder, [dataset], levels):
        result = answer(case.parent, case.child, METHODS[method])
        if result is None:
            continue
        T_true = case.T_parent_child
        xi = se3.log(se3.inverse(result.T_parent_child) @ T_true)
        e_at, e_aR = absolute_errors(result.T_parent_child, T_true)
        sizes = {"mm": 1e3 * e_at, "deg": float(np.degrees(e_aR))}
        cases[case.name] = sizes | _covers(xi, result)
    return _row("levels", " ".join(path_to(dataset, level)), method, cases)


def _squared(xi: FloatArray, covariance: FloatArray) -> float:
    weighted = np.linalg.solve(covariance, xi)
    return float(xi @ weighted)


def truth_row(rig: Rig, name: str, method: str) -> Row:
    """Measure the error of a real recording against its known extrinsic."""
    assert rig.truth is not None
    result = _of_rig(rig, name, method)
    cases = {}
    if result is not None:
        cases = truth_cases(result, rig.truth)
    return Row("known answer", _name_of(rig, name), method, cases)


def truth_cases(
    result: Calibration, truth: Truth
) -> dict[str, dict[str, float]]:
    """Return the error of a result, and whether its intervals contain the true values.

    Only axes that the truth and the motion determine are compared. The intervals of ``covers`` are
    without the common-mode floor, those of ``covers_floor`` with the floor. The intervals of
    ``covers_truth`` are without the floor, but with the uncertainty of the truth.
    """
    is_comparable = np.isfinite(truth.sigmas) & _knows(result)
    error = deviation(result.T_parent_child, truth.T_parent_child)
    # If the truth lacks a rotation axis, the whole rotation may differ much, so the angles are
    # compared one by one.
    if not np.isfinite(truth.sigmas[3:]).all():
        error[3:] = _angle_differences(
            result.T_parent_child, truth.T_parent_child
        )

    sigmas = np.where(is_comparable, result.sigmas_measured, 1.0)
    sigmas_with_floor = np.where(is_comparable, result.sigmas, 1.0)
    sigmas_of_truth = np.where(is_comparable, truth.sigmas, 0.0)
    sigmas_of_both = np.hypot(sigmas, sigmas_of_truth)
    size = np.where(is_comparable, np.abs(error), 0.0)

    def covers(limits: FloatArray) -> dict[str, float]:
        return _by_axis(size < _REACH * limits, is_comparable)

    metres = float(np.linalg.norm(size[:3]))
    radians = np.linalg.norm(size[3:])
    cases = {
        "mm": {"": 1e3 * metres},
        "z": {"": float(np.max(size / sigmas))},
        "covers": covers(sigmas),
        "covers_floor": covers(sigmas_with_floor),
        "covers_truth": covers(sigmas_of_both),
    }
    if is_comparable[3:].any():
        cases["deg"] = {"": float(np.degrees(radians))}
    return cases


def _angle_differences(T: FloatArray, T_truth: FloatArray) -> FloatArray:
    """Return the differences (3,) of roll, pitch and yaw, rad."""
    rpy = se3.rotation_to_rpy(T[:3, :3])
    true_rpy = se3.rotation_to_rpy(T_truth[:3, :3])
    differences = rpy - true_rpy
    return (differences + np.pi) % (2.0 * np.pi) - np.pi


def _knows(result: Calibration) -> BoolArray:
    return np.array([dof.verdict in _KNOWN for dof in result.observability])


def _by_axis(values: BoolArray, is_comparable: BoolArray) -> dict[str, float]:
    by_axis = {}
    for axis, value, is_used in zip(AXES, values, is_comparable, strict=True):
        if is_used:
            by_axis[axis] = float(value)
    return by_axis


def refused_row(rig: Rig, name: str, method: str) -> Row:
    """Measure whether a recording with an undetermined axis is refused: no result, or not OK."""
    result = _of_rig(rig, name, method)
    is_refused = result is None or result.status is not SolveStatus.OK
    cases = {"refused": {"": float(is_refused)}}
    return Row("refused", _name_of(rig, name), method, cases)


def scatter_row(rig: Rig, method: str) -> Row:
    """Measure the scatter between the recordings of a rig, over their stated sigmas."""
    answers = [_of_rig(rig, name, method) for name in rig.recordings]
    return Row("rig", rig.name, method, {"scatter": _scatter_cases(answers)})


def parts_row(rig: Rig, name: str, method: str) -> Row:
    """Measure the scatter of halves and of thirds of a recording, over their stated sigmas."""
    whole = _of_rig(rig, name, method)
    cases: dict[str, float] = {}
    if whole is None:
        return Row("parts", _name_of(rig, name), method, {"scatter": cases})
    options = {**rig.options, **METHODS[method]}
    for count, label in PARTS.items():
        answers = []
        for part in rig.recordings[name].parts(count, whole.time_offset_s):
            answers.append(answer(part.parent, part.child, options))
        for key, value in _scatter_cases(answers).items():
            cases[f"{label} {key}"] = value
    return Row("parts", _name_of(rig, name), method, {"scatter": cases})


def _scatter_cases(answers: Sequence[Calibration | None]) -> dict[str, float]:
    """Return, by axis, the variance of the answers divided by their mean stated variance.

    Axes that an answer does not observe are left out. N answers have N - 1 degrees of freedom, so
    the ratio of an axis has N - 1 entries, numbered from 0.
    """
    results = [result for result in answers if result is not None]
    if len(results) < len(answers) or len(results) < 2:
        return {}
    is_observed = np.logical_and.reduce([_knows(result) for result in results])
    sigmas = np.array([result.sigmas_measured for result in results])
    variances = np.where(is_observed, sigmas, 1.0) ** 2
    first = results[0].T_parent_child
    deviations = np.array(
        [deviation(result.T_parent_child, first) for result in results]
    )
    ratios = deviations.var(axis=0, ddof=1) / variances.mean(axis=0)
    ratio_of_axis = dict(zip(AXES, ratios.tolist(), strict=True))
    observed_axes = [
        axis for axis, is_used in zip(AXES, is_observed, strict=True) if is_used
    ]
    degrees_of_freedom = range(len(results) - 1)
    return {
        f"{axis}/{number}": ratio_of_axis[axis]
        for axis in observed_axes
        for number in degrees_of_freedom
    }


def cycle_row(rigs: Mapping[str, Rig], method: str) -> Row:
    """Measure the misclosure of three pairwise extrinsics, and its chi-square."""
    results = [_of_rig(rigs[name], "whole", method) for name in CYCLE]
    good = [result for result in results if result is not None]
    if len(good) < len(results):
        return Row("cycle", "tango", method, {})
    xi, covariance = misclosure(good)
    metres = float(np.linalg.norm(xi[:3]))
    radians = float(np.linalg.norm(xi[3:]))
    cases = {
        "mm": {"": 1e3 * metres},
        "deg": {"": float(np.degrees(radians))},
        "chi2": {"": _squared(xi, covariance)},
    }
    return Row("cycle", "tango", method, cases)


def misclosure(answers: list[Calibration]) -> tuple[FloatArray, FloatArray]:
    """Return the error (6,) of a closed chain of extrinsics, and its covariance (6, 6).

    The chain leads from the first parent to the last child, which are the same sensor. Error and
    covariance are in the frame of the last child. The lengths of each extrinsic are multiplied by
    the scales of the extrinsics before, so that all lengths are in the unit of the first parent.
    """
    closed = np.eye(4)
    covariance = np.zeros((6, 6))
    scale = 1.0
    for result in answers:
        T = result.T_parent_child.copy()
        T[:3, 3] *= scale
        stretch = np.repeat([scale, 1.0], 3)
        moved = se3.adjoint(se3.inverse(T))
        covariance = moved @ covariance @ moved.T
        covariance += result.covariance_measured * np.outer(stretch, stretch)
        closed = closed @ T
        scale *= result.scale
    return se3.log(closed), covariance
