"""The view in a browser: a small server of one page, which needs nothing from the internet, and the
piece of HTML that the page puts in place.

Events go to the page (server-sent events), presses of buttons come back. Every request must carry
the key that is part of the address: a page of somebody else in the same browser does not know it.
"""

import contextlib
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
from hand_eye_calib.core.base.text import AXIS_UNITS, capital, prior_as_typed
from hand_eye_calib.online.live.state import REPORT_PERIOD_S
from hand_eye_calib.online.watch.board import Bar, Board, Line, Tone, View

# Requests of the page, beside those about an axis measured by hand.
BUTTONS = ("solve", "save", "reset", "recalibrate", "acknowledge", "forget")

# The view is looked at so often (s).
_LOOK_S = 0.25

# A browser that takes nothing for so long is gone (s).
_PATIENCE_S = 10.0

_PAGE = ("page.html", "page.css", "page.js")
_FOLDER = files("hand_eye_calib.online.watch").joinpath("page")
# A vehicle from its left side, on which y points to whoever looks at it.
_SKETCH = _FOLDER.joinpath("sketch.svg").read_text(encoding="utf-8")
_KINDS = {"css": "text/css", "js": "text/javascript", "html": "text/html", "yaml": "text/plain"}
# Files of a saved result that the page links to.
SAVED = ("report.html", "extrinsic.yaml")
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
_POLICY = (
    "default-src 'none'; connect-src 'self'; img-src data:; script-src 'self'; style-src 'self'; "
    "frame-ancestors 'none'; base-uri 'none'"
)
_POLICY_OF_SAVED = "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'"


def _kept_key() -> str:
    """The user's key, the same at every start, so that a page that was left open comes back; one
    for this time if no file that is only this user's can keep it.
    """
    made = secrets.token_urlsafe(6)
    with contextlib.suppress(OSError, RuntimeError, ValueError):
        state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
        file = Path(state, "hand_eye_calib", "watch_key")
        file.parent.mkdir(parents=True, exist_ok=True)
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW
        with open(os.open(file, flags, 0o600), "r+") as kept:
            about = os.fstat(kept.fileno())
            text = kept.read()
            is_own = about.st_uid == os.getuid() and not about.st_mode & 0o077
            if is_own and re.fullmatch(r"[\w-]{8,}", text, re.ASCII):
                return text
            kept.write(made if is_own and not text else "")
    return made


