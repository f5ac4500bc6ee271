"""What the nodes on ``/diagnostics`` say, put into the words and bars that a person is shown.

Nothing here knows ROS, a terminal or a browser: statuses go in, a :class:`View` comes out.
"""

import math
import threading
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum

from hand_eye_calib.text import angle, duration, length

AXES = {"x": "m", "y": "m", "z": "m", "roll": "rad", "pitch": "rad", "yaw": "rad"}

_AXES_OF_ROTATIONS = {"roll": "x", "pitch": "y", "yaw": "z"}

# Levels of diagnostic_msgs/DiagnosticStatus.
OK, WARN, ERROR = 0, 1, 2

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
class Status:
    """A status of ``/diagnostics``: the part of the node it is about, and what it says."""

    part: str
    level: int
    text: str
    values: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Pose:
    """The newest extrinsic: frames, and x, y, z (m), roll, pitch, yaw (rad)."""

    parent_frame: str
    child_frame: str
    values: tuple[float, ...]


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
    sigma, target, difference : str
        With units; empty if not known.
    """

    axis: str
    share: float
    tone: Tone
    word: str
    sigma: str
    target: str
    difference: str

    @property
    def meaning(self) -> str:
        """Such as ``along x`` or ``about z``."""
        along = _AXES_OF_ROTATIONS.get(self.axis)
        return f"about {along}" if along else f"along {self.axis}"

    @property
    def against(self) -> str:
        """The standard deviation against the target, such as ``± 0.065 of 0.3 deg``."""
        if not self.target:
            return ""
        if not self.sigma:
            return f"wanted: {self.target}"
        number, _, unit = self.sigma.rpartition(" ")
        same = self.target.endswith(f" {unit}")
        return f"± {number if same else self.sigma} of {self.target}"


@dataclass(frozen=True)
class View:
    """Everything a person is shown of one node.

    The pose (``values``: each axis with its value) has the angles as they are printed, with their
    own standard deviations. The bars are about the axes of the parent sensor's frame.

    A node that only watches the mount has no bars, verdict and comparison, but a line for each axis
    (``watched``): whether it has moved, or which change would be seen.
    """

    node: str
    nodes: tuple[str, ...]
    tone: Tone
    word: str
    sentence: str
    title: str
    values: tuple[tuple[str, str], ...]
    bars: tuple[Bar, ...]
    watched: tuple[Line, ...]
    result: tuple[Line, ...]
    reasons: tuple[str, ...]
    health: tuple[Line, ...]
    answer: Line | None


class _Node:
    """What is known of one node."""

    def __init__(self) -> None:
        self.statuses: dict[str, Status] = {}
        self.heard_s = -math.inf
        self.pose: Pose | None = None
        self.answer: Line | None = None
        self.answered_s = -math.inf

    def values(self, part: str) -> Mapping[str, str]:
        return self.statuses[part].values if part in self.statuses else {}


class Board:
    """Collects what the nodes say, and makes views of it; may be used from several threads."""

    def __init__(self) -> None:
        self._nodes: dict[str, _Node] = {}
        self._lock = threading.Lock()

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the nodes heard so far, fully qualified."""
        with self._lock:
            return tuple(sorted(self._nodes))

    def take(self, node: str, statuses: Iterable[Status], now_s: float) -> None:
        """Take what a node says on ``/diagnostics``, all of it at once."""
        with self._lock:
            known = self._nodes.setdefault(node, _Node())
            known.statuses = {status.part: status for status in statuses}
            known.heard_s = now_s
            if known.values("progress").get("verdict") == "no result":
                known.pose = None

    def take_pose(self, node: str, pose: Pose) -> None:
        """Take the newest extrinsic of a node."""
        with self._lock:
            self._nodes.setdefault(node, _Node()).pose = pose

    def answer(self, node: str, request: str, good: bool | None, text: str, now_s: float) -> None:
        """Take the answer to a button; ``good`` is None while it is awaited."""
        tone = Tone.BUSY if good is None else Tone.GOOD if good else Tone.ACT
        with self._lock:
            known = self._nodes.setdefault(node, _Node())
            known.answer, known.answered_s = Line(tone, request, text), now_s

    def chosen(self, wanted: str, now_s: float) -> str:
        """The node to show: the one that is wanted, or else the first that is not silent; empty if
        none was heard.
        """
        with self._lock:
            silent = {
                name: now_s - each.heard_s > SILENT_AFTER_S for name, each in self._nodes.items()
            }
        return wanted or min(silent, key=lambda name: (silent[name], name), default="")

    def view(self, wanted: str, now_s: float) -> View:
        """What to show of a node.

        Parameters
        ----------
        wanted : str
            Its name; empty for the first.
        now_s : float
            On the same clock as :meth:`take`.
        """
        name, names = self.chosen(wanted, now_s), self.nodes
        with self._lock:
            return _view(name, names, self._nodes.get(name, _Node()), now_s)


