"""Sources of a stream in a bag.

The poses of the parent or of the child are read from a source: a topic with poses, a topic with
positions joined with a topic with orientations, a path, the points of a lidar, images of a target,
fields of any message, or transforms between two frames.

Fields are written ``/topic?t=header.stamp,x=pose.position.x,...``. The names before the equals
signs are those of csv columns, with their units. Velocities and angular rates (vx, vy, vz, wx, wy,
wz) are integrated to poses. A target is written ``/camera/image_raw?charuco:5x7:0.04:0.03:4X4_50``.
``@FILE`` at the end names the file with the camera's intrinsics.
"""

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from dataclasses import fields as fields_of
from dataclasses import is_dataclass, replace
from decimal import Decimal
from typing import Any

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.errors import (
    ConfigError,
    InputError,
    NoPoseError,
    printable,
)
from hand_eye_calib.core.base.text import (
    frame_name,
    listing,
    shortened,
    without_poses,
)
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import are_null
from hand_eye_calib.formats.bags import messages, unpacking
from hand_eye_calib.formats.bags.pose_table import PoseTable
from hand_eye_calib.formats.trajectory_files.columns import TWIST
from hand_eye_calib.formats.trajectory_files.poses import poses_of
from hand_eye_calib.formats.trajectory_files.stamps import stamps_in_ns
from hand_eye_calib.formats.trajectory_files.table import Table
from hand_eye_calib.formats.transforms import TfSource, TfStream

Source = str | TfSource

# A stamp can only be wrong if the delay of its message jumps by more than this (s), see
# `are_believable`. On a busy computer, the delays of correct messages jump by less.
_JUMP_S = 0.5
# All stamps of a topic are unusable if this share of them, or more, is 0 or repeated.
_MOSTLY = 0.5

# Names of fields that are stamps, in small letters.
_STAMP_NAMES = {"stamp", "time", "timestamp", "timestamp_sample", "t"}
# Largest number of characters in a list of a message's fields.
_LONGEST_FIELDS = 300

_NO_POSES = PoseTable.of([], np.empty((0, 7)))


def source_of(text: str) -> Source:
    """Return the source that the user names: a topic as text, or ``WORLD:SENSOR`` as two frames."""
    topic, _, _ = text.partition("?")
    return TfSource.parse(text) if ":" in topic else text


class Reading(ABC):
    """Base class of the readers of one stream. Each kind of source has a subclass.

    The caller passes all messages of the topics to :meth:`take`, then calls :meth:`table`.

    Attributes
    ----------
    stream : str
        "parent" or "child".
    topics : tuple of str
        Topics whose messages are needed.
    notes : list of str
        Notes for the user, complete after :meth:`table`.
    """

    def __init__(self, stream: str, *topics: str) -> None:
        self.stream = stream
        self.topics = topics
        self.notes: list[str] = []
        self.stamps = "header"

    @property
    def name(self) -> str:
        """Name of the source for messages to the user."""
        return "+".join(self.topics)

    def use_stamps(self, stamps: str) -> None:
        """Set the stamps of the poses: "header", or "receive" for the times of the recorder.

        Raises
        ------
        ConfigError
            For "receive", if a message contains several poses.
        """
        self.stamps = stamps

    @abstractmethod
    def take(self, run: messages.Run) -> None:
        """Read the next messages of a topic. Raise InputError if they are unusable."""

    @abstractmethod
    def table(self) -> PoseTable:
        """Return the poses of all messages. Raise InputError if they cannot contain a pose."""

    def _stamped(self, table: PoseTable) -> PoseTable:
        """Return the table with the chosen stamps, without poses whose header stamp is 0.

        Raises InputError if the header stamps are unusable.
        """
        if self.stamps == "receive":
            self.notes.append(
                f"{self.name}: the stamps are the times at which the recorder "
                "received the messages; the transport delay counts as clock "
                "offset"
            )
            return replace(table, stamps_ns=table.bag_ns)
        is_zero = table.stamps_ns == 0
        n_zero = int(is_zero.sum())
        self._refuse_zeros(n_zero, len(table))
        # A single stamp may be 0, because a simulation can begin at 0.
        if n_zero > 1:
            self.notes.append(
                f"{self.name}: {n_zero:,} poses were left out: their header stamps are 0"
            )
            table = table[~is_zero]
        self._refuse_whole_seconds(table.stamps_ns)
        return table

    def _refuse_zeros(self, n_zero: int, n_all: int) -> None:
        """Raise InputError if most header stamps are 0."""
        if n_zero > max(1, _MOSTLY * n_all):
            raise InputError(
                f"{self.name}: {n_zero:,} of {n_all:,} header stamps are 0. "
                "Set header.stamp in the publisher, or use the times of the "
                f"recorder: `{self.stream}_stamps` receive"
            )

    def _refuse_whole_seconds(self, stamps_ns: IntArray) -> None:
        """Raise InputError if header stamps are whole seconds, many of them repeated."""
        if (stamps_ns % messages.NS_PER_S).any():
            return
        n_stamps = len(np.unique(stamps_ns))
        if 0 < n_stamps <= _MOSTLY * len(stamps_ns):
            raise InputError(
                f"{self.name}: the header stamps have whole seconds only: "
                f"{len(stamps_ns):,} poses have {n_stamps:,} stamps. Set "
                "header.stamp.nanosec in the publisher, or use the times of "
                f"the recorder: `{self.stream}_stamps` receive"
            )

    def _note_null(self, n_null: int, n_all: int) -> None:
        """Add a note about skipped poses: the quaternion is 0, or a value is not finite."""
        if n_null:
            self.notes.append(f"{self.name}: {without_poses(n_null, n_all)}")


