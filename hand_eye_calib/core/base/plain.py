"""Conversion between values of the package and plain data, the types of JSON and YAML."""

import json
import math
import types
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache
from typing import Any, TypeAlias, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

# Mapping of JSON or YAML: names to plain values.
Document: TypeAlias = dict[str, Any]

# Upper bound of numbers in files. Products of several such numbers are finite.
_MAX_NUMBER = 1e50


def plain(value: Any) -> Any:
    """Convert a value and its contents to mappings, lists, texts, bools and numbers.

    A dataclass becomes a mapping of its fields. Numbers and arrays of NumPy become numbers and
    lists. An enum becomes its value, with underscores instead of spaces. Infinity and NaN, which
    JSON does not have, become None.
    """
    if isinstance(value, Enum):
        return _plain_member(value)
    if is_dataclass(value) and not isinstance(value, type):
        value = {
            field.name: getattr(value, field.name) for field in fields(value)
        }
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value


def _plain_member(member: Enum) -> Any:
    """Return the plain value of a member of an enumeration."""
    value = member.value
    return value.replace(" ", "_") if isinstance(value, str) else plain(value)


def from_plain(kind: Any, value: Any, **names: type) -> Any:
    """Convert plain data back to a type: the inverse of :func:`plain`.

    Keys without a field in the dataclass are ignored. None for a float becomes infinity.

    Parameters
    ----------
    kind : type
        A dataclass, an enum, float, int, bool or str; or a tuple, a Mapping or a union of these
        types. For an array type, ``value`` must already be an array.
    value : plain data
        Value to convert.
    **names
        Types by name, for names that the module of a dataclass imports only for type checkers.

    Raises
    ------
    KeyError
        If the data lack a field of a dataclass.
    TypeError, ValueError
        If the data have another type, or a number is too large.
    """
    origin = get_origin(kind)
    if origin in (Union, types.UnionType):
        return _one_of(get_args(kind), value)
    if is_dataclass(kind):
        return _record(kind, _of_type(Mapping, value), names)
    if origin is not None:
        return _collection(kind, value)
    if kind is float:
        return _number(value)
    if issubclass(kind, Enum):
        return _member(kind, value)
    if isinstance(value, bool) and kind is not bool:
        raise TypeError(f"expected {kind.__name__}, found true or false")
    return _of_type(kind, value)


def _one_of(kinds: Sequence[Any], value: Any) -> Any:
    """Convert plain data to the first fitting type of a union. None stays None."""
    if value is None:
        return None
    kinds = [kind for kind in kinds if kind is not types.NoneType]
    fitting = [kind for kind in kinds if get_origin(kind) or is_dataclass(kind)]
    fitting = fitting or [kind for kind in kinds if isinstance(value, kind)]
    return from_plain((fitting or kinds)[0], value)


def _collection(kind: Any, value: Any) -> Any:
    """Convert plain data to a mapping, a tuple or an array."""
    origin = get_origin(kind)
    args = get_args(kind)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        items = _of_type(Mapping, value).items()
        return {key: from_plain(args[1], item) for key, item in items}
    if origin is tuple:
        if isinstance(value, str):
            raise TypeError("expected a list, found a text")
        return tuple(
            from_plain(args[0], item) for item in _of_type(Sequence, value)
        )
    # Since NumPy 2.5, the origin of an array type is NDArray; before, it was np.ndarray.
    assert origin in (np.ndarray, NDArray), kind
    return _of_type(np.ndarray, value)


def _member(kind: type[Enum], value: Any) -> Enum:
    """Return the member of an enum by its plain data or by its value."""
    by_plain = {plain(member): member for member in kind}
    return by_plain[value] if value in by_plain else kind(value)


# Type hints are cached. Resolving them takes longer than the rest of a conversion.
_hints = cache(get_type_hints)


def _record(
    kind: Any, value: Mapping[str, Any], names: Mapping[str, type]
) -> Any:
    """Convert plain data to a dataclass; see :func:`from_plain`."""
    hints = get_type_hints(kind, localns=names) if names else _hints(kind)
    values = {}
    for field in fields(kind):
        if field.name in value:
            try:
                values[field.name] = from_plain(
                    hints[field.name], value[field.name]
                )
            except TypeError as error:
                raise TypeError(f"{field.name}: {error}") from None
        elif field.default is MISSING and field.default_factory is MISSING:
            raise KeyError(field.name)
    return kind(**values)


def _number(value: Any) -> float:
    if value is None:
        return math.inf
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"expected a number, found {type(value).__name__}")
    if not abs(value) < _MAX_NUMBER:
        raise ValueError("a number is not finite, or far too large")
    return float(value)


def _of_type(kind: type, value: Any) -> Any:
    if not isinstance(value, kind):
        raise TypeError(
            f"expected a {kind.__name__.lower()}, found {type(value).__name__}"
        )
    return value


def json_text(document: Any) -> str:
    """Return a JSON text with indentation."""
    return json.dumps(plain(document), indent=2, allow_nan=False)
