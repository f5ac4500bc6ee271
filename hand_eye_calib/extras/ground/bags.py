"""Read the verticals of both sensors from a bag: from clouds of a lidar or IMU data."""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError, NotEnoughDataError
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.core.geometry.frames import StreamFrames
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.extras.ground.joining import VerticalPair
from hand_eye_calib.extras.ground.tracks import (
    Source,
    VerticalTrack,
    gravity_from_accelerations,
    ground_from_clouds,
)
from hand_eye_calib.formats.bags.messages import POINTS_TYPE, ns_of
from hand_eye_calib.formats.bags.points import rows_of_points, topics_and_frames
from hand_eye_calib.formats.bags.reader import PoseBag

_IMU = "sensor_msgs/msg/Imu"

# Largest number of scans that are used, evenly spaced in time.
_MAX_SCANS = 300

# Longest time (ns) before the first pose and after the last one for which poses are extrapolated:
# an odometry may begin some scans after the clouds.
_EXTRAPOLATED_NS = 1_000_000_000


# Quantity that the messages of a type measure.
_QUANTITIES = {POINTS_TYPE: "ground", _IMU: "gravity"}


def verticals_of_bag(
    paths: Sequence[Path], snapshot: Any
) -> tuple[tuple[VerticalPair, ...], list[str]]:
    """Return the verticals of both sensors of a bag, and notes for the user.

    The result is empty if a sensor has neither clouds nor IMU data.

    A topic belongs to a sensor if its ``frame_id`` is the frame of the poses of this sensor. Clouds
    are preferred to IMU data, because the ground also determines the height.

    Parameters
    ----------
    paths : sequence of Path
    snapshot : Snapshot
        Streams and options of the calibration.
    """
    config = snapshot.config
    fewest_poses = min(map(len, snapshot.streams))
    if config.measured != "poses" or fewest_poses < config.min_pairs:
        return (), []
    with PoseBag(*paths) as bag:
        topics_of = _topics_by_frame(bag)
        parent = _topic_of(snapshot.parent_names, topics_of)
        child = _topic_of(snapshot.child_names, topics_of)
        if not (parent and child):
            return (), []
        topics = (parent, child)
        has_imu = any(bag.topics[topic].type == _IMU for topic in topics)
        # If the other sensor is an IMU, a lidar needs a wider lane.
        other_source: Source = "gravity" if has_imu else "ground"
    tracks = []
    for topic, stream in zip(topics, snapshot.streams, strict=True):
        try:
            tracks.append(
                _track_of_bag(tuple(paths), topic, stream, other_source)
            )
        except (InputError, NotEnoughDataError) as error:
            return (), [f"ground and gravity are not used: {topic}: {error}"]
    sources = []
    for track, topic in zip(tracks, topics, strict=True):
        sources.append(f"{track.source} from {topic}")
    text = (
        f"{listing(sources)} are used; to use the motion alone, set ground off"
    )
    return (VerticalPair(*tracks),), [text]


def _topics_by_frame(bag: PoseBag) -> Mapping[str, str]:
    """Return one topic per frame: clouds if there are any, otherwise IMU data.

    If a frame has several topics of a type, the topic with most messages is returned.
    """
    topics_of: dict[str, str] = {}
    for topic, (_, frame) in vertical_topics(bag).items():
        topics_of.setdefault(frame, topic)
    return topics_of


def vertical_topics(bag: PoseBag) -> dict[str, tuple[str, str]]:
    """Return the quantity ("ground" or "gravity") and the frame of clouds and IMU data, by topic.

    Topics with clouds are first. Topics of a type are sorted by their numbers of messages.
    """
    topics: dict[str, tuple[str, str]] = {}
    for message_type, quantity in _QUANTITIES.items():
        for topic, frame in topics_and_frames(bag, message_type):
            topics[topic] = quantity, frame
    return topics


def _topic_of(names: StreamFrames, topics_of: Mapping[str, str]) -> str:
    """Return the topic in the frame of a sensor; an empty text if there is none."""
    return topics_of.get(names.sensor) or topics_of.get(names.option) or ""


@lru_cache(maxsize=2)
def _track_of_bag(
    paths: tuple[Path, ...],
    topic: str,
    stream: Trajectory,
    other_source: Source,
) -> VerticalTrack:
    """Return the vertical from a topic of a bag.

    The result is cached: all pairs of a rig need the vertical of the first sensor.

    For the parameters see :func:`vertical_track`.
    """
    with PoseBag(*paths) as bag:
        return vertical_track(bag, topic, stream, other_source)


def vertical_track(
    bag: PoseBag, topic: str, stream: Trajectory, other_source: Source
) -> VerticalTrack:
    """Return the vertical from the clouds or IMU data of a topic.

    ``stream`` contains the poses of the sensor. ``other_source`` is the quantity that the other
    sensor measures.
    """
    if bag.topics[topic].type == POINTS_TYPE:
        clouds = _clouds(bag, topic, stream)
        return ground_from_clouds(clouds, stream, other_source)
    stamps_ns = []
    forces = []
    for message in _messages(bag, topic, 0):
        force = message.linear_acceleration
        stamps_ns.append(ns_of(message.header.stamp))
        forces.append([force.x, force.y, force.z])
    return gravity_from_accelerations(
        np.array(stamps_ns, dtype=np.int64),
        np.array(forces),
        stream,
    )


def _clouds(
    bag: PoseBag, topic: str, stream: Trajectory
) -> Iterator[tuple[int, FloatArray]]:
    """Yield the stamp (ns) and the finite points (N, 3), m, of at most ``_MAX_SCANS`` scans.

    Scans before and after the poses of the stream are skipped: it may be a part of the recording.
    """
    first_ns = stream.stamps_ns[0] - _EXTRAPOLATED_NS
    last_ns = stream.stamps_ns[-1] + _EXTRAPOLATED_NS
    every_ns = bag.duration_s / _MAX_SCANS * 1e9
    for message in _messages(bag, topic, every_ns):
        stamp_ns = ns_of(message.header.stamp) or 0
        if not first_ns <= stamp_ns <= last_ns:
            continue
        rows = rows_of_points(message)
        columns = [rows[axis] for axis in "xyz"]
        points = np.stack(columns, axis=-1).astype(float)
        is_finite = np.isfinite(points).all(axis=1)
        yield stamp_ns, points[is_finite]


def _messages(bag: PoseBag, topic: str, every_ns: float) -> Iterator[Any]:
    """Yield the decoded messages of a topic that are at least ``every_ns`` apart."""
    next_ns = 0.0
    for run in bag.runs([topic]):
        used = []
        for row, bag_ns in enumerate(run.bag_ns.tolist()):
            if bag_ns >= next_ns:
                used.append(row)
                next_ns = bag_ns + every_ns
        used_run = run._replace(
            messages=[run.messages[row] for row in used],
            bag_ns=run.bag_ns[used],
        )
        yield from used_run.decoded()
