"""The live node as a person sees it: words and bars, on a terminal and as a page."""

import copy
import io
import json
from dataclasses import replace

import pytest
from node_states import (
    CAREFUL,
    CHECKS,
    ERROR,
    EXTRINSIC,
    FULL,
    INF,
    REACHED,
    RESULT,
    SAVED,
    inputs,
    mount,
    state,
    view_of,
)
from rich.console import Console

from hand_eye_calib.core.base.plain import from_plain, plain
from hand_eye_calib.core.results import context
from hand_eye_calib.core.results.context import Comparison, Difference
from hand_eye_calib.online.live.progress import AXIS_KEYS, AxisProgress
from hand_eye_calib.online.live.state import Broadcast, Level, NodeState
from hand_eye_calib.online.ros.watch import _display
from hand_eye_calib.online.watch import terminal
from hand_eye_calib.online.watch.board import AXES, Board, Tone, state_of
from hand_eye_calib.online.watch.web import fragment


def test_evidence_is_displayed_at_the_end_alone():
    fact = "Errors larger than 2 cm along x would have been noticed"
    extrinsic = replace(EXTRINSIC, result=replace(RESULT, facts=(fact,)))
    view = view_of(state(at=REACHED, extrinsic=extrinsic))
    assert view.word == "DONE"
    assert [line.text for line in view.result if line.name == "evidence"] == [
        fact
    ]
    assert fact in fragment(view)
    assert fact not in fragment(view_of(state(extrinsic=extrinsic)))


def test_a_state_survives_its_json_and_nothing_else_is_one():
    for document in (state(), mount()):
        assert from_plain(NodeState, plain(document)) == document
    for wrong in (
        {},
        {**plain(state()), "node": 7},
        {**plain(state()), "inputs": [1]},
        [],
        "x",
    ):
        with pytest.raises((TypeError, ValueError, KeyError)):
            from_plain(NodeState, wrong)


def places(document, path=()):
    """The path to every value of a document, itself included."""
    yield path
    if isinstance(document, dict):
        keys = list(document)
    else:
        keys = range(len(document)) if isinstance(document, list) else ()
    for key in keys:
        yield from places(document[key], (*path, key))


def changed(document, path, value):
    """A copy of a document with another value at one place."""
    if not path:
        return value
    other = copy.deepcopy(document)
    holder = other
    for key in path[:-1]:
        holder = holder[key]
    holder[path[-1]] = value
    return other


HOSTILE = [
    None,
    True,
    -1,
    10**400,
    1e300,
    3e18,
    -1e49,
    "",
    "\x1b[31m",
    "\ud800",
    [],
    {},
    [1],
    {"x": None},
]


@pytest.mark.parametrize("hostile", HOSTILE, ids=lambda value: repr(value)[:12])
@pytest.mark.parametrize(
    "kind", ["calibrates", "watches", "cannot write", "saved"]
)
def test_a_state_with_any_wrong_value_is_shown_or_left_out(kind, hostile):
    states = {
        "calibrates": state(),
        "watches": mount(),
        "cannot write": state(journal=FULL),
        "saved": state(saved=SAVED),
    }
    document = plain(states[kind])
    shown = 0
    for path in places(document):
        taken = state_of(json.dumps(changed(document, path, hostile)))
        if taken is not None:
            view = view_of(taken)
            fragment(view)
            assert list(terminal.lines(view))
            shown += 1
    assert shown < len(list(places(document)))


