"""Quantities, units and kind of data of a table, recognised from the names of its columns.

A quantity is the content of a column, such as "x", "qw", "lat" or "t". Each quantity has a list of
names that programs use for it. The kind of data is "poses", "positions", "rotations", "rates" or
"twists".
"""

import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence

from hand_eye_calib.core.base.config import STAMP_UNITS

POSITION = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")
TUM_COLUMNS = "timestamp tx ty tz qx qy qz qw"
#: Coefficients of a quaternion with the scalar first.
SCALAR_FIRST = ("q0", "q1", "q2", "q3")
#: Coefficients of a quaternion whose order is not known.
UNNAMED = ("q1", "q2", "q3", "q4")
ROTATION_VECTOR = ("rotvec_x", "rotvec_y", "rotvec_z")
#: Elements of the first three rows of the matrix of a pose, row by row; m14 is a translation.
MATRIX = tuple(f"m{row}{column}" for row in "123" for column in "1234")
ROTATION = tuple(f"m{row}{column}" for row in "123" for column in "123")
TRANSLATION = tuple(f"m{row}4" for row in "123")
LAST_ROW = tuple(f"m4{column}" for column in "1234")
RATES = ("wx", "wy", "wz")
TWIST = ("vx", "vy", "vz", *RATES)
# Groups of quantities that are a position. The first group has priority.
_POSITIONS = (POSITION, ("lat", "lon", "height"), ("x", "y", "height"))
#: Groups of quantities that are the position of a vehicle on a plane.
PLANAR_POSITIONS = (("x", "y"), ("lat", "lon"))
# Groups of quantities that are an orientation. The first group has priority.
_ORIENTATIONS = (
    QUATERNION,
    SCALAR_FIRST,
    ("roll", "pitch", "yaw"),
    ("roll", "pitch", "heading"),
    ROTATION_VECTOR,
    UNNAMED,
)
_PLANAR_ORIENTATIONS = (("yaw",), ("heading",))
_POSITION_QUANTITIES = {name for group in _POSITIONS for name in group}
_ORIENTATION_QUANTITIES = {
    name for group in (*_ORIENTATIONS, *_PLANAR_ORIENTATIONS) for name in group
}

