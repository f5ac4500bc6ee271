"""Tables of poses from numbers in memory: arrays and DataFrames."""

from collections.abc import Sequence
from decimal import Decimal
from typing import Any

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry.trajectory import ROTATION_TOLERANCE
from hand_eye_calib.formats.trajectory_files.columns import (
    MATRIX,
    POSITION,
    QUATERNION,
)
from hand_eye_calib.formats.trajectory_files.dates import stamp_of
from hand_eye_calib.formats.trajectory_files.table import Table

# Kinds of data that can be read, for messages.
_KINDS = (
    "a path, an array (N, 4, 4), (N, 8) of t, x, y, z, qx, qy, qz, qw or (N, 7), or a table with "
    "named columns"
)


def columns_of_array(
    source: Any,
) -> tuple[Sequence[str], FloatArray, list[str]]:
    """Return the columns of an array of poses.

    Parameters
    ----------
    source : array_like
        Rows (N, 8) of t, x, y, z, qx, qy, qz, qw; (N, 7) without t; (N, 4) of t, x, y, z; or
        matrices (N, 4, 4) or (N, 3, 4).

    Returns
    -------
    names : sequence of str
    values : (N, k) array
    notes : list of str
        Notes for the user about assumptions.

    Raises
    ------
    InputError
        For another shape, and if the values are not numbers.
    """
    try:
        values = np.asarray(source, dtype=float)
    except (TypeError, ValueError):
        raise InputError(
            f"expected {_KINDS}; found {type(source).__name__}"
        ) from None
    if values.shape[1:] in ((3, 4), (4, 4)):
        return _columns_of_matrices(values)
    names = ("t", *POSITION, *QUATERNION)
    names_of_shape = {(8,): names, (7,): names[1:], (4,): names[:4]}
    if values.shape[1:] not in names_of_shape:
        raise InputError(f"expected {_KINDS}; found an array {values.shape}")
    return names_of_shape[values.shape[1:]], values, []


def _columns_of_matrices(
    matrices: FloatArray,
) -> tuple[Sequence[str], FloatArray, list[str]]:
    """Return the columns of matrices (N, 3, 4) or (N, 4, 4), as :func:`columns_of_array` does.

    Matrices whose last column is 0 0 0 1 are transposed, with a note.
    """
    notes = []
    if matrices.shape[1:] == (4, 4) and not _has_last_row(matrices):
        matrices = np.swapaxes(matrices, 1, 2)
        notes = ["matrices are transposed: their rows were read as columns"]
        if not _has_last_row(matrices):
            raise InputError(
                "the last row of a matrix is not 0 0 0 1; expected poses (N, 4, 4)"
            )
    return MATRIX, matrices[:, :3].reshape(len(matrices), len(MATRIX)), notes


def _has_last_row(matrices: FloatArray) -> bool:
    """Return whether the last row of all matrices (N, 4, 4) with a pose is 0 0 0 1.

    Matrices that are not finite or all 0 contain no pose, and are ignored.
    """
    is_finite = np.isfinite(matrices).all(axis=(1, 2))
    is_zero = ~matrices.any(axis=(1, 2))
    last_rows = matrices[is_finite & ~is_zero, 3]
    return bool(
        np.allclose(
            last_rows, [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=ROTATION_TOLERANCE
        )
    )


def table_of_object(source: Any, times: Any = None) -> Table:
    """Return the table of an array or of a DataFrame; see :func:`hand_eye_calib.read_trajectory`.

    Raises
    ------
    InputError
        If the source is neither an array nor a DataFrame, or if a pose has no stamp that is a
        number or a datetime.
    """
    if hasattr(source, "columns"):
        keys = [*source.columns]
        table = Table("the table", [*map(str, keys)], expected=_KINDS)
        columns = [
            np.asarray(source[keys[place]], dtype=float)
            for place in table.at.values()
        ]
        values = np.column_stack(columns)
        if times is None:
            times = _times_of_columns(
                [source[keys[place]] for place in table.stamp_at], table
            )
    else:
        names, values, notes = columns_of_array(source)
        if names[0] == "t":
            times = values[:, 0] if times is None else times
            names = names[1:]
            values = values[:, 1:]
        table = Table("the poses", names, expected=_KINDS)
        for note in notes:
            table.guess(note)
    stamps = (
        None if times is None else _stamps_of_objects(times, table, len(values))
    )
    table.fill_from_arrays(values, stamps)
    return table


def _times_of_columns(columns: Sequence[Any], table: Table) -> Any:
    """Return the stamps from the columns of a DataFrame, or None without such columns."""
    if len(columns) < 2:
        return columns[0] if columns else None
    rows = zip(*(map(str, column) for column in columns), strict=True)
    return [
        stamp_of(table.stamp_names, cells, table.second_unit) for cells in rows
    ]


def _stamps_of_objects(
    times: Any, table: Table, n_poses: int
) -> list[Decimal | None]:
    """Return the stamp of each pose from numbers or datetimes. A missing time is None.

    For datetimes, this also sets the unit of the table's stamps to ns.
    """
    if isinstance(times, list) and times and isinstance(times[0], Decimal):
        return [*times]
    # Pandas has datetimes with a time zone, and numpy has not. Convert them to UTC.
    if getattr(getattr(times, "dtype", None), "tz", None) is not None:
        times = np.asarray(times, dtype="datetime64[ns]")
    stamps = np.asarray(times)
    is_time = np.ones(stamps.shape, dtype=bool)
    if stamps.dtype.kind == "M":
        table.stamp_unit = "ns"
        is_time = ~np.isnat(stamps)
        stamps = stamps.astype("datetime64[ns]").astype(np.int64)
    elif stamps.dtype.kind == "f":
        is_time = np.isfinite(stamps)
    if stamps.dtype.kind not in "iuf" or not is_time.any():
        raise InputError(
            f"stamps must be finite numbers or datetimes; found {stamps.dtype} of shape "
            f"{stamps.shape}"
        )
    if stamps.shape != (n_poses,):
        raise InputError(
            f"there must be one stamp per pose; found {stamps.size} stamps and {n_poses} poses"
        )
    return [
        Decimal(stamp) if is_valid else None
        for stamp, is_valid in zip(
            stamps.tolist(), is_time.tolist(), strict=True
        )
    ]
