"""Which of the messages that were published have arrived, and how long they waited in the node."""

from collections import deque
from dataclasses import dataclass

# A message that waited so long in the node's queue is late: the node falls behind (s).
LATE_S = 1.0

# A message may be overtaken by so many others of its publisher; farther back, the publisher was
# started again.
_MOST_OVERTAKEN = 1000

# Reports that the share of lost and late messages is taken over.
_REPORTS = 10


@dataclass(frozen=True)
class DeliveryReport:
    """Shares of lost and of late messages (0 to 1), and the longest wait (s)."""

    lost: float
    late: float
    longest_wait_s: float


class Delivery:
    """Counts lost and late messages of one topic by the numbers that its publisher gives them.

    Attributes
    ----------
    received, lost, late : int
        Messages since the first one.
    is_known : bool
        The middleware numbers messages, and one publisher alone sends them.
    """

    def __init__(self) -> None:
        self.received = self.lost = self.late = 0
        self.is_known = False
        self.has_one_publisher = True
        self._next: int | None = None
        self._longest_wait_s = 0.0
        self._counts = deque([(0, 0, 0)], maxlen=_REPORTS + 1)

    def note(self, sequence_number: int | None, waited_s: float) -> None:
        """Count a message.

        Parameters
        ----------
        sequence_number : int or None
            Of its publication; None if the middleware does not tell.
        waited_s : float
            Time from its arrival in this process to its callback.
        """
        self.received += 1
        self.late += waited_s > LATE_S
        self._longest_wait_s = max(self._longest_wait_s, waited_s)
        self.is_known = sequence_number is not None and self.has_one_publisher
        if sequence_number is None or not self.has_one_publisher:
            self._next = None
            return
        missing = 0 if self._next is None else sequence_number - self._next
        if missing >= 0:
            self.lost += missing
            self._next = sequence_number + 1
        elif missing >= -_MOST_OVERTAKEN and self.lost > 0:
            self.lost -= 1  # it was counted when a later one overtook it
        else:
            self._next = sequence_number + 1

    def report(self) -> DeliveryReport:
        """Shares over the last reports, and the longest wait since the last one."""
        self._counts.append((self.received, self.lost, self.late))
        received, lost, late = (
            end - start for start, end in zip(self._counts[0], self._counts[-1], strict=True)
        )
        longest_wait_s, self._longest_wait_s = self._longest_wait_s, 0.0
        return DeliveryReport(
            lost / max(received + lost, 1), late / max(received, 1), longest_wait_s
        )
