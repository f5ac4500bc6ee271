"""Headline of a node: its most important fact, as a word and a sentence.

:func:`headline_of` alone decides what a person at the machine should do first. The page and the
terminal of ``watch``, the topics and the log contain its headline.
"""

import math
from collections.abc import Iterator
from datetime import datetime
from typing import NamedTuple

from hand_eye_calib.core.base.text import (
    AXIS_UNITS,
    amount,
    axes_in_words,
    capital,
    duration,
    listing,
)
from hand_eye_calib.core.results.context import Difference
from hand_eye_calib.online.live.brief import (
    RESET_AFTER_REPAIR,
    START_SOURCE_AGAIN,
    in_one_breath,
)
from hand_eye_calib.online.live.progress import AXIS_KEYS
from hand_eye_calib.online.live.state import (
    ChecksState,
    ExtrinsicState,
    InputState,
    Level,
    MountState,
    NodeState,
    Part,
    ProgressState,
    ResultState,
    SavedState,
    Standing,
)
from hand_eye_calib.online.watch.view import Tone

# Words of headlines that certain buttons depend on.
MOVED = "MOUNT MOVED"
CHANGE_MOTION = "CHANGE THE MOTION"
CHANGE_TARGET = "CHANGE THE TARGET"
CHECK_VALUE = "CHECK THE VALUE"
CHECK_STREAMS = "CHECK THE STREAMS"
DONE = "DONE"

_ACKNOWLEDGE = "Check the mount, then recalibrate or acknowledge."


class Headline(NamedTuple):
    """Most important fact about a node.

    Attributes
    ----------
    tone : Tone
    word : str
        One or two words in capitals.
    sentence : str
    advice : str
        Next action; empty if the sentence contains it.
    request : str
        Recommended request of ``view.KEYS``; empty if there is none.
    """

    tone: Tone
    word: str
    sentence: str
    advice: str = ""
    request: str = ""

    @property
    def line(self) -> str:
        """The headline in one line, for the log and for topics."""
        return f"{self.word}: {self.sentence} {self.advice}".rstrip()


def headline_of(state: NodeState, silent_s: float = 0.0) -> Headline:
    """Return the headline of a node.

    ``silent_s`` is the time (s) since the last message of a silent node, and 0 for other nodes.
    """
    if state.has_ended:
        return _end(state)
    if silent_s:
        return _silence(state, silent_s)
    return _alarm(state) or _activity(state)


def _alarm(state: NodeState) -> Headline | None:
    """Return the gravest condition on which a person must act, or None."""
    for condition in _conditions(state):
        part = condition.part
        if part is not None and part.level is condition.level:
            text = condition.text or part.text
            sentence = _sentence(
                in_one_breath(text, condition.otherwise or text)
            )
            return Headline(
                condition.tone,
                condition.word,
                sentence,
                condition.advice,
                condition.request,
            )
    return None


class _Condition(NamedTuple):
    """Condition of a node. The node is in this condition if ``part`` has the level ``level``.

    Attributes
    ----------
    tone, word, advice, request
        See :class:`Headline`.
    level : Level
    part : Part or None
    text : str
        Text of the headline; by default the text of the part.
    otherwise : str
        Text of the headline if ``text`` is too long.
    """

    tone: Tone
    word: str
    level: Level
    part: Part | None
    advice: str = ""
    request: str = ""
    text: str = ""
    otherwise: str = ""


def _conditions(state: NodeState) -> Iterator[_Condition]:
    """Yield the conditions on which a person must act, the gravest first."""
    # Inputs of further child sensors are displayed, but never in the headline.
    inputs = [
        stream
        for name, stream in state.inputs.items()
        if name in ("parent", "child")
    ]
    yield _Condition(
        Tone.BAD,
        "BROKEN",
        Level.ERROR,
        state.extrinsic,
        advice="Look at the log. The next solve may succeed.",
        otherwise="the solve failed unexpectedly",
    )
    yield _Condition(
        Tone.BAD, MOVED, Level.ERROR, state.mount, _ACKNOWLEDGE, "recalibrate"
    )
    extrinsic = state.extrinsic
    if extrinsic and extrinsic.contradicted:
        yield _of_priors(extrinsic)
    for stream in inputs:
        yield _Condition(
            Tone.BAD,
            "BAD INPUT",
            Level.ERROR,
            stream,
            "Correct the source of the poses.",
            otherwise=f"messages on {stream.topic} are unusable",
        )
    yield _Condition(
        Tone.BAD,
        "BROKEN",
        Level.ERROR,
        None if _is_saved(state) else state.journal,
        "Save: a crash would lose the session.",
        "save",
        text="the session cannot be written to the disk",
    )
    for stream in inputs:
        yield _of_input(stream, state)
    if state.checks and state.checks.age_s is not None:
        yield _of_checks(state.checks)
    if state.standing is Standing.OUTDATED:
        yield _Condition(
            Tone.ACT,
            "OLD RESULT",
            Level.WARN,
            extrinsic,
            "Drive on. If this stays, reset.",
            "reset",
            text="the newest solves fail, and the result is older",
        )
    yield _Condition(Tone.ACT, "NOT WATCHING", Level.WARN, state.mount)


