"""The page of ``watch`` in a browser: what it displays, and what its buttons request."""

import json
import queue
import re
import threading
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from browser import PATIENCE_S, Browser

from hand_eye_calib.online.watch import view, web
from hand_eye_calib.online.watch.view import Line, Tone, View
from hand_eye_calib.online.watch.web import WebServer

FOLDER = Path(web.__file__).parent / "page"
SCRIPT = (FOLDER / "page.js").read_text(encoding="utf-8")
PAGE = (FOLDER / "page.html").read_text(encoding="utf-8")

GO_ON = View(
    node="/calibrator",
    tone=Tone.BUSY,
    word="GO ON",
    sentence="z is behind.",
    buttons=("solve", "save", "reset"),
)
MOVED = View(
    node="/calibrator", tone=Tone.BAD, word="MOUNT MOVED", sentence="by 2 cm."
)

# Counts vibrations of the phone, and requests that the screen stays on, in attributes of the page.
COUNTERS = """
const counts = {vibrations: 0, locks: 0};
const count = (name) => {
  counts[name] += 1;
  document.documentElement.dataset[name] = counts[name];
};
Navigator.prototype.vibrate = () => { count("vibrations"); return true; };
const request = WakeLock.prototype.request;
WakeLock.prototype.request = function (kind) { count("locks"); return request.call(this, kind); };
"""


class Shown:
    """A board whose view the test sets, and which can stop to answer."""

    def __init__(self):
        self.current = GO_ON
        self.answers = threading.Event()
        self.answers.set()

    def view(self, now_s):
        self.answers.wait(PATIENCE_S)
        return self.current


class Page:
    """The page of a server in a browser."""

    def __init__(self, browser, server):
        self.browser = browser
        self.server = server
        browser.open(
            f"http://127.0.0.1:{server.server_port}/?key=word", COUNTERS
        )
        self.wait_for_word(server.board.current.word)

    def show(self, shown):
        """Set the view of the server, and wait until the page displays it."""
        self.server.board.current = shown
        self.wait_for_word(shown.word)

    def wait_for_word(self, word):
        self.browser.wait_for(f"document.title.endsWith({json.dumps(word)})")

    def wait_for_connection(self, text):
        """Wait until the line about the connection begins with a text, and return the line."""
        line = "document.getElementById('connection').textContent"
        self.browser.wait_for(f"{line}.startsWith({json.dumps(text)})")
        return self.browser.evaluate(line)

    def get(self, selector, field):
        """Return a field of an element."""
        return self.browser.evaluate(
            f"document.querySelector({json.dumps(selector)}).{field}"
        )

    def wait_for_count(self, name, number):
        self.browser.wait_for(
            f"document.documentElement.dataset.{name} === '{number}'"
        )

    def visible_buttons(self):
        return self.browser.evaluate(
            "[...document.querySelectorAll('button[data-request]')]"
            ".filter((button) => button.checkVisibility()).map((button) => button.dataset.request)"
        )

    def request(self):
        """Return the next request that the server has received."""
        return self.server.requests.get(timeout=PATIENCE_S)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    started = Browser(tmp_path_factory.mktemp("profile"))
    yield started
    started.close()


def started_server(port=0, key="word"):
    requests = queue.SimpleQueue()
    server = WebServer(Shown(), requests.put, "127.0.0.1", [port])
    server.key = key
    server.requests = requests
    return server


