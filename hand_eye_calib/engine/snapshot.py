"""A snapshot of the engine: all that an estimate needs, independent of the poses that follow."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hand_eye_calib.alignment.angular_rates import Correlation, correlate_rates
from hand_eye_calib.alignment.time_offset import TimeOffset, estimate_time_offset
from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.answers import cross_checked
from hand_eye_calib.engine.estimation import fixed_time_offset, solve_poses
from hand_eye_calib.engine.partial import estimate_lever_arm, estimate_rotation
from hand_eye_calib.errors import ConfigError, InputError, NotEnoughDataError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.pairing.synchronise import PosePairs, select_keyframes, synchronise
from hand_eye_calib.results.calibration import Calibration

STREAMS = ("parent", "child")

# Options that have no meaning for streams that are no poses but with these values.
_OF_PARTS_ALONE = {"method": ("auto", "adaptive"), "reference": ("auto",), "backend": ("fast",)}

# A time offset that is closer than this to the one that the poses were paired with stays (s).
_NEGLIGIBLE_S = 0.005
# One that is farther away is no time offset (s).
_BELIEVABLE_S = 1.0

# Gaps that the stream checks may interpolate across, in median intervals between pairs: pairs that
# were downsampled are farther apart than poses.
GAP_INTERVALS = 4


@dataclass(frozen=True)
class RawPoses:
    """Poses as they came in, in order of time: stamps (N,) int64, and x y z qx qy qz qw (N, 7)."""

    stamps_ns: IntArray
    poses: FloatArray

    @cached_property
    def trajectory(self) -> Trajectory:
        """The same as a Trajectory. This is the expensive part."""
        return Trajectory.from_quat_xyzw(self.stamps_ns, self.poses[:, :3], self.poses[:, 3:])


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """All that an estimate needs. It can be estimated in any thread or process, while poses keep
    coming in.

    Attributes
    ----------
    config : CalibratorConfig
    kept : PosePairs
        Pairs that were made before.
    buffered_parent, buffered_child : RawPoses or Trajectory
        Poses that are not paired yet.
    paired_at : {"parent", "child"} or None
        Stream whose stamps the pairs have; the slower one if None.
    parent_frame, child_frame : str
    warnings : tuple of str
    time_offset : TimeOffset or None
        The offset of the kept pairs if it was estimated.
    """

    config: CalibratorConfig
    kept: PosePairs = field(default_factory=PosePairs.empty)
    buffered_parent: RawPoses | Trajectory
    buffered_child: RawPoses | Trajectory
    paired_at: str | None = None
    parent_frame: str
    child_frame: str
    warnings: tuple[str, ...] = ()
    time_offset: TimeOffset | None = None

    @property
    def parent(self) -> Trajectory:
        """Trajectory of the parent's poses that are not paired yet, in its right convention."""
        return _put_right(self.buffered_parent, "parent", self.config)

    @property
    def child(self) -> Trajectory:
        """The same of the child's, freed of a clock rate."""
        child = _put_right(self.buffered_child, "child", self.config)
        return self.time_offset.steadied(child) if self.time_offset else child

    def resolved(self) -> "Snapshot":
        """The snapshot with its time offset in seconds, estimated if the options ask for that: from
        the buffered poses, unless pairs were made with an estimate before. NotEnoughDataError if it
        cannot be estimated.
        """
        return self._resolved

    @cached_property
    def _resolved(self) -> "Snapshot":
        if not isinstance(self.config.time_offset, str):
            return self
        found = self.time_offset or estimated_time_offset(self.config, self.parent, self.child)
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
        return max(self.config.max_gap, GAP_INTERVALS * self.streams[0].interval_s)

    def pose_pairs(self) -> PosePairs:
        """Synchronised pose pairs: the kept ones, and those of the buffered poses; errors as of
        :meth:`resolved`.
        """
        return self.resolved()._pose_pairs

    @cached_property
    def _pose_pairs(self) -> PosePairs:
        kept = self.kept
        if len(kept):
            parent, child = (
                _put_right(Trajectory(kept.stamps_ns, Ts), stream, self.config)
                for stream, Ts in zip(STREAMS, (kept.Ts_pw_p, kept.Ts_cw_c), strict=True)
            )
            kept = PosePairs(kept.stamps_ns, parent.poses, child.poses)
        made = pair_poses(self.config, self.parent, self.child, self.paired_at, kept)
        return downsample(PosePairs.concatenate(kept, made), self.config.max_pairs)

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
            If both streams have the same sensor frame.
        """
        if self.parent_frame == self.child_frame:
            raise InputError(
                f"both streams name {self.parent_frame!r} as their sensor frame, so there is "
                "nothing to calibrate between; give parent_frame and child_frame"
            )
        resolved, pairs = self.resolved(), self.pose_pairs()
        config = resolved.config
        if len(pairs) < config.min_pairs:
            raise NotEnoughDataError(resolved._what_is_missing(len(pairs)))
        if config.measured != "poses":
            result = resolved._estimate_part()
        else:
            solved = solve_poses(pairs, config, resolved.time_offset)
            if cross_check or (cross_check is None and config.reference == "auto"):
                result = cross_checked(solved, config, pairs)
            else:
                result = solved.calibration()
        return replace(
            result,
            parent_frame=self.parent_frame,
            child_frame=self.child_frame,
            warnings=self.warnings + result.warnings,
        )

    def _estimate_part(self) -> Calibration:
        """The part of the extrinsic that streams without rotations or positions show."""
        for name, allowed in _OF_PARTS_ALONE.items():
            if getattr(self.config, name) not in allowed:
                self.config.require_poses(f"{name} {getattr(self.config, name)}")
        of_positions = self.config.measured == "positions"
        estimate = estimate_lever_arm if of_positions else estimate_rotation
        result = estimate(self._pose_pairs, self.config)
        found_s, given_s = result.time_offset_s, fixed_time_offset(self.config)
        if not abs(found_s - given_s) < _BELIEVABLE_S:
            return replace(result, time_offset_s=given_s)
        if len(self.kept) or not abs(found_s - given_s) > _NEGLIGIBLE_S:
            return result
        # Interpolated where the other stream has its poses, rather than moved along its velocity.
        config = replace(self.config, time_offset=found_s)
        moved = replace(self, config=config)._pose_pairs
        return estimate(moved, config) if len(moved) >= self.config.min_pairs else result

    @cached_property
    def streams(self) -> tuple[Trajectory, Trajectory]:
        """Trajectories of the whole session, each on its own clock: as they came in, or at the
        stamps of the pairs if some were made.
        """
        streams = [self.parent, self.child]
        if len(self.kept):
            resolved = self.resolved()
            pairs, offset_s = resolved._pose_pairs, fixed_time_offset(resolved.config)
            streams = [Trajectory(pairs.stamps_ns, Ts) for Ts in (pairs.Ts_pw_p, pairs.Ts_cw_c)]
            streams[1] = streams[1].shifted(-offset_s)
        for k, stream in enumerate(STREAMS):
            measures = getattr(self.config, f"{stream}_measures")
            if measures not in ("auto", streams[k].measures):
                streams[k] = replace(streams[k], measures=measures)
        return streams[0], streams[1]

    def _what_is_missing(self, n_pairs: int) -> str:
        needed = f"{self.config.min_pairs} synchronised pose pairs are needed, found {n_pairs}"
        if len(self.kept):
            return needed
        parent, child = self.parent, self.child.shifted(fixed_time_offset(self.config))
        for name, stream in zip(STREAMS, (parent, child), strict=True):
            if len(stream) == 0:
                return f"{needed}: no poses on the {name} stream"
        start_ns = max(parent.stamps_ns[0], child.stamps_ns[0])
        end_ns = min(parent.stamps_ns[-1], child.stamps_ns[-1])
        counts = f"{len(parent)} parent and {len(child)} child poses"
        if end_ns < start_ns:
            return (
                f"{needed}: the streams do not overlap in time ({counts}, "
                f"{(start_ns - end_ns) * 1e-9:.3f} s apart); if their clocks differ, set "
                "time_offset to estimate or to the seconds between them"
            )
        return (
            f"{needed} from {counts} that overlap for {(end_ns - start_ns) * 1e-9:.2f} s; "
            "record longer, or raise max_gap if a stream is slower than that"
        )


def conventions(config: CalibratorConfig, stream: str) -> dict[str, float | str]:
    """The options, by name, that say in which convention a stream was written, if it is not the
    usual one.
    """
    names = [f"{stream}_invert", f"{stream}_quaternion"]
    names += ["parent_scale"] if stream == "parent" else []
    given = {name: getattr(config, name) for name in names}
    return {name: each for name, each in given.items() if each != getattr(CalibratorConfig, name)}


def _put_right(poses: RawPoses | Trajectory, stream: str, config: CalibratorConfig) -> Trajectory:
    """The trajectory of a stream in the usual convention, from that of the options."""
    trajectory = poses if isinstance(poses, Trajectory) else poses.trajectory
    if not conventions(config, stream):
        return trajectory
    invert, order = getattr(config, f"{stream}_invert"), getattr(config, f"{stream}_quaternion")
    needs = {"poses"} if invert == "poses" else {"poses", "rotations"}
    if (invert, order) != ("none", "xyzw") and trajectory.measures not in needs:
        name = f"{stream}_invert {invert}" if invert != "none" else f"{stream}_quaternion {order}"
        raise ConfigError(f"{name} cannot be: the {stream} measures {trajectory.measures}")
    right = replace(trajectory, poses=se3.put_right(trajectory.poses, invert, order))
    return right.scaled(config.parent_scale) if stream == "parent" else right


def name_frames(
    config: CalibratorConfig, known: Mapping[str, str]
) -> tuple[str, str, tuple[str, ...]]:
    """Names of the parent's and the child's sensor frame, and a warning for each without a name.
    Those of the options override those that the streams give, which are empty if unknown.
    """
    parent, child = (getattr(config, f"{stream}_frame") or known[stream] for stream in STREAMS)
    warnings = tuple(
        f"the {stream} stream does not name its sensor's frame; it is called '{stream}_sensor' "
        f"here (name it with {stream}_frame)"
        for stream, name in zip(STREAMS, (parent, child), strict=True)
        if not name
    )
    return parent or "parent_sensor", child or "child_sensor", warnings


def estimated_time_offset(
    config: CalibratorConfig, parent: Trajectory, child: Trajectory
) -> TimeOffset:
    """The time offset of two streams, from what the options say that both measure."""
    of_speed = config.measured == "positions"
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
        drop = candidates[np.argsort(-traces, kind="stable")[:n_drop]]
        keep = np.ones(len(pose_pairs), dtype=bool)
        keep[drop] = False
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
    if len(parent) == 0 or len(child) == 0:
        return PosePairs.empty()
    made = synchronise(parent, child.shifted(fixed_time_offset(config)), config.max_gap, at)
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
