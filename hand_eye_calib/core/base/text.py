"""Text of numbers, lengths, angles and lists, for output, and the values of typed quantities.

Every place that prints or reads a quantity uses this module.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import takewhile
from pathlib import PurePath
from typing import TypeAlias

from hand_eye_calib.core.base.errors import ConfigError

# Units of lengths: largest length (m), unit, factor.
_LENGTHS = ((0.00995, "mm", 1000), (0.995, "cm", 100), (math.inf, "m", 1))

# Units of durations: longest duration (s), unit, divisor.
_DURATIONS = ((90.0, "s", 1), (5_400.0, "min", 60), (math.inf, "h", 3600))

# Largest number of decimals.
_MOST_DECIMALS = 6

#: Direction of the axis of each rotation, by the name of its angle.
ABOUT = {"roll": "x", "pitch": "y", "yaw": "z"}


def length(metres: float) -> str:
    """A length with two digits in mm, cm or m; paths of more than 10 m have more."""
    size = abs(metres)
    if size >= 10:
        return f"{metres:,.{1 if size < 100 else 0}f} m"
    unit, factor = next(each[1:] for each in _LENGTHS if not size > each[0])
    return f"{two_digits(factor * metres)} {unit}"


def angle(radians: float) -> str:
    """An angle in degrees with two digits."""
    return f"{two_digits(math.degrees(radians))} deg"


def amount(axis: str, value: float) -> str:
    """A length (m) along x, y or z, otherwise an angle (rad); "unknown" if it is not finite."""
    if not math.isfinite(value):
        return "unknown"
    return length(value) if axis in ("x", "y", "z") else angle(value)


def amount_beside(axis: str, value: float, other: float) -> str:
    """Return an amount with as many digits as it takes to differ from another of the axis."""
    text = amount(axis, value)
    if text != amount(axis, other) or value == other or not math.isfinite(value):
        return text
    unit = text.rpartition(" ")[2]
    factors = {name: factor for _, name, factor in _LENGTHS} | {"deg": math.degrees(1.0)}
    for decimals in range(_MOST_DECIMALS):
        texts = [f"{factors[unit] * size:.{decimals}f}" for size in (value, other)]
        if float(texts[0]) != float(texts[1]):
            return f"{texts[0]} {unit}"
    return text


def change(axis: str, value: float, sigma: float) -> str:
    """A difference along or about an axis (m, rad) with its sign and standard deviation."""
    unit, factor = ("deg", math.degrees(1.0)) if axis in ABOUT else ("cm", 100.0)
    text = with_sigma(factor * value, factor * sigma, 1).replace("+/-", "±")
    if not math.isfinite(sigma):
        return text
    return f"+{text} {unit}" if value >= 0 else f"{text} {unit}"


def capital(text: str) -> str:
    """A text with a capital, unless it begins with a name such as ``/lidar`` or that of an axis."""
    return text if re.match(r"[xyz]\b", text) else f"{text[:1].upper()}{text[1:]}"


def axes_in_words(axes: Sequence[str]) -> str:
    """Name axes as in "x and the rotation about z" for x and yaw."""
    names = [axis for axis in axes if axis not in ABOUT]
    about = [ABOUT[axis] for axis in axes if axis in ABOUT]
    if about:
        rotations = "rotation" if len(about) == 1 else "rotations"
        names.append(f"the {rotations} about {listing(about)}")
    return listing(names)


def two_digits(value: float) -> str:
    """A number with two significant digits, without zeros at the end of its decimals."""
    if abs(value) < 1e-3:
        return "less than 0.001" if value else "0"
    decimals = max(1 - math.floor(math.log10(abs(value))), 0)
    text = f"{value:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if decimals else text


def with_sigma(value: float | None, sigma: float | None, least_decimals: int = 2) -> str:
    """Return a number and its standard deviation; "unknown" if one of them is not known.

    The standard deviation has two digits, and both numbers have at least ``least_decimals``.
    """
    if value is None or sigma is None or not math.isfinite(sigma):
        return "unknown"
    of_sigma = max(1 - math.floor(math.log10(sigma)), 0) if sigma > 0 else _MOST_DECIMALS
    decimals = max(min(of_sigma, _MOST_DECIMALS), least_decimals)
    return f"{fixed(value, decimals)} +/- {fixed(sigma, decimals)}"


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
    unit, factor = next(each[1:] for each in _DURATIONS if not seconds > each[0])
    return f"{seconds / factor:.{1 if seconds < 10 else 0}f} {unit}"


def share(value: float) -> str:
    """A share in per cent."""
    return f"{value:.1%}" if value < 0.1 else f"{value:.0%}"


# Above this share of messages without a pose, the source of the messages deserves a check.
MUCH_NULL = 0.1


def without_poses(n_null: int, n_all: int) -> str:
    """Return how many null poses of a stream were skipped, and what to do if there are many."""
    counts = f"{n_null:,} of {n_all:,} poses ({share(n_null / n_all)}) were left out"
    text = f"{counts}: their quaternion is 0, or a value is not finite or absent"
    if n_null > MUCH_NULL * n_all:
        text += ". This is a large share: check whether the source loses track, and record again"
    return text


def listing(words: Sequence[str]) -> str:
    """One, two and three."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def told_apart(paths: Sequence[str]) -> list[str]:
    """Return paths without the beginning and the end that all share.

    Of a/monday/bag and a/tuesday/bag these are monday and tuesday.
    """
    names = [PurePath(path).parts for path in paths]
    first = _n_shared(names)
    rest = [parts[first:] or parts[-1:] for parts in names]
    last = _n_shared([parts[::-1] for parts in rest])
    return ["/".join(parts[: len(parts) - last] or parts[-1:]) for parts in rest]