def _view(name: str, names: tuple[str, ...], node: _Node, now_s: float) -> View:
    silent_s = now_s - node.heard_s
    tone, word, sentence = _headline(name, node, silent_s)
    values, mount = node.values("progress"), node.values("mount")
    is_watching = "mount" in node.statuses and "progress" not in node.statuses
    is_answered = node.answer is not None and now_s - node.answered_s < ANSWER_FOR_S
    return View(
        node=name,
        nodes=names,
        tone=tone,
        word=word,
        sentence=sentence,
        title="" if is_watching else _title(node.pose),
        values=tuple(_values(node)),
        bars=() if is_watching else tuple(_bar(axis, values) for axis in AXES),
        watched=tuple(_watched(axis, mount) for axis in AXES) if is_watching else (),
        result=() if is_watching else tuple(_result(node)),
        reasons=tuple(_numbered(values, "reason")),
        health=tuple(_health(node, silent_s)),
        answer=node.answer if is_answered else None,
    )


# -------------------------------------------------------------------- headline


def _headline(name: str, node: _Node, silent_s: float) -> tuple[Tone, str, str]:
    """Sign, word and sentence: what a person should know or do first."""
    if not node.statuses:
        who = f"of {name}" if name else "of a calibrator"
        text = f"Nothing heard {who} yet. Is the node running, on the same ROS domain and network?"
        return Tone.UNKNOWN, "NO NODE", text
    if silent_s > SILENT_AFTER_S:
        text = f"The node has said nothing for {silent_s:.0f} s. What is below is older than that."
        return Tone.BAD, SILENT, text
    for part in ("extrinsic", "mount", "parent input", "child input", "journal"):
        status = node.statuses.get(part)
        if status is not None and status.level >= ERROR:
            return Tone.BAD, _ERROR_WORDS.get(part, "BROKEN"), _sentence(status.text)
    progress = node.statuses.get("progress")
    for part in ("parent input", "child input"):
        status = node.statuses.get(part)
        if status is not None and status.level == WARN:
            return Tone.ACT, "CHECK INPUT", _sentence(status.text)
    checks = node.statuses.get("stream checks")
    if checks is not None and _tone(checks) is Tone.ACT:
        return Tone.ACT, "CHECK THE STREAMS", _sentence(checks.text)
    if progress is not None:
        return _of_progress(progress)
    if "mount" in node.statuses:
        return _of_mount(node.statuses["mount"])
    return _of_extrinsic(node.statuses.get("extrinsic"))


_ERROR_WORDS = {"mount": "MOUNT MOVED", "parent input": "BAD INPUT", "child input": "BAD INPUT"}


def _of_progress(progress: Status) -> tuple[Tone, str, str]:
    sentence = _sentence(progress.text)
    if sentence.startswith("Stop: "):  # the result was good, the streams no longer are
        return Tone.ACT, "CHECK THE STREAMS", sentence
    if progress.values.get("done") == "true":
        return Tone.GOOD, "DONE", sentence
    if progress.values.get("verdict") == "no result":
        return Tone.BUSY, "START", sentence
    if progress.level >= WARN:
        return Tone.ACT, "CHANGE THE MOTION", sentence
    return Tone.BUSY, "GO ON", sentence


def _of_mount(status: Status) -> tuple[Tone, str, str]:
    """Of a node that watches the mount, which has not moved."""
    if status.level != OK:
        return Tone.ACT, "NOT WATCHING", _sentence(status.text)
    if status.text.startswith("learning"):
        return Tone.BUSY, LEARNING, _sentence(status.text)
    return Tone.GOOD, "WATCHING", _sentence(status.text)


def _of_extrinsic(status: Status | None) -> tuple[Tone, str, str]:
    """Of a node that sets no goal."""
    if status is None:
        return Tone.UNKNOWN, "LISTENING", "The node is there, and says nothing of a result yet."
    if status.level == OK:
        return Tone.GOOD, "GOOD", _sentence(status.text)
    return Tone.ACT, "GO ON", _sentence(status.text)


def _sentence(text: str) -> str:
    """With a capital and a full stop, unless it begins with a name such as ``/lidar``."""
    return f"{text[:1].upper()}{text[1:]}" + ("" if text.endswith((".", "!", "?")) else ".")


# ------------------------------------------------------------------------ bars


def _bar(axis: str, values: Mapping[str, str]) -> Bar:
    sigma, target = (_number(values, f"{what}.{axis}") for what in ("sigma", "target"))
    left_s = _number(values, f"seconds_left.{axis}")
    unit = AXES[axis]
    share = min(1.0, (target / sigma) ** 2) if sigma > 0 and target > 0 else float(sigma == 0)
    tone, word = _state(sigma, target, left_s, is_behind=values.get("limiting_axis") == axis)
    return Bar(
        axis=axis,
        share=share if math.isfinite(share) else 0.0,
        tone=tone,
        word=word,
        sigma=small(sigma, unit),
        target=small(target, unit),
        difference=_difference(axis, values),
    )


def _state(sigma: float, target: float, left_s: float, is_behind: bool) -> tuple[Tone, str]:
    if not math.isfinite(sigma):
        return Tone.UNKNOWN, "not seen yet"
    if left_s == 0:
        return Tone.GOOD, "enough"
    left = f"{duration(left_s)} left" if math.isfinite(left_s) else "not with this motion"
    if sigma <= target:
        return Tone.BUSY, f"nearly: {left}"
    return (Tone.ACT if is_behind else Tone.BUSY), left


