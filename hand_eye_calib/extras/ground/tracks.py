"""The vertical in the frame of a sensor over time: from clouds, accelerations or an attitude.

The normal n of the ground follows from the clouds of a lidar. The vertical u follows from the
specific force f of an accelerometer, the velocity v of the poses of its sensor and gravity g, in
the world of these poses, over a window from t0 to t1:

    mean(R f) - (v(t1) - v(t0)) / (t1 - t0) = g u.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.constants import g

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Columns, Trajectory
from hand_eye_calib.extras.ground.planes import ground_of

#: Quantity that a vertical is from.
Source: TypeAlias = Literal["ground", "gravity"]

# The vertical is the axis of curves: rotation about all other axes is below this share.
_LARGEST_OTHER_SHARE = 0.3

# Width of the ground (m) that is used, by what the other sensor measures.
_WIDTHS_M = {"ground": 4.0, "gravity": 24.0}

# Window (s) over which accelerations are averaged: errors of velocities count less in long windows,
# drift of the attitude more.
_WINDOW_S = 5.0


@dataclass(frozen=True, eq=False)
class VerticalTrack(Columns):
    """The vertical in the frame of a sensor over time.

    Attributes
    ----------
    stamps_ns : (N,) int64 array
        On the clock of the sensor.
    ups : (N, 3) array
        Unit vectors, up, in the frame of the sensor: normals of the ground, or against gravity.
    heights_m : (N,) array or None
        Heights of the sensor over the ground; None for gravity.
    """

    stamps_ns: IntArray
    ups: FloatArray
    heights_m: FloatArray | None = None

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
        Stamp (ns) and points (m, in the frame of the lidar) of each scan. One or two scans a second
        suffice.
    trajectory : Trajectory
        Poses of the lidar. The ground is perpendicular to the axis about which the lidar turns in
        curves.
    beside : {"ground", "gravity"}
        Quantity that the other sensor measures. For two lidars, the lane of the machine is used,
        because a crown bends the road beside it. For gravity, the whole road is used: both sides of
        a crown together are level.

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
    up = turning_axis(trajectory)
    ahead = driving_direction(trajectory)
    width_m = _WIDTHS_M[beside]
    stamps_ns = []
    planes = []
    n_scans = 0
    for stamp_ns, points in clouds:
        n_scans += 1
        plane = ground_of(np.asarray(points, dtype=float), up, ahead, width_m)
        if plane is not None:
            stamps_ns.append(stamp_ns)
            planes.append(plane)
    # On a ramp and beside walls, a third of the scans has no ground. A plane that is found in fewer
    # than half is not what the machine drives on.
    if 2 * len(planes) <= n_scans:
        raise NotEnoughDataError(f"{len(planes)} of {n_scans} scans contain the ground")
    normals, heights = zip(*planes, strict=True)
    stamps = np.array(stamps_ns, dtype=np.int64)
    return VerticalTrack(stamps, np.array(normals), np.array(heights))


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
        If both streams overlap for less than three windows of 5 s, or if the mean force is not that
        of gravity.

    Examples
    --------
    >>> hec.gravity_from_accelerations(stamps_ns, forces, poses).source  # doctest: +SKIP
    'gravity'
    """
    margin_ns = int(_WINDOW_S / 10 * 1e9)
    first_ns = trajectory.stamps_ns[0] + margin_ns
    last_ns = trajectory.stamps_ns[-1] - margin_ns
    is_used = (stamps_ns > first_ns) & (stamps_ns < last_ns) & np.isfinite(forces).all(axis=1)
    stamps_ns = stamps_ns[is_used]
    forces = forces[is_used]
    n_windows = 0
    if len(stamps_ns):
        n_windows = int((stamps_ns[-1] - stamps_ns[0]) * 1e-9 / _WINDOW_S)
    if n_windows < 3:
        raise NotEnoughDataError("accelerations and poses overlap for less than 15 s")
    middles_ns, verticals = _verticals_of_windows(stamps_ns, forces, trajectory, n_windows)
    length = median(np.linalg.norm(verticals, axis=1))
    if abs(length - g) > g / 20:
        raise NotEnoughDataError(
            f"the mean acceleration is {length:.2f} m/s^2, not that of gravity"
        )
    # The vertical of the world drifts slowly: it is interpolated between the windows.
    stamps = trajectory.stamps_ns
    stamps = stamps[(stamps >= middles_ns[0]) & (stamps <= middles_ns[-1])]
    since_s = (stamps - middles_ns[0]) * 1e-9
    middles_s = (middles_ns - middles_ns[0]) * 1e-9
    columns = [np.interp(since_s, middles_s, column) for column in verticals.T]
    return _in_sensor(trajectory, stamps, np.column_stack(columns))


