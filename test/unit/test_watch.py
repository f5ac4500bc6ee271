"""The live node as a person sees it: words and bars, on a terminal and as a page."""

import http.client
import io
import queue
import re
import time
from xml.etree import ElementTree

import pytest
from rich.console import Console

from hand_eye_calib.cli.main import main
from hand_eye_calib.cli.watch import Session
from hand_eye_calib.errors import ConfigError
from hand_eye_calib.watch import terminal, web
from hand_eye_calib.watch.board import AXES, Board, Pose, Status, Tone, duration, small
from hand_eye_calib.watch.html import fragment
from hand_eye_calib.watch.web import WebServer

NODE = "/calibrator"
PATIENCE_S = 120.0  # how long a hang takes to fail a test, on a busy machine
POSE = Pose("lidar", "camera", (0.42, -0.13, -0.35, 0.01, -0.02, 1.5))


def progress(level=0, sentence="Go on for about 25 s: z is behind.", **more):
    values = {"done": "false", "limiting_axis": "z", "verdict": "USE WITH CARE"}
    for axis, unit in AXES.items():
        values |= {
            f"sigma.{axis}": "0.004" if unit == "m" else "0.001",
            f"target.{axis}": "0.02" if unit == "m" else "0.00524",
            f"seconds_left.{axis}": "0",
        }
    values |= {"sigma.z": "0.04", "seconds_left.z": "25"}
    return Status("progress", level, sentence, values | more)


def inputs(parent=0, child=0):
    texts = {0: "20.0 Hz", 1: "/odom has been silent for 3 s", 2: "/odom: bad quaternion"}
    return [
        Status(f"{name} input", level, texts[level], {"topic": "/odom"})
        for name, level in (("parent", parent), ("child", child))
    ]


def view_of(*statuses, now_s=0.5, pose=POSE, node=""):
    board = Board()
    board.take(NODE, statuses, 0.0)
    if pose is not None:
        board.take_pose(NODE, pose)
    return board.view(node, now_s)


@pytest.mark.parametrize(
    ("statuses", "now_s", "tone", "word", "sentence"),
    [
        ([], 0.5, Tone.UNKNOWN, "NO NODE", "Nothing heard of /calibrator yet."),
        ([progress()], 9.0, Tone.BAD, "SILENT", "The node has said nothing for 9 s."),
        ([progress(), *inputs()], 0.5, Tone.BUSY, "GO ON", "Go on for about 25 s"),
        ([progress(1), *inputs()], 0.5, Tone.ACT, "CHANGE THE MOTION", "Go on"),
        ([progress(1, verdict="no result")], 0.5, Tone.BUSY, "START", "Go on"),
        (
            [progress(done="true", sentence="Stop: the streams are faulty: feet.")],
            *(0.5, Tone.ACT, "CHECK THE STREAMS", "Stop: "),
        ),
        ([progress(done="true"), *inputs()], 0.5, Tone.GOOD, "DONE", "Go on"),
        ([progress(), *inputs(child=1)], 0.5, Tone.ACT, "CHECK INPUT", "/odom has been silent"),
        ([progress(), *inputs(1, 2)], 0.5, Tone.BAD, "BAD INPUT", "/odom: bad quaternion."),
        (
            [progress(), Status("stream checks", 1, "the child's lengths are feet")],
            *(0.5, Tone.ACT, "CHECK THE STREAMS", "The child's lengths are feet."),
        ),
        (
            [progress(), Status("stream checks", 1, "not checked yet", {"checked": "not yet"})],
            *(0.5, Tone.BUSY, "GO ON", "Go on for"),
        ),
        ([Status("mount", 2, "it moved"), progress()], 0.5, Tone.BAD, "MOUNT MOVED", "It moved."),
        ([Status("mount", 0, "it has not")], 0.5, Tone.GOOD, "WATCHING", "It has not."),
        ([Status("mount", 0, "learning")], 0.5, Tone.BUSY, "LEARNING", "Learning."),
        ([Status("mount", 1, "no URDF")], 0.5, Tone.ACT, "NOT WATCHING", "No URDF."),
        ([Status("extrinsic", 0, "known")], 0.5, Tone.GOOD, "GOOD", "Known."),
        ([Status("extrinsic", 2, "defect")], 0.5, Tone.BAD, "BROKEN", "Defect."),
    ],
)
def test_the_headline_is_what_a_person_should_do_first(statuses, now_s, tone, word, sentence):
    view = view_of(*statuses, now_s=now_s)
    assert (view.tone, view.word) == (tone, word)
    assert view.sentence.startswith(sentence)


