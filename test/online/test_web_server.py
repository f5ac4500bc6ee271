"""The page of the live node: its text, its server, and what a person may ask from it."""

import http.client
import queue
import re
import stat
import sys
import time
from dataclasses import replace
from xml.etree import ElementTree

import pytest
from node_states import (
    EXTRINSIC,
    RESULT,
    SAVED,
    state,
    view_of,
)

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.online.live.state import (
    Level,
)
from hand_eye_calib.online.ros.watch import qr_code
from hand_eye_calib.online.watch.board import Board
from hand_eye_calib.online.watch.web import WebServer, fragment

# Time (s) until a hang fails a test on a busy machine.
PATIENCE_S = 120.0


def test_the_fragment_is_well_formed_and_escapes_what_nodes_say():
    hostile = '<script>alert("1")</script>'
    result = replace(
        RESULT, reasons=(hostile,), parent_frame="<", child_frame="&"
    )
    document = state(
        at={"sentence": hostile}, extrinsic=replace(EXTRINSIC, result=result)
    )
    text = fragment(view_of(document))
    assert "<script" not in text
    root = ElementTree.fromstring(f"<main>{text}</main>")
    labels = [element.get("aria-label") for element in root.iter("progress")]
    assert labels[2:4] == ["along z", "about x"]
    assert root.find("*[@id='state']").get("data-buttons") == "solve save reset"
    assert "".join(root.find(".//h1").itertext()) == "▶ GO ON"


@pytest.fixture
def server(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    board = Board()
    requests = queue.SimpleQueue()
    board.take(state(), time.monotonic())
    made = WebServer(board, requests.put, "127.0.0.1", [0])
    made.kept = made.key
    made.key = "word"
    made.requests = requests
    yield made
    made.stop()


def fetch(server, method, path):
    connection = http.client.HTTPConnection(
        "127.0.0.1", server.server_port, timeout=PATIENCE_S
    )
    connection.request(method, path)
    return connection.getresponse()


def test_the_page_needs_nothing_from_elsewhere(server):
    page = fetch(server, "GET", "/?key=word")
    text = page.read().decode()
    names = re.findall(r'(?:src|href)="([^"]+)"', text)
    assert sorted(names) == ["data:,", "page.css", "page.js"]
    assert "default-src 'none'" in page.getheader("Content-Security-Policy")
    for name in ("/page.css", "/page.js"):
        answer = fetch(server, "GET", name)
        assert answer.status == 200
        text = (
            answer.read()
            .decode()
            .replace("// ", "")
            .replace("http://www.w3.org/2000/svg", "")
        )
        assert "//" not in text


def test_a_server_that_is_started_again_has_its_key_again_unless_others_can_read_it(
    server, tmp_path
):
    def started():
        server.stop()
        server.__init__(Board(), print, "127.0.0.1", [server.server_port])
        return server.key

    file = tmp_path / "hand_eye_calib" / "watch_key"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert started() == server.kept == file.read_text()
    file.chmod(0o644)
    assert started() not in (server.kept, "")
    file.rename(file.with_name("elsewhere")).chmod(0o600)
    file.symlink_to("elsewhere")
    assert started() not in (server.kept, "")
    file.unlink()
    assert started() == started()


def test_events_bring_the_view_at_once_and_again_when_it_changes(server):
    events = fetch(server, "GET", "/events?key=word")
    assert events.getheader("Content-Type").startswith("text/event-stream")
    first = events.readline().decode()
    assert first.startswith('data: <div id="state"')
    assert "GO ON" in first
    server.board.take(state(at={"done": True}), time.monotonic())
    changed = next(line for line in iter(events.readline, b"") if b"<" in line)
    assert "DONE" in changed.decode()


def test_nothing_is_seen_or_asked_without_the_key(server):
    for path in ("/", "/?key=other", "/events?key=", "/events"):
        assert fetch(server, "GET", path).status == 403
    assert fetch(server, "POST", "/save?key=word").status == 200
    assert server.requests.get(timeout=PATIENCE_S) == "save"
    assert fetch(server, "POST", "/reset").status == 403
    assert fetch(server, "POST", "/shutdown?key=word").status == 404
    assert fetch(server, "GET", "/save?key=word").status == 404
    assert server.requests.empty()


def test_an_axis_measured_by_hand_becomes_a_parameter(server):
    good = fetch(server, "POST", "/prior?key=word&axis=z&value=1,85&sigma=0.02")
    assert good.status == 200
    assert server.requests.get(timeout=PATIENCE_S) == "prior.z:=1.85m+/-0.02m"
    # The page asks in metres: the node refuses 22 without a unit, and takes one that was typed.
    fetch(server, "POST", "/prior?key=word&axis=z&value=-22&sigma=2")
    assert server.requests.get(timeout=PATIENCE_S) == "prior.z:=-22+/-2"
    fetch(server, "POST", "/prior?key=word&axis=z&value=-22cm&sigma=2cm")
    assert server.requests.get(timeout=PATIENCE_S) == "prior.z:=-22cm+/-2cm"
    fetch(server, "POST", "/prior?key=word&axis=yaw&value=-90&sigma=2")
    assert server.requests.get(timeout=PATIENCE_S) == "prior.yaw:=-90deg+/-2deg"
    assert (
        fetch(server, "POST", "/prior?key=word&axis=q&value=1&sigma=1").status
        == 404
    )
    assert server.requests.empty()
    stuck = state(at={"will_not_get_there": True}, level=Level.WARN)
    assert 'data-by-hand="z"' in fragment(view_of(stuck))


def test_saved_files_are_served_and_nothing_else(server, tmp_path):
    assert fetch(server, "GET", "/report.html?key=word").status == 404
    (tmp_path / "report.html").write_text("<p>report")
    (tmp_path / "extrinsic.yaml").symlink_to("/etc/passwd")
    saved = replace(SAVED, directory=str(tmp_path))
    server.board.take(replace(state(), saved=saved), time.monotonic())
    response = fetch(server, "GET", "/report.html?key=word")
    assert (response.status, response.read()) == (200, b"<p>report")
    assert "script" not in response.getheader("Content-Security-Policy")
    assert fetch(server, "GET", "/report.html").status == 403
    for name in ("extrinsic.yaml", "../report.html", "journal"):
        assert fetch(server, "GET", f"/{name}?key=word").status == 404
    events = fetch(server, "GET", "/events?key=word")
    assert 'data-files="report.html' in events.readline().decode()


def test_the_address_is_drawn_as_a_code(monkeypatch):
    monkeypatch.setitem(sys.modules, "segno", None)
    assert qr_code("http://x") == ""
    monkeypatch.undo()
    pytest.importorskip("segno", reason="segno is not installed: '.[qr]'")
    assert (
        len(qr_code("http://192.168.178.43:8775/?key=Ab3dE_-9").splitlines())
        > 14
    )


def test_a_port_in_use_is_said_in_one_line(server):
    with pytest.raises(ConfigError, match="choose another with --web PORT"):
        WebServer(Board(), print, "127.0.0.1", [server.server_port])


def test_the_next_port_replaces_a_default_port_in_use(server):
    used = server.server_port
    other = WebServer(Board(), print, "127.0.0.1", range(used, used + 10))
    try:
        assert used < other.server_port < used + 10
    finally:
        other.stop()
