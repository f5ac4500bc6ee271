"""A result in plain values: its document in JSON and YAML, both ways, and the numbers that other
programs read.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import METHODS
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.plain import Document, from_plain, plain
from hand_eye_calib.core.base.text import amount, fixed, given_or_estimated, listing, with_sigma
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import inverse_covariance, sigmas_in_parent, sigmas_rpy
from hand_eye_calib.core.geometry.trajectory import check_poses
from hand_eye_calib.core.results.parts import ExtraTransform, all_parts, part
from hand_eye_calib.core.results.records import (
    AXES,
    ROTATIONS,
    TRANSLATIONS,
    CrossCheck,
    Finding,
    by_hand,
)
from hand_eye_calib.core.results.result import Result
from hand_eye_calib.core.results.verdict import Judged, Verdict

# A change that an older reader cannot understand raises the version. In version 1, covariance and
# sigma were without the allowance, which was called floor.
_FORMAT = "hand_eye_calib/extrinsic"
_VERSION = 2
_READABLE = (1, 2)

# Fields that a document has under other names, as matrices; and those that files do not have.
_TRANSFORMS = ("T_parent_child", "T_method", "T_base_parent")
_COVARIANCES = ("covariance_measured", "covariance_allowance")
_NOT_IN_FILES = ("motion_residuals", "recording", "parts")
# Fields that have readers of their own.
_READ_APART = (*_NOT_IN_FILES, "findings")

# The fields of a covariance in version 2 and what they were called in version 1.
_OLD_COVARIANCES = {"covariance_measured": "covariance", "covariance_allowance": "floor"}

# With a direction unobservable, a larger standard deviation (m) in other axes comes from that.
UNKNOWN_M = 0.9

# An axis with more than this share (a cosine) of an unobservable direction is unknown, too.
_SHARED = 0.02

_OfResult = TypeVar("_OfResult", bound=Result)


@dataclass(frozen=True, kw_only=True)
class Notation:
    """A transform in the notations that people and programs use: ``maps`` names source and target.

    Each printed number, m and deg, has a standard deviation, and the part of it that the recording
    shows: the rest is the allowance. What is unknown is NaN, with an infinite one; an unknown
    rotation has no quaternion.
    """

    maps: str
    translation: FloatArray
    sigma_translation: FloatArray
    sigma_measured_translation: FloatArray
    quat_xyzw: FloatArray | None
    rpy_deg: FloatArray
    sigma_rpy_deg: FloatArray
    sigma_measured_rpy_deg: FloatArray
    matrix: FloatArray


def document_of(result: Judged) -> Document:
    """The document of a result; see ``Calibration.to_dict``."""
    parent = result.parent_frame
    child = result.child_frame
    document: Document = {
        "verdict": result.verdict,
        "headline": result.headline,
        "reasons": result.reasons,
        "format": _FORMAT,
        "version": _VERSION,
        "parent_frame": parent,
        "child_frame": child,
        **transforms_of(result),
        "status": result.status,
        **_covariances_of(result),
        "sigma": dict(zip(AXES, result.sigmas, strict=True)),
        "observability": _observability_of(result),
    }
    if result.T_method is not None:
        of = "T_parent_child as the method solved it: nothing set, no prior added"
        document["T_method"] = {"of": of, "matrix": result.T_method}
    document["findings"] = [finding.to_dict() for finding in result.findings]
    left_out = {*_TRANSFORMS, *_COVARIANCES, *_NOT_IN_FILES, "observability_measured"}
    for name in (each.name for each in fields(result)):
        if name not in left_out.union(document):
            document[name] = getattr(result, name)
    for added in all_parts():
        document |= added.write(result.parts.get(added.name))
    return plain(document)


def _covariances_of(result: Result) -> Document:
    """The covariance of a document, and its two parts."""
    of = "error xi in T_parent_child @ exp(xi)"
    child = result.child_frame
    order = ["rho_x", "rho_y", "rho_z", "phi_x", "phi_y", "phi_z"]
    measured = f"{of}: the part that the recording shows"
    allowance = f"{of}: the allowance for constant errors, which no recording shows"
    return {
        "covariance": matrix_of(of, child, result.covariance) | {"order": order},
        "covariance_measured": matrix_of(measured, child, result.covariance_measured),
        "covariance_allowance": matrix_of(allowance, child, result.covariance_allowance),
    }


def _observability_of(result: Result) -> list[Document]:
    """Rows of a document: each axis with its standard deviation and the two parts of it."""
    parts = zip(result.sigmas_measured, result.allowance, strict=True)
    return [
        plain(dof)
        | {"sigma_measured": measured, "allowance": allowance, "frame": result.parent_frame}
        for dof, (measured, allowance) in zip(result.observability, parts, strict=True)
    ]


def transforms_of(result: Result) -> dict[str, Notation]:
    """The transforms of a result by their names."""
    T = result.T_parent_child
    parent = result.parent_frame
    child = result.child_frame
    own = result.covariance_measured, result.covariance_allowance
    exchanged = [inverse_covariance(T, each) for each in own]
    known_m = result.sigmas_measured[:3]
    hidden = {*result.unobservable()}
    # Where the rotation is out of reach, the axes of both sensors are the same by convention.
    of_inverse_m = known_m if {*ROTATIONS} <= {*result.out_of_reach} else None
    rows: list[tuple[str, FloatArray, str, str, Sequence[FloatArray], FloatArray | None]] = [
        ("T_parent_child", T, child, parent, own, known_m),
        ("T_child_parent", result.T_child_parent, parent, child, exchanged, of_inverse_m),
    ]
    if result.T_base_child is not None:
        rows.append(("T_base_child", result.T_base_child, child, result.base_frame, own, None))
    extra = extra_transforms(result)
    for name, added in extra.items():
        added_covariances = added.covariance, np.zeros((6, 6))
        rows.append(
            (name, added.T_target_source, added.source, added.target, added_covariances, None)
        )
    found = {}
    for name, T, source, target, covariances, sigmas_m in rows:
        measured, allowance = covariances
        sigmas = sigmas_rpy(T, measured)
        along, allowance_m = (
            sigmas_in_parent(se3.rotation_of(T), each)[:3] for each in covariances
        )
        if sigmas_m is None:
            is_unsure = bool(hidden) or name in extra
            sigmas_m = np.where(is_unsure & (along > UNKNOWN_M), np.inf, along)
        is_turn_known = not {*ROTATIONS} & hidden
        # Near gimbal lock roll and yaw have no standard deviation and are known.
        known = np.isfinite(sigmas) | is_turn_known
        found[name] = Notation(
            maps=f"coordinates of {source} into {target}",
            translation=np.where(np.isfinite(sigmas_m), se3.translation_of(T), np.nan),
            sigma_translation=np.hypot(sigmas_m, allowance_m),
            sigma_measured_translation=sigmas_m,
            quat_xyzw=se3.to_quat_xyzw(T) if is_turn_known else None,
            rpy_deg=np.degrees(np.where(known, se3.rotation_to_rpy(se3.rotation_of(T)), np.nan)),
            sigma_rpy_deg=np.degrees(np.hypot(sigmas, sigmas_rpy(T, allowance))),
            sigma_measured_rpy_deg=np.degrees(sigmas),
            matrix=T,
        )
    return found


def extra_transforms(result: Result) -> dict[str, ExtraTransform]:
    """Transforms of the parts of a result by their names."""
    found: dict[str, ExtraTransform] = {}
    for name, value in result.parts.items():
        found |= part(name).transforms(value)
    return found


def matrix_of(of: str, frame: str, matrix: FloatArray) -> Document:
    """A covariance of a document, and what it is of."""
    return {"of": of, "frame": frame, "units": "m, rad", "matrix": matrix}


def summary(result: Result) -> dict[str, str]:
    """How a result was solved, as names and values."""
    rate = result.clock_rate
    proof = {"yes": "", "no": "not "}
    offset = result.time_offset_s
    method = [f"{result.method} ({result.backend})"]
    rows = {
        "Method": "; ".join(filter(None, [*method, result.method_reason])),
        "Reference": result.reference_reason or result.reference,
        "Poses": f"{result.n_poses:,}",
        "Motion pairs": f"{result.n_inliers:,} of {result.n_pairs:,} are inliers",
        "Objective": f"{result.objective:.6g}",
        "Time offset": given_or_estimated(offset, result.time_offset_sigma_s, "s"),
        "Scale": given_or_estimated(result.scale, result.scale_sigma, ""),
    }
    if result.proved_global in proof:
        rows["Objective"] += f", {proof[result.proved_global]}proved to be the global minimum"
    if rate and rate.is_used:
        rows["Time offset"] += f" at {rate.at_ns * 1e-9:.3f} s; the child's clock is {rate}"
    if result.noise:
        said = (each.removeprefix("Noise: ").rstrip(".") for each in result.noise.in_words)
        rows["Noise"] = "; ".join(said)
    return rows


def printed_numbers(
    transform: Notation, out_of_reach: Collection[str], sign: str = "+/-"
) -> dict[str, str]:
    """The printed numbers of a transform by axis: x, y, z (m), roll, pitch and yaw (deg), each with
    its standard deviation. Axes that are out of reach of the
    streams stand together.
    """
    found = {}
    for axes, values, sigmas, unit in (
        (TRANSLATIONS, transform.translation, transform.sigma_translation, "m"),
        (ROTATIONS, transform.rpy_deg, transform.sigma_rpy_deg, "deg"),
    ):
        if {*axes} & {*out_of_reach}:
            found[listing(axes)] = "not estimated"
            continue
        for axis, value, sigma in zip(axes, values.tolist(), sigmas.tolist(), strict=True):
            if not np.isfinite(value):
                found[axis] = "unknown"
            elif not np.isfinite(sigma):  # near gimbal lock
                found[axis] = f"{fixed(value, 2)} {unit}"
            else:
                text = with_sigma(value, sigma, 3 if unit == "m" else 2).replace("+/-", sign)
                found[axis] = f"{text} {unit}"
    return found


def parts_of_sigmas(transform: Notation) -> dict[str, str]:
    """The parts of each printed standard deviation by axis, such as "4 mm measured, 8 mm allowance
    for constant errors"; axes without an allowance, or that are unknown, are left out.
    """
    sigmas = np.r_[transform.sigma_translation, np.radians(transform.sigma_rpy_deg)]
    measured = np.r_[
        transform.sigma_measured_translation, np.radians(transform.sigma_measured_rpy_deg)
    ]
    parts = {}
    for axis, sigma, of_recording in zip(AXES, sigmas.tolist(), measured.tolist(), strict=True):
        if math.isfinite(sigma) and sigma > of_recording:
            rest = amount(axis, math.sqrt(sigma**2 - of_recording**2))
            recorded = amount(axis, of_recording)
            parts[axis] = f"{recorded} measured, {rest} allowance for constant errors"
    return parts


def allowance_in_words(result: Result) -> str:
    """How large the allowance in the standard deviations is, in a sentence; empty without one."""
    known = np.isfinite(result.sigmas)
    sizes = []
    for axes in (TRANSLATIONS, ROTATIONS):
        rows = [index for index, axis in enumerate(AXES) if axis in axes and known[index]]
        largest = float(result.allowance[rows].max(initial=0.0))
        if largest > 0.0:
            sizes.append(amount(axes[0], largest))
    if not sizes:
        return ""
    of = "" if result.measured == "positions" else "odometry "
    return f"includes an allowance of up to {listing(sizes)} for constant {of}errors"


# ------------------------------------------------------------------------ for robots


def usable_numbers(result: Judged) -> dict[str, float | str]:
    """The numbers of a result's ``mounting`` for commands and files that others read.

    Returns
    -------
    dict
        x, y, z in m and qx, qy, qz, qw; if an angle is unknown, roll, pitch and yaw in rad instead
        of the quaternion. An axis that cannot be determined is a text that no parser takes, such as
        MEASURE_Z_BY_HAND. Empty under DO NOT USE.
    """
    if result.verdict is Verdict.DO_NOT_USE:
        return {}
    T = result.mounting[1]
    unknown = {*result.unobservable()}
    hidden = np.array([axis in unknown for axis in TRANSLATIONS])
    if result.T_base_parent is not None:  # axes that share a direction that the motion hides
        of_base = np.abs(se3.rotation_of(result.T_base_parent)[:, hidden])
        hidden = of_base.max(axis=1, initial=0.0) > _SHARED
    numbers: dict[str, float | str] = {
        axis: by_hand(axis) if is_hidden else float(value)
        for axis, value, is_hidden in zip(TRANSLATIONS, se3.translation_of(T), hidden, strict=True)
    }
    if unknown.intersection(ROTATIONS):
        return numbers | usable_angles(result)
    return numbers | dict(zip(("qx", "qy", "qz", "qw"), se3.to_quat_xyzw(T), strict=True))


def transform_arguments(result: Judged, decimals: int) -> list[str]:
    """The arguments of static_transform_publisher for a result's ``mounting``, with so many
    decimals; empty under DO NOT USE.
    """
    told: list[str] = []
    for name, value in usable_numbers(result).items():
        told += [f"--{name}", value if isinstance(value, str) else fixed(value, decimals)]
    frames = ["--frame-id", result.mounting[0], "--child-frame-id", result.child_frame]
    return told and told + frames


def usable_angles(result: Result) -> dict[str, float | str]:
    """Roll, pitch and yaw of a result's ``mounting``, rad, about fixed axes, as in URDF; a text for
    an angle that cannot be determined.
    """
    T = result.mounting[1]
    known = np.full(3, True)  # near gimbal lock roll and yaw have no sigma and are known
    if set(result.unobservable()).intersection(ROTATIONS):
        known = np.isfinite(sigmas_rpy(T, result.covariance_measured))
    angles = se3.rotation_to_rpy(se3.rotation_of(T)).tolist()
    return {
        name: angle if is_known else by_hand(name)
        for name, angle, is_known in zip(ROTATIONS, angles, known, strict=True)
    }


# -------------------------------------------------------------------------- reading


def result_from(of: type[_OfResult], data: Mapping[str, Any]) -> _OfResult:
    """A calibration from its document, which may have been changed by hand, or damaged; an
    InputError that says what is wrong.
    """
    is_document = isinstance(data, Mapping)
    form = data.get("format") if is_document else None
    version = data.get("version") if is_document else None
    if form != _FORMAT or version not in _READABLE:
        raise InputError(
            f"expected format {_FORMAT}, version {_READABLE[0]} or {_READABLE[1]}; "
            f"found format {form}, version {version}"
        )
    try:
        return _result_from(of, _measured_parts(data))
    except KeyError as error:
        raise InputError(f"the calibration has no {error}: restore or repeat it") from None
    except (TypeError, ValueError) as error:
        raise InputError(
            f"the calibration was changed after it was written: {error}; restore or repeat it"
        ) from None


def _measured_parts(data: Mapping[str, Any]) -> Document:
    """A document of any version with the fields of a result: measured parts and allowance."""
    document = dict(data)
    if data["version"] == 1:
        document |= {name: data[old] for name, old in _OLD_COVARIANCES.items() if old in data}
        document["observability_measured"] = data["observability"]
        return document
    whole = covariance_of(data["covariance"])
    parts = [covariance_of(data[name]) for name in _OLD_COVARIANCES]
    if not np.allclose(whole, parts[0] + parts[1], rtol=1e-6, atol=1e-300):
        raise ValueError("covariance is not the sum of covariance_measured and its allowance")
    document["observability_measured"] = [
        {**row, "sigma": row["sigma_measured"]} for row in data["observability"]
    ]
    return document


def _result_from(of: type[_OfResult], data: Mapping[str, Any]) -> _OfResult:
    """Build a result from a document of the right format. Raises KeyError, TypeError or ValueError
    if a value is missing or was changed.
    """
    from hand_eye_calib.core.results.context import Comparison

    readers = dict.fromkeys((*_TRANSFORMS, "T_base_child"), transform_of)
    readers |= dict.fromkeys(_COVARIANCES, covariance_of)
    arrays = {name: read(data[name]) for name, read in readers.items() if name in data}
    if "T_base_child" in arrays:
        T_child_parent = se3.inverse(arrays["T_parent_child"])
        arrays["T_base_parent"] = arrays["T_base_child"] @ T_child_parent
    known = {name: value for name, value in data.items() if name not in _READ_APART}
    found = {added.name: added.read(data) for added in all_parts()}
    parts = {name: value for name, value in found.items() if value is not None}
    result: _OfResult = from_plain(of, known | arrays, Comparison=Comparison)
    result = replace(result, parts=parts, findings=_findings_of(data))
    if data["version"] == 1 and result.cross_check:
        result = replace(result, cross_check=_with_allowance(result))
    if tuple(dof.name for dof in result.observability) != AXES:
        raise ValueError(f"the axes of observability are not {', '.join(AXES)}")
    if data["version"] != 1:
        _require_sigmas(result, data["observability"])
    for name in ("contradictions", "target_axes", "cross_check"):
        if not {*(getattr(result, name) or {})} <= {*AXES}:
            raise ValueError(f"{name} has other axes than {', '.join(AXES)}")
    if result.method not in METHODS:
        raise ValueError(f"method {result.method} is not known")
    return result


def _findings_of(data: Mapping[str, Any]) -> tuple[Finding, ...]:
    """Return the findings of a document."""
    rows = data.get("findings", [])
    if not isinstance(rows, (list, tuple)):
        raise TypeError(f"findings: a list is {type(rows).__name__}")
    return tuple(map(Finding.from_dict, rows))


def _require_sigmas(result: Result, rows: Sequence[Mapping[str, Any]]) -> None:
    """Raise ValueError unless the standard deviations are those of their two parts."""
    sigmas = [from_plain(float, row["sigma"]) for row in rows]
    if not np.allclose(sigmas, result.sigmas, rtol=1e-6, atol=1e-300):
        raise ValueError("sigma is not that of sigma_measured and the allowance")


def _with_allowance(result: Result) -> CrossCheck:
    """The cross-check of a document of version 1, whose standard deviations lack the allowance."""
    sizes = dict(zip(AXES, result.allowance.tolist(), strict=True))
    rows = dict(result.cross_check or {})
    for axis, row in rows.items():
        if axis in sizes and row.sigma is not None:
            rows[axis] = replace(row, sigma=math.hypot(row.sigma, sizes[axis]))
    return rows


def transform_of(data: Mapping[str, Any]) -> FloatArray:
    """Transform (4, 4) of a document."""
    matrix = _matrix(data, 4)
    check_poses(matrix[None])
    return matrix


def covariance_of(data: Mapping[str, Any]) -> FloatArray:
    """Covariance (6, 6) of a document; infinite for what is unknown."""
    matrix = _matrix(data, 6)
    known = np.isfinite(matrix)
    sigmas = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    # Rounding makes a correlation of 1 a little larger.
    bounds = (1 + 1e-6) * np.outer(sigmas, sigmas) + 1e-300
    is_symmetric = np.allclose(matrix, matrix.T, rtol=1e-6)
    if not (is_symmetric and np.all(np.abs(matrix[known]) <= bounds[known])):
        raise ValueError("a matrix is not a covariance")
    return matrix


def _matrix(data: Mapping[str, Any], size: int) -> FloatArray:
    rows = from_plain(tuple[tuple[float, ...], ...], data["matrix"])
    return np.array(rows, dtype=float).reshape(size, size)
