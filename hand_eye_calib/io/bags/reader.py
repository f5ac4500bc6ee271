"""Reading the poses of two streams from bags."""

import heapq
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack
from itertools import chain, pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from hand_eye_calib.arrays import IntArray
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.frames import FrameTree, checked_pose
from hand_eye_calib.io.bags import scans
from hand_eye_calib.io.bags.fields import FIELDS, FieldReader, decoder, split_fields
from hand_eye_calib.io.bags.mcap_files import Message, MessageKind
from hand_eye_calib.io.bags.messages import (
    MALFORMED,
    MESSAGE_TYPES,
    PATH_TYPE,
    POINTS_TYPE,
    TF_TYPES,
    MalformedMessage,
    MessageReader,
    frames_in,
    measured_as,
    unpack_path,
    unpack_transforms,
)
from hand_eye_calib.io.bags.poses import PoseBlock, PoseColumns, are_believable
from hand_eye_calib.io.bags.storage import BLOCK_SIZE, message_blocks, open_bags
from hand_eye_calib.io.bags.topics import Source, Topics, joined_parts
from hand_eye_calib.io.transforms import PoseFields, TfSource, TfStream

T = TypeVar("T")


class PoseBag:
    """One bag, or several of one recording, opened for reading; a context manager.

    Parameters
    ----------
    *paths : str or path-like
        Each a rosbag2 directory, a single ``.mcap`` or ``.db3`` file of one, or a rosbag1 ``.bag``
        file. They are read in the order of their times; those that were recorded at the same time
        are merged.

    Attributes
    ----------
    topics : Topics
        By their names, in the order of these; chooses those that are meant.
    start_ns, end_ns : int or None
        Bag time of the first and last message; None if there is none.

    Raises
    ------
    InputError
        If there is no bag or it cannot be read: one line that names the path and says what to do.
    """

    def __init__(self, *paths: str | Path) -> None:
        self.paths = [Path(path) for path in paths]
        # Passes on messages that take long, and may show how far they are.
        self.shown: Callable[[Iterable[Message], int, str], Iterable[Message]] = (
            lambda messages, count, doing: messages
        )
        self._n_wrong_stamps = Counter[str]()
        self._readers: dict[str, MessageReader] = {}
        self._notes: list[str] = []
        with ExitStack() as opened:
            self._storages = open_bags(self.paths, opened)
            self._opened = opened.pop_all()
        found = chain(*(storage.topics for storage in self._storages))
        self.topics = Topics.of_connections(found, str(self), self._first_transforms)
        spans = [(each.start_ns, each.end_ns) for each in self._storages]
        known = [(first, last) for first, last in spans if first is not None and last is not None]
        self.start_ns = min((first for first, _ in known), default=None)
        self.end_ns = max((last for _, last in known), default=None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._opened.close()

    def __str__(self) -> str:
        return ", ".join(map(str, self.paths))

    @property
    def warnings(self) -> list[str]:
        """What could not be read, and poses that cannot be right; complete after reading."""
        losses = [f"{each.path}: {loss}" for each in self._storages for loss in each.losses]
        wrong = [
            f"{name}: {count} stamps jump away and back against the bag's own time; their poses "
            "were left out, the bag may be damaged"
            for name, count in (+self._n_wrong_stamps).items()
        ]
        without = [
            f"{name}: {reader.n_left_out} messages without a fix, or without what they were read "
            "for, were left out"
            for name, reader in self._readers.items()
            if reader.n_left_out
        ]
        return [*self._notes, *losses, *wrong, *without]

    @property
    def n_left_out(self) -> int:
        """Messages left out because their stamps cannot be right, or without a fix; complete after
        reading.
        """
        without = sum(reader.n_left_out for reader in self._readers.values())
        return self._n_wrong_stamps.total() + without

    @property
    def duration_s(self) -> float:
        """Time from the first message to the last; 0 if there is none."""
        return ((self.end_ns or 0) - (self.start_ns or 0)) * 1e-9

    def files(self) -> list[Path]:
        """Paths of all files that are read."""
        return [storage.path for storage in self._storages]

    # ---- topics

    def _first_transforms(self) -> list[str]:
        """Pairs of frames in the first messages of transforms."""
        return sorted({pair for name in self._of_transforms() for pair in self.frames_on(name)})

    def _of_transforms(self) -> list[str]:
        return [topic.name for topic in self.topics.values() if topic.type in TF_TYPES]

    def frames_on(self, topic: str) -> list[str]:
        """Pairs of frames in the first messages of a topic: ``world:sensor`` of poses, as far as
        they say, ``parent:child`` of transforms.

        Raises
        ------
        InputError
            If a message cannot be read.
        """
        if self.topics.type_of(topic) not in {*MESSAGE_TYPES, PATH_TYPE, POINTS_TYPE, *TF_TYPES}:
            return []
        block = next(self._blocks([topic]), [])
        found = _decoded(block, lambda kind, data: frames_in(data, kind.type, _is_ros1(kind)))
        return sorted(set[str]().union(*(frames for _, _, frames in found)))

    def expected(self, *sources: Source | None) -> int | None:
        """Number of poses that the sources will give, as far as the bag says; None for paths and
        transforms.
        """
        if not all(self.topics.type_of(source) in MESSAGE_TYPES for source in sources):
            return None
        return sum(self.topics[str(source)].count for source in sources)

    def measured(self, source: Source, wanted: str = "auto") -> str:
        """What a source measures, one of config.MEASURES: what is wanted of it, or what messages of
        its type are for.

        Raises
        ------
        ConfigError
            If its messages do not have what is wanted.
        """
        return measured_as(self.topics.type_of(source), wanted, source)

    # ---- poses

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
            "parent" and "child" to what their topics are read as, see :meth:`measured`.

        Raises
        ------
        InputError
            If the bag is damaged, or the transforms do not lead from one frame to the other.
        """
        sources = {"parent": parent} | ({"child": child} if child else {})
        self._n_wrong_stamps = Counter()
        self._readers = {}
        direct: dict[str, str] = {}
        others, transforms = dict[str, str](), dict[str, TfSource]()
        for stream, source in sources.items():
            if isinstance(source, TfSource):
                transforms[stream] = source
            elif (type_ := self.topics.type_of(source)) in MESSAGE_TYPES:
                direct[source] = stream
                measured = self.measured(source, (measures or {}).get(stream, "auto"))
                self._readers[source] = MessageReader(type_, measured)
            else:
                others[stream] = source
        blocks = self._direct_blocks(direct) if direct else iter(())
        if others or transforms:
            whole = [*blocks, *(self._other_poses(*each) for each in others.items())]
            whole += self._transformed_poses(transforms, max_gap_s) if transforms else []
            poses = _in_bag_order(PoseBlock.concatenate(whole))
            blocks = (poses[k : k + BLOCK_SIZE] for k in range(0, len(poses), BLOCK_SIZE))
        yield from filter(len, blocks)

    def _direct_blocks(self, streams: dict[str, str]) -> Iterator[PoseBlock]:
        """Poses of topics that carry one in each message."""
        counts = dict.fromkeys(streams, 0)
        for block in self._blocks(streams):
            found = []
            for kind in {id(each): each for each, _, _ in block}.values():
                name, reader = kind.topic, self._readers[kind.topic]
                messages = [data for each, _, data in block if each is kind]
                bag_ns = np.array([each_ns for each, each_ns, _ in block if each is kind])
                numbers = counts[name] + 1 + np.arange(len(messages))
                counts[name] += len(messages)
                try:
                    columns, keep = reader.columns(messages, _is_ros1(kind))
                except MalformedMessage as error:
                    raise _unreadable(kind, numbers[error.index], error) from error
                except InputError as error:
                    raise InputError(f"{name}: {error}") from None
                is_right = are_believable(columns.stamps_ns, bag_ns)
                self._n_wrong_stamps[name] += int((~is_right).sum())
                poses = PoseBlock.of_columns(streams[name], numbers, columns, bag_ns)
                found.append(poses[keep & is_right])
            yield _in_bag_order(PoseBlock.concatenate(found))

    def _whole(self, stream: str, columns: PoseColumns, bag_ns: Any) -> PoseBlock:
        """All poses of a source that is no topic of poses, in the order of bag time."""
        numbers, bag_ns = 1 + np.arange(len(bag_ns)), np.array(bag_ns, dtype=np.int64)
        return _in_bag_order(PoseBlock.of_columns(stream, numbers, columns, bag_ns))

    def _other_poses(self, stream: str, source: str) -> PoseBlock:
        """Poses of a path, of scans, of two topics that are joined, or of fields of messages."""
        type_, (topic, fields) = self.topics.type_of(source), split_fields(source)
        if type_ == PATH_TYPE:
            return self._path_poses(stream, source)
        if type_ == POINTS_TYPE:
            return self._scan_poses(stream, source)
        if topic not in self.topics:
            return self._joined_poses(stream, source, *joined_parts(topic))
        read = FieldReader(topic, fields or FIELDS[type_])
        definitions = (each.definition(topic) for each in self._storages)
        definition = next(filter(None, definitions), None)

        def cells(kind: MessageKind, data: bytes) -> list[str]:
            return read.cells(decoder(kind.type, kind.encoding, definition)(data))

        # The library's errors are of many kinds.
        found = list(_decoded(self._messages([topic]), cells, Exception))
        stamps_ns, poses, notes = read.poses(row for _, _, row in found)
        self._notes += notes
        bag_ns = [message_ns for _, message_ns, _ in found]
        return self._whole(stream, PoseColumns.of_frames(stamps_ns, poses), bag_ns)

    def _joined_poses(self, stream: str, source: str, fix: str, imu: str) -> PoseBlock:
        """Positions of one topic with the orientations of another, interpolated."""
        found = []
        for topic, measured in ((fix, "positions"), (imu, "rotations")):
            self._readers[topic] = MessageReader(self.topics[topic].type, measured)
            found.append(PoseBlock.concatenate(self._direct_blocks({topic: stream})))
        positions, orientations = found
        if not len(positions) or not len(orientations):
            raise InputError(f"{source}: no positions with a fix, or no orientations")
        turning = orientations.trajectory()
        inside = (positions.stamps_ns >= turning.stamps_ns[0]) & (
            positions.stamps_ns <= turning.stamps_ns[-1]
        )
        positions, quats = positions[inside], positions.poses[inside, 3:]
        if len(turning) > 1 and len(positions):
            quats = se3.to_quat_xyzw(turning.at(positions.stamps_ns))
        poses = np.c_[positions.poses[:, :3], quats]
        frame = orientations.sensor_frames[0]
        columns = PoseColumns.of_frames(positions.stamps_ns, poses, "", frame)
        return self._whole(stream, columns, positions.bag_ns)

    def _path_poses(self, stream: str, topic: str) -> PoseBlock:
        """Poses of a path that is published again and again as it grows, perhaps with all poses
        corrected.
        """
        stamps_ns, bag_ns = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
        poses, world_frame = np.empty((0, 7)), ""
        messages = self._messages([topic])
        unpacked = _decoded(messages, lambda kind, data: unpack_path(data, _is_ros1(kind)))
        for _, message_ns, (frame, new_stamps_ns, new_poses) in unpacked:
            world_frame = frame
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
        columns = PoseColumns.of_frames(stamps_ns, poses, world_frame)
        return self._whole(stream, columns, bag_ns)

    def _scan_poses(self, stream: str, topic: str) -> PoseBlock:
        """Odometry from the points of a lidar, which is kept beside the bag for the next time."""
        place = scans.kept_file(self.paths[0], topic)
        found = scans.read_kept(place, self.files())
        if found is None:
            count, doing = self.topics[topic].count, f"odometry of {topic}"
            messages = self.shown(self._messages([topic]), count, doing)
            unpacked = _decoded(
                messages, lambda kind, data: scans.unpack_scan(data, _is_ros1(kind))
            )
            found = scans.odometry(topic, ((scan, bag_ns) for _, bag_ns, scan in unpacked))
            scans.keep(place, self.files(), found)
        about = f"{topic}: odometry from {len(found.poses)} scans"
        lost = f", {found.n_failed} of which could not be registered" if found.n_failed else ""
        self._notes.append(f"{about}{lost}; it is kept in {place}")
        columns = PoseColumns.of_frames(found.stamps_ns, found.poses, "scans", found.frame)
        return self._whole(stream, columns, found.bag_ns)

    def _transformed_poses(self, sources: dict[str, TfSource], max_gap_s: float) -> list[PoseBlock]:
        """A PoseBlock for each stream whose poses come from the transform tree."""
        tree, blocks = self.static_frames(), []
        streams = {name: TfStream(source, max_gap_s, tree) for name, source in sources.items()}
        found: dict[str, list[Any]] = {name: [] for name in streams}
        for source in sources.values():
            tree.route(*source)
        for transform, is_static, bag_ns in self._transforms():
            for name, stream in streams.items() if not is_static else ():
                found[name] += ((bag_ns, *each) for each in stream.edges_at(transform, False))
        for name, stream in streams.items():
            if not found[name]:
                raise InputError(f"{sources[name]}: {stream.describe_missing()}")
            bag_times_ns, stamps_ns, rows = zip(*found[name], strict=True)
            Ts = stream.composed(
                {frame: np.array([each[frame] for each in rows]) for frame in rows[0]}
            )
            values = np.c_[Ts[:, :3, 3], se3.to_quat_xyzw(Ts)]
            columns = PoseColumns.of_frames(np.array(stamps_ns), values, *sources[name])
            blocks.append(self._whole(name, columns, bag_times_ns))
        return blocks

    def static_frames(self) -> FrameTree:
        """The frames of the bag and their static transforms; of repeated ones the last. As in tf2,
        one that is no pose is left out.

        Raises
        ------
        InputError
            If the transforms form no tree or are damaged.
        """
        tree, notes = FrameTree("the bag's transforms"), {}
        for transform, is_static, _ in self._transforms():
            parent, frame, pose = transform.world_frame, transform.sensor_frame or "", None
            if is_static:
                try:
                    pose = checked_pose(transform.position, transform.quat_xyzw)
                except InputError as error:
                    notes[frame] = f"transform {parent}:{frame} was left out: {error}"
                    continue
            tree.add(parent, frame, pose, is_static)
        self._notes += notes.values()
        return tree

    def _transforms(self) -> Iterator[tuple[PoseFields, bool, int]]:
        """Transforms, whether each is static, and its bag time."""
        messages = self._messages(self._of_transforms())
        unpacked = _decoded(messages, lambda kind, data: unpack_transforms(data, _is_ros1(kind)))
        for kind, bag_ns, transforms in unpacked:
            for transform in transforms:
                yield transform, kind.topic.endswith("tf_static"), bag_ns

    # ---- messages

    def _messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Messages of some topics in the order of bag time."""
        return chain.from_iterable(self._blocks(topics))

    def _blocks(self, topics: Collection[str]) -> Iterator[list[Message]]:
        """Messages of some topics in the order of bag time, many at once."""
        storages = [each for each in self._storages if each.start_ns is not None]
        if all((one.end_ns or 0) < (two.start_ns or 0) for one, two in pairwise(storages)):
            return chain.from_iterable(storage.blocks(topics) for storage in storages)
        streams = (chain.from_iterable(storage.blocks(topics)) for storage in storages)
        return message_blocks(heapq.merge(*streams, key=itemgetter(1)))


def _decoded(
    messages: Iterable[Message],
    decode: Callable[[MessageKind, bytes], T],
    errors: type[Exception] | tuple[type[Exception], ...] = MALFORMED,
) -> Iterator[tuple[MessageKind, int, T]]:
    """Kind, bag time and content of messages; one that cannot be unpacked is named."""
    for number, (kind, bag_ns, data) in enumerate(messages, start=1):
        try:
            found = decode(kind, data)
        except InputError:
            raise
        except errors as error:
            raise _unreadable(kind, number, error) from error
        yield kind, bag_ns, found


def _unreadable(kind: MessageKind, number: int, error: Exception) -> InputError:
    """The error of a message that cannot be unpacked."""
    return InputError(
        f"{kind.topic}, message {number}: not a readable {kind.type} ({error}); "
        "the bag is damaged, record it again"
    )


def _is_ros1(kind: MessageKind) -> bool:
    return kind.encoding == "ros1"


def _in_bag_order(poses: PoseBlock) -> PoseBlock:
    return poses[np.argsort(poses.bag_ns, kind="stable")]


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
