"""Stamps and poses from the numbers of a table, in whatever way it gives them.

The order of quaternions and the convention of angles that a file does not name are judged by the
motion: a vehicle moves in a steady direction of its own body, forward as a rule. With orientations
of a wrong convention that direction wanders as the vehicle turns. Hand-held sensors and drones move
in all directions; of them this says nothing.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import (
    CLEARLY,
    FARTHEST_M,
    QUATERNION_NORM_TOLERANCE,
    ROTATION_TOLERANCE,
    STEADY,
    far_position,
    scatter_of_direction,
)
from hand_eye_calib.formats.geodetic import are_earth_centred, axes_of_places
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

# Units of lengths, angles and rates in m, rad and rad/s. Without a name it is the first, or the
# second if a value is larger than the limit: a turn with room for rounding, and 2,000 deg/s, which
# no gyroscope exceeds.
_KINDS = {
    "length": ({"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}, np.inf),
    "angle": ({"rad": 1.0, "deg": np.pi / 180}, 2 * np.pi + 0.01),
    "rate": ({"rad/s": 1.0, "deg/s": np.pi / 180}, 35.0),
}

_COMPASS = "clockwise from north"
_MATHEMATICAL = "counterclockwise from x (east)"
# The inverse rotation in roll, pitch and yaw, as pyboreas has it.
_INVERSE = "that of the world in the sensor's frame"
_OTHER_ORDER = "counterclockwise from x, about axes that roll and pitch have turned"
# A sensor that stays as level as this scatters no more than noise: 1 minus the cosine of 2.5 deg.
_LEVEL = 1e-3

# ---- poses and rates


def poses_of(table: Table, convention: str = "") -> tuple[FloatArray, ...]:
    """Positions (N, 3), m, and quaternions (N, 4), scalar last, of a table, or its angular rates
    (N, 3), rad/s; what had to be guessed is added to its ``guesses``. A ``convention`` of its
    angles goes before what the motion says. An InputError for values that cannot be, with the line.
    """
    table.refuse(
        np.asarray(~np.isfinite(table.values()).all(axis=1)),
        lambda _: "found a value that is not finite; remove the line or repair its source",
    )
    if table.measures == "rates":
        return (_in_si(table, RATES, "rate"),)
    if MATRIX[0] in table.at:
        positions, quats_xyzw = _of_matrices(table)
    else:
        positions, to_first = _positions(table)
        quats_xyzw = _orientations(table, positions, convention)
        if to_first is not None:
            in_local = se3.from_quat_xyzw(positions, quats_xyzw)[:, :3, :3]
            quats_xyzw = se3.to_quat_xyzw(to_first @ in_local)
    if table.measures == "poses" and are_earth_centred(positions):
        quats_xyzw = _in_axes_of_earth(table, positions, quats_xyzw)
    return positions, quats_xyzw


def _positions(table: Table) -> tuple[FloatArray, FloatArray | None]:
    """Positions (N, 3), m, and, of latitudes, the rotations (N, 3, 3) from the axes of each
    position to those of the first.
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
        table.guess("no column of heights: taken as 0")
    _refuse_far(table, positions)
    return positions, to_first


def _refuse_far(table: Table, positions: FloatArray) -> None:
    table.refuse(
        np.asarray(np.abs(positions).max(axis=1) > FARTHEST_M),
        lambda row: f"{far_position(*positions[row])}; check its unit",
    )


def _of_matrices(table: Table) -> tuple[FloatArray, FloatArray]:
    """Positions (N, 3), m, and quaternions (N, 4), scalar last, of matrices: those of the nearest
    rotations, as files have few digits.
    """
    matrices = table.values(MATRIX).reshape(-1, 3, 4)
    positions = matrices[:, :, 3]
    _refuse_far(table, positions)
    nearest = se3.nearest_rotation(matrices[:, :, :3])
    table.refuse(
        np.asarray(np.abs(nearest - matrices[:, :, :3]).max(axis=(1, 2)) > ROTATION_TOLERANCE),
        lambda _: (
            f"the 3x3 part is not a rotation matrix within {ROTATION_TOLERANCE}; check the order "
            "of the values"
        ),
    )
    if not table.is_transposable:
        return positions, se3.to_quat_xyzw(nearest)
    ways = {
        "row by row": se3.to_quat_xyzw(nearest),
        "column by column": se3.to_quat_xyzw(np.swapaxes(nearest, 1, 2)),
    }
    fitting = _fitting(positions, ways)
    reason = ", because the motion fits that" if len(fitting) == 1 else ""
    table.guess(f"rotations are not beside the translations; read {fitting[0]}{reason}")
    return positions, ways[fitting[0]]


