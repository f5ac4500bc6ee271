"""The state of the node, put into the words and bars that a person is shown.

Nothing here knows ROS, a terminal or a browser: states go in, a :class:`View` comes out.
"""

import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

from hand_eye_calib.live.state import (
    AxisValues,
    Broadcast,
    InputState,
    Level,
    MountState,
    NodeState,
    Part,
    ProgressState,
    ResultState,
)
from hand_eye_calib.results.records import AxisProgress, Comparison
from hand_eye_calib.results.status import AXES
from hand_eye_calib.text import amount, duration, two_digits

_AXES_OF_ROTATIONS = {"roll": "x", "pitch": "y", "yaw": "z"}

# A node that has said nothing for so long is silent; it reports once a second (s).
SILENT_AFTER_S = 3.5

# Words whose sentence counts seconds.
SILENT, LEARNING = COUNTING = "SILENT", "LEARNING"

# A shift is told from this many standard deviations on.
_CLEARLY = 3.0

# The answer to a button is shown for so long (s).
ANSWER_FOR_S = 20.0


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
    """One axis of the parent sensor's frame against its target.

    Attributes
    ----------
    axis : str
        x, y, z: the offset along it; roll, pitch, yaw: the rotation about x, y, z.
    share : float
        0 to 1: the share of the information that the target needs. It grows evenly while the motion
        stays as it is.
    tone : Tone
    word : str
        Such as ``enough`` or ``25 s left``.
    against : str
        The standard deviation against the target, such as ``± 0.065 of 0.3 deg``.
    difference : str
        From what is installed, with units; empty if not known.
    """

    axis: str
    share: float
    tone: Tone
    word: str
    against: str
    difference: str

    @property
    def meaning(self) -> str:
        """Such as ``along x`` or ``about z``."""
        along = _AXES_OF_ROTATIONS.get(self.axis)
        return f"about {along}" if along else f"along {self.axis}"


@dataclass(frozen=True)
class View:
    """Everything a person is shown of one node.

    The pose (``values``: each axis with its value) has the angles as they are printed, with their
    own standard deviations. The bars are about the axes of the parent sensor's frame.

    A node that only watches the mount has no bars, verdict and comparison, but a line for each axis
    (``watched``): whether it has moved, or which change would be seen.
    """

    node: str
    tone: Tone
    word: str
    sentence: str
    title: str = ""
    values: tuple[tuple[str, str], ...] = ()
    bars: tuple[Bar, ...] = ()
    watched: tuple[Line, ...] = ()
    result: tuple[Line, ...] = ()
    reasons: tuple[str, ...] = ()
    health: tuple[Line, ...] = ()
    answer: Line | None = None


class Board:
    """Holds the newest state of one node, and makes views of it; may be used from several threads.

    Parameters
    ----------
    wanted : str
        Fully qualified name of the node; empty for the first that is heard, and for another one
        when that is silent.
    """

    def __init__(self, wanted: str = "") -> None:
        self._wanted = wanted
        self._state: NodeState | None = None
        self._heard_s = self._answered_s = -math.inf
        self._answer: Line | None = None
        self._lock = threading.Lock()

    @property
    def node(self) -> str:
        """Fully qualified name of the node that is shown; empty if none was heard."""
        state = self._state
        return state.node if state is not None else ""

    def take(self, state: NodeState, now_s: float) -> None:
        """Take the state of a node."""
        with self._lock:
            shown = self._wanted or self.node
            is_silent = now_s - self._heard_s > SILENT_AFTER_S
            if state.node != shown and (self._wanted or not is_silent):
                return
            if state.node != self.node:
                self._answer = None
            self._state, self._heard_s = state, now_s

    def answer(self, request: str, good: bool | None, text: str, now_s: float) -> None:
        """Take the answer to a button; ``good`` is None while it is awaited."""
        tone = Tone.BUSY if good is None else Tone.GOOD if good else Tone.ACT
        with self._lock:
            self._answer, self._answered_s = Line(tone, request, text), now_s

    def view(self, now_s: float) -> View:
        """What to show; ``now_s`` is on the same clock as that of :meth:`take`."""
        with self._lock:
            if self._state is None:
                return _no_node(self._wanted)
            is_answered = now_s - self._answered_s < ANSWER_FOR_S
            answer = self._answer if is_answered else None
            return _view(self._state, now_s - self._heard_s, answer)


