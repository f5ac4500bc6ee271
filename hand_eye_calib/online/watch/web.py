"""Serve a view as a page for browsers. The page loads nothing from the internet.

The server sends the view as server-sent events. An event is a fragment of HTML that replaces the
previous fragment. The buttons of the page send requests to the server. Every request needs the key
in the address of the page, so other pages in the same browser cannot use the server.
"""

import contextlib
import errno
import hmac
import json
import os
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from html import escape
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from hand_eye_calib.core.base.errors import ConfigError, printable
from hand_eye_calib.core.base.text import AXIS_UNITS, prior_as_typed
from hand_eye_calib.online.live.state import REPORT_PERIOD_S
from hand_eye_calib.online.watch.board import Board
from hand_eye_calib.online.watch.view import KEYS, Bar, Line, Tone, View

# Period (s) at which the server compares the view with the last sent view.
_PERIOD_S = 0.25

# A browser that accepts no data for this time (s) is disconnected.
_TIMEOUT_S = 10.0

# Files of the page that need no key. A page cannot add the key to their addresses.
_STYLE_AND_SCRIPT = ("page.css", "page.js")
_FOLDER = files("hand_eye_calib.online.watch").joinpath("page")
# Sketch of a vehicle with the names of its axes. The vehicle is seen from its left, so its y axis
# points towards the reader.
_SKETCH = _FOLDER.joinpath("sketch.svg").read_text(encoding="utf-8")
# Advice about options at the end of a reason. On the page, the form replaces it.
_PRIOR_ADVICE = re.compile("and give (a prior|priors), such as [^<]*")
# Files of a saved result to which the page links.
SAVED = ("report.html", "extrinsic.yaml")
# Media types by extension; all other files are plain text.
_MEDIA_TYPES = {"css": "text/css", "js": "text/javascript", "html": "text/html"}
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
# Content security policies of the page, and of the files of a saved result.
_POLICY = (
    "default-src 'none'; connect-src 'self'; img-src data:; script-src 'self'; style-src 'self'; "
    "frame-ancestors 'none'; base-uri 'none'"
)
_POLICY_OF_SAVED = (
    "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'"
)


def _user_key() -> str:
    """Return the key of this user.

    The key is stored in a file. After a restart it is the same, so that an open page can reconnect.
    If no file can be stored that only this user can read, a new key is made.
    """
    new_key = secrets.token_urlsafe(6)
    with contextlib.suppress(OSError, RuntimeError, ValueError):
        folder = (
            os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
        )
        path = Path(folder, "hand_eye_calib", "watch_key")
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(
            path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600
        )
        with open(descriptor, "r+") as file:
            status = os.fstat(descriptor)
            is_private = (
                status.st_uid == os.getuid() and not status.st_mode & 0o077
            )
            key = file.read()
            if is_private and re.fullmatch(r"[\w-]{8,}", key, re.ASCII):
                return key
            if is_private and not key:
                file.write(new_key)
    return new_key


