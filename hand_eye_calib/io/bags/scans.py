"""Odometry from the scans of a lidar (``sensor_msgs/PointCloud2``), by registration with
small_gicp.

Each scan is registered against a map of the scans before it, by their local planes (generalised
ICP), whose voxels hold the mean plane of their points. Registration of points to points, as of
KISS-ICP, drags along the rings of a lidar that has 16 of them: they look the same on flat ground
whatever the pitch, and pitch and roll are not followed.

A pose is that of the middle of its scan: vibration of 1.3 Hz is followed 7 % too far at its end.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.config import STAMP_UNITS
from hand_eye_calib.errors import InputError, printable, required
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.bags.messages import ns_of

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
    nearest_m: float = 1.0
    farthest_m: float = 80.0
    # Points of a scan that are used, evenly drawn: more take longer and change nothing.
    most_points: int = 10_000
    # Size of a voxel as a share of the median range, within limits (m).
    voxel_share: float = 0.03
    least_voxel_m: float = 0.1
    most_voxel_m: float = 0.4
    # Of two registrations, of which the first corrects distortion: voxels that a scan is thinned
    # to, and over how many points are matched.
    thinned_voxels: tuple[float, ...] = (3.0, 1.0)
    match_voxels: tuple[float, ...] = (6.0, 2.0)
    # Points that a local plane is fitted to.
    n_neighbours: int = 12
    # Size of a voxel of the map, in those of scans, and for how many scans it is kept unseen.
    map_voxels: float = 2.0
    n_unseen: int = 100
    # Parts of a scan whose points have the same correction for motion, with one in the middle.
    n_parts: int = 41
    # Time (s) after which errors of poses differ, unless a recording has fewer poses then.
    apart_s: float = 1.0
    least_poses: int = 60
    # A registration with a smaller share of matched points counts as failed.
    least_matched: float = 0.3


TUNING = Tuning()

_KEPT = ("poses", "stamps_ns", "bag_ns", "frame", "n_failed")


class Scan(NamedTuple):
    """Points (N, 3) of one turn of a lidar, m, in its own frame; their times (N,), from 0 of the
    first to 1 of the last; and the stamp of the middle.
    """

    points: FloatArray
    phases: FloatArray
    stamp_ns: int
    frame: str


def scan_of(message: Any) -> Scan:
    """Points and times of a PointCloud2 message; an InputError if it has no x, y and z, or is
    damaged. Without times of its points, a scan counts as taken at once.
    """
    names = [field.name for field in message.fields]
    if not {*"xyz"} <= {*names}:
        raise InputError(f"points have no x, y, z, but {', '.join(names)}")
    order, size, n = "<>"[message.is_bigendian], message.point_step, message.height * message.width
    try:
        kinds = [order + _DATATYPES[field.datatype] for field in message.fields]
        places = [field.offset for field in message.fields]
        form = np.dtype({"names": names, "formats": kinds, "offsets": places, "itemsize": size})
        rows = np.asarray(message.data, dtype=np.uint8)[: n * size].view(form)
    except (ValueError, IndexError, TypeError) as error:
        raise InputError(f"a scan of points is damaged ({error}); record it again") from error
    points = np.stack([rows[axis] for axis in "xyz"], axis=-1)
    ranges = np.linalg.norm(points.astype(float), axis=1)
    used = np.flatnonzero((ranges > TUNING.nearest_m) & (ranges < TUNING.farthest_m))
    if len(used) > TUNING.most_points:
        used = used[np.linspace(0, len(used) - 1, TUNING.most_points).astype(int)]
    of_time = next((rows[name] for name in _TIMES if name in names), np.zeros(len(rows)))
    points, times = points[used].astype(float), of_time[used].astype(float)
    span, header_ns = np.ptp(times) if len(times) else 0.0, ns_of(message.header.stamp) or 0
    unit_ns = max((ns for ns in STAMP_UNITS.values() if span * ns <= TUNING.longest_ns), default=0)
    frame = printable(message.header.frame_id)
    if not span * unit_ns:
        return Scan(points, np.full(len(times), 0.5), header_ns, frame)
    # Times may be relative to the stamp of the header, or absolute.
    middle_ns = round(float(times.max() - span / 2) * unit_ns)
    stamp_ns = middle_ns + header_ns * (middle_ns <= TUNING.longest_ns)
    return Scan(points, (times - times.min()) / span, stamp_ns, frame)


class ScanOdometry:
    """Registers the scans on a topic of a bag one after the other; what is found is kept beside the
    bag for the next time, in ``place``. ``kept`` is what was kept for files of the same sizes and
    times: poses (N, 7) in the frame of the first scan, each of the middle of its scan, stamps and
    bag times (N,), the lidar's frame, and how many scans could not be registered.
    """

    def __init__(self, topic: str, bag: Path, files: Sequence[Path]) -> None:
        self._topic, states = topic, [file.stat() for file in files]
        self._state = np.array([[each.st_size, each.st_mtime_ns] for each in states])
        self.place = bag.with_name(f"{bag.name}{topic.replace('/', '.')}.odometry.npz")
        self.kept: dict[str, Any] = {}
        # The errors are of many kinds: it is not there, cut off, or of an older version.
        with suppress(Exception), np.load(self.place, allow_pickle=False) as kept:
            if np.array_equal(kept["of_files"], self._state):
                self.kept = {name: kept[name] for name in _KEPT}
                return
        self._gicp = required(
            "small_gicp", "odometry from the points of a lidar", "hand_eye_calib[lidar]"
        )
        self._pose, self._step, self._frame = np.eye(4), np.eye(4), ""
        self._voxel_m, self._n_failed = 0.0, 0
        self._map: Any = None
        self._found: list[tuple[FloatArray, int, int]] = []

    def add(self, scan: Scan, bag_ns: int) -> None:
        """Register the next scan."""
        if len(scan.points) > TUNING.n_neighbours:
            self._register(scan)
            self._found.append((self._pose, scan.stamp_ns, bag_ns))
            self._frame = scan.frame

    def odometry(self) -> dict[str, Any]:
        """What was found, as it is kept; an InputError if most scans could not be registered."""
        if not self.kept:
            if 2 * self._n_failed >= len(self._found):
                raise InputError(
                    f"{self._topic}: {self._n_failed} of {len(self._found)} scans could not be "
                    "registered; use the odometry of a lidar SLAM"
                )
            Ts, *times = (np.array(each) for each in zip(*self._found, strict=True))
            found = se3.to_rows(Ts), *times, np.array(self._frame), np.array(self._n_failed)
            self.kept = dict(zip(_KEPT, found, strict=True))
            with suppress(OSError):  # the folder may be read-only
                np.savez(self.place, of_files=self._state, **self.kept)
        return self.kept

    def _register(self, scan: Scan) -> None:
        if self._map is None:
            share = TUNING.voxel_share * float(np.median(np.linalg.norm(scan.points, axis=1)))
            self._voxel_m = min(max(share, TUNING.least_voxel_m), TUNING.most_voxel_m)
            self._first = scan
            self._start(np.eye(4))
            return
        pose, step = self._pose, self._step
        for thinned, matched in zip(TUNING.thinned_voxels, TUNING.match_voxels, strict=True):
            if len(self._found) == 1:
                self._start(step)
            points = self._thinned(_without_motion(scan, step), thinned)
            found = self._gicp.align(
                *(self._map, points, self._pose @ step),
                max_correspondence_distance=matched * self._voxel_m,
                max_iterations=30,
            )
            if found.num_inliers < TUNING.least_matched * points.size():
                self._step = np.eye(4)  # rather than on and away from the map
                self._n_failed += 1
                return
            pose = np.array(found.T_target_source)
            # Rounding must not grow from scan to scan.
            pose[:3, :3] = se3.nearest_rotation(pose[None, :3, :3])[0]
            step = se3.inverse(self._pose) @ pose
        self._pose, self._step = pose, step
        self._map.insert(points, pose)

    def _start(self, step: FloatArray) -> None:
        """Begin the map with the first scan, in which the lidar may have moved already."""
        self._map = self._gicp.GaussianVoxelMap(TUNING.map_voxels * self._voxel_m)
        self._map.set_lru(TUNING.n_unseen, TUNING.n_unseen)
        self._map.insert(self._thinned(_without_motion(self._first, step), 1.0))

    def _thinned(self, points: FloatArray, n_voxels: float) -> Any:
        """One of the points (N, 3) in so many voxels, with the planes about them."""
        thinned = self._gicp.voxelgrid_sampling(points, n_voxels * self._voxel_m)
        self._gicp.estimate_covariances(thinned, num_neighbors=TUNING.n_neighbours)
        return thinned


def _without_motion(scan: Scan, step: FloatArray) -> FloatArray:
    """Points (N, 3) as if the whole scan was taken in its middle, in a constant motion ``step``."""
    since_middle = (np.arange(TUNING.n_parts) + 0.5) / TUNING.n_parts - 0.5
    Ts = se3.exp(np.outer(since_middle, se3.log(step)))
    part = np.minimum((scan.phases * TUNING.n_parts).astype(int), TUNING.n_parts - 1)
    return np.asarray(np.einsum("nij,nj->ni", Ts[part, :3, :3], scan.points) + Ts[part, :3, 3])
