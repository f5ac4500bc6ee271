"""Tells corrupt stamps from gaps, late messages, bags that loop and clocks that were reset.

Most streams are regular: from the newest message taken, the next one is a whole number of periods
away. A message that is elsewhere waits until those after it tell what it is. Six that follow each
other are a real change: a gap, or a jump of the clock. Fewer have only changed places with others,
or have corrupt stamps. A corrupt stamp is restored if the messages around it leave exactly one
place for it; otherwise the message is dropped.
"""

import statistics
from bisect import bisect_left, insort
from collections import deque
from dataclasses import dataclass, field
from enum import Enum, auto
from itertools import pairwise
from typing import Any

# A real change this far back is a jump of the clock, and a new session.
BACKWARD_JUMP_NS = 1_000_000_000

# So many messages that follow each other are believed: more than corrupt ones come together.
WITNESSES = 6

# A message is judged at the latest when so many others have come, or when the stream is silent for
# so long (s, periods); at the start of a session, for so long (s).
_PATIENCE = 12
_SILENCE_S, _SILENCE_PERIODS, _START_SILENCE_S = 0.5, 5, 2.0

# Messages follow each other if they are at most so far apart; so far while no period is known.
_FOLLOWS_NS, _FOLLOWS_PERIODS, _FOLLOWS_AT_START_NS = 1_000_000_000, 20, 60_000_000_000

# A stream may fall silent with a few messages after a pause of at most this.
_LONGEST_PAUSE_NS = 60_000_000_000

# Period and jitter are taken from so many intervals, anew after so many messages.
_INTERVALS, _LEARN_EVERY = 64, 16

# How far a regular stamp may be from its place: this many times the jitter (its 80th percentile, as
# corrupt stamps have a part in it), and at least so much (ns, share of the period). A stream that
# needs more than the last share is irregular: there, only the order of the stamps tells.
_JITTERS, _LEAST_TOLERANCE_NS, _LEAST_TOLERANCE, _MOST_TOLERANCE = 4.0, 2_000_000, 0.02, 0.4

# In an irregular stream the next message is at most so many periods away.
_NEXT_PERIODS = 5

# Stamps taken that are remembered, to see whose place is free.
_RECENT = 64

