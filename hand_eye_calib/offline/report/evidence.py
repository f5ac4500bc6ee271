"""Evidence for a result in its report: both paths, motion, and both streams before the solve."""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.alignment.rate_correlation import angular_rates
from hand_eye_calib.core.assessment.excitation import Excitation, excitation
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.checks.streams import are_gaps, coarse
from hand_eye_calib.core.engine.snapshot import Snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.document import UNKNOWN_M

# Shortest step (s) in the length of a path. Shorter steps would add up noise.
_MIN_PATH_STEP_S = 0.2

# A motion is in a plane if the variance of positions across it is at most this multiple of the
# smaller variance in it. Chosen, not measured.
_MAX_FLAT = 0.25
# Smallest cosine between an axis and the normal of this plane (30 deg). Chosen, not measured.
_MIN_UPRIGHT = 0.87

# Largest number of samples of the rates of a stream.
_MAX_RATES = 1500
# Shortest window (s) over which a rate is computed.
_MIN_WINDOW_S = 0.2


@dataclass(frozen=True, kw_only=True)
class StreamSummary:
    """Size and motion of a stream.

    Attributes
    ----------
    poses : int
        Number of poses.
    duration_s : float
        Time between the first and the last pose (s).
    rate_hz : float
        Inverse of the median interval (Hz).
    longest_interval_s : float
        Longest interval between two poses (s).
    path_m : float or None
        Length of the path (m); None without positions.
    rotation_rad : float or None
        Sum of all rotation angles (rad); None without orientations.
    """

    poses: int
    duration_s: float
    rate_hz: float
    longest_interval_s: float
    path_m: float | None
    rotation_rad: float | None


# Kinds of trajectories whose orientations are measured.
_WITH_ROTATION = ("poses", "rotations", "rates")


def summarise(trajectory: Trajectory) -> StreamSummary:
    """Summarise a trajectory of at least two poses."""
    intervals_s = np.diff(trajectory.stamps_ns) * 1e-9
    poses = coarse(trajectory, max(_MIN_PATH_STEP_S, median(intervals_s))).poses
    steps = np.linalg.norm(np.diff(se3.translation_of(poses), axis=0), axis=1)
    rotations = se3.rotation_of(poses)
    angles = se3.rotation_angle(
        se3.relative_rotations(rotations[:-1], rotations[1:])
    )
    # The columns of other kinds, such as the angles of wheels, are no orientations.
    measures_rotation = trajectory.measures in _WITH_ROTATION
    return StreamSummary(
        poses=len(trajectory),
        duration_s=trajectory.duration_s,
        rate_hz=float(1.0 / median(intervals_s)),
        longest_interval_s=float(intervals_s.max()),
        path_m=float(steps.sum()) if trajectory.has_positions else None,
        rotation_rad=float(angles.sum()) if measures_rotation else None,
    )


