"""Topics of bags: what is on them, and which of them are meant."""

import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

from hand_eye_calib.arrays import IntArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.io.bags.fields import split_fields
from hand_eye_calib.io.bags.messages import (
    PATH_TYPE,
    POSE_TYPES,
    SENSOR_TYPES,
    TF_TYPES,
    measured_as,
)
from hand_eye_calib.io.bags.recovery import MessageKind
from hand_eye_calib.io.transforms import TfSource

# A topic with fewer poses is not one of the two sensors: goals and initial poses are published
# once.
_FEWEST_POSES = 3
# Words of a topic's name that say which stream it is, the likeliest parent first.
_PARENT_WORDS = ("parent", "base", "lidar")
_CHILD_WORD = "child"
# Transforms that a message lists.
_MOST_FRAMES = 20

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


class Topics(dict[str, TopicInfo]):
    """The topics of a bag by their names; ``bag`` is its name, and ``frames`` lists its first
    transforms, for messages.
    """

    bag = ""
    frames: Callable[[], list[str]] = list

    def __str__(self) -> str:
        if not self:
            return f"There are no topics in {self.bag}"
        return f"The bag has {', '.join(map(str, self.values()))}"

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
        topic, fields = split_fields(source)
        parts = joined_parts(topic) if topic not in self else (topic,)
        for part in parts:
            if part not in self:
                raise InputError(f"no topic {part} in {self.bag}. {self}")
        if len(parts) > 1:
            for part, wanted in zip(parts, ("positions", "rotations"), strict=True):
                measured_as(self[part].type, wanted, part)
        if len(parts) > 1 or fields:
            return
        found = self[source].type
        if found not in SENSOR_TYPES:
            is_tf = found in TF_TYPES
            hint = (
                "name two of its frames with --parent-tf and --child-tf"
                if is_tf
                else "read others by their fields, TOPIC?t=header.stamp,x=..."
            )
            raise InputError(
                f"topic {source} of {self.bag} is of type {found or 'several types'}; accepted are "
                f"{', '.join(SENSOR_TYPES)}; {hint}. {self}"
            )

    def select(
        self, parent: Source | None = None, child: Source | None = None
    ) -> tuple[Source, Source]:
        """Choose the sources of the parent's and the child's poses.

        What is not named is chosen if there is only one way to do it: with neither named, the bag
        has exactly two topics of poses. The parent is the one whose name has the word parent, base
        or lidar, or the first in alphabetical order. Topics of paths count if there are not enough
        others.

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
                f"--parent-tf and --child-tf. {self}{self._transforms()}"
            )
        chosen = sorted(choices[0], key=_parent_first)[::-1] if wanted else []
        return parent or chosen.pop(), child or chosen.pop()

    def _transforms(self) -> str:
        """The frames of the first transforms, for a message."""
        found = self.frames()
        more = f" and {len(found) - _MOST_FRAMES} more" if len(found) > _MOST_FRAMES else ""
        return f". Transforms are {', '.join(found[:_MOST_FRAMES])}{more}" if found else ""


def joined_parts(source: str) -> tuple[str, ...]:
    """The topics of positions and of orientations of ``/fix+/imu``; otherwise the source."""
    parts = tuple(source.split("+"))
    return parts if len(parts) == 2 and all(parts) else (source,)


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
