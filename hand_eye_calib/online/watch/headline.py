"""The headline of a node: its most important fact, in a word and a sentence."""

import math
from collections.abc import Iterator
from datetime import datetime
from typing import NamedTuple

from hand_eye_calib.core.base.text import AXIS_UNITS, amount, axes_in_words, capital
from hand_eye_calib.core.results.context import Difference
from hand_eye_calib.online.live.progress import AXIS_KEYS
from hand_eye_calib.online.live.state import (
    ChecksState,
    ExtrinsicState,
    Level,
    NodeState,
    Part,
    ProgressState,
    SavedState,
    Standing,
)
from hand_eye_calib.online.watch.view import Tone

# Words of headlines with which certain buttons are displayed.
MOVED = "MOUNT MOVED"
CHANGE_MOTION = "CHANGE THE MOTION"
CHANGE_TARGET = "CHANGE THE TARGET"
DONE = "DONE"


# Most words of a text in a headline: a person at the machine reads it aloud in one breath. Longer
# texts are on the same page below the headline.
_MAX_WORDS = 15


class Headline(NamedTuple):
    """The most important fact about a node.

    Attributes
    ----------
    tone : Tone
    word : str
        One or two words in capitals.
    sentence : str
    advice : str
        What to do; empty if the sentence contains it.
    """

    tone: Tone
    word: str
    sentence: str
    advice: str = ""


def headline_of(state: NodeState, silent_s: float) -> Headline:
    """Return the headline of a node.

    ``silent_s`` is the time (s) since the last message of a node that is silent, otherwise 0.
    """
    if state.has_ended:
        return _end(state)
    if silent_s:
        return _silence(state, silent_s)
    return _alarm(state) or _activity(state)


def _alarm(state: NodeState) -> Headline | None:
    """Return the gravest condition that requires a person; None if there is none."""
    for tone, word, level, part in _conditions(state):
        if part is not None and part.level is level:
            advice = (
                "Check it, then recalibrate or acknowledge." if word == MOVED else ""
            )
            return Headline(tone, word, _sentence(_headline_text(part)), advice)
    return None


def _headline_text(part: Part) -> str:
    """Return the text of a part in a condition that requires a person."""
    if (
        isinstance(part, ExtrinsicState)
        and part.contradicted
        and part.level is Level.WARN
    ):
        priors = f"the prior on {axes_in_words(part.contradicted)}"
        return (
            f"{priors} contradicts the motion. Check value, unit and sign, or remove it"
        )
    if not isinstance(part, ChecksState) or not part.gravest:
        return part.text
    return _in_one_breath(
        part.gravest, "the streams have a fault: read the checks below"
    )


def _in_one_breath(text: str, otherwise: str) -> str:
    """Return a text if a person can read it aloud in one breath, otherwise another text."""
    return text if len(text.split()) <= _MAX_WORDS else otherwise


def _conditions(state: NodeState) -> Iterator[tuple[Tone, str, Level, Part | None]]:
    """Yield conditions, the gravest first.

    A condition has the tone and the word of its headline, a level, and a part of the node. The node
    is in this condition if the part has the level.
    """
    extrinsic = state.extrinsic
    checks = state.checks
    # The inputs of further child sensors are displayed, but do not become a headline.
    inputs = [
        stream for name, stream in state.inputs.items() if name in ("parent", "child")
    ]
    yield Tone.BAD, "BROKEN", Level.ERROR, extrinsic
    yield Tone.BAD, MOVED, Level.ERROR, state.mount
    if extrinsic and extrinsic.contradicted:
        yield Tone.BAD, "CHECK THE PRIOR", Level.WARN, extrinsic
    for stream in inputs:
        yield Tone.BAD, "BAD INPUT", Level.ERROR, stream
    yield Tone.BAD, "BROKEN", Level.ERROR, None if _is_saved(state) else state.journal
    for stream in inputs:
        is_paused = stream.is_paused and state.progress is not None
        yield Tone.ACT, "PAUSED" if is_paused else "CHECK INPUT", Level.WARN, stream
    if checks and checks.age_s is not None:
        yield Tone.ACT, "CHECK THE STREAMS", Level.WARN, checks
    if state.standing is Standing.OUTDATED:
        yield Tone.ACT, "OLD RESULT", Level.WARN, extrinsic
    yield Tone.ACT, "NOT WATCHING", Level.WARN, state.mount


def _is_saved(state: NodeState) -> bool:
    """Whether the final result is saved, so that a crash loses nothing."""
    is_done = state.progress is not None and state.progress.progress.done
    return is_done and state.saved is not None


