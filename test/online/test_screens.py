"""Every screen of ``watch``: its texts agree, and a driver reads them aloud in one breath."""

from dataclasses import replace

import pytest
from node_states import (
    BEHIND,
    CHECKS,
    EXTRINSIC,
    FULL,
    INF,
    NODE,
    REACHED,
    RESULT,
    SAVED,
    inputs,
    mount,
    state,
    view_of,
)
from result_making import seen, written_finding
from screen_rules import faults_of

from hand_eye_calib.core.results.context import (
    AxisDifference,
    Comparison,
    Difference,
)
from hand_eye_calib.core.results.records import AXES, Severity
from hand_eye_calib.core.results.verdict import RULES, Reason, Verdict
from hand_eye_calib.online.live.brief import (
    START_SOURCE,
    START_SOURCE_AGAIN,
    of_reason,
    publishers_in_words,
    step_after,
)
from hand_eye_calib.online.live.describing import NO_PAIRS, too_little_in_words
from hand_eye_calib.online.live.goal import no_result_in_words
from hand_eye_calib.online.live.progress import AXIS_KEYS, AxisProgress
from hand_eye_calib.online.live.state import Level, Standing
from hand_eye_calib.online.watch import terminal
from hand_eye_calib.online.watch.board import Board
from hand_eye_calib.online.watch.view import Tone
from hand_eye_calib.online.watch.web import fragment


def full_bars():
    """Progress of six axes that are within their targets."""
    row = AxisProgress(sigma=0.001, target=0.02, seconds_left=0.0)
    return dict.fromkeys(AXIS_KEYS.values(), row)


DONE = REACHED | {
    "axes": full_bars(),
    "sentence": "Done: good to 4 mm. Stop and save.",
}
UNSEEN = AxisProgress(sigma=INF, target=0.02, seconds_left=INF)
NOTHING = {
    "axes": dict.fromkeys(AXIS_KEYS.values(), UNSEEN),
    "limiting_axis": "",
}
HEIGHT_UNKNOWN = {"z": replace(BEHIND, seconds_left=INF)}
HAND = "Drive over a ramp or a kerb, or measure it by hand."


def moving(motion_s, result=None, **fields):
    """The state of the solver after a motion."""
    return replace(EXTRINSIC, motion_s=motion_s, result=result, **fields)


def at(sentence, **fields):
    return NOTHING | {"sentence": sentence} | fields


def stream(name, text, **fields):
    """Both inputs; one of them needs a person."""
    both = inputs()
    both = {
        key: replace(both[key], topic=f"/{key}_odom", messages=9)
        for key in both
    }
    return both | {
        name: replace(both[name], level=Level.WARN, text=text, **fields)
    }


def silent(name, level=Level.WARN):
    text = f"/{name}_odom has been silent for 19 s"
    both = stream(
        name, text, is_paused=True, silent_s=19.0, step=START_SOURCE_AGAIN
    )
    return both | {name: replace(both[name], level=level)}


def reason(rule, axes):
    sentence = "the recording reveals only errors above 12 cm along x, 19 cm y, 40 cm z"
    return Reason(
        rule.name, rule.verdict, sentence, "compare with a tape", axes
    )


def judged(rule, axes=("x", "y", "z")):
    """A result with one reason."""
    problem, step = of_reason(reason(rule, axes))
    verdict = rule.verdict.value
    fact = "Errors larger than 12 cm along x would have been noticed"
    reasons = ("the recording reveals only errors above 12 cm: compare",)
    return replace(
        RESULT,
        verdict=verdict,
        caution=problem,
        step=step,
        facts=(fact,),
        reasons=reasons,
    )


UNDETECTABLE = next(rule for rule in RULES if rule.name == "undetectable")
CONTRADICTED = next(rule for rule in RULES if rule.name == "prior")
PUBLISHERS = publishers_in_words(["/peer", "/peer"])
FAULT = replace(
    CHECKS,
    level=Level.WARN,
    text="the extrinsic changes 60 s after the start by 2.9 deg: tighten it",
    gravest="the extrinsic changes 60 s after the start by 2.9 deg",
    step=step_after(
        replace(
            written_finding(
                "mount_moved", Severity.ERROR, "moves", "tighten it"
            ),
            code="mount_moved",
        )
    ),
    needs_reset=True,
)


def moved():
    """A comparison in which every axis has moved."""
    row = AxisDifference(
        difference=0.15, sigma=0.004, visible=0.01, verdict="moved"
    )
    difference = Difference(
        first="a",
        second="b",
        verdict="moved",
        sentence="",
        axes=dict.fromkeys(AXIS_KEYS.values(), row),
    )
    return Comparison(
        sentence="moved: x by +15 cm +/- 4 mm",
        verdict="moved",
        differences=(difference,),
    )