_EARTH = "the axes of the earth, too"
_EAST = "east, north and up of each place (ENU)"
_NORTH = "north, east and down of each place (NED)"
# Axes north, east and down in those east, north and up.
_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def _in_axes_of_earth(table: Table, positions: FloatArray, quats_xyzw: FloatArray) -> FloatArray:
    """Quaternions (N, 4) in the axes of positions (N, 3) from the centre of the earth: those of the
    file may be in the axes of each place. The motion tells, or else that a vehicle stays level.
    """
    axes = axes_of_places(positions)
    rotations = se3.from_quat_xyzw(positions, quats_xyzw)[:, :3, :3]
    ways = {
        _EARTH: quats_xyzw,
        _EAST: se3.to_quat_xyzw(axes @ rotations),
        _NORTH: se3.to_quat_xyzw(axes @ _NED @ rotations),
    }
    fitting = _fitting(positions, ways)
    if len(fitting) > 1:
        up = axes[:, :, 2]
        tilts = {way: _tilt(ways[way], up) for way in fitting}
        most = CLEARLY * min(tilts.values())
        fitting = [way for way in fitting if tilts[way] <= max(most, _LEVEL)]
    reason = ", because the motion fits that" if len(fitting) < len(ways) else ""
    table.guess(
        "positions count from the centre of the earth (ECEF); orientations read as relative to "
        f"{fitting[0]}{reason}"
    )
    return ways[fitting[0]]


def _tilt(quats_xyzw: FloatArray, up: FloatArray) -> float:
    """How much directions (N, 3) scatter in the axes of a sensor: 0 if they are always the same."""
    rotations = se3.from_quat_xyzw(np.zeros((len(up), 3)), quats_xyzw)[:, :3, :3]
    in_sensor = np.einsum("nji,nj->ni", rotations, up)
    return 1.0 - float(np.linalg.norm(in_sensor.mean(axis=0)))


