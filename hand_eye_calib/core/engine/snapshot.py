"""Snapshots of poses and options for an estimate. Later poses do not change them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.core.alignment.rate_correlation import (
    Correlation,
    correlate_rates,
)
from hand_eye_calib.core.alignment.time_offset import (
    TimeOffset,
    estimate_time_offset,
)
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import (
    ConfigError,
    InputError,
    NotEnoughDataError,
)
from hand_eye_calib.core.base.registry import RESULT_EXAMINATIONS
from hand_eye_calib.core.base.text import frame_name
from hand_eye_calib.core.engine.kinds import kind_of
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import StreamFrames
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import (
    PosePairs,
    select_keyframes,
    synchronise,
)
from hand_eye_calib.core.results.calibration import Calibration

STREAMS = ("parent", "child")

# Poses are paired anew if the time offset changes by more than this (s). The noise model corrects a
# smaller change by moving poses along their velocities.
MOST_MOVED_S = 0.003

# If the user did not request an estimate, a larger estimated time offset (s) causes a warning.
UNASKED_S = 1.0

# Largest number of pose pairs from whole trajectories, unless the user sets `max_pairs`: three
# hours at 10 Hz. The noise model needs 8 kB per pair.
_MAX_PAIRS = 100_000

# Longest gap that the stream checks interpolate, in median intervals between kept pairs. Kept pairs
# are downsampled, so the distance between them is larger than between poses.
_GAP_INTERVALS = 4


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """Poses and options for an estimate in any thread or process.

    Attributes
    ----------
    config : CalibratorConfig
    kept : PosePairs
        Pose pairs that were made before.
    buffered_parent, buffered_child : Trajectory
        Unpaired poses, as they were received.
    paired_at : {"parent", "child"} or None
        Stream whose stamps the pairs have; None for the slower stream.
    parent_names, child_names : StreamFrames
        Names of the frames of each stream.
    warnings : tuple of str
        Warnings that become part of the result.
    time_offset : TimeOffset or None
        Time offset of the kept pairs, if it was estimated.
    beside_motion : tuple
        Measurements of the extrinsic that do not come from motion, such as those from the ground.
        The method ``joined(calibration, snapshot)`` returns the calibration combined with the
        measurement.
    bags : tuple of Path
        Bags that contain the streams, for pictures of the report; empty for other sources.
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
    beside_motion: tuple[Any, ...] = ()
    bags: tuple[Path, ...] = ()

    @property
    def parent_frame(self) -> str:
        """Name of the parent sensor's frame, which stays the same if options invert the poses."""
        return self._frame("parent")

    @property
    def child_frame(self) -> str:
        """Name of the child sensor's frame, which stays the same if options invert the poses."""
        return self._frame("child")

    def _frame(self, stream: str) -> str:
        """Return the name of a stream's sensor frame, or a default name."""
        names, other = self._names(stream)
        name = names.name
        if (
            getattr(self.config, f"{stream}_invert") == "poses"
            and names.inverse_name != other.name
        ):
            name = names.inverse_name
        return name or f"{stream}_sensor"

    def _names(self, stream: str) -> tuple[StreamFrames, StreamFrames]:
        """Return the names of the frames of a stream, and those of the other stream."""
        if stream == "parent":
            return self.parent_names, self.child_names
        return self.child_names, self.parent_names

    @property
    def frame_warnings(self) -> tuple[str, ...]:
        """Warnings about sensor frames without a name, or renamed because poses are inverted."""
        warnings = []
        for stream, frame in zip(
            STREAMS, (self.parent_frame, self.child_frame), strict=True
        ):
            names, _ = self._names(stream)
            if frame == f"{stream}_sensor":
                warnings.append(
                    f"the {stream} stream does not name its sensor's frame; it is called '{frame}' "
                    f"here (name it with {stream}_frame)"
                )
            elif frame != names.name:
                observed = names.name or "what it observes"
                text = f"the {stream} sensor is now {frame}, because its poses are inverted: "
                text += f"poses of {frame} in {observed}"
                if names.option:
                    text += f", which {stream}_frame names"
                warnings.append(text)
        return tuple(warnings)

    def _check_frames(self) -> None:
        """Raise InputError if both sensors have the same frame, or if options exchange frames."""
        nameless = "a sensor without name"
        for stream in STREAMS:
            names, other = self._names(stream)
            if (
                names.option not in ("", names.sensor)
                and names.option == other.sensor
            ):
                raise InputError(
                    f"{stream}_frame is {names.option}, but that is the frame of the other stream: "
                    f"the parent stream is of {self.parent_names.sensor or nameless}, "
                    f"the child stream of {self.child_names.sensor or nameless}; "
                    "exchange the two streams, or the two names"
                )
        if self.parent_names.option == self.child_names.option != "":
            raise InputError(
                f"parent_frame and child_frame are both {self.parent_frame!r}; give each sensor "
                "its own frame, such as lidar and camera"
            )
        if self.parent_frame == self.child_frame:
            raise InputError(
                f"both streams name {self.parent_frame!r} as their sensor frame. If they are of "
                "two sensors, set parent_frame and child_frame; if they are of one, there is "
                "nothing to calibrate"
            )

    @property
    def unpaired(self) -> tuple[Trajectory, Trajectory]:
        """Trajectories of parent and child, with all poses that are not paired yet.

        Options about conventions and units, and the clock rate of the child, are applied.
        """
        parent = _corrected(self.buffered_parent, "parent", self.config)
        child = _corrected(self.buffered_child, "child", self.config)
        if self.time_offset:
            child = self.time_offset.steadied(child)
        return parent, child

    @cached_property
    def resolved(self) -> "Snapshot":
        """The same snapshot with its time offset as a number (s).

        If the option ``time_offset`` is "estimate", the number is the offset of the kept pairs, or
        without kept pairs an estimate from the buffered poses.

        Raises
        ------
        NotEnoughDataError
            If the time offset cannot be estimated.
        """
        if not isinstance(self.config.time_offset, str):
            return self
        offset = self.time_offset or estimated_time_offset(
            self.config, *self.unpaired
        )
        config = replace(self.config, time_offset=offset.seconds)
        return replace(self, config=config, time_offset=offset)

    @cached_property
    def correlation(self) -> Correlation:
        """Best correlation of the angular rates of both streams over all time offsets."""
        if (
            self.time_offset
            and self.time_offset.correlation.is_clear
            and not len(self.kept)
        ):
            return self.time_offset.correlation
        return correlate_rates(*self.streams, self.max_gap_s)

    @property
    def max_gap_s(self) -> float:
        """Longest gap (s) of :attr:`streams` in which poses are interpolated."""
        if not len(self.kept):
            return self.config.max_gap
        return max(
            self.config.max_gap, _GAP_INTERVALS * self.streams[0].interval_s
        )

    @cached_property
    def pose_pairs(self) -> PosePairs:
        """Synchronised pose pairs: the kept pairs, followed by pairs of the buffered poses.

        Raises the same errors as :attr:`resolved`.
        """
        if self.resolved is not self:
            return self.resolved.pose_pairs
        kept = self.kept
        if len(kept):
            parent = _corrected(
                Trajectory(kept.stamps_ns, kept.Ts_pw_p), "parent", self.config
            )
            child = _corrected(
                Trajectory(kept.stamps_ns, kept.Ts_cw_c), "child", self.config
            )
            kept = PosePairs(kept.stamps_ns, parent.poses, child.poses)
        pairs = pair_poses(self.config, *self.unpaired, self.paired_at, kept)
        if len(kept):
            pairs = PosePairs.concatenate(kept, pairs)
        return downsample(pairs, self.config.max_pairs)

    def pose_pairs_of(self, calibration: Calibration) -> PosePairs:
        """Return the pose pairs with the clock offset and the scale of a result."""
        # The result contains the clock offset, so it is not estimated again.
        settled = replace(self.config, time_offset=calibration.time_offset_s)
        pose_pairs = replace(self, config=settled).pose_pairs
        return pose_pairs.child_scaled(calibration.scale)

    def examined(self, calibration: Calibration) -> Calibration:
        """Return a calibration with the examinations of extras, which depend on its sigmas."""
        for examine in RESULT_EXAMINATIONS.values():
            calibration = examine(calibration, self.resolved)
        return calibration

    def estimate(self, cross_check: bool | None = None) -> Calibration:
        """Estimate the extrinsic.

        Parameters
        ----------
        cross_check : bool, optional
            Whether to compare the result with results of other strides and of both halves. By
            default, it is compared unless the user set a reference. With False, the examinations of
            extras are also skipped.

        Raises
        ------
        NotEnoughDataError
            If fewer than ``min_pairs`` poses can be paired; the message names the missing data.
        InputError
            If both streams have the same sensor frame, or if an option gives one stream the frame
            of the other.
        ConfigError
            If an option has no effect on the quantities that the streams measure.
        """
        self._check_frames()
        kind = kind_of(self.config)
        kind.require_allowed(self.config)
        resolved = self.resolved
        self.require_pairs()
        result = kind.solve(resolved, cross_check)
        for measurement in self.beside_motion:
            result = measurement.joined(result, resolved)
        if cross_check is not False:
            result = self.examined(result)
        return replace(
            result,
            parent_frame=self.parent_frame,
            child_frame=self.child_frame,
            warnings=self.frame_warnings + self.warnings + result.warnings,
        )

    @cached_property
    def streams(self) -> tuple[Trajectory, Trajectory]:
        """Trajectories of the whole session, each stream on its own clock.

        With kept pairs, the trajectories contain the poses of all pairs; without, all received
        poses.
        """
        parent, child = self.unpaired
        if len(self.kept):
            pairs = self.pose_pairs
            parent = Trajectory(pairs.stamps_ns, pairs.Ts_pw_p)
            child = Trajectory(pairs.stamps_ns, pairs.Ts_cw_c)
            child = child.shifted(-float(self.resolved.config.time_offset))
        return (
            _measuring(parent, self.config.parent_measures),
            _measuring(child, self.config.child_measures),
        )

    def require_pairs(self) -> None:
        """Raise NotEnoughDataError with the reason if too few poses can be paired."""
        resolved = self.resolved
        pairs = self.pose_pairs
        if len(pairs) < resolved.config.min_pairs:
            raise NotEnoughDataError(resolved._missing_data(len(pairs)))

    def _missing_data(self, n_pairs: int) -> str:
        """Return a message about the reason why only ``n_pairs`` poses could be paired."""
        needed = f"{self.config.min_pairs} synchronised pose pairs are needed, found {n_pairs}"
        parent, child = self.unpaired
        child = child.shifted(float(self.config.time_offset))
        for name, stream in zip(STREAMS, (parent, child), strict=True):
            if len(stream) == 0:
                return f"{needed}: no poses on the {name} stream"
        start_ns = max(parent.stamps_ns[0], child.stamps_ns[0])
        end_ns = min(parent.stamps_ns[-1], child.stamps_ns[-1])
        common_s = (end_ns - start_ns) * 1e-9
        counts = f"{len(parent)} parent and {len(child)} child poses"
        if common_s < 0:
            offset_s = float(self.config.time_offset)
            _, recorded_child = self.unpaired
            overlap_ns = min(
                parent.stamps_ns[-1], recorded_child.stamps_ns[-1]
            ) - max(parent.stamps_ns[0], recorded_child.stamps_ns[0])
            if offset_s and overlap_ns > 0:
                return (
                    f"{needed}: after the {offset_s:g} s of time_offset the streams do not overlap "
                    f"({counts}); omit time_offset, because the streams overlap without it"
                )
            return (
                f"{needed}: the streams do not overlap in time ({counts}, {-common_s:.3f} s "
                "apart); if their clocks differ, set time_offset to estimate or to the seconds "
                "between them"
            )
        return (
            f"{needed}: {counts} overlap for {common_s:.2f} s; record longer, or raise max_gap for "
            "a slow stream"
        )


