"""Tells a bag that loops, a clock that was reset and a long pause from a single corrupt stamp."""

from enum import Enum, auto
from typing import Any

# A stamp this much earlier than the one before is not a late message, one this much later not the
# next one.
BACKWARD_JUMP_NS = 1_000_000_000
FORWARD_JUMP_NS = 60_000_000_000

# So many messages must agree on a jump before it is believed.
_WITNESSES = 3

# After one stream has jumped back, the others' messages of before are left out for so long: theirs
# are about to jump too.
_OTHERS_FOLLOW_S = 2.0


class Verdict(Enum):
    """What is to be done with the messages that come with it."""

    TAKE = auto()
    HOLD = auto()
    JUMPED_BACK = auto()
    OUTDATED = auto()


class StampGuard:
    """Watches the stamps of one stream.

    Attributes
    ----------
    last_ns : int or None
        Newest stamp of the session.
    discarded : int
        Messages whose stamps nothing else confirmed.
    """

    def __init__(self) -> None:
        self.last_ns: int | None = None
        self.discarded = 0
        self._held: list[tuple[int, Any]] = []
        self._outdated_until_s: float | None = None

    @property
    def held(self) -> int:
        """Number of messages that wait to be confirmed."""
        return len(self._held)

    def check(
        self, stamp_ns: int, message: Any, now_s: float
    ) -> tuple[Verdict, list[tuple[int, Any]]]:
        """Judge the next message.

        Parameters
        ----------
        stamp_ns : int
        message : object
        now_s : float
            Steady time.

        Returns
        -------
        verdict : Verdict
        messages : list of (stamp_ns, message)
            TAKE: to be taken now, held ones included. JUMPED_BACK: the first of a new session.
            Otherwise empty.
        """
        if self._outdated_until_s is not None:
            if (
                now_s < self._outdated_until_s
                and self.last_ns is not None
                and _follows(stamp_ns, self.last_ns)
            ):
                return Verdict.OUTDATED, []
            if now_s >= self._outdated_until_s:
                self._outdated_until_s = None
        if self.last_ns is None or _follows(stamp_ns, self.last_ns):
            return self._expected(stamp_ns, message)
        if self._held and not _follows(stamp_ns, self._held[-1][0]):
            self._discard()
        self._held.append((stamp_ns, message))
        if len(self._held) < _WITNESSES:
            return Verdict.HOLD, []
        jumped_back = stamp_ns < self.last_ns
        followed = self._outdated_until_s is not None
        confirmed, self._held, self._outdated_until_s = self._held, [], None
        self.last_ns = max(stamp for stamp, _ in confirmed)
        return (Verdict.JUMPED_BACK if jumped_back and not followed else Verdict.TAKE), confirmed

    def restart(self, now_s: float | None = None) -> None:
        """Begin a new session; ``now_s`` (steady time) if another stream has jumped back."""
        if now_s is None:
            self.last_ns, self._outdated_until_s = None, None
            self._discard()
        elif self.last_ns is not None:
            self._outdated_until_s = now_s + _OTHERS_FOLLOW_S

    def _expected(self, stamp_ns: int, message: Any) -> tuple[Verdict, list[tuple[int, Any]]]:
        if self._held:
            self._discard()
        self.last_ns = stamp_ns if self.last_ns is None else max(self.last_ns, stamp_ns)
        return Verdict.TAKE, [(stamp_ns, message)]

    def _discard(self) -> None:
        self.discarded += len(self._held)
        self._held = []


def _follows(stamp_ns: int, last_ns: int) -> bool:
    return -BACKWARD_JUMP_NS <= stamp_ns - last_ns <= FORWARD_JUMP_NS
