"""The plane of the ground in a scan of a lidar.

The points are rotated so that z is roughly up, and averaged in cells of 0.5 m. The ground is the
plane z = a x + b y + c with the most cells as inliers (RANSAC). Least squares of these cells
refines the plane. x is the direction of the drive, y points left, the sensor is the origin.
Reference: M. A. Fischler, R. C. Bolles, *Random sample consensus*, Comm. ACM 24, 1981.
"""

from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.blocks import Blocks

# Smallest horizontal distance (m) of a used point. Nearer points may be on the machine.
_MIN_RANGE_M = 1.5
# Largest horizontal distance (m) of a used point. Farther away, the road may bend.
_MAX_RANGE_M = 12.0
# The ground must reach at least this horizontal distance (m). A deck of the machine is shorter.
_MIN_REACH_M = 5.0
# Side of a cell (m). Near rings of a lidar are denser; in cells, they have the weight of far rings.
_CELL_M = 0.5
# Number of random planes of RANSAC.
_N_TRIALS = 200
# Largest slope of the ground relative to the expected vertical: the tangent of 15 deg.
_MAX_SLOPE = 0.27
# Largest vertical distance (m) of an inlier from the plane. It allows for grass and the noise of
# ranges.
_MAX_INLIER_HEIGHT_M = 0.08
# Largest share of the cells below the ground, by more than three times the height of an inlier. A
# loading edge, for example, has more cells below it.
_MAX_SHARE_BELOW = 0.08


class Plane(NamedTuple):
    """Plane of the ground in the frame of a sensor.

    ``normal`` (3,) is a unit vector that points up. ``height_m`` is the height of the sensor.
    """

    normal: FloatArray
    height_m: float


def ground_of(
    points: FloatArray, up: FloatArray, ahead: FloatArray, width_m: float
) -> Plane | None:
    """Detect the ground in a scan; return None if no plane can be the ground.

    Parameters
    ----------
    points : (N, 3) array
        Points in the frame of the sensor, m.
    up : (3,) array
        Expected vertical in the frame of the sensor (unit vector). It differs from the normal of
        the ground by at most 15 deg.
    ahead : (3,) array
        Direction of the drive in the frame of the sensor.
    width_m : float
        Width of the lane whose points are used. The sensor is above the middle of the lane.
    """
    rotation = _rotation_to_level(up, ahead)
    cells = _cell_means(points @ rotation.T, width_m)
    if not len(cells):
        return None
    plane = _plane_by_ransac(cells)
    if plane is None:
        return None
    # The first fit uses the inliers of RANSAC, and the second fit the inliers of the first fit.
    for _ in range(2):
        distances_m = np.abs(cells[:, 2] - _heights(cells, plane))
        is_inlier = distances_m < _MAX_INLIER_HEIGHT_M
        inliers = cells[is_inlier]
        rows = _rows(inliers)
        heights_m = inliers[:, 2]
        solution, *_ = np.linalg.lstsq(rows, heights_m, rcond=None)
        plane = np.asarray(solution, dtype=float)
    if not _is_ground(cells, inliers, plane):
        return None
    a, b, c = plane
    upwards = np.array([-a, -b, 1.0])
    length = np.sqrt(1.0 + a * a + b * b)
    normal = rotation.T @ upwards / length
    height_m = float(-c / length)
    return Plane(normal, height_m)