@pytest.mark.parametrize(
    ("document", "now_s", "tone", "word", "sentence"),
    [
        (
            None,
            0.5,
            Tone.UNKNOWN,
            "NO NODE",
            "No message from a calibrator yet.",
        ),
        (state(), 9.0, Tone.BAD, "SILENT", "No message from the node for 9 s."),
        (state(), 0.5, Tone.BUSY, "GO ON", "Go on for about 25 s"),
        (state(level=Level.WARN), 0.5, Tone.ACT, "CHANGE THE MOTION", "Go on"),
        (
            state(extrinsic=replace(EXTRINSIC, result=None)),
            0.5,
            Tone.BUSY,
            "START",
            "Go on",
        ),
        (
            state(
                at={"done": True, "is_faulty": True, "sentence": "Stop: feet."}
            ),
            *(0.5, Tone.ACT, "CHECK THE STREAMS", "Stop: "),
        ),
        (state(at=REACHED), 0.5, Tone.GOOD, "DONE", "Good to 4 mm."),
        (
            state(inputs=inputs(child=Level.WARN)),
            0.5,
            Tone.ACT,
            "CHECK INPUT",
            "/odom has been",
        ),
        (
            state(inputs=inputs(Level.WARN, Level.ERROR)),
            0.5,
            Tone.BAD,
            "BAD INPUT",
            "/odom: bad",
        ),
        (
            state(
                checks=replace(
                    CHECKS, level=Level.WARN, text="lengths are feet"
                )
            ),
            *(0.5, Tone.ACT, "CHECK THE STREAMS", "Lengths are feet."),
        ),
        (
            state(
                checks=replace(
                    CHECKS, level=Level.WARN, text="a; b: c", gravest="a"
                )
            ),
            *(0.5, Tone.ACT, "CHECK THE STREAMS", "A."),
        ),
        (
            state(
                checks=replace(
                    CHECKS, level=Level.WARN, text="a; b: c", gravest="a " * 16
                )
            ),
            *(
                0.5,
                Tone.ACT,
                "CHECK THE STREAMS",
                "The streams have a fault: read the checks",
            ),
        ),
        (
            state(
                extrinsic=replace(
                    EXTRINSIC,
                    level=Level.WARN,
                    text="a; b: c",
                    contradicted=("z",),
                )
            ),
            *(
                0.5,
                Tone.BAD,
                "CHECK THE VALUE",
                "The value typed in for z contradicts the motion.",
            ),
        ),
        (
            state(checks=replace(CHECKS, level=Level.WARN, age_s=None)),
            *(0.5, Tone.BUSY, "GO ON", "Go on for"),
        ),
        (
            mount(**ERROR, text="it moved"),
            0.5,
            Tone.BAD,
            "MOUNT MOVED",
            "It moved.",
        ),
        (mount(), 0.5, Tone.GOOD, "WATCHING", "It has not."),
        (mount(is_learning=True), 0.5, Tone.BUSY, "LEARNING", "It has not."),
        (
            mount(level=Level.WARN, text="no URDF"),
            0.5,
            Tone.ACT,
            "NOT WATCHING",
            "No URDF.",
        ),
        (
            state(journal=FULL),
            0.5,
            Tone.BAD,
            "BROKEN",
            "The session cannot be ",
        ),
        (
            state(journal=FULL, at=REACHED, saved=SAVED),
            0.5,
            Tone.GOOD,
            "DONE",
            "Good to 4 mm. Saved",
        ),
        (
            state(extrinsic=replace(EXTRINSIC, **ERROR)),
            0.5,
            Tone.BAD,
            "BROKEN",
            "Known.",
        ),
        (
            replace(state(), has_ended=True),
            9.0,
            Tone.ACT,
            "ENDED",
            "The node has ended. The",
        ),
        (
            replace(mount(), has_ended=True),
            0.5,
            Tone.ACT,
            "ENDED",
            "The node has ended: the mount is not",
        ),
        (
            replace(state(at=REACHED), has_ended=True, saved=SAVED),
            *(
                9.0,
                Tone.GOOD,
                "ENDED",
                "The node has ended. The result was saved at ",
            ),
        ),
    ],
)
def test_the_headline_is_what_a_person_should_do_first(
    document, now_s, tone, word, sentence
):
    view = view_of(document, now_s=now_s)
    assert (view.tone, view.word) == (tone, word)
    assert view.sentence.startswith(sentence)


def test_bars_show_the_share_of_the_information_and_the_time_left():
    bars = dict(zip(AXES, view_of(state()).bars, strict=True))
    assert (bars["x"].share, bars["x"].tone, bars["x"].word) == (
        1.0,
        Tone.GOOD,
        "enough",
    )
    assert [bar.name for bar in bars.values()][2:4] == ["along z", "about x"]
    assert {bar.meaning for bar in bars.values()} == {""}
    on_wheels = view_of(
        state(extrinsic=replace(EXTRINSIC, has_vehicle_axes=True))
    )
    assert [bar.meaning for bar in on_wheels.bars][2:4] == [
        "up",
        "tilt to a side",
    ]
    assert [
        "sketch" in fragment(view) for view in (on_wheels, view_of(state()))
    ] == [
        True,
        False,
    ]
    # Twice the target is a quarter of the information.
    assert bars["z"].share == pytest.approx(0.25)
    nearly = AxisProgress(sigma=0.02001, target=0.02, seconds_left=25.0)
    assert view_of(state(axes={"z": nearly})).bars[2].share == 0.99
    assert (bars["z"].tone, bars["z"].word) == (Tone.ACT, "takes longest")
    assert (bars["z"].sigma, bars["yaw"].sigma) == (
        "± 4 cm of 2 cm",
        "± 0.057 deg of 0.3 deg",
    )


