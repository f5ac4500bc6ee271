"""Poses from the numbers of a table.

A file may not state the order of its quaternions, or the convention of its angles. Both are then
inferred from the motion: a vehicle moves in a constant direction of its own body, usually forward.
With orientations in a wrong convention, this direction changes when the vehicle turns. Hand-held
sensors and drones move in all directions, so that their motion does not distinguish conventions.
The usual convention is then assumed.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import (
    FARTHEST_M,
    QUATERNION_NORM_TOLERANCE,
    ROTATION_TOLERANCE,
    STEADY_SCATTER,
    WRONG_SCATTER_RATIO,
    are_earth_centred,
    far_position,
    scatter_of_direction,
)
from hand_eye_calib.formats.geodetic import (
    LocalOrigin,
    axes_of_places,
    rotations_to_first,
)
from hand_eye_calib.formats.trajectory_files.columns import (
    MATRIX,
    QUATERNION,
    RATES,
    ROTATION_VECTOR,
    SCALAR_FIRST,
    UNNAMED,
    is_brief,
)
from hand_eye_calib.formats.trajectory_files.table import Table

# Largest angle (rad) in a column without a unit: one turn, with space for rounding.
_LARGEST_ANGLE_RAD = 2 * np.pi + 0.01
# Units of each kind of quantity, with their factors to m, rad and rad/s, and a limit in the first
# unit. A column without a unit is in the first unit, or in the second unit if a value exceeds the
# limit. The limit of rates is 2,000 deg/s (in rad/s), the range of usual gyroscopes.
_KINDS = {
    "length": ({"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}, np.inf),
    "angle": ({"rad": 1.0, "deg": np.pi / 180}, _LARGEST_ANGLE_RAD),
    "rate": ({"rad/s": 1.0, "deg/s": np.pi / 180}, 35.0),
}

# Texts that notes use for the conventions of the angles. Here: angle about the vertical.
_COMPASS = "clockwise from north"
_MATHEMATICAL = "counterclockwise from x (east)"
# The angles are those of the inverse rotation, like in the library pyboreas.
_INVERSE = "that of the world in the sensor's frame"
# The rotations about x, y and z are applied in the opposite order.
_OTHER_ORDER = (
    "counterclockwise from x, about the axis that roll and pitch have turned"
)
# A sensor remains level if the scatter of the vertical direction in its axes is at most this. The
# scatter is 1 minus the length of the mean direction. The limit is about 1 minus the cosine of
# 2.5 deg.
_LEVEL = 1e-3

# ---- poses and rates


def poses_of(table: Table, convention: str = "") -> tuple[FloatArray, ...]:
    """Return the poses of a table, or its angular rates.

    Notes about guessed conventions are added to the table's ``guesses``.

    Parameters
    ----------
    table : Table
    convention : str, optional
        Convention of the angles. By default, it is inferred from the motion.

    Returns
    -------
    positions : (N, 3) array
        Positions, m. For angular rates, the only array of the result is (N, 3), in rad/s.
    quats_xyzw : (N, 4) array
        Orientations of the sensor in its world.

    Raises
    ------
    InputError
        For invalid values; the message contains the line number.
    """
    table.refuse(
        np.asarray(~np.isfinite(table.values()).all(axis=1)),
        lambda _: (
            "found a value that is not finite; remove the line or repair its source"
        ),
    )
    if table.measures == "rates":
        return (_in_si(table, RATES, "rate"),)
    if MATRIX[0] in table.at:
        positions, quats_xyzw = _of_matrices(table)
    else:
        positions, to_first = _positions(table)
        quats_xyzw = _orientations(table, positions, convention)
        if to_first is not None:
            rotations = _rotations_of(quats_xyzw)
            quats_xyzw = se3.to_quat_xyzw(to_first @ rotations)
    if table.measures == "poses" and are_earth_centred(positions):
        quats_xyzw = _in_axes_of_earth(table, positions, quats_xyzw)
    return positions, quats_xyzw


def _rotations_of(quats_xyzw: FloatArray) -> FloatArray:
    """Return the rotations (N, 3, 3) of quaternions (N, 4)."""
    no_positions = np.zeros((len(quats_xyzw), 3))
    return se3.rotation_of(se3.from_quat_xyzw(no_positions, quats_xyzw))


def _positions(table: Table) -> tuple[FloatArray, FloatArray | None]:
    """Return the positions (N, 3), m, of a table without matrices.

    For latitudes and longitudes, the second value has the rotations (N, 3, 3) from the axes east,
    north and up at each position to those at the first position. Otherwise it is None.
    """
    positions = np.zeros((len(table.line_numbers), 3))
    to_first = None
    up = [name for name in ("z", "height") if name in table.at][:1]
    if "lat" in table.at:
        positions, to_first = _on_earth(table, up)
    elif "x" in table.at:
        names = ("x", "y", *up)
        positions[:, : len(names)] = _in_si(table, names, "length")
    if not up and {"x", "lat"} & table.at.keys():
        # Without orientations, another note lists the unread columns.
        unread = table.unread if table.measures == "poses" else ""
        table.guess(f"no column of heights: 0 is assumed{unread}")
    _refuse_far(table, positions)
    return positions, to_first


def _refuse_far(table: Table, positions: FloatArray) -> None:
    """Raise an InputError at the first position that is too far from the origin."""
    table.refuse(
        np.asarray(np.abs(positions).max(axis=1) > FARTHEST_M),
        lambda row: f"{far_position(*positions[row])}; check its unit",
    )


def _of_matrices(table: Table) -> tuple[FloatArray, FloatArray]:
    """Return the positions (N, 3), m, and the quaternions (N, 4), scalar last, of matrices.

    The numbers may be rounded, so the nearest rotation of each matrix is used.
    """
    matrices = table.values(MATRIX).reshape(-1, 3, 4)
    positions = matrices[:, :, 3]
    _refuse_far(table, positions)
    nearest = se3.nearest_rotation(matrices[:, :, :3])
    errors = np.abs(nearest - matrices[:, :, :3]).max(axis=(1, 2))
    table.refuse(
        np.asarray(errors > ROTATION_TOLERANCE),
        lambda _: (
            f"the 3x3 part is not a rotation matrix within {ROTATION_TOLERANCE}; check the order "
            "of the values"
        ),
    )
    quats_xyzw = se3.to_quat_xyzw(nearest)
    if not table.is_transposable:
        return positions, quats_xyzw
    candidates = {
        "row by row": quats_xyzw,
        "column by column": se3.to_quat_xyzw(np.swapaxes(nearest, 1, 2)),
    }
    fitting = _conventions_that_fit(positions, candidates)
    reason = ", because the motion fits that" if len(fitting) == 1 else ""
    table.guess(
        f"rotations and translations are in separate columns; read {fitting[0]}{reason}"
    )
    return positions, candidates[fitting[0]]


# Rotation from the axes north, east and down to the axes east, north and up.
_R_ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def _in_axes_of_earth(
    table: Table, positions: FloatArray, quats_xyzw: FloatArray
) -> FloatArray:
    """Return the orientations (N, 4) in the earth's axes (ECEF), for positions (N, 3) in ECEF, m.

    The orientations ``quats_xyzw`` (N, 4) of the file may be relative to the earth's axes, to the
    axes east, north and up (ENU), or to north, east and down (NED) at each position. The convention
    is inferred from the motion. Among conventions that fit the motion, those in which the vehicle
    remains level have priority.
    """
    # Rotations (N, 3, 3) from the axes east, north and up at each position to those of the earth.
    axes = axes_of_places(positions)
    rotations = _rotations_of(quats_xyzw)
    candidates = {
        "the axes of the earth, too": quats_xyzw,
        "east, north and up at each position (ENU)": se3.to_quat_xyzw(
            axes @ rotations
        ),
        "north, east and down at each position (NED)": se3.to_quat_xyzw(
            axes @ _R_ENU_NED @ rotations
        ),
    }
    fitting = _conventions_that_fit(positions, candidates)
    if len(fitting) > 1:
        up = axes[:, :, 2]
        scatters = {
            name: _scatter_in_sensor(candidates[name], up) for name in fitting
        }
        largest = max(WRONG_SCATTER_RATIO * min(scatters.values()), _LEVEL)
        fitting = [name for name in fitting if scatters[name] <= largest]
    reason = (
        ", because the motion fits that"
        if len(fitting) < len(candidates)
        else ""
    )
    table.guess(
        "positions count from the centre of the earth (ECEF); orientations read as relative to "
        f"{fitting[0]}{reason}"
    )
    return candidates[fitting[0]]


def _scatter_in_sensor(quats_xyzw: FloatArray, up: FloatArray) -> float:
    """Return the scatter of the directions ``up`` (N, 3) in the axes of a sensor.

    The scatter is 1 minus the length of the mean direction: 0 if the sensor remains level.
    """
    # R' up for each orientation R of the sensor.
    in_sensor = np.einsum("nji,nj->ni", _rotations_of(quats_xyzw), up)
    return 1.0 - float(np.linalg.norm(in_sensor.mean(axis=0)))


def _on_earth(table: Table, up: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Return positions (N, 3), m, along the axes east, north and up at the first position.

    ``up`` is the column of heights, or empty. The second value has the rotations (N, 3, 3) from the
    axes east, north and up at each position to those at the first position.
    """
    lat_rad, lon_rad = _in_si(table, ("lat", "lon"), "angle").T
    table.refuse(
        (np.abs(lat_rad) > np.pi / 2) | (np.abs(lon_rad) > _LARGEST_ANGLE_RAD),
        lambda row: (
            f"found latitude {np.degrees(lat_rad[row]):.7g} deg, longitude "
            f"{np.degrees(lon_rad[row]):.7g} deg; the limit of the latitude "
            "is 90 deg: check whether both are swapped, and the unit (u-blox writes 1e-7 deg as "
            "whole numbers)"
        ),
    )
    height_m = (
        _in_si(table, up, "length")[:, 0] if up else np.zeros(len(lat_rad))
    )
    table.guess(
        "latitude and longitude became metres east and north of the first position"
    )
    positions = LocalOrigin().local(lat_rad, lon_rad, height_m)
    return positions, rotations_to_first(lat_rad, lon_rad)


