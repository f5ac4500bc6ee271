"""The calibrator: poses of two streams in, the extrinsic out.

The one engine behind the node, the replay of bags and the Python function
:func:`~hand_eye_calib.engine.offline.calibrate`. It knows neither ROS nor files.
"""

import dataclasses
from bisect import bisect_left
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hand_eye_calib.alignment.angular_rates import Correlation
from hand_eye_calib.alignment.similarity import SimilarityFit
from hand_eye_calib.alignment.time_offset import TimeOffset, estimate_time_offset
from hand_eye_calib.checks.check import check_streams
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.estimation import estimate_extrinsic
from hand_eye_calib.errors import InputError, NotEnoughDataError
from hand_eye_calib.geometry.trajectory import QUATERNION_NORM_TOLERANCE, Trajectory
from hand_eye_calib.pairing.keyframes import select_keyframes
from hand_eye_calib.pairing.synchronise import PosePairs, slower_stream, synchronise

STREAMS = ("parent", "child")
ESTIMATE = "estimate"

# Raw poses of a stream that wait to be synchronised, at most. So many wait where the other stream
# lags behind, or where the time offset is still to be estimated.
_MAX_WAITING_POSES = 20_000

# From so many on, the oldest are made into pairs, a few at a time: no pose costs more than a few
# milliseconds. Within this horizon (20 s at 100 Hz) messages may come in any order.
_CROWDED_POSES = 2_000
_POSES_AT_A_TIME, _POSES_BETWEEN = 256, 32

# A quaternion's squared length.
_LEAST_NORM2, _MOST_NORM2 = (
    (1 - QUATERNION_NORM_TOLERANCE) ** 2,
    (1 + QUATERNION_NORM_TOLERANCE) ** 2,
)

# Checks look across gaps between pairs of up to so many usual intervals.
_FEW_INTERVALS = 4

# Poses this much older than the newest of their stream are not made into pairs yet, for the sake of
# latecomers. When the waiting room is full, the newest of this share are not.
_LATECOMERS_NS = 1_000_000_000
_SHARE_LEFT_WAITING = 0.1


@dataclass(frozen=True)
class StreamStatistics:
    """What a stream has delivered in this session.

    Attributes
    ----------
    received : int
        Poses taken.
    refused_duplicate : int
        Poses with a stamp the stream already had.
    refused_late : int
        Poses older than what has already been synchronised and let go.
    dropped_unpaired : int
        Poses let go because the other stream had nothing at their time.
    first_stamp_ns, last_stamp_ns : int or None
        Range of the stamps taken.
    """

    received: int = 0
    refused_duplicate: int = 0
    refused_late: int = 0
    dropped_unpaired: int = 0
    first_stamp_ns: int | None = None
    last_stamp_ns: int | None = None


@dataclass(frozen=True)
class RawPoses:
    """Poses as they came in, in order of time.

    Attributes
    ----------
    stamps_ns : (N,) int64 array
    poses : (N, 7) array
        x y z qx qy qz qw.
    """

    stamps_ns: np.ndarray
    poses: np.ndarray

    def __len__(self):
        return len(self.stamps_ns)

    @cached_property
    def trajectory(self):
        """The same as a Trajectory; this is the expensive part."""
        return Trajectory.from_quat_xyzw(self.stamps_ns, self.poses[:, :3], self.poses[:, 3:])


class UnusablePose(InputError):
    """One of many poses cannot be used: its ``index`` among them, and why."""

    def __init__(self, index, reason):
        super().__init__(str(reason))
        self.index = index


