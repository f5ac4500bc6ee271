"""Choose the topics of a bag for streams that the user has not named.

An obvious choice is used. Otherwise an error lists the topics of the bag, and the options for the
likeliest pair.
"""

from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

from hand_eye_calib.core.base.errors import UnclearStreamsError
from hand_eye_calib.core.base.text import counted, listing, shortened
from hand_eye_calib.core.geometry.frames import words_of
from hand_eye_calib.formats.bags import messages, roles
from hand_eye_calib.formats.exports import role_of

# Fewest poses on the topic of a sensor. Goals and initial poses are published only once.
_MIN_POSES = 3

# Words in topic names of poses that no single sensor measures: commands, ground truth, and
# estimates from several sensors.
_NO_SENSOR = {
    "goal",
    "target",
    "plan",
    "setpoint",
    "cmd",
    "truth",
    "gt",
    "filtered",
    "fused",
}
# Words in topic names that describe the kind of message instead of the sensor.
_KINDS_OF_MESSAGES = {
    "odometry",
    "odom",
    "pose",
    "poses",
    "path",
    "trajectory",
    "stamped",
    "local",
}
# Kinds of sensors in role_of, the likeliest first. The kind "base" is left out, because a vehicle
# is no sensor.
_SENSORS = ("lidar", "camera", "imu", "gnss")

# Largest number of characters in a list of topics in an error.
_LONGEST_LIST = 600

_FIX = "sensor_msgs/msg/NavSatFix"
_IMU = "sensor_msgs/msg/Imu"

# Types of topics without poses that can be the other stream: the role of the stream, a likely frame
# of the sensor, and what the messages determine. Wheels have no frame.
_OTHER_STREAMS = {
    _IMU: ("child", "imu_link", "rates, which give the rotation only"),
    _FIX: ("child", "gnss_link", "positions, which give no rotation alone"),
    messages.JOINTS_TYPE: (
        "parent",
        "",
        "wheels, if the poses are not computed from the wheels",
    ),
}


class TopicInfo(NamedTuple):
    """Topic of a bag: its name, its message type and its number of messages.

    The type is empty if several types of messages were published on the topic.
    """

    name: str
    type: str
    count: int  # type: ignore[assignment]

    def __str__(self) -> str:
        kind = self.type or "several types"
        return f"{self.name} ({kind}, {self.count} messages)"


class _Candidate(NamedTuple):
    """Topic with poses, and the sensor's frame in its first message, which may be missing."""

    topic: TopicInfo
    frame: str

    @property
    def name(self) -> str:
        return self.topic.name

    @property
    def is_of_sensor(self) -> bool:
        """Return whether a sensor may have measured the poses, according to the topic name."""
        return not words_of(self.name) & _NO_SENSOR

    @property
    def rank(self) -> int:
        """Index of the sensor's kind in ``_SENSORS``; for other kinds, the length of the list."""
        role = role_of(self.name) or role_of(self.frame)
        return _SENSORS.index(role) if role in _SENSORS else len(_SENSORS)

    def has_sensor_of(self, other: "_Candidate") -> bool:
        """Return whether both topics are from one sensor, according to frames and names."""
        if self.frame and self.frame == other.frame:
            return True
        words = words_of(self.name) - _KINDS_OF_MESSAGES
        return (
            bool(words) and words == words_of(other.name) - _KINDS_OF_MESSAGES
        )


def _of_types(
    topics: Sequence[TopicInfo], types: Collection[str], min_count: int = 0
) -> list[TopicInfo]:
    """Return the topics with at least ``min_count`` messages of the given types."""
    return [
        topic
        for topic in topics
        if topic.type in types and topic.count >= min_count
    ]


def choose(
    topics: Sequence[TopicInfo],
    missing: Sequence[str],
    frame_of: Callable[[str], str],
    edges: Collection[str],
) -> list[str]:
    """Return the topics of the missing streams.

    Parameters
    ----------
    topics : sequence of TopicInfo
        Topics that are not yet used by a stream.
    missing : sequence of str
        Streams without a topic: "parent", "child" or both.
    frame_of : callable
        Function that returns the sensor's frame in the first message of a topic.
    edges : collection of str
        Frames of the moving transforms in the bag, as WORLD:SENSOR.

    Raises
    ------
    UnclearStreamsError
        If there is no obvious choice. The error contains the options of the likeliest choice.
    """
    n_missing = len(missing)
    poses = _of_types(topics, messages.POSE_TYPES)
    moving = _of_types(topics, messages.POSE_TYPES, _MIN_POSES)
    paths = _of_types(topics, {messages.PATH_TYPE})
    others = _of_types(topics, messages.FIELD_POSE_TYPES, _MIN_POSES)
    candidates = [
        _Candidate(topic, frame_of(topic.name))
        for topic in moving + paths + others
    ]
    sensors = _topic_of_each_sensor(candidates)
    of_known_kinds = [
        sensor for sensor in sensors if sensor.rank < len(_SENSORS)
    ]
    groups: list[Sequence[TopicInfo | _Candidate]] = [poses, moving]
    groups += [moving + paths, moving + others, sensors, of_known_kinds]
    # The choice is obvious if a group has as many topics, or sensors, as streams are missing.
    for group in groups:
        if len(group) == n_missing:
            return [item.name for item in group]
    if len(sensors) < n_missing <= len(candidates):
        sensors = candidates
    partners = _partners(topics, n_missing, sensors, frame_of)
    raise _unclear(
        topics, [sensor.topic for sensor in sensors], missing, edges, partners
    )