@pytest.mark.parametrize(
    ("sigma", "left_s", "tone", "word", "share"),
    [
        (INF, INF, Tone.UNKNOWN, "unknown yet", 0.0),
        (INF, 30.0, Tone.UNKNOWN, "out of reach", 0.0),  # as roll of an antenna
        (0.08, INF, Tone.ACT, "not enough yet", 0.0625),
        (0.018, 0.0, Tone.GOOD, "enough", 1.0),
        (0.0, 0.0, Tone.GOOD, "enough", 1.0),
        (0.08, 300.0, Tone.ACT, "takes longest", 0.0625),
    ],
)
def test_an_axis_in_words(sigma, left_s, tone, word, share):
    row = AxisProgress(sigma=sigma, target=0.02, seconds_left=left_s)
    bar = view_of(state(axes={"z": row})).bars[2]
    assert (bar.tone, bar.word, bar.share) == (tone, word, pytest.approx(share))


def test_an_axis_that_this_motion_does_not_determine():
    row = AxisProgress(sigma=0.08, target=0.02, seconds_left=INF)
    stuck = view_of(state(axes={"z": row}, at={"will_not_get_there": True}))
    assert stuck.bars[2].word == "not with this motion"


def test_the_pose_has_the_angles_as_printed_with_their_own_standard_deviations():
    view = view_of(state())
    values = dict(view.values)
    assert view.title == "pose of camera in lidar"
    assert (values["x"], values["roll"]) == (
        "0.420 m ± 4 mm",
        "0.57 ± 0.57 deg",
    )
    assert values["z"] == "unknown"
    moved = replace(EXTRINSIC, motion_s=75.0)
    assert view_of(state(extrinsic=moved)).facts == "3 m, 75 s of motion"
    late = replace(moved, result=replace(RESULT, age_s=40.0))
    view = view_of(state(extrinsic=late))
    assert view.facts == "3 m, 75 s of motion, result 40 s old"
    gone = view_of(state(extrinsic=replace(EXTRINSIC, result=None)))
    assert (gone.title, gone.values, gone.buttons) == ("", (), ("reset",))


def a_mount_that_has_moved():
    """Comparison with what is installed: all axes have moved, and one sigma is unknown."""
    differs = context.AxisDifference(
        difference=0.031, sigma=0.004, visible=0.01, verdict="moved"
    )
    axes = dict.fromkeys(AXIS_KEYS.values(), differs) | {
        "about_z": replace(differs, sigma=INF)
    }
    difference = Difference(
        first="a", second="b", verdict="moved", sentence="", axes=axes
    )
    difference = replace(difference, change="z by +3 cm +/- 4 mm")
    return Comparison(
        sentence="moved: z by +3 cm +/- 4 mm",
        verdict="moved",
        differences=(difference,),
    )


