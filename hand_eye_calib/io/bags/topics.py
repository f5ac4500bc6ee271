"""Topics of bags: what is on them, and which of them are meant."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from hand_eye_calib.arrays import IntArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.io.bags.blocks import MessageKind
from hand_eye_calib.io.bags.messages import (
    MALFORMED,
    PATH_TYPE,
    POSE_TYPES,
    TF_TYPES,
    Buffer,
    MalformedMessage,
    unpack_path,
    unpack_poses,
    unpack_transforms,
)
from hand_eye_calib.io.bags.parts import PART_TYPES
from hand_eye_calib.io.transforms import TfSource

# A topic with fewer poses is not one of the two sensors: goals and initial poses are published
# once.
_FEWEST_POSES = 3
# Different frames of one topic that are listed.
_MOST_FRAMES = 1_000

Source = str | TfSource


class TopicInfo(NamedTuple):
    """A topic of a bag.

    Attributes
    ----------
    name : str
    type : str
        Message type, empty if publishers disagree.
    count : int
        Number of messages.
    """

    name: str
    type: str
    count: int  # type: ignore[assignment]

    def __str__(self) -> str:
        return f"{self.name} ({self.type or 'several types'}, {self.count} messages)"


class TopicDescription(NamedTuple):
    """A topic with its rate and frames.

    Attributes
    ----------
    name, type, count
        As in TopicInfo.
    rate_hz, duration_s : float or None
        Of the stamps if the topic has poses, otherwise of the bag; None if there are too few
        messages.
    frames : list of str
        ``world:sensor`` of poses, as far as they say; ``parent:child`` of transforms.
    is_usable : bool
        Whether poses can be read from it.
    """

    name: str
    type: str
    count: int  # type: ignore[assignment]
    rate_hz: float | None
    duration_s: float | None
    frames: list[str]
    is_usable: bool


class TopicScan:
    """Stamps and frames of a topic's messages, collected while they are read."""

    def __init__(self) -> None:
        self._frames: dict[tuple[str, str | None], None] = {}
        self._first_ns: int | None = None
        self._last_ns: int | None = None

    def take(self, kind: MessageKind, first_number: int, messages: Sequence[Buffer]) -> None:
        """Look at messages of one kind.

        Raises
        ------
        InputError
            At the first that is not readable.
        """
        if kind.type in POSE_TYPES:
            self._take_poses(kind, first_number, messages)
            return
        for number, data in enumerate(messages, start=first_number):
            try:
                if kind.type == PATH_TYPE:
                    world_frame, stamps_ns, _ = unpack_path(data, kind.is_ros1)
                    self._note(stamps_ns, [(world_frame, None)])
                else:
                    for transform in unpack_transforms(data, kind.is_ros1):
                        self._note_frames([(transform.world_frame, transform.sensor_frame)])
            except MALFORMED as error:
                raise unreadable(kind, number, error) from error

    def _take_poses(self, kind: MessageKind, first_number: int, messages: Sequence[Buffer]) -> None:
        try:
            columns = unpack_poses(messages, kind.type, kind.is_ros1)
        except MalformedMessage as error:
            raise unreadable(kind, first_number + error.index, error) from error
        frames = zip(columns.world_frames, columns.sensor_frames, strict=True)
        self._note(columns.stamps_ns, frames)

    def _note(self, stamps_ns: IntArray, frames: Iterable[tuple[str, str | None]]) -> None:
        self._note_frames(frames)
        if len(stamps_ns):
            first_ns, last_ns = int(stamps_ns.min()), int(stamps_ns.max())
            self._first_ns = first_ns if self._first_ns is None else min(first_ns, self._first_ns)
            self._last_ns = last_ns if self._last_ns is None else max(last_ns, self._last_ns)

    def _note_frames(self, frames: Iterable[tuple[str, str | None]]) -> None:
        if len(self._frames) < _MOST_FRAMES:
            self._frames |= dict.fromkeys(frames)

    def describe(self, info: TopicInfo, bag_duration_s: float) -> TopicDescription:
        """Sum up what was seen."""
        is_usable = info.type in (*POSE_TYPES, PATH_TYPE, *PART_TYPES)
        duration_s = bag_duration_s
        if is_usable and self._first_ns is not None and self._last_ns is not None:
            duration_s = (self._last_ns - self._first_ns) * 1e-9
        is_sampled = info.count > 1 and duration_s > 0
        return TopicDescription(
            *info,
            rate_hz=(info.count - 1) / duration_s if is_sampled else None,
            duration_s=duration_s if is_sampled else None,
            frames=[":".join(filter(None, pair)) for pair in sorted(self._frames, key=str)],
            is_usable=is_usable,
        )


