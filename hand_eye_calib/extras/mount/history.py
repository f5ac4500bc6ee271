"""History of a mount: changes between sessions, detected from the digests of the sessions.

In session k, the offset of the child sensor from the installed pose is d + u_k, with an error
u_k ~ N(0, W) that differs from session to session. The information H_k and the score S_k in the
digest measure this offset. If the mount changes before session c, the offset is d + s + u_k from
session c on, with the shift s.

The change is before the session c with the largest likelihood ratio of a shift against no shift, as
in the monitor (:mod:`hand_eye_calib.extras.mount.monitor`). The sessions on each side of the change
are then searched for further changes (binary segmentation: A. Scott, M. Knott, *A cluster analysis
method*, 1974).
"""

from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np

from hand_eye_calib.core.assessment import change, moved
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.blocks import (
    Blocks,
    information,
    inverse,
    score,
    shift_evidence,
)
from hand_eye_calib.core.base.plain import plain
from hand_eye_calib.core.base.text import counted
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.mount.digest import Digest
from hand_eye_calib.extras.mount.monitor import KNOCKS, TUNING

# Covariance (6, 6) of an unknown offset.
_UNKNOWN = np.diag(change.UNKNOWN**2)


@dataclass(frozen=True)
class Changepoint:
    """A change of the mount.

    Attributes
    ----------
    index : int
        Index of the first session after the change.
    log_ratio : float
        Logarithm of the likelihood ratio of this change against no change.
    shift : Moved
        Shift along and about the axes of the parent sensor's frame.
    """

    index: int
    log_ratio: float
    shift: change.Moved


@dataclass(frozen=True)
class Event:
    """A change of the mount or an alarm of the monitor.

    Attributes
    ----------
    index : int
        Index of the first digest since the event.
    is_change : bool
        Whether the history contains a change; otherwise only the monitor has raised an alarm.
    day : str
        Date and time (UTC): of the shift, or of the first session after it.
    when : str
        Kind and time of the event in words.
    what : str
        Axes that have moved, and by how much.
    """

    index: int
    is_change: bool
    day: str
    when: str
    what: str


@dataclass(frozen=True)
class History:
    """History of one mount.

    Attributes
    ----------
    sessions : sequence of Digest
        In order of time.
    digests : sequence of Digest
        The same; a session in which the mount has moved is divided at the time of the shift.
    cuts : set of int
        Indices of digests from which on a new offset is estimated.
    changes : sequence of Changepoint
        In order of time.
    offsets : sequence of Moved
        For each digest, the offset from the installed pose, along and about the axes of the parent
        sensor's frame. It is estimated from all digests since the last cut.
    """

    sessions: Sequence[Digest]
    digests: Sequence[Digest]
    cuts: Set[int]
    changes: Sequence[Changepoint]
    offsets: Sequence[change.Moved]

    @classmethod
    def of(cls, sessions: Sequence[Digest]) -> "History":
        """Return the history of the sessions with these digests."""
        digests: list[Digest] = []
        cuts = set()
        for session in sessions:
            first, *later = session.parts()
            digests.append(first)
            if later:
                cuts.add(len(digests))
            digests += later
        changes = find_changes(digests)
        cuts |= {changepoint.index for changepoint in changes}
        return cls(sessions, digests, cuts, changes, _offsets(digests, cuts))

    @property
    def has_moved(self) -> bool:
        """Whether there is a change between sessions, or an alarm within one."""
        return bool(self.events)

    @property
    def events(self) -> list[Event]:
        """Changes and alarms in order of time.

        If an alarm is also a change, it is listed once. If the mount had moved before the session,
        the alarm repeats an earlier event, and is not listed.
        """
        changes = {item.index: item for item in self.changes}
        events = []
        for index, digest in enumerate(self.digests):
            if index in changes:
                # Only the monitor knows the time of a shift within a session.
                place = "at" if digest.alarm else "before"
                when = f"moved {place} {digest.day}"
                what = changes[index].shift.what
                events.append(Event(index, True, digest.day, when, what))
            elif digest.alarm and (index in self.cuts or not events):
                when = f"alarm at {digest.day}"
                events.append(
                    Event(index, False, digest.day, when, digest.alarm)
                )
        return events

    @property
    def newest_event_ns(self) -> int:
        """Time of the newest change or alarm (ns); 0 without any."""
        events = self.events
        return self.digests[events[-1].index].start_ns if events else 0

    @property
    def sentence(self) -> str:
        """The verdict in one line, with the newest change or alarm."""
        first = self.sessions[0]
        mount = f"Mount of {first.child_frame} on {first.parent_frame}"
        sessions = counted(len(self.sessions), "session")
        if not self.events:
            return f"{mount}: no change in {sessions}"
        newest = self.events[-1]
        return f"{mount}: {newest.when}: {newest.what} ({sessions})"

    def document(self) -> dict[str, Any]:
        """Return days of sessions, changes and alarms as plain values."""
        rows = [
            {
                "session": self.digests[item.index].day,
                "sentence": item.shift.what,
                "axes": item.shift.axes,
            }
            for item in self.changes
        ]
        return {
            "sessions": [digest.day for digest in self.sessions],
            "changes": plain(rows),
            "alarms": {
                digest.day: digest.alarm
                for digest in self.digests
                if digest.alarm
            },
        }