def _in_si(table: Table, names: Sequence[str], kind: str) -> FloatArray:
    """Return k columns (N, k), converted to m, rad or rad/s.

    ``kind`` is "length", "angle" or "rate". If the column names have no unit, it is inferred from
    the size of the values.
    """
    factors, largest_of_first = _KINDS[kind]
    values = table.values(names)
    units = {table.units[name] for name in names if name in table.units}
    if len(units) > 1 or units - factors.keys():
        raise InputError(
            f"{table.path}: columns {', '.join(names)} in {', '.join(sorted(units))}; expected one "
            f"of {', '.join(factors)}"
        )
    magnitudes = np.abs(values).max(axis=1)
    if kind != "length":
        table.refuse(
            magnitudes > FARTHEST_M,
            lambda row: (
                f"found {kind} {magnitudes[row]:.4g}; repair its source"
            ),
        )
    if units:
        unit = units.pop()
        if unit == "rad":
            _refuse_degrees(table, names, values)
        return values * factors[unit]
    # A column without a unit has the first or the second unit.
    first, second, *_ = factors
    largest = float(magnitudes.max())
    unit, other = (
        (second, first) if largest > largest_of_first else (first, second)
    )
    if kind != "length":
        table.guess(
            f"{', '.join(names)} read in {unit}, the largest is "
            f"{largest:.4g}; to change this, name the unit in the header, "
            f"such as {names[-1]}_{other.replace('/', '_')}"
        )
    return values * factors[unit]


