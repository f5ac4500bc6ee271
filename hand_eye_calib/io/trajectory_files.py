"""Trajectories in text files.

tum
    ``timestamp tx ty tz qx qy qz qw``, separated by white space.
kitti
    The first three rows of the pose's matrix, 12 values. The stamps, one a line, are in a file of
    their own.
euroc
    ``timestamp, px, py, pz, qw, qx, qy, qz, ...``, in nanoseconds. What follows (velocities,
    biases) is ignored.
csv
    Columns found by the names in the header, or named by ``columns``; separated by commas,
    semicolons or white space.

Lines that start with ``#`` and empty lines are skipped, but a csv file's header may start with
``#``. Lengths are in metres. The unit of the stamps is recognised from their size. The order of a
quaternion's values is the format's or is named, never guessed.
"""

import csv
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.config import STAMP_UNITS
from hand_eye_calib.config import TRAJECTORY_FORMATS as FORMATS
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import (
    QUATERNION_NORM_TOLERANCE,
    ROTATION_TOLERANCE,
    Trajectory,
)
from hand_eye_calib.io.files import read_text, write_atomically
from hand_eye_calib.io.limits import LARGEST_TEXT, LONGEST_LINE, MOST_COLUMNS
from hand_eye_calib.io.plausibility import check_positions

_Path = str | Path

_TUM_COLUMNS = "timestamp tx ty tz qx qy qz qw"
_EUROC_COLUMNS = "timestamp, px, py, pz, qw, qx, qy, qz"
_POSE_NAMES = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_NS_PER_S = 1_000_000_000
_LARGEST_NS = int(np.iinfo(np.int64).max)

# The largest stamp of a file decides: seconds since 1970 have ten digits, and each smaller unit
# three more.
_SMALLEST_OF_UNIT = {
    "ns": Decimal(10) ** 17,
    "us": Decimal(10) ** 14,
    "ms": Decimal(10) ** 11,
    "s": Decimal(0),
}
# Poses farther apart than this are of no use to a calibration: rather the unit has been mistaken.
_LONGEST_INTERVAL_S = 10

# Characters of a line or value that a message shows.
_MOST_SHOWN = 120
# Columns that a message lists.
_MOST_LISTED = 15

# Last parts of column names, lower case, words joined by underscores; exports of bags have whole
# paths such as .pose.pose.position.x.
_ALIASES = {
    "t": ("t", "time", "timestamp", "timestamps", "stamp", "gpstime", "header_stamp"),
    "x": ("x", "tx", "px", "p_x", "pos_x", "position_x", "translation_x", "p_rs_r_x", "easting"),
    "y": ("y", "ty", "py", "p_y", "pos_y", "position_y", "translation_y", "p_rs_r_y", "northing"),
    "z": ("z", "tz", "pz", "p_z", "pos_z", "position_z", "translation_z", "p_rs_r_z", "altitude"),
    "secs": ("header_stamp_secs", "header_stamp_sec", "stamp_secs", "stamp_sec", "secs", "sec"),
    "nsecs": (
        *("header_stamp_nsecs", "header_stamp_nanosec", "stamp_nsecs", "stamp_nanosec"),
        *("nsecs", "nanosec"),
    ),
}
_QUATERNION_NAMES = (
    "q",
    "q_",
    "quat_",
    "quaternion_",
    "rot_",
    "orientation_",
    "rotation_",
    "q_rs_",
)
_ALIASES |= {f"q{axis}": tuple(name + axis for name in _QUATERNION_NAMES) for axis in "xyzw"}


