"""What the columns of a table are, by their names: quantities, units, and what they measure."""

import re
from collections.abc import Iterable, Mapping, Sequence

from hand_eye_calib.core.base.config import STAMP_UNITS

POSITION = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")
TUM_COLUMNS = "timestamp tx ty tz qx qy qz qw"
# Coefficients of a quaternion with the scalar first, and of one whose order is not known.
SCALAR_FIRST = ("q0", "q1", "q2", "q3")
UNNAMED = ("q1", "q2", "q3", "q4")
ROTATION_VECTOR = ("rotvec_x", "rotvec_y", "rotvec_z")
# The first three rows of a pose's matrix, and its rotation and translation.
MATRIX = tuple(f"m{row}{column}" for row in "123" for column in "1234")
ROTATION = tuple(f"m{row}{column}" for row in "123" for column in "123")
TRANSLATION = tuple(f"m{row}4" for row in "123")
LAST_ROW = tuple(f"m4{column}" for column in "1234")
RATES = ("wx", "wy", "wz")
TWIST = ("vx", "vy", "vz", *RATES)
# Sets of quantities that give a position or an orientation, the preferred first; of a machine on a
# plane, fewer.
_POSITIONS = (POSITION, ("lat", "lon", "height"), ("x", "y", "height"))
PLANAR_POSITIONS = (("x", "y"), ("lat", "lon"))
_ORIENTATIONS = (
    QUATERNION,
    SCALAR_FIRST,
    ("roll", "pitch", "yaw"),
    ("roll", "pitch", "heading"),
    ROTATION_VECTOR,
    UNNAMED,
)
_PLANAR_ORIENTATIONS = (("yaw",), ("heading",))

# What stands before the axis in names of angular rates, velocities and quaternions.
_BEGINNINGS = {
    "w": "w w_ omega_ gyro_ gyr_ angvel_ ang_vel_ angular_velocity_ angular_rate_ rate_",
    "v": "v",
    "q": "q q_ o quat_ quaternion_ rot_ orientation_ rotation_",
}
_OF_POSITION = "{0} t{0} t_{0} p{0} p_{0} pos_{0} position_{0} translation_{0} "
# Last parts of column names, lower case, words joined by underscores; exports of bags have whole
# paths such as .pose.pose.position.x.
_ALIASES = {
    "header": "header_stamp",
    "t": "t ts time timestamp timestamps stamp gpstime gps_time sim_time tracking_timestamp "
    "datetime date_time utc utctime utc_time time_utc time_of_day epoch unix_time unixtime "
    "ros_time rostime",
    "date": "date day utc_date date_utc gps_date",
    "week": "week gpsweek gps_week week_number weeknumber weekno week_no gps_week_no weeks wn wnc "
    "gps_wn gwk",
    "sow": "sow tow gps_sow gpssow gps_tow gpstow gps_seconds gpsseconds gpssec seconds_of_week "
    "second_of_week secs_of_week week_seconds time_of_week timeofweek tow_sec tow_secs sow_sec",
    "mow": "itow gms mow towms tow_msec gps_week_ms week_ms week_msec week_milliseconds "
    "gps_milliseconds gps_ms ms_of_week msec_of_week milliseconds_of_week",
    "x": _OF_POSITION.format("x")
    + "easting pos_east position0 actual_tcp_pose_0 ecef_x x_ecef x_ecf",
    "y": _OF_POSITION.format("y")
    + "northing pos_north position1 actual_tcp_pose_1 ecef_y y_ecef y_ecf",
    "z": _OF_POSITION.format("z") + "altitude pos_up position2 actual_tcp_pose_2 "
    "ecef_z z_ecef z_ecf",
    "lat": "lat latitude",
    "lon": "lon long lng longitude",
    "height": "height ht h_ell h_msl height_msl ellipsoid_height ellipsoidal_height altitude alt "
    "elevation ele",
    "roll": "roll roll_angle",
    "pitch": "pitch pitch_angle",
    "yaw": "yaw yaw_angle theta",
    "heading": "heading true_heading platform_heading hdg azimuth",
    "secs": "stamp_secs stamp_sec secs sec",
    "nsecs": "stamp_nsecs stamp_nanosec stamp_nsec nsecs nanosec nsec",
    "image": "image",
    "sensor": "device_id device_name sensor_id sensor_name camera_id camera_name child_frame_id "
    "rigid_body body_name object_name subject_name",
    **{
        f"{kind}{axis}": " ".join(f"{name}{axis}" for name in names.split())
        for kind, names in _BEGINNINGS.items()
        for axis in "xyzw"
    },
    **{name: f"{name} quat_{name}" for name in (*SCALAR_FIRST, *UNNAMED)},
    **{
        name: f"{name} actual_tcp_pose_{k} r{name[-1]}" for k, name in enumerate(ROTATION_VECTOR, 3)
    },
    **{name: name for name in MATRIX},
}
# Names without an underscore that paths may end in, such as gps_fix_latitude.
_ENDS = {
    *("latitude", "longitude", "altitude"),
    "itow",
    *QUATERNION,
    *(f"t{axis}" for axis in POSITION),
}
# An element of a matrix: t_00, r11, rot_1_2, pose.T[0][3].
_ELEMENT = re.compile(
    r"(?:^|_)(?:m|r|t|h|rot|mat|matrix|rotation|pose|transform|rotm)_?(\d)_?(\d)$"
)
# Names, after each other, of some part of an orientation or of a position, known or not.
_ORIENTED = re.compile(
    r"(^|[^a-z])q(\d|uat|,|$)|orient|rot|angle|euler|attitude|"
    r"(^|,)(a,b,c|w,p,r|rx,ry,rz|ex,ey,ez|omega,phi,kappa)(,|$)"
).search
_PLACED = re.compile(r"(^|[^a-z])(pos(?!e)|loc|trans|coord|north|east|utm)").search

