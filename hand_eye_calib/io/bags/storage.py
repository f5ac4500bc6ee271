"""What the readers of all storages have in common: their interface, their losses, and messages in
the order of time from chunks that may overlap.
"""

import heapq
from bisect import bisect_left
from collections.abc import Callable, Container, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Protocol

from hand_eye_calib.io.bags.blocks import Message
from hand_eye_calib.io.limits import LARGEST_OVERLAP, MOST_TOPICS

LATEST_NS = (1 << 63) - 1

_MOST_LOSSES = 10
# What a message takes beside its bytes.
_OVERHEAD = 200


class Storage(Protocol):
    """A storage file opened for reading.

    Attributes
    ----------
    path : pathlib.Path
    topics : dict of str to (str, int)
        Message type and number of messages by topic. The type is empty if publishers disagree.
    start_ns, end_ns : int or None
        Bag time of the first and last message; None if there is none.
    losses : Losses
        What could not be read; complete after reading.
    """

    path: Path
    start_ns: int | None
    end_ns: int | None
    losses: "Losses"

    @property
    def topics(self) -> dict[str, tuple[str, int]]: ...

    def messages(self, topics: Container[str]) -> Iterator[list[Message]]:
        """Iterate over the messages of some topics in the order of bag time, many at once."""

    def close(self) -> None:
        """Close the file."""


class Losses:
    """What could not be read of a file, for a person; every text once, and not endlessly many."""

    def __init__(self) -> None:
        self._texts: dict[str, None] = {}
        self._more = 0

    def add(self, text: str) -> None:
        """Note a loss."""
        if text in self._texts:
            return
        if len(self._texts) < _MOST_LOSSES:
            self._texts[text] = None
        else:
            self._more += 1

    def texts(self) -> list[str]:
        """List the losses, one line each."""
        more = [f"and {self._more} more losses of this kind"] if self._more else []
        return [*self._texts, *more]


def add_topic(
    topics: dict[str, tuple[str, int]], name: str, message_type: str, n_messages: int
) -> None:
    """Add a connection to the topics of a file.

    Raises
    ------
    ValueError
        If there are too many topics.
    """
    known, before = topics.get(name, (message_type, 0))
    topics[name] = (message_type if message_type == known else "", before + n_messages)
    if len(topics) > MOST_TOPICS:
        raise ValueError(f"it has more than {MOST_TOPICS} topics")


def check_encoding(topic: str, encoding: str) -> None:
    """Refuse messages that are not encoded as CDR.

    Raises
    ------
    ValueError
    """
    if encoding != "cdr":
        raise ValueError(f"messages of {topic} are encoded as {encoding[:40]!r}, expected 'cdr'")


def in_order(
    starts_ns: Sequence[int], read: Callable[[int], list[Message]]
) -> Iterator[list[Message]]:
    """Messages of chunks in the order of bag time.

    Of what has been read, only that which no later chunk can precede is passed on.

    Parameters
    ----------
    starts_ns : sequence of int
        Bag time at which each chunk begins, in increasing order.
    read : callable
        ``index -> messages`` of a chunk, in any order.

    Raises
    ------
    ValueError
        If the chunks overlap so much that too many messages have to wait.
    """
    overlap: list[tuple[int, int, Message]] = []
    sequence, waiting = count(), 0
    for index in range(len(starts_ns)):
        found = sorted(read(index), key=_bag_time)
        next_ns = starts_ns[index + 1] if index + 1 < len(starts_ns) else LATEST_NS + 1
        ready = []
        while overlap and overlap[0][0] < next_ns:
            ready.append(heapq.heappop(overlap)[2])
        waiting -= sum(map(_size, ready))
        split = bisect_left(found, next_ns, key=_bag_time)
        if ready or split:
            yield sorted(ready + found[:split], key=_bag_time) if ready else found[:split]
        for message in found[split:]:
            heapq.heappush(overlap, (message[1], next(sequence), message))
            waiting += _size(message)
        if waiting > LARGEST_OVERLAP:
            raise ValueError(
                f"its chunks overlap in time by more than {LARGEST_OVERLAP} bytes of messages; "
                "sort the file by time"
            )


def _bag_time(message: Message) -> int:
    return message[1]


def _size(message: Message) -> int:
    return len(message[2]) + _OVERHEAD
