"""Options, which are dataclass fields with a name, unit, range, default and help text."""

import contextlib
import dataclasses
import functools
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, Self, TypeAlias

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.text import FACTORS_TO_SI, frame_name, shown_value

OptionValue: TypeAlias = bool | int | float | str
#: Values of options by their public names. The dataclass of the options checks their types.
Options: TypeAlias = Mapping[str, Any]
OptionField: TypeAlias = dataclasses.Field[Any]

#: Upper bound of integers (exclusive). They must fit into signed integers of 64 bits.
LARGEST_INT = 1 << 63

# Number with a decimal comma, such as 0,035.
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+")
# Number with a unit, such as 35ms or -0.1 s.
_NUMBER_WITH_UNIT = re.compile(
    r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\w+)"
)
_GROUPS = ("keyframe", "prior", "target")
_TYPE_NAMES = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
}


def options_in_words(options: Options) -> str:
    """Return options and values as text for messages: ``scale 0.001, time_offset 0.2``."""
    return ", ".join(f"{name} {value}" for name, value in options.items())


def option(
    default: OptionValue,
    doc: str,
    *,
    unit: str = "",
    within: tuple[float, float] | None = None,
    choices: tuple[str, ...] | None = None,
    words: tuple[str, ...] = (),
    read_only: bool = False,
    parse: Callable[[str, str], object] | None = None,
) -> Any:
    """Make a dataclass field that describes an option completely.

    Parameters
    ----------
    default
        Default value. Its type is the type of the option.
    doc
        Help text of one line for the user.
    unit
        Unit of the value; empty for none.
    within
        Smallest and largest allowed number.
    choices
        Allowed texts.
    words
        Words that are allowed instead of a number, such as "none".
    read_only
        The node cannot change the option while it runs.
    parse
        For a text option: ``parse(name, value)`` raises ConfigError if the value is not valid.
    """
    # At this point, the local variables are exactly the arguments.
    metadata = dict(locals())
    return dataclasses.field(default=metadata.pop("default"), metadata=metadata)


def option_name(field: OptionField) -> str:
    """Return the public name of an option: the name of the ROS parameter and the YAML key.

    Options of a group have a dot in their names, as in ``keyframe.min_translation``.
    """
    group, _, name = field.name.partition("_")
    return f"{group}.{name}" if group in _GROUPS else field.name


def did_you_mean(word: str, candidates: Iterable[str]) -> str:
    """Return ``; did you mean X?`` with the most similar candidates; empty if none is similar.

    If two candidates need the smallest number of edits, both are named.
    """
    import difflib

    candidates = list(candidates)
    for spelling in (word, word.lower()):
        similar = difflib.get_close_matches(
            spelling, candidates, n=3, cutoff=0.62
        )
        if similar:
            nearest = _nearest(spelling, similar)
            return f"; did you mean {' or '.join(nearest[:2])}?"
    return ""


def _nearest(word: str, similar: Sequence[str]) -> list[str]:
    """Return the words among ``similar`` that need the smallest number of edits."""
    n_edits = {
        candidate: _count_edits(word, candidate) for candidate in similar
    }
    fewest = min(n_edits.values())
    nearest = [
        candidate for candidate in similar if n_edits[candidate] == fewest
    ]
    # A candidate with the same letters is first: letters are swapped more often than added.
    nearest.sort(key=lambda candidate: sorted(candidate) != sorted(word))
    return nearest


def _count_edits(word: str, other: str) -> int:
    """Count the edits between two words: letters added, removed, replaced or swapped.

    The result is the distance of optimal string alignment. A swap exchanges two neighbouring
    letters.
    """
    # Distances between the beginnings of both words, by the lengths of the beginnings.
    distances = {(row, 0): row for row in range(len(word) + 1)}
    distances |= {(0, column): column for column in range(len(other) + 1)}
    for row, letter in enumerate(word, 1):
        for column, other_letter in enumerate(other, 1):
            replaced = distances[row - 1, column - 1] + (letter != other_letter)
            removed = distances[row - 1, column] + 1
            added = distances[row, column - 1] + 1
            distance = min(replaced, removed, added)
            is_longer = row > 1 and column > 1
            if (
                is_longer
                and word[row - 2 : row] == other[column - 2 : column][::-1]
            ):
                distance = min(distance, distances[row - 2, column - 2] + 1)
            distances[row, column] = distance
    return distances[len(word), len(other)]


def _of_python(value: object) -> object:
    """Return a scalar of NumPy, such as ``np.float64(0.1)``, as Python's; other values as is."""
    is_scalar = (
        type(value).__module__ == "numpy" and getattr(value, "ndim", None) == 0
    )
    return value.item() if is_scalar else value  # type: ignore[attr-defined]


