"""The numbers of a trajectory, row by row, before they become poses: what the columns are by their
names, and what stands in them; and rows as they are written.
"""

import re
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, Self

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.config import STAMP_UNITS
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.files import LONGEST_NAME, write_atomically, writing
from hand_eye_calib.text import shortened, shown_value

POSITION = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")
TUM_COLUMNS = "timestamp tx ty tz qx qy qz qw"
# Coefficients of a quaternion with the scalar first, and of one whose order is not known.
SCALAR_FIRST = ("q0", "q1", "q2", "q3")
UNNAMED = ("q1", "q2", "q3", "q4")
ROTATION_VECTOR = ("rotvec_x", "rotvec_y", "rotvec_z")
# The first three rows of a pose's matrix.
MATRIX = tuple(f"m{row}{column}" for row in "123" for column in "1234")
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
    "t": "t ts time timestamp timestamps stamp gpstime gps_time sim_time tracking_timestamp",
    "x": _OF_POSITION.format("x") + "easting pos_east position0 actual_tcp_pose_0",
    "y": _OF_POSITION.format("y") + "northing pos_north position1 actual_tcp_pose_1",
    "z": _OF_POSITION.format("z") + "altitude pos_up position2 actual_tcp_pose_2",
    "lat": "lat latitude",
    "lon": "lon long lng longitude",
    "height": "height ht h_ell ellipsoid_height ellipsoidal_height altitude alt elevation ele",
    "roll": "roll roll_angle",
    "pitch": "pitch pitch_angle",
    "yaw": "yaw yaw_angle theta",
    "heading": "heading true_heading platform_heading hdg azimuth",
    "secs": "stamp_secs stamp_sec secs sec",
    "nsecs": "stamp_nsecs stamp_nanosec stamp_nsec nsecs nanosec nsec",
    "image": "image",
    **{
        f"{kind}{axis}": " ".join(f"{name}{axis}" for name in names.split())
        for kind, names in _BEGINNINGS.items()
        for axis in "xyzw"
    },
    **{name: f"{name} quat_{name}" for name in (*SCALAR_FIRST, *UNNAMED)},
    **{
        name: f"{name} actual_tcp_pose_{k} r{name[-1]}" for k, name in enumerate(ROTATION_VECTOR, 3)
    },
    **{name: f"{name} t{int(name[1:]) - 11:02d}" for name in MATRIX},
}
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
    **dict.fromkeys(("degree", "degrees", "°"), "deg"),
    **dict.fromkeys(("radian", "radians"), "rad"),
    **dict.fromkeys(("dps", "°/s"), "deg/s"),
}
#: Digits before the point of stamps since 1970; of seconds, fewer.
DIGITS = {"ns": 17, "us": 14, "ms": 11}
#: A number, or a time as of ISO 8601.
NUMBER = re.compile(
    r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|nan|[-+]?inf|\d{4}-\d\d-\d\d[t ]\d.*", re.IGNORECASE
)


