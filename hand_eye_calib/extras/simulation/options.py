"""Options of simulated drives and of their noise (Välimäki et al. 2023, section 4.1)."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class DriveConfig:
    """Vehicle, terrain and sensors of a simulated drive.

    The defaults are those of the published trajectories, except the attitude.

    Attributes
    ----------
    poses : int
        Number of poses of the parent sensor.
    parent_rate, child_rate : float
        Poses per second, Hz.
    child_delay : float
        Time from the first pose of the parent to the first pose of the child, s.
    start_time : float
        Stamp of the first pose of the parent, s.
    speed : float
        Horizontal speed, m/s.
    max_yaw_rate, hold_time : float
        Yaw rates are drawn within +/- ``max_yaw_rate`` (rad/s), and are constant for ``hold_time``
        (s).
    terrain_height, terrain_scale, terrain_limit : float
        See :func:`~hand_eye_calib.extras.simulation.drive.surface`.
    attitude : {"vehicle", "published"}
        "vehicle": x ahead and z along the normal of the ground. "published": the orientations of
        the published trajectories. These are not possible for a vehicle: they are transposed, and
        slopes are not rotated with the heading.
    """

    poses: int = 100
    parent_rate: float = 10.0
    child_rate: float = 10.0
    child_delay: float = 0.0
    start_time: float = 0.0
    speed: float = 0.5
    max_yaw_rate: float = 2.0
    hold_time: float = 0.5
    terrain_height: float = 0.1
    terrain_scale: float = 1.0
    terrain_limit: float = 5.0
    attitude: str = "vehicle"
    parent_frame: str = "parent"
    child_frame: str = "child"


# The published drives of the article.
PUBLISHED_DRIVE = DriveConfig(attitude="published")

# Two minutes of a robot or forklift outdoors. The slopes determine all six axes. The sensors have
# different rates and no common stamps.
HILLY_DRIVE = DriveConfig(
    poses=1200,
    child_rate=20.0,
    child_delay=0.0137,
    start_time=1.7e9,
    speed=1.5,
    max_yaw_rate=1.0,
    hold_time=1.5,
    terrain_height=0.15,
    terrain_scale=2.5,
    terrain_limit=3.0,
)


@dataclass(frozen=True)
class NoiseConfig:
    """Level of each kind of noise in a simulated drive. By default, there is no noise.

    Attributes
    ----------
    gaussian : float
        Standard deviation of each pose's translation error per axis, m (published: 0 to 0.010).
    rotation_per_metre : float
        Standard deviation of each pose's Euler angles (rad), divided by that of its translation
        (m).
    outliers : float
        Share of the poses of each sensor at which the trajectory jumps (published: 0 to 0.10).
    drift : float
        Drift of the child sensor along one of its axes, metres per metre (published: 0 to 0.05).
    """

    gaussian: float = 0.0
    rotation_per_metre: float = 2.0
    outliers: float = 0.0
    drift: float = 0.0


# Good odometry: 2 mm and 0.06 deg per pose, 2 mm of drift per metre, and a few jumps of some
# decimetres, as from corrections by SLAM.
REALISTIC = NoiseConfig(
    gaussian=0.002, rotation_per_metre=0.5, outliers=0.005, drift=0.002
)

# Mixture of the article: the middle of each published range.
MIXTURE = NoiseConfig(gaussian=0.005, outliers=0.05, drift=0.025)
