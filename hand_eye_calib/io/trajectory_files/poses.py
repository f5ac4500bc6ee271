"""Stamps and poses from the numbers of a table, in whatever way it gives them."""

from decimal import Decimal

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.config import STAMP_UNITS
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import FARTHEST_M, far_position
from hand_eye_calib.io.geodetic import LocalOrigin, rotations_to_first
from hand_eye_calib.io.trajectory_files.columns import MATRIX
from hand_eye_calib.io.trajectory_files.orientations import (
    LARGEST_RAD,
    RADIANS,
    Columns,
    from_matrices,
    orientations,
    unit_of,
)
from hand_eye_calib.io.trajectory_files.table import Table
from hand_eye_calib.stats import median

_LARGEST_NS = int(np.iinfo(np.int64).max)
# Poses farther apart than this (s) are of no use to a calibration: rather the unit has been
# mistaken.
_LONGEST_INTERVAL_S = 10
_METRES = {"": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0}
_RADIANS_PER_S = {"deg/s": np.pi / 180, "rad/s": 1.0}
# No gyroscope measures more (rad/s): 2,000 deg/s.
_FASTEST = 35.0

# ---- stamps


def unit_by_size(largest: Decimal | float) -> str:
    """Unit of the largest stamp of a file: seconds since 1970 have ten digits, and each smaller
    unit three more.
    """
    digits = {"ns": 17, "us": 14, "ms": 11}
    return next((unit for unit, each in digits.items() if largest >= 10**each), "s")


def stamps_in_ns(table: Table, stamp_unit: str | None) -> IntArray:
    """Stamps (N,) in nanoseconds, in the unit that is given, that the format has, or that their
    size tells.

    Raises
    ------
    InputError
        If they are too large, or their unit is not clear.
    """
    unit = stamp_unit or table.columns.stamp_unit
    largest = max(map(abs, table.stamps))
    recognised = unit or unit_by_size(largest)
    factor = STAMP_UNITS[recognised]
    is_large = np.array([abs(stamp) > Decimal(_LARGEST_NS) / factor for stamp in table.stamps])
    table.refuse(
        is_large,
        lambda index: (
            f"the timestamp {table.stamps[index]:.6g} is too large for {recognised}; name its unit "
            "with `stamp_unit`"
        ),
    )
    rounded = (int((stamp * factor).to_integral_value()) for stamp in table.stamps)
    stamps_ns = np.fromiter(rounded, dtype=np.int64, count=len(table.stamps))
    # Stamps with a fraction are in seconds.
    if not unit and all(stamp == stamp.to_integral_value() for stamp in table.stamps):
        intervals_s = np.abs(np.diff(stamps_ns.astype(float))) * 1e-9
        if len(intervals_s) and median(intervals_s) > _LONGEST_INTERVAL_S:
            raise InputError(
                f"{table.path}: the unit of the timestamps is unclear; read as {recognised}, the "
                f"poses are {median(intervals_s):.4g} s apart; name it with `stamp_unit`: s, ms, "
                "us or ns"
            )
    return stamps_ns


def in_order(table: Table, stamps_ns: IntArray, repair: bool) -> tuple[IntArray, list[str]]:
    """Indices of the poses in the order of time, and what was repaired for that.

    Raises
    ------
    InputError
        If stamps repeat or decrease and must not be repaired.
    """
    wrong = np.r_[False, stamps_ns[1:] <= stamps_ns[:-1]]
    if not wrong.any():
        return np.arange(len(stamps_ns)), []
    if not repair:
        table.refuse(
            wrong,
            lambda index: (
                f"timestamps must increase, found {seconds(stamps_ns[index])} after "
                f"{seconds(stamps_ns[index - 1])}; {int(wrong.sum())} such lines; sort the lines "
                "and drop repeated timestamps, or have that done with `repair`"
            ),
        )
    keep, repairs = sorted_stamps(stamps_ns)
    return keep, [f"{table.path}: {repairs}"]


def sorted_stamps(stamps_ns: IntArray) -> tuple[IntArray, str]:
    """Indices of stamps that are out of order, sorted and each once, and what was done."""
    keep = np.unique(stamps_ns, return_index=True)[1]
    backward, n_dropped = int((np.diff(stamps_ns) < 0).sum()), len(stamps_ns) - len(keep)
    went_back = f"stamps went back at {backward} of {len(stamps_ns)} poses, which were sorted"
    dropped = f"dropped {n_dropped} whose stamp was there already"
    return keep, "; ".join([went_back] * (backward > 0) + [dropped] * (n_dropped > 0))


