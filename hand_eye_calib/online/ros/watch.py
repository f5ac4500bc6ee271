"""The command ``watch``: display the live node on a terminal and in a browser."""

import argparse
import contextlib
import os
import queue
import re
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from io import StringIO
from typing import TYPE_CHECKING

from hand_eye_calib.online.watch.view import KEYS, View

if TYPE_CHECKING:
    from hand_eye_calib.online.watch.board import Board

EXAMPLES = """\
examples:
  hand_eye_calib watch                     on this terminal
  hand_eye_calib watch --web               also in a browser, on a phone for example
  hand_eye_calib watch --node /robot1/calibrator
  hand_eye_calib watch > log.txt           a line for every new headline"""

# Ports of the page if the user names none; the first free port is used. Not 8765, which
# foxglove_bridge uses. Ten, for several robots or people on one computer.
_DEFAULT_PORTS = range(8775, 8785)
_DEFAULT_ADDRESS = ("", _DEFAULT_PORTS)

# Longest wait (s) for a message. Keys and requests of a browser are processed after it.
_MAX_WAIT_S = 0.1

# A second press of a key within this time (s) confirms a request.
_CONFIRM_WITHIN_S = 5.0

_REQUESTS = {key: request for request, key in KEYS.items()}

# Requests that need a second press of their key, with their consequences.
_CONSEQUENCES = {
    "reset": "forgets all poses",
    "recalibrate": "stops watching and calibrates anew",
    "forget": "removes all values that were typed in",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.usage = "%(prog)s [OPTION ...]"
    parser.epilog = EXAMPLES
    node = (
        "full name of the node, such as /robot1/calibrator. "
        "Default: the first node that publishes"
    )
    parser.add_argument("--node", metavar="NAME", default="", help=node)
    web = (
        "also serve a page for browsers. Default: port "
        f"{_DEFAULT_PORTS.start} of all addresses, or the next free port"
    )
    parser.add_argument(
        "--web",
        metavar="[HOST:]PORT",
        nargs="?",
        const=_DEFAULT_ADDRESS,
        type=_address,
        help=web,
    )


def run(arguments: argparse.Namespace) -> int:
    """Display the node until a signal or the key ``q``; return the exit code."""
    from hand_eye_calib.online.ros.watcher import Watcher
    from hand_eye_calib.online.watch.board import Board

    board = Board(arguments.node)
    requests = queue.SimpleQueue[str]()
    received: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda signum, _: received.append(signum))
    with contextlib.ExitStack() as stack:
        watcher = stack.enter_context(Watcher(board))
        addresses = [""]
        if arguments.web is not None:
            from hand_eye_calib.online.watch.web import WebServer

            server = WebServer(board, requests.put, *arguments.web)
            stack.callback(server.stop)
            addresses = server.addresses()
            for address in addresses:
                print(
                    f"hand_eye_calib: note: open {address} in a browser",
                    file=sys.stderr,
                )
        session = Session(board, requests, stack.enter_context(_keyboard()))
        display = stack.enter_context(_display(addresses[0]))
        while not received and not session.is_over:
            watcher.spin(_MAX_WAIT_S)
            while not requests.empty():
                watcher.ask(requests.get())
            display(session.view(), session.shows_code)
    return 0


