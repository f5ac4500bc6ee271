"""A snapshot of the engine: all that an estimate needs, independent of the poses that follow."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hand_eye_calib.core.alignment.time_offset import (
    Correlation,
    TimeOffset,
    correlate_rates,
    estimate_time_offset,
)
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError, NotEnoughDataError
from hand_eye_calib.core.base.text import frame_name
from hand_eye_calib.core.engine.kinds import kind_of
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import StreamFrames
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import PosePairs, select_keyframes, synchronise
from hand_eye_calib.core.results.calibration import Calibration

STREAMS = ("parent", "child")

# A model moves poses along their velocities by a smaller time offset (s). From this one on, the
# poses are paired anew instead.
MOST_MOVED_S = 0.003

# A time offset (s) that nobody asked for is not taken without doubt from this one on.
UNASKED_S = 1.0

# Pose pairs of whole trajectories that are used unless an option says otherwise: the noise model
# takes 8 kB for each, and hours at ten a second hold as many.
_MOST_PAIRS = 100_000

# Gaps that the stream checks may interpolate across, in median intervals between pairs: pairs that
# were downsampled are farther apart than poses.
_GAP_INTERVALS = 4


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """All that an estimate needs. It can be estimated in any thread or process, while poses keep
    coming in.

    Attributes
    ----------
    config : CalibratorConfig
    kept : PosePairs
        Pairs that were made before.
    buffered_parent, buffered_child : Trajectory
        Poses that are not paired yet, as they came in.
    paired_at : {"parent", "child"} or None
        Stream whose stamps the pairs have; the slower one if None.
    parent_names, child_names : StreamFrames
        Names of the frames of each stream.
    warnings : tuple of str
    time_offset : TimeOffset or None
        The offset of the kept pairs if it was estimated.
    """

    config: CalibratorConfig
    kept: PosePairs = field(default_factory=PosePairs.empty)
    buffered_parent: Trajectory
    buffered_child: Trajectory
    paired_at: str | None = None
    parent_names: StreamFrames = field(default_factory=StreamFrames)
    child_names: StreamFrames = field(default_factory=StreamFrames)
    warnings: tuple[str, ...] = ()
    time_offset: TimeOffset | None = None

    @property
    def parent_frame(self) -> str:
        """Name of the parent sensor's frame, as the options read its poses."""
        return self._frame("parent")

    @property
    def child_frame(self) -> str:
        """Name of the child sensor's frame, as the options read its poses."""
        return self._frame("child")

    def _frame(self, stream: str) -> str:
        """Name of a stream's sensor frame; a default if it is not known."""
        names, other = self._names(stream)
        name = names.name
        if getattr(self.config, f"{stream}_invert") == "poses" and names.inverse_name != other.name:
            name = names.inverse_name
        return name or f"{stream}_sensor"

    def _names(self, stream: str) -> tuple[StreamFrames, StreamFrames]:
        """Names of the frames of a stream, and those of the other stream."""
        both = self.parent_names, self.child_names
        return both if stream == "parent" else both[::-1]

    @property
    def frame_warnings(self) -> tuple[str, ...]:
        """Warnings about sensor frames: without a name, or with that of the inverse poses."""
        warnings = []
        for stream, frame in zip(STREAMS, (self.parent_frame, self.child_frame), strict=True):
            names, _ = self._names(stream)
            if frame == f"{stream}_sensor":
                warnings.append(
                    f"the {stream} stream does not name its sensor's frame; it is called '{frame}' "
                    f"here (name it with {stream}_frame)"
                )
            elif frame != names.name:
                observed = names.name or "what it observes"
                text = f"the {stream} is {frame}: inverted, the poses are those of {frame} in "
                text += observed
                if names.option:
                    text += f", which {stream}_frame names"
                warnings.append(text)
        return tuple(warnings)

    def _check_frames(self) -> None:
        """Raise InputError if the names of the frames contradict each other."""
        for stream in STREAMS:
            names, other = self._names(stream)
            if names.option not in ("", names.sensor) and names.option == other.sensor:
                raise InputError(
                    f"{stream}_frame is {names.option}, but that is the frame of the other stream: "
                    f"the parent stream is of {self.parent_names.sensor or 'a sensor without name'}"
                    f", the child stream of {self.child_names.sensor or 'a sensor without name'}; "
                    "exchange the two streams, or the two names"
                )
        if self.parent_frame == self.child_frame:
            raise InputError(
                f"both streams name {self.parent_frame!r} as their sensor frame, so there is "
                "nothing to calibrate between; give parent_frame and child_frame"
            )

    @property
    def unpaired(self) -> tuple[Trajectory, Trajectory]:
        """Trajectories of the poses of parent and child that are not paired yet, in the usual
        convention; the child's stamps are corrected for a clock rate.
        """
        parent = _put_right(self.buffered_parent, "parent", self.config)
        child = _put_right(self.buffered_child, "child", self.config)
        return parent, self.time_offset.steadied(child) if self.time_offset else child

    @cached_property
    def resolved(self) -> "Snapshot":
        """The snapshot with its time offset in seconds, estimated if the options ask for that: from
        the buffered poses, unless pairs were made with an estimate before. NotEnoughDataError if it
        cannot be estimated.
        """
        if not isinstance(self.config.time_offset, str):
            return self
        found = self.time_offset or estimated_time_offset(self.config, *self.unpaired)
        config = replace(self.config, time_offset=found.seconds)
        return replace(self, config=config, time_offset=found)

    @cached_property
    def correlation(self) -> Correlation:
        """Correlation of the angular rates of the streams, over all time offsets."""
        if self.time_offset and self.time_offset.correlation.is_clear and not len(self.kept):
            return self.time_offset.correlation
        return correlate_rates(*self.streams, self.max_gap_s)

    @property
    def max_gap_s(self) -> float:
        """Longest time between two poses of the streams that interpolation may bridge, s."""
        if not len(self.kept):
            return self.config.max_gap
        return max(self.config.max_gap, _GAP_INTERVALS * self.streams[0].interval_s)

    @cached_property
    def pose_pairs(self) -> PosePairs:
        """Synchronised pose pairs: the kept ones, and those of the buffered poses; errors as of
        :attr:`resolved`.
        """
        if self.resolved is not self:
            return self.resolved.pose_pairs
        kept = self.kept
        if len(kept):
            parent, child = (
                _put_right(Trajectory(kept.stamps_ns, Ts), stream, self.config)
                for stream, Ts in zip(STREAMS, (kept.Ts_pw_p, kept.Ts_cw_c), strict=True)
            )
            kept = PosePairs(kept.stamps_ns, parent.poses, child.poses)
        pairs = pair_poses(self.config, *self.unpaired, self.paired_at, kept)
        pairs = PosePairs.concatenate(kept, pairs) if len(kept) else pairs
        most = self.config.max_pairs
        return downsample(pairs, most) if len(pairs) > most else pairs

    def estimate(self, cross_check: bool | None = None) -> Calibration:
        """Estimate the extrinsic.

        Parameters
        ----------
        cross_check : bool, optional
            Whether to compare the result with other references and with both halves; by default
            unless the user set the reference.

        Raises
        ------
        NotEnoughDataError
            If fewer than ``min_pairs`` poses can be paired; the message says what is missing.
        InputError
            If both streams have the same sensor frame, or an option gives one of them the other's.
        ConfigError
            If an option has no meaning for what the streams measure.
        """
        self._check_frames()
        kind = kind_of(self.config)
        kind.require_allowed(self.config)
        resolved = self.resolved
        pairs = self.pose_pairs
        if len(pairs) < resolved.config.min_pairs:
            raise NotEnoughDataError(resolved._what_is_missing(len(pairs)))
        result = kind.solve(resolved, cross_check)
        return replace(
            result,
            parent_frame=self.parent_frame,
            child_frame=self.child_frame,
            warnings=self.frame_warnings + self.warnings + result.warnings,
        )

    @cached_property
    def streams(self) -> tuple[Trajectory, Trajectory]:
        """Trajectories of the whole session, each on its own clock: as they came in, or at the
        stamps of the pairs if some were made.
        """
        streams = [*self.unpaired]
        if len(self.kept):
            pairs = self.pose_pairs
            offset_s = float(self.resolved.config.time_offset)
            streams = [Trajectory(pairs.stamps_ns, Ts) for Ts in (pairs.Ts_pw_p, pairs.Ts_cw_c)]
            streams[1] = streams[1].shifted(-offset_s)
        for k, stream in enumerate(STREAMS):
            measures = getattr(self.config, f"{stream}_measures")
            if measures not in ("auto", streams[k].measures):
                streams[k] = replace(streams[k], measures=measures)
        return streams[0], streams[1]

    def _what_is_missing(self, n_pairs: int) -> str:
        needed = f"{self.config.min_pairs} synchronised pose pairs are needed, found {n_pairs}"
        parent, child = self.unpaired
        child = child.shifted(float(self.config.time_offset))
        for name, stream in zip(STREAMS, (parent, child), strict=True):
            if len(stream) == 0:
                return f"{needed}: no poses on the {name} stream"
        start_ns = max(parent.stamps_ns[0], child.stamps_ns[0])
        common_s = (min(parent.stamps_ns[-1], child.stamps_ns[-1]) - start_ns) * 1e-9
        counts = f"{len(parent)} parent and {len(child)} child poses"
        if common_s < 0:
            return (
                f"{needed}: the streams do not overlap in time ({counts}, {-common_s:.3f} s "
                "apart); if their clocks differ, set time_offset to estimate or to the seconds "
                "between them"
            )
        return (
            f"{needed} from {counts} that overlap for {common_s:.2f} s; "
            "record longer, or raise max_gap if a stream is slower than that"
        )


