"""Ten more faults, built when the checks had been done with all others, and not tuned on."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from reproduction.fault_cases import Fault, Streams, low_passed_values, uprighted, with_poses

# Time between two world jumps (s).
_BETWEEN_JUMPS_S = 20.0

# Time between the stamps of poses that arrive together (s).
_TOGETHER_S = 0.001


def interpolated(parent: Trajectory, child: Trajectory, factor: float, random: Any) -> Streams:
    """A child of so many times less poses, filled up to its full rate by interpolation."""
    few = child[:: int(factor)]
    inside = child.stamps_ns <= few.stamps_ns[-1]
    return parent, Trajectory(child.stamps_ns[inside], few.at(child.stamps_ns[inside]))


def mirrored_world(parent: Trajectory, child: Trajectory, axis: float, random: Any) -> Streams:
    """Positions and orientations of the child as in left-handed axes: one axis is mirrored."""
    mirror = np.eye(4)
    mirror[int(axis), int(axis)] = -1.0
    return parent, Trajectory(child.stamps_ns, mirror @ child.poses @ mirror)


def stuck(parent: Trajectory, child: Trajectory, seconds: float, random: Any) -> Streams:
    """The child repeats one pose for a while, half-way, and goes on where it is then."""
    first = len(child) // 2
    is_stuck = (child.stamps_ns >= child.stamps_ns[first]) & (
        child.stamps_ns < child.stamps_ns[first] + seconds * 1e9
    )
    poses = child.poses.copy()
    poses[is_stuck] = poses[first]
    return parent, dataclasses.replace(child, poses=poses)


def few_digits(parent: Trajectory, child: Trajectory, digits: float, random: Any) -> Streams:
    """Quaternions and positions of the child are written with few digits."""
    step = 10.0 ** -int(digits)
    quats = np.round(se3.to_quat_xyzw(child.poses) / step) * step
    positions = np.round(child.poses[:, :3, 3] / step) * step
    return parent, Trajectory(child.stamps_ns, se3.from_quat_xyzw(positions, quats))


def relocalised(parent: Trajectory, child: Trajectory, metres: float, random: Any) -> Streams:
    """Every 20 s the child's world jumps by so much, and by as many tenths of a radian."""
    elapsed_s = (child.stamps_ns - child.stamps_ns[0]) * 1e-9
    poses = child.poses.copy()
    for start_s in np.arange(_BETWEEN_JUMPS_S, elapsed_s[-1], _BETWEEN_JUMPS_S):
        sizes = metres * np.repeat([1.0, 0.1], 3)
        later = elapsed_s >= start_s
        poses[later] = se3.exp(sizes * random.standard_normal(6)) @ poses[later]
    return parent, dataclasses.replace(child, poses=poses)


def republished(parent: Trajectory, child: Trajectory, late_s: float, random: Any) -> Streams:
    """Each pose of the child comes again so much later, with a stamp of its own."""
    stamps_ns = np.concatenate([child.stamps_ns, child.stamps_ns + round(late_s * 1e9)])
    stamps_ns, first = np.unique(stamps_ns, return_index=True)
    return parent, Trajectory(stamps_ns, np.concatenate([child.poses, child.poses])[first])


def fast_clock(parent: Trajectory, child: Trajectory, ppm: float, random: Any) -> Streams:
    """The child's clock is right half-way, and fast by so many parts in a million."""
    from_middle = child.stamps_ns - child.stamps_ns[len(child) // 2]
    return parent, Trajectory(
        child.stamps_ns + np.round(1e-6 * ppm * from_middle).astype(np.int64), child.poses
    )


def without_heights(parent: Trajectory, child: Trajectory, which: float, random: Any) -> Streams:
    """Heights are always zero: the parent's, those of both, and both upright besides."""
    flat = [
        with_poses(stream, positions=stream.poses[:, :3, 3] * [1, 1, 0])
        for stream in (parent, child)
    ]
    if which == 0.0:
        return flat[0], child
    if which == 1.0:
        return flat[0], flat[1]
    return uprighted(flat[0]), uprighted(flat[1])


def slow_heading(parent: Trajectory, child: Trajectory, tau_s: float, random: Any) -> Streams:
    """The child's yaw alone is low-passed."""
    angles = Rotation.from_matrix(child.poses[:, :3, :3]).as_euler("ZYX")
    yaw = np.unwrap(angles[:, 0])
    angles[:, 0] = low_passed_values(yaw[:, None], child.stamps_ns, tau_s)[:, 0]
    return parent, with_poses(child, Rotation.from_euler("ZYX", angles).as_matrix())


def in_bursts(parent: Trajectory, child: Trajectory, seconds: float, random: Any) -> Streams:
    """The child's poses are held back, come together, and have stamps of when they came."""
    elapsed_ns = child.stamps_ns - child.stamps_ns[0]
    interval_ns = round(seconds * 1e9)
    bursts = elapsed_ns // interval_ns
    firsts = np.searchsorted(bursts, bursts)
    order = np.arange(len(child)) - firsts
    came_ns = (bursts + 1) * interval_ns + np.round(order * _TOGETHER_S * 1e9).astype(np.int64)
    stamps_ns, first = np.unique(child.stamps_ns[0] + came_ns, return_index=True)
    return parent, Trajectory(stamps_ns, child.poses[first])


_ANY = frozenset({"*"})

LAST = (
    Fault("W1", "filled up by interpolation", (2.0, 4.0, 8.0), interpolated, "times", _ANY),
    Fault("W2", "left-handed axes", (0.0, 1.0, 2.0), mirrored_world, "(axis)", _ANY),
    Fault("W3", "stuck half-way", (2.0, 5.0, 15.0), stuck, "s", _ANY),
    Fault("W4", "few digits", (3.0, 2.0, 1.0), few_digits, "digits", _ANY),
    Fault("W5", "relocalised every 20 s", (0.1, 0.5, 2.0), relocalised, "m", _ANY),
    Fault("W6", "published again", (0.005, 0.02, 0.05), republished, "s later", _ANY),
    Fault("W7", "clock too fast", (100.0, 1000.0, 5000.0), fast_clock, "ppm", _ANY),
    Fault("W8", "heights zero", (0.0, 1.0, 2.0), without_heights, "(which)", _ANY),
    Fault("W9", "heading low-passed", (0.05, 0.1, 0.3), slow_heading, "s", _ANY),
    Fault("W10", "stamps of arrival, in bursts", (0.1, 0.3, 1.0), in_bursts, "s", _ANY),
)
