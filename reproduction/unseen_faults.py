"""Faults that were built when the checks had been done with all others, and that no limit was set
with.
"""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from reproduction.fault_cases import late_positions, low_passed
from reproduction.fault_parts import (
    Fault,
    Random,
    Streams,
    angles_of,
    at_stamps,
    filtered,
    from_angles,
    of_both,
    of_child,
    positions_of,
    seconds_of,
    upright,
    with_parts,
)

UNSEEN: list[Fault] = []
# When all was done.
LAST: list[Fault] = []

# Time between two world jumps, and between the stamps of poses that arrive together (s).
_BETWEEN_JUMPS_S, _TOGETHER_S = 20.0, 0.001

# ------------------------------------------------------------------ built after those


@of_both(UNSEEN, "V1", "parent's positions late", (0.02, 0.05, 0.1), "s")
def _parent_late(parent: Trajectory, child: Trajectory, s: float, random: Random) -> Streams:
    return late_positions(parent, s, random), child


@of_child(UNSEEN, "V2", "child's orientations late", (0.02, 0.05, 0.1), "s")
def _late_orientations(child: Trajectory, delay_s: float, random: Random) -> Trajectory:
    late = child.shifted(delay_s).at(child.stamps_ns, extrapolate=True)
    return with_parts(child, late[:, :3, :3])


@of_child(UNSEEN, "V3", "heights off by a factor", (0.02, 0.1, 0.5))
def _height_gain(child: Trajectory, gain: float, random: Random) -> Trajectory:
    """As of a barometer."""
    return with_parts(child, positions=positions_of(child) * [1.0, 1.0, 1.0 + gain])


@of_child(UNSEEN, "V4", "heading drifts", (1.0, 5.0, 20.0), "deg/min")
def _heading_drift(child: Trajectory, degrees: float, random: Random) -> Trajectory:
    minutes = (child.stamps_ns - child.stamps_ns[0]) / 60e9
    worlds = np.tile(np.eye(4), (len(child), 1, 1))
    worlds[:, :3, :3] = se3.rotation_exp(np.outer(np.radians(degrees) * minutes, [0.0, 0.0, 1.0]))
    return dataclasses.replace(child, poses=worlds @ child.poses)


@of_child(UNSEEN, "V5", "positions flat", (0.2, 0.5, 1.0), "share")
def _flat_positions(child: Trajectory, share: float, random: Random) -> Trajectory:
    return _height_gain(child, -share, random)


@of_child(UNSEEN, "V6", "stamps scatter", (0.005, 0.02, 0.05), "s")
def _jittered(child: Trajectory, sigma_s: float, random: Random) -> Trajectory:
    jitter_ns = np.round(1e9 * sigma_s * random.standard_normal(len(child)))
    return at_stamps(child.stamps_ns + jitter_ns, child.poses)


@of_child(UNSEEN, "V7", "every second stamp late", (0.01, 0.02, 0.04), "s")
def _every_second_late(child: Trajectory, late_s: float, random: Random) -> Trajectory:
    stamps_ns = child.stamps_ns.copy()
    stamps_ns[1::2] += round(late_s * 1e9)
    return at_stamps(stamps_ns, child.poses)


@of_child(UNSEEN, "V8", "child swings on its mount", (0.2, 1.0, 5.0), "deg")
def _swinging(child: Trajectory, degrees: float, random: Random) -> Trajectory:
    """About one axis, once in seven seconds."""
    angles = np.radians(degrees) * np.sin(2 * np.pi * seconds_of(child) / 7.0)
    swing = se3.rotation_exp(np.outer(angles, [0.0, 1.0, 0.0]))
    return with_parts(child, child.poses[:, :3, :3] @ swing)


@of_child(UNSEEN, "V9", "angles in whole steps", (0.2, 1.0, 5.0), "deg")
def _coarse_angles(child: Trajectory, degrees: float, random: Random) -> Trajectory:
    angles = Rotation.from_matrix(child.poses[:, :3, :3]).as_euler("ZYX", degrees=True)
    angles = np.round(angles / degrees) * degrees
    return with_parts(child, Rotation.from_euler("ZYX", angles, degrees=True).as_matrix())


@of_both(UNSEEN, "V10", "both streams' positions low-passed", (0.05, 0.1, 0.2), "s")
def _both_low_passed(
    parent: Trajectory, child: Trajectory, tau_s: float, random: Random
) -> Streams:
    return low_passed(parent, tau_s, random), low_passed(child, tau_s, random)


# ------------------------------------------------------------------ built when all was done


