"""Stamps of a table, as increasing whole nanoseconds."""

from decimal import Decimal

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.config import STAMP_UNITS
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.formats.trajectory_files.dates import DAY_S, WEEK_S, seconds, seconds_of
from hand_eye_calib.formats.trajectory_files.layout import DIGITS
from hand_eye_calib.formats.trajectory_files.table import Table

_NS = STAMP_UNITS["s"]
# Poses farther apart than this (s) are of no use to a calibration: rather the unit has been
# mistaken.
_LONGEST_INTERVAL_S = 10
# Stamps that count from the start of a day or a week begin again in the last and first of so many
# parts of it.
_PARTS = 10
# Numbers such as 20231114221320.5 are dates with the time of day.
_PACKED = (Decimal(20_000_101_000_000), Decimal(21_000_101_000_000))
# Share of poses that move on while their stamp does not, from which on stamps are too coarse.
_COARSE_SHARE = 0.25
# Other poses than the one before with the same stamp differ by more than this in some number.
_SAME = 1e-12


def stamps_in_ns(table: Table, stamp_unit: str | None) -> IntArray:
    """Stamps (N,) in nanoseconds, in the unit that is given, that the format has, or that their
    size tells; an InputError if there are none, they are too large, or their unit is not clear.
    """
    if not table.stamps:
        raise InputError(
            f"{table.path}: the poses have no stamps; name their column t, give `times`, or pair "
            "poses by row with `pair_by`"
        )
    unit = stamp_unit or table.units["t"]
    stamps = table.stamps
    if not unit and _PACKED[0] <= min(stamps) and max(stamps) < _PACKED[1]:
        stamps = _unpacked(stamps)
    sizes = np.abs(np.array(stamps, dtype=float))
    by_size = (name for name, digits in DIGITS.items() if sizes.max() >= 10.0**digits)
    recognised = unit or next(by_size, "s")
    factor = STAMP_UNITS[recognised]
    table.refuse(
        np.asarray(sizes * factor >= float(np.iinfo(np.int64).max)),
        lambda index: (
            f"the timestamp {stamps[index]:.6g} is too large for {recognised}; name its unit "
            "with `stamp_unit`"
        ),
    )
    rounded = (int((stamp * factor).to_integral_value()) for stamp in stamps)
    stamps_ns = np.fromiter(rounded, dtype=np.int64, count=len(stamps))
    # Stamps with a fraction are in seconds.
    if not unit and not any(stamp % 1 for stamp in stamps):
        _refuse_unclear_unit(table, stamps_ns, recognised)
    for period_s in (DAY_S, WEEK_S):
        stamps_ns = _continued(stamps_ns, period_s)
    return stamps_ns


def _unpacked(stamps: list[Decimal]) -> list[Decimal]:
    """Seconds of dates such as 20231114221320.5, or the stamps if one is no date."""
    try:
        return [seconds_of(f"{stamp:f}") for stamp in stamps]
    except ValueError:
        return stamps


def _refuse_unclear_unit(table: Table, stamps_ns: IntArray, recognised: str) -> None:
    intervals_s = np.abs(np.diff(stamps_ns.astype(float))) * 1e-9
    if len(intervals_s) and median(intervals_s) > _LONGEST_INTERVAL_S:
        raise InputError(
            f"{table.path}: the unit of the timestamps is unclear; read as {recognised}, the "
            f"poses are {median(intervals_s):.4g} s apart; name it with `stamp_unit`: s, ms, "
            "us or ns"
        )


def _continued(stamps_ns: IntArray, period_s: int) -> IntArray:
    """Stamps that go on where those of a day or a week begin again at 0."""
    period_ns = period_s * _NS
    if not len(stamps_ns) or stamps_ns.min() < 0 or stamps_ns.max() > period_ns:
        return stamps_ns
    is_at_end = stamps_ns[:-1] > period_ns - period_ns // _PARTS
    is_at_start = stamps_ns[1:] < period_ns // _PARTS
    begins_again = np.r_[False, is_at_end & is_at_start]
    return stamps_ns + np.cumsum(begins_again) * period_ns


def refuse_coarse(table: Table, stamps_ns: IntArray, values: FloatArray) -> None:
    """Raise an InputError if many poses (N, k) differ from the one before with the same stamp: the
    stamps have lost their last digits.
    """
    if len(stamps_ns) < 2:
        return
    is_same_stamp = np.diff(stamps_ns) == 0
    has_moved = np.abs(np.diff(values, axis=0)).max(axis=1) > _SAME
    if (is_same_stamp & has_moved).mean() < _COARSE_SHARE:
        return
    different = np.unique(stamps_ns)
    steps_s = np.diff(different) * 1e-9
    coarse = f"have steps of {steps_s.min():.4g} s" if len(steps_s) else "are all the same"
    if len(steps_s) and not (different % _NS).any():
        coarse = "have whole seconds only"
    raise InputError(
        f"{table.path}: the timestamps {coarse}: {len(stamps_ns)} poses have {len(different)} "
        "different ones; write timestamps with all their digits, such as with %.9f instead of %g "
        "or %e, or give `times`"
    )


def in_order(table: Table, stamps_ns: IntArray, repair: bool) -> tuple[IntArray, list[str]]:
    """Indices of poses in the order of time, each stamp once, and what was repaired for that; an
    InputError if it must not be repaired.
    """
    wrong = np.r_[False, stamps_ns[1:] <= stamps_ns[:-1]]
    if not repair:
        table.refuse(
            wrong,
            lambda index: (
                f"timestamps must increase, found {seconds(stamps_ns[index])} after "
                f"{seconds(stamps_ns[index - 1])}; {int(wrong.sum())} such lines; sort the lines "
                "and drop repeated timestamps, or have that done with `repair`"
            ),
        )
    keep = np.unique(stamps_ns, return_index=True)[1]
    n_backward = int((np.diff(stamps_ns) < 0).sum())
    n_dropped = len(stamps_ns) - len(keep)
    repairs = []
    if n_backward:
        repairs.append(
            f"stamps went back at {n_backward} of {len(stamps_ns)} poses, which were sorted"
        )
    if n_dropped:
        repairs.append(f"dropped {n_dropped} whose stamp was there already")
    return keep, [f"{table.path}: {'; '.join(repairs)}"]
