"""Topics of bags: what is on them, which of them are meant, and what they measure."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.rates import RateIntegrator
from hand_eye_calib.io.bags.messages import (
    FIX_TYPE,
    IMU_TYPE,
    MALFORMED,
    MESSAGE_TYPES,
    OF_POSES,
    PATH_TYPE,
    POINT_TYPE,
    POSE_TYPES,
    SENSOR_TYPES,
    TF_TYPES,
    Buffer,
    MalformedMessage,
    unpack_one,
    unpack_path,
    unpack_poses,
    unpack_transforms,
)
from hand_eye_calib.io.bags.poses import PoseColumns, PoseFields
from hand_eye_calib.io.bags.recovery import MessageKind
from hand_eye_calib.io.trajectory_files.geodetic import LocalOrigin, wrong_latitude
from hand_eye_calib.io.transforms import TfSource

# A topic with fewer poses is not one of the two sensors: goals and initial poses are published
# once.
_FEWEST_POSES = 3

_POLE_DEG = 90.0 + 1e-9
_LEVEL = (0.0, 0.0, 0.0, 1.0)

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

    def described(
        self,
        frames: Iterable[tuple[str, str | None]],
        stamps_ns: tuple[int, int] | None,
        bag_duration_s: float,
    ) -> "TopicDescription":
        """With pairs of frames, and the first and last stamp if it has any."""
        is_usable = self.type in SENSOR_TYPES
        duration_s = bag_duration_s
        if is_usable and stamps_ns is not None:
            duration_s = (stamps_ns[1] - stamps_ns[0]) * 1e-9
        is_sampled = self.count > 1 and duration_s > 0
        return TopicDescription(
            *self,
            rate_hz=(self.count - 1) / duration_s if is_sampled else None,
            duration_s=duration_s if is_sampled else None,
            frames=[":".join(filter(None, pair)) for pair in sorted(frames, key=str)],
            is_usable=is_usable,
        )


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


def stamps_and_frames(
    kind: MessageKind, messages: Sequence[bytes], first_number: int
) -> tuple[IntArray, dict[tuple[str, str | None], None]]:
    """Stamps of the poses in messages of one kind (none of transforms), and the pairs of frames."""
    is_ros1 = kind.encoding == "ros1"
    if kind.type in POSE_TYPES:
        try:
            columns = unpack_poses(messages, kind.type, is_ros1)
        except MalformedMessage as error:
            raise unreadable(kind, first_number + error.index, error) from error
        pairs = zip(columns.world_frames, columns.sensor_frames, strict=True)
        return columns.stamps_ns, dict.fromkeys(pairs)
    found_ns, frames = [np.empty(0, dtype=np.int64)], dict[tuple[str, str | None], None]()
    for number, data in enumerate(messages, start=first_number):
        try:
            if kind.type == PATH_TYPE:
                world_frame, stamps_ns, _ = unpack_path(data, is_ros1)
                found_ns.append(stamps_ns)
                frames[world_frame, None] = None
            else:
                transforms = unpack_transforms(data, is_ros1)
                frames |= {(each.world_frame, each.sensor_frame): None for each in transforms}
        except MALFORMED as error:
            raise unreadable(kind, number, error) from error
    return np.concatenate(found_ns), frames


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
    if found not in SENSOR_TYPES:
        frames = (
            "; name two of its frames with --parent-tf and --child-tf" if found in TF_TYPES else ""
        )
        raise InputError(
            f"topic {source} of {bag} is of type {found or 'several types'}; accepted are "
            f"{', '.join(SENSOR_TYPES)}{frames}. {listing(topics, bag)}"
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


# ---- what the messages of a topic measure


def measured_as(message_type: str, wanted: str, source: object) -> str:
    """What messages of a type are read as: what is wanted, or the usual for "auto".

    Raises
    ------
    ConfigError
        If they cannot be read as that.
    """
    row = MESSAGE_TYPES.get(message_type)
    possible = row.measures if row else OF_POSES
    if wanted == "auto":
        return possible[0]
    if wanted not in possible:
        raise ConfigError(
            f"{source} has messages of type {message_type or 'tf2_msgs/msg/TFMessage'}, which "
            f"measure {' or '.join(possible)}; asked for are {wanted}"
        )
    return wanted


# What a row that is not finite lacks.
_LACKS = {"positions": "fix", "rotations": "orientation", "rates": "angular rates"}


class MessageReader:
    """Unpacks the messages of one topic, in their order, as poses: of what is no pose, the other
    part means nothing (level positions, rotations at the origin).

    Parameters
    ----------
    message_type, measures : str
        As of :func:`measured_as`.
    origin : LocalOrigin, optional
        Of latitudes and longitudes; the first one read by default.

    Attributes
    ----------
    n_left_out : int
        Messages without a fix or an orientation.
    """

    def __init__(self, message_type: str, measures: str, origin: LocalOrigin | None = None) -> None:
        self._type, self._measures = message_type, measures
        self._integrator, self._origin = RateIntegrator(), origin or LocalOrigin()
        self.n_left_out = 0

    def columns(self, messages: Sequence[Buffer], is_ros1: bool) -> PoseColumns:
        """The next messages; a row without a fix or an orientation is not finite.

        Raises
        ------
        MalformedMessage
            At the first that cannot be unpacked.
        InputError
            At the first latitude beyond 90 deg; its attribute ``index`` has the row.
        """
        columns = unpack_poses(messages, self._type, is_ros1)
        if self._measures == "poses":
            return columns
        values = columns.poses
        poses = np.zeros((len(values), 7))
        poses[:, 3:] = _LEVEL
        if self._type in POSE_TYPES:
            part = slice(3) if self._measures == "positions" else slice(3, 7)
            poses[:, part] = values[:, part]
            return columns._replace(poses=poses)
        if self._type == IMU_TYPE:
            values = values[:, 4:] if self._measures == "rates" else values[:, :4]
        is_usable = np.asarray(np.isfinite(values).all(axis=1), dtype=bool)
        self.n_left_out += int((~is_usable).sum())
        if is_usable.any():
            if self._type == FIX_TYPE:
                _check_latitudes(values, is_usable)
            part = slice(3) if self._measures == "positions" else slice(3, 7)
            poses[is_usable, part] = self._measured(columns.stamps_ns[is_usable], values[is_usable])
        poses[~is_usable] = np.nan
        columns = columns._replace(poses=poses)
        if self._type == POINT_TYPE:
            return columns
        # The frame of the header is the sensor's.
        return columns._replace(world_frames=[""] * len(poses), sensor_frames=columns.world_frames)

    def is_measured(self, poses: FloatArray) -> BoolArray:
        """Which rows of :meth:`columns` have what is measured; of poses all."""
        is_measured = np.asarray(~np.isnan(poses).any(axis=1), dtype=bool)
        return is_measured | np.full(len(poses), self._measures == "poses")

    def _measured(self, stamps_ns: IntArray, values: FloatArray) -> FloatArray:
        """Positions (N, 3) or quaternions (N, 4) of what was read."""
        if self._type == POINT_TYPE or self._measures == "rotations":
            return values
        if self._measures == "rates":
            return self._integrator.quats_xyzw(stamps_ns, values)
        lat, lon = np.radians(values[:, :2]).T
        return self._origin.local(lat, lon, values[:, 2])

    def __call__(self, data: Buffer) -> PoseFields:
        """The next message, in CDR, as it arrives.

        Raises
        ------
        InputError
            If it cannot be unpacked, or lacks what is measured.
        """
        try:
            if self._measures == "poses":
                stamp_ns, world, sensor, values = unpack_one(data, self._type, is_ros1=False)
                return PoseFields(stamp_ns, world, sensor, values[:3], values[3:])
            columns = self.columns([data], is_ros1=False)
        except InputError:
            raise
        except MALFORMED as error:
            raise InputError(f"not a message of type {self._type}: {error}") from error
        if not np.isfinite(columns.poses).all():
            raise InputError(f"the message has no {_LACKS[self._measures]}")
        stamps_ns, world_frames, sensor_frames, poses = columns
        position, quat_xyzw = poses[0, :3].tolist(), poses[0, 3:].tolist()
        frames = world_frames[0], sensor_frames[0]
        return PoseFields(int(stamps_ns[0]), *frames, position, quat_xyzw)


def _check_latitudes(values: FloatArray, rows: BoolArray) -> None:
    """Refuse latitudes (deg) beyond the poles, of some rows of latitude, longitude and height."""
    beyond = np.flatnonzero(rows & (np.abs(values[:, 0]) > _POLE_DEG))
    if len(beyond):
        error = InputError(wrong_latitude(*values[beyond[0], :2]))
        error.index = int(beyond[0])  # type: ignore[attr-defined]
        raise error