# Names of a coordinate of a position. {0} is the axis (x), {1} its number (0), and {2} names of
# this axis only (easting).
_POSITION_NAMES = (
    "{0} t{0} t_{0} p{0} p_{0} pos_{0} position_{0} translation_{0} position{1} "
    "actual_tcp_pose_{1} ecef_{0} {0}_ecef {0}_ecf {2}"
)
_DIRECTIONS = {
    "x": "easting pos_east",
    "y": "northing pos_north",
    "z": "altitude pos_up",
}
# First parts of the names of angular rates, velocities and quaternions. The axis, or the
# coefficient of the quaternion, follows.
_BEGINNINGS = {
    "w": "w w_ omega_ gyro_ gyr_ angvel_ ang_vel_ angular_velocity_ angular_rate_ rate_",
    "v": "v",
    "q": "q q_ o quat_ quaternion_ rot_ orientation_ rotation_",
}
# Names of each quantity, in lower case without accents, with underscores between words. A file
# that was exported from a bag has a whole path such as .pose.pose.position.x as the name of a
# column. The end of the path is compared with the names.
_NAMES = {
    "header": "header_stamp",
    "t": "t ts time timestamp timestamps stamp gpstime gps_time sim_time tracking_timestamp "
    "datetime date_time utc utctime utc_time time_utc time_of_day epoch unix_time unixtime "
    "ros_time rostime zeit zeitstempel aika temps tiempo tempo",
    "date": "date day utc_date date_utc gps_date",
    "week": "week gpsweek gps_week week_number weeknumber weekno week_no gps_week_no weeks wn wnc "
    "gps_wn gwk",
    "sow": "sow tow gps_sow gpssow gps_tow gpstow gps_seconds gpsseconds gpssec seconds_of_week "
    "second_of_week secs_of_week week_seconds time_of_week timeofweek tow_sec tow_secs sow_sec",
    "mow": "itow gms mow towms tow_msec gps_week_ms week_ms week_msec week_milliseconds "
    "gps_milliseconds gps_ms ms_of_week msec_of_week milliseconds_of_week",
    **{
        axis: _POSITION_NAMES.format(axis, number, names)
        for number, (axis, names) in enumerate(_DIRECTIONS.items())
    },
    "lat": "lat latitude breitengrad",
    "lon": "lon long lng longitude langengrad laengengrad",
    "height": "height ht h_ell h_msl height_msl ellipsoid_height ellipsoidal_height altitude alt "
    "elevation ele hohe hoehe hauteur altura quota",
    "roll": "roll roll_angle rollwinkel wankwinkel roulis alabeo rollio",
    "pitch": "pitch pitch_angle nick nickwinkel tangage cabeceo beccheggio",
    "yaw": "yaw yaw_angle theta gier gierwinkel lacet guinada imbardata",
    "heading": "heading true_heading platform_heading hdg azimuth",
    "secs": "stamp_secs stamp_sec secs sec",
    "nsecs": "stamp_nsecs stamp_nanosec stamp_nsec nsecs nanosec nsec",
    "image": "image",
    "sensor": "device_id device_name sensor_id sensor_name camera_id camera_name child_frame_id "
    "rigid_body body_name object_name subject_name",
    **{
        f"{kind}{axis}": " ".join(
            f"{beginning}{axis}" for beginning in beginnings.split()
        )
        for kind, beginnings in _BEGINNINGS.items()
        for axis in "xyzw"
    },
    **{name: f"{name} quat_{name}" for name in (*SCALAR_FIRST, *UNNAMED)},
    "rotvec_x": "rotvec_x actual_tcp_pose_3 rx",
    "rotvec_y": "rotvec_y actual_tcp_pose_4 ry",
    "rotvec_z": "rotvec_z actual_tcp_pose_5 rz",
    **{name: name for name in MATRIX},
}
# Names without an underscore that may be the end of a longer name, such as gps_fix_latitude. Other
# short names ("x", "time") often are the end of the names of other quantities.
_ENDS = {
    "latitude",
    "longitude",
    "altitude",
    "itow",
    *QUATERNION,
    "tx",
    "ty",
    "tz",
}
# Names of an element of a matrix, at row and column: t_00, r11, rot_1_2, pose.T[0][3].
_ELEMENT = re.compile(
    r"(?:^|_)(?:m|r|t|h|rot|mat|matrix|rotation|pose|transform|rotm)_?(\d)_?(\d)$"
)
# Parts of names that indicate an orientation, even if no quantity was recognised. They are searched
# for in the names of all columns, joined by commas.
_ORIENTED = re.compile(
    r"(^|[^a-z])q(\d|uat|,|$)|orient|rot|angle|euler|attitude|"
    r"(^|,)(a,b,c|w,p,r|rx,ry,rz|ex,ey,ez|omega,phi,kappa)(,|$)"
)
# Parts of names that indicate a position.
_PLACED = re.compile(r"(^|[^a-z])(pos(?!e)|loc|trans|coord|north|east|utm)")

# Names of each unit, with a slash between words.
_UNIT_NAMES = {
    "m": "m metre metres meter meters",
    "mm": "mm",
    "cm": "cm",
    "ft": "ft feet",
    "deg": "deg degree degrees °",
    "rad": "rad radian radians",
    "deg/s": "deg/s dps °/s",
    "rad/s": "rad/s",
    "s": "s second seconds",
    "ms": "ms msec millisecond milliseconds",
    "us": "us usec µs μs microsecond microseconds",
    "ns": "ns nanosecond nanoseconds",
}
_UNITS = {
    name: unit for unit, names in _UNIT_NAMES.items() for name in names.split()
}
# Names of units in brackets. Without brackets, some of them mean something else at the end of a
# name: stamp_sec has the whole seconds of a stamp.
_UNITS_IN_BRACKETS = {
    **_UNITS,
    **dict.fromkeys(("sec", "secs"), "s"),
    "nsec": "ns",
    # Degrees, minutes and seconds.
    **dict.fromkeys(("d/m/s", "+/-d/m/s", "dms", "d/m"), "deg"),
}
# Words in the names of columns with a unit of time. "tow" and "sow" are the time and the second of
# a GPS week.
_TIME_WORD = re.compile(r"t|time.*|stamp.*|(?:gps|i)?(?:tow|sow)")
# Brackets with their content. A bracket that is not closed extends to the end of the name.
_BRACKETS = re.compile(r"[\[(]([^\])]*)([\])]|$)")


