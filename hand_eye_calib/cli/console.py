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


def with_progress(items, total, doing):
    """Pass on ``items``; on a terminal, once that has taken two seconds, show how far it has got."""
    if not sys.stderr.isatty():
        yield from items
        return
    redraw_at = time.monotonic() + _SILENT_S
    shown = False
    try:
        for done, item in enumerate(items):
            if time.monotonic() >= redraw_at:
                print(f"\r{doing}: {done / max(total, 1):4.0%}", end="", file=sys.stderr, flush=True)
                redraw_at, shown = time.monotonic() + _REDRAW_S, True
            yield item
    finally:
        if shown:
            print(_CLEAR_LINE, end="", file=sys.stderr, flush=True)