def _no_node(name: str) -> View:
    who = f"of {name}" if name else "of a calibrator"
    text = f"Nothing heard {who} yet. Is the node running, on the same ROS domain and network?"
    return View(name, Tone.UNKNOWN, "NO NODE", text)


def _view(state: NodeState, silent_s: float, answer: Line | None) -> View:
    is_silent = silent_s > SILENT_AFTER_S
    head = _headline(state)
    if is_silent:
        text = f"The node has said nothing for {silent_s:.0f} s. What is below is older than that."
        head = Tone.BAD, SILENT, text
    health = tuple(_health(state, is_silent))
    if state.mount is not None:
        watched = tuple(_watched(axis, state.mount) for axis in AXES)
        return View(state.node, *head, watched=watched, health=health, answer=answer)
    result = state.extrinsic.result if state.extrinsic else None
    title = f"pose of {result.child_frame} in {result.parent_frame}" if result else ""
    return View(
        state.node,
        *head,
        title=title or "no extrinsic yet",
        values=tuple(_values(result)) if result else (),
        bars=tuple(_bar(axis, state.progress) for axis in AXES) if state.progress else (),
        result=tuple(_result(state)),
        reasons=result.reasons if result else (),
        health=health,
        answer=answer,
    )


# -------------------------------------------------------------------- headline


def _headline(state: NodeState) -> tuple[Tone, str, str]:
    """Sign, word and sentence: what a person should know or do first."""
    inputs = [state.inputs[name] for name in ("parent", "child") if name in state.inputs]
    broken: list[tuple[Part | None, str]] = [
        (state.extrinsic, "BROKEN"),
        (state.mount, "MOUNT MOVED"),
        *((each, "BAD INPUT") for each in inputs),
        (state.journal, "BROKEN"),
    ]
    for part, word in broken:
        if part is not None and part.level is Level.ERROR:
            return Tone.BAD, word, _sentence(part.text)
    for each in inputs:
        if each.level is Level.WARN:
            return Tone.ACT, "CHECK INPUT", _sentence(each.text)
    checks = state.checks
    if checks is not None and checks.level is Level.WARN and checks.age_s is not None:
        return Tone.ACT, "CHECK THE STREAMS", _sentence(checks.text)
    if state.mount is not None:
        return _of_mount(state.mount)
    if state.progress is not None:
        return _of_progress(state.progress)
    return Tone.UNKNOWN, "LISTENING", "The node is there, and says nothing of a result yet."


def _of_progress(progress: ProgressState) -> tuple[Tone, str, str]:
    sentence = _sentence(progress.text)
    if progress.progress.is_faulty:  # the result was good, the streams no longer are
        return Tone.ACT, "CHECK THE STREAMS", sentence
    if progress.progress.done:
        return Tone.GOOD, "DONE", sentence
    if not progress.has_result:
        return Tone.BUSY, "START", sentence
    if progress.level >= Level.WARN:
        return Tone.ACT, "CHANGE THE MOTION", sentence
    return Tone.BUSY, "GO ON", sentence


def _of_mount(mount: MountState) -> tuple[Tone, str, str]:
    """Of a node that watches the mount, which has not moved."""
    sentence = _sentence(mount.text)
    if mount.level is not Level.OK:
        return Tone.ACT, "NOT WATCHING", sentence
    if mount.is_learning:
        return Tone.BUSY, LEARNING, sentence
    return Tone.GOOD, "WATCHING", sentence


def _sentence(text: str) -> str:
    """With a capital and a full stop, unless it begins with a name such as ``/lidar``."""
    return f"{text[:1].upper()}{text[1:]}" + ("" if text.endswith((".", "!", "?")) else ".")


# ------------------------------------------------------------------------ bars


def _bar(axis: str, part: ProgressState) -> Bar:
    known = part.progress.axes[axis]
    share = min(1.0, (known.target / known.sigma) ** 2) if known.sigma > 0 else 1.0
    tone, word = _state(known, is_behind=part.progress.limiting_axis == axis)
    return Bar(axis, share, tone, word, _against(axis, known), _difference(axis, part.comparison))


def _state(known: AxisProgress, is_behind: bool) -> tuple[Tone, str]:
    left_s = known.seconds_left
    if not math.isfinite(known.sigma):
        return Tone.UNKNOWN, "not seen yet"
    if left_s == 0:
        return Tone.GOOD, "enough"
    left = f"{duration(left_s)} left" if math.isfinite(left_s) else "not with this motion"
    if known.sigma <= known.target:
        return Tone.BUSY, f"nearly: {left}"
    return (Tone.ACT if is_behind else Tone.BUSY), left