@dataclass
class Table:
    """The rows of a file: their line numbers, stamps (none without a column of them), and values,
    one row after the other; the names of their images, if there is a column of them.

    ``path`` is what messages call it, ``names`` are those of all columns. ``measures`` says what
    to read, one of config.MEASURES, "twists" for velocities, or "auto", which becomes what the
    columns are; ``expected`` is what a row should be, for messages. Found are the column of each
    quantity (``at``), such as "x" or "qw", those of the stamp (``stamp_at``: one, or that of
    seconds and that of nanoseconds), and the ``units`` of quantities and of "t" in the names.
    ``guesses`` are what a person should know of how the file was read, ``conventions`` those of
    its angles that the motion does not contradict, the usual first. An InputError if a column is
    missing, or several have the same meaning.
    """

    path: object
    names: Sequence[str]
    measures: str = "auto"
    expected: str = ""
    format: str = "csv"
    line_numbers: "array[int]" = field(default_factory=lambda: array("q"))
    stamps: list[Decimal] = field(default_factory=list)
    numbers: "array[float]" = field(default_factory=lambda: array("d"))
    images: list[str] = field(default_factory=list)
    guesses: list[str] = field(default_factory=list)
    conventions: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        found, units = named_columns(self.names)
        self.expected = self.expected or f"{len(self.names)} columns: {self._listed()}"
        self.measures, measured = _measured(found, self.names, self.measures)
        # The stamp of the message's header rather than the time of its arrival.
        ways = (("secs", "nsecs"), ("header",), ("t",), ())
        stamp = next(way for way in ways if {*way} <= found.keys())
        if missing := [name for name in measured if name not in found]:
            listed = self._listed()
            no_pose = " (accelerations show no pose)" * bool(re.search(r", a(cc\w*)?_?x", listed))
            raise InputError(
                f"{self.path}: no column for {', '.join(missing)} among {listed}{no_pose}; name "
                "all columns with `columns`, such as t,x,y,z,qw,qx,qy,qz, or roll_deg,pitch_deg,"
                "yaw_deg or rotvec_x,rotvec_y,rotvec_z for turns, or t,wx,wy,wz of a gyroscope; "
                "remove other text above the rows"
            )
        for name in (*stamp, *measured):
            if len(found[name]) > 1:
                raise InputError(
                    f"{self.path}: columns {self._listed(found[name])} could all be {name}; name "
                    "them with `columns`"
                )
        self.at = {name: found[name][0] for name in measured}
        self.stamp_at = [found[name][0] for name in stamp]
        self._image_at = found.get("image", ())
        self.units = {name: units[at] for name, at in self.at.items() if units[at]}
        self.units["t"] = "ns" if len(stamp) > 1 else units[self.stamp_at[0]] if stamp else ""

    def _listed(self, places: Iterable[int] | None = None) -> str:
        """The names of some columns, or of all, for a message."""
        names = self.names if places is None else [self.names[k] for k in places]
        return shortened(", ".join(names), LONGEST_NAME)

    def values(self, names: Iterable[str] = ()) -> FloatArray:
        """(N, k) array: the values of some quantities, or of all."""
        places, all_values = [*self.at], np.asarray(self.numbers).reshape(-1, len(self.at))
        return all_values[:, [places.index(name) for name in names]] if names else all_values

    def fill(
        self, lines: Iterable[tuple[int, Any]], cells_of: Callable[[Any], Sequence[str]]
    ) -> Self:
        """Add rows from their line numbers and texts; an InputError at the first line with another
        number of cells, or with something that is no number.
        """
        stamp_at, at, n_columns = self.stamp_at, [*self.at.values()], len(self.names)
        for number, text in lines:
            cells = cells_of(text)
            if len(cells) != n_columns:
                raise InputError(
                    f"{self.path}, line {number}: expected {self.expected}; found {len(cells)}: "
                    f"{shown_value(text)}"
                )
            try:
                if stamp_at:
                    self.stamps.append(_stamp(*[cells[index] for index in stamp_at]))
                self.numbers.extend([float(cells[index]) for index in at])
            except ValueError as error:
                reason = f"expected {self.expected}; {shortened(str(error))}"
                raise InputError(f"{self.path}, line {number}: {reason}") from None
            if self._image_at:
                self.images.append(cells[self._image_at[0]])
            self.line_numbers.append(number)
        return self

    def guess(self, text: str) -> None:
        """Note how something was read that the file does not say."""
        self.guesses.append(f"{self.path}: {text}")

    def refuse(self, wrong: BoolArray, message: Callable[[int], str]) -> None:
        """Raise an error at the first wrong row (N,), if there is one."""
        index = int(np.argmax(wrong))
        if wrong[index]:
            raise InputError(f"{self.path}, line {self.line_numbers[index]}: {message(index)}")


def named_columns(names: Sequence[str]) -> tuple[dict[str, list[int]], list[str]]:
    """Columns of each quantity, of those that have any: of one of its names; if there is none, of
    paths that end in one; and the units in the names, empty for none.
    """
    plain, units = zip(*map(_split, names), strict=True) if names else ((), ())
    found: dict[str, list[int]] = {}
    for wanted, aliases in _ALIASES.items():
        known = aliases.split()
        # Of paths, the longest end that is known: position_x rather than x.
        ends = tuple(f"_{alias}" for alias in known if "_" in alias)
        columns = [at for at, name in enumerate(plain) if name in known]
        columns = columns or [at for at, name in enumerate(plain) if name.endswith(ends)]
        if wanted in ROTATION_VECTOR:
            # In degrees they are rather angles, in an order that nothing names.
            columns = [at for at in columns if not (is_brief(names[at]) and units[at] == "deg")]
        if columns:
            found[wanted] = columns
    return found, [*units]


