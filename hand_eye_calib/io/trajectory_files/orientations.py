"""Orientations from the columns of a table: the order of quaternions and the convention of angles
that the file does not name are judged by the motion.

A vehicle moves in a steady direction of its own body: forward, as a rule. With orientations of a
wrong convention that direction wanders as the vehicle turns. Hand-held sensors and drones move in
all directions; of them this says nothing.
"""

from collections.abc import Sequence

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import QUATERNION_NORM_TOLERANCE, ROTATION_TOLERANCE
from hand_eye_calib.io.trajectory_files.columns import QUATERNION, UNNAMED
from hand_eye_calib.io.trajectory_files.table import Table

#: Units of angles, and angles in radians are no larger than a turn, with room for rounding.
RADIANS = {"deg": np.pi / 180, "rad": 1.0}
LARGEST_RAD = 2 * np.pi + 0.01
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

# Steps are this share of the extent of the positions, and at least so many are needed.
_STEPS_IN_EXTENT, _FEWEST_STEPS = 50, 10
# The wrong convention scatters the direction at least so much, and so many times as much as the
# right one.
_SMALLEST_SCATTER, _CLEARLY = 0.05, 4.0

# Values of each quantity.
Columns = dict[str, FloatArray]


def orientations(table: Table, columns: Columns, positions: FloatArray) -> FloatArray:
    """Quaternions (N, 4), scalar last; level where there are none."""
    if UNNAMED[0] in columns:
        return _of_unknown_order(table, np.stack([columns[name] for name in UNNAMED], 1), positions)
    if QUATERNION[0] in columns:
        quats_xyzw = np.stack([columns[name] for name in QUATERNION], axis=1)
        _check_quaternions(table, quats_xyzw)
        return quats_xyzw
    if not {"yaw", "heading"} & columns.keys():
        return np.tile([0.0, 0.0, 0.0, 1.0], (len(positions), 1))
    return _from_angles(table, columns, positions)


def unit_of(table: Table, name: str, known: dict[str, float]) -> str:
    """Unit of a quantity in the header; empty if it has none."""
    unit = table.units.get(name, "")
    if unit and unit not in known:
        raise InputError(
            f"{table.path}: column of {name} in {unit}; expected {', '.join(filter(None, known))}"
        )
    return unit


def from_matrices(table: Table, rotations: FloatArray) -> FloatArray:
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
    return se3.to_quat_xyzw(se3.nearest_rotation(rotations))


def _is_rotation(matrices: FloatArray) -> BoolArray:
    """Mask of the matrices (N, 3, 3) that are rotations within the tolerance."""
    products = np.swapaxes(matrices, 1, 2) @ matrices
    is_orthogonal = np.abs(products - np.eye(3)).max(axis=(1, 2)) <= ROTATION_TOLERANCE
    is_orthogonal[is_orthogonal] = np.linalg.det(matrices[is_orthogonal]) > 0
    return np.asarray(is_orthogonal, dtype=bool)


# ---- quaternions


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
    first_fits, last_fits = (
        _fits_better(positions, one, other)
        for one, other in ((quats, scalar_first), (scalar_first, quats))
    )
    reason = ""
    if first_fits:
        reason = "the motion keeps a steady direction that way"
    elif _starts_level(scalar_first) and not last_fits:
        reason = "the first orientation is the identity that way"
    if reason:
        table.guess(f"quaternions read with the scalar first, t x y z qw qx qy qz: {reason}")
        return scalar_first
    if not (_starts_level(quats) or last_fits or table.is_scalar_last_usual):
        table.guess(
            "no columns are named, and nothing tells the order of the quaternion; read with the "
            "scalar last, t x y z qx qy qz qw; to change that, give `columns`"
        )
    return quats


def _starts_level(quats_xyzw: FloatArray) -> bool:
    return bool(abs(abs(quats_xyzw[0, 3]) - 1.0) < _IDENTITY_WITHIN**2)


# ---- angles


