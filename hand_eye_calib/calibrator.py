"""The calibrator: poses of two streams in, the extrinsic out.

The one engine behind the node, the replay of bags and the Python function :func:`calibrate`. It knows neither ROS nor files.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import InputError, NotEnoughDataError
from hand_eye_calib.estimation import estimate_extrinsic
from hand_eye_calib.geometry.trajectory import QUATERNION_NORM_TOLERANCE, Trajectory
from hand_eye_calib.pairing.keyframes import select_keyframes
from hand_eye_calib.pairing.synchronise import PosePairs, slower_stream, synchronise

STREAMS = ("parent", "child")

# Raw poses of a stream that wait to be synchronised. Within this horizon messages may come in any order; a session that stays
# below it (200 s at 100 Hz) is solved from all its poses at once, whatever the order they came in.
_MAX_WAITING_POSES = 20_000

# When the waiting room is full, the newest poses of this share stay behind for latecomers.
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


class _Stream:
    """Poses of one sensor that wait to be synchronised, in order of their stamps."""

    def __init__(self):
        self._stamps_ns = np.empty(_MAX_WAITING_POSES, dtype=np.int64)
        self._poses = np.empty((_MAX_WAITING_POSES, 7))  # x y z qx qy qz qw
        self._count = 0
        self._last_stamp_ns = None
        self._let_go_until_ns = None
        self.frame = ""
        self.statistics = StreamStatistics()

    def add(self, stamp_ns, position, quat_xyzw):
        """Take a pose; False where its stamp is taken or too old."""
        if self._let_go_until_ns is not None and stamp_ns <= self._let_go_until_ns:
            self._count_up("refused_late")
            return False
        index = self._count
        if self._last_stamp_ns is not None and stamp_ns <= self._last_stamp_ns:
            index = int(np.searchsorted(self._stamps_ns[: self._count], stamp_ns))
            if index < self._count and self._stamps_ns[index] == stamp_ns:
                self._count_up("refused_duplicate")
                return False
            self._stamps_ns[index + 1 : self._count + 1] = self._stamps_ns[index : self._count]
            self._poses[index + 1 : self._count + 1] = self._poses[index : self._count]
        else:
            self._last_stamp_ns = stamp_ns
        self._stamps_ns[index] = stamp_ns
        row = self._poses[index]
        row[0], row[1], row[2] = position
        row[3], row[4], row[5], row[6] = quat_xyzw
        self._count += 1
        statistics = self.statistics
        first_ns, last_ns = statistics.first_stamp_ns, statistics.last_stamp_ns
        self.statistics = StreamStatistics(
            statistics.received + 1,
            statistics.refused_duplicate,
            statistics.refused_late,
            statistics.dropped_unpaired,
            stamp_ns if first_ns is None else min(first_ns, stamp_ns),
            stamp_ns if last_ns is None else max(last_ns, stamp_ns),
        )
        return True

    def _count_up(self, counter, by=1):
        self.statistics = dataclasses.replace(self.statistics, **{counter: getattr(self.statistics, counter) + by})

    @property
    def is_full(self):
        return self._count == _MAX_WAITING_POSES

    def __len__(self):
        return self._count

    def stamp_at(self, share):
        """Stamp below which this share of the waiting poses lies."""
        return int(self._stamps_ns[int(share * (self._count - 1))])

    def trajectory(self):
        """The waiting poses, copied."""
        poses = self._poses[: self._count]
        return Trajectory.from_quat_xyzw(self._stamps_ns[: self._count].copy(), poses[:, :3], poses[:, 3:])

    def let_go(self, until_ns, unpaired=False):
        """Forget poses up to and including a stamp, but for the last of them: what comes next is interpolated from it."""
        split = max(int(np.searchsorted(self._stamps_ns[: self._count], until_ns, side="right")) - 1, 0)
        if unpaired:
            self._count_up("dropped_unpaired", split)
        rest = self._count - split
        self._stamps_ns[:rest] = self._stamps_ns[split : self._count].copy()
        self._poses[:rest] = self._poses[split : self._count].copy()
        self._count = rest
        self._let_go_until_ns = until_ns


@dataclass(frozen=True)
class Snapshot:
    """All that an estimate needs, detached from the calibrator: estimate it in any thread, while poses keep coming in."""

    config: CalibratorConfig
    kept: PosePairs
    parent: Trajectory
    child: Trajectory
    base_stream: str | None
    parent_frame: str
    child_frame: str
    warnings: tuple = ()

    def pose_pairs(self):
        """Synchronised pose pairs, the kept ones of earlier and those of the poses still waiting."""
        waiting = _synchronised(self.config, self.parent, self.child, self.base_stream, self.kept)
        return thin(PosePairs.concatenate(self.kept, waiting), self.config.max_pairs)

    def estimate(self):
        """Solve; see :meth:`Calibrator.estimate`."""
        if self.parent_frame == self.child_frame:
            raise InputError(
                f"both streams name {self.parent_frame!r} as their sensor frame, so there is nothing to calibrate between; "
                "give parent_frame and child_frame"
            )
        pose_pairs = self.pose_pairs()
        if len(pose_pairs) < self.config.min_pairs:
            raise NotEnoughDataError(self._what_is_missing(len(pose_pairs)))
        result = estimate_extrinsic(pose_pairs, self.config)
        return dataclasses.replace(
            result,
            parent_frame=self.parent_frame,
            child_frame=self.child_frame,
            warnings=self.warnings + result.warnings,
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
                "set time_offset if their clocks differ"
            )
        return (
            f"{needed} from {counts} that overlap for {(end_ns - start_ns) * 1e-9:.2f} s; "
            "record longer, or raise max_gap if a stream is slower than that"
        )


class Calibrator:
    """Collects the poses of both streams and estimates T_parent_child from them.

    Poses may come at any rate and in any order. They are paired at the slower stream's stamps, the other stream interpolated
    along the geodesic of SE(3), never extrapolated and never across a gap of more than ``max_gap``. Memory is bounded: a waiting
    room per stream and at most ``max_pairs`` pose pairs.

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

    def reconfigure(self, config):
        """Put other options in force. Poses are kept, except pairs already made with another time offset."""
        if config.time_offset != self._config.time_offset:
            self._kept, self._base_stream = PosePairs.empty(), None
        self._config = config

    def statistics(self, stream):
        """StreamStatistics of "parent" or "child"."""
        return self._streams[stream].statistics

    def set_frame(self, stream, sensor_frame):
        """Tell the name of a stream's sensor frame, as its messages give it; an option that names the frame overrides this.

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
            raise InputError(f"the {stream} stream's sensor frame is empty; name it with {stream}_frame")
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
            False where the pose was refused because its stamp is taken or too old; :meth:`statistics` counts them.

        Raises
        ------
        InputError
            Where a number is not finite or the quaternion is not of unit length.
        """
        x, y, z = position
        qx, qy, qz, qw = quat_xyzw
        squared_norm = qx * qx + qy * qy + qz * qz + qw * qw
        # A sum is finite only if all its terms are; nan fails every comparison.
        if not abs(x + y + z) < np.inf:
            raise InputError(f"position ({x}, {y}, {z}) is not finite")
        if not (1 - QUATERNION_NORM_TOLERANCE) ** 2 <= squared_norm <= (1 + QUATERNION_NORM_TOLERANCE) ** 2:
            raise InputError(
                f"quaternion (x {qx}, y {qy}, z {qz}, w {qw}) has length {squared_norm**0.5:.4g}, "
                f"expected 1 within {QUATERNION_NORM_TOLERANCE}"
            )
        waiting = self._streams[stream]
        if waiting.is_full:
            self._make_room()
        return waiting.add(stamp_ns, position, quat_xyzw)

    def snapshot(self):
        """What is known now, for an estimate in this or another thread."""
        parent, child = self._streams["parent"], self._streams["child"]
        frames, warnings = _name_frames(self._config, {"parent": parent.frame, "child": child.frame})
        return Snapshot(self._config, self._kept, parent.trajectory(), child.trajectory(), self._base_stream, *frames, warnings)

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
        """Synchronise what waits, keep the pairs, and let go of the poses they came from."""
        parent, child = self._streams["parent"], self._streams["child"]
        offset_ns = round(self._config.time_offset * 1e9)
        if not len(parent) or not len(child):
            full = parent if parent.is_full else child
            full.let_go(full.stamp_at(0.5), unpaired=True)
            return
        if self._base_stream is None:
            self._base_stream = slower_stream(parent.trajectory(), child.trajectory())
        # Up to here (parent clock) no more poses are awaited.
        horizon_ns = min(
            parent.stamp_at(1 - _SHARE_LEFT_WAITING),
            child.stamp_at(1 - _SHARE_LEFT_WAITING) + offset_ns,
        )
        made = _synchronised(self._config, parent.trajectory(), child.trajectory(), self._base_stream, self._kept)
        made = made[made.stamps_ns <= horizon_ns]
        self._kept = thin(PosePairs.concatenate(self._kept, made), self._config.max_pairs)
        parent.let_go(horizon_ns)
        child.let_go(horizon_ns - offset_ns)
        for stream in (parent, child):
            if stream.is_full:  # the other stream has fallen silent: waiting longer would not pair these
                stream.let_go(stream.stamp_at(0.5), unpaired=True)


