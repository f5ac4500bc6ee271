"""Leaps in time: stamps days apart from the others, which no recording has."""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import IntArray

# No recording pauses this long (s): a stamp is wrong.
_LEAP_S = 86_400.0


@dataclass(frozen=True)
class Leap:
    """The longest leap in a stream's stamps.

    Attributes
    ----------
    seconds : float
        Time between the two poses.
    before, after : int
        Number of poses before and after it.
    """

    seconds: float
    before: int
    after: int

    def what(self) -> str:
        """The finding, to follow "the parent stream's"."""
        return (
            f"stamps leap by {self.seconds / _LEAP_S:,.0f} days after pose {self.before} "
            f"of {self.before + self.after}"
        )

    def advice(self) -> str:
        """The remedy."""
        few = f"the first {self.before}" if self.before < self.after else f"the last {self.after}"
        return f"repair the stamps, or remove {few} of its poses"


def find_leap(stamps_ns: IntArray) -> Leap | None:
    """The longest leap in stamps (N,), in rising order; None without one."""
    if len(stamps_ns) < 2:
        return None
    intervals_s = np.diff(stamps_ns) * 1e-9
    before = int(np.argmax(intervals_s)) + 1
    if intervals_s[before - 1] <= _LEAP_S:
        return None
    return Leap(float(intervals_s[before - 1]), before, len(stamps_ns) - before)
