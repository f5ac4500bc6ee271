"""The script of the page of ``watch``: it finds what it looks for, and does what it should."""

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest

from hand_eye_calib.online.watch import view, web

FOLDER = Path(web.__file__).parent / "page"
SCRIPT = (FOLDER / "page.js").read_text(encoding="utf-8")
PAGE = (FOLDER / "page.html").read_text(encoding="utf-8")

# A browser as far as the script needs one: it stands still until it is told what happens.
BROWSER = """
let now = 0, tick = null; const log = {posts: [], opened: [], shaken: 0, locks: []};
Date.now = () => now;
const element = (more) => withClasses({
  dataset: {}, hidden: false, disabled: false, textContent: "", heard: {}, classes: new Set(),
  value: "", innerHTML: "",
  setAttribute() {},
  addEventListener(name, run) { this.heard[name] = run; }, ...more});
const withClasses = (one) => { one.classList = {toggle(name, on) {
  on ? one.classes.add(name) : one.classes.delete(name); }}; return one; };
const anchors = [element({dataset: {file: "a"}, hidden: true})];
const nodes = {connection: element(), footer: element(), view: element({
  innerHTML: "",
  querySelector() {
    const textContent = this.innerHTML.match(/<h1>(.*?)<.h1>/)[1].replace(/<[^>]*>/g, "");
    return {textContent, innerText: this.innerHTML};
  }})};
for (const id of ["by-hand", "files", "sound", "asked", "unit", "icon", "said", "forget"])
  nodes[id] = element();
const shown = {buttons: "solve save reset", byHand: "", priors: "{}", files: ""};
nodes.state = {className: "busy", dataset: shown};
const keys = ["solve", "save", "reset"].map((request) => element(
  {dataset: request === "reset" ? {request, sure: "Forget all poses?"} : {request}}));
globalThis.document = {title: "", getElementById: (id) => nodes[id], visibilityState: "visible",
  addEventListener(name, run) { seen = run; }, querySelector: () => nodes.footer,
  querySelectorAll: (what) => what.startsWith("a") ? anchors : keys};
globalThis.FormData = class {
  *[Symbol.iterator]() { yield ["axis", "?"]; yield ["value", "1.85"]; yield ["sigma", "0.02"]; }
};
globalThis.location = {search: "?key=word"};
Object.defineProperty(globalThis, "navigator", {value: {
  vibrate() { log.shaken += 1; },
  wakeLock: {request(kind) { log.locks.push(kind); return Promise.resolve(); }}}});
let seen = null, sure = false, asks = [], answer = {ok: true, text: async () => ""};
globalThis.confirm = (text) => { asks.push(text); return sure; };
globalThis.fetch = (address, {method}) => {
  log.posts.push(`${method} ${address}`); return Promise.resolve(answer); };
globalThis.setInterval = (run) => { tick = run; };
globalThis.EventSource = class {
  static CLOSED = 2;
  constructor(address) { this.readyState = 1; log.opened.push(address); events = this; }
  close() { this.readyState = 2; }
};
let events = null;
const state = () => ({...log, posts: [...log.posts], locks: log.locks.length,
  opened: log.opened.length, last: log.opened.at(-1),
  title: document.title, said: nodes.connection.textContent,
  lost: nodes.connection.classes.has("lost"), footer: nodes.footer.hidden,
  form: nodes["by-hand"].hidden, axes: nodes.asked.innerHTML, chosen: nodes.asked.value,
  unit: nodes.unit.textContent, forget: nodes.forget.hidden, asks: [...asks],
  hidden: keys.map((key) => key.hidden),
  main: keys.map((key) => key.classes.has("main")), link: anchors[0].hidden || anchors[0].href,
  disabled: keys.every((button) => button.disabled)});
"""


class Found(HTMLParser):
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
    page = Found(PAGE)
    assert set(re.findall(r'part\("([\w-]+)"\)', SCRIPT)) - {"state"} <= page.ids
    assert set(re.findall(r'document\.querySelector(?:All)?\("(\w+)"\)', SCRIPT)) <= set(page.tags)
    assert page.data["data-file"] == list(web.SAVED)
    assert sorted(page.data["data-request"]) == sorted(view.KEYS)
    assert set(re.findall(r"button\.dataset\.(\w+)", SCRIPT)) == {"request", "sure"}
    assert len(page.data["data-sure"]) == 3


def test_the_word_is_large_on_a_phone_and_larger_on_a_wide_screen():
    style = (FOLDER / "page.css").read_text(encoding="utf-8")
    (sizes,) = re.findall(r"h1 \{ font-size: clamp\((.+?)rem, (.+?)vw, (.+?)rem\)", style)
    smallest, share, largest = map(float, sizes)
    assert 16 * smallest >= 27
    assert min(12.8 * share, 16 * largest) >= 64  # at 1,280 px


