"""Several recordings, as a part of their common result."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """One of several recordings, as it stands by itself and beside the others.

    Attributes
    ----------
    name, headline : str
    left_out : str
        Why it is no part of the result; empty if it is.
    deviations, sigmas : mapping of str to float
        By axis, m or rad: from the common result, and their standard deviations with the usual
        scatter of recordings; NaN (None in files) if it does not know the axis.
    time_offset_s, scale, stamp_ns
        As of its own result.
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
    """What several recordings of one rig say together.

    Attributes
    ----------
    kind : str
        single, agree, scatter (more than recordings of one rig do), one off, moved (between two of
        them), or differ (two do, and nobody knows which is wrong).
    sentence : str
    scatter : mapping of str to float
        By axis, m or rad: what differs from recording to recording, beyond what each states.
    recordings : tuple of Recorded
        In the order of time.
    """

    kind: str
    sentence: str
    scatter: Mapping[str, float]
    recordings: tuple[Recorded, ...]


# What to do if recordings belong together in one of these ways.
_OF_RECORDINGS = {
    "differ": "record once more: then the one that is off shows",
    "moved": "calibrate from the recordings since then alone",
    "one off": "find out what was different in that recording; it is left out",
    "scatter": "look for what changes from recording to recording; the standard deviations contain "
    "the scatter",
}


def find_kinds(kinds: Sequence[str], result: Any) -> Iterator[tuple[Any, ...]]:
    """Yield the reason of a result whose recordings belong together in one of these ways."""
    together = result.parts.get("together")
    if together and together.kind in kinds:
        yield together.sentence, _OF_RECORDINGS[together.kind], (), {}


def details(together: Together, headline: str) -> list[str]:
    """Return lines about the recordings, for a person."""
    lines = [] if together.sentence in headline else [together.sentence]
    for recording in together.recordings:
        left_out = recording.left_out and f"left out, {recording.left_out}"
        lines.append(f"{recording.name}: {left_out or recording.headline}")
    return lines
