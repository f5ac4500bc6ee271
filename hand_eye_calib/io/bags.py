"""Poses in bags: rosbag2 (sqlite3, mcap) and rosbag1, read and written without ROS. The only module
that imports rosbags.

Only the messages of the chosen topics are read, and of these only stamp, frames and pose
(:mod:`~hand_eye_calib.io.messages`). mcap files have a reader of their own
(:mod:`~hand_eye_calib.io.mcap`), which copes with those that end in the middle and leaves camera
images where they are.
"""

import heapq
import re
import shutil
import struct
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from pathlib import Path, PurePath
from typing import NamedTuple

import numpy as np
import yaml
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2.reader import zstd
from rosbags.rosbag2.storage_mcap import decompress
from rosbags.typesys import Stores, get_typestore

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.mcap import McapFile
from hand_eye_calib.io.messages import (
    MALFORMED,
    PATH_TYPE,
    POSE_TYPES,
    TF_TYPES,
    MalformedMessage,
    PoseColumns,
    unpack_path,
    unpack_poses,
    unpack_transforms,
)
from hand_eye_calib.io.plausibility import PoseWatch
from hand_eye_calib.io.transforms import TfSource, TransformTree

STORAGES = ("mcap", "sqlite3", "rosbag1")

_NS_PER_S = 1_000_000_000
_KINDS = "a rosbag2 directory, a .mcap or .db3 file of one, or a rosbag1 .bag file"
_STORAGE_SUFFIXES = (".mcap", ".db3", ".bag")
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

# Messages that are unpacked at once.
_BLOCK = 2048
# A topic that carries fewer poses is none that two sensors could be meant by: goals and initial
# poses are published once.
_FEWEST_POSES = 3


class TopicInfo(NamedTuple):
    """A topic of a bag: its name, its message type ("" where publishers disagree) and its number of
    messages.
    """

    name: str
    type: str
    count: int

    def __str__(self):
        return f"{self.name} ({self.type or 'several types'}, {self.count} messages)"


class TopicDescription(NamedTuple):
    """A topic, looked at more closely.

    Attributes
    ----------
    name, type, count
        As in TopicInfo.
    rate_hz, duration_s : float or None
        Of the stamps where the topic has poses, otherwise of the bag; None where there are too few
        messages.
    frames : list of str
        ``world:sensor`` of poses, as far as they say; ``parent:child`` of transforms.
    is_usable : bool
        Whether poses can be read from it.
    """

    name: str
    type: str
    count: int
    rate_hz: float | None
    duration_s: float | None
    frames: list
    is_usable: bool


class StampedPose(NamedTuple):
    """A pose of a stream.

    Attributes
    ----------
    stream : str
        "parent" or "child".
    number : int
        Of the message within its topic, from 1; of a path or a transform, of the pose.
    stamp_ns : int
        From the header.
    world_frame : str
    sensor_frame : str or None
        None where the message type does not carry it.
    position : tuple of 3 floats
        m.
    quat_xyzw : tuple of 4 floats
        As recorded: not checked, not normalised.
    bag_ns : int
        When it was recorded.
    """

    stream: str
    number: int
    stamp_ns: int
    world_frame: str
    sensor_frame: str | None
    position: tuple
    quat_xyzw: tuple
    bag_ns: int


@dataclass(frozen=True)
class PoseBlock:
    """N StampedPoses in columns: what is quickly made of many messages, and quickly handed on.

    Attributes
    ----------
    streams, world_frames, sensor_frames : (N,) arrays of str or None
    numbers : (N,) int array
    stamps_ns, bag_ns : (N,) int64 arrays
    poses : (N, 7) array
        x y z qx qy qz qw.
    """

    streams: np.ndarray
    numbers: np.ndarray
    stamps_ns: np.ndarray
    world_frames: np.ndarray
    sensor_frames: np.ndarray
    poses: np.ndarray
    bag_ns: np.ndarray

    def __len__(self):
        return len(self.stamps_ns)

    def __getitem__(self, index):
        return PoseBlock(*(column[index] for column in vars(self).values()))

    @classmethod
    def concatenate(cls, blocks):
        """One after the other."""
        return cls(
            *map(np.concatenate, zip(*(vars(block).values() for block in blocks), strict=True))
        )

    @classmethod
    def of_columns(cls, stream, numbers, columns, bag_ns):
        """Of PoseColumns."""
        streams = np.full(len(numbers), stream, dtype=object)
        frames = (
            np.array(names, dtype=object) for names in (columns.world_frames, columns.sensor_frames)
        )
        return cls(streams, numbers, columns.stamps_ns, *frames, columns.numbers, bag_ns)

    @classmethod
    def of_rows(cls, rows):
        """Of a list of StampedPose."""
        streams, numbers, stamps_ns, world_frames, sensor_frames, positions, quats_xyzw, bag_ns = (
            zip(*rows, strict=True)
        )
        names = (
            np.array(column, dtype=object) for column in (streams, world_frames, sensor_frames)
        )
        streams, world_frames, sensor_frames = names
        stamps_ns, bag_ns = np.array(stamps_ns, dtype=np.int64), np.array(bag_ns, dtype=np.int64)
        poses = np.concatenate([positions, quats_xyzw], axis=1)
        return cls(
            streams, np.array(numbers), stamps_ns, world_frames, sensor_frames, poses, bag_ns
        )

    def rows(self):
        """An iterator of StampedPose."""
        rows = zip(
            self.streams.tolist(), self.numbers.tolist(), self.stamps_ns.tolist(), self.world_frames.tolist(),
            self.sensor_frames.tolist(), _tuples(self.poses[:, :3]), _tuples(self.poses[:, 3:]), self.bag_ns.tolist(), strict=True,
        )  # fmt: skip
        return map(_make_stamped_pose, rows)


