"""What commands print beside their result: notes, errors and progress, all on stderr. And how the
command line spells options.
"""

import dataclasses
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from typing import TypeVar

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import printable
from hand_eye_calib.option import option_name

_Item = TypeVar("_Item")

STREAMS = ("parent", "child")


class Exit(IntEnum):
    """Exit codes: failed or bad input; wrong usage; solved, but an axis is unobservable or the
    verdict is DO NOT USE; and what a shell reports for SIGINT and SIGPIPE.
    """

    GOOD = 0
    FAILED = 1
    USAGE = 2
    NOT_ALL = 3
    INTERRUPTED = 130
    BROKEN_PIPE = 141


# How a terminal shows the verdict that a line begins with: bold green, yellow, red.
_STYLES = {"USE": "\x1b[1;32m", "USE WITH CARE": "\x1b[1;33m", "DO NOT USE": "\x1b[1;31m"}

OPTION_FIELDS = {option_name(field): field for field in dataclasses.fields(CalibratorConfig)}

_OF_FILES = ("format", "columns", "times", "stamp_unit", "pair_by")
_OPTIONS = {*OPTION_FIELDS, *_OF_FILES, *(f"{one}_{name}" for one in STREAMS for name in _OF_FILES)}

# Names in backticks; and names that are no words of the language, such as max_gap and prior.z,
# wherever they stand, but not in a path, after dashes or in quotes.
_NAMES = re.compile(r"`([\w.]+)`|(?<![\w./\\='-])([a-z]+(?:[._][a-z_]+)+)(?![\w/=-]|\.\w)( VALUE)?")


def flag(name: str) -> str:
    """The option of the command line for a public option name, without the leading dashes."""
    return name.replace(".", "-").replace("_", "-")


def typed_options(options: Iterable[tuple[str, object]]) -> str:
    """Options by their public names, as they are typed."""
    return " ".join(f"--{flag(name)} {value}" for name, value in options)


def as_typed(text: str) -> str:
    """A message of the engine with its option names, which are those of Python and the node, as
    they are typed: ``raise max_gap`` becomes ``raise --max-gap``.
    """

    def typed(match: re.Match[str]) -> str:
        name, value = match[1] or match[2], match[3] or ""
        if name in _OPTIONS and name.startswith("prior."):
            return f"--prior {name.removeprefix('prior.')}{value.replace(' ', '=')}"
        return f"--{flag(name)}{value}" if name in _OPTIONS else match[0]

    return _NAMES.sub(typed, text)


def note(text: object) -> None:
    """Print something that is good to know, in one line."""
    print(f"hand_eye_calib: note: {printable(as_typed(str(text)))}", file=sys.stderr)


def fail(error: object, code: int = Exit.FAILED) -> int:
    """Print in one line what went wrong; returns ``code``."""
    print(f"hand_eye_calib: error: {printable(as_typed(str(error)))}", file=sys.stderr)
    return code


@contextmanager
def waiting_for(what: str) -> Iterator[None]:
    """On a terminal, show what is being done for as long as it lasts."""
    is_watched = sys.stderr.isatty()
    print(f"{what} ..." * is_watched, end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        print("\r\x1b[K" * is_watched, end="", file=sys.stderr, flush=True)


def with_progress(
    items: Iterable[_Item],
    total: int | None,
    doing: str,
    size: Callable[[_Item], int] = lambda item: 1,
) -> Iterator[_Item]:
    """Pass on items. On a terminal, show how much of the sum of their sizes is done and the time
    left.
    """
    if not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(doing, total=total)
        for item in items:
            yield item
            progress.advance(task, size(item))


def print_result(lines: Iterable[str], document: object = None) -> None:
    """Print what a command found: its document as JSON, if there is one; otherwise as text, on a
    terminal with the verdict that it begins with in its colour.
    """
    if document is None:
        text = "\n".join(map(printable, lines))
    else:
        from hand_eye_calib.plain import json_text

        text = json_text(document)
    verdict, colon, rest = text.partition(":")
    if sys.stdout.isatty() and verdict in _STYLES:
        text = f"{_STYLES[verdict]}{verdict}\x1b[0m{colon}{rest}"
    print(text, flush=True)