def calibrate(parent, child, **options):
    """Extrinsic between two sensors from their trajectories.

    Parameters
    ----------
    parent, child : Trajectory
        Poses of each sensor in its own world.
    **options
        Options of :class:`~hand_eye_calib.config.CalibratorConfig` by their public names, such as ``method="dnlo"``,
        ``reference="B5"``, ``time_offset=0.02``. Unlike the node, all poses are used: ``max_pairs`` does not apply unless given.

    Returns
    -------
    Calibration

    Raises
    ------
    ConfigError
        For an unknown option or an impossible value.
    NotEnoughDataError
        Where too few poses could be paired.
    """
    config = offline_config(parent, child, options)
    frames, warnings = _name_frames(config, {"parent": parent.sensor_frame, "child": child.sensor_frame})
    return Snapshot(config, PosePairs.empty(), parent, child, None, *frames, warnings).estimate()


def offline_config(parent, child, options):
    """The CalibratorConfig for two whole trajectories: no limit on the pairs unless the options set one."""
    return CalibratorConfig.from_options({"max_pairs": max(len(parent), len(child), 10), **options})


def _name_frames(config, known):
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
    """At most ``max_pairs`` of the pose pairs: of every second one, those around which the parent turns least go first."""
    while len(pose_pairs) > max_pairs:
        candidates = np.arange(1, len(pose_pairs) - 1, 2)
        rotations = pose_pairs.Ts_pw_p[:, :3, :3]
        turned = np.einsum("kij,kij->k", rotations[candidates - 1], rotations[candidates + 1])  # 1 + 2 cos(angle)
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