def seconds(stamp_ns: int) -> str:
    """A stamp in seconds, with all its digits."""
    whole, nanoseconds = divmod(abs(int(stamp_ns)), STAMP_UNITS["s"])
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{nanoseconds:09d}"


# ---- poses


def poses_of(table: Table, convention: str = "") -> tuple[FloatArray, FloatArray]:
    """Positions (N, 3), m, and quaternions (N, 4), scalar last, of a table; what had to be guessed
    is added to its ``guesses``. A ``convention`` of its angles goes before what the motion says.

    Raises
    ------
    InputError
        For values that cannot be; the message names the line.
    """
    values = _finite_values(table)
    if MATRIX[0] in table.columns.quantities:
        matrices = values.reshape(-1, 3, 4)
        positions = _checked(table, matrices[:, :, 3])
        return positions, from_matrices(table, matrices[:, :, :3])
    columns = dict(zip(table.columns.quantities, values.T, strict=True))
    if "lat" in columns:
        return _in_local_frame(table, columns, convention)
    positions = np.zeros((len(values), 3))
    if "x" in columns:
        names = ("x", "y", "height" if "height" in columns else "z")
        positions = np.stack([_lengths(table, columns, name) for name in names], axis=1)
    return _checked(table, positions), orientations(table, columns, positions, convention)


def rates_of(table: Table) -> FloatArray:
    """The angular rates (N, 3), rad/s, of a table of rates; a unit that had to be guessed is added
    to its ``guesses``.

    Raises
    ------
    InputError
        For values that cannot be; the message names the line.
    """
    values = _finite_values(table)
    units = {unit_of(table, name, _RADIANS_PER_S) for name in table.columns.quantities}
    if len(units) > 1:
        raise InputError(f"{table.path}: the columns of the rates have different units")
    unit = units.pop()
    if not unit:
        largest = float(np.abs(values).max())
        unit = "deg/s" if largest > _FASTEST else "rad/s"
        table.guess(
            f"angular rates read in {unit}, the largest is {largest:.4g}; to change that, name "
            "their unit in the header, such as wx_deg_s"
        )
    return values * _RADIANS_PER_S[unit]


def _finite_values(table: Table) -> FloatArray:
    values = table.values
    table.refuse(
        np.asarray(~np.isfinite(values).all(axis=1)),
        lambda _: "found a value that is not finite; remove the line or repair its source",
    )
    return values


def _checked(table: Table, positions: FloatArray) -> FloatArray:
    """The positions (N, 3), none of which is too far away."""
    is_far = np.abs(positions).max(axis=1) > FARTHEST_M
    table.refuse(np.asarray(is_far), lambda row: f"{far_position(*positions[row])}; check its unit")
    return positions


def _lengths(table: Table, columns: Columns, name: str) -> FloatArray:
    """A column of lengths in metres; zeros if there is none."""
    if name in columns:
        return columns[name] * _METRES[unit_of(table, name, _METRES)]
    table.guess(f"no column of {'heights' if name == 'height' else name}: taken as 0")
    return np.zeros(len(table.line_numbers))


def _in_local_frame(
    table: Table, columns: Columns, convention: str
) -> tuple[FloatArray, FloatArray]:
    """Poses from latitude, longitude and height, in the frame of the first one."""
    lats, lons = columns["lat"], columns["lon"]
    named = unit_of(table, "lat", RADIANS) or unit_of(table, "lon", RADIANS)
    is_small = max(np.abs(lats).max() * 2, np.abs(lons).max()) <= np.pi
    unit = named or ("rad" if is_small else "deg")
    lat, lon = lats * RADIANS[unit], lons * RADIANS[unit]
    table.refuse(
        (np.abs(lat) > np.pi / 2 + 1e-9) | (np.abs(lon) > LARGEST_RAD),
        lambda index: (
            f"found latitude {lats[index]:.7g}, longitude {lons[index]:.7g}; expected degrees or "
            "radians, and no latitude beyond 90 deg: perhaps they are swapped"
        ),
    )
    positions = LocalOrigin().local(lat, lon, _lengths(table, columns, "height"))
    by_size = "" if named else f", in {unit} by their size,"
    table.guess(
        f"latitude and longitude{by_size} became metres east and north of the first position"
    )
    quats_xyzw = orientations(table, columns, _checked(table, positions), convention)
    in_local = se3.from_quat_xyzw(positions, quats_xyzw)[:, :3, :3]
    return positions, se3.to_quat_xyzw(rotations_to_first(lat, lon) @ in_local)
