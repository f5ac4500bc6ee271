"""What faults do to the poses of one stream or of two."""

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory

Streams = tuple[Trajectory, Trajectory]
Random = np.random.Generator

# Time between two world jumps, and between the stamps of poses that arrive together (s).
_BETWEEN_JUMPS_S, _TOGETHER_S = 20.0, 0.001

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
    return posed(stream, poses)


def posed(stream: Trajectory, poses: FloatArray) -> Trajectory:
    return dataclasses.replace(stream, poses=poses)


def moved_at(stream: Trajectory, where: Any, transforms: FloatArray) -> Trajectory:
    """The stream with some of its poses multiplied from the right."""
    poses = stream.poses.copy()
    poses[where] = poses[where] @ transforms
    return posed(stream, poses)


def positions_of(stream: Trajectory) -> FloatArray:
    return stream.poses[:, :3, 3]


def angles_of(stream: Trajectory) -> FloatArray:
    """Yaw, pitch and roll (N, 3), rad."""
    return Rotation.from_matrix(stream.poses[:, :3, :3]).as_euler("ZYX")


def turned(stream: Trajectory, angles: FloatArray) -> Trajectory:
    """The stream with other yaw, pitch and roll (N, 3)."""
    return with_parts(stream, Rotation.from_euler("ZYX", angles).as_matrix())


def with_quats(stream: Trajectory, quats: FloatArray) -> Trajectory:
    return Trajectory(stream.stamps_ns, se3.from_quat_xyzw(positions_of(stream), quats))


def at_stamps(stamps_ns: Any, poses: FloatArray) -> Trajectory:
    """Poses in the order of their stamps; of equal ones the first."""
    stamps_ns, first = np.unique(np.asarray(stamps_ns).astype(np.int64), return_index=True)
    return Trajectory(stamps_ns, poses[first])


def seconds_of(stream: Trajectory) -> FloatArray:
    """Times (N,) since the first pose, s."""
    return (stream.stamps_ns - stream.stamps_ns[0]) * 1e-9


def noisy(stream: Trajectory, metres: float, random: Random) -> Trajectory:
    """White noise of so many metres, and twice as many radians."""
    xi = metres * random.standard_normal((len(stream), 6))
    xi[:, 3:] *= 2.0
    return posed(stream, stream.poses @ se3.exp(xi))


def shares(stamps_ns: IntArray, tau_s: float) -> FloatArray:
    """Of the way to its input that a first-order low-pass filter goes in each step."""
    return 1.0 - np.exp(-np.diff(stamps_ns) * 1e-9 / tau_s)


def filtered(values: FloatArray, stamps_ns: IntArray, tau_s: float) -> FloatArray:
    """Values (N, ...) after a first-order low-pass filter."""
    out = values.copy()
    for k, share in enumerate(shares(stamps_ns, tau_s)):
        out[k + 1] = out[k] + share * (values[k + 1] - out[k])
    return out


def filtered_positions(stream: Trajectory, tau_s: float) -> FloatArray:
    return filtered(positions_of(stream), stream.stamps_ns, tau_s)


def filtered_rotations(stream: Trajectory, tau_s: float) -> FloatArray:
    rotations = stream.poses[:, :3, :3].copy()
    for k, share in enumerate(shares(stream.stamps_ns, tau_s)):
        step = se3.rotation_log(rotations[k].T @ stream.poses[k + 1, :3, :3])
        rotations[k + 1] = rotations[k] @ se3.rotation_exp(share * step)
    return rotations


def upright(stream: Trajectory, share: float = 1.0) -> Trajectory:
    """A stream with a share less of roll and pitch."""
    return turned(stream, angles_of(stream) * [1.0, 1.0 - share, 1.0 - share])


def higher(stream: Trajectory, factor: float) -> Trajectory:
    return with_parts(stream, positions=positions_of(stream) * [1.0, 1.0, factor])


def delayed(stream: Trajectory, delay_s: float) -> FloatArray:
    """Poses (N, 4, 4) as they were so long before."""
    return stream.shifted(delay_s).at(stream.stamps_ns, extrapolate=True)


def beside(metres: float) -> FloatArray:
    """Pose of another sensor beside the child."""
    return se3.from_rotation_translation(np.eye(3), [metres, 0.0, 0.0])


# ------------------------------------------------------------------ the faults


def copied(parent: Trajectory, child: Trajectory, noise: float, random: Random) -> Streams:
    world = se3.exp(random.standard_normal(6))
    return parent, noisy(Trajectory(parent.stamps_ns, world @ parent.poses), noise, random)