def _against(axis: str, known: AxisProgress) -> str:
    wanted = amount(axis, known.target)
    if not math.isfinite(known.sigma):
        return f"wanted: {wanted}"
    number, _, unit = amount(axis, known.sigma).rpartition(" ")
    return f"± {number if wanted.endswith(f' {unit}') else f'{number} {unit}'} of {wanted}"


def _difference(axis: str, comparison: Comparison | None) -> str:
    """Result minus what is installed, with its standard deviation; unknown without one."""
    if comparison is None or not comparison.differences:
        return ""
    row = comparison.differences[0].axes[axis]
    if not math.isfinite(row.sigma):
        return "unknown"
    sign = "+" * (row.difference >= 0)
    return f"{sign}{amount(axis, row.difference)} ± {amount(axis, row.sigma)}"


# ------------------------------------------------------------------------ pose


def _values(result: ResultState) -> Iterator[tuple[str, str]]:
    """Each axis with its value and standard deviation; a question mark if it is not observed."""
    for axis in AXES:
        value, sigma = result.pose.get(axis), result.pose_sigma.get(axis)
        if value is None or sigma is None:
            yield axis, "? not observed"
        elif axis in _AXES_OF_ROTATIONS:
            yield axis, f"{math.degrees(value):.2f} ± {two_digits(math.degrees(sigma))} deg"
        else:
            yield axis, f"{value:.3f} m ± {amount(axis, sigma)}"


# ------------------------------------------------- health, verdict, comparison

_TONES = {Level.OK: Tone.GOOD, Level.WARN: Tone.ACT, Level.ERROR: Tone.BAD}
_VERDICTS = {"USE": Tone.GOOD, "USE WITH CARE": Tone.ACT, "DO NOT USE": Tone.BAD}
_COMPARED = {"same": Tone.GOOD, "moved": Tone.ACT}
_BROADCAST = {
    Broadcast.WAITING: Tone.BUSY,
    Broadcast.REFUSED: Tone.ACT,
    Broadcast.ON: Tone.GOOD,
}


def _health(state: NodeState, is_old: bool) -> Iterator[Line]:
    for name, part in state.parts():
        if name in ("extrinsic", "progress", "mount"):
            continue
        tone, text = _TONES[part.level], part.text
        if part is state.checks and state.checks.age_s is None:
            tone = Tone.BUSY  # a check that has not been made yet asks for nothing
        if isinstance(part, InputState) and part.topic not in text:
            text = f"{text}, {part.topic}"
        yield Line(Tone.UNKNOWN if is_old else tone, name, text)


def _result(state: NodeState) -> Iterator[Line]:
    result = state.extrinsic.result if state.extrinsic else None
    verdict = result.verdict if result else "no result yet"
    yield Line(_VERDICTS.get(verdict, Tone.UNKNOWN), "verdict", verdict)
    comparison = state.progress.comparison if state.progress else None
    if comparison is None:
        text = "nothing to compare with (parameter installed)"
        yield Line(Tone.UNKNOWN, "installed", text)
    else:
        tone = _COMPARED.get(comparison.verdict, Tone.UNKNOWN)
        yield Line(tone, "installed", comparison.sentence)
    if state.extrinsic and (broadcast := state.extrinsic.tf_static) is not Broadcast.OFF:
        text = ": ".join(filter(None, (broadcast.value, state.extrinsic.tf_static_reason)))
        yield Line(_BROADCAST[broadcast], "on /tf_static", text)


def _watched(axis: str, mount: MountState) -> Line:
    """Whether an axis of a watched mount has moved, or what ten minutes of motion would show."""
    shift, sigma = _number(axis, mount.shift), _number(axis, mount.shift_sigma)
    if abs(shift) > _CLEARLY * sigma:
        return Line(Tone.BAD, axis, f"moved by {amount(axis, shift)} ± {amount(axis, sigma)}")
    visible = _number(axis, mount.visible_10min)
    if math.isfinite(visible):
        return Line(Tone.GOOD, axis, f"a change of {amount(axis, visible)} would be seen")
    return Line(Tone.UNKNOWN, axis, "nothing yet")


def _number(axis: str, values: AxisValues) -> float:
    value = values.get(axis)
    return math.nan if value is None else value
