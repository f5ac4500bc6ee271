"""Stamps of a table: conversion to whole nanoseconds, and order."""

from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.config import STAMP_UNITS, CalibratorConfig
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.base.text import duration, shortened
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.files import LONGEST_NAME
from hand_eye_calib.formats.trajectory_files.dates import (
    DAY_S,
    WEEK_S,
    seconds,
    seconds_of,
)
from hand_eye_calib.formats.trajectory_files.layout import UNIT_EXPONENTS
from hand_eye_calib.formats.trajectory_files.table import Table

# Nanoseconds in a second.
_NS = STAMP_UNITS["s"]
# If the median time between poses (s) is longer than this, the unit of the stamps is probably
# wrong.
_LONGEST_INTERVAL_S = 10
# Rates and durations of two sensors of one recording usually differ by less than this factor.
_SIMILAR = 3
# Dates with a time of day as a number, such as 20231114221320.5, are at least this: 2000-01-01.
_FIRST_PACKED = Decimal(20_000_101_000_000)
# Dates with a time of day as a number are below this: 2100-01-01.
_END_OF_PACKED = Decimal(21_000_101_000_000)
# Smallest stamp, largest stamp and 1970-01-01 on each clock that counts days: of spreadsheets
# (since 1899-12-30), of MATLAB (datenum) and of astronomers (Julian day).
_CLOCKS_OF_DAYS = (
    (20_000, 80_000, Decimal(25_569)),
    (690_000, 770_000, Decimal(719_529)),
    (2_430_000, 2_500_000, Decimal("2440587.5")),
)
# Mean time (s) between poses, read in seconds, below which such stamps count days: no sensor of
# poses is faster than 10 kHz.
_SHORTEST_INTERVAL_S = 1e-4
# Stamps have lost their last digits if this share of the poses, or more, have moved without a new
# stamp.
_COARSE_SHARE = 0.25
# Stamps may be 32-bit numbers if such numbers have at least this step (s). Since 1970 it is 128 s.
_SHORT_STEP_S = 1e-3
# Poses are equal, up to rounding, if no number differs by more than this.
_SAME = 1e-12
# Smallest number of poses and smallest mean interval (ns) of a stream; closer stamps have another
# unit.
_FEWEST_STAMPS = 10
_SHORTEST_INTERVAL_NS = 1e5
# Smallest stamp since 1970 in each unit: March 1973.
_UNITS_SINCE_1970 = (
    (10**14, "microseconds"),
    (10**11, "milliseconds"),
    (10**8, "seconds"),
)


def require_nanoseconds(name: str, trajectory: Trajectory) -> None:
    """Raise InputError if the stamps of a whole stream seem to have another unit than ns.

    No sensor of poses is faster than 10 kHz. A part of a stream is not checked: messages that were
    received together may be closer.

    Parameters
    ----------
    name : str
        Name of the stream in the message.
    trajectory : Trajectory
    """
    if len(trajectory) < _FEWEST_STAMPS:
        return
    interval_ns = trajectory.duration_s * 1e9 / (len(trajectory) - 1)
    if interval_ns >= _SHORTEST_INTERVAL_NS:
        return
    largest = abs(int(trajectory.stamps_ns[-1]))
    units = [unit for least, unit in _UNITS_SINCE_1970 if largest >= least]
    unit = units[0] if units else "seconds or milliseconds"
    raise InputError(
        f"{name} has a pose every {interval_ns:.3g} ns, at stamps such as "
        f"{trajectory.stamps_ns[0]}: they look like {unit}; multiply them so that stamps_ns are "
        "nanoseconds (1 s is 1,000,000,000)"
    )


def _without_stamps(table: Table) -> str:
    """Return the message for a table without stamps."""
    remedy = (
        "name their column t, set `times`, or pair poses by row with `pair_by`"
    )
    if not isinstance(table.path, Path):
        remedy = (
            "read them with read_trajectory(poses, times=stamps); stops without stamps are for "
            "calibrate_stops"
        )
    used = {*table.at.values()}
    others = [
        name for column, name in enumerate(table.names) if column not in used
    ]
    if others:
        listed = shortened(" or ".join(others), LONGEST_NAME)
        return (
            f"{table.path}: the poses have no stamps; name their column t (is it {listed}?), or "
            "set `times`"
        )
    return f"{table.path}: the poses have no stamps; {remedy}"