def _of_priors(extrinsic: ExtrinsicState) -> _Condition:
    """Return the condition that the motion contradicts priors."""
    axes = axes_in_words(extrinsic.contradicted)
    return _Condition(
        Tone.BAD,
        CHECK_VALUE,
        Level.WARN,
        extrinsic,
        "Correct the value (number, unit, sign), or remove it.",
        text=f"the value typed in for {axes} contradicts the motion",
    )


def _of_input(stream: InputState, state: NodeState) -> _Condition:
    """Return the condition of an input without poses, or with unsuitable poses."""
    is_paused = stream.is_paused and state.progress is not None
    return _Condition(
        Tone.ACT,
        "PAUSED" if is_paused else "CHECK INPUT",
        Level.WARN,
        stream,
        stream.step,
        "reset" if stream.needs_reset else "",
    )


def _of_checks(checks: ChecksState) -> _Condition:
    """Return the condition of faulty streams."""
    otherwise = ""
    if checks.gravest:
        otherwise = "the streams have a fault: read the checks below"
    return _Condition(
        Tone.ACT,
        CHECK_STREAMS,
        Level.WARN,
        checks,
        checks.step,
        "reset" if checks.needs_reset else "",
        checks.gravest,
        otherwise,
    )


def _is_saved(state: NodeState) -> bool:
    """Return whether the final result is saved, so that a crash loses nothing."""
    is_done = state.progress is not None and state.progress.progress.done
    return is_done and state.saved is not None


def _activity(state: NodeState) -> Headline:
    """Return the headline of a node without an alarm."""
    if state.mount is not None:
        return _monitoring(state.mount)
    session = state.progress
    if session is None:
        text = "The node runs, and has no result yet."
        return Headline(Tone.UNKNOWN, "LISTENING", text)
    sentence = _sentence(session.text)
    # Streams may become faulty after the goal is reached.
    if session.progress.is_faulty:
        text = in_one_breath(
            sentence, "The streams have a fault: read the reasons below."
        )
        return Headline(
            Tone.ACT, CHECK_STREAMS, text, RESET_AFTER_REPAIR, "reset"
        )
    if session.progress.done:
        return _at_goal(state, session)
    tone = Tone.BUSY if session.level is Level.OK else Tone.ACT
    if session.is_paused:
        return _pause(tone, state, sentence)
    return _under_way(tone, state, session)


def _under_way(
    tone: Tone, state: NodeState, session: ProgressState
) -> Headline:
    """Return the headline of a session with poses that has not reached its goal."""
    sentence = _sentence(session.text)
    # Before the next result, neither bars nor advice change.
    slow = state.extrinsic.slow if state.extrinsic else ""
    if state.result is None:
        has_moved = (
            state.extrinsic is not None and state.extrinsic.motion_s > 0.0
        )
        return Headline(
            Tone.BUSY, "GO ON" if has_moved else "START", sentence, slow
        )
    if session.progress.target_is_too_small:
        return Headline(tone, CHANGE_TARGET, sentence, slow, "save")
    return Headline(
        tone, "GO ON" if tone is Tone.BUSY else CHANGE_MOTION, sentence, slow
    )


def _monitoring(mount: MountState) -> Headline:
    """Return the headline of a node that monitors a mount, without an alarm."""
    sentence = _sentence(mount.text)
    if mount.is_learning:
        return Headline(Tone.BUSY, "LEARNING", sentence)
    return Headline(Tone.GOOD, "WATCHING", sentence)


def _pause(tone: Tone, state: NodeState, sentence: str) -> Headline:
    """Return the headline of a session without new poses: ``sentence`` if the inputs are silent."""
    paused = {
        name: stream
        for name, stream in state.inputs.items()
        if stream.is_paused
    }
    if not paused:
        return Headline(tone, "PAUSED", sentence)
    longest_s = max(stream.silent_s or 0.0 for stream in paused.values())
    text = f"No pose of {listing([*paused])} for {duration(longest_s)}."
    advice = "Drive on, or save." if tone is Tone.BUSY else START_SOURCE_AGAIN
    return Headline(tone, "PAUSED", text, advice)


