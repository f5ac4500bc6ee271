"""Parts of a result that layers above the core add, such as the scale of a goal."""

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.plain import Document, from_plain
from hand_eye_calib.core.base.registry import RESULT_PARTS


class ExtraTransform(NamedTuple):
    """Transform of a part. It maps coordinates of ``source`` into ``target``.

    ``covariance`` (6, 6) is the covariance of its error, in the frame ``source``.
    """

    T_target_source: FloatArray
    source: str
    target: str
    covariance: FloatArray


class Part:
    """Part of a result, by default a single record with the same name in results and documents.

    Parameters
    ----------
    name : str
    load : callable
        ``load()`` returns the type of the record.
    details : callable, optional
        ``details(record, result)`` returns lines of text about the record.

    Attributes
    ----------
    without : mapping of str to object
        Attributes that the part adds to a result, with the values they have without the part.
    file_names : tuple of str
        Names of the files that :meth:`files` may return.
    """

    file_names: tuple[str, ...] = ()

    def __init__(
        self,
        name: str,
        load: Callable[[], type],
        details: Callable[[Any, Any], list[str]] | None = None,
    ) -> None:
        self.name = name
        self.load = load
        self.without: Mapping[str, Any] = {name: None}
        self._details = details

    def attribute(self, value: Any, name: str) -> Any:
        """Return an attribute of a result that has the part."""
        return value

    def write(self, value: Any) -> Document:
        """Return the fields of a document for the part. A missing part has the ``value`` None."""
        return {self.name: value}

    def read(self, document: Mapping[str, Any]) -> Any:
        """Return the value of the part in a document; None if the document lacks the part.

        Raises
        ------
        KeyError, TypeError, ValueError
            If a value is missing or damaged.
        """
        value = document.get(self.name)
        if value is None:
            return None
        try:
            return from_plain(self.load(), value)
        except TypeError as error:
            raise TypeError(f"{self.name}: {error}") from None

    def invert(self, value: Any) -> Any:
        """Return the value of the part for the result with both sensors exchanged."""
        return value

    def transforms(self, value: Any) -> dict[str, ExtraTransform]:
        """Return the transforms of the part by their names."""
        return {}

    def details(self, value: Any, result: Any) -> list[str]:
        """Return lines of text about the part of a result."""
        return self._details(value, result) if self._details else []

    def facts(self, value: Any, result: Any) -> list[str]:
        """Return further lines about the part, for a user who requests all details."""
        return []

    def brief_facts(self, value: Any, result: Any) -> list[str]:
        """Return the facts as short lines, for a person next to the robot."""
        return self.facts(value, result)

    def files(self, value: Any, result: Any) -> dict[str, str]:
        """Return files to be saved beside a usable result: their names and texts."""
        return {}

    def advice(self, value: Any, result: Any) -> str:
        """Return what to record next if the result is not USE; empty without advice."""
        return ""

    def headline(self, value: Any) -> str:
        """Return a note on the part for the headline of a usable result; empty without one."""
        return ""


def advice_of(result: Any) -> list[str]:
    """Return what to record next, by the parts of a result that have advice."""
    advice = [
        part(name).advice(value, result) for name, value in result.parts.items()
    ]
    return [text for text in advice if text]


def facts_of(result: Any, *without: str) -> list[str]:
    """Return further lines about the parts of a result, except the parts ``without``."""
    facts = []
    for name, value in result.parts.items():
        if name not in without:
            facts += part(name).facts(value, result)
    return facts


def brief_facts_of(result: Any) -> list[str]:
    """Return short lines about the parts of a result."""
    facts = []
    for name, value in result.parts.items():
        facts += part(name).brief_facts(value, result)
    return facts


@cache
def part(name: str) -> Part:
    """Return a part by its name."""
    part_of_name: Part = RESULT_PARTS[name]()
    return part_of_name


def all_parts() -> Iterator[Part]:
    """Yield all parts that layers have registered."""
    yield from map(part, RESULT_PARTS)