def read_trajectory(
    path: _Path,
    format: str = "tum",
    *,
    topic: str | None = None,
    tf: str | None = None,
    columns: str | None = None,
    times: _Path | None = None,
    stamp_unit: str | None = None,
    repair: bool = False,
) -> Trajectory:
    """Read a trajectory from a text file, or from a bag if ``topic`` or ``tf`` is given.

    Parameters
    ----------
    path : str or path-like
    format : str
        "tum", "kitti", "euroc" or "csv"; see the module's table.
    topic : str, optional
        Of a bag: the topic of the poses. No other option goes with it.
    tf : str, optional
        Of a bag: the two frames, ``world:sensor``, whose transform is the trajectory, from ``/tf``
        and ``/tf_static``.
    columns : str, optional
        For csv without a header: the columns' names, such as ``"t,x,y,z,qw,qx,qy,qz"``. Other names
        are columns to skip.
    times : str or path-like, optional
        For kitti: the file of the stamps.
    stamp_unit : str, optional
        "s", "ms", "us" or "ns"; if left out, recognised from the stamps' size or taken from the
        header (``timestamp [ns]``).
    repair : bool
        Sort poses that are out of order and drop those with a stamp that is there already, with a
        ``UserWarning`` that says how many; otherwise they are an error.

    Returns
    -------
    Trajectory
        Stamps are exactly the decimal numbers of the file, in nanoseconds; frame names are empty,
        from a bag those of the messages.

    Raises
    ------
    InputError
        If the file cannot be read or a line cannot be used; the message names file, line and what
        was found.
    ConfigError
        For a format or unit that is not known, and options that do not go together.
    """
    if topic or tf:
        if (format, columns, times, stamp_unit, repair) != ("tum", None, None, None, False) or (
            topic and tf
        ):
            raise ConfigError(
                "topic and tf are for bags: give one of them and none of the options of text files"
            )
        from hand_eye_calib.io.bags import read_bag_trajectory

        trajectory, notes = read_bag_trajectory(path, topic, tf)
    else:
        trajectory, notes = read_trajectory_file(path, format, columns, times, stamp_unit, repair)
    for text in notes:
        warnings.warn(text, UserWarning, stacklevel=2)
    return trajectory


def read_trajectory_file(
    path: _Path,
    format: str = "tum",
    columns: str | None = None,
    times: _Path | None = None,
    stamp_unit: str | None = None,
    repair: bool = False,
) -> tuple[Trajectory, list[str]]:
    """Read a text file as :func:`read_trajectory`, and return what a person should know as a list
    of str.
    """
    if stamp_unit is not None and stamp_unit not in STAMP_UNITS:
        raise ConfigError(
            f"unknown unit of stamps {stamp_unit!r}; known are {', '.join(STAMP_UNITS)}"
        )
    if format not in FORMATS:
        raise ConfigError(f"unknown trajectory format {format!r}; known are {', '.join(FORMATS)}")
    if columns is not None and format != "csv":
        raise ConfigError(f"columns are named for format csv only; the format is {format}")
    if times is not None and format != "kitti":
        raise ConfigError(f"a file of times belongs to format kitti only; the format is {format}")
    table = _table(path, format, columns, times)
    if not table.stamps:
        raise InputError(f"{path}: no poses in it; expected lines of {table.expected}")
    stamps_ns = _to_ns(path, table, stamp_unit)
    positions, quats_xyzw = _poses(path, table)
    keep, notes = _ordered(path, table, stamps_ns, repair)
    return Trajectory.from_quat_xyzw(stamps_ns[keep], positions[keep], quats_xyzw[keep]), notes


def _table(path: _Path, format: str, columns: str | None, times: _Path | None) -> "_Table":
    if format == "csv":
        return _read_csv(path, columns)
    if format == "kitti":
        return _read_kitti(path, times)
    return _read_tum(path) if format == "tum" else _read_euroc(path)


def write_trajectory(path: _Path, trajectory: Trajectory, format: str = "tum") -> None:
    """Write a trajectory to a file, replacing it if it exists. Reading it back gives the same
    stamps and poses.

    Parameters
    ----------
    path : str or path-like
    trajectory : Trajectory
    format : str
        "tum".

    Raises
    ------
    InputError
        If the file cannot be written.
    ConfigError
        For any other format.
    """
    if format != "tum":
        raise ConfigError(f"trajectories are written in format tum; got {format!r}")
    try:
        write_atomically({Path(path): _tum_text(trajectory)})
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None