def is_brief(name: str) -> bool:
    """Whether a column is called rx, ry or rz: a rotation vector of Universal Robots, or angles of
    other robots.
    """
    return _split(name)[0] in ("rx", "ry", "rz")


def _measured(
    found: Mapping[str, Any], names: Sequence[str], measures: str
) -> tuple[str, Sequence[str]]:
    """What the columns measure, and the quantities to read for that: poses and the preferred
    quantities in doubt, so that what is missing is named.
    """

    known = [*_POSITIONS, *PLANAR_POSITIONS, *_ORIENTATIONS, *_PLANAR_ORIENTATIONS]
    known = [group for group in known if {*group} <= found.keys()]
    flat = next((group for group in known if group in (*_POSITIONS, *PLANAR_POSITIONS)), ())
    turn = next((group for group in known if group in _ORIENTATIONS), ())
    heading = next((group for group in known if group in _PLANAR_ORIENTATIONS), ())
    if measures == "auto":
        oriented = {*sum((*_ORIENTATIONS, *_PLANAR_ORIENTATIONS), ())}
        measures = "poses"
        listed = ",".join(_split(name)[0] for name in names)
        if flat and not (found.keys() & oriented or _ORIENTED(listed)):
            measures = "positions"
        elif not found.keys() & {*sum(_POSITIONS, ())}:
            is_turning = turn and not _PLACED(listed)
            measures = (
                "rates" if {*RATES} <= found.keys() else "rotations" if is_turning else "poses"
            )
    if measures == "poses" and MATRIX[0] in found:
        return measures, MATRIX
    orientation: Sequence[str] = turn or heading or QUATERNION
    is_planar = measures == "positions" or orientation in _PLANAR_ORIENTATIONS
    position = flat if flat and (is_planar or flat in _POSITIONS) else POSITION
    parts = {"rates": RATES, "twists": TWIST, "positions": position, "rotations": orientation}
    parts["stamps"] = ()
    return measures, parts.get(measures, (*position, *orientation))


def _split(name: str) -> tuple[str, str]:
    """A column's name without its unit, and the unit, empty if there is none:
    ``.pose.position.x [mm]`` to pose_position_x and mm, wx_deg_s to wx and deg/s.
    """
    # An element such as q[0], and frames as in p_RS_R_x.
    name = re.sub(r"\[(\d)\]$", r"\1", name.strip().lower())
    name = re.sub(r"^([pqw])_[a-z]{2}(_[a-z])?_|_(world|odometry)_device$", r"\1_", name)
    words = re.findall("[a-z0-9°]+", re.sub(r"\[.*?\]|\(.*?\)", "", name))
    if in_brackets := re.search(r"[\[(]\s*([^\])]*?)\s*(?:\^?-1)?\s*[\])]$", name):
        return "_".join(words), _UNITS.get(re.sub(r"[\s/_]+", "/", in_brackets[1]), "")
    is_time = any(re.fullmatch("t|time.*|stamp.*", word) for word in words)
    for count in (2, 1):
        unit = _UNITS.get("/".join(words[-count:]), "")
        if len(words) > count and unit and (unit in STAMP_UNITS) == is_time:
            return "_".join(words[:-count]), unit
    return "_".join(words), ""


def _stamp(text: str, nanoseconds: str = "") -> Decimal:
    """A stamp as it is written, with no binary floating point in between; nanoseconds of one in two
    columns; of a time of ISO 8601, in UTC if it names no zone, microseconds count.
    """
    if nanoseconds:
        return Decimal(int(text) * STAMP_UNITS["s"] + int(nanoseconds))
    try:
        stamp = Decimal(text)
    except InvalidOperation:
        if not NUMBER.fullmatch(text):
            raise ValueError(f"found {text!r} for the timestamp") from None
        moment = datetime.fromisoformat(text)
        moment = moment.replace(tzinfo=moment.tzinfo or UTC)
        return Decimal(int(moment.timestamp())) + Decimal(moment.microsecond).scaleb(-6)
    if not stamp.is_finite() or stamp.adjusted() > 30:
        raise ValueError(f"found {text!r} for the timestamp")
    return stamp


