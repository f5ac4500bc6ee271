"""Poses of all sensors of a rig at common instants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.pairing.synchronise import PosePairs, synchronise


@dataclass(frozen=True)
class Table:
    """Poses of S sensors at N common instants.

    Attributes
    ----------
    stamps_ns : (N,) int64 array
        Clock of the first sensor, strictly increasing.
    poses : (S, N, 4, 4) array
        Of each sensor in its own world.
    """

    stamps_ns: IntArray
    poses: FloatArray

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def n_sensors(self) -> int:
        """S."""
        return len(self.poses)

    def pair(self, first: int, second: int) -> PosePairs:
        """Pose pairs of two of the sensors."""
        return PosePairs(self.stamps_ns, self.poses[first], self.poses[second])

    def at(self, kept: IntArray) -> Table:
        """Some of the instants, in order."""
        return Table(self.stamps_ns[kept], self.poses[:, kept])


def synchronised(trajectories: Sequence[Trajectory], max_gap_s: float) -> Table:
    """Interpolate all trajectories at the stamps of the slowest one.

    An instant that is outside of a trajectory, or in a gap of more than ``max_gap_s``, is left out
    for all sensors.

    Parameters
    ----------
    trajectories : sequence of Trajectory
        On one clock, at least two poses each.
    max_gap_s : float
    """
    intervals_ns = [float(np.median(np.diff(each.stamps_ns))) for each in trajectories]
    slowest = trajectories[int(np.argmax(intervals_ns))]
    pairs = [
        synchronise(slowest, each, max_gap_s, at="parent") if each is not slowest else None
        for each in trajectories
    ]
    stamps_ns = slowest.stamps_ns
    for pair in pairs:
        if pair is not None:
            stamps_ns = np.intersect1d(stamps_ns, pair.stamps_ns, assume_unique=True)
    poses = [
        slowest.poses[np.searchsorted(slowest.stamps_ns, stamps_ns)]
        if pair is None
        else pair.Ts_cw_c[np.searchsorted(pair.stamps_ns, stamps_ns)]
        for pair in pairs
    ]
    return Table(stamps_ns, np.array(poses))
