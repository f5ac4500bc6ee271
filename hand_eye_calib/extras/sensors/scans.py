"""Odometry from the scans of a lidar (``sensor_msgs/PointCloud2``), by registration with
small_gicp.

Each scan is registered against a map of the scans before it, by their local planes (generalised
ICP), whose voxels hold the mean plane of their points. Registration of points to points, as of
KISS-ICP, drags along the rings of a lidar that has 16 of them: they look the same on flat ground
whatever the pitch, and pitch and roll are not followed.

A pose is that of the middle of its scan. A scan is registered roughly when it comes, as if the
motion went on, and finely after the next one, when the motion during it is known from both sides:
a constant motion doubles the errors. What each ring of the lidar measures too far is learned from
the planes of the map: with 3 mm of that, walls seem to move as the lidar pitches, and the extrinsic
is up to 2 cm off along the axis that turns least.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.config import STAMP_UNITS
from hand_eye_calib.core.base.errors import InputError, printable, required
from hand_eye_calib.core.base.text import frame_name
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.bags.messages import Run, ns_of
from hand_eye_calib.formats.bags.pose_table import PoseTable
from hand_eye_calib.formats.bags.sources import Reading
from hand_eye_calib.formats.npz import read_arrays

# numpy's name of each datatype of a PointField.
_DATATYPES = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
# Names that drivers give the time of a point.
_TIMES = ("t", "time", "timestamp", "time_stamp", "offset_time", "timeOffset", "ts")


@dataclass(frozen=True)
class Tuning:
    """Numbers of the registration."""

    # No scan lasts longer (ns): tells the unit of the times of its points.
    longest_ns: float = 1e9
    # Ranges that are used (m): the robot itself is nearer, and beyond a scan is too sparse.
    ranges_m: tuple[float, float] = (1.0, 80.0)
    # Points of a scan that are used, evenly drawn: more take longer and change nothing.
    most_points: int = 7_000
    # Size of a voxel as a share of the median range, within limits (m).
    voxel_share: float = 0.03
    voxel_limits_m: tuple[float, float] = (0.1, 0.4)
    # Of the rough and the fine registration: voxels of the map, voxels that a scan is thinned to,
    # and over how much points are matched, all in voxels; share of matched points below which it
    # counts as failed. The fine map has few voxels in the beginning.
    steps: tuple[tuple[float, ...], ...] = ((3.0, 3.0, 6.0, 0.3), (1.0, 1.5, 2.0, 0.1))
    # Points that a local plane is fitted to: fewer are of one ring, on a line.
    n_neighbours: int = 15
    # Rings by elevation, in half degrees; scans from one look at them to the next, what a look
    # counts at the next one, and the sum of squared cosines that says that a ring is right.
    n_rings: int = 361
    look_every: int = 10
    kept_share: float = 0.95
    right: float = 100.0
    # Of a plane: variance across over that along, and distance of its points (m).
    flat: float = 0.01
    near_m: float = 0.1
    # Time (s) in which points of a scan have the same correction for motion.
    part_s: float = 0.002


TUNING = Tuning()

_KEPT = ("poses", "stamps_ns", "bag_ns", "frame", "n_failed", "too_far_m")


class Scan(NamedTuple):
    """Points (N, 3) of one turn of a lidar, m, in its own frame; their rings (N,), which are their
    elevations in half degrees from straight down; their times (N,), s since the middle of the scan;
    and its stamp.
    """

    points: FloatArray
    rings: IntArray
    times_s: FloatArray
    stamp_ns: int
    frame: str


def scan_of(message: Any) -> Scan:
    """Points and times of a PointCloud2 message; an InputError if it has no x, y and z, or is
    damaged. Without times of its points, a scan counts as taken at once.
    """
    names = [field.name for field in message.fields]
    if not {*"xyz"} <= {*names}:
        raise InputError(f"points have no x, y, z, but {', '.join(names)}")
    order = "<>"[message.is_bigendian]
    size = message.point_step
    n = message.height * message.width
    try:
        kinds = [order + _DATATYPES[field.datatype] for field in message.fields]
        places = [field.offset for field in message.fields]
        form = np.dtype({"names": names, "formats": kinds, "offsets": places, "itemsize": size})
        rows = np.asarray(message.data, dtype=np.uint8)[: n * size].view(form)
    except (ValueError, IndexError, TypeError) as error:
        raise InputError(f"a scan of points is damaged ({error}); record it again") from error
    points = np.stack([rows[axis] for axis in "xyz"], axis=-1)
    ranges = np.linalg.norm(points.astype(float), axis=1)
    used = np.flatnonzero((ranges > TUNING.ranges_m[0]) & (ranges < TUNING.ranges_m[1]))
    if len(used) > TUNING.most_points:
        used = used[np.linspace(0, len(used) - 1, TUNING.most_points).astype(int)]
    of_time = next((rows[name] for name in _TIMES if name in names), np.zeros(len(rows)))
    points = points[used].astype(float)
    times = of_time[used].astype(float)
    rings = np.round(np.degrees(2 * np.arccos(-points[:, 2] / ranges[used]))).astype(int)
    first, last = (times.min(), times.max()) if len(times) else (0.0, 0.0)
    fitting = (ns for ns in STAMP_UNITS.values() if 0 < (last - first) * ns <= TUNING.longest_ns)
    unit_ns = max(fitting, default=0)
    middle = (first + last) / 2
    # Times may be relative to the stamp of the header, or absolute.
    middle_ns = round(float(middle) * unit_ns)
    header_ns = ns_of(message.header.stamp) or 0
    stamp_ns = middle_ns + header_ns * (middle_ns <= TUNING.longest_ns)
    times_s = (times - middle) * unit_ns * 1e-9
    frame = printable(frame_name(message.header.frame_id))
    return Scan(points, rings, times_s, stamp_ns, frame)


class ScanReading(Reading):
    """The points of a lidar, as odometry: its scans are registered one after the other. What is
    found is kept beside the bag, and read again for files of the same sizes and times: poses (N, 7)
    in the frame of the first scan, each of the middle of its scan, stamps and bag times (N,), the
    lidar's frame, how many scans could not be registered, and what rings measure too far (m).
    """

    def __init__(self, stream: str, topic: str, bag: Path, files: Sequence[Path]) -> None:
        super().__init__(stream, topic)
        self._state = np.array([[each.stat().st_size, each.stat().st_mtime_ns] for each in files])
        self._place = bag.with_name(f"{bag.name}{topic.replace('/', '.')}.odometry.npz")
        self._kept: list[Any] = []
        # The errors are of many kinds: it is not there, cut off, or of an older version.
        with suppress(Exception):
            kept = read_arrays(self._place)
            if np.array_equal(kept["bag_files"], self._state):
                self._kept = [kept[name] for name in _KEPT]
                self.topics = ()
                return
        self._gicp = required("small_gicp", "odometry from the points of a lidar", "lidar")
        self._voxel_m = 0.0
        self._has_failed = [False]
        self._maps: list[Any] = []
        # Of all scans, and the newest three of them.
        self._poses = [np.eye(4)]
        self._stamps_ns = list[int]()
        self._bag_ns = list[int]()
        self._scans = list[Scan]()
        # What rings measure too far (m), and of what it is the ratio.
        self._too_far_m = np.zeros(TUNING.n_rings)
        self._sums = np.zeros((2, TUNING.n_rings))

    def take(self, run: Run) -> None:
        for message, bag_ns in zip(run.decoded(), run.bag_ns.tolist(), strict=True):
            scan = scan_of(message)
            if len(scan.points) > TUNING.n_neighbours:
                self._bag_ns.append(bag_ns)
                self._add(scan)

    def table(self) -> PoseTable:
        if not self._kept:
            n_failed = sum(self._has_failed)
            if 2 * n_failed >= len(self._bag_ns):
                raise InputError(
                    f"{self.topics[0]}: of {len(self._bag_ns)} scans with points, {n_failed} "
                    "could not be registered; use the odometry of a lidar SLAM"
                )
            self._register(-1, 1)
            found = se3.to_rows(np.array(self._poses)), self._stamps_ns, self._bag_ns
            self._kept = [*found, self._scans[-1].frame, n_failed, self._too_far_m]
            with suppress(OSError):  # the folder may be read-only
                kept = dict(zip(_KEPT, self._kept, strict=True))
                np.savez(self._place, bag_files=self._state, **kept)
        poses, stamps_ns, bag_ns, frame, n_failed, _ = self._kept
        lost = f", {n_failed} of which could not be registered" if n_failed else ""
        self.notes.append(f"odometry from {len(poses)} scans{lost}; it is kept in {self._place}")
        return PoseTable.of(stamps_ns, poses, "scans", str(frame)).recorded(self.stream, bag_ns)

    def _add(self, scan: Scan) -> None:
        """Register the next scan."""
        ranges = np.linalg.norm(scan.points, axis=1)
        right = 1.0 - self._too_far_m[scan.rings] / ranges
        self._scans = [*self._scans[-2:], scan._replace(points=scan.points * right[:, None])]
        self._stamps_ns.append(scan.stamp_ns)
        count = len(self._stamps_ns)
        if count == 1:
            size_m = TUNING.voxel_share * np.median(ranges)
            self._voxel_m = float(np.clip(size_m, *TUNING.voxel_limits_m))
        else:
            last = self._poses[-1]
            self._poses.append(last @ se3.inverse(self._poses[-2:][0]) @ last)
            self._has_failed.append(True)
            self._register(-1, 0)
        if count <= 3:  # the first scan needs the motion during it
            self._start()
        if count >= 3:
            self._register(-2, 1)

    def _start(self) -> None:
        """Begin the maps with the first scan."""
        points = self._thinned(self._still(-len(self._scans)), 1)
        self._maps = [self._gicp.GaussianVoxelMap(x[0] * self._voxel_m) for x in TUNING.steps]
        for each in self._maps:
            each.insert(points)

    def _register(self, index: int, step: int) -> None:
        """Find the pose of the scan at this index from the end: roughly, or finely as a part of the
        maps.
        """
        still = self._still(index)
        _, _, matched, least = TUNING.steps[step]
        points = self._thinned(still, step)
        found = self._gicp.align(
            *(self._maps[step], points, self._poses[index]),
            max_correspondence_distance=matched * self._voxel_m,
            max_iterations=30,
        )
        if found.num_inliers >= least * points.size():
            pose = np.array(found.T_target_source)
            # Rounding must not grow from scan to scan.
            pose[:3, :3] = se3.nearest_rotation(pose[None, :3, :3])[0]
            self._poses[index] = pose
            self._has_failed[index] = False
        elif not step:
            self._poses[index] = self._poses[index - 1]  # rather than on and away from the map
        if step and not self._has_failed[index]:
            if len(self._poses) % TUNING.look_every == 0:
                self._look_at_rings(self._scans[index], still, self._poses[index])
            for each in self._maps:
                each.insert(points, self._poses[index])

    def _still(self, index: int) -> FloatArray:
        """Points (N, 3) of a scan as if all were taken in its middle, in the motion through its
        pose and those beside it.
        """
        scan = self._scans[index]
        near = slice(-len(self._scans), None)
        since_s = (np.array(self._stamps_ns[near]) - scan.stamp_ns) * 1e-9
        motions = se3.log(se3.inverse(self._poses[index]) @ np.array(self._poses[near]))
        polynomial = np.linalg.lstsq(np.vander(since_s), motions, rcond=None)[0]
        parts_s, part = np.unique(np.round(scan.times_s / TUNING.part_s), return_inverse=True)
        Ts = se3.exp(np.vander(parts_s * TUNING.part_s, len(since_s)) @ polynomial)[part]
        return np.asarray(np.einsum("nij,nj->ni", Ts[:, :3, :3], scan.points) + Ts[:, :3, 3])

    def _thinned(self, points: FloatArray, step: int) -> Any:
        """One of the points (N, 3) in each voxel, with the planes about them."""
        thinned = self._gicp.voxelgrid_sampling(points, TUNING.steps[step][1] * self._voxel_m)
        self._gicp.estimate_covariances(thinned, num_neighbors=TUNING.n_neighbours)
        return thinned

    def _look_at_rings(self, scan: Scan, still: FloatArray, pose: FloatArray) -> None:
        """Learn what rings measure too far, from their points beside planes of the map."""
        means = np.array(self._maps[1].voxel_points())[:, :3]
        covs = np.reshape(self._maps[1].voxel_covs(), (-1, 4, 4))[:, :3, :3]
        placed = still @ pose[:3, :3].T + pose[:3, 3]
        rays = scan.points @ pose[:3, :3].T
        nearest = self._gicp.KdTree(means).batch_nearest_neighbor_search(placed)[0]
        planes, of_point = np.unique(nearest, return_inverse=True)
        variances, axes = np.linalg.eigh(covs[planes])
        is_flat = variances[:, 0] < TUNING.flat * variances[:, 1]
        normals = axes[of_point, :, 0]
        offsets = np.einsum("ni,ni->n", normals, placed - means[planes[of_point]])
        cosines = np.einsum("ni,ni->n", normals, rays) / np.linalg.norm(rays, axis=1)
        cosines *= is_flat[of_point] & (np.abs(offsets) < TUNING.near_m)
        offsets += cosines * self._too_far_m[scan.rings]
        counted = (np.bincount(scan.rings, cosines * x, TUNING.n_rings) for x in (offsets, cosines))
        self._sums = TUNING.kept_share * self._sums + np.array([*counted])
        self._too_far_m = self._sums[0] / (self._sums[1] + TUNING.right)