# Units as names have them, with a slash for what separates words.
_UNITS = {
    **{
        unit: unit for unit in ("m", "mm", "cm", "ft", "deg", "rad", "deg/s", "rad/s", *STAMP_UNITS)
    },
    "feet": "ft",
    **dict.fromkeys(("metre", "metres", "meter", "meters"), "m"),
    **dict.fromkeys(("degree", "degrees", "°"), "deg"),
    **dict.fromkeys(("radian", "radians"), "rad"),
    **dict.fromkeys(("dps", "°/s"), "deg/s"),
    **dict.fromkeys(("second", "seconds"), "s"),
    **dict.fromkeys(("msec", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("usec", "µs", "μs", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("nanosecond", "nanoseconds"), "ns"),
}
# In brackets only: as last words they are names of their own, such as stamp_sec.
_UNITS_IN_BRACKETS = {
    **_UNITS,
    **dict.fromkeys(("sec", "secs"), "s"),
    "nsec": "ns",
    # Degrees, minutes and seconds.
    **dict.fromkeys(("d/m/s", "+/-d/m/s", "dms", "d/m"), "deg"),
}
# Words of stamps, the last for seconds of a week of GPS: a unit behind them is one of time.
_TIME_WORD = re.compile(r"t|time.*|stamp.*|(?:gps|i)?(?:tow|sow)")
_OPENING = "[("
_CLOSING = "])"


def named_columns(names: Sequence[str]) -> tuple[dict[str, list[int]], list[str]]:
    """Columns of the quantities that have any: those with one of its names; if there is none, those
    with a path that ends in one; and the units in the names, empty for none.
    """
    split = [_split(name) for name in names]
    plain = [name for name, _ in split]
    columns: dict[str, list[int]] = {}
    for quantity, aliases in _ALIASES.items():
        known = aliases.split()
        # Of paths, the longest end that is known: position_x rather than x.
        ends = tuple(f"_{alias}" for alias in known if "_" in alias or alias in _ENDS)
        places = [at for at, name in enumerate(plain) if name in known]
        places = places or [at for at, name in enumerate(plain) if name.endswith(ends)]
        if quantity in ROTATION_VECTOR:
            # In degrees they are rather angles, in an order that nothing names.
            places = [at for at in places if not (is_brief(names[at]) and split[at][1] == "deg")]
        if places:
            columns[quantity] = places
    columns |= _elements(plain, columns)
    return columns, [unit for _, unit in split]


def is_brief(name: str) -> bool:
    """Whether a column is called rx, ry or rz: a rotation vector of Universal Robots, or angles of
    other robots.
    """
    return plain_name(name) in ("rx", "ry", "rz")


def _elements(plain: Sequence[str], columns: Mapping[str, list[int]]) -> dict[str, list[int]]:
    """Columns of the elements of a matrix, counted from 0 or from 1; the translation may have the
    names of a position.
    """
    matches = [_ELEMENT.search(name) for name in plain]
    counts = [(int(match[1]), int(match[2])) if match else None for match in matches]
    first = 0 if (0, 0) in counts else 1
    elements: dict[str, list[int]] = {}
    for place, count in enumerate(counts):
        if count:
            row, column = count
            elements.setdefault(f"m{row - first + 1}{column - first + 1}", []).append(place)
    if not {*ROTATION} <= elements.keys():
        return {}
    by_name = dict(zip(TRANSLATION, POSITION, strict=True))
    for element, axis in by_name.items():
        if element not in elements and axis in columns:
            elements[element] = columns[axis]
    return {name: places for name, places in elements.items() if name in MATRIX}


def measured(
    columns: Mapping[str, list[int]], names: Sequence[str], measures: str
) -> tuple[str, Sequence[str]]:
    """What the columns measure, and the quantities to read for that: poses and the preferred
    quantities in doubt, so that what is missing is named.
    """
    groups = [*_POSITIONS, *PLANAR_POSITIONS, *_ORIENTATIONS, *_PLANAR_ORIENTATIONS]
    groups = [group for group in groups if {*group} <= columns.keys()]
    flat = next((group for group in groups if group in (*_POSITIONS, *PLANAR_POSITIONS)), ())
    turn = next((group for group in groups if group in _ORIENTATIONS), ())
    heading = next((group for group in groups if group in _PLANAR_ORIENTATIONS), ())
    has_matrix = {*ROTATION} <= columns.keys()
    if measures == "auto":
        oriented = {*sum((*_ORIENTATIONS, *_PLANAR_ORIENTATIONS), ())}
        measures = "poses"
        listed = ",".join(plain_name(name) for name in names)
        if has_matrix:
            measures = "poses"
        elif flat and not (columns.keys() & oriented or _ORIENTED(listed)):
            measures = "positions"
        elif not columns.keys() & {*sum(_POSITIONS, ())}:
            is_turning = turn and not _PLACED(listed)
            measures = (
                "rates" if {*RATES} <= columns.keys() else "rotations" if is_turning else "poses"
            )
    if measures == "poses" and has_matrix:
        return measures, MATRIX
    orientation: Sequence[str] = turn or heading or QUATERNION
    is_planar = measures == "positions" or orientation in _PLANAR_ORIENTATIONS
    position = flat if flat and (is_planar or flat in _POSITIONS) else POSITION
    parts = {"rates": RATES, "twists": TWIST, "positions": position, "rotations": orientation}
    parts["stamps"] = ()
    return measures, parts.get(measures, (*position, *orientation))


#: Ways to give a stamp, the preferred first: the stamp of the message's header rather than the
#: time of its arrival; a date and a time of day; a week of GPS and its second or millisecond.
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
    (),
)


def stamp_columns(columns: Mapping[str, list[int]]) -> Sequence[str]:
    """Return the quantities that give the stamp; none if there are none.

    A stamp beside a week of GPS and its second is on the clock of the recording.
    """
    has_second = "sow" in columns or "mow" in columns
    if has_second and {"week", "t"} <= columns.keys():
        return ("t",)
    return next(way for way in _STAMPS if {*way} <= columns.keys())


def is_pose(columns: Iterable[str]) -> bool:
    """Whether there are columns of a position, of rates, or of a rotation's matrix."""
    groups = (*PLANAR_POSITIONS, RATES, ROTATION)
    return any({*group} <= {*columns} for group in groups)


def plain_name(name: str) -> str:
    """A column's name without its unit."""
    return _split(name)[0]


def _split(name: str) -> tuple[str, str]:
    """A column's name without its unit, and the unit, empty if there is none:
    ``.pose.position.x [mm]`` to pose_position_x and mm, wx_deg_s to wx and deg/s.
    """
    name = name.strip().lower()
    # An element such as q[0] or T[0][3].
    name = re.sub(r"\[(\d)\]", r"_\1_", name) if re.search(r"\[\d\]$", name) else name
    # Frames as in p_RS_R_x.
    name = re.sub(r"^([pqw])_[a-z]{2}(_[a-z])?_|_(world|odometry)_device$", r"\1_", name)
    outside, inside = _brackets(name)
    words = re.findall("[a-z0-9°µμ]+", outside)
    if inside is not None:
        unit = re.sub(r"[\s/_]+", "/", _without_inverse(inside))
        return "_".join(words), _UNITS_IN_BRACKETS.get(unit, "")
    if len(words) > 1 and words[-1].isdigit() and words[-2] in ("q", "position"):
        return "_".join([*words[:-2], words[-2] + words[-1]]), ""
    is_time = any(_TIME_WORD.fullmatch(word) for word in words)
    for count in (2, 1):
        unit = _UNITS.get("/".join(words[-count:]), "")
        if len(words) > count and unit and (unit in STAMP_UNITS) == is_time:
            return "_".join(words[:-count]), unit
    return "_".join(words), ""


def _brackets(name: str) -> tuple[str, str | None]:
    """A name without what it has in brackets, and what the last brackets at its end have, if any;
    in one pass.
    """
    outside: list[str] = []
    inside: list[str] = []
    last: str | None = None
    is_inside = False
    for letter in name:
        if letter in _OPENING and not is_inside:
            is_inside = True
            inside = []
        elif letter in _CLOSING and is_inside:
            is_inside = False
            last = "".join(inside)
        elif is_inside:
            inside.append(letter)
        else:
            outside.append(letter)
    if is_inside:
        outside += [" ", *inside]
    at_end = name.endswith(tuple(_CLOSING))
    return "".join(outside), last if at_end else None


def _without_inverse(unit: str) -> str:
    """A unit such as "deg s" for "deg s^-1"."""
    return unit.strip().removesuffix("-1").removesuffix("^").strip()
