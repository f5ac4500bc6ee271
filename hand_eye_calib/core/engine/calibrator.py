"""Calibrator: it collects the poses of two streams as they arrive, and pairs them.

The node, the replay of bags and the Python API use it.
"""

import math
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from hand_eye_calib.core.alignment.time_offset import TimeOffset
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import InputError, NotEnoughDataError
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.text import frame_name
from hand_eye_calib.core.engine import snapshot as snapshots
from hand_eye_calib.core.engine.snapshot import STREAMS, Snapshot
from hand_eye_calib.core.geometry import trajectory
from hand_eye_calib.core.geometry.frames import check_pose
from hand_eye_calib.core.geometry.interpolation import REACH
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import PosePairs, slower_stream
from hand_eye_calib.core.results.calibration import Calibration


@dataclass(frozen=True, kw_only=True)
class BufferLimits:
    """Limits of the buffers, and of the batches of poses that are paired.

    Attributes
    ----------
    capacity : int
        Largest number of poses in a buffer. A buffer is filled if the other stream is delayed, or
        before the time offset is estimated. If it is full, its oldest poses are paired. If this is
        impossible, half of its poses are dropped.
    pairing_starts : int
        The oldest poses are paired if more poses than this are buffered: 20 s at 100 Hz. Poses in
        the buffer may arrive in any order.
    batch : int
        Largest number of poses that are paired together. Small batches limit the time of adding a
        pose to a few milliseconds.
    batch_every : int
        Number of new poses between two batches.
    late_ns : int
        Poses within this time of the newest pose of their stream are not paired yet, because
        earlier poses may still arrive.
    """

    capacity: int = 20_000
    pairing_starts: int = 2_000
    batch: int = 256
    batch_every: int = 32
    late_ns: int = 1_000_000_000


@dataclass(kw_only=True)
class StreamStatistics:
    """Numbers of poses of a stream in this session.

    Attributes
    ----------
    received : int
        Number of accepted poses.
    refused_duplicate : int
        Number of poses that were refused because another pose has the same stamp.
    refused_late : int
        Number of poses that were refused because later poses were paired already.
    dropped_unpaired : int
        Number of accepted poses that were dropped because the other stream had no poses at that
        time.
    first_stamp_ns, last_stamp_ns : int or None
        Smallest and largest accepted stamp; None before the first pose.
    """

    received: int = 0
    refused_duplicate: int = 0
    refused_late: int = 0
    dropped_unpaired: int = 0
    first_stamp_ns: int | None = None
    last_stamp_ns: int | None = None


# Number of values of a pose: x y z qx qy qz qw.
_WIDTH = 7


class _PoseBuffer:
    """Poses of one sensor in order of their stamps, the names of its frames, and its statistics.

    The names of the frames are empty until a message with names is received.
    """

    def __init__(self) -> None:
        # Python's arrays append single poses as fast as lists, and NumPy can copy whole arrays.
        self.stamps_ns = array("q")
        self._poses = array("d")
        self._dropped_until_ns = -(2**63)
        self.frame = ""
        self.world = ""
        self.statistics = StreamStatistics()

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def add(self, stamp_ns: int, pose: tuple[float, ...]) -> bool:
        """Insert a pose (x y z qx qy qz qw). Return False if its stamp is a duplicate or late."""
        counts = self.statistics
        index = bisect_left(self.stamps_ns, stamp_ns)
        if stamp_ns <= self._dropped_until_ns:
            counts.refused_late += 1
            return False
        if index < len(self) and self.stamps_ns[index] == stamp_ns:
            counts.refused_duplicate += 1
            return False
        self.stamps_ns.insert(index, stamp_ns)
        self._poses[_WIDTH * index : _WIDTH * index] = array("d", pose)
        counts.received += 1
        if counts.first_stamp_ns is None or stamp_ns < counts.first_stamp_ns:
            counts.first_stamp_ns = stamp_ns
        if counts.last_stamp_ns is None or stamp_ns > counts.last_stamp_ns:
            counts.last_stamp_ns = stamp_ns
        return True

    def stamp_of(self, index: int) -> int:
        """Return the stamp (ns) of a pose; the newest stamp if the index is too large."""
        return self.stamps_ns[min(index, len(self) - 1)]

    def trajectory(self, until_ns: int = 2**63) -> Trajectory:
        """Return the poses up to a stamp, and the few later poses that interpolation needs."""
        end = bisect_right(self.stamps_ns, until_ns) + REACH
        values = np.array(self._poses[: _WIDTH * end])
        poses = values.reshape(-1, _WIDTH)
        stamps_ns = np.array(self.stamps_ns[:end], dtype=np.int64)
        return Trajectory.from_quat_xyzw(stamps_ns, poses[:, :3], poses[:, 3:])

    def drop(self, until_ns: int, unpaired: bool) -> None:
        """Drop the poses up to a stamp, except the last few for interpolation.

        Poses up to this stamp are refused afterwards. With ``unpaired``, the statistics count the
        poses as dropped.
        """
        split = max(bisect_right(self.stamps_ns, until_ns) - REACH, 0)
        if unpaired:
            self.statistics.dropped_unpaired += split
        del self.stamps_ns[:split], self._poses[: _WIDTH * split]
        self._dropped_until_ns = until_ns