def test_bars_show_the_share_of_the_information_and_the_time_left():
    bars = {bar.axis: bar for bar in view_of(progress()).bars}
    assert list(bars) == list(AXES)
    assert bars["x"].share == 1.0
    assert (bars["x"].tone, bars["x"].word) == (Tone.GOOD, "enough")
    assert [bar.meaning for bar in bars.values()][2:4] == ["along z", "about x"]
    assert bars["z"].share == pytest.approx(0.25)  # twice the target: a quarter of the information
    assert (bars["z"].tone, bars["z"].word) == (Tone.ACT, "25 s left")
    assert (bars["z"].sigma, bars["z"].target) == ("4 cm", "2 cm")
    assert (bars["z"].against, bars["yaw"].against) == ("± 4 of 2 cm", "± 0.057 of 0.3 deg")


@pytest.mark.parametrize(
    ("sigma", "left", "tone", "word", "share"),
    [
        ("unobservable", "unobservable", Tone.UNKNOWN, "not seen yet", 0.0),
        ("0.08", "unobservable", Tone.ACT, "not with this motion", 0.0625),
        ("0.018", "12", Tone.BUSY, "nearly: 12 s left", 1.0),
        ("0", "0", Tone.GOOD, "enough", 1.0),
        ("0.08", "300", Tone.ACT, "5 min left", 0.0625),
    ],
)
def test_an_axis_in_words(sigma, left, tone, word, share):
    bar = view_of(progress(**{"sigma.z": sigma, "seconds_left.z": left})).bars[2]
    assert (bar.tone, bar.word, bar.share) == (tone, word, pytest.approx(share))


def test_the_pose_has_the_angles_as_printed_with_their_own_standard_deviations():
    said = {"sigma x (mm)": "4.00", "sigma z (mm)": "unknown", "sigma roll (deg)": "0.5700"}
    view = view_of(progress(), Status("extrinsic", 0, "known", said))
    values = dict(view.values)
    assert view.title == "pose of camera in lidar"
    assert values["x"] == "0.420 m ± 4 mm"
    assert values["roll"] == "0.57 ± 0.57 deg"
    assert values["z"] == values["yaw"] == "? not observed"


def test_the_comparison_has_its_figures_and_a_sign():
    values = {
        "comparison": "moved",
        "comparison_sentence": "z has moved by 3 cm",
        "difference.z": "0.031",
        "difference_sigma.z": "0.004",
        "difference.yaw": "-0.02",
        "difference_sigma.yaw": "unobservable",
    }
    view = view_of(progress(**values))
    assert (view.result[1].tone, view.result[1].text) == (Tone.ACT, "z has moved by 3 cm")
    assert view.bars[2].difference == "+3.1 cm ± 4 mm"
    assert view.bars[5].difference == "unknown"
    assert view_of(progress(comparison="same")).result[1].tone is Tone.GOOD
    assert view_of(progress(comparison="cannot tell")).result[1].tone is Tone.UNKNOWN
    assert "nothing to compare with" in view_of(progress()).result[1].text
    assert len(view_of(progress()).result) == 2
    waiting = {"comparison": "not yet", "comparison_sentence": "not compared yet: no result yet"}
    assert view_of(progress(**waiting)).result[1].text == "not compared yet: no result yet"


