"""Options of simulated drives and their noise (Välimäki et al. 2023, section 4.1)."""

from dataclasses import dataclass
from typing import Any

from hand_eye_calib.config import OptionSet, option


def _number(
    default: float, doc: str, unit: str = "", least: float = 0.0, most: float = 10_000.0
) -> Any:
    return option(default, doc, unit=unit, within=(least, most))


@dataclass(frozen=True, kw_only=True)
class DriveConfig(OptionSet):
    """Vehicle, terrain and sensors; all defaults but the attitude are those of the published
    trajectories.
    """

    poses: int = option(100, "Number of poses of the parent sensor.", within=(2, 10_000_000))
    parent_rate: float = _number(10.0, "Poses of the parent sensor per second.", "Hz", 0.01)
    child_rate: float = _number(10.0, "Poses of the child sensor per second.", "Hz", 0.01)
    child_delay: float = _number(
        0.0, "Time from the first pose of the parent to the first of the child.", "s", most=60.0
    )
    start_time: float = _number(0.0, "Stamp of the first pose of the parent.", "s", most=4e9)
    speed: float = _number(0.5, "Horizontal speed.", "m/s", most=100.0)
    max_yaw_rate: float = _number(
        2.0, "Yaw rates are drawn between plus and minus this.", "rad/s", most=100.0
    )
    hold_time: float = _number(0.5, "Time for which a yaw rate is held.", "s", 1e-3)
    terrain_height: float = _number(
        0.1, "Height of the terrain per unit of peaks.", "m", most=100.0
    )
    terrain_scale: float = _number(
        1.0, "Horizontal size of the terrain per unit of peaks' arguments.", "m", 0.01
    )
    terrain_limit: float = _number(
        5.0, "Beyond this argument of peaks the terrain continues mirrored.", "", 1.0, 1e6
    )
    attitude: str = option(
        "vehicle",
        "vehicle: x ahead, z along the normal of the surface. published: the orientations of the "
        "published trajectories, which no vehicle has (transposed, slopes not rotated with the "
        "heading).",
        choices=("published", "vehicle"),
    )
    max_offset: float = _number(
        0.5, "Largest offset of the child sensor along each axis of the parent.", "m", most=100.0
    )
    parent_frame: str = option("parent", "Frame of the parent sensor.")
    child_frame: str = option("child", "Frame of the child sensor.")


# Drives of the article, as published.
PUBLISHED_DRIVE = DriveConfig(attitude="published")

# Two minutes of a robot or forklift outdoors: hills steep enough to reveal all six degrees of
# freedom, sensors at different rates without a common stamp.
HILLY_DRIVE = DriveConfig(
    poses=1200,
    parent_rate=10.0,
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
class NoiseConfig(OptionSet):
    """Level of each kind of noise; the default is none."""

    gaussian: float = _number(
        0.0,
        "Standard deviation of each pose's translation error per axis (published: 0 to 0.010).",
        "m",
        most=10.0,
    )
    rotation_per_metre: float = _number(
        2.0,
        "Standard deviation of each pose's Euler angles over that of its translation.",
        "rad/m",
        most=100.0,
    )
    outliers: float = _number(
        0.0,
        "Share of the poses of each sensor at which its trajectory jumps (published: 0 to 0.10).",
        most=1.0,
    )
    drift: float = _number(
        0.0,
        "Drift of the child sensor along one of its axes (published: 0 to 0.05).",
        "m/m",
        most=10.0,
    )


# Good odometry: 2 mm and 0.06 deg per pose, 2 mm of drift per metre, a few SLAM corrections of
# decimetres.
REALISTIC = NoiseConfig(gaussian=0.002, rotation_per_metre=0.5, outliers=0.005, drift=0.002)

# Mixture of the article: the middle of each range.
MIXTURE = NoiseConfig(gaussian=0.005, outliers=0.05, drift=0.025)