class _Stream:
    """Poses of one sensor that wait to be synchronised, in order of their stamps."""

    def __init__(self):
        self._stamps_ns = np.empty(_MAX_WAITING_POSES, dtype=np.int64)
        self._poses = np.empty((_MAX_WAITING_POSES, 7))  # x y z qx qy qz qw
        self._count = 0
        self._let_go_until_ns = None
        self.frame = ""
        self._received = self._refused_duplicate = self._refused_late = self._dropped_unpaired = 0
        self._first_ns = self._last_ns = None  # of all stamps taken

    @property
    def statistics(self):
        """StreamStatistics so far."""
        return StreamStatistics(
            self._received,
            self._refused_duplicate,
            self._refused_late,
            self._dropped_unpaired,
            self._first_ns,
            self._last_ns,
        )

    def add(self, stamp_ns, position, quat_xyzw):
        """Take a pose; False where its stamp is taken or too old."""
        if self._let_go_until_ns is not None and stamp_ns <= self._let_go_until_ns:
            self._refused_late += 1
            return False
        index = self._count
        if self._last_ns is None:
            self._first_ns = self._last_ns = stamp_ns
        elif stamp_ns > self._last_ns:
            self._last_ns = stamp_ns
        else:
            index = int(np.searchsorted(self._stamps_ns[: self._count], stamp_ns))
            if index < self._count and self._stamps_ns[index] == stamp_ns:
                self._refused_duplicate += 1
                return False
            self._stamps_ns[index + 1 : self._count + 1] = self._stamps_ns[index : self._count]
            self._poses[index + 1 : self._count + 1] = self._poses[index : self._count]
            self._first_ns = min(self._first_ns, stamp_ns)
        self._stamps_ns[index] = stamp_ns
        row = self._poses[index]
        row[0], row[1], row[2] = position
        row[3], row[4], row[5], row[6] = quat_xyzw
        self._count += 1
        self._received += 1
        return True

    def extend(self, stamps_ns, poses):
        """Take poses (N, 7), each newer than all before; there must be room for them."""
        end = self._count + len(stamps_ns)
        self._stamps_ns[self._count : end] = stamps_ns
        self._poses[self._count : end] = poses
        self._last_ns = int(stamps_ns[-1])
        if self._first_ns is None:
            self._first_ns = int(stamps_ns[0])
        self._count = end
        self._received += len(stamps_ns)

    def are_newer(self, stamps_ns):
        """(N,) whether each stamp is newer than all before it."""
        last_ns = np.iinfo(np.int64).min if self._last_ns is None else self._last_ns
        return stamps_ns > np.maximum.accumulate(np.concatenate([[last_ns], stamps_ns]))[:-1]

    @property
    def quiet_for(self):
        """How many newer poses may come until the waiting room is full or, at the time to look at
        it, crowded.
        """
        until_crowded = max(_CROWDED_POSES + 1 - self._count, 0)
        until_looked_at = until_crowded + -(self._received + until_crowded) % _POSES_BETWEEN
        return min(until_looked_at, _MAX_WAITING_POSES - self._count)

    @property
    def is_full(self):
        return self._count == _MAX_WAITING_POSES

    @property
    def is_crowded(self):
        return self._count > _CROWDED_POSES and self._received % _POSES_BETWEEN == 0

    def __len__(self):
        return self._count

    def stamp_at(self, share):
        """Stamp below which this share of the waiting poses lies."""
        return self.stamp_of(int(share * (self._count - 1)))

    def stamp_of(self, index):
        """Stamp of a waiting pose, or of the newest."""
        return int(self._stamps_ns[min(index, self._count - 1)])

    def state(self):
        """All there is to know, as arrays."""
        return {
            "stamps_ns": self._stamps_ns[: self._count].copy(),
            "poses": self._poses[: self._count].copy(),
            "frame": np.array(self.frame),
            "statistics": np.array(
                [-1 if value is None else value for value in dataclasses.astuple(self.statistics)]
            ),
            "let_go_until_ns": np.array(
                [] if self._let_go_until_ns is None else [self._let_go_until_ns], dtype=np.int64
            ),
        }

    @classmethod
    def from_state(cls, state):
        """The stream that gave this state."""
        stream = cls()
        stream._count = len(state["stamps_ns"])
        stream._stamps_ns[: stream._count] = state["stamps_ns"]
        stream._poses[: stream._count] = state["poses"]
        stream.frame = str(state["frame"])
        *counts, first_ns, last_ns = state["statistics"].tolist()
        (
            stream._received,
            stream._refused_duplicate,
            stream._refused_late,
            stream._dropped_unpaired,
        ) = counts
        if stream._received:
            stream._first_ns, stream._last_ns = first_ns, last_ns
        stream._let_go_until_ns = (
            int(state["let_go_until_ns"][0]) if len(state["let_go_until_ns"]) else None
        )
        return stream

    def poses(self, until_ns=None):
        """The waiting poses, copied: all, or those up to a stamp and the next one."""
        end = self._count
        if until_ns is not None:
            end = min(
                int(np.searchsorted(self._stamps_ns[: self._count], until_ns, side="right")) + 1,
                self._count,
            )
        return RawPoses(self._stamps_ns[:end].copy(), self._poses[:end].copy())

    def let_go(self, until_ns, unpaired=False):
        """Forget poses up to and including a stamp, but for the last of them: what comes next is
        interpolated from it.
        """
        split = max(
            int(np.searchsorted(self._stamps_ns[: self._count], until_ns, side="right")) - 1, 0
        )
        if unpaired:
            self._dropped_unpaired += split
        rest = self._count - split
        self._stamps_ns[:rest] = self._stamps_ns[split : self._count].copy()
        self._poses[:rest] = self._poses[split : self._count].copy()
        self._count = rest
        self._let_go_until_ns = until_ns


