"""The stamps of a trajectory file: their unit and their order."""

from decimal import Decimal

import numpy as np

from hand_eye_calib.arrays import IntArray
from hand_eye_calib.config import STAMP_UNITS
from hand_eye_calib.errors import InputError
from hand_eye_calib.io.trajectory_files.table import Table
from hand_eye_calib.stats import median

_NS_PER_S = 1_000_000_000
_LARGEST_NS = int(np.iinfo(np.int64).max)

# The largest stamp of a file decides: seconds since 1970 have ten digits, and each smaller unit
# three more.
SMALLEST_OF_UNIT = {
    "ns": Decimal(10) ** 17,
    "us": Decimal(10) ** 14,
    "ms": Decimal(10) ** 11,
    "s": Decimal(0),
}
# Poses farther apart than this are of no use to a calibration: rather the unit has been mistaken.
_LONGEST_INTERVAL_S = 10


def stamps_in_ns(table: Table, stamp_unit: str | None) -> IntArray:
    """Stamps (N,) in nanoseconds, in the unit that is given, that the format has, or that their
    size tells.

    Raises
    ------
    InputError
        If they are too large, or their unit is not clear.
    """
    unit = stamp_unit or table.stamp_unit
    largest = max(map(abs, table.stamps))
    recognised = unit or next(
        unit for unit, smallest in SMALLEST_OF_UNIT.items() if largest >= smallest
    )
    if largest > Decimal(_LARGEST_NS) / STAMP_UNITS[recognised]:
        index = max(range(len(table.stamps)), key=lambda index: abs(table.stamps[index]))
        raise InputError(
            f"{table.path}, line {table.line_numbers[index]}: the timestamp "
            f"{table.stamps[index]:.6g} is too large for {recognised}; name its unit with "
            "`stamp_unit`"
        )
    stamps_ns = np.array(
        [int((stamp * STAMP_UNITS[recognised]).to_integral_value()) for stamp in table.stamps],
        dtype=np.int64,
    )
    # Stamps with a fraction are in seconds.
    is_whole = all(stamp == stamp.to_integral_value() for stamp in table.stamps)
    interval_s = _median_interval_s(stamps_ns)
    if not unit and is_whole and interval_s > _LONGEST_INTERVAL_S:
        raise InputError(
            f"{table.path}: the unit of the timestamps is unclear; read as {recognised}, the poses "
            f"are {interval_s:.4g} s apart; name it with `stamp_unit`: s, ms, us or ns"
        )
    return stamps_ns


def _median_interval_s(stamps_ns: IntArray) -> float:
    if len(stamps_ns) < 2:
        return 0.0
    return median(np.abs(np.diff(stamps_ns.astype(float)))) * 1e-9


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
        index = int(np.argmax(wrong))
        raise InputError(
            f"{table.path}, line {table.line_numbers[index]}: timestamps must increase, found "
            f"{seconds(stamps_ns[index])} after {seconds(stamps_ns[index - 1])}; "
            f"{int(wrong.sum())} such lines; sort the lines and drop repeated timestamps, or have "
            "that done with `repair`"
        )
    order = np.argsort(stamps_ns, kind="stable")
    repeated = np.r_[False, stamps_ns[order][1:] == stamps_ns[order][:-1]]
    backward, n_repeated = int((stamps_ns[1:] < stamps_ns[:-1]).sum()), int(repeated.sum())
    repairs = []
    if backward:
        repairs.append(
            f"stamps went back at {backward} of {len(stamps_ns)} poses, which were sorted"
        )
    if n_repeated:
        repairs.append(f"dropped {n_repeated} whose stamp was there already")
        repairs += _contradictions(table, order, repeated)
    return order[~repeated], [f"{table.path}: {'; '.join(repairs)}"]


def _contradictions(table: Table, order: IntArray, repeated: IntArray) -> list[str]:
    """How many of the dropped rows differ from the one that is kept."""
    dropped = np.flatnonzero(repeated)
    values = table.values
    differing = int((values[order[dropped]] != values[order[dropped - 1]]).any(axis=1).sum())
    return [f"{differing} of these with another pose"] if differing else []


def seconds(stamp_ns: int) -> str:
    """A stamp in seconds, with all its digits."""
    whole, nanoseconds = divmod(abs(int(stamp_ns)), _NS_PER_S)
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{nanoseconds:09d}"
