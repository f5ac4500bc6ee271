"""Poses of messages and of bags, one by one and in columns."""

import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from hand_eye_calib.arrays import FloatArray, IntArray

ObjectArray = NDArray[np.object_]


class PoseFields(NamedTuple):
    """The unpacked part of one message.

    Attributes
    ----------
    stamp_ns : int
    world_frame : str
    sensor_frame : str or None
        None if the type has no place for it.
    position : list of 3 floats
        m.
    quat_xyzw : list of 4 floats
    """

    stamp_ns: int
    world_frame: str
    sensor_frame: str | None
    position: list[float]
    quat_xyzw: list[float]


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


class StampedPose(NamedTuple):
    """A pose of a stream.

    Attributes
    ----------
    stream : str
        "parent" or "child".
    number : int
        Number of the message within its topic, from 1; of a path or a transform, of the pose.
    stamp_ns : int
        From the header.
    world_frame : str
    sensor_frame : str or None
        None if the message type does not carry it.
    position : tuple of 3 floats
        m.
    quat_xyzw : tuple of 4 floats
        As recorded: not checked, not normalised.
    bag_ns : int
        When the message was recorded.
    """

    stream: str
    number: int
    stamp_ns: int
    world_frame: str
    sensor_frame: str | None
    position: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float]
    bag_ns: int


@dataclass(frozen=True, kw_only=True)
class PoseBlock:
    """N poses of streams in columns.

    Attributes
    ----------
    streams, world_frames, sensor_frames : (N,) arrays of str or None
    message_numbers : (N,) int array
    stamps_ns, bag_ns : (N,) int64 arrays
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
        return type(self)(**{name: column[index] for name, column in vars(self).items()})

    @classmethod
    def concatenate(cls, blocks: Iterable["PoseBlock"]) -> "PoseBlock":
        """Join blocks in their order."""
        columns = [vars(block) for block in blocks]
        return cls(
            **{name: np.concatenate([each[name] for each in columns]) for name in columns[0]}
        )

    @classmethod
    def of_columns(
        cls, stream: str, message_numbers: IntArray, columns: PoseColumns, bag_ns: IntArray
    ) -> "PoseBlock":
        """Make a block of unpacked messages of one stream."""
        return cls(
            streams=np.full(len(message_numbers), stream, dtype=object),
            message_numbers=message_numbers,
            stamps_ns=columns.stamps_ns,
            world_frames=np.array(columns.world_frames, dtype=object),
            sensor_frames=np.array(columns.sensor_frames, dtype=object),
            poses=columns.poses,
            bag_ns=bag_ns,
        )

    def rows(self) -> Iterator[StampedPose]:
        """Iterate over the poses one by one."""
        # Tuples, as quick to make as lists, do not occupy the garbage collector.
        positions = struct.iter_unpack("3d", self.poses[:, :3].tobytes())
        quats_xyzw = struct.iter_unpack("4d", self.poses[:, 3:].tobytes())
        columns = (self.streams, self.message_numbers, self.stamps_ns, self.world_frames)
        lists = (column.tolist() for column in (*columns, self.sensor_frames))
        rows = zip(*lists, positions, quats_xyzw, self.bag_ns.tolist(), strict=True)
        # A named tuple's own constructor takes three times as long, and there may be millions.
        return map(partial(tuple.__new__, StampedPose), rows)