def fused(parent: Trajectory, child: Trajectory, noise: float, random: Random) -> Streams:
    """Positions from the parent's, turned by the rotation that both orientations give."""
    child = child[
        (child.stamps_ns >= parent.stamps_ns[0]) & (child.stamps_ns <= parent.stamps_ns[-1])
    ]
    at_child = parent.at(child.stamps_ns)
    steps = (
        se3.rotation_log(np.swapaxes(poses[:-1], 1, 2) @ poses[1:])
        for poses in (at_child[::10, :3, :3], child.poses[::10, :3, :3])
    )
    X = Rotation.align_vectors(*steps)[0].as_matrix()
    # The child's world in the parent's, from the orientations at the start and a common origin.
    turned = child.poses[0, :3, :3] @ X.T @ at_child[0, :3, :3].T
    positions = (at_child[:, :3, 3] - at_child[0, :3, 3]) @ turned.T
    positions += noise * random.standard_normal(positions.shape)
    return parent, with_parts(child, positions=positions)


def interleaved(child: Trajectory, metres: float, random: Random) -> Trajectory:
    return moved_at(child, slice(1, None, 2), beside(metres))


def low_passed(child: Trajectory, tau_s: float, random: Random) -> Trajectory:
    return with_parts(child, positions=filtered_positions(child, tau_s))


def late_positions(child: Trajectory, delay_s: float, random: Random) -> Trajectory:
    return with_parts(child, positions=delayed(child, delay_s)[:, :3, 3])


def in_two_worlds(child: Trajectory, metres: float, random: Random) -> Trajectory:
    poses = child.poses.copy()
    poses[1::2] = se3.exp(np.r_[metres, 0, 0, 0, 0, 0.2]) @ poses[1::2] @ beside(metres)
    return posed(child, poses)


def smoothed(child: Trajectory, tau_s: float, random: Random) -> Trajectory:
    ahead = filtered_positions(child, tau_s)
    return with_parts(child, positions=filtered(ahead[::-1], -child.stamps_ns[::-1], tau_s)[::-1])


def yaw_gain(child: Trajectory, gain: float, random: Random) -> Trajectory:
    """About the vehicle's vertical: the main axis of rotation in the child's frame."""
    steps = se3.inverse(child.poses[:-1]) @ child.poses[1:]
    vectors = se3.rotation_log(steps[:, :3, :3])
    axis = np.linalg.eigh(vectors.T @ vectors)[1][:, -1]
    steps[:, :3, :3] = se3.rotation_exp(vectors + gain * np.outer(vectors @ axis, axis))
    poses = [child.poses[0]]
    for step in steps:
        poses.append(poses[-1] @ step)
    return posed(child, np.array(poses))