def _partners(
    topics: Sequence[TopicInfo],
    n_missing: int,
    sensors: Sequence[_Candidate],
    frame_of: Callable[[str], str],
) -> Sequence[TopicInfo]:
    """Return the topics that may be the second stream, beside the stream of one of ``sensors``.

    ``n_missing`` is the number of streams that the user has not named.
    """
    partners = topics
    if len(sensors) == 1 and sensors[0].frame:
        # The other stream must be from another sensor.
        frame = sensors[0].frame
        partners = [topic for topic in topics if frame_of(topic.name) != frame]
    if n_missing == 1:
        # Wheels can only be the parent, and the stream that the user named may be the parent.
        partners = [
            topic for topic in partners if topic.type != messages.JOINTS_TYPE
        ]
    return partners


def _topic_of_each_sensor(candidates: Sequence[_Candidate]) -> list[_Candidate]:
    """Return the likeliest topic of each sensor, the likeliest sensor first."""
    sensors: list[_Candidate] = []
    ranked = sorted(
        candidates,
        key=lambda candidate: (candidate.rank, -candidate.topic.count),
    )
    for candidate in ranked:
        is_same_sensor = any(
            candidate.has_sensor_of(sensor) for sensor in sensors
        )
        if candidate.is_of_sensor and not is_same_sensor:
            sensors.append(candidate)
    return sensors


def _unclear(
    topics: Sequence[TopicInfo],
    sensors: Sequence[TopicInfo],
    missing: Sequence[str],
    edges: Collection[str],
    partners: Sequence[TopicInfo],
) -> UnclearStreamsError:
    """Return the error for a bag without an obvious choice.

    The error contains the problem, and the options for the likeliest choice. If no choice is
    possible, it contains what to record instead, and the topics of the bag. If only one topic has
    poses, ``partners`` are the topics that may belong to the other sensor.
    """
    if not any(topic.count for topic in topics) and len(missing) > 1:
        return UnclearStreamsError("the bag has no messages: record again", {})
    problem, sources = _problem_and_sources(
        partners, sensors, edges, len(missing)
    )
    if len(sensors) == 1 and len(missing) > 1:
        others = [topic for topic in topics if topic.name not in sources]
        of_own_frame = {topic.name for topic in partners}
        texts = other_streams(others, of_own_frame)
        problem = ". ".join([problem, *texts])
    if len(sources) >= len(missing):
        return UnclearStreamsError(problem, _options(missing, sources))
    advice = "record the odometry of the other sensor"
    if not sensors:
        advice = _advice({topic.type for topic in topics}, len(missing))
    listed = "The bag has no other topics"
    if topics:
        listed = f"The bag has {listed_usable(topics)}"
    return UnclearStreamsError(f"{problem}: {advice}. {listed}", {})


def _problem_and_sources(
    topics: Sequence[TopicInfo],
    sensors: Sequence[TopicInfo],
    edges: Collection[str],
    n_missing: int,
) -> tuple[str, list[str]]:
    """Return the reason why the choice is unclear, and the possible sources, the likeliest first.

    Sources are topics with poses, pairs of frames in transforms, and clouds of points. ``sensors``
    are the topics with poses.
    """
    pairs = _separate_edges(edges)
    clouds = _of_types(topics, {messages.POINTS_TYPE})
    if len(sensors) >= n_missing:
        problem = f"{len(sensors)} topics have poses: {_listed(sensors)}"
        return problem, [topic.name for topic in sensors]
    if sensors:
        return _partners_of(sensors[0], topics, pairs)
    # A topic that the user has named is not in ``topics``.
    no_poses = (
        "no topic has poses" if n_missing > 1 else "no other topic has poses"
    )
    if len(pairs) >= n_missing:
        listed = shortened(listing(pairs), _LONGEST_LIST)
        return f"{no_poses}, but transforms have: {listed}", pairs
    if len(clouds) >= n_missing:
        problem = f"{no_poses}; the odometry of lidars can be computed from {_listed(clouds)}"
        return problem, [topic.name for topic in clouds]
    frames = {edge.split(":")[-1] for edge in edges}
    worlds = {edge.split(":")[0] for edge in edges}
    if len(frames - worlds) >= n_missing:
        listed = shortened(listing(sorted(edges)), _LONGEST_LIST)
        problem = (
            f"{no_poses}; the transforms share a frame, so they may all be from one sensor "
            f"({listed}; if two sensors measured two of the transforms, name these two)"
        )
        return problem, []
    partial = _partial_topic(topics) if n_missing == 1 else None
    if partial is None:
        return no_poses, []
    quantity = "positions" if partial.type == _FIX else "rates"
    return f"{no_poses}; {partial.name} has {quantity}", [partial.name]


