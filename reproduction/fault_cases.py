"""Faults that give a wrong extrinsic in confidence, made on purpose in two streams, each in three
severities. The limits of the checks were set with the first group; the others were built later.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from reproduction.changed_streams import (
    Random,
    at_stamps,
    beside,
    delayed,
    filtered,
    filtered_positions,
    filtered_rotations,
    higher,
    moved_at,
    noisy,
    posed,
    positions_of,
    seconds_of,
    upright,
    with_parts,
    with_quats,
)

Streams = tuple[Trajectory, Trajectory]
_OfChild = Callable[[Trajectory, float, Random], Trajectory]
_OfBoth = Callable[[Trajectory, Trajectory, float, Random], Streams]

# Time between two world jumps, and between the stamps of poses that arrive together (s).
_BETWEEN_JUMPS_S = 20.0
_TOGETHER_S = 0.001


@dataclass(frozen=True)
class Fault:
    """A fault: its code, and what is wrong in words."""

    code: str
    what: str
    # The weakest first; one if it has no degrees.
    severities: tuple[float, ...]
    unit: str
    # ``damage(parent, child, severity, generator)``.
    damage: _OfBoth
    # Codes of findings that name it; empty if the checks were built without it.
    named: frozenset[str] = frozenset()
    # Of the calibration, besides its method.
    options: Mapping[str, Any] = field(default_factory=dict)


_ALL: list[Fault] = []
_THREE = (0.0, 1.0, 2.0)
_SECONDS = (0.05, 0.1, 0.2)


def _both(
    code: str,
    what: str,
    severities: Any,
    unit: str = "",
    named: str = "",
    **options: Any,
) -> Callable[[_OfBoth], _OfBoth]:
    """Enter a fault of both streams; ``named`` has the codes, a space between them."""

    def enter(damage: _OfBoth) -> _OfBoth:
        names = frozenset(named.split())
        _ALL.append(Fault(code, what, severities, unit, damage, names, options))
        return damage

    return enter


def _child(*about: Any, **options: Any) -> Callable[[_OfChild], _OfChild]:
    """Enter a fault of the child's stream alone."""

    def enter(change: _OfChild) -> _OfChild:
        def damage(
            parent: Trajectory, child: Trajectory, value: float, random: Random
        ) -> Streams:
            return parent, change(child, value, random)

        _both(*about, **options)(damage)
        return change

    return enter


_POSITIONS = "smoothed_positions position_clock"


@_both(
    "S1", "child is the parent's own frame", (0.01, 0.003, 0.0), "m noise", "same_frame"
)
def copied(
    parent: Trajectory, child: Trajectory, noise: float, random: Random
) -> Streams:
    world = se3.exp(random.standard_normal(6))
    copy = Trajectory(parent.stamps_ns, world @ parent.poses)
    return parent, noisy(copy, noise, random)


@_both("S2", "child positions from the parent", (0.01, 0.003, 0.0), "m noise",
       "same_position same_frame")  # fmt: skip
def fused(
    parent: Trajectory, child: Trajectory, noise: float, random: Random
) -> Streams:
    """Positions from the parent's, turned by the rotation that both orientations give."""
    is_shared = child.stamps_ns >= parent.stamps_ns[0]
    is_shared &= child.stamps_ns <= parent.stamps_ns[-1]
    child = child[is_shared]
    at_child = parent.at(child.stamps_ns)
    parent_rotations = at_child[:, :3, :3]
    child_rotations = child.poses[:, :3, :3]
    parent_steps = _rotation_steps(parent_rotations[::10])
    child_steps = _rotation_steps(child_rotations[::10])
    X = Rotation.align_vectors(parent_steps, child_steps)[0].as_matrix()

    # The child's world in the parent's, from the orientations at the start and a common origin.
    turned = child_rotations[0] @ X.T @ parent_rotations[0].T
    travelled = at_child[:, :3, 3] - at_child[0, :3, 3]
    positions = travelled @ turned.T
    positions += noise * random.standard_normal(positions.shape)
    return parent, with_parts(child, positions=positions)


def _rotation_steps(rotations: FloatArray) -> FloatArray:
    """Rotation vectors (N-1, 3) from each of the rotations (N, 3, 3) to the next."""
    back = np.swapaxes(rotations[:-1], 1, 2)
    return se3.rotation_log(back @ rotations[1:])