class TopicReading(Reading):
    """Read a topic with one pose, position, orientation or angular rate per message."""

    def __init__(
        self, stream: str, topic: str, message_type: str, measures: str
    ) -> None:
        super().__init__(stream, topic)
        self._measures = measures
        self._reader = unpacking.MessageReader(message_type, measures)
        self._tables = [_NO_POSES]

    def take(self, run: messages.Run) -> None:
        try:
            table, is_usable = self._reader.columns(
                run.messages, run.kind.is_ros1
            )
        except InputError:
            raise
        except messages.MALFORMED as error:
            raise run.unreadable(error) from error
        self._tables.append(table.recorded(self.stream, run.bag_ns)[is_usable])

    def table(self) -> PoseTable:
        table = PoseTable.joined(self._tables)
        n_read = len(table)
        table = self._stamped(table)
        is_right = are_believable(table.stamps_ns, table.bag_ns)
        if not is_right.all():
            self.notes.append(
                f"{self.name}: {(~is_right).sum()} poses were left out: their "
                "stamps jump away from the bag's time and back; the bag may "
                "be damaged"
            )
            table = table[is_right]
        n_null = self._reader.n_left_out
        if self._measures == "poses":
            self._note_null(n_null, n_null + n_read)
        elif n_null:
            self.notes.append(
                f"{self.name}: {n_null} messages without a fix, or without "
                "the quantity to be read, were left out"
            )
        return table


def are_believable(stamps_ns: IntArray, bag_ns: IntArray) -> BoolArray:
    """Return a mask without the single stamps that jump away from bag time.

    A single wrong stamp may extend a recording of minutes to years. The delay d_i of a message is
    its bag time minus its stamp. A stamp is wrong if both abs(d_i - d_(i-1)) and abs(d_i - d_(i+1))
    exceed ``_JUMP_S`` + abs(d_(i+1) - d_(i-1)) + the median step of the delays.

    Parameters
    ----------
    stamps_ns, bag_ns : (N,) int64 arrays
        Stamps and bag times of messages, in the order of the recording.

    Returns
    -------
    (N,) bool array
        False for wrong stamps.
    """
    if len(stamps_ns) < 3:
        return np.ones(len(stamps_ns), dtype=bool)
    delays_s = np.asarray(bag_ns - stamps_ns, dtype=float) * 1e-9
    # Compare the first message with the two after it, and the last message with the two before it.
    padded_s = np.r_[delays_s[2], delays_s, delays_s[-3]]
    steps_s = np.abs(np.diff(padded_s))
    smaller_steps_s = np.minimum(steps_s[:-1], steps_s[1:])
    between_neighbours_s = np.abs(padded_s[2:] - padded_s[:-2])
    usual_step_s = np.median(steps_s[1:-1])
    return smaller_steps_s <= _JUMP_S + between_neighbours_s + usual_step_s


