"""Drives for the benchmarks: the two KITTI drives of Valimaki et al. 2023 if their files are
present, and simulated drives of any length.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import PosePairs, motion_pairs
from reproduction.published import load_kitti_long, load_kitti_short

REFERENCE = "B5"
# Numbers of motion pairs of reference B5 in the KITTI drives, which have 448 and 2,343 common
# poses.
SHORT = 443
LONG = 2338
# Number of messages of both streams together.
MESSAGES = 40_000
STREAMS = ("parent", "child")
START_NS = 1_700_000_000_000_000_000
T_PARENT_CHILD = se3.exp(np.array([0.3, -0.1, 0.2, 0.3, -0.5, 1.2]))

# Number of poses that are simulated at a time, to save memory.
_POSES_AT_A_TIME = 100_000
# Interval of the poses of a drive (ns).
_PERIOD_NS = 100_000_000
# Noise of the poses of a drive (m, rad).
_SIGMA = np.repeat([0.01, 0.002], 3)
# Noise of the poses of messages (m, rad). The motion of a pair of B5 at 400 Hz lasts 12 ms, and is
# so small that a centimetre of noise would hide it.
_SIGMA_OF_MESSAGES = np.repeat([2e-5, 5e-6], 3)


@dataclass(frozen=True)
class Drive:
    """Synchronised poses, their motion pairs and the true extrinsic."""

    poses: PosePairs
    T_parent_child: np.ndarray

    @property
    def pairs(self):
        """Motion pairs of reference B5."""
        return motion_pairs(self.poses.Ts_pw_p, self.poses.Ts_cw_c, REFERENCE)

    def trajectories(self):
        """Return the trajectories of parent and child."""
        stamps_ns = self.poses.stamps_ns
        return Trajectory(stamps_ns, self.poses.Ts_pw_p), Trajectory(
            stamps_ns, self.poses.Ts_cw_c
        )


def drives(sizes):
    """Return the source of the short and long drive, and a Drive by number of pairs."""
    drive_of_size = {n_pairs: simulated_drive(n_pairs + 5) for n_pairs in sizes}
    shared = Path(__file__).resolve().parents[3] / "shared" / "data"
    folder = (
        Path(os.environ.get("HAND_EYE_CALIB_DATA", shared)) / "valimaki2023"
    )
    try:
        cases = {SHORT: load_kitti_short(folder), LONG: load_kitti_long(folder)}
    except InputError:
        return "simulated", drive_of_size
    for size, case in cases.items():
        poses = PosePairs(
            case.parent.stamps_ns, case.parent.poses, case.child.poses
        )
        drive_of_size[size] = Drive(poses, case.T_parent_child)
    return "published", drive_of_size


def messages(first, count, rate_hz):
    """Return trajectories of both sensors with noise, in a smooth motion about all axes.

    The trajectories contain the poses with numbers from ``first`` to ``first + count``.
    """
    numbers = first + np.arange(count)
    s = numbers / rate_hz
    turns = np.stack(
        [
            0.3 * np.sin(0.7 * s),
            0.2 * np.sin(0.9 * s + 1.0),
            1.2 * np.sin(0.1 * s),
        ],
        axis=1,
    )
    places = np.stack(
        [20 * np.sin(0.05 * s), 20 * np.sin(0.07 * s), 0.5 * np.cos(0.8 * s)],
        axis=1,
    )
    Ts_pw_p = se3.from_rotation_translation(se3.rotation_exp(turns), places)
    noise = (
        np.random.default_rng(first).normal(size=(2, count, 6))
        * _SIGMA_OF_MESSAGES
    )
    stamps_ns = START_NS + numbers * round(1e9 / rate_hz)
    return (
        Trajectory(
            stamps_ns, Ts_pw_p @ se3.exp(noise[0]), "parent_sensor", "world"
        ),
        Trajectory(
            stamps_ns,
            Ts_pw_p @ T_PARENT_CHILD @ se3.exp(noise[1]),
            "child_sensor",
            "world",
        ),
    )


def parts(first, count, rate_hz):
    """Return the fields of messages by stream: lists of stamps (ns), positions and quaternions."""
    trajectories = messages(first, count, rate_hz)
    fields = {}
    for stream, trajectory in zip(STREAMS, trajectories, strict=True):
        fields[stream] = (
            trajectory.stamps_ns.tolist(),
            trajectory.poses[:, :3, 3].tolist(),
            se3.to_quat_xyzw(trajectory.poses).tolist(),
        )
    return fields


def simulated_drive(n_poses, seed=0):
    """Simulate a road vehicle's smooth motion with noise on both sensors.

    The child jumps at 2 % of the poses.
    """
    stamps_ns = _PERIOD_NS * np.arange(n_poses)
    Ts_pw_p, Ts_cw_c = np.empty((2, n_poses, 4, 4))
    random = np.random.default_rng(seed)
    place = np.zeros(3)
    shift = np.zeros(3)
    for first in range(0, n_poses, _POSES_AT_A_TIME):
        part = slice(first, first + _POSES_AT_A_TIME)
        s = stamps_ns[part] * 1e-9
        yaw = 1.5 * np.sin(0.11 * s)
        roll = 0.05 * np.sin(0.7 * s)
        pitch = 0.06 * np.sin(1.1 * s)
        about_z = np.stack(
            [np.zeros_like(yaw), np.zeros_like(yaw), yaw], axis=1
        )
        rotations = se3.rotation_exp(about_z) @ se3.rotation_exp(
            np.stack([roll, pitch, np.zeros_like(yaw)], axis=1)
        )
        places = place + np.cumsum(rotations[:, :, 0], axis=0)
        jumps = (
            random.normal(size=places.shape)
            * 0.5
            * (random.random((len(places), 1)) < 0.02)
        )
        shifts = shift + np.cumsum(jumps, axis=0)
        place = places[-1]
        shift = shifts[-1]
        Ts = se3.from_rotation_translation(rotations, places)
        noise = se3.exp(random.normal(size=(2, len(Ts), 6)) * _SIGMA)
        Ts_pw_p[part] = Ts @ noise[0]
        Ts_cw_c[part] = (
            se3.inverse(T_PARENT_CHILD) @ Ts @ T_PARENT_CHILD @ noise[1]
        )
        Ts_cw_c[part, :3, 3] += shifts
    return Drive(PosePairs(stamps_ns, Ts_pw_p, Ts_cw_c), T_PARENT_CHILD)
