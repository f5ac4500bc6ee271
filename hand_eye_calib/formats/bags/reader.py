"""Read the poses of two streams, parent and child, from bags."""

from collections import defaultdict
from collections.abc import (
    Callable,
    Collection,
    Iterable,
    Iterator,
    Mapping,
    Sequence,
)
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from hand_eye_calib.core.base.arrays import IntArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.option import did_you_mean
from hand_eye_calib.core.base.registry import BAG_READINGS
from hand_eye_calib.core.geometry.frames import FrameTree, checked_pose
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.bags import messages, roles, sources, unpacking
from hand_eye_calib.formats.bags.choice import TopicInfo, choose, listed_usable
from hand_eye_calib.formats.bags.folders import losses_of, open_bags
from hand_eye_calib.formats.bags.messages import Run
from hand_eye_calib.formats.bags.pose_table import PoseTable
from hand_eye_calib.formats.bags.sources import Reading, Source
from hand_eye_calib.formats.bags.storage import ALWAYS, MessageKind, Span
from hand_eye_calib.formats.transforms import TfSource, TfStream

# Packages whose messages contain no pose, except those types that are read.
_WITHOUT_POSES = (
    *("sensor_msgs/", "std_msgs/", "visualization_msgs/", "diagnostic_msgs/"),
    *("rcl_interfaces/", "rosgraph_msgs/", "shape_msgs/"),
)


