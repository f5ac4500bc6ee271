"""Tells corrupt stamps from gaps, late messages, bags that loop and clocks that were reset.

A message near one of those taken last is taken at once. Any other waits: six that follow each other
are a real change, a gap or a jump of the clock; fewer, before the stream goes on where it was, have
corrupt stamps and are dropped.
"""

import itertools
import statistics
from collections import deque
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Any

# A real change this far back is a jump of the clock, and a new session.
BACKWARD_JUMP_NS = 1_000_000_000

# So many messages that follow each other are believed: more than corrupt ones come together.
WITNESSES = 6

# Near another message: within so much (ns, periods). Messages that wait follow each other, and
# those at the end of a stream follow it, within the longest pause (ns).
_NEAR_NS, _NEAR_PERIODS, _LONGEST_PAUSE_NS = 1_000_000_000, 5, 60_000_000_000

# A stream is silent after so long (s, periods); at the start of a session, after so long (s).
_SILENCE_S, _SILENCE_PERIODS, _START_SILENCE_S = 0.5, 5, 2.0

# The period is the median of so many intervals.
_INTERVALS = 15

# After one stream has jumped back, the others' messages of before are left out for so long (s):
# theirs are about to jump, too.
_OTHERS_FOLLOW_S = 2.0

Stamped = tuple[int, Any]


class Verdict(Enum):
    """What is to be done with a message, and with those that come back with it."""

    TAKE = auto()
    HOLD = auto()
    JUMPED_BACK = auto()
    OUTDATED = auto()


@dataclass
class Judgement:
    """What a message has brought about.

    Attributes
    ----------
    verdict : Verdict
        JUMPED_BACK: the messages taken are the first of a new session.
    taken : list of (stamp_ns, message)
        To be used now; messages that waited are among them.
    dropped : list of int
        Corrupt stamps of messages that are not to be used.
    """

    verdict: Verdict
    taken: list[Stamped] = field(default_factory=list)
    dropped: list[int] = field(default_factory=list)


class StampGuard:
    """Watches the stamps of one stream.

    Attributes
    ----------
    last_ns : int or None
        Newest stamp taken in the session.
    """

    def __init__(self) -> None:
        self._outdated_until_s: float | None = None
        self._intervals: deque[int] = deque(maxlen=_INTERVALS)
        self._arrived_s = 0.0
        self._begin()

    def _begin(self) -> None:
        self.last_ns: int | None = None
        # Those taken last: corrupt ones come WITNESSES - 1 together, and are never half of these.
        self._recent_ns: deque[int] = deque(maxlen=2 * WITNESSES - 1)
        self._held: list[Stamped] = []

    @property
    def held(self) -> int:
        """Number of messages that wait to be judged."""
        return len(self._held)

    def check(self, stamp_ns: int, message: Any, now_s: float) -> Judgement:
        """Judge the next message.

        Parameters
        ----------
        stamp_ns : int
        message : object
        now_s : float
            Steady time.
        """
        self._arrived_s = now_s
        latest_ns = itertools.islice(reversed(self._recent_ns), WITNESSES)
        is_near = any(self._is_near(stamp_ns, other_ns) for other_ns in latest_ns)
        if self._outdated_until_s is not None and now_s >= self._outdated_until_s:
            self._outdated_until_s = None
        if is_near and self._outdated_until_s is not None:
            return Judgement(Verdict.OUTDATED)
        if is_near:
            self._take(stamp_ns)
            return Judgement(Verdict.TAKE, [(stamp_ns, message)], self._drop_held())
        dropped = []
        if self._held and not 0 < abs(stamp_ns - self._held[-1][0]) <= _LONGEST_PAUSE_NS:
            dropped = self._drop_held()
        self._held.append((stamp_ns, message))
        judgement = self._believe() if self.held >= WITNESSES else Judgement(Verdict.HOLD)
        judgement.dropped = dropped
        return judgement

    def flush(self, now_s: float) -> Judgement:
        """Judge the messages that wait if the stream is silent; to be called often."""
        silence_s = max(_SILENCE_S, _SILENCE_PERIODS * self._period_ns * 1e-9)
        if self.last_ns is None:
            silence_s = max(silence_s, _START_SILENCE_S)
        if not self._held or now_s - self._arrived_s < silence_s:
            return Judgement(Verdict.HOLD)
        # A short stream, or the last ones after a pause: as good as it gets.
        is_after = self.last_ns is None or 0 < self._held[0][0] - self.last_ns <= _LONGEST_PAUSE_NS
        if is_after:
            return self._believe()
        return Judgement(Verdict.HOLD, dropped=self._drop_held())

    def restart(self, now_s: float | None = None) -> None:
        """Begin a new session; with ``now_s`` (steady time) as another stream has jumped back."""
        if now_s is None:
            self._begin()
            self._outdated_until_s = None
        elif self.last_ns is not None:
            follow_s = _OTHERS_FOLLOW_S + 2 * WITNESSES * self._period_ns * 1e-9
            self._outdated_until_s = now_s + follow_s

    def resume(self, last_ns: int | None) -> None:
        """Go on with a session whose newest stamp this is."""
        self.last_ns = last_ns
        if last_ns is not None:
            self._recent_ns.append(last_ns)

    @property
    def _period_ns(self) -> float:
        return statistics.median(self._intervals) if self._intervals else 0.0

    def _is_near(self, stamp_ns: int, other_ns: int) -> bool:
        apart_ns = abs(stamp_ns - other_ns)
        return apart_ns <= _NEAR_NS or apart_ns <= _NEAR_PERIODS * self._period_ns

    def _take(self, stamp_ns: int) -> None:
        if self._recent_ns and stamp_ns > self._recent_ns[-1]:
            self._intervals.append(stamp_ns - self._recent_ns[-1])
        self._recent_ns.append(stamp_ns)
        self.last_ns = stamp_ns if self.last_ns is None else max(self.last_ns, stamp_ns)

    def _drop_held(self) -> list[int]:
        """Drop the messages that wait; returns their stamps."""
        dropped, self._held = [stamp_ns for stamp_ns, _ in self._held], []
        return dropped

    def _believe(self) -> Judgement:
        """Take the messages that wait."""
        members, self._held = self._held, []
        before_ns = statistics.median_low(self._recent_ns) if self._recent_ns else members[0][0]
        jumped = members[0][0] < before_ns - BACKWARD_JUMP_NS
        followed, self._outdated_until_s = self._outdated_until_s is not None, None
        if jumped:
            self._begin()
        # The rate may be another one.
        for stamp_ns, _ in members:
            self._take(stamp_ns)
        self._intervals.clear()
        self._intervals.extend(
            later - earlier
            for (earlier, _), (later, _) in itertools.pairwise(members)
            if later > earlier
        )
        verdict = Verdict.JUMPED_BACK if jumped and not followed else Verdict.TAKE
        return Judgement(verdict, members)