def _refuse_degrees(
    table: Table, names: Sequence[str], values: FloatArray
) -> None:
    """Raise an InputError if columns that are named as radians probably contain degrees.

    Angles above one turn are degrees. Exception: a yaw or heading may count turns without a jump,
    and gets a note. A yaw or heading with a jump of more than one turn is in degrees.

    Parameters
    ----------
    table : Table
    names : sequence of str
        Quantities of k columns.
    values : (N, k) array
        Their numbers.
    """
    jumps = np.abs(np.diff(values, axis=0, prepend=values[:1]))
    for name, column, jump in zip(names, values.T, jumps.T, strict=True):
        largest = np.abs(column).max()
        if largest <= _LARGEST_ANGLE_RAD:
            continue
        in_degrees = f"name the column {name}_deg"
        column_name = table.names[table.at[name]]
        if name in ("yaw", "heading") and jump.max() <= _LARGEST_ANGLE_RAD:
            table.guess(
                f"{column_name} reaches {largest:.4g} rad, more than one turn; if it is "
                f"in degrees, {in_degrees}"
            )
            continue
        raise InputError(
            f"{table.path}: {column_name} reaches {largest:.4g}, more than one turn (2 pi "
            f"rad): probably degrees; then {in_degrees}, else write angles from -pi to pi"
        )


