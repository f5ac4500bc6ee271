"""How the command line spells options."""

import dataclasses
import re

from hand_eye_calib.config import CalibratorConfig, option_name

OPTION_FIELDS = {option_name(field): field for field in dataclasses.fields(CalibratorConfig)}

# Options of trajectory files, which are no options of the engine.
_FILE_OPTIONS = ("stamp_unit", "repair_stamps")

# Only names that are no words of the language: `max_gap` and `prior.z`, but not `scale`. Not in
# a path, after dashes or in quotes.
_NAMES = re.compile(
    r"(?<![\w./\\='-])("
    + "|".join(
        re.escape(name) for name in (*OPTION_FIELDS, *_FILE_OPTIONS) if set(name) & set("._")
    )
    + r")(?![\w/=-]|\.\w)"
)


def flag(name: str) -> str:
    """The option of the command line for a public option name, without the leading dashes."""
    return name.replace(".", "-").replace("_", "-")


def as_typed(text: str) -> str:
    """A message of the engine with its option names as they are typed: ``raise max_gap`` becomes
    ``raise --max-gap``.
    """
    return _NAMES.sub(lambda match: f"--{flag(match[1])}", text)