class PoseBag:
    """One bag, or several of one drive, opened for reading; a context manager.

    Parameters
    ----------
    *paths : str or path-like
        Each a rosbag2 directory, a single ``.mcap`` or ``.db3`` file of one, or a rosbag1 ``.bag``
        file. They are read in the order of their times, those that were recorded at the same time
        side by side.

    Raises
    ------
    InputError
        Where there is no bag or it cannot be read: one line that names the path and says what to
        do.
    """

    def __init__(self, *paths):
        self.paths = [Path(path) for path in paths]
        self._notes, self._parts, self._temporary = [], [], None
        self._watches = {}
        try:
            for path in self.paths:
                _check_path(path)
                self._parts += [self._open(path, file) for file in self._storage_files(path)]
        except BaseException:
            self.close()
            raise
        self._parts.sort(key=lambda part: (part.start_ns is None, part.start_ns))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """Close the files."""
        for part in self._parts:
            part.close()
        if self._temporary:
            self._temporary.cleanup()

    def __str__(self):
        return ", ".join(map(str, self.paths))

    @property
    def warnings(self):
        """What a person should know of what could not be read, and of poses that cannot be right;
        complete after reading.
        """
        losses = [f"{part.path}: {loss}" for part in self._parts for loss in part.losses]
        return (
            self._notes
            + losses
            + [text for name, watch in self._watches.items() for text in watch.warnings(name)]
        )

    @property
    def n_left_out(self):
        """Messages left out because their stamps cannot be right; complete after reading."""
        return sum(watch.n_stamps for watch in self._watches.values())

    @property
    def start_ns(self):
        """Bag time of the first message, None where there is none."""
        return min(
            (part.start_ns for part in self._parts if part.start_ns is not None), default=None
        )

    @property
    def end_ns(self):
        """Bag time of the last message, None where there is none."""
        return max((part.end_ns for part in self._parts if part.end_ns is not None), default=None)

    def files(self):
        """Paths of all files that are read, a list."""
        return [part.path for part in self._parts]

    # ---- what is there

    def topics(self):
        """All topics, a list of TopicInfo in the order of their names."""
        found = {}
        for part in self._parts:
            for name, (message_type, count) in part.topics.items():
                known, before = found.get(name, (message_type, 0))
                found[name] = (message_type if message_type == known else "", before + count)
        return [TopicInfo(name, *found[name]) for name in sorted(found)]

    def describe(self):
        """All topics with rates and frames, a list of TopicDescription; reads all poses and
        transforms.

        Raises
        ------
        InputError
            Where a message cannot be read.
        """
        infos = self.topics()
        looks = {
            info.name: _Look() for info in infos if info.type in (*POSE_TYPES, PATH_TYPE, *TF_TYPES)
        }
        counts = dict.fromkeys(looks, 0)
        for block in self._messages(looks):
            for kind in {message[0] for message in block}:
                messages = [message[2] for message in block if message[0] == kind]
                looks[kind.topic].take(kind, counts[kind.topic] + 1, messages)
                counts[kind.topic] += len(messages)
        duration_s = (self.end_ns - self.start_ns) * 1e-9 if self.start_ns is not None else 0.0
        return [looks.get(info.name, _Look()).describe(info, duration_s) for info in infos]

    def select_topics(self, parent=None, child=None):
        """Where the parent's and the child's poses come from.

        What is not named is chosen where the bag leaves only one way to do it: with neither named,
        it has exactly two topics of poses, and the first in alphabetical order becomes the parent.
        Topics of paths count where there are not enough others.

        Parameters
        ----------
        parent, child : str, TfSource or None
            A topic, or a pair of frames.

        Raises
        ------
        InputError
            Where a named topic is not in the bag or holds no poses, where both are the same, or
            where there is a choice to make. The message lists the topics that are there.
        """
        topics = {topic.name: topic for topic in self.topics()}
        named = [source for source in (parent, child) if source]
        for source in named:
            self.check(source)
        if len(named) == 2 and named[0] == named[1]:
            raise InputError(
                f"parent and child topic are both {parent}; name two topics. {self._listing(topics)}"
            )
        wanted = 2 - len(named)
        free = [
            name for name, topic in topics.items() if topic.type in POSE_TYPES and name not in named
        ]
        moving = [name for name in free if topics[name].count >= _FEWEST_POSES]
        paths = [
            name for name, topic in topics.items() if topic.type == PATH_TYPE and name not in named
        ]
        choices = [names for names in (free, moving, moving + paths) if len(names) == wanted]
        if wanted and not choices:
            raise InputError(
                f"name the topics of poses with --parent-topic and --child-topic, or frames with --parent-tf and --child-tf. "
                f"{self._listing(topics)}"
            )
        chosen = sorted(choices[0]) if wanted else []
        return parent or chosen.pop(0), child or chosen.pop(0)

    def check(self, source):
        """Whether the bag has this topic, with poses on it, or transforms.

        Raises
        ------
        InputError
            Where it has not; the message lists the topics that are there.
        """
        topics = {topic.name: topic for topic in self.topics()}
        if isinstance(source, TfSource):
            if not any(topic.type in TF_TYPES for topic in topics.values()):
                raise InputError(f"no transforms in {self}. {self._listing(topics)}")
        else:
            self._check_topic(source, topics)

    def expected(self, *sources):
        """How many poses the sources will give, as far as the bag says; None for paths and
        transforms, where that is found by reading.
        """
        topics = {topic.name: topic for topic in self.topics()}
        if any(source not in topics or topics[source].type not in POSE_TYPES for source in sources):
            return None
        return sum(topics[source].count for source in sources)

    def _check_topic(self, name, topics):
        if name not in topics:
            raise InputError(f"no topic {name} in {self}. {self._listing(topics)}")
        if topics[name].type not in (*POSE_TYPES, PATH_TYPE):
            frames = (
                "; name two of its frames with --parent-tf and --child-tf"
                if topics[name].type in TF_TYPES
                else ""
            )
            raise InputError(
                f"topic {name} of {self} is of type {topics[name].type or 'several types'}; accepted are "
                f"{', '.join([*POSE_TYPES, PATH_TYPE])}{frames}. {self._listing(topics)}"
            )

    def _listing(self, topics):
        return (
            f"The bag has {', '.join(map(str, topics.values()))}"
            if topics
            else f"There are no topics in {self}"
        )

    # ---- poses

    def poses(self, parent, child, max_gap_s=CalibratorConfig.max_gap):
        """Iterate over the poses of both streams, StampedPose by StampedPose; as :meth:`blocks`
        otherwise.
        """
        for block in self.blocks(parent, child, max_gap_s):
            yield from block.rows()

    def blocks(self, parent, child, max_gap_s=CalibratorConfig.max_gap):
        """Iterate over the poses of both streams in the order of the bag's time, many at once.

        A path's poses are those of its newest message, and before its first stamp those of older
        ones; they count as recorded when they first appeared. Transforms are composed at the stamps
        of the slowest moving one of the chain.

        Parameters
        ----------
        parent, child : str or TfSource
            A topic, or a pair of frames.
        max_gap_s : float
            Longest time that is interpolated between two transforms of a chain.

        Yields
        ------
        PoseBlock

        Raises
        ------
        InputError
            Where the bag turns out to be damaged, or the transforms do not lead from one frame to
            the other.
        """
        sources = {"parent": parent, "child": child}
        types = {topic.name: topic.type for topic in self.topics()}
        self._watches = {str(source): PoseWatch() for source in sources.values()}
        direct = {
            source: stream for stream, source in sources.items() if types.get(source) in POSE_TYPES
        }
        streams = [self._direct_blocks(direct)] if direct else []
        transforms = {
            stream: source for stream, source in sources.items() if isinstance(source, TfSource)
        }
        if transforms:
            streams += [[block] for block in self._transformed_poses(transforms, max_gap_s)]
        streams += [
            [self._path_poses(stream, source)]
            for stream, source in sources.items()
            if types.get(source) == PATH_TYPE
        ]
        if len(streams) == 1:
            yield from filter(len, streams[0])
        else:
            rows = (chain.from_iterable(map(PoseBlock.rows, blocks)) for blocks in streams)
            yield from map(PoseBlock.of_rows, _blocks(heapq.merge(*rows, key=_bag_time), _BLOCK))

    def _direct_blocks(self, streams):
        """Poses of topics that carry one in each message."""
        counts = dict.fromkeys(streams, 0)
        for messages in self._messages(streams):
            rows_of = {}
            for row, message in enumerate(messages):
                rows_of.setdefault(message[0], []).append(row)
            parts, rows_kept = [], []
            for kind, rows in rows_of.items():
                part, keep = self._unpacked_poses(
                    kind,
                    streams[kind.topic],
                    counts[kind.topic] + 1,
                    [messages[row] for row in rows],
                )
                counts[kind.topic] += len(rows)
                parts.append(part[keep])
                rows_kept.append(np.array(rows)[keep])
            yield PoseBlock.concatenate(parts)[np.argsort(np.concatenate(rows_kept))]

    def _unpacked_poses(self, kind, stream, first_number, messages):
        """PoseBlock of messages, and which of them to keep."""
        try:
            columns = unpack_poses([message[2] for message in messages], kind.type, kind.is_ros1)
        except MalformedMessage as error:
            raise _unreadable(kind, first_number + error.index, error) from error
        numbers = first_number + np.arange(len(messages))
        bag_ns = np.array([message[1] for message in messages], dtype=np.int64)
        keep = self._watches[kind.topic].believable(first_number, columns.stamps_ns, bag_ns)
        return self._watched(kind.topic, stream, columns, bag_ns, numbers, keep), keep

    def _watched(self, name, stream, columns, bag_ns, numbers=None, keep=slice(None)):
        """PoseBlock of PoseColumns, all of them; only those to keep are looked at more closely."""
        numbers = 1 + np.arange(len(bag_ns)) if numbers is None else numbers
        try:
            self._watches[name].add(numbers[keep], columns.stamps_ns[keep], columns.numbers[keep])
        except InputError as error:
            raise InputError(f"{name}, {error}") from None
        return PoseBlock.of_columns(stream, numbers, columns, bag_ns)

    def _path_poses(self, stream, topic):
        """Poses of a path that is published again and again as it grows, perhaps with all poses
        corrected.
        """
        stamps_ns, numbers = np.empty(0, dtype=np.int64), np.empty((0, 7))
        first_seen, world_frame = {}, ""
        for number, (kind, bag_ns, data) in enumerate(
            chain.from_iterable(self._messages([topic])), start=1
        ):
            try:
                world_frame, new_stamps_ns, new_numbers = unpack_path(data, kind.is_ros1)
            except MALFORMED as error:
                raise _unreadable(kind, number, error) from error
            if not len(new_stamps_ns):
                continue
            order = np.argsort(new_stamps_ns, kind="stable")
            older = stamps_ns < new_stamps_ns[order[0]]
            stamps_ns = np.concatenate([stamps_ns[older], new_stamps_ns[order]])
            numbers = np.concatenate([numbers[older], new_numbers[order]])
            for stamp_ns in new_stamps_ns.tolist():
                first_seen.setdefault(stamp_ns, bag_ns)
        if len(stamps_ns) > 1 and not stamps_ns.any():
            raise InputError(
                f"the poses of path {topic} have no stamps: all are zero; use the odometry that the path was made from"
            )
        columns = PoseColumns(
            stamps_ns, [world_frame] * len(stamps_ns), [None] * len(stamps_ns), numbers
        )
        bag_ns = np.array([first_seen[stamp_ns] for stamp_ns in stamps_ns.tolist()], dtype=np.int64)
        return self._watched(topic, stream, columns, bag_ns)[np.argsort(bag_ns, kind="stable")]

    def _transformed_poses(self, sources, max_gap_s):
        """A PoseBlock for each stream whose poses come from the transform tree."""
        tree = self.transforms()
        needed = {
            frame for source in sources.values() for side in tree.chain(source) for frame in side
        }
        for transform, is_static, bag_ns in self._transforms(needed):
            tree.keep(transform, is_static, bag_ns)
        found = []
        for stream, source in sources.items():
            trajectory, bag_ns, n_left_out = tree.trajectory(source, max_gap_s)
            if n_left_out:
                self._notes.append(
                    f"{source}: {n_left_out} of {n_left_out + len(trajectory)} poses were left out, because another transform of the chain "
                    f"was not known within {max_gap_s:g} s"
                )
            frames = [[frame] * len(trajectory) for frame in source]
            numbers = np.concatenate(
                [trajectory.poses[:, :3, 3], se3.to_quat_xyzw(trajectory.poses)], axis=1
            )
            columns = PoseColumns(trajectory.stamps_ns, *frames, numbers)
            found.append(
                self._watched(str(source), stream, columns, bag_ns)[
                    np.argsort(bag_ns, kind="stable")
                ]
            )
        return found

    def transforms(self):
        """The TransformTree of the bag, without numbers.

        Raises
        ------
        InputError
            Where the transforms form no tree or are damaged.
        """
        tree = TransformTree()
        for transform, is_static, _ in self._transforms():
            tree.note(transform, is_static)
        return tree

    def _transforms(self, frames=None):
        """Transforms, whether each is static, and its bag time; of some frames, or of all."""
        names = [topic.name for topic in self.topics() if topic.type in TF_TYPES]
        needles = None if frames is None else [frame.encode() for frame in frames]
        for number, (kind, bag_ns, data) in enumerate(
            chain.from_iterable(self._messages(names)), start=1
        ):
            data = bytes(data)
            if needles is not None and not any(needle in data for needle in needles):
                continue
            try:
                transforms = unpack_transforms(data, kind.is_ros1)
            except MALFORMED as error:
                raise _unreadable(kind, number, error) from error
            for transform in transforms:
                if frames is None or transform.sensor_frame in frames:
                    yield transform, kind.topic.endswith("tf_static"), bag_ns

    # ---- messages

    def _messages(self, topics):
        """Lists of (MessageKind, bag time in ns, bytes), all in the order of bag time."""
        for group in _overlapping(self._parts):
            streams = [self._part_messages(part, topics) for part in group]
            if len(streams) == 1:
                yield from streams[0]
            else:
                yield from _blocks(
                    heapq.merge(*map(chain.from_iterable, streams), key=lambda message: message[1]),
                    _BLOCK,
                )

    def _part_messages(self, part, topics):
        with _reading(part.path):
            for block in part.messages(topics):
                # Compressed message by message; plain CDR never begins like this.
                if any(message[2][:4] == _ZSTD_MAGIC for message in block):
                    block = [
                        (
                            kind,
                            bag_ns,
                            zstd.decompress(bytes(data)) if data[:4] == _ZSTD_MAGIC else data,
                        )
                        for kind, bag_ns, data in block
                    ]
                yield block

    # ---- files

    def _open(self, path, file):
        with _reading(path if path.is_file() else file):
            if file.suffix == ".mcap":
                part = _McapPart(file)
            elif file.suffix == ".db3":
                part = _RosbagsPart(rosbag2.Reader(file), is_ros1=False)
                log = file.with_name(file.name + "-wal")
                if log.exists() and log.stat().st_size:
                    part.losses.append(
                        "what the recorder had not yet moved out of its log beside it (-wal) is left out; open the file once with "
                        "sqlite3 to have it moved"
                    )
            else:
                part = _RosbagsPart(rosbag1.Reader(file), is_ros1=True)
        part.path = path if path.is_file() else file
        return part

    def _storage_files(self, path):
        """The files that hold a bag's messages, in order; those compressed as a whole are unpacked
        into a temporary folder.
        """
        if path.is_file():
            return [self._unpacked(path)]
        files = self._listed_files(path) if (path / "metadata.yaml").exists() else None
        if files is None:
            files = sorted(
                (file for file in path.iterdir() if _storage_suffix(file)), key=_natural_order
            )
        if not files:
            raise InputError(
                f"no bag in {path}: expected metadata.yaml or files that end in {', '.join(_STORAGE_SUFFIXES)}; check the path"
            )
        return [self._unpacked(file) for file in files]

    def _listed_files(self, path):
        """The files that metadata.yaml names; None where it cannot be used."""
        try:
            document = yaml.safe_load((path / "metadata.yaml").read_text(encoding="utf-8"))
            names = [
                PurePath(name).name
                for name in document["rosbag2_bagfile_information"]["relative_file_paths"]
            ]
        except (OSError, UnicodeDecodeError, yaml.YAMLError, LookupError, TypeError) as error:
            self._notes.append(
                f"{path / 'metadata.yaml'} is damaged ({type(error).__name__}); the files beside it were read instead"
            )
            return None
        missing = [name for name in names if not (path / name).is_file()]
        if missing:
            self._notes.append(
                f"{path}: {', '.join(missing)} of {len(names)} files in metadata.yaml is missing; its messages are left out"
            )
        return [
            path / name for name in names if name not in missing and _storage_suffix(path / name)
        ]

    def _unpacked(self, file):
        if file.suffix != ".zstd":
            return file
        self._temporary = self._temporary or tempfile.TemporaryDirectory(prefix="hand_eye_calib_")
        target = Path(
            self._temporary.name, f"{len(list(Path(self._temporary.name).iterdir()))}_{file.stem}"
        )
        with (
            _reading(file),
            file.open("rb") as raw,
            zstd.open(raw, "rb") as source,
            target.open("wb") as unpacked,
        ):
            shutil.copyfileobj(source, unpacked, 1 << 20)
        return target


