"""How the command line spells options."""

import dataclasses
import re

from hand_eye_calib.config import CalibratorConfig, option_name

OPTION_FIELDS = {option_name(field): field for field in dataclasses.fields(CalibratorConfig)}

# Options of :func:`hand_eye_calib.read_trajectory`, and their names here.
_FILE_OPTIONS = {
    "format": "format",
    "columns": "columns",
    "times": "times",
    "stamp_unit": "stamp-unit",
}
_FILE_OPTIONS |= {
    f"{stream}_{name}": f"{stream}-{flag}"
    for stream in ("parent", "child")
    for name, flag in _FILE_OPTIONS.items()
}

# Names that are no words of the language, such as max_gap and prior.z, wherever they stand, but not
# in a path, after dashes or in quotes; and any name in backticks.
_UNMISTAKABLE = [name for name in (*OPTION_FIELDS, *_FILE_OPTIONS) if set(name) & set("._")]
_NAMES = re.compile(
    rf"`(?P<quoted>[\w.]+)`|(?<![\w./\\='-])(?P<plain>{'|'.join(map(re.escape, _UNMISTAKABLE))})"
    r"(?![\w/=-]|\.\w)"
)


def flag(name: str) -> str:
    """The option of the command line for a public option name, without the leading dashes."""
    return _FILE_OPTIONS.get(name) or name.replace(".", "-").replace("_", "-")


def as_typed(text: str) -> str:
    """A message of the engine with its option names as they are typed.

    Messages spell options as Python and the node do. ``raise max_gap`` becomes ``raise --max-gap``;
    a name that is also a word is in backticks, and becomes an option, too.
    """
    return _NAMES.sub(_typed, text)


def _typed(match: re.Match[str]) -> str:
    name = match["quoted"] or match["plain"]
    is_option = name in OPTION_FIELDS or name in _FILE_OPTIONS
    return f"--{flag(name)}" if is_option else match[0]
