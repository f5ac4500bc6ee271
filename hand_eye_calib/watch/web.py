"""The view in a browser: a small server of one page, which needs nothing from the internet.

Events go to the page (server-sent events), presses of buttons come back. Every request must carry
the key that is part of the address: a page of somebody else in the same browser does not know it.
"""

import hmac
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, urlsplit

from hand_eye_calib.errors import ConfigError
from hand_eye_calib.watch.board import Board
from hand_eye_calib.watch.html import fragment

PORT = 8765
REQUESTS = ("solve", "save", "reset")

# The view is looked at so often, and something is sent at least so often (s).
_LOOK_S, _SEND_S = 0.25, 1.0

# A browser that takes nothing for so long is gone (s), and most that are served at a time.
_PATIENCE_S = 10.0
_MOST_CLIENTS = 32

_FILES = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
}
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; connect-src 'self'; img-src data:; "
    "script-src 'self'; style-src 'self'; frame-ancestors 'none'; base-uri 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class WebServer(ThreadingHTTPServer):
    """Serves the view until :meth:`stop`, in threads of its own.

    Parameters
    ----------
    board : Board
    ask : callable
        Called with one of :data:`REQUESTS`, in another thread.
    address : (str, int)
        Host and port to listen on; an empty host stands for all addresses of the computer, port 0
        for any that is free.
    key : str
        Empty for a new one.

    Raises
    ------
    ConfigError
        If it cannot listen there.
    """

    daemon_threads = True
    block_on_close = False

    def __init__(
        self,
        board: Board,
        ask: Callable[[str], None],
        address: tuple[str, int] = ("", PORT),
        key: str = "",
    ) -> None:
        self.key = key or secrets.token_urlsafe(6)
        self.board, self.ask = board, ask
        self.stopping = threading.Event()
        self.clients = threading.BoundedSemaphore(_MOST_CLIENTS)
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

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self.server_address[1])

    def addresses(self) -> list[str]:
        """What to type into a browser, that for other computers first."""
        hosts = [self._host] if self._host else [own_address(), "localhost"]
        hosts = [f"[{host}]" if ":" in host else host for host in hosts if host]
        return [f"http://{host}:{self.port}/?key={self.key}" for host in hosts]

    def stop(self) -> None:
        """Close all connections."""
        self.stopping.set()
        self.shutdown()
        self.server_close()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of browsers that have gone."""


def own_address() -> str:
    """Address of this computer on its network; empty if it has none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing; only asks which way it would go
        except OSError:
            return ""
        return str(probe.getsockname()[0])


class _Handler(BaseHTTPRequestHandler):
    server: WebServer
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "hand_eye_calib", ""
    timeout = _PATIENCE_S

    def do_GET(self) -> None:
        path, query = self._parts()
        if path in ("/page.css", "/page.js"):  # no secrets, and asked for without the key
            self._send_file(path)
        elif not self._has_key(query):
            self._refuse()
        elif path == "/events":
            self._send_events()
        elif path in _FILES:
            self._send_file(path)
        else:
            self._send(HTTPStatus.NOT_FOUND, b"there is no such page", "text/plain")

    def do_POST(self) -> None:
        self.close_connection = True  # a body, if there is one, is not read
        path, query = self._parts()
        request = path.removeprefix("/")
        if not self._has_key(query):
            self._refuse()
        elif request in REQUESTS:
            self.server.ask(request)
            self._send(HTTPStatus.OK, b"", "text/plain")
        else:
            self._send(HTTPStatus.NOT_FOUND, b"there is no such request", "text/plain")

    def log_message(self, format: str, *args: Any) -> None:
        """Keep the terminal to the view."""

    def _parts(self) -> tuple[str, dict[str, str]]:
        url = urlsplit(self.path)
        return url.path, {name: values[-1] for name, values in parse_qs(url.query).items()}

    def _has_key(self, query: dict[str, str]) -> bool:
        given = query.get("key", "").encode(errors="replace")
        return hmac.compare_digest(given, self.server.key.encode())

    def _refuse(self) -> None:
        text = b"Open the whole address that the terminal with `hand_eye_calib watch` shows."
        self._send(HTTPStatus.FORBIDDEN, text, "text/plain")

    def _send_file(self, path: str) -> None:
        name, kind = _FILES[path]
        content = files("hand_eye_calib.watch").joinpath("page", name).read_bytes()
        self._send(HTTPStatus.OK, content, kind)

    def _send(self, status: HTTPStatus, content: bytes, kind: str) -> None:
        self._begin(status, kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def _begin(self, status: HTTPStatus, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        for name, value in _HEADERS.items():
            self.send_header(name, value)

    def _send_events(self) -> None:
        if not self.server.clients.acquire(blocking=False):
            self._send(HTTPStatus.SERVICE_UNAVAILABLE, b"too many browsers", "text/plain")
            return
        self.close_connection = True
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux: a phone out of reach is noticed soon
            patience_ms = round(1000 * _PATIENCE_S)
            self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, patience_ms)
        try:
            self._begin(HTTPStatus.OK, "text/event-stream; charset=utf-8")
            self.end_headers()
            for event in self._events():
                self.wfile.write(event)
        except OSError:
            return  # the browser has gone
        finally:
            self.server.clients.release()

    def _events(self) -> Iterator[bytes]:
        """The view whenever it has changed; an empty event every second in between."""
        sent, sent_s = "", -_SEND_S
        while not self.server.stopping.wait(_LOOK_S if sent else 0.0):
            now_s = time.monotonic()
            made = fragment(self.server.board.view(now_s))
            if made != sent:
                one_line = made.replace("\r", " ").replace("\n", " ")
                yield f"data: {one_line}\n\n".encode()
                sent, sent_s = made, now_s
            elif now_s - sent_s >= _SEND_S:
                yield b"data:\n\n"
                sent_s = now_s
