"""What one input of the node has delivered: rate, gaps, refused and lost messages."""

import time
from collections import Counter, deque

import numpy as np

from hand_eye_calib.engine.pose_buffer import StreamStatistics
from hand_eye_calib.ros.delivery import Delivery, DeliveryReport
from hand_eye_calib.ros.status import ERROR, OK, WARN, Report

# An input without a message for so long is silent, and a bad message is reported for so long (s).
STALE_AFTER_S = 2.0
BAD_INPUT_FOR_S = 10.0

# Shares of lost and of late messages from which on somebody should look.
_MUCH_LOST, _MUCH_LATE = 0.01, 0.05

# Reports over which the rate is taken, and most delays looked at in one.
_RATE_REPORTS = 5
_MOST_DELAYS = 5000


class InputMonitor:
    """Counts the messages of one input between two reports.

    Attributes
    ----------
    arrived, ignored : int
        Messages, and those of them that came while the node was disabled.
    refused : Counter
        Messages that could not be used, by reason.
    delay_s : float or None
        Median of the node's clock minus the stamps, in the last report with messages.
    delivery : Delivery
    """

    def __init__(self) -> None:
        self.arrived = 0
        self.ignored = 0
        self.refused: Counter[str] = Counter()
        self.delay_s: float | None = None
        self.delivery = Delivery()
        self._bad = ""
        self._bad_at_s = -np.inf
        self._arrived_at_s: float | None = None
        self._last_stamp_ns: int | None = None
        self._delays_ns: deque[int] = deque(maxlen=_MOST_DELAYS)
        self._longest_gap_ns = 0
        self._long_gaps = 0
        self._counts = deque([(time.monotonic(), 0)], maxlen=_RATE_REPORTS + 1)

    def note(self, stamp_ns: int, clock_ns: int, steady_s: float, max_gap_ns: float) -> None:
        """Count a message; ``clock_ns`` is the node's clock, 0 if it does not run yet."""
        self.arrived += 1
        self._arrived_at_s = steady_s
        if clock_ns:
            self._delays_ns.append(clock_ns - stamp_ns)
        if self._last_stamp_ns is not None:
            gap_ns = stamp_ns - self._last_stamp_ns
            self._longest_gap_ns = max(self._longest_gap_ns, gap_ns)
            self._long_gaps += gap_ns > max_gap_ns
        self._last_stamp_ns = stamp_ns

    def note_refused(self, reason: str, text: str, steady_s: float) -> None:
        """Count a message that could not be used."""
        self.refused[reason] += 1
        self._bad, self._bad_at_s = text, steady_s

    def restart(self) -> None:
        """Begin a new session: gaps are counted anew."""
        self._last_stamp_ns = None
        self._longest_gap_ns = self._long_gaps = 0

    def is_silent(self, steady_s: float) -> bool:
        """Whether messages have come, but not lately."""
        return self._arrived_at_s is not None and steady_s - self._arrived_at_s > STALE_AFTER_S

    def report(
        self,
        topic: str,
        steady_s: float,
        statistics: StreamStatistics,
        may_rest: bool = False,
        missing: str = "",
    ) -> Report:
        """State of this input; begins a new interval.

        Parameters
        ----------
        topic : str
        steady_s : float
        statistics : StreamStatistics
        may_rest : bool
            Silence is nothing to look at: there is a result, and the other input is silent too.
        missing : str
            Why no message has come yet, if that is known.
        """
        self._counts.append((steady_s, self.arrived))
        (start_s, start), (end_s, end) = self._counts[0], self._counts[-1]
        rate_hz = (end - start) / (end_s - start_s) if end_s > start_s else 0.0
        delivery = self.delivery.report()
        delays_s = np.array(self._delays_ns) * 1e-9
        self._delays_ns.clear()
        if delays_s.size:
            self.delay_s = float(np.median(delays_s))
        level, text = self._judge(topic, steady_s, rate_hz, delivery, may_rest)
        if self._arrived_at_s is None and missing:
            text = f"{text}: {missing}"
        values = {
            "topic": topic,
            "rate (Hz)": f"{rate_hz:.1f}",
            **self._counts_of(statistics),
            **self._delivery_values(delivery),
            "longest gap (s)": f"{self._longest_gap_ns * 1e-9:.3f}",
            "gaps above max_gap": self._long_gaps,
            "silent for (s)": self._silence(steady_s),
            "node clock minus stamps, median (s)": _delay(delays_s, 50),
            "node clock minus stamps, 99 % (s)": _delay(delays_s, 99),
        }
        return Report(level, text, values)

    def _judge(
        self, topic: str, steady_s: float, rate_hz: float, delivery: DeliveryReport, may_rest: bool
    ) -> tuple[bytes, str]:
        if self._arrived_at_s is None:
            return WARN, f"no message on {topic} yet"
        if steady_s - self._bad_at_s < BAD_INPUT_FOR_S:
            return ERROR, f"{topic}: {self._bad}"
        if self.is_silent(steady_s):
            text = f"{topic} has been silent for {steady_s - self._arrived_at_s:.0f} s"
            return (OK if may_rest else WARN), text
        problems = []
        if delivery.lost >= _MUCH_LOST:
            problems.append(f"{delivery.lost:.1%} of the messages are lost")
        if delivery.late >= _MUCH_LATE:
            waited = f"waited up to {delivery.longest_wait_s:.1f} s in the node"
            problems.append(f"{delivery.late:.0%} of the messages are late, they {waited}")
        if not problems:
            return OK, f"{rate_hz:.1f} Hz"
        advice = "give the node more processor time, or publish at a lower rate"
        return WARN, f"{rate_hz:.1f} Hz; {'; '.join(problems)}: {advice}"

    def _counts_of(self, statistics: StreamStatistics) -> dict[str, object]:
        return {
            "messages": self.arrived,
            "poses taken": statistics.received,
            "refused: repeated stamp": statistics.refused_duplicate,
            "refused: too late": statistics.refused_late,
            **{f"refused: {reason}": count for reason, count in sorted(self.refused.items())},
            "dropped: no pose of the other input at their time": statistics.dropped_unpaired,
            "ignored while disabled": self.ignored,
        }

    def _delivery_values(self, delivery: DeliveryReport) -> dict[str, object]:
        counts: dict[str, object] = {
            "late messages": self.delivery.late,
            "longest wait in the node (s)": f"{delivery.longest_wait_s:.3f}",
        }
        if not self.delivery.is_known:
            return {"lost messages": "unknown", **counts}
        shares = {"lost messages (%), last 10 s": f"{100 * delivery.lost:.2f}"}
        return {"lost messages": self.delivery.lost, **shares, **counts}

    def _silence(self, steady_s: float) -> str:
        if self._arrived_at_s is None:
            return "no message yet"
        return f"{steady_s - self._arrived_at_s:.1f}"


def _delay(delays_s: np.ndarray, percentile: float) -> str:
    return f"{np.percentile(delays_s, percentile):.4f}" if delays_s.size else "-"