GOOD = replace(EXTRINSIC, motion_s=83.0)
CARE = replace(GOOD, result=judged(UNDETECTABLE))
REFUTED = replace(
    EXTRINSIC,
    level=Level.WARN,
    text="DO NOT USE: the prior on z is 158 standard deviations from the motion",
    motion_s=40.0,
    standing=Standing.REFUTED,
    priors={"z": "1.5+/-0.01"},
    contradicted=("z",),
    result=judged(CONTRADICTED, ("z",)),
)
NO_USE = replace(SAVED, verdict="DO NOT USE", text="DO NOT USE: the prior on z")

SCREENS = {
    "no node": None,
    "no publisher": state(
        extrinsic=moving(0.0),
        at=at("No result yet: move the sensors, with rotations."),
        inputs=stream(
            "parent",
            "no message on /parent_odom yet: 0 publishers",
            step=START_SOURCE,
            messages=0,
        ),
    ),
    "nothing moves": state(
        extrinsic=moving(0.0),
        at=at("No result yet: move the sensors, with rotations."),
    ),
    "first seconds": state(
        extrinsic=moving(3.0),
        at=at(too_little_in_words(seen(3.0, (0.0, 0.0, 21.0)))),
    ),
    "first seconds, turned": state(
        extrinsic=moving(3.0),
        at=at(too_little_in_words(seen(3.0, (0.0, 0.0, 40.0)))),
    ),
    "streams do not pair": state(
        extrinsic=moving(
            0.0, text="10 synchronised pose pairs are needed, found 0"
        ),
        at=at(NO_PAIRS),
    ),
    "no height yet": state(
        extrinsic=moving(25.0),
        at=at(
            f"z cannot be determined from the motion so far. {HAND}",
            by_hand=("z",),
        ),
    ),
    "not converged": state(
        extrinsic=moving(24.0),
        at=at(no_result_in_words("the solver did not converge")),
    ),
    "flat": state(
        axes=HEIGHT_UNKNOWN,
        extrinsic=GOOD,
        at={
            "sentence": f"z is not determined well enough yet. {HAND}",
            "by_hand": ("z",),
        },
    ),
    "ramps": state(
        axes=HEIGHT_UNKNOWN,
        extrinsic=GOOD,
        at={
            "sentence": "z is not determined well enough yet. This motion is right: continue it.",
        },
    ),
    "time left": state(
        extrinsic=GOOD,
        at={
            "sentence": "Go on for about 90 s, z takes longest. This motion is right: continue it."
        },
    ),
    "change": state(
        axes=HEIGHT_UNKNOWN,
        extrinsic=GOOD,
        level=Level.WARN,
        at={
            "sentence": f"This motion will not determine z well enough. {HAND}",
            "will_not_get_there": True,
            "by_hand": ("z",),
        },
    ),
    "target": state(
        extrinsic=GOOD,
        level=Level.WARN,
        at={
            "sentence": "No motion makes z good to 2 mm. Constant errors alone may be 5 mm. "
            "Stop and save, or set a larger target.",
            "target_is_too_small": True,
            "will_not_get_there": True,
        },
    ),
    "confirming": state(
        extrinsic=GOOD,
        at=at(
            "Confirming, 20 s: every axis is within its target. Go on.",
            axes=full_bars(),
        ),
    ),
    "done": state(extrinsic=GOOD, at=DONE),
    "done, saved": state(extrinsic=GOOD, at=DONE, saved=SAVED),
    "done, moved": state(extrinsic=GOOD, at=DONE, comparison=moved()),
    "done with care": state(extrinsic=CARE, at=DONE),
    "done with care, moved": state(extrinsic=CARE, at=DONE, comparison=moved()),
    "one stream is silent": state(extrinsic=GOOD, inputs=silent("child")),
    "parked": state(
        extrinsic=GOOD,
        inputs={
            name: replace(part, is_paused=True, level=Level.OK)
            for name, part in silent("child").items()
        },
        is_paused=True,
    ),
    "two publishers": state(
        extrinsic=GOOD,
        inputs=stream(
            "child",
            f"/child_odom has {PUBLISHERS}. Stop all but one, then reset",
            needs_reset=True,
        ),
    ),
    "had two publishers": state(
        extrinsic=GOOD,
        inputs=stream(
            "child",
            f"/child_odom had {PUBLISHERS}. Their poses are mixed: reset",
            needs_reset=True,
        ),
    ),
    "bad input": state(inputs=inputs(child=Level.ERROR)),
    "lost messages": state(
        inputs=stream(
            "child",
            "12 % of the messages are lost. "
            "Free processor time, or publish at a lower rate",
        )
    ),
    "the mount was knocked": state(
        extrinsic=GOOD,
        checks=FAULT,
        at={
            "is_faulty": True,
            "axes": full_bars(),
            "sentence": "Stop: the streams differ.",
        },
    ),
    "a fault without a check": state(
        extrinsic=GOOD,
        at={
            "is_faulty": True,
            "axes": full_bars(),
            "sentence": "Stop: the streams differ.",
        },
    ),
    "a value contradicts": state(
        extrinsic=REFUTED, level=Level.WARN, at=at("No usable result: a prior.")
    ),
    "outdated": state(
        extrinsic=replace(
            GOOD,
            level=Level.WARN,
            text="USE, but every solve has failed for 60 s: no overlap; the result is old",
            standing=Standing.OUTDATED,
        ),
        level=Level.WARN,
    ),
    "a defect": state(
        extrinsic=replace(EXTRINSIC, level=Level.ERROR, text="a " * 20)
    ),
    "no disk": state(extrinsic=GOOD, journal=FULL),
    "ended": replace(
        state(extrinsic=GOOD, at=DONE, saved=SAVED), has_ended=True
    ),
    "ended before it was confirmed": replace(
        state(extrinsic=GOOD, saved=SAVED), has_ended=True
    ),
    "ended with care": replace(
        state(
            extrinsic=CARE,
            at=DONE,
            saved=replace(SAVED, verdict="USE WITH CARE"),
        ),
        has_ended=True,
    ),
    "ended, not to be used": replace(
        state(
            extrinsic=REFUTED, at=at("No usable result: a prior."), saved=NO_USE
        ),
        has_ended=True,
    ),
    "ended before a result": replace(
        state(extrinsic=moving(9.0), at=at("No result yet.")), has_ended=True
    ),
    "monitor": mount(),
    "monitor learns": mount(is_learning=True),
}