def _measuring(trajectory: Trajectory, measures: str) -> Trajectory:
    """Return the trajectory with the measured quantity of the option, except for "auto"."""
    if measures in ("auto", trajectory.measures):
        return trajectory
    return replace(trajectory, measures=measures)


def _corrected(
    trajectory: Trajectory, stream: str, config: CalibratorConfig
) -> Trajectory:
    """Return a stream with the options about inversion, quaternions and parent scale applied.

    Raises
    ------
    ConfigError
        If the options have no effect on the quantity that the stream measures.
    """
    invert = getattr(config, f"{stream}_invert")
    order = getattr(config, f"{stream}_quaternion")
    if (invert, order) != ("none", "xyzw"):
        kind = trajectory.measures
        if kind not in ("poses", "rotations") or (invert, kind) == (
            "poses",
            "rotations",
        ):
            options = f"{stream}_invert {invert}, {stream}_quaternion {order}"
            raise ConfigError(
                f"{options} cannot be: the {stream} measures {kind}; omit these options"
            )
        trajectory = replace(
            trajectory, poses=se3.put_right(trajectory.poses, invert, order)
        )
    if stream == "parent" and config.parent_scale != 1.0:
        return trajectory.scaled(config.parent_scale)
    return trajectory


def options_of_streams(
    parent: Trajectory, child: Trajectory
) -> dict[str, float | str]:
    """Return the options that follow from whole trajectories, unless the user sets them."""
    return {
        "max_pairs": min(max(len(parent), len(child), 10), _MAX_PAIRS),
        "parent_measures": parent.measures,
        "child_measures": child.measures,
    }


