"""Stamps in text, read without loss of digits: numbers, weeks of GPS, dates and times of day.

Every pattern is applied to at most :data:`_LONGEST` characters, so that a hostile file cannot make
it slow.
"""

import math
import re
from collections.abc import Sequence
from datetime import date
from decimal import Decimal, InvalidOperation

from hand_eye_calib.core.base.config import STAMP_UNITS

#: Note on stamps of GPS time. The 18 s are the leap seconds since 1980-01-06.
GPS_TIME = "stamps are of GPS time, 18 s ahead of UTC since 2017"

# Nanoseconds in a second.
_NS = STAMP_UNITS["s"]
# Largest number of characters of a date with time and zone, with some spaces.
_LONGEST = 48
# Ordinal of the day 1970-01-01 in :class:`datetime.date`.
_EPOCH_DAY = date(1970, 1, 1).toordinal()
#: Seconds in a day.
DAY_S = 86_400
#: Seconds in a week of GPS.
WEEK_S = 604_800
#: Beginning of GPS time, 1980-01-06, in s since 1970 (IS-GPS-200).
GPS_EPOCH_S = 315_964_800

_MONTHS = (
    "jan",
    "feb",
    "mar",
    "apr",
    "may",
    "jun",
    "jul",
    "aug",
    "sep",
    "oct",
    "nov",
    "dec",
)
_YEAR_FIRST = re.compile(
    r"(\d{4})([-/._ ])(\d\d?|[a-z]{3,9})\2(\d\d?)", re.IGNORECASE | re.ASCII
)
_YEAR_LAST = re.compile(
    r"(\d\d?)([-/. ])(\d\d?|[a-z]{3,9})\2(\d{4})", re.IGNORECASE | re.ASCII
)
# Date such as 20231114. Its groups have the same numbers as those of _YEAR_FIRST.
_PACKED = re.compile(r"(20\d\d)()(\d\d)(\d\d)", re.ASCII)
# Text between a date and a time of day.
_BETWEEN = re.compile(r"T|[ ,_-]{1,4}|", re.IGNORECASE)
_TIME = re.compile(
    r"(\d\d?)([:._-]?)(\d\d)(?:\2(\d\d)(?:([.,]|\2)(\d{1,12}))?)? ?([ap]m)? ?"
    r"(z|utc|gmt|[-+]\d\d(?::?\d\d)?)?",
    re.IGNORECASE | re.ASCII,
)
_ZONE = re.compile(r"([-+])(\d\d):?(\d\d)?", re.ASCII)
# A time with at least this number of characters is a complete stamp: no date from another column is
# put before it.
_LONGEST_TIME = len("HH:MM:SS.123456789ab")


def seconds_of(text: str) -> Decimal:
    """Return the seconds since 1970 of a date with or without a time of day.

    A time of day alone yields the seconds since midnight. A time without a zone is UTC. Digits
    after the seconds are decimals: 12:30:05.25 has 250 ms. If the separators before and after the
    seconds are equal (12:30:05:25), these digits are a whole number: up to 3 digits are
    milliseconds, up to 6 microseconds, up to 9 nanoseconds (25 ms).

    Raises
    ------
    ValueError
        If the text is neither a date nor a time of day.
    """
    text = text.strip()
    if len(text) > _LONGEST:
        raise ValueError("too long for a time")
    day, rest = _day_and_rest(text)
    if day is None:
        if ":" not in text:
            raise ValueError("no time of day")
        return _time_of_day(text)
    if not rest:
        return Decimal(DAY_S * day)
    return DAY_S * day + _time_of_day(_BETWEEN.sub("", rest, count=1))


def is_date_or_time(text: str) -> bool:
    """Return whether the text is a date, a time of day, or both."""
    try:
        seconds_of(text)
    except ValueError:
        return False
    return True


