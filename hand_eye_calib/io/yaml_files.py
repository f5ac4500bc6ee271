"""YAML of unknown origin, read within limits.

Every YAML file of the package is read here. Values are those of JSON: dates and other tags of YAML
are read as text or refused. What is not accepted is refused in one line: keys that appear twice,
numbers that are too long, and documents that are too large, too deep, or that expand to too much
by aliases and merge keys.
"""

import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from hand_eye_calib.errors import InputError
from hand_eye_calib.io.files import read_text
from hand_eye_calib.io.limits import (
    DEEPEST_YAML,
    LARGEST_YAML,
    LONGEST_NUMBER,
    MOST_YAML_VALUES,
)
from hand_eye_calib.plain import plain

_SCALARS = ("null", "bool", "int", "float", "str")
_MERGE = "tag:yaml.org,2002:merge"
_PREFIX = "tag:yaml.org,2002:"
_MOST_SHOWN = 300

# libyaml is ten times as fast, and part of most builds.
_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_Base):
    """YAML's safe loader without dates, and with limits."""


# Without dates, 2024-13-45 is a text like any other.
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":timestamp")]
    for first, resolvers in _Base.yaml_implicit_resolvers.items()
}


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file.

    Returns
    -------
    dict, list, str, float, int, bool or None

    Raises
    ------
    InputError
        If it cannot be read, is not YAML or exceeds a limit; one line that names the file.
    """
    return parse_yaml(read_text(path, "YAML", LARGEST_YAML), str(path))


def yaml_text(document: Any) -> str:
    """Values of any kind as a YAML file for programs and people."""
    return yaml.safe_dump(
        plain(document), sort_keys=False, default_flow_style=None, width=120, allow_unicode=True
    )


def parse_yaml(text: str, name: str) -> Any:
    """Read YAML from a text; ``name`` is that of the file in messages.

    Raises
    ------
    InputError
        As :func:`read_yaml`.
    """
    try:
        _check_events(text)
        loader = _Loader(text)
        try:
            root = loader.get_single_node()
            if root is None:
                return None
            _check_node(root, {}, frozenset())
            return loader.construct_document(root)
        finally:
            loader.dispose()
    # A loader raises nearly anything at values that are not what their tags say.
    except Exception as error:
        reason = " ".join(str(error).split())[:_MOST_SHOWN] or type(error).__name__
        raise InputError(f"{name} is not YAML that can be read: {reason}") from None


def parse_opencv_yaml(text: str, name: str) -> Any:
    """The same of a text that may be of OpenCV, whose header and tag are not of YAML."""
    return parse_yaml(re.sub(r"^%YAML:.*|!!opencv-matrix", "", text), name)


def _check_events(text: str) -> None:
    """Refuse what is too deep or too long, before anything is built from it."""
    depth = n_values = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        n_values += isinstance(event, yaml.NodeEvent)
        if depth > DEEPEST_YAML:
            raise ValueError(f"it is nested more than {DEEPEST_YAML} levels deep")
        if n_values > MOST_YAML_VALUES:
            raise ValueError(f"it has more than {MOST_YAML_VALUES} values")


def _check_node(node: yaml.Node, sizes: dict[int, int], above: frozenset[int]) -> int:
    """Number of values of a node with all aliases expanded; refuses what cannot be accepted."""
    key = id(node)
    if key in above:
        raise ValueError(f"an alias leads to the value it is part of{_place(node)}")
    if key not in sizes:
        parts = _parts(node)
        sizes[key] = 1 + sum(_check_node(part, sizes, above | {key}) for part in parts)
        if sizes[key] > MOST_YAML_VALUES:
            raise ValueError(f"its aliases expand to more than {MOST_YAML_VALUES} values")
    return sizes[key]


def _parts(node: yaml.Node) -> list[yaml.Node]:
    tag = node.tag.removeprefix(_PREFIX)
    if isinstance(node, yaml.MappingNode) and tag == "map":
        _check_keys(node)
        return [part for pair in node.value for part in pair]
    if isinstance(node, yaml.SequenceNode) and tag == "seq":
        return list(node.value)
    if isinstance(node, yaml.ScalarNode) and (tag in _SCALARS or node.tag == _MERGE):
        _check_scalar(node, tag)
        return []
    raise ValueError(f"a value has the tag {node.tag[:40]!r}{_place(node)}")


def _check_keys(node: yaml.MappingNode) -> None:
    seen: set[Hashable] = set()
    for name, _ in node.value:
        if not isinstance(name, yaml.ScalarNode):
            raise ValueError(f"a key is not a single value{_place(name)}")
        if name.value in seen:
            raise ValueError(f"the key {name.value[:40]!r} appears twice{_place(name)}")
        seen.add(name.value)


def _check_scalar(node: yaml.ScalarNode, tag: str) -> None:
    if tag in ("int", "float") and len(node.value) > LONGEST_NUMBER:
        raise ValueError(f"a number has {len(node.value)} characters{_place(node)}")
    if tag == "int" and not -(2**63) <= yaml.SafeLoader("").construct_yaml_int(node) < 2**63:
        raise ValueError(f"an integer does not fit into 64 bits{_place(node)}")


def _place(node: yaml.Node) -> str:
    return f", line {node.start_mark.line + 1}" if node.start_mark else ""