class MessageKind(NamedTuple):
    """What the messages of one connection have in common."""

    topic: str
    type: str
    is_ros1: bool


class _McapPart:
    """An mcap file."""

    def __init__(self, file):
        self._mcap = McapFile(file, decompress)
        self.close, self.losses = self._mcap.close, self._mcap.losses
        self.start_ns, self.end_ns = self._mcap.start_ns, self._mcap.end_ns
        self.topics = {}
        for key, channel in self._mcap.channels.items():
            known, before = self.topics.get(channel.topic, (channel.type, 0))
            self.topics[channel.topic] = (
                known if known == channel.type else "",
                before + self._mcap.counts.get(key, 0),
            )

    def messages(self, topics):
        channels = [channel for channel in self._mcap.channels.values() if channel.topic in topics]
        for channel in channels:
            if channel.encoding != "cdr":
                raise ValueError(
                    f"messages of {channel.topic} are encoded as {channel.encoding!r}, expected 'cdr'"
                )
        kinds = {channel: MessageKind(channel.topic, channel.type, False) for channel in channels}
        waiting = []
        for block in self._mcap.messages(
            topics
        ):  # between images, a chunk may hold only a few poses
            waiting += [(kinds[channel], bag_ns, data) for channel, bag_ns, data in block]
            if len(waiting) >= _BLOCK:
                yield waiting
                waiting = []
        if waiting:
            yield waiting


