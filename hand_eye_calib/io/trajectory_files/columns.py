"""Columns of a table by the names in its header."""

import re
from collections.abc import Mapping, Sequence
from itertools import chain
from types import MappingProxyType
from typing import NamedTuple

from hand_eye_calib.config import STAMP_UNITS
from hand_eye_calib.errors import InputError
from hand_eye_calib.text import shortened

# Characters of a list of names that a message shows.
_MOST_SHOWN = 600

POSITION = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")
# Coefficients of a quaternion whose order is not known.
UNNAMED = ("q1", "q2", "q3", "q4")
# The first three rows of a pose's matrix.
MATRIX = tuple(f"m{row}{column}" for row in "123" for column in "1234")
RATES = ("wx", "wy", "wz")
TWIST = ("vx", "vy", "vz", *RATES)
# Sets of quantities that give a position or an orientation, the preferred first; of a machine on a
# plane, fewer.
_POSITIONS = (POSITION, ("lat", "lon", "height"), ("x", "y", "height"))
_ORIENTATIONS = (QUATERNION, ("roll", "pitch", "yaw"), ("roll", "pitch", "heading"), UNNAMED)
_PLANAR_ORIENTATIONS = (("yaw",), ("heading",))
_ALL_POSITIONS = (*_POSITIONS, ("x", "y"), ("lat", "lon"))

# What stands before the axis in names of angular rates, velocities and quaternions.
_BEGINNINGS = {
    "w": "w w_ omega_ gyro_ gyr_ angvel_ ang_vel_ angular_velocity_ angular_rate_ rate_ w_rs_s_",
    "v": "v",
    "q": "q q_ quat_ quaternion_ rot_ orientation_ rotation_ q_rs_",
}
# Last parts of column names, lower case, words joined by underscores; exports of bags have whole
# paths such as .pose.pose.position.x.
_ALIASES = {
    "t": ("t", "time", "timestamp", "timestamps", "stamp", "gpstime", "header_stamp"),
    "x": ("x", "tx", "px", "p_x", "pos_x", "position_x", "translation_x", "p_rs_r_x", "easting"),
    "y": ("y", "ty", "py", "p_y", "pos_y", "position_y", "translation_y", "p_rs_r_y", "northing"),
    "z": ("z", "tz", "pz", "p_z", "pos_z", "position_z", "translation_z", "p_rs_r_z", "altitude"),
    "lat": ("lat", "latitude"),
    "lon": ("lon", "long", "lng", "longitude"),
    "height": ("height", "h_ell", "ellipsoidal_height", "altitude", "alt"),
    "roll": ("roll", "roll_angle"),
    "pitch": ("pitch", "pitch_angle"),
    "yaw": ("yaw", "yaw_angle", "theta"),
    "heading": ("heading", "true_heading", "hdg", "azimuth"),
    "secs": ("header_stamp_secs", "header_stamp_sec", "stamp_secs", "stamp_sec", "secs", "sec"),
    "nsecs": (
        *("header_stamp_nsecs", "header_stamp_nanosec", "stamp_nsecs", "stamp_nanosec"),
        *("nsecs", "nanosec"),
    ),
    **{
        f"{kind}{axis}": tuple(f"{name}{axis}" for name in names.split())
        for kind, names in _BEGINNINGS.items()
        for axis in "xyzw"
    },
    **{name: (name,) for name in (*MATRIX, *UNNAMED)},
}
# Names that stand for a part of an orientation, even if it is not known which.
_ORIENTED = re.compile(r"(^|[^a-z])q(\d|uat|$)|orient|rot|angle|euler|attitude", re.I).search

# Units as names have them, with a slash for what separates words.
_UNITS = {
    **{unit: unit for unit in ("m", "mm", "cm", "deg", "rad", "deg/s", "rad/s", *STAMP_UNITS)},
    **dict.fromkeys(("degree", "degrees", "°"), "deg"),
    **dict.fromkeys(("radian", "radians"), "rad"),
    **dict.fromkeys(("dps", "°/s"), "deg/s"),
}


class Columns(NamedTuple):
    """Where stamp and values stand in a row: the stamp in one column, in those of seconds and
    nanoseconds, or in none; the column of each quantity, such as "x" or "qw", and the units that
    the header names (empty for none); and what they measure, one of config.MEASURES.
    """

    stamp: list[int]
    quantities: dict[str, int]
    measures: str = "poses"
    stamp_unit: str = ""
    units: Mapping[str, str] = MappingProxyType({})