def _at_goal(state: NodeState, session: ProgressState) -> Headline:
    """Return the headline of a session that has reached its goal.

    If the sensor has moved, the sentence is the displacement from the installed transform.
    Otherwise it is the verdict with its gravest reason or, for the verdict ``USE``, the precision.
    """
    result = state.result
    sentence = _sentence(session.progress.precision)
    steps = ["" if state.saved else "Stop and save."]
    tone = Tone.GOOD
    caution = _caution(result) if result else ""
    if result and caution:
        tone = Tone.ACT
        sentence = caution
        steps = ["" if state.saved else "Save.", result.step]
    if moved := _moved(state):
        tone = Tone.ACT
        sentence = moved
        steps = ["" if state.saved else "Save.", caution]
    if state.saved:
        sentence = f"{sentence} Saved at {_time_of(state.saved)}."
    advice = " ".join(step for step in steps if step)
    return Headline(tone, DONE, sentence, advice, "" if state.saved else "save")


def _caution(result: ResultState) -> str:
    """Return verdict and gravest reason as a sentence; empty if the verdict is ``USE``."""
    if result.verdict == "USE":
        return ""
    return f"{result.verdict}: {result.caution or 'read the reasons below'}."


def _moved(state: NodeState) -> str:
    """Return how far the sensor has moved against the installed transform; empty if it has not."""
    comparison = state.progress.comparison if state.progress else None
    if state.result is None or comparison is None:
        return ""
    if comparison.verdict != "moved":
        return ""
    displacement = _displacement(comparison.differences[0])
    return f"{state.result.child_frame} HAS MOVED by {displacement}."


def _displacement(difference: Difference) -> str:
    """Return distance and angle by which the moved axes differ from the installed transform.

    The bars contain the change of each axis. If no single axis has moved, all determined axes are
    included.
    """
    known = [
        key for key, row in difference.axes.items() if math.isfinite(row.sigma)
    ]
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
    """Return the headline of a node that no longer sends states."""
    text = (
        f"No message from the node for {silent_s:.0f} s. Wait if the computer is busy. "
        "If the node has died, start it again"
    )
    if state.journal and state.journal.directory:
        text += ", with journal:=resume"
    return Headline(Tone.BAD, "SILENT", f"{text}.")


def _end(state: NodeState) -> Headline:
    """Return the headline of a node that has ended."""
    text = "The node has ended"
    saved = state.saved
    if state.mount is not None:
        advice = ""
        if state.mount.is_learning:
            advice = "It wrote no digest, because its motion was too short."
        return Headline(
            Tone.ACT, "ENDED", f"{text}: the mount is not monitored.", advice
        )
    if saved is None:
        if not state.result:
            reason = "There was no result yet. Start the node again to go on."
        elif state.can_save:
            reason = "The result is not saved: the log contains the reason."
        else:
            reason = (
                "The result is not saved, because output_directory is not set."
            )
        return Headline(Tone.ACT, "ENDED", f"{text}. {reason}")
    saved_text = f"The result was saved at {_time_of(saved)}."
    caution = _caution(state.result) if state.result else ""
    if saved.verdict == "DO NOT USE":
        caution = caution or f"{saved.verdict}: read the reasons below."
        return Headline(
            Tone.BAD,
            "ENDED",
            f"{caution} {saved_text}",
            "Mend the fault, and record again.",
        )
    if state.result and caution:
        return Headline(
            Tone.ACT, "ENDED", f"{caution} {saved_text}", state.result.step
        )
    if state.progress is not None and not state.progress.progress.done:
        return Headline(
            Tone.ACT,
            "ENDED",
            f"{saved_text} Further motion has not confirmed it yet.",
            "Record longer, until DONE.",
        )
    if moved := _moved(state):
        return Headline(
            Tone.ACT,
            "ENDED",
            f"{moved} {saved_text}",
            "Check the mount, then install this result.",
        )
    return Headline(Tone.GOOD, "ENDED", f"{text}. {saved_text}")


def typeset(text: str) -> str:
    """Return a text with the sign ± instead of +/-."""
    return text.replace("+/-", "±")


def _sentence(text: str) -> str:
    """Return a text as a sentence, with a capital letter and a full stop."""
    text = capital(typeset(text))
    return text if text.endswith((".", "!", "?")) else f"{text}."


def saved_at(saved: SavedState) -> str:
    """Return time of day and directory of a saved result."""
    return f"at {_time_of(saved)} in {saved.directory}"


def _time_of(saved: SavedState) -> str:
    """Return the time of day of a saved result."""
    return f"{datetime.fromtimestamp(saved.at_s):%H:%M}"
