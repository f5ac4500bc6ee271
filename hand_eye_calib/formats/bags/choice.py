"""Choose topics of a bag for the streams that the user has not named.

An obvious pair is taken. Otherwise the error states what the bag has, and the options of the
likeliest pair.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

from hand_eye_calib.core.base.errors import UnclearStreamsError
from hand_eye_calib.core.base.text import listing, shortened
from hand_eye_calib.core.geometry.frames import words_of
from hand_eye_calib.formats.bags import messages, roles
from hand_eye_calib.formats.exports import role_of

# A topic with fewer poses is no sensor: goals and initial poses are published once.
_FEWEST_POSES = 3

# Words of topics whose poses are not those of a sensor, or are computed from those of sensors.
_NO_SENSOR = {"goal", "target", "plan", "setpoint", "cmd", "truth", "gt", "filtered", "fused"}
# Words that name a kind of message, and no sensor.
_OF_MESSAGES = {"odometry", "odom", "pose", "poses", "path", "trajectory", "stamped", "local"}
# Kinds of sensors of role_of, the likeliest first; "base" is a vehicle.
_SENSORS = ("lidar", "camera", "imu", "gnss")

# Characters of the longest list of topics in an error.
_LONGEST_LIST = 600

_FIX = "sensor_msgs/msg/NavSatFix"
_IMU = "sensor_msgs/msg/Imu"


class TopicInfo(NamedTuple):
    """A topic of a bag: name, message type (empty if publishers disagree), number of messages."""

    name: str
    type: str
    count: int  # type: ignore[assignment]

    def __str__(self) -> str:
        return f"{self.name} ({self.type or 'several types'}, {self.count} messages)"


class _Candidate(NamedTuple):
    """A topic with poses, and the sensor's frame in its first message; empty without a frame."""

    topic: TopicInfo
    frame: str

    @property
    def name(self) -> str:
        return self.topic.name

    @property
    def is_of_sensor(self) -> bool:
        """Whether the name does not exclude that the poses are those of a sensor."""
        return not words_of(self.name) & _NO_SENSOR

    @property
    def rank(self) -> int:
        """Place of the sensor's kind in ``_SENSORS``, or the place behind the last."""
        role = role_of(self.name) or role_of(self.frame)
        return _SENSORS.index(role) if role in _SENSORS else len(_SENSORS)

    def has_sensor_of(self, other: "_Candidate") -> bool:
        """Whether both topics have poses of one sensor, by their frames or names."""
        if self.frame and self.frame == other.frame:
            return True
        words = words_of(self.name) - _OF_MESSAGES
        return bool(words) and words == words_of(other.name) - _OF_MESSAGES


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
        Topics that no stream uses.
    missing : sequence of str
        Streams without a topic: "parent", "child" or both.
    frame_of : callable
        Return the sensor's frame in the first message of a topic.
    edges : collection of str
        Frames of transforms as WORLD:SENSOR.

    Raises
    ------
    UnclearStreamsError
        If there is no obvious choice.
    """
    n_missing = len(missing)
    poses = [topic for topic in topics if topic.type in messages.POSE_TYPES]
    moving = [topic for topic in poses if topic.count >= _FEWEST_POSES]
    paths = [topic for topic in topics if topic.type == messages.PATH_TYPE]
    others = [
        topic
        for topic in topics
        if topic.type in messages.FIELD_POSE_TYPES and topic.count >= _FEWEST_POSES
    ]
    for some in (poses, moving, moving + paths, moving + others):
        if len(some) == n_missing:
            return [topic.name for topic in some]
    candidates = [_Candidate(topic, frame_of(topic.name)) for topic in moving + paths + others]
    sensors = _one_of_each_sensor(candidates)
    named = [sensor for sensor in sensors if sensor.rank < len(_SENSORS)]
    for likely in (sensors, named):
        if len(likely) == n_missing:
            return [sensor.name for sensor in likely]
    if len(sensors) < n_missing <= len(candidates):
        sensors = candidates
    raise _unclear(topics, [sensor.topic for sensor in sensors], missing, edges)


def _one_of_each_sensor(candidates: Sequence[_Candidate]) -> list[_Candidate]:
    """Return the likeliest topic of each sensor, the likeliest sensor first."""
    sensors: list[_Candidate] = []
    ranked = sorted(candidates, key=lambda candidate: (candidate.rank, -candidate.topic.count))
    for candidate in ranked:
        is_other = not any(candidate.has_sensor_of(sensor) for sensor in sensors)
        if candidate.is_of_sensor and is_other:
            sensors.append(candidate)
    return sensors


def _unclear(
    topics: Sequence[TopicInfo],
    sensors: Sequence[TopicInfo],
    missing: Sequence[str],
    edges: Collection[str],
) -> UnclearStreamsError:
    """Return the error about a bag without an obvious choice."""
    by_type: dict[str, list[TopicInfo]] = {}
    for topic in topics:
        by_type.setdefault(topic.type, []).append(topic)
    if not any(topic.count for topic in topics) and len(missing) > 1:
        return UnclearStreamsError("the bag has no messages: record again", {})
    if len(sensors) >= len(missing):
        what = f"{len(sensors)} topics have poses: {_listed(sensors)}"
        return UnclearStreamsError(what, _options(missing, [topic.name for topic in sensors]))
    clouds = by_type.get(messages.POINTS_TYPE, [])
    partners = [*by_type.get(_FIX, []), *clouds, *by_type.get(_IMU, [])]
    pairs = _separate_edges(edges)
    if sensors:
        what = f"only one topic has poses, {sensors[0]}"
        likeliest = [sensors[0].name, *[topic.name for topic in partners], *pairs]
        advice = "record the odometry of the other sensor"
    elif len(pairs) >= len(missing):
        what = (
            f"no topic has poses, but transforms have: {shortened(listing(pairs), _LONGEST_LIST)}"
        )
        likeliest = pairs
    elif len(clouds) >= len(missing):
        what = f"no topic has poses; the odometry of lidars can be computed from {_listed(clouds)}"
        likeliest = [topic.name for topic in clouds]
    else:
        what = "no topic has poses"
        likeliest = []
        advice = _advice(by_type)
    if len(likeliest) >= len(missing):
        return UnclearStreamsError(what, _options(missing, likeliest))
    listed = f"The bag has {_listed(topics)}" if topics else "The bag has no other topics"
    return UnclearStreamsError(f"{what}: {advice}. {listed}", {})


def _advice(by_type: Mapping[str, Sequence[TopicInfo]]) -> str:
    """Return what to do with a bag that has no poses."""
    if messages.POINTS_TYPE in by_type:
        return "run the odometry of both sensors and record it; clouds of one lidar are one stream"
    if {*messages.IMAGE_TYPES} & {*by_type}:
        return "run visual odometry or SLAM on the images, and record its poses"
    if _FIX in by_type and _IMU in by_type:
        return "GNSS and IMU need the poses of another sensor: record its odometry or SLAM"
    return "run the odometry or SLAM of both sensors, and record it"


def _separate_edges(edges: Collection[str]) -> list[str]:
    """Return edges WORLD:SENSOR that share no frame, because each sensor has its own world."""
    separate: list[str] = []
    used: set[str] = set()
    for edge in sorted(edges):
        frames = {*edge.split(":")}
        if not frames & used:
            separate.append(edge)
            used |= frames
    return separate


def _options(missing: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Return the options that name the likeliest topics for the missing streams."""
    likeliest = [*names[: len(missing)]]
    if len(likeliest) > 1:
        likeliest = roles.parent_and_child(likeliest, {}, {})
    return {f"{stream}_topic": name for stream, name in zip(missing, likeliest, strict=True)}


def _listed(topics: Sequence[TopicInfo]) -> str:
    return shortened(listing([str(topic) for topic in topics]), _LONGEST_LIST)
