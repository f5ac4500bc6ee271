"""Orientations from the columns of a table: the order of quaternions and the convention of angles
that the file does not name are judged by the motion.

A vehicle moves in a steady direction of its own body: forward, as a rule. With orientations of a
wrong convention that direction wanders as the vehicle turns. Hand-held sensors and drones move in
all directions; of them this says nothing.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import QUATERNION_NORM_TOLERANCE, ROTATION_TOLERANCE
from hand_eye_calib.io.trajectory_files.columns import QUATERNION, UNNAMED
from hand_eye_calib.io.trajectory_files.table import Table

#: Units of angles, and angles in radians are no larger than a turn, with room for rounding.
RADIANS = {"deg": np.pi / 180, "rad": 1.0}
LARGEST_RAD = 2 * np.pi + 0.01
# A first orientation so close to the identity is where an odometry starts.
_IDENTITY_WITHIN = 1e-8
# Of eight numbers in files so called, the scalar is the last.
_SUFFIXES_OF_TUM = ("", ".txt", ".tum")

_COMPASS = "clockwise from north"
_MATHEMATICAL = "counterclockwise from x (east)"
# The inverse rotation in roll, pitch and yaw, as pyboreas has it.
_INVERSE = "that of the world in the sensor's frame"

# Steps are this share of the extent of the positions, and at least so many are needed.
_STEPS_IN_EXTENT, _FEWEST_STEPS = 50, 10
# The wrong convention scatters the direction at least so much, and so many times as much as the
# right one.
_SMALLEST_SCATTER, _CLEARLY = 0.05, 4.0

# Values of each quantity.
Columns = dict[str, FloatArray]


def orientations(
    table: Table, columns: Columns, positions: FloatArray, convention: str = ""
) -> FloatArray:
    """Quaternions (N, 4), scalar last; level where there are none. A ``convention`` of angles goes
    before that which the motion fits.
    """
    if UNNAMED[0] in columns or QUATERNION[0] in columns:
        names = QUATERNION if QUATERNION[0] in columns else UNNAMED
        quats = np.stack([columns[name] for name in names], axis=1)
        with np.errstate(over="ignore"):
            norms = np.linalg.norm(quats, axis=1)
        table.refuse(
            np.abs(norms - 1.0) > QUATERNION_NORM_TOLERANCE,
            lambda index: (
                f"found a quaternion of length {norms[index]:.4g}, expected 1 within "
                f"{QUATERNION_NORM_TOLERANCE}; check the column order ({table.expected})"
            ),
        )
        return quats if names == QUATERNION else _in_order(table, quats, positions)
    if not {"yaw", "heading"} & columns.keys():
        return np.tile([0.0, 0.0, 0.0, 1.0], (len(positions), 1))
    return _from_angles(table, columns, positions, convention)


def unit_of(table: Table, name: str, known: Mapping[str, float]) -> str:
    """Unit of a quantity in the header; empty if it has none."""
    unit = table.columns.units.get(name, "")
    if unit and unit not in known:
        raise InputError(
            f"{table.path}: column of {name} in {unit}; expected {', '.join(filter(None, known))}"
        )
    return unit


def from_matrices(table: Table, rotations: FloatArray) -> FloatArray:
    """Quaternions (N, 4), scalar last, of the nearest rotations: files have few digits."""
    with np.errstate(over="ignore", invalid="ignore"):
        products = np.swapaxes(rotations, 1, 2) @ rotations
        is_rotation = np.abs(products - np.eye(3)).max(axis=(1, 2)) <= ROTATION_TOLERANCE
    is_rotation[is_rotation] = np.linalg.det(rotations[is_rotation]) > 0
    table.refuse(
        np.asarray(~is_rotation, dtype=bool),
        lambda _: (
            f"the 3x3 part is not a rotation matrix within {ROTATION_TOLERANCE}; check the order "
            "of the values"
        ),
    )
    return se3.to_quat_xyzw(se3.nearest_rotation(rotations))


def _in_order(table: Table, quats: FloatArray, positions: FloatArray) -> FloatArray:
    """Quaternions, scalar last, in the order that motion and start speak for; the scalar is last
    if they say nothing.
    """
    ways = {"last": quats, "first": np.roll(quats, -1, axis=1)}
    fitting = _fitting(positions, ways)
    level = [way for way, each in ways.items() if abs(abs(each[0, 3]) - 1.0) < _IDENTITY_WITHIN]
    reason = ""
    if fitting == ["first"]:
        reason = "the motion keeps a steady direction that way"
    elif "first" in level and "first" in fitting:
        reason = "the first orientation is the identity that way"
    if reason:
        table.guess(f"quaternions read with the scalar first, t x y z qw qx qy qz: {reason}")
        return ways["first"]
    is_clear = fitting == ["last"] or "last" in level
    if not is_clear and Path(table.path).suffix.lower() not in _SUFFIXES_OF_TUM:
        table.guess(
            "no columns are named, and nothing tells the order of the quaternion; read with the "
            "scalar last, t x y z qx qy qz qw; to change that, give `columns`"
        )
    return quats


# ---- angles


def _from_angles(
    table: Table, columns: Columns, positions: FloatArray, convention: str
) -> FloatArray:
    """Quaternions from roll, pitch and yaw (about the fixed axes x, y, z) or heading."""
    given = [name for name in ("roll", "pitch", "yaw", "heading") if name in columns]
    factors = _angle_factors(table, columns, given)
    if "roll" not in columns:
        table.guess("no columns of roll and pitch: taken as 0")
    roll, pitch = (
        columns[name] * factors[name] if name in columns else np.zeros(len(positions))
        for name in ("roll", "pitch")
    )
    angle = columns[given[-1]] * factors[given[-1]]
    # With a compass heading, a positive pitch is nose up, as on aircraft and in INS; with a yaw it
    # is about y, as in REP 103. Axes of the body are x forward, y left and z up, in a frame with z
    # up.
    rpy = {
        _COMPASS: (roll, -pitch, np.pi / 2 - angle),
        _MATHEMATICAL: (roll, pitch, angle),
        _INVERSE: (roll, pitch, angle),
    }
    rotations = {
        way: se3.rotation_from_rpy(np.stack(angles, axis=1)) for way, angles in rpy.items()
    }
    rotations[_INVERSE] = np.swapaxes(rotations[_INVERSE], 1, 2)
    ways = {way: se3.to_quat_xyzw(each) for way, each in rotations.items()}
    usual = _COMPASS if "heading" in columns else _MATHEMATICAL
    table.conventions = sorted(_fitting(positions, ways), key=lambda way: way != usual)
    way = convention or table.conventions[0]
    if way != _MATHEMATICAL or usual != way:
        why = "" if way == usual else ", because the motion fits that and not the usual"
        if convention:
            why = ", because that fits the other file with the same columns, too"
        axes = "x forward, y left, z up"
        if way == _INVERSE:
            axes = "x, y, z of the world where all angles are 0"
        table.guess(f"{given[-1]} read as {way}{why}; axes of the sensor: {axes}")
    return ways[way]


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


def _fitting(positions: FloatArray, ways: Mapping[str, FloatArray]) -> list[str]:
    """Of ways to read the sensor's orientations (N, 4) in the frame of the positions (N, 3), those
    that the motion does not contradict: another does not fit it clearly better.
    """
    moved = _steps(positions)
    if moved.sum() <= _FEWEST_STEPS:
        return [*ways]
    rows = np.flatnonzero(moved)
    steps = np.diff(positions[rows], axis=0)
    scatters = {way: _scatter(steps, quats[rows[:-1]]) for way, quats in ways.items()}
    largest = max(_SMALLEST_SCATTER, _CLEARLY * min(scatters.values()))
    return [way for way, scatter in scatters.items() if scatter <= largest]


def _steps(positions: FloatArray) -> BoolArray:
    """Whether the sensor has moved on by a step at each row."""
    step = float(np.linalg.norm(np.ptp(positions, axis=0))) / _STEPS_IN_EXTENT
    if not step > 0:
        return np.zeros(len(positions), dtype=bool)
    travelled = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))]
    moved = np.diff(np.floor(travelled / step), prepend=-1.0) != 0
    # Of a sensor that stands still, the noise of the positions adds up to a path.
    rows = np.flatnonzero(moved)[1:]
    moved[rows] = np.linalg.norm(np.diff(positions[moved], axis=0), axis=1) > step / 3
    return np.asarray(moved, dtype=bool)


def _scatter(steps: FloatArray, quats_xyzw: FloatArray) -> float:
    """Scatter of the directions of steps (N, 3) in the sensor's own frame: 0 if all are the same,
    1 if they go everywhere.
    """
    directions = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    rotations = se3.from_quat_xyzw(np.zeros_like(steps), quats_xyzw)[:, :3, :3]
    in_sensor = np.einsum("nji,nj->ni", rotations, directions)
    return 1.0 - float(np.linalg.norm(in_sensor.mean(axis=0)))
