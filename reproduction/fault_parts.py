"""What faults are made of: their record, and parts of a stream."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory

Streams = tuple[Trajectory, Trajectory]
Random = np.random.Generator
_OfBoth = Callable[[Trajectory, Trajectory, float, Random], Streams]
_OfChild = Callable[[Trajectory, float, Random], Trajectory]


@dataclass(frozen=True)
class Fault:
    """A fault: its code in the list of faults, and what is wrong in words."""

    code: str
    what: str
    # The weakest first; one if it has no degrees.
    severities: tuple[float, ...]
    # Damages (parent, child, severity, generator).
    damage: _OfBoth
    # Of the severities.
    unit: str = ""
    # Codes of findings that name it.
    named: frozenset[str] = frozenset({"*"})
    # Of the calibration, besides its method.
    options: dict[str, Any] = field(default_factory=dict)


def of_both(
    group: list[Fault],
    code: str,
    what: str,
    severities: tuple[float, ...],
    unit: str = "",
    named: str = "*",
    options: dict[str, Any] | None = None,
) -> Callable[[_OfBoth], _OfBoth]:
    """Add a fault of both streams to a group; ``named`` holds the codes, a space between them."""

    def add(damage: _OfBoth) -> _OfBoth:
        codes = frozenset(named.split())
        group.append(Fault(code, what, severities, damage, unit, codes, options or {}))
        return damage

    return add


def of_child(*about: Any, **more: Any) -> Callable[[_OfChild], _OfChild]:
    """The same for a fault of the child's stream alone."""

    def add(damage: _OfChild) -> _OfChild:
        of_both(*about, **more)(
            lambda parent, child, value, random: (parent, damage(child, value, random))
        )
        return damage

    return add


# ------------------------------------------------------------------ parts of a stream


def with_parts(
    stream: Trajectory, rotations: FloatArray | None = None, positions: FloatArray | None = None
) -> Trajectory:
    """The stream with other orientations (N, 3, 3) or positions (N, 3)."""
    poses = stream.poses.copy()
    if rotations is not None:
        poses[:, :3, :3] = rotations
    if positions is not None:
        poses[:, :3, 3] = positions
    return dataclasses.replace(stream, poses=poses)


def positions_of(stream: Trajectory) -> FloatArray:
    """Positions (N, 3)."""
    return stream.poses[:, :3, 3]


def angles_of(stream: Trajectory) -> FloatArray:
    """Yaw, pitch and roll (N, 3), rad."""
    return Rotation.from_matrix(stream.poses[:, :3, :3]).as_euler("ZYX")


def from_angles(angles: FloatArray) -> FloatArray:
    """Rotations (N, 3, 3) of yaw, pitch and roll."""
    return Rotation.from_euler("ZYX", angles).as_matrix()


def with_quats(stream: Trajectory, quats: FloatArray) -> Trajectory:
    """The stream with other quaternions (N, 4), xyzw."""
    return Trajectory(stream.stamps_ns, se3.from_quat_xyzw(positions_of(stream), quats))


def at_stamps(stamps_ns: Any, poses: FloatArray) -> Trajectory:
    """Poses in the order of their stamps; of equal ones the first."""
    stamps_ns, first = np.unique(np.asarray(stamps_ns).astype(np.int64), return_index=True)
    return Trajectory(stamps_ns, poses[first])


def seconds_of(stream: Trajectory) -> FloatArray:
    """Times (N,) since the first pose, s."""
    return (stream.stamps_ns - stream.stamps_ns[0]) * 1e-9


def noisy(poses: FloatArray, metres: float, random: Random) -> FloatArray:
    """Poses with white noise, as many metres as half radians."""
    xi = metres * random.standard_normal((len(poses), 6))
    xi[:, 3:] *= 2.0
    return poses @ se3.exp(xi)


def _shares(stamps_ns: IntArray, tau_s: float) -> FloatArray:
    """Of the way to its input that a first-order low-pass filter goes in each step."""
    return 1.0 - np.exp(-np.diff(stamps_ns) * 1e-9 / tau_s)


def filtered(values: FloatArray, stamps_ns: IntArray, tau_s: float) -> FloatArray:
    """Values (N, ...) after a first-order low-pass filter."""
    out = values.copy()
    for k, share in enumerate(_shares(stamps_ns, tau_s)):
        out[k + 1] = out[k] + share * (values[k + 1] - out[k])
    return out


def filtered_positions(stream: Trajectory, tau_s: float) -> FloatArray:
    """Positions (N, 3) after the filter."""
    return filtered(positions_of(stream), stream.stamps_ns, tau_s)


def filtered_rotations(stream: Trajectory, tau_s: float) -> FloatArray:
    """Rotations (N, 3, 3) after the filter."""
    rotations = stream.poses[:, :3, :3].copy()
    for k, share in enumerate(_shares(stream.stamps_ns, tau_s)):
        step = se3.rotation_log(rotations[k].T @ stream.poses[k + 1, :3, :3])
        rotations[k + 1] = rotations[k] @ se3.rotation_exp(share * step)
    return rotations


def upright(stream: Trajectory, share: float = 1.0) -> Trajectory:
    """A stream with a share less of roll and pitch."""
    return with_parts(stream, from_angles(angles_of(stream) * [1.0, 1.0 - share, 1.0 - share]))