def test_verdict_and_reasons():
    view = view_of(progress(verdict="DO NOT USE", **{"reason.1": "a: b", "reason.2": "c"}))
    assert (view.result[0].tone, view.result[0].text) == (Tone.BAD, "DO NOT USE")
    assert view.reasons == ("a: b", "c")


def test_a_watched_mount_has_a_line_for_each_axis_instead_of_bars():
    values = {f"visible_10min.{axis}": "0.004" for axis in AXES} | {"visible_10min.z": "unknown"}
    values |= {"shift.yaw": "0.0175", "shift_sigma.yaw": "0.001", "shift.x": "0.001"}
    values |= {"shift_sigma.x": "0.001"}
    view = view_of(Status("mount", 2, "the mount has moved: yaw by 1 deg", values), *inputs())
    lines = {line.name: (line.tone, line.text) for line in view.watched}
    assert lines["yaw"] == (Tone.BAD, "moved by 1 deg ± 0.057 deg")
    assert lines["x"] == (Tone.GOOD, "a change of 4 mm")
    assert lines["z"] == (Tone.UNKNOWN, "nothing yet")
    assert (view.bars, view.result, view.word) == ((), (), "MOUNT MOVED")
    assert "the mount: what ten minutes" in fragment(view)
    assert "precision" not in fragment(view)
    assert "moved by 1 deg" in drawn(view, 80)
    assert "s solve" not in drawn(view, 80)
    assert len(terminal.LineLog().lines(view, 0.0)) == 1


def test_a_reset_takes_the_values_away():
    board = Board()
    board.take(NODE, [progress()], 0.0)
    board.take_pose(NODE, POSE)
    board.take(NODE, [progress(verdict="no result")], 1.0)
    view = board.view("", 1.0)
    assert (view.title, view.values) == ("no extrinsic yet", ())


def test_of_several_nodes_the_first_that_speaks_is_shown_or_the_one_that_is_wanted():
    board = Board()
    for name, heard_s in (("/a", 0.0), ("/c", 9.0), ("/b", 9.0)):
        board.take(name, [progress()], heard_s)
    assert board.view("", 10.0).node == "/b"
    assert board.view("/c", 10.0).node == "/c"
    assert board.view("", 10.0).nodes == ("/a", "/b", "/c")
    assert board.view("", 99.0).node == "/a"
    assert board.view("/x", 10.0).word == "NO NODE"


def test_an_answer_is_shown_for_a_while():
    board = Board()
    board.take(NODE, [progress()], 0.0)
    board.answer(NODE, "save", True, "result saved to here", 0.0)
    assert board.view("", 1.0).answer.text == "result saved to here"
    assert board.view("", 60.0).answer is None


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.0004, "m", "0.4 mm"),
        (0.0099, "m", "9.9 mm"),
        (0.0123, "m", "1.2 cm"),
        (0.5, "m", "50 cm"),
        (12.3, "m", "12.3 m"),
        (0.001, "rad", "0.057 deg"),
        (0.0001, "rad", "0.0057 deg"),
        (-0.0003, "m", "-0.3 mm"),
        (-0.000001, "rad", "less than 0.001 deg"),
        (float("nan"), "m", ""),
    ],
)
def test_small_lengths_and_angles(value, unit, text):
    assert small(value, unit) == text


def test_durations():
    assert [duration(seconds) for seconds in (89, 120, 7200, 1e300)] == [
        *("89 s", "2 min", "2 h", "more than a day"),
    ]


# -------------------------------------------------------------------- terminal


def drawn(view, width):
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(terminal.screen(view, width, 24, "phone: http://x"))
    return console.export_text()


