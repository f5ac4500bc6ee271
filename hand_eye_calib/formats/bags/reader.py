"""Reading the poses of two streams from bags."""

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from hand_eye_calib.core.base.arrays import IntArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.registry import BAG_READINGS
from hand_eye_calib.core.geometry.frames import FrameTree, checked_pose
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.bags import messages, roles, sources
from hand_eye_calib.formats.bags.folders import losses_of, open_bags
from hand_eye_calib.formats.bags.messages import PoseTable, Run
from hand_eye_calib.formats.bags.sources import Reading, Source
from hand_eye_calib.formats.files import LONGEST_NAME
from hand_eye_calib.formats.transforms import TfSource, TfStream

# A topic with fewer poses is not one of the two sensors: goals and initial poses are published
# once.
_FEWEST_POSES = 3


class TopicInfo(NamedTuple):
    """A topic of a bag: name, message type (empty if publishers disagree), number of messages."""

    name: str
    type: str
    count: int  # type: ignore[assignment]

    def __str__(self) -> str:
        return f"{self.name} ({self.type or 'several types'}, {self.count} messages)"


class PoseBag:
    """One bag, or several of one recording, opened for reading; a context manager. They are read in
    the order of their times; those that were recorded at the same time are merged.

    An InputError if there is no bag or it cannot be read. ``files`` are all that are read,
    ``topics`` are in the order of their names, ``start_ns`` and ``end_ns`` the bag times of the
    first and last message, if there are any. ``shown`` passes on runs of messages, and may show how
    far they are; it takes the runs, the number of all messages, what is being done, and what gives
    the size of a run.
    """

    def __init__(self, *paths: str | Path) -> None:
        self.paths = [Path(path) for path in paths]
        self.shown: Callable[..., Iterable[Run]] = lambda runs, *_: runs
        self._notes: list[str] = []
        with ExitStack() as opened:
            self._storages = open_bags(self.paths, opened)
            self._opened = opened.pop_all()
        self.files = [file for storage in self._storages for file in storage.paths]
        types = defaultdict[str, set[str]](set)
        counts = Counter[str]()
        for kind, count in chain(*(storage.counts.items() for storage in self._storages)):
            types[kind.topic].add(kind.type)
            counts[kind.topic] += count
        self.topics = {
            name: TopicInfo(name, "" if len(types[name]) > 1 else types[name].pop(), counts[name])
            for name in sorted(types)
        }
        for path in self.paths:
            inside = [storage for storage in self._storages if path in storage.paths[0].parents]
            n_present = sum(sum(storage.counts.values()) for storage in inside)
            self._notes += losses_of(path, n_present)
        spans = [each.span_ns for each in self._storages if each.span_ns]
        self.start_ns = min((first for first, _ in spans), default=None)
        self.end_ns = max((last for _, last in spans), default=None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def __str__(self) -> str:
        return ", ".join(map(str, self.paths))

    @property
    def warnings(self) -> list[str]:
        """What could not be read, and poses that cannot be right; complete after reading."""
        losses = [f"{each.paths[0]}: {loss}" for each in self._storages for loss in each.losses]
        return [*self._notes, *losses]

    @property
    def duration_s(self) -> float:
        """Time from the first message to the last; 0 if there is none."""
        return ((self.end_ns or 0) - (self.start_ns or 0)) * 1e-9

    # ---- topics

    def _listing(self) -> str:
        return f"The bag has {', '.join(map(str, self.topics.values())) or 'no topics'}"

    def type_of(self, source: Source) -> str:
        """Message type of a topic; empty for frames, and for what is not there."""
        return self.topics[source].type if source in self.topics else ""

    def _of_transforms(self) -> list[str]:
        return [topic.name for topic in self.topics.values() if topic.type in messages.TF_TYPES]

    def edges_on(self, topic: str) -> list[str]:
        """Pairs of frames, ``parent:child``, in the first messages of a topic, if these are
        transforms. An InputError if they cannot be read.
        """
        runs = self.runs([topic] if self.topics[topic].type in messages.TF_TYPES else [])
        first = next((run.transforms() for run in runs), ())
        return sorted({f"{each.world_frame}:{each.sensor_frame}" for _, each in first})

    def measured(self, source: Source, wanted: str = "auto") -> str:
        """What a source measures, one of registry.MEASURES: what is wanted of it, or what messages
        of its type are for; a ConfigError if they do not have what is wanted.
        """
        topic, _, fields = str(source).partition("?")
        if "=" in fields:
            usual = sources.FieldReading("", topic, fields).measures
            if usual != "poses" and wanted not in ("auto", usual):
                raise ConfigError(f"{source} measures {usual}; asked for are {wanted}")
            return usual if wanted == "auto" else wanted
        return messages.measured_as(self.type_of(source), wanted, source)

    def check(self, source: Source) -> None:
        """Raise InputError, with the topics that are there, for a topic without poses, and for
        frames of a bag without transforms.
        """
        if isinstance(source, TfSource):
            if not self._of_transforms():
                raise InputError(f"no transforms in {self}. {self._listing()}")
            return
        topic, _, fields = source.partition("?")
        parts = self._parts_of(topic)
        for part in parts:
            if part not in self.topics:
                raise InputError(f"no topic {part} in {self}. {self._listing()}")
        if len(parts) > 1:
            for part, wanted in zip(parts, ("positions", "rotations"), strict=True):
                self.measured(part, wanted)
        elif not fields and (type_ := self.type_of(topic)) not in messages.MESSAGE_TYPES:
            hint = "name its fields, TOPIC?t=header.stamp,x=..."
            if type_ in messages.TF_TYPES:
                hint = "name two of its frames instead, as odom:lidar"
            elif type_ in messages.IMAGE_TYPES:
                hint = f"name what images show, {topic}?charuco:5x7:0.04:0.03, or with --target"
            raise InputError(
                f"topic {source} of {self} is of type {type_ or 'several types'}, which is not "
                f"read as it is; {hint}. {self._listing()}"
            )

    def select(
        self,
        parent: Source | None = None,
        child: Source | None = None,
        frames: Mapping[str, str] | None = None,
    ) -> tuple[Source, Source]:
        """Choose the sources of the parent's and the child's poses; an InputError if one that is
        named cannot be used, both are the same, or there is a choice to make. With neither named,
        the bag has exactly two topics of poses, or of paths if there are no others; the parent is
        the one whose name has the word parent, base or lidar, or the first by name. If ``frames``
        name the sensors of "parent" or "child", the topics are chosen by these names.
        """
        named = [source for source in (parent, child) if source]
        for source in named:
            self.check(source)
        if len(named) == 2 and named[0] == named[1]:
            raise InputError(
                f"parent and child topic are both {parent}; name two topics. {self._listing()}"
            )
        free = [topic for name, topic in self.topics.items() if name not in named]
        poses = [topic for topic in free if topic.type in messages.POSE_TYPES]
        moving = [topic for topic in poses if topic.count >= _FEWEST_POSES]
        paths = [topic for topic in free if topic.type == messages.PATH_TYPE]
        wanted = 2 - len(named)
        choices = [topics for topics in (poses, moving, moving + paths) if len(topics) == wanted]
        if wanted and not choices:
            found = sorted({edge for name in self.topics for edge in self.edges_on(name)})
            raise InputError(
                "name the topics of poses with --parent-topic and --child-topic, or frames as "
                f"odom:lidar. {self._listing()}"
                + (f". Transforms are {', '.join(found)[:LONGEST_NAME]}" if found else "")
            )
        chosen = [topic.name for topic in choices[0]] if wanted else []
        if wanted == 2:
            is_named = any((frames or {}).values())
            sensors = {topic: self.sensor_frame(topic) for topic in chosen if is_named}
            chosen = roles.parent_and_child(chosen, frames or {}, sensors)
        return parent or chosen.pop(0), child or chosen.pop(0)

    def sensor_frame(self, topic: str) -> str:
        """Frame of the sensor of a topic of poses, as its first message names it; empty if none."""
        run = next(self.runs([topic]), None)
        kind = self.topics[topic].type
        if run is None or kind not in messages.POSE_TYPES:
            return ""
        try:
            table = messages.unpack_poses(run.messages[:1], kind, run.kind.is_ros1)
        except messages.MALFORMED as error:
            raise run.unreadable(error) from error
        return table.sensor_frames[0] or ""

    def _parts_of(self, topic: str) -> list[str]:
        """The topics of positions and of orientations of ``/fix+/imu``; otherwise the topic."""
        parts = topic.split("+")
        return parts if topic not in self.topics and len(parts) == 2 and all(parts) else [topic]

    # ---- poses

    def poses(
        self,
        parent: Source,
        child: Source | None = None,
        max_gap_s: float = CalibratorConfig.max_gap,
        measures: Mapping[str, str] | None = None,
        stamps: Mapping[str, str] | None = None,
    ) -> PoseTable:
        """The poses of one or two streams in the order of the bag's time; an InputError if the bag
        is damaged, or the transforms do not lead from one frame to the other. Up to ``max_gap_s``
        is interpolated between two transforms of a chain; ``measures`` are what the topics of
        "parent" and "child" are read as, see :meth:`measured`; ``stamps`` are where their stamps
        come from, "header" or "receive".
        """
        measures = measures or {}
        wanted = {"parent": parent} | ({"child": child} if child else {})
        readings = [
            self._reading(stream, source, measures.get(stream, "auto"), max_gap_s)
            for stream, source in wanted.items()
        ]
        for reading in readings:
            reading.use_stamps((stamps or {}).get(reading.stream, "header"))
        topics = {topic for reading in readings for topic in reading.topics}
        count = sum(self.topics[topic].count for topic in topics)
        runs = self.runs(topics)
        for run in self.shown(runs, count, f"reading {self}", lambda run: len(run.messages)):
            for reading in readings:
                if run.kind.topic in reading.topics:
                    reading.take(run)
        tables = [reading.table() for reading in readings]
        self._notes += [note for reading in readings for note in reading.notes]
        return PoseTable.joined(tables)

    def _reading(self, stream: str, source: Source, measures: str, max_gap_s: float) -> Reading:
        if isinstance(source, TfSource):
            self.static_frames.route(*source)  # or it raises
            of_tree = TfStream(source, max_gap_s, self.static_frames)
            return sources.TransformReading(stream, of_tree, self._of_transforms())
        topic, _, fields = source.partition("?")
        if ":" in fields and "=" not in fields:
            return BAG_READINGS["images of a target"](self, stream, topic, fields)
        type_ = self.type_of(topic)
        row = messages.MESSAGE_TYPES.get(type_)
        if fields := fields or (row.fields if row else ""):
            return sources.FieldReading(stream, topic, fields)
        if row and row.unpack:
            return sources.TopicReading(stream, topic, type_, self.measured(source, measures))
        if type_ == messages.PATH_TYPE:
            return sources.PathReading(stream, topic)
        if type_ == messages.POINTS_TYPE:
            return BAG_READINGS[type_](self, stream, topic, fields)
        fixes, turns = self._parts_of(topic)
        return sources.JoinedReading(
            sources.TopicReading(stream, fixes, self.type_of(fixes), "positions"),
            sources.TopicReading(stream, turns, self.type_of(turns), "rotations"),
        )

    def trajectory(
        self, source: Source, measures: str = "auto", stamps: str = "header"
    ) -> tuple[Trajectory, list[str]]:
        """The trajectory of one source in the order of stamps, of those with equal stamps the
        first, and what a person should know; ``measures`` as of :meth:`measured`, ``stamps`` as of
        :meth:`poses`. An InputError if the bag or a pose cannot be read.
        """
        self.check(source)
        poses = self.poses(source, measures={"parent": measures}, stamps={"parent": stamps})
        if not len(poses):
            raise InputError(f"no poses on {source} of {self}")
        kind: Any = self.measured(source, measures)
        trajectory = replace(poses.trajectory(), measures=kind)
        notes = []
        if (np.diff(poses.stamps_ns) <= 0).any():
            notes.append(
                f"{source}: poses were put in the order of their stamps; "
                f"{len(poses) - len(trajectory)} of {len(poses)} repeated one and were dropped"
            )
        return trajectory, notes

    @cached_property
    def static_frames(self) -> FrameTree:
        """The frames of the bag and their static transforms; of repeated ones the last. As in tf2,
        one that is no pose is left out. An InputError if they form no tree or are damaged.
        """
        tree = FrameTree("the bag's transforms")
        notes = {}
        for run in self.runs(self._of_transforms()):
            is_fixed = run.kind.topic.endswith("tf_static")
            for _, (_, parent, frame, *values) in run.transforms():
                try:
                    pose = checked_pose(*values) if is_fixed else None
                except InputError as error:
                    notes[frame] = f"transform {parent}:{frame} was left out: {error}"
                else:
                    tree.add(parent, frame or "", pose, is_fixed)
        self._notes += notes.values()
        return tree

    # ---- messages

    def runs(self, topics: Collection[str]) -> Iterator[Run]:
        """Messages of some topics, many of a kind at once: in the order of bag time, or one file
        after the other if they were recorded at the same time.
        """
        for block in chain.from_iterable(each.blocks(topics) for each in self._storages):
            for kind in {id(each): each for each, _, _ in block}.values():
                data = [data for each, _, data in block if each is kind]
                bag_ns = [bag_ns for each, bag_ns, _ in block if each is kind]
                yield Run(kind, data, _bag_times(bag_ns))


def _bag_times(bag_ns: Sequence[int]) -> IntArray:
    """Return times as int64 (N,); a damaged bag may have times beyond, which get its limits."""
    try:
        return np.array(bag_ns, dtype=np.int64)
    except OverflowError:
        limits = np.iinfo(np.int64)
        inside = [min(max(time_ns, limits.min), limits.max) for time_ns in bag_ns]
        return np.array(inside, dtype=np.int64)