def is_date(text: str) -> bool:
    """Return whether the text is a date without a time of day."""
    try:
        day, rest = _day_and_rest(text.strip()[: _LONGEST + 1])
    except ValueError:
        return False
    return day is not None and not rest


def is_ambiguous(text: str) -> bool:
    """Return whether a date with slashes remains valid if its day and month are exchanged."""
    match = _YEAR_LAST.match(text.strip()[:_LONGEST])
    if not match or match[2] != "/" or not match[3].isdigit():
        return False
    return int(match[1]) <= 12 and int(match[3]) <= 12 and match[1] != match[3]


def _day_and_rest(text: str) -> tuple[int | None, str]:
    """Return the day since 1970 of a date at the beginning of a text, and the remaining text.

    The day is None if the text does not begin with a date.
    """
    if match := _YEAR_FIRST.match(text) or _PACKED.match(text):
        return _day(match[1], match[3], match[4]), text[match.end() :]
    match = _YEAR_LAST.match(text)
    if not match:
        return None, text
    day = match[1]
    month = match[3]
    # Dates with slashes begin with the month, unless the first number is no month.
    if match[2] == "/" and int(match[1]) <= 12:
        day = match[3]
        month = match[1]
    return _day(match[4], month, day), text[match.end() :]


def _day(year: str, month: str, day: str) -> int:
    """Return the day since 1970 of a date; the month is a number or a name."""
    month_number = (
        int(month) if month.isdigit() else 1 + _MONTHS.index(month[:3].lower())
    )
    return date(int(year), month_number, int(day)).toordinal() - _EPOCH_DAY


def _time_of_day(text: str) -> Decimal:
    """Return the seconds of a time of day, in UTC."""
    match = _TIME.fullmatch(text)
    if not match:
        raise ValueError("no time of day")
    (
        hour_text,
        separator,
        minute_text,
        second_text,
        point,
        digits,
        half,
        zone,
    ) = match.groups()
    hour = _hour_of_day(int(hour_text), half)
    minute = int(minute_text)
    second = int(second_text or 0)
    if hour > 24 or minute > 59 or second > 60:
        raise ValueError("no time of day")
    fraction = Decimal(0)
    if digits:
        # With equal separators, as in 12:30:05:25, the digits are a number of ms, us or ns.
        is_number = point == separator and point != "."
        fraction = _fraction(digits, is_number)
    return (
        Decimal(3600 * hour + 60 * minute + second - _zone_s(zone or ""))
        + fraction
    )


def _hour_of_day(hour: int, half: str | None) -> int:
    """Return the hour from 0 to 23. ``half`` is "am", "pm", or None for a 24-hour clock."""
    if half is None:
        return hour
    if not 1 <= hour <= 12:
        raise ValueError("no hour of twelve")
    return hour % 12 + (12 if half.lower() == "pm" else 0)


def _fraction(digits: str, is_number: bool) -> Decimal:
    """Return the fraction of a second from its digits.

    If the digits are a whole number, up to 3 of them are ms, up to 6 are us, and up to 9 are ns.
    """
    n_decimals = 3 * math.ceil(len(digits) / 3) if is_number else len(digits)
    return Decimal(digits).scaleb(-n_decimals)


def _zone_s(zone: str) -> int:
    """Return the offset (s) of a time zone from UTC, positive in the east."""
    match = _ZONE.fullmatch(zone)
    if not match:
        return 0
    ahead_s = 3600 * int(match[2]) + 60 * int(match[3] or 0)
    return -ahead_s if match[1] == "-" else ahead_s


# ---- stamp of a row


