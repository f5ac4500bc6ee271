"""Measure the processor time of a function, as the median of several repeats."""

import time
from dataclasses import dataclass

import numpy as np

# Time for the repeats of a row (s).
_BUDGET_S = 1.0
# Shortest time that is measured precisely (s); faster functions are called several times in it.
_SHORTEST_S = 2e-3
# Limits of the number of repeats.
_FEWEST = 2
_MOST = 25
# Fewest repeats of the slow function of a ratio.
_FEWEST_TURNS = 3


@dataclass(frozen=True)
class Row:
    """A measured time.

    Attributes
    ----------
    name : str
    size : int
        Number of motion pairs, poses or messages.
    seconds : float
        Median of the repeats.
    spread : float
        Half the range of the repeats over the median.
    repeats : int
    objective : float, optional
    error_m, error_rad : float, optional
        Errors of the extrinsic, against the truth.
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
    """Measure ``work()``; return its row and the result of the last call.

    The first call does not count, unless it alone exceeds ``budget_s``.
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
    """Measure two functions alternately; return (row, result) for each.

    ``slow`` and ``fast`` are pairs (name, function). A processor's speed changes within seconds,
    and would change the ratio of the times. Therefore, calls of the fast function follow each call
    of the slow function, for a tenth of its time.
    """

    def timed(work):
        start = clock()
        result = work()
        return clock() - start, result

    slow_s = []
    fast_s = []
    # The first call fills caches, and does not count.
    _, of_fast = timed(fast[1])
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
    """Return the row of times (s) that were measured elsewhere."""
    median = float(np.median(times))
    return Row(
        name,
        size,
        median,
        float(max(times) - min(times)) / (2 * median),
        len(times),
    )
