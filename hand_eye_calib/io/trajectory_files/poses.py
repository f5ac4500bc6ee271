"""Poses from the numbers of a table, in whatever way it gives positions and orientations."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import QUATERNION_NORM_TOLERANCE, ROTATION_TOLERANCE
from hand_eye_calib.io.geodetic import LocalOrigin, rotations_to_first, wrong_latitude
from hand_eye_calib.io.plausibility import check_positions
from hand_eye_calib.io.trajectory_files.columns import QUATERNION
from hand_eye_calib.io.trajectory_files.formats import MATRIX, UNNAMED
from hand_eye_calib.io.trajectory_files.motion import fits_better
from hand_eye_calib.io.trajectory_files.table import Table

_METRES = {"": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0}
_RADIANS = {"deg": np.pi / 180, "rad": 1.0}
_RADIANS_PER_S = {"deg/s": np.pi / 180, "rad/s": 1.0}
# No gyroscope measures more (rad/s): 2,000 deg/s.
_FASTEST = 35.0
# Angles in radians are no larger than a turn, with room for rounding.
_LARGEST_RAD = 2 * np.pi + 0.01
# A first orientation so close to the identity is where an odometry starts.
_IDENTITY_WITHIN = 1e-4
_SCALAR_FIRST = [1, 2, 3, 0]  # indices that put the scalar last

_COMPASS = "clockwise from north"
_MATHEMATICAL = "counterclockwise from x (east)"
# The inverse rotation in roll, pitch and yaw, as pyboreas has it.
_INVERSE = "that of the world in the sensor's frame"
_AXES = {
    _COMPASS: "x forward, y left, z up",
    _MATHEMATICAL: "x forward, y left, z up",
    _INVERSE: "x, y, z of the world where all angles are 0",
}

# Values of each quantity.
_Columns = dict[str, FloatArray]


class Poses(NamedTuple):
    """Positions (N, 3), m, and quaternions (N, 4), scalar last."""

    positions: FloatArray
    quats_xyzw: FloatArray


def poses_of(table: Table) -> Poses:
    """The poses of a table; what had to be guessed is added to its ``guesses``.

    Raises
    ------
    InputError
        For values that cannot be; the message names the line.
    """
    values = _finite_values(table)
    if table.quantities == MATRIX:
        matrices = values.reshape(-1, 3, 4)
        positions = _checked(table, matrices[:, :, 3])
        return Poses(positions, _from_matrices(table, matrices[:, :, :3]))
    columns = dict(zip(table.quantities, values.T, strict=True))
    return (_in_local_frame if "lat" in columns else _in_metres)(table, columns)


def _finite_values(table: Table) -> FloatArray:
    values = table.values
    table.refuse(
        np.asarray(~np.isfinite(values).all(axis=1)),
        lambda _: "found a value that is not finite; remove the line or repair its source",
    )
    return values


def rates_of(table: Table) -> FloatArray:
    """The angular rates (N, 3), rad/s, of a table of rates; a unit that had to be guessed is added
    to its ``guesses``.

    Raises
    ------
    InputError
        For values that cannot be; the message names the line.
    """
    values = _finite_values(table)
    units = {_checked_unit(table, name, _RADIANS_PER_S) for name in table.quantities}
    if len(units) > 1:
        raise InputError(f"{table.path}: the columns of the rates have different units")
    unit = units.pop()
    if not unit:
        largest = float(np.abs(values).max())
        unit = "deg/s" if largest > _FASTEST else "rad/s"
        _guess(
            table,
            f"angular rates read in {unit}, the largest is {largest:.4g}; to change that, name "
            "their unit in the header, such as wx_deg_s",
        )
    return values * _RADIANS_PER_S[unit]


def _guess(table: Table, text: str) -> None:
    table.guesses.append(f"{table.path}: {text}")


# ---- positions


def _checked(table: Table, positions: FloatArray) -> FloatArray:
    """The positions (N, 3), none of which is too far away."""
    try:
        check_positions(positions)
    except InputError as error:
        line = table.line_numbers[getattr(error, "index", 0)]
        raise InputError(f"{table.path}, line {line}: {error}; check its unit") from None
    return positions


def _in_metres(table: Table, columns: _Columns) -> Poses:
    if "x" not in columns:
        positions = np.zeros((len(table.values), 3))
        return Poses(positions, _orientations(table, columns, positions))
    names = ("x", "y", "height" if "height" in columns else "z")
    positions = np.stack([_lengths(table, columns, name) for name in names], axis=1)
    _checked(table, positions)
    return Poses(positions, _orientations(table, columns, positions))


def _lengths(table: Table, columns: _Columns, name: str) -> FloatArray:
    """A column of lengths in metres; zeros if there is none."""
    if name in columns:
        return columns[name] * _METRES[_checked_unit(table, name, _METRES)]
    _guess(table, f"no column of {'heights' if name == 'height' else name}: taken as 0")
    return np.zeros(len(table.values))


def _in_local_frame(table: Table, columns: _Columns) -> Poses:
    """Positions from latitude, longitude and height, in the frame of the first one."""
    is_small = max(np.abs(columns["lat"]).max() * 2, np.abs(columns["lon"]).max()) <= np.pi
    named = _checked_unit(table, "lat", _RADIANS) or _checked_unit(table, "lon", _RADIANS)
    factor = _RADIANS[named or ("rad" if is_small else "deg")]
    lat, lon = columns["lat"] * factor, columns["lon"] * factor
    are_swapped = bool(np.abs(lat).min() > np.pi / 2 >= np.abs(lon).max())
    table.refuse(
        (np.abs(lat) > np.pi / 2 + 1e-9) | (np.abs(lon) > _LARGEST_RAD),
        lambda index: _wrong_place(columns["lat"][index], columns["lon"][index], are_swapped),
    )
    positions = LocalOrigin().local(lat, lon, _lengths(table, columns, "height"))
    _checked(table, positions)
    unit = "" if named else f", in {'radians' if is_small else 'degrees'} by their size,"
    _guess(
        table, f"latitude and longitude{unit} became metres east and north of the first position"
    )
    quats_xyzw = _orientations(table, columns, positions)
    in_local = se3.from_quat_xyzw(positions, quats_xyzw)[:, :3, :3]
    return Poses(positions, se3.to_quat_xyzw(rotations_to_first(lat, lon) @ in_local))


def _wrong_place(lat: float, lon: float, are_swapped: bool) -> str:
    """What is wrong with a latitude or longitude."""
    if are_swapped:
        return f"{wrong_latitude(lat, lon)}, or the names of the columns"
    return f"found latitude {lat:.7g}, longitude {lon:.7g}; expected degrees or radians"


# ---- orientations


def _orientations(table: Table, columns: _Columns, positions: FloatArray) -> FloatArray:
    """Quaternions (N, 4), scalar last."""
    if UNNAMED[0] in columns:
        return _of_unknown_order(table, np.stack([columns[name] for name in UNNAMED], 1), positions)
    if QUATERNION[0] in columns:
        quats_xyzw = np.stack([columns[name] for name in QUATERNION], axis=1)
        _check_quaternions(table, quats_xyzw)
        return quats_xyzw
    if not {"yaw", "heading"} & columns.keys():
        return np.tile([0.0, 0.0, 0.0, 1.0], (len(positions), 1))
    return _from_angles(table, columns, positions)


def _check_quaternions(table: Table, quats: FloatArray) -> None:
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(quats, axis=1)
    table.refuse(
        np.abs(norms - 1.0) > QUATERNION_NORM_TOLERANCE,
        lambda index: (
            f"found a quaternion of length {norms[index]:.4g}, expected 1 within "
            f"{QUATERNION_NORM_TOLERANCE}; check the column order ({table.expected})"
        ),
    )


def _of_unknown_order(table: Table, quats: FloatArray, positions: FloatArray) -> FloatArray:
    """Quaternions, scalar last, in the order that start and motion speak for; the scalar is last
    if they say nothing.
    """
    _check_quaternions(table, quats)
    scalar_first = quats[:, _SCALAR_FIRST]
    reason = ""
    if fits_better(positions, quats, scalar_first):
        reason = "the motion keeps a steady direction that way"
    elif _starts_level(scalar_first) and not fits_better(positions, scalar_first, quats):
        reason = "the first orientation is the identity that way"
    if reason:
        _guess(table, f"quaternions read with the scalar first, t x y z qw qx qy qz: {reason}")
        return scalar_first
    is_known = _starts_level(quats) or fits_better(positions, scalar_first, quats)
    if not (is_known or table.is_scalar_last_usual):
        _guess(
            table,
            "no columns are named, and nothing tells the order of the quaternion; read with the "
            "scalar last, t x y z qx qy qz qw; to change that, give `columns`",
        )
    return quats


def _starts_level(quats_xyzw: FloatArray) -> bool:
    return bool(abs(abs(quats_xyzw[0, 3]) - 1.0) < _IDENTITY_WITHIN**2)


def _from_angles(table: Table, columns: _Columns, positions: FloatArray) -> FloatArray:
    """Quaternions from roll, pitch and yaw (about the fixed axes x, y, z) or heading."""
    given = [name for name in ("roll", "pitch", "yaw", "heading") if name in columns]
    factors = _angle_factors(table, columns, given)
    zero = np.zeros(len(table.values))
    if "roll" not in columns:
        _guess(table, "no columns of roll and pitch: taken as 0")
    roll, pitch = (
        columns[name] * factors[name] if name in columns else zero for name in ("roll", "pitch")
    )
    usual, other = (_COMPASS, _MATHEMATICAL) if "heading" in columns else (_MATHEMATICAL, _COMPASS)
    angles = columns[given[-1]] * factors[given[-1]]
    ways = {each: _turned(roll, pitch, angles, each) for each in (usual, other, _INVERSE)}
    table.conventions = [
        each
        for each, quats in ways.items()
        if not any(fits_better(positions, quats, others) for others in ways.values())
    ]
    way = table.convention or table.conventions[0]
    if way != _MATHEMATICAL or usual != way:
        if table.convention:
            why = ", because that fits the other file with the same columns, too"
        else:
            why = "" if way == usual else ", because the motion fits that and not the usual"
        _guess(table, f"{given[-1]} read as {way}{why}; axes of the sensor: {_AXES[way]}")
    return ways[way]


def _turned(roll: FloatArray, pitch: FloatArray, angle: FloatArray, convention: str) -> FloatArray:
    """Quaternions of a body with x forward, y left and z up, in a frame with z up.

    With a compass heading, a positive pitch is nose up, as on aircraft and in INS; with a yaw it
    is about y, as in REP 103.
    """
    if convention == _INVERSE:
        in_sensor = se3.rotation_from_rpy(np.stack([roll, pitch, angle], axis=1))
        return _quats_of(np.swapaxes(in_sensor, 1, 2))
    is_compass = convention == _COMPASS
    yaw = np.pi / 2 - angle if is_compass else angle
    rpy = np.stack([roll, -pitch if is_compass else pitch, yaw], axis=1)
    return _quats_of(se3.rotation_from_rpy(rpy))


def _angle_factors(table: Table, columns: _Columns, given: Sequence[str]) -> dict[str, float]:
    """Factors to radians: by the units in the header, else by the size of the angles."""
    units = {name: _checked_unit(table, name, _RADIANS) for name in given}
    unnamed = [name for name in given if not units[name]]
    if unnamed:
        largest = max(float(np.abs(columns[name]).max()) for name in unnamed)
        usual = next(filter(None, units.values()), "deg" if largest > _LARGEST_RAD else "rad")
        units |= dict.fromkeys(unnamed, usual)
        if len(unnamed) == len(given):
            _guess(
                table,
                f"angles read in {usual}, the largest is {largest:.4g}; to change that, name their "
                "unit in the header, such as yaw_deg",
            )
    return {name: _RADIANS[unit] for name, unit in units.items()}


def _checked_unit(table: Table, name: str, known: dict[str, float]) -> str:
    """Unit of a quantity in the header; empty if it has none."""
    unit = table.units.get(name, "")
    if unit and unit not in known:
        raise InputError(
            f"{table.path}: column of {name} in {unit}; expected {', '.join(filter(None, known))}"
        )
    return unit


def _from_matrices(table: Table, rotations: FloatArray) -> FloatArray:
    """Quaternions (N, 4), scalar last, of the nearest rotations: files have few digits."""
    with np.errstate(over="ignore", invalid="ignore"):
        wrong = ~_is_rotation(rotations)
    table.refuse(
        wrong,
        lambda _: (
            f"the 3x3 part is not a rotation matrix within {ROTATION_TOLERANCE}; check the order "
            "of the values"
        ),
    )
    left, _, right = np.linalg.svd(rotations)
    return se3.to_quat_xyzw(left @ right)


def _is_rotation(matrices: FloatArray) -> BoolArray:
    """Mask of the matrices (N, 3, 3) that are rotations within the tolerance."""
    products = np.swapaxes(matrices, 1, 2) @ matrices
    deviation = np.abs(products - np.eye(3)).max(axis=(1, 2))
    is_orthogonal = deviation <= ROTATION_TOLERANCE
    is_orthogonal[is_orthogonal] = np.linalg.det(matrices[is_orthogonal]) > 0
    return is_orthogonal


def _quats_of(rotations: FloatArray) -> FloatArray:
    return se3.to_quat_xyzw(rotations)