@pytest.fixture
def server(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    started = started_server()
    yield started
    started.board.answers.set()
    started.stop()


@pytest.fixture
def page(browser, server):
    return Page(browser, server)


class Elements(HTMLParser):
    """Ids, tags and data attributes of a piece of HTML."""

    def __init__(self, text):
        super().__init__()
        self.ids = set()
        self.tags = []
        self.data = {}
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.add(value)
            if name.startswith("data-"):
                self.data.setdefault(name, []).append(value)


def test_the_script_finds_what_it_looks_for():
    page = Elements(PAGE)
    assert (
        set(re.findall(r'part\("([\w-]+)"\)', SCRIPT)) - {"state"} <= page.ids
    )
    assert set(
        re.findall(r'document\.querySelector(?:All)?\("(\w+)"\)', SCRIPT)
    ) <= set(page.tags)
    assert page.data["data-file"] == list(web.SAVED)
    assert sorted(set(page.data["data-request"])) == sorted(view.KEYS)
    assert set(re.findall(r"button\.dataset\.(\w+)", SCRIPT)) == {
        "request",
        "sure",
    }
    assert len(page.data["data-sure"]) == 4


def test_the_word_is_large_on_a_phone_and_larger_on_a_wide_screen(page):
    def height_px(width):
        screen = {
            "width": width,
            "height": 800,
            "deviceScaleFactor": 1,
            "mobile": width < 600,
        }
        page.browser.call("Emulation.setDeviceMetricsOverride", **screen)
        return float(
            page.browser.evaluate(
                "getComputedStyle(document.querySelector('h1')).fontSize"
            )[:-2]
        )

    assert height_px(390) >= 27
    assert height_px(1280) >= 64


# ------------------------------------------------------------------------ what it displays


def test_the_title_is_the_word_of_the_newest_view(page):
    assert page.browser.evaluate("document.title") == f"{Tone.BUSY.value} GO ON"
    assert page.get("#announcement", "textContent").startswith(
        f"{Tone.BUSY.value} GO ON"
    )
    page.show(MOVED)
    assert (
        page.browser.evaluate("document.title")
        == f"{Tone.BAD.value} MOUNT MOVED"
    )
    assert page.wait_for_connection("✓") == "✓ connected"


def test_a_phone_shakes_at_each_new_word_once_it_was_touched(page):
    page.show(MOVED)
    assert page.get("html", "dataset.vibrations") is None
    page.browser.click("#sound")
    page.show(GO_ON)
    page.wait_for_count("vibrations", 1)
    page.show(MOVED)
    page.wait_for_count("vibrations", 2)
    assert page.get("#sound", "textContent") == "Sound: on"


def test_a_phone_shakes_at_a_new_sentence_but_not_at_new_numbers(page):
    page.browser.click("#sound")
    page.show(replace(GO_ON, sentence="Go on for about 90 s: z takes longest."))
    page.wait_for_count("vibrations", 1)
    page.show(
        replace(GO_ON, sentence="Go on for about 2 min: z takes longest.")
    )
    page.show(
        replace(
            GO_ON, sentence="Confirming, 30 s: every axis is within its target."
        )
    )
    page.wait_for_count("vibrations", 2)


def test_the_screen_stays_on_while_the_page_is_visible(page):
    page.wait_for_count("locks", 1)
    session_of_page = page.browser.session
    page.browser.open("about:blank")
    page.browser.session = session_of_page
    assert page.browser.evaluate("document.visibilityState") == "hidden"
    page.browser.call("Page.bringToFront")
    page.wait_for_count("locks", 2)


def test_a_silent_connection_is_stated_and_opened_again(page):
    page.server.board.answers.clear()
    lost = page.wait_for_connection("✗")
    assert re.fullmatch(
        r"✗ CONNECTION LOST at \d\d:\d\d(\W[AP]M)?, trying again \.\.\.", lost
    )
    assert page.get("#connection", "className") == "lost"
    assert page.get("button[data-request=solve]", "disabled")
    page.server.board.answers.set()
    assert page.wait_for_connection("✓") == "✓ connected"
    assert page.get("#connection", "className") == ""
    assert not page.get("button[data-request=solve]", "disabled")


def test_a_server_with_another_key_is_an_old_address(page):
    page.server.stop()
    page.wait_for_connection("✗ CONNECTION LOST")
    other = started_server(page.server.server_port, "other")
    try:
        old = page.wait_for_connection("✗ OLD")
    finally:
        other.stop()
    assert old == "✗ OLD ADDRESS: open the address that watch shows now"


# ------------------------------------------------------------------------ buttons


def test_buttons_send_their_requests(page):
    page.browser.click("button[data-request=solve]")
    assert page.request() == "solve"
    page.browser.click("button[data-request=save]")
    assert page.request() == "save"


def test_a_reset_is_confirmed_first(page):
    assert page.browser.click("button[data-request=reset]", [False]) == [
        "Forget all poses?"
    ]
    assert page.browser.click("button[data-request=reset]", [True]) == [
        "Forget all poses?"
    ]
    assert page.request() == "reset"
    assert page.server.requests.empty()


def test_a_request_that_is_refused_is_a_lost_connection(page):
    page.server.key = "other"
    page.browser.click("button[data-request=save]")
    page.wait_for_connection("✗")


def test_the_recommended_button_stands_out_and_the_others_are_hidden(page):
    def main_buttons():
        return page.browser.evaluate(
            "[...document.querySelectorAll('button.main')].map((button) => button.dataset.request)"
        )

    assert page.visible_buttons() == ["reset", "save", "solve"]
    assert main_buttons() == []
    page.show(
        replace(GO_ON, word="SAVE", buttons=("save", "solve"), asked="save")
    )
    assert page.visible_buttons() == ["save", "solve"]
    assert main_buttons() == ["save"]
    page.show(MOVED)
    assert page.visible_buttons() == []


def test_a_reset_that_is_asked_for_is_in_the_fixed_bar(page):
    footer = "footer button[data-request=reset]"
    assert page.get(footer, "hidden")
    page.show(replace(GO_ON, word="RESET", asked="reset"))
    assert not page.get(footer, "hidden")
    assert page.get(".apart button[data-request=reset]", "hidden")
    position = "getComputedStyle(document.querySelector('footer')).position"
    assert page.browser.evaluate(position) == "fixed"
    page.browser.click(footer, [True])
    assert page.request() == "reset"


def test_saved_files_are_linked(page, tmp_path):
    assert page.get("a[data-file='report.html']", "hidden")
    (tmp_path / "report.html").write_text("<p>report")
    page.show(replace(GO_ON, word="DONE", saved_in=str(tmp_path)))
    assert page.get("a[data-file='report.html']", "href").endswith(
        "/report.html?key=word"
    )
    assert not page.get("a[data-file='report.html']", "hidden")
    assert page.get("a[data-file='extrinsic.yaml']", "hidden")


def test_evidence_of_the_result_is_readable_at_the_end(page):
    fact = (
        "Errors larger than 2 cm along x would have been noticed: <b> & 0.5 deg"
    )
    page.show(
        replace(GO_ON, word="DONE", result=(Line(Tone.GOOD, "evidence", fact),))
    )
    assert fact in page.get(".health", "innerText")
    assert page.get(".health", "checkVisibility()")
    assert page.get(".health", "scrollWidth") <= page.get(
        ".health", "clientWidth"
    )


# ------------------------------------------------------------------------ priors


WITH_PRIOR = replace(
    GO_ON,
    word="CHECK THE VALUE",
    by_hand=("z", "yaw"),
    priors=(("z", "1.5m+/-0.02m"),),
)


def choose(page, axis):
    page.browser.evaluate(
        f"axisByHand.value = {json.dumps(axis)}; axisByHand.dispatchEvent(new Event('change'))"
    )


def test_an_axis_measured_by_hand_is_sent(page):
    assert page.get("#by-hand", "hidden")
    page.show(replace(GO_ON, word="MEASURE", by_hand=("z",)))
    assert not page.get("#by-hand", "hidden")
    page.browser.fill("input[name=value]", "1.85")
    page.browser.fill("input[name=sigma]", "0.02")
    page.browser.click("#by-hand button")
    assert page.request() == "prior.z:=1.85m+/-0.02m"


def test_the_form_names_the_pose_and_replaces_the_option(page):
    reason = "measure it by hand and give a prior, such as prior.z 0.50+/-0.02"
    shown = replace(GO_ON, word="MEASURE", reasons=(reason, "c: d"))
    pose = replace(shown, pose_of="of camera in lidar", values=(("z", "?"),))
    page.show(replace(pose, by_hand=("z",)))
    assert page.get("#pose-of", "textContent") == "of camera in lidar"
    text = page.get(".health", "innerText")
    assert "measure it by hand and type it above\nc: d" in text
    # Without the form, the driver can only change the motion.
    page.show(replace(shown, word="GO ON"))
    assert page.get("#pose-of", "textContent") == ""
    text = page.get(".health", "innerText")
    assert "measure it by hand or change the motion\nc: d" in text


def test_the_unit_and_the_button_to_remove_follow_the_axis(page):
    page.show(WITH_PRIOR)
    options = "[...axisByHand.options].map((option) => option.value)"
    assert page.browser.evaluate(options) == ["z", "yaw"]
    assert (
        page.get("#unit", "textContent"),
        page.get("#forget", "hidden"),
    ) == (
        "m",
        False,
    )
    choose(page, "yaw")
    assert (
        page.get("#unit", "textContent"),
        page.get("#forget", "hidden"),
    ) == (
        "deg",
        True,
    )


def test_a_chosen_axis_stays_when_the_axes_change(page):
    page.show(WITH_PRIOR)
    choose(page, "yaw")
    page.show(replace(WITH_PRIOR, word="GO ON", by_hand=("yaw", "z", "x")))
    assert page.get("#by-hand-axis", "value") == "yaw"


def test_a_prior_is_removed(page):
    page.show(WITH_PRIOR)
    page.browser.click("#forget")
    assert page.request() == "prior.z:="


def test_a_reset_offers_to_remove_the_priors_too(page):
    page.show(replace(WITH_PRIOR, buttons=("solve", "forget", "reset")))
    messages = page.browser.click("button[data-request=reset]", [True, True])
    assert messages == [
        "Forget all poses?",
        "Remove what was typed in, too? It is z = 1.5m+/-0.02m.",
    ]
    assert {page.request(), page.request()} == {"forget", "reset"}
