"""What a report shows beside the result: paths, excitation, and both streams before any solve."""

from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.core.alignment.time_offset import angular_rates
from hand_eye_calib.core.assessment.excitation import Excitation, excitation
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.checks.streams import are_gaps, coarse
from hand_eye_calib.core.engine.snapshot import Snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import Calibration

# Shortest step (s) of a path length: over shorter steps it would be the length of the noise.
_PATH_STEP_S = 0.2

# Most samples of the angular rates, and the shortest window of each (s).
_MAX_RATES = 1500
_MIN_WINDOW_S = 0.2


@dataclass(frozen=True, kw_only=True)
class StreamSummary:
    """Size and motion of a stream: the rate is of the median interval; path length and the sum of
    all rotation angles are None without positions, orientations.
    """

    poses: int
    duration_s: float
    rate_hz: float
    longest_interval_s: float
    path_m: float | None
    rotation_rad: float | None


def summarise(trajectory: Trajectory) -> StreamSummary:
    """StreamSummary of a trajectory of at least two poses."""
    intervals_s = np.diff(trajectory.stamps_ns) * 1e-9
    poses = coarse(trajectory, max(_PATH_STEP_S, median(intervals_s))).poses
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    angles = se3.rotation_angle(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3])
    return StreamSummary(
        poses=len(trajectory),
        duration_s=trajectory.duration_s,
        rate_hz=float(1.0 / median(intervals_s)),
        longest_interval_s=float(intervals_s.max()),
        path_m=float(steps.sum()) if trajectory.has_positions else None,
        rotation_rad=float(angles.sum()) if trajectory.has_rotations else None,
    )


@dataclass(frozen=True, kw_only=True)
class StreamView:
    """What the streams show before any solve, on the parent's clock and in its unit of length;
    first the parent, then the child.

    Attributes
    ----------
    quantity : {"angular rate", "speed"}
        What is shown over time: the speed if one sensor has positions alone.
    rates : 2 x (times_s, rates)
        rad/s or m/s; NaN in gaps.
    spans_s : 2 x (M, 2) arrays
        Start and end of the times in which each stream has poses, without longer gaps.
    """

    quantity: str
    rates: tuple[tuple[FloatArray, FloatArray], ...]
    spans_s: tuple[FloatArray, ...]

    @property
    def apart(self) -> float:
        """Median difference of both rates (rad/s) or speeds (m/s); NaN if they never overlap."""
        (times, of_parent), (others, of_child) = self.rates
        shared = (times >= others[0]) & (times <= others[-1]) if len(others) else times < 0
        apart = np.abs(of_parent - np.interp(times, others, of_child))[shared]
        return median(apart[np.isfinite(apart)])


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What the figures show beside the Calibration itself.

    Attributes
    ----------
    times_s, parent, child : (N,), (N, 3), (N, 3) arrays
        Times, s, and two paths, m, of one sensor: as its own stream has it, and from the other
        stream through the result. It is the parent, in its world; or the sensor that has positions
        alone, in theirs.
    excitation : Excitation
        How the sensors moved.
    streams : StreamView
    has_positions_of_parent : bool
        The parent has positions alone.
    """

    times_s: FloatArray
    parent: FloatArray
    child: FloatArray
    excitation: Excitation
    streams: StreamView
    has_positions_of_parent: bool


def gather(calibration: Calibration, snapshot: Snapshot) -> Evidence:
    """Collect the evidence of a result from the poses and options that gave it."""
    config = snapshot.config
    # The time offset is settled; estimating it again would cost time.
    settled = replace(config, time_offset=calibration.time_offset_s)
    pose_pairs = replace(snapshot, config=settled).pose_pairs.child_scaled(calibration.scale)
    of_parent = config.parent_measures == "positions"
    turned = PosePairs(pose_pairs.stamps_ns, pose_pairs.Ts_cw_c, pose_pairs.Ts_pw_p)
    parent, child = snapshot.streams
    shifted = child.shifted(calibration.time_offset_s).scaled(calibration.scale)
    paths = _paths(calibration, pose_pairs, of_parent)
    return Evidence(
        times_s=(pose_pairs.stamps_ns - pose_pairs.stamps_ns[0]) * 1e-9,
        parent=paths[0],
        child=paths[1],
        excitation=excitation(turned if of_parent else pose_pairs),
        streams=view_streams(parent, shifted, config.max_gap),
        has_positions_of_parent=of_parent,
    )


def view_streams(parent: Trajectory, child: Trajectory, max_gap_s: float) -> StreamView:
    """The StreamView of two trajectories on one clock, in one unit of length."""
    start_ns = min(parent.stamps_ns[0], child.stamps_ns[0])
    longest_s = max(parent.duration_s, child.duration_s)
    step_s = max(parent.interval_s, child.interval_s, longest_s / _MAX_RATES)
    has_rates = parent.has_rotations and child.has_rotations
    rates = []
    spans = []
    for stream in (parent, child):
        window_s = max(3 * step_s, _MIN_WINDOW_S)
        found = angular_rates(stream, window_s, step_s, max_gap_s, of_speed=not has_rates)
        steps = np.arange(len(found)) * step_s
        rates.append(((stream.stamps_ns[0] - start_ns) * 1e-9 + steps, found))
        gaps = np.flatnonzero(are_gaps(np.diff(stream.stamps_ns) * 1e-9, max_gap_s))
        edges = stream.stamps_ns[np.sort(np.r_[0, gaps, gaps + 1, len(stream) - 1])]
        spans.append((edges.reshape(-1, 2) - start_ns) * 1e-9)
    return StreamView(
        quantity="angular rate" if has_rates else "speed", rates=tuple(rates), spans_s=tuple(spans)
    )


def _paths(
    calibration: Calibration, pose_pairs: PosePairs, of_parent: bool
) -> tuple[FloatArray, FloatArray]:
    """Both paths, the child's world aligned with the parent's: by the mean over all poses, or by
    the paths if one sensor has positions alone.
    """
    if calibration.measured == "positions":
        poses = pose_pairs.Ts_pw_p @ calibration.T_parent_child
        measured = pose_pairs.Ts_cw_c
        if of_parent:
            poses = pose_pairs.Ts_cw_c @ calibration.T_child_parent
            measured = pose_pairs.Ts_pw_p
        path = poses[:, :3, 3]
        positions = measured[:, :3, 3]
        path = path - path.mean(axis=0)
        rotation = se3.nearest_rotation((positions - positions.mean(axis=0)).T @ path)
        path = path @ rotation.T + positions.mean(axis=0)
        parent, child = (positions, path) if of_parent else (path, positions)
        return parent - positions[0], child - positions[0]
    Ts_cw_p = pose_pairs.Ts_cw_c @ calibration.T_child_parent
    rotations = pose_pairs.Ts_pw_p[:, :3, :3] @ np.swapaxes(Ts_cw_p[:, :3, :3], 1, 2)
    parent = pose_pairs.Ts_pw_p[:, :3, 3]
    child = Ts_cw_p[:, :3, 3] @ se3.nearest_rotation(rotations.mean(axis=0)).T
    child = child + np.median(parent - child, axis=0)
    return parent - parent[0], child - parent[0]
