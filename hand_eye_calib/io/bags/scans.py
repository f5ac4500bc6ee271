"""Odometry from the scans of a lidar (``sensor_msgs/PointCloud2``), by registration with
small_gicp.

Each scan is registered against a map of the scans before it, by their local planes (generalised
ICP). Registration of points to points, as of KISS-ICP, drags along the rings of a lidar that has 16
of them: they look the same on flat ground whatever the pitch, and pitch and roll are not followed.
"""

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import InputError, MissingDependencyError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.bags.messages import Cursor

# numpy's name of each datatype of a PointField.
_DATATYPES = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
# Names that drivers give the time of a point.
_TIMES = ("t", "time", "timestamp", "time_stamp", "offset_time", "timeOffset", "ts")
# A scan lasts so long (s): tells the unit of the times of its points.
_SHORTEST_S, _LONGEST_S = 0.005, 1.0

# Ranges that are used (m): the robot itself is nearer, and beyond a scan is too sparse.
_NEAREST_M, _FARTHEST_M = 1.0, 80.0
# Size of a voxel as a share of the median range, within limits (m).
_VOXEL_SHARE, _LEAST_VOXEL_M, _MOST_VOXEL_M = 0.03, 0.1, 0.4
# Over so many voxels points are matched: each scan is registered twice, its distortion corrected
# anew.
_MATCH_VOXELS = (6.0, 2.0)
_NEIGHBOURS = 12
# Of what does not depend on their number.
_N_THREADS = os.cpu_count() or 1
# A scan becomes part of the map after so much motion; the map has so many.
_KEY_M, _KEY_RAD, _N_KEYS = 0.7, 0.06, 30
# Parts of a scan whose points have the same correction.
_PARTS = 40
# A registration with a smaller share of matched points counts as failed.
_LEAST_MATCHED = 0.3


class Scan(NamedTuple):
    """Points (N, 3) of one turn of a lidar, m, in its own frame; their times (N,) from 0 to 1, the
    last one's; and the stamp of the last.
    """

    points: FloatArray
    phases: FloatArray
    stamp_ns: int
    frame: str


def unpack_scan(data: bytes, is_ros1: bool) -> Scan:
    """Points and times of a PointCloud2 message; a ValueError if it is damaged, or has no x, y and
    z. Without times of its points, a scan counts as taken at once.
    """
    cursor = Cursor(data, is_ros1)
    header_ns, frame = cursor.header()
    height, width = cursor.number(), cursor.number()
    formats, offsets = {}, {}
    for _ in range(cursor.number()):
        name, offsets[name], kind = cursor.name(), cursor.number(), cursor.number("B")
        cursor.number()
        if not 0 < kind < len(_DATATYPES):
            raise ValueError(f"field {name} of the points has datatype {kind}")
        formats[name] = _DATATYPES[kind]
    order = ">" if cursor.number("B") else "<"
    step, _, size = cursor.number(), cursor.number(), cursor.number()
    if not {"x", "y", "z"} <= formats.keys():
        raise ValueError(f"points have no x, y, z, but {', '.join(formats)}")
    if size < height * width * step or cursor.position + size > len(data):
        raise ValueError(f"{height * width} points do not fit into {size} bytes")
    table = np.frombuffer(data, np.uint8, height * width * step, cursor.position).reshape(-1, step)

    def column(name: str) -> FloatArray:
        kind = np.dtype(order + formats[name])
        part = table[:, offsets[name] : offsets[name] + kind.itemsize]
        return np.ascontiguousarray(part).view(kind)[:, 0].astype(float)

    points = np.stack([column(axis) for axis in "xyz"], axis=-1)
    of_time = next((name for name in _TIMES if name in formats), None)
    times = column(of_time) if of_time else np.zeros(len(points))
    ranges = np.linalg.norm(points, axis=1)
    is_used = (ranges > _NEAREST_M) & (ranges < _FARTHEST_M)  # nor those that are not finite
    points, times = points[is_used], times[is_used]
    span = np.ptp(times) if len(times) else 0.0
    units_s = [unit for unit in (1.0, 1e-3, 1e-6, 1e-9) if _SHORTEST_S <= span * unit <= _LONGEST_S]
    if not units_s:
        return Scan(points, np.ones(len(times)), header_ns, frame)
    # Times may be relative to the stamp of the header, or absolute.
    last_s = float(times.max() * units_s[0])
    stamp_ns = round(last_s * 1e9) + header_ns * (last_s <= _LONGEST_S)
    return Scan(points, (times - times.min()) / span, stamp_ns, frame)


class Odometry(NamedTuple):
    """Poses (N, 7) x y z qx qy qz qw of a lidar in the frame of its first scan, each at the end of
    its scan; their stamps and bag times (N,), its frame, and how many scans could not be
    registered.
    """

    poses: np.ndarray
    stamps_ns: np.ndarray
    bag_ns: np.ndarray
    frame: np.ndarray
    n_failed: np.ndarray