# ---- orientations


def _orientations(
    table: Table, positions: FloatArray, convention: str
) -> FloatArray:
    """Return the quaternions (N, 4), scalar last, of a table; identities without orientations."""
    for names in (QUATERNION, SCALAR_FIRST, UNNAMED):
        if names[0] in table.at:
            return _of_quaternions(table, names, positions)
    if {"yaw", "heading"} & table.at.keys():
        return _of_angles(table, positions, convention)
    if ROTATION_VECTOR[0] in table.at:
        _require_rotation_vectors(table)
        return se3.to_quat_xyzw(
            se3.rotation_exp(_in_si(table, ROTATION_VECTOR, "angle"))
        )
    return np.tile([0.0, 0.0, 0.0, 1.0], (len(positions), 1))


def _of_quaternions(
    table: Table, names: Sequence[str], positions: FloatArray
) -> FloatArray:
    """Return the quaternions (N, 4) of a table, with the scalar last.

    With names q0 to q3 the scalar is usually first; without names it is usually last. These orders
    are assumed, unless the motion or the first orientation is evidence for the other order.
    """
    quats = _unit_quaternions(table, names)
    if names == QUATERNION:
        return quats
    # The quaternions, converted to scalar last, by the assumed place of the scalar in the file.
    candidates = {"last": quats, "first": np.roll(quats, -1, axis=1)}
    usual, opposite = (
        ("first", "last") if names == SCALAR_FIRST else ("last", "first")
    )
    fitting = _conventions_that_fit(positions, candidates)
    # An odometry begins with the identity, whose scalar is 1 or -1.
    begins_with_identity = {
        order: np.isclose(abs(quats_xyzw[0, 3]), 1.0, rtol=0.0)
        for order, quats_xyzw in candidates.items()
    }
    # Evidence for the other order.
    reason = ""
    if fitting == [opposite]:
        reason = "the motion then has a steady direction"
    elif begins_with_identity[opposite] and opposite in fitting:
        reason = "the first orientation is then the identity"
    if reason:
        columns = {"first": "qw qx qy qz", "last": "qx qy qz qw"}[opposite]
        table.guess(
            f"quaternions read with the scalar {opposite}, t x y z {columns}: {reason}"
        )
        return candidates[opposite]
    is_certain = fitting == [usual] or begins_with_identity[usual]
    if names == UNNAMED and table.format != "tum" and not is_certain:
        table.guess(
            "the file does not name its columns or the order of the "
            "quaternion; read with the scalar last, t x y z qx qy qz qw; to "
            "change this, set `columns`"
        )
    return candidates[usual]


def _unit_quaternions(table: Table, names: Sequence[str]) -> FloatArray:
    """Return the quaternions (N, 4) in columns. Raise an InputError if a length is not 1."""
    quats = table.values(names)
    # Squares of very large numbers overflow to infinity, and are rejected.
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(quats, axis=1)
    table.refuse(
        np.abs(norms - 1.0) > QUATERNION_NORM_TOLERANCE,
        lambda index: (
            f"found a quaternion of length {norms[index]:.4g}, expected 1 within "
            f"{QUATERNION_NORM_TOLERANCE}; check the column order ({table.expected})"
        ),
    )
    return quats


