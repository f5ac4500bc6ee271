"""Simulate a ground vehicle with two sensors on hills, and the errors of odometry and SLAM.

Reference: Välimäki et al. 2023, section 4.1. The text of the article differs from its published
trajectories in three points. The simulation follows the trajectories: the value called sigma^2 is a
standard deviation, a jump shifts all later poses, and only the child sensor drifts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Integral
from typing import Literal

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import require_type
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory, WithArrays
from hand_eye_calib.extras.simulation import options

# Position (x, y) at the start of the published drives, in units of ``terrain_scale``. The vehicle
# starts in the direction of x.
_START = np.array([0.0, 0.5])
# Time from the start of the published drives to their first pose (s).
_LEAD_S = 0.1
# Time for which the first yaw rate of the published drives is constant (s).
_FIRST_HOLD_S = 0.4
# Largest offset of the child sensor along each axis of the parent (m).
_LARGEST_OFFSET_M = 0.5
# Variance of a jump along each axis (m^2).
_JUMP_VARIANCE = 0.02

_NO_NOISE = options.NoiseConfig()


@dataclass(frozen=True, eq=False)
class SimulatedDrive(WithArrays):
    """Simulated trajectories of both sensors, and the truth.

    Attributes
    ----------
    parent, child : Trajectory
        Poses with noise, of each sensor in its own world.
    T_parent_child : (4, 4) array
        The true extrinsic.
    T_pw_cw : (4, 4) array
        Pose of the child's world in the parent's world.
    """

    parent: Trajectory
    child: Trajectory
    T_parent_child: FloatArray
    T_pw_cw: FloatArray


def simulate(
    seed: int = 0,
    *,
    drive: Literal["hilly", "published"] = "hilly",
    poses: int = 600,
    gaussian: float = options.REALISTIC.gaussian,
    outliers: float = options.REALISTIC.outliers,
    drift: float = options.REALISTIC.drift,
) -> SimulatedDrive:
    """Simulate two sensors on one vehicle with a known extrinsic.

    Parameters
    ----------
    seed : int
        Equal seeds make equal drives. Default: 0.
    drive : {"hilly", "published"}
        "hilly" (default): a robot outdoors at 1.5 m/s; sensors at 10 and 20 Hz without common
        stamps. "published": the drive of the article at 0.5 m/s; both sensors at 10 Hz with equal
        stamps.
    poses : int
        Number of poses of the parent sensor. Default: 600, one minute.
    gaussian : float
        Standard deviation of each pose's translation error per axis. Default: 0.002 m.
    outliers : float
        Share of the poses at which a trajectory jumps. Default: 0.005.
    drift : float
        Drift of the child per metre, m/m. Default: 0.002.

    Returns
    -------
    SimulatedDrive
        Trajectories ``parent`` and ``child``, and the truth ``T_parent_child``.

    Examples
    --------
    >>> drive = hec.simulate(3, poses=100)
    >>> drive.parent
    Trajectory(100 poses over 9.900 s, sensor_frame='lidar', world_frame='lidar_odom')
    """
    config = (
        options.HILLY_DRIVE if drive == "hilly" else options.PUBLISHED_DRIVE
    )
    config = replace(
        config, poses=poses, parent_frame="lidar", child_frame="camera"
    )
    noise = replace(
        options.REALISTIC, gaussian=gaussian, outliers=outliers, drift=drift
    )
    require_type("seed", seed, Integral)
    return simulate_drive(seed, config, noise)


def _drawn_extrinsic(rng: np.random.Generator) -> FloatArray:
    """Return a random extrinsic (4, 4): any rotation, and a translation within some metres."""
    rotation = se3.rotation_of(
        se3.from_quat_xyzw(np.zeros(3), rng.standard_normal(4))
    )
    translation = rng.uniform(-_LARGEST_OFFSET_M, _LARGEST_OFFSET_M, 3)
    return se3.from_rotation_translation(rotation, translation)


def _drawn_worlds(rng: np.random.Generator) -> FloatArray:
    """Return a random pose (4, 4) of the child's world in the parent's world.

    Yaw, pitch, roll (rad) and translation (m) are differences of two uniform random numbers each.
    """
    first = rng.uniform(size=(2, 3))
    angles, translation = first - rng.uniform(size=(2, 3))
    rotation = se3.rotation_from_rpy(angles[::-1])
    return se3.from_rotation_translation(rotation, translation)


def simulate_drive(
    seed: int | Sequence[int],
    config: options.DriveConfig = options.PUBLISHED_DRIVE,
    noise: options.NoiseConfig = _NO_NOISE,
    T_parent_child: FloatArray | None = None,
) -> SimulatedDrive:
    """Simulate one drive.

    Parameters
    ----------
    seed : int or sequence of int
        Equal seeds make equal drives for any noise. The random numbers of the noise are then equal,
        too; the levels of ``noise`` multiply them.
    config : DriveConfig
    noise : NoiseConfig
    T_parent_child : (4, 4) array, optional
        The true extrinsic; random by default.

    Returns
    -------
    SimulatedDrive
    """
    motion_rng, extrinsic_rng, noise_rng = np.random.default_rng(seed).spawn(3)
    n_child = max(
        2, round(config.poses * config.child_rate / config.parent_rate)
    )
    parent_times_s = np.arange(config.poses) / config.parent_rate
    child_times_s = config.child_delay + np.arange(n_child) / config.child_rate
    times_s = _LEAD_S + np.r_[parent_times_s, child_times_s]
    positions, headings = _ground_track(config, motion_rng, times_s)
    Ts_pw_p = _poses_on_terrain(config, positions, headings)
    Ts_pw_p_at_child = Ts_pw_p[config.poses :]
    Ts_pw_p = Ts_pw_p[: config.poses]
    # The random numbers are drawn even if they are not needed, so that those of the worlds stay.
    T_drawn = _drawn_extrinsic(extrinsic_rng)
    if T_parent_child is None:
        T_parent_child = T_drawn
    T_pw_cw = _drawn_worlds(extrinsic_rng)
    Ts_cw_c = se3.inverse(T_pw_cw) @ Ts_pw_p_at_child @ T_parent_child
    Ts_pw_p, Ts_cw_c = add_noise(Ts_pw_p, Ts_cw_c, noise, noise_rng)

    def trajectory(
        times_s: FloatArray, Ts_world_sensor: FloatArray, frame: str
    ) -> Trajectory:
        """Return a trajectory with stamps that begin at the start time of the drive."""
        since_start_ns = np.round(times_s * 1e9).astype(np.int64)
        stamps_ns = round(config.start_time * 1e9) + since_start_ns
        return Trajectory(stamps_ns, Ts_world_sensor, frame, f"{frame}_odom")

    return SimulatedDrive(
        trajectory(parent_times_s, Ts_pw_p, config.parent_frame),
        trajectory(child_times_s, Ts_cw_c, config.child_frame),
        T_parent_child,
        T_pw_cw,
    )


def _ground_track(
    config: options.DriveConfig, rng: np.random.Generator, times_s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the positions (N, 2), m, and headings (N,), rad, at times (N,), s, since the start.

    The track consists of circular arcs, because each random yaw rate is constant for a hold time.
    """
    # Duration, yaw rate, start time and first heading of each arc.
    n_arcs = int(times_s.max() // config.hold_time) + 2
    holds_s = np.full(n_arcs, config.hold_time)
    holds_s[0] = _FIRST_HOLD_S
    yaw_rates = rng.uniform(
        -config.max_yaw_rate, config.max_yaw_rate, len(holds_s)
    )
    starts_s = np.cumsum(holds_s) - holds_s
    headings = np.cumsum(yaw_rates * holds_s) - yaw_rates * holds_s
    arcs = _arc(config.speed, headings, yaw_rates, holds_s)
    # First position of each arc.
    corners = _START * config.terrain_scale + (np.cumsum(arcs, axis=0) - arcs)
    # Index of the arc at each time.
    arc = np.searchsorted(starts_s, times_s, side="right") - 1
    elapsed_s = times_s - starts_s[arc]
    positions = corners[arc] + _arc(
        config.speed, headings[arc], yaw_rates[arc], elapsed_s
    )
    return positions, headings[arc] + yaw_rates[arc] * elapsed_s


def _arc(
    speed: float,
    heading: FloatArray,
    yaw_rate: FloatArray,
    duration_s: FloatArray,
) -> FloatArray:
    """Return the displacements (N, 2), m, along arcs that begin with these headings (N,), rad.

    The chord of an arc has the mean heading of both ends.
    """
    half_turn = 0.5 * yaw_rate * duration_s
    chord = speed * duration_s * np.sinc(half_turn / np.pi)
    direction = heading + half_turn
    return np.stack(
        [chord * np.cos(direction), chord * np.sin(direction)], axis=-1
    )


def _poses_on_terrain(
    config: options.DriveConfig, positions: FloatArray, headings: FloatArray
) -> FloatArray:
    """Return poses (N, 4, 4) of the vehicle at positions (N, 2) with headings (N,)."""
    x, y = positions.T
    z, slope_x, slope_y = surface(config, x, y)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(z)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    if config.attitude == "published":
        # This formula was fitted to the published noise-free poses. It reproduces their heading
        # exactly, and pitch and roll to 0.01 rad. Yaw is the heading. Pitch and roll are the arc
        # sines of x and y of the normal. The rotation matrix is then transposed.
        yaw_pitch_roll = np.stack(
            [headings, *np.arcsin(normals[:, :2].T)], axis=-1
        )
        transposed = se3.rotation_from_rpy(yaw_pitch_roll[:, ::-1])
        rotations = np.swapaxes(transposed, -1, -2)
    else:
        # z is along the normal, and x is in the vertical plane of the heading.
        ahead = np.stack(
            [np.cos(headings), np.sin(headings), np.zeros_like(headings)],
            axis=-1,
        )
        y_axes = np.cross(normals, ahead)
        y_axes /= np.linalg.norm(y_axes, axis=-1, keepdims=True)
        x_axes = np.cross(y_axes, normals)
        rotations = np.stack([x_axes, y_axes, normals], axis=-1)
    return se3.from_rotation_translation(
        rotations, np.column_stack([positions, z])
    )


def surface(
    config: options.DriveConfig, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, ...]:
    """Return the height (N,) of the ground, m, and its slopes (N,) along x and y.

    Parameters
    ----------
    config : DriveConfig
        The ground is ``terrain_height * peaks(x / terrain_scale, y / terrain_scale)``, with the
        function :func:`_peaks` and lengths in m. Its arguments beyond +/- ``terrain_limit`` are
        mirrored, so that a long drive stays on the hills.
    x, y : (N,) arrays
        Positions, m.
    """
    height = config.terrain_height
    scale = config.terrain_scale
    limit = config.terrain_limit
    u, sign_u = _mirrored(x / scale, limit)
    v, sign_v = _mirrored(y / scale, limit)
    peaks, along_u, along_v = _peaks(u, v)
    slope = height / scale
    return height * peaks, slope * sign_u * along_u, slope * sign_v * along_v


def _peaks(
    x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the height of three hills and three hollows, and its derivatives along x and y.

    This is the function ``peaks`` of MATLAB. All arrays have the same shape and no unit. The ground
    is flat at distances of more than 3.5 from the origin.
    """
    hill = 3.0 * np.exp(-(x**2) - (y + 1.0) ** 2)
    middle = 10.0 * np.exp(-(x**2) - y**2)
    polynomial = x / 5.0 - x**3 - y**5
    hollow = np.exp(-((x + 1.0) ** 2) - y**2) / 3.0
    total = (1.0 - x) ** 2 * hill - polynomial * middle - hollow
    hill_along_x = -2.0 * (1.0 - x) * (1.0 + x * (1.0 - x)) * hill
    middle_along_x = (2.0 * x * polynomial - 0.2 + 3.0 * x**2) * middle
    hollow_along_x = 2.0 * (x + 1.0) * hollow
    hill_along_y = -2.0 * (y + 1.0) * (1.0 - x) ** 2 * hill
    middle_along_y = (2.0 * y * polynomial + 5.0 * y**4) * middle
    hollow_along_y = 2.0 * y * hollow
    along_x = hill_along_x + (middle_along_x + hollow_along_x)
    along_y = hill_along_y + (middle_along_y + hollow_along_y)
    return total, along_x, along_y


def _mirrored(
    values: FloatArray, limit: float
) -> tuple[FloatArray, FloatArray]:
    """Return values (N,) mirrored at +/- ``limit``, which is a triangle wave, and its slope."""
    phase = np.mod(values + limit, 4.0 * limit)
    is_falling = phase > 2.0 * limit
    wave = np.where(is_falling, 3.0 * limit - phase, phase - limit)
    return wave, np.where(is_falling, -1.0, 1.0)


def add_noise(
    Ts_pw_p: FloatArray,
    Ts_cw_c: FloatArray,
    noise: options.NoiseConfig,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Add Gaussian noise to both sensors, then drift to the child, then jumps to both sensors.

    Each kind of noise has its own random numbers, so that the level of one kind does not change the
    others.

    Parameters
    ----------
    Ts_pw_p, Ts_cw_c : (N, 4, 4), (M, 4, 4) arrays
        Poses of the parent sensor and of the child sensor, each in its world.
    noise : NoiseConfig
    rng : numpy.random.Generator

    Returns
    -------
    (N, 4, 4), (M, 4, 4) arrays
    """
    gaussian_rng, drift_rng, jump_rng = rng.spawn(3)
    Ts_pw_p = _with_gaussian(Ts_pw_p, noise, gaussian_rng)
    Ts_cw_c = _with_gaussian(Ts_cw_c, noise, gaussian_rng)
    # Drift: each step is extended along one axis of the sensor, by a share of its length.
    axis = drift_rng.integers(3)
    lengths_m = np.linalg.norm(
        np.diff(se3.translation_of(Ts_cw_c), axis=0), axis=1
    )
    steps = noise.drift * lengths_m[:, None] * Ts_cw_c[:-1, :3, axis]
    Ts_cw_c[1:, :3, 3] += np.cumsum(steps, axis=0)
    Ts_pw_p = _with_jumps(Ts_pw_p, noise.outliers, jump_rng)
    Ts_cw_c = _with_jumps(Ts_cw_c, noise.outliers, jump_rng)
    return Ts_pw_p, Ts_cw_c


def _with_gaussian(
    Ts_world_sensor: FloatArray,
    noise: options.NoiseConfig,
    rng: np.random.Generator,
) -> FloatArray:
    """Add an independent error to each pose (N, 4, 4), in the frame of the sensor."""
    shape = (len(Ts_world_sensor), 3)
    angles = (
        noise.gaussian * noise.rotation_per_metre * rng.standard_normal(shape)
    )
    rotations = se3.rotation_from_rpy(angles[:, ::-1])
    translations = noise.gaussian * rng.standard_normal(shape)
    return Ts_world_sensor @ se3.from_rotation_translation(
        rotations, translations
    )


def _with_jumps(
    Ts_world_sensor: FloatArray, share: float, rng: np.random.Generator
) -> FloatArray:
    """Return a trajectory (N, 4, 4) with jumps: each shifts all later poses along the world's axes.

    ``round(share * N)`` poses at which it jumps are drawn with replacement.
    """
    count = len(Ts_world_sensor)
    indices = rng.integers(count, size=round(share * count))
    shifts = np.zeros((count, 3))
    np.add.at(
        shifts,
        indices,
        np.sqrt(_JUMP_VARIANCE) * rng.standard_normal((len(indices), 3)),
    )
    jumped = Ts_world_sensor.copy()
    jumped[:, :3, 3] += np.cumsum(shifts, axis=0)
    return jumped
