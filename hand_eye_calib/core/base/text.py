"""Format numbers, lengths, angles and lists as text, and parse quantities that users type.

All output and all options use this module.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import takewhile
from pathlib import PurePath
from typing import TypeAlias

from hand_eye_calib.core.base.errors import ConfigError

# Units of length: the largest length (m) for the unit, the unit, and the factor from metres.
_LENGTHS = ((0.00995, "mm", 1000), (0.995, "cm", 100), (math.inf, "m", 1))

# Units of duration: the longest duration (s) for the unit, the unit, and the divisor of seconds.
_DURATIONS = ((90.0, "s", 1), (5_400.0, "min", 60), (math.inf, "h", 3600))

# Largest number of decimals in a text.
_MAX_DECIMALS = 6

#: Axis about which each angle rotates.
ABOUT = {"roll": "x", "pitch": "y", "yaw": "z"}


def length(metres: float) -> str:
    """Format a length with two digits in mm, cm or m, and with up to four above 10 m."""
    size = abs(metres)
    if size >= 10:
        return f"{metres:,.{1 if size < 100 else 0}f} m"
    unit, factor = _suitable_unit(size, _LENGTHS)
    return f"{two_digits(factor * metres)} {unit}"


def _suitable_unit(
    size: float, units: Iterable[tuple[float, str, int]]
) -> tuple[str, int]:
    """Return name and factor of the first suitable unit for a size."""
    return next(
        (name, factor) for largest, name, factor in units if not size > largest
    )


def angle(radians: float) -> str:
    """Format an angle in degrees with two digits."""
    return f"{two_digits(math.degrees(radians))} deg"


def amount(axis: str, value: float) -> str:
    """Format a length (m) of x, y or z, or an angle (rad); "unknown" if it is not finite."""
    if not math.isfinite(value):
        return "unknown"
    return length(value) if axis in ("x", "y", "z") else angle(value)


def amount_beside(axis: str, value: float, other: float) -> str:
    """Format an amount like :func:`amount`, with the digits needed to differ from ``other``."""
    text = amount(axis, value)
    is_distinct = text != amount(axis, other)
    if is_distinct or value == other or not math.isfinite(value):
        return text
    *_, unit = text.split(" ")
    factors = {name: factor for _, name, factor in _LENGTHS} | {
        "deg": math.degrees(1.0)
    }
    for decimals in range(_MAX_DECIMALS):
        number = f"{factors[unit] * value:.{decimals}f}"
        other_number = f"{factors[unit] * other:.{decimals}f}"
        if float(number) != float(other_number):
            return f"{number} {unit}"
    return text


def change(axis: str, value: float, sigma: float) -> str:
    """Format a difference along or about an axis (m, rad) with sign and standard deviation."""
    unit, factor = (
        ("deg", math.degrees(1.0)) if axis in ABOUT else ("cm", 100.0)
    )
    text = with_sigma(factor * value, factor * sigma, 1).replace("+/-", "±")
    if not math.isfinite(sigma):
        return text
    return f"+{text} {unit}" if value >= 0 else f"{text} {unit}"


def capital(text: str) -> str:
    """Capitalise the first letter of a text, unless the text begins with the axis x, y or z."""
    if re.match(r"[xyz]\b", text):
        return text
    return f"{text[:1].upper()}{text[1:]}"


def in_sentences(message: str) -> str:
    """Return a one-line message as sentences, divided at its colons or semicolons."""
    parts = re.split("[:;] ", message)
    return " ".join(f"{capital(part)}." for part in parts)


def axes_in_words(axes: Sequence[str]) -> str:
    """List axes in words, such as "x and the rotation about z" for x and yaw."""
    names = [axis for axis in axes if axis not in ABOUT]
    about = [ABOUT[axis] for axis in axes if axis in ABOUT]
    if about:
        rotations = "rotation" if len(about) == 1 else "rotations"
        names.append(f"the {rotations} about {listing(about)}")
    return listing(names)


def two_digits(value: float) -> str:
    """Format a number with two significant digits, and all digits before the decimal point.

    Trailing zeros of the decimals are left out.
    """
    if abs(value) < 1e-3:
        return "less than 0.001" if value else "0"
    decimals = max(1 - math.floor(math.log10(abs(value))), 0)
    text = f"{value:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if decimals else text


def with_sigma(
    value: float | None, sigma: float | None, min_decimals: int = 2
) -> str:
    """Format a number with its standard deviation; "unknown" without a number or a finite sigma.

    The standard deviation has two significant digits. Value and standard deviation have the same
    number of decimals, at least ``min_decimals``.
    """
    if value is None or sigma is None or not math.isfinite(sigma):
        return "unknown"
    decimals = _MAX_DECIMALS
    if sigma > 0:
        decimals = min(max(1 - math.floor(math.log10(sigma)), 0), _MAX_DECIMALS)
    decimals = max(decimals, min_decimals)
    return f"{fixed(value, decimals)} +/- {fixed(sigma, decimals)}"


def fixed(value: float, decimals: int = 4) -> str:
    """Format a number with a fixed number of decimals, without a minus sign before zero."""
    # Rounding may produce -0.0. Adding 0.0 changes it to 0.0.
    rounded = round(value, decimals) + 0.0
    return f"{rounded:.{decimals}f}"


def in_words(value: object) -> str:
    """Format any plain value as text."""
    if isinstance(value, dict):
        return ", ".join(
            f"{name} {in_words(item)}" for name, item in value.items()
        )
    if isinstance(value, (list, tuple)):
        return "; ".join(in_words(item) for item in value)
    if isinstance(value, float):
        return f"{value:.6g}"
    return "-" if value in ("", None) else str(value)


def given_or_estimated(value: float, sigma: float, unit: str) -> str:
    """Format a number that was set by the user (``sigma`` is 0) or estimated."""
    if not sigma:
        return f"{value:g} {unit}".strip()
    number = f"{with_sigma(value, sigma, 4)} {unit}".strip()
    return f"{number}, estimated"


def duration(seconds: float) -> str:
    """Format a duration in seconds, minutes or hours."""
    unit, factor = _suitable_unit(seconds, _DURATIONS)
    decimals = 1 if seconds < 10 else 0
    return f"{seconds / factor:.{decimals}f} {unit}"


def share(value: float) -> str:
    """Format a share in per cent."""
    decimals = 1 if value < 0.1 else 0
    return f"{value:.{decimals}%}"


# If more than this share of all messages has null poses, the user is asked to check their source.
MUCH_NULL = 0.1


def without_poses(n_null: int, n_all: int) -> str:
    """Return a message about skipped null poses, with advice if there are many."""
    counts = (
        f"{n_null:,} of {n_all:,} poses ({share(n_null / n_all)}) were left out"
    )
    text = (
        f"{counts}: their quaternion is 0, or a value is not finite or absent"
    )
    if n_null > MUCH_NULL * n_all:
        text += ". This is a large share: check whether the source loses track, and record again"
    return text


def listing(words: Sequence[str]) -> str:
    """Join words as in "x, y and z"."""
    first = ", ".join(words[:-1])
    last = "".join(words[-1:])
    return f"{first} and {last}" if first else last


def distinct_names(paths: Sequence[str]) -> list[str]:
    """Return short names: paths without the first and last parts that all paths share.

    For a/monday/bag and a/tuesday/bag, the names are monday and tuesday.
    """
    names = [PurePath(path).parts for path in paths]
    first = _n_shared(names)
    rest = [parts[first:] or parts[-1:] for parts in names]
    last = _n_shared([parts[::-1] for parts in rest])
    return [
        "/".join(parts[: len(parts) - last] or parts[-1:]) for parts in rest
    ]


def _n_shared(paths: Sequence[Sequence[str]]) -> int:
    """Return the number of first parts that all paths share."""
    levels = zip(*paths, strict=False)
    return sum(1 for _ in takewhile(lambda names: len(set(names)) == 1, levels))


def counted(count: int, noun: str) -> str:
    """Return a count with its noun. The plural gets an s."""
    plural = "" if count == 1 else "s"
    return f"{count:,} {noun}{plural}"


# --------------------------- quantities that users type: in m and rad, or with a unit

# Largest number of characters of a value in a message.
_MAX_CHARACTERS = 80

AXIS_UNITS = dict.fromkeys(("x", "y", "z"), "m") | dict.fromkeys(
    ("roll", "pitch", "yaw"), "rad"
)
#: Factors from the units that a user may type to m, rad or s.
FACTORS_TO_SI = {
    "m": {"m": 1.0, "cm": 0.01, "mm": 0.001},
    "rad": {"rad": 1.0, "deg": math.pi / 180},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
}
_QUANTITY = re.compile(
    r"([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)(m|cm|mm|rad|deg)?"
)

# Largest length (m) or angle (rad) that a user may type. Squares of larger numbers could overflow.
_MAX_TYPED = 1e6

# Longest length (m) of a prior or a typed pose without a unit. Sensors are rarely farther apart; 22
# without a unit is probably in centimetres.
_MAX_WITHOUT_UNIT_M = 5.0

# Prior on the pose of the child sensor in the parent sensor's frame. For each of x, y, z (m), roll,
# pitch, yaw (rad): value and standard deviation, or the text of the option ``prior.AXIS``.
Prior: TypeAlias = Mapping[str, tuple[float, float] | str]


def shortened(text: str, length: int = _MAX_CHARACTERS) -> str:
    """Return the text, cut to ``length`` characters."""
    return text if len(text) <= length else f"{text[:length]}..."


def shown_value(value: object) -> str:
    """Return the Python notation of a value, shortened, for a message."""
    return shortened(repr(value))


def parse_prior(name: str, text: str) -> tuple[float, float]:
    """Return value and standard deviation (m or rad) of the option ``prior.AXIS``.

    The text is ``VALUE+/-SIGMA``, in metres or radians, or with units (m, cm, mm, rad, deg).

    Raises
    ------
    ConfigError
        If the text has another form, an unknown unit or a standard deviation of 0. If a value above
        5 m has no unit. If the value has a unit other than m or rad, and the standard deviation has
        no unit.
    """
    in_one_notation = text.replace("±", "+/-").replace("+-", "+/-")
    value, _, sigma = in_one_notation.partition("+/-")
    value = value.strip()
    sigma = sigma.strip()
    unit = AXIS_UNITS[name.removeprefix("prior.")]
    form = "VALUE+/-SIGMA, with its standard deviation"
    if not sigma:
        hint = ""
        first, _, second = value.partition(",")
        if "." in first and second:
            hint = f"; write {first}+/-{second.strip()}"
        raise ConfigError(
            f"{name} must be {form}; got {shown_value(text)}{hint}"
        )
    (prior,) = quantities(name, [unit], value.split(), form)
    (prior_sigma,) = quantities(name, [unit], sigma.split(), form, 0.0)
    unit_of_value = _unit_of(value)
    if unit == "m" and abs(prior) > _MAX_WITHOUT_UNIT_M and not unit_of_value:
        in_cm = "+/-".join(_with_units((value, sigma), "cm"))
        in_m = "+/-".join(_with_units((value, sigma), "m"))
        raise ConfigError(
            f"{name} needs a unit: {value} may be m, cm or mm; write {in_cm} or {in_m}"
        )
    if unit_of_value not in ("", unit) and not _unit_of(sigma):
        raise ConfigError(
            f"{name}: the standard deviation {sigma} needs a unit: write "
            f"{sigma}{unit_of_value} or {sigma}{unit}"
        )
    return prior, prior_sigma


def _unit_of(word: str) -> str:
    """Return the unit at the end of a quantity; empty for a quantity without unit."""
    match = _QUANTITY.fullmatch(word)
    return (match[2] or "") if match else ""


def _with_units(words: Iterable[str], unit: str) -> list[str]:
    """Return the quantities; those without a unit get ``unit``."""
    return [word if _unit_of(word) else f"{word}{unit}" for word in words]


def prior_as_typed(axis: str, value: str, sigma: str) -> str:
    """Return the text of the option ``prior.AXIS`` for numbers typed into fields in m or deg.

    A length above 5 m gets no unit, so that the option requests it.
    """
    words = [word.strip().replace(",", ".") for word in (value, sigma)]
    if AXIS_UNITS[axis] == "rad":
        return "+/-".join(_with_units(words, "deg"))
    is_number = _QUANTITY.fullmatch(words[0]) and not _unit_of(words[0])
    if is_number and abs(float(words[0])) > _MAX_WITHOUT_UNIT_M:
        return "+/-".join(words)
    return "+/-".join(_with_units(words, "m"))


def parse_pose(name: str, text: str) -> tuple[float, ...]:
    """Return the six numbers of ``X Y Z ROLL PITCH YAW``, in m and rad.

    The text may contain units, as in ``40cm 0 1.85 0 0 -90deg``.

    Raises
    ------
    ConfigError
        If the text has another form, or a length above 5 m has no unit.
    """
    units = [*AXIS_UNITS.values()]
    words = text.split()
    values = quantities(name, units, words, "X Y Z ROLL PITCH YAW")
    for unit, word, value in zip(units, words, values, strict=True):
        is_far = unit == "m" and abs(value) > _MAX_WITHOUT_UNIT_M
        if is_far and not _unit_of(word):
            raise ConfigError(
                f"{name} needs a unit: {word} may be m, cm or mm; write {word}mm or {word}m"
            )
    return tuple(values)


def parse_targets(name: str, text: str) -> dict[str, float]:
    """Return the targets of single axes: axis name to standard deviation (m or rad).

    The text is like ``z=10cm yaw=0.5deg``. Numbers without a unit are in metres or radians.

    Raises
    ------
    ConfigError
        If the text has another form, if it contains an axis twice, or if a target is not above 0.
    """
    targets: dict[str, float] = {}
    for word in text.replace(",", " ").split():
        axis, _, value = word.partition("=")
        if axis not in AXIS_UNITS or axis in targets:
            raise ConfigError(
                f"{name} takes AXIS=TARGET of {', '.join(AXIS_UNITS)}, once each, such as z=10cm "
                f"yaw=0.5deg; got {shown_value(word)}"
            )
        (targets[axis],) = quantities(
            f"{name}: {axis}", [AXIS_UNITS[axis]], [value], "TARGET", 0.0
        )
        if AXIS_UNITS[axis] == "rad" and targets[axis] > math.pi:
            raise ConfigError(
                f"{name} is in rad without a unit; for degrees write {axis}={value}deg"
            )
    return targets


def quantities(
    name: str,
    units: Sequence[str],
    words: Sequence[str],
    form: str,
    above: float = -math.inf,
) -> list[float]:
    """Return the numbers in words, each converted to its unit (m or rad).

    Parameters
    ----------
    name : str
        Name of the option, for messages.
    units : sequence of {"m", "rad"}
        Unit of each result. A word without a unit has this unit.
    words : sequence of str
        Numbers, with or without units such as cm or deg.
    form : str
        Expected form of the text, for messages.
    above : float
        Lower bound (exclusive).

    Raises
    ------
    ConfigError
        If the number of words is wrong, or a word is not an allowed number.
    """
    if len(words) != len(units):
        raise ConfigError(
            f"{name} must be {form}; got {shown_value(' '.join(words))}"
        )
    values = []
    for unit, word in zip(units, words, strict=True):
        value = _quantity(name, unit, word)
        if not value > above:
            raise ConfigError(
                f"{name} needs a standard deviation above 0; got {shown_value(word)}"
            )
        if unit == "rad" and not _unit_of(word) and abs(value) > 2 * math.pi:
            raise ConfigError(
                f"{name} is in radians without a unit; got {word[:20]}: write "
                f"{word[:20]}deg for degrees"
            )
        values.append(value)
    return values


def _quantity(name: str, unit: str, word: str) -> float:
    """Return the number of a word in ``unit`` (m or rad); see :func:`quantities`."""
    match = _QUANTITY.fullmatch(word)
    factors = FACTORS_TO_SI[unit]
    unit_of_word = _unit_of(word) or unit
    if not match or unit_of_word not in factors:
        allowed = " or ".join(factors)
        hint = ""
        with_point = word.replace(",", ".")
        if "," in word and (_unit_of(with_point) or unit) in factors:
            is_number = _QUANTITY.fullmatch(with_point)
            hint = f"; write {with_point}" if is_number else ""
        raise ConfigError(
            f"{name} must be numbers in {allowed}; got {shown_value(word)}{hint}"
        )
    value = float(match[1]) * factors[unit_of_word]
    if abs(value) > _MAX_TYPED:
        raise ConfigError(
            f"{name} must be at most {_MAX_TYPED:g} {unit}; got {word[:20]!r}"
        )
    return value


def parse_reference(name: str, text: str) -> tuple[str, int]:
    """Return the letter (A, B or C) and the number (1 for A) of a reference for motion pairs.

    Raises
    ------
    ConfigError
        If the text has another form.
    """
    if not re.fullmatch("A|B[1-9][0-9]{0,8}|C([2-9]|[1-9][0-9]{1,8})", text):
        raise ConfigError(
            f"{name} must be auto, A, B<n> such as B5, or C<n> such as C20; got {shown_value(text)}"
        )
    return text[0], int(text[1:] or 1)


def frame_name(name: str) -> str:
    """Return the name of a frame without the leading slash of ROS 1, which tf2 rejects."""
    return name.lstrip("/")


def split_frames(name: str, text: str) -> tuple[str, str]:
    """Return the fixed frame and the sensor's frame from ``WORLD:SENSOR``, the value of an option.

    Raises
    ------
    ConfigError
        If the text does not name two different frames.
    """
    frames = [frame_name(frame.strip()) for frame in text.split(":")]
    if len(frames) != 2 or not all(frames) or frames[0] == frames[1]:
        raise ConfigError(
            f"{name} must be two frames as WORLD:SENSOR, such as odom:lidar; "
            f"got {shown_value(text)}"
        )
    return frames[0], frames[1]
