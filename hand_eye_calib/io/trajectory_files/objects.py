"""Trajectories from the objects of other libraries, recognised by what they have; none of these
libraries is imported.
"""

from array import array
from collections.abc import Iterable, Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.config import STAMP_UNITS
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.trajectory_files.columns import QUATERNION, choose_columns, listed
from hand_eye_calib.io.trajectory_files.poses import poses_of, unit_by_size
from hand_eye_calib.io.trajectory_files.table import Table

_POSE = ("x", "y", "z", *QUATERNION)
_NS_PER_S = 1_000_000_000
_KINDS = (
    "a path, a PoseTrajectory3D of evo, a DataFrame of pandas, a RigidTransform of SciPy, or an "
    "array (N, 4, 4), (N, 8) or (N, 7)"
)


class PathOfEvo(Protocol):
    """``evo.core.trajectory.PoseTrajectory3D``; a ``PosePath3D`` has no ``timestamps``."""

    @property
    def positions_xyz(self) -> Any: ...

    @property
    def orientations_quat_wxyz(self) -> Any: ...


class NamedColumns(Protocol):
    """``pandas.DataFrame``, or another table with named columns."""

    @property
    def columns(self) -> Iterable[Any]: ...

    def __getitem__(self, key: Any, /) -> Any: ...


class Transforms(Protocol):
    """``scipy.spatial.transform.RigidTransform`` of N transforms."""

    def as_matrix(self) -> Any: ...


PoseObject: TypeAlias = (
    Trajectory | PathOfEvo | NamedColumns | Transforms | np.ndarray | Sequence[Any]
)


def trajectory_from_object(
    source: PoseObject,
    times: ArrayLike | None = None,
    columns: str | None = None,
    stamp_unit: str | None = None,
    repair: bool = False,
) -> tuple[Trajectory, list[str]]:
    """The poses of an object as a Trajectory, and what a person should know as a list of str; see
    :func:`hand_eye_calib.read_trajectory`.

    Raises
    ------
    InputError
        If it is no such object, or its poses cannot be used.
    ConfigError
        If options do not go together.
    """
    if isinstance(source, Trajectory):
        if times is not None or columns or stamp_unit:
            raise ConfigError("a Trajectory has stamps and poses already: give no other option")
        return source, []
    if columns and not (hasattr(source, "columns") or _is_rows(source)):
        raise ConfigError("columns are named for tables and for arrays of rows only")
    own_times: Any = None
    frames, notes = ("", ""), list[str]()
    if hasattr(source, "orientations_quat_wxyz"):
        values, own_times, frames = _of_evo(source)
    elif hasattr(source, "as_matrix"):
        values = np.asarray(source.as_matrix(), dtype=float)
    elif hasattr(source, "columns"):
        values, own_times, stamp_unit, notes = _of_table(source, columns, times is None, stamp_unit)
    else:
        values, own_times = _of_array(source, columns, times is None)
    if times is None and own_times is None:
        raise InputError("the poses have no stamps: give them with `times`, in seconds")
    stamps_ns = to_nanoseconds(own_times if times is None else times, stamp_unit)
    if values.ndim not in (2, 3) or len(stamps_ns) != len(values):
        raise InputError(
            f"there must be one stamp per pose; found {len(stamps_ns)} stamps and poses of shape "
            f"{values.shape}"
        )
    keep, repairs = _in_order(stamps_ns, repair)
    return _trajectory(stamps_ns[keep], values[keep], frames), notes + repairs


def _trajectory(stamps_ns: IntArray, values: FloatArray, frames: tuple[str, str]) -> Trajectory:
    """Of matrices (N, 4, 4), or rows (N, 7) of position and quaternion, scalar last."""
    if values.shape[1:] == (4, 4):
        return Trajectory(stamps_ns, values, *frames)
    return Trajectory.from_quat_xyzw(stamps_ns, values[:, :3], values[:, 3:], *frames)


def _of_evo(source: Any) -> tuple[FloatArray, Any, tuple[str, str]]:
    quats_xyzw = np.roll(np.asarray(source.orientations_quat_wxyz, dtype=float), -1, axis=1)
    values = np.hstack([np.asarray(source.positions_xyz, dtype=float), quats_xyzw])
    meta = getattr(source, "meta", {})
    frames = (str(meta.get("child_frame_id") or ""), str(meta.get("frame_id") or ""))
    return values, getattr(source, "timestamps", None), frames