def unreadable(kind: MessageKind, number: int, error: Exception) -> InputError:
    """The error of a message that cannot be unpacked."""
    return InputError(
        f"{kind.topic}, message {number}: not a readable {kind.type} ({error}); "
        "the bag is damaged, record it again"
    )


def listing(topics: Mapping[str, TopicInfo], bag: str) -> str:
    """List the topics of a bag in a sentence."""
    if not topics:
        return f"There are no topics in {bag}"
    return f"The bag has {', '.join(map(str, topics.values()))}"


def check_source(source: Source, topics: Mapping[str, TopicInfo], bag: str) -> None:
    """Refuse a topic without poses, and frames of a bag without transforms.

    Raises
    ------
    InputError
        The message lists the topics that are there.
    """
    if isinstance(source, TfSource):
        if not any(topic.type in TF_TYPES for topic in topics.values()):
            raise InputError(f"no transforms in {bag}. {listing(topics, bag)}")
        return
    if source not in topics:
        raise InputError(f"no topic {source} in {bag}. {listing(topics, bag)}")
    found = topics[source].type
    if found not in (*POSE_TYPES, PATH_TYPE, *PART_TYPES):
        frames = (
            "; name two of its frames with --parent-tf and --child-tf" if found in TF_TYPES else ""
        )
        raise InputError(
            f"topic {source} of {bag} is of type {found or 'several types'}; accepted are "
            f"{', '.join([*POSE_TYPES, PATH_TYPE, *PART_TYPES])}{frames}. {listing(topics, bag)}"
        )


def select_sources(
    parent: Source | None, child: Source | None, topics: Mapping[str, TopicInfo], bag: str
) -> tuple[Source, Source]:
    """Choose what is not named, if there is only one way to do it.

    Raises
    ------
    InputError
        If a named source cannot be used, both are the same, or there is a choice to make.
    """
    named = [source for source in (parent, child) if source]
    for source in named:
        check_source(source, topics, bag)
    if len(named) == 2 and named[0] == named[1]:
        raise InputError(
            f"parent and child topic are both {parent}; name two topics. {listing(topics, bag)}"
        )
    free = [name for name in topics if name not in named]
    poses = [name for name in free if topics[name].type in POSE_TYPES]
    moving = [name for name in poses if topics[name].count >= _FEWEST_POSES]
    paths = [name for name in free if topics[name].type == PATH_TYPE]
    wanted = 2 - len(named)
    choices = [names for names in (poses, moving, moving + paths) if len(names) == wanted]
    if wanted and not choices:
        raise InputError(
            "name the topics of poses with --parent-topic and --child-topic, or frames with "
            f"--parent-tf and --child-tf. {listing(topics, bag)}"
        )
    chosen = sorted(choices[0], key=_parent_first)[::-1] if wanted else []
    return parent or chosen.pop(), child or chosen.pop()


# Words of a topic's name that say which stream it is, the likeliest parent first.
_PARENT_WORDS = ("parent", "base", "lidar")
_CHILD_WORD = "child"


def _parent_first(topic: str) -> tuple[int, str]:
    """Sorts the likelier parent first: by name, then alphabetically."""
    words = re.split(r"[/_]+", topic.lower())
    if _CHILD_WORD in words:
        return len(_PARENT_WORDS) + 1, topic
    ranks = [rank for rank, word in enumerate(_PARENT_WORDS) if word in words]
    return min(ranks, default=len(_PARENT_WORDS)), topic