def _n_shared(paths: Sequence[Sequence[str]]) -> int:
    """Return how many names all paths begin with."""
    levels = zip(*paths, strict=False)
    return sum(1 for _ in takewhile(lambda names: len(set(names)) == 1, levels))


def counted(count: int, noun: str) -> str:
    """A count and a noun that forms its plural with s."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


# --------------------------- what people type: m and rad, or with a unit

# Characters of a value that a message shows.
_MOST_SHOWN = 80

AXIS_UNITS = dict.fromkeys(("x", "y", "z"), "m") | dict.fromkeys(("roll", "pitch", "yaw"), "rad")
_IN_SI = {"m": {"m": 1.0, "cm": 0.01, "mm": 0.001}, "rad": {"rad": 1.0, "deg": math.pi / 180}}
_QUANTITY = re.compile(r"([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)(m|cm|mm|rad|deg)?")

# Lengths (m) and angles (rad) of a user must not be larger, so that their squares do not overflow.
_LARGEST = 1e6

# Longest length (m) of a prior without a unit. Sensors are seldom farther apart, and 22 that was
# meant in centimetres must not be read as 22 m.
_LONGEST_WITHOUT_UNIT_M = 5.0

# Prior on the pose of the child sensor in the parent sensor's frame. For each of x, y, z (m), roll,
# pitch, yaw (rad): value and standard deviation, or both as the text of the option ``prior.AXIS``.
Prior: TypeAlias = Mapping[str, tuple[float, float] | str]


def shortened(text: str, most: int = _MOST_SHOWN) -> str:
    """Return the text, cut to ``most`` characters so that a message with it remains short."""
    return text if len(text) <= most else f"{text[:most]}..."


def shown_value(value: object) -> str:
    """A value for a message."""
    return shortened(repr(value))


def parse_prior(name: str, text: str) -> tuple[float, float]:
    """Value and standard deviation, in m or rad, of the option ``prior.AXIS``: ``VALUE+/-SIGMA`` in
    metres or radians, or with units (m, cm, mm, rad, deg).

    Raises
    ------
    ConfigError
        If the text has another form, an unknown unit or a standard deviation of 0; if a length of
        more than 5 m has no unit, or only the value has one that is not m or rad.
    """
    value, _, sigma = text.replace("±", "+/-").replace("+-", "+/-").partition("+/-")
    unit = AXIS_UNITS[name.removeprefix("prior.")]
    form = "VALUE+/-SIGMA, with its standard deviation"
    (known,) = quantities(name, [unit], value.split(), form)
    (known_sigma,) = quantities(name, [unit], sigma.split(), form, 0.0)
    words = value.strip(), sigma.strip()
    # A large standard deviation is a vague prior.
    is_long = unit == "m" and abs(known) > _LONGEST_WITHOUT_UNIT_M
    if is_long and not _unit_of(words[0]):
        raise ConfigError(
            f"{name} needs a unit: {words[0]} may be m, cm or mm; write "
            f"{' or '.join('+/-'.join(_with_units(words, each)) for each in ('cm', 'm'))}"
        )
    if _unit_of(words[0]) not in ("", unit) and not _unit_of(words[1]):
        raise ConfigError(
            f"{name}: the standard deviation {words[1]} needs a unit: write "
            f"{words[1]}{_unit_of(words[0])} or {words[1]}{unit}"
        )
    return known, known_sigma


def _unit_of(word: str) -> str:
    """Return the unit at the end of a quantity; empty if it has none."""
    match = _QUANTITY.fullmatch(word)
    return (match[2] or "") if match else ""


def _with_units(words: Iterable[str], unit: str) -> list[str]:
    """Return quantities with a unit in those that have none."""
    return [word if _unit_of(word) else f"{word}{unit}" for word in words]


def prior_as_typed(axis: str, value: str, sigma: str) -> str:
    """Return the text of ``prior.AXIS`` for what somebody typed beside the units m and deg.

    A length of more than 5 m gets no unit: the option asks for it.
    """
    words = [word.strip().replace(",", ".") for word in (value, sigma)]
    if AXIS_UNITS[axis] == "rad":
        return "+/-".join(_with_units(words, "deg"))
    value_without_unit = _QUANTITY.fullmatch(words[0]) and not _unit_of(words[0])
    is_short = not value_without_unit or abs(float(words[0])) <= _LONGEST_WITHOUT_UNIT_M
    return "+/-".join(_with_units(words, "m") if is_short else words)


def parse_pose(name: str, text: str) -> tuple[float, ...]:
    """Return the six numbers of ``X Y Z ROLL PITCH YAW``, in m and rad.

    The text may contain units, as in ``40cm 0 1.85 0 0 -90deg``.

    Raises
    ------
    ConfigError
        If the text has another form.
    """
    return tuple(quantities(name, [*AXIS_UNITS.values()], text.split(), "X Y Z ROLL PITCH YAW"))


def parse_targets(name: str, text: str) -> dict[str, float]:
    """Return the targets of single axes: axis name to standard deviation in m or rad.

    The text is such as ``z=10cm yaw=0.5deg``; numbers without a unit are metres and radians.

    Raises
    ------
    ConfigError
        If the text has another form, an axis comes twice or a target is not above 0.
    """
    targets: dict[str, float] = {}
    for word in text.replace(",", " ").split():
        axis, _, value = word.partition("=")
        if axis not in AXIS_UNITS or axis in targets:
            raise ConfigError(
                f"{name} takes AXIS=TARGET of {', '.join(AXIS_UNITS)}, once each, such as z=10cm "
                f"yaw=0.5deg; got {shown_value(word)}"
            )
        (targets[axis],) = quantities(f"{name}: {axis}", [AXIS_UNITS[axis]], [value], "TARGET", 0.0)
        if AXIS_UNITS[axis] == "rad" and targets[axis] > math.pi:
            raise ConfigError(
                f"{name} is in rad without a unit; for degrees write {axis}={value}deg"
            )
    return targets


def quantities(
    name: str, units: Sequence[str], words: Sequence[str], form: str, above: float = -math.inf
) -> list[float]:
    """Return numbers in ``units`` (m or rad) from words that may contain other units.

    Error messages quote ``form``, the expected form of the text.
    """
    if len(words) != len(units):
        raise ConfigError(f"{name} must be {form}; got {shown_value(' '.join(words))}")
    found = []
    for unit, word in zip(units, words, strict=True):
        match = _QUANTITY.fullmatch(word)
        if not match or (match[2] or unit) not in _IN_SI[unit]:
            known = " or ".join(_IN_SI[unit])
            raise ConfigError(f"{name} must be numbers in {known}; got {shown_value(word)}")
        value = float(match[1]) * _IN_SI[unit][match[2] or unit]
        if abs(value) > _LARGEST:
            raise ConfigError(f"{name} must be at most {_LARGEST:g} {unit}; got {word[:20]!r}")
        if not value > above:
            raise ConfigError(f"{name} needs a standard deviation above 0; got {shown_value(word)}")
        if unit == "rad" and not match[2] and abs(value) > 2 * math.pi:
            raise ConfigError(
                f"{name} is in radians without a unit; got {word[:20]}: write "
                f"{word[:20]}deg for degrees"
            )
        found.append(value)
    return found


def parse_reference(name: str, text: str) -> tuple[str, int]:
    """Return kind ("A", "B" or "C") and step (1 for "A") of a reference for motion pairs.

    Any other text raises ConfigError.
    """
    if not re.fullmatch("A|B[1-9][0-9]{0,8}|C([2-9]|[1-9][0-9]{1,8})", text):
        raise ConfigError(
            f"{name} must be auto, A, B<n> such as B5, or C<n> such as C20; got {shown_value(text)}"
        )
    return text[0], int(text[1:] or 1)


def frame_name(name: str) -> str:
    """Return the name of a frame as tf2 takes it: without the leading slash of ROS 1."""
    return name.lstrip("/")


def split_frames(name: str, text: str) -> tuple[str, str]:
    """The fixed frame and the sensor's frame of ``WORLD:SENSOR``, the value of an option.

    Raises
    ------
    ConfigError
        If these are not two different frames.
    """
    frames = [frame_name(frame.strip()) for frame in text.split(":")]
    if len(frames) != 2 or not all(frames) or frames[0] == frames[1]:
        raise ConfigError(
            f"{name} must be two frames as WORLD:SENSOR, such as odom:lidar; "
            f"got {shown_value(text)}"
        )
    return frames[0], frames[1]
