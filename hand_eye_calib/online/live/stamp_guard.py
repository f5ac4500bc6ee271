"""Check the stamps of a stream: corrupt stamps, gaps, bags that loop, clocks that were reset.

A message whose stamp is near the last stamps is accepted at once. Any other message is held back.
If six messages are held in sequence, the change of their stamps is real: a gap, a bag that loops,
or a clock that was reset. If the stream continues as before after fewer messages, the held messages
had corrupt stamps and are dropped.
"""

import itertools
import math
import statistics
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

# If at least this number of messages is held in sequence, the change of their stamps is real.
# Corrupt stamps come in shorter sequences.
MIN_HELD = 6

# Largest difference (ns) between stamps that are near each other. A larger jump back begins a new
# session.
NEAR_NS = 1_000_000_000

# Stamps are also near each other if they differ by at most this number of periods of the stream. A
# longer pause is reported.
NEAR_PERIODS = 5

# Longest interval (ns) between two messages that are held in sequence.
_MAX_PAUSE_NS = 60_000_000_000

# A stream is silent after this time (s) without a message. If a stream jumps back, old messages of
# the other streams are dropped for the same time.
SILENT_AFTER_S = 2.0

# A stamp (ns) and its message.
Stamped: TypeAlias = tuple[int, Any]


class Judgement(NamedTuple):
    """Decision of a :class:`StampGuard` about a message and about the held messages.

    Attributes
    ----------
    taken : sequence of (int, message)
        Stamps and messages to use now: the message, or all messages that were held.
    dropped : sequence of int
        Corrupt stamps of held messages. These messages are dropped.
    jumped_back : bool
        Whether the messages begin a new session.
    repeated : sequence of int
        The stamp of the message, if the last held message has the same stamp.
    """

    taken: Sequence[Stamped] = ()
    dropped: Sequence[int] = ()
    jumped_back: bool = False
    repeated: Sequence[int] = ()


class StampGuard:
    """Check the stamps of a stream, and hold messages back until their stamps are confirmed.

    Attributes
    ----------
    last_ns : int or None
        Newest accepted stamp of the session (ns); None before the first accepted message.
    """

    def __init__(self) -> None:
        self._reset()

    def _reset(self) -> None:
        # Until this steady time (s), messages are from before the session.
        self._outdated_until_s = -math.inf
        self.last_ns: int | None = None
        # The last accepted stamps. At most MIN_HELD - 1 corrupt stamps follow each other, so the
        # median of these stamps is correct.
        self._recent_ns: deque[int] = deque(maxlen=2 * MIN_HELD - 1)
        self._held: list[Stamped] = []

    def check(self, stamp_ns: int, message: Any, now_s: float) -> Judgement:
        """Check the next message; ``now_s`` is steady time (s)."""
        if self._is_near(stamp_ns):
            if now_s < self._outdated_until_s:
                return Judgement()
            return Judgement(
                self._accept([(stamp_ns, message)]), self._drop_held()
            )
        dropped = []
        if self._held:
            step_ns = abs(stamp_ns - self._held[-1][0])
            if step_ns == 0:
                return Judgement(repeated=[stamp_ns])
            if step_ns > _MAX_PAUSE_NS:
                dropped = self._drop_held()
        self._held.append((stamp_ns, message))
        judgement = (
            self._accept_held(now_s)
            if len(self._held) >= MIN_HELD
            else Judgement()
        )
        return judgement._replace(dropped=dropped)

    def restart(self, now_s: float | None = None) -> None:
        """Begin a new session.

        Parameters
        ----------
        now_s : float, optional
            Steady time (s), if another stream has jumped back and begins the session. For some
            seconds, messages of this stream are from before the jump, and are dropped.
        """
        if now_s is None:
            self._reset()
        elif self.last_ns is not None:
            self._outdated_until_s = now_s + SILENT_AFTER_S
            self._outdated_until_s += 2 * MIN_HELD * self.period_ns() * 1e-9

    def resume(self, last_ns: int | None) -> None:
        """Continue a session whose newest stamp is ``last_ns``."""
        self.last_ns = last_ns
        if last_ns is not None:
            self._recent_ns.append(last_ns)

    def period_ns(self) -> float:
        """Return the median interval (ns) of the last accepted stamps; 0 if there are too few."""
        stamps_ns = sorted(self._recent_ns)
        intervals = [
            later - earlier for earlier, later in itertools.pairwise(stamps_ns)
        ]
        return statistics.median(intervals) if intervals else 0.0

    def _is_near(self, stamp_ns: int) -> bool:
        """Whether a stamp is near the last accepted stamps."""
        distances = (abs(stamp_ns - recent_ns) for recent_ns in self._recent_ns)
        distance_ns = min(distances, default=math.inf)
        return (
            distance_ns <= NEAR_NS
            or distance_ns <= NEAR_PERIODS * self.period_ns()
        )

    def _accept(self, messages: list[Stamped]) -> list[Stamped]:
        """Store the stamps of messages as accepted, and return the messages."""
        stamps_ns = [stamp_ns for stamp_ns, _ in messages]
        self._recent_ns.extend(stamps_ns)
        if self.last_ns is not None:
            stamps_ns.append(self.last_ns)
        self.last_ns = max(stamps_ns)
        return messages

    def _drop_held(self) -> list[int]:
        """Drop the held messages and return their stamps."""
        dropped = [stamp_ns for stamp_ns, _ in self._held]
        self._held = []
        return dropped

    def _accept_held(self, now_s: float) -> Judgement:
        """Accept the held messages, because the change of their stamps is real."""
        messages = self._held
        self._held = []
        first_ns = messages[0][0]
        before_ns = statistics.median_low(self._recent_ns or [first_ns])
        is_back = first_ns < before_ns - NEAR_NS
        # Another stream may have jumped back shortly before. The new session has then begun
        # already, and only this guard is reset.
        has_begun = now_s < self._outdated_until_s
        self._outdated_until_s = -math.inf
        if is_back:
            self._reset()
        return Judgement(
            self._accept(messages), jumped_back=is_back and not has_begun
        )