@dataclass(frozen=True, kw_only=True)
class StreamView:
    """Angular rates or speeds of both streams before the solve: first the parent, then the child.

    Times are on the parent's clock, lengths in the parent's unit.

    Attributes
    ----------
    quantity : {"angular rate", "speed"}
        Speed if one sensor has positions without orientations.
    rates : 2 x (times_s, rates)
        Times (s) and rates (rad/s or m/s) of each stream; NaN in gaps.
    spans_s : 2 x (M, 2) arrays
        Start and end (s) of each time for which a stream has poses without a long gap.
    """

    quantity: str
    rates: tuple[tuple[FloatArray, FloatArray], ...]
    spans_s: tuple[FloatArray, ...]

    @property
    def difference(self) -> float:
        """Median difference of both rates (rad/s or m/s); NaN if the streams never overlap."""
        (times_s, parent_rates), (child_times_s, child_rates) = self.rates
        if not len(child_times_s):
            return float("nan")
        is_shared = (times_s >= child_times_s[0]) & (
            times_s <= child_times_s[-1]
        )
        differences = np.abs(
            parent_rates - np.interp(times_s, child_times_s, child_rates)
        )
        differences = differences[is_shared]
        return median(differences[np.isfinite(differences)])


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Data that the figures of a report draw, in addition to the Calibration.

    Attributes
    ----------
    times_s : (N,) array
        Times of both paths (s).
    parent, child : (N, 3) arrays
        Two paths of one sensor (m): from the parent's stream, and from the child's stream. One path
        is measured by the sensor; the other is computed from the other stream and the result. The
        sensor is the one that has positions without orientations, or else the parent. The paths are
        in the world of this sensor and begin at its first position.
    angles : 2 x (N, 3) arrays, or None
        Angles (rad) by which the parent has turned about its own x, y and z since its first pose:
        measured, and computed from the child's stream. Their difference is the rotation vector
        between the measured and the computed pose. None if a stream does not measure poses.
    excitation : Excitation
        Motion of the sensors.
    streams : StreamView
        Rates of both streams.
    without_lever_arm : (N, 3) array, or None
        Computed path (m) as if both sensors were at one place. None unless a sensor has positions
        without orientations.
    has_positions_of_parent : bool
        Whether the parent has positions without orientations.
    is_upright : bool
        Whether z of the sensor is near the normal of the plane in which it moves.
    """

    times_s: FloatArray
    parent: FloatArray
    child: FloatArray
    angles: tuple[FloatArray, FloatArray] | None
    excitation: Excitation
    streams: StreamView
    without_lever_arm: FloatArray | None
    has_positions_of_parent: bool
    is_upright: bool


def gather(calibration: Calibration, snapshot: Snapshot) -> Evidence:
    """Compute the evidence for a result from its poses and options."""
    config = snapshot.config
    pose_pairs = snapshot.pose_pairs_of(calibration)
    parent_is_positions = config.parent_measures == "positions"
    # Pairs for the excitation, which is computed from the first sensor's orientations.
    oriented = pose_pairs
    if parent_is_positions:
        oriented = PosePairs(
            pose_pairs.stamps_ns, pose_pairs.Ts_cw_c, pose_pairs.Ts_pw_p
        )
    parent, child = snapshot.streams
    shifted = child.shifted(calibration.time_offset_s).scaled(calibration.scale)
    without_lever_arm = None
    if calibration.measured == "positions":
        measured, computed, without_lever_arm = _paths_of_positions(
            calibration, pose_pairs, parent_is_positions
        )
        parent_path, child_path = computed, measured
        if parent_is_positions:
            parent_path, child_path = measured, computed
    else:
        parent_path, child_path = _paths_of_poses(calibration, pose_pairs)
    angles = None
    if calibration.measured == "poses":
        angles = _angles(calibration, pose_pairs)
    return Evidence(
        times_s=(pose_pairs.stamps_ns - pose_pairs.stamps_ns[0]) * 1e-9,
        parent=parent_path,
        child=child_path,
        angles=angles,
        excitation=excitation(oriented),
        streams=view_streams(parent, shifted, config.max_gap),
        without_lever_arm=without_lever_arm,
        has_positions_of_parent=parent_is_positions,
        is_upright=_is_upright(oriented.Ts_pw_p),
    )


def view_streams(
    parent: Trajectory, child: Trajectory, max_gap_s: float
) -> StreamView:
    """Return the rates of two trajectories on one clock and in one unit of length."""
    start_ns = min(parent.stamps_ns[0], child.stamps_ns[0])
    longest_s = max(parent.duration_s, child.duration_s)
    step_s = max(parent.interval_s, child.interval_s, longest_s / _MAX_RATES)
    window_s = max(3 * step_s, _MIN_WINDOW_S)
    has_rates = parent.has_rotations and child.has_rotations
    rates = []
    spans_s = []
    for stream in (parent, child):
        values = angular_rates(
            stream, window_s, step_s, max_gap_s, of_speed=not has_rates
        )
        first_s = (stream.stamps_ns[0] - start_ns) * 1e-9
        rates.append((first_s + np.arange(len(values)) * step_s, values))
        # A gap is the end of one span and the start of the next. So the sorted edges are pairs of
        # start and end.
        gaps = np.flatnonzero(
            are_gaps(np.diff(stream.stamps_ns) * 1e-9, max_gap_s)
        )
        edges = np.sort(np.r_[0, gaps, gaps + 1, len(stream) - 1])
        edges_ns = stream.stamps_ns[edges]
        spans_s.append((edges_ns.reshape(-1, 2) - start_ns) * 1e-9)
    quantity = "angular rate" if has_rates else "speed"
    return StreamView(
        quantity=quantity, rates=tuple(rates), spans_s=tuple(spans_s)
    )


def _paths_of_positions(
    calibration: Calibration, pose_pairs: PosePairs, parent_is_positions: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return three paths (N, 3) of the sensor with positions, m.

    The first path is measured, and begins at 0. The second path is computed from the poses of the
    other sensor and the result. The third path is computed from these poses alone. The second and
    third path are fitted to the first by a rotation and a translation.
    """
    if parent_is_positions:
        poses = pose_pairs.Ts_cw_c
        T_oriented_point = calibration.T_child_parent
        positions = se3.translation_of(pose_pairs.Ts_pw_p)
    else:
        poses = pose_pairs.Ts_pw_p
        T_oriented_point = calibration.T_parent_child
        positions = se3.translation_of(pose_pairs.Ts_cw_c)
    measured = positions - positions[0]
    computed = moved_onto(
        measured, se3.translation_of(poses @ T_oriented_point)
    )
    return measured, computed, moved_onto(measured, se3.translation_of(poses))


