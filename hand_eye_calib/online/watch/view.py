"""Content that ``watch`` displays about a node, on a terminal or in a browser."""

from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias

# Requests that a person can send to the node, with their keys on a terminal.
KEYS = {
    "solve": "s",
    "save": "w",
    "reset": "r",
    "recalibrate": "c",
    "acknowledge": "a",
    "forget": "f",
}


class Tone(Enum):
    """Severity with its sign. The sign is for people who cannot distinguish the colours."""

    GOOD = "✓"
    BUSY = "▶"
    ACT = "!"
    BAD = "✗"
    UNKNOWN = "?"


@dataclass(frozen=True)
class Line:
    """A line with a sign, a name and a text, such as the condition of an input."""

    tone: Tone
    name: str
    text: str


Lines: TypeAlias = tuple[Line, ...]
Texts: TypeAlias = tuple[str, ...]
# Pairs of an axis and a text.
AxisTexts: TypeAlias = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Bar:
    """Progress of one axis of the parent sensor's frame towards its target.

    Attributes
    ----------
    name : str
        Name of the axis, such as "about z".
    meaning : str
        Meaning of the axis on a vehicle, such as "turn"; empty if the parent does not move like a
        vehicle.
    share : float
        Length of the bar, 0 to 1: the information so far, divided by the information that the
        target requires. Information is the inverse of the variance.
    tone : Tone
    word : str
        Progress in words, such as "enough". The time left is only in the headline.
    sigma : str
        Standard deviation and target, such as "± 0.065 deg of 0.3 deg".
    difference : str
        Difference of the result from the installed transform; empty if unknown.
    """

    name: str
    meaning: str
    share: float
    tone: Tone
    word: str
    sigma: str
    difference: str


@dataclass(frozen=True)
class View:
    """All displayed content about a node.

    Attributes
    ----------
    node : str
        Fully qualified name of the node.
    tone, word, sentence
        Severity of the headline, its one or two words in capitals, and its sentence.
    advice : str
        Next action; empty if the sentence contains it.
    facts : str
        Amount of motion, and age of the result.
    pose_of : str
        Frames of the pose in words, "of CHILD in PARENT"; empty without a result.
    title : str
        Name of the pose in ``values``.
    values : tuple of (str, str)
        Axes and values of the printed pose.
    bars : tuple of Bar
        Progress of each axis; empty if the node monitors the mount.
    watched : tuple of Line
        Axes of a monitored mount; empty if the node calibrates.
    result : tuple of Line
        Verdict, warnings, priors, comparison and files of the result.
    reasons : tuple of str
        Reasons for the verdict.
    health : tuple of Line
        Conditions of inputs, stream checks and journal.
    topics : tuple of str
        Topics with poses, if an input lacks poses.
    buttons : tuple of str
        Requests that are possible now, the recommended request first.
    asked : str
        Request that the headline recommends; empty if there is none.
    by_hand : tuple of str
        Axes whose prior a person may set, correct or remove, in order of importance.
    priors : tuple of (str, str)
        Axes with a prior, and the priors as typed by the user.
    saved_in : str
        Directory of the saved files; empty if nothing is saved.
    answer : tuple of Line
        Answer to the last button, for some seconds.
    """

    node: str
    tone: Tone
    word: str
    sentence: str
    advice: str = ""
    facts: str = ""
    pose_of: str = ""
    title: str = ""
    values: AxisTexts = ()
    bars: tuple[Bar, ...] = ()
    watched: Lines = ()
    result: Lines = ()
    reasons: Texts = ()
    health: Lines = ()
    topics: Texts = ()
    buttons: Texts = ()
    asked: str = ""
    by_hand: Texts = ()
    priors: AxisTexts = ()
    saved_in: str = ""
    answer: Lines = ()

    @property
    def text(self) -> str:
        """Sentence and advice in one line."""
        return f"{self.sentence} {self.advice}".rstrip()
