"""Read YAML files of unknown origin within limits.

This module reads all YAML files of the package, including JSON with comments and YAML of OpenCV.
The values are those of JSON; a date is read as text. Other tags of YAML, repeated keys, aliases,
and documents that are too large or too deeply nested raise an error of one line.
"""

import re
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import yaml

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.option import LARGEST_INT
from hand_eye_calib.core.base.plain import plain
from hand_eye_calib.core.base.text import shortened
from hand_eye_calib.formats.files import (
    DEEPEST_YAML,
    LARGEST_YAML,
    LONGEST_NAME,
    read_text,
)

# Largest number of characters of an integer: 64 binary digits, with space for underscores.
_LONGEST_INT = 100
# Tags of YAML for the values of JSON.
_TAGS = ("null", "bool", "int", "float", "str", "seq", "map")

# The loader of libyaml is several times faster. Most builds of the package yaml contain it.
_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_dump = partial(
    yaml.dump,
    Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper),
    sort_keys=False,
)


class _Loader(_Base):
    """Safe loader of YAML, restricted to the values of JSON."""

    # Read dates as text: an impossible date such as 2024-13-45 would otherwise be an error.
    yaml_implicit_resolvers: ClassVar = {
        first: [
            (tag, pattern)
            for tag, pattern in resolvers
            if not tag.endswith(":timestamp")
        ]
        for first, resolvers in _Base.yaml_implicit_resolvers.items()
    }
    yaml_constructors: ClassVar = {
        tag: construct
        for tag, construct in _Base.yaml_constructors.items()
        if tag is None or tag.rpartition(":")[2] in _TAGS
    }

    def construct_mapping(
        self, node: Any, deep: bool = False
    ) -> dict[Any, Any]:
        """Return a mapping; raise a ValueError for a repeated key."""
        names = set()
        for key, _ in node.value:
            if (name := str(key.value)) in names:
                line = key.start_mark.line + 1
                raise ValueError(
                    f"the key {name[:40]!r} appears twice, line {line}"
                )
            names.add(name)
        return super().construct_mapping(node, deep)


def _whole_number(loader: Any, node: Any) -> int:
    """Return a whole number in any base; raise a ValueError if it does not fit into 64 bits.

    The length of the text is checked first, because the conversion of a long text is slow.
    """
    is_short = len(node.value) <= _LONGEST_INT
    number = int(loader.construct_yaml_int(node)) if is_short else LARGEST_INT
    if abs(number) >= LARGEST_INT:
        raise ValueError(
            f"a whole number is too large, line {node.start_mark.line + 1}"
        )
    return number


_Loader.add_constructor("tag:yaml.org,2002:int", _whole_number)


class UnreadableYamlError(InputError):
    """A file that is not YAML, such as a damaged file."""


def read_yaml(path: str | Path, expected: str = "YAML") -> Any:
    """Read a YAML file.

    Parameters
    ----------
    path : str or path-like
    expected : str
        Description of the expected file, for errors.

    Raises
    ------
    InputError
        If the file cannot be read, is not YAML or exceeds a limit.
    """
    text = read_text(path, expected, LARGEST_YAML)
    # Remove comments of JSON, and the header and tag of OpenCV.
    text = re.sub(
        r"^%YAML.*|^[ \t]*//.*|!!opencv-matrix", "", text, flags=re.MULTILINE
    )
    try:
        _check_events(text)
        return yaml.load(text, Loader=_Loader)
    # The loader raises errors of many types for values that do not fit their tags.
    except Exception as error:
        # The parser names its source. Remove this name, because the source is always a text.
        words = re.sub(r' in "<[a-z ]+>",', ",", " ".join(str(error).split()))
        reason = shortened(words, LONGEST_NAME // 2) or type(error).__name__
        raise UnreadableYamlError(
            f"{path} is not readable YAML: {reason}"
        ) from None


def yaml_text(document: Any) -> str:
    """Convert a document of any values to YAML that is easy to read."""
    return str(
        _dump(
            plain(document),
            default_flow_style=None,
            width=120,
            allow_unicode=True,
        )
    )


def _check_events(text: str) -> None:
    """Raise a ValueError for aliases and deep nesting, before any value is constructed."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST_YAML:
            raise ValueError(
                f"it is nested more than {DEEPEST_YAML} levels deep"
            )
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(
                f"aliases are not supported: write the value of {str(event.anchor)[:40]!r}"
            )