def choose_columns(path: object, names: Sequence[str], measures: str = "auto") -> Columns:
    """Find the columns of the stamp, if there is one, and of what is measured: position and
    orientation, or what there is of them, or angular rates.

    Raises
    ------
    InputError
        If one is missing, or several have the same meaning.
    """
    found = _matches(names)
    # The stamp of the message's header rather than the time of its arrival.
    stamp = ("secs", "nsecs") if {"secs", "nsecs"} <= found.keys() else ("t",) * ("t" in found)
    measures, measured = _measured(found, names, measures)
    if missing := [name for name in measured if name not in found]:
        raise InputError(
            f"{path}: no column for {', '.join(missing)} among {listed(names)}; name all columns "
            "with `columns`, such as t,x,y,z,qw,qx,qy,qz"
        )
    for name in (*stamp, *measured):
        if len(found[name]) > 1:
            raise InputError(
                f"{path}: columns {listed([names[index] for index in found[name]])} could all be "
                f"{name}; name them with `columns`"
            )
    at = {name: found[name][0] for name in measured}
    units = {name: unit for name, column in at.items() if (unit := _split(names[column])[1])}
    unit = _split(names[found["t"][0]])[1] if stamp == ("t",) else "ns" if stamp else ""
    return Columns([found[name][0] for name in stamp], at, measures, unit, units)


def _measured(
    found: dict[str, list[int]], names: Sequence[str], measures: str
) -> tuple[str, tuple[str, ...]]:
    """What the columns measure, "twists" being velocities, and the quantities to read for that:
    poses and the preferred quantities in doubt, so that what is missing is named.
    """

    def best(*groups: tuple[str, ...]) -> tuple[str, ...] | None:
        return next((group for group in groups if {*group} <= found.keys()), None)

    turn, heading = best(*_ORIENTATIONS), best(*_PLANAR_ORIENTATIONS)
    flat = best(*_ALL_POSITIONS)
    if measures == "auto":
        oriented = {*chain(*_ORIENTATIONS, *_PLANAR_ORIENTATIONS)}
        measures = "poses"
        if flat and not (found.keys() & oriented or any(map(_ORIENTED, names))):
            measures = "positions"
        elif not found.keys() & {*chain(*_POSITIONS)}:
            measures = "rates" if best(RATES) else "rotations" if turn else "poses"
    if measures == "poses" and MATRIX[0] in found:
        return measures, MATRIX
    orientation = turn or heading or QUATERNION
    is_planar = measures == "positions" or orientation in _PLANAR_ORIENTATIONS
    position = (flat if is_planar else best(*_POSITIONS)) or POSITION
    parts = {"rates": RATES, "twists": TWIST, "positions": position, "rotations": orientation}
    return measures, parts.get(measures, (*position, *orientation))


def are_columns(names: Sequence[str]) -> bool:
    """Whether these are names of columns, or some other text."""
    found = _matches(names).keys()
    return any({*group} <= found for group in (*_ALL_POSITIONS, RATES))


def _matches(names: Sequence[str]) -> dict[str, list[int]]:
    """Columns of each quantity, of those that have any: of one of its names; if there is none, of
    paths that end in one.
    """
    plain = [_split(name)[0] for name in names]
    found = {}
    for wanted, aliases in _ALIASES.items():
        # Of paths, the longest end that is known: position_x rather than x.
        ends = tuple(f"_{alias}" for alias in aliases if "_" in alias)
        found[wanted] = [index for index, name in enumerate(plain) if name in aliases] or [
            index for index, name in enumerate(plain) if name.endswith(ends)
        ]
    return {wanted: columns for wanted, columns in found.items() if columns}


def _split(name: str) -> tuple[str, str]:
    """A column's name without its unit, and the unit, empty if there is none:
    ``.pose.position.x [mm]`` to pose_position_x and mm, wx_deg_s to wx and deg/s.
    """
    name = name.strip().lower()
    words = re.findall("[a-z0-9°]+", re.sub(r"\[.*?\]|\(.*?\)", "", name))
    if in_brackets := re.search(r"[\[(]\s*([^\])]*?)\s*(?:\^?-1)?\s*[\])]$", name):
        return "_".join(words), _UNITS.get(re.sub(r"[\s/_]+", "/", in_brackets[1]), "")
    is_time = re.match("(t|time.*|stamp.*)$", words[0] if words else "") is not None
    for count in (2, 1):
        unit = _UNITS.get("/".join(words[-count:]), "")
        if len(words) > count and unit and (unit in STAMP_UNITS) == is_time:
            return "_".join(words[:-count]), unit
    return "_".join(words), ""


def listed(names: Sequence[str]) -> str:
    """Names of columns for a message."""
    return shortened(", ".join(names), _MOST_SHOWN)
