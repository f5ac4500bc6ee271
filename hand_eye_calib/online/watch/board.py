"""The state of the node, put into the words and bars that a person is shown.

Nothing here knows ROS, a terminal or a browser: states go in, a :class:`View` comes out.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from enum import Enum
from typing import Any

from hand_eye_calib.core.base.errors import printable
from hand_eye_calib.core.base.plain import from_plain
from hand_eye_calib.core.base.stats import LARGEST_OF_SIX
from hand_eye_calib.core.base.text import amount, capital, change, duration, fixed, two_digits
from hand_eye_calib.core.results.context import Comparison
from hand_eye_calib.core.results.records import AXES, ROTATIONS
from hand_eye_calib.online.live.state import (
    REPORT_PERIOD_S,
    Broadcast,
    ExtrinsicState,
    InputState,
    Level,
    MountState,
    NodeState,
    ResultState,
    SavedState,
    Standing,
)

# A node that has said nothing for so long (s) is silent.
SILENT_AFTER_S = 3.5 * REPORT_PERIOD_S

MOVED = "MOUNT MOVED"
CHANGE_MOTION = "CHANGE THE MOTION"
PAUSED = "PAUSED"
_ADVICE = "; check it, then recalibrate or acknowledge"

# The answer to a button is shown for so long (s).
ANSWER_FOR_S = 20.0

# Names of the axes, and what they mean on a vehicle (REP 103).
_AXES = [f"{how} {axis}" for how in ("along", "about") for axis in "xyz"]
_NAMES = dict(zip(AXES, _AXES, strict=True))
_WORDS = ("forward", "left", "up", "tilt to a side", "nose up or down", "turn")
_ON_A_VEHICLE = dict(zip(AXES, _WORDS, strict=True))


class Tone(Enum):
    """How good something is: never told by a colour alone, always with this sign."""

    GOOD = "✓"
    BUSY = "▶"
    ACT = "!"
    BAD = "✗"
    UNKNOWN = "?"


@dataclass(frozen=True)
class Line:
    """One line with its sign, such as the health of an input."""

    tone: Tone
    name: str
    text: str


@dataclass(frozen=True)
class Bar:
    """One axis of the parent sensor's frame, such as "about z", against its target.

    ``meaning`` is such as "turn", if the axes are those of a vehicle; ``share``, 0 to 1, of the
    information that the target needs; ``word`` such as "30 s left"; ``against`` such as "± 0.065
    deg of 0.3 deg"; ``difference`` from what is installed, empty if not known.
    """

    name: str
    meaning: str
    share: float
    tone: Tone
    word: str
    against: str
    difference: str


@dataclass(frozen=True)
class View:
    """Everything a person is shown of one node.

    ``values`` is the pose as it is printed, by axis. ``buttons`` are the requests that make sense
    now, that to be pressed first; ``by_hand`` are the axes that somebody may measure or correct,
    that to be looked at first; ``priors`` are those that somebody has measured, as they were typed;
    ``saved_in`` is the directory of the files. A node that only watches the mount has a line for
    each axis (``watched``), and no bars, verdict and comparison.
    """

    node: str
    tone: Tone
    word: str
    sentence: str
    facts: str = ""
    title: str = ""
    values: tuple[tuple[str, str], ...] = ()
    bars: tuple[Bar, ...] = ()
    watched: tuple[Line, ...] = ()
    result: tuple[Line, ...] = ()
    reasons: tuple[str, ...] = ()
    health: tuple[Line, ...] = ()
    topics: tuple[str, ...] = ()
    buttons: tuple[str, ...] = ()
    by_hand: tuple[str, ...] = ()
    priors: tuple[tuple[str, str], ...] = ()
    saved_in: str = ""
    answer: tuple[Line, ...] = ()


class Board:
    """Holds the newest state of one node, and makes views of it; may be used from several threads.
    The node is known by its fully qualified name; without one, it is the first that is heard, and
    another one when that is silent. ``topics`` are lines about the topics with poses that exist.
    """

    def __init__(self, wanted: str = "") -> None:
        self.topics: tuple[str, ...] = ()
        self._wanted = wanted
        # One assignment each, so that no other thread sees half of it: what, and when.
        self._heard: tuple[NodeState, float] | None = None
        self._answer: tuple[Line, float] | None = None
        self._acknowledged: tuple[str, int | None] | None = None

    @property
    def priors(self) -> tuple[str, ...]:
        """Axes whose prior is set on the node that is shown."""
        if self._heard is None or self._heard[0].extrinsic is None:
            return ()
        priors = self._heard[0].extrinsic.priors
        return tuple(axis for axis in AXES if axis in priors)

    @property
    def node(self) -> str:
        """Fully qualified name of the node that is shown; empty if none was heard."""
        return self._heard[0].node if self._heard else ""

    def take(self, state: NodeState, now_s: float) -> None:
        """Take the state of a node."""
        is_silent = not self._heard or now_s - self._heard[1] > SILENT_AFTER_S
        if state.node == (self._wanted or self.node) or (is_silent and not self._wanted):
            self._heard = state, now_s

    def answer(self, request: str, good: bool | None, text: str, now_s: float) -> None:
        """Take the answer to a button; ``good`` is None while it is awaited."""
        tone = Tone.BUSY if good is None else Tone.GOOD if good else Tone.ACT
        self._answer = Line(tone, request, text), now_s

    def acknowledge(self) -> None:
        """Somebody knows that the mount has moved: it is said without alarm, until the next one."""
        self._acknowledged = _alarm_of(self._heard[0]) if self._heard else None

    def view(self, now_s: float) -> View:
        """What to show; ``now_s`` is on the same clock as that of :meth:`take`."""
        if self._heard is None:
            who = f"of {self._wanted}" if self._wanted else "of a calibrator"
            text = f"Nothing heard {who} yet. Is the node running, on the same ROS domain and "
            return View(self._wanted, Tone.UNKNOWN, "NO NODE", f"{text}network?")
        state, heard_s = self._heard
        view = _view(state, now_s - heard_s)
        if view.word == MOVED and _alarm_of(state) == self._acknowledged:
            facts = f"{view.facts}; acknowledged"
            buttons = ("recalibrate", "reset")
            told = view.sentence.replace(" or acknowledge", "")
            view = replace(view, tone=Tone.ACT, sentence=told, buttons=buttons, facts=facts)
        if view.word in ("CHECK INPUT", "BAD INPUT"):
            view = replace(view, topics=self.topics)
        if self._answer and now_s - self._answer[1] < ANSWER_FOR_S:
            view = replace(view, answer=self._answer[:1])
        return view


def _alarm_of(state: NodeState) -> tuple[str, int | None]:
    return state.node, state.mount.since_ns if state.mount else None


def _view(state: NodeState, silent_s: float) -> View:
    head = _headline(state)
    is_old = state.has_ended or silent_s > SILENT_AFTER_S
    if state.has_ended:
        head = _of_end(state)
    elif is_old:
        text = f"No word from the node for {silent_s:.0f} s. If it has died, start it again"
        text += ", with journal:=resume." if state.journal and state.journal.directory else "."
        head = Tone.BAD, "SILENT", text
    saved_in = state.saved.directory if state.saved else ""
    health = () if state.has_ended else tuple(_health(state, is_old))
    view = View(state.node, *head, health=health, saved_in=saved_in)
    if state.mount is not None:
        asked = ("recalibrate", "acknowledge", "reset") if view.word == MOVED else ()
        watched = tuple(_watched(axis, state.mount) for axis in AXES)
        facts = _ago(state.mount) + "; a reset ends the alarm" * bool(asked)
        return replace(view, facts=facts, watched=watched, buttons=asked)
    if result := _result_of(state):
        view = replace(view, reasons=result.reasons)
        if _standing(state) is not Standing.REFUTED:
            title = f"pose of {result.child_frame} in {result.parent_frame}"
            view = replace(view, title=title, values=tuple(_values(result)))
    if state.progress:
        bars = tuple(_bar(axis, state) for axis in AXES)
        view = replace(view, bars=bars, by_hand=_axes_by_hand(state, view.word))
    if state.extrinsic and not is_old:
        priors = state.extrinsic.priors
        view = replace(view, priors=tuple(item for item in priors.items() if item[0] in AXES))
    shown = () if is_old else _buttons(state, view.word)
    return replace(view, facts=_facts(state, is_old), result=tuple(_result(state)), buttons=shown)


def _buttons(state: NodeState, word: str) -> tuple[str, ...]:
    """The requests that make sense for a node that calibrates, that to be pressed first."""
    buttons: tuple[str, ...] = ("reset",)
    if _result_of(state):
        is_wanted = word == "DONE" and not state.saved
        buttons = ("save", "solve", "reset") if is_wanted else ("solve", "save", "reset")
    has_priors = state.extrinsic is not None and bool(state.extrinsic.priors)
    return (*buttons, "forget") if has_priors else buttons


def _axes_by_hand(state: NodeState, word: str) -> tuple[str, ...]:
    """Axes that somebody may measure, or whose prior may be corrected or removed."""
    extrinsic = state.extrinsic
    at = state.progress
    if extrinsic is None or at is None:
        return ()
    axes = [*extrinsic.contradicted]
    if at.progress.will_not_get_there and word == CHANGE_MOTION:
        axes.append(at.progress.limiting_axis)
    axes += extrinsic.priors
    return tuple(axis for axis in dict.fromkeys(axes) if axis in AXES)


def _standing(state: NodeState) -> Standing:
    return state.extrinsic.standing if state.extrinsic else Standing.NONE


def _result_of(state: NodeState) -> ResultState | None:
    return state.extrinsic.result if state.extrinsic else None


def _where(saved: SavedState) -> str:
    """When, by the clock on the wall, and where the result was saved."""
    return f"at {datetime.fromtimestamp(saved.at_s):%H:%M} in {saved.directory}"


# -------------------------------------------------------------------- headline


def _headline(state: NodeState) -> tuple[Tone, str, str]:
    """Sign, word and sentence: what a person should know or do first, the gravest that applies."""
    extrinsic = state.extrinsic
    mount = state.mount
    at = state.progress
    checks = state.checks
    is_safe = at is not None and at.progress.done and state.saved  # whatever the journal lacks
    inputs = [state.inputs[name] for name in ("parent", "child") if name in state.inputs]
    is_contradicted = extrinsic is not None and bool(extrinsic.contradicted)
    is_outdated = _standing(state) is Standing.OUTDATED
    told = [
        (Tone.BAD, "BROKEN", extrinsic, Level.ERROR),
        (Tone.BAD, MOVED, mount, Level.ERROR),
        (Tone.BAD, "CHECK THE PRIOR", extrinsic if is_contradicted else None, Level.WARN),
        *((Tone.BAD, "BAD INPUT", each, Level.ERROR) for each in inputs),
        (Tone.BAD, "BROKEN", None if is_safe else state.journal, Level.ERROR),
        *((Tone.ACT, _word_of(each, at is not None), each, Level.WARN) for each in inputs),
        (Tone.ACT, "CHECK THE STREAMS", checks, Level.WARN),
        (Tone.ACT, "OLD RESULT", extrinsic if is_outdated else None, Level.WARN),
        (Tone.ACT, "NOT WATCHING", mount, Level.WARN),
    ]
    for tone, word, part, level in told:
        is_open = part is checks and checks is not None and checks.age_s is None
        if part is not None and part.level is level and not is_open:
            return tone, word, _sentence(part.text + _ADVICE * (word == MOVED))
    if mount is not None:
        tone, word = (Tone.BUSY, "LEARNING") if mount.is_learning else (Tone.GOOD, "WATCHING")
        return tone, word, _sentence(mount.text)
    if at is None:
        return Tone.UNKNOWN, "LISTENING", "The node is there, and says nothing of a result yet."
    sentence = _sentence(at.text.removeprefix("Done: "))
    if at.progress.is_faulty:  # the result was good, the streams no longer are
        return Tone.ACT, "CHECK THE STREAMS", sentence
    if at.progress.done:
        moved = _moved(at.comparison)
        return Tone.ACT if moved else Tone.GOOD, "DONE", _of_done(state, moved, sentence)
    if at.is_paused:
        return Tone.ACT if at.level >= Level.WARN else Tone.BUSY, PAUSED, sentence
    if _result_of(state) is None:
        return Tone.BUSY, "START", sentence
    if at.level >= Level.WARN:
        return Tone.ACT, CHANGE_MOTION, sentence
    return Tone.BUSY, "GO ON", sentence


def _word_of(part: InputState, calibrates: bool) -> str:
    """The word for an input that a person should look at."""
    return PAUSED if calibrates and part.is_paused else "CHECK INPUT"


def _of_done(state: NodeState, moved: str, sentence: str) -> str:
    """What has changed against what is installed, or how good it is; save, or where it is saved."""
    if moved and (result := _result_of(state)):
        sentence = f"{result.child_frame} HAS MOVED: {moved}. Save."
    if state.saved is None:
        return sentence
    told = sentence.removesuffix(" Save.").removesuffix(" Stop and save.")
    return f"{told} Saved {_where(state.saved)}."


def _moved(comparison: Comparison | None) -> str:
    """What has moved against what is installed, and by how much."""
    if comparison is None or comparison.verdict != "moved":
        return ""
    return comparison.sentence.removeprefix("moved: ").replace("+/-", "±")


def _of_end(state: NodeState) -> tuple[Tone, str, str]:
    """The last word of a node that was told to end."""
    if state.mount is not None:
        return Tone.ACT, "ENDED", "The node has ended: nobody watches the mount."
    if state.saved is not None:
        text = f"The node has ended. The result was saved {_where(state.saved)}."
        if state.saved.verdict == "DO NOT USE":
            return Tone.ACT, "ENDED", f"{text} {_sentence(state.saved.text)}"
        return Tone.GOOD, "ENDED", text
    lost = "The result is not saved: the log says why."
    text = lost if _result_of(state) else "There was no result yet."
    return Tone.ACT, "ENDED", f"The node has ended. {text}"


def _sentence(text: str) -> str:
    """A sentence: the text with a capital and a full stop."""
    text = capital(text.replace("+/-", "±"))
    return text if text.endswith((".", "!", "?")) else f"{text}."


def _facts(state: NodeState, is_old: bool) -> str:
    """How far and how long the sensors have moved, and how old the result is, if that is known."""
    seen = state.extrinsic
    if seen is None or not seen.n_poses:
        return ""
    told = [f"{seen.path_m:,.0f} m", f"{duration(seen.motion_s)} of motion"]
    if seen.result and not is_old and seen.standing is not Standing.REFUTED:
        told.append(f"result {duration(seen.result.age_s)} old")
    if seen.standing is Standing.OUTDATED:
        told.append("newer solves fail")
    return ", ".join(told)


def _ago(mount: MountState) -> str:
    if not mount.since_ns or not mount.newest_ns:
        return f"{duration(mount.seconds_of_motion)} of motion seen"
    return f"{duration((mount.newest_ns - mount.since_ns) * 1e-9)} ago"


# ------------------------------------------------------------------------ axes


def _bar(axis: str, state: NodeState) -> Bar:
    at = state.progress
    assert at is not None
    known = at.progress.axes[axis]
    share = min(1.0, (known.target / known.sigma) ** 2) if known.sigma > 0 else 1.0
    has_end = math.isfinite(known.seconds_left)
    left = f"{duration(known.seconds_left)} left" if has_end else "not with this motion"
    tone = Tone.ACT if at.progress.limiting_axis == axis else Tone.BUSY
    word = left
    wanted = amount(axis, known.target)
    sigma = amount(axis, known.sigma).removesuffix(f" {wanted.rpartition(' ')[2]}")
    against = f"± {sigma} of {wanted}"
    if state.extrinsic is not None and state.extrinsic.contradicted:
        tone = Tone.UNKNOWN
        word = "no usable result"
        against = f"wanted: {wanted}"
    elif not math.isfinite(known.sigma):
        tone = Tone.UNKNOWN
        word = "out of reach" if has_end else "not seen yet"
        against = "" if has_end else f"wanted: {wanted}"
    elif at.progress.is_faulty:
        tone = Tone.UNKNOWN
        word = "of faulty streams"
    elif known.seconds_left == 0:
        tone = Tone.GOOD
        word = "enough"
    elif known.sigma <= known.target:
        tone = Tone.BUSY
        word = f"nearly: {left}"
    difference = ""
    if at.comparison is not None and at.comparison.differences:
        row = at.comparison.differences[0].axes[axis]
        difference = change(axis, row.difference, row.sigma)
    is_vehicle = state.extrinsic is not None and state.extrinsic.has_vehicle_axes
    meaning = _ON_A_VEHICLE[axis] if is_vehicle else ""
    return Bar(_NAMES[axis], meaning, share, tone, word, against, difference)


def _values(result: ResultState) -> Iterator[tuple[str, str]]:
    """Each axis with its value and standard deviation; a question mark if it is not observed."""
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
    """Whether an axis of a watched mount has moved, or what ten minutes of motion would show."""
    shift = mount.shift.get(axis) or 0.0
    sigma = mount.shift_sigma.get(axis) or math.inf
    visible = mount.visible_10min.get(axis)
    tone = Tone.UNKNOWN
    text = "cannot be watched with this motion"
    if abs(shift) > LARGEST_OF_SIX * sigma:
        tone = Tone.BAD
        text = f"moved by {amount(axis, shift)} ± {amount(axis, sigma)}"
    elif visible is not None:
        tone = Tone.GOOD
        text = f"not moved (would see {amount(axis, visible)})"
    elif mount.is_learning or not mount.visible_10min:
        text = "not known yet"
    return Line(tone, _NAMES[axis], text)


# ------------------------------------------------- health, verdict, comparison

# Of levels, verdicts, comparisons and broadcasts.
_TONES: dict[object, Tone] = {
    **dict.fromkeys((Level.OK, "USE", "same", Broadcast.ON), Tone.GOOD),
    **dict.fromkeys((Level.WARN, "USE WITH CARE", "moved", Broadcast.REFUSED), Tone.ACT),
    **dict.fromkeys((Level.ERROR, "DO NOT USE"), Tone.BAD),
    Broadcast.WAITING: Tone.BUSY,
}


def _health(state: NodeState, is_old: bool) -> Iterator[Line]:
    for name, part in state.parts():
        if name in ("extrinsic", "progress", "mount"):
            continue
        tone = _TONES[part.level]
        text = part.text
        if part is state.checks and state.checks.age_s is None:
            tone = Tone.BUSY  # a check that has not been made yet asks for nothing
        if isinstance(part, InputState) and part.topic not in text:
            text = f"{text}, {part.topic}"
        yield Line(Tone.UNKNOWN if is_old else tone, name, text)


def _result(state: NodeState) -> Iterator[Line]:
    result = _result_of(state)
    verdict, notes = (result.verdict, result.warnings) if result else ("no result yet", ())
    yield Line(_TONES.get(verdict, Tone.UNKNOWN), "verdict", verdict)
    yield from (Line(Tone.ACT, "note", note.replace("+/-", "±")) for note in notes)
    if state.extrinsic is not None:
        yield from _priors(state.extrinsic)
    if state.progress and (found := state.progress.comparison):
        text = found.sentence.replace("+/-", "±")
        tone = _TONES.get(found.verdict, Tone.UNKNOWN)
        yield Line(tone, "compared with what is installed", text)
    if state.extrinsic and (broadcast := state.extrinsic.tf_static) is not Broadcast.OFF:
        text = ": ".join(filter(None, (broadcast.value, state.extrinsic.tf_static_reason)))
        told = (Tone.ACT, "nothing: the node has ended") if state.has_ended else None
        tone, text = told or (_TONES[broadcast], text)
        yield Line(tone, "on /tf_static", text)
    if state.saved is not None:
        tone = Tone.BAD if state.saved.verdict == "DO NOT USE" else Tone.GOOD
        yield Line(tone, "saved", f"{_where(state.saved)}: {state.saved.text}")


def _priors(extrinsic: ExtrinsicState) -> Iterator[Line]:
    """The priors that are set, and whether the motion contradicts them."""
    for axis in (name for name in AXES if name in extrinsic.priors):
        prior = extrinsic.priors[axis]
        text = f"{axis} = {prior.replace('+/-', ' ± ')}"
        if axis in extrinsic.contradicted:
            yield Line(Tone.BAD, "prior", f"{text}: contradicts the motion")
        else:
            yield Line(Tone.BUSY, "prior", text)


def state_of(text: str) -> NodeState | None:
    """Return the state of a node from its JSON, without control characters.

    Anybody may publish on that topic. None stands for a text that is no state, such as that of
    another version, and for a state whose values cannot be shown.
    """
    try:
        state = from_plain(NodeState, _printable(json.loads(text)))
        trial = Board()
        trial.take(state, 0.0)
        trial.view(0.0)
    except (TypeError, ValueError, KeyError, RecursionError, OverflowError, OSError):
        return None
    return state


def _printable(value: Any) -> Any:
    if isinstance(value, dict):
        return {printable(key): _printable(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_printable(item) for item in value]
    return printable(value) if isinstance(value, str) else value