@pytest.mark.parametrize("width", [60, 80, 120])
def test_the_terminal_shows_words_and_signs_at_every_width(width):
    said = Status("extrinsic", 0, "known", {"sigma x (mm)": "4.00"})
    text = drawn(view_of(said, progress(), *inputs()), width)
    assert "▶ GO ON" in text
    for word in (
        "✓ enough",
        "! 25 s left",
        "0.420 m",
        "± 4 of 2 cm",
        "██",
        "░░",
        "20.0 Hz",
        "USE WITH CARE",
    ):
        assert word in text
    assert max(map(len, text.splitlines())) <= width


def test_lines_are_printed_when_something_new_is_said():
    log = terminal.LineLog()
    first = log.lines(view_of(progress()), 1.0)
    assert first[0] == "   1.0 s  ▶ GO ON: Go on for about 25 s: z is behind."
    assert "z 25 %" in first[1]
    assert log.lines(view_of(progress(**{"sigma.x": "0.003"})), 2.0) == []
    assert log.lines(view_of(progress(done="true")), 3.0)
    assert log.lines(view_of(progress(), now_s=9.0), 9.0)
    assert log.lines(view_of(progress(), now_s=10.0), 10.0) == []  # still silent
    learning = [Status("mount", 0, f"learning: {second} of 120 s") for second in (1, 2)]
    assert [len(log.lines(view_of(each), 11.0)) for each in learning] == [1, 0]


def test_an_answer_has_a_line_of_its_own():
    log, board = terminal.LineLog(), Board()
    board.take(NODE, [progress()], 0.0)
    log.lines(board.view("", 0.0), 0.0)
    board.answer(NODE, "save", True, "result saved", 0.0)
    assert log.lines(board.view("", 1.0), 1.0) == ["   1.0 s  ✓ save: result saved"]


@pytest.fixture
def typed():
    """A session at a terminal: function that types keys and returns the view."""
    board, requests, keys = Board(), queue.SimpleQueue(), []
    for name in ("/a", "/b"):
        board.take(name, [progress()], time.monotonic())
    session = Session(board, "", requests, lambda: keys.pop() if keys else "")

    def type_keys(text):
        keys.append(text)
        return session.view()

    type_keys.session, type_keys.requests = session, requests
    return type_keys


def test_keys_ask_the_node_that_is_shown(typed):
    assert typed("s").node == "/a"
    assert typed("2w").node == "/b"
    assert [typed.requests.get(), typed.requests.get()] == [("/a", "solve"), ("/b", "save")]
    assert typed("9x").node == "/b"
    assert typed.requests.empty()


def test_a_reset_takes_two_presses(typed):
    assert typed("r").answer.text == "forgets all poses: press r again"
    assert typed.requests.empty()
    typed("r")
    assert typed.requests.get() == ("/a", "reset")


def test_q_ends(typed):
    typed("s")
    assert not typed.session.is_over
    typed("q")
    assert typed.session.is_over


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--web", "high"], "expected PORT or HOST:PORT, got 'high'"),
        (["--web", "99999"], "expected PORT or HOST:PORT, got '99999'"),
        (["--key", "word"], "--key is for --web"),
    ],
)
def test_wrong_usage_is_one_line(arguments, text, capsys):
    try:
        code = main(["watch", *arguments])
    except SystemExit as end:
        code = end.code
    assert code == 2
    assert text in capsys.readouterr().err


# ------------------------------------------------------------------------ page


def test_the_fragment_is_well_formed_and_escapes_what_nodes_say():
    hostile = '<script>alert("1")</script>'
    view = view_of(
        progress(sentence=hostile, **{"reason.1": hostile}), pose=Pose("<", "&", POSE.values)
    )
    text = fragment(view)
    assert "<script" not in text
    root = ElementTree.fromstring(f"<main>{text}</main>")
    assert [each.get("aria-label") for each in root.iter("progress")] == list(AXES)
    assert "".join(root.find(".//h1").itertext()) == "▶ GO ON"


