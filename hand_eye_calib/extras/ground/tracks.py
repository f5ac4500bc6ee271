"""The vertical in the frame of a sensor over time: from clouds, accelerations or an attitude.

From clouds of a lidar, the vertical is the normal of the ground. From an accelerometer, the
vertical u (a unit vector in the world of the poses) follows over a window from t0 to t1:

    mean(R f) - (v(t1) - v(t0)) / (t1 - t0) = g u

with the specific force f, the rotation R from the sensor to the world, the velocity v of the poses
and the standard gravity g.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
from scipy.constants import g

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.stats import median, medians
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Columns, Trajectory
from hand_eye_calib.extras.ground.planes import Plane, ground_of

#: Quantity from which a vertical was measured.
Source: TypeAlias = Literal["ground", "gravity"]

# Largest rotation about another axis, as a share of the rotation about the main axis. A machine
# that only drives curves is below this limit, and its main axis is the vertical.
_MAX_OTHER_SHARE = 0.3

# Width of the lane (m) whose points are used, by the quantity that the other sensor measures.
_LANE_WIDTHS_M = {"ground": 4.0, "gravity": 24.0}
# Width of a narrower lane (m) that reveals a bend, such as a crown, or tall grass on one side.
_NARROW_WIDTHS_M = {"ground": 2.0, "gravity": 4.0}

# Time (s) over which accelerations are averaged. If it is longer, errors of the velocities matter
# less, and drift of the attitude matters more.
_WINDOW_S = 5.0


@dataclass(frozen=True, eq=False)
class VerticalTrack(Columns):
    """The vertical in the frame of a sensor over time.

    Attributes
    ----------
    stamps_ns : (N,) int64 array
        Stamps on the clock of the sensor.
    ups : (N, 3) array
        Unit vectors that point up, in the frame of the sensor: normals of the ground, or the
        opposite of gravity.
    heights_m : (N,) array or None
        Heights of the sensor over the ground; None for gravity.
    bend_rad : float
        Angle between the ground of the lane and of a narrower lane, for example on a crowned road
        or beside tall grass. Zero for gravity.
    """

    stamps_ns: IntArray
    ups: FloatArray
    heights_m: FloatArray | None = None
    bend_rad: float = 0.0

    @property
    def source(self) -> str:
        """The measured quantity: "gravity" or "ground"."""
        return "gravity" if self.heights_m is None else "ground"


def ground_from_clouds(
    clouds: Iterable[tuple[int, FloatArray]],
    trajectory: Trajectory,
    beside: Source = "ground",
) -> VerticalTrack:
    """Estimate the ground in the scans of a lidar.

    Parameters
    ----------
    clouds : iterable of (int, (N, 3) array)
        Stamp (ns) and points (m, in the frame of the lidar) of each scan. One or two scans per
        second are sufficient.
    trajectory : Trajectory
        Poses of the lidar. The ground is perpendicular to the axis about which the lidar turns in
        curves.
    beside : {"ground", "gravity"}
        Quantity that the other sensor measures. With "ground", only points in the lane of the
        machine are used, because a crown bends the road beside the lane. With "gravity", points of
        the whole road are used, because both sides of a crown together are level.

    Returns
    -------
    VerticalTrack

    Raises
    ------
    NotEnoughDataError
        If the lidar does not turn, or if too few scans contain the ground.

    Examples
    --------
    >>> hec.ground_from_clouds(clouds, poses).heights_m.mean()  # doctest: +SKIP
    1.82
    """
    scans = _ground_of_scans(
        clouds, turning_axis(trajectory), driving_direction(trajectory), beside
    )
    n_planes = len(scans.planes)
    # On a ramp or beside walls, a third of the scans may have no ground. If less than half of them
    # have a plane, the machine does not drive on this plane.
    if 2 * n_planes <= scans.n_scans:
        raise NotEnoughDataError(
            f"{n_planes} of {scans.n_scans} scans contain the ground: it must be visible between 5 "
            "and 12 m, and the z axis of the lidar must point up"
        )
    normals, heights = zip(*scans.planes, strict=True)
    stamps_ns = np.array(scans.stamps_ns, dtype=np.int64)
    bend_rad = 0.0
    if scans.bends:
        # The median vector belongs to the road. Single scans differ by noise and by walls.
        bend = medians(np.array(scans.bends).T)
        bend_rad = float(np.linalg.norm(bend))
    return VerticalTrack(
        stamps_ns, np.array(normals), np.array(heights), bend_rad
    )


@dataclass
class _GroundOfScans:
    """Ground in the scans of a lidar.

    Attributes
    ----------
    n_scans : int
        Number of all scans.
    stamps_ns : list of int
        Stamps of the scans that contain the ground.
    planes : list of Plane
        Ground in the lane, of the same scans.
    bends : list of (3,) arrays
        Normal in a narrower lane minus normal in the lane, of the scans that have both.
    """

    n_scans: int = 0
    stamps_ns: list[int] = field(default_factory=list)
    planes: list[Plane] = field(default_factory=list)
    bends: list[FloatArray] = field(default_factory=list)


def _ground_of_scans(
    clouds: Iterable[tuple[int, FloatArray]],
    up: FloatArray,
    ahead: FloatArray,
    beside: Source,
) -> _GroundOfScans:
    """Return the ground in the scans, for the lane widths of the other sensor's quantity.

    ``up`` and ``ahead`` are unit vectors in the frame of the lidar.
    """
    scans = _GroundOfScans()
    for stamp_ns, cloud in clouds:
        scans.n_scans += 1
        points = np.asarray(cloud, dtype=float)
        plane = ground_of(points, up, ahead, _LANE_WIDTHS_M[beside])
        if plane is None:
            continue
        scans.stamps_ns.append(stamp_ns)
        scans.planes.append(plane)
        narrow = ground_of(points, up, ahead, _NARROW_WIDTHS_M[beside])
        if narrow is not None:
            scans.bends.append(narrow.normal - plane.normal)
    return scans


def gravity_from_accelerations(
    stamps_ns: IntArray, forces: FloatArray, trajectory: Trajectory
) -> VerticalTrack:
    """Estimate the vertical from an accelerometer, at rest or while its sensor moves.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    forces : (N, 3) array
        Specific forces (m/s^2) in the frame of the sensor, as in sensor_msgs/Imu: +9.81 up at rest.
    trajectory : Trajectory
        Poses of the sensor. Their accelerations are subtracted.

    Returns
    -------
    VerticalTrack

    Raises
    ------
    NotEnoughDataError
        If both streams overlap for less than three windows of 5 s, or if the mean force is not
        about gravity.

    Examples
    --------
    >>> hec.gravity_from_accelerations(stamps_ns, forces, poses).source  # doctest: +SKIP
    'gravity'
    """
    margin_ns = int(_WINDOW_S / 10 * 1e9)
    first_ns = trajectory.stamps_ns[0] + margin_ns
    last_ns = trajectory.stamps_ns[-1] - margin_ns
    has_poses = (stamps_ns > first_ns) & (stamps_ns < last_ns)
    is_finite = np.isfinite(forces).all(axis=1)
    is_used = has_poses & is_finite
    stamps_ns = stamps_ns[is_used]
    forces = forces[is_used]
    n_windows = 0
    if len(stamps_ns):
        n_windows = int((stamps_ns[-1] - stamps_ns[0]) * 1e-9 / _WINDOW_S)
    if n_windows < 3:
        raise NotEnoughDataError(
            "accelerations and poses overlap for less than 15 s"
        )
    middles_ns, verticals = _verticals_of_windows(
        stamps_ns, forces, trajectory, n_windows
    )
    length = median(np.linalg.norm(verticals, axis=1))
    if abs(length - g) > g / 20:
        raise NotEnoughDataError(
            f"the mean acceleration is {length:.2f} m/s^2, not that of gravity: the driver of the "
            "IMU must not subtract gravity"
        )
    # The world of the poses tilts slowly. Interpolate its vertical between the windows.
    stamps = trajectory.stamps_ns
    stamps = stamps[(stamps >= middles_ns[0]) & (stamps <= middles_ns[-1])]
    since_s = (stamps - middles_ns[0]) * 1e-9
    middles_s = (middles_ns - middles_ns[0]) * 1e-9
    columns = [np.interp(since_s, middles_s, column) for column in verticals.T]
    return _in_sensor(trajectory, stamps, np.column_stack(columns))


def _verticals_of_windows(
    stamps_ns: IntArray,
    forces: FloatArray,
    trajectory: Trajectory,
    n_windows: int,
) -> tuple[IntArray, FloatArray]:
    """Return the vertical times gravity in each of W windows, in the world of the poses.

    Returns
    -------
    middles_ns : (W,) int64 array
        Stamps of the middles of the windows.
    verticals : (W, 3) array
        ``g u`` of the module, m/s^2.
    """
    poses = trajectory.at(stamps_ns, extrapolate=True)
    rotations = se3.rotation_of(poses)
    in_world = np.einsum("nij,nj->ni", rotations, forces)
    middles_ns = []
    verticals = []
    for rows in np.array_split(np.arange(len(stamps_ns)), n_windows):
        ends_ns = stamps_ns[rows[[0, -1]]]
        duration_ns = ends_ns[1] - ends_ns[0]
        duration_s = duration_ns * 1e-9
        velocities = _velocities(trajectory, ends_ns)
        acceleration = (velocities[1] - velocities[0]) / duration_s
        mean_force = in_world[rows].mean(axis=0)
        middle_ns = ends_ns.sum() // 2
        verticals.append(mean_force - acceleration)
        middles_ns.append(middle_ns)
    return np.array(middles_ns, dtype=np.int64), np.array(verticals)


def gravity_from_attitude(trajectory: Trajectory) -> VerticalTrack:
    """Return the vertical from poses whose world has z up, such as those of an INS.

    Parameters
    ----------
    trajectory : Trajectory

    Returns
    -------
    VerticalTrack

    Examples
    --------
    >>> hec.gravity_from_attitude(hec.simulate(0, poses=50).parent).source
    'gravity'
    """
    up = np.array([0.0, 0.0, 1.0])
    ups = np.tile(up, (len(trajectory), 1))
    return _in_sensor(trajectory, trajectory.stamps_ns, ups)


def _in_sensor(
    trajectory: Trajectory, stamps_ns: IntArray, ups: FloatArray
) -> VerticalTrack:
    """Return the track of a sensor from verticals (N, 3) in the world of its poses."""
    poses = trajectory.at(stamps_ns, extrapolate=True)
    rotations = se3.rotation_of(poses)
    # Transposed rotations: from the world to the sensor.
    in_sensor = np.einsum("nji,nj->ni", rotations, ups)
    lengths = np.linalg.norm(in_sensor, axis=1, keepdims=True)
    return VerticalTrack(stamps_ns, in_sensor / lengths)


def _velocities(trajectory: Trajectory, stamps_ns: IntArray) -> FloatArray:
    """Return velocities (N, 3) at stamps (N,), in m/s and the world of the poses."""
    half_ns = int(_WINDOW_S / 20 * 1e9)
    before = trajectory.at(stamps_ns - half_ns, extrapolate=True)
    after = trajectory.at(stamps_ns + half_ns, extrapolate=True)
    moved_m = se3.translation_of(after) - se3.translation_of(before)
    duration_ns = 2 * half_ns
    return moved_m * 1e9 / duration_ns


def turning_axis(trajectory: Trajectory) -> FloatArray:
    """Estimate the vertical (3,) in the frame of the sensor: the main axis of its rotation.

    The sign is chosen so that the z axis of the sensor points up.

    Raises
    ------
    NotEnoughDataError
        If the sensor turns about several axes, or not at all.
    """
    # Rotations over a second exceed the noise of single poses.
    step = max(1, round(1.0 / trajectory.interval_s))
    poses = trajectory.poses[::step]
    rotations = se3.rotation_of(poses)
    turns = se3.rotations_between(rotations[:-1], rotations[1:])
    products = turns.T @ turns
    squares, axes = np.linalg.eigh(products)
    # The last axis has the largest eigenvalue.
    largest_other = _MAX_OTHER_SHARE**2 * squares[2]
    if squares[1] >= largest_other:
        raise NotEnoughDataError(
            "the sensor does not turn about the vertical alone"
        )
    axis = axes[:, 2]
    sign = np.sign(axis[2])
    return axis * sign


def driving_direction(trajectory: Trajectory) -> FloatArray:
    """Estimate the main direction of the motion (3,) in the frame of the sensor.

    The direction may be forwards or backwards.
    """
    step = max(1, round(1.0 / trajectory.interval_s))
    before = trajectory.poses[:-step:step]
    after = trajectory.poses[step::step]
    motions = se3.inverse(before) @ after
    displacements = se3.translation_of(motions)
    products = displacements.T @ displacements
    _, axes = np.linalg.eigh(products)
    return axes[:, 2]