def whole_snapshot(
    parent: Trajectory, child: Trajectory, options: Mapping[str, object]
) -> Snapshot:
    """Return the snapshot of two whole trajectories.

    Parameters
    ----------
    parent, child : Trajectory
    options : mapping
        Options by their public names. If ``max_pairs`` is not set, up to 100,000 pairs are used.
    """
    of_streams = options_of_streams(parent, child)
    config = CalibratorConfig.from_options(of_streams | dict(options))
    warnings: tuple[str, ...] = ()
    if min(len(parent), len(child)) > config.max_pairs == _MAX_PAIRS:
        warnings = (
            f"{_MAX_PAIRS:,} pose pairs are used at most; set max_pairs to use more",
        )
    return Snapshot(
        config=config,
        buffered_parent=parent,
        buffered_child=child,
        parent_names=names_of(
            config, "parent", parent.sensor_frame, parent.world_frame
        ),
        child_names=names_of(
            config, "child", child.sensor_frame, child.world_frame
        ),
        warnings=warnings,
    )


def names_of(
    config: CalibratorConfig, stream: str, sensor: str, world: str
) -> StreamFrames:
    """Return the names of the frames of a stream, from its messages and the options."""
    option = getattr(config, f"{stream}_frame")
    return StreamFrames(
        frame_name(sensor), frame_name(world), frame_name(option)
    )