def test_the_fragment_lets_choose_among_several_nodes():
    board = Board()
    for name in ("/a", "/b"):
        board.take(name, [progress()], 0.0)
    root = ElementTree.fromstring(f"<main>{fragment(board.view('/b', 0.0))}</main>")
    links = {link.get("data-node"): link.get("aria-current") for link in root.iter("a")}
    assert links == {"/a": None, "/b": "true"}


@pytest.fixture
def server():
    board, requests = Board(), queue.SimpleQueue()
    board.take(NODE, [progress()], time.monotonic())
    made = WebServer(board, lambda *request: requests.put(request), ("127.0.0.1", 0), key="word")
    made.requests = requests
    yield made
    made.stop()


def fetch(server, method, path):
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE_S)
    connection.request(method, path)
    return connection.getresponse()


def test_the_page_needs_nothing_from_elsewhere(server):
    page = fetch(server, "GET", "/?key=word")
    text = page.read().decode()
    names = re.findall(r'(?:src|href)="([^"]+)"', text)
    assert names == ["page.css", "data:,", "page.js"]
    assert "default-src 'none'" in page.getheader("Content-Security-Policy")
    for name in ("/page.css", "/page.js"):
        answer = fetch(server, "GET", name)
        assert answer.status == 200
        assert "//" not in answer.read().decode().replace("// ", "")


def test_events_bring_the_view_at_once_and_again_when_it_changes(server):
    events = fetch(server, "GET", "/events?key=word")
    assert events.getheader("Content-Type").startswith("text/event-stream")
    first = events.readline().decode()
    assert first.startswith("data: <p")
    assert "GO ON" in first
    server.board.take(NODE, [progress(done="true")], time.monotonic())
    changed = next(line for line in iter(events.readline, b"") if b"<" in line)
    assert "DONE" in changed.decode()


@pytest.mark.parametrize("path", ["/", "/?key=other", "/events?key=", "/events"])
def test_without_the_key_there_is_nothing_to_see(server, path):
    assert fetch(server, "GET", path).status == 403


def test_buttons_are_passed_on_with_the_key_only(server):
    assert fetch(server, "POST", "/save?key=word").status == 200
    assert server.requests.get(timeout=PATIENCE_S) == (NODE, "save")
    assert fetch(server, "POST", "/reset").status == 403
    assert fetch(server, "POST", "/shutdown?key=word").status == 404
    assert fetch(server, "GET", "/save?key=word").status == 404
    assert server.requests.empty()


def test_a_browser_that_leaves_makes_room_for_another(monkeypatch):
    monkeypatch.setattr(web, "_MOST_CLIENTS", 1)
    board = Board()
    server = WebServer(board, print, ("127.0.0.1", 0), key="word")
    try:
        events = fetch(server, "GET", "/events?key=word")
        assert events.readline().startswith(b"data: <p")
        assert fetch(server, "GET", "/events?key=word").status == 503
        events.close()
        end = time.monotonic() + PATIENCE_S
        while fetch(server, "GET", "/events?key=word").status == 503:
            assert time.monotonic() < end
            time.sleep(0.05)
    finally:
        server.stop()


def test_a_port_in_use_is_said_in_one_line(server):
    with pytest.raises(ConfigError, match="choose another with --web PORT"):
        WebServer(Board(), print, ("127.0.0.1", server.port))


@pytest.mark.parametrize(
    ("state", "tone"),
    [
        ("broadcast", Tone.GOOD),
        ("not yet: the goal is not reached", Tone.BUSY),
        ("refused: camera has the parent base_link on /tf_static already", Tone.ACT),
    ],
)
def test_whether_the_result_is_broadcast_is_shown_where_that_was_asked_for(state, tone):
    said = Status("extrinsic", 0, "USE", {"broadcast on /tf_static": state})
    line = view_of(progress(), said).result[2]
    assert (line.tone, line.name, line.text) == (tone, "on /tf_static", state)
    off = Status("extrinsic", 0, "USE", {"broadcast on /tf_static": "off"})
    assert len(view_of(progress(), off).result) == 2