def test_verdict_reasons_and_comparison_have_a_sign():
    comparison = a_mount_that_has_moved()
    done = {"at": {"done": True, "precision": "known"}}
    careful = replace(EXTRINSIC, result=CAREFUL)
    view = view_of(state(comparison=comparison, extrinsic=careful, **done))
    assert (view.word, view.tone, view.buttons[0]) == ("DONE", Tone.ACT, "save")
    # Distance and angle of the axes that have moved; the bars contain each of them.
    assert view.sentence == "camera HAS MOVED by 5.4 cm and 2.5 deg."
    assert view.advice == "Save. USE WITH CARE: z might be wrong."
    assert view_of(state(**done)).text == "Known. Stop and save."
    saved = view_of(replace(state(**done), saved=SAVED))
    assert saved.text.startswith("Known. Saved at ")
    assert saved.result[-1].text.endswith(" in /home/live: USE: all six axes")
    assert (saved.tone, saved.buttons[0], saved.saved_in) == (
        Tone.GOOD,
        "solve",
        "/home/live",
    )
    assert (saved.result[-1].name, saved.result[-1].tone) == (
        "saved",
        Tone.GOOD,
    )
    assert (view.result[0].tone, view.result[0].text) == (
        Tone.ACT,
        "USE WITH CARE",
    )
    assert view.reasons == ("a: b", "c: d")
    assert (view.result[2].tone, view.result[2].text) == (
        Tone.ACT,
        "moved: z by +3 cm ± 4 mm",
    )
    assert view.bars[2].difference == "+3.10 ± 0.40 cm"
    assert view.bars[5].difference == "unknown"
    assert [line.name for line in view_of(state()).result] == [
        "verdict",
        "note",
    ]
    for verdict, tone in (("same", Tone.GOOD), ("cannot tell", Tone.UNKNOWN)):
        other = replace(comparison, verdict=verdict)
        assert view_of(state(comparison=other)).result[2].tone is tone


@pytest.mark.parametrize(
    ("broadcast", "tone"),
    [
        (Broadcast.ON, Tone.GOOD),
        (Broadcast.REFUSED, Tone.ACT),
        (Broadcast.WITHDRAWN, Tone.ACT),
    ],
)
def test_a_broadcast_has_a_sign(broadcast, tone):
    extrinsic = replace(EXTRINSIC, tf_static=broadcast, tf_static_reason="why")
    # After the end of the node, late subscribers receive nothing.
    for has_ended, expected in ((False, tone), (True, Tone.ACT)):
        seen_state = replace(state(extrinsic=extrinsic), has_ended=has_ended)
        line = view_of(seen_state).result[2]
        assert (line.tone, line.name) == (expected, "sent to other programs")
        texts = "nothing" in line.text, line.text.endswith(": why")
        assert texts == (has_ended, not has_ended)


def test_a_session_is_done_with_the_reason_of_its_verdict():
    careful = replace(EXTRINSIC, result=CAREFUL)
    done = state(at={"done": True, "precision": "known"}, extrinsic=careful)
    view = view_of(done)
    assert (view.word, view.tone, view.asked) == ("DONE", Tone.ACT, "save")
    assert view.text == "USE WITH CARE: z might be wrong. Save. Measure it."
    saved = view_of(replace(done, saved=SAVED))
    assert saved.text.startswith("USE WITH CARE: z might be wrong. Saved at ")
    assert (saved.tone, saved.advice, saved.asked) == (
        Tone.ACT,
        "Measure it.",
        "",
    )


def test_a_watched_mount_has_a_line_for_each_axis_instead_of_bars():
    view = view_of(
        mount(
            **ERROR,
            text="the mount has moved",
            since_ns=10**18,
            newest_ns=10**18 + 130 * 10**9,
            visible_10min=dict.fromkeys(AXIS_KEYS.values(), 0.004)
            | {"z": None},
            shift={"about_z": 0.0175, "x": 0.001},
            shift_sigma={"about_z": 0.001, "x": 0.001},
        )
    )
    lines = {line.name: (line.tone, line.text) for line in view.watched}
    assert lines["about z"] == (Tone.BAD, "moved by 1 deg ± 0.057 deg")
    assert lines["along x"] == (Tone.GOOD, "not moved (detects 4 mm)")
    assert lines["along z"] == (
        Tone.UNKNOWN,
        "cannot be watched with this motion",
    )
    assert (view.bars, view.result, view.word) == ((), (), "MOUNT MOVED")
    assert (
        view.text
        == "The mount has moved. Check the mount, then recalibrate or acknowledge."
    )
    assert view.facts == "2 min ago; a reset ends the alarm"
    assert view.buttons[:2] == ("recalibrate", "acknowledge")
    assert "the mount, and what ten minutes of motion detect" in fragment(view)
    assert "precision" not in fragment(view)
    assert "moved by 1 deg" in drawn(view, 80)
    assert "s solve" not in drawn(view, 80)
    assert "c recalibrate   a acknowledge   r reset" in drawn(view, 80)
    assert '<p class="advice">Check the mount, then' in fragment(view)
    assert view_of(mount(level=Level.WARN)).watched[0].text == "not known yet"


