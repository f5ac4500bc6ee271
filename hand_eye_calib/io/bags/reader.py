"""Reading the poses of two streams from bags."""

import heapq
from collections.abc import Collection, Container, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, compress
from operator import itemgetter
from pathlib import Path
from typing import Self

import numpy as np

from hand_eye_calib.arrays import BoolArray, IntArray
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.frames import FrameTree, checked_pose
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.bags.messages import (
    MALFORMED,
    MESSAGE_TYPES,
    PATH_TYPE,
    POSE_TYPES,
    TF_TYPES,
    MalformedMessage,
    unpack_path,
    unpack_transforms,
)
from hand_eye_calib.io.bags.poses import PoseBlock, PoseColumns, PoseFields, StampedPose
from hand_eye_calib.io.bags.recovery import Message, MessageKind
from hand_eye_calib.io.bags.storage import (
    BLOCK_SIZE,
    BagFiles,
    MessageBlock,
    Storage,
    message_blocks,
)
from hand_eye_calib.io.bags.topics import (
    MessageReader,
    Source,
    TopicDescription,
    TopicInfo,
    check_source,
    measured_as,
    select_sources,
    stamps_and_frames,
    unreadable,
)
from hand_eye_calib.io.plausibility import PoseWatch
from hand_eye_calib.io.transforms import TfSource, TransformTree

# Different frames of one topic that are listed.
_MOST_FRAMES = 1_000


