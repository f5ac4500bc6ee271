"""Read a result from its document, which may be damaged or changed by hand."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import METHODS
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.plain import Document, from_plain
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import check_poses
from hand_eye_calib.core.results.document import (
    COVARIANCES,
    FORMAT,
    NOT_IN_FILES,
    TRANSFORMS,
)
from hand_eye_calib.core.results.parts import all_parts
from hand_eye_calib.core.results.records import AXES, CrossCheck, Finding
from hand_eye_calib.core.results.result import Result

# Versions of documents that are read.
_READABLE = (1, 2)

# Fields with their own reading functions.
_READ_APART = (*NOT_IN_FILES, "findings")

# Names of the covariances in version 2, with their names in version 1.
_OLD_COVARIANCES = {
    "covariance_measured": "covariance",
    "covariance_allowance": "floor",
}

_OfResult = TypeVar("_OfResult", bound=Result)


def result_from(of: type[_OfResult], data: Mapping[str, Any]) -> _OfResult:
    """Make a calibration from its document, which may be damaged or changed by hand.

    Raises
    ------
    InputError
        If a value is missing or wrong; the message names the value.
    """
    is_document = isinstance(data, Mapping)
    form = data.get("format") if is_document else None
    version = data.get("version") if is_document else None
    if form != FORMAT:
        found = f"; found format {form}" if form else ""
        raise InputError(
            f"not a saved result: expected format {FORMAT}, as in extrinsic.yaml that --out "
            f"writes{found}"
        )
    if version not in _READABLE:
        raise InputError(
            f"expected format {FORMAT}, version {_READABLE[0]} or {_READABLE[1]}; found version "
            f"{version}: read it with the release that wrote it, or calibrate again"
        )
    try:
        return _result_from(of, _measured_parts(data))
    except KeyError as error:
        raise InputError(
            f"the calibration has no {error}: restore the file, or calibrate again"
        ) from None
    except (TypeError, ValueError) as error:
        raise InputError(
            f"the calibration was changed after it was written: {error}; restore the file, or "
            "calibrate again"
        ) from None


def _measured_parts(data: Mapping[str, Any]) -> Document:
    """Return a document of any version, with measured parts under the names of version 2."""
    document = dict(data)
    if data["version"] == 1:
        document |= {
            name: data[old]
            for name, old in _OLD_COVARIANCES.items()
            if old in data
        }
        document["observability_measured"] = data["observability"]
        return document
    whole = covariance_of(data["covariance"])
    measured = covariance_of(data["covariance_measured"])
    allowance = covariance_of(data["covariance_allowance"])
    if not np.allclose(whole, measured + allowance, rtol=1e-6, atol=1e-300):
        raise ValueError(
            "covariance is not the sum of covariance_measured and its allowance"
        )
    document["observability_measured"] = [
        {**row, "sigma": row["sigma_measured"]} for row in data["observability"]
    ]
    return document


def _result_from(of: type[_OfResult], data: Mapping[str, Any]) -> _OfResult:
    """Make a result from a document of the right format.

    Raises
    ------
    KeyError, TypeError, ValueError
        If a value is missing or wrong.
    """
    from hand_eye_calib.core.results.context import Comparison

    readers = dict.fromkeys((*TRANSFORMS, "T_base_child"), transform_of)
    readers |= dict.fromkeys(COVARIANCES, covariance_of)
    arrays = {
        name: read(data[name]) for name, read in readers.items() if name in data
    }
    if "T_base_child" in arrays:
        T_child_parent = se3.inverse(arrays["T_parent_child"])
        arrays["T_base_parent"] = arrays["T_base_child"] @ T_child_parent
    values = {
        name: value for name, value in data.items() if name not in _READ_APART
    }
    parts = {extra.name: extra.read(data) for extra in all_parts()}
    parts = {name: value for name, value in parts.items() if value is not None}
    result: _OfResult = from_plain(of, values | arrays, Comparison=Comparison)
    result = replace(result, parts=parts, findings=_findings_of(data))
    if data["version"] == 1 and result.cross_check:
        result = replace(result, cross_check=_with_allowance(result))
    _require_known_names(result)
    if data["version"] != 1:
        _require_sigmas(result, data["observability"])
    return result


def _require_known_names(result: Result) -> None:
    """Raise ValueError if a result has an axis or a method that this version does not have."""
    if tuple(dof.name for dof in result.observability) != AXES:
        raise ValueError(f"the axes of observability are not {', '.join(AXES)}")
    for name in ("contradictions", "target_axes", "cross_check"):
        if not {*(getattr(result, name) or {})} <= {*AXES}:
            raise ValueError(f"{name} has other axes than {', '.join(AXES)}")
    if result.method not in METHODS:
        raise ValueError(f"this version has no method {result.method}")


def _findings_of(data: Mapping[str, Any]) -> tuple[Finding, ...]:
    """Return the findings of a document."""
    rows = data.get("findings", [])
    if not isinstance(rows, (list, tuple)):
        raise TypeError(
            f"findings: expected a list, found {type(rows).__name__}"
        )
    return tuple(map(Finding.from_dict, rows))


def _require_sigmas(result: Result, rows: Sequence[Mapping[str, Any]]) -> None:
    """Raise ValueError unless each standard deviation is the root sum of squares of its parts."""
    sigmas = [from_plain(float, row["sigma"]) for row in rows]
    if not np.allclose(sigmas, result.sigmas, rtol=1e-6, atol=1e-300):
        raise ValueError(
            "sigma is not the root sum of squares of sigma_measured and the allowance"
        )


def _with_allowance(result: Result) -> CrossCheck:
    """Add the allowance to the standard deviations of a cross-check in version 1."""
    sizes = dict(zip(AXES, result.allowance.tolist(), strict=True))
    rows = dict(result.cross_check or {})
    for axis, row in rows.items():
        if axis in sizes and row.sigma is not None:
            rows[axis] = replace(row, sigma=math.hypot(row.sigma, sizes[axis]))
    return rows


def transform_of(data: Mapping[str, Any]) -> FloatArray:
    """Return the transform (4, 4) of a document."""
    matrix = _matrix(data, 4)
    check_poses(matrix[None])
    return matrix


def covariance_of(data: Mapping[str, Any]) -> FloatArray:
    """Return the covariance (6, 6) of a document; unknown variances are infinite."""
    matrix = _matrix(data, 6)
    is_known = np.isfinite(matrix)
    sigmas = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    # Rounding may make a correlation slightly larger than 1.
    bounds = (1 + 1e-6) * np.outer(sigmas, sigmas) + 1e-300
    is_symmetric = np.allclose(matrix, matrix.T, rtol=1e-6)
    if not (
        is_symmetric and np.all(np.abs(matrix[is_known]) <= bounds[is_known])
    ):
        raise ValueError("a matrix is not a covariance")
    return matrix


def _matrix(data: Mapping[str, Any], size: int) -> FloatArray:
    rows = from_plain(tuple[tuple[float, ...], ...], data["matrix"])
    return np.array(rows, dtype=float).reshape(size, size)
