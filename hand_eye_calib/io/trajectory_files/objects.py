"""Trajectories from numbers in memory: arrays, tables, and whatever has such."""

from collections.abc import Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.config import STAMP_UNITS
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.trajectory_files.columns import POSITION, QUATERNION
from hand_eye_calib.io.trajectory_files.poses import sorted_stamps, unit_by_size
from hand_eye_calib.io.trajectory_files.table import check_stamp_unit

_POSE = (*POSITION, *QUATERNION)
_KINDS = "a path, an array (N, 4, 4), (N, 8) or (N, 7), or a table with named columns"


class NamedColumns(Protocol):
    """``pandas.DataFrame``, or another table with named columns."""

    columns: Any

    def __getitem__(self, key: Any, /) -> Any: ...


PoseObject: TypeAlias = Trajectory | NamedColumns | np.ndarray | Sequence[Any]


def trajectory_from_object(
    source: PoseObject,
    times: ArrayLike | None = None,
    stamp_unit: str | None = None,
    repair: bool = False,
) -> tuple[Trajectory, list[str]]:
    """The poses of an object, and what a person should know; see ``read_trajectory``.

    Raises
    ------
    InputError
        If it is no such object, or its poses cannot be used.
    ConfigError
        If options do not go together.
    """
    if isinstance(source, Trajectory):
        if times is not None or stamp_unit:
            raise ConfigError("a Trajectory has stamps and poses already: give no other option")
        return source, []
    values, own_times = _numbers(source, ["t", *_POSE] if times is None else [*_POSE])
    times = own_times if times is None else times
    if times is None:
        raise InputError("the poses have no stamps: give them with `times`, in seconds")
    stamps_ns, notes = to_nanoseconds(times, stamp_unit), list[str]()
    if len(stamps_ns) != len(values):
        raise InputError(
            f"there must be one stamp per pose; found {len(stamps_ns)} stamps and poses of shape "
            f"{values.shape}"
        )
    if repair and not (np.diff(stamps_ns) > 0).all():
        keep, repairs = sorted_stamps(stamps_ns)
        notes.append(repairs)
        stamps_ns, values = stamps_ns[keep], values[keep]
    if values.ndim == 3:
        return Trajectory(stamps_ns, values), notes
    return Trajectory.from_quat_xyzw(stamps_ns, values[:, :3], values[:, 3:]), notes


def _numbers(source: Any, names: list[str]) -> tuple[FloatArray, Any]:
    """Matrices (N, 4, 4), or rows (N, 7) of position and quaternion, and the stamps that stand
    beside them in a column t.
    """
    if hasattr(source, "columns"):
        cells = {str(key): np.asarray(source[key]) for key in source.columns}
        if missing := {*names} - cells.keys():
            raise InputError(
                f"expected {_KINDS}; the columns lack {', '.join(sorted(missing))} of "
                f"{', '.join(names)}; give the stamps with `times` if they are elsewhere"
            )
        return np.stack([cells[name] for name in _POSE], axis=1).astype(float), cells.get("t")
    try:
        values = np.asarray(source, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"expected {_KINDS}; found {type(source).__name__}") from None
    if values.ndim == 2 and values.shape[1] == len(names):
        return values[:, -len(_POSE) :], values[:, 0] if "t" in names else None
    if values.shape[1:] != (4, 4):
        raise InputError(
            f"expected {_KINDS}: rows are of {', '.join(names)}; found an array {values.shape}"
        )
    return values, None


def to_nanoseconds(times: Any, stamp_unit: str | None = None) -> IntArray:
    """Stamps (N,) in nanoseconds from datetimes, or from numbers in ``stamp_unit``: if left out,
    seconds, and for whole numbers as their size tells.

    Raises
    ------
    InputError
        If they are no such numbers.
    ConfigError
        For a unit that is not known.
    """
    check_stamp_unit(stamp_unit)
    if getattr(getattr(times, "dtype", None), "tz", None) is not None:
        times = np.asarray(times, dtype="datetime64[ns]")
    stamps = np.asarray(times)
    if stamps.dtype.kind == "M":
        return np.asarray(stamps.astype("datetime64[ns]").astype(np.int64))
    if stamps.dtype.kind not in "iuf" or stamps.ndim != 1 or not np.isfinite(stamps).all():
        raise InputError(
            f"stamps must be one-dimensional finite numbers or datetimes; found {stamps.dtype} of "
            f"shape {stamps.shape}"
        )
    whole = np.floor(stamps) if stamps.dtype.kind == "f" else stamps
    largest = float(np.abs(stamps).max(initial=0))
    # Stamps with a fraction are in seconds.
    by_size = unit_by_size(largest) if (stamps == whole).all() else "s"
    factor = STAMP_UNITS[stamp_unit or by_size]
    if largest > np.iinfo(np.int64).max / factor:
        raise InputError("stamps are too large for their unit; name it with `stamp_unit`")
    # The fraction by itself, so that no digit of an epoch second is lost.
    fraction_ns = np.rint((stamps - whole) * factor).astype(np.int64)
    return np.asarray(whole.astype(np.int64) * factor + fraction_ns)