def _offsets(digests: Sequence[Digest], cuts: Set[int]) -> list[change.Moved]:
    """Return the offset from the installed pose at each digest, see :class:`History`."""
    offsets = []
    evidence = np.zeros((6, 7))
    for index, digest in enumerate(digests):
        if index in cuts:
            evidence = np.zeros((6, 7))
        # All digests since the last cut have one offset, so their evidence is added.
        evidence = evidence + _evidence_on_common_offset(digest)
        to_parent = se3.block_diagonal(se3.rotation_of(digest.installed))
        offsets.append(_shift_of(evidence, to_parent))
    return offsets


def find_changes(digests: Sequence[Digest]) -> list[Changepoint]:
    """Return the changes of the mount, in order of time.

    A change with index 0 means that the mount differs from the installed pose in the first session.
    """
    if not digests:
        return []
    tables = np.array(
        [_evidence_on_common_offset(digest) for digest in digests]
    )
    to_parent = se3.block_diagonal(se3.rotation_of(digests[0].installed))
    changes = _changes(tables, 0, digests[0].covariance, to_parent, cuts_from=0)
    return sorted(changes, key=lambda changepoint: changepoint.index)


def _evidence_on_common_offset(digest: Digest) -> FloatArray:
    """Return the evidence ``[H S]`` (6, 7) of a session on d, the offset common to all sessions.

    This evidence is weaker than the evidence in the digest, because of the error u_k.
    """
    return shift_evidence(digest.evidence, np.zeros(6), digest.wander)


def _changes(
    tables: FloatArray,
    start: int,
    prior: FloatArray,
    to_parent: FloatArray,
    cuts_from: int,
) -> Iterator[Changepoint]:
    """Yield the changes within a sequence of n sessions, by binary segmentation.

    Parameters
    ----------
    tables : (n, 6, 7) array
        Evidence of each session on the common offset.
    start : int
        Index of the first session of the sequence among all sessions.
    prior : (6, 6) array
        Prior covariance of the offset at the start of the sequence.
    to_parent : (6, 6) array
        Rotation of tangent vectors from the child's to the parent's frame.
    cuts_from : int
        First session of the sequence before which a change is possible: 0 or 1.
    """
    cuts = np.arange(cuts_from, len(tables))
    if not len(cuts):
        return
    blocks = Blocks(tables)
    after = blocks.since(cuts)
    before = blocks.total - after
    # Offset before each possible change, and its covariance.
    covariances = inverse(inverse(prior) + information(before))
    offsets = se3.times(covariances, score(before))
    shifts = shift_evidence(after, offsets, covariances)
    ratios = moved.log_ratio(shifts, KNOCKS[:, None]).max(axis=0)
    best = int(np.argmax(ratios))
    if ratios[best] < TUNING.threshold:
        return
    cut = int(cuts[best])
    yield Changepoint(
        start + cut, float(ratios[best]), _shift_of(shifts[best], to_parent)
    )
    yield from _changes(tables[:cut], start, prior, to_parent, cuts_from)
    yield from _changes(
        tables[cut:], start + cut, _UNKNOWN, to_parent, cuts_from=1
    )


def _shift_of(table: FloatArray, to_parent: FloatArray) -> change.Moved:
    """Return the most likely shift from the evidence ``[H S]`` (6, 7) on it."""
    prior = inverse(moved.shift_covariance(1.0, 1.0))
    covariance = np.linalg.inv(information(table) + prior)
    values = to_parent @ covariance @ score(table)
    return change.moved(
        values, to_parent @ covariance @ to_parent.T, np.zeros(6)
    )