class _RosbagsPart:
    """A file that the library rosbags reads: sqlite3 or rosbag1."""

    def __init__(self, reader, is_ros1):
        reader.open()
        self._reader, self._is_ros1 = reader, is_ros1
        self.close, self.losses = reader.close, []
        self.topics = {
            name: (info.msgtype or "", info.msgcount) for name, info in reader.topics.items()
        }
        has_messages = any(number for _, number in self.topics.values())
        self.start_ns, self.end_ns = (
            (reader.start_time, reader.end_time - 1) if has_messages else (None, None)
        )

    def messages(self, topics):
        connections = [
            connection for connection in self._reader.connections if connection.topic in topics
        ]
        for connection in connections:
            encoding = getattr(connection.ext, "serialization_format", "cdr")
            if encoding != "cdr":
                raise ValueError(
                    f"messages of {connection.topic} are encoded as {encoding!r}, expected 'cdr'"
                )
        if not connections:
            return
        kinds = {
            connection.id: MessageKind(connection.topic, connection.msgtype, self._is_ros1)
            for connection in connections
        }
        for block in _blocks(self._reader.messages(connections), _BLOCK):
            yield [(kinds[connection.id], bag_ns, data) for connection, bag_ns, data in block]


@contextmanager
def _reading(path):
    """Whatever a reader stumbles over becomes one line.

    A damaged file makes rosbags, sqlite, lz4 or zstd raise nearly anything, assertions and key
    errors included. Nothing but readers' code runs inside, so no defect of the rest is hidden.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = " ".join([f"{type(error).__name__}:", *str(error).split()]).rstrip(".:")
        repair = {".bag": "'rosbag reindex'", ".db3": "sqlite3's '.recover'"}.get(
            path.suffix, "'mcap recover'"
        )
        raise InputError(
            f"cannot read bag {path}: it is cut off, damaged or of an unsupported kind ({reason}); "
            f"repair it with {repair}, or record it again"
        ) from error


def read_bag_trajectory(path, topic=None, tf=None):
    """One trajectory of a bag.

    Parameters
    ----------
    path : str or path-like
    topic : str, optional
    tf : str, optional
        ``world:sensor``, instead of a topic.

    Returns
    -------
    Trajectory
        In the order of stamps; of those with equal stamps the first.
    notes : list of str
        What a person should know.

    Raises
    ------
    InputError
        Where the bag or a pose cannot be read.
    """
    source = TfSource.parse(tf) if tf else topic
    with PoseBag(path) as bag:
        bag.check(source)
        blocks = list(bag.blocks(source, None))
        notes = bag.warnings
    if not blocks:
        raise InputError(f"no poses on {source} of {path}")
    poses = PoseBlock.concatenate(blocks)
    stamps_ns, first = np.unique(poses.stamps_ns, return_index=True)
    if len(first) < len(poses):
        notes.append(
            f"{source}: {len(poses) - len(first)} of {len(poses)} poses had a stamp that was there already and were dropped"
        )
    if (np.diff(first) < 0).any():
        notes.append(f"{source}: stamps were not in the order of the bag and were sorted")
    poses = poses[first]
    return Trajectory.from_quat_xyzw(
        stamps_ns,
        poses.poses[:, :3],
        poses.poses[:, 3:],
        sensor_frame=poses.sensor_frames[0] or "",
        world_frame=poses.world_frames[0],
    ), notes


class _Look:
    """Stamps and frames of a topic's messages, as they pass by."""

    def __init__(self):
        self._frames = {}
        self._first_ns = self._last_ns = None

    def take(self, kind, first_number, messages):
        if kind.type in POSE_TYPES:
            try:
                columns = unpack_poses(messages, kind.type, kind.is_ros1)
            except MalformedMessage as error:
                raise _unreadable(kind, first_number + error.index, error) from error
            self._note(
                columns.stamps_ns, zip(columns.world_frames, columns.sensor_frames, strict=True)
            )
            return
        for number, data in enumerate(messages, start=first_number):
            try:
                if kind.type == PATH_TYPE:
                    world_frame, stamps_ns, _ = unpack_path(data, kind.is_ros1)
                    self._note(stamps_ns, [(world_frame, None)])
                else:
                    transforms = unpack_transforms(data, kind.is_ros1)
                    frames = [
                        (transform.world_frame, transform.sensor_frame) for transform in transforms
                    ]
                    self._note(
                        np.array([transform.stamp_ns for transform in transforms], dtype=np.int64),
                        frames,
                    )
            except MALFORMED as error:
                raise _unreadable(kind, number, error) from error

    def _note(self, stamps_ns, frames):
        self._frames |= dict.fromkeys(frames)
        if len(stamps_ns):
            first_ns, last_ns = int(stamps_ns.min()), int(stamps_ns.max())
            self._first_ns = first_ns if self._first_ns is None else min(first_ns, self._first_ns)
            self._last_ns = last_ns if self._last_ns is None else max(last_ns, self._last_ns)

    def describe(self, info, bag_duration_s):
        is_usable = info.type in POSE_TYPES or info.type == PATH_TYPE
        duration_s = (
            (self._last_ns - self._first_ns) * 1e-9
            if is_usable and self._first_ns is not None
            else bag_duration_s
        )
        is_sampled = info.count > 1 and duration_s > 0
        frames = [":".join(filter(None, pair)) for pair in sorted(self._frames, key=str)]
        return TopicDescription(
            *info,
            (info.count - 1) / duration_s if is_sampled else None,
            duration_s if is_sampled else None,
            frames,
            is_usable,
        )


