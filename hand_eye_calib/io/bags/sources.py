"""What a stream can be read from: a topic of poses, two topics that are joined, a path, the points
of a lidar, fields of any message, or transforms.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.bags.fields import FieldReader
from hand_eye_calib.io.bags.messages import MessageReader, Run, unpack_path, unpack_transforms
from hand_eye_calib.io.bags.poses import NOTHING, PoseColumns, PoseTable, are_believable
from hand_eye_calib.io.bags.scans import ScanOdometry, unpack_scan
from hand_eye_calib.io.transforms import TfSource, TfStream

Source = str | TfSource


class Reading(ABC):
    """Reads one stream; there is a subclass for each kind of source.

    ``topics`` are those whose messages it takes, ``notes`` what a person should know in the end.
    """

    def __init__(self, stream: str, *topics: str) -> None:
        self.stream, self.topics = stream, topics
        self.notes: list[str] = []

    @abstractmethod
    def take(self, run: Run) -> None:
        """Take the next messages of one of the topics; an InputError if they cannot be used."""

    @abstractmethod
    def table(self) -> PoseTable:
        """The poses of all messages; an InputError if there can be none."""

    def _of_frames(self, stamps_ns: Any, poses: FloatArray, bag_ns: Any, *frames: Any) -> PoseTable:
        """A table whose poses are all in the same frames: of the world, of the sensor."""
        columns = PoseColumns.of_frames(np.array(stamps_ns, dtype=np.int64), poses, *frames)
        return PoseTable.of_columns(self.stream, columns, bag_ns)


class TopicReading(Reading):
    """A topic with a pose, or what is measured of one, in each message."""

    def __init__(self, stream: str, topic: str, message_type: str, measures: str) -> None:
        super().__init__(stream, topic)
        self._reader = MessageReader(message_type, measures)
        self._tables = [PoseTable.of_columns(stream, NOTHING, [])]

    def take(self, run: Run) -> None:
        columns, keep = run.read(self._reader.columns)
        self._tables.append(PoseTable.of_columns(self.stream, columns, run.bag_ns)[keep])

    def table(self) -> PoseTable:
        table = PoseTable.joined(self._tables)
        is_right, (name,) = are_believable(table.stamps_ns, table.bag_ns), self.topics
        if not is_right.all():
            self.notes.append(
                f"{name}: {(~is_right).sum()} stamps jump away and back against the bag's own "
                "time; their poses were left out, the bag may be damaged"
            )
            table = table[is_right]
        if without := self._reader.n_left_out:
            self.notes.append(
                f"{name}: {without} messages without a fix, or without what they were read for, "
                "were left out"
            )
        return table


class JoinedReading(Reading):
    """Positions of one topic with the orientations of another, interpolated."""

    def __init__(self, *parts: TopicReading) -> None:
        super().__init__(parts[0].stream, *(topic for part in parts for topic in part.topics))
        self._parts = parts

    def take(self, run: Run) -> None:
        for part in self._parts:
            if run.kind.topic in part.topics:
                part.take(run)

    def table(self) -> PoseTable:
        fixes, turning = (part.table() for part in self._parts)
        self.notes += [note for part in self._parts for note in part.notes]
        if not len(fixes) or len(turning) < 2:
            both = "+".join(self.topics)
            raise InputError(f"{both}: no positions with a fix, or no orientations")
        orientations = turning.trajectory()
        first_ns, last_ns = orientations.stamps_ns[[0, -1]]
        fixes = fixes[(fixes.stamps_ns >= first_ns) & (fixes.stamps_ns <= last_ns)]
        quats_xyzw = se3.to_quat_xyzw(orientations.at(fixes.stamps_ns))
        poses, frame = np.c_[fixes.poses[:, :3], quats_xyzw], orientations.sensor_frame
        return self._of_frames(fixes.stamps_ns, poses, fixes.bag_ns, "", frame)


class PathReading(Reading):
    """A path that is published again and again as it grows, perhaps with all poses corrected: the
    poses of its newest message. Its stamps count as bag times.
    """

    def __init__(self, stream: str, topic: str) -> None:
        super().__init__(stream, topic)
        self._newest: PoseColumns | None = None

    def take(self, run: Run) -> None:
        (self._newest,) = run._replace(messages=run.messages[-1:]).each(unpack_path)

    def table(self) -> PoseTable:
        path = self._newest or NOTHING
        if len(path.stamps_ns) > 1 and not path.stamps_ns.any():
            raise InputError(
                f"the poses of path {self.topics[0]} have no stamps: all are zero; use the "
                "odometry that the path was made from"
            )
        return PoseTable.of_columns(self.stream, path, path.stamps_ns)


class ScanReading(Reading):
    """The points of a lidar, as odometry."""

    def __init__(self, stream: str, topic: str, bag: Path, files: Sequence[Path]) -> None:
        self._lidar, self._topic = ScanOdometry(topic, bag, files), topic
        super().__init__(stream, *([] if self._lidar.kept else [topic]))

    def take(self, run: Run) -> None:
        for scan, bag_ns in zip(run.each(unpack_scan), run.bag_ns.tolist(), strict=True):
            self._lidar.add(scan, bag_ns)

    def table(self) -> PoseTable:
        found = self._lidar.odometry()
        about = f"{self._topic}: odometry from {len(found.poses)} scans"
        lost = f", {found.n_failed} of which could not be registered" if found.n_failed else ""
        self.notes.append(f"{about}{lost}; it is kept in {self._lidar.place}")
        columns = found.stamps_ns, found.poses, found.bag_ns
        return self._of_frames(*columns, "scans", str(found.frame))


class FieldReading(Reading):
    """Fields of messages of any type."""

    def __init__(self, stream: str, topic: str, fields: str) -> None:
        super().__init__(stream, topic)
        self._reader = FieldReader(topic, fields)
        self._rows, self._bag_ns = list[list[str]](), list[int]()

    def take(self, run: Run) -> None:
        # The library's errors are of many kinds.
        self._rows += run.each(self._reader.cells_of(run.kind), Exception)
        self._bag_ns += run.bag_ns.tolist()

    def table(self) -> PoseTable:
        stamps_ns, poses, self.notes = self._reader.poses(self._rows)
        return self._of_frames(stamps_ns, poses, self._bag_ns)


class TransformReading(Reading):
    """Transforms between two frames, composed at the stamps of the moving transform with the lowest
    rate in the chain.
    """

    def __init__(self, stream: str, source: TfStream, topics: Sequence[str]) -> None:
        super().__init__(stream, *(topic for topic in topics if not is_static(topic)))
        self._source = source
        self._found: list[tuple[Any, ...]] = []

    def take(self, run: Run) -> None:
        lists = run.each(unpack_transforms)
        for transforms, bag_ns in zip(lists, run.bag_ns.tolist(), strict=True):
            for transform in transforms:
                poses = self._source.edges_at(transform, False)
                self._found += ((bag_ns, *pose) for pose in poses)

    def table(self) -> PoseTable:
        frames = self._source.source
        if not self._found:
            raise InputError(f"{frames}: {self._source.describe_missing()}")
        bag_ns, stamps_ns, rows = zip(*self._found, strict=True)
        moving = {frame: np.array([each[frame] for each in rows]) for frame in rows[0]}
        Ts = self._source.composed(moving)
        poses = np.c_[Ts[:, :3, 3], se3.to_quat_xyzw(Ts)]
        return self._of_frames(stamps_ns, poses, bag_ns, *frames)


def is_static(topic: str) -> bool:
    """Whether the transforms of a topic are static."""
    return topic.endswith("tf_static")