@_child("S3", "two sensors, one world", (0.03, 0.1, 0.3), "m", "interleaved")
def interleaved(child: Trajectory, metres: float, _: Random) -> Trajectory:
    return moved_at(child, slice(1, None, 2), beside(metres))


@_child("S3b", "two sensors, two worlds", (0.1, 0.3, 3.0), "m", "interleaved")
def in_two_worlds(child: Trajectory, metres: float, _: Random) -> Trajectory:
    poses = child.poses.copy()
    world = se3.exp(np.array([metres, 0.0, 0.0, 0.0, 0.0, 0.2]))
    poses[1::2] = world @ poses[1::2] @ beside(metres)
    return posed(child, poses)


@_child("S4", "positions low-passed", _SECONDS, "s", _POSITIONS)
def low_passed(child: Trajectory, tau_s: float, _: Random) -> Trajectory:
    return with_parts(child, positions=filtered_positions(child, tau_s))


@_child("S4b", "positions late", _SECONDS, "s", _POSITIONS)
def late_positions(child: Trajectory, delay_s: float, _: Random) -> Trajectory:
    poses = delayed(child, delay_s)
    return with_parts(child, positions=poses[:, :3, 3])


@_child("S5", "positions smoothed, no delay", _SECONDS, "s", _POSITIONS)
def smoothed(child: Trajectory, tau_s: float, _: Random) -> Trajectory:
    ahead = filtered_positions(child, tau_s)
    backwards_ns = -child.stamps_ns[::-1]
    back = filtered(ahead[::-1], backwards_ns, tau_s)
    return with_parts(child, positions=back[::-1])


_child(
    "S6",
    "all low-passed",
    _SECONDS,
    "s",
    f"smoothed_orientations {_POSITIONS}",
    time_offset="estimate",
)(
    lambda child, s, _: with_parts(
        child, filtered_rotations(child, s), filtered_positions(child, s)
    )
)


@_child("S7", "yaw gain", (0.005, 0.01, 0.02), "", "rotation_gain")
def yaw_gain(child: Trajectory, gain: float, _: Random) -> Trajectory:
    """About the vehicle's vertical: the main axis of rotation in the child's frame."""
    steps = se3.inverse(child.poses[:-1]) @ child.poses[1:]
    vectors = se3.rotation_log(steps[:, :3, :3])
    moments = vectors.T @ vectors
    axes = np.linalg.eigh(moments)[1]
    axis = axes[:, -1]
    about_axis = np.outer(vectors @ axis, axis)
    steps[:, :3, :3] = se3.rotation_exp(vectors + gain * about_axis)
    poses = [child.poses[0]]
    for step in steps:
        poses.append(poses[-1] @ step)
    return posed(child, np.array(poses))