def stamps_in_ns(table: Table, stamp_unit: str | None) -> IntArray:
    """Return the stamps of a table in nanoseconds.

    Parameters
    ----------
    table : Table
    stamp_unit : str or None
        "s", "ms", "us" or "ns". With None, the unit is in the column's name; without a unit in the
        name, it is inferred from the size of the stamps.

    Returns
    -------
    (N,) array of int64

    Raises
    ------
    InputError
        If the table has no stamps, if stamps are too large, or if their unit is unclear.
    """
    if not table.stamps:
        raise InputError(_without_stamps(table))
    unit = stamp_unit or table.stamp_unit
    stamps = table.stamps
    if not unit:
        if min(stamps) >= _FIRST_PACKED and max(stamps) < _END_OF_PACKED:
            stamps = _unpacked(stamps)
        stamps = _from_days(table, stamps)
    magnitudes = np.abs(np.array(stamps, dtype=float))
    recognised = unit or _unit_of_magnitude(magnitudes.max())
    factor = STAMP_UNITS[recognised]
    table.refuse(
        np.asarray(magnitudes * factor >= float(np.iinfo(np.int64).max)),
        lambda index: (
            f"the timestamp {stamps[index]:.6g} is too large for "
            f"{recognised}; set its unit with `stamp_unit`"
        ),
    )
    nanoseconds = (
        int((stamp * factor).to_integral_value()) for stamp in stamps
    )
    stamps_ns = np.fromiter(nanoseconds, dtype=np.int64, count=len(stamps))
    # Only stamps in seconds have decimals, so decimals determine the unit.
    if not unit and not any(stamp % 1 for stamp in stamps):
        _refuse_unclear_unit(table, stamps_ns, recognised)
    for period_s in (DAY_S, WEEK_S):
        stamps_ns = _without_restarts(stamps_ns, period_s)
    return stamps_ns


def _from_days(table: Table, stamps: list[Decimal]) -> list[Decimal]:
    """Return the seconds since 1970 of stamps that count days; other stamps are returned unchanged.

    A note reports the conversion.
    """
    smallest = min(stamps)
    largest = max(stamps)
    interval_s = float(largest - smallest) / len(stamps)
    if not 0.0 < interval_s < _SHORTEST_INTERVAL_S:
        return stamps
    for first, last, epoch in _CLOCKS_OF_DAYS:
        if first <= smallest and largest <= last:
            table.guess(
                f"stamps such as {shortened(str(stamps[0]), 20)} read as days, as in a "
                "spreadsheet; if they are seconds, set `stamp_unit` s"
            )
            return [DAY_S * (stamp - epoch) for stamp in stamps]
    return stamps


def _unit_of_magnitude(largest: float) -> str:
    """Return the unit of stamps since 1970, given the largest stamp."""
    for unit, digits in UNIT_EXPONENTS.items():
        if largest >= 10.0**digits:
            return unit
    return "s"


def _unpacked(stamps: list[Decimal]) -> list[Decimal]:
    """Return the seconds since 1970 of dates such as 20231114221320.5.

    If one of the stamps is not a date, all stamps are returned unchanged.
    """
    try:
        return [seconds_of(f"{stamp:f}") for stamp in stamps]
    except ValueError:
        return stamps


def _refuse_unclear_unit(
    table: Table, stamps_ns: IntArray, recognised: str
) -> None:
    """Raise an InputError if the interval of poses is so long that the unit is probably wrong."""
    intervals_s = np.abs(np.diff(stamps_ns.astype(float))) * 1e-9
    if len(intervals_s) and median(intervals_s) > _LONGEST_INTERVAL_S:
        raise InputError(
            f"{table.path}: the unit of the timestamps is unclear; read as "
            f"{recognised}, the poses are {median(intervals_s):.4g} s apart; "
            "set `stamp_unit` to s, ms, us or ns"
        )


def refuse_milliseconds(
    tables: Sequence[Table],
    stamps_ns: Sequence[IntArray],
    units: Sequence[str | None],
) -> None:
    """Raise an InputError if the stamps of a table were read in s, but are probably in ms.

    Read in s, they would be about 1,000 times as far apart as those of another table, and last
    about 1,000 times as long, so that few of them are within the duration of the other table.

    Parameters
    ----------
    tables : sequence of Table
    stamps_ns : sequence of (N,) array of int64
        Stamps of each table in order.
    units : sequence of str or None
        Unit of the stamps of each table that the user set, or None.
    """
    spans_s = [float(stamps[-1] - stamps[0]) / _NS for stamps in stamps_ns]
    intervals_s = [
        span_s / len(stamps)
        for span_s, stamps in zip(spans_s, stamps_ns, strict=True)
    ]
    slow = int(np.argmax(intervals_s))
    interval_s = intervals_s[slow]
    span_s = spans_s[slow]
    if units[slow] or tables[slow].stamp_unit:
        return
    few_s = CalibratorConfig.min_pairs * interval_s
    for other_interval_s, other_span_s in zip(
        intervals_s, spans_s, strict=True
    ):
        is_apart = _is_near_thousand(interval_s, other_interval_s)
        is_longer = _is_near_thousand(span_s, other_span_s)
        if is_apart and is_longer and other_span_s < few_s:
            raise InputError(
                f"{tables[slow].path}: one pose every {interval_s:.3g} s for {duration(span_s)}: "
                "its stamps look like milliseconds; give `stamp_unit` ms"
            )