class ScanOdometry:
    """Registers the scans on a topic of a bag one after the other; what is found is kept beside the
    bag for the next time, in ``place``. ``kept`` is what was kept for files of the same sizes and
    times.
    """

    def __init__(self, topic: str, bag: Path, files: Sequence[Path]) -> None:
        self._topic, states = topic, [file.stat() for file in files]
        self._state = np.array([[each.st_size, each.st_mtime_ns] for each in states])
        self.place = bag.with_name(f"{bag.name}{topic.replace('/', '.')}.odometry.npz")
        self.kept: Odometry | None = None
        # The errors are of many kinds: it is not there, cut off, or of an older version.
        with suppress(Exception), np.load(self.place, allow_pickle=False) as kept:
            if np.array_equal(kept["files"], self._state):
                self.kept = Odometry(*(kept[name] for name in Odometry._fields))
                return
        try:
            import small_gicp
        except ImportError:
            raise MissingDependencyError(
                "odometry from the points of a lidar needs small_gicp, which is not installed: pip "
                "install 'hand_eye_calib[lidar]'; or record the odometry of a lidar SLAM"
            ) from None
        self._gicp = small_gicp
        self._pose, self._step, self._frame = np.eye(4), np.eye(4), ""
        self._voxel_m, self._n_failed = 0.0, 0
        self._keys: list[tuple[FloatArray, FloatArray]] = []
        self._found: list[tuple[FloatArray, int, int]] = []

    def add(self, scan: Scan, bag_ns: int) -> None:
        """Register the next scan."""
        if len(scan.points) > _NEIGHBOURS:
            self._register(scan)
            self._found.append((self._pose, scan.stamp_ns, bag_ns))
            self._frame = scan.frame

    def odometry(self) -> Odometry:
        """What was found; an InputError if most scans could not be registered."""
        if self.kept is not None:
            return self.kept
        if 2 * self._n_failed >= len(self._found):
            raise InputError(
                f"{self._topic}: {self._n_failed} of {len(self._found)} scans could not be "
                "registered; use the odometry of a lidar SLAM"
            )
        poses, stamps_ns, bag_ns = (np.array(each) for each in zip(*self._found, strict=True))
        rows = np.c_[poses[:, :3, 3], se3.to_quat_xyzw(poses)]
        found = rows, stamps_ns, bag_ns, np.array(self._frame), np.array(self._n_failed)
        with suppress(OSError):  # the folder may be read-only
            np.savez(self.place, files=self._state, **Odometry(*found)._asdict())
        return Odometry(*found)

    def _register(self, scan: Scan) -> None:
        if not self._keys:
            share = _VOXEL_SHARE * float(np.median(np.linalg.norm(scan.points, axis=1)))
            self._voxel_m = min(max(share, _LEAST_VOXEL_M), _MOST_VOXEL_M)
            self._add_to_map(scan.points)
            return
        before, step, pose = self._pose, self._step, self._pose
        for n_voxels in _MATCH_VOXELS:
            points = self._gicp.voxelgrid_sampling(_without_motion(scan, step), self._voxel_m)
            self._gicp.estimate_covariances(points, None, _NEIGHBOURS, _N_THREADS)
            found = self._gicp.align(
                *(self._map[0], points, self._map[1]),
                init_T_target_source=before @ step,
                registration_type="GICP",
                max_correspondence_distance=n_voxels * self._voxel_m,
                max_iterations=30,
            )
            if found.num_inliers < _LEAST_MATCHED * points.size():
                pose, step = before, np.eye(4)  # rather than on and away from the map
                self._n_failed += 1
                break
            pose = np.array(found.T_target_source)
            # Rounding must not grow from scan to scan.
            pose[:3, :3] = se3.nearest_rotation(pose[None, :3, :3])[0]
            step = se3.inverse(before) @ pose
        self._pose, self._step = pose, step
        moved = se3.inverse(self._keys[-1][0]) @ pose
        is_new = len(self._keys) < 5 or np.linalg.norm(moved[:3, 3]) > _KEY_M
        if is_new or se3.rotation_angle(moved[:3, :3]) > _KEY_RAD:
            self._add_to_map(_without_motion(scan, step))

    def _add_to_map(self, points: FloatArray) -> None:
        placed = points @ self._pose[:3, :3].T + self._pose[:3, 3]
        sampled = self._gicp.voxelgrid_sampling(placed, self._voxel_m / 2.0)
        self._keys = [*self._keys, (self._pose, np.array(sampled.points()[:, :3]))][-_N_KEYS:]
        whole = np.concatenate([each for _, each in self._keys])
        self._map = self._gicp.preprocess_points(whole, self._voxel_m, _NEIGHBOURS, _N_THREADS)


def _without_motion(scan: Scan, step: FloatArray) -> FloatArray:
    """Points (N, 3) as if the whole scan was taken at its end, after a constant motion ``step``."""
    before_end = (np.arange(_PARTS) + 0.5) / _PARTS - 1.0
    Ts = se3.exp(np.outer(before_end, se3.log(step)))
    part = np.minimum((scan.phases * _PARTS).astype(int), _PARTS - 1)
    turned = np.einsum("nij,nj->ni", Ts[part, :3, :3], scan.points)
    return np.asarray(np.where(scan.phases[:, None] < 1.0, turned + Ts[part, :3, 3], scan.points))
