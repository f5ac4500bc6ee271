"""The plane of the ground in a scan of a lidar.

The points are turned so that z is roughly up, and thinned to one point a cell. The ground is the
plane z = a x + b y + c that most cells are near to (RANSAC), fitted to them by least squares.
Reference: M. A. Fischler, R. C. Bolles, *Random sample consensus*, Comm. ACM 24, 1981.
"""

from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.blocks import Blocks

# Distances of used points (m): nearer ones are of the machine, farther on the road may bend.
_RANGE_M = (1.5, 12.0)
# Side of a cell (m). Near rings have many points in a cell, far rings one.
_CELL_M = 0.5
# Number of planes that are tried.
_TRIALS = 200
# Steepest plane against the expected vertical (tangent of 15 deg).
_STEEPEST = 0.27
# Cells within this distance of a plane (m) are of it: grass and the noise of ranges.
_NEAR_M = 0.08
# A plane is no ground if this share of the cells is clearly lower: it may be a loading edge.
_SHARE_BELOW = 0.08


class Plane(NamedTuple):
    """Plane of the ground: its unit normal (3,), up, and the height (m) of the sensor over it."""

    normal: FloatArray
    height_m: float


def ground_of(
    points: FloatArray, up: FloatArray, ahead: FloatArray, width_m: float
) -> Plane | None:
    """Return the ground in a scan, or None if no plane is the ground.

    Parameters
    ----------
    points : (N, 3) array
        In the frame of the sensor, m.
    up : (3,) array
        Expected vertical in the frame of the sensor, a unit vector. The normal of the ground
        differs by 15 deg at most.
    ahead : (3,) array
        Direction of the drive in the frame of the sensor.
    width_m : float
        Width of the ground that is used, with the sensor above its middle.
    """
    turn = _level(up, ahead)
    cells = _cells(points @ turn.T, width_m)
    if not len(cells):
        return None
    plane = _most_supported(cells)
    if plane is None:
        return None
    for _ in range(2):  # of the tried plane, and of the fit
        near = np.abs(cells[:, 2] - _heights(cells, plane)) < _NEAR_M
        plane = np.linalg.lstsq(_columns(cells[near]), cells[near, 2], rcond=None)[0]
    if not _is_ground(cells, near, plane):
        return None
    a, b, c = plane
    length = np.sqrt(1.0 + a * a + b * b)
    return Plane(turn.T @ np.array([-a, -b, 1.0]) / length, float(-c / length))


def _level(up: FloatArray, ahead: FloatArray) -> FloatArray:
    """Return a rotation (3, 3) that turns ``up`` into z, and ``ahead`` into the x-z plane."""
    left = np.cross(up, ahead)
    left /= np.linalg.norm(left)
    return np.array([np.cross(left, up), left, up])


def _cells(points: FloatArray, width_m: float) -> FloatArray:
    """Return means (C, 3) of the points of a lane below the sensor, in cells."""
    ranges = np.hypot(points[:, 0], points[:, 1])
    nearest_m, farthest_m = _RANGE_M
    in_range = (ranges > nearest_m) & (ranges < farthest_m)
    in_lane = np.abs(points[:, 1]) < width_m / 2
    used = points[in_range & in_lane & (points[:, 2] < 0.0)]
    # Cells have three dimensions, so that a wall does not lift the ground at its foot.
    numbers = np.floor(used / _CELL_M).astype(int)
    _, cell_of_point, counts = np.unique(numbers, axis=0, return_inverse=True, return_counts=True)
    sums = Blocks.gathered(used, cell_of_point.ravel(), len(counts)).sums
    return np.asarray(sums / counts[:, None])


def _columns(cells: FloatArray) -> FloatArray:
    return np.column_stack([cells[:, :2], np.ones(len(cells))])


def _heights(cells: FloatArray, planes: FloatArray) -> FloatArray:
    """Heights (..., C) of planes (..., 3) at the cells."""
    return np.asarray(planes @ _columns(cells).T)


def _most_supported(cells: FloatArray) -> FloatArray | None:
    """Return the plane (3,) through three cells that most cells are near to."""
    rng = np.random.default_rng(0)
    samples = cells[rng.integers(len(cells), size=(_TRIALS, 3))]
    columns = np.dstack([samples[..., :2], np.ones((_TRIALS, 3))])
    # Twice the area of the triangle of the cells (m^2).
    is_regular = np.abs(np.linalg.det(columns)) > 1.0
    heights = samples[is_regular][..., 2:]
    planes = np.linalg.solve(columns[is_regular], heights)[..., 0]
    planes = planes[np.hypot(planes[:, 0], planes[:, 1]) < _STEEPEST]
    if not len(planes):
        return None
    distances = np.abs(cells[:, 2] - _heights(cells, planes))
    supports = (distances < _NEAR_M).sum(axis=1)
    return np.asarray(planes[supports.argmax()])


def _is_ground(cells: FloatArray, near: BoolArray, plane: FloatArray) -> bool:
    """Whether a plane is wide, not too steep, and lower than nearly everything else."""
    # A single ring of beams is a line, which determines no plane.
    horizontal = cells[near, :2] - cells[near, :2].mean(axis=0)
    is_wide = np.linalg.eigvalsh(horizontal.T @ horizontal / near.sum())[0] > _CELL_M**2
    is_lower = cells[:, 2] < _heights(cells, plane) - 3 * _NEAR_M
    is_lowest = is_lower.mean() < _SHARE_BELOW
    return bool(is_wide and is_lowest and np.hypot(*plane[:2]) < _STEEPEST)