def _is_near_thousand(longer: float, shorter: float) -> bool:
    """Return whether the ratio of two times is about that of s and ms."""
    expected = shorter * STAMP_UNITS["s"] / STAMP_UNITS["ms"]
    return expected / _SIMILAR <= longer <= expected * _SIMILAR


def _without_restarts(stamps_ns: IntArray, period_s: int) -> IntArray:
    """Return stamps that increase over the end of a day or week, at which they restart at 0.

    The stamps have restarted if a stamp in the last tenth of the period is followed by a stamp in
    the first tenth. Stamps that exceed one period are returned unchanged.
    """
    period_ns = period_s * _NS
    if not len(stamps_ns) or stamps_ns.min() < 0 or stamps_ns.max() > period_ns:
        return stamps_ns
    tenth_ns = period_ns // 10
    is_at_end = stamps_ns[:-1] > period_ns - tenth_ns
    is_at_start = stamps_ns[1:] < tenth_ns
    restarts = np.r_[False, is_at_end & is_at_start]
    return stamps_ns + np.cumsum(restarts) * period_ns


def refuse_coarse(
    table: Table, stamps_ns: IntArray, values: FloatArray
) -> None:
    """Raise an InputError if the stamps (N,) of a table have lost their last digits.

    The digits are lost if many poses have the stamp of the previous pose, but other ``values``
    (N, k).
    """
    if len(stamps_ns) < 2:
        return
    is_same_stamp = np.diff(stamps_ns) == 0
    has_moved = np.abs(np.diff(values, axis=0)).max(axis=1) > _SAME
    if (is_same_stamp & has_moved).mean() < _COARSE_SHARE:
        return
    different = np.unique(stamps_ns)
    if len(different) == 1:
        problem = f"of all {len(stamps_ns)} poses are the same"
    else:
        steps = "whole seconds only"
        if (different % _NS).any():
            steps = f"steps of {(np.diff(different) * 1e-9).min():.4g} s"
        problem = (
            f"have {steps}: {len(stamps_ns)} poses have {len(different)} different "
            "stamps"
        )
    advice = "write all digits (%.9f instead of %g or %e)"
    if step_s := _step_of_32_bits(different):
        problem += f" (numbers of 32 bits have steps of {step_s:.4g} s here)"
        advice += ", and numbers of 64 bits (float64)"
    raise InputError(f"{table.path}: the timestamps {problem}; {advice}")


def _step_of_32_bits(different: IntArray) -> float:
    """Return the step (s) of 32-bit numbers if the stamps can be such numbers, or 0 if they cannot.

    ``different`` are the different stamps, sorted. Some of them must differ by a single step.
    """
    step_s = float(np.spacing(np.float32(different[-1] / _NS)))
    is_multiple = not (different % max(1, round(step_s * _NS))).any()
    are_adjacent = (
        len(different) == 1 or np.diff(different).min() < 2.0 * step_s * _NS
    )
    is_possible = step_s >= _SHORT_STEP_S and is_multiple and are_adjacent
    return step_s if is_possible else 0.0


def in_order(
    table: Table, stamps_ns: IntArray, repair: bool
) -> tuple[IntArray, list[str]]:
    """Return the indices of the poses in order of time, and notes on repairs.

    Among poses with equal stamps, only the first is kept.

    Raises
    ------
    InputError
        If stamps are not in order and ``repair`` is False.
    """
    if not repair:
        is_wrong = np.r_[False, stamps_ns[1:] <= stamps_ns[:-1]]
        table.refuse(
            is_wrong,
            lambda index: (
                f"timestamps must increase, found {seconds(stamps_ns[index])} "
                f"after {seconds(stamps_ns[index - 1])}; "
                f"{int(is_wrong.sum())} such lines; sort the lines and drop "
                "repeated timestamps, or read the file with "
                "`hec.read_trajectory(path, repair=True)`"
            ),
        )
    indices = np.unique(stamps_ns, return_index=True)[1]
    n_backward = int((np.diff(stamps_ns) < 0).sum())
    n_dropped = len(stamps_ns) - len(indices)
    repairs = []
    if n_backward:
        repairs.append(
            f"stamps decrease at {n_backward} of {len(stamps_ns)} poses; the poses were sorted"
        )
    if n_dropped:
        repairs.append(f"dropped {n_dropped} with a repeated stamp")
    return indices, [f"{table.path}: {'; '.join(repairs)}"]
