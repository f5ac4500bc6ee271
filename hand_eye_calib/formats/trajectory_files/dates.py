"""Stamps in text: numbers, weeks of GPS, dates and times of day, exactly as they are written.

Every pattern meets text of at most :data:`_LONGEST` characters.
"""

import re
from collections.abc import Sequence
from datetime import date
from decimal import Decimal, InvalidOperation

from hand_eye_calib.core.base.config import STAMP_UNITS

#: What a person should know of stamps of GPS time.
GPS_TIME = "stamps are of GPS time, 18 s ahead of UTC since 2017"

_NS = STAMP_UNITS["s"]

#: Characters of the longest date with time and zone, with room for spaces.
_LONGEST = 48
#: Proleptic day of 1970-01-01.
_EPOCH_DAY = date(1970, 1, 1).toordinal()
DAY_S = 86_400
#: GPS time begins at 1980-01-06, s since 1970, and counts weeks.
_GPS_EPOCH_S = 315_964_800
WEEK_S = 604_800

_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_YEAR_FIRST = re.compile(r"(\d{4})([-/._ ])(\d\d?|[a-z]{3,9})\2(\d\d?)", re.IGNORECASE | re.ASCII)
_YEAR_LAST = re.compile(r"(\d\d?)([-/. ])(\d\d?|[a-z]{3,9})\2(\d{4})", re.IGNORECASE | re.ASCII)
_PACKED = re.compile(r"(20\d\d)()(\d\d)(\d\d)", re.ASCII)
# Between date and time.
_BETWEEN = re.compile(r"T|[ ,_-]{1,4}", re.IGNORECASE)
_TIME = re.compile(
    r"(\d\d?)([:._-]?)(\d\d)(?:\2(\d\d)(?:([.,]|\2)(\d{1,12}))?)? ?([ap]m)? ?"
    r"(z|utc|gmt|[-+]\d\d(?::?\d\d)?)?",
    re.IGNORECASE | re.ASCII,
)
_ZONE = re.compile(r"([-+])(\d\d):?(\d\d)?", re.ASCII)