class Session:
    """Process the keys that a person presses on the terminal.

    Parameters
    ----------
    board : Board
    requests : queue of str
        Queue that gets the requests of the keys.
    keys : callable
        Function that returns the keys pressed since its last call.

    Attributes
    ----------
    is_over : bool
        Whether the person has ended the program.
    shows_code : bool
        Whether the QR code of the page's address replaces the view.
    """

    def __init__(
        self,
        board: "Board",
        requests: "queue.SimpleQueue[str]",
        keys: Callable[[], str],
    ) -> None:
        self.is_over = False
        self.shows_code = False
        self._board = board
        self._requests = requests
        self._keys = keys
        # Request that waits for a second press of its key.
        self._unconfirmed = ""
        # End of this wait (steady time, s).
        self._confirm_until_s = 0.0

    def view(self) -> View:
        """Process the pressed keys and return the view."""
        now_s = time.monotonic()
        for key in self._keys():
            # Ctrl-C and Ctrl-D also end the program.
            if key in ("q", "\x03", "\x04"):
                self.is_over = True
            elif key == "p":
                self.shows_code = not self.shows_code
            else:
                self._press(key, now_s)
        return self._board.view(now_s)

    def _press(self, key: str, now_s: float) -> None:
        """Send the request of a key, or ask for a second press."""
        request = _REQUESTS.get(key, "")
        if request not in self._board.view(now_s).buttons:
            return
        is_confirmed = (
            request == self._unconfirmed and now_s <= self._confirm_until_s
        )
        if request in _CONSEQUENCES and not is_confirmed:
            self._unconfirmed = request
            self._confirm_until_s = now_s + _CONFIRM_WITHIN_S
            text = f"{_CONSEQUENCES[request]}: press {key} again"
            self._board.answer(request, False, text, now_s)
        else:
            self._requests.put(request)


@contextlib.contextmanager
def _display(address: str) -> Iterator[Callable[[View, bool], None]]:
    """Yield a function that displays a view.

    Its arguments are a View, and whether to display the QR code of the page's address instead. On a
    terminal, the view fills the screen. A file or a pipe receives lines. A line is left out if it
    differs from a line of the last view only in numbers.
    """
    from rich.live import Live
    from rich.text import Text

    from hand_eye_calib.online.watch.terminal import lines, screen

    if not sys.stdout.isatty():
        printed: set[str] = set()

        def write(view: View, shows_code: bool) -> None:
            before = printed.copy()
            printed.clear()
            for line in lines(view):
                # The line without its numbers.
                key = re.sub(r"[\d.]+", "", line)
                printed.add(key)
                if key not in before:
                    print(line, flush=True)

        yield write
        return
    code = qr_code(address)
    footer = f"phone: {address}" if address else ""
    if code:
        footer = f"p QR code   {footer}"
    displayed: tuple[object, ...] = ()
    with Live(screen=True, auto_refresh=False) as live:

        def draw(view: View, shows_code: bool) -> None:
            nonlocal displayed
            size = live.console.size
            content = view, size, shows_code
            if content == displayed:
                return
            if code and shows_code:
                # These colours are readable on light terminals as well.
                live.update(
                    Text.from_ansi(code, style="bright_white on black"),
                    refresh=True,
                )
            else:
                live.update(screen(view, size.width, footer), refresh=True)
            displayed = content

        yield draw


def qr_code(address: str) -> str:
    """Return an address as a QR code in characters; empty if ``segno`` is not installed."""
    try:
        import segno
    except ModuleNotFoundError:
        return ""
    text = StringIO()
    if address:
        segno.make(address, micro=False, error="l").terminal(
            out=text, border=2, compact=True
        )
    return text.getvalue()


@contextlib.contextmanager
def _keyboard() -> Iterator[Callable[[], str]]:
    """Yield a function that returns the keys pressed since its last call.

    Keys are read at once, without Enter, and not displayed. If standard input or output is not a
    terminal, the function returns an empty text.
    """
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        yield str
        return
    import termios
    import tty

    def pressed() -> str:
        keys = b""
        while select.select([sys.stdin], [], [], 0)[0] and (
            read := os.read(0, 64)
        ):
            keys += read
        return keys.decode(errors="replace")

    before = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)
        yield pressed
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def _address(text: str) -> tuple[str, Sequence[int]]:
    """Return the host, and a list of one port, from PORT or HOST:PORT."""
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or int(port) > 65535:
        raise argparse.ArgumentTypeError(
            f"expected PORT or HOST:PORT, got {text!r}; a port is at most 65535"
        )
    return host.strip("[]"), [int(port)]