def moved_onto(measured: FloatArray, path: FloatArray) -> FloatArray:
    """Fit a path (N, 3) to a measured path (N, 3) by the best rotation and translation."""
    center = measured.mean(axis=0)
    path = path - path.mean(axis=0)
    rotation = se3.nearest_rotation((measured - center).T @ path)
    return path @ rotation.T + center


def _paths_of_poses(
    calibration: Calibration, pose_pairs: PosePairs
) -> tuple[FloatArray, FloatArray]:
    """Return the path (N, 3) of the parent: measured, and computed from the child's stream.

    The measured path begins at 0. The computed path is fitted to it by the mean rotation between
    the worlds and by the median difference.
    """
    Ts_cw_p = pose_pairs.Ts_cw_c @ calibration.T_child_parent
    parent = se3.translation_of(pose_pairs.Ts_pw_p)
    child = (
        se3.translation_of(Ts_cw_p)
        @ rotation_between_worlds(pose_pairs, Ts_cw_p).T
    )
    child = child + np.median(parent - child, axis=0)
    return parent - parent[0], child - parent[0]


def rotation_between_worlds(
    pose_pairs: PosePairs, Ts_cw_p: FloatArray
) -> FloatArray:
    """Return the mean rotation (3, 3) from the child's world to the parent's world.

    ``Ts_cw_p`` (N, 4, 4) are the parent's poses in the child's world.
    """
    to_parent_world = se3.rotation_of(pose_pairs.Ts_pw_p)
    from_child_world = np.swapaxes(se3.rotation_of(Ts_cw_p), 1, 2)
    rotations = to_parent_world @ from_child_world
    return se3.nearest_rotation(rotations.mean(axis=0))


def _angles(
    calibration: Calibration, pose_pairs: PosePairs
) -> tuple[FloatArray, FloatArray]:
    """Return the angles (N, 3) turned about the parent's axes: measured, and computed.

    The measured angles (rad) are sums of the rotation vectors from pose to pose. Unlike roll, pitch
    and yaw, they are not singular at a pitch of 90 deg. The computed angles are the measured angles
    plus a rotation vector: from the measured pose to the pose that is computed from the child's
    stream and the result.
    """
    Ts_cw_p = pose_pairs.Ts_cw_c @ calibration.T_child_parent
    measured = se3.rotation_of(pose_pairs.Ts_pw_p)
    computed = rotation_between_worlds(pose_pairs, Ts_cw_p) @ se3.rotation_of(
        Ts_cw_p
    )
    steps_rad = se3.rotations_between(measured[:-1], measured[1:])
    measured_rad = np.vstack([np.zeros(3), np.cumsum(steps_rad, axis=0)])
    errors_rad = se3.rotations_between(measured, computed)
    return measured_rad, measured_rad + errors_rad


