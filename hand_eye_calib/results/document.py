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
NOT_IN_FILES = ("motion_residuals", "model", "recording")

# No standard deviation of a result is as large (m, rad).
_LARGEST_SIGMA = 1e4


def values_of(of: type[Any], data: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a calibration from its document."""
    values = {
        "T_parent_child": _transform_of(data["T_parent_child"]),
        "covariance": _covariance_of(data["covariance"]),
    }
    if "T_method" in data:
        values["T_method"] = _transform_of(data["T_method"])
    if "T_world_world" in data:
        values["T_world_world"] = _transform_of(data["T_world_world"])
        values["cov_world_world"] = _covariance_of(data["cov_world_world"])
    if "floor" in data:
        values["floor"] = _covariance_of(data["floor"], is_known=True)
    if "T_base_child" in data:
        T_child_parent = se3.inverse(values["T_parent_child"])
        values["T_base_parent"] = _transform_of(data["T_base_child"]) @ T_child_parent
    hints = get_type_hints(of)
    for name, each in of.__dataclass_fields__.items():
        if name in data and name not in (*MATRICES, *NOT_IN_FILES):
            try:
                values[name] = from_plain(hints[name], data[name])
            except TypeError as error:
                raise TypeError(f"{name}: {error}") from None
        elif name not in values and each.default is each.default_factory is MISSING:
            raise KeyError(name)
    _check_values(values)
    return values


def _check_values(values: Mapping[str, Any]) -> None:
    """Refuse fields of a calibration that cannot belong to one."""
    if tuple(dof.name for dof in values["observability"]) != AXES:
        raise ValueError(f"the axes of observability are not {', '.join(AXES)}")
    for name in ("contradictions", "target_axes", "cross_check"):
        if not {*(values.get(name) or {})} <= {*AXES}:
            raise ValueError(f"{name} has other axes than {', '.join(AXES)}")
    if values["method"] not in METHODS:
        raise ValueError(f"method {values['method']} is not known")


def _transform_of(data: Mapping[str, Any]) -> FloatArray:
    """Transform (4, 4) of a document."""
    matrix = _matrix(data, 4)
    rotation = matrix[:3, :3]
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=ROTATION_TOLERANCE)
    if not (is_rotation and np.isfinite(matrix).all() and np.linalg.det(rotation) > 0):
        raise ValueError("a matrix is not a transform")
    return matrix


def _covariance_of(data: Mapping[str, Any], is_known: bool = False) -> FloatArray:
    """Covariance (6, 6) of a document; infinite for what is unknown, unless all is known."""
    matrix = _matrix(data, 6)
    known = np.isfinite(matrix)
    if is_known and not known.all():
        raise ValueError("the floor is not finite")
    sigmas = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    is_usual = is_known or bool(np.all(sigmas[np.diag(known)] <= _LARGEST_SIGMA))
    # Rounding makes a correlation of 1 a little larger.
    bounds = (1 + 1e-6) * np.outer(sigmas, sigmas) + 1e-300
    is_usual &= np.allclose(matrix, matrix.T, rtol=1e-6)
    if not (is_usual and np.all(np.abs(matrix[known]) <= bounds[known])):
        raise ValueError("a matrix is not a covariance")
    return matrix


def _matrix(data: Mapping[str, Any], size: int) -> FloatArray:
    rows = from_plain(tuple[tuple[float, ...], ...], data["matrix"])
    return np.array(rows, dtype=float).reshape(size, size)