def loosened(child: Trajectory, degrees: float, random: Random) -> Trajectory:
    """By so many degrees and 2.5 cm for each."""
    axes = random.standard_normal((2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    shift = se3.exp(np.r_[0.025 * degrees * axes[0], np.radians(degrees) * axes[1]])
    return moved_at(child, slice(len(child) // 2, None), shift)


def mirrored(child: Trajectory, axis: float, random: Random) -> Trajectory:
    signs = np.where(np.arange(3) == int(axis), -1.0, 1.0)
    return with_parts(child, positions=positions_of(child) * signs)


def as_float32(parent: Trajectory, child: Trajectory, metres: float, random: Random) -> Streams:
    """Far from the origin, both streams on one map."""
    origin = np.array([metres, 9.0 * metres, 0.0])
    on_map = [(positions_of(stream) + origin).astype(np.float32) for stream in (parent, child)]
    return (
        with_parts(parent, positions=on_map[0].astype(float)),
        with_parts(child, positions=on_map[1].astype(float)),
    )


def scalar_first(parent: Trajectory, child: Trajectory, which: float, random: Random) -> Streams:
    rolled = [
        with_quats(stream, np.roll(se3.to_quat_xyzw(stream.poses), 1, axis=1))
        for stream in (parent, child)
    ]
    return rolled[0], rolled[1]


def inverted_orientations(child: Trajectory, noise: float, random: Random) -> Trajectory:
    rotations = noisy(child, noise, random).poses[:, :3, :3]
    return with_parts(child, np.swapaxes(rotations, 1, 2))


def inverted(child: Trajectory, noise: float, random: Random) -> Trajectory:
    return posed(child, se3.inverse(noisy(child, noise, random).poses))


def jumping(child: Trajectory, share: float, random: Random) -> Trajectory:
    """Lasting, of some 30 cm."""
    shifts = np.zeros((len(child), 3))
    at = random.integers(len(child), size=round(share * len(child)))
    shifts[at] = 0.3 * random.standard_normal((len(at), 3))
    return with_parts(child, positions=positions_of(child) + np.cumsum(shifts, axis=0))


def rounded_stamps(child: Trajectory, step_s: float, random: Random) -> Trajectory:
    step_ns = round(step_s * 1e9)
    return at_stamps(child.stamps_ns // step_ns * step_ns, child.poses)


def repeated(child: Trajectory, share: float, random: Random) -> Trajectory:
    """The last share is a copy of the part before it."""
    n = int(share * len(child))
    poses = child.poses.copy()
    poses[-n:] = poses[-2 * n : -n]
    return posed(child, poses)


def restarted(child: Trajectory, gap_s: float, random: Random) -> Trajectory:
    """With a world of its own."""
    half = len(child) // 2
    poses = child.poses.copy()
    poses[half:] = se3.inverse(poses[half]) @ poses[half:]
    since_ns = child.stamps_ns - child.stamps_ns[half]
    gone = (since_ns > 0) & (since_ns < gap_s * 1e9)
    return Trajectory(child.stamps_ns[~gone], poses[~gone])


def flipped(child: Trajectory, part: float, random: Random) -> Trajectory:
    quats = se3.to_quat_xyzw(child.poses)
    quats[:, int(part)] *= -1.0
    return with_quats(child, quats)


def slow_clock(child: Trajectory, drift_s: float, random: Random) -> Trajectory:
    elapsed = child.stamps_ns - child.stamps_ns[0]
    late = (elapsed * (drift_s / (elapsed[-1] * 1e-9))).astype(np.int64)
    return Trajectory(child.stamps_ns + late, child.poses)


def smooth_parent(parent: Trajectory, child: Trajectory, tau_s: float, random: Random) -> Streams:
    """Low-passed and shifted back by the delay."""
    smooth = with_parts(parent, filtered_rotations(parent, tau_s))
    return with_parts(parent, delayed(smooth, -tau_s)[:, :3, :3]), child


def degrees_as_radians(child: Trajectory, which: float, random: Random) -> Trajectory:
    """All Euler angles, yaw only, or roll and pitch only."""
    angles = angles_of(child)
    parts = {0.0: slice(None), 1.0: slice(0, 1), 2.0: slice(1, 3)}[which]
    angles[:, parts] = np.degrees(angles[:, parts])
    return turned(child, angles)


def remounted(parent: Trajectory, child: Trajectory, degrees: float, random: Random) -> Streams:
    """A minute apart, with another mount and other worlds in the second."""
    remount = loosened(child, degrees, random)
    half_ns = child.stamps_ns[len(child) // 2]
    streams = []
    for stream in (parent, remount):
        is_late = stream.stamps_ns >= half_ns
        poses = stream.poses.copy()
        poses[is_late] = se3.exp(random.standard_normal(6)) @ poses[is_late]
        streams.append(Trajectory(stream.stamps_ns + 60_000_000_000 * is_late, poses))
    return streams[0], streams[1]


def held(child: Trajectory, interval_s: float, random: Random) -> Trajectory:
    """A slow source published fast: each pose is repeated until there is a new one."""
    steps = (seconds_of(child) / interval_s).astype(int)
    first = np.unique(steps, return_index=True)[1]
    return posed(child, child.poses[first[steps]])


def heading_drift(child: Trajectory, degrees: float, random: Random) -> Trajectory:
    minutes = (child.stamps_ns - child.stamps_ns[0]) / 60e9
    worlds = np.tile(np.eye(4), (len(child), 1, 1))
    worlds[:, :3, :3] = se3.rotation_exp(np.outer(np.radians(degrees) * minutes, [0.0, 0.0, 1.0]))
    return posed(child, worlds @ child.poses)


def jittered(child: Trajectory, sigma_s: float, random: Random) -> Trajectory:
    jitter_ns = np.round(1e9 * sigma_s * random.standard_normal(len(child)))
    return at_stamps(child.stamps_ns + jitter_ns, child.poses)


def every_second_late(child: Trajectory, late_s: float, random: Random) -> Trajectory:
    stamps_ns = child.stamps_ns.copy()
    stamps_ns[1::2] += round(late_s * 1e9)
    return at_stamps(stamps_ns, child.poses)


def swinging(child: Trajectory, degrees: float, random: Random) -> Trajectory:
    """About one axis, once in seven seconds."""
    angles = np.radians(degrees) * np.sin(2 * np.pi * seconds_of(child) / 7.0)
    swing = se3.rotation_exp(np.outer(angles, [0.0, 1.0, 0.0]))
    return with_parts(child, child.poses[:, :3, :3] @ swing)


def coarse_angles(child: Trajectory, degrees: float, random: Random) -> Trajectory:
    angles = np.degrees(angles_of(child))
    return turned(child, np.radians(np.round(angles / degrees) * degrees))


def interpolated(child: Trajectory, factor: float, random: Random) -> Trajectory:
    """A child of so many times less poses."""
    few = child[:: int(factor)]
    inside = child.stamps_ns <= few.stamps_ns[-1]
    return Trajectory(child.stamps_ns[inside], few.at(child.stamps_ns[inside]))


def mirrored_world(child: Trajectory, axis: float, random: Random) -> Trajectory:
    mirror = np.diag(np.where(np.arange(4) == int(axis), -1.0, 1.0))
    return Trajectory(child.stamps_ns, mirror @ child.poses @ mirror)


def stuck(child: Trajectory, seconds: float, random: Random) -> Trajectory:
    """It goes on where it is then."""
    first = len(child) // 2
    since_ns = child.stamps_ns - child.stamps_ns[first]
    poses = child.poses.copy()
    poses[(since_ns >= 0) & (since_ns < seconds * 1e9)] = poses[first]
    return posed(child, poses)


def few_digits(child: Trajectory, digits: float, random: Random) -> Trajectory:
    step = 10.0 ** -int(digits)
    quats = np.round(se3.to_quat_xyzw(child.poses) / step) * step
    positions = np.round(positions_of(child) / step) * step
    return Trajectory(child.stamps_ns, se3.from_quat_xyzw(positions, quats))


def relocalised(child: Trajectory, metres: float, random: Random) -> Trajectory:
    """The child's world jumps by so much, and by as many tenths of a radian."""
    elapsed_s = seconds_of(child)
    poses = child.poses.copy()
    for start_s in np.arange(_BETWEEN_JUMPS_S, elapsed_s[-1], _BETWEEN_JUMPS_S):
        sizes = metres * np.repeat([1.0, 0.1], 3)
        later = elapsed_s >= start_s
        poses[later] = se3.exp(sizes * random.standard_normal(6)) @ poses[later]
    return posed(child, poses)


def republished(child: Trajectory, late_s: float, random: Random) -> Trajectory:
    stamps_ns = np.concatenate([child.stamps_ns, child.stamps_ns + round(late_s * 1e9)])
    return at_stamps(stamps_ns, np.concatenate([child.poses, child.poses]))


def fast_clock(child: Trajectory, ppm: float, random: Random) -> Trajectory:
    """It is right half-way."""
    from_middle = child.stamps_ns - child.stamps_ns[len(child) // 2]
    late_ns = np.round(1e-6 * ppm * from_middle).astype(np.int64)
    return Trajectory(child.stamps_ns + late_ns, child.poses)


def turned_positions(stream: Trajectory, degrees: float, _: Random) -> Trajectory:
    """Positions in a world that is turned about z against that of the orientations."""
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return with_parts(stream, positions=positions_of(stream) @ turn.T)


def late_heights(stream: Trajectory, tau_s: float, _: Random) -> Trajectory:
    positions = positions_of(stream).copy()
    positions[:, 2] = filtered(positions[:, 2], stream.stamps_ns, tau_s)
    return with_parts(stream, positions=positions)


def heightless(parent: Trajectory, child: Trajectory, which: float, random: Random) -> Streams:
    """The parent's, those of both, and both upright besides."""
    flat = higher(parent, 0.0), higher(child, 0.0)
    if which == 0.0:
        return flat[0], child
    return flat if which == 1.0 else (upright(flat[0]), upright(flat[1]))


def slow_heading(child: Trajectory, tau_s: float, random: Random) -> Trajectory:
    angles = angles_of(child)
    angles[:, 0] = filtered(np.unwrap(angles[:, 0]), child.stamps_ns, tau_s)
    return turned(child, angles)


def in_bursts(child: Trajectory, seconds: float, random: Random) -> Trajectory:
    """The poses are held back, come together, and have stamps of when they came."""
    interval_ns = round(seconds * 1e9)
    bursts = (child.stamps_ns - child.stamps_ns[0]) // interval_ns
    order = np.arange(len(child)) - np.searchsorted(bursts, bursts)
    came_ns = (bursts + 1) * interval_ns + np.round(order * _TOGETHER_S * 1e9).astype(np.int64)
    return at_stamps(child.stamps_ns[0] + came_ns, child.poses)