def named_columns(
    names: Sequence[str],
) -> tuple[dict[str, list[int]], list[str]]:
    """Return the columns of each quantity, and the unit in the name of each column.

    A column belongs to a quantity if its name is one of the quantity's names. If a quantity has no
    such column, a column whose name ends in one of the quantity's names is accepted.

    Parameters
    ----------
    names : (N,) sequence of str

    Returns
    -------
    columns : dict of str to list of int
        Indices of the columns of each quantity; quantities without a column are missing.
    units : (N,) list of str
        Unit of each column; empty if the name has no unit.
    """
    split = [_split(name) for name in names]
    plain = [name for name, _ in split]
    units = [unit for _, unit in split]
    columns: dict[str, list[int]] = {}
    for quantity, text in _NAMES.items():
        places = _places_of(text.split(), plain)
        if quantity in ROTATION_VECTOR:
            # In degrees, rx, ry and rz are Euler angles of an unknown order instead of a rotation
            # vector.
            places = [
                place
                for place in places
                if not (is_brief(plain[place]) and units[place] == "deg")
            ]
        if places:
            columns[quantity] = places
    columns |= _elements(plain, columns)
    return columns, units


def _places_of(aliases: Sequence[str], plain: Sequence[str]) -> list[int]:
    """Return the columns whose names are among the aliases of a quantity.

    If there are none, return the columns whose names end in an alias, such as pose_position_x for
    the alias position_x. An alias of one word must then be in ``_ENDS``.
    """
    places = [place for place, name in enumerate(plain) if name in aliases]
    if places:
        return places
    ends = tuple(
        f"_{alias}" for alias in aliases if "_" in alias or alias in _ENDS
    )
    return [place for place, name in enumerate(plain) if name.endswith(ends)]


def is_brief(name: str) -> bool:
    """Return whether the name of a column is rx, ry or rz.

    Universal Robots uses these names for a rotation vector, other makers for Euler angles.
    """
    return plain_name(name) in ("rx", "ry", "rz")


def _elements(
    plain: Sequence[str], columns: Mapping[str, list[int]]
) -> dict[str, list[int]]:
    """Return the columns of the elements m11 to m34 of a pose; empty if the rotation is incomplete.

    The names may count rows and columns of the matrix from 0 or from 1. The translation may have
    the names of a position.
    """
    places_of: dict[tuple[int, int], list[int]] = {}
    for place, name in enumerate(plain):
        if match := _ELEMENT.search(name):
            places_of.setdefault((int(match[1]), int(match[2])), []).append(
                place
            )
    # Names that count from 0 have an element 00.
    shift = 1 if (0, 0) in places_of else 0
    elements = {
        f"m{row + shift}{column + shift}": places
        for (row, column), places in places_of.items()
    }
    if not {*ROTATION} <= elements.keys():
        return {}
    for element, axis in zip(TRANSLATION, POSITION, strict=True):
        if axis in columns:
            elements.setdefault(element, columns[axis])
    return {name: places for name, places in elements.items() if name in MATRIX}


