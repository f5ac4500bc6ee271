"""What commands print beside their result: notes, errors and progress, all on stderr. And how the
command line spells options.
"""

import dataclasses
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from hand_eye_calib.config import CalibratorConfig, option_name
from hand_eye_calib.errors import printable

if TYPE_CHECKING:
    from rich.progress import Progress
    from rich.table import Table

_Item = TypeVar("_Item")

_SILENT_S = 2.0
_REDRAW_S = 0.2
_CLEAR_LINE = "\r\033[K"

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


def note(text: object) -> None:
    """Print something that is good to know, in one line."""
    print(f"hand_eye_calib: note: {printable(as_typed(str(text)))}", file=sys.stderr)


def fail(error: object, code: int) -> int:
    """Print in one line what went wrong; returns ``code``."""
    print(f"hand_eye_calib: error: {printable(as_typed(str(error)))}", file=sys.stderr)
    return code


@contextmanager
def waiting_for(what: str) -> Iterator[None]:
    """On a terminal, show what is being done for as long as it lasts; after two seconds, how long
    it has taken.
    """
    if not sys.stderr.isatty():
        yield
        return
    print(f"{what} ...", end="", file=sys.stderr, flush=True)
    done = threading.Event()
    clock = threading.Thread(target=_show_seconds, args=(what, done), daemon=True)
    clock.start()
    try:
        yield
    finally:
        done.set()
        clock.join()
        print(_CLEAR_LINE, end="", file=sys.stderr, flush=True)


def _show_seconds(what: str, done: threading.Event) -> None:
    started = time.monotonic()
    wait_s = _SILENT_S
    while not done.wait(wait_s):
        seconds = time.monotonic() - started
        print(f"\r{what} ... {seconds:.0f} s", end="", file=sys.stderr, flush=True)
        wait_s = 1.0


def with_progress(
    items: Iterable[_Item],
    total: int | None,
    doing: str,
    size: Callable[[_Item], int] = lambda item: 1,
) -> Iterator[_Item]:
    """Pass on ``items``. On a terminal, from two seconds on, show how much is done, at what rate,
    and the time left.

    Parameters
    ----------
    items : iterable
    total : int or None
        Sum of their sizes, if it is known.
    doing : str
    size : callable
        What an item adds to what is done.
    """
    if not sys.stderr.isatty():
        yield from items
        return
    started = time.monotonic()
    redraw_at = started + _SILENT_S
    shown: Progress | None = None
    done = 0
    try:
        for item in items:
            if (now := time.monotonic()) >= redraw_at:
                if shown is None:
                    shown = _progress_bar()
                    shown.start()
                    task = shown.add_task(doing, total=total, rate="")
                rate = f"{done / max(now - started, 1e-9):,.0f}/s"
                shown.update(task, completed=done, rate=rate)
                redraw_at = now + _REDRAW_S
            yield item
            done += size(item)
    finally:
        if shown is not None:
            shown.stop()


def _progress_bar() -> "Progress":
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )


def print_table(table: "Table") -> None:
    """Print a table; through a pipe with whole lines, not those of a terminal of 80 columns."""
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console = Console(highlight=False, markup=False, width=240)
    console.print(table)
