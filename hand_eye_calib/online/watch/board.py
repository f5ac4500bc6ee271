"""Convert the state of a node into what ``watch`` displays: words, signs and bars.

A :class:`Board` stores the newest state of a node and makes a :class:`View`. This module does not
depend on ROS, a terminal or a browser.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from typing import Any, NamedTuple

from hand_eye_calib.core.base.errors import printable
from hand_eye_calib.core.base.plain import from_plain
from hand_eye_calib.core.base.stats import LARGEST_OF_SIX
from hand_eye_calib.core.base.text import (
    ABOUT,
    amount,
    capital,
    change,
    duration,
    fixed,
    two_digits,
)
from hand_eye_calib.core.results.records import AXES, ROTATIONS
from hand_eye_calib.online.live.progress import AXIS_KEYS, AxisProgress
from hand_eye_calib.online.live.state import (
    REPORT_PERIOD_S,
    Broadcast,
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
from hand_eye_calib.online.watch.view import AxisTexts, Bar, Line, Texts, Tone, View

# Age (s) of the newest state from which on a node is silent: three reports are missing.
SILENT_AFTER_S = 3.5 * REPORT_PERIOD_S

# Time (s) for which the answer to a button is displayed.
ANSWER_FOR_S = 20.0

# Words of headlines with which certain buttons are displayed.
MOVED = "MOUNT MOVED"
CHANGE_MOTION = "CHANGE THE MOTION"
CHANGE_TARGET = "CHANGE THE TARGET"
DONE = "DONE"

# Names of the axes of the parent sensor's frame.
_NAMES = {axis: f"along {axis}" for axis in "xyz"}
_NAMES |= {axis: f"about {direction}" for axis, direction in ABOUT.items()}
# Meaning of the axes on a vehicle (REP 103).
_ON_A_VEHICLE = {
    "x": "forward",
    "y": "left",
    "z": "up",
    "roll": "tilt to a side",
    "pitch": "nose up or down",
    "yaw": "turn",
}


# Tone of each level, verdict, verdict of a comparison, and state of a broadcast.
_TONES: dict[object, Tone] = {
    **dict.fromkeys((Level.OK, "USE", "same", Broadcast.ON), Tone.GOOD),
    **dict.fromkeys((Level.WARN, "USE WITH CARE", "moved", Broadcast.REFUSED), Tone.ACT),
    **dict.fromkeys((Level.ERROR, "DO NOT USE"), Tone.BAD),
    Broadcast.WAITING: Tone.BUSY,
}


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


class Board:
    """Stores the newest state of one node, and makes views from it. Several threads may use it.

    Parameters
    ----------
    wanted : str
        Fully qualified name of the node. If empty, the first node that sends a state is displayed,
        until it is silent and another node sends a state.

    Attributes
    ----------
    topics : tuple of str
        A line for each topic with poses.
    """

    def __init__(self, wanted: str = "") -> None:
        self.topics: Texts = ()
        self._wanted = wanted
        # State and answer, each with its time (s). Both are in one tuple, which is replaced as a
        # whole, so that no thread reads a state with the time of another state.
        self._newest: tuple[NodeState, float] | None = None
        self._answer: tuple[Line, float] | None = None
        # Node and start (ns) of the alarm that a person has acknowledged.
        self._acknowledged: tuple[str, int | None] | None = None

    @property
    def priors(self) -> Texts:
        """Axes of the displayed node that have a prior."""
        return tuple(dict(_priors_of(self._newest[0]))) if self._newest else ()

    @property
    def node(self) -> str:
        """Fully qualified name of the displayed node; empty before its first state."""
        return self._newest[0].node if self._newest else ""

    def take(self, state: NodeState, now_s: float) -> None:
        """Store a state; ignore it if another node is displayed.

        ``now_s`` is the time (s) at which the state was received, on a steady clock.
        """
        is_silent = not self._newest or now_s - self._newest[1] > SILENT_AFTER_S
        if state.node == (self._wanted or self.node) or (is_silent and not self._wanted):
            self._newest = state, now_s

    def answer(self, request: str, good: bool | None, text: str, now_s: float) -> None:
        """Store the answer to a request; ``good`` is None until the answer arrives."""
        tones = {None: Tone.BUSY, True: Tone.GOOD, False: Tone.ACT}
        self._answer = Line(tones[good], request, text), now_s

    def acknowledge(self) -> None:
        """Display the present alarm of the mount as acknowledged, until another alarm begins."""
        self._acknowledged = _alarm_of(self._newest[0]) if self._newest else None

    def view(self, now_s: float) -> View:
        """Return what to display at a time ``now_s`` (s), on the clock of :meth:`take`."""
        if self._newest is None:
            name = self._wanted or "a calibrator"
            text = f"No message from {name} yet. Is the node running, on the same ROS domain and "
            return View(self._wanted, Tone.UNKNOWN, "NO NODE", f"{text}network?")
        state, received_s = self._newest
        view = _view(state, now_s - received_s)
        if view.word == MOVED and _alarm_of(state) == self._acknowledged:
            view = replace(
                view,
                tone=Tone.ACT,
                advice="Check it, then recalibrate.",
                facts=f"{view.facts}; acknowledged",
                buttons=("recalibrate", "reset"),
            )
        if view.word in ("CHECK INPUT", "BAD INPUT"):
            view = replace(view, topics=self.topics)
        if self._answer and now_s - self._answer[1] < ANSWER_FOR_S:
            view = replace(view, answer=self._answer[:1])
        return view


def _alarm_of(state: NodeState) -> tuple[str, int | None]:
    """Return node and start (ns) of an alarm of the mount: they identify the alarm."""
    return state.node, state.mount.since_ns if state.mount else None


def _priors_of(state: NodeState) -> AxisTexts:
    """Return the axes that have a prior, with the priors as the user has typed them."""
    if state.extrinsic is None:
        return ()
    priors = state.extrinsic.priors
    return tuple((axis, priors[axis]) for axis in AXES if axis in priors)


def _view(state: NodeState, silent_s: float) -> View:
    """Return the view of a state that was received ``silent_s`` seconds ago."""
    is_silent = silent_s > SILENT_AFTER_S
    is_old = state.has_ended or is_silent
    if state.has_ended:
        headline = _end(state)
    elif is_silent:
        headline = _silence(state, silent_s)
    else:
        headline = _alarm(state) or _activity(state)
    view = View(
        state.node,
        *headline,
        health=() if state.has_ended else tuple(_health(state, is_old)),
        saved_in=state.saved.directory if state.saved else "",
    )
    if state.mount is not None:
        return _with_mount(view, state.mount)
    view = _with_result(view, state)
    view = replace(view, facts=_facts(state, is_old), by_hand=_axes_by_hand(state, view.word))
    if progress := state.progress:
        bars = tuple(_bar(axis, progress, state.extrinsic) for axis in AXES)
        view = replace(view, bars=bars)
    if is_old:
        return view
    return replace(view, priors=_priors_of(state), buttons=_buttons(state, view.word))


def _with_result(view: View, state: NodeState) -> View:
    """Add the result to the view of a node that calibrates; a refuted result has no pose."""
    view = replace(view, result=tuple(_result(state)))
    if result := state.result:
        view = replace(view, reasons=result.reasons)
        if state.standing is not Standing.REFUTED:
            title = f"pose of {result.child_frame} in {result.parent_frame}"
            view = replace(view, title=title, values=tuple(_values(result)))
    return view


def _with_mount(view: View, mount: MountState) -> View:
    """Add the mount to the view of a node that monitors the mount."""
    facts = f"{duration(mount.seconds_of_motion)} of motion seen"
    if mount.since_ns and mount.newest_ns:
        facts = f"{duration((mount.newest_ns - mount.since_ns) * 1e-9)} ago"
    view = replace(view, facts=facts, watched=tuple(_watched(axis, mount) for axis in AXES))
    if view.word != MOVED:
        return view
    buttons = ("recalibrate", "acknowledge", "reset")
    return replace(view, facts=f"{facts}; a reset ends the alarm", buttons=buttons)


def _buttons(state: NodeState, word: str) -> Texts:
    """Return the possible requests to a node that calibrates, the recommended one first."""
    buttons: Texts = ("reset",)
    if state.result:
        buttons = ("solve", "save", "reset")
        if word == DONE and not state.saved:
            buttons = ("save", "solve", "reset")
    if state.extrinsic and state.extrinsic.priors:
        buttons += ("forget",)
    return buttons


def _axes_by_hand(state: NodeState, word: str) -> Texts:
    """Return axes whose prior a person may set, correct or remove, the most important first.

    These are the axes whose prior contradicts the motion, the axis that the present motion cannot
    determine, and all other axes with a prior.
    """
    extrinsic = state.extrinsic
    if extrinsic is None or state.progress is None:
        return ()
    axes = [*extrinsic.contradicted]
    progress = state.progress.progress
    if progress.will_not_get_there and word == CHANGE_MOTION:
        axes += [axis for axis, key in AXIS_KEYS.items() if key == progress.limiting_axis]
    axes += extrinsic.priors
    return tuple(axis for axis in dict.fromkeys(axes) if axis in AXES)


def _saved_at(saved: SavedState) -> str:
    """Return time of day and directory of a saved result."""
    return f"at {datetime.fromtimestamp(saved.at_s):%H:%M} in {saved.directory}"


# -------------------------------------------------------------------- headline


def _alarm(state: NodeState) -> Headline | None:
    """Return the gravest condition that requires a person; None if there is none."""
    for tone, word, level, part in _conditions(state):
        if part is not None and part.level is level:
            advice = "Check it, then recalibrate or acknowledge." if word == MOVED else ""
            return Headline(tone, word, _sentence(part.text), advice)
    return None


def _conditions(state: NodeState) -> Iterator[tuple[Tone, str, Level, Part | None]]:
    """Yield conditions, the gravest first.

    A condition has the tone and the word of its headline, a level, and a part of the node. The node
    is in this condition if the part has the level.
    """
    extrinsic = state.extrinsic
    checks = state.checks
    # The inputs of further child sensors are displayed, but do not become a headline.
    inputs = [stream for name, stream in state.inputs.items() if name in ("parent", "child")]
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
    if state.result is None:
        return Headline(Tone.BUSY, "START", sentence)
    if session.progress.target_is_too_small:
        return Headline(tone, CHANGE_TARGET, sentence)
    return Headline(tone, "GO ON" if tone is Tone.BUSY else CHANGE_MOTION, sentence)


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
        gravest = state.result.reasons[:1]
        caution = _sentence(": ".join((state.result.verdict, *gravest)))
    if state.result and session.comparison and session.comparison.verdict == "moved":
        tone = Tone.ACT
        displacement = _typeset(session.comparison.differences[0].change)
        sentence = f"{state.result.child_frame} HAS MOVED: {displacement}."
        advice = "Save."
    if state.saved:
        sentence = f"{sentence} Saved {_saved_at(state.saved)}."
        advice = ""
    return Headline(tone, DONE, sentence, f"{advice} {caution}".strip())


def _silence(state: NodeState, silent_s: float) -> Headline:
    """Return the headline of a node that no longer sends its state."""
    text = f"No message from the node for {silent_s:.0f} s. If it has died, start it again"
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
        text += f". The result was saved {_saved_at(saved)}."
        if saved.verdict == "DO NOT USE":
            text += f" {_sentence(saved.text)}"
        else:
            tone = Tone.GOOD
    elif state.result:
        text += ". The result is not saved: the log contains the reason."
    else:
        text += ". There was no result yet."
    return Headline(tone, "ENDED", text)


def _typeset(text: str) -> str:
    """Return a text with the sign ± in place of +/-."""
    return text.replace("+/-", "±")


def _sentence(text: str) -> str:
    """Return a text as a sentence, with a capital letter and a full stop."""
    text = capital(_typeset(text))
    return text if text.endswith((".", "!", "?")) else f"{text}."


def _facts(state: NodeState, is_old: bool) -> str:
    """Return path length, duration of motion and age of the result; empty without poses."""
    extrinsic = state.extrinsic
    if extrinsic is None or not extrinsic.n_poses:
        return ""
    facts = f"{extrinsic.path_m:,.0f} m, {duration(extrinsic.motion_s)} of motion"
    if extrinsic.result and not is_old and extrinsic.standing is not Standing.REFUTED:
        facts += f", result {duration(extrinsic.result.age_s)} old"
    if extrinsic.standing is Standing.OUTDATED:
        facts += ", newer solves fail"
    return facts


# ------------------------------------------------------------------------ axes


def _bar(axis: str, session: ProgressState, extrinsic: ExtrinsicState | None) -> Bar:
    """Return the bar of an axis."""
    row = session.progress.axes[AXIS_KEYS[axis]]
    target = amount(axis, row.target)
    if extrinsic and extrinsic.contradicted:
        tone = Tone.UNKNOWN
        word = "no usable result"
        sigma = f"wanted: {target}"
    elif math.isfinite(row.sigma):
        tone, word = _progress_in_words(row, session, axis)
        sigma = f"± {amount(axis, row.sigma)}"
        sigma += ", from the prior" if _has_prior(row) else f" of {target}"
    else:
        tone = Tone.UNKNOWN
        # The time left is 0 without a standard deviation: these streams never observe the axis.
        is_out_of_reach = math.isfinite(row.seconds_left)
        word = "out of reach" if is_out_of_reach else "not seen yet"
        sigma = "" if is_out_of_reach else f"wanted: {target}"
    meaning = _ON_A_VEHICLE[axis] if extrinsic and extrinsic.has_vehicle_axes else ""
    difference = _difference(axis, session)
    return Bar(_NAMES[axis], meaning, _share_of(row), tone, word, sigma, difference)


def _has_prior(row: AxisProgress) -> bool:
    """Whether an axis has a prior: no time is left, although the target is not reached."""
    return row.seconds_left == 0 and row.target < row.sigma < math.inf


def _share_of(row: AxisProgress) -> float:
    """Return the information of an axis (1 / variance) as a share of what the target needs."""
    if row.sigma <= row.target or _has_prior(row):
        return 1.0
    return (row.target / row.sigma) ** 2


def _difference(axis: str, session: ProgressState) -> str:
    """Return the difference of an axis from the installed transform; empty if unknown."""
    if session.comparison is None or not session.comparison.differences:
        return ""
    row = session.comparison.differences[0].axes[AXIS_KEYS[axis]]
    return change(axis, row.difference, row.sigma)


def _progress_in_words(row: AxisProgress, session: ProgressState, axis: str) -> tuple[Tone, str]:
    """Return tone and word of an axis that has a standard deviation."""
    if session.progress.is_faulty:
        return Tone.UNKNOWN, "of faulty streams"
    if row.seconds_left == 0:
        return Tone.GOOD, "enough"
    word = "not with this motion"
    if math.isfinite(row.seconds_left):
        word = f"{duration(row.seconds_left)} left"
    is_limiting = session.progress.limiting_axis == AXIS_KEYS[axis]
    return Tone.ACT if is_limiting else Tone.BUSY, word


def _values(result: ResultState) -> Iterator[tuple[str, str]]:
    """Yield each axis of the printed pose with its value and standard deviation."""
    for axis in AXES:
        value = result.pose.get(axis)
        sigma = result.pose_sigma.get(axis)
        if value is None or sigma is None:
            yield axis, "? not observed"
        elif axis in ROTATIONS:
            yield axis, f"{fixed(math.degrees(value), 2)} ± {two_digits(math.degrees(sigma))} deg"
        else:
            yield axis, f"{value:.3f} m ± {amount(axis, sigma)}"


def _watched(axis: str, mount: MountState) -> Line:
    """Return the line of one axis of a monitored mount.

    The text is the shift of the axis, or the smallest shift that ten minutes of motion would
    detect.
    """
    key = AXIS_KEYS[axis]
    shift = mount.shift.get(key) or 0.0
    sigma = mount.shift_sigma.get(key) or math.inf
    visible = mount.visible_10min.get(key)
    tone = Tone.UNKNOWN
    text = "cannot be watched with this motion"
    # An axis has moved if noise seldom makes the largest of six shifts as large.
    if abs(shift) > LARGEST_OF_SIX * sigma:
        tone = Tone.BAD
        text = f"moved by {amount(axis, shift)} ± {amount(axis, sigma)}"
    elif visible is not None:
        tone = Tone.GOOD
        text = f"not moved (detects {amount(axis, visible)})"
    elif mount.is_learning or not mount.visible_10min:
        text = "not known yet"
    return Line(tone, _NAMES[axis], text)


# ------------------------------------------------- health, verdict, comparison


def _health(state: NodeState, is_old: bool) -> Iterator[Line]:
    """Yield a line for each input, for the stream checks and for the journal.

    A state that is old has no tones: its conditions may have changed.
    """
    for name, part in state.parts():
        if name in ("extrinsic", "progress", "mount"):
            continue
        tone = _TONES[part.level]
        text = part.text
        # Before the first check, the level is WARN, but a person need not act.
        if part is state.checks and state.checks.age_s is None:
            tone = Tone.BUSY
        if isinstance(part, InputState) and part.topic not in text:
            text = f"{text}, {part.topic}"
        yield Line(Tone.UNKNOWN if is_old else tone, name, text)


def _result(state: NodeState) -> Iterator[Line]:
    """Yield the lines of the result: verdict, warnings, priors, comparison, broadcast and files."""
    result = state.result
    verdict = result.verdict if result else "no result yet"
    yield Line(_TONES.get(verdict, Tone.UNKNOWN), "verdict", verdict)
    if result:
        for warning in result.warnings:
            yield Line(Tone.ACT, "note", _typeset(warning))
    yield from _prior_lines(state)
    if state.progress and (comparison := state.progress.comparison):
        tone = _TONES.get(comparison.verdict, Tone.UNKNOWN)
        yield Line(tone, "compared with the installed transform", _typeset(comparison.sentence))
    if state.extrinsic and state.extrinsic.tf_static is not Broadcast.OFF:
        yield _broadcast(state.extrinsic, state.has_ended)
    if state.saved:
        tone = Tone.BAD if state.saved.verdict == "DO NOT USE" else Tone.GOOD
        yield Line(tone, "saved", f"{_saved_at(state.saved)}: {state.saved.text}")


def _prior_lines(state: NodeState) -> Iterator[Line]:
    """Yield a line for each prior that is set."""
    contradicted = state.extrinsic.contradicted if state.extrinsic else ()
    for axis, prior in _priors_of(state):
        text = f"{axis} = {prior.replace('+/-', ' ± ')}"
        if axis in contradicted:
            yield Line(Tone.BAD, "prior", f"{text}: contradicts the motion")
        else:
            yield Line(Tone.BUSY, "prior", text)


def _broadcast(extrinsic: ExtrinsicState, has_ended: bool) -> Line:
    """Return the line about the broadcast of the result on /tf_static."""
    tone = _TONES[extrinsic.tf_static]
    text = extrinsic.tf_static.value
    if extrinsic.tf_static_reason:
        text += f": {extrinsic.tf_static_reason}"
    if has_ended:
        tone = Tone.ACT
        text = "nothing: the node has ended"
    return Line(tone, "on /tf_static", text)


def state_of(text: str) -> NodeState | None:
    """Return the state of a node from its JSON, without control characters.

    Any program may publish on the topic. So None is returned for a text that is no state, for the
    state of another version, and for a state whose values cannot be displayed.
    """
    try:
        state = from_plain(NodeState, _printable(json.loads(text)))
        # Make a view as a trial: it raises an error for values that cannot be displayed.
        _view(state, 0.0)
    except (TypeError, ValueError, KeyError, RecursionError, OverflowError, OSError):
        return None
    return state


def _printable(value: Any) -> Any:
    """Return plain data with all control characters of texts and keys escaped."""
    if isinstance(value, dict):
        return {printable(key): _printable(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_printable(item) for item in value]
    return printable(value) if isinstance(value, str) else value
