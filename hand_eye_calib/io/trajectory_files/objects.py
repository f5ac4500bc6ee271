"""Trajectories from the objects of other libraries, recognised by what they have; none of these
libraries is imported.
"""

from array import array
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.config import STAMP_UNITS
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.trajectory_files.columns import POSITION, QUATERNION, choose_columns, listed
from hand_eye_calib.io.trajectory_files.poses import poses_of, unit_by_size
from hand_eye_calib.io.trajectory_files.table import Table

_POSE = (*POSITION, *QUATERNION)
_NS_PER_S = 1_000_000_000
_KINDS = (
    "a path, a PoseTrajectory3D of evo, a DataFrame of pandas, a RigidTransform of SciPy, or an "
    "array (N, 4, 4), (N, 8) or (N, 7)"
)


class PathOfEvo(Protocol):
    """``evo.core.trajectory.PoseTrajectory3D``; a ``PosePath3D`` has no ``timestamps``."""

    positions_xyz: Any
    orientations_quat_wxyz: Any


class NamedColumns(Protocol):
    """``pandas.DataFrame``, or another table with named columns."""

    columns: Any

    def __getitem__(self, key: Any, /) -> Any: ...


class Transforms(Protocol):
    """``scipy.spatial.transform.RigidTransform`` of N transforms."""

    def as_matrix(self) -> Any: ...


PoseObject: TypeAlias = (
    Trajectory | PathOfEvo | NamedColumns | Transforms | np.ndarray | Sequence[Any]
)


class _Found(NamedTuple):
    """Matrices (N, 4, 4), or rows (N, 7) of position and quaternion, scalar last; stamps and their
    unit, sensor and world frame, and notes, as far as the object has them.
    """

    poses: FloatArray
    times: Any = None
    stamp_unit: str | None = None
    frames: tuple[str, str] = ("", "")
    notes: Sequence[str] = ()


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
    is_evo, is_table = hasattr(source, "orientations_quat_wxyz"), hasattr(source, "columns")
    if columns and (is_evo or not (is_table or np.ndim(source) == 2)):  # type: ignore[arg-type]
        raise ConfigError("columns are named for tables and for arrays of rows only")
    names = [name.strip() for name in columns.split(",")] if columns is not None else None
    if is_evo:
        found = _of_evo(source)
    elif hasattr(source, "as_matrix"):
        found = _Found(np.asarray(source.as_matrix(), dtype=float))
    elif is_table:
        found = _of_table(source, names, times is None)
    else:
        found = _of_array(source, names, times is None)
    if times is None and found.times is None:
        raise InputError("the poses have no stamps: give them with `times`, in seconds")
    unit = stamp_unit or found.stamp_unit
    stamps_ns, poses = to_nanoseconds(found.times if times is None else times, unit), found.poses
    if poses.ndim not in (2, 3) or len(stamps_ns) != len(poses):
        raise InputError(
            f"there must be one stamp per pose; found {len(stamps_ns)} stamps and poses of shape "
            f"{poses.shape}"
        )
    notes = [*found.notes]
    if repair and not (np.diff(stamps_ns) > 0).all():
        keep = np.unique(stamps_ns, return_index=True)[1]
        n_repeated = len(stamps_ns) - len(keep)
        notes.append(f"poses were sorted by time; {n_repeated} repeated ones dropped")
        stamps_ns, poses = stamps_ns[keep], poses[keep]
    if poses.shape[1:] == (4, 4):
        return Trajectory(stamps_ns, poses, *found.frames), notes
    parts = poses[:, :3], poses[:, 3:]
    return Trajectory.from_quat_xyzw(stamps_ns, *parts, *found.frames), notes


def _of_evo(source: Any) -> _Found:
    quats_xyzw = np.roll(np.asarray(source.orientations_quat_wxyz, dtype=float), -1, axis=1)
    poses = np.hstack([np.asarray(source.positions_xyz, dtype=float), quats_xyzw])
    meta = getattr(source, "meta", {})
    frames = (str(meta.get("child_frame_id") or ""), str(meta.get("frame_id") or ""))
    return _Found(poses, getattr(source, "timestamps", None), frames=frames)


def _of_table(source: Any, names: list[str] | None, needs_times: bool) -> _Found:
    """Of a table; an index of times counts as a column of stamps."""
    own = [str(name) for name in source.columns]
    names = own if names is None else names
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
    poses = np.hstack(poses_of(table))
    times, unit = index if is_indexed else None, None
    if len(chosen.stamp) == 2:
        secs, nsecs = (np.asarray(cells[at], np.int64) for at in chosen.stamp)
        times, unit = secs * _NS_PER_S + nsecs, "ns"
    elif chosen.stamp:
        times, unit = np.asarray(cells[chosen.stamp[0]]), chosen.stamp_unit or None
    return _Found(poses, times, unit, notes=table.guesses)


def _of_array(source: Any, names: list[str] | None, needs_times: bool) -> _Found:
    try:
        values = np.asarray(source, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"expected {_KINDS}; found {type(source).__name__}") from None
    if values.ndim == 3 and values.shape[1:] == (4, 4):
        return _Found(values)
    wanted = ("t", *_POSE) if needs_times else _POSE
    order = [*wanted] if names is None else names
    if values.ndim != 2 or values.shape[1] != len(order) or not {*wanted} <= {*order}:
        raise InputError(
            f"expected {_KINDS}; found an array {values.shape}. Rows are t,x,y,z,qx,qy,qz,qw, "
            "without t if there are `times`; another order is named with `columns`"
        )
    rows = values[:, [order.index(name) for name in _POSE]]
    return _Found(rows, values[:, order.index("t")] if needs_times else None)


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