class WebServer(ThreadingHTTPServer):
    """Serves the view until :meth:`stop`, in threads of its own, under the key of this user.

    Parameters
    ----------
    board : Board
    ask : callable
        Called in another thread with one of BUTTONS, or with a parameter and its value as in
        ``prior.z:=1.85m+/-0.02m``, or ``prior.z:=`` to remove it.
    address : (str, int)
        Host and port; an empty host stands for all addresses of the computer, port 0 for any that
        is free.

    Raises
    ------
    ConfigError
        If it cannot listen there.
    """

    daemon_threads = True
    block_on_close = False

    def __init__(self, board: Board, ask: Callable[[str], None], address: tuple[str, int]) -> None:
        self.key = _kept_key()
        self.board = board
        self.ask = ask
        self.stopping = threading.Event()
        self._host, port = address
        try:
            super().__init__(address, _Handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise ConfigError(
                f"cannot serve the page on {self._host}:{port}: {reason}; choose another with "
                "--web PORT"
            ) from None
        threading.Thread(target=self.serve_forever, name="web", daemon=True).start()

    def addresses(self) -> list[str]:
        """What to type into a browser, that for other computers first."""
        hosts = [self._host or "localhost"]
        probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with probe, contextlib.suppress(OSError):  # of a computer without a network
            probe.connect(("192.0.2.1", 9))  # sends nothing; asks which way it would go
            hosts[:0] = [] if self._host else [str(probe.getsockname()[0])]
        return [f"http://{host}:{self.server_port}/?key={self.key}" for host in hosts]

    def stop(self) -> None:
        """Close all connections."""
        self.stopping.set()
        self.shutdown()
        self.server_close()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of browsers that have gone."""


class _Handler(BaseHTTPRequestHandler):
    server: WebServer
    protocol_version = "HTTP/1.1"
    server_version = "hand_eye_calib"
    sys_version = ""
    timeout = _PATIENCE_S

    def do_GET(self) -> None:
        name = self._path() or "page.html"
        if name in _PAGE and (name != "page.html" or self._has_key()):  # the others have no secrets
            content = _FOLDER.joinpath(name).read_bytes()
            self._send(HTTPStatus.OK, content, name)
        elif not self._has_key():
            text = "Open the whole address that the terminal with `hand_eye_calib watch` shows."
            self._send(HTTPStatus.FORBIDDEN, text)
        elif name == "events":
            self._send_events()
        elif name in SAVED and (saved := self._saved(name)):
            self._send(HTTPStatus.OK, saved, name, _POLICY_OF_SAVED)
        else:
            self._send(HTTPStatus.NOT_FOUND, "there is no such page")

    def _saved(self, name: str) -> bytes:
        """A file of the saved result, if it is on this computer; links are not followed."""
        directory = self.server.board.view(time.monotonic()).saved_in
        file = Path(directory, name)
        return file.read_bytes() if directory and file.is_file() and not file.is_symlink() else b""

    def do_POST(self) -> None:
        self.close_connection = True  # a body, if there is one, is not read
        request = self._path()
        axis = self._given("axis")
        status = HTTPStatus.OK
        text = ""
        if not self._has_key():
            status = HTTPStatus.FORBIDDEN
            text = "the key is missing"
        elif request == "forget" and axis in AXIS_UNITS:
            self.server.ask(f"prior.{axis}:=")
        elif request in BUTTONS:
            self.server.ask(request)
        elif request == "prior" and axis in AXIS_UNITS:  # the node refuses what is no number
            prior = prior_as_typed(axis, self._given("value"), self._given("sigma"))
            self.server.ask(printable(f"prior.{axis}:={prior}"))
        else:
            status = HTTPStatus.NOT_FOUND
            text = "there is no such request"
        self._send(status, text)

    def log_message(self, format: str, *args: Any) -> None:
        """Keep the terminal to the view."""

    def _path(self) -> str:
        return urlsplit(self.path).path[1:]

    def _given(self, name: str) -> str:
        return parse_qs(urlsplit(self.path).query).get(name, [""])[-1]

    def _has_key(self) -> bool:
        given = self._given("key").encode(errors="replace")
        return hmac.compare_digest(given, self.server.key.encode())

    def _send(
        self, status: HTTPStatus, content: str | bytes, name: str = "", policy: str = _POLICY
    ) -> None:
        made = content.encode() if isinstance(content, str) else content
        self._begin(status, _KINDS.get(name.rpartition(".")[2], "text/plain"), policy)
        self.send_header("Content-Length", str(len(made)))
        self.end_headers()
        self.wfile.write(made)

    def _begin(self, status: HTTPStatus, kind: str, policy: str = _POLICY) -> None:
        self.send_response(status)
        headers = {"Content-Type": f"{kind}; charset=utf-8", "Content-Security-Policy": policy}
        for name, value in (_HEADERS | headers).items():
            self.send_header(name, value)

    def _send_events(self) -> None:
        self.close_connection = True
        self._begin(HTTPStatus.OK, "text/event-stream")
        self.end_headers()
        with contextlib.suppress(OSError):  # the browser has gone
            for event in self._events():
                self.wfile.write(event)

    def _events(self) -> Iterator[bytes]:
        """The view whenever it has changed; an empty event every second in between."""
        sent = ""
        sent_s = 0.0
        board = self.server.board
        while not self.server.stopping.wait(_LOOK_S if sent else 0.0):
            now_s = time.monotonic()
            view = board.view(now_s)
            there = [name for name in SAVED if os.path.isfile(os.path.join(view.saved_in, name))]
            made = " ".join(fragment(view, there if view.saved_in else ()).splitlines())
            if made != sent or now_s - sent_s >= REPORT_PERIOD_S:
                yield f"data: {made if made != sent else ''}\n\n".encode()
                sent = made
                sent_s = now_s


def fragment(view: View, files: Sequence[str] = ()) -> str:
    """Everything but buttons and links, which stay in the page, so that none vanishes under a
    finger: the attributes of the first element say which of them are shown.

    Parameters
    ----------
    view : View
    files : sequence of str
        Saved files that the page may have.
    """
    axes = "precision against the target"
    axes += ", change from installed" * any(bar.difference for bar in view.bars)
    sketch = [_SKETCH] if any(bar.meaning for bar in view.bars) else []
    values = (f"<dt>{escape(axis)}</dt><dd>{escape(text)}</dd>" for axis, text in view.values)
    reasons = (f"<li>{escape(reason)}</li>" for reason in view.reasons)
    result = [*map(_line, view.result[:1]), *_wrapped("ul", reasons), *map(_line, view.result[1:])]
    topics = (f"<li>{escape(topic)}</li>" for topic in view.topics)
    sections = (
        _section("answer", "", map(_line, view.answer)),
        _section("topics", "topics with poses", _wrapped("ul", topics)),
        _section("axes", axes, [*sketch, *map(_bar, view.bars)]),
        _section("axes", "the mount, after ten minutes of motion", map(_line, view.watched)),
        '<div class="side">',
        _section("pose", view.title, _wrapped("dl", values)),
        _section("health", "result and inputs", [*result, *map(_line, view.health)]),
        "</div>",
    )
    said, _, advice = view.sentence.partition("; ")
    told = (("advice", capital(advice)), ("facts", view.facts))
    priors = escape(json.dumps(dict(view.priors)))
    more = [f'<p class="{name}">{escape(text)}</p>' for name, text in told if text]
    return (
        f'<div id="state" class="{view.tone.name.lower()}" data-buttons="{" ".join(view.buttons)}" '
        f'data-by-hand="{" ".join(view.by_hand)}" data-priors="{priors}" '
        f'data-files="{" ".join(files)}">'
        f'<p class="node">{escape(view.node or "no node")}</p>'
        f'<section class="headline"><h1>{_sign(view.tone)} {escape(view.word)}</h1>'
        f"<p>{escape(said)}</p>{''.join(more)}</section>{''.join(sections)}</div>"
    )


def _section(name: str, title: str, parts: Iterable[str]) -> str:
    """A section with a title; nothing if it is empty."""
    content = "".join(parts)
    head = f"<h2>{escape(title)}</h2>" if title else ""
    return f'<section class="{name}">{head}{content}</section>' if content else ""


def _wrapped(tag: str, parts: Iterable[str]) -> list[str]:
    content = "".join(parts)
    return [f"<{tag}>{content}</{tag}>"] if content else []


def _bar(bar: Bar) -> str:
    difference = f"change: {bar.difference}" if bar.difference else ""
    return (
        f'<div class="axis {bar.tone.name.lower()}">'
        f"<span><b>{escape(bar.name)}</b> {escape(bar.meaning)}</span>"
        f'<span class="state">{_sign(bar.tone)} {escape(bar.word)}</span>'
        f'<progress max="1" value="{bar.share:.3f}" aria-label="{escape(bar.name)}"></progress>'
        f"<span>{escape(bar.against)}</span><span>{escape(difference)}</span></div>"
    )


def _line(line: Line) -> str:
    return (
        f'<p class="line {line.tone.name.lower()}">{_sign(line.tone)} <b>{escape(line.name)}</b> '
        f"{escape(line.text)}</p>"
    )


def _sign(tone: Tone) -> str:
    return f'<span class="sign">{tone.value}</span>'