def _rotation_to_level(up: FloatArray, ahead: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) that turns ``up`` into z, and ``ahead`` into the x-z plane."""
    left = np.cross(up, ahead)
    left /= np.linalg.norm(left)
    level_ahead = np.cross(left, up)
    return np.array([level_ahead, left, up])


def _cell_means(points: FloatArray, width_m: float) -> FloatArray:
    """Return the mean point (C, 3) of each cell that has points of the lane, in m.

    Parameters
    ----------
    points : (N, 3) array
        Levelled points. Points above the sensor, too near or too far are skipped.
    width_m : float
        Width of the lane.
    """
    x, y, z = points.T
    ranges = np.hypot(x, y)
    is_beyond_machine = ranges > _MIN_RANGE_M
    is_near = ranges < _MAX_RANGE_M
    in_lane = np.abs(y) < width_m / 2
    is_below_sensor = z < 0.0
    used = points[is_beyond_machine & is_near & in_lane & is_below_sensor]
    # Cells are cubes. A wall fills its own cubes, and does not raise the ground at its foot.
    cubes = np.floor(used / _CELL_M).astype(int)
    _, cell_of_point, counts = np.unique(
        cubes, axis=0, return_inverse=True, return_counts=True
    )
    points_of_cells = Blocks.gathered(used, cell_of_point.ravel(), len(counts))
    return points_of_cells.sums / counts[:, None]


def _rows(cells: FloatArray) -> FloatArray:
    """Return rows (C, 3) of (x, y, 1). Their product with a plane (a, b, c) has its heights."""
    return np.column_stack([cells[:, :2], np.ones(len(cells))])


def _heights(cells: FloatArray, planes: FloatArray) -> FloatArray:
    """Return the heights z (..., C) of planes (..., 3) at the x and y of cells (C, 3)."""
    return planes @ _rows(cells).T


def _plane_by_ransac(cells: FloatArray) -> FloatArray | None:
    """Return the plane (a, b, c) with most inliers, among random planes through three cells.

    None if all random planes are too steep, or if their cells are nearly on a line.
    """
    rng = np.random.default_rng(0)
    corners = rng.integers(len(cells), size=(_N_TRIALS, 3))
    triangles = cells[corners]
    ones = np.ones((_N_TRIALS, 3))
    rows = np.dstack([triangles[..., :2], ones])
    # The determinant is twice the area of the triangle (m^2). A thin triangle determines no plane.
    double_areas_m2 = np.abs(np.linalg.det(rows))
    is_regular = double_areas_m2 > 1.0
    regular_rows = rows[is_regular]
    heights_m = triangles[is_regular][..., 2:]
    planes = np.linalg.solve(regular_rows, heights_m)[..., 0]
    is_level = _slopes(planes) < _MAX_SLOPE
    planes = planes[is_level]
    if not len(planes):
        return None
    distances_m = np.abs(cells[:, 2] - _heights(cells, planes))
    is_inlier = distances_m < _MAX_INLIER_HEIGHT_M
    n_inliers = is_inlier.sum(axis=1)
    return planes[n_inliers.argmax()]


def _slopes(planes: FloatArray) -> FloatArray:
    """Return the slopes (...) of planes (..., 3): tangents of their angles to the horizontal."""
    return np.asarray(np.hypot(planes[..., 0], planes[..., 1]))


def _is_ground(
    cells: FloatArray, inliers: FloatArray, plane: FloatArray
) -> bool:
    """Return whether a plane is wide, not too steep, below nearly all cells, and no deck.

    Parameters
    ----------
    cells : (C, 3) array
    inliers : (I, 3) array
        The cells in the plane.
    plane : (3,) array
    """
    places = inliers[:, :2]
    deviations = places - places.mean(axis=0)
    covariance = deviations.T @ deviations / len(inliers)
    # A single ring of a lidar is nearly a line, so it determines no plane.
    smallest_variance = np.linalg.eigvalsh(covariance)[0]
    is_wide = smallest_variance > _CELL_M**2
    lowest_m = _heights(cells, plane) - 3 * _MAX_INLIER_HEIGHT_M
    is_below = cells[:, 2] < lowest_m
    share_below = is_below.mean()
    is_lowest = share_below < _MAX_SHARE_BELOW
    is_level = _slopes(plane) < _MAX_SLOPE
    reach_m = np.hypot(*places.T).max()
    is_beyond_machine = reach_m > _MIN_REACH_M
    return bool(is_wide and is_lowest and is_level and is_beyond_machine)