def _activity(state: NodeState) -> Headline:
    """Return the headline of a node without an alarm."""
    if state.mount is not None:
        sentence = _sentence(state.mount.text)
        if state.mount.is_learning:
            return Headline(Tone.BUSY, "LEARNING", sentence)
        return Headline(Tone.GOOD, "WATCHING", sentence)
    session = state.progress
    if session is None:
        text = "The node runs, and has no result yet."
        return Headline(Tone.UNKNOWN, "LISTENING", text)
    sentence = _sentence(session.text)
    # Streams may become faulty after the goal is reached.
    if session.progress.is_faulty:
        return Headline(Tone.ACT, "CHECK THE STREAMS", sentence)
    if session.progress.done:
        return _at_goal(state, session)
    tone = Tone.BUSY if session.level is Level.OK else Tone.ACT
    if session.is_paused:
        return Headline(tone, "PAUSED", sentence)
    # Until the next result, neither bars nor advice change, whatever the person does.
    slow = state.extrinsic.slow if state.extrinsic else ""
    if state.result is None:
        return Headline(Tone.BUSY, "START", sentence, slow)
    if session.progress.target_is_too_small:
        return Headline(tone, CHANGE_TARGET, sentence, slow)
    return Headline(
        tone, "GO ON" if tone is Tone.BUSY else CHANGE_MOTION, sentence, slow
    )


def _at_goal(state: NodeState, session: ProgressState) -> Headline:
    """Return the headline of a session that has reached its goal.

    If the sensor has moved against the installed transform, the sentence states by how much.
    Otherwise the sentence states the precision. If the verdict is not ``USE``, the advice contains
    the gravest reason.
    """
    tone = Tone.GOOD
    sentence = _sentence(session.progress.precision)
    advice = "Stop and save."
    caution = ""
    if state.result and state.result.verdict != "USE":
        tone = Tone.ACT
        reasons = [
            _in_one_breath(reason, "read the reasons below")
            for reason in state.result.reasons[:1]
        ]
        caution = _sentence(": ".join((state.result.verdict, *reasons)))
    if state.result and session.comparison and session.comparison.verdict == "moved":
        tone = Tone.ACT
        displacement = _displacement(session.comparison.differences[0])
        sentence = f"{state.result.child_frame} HAS MOVED by {displacement}."
        advice = "Save."
    if state.saved:
        sentence = f"{sentence} Saved {saved_at(state.saved)}."
        advice = ""
    return Headline(tone, DONE, sentence, f"{advice} {caution}".strip())


def _displacement(difference: Difference) -> str:
    """Return distance and angle by which the moved axes differ from the installed transform.

    The bars contain the change of each axis. If no single axis has moved, all axes that are
    determined count.
    """
    known = [key for key, row in difference.axes.items() if math.isfinite(row.sigma)]
    moved = [key for key in known if difference.axes[key].verdict == "moved"]
    squares = {"m": 0.0, "rad": 0.0}
    for axis, key in AXIS_KEYS.items():
        if key in (moved or known):
            squares[AXIS_UNITS[axis]] += difference.axes[key].difference ** 2
    parts = []
    for axis in ("x", "yaw"):
        size = math.sqrt(squares[AXIS_UNITS[axis]])
        if size > 0.0:
            parts.append(amount(axis, size))
    return " and ".join(parts)


def _silence(state: NodeState, silent_s: float) -> Headline:
    """Return the headline of a node that no longer sends its state."""
    text = (
        f"No message from the node for {silent_s:.0f} s. Wait if the computer is busy. "
        "If the node has died, start it again"
    )
    if state.journal and state.journal.directory:
        text += ", with journal:=resume"
    return Headline(Tone.BAD, "SILENT", f"{text}.")


def _end(state: NodeState) -> Headline:
    """Return the headline of a node that has ended."""
    tone = Tone.ACT
    saved = state.saved
    text = "The node has ended"
    if state.mount is not None:
        text += ": the mount is not monitored."
    elif saved is not None:
        text += f". The result was saved {saved_at(saved)}."
        if saved.verdict == "DO NOT USE":
            text += f" {_sentence(saved.text)}"
        else:
            tone = Tone.GOOD
    elif state.result:
        text += ". The result is not saved: the log contains the reason."
    else:
        text += ". There was no result yet."
    return Headline(tone, "ENDED", text)


def typeset(text: str) -> str:
    """Return a text with the sign ± in place of +/-."""
    return text.replace("+/-", "±")


def _sentence(text: str) -> str:
    """Return a text as a sentence, with a capital letter and a full stop."""
    text = capital(typeset(text))
    return text if text.endswith((".", "!", "?")) else f"{text}."


def saved_at(saved: SavedState) -> str:
    """Return time of day and directory of a saved result."""
    return f"at {datetime.fromtimestamp(saved.at_s):%H:%M} in {saved.directory}"
