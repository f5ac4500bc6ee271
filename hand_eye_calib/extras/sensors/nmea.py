"""Read sentences of NMEA 0183: places with a fix, and their time."""

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from functools import reduce
from operator import xor

from hand_eye_calib.formats.trajectory_files.dates import DAY_S


def places_of(lines: Iterable[str]) -> tuple[list[list[float]], list[str]]:
    """Read GGA sentences; the previous RMC sentence states their day.

    Returns
    -------
    rows : list of list of float
        Stamp (s since 1970), latitude, longitude (deg) and height (m) above the ellipsoid.
    notes : list of str
        What was left out.

    Raises
    ------
    ValueError
        If no sentence has a fix and a day.
    """
    rows: list[list[float]] = []
    day_s = None
    n_damaged = 0
    for line in lines:
        cells = _cells_of_sentence(line)
        if cells is None:
            n_damaged += 1
            continue
        # The first two letters are the talker, such as GP.
        kind = cells[0][-3:]
        if kind == "RMC":
            day_s = _day_of_rmc(cells) or day_s
        if kind != "GGA" or day_s is None or not _has_fix(cells):
            continue
        row = _gga_row(cells, day_s)
        # After midnight, the date is that of the day before until the next RMC sentence.
        if rows and row[0] < rows[-1][0] - DAY_S / 2:
            row[0] += DAY_S
        rows.append(row)
    if not rows:
        raise ValueError(
            "NMEA: expected GGA sentences with a fix, and the date in RMC sentences"
        )
    notes = (
        [f"{n_damaged} sentences with a wrong checksum left out"]
        if n_damaged
        else []
    )
    return rows, notes


def _cells_of_sentence(line: str) -> list[str] | None:
    """Return the cells of an NMEA sentence; None if its checksum is wrong."""
    # A sentence is between $ and *; its checksum follows.
    start = line.find("$") + 1
    sentence, _, checksum = line[start:].partition("*")
    if checksum and _checksum(sentence) != checksum[:2].upper():
        return None
    return sentence.strip().split(",")


def _checksum(sentence: str) -> str:
    """Return the checksum of a sentence of NMEA: two hexadecimal digits."""
    return f"{reduce(xor, sentence.encode(), 0):02X}"


def _day_of_rmc(cells: Sequence[str]) -> float | None:
    """Return the start of the day (s since 1970) of an RMC sentence; None without a date."""
    if len(cells) <= 9 or not cells[9]:
        return None
    return datetime.strptime(cells[9], "%d%m%y").replace(tzinfo=UTC).timestamp()


def _has_fix(cells: Sequence[str]) -> bool:
    """Return whether a GGA sentence has a fix and a height."""
    return len(cells) > 11 and cells[6] not in ("", "0") and cells[9] != ""


def _gga_row(cells: Sequence[str], day_s: float) -> list[float]:
    """Return stamp (s), latitude, longitude (deg) and height (m) of a GGA sentence.

    The height is above the ellipsoid: the height above the geoid plus the height of the geoid.
    """
    clock, lat, north, lon, east = cells[1:6]
    # hhmmss.ss, ddmm.mmmm and dddmm.mmmm.
    stamp_s = (
        day_s + 3600 * int(clock[:2]) + 60 * int(clock[2:4]) + float(clock[4:])
    )
    lat_deg = int(lat[:2]) + float(lat[2:]) / 60
    lon_deg = int(lon[:3]) + float(lon[3:]) / 60
    if north in "SW":
        lat_deg = -lat_deg
    if east in "SW":
        lon_deg = -lon_deg
    above_geoid_m = float(cells[9])
    geoid_m = float(cells[11] or 0)
    return [stamp_s, lat_deg, lon_deg, above_geoid_m + geoid_m]