@of_child(LAST, "W1", "filled up by interpolation", (2.0, 4.0, 8.0), "times")
def _interpolated(child: Trajectory, factor: float, random: Random) -> Trajectory:
    """A child of so many times less poses."""
    few = child[:: int(factor)]
    inside = child.stamps_ns <= few.stamps_ns[-1]
    return Trajectory(child.stamps_ns[inside], few.at(child.stamps_ns[inside]))


@of_child(LAST, "W2", "left-handed axes", (0.0, 1.0, 2.0), "(axis)")
def _mirrored_world(child: Trajectory, axis: float, random: Random) -> Trajectory:
    mirror = np.eye(4)
    mirror[int(axis), int(axis)] = -1.0
    return Trajectory(child.stamps_ns, mirror @ child.poses @ mirror)


@of_child(LAST, "W3", "stuck half-way", (2.0, 5.0, 15.0), "s")
def _stuck(child: Trajectory, seconds: float, random: Random) -> Trajectory:
    """It goes on where it is then."""
    first = len(child) // 2
    since_ns = child.stamps_ns - child.stamps_ns[first]
    poses = child.poses.copy()
    poses[(since_ns >= 0) & (since_ns < seconds * 1e9)] = poses[first]
    return dataclasses.replace(child, poses=poses)


@of_child(LAST, "W4", "few digits", (3.0, 2.0, 1.0), "digits")
def _few_digits(child: Trajectory, digits: float, random: Random) -> Trajectory:
    step = 10.0 ** -int(digits)
    quats = np.round(se3.to_quat_xyzw(child.poses) / step) * step
    positions = np.round(positions_of(child) / step) * step
    return Trajectory(child.stamps_ns, se3.from_quat_xyzw(positions, quats))


@of_child(LAST, "W5", "relocalised every 20 s", (0.1, 0.5, 2.0), "m")
def _relocalised(child: Trajectory, metres: float, random: Random) -> Trajectory:
    """The child's world jumps by so much, and by as many tenths of a radian."""
    elapsed_s = seconds_of(child)
    poses = child.poses.copy()
    for start_s in np.arange(_BETWEEN_JUMPS_S, elapsed_s[-1], _BETWEEN_JUMPS_S):
        sizes = metres * np.repeat([1.0, 0.1], 3)
        later = elapsed_s >= start_s
        poses[later] = se3.exp(sizes * random.standard_normal(6)) @ poses[later]
    return dataclasses.replace(child, poses=poses)


@of_child(LAST, "W6", "published again", (0.005, 0.02, 0.05), "s later")
def _republished(child: Trajectory, late_s: float, random: Random) -> Trajectory:
    stamps_ns = np.concatenate([child.stamps_ns, child.stamps_ns + round(late_s * 1e9)])
    return at_stamps(stamps_ns, np.concatenate([child.poses, child.poses]))


@of_child(LAST, "W7", "clock too fast", (100.0, 1000.0, 5000.0), "ppm")
def _fast_clock(child: Trajectory, ppm: float, random: Random) -> Trajectory:
    """It is right half-way."""
    from_middle = child.stamps_ns - child.stamps_ns[len(child) // 2]
    late_ns = np.round(1e-6 * ppm * from_middle).astype(np.int64)
    return Trajectory(child.stamps_ns + late_ns, child.poses)


@of_both(LAST, "W8", "heights zero", (0.0, 1.0, 2.0), "(which)")
def _without_heights(
    parent: Trajectory, child: Trajectory, which: float, random: Random
) -> Streams:
    """The parent's, those of both, and both upright besides."""
    flat = [
        with_parts(stream, positions=positions_of(stream) * [1, 1, 0]) for stream in (parent, child)
    ]
    if which == 0.0:
        return flat[0], child
    return (flat[0], flat[1]) if which == 1.0 else (upright(flat[0]), upright(flat[1]))


@of_child(LAST, "W9", "heading low-passed", (0.05, 0.1, 0.3), "s")
def _slow_heading(child: Trajectory, tau_s: float, random: Random) -> Trajectory:
    angles = angles_of(child)
    angles[:, 0] = filtered(np.unwrap(angles[:, 0]), child.stamps_ns, tau_s)
    return with_parts(child, from_angles(angles))


@of_child(LAST, "W10", "stamps of arrival, in bursts", (0.1, 0.3, 1.0), "s")
def _in_bursts(child: Trajectory, seconds: float, random: Random) -> Trajectory:
    """The poses are held back, come together, and have stamps of when they came."""
    interval_ns = round(seconds * 1e9)
    bursts = (child.stamps_ns - child.stamps_ns[0]) // interval_ns
    order = np.arange(len(child)) - np.searchsorted(bursts, bursts)
    came_ns = (bursts + 1) * interval_ns + np.round(order * _TOGETHER_S * 1e9).astype(np.int64)
    return at_stamps(child.stamps_ns[0] + came_ns, child.poses)
