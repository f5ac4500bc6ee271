"""What a stream can be read from: a topic of poses, two topics that are joined, a path, the points
of a lidar, images of a target, fields of any message, or transforms.

Fields are named as in ``/topic?t=header.stamp,x=pose.position.x,...``: before the equals sign as
columns of csv files, with their units; vx, vy, vz, wx, wy, wz are integrated. A target is named as
in ``/camera/image_raw?charuco:5x7:0.04:0.03:4X4_50``, and with ``@FILE`` behind it the file of the
camera's intrinsics.
"""

from abc import ABC, abstractmethod
from collections.abc import Collection
from decimal import Decimal
from itertools import compress
from typing import Any

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.errors import ConfigError, InputError, located, printable
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.bags import messages
from hand_eye_calib.io.target_images import Camera, Target, TargetFinder, grey_of
from hand_eye_calib.io.trajectory_files.poses import poses_of, stamps_in_ns
from hand_eye_calib.io.trajectory_files.table import TWIST, Table
from hand_eye_calib.io.transforms import TfSource, TfStream

Source = str | TfSource
# A delay against the bag's time (s) is of a wrong stamp if it is so much farther from both
# neighbours than these are from each other and than the usual step: computers delay for less.
_JUMP_S = 0.5
_NOTHING = messages.PoseTable.of([], np.empty((0, 7)))
_NOT_FINITE = {"nan", "inf", "-inf"}


def source_of(text: str) -> Source:
    """The topic, or the frames, that a text names."""
    return TfSource.parse(text) if ":" in text.partition("?")[0] else text


class Reading(ABC):
    """Reads one stream; there is a subclass for each kind of source.

    ``topics`` are those whose messages it takes, ``notes`` what a person should know in the end.
    """

    def __init__(self, stream: str, *topics: str) -> None:
        self.stream, self.topics = stream, topics
        self.notes: list[str] = []

    @abstractmethod
    def take(self, run: messages.Run) -> None:
        """Take the next messages of one of the topics; an InputError if they cannot be used."""

    @abstractmethod
    def table(self) -> messages.PoseTable:
        """The poses of all messages; an InputError if there can be none."""


class TopicReading(Reading):
    """A topic with a pose, or what is measured of one, in each message."""

    def __init__(self, stream: str, topic: str, message_type: str, measures: str) -> None:
        super().__init__(stream, topic)
        self._reader = messages.MessageReader(message_type, measures)
        self._tables = [_NOTHING]

    def take(self, run: messages.Run) -> None:
        try:
            columns, keep = self._reader.columns(run.messages, run.kind.is_ros1)
        except InputError:
            raise
        except messages.MALFORMED as error:
            raise run.unreadable(error) from error
        self._tables.append(columns.recorded(self.stream, run.bag_ns)[keep])

    def table(self) -> messages.PoseTable:
        table = messages.PoseTable.joined(self._tables)
        is_right, (name,) = are_believable(table.stamps_ns, table.bag_ns), self.topics
        if not is_right.all():
            self.notes.append(
                f"{name}: {(~is_right).sum()} poses were left out: their stamps jump away from "
                "the bag's own time and back; the bag may be damaged"
            )
            table = table[is_right]
        if without := self._reader.n_left_out:
            self.notes.append(
                f"{name}: {without} messages without a fix, or without the quantity that is read, "
                "were left out"
            )
        return table


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


class JoinedReading(Reading):
    """Positions of one topic with the orientations of another, interpolated."""

    def __init__(self, *parts: TopicReading) -> None:
        super().__init__(parts[0].stream, *(topic for part in parts for topic in part.topics))
        self._parts = parts

    def take(self, run: messages.Run) -> None:
        for part in self._parts:
            if run.kind.topic in part.topics:
                part.take(run)

    def table(self) -> messages.PoseTable:
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
        table = messages.PoseTable.of(fixes.stamps_ns, poses, "", frame)
        return table.recorded(self.stream, fixes.bag_ns)


class PathReading(Reading):
    """A path that is published again and again as it grows, perhaps with all poses corrected: the
    poses of its newest message. Its stamps count as bag times.
    """

    _newest: messages.Run | None = None

    def take(self, run: messages.Run) -> None:
        self._newest = run._replace(messages=run.messages[-1:])

    def table(self) -> messages.PoseTable:
        if self._newest is None:
            return _NOTHING
        (path,) = self._newest.decoded()
        rows = [messages.pose_row(each.pose.position, each.pose.orientation) for each in path.poses]
        stamps_ns = [messages.ns_of(each.header.stamp) for each in path.poses]
        if len(rows) > 1 and not any(stamps_ns):
            raise InputError(
                f"the poses of path {self.topics[0]} have no stamps: all are zero; use the "
                "odometry that the path was made from"
            )
        frame = printable(path.header.frame_id)
        table = messages.PoseTable.of(stamps_ns, np.reshape(rows, (-1, 7)), frame)
        return table.recorded(self.stream, stamps_ns)


