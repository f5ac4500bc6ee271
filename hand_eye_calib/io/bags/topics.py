"""Topics of bags: what is on them, and which of them are meant."""

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hand_eye_calib.arrays import IntArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.io.bags.messages import (
    MALFORMED,
    MESSAGE_TYPES,
    PATH_TYPE,
    POSE_TYPES,
    SENSOR_TYPES,
    TF_TYPES,
    MalformedMessage,
    unpack_path,
    unpack_poses,
    unpack_transforms,
)
from hand_eye_calib.io.bags.recovery import MessageKind
from hand_eye_calib.io.transforms import TfSource

# A topic with fewer poses is not one of the two sensors: goals and initial poses are published
# once.
_FEWEST_POSES = 3
# Words of a topic's name that say which stream it is, the likeliest parent first.
_PARENT_WORDS = ("parent", "base", "lidar")
_CHILD_WORD = "child"

Source = str | TfSource
# Pairs of frames, of a world and a sensor, in the order of their appearance.
Frames = dict[tuple[str, str | None], None]


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


class Topics(dict[str, TopicInfo]):
    """The topics of a bag by their names; ``bag`` is its name, for messages."""

    bag = ""

    def __str__(self) -> str:
        if not self:
            return f"There are no topics in {self.bag}"
        return f"The bag has {', '.join(map(str, self.values()))}"

    def described(
        self,
        frames: Mapping[str, Frames],
        spans_ns: Mapping[str, tuple[int, int]],
        span_ns: tuple[int, int],
    ) -> list[TopicDescription]:
        """With their frames, and their first and last stamps, or those of the bag."""
        found = []
        for name, info in self.items():
            first_ns, last_ns = spans_ns.get(name, span_ns)
            duration_s = (last_ns - first_ns) * 1e-9
            is_sampled = info.count > 1 and duration_s > 0
            rate_hz = (info.count - 1) / duration_s if is_sampled else None
            pairs = [":".join(filter(None, pair)) for pair in sorted(frames[name], key=str)]
            is_usable = info.type in SENSOR_TYPES
            sampled_s = duration_s if is_sampled else None
            found.append(TopicDescription(*info, rate_hz, sampled_s, pairs, is_usable))
        return found

    def type_of(self, source: Source | None) -> str:
        """Message type of a topic; empty for frames, and for what is not there."""
        return self[source].type if isinstance(source, str) and source in self else ""

    def check(self, source: Source) -> None:
        """Refuse a topic without poses, and frames of a bag without transforms.

        Raises
        ------
        InputError
            The message lists the topics that are there.
        """
        if isinstance(source, TfSource):
            if not any(topic.type in TF_TYPES for topic in self.values()):
                raise InputError(f"no transforms in {self.bag}. {self}")
            return
        if source not in self:
            raise InputError(f"no topic {source} in {self.bag}. {self}")
        found = self[source].type
        if found not in SENSOR_TYPES:
            is_tf = found in TF_TYPES
            frames = "; name two of its frames with --parent-tf and --child-tf" if is_tf else ""
            raise InputError(
                f"topic {source} of {self.bag} is of type {found or 'several types'}; accepted are "
                f"{', '.join(SENSOR_TYPES)}{frames}. {self}"
            )

    def select(self, parent: Source | None, child: Source | None) -> tuple[Source, Source]:
        """Choose what is not named, if there is only one way to do it.

        Raises
        ------
        InputError
            If a named source cannot be used, both are the same, or there is a choice to make.
        """
        named = [source for source in (parent, child) if source]
        for source in named:
            self.check(source)
        if len(named) == 2 and named[0] == named[1]:
            raise InputError(f"parent and child topic are both {parent}; name two topics. {self}")
        free = [name for name in self if name not in named]
        poses = [name for name in free if self[name].type in POSE_TYPES]
        moving = [name for name in poses if self[name].count >= _FEWEST_POSES]
        paths = [name for name in free if self[name].type == PATH_TYPE]
        wanted = 2 - len(named)
        choices = [names for names in (poses, moving, moving + paths) if len(names) == wanted]
        if wanted and not choices:
            raise InputError(
                "name the topics of poses with --parent-topic and --child-topic, or frames with "
                f"--parent-tf and --child-tf. {self}"
            )
        chosen = sorted(choices[0], key=_parent_first)[::-1] if wanted else []
        return parent or chosen.pop(), child or chosen.pop()


def joined(parts: Mapping[str, list[tuple[str, int]]], bag: str) -> Topics:
    """Topics from what each file says of them: message type, and number of messages."""
    topics = Topics()
    topics.bag = bag
    for name in sorted(parts):
        types = {each for each, _ in parts[name]}
        count = sum(each for _, each in parts[name])
        topics[name] = TopicInfo(name, types.pop() if len(types) == 1 else "", count)
    return topics


class Part(NamedTuple):
    """The N messages of one kind in a block: rows of the block (N,), numbers within the topic (N,),
    bytes, and bag times (N,).
    """

    kind: MessageKind
    rows: IntArray
    numbers: IntArray
    messages: list[bytes]
    bag_ns: IntArray

    def stamps_and_frames(self) -> tuple[IntArray, Frames]:
        """Stamps of the poses (none of transforms), and the pairs of frames."""
        kind, is_ros1 = self.kind, self.kind.encoding == "ros1"
        if kind.type in MESSAGE_TYPES:
            try:
                columns = unpack_poses(self.messages, kind.type, is_ros1)
            except MalformedMessage as error:
                raise unreadable(kind, int(self.numbers[error.index]), error) from error
            pairs = zip(columns.world_frames, columns.sensor_frames, strict=True)
            return columns.stamps_ns, dict.fromkeys(pairs)
        found_ns, frames = [np.empty(0, dtype=np.int64)], Frames()
        for number, data in zip(self.numbers, self.messages, strict=True):
            try:
                if kind.type == PATH_TYPE:
                    world_frame, stamps_ns, _ = unpack_path(data, is_ros1)
                    found_ns.append(stamps_ns)
                    frames[world_frame, None] = None
                else:
                    transforms = unpack_transforms(data, is_ros1)
                    frames |= {(each.world_frame, each.sensor_frame): None for each in transforms}
            except MALFORMED as error:
                raise unreadable(kind, int(number), error) from error
        return np.concatenate(found_ns), frames


def unreadable(kind: MessageKind, number: int, error: Exception) -> InputError:
    """The error of a message that cannot be unpacked."""
    return InputError(
        f"{kind.topic}, message {number}: not a readable {kind.type} ({error}); "
        "the bag is damaged, record it again"
    )


def _parent_first(topic: str) -> tuple[int, str]:
    """Sorts the likelier parent first: by name, then alphabetically."""
    words = re.split(r"[/_]+", topic.lower())
    if _CHILD_WORD in words:
        return len(_PARENT_WORDS) + 1, topic
    ranks = [rank for rank, word in enumerate(_PARENT_WORDS) if word in words]
    return min(ranks, default=len(_PARENT_WORDS)), topic