@dataclass
class _Table:
    """The lines of a file: stamps and values row by row, the values in the format's own order.

    ``stamps`` are Decimal in ``unit``, or in a unit to be recognised if that is empty.
    """

    expected: str
    unit: str = ""
    matrices: bool = False
    line_numbers: list[int] = field(default_factory=list)
    stamps: list[Decimal] = field(default_factory=list)
    values: list[list[float]] = field(default_factory=list)


# ---- formats


def _read_tum(path: _Path) -> _Table:
    table = _Table(f"8 numbers, {_TUM_COLUMNS}")
    for number, line in _data_lines(path, table.expected):
        fields = line.split()
        if len(fields) != 8:
            raise _unexpected(path, number, table.expected, line, len(fields))
        _add(path, table, number, fields[0], fields[1:])
    return table


def _read_euroc(path: _Path) -> _Table:
    table = _Table(_EUROC_COLUMNS, unit="ns")
    for number, line in _data_lines(path, table.expected):
        fields = [cell.strip() for cell in line.split(",")]
        if len(fields) < 8:
            raise _unexpected(
                path, number, f"8 numbers or more, {table.expected}", line, len(fields)
            )
        qw, qx, qy, qz = fields[4:8]
        _add(path, table, number, fields[0], [*fields[1:4], qx, qy, qz, qw])
    return table


def _read_kitti(path: _Path, times: _Path | None) -> _Table:
    table = _Table("12 numbers, the first three rows of a pose", matrices=True)
    if times is None:
        raise ConfigError(
            f"{path}: the poses of format kitti have no stamps; name their file with `times`"
        )
    stamps = list(_data_lines(times, "stamps"))
    for index, (number, line) in enumerate(_data_lines(path, table.expected)):
        fields = line.split()
        if len(fields) != 12:
            raise _unexpected(path, number, table.expected, line, len(fields))
        _add(path, table, number, stamps[index][1].strip() if index < len(stamps) else "0", fields)
    if len(stamps) != len(table.values):
        raise InputError(
            f"{path}: {len(table.values)} poses, but {times} has {len(stamps)} stamps; they belong "
            "to different recordings"
        )
    return table


def _read_csv(path: _Path, columns: str | None) -> _Table:
    lines = [
        (number, line)
        for number, line in enumerate(_lines(path, "a table"), start=1)
        if line.strip()
    ]
    if columns is None:
        names, lines = _header(path, lines)
    else:
        names = [name.strip() for name in columns.split(",")]
    if len(names) > MOST_COLUMNS:
        raise InputError(f"{path}: {len(names)} columns; at most {MOST_COLUMNS} are read")
    lines = [(number, line) for number, line in lines if not line.lstrip().startswith("#")]
    chosen = _choose(path, names)
    unit = _unit_in(names[chosen["t"]]) if "t" in chosen else "ns"
    table = _Table(f"{len(names)} columns: {_listed(names)}", unit=unit)
    for number, line in lines:
        cells = _cells(line)
        if len(cells) != len(names):
            raise _unexpected(path, number, table.expected, line, len(cells))
        row = {name: cells[index] for name, index in chosen.items()}
        stamp = row["t"] if "t" in row else _joined(path, number, row["secs"], row["nsecs"])
        _add(path, table, number, stamp, [row[name] for name in _POSE_NAMES[1:]])
    return table


def _header(path: _Path, lines: list[tuple[int, str]]) -> tuple[list[str], list[tuple[int, str]]]:
    """Names in the first line, and the lines after it."""
    if not lines:
        return list(_POSE_NAMES), []
    names = _cells(lines[0][1].lstrip().lstrip("#"))
    if all(_is_number(name) for name in names if name):
        raise InputError(
            f"{path}: the first line names no columns, so the order of the quaternion is unknown; "
            "name them with `columns`, such as t,x,y,z,qx,qy,qz,qw; there are "
            f"{len(names)}"
        )
    return names, lines[1:]