def _of_table(
    source: Any, columns: str | None, needs_times: bool, stamp_unit: str | None
) -> tuple[FloatArray, Any, str | None, list[str]]:
    """Poses, stamps, their unit, and notes; an index of times counts as a column of them."""
    own = [str(name) for name in source.columns]
    names = own if columns is None else [name.strip() for name in columns.split(",")]
    if len(names) != len(own):
        raise InputError(f"{len(names)} columns are named; the table has {len(own)}")
    index = getattr(source, "index", None)
    is_indexed = getattr(getattr(index, "dtype", None), "kind", "") == "M"
    chosen = choose_columns("the table", names, has_stamps=needs_times and not is_indexed)
    cells = [source[key] for key in source.columns]
    numbers = [np.asarray(cells[at], float) for at in chosen.quantities.values()]
    table = Table(
        "the table",
        f"{len(names)} columns: {listed(names)}",
        tuple(chosen.quantities),
        units=chosen.units,
        line_numbers=array("q", range(len(cells[0]))),
        numbers=array("d", np.stack(numbers, axis=1).tobytes()),
    )
    values = np.hstack(poses_of(table))
    if not chosen.stamp:
        return values, index, stamp_unit, table.guesses
    if len(chosen.stamp) == 2:
        seconds, rest = (np.asarray(cells[at], np.int64) for at in chosen.stamp)
        return values, seconds * _NS_PER_S + rest, "ns", table.guesses
    stamps = np.asarray(cells[chosen.stamp[0]])
    return values, stamps, stamp_unit or chosen.stamp_unit or None, table.guesses


def _is_rows(source: Any) -> bool:
    return not hasattr(source, "orientations_quat_wxyz") and np.ndim(source) == 2


def _of_array(source: Any, columns: str | None, needs_times: bool) -> tuple[FloatArray, Any]:
    try:
        values = np.asarray(source, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"expected {_KINDS}; found {type(source).__name__}") from None
    if values.ndim == 3 and values.shape[1:] == (4, 4):
        return values, None
    wanted = ("t", *_POSE) if needs_times else _POSE
    order = [*wanted] if columns is None else [name.strip() for name in columns.split(",")]
    if values.ndim != 2 or values.shape[1] != len(order) or not {*wanted} <= {*order}:
        raise InputError(
            f"expected {_KINDS}; found an array {values.shape}. Rows are t,x,y,z,qx,qy,qz,qw, "
            "without t if there are `times`; another order is named with `columns`"
        )
    rows = values[:, [order.index(name) for name in _POSE]]
    return rows, values[:, order.index("t")] if needs_times else None


def to_nanoseconds(times: Any, stamp_unit: str | None = None) -> IntArray:
    """Stamps (N,) in nanoseconds from numbers or from datetimes.

    Parameters
    ----------
    times : (N,) array-like
        datetime64, or numbers in ``stamp_unit``.
    stamp_unit : str, optional
        "s", "ms", "us" or "ns"; if left out, seconds, and for whole numbers as their size tells.

    Raises
    ------
    InputError
        If they are no such numbers.
    ConfigError
        For a unit that is not known.
    """
    if stamp_unit is not None and stamp_unit not in STAMP_UNITS:
        raise ConfigError(
            f"unknown unit of stamps {stamp_unit!r}; known are {', '.join(STAMP_UNITS)}"
        )
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
    factor = STAMP_UNITS[stamp_unit or _unit_of(stamps)]
    if len(stamps) and np.abs(stamps).max() > np.iinfo(np.int64).max / factor:
        raise InputError("stamps are too large for their unit; name it with `stamp_unit`")
    if stamps.dtype.kind != "f":
        return np.asarray(stamps.astype(np.int64) * factor)
    whole = np.floor(stamps)
    # The fraction by itself, so that no digit of an epoch second is lost.
    fraction_ns = np.rint((stamps - whole) * factor).astype(np.int64)
    return np.asarray(whole.astype(np.int64) * factor + fraction_ns)


def _unit_of(stamps: Any) -> str:
    """Of whole numbers by their size; others are seconds."""
    if stamps.dtype.kind == "f" and (stamps != np.floor(stamps)).any():
        return "s"
    return unit_by_size(float(np.abs(stamps).max(initial=0)))


def _in_order(stamps_ns: IntArray, repair: bool) -> tuple[Any, list[str]]:
    """Which poses to keep: all, or with ``repair`` one per stamp in the order of time."""
    if not repair or (np.diff(stamps_ns) > 0).all():
        return slice(None), []
    keep = np.unique(stamps_ns, return_index=True)[1]
    return keep, [f"poses were sorted by time; {len(stamps_ns) - len(keep)} repeated ones dropped"]