def _unreadable(kind, number, error):
    return InputError(
        f"{kind.topic}, message {number}: not a readable {kind.type} ({error}); the bag is damaged, record it again"
    )


# A named tuple's own constructor takes three times as long, and there may be millions.
_make_stamped_pose = partial(tuple.__new__, StampedPose)


def _tuples(rows):
    """Rows of a float array as tuples: quicker than lists, and nothing for the garbage collector to
    look through.
    """
    return struct.iter_unpack(f"{rows.shape[1]}d", rows.tobytes())


def _bag_time(pose):
    return pose.bag_ns


def _blocks(items, size):
    items = iter(items)
    while block := list(islice(items, size)):
        yield block


def _overlapping(parts):
    """Parts in order, those that overlap in time together."""
    group, end_ns = [], None
    for part in parts:
        if part.start_ns is None:
            continue
        if group and part.start_ns > end_ns:
            yield group
            group = []
        end_ns = max(end_ns, part.end_ns) if group else part.end_ns
        group.append(part)
    if group:
        yield group


def _storage_suffix(file):
    """.mcap, .db3 or .bag, also of a compressed file; empty for any other."""
    suffix = PurePath(file.name.removesuffix(".zstd")).suffix
    return suffix if suffix in _STORAGE_SUFFIXES else ""