def _partners_of(
    sensor: TopicInfo, topics: Sequence[TopicInfo], pairs: Sequence[str]
) -> tuple[str, list[str]]:
    """Return the problem that only one topic has poses, and the possible partners of this topic.

    ``pairs`` are pairs of frames in transforms.
    """
    partners: list[TopicInfo] = []
    for type_ in (_FIX, messages.POINTS_TYPE, _IMU):
        partners += _of_types(topics, {type_})
    names = [topic.name for topic in (sensor, *partners)] + [*pairs]
    problem = f"only one topic has poses, {sensor}"
    wheels = _of_types(topics, {messages.JOINTS_TYPE})
    if len(names) == 1 and wheels:
        problem += (
            f". If {sensor.name} is not computed from the wheels, {wheels[0].name} is "
            "the other stream; otherwise record the odometry of a second sensor"
        )
        # Wheels are the parent.
        names = [wheels[0].name, *names]
    return problem, names


def other_streams(
    topics: Sequence[TopicInfo], of_own_frame: Collection[str]
) -> list[str]:
    """Return a text about each topic without poses that can be the other stream, with its options.

    Parameters
    ----------
    topics : sequence of TopicInfo
    of_own_frame : collection of str
        Topics whose messages have another frame than the poses. The user must name the frame of the
        other topics: the frame in their messages is that of the poses.
    """
    texts = []
    for topic in topics:
        if topic.type not in _OTHER_STREAMS or not topic.count:
            continue
        role, frame, quantity = _OTHER_STREAMS[topic.type]
        text = f"{topic.name}: {quantity}: --{role}-topic {topic.name}"
        if frame and topic.name not in of_own_frame:
            text += f" --{role}-frame {frame}"
        texts.append(text)
    return texts


def _partial_topic(topics: Sequence[TopicInfo]) -> TopicInfo | None:
    """Return the first topic with positions, otherwise with rates; None if there is none."""
    partial = [*_of_types(topics, {_FIX}), *_of_types(topics, {_IMU})]
    return partial[0] if partial else None


def _advice(types: set[str], n_missing: int) -> str:
    """Return advice for a bag without poses, given the types of its messages."""
    if messages.POINTS_TYPE in types:
        return "run the odometry of both sensors and record it; clouds of one lidar are one stream"
    if not types.isdisjoint(messages.IMAGE_TYPES):
        return "run visual odometry or SLAM on the images, and record its poses"
    if _FIX in types and _IMU in types:
        return "GNSS and IMU need the poses of another sensor: record its odometry or SLAM"
    sensors = "both sensors" if n_missing > 1 else "the other sensor"
    return f"run the odometry or SLAM of {sensors}, and record it"


def _separate_edges(edges: Collection[str]) -> list[str]:
    """Return pairs WORLD:SENSOR without a common frame: each sensor has its own world."""
    separate: list[str] = []
    used: set[str] = set()
    for edge in sorted(edges):
        frames = {*edge.split(":")}
        if not frames & used:
            separate.append(edge)
            used |= frames
    return separate


def _options(missing: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Return the options that choose the first (likeliest) names for the missing streams."""
    chosen = [*names[: len(missing)]]
    if len(chosen) > 1:
        chosen = roles.parent_and_child(chosen, {}, {})
    return {
        f"{stream}_topic": name
        for stream, name in zip(missing, chosen, strict=True)
    }


def listed_usable(topics: Sequence[TopicInfo]) -> str:
    """Return the topics that may belong to a stream as text for an error, and how many others are.

    If there are none, all topics are returned.
    """
    types = {
        *messages.MESSAGE_TYPES,
        *messages.TF_TYPES,
        *messages.IMAGE_TYPES,
    }
    usable = _of_types(topics, types)
    n_others = len(topics) - len(usable)
    if not usable or not n_others:
        return _listed(topics)
    return f"{_listed(usable)}, and {counted(n_others, 'topic')} of other types"


def _listed(topics: Sequence[TopicInfo]) -> str:
    """Return topics as text for an error, shortened if they are many."""
    descriptions = [str(topic) for topic in topics]
    return shortened(listing(descriptions), _LONGEST_LIST)