def _put_right(trajectory: Trajectory, stream: str, config: CalibratorConfig) -> Trajectory:
    """The trajectory of a stream in the usual convention, from that of the options."""
    invert = getattr(config, f"{stream}_invert")
    order = getattr(config, f"{stream}_quaternion")
    if (invert, order) != ("none", "xyzw"):
        kind = trajectory.measures
        if kind not in ("poses", "rotations") or (invert, kind) == ("poses", "rotations"):
            options = f"{stream}_invert {invert}, {stream}_quaternion {order}"
            raise ConfigError(f"{options} cannot be: the {stream} measures {kind}")
        right = se3.put_right(trajectory.poses, invert, order)
        trajectory = replace(trajectory, poses=right)
    is_scaled = stream == "parent" and config.parent_scale != 1.0
    return trajectory.scaled(config.parent_scale) if is_scaled else trajectory


def whole_snapshot(
    parent: Trajectory, child: Trajectory, options: Mapping[str, object]
) -> Snapshot:
    """The Snapshot of two whole trajectories, with options by their public names: all pairs up to
    100,000 unless they set another limit.
    """
    of_streams = {
        "max_pairs": min(max(len(parent), len(child), 10), _MOST_PAIRS),
        "parent_measures": parent.measures,
        "child_measures": child.measures,
    }
    config = CalibratorConfig.from_options(of_streams | dict(options))
    warnings: tuple[str, ...] = ()
    if min(len(parent), len(child)) > config.max_pairs == _MOST_PAIRS:
        warnings = (f"{_MOST_PAIRS:,} pose pairs are used at most; give max_pairs to use more",)
    return Snapshot(
        config=config,
        buffered_parent=parent,
        buffered_child=child,
        parent_names=names_of(config, "parent", parent.sensor_frame, parent.world_frame),
        child_names=names_of(config, "child", child.sensor_frame, child.world_frame),
        warnings=warnings,
    )


