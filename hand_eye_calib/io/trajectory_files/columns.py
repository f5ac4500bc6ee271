"""Columns of a table by the names in its header."""

import re
from collections.abc import Sequence
from typing import NamedTuple

from hand_eye_calib.errors import InputError

# Columns that a message lists, and characters of a name that it shows.
_MOST_LISTED, _MOST_SHOWN = 15, 120

POSITION = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")
# Coefficients of a quaternion whose order is not known.
UNNAMED = ("q1", "q2", "q3", "q4")
# The first three rows of a pose's matrix.
MATRIX = tuple(f"m{row}{column}" for row in "123" for column in "1234")
# Sets of quantities that give a position or an orientation, the preferred first.
POSITIONS = (POSITION, ("lat", "lon", "height"), ("x", "y", "height"))
ORIENTATIONS = (QUATERNION, ("roll", "pitch", "yaw"), ("roll", "pitch", "heading"))
RATES = ("wx", "wy", "wz")
# Of a machine on a plane.
_PLANAR_POSITIONS = (("x", "y"), ("lat", "lon"))
_PLANAR_ORIENTATIONS = (("yaw",), ("heading",))
_ALL_POSITIONS = (*POSITIONS, *_PLANAR_POSITIONS)
_ALL_ORIENTATIONS = (*ORIENTATIONS, *_PLANAR_ORIENTATIONS)

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
}
_RATE_NAMES = (
    *("w", "w_", "omega_", "gyro_", "gyr_", "angvel_", "ang_vel_", "angular_velocity_"),
    *("angular_rate_", "rate_", "w_rs_s_"),
)
_ALIASES |= {f"w{axis}": tuple(name + axis for name in _RATE_NAMES) for axis in "xyz"}
# Names that stand for a part of an orientation, even if it is not known which.
_ORIENTED = re.compile(r"(^|[^a-z])q(\d|uat|$)|orient|rot|angle|euler|attitude", re.IGNORECASE)
_QUATERNION_NAMES = (
    *("q", "q_", "quat_", "quaternion_", "rot_", "orientation_", "rotation_", "q_rs_"),
)
_ALIASES |= {f"q{axis}": tuple(name + axis for name in _QUATERNION_NAMES) for axis in "xyzw"}

_LENGTHS = ("m", "mm", "cm", "km")
_ANGLES = {"deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg"} | dict.fromkeys(
    ("rad", "radian", "radians"), "rad"
)
_UNITS = "|".join([*_LENGTHS, *_ANGLES])
_STAMP_UNIT = re.compile(
    r"[\[(]\s*(s|ms|us|ns)\s*[\])]\s*$|^\W*(?:t|time|timestamp|stamp)_(s|ms|us|ns)$"
)
_RATE_UNIT = re.compile(r"(?:\b|_)(?:(rad|deg|°)(?:_?ps|\s*/\s*s|[ _]s(?:\^?-1)?)|(dps))[\])\s]*$")
_UNIT = re.compile(rf"[\[(]\s*({_UNITS})\s*[\])]\s*$|_({_UNITS})$")


class Columns(NamedTuple):
    """Where the stamp and the values of a pose stand in a row.

    Attributes
    ----------
    stamp : list of int
        One column, or those of seconds and nanoseconds.
    quantities : dict
        Name of each quantity to its column.
    stamp_unit : str
        As the header has it; empty if it names none.
    units : dict
        Units of quantities that the header names.
    """

    stamp: list[int]
    quantities: dict[str, int]
    stamp_unit: str
    units: dict[str, str]


def choose_columns(
    path: object, names: Sequence[str], has_stamps: bool = True, measures: str = "auto"
) -> Columns:
    """Find the columns of stamp, unless stamps come from elsewhere, and of what is measured:
    position and orientation, or what there is of them, or angular rates.

    Raises
    ------
    InputError
        If one is missing, or several have the same meaning.
    """
    found = _matches(names)
    # The stamp of the message's header rather than the time of its arrival.
    stamp: tuple[str, ...] = ()
    if has_stamps:
        stamp = ("secs", "nsecs") if {"secs", "nsecs"} <= found.keys() else ("t",)
    measured = _quantities(found, names, measures)
    wanted = (*stamp, *measured)
    missing = [name for name in wanted if name not in found]
    if missing:
        raise InputError(
            f"{path}: no column for {', '.join(missing)} among {listed(names)}; name all columns "
            "with `columns`, such as t,x,y,z,qw,qx,qy,qz"
        )
    for name in wanted:
        if len(found[name]) > 1:
            raise InputError(
                f"{path}: columns {listed([names[index] for index in found[name]])} could all be "
                f"{name}; name them with `columns`"
            )
    quantities = {name: found[name][0] for name in measured}
    return Columns(
        stamp=[found[name][0] for name in stamp],
        quantities=quantities,
        stamp_unit=_stamp_unit(names[found["t"][0]]) if stamp == ("t",) else "ns",
        units={name: unit for name, at in quantities.items() if (unit := _unit(names[at]))},
    )


