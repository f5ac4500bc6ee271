"""Faults that give a wrong extrinsic in confidence, made on purpose in two streams, each in three
severities.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory

Streams = tuple[Trajectory, Trajectory]


@dataclass(frozen=True)
class Fault:
    """A fault.

    Attributes
    ----------
    code : str
        As in the list of faults.
    what : str
        What is wrong, in words.
    severities : tuple
        Three values, the weakest first; one if it has no degrees.
    damage : callable
        Damages (parent, child, severity, generator).
    unit : str
        Of the severities.
    named : frozenset of str
        Codes of findings that name it.
    options : dict
        Options of the calibration, besides its method.
    """

    code: str
    what: str
    severities: tuple[float, ...]
    damage: Callable[[Trajectory, Trajectory, float, np.random.Generator], Streams]
    unit: str
    named: frozenset[str]
    options: dict[str, Any] = field(default_factory=dict)


def with_poses(
    stream: Trajectory, rotations: FloatArray | None = None, positions: FloatArray | None = None
) -> Trajectory:
    """The stream with other orientations (N, 3, 3) or positions (N, 3)."""
    poses = stream.poses.copy()
    if rotations is not None:
        poses[:, :3, :3] = rotations
    if positions is not None:
        poses[:, :3, 3] = positions
    return dataclasses.replace(stream, poses=poses)


def _noisy(poses: FloatArray, metres: float, random: np.random.Generator) -> FloatArray:
    """Poses with white noise, as many metres as half radians."""
    xi = metres * random.standard_normal((len(poses), 6))
    xi[:, 3:] *= 2.0
    return poses @ se3.exp(xi)


def copied(parent: Trajectory, child: Trajectory, noise: float, random: Any) -> Streams:
    """The child stream is the parent's own frame in another world."""
    world = se3.exp(random.standard_normal(6))
    poses = _noisy(world @ parent.poses, noise, random)
    return parent, Trajectory(parent.stamps_ns, poses)


def fused(parent: Trajectory, child: Trajectory, noise: float, random: Any) -> Streams:
    """The child's positions are the parent's, in the child's world."""
    inside = (child.stamps_ns >= parent.stamps_ns[0]) & (child.stamps_ns <= parent.stamps_ns[-1])
    child = child[inside]
    at_child = parent.at(child.stamps_ns)
    # The child's world in the parent's, from the orientations at the start and a common origin.
    turned = child.poses[0, :3, :3] @ _fitted_rotation(parent, child).T @ at_child[0, :3, :3].T
    positions = (at_child[:, :3, 3] - at_child[0, :3, 3]) @ turned.T
    positions += noise * random.standard_normal(positions.shape)
    return parent, with_poses(child, positions=positions)


def _fitted_rotation(parent: Trajectory, child: Trajectory) -> FloatArray:
    """Rotation X from the rotations of both streams alone."""
    at_child = parent.at(child.stamps_ns)[::10, :3, :3]
    own = child.poses[::10, :3, :3]
    of_parent, of_child = (
        se3.rotation_log(np.swapaxes(poses[:-1], 1, 2) @ poses[1:]) for poses in (at_child, own)
    )
    return Rotation.align_vectors(of_parent, of_child)[0].as_matrix()


def interleaved(worlds: bool) -> Callable[..., Streams]:
    """Two sensors take turns on the child's topic, in one world or each in its own."""

    def damage(parent: Trajectory, child: Trajectory, metres: float, random: Any) -> Streams:
        offset = se3.from_rotation_translation(np.eye(3), [metres, 0.0, 0.0])
        poses = child.poses.copy()
        world = se3.exp(np.r_[metres, 0, 0, 0, 0, 0.2]) if worlds else np.eye(4)
        poses[1::2] = world @ poses[1::2] @ offset
        return parent, dataclasses.replace(child, poses=poses)

    return damage


def low_passed_values(values: FloatArray, stamps_ns: Any, tau_s: float) -> FloatArray:
    """First-order low-pass filter."""
    out = values.copy()
    shares = 1.0 - np.exp(-np.diff(stamps_ns) * 1e-9 / tau_s)
    for k, share in enumerate(shares):
        out[k + 1] = out[k] + share * (values[k + 1] - out[k])
    return out