@pytest.mark.parametrize("name", SCREENS)
def test_the_texts_of_a_screen_agree(name):
    document = SCREENS[name]
    view = view_of(document)
    if document is not None:
        assert list(faults_of(view, document)) == []
    # Page and terminal display the same sentences.
    for sentence in (view.word, view.sentence):
        assert sentence in terminal.lines(view)[0]
        assert sentence.replace("'", "&#x27;") in fragment(view)


@pytest.mark.parametrize("rule", RULES, ids=[rule.name for rule in RULES])
@pytest.mark.parametrize("axes", [(), ("z",), AXES[:5], AXES], ids=len)
def test_a_session_is_done_with_each_reason_in_a_few_words(rule, axes):
    extrinsic = replace(GOOD, result=judged(rule, tuple(axes)))
    verdict = rule.verdict.value
    saved = replace(SAVED, verdict=verdict)
    documents = [
        replace(state(extrinsic=extrinsic, saved=saved), has_ended=True)
    ]
    if rule.verdict is not Verdict.DO_NOT_USE:
        documents.append(state(extrinsic=extrinsic, at=DONE))
    for document in documents:
        view = view_of(document)
        assert list(faults_of(view, document)) == []
        assert verdict in view.text
        assert extrinsic.result.caution in view.text


@pytest.mark.parametrize("has_options", [False, True])
@pytest.mark.parametrize("severity", [Severity.ERROR, Severity.WARNING])
@pytest.mark.parametrize("code", ["mount_moved", "interleaved", "lengths"])
@pytest.mark.parametrize("n_words", [4, 40])
def test_a_fault_of_the_streams_has_a_next_step(
    code, severity, has_options, n_words
):
    options = {"time_offset": 0.02} if has_options else {}
    advice = "correct " + "that " * n_words
    fault = written_finding(
        code, severity, "a " * n_words, advice, options=options
    )
    is_reset = fault.makes_unusable and not has_options
    checks = replace(
        FAULT, gravest=fault.what, step=step_after(fault), needs_reset=is_reset
    )
    document = state(extrinsic=GOOD, checks=checks)
    view = view_of(document)
    assert list(faults_of(view, document)) == []
    assert (view.word, view.asked) == (
        "CHECK THE STREAMS",
        "reset" if is_reset else "",
    )


