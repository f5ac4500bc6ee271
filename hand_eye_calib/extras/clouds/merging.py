"""Merge a few scans of both sensors in the parent's world, before and after the calibration."""

from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from hand_eye_calib.core.assessment.comparison import installed_transform
from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.engine.snapshot import Snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.formats.bags.messages import POINTS_TYPE, Run, ns_of
from hand_eye_calib.formats.bags.points import (
    rows_of_points,
    times_of_points,
    topics_and_frames,
)
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.offline.report.evidence import upward_normal


@dataclass(frozen=True)
class Tuning:
    """Constants of the merged clouds. All of them are choices, not measured."""

    # Number of scans of each sensor.
    n_scans: int = 4
    # Longest time (s) from the first scan to the last scan. It is short because odometry drifts.
    longest_s: float = 30.0
    # Sufficient rotation (rad) between the first and the last scan.
    sufficient_turn: float = np.pi / 2
    # Time (s) between compared poses. Each scan is then shifted by up to twice this time, to the
    # instant at which the sensor rotates most slowly.
    step_s: float = 0.5
    # Largest number of points of a scan, evenly drawn.
    max_points: int = 5_000
    # Smallest and largest range of a point (m): nearer points are on the vehicle.
    ranges_m: tuple[float, float] = (1.0, 80.0)
    # A plane is fitted to this number of neighbours within this distance (m).
    n_neighbours: int = 12
    reach_m: float = 1.0
    # Largest variance of a plane along its normal, as a share of its next larger variance.
    max_flat: float = 0.1


TUNING = Tuning()


class _Cloud(NamedTuple):
    """Points (N, 3) in the frame of their sensor, m, and their stamps (N,), ns."""

    points: FloatArray
    stamps_ns: IntArray


@dataclass(frozen=True, eq=False)
class MergedClouds:
    """Scans of both sensors in the axes of the picture (m).

    The origin is the parent's position at its first scan, and x is near the parent's x axis.

    Attributes
    ----------
    parent : (N, 3) array
        Points of the parent.
    before, after : (M, 3) arrays
        Points of the child, before the calibration and through the result.
    is_upright : bool
        Whether z is the normal of the plane of motion; otherwise it is an axis of the surfaces.
    turn_rad : float
        Largest angle between two poses of the parent at its scans.
    """

    parent: FloatArray
    before: FloatArray
    after: FloatArray
    is_upright: bool
    turn_rad: float


def merge(calibration: Calibration, snapshot: Snapshot) -> MergedClouds | None:
    """Merge the clouds of a recording; None unless both sensors have clouds in their frames.

    Clouds are also not used if their stamps are outside the poses of the parent.
    """
    if not snapshot.bags or snapshot.config.measured != "poses":
        return None
    parent, child = snapshot.streams
    offset_ns = round(calibration.time_offset_s * 1e9)
    instants_ns = _instants(parent, child.shifted(calibration.time_offset_s))
    clouds = []
    with PoseBag(*snapshot.bags) as bag:
        topics_of: dict[str, str] = {}
        for topic, frame in topics_and_frames(bag, POINTS_TYPE):
            topics_of.setdefault(frame, topic)
        for names, shift_ns in (
            (snapshot.parent_names, 0),
            (snapshot.child_names, offset_ns),
        ):
            topic = (
                topics_of.get(names.sensor) or topics_of.get(names.option) or ""
            )
            if not topic:
                return None
            cloud = _scans(bag, topic, instants_ns - shift_ns)
            clouds.append(cloud._replace(stamps_ns=cloud.stamps_ns + shift_ns))
    own, other = [_within(cloud, parent) for cloud in clouds]
    if not (len(own.points) and len(other.points)):
        return None
    own_in_world = _placed(own, parent, np.eye(4))
    T_picture_world, is_upright = _axes_of_picture(
        parent, instants_ns[0], own_in_world
    )
    installed = installed_transform(calibration)
    T_before = np.eye(4) if installed is None else installed
    in_picture = [
        own_in_world,
        _placed(other, parent, T_before),
        _placed(other, parent, calibration.T_parent_child),
    ]
    points, before, after = [
        _moved(T_picture_world, cloud) for cloud in in_picture
    ]
    rotations = se3.rotation_of(parent.at(instants_ns))
    turns = [_angles(rotations, rotation).max() for rotation in rotations]
    return MergedClouds(
        parent=points,
        before=before,
        after=after,
        is_upright=is_upright,
        turn_rad=float(max(turns)),
    )


