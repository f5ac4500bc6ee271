"""What commands print beside their result: notes, errors and progress, all on stderr. And how the
command line spells options.
"""

import dataclasses
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

from hand_eye_calib.config import CalibratorConfig, option_name
from hand_eye_calib.errors import printable

_Item = TypeVar("_Item")

_CLEAR_LINE = "\r\033[K"
# Columns of a table that does not go to a terminal: its lines stay whole.
_WIDTH_IN_A_FILE = 240

# How a terminal shows the verdict that a line begins with.
_STYLES = {"USE": "bold green", "USE WITH CARE": "bold yellow", "DO NOT USE": "bold red"}

# Notes and progress are left out: work for a batch, of which only the result is of interest.
_IS_SILENT = ContextVar("is_silent", default=False)

OPTION_FIELDS = {option_name(field): field for field in dataclasses.fields(CalibratorConfig)}

# Options of :func:`hand_eye_calib.read_trajectory`.
_FILE_OPTIONS = [
    f"{stream}{name}"
    for stream in ("", "parent_", "child_")
    for name in ("format", "columns", "times", "stamp_unit")
]

# Names that are no words of the language, such as max_gap and prior.z, wherever they stand, but not
# in a path, after dashes or in quotes; and any name in backticks.
_UNMISTAKABLE = [name for name in (*OPTION_FIELDS, *_FILE_OPTIONS) if set(name) & set("._")]
_NAMES = re.compile(
    rf"`(?P<quoted>[\w.]+)`|(?<![\w./\\='-])(?P<plain>{'|'.join(map(re.escape, _UNMISTAKABLE))})"
    r"(?![\w/=-]|\.\w)"
)


def flag(name: str) -> str:
    """The option of the command line for a public option name, without the leading dashes."""
    return name.replace(".", "-").replace("_", "-")


def typed_options(options: Iterable[tuple[str, object]]) -> str:
    """Options by their public names, as they are typed."""
    return " ".join(f"--{flag(name)} {value}" for name, value in options)


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


@contextmanager
def silence() -> Iterator[None]:
    """Print neither notes nor progress inside the block."""
    token = _IS_SILENT.set(True)
    try:
        yield
    finally:
        _IS_SILENT.reset(token)


def note(text: object) -> None:
    """Print something that is good to know, in one line."""
    if not _IS_SILENT.get():
        print(f"hand_eye_calib: note: {printable(as_typed(str(text)))}", file=sys.stderr)


def fail(error: object, code: int) -> int:
    """Print in one line what went wrong; returns ``code``."""
    print(f"hand_eye_calib: error: {printable(as_typed(str(error)))}", file=sys.stderr)
    return code


def _is_watched() -> bool:
    return sys.stderr.isatty() and not _IS_SILENT.get()


@contextmanager
def waiting_for(what: str) -> Iterator[None]:
    """On a terminal, show what is being done for as long as it lasts."""
    if not _is_watched():
        yield
        return
    print(f"{what} ...", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        print(_CLEAR_LINE, end="", file=sys.stderr, flush=True)


def with_progress(
    items: Iterable[_Item],
    total: int | None,
    doing: str,
    size: Callable[[_Item], int] = lambda item: 1,
) -> Iterator[_Item]:
    """Pass on ``items``. On a terminal, show how much is done and the time left.

    Parameters
    ----------
    items : iterable
    total : int or None
        Sum of their sizes, if it is known.
    doing : str
    size : callable
        What an item adds to what is done.
    """
    if not _is_watched():
        yield from items
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(doing, total=total)
        for item in items:
            yield item
            progress.advance(task, size(item))


def print_result(text: str) -> None:
    """Print what a command found; on a terminal, the verdict that it begins with in its colour."""
    verdict, colon, rest = text.partition(":")
    if not (sys.stdout.isatty() and verdict in _STYLES):
        print(text)
        return
    from rich.console import Console
    from rich.text import Text

    Console(highlight=False).print(
        Text.assemble((verdict, _STYLES[verdict]), colon, rest), soft_wrap=True
    )


def print_table(title: str, headings: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """Print a table; through a pipe with whole lines, not those of a terminal of 80 columns.

    Columns whose heading begins with a space are aligned to the right.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table: Table = Table(title=title, box=box.SIMPLE, title_justify="left", pad_edge=False)
    for heading in headings:
        is_number = heading.startswith(" ")
        table.add_column(heading.strip(), justify="right" if is_number else "left", overflow="fold")
    for row in rows:
        table.add_row(*row)
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console = Console(highlight=False, markup=False, width=_WIDTH_IN_A_FILE)
    console.print(table)