def estimated_time_offset(
    config: CalibratorConfig, parent: Trajectory, child: Trajectory
) -> TimeOffset:
    """Estimate the time offset of two streams from the rates of their kind of data."""
    of_speed = kind_of(config).is_timed_by_speed
    return estimate_time_offset(parent, child, config.max_gap, of_speed)


def downsample(pose_pairs: PosePairs, max_pairs: int) -> PosePairs:
    """Return at most ``max_pairs`` of the pose pairs.

    In each round, every second pair is a candidate. A round drops the candidates that matter least:
    the parent rotates little between the pair before and the pair after them. The rounds end when
    at most ``max_pairs`` remain.
    """
    while len(pose_pairs) > max_pairs:
        candidates = np.arange(1, len(pose_pairs) - 1, 2)
        rotations = se3.rotation_of(pose_pairs.Ts_pw_p)
        # Trace of the rotation between both neighbours: 1 + 2 cos(angle).
        traces = np.einsum(
            "kij,kij->k", rotations[candidates - 1], rotations[candidates + 1]
        )
        # Drop a tenth of ``max_pairs`` more than needed, but at most half of the candidates.
        n_drop = min(
            len(pose_pairs) - max_pairs + max_pairs // 10,
            (len(candidates) + 1) // 2,
        )
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
    """Pair two trajectories. Return the pairs that are keyframes and later than ``kept``.

    Parameters
    ----------
    config : CalibratorConfig
        Options. Their time offset is a number (s).
    parent, child : Trajectory
        Streams, each on its own clock.
    at : {"parent", "child"} or None
        Stream whose stamps the pairs have; None for the slower stream.
    kept : PosePairs
        Earlier pairs.
    """
    pairs = synchronise(
        parent, child.shifted(float(config.time_offset)), config.max_gap, at
    )
    if len(kept):
        pairs = pairs[pairs.stamps_ns > kept.stamps_ns[-1]]
    keyframes = select_keyframes(
        pairs,
        config.keyframe_min_translation,
        config.keyframe_min_rotation,
        config.keyframe_min_interval,
        previous=kept[-1:],
    )
    return pairs if len(keyframes) == len(pairs) else pairs[keyframes]
