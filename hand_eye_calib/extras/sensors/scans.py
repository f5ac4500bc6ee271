"""Compute odometry from the scans of a lidar (``sensor_msgs/PointCloud2``) with small_gicp.

Each scan is registered against a map of the previous scans by generalised ICP (A. Segal et al.,
*Generalized-ICP*, RSS 2009): points match local planes, and each voxel of the map contains the mean
plane of its points. Point-to-point matching, as in KISS-ICP, fails for a lidar with 16 rings: on
flat ground the rings have the same shape at any pitch and roll, so these angles are lost.

A pose is that of the lidar in the middle of its scan. A new scan is first registered roughly, from
the pose that continues the last motion. It is registered finely after the next scan, when there are
poses before and after it. The poses then determine the motion during the scan. A constant motion in
its place would double the errors.

The range error of each ring is estimated from the planes of the map. Without this correction, an
error of 3 mm makes walls move as the lidar pitches. The extrinsic is then up to 2 cm off, along the
axis with the least rotation.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.errors import InputError, printable, required
from hand_eye_calib.core.base.text import frame_name
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.bags.messages import Run, ns_of
from hand_eye_calib.formats.bags.points import rows_of_points, times_of_points
from hand_eye_calib.formats.bags.pose_table import PoseTable
from hand_eye_calib.formats.bags.sources import Reading
from hand_eye_calib.formats.npz import read_arrays


class Step(NamedTuple):
    """Sizes of a registration, in voxels of the fine map.

    Attributes
    ----------
    map_voxel : float
        Size of the voxels of the map.
    scan_voxel : float
        The scan is reduced to one point in each voxel of this size.
    reach : float
        Longest distance of matched points.
    min_inlier_fraction : float
        Smallest share of matched points. Registration fails below it.
    """

    map_voxel: float
    scan_voxel: float
    reach: float
    min_inlier_fraction: float


@dataclass(frozen=True)
class Tuning:
    """Constants of the registration."""

    # Smallest and largest range that is used (m). Nearer points are on the robot itself, farther
    # points are too sparse.
    ranges_m: tuple[float, float] = (1.0, 80.0)
    # Largest number of points of a scan that are used, evenly drawn. More points take more time and
    # change nothing.
    most_points: int = 7_000
    # Size of a voxel as a share of the median range.
    voxel_share: float = 0.03
    # Limits of the size of a voxel (m).
    voxel_limits_m: tuple[float, float] = (0.1, 0.4)
    # Number of neighbours that a local plane is fitted to. Fewer neighbours may all be on one ring,
    # which is a line and not a plane.
    n_neighbours: int = 15
    # Number of possible rings: elevations from 0 to 180 deg from straight down, in half degrees.
    n_rings: int = 361
    # Number of scans from one estimate of the range errors of rings to the next.
    learn_every: int = 10
    # Share of the sums of earlier scans that is kept at each new estimate (forgetting factor).
    kept_share: float = 0.95
    # Weight of the prior that a ring has no range error: a sum of squared cosines, as that of
    # measurements.
    prior_weight: float = 100.0
    # A voxel is a plane if its variance along the normal is below this share of the next variance.
    flat: float = 0.01
    # Longest distance of a point from its plane (m).
    near_m: float = 0.1
    # Time (s) in which points of a scan have the same correction for motion.
    part_s: float = 0.002


TUNING = Tuning()
_ROUGH = Step(map_voxel=3.0, scan_voxel=3.0, reach=6.0, min_inlier_fraction=0.3)
# The fine map has few voxels in the beginning, so few points match.
_FINE = Step(map_voxel=1.0, scan_voxel=1.5, reach=2.0, min_inlier_fraction=0.1)

# Arrays of a stored result.
_STORED = ("poses", "stamps_ns", "bag_ns", "frame", "n_failed", "too_far_m")


class Scan(NamedTuple):
    """One turn of a lidar.

    Attributes
    ----------
    points : (N, 3) array
        In the frame of the lidar, m.
    rings : (N,) int array
        Elevations in half degrees from straight down.
    times_s : (N,) array
        Times since the middle of the scan.
    stamp_ns : int
        Stamp of the middle of the scan.
    frame : str
    """

    points: FloatArray
    rings: IntArray
    times_s: FloatArray
    stamp_ns: int
    frame: str


def scan_of(message: Any) -> Scan:
    """Return the points of a PointCloud2 message in the used ranges.

    All points count as measured at once if the message has no times of points.

    Raises
    ------
    InputError
        If the message has no x, y and z, or is damaged.
    """
    rows = rows_of_points(message)
    points = np.stack([rows[axis] for axis in "xyz"], axis=-1)
    ranges = np.linalg.norm(points.astype(float), axis=1)
    nearest_m, farthest_m = TUNING.ranges_m
    used = np.flatnonzero((ranges > nearest_m) & (ranges < farthest_m))
    if len(used) > TUNING.most_points:
        evenly = np.linspace(0, len(used) - 1, TUNING.most_points).astype(int)
        used = used[evenly]
    points = points[used].astype(float)
    elevations = np.arccos(-points[:, 2] / ranges[used])
    half_degrees = np.degrees(2 * elevations)
    rings = np.round(half_degrees).astype(int)
    times_s, stamp_ns = times_of_points(
        rows[used], ns_of(message.header.stamp) or 0
    )
    frame = printable(frame_name(message.header.frame_id))
    return Scan(points, rings, times_s, stamp_ns, frame)


class ScanReading(Reading):
    """Compute odometry from the points of a lidar: each scan is registered after the previous one.

    The result is stored beside the bag, and read again for files of the same sizes and times. Its
    ``poses`` (N, 7) are at the middles of the scans, in the frame of the first scan. ``stamps_ns``
    and ``bag_ns`` (N,) are their times. ``frame`` is the lidar's frame, ``n_failed`` the number of
    scans without registration, and ``too_far_m`` the range error of each ring.

    Raises
    ------
    MissingDependencyError
        If small_gicp is not installed, and no result is stored.
    """

    def __init__(
        self, stream: str, topic: str, bag: Path, files: Sequence[Path]
    ) -> None:
        super().__init__(stream, topic)
        self._state = np.array(
            [[file.stat().st_size, file.stat().st_mtime_ns] for file in files]
        )
        self._path = bag.with_name(
            f"{bag.name}{topic.replace('/', '.')}.odometry.npz"
        )
        self._stored: Mapping[str, Any] = {}
        # Many kinds of errors are possible: the file is absent, cut off, or of an older version.
        with suppress(Exception):
            stored = read_arrays(self._path)
            if np.array_equal(stored["bag_files"], self._state):
                self._stored = {name: stored[name] for name in _STORED}
                self.topics = ()
                return
        self._gicp = required(
            "small_gicp", "odometry from the points of a lidar", "lidar"
        )
        # Size of a voxel of the fine map.
        self._voxel_m = 0.0
        self._rough_map: Any = None
        self._fine_map: Any = None
        # One entry for each scan so far.
        self._poses = [np.eye(4)]
        self._has_failed = [False]
        self._stamps_ns = list[int]()
        self._bag_ns = list[int]()
        # The newest three scans.
        self._scans = list[Scan]()
        # Range error of each ring, m.
        self._too_far_m = np.zeros(TUNING.n_rings)
        # Sums over points for the range errors: c times distance from the plane (m), and squared c.
        # The factor c is the cosine between the ray and the normal of the plane.
        self._sums = np.zeros((2, TUNING.n_rings))

    def take(self, run: Run) -> None:
        for message, bag_ns in zip(
            run.decoded(), run.bag_ns.tolist(), strict=True
        ):
            scan = scan_of(message)
            if len(scan.points) > TUNING.n_neighbours:
                self._bag_ns.append(bag_ns)
                self._add(scan)

    def table(self) -> PoseTable:
        if not self._stored:
            self._finish()
        stored = self._stored
        text = f"odometry from {len(stored['poses'])} scans"
        if stored["n_failed"]:
            text += f", {stored['n_failed']} of which could not be registered"
        self.notes.append(f"{text}; it is stored in {self._path}")
        frame = str(stored["frame"])
        table = PoseTable.of(
            stored["stamps_ns"], stored["poses"], "scans", frame
        )
        return table.recorded(self.stream, stored["bag_ns"])

    def _finish(self) -> None:
        """Register the last scan finely, and store the result."""
        n_failed = sum(self._has_failed)
        if 2 * n_failed >= len(self._bag_ns):
            raise InputError(
                f"{self.name}: {n_failed} of {len(self._bag_ns)} scans with "
                "points could not be registered; use the odometry of a lidar "
                "SLAM"
            )
        self._register_finely(-1)
        self._stored = {
            "poses": se3.to_rows(np.array(self._poses)),
            "stamps_ns": self._stamps_ns,
            "bag_ns": self._bag_ns,
            "frame": self._scans[-1].frame,
            "n_failed": n_failed,
            "too_far_m": self._too_far_m,
        }
        # The folder may be read-only.
        with suppress(OSError):
            np.savez(self._path, bag_files=self._state, **self._stored)

    def _add(self, scan: Scan) -> None:
        """Register the next scan roughly, and the scan before it finely."""
        ranges = np.linalg.norm(scan.points, axis=1)
        factors = 1.0 - self._too_far_m[scan.rings] / ranges
        corrected = scan._replace(points=scan.points * factors[:, None])
        self._scans = [*self._scans[-2:], corrected]
        self._stamps_ns.append(scan.stamp_ns)
        count = len(self._stamps_ns)
        if count == 1:
            size_m = TUNING.voxel_share * np.median(ranges)
            self._voxel_m = float(np.clip(size_m, *TUNING.voxel_limits_m))
        else:
            # Predict the pose: the last motion continues. The second scan starts from the pose of
            # the first, because there is no motion yet.
            last = self._poses[-1]
            before = self._poses[-2:][0]
            self._poses.append(last @ se3.inverse(before) @ last)
            self._has_failed.append(True)
            self._register_roughly()
        if count <= 3:
            # Begin again: more poses determine the motion during the first scan better.
            self._start_maps()
        if count >= 3:
            self._register_finely(-2)

    def _start_maps(self) -> None:
        """Begin the maps with the first scan."""
        points = self._thinned(self._still(-len(self._scans)), _FINE)
        self._rough_map = self._gicp.GaussianVoxelMap(
            _ROUGH.map_voxel * self._voxel_m
        )
        self._fine_map = self._gicp.GaussianVoxelMap(
            _FINE.map_voxel * self._voxel_m
        )
        self._rough_map.insert(points)
        self._fine_map.insert(points)

    def _register_roughly(self) -> None:
        """Estimate the pose of the newest scan; the pose before it if that fails."""
        points = self._thinned(self._still(-1), _ROUGH)
        if not self._align(-1, points, self._rough_map, _ROUGH):
            # Further predictions from the predicted pose would lead away from the map.
            self._poses[-1] = self._poses[-2]

    def _register_finely(self, index: int) -> None:
        """Estimate the pose of a scan (index -1 is the newest), and add the scan to the maps."""
        still = self._still(index)
        points = self._thinned(still, _FINE)
        self._align(index, points, self._fine_map, _FINE)
        if self._has_failed[index]:
            return
        if len(self._poses) % TUNING.learn_every == 0:
            self._learn_range_errors(
                self._scans[index], still, self._poses[index]
            )
        self._rough_map.insert(points, self._poses[index])
        self._fine_map.insert(points, self._poses[index])

    def _align(
        self, index: int, points: Any, voxel_map: Any, step: Step
    ) -> bool:
        """Register the points of a scan, and return whether enough of them match.

        If enough match, the pose of the scan is replaced, and the scan counts as registered.
        """
        result = self._gicp.align(
            voxel_map,
            points,
            self._poses[index],
            max_correspondence_distance=step.reach * self._voxel_m,
            max_iterations=30,
        )
        if result.num_inliers < step.min_inlier_fraction * points.size():
            return False
        pose = np.array(result.T_target_source)
        # Rounding must not grow from scan to scan.
        pose[:3, :3] = se3.nearest_rotation(pose[None, :3, :3])[0]
        self._poses[index] = pose
        self._has_failed[index] = False
        return True

    def _still(self, index: int) -> FloatArray:
        """Return the points (N, 3) of a scan as if all were measured in its middle.

        The motion during the scan is a polynomial through the poses of the newest scans.
        """
        scan = self._scans[index]
        newest = slice(-len(self._scans), None)
        since_s = (np.array(self._stamps_ns[newest]) - scan.stamp_ns) * 1e-9
        relative_poses = se3.inverse(self._poses[index]) @ np.array(
            self._poses[newest]
        )
        motions = se3.log(relative_poses)
        polynomial = np.linalg.lstsq(np.vander(since_s), motions, rcond=None)[0]
        part_numbers = np.round(scan.times_s / TUNING.part_s)
        parts, part_of_point = np.unique(part_numbers, return_inverse=True)
        powers = np.vander(parts * TUNING.part_s, len(since_s))
        Ts = se3.exp(powers @ polynomial)[part_of_point]
        rotated = np.einsum("nij,nj->ni", se3.rotation_of(Ts), scan.points)
        return rotated + se3.translation_of(Ts)

    def _thinned(self, points: FloatArray, step: Step) -> Any:
        """Return one point in each voxel, with its local plane, from points (N, 3)."""
        thinned = self._gicp.voxelgrid_sampling(
            points, step.scan_voxel * self._voxel_m
        )
        self._gicp.estimate_covariances(
            thinned, num_neighbors=TUNING.n_neighbours
        )
        return thinned

    def _learn_range_errors(
        self, scan: Scan, still: FloatArray, pose: FloatArray
    ) -> None:
        """Estimate the range errors of rings from points near planes of the fine map.

        A range that is too long by e displaces the point from its plane by e times the cosine
        between ray and normal. The estimate of e is by least squares with a prior of 0.

        Parameters
        ----------
        scan : Scan
        still : (N, 3) array
            Points of the scan as if all were measured in its middle.
        pose : (4, 4) array
            Pose of the middle of the scan in the map.
        """
        means = np.array(self._fine_map.voxel_points())[:, :3]
        matrices = np.reshape(self._fine_map.voxel_covs(), (-1, 4, 4))
        covariances = matrices[:, :3, :3]
        to_map = se3.rotation_of(pose).T
        points = still @ to_map + se3.translation_of(pose)
        rays = scan.points @ to_map
        nearest, *_ = self._gicp.KdTree(means).batch_nearest_neighbor_search(
            points
        )
        voxels, voxel_of_point = np.unique(nearest, return_inverse=True)
        variances, axes = np.linalg.eigh(covariances[voxels])
        is_flat = variances[:, 0] < TUNING.flat * variances[:, 1]
        normals = axes[voxel_of_point, :, 0]
        from_means = points - means[voxels[voxel_of_point]]
        distances = np.einsum("ni,ni->n", normals, from_means)
        along_normals = np.einsum("ni,ni->n", normals, rays)
        cosines = along_normals / np.linalg.norm(rays, axis=1)
        is_near = np.abs(distances) < TUNING.near_m
        # Points that are not near a plane have no weight.
        cosines *= is_flat[voxel_of_point] & is_near
        # The points were corrected by the previous estimate.
        distances += cosines * self._too_far_m[scan.rings]
        products = np.bincount(scan.rings, cosines * distances, TUNING.n_rings)
        squares = np.bincount(scan.rings, cosines * cosines, TUNING.n_rings)
        self._sums = TUNING.kept_share * self._sums + np.array(
            [products, squares]
        )
        self._too_far_m = self._sums[0] / (self._sums[1] + TUNING.prior_weight)