def _natural_order(file):
    """Part 10 after part 9."""
    return [int(text) if text.isdecimal() else text for text in re.split(r"(\d+)", file.name)]


def _check_path(path):
    """The mistakes that are easily made and easily explained."""
    if not path.exists():
        raise InputError(f"no bag at {path}; expected {_KINDS}")
    if path.is_file() and not _storage_suffix(path):
        raise InputError(f"{path} is not a bag; expected {_KINDS}")
    if path.is_file() and path.stat().st_size == 0:
        raise InputError(f"bag {path} is an empty file; record it again")


def write_bag(path, streams, storage="mcap"):
    """Write trajectories into a new bag, the poses of all topics interleaved in the order of their
    stamps.

    Parameters
    ----------
    path : str or path-like
        Directory to make, or for rosbag1 the ``.bag`` file. It must not exist.
    streams : mapping of str to (Trajectory, str)
        Topic to trajectory and message type, one of POSE_TYPES. Where the type has a place for the
        sensor's frame, the trajectory's is put there. Stamps are written to both header and bag.
    storage : str
        "mcap", "sqlite3" or "rosbag1".

    Raises
    ------
    InputError
        Where the path exists or cannot be written.
    ConfigError
        For an unknown storage or message type.
    """
    path = Path(path)
    if storage not in STORAGES:
        raise ConfigError(f"unknown bag storage {storage!r}; known are {', '.join(STORAGES)}")
    unknown = [
        message_type for _, message_type in streams.values() if message_type not in POSE_TYPES
    ]
    if unknown:
        raise ConfigError(
            f"cannot write messages of type {unknown[0]!r}; known are {', '.join(POSE_TYPES)}"
        )
    if (path.suffix == ".bag") != (storage == "rosbag1"):
        raise InputError(
            f"cannot write {path} as {storage}: a rosbag1 file, and nothing else, must be named .bag"
        )
    if path.exists():
        raise InputError(f"{path} exists already; remove it or choose another name")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _writer(path, storage) as writer:
            _write_streams(writer, streams, storage)
    except OSError as error:
        raise InputError(f"cannot write bag {path}: {error.strerror}") from None