def _smoothed(values: FloatArray, stamps_ns: Any, tau_s: float) -> FloatArray:
    """The same filter forwards and backwards: no delay."""
    ahead = low_passed_values(values, stamps_ns, tau_s)
    return low_passed_values(ahead[::-1], -stamps_ns[::-1], tau_s)[::-1]


def low_passed(parent: Trajectory, child: Trajectory, tau_s: float, random: Any) -> Streams:
    """Positions low-passed, orientations not."""
    return parent, with_poses(
        child, positions=low_passed_values(child.poses[:, :3, 3], child.stamps_ns, tau_s)
    )


def smoothed(parent: Trajectory, child: Trajectory, tau_s: float, random: Any) -> Streams:
    """Positions smoothed without a delay."""
    return parent, with_poses(
        child, positions=_smoothed(child.poses[:, :3, 3], child.stamps_ns, tau_s)
    )


def all_low_passed(parent: Trajectory, child: Trajectory, tau_s: float, random: Any) -> Streams:
    """Positions and orientations low-passed."""
    return parent, with_poses(
        child,
        _low_passed_rotations(child, tau_s),
        low_passed_values(child.poses[:, :3, 3], child.stamps_ns, tau_s),
    )


def _low_passed_rotations(child: Trajectory, tau_s: float) -> FloatArray:
    rotations = child.poses[:, :3, :3].copy()
    shares = 1.0 - np.exp(-np.diff(child.stamps_ns) * 1e-9 / tau_s)
    for k, share in enumerate(shares):
        step = se3.rotation_log(rotations[k].T @ child.poses[k + 1, :3, :3])
        rotations[k + 1] = rotations[k] @ se3.rotation_exp(share * step)
    return rotations


def late_positions(parent: Trajectory, child: Trajectory, delay_s: float, random: Any) -> Streams:
    """Positions later than the orientations of the same message."""
    late = child.shifted(delay_s).at(child.stamps_ns, extrapolate=True)
    return parent, with_poses(child, positions=late[:, :3, 3])


def yaw_gain(parent: Trajectory, child: Trajectory, gain: float, random: Any) -> Streams:
    """Dead reckoning whose yaw rate has a gain, as of wheels."""
    steps = se3.inverse(child.poses[:-1]) @ child.poses[1:]
    # The vehicle's vertical in the child's frame: the main axis of rotation.
    vectors = se3.rotation_log(steps[:, :3, :3])
    axis = np.linalg.eigh(vectors.T @ vectors)[1][:, -1]
    vectors = vectors + gain * np.outer(vectors @ axis, axis)
    steps[:, :3, :3] = se3.rotation_exp(vectors)
    poses = [child.poses[0]]
    for step in steps:
        poses.append(poses[-1] @ step)
    return parent, dataclasses.replace(child, poses=np.array(poses))