# ---- numbers in memory

_KINDS = (
    "a path, an array (N, 4, 4), (N, 8) of t, x, y, z, qx, qy, qz, qw or (N, 7), or a table with "
    "named columns"
)


def columns_of_array(source: Any) -> tuple[Sequence[str], FloatArray]:
    """Names and values of the columns of an array of poses; an InputError if it is none."""
    try:
        values = np.asarray(source, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"expected {_KINDS}; found {type(source).__name__}") from None
    if values.shape[1:] in ((3, 4), (4, 4)):
        return MATRIX, values.reshape(len(values), -1)[:, :12]
    names = ("t", *POSITION, *QUATERNION)
    known = {8: names, 7: names[1:], 4: names[:4]}
    if values.ndim != 2 or values.shape[1] not in known:
        raise InputError(f"expected {_KINDS}; found an array {values.shape}")
    return known[values.shape[1]], values


def table_of_object(source: Any, times: Any = None) -> Table:
    """The numbers of an array or of a table; see :func:`hand_eye_calib.read_trajectory`. An
    InputError if it is neither, or the stamps are no numbers or datetimes, one for each pose.
    """
    if hasattr(source, "columns"):
        keys = [*source.columns]
        table = Table("the table", [*map(str, keys)], expected=_KINDS)
        columns = [np.asarray(source[keys[at]], dtype=float) for at in table.at.values()]
        values = np.column_stack(columns)
        if times is None and len(table.stamp_at) == 1:
            times = source[keys[table.stamp_at[0]]]
    else:
        names, values = columns_of_array(source)
        if names[0] == "t":
            times, names, values = (
                values[:, 0] if times is None else times,
                names[1:],
                values[:, 1:],
            )
        table = Table("the poses", names, expected=_KINDS)
    table.numbers.frombytes(np.ascontiguousarray(values).tobytes())
    table.line_numbers.extend(range(1, len(values) + 1))
    if times is not None:
        if getattr(getattr(times, "dtype", None), "tz", None) is not None:
            times = np.asarray(times, dtype="datetime64[ns]")
        stamps = np.asarray(times)
        if stamps.dtype.kind == "M":
            table.units["t"] = "ns"
            stamps = stamps.astype("datetime64[ns]").astype(np.int64)
        if stamps.dtype.kind not in "iuf" or not np.isfinite(stamps).all():
            raise InputError(
                f"stamps must be finite numbers or datetimes; found {stamps.dtype} of shape "
                f"{stamps.shape}"
            )
        if stamps.shape != (len(values),):
            raise InputError(
                f"there must be one stamp per pose; found {stamps.size} stamps and {len(values)} "
                "poses"
            )
        table.stamps = [*map(Decimal, stamps.tolist())]
    return table


# ---- rows that are written


def write_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory to a text file in the format tum, which evo reads, too, replacing it if it
    exists. Reading it back gives the same stamps and poses.

    Parameters
    ----------
    path : str or path-like
    trajectory : Trajectory

    Raises
    ------
    InputError
        If the file cannot be written.

    Examples
    --------
    >>> hec.write_trajectory("moved.tum", child.shifted(result.time_offset_s))
    """
    lines = map(tum_line, trajectory.stamps_ns.tolist(), se3.to_rows(trajectory.poses).tolist())
    with writing(path):
        write_atomically({Path(path): "\n".join([f"# {TUM_COLUMNS}", *lines, ""])})


def tum_line(stamp_ns: int, pose: Iterable[float]) -> str:
    """The line of a pose x y z qx qy qz qw, which keeps every digit."""
    return f"{seconds(stamp_ns)} {' '.join(map(repr, pose))}"


def seconds(stamp_ns: int) -> str:
    """A stamp in seconds, with all its digits."""
    whole, nanoseconds = divmod(abs(int(stamp_ns)), STAMP_UNITS["s"])
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{nanoseconds:09d}"