def _quantities(
    found: dict[str, list[int]], names: Sequence[str], measures: str
) -> tuple[str, ...]:
    """The quantities to read: of poses, or of the part of them that is measured or is there."""
    orientation = _first_complete(_ALL_ORIENTATIONS, found)
    is_planar = orientation in _PLANAR_ORIENTATIONS
    position = _first_complete(_ALL_POSITIONS if is_planar else POSITIONS, found)
    if measures == "auto":
        measures = _what_is_there(found, names)
    if measures == "positions":
        return _first_complete(_ALL_POSITIONS, found)
    parts = {"rates": RATES, "rotations": orientation}
    return parts.get(measures, (*position, *orientation))


def _what_is_there(found: dict[str, list[int]], names: Sequence[str]) -> str:
    """What the columns measure; poses in doubt, so that what is missing is named."""
    has_position, has_orientation, has_rates = (
        any(set(group) <= found.keys() for group in groups)
        for groups in (_ALL_POSITIONS, ORIENTATIONS, (RATES,))
    )
    if has_position:
        is_oriented = _has_any(_ALL_ORIENTATIONS, found) or any(map(_ORIENTED.search, names))
        return "poses" if is_oriented else "positions"
    if _has_any(POSITIONS, found):
        return "poses"
    if has_rates:
        return "rates"
    return "rotations" if has_orientation else "poses"


def _has_any(groups: Sequence[tuple[str, ...]], found: dict[str, list[int]]) -> bool:
    return any(name in found for group in groups for name in group)


def measured_by(quantities: Sequence[str]) -> str:
    """What quantities of :func:`choose_columns` measure, one of config.MEASURES."""
    if not {"x", "lat", "m11"} & {*quantities}:
        return "rates" if RATES[0] in quantities else "rotations"
    last = quantities[-1]
    return "positions" if any(last == group[-1] for group in _ALL_POSITIONS) else "poses"


def are_columns(names: Sequence[str]) -> bool:
    """Whether these are names of columns, or some other text."""
    found = _matches(names)
    return any(set(group) <= found.keys() for group in (*_ALL_POSITIONS, RATES))


def _matches(names: Sequence[str]) -> dict[str, list[int]]:
    """Columns of each quantity, of those that have any."""
    plain = [_plain(name) for name in names]
    found = {wanted: _matching(plain, aliases) for wanted, aliases in _ALIASES.items()}
    return {wanted: columns for wanted, columns in found.items() if columns}


def _matching(plain: list[str], aliases: Sequence[str]) -> list[int]:
    """Columns of one of these names; if there is none, of paths that end in one."""
    # Of paths, the longest end that is known: position_x rather than x.
    ends = tuple(f"_{alias}" for alias in aliases if "_" in alias)
    return [index for index, name in enumerate(plain) if name in aliases] or [
        index for index, name in enumerate(plain) if name.endswith(ends)
    ]


def _first_complete(
    groups: Sequence[tuple[str, ...]], found: dict[str, list[int]]
) -> tuple[str, ...]:
    """The first group of which every quantity has a column; the first of all if none has."""
    return next((group for group in groups if set(group) <= found.keys()), groups[0])


def listed(names: Sequence[str]) -> str:
    """Names of columns for a message, which must not grow with the file."""
    text = ", ".join(name[:_MOST_SHOWN] for name in names[:_MOST_LISTED])
    return text if len(names) <= _MOST_LISTED else f"{text} and {len(names) - _MOST_LISTED} more"


def _plain(name: str) -> str:
    """A column's name without its unit: ``.pose.position.x [m]`` to ``pose_position_x``."""
    name = re.sub(r"\[.*?\]|\(.*?\)", "", name).strip().lower()
    name = _RATE_UNIT.sub("", name)
    name = re.sub(r"[^a-z0-9°]+", "_", name).strip("_")
    if name.startswith(("t_", "time", "stamp")):
        return re.sub(r"_(s|ms|us|ns)$", "", name)
    return re.sub(rf"_({_UNITS})$", "", name)


def _stamp_unit(name: str) -> str:
    """Unit of the stamps in a column's name, empty if it has none."""
    found = _STAMP_UNIT.search(name.strip().lower())
    return (found[1] or found[2]) if found else ""


def _unit(name: str) -> str:
    """Unit of a length, an angle or a rate in a column's name, empty if it has none."""
    if rate := _RATE_UNIT.search(name.strip().lower()):
        return "deg/s" if rate[1] != "rad" else "rad/s"
    found = _UNIT.search(name.strip().lower())
    unit = (found[1] or found[2]) if found else ""
    return _ANGLES.get(unit, unit)
