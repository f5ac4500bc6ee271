"""Make pictures of the page of ``watch`` from a recorded session.

    python benchmarks/node_sessions.py "straight, curves, ramps" --out SESSIONS
    python benchmarks/watch_picture.py SESSIONS/session_8/pages.jsonl docs/images/watch.webp

Every headline is displayed for two seconds, by the real page in Chromium, at the size of a phone.
With ``--headline TEXT``, the picture is the last page whose headline begins so.
"""

import argparse
import base64
import http.server
import io
import itertools
import json
import sys
import tempfile
import threading
import time
from pathlib import Path

from PIL import Image

PROJECT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(PROJECT), str(PROJECT / "test")]

from browser import Browser  # noqa: E402
from node_sessions import Page  # noqa: E402

from hand_eye_calib.online.watch import web  # noqa: E402

PAGE_FILES = Path(web.__file__).parent / "page"
MEDIA_TYPES = {
    ".css": "text/css",
    ".js": "text/javascript",
    ".html": "text/html",
}

# Height of the picture (pixels), and time for which a page is displayed (ms).
HEIGHT = 800
FRAME_MS = 2000
# Colours of a single picture.
N_COLOURS = 128

# Number of letters by which sentences are recognised as the same.
SAME_START = 25

# Headlines of the start and the end, which are not part of the picture.
LEFT_OUT = ("NO NODE", "CHECK INPUT", "ENDED")


class Player(http.server.BaseHTTPRequestHandler):
    """Serve the page, and send ``server.html`` whenever it changes."""

    protocol_version = "HTTP/1.1"

    def do_GET(self):
        name = self.path.partition("?")[0].strip("/") or "page.html"
        self.close_connection = True
        self.send_response(200)
        if name == "events":
            self.send_header("Content-Type", "text/event-stream")
            self.end_headers()
            self._send_events()
            return
        file = PAGE_FILES / name
        self.send_header("Content-Type", MEDIA_TYPES[file.suffix])
        self.end_headers()
        self.wfile.write(file.read_bytes())

    def _send_events(self):
        sent = None
        while self.server.html is not None:
            if self.server.html != sent:
                sent = self.server.html
                self.wfile.write(f"data: {sent}\n\n".encode())
                self.wfile.flush()
            time.sleep(0.05)

    def log_message(self, format, *args):
        """Log nothing."""


def chosen_pages(file):
    """Return the last page of each series of pages whose headlines differ only at their ends."""
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    pages = [Page(html) for _, html in rows]
    pages = [page for page in pages if page.word not in LEFT_OUT]
    groups = itertools.groupby(pages, lambda page: page.headline[:SAME_START])
    return [list(group)[-1] for _, group in groups]


def photographs(pages, width):
    """Yield a picture of each page."""
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Player)
    server.html = ""
    # The browser may close a connection at any time, which is no error.
    server.handle_error = lambda *_: None
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with tempfile.TemporaryDirectory() as folder:
        browser = Browser(folder)
        browser.open(f"http://127.0.0.1:{server.server_port}/?key=picture")
        size = {
            "width": width,
            "height": HEIGHT,
            "deviceScaleFactor": 1,
            "mobile": True,
        }
        browser.call("Emulation.setDeviceMetricsOverride", **size)
        for page in pages:
            server.html = page.html
            _, _, sentence = page.headline.partition(": ")
            start = json.dumps(sentence[:40])
            browser.wait_for(f"document.body.innerText.includes({start})")
            data = browser.call("Page.captureScreenshot", format="png")["data"]
            yield Image.open(io.BytesIO(base64.b64decode(data)))
        server.html = None
        browser.close()
    server.shutdown()


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("pages", type=Path, help="pages.jsonl of a session")
    parser.add_argument("target", type=Path, help="picture to write")
    parser.add_argument(
        "--headline", default="", help="beginning of the only headline"
    )
    parser.add_argument(
        "--width", type=int, default=390, help="pixels. Default: a phone"
    )
    arguments = parser.parse_args()
    pages = chosen_pages(arguments.pages)
    if arguments.headline:
        pages = [
            page
            for page in pages
            if page.headline.startswith(arguments.headline)
        ][-1:]
    if not pages:
        parser.error(f"no headline begins with {arguments.headline!r}")
    first, *others = photographs(pages, arguments.width)
    if others:
        moving = {
            "save_all": True,
            "append_images": others,
            "duration": FRAME_MS,
            "loop": 0,
        }
        first.save(arguments.target, quality=60, **moving)
    else:
        first.quantize(N_COLOURS).save(arguments.target, optimize=True)
    size_kb = arguments.target.stat().st_size / 1000
    print(f"{arguments.target}: {1 + len(others)} pages, {size_kb:.0f} kB")


if __name__ == "__main__":
    main()