class JoinedReading(Reading):
    """Read positions from one topic, and orientations from another topic.

    The orientations are interpolated at the stamps of the positions.
    """

    def __init__(self, fixes: TopicReading, rotations: TopicReading) -> None:
        super().__init__(fixes.stream, *fixes.topics, *rotations.topics)
        self._fixes = fixes
        self._rotations = rotations

    def use_stamps(self, stamps: str) -> None:
        self._fixes.use_stamps(stamps)
        self._rotations.use_stamps(stamps)

    def take(self, run: messages.Run) -> None:
        for reading in (self._fixes, self._rotations):
            if run.kind.topic in reading.topics:
                reading.take(run)

    def table(self) -> PoseTable:
        fixes = self._fixes.table()
        rotations = self._rotations.table()
        self.notes += self._fixes.notes + self._rotations.notes
        if not len(fixes) or len(rotations) < 2:
            raise InputError(
                f"{self.name}: no positions with a fix, or no orientations"
            )
        orientations = rotations.trajectory()
        first_ns, last_ns = orientations.stamps_ns[[0, -1]]
        is_after_first = fixes.stamps_ns >= first_ns
        fixes = fixes[is_after_first & (fixes.stamps_ns <= last_ns)]
        quats_xyzw = se3.to_quat_xyzw(orientations.at(fixes.stamps_ns))
        poses = np.c_[fixes.poses[:, :3], quats_xyzw]
        table = PoseTable.of(
            fixes.stamps_ns, poses, "", orientations.sensor_frame
        )
        return table.recorded(self.stream, fixes.bag_ns)


class PathReading(Reading):
    """Read the poses in the newest message of a path.

    A path is published again when it grows, and earlier poses may then be corrected. The stamps of
    the poses are also their bag times.
    """

    _newest: messages.Run | None = None

    def use_stamps(self, stamps: str) -> None:
        if stamps == "receive":
            raise ConfigError(
                f"{self.name} is a path, which is received as a whole, so its "
                f"poses have no times of receipt; omit `{self.stream}_stamps`"
            )

    def take(self, run: messages.Run) -> None:
        self._newest = run._replace(messages=run.messages[-1:])

    def table(self) -> PoseTable:
        if self._newest is None:
            return _NO_POSES
        (path,) = self._newest.decoded()
        rows = [
            messages.pose_row(item.pose.position, item.pose.orientation)
            for item in path.poses
        ]
        stamps_ns = [messages.ns_of(item.header.stamp) for item in path.poses]
        if len(rows) > 1 and not any(stamps_ns):
            raise InputError(
                f"the poses of path {self.name} have no stamps (all are "
                "zero); use the odometry from which the path was made"
            )
        frame = printable(frame_name(path.header.frame_id))
        poses = np.reshape(rows, (-1, 7))
        is_null = are_null(poses)
        self._note_null(int(is_null.sum()), len(poses))
        table = PoseTable.of(stamps_ns, poses, frame).recorded(
            self.stream, stamps_ns
        )
        return self._stamped(table[~is_null])


def fields_in_words(message: Any) -> str:
    """List the fields of a decoded message, in parentheses; empty if they are unknown."""
    paths = [*_paths_of(message, "")]
    if not paths:
        return ""
    return f" (the message has {shortened(listing(paths), _LONGEST_FIELDS)})"


def hint_for_fields(topic: str, message: Any) -> str:
    """Return the advice to name the fields of a topic, with a list of those of a decoded message.

    ``message`` is None if it cannot be decoded.
    """
    names = [path.rpartition(".")[2] for path in _paths_of(message, "")]
    fields = fields_in_words(message)
    if not names or any(name.lower() in _STAMP_NAMES for name in names):
        return f"name its fields, {topic}?t=header.stamp,x=...{fields}"
    return (
        f"name its fields, {topic}?x=..., and take the times of the recorder with `stamps` "
        f"receive, because it has no stamp{fields}"
    )


def _paths_of(message: Any, prefix: str) -> Iterator[str]:
    """Yield the paths of the fields of a decoded message, such as ``pose.position.x``."""
    if is_dataclass(message):
        names = [field.name for field in fields_of(message)]
    else:
        # A message in JSON.
        names = [*getattr(message, "__dict__", ())]
    for name in names:
        # Names that begin with an underscore describe the type of the message.
        if name.startswith("_"):
            continue
        value = getattr(message, name)
        inner = [*_paths_of(value, f"{prefix}{name}.")]
        is_stamp = messages.ns_of(value) is not None
        yield from [f"{prefix}{name}"] if is_stamp or not inner else inner


