"""The poses of one stream that are not paired yet: in order of their stamps, in bounded memory."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry.trajectory import REACH, Trajectory


@dataclass(frozen=True, kw_only=True)
class BufferLimits:
    """Limits of the buffers, and when poses are made into pairs.

    Attributes
    ----------
    capacity : int
        Most poses of a stream. A buffer fills up if the other stream lags behind, or if the time
        offset is still to be estimated; then all but a tenth are paired.
    pairing_starts : int
        Number of poses from which on the oldest are made into pairs. Until then, messages may come
        in any order: 20 s at 100 Hz.
    batch, batch_every : int
        Most poses that are made into pairs at once, and how many new poses come between two
        batches. Small batches keep the time of a single pose below a few milliseconds.
    late_ns : int
        Poses closer than this to the newest of their stream are not paired yet, in case others
        arrive late.
    """

    capacity: int = 20_000
    pairing_starts: int = 2_000
    batch: int = 256
    batch_every: int = 32
    late_ns: int = 1_000_000_000


@dataclass(kw_only=True)
class StreamStatistics:
    """What a stream has delivered in this session: poses taken; refused, as the stream had a pose
    with that stamp, or as older ones than those were paired and dropped already; and dropped, as
    the other stream had none at their time. The range of the stamps taken.
    """

    received: int = 0
    refused_duplicate: int = 0
    refused_late: int = 0
    dropped_unpaired: int = 0
    first_stamp_ns: int | None = None
    last_stamp_ns: int | None = None

    def note(self, stamp_ns: int) -> None:
        """Count a pose that was taken."""
        self.received += 1
        if self.first_stamp_ns is None or self.last_stamp_ns is None:
            self.first_stamp_ns = self.last_stamp_ns = stamp_ns
        elif stamp_ns > self.last_stamp_ns:
            self.last_stamp_ns = stamp_ns
        else:
            self.first_stamp_ns = min(self.first_stamp_ns, stamp_ns)

    def to_dict(self) -> dict[str, int | None]:
        """What a result says of its inputs."""
        values = {name: each for name, each in vars(self).items() if name != "dropped_unpaired"}
        return {"messages": values.pop("received"), **values}


@dataclass(frozen=True)
class RawPoses:
    """Poses as they came in, in order of time: stamps (N,) int64, and x y z qx qy qz qw (N, 7)."""

    stamps_ns: IntArray
    poses: FloatArray

    @cached_property
    def trajectory(self) -> Trajectory:
        """The same as a Trajectory. This is the expensive part."""
        return Trajectory.from_quat_xyzw(self.stamps_ns, self.poses[:, :3], self.poses[:, 3:])


class PoseBuffer:
    """Poses of one sensor, in order of their stamps.

    Attributes
    ----------
    frame : str
        Name of the sensor frame; empty until it is known.
    statistics : StreamStatistics
    """

    def __init__(self, limits: BufferLimits) -> None:
        self._limits = limits
        self._stamps_ns = np.empty(limits.capacity, dtype=np.int64)
        self._poses = np.empty((limits.capacity, 7))  # x y z qx qy qz qw
        self._count = 0
        self._dropped_until_ns = -(2**63)
        self.frame = ""
        self.statistics = StreamStatistics()

    def __len__(self) -> int:
        return self._count

    @property
    def stamps_ns(self) -> IntArray:
        """(N,) int64 array: the stamps, valid until the buffer changes."""
        return self._stamps_ns[: self._count]

    @property
    def is_full(self) -> bool:
        """Whether there is no room for another pose."""
        return self._count == self._limits.capacity

    @property
    def pairing_is_due(self) -> bool:
        """Whether it is time to make a batch of pairs."""
        is_many = self._count > self._limits.pairing_starts
        return is_many and self.statistics.received % self._limits.batch_every == 0

    def add(self, stamp_ns: int, position: Any, quat_xyzw: Any) -> bool:
        """Take a pose; False if the stamp is a duplicate or too late."""
        if stamp_ns <= self._dropped_until_ns:
            self.statistics.refused_late += 1
            return False
        index, end = self._count, self._count
        if index and stamp_ns <= self._stamps_ns[index - 1]:
            index = int(np.searchsorted(self.stamps_ns, stamp_ns))
            if self._stamps_ns[index] == stamp_ns:
                self.statistics.refused_duplicate += 1
                return False
            self._stamps_ns[index + 1 : end + 1] = self._stamps_ns[index:end]
            self._poses[index + 1 : end + 1] = self._poses[index:end]
        self._stamps_ns[index] = stamp_ns
        self._poses[index, :3], self._poses[index, 3:] = position, quat_xyzw
        self._count += 1
        self.statistics.note(stamp_ns)
        return True

    def stamp_at(self, share: float) -> int:
        """Stamp below which this share of the poses lies."""
        return self.stamp_of(int(share * (self._count - 1)))

    def stamp_of(self, index: int) -> int:
        """Stamp of a pose, or of the newest if there are not so many."""
        return int(self._stamps_ns[min(index, self._count - 1)])

    def poses(self, until_ns: int | None = None) -> RawPoses:
        """The poses, copied: all, or those up to a stamp and the ones after it that interpolation
        up to it looks at.
        """
        end = self._count
        if until_ns is not None:
            after = int(np.searchsorted(self.stamps_ns, until_ns, side="right"))
            end = min(after + REACH, self._count)
        return RawPoses(self._stamps_ns[:end].copy(), self._poses[:end].copy())

    def drop(self, until_ns: int, unpaired: bool = False) -> None:
        """Drop poses up to and including a stamp, except the last of them that interpolation up to
        the next pose looks at.
        """
        after = int(np.searchsorted(self.stamps_ns, until_ns, side="right"))
        split = max(after - REACH, 0)
        if unpaired:
            self.statistics.dropped_unpaired += split
        rest = self._count - split
        self._stamps_ns[:rest] = self._stamps_ns[split : self._count].copy()
        self._poses[:rest] = self._poses[split : self._count].copy()
        self._count = rest
        self._dropped_until_ns = until_ns
