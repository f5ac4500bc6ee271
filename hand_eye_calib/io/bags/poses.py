"""Poses of messages and of bags in columns."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.geometry.trajectory import Trajectory

ObjectArray = NDArray[np.object_]

# A delay against the bag's time is of a wrong stamp if it is this many times farther from both
# neighbours than these from each other (and than the usual step), and this far.
_FACTOR, _SMALLEST_JUMP_S = 10.0, 0.5


class PoseColumns(NamedTuple):
    """The unpacked part of N messages in columns.

    Attributes
    ----------
    stamps_ns : (N,) int64 array
    world_frames : list of str
    sensor_frames : list of str or None
    poses : (N, 7) array
        x y z qx qy qz qw; of messages that are no poses, what :attr:`MessageType.unpack` reads.
    """

    stamps_ns: IntArray
    world_frames: list[str]
    sensor_frames: Sequence[str | None]
    poses: FloatArray

    @classmethod
    def of_frames(
        cls, stamps_ns: IntArray, poses: FloatArray, world: str = "", sensor: str | None = None
    ) -> "PoseColumns":
        """All in the same frames."""
        return cls(stamps_ns, [world] * len(stamps_ns), [sensor] * len(stamps_ns), poses)


@dataclass(frozen=True)
class PoseBlock:
    """N poses of streams in columns.

    Attributes
    ----------
    streams : (N,) array of str
        "parent" or "child".
    message_numbers : (N,) int array
        Of the message within its topic, from 1; of a path or a transform, of the pose.
    stamps_ns, bag_ns : (N,) int64 arrays
        Of the header, and when the message was recorded.
    world_frames, sensor_frames : (N,) arrays of str or None
        None if the message type does not carry it.
    poses : (N, 7) array
        x y z qx qy qz qw.
    """

    streams: ObjectArray
    message_numbers: IntArray
    stamps_ns: IntArray
    world_frames: ObjectArray
    sensor_frames: ObjectArray
    poses: FloatArray
    bag_ns: IntArray

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, index: Any) -> Self:
        """A part of the block: any slice, mask or index array."""
        return type(self)(*(column[index] for column in vars(self).values()))

    @classmethod
    def concatenate(cls, blocks: Iterable["PoseBlock"]) -> "PoseBlock":
        """Join blocks in their order."""
        columns = zip(*(vars(block).values() for block in blocks), strict=True)
        joined: Any = [*map(np.concatenate, columns)]
        return cls(*joined)

    @classmethod
    def of_columns(
        cls, stream: str, message_numbers: IntArray, columns: PoseColumns, bag_ns: IntArray
    ) -> "PoseBlock":
        """Make a block of unpacked messages of one stream."""
        streams = np.full(len(message_numbers), stream, dtype=object)
        world, sensor = (np.array(each, dtype=object) for each in columns[1:3])
        stamps_ns, *_, poses = columns
        return cls(streams, message_numbers, stamps_ns, world, sensor, poses, bag_ns)

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
    usual_s = across_s + np.median(steps_s[1:-1])
    is_believable: BoolArray = (off_s <= _SMALLEST_JUMP_S) | (off_s <= _FACTOR * usual_s)
    return is_believable