class PoseBag:
    """Read one bag, or several bags of one recording (context manager).

    The bags are read in the order of their times. Bags from the same time are merged.

    Parameters
    ----------
    *paths : str or Path

    Attributes
    ----------
    files : list of Path
        All files that are read.
    topics : dict of str to TopicInfo
        In the order of their names.
    start_ns, end_ns : int or None
        Bag times of the first and the last message; None without messages.
    shown : callable
        Hook that reports progress. ``shown(runs, n_messages, step, size_of)`` yields the runs of
        messages. ``step`` is a text for the user; ``size_of(run)`` returns the number of its
        messages.

    Raises
    ------
    InputError
        If a path is not a bag, or a bag cannot be read.
    """

    def __init__(self, *paths: str | Path) -> None:
        self.paths = [Path(path) for path in paths]
        self.shown: Callable[..., Iterable[Run]] = lambda runs, *_: runs
        self._notes: list[str] = []
        with ExitStack() as opened:
            self._storages = open_bags(self.paths, opened)
            self._opened = opened.pop_all()
        self.files = [
            file for storage in self._storages for file in storage.paths
        ]
        self.topics = self._all_topics()
        for path in self.paths:
            n_present = 0
            for storage in self._storages:
                if path in storage.paths[0].parents:
                    n_present += storage.counts.total()
            self._notes += losses_of(path, n_present)
        times_ns = [
            time_ns for storage in self._storages for time_ns in storage.span_ns
        ]
        self.start_ns = min(times_ns, default=None)
        self.end_ns = max(times_ns, default=None)

    def _all_topics(self) -> dict[str, TopicInfo]:
        """Return the topics of all files, sorted by name."""
        topics: dict[str, TopicInfo] = {}
        for storage in self._storages:
            for kind, count in storage.counts.items():
                previous = topics.get(
                    kind.topic, TopicInfo(kind.topic, kind.type, 0)
                )
                type_ = kind.type if kind.type == previous.type else ""
                topics[kind.topic] = TopicInfo(
                    kind.topic, type_, previous.count + count
                )
        return dict(sorted(topics.items()))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def __str__(self) -> str:
        return ", ".join(map(str, self.paths))

    @property
    def warnings(self) -> list[str]:
        """Lines about unreadable parts, and about skipped poses.

        The list is complete after all poses were read.
        """
        warnings = [*self._notes]
        for storage in self._storages:
            warnings += [
                f"{storage.paths[0]}: {loss}" for loss in storage.losses
            ]
        return warnings

    @property
    def duration_s(self) -> float:
        """Time from the first message to the last; 0 without messages."""
        return ((self.end_ns or 0) - (self.start_ns or 0)) * 1e-9

    # ---- topics

    def _listing(self) -> str:
        """Return a sentence with the topics of the bag, for messages."""
        topics = listed_usable([*self.topics.values()])
        return f"The bag has {topics or 'no topics'}"

    def type_of(self, source: Source) -> str:
        """Return the message type of a topic; empty for missing topics and for pairs of frames."""
        return self.topics[source].type if source in self.topics else ""

    def _tf_topics(self) -> list[str]:
        """Return the names of the topics of transforms."""
        return [
            topic.name
            for topic in self.topics.values()
            if topic.type in messages.TF_TYPES
        ]

    def edges_on(self, topic: str) -> list[str]:
        """Return the pairs of frames ``parent:child`` in the first transforms on a topic.

        The list is empty for other topics. Raises InputError if the messages cannot be read.
        """
        if self.type_of(topic) not in messages.TF_TYPES:
            return []
        first_run = next(self.runs([topic]), None)
        if first_run is None:
            return []
        edges = {
            f"{edge.world_frame}:{edge.sensor_frame}"
            for _, edge in first_run.transforms()
        }
        return sorted(edges)

    def measured(self, source: Source, wanted: str = "auto") -> str:
        """Return the quantity to read from a source: a key of registry.MEASURES.

        Parameters
        ----------
        source : Source
        wanted : str
            Quantity that the user requests, or "auto" for the usual quantity of the messages.

        Raises
        ------
        ConfigError
            If the messages do not contain the wanted quantity.
        """
        topic, _, fields = str(source).partition("?")
        if "=" not in fields:
            return messages.measured_as(self.type_of(topic), wanted, source)
        # The source names fields of the messages. They determine the quantity.
        usual = sources.FieldReading("", topic, fields).measures
        if wanted == "auto":
            return usual
        if usual not in ("poses", wanted):
            raise ConfigError(
                f"{source} measures {usual}, but the options ask for {wanted}"
            )
        return wanted

    def check(self, source: Source, taken: Sequence[Source] = ()) -> None:
        """Raise InputError if a source cannot be read. The message lists the topics of the bag.

        Topics that are missing or have no poses cannot be read. Pairs of frames cannot be read from
        a bag without transforms. Where the message proposes a topic of a similar name, it leaves
        out the sources in ``taken``, which other streams use.
        """
        if isinstance(source, TfSource):
            if not self._tf_topics():
                raise InputError(
                    f"no transforms in {self}: name topics with poses instead. {self._listing()}"
                )
            return
        topic, _, fields = source.partition("?")
        topics = self._parts_of(topic)
        for name in topics:
            if name not in self.topics:
                free = [topic for topic in self.topics if topic not in taken]
                hint = did_you_mean(name, free) or "."
                raise InputError(
                    f"no topic {name} in {self}{hint} {self._listing()}"
                )
        if len(topics) > 1:
            self.measured(topics[0], "positions")
            self.measured(topics[1], "rotations")
        elif not fields:
            self._check_type(topic)

    def _check_type(self, topic: str) -> None:
        """Raise InputError if the messages of a topic are unreadable and no fields are named.

        The message contains what the user can write instead of the topic alone.
        """
        type_ = self.type_of(topic)
        if type_ in messages.MESSAGE_TYPES:
            return
        hint = sources.hint_for_fields(topic, self._first_message(topic))
        if type_ in messages.TF_TYPES:
            hint = "name two of its frames instead, as odom:lidar"
        elif type_ == messages.TWIST_TYPE:
            hint = (
                "it has no stamps, and is usually a command: record the measured velocity "
                "as TwistStamped or Odometry"
            )
        elif type_ in messages.IMAGE_TYPES:
            hint = f"name the target in the images, {topic}?charuco:5x7:0.04:0.03, or set --target"
        elif type_.startswith(_WITHOUT_POSES):
            hint = (
                "its messages contain no pose: run the odometry or SLAM of this sensor, "
                "and give the topic of its poses"
            )
        raise InputError(
            f"topic {topic} of {self} has type {type_ or 'several types'}, "
            f"which cannot be read; {hint}. {self._listing()}"
        )

    def _first_message(self, topic: str) -> Any:
        """Return the first message of a topic, decoded; None if this is impossible."""
        run = next(self.runs([topic]), None)
        # The definition of the type may be missing.
        with suppress(InputError):
            return next(run.decoded()) if run else None
        return None

    def select(
        self,
        parent: Source | None = None,
        child: Source | None = None,
        frames: Mapping[str, str] | None = None,
    ) -> tuple[Source, Source]:
        """Choose the sources of the parent's and the child's poses.

        Sources that the user does not name must be obvious, see :mod:`.choice`. If no source is
        named, ``frames`` decides which topic is the parent's. Without ``frames``, the parent is the
        topic with parent, base or lidar in its name, or the first topic by name.

        Parameters
        ----------
        parent, child : Source, optional
            Sources as the user names them.
        frames : mapping of str to str, optional
            Frames that the user sets for "parent" or "child".

        Raises
        ------
        InputError
            If a named source is unusable, if both sources are the same, or if no choice is obvious.
        """
        named = [source for source in (parent, child) if source]
        for source in named:
            self.check(source, named)
        if len(named) == 2 and parent == child:
            raise InputError(
                f"parent and child topic are both {parent}; name two topics. {self._listing()}"
            )
        if not (parent and child):
            parent, child = self._completed(parent, child, named, frames or {})
        topics = [str(source).partition("?")[0] for source in (parent, child)]
        types = {self.type_of(topic): topic for topic in topics}
        self._notes += roles.remarks_on_wheels(types)
        return parent, child

    def _completed(
        self,
        parent: Source | None,
        child: Source | None,
        named: Sequence[Source],
        frames: Mapping[str, str],
    ) -> tuple[Source, Source]:
        """Return both sources, of which the user has named at most one, see :meth:`select`."""
        missing = [
            name
            for name, source in (("parent", parent), ("child", child))
            if not source
        ]
        topics = self._choice(missing, named)
        if parent:
            return parent, topics[0]
        if child:
            return topics[0], child
        return self._by_role(topics, frames)

    def _by_role(
        self, topics: Sequence[str], frames: Mapping[str, str]
    ) -> tuple[str, str]:
        """Sort two topics: first the parent's, then the child's."""
        sensors = {}
        if any(frames.values()):
            sensors = {topic: self.sensor_frame(topic) for topic in topics}
        parent, child = roles.parent_and_child(topics, frames, sensors)
        return parent, child

    def _choice(
        self, missing: Sequence[str], used: Collection[Source]
    ) -> list[str]:
        """Return the topics for the missing streams: "parent", "child" or both.

        Raises UnclearStreamsError if no choice is obvious. ``used`` are the sources that the user
        named.
        """
        free = [
            topic for topic in self.topics.values() if topic.name not in used
        ]
        moving_edges = set()
        for topic in self._tf_topics():
            if not topic.endswith("tf_static"):
                moving_edges.update(self.edges_on(topic))
        return choose(free, missing, self.sensor_frame, moving_edges)

    def sensor_frame(self, topic: str) -> str:
        """Return the sensor's frame in the first message of a topic; empty if it is missing."""
        type_ = self.type_of(topic)
        if type_ not in (*messages.POSE_TYPES, *messages.SENSOR_TYPES):
            return ""
        run = next(self.runs([topic]), None)
        if run is None:
            return ""
        try:
            table = unpacking.unpack_poses(
                run.messages[:1], type_, run.kind.is_ros1
            )
        except messages.MALFORMED as error:
            raise run.unreadable(error) from error
        if type_ in messages.SENSOR_TYPES:
            return table.world_frames[0]
        return table.sensor_frames[0] or ""

    def _parts_of(self, topic: str) -> list[str]:
        """Split ``/fix+/imu`` into the topic of positions and the topic of orientations.

        Any other name is returned as the only element.
        """
        parts = topic.split("+")
        is_joined = topic not in self.topics and len(parts) == 2 and all(parts)
        return parts if is_joined else [topic]

    # ---- poses

    def poses(
        self,
        parent: Source,
        child: Source | None = None,
        max_gap_s: float = CalibratorConfig.max_gap,
        measures: Mapping[str, str] | None = None,
        stamps: Mapping[str, str] | None = None,
    ) -> PoseTable:
        """Read the poses of one or two streams in the order of bag time.

        Parameters
        ----------
        parent, child : Source
        max_gap_s : float
            Largest time (s) between two transforms that are interpolated.
        measures : mapping of str to str, optional
            Quantities to read from the topics of "parent" and "child", see :meth:`measured`.
        stamps : mapping of str to str, optional
            Stamps of "parent" and "child": "header", or "receive" for the times at which the
            recorder received the messages.

        Raises
        ------
        InputError
            If the bag is damaged, or the transforms do not connect the frames.
        """
        readings = [self._reading("parent", parent, measures or {}, max_gap_s)]
        if child:
            readings.append(
                self._reading("child", child, measures or {}, max_gap_s)
            )
        return self._poses_of(readings, stamps or {})

    def _poses_of(
        self, readings: Sequence[Reading], stamps: Mapping[str, str]
    ) -> PoseTable:
        """Read the poses of streams in the order of bag time. For ``stamps`` see `poses`."""
        topics: set[str] = set()
        for reading in readings:
            reading.use_stamps(stamps.get(reading.stream, "header"))
            topics.update(reading.topics)
        count = sum(self.topics[topic].count for topic in topics)
        runs = self.runs(topics)
        for run in self.shown(
            runs, count, f"reading {self}", lambda run: len(run.messages)
        ):
            for reading in readings:
                if run.kind.topic in reading.topics:
                    reading.take(run)
        tables = [reading.table() for reading in readings]
        for reading in readings:
            self._notes += reading.notes
        return PoseTable.joined(tables)

    def _reading(
        self,
        stream: str,
        source: Source,
        measures: Mapping[str, str],
        max_gap_s: float,
    ) -> Reading:
        """Return the reader for a source. ``stream`` is "parent" or "child"."""
        if isinstance(source, TfSource):
            # This raises an InputError if the frames are unconnected.
            self.static_frames.route(*source)
            tf_stream = TfStream(source, max_gap_s, self.static_frames)
            return sources.TransformReading(
                stream, tf_stream, self._tf_topics()
            )
        topic, _, fields = source.partition("?")
        if ":" in fields and "=" not in fields:
            return BAG_READINGS["images of a target"](
                self, stream, topic, fields
            )
        type_ = self.type_of(topic)
        if type_ == messages.JOINTS_TYPE and "=" not in fields:
            return BAG_READINGS[type_](
                stream, topic, fields, measures.get(stream, "auto")
            )
        row = messages.MESSAGE_TYPES.get(type_)
        if row:
            fields = fields or row.fields
        if fields:
            return sources.FieldReading(stream, topic, fields)
        if row and row.unpack:
            wanted = self.measured(source, measures.get(stream, "auto"))
            return sources.TopicReading(stream, topic, type_, wanted)
        return self._reading_of_several_poses(stream, topic, type_)

    def _reading_of_several_poses(
        self, stream: str, topic: str, type_: str
    ) -> Reading:
        """Return the reader for a topic whose messages do not contain a single pose.

        Such messages are paths, clouds, or positions whose rotations come from another topic.
        """
        if type_ == messages.PATH_TYPE:
            return sources.PathReading(stream, topic)
        if type_ == messages.POINTS_TYPE:
            return BAG_READINGS[type_](self, stream, topic, "")
        fixes, rotations = self._parts_of(topic)
        return sources.JoinedReading(
            sources.TopicReading(
                stream, fixes, self.type_of(fixes), "positions"
            ),
            sources.TopicReading(
                stream, rotations, self.type_of(rotations), "rotations"
            ),
        )

    def trajectory(
        self,
        source: Source,
        measures: str = "auto",
        stamps: str = "header",
        stream: str = "parent",
    ) -> tuple[Trajectory, list[str]]:
        """Read the trajectory of one source, sorted by stamps.

        Among poses with equal stamps, only the first is used.

        Parameters
        ----------
        source : Source
        measures : str
            Quantity to read, see :meth:`measured`.
        stamps : {"header", "receive"}
            See :meth:`poses`.
        stream : {"parent", "child"}
            Stream whose options are named in errors.

        Returns
        -------
        Trajectory
        list of str
            Notes for the user.

        Raises
        ------
        InputError
            If the bag or a pose cannot be read.
        """
        self.check(source)
        reading = self._reading(
            stream, source, {stream: measures}, CalibratorConfig.max_gap
        )
        poses = self._poses_of([reading], {stream: stamps})
        if not len(poses):
            raise InputError(f"no poses on {source} of {self}")
        kind: Any = self.measured(source, measures)
        trajectory = replace(poses.trajectory(), measures=kind)
        notes = []
        if (np.diff(poses.stamps_ns) <= 0).any():
            notes.append(
                f"{source}: poses were sorted by their stamps; "
                f"{len(poses) - len(trajectory)} of {len(poses)} repeated a "
                "stamp and were dropped"
            )
        return trajectory, notes

    @cached_property
    def static_frames(self) -> FrameTree:
        """Tree of all frames in the bag, with the poses of the static transforms.

        If a static transform is repeated, the last one is used. Invalid transforms are skipped with
        a note, as in tf2. Raises InputError if the frames do not form a tree, or if a message is
        damaged.
        """
        tree = FrameTree("the bag's transforms")
        notes = {}
        for run in self.runs(self._tf_topics()):
            is_static = run.kind.topic.endswith("tf_static")
            for _, (_, parent, frame, *values) in run.transforms():
                try:
                    pose = checked_pose(*values) if is_static else None
                except InputError as error:
                    notes[frame] = (
                        f"transform {parent}:{frame} was left out: {error}"
                    )
                else:
                    tree.add(parent, frame or "", pose, is_static)
        self._notes += notes.values()
        return tree

    # ---- messages

    def runs(
        self, topics: Collection[str], span_ns: Span = ALWAYS
    ) -> Iterator[Run]:
        """Iterate over the messages of topics, in runs of one kind of message.

        A run has the messages of one kind in a block of a file, in the order of bag time. The
        blocks of a file follow each other in time, and the files are read one after the other. Only
        messages with a bag time (ns) in ``span_ns`` are read.
        """
        start_ns, stop_ns = span_ns
        for storage in self._storages:
            for block in storage.blocks(topics, span_ns):
                rows_of = defaultdict[MessageKind, list[tuple[int, bytes]]](
                    list
                )
                for kind, bag_ns, data in block:
                    if start_ns <= bag_ns < stop_ns:
                        rows_of[kind].append((bag_ns, data))
                for kind, rows in rows_of.items():
                    times_ns = _bag_times([bag_ns for bag_ns, _ in rows])
                    yield Run(kind, [data for _, data in rows], times_ns)


def _bag_times(bag_ns: Sequence[int]) -> IntArray:
    """Return bag times (N,), ns, as int64. Times of damaged bags are clipped to its range."""
    try:
        return np.array(bag_ns, dtype=np.int64)
    except OverflowError:
        limits = np.iinfo(np.int64)
        inside = [
            min(max(time_ns, limits.min), limits.max) for time_ns in bag_ns
        ]
        return np.array(inside, dtype=np.int64)
