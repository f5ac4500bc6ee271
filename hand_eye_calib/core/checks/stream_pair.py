"""Two streams with nearly equal clocks, and the motion pairs that both contain."""

from dataclasses import dataclass, replace
from functools import cached_property

from hand_eye_calib.core.alignment.rate_correlation import (
    Correlation,
    correlate_rates,
)
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing import motion_pairs

# Durations (s) of the compared motions. Shorter motions are used only if longer motions disagree.
LAGS_S = (3.0, 1.0, 0.4)
# Largest number of motions in one fit.
MAX_PAIRS = 400
# Smallest number of motions in one fit.
MIN_PAIRS = 12

# Larger rotation vectors (rad) are skipped: near pi their sign is ambiguous.
MAX_ROTATION_RAD = 2.8


@dataclass(frozen=True)
class StreamPair:
    """Two streams with nearly equal clocks.

    Attributes
    ----------
    parent, child : Trajectory
        Streams of both sensors.
    max_gap_s : float
        Longest interval between two poses that is interpolated, s.
    """

    parent: Trajectory
    child: Trajectory
    max_gap_s: float

    @property
    def interval_s(self) -> float:
        """Median interval between poses of the faster stream, s."""
        return min(self.parent.interval_s, self.child.interval_s)

    @property
    def is_slow(self) -> bool:
        """Whether most poses are too far apart to interpolate between them."""
        return self.interval_s > self.max_gap_s

    def correlate(self) -> Correlation:
        """Correlate the angular rates of both streams, to compare their clocks."""
        return correlate_rates(self.parent, self.child, self.max_gap_s)

    def shifted(self, offset_s: float) -> "StreamPair":
        """Return the pair with ``offset_s`` added to the child's stamps."""
        return replace(self, child=self.child.shifted(offset_s))

    @cached_property
    def synchronised(self) -> motion_pairs.PosePairs:
        """Poses of both streams, interpolated at common stamps."""
        return motion_pairs.synchronise(self.parent, self.child, self.max_gap_s)

    def pairs(self, lag_s: float, max_pairs: int) -> motion_pairs.MotionPairs:
        """Return at most ``max_pairs`` motion pairs, each over ``lag_s`` seconds.

        Raises
        ------
        NotEnoughDataError
            If the streams have fewer than MIN_PAIRS motion pairs.
        """
        pairs = motion_pairs.pairs_over(self.synchronised, lag_s, max_pairs)
        if len(pairs) < MIN_PAIRS:
            text = f"the streams have only {len(pairs)} motions over {lag_s:g} s in common"
            raise NotEnoughDataError(text)
        return pairs