@dataclass(frozen=True)
class Snapshot:
    """All that an estimate needs, detached from the calibrator: estimate it in any thread, while
    poses keep coming in.
    """

    config: CalibratorConfig
    kept: PosePairs
    waiting_parent: RawPoses | Trajectory
    waiting_child: RawPoses | Trajectory
    base_stream: str | None
    parent_frame: str
    child_frame: str
    warnings: tuple = ()
    time_offset: TimeOffset | None = None

    @property
    def parent(self):
        """Trajectory of the parent's poses that wait to be paired."""
        return _as_trajectory(self.waiting_parent)

    @property
    def child(self):
        """Trajectory of the child's poses that wait to be paired."""
        return _as_trajectory(self.waiting_child)

    def pose_pairs(self):
        """Synchronised pose pairs, the kept ones of earlier and those of the poses still waiting."""
        if self.config.time_offset == ESTIMATE:
            return self._with_time_offset.pose_pairs()
        return self._pose_pairs

    @cached_property
    def _pose_pairs(self):
        waiting = _synchronised(self.config, self.parent, self.child, self.base_stream, self.kept)
        return thin(PosePairs.concatenate(self.kept, waiting), self.config.max_pairs)

    def estimate(self):
        """Solve; see :meth:`Calibrator.estimate`."""
        if self.parent_frame == self.child_frame:
            raise InputError(
                f"both streams name {self.parent_frame!r} as their sensor frame, so there is nothing to calibrate between; "
                "give parent_frame and child_frame"
            )
        if self.config.time_offset == ESTIMATE:
            return self._with_time_offset.estimate()
        pose_pairs = self.pose_pairs()
        if len(pose_pairs) < self.config.min_pairs:
            raise NotEnoughDataError(self._what_is_missing(len(pose_pairs)))
        result = estimate_extrinsic(pose_pairs, self.config, self.time_offset)
        return dataclasses.replace(
            result,
            parent_frame=self.parent_frame,
            child_frame=self.child_frame,
            warnings=self.warnings + result.warnings,
        )

    @property
    def found_time_offset(self):
        """The TimeOffset that pose_pairs() or estimate() found; None where that was not their task
        or they failed.
        """
        return (
            self.__dict__["_with_time_offset"].time_offset
            if "_with_time_offset" in self.__dict__
            else None
        )

    @cached_property
    def streams(self):
        """Trajectories of the whole session, each on its own clock: as they came in, or at the
        instants of the pairs where there are some.
        """
        if not len(self.kept):
            return self.parent, self.child
        pairs = self.pose_pairs()
        offset_s = self.time_offset.seconds if self.time_offset else self.config.time_offset
        return Trajectory(pairs.stamps_ns, pairs.Ts_pw_p), Trajectory(
            pairs.stamps_ns, pairs.Ts_cw_c
        ).shifted(-offset_s)

    def check(self, calibration=None):
        """Agreement of the streams: what is wrong with them, given a calibration's time offset and
        scale.

        Parameters
        ----------
        calibration : Calibration, optional
            Its time offset and scale count as known; without one, those of the options.
        """
        offset_s = calibration.time_offset_s if calibration else self.config.time_offset
        scale = calibration.scale if calibration else self.config.scale
        # Pairs that were thinned out lie farther apart than poses.
        interval_s = (
            float(np.median(np.diff(self.streams[0].stamps_ns))) * 1e-9 if len(self.kept) else 0.0
        )
        agreement = check_streams(
            *self.streams,
            0.0 if offset_s == ESTIMATE else offset_s,
            1.0 if isinstance(scale, str) else scale,
            max(self.config.max_gap, _FEW_INTERVALS * interval_s),
        )
        if not len(self.kept):
            return agreement
        # Between pairs there may be gaps where the streams have none.
        return dataclasses.replace(
            agreement, findings=tuple(f for f in agreement.findings if f.code != "gaps")
        )

    @cached_property
    def _with_time_offset(self):
        """The same with the time offset estimated: from the poses that wait, unless pairs were made
        with one before.
        """
        found = self.time_offset or estimate_time_offset(
            self.parent, self.child, self.config.max_gap
        )
        return dataclasses.replace(
            self,
            config=dataclasses.replace(self.config, time_offset=found.seconds),
            time_offset=found,
        )

    def _what_is_missing(self, n_pairs):
        needed = f"{self.config.min_pairs} synchronised pose pairs are needed, found {n_pairs}"
        for name, stream in (("parent", self.parent), ("child", self.child)):
            if len(stream) == 0 and len(self.kept) == 0:
                return f"{needed}: no poses on the {name} stream"
        if len(self.kept):
            return needed
        child = self.child.shifted(self.config.time_offset)
        start_ns = max(self.parent.stamps_ns[0], child.stamps_ns[0])
        end_ns = min(self.parent.stamps_ns[-1], child.stamps_ns[-1])
        counts = f"{len(self.parent)} parent and {len(child)} child poses"
        if end_ns < start_ns:
            return (
                f"{needed}: the streams do not overlap in time ({counts}, {(start_ns - end_ns) * 1e-9:.3f} s apart); "
                "if their clocks differ, set time_offset to estimate or to the seconds between them"
            )
        return (
            f"{needed} from {counts} that overlap for {(end_ns - start_ns) * 1e-9:.2f} s; "
            "record longer, or raise max_gap if a stream is slower than that"
        )