def _writer(path, storage):
    if storage == "rosbag1":
        return rosbag1.Writer(path)
    return rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[storage.upper()])


def _write_streams(writer, streams, storage):
    is_rosbag1 = storage == "rosbag1"
    typestore = get_typestore(Stores.ROS1_NOETIC if is_rosbag1 else Stores.ROS2_JAZZY)
    serialize = typestore.serialize_ros1 if is_rosbag1 else typestore.serialize_cdr
    sequences = []
    for topic, (trajectory, message_type) in streams.items():
        connection = writer.add_connection(topic, message_type, typestore=typestore)
        sequences.append(
            _stamped_messages(typestore, trajectory, message_type, is_rosbag1, connection)
        )
    for stamp_ns, connection, message in heapq.merge(*sequences, key=lambda item: item[0]):
        writer.write(connection, stamp_ns, serialize(message, connection.msgtype))


def _stamped_messages(typestore, trajectory, message_type, is_rosbag1, connection):
    types = typestore.types
    zero, no_covariance = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0), np.zeros(36)
    twist = types["geometry_msgs/msg/TwistWithCovariance"](
        types["geometry_msgs/msg/Twist"](zero, zero), no_covariance
    )
    positions, quats_xyzw = (
        trajectory.poses[:, :3, 3].tolist(),
        se3.to_quat_xyzw(trajectory.poses).tolist(),
    )
    for number, stamp_ns in enumerate(trajectory.stamps_ns.tolist()):
        header = types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, _NS_PER_S)),
            frame_id=trajectory.world_frame,
            **({"seq": number} if is_rosbag1 else {}),
        )
        pose = types["geometry_msgs/msg/Pose"](
            types["geometry_msgs/msg/Point"](*positions[number]),
            types["geometry_msgs/msg/Quaternion"](*quats_xyzw[number]),
        )
        with_covariance = types["geometry_msgs/msg/PoseWithCovariance"](pose, no_covariance)
        if message_type == "nav_msgs/msg/Odometry":
            message = types[message_type](header, trajectory.sensor_frame, with_covariance, twist)
        elif message_type == "geometry_msgs/msg/PoseWithCovarianceStamped":
            message = types[message_type](header, with_covariance)
        elif message_type == "geometry_msgs/msg/TransformStamped":
            translation = types["geometry_msgs/msg/Vector3"](*positions[number])
            transform = types["geometry_msgs/msg/Transform"](translation, pose.orientation)
            message = types[message_type](header, trajectory.sensor_frame, transform)
        else:
            message = types[message_type](header, pose)
        yield stamp_ns, connection, message