class Calibrator:
    """Collect the poses of both streams and estimate T_parent_child from them.

    Poses may arrive at any rate and in any order. They are paired at the stamps of the slower
    stream. The poses of the other stream are interpolated along the geodesic of SE(3), but not
    outside of the stream, and not in gaps longer than ``max_gap``. Memory is bounded: one buffer
    per stream, and at most ``max_pairs`` pose pairs.

    Parameters
    ----------
    config : CalibratorConfig, optional
        Options until :meth:`reconfigure`.
    limits : BufferLimits, optional

    Examples
    --------
    >>> calibrator = hec.Calibrator(hec.CalibratorConfig(reference="B5"))
    >>> calibrator.add_pose("parent", 1_700_000_000_000_000_000, [0, 0, 0], [0, 0, 0, 1])
    True
    """

    def __init__(
        self,
        config: CalibratorConfig | None = None,
        limits: BufferLimits | None = None,
    ) -> None:
        self.config = config or CalibratorConfig()
        self._limits = limits or BufferLimits()
        self.reset()

    def reset(self) -> None:
        """Drop all poses, frames and statistics."""
        self._buffers = {stream: _PoseBuffer() for stream in STREAMS}
        self._drop_pairs()

    def _drop_pairs(self) -> None:
        """Drop all pose pairs and the estimated time offset. Poses in the buffers are kept."""
        self._kept_parts = [PosePairs.empty()]
        self._paired_at: str | None = None
        self._time_offset: TimeOffset | None = None
        self._proposed_offset: TimeOffset | None = None

    def reconfigure(self, config: CalibratorConfig) -> None:
        """Set other options. Poses are kept. If the time offset changes, pairs are dropped."""
        if config.time_offset != self.config.time_offset:
            self._drop_pairs()
        self.config = config

    def inputs(self, topics: Mapping[str, object]) -> Document:
        """Return the options, and topic and statistics of each stream, as plain values.

        ``topics`` maps "parent" and "child" to their topics.
        """
        streams = {}
        for stream, topic in topics.items():
            counts = asdict(self._buffers[stream].statistics)
            streams[stream] = {
                "topic": str(topic),
                "messages": counts.pop("received"),
                **counts,
            }
        return {"options": self.config.to_options(), **streams}

    def statistics(self, stream: str) -> StreamStatistics:
        """Return a copy of the statistics of "parent" or "child"."""
        return replace(self._buffers[stream].statistics)

    def frame(self, stream: str) -> str:
        """Return the name of a stream's sensor frame in messages; empty before the first."""
        return self._buffers[stream].frame

    def set_frame(self, stream: str, sensor_frame: str) -> None:
        """Set the name of a stream's sensor frame that its messages contain.

        The option ``parent_frame`` or ``child_frame`` overrides this name.

        Raises
        ------
        InputError
            If no option sets the name, and the name is empty or has changed.
        """
        sensor_frame = frame_name(sensor_frame)
        buffer = self._buffers[stream]
        if not getattr(self.config, f"{stream}_frame"):
            if not sensor_frame:
                raise InputError(
                    f"the {stream} stream's sensor frame is empty; name it with {stream}_frame"
                )
            if buffer.frame not in ("", sensor_frame):
                raise InputError(
                    f"the {stream} stream's sensor frame changed from {buffer.frame!r} to "
                    f"{sensor_frame!r}; one stream must be one sensor"
                )
        buffer.frame = buffer.frame or sensor_frame

    def world(self, stream: str) -> str:
        """Return the name of the fixed frame of a stream; empty before the first message."""
        return self._buffers[stream].world

    def set_world(self, stream: str, world_frame: str) -> None:
        """Set the name of the fixed frame of a stream. Once set, the name does not change."""
        buffer = self._buffers[stream]
        buffer.world = buffer.world or frame_name(world_frame)

    def add_pose(
        self,
        stream: str,
        stamp_ns: int,
        position: Sequence[float],
        quat_xyzw: Sequence[float],
    ) -> bool:
        """Add a pose of a sensor in its own world.

        Parameters
        ----------
        stream : {"parent", "child"}
        stamp_ns : int
            Stamp (ns) on the stream's own clock.
        position : sequence of 3 floats
            Position (m).
        quat_xyzw : sequence of 4 floats
            Quaternion, scalar last. Its length is 1 within 1 %.

        Returns
        -------
        bool
            False if the pose was refused, because its stamp is a duplicate or too late.
            :meth:`statistics` counts refused poses.

        Raises
        ------
        InputError
            If a value is not finite or the quaternion is not of unit length.
        """
        is_unit = (
            abs(math.hypot(*quat_xyzw) - 1.0)
            <= trajectory.QUATERNION_NORM_TOLERANCE
        )
        if not (is_unit and math.hypot(*position) <= trajectory.FARTHEST_M):
            # This raises an InputError with the reason.
            check_pose(*position, *quat_xyzw)
        buffer = self._buffers[stream]
        limits = self._limits
        is_full = len(buffer) >= limits.capacity
        is_due = buffer.statistics.received % limits.batch_every == 0
        if is_full or (is_due and len(buffer) > limits.pairing_starts):
            self._make_pairs(is_full)
        if len(buffer) >= limits.capacity:
            # The other stream has no poses at the times of the older half, so these poses cannot be
            # paired.
            buffer.drop(buffer.stamp_of(len(buffer) // 2), unpaired=True)
        return buffer.add(int(stamp_ns), (*position, *quat_xyzw))

    def snapshot(self) -> Snapshot:
        """Return the poses and options so far, for an estimate in any thread or process."""
        parent = self._buffers["parent"]
        child = self._buffers["child"]
        config = self.config
        return Snapshot(
            config=config,
            kept=self._kept,
            buffered_parent=parent.trajectory(),
            buffered_child=child.trajectory(),
            paired_at=self._paired_at,
            parent_names=snapshots.names_of(
                config, "parent", parent.frame, parent.world
            ),
            child_names=snapshots.names_of(
                config, "child", child.frame, child.world
            ),
            time_offset=self._time_offset,
        )

    def take_pairs(self) -> PosePairs:
        """Return the pose pairs made so far, and drop all of them except the last pair.

        New pairs must have later stamps than the last pair, so it is kept, and returned again by
        the next call.
        """
        pairs = self._kept
        self._kept_parts = [pairs[-1:]]
        return pairs

    def estimate(self) -> Calibration:
        """Estimate the extrinsic from all poses so far.

        Raises the errors of :meth:`~hand_eye_calib.core.engine.snapshot.Snapshot.estimate`.
        """
        return self.snapshot().estimate()

    def adopt(self, offset: TimeOffset | None) -> None:
        """Store a time offset that was estimated elsewhere, so that it is not estimated again."""
        self._proposed_offset = offset or self._proposed_offset

    def _make_pairs(self, is_full: bool) -> None:
        """Pair the oldest poses, at most one batch, and drop them from the buffers.

        Poses are paired only if no earlier poses are expected, see ``BufferLimits.late_ns``. If the
        time offset must be estimated, this happens when a buffer is full.
        """
        parent = self._buffers["parent"]
        child = self._buffers["child"]
        if not len(parent) or not len(child):
            return
        config = self.config
        if isinstance(config.time_offset, str):
            if self._time_offset is None and is_full:
                self._time_offset = self._estimated_offset()
            if self._time_offset is None:
                return
            config = replace(config, time_offset=self._time_offset.seconds)
        offset_ns = round(float(config.time_offset) * 1e9)
        if self._paired_at is None:
            self._paired_at = slower_stream(
                np.array(parent.stamps_ns), np.array(child.stamps_ns)
            )
        # Last stamp of the batch, on the parent's clock.
        horizon_ns = min(
            self._end_of_batch(parent), self._end_of_batch(child) + offset_ns
        )
        to_horizon = child.trajectory(horizon_ns - offset_ns)
        if self._time_offset:
            to_horizon = self._time_offset.steadied(to_horizon)
        pairs = snapshots.pair_poses(
            config,
            parent.trajectory(horizon_ns),
            to_horizon,
            self._paired_at,
            self._kept_parts[-1],
        )
        pairs = pairs[pairs.stamps_ns <= horizon_ns]
        if len(pairs):
            self._kept_parts.append(pairs)
            if sum(map(len, self._kept_parts)) > config.max_pairs:
                self._kept_parts = [
                    snapshots.downsample(self._kept, config.max_pairs)
                ]
        # One stream begins after this batch, so the poses of the other stream cannot be paired.
        is_alone = (
            max(parent.stamps_ns[0], child.stamps_ns[0] + offset_ns)
            > horizon_ns
        )
        parent.drop(horizon_ns, unpaired=is_alone)
        child.drop(horizon_ns - offset_ns, unpaired=is_alone)

    def _estimated_offset(self) -> TimeOffset | None:
        """Return the adopted time offset, or an estimate from the buffered poses if possible."""
        if self._proposed_offset:
            return self._proposed_offset
        parent = self._buffers["parent"].trajectory()
        child = self._buffers["child"].trajectory()
        try:
            return snapshots.estimated_time_offset(self.config, parent, child)
        except NotEnoughDataError:
            return None

    def _end_of_batch(self, buffer: _PoseBuffer) -> int:
        """Return the last stamp (ns) of a buffer that the next batch may contain."""
        newest_ns = buffer.stamps_ns[-1] - self._limits.late_ns
        return min(newest_ns, buffer.stamp_of(self._limits.batch))

    @property
    def _kept(self) -> PosePairs:
        """All pose pairs made so far."""
        # Concatenate the batches only when all pairs are needed.
        if len(self._kept_parts) > 1:
            self._kept_parts = [PosePairs.concatenate(*self._kept_parts)]
        return self._kept_parts[0]


class Calibrators(dict[str, Calibrator]):
    """Calibrators of several child sensors with one parent sensor.

    Keys are the child streams: "child", "child2" and so on.
    """

    def takers(self, stream: str) -> list[tuple[str, Calibrator]]:
        """Return the calibrators that use a stream, with their own names for this stream.

        All calibrators use the stream "parent". A child stream has the name "child" in its own
        calibrator.
        """
        if stream == "parent":
            return [(stream, calibrator) for calibrator in self.values()]
        return [("child", self[stream])] if stream in self else []

    def statistics(self, stream: str) -> StreamStatistics:
        """Return the statistics of a stream."""
        own_stream, first = self.takers(stream)[0]
        return first.statistics(own_stream)

    def set_frame(self, stream: str, sensor_frame: str) -> None:
        """Set the name of a stream's sensor frame; see :meth:`Calibrator.set_frame`."""
        for own_stream, calibrator in self.takers(stream):
            calibrator.set_frame(own_stream, sensor_frame)

    def set_world(self, stream: str, world_frame: str) -> None:
        """Set the name of a stream's fixed frame; see :meth:`Calibrator.set_world`."""
        for own_stream, calibrator in self.takers(stream):
            calibrator.set_world(own_stream, world_frame)

    def add_pose(
        self,
        stream: str,
        stamp_ns: int,
        position: Sequence[float],
        quat_xyzw: Sequence[float],
    ) -> bool:
        """Add a pose; see :meth:`Calibrator.add_pose`."""
        (own_stream, first), *others = self.takers(stream)
        is_accepted = first.add_pose(own_stream, stamp_ns, position, quat_xyzw)
        if is_accepted:
            for _, other in others:
                other.add_pose(own_stream, stamp_ns, position, quat_xyzw)
        return is_accepted