class Calibrator:
    """Collects the poses of both streams and estimates T_parent_child from them.

    Poses may come at any rate and in any order. They are paired at the slower stream's stamps, the
    other stream interpolated along the geodesic of SE(3), never extrapolated and never across a gap
    of more than ``max_gap``. Memory is bounded: a waiting room per stream and at most ``max_pairs``
    pose pairs.

    Parameters
    ----------
    config : CalibratorConfig
    """

    def __init__(self, config=None):
        self._config = config or CalibratorConfig()
        self.reset()

    @property
    def config(self):
        """The CalibratorConfig in force."""
        return self._config

    def reset(self):
        """Forget all poses, frames and statistics."""
        self._streams = {stream: _Stream() for stream in STREAMS}
        self._kept = PosePairs.empty()
        self._base_stream = None
        self._time_offset = self._proposed_offset = None

    def reconfigure(self, config):
        """Put other options in force. Poses are kept, except pairs already made with another time
        offset.
        """
        if config.time_offset != self._config.time_offset:
            self._kept, self._base_stream = PosePairs.empty(), None
            self._time_offset = self._proposed_offset = None
        self._config = config

    def state(self):
        """All poses and pairs as a flat mapping of names to arrays, for :meth:`restore`; options
        are not part of it.
        """
        state = {
            f"{stream}.{name}": value
            for stream in STREAMS
            for name, value in self._streams[stream].state().items()
        }
        kept = {
            "stamps_ns": self._kept.stamps_ns,
            "Ts_pw_p": self._kept.Ts_pw_p,
            "Ts_cw_c": self._kept.Ts_cw_c,
        }
        state |= {f"kept.{name}": value for name, value in kept.items()} | {
            "base": np.array(self._base_stream or "")
        }
        return state | (_offset_state(self._time_offset) if self._time_offset else {})

    def restore(self, state):
        """Go on from a :meth:`state`, of this or an earlier calibrator."""
        parts = {part: {} for part in (*STREAMS, "kept", "offset", "correlation", "fit")}
        for name, value in state.items():
            part, _, rest = name.partition(".")
            if rest:
                parts[part][rest] = value
        self._streams = {stream: _Stream.from_state(parts[stream]) for stream in STREAMS}
        self._kept = PosePairs(**parts["kept"])
        self._base_stream = str(state["base"]) or None
        self._time_offset = _offset_from_state(parts) if parts["offset"] else None

    def statistics(self, stream):
        """StreamStatistics of "parent" or "child"."""
        return self._streams[stream].statistics

    def set_frame(self, stream, sensor_frame):
        """Tell the name of a stream's sensor frame, as its messages give it; an option that names
        the frame overrides this.

        Raises
        ------
        InputError
            Where the name is empty, or another than before.
        """
        known = self._streams[stream].frame
        if sensor_frame == known and known:
            return
        if getattr(self._config, f"{stream}_frame"):
            return
        if not sensor_frame:
            raise InputError(
                f"the {stream} stream's sensor frame is empty; name it with {stream}_frame"
            )
        if known:
            raise InputError(
                f"the {stream} stream's sensor frame changed from {known!r} to {sensor_frame!r}; one stream must be one sensor"
            )
        self._streams[stream].frame = sensor_frame

    def add_pose(self, stream, stamp_ns, position, quat_xyzw):
        """Take a pose of a sensor in its own world.

        Parameters
        ----------
        stream : {"parent", "child"}
        stamp_ns : int
            Nanoseconds, on the stream's own clock.
        position : sequence of 3 floats
            Metres.
        quat_xyzw : sequence of 4 floats
            Scalar last, unit length to 1 %.

        Returns
        -------
        bool
            False where the pose was refused because its stamp is taken or too old;
            :meth:`statistics` counts them.

        Raises
        ------
        InputError
            Where a number is not finite or the quaternion is not of unit length.
        """
        if not _is_pose(*position, *quat_xyzw):
            raise _what_is_wrong(position, quat_xyzw)
        waiting = self._streams[stream]
        if waiting.is_full:
            self._make_room()
        elif waiting.is_crowded:
            self._make_pairs()
        return waiting.add(stamp_ns, position, quat_xyzw)

    def add_poses(self, stream, stamps_ns, positions, quats_xyzw):
        """Take many poses: what :meth:`add_pose` does with one after the other, to the last bit,
        but quicker.

        Parameters
        ----------
        stream : str, or sequence of N str
            "parent" or "child": of all the poses, or of each.
        stamps_ns : (N,) int64 array
        positions : (N, 3) array
        quats_xyzw : (N, 4) array

        Returns
        -------
        (N,) bool array
            False where a pose was refused.

        Raises
        ------
        UnusablePose
            At the first pose that :meth:`add_pose` has an error for; those before it have been
            taken.
        """
        stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
        poses = np.concatenate([positions, quats_xyzw], axis=1, dtype=float)
        names = np.broadcast_to(np.asarray(stream), len(stamps_ns))
        with np.errstate(over="ignore", invalid="ignore"):
            is_usable = _is_pose(*poses.T)
        is_plain, columns = np.zeros(len(stamps_ns), dtype=bool), []
        for name, waiting in self._streams.items():
            rows = np.flatnonzero(names == name)
            is_plain[rows] = is_usable[rows] & waiting.are_newer(stamps_ns[rows])
            columns.append((waiting, rows.tolist(), stamps_ns[rows], poses[rows]))
        others = [*np.flatnonzero(~is_plain).tolist(), len(stamps_ns)]
        taken = np.ones(len(stamps_ns), dtype=bool)
        first = 0
        while first < len(stamps_ns):
            # Up to the next pose that is not plain, or with which the engine has more to do, they
            # need only be stored.
            begins = [bisect_left(rows, first) for _, rows, *_ in columns]
            stop = others[bisect_left(others, first)]
            for begin, (waiting, rows, *_) in zip(begins, columns, strict=True):
                if (busy := begin + waiting.quiet_for) < len(rows):
                    stop = min(stop, rows[busy])
            for begin, (waiting, rows, own_stamps_ns, own_poses) in zip(
                begins, columns, strict=True
            ):
                end = bisect_left(rows, stop)
                if begin < end:
                    waiting.extend(own_stamps_ns[begin:end], own_poses[begin:end])
            if stop < len(stamps_ns):
                pose = poses[stop].tolist()
                try:
                    taken[stop] = self.add_pose(
                        str(names[stop]), int(stamps_ns[stop]), pose[:3], pose[3:]
                    )
                except InputError as error:
                    raise UnusablePose(stop, error) from None
            first = stop + 1
        return taken

    def snapshot(self):
        """What is known now, for an estimate in this or another thread."""
        parent, child = self._streams["parent"], self._streams["child"]
        frames, warnings = name_frames(self._config, {"parent": parent.frame, "child": child.frame})
        return Snapshot(
            self._config,
            self._kept,
            parent.poses(),
            child.poses(),
            self._base_stream,
            *frames,
            warnings,
            self._time_offset,
        )

    def estimate(self):
        """Solve for the extrinsic from all poses so far.

        Returns
        -------
        Calibration

        Raises
        ------
        NotEnoughDataError
            Where fewer than ``min_pairs`` poses could be paired; the message says what is missing.
        InputError
            Where both streams are of the same sensor frame.
        """
        return self.snapshot().estimate()

    def _make_room(self):
        """Find place in a full waiting room."""
        self._make_pairs(1 - _SHARE_LEFT_WAITING)
        for stream in self._streams.values():
            if (
                stream.is_full
            ):  # the other stream has nothing at these times: waiting longer would not pair them
                stream.let_go(stream.stamp_at(0.5), unpaired=True)

    def _make_pairs(self, settled_share=None):
        """Make the oldest waiting poses into pairs, keep the pairs, and let go of the poses they
        came from.

        Only poses that no latecomer is expected among: those older than the newest by a while, or
        the given share of them.
        """
        parent, child = self._streams["parent"], self._streams["child"]
        if not len(parent) or not len(child):
            return
        config = self._config_with_time_offset(estimate=settled_share is not None)
        if config is None:
            return
        offset_ns = round(config.time_offset * 1e9)

        def settled_ns(stream):
            return (
                stream.stamp_at(1) - _LATECOMERS_NS
                if settled_share is None
                else stream.stamp_at(settled_share)
            )

        horizon_ns = min(
            settled_ns(parent),
            settled_ns(child) + offset_ns,
            parent.stamp_of(_POSES_AT_A_TIME),
            child.stamp_of(_POSES_AT_A_TIME) + offset_ns,
        )
        longer, its_offset_ns = (parent, 0) if len(parent) >= len(child) else (child, offset_ns)
        if (
            settled_share is None
            and horizon_ns < longer.stamp_of(_POSES_AT_A_TIME // 2) + its_offset_ns
        ):
            return  # too few to be worth it
        waiting = parent.poses(horizon_ns), child.poses(horizon_ns - offset_ns)
        if self._base_stream is None:
            self._base_stream = slower_stream(parent.poses(), child.poses())
        made = _synchronised(
            config,
            *(poses.trajectory for poses in waiting),
            self._base_stream,
            self._kept_parts[-1],
        )
        self._keep(made[made.stamps_ns <= horizon_ns])
        alone = parent.stamp_of(0) > horizon_ns or child.stamp_of(0) + offset_ns > horizon_ns
        parent.let_go(horizon_ns, unpaired=alone)
        child.let_go(horizon_ns - offset_ns, unpaired=alone)

    def _keep(self, made):
        if not len(made):
            return
        self._kept_parts.append(made)
        if sum(map(len, self._kept_parts)) > self._config.max_pairs:
            self._kept_parts = [thin(self._kept, self._config.max_pairs)]

    @property
    def _kept(self):
        """All pose pairs made so far; they come in parts, which are put together only when somebody
        asks.
        """
        if len(self._kept_parts) > 1:
            self._kept_parts = [PosePairs.concatenate(*self._kept_parts)]
        return self._kept_parts[0]

    @_kept.setter
    def _kept(self, pose_pairs):
        self._kept_parts = [pose_pairs]

    def adopt(self, found: TimeOffset | None) -> None:
        """Take over the time offset that a snapshot has estimated, if any, to spare the calibrator
        that work when it needs one.
        """
        self._proposed_offset = found or self._proposed_offset

    def _config_with_time_offset(self, estimate):
        """The configuration with a time offset in seconds; None where it is to be estimated and
        cannot or need not be yet.
        """
        if self._config.time_offset != ESTIMATE:
            return self._config
        if self._time_offset is None and not estimate:
            return None
        if self._time_offset is None:
            parent, child = self._streams["parent"].poses(), self._streams["child"].poses()
            try:
                self._time_offset = self._proposed_offset or estimate_time_offset(
                    parent.trajectory, child.trajectory, self._config.max_gap
                )
            except NotEnoughDataError:
                return None
        return dataclasses.replace(self._config, time_offset=self._time_offset.seconds)


def _is_pose(x, y, z, qx, qy, qz, qw):
    """Whether these numbers are a pose, or for each row of these arrays."""
    norm2 = qx * qx + qy * qy + qz * qz + qw * qw
    # A sum is finite only if all its terms are; nan fails every comparison.
    return (abs(x + y + z) < np.inf) & (norm2 >= _LEAST_NORM2) & (norm2 <= _MOST_NORM2)


def _what_is_wrong(position, quat_xyzw):
    """The InputError for what is no pose."""
    x, y, z = position
    if not abs(x + y + z) < np.inf:
        return InputError(f"position ({x}, {y}, {z}) is not finite")
    qx, qy, qz, qw = quat_xyzw
    length = (qx * qx + qy * qy + qz * qz + qw * qw) ** 0.5
    return InputError(
        f"quaternion (x {qx}, y {qy}, z {qz}, w {qw}) has length {length:.4g}, expected 1 within {QUATERNION_NORM_TOLERANCE}"
    )


def _offset_state(offset):
    """A TimeOffset as a flat mapping of names to arrays."""
    state = {"offset.seconds": offset.seconds, "offset.sigma_s": offset.sigma_s}
    for part in ("correlation", "fit"):
        found = getattr(offset, part)
        if found is not None:
            state |= {
                f"{part}.{field.name}": getattr(found, field.name)
                for field in dataclasses.fields(found)
            }
    return {name: np.asarray(value) for name, value in state.items()}


def _offset_from_state(parts):
    """The TimeOffset that gave these parts of a state."""

    def values(part):
        return {name: value if value.ndim else value.item() for name, value in parts[part].items()}

    fit = SimilarityFit(**values("fit")) if parts["fit"] else None
    return TimeOffset(**values("offset"), correlation=Correlation(**values("correlation")), fit=fit)


def _as_trajectory(poses):
    return poses if isinstance(poses, Trajectory) else poses.trajectory


def name_frames(config, known):
    """Names of the parent's and the child's sensor frame, and a warning for each that nobody named."""
    names, warnings = [], []
    for stream in STREAMS:
        name = getattr(config, f"{stream}_frame") or known[stream]
        if not name:
            name = f"{stream}_sensor"
            warnings.append(
                f"the {stream} stream does not name its sensor's frame; it is called {name!r} here (name it with {stream}_frame)"
            )
        names.append(name)
    return names, tuple(warnings)


def thin(pose_pairs, max_pairs):
    """At most ``max_pairs`` of the pose pairs: of every second one, those around which the parent
    turns least go first.
    """
    while len(pose_pairs) > max_pairs:
        candidates = np.arange(1, len(pose_pairs) - 1, 2)
        rotations = pose_pairs.Ts_pw_p[:, :3, :3]
        turned = np.einsum(
            "kij,kij->k", rotations[candidates - 1], rotations[candidates + 1]
        )  # 1 + 2 cos(angle)
        n_drop = min(len(pose_pairs) - max_pairs + max_pairs // 10, (len(candidates) + 1) // 2)
        drop = candidates[np.argsort(-turned, kind="stable")[:n_drop]]
        keep = np.ones(len(pose_pairs), dtype=bool)
        keep[drop] = False
        pose_pairs = pose_pairs[keep]
    return pose_pairs


def _synchronised(config, parent, child, base_stream, kept):
    """Keyframes among the waiting poses, after the last one kept."""
    if len(parent) == 0 or len(child) == 0:
        return PosePairs.empty()
    made = synchronise(parent, child.shifted(config.time_offset), config.max_gap, base_stream)
    if len(kept):
        made = made[made.stamps_ns > kept.stamps_ns[-1]]
    return made[
        select_keyframes(
            made,
            config.keyframe_min_translation,
            config.keyframe_min_rotation,
            config.keyframe_min_interval,
            previous=kept[-1:],
        )
    ]
