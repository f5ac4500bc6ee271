"""One measurement: processor time, repeated until the median holds still."""

import time
from dataclasses import dataclass

import numpy as np

# Seconds for one row, the shortest time that is told apart, and repeats at least and at most.
_BUDGET_S = 1.0
_SHORTEST_S = 2e-3
_FEWEST = 2
_MOST = 25
_FEWEST_TURNS = 3


@dataclass(frozen=True)
class Row:
    """One measurement.

    Attributes
    ----------
    name : str
    size : int
        Motion pairs, poses or messages.
    seconds : float
        Median of the repeats.
    spread : float
        Half the range of the repeats over the median.
    repeats : int
    objective : float, optional
    error_m, error_rad : float, optional
        Of the answer, against the truth.
    """

    name: str
    size: int
    seconds: float
    spread: float
    repeats: int
    objective: float | None = None
    error_m: float | None = None
    error_rad: float | None = None

    @property
    def key(self):
        """Name and size, for the baseline."""
        return f"{self.name}, {self.size}"


def measure(name, size, work, budget_s=_BUDGET_S, clock=time.process_time):
    """Row for ``work()``, and what the last call returned. The first call does not count unless it
    alone takes up the budget.
    """
    start = clock()
    result = work()
    first = clock() - start
    calls = max(1, int(_SHORTEST_S / max(first, 1e-9)))
    repeats = int(np.clip(budget_s / max(first * calls, 1e-9), _FEWEST, _MOST))
    times = [first] if first > budget_s else []
    while len(times) < repeats:
        start = clock()
        for _ in range(calls):
            result = work()
        times.append((clock() - start) / calls)
    return row_of(name, size, times), result


def measure_in_turn(size, slow, fast, clock=time.process_time):
    """Rows for two named pieces of work, (name, work) each, and what they returned.

    A processor's speed changes within seconds: for the ratio to hold, every call of the slow one is
    followed by as many of the fast one as take a tenth of its time.
    """

    def timed(work):
        start = clock()
        result = work()
        return clock() - start, result

    slow_s = []
    fast_s = []
    _, of_fast = timed(fast[1])  # does not count: it warms up
    while len(slow_s) < _FEWEST_TURNS or sum(slow_s) < _BUDGET_S:
        seconds, of_slow = timed(slow[1])
        slow_s.append(seconds)
        end = clock() + seconds / 10
        while clock() < end:
            fast_s.append(timed(fast[1])[0])
    return (row_of(slow[0], size, slow_s), of_slow), (
        row_of(fast[0], size, fast_s),
        of_fast,
    )


def row_of(name, size, times):
    """Row for times that have been taken elsewhere, in seconds."""
    median = float(np.median(times))
    return Row(
        name,
        size,
        median,
        float(max(times) - min(times)) / (2 * median),
        len(times),
    )
