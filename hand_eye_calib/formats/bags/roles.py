"""Decide which of two topics of poses is the parent, and which the child."""

import re
from collections.abc import Mapping, Sequence

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry.frames import words_of
from hand_eye_calib.formats.exports import role_of

# Words in the names of topics, the likeliest parent first. The empty word is that of other topics.
_WORDS = ("parent", "base", "lidar", "", "child")

# Words that many names of frames contain.
_COMMON_WORDS = {"link", "frame", "sensor", "optical", "base"}

# Score of a topic for a frame that the user names, if its messages name the same frame.
_SAME_NAME = 8.0
# Score of each word that the frame shares with the topic or with the frame of its messages.
_SAME_WORD = 2.0
# Score if the frame and the topic name sensors of the same kind.
_SAME_KIND = 1.0
# Score if the messages name no frame, which is better than another frame.
_NO_NAME = 0.5


def parent_and_child(
    topics: Sequence[str], frames: Mapping[str, str], sensors: Mapping[str, str]
) -> list[str]:
    """Sort two topics of poses: parent, child.

    Parameters
    ----------
    topics : sequence of 2 str
    frames : mapping of str to str
        Frames of the sensors of "parent" and "child" that the user set; empty if not set.
    sensors : mapping of str to str
        Frame of the sensor in the messages of each topic; empty if the messages name none.

    Raises
    ------
    InputError
        If the user names a frame that fits both topics equally well.
    """
    by_words = sorted(topics, key=_parent_first)
    named = {stream: frame for stream, frame in frames.items() if frame}
    if not named:
        return by_words
    scores = []
    for order in ([*topics], [*topics[::-1]]):
        topic_of = dict(zip(("parent", "child"), order, strict=True))
        score = 0.0
        for stream, frame in named.items():
            topic = topic_of[stream]
            score += _match(frame, topic, sensors.get(topic, ""))
        scores.append((score, order))
    (worst, _), (best, best_order) = sorted(scores)
    if best > worst:
        return best_order
    if any({"parent", "child"} & words_of(topic) for topic in topics):
        return by_words
    names = " and ".join(named.values())
    raise InputError(
        f"the names do not decide which of the topics {topics[0]} and "
        f"{topics[1]} is of {names}: set --parent-topic and --child-topic"
    )


def _match(frame: str, topic: str, sensor: str) -> float:
    """Return a score that is higher the more likely a frame is that of a topic's sensor."""
    score = 0.0
    if sensor == frame:
        score += _SAME_NAME
    elif not sensor:
        score += _NO_NAME
    shared = (words_of(frame) - _COMMON_WORDS) & (words_of(topic) | words_of(sensor))
    score += _SAME_WORD * len(shared)
    role = role_of(frame)
    if role and role in (role_of(topic), role_of(sensor)):
        score += _SAME_KIND
    return score


def _parent_first(topic: str) -> tuple[int, str]:
    """Return a sort key: by the likeliest word of a topic's name, then by the name."""
    words = {*re.split(r"[/_:]+", topic.lower()), ""}
    if "child" in words:
        return _WORDS.index("child"), topic
    return min(rank for rank, word in enumerate(_WORDS) if word in words), topic
