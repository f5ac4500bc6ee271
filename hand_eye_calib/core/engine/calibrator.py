"""The calibrator: poses of two streams in, the extrinsic out.

The one engine of the node, of the replay of bags and of the Python API. It knows neither ROS nor
files.
"""

import contextlib
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
from hand_eye_calib.core.geometry.trajectory import REACH, Trajectory
from hand_eye_calib.core.pairing.motion_pairs import PosePairs, slower_stream
from hand_eye_calib.core.results.calibration import Calibration


@dataclass(frozen=True, kw_only=True)
class BufferLimits:
    """Limits of the buffers, and when poses are made into pairs.

    Attributes
    ----------
    capacity : int
        Most poses of a stream. A buffer fills up if the other stream lags behind, or if the time
        offset is still to be estimated; then a batch is paired, or half of the buffer dropped.
    pairing_starts : int
        Number of poses from which on the oldest are made into pairs. Until then, messages may come
        in any order: 20 s at 100 Hz.
    batch, batch_every : int
        Most poses that are made into pairs at once, and how many new poses come between two
        batches. Small batches keep the time of a single pose below a few milliseconds.
    late_ns : int
        Poses closer than this to the newest of their stream are not paired yet, in case others
        arrive late.
    """

    capacity: int = 20_000
    pairing_starts: int = 2_000
    batch: int = 256
    batch_every: int = 32
    late_ns: int = 1_000_000_000


@dataclass(kw_only=True)
class StreamStatistics:
    """What a stream has delivered in this session, in numbers of poses.

    Taken; refused, because there was a pose with that stamp, or because later poses were paired and
    dropped already; dropped, because the other stream had no poses at their times. And the range of
    the stamps that were taken.
    """

    received: int = 0
    refused_duplicate: int = 0
    refused_late: int = 0
    dropped_unpaired: int = 0
    first_stamp_ns: int | None = None
    last_stamp_ns: int | None = None


# Numbers of a pose.
_WIDTH = 7


class _PoseBuffer:
    """Poses of one sensor, in order of their stamps; the names of its frame and of its world,
    empty until they are known; and its statistics.
    """

    def __init__(self) -> None:
        # Arrays of Python take poses one by one as fast as lists, and become NumPy's at once.
        self.stamps_ns = array("q")
        self._poses = array("d")  # x y z qx qy qz qw
        self._dropped_until_ns = -(2**63)
        self.frame = ""
        self.world = ""
        self.statistics = StreamStatistics()

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def add(self, stamp_ns: int, pose: tuple[float, ...]) -> bool:
        """Take a pose; False if the stamp is a duplicate or too late."""
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
        first_ns = counts.first_stamp_ns
        last_ns = counts.last_stamp_ns
        counts.first_stamp_ns = stamp_ns if first_ns is None else min(first_ns, stamp_ns)
        counts.last_stamp_ns = stamp_ns if last_ns is None else max(last_ns, stamp_ns)
        return True

    def stamp_of(self, index: int) -> int:
        """Stamp of a pose, or of the newest if there are not so many."""
        return self.stamps_ns[min(index, len(self) - 1)]

    def trajectory(self, until_ns: int = 2**63) -> Trajectory:
        """The poses up to a stamp, and the ones after it that interpolation up to it looks at."""
        end = bisect_right(self.stamps_ns, until_ns) + REACH
        poses = np.array(self._poses[: _WIDTH * end]).reshape(-1, _WIDTH)
        stamps_ns = np.array(self.stamps_ns[:end], dtype=np.int64)
        return Trajectory.from_quat_xyzw(stamps_ns, poses[:, :3], poses[:, 3:])

    def drop(self, until_ns: int, unpaired: bool) -> None:
        """Drop poses up to and including a stamp, except the last of them that interpolation up to
        the next pose looks at.
        """
        split = max(bisect_right(self.stamps_ns, until_ns) - REACH, 0)
        self.statistics.dropped_unpaired += split * unpaired
        del self.stamps_ns[:split], self._poses[: _WIDTH * split]
        self._dropped_until_ns = until_ns


