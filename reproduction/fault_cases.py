"""Faults that give a wrong extrinsic in confidence, made on purpose in two streams, each in three
severities. The limits of the checks were set with :data:`FAULTS`, none with :data:`UNTUNED`.
"""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from reproduction.fault_parts import (
    Fault,
    Random,
    Streams,
    angles_of,
    at_stamps,
    filtered,
    filtered_positions,
    filtered_rotations,
    from_angles,
    noisy,
    of_both,
    of_child,
    positions_of,
    seconds_of,
    upright,
    with_parts,
    with_quats,
)

FAULTS: list[Fault] = []
UNTUNED: list[Fault] = []

# ------------------------------------------------------------------ faults of the list


@of_both(
    FAULTS, "S1", "child is the parent's own frame", (0.01, 0.003, 0.0), "m noise", "same_frame"
)
def _copied(parent: Trajectory, child: Trajectory, noise: float, random: Random) -> Streams:
    world = se3.exp(random.standard_normal(6))
    return parent, Trajectory(parent.stamps_ns, noisy(world @ parent.poses, noise, random))


@of_both(
    FAULTS, "S2", "child positions from the parent", (0.01, 0.003, 0.0), "m noise",
    "same_position same_frame",
)  # fmt: skip
def _fused(parent: Trajectory, child: Trajectory, noise: float, random: Random) -> Streams:
    inside = (child.stamps_ns >= parent.stamps_ns[0]) & (child.stamps_ns <= parent.stamps_ns[-1])
    child = child[inside]
    at_child = parent.at(child.stamps_ns)
    # The child's world in the parent's, from the orientations at the start and a common origin.
    turned = child.poses[0, :3, :3] @ _fitted_rotation(parent, child).T @ at_child[0, :3, :3].T
    positions = (at_child[:, :3, 3] - at_child[0, :3, 3]) @ turned.T
    positions += noise * random.standard_normal(positions.shape)
    return parent, with_parts(child, positions=positions)


def _fitted_rotation(parent: Trajectory, child: Trajectory) -> FloatArray:
    """Rotation X from the rotations of both streams alone."""
    at_child = parent.at(child.stamps_ns)[::10, :3, :3]
    own = child.poses[::10, :3, :3]
    of_parent, of_child = (
        se3.rotation_log(np.swapaxes(poses[:-1], 1, 2) @ poses[1:]) for poses in (at_child, own)
    )
    return Rotation.align_vectors(of_parent, of_child)[0].as_matrix()


def _other(metres: float) -> FloatArray:
    """Pose of another sensor beside the child."""
    return se3.from_rotation_translation(np.eye(3), [metres, 0.0, 0.0])


@of_child(FAULTS, "S3", "two sensors, one world", (0.03, 0.1, 0.3), "m", "interleaved")
def _interleaved(child: Trajectory, metres: float, random: Random) -> Trajectory:
    poses = child.poses.copy()
    poses[1::2] = poses[1::2] @ _other(metres)
    return dataclasses.replace(child, poses=poses)


@of_child(FAULTS, "S3b", "two sensors, two worlds", (0.1, 0.3, 3.0), "m", "interleaved")
def _in_two_worlds(child: Trajectory, metres: float, random: Random) -> Trajectory:
    poses = child.poses.copy()
    poses[1::2] = se3.exp(np.r_[metres, 0, 0, 0, 0, 0.2]) @ poses[1::2] @ _other(metres)
    return dataclasses.replace(child, poses=poses)


_OF_POSITIONS = "smoothed_positions position_clock"


@of_child(FAULTS, "S4", "positions low-passed", (0.05, 0.1, 0.2), "s", _OF_POSITIONS)
def low_passed(child: Trajectory, tau_s: float, random: Random) -> Trajectory:
    """Positions low-passed, orientations not."""
    return with_parts(child, positions=filtered_positions(child, tau_s))


@of_child(FAULTS, "S4b", "positions late", (0.05, 0.1, 0.2), "s", _OF_POSITIONS)
def late_positions(child: Trajectory, delay_s: float, random: Random) -> Trajectory:
    """Positions later than the orientations of the same message."""
    late = child.shifted(delay_s).at(child.stamps_ns, extrapolate=True)
    return with_parts(child, positions=late[:, :3, 3])


@of_child(FAULTS, "S5", "positions smoothed, no delay", (0.05, 0.1, 0.2), "s", _OF_POSITIONS)
def _smoothed(child: Trajectory, tau_s: float, random: Random) -> Trajectory:
    ahead = filtered_positions(child, tau_s)
    return with_parts(child, positions=filtered(ahead[::-1], -child.stamps_ns[::-1], tau_s)[::-1])


@of_child(
    FAULTS, "S6", "all low-passed", (0.05, 0.1, 0.2), "s", f"smoothed_orientations {_OF_POSITIONS}",
    options={"time_offset": "estimate"},
)  # fmt: skip
def _all_low_passed(child: Trajectory, tau_s: float, random: Random) -> Trajectory:
    return with_parts(child, filtered_rotations(child, tau_s), filtered_positions(child, tau_s))


