"""Topics of bags: what is on them, and which of them are meant."""

import re
from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import NamedTuple

from hand_eye_calib.errors import InputError
from hand_eye_calib.io.bags.fields import split_fields
from hand_eye_calib.io.bags.messages import (
    PATH_TYPE,
    POSE_TYPES,
    SENSOR_TYPES,
    TF_TYPES,
    measured_as,
)
from hand_eye_calib.io.transforms import TfSource

# A topic with fewer poses is not one of the two sensors: goals and initial poses are published
# once.
_FEWEST_POSES = 3
# Words of a topic's name that say which stream it is, the likeliest parent first.
_WORDS = ("parent", "base", "lidar", "", "child")
# Transforms that a message lists.
_MOST_FRAMES = 20

Source = str | TfSource


class TopicInfo(NamedTuple):
    """A topic of a bag: its name, its message type (empty if publishers disagree), and how many
    messages it has.
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

    @classmethod
    def of_connections(
        cls, found: Iterable[tuple[str, str, int]], bag: str, frames: Callable[[], list[str]]
    ) -> "Topics":
        """From topic, message type and number of messages of each connection."""
        types, counts = defaultdict[str, set[str]](set), defaultdict[str, int](int)
        for name, type_, count in found:
            types[name].add(type_)
            counts[name] += count
        topics = cls(
            (name, TopicInfo(name, "" if len(types[name]) > 1 else [*types[name]][0], counts[name]))
            for name in sorted(types)
        )
        topics.bag, topics.frames = bag, frames
        return topics

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
        elif not fields and self[source].type not in SENSOR_TYPES:
            is_tf = self[source].type in TF_TYPES
            hint = (
                "name two of its frames with --parent-tf and --child-tf"
                if is_tf
                else "read others by their fields, TOPIC?t=header.stamp,x=..."
            )
            raise InputError(
                f"topic {source} of {self.bag} is of type {self[source].type or 'several types'}; "
                f"accepted are {', '.join(SENSOR_TYPES)}; {hint}. {self}"
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
        free = [topic for name, topic in self.items() if name not in named]
        poses = [topic for topic in free if topic.type in POSE_TYPES]
        moving = [topic for topic in poses if topic.count >= _FEWEST_POSES]
        paths = [topic for topic in free if topic.type == PATH_TYPE]
        wanted = 2 - len(named)
        choices = [topics for topics in (poses, moving, moving + paths) if len(topics) == wanted]
        if wanted and not choices:
            found = self.frames()
            more = f" and {len(found) - _MOST_FRAMES} more" if len(found) > _MOST_FRAMES else ""
            raise InputError(
                "name the topics of poses with --parent-topic and --child-topic, or frames with "
                f"--parent-tf and --child-tf. {self}"
                + (f". Transforms are {', '.join(found[:_MOST_FRAMES])}{more}" if found else "")
            )
        chosen = sorted((topic.name for topic in choices[0]), key=_parent_first) if wanted else []
        return parent or chosen.pop(0), child or chosen.pop(0)


def joined_parts(source: str) -> tuple[str, ...]:
    """The topics of positions and of orientations of ``/fix+/imu``; otherwise the source."""
    parts = tuple(source.split("+"))
    return parts if len(parts) == 2 and all(parts) else (source,)


def _parent_first(topic: str) -> tuple[int, str]:
    """Sorts the likelier parent first: by name, then alphabetically."""
    words = {*re.split(r"[/_]+", topic.lower()), ""}
    word = "child" if "child" in words else next(each for each in _WORDS if each in words)
    return _WORDS.index(word), topic