def _choose(path: _Path, names: list[str]) -> dict[str, int]:
    """Index of the column of the stamp and of each value of the pose."""
    plain = [_plain(name) for name in names]
    chosen = {}
    for wanted, aliases in _ALIASES.items():
        found = _matching(plain, aliases)
        if len(found) > 1:
            raise InputError(
                f"{path}: columns {_listed([names[index] for index in found])} could all be "
                f"{wanted}; name them with `columns`"
            )
        if found:
            chosen[wanted] = found[0]
    needed = set(_POSE_NAMES)
    if {"secs", "nsecs"} <= chosen.keys():
        # The stamp of the message's header rather than the time of its arrival.
        needed = needed - {"t"} | {"secs", "nsecs"}
    missing = [name for name in _POSE_NAMES if name in needed - chosen.keys()]
    if missing:
        raise InputError(
            f"{path}: no column for {', '.join(missing)} among {_listed(names)}; name all columns "
            "with `columns`, such as t,x,y,z,qw,qx,qy,qz"
        )
    return {name: index for name, index in chosen.items() if name in needed}


def _matching(plain: list[str], aliases: Sequence[str]) -> list[int]:
    """Columns of one of these names; if there is none, of paths that end in one."""
    # Of paths, the longest end that is known: position_x rather than x.
    ends = tuple(f"_{alias}" for alias in aliases if "_" in alias)
    return [index for index, name in enumerate(plain) if name in aliases] or [
        index for index, name in enumerate(plain) if name.endswith(ends)
    ]


def _listed(names: list[str]) -> str:
    """Names of columns for a message, which must not grow with the file."""
    text = ", ".join(name[:_MOST_SHOWN] for name in names[:_MOST_LISTED])
    return text if len(names) <= _MOST_LISTED else f"{text} and {len(names) - _MOST_LISTED} more"


def _plain(name: str) -> str:
    """A column's name without its unit: ``.pose.position.x [m]`` to ``pose_position_x``."""
    name = re.sub(r"\[.*?\]|\(.*?\)", "", name).strip().lower()
    name = re.sub(r"[^a-z0-9]+", "_", name).strip("_")
    return re.sub(r"_(s|ms|us|ns)$", "", name) if name.startswith(("t_", "time", "stamp")) else name


def _unit_in(name: str) -> str:
    """Unit of the stamps in a column's name, empty if it has none."""
    found = re.search(
        r"[\[(]\s*(s|ms|us|ns)\s*[\])]\s*$|^\W*(?:t|time|timestamp|stamp)_(s|ms|us|ns)$",
        name.strip().lower(),
    )
    return (found[1] or found[2]) if found else ""


def _cells(line: str) -> list[str]:
    if "," not in line and ";" not in line:
        return line.split()
    reader = csv.reader([line], delimiter="," if "," in line else ";", skipinitialspace=True)
    return [cell.strip() for cell in next(reader)]


def _joined(path: _Path, number: int, secs: str, nsecs: str) -> str:
    """Nanoseconds of a stamp in two columns."""
    if not (re.fullmatch(r"-?\d{1,18}", secs) and re.fullmatch(r"\d{1,9}", nsecs)):
        raise InputError(
            f"{path}, line {number}: expected whole seconds and nanoseconds; found "
            f"{secs[:40]!r} and {nsecs[:40]!r}"
        )
    return str(int(secs) * _NS_PER_S + int(nsecs))


# ---- lines and numbers


def _lines(path: _Path, expected: str) -> list[str]:
    lines = read_text(path, f"lines of {expected}", LARGEST_TEXT).splitlines()
    for number, line in enumerate(lines, start=1):
        if len(line) > LONGEST_LINE:
            raise InputError(f"{path}, line {number}: longer than {LONGEST_LINE} characters")
    return lines


