"""Poses and messages of bags, one by one and in blocks."""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any, NamedTuple, Self, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.io.bags.messages import PoseColumns
from hand_eye_calib.io.limits import BLOCK_BYTES

#: Messages that are unpacked at once.
BLOCK_SIZE = 2048

ObjectArray = NDArray[np.object_]
_Item = TypeVar("_Item")


class MessageKind(NamedTuple):
    """What the messages of one connection have in common."""

    topic: str
    type: str
    is_ros1: bool


# A message as it was recorded: its kind, its bag time in ns and its bytes.
Message: TypeAlias = tuple[MessageKind, int, bytes]


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

    @classmethod
    def of_rows(cls, rows: list[StampedPose]) -> "PoseBlock":
        """Make a block of single poses."""
        columns = dict(zip(StampedPose._fields, zip(*rows, strict=True), strict=True))
        return cls(
            streams=np.array(columns["stream"], dtype=object),
            message_numbers=np.array(columns["number"]),
            stamps_ns=np.array(columns["stamp_ns"], dtype=np.int64),
            world_frames=np.array(columns["world_frame"], dtype=object),
            sensor_frames=np.array(columns["sensor_frame"], dtype=object),
            poses=np.concatenate([columns["position"], columns["quat_xyzw"]], axis=1),
            bag_ns=np.array(columns["bag_ns"], dtype=np.int64),
        )

    def rows(self) -> Iterator[StampedPose]:
        """Iterate over the poses one by one."""
        rows = zip(
            self.streams.tolist(),
            self.message_numbers.tolist(),
            self.stamps_ns.tolist(),
            self.world_frames.tolist(),
            self.sensor_frames.tolist(),
            _tuples(self.poses[:, :3]),
            _tuples(self.poses[:, 3:]),
            self.bag_ns.tolist(),
            strict=True,
        )
        return map(_make_stamped_pose, rows)


# A named tuple's own constructor takes three times as long, and there may be millions.
_make_stamped_pose = partial(tuple.__new__, StampedPose)


def _tuples(rows: FloatArray) -> Iterator[tuple[float, ...]]:
    """Rows of an array as tuples; quicker than lists, and unknown to the garbage collector."""
    return struct.iter_unpack(f"{rows.shape[1]}d", rows.tobytes())


def blocks_of(items: Iterable[_Item], size: int = BLOCK_SIZE) -> Iterator[list[_Item]]:
    """Split a sequence into lists of some length."""
    iterator = iter(items)
    while block := list(islice(iterator, size)):
        yield block


def message_blocks(messages: Iterable[Message]) -> Iterator[list[Message]]:
    """Split messages into lists that are neither long nor large."""
    block: list[Message] = []
    size = 0
    for message in messages:
        block.append(message)
        size += len(message[2])
        if len(block) >= BLOCK_SIZE or size >= BLOCK_BYTES:
            yield block
            block, size = [], 0
    if block:
        yield block


def regrouped(lists: Iterable[list[_Item]]) -> Iterator[list[_Item]]:
    """Join short lists and split long ones: between images, a chunk may hold only a few poses."""
    waiting: list[_Item] = []
    for items in lists:
        waiting = waiting + items if waiting else items
        if len(waiting) >= BLOCK_SIZE:
            yield from blocks_of(waiting)
            waiting = []
    if waiting:
        yield waiting