def _on_earth(table: Table, up: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Metres (N, 3) east, north and up of the first position, and the rotations (N, 3, 3) from the
    axes of each position to those of the first.
    """
    from hand_eye_calib.formats.geodetic import LocalOrigin, rotations_to_first

    lat, lon = _in_si(table, ("lat", "lon"), "angle").T
    table.refuse(
        (np.abs(lat) > np.pi / 2) | (np.abs(lon) > _KINDS["angle"][1]),
        lambda row: (
            f"found latitude {np.degrees(lat[row]):.7g} deg, longitude "
            f"{np.degrees(lon[row]):.7g} deg; expected no latitude beyond 90 deg: perhaps they "
            "are swapped"
        ),
    )
    height = _in_si(table, up, "length")[:, 0] if up else np.zeros(len(lat))
    table.guess("latitude and longitude became metres east and north of the first position")
    return LocalOrigin().local(lat, lon, height), rotations_to_first(lat, lon)


def _in_si(table: Table, names: Sequence[str], kind: str) -> FloatArray:
    """Columns (N, k) in m, rad or rad/s: in the unit that the header names, or by their size."""
    known, largest_of_first = _KINDS[kind]
    values = table.values(names)
    named = {unit for name in names if (unit := table.units.get(name))}
    if len(named) > 1 or named - known.keys():
        raise InputError(
            f"{table.path}: columns {', '.join(names)} in {', '.join(sorted(named))}; expected one "
            f"of {', '.join(known)}"
        )
    sizes = np.abs(values).max(axis=1)
    table.refuse(
        (sizes > FARTHEST_M) & (kind != "length"),
        lambda row: f"found {kind} {sizes[row]:.4g}; repair its source",
    )
    largest = float(sizes.max())
    unit = min(named) if named else [*known][largest > largest_of_first]
    if not named and kind != "length":
        table.guess(
            f"{', '.join(names)} read in {unit}, the largest is {largest:.4g}; to change that, "
            f"name the unit in the header, such as {names[-1]}_{unit.replace('/', '_')}"
        )
    return values * known[unit]


# ---- orientations


def _orientations(table: Table, positions: FloatArray, convention: str) -> FloatArray:
    """Quaternions (N, 4), scalar last; level where there are none."""
    kinds = (QUATERNION, SCALAR_FIRST, UNNAMED)
    names = next((each for each in kinds if each[0] in table.at), ())
    if not names:
        if {"yaw", "heading"} & table.at.keys():
            return _from_angles(table, positions, convention)
        if ROTATION_VECTOR[0] in table.at:
            _require_rotation_vectors(table)
            return se3.to_quat_xyzw(se3.rotation_exp(_in_si(table, ROTATION_VECTOR, "angle")))
        return np.tile([0.0, 0.0, 0.0, 1.0], (len(positions), 1))
    quats = table.values(names)
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(quats, axis=1)
    table.refuse(
        np.abs(norms - 1.0) > QUATERNION_NORM_TOLERANCE,
        lambda index: (
            f"found a quaternion of length {norms[index]:.4g}, expected 1 within "
            f"{QUATERNION_NORM_TOLERANCE}; check the column order ({table.expected})"
        ),
    )
    if names == QUATERNION:
        return quats
    # The order that motion and start speak for, or else the usual one.
    ways = {"last": quats, "first": np.roll(quats, -1, axis=1)}
    usual, other = ("first", "last") if names == SCALAR_FIRST else ("last", "first")
    fitting = _fitting(positions, ways)
    # An odometry starts at the identity.
    level = [way for way, (first, *_) in ways.items() if np.isclose(abs(first[3]), 1.0, rtol=0.0)]
    reason = ""
    if fitting == [other]:
        reason = "the motion keeps a steady direction that way"
    elif other in level and other in fitting:
        reason = "the first orientation is the identity that way"
    if reason:
        order = {"first": "qw qx qy qz", "last": "qx qy qz qw"}[other]
        table.guess(f"quaternions read with the scalar {other}, t x y z {order}: {reason}")
        return ways[other]
    if names == UNNAMED and table.format != "tum" and fitting != ["last"] and "last" not in level:
        table.guess(
            "no columns are named, and nothing names the order of the quaternion; read with the "
            "scalar last, t x y z qx qy qz qw; to change that, give `columns`"
        )
    return ways[usual]


def _require_rotation_vectors(table: Table) -> None:
    """Refuse columns rx, ry, rz that are angles in degrees: nothing names their order."""
    vectors = table.values(ROTATION_VECTOR)
    if not is_brief(table.names[table.at[ROTATION_VECTOR[0]]]):
        return
    lengths = np.linalg.norm(vectors, axis=1)
    table.refuse(
        lengths > _KINDS["angle"][1],
        lambda row: (
            f"rx, ry, rz are {lengths[row]:.4g} long, more than a turn: angles in degrees? Name "
            "the columns roll_deg, pitch_deg, yaw_deg (about the fixed axes x, y, z), or "
            "rotvec_x_deg, rotvec_y_deg, rotvec_z_deg"
        ),
    )
    table.guess("rx, ry, rz read as a rotation vector, as Universal Robots have it")


def _from_angles(table: Table, positions: FloatArray, convention: str) -> FloatArray:
    """Quaternions (N, 4) from roll, pitch and yaw (about the fixed axes x, y, z) or heading."""
    names = [each for each in ("roll", "pitch", "yaw", "heading") if each in table.at]
    *tilt, angle = _in_si(table, names, "angle").T
    if not tilt:
        table.guess("no columns of roll and pitch: taken as 0")
    roll, pitch = tilt or np.zeros((2, len(angle)))
    # With a compass heading, a positive pitch is nose up, as on aircraft and in INS; with a yaw it
    # is about y, as in REP 103. Axes of the body are x forward, y left and z up, in a frame with z
    # up.
    compass, usual = (
        se3.rotation_from_rpy(np.stack(rpy, axis=1))
        for rpy in ((roll, -pitch, np.pi / 2 - angle), (roll, pitch, angle))
    )
    inverse = np.swapaxes(usual, 1, 2)
    other_order = se3.in_other_order(usual)
    rotations = {
        _COMPASS: compass,
        _MATHEMATICAL: usual,
        _INVERSE: inverse,
        _OTHER_ORDER: other_order,
    }
    ways = {way: se3.to_quat_xyzw(each) for way, each in rotations.items()}
    expected = _COMPASS if names[-1] == "heading" else _MATHEMATICAL
    # In flat motion the order of angles does not matter.
    unlikely = {expected: 0, _OTHER_ORDER: 2}
    table.conventions = sorted(_fitting(positions, ways), key=lambda way: unlikely.get(way, 1))
    way = convention or table.conventions[0]
    if expected == _COMPASS or way != expected:
        why = "" if way == expected else ", because the motion fits that and not the usual"
        if convention:
            why = ", because that fits the other file with the same columns, too"
        axes = "x forward, y left, z up"
        if way == _INVERSE:
            axes = "x, y, z of the world where all angles are 0"
        table.guess(f"{names[-1]} read as {way}{why}; axes of the sensor: {axes}")
    return ways[way]


def _fitting(positions: FloatArray, ways: Mapping[str, FloatArray]) -> list[str]:
    """Select the ways to read orientations (N, 4) that the motion does not contradict: no other way
    fits it clearly better. The positions (N, 3) are those of the sensor in its world.
    """
    scatters = {
        way: scatter_of_direction(se3.from_quat_xyzw(positions, quats))
        for way, quats in ways.items()
    }
    largest = max(STEADY, CLEARLY * min(scatters.values()))
    return [way for way, scatter in scatters.items() if scatter <= largest]