def measured(
    columns: Mapping[str, list[int]], names: Sequence[str], measures: str
) -> tuple[str, Sequence[str]]:
    """Return the kind of data in a table, and the quantities to read for this kind.

    If a quantity has no column, the caller raises an error that names it.

    Parameters
    ----------
    columns : mapping of str to list of int
        Columns of each quantity.
    names : sequence of str
        Names of all columns.
    measures : str
        "poses", "positions", "rotations", "rates", "twists", "stamps", or "auto" for the kind that
        the columns have.
    """
    position = _first_group((*_POSITIONS, *PLANAR_POSITIONS), columns)
    orientation = (
        _first_group((*_ORIENTATIONS, *_PLANAR_ORIENTATIONS), columns)
        or QUATERNION
    )
    has_matrix = {*ROTATION} <= columns.keys()
    if measures == "auto":
        measures = "poses" if has_matrix else _kind_of(columns, names)
    if measures == "poses":
        if has_matrix:
            return measures, MATRIX
        # A pose without a height is accepted only if its orientation is only a yaw or heading, as
        # for a vehicle on a plane.
        if (
            position in PLANAR_POSITIONS
            and orientation not in _PLANAR_ORIENTATIONS
        ):
            position = ()
        return measures, (*(position or POSITION), *orientation)
    quantities: dict[str, Sequence[str]] = {
        "rates": RATES,
        "twists": TWIST,
        "positions": position or POSITION,
        "rotations": orientation,
        "stamps": (),
    }
    return measures, quantities[measures]


def _first_group(
    groups: Iterable[Sequence[str]], columns: Mapping[str, list[int]]
) -> Sequence[str]:
    """Return the first group whose quantities all have columns; empty if there is none."""
    return next((group for group in groups if {*group} <= columns.keys()), ())


def _kind_of(columns: Mapping[str, list[int]], names: Sequence[str]) -> str:
    """Return the kind of data in columns without a matrix.

    Positions alone are "positions" only if no name indicates an orientation, and likewise for
    "rotations". Otherwise the table counts as "poses", so that an error reports the missing
    quantities.
    """
    listed = ",".join(plain_name(name) for name in names)
    if _first_group((*_POSITIONS, *PLANAR_POSITIONS), columns):
        has_orientation = (
            columns.keys() & _ORIENTATION_QUANTITIES or _ORIENTED.search(listed)
        )
        return "poses" if has_orientation else "positions"
    if columns.keys() & _POSITION_QUANTITIES:
        return "poses"
    if {*RATES} <= columns.keys():
        return "rates"
    if _first_group(_ORIENTATIONS, columns) and not _PLACED.search(listed):
        return "rotations"
    return "poses"


# Groups of quantities that are a stamp. The first group has priority: the stamp of a header before
# the time of arrival, and a date with a time of day before a GPS week. "sow" is the second of a GPS
# week, "mow" its millisecond.
_STAMPS = (
    ("secs", "nsecs"),
    ("header",),
    ("date", "t"),
    ("week", "sow"),
    ("week", "mow"),
    ("week", "t"),
    ("t",),
    ("sow",),
    ("mow",),
    ("date",),
)


# Parts of the names of accuracies and rates, which are no part of a pose.
_NO_POSE = re.compile(r"std|sd|sigma|cov|err|acc|rms|unc|dop|rate|vel|speed")
# Number of angles of an orientation.
_N_ANGLES = 3


def unknown_columns(
    names: Sequence[str], columns: Mapping[str, list[int]]
) -> list[int]:
    """Return the columns with a name that is not the name of a quantity."""
    known = {place for places in columns.values() for place in places}
    return [
        place
        for place, name in enumerate(names)
        if name.strip(" _") and place not in known
    ]


def unknown_angles(
    names: Sequence[str], units: Sequence[str], unknown: Sequence[int]
) -> list[int]:
    """Return the columns of an orientation with unknown names; empty if there is none.

    These are three unknown columns with a unit of angle.

    Parameters
    ----------
    names, units : (N,) sequence of str
        Names and units of all columns.
    unknown : sequence of int
        Columns with unknown names.
    """
    angles = [
        place
        for place in unknown
        if units[place] in ("deg", "rad")
        and not _NO_POSE.search(plain_name(names[place]))
    ]
    return angles if len(angles) == _N_ANGLES else []


