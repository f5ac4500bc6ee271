"""Rules for the screens of ``watch``: do all texts of a screen agree, and is there a next step?"""

import re

from hand_eye_calib.online.live.brief import MAX_WORDS
from hand_eye_calib.online.watch.headline import (
    CHANGE_MOTION,
    CHANGE_TARGET,
    DONE,
    MOVED,
)
from hand_eye_calib.online.watch.view import Tone

# Words of parameters, topics and algorithms, which a driver does not know.
JARGON = (
    r"\bpriors?\b|max_gap|tf_static|synchronised|xyz =|adaptive|\bpairs\b|->"
)

# Verbs of next steps. Every screen that requires a person has one of them.
STEPS = (
    "acknowledge|check|compare|continue|correct|drive|go on|keep moving|look|measure|mend|"
    "move|read|recalibrate|record|remove|reset|rotate|save|set|start|stop|tighten|tilt|wait|free|call"
)

# Times left: of the drive, and of the confirmation.
TIMES_LEFT = (
    r"(?:about|Confirming,) [\d.]+ (?:s|min|h)\b|[\d.]+ (?:s|min|h) left"
)


def sentences_of(view):
    """Return the sentences of a headline."""
    return [
        text
        for text in re.split(r"(?<=[.!?]) |(?<=[A-Z]:) ", view.text)
        if text
    ]


def faults_of(view, state):
    """Yield each contradiction on the screen of a state, and each rule that it breaks."""
    yield from _faults_of_the_headline(view)
    yield from _faults_of_the_verdict(view, state)
    yield from _faults_of_requests(view, state)
    yield from _faults_of_the_motion(view, state)
    yield from _faults_of_inputs(view, state)


def _faults_of_the_headline(view):
    for sentence in sentences_of(view):
        if len(sentence.split()) > MAX_WORDS:
            yield f"more than {MAX_WORDS} words: {sentence}"
    own_texts = [view.text, *(bar.word for bar in view.bars)]
    own_texts += [line.name for line in view.result + view.health]
    for text in own_texts:
        if re.search(JARGON, text, re.IGNORECASE):
            yield f"jargon: {text}"
    for line in view.result:
        if line.name == "note" and "xyz =" in line.text:
            yield f"a line of the log: {line.text}"
    if repeated := re.search(r"(\S+) and \1\b", view.text):
        yield f"a name twice: {repeated[0]}"
    times = re.findall(TIMES_LEFT, " ".join(own_texts))
    if len(times) > 1:
        yield f"several times left: {times}"
    if view.tone in (Tone.ACT, Tone.BAD) and not re.search(
        rf"\b(?:{STEPS})\b", view.text, re.IGNORECASE
    ):
        yield f"no next step: {view.word}: {view.text}"


def _faults_of_the_verdict(view, state):
    verdict = state.result.verdict if state.result else "USE"
    is_final = view.word == DONE or (view.word == "ENDED" and state.saved)
    if is_final and verdict != "USE" and verdict not in view.text:
        yield f"{verdict} is not in {view.text!r}"
    if is_final and verdict != "USE" and view.tone is Tone.GOOD:
        yield f"{verdict} with the tone of success"
    bad_lines = [line for line in view.result if line.tone is Tone.BAD]
    if view.tone is Tone.GOOD and bad_lines:
        yield f"success beside {bad_lines}"
    evidence = [line for line in view.result if line.name == "evidence"]
    if evidence and verdict != "USE":
        yield f"{verdict} beside evidence with the tone of success"
    saved = [line.tone for line in view.result if line.name == "saved"]
    if (
        view.word == "ENDED"
        and view.tone is not Tone.GOOD
        and Tone.GOOD in saved
    ):
        yield "the end is no success, the saved result is"


def _faults_of_requests(view, state):
    is_over = view.word in ("ENDED", "SILENT")
    if is_over:
        if view.by_hand or view.buttons or view.asked:
            yield "requests to a node that does not answer"
        return
    asks_reset = re.search(r"\breset\b", view.text) and view.word != MOVED
    if asks_reset and not (view.asked == "reset" and "reset" in view.buttons):
        yield "a reset is asked for, and not within reach"
    asks_save = re.search(r"\b[Ss]top and save\b|\bSave[.:]", view.text)
    if asks_save and "save" not in view.buttons:
        yield "a save is asked for, and not possible"
    if view.asked and view.asked not in view.buttons:
        yield f"{view.asked} is asked for, and not possible"
    if "by hand" in view.text and not view.by_hand:
        yield "a measurement by hand is proposed, and there is no field for it"
    contradicted = state.extrinsic.contradicted if state.extrinsic else ()
    if contradicted and "save" in view.buttons:
        yield "save is offered beside a value that the motion contradicts"


def _faults_of_the_motion(view, state):
    extrinsic = state.extrinsic
    if extrinsic is None or state.progress is None:
        return
    if view.word == "START" and (extrinsic.motion_s > 0.0 or state.result):
        yield f"START after {extrinsic.motion_s:.0f} s of motion"
    is_early = extrinsic.motion_s < 20.0 and not state.result
    has_advice = "cannot be determined" in view.text
    if is_early and (
        has_advice or view.word in (CHANGE_MOTION, CHANGE_TARGET, DONE)
    ):
        yield f"advice after {extrinsic.motion_s:.0f} s of motion: {view.text}"
    is_full = [bar.share >= 1.0 for bar in view.bars]
    if (view.word == DONE or "Confirming" in view.text) and not all(is_full):
        yield f"{view.text} with a bar that is not full"
    if state.progress.progress.is_faulty and any(
        bar.share for bar in view.bars
    ):
        yield "bars of faulty streams look good"
    words = {bar.word for bar in view.bars}
    if "motion is right" in view.text and "not with this motion" in words:
        yield "the motion is right, and a bar denies it"


def _faults_of_inputs(view, state):
    tones = {line.name: line.tone for line in view.health}
    for name, stream in state.inputs.items():
        lacks = re.search(
            rf"[Nn]o (?:poses?|message)[^.]*\b(?:{name}|{stream.topic})\b",
            view.text,
        )
        if lacks and tones.get(f"{name} input") is Tone.GOOD:
            yield f"{lacks[0]}, and the input is good"
        if view.topics and any(
            topic.startswith(stream.topic) for topic in view.topics
        ):
            yield f"{stream.topic} is displayed twice, with other facts"
    is_paused = any(stream.is_paused for stream in state.inputs.values())
    if is_paused and re.search(r"result .* old", view.facts):
        yield "the age of a result while its streams are silent"
