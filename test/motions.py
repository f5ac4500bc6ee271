"""Synthetic motion with a known answer, for tests that need poses rather than a vehicle."""

from itertools import accumulate
from pathlib import Path

import numpy as np

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.geodetic import LocalOrigin
from hand_eye_calib.formats.trajectory_files.file_options import FileOptions
from hand_eye_calib.formats.trajectory_files.reading import (
    read_trajectory_files,
)
from hand_eye_calib.formats.trajectory_files.writing import write_trajectory

T_PARENT_CHILD = se3.exp(np.array([0.4, -0.2, 0.7, 0.3, -1.2, 0.6]))


_HOME = np.eye(4)


def walked(steps, first=_HOME):
    """(N + 1, 4, 4) poses that follow the first one by N steps."""
    poses = accumulate([first, *steps], np.matmul)
    return np.array(list(poses))


def wandering_poses(n_poses, seed=0, step_m=0.1, step_rad=0.08):
    """(N, 4, 4) poses of a random walk in six degrees of freedom, smooth over about ten poses."""
    random = np.random.default_rng(seed)
    kernel = np.ones(10) / np.sqrt(10)
    white = random.normal(size=(n_poses + 9, 6))
    steps = np.apply_along_axis(np.convolve, 0, white, kernel, mode="valid")
    steps *= np.repeat([step_m, step_rad], 3)
    return walked(se3.exp(steps[1:]))


def planar_poses(n_poses, seed=0):
    """(N, 4, 4) poses of a vehicle on flat ground: x, y and yaw only."""
    random = np.random.default_rng(seed)
    yaw = np.cumsum(random.normal(0, 0.08, n_poses))
    zero = np.zeros(n_poses)
    forward = np.c_[np.cos(yaw), np.sin(yaw), zero]
    positions = np.cumsum(0.1 * forward, axis=0)
    rotations = se3.rotation_exp(np.c_[zero, zero, yaw])
    return se3.from_rotation_translation(rotations, positions)


def child_of(Ts_pw_p, T_parent_child=T_PARENT_CHILD, T_cw_pw=None):
    """Noise-free poses of the child sensor in a world of its own."""
    T_cw_pw = (
        se3.exp(np.array([3.0, -2.0, 1.0, 0.5, 0.2, -2.0]))
        if T_cw_pw is None
        else T_cw_pw
    )
    return T_cw_pw @ Ts_pw_p @ T_parent_child


def disturbed(poses, seed, sigma_m, sigma_rad):
    """Poses with white noise in their own frames."""
    random = np.random.default_rng(seed)
    sigmas = np.repeat([sigma_m, sigma_rad], 3)
    noise = random.normal(size=(len(poses), 6)) * sigmas
    return poses @ se3.exp(noise)


def smooth_poses(times_s):
    """(N, 4, 4) poses on a smooth curve in all six degrees of freedom."""
    k = np.arange(1, 7)
    frequencies = 0.5 + 0.15 * k
    amplitudes = np.repeat([3.0, 0.8], 3)
    phases = times_s[:, None] * frequencies + k
    return se3.exp(np.sin(phases) * amplitudes)


def as_trajectory(
    poses, rate_hz=10.0, start_ns=1_700_000_000_000_000_000, **frames
):
    """Poses at a steady rate."""
    return Trajectory(
        start_ns
        + np.round(np.arange(len(poses)) * 1e9 / rate_hz).astype(np.int64),
        poses,
        **frames,
    )


def noisy_pair(poses, seed, *noise, rate_hz=10.0, mount=T_PARENT_CHILD):
    """Both trajectories, each with white noise (m, rad) of its own."""
    both = enumerate((poses, child_of(poses, mount)), start=seed)
    return [
        as_trajectory(disturbed(poses, own, *noise), rate_hz)
        for own, poses in both
    ]


def write_pair(folder, parent, child):
    """Paths of two text files with the trajectories."""
    parent_path = str(folder / "parent.tum")
    child_path = str(folder / "child.tum")
    write_trajectory(parent_path, parent)
    write_trajectory(child_path, child)
    return [parent_path, child_path]


def messages(stream, trajectory):
    """What the engine is given for each pose."""
    stamps_ns = trajectory.stamps_ns.tolist()
    positions = trajectory.poses[:, :3, 3].tolist()
    quats = se3.to_quat_xyzw(trajectory.poses).tolist()
    poses = zip(stamps_ns, positions, quats, strict=True)
    return [(stream, *pose) for pose in poses]


def feed(calibrator, stream, trajectory):
    for message in messages(stream, trajectory):
        calibrator.add_pose(*message)


def geodetic(positions, origin):
    """Latitudes and longitudes (deg) and heights (m) of positions (N, 3) east, north and up of an
    origin (deg, deg, m) within some kilometres: what LocalOrigin gives, the other way round.
    """
    latitude, longitude = np.radians(origin[:2])
    start = np.array([latitude, longitude, origin[2]])
    local_origin = LocalOrigin()
    local_origin.geodetic = latitude, longitude, origin[2]
    # Metres per radian east and north, per metre up.
    scales = np.array([6.37e6 * np.cos(latitude), 6.37e6, 1.0])
    points = np.tile(start, (len(positions), 1))
    # Each round leaves less than a hundredth of the error.
    for _ in range(10):
        missing = (positions - local_origin.local(*points.T)) / scales
        points += missing[:, [1, 0, 2]]
    latitudes, longitudes, heights = points.T
    return np.degrees(latitudes), np.degrees(longitudes), heights


def read_trajectory_file(path, format="tum", **options):
    """A file as the command line reads it: with what was repaired and guessed."""
    return read_trajectory_files(
        [(Path(path), FileOptions(format=format, **options))]
    )[0]