def loosened(parent: Trajectory, child: Trajectory, degrees: float, random: Any) -> Streams:
    """The mount moves half-way, by so many degrees and 2.5 cm for each."""
    axes = random.standard_normal((2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    shift = se3.exp(np.r_[0.025 * degrees * axes[0], np.radians(degrees) * axes[1]])
    poses = child.poses.copy()
    half = len(poses) // 2
    poses[half:] = poses[half:] @ shift
    return parent, dataclasses.replace(child, poses=poses)


def scaled(parent: Trajectory, child: Trajectory, excess: float, random: Any) -> Streams:
    """Lengths off by a factor."""
    return parent, child.scaled(1.0 + excess)


def mirrored(parent: Trajectory, child: Trajectory, axis: float, random: Any) -> Streams:
    """One axis of the positions mirrored."""
    positions = child.poses[:, :3, 3].copy()
    positions[:, int(axis)] *= -1.0
    return parent, with_poses(child, positions=positions)


def flattened(parent: Trajectory, child: Trajectory, share: float, random: Any) -> Streams:
    """Height, roll and pitch of the child are zero, or a share less than they were."""
    tilt = Rotation.from_matrix(child.poses[:, :3, :3]).as_euler("ZYX")
    tilt[:, 1:] *= 1.0 - share
    positions = child.poses[:, :3, 3] * [1.0, 1.0, 1.0 - share]
    return parent, with_poses(child, Rotation.from_euler("ZYX", tilt).as_matrix(), positions)


def as_float32(parent: Trajectory, child: Trajectory, metres: float, random: Any) -> Streams:
    """Positions far from the origin in 32 bits, both streams on one map."""
    origin = np.array([metres, 9.0 * metres, 0.0])

    def rounded(stream: Trajectory) -> Trajectory:
        positions = stream.poses[:, :3, 3] + origin
        return with_poses(stream, positions=positions.astype(np.float32).astype(float))

    return rounded(parent), rounded(child)


def _scalar_first(stream: Trajectory) -> Trajectory:
    quats = np.roll(se3.to_quat_xyzw(stream.poses), 1, axis=1)
    return Trajectory(stream.stamps_ns, se3.from_quat_xyzw(stream.poses[:, :3, 3], quats))


def scalar_first(parent: Trajectory, child: Trajectory, which: float, random: Any) -> Streams:
    """Quaternions w x y z in both files."""
    return _scalar_first(parent), _scalar_first(child)


def inverted(parent: Trajectory, child: Trajectory, noise: float, random: Any) -> Streams:
    """Inverse poses, under noise."""
    poses = se3.inverse(_noisy(child.poses, noise, random))
    return parent, dataclasses.replace(child, poses=poses)


def inverted_orientations(
    parent: Trajectory, child: Trajectory, noise: float, random: Any
) -> Streams:
    """Orientations inverted, positions upright."""
    poses = _noisy(child.poses, noise, random)
    return parent, with_poses(child, np.swapaxes(poses[:, :3, :3], 1, 2))


def late(parent: Trajectory, child: Trajectory, delay_s: float, random: Any) -> Streams:
    """The child's clock is off."""
    return parent, child.shifted(delay_s)


def jumping(parent: Trajectory, child: Trajectory, share: float, random: Any) -> Streams:
    """Lasting jumps of some 30 cm at a share of the poses."""
    shifts = np.zeros((len(child), 3))
    at = random.integers(len(child), size=round(share * len(child)))
    shifts[at] = 0.3 * random.standard_normal((len(at), 3))
    return parent, with_poses(child, positions=child.poses[:, :3, 3] + np.cumsum(shifts, axis=0))


_POSITIONS = frozenset({"smoothed_positions", "position_clock"})
_ESTIMATE = {"time_offset": "estimate"}

FAULTS = (
    Fault(
        "S1",
        "child is the parent's own frame",
        (0.01, 0.003, 0.0),
        copied,
        "m noise",
        frozenset({"same_frame"}),
    ),
    Fault(
        "S2",
        "child positions from the parent",
        (0.01, 0.003, 0.0),
        fused,
        "m noise",
        frozenset({"same_position", "same_frame"}),
    ),
    Fault(
        "S3",
        "two sensors, one world",
        (0.03, 0.1, 0.3),
        interleaved(False),
        "m",
        frozenset({"interleaved"}),
    ),
    Fault(
        "S3b",
        "two sensors, two worlds",
        (0.1, 0.3, 3.0),
        interleaved(True),
        "m",
        frozenset({"interleaved"}),
    ),
    Fault("S4", "positions low-passed", (0.05, 0.1, 0.2), low_passed, "s", _POSITIONS),
    Fault("S4b", "positions late", (0.05, 0.1, 0.2), late_positions, "s", _POSITIONS),
    Fault("S5", "positions smoothed, no delay", (0.05, 0.1, 0.2), smoothed, "s", _POSITIONS),
    Fault(
        "S6",
        "all low-passed",
        (0.05, 0.1, 0.2),
        all_low_passed,
        "s",
        frozenset({"smoothed_orientations", *_POSITIONS}),
        _ESTIMATE,
    ),
    Fault("S7", "yaw gain", (0.005, 0.01, 0.02), yaw_gain, "", frozenset({"rotation_gain"})),
    Fault(
        "S8",
        "mount loosened half-way",
        (0.5, 1.0, 2.0),
        loosened,
        "deg",
        frozenset({"mount_moved"}),
    ),
    Fault("S9", "scale", (0.005, 0.01, 0.02), scaled, "", frozenset({"scale"})),
    Fault(
        "S10",
        "mirrored axis",
        (0.0, 1.0, 2.0),
        mirrored,
        "(axis)",
        frozenset({"axes", "left_handed"}),
    ),
    Fault(
        "S10b",
        "child in 2D",
        (0.5, 0.8, 1.0),
        flattened,
        "share",
        frozenset({"flat", "unrelated", "noisy"}),
    ),
    Fault(
        "S11",
        "float32 positions",
        (2e3, 5e4, 5e5),
        as_float32,
        "m east",
        frozenset({"coarse_positions"}),
    ),
    Fault(
        "S12",
        "both scalar first",
        (0.0,),
        scalar_first,
        "",
        frozenset({"quaternion_order"}),
    ),
    Fault(
        "S13",
        "inverse poses under noise",
        (0.003, 0.02, 0.05),
        inverted,
        "m noise",
        frozenset({"inverse"}),
    ),
    Fault(
        "S14",
        "orientations inverted",
        (0.0, 0.01, 0.03),
        inverted_orientations,
        "m noise",
        frozenset({"inverse_orientation"}),
    ),
    Fault("clock", "child's clock", (0.02, 0.05, 0.2), late, "s", frozenset({"time_offset"})),
    Fault("S15", "jumps", (0.003, 0.01, 0.03), jumping, "share", frozenset({"jumps"})),
)


# ------------------------------------------- faults that no limit was set with


def upright(parent: Trajectory, child: Trajectory, share: float, random: Any) -> Streams:
    """Orientations with yaw only, or with a share less of roll and pitch."""
    return parent, uprighted(child, share)


def uprighted(stream: Trajectory, share: float = 1.0) -> Trajectory:
    """A stream with a share less of roll and pitch."""
    angles = Rotation.from_matrix(stream.poses[:, :3, :3]).as_euler("ZYX")
    angles[:, 1:] *= 1.0 - share
    return with_poses(stream, Rotation.from_euler("ZYX", angles).as_matrix())


def rounded_stamps(parent: Trajectory, child: Trajectory, step_s: float, random: Any) -> Streams:
    """Stamps cut to a coarse clock; of equal ones the first."""
    step_ns = round(step_s * 1e9)
    stamps_ns, first = np.unique(child.stamps_ns // step_ns * step_ns, return_index=True)
    return parent, Trajectory(stamps_ns, child.poses[first])


def repeated(parent: Trajectory, child: Trajectory, share: float, random: Any) -> Streams:
    """The last share of the child's recording is a copy of the part before it."""
    n = int(share * len(child))
    poses = child.poses.copy()
    poses[-n:] = poses[-2 * n : -n]
    return parent, dataclasses.replace(child, poses=poses)


def restarted(parent: Trajectory, child: Trajectory, gap_s: float, random: Any) -> Streams:
    """The child's world starts anew half-way, after a gap."""
    half = len(child) // 2
    poses = child.poses.copy()
    poses[half:] = se3.inverse(poses[half]) @ poses[half:]
    gone = (child.stamps_ns > child.stamps_ns[half]) & (
        child.stamps_ns < child.stamps_ns[half] + gap_s * 1e9
    )
    return parent, Trajectory(child.stamps_ns[~gone], poses[~gone])


def flipped(parent: Trajectory, child: Trajectory, part: float, random: Any) -> Streams:
    """One component of every quaternion has the wrong sign: as in left-handed axes."""
    quats = se3.to_quat_xyzw(child.poses)
    quats[:, int(part)] *= -1.0
    return parent, Trajectory(child.stamps_ns, se3.from_quat_xyzw(child.poses[:, :3, 3], quats))


def slow_clock(parent: Trajectory, child: Trajectory, drift_s: float, random: Any) -> Streams:
    """The child's latency grows from zero over the recording."""
    elapsed = child.stamps_ns - child.stamps_ns[0]
    late = (elapsed * (drift_s / (elapsed[-1] * 1e-9))).astype(np.int64)
    return parent, Trajectory(child.stamps_ns + late, child.poses)


def smooth_parent(parent: Trajectory, child: Trajectory, tau_s: float, random: Any) -> Streams:
    """The parent's orientations are low-passed and shifted back by the delay."""
    late = with_poses(parent, _low_passed_rotations(parent, tau_s))
    back = late.shifted(-tau_s).at(parent.stamps_ns, extrapolate=True)
    return with_poses(parent, back[:, :3, :3]), child


def in_unit(parent: Trajectory, child: Trajectory, factor: float, random: Any) -> Streams:
    """Lengths in another unit."""
    return parent, child.scaled(factor)


def degrees_as_radians(parent: Trajectory, child: Trajectory, which: float, random: Any) -> Streams:
    """Euler angles in degrees that are read as radians: all, yaw only, or roll and pitch only."""
    angles = Rotation.from_matrix(child.poses[:, :3, :3]).as_euler("ZYX")
    parts = {0.0: slice(None), 1.0: slice(0, 1), 2.0: slice(1, 3)}[which]
    angles[:, parts] = np.degrees(angles[:, parts])
    return parent, with_poses(child, Rotation.from_euler("ZYX", angles).as_matrix())


def remounted(parent: Trajectory, child: Trajectory, degrees: float, random: Any) -> Streams:
    """Two recordings, a minute apart, with another mount and other worlds in the second."""
    _, moved = loosened(parent, child, degrees, random)
    worlds = [se3.exp(random.standard_normal(6)) for _ in range(2)]
    half_ns = child.stamps_ns[len(child) // 2]

    def second(stream: Trajectory, world: FloatArray) -> Trajectory:
        is_late = stream.stamps_ns >= half_ns
        poses = stream.poses.copy()
        poses[is_late] = world @ poses[is_late]
        return Trajectory(stream.stamps_ns + 60_000_000_000 * is_late, poses)

    return second(parent, worlds[0]), second(moved, worlds[1])


def held(parent: Trajectory, child: Trajectory, interval_s: float, random: Any) -> Streams:
    """A slow source published fast: each pose is repeated until there is a new one."""
    elapsed_s = (child.stamps_ns - child.stamps_ns[0]) * 1e-9
    steps = (elapsed_s / interval_s).astype(int)
    first = np.unique(steps, return_index=True)[1]
    return parent, dataclasses.replace(child, poses=child.poses[first[steps]])


def mixed(parent: Trajectory, child: Trajectory, metres: float, random: Any) -> Streams:
    """Two sensors on one topic, in no order."""
    offset = se3.from_rotation_translation(np.eye(3), [metres, 0.0, 0.0])
    is_other = random.random(len(child)) < 0.5
    poses = child.poses.copy()
    poses[is_other] = poses[is_other] @ offset
    return parent, dataclasses.replace(child, poses=poses)


_ANY = frozenset({"*"})

UNTUNED = (
    Fault("U1", "orientations with yaw only", (0.2, 0.5, 1.0), upright, "share", _ANY),
    Fault("U2", "coarse stamps", (0.01, 0.05, 0.1), rounded_stamps, "s", _ANY),
    Fault("U3", "part of the child repeated", (0.1, 0.25, 0.5), repeated, "share", _ANY),
    Fault("U4", "child restarted half-way", (0.0, 1.0, 10.0), restarted, "s gap", _ANY),
    Fault("U5", "quaternion with one wrong sign", (0.0, 1.0, 2.0), flipped, "(part)", _ANY),
    Fault("U6", "latency that grows", (0.02, 0.05, 0.2), slow_clock, "s", _ANY),
    Fault("U7", "parent's orientations smoothed", (0.05, 0.1, 0.2), smooth_parent, "s", _ANY),
    Fault("U8", "another unit", (100.0, 1000.0, 3.28084), in_unit, "", _ANY),
    Fault("U9", "degrees read as radians", (0.0, 1.0, 2.0), degrees_as_radians, "(which)", _ANY),
    Fault("U10", "two recordings, remounted", (1.0, 2.0, 5.0), remounted, "deg", _ANY),
    Fault("U11", "poses held", (0.1, 0.2, 0.5), held, "s", _ANY),
    Fault("U12", "two sensors, no order", (0.03, 0.1, 0.3), mixed, "m", _ANY),
)


# ------------------------------------- faults that were built when all was done


def parent_positions_late(parent: Trajectory, child: Trajectory, s: float, random: Any) -> Streams:
    """Positions of the parent later than the orientations of the same message."""
    return late_positions(child, parent, s, random)[1], child


def late_orientations(
    parent: Trajectory, child: Trajectory, delay_s: float, random: Any
) -> Streams:
    """Orientations of the child later than the positions of the same message."""
    late = child.shifted(delay_s).at(child.stamps_ns, extrapolate=True)
    return parent, with_poses(child, rotations=late[:, :3, :3])


def height_gain(parent: Trajectory, child: Trajectory, gain: float, random: Any) -> Streams:
    """Heights of the child off by a factor, as of a barometer."""
    return parent, with_poses(child, positions=child.poses[:, :3, 3] * [1.0, 1.0, 1.0 + gain])


def heading_drift(parent: Trajectory, child: Trajectory, degrees: float, random: Any) -> Streams:
    """The child's world turns about its vertical, by so many degrees a minute."""
    minutes = (child.stamps_ns - child.stamps_ns[0]) / 60e9
    worlds = np.tile(np.eye(4), (len(child), 1, 1))
    worlds[:, :3, :3] = se3.rotation_exp(np.outer(np.radians(degrees) * minutes, [0.0, 0.0, 1.0]))
    return parent, dataclasses.replace(child, poses=worlds @ child.poses)


def flat_positions(parent: Trajectory, child: Trajectory, share: float, random: Any) -> Streams:
    """Heights of the child a share less than they were; orientations as they are."""
    return parent, with_poses(child, positions=child.poses[:, :3, 3] * [1.0, 1.0, 1.0 - share])


def jittered(parent: Trajectory, child: Trajectory, sigma_s: float, random: Any) -> Streams:
    """Stamps of the child scatter; in the order of the stamps."""
    stamps_ns = child.stamps_ns + np.round(1e9 * sigma_s * random.standard_normal(len(child)))
    stamps_ns, first = np.unique(stamps_ns.astype(np.int64), return_index=True)
    return parent, Trajectory(stamps_ns, child.poses[first])


def every_second_late(parent: Trajectory, child: Trajectory, late_s: float, random: Any) -> Streams:
    """Every second pose of the child has a stamp that is too late."""
    stamps_ns = child.stamps_ns.copy()
    stamps_ns[1::2] += round(late_s * 1e9)
    stamps_ns, first = np.unique(stamps_ns, return_index=True)
    return parent, Trajectory(stamps_ns, child.poses[first])


def swinging(parent: Trajectory, child: Trajectory, degrees: float, random: Any) -> Streams:
    """The child swings on its mount about one axis, once in seven seconds."""
    elapsed_s = (child.stamps_ns - child.stamps_ns[0]) * 1e-9
    angles = np.radians(degrees) * np.sin(2 * np.pi * elapsed_s / 7.0)
    turned = child.poses.copy()
    turned[:, :3, :3] = turned[:, :3, :3] @ se3.rotation_exp(np.outer(angles, [0.0, 1.0, 0.0]))
    return parent, dataclasses.replace(child, poses=turned)


def coarse_angles(parent: Trajectory, child: Trajectory, degrees: float, random: Any) -> Streams:
    """Euler angles of the child in whole steps."""
    angles = Rotation.from_matrix(child.poses[:, :3, :3]).as_euler("ZYX", degrees=True)
    angles = np.round(angles / degrees) * degrees
    return parent, with_poses(child, Rotation.from_euler("ZYX", angles, degrees=True).as_matrix())


def both_low_passed(parent: Trajectory, child: Trajectory, tau_s: float, random: Any) -> Streams:
    """Positions of both streams low-passed, orientations not."""
    _, slow_child = low_passed(parent, child, tau_s, random)
    _, slow_parent = low_passed(child, parent, tau_s, random)
    return slow_parent, slow_child


UNSEEN = (
    Fault("V1", "parent's positions late", (0.02, 0.05, 0.1), parent_positions_late, "s", _ANY),
    Fault("V2", "child's orientations late", (0.02, 0.05, 0.1), late_orientations, "s", _ANY),
    Fault("V3", "heights off by a factor", (0.02, 0.1, 0.5), height_gain, "", _ANY),
    Fault("V4", "heading drifts", (1.0, 5.0, 20.0), heading_drift, "deg/min", _ANY),
    Fault("V5", "positions flat", (0.2, 0.5, 1.0), flat_positions, "share", _ANY),
    Fault("V6", "stamps scatter", (0.005, 0.02, 0.05), jittered, "s", _ANY),
    Fault("V7", "every second stamp late", (0.01, 0.02, 0.04), every_second_late, "s", _ANY),
    Fault("V8", "child swings on its mount", (0.2, 1.0, 5.0), swinging, "deg", _ANY),
    Fault("V9", "angles in whole steps", (0.2, 1.0, 5.0), coarse_angles, "deg", _ANY),
    Fault(
        "V10", "both streams' positions low-passed", (0.05, 0.1, 0.2), both_low_passed, "s", _ANY
    ),
)
