"""Values of a result's document, checked before a result is made of them.

A file may be changed by hand, or damaged. All functions raise KeyError, TypeError or ValueError for
what was not written so; :meth:`~hand_eye_calib.results.calibration.Calibration.from_dict` says it
in words.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import ROTATION_TOLERANCE
from hand_eye_calib.methods import METHODS
from hand_eye_calib.results.status import ROTATIONS, TRANSLATIONS

# Attributes that to_dict holds as they are: those that every file has, and those added later.
PLAIN = (
    "objective",
    "method",
    "reference",
    "backend",
    "n_poses",
    "n_pairs",
    "n_inliers",
    "time_offset_s",
    "scale",
    "stamp_ns",
    "parent_frame",
    "child_frame",
)
PLAIN_LATER = (
    "time_offset_sigma_s",
    "scale_sigma",
    "proved_global",
    "method_reason",
    "reference_reason",
    "noise",
    "cross_check",
    "contradictions",
    "target_translation",
    "target_rotation",
    "target_axes",
    "comparison",
    "goal",
    "measured",
    "rate_bias",
)

# Of other values than numbers.
_KINDS: dict[str, Any] = (
    dict.fromkeys(("method", "reference", "backend", "parent_frame", "child_frame"), str)
    | dict.fromkeys(("n_poses", "n_pairs", "n_inliers", "stamp_ns"), int)
    | dict.fromkeys(("method_reason", "reference_reason", "proved_global", "measured"), str)
    | dict.fromkeys(("noise", "cross_check", "comparison", "goal", "rate_bias"), (dict, type(None)))
    | {"contradictions": dict, "target_axes": dict}
)

_AXES = (*TRANSLATIONS, *ROTATIONS)

# No standard deviation of a result is as large (m, rad).
_LARGEST_SIGMA = 1e4

# No number is as large: the products of some are still finite.
_LARGEST = 1e50


def check_values(data: Mapping[str, Any]) -> None:
    """Refuse values of a document that are not of the kind that was written."""
    for name in (*PLAIN, *PLAIN_LATER):
        kind = _KINDS.get(name, (int, float))
        value = data.get(name)
        if name in data and (not isinstance(value, kind) or isinstance(value, bool)):
            raise TypeError(f"{name} is {type(value).__name__}")
    if not all(_has_usual_numbers(value) for name, value in data.items() if name != "provenance"):
        raise ValueError("a number is not finite, or far too large")
    if tuple(dof["name"] for dof in data["observability"]) != _AXES:
        raise ValueError(f"the axes of observability are not {', '.join(_AXES)}")
    words = (data.get("noise") or {}).get("in_words", [])
    for name, values in (("noise", words), ("warnings", data["warnings"])):
        if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
            raise TypeError(f"{name} is not text")
    for finding in data.get("findings", ()):
        values = [finding[name] for name in ("code", "severity", "what", "advice")]
        if not all(isinstance(value, str) for value in values):
            raise TypeError("a finding is not text")
        dict(finding.get("options", {}))
    for name in ("contradictions", "target_axes", "cross_check"):
        if not {*(data.get(name) or {})} <= {*_AXES}:
            raise ValueError(f"{name} has other axes than {', '.join(_AXES)}")
    numbers(data.get("contradictions", {}).values())
    if data["method"] not in METHODS:
        raise ValueError(f"method {data['method']} is not known")
    for value in data.get("target_axes", {}).values():
        float(value)
    for row in (data["cross_check"] or {}).values():
        if not {*row} >= {"sigma", "of_methods", "of_halves"}:
            raise TypeError("cross_check lacks values")
        numbers(row.values())
    for name in ("comparison", "goal"):
        if not isinstance((data.get(name) or {"sentence": ""}).get("sentence"), str):
            raise TypeError(f"{name} has no sentence")


def transform_of(data: Mapping[str, Any]) -> FloatArray:
    """Transform (4, 4) of a document."""
    matrix = matrix_of(data, 4)
    rotation = matrix[:3, :3]
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=ROTATION_TOLERANCE)
    if not (is_rotation and np.isfinite(matrix).all() and np.linalg.det(rotation) > 0):
        raise ValueError("a matrix is not a transform")
    return matrix


def base_parent(data: Mapping[str, Any]) -> FloatArray:
    """Pose of the parent sensor in the base frame of a document."""
    return transform_of(data["T_base_child"]) @ se3.inverse(transform_of(data["T_parent_child"]))


def floor_of(data: Mapping[str, Any]) -> FloatArray:
    """Common-mode floor (6, 6) of a document."""
    matrix = covariance_of(data, np.inf)
    if not np.isfinite(matrix).all():
        raise ValueError("the floor is not finite")
    return matrix


def covariance_of(data: Mapping[str, Any], largest_sigma: float = _LARGEST_SIGMA) -> FloatArray:
    """Covariance (6, 6) of a document; infinite for what is unknown."""
    matrix = matrix_of(data, 6)
    known = np.isfinite(matrix)
    sigmas = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    is_usual = bool(np.all(sigmas[np.diag(known)] <= largest_sigma))
    # Rounding makes a correlation of 1 a little larger.
    bounds = (1 + 1e-6) * np.outer(sigmas, sigmas) + 1e-300
    is_usual &= np.allclose(matrix, matrix.T, rtol=1e-6)
    if not (is_usual and np.all(np.abs(matrix[known]) <= bounds[known])):
        raise ValueError("a matrix is not a covariance")
    return matrix


def _has_usual_numbers(value: Any) -> bool:
    """Whether all numbers in plain data are finite, and far from overflow."""
    if isinstance(value, Mapping):
        return all(map(_has_usual_numbers, value.values()))
    if isinstance(value, list):
        return all(map(_has_usual_numbers, value))
    return not isinstance(value, float) or abs(value) < _LARGEST


def numbers(values: Iterable[float | None]) -> list[float]:
    """Numbers of a document; infinite for None.

    Raises
    ------
    TypeError, ValueError
        If one is no number.
    """
    return [np.inf if value is None else float(value) for value in values]


def matrix_of(data: Mapping[str, Any], size: int) -> FloatArray:
    """Square matrix of a document.

    Raises
    ------
    KeyError, TypeError, ValueError
        If it has none of that size.
    """
    rows = [numbers(row) for row in data["matrix"]]
    return np.array(rows, dtype=float).reshape(size, size)
