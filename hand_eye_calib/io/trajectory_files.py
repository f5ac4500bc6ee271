"""Trajectories in text files.

The TUM format has one pose a line, ``timestamp tx ty tz qx qy qz qw``: seconds, metres, scalar-last quaternion. Lines that
start with ``#`` and empty lines are skipped.
"""

from decimal import Decimal, InvalidOperation

import numpy as np

from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import QUATERNION_NORM_TOLERANCE, Trajectory

_TUM_COLUMNS = "timestamp tx ty tz qx qy qz qw"
_NS_PER_S = 1_000_000_000
_LARGEST_S = Decimal(int(np.iinfo(np.int64).max)) / _NS_PER_S


def read_trajectory(path, format="tum"):
    """Read a trajectory from a file.

    Parameters
    ----------
    path : str or path-like
    format : str
        "tum".

    Returns
    -------
    Trajectory
        Stamps are exactly the decimal numbers of the file, in nanoseconds; frame names are empty.

    Raises
    ------
    InputError
        Where the file cannot be read or a line cannot be used; the message names file, line and what was found.
    ConfigError
        For a format that is not known.
    """
    return _format(format)[0](path)


def write_trajectory(path, trajectory, format="tum"):
    """Write a trajectory to a file, replacing it where it exists; reading it back gives the same stamps and poses.

    Parameters
    ----------
    path : str or path-like
    trajectory : Trajectory
    format : str
        "tum".

    Raises
    ------
    InputError
        Where the file cannot be written.
    ConfigError
        For a format that is not known.
    """
    text = _format(format)[1](trajectory)
    try:
        with open(path, "w", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None


def _format(name):
    if name not in _FORMATS:
        raise ConfigError(f"unknown trajectory format {name!r}; known are {', '.join(_FORMATS)}")
    return _FORMATS[name]


def _read_tum(path):
    line_numbers, stamps_ns, values = [], [], []
    for number, line in enumerate(_lines(path), start=1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) != 8:
            raise InputError(
                f"{path}, line {number}: expected 8 numbers, {_TUM_COLUMNS}; found {len(fields)}: {_shortened(line)}"
            )
        try:
            stamps_ns.append(_nanoseconds(fields[0]))
            values.extend(map(float, fields[1:]))
        except ValueError as error:
            raise InputError(f"{path}, line {number}: expected 8 numbers, {_TUM_COLUMNS}; {error}") from None
        line_numbers.append(number)
    if not stamps_ns:
        raise InputError(f"{path}: no poses in it; expected lines of {_TUM_COLUMNS}")
    stamps_ns, values = np.array(stamps_ns, dtype=np.int64), np.array(values).reshape(-1, 7)
    _check(path, line_numbers, stamps_ns, values)
    return Trajectory.from_quat_xyzw(stamps_ns, values[:, :3], values[:, 3:])


def _lines(path):
    try:
        with open(path, encoding="utf-8-sig") as file:
            return file.read().splitlines()
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; expected lines of {_TUM_COLUMNS}") from None
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None


def _nanoseconds(text):
    """Seconds as decimal text to whole nanoseconds, with no binary floating point in between."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        seconds = Decimal("nan")
    if not seconds.is_finite():
        raise ValueError(f"found {text!r} for the timestamp")
    if not -_LARGEST_S <= seconds <= _LARGEST_S:
        raise ValueError(f"the timestamp must be in seconds, found {text!r}; divide milli-, micro- or nanoseconds first")
    return int((seconds * _NS_PER_S).to_integral_value())


def _check(path, line_numbers, stamps_ns, values):
    """What Trajectory would refuse too, but here the line in the file can be named."""

    def refuse(wrong, message):
        index = int(np.argmax(wrong))
        if wrong[index]:
            raise InputError(f"{path}, line {line_numbers[index]}: {message(index)}")

    refuse(
        ~np.isfinite(values).all(axis=1), lambda index: "found a value that is not finite; remove the line or repair its source"
    )
    norms = np.linalg.norm(values[:, 3:], axis=1)
    refuse(
        np.abs(norms - 1.0) > QUATERNION_NORM_TOLERANCE,
        lambda index: (
            f"found a quaternion of length {norms[index]:.4g}, expected 1 within {QUATERNION_NORM_TOLERANCE}; "
            f"check the column order ({_TUM_COLUMNS})"
        ),
    )
    refuse(
        np.diff(stamps_ns, prepend=stamps_ns[0] - 1) <= 0,
        lambda index: (
            f"timestamps must increase, found {_seconds(stamps_ns[index])} after {_seconds(stamps_ns[index - 1])}; "
            "sort the lines and drop repeated timestamps"
        ),
    )


def _shortened(line, length=60):
    return repr(line if len(line) <= length else line[:length] + "...")


def _tum_text(trajectory):
    quats_xyzw = se3.to_quat_xyzw(trajectory.poses)
    values = np.concatenate([trajectory.poses[:, :3, 3], quats_xyzw], axis=1).tolist()
    rows = zip(trajectory.stamps_ns.tolist(), values, strict=True)
    lines = [f"{_seconds(stamp)} {' '.join(map(repr, row))}" for stamp, row in rows]
    return "\n".join([f"# {_TUM_COLUMNS}", *lines, ""])


def _seconds(stamp_ns):
    seconds, nanoseconds = divmod(abs(int(stamp_ns)), _NS_PER_S)
    return f"{'-' if stamp_ns < 0 else ''}{seconds}.{nanoseconds:09d}"


_FORMATS = {"tum": (_read_tum, _tum_text)}