@of_child(FAULTS, "S7", "yaw gain", (0.005, 0.01, 0.02), named="rotation_gain")
def _yaw_gain(child: Trajectory, gain: float, random: Random) -> Trajectory:
    steps = se3.inverse(child.poses[:-1]) @ child.poses[1:]
    # The vehicle's vertical in the child's frame: the main axis of rotation.
    vectors = se3.rotation_log(steps[:, :3, :3])
    axis = np.linalg.eigh(vectors.T @ vectors)[1][:, -1]
    vectors = vectors + gain * np.outer(vectors @ axis, axis)
    steps[:, :3, :3] = se3.rotation_exp(vectors)
    poses = [child.poses[0]]
    for step in steps:
        poses.append(poses[-1] @ step)
    return dataclasses.replace(child, poses=np.array(poses))


@of_child(FAULTS, "S8", "mount loosened half-way", (0.5, 1.0, 2.0), "deg", "mount_moved")
def _loosened(child: Trajectory, degrees: float, random: Random) -> Trajectory:
    """By so many degrees and 2.5 cm for each."""
    axes = random.standard_normal((2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    shift = se3.exp(np.r_[0.025 * degrees * axes[0], np.radians(degrees) * axes[1]])
    poses = child.poses.copy()
    half = len(poses) // 2
    poses[half:] = poses[half:] @ shift
    return dataclasses.replace(child, poses=poses)


@of_child(FAULTS, "S9", "scale", (0.005, 0.01, 0.02), named="scale")
def _scaled(child: Trajectory, excess: float, random: Random) -> Trajectory:
    return child.scaled(1.0 + excess)


@of_child(FAULTS, "S10", "mirrored axis", (0.0, 1.0, 2.0), "(axis)", "axes left_handed")
def _mirrored(child: Trajectory, axis: float, random: Random) -> Trajectory:
    """Of the positions alone."""
    positions = positions_of(child).copy()
    positions[:, int(axis)] *= -1.0
    return with_parts(child, positions=positions)


@of_child(FAULTS, "S10b", "child in 2D", (0.5, 0.8, 1.0), "share", "flat unrelated noisy")
def _flattened(child: Trajectory, share: float, random: Random) -> Trajectory:
    return with_parts(
        upright(child, share), positions=positions_of(child) * [1.0, 1.0, 1.0 - share]
    )


@of_both(FAULTS, "S11", "float32 positions", (2e3, 5e4, 5e5), "m east", "coarse_positions")
def _as_float32(parent: Trajectory, child: Trajectory, metres: float, random: Random) -> Streams:
    """Far from the origin, both streams on one map."""
    origin = np.array([metres, 9.0 * metres, 0.0])

    def rounded(stream: Trajectory) -> Trajectory:
        positions = (positions_of(stream) + origin).astype(np.float32)
        return with_parts(stream, positions=positions.astype(float))

    return rounded(parent), rounded(child)


@of_both(FAULTS, "S12", "both scalar first", (0.0,), named="quaternion_order")
def _scalar_first(parent: Trajectory, child: Trajectory, which: float, random: Random) -> Streams:
    rolled = [np.roll(se3.to_quat_xyzw(stream.poses), 1, axis=1) for stream in (parent, child)]
    return with_quats(parent, rolled[0]), with_quats(child, rolled[1])


@of_child(FAULTS, "S13", "inverse poses under noise", (0.003, 0.02, 0.05), "m noise", "inverse")
def _inverted(child: Trajectory, noise: float, random: Random) -> Trajectory:
    return dataclasses.replace(child, poses=se3.inverse(noisy(child.poses, noise, random)))


@of_child(
    FAULTS, "S14", "orientations inverted", (0.0, 0.01, 0.03), "m noise", "inverse_orientation"
)
def _inverted_orientations(child: Trajectory, noise: float, random: Random) -> Trajectory:
    poses = noisy(child.poses, noise, random)
    return with_parts(child, np.swapaxes(poses[:, :3, :3], 1, 2))


@of_child(FAULTS, "clock", "child's clock", (0.02, 0.05, 0.2), "s", "time_offset")
def _late(child: Trajectory, delay_s: float, random: Random) -> Trajectory:
    return child.shifted(delay_s)


@of_child(FAULTS, "S15", "jumps", (0.003, 0.01, 0.03), "share", "jumps")
def _jumping(child: Trajectory, share: float, random: Random) -> Trajectory:
    """Lasting, of some 30 cm."""
    shifts = np.zeros((len(child), 3))
    at = random.integers(len(child), size=round(share * len(child)))
    shifts[at] = 0.3 * random.standard_normal((len(at), 3))
    return with_parts(child, positions=positions_of(child) + np.cumsum(shifts, axis=0))


# ------------------------------------------------------------------ built without a limit for them


@of_child(UNTUNED, "U1", "orientations with yaw only", (0.2, 0.5, 1.0), "share")
def _yaw_only(child: Trajectory, share: float, random: Random) -> Trajectory:
    return upright(child, share)


@of_child(UNTUNED, "U2", "coarse stamps", (0.01, 0.05, 0.1), "s")
def _rounded_stamps(child: Trajectory, step_s: float, random: Random) -> Trajectory:
    step_ns = round(step_s * 1e9)
    return at_stamps(child.stamps_ns // step_ns * step_ns, child.poses)


@of_child(UNTUNED, "U3", "part of the child repeated", (0.1, 0.25, 0.5), "share")
def _repeated(child: Trajectory, share: float, random: Random) -> Trajectory:
    """The last share is a copy of the part before it."""
    n = int(share * len(child))
    poses = child.poses.copy()
    poses[-n:] = poses[-2 * n : -n]
    return dataclasses.replace(child, poses=poses)


@of_child(UNTUNED, "U4", "child restarted half-way", (0.0, 1.0, 10.0), "s gap")
def _restarted(child: Trajectory, gap_s: float, random: Random) -> Trajectory:
    """With a world of its own."""
    half = len(child) // 2
    poses = child.poses.copy()
    poses[half:] = se3.inverse(poses[half]) @ poses[half:]
    since_ns = child.stamps_ns - child.stamps_ns[half]
    gone = (since_ns > 0) & (since_ns < gap_s * 1e9)
    return Trajectory(child.stamps_ns[~gone], poses[~gone])


@of_child(UNTUNED, "U5", "quaternion with one wrong sign", (0.0, 1.0, 2.0), "(part)")
def _flipped(child: Trajectory, part: float, random: Random) -> Trajectory:
    quats = se3.to_quat_xyzw(child.poses)
    quats[:, int(part)] *= -1.0
    return with_quats(child, quats)


@of_child(UNTUNED, "U6", "latency that grows", (0.02, 0.05, 0.2), "s")
def _slow_clock(child: Trajectory, drift_s: float, random: Random) -> Trajectory:
    elapsed = child.stamps_ns - child.stamps_ns[0]
    late = (elapsed * (drift_s / (elapsed[-1] * 1e-9))).astype(np.int64)
    return Trajectory(child.stamps_ns + late, child.poses)


@of_both(UNTUNED, "U7", "parent's orientations smoothed", (0.05, 0.1, 0.2), "s")
def _smooth_parent(parent: Trajectory, child: Trajectory, tau_s: float, random: Random) -> Streams:
    """Low-passed and shifted back by the delay."""
    late = with_parts(parent, filtered_rotations(parent, tau_s))
    back = late.shifted(-tau_s).at(parent.stamps_ns, extrapolate=True)
    return with_parts(parent, back[:, :3, :3]), child


@of_child(UNTUNED, "U8", "another unit", (100.0, 1000.0, 3.28084))
def _in_unit(child: Trajectory, factor: float, random: Random) -> Trajectory:
    return child.scaled(factor)


@of_child(UNTUNED, "U9", "degrees read as radians", (0.0, 1.0, 2.0), "(which)")
def _degrees_as_radians(child: Trajectory, which: float, random: Random) -> Trajectory:
    """All Euler angles, yaw only, or roll and pitch only."""
    angles = angles_of(child)
    parts = {0.0: slice(None), 1.0: slice(0, 1), 2.0: slice(1, 3)}[which]
    angles[:, parts] = np.degrees(angles[:, parts])
    return with_parts(child, from_angles(angles))


@of_both(UNTUNED, "U10", "two recordings, remounted", (1.0, 2.0, 5.0), "deg")
def _remounted(parent: Trajectory, child: Trajectory, degrees: float, random: Random) -> Streams:
    """A minute apart, with another mount and other worlds in the second."""
    moved = _loosened(child, degrees, random)
    worlds = [se3.exp(random.standard_normal(6)) for _ in range(2)]
    half_ns = child.stamps_ns[len(child) // 2]

    def second(stream: Trajectory, world: FloatArray) -> Trajectory:
        is_late = stream.stamps_ns >= half_ns
        poses = stream.poses.copy()
        poses[is_late] = world @ poses[is_late]
        return Trajectory(stream.stamps_ns + 60_000_000_000 * is_late, poses)

    return second(parent, worlds[0]), second(moved, worlds[1])


@of_child(UNTUNED, "U11", "poses held", (0.1, 0.2, 0.5), "s")
def _held(child: Trajectory, interval_s: float, random: Random) -> Trajectory:
    """A slow source published fast: each pose is repeated until there is a new one."""
    steps = (seconds_of(child) / interval_s).astype(int)
    first = np.unique(steps, return_index=True)[1]
    return dataclasses.replace(child, poses=child.poses[first[steps]])


@of_child(UNTUNED, "U12", "two sensors, no order", (0.03, 0.1, 0.3), "m")
def _mixed(child: Trajectory, metres: float, random: Random) -> Trajectory:
    is_other = random.random(len(child)) < 0.5
    poses = child.poses.copy()
    poses[is_other] = poses[is_other] @ _other(metres)
    return dataclasses.replace(child, poses=poses)