class PoseBag:
    """One bag, or several of one recording, opened for reading; a context manager.

    Parameters
    ----------
    *paths : str or path-like
        Each a rosbag2 directory, a single ``.mcap`` or ``.db3`` file of one, or a rosbag1 ``.bag``
        file. They are read in the order of their times; those that were recorded at the same time
        are merged.

    Raises
    ------
    InputError
        If there is no bag or it cannot be read: one line that names the path and says what to do.
    """

    def __init__(self, *paths: str | Path) -> None:
        self.paths = [Path(path) for path in paths]
        self._files = BagFiles()
        self._watches: dict[str, PoseWatch] = {}
        self._readers: dict[str, MessageReader] = {}
        self._gaps: list[str] = []
        try:
            for path in self.paths:
                self._files.open(path)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._files.close()

    def __str__(self) -> str:
        return ", ".join(map(str, self.paths))

    @property
    def warnings(self) -> list[str]:
        """What could not be read, and poses that cannot be right; complete after reading."""
        losses = [
            f"{storage.path}: {loss}" for storage in self._files.storages for loss in storage.losses
        ]
        watched = [text for name, watch in self._watches.items() for text in watch.warnings(name)]
        without = [
            f"{name}: {reader.n_left_out} messages without a fix, or without what they were read "
            "for, were left out"
            for name, reader in self._readers.items()
            if reader.n_left_out
        ]
        return [*self._files.notes, *self._gaps, *losses, *watched, *without]

    @property
    def n_left_out(self) -> int:
        """Messages left out because their stamps cannot be right, or without a fix; complete after
        reading.
        """
        of_stamps = sum(watch.n_stamps for watch in self._watches.values())
        return of_stamps + sum(reader.n_left_out for reader in self._readers.values())

    @property
    def start_ns(self) -> int | None:
        """Bag time of the first message, None if there is none."""
        starts_ns = [storage.start_ns for storage in self._files.storages]
        return min((each for each in starts_ns if each is not None), default=None)

    @property
    def end_ns(self) -> int | None:
        """Bag time of the last message, None if there is none."""
        ends_ns = [storage.end_ns for storage in self._files.storages]
        return max((each for each in ends_ns if each is not None), default=None)

    @property
    def duration_s(self) -> float:
        """Time from the first message to the last; 0 if there is none."""
        return ((self.end_ns or 0) - (self.start_ns or 0)) * 1e-9

    def files(self) -> list[Path]:
        """Paths of all files that are read."""
        return [storage.path for storage in self._files.storages]

    # ---- topics

    def topics(self) -> list[TopicInfo]:
        """All topics, in the order of their names."""
        return list(self._topics().values())

    def _topics(self) -> dict[str, TopicInfo]:
        found: dict[str, tuple[str, int]] = {}
        for storage in self._files.storages:
            for name, (message_type, count) in storage.topics.items():
                known, before = found.get(name, (message_type, 0))
                found[name] = (message_type if message_type == known else "", before + count)
        return {name: TopicInfo(name, *found[name]) for name in sorted(found)}

    def describe(self) -> list[TopicDescription]:
        """All topics with rates and frames; reads all poses and transforms.

        Raises
        ------
        InputError
            If a message cannot be read.
        """
        infos = self.topics()
        frames: dict[str, dict[tuple[str, str | None], None]] = {each.name: {} for each in infos}
        stamps_ns: dict[str, tuple[int, int]] = {}
        counts = dict.fromkeys(frames, 0)
        known_types = (*POSE_TYPES, PATH_TYPE, *TF_TYPES)
        blocks = self._blocks([info.name for info in infos if info.type in known_types])
        for kind, _, messages in chain.from_iterable(map(_by_kind, blocks)):
            name = kind.topic
            found_ns, pairs = stamps_and_frames(kind, messages, counts[name] + 1)
            counts[name] += len(messages)
            if len(frames[name]) < _MOST_FRAMES:
                frames[name] |= pairs
            if len(found_ns):
                first_ns, last_ns = int(found_ns.min()), int(found_ns.max())
                before = stamps_ns.get(name, (first_ns, last_ns))
                stamps_ns[name] = (min(first_ns, before[0]), max(last_ns, before[1]))
        return [
            info.described(frames[info.name], stamps_ns.get(info.name), self.duration_s)
            for info in infos
        ]

    def select_topics(
        self, parent: Source | None = None, child: Source | None = None
    ) -> tuple[Source, Source]:
        """Choose the sources of the parent's and the child's poses.

        What is not named is chosen if there is only one way to do it: with neither named, the bag
        has exactly two topics of poses. The parent is the one whose name has the word parent, base
        or lidar, or the first in alphabetical order. Topics of paths count if there are not enough
        others.

        Parameters
        ----------
        parent, child : str, TfSource or None
            A topic, or a pair of frames.

        Raises
        ------
        InputError
            If a named topic is not in the bag or holds no poses, if both are the same, or if there
            is a choice to make. The message lists the topics that are there.
        """
        return select_sources(parent, child, self._topics(), str(self))

    def check(self, source: Source) -> None:
        """Refuse a topic that is not in the bag or has no poses, and frames without transforms.

        Raises
        ------
        InputError
            The message lists the topics that are there.
        """
        check_source(source, self._topics(), str(self))

    def expected(self, *sources: Source | None) -> int | None:
        """Number of poses that the sources will give, as far as the bag says; None for paths and
        transforms.
        """
        topics = self._topics()
        count = 0
        for source in sources:
            if not isinstance(source, str) or source not in topics:
                return None
            if topics[source].type not in MESSAGE_TYPES:
                return None
            count += topics[source].count
        return count

    def measured(self, source: Source, wanted: str = "auto") -> str:
        """What a source measures, one of config.MEASURES: what is wanted of it, or what messages of
        its type are for.

        Raises
        ------
        ConfigError
            If its messages do not have what is wanted.
        """
        topics = self._topics()
        message_type = topics[source].type if isinstance(source, str) and source in topics else ""
        return measured_as(message_type, wanted, source)

    # ---- poses

    def poses(
        self, parent: Source, child: Source | None, max_gap_s: float = CalibratorConfig.max_gap
    ) -> Iterator[StampedPose]:
        """Iterate over the poses of both streams one by one; see :meth:`blocks`."""
        for block in self.blocks(parent, child, max_gap_s):
            yield from block.rows()

    def blocks(
        self,
        parent: Source,
        child: Source | None,
        max_gap_s: float = CalibratorConfig.max_gap,
        measures: Mapping[str, str] | None = None,
    ) -> Iterator[PoseBlock]:
        """Iterate over the poses of both streams in the order of the bag's time, many at once.

        A path's poses are those of its newest message, and before its first stamp those of older
        messages; they count as recorded when they first appeared. Transforms are composed at the
        stamps of the moving transform with the lowest rate in the chain.

        Parameters
        ----------
        parent, child : str or TfSource
            A topic, or a pair of frames.
        max_gap_s : float
            Longest time that is interpolated between two transforms of a chain.
        measures : mapping, optional
            "parent" and "child" to what their topics are read as, if that is not what their types
            are for; see :meth:`measured`.

        Yields
        ------
        PoseBlock

        Raises
        ------
        InputError
            If the bag is damaged, or the transforms do not lead from one frame to the other.
        """
        sources = {"parent": parent, "child": child}
        types = {topic.name: topic.type for topic in self.topics()}
        self._watches = {str(source): PoseWatch() for source in sources.values()}
        self._readers = {}
        direct, paths, transforms = {}, {}, {}
        for stream, source in sources.items():
            if isinstance(source, TfSource):
                transforms[stream] = source
            elif source is not None and types.get(source) in MESSAGE_TYPES:
                direct[source] = stream
                measured = self.measured(source, (measures or {}).get(stream, "auto"))
                self._readers[source] = MessageReader(types[source], measured)
            elif source is not None and types.get(source) == PATH_TYPE:
                paths[stream] = source
        blocks = self._direct_blocks(direct) if direct else iter(())
        if paths or transforms:
            of_others = self._transformed_poses(transforms, max_gap_s) if transforms else []
            of_others += [self._path_poses(*each) for each in paths.items()]
            whole = PoseBlock.concatenate([*blocks, *of_others])
            whole = whole[np.argsort(whole.bag_ns, kind="stable")]
            blocks = (whole[k : k + BLOCK_SIZE] for k in range(0, len(whole), BLOCK_SIZE))
        yield from filter(len, blocks)

    def _direct_blocks(self, streams: dict[str, str]) -> Iterator[PoseBlock]:
        """Poses of topics that carry one in each message."""
        counts = dict.fromkeys(streams, 0)
        for block in self._blocks(streams):
            parts, kept_rows = [], []
            for kind, rows, messages in _by_kind(block):
                numbers = counts[kind.topic] + 1 + np.arange(len(rows))
                counts[kind.topic] += len(rows)
                part, keep = self._unpacked_poses(
                    kind, streams[kind.topic], numbers, messages, block.bag_ns[rows]
                )
                parts.append(part[keep])
                kept_rows.append(rows[keep])
            yield PoseBlock.concatenate(parts)[np.argsort(np.concatenate(kept_rows))]

    def _unpacked_poses(
        self,
        kind: MessageKind,
        stream: str,
        message_numbers: IntArray,
        messages: Sequence[bytes],
        bag_ns: IntArray,
    ) -> tuple[PoseBlock, BoolArray]:
        """PoseBlock of messages, and which of them to keep."""
        reader, first_number = self._readers[kind.topic], int(message_numbers[0])
        try:
            columns = reader.columns(messages, kind.encoding == "ros1")
        except MalformedMessage as error:
            raise unreadable(kind, first_number + error.index, error) from error
        except InputError as error:
            number = first_number + getattr(error, "index", 0)
            raise InputError(f"{kind.topic}, message {number}: {error}") from None
        keep = self._watches[kind.topic].believable(first_number, columns.stamps_ns, bag_ns)
        keep &= reader.is_measured(columns.poses)
        self._watch(kind.topic, message_numbers, columns, keep)
        return PoseBlock.of_columns(stream, message_numbers, columns, bag_ns), keep

    def _watch(
        self, name: str, message_numbers: IntArray, columns: PoseColumns, keep: BoolArray
    ) -> None:
        """Look at the poses that are kept."""
        try:
            self._watches[name].add(
                message_numbers[keep], columns.stamps_ns[keep], columns.poses[keep]
            )
        except InputError as error:
            raise InputError(f"{name}, {error}") from None

    def _watched_block(
        self, name: str, stream: str, columns: PoseColumns, bag_ns: IntArray
    ) -> PoseBlock:
        """PoseBlock of all poses of a stream, in the order of bag time."""
        message_numbers = 1 + np.arange(len(bag_ns))
        self._watch(name, message_numbers, columns, np.ones(len(bag_ns), dtype=bool))
        block = PoseBlock.of_columns(stream, message_numbers, columns, bag_ns)
        return block[np.argsort(bag_ns, kind="stable")]

    def _path_poses(self, stream: str, topic: str) -> PoseBlock:
        """Poses of a path that is published again and again as it grows, perhaps with all poses
        corrected.
        """
        stamps_ns, bag_ns = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
        poses, world_frame = np.empty((0, 7)), ""
        messages = self._messages([topic])
        for number, (kind, message_ns, data) in enumerate(messages, start=1):
            try:
                world_frame, new_stamps_ns, new_poses = unpack_path(data, kind.encoding == "ros1")
            except MALFORMED as error:
                raise unreadable(kind, number, error) from error
            if not len(new_stamps_ns):
                continue
            order = np.argsort(new_stamps_ns, kind="stable")
            new_stamps_ns = new_stamps_ns[order]
            new_bag_ns = _first_seen(new_stamps_ns, message_ns, stamps_ns, bag_ns)
            older = stamps_ns < new_stamps_ns[0]
            stamps_ns = np.concatenate([stamps_ns[older], new_stamps_ns])
            bag_ns = np.concatenate([bag_ns[older], new_bag_ns])
            poses = np.concatenate([poses[older], new_poses[order]])
        if len(stamps_ns) > 1 and not stamps_ns.any():
            raise InputError(
                f"the poses of path {topic} have no stamps: all are zero; use the odometry that "
                "the path was made from"
            )
        count = len(stamps_ns)
        columns = PoseColumns(stamps_ns, [world_frame] * count, [None] * count, poses)
        return self._watched_block(topic, stream, columns, bag_ns)

    def _transformed_poses(self, sources: dict[str, TfSource], max_gap_s: float) -> list[PoseBlock]:
        """A PoseBlock for each stream whose poses come from the transform tree."""
        tree = self.transforms()
        chains = [side for source in sources.values() for side in tree.chain(source)]
        for transform, is_static, bag_ns in self._transforms(set(chain.from_iterable(chains))):
            tree.keep(transform, is_static, bag_ns)
        found = []
        for stream, source in sources.items():
            trajectory, log_ns, n_left_out = tree.trajectory(source, max_gap_s)
            if n_left_out:
                self._gaps.append(
                    f"{source}: {n_left_out} of {n_left_out + len(trajectory)} poses were left "
                    "out, because another transform of the chain was not known within "
                    f"{max_gap_s:g} s"
                )
            quats_xyzw = se3.to_quat_xyzw(trajectory.poses)
            columns = PoseColumns(
                trajectory.stamps_ns,
                [source.world_frame] * len(trajectory),
                [source.sensor_frame] * len(trajectory),
                np.concatenate([trajectory.poses[:, :3, 3], quats_xyzw], axis=1),
            )
            found.append(self._watched_block(str(source), stream, columns, log_ns))
        return found

    def transforms(self) -> TransformTree:
        """The TransformTree of the bag, without poses.

        Raises
        ------
        InputError
            If the transforms form no tree or are damaged.
        """
        return self._tree_and_static()[0]

    def static_frames(self) -> FrameTree:
        """The frames of the bag and their static transforms; of repeated ones the last.

        Raises
        ------
        InputError
            If the transforms form no tree or are damaged.
        """
        tree, static = self._tree_and_static()
        for frame, last in static.items():
            if tree.edges[frame].is_static:
                tree.edges[frame].pose = checked_pose(last.position, last.quat_xyzw)
        return tree

    def _tree_and_static(self) -> tuple[TransformTree, dict[str, PoseFields]]:
        """All edges, and the last static transform of each frame."""
        tree, static = TransformTree(), dict[str, PoseFields]()
        for transform, is_static, _ in self._transforms():
            tree.note(transform, is_static)
            if is_static:
                static[transform.sensor_frame or ""] = transform
        return tree, static

    def _transforms(
        self, frames: Container[str] | None = None
    ) -> Iterator[tuple[PoseFields, bool, int]]:
        """Transforms, whether each is static, and its bag time; of some frames, or of all."""
        names = [topic.name for topic in self.topics() if topic.type in TF_TYPES]
        messages = self._messages(names)
        for number, (kind, bag_ns, data) in enumerate(messages, start=1):
            try:
                for transform in unpack_transforms(data, kind.encoding == "ros1"):
                    if frames is None or transform.sensor_frame in frames:
                        yield transform, kind.topic.endswith("tf_static"), bag_ns
            except MALFORMED as error:
                raise unreadable(kind, number, error) from error

    # ---- messages

    def _messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Messages of some topics in the order of bag time."""
        return chain.from_iterable(map(_rows, self._blocks(topics)))

    def _blocks(self, topics: Collection[str]) -> Iterator[MessageBlock]:
        """Messages of some topics in the order of bag time, many at once."""
        for group in _overlapping(self._files.storages):
            if len(group) == 1:
                yield from group[0].blocks(topics)
            else:
                streams = (map(_rows, storage.blocks(topics)) for storage in group)
                merged = heapq.merge(*map(chain.from_iterable, streams), key=itemgetter(1))
                yield from message_blocks(merged, self._gaps.append)


def read_bag_trajectory(
    path: str | Path, topic: str | None = None, tf: str | None = None, measures: str = "auto"
) -> tuple[Trajectory, list[str]]:
    """Read one trajectory of a bag.

    Parameters
    ----------
    path : str or path-like
    topic : str, optional
    tf : str, optional
        ``world:sensor``, instead of a topic.
    measures : str
        What to read of the poses, see :meth:`PoseBag.measured`.

    Returns
    -------
    Trajectory
        In the order of stamps; of those with equal stamps the first.
    notes : list of str
        What a person should know.

    Raises
    ------
    InputError
        If the bag or a pose cannot be read.
    """
    with PoseBag(path) as bag:
        trajectory, notes = trajectory_of(bag, TfSource.parse(tf) if tf else topic or "", measures)
        return trajectory, [*bag.warnings, *notes]


def trajectory_of(
    bag: PoseBag, source: Source, measures: str = "auto"
) -> tuple[Trajectory, list[str]]:
    """The trajectory of one source of an open bag, as :func:`read_bag_trajectory` gives it, and
    what a person should know of it.
    """
    bag.check(source)
    kind = bag.measured(source, measures)
    notes: list[str] = []
    blocks = list(bag.blocks(source, None, measures={"parent": measures}))
    if not blocks:
        raise InputError(f"no poses on {source} of {bag}")
    poses = PoseBlock.concatenate(blocks)
    stamps_ns, first = np.unique(poses.stamps_ns, return_index=True)
    if len(first) < len(poses):
        notes.append(
            f"{source}: {len(poses) - len(first)} of {len(poses)} poses had a stamp that was there "
            "already and were dropped"
        )
    if (np.diff(first) < 0).any():
        notes.append(f"{source}: stamps were not in the order of the bag and were sorted")
    poses = poses[first]
    trajectory = Trajectory.from_quat_xyzw(
        stamps_ns,
        poses.poses[:, :3],
        poses.poses[:, 3:],
        sensor_frame=poses.sensor_frames[0] or "",
        world_frame=poses.world_frames[0],
    )
    return replace(trajectory, measures=kind) if kind != "poses" else trajectory, notes


def _first_seen(
    new_stamps_ns: IntArray, message_ns: int, stamps_ns: IntArray, bag_ns: IntArray
) -> IntArray:
    """Bag time at which each stamp appeared first; ``stamps_ns`` are sorted."""
    first_ns = np.full(len(new_stamps_ns), message_ns, dtype=np.int64)
    if len(stamps_ns):
        index = np.minimum(np.searchsorted(stamps_ns, new_stamps_ns), len(stamps_ns) - 1)
        is_known = stamps_ns[index] == new_stamps_ns
        first_ns[is_known] = bag_ns[index[is_known]]
    return first_ns


def _rows(block: MessageBlock) -> Iterator[Message]:
    """Messages of a block one by one."""
    return zip(block.kinds, block.bag_ns.tolist(), block.contents, strict=True)


def _by_kind(block: MessageBlock) -> Iterator[tuple[MessageKind, IntArray, list[bytes]]]:
    """Each kind of messages in a block, their rows and their bytes."""
    for kind in {id(each): each for each in block.kinds}.values():
        is_of_kind = [each is kind for each in block.kinds]
        yield kind, np.flatnonzero(is_of_kind), list(compress(block.contents, is_of_kind))


def _overlapping(storages: list[Storage]) -> Iterator[list[Storage]]:
    """Storages in order, those that overlap in time together."""
    group: list[Storage] = []
    last_ns = 0
    for storage in storages:
        if storage.start_ns is None or storage.end_ns is None:
            continue
        if group and storage.start_ns > last_ns:
            yield group
            group = []
        last_ns = max(last_ns, storage.end_ns) if group else storage.end_ns
        group.append(storage)
    if group:
        yield group
