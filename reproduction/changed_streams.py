"""Changes of the poses of a stream: filter, delay, rotation, noise. Faults are made of them."""

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory

Random = np.random.Generator


def with_parts(
    stream: Trajectory,
    rotations: FloatArray | None = None,
    positions: FloatArray | None = None,
) -> Trajectory:
    """Return the stream with these orientations (N, 3, 3) or positions (N, 3)."""
    poses = stream.poses.copy()
    if rotations is not None:
        poses[:, :3, :3] = rotations
    if positions is not None:
        poses[:, :3, 3] = positions
    return posed(stream, poses)


def posed(stream: Trajectory, poses: FloatArray) -> Trajectory:
    return dataclasses.replace(stream, poses=poses)


def moved_at(
    stream: Trajectory, where: Any, transforms: FloatArray
) -> Trajectory:
    """Multiply the poses with index ``where`` by transforms from the right."""
    poses = stream.poses.copy()
    poses[where] = poses[where] @ transforms
    return posed(stream, poses)


def positions_of(stream: Trajectory) -> FloatArray:
    return se3.translation_of(stream.poses)


def angles_of(stream: Trajectory) -> FloatArray:
    """Return yaw, pitch and roll (N, 3), rad."""
    rotations = Rotation.from_matrix(se3.rotation_of(stream.poses))
    return rotations.as_euler("ZYX")


def turned(stream: Trajectory, angles: FloatArray) -> Trajectory:
    """Return the stream with these angles (N, 3): yaw, pitch and roll, rad."""
    rotations = Rotation.from_euler("ZYX", angles)
    return with_parts(stream, rotations.as_matrix())


def with_quats(stream: Trajectory, quats: FloatArray) -> Trajectory:
    poses = se3.from_quat_xyzw(positions_of(stream), quats)
    return Trajectory(stream.stamps_ns, poses)


def at_stamps(stamps_ns: Any, poses: FloatArray) -> Trajectory:
    """Sort poses by their stamps; of poses with equal stamps, keep the first."""
    whole_ns = np.asarray(stamps_ns).astype(np.int64)
    stamps_ns, first = np.unique(whole_ns, return_index=True)
    return Trajectory(stamps_ns, poses[first])


def seconds_of(stream: Trajectory) -> FloatArray:
    """Return the times (N,) since the first pose, s."""
    since_ns = stream.stamps_ns - stream.stamps_ns[0]
    return since_ns * 1e-9


def noisy(stream: Trajectory, metres: float, random: Random) -> Trajectory:
    """Add white noise of ``metres``, and of twice this number of radians."""
    xi = metres * random.standard_normal((len(stream), 6))
    xi[:, 3:] *= 2.0
    return posed(stream, stream.poses @ se3.exp(xi))


def filtered(values: FloatArray, stamps_ns: Any, tau_s: float) -> FloatArray:
    """Apply a first-order low-pass filter with the time constant ``tau_s`` to values (N, ...)."""
    intervals_s = np.diff(stamps_ns) * 1e-9
    gains = 1.0 - np.exp(-intervals_s / tau_s)
    out = values.copy()
    for k, gain in enumerate(gains):
        change = values[k + 1] - out[k]
        out[k + 1] = out[k] + gain * change
    return out


def filtered_positions(stream: Trajectory, tau_s: float) -> FloatArray:
    return filtered(positions_of(stream), stream.stamps_ns, tau_s)


def filtered_rotations(stream: Trajectory, tau_s: float) -> FloatArray:
    intervals_s = np.diff(stream.stamps_ns) * 1e-9
    gains = 1.0 - np.exp(-intervals_s / tau_s)
    measured = se3.rotation_of(stream.poses)
    rotations = measured.copy()
    for k, gain in enumerate(gains):
        change = rotations[k].T @ measured[k + 1]
        step = gain * se3.rotation_log(change)
        rotations[k + 1] = rotations[k] @ se3.rotation_exp(step)
    return rotations


def upright(stream: Trajectory, share: float = 1.0) -> Trajectory:
    """Reduce roll and pitch by a share of their values; with 1, the stream is level."""
    remaining = 1.0 - share
    angles = angles_of(stream) * [1.0, remaining, remaining]
    return turned(stream, angles)


def higher(stream: Trajectory, factor: float) -> Trajectory:
    """Multiply the heights of a stream."""
    positions = positions_of(stream) * [1.0, 1.0, factor]
    return with_parts(stream, positions=positions)


def delayed(stream: Trajectory, delay_s: float) -> FloatArray:
    """Return the poses (N, 4, 4) at a time ``delay_s`` before each stamp."""
    later = stream.shifted(delay_s)
    return later.at(stream.stamps_ns, extrapolate=True)


def beside(metres: float) -> FloatArray:
    """Return the pose of another sensor that is shifted along the child's x axis."""
    translation = [metres, 0.0, 0.0]
    return se3.from_rotation_translation(np.eye(3), translation)
