"""Types of NumPy arrays for annotations, and a check of arguments that are arrays."""

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hand_eye_calib.core.base.errors import InputError

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]


def floats(name: str, values: ArrayLike, columns: int = 0) -> FloatArray:
    """Return an argument of the Python interface as an array of floats.

    The shape is (N, columns); if ``columns`` is 0, the shape is that of the argument.

    Raises
    ------
    InputError
        If the argument is no array of numbers, or has another shape.
    """
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        array = None
    shape = f" of shape (N, {columns})" if columns else ""
    if array is None:
        raise InputError(
            f"{name} must be numbers{shape}; got {type(values).__name__}"
        )
    if not columns:
        return array
    # A flat array is a sequence of rows.
    has_other_rows = array.ndim > 1 and array.shape[1:] != (columns,)
    if has_other_rows or array.size % columns:
        raise InputError(
            f"{name} must be numbers{shape}; found shape {array.shape}"
        )
    return array.reshape(-1, columns)
