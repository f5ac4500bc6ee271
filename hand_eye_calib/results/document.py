"""Values of a result's document, checked before a result is made of them.

A file may be changed by hand, or damaged. All functions raise KeyError, TypeError or ValueError for
what was not written so; :meth:`~hand_eye_calib.results.calibration.Calibration.from_dict` says it
in words.
"""

from collections.abc import Mapping
from dataclasses import MISSING
from typing import Any, get_type_hints

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import ROTATION_TOLERANCE
from hand_eye_calib.methods import METHODS
from hand_eye_calib.plain import from_plain
from hand_eye_calib.results.status import AXES

# Fields that a document has under other names, as matrices; and those that files do not have.
MATRICES = (
    "T_parent_child",
    "T_method",
    "covariance",
    "floor",
    "T_base_parent",
    "T_world_world",
    "cov_world_world",
)
NOT_IN_FILES = ("motion_residuals", "recording")


def values_of(of: type[Any], data: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a calibration from its document."""
    values: dict[str, Any] = {}
    for name in ("T_parent_child", "T_method", "T_world_world", "T_base_child"):
        if name in data:
            values[name] = _transform_of(data[name])
    for name in ("covariance", "cov_world_world", "floor"):
        if name in data:
            values[name] = _covariance_of(data[name])
    if "T_base_child" in values:
        T_child_parent = se3.inverse(values["T_parent_child"])
        values["T_base_parent"] = values.pop("T_base_child") @ T_child_parent
    hints = get_type_hints(of)
    for name, each in of.__dataclass_fields__.items():
        if name in data and name not in (*MATRICES, *NOT_IN_FILES):
            try:
                values[name] = from_plain(hints[name], data[name])
            except TypeError as error:
                raise TypeError(f"{name}: {error}") from None
        elif name not in values and each.default is each.default_factory is MISSING:
            raise KeyError(name)
    if tuple(dof.name for dof in values["observability"]) != AXES:
        raise ValueError(f"the axes of observability are not {', '.join(AXES)}")
    for name in ("contradictions", "target_axes", "cross_check"):
        if not {*(values.get(name) or {})} <= {*AXES}:
            raise ValueError(f"{name} has other axes than {', '.join(AXES)}")
    if values["method"] not in METHODS:
        raise ValueError(f"method {values['method']} is not known")
    return values


def _transform_of(data: Mapping[str, Any]) -> FloatArray:
    """Transform (4, 4) of a document."""
    matrix = _matrix(data, 4)
    rotation = matrix[:3, :3]
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=ROTATION_TOLERANCE)
    if not (is_rotation and np.isfinite(matrix).all() and np.linalg.det(rotation) > 0):
        raise ValueError("a matrix is not a transform")
    return matrix


def _covariance_of(data: Mapping[str, Any]) -> FloatArray:
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