def _from_angles(table: Table, columns: Columns, positions: FloatArray) -> FloatArray:
    """Quaternions from roll, pitch and yaw (about the fixed axes x, y, z) or heading."""
    given = [name for name in ("roll", "pitch", "yaw", "heading") if name in columns]
    factors = _angle_factors(table, columns, given)
    if "roll" not in columns:
        table.guess("no columns of roll and pitch: taken as 0")
    roll, pitch = (
        columns[name] * factors[name] if name in columns else np.zeros(len(positions))
        for name in ("roll", "pitch")
    )
    usual, other = (_COMPASS, _MATHEMATICAL) if "heading" in columns else (_MATHEMATICAL, _COMPASS)
    angles = columns[given[-1]] * factors[given[-1]]
    ways = {each: _turned(roll, pitch, angles, each) for each in (usual, other, _INVERSE)}
    table.conventions = [
        each
        for each, quats in ways.items()
        if not any(_fits_better(positions, quats, others) for others in ways.values())
    ]
    way = table.convention or table.conventions[0]
    if way != _MATHEMATICAL or usual != way:
        if table.convention:
            why = ", because that fits the other file with the same columns, too"
        else:
            why = "" if way == usual else ", because the motion fits that and not the usual"
        table.guess(f"{given[-1]} read as {way}{why}; axes of the sensor: {_AXES[way]}")
    return ways[way]


def _turned(roll: FloatArray, pitch: FloatArray, angle: FloatArray, convention: str) -> FloatArray:
    """Quaternions of a body with x forward, y left and z up, in a frame with z up.

    With a compass heading, a positive pitch is nose up, as on aircraft and in INS; with a yaw it
    is about y, as in REP 103.
    """
    if convention == _INVERSE:
        in_sensor = se3.rotation_from_rpy(np.stack([roll, pitch, angle], axis=1))
        return se3.to_quat_xyzw(np.swapaxes(in_sensor, 1, 2))
    is_compass = convention == _COMPASS
    yaw = np.pi / 2 - angle if is_compass else angle
    rpy = np.stack([roll, -pitch if is_compass else pitch, yaw], axis=1)
    return se3.to_quat_xyzw(se3.rotation_from_rpy(rpy))


def _angle_factors(table: Table, columns: Columns, given: Sequence[str]) -> dict[str, float]:
    """Factors to radians: by the units in the header, else by the size of the angles."""
    units = {name: unit_of(table, name, RADIANS) for name in given}
    unnamed = [name for name in given if not units[name]]
    if unnamed:
        largest = max(float(np.abs(columns[name]).max()) for name in unnamed)
        usual = next(filter(None, units.values()), "deg" if largest > LARGEST_RAD else "rad")
        units |= dict.fromkeys(unnamed, usual)
        if len(unnamed) == len(given):
            table.guess(
                f"angles read in {usual}, the largest is {largest:.4g}; to change that, name their "
                "unit in the header, such as yaw_deg"
            )
    return {name: RADIANS[unit] for name, unit in units.items()}


# ---- what the motion says


def _fits_better(positions: FloatArray, quats_xyzw: FloatArray, others_xyzw: FloatArray) -> bool:
    """Whether the motion fits other orientations of the sensor in the frame of the positions
    clearly better; false if it says nothing.
    """
    rows = _apart(positions)
    if len(rows) <= _FEWEST_STEPS:
        return False
    steps = np.diff(positions[rows], axis=0)
    scatter = _scatter(steps, quats_xyzw[rows[:-1]])
    other = _scatter(steps, others_xyzw[rows[:-1]])
    return scatter > _SMALLEST_SCATTER and scatter > _CLEARLY * other


def _apart(positions: FloatArray) -> IntArray:
    """Rows between which the sensor has moved on by a step."""
    step = float(np.linalg.norm(np.ptp(positions, axis=0))) / _STEPS_IN_EXTENT
    if not step > 0:
        return np.arange(0)
    travelled = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))]
    rows = np.flatnonzero(np.diff(np.floor(travelled / step), prepend=-1.0))
    # Of a sensor that stands still, the noise of the positions adds up to a path.
    moved = np.linalg.norm(np.diff(positions[rows], axis=0), axis=1) > step / 3
    return rows[np.r_[True, moved]]


def _scatter(steps: FloatArray, quats_xyzw: FloatArray) -> float:
    """Scatter of the directions of steps (N, 3) in the sensor's own frame: 0 if all are the same,
    1 if they go everywhere.
    """
    directions = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    rotations = se3.from_quat_xyzw(np.zeros_like(steps), quats_xyzw)[:, :3, :3]
    in_sensor = np.einsum("nji,nj->ni", rotations, directions)
    return 1.0 - float(np.linalg.norm(in_sensor.mean(axis=0)))
