"""Quantities of columns without names, recognised from their values.

A quaternion has unit length, and a rotation matrix is orthogonal.
"""

from collections.abc import Sequence
from itertools import islice

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry.trajectory import (
    QUATERNION_NORM_TOLERANCE,
    ROTATION_TOLERANCE,
)
from hand_eye_calib.formats.trajectory_files.cells import (
    is_number,
    is_value,
    number,
)
from hand_eye_calib.formats.trajectory_files.columns import (
    LAST_ROW,
    MATRIX,
    POSITION,
    ROTATION,
    ROTATION_VECTOR,
    TRANSLATION,
    UNNAMED,
)

# Largest number of rows whose values are used to recognise the columns.
_MOST_ROWS = 100
#: Columns of a stamp and a pose. The scalar of the quaternion may be first or last.
STAMPED_POSE = ("t", *POSITION, *UNNAMED)
# Columns of the state that FAST-LIO and related programs write: a stamp, a rotation vector, a
# position, and six more vectors (18 columns). The last vector is gravity.
_FAST_LIO = ("t", *ROTATION_VECTOR, *POSITION, *[""] * 18)
# Smallest and largest length of gravity (m/s^2) in the state of FAST-LIO: 9.81, with space for
# errors of its estimate.
_GRAVITY_M_S2 = (9.6, 10.0)
# Possible columns of a pose without a stamp, in the order in which they are tried.
_POSES: tuple[tuple[str, ...], ...] = (
    (*MATRIX, *LAST_ROW),
    tuple(f"m{row}{column}" for column in "1234" for row in "1234"),
    MATRIX,
    (*ROTATION, *TRANSLATION),
    (*TRANSLATION, *ROTATION),
    (*POSITION, *UNNAMED),
    (*UNNAMED, *POSITION),
)
#: Poses whose rotation matrix is separate from the translation. Programs store such a matrix by
#: rows or by columns.
TRANSPOSABLE = _POSES[3:5]
# Possible numbers of columns of a covariance (6, 6) after a pose: the diagonal, one triangle, or
# all elements.
_COVARIANCES = (6, 21, 36)


def columns_of_rows(
    row: Sequence[str], rows: Sequence[Sequence[str]]
) -> tuple[str, ...] | None:
    """Return the quantities of the columns from values in the first rows, or None if none fit.

    Columns with text have an empty name. ``row`` is a row with the usual number of cells.
    """
    places = [place for place, cell in enumerate(row) if is_value(cell)]
    if not places:
        return None
    values = _values_in(rows, places, len(row))
    # Squares of very large numbers overflow to infinity, which fits nothing.
    with np.errstate(all="ignore"):
        columns = _columns_of_values(values) if len(values) else None
    if columns is None:
        return None
    named = [""] * len(row)
    for place, name in zip(places, columns, strict=True):
        named[place] = name
    return tuple(named)


def _columns_of_values(values: FloatArray) -> tuple[str, ...] | None:
    """Return the quantities of columns with values (N, n), or None if no quantities fit.

    The possibilities are a pose with or without a stamp, and a stamped pose with further columns.
    """
    if values.shape[1] == len(_FAST_LIO) and _is_gravity(values[:, -3:]):
        return _FAST_LIO
    return _pose_alone(values) or _pose_with_more(values)


def _pose_alone(values: FloatArray) -> tuple[str, ...] | None:
    """Return the columns of a pose with or without a stamp, or None if values (N, n) do not fit."""
    stamps: list[tuple[str, ...]] = [(), ("t",)]
    if _are_seconds_and_ns(values):
        stamps.append(("secs", "nsecs"))
    for pose in _POSES:
        for stamp in stamps:
            columns = (*stamp, *pose)
            if len(columns) == values.shape[1] and _fits(
                pose, values[:, len(stamp) :]
            ):
                return columns
    return None


def _pose_with_more(values: FloatArray) -> tuple[str, ...] | None:
    """Return the columns of a stamped pose and further columns, or None if nothing fits.

    The columns after the pose have empty names.
    """
    for pose in _POSES:
        n_more = values.shape[1] - 1 - len(pose)
        # After a position and a quaternion, any number of columns may follow. After another pose,
        # only the columns of a covariance may follow.
        may_have_more = pose == STAMPED_POSE[1:] or n_more in _COVARIANCES
        if (
            n_more > 0
            and may_have_more
            and _fits(pose, values[:, 1 : 1 + len(pose)])
        ):
            return ("t", *pose, *[""] * n_more)
    return None


def _values_in(
    rows: Sequence[Sequence[str]], places: Sequence[int], n_columns: int
) -> FloatArray:
    """Return the values (N, n) in the columns ``places`` of the first rows with numbers there.

    Rows whose number of columns is not ``n_columns`` are skipped. If the first cell is not a
    number, such as a date, it becomes 0.
    """
    values: list[list[float]] = []
    for cells in islice(
        (cells for cells in rows if len(cells) == n_columns), _MOST_ROWS
    ):
        first, *others = (cells[place] for place in places)
        try:
            stamp = number(first) if is_number(first) else 0.0
            values.append([stamp, *map(number, others)])
        except ValueError:
            continue
    table = np.array(values, dtype=float).reshape(len(values), len(places))
    return table[np.isfinite(table).all(axis=1)]


def _fits(pose: Sequence[str], values: FloatArray) -> bool:
    """Return whether values (N, n) can be a pose with these columns.

    Quaternions must have unit length, and rotation matrices must be orthogonal. Rows of zeros
    contain no pose and are ignored, but at least one row must have a pose.
    """
    if UNNAMED[0] in pose:
        norms = np.linalg.norm(_values_of(UNNAMED, pose, values), axis=1)
        is_unit = np.abs(norms - 1.0) <= QUATERNION_NORM_TOLERANCE
        return bool(is_unit[norms > 0.0].all() and norms.any())
    Rs = _values_of(ROTATION, pose, values).reshape(-1, 3, 3)
    Rs = Rs[Rs.any(axis=(1, 2))]
    errors = np.abs(Rs @ np.swapaxes(Rs, 1, 2) - np.eye(3))
    if not len(Rs) or not (errors <= ROTATION_TOLERANCE).all():
        return False
    if LAST_ROW[0] not in pose:
        return True
    last_rows = _values_of(LAST_ROW, pose, values)
    return bool(
        np.allclose(last_rows, [0.0, 0.0, 0.0, 1.0], atol=ROTATION_TOLERANCE)
    )


def _values_of(
    names: Sequence[str], pose: Sequence[str], values: FloatArray
) -> FloatArray:
    """Return the values (N, k) of k quantities. Column i of ``values`` is the quantity pose[i]."""
    columns = [pose.index(name) for name in names]
    return values[:, columns]


def _are_seconds_and_ns(values: FloatArray) -> bool:
    """Return whether the first two columns are whole seconds since 1970 and nanoseconds."""
    stamps = values[:, :2]
    is_whole = (stamps == np.round(stamps)).all()
    # Seconds since 1970 have ten digits.
    is_since_1970 = (stamps[:, 0] >= 1e9).all()
    nanoseconds = stamps[:, -1]
    is_below_second = ((nanoseconds >= 0) & (nanoseconds < 1e9)).all()
    return bool(is_whole and is_since_1970 and is_below_second)


def _is_gravity(values: FloatArray) -> bool:
    """Return whether all vectors (N, 3) have the length of gravity."""
    lengths = np.linalg.norm(values, axis=1)
    shortest, longest = _GRAVITY_M_S2
    return bool(((lengths >= shortest) & (lengths <= longest)).all())
