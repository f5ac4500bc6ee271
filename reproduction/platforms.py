"""Simulated machines of the studies of faults: motion, odometry, lever arm."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry.trajectory import Trajectory
from reproduction.coverage import motions
from reproduction.coverage.classes import LIDAR_ODOMETRY, VIO, slam, stamps_ns
from reproduction.coverage.sensor_errors import SensorErrors, draw, sigmas

_WHEELS = SensorErrors(
    white=sigmas(0.002, 0.02), walk_by_metre=sigmas(0.004, 0.05)
)


def generators_of(
    platform: str, seed: int, study: int
) -> list[np.random.Generator]:
    """Return random generators for the motion, the mount, the parent and the child of a recording.

    ``study`` is a number that no other study has.
    """
    key = (seed, sorted(PLATFORMS).index(platform), study)
    return np.random.default_rng(key).spawn(4)


class Platform(NamedTuple):
    """A machine with an odometry, and an antenna beside it.

    Attributes
    ----------
    motion : callable
        ``motion(generator, duration_s)``.
    odometry : SensorErrors
    rate_hz : float
        Rate of the odometry, Hz.
    duration_s : float
    lever_m : float
        Size of the lever arm, m.
    noise_m : float
        Standard deviation of the noise of positions, m.
    positions_hz : float
        Rate of the positions, Hz.
    """

    motion: Callable[[np.random.Generator, float], motions.Motion]
    odometry: SensorErrors
    rate_hz: float
    duration_s: float
    lever_m: float
    noise_m: float
    positions_hz: float

    def measured(
        self, motion: motions.Motion, random: np.random.Generator
    ) -> Trajectory:
        """Return the poses of the odometry along a motion."""
        step_s = 1 / self.rate_hz
        n_poses = round(self.duration_s * self.rate_hz)
        times_s: FloatArray = np.arange(n_poses) / self.rate_hz
        poses = motion.at(times_s)
        twists = motion.twists(times_s)
        drawn = draw(self.odometry, poses, twists, step_s, random)
        return Trajectory(stamps_ns(times_s), drawn.poses, "lidar", "odom")


PLATFORMS = {
    "car": Platform(
        motion=motions.car,
        odometry=LIDAR_ODOMETRY,
        rate_hz=10.0,
        duration_s=240.0,
        lever_m=2.0,
        noise_m=0.01,
        positions_hz=10.0,
    ),
    "excavator": Platform(
        motion=motions.excavator,
        odometry=LIDAR_ODOMETRY,
        rate_hz=10.0,
        duration_s=240.0,
        lever_m=2.0,
        noise_m=0.01,
        positions_hz=5.0,
    ),
    "hand": Platform(
        motion=motions.hand_held,
        odometry=VIO,
        rate_hz=30.0,
        duration_s=90.0,
        lever_m=0.3,
        noise_m=0.003,
        positions_hz=20.0,
    ),
    "drone": Platform(
        motion=motions.drone,
        odometry=VIO,
        rate_hz=20.0,
        duration_s=120.0,
        lever_m=0.3,
        noise_m=0.01,
        positions_hz=10.0,
    ),
    "drone_slam": Platform(
        motion=motions.drone,
        odometry=slam(10.0, 0.05, 0.1),
        rate_hz=20.0,
        duration_s=120.0,
        lever_m=0.5,
        noise_m=0.005,
        positions_hz=20.0,
    ),
    "agv": Platform(
        motion=motions.agv,
        odometry=_WHEELS,
        rate_hz=10.0,
        duration_s=240.0,
        lever_m=0.8,
        noise_m=0.005,
        positions_hz=10.0,
    ),
}

# Targets that a person would set for poses (m and deg).
TARGETS = {
    "car": (0.15, 1.0),
    "excavator": (0.05, 1.0),
    "hand": (0.01, 0.5),
    "drone": (0.05, 0.5),
    "drone_slam": (0.05, 0.5),
    "agv": (0.05, 1.0),
}