def stamp_of(
    names: Sequence[str], cells: Sequence[str], unit: str = ""
) -> Decimal:
    """Return the stamp of a row with all its digits.

    Parameters
    ----------
    names : sequence of str
        Quantities of the cells, such as ("date", "t"); see columns.stamp_columns.
    cells : sequence of str
    unit : str, optional
        Unit of the time within a GPS week, if a column name states it. The default is seconds, or
        milliseconds for numbers above the seconds of two weeks.

    Returns
    -------
    Decimal
        Stamp in seconds for dates and GPS weeks, in nanoseconds for columns of seconds and
        nanoseconds, and otherwise in the unit of the column.

    Raises
    ------
    ValueError
        If a cell contains other text.
    """
    last = cells[-1]
    if len(cells) == 1:
        return _decimal(last)
    if names == ("secs", "nsecs"):
        return Decimal(int(cells[0]) * _NS + int(last))
    if names[0] == "week":
        second = _number(last)
        if second is not None and second.is_finite():
            return _stamp_in_week(cells[0], second, unit)
    # A longer cell is a complete stamp. Ignore the date in the other column.
    if names[0] == "date" and ":" in last and len(last) < _LONGEST_TIME:
        return seconds_of(" ".join(cells))
    return _decimal(last)


def _stamp_in_week(week_text: str, second: Decimal, unit: str) -> Decimal:
    """Convert a GPS week and a second of the week to seconds since 1970, in GPS time.

    A number above the seconds, and above the milliseconds, of two weeks is a complete stamp, and
    returned unchanged.
    """
    for possible_unit in (unit,) if unit else ("s", "ms"):
        second_of_week = second * STAMP_UNITS[possible_unit] / _NS
        if second_of_week < 2 * WEEK_S:
            week = Decimal(week_text)
            if week != int(week) or not 0 <= week < 10_000:
                raise ValueError(
                    f"found {week_text[:20]!r} for the week of GPS"
                )
            return GPS_EPOCH_S + WEEK_S * int(week) + second_of_week
    return second


def _number(text: str) -> Decimal | None:
    """Return the number in a text, with a decimal point or comma; None for other text."""
    # Decimal ignores underscores, but in stamps an underscore separates two numbers.
    if "_" in text:
        return None
    for number in (text, text.replace(",", ".")):
        try:
            return Decimal(number)
        except InvalidOperation:
            continue
    return None


def decimals(texts: Sequence[str]) -> list[Decimal]:
    """Return the numbers in texts, as :func:`stamp_of` does for a single column.

    Raises
    ------
    ValueError
        If :func:`stamp_of` would not read one of the texts as a plain number.
    """
    try:
        numbers = [*map(Decimal, texts)]
    except InvalidOperation:
        raise ValueError("not all stamps are plain numbers") from None
    is_plain = "_" not in "".join(texts)
    if not is_plain or not all(map(_is_stamp, numbers)):
        raise ValueError("not all stamps are plain numbers")
    return numbers


def _is_stamp(number: Decimal) -> bool:
    """Return whether a number is finite and not too large for a stamp."""
    return number.is_finite() and number.adjusted() <= 30


def _decimal(text: str) -> Decimal:
    """Return the number in a text (in an unknown unit), or the seconds of a date or time of day."""
    stamp = _number(text)
    if stamp is None and is_date_or_time(text):
        return seconds_of(text)
    if stamp is None or not _is_stamp(stamp):
        raise ValueError(f"found {text!r} for the timestamp")
    return stamp


def notes_on_stamps(names: Sequence[str], cells: Sequence[str]) -> list[str]:
    """Return notes for the user about the stamps of a table: GPS time, and ambiguous dates.

    ``names`` has the quantities of the stamp, and ``cells`` its cells in one row.
    """
    notes = []
    if names and names[0] == "week":
        notes.append(GPS_TIME)
    if any(map(is_ambiguous, cells)):
        notes.append(f"the date {cells[0]} read as month/day/year")
    return notes


def seconds(stamp_ns: int) -> str:
    """Return a stamp in seconds, with all its digits."""
    whole, nanoseconds = divmod(abs(int(stamp_ns)), _NS)
    sign = "-" if stamp_ns < 0 else ""
    return f"{sign}{whole}.{nanoseconds:09d}"
