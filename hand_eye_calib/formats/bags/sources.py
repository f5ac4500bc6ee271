"""What a stream can be read from: a topic of poses, two topics that are joined, a path, the points
of a lidar, images of a target, fields of any message, or transforms.

Fields are named as in ``/topic?t=header.stamp,x=pose.position.x,...``: before the equals sign as
columns of csv files, with their units; vx, vy, vz, wx, wy, wz are integrated. A target is named as
in ``/camera/image_raw?charuco:5x7:0.04:0.03:4X4_50``, and with ``@FILE`` behind it the file of the
camera's intrinsics.
"""

from abc import ABC, abstractmethod
from collections.abc import Collection
from dataclasses import replace
from decimal import Decimal
from typing import Any

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.errors import ConfigError, InputError, NoPoseError, printable
from hand_eye_calib.core.base.text import frame_name, without_poses
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import are_null
from hand_eye_calib.formats.bags import messages
from hand_eye_calib.formats.trajectory_files.columns import TWIST
from hand_eye_calib.formats.trajectory_files.poses import poses_of
from hand_eye_calib.formats.trajectory_files.stamps import stamps_in_ns
from hand_eye_calib.formats.trajectory_files.table import Table
from hand_eye_calib.formats.transforms import TfSource, TfStream

Source = str | TfSource
# A delay against the bag's time (s) is of a wrong stamp if it is so much farther from both
# neighbours than these are from each other and than the usual step: computers delay for less.
_JUMP_S = 0.5
_NOTHING = messages.PoseTable.of([], np.empty((0, 7)))
# Share of stamps that are 0, or repeated, from which on they are of no use.
_MOSTLY = 0.5


def source_of(text: str) -> Source:
    """The topic, or the frames, that a text names."""
    return TfSource.parse(text) if ":" in text.partition("?")[0] else text


class Reading(ABC):
    """Reads one stream; there is a subclass for each kind of source.

    ``topics`` are those whose messages it takes, ``notes`` what a person should know in the end.
    """

    def __init__(self, stream: str, *topics: str) -> None:
        self.stream = stream
        self.topics = topics
        self.notes: list[str] = []
        self.stamps = "header"

    def use_stamps(self, stamps: str) -> None:
        """Take the stamps of the poses from "header", or the times of the recorder, "receive".

        Raises
        ------
        ConfigError
            If the messages were not received one by one.
        """
        self.stamps = stamps

    @abstractmethod
    def take(self, run: messages.Run) -> None:
        """Take the next messages of one of the topics; an InputError if they cannot be used."""

    @abstractmethod
    def table(self) -> messages.PoseTable:
        """The poses of all messages; an InputError if there can be none."""

    def _stamped(self, table: messages.PoseTable) -> messages.PoseTable:
        """Return the table with the stamps that are wanted, without poses whose stamp is 0."""
        name = "+".join(self.topics)
        if self.stamps == "receive":
            self.notes.append(
                f"{name}: the stamps are the times at which the recorder received the messages; "
                "the delay on the way counts as offset of the clocks"
            )
            return replace(table, stamps_ns=table.bag_ns)
        is_zero = table.stamps_ns == 0
        n_zero = int(is_zero.sum())
        self._refuse_zeros(n_zero, len(table))
        if n_zero > 1:  # a simulation may begin at 0
            self.notes.append(f"{name}: {n_zero:,} poses were left out: their header stamps are 0")
            table = table[~is_zero]
        if not len(table) or (table.stamps_ns % messages.NS_PER_S).any():
            return table
        n_stamps = len(np.unique(table.stamps_ns))
        if n_stamps <= _MOSTLY * len(table):
            raise InputError(
                f"{name}: the header stamps have whole seconds only: {len(table):,} poses have "
                f"{n_stamps:,} stamps; have the publisher set header.stamp.nanosec; "
                f"{self._advice()}"
            )
        return table

    def _refuse_zeros(self, n_zero: int, n_all: int) -> None:
        """Raise InputError if most header stamps are 0."""
        if n_zero > max(1, _MOSTLY * n_all):
            raise InputError(
                f"{'+'.join(self.topics)}: {n_zero:,} of {n_all:,} header stamps are 0: have the "
                f"publisher set header.stamp; {self._advice()}"
            )

    def _advice(self) -> str:
        return f"or take the times of the recorder: `{self.stream}_stamps` receive"

    def _note_null(self, n_null: int, n_all: int) -> None:
        """Note how many poses were left out because they are null."""
        if n_null:
            self.notes.append(f"{'+'.join(self.topics)}: {without_poses(n_null, n_all)}")


