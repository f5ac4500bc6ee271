"""Which of two topics of poses is the parent, and which the child."""

import itertools
import re
from collections.abc import Mapping, Sequence

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry.frames import words_of
from hand_eye_calib.formats.exports import role_of

# Words of a topic's name that say which stream it is, the likeliest parent first.
_WORDS = ("parent", "base", "lidar", "", "child")

# Words that many frames have in common.
_OF_ALL = {"link", "frame", "sensor", "optical", "base"}

# What speaks for a frame's name being that of a topic: the messages have the same name; the words
# of both are the same; both are sensors of one kind. The messages have no name: more than another.
_SAME_NAME = 8.0
_SAME_WORD = 2.0
_SAME_KIND = 1.0
_NO_NAME = 0.5


def parent_and_child(
    topics: Sequence[str], frames: Mapping[str, str], sensors: Mapping[str, str]
) -> list[str]:
    """Return two topics of poses in their order: parent, child.

    Parameters
    ----------
    topics : sequence of 2 str
    frames : mapping of str to str
        Frames of the sensors of "parent" and "child" as the user names them; empty if not named.
    sensors : mapping of str to str
        Frame of the sensor of each topic as its messages name it; empty if they do not.

    Raises
    ------
    InputError
        If the user names a frame, and nothing says which topic it belongs to.
    """
    by_words = sorted(topics, key=_parent_first)
    named = {stream: frame for stream, frame in frames.items() if frame}
    if not named:
        return by_words
    scores = {
        order: sum(
            _match(named[stream], topic, sensors.get(topic, ""))
            for stream, topic in zip(("parent", "child"), order, strict=True)
            if stream in named
        )
        for order in itertools.permutations(topics)
    }
    (best, most), (_, less) = sorted(scores.items(), key=lambda item: -item[1])
    if most > less:
        return [*best]
    if any({"parent", "child"} & words_of(topic) for topic in topics):
        return by_words
    names = " and ".join(named.values())
    raise InputError(
        f"nothing says which of the topics {topics[0]} and {topics[1]} is of {names}: name them "
        "with --parent-topic and --child-topic"
    )


def _match(frame: str, topic: str, sensor: str) -> float:
    """How much speaks for the frame being that of the sensor of a topic."""
    score = 0.0
    if sensor == frame:
        score += _SAME_NAME
    elif not sensor:
        score += _NO_NAME
    shared = (words_of(frame) - _OF_ALL) & (words_of(topic) | words_of(sensor))
    score += _SAME_WORD * len(shared)
    role = role_of(frame)
    if role and role in (role_of(topic), role_of(sensor)):
        score += _SAME_KIND
    return score


def _parent_first(topic: str) -> tuple[int, str]:
    """Sorts the likelier parent first: by name, then alphabetically."""
    words = {*re.split(r"[/_]+", topic.lower()), ""}
    word = "child" if "child" in words else next(each for each in _WORDS if each in words)
    return _WORDS.index(word), topic