def turning_part(
    path: FloatArray, times_s: FloatArray, least_s: float
) -> slice:
    """Return the part of a path (N, 3) in which the sensor turns most.

    All parts have equal durations: a tenth of the path's duration, and at least ``least_s``. The
    returned part has the largest ratio of its length to the distance of its ends. Parts shorter
    than half of the median length are left out.
    """
    duration_s = max(times_s[-1] / 10, least_s)
    ends = np.searchsorted(times_s, times_s + duration_s)
    starts = np.flatnonzero(ends < len(times_s))
    if not len(starts):
        return slice(0, len(times_s))
    ends = ends[starts]
    # Steps between distant poses add up the motion instead of the noise.
    stride = max(1, round(_MIN_PATH_STEP_S / median(np.diff(times_s))))
    way = np.r_[
        0.0, np.cumsum(np.linalg.norm(np.diff(path[::stride], axis=0), axis=1))
    ]
    travelled = np.interp(times_s, times_s[::stride], way)
    lengths = travelled[ends] - travelled[starts]
    chords = np.linalg.norm(path[ends] - path[starts], axis=1)
    is_long = 2 * lengths >= median(lengths)
    ratios = np.where(is_long, lengths / (chords + 0.1 * lengths), 0.0)
    row = int(np.argmax(ratios))
    return slice(int(starts[row]), int(ends[row]) + 1)


def _is_upright(poses: FloatArray) -> bool:
    """Return whether z of a sensor with ``poses`` (N, 4, 4) is near the normal of its plane."""
    return upward_normal(poses) is not None


def upward_normal(poses: FloatArray) -> FloatArray | None:
    """Return the normal (3,) of the plane in which a sensor moves, on the side of its z axis.

    ``poses`` (N, 4, 4) are poses of the sensor in its world. The result is None if the sensor moves
    in all directions, or if its z axis is not near the normal.
    """
    variances, axes = np.linalg.eigh(np.cov(se3.translation_of(poses).T))
    normal = axes[:, 0]
    # Cosine between the normal of the plane and z of the sensor.
    cosine = float(np.mean(poses[:, :3, 2] @ normal))
    is_flat = variances[0] <= _MAX_FLAT * variances[1]
    if not is_flat or abs(cosine) <= _MIN_UPRIGHT:
        return None
    return np.asarray(np.copysign(1.0, cosine) * normal)


def spread_of_position(
    calibration: Calibration,
) -> tuple[FloatArray, FloatArray]:
    """Return covariance and unknown directions of the child's position, in the parent's axes.

    Returns
    -------
    covariance : (3, 3) array
        Covariance (m^2) without its part along unknown directions.
    unknown : (K, 3) array
        Unit vectors of the unknown directions.
    """
    sigmas_m = calibration.sigmas[:3]
    is_unknown = ~np.isfinite(sigmas_m)
    covariance = calibration.covariance[:3, :3]
    if np.isfinite(covariance).all():
        R = se3.rotation_of(calibration.T_parent_child)
        variances, directions = np.linalg.eigh(R @ covariance @ R.T)
        if not is_unknown.any():
            return (directions * variances) @ directions.T, np.empty((0, 3))
        # An unknown direction need not be parallel to an axis. It is an eigenvector with a huge
        # variance.
        is_huge = variances > UNKNOWN_M**2
        if is_huge.any():
            finite = directions[:, ~is_huge]
            unknown_directions = directions[:, is_huge].T
            return (finite * variances[~is_huge]) @ finite.T, unknown_directions
    # The unknown directions are the axes without a standard deviation.
    variances_m2 = np.where(is_unknown, 0.0, sigmas_m) ** 2
    return np.diag(variances_m2), np.eye(3)[is_unknown]
