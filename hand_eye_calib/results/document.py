"""Values of a result's document, checked before a result is made of them.

A file may be changed by hand, or damaged. All functions raise KeyError, TypeError or ValueError for
what was not written so; :meth:`~hand_eye_calib.results.calibration.Calibration.from_dict` says it
in words.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry.trajectory import ROTATION_TOLERANCE
from hand_eye_calib.methods import METHODS
from hand_eye_calib.plain import from_plain
from hand_eye_calib.results.status import AXES

# No standard deviation of a result is as large (m, rad).
_LARGEST_SIGMA = 1e4


def check_values(values: Mapping[str, Any]) -> None:
    """Refuse fields of a calibration that cannot belong to one."""
    if tuple(dof.name for dof in values["observability"]) != AXES:
        raise ValueError(f"the axes of observability are not {', '.join(AXES)}")
    for name in ("contradictions", "target_axes", "cross_check"):
        if not {*(values.get(name) or {})} <= {*AXES}:
            raise ValueError(f"{name} has other axes than {', '.join(AXES)}")
    if values["method"] not in METHODS:
        raise ValueError(f"method {values['method']} is not known")


def transform_of(data: Mapping[str, Any]) -> FloatArray:
    """Transform (4, 4) of a document."""
    matrix = _matrix(data, 4)
    rotation = matrix[:3, :3]
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=ROTATION_TOLERANCE)
    if not (is_rotation and np.isfinite(matrix).all() and np.linalg.det(rotation) > 0):
        raise ValueError("a matrix is not a transform")
    return matrix


def covariance_of(data: Mapping[str, Any], is_known: bool = False) -> FloatArray:
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
