"""Numbers and names as text for people: on the terminal and on pages."""

import math
from collections.abc import Sequence

_SECONDS_BELOW = 120.0
_MOST_DECIMALS = 6


def with_sigma(value: float, sigma: float | None, least_decimals: int = 2) -> str:
    """A number and its standard deviation, with two digits of the latter.

    Parameters
    ----------
    value : float
    sigma : float or None
        None where the value is not known.
    least_decimals : int
        Decimals that are shown in any case.
    """
    if sigma is None or not math.isfinite(sigma):
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


def plain(value: object) -> str:
    """Any plain value as text."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {plain(item)}" for name, item in value.items())
    if isinstance(value, (list, tuple)):
        return "; ".join(plain(item) for item in value)
    if isinstance(value, float):
        return f"{value:.6g}"
    return "-" if value in ("", None) else str(value)


def given_or_estimated(value: float, sigma: float, unit: str) -> str:
    """A number with its standard deviation if it was estimated, as it is if it was given."""
    text = f"{value:.4f} +/- {sigma:.4f} {unit}" if sigma else f"{value:g} {unit}"
    return text.strip() + (", estimated" if sigma else "")


def size(value: float, axis: str) -> str:
    """A length in cm or an angle in degrees, with two digits; which of them, the axis says."""
    value, unit = (100 * value, " cm") if axis in "xyz" else (math.degrees(value), "°")
    return f"{two_digits(value)}{unit}"


def length(value_m: float) -> str:
    """A length in cm or m."""
    if value_m < 1:
        return f"{two_digits(100 * value_m)} cm"
    return f"{value_m:,.{1 if value_m < 100 else 0}f} m"


def two_digits(value: float) -> str:
    """A number with two significant digits."""
    if value == 0 or abs(value) < 1e-4:
        return "less than 0.0001" if value else "0"
    return f"{value:.{max(1 - math.floor(math.log10(abs(value))), 0)}f}"


def duration(seconds: float) -> str:
    """A duration in s or min."""
    return f"{seconds:.1f} s" if seconds < _SECONDS_BELOW else f"{seconds / 60:.1f} min"


def share(value: float) -> str:
    """A share in per cent."""
    return f"{value:.1%}" if value < 0.1 else f"{value:.0%}"


def listing(words: Sequence[str]) -> str:
    """One, two and three."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def counted(count: int, noun: str) -> str:
    """A count and a noun that forms its plural with s."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"