def seconds_of(text: str) -> Decimal:
    """Seconds since 1970 of a date with a time of day, or of the day for a time of day alone.

    Without a zone the time is UTC. A fraction behind the same character as between minutes and
    seconds is a count of milliseconds, microseconds or nanoseconds.

    Raises
    ------
    ValueError
        If the text is neither.
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
    between = _BETWEEN.match(rest)
    start = between.end() if between else 0
    return DAY_S * day + _time_of_day(rest[start:])


def is_date_or_time(text: str) -> bool:
    """Whether the text is a date, a time of day, or both."""
    try:
        seconds_of(text)
    except ValueError:
        return False
    return True


def is_date(text: str) -> bool:
    """Whether the text is a date without a time of day."""
    try:
        day, rest = _day_and_rest(text.strip()[: _LONGEST + 1])
    except ValueError:
        return False
    return day is not None and not rest


def is_ambiguous(text: str) -> bool:
    """Whether day and month of a date could be exchanged."""
    match = _YEAR_LAST.match(text.strip()[:_LONGEST])
    if not match or match[2] != "/" or not match[3].isdigit():
        return False
    return int(match[1]) <= 12 and int(match[3]) <= 12 and match[1] != match[3]


def seconds_of_week(week: str, second: Decimal) -> Decimal:
    """Seconds since 1970, in GPS time, of a second of a week of GPS."""
    number = Decimal(week)
    if number != int(number) or not 0 <= number < 10_000:
        raise ValueError(f"found {week[:20]!r} for the week of GPS")
    return _GPS_EPOCH_S + WEEK_S * int(number) + second


def _day_and_rest(text: str) -> tuple[int | None, str]:
    """The day since 1970 at the beginning of a text, none without one, and what follows it."""
    if match := _YEAR_FIRST.match(text) or _PACKED.match(text):
        return _day(match[1], match[3], match[4]), text[match.end() :]
    if match := _YEAR_LAST.match(text):
        first = match[1]
        second = match[3]
        # Month first is usual with slashes, unless it cannot be.
        month_first = match[2] == "/" and int(first) <= 12
        day, month = (second, first) if month_first else (first, second)
        return _day(match[4], month, day), text[match.end() :]
    return None, text


def _day(year: str, month: str, day: str) -> int:
    number = int(month) if month.isdigit() else 1 + _MONTHS.index(month[:3].lower())
    return date(int(year), number, int(day)).toordinal() - _EPOCH_DAY


def _time_of_day(text: str) -> Decimal:
    """Seconds of a time of day, in UTC."""
    match = _TIME.fullmatch(text)
    if not match:
        raise ValueError("no time of day")
    hour_text, separator, minute_text, second_text, point, digits, half, zone = match.groups()
    hour = int(hour_text)
    minute = int(minute_text)
    second = int(second_text or 0)
    if half:
        if not 1 <= hour <= 12:
            raise ValueError("no hour of twelve")
        hour = hour % 12 + (12 if half.lower() == "pm" else 0)
    if hour > 24 or minute > 59 or second > 60:
        raise ValueError("no time of day")
    fraction = _fraction(digits, is_count=point == separator and point != ".") if digits else 0
    return 3600 * hour + 60 * minute + second + Decimal(fraction) - _zone_s(zone or "")


def _fraction(digits: str, is_count: bool) -> Decimal:
    """The part of a second in digits after a point, or a count of ms, us or ns."""
    places = -(-len(digits) // 3) * 3 if is_count else len(digits)
    return Decimal(digits).scaleb(-places)


def _zone_s(zone: str) -> int:
    """Seconds that a zone is ahead of UTC."""
    match = _ZONE.fullmatch(zone)
    if not match:
        return 0
    size = 3600 * int(match[2]) + 60 * int(match[3] or 0)
    return -size if match[1] == "-" else size


# ---- the stamp of a row


def stamp_of(names: Sequence[str], cells: Sequence[str], unit: str = "") -> Decimal:
    """The stamp of a row as it is written, with no binary floating point in between, in the unit of
    its column; in seconds for dates and weeks of GPS, in nanoseconds for two columns. The ``unit``
    is that of the second of a week, if it is named: otherwise what is no second of a week, nor of
    the next, is a millisecond.

    Raises
    ------
    ValueError
        If the cells have something else.
    """
    if len(cells) == 1:
        return _decimal(cells[0])
    if names == ("secs", "nsecs"):
        return Decimal(int(cells[0]) * _NS + int(cells[1]))
    second = _number(cells[1])
    if names[0] == "week" and second is not None and second.is_finite():
        for possible_unit in (unit,) if unit else ("s", "ms"):
            in_seconds = second * STAMP_UNITS[possible_unit] / _NS
            if in_seconds < 2 * WEEK_S:
                return seconds_of_week(cells[0], in_seconds)
        return second
    last = cells[-1]
    # A time of day belongs to its date, whatever else is complete in itself.
    if names[0] == "date" and ":" in last and len(last) < len("HH:MM:SS") + 12:
        return seconds_of(" ".join(cells))
    return _decimal(last)


def _number(text: str) -> Decimal | None:
    """The number in a text, none if it is something else."""
    if "_" in text:  # Decimal skips it, but in a stamp it separates
        return None
    for written in (text, text.replace(",", ".")):
        try:
            return Decimal(written)
        except InvalidOperation:
            continue
    return None


def _decimal(text: str) -> Decimal:
    """Seconds or another unit in a number, or seconds of a date or time of day."""
    stamp = _number(text)
    if stamp is None and is_date_or_time(text):
        return seconds_of(text)
    if stamp is None or not stamp.is_finite() or stamp.adjusted() > 30:
        raise ValueError(f"found {text!r} for the timestamp")
    return stamp


def notes_on_stamps(names: Sequence[str], cells: Sequence[str]) -> list[str]:
    """What a person should know of stamps like those of one row."""
    notes = []
    if names and names[0] == "week":
        notes.append(GPS_TIME)
    if any(map(is_ambiguous, cells)):
        notes.append(f"the date {cells[0]} read as month/day/year")
    return notes


def seconds(stamp_ns: int) -> str:
    """A stamp in seconds, with all its digits."""
    whole, nanoseconds = divmod(abs(int(stamp_ns)), _NS)
    sign = "-" if stamp_ns < 0 else ""
    return f"{sign}{whole}.{nanoseconds:09d}"
