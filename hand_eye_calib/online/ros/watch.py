"""``watch``: the live node as a person sees it, on a terminal and in a browser."""

import argparse
import contextlib
import os
import queue
import re
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from io import StringIO
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hand_eye_calib.online.watch.board import Board, View

EXAMPLES = """\
examples:
  hand_eye_calib watch                     on this terminal
  hand_eye_calib watch --web               also in a browser, on a phone for example
  hand_eye_calib watch --node /robot1/calibrator
  hand_eye_calib watch > seen.txt          a line whenever something else is said"""

_PORT = 8765
_LISTEN_S = 0.1
_SURE_WITHIN_S = 5.0
_KEYS = {
    "s": "solve",
    "w": "save",
    "r": "reset",
    "c": "recalibrate",
    "a": "acknowledge",
    "f": "forget",
}
_SURE = {
    "r": "forgets all poses",
    "c": "stops watching and calibrates anew",
    "f": "removes all priors",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.usage = "%(prog)s [OPTION ...]"
    parser.epilog = EXAMPLES
    add = parser.add_argument
    node = "full name of the node, such as /robot1/calibrator. Default: the first that is heard"
    add("--node", metavar="NAME", default="", help=node)
    web = f"also serve a page for browsers, at port {_PORT} of all addresses by default"
    at = ("", _PORT)
    add("--web", metavar="[HOST:]PORT", nargs="?", const=at, type=_address, help=web)


def run(arguments: argparse.Namespace) -> int:
    """Show the node until told to end; returns the exit code."""
    from hand_eye_calib.online.ros.watcher import Watcher
    from hand_eye_calib.online.watch.board import Board

    board = Board(arguments.node)
    requests = queue.SimpleQueue[str]()
    came: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda signum, _: came.append(signum))
    with contextlib.ExitStack() as stack:
        watcher = stack.enter_context(Watcher(board))
        addresses = [""]
        if arguments.web is not None:
            from hand_eye_calib.online.watch.web import WebServer

            server = WebServer(board, requests.put, arguments.web)
            stack.callback(server.stop)
            addresses = server.addresses()
            for address in addresses:
                print(f"hand_eye_calib: note: open {address} in a browser", file=sys.stderr)
        session = Session(board, requests, stack.enter_context(_keyboard()))
        show = stack.enter_context(_display(addresses[0]))
        while not came and not session.is_over:
            watcher.spin(_LISTEN_S)
            while not requests.empty():
                watcher.ask(requests.get())
            show(session.view(), session.shows_code)
    return 0


class Session:
    """What the person at the terminal has typed, also keys that wait for a second press; ``keys``
    gives those pressed since the last call, and the queue takes the requests.
    """

    def __init__(
        self, board: "Board", requests: "queue.SimpleQueue[str]", keys: Callable[[], str]
    ) -> None:
        self.is_over = self.shows_code = False
        self._board = board
        self._requests = requests
        self._keys = keys
        self._sure = ""
        self._sure_until_s = 0.0

    def view(self) -> "View":
        """Do what was typed, and make the view."""
        now_s = time.monotonic()
        for key in self._keys():
            request = _KEYS.get(key, "")
            if key in ("q", "\x03", "\x04"):
                self.is_over = True
            elif key == "p":
                self.shows_code = not self.shows_code
            elif request not in self._board.view(now_s).buttons:
                continue
            elif key in _SURE and (key != self._sure or now_s > self._sure_until_s):
                self._sure = key
                self._sure_until_s = now_s + _SURE_WITHIN_S
                self._board.answer(request, False, f"{_SURE[key]}: press {key} again", now_s)
            else:
                self._requests.put(request)
        return self._board.view(now_s)


@contextlib.contextmanager
def _display(address: str) -> "Iterator[Callable[[View, bool], None]]":
    """Function that shows a view, or the code of the page's address: on the screen of a terminal,
    or in lines for a file or a pipe.
    """
    from rich.live import Live
    from rich.text import Text

    from hand_eye_calib.online.watch.terminal import lines, screen

    if not sys.stdout.isatty():
        said: set[str] = set()

        def write(view: "View", shows_code: bool) -> None:
            before = said.copy()
            said.clear()
            for line in lines(view):  # those that differ in their numbers only are the same
                said.add(key := re.sub(r"[\d.]+", "", line))
                if key not in before:
                    print(line, flush=True)

        yield write
        return
    code = qr_code(address)
    footer = f"{'p QR code   ' * bool(code)}phone: {address}" if address else ""
    shown: tuple[object, ...] = ()
    with Live(screen=True, auto_refresh=False) as live:

        def show(view: "View", shows_code: bool) -> None:
            nonlocal shown
            size = live.console.size
            if shown != (view, size, shows_code):
                of_view = screen(view, size.width, footer)
                of_code = Text.from_ansi(code, style="bright_white on black")  # on light ones, too
                live.update(of_code if code and shows_code else of_view, refresh=True)
                shown = view, size, shows_code

        yield show


def qr_code(address: str) -> str:
    """The address as a QR code in characters; empty without the library for it."""
    try:
        import segno
    except ModuleNotFoundError:
        return ""
    drawn = StringIO()
    if address:
        segno.make(address, micro=False, error="l").terminal(out=drawn, border=2, compact=True)
    return drawn.getvalue()


@contextlib.contextmanager
def _keyboard() -> Iterator[Callable[[], str]]:
    """Function that gives the keys pressed since its last call, at once, without Enter and without
    showing them; none unless a person sits at a terminal.
    """
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        yield str
        return
    import termios
    import tty

    def pressed() -> str:
        keys = b""
        while select.select([sys.stdin], [], [], 0)[0] and (read := os.read(0, 64)):
            keys += read
        return keys.decode(errors="replace")

    before = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)
        yield pressed
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or int(port) > 65535:
        raise argparse.ArgumentTypeError(f"expected PORT or HOST:PORT, got {text!r}")
    return host.strip("[]"), int(port)