class WebServer(ThreadingHTTPServer):
    """Serve the view in separate threads until :meth:`stop` is called.

    Parameters
    ----------
    board : Board
    ask : callable
        Function that is called in another thread with a request of ``view.KEYS``, or with a
        parameter and its value such as ``prior.z:=1.85m+/-0.02m``; ``prior.z:=`` removes the prior.
    host : str
        Address to serve; empty for all addresses of the computer.
    ports : sequence of int
        Ports; the first one that is not in use is taken. Port 0 stands for any free port.

    Raises
    ------
    ConfigError
        If the address cannot be used.
    """

    daemon_threads = True
    block_on_close = False

    def __init__(
        self,
        board: Board,
        ask: Callable[[str], None],
        host: str,
        ports: Sequence[int],
    ) -> None:
        self.key = _user_key()
        self.board = board
        self.ask = ask
        self.stopping = threading.Event()
        self._host = host
        for port in ports:
            try:
                super().__init__((host, port), _Handler)
                break
            except (OSError, OverflowError) as error:
                is_in_use = getattr(error, "errno", None) == errno.EADDRINUSE
                if is_in_use and port != ports[-1]:
                    continue
                reason = getattr(error, "strerror", None) or error
                raise ConfigError(
                    f"cannot serve the page on {host}:{port}: {reason}; choose another with "
                    "--web PORT"
                ) from None
        threading.Thread(
            target=self.serve_forever, name="web", daemon=True
        ).start()

    def addresses(self) -> list[str]:
        """Return addresses of the page.

        With a network, the first address also works on other computers.
        """
        hosts = [self._host or "localhost"]
        probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        # connect() raises an error on a computer without a network.
        with probe, contextlib.suppress(OSError):
            # For UDP, connect() sends nothing; it only selects the network interface. 192.0.2.1 is
            # reserved for documentation (RFC 5737).
            probe.connect(("192.0.2.1", 9))
            if not self._host:
                hosts.insert(0, str(probe.getsockname()[0]))
        return [
            f"http://{host}:{self.server_port}/?key={self.key}"
            for host in hosts
        ]

    def stop(self) -> None:
        """Close all connections."""
        self.stopping.set()
        self.shutdown()
        self.server_close()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore browsers that have closed their connection."""


class _Handler(BaseHTTPRequestHandler):
    """Answer the requests of one connection."""

    server: WebServer
    protocol_version = "HTTP/1.1"
    server_version = "hand_eye_calib"
    sys_version = ""
    timeout = _TIMEOUT_S

    def do_GET(self) -> None:
        """Send a file of the page, the events, or a file of the saved result."""
        name = self._path() or "page.html"
        if name not in _STYLE_AND_SCRIPT and not self._has_key():
            text = b"Open the whole address that `hand_eye_calib watch` shows on its terminal."
            self._send(HTTPStatus.FORBIDDEN, text)
        elif name in ("page.html", *_STYLE_AND_SCRIPT):
            self._send(HTTPStatus.OK, _FOLDER.joinpath(name).read_bytes(), name)
        elif name == "events":
            self._send_events()
        elif name in SAVED and (content := self._saved(name)):
            self._send(HTTPStatus.OK, content, name, _POLICY_OF_SAVED)
        else:
            self._send(HTTPStatus.NOT_FOUND, b"there is no such page")

    def do_POST(self) -> None:
        """Pass the request of a button, or a prior, on to the node."""
        # The body of the request is not read, so the connection cannot be used again.
        self.close_connection = True
        if not self._has_key():
            self._send(HTTPStatus.FORBIDDEN, b"the key is missing")
            return
        request = self._path()
        axis = self._argument("axis")
        if request == "forget" and axis in AXIS_UNITS:
            request = f"prior.{axis}:="
        elif request == "prior" and axis in AXIS_UNITS:
            # The node refuses a value that is not a number.
            prior = prior_as_typed(
                axis, self._argument("value"), self._argument("sigma")
            )
            request = printable(f"prior.{axis}:={prior}")
        elif request not in KEYS:
            self._send(HTTPStatus.NOT_FOUND, b"there is no such request")
            return
        self.server.ask(request)
        self._send(HTTPStatus.OK, b"")

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: the terminal displays the view."""

    def _saved(self, name: str) -> bytes:
        """Return a file of the saved result; empty if there is none, or if it is a symbolic link.

        If the node runs on another computer, the file may be missing here.
        """
        folder = self.server.board.view(time.monotonic()).saved_in
        file = Path(folder, name)
        return (
            file.read_bytes()
            if folder and file.is_file() and not file.is_symlink()
            else b""
        )

    def _path(self) -> str:
        """Return the path of the request without the slash."""
        return urlsplit(self.path).path[1:]

    def _argument(self, name: str) -> str:
        """Return an argument of the request; empty if it is missing."""
        return parse_qs(urlsplit(self.path).query).get(name, [""])[-1]

    def _has_key(self) -> bool:
        """Return whether the address has the right key, in the same time for any key."""
        key = self._argument("key").encode(errors="replace")
        return hmac.compare_digest(key, self.server.key.encode())

    def _send(
        self,
        status: HTTPStatus,
        content: bytes,
        name: str = "",
        policy: str = _POLICY,
    ) -> None:
        media_type = _MEDIA_TYPES.get(name.rpartition(".")[2], "text/plain")
        self._begin(status, media_type, policy)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def _begin(
        self, status: HTTPStatus, media_type: str, policy: str = _POLICY
    ) -> None:
        """Send the status and the headers of every response."""
        self.send_response(status)
        self.send_header("Content-Type", f"{media_type}; charset=utf-8")
        self.send_header("Content-Security-Policy", policy)
        for name, value in _HEADERS.items():
            self.send_header(name, value)

    def _send_events(self) -> None:
        self.close_connection = True
        self._begin(HTTPStatus.OK, "text/event-stream")
        self.end_headers()
        # The browser may have closed the connection.
        with contextlib.suppress(OSError):
            for event in self._events():
                self.wfile.write(event)

    def _events(self) -> Iterator[bytes]:
        """Yield the view whenever it has changed, and an empty event after a second without one."""
        last_html = ""
        sent_s = 0.0
        while not self.server.stopping.wait(_PERIOD_S if last_html else 0.0):
            now_s = time.monotonic()
            view = self.server.board.view(now_s)
            # Path.is_file raises an error for a name that is too long.
            files = [
                name
                for name in SAVED
                if os.path.isfile(f"{view.saved_in}/{name}")
            ]
            html = fragment(view, files if view.saved_in else ())
            # The data of an event are one line.
            html = " ".join(html.splitlines())
            if html != last_html:
                yield f"data: {html}\n\n".encode()
            elif now_s - sent_s >= REPORT_PERIOD_S:
                yield b"data: \n\n"
            else:
                continue
            last_html = html
            sent_s = now_s


