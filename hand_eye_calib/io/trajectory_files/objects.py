"""Trajectories from numbers in memory: arrays, and tables with named columns."""

from decimal import Decimal
from typing import Any

import numpy as np

from hand_eye_calib.errors import InputError
from hand_eye_calib.io.trajectory_files.table import MATRIX, POSITION, QUATERNION, Table

_KINDS = (
    "a path, an array (N, 4, 4), (N, 8) of t, x, y, z, qx, qy, qz, qw or (N, 7), or a table with "
    "named columns"
)


def table_of_object(source: Any, times: Any = None) -> Table:
    """The numbers of an array or of a table; see :func:`hand_eye_calib.read_trajectory`. An
    InputError if it is neither, or the stamps are no numbers or datetimes, one for each pose.
    """
    if hasattr(source, "columns"):
        keys = [*source.columns]
        table = Table("the table", [*map(str, keys)], expected=_KINDS)
        columns = [np.asarray(source[keys[at]], dtype=float) for at in table.at.values()]
        values = np.column_stack(columns)
        if times is None and len(table.stamp_at) == 1:
            times = source[keys[table.stamp_at[0]]]
    else:
        try:
            values = np.asarray(source, dtype=float)
        except (TypeError, ValueError):
            raise InputError(f"expected {_KINDS}; found {type(source).__name__}") from None
        if values.shape[1:] == (4, 4):
            names, values = MATRIX, values.reshape(-1, 16)[:, :12]
        elif values.ndim == 2 and values.shape[1] in (7, 8):
            names = (*POSITION, *QUATERNION)
            times = values[:, 0] if times is None and values.shape[1] == 8 else times
            values = values[:, -7:]
        else:
            raise InputError(f"expected {_KINDS}; found an array {values.shape}")
        table = Table("the poses", names, expected=_KINDS)
    table.numbers.frombytes(np.ascontiguousarray(values).tobytes())
    table.line_numbers.extend(range(1, len(values) + 1))
    if times is not None:
        if getattr(getattr(times, "dtype", None), "tz", None) is not None:
            times = np.asarray(times, dtype="datetime64[ns]")
        stamps = np.asarray(times)
        if stamps.dtype.kind == "M":
            table.units["t"] = "ns"
            stamps = stamps.astype("datetime64[ns]").astype(np.int64)
        if stamps.dtype.kind not in "iuf" or not np.isfinite(stamps).all():
            raise InputError(
                f"stamps must be finite numbers or datetimes; found {stamps.dtype} of shape "
                f"{stamps.shape}"
            )
        if stamps.shape != (len(values),):
            raise InputError(
                f"there must be one stamp per pose; found {stamps.size} stamps and {len(values)} "
                "poses"
            )
        table.stamps = [*map(Decimal, stamps.tolist())]
    return table