@_child("S8", "mount loosened half-way", (0.5, 1.0, 2.0), "deg", "mount_moved")
def loosened(child: Trajectory, degrees: float, random: Random) -> Trajectory:
    """By so many degrees and 2.5 cm for each."""
    axes = random.standard_normal((2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    translation = 0.025 * degrees * axes[0]
    rotation = np.radians(degrees) * axes[1]
    shift = se3.exp(np.concatenate([translation, rotation]))
    return moved_at(child, slice(len(child) // 2, None), shift)


_child("S9", "scale", (0.005, 0.01, 0.02), "", "scale")(
    lambda child, excess, _: child.scaled(1.0 + excess)
)


@_child("S10", "mirrored axis", _THREE, "(axis)", "axes left_handed")
def mirrored(child: Trajectory, axis: float, _: Random) -> Trajectory:
    is_mirrored = np.arange(3) == int(axis)
    signs = np.where(is_mirrored, -1.0, 1.0)
    return with_parts(child, positions=positions_of(child) * signs)


_child("S10b", "child in 2D", (0.5, 0.8, 1.0), "share", "flat unrelated noisy")(
    lambda child, share, _: higher(upright(child, share), 1.0 - share)
)


@_both("S11", "float32 positions", (2e3, 5e4, 5e5), "m east", "coarse_positions")
def as_float32(
    parent: Trajectory, child: Trajectory, metres: float, _: Random
) -> Streams:
    """Far from the origin, both streams on one map."""
    origin = np.array([metres, 9.0 * metres, 0.0])
    streams = []
    for stream in (parent, child):
        on_map = (positions_of(stream) + origin).astype(np.float32)
        streams.append(with_parts(stream, positions=on_map.astype(float)))
    return streams[0], streams[1]


@_both("S12", "both scalar first", (0.0,), "", "quaternion_order")
def scalar_first(
    parent: Trajectory, child: Trajectory, _: float, random: Random
) -> Streams:
    streams = []
    for stream in (parent, child):
        quats_wxyz = np.roll(se3.to_quat_xyzw(stream.poses), 1, axis=1)
        streams.append(with_quats(stream, quats_wxyz))
    return streams[0], streams[1]


@_child("S13", "inverse poses under noise", (0.003, 0.02, 0.05), "m noise", "inverse")
def inverted(child: Trajectory, noise: float, random: Random) -> Trajectory:
    poses = noisy(child, noise, random).poses
    return posed(child, se3.inverse(poses))


@_child(
    "S14", "orientations inverted", (0.0, 0.01, 0.03), "m noise", "inverse_orientation"
)
def inverted_orientations(
    child: Trajectory, noise: float, random: Random
) -> Trajectory:
    rotations = noisy(child, noise, random).poses[:, :3, :3]
    return with_parts(child, np.swapaxes(rotations, 1, 2))


_child("clock", "child's clock", (0.02, 0.05, 0.2), "s", "time_offset")(
    lambda child, s, _: child.shifted(s)
)


@_child("S15", "jumps", (0.003, 0.01, 0.03), "share", "jumps")
def jumping(child: Trajectory, share: float, random: Random) -> Trajectory:
    """Lasting, of some 30 cm."""
    count = len(child)
    shifts = np.zeros((count, 3))
    rows = random.integers(count, size=round(share * count))
    shifts[rows] = 0.3 * random.standard_normal((len(rows), 3))
    lasting = np.cumsum(shifts, axis=0)
    return with_parts(child, positions=positions_of(child) + lasting)


@_child("U4", "child restarted half-way", (0.0, 1.0, 10.0), "s gap")
def restarted(child: Trajectory, gap_s: float, _: Random) -> Trajectory:
    """With a world of its own."""
    half = len(child) // 2
    poses = child.poses.copy()
    poses[half:] = se3.inverse(poses[half]) @ poses[half:]
    since_ns = child.stamps_ns - child.stamps_ns[half]
    is_gone = (since_ns > 0) & (since_ns < gap_s * 1e9)
    is_kept = ~is_gone
    return Trajectory(child.stamps_ns[is_kept], poses[is_kept])


@_both("U7", "parent's orientations smoothed", _SECONDS, "s",
       "smoothed_orientations position_clock")  # fmt: skip
def smooth_parent(
    parent: Trajectory, child: Trajectory, tau_s: float, _: Random
) -> Streams:
    """Low-passed and shifted back by the delay."""
    smooth = with_parts(parent, filtered_rotations(parent, tau_s))
    poses = delayed(smooth, -tau_s)
    return with_parts(parent, poses[:, :3, :3]), child


@_both("U10", "two recordings, remounted", (1.0, 2.0, 5.0), "deg")
def remounted(
    parent: Trajectory, child: Trajectory, degrees: float, random: Random
) -> Streams:
    """A minute apart, with another mount and other worlds in the second."""
    remount = loosened(child, degrees, random)
    half_ns = child.stamps_ns[len(child) // 2]
    streams = []
    for stream in (parent, remount):
        is_late = stream.stamps_ns >= half_ns
        world = se3.exp(random.standard_normal(6))
        poses = stream.poses.copy()
        poses[is_late] = world @ poses[is_late]
        stamps_ns = stream.stamps_ns + 60_000_000_000 * is_late
        streams.append(Trajectory(stamps_ns, poses))
    return streams[0], streams[1]


@_child("U11", "poses held", (0.1, 0.2, 0.5), "s")
def held(child: Trajectory, interval_s: float, _: Random) -> Trajectory:
    """A slow source published fast: each pose is repeated until there is a new one."""
    elapsed_s = seconds_of(child)
    steps = (elapsed_s / interval_s).astype(int)
    first = np.unique(steps, return_index=True)[1]
    return posed(child, child.poses[first[steps]])


@_both("U12", "streams exchanged", (0.5, 0.3, 0.7), "share", "exchanged")
def exchanged(
    parent: Trajectory, child: Trajectory, share: float, _: Random
) -> Streams:
    """From a share of the recording on, each stream has the poses of the other sensor."""
    from_ns = child.stamps_ns[int(share * len(child))]
    streams = []
    for first, second in ((parent, child), (child, parent)):
        before = first[first.stamps_ns < from_ns]
        after = second[second.stamps_ns >= from_ns]
        stamps_ns = np.concatenate([before.stamps_ns, after.stamps_ns])
        poses = np.concatenate([before.poses, after.poses])
        streams.append(Trajectory(stamps_ns, poses))
    return streams[0], streams[1]


_both("V1", "parent's positions late", (0.02, 0.05, 0.1), "s", "position_clock")(
    lambda parent, child, s, random: (late_positions(parent, s, random), child)
)

_child("V2", "child's orientations late", (0.02, 0.05, 0.1), "s", "position_clock")(
    lambda child, s, _: with_parts(child, delayed(child, s)[:, :3, :3])
)


@_child("V4", "heading drifts", (1.0, 5.0, 20.0), "deg/min")
def heading_drift(child: Trajectory, degrees: float, _: Random) -> Trajectory:
    elapsed_ns = child.stamps_ns - child.stamps_ns[0]
    minutes = elapsed_ns / 60e9
    yaw = np.radians(degrees) * minutes
    turns = se3.rotation_exp(np.outer(yaw, [0.0, 0.0, 1.0]))
    worlds = np.tile(np.eye(4), (len(child), 1, 1))
    worlds[:, :3, :3] = turns
    return posed(child, worlds @ child.poses)


@_child("V6", "stamps scatter", (0.005, 0.02, 0.05), "s")
def jittered(child: Trajectory, sigma_s: float, random: Random) -> Trajectory:
    standard = random.standard_normal(len(child))
    jitter_ns = np.round(1e9 * sigma_s * standard)
    return at_stamps(child.stamps_ns + jitter_ns, child.poses)


@_child("V8", "child swings on its mount", (0.2, 1.0, 5.0), "deg")
def swinging(child: Trajectory, degrees: float, _: Random) -> Trajectory:
    """About one axis, once in seven seconds."""
    phases = 2 * np.pi * seconds_of(child) / 7.0
    angles = np.radians(degrees) * np.sin(phases)
    swing = se3.rotation_exp(np.outer(angles, [0.0, 1.0, 0.0]))
    rotations = child.poses[:, :3, :3]
    return with_parts(child, rotations @ swing)


@_child("W2", "left-handed axes", _THREE, "(axis)")
def mirrored_world(child: Trajectory, axis: float, _: Random) -> Trajectory:
    is_mirrored = np.arange(4) == int(axis)
    mirror = np.diag(np.where(is_mirrored, -1.0, 1.0))
    return Trajectory(child.stamps_ns, mirror @ child.poses @ mirror)


@_child("W3", "stuck half-way", (2.0, 5.0, 15.0), "s")
def stuck(child: Trajectory, seconds: float, _: Random) -> Trajectory:
    """It goes on where it is then."""
    first = len(child) // 2
    since_ns = child.stamps_ns - child.stamps_ns[first]
    is_stuck = (since_ns >= 0) & (since_ns < seconds * 1e9)
    poses = child.poses.copy()
    poses[is_stuck] = poses[first]
    return posed(child, poses)


@_child("W4", "few digits", (3.0, 2.0, 1.0), "digits")
def few_digits(child: Trajectory, digits: float, _: Random) -> Trajectory:
    step = 10.0 ** -int(digits)

    def rounded(values: FloatArray) -> FloatArray:
        return np.round(values / step) * step

    quats = rounded(se3.to_quat_xyzw(child.poses))
    positions = rounded(positions_of(child))
    return Trajectory(child.stamps_ns, se3.from_quat_xyzw(positions, quats))


@_child("W5", "relocalised every 20 s", (0.1, 0.5, 2.0), "m")
def relocalised(child: Trajectory, metres: float, random: Random) -> Trajectory:
    """The child's world jumps by so much, and by as many tenths of a radian."""
    elapsed_s = seconds_of(child)
    poses = child.poses.copy()
    sizes = metres * np.repeat([1.0, 0.1], 3)
    starts_s = np.arange(_BETWEEN_JUMPS_S, elapsed_s[-1], _BETWEEN_JUMPS_S)
    for start_s in starts_s:
        is_later = elapsed_s >= start_s
        jump = se3.exp(sizes * random.standard_normal(6))
        poses[is_later] = jump @ poses[is_later]
    return posed(child, poses)


@_child("W6", "published again", (0.005, 0.02, 0.05), "s later")
def republished(child: Trajectory, late_s: float, _: Random) -> Trajectory:
    late_ns = child.stamps_ns + round(late_s * 1e9)
    stamps_ns = np.concatenate([child.stamps_ns, late_ns])
    poses = np.concatenate([child.poses, child.poses])
    return at_stamps(stamps_ns, poses)


@_child("W7", "clock too fast", (100.0, 1000.0, 5000.0), "ppm")
def fast_clock(child: Trajectory, ppm: float, _: Random) -> Trajectory:
    """It is right half-way."""
    middle_ns = child.stamps_ns[len(child) // 2]
    since_ns = child.stamps_ns - middle_ns
    late_ns = np.round(1e-6 * ppm * since_ns).astype(np.int64)
    return Trajectory(child.stamps_ns + late_ns, child.poses)


@_both("W8", "heights zero", _THREE, "(which)")
def heightless(
    parent: Trajectory, child: Trajectory, which: float, _: Random
) -> Streams:
    """The parent's, those of both, and both upright besides."""
    flat_parent = higher(parent, 0.0)
    flat_child = higher(child, 0.0)
    if which == 0.0:
        return flat_parent, child
    if which == 1.0:
        return flat_parent, flat_child
    return upright(flat_parent), upright(flat_child)


@_child("W10", "stamps of arrival, in bursts", (0.1, 0.3, 1.0), "s")
def in_bursts(child: Trajectory, seconds: float, _: Random) -> Trajectory:
    """The poses are held back, come together, and have stamps of when they came."""
    start_ns = child.stamps_ns[0]
    interval_ns = round(seconds * 1e9)
    bursts = (child.stamps_ns - start_ns) // interval_ns
    ends_ns = (bursts + 1) * interval_ns
    place_in_burst = np.arange(len(child)) - np.searchsorted(bursts, bursts)
    behind_ns = np.round(place_in_burst * _TOGETHER_S * 1e9)
    arrival_ns = ends_ns + behind_ns.astype(np.int64)
    return at_stamps(start_ns + arrival_ns, child.poses)


@_child(
    "X1",
    "positions turned against orientations",
    (1.5, 2.5, 4.0),
    "deg",
    "worlds_turned",
)
def turned_positions(stream: Trajectory, degrees: float, _: Random) -> Trajectory:
    """Positions in a world that is turned about z against that of the orientations."""
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return with_parts(stream, positions=positions_of(stream) @ turn.T)


_both("X2", "the parent's turned", (1.5, 2.5, 4.0), "deg", "worlds_turned")(
    lambda parent, child, degrees, _: (turned_positions(parent, degrees, _), child)
)

_child("X3", "heights in another unit", (1.02, 1.1, 3.28084), "", "axis_scale")(
    lambda child, factor, _: higher(child, factor)
)


@_child("X4", "heights of a barometer", (0.3, 1.0, 3.0), "s", "axis_lag axis_scale")
def late_heights(stream: Trajectory, tau_s: float, _: Random) -> Trajectory:
    positions = positions_of(stream).copy()
    heights = positions[:, 2]
    positions[:, 2] = filtered(heights, stream.stamps_ns, tau_s)
    return with_parts(stream, positions=positions)


_child("X5", "heights constant", (0.0,), "", "axis_scale")(
    lambda child, factor, _: higher(child, factor)
)


def _group(initials: str) -> tuple[Fault, ...]:
    faults = []
    for fault in _ALL:
        initial = fault.code.replace("clock", "S")[0]
        if initial in initials:
            faults.append(fault)
    return tuple(faults)


FAULTS = _group("S")
LATER = _group("UVW")
SILENT = _group("X")
# Groups of the page: title to faults.
GROUPS = {
    "Faults": FAULTS,
    "Faults that were built later, without a limit for them": LATER,
    "Faults that were silent before their columns": SILENT,
}
