"""Numbers, lengths, angles and lists as people read them: on the terminal, on pages and in the log.
Every place that prints a quantity takes it from here.
"""

import math
from collections.abc import Sequence

# Shorter lengths (m) are in mm, from the second on in m.
_MM_BELOW, _M_FROM = 0.00995, 0.995
# Longer durations (s) are in min, in h, and not told any more.
_MIN_FROM, _H_FROM, _LONGEST = 90.0, 5_400.0, 86_400.0
_MOST_DECIMALS = 6
_ABOUT = {"roll": "x", "pitch": "y", "yaw": "z"}


def length(metres: float) -> str:
    """A length with two digits in mm, cm or m; paths of more than 10 m have more."""
    size = abs(metres)
    if size < _MM_BELOW:
        return f"{two_digits(1000 * metres)} mm"
    if size < _M_FROM:
        return f"{two_digits(100 * metres)} cm"
    if size < 10:
        return f"{two_digits(metres)} m"
    return f"{metres:,.{1 if size < 100 else 0}f} m"


def angle(radians: float) -> str:
    """An angle in degrees with two digits."""
    return f"{two_digits(math.degrees(radians))} deg"


def amount(axis: str, value: float) -> str:
    """A length (m) along x, y or z, otherwise an angle (rad); "unknown" if it is not finite."""
    if not math.isfinite(value):
        return "unknown"
    return length(value) if axis in ("x", "y", "z") else angle(value)


def axes_in_words(axes: Sequence[str]) -> str:
    """Axes as in "x and the rotation about z" for x and yaw."""
    about = [_ABOUT[axis] for axis in axes if axis in _ABOUT]
    rotations = [f"the rotation{'s' * (len(about) > 1)} about {listing(about)}"] if about else []
    return listing([*(axis for axis in axes if axis not in _ABOUT), *rotations])


def two_digits(value: float) -> str:
    """A number with two significant digits, without zeros at the end of its decimals."""
    if abs(value) < 1e-3:
        return "less than 0.001" if value else "0"
    decimals = max(1 - math.floor(math.log10(abs(value))), 0)
    text = f"{value:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if decimals else text


def with_sigma(value: float | None, sigma: float | None, least_decimals: int = 2) -> str:
    """A number and its standard deviation, with two digits of the latter.

    Parameters
    ----------
    value, sigma : float or None
        None where the value is not known.
    least_decimals : int
        Decimals that are shown in any case.
    """
    if value is None or sigma is None or not math.isfinite(sigma):
        return "unknown"
    decimals = max(decimals_of(sigma), least_decimals)
    return f"{fixed(value, decimals)} +/- {fixed(sigma, decimals)}"


def decimals_of(sigma: float) -> int:
    """Decimals that show two digits of a standard deviation."""
    if not sigma > 0:
        return _MOST_DECIMALS
    return min(max(1 - math.floor(math.log10(sigma)), 0), _MOST_DECIMALS)


def fixed(value: float, decimals: int = 4) -> str:
    """A number with so many decimals, and no minus before a zero."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def in_words(value: object) -> str:
    """Any plain value as text."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {in_words(item)}" for name, item in value.items())
    if isinstance(value, (list, tuple)):
        return "; ".join(in_words(item) for item in value)
    if isinstance(value, float):
        return f"{value:.6g}"
    return "-" if value in ("", None) else str(value)


def given_or_estimated(value: float, sigma: float, unit: str) -> str:
    """A number with its standard deviation if it was estimated, as it is if it was given."""
    text = f"{value:.4f} +/- {sigma:.4f} {unit}" if sigma else f"{value:g} {unit}"
    return text.strip() + (", estimated" if sigma else "")


def duration(seconds: float) -> str:
    """Seconds, minutes or hours."""
    if seconds >= _LONGEST:
        return "more than a day"
    if seconds >= _H_FROM:
        return f"{seconds / 3600:.0f} h"
    if seconds >= _MIN_FROM:
        return f"{seconds / 60:.0f} min"
    return f"{seconds:.{1 if seconds < 10 else 0}f} s"


def share(value: float) -> str:
    """A share in per cent."""
    return f"{value:.1%}" if value < 0.1 else f"{value:.0%}"


def listing(words: Sequence[str]) -> str:
    """One, two and three."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def counted(count: int, noun: str) -> str:
    """A count and a noun that forms its plural with s."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"