# After one stream has jumped back, the others' messages of before are left out for so long: theirs
# are about to jump too.
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
        To be used now; held ones among them, some with a restored stamp.
    restored : list of int
        The corrupt stamps of those.
    dropped : list of int
        Corrupt stamps of messages that are not to be used.
    """

    verdict: Verdict
    taken: list[Stamped] = field(default_factory=list)
    restored: list[int] = field(default_factory=list)
    dropped: list[int] = field(default_factory=list)


@dataclass
class _Held:
    stamp_ns: int
    message: Any
    number: int  # of its arrival


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
        self._period_ns = self._tolerance_ns = 0.0
        self._arrivals = 0
        self._arrived_s = 0.0
        self._begin()

    def _begin(self) -> None:
        """Forget all stamps."""
        self.last_ns: int | None = None
        self._sure_ns: int | None = None  # the newest that others have confirmed
        self._previous_ns: int | None = None
        self._held: list[_Held] = []
        self._recent: list[tuple[int, int]] = []  # stamps taken, with their arrival
        self._since_last = 0  # messages held since the newest one taken
        self._session_began = self._arrivals  # messages before are not of this session

    @property
    def held(self) -> int:
        """Number of messages that wait to be judged."""
        return len(self._held)

    @property
    def _is_regular(self) -> bool:
        return 0.0 < self._tolerance_ns <= _MOST_TOLERANCE * self._period_ns

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
        self._learn(stamp_ns)
        if self._is_outdated(stamp_ns, now_s):
            return Judgement(Verdict.OUTDATED)
        self._arrivals += 1
        if self._is_next(stamp_ns):
            self._take(stamp_ns, self._arrivals)
            self._sure_ns = self.last_ns
            judgement = self._judge_old(_PATIENCE)
            judgement.verdict = Verdict.TAKE
            judgement.taken.insert(0, (stamp_ns, message))
            return judgement
        self._held.append(_Held(stamp_ns, message, self._arrivals))
        self._since_last += 1
        return self._believe(WITNESSES)

    def flush(self, now_s: float) -> Judgement:
        """Judge the messages that wait if the stream is silent; to be called often."""
        silence_s = max(_SILENCE_S, _SILENCE_PERIODS * self._period_ns * 1e-9)
        if self.last_ns is None:
            silence_s = max(silence_s, _START_SILENCE_S)
        if not self._held or now_s - self._arrived_s < silence_s:
            return Judgement(Verdict.HOLD)
        if self.last_ns is None:  # a short stream: as good as it gets
            return self._believe(1)
        judgement = self._judge_old(0)
        if self._held and self._held[0].stamp_ns - self.last_ns <= _LONGEST_PAUSE_NS:
            judgement.taken += self._believe(1).taken  # the last ones, after a pause
        return judgement

    def restart(self, now_s: float | None = None) -> None:
        """Begin a new session; with ``now_s`` (steady time) as another stream has jumped back."""
        if now_s is None:
            self._begin()
            self._outdated_until_s = None
        elif self.last_ns is not None:
            follow_s = _OTHERS_FOLLOW_S + 2 * WITNESSES * self._period_ns * 1e-9
            self._outdated_until_s = now_s + follow_s
            self._recent = []  # the engine has forgotten them
            self._session_began = self._arrivals

    # ------------------------------------------------------------- one message

    def _learn(self, stamp_ns: int) -> None:
        """Take note of an interval; period and jitter follow."""
        if self._previous_ns is not None and stamp_ns > self._previous_ns:
            self._intervals.append(stamp_ns - self._previous_ns)
        self._previous_ns = stamp_ns
        if self._arrivals % _LEARN_EVERY == 0 or not self._period_ns:
            self._set_period()

    def _set_period(self) -> None:
        if len(self._intervals) < WITNESSES - 1:
            return
        period_ns = self._period_ns = statistics.median(self._intervals)
        # Not NumPy: for so few numbers it takes several times as long.
        off = sorted(abs(each - round(each / period_ns) * period_ns) for each in self._intervals)
        jitter_ns = off[round(0.8 * (len(off) - 1))]
        least_ns = max(_LEAST_TOLERANCE_NS, _LEAST_TOLERANCE * self._period_ns)
        self._tolerance_ns = max(_JITTERS * jitter_ns, least_ns)

    def _is_outdated(self, stamp_ns: int, now_s: float) -> bool:
        if self._outdated_until_s is None:
            return False
        if now_s >= self._outdated_until_s:
            self._outdated_until_s = None
            return False
        return self.last_ns is not None and 0 <= stamp_ns - self.last_ns <= self._follows_ns

    @property
    def _follows_ns(self) -> float:
        if not self._period_ns:
            return _FOLLOWS_AT_START_NS
        return max(_FOLLOWS_NS, _FOLLOWS_PERIODS * self._period_ns)

    def _is_next(self, stamp_ns: int) -> bool:
        """Whether a stamp is where the next one must be."""
        if self.last_ns is None:
            return False
        later_ns = stamp_ns - self.last_ns
        if not self._is_regular:
            return 0 < later_ns <= _NEXT_PERIODS * self._period_ns
        # Those that wait have had their places between.
        is_place = round(later_ns / self._period_ns) == 1 + self._since_last
        return is_place and self._fits(later_ns)

    def _fits(self, later_ns: int) -> bool:
        """Whether an interval is a whole number of periods."""
        periods = round(later_ns / self._period_ns)
        return abs(later_ns - periods * self._period_ns) <= self._tolerance_ns

    def _take(self, stamp_ns: int, number: int) -> None:
        if self.last_ns is None or stamp_ns > self.last_ns:
            self.last_ns = stamp_ns
            self._since_last = 0
        insort(self._recent, (stamp_ns, number))
        del self._recent[:-_RECENT]

    # -------------------------------------------------------- messages that wait

    def _believe(self, witnesses: int) -> Judgement:
        """Take the messages that wait if enough of them follow each other."""
        chain = _longest_chain([each.stamp_ns for each in self._held], self._follows_ns)
        if len(chain) < witnesses:
            return self._judge_old(_PATIENCE)
        members = [self._held[index] for index in chain]
        self._held = [each for index, each in enumerate(self._held) if index not in chain]
        newest_ns = self._sure_ns or self.last_ns
        jumped = newest_ns is not None and members[0].stamp_ns < newest_ns - BACKWARD_JUMP_NS
        followed, self._outdated_until_s = self._outdated_until_s is not None, None
        if jumped:
            held, arrivals = self._held, members[0].number - 1
            self._begin()
            self._held, self._session_began = held, arrivals
        self.last_ns = None  # what comes next follows these, also after a small step back
        for each in members:
            self._take(each.stamp_ns, each.number)
        if len(members) >= WITNESSES:
            self._sure_ns = self.last_ns
        # The rate may be another one.
        self._intervals.clear()
        newest = [stamp_ns for stamp_ns, _ in self._recent[-2 * WITNESSES :]]
        self._intervals.extend(later - earlier for earlier, later in pairwise(newest))
        self._set_period()
        verdict = Verdict.JUMPED_BACK if jumped and not followed else Verdict.TAKE
        return Judgement(verdict, [(each.stamp_ns, each.message) for each in members])

    def _judge_old(self, patience: int) -> Judgement:
        """Judge the messages that have waited for so many others."""
        judgement = Judgement(Verdict.HOLD)
        if self.last_ns is None:
            return judgement
        held, self._held = self._held, []
        for each in held:
            waits_on = patience == 0 and each.stamp_ns > self.last_ns
            if self._arrivals - each.number < patience or waits_on:
                self._held.append(each)
            else:
                self._settle(each, judgement)
        return judgement

    def _settle(self, held: _Held, judgement: Judgement) -> None:
        """Take, restore or drop one message."""
        place_ns = self._only_place(held)
        if place_ns is not None:
            judgement.restored.append(held.stamp_ns)
        elif self._is_out_of_order(held):
            place_ns = held.stamp_ns
        else:
            judgement.dropped.append(held.stamp_ns)
            return
        self._take(place_ns, held.number)
        judgement.taken.append((place_ns, held.message))

    def _only_place(self, held: _Held) -> int | None:
        """The stamp that a message must have had, if the stream is regular and nothing is lost
        around it: between its neighbours there are as many periods as messages.
        """
        if not self._is_regular or not self._recent:
            return None
        before = max((each for each in self._arrived(before=held.number)), default=None)
        after_number, after_ns = min(self._arrived(after=held.number), default=(0, 0))
        if not after_number:
            return None
        if before is None:
            if held.number <= self._session_began:
                return None
            return round(after_ns - (after_number - held.number) * self._period_ns)
        number, before_ns = before
        count = after_number - number
        if abs(after_ns - before_ns - count * self._period_ns) > self._tolerance_ns:
            return None
        return before_ns + round((after_ns - before_ns) * (held.number - number) / count)

    def _arrived(self, before: int | None = None, after: int = 0) -> list[tuple[int, int]]:
        """Arrival and stamp of messages taken that came before or after another one."""
        return [
            (number, stamp_ns)
            for stamp_ns, number in self._recent
            if number > after and (before is None or number < before)
        ]

    def _is_out_of_order(self, held: _Held) -> bool:
        """Whether a message has only changed places with others, or repeats one of them."""
        stamps_ns = [stamp_ns for stamp_ns, _ in self._recent]
        place = bisect_left(stamps_ns, held.stamp_ns)
        if place == len(stamps_ns) or (place == 0 and held.stamp_ns != stamps_ns[0]):
            return False
        if held.stamp_ns == stamps_ns[place]:  # the engine counts it
            return True
        if not self._is_regular:
            return True
        before_ns, after_ns = stamps_ns[place - 1], stamps_ns[place]
        half_ns = self._period_ns / 2
        is_free = held.stamp_ns - before_ns > half_ns and after_ns - held.stamp_ns > half_ns
        has_overtaken = any(number > held.number for _, number in self._recent[:place])
        was_overtaken = any(number < held.number for _, number in self._recent[place:])
        fits = self._fits(held.stamp_ns - before_ns)
        return is_free and fits and (has_overtaken or was_overtaken)


def _longest_chain(stamps_ns: list[int], limit_ns: float) -> list[int]:
    """Indices of the most stamps that follow each other, each at most so far behind the next."""
    lengths, before = [1] * len(stamps_ns), [-1] * len(stamps_ns)
    for j, later in enumerate(stamps_ns):
        for i, earlier in enumerate(stamps_ns[:j]):
            if 0 < later - earlier <= limit_ns and lengths[i] >= lengths[j]:
                lengths[j], before[j] = lengths[i] + 1, i
    chain = []
    index = max(range(len(lengths)), key=lengths.__getitem__, default=-1)
    while index >= 0:
        chain.append(index)
        index = before[index]
    return chain[::-1]
