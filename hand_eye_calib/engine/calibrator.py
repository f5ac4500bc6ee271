"""The calibrator: poses of two streams in, the extrinsic out.

The one engine of the node, of the replay of bags and of the Python API. It knows neither ROS nor
files.
"""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hand_eye_calib.alignment.time_offset import TimeOffset
from hand_eye_calib.arrays import IntArray
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.estimation import fixed_time_offset
from hand_eye_calib.engine.snapshot import (
    STREAMS,
    RawPoses,
    Snapshot,
    downsample,
    estimated_time_offset,
    name_frames,
    pair_poses,
)
from hand_eye_calib.errors import InputError, NotEnoughDataError
from hand_eye_calib.geometry.frames import check_pose
from hand_eye_calib.geometry.trajectory import REACH
from hand_eye_calib.pairing.synchronise import PosePairs, slower_stream
from hand_eye_calib.results.calibration import Calibration

# Share of the poses that are paired if a buffer is full.
_PAIRED_IF_FULL = 0.9


@dataclass(frozen=True, kw_only=True)
class BufferLimits:
    """Limits of the buffers, and when poses are made into pairs.

    Attributes
    ----------
    capacity : int
        Most poses of a stream. A buffer fills up if the other stream lags behind, or if the time
        offset is still to be estimated; then all but a tenth are paired.
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
    """What a stream has delivered in this session: poses taken; refused, as the stream had a pose
    with that stamp, or as older ones than those were paired and dropped already; and dropped, as
    the other stream had none at their time. The range of the stamps taken.
    """

    received: int = 0
    refused_duplicate: int = 0
    refused_late: int = 0
    dropped_unpaired: int = 0
    first_stamp_ns: int | None = None
    last_stamp_ns: int | None = None

    def note(self, stamp_ns: int) -> None:
        """Count a pose that was taken."""
        self.received += 1
        if self.first_stamp_ns is None or self.last_stamp_ns is None:
            self.first_stamp_ns = self.last_stamp_ns = stamp_ns
        elif stamp_ns > self.last_stamp_ns:
            self.last_stamp_ns = stamp_ns
        else:
            self.first_stamp_ns = min(self.first_stamp_ns, stamp_ns)

    def to_dict(self) -> dict[str, int | None]:
        """What a result says of its inputs."""
        values = {name: each for name, each in vars(self).items() if name != "dropped_unpaired"}
        return {"messages": values.pop("received"), **values}


class PoseBuffer:
    """Poses of one sensor, in order of their stamps.

    Attributes
    ----------
    frame : str
        Name of the sensor frame; empty until it is known.
    statistics : StreamStatistics
    """

    def __init__(self, limits: BufferLimits) -> None:
        self._limits = limits
        self._stamps_ns = np.empty(limits.capacity, dtype=np.int64)
        self._poses = np.empty((limits.capacity, 7))  # x y z qx qy qz qw
        self._count = 0
        self._dropped_until_ns = -(2**63)
        self.frame = ""
        self.statistics = StreamStatistics()

    def __len__(self) -> int:
        return self._count

    @property
    def stamps_ns(self) -> IntArray:
        """(N,) int64 array: the stamps, valid until the buffer changes."""
        return self._stamps_ns[: self._count]

    @property
    def is_full(self) -> bool:
        """Whether there is no room for another pose."""
        return self._count == self._limits.capacity

    @property
    def pairing_is_due(self) -> bool:
        """Whether it is time to make a batch of pairs."""
        is_many = self._count > self._limits.pairing_starts
        return is_many and self.statistics.received % self._limits.batch_every == 0

    def add(self, stamp_ns: int, position: Any, quat_xyzw: Any) -> bool:
        """Take a pose; False if the stamp is a duplicate or too late."""
        if stamp_ns <= self._dropped_until_ns:
            self.statistics.refused_late += 1
            return False
        index, end = self._count, self._count
        if index and stamp_ns <= self._stamps_ns[index - 1]:
            index = int(np.searchsorted(self.stamps_ns, stamp_ns))
            if self._stamps_ns[index] == stamp_ns:
                self.statistics.refused_duplicate += 1
                return False
            self._stamps_ns[index + 1 : end + 1] = self._stamps_ns[index:end]
            self._poses[index + 1 : end + 1] = self._poses[index:end]
        self._stamps_ns[index] = stamp_ns
        self._poses[index, :3], self._poses[index, 3:] = position, quat_xyzw
        self._count += 1
        self.statistics.note(stamp_ns)
        return True

    def stamp_at(self, share: float) -> int:
        """Stamp below which this share of the poses lies."""
        return self.stamp_of(int(share * (self._count - 1)))

    def stamp_of(self, index: int) -> int:
        """Stamp of a pose, or of the newest if there are not so many."""
        return int(self._stamps_ns[min(index, self._count - 1)])

    def poses(self, until_ns: int | None = None) -> RawPoses:
        """The poses, copied: all, or those up to a stamp and the ones after it that interpolation
        up to it looks at.
        """
        end = self._count
        if until_ns is not None:
            after = int(np.searchsorted(self.stamps_ns, until_ns, side="right"))
            end = min(after + REACH, self._count)
        return RawPoses(self._stamps_ns[:end].copy(), self._poses[:end].copy())

    def drop(self, until_ns: int, unpaired: bool = False) -> None:
        """Drop poses up to and including a stamp, except the last of them that interpolation up to
        the next pose looks at.
        """
        after = int(np.searchsorted(self.stamps_ns, until_ns, side="right"))
        split = max(after - REACH, 0)
        if unpaired:
            self.statistics.dropped_unpaired += split
        rest = self._count - split
        self._stamps_ns[:rest] = self._stamps_ns[split : self._count].copy()
        self._poses[:rest] = self._poses[split : self._count].copy()
        self._count = rest
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
        self._config = config or CalibratorConfig()
        self._limits = limits or BufferLimits()
        self.reset()

    @property
    def config(self) -> CalibratorConfig:
        """The CalibratorConfig in use."""
        return self._config

    def reset(self) -> None:
        """Forget all poses, frames and statistics."""
        self._buffers = {stream: PoseBuffer(self._limits) for stream in STREAMS}
        self._forget_pairs()

    def _forget_pairs(self) -> None:
        self._kept_parts = [PosePairs.empty()]
        self._paired_at: str | None = None
        self._time_offset: TimeOffset | None = None
        self._proposed_offset: TimeOffset | None = None

    def reconfigure(self, config: CalibratorConfig) -> None:
        """Use other options. Poses are kept, except pairs made with another time offset."""
        if config.time_offset != self._config.time_offset:
            self._forget_pairs()
        self._config = config

    def inputs(self, topics: Mapping[str, object]) -> dict[str, Any]:
        """Where a result came from, in plain values: options, and streams by their topics."""
        streams = {
            stream: {"topic": str(topic), **self.statistics(stream).to_dict()}
            for stream, topic in topics.items()
        }
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
        known = self._buffers[stream].frame
        if getattr(self._config, f"{stream}_frame") or (sensor_frame and sensor_frame == known):
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
        check_pose(*position, *quat_xyzw)
        buffer = self._buffers[stream]
        if buffer.is_full:
            self._make_pairs(_PAIRED_IF_FULL)
            for each in self._buffers.values():
                if each.is_full:
                    # The other stream has no poses at these times: they cannot be paired.
                    each.drop(each.stamp_at(0.5), unpaired=True)
        elif buffer.pairing_is_due:
            self._make_pairs()
        return buffer.add(stamp_ns, position, quat_xyzw)

    def snapshot(self) -> Snapshot:
        """All that is known now, for an estimate in this or another thread."""
        parent, child = self._buffers["parent"], self._buffers["child"]
        parent_frame, child_frame, warnings = name_frames(
            self._config, {"parent": parent.frame, "child": child.frame}
        )
        return Snapshot(
            config=self._config,
            kept=self._kept,
            buffered_parent=parent.poses(),
            buffered_child=child.poses(),
            paired_at=self._paired_at,
            parent_frame=parent_frame,
            child_frame=child_frame,
            warnings=warnings,
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

    def _make_pairs(self, settled_share: float | None = None) -> None:
        """Make the oldest poses into pairs, keep the pairs, and drop the poses.

        Poses are settled if no late arrivals are expected among them: those older than the newest
        by a while, or the given share of them; at most a batch.
        """
        parent, child = self._buffers["parent"], self._buffers["child"]
        config = self._config_with_time_offset(estimate=settled_share is not None)
        if config is None or not len(parent) or not len(child):
            return
        offset_ns, limits = round(fixed_time_offset(config) * 1e9), self._limits

        def settled_until_ns(buffer: PoseBuffer) -> int:
            late_ns = limits.late_ns if settled_share is None else 0
            newest_ns = buffer.stamp_at(1.0 if settled_share is None else settled_share)
            return min(newest_ns - late_ns, buffer.stamp_of(limits.batch))

        horizon_ns = min(settled_until_ns(parent), settled_until_ns(child) + offset_ns)
        if settled_share is None:
            # At least half a batch of the longer buffer is settled.
            longer, ahead_ns = (parent, 0) if len(parent) >= len(child) else (child, offset_ns)
            if horizon_ns < longer.stamp_of(limits.batch // 2) + ahead_ns:
                return
        if self._paired_at is None:
            self._paired_at = slower_stream(parent.stamps_ns, child.stamps_ns)
        of_parent = parent.poses(horizon_ns).trajectory
        of_child = child.poses(horizon_ns - offset_ns).trajectory
        of_child = self._time_offset.steadied(of_child) if self._time_offset else of_child
        made = pair_poses(config, of_parent, of_child, self._paired_at, self._kept_parts[-1])
        made = made[made.stamps_ns <= horizon_ns]
        if len(made):
            self._kept_parts.append(made)
            if sum(map(len, self._kept_parts)) > self._config.max_pairs:
                self._kept_parts = [downsample(self._kept, self._config.max_pairs)]
        unpaired = parent.stamp_of(0) > horizon_ns or child.stamp_of(0) + offset_ns > horizon_ns
        parent.drop(horizon_ns, unpaired=unpaired)
        child.drop(horizon_ns - offset_ns, unpaired=unpaired)

    @property
    def _kept(self) -> PosePairs:
        """All pose pairs made so far. They come in parts, which are concatenated on demand."""
        if len(self._kept_parts) > 1:
            self._kept_parts = [PosePairs.concatenate(*self._kept_parts)]
        return self._kept_parts[0]

    def _config_with_time_offset(self, estimate: bool) -> CalibratorConfig | None:
        """The options with a time offset in seconds; None if it cannot be estimated, or need not be
        yet.
        """
        if not isinstance(self._config.time_offset, str):
            return self._config
        if self._time_offset is None and estimate:
            parent, child = self._buffers["parent"].poses(), self._buffers["child"].poses()
            with contextlib.suppress(NotEnoughDataError):
                self._time_offset = self._proposed_offset or estimated_time_offset(
                    self._config, parent.trajectory, child.trajectory
                )
        found = self._time_offset
        return replace(self._config, time_offset=found.seconds) if found else None