def proposed_names(
    units: Sequence[str],
    columns: Mapping[str, list[int]],
    unknown: Sequence[int],
    angles: Sequence[int],
) -> str:
    """Return names for all columns, such as "t,x,y,z,roll_deg,pitch_deg,yaw_deg,_".

    Without a known height, the only other unknown column in a unit of length is the height.
    ``units``, ``unknown`` and ``angles`` are those of :func:`unknown_angles`; ``columns`` are the
    known columns.
    """
    quantities = dict.fromkeys(range(len(units)), "_")
    for quantity, places in columns.items():
        for place in places:
            if quantities[place] == "_":
                quantities[place] = quantity
    quantities |= dict(zip(angles, ("roll", "pitch", "yaw"), strict=False))
    lengths = [
        place for place in unknown if units[place] in ("m", "cm", "mm", "ft")
    ]
    if len(lengths) == 1 and not {"z", "height"} & columns.keys():
        quantities[lengths[0]] = "height" if "lat" in columns else "z"
    return ",".join(
        "_".join(filter(None, [quantities[place], unit.replace("/", "_")]))
        if quantities[place] != "_"
        else "_"
        for place, unit in enumerate(units)
    )


def stamp_columns(columns: Mapping[str, list[int]]) -> Sequence[str]:
    """Return the quantities that together are the stamp; empty if they have no columns.

    If there are a stamp "t", a GPS week and a second of this week, "t" is used: it is on the clock
    of the recording.
    """
    has_second = "sow" in columns or "mow" in columns
    if has_second and {"week", "t"} <= columns.keys():
        return ("t",)
    return _first_group(_STAMPS, columns)


def is_pose(columns: Iterable[str]) -> bool:
    """Return whether quantities include a position, rates, or a rotation matrix."""
    groups = (*PLANAR_POSITIONS, RATES, ROTATION)
    return any({*group} <= {*columns} for group in groups)


def plain_name(name: str) -> str:
    """Return a column's name without its unit."""
    return _split(name)[0]


def _split(name: str) -> tuple[str, str]:
    """Return a column's name without its unit, and its unit, which may be empty.

    ``.pose.position.x [mm]`` becomes pose_position_x and mm; wx_deg_s becomes wx and deg/s.
    """
    name = _without_accents(name.strip().lower())
    # An index such as in q[0] or T[0][3] is not a unit in brackets. Write it as q_0_.
    if re.search(r"\[\d\]$", name):
        name = re.sub(r"\[(\d)\]", r"_\1_", name)
    # Remove frame names, such as in p_RS_R_x of EuRoC and tx_world_device of Aria.
    name = re.sub(
        r"^([pqw])_[a-z]{2}(_[a-z])?_|_(world|odometry)_device$", r"\1_", name
    )
    # Remove brackets with their content. Text after a bracket that is not closed is kept.
    outside = _BRACKETS.sub(
        lambda match: "" if match[2] else f" {match[1]}", name
    )
    words = re.findall("[a-z0-9°µμ]+", outside)
    in_brackets = [match[1] for match in _BRACKETS.finditer(name) if match[2]]
    if in_brackets and name.endswith(("]", ")")):
        return "_".join(words), _unit_in_brackets(in_brackets[-1])
    return _split_words(words)


def _without_accents(text: str) -> str:
    """Return a text with plain letters instead of letters with accents."""
    letters = unicodedata.normalize("NFD", text)
    return "".join(
        letter for letter in letters if not unicodedata.combining(letter)
    )


def _unit_in_brackets(text: str) -> str:
    """Return the unit in the brackets of a name, such as deg/s for "deg s^-1"."""
    unit = text.strip().removesuffix("-1").removesuffix("^").strip()
    return _UNITS_IN_BRACKETS.get(re.sub(r"[\s/_]+", "/", unit), "")


def _split_words(words: list[str]) -> tuple[str, str]:
    """Return the joined words of a name without the unit at its end, and this unit.

    A unit of time is accepted after a word of time only, and other units after other words only.
    """
    # The number of a coefficient or axis, such as in q_0 and position_1, belongs to the name.
    if (
        len(words) > 1
        and words[-1].isdigit()
        and words[-2] in ("q", "position")
    ):
        return "_".join(words[:-1]) + words[-1], ""
    is_time = any(_TIME_WORD.fullmatch(word) for word in words)
    for n_words in (2, 1):
        unit = _UNITS.get("/".join(words[-n_words:]), "")
        is_unit_of_time = unit in STAMP_UNITS
        if unit and is_unit_of_time == is_time and len(words) > n_words:
            return "_".join(words[:-n_words]), unit
    return "_".join(words), ""