def _require_rotation_vectors(table: Table) -> None:
    """Raise an InputError if the columns rx, ry, rz cannot be a rotation vector in rad.

    They are then Euler angles in degrees of an unknown order.
    """
    if not is_brief(table.names[table.at[ROTATION_VECTOR[0]]]):
        return
    lengths = np.linalg.norm(table.values(ROTATION_VECTOR), axis=1)
    table.refuse(
        lengths > _LARGEST_ANGLE_RAD,
        lambda row: (
            f"rx, ry, rz have a length of {lengths[row]:.4g} rad, more than one turn. Are they "
            "angles in degrees? Name the columns roll_deg, pitch_deg, yaw_deg (about the fixed "
            "axes x, y, z), or rotvec_x_deg, rotvec_y_deg, rotvec_z_deg"
        ),
    )
    table.guess("rx, ry, rz read as a rotation vector, as of Universal Robots")


def _of_angles(
    table: Table, positions: FloatArray, convention: str
) -> FloatArray:
    """Return quaternions (N, 4), scalar last, from roll, pitch and yaw or heading.

    Angles are about the fixed axes x, y and z. The body axes are x forward, y left and z up, in a
    world with z up. With a heading, a positive pitch is nose up, as on aircraft and in INS. With a
    yaw, the pitch is about y, as in REP 103. ``convention`` replaces the convention that the motion
    indicates, unless it is empty.
    """
    names = [
        name for name in ("roll", "pitch", "yaw", "heading") if name in table.at
    ]
    *tilt, angle = _in_si(table, names, "angle").T
    if not tilt:
        table.guess("no columns of roll and pitch: 0 is assumed")
    roll, pitch = tilt or np.zeros((2, len(angle)))
    as_compass = np.stack([roll, -pitch, np.pi / 2 - angle], axis=1)
    usual = se3.rotation_from_rpy(np.stack([roll, pitch, angle], axis=1))
    candidates = {
        _COMPASS: se3.to_quat_xyzw(se3.rotation_from_rpy(as_compass)),
        _MATHEMATICAL: se3.to_quat_xyzw(usual),
        _INVERSE: se3.to_quat_xyzw(np.swapaxes(usual, 1, 2)),
        _OTHER_ORDER: se3.to_quat_xyzw(se3.in_other_order(usual)),
    }
    expected = _COMPASS if names[-1] == "heading" else _MATHEMATICAL
    # The expected convention is first. The other order is last: without roll and pitch it makes no
    # difference, so on flat ground it fits every motion.
    preference = {expected: 0, _OTHER_ORDER: 2}
    table.conventions = sorted(
        _conventions_that_fit(positions, candidates),
        key=lambda name: preference.get(name, 1),
    )
    used = convention or table.conventions[0]
    if expected == _COMPASS or used != expected:
        reason = ""
        if convention:
            reason = ", as in the other file with the same columns"
        elif used != expected:
            reason = ", because the motion fits this convention and not the usual one"
        axes = "x forward, y left, z up"
        undo = ""
        if used == _INVERSE:
            axes = "x, y, z of the world where all angles are 0"
            undo = "; to read it as that of the sensor in the world, set `invert` orientations"
        table.guess(
            f"{names[-1]} read as {used}{reason}; axes of the sensor: {axes}{undo}"
        )
    return candidates[used]


def _conventions_that_fit(
    positions: FloatArray, candidates: Mapping[str, FloatArray]
) -> list[str]:
    """Return the conventions under which the direction of travel may be constant in the sensor.

    A convention is excluded if the scatter of its direction exceeds both STEADY_SCATTER and
    WRONG_SCATTER_RATIO times the smallest scatter of all conventions.

    Parameters
    ----------
    positions : (N, 3) array
        Positions of the sensor in its world, m.
    candidates : mapping of str to (N, 4) array
        Orientations xyzw of the sensor in its world, in each convention.
    """
    scatters = {
        convention: scatter_of_direction(
            se3.from_quat_xyzw(positions, quats_xyzw)
        )
        for convention, quats_xyzw in candidates.items()
    }
    largest = max(STEADY_SCATTER, WRONG_SCATTER_RATIO * min(scatters.values()))
    return [
        convention
        for convention, scatter in scatters.items()
        if scatter <= largest
    ]