class FieldReading(Reading):
    """Read fields that the user names, in messages of any type.

    Attributes
    ----------
    measures : str
        Quantity that the fields measure.

    Raises
    ------
    ConfigError
        If the fields are not in the form NAME=PATH,...
    InputError
        If the fields are angular rates without velocities.
    """

    def __init__(self, stream: str, topic: str, fields: str) -> None:
        super().__init__(stream, topic)
        paths: list[tuple[str, str]] = []
        for field in fields.split(","):
            name, _, path = field.partition("=")
            if not (name and path):
                raise ConfigError(
                    "fields must be NAME=PATH,..., such as "
                    f"t=header.stamp,x=pose.position.x; got {fields!r}"
                )
            paths.append((name, path))
        names = [name for name, _ in paths]
        self._paths = [path.split(".") for _, path in paths]
        are_twists = set(TWIST) <= set(names)
        self._table = Table(topic, names, "twists" if are_twists else "auto")
        self._bag_ns: list[int] = []
        # Fields of the newest message in words, for an error.
        self._listed = ""
        self.measures = "poses" if are_twists else self._table.measures
        if self.measures == "rates":
            raise InputError(
                f"{topic}: wx, wy, wz alone are no poses; also name vx, vy, vz"
            )

    def take(self, run: messages.Run) -> None:
        rows = []
        for message in run.decoded():
            rows.append([self._cell(message, path) for path in self._paths])
        if rows and not self._table.stamp_at:
            self._listed = fields_in_words(message)
        self._table.fill(enumerate(rows, len(self._bag_ns) + 1), list)
        self._bag_ns += run.bag_ns.tolist()

    def _cell(self, message: Any, path: list[str]) -> str:
        """Return a field of a message as text; a stamp is in seconds with all its digits."""
        value = message
        try:
            for name in path:
                value = (
                    value[int(name)]
                    if name.isdecimal()
                    else getattr(value, name)
                )
        except (AttributeError, IndexError, TypeError):
            raise InputError(
                f"{self.name}: a message has no {'.'.join(path)}; name other fields"
                f"{fields_in_words(message)}"
            ) from None
        stamp_ns = messages.ns_of(value)
        if stamp_ns is None:
            return str(value)
        return f"{Decimal(stamp_ns).scaleb(-9):f}"

    def table(self) -> PoseTable:
        table = self._table
        if not len(table.rows):
            raise InputError(f"no messages with a pose on {self.name}")
        bag_ns = np.asarray(self._bag_ns)[table.rows]
        if table.stamps:
            stamps_ns = stamps_in_ns(table, None)
        elif self.stamps == "receive":
            stamps_ns = bag_ns
        else:
            raise InputError(
                f"{self.name}: no field is the stamp, t: name it, such as t=header.stamp, or use "
                f"the times of the recorder: `{self.stream}_stamps` receive{self._listed}"
            )
        self.notes = table.guesses
        self._note_null(table.n_left_out, table.n_rows)
        if table.measures == "twists":
            poses = _integrated(stamps_ns, table.values())
        else:
            poses = np.column_stack(poses_of(table))
        return self._stamped(
            PoseTable.of(stamps_ns, poses).recorded(self.stream, bag_ns)
        )


def _integrated(stamps_ns: IntArray, twists: FloatArray) -> FloatArray:
    """Integrate twists (N, 6), m/s and rad/s in the sensor's frame, to poses (N, 7).

    The first pose is the identity. Between two stamps, the twist is the mean of both.
    """
    intervals_s = np.diff(stamps_ns) * 1e-9
    means = (twists[1:] + twists[:-1]) / 2
    steps = means * intervals_s[:, None]
    return se3.to_rows(se3.chained(se3.exp(steps)))


class TransformReading(Reading):
    """Read the transform between two frames from a chain of transforms.

    The poses have the stamps of the slowest moving transform in the chain.
    """

    def __init__(
        self, stream: str, source: TfStream, topics: Collection[str]
    ) -> None:
        super().__init__(
            stream,
            *(topic for topic in topics if not topic.endswith("tf_static")),
        )
        self._source = source
        # For each pose: bag time, stamp, and by frame the values x y z qx qy qz qw of each moving
        # transform.
        self._poses: list[tuple[int, int, Any]] = []
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
                continue
            for stamp_ns, edges in poses:
                self._poses.append((bag_ns, stamp_ns, edges))

    def table(self) -> PoseTable:
        frames = self._source.source
        self._refuse_zeros(self._n_zero, self._n_taken)
        if not self._poses:
            raise InputError(f"{frames}: {self._source.describe_missing()}")
        bag_ns, stamps_ns, edges = zip(*self._poses, strict=True)
        moving = {
            frame: np.array([rows[frame] for rows in edges])
            for frame in edges[0]
        }
        poses = se3.to_rows(self._source.composed(moving))
        self._note_null(self._n_null, self._n_null + len(poses))
        table = PoseTable.of(stamps_ns, poses, *frames).recorded(
            self.stream, bag_ns
        )
        return self._stamped(table)