def played(steps):
    """States of the page after each step, given in JavaScript."""
    run = "\n".join(f"{step}\nawait null; await null; states.push(state());" for step in steps)
    text = f"{BROWSER}{SCRIPT.replace('use strict', '')}"
    text += f"(async () => {{ const states = []; {run}\nconsole.log(JSON.stringify(states)); }})();"
    node = shutil.which("node")
    if node is None:
        pytest.skip("the script runs in Node.js, which is not installed")
    done = subprocess.run([node, "-"], input=text, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_the_page_shows_what_comes_and_says_when_nothing_comes():
    go_on = "'<h1><span>▶</span> GO ON</h1><progress></progress>'"
    states = played(
        [
            "",
            f"now = 100; events.onmessage({{data: {go_on}}});",
            "shown.buttons = ''; now = 200; events.onmessage({data: '<h1>MOUNT MOVED</h1>'});",
            "now = 3000; events.onmessage({data: ''}); tick();",
            "now = 7500; tick();",
            "now = 9500; tick();",
            f"now = 9800; events.onmessage({{data: {go_on}}});",
            "events.onerror(); now = 10800; tick();",
            "answer = {status: 403}; events.onerror(); await null; now = 11800; tick();",
            "document.visibilityState = 'hidden'; seen(); document.visibilityState = 'visible';",
            "seen();",
        ]
    )
    opened = [state["opened"] for state in states]
    title = [state["title"] for state in states]
    messages = [state["said"] for state in states]
    assert opened == [1, 1, 1, 1, 2, 2, 2, 3, 4, 4, 4]
    assert states[0]["last"] == "events?key=word"
    assert title[1:4] == ["▶ GO ON", "MOUNT MOVED", "MOUNT MOVED"]
    assert [state["shaken"] for state in states][:9] == [0, 1, 2, 2, 2, 2, 3, 3, 3]
    assert [state["footer"] for state in states][1:3] == [False, True]
    assert [state["locks"] for state in states][8:] == [1, 1, 2]  # while seen, it stays on
    assert [state["disabled"] for state in states][:9] == [k in (4, 5, 7, 8) for k in range(9)]
    assert messages[3] == messages[6] == "✓ connected"
    assert re.fullmatch(r"✗ CONNECTION LOST at \d\d:\d\d( [AP]M)?, trying again ...", messages[4])
    assert messages[5] == messages[4]
    assert messages[8] == "✗ OLD ADDRESS: open the address that watch shows now"
    assert [state["lost"] for state in states][3:7] == [False, True, True, False]


def test_buttons_are_asked_for_by_their_addresses():
    def click(index):
        return f"keys[{index}].heard.click();"

    states = played(
        [
            click(0) + click(1),
            click(2),
            "sure = true;" + click(2),
            "answer = {ok: false, text: async () => ''};" + click(1),
        ]
    )
    asked = [f"POST {name}?key=word" for name in ("solve", "save", "reset")]
    assert [state["posts"] for state in states[:3]] == [asked[:2], asked[:2], asked]
    assert states[3]["posts"][-1] == "POST save?key=word"
    assert states[3]["lost"]


def test_what_is_to_be_pressed_first_stands_out_and_an_axis_can_be_given_by_hand():
    go_on = "events.onmessage({data: '<h1>GO ON</h1>'});"
    linked = "shown.files = 'a b';"
    states = played(
        [
            go_on,
            f"shown.buttons = 'save solve'; {linked}{go_on}",
            f"shown.byHand = 'z'; {go_on}",
            "nodes['by-hand'].heard.submit({preventDefault() {}});",
        ]
    )
    assert [state["main"] for state in states[:2]] == [[False] * 3, [False, True, False]]
    assert [state["hidden"] for state in states[:2]] == [[False] * 3, [False, False, True]]
    assert [state["link"] for state in states[:2]] == [True, "a?key=word"]
    assert [state["form"] for state in states] == [True, True, False, False]
    assert states[3]["posts"] == ["POST prior?key=word&axis=z&value=1.85&sigma=0.02"]


def test_a_prior_can_be_corrected_and_removed_and_what_somebody_has_chosen_stays():
    message = "events.onmessage({data: '<h1>CHECK THE PRIOR</h1>'});"
    states = played(
        [
            f"""shown.byHand = 'z yaw'; shown.priors = '{{"z": "1.5m+/-0.02m"}}'; {message}""",
            "nodes.asked.value = 'yaw'; nodes.asked.heard.change();",
            f"shown.byHand = 'yaw z x'; {message}",
            "nodes.asked.value = 'z'; nodes.asked.heard.change(); nodes.forget.heard.click();",
            "sure = true; keys[2].heard.click();",
            f"shown.priors = '{{}}'; {message} keys[2].heard.click();",
        ]
    )
    assert [state["form"] for state in states] == [False] * 6
    assert states[0]["axes"] == "<option>z</option><option>yaw</option>"
    assert [state["chosen"] for state in states[:4]] == ["z", "yaw", "yaw", "z"]
    assert [state["unit"] for state in states[:4]] == ["m", "deg", "deg", "m"]
    assert [state["forget"] for state in states[:4]] == [False, True, True, False]
    assert states[3]["posts"] == ["POST forget?key=word&axis=z"]
    assert states[4]["asks"] == [
        "Forget all poses?",
        "Remove the prior, too? It is z = 1.5m+/-0.02m.",
    ]
    assert states[4]["posts"][1:] == ["POST forget?key=word", "POST reset?key=word"]
    assert states[5]["asks"][2:] == ["Forget all poses?"]
    assert states[5]["posts"][3:] == ["POST reset?key=word"]
