"""Tells corrupt stamps from gaps, late messages, bags that loop and clocks that were reset.

A message near one of those taken last is taken at once. Any other waits: six that follow each other
are a real change, a gap or a jump of the clock. Fewer, before the stream goes on where it was, have
corrupt stamps and are dropped.
"""

import itertools
import math
import statistics
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

# So many messages that follow each other are believed: more than corrupt ones come together.
WITNESSES = 6

# Near another message: within so much (ns), or so many periods. A real change farther back is a
# jump of the clock, and a new session. Messages that wait follow each other within the longest
# pause (ns).
NEAR_NS, _PERIODS, _LONGEST_PAUSE_NS = 1_000_000_000, 5, 60_000_000_000

# A stream is silent after so long (s). After one has jumped back, the others' messages of before
# are left out for as long.
SILENT_AFTER_S = 2.0

Stamped = tuple[int, Any]


class Judgement(NamedTuple):
    """What a message has brought about: stamps and messages to be used now, of which some have
    waited; corrupt stamps of messages that are not to be used; whether those to be used are the
    first of a new session.
    """

    taken: Sequence[Stamped] = ()
    dropped: Sequence[int] = ()
    jumped_back: bool = False


class StampGuard:
    """Watches the stamps of one stream; ``last_ns`` is the newest one taken in the session, None
    if there is none.
    """

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._outdated_until_s = -math.inf
        self.last_ns: int | None = None
        # Those taken last: corrupt ones come WITNESSES - 1 together, and are never half of these.
        self._recent_ns: deque[int] = deque(maxlen=2 * WITNESSES - 1)
        self._held: list[Stamped] = []

    def check(self, stamp_ns: int, message: Any, now_s: float) -> Judgement:
        """Judge the next message; ``now_s`` is steady time."""
        if self._is_near(stamp_ns):
            if now_s < self._outdated_until_s:
                return Judgement()
            return Judgement(self._take([(stamp_ns, message)]), self._drop_held())
        dropped = []
        if self._held and not 0 < abs(stamp_ns - self._held[-1][0]) <= _LONGEST_PAUSE_NS:
            dropped = self._drop_held()
        self._held.append((stamp_ns, message))
        judgement = self._believe(now_s) if len(self._held) >= WITNESSES else Judgement()
        return judgement._replace(dropped=dropped)

    def restart(self, now_s: float | None = None) -> None:
        """Begin a new session; with ``now_s`` (steady time) as another stream has jumped back."""
        if now_s is None:
            self._begin()
        elif self.last_ns is not None:
            self._outdated_until_s = now_s + SILENT_AFTER_S
            self._outdated_until_s += 2 * WITNESSES * self._period_ns() * 1e-9

    def resume(self, last_ns: int | None) -> None:
        """Go on with a session whose newest stamp this is."""
        self.last_ns = last_ns
        if last_ns is not None:
            self._recent_ns.append(last_ns)

    def _period_ns(self) -> float:
        """Median interval of the messages taken last."""
        intervals = [late - early for early, late in itertools.pairwise(sorted(self._recent_ns))]
        return statistics.median(intervals) if intervals else 0.0

    def _is_near(self, stamp_ns: int) -> bool:
        apart_ns = min((abs(stamp_ns - each) for each in self._recent_ns), default=math.inf)
        return apart_ns <= NEAR_NS or apart_ns <= _PERIODS * self._period_ns()

    def _take(self, messages: list[Stamped]) -> list[Stamped]:
        stamps_ns = [stamp_ns for stamp_ns, _ in messages]
        self._recent_ns.extend(stamps_ns)
        self.last_ns = max(stamps_ns if self.last_ns is None else [self.last_ns, *stamps_ns])
        return messages

    def _drop_held(self) -> list[int]:
        """Drop the messages that wait; returns their stamps."""
        dropped, self._held = [stamp_ns for stamp_ns, _ in self._held], []
        return dropped

    def _believe(self, now_s: float) -> Judgement:
        """Take the messages that wait."""
        members, self._held = self._held, []
        before_ns = statistics.median_low(self._recent_ns or [members[0][0]])
        jumped = members[0][0] < before_ns - NEAR_NS
        follows = now_s < self._outdated_until_s
        self._outdated_until_s = -math.inf
        if jumped:
            self._begin()
        return Judgement(self._take(members), jumped_back=jumped and not follows)