def test_of_several_nodes_the_first_that_speaks_is_shown_or_the_one_that_is_wanted():
    first = Board()
    wanted = Board("/b")
    for board in (first, wanted):
        for name in ("/a", "/b"):
            board.take(state(name), 0.0)
    assert (first.view(0.0).node, wanted.view(0.0).node) == ("/a", "/b")
    first.take(state("/b"), 9.0)  # the other one is silent
    assert first.view(9.0).node == "/b"
    other = Board("/x")
    other.take(state("/a"), 0.0)
    assert (other.node, other.view(0.0).word) == ("", "NO NODE")


def test_an_alarm_that_somebody_knows_of_is_quiet_until_the_next():
    board = Board()
    board.take(mount(**ERROR, text="moved", since_ns=10**18), 0.0)
    board.acknowledge()
    view = board.view(0.5)
    quiet = "MOUNT MOVED", Tone.ACT, ("recalibrate", "reset")
    assert (view.word, view.tone, view.buttons) == quiet
    assert view.facts.endswith("; acknowledged")
    assert view.text.endswith("then recalibrate.")
    board.take(mount(**ERROR, text="moved", since_ns=2 * 10**18), 1.0)
    assert board.view(1.0).tone is Tone.BAD


def test_topics_with_poses_are_listed_where_an_input_lacks_them():
    board = Board()
    board.topics = ("/lidar (nav_msgs/msg/Odometry, 1 publisher)",)
    silent = {
        name: replace(stream, messages=9 * (name == "parent"))
        for name, stream in inputs(child=Level.WARN).items()
    }
    board.take(state(inputs=silent), 0.0)
    assert board.view(0.0).topics == board.topics
    assert "/lidar (nav_msgs" in drawn(board.view(0.0), 80)
    assert board.inputs == ("/odom", "/odom")
    both = {
        name: replace(stream, messages=9) for name, stream in silent.items()
    }
    board.take(state(inputs=both), 0.0)
    assert board.view(0.0).topics == ()


# -------------------------------------------------------------------- terminal


def drawn(view, width):
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(terminal.screen(view, width, "phone: http://x"))
    return console.export_text()


@pytest.mark.parametrize("width", [60, 120])
def test_the_terminal_shows_words_and_signs_at_every_width(width):
    careful = replace(
        EXTRINSIC, result=replace(RESULT, verdict="USE WITH CARE")
    )
    text = drawn(view_of(state(extrinsic=careful)), width)
    words = ("▶ GO ON", "✓ enough", "! takes longest", "0.420 m", "± 4 cm of 2 cm", "━━━",
             "20.0 Hz", "USE WITH CARE")  # fmt: skip
    for word in words:
        assert word in text
    assert max(map(len, text.splitlines())) <= width


def test_a_line_is_printed_when_something_else_is_said(capsys):
    board = Board()

    def printed(document, now_s):
        board.take(document, now_s)
        show(board.view(now_s), False)
        return capsys.readouterr().out.splitlines()

    with _display("") as show:
        assert printed(state(), 1.0) == [
            "▶ GO ON: Go on for about 25 s: z is behind."
        ]
        assert (
            printed(
                state(at={"sentence": "Go on for about 20 s: z is behind."}),
                2.0,
            )
            == []
        )
        assert printed(state(at={"done": True}), 3.0)
        learning = [
            mount(is_learning=True, text=f"{second} of 120 s")
            for second in (1, 2)
        ]
        assert [len(printed(document, 4.0)) for document in learning] == [1, 0]
        board.answer("save", True, "result saved", 5.0)
        assert printed(learning[0], 5.0) == ["✓ save: result saved"]
        assert board.view(60.0).answer == ()


def test_a_busy_computer_is_named_beside_the_advice_that_waits_for_its_result():
    slow = "The computer is busy: a result takes 60 s."
    busy = replace(EXTRINSIC, slow=slow)
    view = view_of(state(extrinsic=busy))
    assert (view.word, view.advice) == ("GO ON", slow)
    start = view_of(state(extrinsic=replace(busy, result=None)))
    assert (start.word, start.advice) == ("START", slow)
    done = view_of(
        state(extrinsic=busy, at={"done": True, "precision": "good to 1 cm"})
    )
    assert slow not in done.text