def distances_from_surfaces(
    surfaces: FloatArray, points: FloatArray
) -> FloatArray:
    """Return the distances (M,) of points (M, 3) from the planes through their neighbours, m.

    ``surfaces`` (N, 3) are points of the surfaces. A point without a plane nearby has the distance
    NaN.
    """
    means, normals = _planes(surfaces, points)
    return np.abs(np.einsum("ni,ni->n", points - means, normals))


def _planes(
    surfaces: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the means and the normals (M, 3) of the planes of surfaces near points (M, 3).

    They are NaN without a plane nearby.
    """
    means = np.full((len(points), 3), np.nan)
    normals = np.full((len(points), 3), np.nan)
    if len(surfaces) < TUNING.n_neighbours:
        return means, normals
    nearest_m, rows = cKDTree(surfaces).query(
        points, TUNING.n_neighbours, distance_upper_bound=TUNING.reach_m
    )
    near = np.flatnonzero(np.isfinite(nearest_m).all(axis=1))
    neighbours = surfaces[rows[near]]
    centers = neighbours.mean(axis=1)
    offsets = neighbours - centers[:, None]
    variances, axes = np.linalg.eigh(
        np.einsum("nki,nkj->nij", offsets, offsets)
    )
    is_flat = variances[:, 0] < TUNING.max_flat * variances[:, 1]
    means[near[is_flat]] = centers[is_flat]
    normals[near[is_flat]] = axes[is_flat, :, 0]
    return means, normals


# ------------------------------------------------------------------ scans


def _instants(parent: Trajectory, child: Trajectory) -> IntArray:
    """Return stamps (ns) of scans between which the parent rotates most in a short time.

    The child is on the parent's clock.
    """
    step_ns = round(TUNING.step_s * 1e9)
    # A scan lasts up to this time, and its points need poses.
    first_ns = max(parent.stamps_ns[0], child.stamps_ns[0]) + step_ns
    last_ns = min(parent.stamps_ns[-1], child.stamps_ns[-1]) - step_ns
    stamps_ns = np.arange(first_ns, max(last_ns, first_ns + 1), step_ns)
    rotations = se3.rotation_of(parent.at(stamps_ns, extrapolate=True))
    longest = min(round(TUNING.longest_s / TUNING.step_s), len(stamps_ns) - 1)
    best_turn = 0.0
    start = 0
    length = longest
    for n_steps in range(1, longest + 1):
        turns = se3.rotation_angle(
            se3.relative_rotations(rotations[:-n_steps], rotations[n_steps:])
        )
        row = int(np.argmax(turns))
        if turns[row] > best_turn:
            best_turn = float(turns[row])
            start = row
            length = n_steps
        if best_turn > TUNING.sufficient_turn:
            break
    steps_rad = se3.rotation_angle(
        se3.relative_rotations(rotations[:-1], rotations[1:])
    )
    rates = np.r_[steps_rad, np.inf] + np.r_[np.inf, steps_rad]
    chosen = []
    for row in (
        np.linspace(start, start + length, TUNING.n_scans).round().astype(int)
    ):
        first = max(row - 2, 0)
        chosen.append(first + int(np.argmin(rates[first : row + 3])))
    return np.asarray(stamps_ns[np.unique(chosen)])


def _angles(rotations: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the angles (N,) between rotations (N, 3, 3) and a rotation (3, 3), rad."""
    return np.asarray(
        se3.rotation_angle(se3.relative_rotations(rotation[None], rotations))
    )


def _scans(bag: PoseBag, topic: str, stamps_ns: IntArray) -> _Cloud:
    """Return the points of those scans of a topic that are nearest to the stamps (ns).

    Damaged scans are skipped. Only the parts of the bag near these stamps are read.
    """
    interval_ns = bag.duration_s * 1e9 / max(bag.topics[topic].count - 1, 1)
    reach_ns = round(max(2 * interval_ns, 2e9))
    clouds = []
    for stamp_ns in (stamps_ns + _bag_delay(bag, topic)).tolist():
        nearest = _nearest(bag, topic, stamp_ns, reach_ns)
        if nearest is not None:
            with suppress(InputError):  # a damaged message
                clouds.append(_cloud_of(next(nearest.decoded())))
    if not clouds:
        return _Cloud(np.empty((0, 3)), np.empty(0, dtype=np.int64))
    return _Cloud(*map(np.concatenate, zip(*clouds, strict=True)))


def _bag_delay(bag: PoseBag, topic: str) -> int:
    """Return the bag time of the first message of a topic minus its stamp (ns)."""
    run = next(bag.runs([topic]))
    message = next(run._replace(messages=run.messages[:1]).decoded())
    stamp_ns = ns_of(message.header.stamp) or 0
    return int(run.bag_ns[0]) - stamp_ns


def _nearest(
    bag: PoseBag, topic: str, bag_ns: int, reach_ns: int
) -> Run | None:
    """Return the message of a topic nearest to a bag time, or None if none is in reach."""
    nearest = None
    smallest_ns = reach_ns
    for run in bag.runs([topic], (bag_ns - reach_ns, bag_ns + reach_ns)):
        distances_ns = np.abs(run.bag_ns - bag_ns)
        row = int(np.argmin(distances_ns))
        if distances_ns[row] < smallest_ns:
            smallest_ns = int(distances_ns[row])
            nearest = run._replace(
                messages=run.messages[row : row + 1],
                bag_ns=run.bag_ns[row : row + 1],
            )
    return nearest


def _cloud_of(message: Any) -> _Cloud:
    """Return at most ``TUNING.max_points`` points of a PointCloud2 message with their stamps."""
    rows = rows_of_points(message)
    points = np.stack([rows[axis] for axis in "xyz"], axis=-1).astype(float)
    times_s, middle_ns = times_of_points(rows, ns_of(message.header.stamp) or 0)
    nearest_m, farthest_m = TUNING.ranges_m
    ranges = np.linalg.norm(points, axis=1)
    used = np.flatnonzero((ranges > nearest_m) & (ranges < farthest_m))
    if len(used) > TUNING.max_points:
        evenly = np.linspace(0, len(used) - 1, TUNING.max_points)
        used = used[evenly.astype(int)]
    stamps_ns = middle_ns + np.round(times_s[used] * 1e9).astype(np.int64)
    return _Cloud(points[used], stamps_ns)


# ------------------------------------------------------------------ places


def _within(cloud: _Cloud, stream: Trajectory) -> _Cloud:
    """Return the points of a cloud that were measured among the poses of a stream."""
    is_within = (cloud.stamps_ns >= stream.stamps_ns[0]) & (
        cloud.stamps_ns <= stream.stamps_ns[-1]
    )
    return _Cloud(cloud.points[is_within], cloud.stamps_ns[is_within])


def _placed(
    cloud: _Cloud, parent: Trajectory, T_parent_sensor: FloatArray
) -> FloatArray:
    """Return the points (N, 3) of a cloud in the world of the parent."""
    stamps_ns, part_of_point = np.unique(cloud.stamps_ns, return_inverse=True)
    Ts = (parent.at(stamps_ns) @ T_parent_sensor)[part_of_point]
    rotated = np.einsum("nij,nj->ni", se3.rotation_of(Ts), cloud.points)
    return np.asarray(rotated + se3.translation_of(Ts))


def _moved(T: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (N, 3) moved by a transform (4, 4)."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _axis_of_surfaces(
    surfaces: FloatArray, direction: FloatArray
) -> FloatArray:
    """Return the principal axis (3,) of the normals of surfaces (N, 3).

    It is the principal axis nearest to the direction. Without planes, it is any axis of the world.
    """
    # At most ``max_points`` points have a normal.
    stride = -(-len(surfaces) // TUNING.max_points)
    _, normals = _planes(surfaces, surfaces[::stride])
    normals = normals[np.isfinite(normals).all(axis=1)]
    _, axes = np.linalg.eigh(normals.T @ normals)
    cosines = axes.T @ direction
    nearest = int(np.argmax(np.abs(cosines)))
    return np.asarray(np.copysign(1.0, cosines[nearest]) * axes[:, nearest])


def _axes_of_picture(
    parent: Trajectory, stamp_ns: int, surfaces: FloatArray
) -> tuple[FloatArray, bool]:
    """Return the transform (4, 4) from the parent's world to the picture.

    The second value is whether z of the picture is the normal of the plane of motion. If not, z is
    an axis of the surfaces (N, 3) near z of the parent: walls are parallel or perpendicular to it.
    """
    T_world_parent = parent.at(np.array([stamp_ns]))[0]
    normal = upward_normal(parent.poses)
    up = normal
    if up is None:
        up = _axis_of_surfaces(surfaces, T_world_parent[:3, 2])
    left = np.cross(up, T_world_parent[:3, 0])
    left /= np.linalg.norm(left)
    axes = np.column_stack([np.cross(left, up), left, up])
    T_world_picture = se3.from_rotation_translation(axes, T_world_parent[:3, 3])
    return se3.inverse(T_world_picture), normal is not None