def _verticals_of_windows(
    stamps_ns: IntArray, forces: FloatArray, trajectory: Trajectory, n_windows: int
) -> tuple[IntArray, FloatArray]:
    """Return the middles (W,) of windows, and mean forces (W, 3) of gravity in the world."""
    rotations = se3.rotation_of(trajectory.at(stamps_ns, extrapolate=True))
    in_world = np.einsum("nij,nj->ni", rotations, forces)
    middles_ns = []
    verticals = []
    for rows in np.array_split(np.arange(len(stamps_ns)), n_windows):
        ends_ns = stamps_ns[rows[[0, -1]]]
        duration_s = (ends_ns[1] - ends_ns[0]) * 1e-9
        velocities = _velocities(trajectory, ends_ns)
        acceleration = (velocities[1] - velocities[0]) / duration_s
        verticals.append(in_world[rows].mean(axis=0) - acceleration)
        middles_ns.append(ends_ns.sum() // 2)
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
    ups = np.tile([0.0, 0.0, 1.0], (len(trajectory), 1))
    return _in_sensor(trajectory, trajectory.stamps_ns, ups)


def _in_sensor(trajectory: Trajectory, stamps_ns: IntArray, ups: FloatArray) -> VerticalTrack:
    """Return the track of verticals (N, 3) that are in the world of the poses."""
    rotations = se3.rotation_of(trajectory.at(stamps_ns, extrapolate=True))
    ups = np.einsum("nji,nj->ni", rotations, ups)
    return VerticalTrack(stamps_ns, ups / np.linalg.norm(ups, axis=1, keepdims=True))


def _velocities(trajectory: Trajectory, stamps_ns: IntArray) -> FloatArray:
    """Return velocities (N, 3), m/s, in the world of the poses."""
    half_ns = int(_WINDOW_S / 20 * 1e9)
    before, after = (
        se3.translation_of(trajectory.at(stamps_ns + shift, extrapolate=True))
        for shift in (-half_ns, half_ns)
    )
    return np.asarray((after - before) * 1e9 / (2 * half_ns))


def turning_axis(trajectory: Trajectory) -> FloatArray:
    """Return the main axis of rotation (3,) in the frame of the sensor: the vertical.

    The z axis of the sensor points upwards, so that it tells up from down.

    Raises
    ------
    NotEnoughDataError
        If the sensor turns about several axes, or not at all.
    """
    # Rotations within a second: noise of single poses counts little.
    step = max(1, round(1.0 / trajectory.interval_s))
    rotations = se3.rotation_of(trajectory.poses[::step])
    turns = se3.rotation_log(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])
    squares, axes = np.linalg.eigh(turns.T @ turns)
    if squares[1] >= _LARGEST_OTHER_SHARE**2 * squares[2]:
        raise NotEnoughDataError("the sensor does not turn about the vertical alone")
    axis = axes[:, 2]
    return np.asarray(axis * np.sign(axis[2]))


def driving_direction(trajectory: Trajectory) -> FloatArray:
    """Return the main direction of the motion (3,) in the frame of the sensor."""
    step = max(1, round(1.0 / trajectory.interval_s))
    steps = se3.translation_of(
        se3.inverse(trajectory.poses[:-step:step]) @ trajectory.poses[step::step]
    )
    return np.asarray(np.linalg.eigh(steps.T @ steps)[1][:, 2])
