"""Poses of messages and of bags in columns."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.geometry.trajectory import Trajectory

# A delay against the bag's time (s) is of a wrong stamp if it is so much farther from both
# neighbours than these are from each other and than the usual step: computers delay for less.
_JUMP_S = 0.5


@dataclass(frozen=True)
class PoseTable:
    """N poses of streams, "parent" or "child", in columns (N,), in the order of bag time.

    ``stamps_ns`` are of the headers, ``bag_ns`` when the messages were recorded; frames are None if
    the message type does not carry them; ``poses`` (N, 7) are x y z qx qy qz qw.
    """

    streams: NDArray[np.object_]
    stamps_ns: IntArray
    world_frames: NDArray[np.object_]
    sensor_frames: NDArray[np.object_]
    poses: FloatArray
    bag_ns: IntArray

    @classmethod
    def of(cls, stamps_ns: Any, poses: Any, world: Any = "", sensor: Any = None) -> Self:
        """Poses of no stream yet, whose stamps (N,) count as bag times; frames are one for all, or
        (N,). Of messages that are no poses, ``poses`` are what is unpacked of them.
        """
        stamps_ns = np.array(stamps_ns, dtype=np.int64)
        stream, world, sensor = (
            np.broadcast_to(np.array(each, dtype=object), stamps_ns.shape)
            for each in ("", world, sensor)
        )
        return cls(stream, stamps_ns, world, sensor, np.asarray(poses), stamps_ns)

    def recorded(self, stream: str, bag_ns: Any) -> Self:
        """The same of a stream, at bag times (N,)."""
        streams = np.full(len(self), stream, dtype=object)
        return replace(self, streams=streams, bag_ns=np.array(bag_ns, dtype=np.int64))

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, index: Any) -> Self:
        """A part of the table: any slice, mask or index array."""
        return type(self)(*(column[index] for column in vars(self).values()))

    @classmethod
    def joined(cls, tables: Iterable["PoseTable"]) -> "PoseTable":
        """The rows of one or more tables in the order of bag time."""
        columns = zip(*(vars(table).values() for table in tables), strict=True)
        whole: Any = [*map(np.concatenate, columns)]
        table, is_sorted = cls(*whole), (np.diff(whole[-1]) >= 0).all()
        return table if is_sorted else table[np.argsort(whole[-1], kind="stable")]

    def trajectory(self) -> Trajectory:
        """Poses of one stream in the order of stamps; of those with equal stamps the first."""
        stamps_ns, first = np.unique(self.stamps_ns, return_index=True)
        poses = self[first]
        positions, quats_xyzw = poses.poses[:, :3], poses.poses[:, 3:]
        frames = poses.sensor_frames[0] or "", poses.world_frames[0]
        return Trajectory.from_quat_xyzw(stamps_ns, positions, quats_xyzw, *frames)


def are_believable(stamps_ns: IntArray, bag_ns: IntArray) -> BoolArray:
    """Mask (N,) of the stamps (N,) that can be right, of messages in the order of the recording.

    A single stamp that jumps away from the bag's own time (N,) and back is wrong: with it, a
    recording of minutes would last for years.
    """
    if len(stamps_ns) < 3:
        return np.ones(len(stamps_ns), dtype=bool)
    delays_s = np.asarray(bag_ns - stamps_ns, dtype=float) * 1e-9
    # At both ends the two neighbours are on one side.
    delays_s = np.r_[delays_s[2], delays_s, delays_s[-3]]
    steps_s, across_s = np.abs(np.diff(delays_s)), np.abs(delays_s[2:] - delays_s[:-2])
    off_s = np.minimum(steps_s[:-1], steps_s[1:])
    return np.asarray(off_s <= _JUMP_S + across_s + np.median(steps_s[1:-1]))