def check_value(field: OptionField, value: object) -> OptionValue:
    """Return a value of an option, checked and converted to the type of the option.

    Raises
    ------
    ConfigError
        If the value has the wrong type, is out of range or is not among the choices. The message
        is one line and contains the allowed values.
    """
    name = option_name(field)
    words = field.metadata["words"]
    value = _of_python(value)
    if type(value) is int and not -LARGEST_INT < value < LARGEST_INT:
        raise ConfigError(f"{name}: the number is too large")
    kind = _type_of(field)
    if isinstance(value, str) and (value in words or kind is str):
        return _checked_text(field, value)
    if kind is float:
        value = _as_float(value, has_words=bool(words))
    if type(value) is not kind or not isinstance(value, bool | int | float):
        hint = _without_unit(value, field.metadata["unit"])
        hint = hint or did_you_mean(str(value), words)
        raise ConfigError(
            f"{name} must be {_expected(field)}; got {shown_value(value)}{hint}"
        )
    return _checked_number(field, value)


def _type_of(field: OptionField) -> type:
    """Return the type of an option. An option with words is a number if it is not a word."""
    return float if field.metadata["words"] else type(field.default)


def _expected(field: OptionField) -> str:
    """Return the type and the unit of an option, for messages."""
    words = field.metadata["words"]
    unit = field.metadata["unit"]
    expected = (
        f"{' or '.join(words)} or a number"
        if words
        else _TYPE_NAMES[_type_of(field)]
    )
    if option_name(field).startswith("prior."):
        return f"{expected} with its standard deviation, such as '1.85+/-0.02'"
    return f"{expected} in {unit}" if unit else expected


def _without_unit(value: object, unit: str) -> str:
    """Return ``; write 0.035`` for a text such as ``35ms`` or ``0,035``.

    ``unit`` is the unit of the option. The return value is empty if the text has another form.
    """
    if not isinstance(value, str):
        return ""
    if _DECIMAL_COMMA.fullmatch(value):
        return f"; write {value.replace(',', '.')}"
    match = _NUMBER_WITH_UNIT.fullmatch(value)
    factors = FACTORS_TO_SI.get(unit, {})
    if match is None or match[2] not in factors:
        return ""
    return f"; write {float(match[1]) * factors[match[2]]:.9g}"


def _as_float(value: object, has_words: bool) -> object:
    """Return a whole number as float, and the text of a number if the option allows words.

    Any other value is returned unchanged.
    """
    if type(value) is int or (has_words and isinstance(value, str)):
        with contextlib.suppress(ValueError):
            return float(value)
    return value


def _checked_text(field: OptionField, text: str) -> str:
    """Return the text of an option, or raise ConfigError if its choice or form is wrong."""
    name = option_name(field)
    choices = field.metadata["choices"]
    if choices is not None and text not in choices:
        raise ConfigError(
            f"{name} must be one of {', '.join(choices)}; got {shown_value(text)}"
            f"{did_you_mean(text, choices)}"
        )
    parse = field.metadata["parse"]
    if parse is not None and text:
        parse(name, text)
    return frame_name(text) if name.endswith("_frame") else text


def _checked_number(field: OptionField, value: float) -> float:
    """Return the number of an option, or raise ConfigError if it is out of range."""
    name = option_name(field)
    if not math.isfinite(value):
        raise ConfigError(f"{name} must be a finite number; got {value}")
    low, high = field.metadata["within"] or (value, value)
    if not low <= value <= high:
        bound = f"at least {low}" if value < low else f"at most {high}"
        unit = field.metadata["unit"]
        hint = f"; write {value:g}deg for degrees" if unit == "rad" else ""
        raise ConfigError(
            f"{name} must be {' '.join([bound, unit]).rstrip()}; got {value}{hint}"
        )
    return value


class OptionSet:
    """Base class of dataclasses whose fields are options. The constructor checks the values."""

    given: frozenset[str]
    __dataclass_fields__: ClassVar[dict[str, OptionField]]

    def __post_init__(self, _: object = None) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            # Defaults are valid. Configurations are copied often, with few other values.
            if value is not field.default:
                object.__setattr__(self, field.name, check_value(field, value))

    @classmethod
    @functools.cache
    def by_name(cls) -> dict[str, OptionField]:
        """Return the fields of the options by their public names."""
        return {option_name(field): field for field in dataclasses.fields(cls)}

    @classmethod
    def from_options(cls, options: Mapping[str, object]) -> Self:
        """Make an object from a mapping of public names to values.

        Raises
        ------
        ConfigError
            If a name is unknown (the message lists all names), or if a value is not allowed.
        """
        by_name = cls.by_name()
        unknown = [name for name in options if name not in by_name]
        if unknown:
            raise ConfigError(
                f"unknown option {unknown[0]!r}{did_you_mean(unknown[0], by_name)}; known are "
                f"{', '.join(sorted(by_name))}"
            )
        return cls(
            **{by_name[name].name: value for name, value in options.items()}
        )

    def to_options(self) -> dict[str, OptionValue]:
        """Return the values of all options by their public names."""
        return {
            name: getattr(self, field.name)
            for name, field in self.by_name().items()
        }
