"""Spelling of options in messages: on the command line, in Python, and in files and parameters.

The engine writes options by their public names, such as ``prior.z 1.85+/-0.02``. A user of the
command line types ``--prior z=1.85+/-0.02``, and a Python program has ``prior={"z": (1.85,
0.02)}``.
"""

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from enum import Enum
from typing import TypeAlias

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.option import check_value

Pairs: TypeAlias = Iterable[tuple[str, object]]


class Interface(Enum):
    """Interface for options: command line, Python, or YAML files and ROS parameters."""

    TERMINAL = "terminal"
    PYTHON = "python"
    NODE = "node"


#: Value of a prior that the user must measure. Messages contain an example instead.
PLACEHOLDER = "VALUE+/-SIGMA"
_PRIOR_OF_TRANSLATION = "0.50+/-0.02"
_PRIOR_OF_ROTATION = "90deg+/-2deg"

_FIELDS = CalibratorConfig.by_name()
# Arguments of extras that appear in messages of the engine, with their values.
_CHOICES = {"ground": ("auto", "off"), "setup": ("hand", "beside")}
# Arguments of readers that appear in messages of the engine; their values are any numbers.
_TIMES = ("start", "end")

# Possible options in a message, with a possible value: a word in backticks; a word with a dot or an
# underscore, such as max_gap and prior.z; scale, ground, setup, start and end before a value. Words
# in a path, after a dash or in quotes do not count.
_OPTION_IN_TEXT = re.compile(
    r"(?:`(?P<quoted>[\w.]+)`|(?<![\w./\\='-])(?P<name>[a-z]+\d?(?:[._]+[a-z]+)+|"
    r"scale(?= (?:none|auto|estimate\b|\d))|ground(?= (?:auto|off)\b)|setup(?= (?:hand|beside)\b)|"
    r"(?:start|end)(?= \d)))"
    r"(?![\w/=-]|\.\w)(?: (?P<value>[^\s,;:()]*[^\s,;:().]))?"
)
# A prior in metres or radians.
_PLAIN_PRIOR = re.compile(r"(-?[\d.]+)\+/-([\d.]+)")


def spelled(text: str, interface: Interface, others: Iterable[str] = ()) -> str:
    """Return a message of the engine with its options in the spelling of an interface.

    ``others`` has the names of further options of the interface in messages.
    """
    names = {*_FIELDS, *_CHOICES, *_TIMES, *others}
    if interface is Interface.NODE:
        # The parameters of the node have the names that the engine writes. Only commands take a
        # part of a recording.
        names = {*_TIMES}
        interface = Interface.TERMINAL

    def option(match: re.Match[str]) -> str:
        name = match["quoted"] or match["name"]
        value = match["value"]
        if name not in names:
            return match[0]
        if value is None:
            return _name_alone(name, interface)
        if _is_value(name, value):
            return spelled_options([(name, value)], interface)
        return f"{_name_alone(name, interface)} {value}"

    return _OPTION_IN_TEXT.sub(option, text)


def spelled_options(options: Pairs, interface: Interface) -> str:
    """Return pairs of public option name and value in the spelling of an interface.

    If the user must measure a prior, an example replaces its value.
    """
    options = [(name, _example_of(name, value)) for name, value in options]
    if interface is Interface.TERMINAL:
        return " ".join(_typed(name, value) for name, value in options)
    if interface is Interface.NODE:
        return ", ".join(f"{name} {value}" for name, value in options)
    arguments = []
    priors = []
    for name, value in options:
        group, _, axis = name.partition(".")
        if group == "prior":
            priors.append(f'"{axis}": {_prior_of_python(str(value))}')
        else:
            arguments.append(
                f"{_name_alone(name, interface)}={_value_of_python(value)}"
            )
    if priors:
        arguments.append(f"prior={{{', '.join(priors)}}}")
    return ", ".join(arguments)


def with_options(
    advice: str, options: Mapping[str, object], interface: Interface
) -> str:
    """Return advice with the options that it needs, in the spelling of an interface.

    Options that are already in the advice are not repeated.
    """
    text = spelled(advice, interface)
    ready = {}
    # Priors that the user must measure.
    to_measure = {}
    for name, value in options.items():
        if value == PLACEHOLDER:
            to_measure[name] = value
        elif spelled_options([(name, value)], interface) not in text:
            ready[name] = value
    if ready:
        text = f"{text}: {spelled_options(ready.items(), interface)}"
    if to_measure:
        examples = spelled_options(to_measure.items(), interface)
        text = f"{text}, such as {examples}"
    return text


def _example_of(name: str, value: object) -> object:
    """Return an example for a prior that the user must measure. Other values are unchanged."""
    if value != PLACEHOLDER:
        return value
    is_translation = name.rpartition(".")[2] in ("x", "y", "z")
    return _PRIOR_OF_TRANSLATION if is_translation else _PRIOR_OF_ROTATION


def _is_value(name: str, text: str) -> bool:
    """Return whether a word after an option in a message is the value of the option."""
    if name not in _FIELDS:
        return name not in _CHOICES or text in _CHOICES[name]
    field = _FIELDS[name]
    is_text = isinstance(field.default, str)
    if is_text and not any(
        field.metadata[form] for form in ("parse", "choices", "words")
    ):
        # Any text can be the name of a frame.
        return False
    value: float | str = text
    with suppress(ValueError):
        value = float(text)
    try:
        if type(field.default) is int:
            value = int(value)
        check_value(field, value)
    except (ConfigError, ValueError):
        return False
    return True


def _typed(name: str, value: object) -> str:
    """Return an option and its value, such as ``--max-gap 0.2`` or ``--prior z=1.85+/-0.02``."""
    typed = _name_alone(name, Interface.TERMINAL)
    return (
        f"{typed}={value}" if name.startswith("prior.") else f"{typed} {value}"
    )


def _name_alone(name: str, interface: Interface) -> str:
    """Return an option without value, such as ``--max-gap``, ``--prior z`` or ``prior["z"]``."""
    group, _, axis = name.partition(".")
    is_prior = group == "prior"
    if interface is Interface.TERMINAL:
        return f"--prior {axis}" if is_prior else f"--{name}".translate(_DASHES)
    return f'prior["{axis}"]' if is_prior else name.replace(".", "_")


_DASHES = str.maketrans("._", "--")


def _value_of_python(value: object) -> str:
    """Return the Python notation of a value. Its type may be a text that contains a number."""
    with suppress(ValueError):
        return f"{float(str(value)):.12g}"
    return f'"{value}"' if isinstance(value, str) else str(value)


def _prior_of_python(text: str) -> str:
    """Return the Python notation of a prior: a pair of numbers, or a text with units."""
    plain = _PLAIN_PRIOR.fullmatch(text)
    return f"({plain[1]}, {plain[2]})" if plain else f'"{text}"'