class ImageReading(Reading):
    """Images of a target: the poses of the camera in the frame of the target."""

    def __init__(self, stream: str, topic: str, target: Target, camera: Camera) -> None:
        super().__init__(stream, topic)
        self._finder, self._frame = TargetFinder(target, camera), ""
        self._stamps_ns, self._bag_ns = list[int](), list[int]()

    def take(self, run: messages.Run) -> None:
        for message, bag_ns in zip(run.decoded(), run.bag_ns.tolist(), strict=True):
            with located(self.topics[0]):
                is_seen = self._finder.look(grey_of(message))
            if is_seen:
                self._stamps_ns.append(messages.ns_of(message.header.stamp) or 0)
                self._bag_ns.append(bag_ns)
                self._frame = printable(message.header.frame_id)

    def table(self) -> messages.PoseTable:
        found = self._finder.found()
        self.notes.append(f"{self.topics[0]}: {found}")
        poses = se3.to_rows(se3.inverse(found.Ts_camera_target))
        table = messages.PoseTable.of(self._stamps_ns, poses, "target", self._frame)
        return table.recorded(self.stream, self._bag_ns)


class FieldReading(Reading):
    """Fields of messages of any type; a ConfigError if they are not written as they should be.
    ``measures`` is what they are of a pose.
    """

    def __init__(self, stream: str, topic: str, fields: str) -> None:
        super().__init__(stream, topic)
        pairs = [each.partition("=")[::2] for each in fields.split(",")]
        if not all(name and path for name, path in pairs):
            raise ConfigError(
                "fields are written NAME=PATH,..., such as t=header.stamp,x=pose.position.x; got "
                f"{fields!r}"
            )
        self._names = [name for name, _ in pairs]
        self._paths = [path.split(".") for _, path in pairs]
        of_table = "twists" if {*TWIST} <= {*self._names} else "auto"
        self._table = Table(topic, self._names, of_table)
        self._bag_ns, self._n_left_out = list[int](), 0
        self.measures = "poses" if of_table == "twists" else self._table.measures
        if self.measures == "rates":
            raise InputError(f"{topic}: wx, wy, wz alone are no poses; name vx, vy, vz, too")

    def take(self, run: messages.Run) -> None:
        rows = [[self._cell(each, path) for path in self._paths] for each in run.decoded()]
        # As of an estimator that has not started.
        is_known = [_NOT_FINITE.isdisjoint(row) for row in rows]
        self._n_left_out += is_known.count(False)
        self._table.fill(enumerate(compress(rows, is_known), len(self._bag_ns) + 1), list)
        self._bag_ns += run.bag_ns[is_known].tolist()

    def _cell(self, value: Any, path: list[str]) -> str:
        """A value of a message, stamps in seconds with all their digits."""
        try:
            for part in path:
                value = value[int(part)] if part.isdecimal() else getattr(value, part)
        except (AttributeError, IndexError, TypeError):
            raise InputError(
                f"{self.topics[0]}: a message has no {'.'.join(path)}; name other fields"
            ) from None
        stamp_ns = messages.ns_of(value)
        return str(value) if stamp_ns is None else f"{Decimal(stamp_ns).scaleb(-9):f}"

    def table(self) -> messages.PoseTable:
        table = self._table
        if not table.stamps:
            topic = self.topics[0]
            raise InputError(f"no messages on {topic}, or none of its fields is a stamp, t")
        stamps_ns, self.notes = stamps_in_ns(table, None), table.guesses
        if self._n_left_out:
            table.guess(f"{self._n_left_out} messages with values that are not finite left out")
        are_twists = table.measures == "twists"
        poses = _integrated(stamps_ns, table.values()) if are_twists else np.c_[poses_of(table)]
        return messages.PoseTable.of(stamps_ns, poses).recorded(self.stream, self._bag_ns)


def _integrated(stamps_ns: IntArray, twists: FloatArray) -> FloatArray:
    """Poses (N, 7) of velocities (N, 6), m/s and rad/s, in the sensor's own frame."""
    steps = (twists[1:] + twists[:-1]) / 2 * (np.diff(stamps_ns) * 1e-9)[:, None]
    return se3.to_rows(se3.chained(se3.exp(steps)))


class TransformReading(Reading):
    """Transforms between two frames, composed at the stamps of the moving transform with the lowest
    rate in the chain.
    """

    def __init__(self, stream: str, source: TfStream, topics: Collection[str]) -> None:
        super().__init__(stream, *(topic for topic in topics if not topic.endswith("tf_static")))
        self._source = source
        self._found: list[tuple[Any, ...]] = []

    def take(self, run: messages.Run) -> None:
        for bag_ns, transform in run.transforms():
            poses = self._source.edges_at(transform, False)
            self._found += ((bag_ns, *pose) for pose in poses)

    def table(self) -> messages.PoseTable:
        frames = self._source.source
        if not self._found:
            raise InputError(f"{frames}: {self._source.describe_missing()}")
        bag_ns, stamps_ns, rows = zip(*self._found, strict=True)
        moving = {frame: np.array([each[frame] for each in rows]) for frame in rows[0]}
        poses = se3.to_rows(self._source.composed(moving))
        return messages.PoseTable.of(stamps_ns, poses, *frames).recorded(self.stream, bag_ns)
