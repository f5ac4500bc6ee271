"""Table of the poses of one or two streams, in the order of bag time.

Bag time is the time at which the recorder received a message.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.geometry.trajectory import Columns, Trajectory


@dataclass(frozen=True, eq=False)
class PoseTable(Columns):
    """Table of N poses of one or two streams, in the order of bag time.

    Attributes
    ----------
    streams : (N,) object array
        "parent" or "child"; empty until the stream is known.
    stamps_ns : (N,) int64 array
        Header stamps.
    world_frames, sensor_frames : (N,) object array
        Names of frames; None if the message type has no such field.
    poses : (N, 7) array
        Position x y z, m, and quaternion qx qy qz qw of the sensor in its world. For messages
        without poses, such as angular rates: their values, in any number of columns.
    bag_ns : (N,) int64 array
        Times at which the recorder received the messages.
    """

    streams: NDArray[np.object_]
    stamps_ns: IntArray
    world_frames: NDArray[np.object_]
    sensor_frames: NDArray[np.object_]
    poses: FloatArray
    bag_ns: IntArray

    @classmethod
    def of(
        cls, stamps_ns: Any, poses: Any, world: Any = "", sensor: Any = None
    ) -> Self:
        """Return a table without stream names. The stamps (N,), ns, are used as bag times.

        ``world`` and ``sensor`` are a frame for all poses, or a frame for each pose (N,).
        """
        stamps_ns = np.array(stamps_ns, dtype=np.int64)

        def column(value: Any) -> NDArray[np.object_]:
            return np.broadcast_to(
                np.array(value, dtype=object), stamps_ns.shape
            )

        return cls(
            streams=column(""),
            stamps_ns=stamps_ns,
            world_frames=column(world),
            sensor_frames=column(sensor),
            poses=np.asarray(poses),
            bag_ns=stamps_ns,
        )

    def recorded(self, stream: str, bag_ns: Any) -> Self:
        """Return the table with a stream name and with the bag times (N,) of its poses."""
        streams = np.full(len(self), stream, dtype=object)
        return replace(
            self, streams=streams, bag_ns=np.array(bag_ns, dtype=np.int64)
        )

    @classmethod
    def joined(cls, tables: Iterable[Self]) -> Self:
        """Return the rows of one or more tables in the order of bag time."""
        table = cls.concatenate(*tables)
        # Most bags are already in order. Do not copy their columns.
        is_sorted = (np.diff(table.bag_ns) >= 0).all()
        return (
            table
            if is_sorted
            else table[np.argsort(table.bag_ns, kind="stable")]
        )

    def trajectory(self) -> Trajectory:
        """Return the trajectory of a table with one stream, sorted by stamps.

        Among poses with equal stamps, only the first is used.
        """
        stamps_ns, first = np.unique(self.stamps_ns, return_index=True)
        poses = self.poses[first]
        sensor_frame = self.sensor_frames[first[0]] or ""
        world_frame = self.world_frames[first[0]]
        return Trajectory.from_quat_xyzw(
            stamps_ns, poses[:, :3], poses[:, 3:], sensor_frame, world_frame
        )