def names_of(config: CalibratorConfig, stream: str, sensor: str, world: str) -> StreamFrames:
    """Names of the frames of a stream, from its messages and the options."""
    option = getattr(config, f"{stream}_frame")
    return StreamFrames(frame_name(sensor), frame_name(world), frame_name(option))


def estimated_time_offset(
    config: CalibratorConfig, parent: Trajectory, child: Trajectory
) -> TimeOffset:
    """The time offset of two streams, from what the options say that both measure."""
    of_speed = kind_of(config).is_timed_by_speed
    return estimate_time_offset(parent, child, config.max_gap, of_speed)


def downsample(pose_pairs: PosePairs, max_pairs: int) -> PosePairs:
    """At most ``max_pairs`` of the pose pairs: of every second one, those with the least rotation
    of the parent around them are dropped first.
    """
    while len(pose_pairs) > max_pairs:
        candidates = np.arange(1, len(pose_pairs) - 1, 2)
        rotations = pose_pairs.Ts_pw_p[:, :3, :3]
        # Trace of the rotation between both neighbours: 1 + 2 cos(angle).
        traces = np.einsum("kij,kij->k", rotations[candidates - 1], rotations[candidates + 1])
        n_drop = min(len(pose_pairs) - max_pairs + max_pairs // 10, (len(candidates) + 1) // 2)
        keep = np.ones(len(pose_pairs), dtype=bool)
        keep[candidates[np.argsort(-traces, kind="stable")[:n_drop]]] = False
        pose_pairs = pose_pairs[keep]
    return pose_pairs


def pair_poses(
    config: CalibratorConfig,
    parent: Trajectory,
    child: Trajectory,
    at: str | None,
    kept: PosePairs,
) -> PosePairs:
    """Pose pairs of two trajectories that are keyframes, after the last pair of ``kept``."""
    made = synchronise(parent, child.shifted(float(config.time_offset)), config.max_gap, at)
    if len(kept):
        made = made[made.stamps_ns > kept.stamps_ns[-1]]
    least = config.keyframe_min_translation, config.keyframe_min_rotation
    least_s = config.keyframe_min_interval
    if not any((*least, least_s)):
        return made
    return made[select_keyframes(made, *least, least_s, previous=kept[-1:])]
