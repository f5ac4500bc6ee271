"""A browser without a window: Chromium, driven by its DevTools protocol.

Commands, replies and events are JSON texts that end in a zero byte. They pass through two pipes of
the browser's process. https://chromedevtools.github.io/devtools-protocol/
"""

import itertools
import json
import os
import re
import select
import shutil
import subprocess

import pytest

# Nothing is measured with this: it is how long a hang takes to fail a test, on a busy machine.
PATIENCE_S = 120.0

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
OPTIONS = (
    "--headless=new",
    "--remote-debugging-pipe",
    "--no-sandbox",  # as root, in a container
    "--disable-dev-shm-usage",
    "--disable-gpu",
    "--disable-background-networking",
    "--no-first-run",
)

# Resolves when a condition is true: looks again whenever the page changes.
WHEN = """new Promise((resolve) => {
  const look = () => { if (CONDITION) { observer.disconnect(); resolve(true); } };
  const observer = new MutationObserver(look);
  const changes = {attributes: true, characterData: true, childList: true, subtree: true};
  observer.observe(document, changes);
  look();
})"""


class Browser:
    """A process of Chromium with one page.

    Parameters
    ----------
    folder : Path
        Where the browser stores its profile.
    """

    def __init__(self, folder):
        programs = filter(None, map(shutil.which, PROGRAMS))
        program = next(programs, None)
        if program is None:
            pytest.skip("Chromium is not installed: apt-get install chromium")
        commands, self._commands = os.pipe()
        self._events, events = os.pipe()
        # The browser reads commands from descriptor 3 and writes to descriptor 4.
        redirected = f'exec "$@" 3<&{commands} 4>&{events}'
        self._process = subprocess.Popen(
            [
                "bash",
                "-c",
                redirected,
                "bash",
                program,
                *OPTIONS,
                f"--user-data-dir={folder}",
            ],
            pass_fds=(commands, events),
            stderr=subprocess.DEVNULL,
        )
        os.close(commands)
        os.close(events)
        self._numbers = itertools.count(1)
        self._unread = b""
        self._waiting = []
        self.session = None

    def close(self):
        """End the process."""
        self.session = None
        self.call("Browser.close")
        self._process.wait(PATIENCE_S)
        os.close(self._commands)
        os.close(self._events)

    def call(self, method, **parameters):
        """Return the result of a command."""
        number = self._send(method, parameters)
        return self._reply(number)

    def evaluate(self, expression):
        """Return the value of a JavaScript expression; a promise is awaited."""
        result = self.call(
            "Runtime.evaluate",
            expression=expression,
            awaitPromise=True,
            returnByValue=True,
        )
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait_for(self, condition):
        """Wait until a condition in JavaScript is true; it may change with the page only."""
        script = WHEN.replace("CONDITION", condition)
        self.evaluate(script)

    def open(self, address, script=""):
        """Open a page in a new tab, to which all later commands go.

        The script runs before the scripts of the page.
        """
        self.session = None
        self._waiting.clear()
        tab = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call(
            "Target.attachToTarget", targetId=tab, flatten=True
        )["sessionId"]
        self.call("Page.enable")
        self.call("Page.addScriptToEvaluateOnNewDocument", source=script)
        self.call("Page.navigate", url=address)
        self._wait_for_event("Page.loadEventFired")

    def click(self, selector, answers=()):
        """Click an element with the mouse, and answer the dialogs that open.

        Parameters
        ----------
        selector : str
            CSS selector.
        answers : sequence of bool
            Whether to accept each dialog.

        Returns
        -------
        list of str
            Messages of the dialogs.
        """
        x, y = self.evaluate(
            f"(() => {{ const box = document.querySelector({json.dumps(selector)});"
            "box.scrollIntoView({block: 'center'}); const place = box.getBoundingClientRect();"
            "return [place.x + place.width / 2, place.y + place.height / 2]; })()"
        )
        mouse = {"x": x, "y": y, "button": "left", "clickCount": 1}
        self.call("Input.dispatchMouseEvent", type="mousePressed", **mouse)
        released = self._send(
            "Input.dispatchMouseEvent", {"type": "mouseReleased", **mouse}
        )
        messages = []
        for answer in answers:
            dialog = self._wait_for_event("Page.javascriptDialogOpening")
            messages.append(dialog["message"])
            self.call("Page.handleJavaScriptDialog", accept=answer)
        self._reply(released)
        return messages

    def fill(self, selector, text):
        """Type a text into a field."""
        quoted = json.dumps(selector)
        self.evaluate(f"document.querySelector({quoted}).select()")
        self.call("Input.insertText", text=text)

    def _send(self, method, parameters):
        number = next(self._numbers)
        command = {"id": number, "method": method, "params": parameters}
        if self.session is not None:
            command["sessionId"] = self.session
        os.write(self._commands, json.dumps(command).encode() + b"\0")
        return number

    def _reply(self, number):
        message = self._wait(lambda message: message.get("id") == number)
        assert "error" not in message, message
        return message["result"]

    def _wait_for_event(self, method):
        event = self._wait(lambda message: message.get("method") == method)
        return event["params"]

    def _wait(self, is_wanted):
        """Return the first message that is wanted; the other messages wait."""
        for message in self._waiting:
            if is_wanted(message):
                self._waiting.remove(message)
                return message
        while not is_wanted(message := self._read()):
            self._waiting.append(message)
        return message

    def _read(self):
        while b"\0" not in self._unread:
            readable, _, _ = select.select([self._events], [], [], PATIENCE_S)
            assert readable, f"Chromium is silent; it sent {self._waiting}"
            data = os.read(self._events, 1 << 16)
            assert data, f"Chromium has ended with code {self._process.poll()}"
            self._unread += data
        message, _, self._unread = self._unread.partition(b"\0")
        return json.loads(message)


def printed_pages(page, folder):
    """Number of pages on which the browser prints a page; the test is skipped without a browser."""
    programs = filter(None, map(shutil.which, PROGRAMS))
    program = next(programs, None)
    if program is None:
        pytest.skip("Chromium is not installed: apt-get install chromium")
    pdf = folder / "printed.pdf"
    arguments = [
        program,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--no-pdf-header-footer",
        f"--print-to-pdf={pdf}",
        page.as_uri(),
    ]
    subprocess.run(
        arguments, check=True, capture_output=True, timeout=PATIENCE_S
    )
    return len(re.findall(rb"/Type /Page\b", pdf.read_bytes()))