def _number(values: Mapping[str, str], key: str) -> float:
    """A value as a number; nan for a word such as ``unobservable``, or if it is missing."""
    try:
        return float(values[key])
    except (KeyError, ValueError):
        return math.nan


def small(value: float, unit: str) -> str:
    """A standard deviation or a difference, short; empty if not known."""
    if not math.isfinite(value):
        return ""
    return angle(value) if unit == "rad" else length(value)


# ------------------------------------------------------------------------ pose


def _values(node: _Node) -> Iterator[tuple[str, str]]:
    """Each axis with its value and standard deviation; a question mark if it is not observed."""
    if node.pose is None:
        return
    said = node.values("extrinsic")
    for (axis, unit), value in zip(AXES.items(), node.pose.values, strict=True):
        if unit == "m":
            sigma = _number(said, f"sigma {axis} (mm)") / 1000.0
            text = f"{value:.3f} m"
        else:
            sigma = math.radians(_number(said, f"sigma {axis} (deg)"))
            text = f"{math.degrees(value):.2f}"
        yield axis, f"{text} ± {small(sigma, unit)}" if math.isfinite(sigma) else "? not observed"


# ------------------------------------------------- health, verdict, comparison

_PARTS = ("parent input", "child input", "stream checks", "journal")
_TONES = {OK: Tone.GOOD, WARN: Tone.ACT}


def _tone(status: Status) -> Tone:
    """Of a part of the node; a check that has not been made yet asks for nothing."""
    if status.values.get("checked") == "not yet":
        return Tone.BUSY
    return _TONES.get(status.level, Tone.BAD)


def _health(node: _Node, silent_s: float) -> Iterator[Line]:
    is_old = silent_s > SILENT_AFTER_S
    for part in _PARTS:
        status = node.statuses.get(part)
        if status is not None:
            tone = Tone.UNKNOWN if is_old else _tone(status)
            topic = status.values.get("topic", "")
            about = f"{status.text}, {topic}" if topic and topic not in status.text else status.text
            yield Line(tone, part, about)


_VERDICTS = {"USE": Tone.GOOD, "USE WITH CARE": Tone.ACT, "DO NOT USE": Tone.BAD}


# By the first words of the state; what is broadcast begins with other ones.
_BROADCAST = {"not yet": Tone.BUSY, "refused": Tone.ACT}


def _verdict(word: str) -> Line:
    text = word if word in _VERDICTS else "no result yet"
    return Line(_VERDICTS.get(word, Tone.UNKNOWN), "verdict", text)


def _result(node: _Node) -> Iterator[Line]:
    values = node.values("progress")
    yield _verdict(values.get("verdict", ""))
    yield _comparison(values)
    state = node.values("extrinsic").get("broadcast on /tf_static", "off")
    if state != "off":
        tone = _BROADCAST.get(state.partition(":")[0], Tone.GOOD)
        yield Line(tone, "on /tf_static", state)


def _numbered(values: Mapping[str, str], name: str) -> Iterator[str]:
    """Values of NAME.1, NAME.2 and so on."""
    number = 1
    while f"{name}.{number}" in values:
        yield values[f"{name}.{number}"]
        number += 1


_COMPARED = {"same": Tone.GOOD, "moved": Tone.ACT}


def _comparison(values: Mapping[str, str]) -> Line:
    verdict = values.get("comparison", "")
    if not verdict:
        return Line(Tone.UNKNOWN, "installed", "nothing to compare with (parameter installed)")
    text = values.get("comparison_sentence") or verdict
    return Line(_COMPARED.get(verdict, Tone.UNKNOWN), "installed", text)


def _watched(axis: str, values: Mapping[str, str]) -> Line:
    """Whether an axis of a watched mount has moved, or what ten minutes of motion would show."""
    unit = AXES[axis]
    shift, sigma = _number(values, f"shift.{axis}"), _number(values, f"shift_sigma.{axis}")
    if abs(shift) > _CLEARLY * sigma:
        return Line(Tone.BAD, axis, f"moved by {small(shift, unit)} ± {small(sigma, unit)}")
    visible = _number(values, f"visible_10min.{axis}")
    if math.isfinite(visible):
        return Line(Tone.GOOD, axis, f"a change of {small(visible, unit)}")
    return Line(Tone.UNKNOWN, axis, "nothing yet")


def _difference(axis: str, values: Mapping[str, str]) -> str:
    """Result minus what is installed, with its standard deviation; unknown without one."""
    difference = _number(values, f"difference.{axis}")
    sigma = _number(values, f"difference_sigma.{axis}")
    if not math.isfinite(difference):
        return ""
    if not math.isfinite(sigma):
        return "unknown"
    sign = "+" if difference >= 0 else ""
    return f"{sign}{small(difference, AXES[axis])} ± {small(sigma, AXES[axis])}"


def _title(pose: Pose | None) -> str:
    if pose is None:
        return "no extrinsic yet"
    return f"pose of {pose.child_frame} in {pose.parent_frame}"