def fragment(view: View, files: Sequence[str] = ()) -> str:
    """Return the HTML of a view, without buttons and links.

    Buttons and links are fixed parts of the page: a button that is replaced under a finger does not
    react. Attributes of the first element list the buttons and links to display.

    Parameters
    ----------
    view : View
    files : sequence of str
        Saved files to which the page may link.
    """
    headline = f"<h1>{_sign(view.tone)} {escape(view.word)}</h1>{_element('p', view.sentence)}"
    if view.advice:
        headline += _element("p", view.advice, "advice")
    if view.facts:
        headline += _element("p", view.facts, "facts")
    axes_title = "precision against the target"
    if any(bar.difference for bar in view.bars):
        axes_title += ", change from installed"
    bars = "".join(map(_bar, view.bars))
    if any(bar.meaning for bar in view.bars):
        bars = _SKETCH + bars
    pose = [
        _element("dt", axis) + _element("dd", text)
        for axis, text in view.values
    ]
    # The first line of the result is the verdict. The reasons for the verdict follow it.
    reasons = _listed(view.reasons)
    # Without a form, the motion must change.
    replacement = (
        "and type it above" if view.by_hand else "or change the motion"
    )
    reasons = _PRIOR_ADVICE.sub(replacement, reasons)
    health = _lines(view.result[:1]) + reasons
    health += _lines(view.result[1:] + view.health)
    return (
        f'<div id="state" class="{view.tone.name.lower()}" data-buttons="{" ".join(view.buttons)}" '
        f'data-asked="{view.asked}" '
        f'data-by-hand="{" ".join(view.by_hand)}" '
        f'data-pose-of="{escape(view.pose_of)}" '
        f'data-priors="{escape(json.dumps(dict(view.priors)))}" '
        f'data-files="{" ".join(files)}">'
        + _element("p", view.node or "no node", "node")
        + _section("headline", "", headline)
        + _section("answer", "", _lines(view.answer))
        + _section("topics", "topics with poses", _listed(view.topics))
        + _section("axes", axes_title, bars)
        + _section(
            "axes",
            "the mount, and what ten minutes of motion detect",
            _lines(view.watched),
        )
        + '<div class="side">'
        + _section("pose", view.title, _wrapped("dl", pose))
        + _section("health", "result and inputs", health)
        + "</div></div>"
    )


def _section(name: str, title: str, content: str) -> str:
    """Return a section with a title; empty without content."""
    head = _element("h2", title) if title else ""
    return (
        f'<section class="{name}">{head}{content}</section>' if content else ""
    )


def _element(tag: str, text: str, name: str = "") -> str:
    """Return an element with a text and, unless ``name`` is empty, a class."""
    attribute = f' class="{name}"' if name else ""
    return f"<{tag}{attribute}>{escape(text)}</{tag}>"


def _wrapped(tag: str, parts: Iterable[str]) -> str:
    """Return an element with other elements; empty without them."""
    content = "".join(parts)
    return f"<{tag}>{content}</{tag}>" if content else ""


def _listed(texts: Iterable[str]) -> str:
    return _wrapped("ul", [_element("li", text) for text in texts])


def _lines(lines: Iterable[Line]) -> str:
    return "".join(map(_line, lines))


def _line(line: Line) -> str:
    name = _element("b", line.name)
    text = f"{_sign(line.tone)} {name} {escape(line.text)}"
    return f'<p class="line {line.tone.name.lower()}">{text}</p>'


def _bar(bar: Bar) -> str:
    difference = f"change: {bar.difference}" if bar.difference else ""
    name = escape(bar.name)
    return (
        f'<div class="axis {bar.tone.name.lower()}">'
        f"<span><b>{name}</b> {escape(bar.meaning)}</span>"
        f'<span class="state">{_sign(bar.tone)} {escape(bar.word)}</span>'
        f'<progress max="1" value="{bar.share:.3f}" aria-label="{name}"></progress>'
        f"{_element('span', bar.sigma)}{_element('span', difference)}</div>"
    )


def _sign(tone: Tone) -> str:
    return f'<span class="sign">{tone.value}</span>'