class Calibrator:
    """Collects the poses of both streams and estimates T_parent_child from them.

    Poses may come at any rate and in any order. They are paired at the slower stream's stamps. The
    other stream is interpolated along the geodesic of SE(3), never extrapolated and never across a
    gap of more than ``max_gap``. Memory is bounded: a buffer per stream and at most ``max_pairs``
    pose pairs.

    Parameters
    ----------
    config : CalibratorConfig, optional
        In use until :meth:`reconfigure`.
    limits : BufferLimits, optional

    Examples
    --------
    >>> calibrator = hec.Calibrator(hec.CalibratorConfig(reference="B5"))
    >>> calibrator.add_pose("parent", 1_700_000_000_000_000_000, [0, 0, 0], [0, 0, 0, 1])
    True
    """

    def __init__(
        self, config: CalibratorConfig | None = None, limits: BufferLimits | None = None
    ) -> None:
        self.config = config or CalibratorConfig()
        self._limits = limits or BufferLimits()
        self.reset()

    def reset(self) -> None:
        """Forget all poses, frames and statistics."""
        self._buffers = {stream: _PoseBuffer() for stream in STREAMS}
        self._forget_pairs()

    def _forget_pairs(self) -> None:
        self._kept_parts = [PosePairs.empty()]
        self._paired_at: str | None = None
        self._time_offset: TimeOffset | None = None
        self._proposed_offset: TimeOffset | None = None

    def reconfigure(self, config: CalibratorConfig) -> None:
        """Use other options. Poses are kept, except pairs made with another time offset."""
        if config.time_offset != self.config.time_offset:
            self._forget_pairs()
        self.config = config

    def inputs(self, topics: Mapping[str, object]) -> Document:
        """Where a result came from, in plain values: options, and streams by their topics."""
        streams = {}
        for stream, topic in topics.items():
            counts = asdict(self._buffers[stream].statistics)
            streams[stream] = {"topic": str(topic), "messages": counts.pop("received"), **counts}
        return {"options": self.config.to_options(), **streams}

    def statistics(self, stream: str) -> StreamStatistics:
        """StreamStatistics of "parent" or "child"."""
        return replace(self._buffers[stream].statistics)

    def frame(self, stream: str) -> str:
        """Name of a stream's sensor frame, as its messages give it; empty if it is not known."""
        return self._buffers[stream].frame

    def set_frame(self, stream: str, sensor_frame: str) -> None:
        """Set the name of a stream's sensor frame, as its messages give it. An option that names
        the frame overrides this.

        Raises
        ------
        InputError
            If the name is empty, or another than before.
        """
        sensor_frame = frame_name(sensor_frame)
        known = self._buffers[stream].frame
        if getattr(self.config, f"{stream}_frame"):
            self._buffers[stream].frame = known or sensor_frame
            return
        if sensor_frame and sensor_frame == known:
            return
        if not sensor_frame:
            raise InputError(
                f"the {stream} stream's sensor frame is empty; name it with {stream}_frame"
            )
        if known:
            raise InputError(
                f"the {stream} stream's sensor frame changed from {known!r} to {sensor_frame!r}; "
                "one stream must be one sensor"
            )
        self._buffers[stream].frame = sensor_frame

    def world(self, stream: str) -> str:
        """Name of the frame in which a stream's poses are; empty if it is not known."""
        return self._buffers[stream].world

    def set_world(self, stream: str, world_frame: str) -> None:
        """Set the name of the frame in which a stream's poses are; the first one stays."""
        buffer = self._buffers[stream]
        buffer.world = buffer.world or frame_name(world_frame)

    def add_pose(
        self,
        stream: str,
        stamp_ns: int,
        position: Sequence[float],
        quat_xyzw: Sequence[float],
    ) -> bool:
        """Take a pose of a sensor in its own world.

        Parameters
        ----------
        stream : {"parent", "child"}
        stamp_ns : int
            On the stream's own clock.
        position : sequence of 3 floats
            Metres.
        quat_xyzw : sequence of 4 floats
            Scalar last, unit length to 1 %.

        Returns
        -------
        bool
            False if the pose was refused because its stamp is a duplicate or too late;
            :meth:`statistics` counts them.

        Raises
        ------
        InputError
            If a value is not finite or the quaternion is not of unit length.
        """
        is_unit = abs(math.hypot(*quat_xyzw) - 1.0) <= trajectory.QUATERNION_NORM_TOLERANCE
        if not (is_unit and math.hypot(*position) <= trajectory.FARTHEST_M):
            check_pose(*position, *quat_xyzw)  # says what is wrong, if anything is
        buffer = self._buffers[stream]
        limits = self._limits
        is_full = len(buffer) >= limits.capacity
        is_due = buffer.statistics.received % limits.batch_every == 0
        if is_full or (is_due and len(buffer) > limits.pairing_starts):
            self._make_pairs(is_full)
        if len(buffer) >= limits.capacity:
            # The other stream has no poses at these times: they cannot be paired.
            buffer.drop(buffer.stamp_of(len(buffer) // 2), unpaired=True)
        return buffer.add(int(stamp_ns), (*position, *quat_xyzw))

    def snapshot(self) -> Snapshot:
        """All that is known now, for an estimate in this or another thread."""
        parent = self._buffers["parent"]
        child = self._buffers["child"]
        config = self.config
        return Snapshot(
            config=config,
            kept=self._kept,
            buffered_parent=parent.trajectory(),
            buffered_child=child.trajectory(),
            paired_at=self._paired_at,
            parent_names=snapshots.names_of(config, "parent", parent.frame, parent.world),
            child_names=snapshots.names_of(config, "child", child.frame, child.world),
            time_offset=self._time_offset,
        )

    def take_pairs(self) -> PosePairs:
        """Give away the pose pairs made so far; only the last is kept, which the next ones follow
        and the next call gives again.
        """
        made = self._kept
        self._kept_parts = [made[-1:]]
        return made

    def estimate(self) -> Calibration:
        """Estimate the extrinsic from all poses so far; errors as of `Snapshot.estimate`."""
        return self.snapshot().estimate()

    def adopt(self, found: TimeOffset | None) -> None:
        """Use the time offset of a resolved snapshot, if it has one, when one is needed: saves the
        time of estimating it again.
        """
        self._proposed_offset = found or self._proposed_offset

    def _make_pairs(self, is_full: bool) -> None:
        """Make the oldest poses into pairs, keep the pairs, and drop the poses: at most a batch, of
        poses so old that no late arrivals are expected among them. A time offset is estimated when
        a buffer is full.
        """
        parent = self._buffers["parent"]
        child = self._buffers["child"]
        limits = self._limits
        if not len(parent) or not len(child):
            return
        config = self.config
        if isinstance(config.time_offset, str):
            if self._time_offset is None and is_full:
                with contextlib.suppress(NotEnoughDataError):
                    self._time_offset = self._proposed_offset or snapshots.estimated_time_offset(
                        config, parent.trajectory(), child.trajectory()
                    )
            if self._time_offset is None:
                return
            config = replace(config, time_offset=self._time_offset.seconds)
        offset_ns = round(float(config.time_offset) * 1e9)
        if self._paired_at is None:
            self._paired_at = slower_stream(np.array(parent.stamps_ns), np.array(child.stamps_ns))
        horizon_ns = min(
            min(each.stamps_ns[-1] - limits.late_ns, each.stamp_of(limits.batch)) + ahead_ns
            for each, ahead_ns in ((parent, 0), (child, offset_ns))
        )
        of_child = child.trajectory(horizon_ns - offset_ns)
        of_child = self._time_offset.steadied(of_child) if self._time_offset else of_child
        made = snapshots.pair_poses(
            config, parent.trajectory(horizon_ns), of_child, self._paired_at, self._kept_parts[-1]
        )
        made = made[made.stamps_ns <= horizon_ns]
        if len(made):
            self._kept_parts.append(made)
            if sum(map(len, self._kept_parts)) > config.max_pairs:
                self._kept_parts = [snapshots.downsample(self._kept, config.max_pairs)]
        is_alone = max(parent.stamps_ns[0], child.stamps_ns[0] + offset_ns) > horizon_ns
        parent.drop(horizon_ns, unpaired=is_alone)
        child.drop(horizon_ns - offset_ns, unpaired=is_alone)

    @property
    def _kept(self) -> PosePairs:
        """All pose pairs made so far. They come in parts, which are concatenated on demand."""
        if len(self._kept_parts) > 1:
            self._kept_parts = [PosePairs.concatenate(*self._kept_parts)]
        return self._kept_parts[0]


class Calibrators(dict[str, Calibrator]):
    """Calibrators by child sensor: "child", and the names of further ones. All have the same parent
    sensor.
    """

    def takers(self, stream: str) -> list[tuple[str, Calibrator]]:
        """Who takes the poses of a stream, and as which: the parent's count for all children."""
        if stream == "parent":
            return [(stream, each) for each in self.values()]
        return [("child", self[stream])] if stream in self else []

    def statistics(self, stream: str) -> StreamStatistics:
        """What was taken of a stream."""
        own_stream, first = self.takers(stream)[0]
        return first.statistics(own_stream)

    def set_frame(self, stream: str, sensor_frame: str) -> None:
        """Set the name of a stream's sensor frame; see :meth:`Calibrator.set_frame`."""
        for own_stream, each in self.takers(stream):
            each.set_frame(own_stream, sensor_frame)

    def set_world(self, stream: str, world_frame: str) -> None:
        """Set the name of a stream's fixed frame; see :meth:`Calibrator.set_world`."""
        for own_stream, calibrator in self.takers(stream):
            calibrator.set_world(own_stream, world_frame)

    def add_pose(
        self, stream: str, stamp_ns: int, position: Sequence[float], quat_xyzw: Sequence[float]
    ) -> bool:
        """Take a pose, or not; see :meth:`Calibrator.add_pose`."""
        (own_stream, first), *others = self.takers(stream)
        is_taken = first.add_pose(own_stream, stamp_ns, position, quat_xyzw)
        for _, other in others if is_taken else ():
            other.add_pose(own_stream, stamp_ns, position, quat_xyzw)
        return is_taken