def _data_lines(path: _Path, expected: str) -> Iterator[tuple[int, str]]:
    """Line numbers, from 1, and lines that are neither empty nor comments."""
    for number, line in enumerate(_lines(path, expected), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            yield number, line


def _unexpected(path: _Path, number: int, expected: str, line: str, found: int) -> InputError:
    shortened = line if len(line) <= 60 else line[:60] + "..."
    return InputError(f"{path}, line {number}: expected {expected}; found {found}: {shortened!r}")


def _add(path: _Path, table: _Table, number: int, stamp: str, values: Sequence[str]) -> None:
    try:
        table.stamps.append(_decimal(stamp))
        table.values.append([float(value) for value in values])
    except ValueError as error:
        reason = str(error)[:_MOST_SHOWN]
        raise InputError(f"{path}, line {number}: expected {table.expected}; {reason}") from None
    table.line_numbers.append(number)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _decimal(text: str) -> Decimal:
    """A stamp as it is written, with no binary floating point in between."""
    try:
        stamp = Decimal(text)
    except InvalidOperation:
        stamp = Decimal("nan")
    if not stamp.is_finite() or stamp.adjusted() > 30:
        raise ValueError(f"found {text!r} for the timestamp")
    return stamp


def _to_ns(path: _Path, table: _Table, stamp_unit: str | None) -> IntArray:
    """Stamps in nanoseconds, in the unit that is given, that the format has, or that their size
    tells.
    """
    unit = stamp_unit or table.unit
    largest = max(map(abs, table.stamps))
    recognised = unit or next(
        unit for unit, smallest in _SMALLEST_OF_UNIT.items() if largest >= smallest
    )
    if largest > Decimal(_LARGEST_NS) / STAMP_UNITS[recognised]:
        index = max(range(len(table.stamps)), key=lambda index: abs(table.stamps[index]))
        raise InputError(
            f"{path}, line {table.line_numbers[index]}: the timestamp {table.stamps[index]:.6g} is "
            f"too large for {recognised}; name its unit with `stamp_unit`"
        )
    stamps_ns = np.array(
        [int((stamp * STAMP_UNITS[recognised]).to_integral_value()) for stamp in table.stamps],
        dtype=np.int64,
    )
    # Stamps with a fraction are in seconds.
    is_whole = all(stamp == stamp.to_integral_value() for stamp in table.stamps)
    interval_s = _median_interval_s(stamps_ns)
    if not unit and is_whole and interval_s > _LONGEST_INTERVAL_S:
        raise InputError(
            f"{path}: the unit of the timestamps is unclear; read as {recognised}, the poses are "
            f"{interval_s:.4g} s apart; name it with `stamp_unit`: s, ms, us or ns"
        )
    return stamps_ns


def _median_interval_s(stamps_ns: IntArray) -> float:
    if len(stamps_ns) < 2:
        return 0.0
    return float(np.median(np.abs(np.diff(stamps_ns.astype(float))))) * 1e-9


def _poses(path: _Path, table: _Table) -> tuple[FloatArray, FloatArray]:
    """Positions (N, 3) and quaternions (N, 4), scalar last; every refusal names the line."""
    values = np.array(table.values)
    _refuse(
        path,
        table,
        ~np.isfinite(values).all(axis=1),
        lambda _: "found a value that is not finite; remove the line or repair its source",
    )
    if table.matrices:
        matrices = values.reshape(-1, 3, 4)
        positions, quats_xyzw = matrices[:, :, 3], _from_matrices(path, table, matrices[:, :, :3])
    else:
        positions, quats_xyzw = values[:, :3], values[:, 3:]
        _check_quaternions(path, table, quats_xyzw)
    try:
        check_positions(positions)
    except InputError as error:
        line = table.line_numbers[getattr(error, "index", 0)]
        raise InputError(f"{path}, line {line}: {error}; check its unit") from None
    return positions, quats_xyzw


def _refuse(path: _Path, table: _Table, wrong: BoolArray, message: Callable[[int], str]) -> None:
    """Raise an error at the first wrong row."""
    index = int(np.argmax(wrong))
    if wrong[index]:
        raise InputError(f"{path}, line {table.line_numbers[index]}: {message(index)}")


def _from_matrices(path: _Path, table: _Table, rotations: FloatArray) -> FloatArray:
    """Quaternions (N, 4), scalar last, of the nearest rotations: files have few digits."""
    with np.errstate(over="ignore", invalid="ignore"):
        wrong = ~_is_rotation(rotations)
    _refuse(
        path,
        table,
        wrong,
        lambda _: (
            f"the 3x3 part is not a rotation matrix within {ROTATION_TOLERANCE}; check the order "
            "of the values"
        ),
    )
    left, _, right = np.linalg.svd(rotations)
    return se3.to_quat_xyzw(left @ right)


def _check_quaternions(path: _Path, table: _Table, quats_xyzw: FloatArray) -> None:
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(quats_xyzw, axis=1)
    _refuse(
        path,
        table,
        np.abs(norms - 1.0) > QUATERNION_NORM_TOLERANCE,
        lambda index: (
            f"found a quaternion of length {norms[index]:.4g}, expected 1 within "
            f"{QUATERNION_NORM_TOLERANCE}; check the column order ({table.expected})"
        ),
    )


def _is_rotation(matrices: FloatArray) -> BoolArray:
    """Mask of the matrices (N, 3, 3) that are rotations within the tolerance."""
    products = np.swapaxes(matrices, 1, 2) @ matrices
    deviation = np.abs(products - np.eye(3)).max(axis=(1, 2))
    is_orthogonal = deviation <= ROTATION_TOLERANCE
    is_orthogonal[is_orthogonal] = np.linalg.det(matrices[is_orthogonal]) > 0
    return is_orthogonal


def _ordered(
    path: _Path, table: _Table, stamps_ns: IntArray, repair: bool
) -> tuple[IntArray, list[str]]:
    """Indices of the poses in the order of time, and what was repaired for that."""
    wrong = np.r_[False, stamps_ns[1:] <= stamps_ns[:-1]]
    if not wrong.any():
        return np.arange(len(stamps_ns)), []
    if not repair:
        index = int(np.argmax(wrong))
        raise InputError(
            f"{path}, line {table.line_numbers[index]}: timestamps must increase, found "
            f"{_seconds(stamps_ns[index])} after {_seconds(stamps_ns[index - 1])}; "
            f"{int(wrong.sum())} such lines; sort the lines and drop repeated timestamps, or have "
            "that done with `repair`"
        )
    order = np.argsort(stamps_ns, kind="stable")
    repeated = np.r_[False, stamps_ns[order][1:] == stamps_ns[order][:-1]]
    backward, n_repeated = int((stamps_ns[1:] < stamps_ns[:-1]).sum()), int(repeated.sum())
    repairs = (
        [f"stamps went back at {backward} of {len(stamps_ns)} poses, which were sorted"]
        if backward
        else []
    )
    repairs += [f"dropped {n_repeated} whose stamp was there already"] if n_repeated else []
    return order[~repeated], [f"{path}: {'; '.join(repairs)}"]


# ---- writing


def _tum_text(trajectory: Trajectory) -> str:
    quats_xyzw = se3.to_quat_xyzw(trajectory.poses)
    values = np.concatenate([trajectory.poses[:, :3, 3], quats_xyzw], axis=1).tolist()
    rows = zip(trajectory.stamps_ns.tolist(), values, strict=True)
    lines = [f"{_seconds(stamp)} {' '.join(map(repr, row))}" for stamp, row in rows]
    return "\n".join([f"# {_TUM_COLUMNS}", *lines, ""])


def _seconds(stamp_ns: int) -> str:
    seconds, nanoseconds = divmod(abs(int(stamp_ns)), _NS_PER_S)
    return f"{'-' if stamp_ns < 0 else ''}{seconds}.{nanoseconds:09d}"