BROKEN = {
    "a verdict that is not named": (
        SCREENS["done with care"],
        {"sentence": "Good."},
    ),
    "two times left": (SCREENS["time left"], {"advice": "Confirming, 20 s."}),
    "no step": (SCREENS["one stream is silent"], {"advice": ""}),
    "a reset out of reach": (SCREENS["two publishers"], {"asked": ""}),
    "no field": (SCREENS["flat"], {"by_hand": ()}),
    "jargon": (SCREENS["flat"], {"sentence": "Raise max_gap by hand."}),
    "too long": (SCREENS["flat"], {"sentence": "a " * 16 + "by hand."}),
    "a name twice": (
        SCREENS["two publishers"],
        {"sentence": "/a and /a: reset."},
    ),
    "a form after the end": (SCREENS["ended"], {"by_hand": ("z",)}),
    "START while moving": (SCREENS["not converged"], {"word": "START"}),
    "early advice": (
        SCREENS["first seconds"],
        {"sentence": "z cannot be determined."},
    ),
    "bars that are not full": (SCREENS["time left"], {"word": "DONE"}),
    "a good input without poses": (
        SCREENS["time left"],
        {"sentence": "No poses of parent."},
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_the_rules_find_a_screen_that_contradicts_itself(name):
    document, fields = BROKEN[name]
    view = view_of(document)
    assert not list(faults_of(view, document))
    assert list(faults_of(replace(view, **fields), document))


def moved_by(metres):
    """A comparison with the installed transform: z has changed."""
    unmoved = AxisDifference(
        difference=0.0, sigma=0.004, visible=0.01, verdict="same"
    )
    z = replace(unmoved, difference=metres, verdict="moved")
    axes = dict.fromkeys(AXIS_KEYS.values(), unmoved) | {"z": z}
    difference = Difference(
        first="a", second="b", verdict="moved", sentence="", axes=axes
    )
    return Comparison(
        sentence="moved", verdict="moved", differences=(difference,)
    )


@pytest.mark.parametrize(
    ("parts", "tone", "start"),
    [
        ({"at": DONE}, Tone.GOOD, "The node has ended. The result was saved"),
        ({}, Tone.ACT, "The result was saved at "),
        (
            {"at": DONE, "comparison": moved_by(0.15)},
            Tone.ACT,
            "camera HAS MOVED by 15 cm. The result was saved at ",
        ),
    ],
    ids=["done", "not confirmed", "moved"],
)
def test_the_end_states_what_the_saved_result_is(parts, tone, start):
    ended = replace(state(extrinsic=GOOD, saved=SAVED, **parts), has_ended=True)
    view = view_of(ended)
    assert (view.word, view.tone) == ("ENDED", tone)
    assert view.sentence.startswith(start)
    assert ("confirmed" in view.sentence) == (not parts)
    assert list(faults_of(view, ended)) == []


def test_the_angles_are_explained_at_the_end():
    words = "roll and yaw vary together at pitch 52 deg"
    extrinsic = replace(EXTRINSIC, result=replace(RESULT, angles=words))
    view = view_of(state(at=REACHED, extrinsic=extrinsic))
    assert [line.text for line in view.result if line.name == "angles"] == [
        words
    ]
    assert words not in fragment(view_of(state(extrinsic=extrinsic)))


def test_the_end_names_the_reason_why_nothing_is_saved():
    ended = replace(state(), has_ended=True, can_save=False)
    assert view_of(ended).text == (
        "The node has ended. The result is not saved, because output_directory is not set."
    )


def test_the_age_of_a_shift_does_not_grow_after_the_end():
    ended = replace(
        mount(
            shift={"x": 0.1},
            shift_sigma={"x": 0.01},
            since_ns=1,
            newest_ns=74 * 10**9,
        ),
        has_ended=True,
    )
    assert view_of(ended).facts == "moved 74 s before the last motion"


def test_after_an_alarm_an_uncertain_axis_is_not_called_unmoved():
    document = mount(
        shift={"x": 0.7, "y": 0.0},
        shift_sigma={"x": 0.1, "y": 0.25},
        visible_10min={"x": 0.017, "y": 0.017},
    )
    (line,) = (
        line for line in view_of(document).watched if line.name == "along y"
    )
    assert line.text == "cannot tell (± 25 cm)"
    assert line.tone is Tone.UNKNOWN


@pytest.mark.parametrize("is_learning", [True, False])
def test_the_end_of_a_short_monitored_session_names_the_missing_digest(
    is_learning,
):
    ended = replace(mount(is_learning=is_learning), has_ended=True)
    assert ("It wrote no digest" in view_of(ended).advice) == is_learning


@pytest.mark.parametrize(
    ("shared_names", "is_shared"),
    [((), False), (("/other",), False), ((NODE,), True)],
)
@pytest.mark.parametrize(
    "document",
    [state(), state(at=REACHED), mount()],
    ids=["on", "done", "mount"],
)
def test_nodes_of_one_name_have_one_headline_and_no_buttons(
    document, shared_names, is_shared
):
    board = Board()
    board.shared_names = frozenset(shared_names)
    board.take(document, 0.0)
    view = board.view(0.5)
    text = f"Two nodes are named {NODE}."
    assert (text in view.text) is is_shared
    if is_shared:
        assert view.word == "CHECK INPUT"
        assert view.advice == "Stop one of them, or set another ROS_DOMAIN_ID."
        assert (view.buttons, view.values, view.saved_in) == ((), (), "")
        assert list(faults_of(view, document)) == []
