"""Decide which of two topics with poses is the parent, and which is the child."""

import re
from collections.abc import Mapping, Sequence

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry.frames import words_of
from hand_eye_calib.formats.bags import messages
from hand_eye_calib.formats.exports import role_of

# Words in topic names, from the likeliest parent to the likeliest child. The empty word represents
# topics without any of the other words.
_WORDS = ("parent", "joint", "base", "lidar", "", "child")

# Common words in frame names. They do not indicate that two frames are of the same sensor.
_COMMON_WORDS = {"link", "frame", "sensor", "optical", "base"}

# The user may set the frame of a stream. The next four scores express how well a topic fits this
# frame, and are added up. Only their order matters.
# Score if the messages have the same frame.
_SAME_NAME = 8.0
# Score for each word that the frame shares with the topic, or with the frame in its messages.
_SAME_WORD = 2.0
# Score if the names of the frame and of the topic indicate the same kind of sensor.
_SAME_KIND = 1.0
# Score if the messages have no frame. A different frame has the score 0.
_NO_NAME = 0.5

_ODOMETRY = "nav_msgs/msg/Odometry"


def parent_and_child(
    topics: Sequence[str], frames: Mapping[str, str], sensors: Mapping[str, str]
) -> list[str]:
    """Return two topics of poses in the order parent, child.

    Parameters
    ----------
    topics : sequence of 2 str
    frames : mapping of str to str
        Frames that the user set for "parent" and "child"; empty if not set.
    sensors : mapping of str to str
        Frame of the sensor in the messages of each topic; empty if the messages have none.

    Raises
    ------
    InputError
        If the user set a frame, and both orders of the topics fit it equally well.
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
    """Return a score for ``frame``, which is higher if the topic's sensor probably has this frame.

    ``sensor`` is the frame of the sensor in the topic's messages.
    """
    score = 0.0
    if sensor == frame:
        score += _SAME_NAME
    elif not sensor:
        score += _NO_NAME
    shared = (words_of(frame) - _COMMON_WORDS) & (
        words_of(topic) | words_of(sensor)
    )
    score += _SAME_WORD * len(shared)
    role = role_of(frame)
    if role and role in (role_of(topic), role_of(sensor)):
        score += _SAME_KIND
    return score


def _parent_first(topic: str) -> tuple[int, str]:
    """Return a sort key with the likeliest parent first. Equal topics are sorted by name."""
    words = {*re.split(r"[/_:]+", topic.lower()), ""}
    # The word "child" decides, even if another word is present, as in "lidar_child".
    if "child" in words:
        return _WORDS.index("child"), topic
    return min(rank for rank, word in enumerate(_WORDS) if word in words), topic


def remarks_on_wheels(topics: Mapping[str, str]) -> list[str]:
    """Return the remark on an odometry that may be computed from the wheels that it is paired with.

    ``topics`` has the topics of both streams by their message types.
    """
    wheels = topics.get(messages.JOINTS_TYPE)
    odometry = topics.get(_ODOMETRY)
    if not (wheels and odometry):
        return []
    return [
        f"if {odometry} is computed from the wheels of {wheels}, as that of a wheel controller is, "
        "this result means nothing: record the odometry of another sensor"
    ]
