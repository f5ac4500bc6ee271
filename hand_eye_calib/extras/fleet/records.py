"""Part of a common result that describes its recordings."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from hand_eye_calib.core.results.reasons import Ground


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """A recording: its own result, and its difference from the common result.

    Attributes
    ----------
    name, headline : str
    left_out : str
        Reason why the recording is not in the common result; empty if it is.
    deviations, sigmas : mapping of str to float
        Deviations from the common result by axis (m or rad), and their standard deviations, which
        contain the usual scatter between recordings. Axes that the recording does not determine are
        NaN (None in files).
    time_offset_s, scale, stamp_ns
        Fields of the recording's own result.
    """

    name: str
    headline: str
    left_out: str = ""
    deviations: Mapping[str, float] = field(default_factory=dict)
    sigmas: Mapping[str, float] = field(default_factory=dict)
    time_offset_s: float = 0.0
    scale: float = 1.0
    stamp_ns: int = 0


@dataclass(frozen=True, kw_only=True)
class Together:
    """Agreement of several recordings of one rig.

    Attributes
    ----------
    kind : str
        "single" for a single recording; "agree"; "scatter" for more scatter than usual; "one off"
        if one recording contradicts the others; "moved" if the mount moved between two recordings;
        "differ" if two recordings contradict each other, and there is no third.
    sentence : str
        The agreement in words.
    scatter : mapping of str to float
        Standard deviation between recordings by axis (m or rad), in addition to those of the
        recordings.
    recordings : tuple of Recorded
        In order of time.
    """

    kind: str
    sentence: str
    scatter: Mapping[str, float]
    recordings: tuple[Recorded, ...]


#: Kinds of agreement for each rule of the verdict.
RULES = {
    "recordings_differ": ("differ", "moved"),
    "recordings": ("one off", "scatter"),
}

#: Kinds of agreement of recordings that contradict each other.
CONTRADICTIONS = ("differ", "moved", "one off")

# Advice by kind of agreement.
_ADVICE = {
    "differ": "record once more: three recordings reveal which one is off",
    "moved": "calibrate only from the recordings after the change",
    "one off": "find the cause in that recording, which is left out",
    "scatter": "find the cause of the differences between recordings; the "
    "standard deviations contain the scatter",
}


def find_kinds(rule: str, result: Any) -> Iterator[Ground]:
    """Yield a ground if the agreement of the recordings has a kind for which the rule is."""
    together = result.parts.get("together")
    if together and together.kind in RULES[rule]:
        yield Ground(together.sentence, _ADVICE[together.kind])


def is_in_headline(result: Any) -> bool:
    """Whether the headline of a result contains the sentence about its recordings."""
    return any(reason.rule in RULES for reason in result.reasons_in_headline)


def details(together: Together, result: Any) -> list[str]:
    """Return lines of text about the recordings of a result."""
    lines = [] if is_in_headline(result) else [together.sentence]
    for recording in together.recordings:
        left_out = recording.left_out and f"left out, {recording.left_out}"
        lines.append(f"{recording.name}: {left_out or recording.headline}")
    return lines
