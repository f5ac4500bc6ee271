"""What commands say beside their result: notes, errors and progress, all on stderr."""

import sys
import time
from contextlib import contextmanager

_SILENT_S = 2.0
_REDRAW_S = 0.2
_CLEAR_LINE = "\r\033[K"


def note(text):
    """Say something that is good to know."""
    print(f"hand_eye_calib: note: {text}", file=sys.stderr)


def fail(error, code):
    """Say in one line what went wrong; returns ``code``."""
    print(f"hand_eye_calib: error: {error}", file=sys.stderr)
    return code


@contextmanager
def waiting_for(what):
    """On a terminal, show what is being done for as long as it lasts."""
    is_terminal = sys.stderr.isatty()
    if is_terminal:
        print(f"{what} ...", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        if is_terminal:
            print(_CLEAR_LINE, end="", file=sys.stderr, flush=True)


def with_progress(items, total, doing, size=lambda item: 1):
    """Pass on ``items``; on a terminal, once that has taken two seconds, show how far, how fast and
    how long still.

    Parameters
    ----------
    items : iterable
    total : int or None
        How many there are, as far as one knows.
    doing : str
    size : callable
        For how many an item counts.
    """
    if not sys.stderr.isatty():
        yield from items
        return
    started = redraw_at = time.monotonic()
    redraw_at += _SILENT_S
    progress, done = None, 0
    try:
        for item in items:
            if (now := time.monotonic()) >= redraw_at:
                if progress is None:
                    progress = _progress_bar()
                    progress.start()
                    task = progress.add_task(doing, total=total, rate="")
                progress.update(
                    task, completed=done, rate=f"{done / max(now - started, 1e-9):,.0f}/s"
                )
                redraw_at = now + _REDRAW_S
            yield item
            done += size(item)
    finally:
        if progress is not None:
            progress.stop()


def _progress_bar():
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[rate]}"), TimeRemainingColumn(),
    )  # fmt: skip
    return Progress(*columns, console=Console(stderr=True), transient=True)