class TopicReading(Reading):
    """A topic with a pose, or what is measured of one, in each message."""

    def __init__(self, stream: str, topic: str, message_type: str, measures: str) -> None:
        super().__init__(stream, topic)
        self._measures = measures
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
        (name,) = self.topics
        table = messages.PoseTable.joined(self._tables)
        n_read = len(table)
        table = self._stamped(table)
        is_right = are_believable(table.stamps_ns, table.bag_ns)
        if not is_right.all():
            self.notes.append(
                f"{name}: {(~is_right).sum()} poses were left out: their stamps jump away from "
                "the bag's own time and back; the bag may be damaged"
            )
            table = table[is_right]
        n_null = self._reader.n_left_out
        if n_null and self._measures != "poses":
            self.notes.append(
                f"{name}: {n_null} messages without a fix, or without the quantity that is read, "
                "were left out"
            )
        else:
            self._note_null(n_null, n_null + n_read)
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
    steps_s = np.abs(np.diff(delays_s))
    across_s = np.abs(delays_s[2:] - delays_s[:-2])
    off_s = np.minimum(steps_s[:-1], steps_s[1:])
    return np.asarray(off_s <= _JUMP_S + across_s + np.median(steps_s[1:-1]))


class JoinedReading(Reading):
    """Positions of one topic with the orientations of another, interpolated."""

    def __init__(self, *parts: TopicReading) -> None:
        super().__init__(parts[0].stream, *(topic for part in parts for topic in part.topics))
        self._parts = parts

    def use_stamps(self, stamps: str) -> None:
        for part in self._parts:
            part.use_stamps(stamps)

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
        poses = np.c_[fixes.poses[:, :3], quats_xyzw]
        frame = orientations.sensor_frame
        table = messages.PoseTable.of(fixes.stamps_ns, poses, "", frame)
        return table.recorded(self.stream, fixes.bag_ns)


class PathReading(Reading):
    """A path that is published again and again as it grows, perhaps with all poses corrected: the
    poses of its newest message. Its stamps count as bag times.
    """

    _newest: messages.Run | None = None

    def use_stamps(self, stamps: str) -> None:
        if stamps == "receive":
            raise ConfigError(
                f"{self.topics[0]} is a path, which is received as a whole: its poses have no "
                f"times of receipt; leave out `{self.stream}_stamps`"
            )

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
        frame = printable(frame_name(path.header.frame_id))
        poses = np.reshape(rows, (-1, 7))
        is_null = are_null(poses)
        self._note_null(int(is_null.sum()), len(poses))
        table = messages.PoseTable.of(stamps_ns, poses, frame).recorded(self.stream, stamps_ns)
        return self._stamped(table[~is_null])


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
        self._bag_ns: list[int] = []
        self.measures = "poses" if of_table == "twists" else self._table.measures
        if self.measures == "rates":
            raise InputError(f"{topic}: wx, wy, wz alone are no poses; name vx, vy, vz, too")

    def take(self, run: messages.Run) -> None:
        rows = [[self._cell(each, path) for path in self._paths] for each in run.decoded()]
        self._table.fill(enumerate(rows, len(self._bag_ns) + 1), list)
        self._bag_ns += run.bag_ns.tolist()

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
        stamps_ns = stamps_in_ns(table, None)
        self.notes = table.guesses
        self._note_null(table.n_left_out, table.n_rows)
        if table.measures == "twists":
            poses = _integrated(stamps_ns, table.values())
        else:
            poses = np.column_stack(poses_of(table))
        bag_ns = np.asarray(self._bag_ns)[table.rows]
        found = messages.PoseTable.of(stamps_ns, poses).recorded(self.stream, bag_ns)
        return self._stamped(found)


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
        self._n_null = 0
        self._n_zero = 0
        self._n_taken = 0

    def take(self, run: messages.Run) -> None:
        for bag_ns, transform in run.transforms():
            if self.stamps == "receive":
                transform = transform._replace(stamp_ns=bag_ns)
            self._n_taken += 1
            self._n_zero += transform.stamp_ns == 0
            try:
                poses = [*self._source.edges_at(transform, False)]
            except NoPoseError:
                self._n_null += 1
            else:
                self._found += ((bag_ns, *pose) for pose in poses)

    def table(self) -> messages.PoseTable:
        frames = self._source.source
        self._refuse_zeros(self._n_zero, self._n_taken)
        if not self._found:
            raise InputError(f"{frames}: {self._source.describe_missing()}")
        bag_ns, stamps_ns, rows = zip(*self._found, strict=True)
        moving = {frame: np.array([each[frame] for each in rows]) for frame in rows[0]}
        poses = se3.to_rows(self._source.composed(moving))
        self._note_null(self._n_null, self._n_null + len(poses))
        table = messages.PoseTable.of(stamps_ns, poses, *frames).recorded(self.stream, bag_ns)
        return self._stamped(table)
